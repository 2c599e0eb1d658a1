"""Keyframes: few, from all sides, the oldest first."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import ring
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.keyframes import (
    MAX_KEYFRAMES,
    NEW_SCALE,
    NEW_TURN,
    RINGS,
    nearest_views,
    references_of,
    viewpoints,
    with_keyframe,
)

UP = np.array([0.0, 1.0, 0.0])
START = RigidTransform.from_components([0.02, -0.03, 0.05], Rotation.from_rotvec([0.2, -0.1, 0.3]))


@pytest.fixture(scope="module")
def rig() -> Rig:
    """Three cameras around the object's first place, at its height: a turn about the vertical moves all views by it."""
    return ring(3, 1.5, target=START.translation)


def turned(degrees: float, axis: FloatArray = UP) -> RigidTransform:
    """The object's pose, turned about its centre."""
    return RigidTransform.from_components(
        START.translation, Rotation.from_rotvec(np.radians(degrees) * axis) * START.rotation
    )


def frame(rig: Rig, index: int, pose: RigidTransform, blind: tuple[int, ...] = ()) -> SolvedFrame:
    """A solved frame; blind cameras have no features."""
    sees = np.array([c not in blind for c in range(len(rig))])
    return SolvedFrame(index, index / 30, np.zeros(len(rig)), pose, np.zeros((6, 6)), viewpoints(rig, pose), sees)


def add_keyframe(kept: list[SolvedFrame], current: SolvedFrame) -> bool:
    """Whether it became one."""
    before = tuple(kept)
    kept[:] = with_keyframe(before, current)
    assert all(isinstance(k, SolvedFrame) for k in kept)
    return len(kept) > len(before) or tuple(kept) != before


def frames(rig: Rig, *degrees: float) -> list[SolvedFrame]:
    return [frame(rig, k, turned(d)) for k, d in enumerate(degrees)]


def indices(references: list[SolvedFrame]) -> list[int]:
    return [r.number for r in references]


