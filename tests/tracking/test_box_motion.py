"""Box motion: the center of the boxes shows whether the object moves or something else does."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.trust import compute_errors, draw
from sylpose.features.sift import Features
from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.landmarks.landmark_filter import Landmarks, LandmarkTable
from sylpose.rig import Rig
from sylpose.simulate import Actor, ring
from sylpose.status import FrameStatus
from sylpose.tracking.box_motion import (
    OUTSIDE_REASON,
    RIVAL_REASON,
    _count_all_central,
    _is_at_edges,
    bound_pose,
    is_box_center_static,
    select_static_matches,
)
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.camera_side.frame import CameraFrame, FrameMatches
from sylpose.tracking.context import Context, Frame, LocalExecutor
from sylpose.tracking.first_motion import FirstMotion
from sylpose.tracking.joint_side.joint_state import JointState, KnownFrames, SolvedFrame
from sylpose.tracking.joint_side.object_model import ObjectModel
from sylpose.tracking.tracker import track
from tests.clips import Clip, compute_pose_errors, make_rotated_pose, make_slab, moving_scene, statuses

RADIUS = 0.15
RIG = ring(3, 1.5, 1000.0)


def make_bounded_state(rig: Rig = RIG) -> JointState:
    """Return the state after the first frame, with boxes."""
    n, cloud = len(rig), np.random.default_rng(0).uniform(-RADIUS, RADIUS, (200, 3))
    start = RigidTransform.identity()
    first = SolvedFrame(0, 0.0, np.zeros(n), start, np.zeros((6, 6)), np.zeros((n, 3)), np.ones(n, bool))
    model = ObjectModel(np.zeros(3), RADIUS, cloud, is_bounded=True, is_depth_guessed=True)
    return JointState(model, KnownFrames(first, (first,)))


def simulate_box_motion(shifts: list[tuple[float, float]], rig: Rig = RIG) -> tuple[bool, list[int]]:
    """Simulate displacements at the center and at the edge of each camera's box, pixels (NaN: no features).

    Returns:
        whether the center is static; number of static matches per camera.
    """
    executor, rng, n = LocalExecutor(len(rig), 1), np.random.default_rng(0), len(rig)
    state = make_bounded_state(rig)
    pairs, cameras = [], []
    for camera, moves in zip(rig, shifts, strict=True):
        outline = camera.project(state.object.points)
        low, size = outline.min(axis=0), np.ptp(outline, axis=0)
        at = rng.uniform(0.3, 0.7, (30, 2)), rng.uniform(0.0, 0.1, (30, 2))
        seen = [(low + size * where, px) for where, px in zip(at, moves, strict=True) if np.isfinite(px)]
        before = np.concatenate([np.empty((0, 2)), *(places for places, _ in seen)])
        after = before + np.repeat([px for _, px in seen], 30)[:, None] * np.array([0.6, 0.8])
        pairs.append([make_pair(before, after)] if len(before) else [])
        cameras.append(
            CameraFrame(make_features(after), np.zeros(len(after), bool), LandmarkTable(), np.full(len(after), -1))
        )
    images = FrameSet(1, 1.0, (None,) * n, (None,) * n, (None,) * n)
    frame = Frame(1, images, np.zeros(n), cameras=cameras)
    camera_trackers = [CameraTracker(c, camera) for c, camera in enumerate(rig)]
    context = Context(rig, camera_trackers, executor, "landmarks", False, True, np.zeros(n), 0)
    rest = select_static_matches(frame, pairs)
    return is_box_center_static(context, state, frame, pairs), [sum(map(len, of)) for of in rest]


def make_features(pixels: FloatArray) -> Features:
    return Features(pixels, pixels / 1000.0, np.zeros((len(pixels), 128), np.float32))


def make_pair(before: FloatArray, after: FloatArray) -> FrameMatches:
    n = len(before)
    table = LandmarkTable()
    known = Landmarks(
        np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)), np.ones(n, int), np.zeros(n, bool), before, np.full(n, -1)
    )
    earlier = CameraFrame(make_features(before), np.zeros(n, bool), table, table.update(known))
    return FrameMatches.from_indices(0, earlier, make_features(after), np.column_stack([np.arange(n), np.arange(n)]))


@pytest.mark.parametrize(
    ("shifts", "stands"),
    [
        ([(0.1, 12.0), (0.1, 12.0), (0.1, 0.1)], True),  # a person passes behind it
        ([(0.1, 12.0), (0.1, 0.1), (0.1, 0.1)], True),
        ([(12.0, 0.1), (12.0, 0.1), (12.0, 0.1)], False),  # the object moves in front of a wall
        ([(12.0, 0.1), (12.0, 0.1), (0.1, 0.1)], False),  # something static covers one camera
        ([(5.0, 60.0), (5.0, 60.0), (5.0, 60.0)], False),  # it moves too, a person faster
        ([(0.1, 0.1), (0.1, 0.1), (0.1, 0.1)], False),  # nothing moves
        ([(3.0, 9.0), (3.0, 9.0), (3.0, 9.0)], False),  # it rotates about its center
        ([(np.nan, 12.0), (np.nan, 12.0), (np.nan, 12.0)], False),  # no features at the center
        ([(np.nan, np.nan)] * 3, False),
    ],
)
def test_static_box_center(shifts: list[tuple[float, float]], stands: bool) -> None:
    assert simulate_box_motion(shifts)[0] is stands


@pytest.mark.parametrize(
    ("n_center", "n_edge", "follows", "expected"),
    [
        (60, 30, "edge", True),  # a trunk behind an object that hardly moves yet
        (60, 30, "center", False),
        (60, 30, "all", False),
        (0, 30, "edge", False),  # only the border of a board is printed
        (5, 60, "edge", True),
    ],
)
def test_motion_at_the_edges_of_the_boxes(n_center: int, n_edge: int, follows: str, expected: bool) -> None:
    rng, state, n = np.random.default_rng(0), make_bounded_state(), len(RIG)
    cameras, pairs, inliers = list[CameraTracker](), list[list[FrameMatches]](), list[list[FrameMatches]]()
    for c, camera in enumerate(RIG):
        outline = camera.project(state.object.points)
        low, size = outline.min(axis=0), np.ptp(outline, axis=0)
        at = np.concatenate([rng.uniform(0.4, 0.6, (n_center, 2)), rng.uniform(0.05, 0.2, (n_edge, 2))])
        before, is_center = low + size * at, np.arange(n_center + n_edge) < n_center
        pair, tracker = make_pair(before, before + 9.0), CameraTracker(c, camera)
        tracker.frames = {0: CameraFrame(make_features(before), np.zeros(len(before), bool), LandmarkTable())}
        is_follower = {"center": is_center, "edge": ~is_center, "all": np.ones(len(before), bool)}[follows]
        cameras.append(tracker)
        pairs.append([pair])
        inliers.append([pair.subset(is_follower)])
    context = Context(RIG, cameras, LocalExecutor(n, 1), "landmarks", False, True, np.zeros(n), 0)
    motion = cast(FirstMotion, SimpleNamespace(inliers=inliers))
    assert _is_at_edges(_count_all_central(context, state, pairs, motion)) is expected


def test_static_matches_are_selected() -> None:
    assert simulate_box_motion([(0.1, 12.0), (12.0, 0.1), (np.nan, np.nan)])[1] == [30, 30, 0]


def test_person_passing_behind_static_object() -> None:
    """The person is visible in most boxes and larger than the object; then the object moves too."""
    rest, moving = 8, 4

    def path(frame: float) -> RigidTransform:
        return make_rotated_pose(3.0 * max(frame - rest + 1, 0.0))

    def walking_path(frame: float) -> RigidTransform:
        return make_rotated_pose(1.0 * frame, [-0.45 + 0.08 * frame, 0.0, 0.45])

    clip = Clip.render(moving_scene(path, rest + moving, [Actor(make_slab((0.4, 0.8, 0.2), 30), walking_path)]))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (rest + moving - 1)
    error = compute_pose_errors(tracked, clip.truth)
    assert error[: rest - 1, 0].max() < 0.1
    assert error[: rest - 1, 1].max() < 1.0
    assert error[:, 0].max() < 1.0


def test_body_that_continues_outside_of_the_boxes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Boxes hold the whole object: what fills them and more is another body, or they are too small."""
    clip = Clip.render(moving_scene(lambda frame: make_rotated_pose(4.0 * frame), 5))
    assert clip.boxes is not None
    small = {
        name: Box(box.x + 0.35 * box.width, box.y + 0.35 * box.height, 0.3 * box.width, 0.3 * box.height)
        for name, box in clip.boxes.items()
    }
    inside = list(track(clip.frames(), clip.rig, clip.boxes))
    assert statuses(inside)[1:] == [FrameStatus.TRACKED] * 4
    monkeypatch.setattr(Context, "is_contradicted", False)  # in so small boxes
    outside = list(track(clip.frames(), clip.rig, small))
    assert set(statuses(outside)[1:]) == {FrameStatus.AMBIGUOUS}
    assert outside[-1].pose.reason == OUTSIDE_REASON


