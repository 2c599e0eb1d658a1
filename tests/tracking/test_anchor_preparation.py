"""Background work: preparation of the next anchor, and joint refinement of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from threading import Event
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from sylpose.frames import FrameSet
from sylpose.geometry.future import BackgroundResult
from sylpose.tracking import anchor_preparation, window
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.joint_side.joint_state import RESULT_DELAY, JointState, SolvedFrame
from sylpose.tracking.search_clock import SearchClock
from sylpose.tracking.tracker import Tracker
from tests.clips import Clip, compute_pose_errors, frame_sets, make_rotated_pose, moving_scene
from tests.stored import dump_state, restore_state

FRAMES = 66


@pytest.fixture(scope="module")
def clip() -> Clip:
    """Rotation by 1.1 degrees per frame: two anchors are replaced."""
    return Clip.render(
        moving_scene(lambda k: make_rotated_pose(1.1 * k, np.array([2e-3, 0.0, 1e-3]) * k), FRAMES, n_cameras=3)
    )


def track_states(tracker: Tracker, frames: Sequence[FrameSet]) -> tuple[list[TrackedFrame], list[JointState]]:
    """Track the frames and return the state after each."""
    decided, known = [], []
    for frame in frames:
        decided += tracker.step(frame)
        known.append(tracker.copy_snapshot().state)
    return decided, known


@pytest.fixture(scope="module")
def tracked_and_states(clip: Clip) -> tuple[list[TrackedFrame], list[JointState]]:
    with Tracker(clip.rig, clip.boxes) as tracker:
        return track_states(tracker, clip.frames())


def test_next_anchor_joins_after_fixed_delay(tracked_and_states: tuple[list[TrackedFrame], list[JointState]]) -> None:
    joints, joined = tracked_and_states[1], 0
    for before, after in pairwise(joints):
        if (
            before.frames.next_anchor_number is not None
            and after.frames.next_anchor_number != before.frames.next_anchor_number
        ):
            assert after.frames.anchor is not None
            assert after.frames.anchor.frame.number == before.frames.next_anchor_number
            assert after.last.number == before.frames.next_anchor_number + RESULT_DELAY
            assert after.frames.anchor.age == RESULT_DELAY
            joined += 1
    assert joined >= 2
    # From then on no detection in the foreground is needed while the object is visible: no frame is its own anchor.
    first = next(k for k, joint in enumerate(joints) if joint.frames.next_anchor_number is not None)
    assert all(j.frames.anchor is not None and j.frames.anchor.frame.number < j.last.number for j in joints[first:])


def test_joint_refinement_runs_in_background(tracked_and_states: tuple[list[TrackedFrame], list[JointState]]) -> None:
    joints, finished = tracked_and_states[1], 0
    for before, after in pairwise(joints):
        if before.refinement.pending is not None and after.refinement.pending is not before.refinement.pending:
            assert after.last.number == before.refinement.pending.number + RESULT_DELAY
            finished += 1
    assert finished >= 1


def test_live_poses_do_not_wait_for_refinements(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of few frames are awaited; the next one, which takes long here, is applied once it is known."""
    go, refine = Event(), window.bundle_frames

    def refine_slowly(*arguments: Any) -> Any:
        assert len(arguments[2]) < 4 or go.wait(60.0)
        return refine(*arguments)

    monkeypatch.setattr(window, "bundle_frames", refine_slowly)
    with Tracker(clip.rig, clip.boxes, search_clock=SearchClock()) as tracker:
        states = track_states(tracker, clip.frames()[:9])[1]
        pending = states[-1].refinement.pending
        assert pending is not None
        assert pending.number < 8
        go.set()
        pending.result.value()
        (after,) = track_states(tracker, clip.frames()[9:10])[1]
    assert after.refinement.pending is not pending
    covariance, refined = (state.frames.by_number[pending.number].covariance for state in (states[-1], after))
    assert not np.allclose(covariance, refined, rtol=1e-3)


