"""Nodes with only their own images agree with each other and with one process, and tolerate crashes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.kinds_scenes import rotate_view
from benchmarks.nodes import compare_runs
from sylpose.geometry.arrays import FloatArray
from sylpose.methods import MODES
from sylpose.network import simulation
from sylpose.network.membership import ExchangeRequest, ExchangeResult, Request
from sylpose.network.node import Node
from sylpose.network.rounds import DEFAULT_TIMEOUTS
from sylpose.network.simulation import NodesTracker, SimulationResult, track_by_nodes
from sylpose.network.smoothing import _unpack_observations
from sylpose.network.wire_format import HEADER, Hello, encode_hello
from sylpose.packets import Inbox, NetworkFaults, Packet
from sylpose.simulate import make_demo_scene
from sylpose.smoothing import Track, smooth_tracks
from sylpose.status import FrameStatus, Status
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.reports import CameraObservations
from sylpose.tracking.tracker import track
from tests.clips import SIZE, Clip, compute_pose_errors
from tests.network.byzantine_faults import FaultKind, make_fault
from tests.tracking.test_fallback_search import LOW_CONTRAST, make_jumping_clip

FRAMES = 8


@pytest.fixture(scope="module")
def clip() -> Clip:
    return Clip.render(make_demo_scene(frames=FRAMES, angle_deg=25, size=SIZE, n_cameras=3, seed=2))


@pytest.fixture(scope="module")
def by_one(clip: Clip) -> list[TrackedFrame]:
    """The clip tracked in one process, with boxes."""
    return list(track(clip.frames(), clip.rig, clip.boxes))


@pytest.fixture(scope="module")
def by_nodes(clip: Clip) -> SimulationResult:
    return track_by_nodes(clip.frames(), clip.rig, clip.boxes)


def assert_same(found: Sequence[TrackedFrame], wanted: Sequence[TrackedFrame], apart: float = 0.0) -> None:
    """Compare with one process up to rounding, since matrix products depend on the memory layout."""
    assert [f.pose.status for f in found] == [f.pose.status for f in wanted]
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a.pose.covariance, b.pose.covariance, rtol=1e4 * apart, atol=0)
        np.testing.assert_array_equal(a.pose.inliers, b.pose.inliers)
        if b.pose.world_from_object is not None:
            assert a.pose.world_from_object is not None
            one, other = a.pose.world_from_object.as_matrix(), b.pose.world_from_object.as_matrix()
            np.testing.assert_allclose(one, other, rtol=0, atol=apart)


def assert_agreed(outcome: SimulationResult, cameras: Sequence[int]) -> None:
    """Check that the given cameras agree on every frame to the bit."""
    first, *others = (outcome.frames[c] for c in cameras)
    for other in others:
        assert_same(other, first)


@pytest.mark.parametrize(
    ("method", "with_boxes", "network_faults"),
    [
        pytest.param("landmarks", True, NetworkFaults(), marks=pytest.mark.slow),
        ("landmarks", True, NetworkFaults(loss=0.1, delay=2, seed=4)),
        pytest.param("landmarks", False, NetworkFaults(loss=0.3, seed=5), marks=pytest.mark.slow),
        pytest.param("epipolar", True, NetworkFaults(), marks=pytest.mark.slow),
        pytest.param("sylvester", False, NetworkFaults(), marks=pytest.mark.slow),
    ],
)
def test_nodes_reproduce_single_process_poses(
    clip: Clip, method: str, with_boxes: bool, network_faults: NetworkFaults
) -> None:
    frames, boxes = clip.frames(), clip.boxes if with_boxes else None
    # One camera is blind for a while; then all are, and the object must be relocalized.
    frames[3] = replace(frames[3], images=(frames[3].images[0], None, frames[3].images[2]))
    frames[5] = replace(frames[5], images=(None, None, None))
    expected = list(track(frames, clip.rig, boxes, method=method))
    assert sum(f.pose.is_measured for f in expected) >= FRAMES - 2
    outcome = track_by_nodes(frames, clip.rig, boxes, network_faults=network_faults, method=method)
    assert outcome.members == [(0, 1, 2)] * 3
    # Rounding depends on the processor: 2e-10 on some.
    assert_same(outcome.frames[0], expected, 1e-9)
    assert_agreed(outcome, range(3))
    assert outcome.refused == [{}] * 3
    for c, found in enumerate(outcome.frames):
        for mine, wanted in zip(found, expected, strict=True):
            assert mine.radius == pytest.approx(wanted.radius, rel=1e-9, nan_ok=True)
            # The local results of each camera agree as well.
            if wanted.observations:
                np.testing.assert_array_equal(mine.observations[c].landmark_ids, wanted.observations[c].landmark_ids)
                np.testing.assert_allclose(
                    mine.observations[c].positions, wanted.observations[c].positions, rtol=0, atol=1e-9
                )
    for reported in outcome.payload_sizes:
        # Without boxes the first motion needs all matches, once.
        assert sum(reported) / FRAMES < 50_000
        if method == "landmarks":
            # An alignment round, the most frequent kind; and the header.
            assert np.median(reported) + HEADER.size <= 256


@pytest.mark.slow
def test_all_nodes_request_faint_features() -> None:
    """With a low-contrast object, all nodes agree that it is feature-poor."""
    clip = make_jumping_clip(12.0, LOW_CONTRAST)
    frames = clip.frames()
    expected = list(track(frames, clip.rig, clip.boxes, features="sift"))
    assert sum(f.pose.is_measured for f in expected) >= len(frames) - 1
    outcome = track_by_nodes(frames, clip.rig, clip.boxes, features="sift")
    assert_same(outcome.frames[0], expected, 1e-10)
    assert_agreed(outcome, range(len(clip.rig)))
    assert outcome.refused == [{}] * len(clip.rig)


@pytest.mark.slow
def test_camera_motion_is_shared(clip: Clip) -> None:
    """It reports its rotation, and rectifies its images itself."""
    frames = clip.frames()
    for k in range(4, FRAMES):
        seen = list(clip.images[k])
        seen[1] = rotate_view(seen[1], clip.rig.cameras[1], np.radians([0.8, -1.2, 0.5]))
        frames[k] = replace(frames[k], images=tuple(seen))
    expected = list(track(frames, clip.rig, clip.boxes))
    (message,) = expected[-1].pose.faults
    assert message == "camera cam_1 was nudged at frame 4: the background turned by 1.5 degrees"
    outcome = track_by_nodes(frames, clip.rig, clip.boxes)
    assert_same(outcome.frames[0], expected, 1e-10)
    assert_agreed(outcome, range(3))
    for found in outcome.frames:
        assert [f.pose.faults for f in found] == [f.pose.faults for f in expected]


@pytest.mark.slow
def test_known_depths_are_shared(clip: Clip) -> None:
    """Matrix products depend on the memory layout, which landmarks at a threshold amplify."""
    expected = list(track(clip.frames(), clip.rig, clip.boxes, method="known-depth"))
    outcome = track_by_nodes(clip.frames(), clip.rig, clip.boxes, method="known-depth")
    assert_agreed(outcome, range(3))
    for found, wanted in zip(outcome.frames[0], expected, strict=True):
        a, b = found.pose.world_from_object, wanted.pose.world_from_object
        assert a is not None
        assert b is not None
        np.testing.assert_allclose(a.as_matrix(), b.as_matrix(), atol=1e-3)


def test_blind_camera_has_the_pose(clip: Clip) -> None:
    """The paper's promise: an estimate at each camera, even if the features are not visible to it."""
    blind = [replace(f, images=(f.images[0], None, f.images[2])) for f in clip.frames()[:5]]
    outcome = track_by_nodes(blind, clip.rig, clip.boxes)
    assert sum(f.pose.is_measured for f in outcome.frames[1]) == len(blind)
    assert not any(f.pose.inliers[1] for f in outcome.frames[1])
    assert_agreed(outcome, range(3))