def test_object_that_left_only_background_does_not_rest() -> None:
    """It turns too fast for any match: all matches are of the wall, which stands still."""
    clip = Clip.render(moving_scene(lambda frame: make_rotated_pose(110.0 * frame), 3))
    assert clip.boxes is not None
    large = {
        name: Box(box.x - 0.3 * box.width, box.y - 0.3 * box.height, 1.6 * box.width, 1.6 * box.height)
        for name, box in clip.boxes.items()
    }
    found = list(track(clip.frames(), clip.rig, large))
    assert statuses(found)[1:] == [FrameStatus.BACKGROUND_ONLY] * 2


def test_pose_from_guessed_depths_has_its_covariance() -> None:
    """An arm before the object, in boxes of two cameras: before any depth is known the arm's motion fits as well."""
    take = draw("arm-across", 93)
    poses = [one.pose for one in track(list(islice(take.frames(), 4)), take.calibration, take.boxes, workers=1)]
    (truth, *_) = take.true_poses()
    errors, _ = compute_errors(take, poses, truth)
    assert errors[1:, 0].min() > 3.0  # degrees: else this scene is no example any more
    assert errors[1:, 2:].max() < 3.0  # standard deviations


def bound_rod(rig: Rig, displacement: float = 0.0) -> FloatArray:
    """Return standard deviations (6,) of the pose of a rod along z that may have moved so far."""
    state = make_bounded_state(rig)
    upright = RigidTransform.from_rotation(Rotation.from_rotvec([0.5 * np.pi, 0.0, 0.0]))
    first = replace(state.frames.first, world_from_object=upright)
    state = replace(state, object=replace(state.object, points=ROD), frames=KnownFrames(first, (first,)))
    context = Context(rig, (), LocalExecutor(len(rig), 1), "landmarks", False, True, np.zeros(len(rig)), 0)
    return np.asarray(np.sqrt(np.diag(bound_pose(context, state, displacement).covariance)))


