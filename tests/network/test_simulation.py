"""Nodes that see their own images alone come to the poses of one process, all alike; and go on where one of them dies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.kinds_scenes import turned
from benchmarks.nodes import difference
from sylpose.geometry.arrays import FloatArray
from sylpose.methods import MODES
from sylpose.network import simulation
from sylpose.network.fault_injection import Lie
from sylpose.network.membership import Ask, Heard, Tell
from sylpose.network.node import Node
from sylpose.network.node_tracker import NodesTracker
from sylpose.network.rounds import PATIENCE
from sylpose.network.simulation import Outcome, track_by_nodes
from sylpose.network.smoothing import _sightings
from sylpose.network.wire_format import HEADER, Hello, said_hello
from sylpose.results import FrameStatus, Status
from sylpose.simulate import demo_scene
from sylpose.smoothing.trajectory import Track, smooth
from sylpose.sylvester.distributed.messages import Inbox, Packet
from sylpose.sylvester.distributed.simulation import Disturbances
from sylpose.tracking.reports import Sighted
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import track
from tests.clips import SIZE, Clip, errors
from tests.tracking.test_fallback_search import PALE, jumping

FRAMES = 8


@pytest.fixture(scope="module")
def clip() -> Clip:
    return Clip.render(demo_scene(frames=FRAMES, turn_deg=25, size=SIZE, n_cameras=3, seed=2))


@pytest.fixture(scope="module")
def by_one(clip: Clip) -> list[TrackedFrame]:
    """What one process finds in it, with boxes."""
    return list(track(clip.frames(), clip.rig, clip.boxes))


@pytest.fixture(scope="module")
def by_nodes(clip: Clip) -> Outcome:
    return track_by_nodes(clip.frames(), clip.rig, clip.boxes)


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
        pytest.param("landmarks", True, Disturbances(), marks=pytest.mark.slow),
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
            # A round of the alignment, which is what most rounds are; of a header, too.
            assert np.median(told) + HEADER.size <= 256


def test_faint_features_are_asked_for_by_all_alike() -> None:
    """An object in pale paint: all know that it starves."""
    clip = jumping(12.0, PALE)
    frames = clip.frames()
    expected = list(track(frames, clip.rig, clip.boxes, features="sift"))
    assert sum(f.pose.measured for f in expected) >= len(frames) - 1
    outcome = track_by_nodes(frames, clip.rig, clip.boxes, features="sift")
    assert_same(outcome.frames[0], expected, 1e-11)
    assert_agreed(outcome, range(len(clip.rig)))
    assert outcome.refused == [{}] * len(clip.rig)


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


@pytest.mark.parametrize("dies", [pytest.param(60, marks=pytest.mark.slow), 180])
def test_the_others_go_on_without_a_node_that_dies(clip: Clip, by_one: list[TrackedFrame], dies: int) -> None:
    outcome = track_by_nodes(clip.frames(), clip.rig, clip.boxes, disturbances=Disturbances(dies={1: dies}))
    assert outcome.members[0] == outcome.members[2] == (0, 2)
    assert_agreed(outcome, [0, 2])
    of_dead = outcome.frames[1]
    assert 0 < len(of_dead) < FRAMES
    # What it said until then is what all said.
    assert_same(of_dead, by_one[: len(of_dead)], 1e-11)
    found = outcome.frames[0]
    assert len(found) == FRAMES
    assert {f.pose.status for f in found[1:]} == {FrameStatus.TRACKED}
    assert not found[-1].pose.inliers[1]
    assert errors(found, clip.truth)[:, 0].max() < 0.5


def assert_alike_where_both_took_part(outcome: Outcome) -> None:
    """Of each frame all that said anything of it said the same, to the bit."""
    said: dict[int, TrackedFrame] = {}
    for found in outcome.frames:
        for tracked in found:
            assert_same([tracked], [said.setdefault(tracked.pose.index, tracked)])


def good(found: Sequence[TrackedFrame], clip: Clip, worst: float) -> bool:
    return bool(errors(found, clip.truth)[:, 0].max() < worst)


@pytest.mark.parametrize(
    "disturbances",
    [
        pytest.param(Disturbances(joins={2: 60}), marks=pytest.mark.slow),
        Disturbances(joins={0: 100}, loss=0.2, delay=2, seed=3),
        Disturbances(dies={1: 60}, returns={1: 110}),
        pytest.param(Disturbances(dies={0: 70}, returns={0: 75}), marks=pytest.mark.slow),
        pytest.param(Disturbances(apart=(60, 140, frozenset({1}))), marks=pytest.mark.slow),
        Disturbances(apart=(60, 140, frozenset({0, 1})), loss=0.1, seed=6),
    ],
    ids=["late", "late, lossy", "back after a while", "back at once", "one apart", "two apart, lossy"],
)
def test_who_comes_late_or_again_takes_part_again(clip: Clip, disturbances: Disturbances) -> None:
    outcome = track_by_nodes(clip.frames(), clip.rig, clip.boxes, disturbances=disturbances)
    assert outcome.members == [(0, 1, 2)] * 3
    assert outcome.refused == [{}] * 3
    away = {*disturbances.joins, *disturbances.returns, *disturbances.apart[2]}
    for c, found in enumerate(outcome.frames):
        numbers = [f.pose.index for f in found]
        assert numbers[-1] == FRAMES - 1
        assert len(numbers) == len(set(numbers))
        assert (len(numbers) == FRAMES) or c in away
        assert all(f.pose.world_from_object is not None for f in found)
        # Who was apart had but some of the images.
        assert good(found, clip, 2.5 if disturbances.apart[2] else 0.5)
        # It has features of its own again, or those it had.
        assert found[-1].pose.inliers[c] > 0
    if not disturbances.apart[2]:
        assert_alike_where_both_took_part(outcome)
    last = [[found[-1]] for found in outcome.frames]
    for other in last[1:]:
        assert_same(other, last[0])


def test_who_comes_before_anything_has_moved_waits_with_the_others(clip: Clip) -> None:
    """Without boxes, frames wait until something moves: a newcomer has the first ones not seen, but it has their poses."""
    frames = [clip.frames()[0]] * 3 + clip.frames()
    frames = [replace(f, index=k, time=k / 30, times=(None,) * 3) for k, f in enumerate(frames)]
    outcome = track_by_nodes(frames, clip.rig, None, disturbances=Disturbances(joins={2: 6}))
    assert outcome.members == [(0, 1, 2)] * 3
    assert_alike_where_both_took_part(outcome)
    assert len(outcome.frames[2]) > FRAMES
    assert sum(f.pose.measured for f in outcome.frames[2]) >= FRAMES - 2


def test_cameras_that_all_come_late_found_a_group(clip: Clip, by_one: list[TrackedFrame]) -> None:
    joins = {0: 3, 1: 20, 2: 9}
    outcome = track_by_nodes(clip.frames(), clip.rig, clip.boxes, disturbances=Disturbances(joins=joins))
    assert outcome.members == [(0, 1, 2)] * 3
    assert_same(outcome.frames[0], by_one, 1e-11)
    assert_agreed(outcome, range(3))


def test_where_nobody_has_seen_the_object_it_is_looked_for_anew() -> None:
    """Those that have seen it are gone as the others are taken in, who know where it is and would not know it again. Its
    frame is another one then, and that is said."""
    clip = Clip.render(demo_scene(frames=24, turn_deg=50, size=SIZE, n_cameras=3, seed=2))
    disturbances = Disturbances(dies={0: 186, 1: 100, 2: 100}, returns={0: 306, 1: 130, 2: 130})
    outcome = track_by_nodes(clip.frames(), clip.rig, clip.boxes, disturbances=disturbances)
    assert outcome.members == [(0, 1, 2)] * 3
    for c, found in enumerate(outcome.frames):
        started = [f for f in found if f.pose.index and f.pose.status is FrameStatus.FIRST]
        assert sum(f.pose.measured for f in found[-15:]) == 15
        if c == 0:  # it came back when that had been found
            assert not started
        else:
            (first,) = started
            assert first.pose.faults == ("from here on poses are told in another frame of the object",)
            assert not any(f.pose.faults for f in found if f is not first)
        # In that frame it is followed as well as in any.
        off = errors(found[-12:], clip.truth)[:, 0]
        assert np.ptp(off) < 0.5


def test_a_recording_without_frames_is_none(clip: Clip) -> None:
    outcome = track_by_nodes([], clip.rig, clip.boxes)
    assert outcome.frames == [[], [], []]
    assert [len(told) for told in outcome.told] == [2, 2, 2]  # that there is none, and that all have heard so


def test_a_node_takes_what_means_nothing_for_nothing_and_names_who_said_it() -> None:
    def ask(ask: Ask, frames: int) -> Heard:  # noqa: ARG001
        assert isinstance(ask, Tell)
        return Heard({0: ask.own, 1: b"\xc1 nonsense"}, frozenset(), False)

    node = Node(0, 3, ask)
    assert node.ask(lambda c: 5 + c, 0) == [5, 0, 0]
    assert list(node.refused) == [1]
    assert node.refused[1].startswith("no message")


@pytest.fixture(scope="module")
def four() -> Clip:
    return Clip.render(demo_scene(frames=6, turn_deg=18, size=SIZE, n_cameras=4, seed=2))


@pytest.fixture(scope="module")
def without_it(four: Clip) -> FloatArray:
    """(2,) rms degrees and millimetres where camera 1 sees nothing."""
    without = [replace(f, images=(f.images[0], None, *f.images[2:])) for f in four.frames()]
    return rms(list(track(without, four.rig, four.boxes)), four)


def rms(found: Sequence[TrackedFrame], clip: Clip) -> FloatArray:
    return np.asarray(np.sqrt(np.nanmean(errors(found, clip.truth) ** 2, axis=0)))


@pytest.mark.parametrize(
    ("lie", "mode", "loss", "said"),
    [
        pytest.param("two-faced", "exact", 0.0, "it told others something else", marks=pytest.mark.slow),
        ("two-faced", "compact", 0.1, "it told others something else"),
        ("accusing", "exact", 0.0, "it told others something else"),
        ("whispering", "compact", 0.0, "it or camera 2 lies of what it told"),
        ("heavy", "compact", 0.0, None),
        ("bent", "compact", 0.0, "what it says of the pose is no information"),
    ],
)
def test_the_others_go_on_beside_a_node_that_lies(
    four: Clip, without_it: FloatArray, lie: Lie, mode: str, loss: float, said: str | None
) -> None:
    """Alike, and about as well as if it had not been there; what was said before it was found out is no frame's."""
    disturbances = Disturbances(loss=loss, seed=1)
    outcome = track_by_nodes(four.frames(), four.rig, four.boxes, lies={1: lie}, mode=mode, disturbances=disturbances)
    good = [0, 2, 3]
    assert_agreed(outcome, good)
    found = outcome.frames[good[0]]
    assert [f.pose.index for f in found] == list(range(6))
    assert {f.pose.status for f in found[1:]} == {FrameStatus.TRACKED}
    assert (rms(found, four) < 1.5 * without_it).all()
    for c in good:
        assert outcome.refused[c].get(1) == said
        assert outcome.refused[c].keys() <= ({1, 2} if lie == "whispering" else {1})