@pytest.mark.parametrize("dies", [pytest.param(60, marks=pytest.mark.slow), 180])
def test_others_continue_after_node_crash(clip: Clip, by_one: list[TrackedFrame], dies: int) -> None:
    outcome = track_by_nodes(clip.frames(), clip.rig, clip.boxes, network_faults=NetworkFaults(dies={1: dies}))
    assert outcome.members[0] == outcome.members[2] == (0, 2)
    assert_agreed(outcome, [0, 2])
    of_dead = outcome.frames[1]
    assert 0 < len(of_dead) < FRAMES
    # Until then it agrees with all others.
    assert_same(of_dead, by_one[: len(of_dead)], 1e-11)
    found = outcome.frames[0]
    assert len(found) == FRAMES
    assert {f.pose.status for f in found[1:]} == {FrameStatus.TRACKED}
    assert not found[-1].pose.inliers[1]
    assert compute_pose_errors(found, clip.truth)[:, 0].max() < 0.5


def assert_common_frames_equal(outcome: SimulationResult) -> None:
    """Check that all nodes that report a frame agree on it to the bit."""
    message: dict[int, TrackedFrame] = {}
    for found in outcome.frames:
        for tracked in found:
            assert_same([tracked], [message.setdefault(tracked.pose.index, tracked)])


