"""A camera that is nudged while it records is named, with the frame and by how much, and its images are turned back; nothing
else that may happen in its images is taken for that."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_scenes import turned
from sylpose.app.checkpoint_schema import KINDS
from sylpose.app.serialization import decoded, encoded
from sylpose.features.static_background import FEWEST, Steadied, alike, begin, turn_since
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.results import FramePose, FrameStatus
from sylpose.rig import Camera
from sylpose.simulate import demo_scene
from sylpose.simulate.textures import room
from sylpose.tracking.camera_motion_correction import with_nudges
from sylpose.tracking.camera_motion_detection import PATIENCE, PAUSE, Watch
from sylpose.tracking.context import Team
from sylpose.tracking.joint_state import Joint, Nudge
from sylpose.tracking.reports import Stance
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import Tracker, track
from tests.clips import Clip, errors, frame_sets
from tests.stored import go_on, stored

SIZE = (320, 240)
FRAMES, NUDGED, CAMERA = 12, 6, 1
AXIS = np.array([0.6, -0.7, 0.39])
AXIS /= np.linalg.norm(AXIS)
SAID = re.compile(r"camera (\S+) was nudged at frame (\d+): the background turned by (\S+) degrees")


@pytest.fixture(scope="module")
def camera() -> Camera:
    matrix = np.array([[400.0, 0, 159.5], [0, 400.0, 119.5], [0, 0, 1]])
    return Camera("cam_0", SIZE, matrix, np.array([-0.1, 0.03, 0, 0, 0]), RigidTransform.identity())


def wall(seed: int = 3) -> Image:
    return room(*SIZE, np.random.default_rng(seed))


def noisy(image: Image, seed: int, gain: float = 1.0) -> Image:
    noise = np.random.default_rng(seed).normal(0, 2.0, image.shape)
    return np.asarray(np.clip(gain * image + noise, 0, 255), np.uint8)


def nudge(degrees: float) -> FloatArray:
    """The rotation vector of directions in the camera."""
    return np.asarray(np.radians(degrees) * AXIS)


def after(image: Image, camera: Camera, degrees: float) -> Image:
    return np.asarray(turned(image, camera, -nudge(degrees)), np.uint8)


def off(rotation: FloatArray, degrees: float) -> float:
    """Degrees from what it should be."""
    return float(np.degrees((Rotation.from_matrix(rotation) * Rotation.from_rotvec(nudge(degrees)).inv()).magnitude()))


# --- corners of one image


@pytest.mark.parametrize("degrees", [0.5, 2.0, 9.0])
def test_the_rotation_is_found_and_taken_back(camera: Camera, degrees: float) -> None:
    image = wall()
    backdrop = begin(noisy(image, 1))
    assert FEWEST < len(backdrop) <= 120
    now = noisy(after(image, camera, degrees), 2)
    assert alike(backdrop, now).mean() < 0.4
    turn = turn_since(backdrop, now, camera, np.ones(len(backdrop), bool))
    assert turn is not None
    assert off(turn.rotation, degrees) < 4 * np.degrees(turn.sd)
    assert 0.002 < np.degrees(turn.sd) < 0.05
    assert turn.agree > 0.8 * turn.asked
    assert turn.still <= 1
    steadied = Steadied(camera, turn.rotation)
    back = steadied.image(now).astype(float)
    assert 0.3 < steadied.seen.mean() < 1.0
    worse, better = (np.abs(x - image)[steadied.seen].mean() for x in (now.astype(float), back))
    assert better < 0.6 * worse
    # A mask goes the same way, and nothing is on the object where there is no image.
    everywhere = np.ones(SIZE[::-1], bool)
    np.testing.assert_array_equal(steadied.mask(everywhere), steadied.seen)


def test_other_light_is_alike_and_stands(camera: Camera) -> None:
    backdrop = begin(noisy(wall(), 1))
    for gain in (0.5, 1.0, 1.3):
        now = noisy(wall(), 2, gain)
        assert alike(backdrop, now).mean() > 0.8
        turn = turn_since(backdrop, now, camera, np.ones(len(backdrop), bool))
        assert turn is not None
        assert off(turn.rotation, 0.0) < 0.02
        assert turn.agree > 0.8 * turn.asked
        assert turn.shift_px < 0.3


# --- one camera


def watched(camera: Camera, images: Sequence[Image | None]) -> tuple[Watch, list[Stance]]:
    watch = Watch(camera)
    return watch, [watch.look(image, lambda: None, k) for k, image in enumerate(images)]


def test_a_nudge_is_certain_in_its_second_frame(camera: Camera) -> None:
    image, moved = wall(), after(wall(), camera, 1.0)
    seen = [noisy(image, k) for k in range(4)] + [noisy(moved, k) for k in range(4, 6)]
    watch, told = watched(camera, [*seen[:2], None, *seen[2:]])
    assert [stance.odd for stance in told] == [False] * 5 + [True] * 2
    assert [stance.certain for stance in told] == [False] * 6 + [True]
    assert {stance.since for stance in told[5:]} == {5}
    assert np.degrees(told[6].angle) == pytest.approx(1.0, abs=4 * np.degrees(told[6].sd))
    watch.turn_back()
    # It stands again, and a second nudge adds to the first.
    more, _ = watch.seen(noisy(moved, 7), None)
    assert not watch.look(more, lambda: None, 7).odd
    for k in (8, 9):
        more, _ = watch.seen(noisy(after(wall(), camera, 2.5), k), None)
        stance = watch.look(more, lambda: None, k)
    assert stance.certain
    assert np.degrees(stance.angle) == pytest.approx(1.5, abs=0.05)
    watch.turn_back()
    assert watch.steady is not None
    assert off(watch.steady.rotation, 2.5) < 0.05
    # As it was is as it is, to the bit.
    table, *blocks = encoded(watch, KINDS, {})
    again: Watch = decoded(memoryview(b"".join([table, *blocks])), len(table), Watch, KINDS, {})
    np.testing.assert_array_equal(again.seen(moved, None)[0], watch.seen(moved, None)[0])


def walks_by(k: int) -> Image:
    """Somebody in front of up to half of the wall."""
    image, coat = wall().copy(), wall(8)[:, : SIZE[0] // 2]
    left = 40 * k - SIZE[0] // 2
    low, high = max(left, 0), min(left + coat.shape[1], SIZE[0])
    image[:, low : max(high, low)] = coat[:, low - left : max(high, low) - left]
    return image


def large(k: int) -> Image:
    """Something that fills four fifths of the image and begins to move, as fast as a nudge."""
    image, step = wall().copy(), 4 * max(k - 3, 0)
    image[24:-24, 32:-32] = np.roll(wall(9), step, axis=1)[24:-24, 32:-32]
    return image


def covered(k: int) -> Image:
    return np.zeros_like(wall()) if 3 <= k < 6 else wall()


def plain(k: int) -> Image:
    return np.full((SIZE[1], SIZE[0], 3), 90 + 20 * (k > 5), np.uint8)


@pytest.mark.parametrize("view", [walks_by, large, covered, plain])
def test_what_is_no_nudge_is_not_taken_for_one(camera: Camera, view: Callable[[int], Image]) -> None:
    _, told = watched(camera, [noisy(view(k), k) for k in range(14)])
    assert not any(stance.angle for stance in told)


def test_one_that_takes_its_time_is_certain_once_it_rests(camera: Camera) -> None:
    """Where the object is does not count from the first frame on: without this camera it is known less and less."""
    watch, asked = Watch(camera), []

    def region() -> FloatArray:
        asked.append(1)
        return np.array([[100.0, 60], [220, 60], [220, 180], [100, 180]])

    course = [0.0, 0.0, 0.4, 1.6, 2.2, 1.5, 1.5]
    told = [watch.look(noisy(after(wall(), camera, d), k), region, k) for k, d in enumerate(course)]
    assert [stance.certain for stance in told] == [False] * 6 + [True]
    assert told[-1].since == 2
    assert np.degrees(told[-1].angle) == pytest.approx(1.5, abs=0.05)
    assert len(asked) == 1


def test_one_that_never_stands_again_is_watched_anew(camera: Camera) -> None:
    swings = [noisy(after(wall(), camera, 3 + 1.5 * np.sin(1.3 * k)), k) for k in range(PATIENCE + 2)]
    watch, told = watched(camera, [wall(), *swings])
    assert not any(stance.certain for stance in told)
    assert all(stance.angle for stance in told[1 : PATIENCE + 1])
    assert watch.backdrop is None
    assert PAUSE - 2 <= watch.pause <= PAUSE


# --- all of them


@pytest.fixture(scope="module")
def clip() -> Clip:
    return Clip.render(demo_scene(frames=FRAMES, turn_deg=25, size=(320, 240), n_cameras=3, seed=4))


def nudged(clip: Clip, degrees: float, cameras: Sequence[int] = (CAMERA,)) -> list[FrameSet]:
    images = [list(seen) for seen in clip.images]
    for seen in images[NUDGED:]:
        for c in cameras:
            seen[c] = after(seen[c], clip.rig.cameras[c], degrees)
    return frame_sets(images)


def said_of(tracked: Sequence[TrackedFrame]) -> list[set[tuple[str, ...]]]:
    """By frame, what is said of nudges."""
    return [{said.groups() for fault in f.pose.faults if (said := SAID.match(fault))} for f in tracked]


@pytest.mark.parametrize("boxed", [pytest.param(True, marks=pytest.mark.slow), False])
def test_a_nudged_camera_is_named_and_goes_on(clip: Clip, boxed: bool) -> None:
    tracked = list(track(nudged(clip, 1.0), clip.rig, clip.boxes if boxed else None))
    *_, told = said = said_of(tracked)
    assert said == [set()] * (NUDGED + 1) + [told] * (FRAMES - NUDGED - 1)
    ((name, frame, angle),) = told
    assert (name, int(frame)) == ("cam_1", NUDGED)
    assert 0.97 <= float(angle) <= 1.03
    # It is heard again, and the poses are as good as if nothing had happened.
    assert tracked[NUDGED].pose.inliers[CAMERA] == 0
    assert all(f.pose.inliers[CAMERA] > 20 for f in tracked[NUDGED + 1 :])
    found = errors(tracked, clip.truth)
    assert 0.01 < found[:, 0].max() < 0.6
    assert 0.05 < found[:, 1].max() < 3.0


@pytest.mark.parametrize(("degrees", "cameras"), [(0.0, (CAMERA,)), (1.0, (0, 1, 2))])
def test_nobody_is_named_where_none_or_all_were_turned(clip: Clip, degrees: float, cameras: Sequence[int]) -> None:
    frames = nudged(clip, degrees, cameras)[: NUDGED + 3]
    tracked = list(track(frames, clip.rig, clip.boxes))
    assert not any(said_of(tracked))
    assert all(f.pose.inliers.min() > 0 for f in tracked[1:NUDGED])


def test_a_checkpoint_goes_on_exactly(clip: Clip) -> None:
    frames, states, found = nudged(clip, 2.0), [], []
    with Tracker(clip.rig, clip.boxes, workers=1) as tracker:
        for frame in frames:
            states.append(stored(tracker))
            found += tracker.step(frame)
    assert any(said_of(found))
    for k in (NUDGED + 1, NUDGED + 2):  # while it is being decided, and after
        with Tracker(clip.rig, clip.boxes, workers=1) as tracker:
            go_on(tracker, states[k])
            again = [f for frame in frames[k:] for f in tracker.step(frame)]
        for one, other in zip(again, found[k:], strict=True):
            assert one.pose.faults == other.pose.faults
            np.testing.assert_array_equal(one.pose.covariance, other.pose.covariance)
            np.testing.assert_array_equal(one.pose.position, other.pose.position)


def test_what_is_not_known_of_the_turn_is_not_known_of_the_pose(clip: Clip) -> None:
    pose = FramePose(7, 0.2, FrameStatus.TRACKED, RigidTransform.identity(), np.eye(6), np.zeros(3, int), np.zeros(3))
    before, team = replace(pose, index=6), cast(Team, SimpleNamespace(rig=clip.rig))
    frames = [TrackedFrame(p, clip.frames()[0], (None,) * 3, (None,) * 3, 1.0) for p in (before, pose)]
    joint = Joint(nudges=(Nudge(2, 7, nudge(1.234), 0.1), Nudge(0, 9, nudge(5.7), 0.1)))
    found = with_nudges(team, joint, frames)
    assert [f.nudges for f in found] == [(), joint.nudges[:1]]
    one, other = (f.pose for f in found)
    assert one.faults == ()
    assert other.faults == ("camera cam_2 was nudged at frame 7: the background turned by 1.2 degrees",)
    far = float(np.linalg.norm(clip.rig.cameras[2].center))
    np.testing.assert_allclose(one.covariance, np.eye(6))
    np.testing.assert_allclose(np.diag(other.covariance), np.repeat([1.01, 1 + (0.1 * far) ** 2], 3))