ROD = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 3)) * [0.02, RADIUS, 0.02]
ROD -= ROD.mean(axis=0)


def test_rest_of_a_thin_object_is_uncertain_about_its_axis() -> None:
    """The smallest motion that would be seen turns a rod by much about its axis, and by little across it."""
    sd = bound_rod(RIG)
    assert sd[2] > 4.0 * sd[:2].max()
    lever = np.sqrt((ROD[:, 1] ** 2).mean())
    np.testing.assert_allclose(sd[:2], sd[4:2:-1] / lever, rtol=0.1)


def test_displacement_along_the_view_is_not_seen() -> None:
    """Of a single camera: the object's radius bounds it. A displacement of unknown length is as large, in any direction."""
    rig, length = ring(1, 1.5, 1000.0), 0.01
    sd, view = bound_rod(rig, length)[3:], np.abs(rig.cameras[0].rotation[2])
    along, across = int(np.argmax(view)), int(np.argmin(view))
    assert view[along] > 0.99
    np.testing.assert_allclose([sd[along], sd[across]], [RADIUS, length], rtol=0.05)
    assert (bound_rod(RIG, np.nan)[3:] > 0.5 * RADIUS).all()


def disturb_image(image: Image, *, blur: float, light: float, noise: float, seed: int) -> Image:
    """Blur an image, change its light and add sensor noise."""
    values = image.astype(np.float32) if not blur else cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur)
    values = light * values + noise * np.random.default_rng(seed).standard_normal(image.shape)
    return np.asarray(np.clip(np.round(values), 0, 255), np.uint8)


