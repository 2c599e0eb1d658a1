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
from sylpose.tracking.joint_side.joint_state import (
    MIN_KEYFRAME_SCALE,
    RING_ANGLES,
    SolvedFrame,
    add_keyframe,
    compute_viewpoints,
    find_nearest_views,
    select_references,
)
from sylpose.tracking.options import TrackingOptions

UP = np.array([0.0, 1.0, 0.0])
DEFAULTS = TrackingOptions()
START = RigidTransform.from_components([0.02, -0.03, 0.05], Rotation.from_rotvec([0.2, -0.1, 0.3]))


@pytest.fixture(scope="module")
def rig() -> Rig:
    """Three cameras around the object's first position, at its height: vertical rotation rotates all views."""
    return ring(3, 1.5, target=START.translation)


def make_rotated(degrees: float, axis: FloatArray = UP) -> RigidTransform:
    """The object's pose, rotated about its center."""
    return RigidTransform.from_components(
        START.translation, Rotation.from_rotvec(np.radians(degrees) * axis) * START.rotation
    )


def make_frame(rig: Rig, index: int, pose: RigidTransform, without_features: tuple[int, ...] = ()) -> SolvedFrame:
    """A solved frame; blind cameras have no features."""
    sees = np.array([c not in without_features for c in range(len(rig))])
    return SolvedFrame(
        index, index / 30, np.zeros(len(rig)), pose, np.zeros((6, 6)), compute_viewpoints(rig, pose), sees
    )


def try_keyframe(kept: list[SolvedFrame], current: SolvedFrame, options: TrackingOptions = DEFAULTS) -> bool:
    """Return whether the frame became a keyframe."""
    before = tuple(kept)
    kept[:] = add_keyframe(before, current, options)
    assert all(isinstance(k, SolvedFrame) for k in kept)
    return len(kept) > len(before) or tuple(kept) != before


def make_frames(rig: Rig, *degrees: float) -> list[SolvedFrame]:
    return [make_frame(rig, k, make_rotated(d)) for k, d in enumerate(degrees)]


def indices(references: list[SolvedFrame]) -> list[int]:
    return [r.number for r in references]


