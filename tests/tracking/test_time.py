"""The tracker over time: cameras that are exposed at different instants, a whole turn, landmarks' numbers, checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.results import FrameStatus
from sylpose.simulate import Actor, Scene, demo_truth, render_frames
from sylpose.simulate.render import Path
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import Tracker, track
from tests.clips import (
    HALF_DEGREE,
    RATE,
    Clip,
    assert_valid,
    errors,
    moving_scene,
    statuses,
    surface_points,
    tracked_turning,
    turned,
    turning_clip,
)
from tests.stored import go_on, stored

# By how much the cameras are exposed late, frames: their mean is 0.
SKEW = (-0.4, 0.1, 0.5, -0.2)


def swinging(frame: float) -> RigidTransform:
    """Up to 10 degrees and 20 mm per frame, at a speed that changes all the time."""
    s = 2 * np.pi * frame / 48
    return turned(40 * np.sin(s), 0.08 * np.array([np.cos(s), 0.2 * np.sin(2 * s), 0.5 * np.sin(s)]))


def skewed(scene: Scene, skew: Sequence[float]) -> Clip:
    """The scene as cameras see it that are exposed so many frames late each."""
    actor = scene.actors[0]
    alone = []
    for k, (name, late) in enumerate(zip(scene.rig.names, skew, strict=True)):

        def path(frame: float, late: float = late) -> RigidTransform:
            return actor.path(frame + late)

        # Another seed each: a rig's first camera has the first room.
        one = replace(scene, rig=scene.rig.subset([name]), actors=(Actor(actor.body, path),), seed=100 + k)
        alone.append([image for (image,) in render_frames(one)])
    return Clip(scene.rig, demo_truth(scene), list(zip(*alone, strict=True)))


def stamped(clip: Clip, skew: Sequence[float]) -> list[FrameSet]:
    n = len(clip.rig)
    return [
        FrameSet(k, k / RATE, tuple((k + late) / RATE for late in skew), images, (None,) * n)
        for k, images in enumerate(clip.images)
    ]


@pytest.fixture(scope="module")
def late() -> Clip:
    return skewed(moving_scene(swinging, 20), SKEW)


@pytest.fixture(scope="module")
def told(late: Clip) -> list[TrackedFrame]:
    return list(track(stamped(late, SKEW), late.rig, late.boxes))


def test_time_stamps_are_used(late: Clip, told: list[TrackedFrame]) -> None:
    untold = list(track(late.frames(), late.rig, late.boxes))
    assert statuses(told) == statuses(untold) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 19
    one, other = errors(told, late.truth), errors(untold, late.truth)
    assert (one.max(axis=0) < other.max(axis=0) / 3).all()
    assert (np.median(one, axis=0) < np.median(other, axis=0) / 3).all()
    assert one[:, 0].max() < 0.8
    np.testing.assert_allclose(told[3].late, np.array(SKEW) / RATE, atol=1e-12)
    assert_valid(told)


def test_offsets_do_what_time_stamps_do(late: Clip, told: list[TrackedFrame]) -> None:
    offsets = dict(zip(late.rig.names, np.array(SKEW) / RATE, strict=True))
    found = list(track(late.frames(), late.rig, late.boxes, offsets=offsets))
    np.testing.assert_allclose(errors(found, late.truth), errors(told, late.truth), atol=0.05)
    # They come on top of stamps, and correct wrong ones.
    wrong = [2 * s for s in SKEW]
    back = {name: -offset for name, offset in offsets.items()}
    again = list(track(stamped(late, wrong), late.rig, late.boxes, offsets=back))
    np.testing.assert_allclose(errors(again, late.truth), errors(told, late.truth), atol=0.05)


def test_cameras_at_the_same_instant_need_no_correction() -> None:
    clip, plain = turning_clip(), tracked_turning(True)
    same = list(track(stamped(clip, [0.0] * len(clip.rig)), clip.rig, clip.boxes))
    for a, b in zip(plain, same, strict=True):
        assert a.pose.world_from_object is not None
        assert b.pose.world_from_object is not None
        np.testing.assert_array_equal(a.pose.world_from_object.as_matrix(), b.pose.world_from_object.as_matrix())
    # A camera without a time stamp was there at the instant's time.
    unknown = [replace(f, times=(None,) * len(clip.rig)) for f in clip.frames()]
    assert not any(f.late.any() for f in track(unknown, clip.rig, clip.boxes))


# --- a whole turn


def circle(frames: int) -> Path:
    """A turn by 360 degrees, once around a small loop in space."""

    def path(frame: float) -> RigidTransform:
        s = 2 * np.pi * frame / frames
        return turned(np.degrees(s), 0.06 * np.array([np.sin(s), 0.3 * np.sin(2 * s), np.cos(s) - 1]))

    return path


@pytest.fixture(scope="module")
def loop() -> Clip:
    return Clip.render(moving_scene(circle(48), 52))


@pytest.fixture(scope="module", params=["klt", pytest.param("sift", marks=pytest.mark.slow)])
def around(loop: Clip, request: pytest.FixtureRequest) -> list[TrackedFrame]:
    return list(track(loop.frames(), loop.rig, loop.boxes, features=request.param))


def test_a_loop_is_closed(loop: Clip, around: list[TrackedFrame]) -> None:
    assert statuses(around) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 51
    error = errors(around, loop.truth)
    assert error[:, 0].max() < 1
    middle, end = error[20:36], error[-4:]
    # Over many loops (benchmarks/loops.py) the end is as good as the middle; of one, chance is a half.
    assert (np.median(end, axis=0) <= 1.5 * middle.max(axis=0)).all()
    assert np.median(end[:, 0]) < HALF_DEGREE
    assert_valid(around)


# --- what is seen of the object


def test_a_landmarks_number_is_one_place_on_the_object(loop: Clip, around: list[TrackedFrame]) -> None:
    """Where true rays of sightings with the same number meet the true object is the same place."""
    first = around[0].pose.world_from_object
    assert first is not None
    # The tracker's frame of the object and the truth's differ by where they take the centre to be.
    offset = first.translation - loop.truth.world_from_object[0].translation
    for c, camera in enumerate(loop.rig):
        seen: dict[int, FloatArray] = {}
        gaps, places, counts = [], [], 0
        for f in around:
            sightings = f.sightings[c]
            assert sightings.landmark.shape == (len(sightings.normalized),) == (len(sightings.place),)
            pose = loop.truth.world_from_object[f.pose.index]
            points = surface_points(camera, sightings.normalized, pose, loop.truth.vertices)
            _, count = np.unique(sightings.landmark, return_counts=True)
            counts += int((count > 1).sum())
            for number, point, place in zip(sightings.landmark.tolist(), points, sightings.place, strict=True):
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
        *((True, 1), (True, 4), (False, 0), (False, 6)),
        *(pytest.param(*other, marks=pytest.mark.slow) for other in ((True, 0), (True, 6), (False, 1), (False, 4))),
    ],
)
def test_a_tracker_goes_on_from_a_checkpoint(cut: int, with_boxes: bool) -> None:
    clip, whole = turning_clip(), tracked_turning(with_boxes)
    frames, boxes = clip.frames(), clip.boxes if with_boxes else None
    with Tracker(clip.rig, boxes) as tracker:
        decided = [f for frame in frames[:cut] for f in tracker.step(frame)]
        data = stored(tracker)
        tracker.step(frames[cut])  # what comes after it changes nothing
    with Tracker(clip.rig, boxes) as again:
        go_on(again, data)
        decided += [f for frame in frames[cut:] for f in again.step(frame)]
        decided += again.flush()
    assert statuses(decided) == statuses(whole)
    for a, b in zip(decided, whole, strict=True):
        if a.pose.world_from_object is None or b.pose.world_from_object is None:
            continue
        np.testing.assert_array_equal(a.pose.world_from_object.as_matrix(), b.pose.world_from_object.as_matrix())
        np.testing.assert_array_equal(a.pose.covariance, b.pose.covariance)
        for one, other in zip(a.sightings, b.sightings, strict=True):
            np.testing.assert_array_equal(one.landmark, other.landmark)