@pytest.mark.parametrize(
    "seed", [1, pytest.param(5, marks=pytest.mark.slow), 8, pytest.param(11, marks=pytest.mark.slow)]
)
def test_a_node_whose_bytes_flip_harms_nobody(four: Clip, seed: int) -> None:
    boxes = four.boxes if seed % 2 else None
    outcome = track_by_nodes(
        four.frames(),
        four.rig,
        boxes,
        lies={seed % 4: "flipped"},
        mode=MODES[seed % 2],
        disturbances=Disturbances(seed=seed),
    )
    good = [c for c in range(4) if c != seed % 4]
    assert_agreed(outcome, good)
    found = outcome.frames[good[0]]
    assert len(found) >= 6
    assert sum(f.pose.measured for f in found) >= 4
    assert np.nanmax(errors(found[:6], four.truth)[:, 0]) < 1.0


def test_what_is_not_simulated_is_refused(clip: Clip) -> None:
    with pytest.raises(ValueError, match="what nodes say is garbled by `lies`"):
        track_by_nodes(clip.frames(), clip.rig, disturbances=Disturbances(nonsense={1: "two-faced"}))


def test_an_error_of_a_node_is_the_callers(clip: Clip) -> None:
    with pytest.raises(ValueError, match="no camera 'other'"):
        track_by_nodes(clip.frames(), clip.rig, {"other": next(iter(clip.boxes.values()))})


