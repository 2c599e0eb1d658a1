"""What is prepared beside the frames: the next anchor, and frames that are refined together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from threading import Event

import numpy as np
import pytest

from sylpose.frames import FrameSet
from sylpose.geometry.future import Later
from sylpose.tracking.anchor_preparation import LATER
from sylpose.tracking.joint_state import Joint
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import Tracker
from sylpose.tracking.window import LATER as REFINED_LATER
from tests.clips import Clip, errors, frame_sets, moving_scene, turned
from tests.stored import go_on, stored

FRAMES = 66


@pytest.fixture(scope="module")
def clip() -> Clip:
    """A turn by 1.1 degrees per frame: two anchors are outlived."""
    return Clip.render(moving_scene(lambda k: turned(1.1 * k, np.array([2e-3, 0.0, 1e-3]) * k), FRAMES, n_cameras=3))


def states(tracker: Tracker, frames: Sequence[FrameSet]) -> tuple[list[TrackedFrame], list[Joint]]:
    """The frames tracked, and what was known after each."""
    decided, known = [], []
    for frame in frames:
        decided += tracker.step(frame)
        known.append(tracker.remembered().joint)
    return decided, known


@pytest.fixture(scope="module")
def tracked(clip: Clip) -> tuple[list[TrackedFrame], list[Joint]]:
    with Tracker(clip.rig, clip.boxes) as tracker:
        return states(tracker, clip.frames())


def test_the_next_anchor_joins_a_fixed_number_of_frames_later(tracked: tuple[list[TrackedFrame], list[Joint]]) -> None:
    joints, joined = tracked[1], 0
    for before, after in pairwise(joints):
        if before.renewal is not None and after.renewal != before.renewal:
            assert after.anchor is not None
            assert after.anchor.frame.number == before.renewal
            assert after.base.number == before.renewal + LATER
            assert after.anchor.age == LATER
            joined += 1
    assert joined >= 2
    # From then on nothing is searched while the object is in sight: no frame is its own anchor.
    first = next(k for k, joint in enumerate(joints) if joint.renewal is not None)
    assert all(j.anchor is not None and j.anchor.frame.number < j.base.number for j in joints[first:])


def test_frames_are_refined_together_beside_the_next_ones(tracked: tuple[list[TrackedFrame], list[Joint]]) -> None:
    joints, finished = tracked[1], 0
    for before, after in pairwise(joints):
        if before.pending is not None and after.pending is not before.pending:
            assert after.base.number == before.pending.number + REFINED_LATER
            finished += 1
    assert finished >= 1


def test_it_is_as_good_as_if_all_were_done_at_once(tracked: tuple[list[TrackedFrame], list[Joint]], clip: Clip) -> None:
    error = errors(tracked[0], clip.truth)
    assert len(error) == FRAMES - 1
    assert 0.0 < np.median(error[:, 0]) < 0.15
    assert error[2:, 0].max() < 0.4  # at first it moves by less than what stands still may


def test_landmarks_go_on_under_their_numbers(clip: Clip) -> None:
    """What is found anew of what keyframes have seen is the same landmark: else a turn back would drift."""
    images = clip.images[:28]
    with Tracker(clip.rig, clip.boxes) as tracker:
        decided, joints = states(tracker, frame_sets([*images, *images[::-1]]))
    assert any(joint.renewal is not None for joint in joints)
    first, last = decided[0].pose.world_from_object, decided[-1].pose.world_from_object
    assert first is not None
    assert last is not None
    off = last * first.inv()
    assert np.degrees(off.rotation.magnitude()) < 0.2


def test_a_camera_that_saw_nothing_of_the_frame_is_looked_at_again(clip: Clip) -> None:
    with Tracker(clip.rig, clip.boxes) as tracker:
        decided, joints = states(tracker, clip.frames()[:8])
        hidden: list[int] = []
        for frame in clip.frames()[8:]:
            images = frame.images
            if joints[-1].renewal is None and not hidden:
                images = (None, *images[1:])  # until the next anchor begins, and in its own frame
            elif not hidden:
                hidden.append(frame.index)
            decided += tracker.step(replace(frame, images=images))
            joints.append(tracker.remembered().joint)
    assert hidden
    assert errors(decided, clip.truth)[2:, 0].max() < 0.5
    assert decided[-1].pose.inliers[0] > 20


def test_saved_and_loaded_or_gone_back_it_comes_to_the_same(
    tracked: tuple[list[TrackedFrame], list[Joint]], clip: Clip
) -> None:
    plain, joints = tracked
    frames = clip.frames()
    at = next(k for k, joint in enumerate(joints) if joint.renewal is not None) + 2
    pending = next((k for k, joint in enumerate(joints) if joint.pending is not None), at) + 1
    stops, found = {at, pending}, []
    tracker = Tracker(clip.rig, clip.boxes)
    for k, frame in enumerate(frames):
        if k in stops:
            memory = tracker.remembered()
            tracker.step(replace(frame, images=frame.images[::-1]))
            tracker.go_back(memory)
            data = stored(tracker)
            tracker.close()
            tracker = Tracker(clip.rig, clip.boxes)
            go_on(tracker, data)
        found += tracker.step(frame)
    tracker.close()
    for one, other in zip(found, plain, strict=True):
        assert one.pose.world_from_object is not None
        assert other.pose.world_from_object is not None
        a, b = one.pose.world_from_object.as_matrix(), other.pose.world_from_object.as_matrix()
        np.testing.assert_array_equal(a, b)


def broken(number: int) -> int:
    raise ValueError(f"no {number}")


def test_what_is_computed_later_raises_when_it_is_asked_for() -> None:
    with pytest.raises(ValueError, match="no 7"):
        Later(broken, 7).value()


def test_what_is_computed_later_is_begun_at_once_and_waited_for() -> None:
    go = Event()
    waits = Later(go.wait, 10.0)
    go.set()
    assert waits.value()