def is_accurate(found: Sequence[TrackedFrame], clip: Clip, worst: float) -> bool:
    return bool(compute_pose_errors(found, clip.truth)[:, 0].max() < worst)


@pytest.mark.parametrize(
    "network_faults",
    [
        pytest.param(NetworkFaults(joins={2: 60}), marks=pytest.mark.slow),
        pytest.param(NetworkFaults(joins={0: 100}, loss=0.2, delay=2, seed=3), marks=pytest.mark.slow),
        # As test_real.py::test_killed_node_rejoins.
        pytest.param(NetworkFaults(dies={1: 60}, returns={1: 110}), marks=pytest.mark.slow),
        pytest.param(NetworkFaults(dies={0: 70}, returns={0: 75}), marks=pytest.mark.slow),
        pytest.param(NetworkFaults(partition=(60, 140, frozenset({1}))), marks=pytest.mark.slow),
        NetworkFaults(partition=(60, 140, frozenset({0, 1})), loss=0.1, seed=6),
    ],
    ids=["late", "late, lossy", "back after a while", "back at once", "one apart", "two apart, lossy"],
)
def test_late_and_restarted_nodes_join(clip: Clip, network_faults: NetworkFaults) -> None:
    outcome = track_by_nodes(clip.frames(), clip.rig, clip.boxes, network_faults=network_faults)
    assert outcome.members == [(0, 1, 2)] * 3
    assert outcome.refused == [{}] * 3
    away = {*network_faults.joins, *network_faults.returns, *network_faults.partition[2]}
    for c, found in enumerate(outcome.frames):
        numbers = [f.pose.index for f in found]
        assert numbers[-1] == FRAMES - 1
        assert len(numbers) == len(set(numbers))
        assert (len(numbers) == FRAMES) or c in away
        assert all(f.pose.world_from_object is not None for f in found)
        # A separated node had only some of the images.
        assert is_accurate(found, clip, 2.5 if network_faults.partition[2] else 0.5)
        # It has own features again, new or previous ones.
        assert found[-1].pose.inliers[c] > 0
    if not network_faults.partition[2]:
        assert_common_frames_equal(outcome)
    last = [[found[-1]] for found in outcome.frames]
    for other in last[1:]:
        assert_same(other, last[0])


def test_newcomer_before_first_motion_waits(clip: Clip) -> None:
    """Without boxes, frames wait for a motion: a newcomer has their poses although it missed the first ones."""
    frames = [clip.frames()[0]] * 3 + clip.frames()[:5]
    frames = [replace(f, index=k, time=k / 30, times=(None,) * 3) for k, f in enumerate(frames)]
    outcome = track_by_nodes(frames, clip.rig, None, network_faults=NetworkFaults(joins={2: 6}))
    assert outcome.members == [(0, 1, 2)] * 3
    assert_common_frames_equal(outcome)
    assert len(outcome.frames[2]) > 5
    assert sum(f.pose.is_measured for f in outcome.frames[2]) >= 3