def test_the_economical_mode_is_as_good_in_fewer_rounds_and_bytes(clip: Clip) -> None:
    """One camera of three sees nothing for a while, then all are blind: found again by all, alike to the bit."""
    frames = clip.frames()
    frames[3] = replace(frames[3], images=(frames[3].images[0], None, frames[3].images[2]))
    frames[5] = replace(frames[5], images=(None, None, None))
    expected = list(track(frames, clip.rig, clip.boxes))
    exact, few = (track_by_nodes(frames, clip.rig, clip.boxes, mode=mode) for mode in MODES)
    assert [f.pose.status for f in few.frames[0]] == [f.pose.status for f in expected]
    assert_agreed(few, range(3))
    assert sum(len(told) for told in few.told) < 0.7 * sum(len(told) for told in exact.told)
    assert sum(map(sum, few.told)) < 0.6 * sum(map(sum, exact.told))
    was, by_few = (rms(found, clip) for found in (expected, few.frames[0]))
    assert (by_few < 1.1 * was + 1e-3).all()
    # It is another way to about the same, not the same way.
    apart = difference(few.frames[0], expected)
    assert 1e-9 < apart.turn < 1e-3


def test_a_mode_that_there_is_not_is_refused(clip: Clip) -> None:
    with pytest.raises(ValueError, match="mode 'quick': expected exact or compact"):
        track_by_nodes(clip.frames(), clip.rig, clip.boxes, mode="quick")


