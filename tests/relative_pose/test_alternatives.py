"""What is asked of a motion that is hardly seen: whether it leads to itself, what is as likely far along its valley, and
what second planes say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.honesty import judge, solve
from benchmarks.honesty_kinds import make_problem
from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.alternative_solutions import second_planes
from sylpose.relative_pose.curvature_correction import NEAR, TOO_SMALL, less_certain, taken_in
from sylpose.relative_pose.irls import SIGMA_FLOOR_PX, Reweighted, nothing_yet, reweight, reweight_held
from sylpose.relative_pose.terms import Stack, TermData, object_place, stack_terms


def fitted_to_truth(kind: str, number: int) -> tuple[Stack, Reweighted]:
    """A scene of two cameras, and where its true motion leads to."""
    problem = make_problem(kind, number)
    terms = [
        TermData(c, m.x, m.y, camera.rotation, camera.center, camera.focal)
        for c, (camera, m) in enumerate(zip(problem.rig, problem.matches, strict=True))
    ]
    center, radius = object_place(terms)
    stack = stack_terms(terms, center, radius)
    found = nothing_yet(stack)
    truth = problem.truths[0]
    found.candidate.rotation[:], found.candidate.shift[:] = truth.rotation.as_matrix(), truth.apply(center) - center
    reweight(stack, np.ones(len(stack.x)), found, SIGMA_FLOOR_PX)
    return stack, found


@pytest.mark.parametrize(
    ("kind", "number"),
    [
        ("solid, unequal, wrong 30 to 60 %", 100064),  # does not lead to itself
        ("few, wrong 30 to 60 %", 100014),
        ("two opposite, flat", 100176),  # second planes are likelier
        ("slab", 100019),
        ("two opposite, wrong 30 to 60 %", 100160),
        ("second 20 to 60 %, two cameras", 100195),  # neighbours are off alike
        ("narrow", 100177),  # as likely far along the valley
        ("narrow, wrong 30 to 60 %", 100008),
    ],
)
def test_what_is_hardly_seen_is_not_wrong_and_sure(kind: str, number: int) -> None:
    """Each was, by 3 to 16 degrees or as much of a displacement."""
    problem = make_problem(kind, number)
    assert not judge(problem, solve(problem)).wrong


@pytest.mark.parametrize("direction", range(6))
def test_what_is_held_stays(direction: int) -> None:
    stack, found = fitted_to_truth("two cameras", 1)
    again, held = nothing_yet(stack), np.eye(6)[direction]
    away = np.radians(3.0) if direction < 3 else 0.01
    turn = Rotation.from_rotvec(away * held[:3]).as_matrix()
    again.candidate.rotation[:] = turn @ found.candidate.rotation
    again.candidate.shift[:] = found.candidate.shift + away * held[3:]
    again.sigma_px[:] = found.sigma_px
    before = again.candidate.rotation.copy(), again.candidate.shift.copy()
    _, _, cost = reweight_held(stack, np.ones(len(stack.x)), again, SIGMA_FLOOR_PX, held)
    moved = np.append(
        Rotation.from_matrix(again.candidate.rotation @ before[0].T).as_rotvec(), again.candidate.shift - before[1]
    )
    # Steps compose, so that a turn about a held axis is one to second order.
    assert abs(moved[direction]) < (2e-3 if direction < 3 else 1e-6)
    assert np.abs(moved).max() > 1e-3
    free = nothing_yet(stack)
    free.candidate.rotation[:], free.candidate.shift[:] = before
    free.sigma_px[:] = found.sigma_px
    assert reweight(stack, np.ones(len(stack.x)), free, SIGMA_FLOOR_PX)[2] < cost


@pytest.mark.parametrize("dearer", [-3.0, 0.0, 20.0])
def test_a_covariance_takes_in_what_it_is_much_too_small_for(dearer: float) -> None:
    root = np.random.default_rng(0).normal(size=(6, 6))
    information, most = root @ root.T, max(2.0 * dearer, NEAR**2)

    def squared(share: float) -> tuple[float, int]:
        step: FloatArray = np.arange(1.0, 7.0)
        step *= np.sqrt(share * TOO_SMALL * most / (step @ information @ step))
        column = taken_in(information, step, dearer)
        less = less_certain(information, column)
        assert np.linalg.eigvalsh(information - less).min() > -1e-9
        return float(step @ less @ step), column.shape[1]

    np.testing.assert_allclose(squared(1.01), (most, 1))
    np.testing.assert_allclose(squared(0.99), (0.99 * TOO_SMALL * most, 0))


def plane_of(stack: Stack, t: int, surface: FloatArray) -> FloatArray:
    """(4,) the plane of term t's surface as n'X = m, world axes about g, of unit length and any sign."""
    slopes = surface[1:3] / stack.spread[t]
    normal = stack.inverse_depth[t] * np.append(slopes, surface[0] - slopes @ stack.anchor[t])
    world = stack.qx[t].T @ normal
    plane = np.append(world, 1.0 + world @ stack.a1[t])
    return np.asarray(plane / np.linalg.norm(plane))


def test_a_second_plane_maps_images_alike_and_is_one_for_all_cameras() -> None:
    stack, found = fitted_to_truth("two cameras, flat", 3)
    assert second_planes(*fitted_to_truth("two cameras", 3)) == []
    # Exactly flat.
    found.candidate.surface[:, 3:], found.relief[:] = 0.0, 0.0
    planes = second_planes(stack, found)
    assert len(planes) == 2
    for t, other in enumerate(planes):
        maps = []
        for rotation, shift, surface in (found.candidate, other):
            slopes = surface[t, 1:3] / stack.spread[t]
            normal = stack.inverse_depth[t] * np.append(slopes, surface[t, 0] - slopes @ stack.anchor[t])
            tau = stack.qy[t] @ (rotation @ stack.a1[t] - stack.a2[t] + shift)
            maps.append(stack.qy[t] @ rotation @ stack.qx[t].T + np.outer(tau, normal))
        first, second = (m / np.linalg.norm(m) for m in maps)
        np.testing.assert_allclose(second, first, atol=1e-9)
        # It is another one,
        assert np.degrees(Rotation.from_matrix(other.rotation @ found.candidate.rotation.T).magnitude()) > 0.5
        # and the same for both cameras.
        one, same = (plane_of(stack, k, other.surface[k]) for k in range(2))
        np.testing.assert_allclose(np.outer(one, one), np.outer(same, same), atol=1e-9)