def angle(a: FloatArray, b: FloatArray) -> float:
    return float(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def test_viewpoints_are_the_cameras_centres_in_the_objects_frame(rig: Rig) -> None:
    pose = turned(37.0)
    found = viewpoints(rig, pose)
    np.testing.assert_allclose(pose.apply(found), [camera.center for camera in rig], atol=1e-12)
    # The object turns by 20 degrees: so do all viewpoints about it.
    for a, b in zip(found, viewpoints(rig, turned(57.0)), strict=True):
        assert np.degrees(angle(a, b)) == pytest.approx(20.0)
        assert np.linalg.norm(a) == pytest.approx(1.5)


# --- which are matched


@pytest.mark.parametrize("camera", [0, 1, 2])
def test_the_oldest_of_each_ring_is_matched(rig: Rig, camera: int) -> None:
    #                     0    1   2   3    4   5   6   7
    kept = frames(rig, -60, -25, 15, 24, -13, 5, 21, -3)
    here = viewpoints(rig, turned(0.0))[camera]
    assert indices(references_of(kept, camera, here)) == [5, 2, 1]
    # Without one of the middle ring.
    del kept[4], kept[2]
    assert indices(references_of(kept, camera, here)) == [5, 1]
    assert indices(references_of(kept[:1], camera, here)) == []
    assert references_of([], camera, here) == []


def test_what_is_matched_anyway_is_not_matched_twice(rig: Rig) -> None:
    kept = frames(rig, -25, 15, 5, 4)
    here = viewpoints(rig, turned(0.0))[1]
    assert indices(references_of(kept, 1, here, skip=kept[1])) == [2, 0]
    assert indices(references_of(kept, 1, here, skip=frame(rig, 9, turned(0.0)))) == [2, 1, 0]


def test_a_view_in_which_nothing_was_seen_is_not_matched(rig: Rig) -> None:
    kept = [frame(rig, 0, turned(5.0), blind=(1,)), frame(rig, 1, turned(6.0)), frame(rig, 2, turned(8.0), blind=(0,))]
    here = viewpoints(rig, turned(0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [indices(references_of(kept, c, here[c])) for c in range(3)] == [[0], [1], [0]]
        assert [indices(nearest_views(kept, c, here[c], 5)) for c in range(3)] == [[0, 1], [1, 2], [0, 1, 2]]
        nowhere = [frame(rig, 0, turned(0.0), blind=(0, 1, 2))]
        assert references_of(nowhere, 0, here[0]) == nearest_views(nowhere, 0, here[0], 5) == []


@given(turns=st.lists(st.floats(-180, 180), max_size=30), here=st.floats(-180, 180))
def test_references_are_few_near_and_the_oldest_of_their_ring(turns: list[float], here: float) -> None:
    rig = ring(2, 1.5, target=START.translation)
    kept = frames(rig, *turns)
    viewpoint = viewpoints(rig, turned(here))[0]
    chosen = references_of(kept, 0, viewpoint)
    assert len(chosen) <= len(RINGS) - 1
    assert len(set(indices(chosen))) == len(chosen)
    apart = np.array([angle(k.viewpoints[0], viewpoint) for k in kept])
    for reference in chosen:
        mine = apart[reference.number]
        assert mine < RINGS[-1] + 1e-9
        if np.abs(np.subtract(RINGS, mine)).min() < 2e-4:  # on the border of two rings: either's
            continue
        older = apart[: reference.number]
        inside = int(np.searchsorted(RINGS, mine, side="right"))
        # A hundredth of a degree for what lies on the border of two rings.
        clear = (older > RINGS[inside - 1] + 2e-4) & (older < RINGS[min(inside, len(RINGS) - 1)] - 2e-4)
        assert not clear.any()
    # Something is matched whenever something is near, and nothing else; on the border either may be.
    assert bool(chosen) >= bool((apart < RINGS[-1] - 1e-9).any())
    assert bool(chosen) <= bool((apart < RINGS[-1] + 1e-9).any())


def test_nearest_views_are_in_order_and_ties_go_to_the_older(rig: Rig) -> None:
    kept = frames(rig, 40, 10, -20, 10, 0)
    here = viewpoints(rig, turned(2.0))[2]
    assert indices(nearest_views(kept, 2, here, 4)) == [4, 1, 3, 2]
    assert indices(nearest_views(kept, 2, here, 50)) == [4, 1, 3, 2, 0]
    assert nearest_views(kept, 2, here, 0) == []
    assert nearest_views([], 2, here, 3) == []


# --- which are kept


def test_a_frame_is_kept_when_it_shows_another_side(rig: Rig) -> None:
    kept: list[SolvedFrame] = []
    limit = float(np.degrees(NEW_TURN))
    assert add_keyframe(kept, frame(rig, 0, turned(0.0)))
    assert not add_keyframe(kept, frame(rig, 1, turned(0.9 * limit)))
    assert add_keyframe(kept, frame(rig, 2, turned(1.1 * limit)))
    assert not add_keyframe(kept, frame(rig, 3, turned(0.0)))
    assert not add_keyframe(kept, frame(rig, 4, turned(-0.9 * limit)))
    assert indices(kept) == [0, 2]


def test_a_frame_is_kept_when_the_object_is_much_nearer_or_further(rig: Rig) -> None:
    camera = rig.subset(["cam_0"])
    towards = START.translation - camera.cameras[0].center

    def at(factor: float) -> RigidTransform:
        return RigidTransform.from_components(camera.cameras[0].center + factor * towards, START.rotation)

    kept = [frame(camera, 0, at(1.0))]
    assert not add_keyframe(kept, frame(camera, 1, at(0.98 * NEW_SCALE)))
    assert not add_keyframe(kept, frame(camera, 2, at(1.02 / NEW_SCALE)))
    assert add_keyframe(kept, frame(camera, 3, at(1.02 * NEW_SCALE)))
    assert add_keyframe(kept, frame(camera, 4, at(0.98 / NEW_SCALE)))


def test_most_of_the_cameras_that_see_it_decide(rig: Rig) -> None:
    first = frame(rig, 0, turned(0.0), blind=(1, 2))
    # New to two of three; to one of two is not most of them; what is blind has no say.
    assert add_keyframe([first], frame(rig, 1, turned(1.0)))
    assert not add_keyframe([first], frame(rig, 1, turned(1.0), blind=(2,)))
    assert add_keyframe([first], frame(rig, 1, turned(1.0), blind=(0,)))
    assert not add_keyframe([first], frame(rig, 1, turned(90.0), blind=(0, 1, 2)))


def test_a_turn_about_a_line_of_sight_is_not_another_side() -> None:
    """The camera sees the same, rolled, which its features do not mind."""
    rig = ring(1, 1.5, target=START.translation)
    kept = [frame(rig, 0, turned(0.0))]
    assert not add_keyframe(kept, frame(rig, 1, turned(90.0, rig.cameras[0].direction)))


def test_cameras_without_features_do_not_warn(rig: Rig) -> None:
    kept: list[SolvedFrame] = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for k in range(40):
            add_keyframe(kept, frame(rig, k, turned(9.0 * k), blind=((), (0,), (1, 2), (0, 1, 2))[k % 4]))
    assert not any(k.number % 4 == 3 for k in kept)  # nothing was seen in those


def test_of_too_many_the_most_redundant_newer_one_goes(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sylpose.tracking.keyframes.MAX_KEYFRAMES", 4)
    kept = frames(rig, 0, 40, 80, 93)
    assert add_keyframe(kept, frame(rig, 4, turned(120.0)))
    assert indices(kept) == [0, 1, 2, 4]  # 80 and 93 were the most alike
    # The newest itself, where it is: then nothing else is lost for it.
    add_keyframe(kept, frame(rig, 5, turned(50.0)))
    assert indices(kept) == [0, 1, 2, 4]
    # The first one stays, whatever is like it.
    add_keyframe(kept, frame(rig, 6, turned(-7.0)))
    assert indices(kept) == [0, 1, 2, 4]


def test_a_long_recording_keeps_a_bounded_number_and_the_first(rig: Rig) -> None:
    rng = np.random.default_rng(0)
    kept: list[SolvedFrame] = []
    turns = Rotation.random(4 * MAX_KEYFRAMES, rng=rng)
    for k, turn in enumerate(turns):
        pose = RigidTransform.from_components(START.translation, turn * START.rotation)
        add_keyframe(kept, frame(rig, k, pose))
        assert len(kept) <= MAX_KEYFRAMES
    assert len(kept) == MAX_KEYFRAMES
    assert kept[0].number == 0
    assert indices(kept) == sorted(indices(kept))


@given(
    steps=st.lists(st.tuples(st.floats(-20, 20), st.sampled_from([0, 1, 2])), min_size=1, max_size=40),
    most=st.integers(3, 100),
)
def test_every_view_that_was_met_stays_covered(steps: list[tuple[float, int]], most: int) -> None:
    """Unless there are too many, each solved frame has a keyframe within the turn that makes a new one, in half of the
    cameras at least; the first one and the order stay in any case."""
    rig = ring(3, 1.5, target=START.translation)
    kept: list[SolvedFrame] = []
    pose, met = START, []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sylpose.tracking.keyframes.MAX_KEYFRAMES", most)
        for k, (degrees, axis) in enumerate(steps):
            turn = Rotation.from_rotvec(np.radians(degrees) * np.eye(3)[axis])
            pose = RigidTransform.from_components(pose.translation, turn * pose.rotation)
            met.append(frame(rig, k, pose))
            add_keyframe(kept, met[-1])
            assert len(kept) <= most
            assert kept[0] is met[0]
            assert indices(kept) == sorted(set(indices(kept)))
    if len(kept) < most:
        for current in met:
            near = [
                min(angle(current.viewpoints[c], k.viewpoints[c]) for k in kept) < NEW_TURN + 1e-6 for c in range(3)
            ]
            assert sum(near) >= 2
