"""Correction of camera rotations during recording: detection, report, compensation, and no false detections."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_scenes import rotate_view
from sylpose.features.static_background import (
    MIN_CORNERS,
    RotationRectifier,
    detect_corners,
    estimate_camera_rotation,
    find_unchanged_corners,
)
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.results import FramePose
from sylpose.rig import Camera
from sylpose.runs.checkpoint_schema import SERIALIZER
from sylpose.simulate import make_demo_scene
from sylpose.simulate.textures import make_room_image
from sylpose.status import FrameStatus
from sylpose.tracking.camera_side.camera_motion import CameraMotionDetector
from sylpose.tracking.context import Context, TrackedFrame
from sylpose.tracking.joint_side.joint_state import RETRY_FRAMES, JointState, Nudge
from sylpose.tracking.reports import CameraMotionReport
from sylpose.tracking.state_machine import add_nudge_faults
from sylpose.tracking.tracker import Tracker, track
from tests.clips import Clip, compute_pose_errors, frame_sets
from tests.stored import dump_state, restore_state

SIZE = (320, 240)
FRAMES, NUDGED, CAMERA = 9, 4, 1
AXIS = np.array([0.6, -0.7, 0.39])
AXIS /= np.linalg.norm(AXIS)
FAULT_TEXT = re.compile(r"camera (\S+) was nudged at frame (\d+): the background turned by (\S+) degrees")


@pytest.fixture(scope="module")
def camera() -> Camera:
    matrix = np.array([[400.0, 0, 159.5], [0, 400.0, 119.5], [0, 0, 1]])
    return Camera("cam_0", SIZE, matrix, np.array([-0.1, 0.03, 0, 0, 0]), RigidTransform.identity())


def render_wall(seed: int = 3) -> Image:
    return make_room_image(*SIZE, np.random.default_rng(seed))


def add_noise(image: Image, seed: int, gain: float = 1.0) -> Image:
    noise = np.random.default_rng(seed).normal(0, 2.0, image.shape)
    return np.asarray(np.clip(gain * image + noise, 0, 255), np.uint8)


def nudge_rotvec(degrees: float) -> FloatArray:
    """Return the rotation vector of directions in the camera."""
    return np.asarray(np.radians(degrees) * AXIS)


def apply_nudge(image: Image, camera: Camera, degrees: float) -> Image:
    return np.asarray(rotate_view(image, camera, -nudge_rotvec(degrees)), np.uint8)


def rotation_error(rotation: FloatArray, degrees: float) -> float:
    """Return the error of a rotation, degrees."""
    return float(
        np.degrees((Rotation.from_matrix(rotation) * Rotation.from_rotvec(nudge_rotvec(degrees)).inv()).magnitude())
    )


# --- corners of one image


@pytest.mark.parametrize("degrees", [0.5, 2.0, 9.0])
def test_rotation_is_estimated_and_compensated(camera: Camera, degrees: float) -> None:
    image = render_wall()
    backdrop = detect_corners(add_noise(image, 1))
    assert MIN_CORNERS < len(backdrop) <= 120
    now = add_noise(apply_nudge(image, camera, degrees), 2)
    assert find_unchanged_corners(backdrop, now).mean() < 0.4
    turn = estimate_camera_rotation(backdrop, now, camera, np.ones(len(backdrop), bool))
    assert turn is not None
    assert rotation_error(turn.rotation, degrees) < 4 * np.degrees(turn.sd)
    assert 0.002 < np.degrees(turn.sd) < 0.05
    assert turn.n_inliers > 0.8 * turn.n_evaluated
    assert turn.n_static <= 1
    steadied = RotationRectifier(camera, turn.rotation)
    back = steadied.rectify_image(now).astype(float)
    assert 0.3 < steadied.valid.mean() < 1.0
    worse, better = (np.abs(x - image)[steadied.valid].mean() for x in (now.astype(float), back))
    assert better < 0.6 * worse
    # The mask is transformed alike and is empty where there is no image.
    everywhere = np.ones(SIZE[::-1], bool)
    np.testing.assert_array_equal(steadied.rectify_mask(everywhere), steadied.valid)


def test_illumination_change_is_not_motion(camera: Camera) -> None:
    backdrop = detect_corners(add_noise(render_wall(), 1))
    for gain in (0.5, 1.0, 1.3):
        now = add_noise(render_wall(), 2, gain)
        assert find_unchanged_corners(backdrop, now).mean() > 0.8
        turn = estimate_camera_rotation(backdrop, now, camera, np.ones(len(backdrop), bool))
        assert turn is not None
        assert rotation_error(turn.rotation, 0.0) < 0.02
        assert turn.n_inliers > 0.8 * turn.n_evaluated
        assert turn.displacement_px < 0.3


# --- one camera


def detect_motion(
    camera: Camera, images: Sequence[Image | None]
) -> tuple[CameraMotionDetector, list[CameraMotionReport]]:
    watch = CameraMotionDetector(camera)
    return watch, [watch.detect(image, None, k) for k, image in enumerate(images)]


def test_nudge_is_confirmed_in_second_frame(camera: Camera) -> None:
    image, moved = render_wall(), apply_nudge(render_wall(), camera, 1.0)
    seen = [add_noise(image, k) for k in range(4)] + [add_noise(moved, k) for k in range(4, 6)]
    watch, reported = detect_motion(camera, [*seen[:2], None, *seen[2:]])
    assert [stance.has_changed for stance in reported] == [False] * 5 + [True] * 2
    assert [stance.is_confirmed for stance in reported] == [False] * 6 + [True]
    assert {stance.first_frame for stance in reported[5:]} == {5}
    assert np.degrees(reported[6].angle) == pytest.approx(1.0, abs=4 * np.degrees(reported[6].sd))
    watch.apply_correction()
    # The camera is static again, and a second nudge adds to the first.
    more, _ = watch.stabilize(add_noise(moved, 7), None)
    assert not watch.detect(more, None, 7).has_changed
    for k in (8, 9):
        more, _ = watch.stabilize(add_noise(apply_nudge(render_wall(), camera, 2.5), k), None)
        stance = watch.detect(more, None, k)
    assert stance.is_confirmed
    assert np.degrees(stance.angle) == pytest.approx(1.5, abs=0.05)
    watch.apply_correction()
    assert watch.stabilizer is not None
    assert rotation_error(watch.stabilizer.rotation, 2.5) < 0.05
    # The original image is unchanged, to the bit.
    again: CameraMotionDetector = SERIALIZER.load(memoryview(b"".join(SERIALIZER.dump(watch))), CameraMotionDetector)
    np.testing.assert_array_equal(again.stabilize(moved, None)[0], watch.stabilize(moved, None)[0])


def render_person(k: int) -> Image:
    """A person in front of up to half of the wall."""
    image, coat = render_wall().copy(), render_wall(8)[:, : SIZE[0] // 2]
    left = 40 * k - SIZE[0] // 2
    low, high = max(left, 0), min(left + coat.shape[1], SIZE[0])
    image[:, low : max(high, low)] = coat[:, low - left : max(high, low) - left]
    return image


def render_large_object(k: int) -> Image:
    """An object that fills four fifths of the image and starts to move as fast as a nudge."""
    image, step = render_wall().copy(), 4 * max(k - 3, 0)
    image[24:-24, 32:-32] = np.roll(render_wall(9), step, axis=1)[24:-24, 32:-32]
    return image


def render_covered(k: int) -> Image:
    return np.zeros_like(render_wall()) if 3 <= k < 6 else render_wall()


def render_plain(k: int) -> Image:
    return np.full((SIZE[1], SIZE[0], 3), 90 + 20 * (k > 5), np.uint8)


@pytest.mark.parametrize("view", [render_person, render_large_object, render_covered, render_plain])
def test_other_changes_are_not_nudges(camera: Camera, view: Callable[[int], Image]) -> None:
    _, reported = detect_motion(camera, [add_noise(view(k), k) for k in range(14)])
    assert not any(stance.angle for stance in reported)


def test_slow_camera_motion_is_confirmed_at_rest(camera: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    """Corners on the object are ignored from the first frame on; its predicted position grows less certain."""
    watch, arguments = CameraMotionDetector(camera), []

    def project(*_: object) -> FloatArray:
        arguments.append(1)
        return np.array([[100.0, 60], [220, 60], [220, 180], [100, 180]])

    monkeypatch.setattr("sylpose.tracking.camera_side.camera_motion.project_outline", project)
    points = np.zeros((1, 3))
    course = [0.0, 0.0, 0.4, 1.6, 2.2, 1.5, 1.5]
    reported = [
        watch.detect(add_noise(apply_nudge(render_wall(), camera, d), k), points, k) for k, d in enumerate(course)
    ]
    assert [stance.is_confirmed for stance in reported] == [False] * 6 + [True]
    assert reported[-1].first_frame == 2
    assert np.degrees(reported[-1].angle) == pytest.approx(1.5, abs=0.05)
    assert len(arguments) == 1


def test_detection_restarts_for_continuously_moving_camera(camera: Camera) -> None:
    swings = [
        add_noise(apply_nudge(render_wall(), camera, 3 + 1.5 * np.sin(1.3 * k)), k) for k in range(RETRY_FRAMES + 2)
    ]
    watch, reported = detect_motion(camera, [render_wall(), *swings])
    assert not any(stance.is_confirmed for stance in reported)
    assert all(stance.angle for stance in reported[1 : RETRY_FRAMES + 1])
    assert watch.background is None
    assert RETRY_FRAMES - 2 <= watch.pause <= RETRY_FRAMES


# --- all cameras


@pytest.fixture(scope="module")
def clip() -> Clip:
    return Clip.render(make_demo_scene(frames=FRAMES, angle_deg=25, size=(320, 240), n_cameras=3, seed=4))


def nudge_cameras(clip: Clip, degrees: float, cameras: Sequence[int] = (CAMERA,)) -> list[FrameSet]:
    images = [list(seen) for seen in clip.images]
    for seen in images[NUDGED:]:
        for c in cameras:
            seen[c] = apply_nudge(seen[c], clip.rig.cameras[c], degrees)
    return frame_sets(images)


def collect_faults(tracked: Sequence[TrackedFrame]) -> list[set[tuple[str, ...]]]:
    """Return the nudge faults of each frame."""
    return [{message.groups() for fault in f.pose.faults if (message := FAULT_TEXT.match(fault))} for f in tracked]


@pytest.mark.parametrize("boxed", [pytest.param(True, marks=pytest.mark.slow), False])
def test_nudged_camera_is_reported_and_used_again(clip: Clip, boxed: bool) -> None:
    tracked = list(track(nudge_cameras(clip, 1.0), clip.rig, clip.boxes if boxed else None))
    *_, reported = message = collect_faults(tracked)
    assert message == [set()] * (NUDGED + 1) + [reported] * (FRAMES - NUDGED - 1)
    ((name, frame, angle),) = reported
    assert (name, int(frame)) == ("cam_1", NUDGED)
    assert 0.97 <= float(angle) <= 1.03
    # Its observations are used again, and the poses are as good as without a nudge.
    assert tracked[NUDGED].pose.inliers[CAMERA] == 0
    assert all(f.pose.inliers[CAMERA] > 20 for f in tracked[NUDGED + 1 :])
    found = compute_pose_errors(tracked, clip.truth)
    assert 0.01 < found[:, 0].max() < 0.6
    assert 0.05 < found[:, 1].max() < 3.0


@pytest.mark.parametrize(
    ("degrees", "cameras"), [pytest.param(0.0, (CAMERA,), marks=pytest.mark.slow), (1.0, (0, 1, 2))]
)
def test_no_fault_if_no_or_all_cameras_rotate(clip: Clip, degrees: float, cameras: Sequence[int]) -> None:
    frames = nudge_cameras(clip, degrees, cameras)[: NUDGED + 3]
    tracked = list(track(frames, clip.rig, clip.boxes))
    assert not any(collect_faults(tracked))
    assert all(f.pose.inliers.min() > 0 for f in tracked[1:NUDGED])


def test_checkpoint_continues_exactly(clip: Clip) -> None:
    frames, states, found = nudge_cameras(clip, 2.0), [], []
    with Tracker(clip.rig, clip.boxes, workers=1) as tracker:
        for frame in frames:
            states.append(dump_state(tracker))
            found += tracker.step(frame)
    assert any(collect_faults(found))
    for k in (NUDGED + 1, NUDGED + 2):  # before and after confirmation
        with Tracker(clip.rig, clip.boxes, workers=1) as tracker:
            restore_state(tracker, states[k])
            again = [f for frame in frames[k:] for f in tracker.step(frame)]
        for one, other in zip(again, found[k:], strict=True):
            assert one.pose.faults == other.pose.faults
            np.testing.assert_array_equal(one.pose.covariance, other.pose.covariance)
            np.testing.assert_array_equal(one.pose.position, other.pose.position)


def test_rotation_uncertainty_enters_pose_covariance(clip: Clip) -> None:
    pose = FramePose(7, 0.2, FrameStatus.TRACKED, RigidTransform.identity(), np.eye(6), np.zeros(3, int), np.zeros(3))
    before, context = replace(pose, index=6), cast(Context, SimpleNamespace(rig=clip.rig))
    frames = [TrackedFrame(p, clip.frames()[0], (None,) * 3, (None,) * 3, 1.0) for p in (before, pose)]
    state = JointState(nudges=(Nudge(2, 7, nudge_rotvec(1.234), 0.1), Nudge(0, 9, nudge_rotvec(5.7), 0.1)))
    found = add_nudge_faults(context, state, frames)
    assert [f.nudges for f in found] == [(), state.nudges[:1]]
    one, other = (f.pose for f in found)
    assert one.faults == ()
    assert other.faults == ("camera cam_2 was nudged at frame 7: the background turned by 1.2 degrees",)
    far = float(np.linalg.norm(clip.rig.cameras[2].center))
    np.testing.assert_allclose(one.covariance, np.eye(6))
    np.testing.assert_allclose(np.diag(other.covariance), np.repeat([1.01, 1 + (0.1 * far) ** 2], 3))