def test_late_cameras_found_group(clip: Clip, by_one: list[TrackedFrame]) -> None:
    joins = {0: 3, 1: 20, 2: 9}
    outcome = track_by_nodes(clip.frames()[:5], clip.rig, clip.boxes, network_faults=NetworkFaults(joins=joins))
    assert outcome.members == [(0, 1, 2)] * 3
    assert_same(outcome.frames[0], by_one[:5], 1e-11)
    assert_agreed(outcome, range(3))


@pytest.mark.slow
def test_object_is_reinitialized_if_no_node_knows_it() -> None:
    """The nodes that saw the object leave when the others join, which cannot relocalize it. The object frame then
    changes, which is reported."""
    clip = Clip.render(make_demo_scene(frames=24, angle_deg=50, size=SIZE, n_cameras=3, seed=2))
    network_faults = NetworkFaults(dies={0: 186, 1: 100, 2: 100}, returns={0: 306, 1: 130, 2: 130})
    outcome = track_by_nodes(clip.frames(), clip.rig, clip.boxes, network_faults=network_faults)
    assert outcome.members == [(0, 1, 2)] * 3
    for c, found in enumerate(outcome.frames):
        started = [f for f in found if f.pose.index and f.pose.status is FrameStatus.FIRST]
        assert sum(f.pose.is_measured for f in found[-15:]) == 15
        if c == 0:  # it returned after the object was found
            assert not started
        else:
            (first,) = started
            assert first.pose.faults == ("from here on poses refer to another object frame",)
            assert not any(f.pose.faults for f in found if f is not first)
        # In the new object frame, tracking is as accurate.
        off = compute_pose_errors(found[-12:], clip.truth)[:, 0]
        assert np.ptp(off) < 0.5


def test_recording_without_frames(clip: Clip) -> None:
    outcome = track_by_nodes([], clip.rig, clip.boxes)
    assert outcome.frames == [[], [], []]
    assert [len(reported) for reported in outcome.payload_sizes] == [
        2,
        2,
        2,
    ]  # the end of the recording, and its confirmation


def test_node_ignores_invalid_payload_and_names_sender() -> None:
    def ask(ask: Request, frames: int) -> ExchangeResult:  # noqa: ARG001
        assert isinstance(ask, ExchangeRequest)
        return ExchangeResult({0: ask.payload, 1: b"\xc1 nonsense"}, frozenset(), False)

    node = Node(0, 3, ask)
    assert node.gather([5], 0) == [5, 0, 0]
    assert list(node.refused) == [1]
    assert node.refused[1].startswith("not a message")


# Number of frames of `four`.
N_FOUR = 5


@pytest.fixture(scope="module")
def four() -> Clip:
    return Clip.render(make_demo_scene(frames=N_FOUR, angle_deg=3 * N_FOUR, size=SIZE, n_cameras=4, seed=2))


@pytest.fixture(scope="module")
def rms_without_camera(four: Clip) -> FloatArray:
    """(2,) RMS errors in degrees and millimeters if camera 1 is blind."""
    without = [replace(f, images=(f.images[0], None, *f.images[2:])) for f in four.frames()]
    return rms(list(track(without, four.rig, four.boxes)), four)


def rms(found: Sequence[TrackedFrame], clip: Clip) -> FloatArray:
    return np.asarray(np.sqrt(np.nanmean(compute_pose_errors(found, clip.truth) ** 2, axis=0)))


