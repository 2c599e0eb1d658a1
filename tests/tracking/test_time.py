"""The tracker over time: time offsets between cameras, a full rotation, landmark numbers, checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.simulate import Actor, Scene, compute_demo_truth, render_frames
from sylpose.simulate.render import Path
from sylpose.status import FrameStatus
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.tracker import Tracker, track
from tests.clips import (
    HALF_DEGREE,
    RATE,
    Clip,
    assert_valid,
    compute_pose_errors,
    make_rotated_pose,
    moving_scene,
    statuses,
    surface_points,
    track_turning_clip,
    turning_clip,
)
from tests.stored import dump_state, restore_state

# Time offsets of the cameras, frames: their mean is 0.
SKEW = (-0.4, 0.1, 0.5, -0.2)
# Number of frames with them.
N_SKEWED = 12


def swinging_path(frame: float) -> RigidTransform:
    """Up to 10 degrees and 20 mm per frame, at a continuously changing velocity."""
    s = 2 * np.pi * frame / 48
    return make_rotated_pose(40 * np.sin(s), 0.08 * np.array([np.cos(s), 0.2 * np.sin(2 * s), 0.5 * np.sin(s)]))


def skew_cameras(scene: Scene, skew: Sequence[float]) -> Clip:
    """The scene seen by cameras with time offsets, in frames."""
    actor = scene.actors[0]
    alone = []
    for k, (name, late) in enumerate(zip(scene.rig.names, skew, strict=True)):

        def path(frame: float, late: float = late) -> RigidTransform:
            return actor.path(frame + late)

        # A different seed for each: the first camera of a rig gets the first room.
        one = replace(scene, rig=scene.rig.subset([name]), actors=(Actor(actor.body, path),), seed=100 + k)
        alone.append([image for (image,) in render_frames(one)])
    return Clip(scene.rig, compute_demo_truth(scene), list(zip(*alone, strict=True)))


def stamp_times(clip: Clip, skew: Sequence[float]) -> list[FrameSet]:
    n = len(clip.rig)
    return [
        FrameSet(k, k / RATE, tuple((k + late) / RATE for late in skew), images, (None,) * n)
        for k, images in enumerate(clip.images)
    ]


@pytest.fixture(scope="module")
def skewed_clip() -> Clip:
    return skew_cameras(moving_scene(swinging_path, N_SKEWED), SKEW)


@pytest.fixture(scope="module")
def tracked_clip(skewed_clip: Clip) -> list[TrackedFrame]:
    return list(track(stamp_times(skewed_clip, SKEW), skewed_clip.rig, skewed_clip.boxes))


def test_time_stamps_are_used_by_tracker(skewed_clip: Clip, tracked_clip: list[TrackedFrame]) -> None:
    untold = list(track(skewed_clip.frames(), skewed_clip.rig, skewed_clip.boxes))
    assert statuses(tracked_clip) == statuses(untold) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (N_SKEWED - 1)
    one, other = compute_pose_errors(tracked_clip, skewed_clip.truth), compute_pose_errors(untold, skewed_clip.truth)
    assert (one.max(axis=0) < other.max(axis=0) / 3).all()
    assert (np.median(one, axis=0) < np.median(other, axis=0) / 3).all()
    assert one[:, 0].max() < 0.8
    np.testing.assert_allclose(tracked_clip[3].time_offsets, np.array(SKEW) / RATE, atol=1e-12)
    assert_valid(tracked_clip)


@pytest.mark.slow
def test_offsets_do_what_time_stamps_do(skewed_clip: Clip, tracked_clip: list[TrackedFrame]) -> None:
    offsets = dict(zip(skewed_clip.rig.names, np.array(SKEW) / RATE, strict=True))
    found = list(track(skewed_clip.frames(), skewed_clip.rig, skewed_clip.boxes, offsets=offsets))
    np.testing.assert_allclose(
        compute_pose_errors(found, skewed_clip.truth), compute_pose_errors(tracked_clip, skewed_clip.truth), atol=0.05
    )
    # Offsets are added to time stamps, and correct wrong ones.
    wrong = [2 * s for s in SKEW]
    back = {name: -offset for name, offset in offsets.items()}
    again = list(track(stamp_times(skewed_clip, wrong)[:4], skewed_clip.rig, skewed_clip.boxes, offsets=back))
    np.testing.assert_allclose(again[3].time_offsets, tracked_clip[3].time_offsets, atol=1e-12)
    np.testing.assert_allclose(
        compute_pose_errors(again, skewed_clip.truth),
        compute_pose_errors(tracked_clip[:4], skewed_clip.truth),
        atol=0.05,
    )


def test_equal_time_stamps_need_no_correction() -> None:
    clip, plain = turning_clip(), track_turning_clip(True)
    same = list(track(stamp_times(clip, [0.0] * len(clip.rig))[:4], clip.rig, clip.boxes))
    for a, b in zip(plain[:4], same, strict=True):
        assert a.pose.world_from_object is not None
        assert b.pose.world_from_object is not None
        np.testing.assert_array_equal(a.pose.world_from_object.as_matrix(), b.pose.world_from_object.as_matrix())
    # A camera without a time stamp has the frame's time.
    unknown = [replace(f, times=(None,) * len(clip.rig)) for f in clip.frames()[:4]]
    assert not any(f.time_offsets.any() for f in track(unknown, clip.rig, clip.boxes))


# --- a full rotation


def make_circle(frames: int) -> Path:
    """A rotation by 360 degrees, once around a small loop in space."""

    def path(frame: float) -> RigidTransform:
        s = 2 * np.pi * frame / frames
        return make_rotated_pose(np.degrees(s), 0.06 * np.array([np.sin(s), 0.3 * np.sin(2 * s), np.cos(s) - 1]))

    return path


@pytest.fixture(scope="module")
def loop_clip() -> Clip:
    return Clip.render(moving_scene(make_circle(48), 52, n_cameras=3))


@pytest.fixture(scope="module", params=["klt", pytest.param("sift", marks=pytest.mark.slow)])
def tracked_loop(loop_clip: Clip, request: pytest.FixtureRequest) -> list[TrackedFrame]:
    return list(track(loop_clip.frames(), loop_clip.rig, loop_clip.boxes, features=request.param))


@pytest.mark.slow
def test_loop_closure(loop_clip: Clip, tracked_loop: list[TrackedFrame]) -> None:
    assert statuses(tracked_loop) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 51
    error = compute_pose_errors(tracked_loop, loop_clip.truth)
    assert error[:, 0].max() < 1
    middle, end = error[20:36], error[-4:]
    # Over many loops (benchmarks/loops.py) the end is as good as the middle; in a single one it is half the time.
    assert (np.median(end, axis=0) <= 1.5 * middle.max(axis=0)).all()
    assert np.median(end[:, 0]) < HALF_DEGREE
    assert_valid(tracked_loop)


# --- landmark observations


@pytest.mark.slow
def test_landmark_number_is_one_point_on_object(loop_clip: Clip, tracked_loop: list[TrackedFrame]) -> None:
    """True rays of observations with the same number meet the true object at the same point."""
    first = tracked_loop[0].pose.world_from_object
    assert first is not None
    # The tracker's object frame and the true one differ in the position of the center.
    offset = first.translation - loop_clip.truth.world_from_object[0].translation
    for c, camera in enumerate(loop_clip.rig):
        seen: dict[int, FloatArray] = {}
        gaps, places, counts = [], [], 0
        for f in tracked_loop:
            sightings = f.observations[c]
            assert sightings.landmark_ids.shape == (len(sightings.normalized),) == (len(sightings.positions),)
            pose = loop_clip.truth.world_from_object[f.pose.index]
            points = surface_points(camera, sightings.normalized, pose, loop_clip.truth.vertices)
            _, count = np.unique(sightings.landmark_ids, return_counts=True)
            counts += int((count > 1).sum())
            for number, point, place in zip(sightings.landmark_ids.tolist(), points, sightings.positions, strict=True):
                if number in seen:
                    gaps.append(np.linalg.norm(point - seen[number]))
                    places.append(np.linalg.norm(place + offset - point))
                seen.setdefault(number, point)
        gap, place_error = np.array(gaps), np.array(places)
        on_it = np.isfinite(gap)
        assert on_it.sum() > 1000
        # A pixel is 3 mm.
        assert np.median(gap[on_it]) < 2e-3
        assert np.quantile(gap[on_it], 0.95) < 10e-3
        assert np.median(place_error[on_it]) < 6e-3
        assert counts < 0.005 * len(gaps)


# --- checkpoints


@pytest.mark.parametrize(
    ("with_boxes", "cut"),
    [
        (True, 4),
        *(
            pytest.param(*other, marks=pytest.mark.slow)
            for other in ((False, 0), (True, 0), (True, 1), (True, 6), (False, 1), (False, 4), (False, 6))
        ),
    ],
)
def test_tracker_continues_from_checkpoint(cut: int, with_boxes: bool) -> None:
    clip, whole = turning_clip(), track_turning_clip(with_boxes)
    frames, boxes = clip.frames(), clip.boxes if with_boxes else None
    with Tracker(clip.rig, boxes) as tracker:
        decided = [f for frame in frames[:cut] for f in tracker.step(frame)]
        data = dump_state(tracker)
        tracker.step(frames[cut])  # later frames do not change the snapshot
    with Tracker(clip.rig, boxes) as again:
        restore_state(again, data)
        decided += [f for frame in frames[cut:] for f in again.step(frame)]
        decided += again.flush()
    assert statuses(decided) == statuses(whole)
    for a, b in zip(decided, whole, strict=True):
        if a.pose.world_from_object is None or b.pose.world_from_object is None:
            continue
        np.testing.assert_array_equal(a.pose.world_from_object.as_matrix(), b.pose.world_from_object.as_matrix())
        np.testing.assert_array_equal(a.pose.covariance, b.pose.covariance)
        for one, other in zip(a.observations, b.observations, strict=True):
            np.testing.assert_array_equal(one.landmark_ids, other.landmark_ids)