@pytest.mark.parametrize(
    ("blur", "light", "noise"), [(0.0, 1.0, 2.0), (0.0, 1.0, 5.0), (0.0, 0.4, 4.0), (2.0, 1.0, 2.0), (2.0, 1.0, 4.0)]
)
def test_resting_object_is_tracked_in_noise(blur: float, light: float, noise: float) -> None:
    clip = Clip.render(moving_scene(lambda frame: make_rotated_pose(0.0 * frame), 4))
    disturbed = [
        replace(
            frames,
            images=tuple(
                None if own is None else disturb_image(own, blur=blur, light=light, noise=noise, seed=10 * k + c)
                for c, own in enumerate(frames.images)
            ),
        )
        for k, frames in enumerate(clip.frames())
    ]
    assert statuses(list(track(disturbed, clip.rig, clip.boxes)))[1:] == [FrameStatus.TRACKED] * 3


def test_resting_object_is_found_again_after_a_lost_frame() -> None:
    clip = Clip.render(moving_scene(lambda frame: make_rotated_pose(0.0 * frame), 6))
    frames = list(clip.frames())
    frames[3] = replace(frames[3], images=(None,) * len(clip.rig))
    found = statuses(list(track(frames, clip.rig, clip.boxes)))
    assert found[3] is FrameStatus.LOST
    assert set(found[4:]) <= {FrameStatus.TRACKED, FrameStatus.RELOCALIZED}


def test_resting_object_is_tracked_in_fading_light() -> None:
    clip = Clip.render(moving_scene(lambda frame: make_rotated_pose(0.0 * frame), 4))
    fading = [
        replace(frames, images=tuple(None if own is None else (light * own).astype(np.uint8) for own in frames.images))
        for frames, light in zip(clip.frames(), (1.0, 0.9, 0.8, 0.7), strict=True)
    ]
    found = list(track(fading, clip.rig, clip.boxes))
    assert statuses(found)[1:] == [FrameStatus.TRACKED] * 3


@pytest.mark.parametrize("seed", [76, 81, 90])
def test_arm_before_the_object_is_not_tracked_instead(seed: int) -> None:
    """It has more matches in the boxes than the object, and begins to move with it; the object is at their centers."""
    take = draw("arm-across", seed)
    poses = [one.pose for one in track(list(islice(take.frames(), 4)), take.calibration, take.boxes, workers=1)]
    (truth, *_) = take.true_poses()
    errors, _ = compute_errors(take, poses, truth)
    is_wrong = (errors[:, 0] > 3.0) & (errors[:, 2] > 5.0)
    assert not (is_wrong & [pose.status is FrameStatus.TRACKED for pose in poses]).any()
    assert errors[-1, 0] < 1.0
    assert all(pose.reason == RIVAL_REASON for pose in poses if pose.status is FrameStatus.AMBIGUOUS)


@pytest.mark.parametrize("seed", [75, 77])
def test_two_cameras_are_not_believed_in_one_frame(seed: int) -> None:
    """They see an arm, or a motion between the arm's and the object's, which explains few of the matches at the centers."""
    take = draw("arm-across", seed)
    poses = [one.pose for one in track(list(islice(take.frames(), 4)), take.calibration, take.boxes, workers=1)]
    (truth, *_) = take.true_poses()
    errors, _ = compute_errors(take, poses, truth)
    is_localized = [pose.status in (FrameStatus.TRACKED, FrameStatus.RELOCALIZED) for pose in poses]
    assert not (np.array(is_localized) & (errors[:, 2:].max(axis=1) > 5.0)).any()  # standard deviations
    assert any(is_localized[1:])