@pytest.mark.parametrize(
    ("lie", "mode", "loss", "said"),
    [
        pytest.param(
            "two-faced", "exact", 0.0, "it sent different messages to different cameras", marks=pytest.mark.slow
        ),
        ("two-faced", "compact", 0.1, "it sent different messages to different cameras"),
        pytest.param(
            "accusing", "exact", 0.0, "it sent different messages to different cameras", marks=pytest.mark.slow
        ),
        pytest.param("whispering", "compact", 0.0, "it or camera 2 reports false messages", marks=pytest.mark.slow),
        pytest.param("heavy", "compact", 0.0, None, marks=pytest.mark.slow),
        # As test_plausibility.py.
        pytest.param("bent", "compact", 0.0, "its pose information matrix is invalid", marks=pytest.mark.slow),
    ],
)
def test_others_continue_despite_faulty_node(
    four: Clip, rms_without_camera: FloatArray, lie: FaultKind, mode: str, loss: float, said: str | None
) -> None:
    """They agree, with about the accuracy without it; results before its detection are discarded."""
    network_faults = NetworkFaults(loss=loss, seed=1)
    outcome = track_by_nodes(
        four.frames(),
        four.rig,
        four.boxes,
        faults={1: make_fault(lie, 1, 4, seed=1)},
        mode=mode,
        network_faults=network_faults,
    )
    good = [0, 2, 3]
    assert_agreed(outcome, good)
    found = outcome.frames[good[0]]
    assert [f.pose.index for f in found] == list(range(N_FOUR))
    assert {f.pose.status for f in found[1:]} == {FrameStatus.TRACKED}
    assert (rms(found, four) < 1.5 * rms_without_camera).all()
    for c in good:
        assert outcome.refused[c].get(1) == said
        assert outcome.refused[c].keys() <= ({1, 2} if lie == "whispering" else {1})


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (5, 8, 11))])
def test_node_with_corrupted_bytes_is_harmless(four: Clip, seed: int) -> None:
    boxes = four.boxes if seed % 2 else None
    outcome = track_by_nodes(
        four.frames(),
        four.rig,
        boxes,
        faults={seed % 4: make_fault("flipped", seed % 4, 4, seed)},
        mode=MODES[seed % 2],
        network_faults=NetworkFaults(seed=seed),
    )
    good = [c for c in range(4) if c != seed % 4]
    assert_agreed(outcome, good)
    found = outcome.frames[good[0]]
    assert len(found) >= N_FOUR
    assert sum(f.pose.is_measured for f in found) >= N_FOUR - 2
    assert np.nanmax(compute_pose_errors(found[:N_FOUR], four.truth)[:, 0]) < 1.0


def test_node_error_is_raised_in_caller(clip: Clip) -> None:
    with pytest.raises(ValueError, match="no camera 'other'"):
        track_by_nodes(clip.frames(), clip.rig, {"other": next(iter(clip.boxes.values()))})


def test_compact_mode_needs_fewer_rounds_and_bytes(clip: Clip) -> None:
    """One of three cameras is blind for a while, then all are; the object is relocalized, with results equal to the
    bit."""
    frames = clip.frames()
    frames[3] = replace(frames[3], images=(frames[3].images[0], None, frames[3].images[2]))
    frames[5] = replace(frames[5], images=(None, None, None))
    expected = list(track(frames, clip.rig, clip.boxes))
    exact, few = (track_by_nodes(frames, clip.rig, clip.boxes, mode=mode) for mode in MODES)
    assert [f.pose.status for f in few.frames[0]] == [f.pose.status for f in expected]
    assert_agreed(few, range(3))
    assert sum(len(reported) for reported in few.payload_sizes) < 0.7 * sum(
        len(reported) for reported in exact.payload_sizes
    )
    assert sum(map(sum, few.payload_sizes)) < 0.6 * sum(map(sum, exact.payload_sizes))
    was, by_few = (rms(found, clip) for found in (expected, few.frames[0]))
    assert (by_few < 1.1 * was + 1e-3).all()
    # The results agree approximately, not exactly.
    apart = compare_runs(few.frames[0], expected)
    assert 1e-9 < apart.rotation < 1e-3