def angle(a: FloatArray, b: FloatArray) -> float:
    return float(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def test_viewpoints_are_camera_centers_in_object_frame(rig: Rig) -> None:
    pose = make_rotated(37.0)
    found = compute_viewpoints(rig, pose)
    np.testing.assert_allclose(pose.apply(found), [camera.center for camera in rig], atol=1e-12)
    # The object rotates by 20 degrees: so do all viewpoints about it.
    for a, b in zip(found, compute_viewpoints(rig, make_rotated(57.0)), strict=True):
        assert np.degrees(angle(a, b)) == pytest.approx(20.0)
        assert np.linalg.norm(a) == pytest.approx(1.5)


# --- selection of references


@pytest.mark.parametrize("camera", [0, 1, 2])
def test_oldest_of_each_ring_is_selected(rig: Rig, camera: int) -> None:
    #                     0    1   2   3    4   5   6   7
    kept = make_frames(rig, -60, -25, 15, 24, -13, 5, 21, -3)
    here = compute_viewpoints(rig, make_rotated(0.0))[camera]
    assert indices(select_references(kept, camera, here)) == [5, 2, 1]
    # Without one in the middle ring.
    del kept[4], kept[2]
    assert indices(select_references(kept, camera, here)) == [5, 1]
    assert indices(select_references(kept[:1], camera, here)) == []
    assert select_references([], camera, here) == []


def test_skipped_frame_is_not_selected(rig: Rig) -> None:
    kept = make_frames(rig, -25, 15, 5, 4)
    here = compute_viewpoints(rig, make_rotated(0.0))[1]
    assert indices(select_references(kept, 1, here, skip=kept[1])) == [2, 0]
    assert indices(select_references(kept, 1, here, skip=make_frame(rig, 9, make_rotated(0.0)))) == [2, 1, 0]


def test_view_without_features_is_not_selected(rig: Rig) -> None:
    kept = [
        make_frame(rig, 0, make_rotated(5.0), without_features=(1,)),
        make_frame(rig, 1, make_rotated(6.0)),
        make_frame(rig, 2, make_rotated(8.0), without_features=(0,)),
    ]
    here = compute_viewpoints(rig, make_rotated(0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [indices(select_references(kept, c, here[c])) for c in range(3)] == [[0], [1], [0]]
        assert [indices(find_nearest_views(kept, c, here[c], 5)) for c in range(3)] == [[0, 1], [1, 2], [0, 1, 2]]
        nowhere = [make_frame(rig, 0, make_rotated(0.0), without_features=(0, 1, 2))]
        assert select_references(nowhere, 0, here[0]) == find_nearest_views(nowhere, 0, here[0], 5) == []


@given(turns=st.lists(st.floats(-180, 180), max_size=30), here=st.floats(-180, 180))
def test_references_are_few_near_and_oldest(turns: list[float], here: float) -> None:
    rig = ring(2, 1.5, target=START.translation)
    kept = make_frames(rig, *turns)
    viewpoint = compute_viewpoints(rig, make_rotated(here))[0]
    chosen = select_references(kept, 0, viewpoint)
    assert len(chosen) <= len(RING_ANGLES) - 1
    assert len(set(indices(chosen))) == len(chosen)
    apart = np.array([angle(k.viewpoints[0], viewpoint) for k in kept])
    for reference in chosen:
        mine = apart[reference.number]
        assert mine < RING_ANGLES[-1] + 1e-9
        if np.abs(np.subtract(RING_ANGLES, mine)).min() < 2e-4:  # on the border of two rings: either
            continue
        older = apart[: reference.number]
        inside = int(np.searchsorted(RING_ANGLES, mine, side="right"))
        # A hundredth of a degree for views on the border of two rings.
        clear = (older > RING_ANGLES[inside - 1] + 2e-4) & (
            older < RING_ANGLES[min(inside, len(RING_ANGLES) - 1)] - 2e-4
        )
        assert not clear.any()
    # A reference is selected whenever a view is near, and only then; on the border either may be.
    assert bool(chosen) >= bool((apart < RING_ANGLES[-1] - 1e-9).any())
    assert bool(chosen) <= bool((apart < RING_ANGLES[-1] + 1e-9).any())


def test_nearest_views_are_sorted_with_older_first(rig: Rig) -> None:
    kept = make_frames(rig, 40, 10, -20, 10, 0)
    here = compute_viewpoints(rig, make_rotated(2.0))[2]
    assert indices(find_nearest_views(kept, 2, here, 4)) == [4, 1, 3, 2]
    assert indices(find_nearest_views(kept, 2, here, 50)) == [4, 1, 3, 2, 0]
    assert find_nearest_views(kept, 2, here, 0) == []
    assert find_nearest_views([], 2, here, 3) == []


# --- creation and removal


def test_new_side_makes_keyframe(rig: Rig) -> None:
    kept: list[SolvedFrame] = []
    limit = float(np.degrees(DEFAULTS.min_keyframe_rotation))
    assert try_keyframe(kept, make_frame(rig, 0, make_rotated(0.0)))
    assert not try_keyframe(kept, make_frame(rig, 1, make_rotated(0.9 * limit)))
    assert try_keyframe(kept, make_frame(rig, 2, make_rotated(1.1 * limit)))
    assert not try_keyframe(kept, make_frame(rig, 3, make_rotated(0.0)))
    assert not try_keyframe(kept, make_frame(rig, 4, make_rotated(-0.9 * limit)))
    assert indices(kept) == [0, 2]


def test_new_distance_makes_keyframe(rig: Rig) -> None:
    camera = rig.subset(["cam_0"])
    towards = START.translation - camera.cameras[0].center

    def at(factor: float) -> RigidTransform:
        return RigidTransform.from_components(camera.cameras[0].center + factor * towards, START.rotation)

    kept = [make_frame(camera, 0, at(1.0))]
    assert not try_keyframe(kept, make_frame(camera, 1, at(0.98 * MIN_KEYFRAME_SCALE)))
    assert not try_keyframe(kept, make_frame(camera, 2, at(1.02 / MIN_KEYFRAME_SCALE)))
    assert try_keyframe(kept, make_frame(camera, 3, at(1.02 * MIN_KEYFRAME_SCALE)))
    assert try_keyframe(kept, make_frame(camera, 4, at(0.98 / MIN_KEYFRAME_SCALE)))


def test_majority_of_cameras_decides(rig: Rig) -> None:
    first = make_frame(rig, 0, make_rotated(0.0), without_features=(1, 2))
    # New to two of three; one of two is no majority; cameras without features do not count.
    assert try_keyframe([first], make_frame(rig, 1, make_rotated(1.0)))
    assert not try_keyframe([first], make_frame(rig, 1, make_rotated(1.0), without_features=(2,)))
    assert try_keyframe([first], make_frame(rig, 1, make_rotated(1.0), without_features=(0,)))
    assert not try_keyframe([first], make_frame(rig, 1, make_rotated(90.0), without_features=(0, 1, 2)))


def test_rotation_about_viewing_ray_is_not_new_side() -> None:
    """The camera has the same view, rolled, to which its features are invariant."""
    rig = ring(1, 1.5, target=START.translation)
    kept = [make_frame(rig, 0, make_rotated(0.0))]
    assert not try_keyframe(kept, make_frame(rig, 1, make_rotated(90.0, rig.cameras[0].direction)))


def test_cameras_without_features_give_no_warning(rig: Rig) -> None:
    kept: list[SolvedFrame] = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for k in range(40):
            try_keyframe(
                kept, make_frame(rig, k, make_rotated(9.0 * k), without_features=((), (0,), (1, 2), (0, 1, 2))[k % 4])
            )
    assert not any(k.number % 4 == 3 for k in kept)  # those have no features


def test_most_redundant_keyframe_is_removed(rig: Rig) -> None:
    options = TrackingOptions(max_keyframes=4)
    kept = make_frames(rig, 0, 40, 80, 93)
    assert try_keyframe(kept, make_frame(rig, 4, make_rotated(120.0)), options)
    assert indices(kept) == [0, 1, 2, 4]  # 80 and 93 were most similar
    # The newest itself, if it is redundant: then no other is removed.
    try_keyframe(kept, make_frame(rig, 5, make_rotated(50.0)), options)
    assert indices(kept) == [0, 1, 2, 4]
    # The first one stays, even if another is similar.
    try_keyframe(kept, make_frame(rig, 6, make_rotated(-7.0)), options)
    assert indices(kept) == [0, 1, 2, 4]


def test_number_of_keyframes_is_bounded_and_first_kept(rig: Rig) -> None:
    rng = np.random.default_rng(0)
    kept: list[SolvedFrame] = []
    turns = Rotation.random(2 * DEFAULTS.max_keyframes, rng=rng)
    for k, turn in enumerate(turns):
        pose = RigidTransform.from_components(START.translation, turn * START.rotation)
        try_keyframe(kept, make_frame(rig, k, pose))
        assert len(kept) <= DEFAULTS.max_keyframes
    assert len(kept) == DEFAULTS.max_keyframes
    assert kept[0].number == 0
    assert indices(kept) == sorted(indices(kept))


@given(
    steps=st.lists(st.tuples(st.floats(-20, 20), st.sampled_from([0, 1, 2])), min_size=1, max_size=40),
    most=st.integers(3, 100),
)
def test_every_view_stays_covered(steps: list[tuple[float, int]], most: int) -> None:
    """Unless there are too many, each solved frame has a keyframe within the limit angle in half of the cameras.

    The first one and the order stay in any case.
    """
    rig = ring(3, 1.5, target=START.translation)
    kept: list[SolvedFrame] = []
    pose, met = START, []
    options = TrackingOptions(max_keyframes=most)
    for k, (degrees, axis) in enumerate(steps):
        turn = Rotation.from_rotvec(np.radians(degrees) * np.eye(3)[axis])
        pose = RigidTransform.from_components(pose.translation, turn * pose.rotation)
        met.append(make_frame(rig, k, pose))
        try_keyframe(kept, met[-1], options)
        assert len(kept) <= most
        assert kept[0] is met[0]
        assert indices(kept) == sorted(set(indices(kept)))
    if len(kept) < most:
        for current in met:
            near = [
                min(angle(current.viewpoints[c], k.viewpoints[c]) for k in kept) < DEFAULTS.min_keyframe_rotation + 1e-6
                for c in range(3)
            ]
            assert sum(near) >= 2