def test_background_work_keeps_accuracy(
    tracked_and_states: tuple[list[TrackedFrame], list[JointState]], clip: Clip
) -> None:
    error = compute_pose_errors(tracked_and_states[0], clip.truth)
    assert len(error) == FRAMES - 1
    assert 0.0 < np.median(error[:, 0]) < 0.15
    assert error[2:, 0].max() < 0.4  # the first motion is below the static threshold


@pytest.mark.slow
def test_landmarks_keep_their_numbers(clip: Clip) -> None:
    """Features detected again that match keyframes keep their landmarks: otherwise a reversed motion would drift."""
    images = clip.images[:28]
    with Tracker(clip.rig, clip.boxes) as tracker:
        decided, joints = track_states(tracker, frame_sets([*images, *images[::-1]]))
    assert any(joint.frames.next_anchor_number is not None for joint in joints)
    first, last = decided[0].pose.world_from_object, decided[-1].pose.world_from_object
    assert first is not None
    assert last is not None
    off = last * first.inv()
    assert np.degrees(off.rotation.magnitude()) < 0.2


@pytest.mark.slow
def test_camera_without_image_recovers(clip: Clip) -> None:
    with Tracker(clip.rig, clip.boxes) as tracker:
        decided, joints = track_states(tracker, clip.frames()[:8])
        hidden: list[int] = []
        for frame in clip.frames()[8:]:
            if hidden and frame.index > hidden[0] + 12:
                break
            images = frame.images
            if joints[-1].frames.next_anchor_number is None and not hidden:
                images = (None, *images[1:])  # until the next anchor's preparation starts, and in its frame
            elif not hidden:
                hidden.append(frame.index)
            decided += tracker.step(replace(frame, images=images))
            joints.append(tracker.copy_snapshot().state)
    assert hidden
    assert compute_pose_errors(decided, clip.truth)[2:, 0].max() < 0.5
    assert decided[-1].pose.inliers[0] > 20


def test_checkpoint_and_restore_give_equal_results(
    tracked_and_states: tuple[list[TrackedFrame], list[JointState]], clip: Clip
) -> None:
    plain, joints = tracked_and_states
    at = next(k for k, joint in enumerate(joints) if joint.frames.next_anchor_number is not None) + 2
    pending = next((k for k, joint in enumerate(joints) if joint.refinement.pending is not None), at) + 1
    stops, found = {at, pending}, []
    frames = clip.frames()[: max(stops) + 8]
    tracker = Tracker(clip.rig, clip.boxes)
    for k, frame in enumerate(frames):
        if k in stops:
            memory = tracker.copy_snapshot()
            tracker.step(replace(frame, images=frame.images[::-1]))
            tracker.restore(memory)
            data = dump_state(tracker)
            tracker.close()
            tracker = Tracker(clip.rig, clip.boxes)
            restore_state(tracker, data)
        found += tracker.step(frame)
    tracker.close()
    for one, other in zip(found, plain[: len(frames)], strict=True):
        assert one.pose.world_from_object is not None
        assert other.pose.world_from_object is not None
        a, b = one.pose.world_from_object.as_matrix(), other.pose.world_from_object.as_matrix()
        np.testing.assert_array_equal(a, b)


def test_camera_without_next_anchor_keeps_its_features(monkeypatch: pytest.MonkeyPatch) -> None:
    """It had no image of that frame: the frame itself becomes its anchor, with the features that it has."""
    monkeypatch.setattr(anchor_preparation, "create_anchor", lambda *arguments: arguments)
    camera = SimpleNamespace(next_anchor=None, frames={4: "features"}, anchor="previous")
    anchor_preparation._join_camera(
        cast(CameraTracker, camera), JointState(), cast(SolvedFrame, SimpleNamespace(number=4))
    )
    assert camera.anchor == (4, "features", None, None)
    assert camera.next_anchor is None


def raise_error(number: int) -> int:
    raise ValueError(f"no {number}")


def test_background_error_is_raised_on_access() -> None:
    with pytest.raises(ValueError, match="no 7"):
        BackgroundResult(raise_error, 7).value()


def test_background_task_starts_at_once_and_is_awaited() -> None:
    go = Event()
    waits = BackgroundResult(go.wait, 10.0)
    go.set()
    assert waits.value()
