"""Nodes that see their own images alone come to the poses of one process, all alike; and go on where one of them dies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.kinds_scenes import turned
from sylpose.network.node import Node
from sylpose.network.simulated import Outcome, track_by_nodes
from sylpose.paper.distributed.simulated import Disturbances
from sylpose.results import FrameStatus
from sylpose.simulate import demo_scene
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import track
from tests.clips import SIZE, Clip, errors

FRAMES = 8


@pytest.fixture(scope="module")
def clip() -> Clip:
    return Clip.render(demo_scene(frames=FRAMES, turn_deg=25, size=SIZE, n_cameras=3, seed=2))


def assert_same(found: Sequence[TrackedFrame], wanted: Sequence[TrackedFrame], apart: float = 0.0) -> None:
    """Up to rounding, against one process: products of matrices depend on how their arrays lie in memory, and what was
    sent lies elsewhere."""
    assert [f.pose.status for f in found] == [f.pose.status for f in wanted]
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a.pose.covariance, b.pose.covariance, rtol=1e5 * apart, atol=0)
        np.testing.assert_array_equal(a.pose.inliers, b.pose.inliers)
        if b.pose.world_from_object is not None:
            assert a.pose.world_from_object is not None
            one, other = a.pose.world_from_object.as_matrix(), b.pose.world_from_object.as_matrix()
            np.testing.assert_allclose(one, other, rtol=0, atol=apart)


def assert_agreed(outcome: Outcome, cameras: Sequence[int]) -> None:
    """All of some cameras say the same of every frame, to the bit."""
    first, *others = (outcome.frames[c] for c in cameras)
    for other in others:
        assert_same(other, first)


@pytest.mark.parametrize(
    ("method", "with_boxes", "disturbances"),
    [
        ("landmarks", True, Disturbances()),
        ("landmarks", True, Disturbances(loss=0.1, delay=2, seed=4)),
        ("landmarks", False, Disturbances(loss=0.3, seed=5)),
        ("epipolar", True, Disturbances()),
        ("sylvester", False, Disturbances()),
    ],
)
def test_nodes_have_the_poses_of_one_process(
    clip: Clip, method: str, with_boxes: bool, disturbances: Disturbances
) -> None:
    frames, boxes = clip.frames(), clip.boxes if with_boxes else None
    # One camera sees nothing for a while; then nobody does, and the object has to be found again.
    frames[3] = replace(frames[3], images=(frames[3].images[0], None, frames[3].images[2]))
    frames[5] = replace(frames[5], images=(None, None, None))
    expected = list(track(frames, clip.rig, boxes, method=method))
    assert sum(f.pose.measured for f in expected) >= FRAMES - 2
    outcome = track_by_nodes(frames, clip.rig, boxes, disturbances=disturbances, method=method)
    assert outcome.members == [(0, 1, 2)] * 3
    assert_same(outcome.frames[0], expected, 1e-11)
    assert_agreed(outcome, range(3))
    assert outcome.refused == [{}] * 3
    for c, found in enumerate(outcome.frames):
        for mine, wanted in zip(found, expected, strict=True):
            assert mine.radius == pytest.approx(wanted.radius, rel=1e-9, nan_ok=True)
            # What stays with the camera is the same as well.
            if wanted.sightings:
                np.testing.assert_array_equal(mine.sightings[c].landmark, wanted.sightings[c].landmark)
                np.testing.assert_allclose(mine.sightings[c].place, wanted.sightings[c].place, rtol=0, atol=1e-9)
    for told in outcome.told:
        # Without boxes the first motion takes all matches, once.
        assert sum(told) / FRAMES < 50_000
        if method == "landmarks":
            # A round of the alignment, which is what most rounds are; 8 bytes of header.
            assert np.median(told) <= 248


def test_a_nudged_camera_tells_the_others(clip: Clip) -> None:
    """That it was, and by how much: its images it turns back alone."""
    frames = clip.frames()
    for k in range(4, FRAMES):
        seen = list(clip.images[k])
        seen[1] = turned(seen[1], clip.rig.cameras[1], np.radians([0.8, -1.2, 0.5]))
        frames[k] = replace(frames[k], images=tuple(seen))
    expected = list(track(frames, clip.rig, clip.boxes))
    (said,) = expected[-1].pose.faults
    assert said == "camera cam_1 was nudged at frame 4: the background turned by 1.5 degrees"
    outcome = track_by_nodes(frames, clip.rig, clip.boxes)
    assert_same(outcome.frames[0], expected, 1e-11)
    assert_agreed(outcome, range(3))
    for found in outcome.frames:
        assert [f.pose.faults for f in found] == [f.pose.faults for f in expected]


def test_known_depths_are_sent_too(clip: Clip) -> None:
    """Products of matrices round by how arrays lie in memory, and a landmark at a threshold makes more of it."""
    expected = list(track(clip.frames(), clip.rig, clip.boxes, method="known-depth"))
    outcome = track_by_nodes(clip.frames(), clip.rig, clip.boxes, method="known-depth")
    assert_agreed(outcome, range(3))
    for found, wanted in zip(outcome.frames[0], expected, strict=True):
        a, b = found.pose.world_from_object, wanted.pose.world_from_object
        assert a is not None
        assert b is not None
        np.testing.assert_allclose(a.as_matrix(), b.as_matrix(), atol=1e-3)


def test_a_camera_that_sees_nothing_has_the_pose_too(clip: Clip) -> None:
    """The paper's promise: an estimate at each camera, also when the features are not visible to it."""
    blind = [replace(f, images=(f.images[0], None, f.images[2])) for f in clip.frames()]
    outcome = track_by_nodes(blind, clip.rig, clip.boxes)
    assert sum(f.pose.measured for f in outcome.frames[1]) == len(blind)
    assert not any(f.pose.inliers[1] for f in outcome.frames[1])
    assert_agreed(outcome, range(3))