def test_nodes_smooth_as_one_process_does(clip: Clip, by_one: list[TrackedFrame], by_nodes: Outcome) -> None:
    """By what each camera tells of its own sights, once."""
    expected = smooth([Track.of(f) for f in by_one], clip.rig)
    assert expected.status is Status.OK
    told = by_nodes.told
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
    # Refined, and each sight in a few bytes, once.
    refined = [replace(frame, pose=pose) for frame, pose in zip(outcome.frames[0], first.poses, strict=True)]
    assert difference(outcome.frames[0], refined).turn > 1e-6
    for c in range(3):
        sights = sum(len(f.sightings[c].landmark) for f in outcome.frames[c])
        # Since when it takes part, then the sights, and that all have heard the same.
        assert len(outcome.told[c]) == len(told[c]) + 3
        assert outcome.told[c][-2] < 9 * sights + 500


def test_sights_of_what_is_not_there_are_none() -> None:
    told = Sighted(np.array([9]), np.array([0]), np.zeros((1, 2)), np.array([4]), np.zeros((1, 3)), np.array([1]))
    assert [len(s.landmark) for s in _sightings(told, 2)] == [0, 0]
    assert [len(s.landmark) for s in _sightings(replace(told, frame=np.array([1])), 2)] == [0, 1]


def test_nodes_that_are_fed_frame_by_frame(clip: Clip, by_one: list[TrackedFrame]) -> None:
    with NodesTracker(clip.rig, clip.boxes, mode="exact") as tracker:
        found = [f for frame in clip.frames() for f in tracker.step(frame)]
        assert len(found) >= FRAMES - 1
        found += tracker.flush()
    assert_same(found, by_one, 1e-11)
    for mine, wanted in zip(found, by_one, strict=True):
        for one, other in zip(mine.sightings, wanted.sightings, strict=True):
            np.testing.assert_array_equal(one.landmark, other.landmark)
    assert tracker.cost().startswith("3 nodes told each other ")
    with (
        pytest.raises(ValueError, match="no camera 'other'"),
        NodesTracker(clip.rig, {"other": next(iter(clip.boxes.values()))}, mode="exact"),
    ):
        pass


def test_who_never_takes_part_keeps_nobody_from_tracking(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    hello = said_hello(2, 0, Hello(0, 0))
    step = simulation._step

    def knocked(state: simulation.NodeState, inbox: Inbox) -> tuple[simulation.NodeState, list[Packet]]:
        return step(state, [*inbox, (2, hello)] if state.present.ticks % 5 == 0 else inbox)

    monkeypatch.setattr(simulation, "_step", knocked)
    outcome = track_by_nodes(clip.frames(), clip.rig, clip.boxes, disturbances=Disturbances(dies={2: 1}))
    for found in outcome.frames[:2]:
        assert len(found) == FRAMES
        assert sum(f.pose.measured for f in found) >= FRAMES - 1
    assert outcome.steps < 40 * PATIENCE.silent * FRAMES