def test_unknown_mode_is_rejected(clip: Clip) -> None:
    with pytest.raises(ValueError, match="mode 'quick': expected exact or compact"):
        track_by_nodes(clip.frames(), clip.rig, clip.boxes, mode="quick")


def test_nodes_smooth_like_one_process(clip: Clip, by_one: list[TrackedFrame], by_nodes: SimulationResult) -> None:
    """From each camera's observations, sent once."""
    expected = smooth_tracks([Track.from_tracked(f) for f in by_one], clip.rig)
    assert expected.status is Status.OK
    reported = by_nodes.payload_sizes
    outcome = track_by_nodes(clip.frames(), clip.rig, clip.boxes, smooth=True)
    first, *others = outcome.smoothed
    assert first is not None
    for a, b in zip(first.poses, expected.poses, strict=True):
        assert a.world_from_object is not None
        assert b.world_from_object is not None
        one, other = a.world_from_object.as_matrix(), b.world_from_object.as_matrix()
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6)
    for other in others:
        assert other is not None
        for a, b in zip(other.poses, first.poses, strict=True):
            np.testing.assert_array_equal(a.covariance, b.covariance)
            assert a.world_from_object is not None
            assert b.world_from_object is not None
            np.testing.assert_array_equal(a.world_from_object.as_matrix(), b.world_from_object.as_matrix())
    # Refined, with each observation sent once in a few bytes.
    refined = [replace(frame, pose=pose) for frame, pose in zip(outcome.frames[0], first.poses, strict=True)]
    assert compare_runs(outcome.frames[0], refined).rotation > 1e-6
    for c in range(3):
        sights = sum(len(f.observations[c].landmark_ids) for f in outcome.frames[c])
        # The first common frame, the observations, and the confirmation.
        assert len(outcome.payload_sizes[c]) == len(reported[c]) + 3
        assert outcome.payload_sizes[c][-2] < 9 * sights + 500


def test_invalid_observations_are_dropped() -> None:
    reported = CameraObservations(
        np.array([9]), np.array([0]), np.zeros((1, 2)), np.array([4]), np.zeros((1, 3)), np.array([1])
    )
    assert [len(s.landmark_ids) for s in _unpack_observations(reported, 2)] == [0, 0]
    assert [len(s.landmark_ids) for s in _unpack_observations(replace(reported, frame=np.array([1])), 2)] == [0, 1]


def test_nodes_tracker_frame_by_frame(clip: Clip, by_one: list[TrackedFrame]) -> None:
    with NodesTracker(clip.rig, clip.boxes, mode="exact") as tracker:
        found = [f for frame in clip.frames()[:5] for f in tracker.step(frame)]
        assert len(found) >= 4
        found += tracker.flush()
    assert_same(found, by_one[:5], 1e-11)
    for mine, wanted in zip(found, by_one[:5], strict=True):
        for one, other in zip(mine.observations, wanted.observations, strict=True):
            np.testing.assert_array_equal(one.landmark_ids, other.landmark_ids)
    assert tracker.describe_cost().startswith("3 nodes exchanged ")
    with (
        pytest.raises(ValueError, match="no camera 'other'"),
        NodesTracker(clip.rig, {"other": next(iter(clip.boxes.values()))}, mode="exact"),
    ):
        pass


def test_passive_newcomer_does_not_block_tracking(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    hello = encode_hello(2, 0, Hello(0, 0))
    step = simulation._step_node

    def knocked(state: simulation.NodeState, inbox: Inbox) -> tuple[simulation.NodeState, list[Packet]]:
        return step(state, [*inbox, (2, hello)] if state.membership.ticks % 5 == 0 else inbox)

    monkeypatch.setattr(simulation, "_step_node", knocked)
    outcome = track_by_nodes(clip.frames(), clip.rig, clip.boxes, network_faults=NetworkFaults(dies={2: 1}))
    for found in outcome.frames[:2]:
        assert len(found) == FRAMES
        assert sum(f.pose.is_measured for f in found) >= FRAMES - 1
    assert outcome.steps < 40 * DEFAULT_TIMEOUTS.inactive * FRAMES