@pytest.mark.parametrize("dies", [60, 180])
def test_the_others_go_on_without_a_node_that_dies(clip: Clip, dies: int) -> None:
    expected = list(track(clip.frames(), clip.rig, clip.boxes))
    outcome = track_by_nodes(clip.frames(), clip.rig, clip.boxes, disturbances=Disturbances(dies={1: dies}))
    assert outcome.members[0] == outcome.members[2] == (0, 2)
    assert_agreed(outcome, [0, 2])
    of_dead = outcome.frames[1]
    assert 0 < len(of_dead) < FRAMES
    # What it said until then is what all said.
    assert_same(of_dead, expected[: len(of_dead)], 1e-11)
    found = outcome.frames[0]
    assert len(found) == FRAMES
    assert {f.pose.status for f in found[1:]} == {FrameStatus.TRACKED}
    assert not found[-1].pose.inliers[1]
    assert errors(found, clip.truth)[:, 0].max() < 0.5


def test_a_recording_without_frames_is_none(clip: Clip) -> None:
    outcome = track_by_nodes([], clip.rig, clip.boxes)
    assert outcome.frames == [[], [], []]
    assert not outcome.sent.any()


def test_a_node_takes_what_means_nothing_for_nothing_and_names_who_said_it() -> None:
    node = Node(0, 3, lambda own: {0: own, 1: b"\xc1 nonsense"})
    assert node.ask(lambda c: 5 + c, 0) == [5, 0, 0]
    assert list(node.refused) == [1]
    assert node.refused[1].startswith("no message")


def test_what_is_not_simulated_is_refused(clip: Clip) -> None:
    with pytest.raises(ValueError, match="join late or tell nonsense are not simulated"):
        track_by_nodes(clip.frames(), clip.rig, disturbances=Disturbances(joins={1: 4}))


def test_an_error_of_a_node_is_the_callers(clip: Clip) -> None:
    with pytest.raises(ValueError, match="no camera 'other'"):
        track_by_nodes(clip.frames(), clip.rig, {"other": next(iter(clip.boxes.values()))})
