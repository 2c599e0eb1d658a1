"""Checks of weakly observed motions: self-consistency, distant equally likely motions, and second planes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.honesty import compare_with_truth, solve
from benchmarks.honesty_kinds import make_problem
from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.irls import IrlsFit, make_empty_irls_fit, run_constrained_irls, run_irls
from sylpose.relative_pose.limits import SIGMA_FLOOR_PX
from sylpose.relative_pose.terms import Stack, TermData, locate_object, stack_terms
from sylpose.relative_pose.uncertainty import (
    MAX_INCLUDED_SIGMAS,
    MIN_VARIANCE_DEFICIT,
    compute_second_planes,
    inflate,
    inflate_covariance,
)


def fit_from_truth(kind: str, number: int) -> tuple[Stack, IrlsFit]:
    """Return a two-camera scene and the fit that starts from its true motion."""
    problem = make_problem(kind, number)
    terms = [
        TermData(c, m.x, m.y, camera.rotation, camera.center, camera.focal)
        for c, (camera, m) in enumerate(zip(problem.rig, problem.matches, strict=True))
    ]
    center, radius = locate_object(terms)
    stack = stack_terms(terms, center, radius)
    found = make_empty_irls_fit(stack)
    truth = problem.truths[0]
    found.candidate.rotation[:], found.candidate.translation[:] = (
        truth.rotation.as_matrix(),
        truth.apply(center) - center,
    )
    run_irls(stack, np.ones(len(stack.x)), found, SIGMA_FLOOR_PX)
    return stack, found


@pytest.mark.parametrize(
    ("kind", "number"),
    [
        ("solid, unequal, wrong 30 to 60 %", 100064),  # does not converge to itself
        ("few, wrong 30 to 60 %", 100014),
        ("two opposite, flat", 100176),  # second planes are likelier
        ("slab", 100019),
        ("two opposite, wrong 30 to 60 %", 100160),
        ("second 20 to 60 %, two cameras", 100195),  # correlated neighbors
        ("narrow", 100177),  # as likely far along the valley
        ("narrow, wrong 30 to 60 %", 100008),
    ],
)
def test_weakly_observed_motion_is_not_overconfident(kind: str, number: int) -> None:
    """Regression: each was off by 3 to 16 degrees, or by a comparable translation, with a small covariance."""
    problem = make_problem(kind, number)
    assert not compare_with_truth(problem, solve(problem)).wrong


@pytest.mark.parametrize("direction", range(6))
def test_constraint_is_kept(direction: int) -> None:
    stack, found = fit_from_truth("two cameras", 1)
    again, constraint = make_empty_irls_fit(stack), np.eye(6)[direction]
    away = np.radians(3.0) if direction < 3 else 0.01
    rotation = Rotation.from_rotvec(away * constraint[:3]).as_matrix()
    again.candidate.rotation[:] = rotation @ found.candidate.rotation
    again.candidate.translation[:] = found.candidate.translation + away * constraint[3:]
    again.sigma_px[:] = found.sigma_px
    before = again.candidate.rotation.copy(), again.candidate.translation.copy()
    _, _, cost = run_constrained_irls(stack, np.ones(len(stack.x)), again, SIGMA_FLOOR_PX, constraint)
    moved = np.append(
        Rotation.from_matrix(again.candidate.rotation @ before[0].T).as_rotvec(),
        again.candidate.translation - before[1],
    )
    # Steps compose, so a rotation about a constrained axis may change to second order.
    assert abs(moved[direction]) < (2e-3 if direction < 3 else 1e-6)
    assert np.abs(moved).max() > 1e-3
    free = make_empty_irls_fit(stack)
    free.candidate.rotation[:], free.candidate.translation[:] = before
    free.sigma_px[:] = found.sigma_px
    assert run_irls(stack, np.ones(len(stack.x)), free, SIGMA_FLOOR_PX)[2] < cost


@pytest.mark.parametrize("dearer", [-3.0, 0.0, 20.0])
def test_covariance_is_inflated_only_if_much_too_small(dearer: float) -> None:
    root = np.random.default_rng(0).normal(size=(6, 6))
    information, most = root @ root.T, max(2.0 * dearer, MAX_INCLUDED_SIGMAS**2)

    def squared(share: float) -> tuple[float, int]:
        step: FloatArray = np.arange(1.0, 7.0)
        step *= np.sqrt(share * MIN_VARIANCE_DEFICIT * most / (step @ information @ step))
        column = inflate_covariance(information, step, dearer)
        less = inflate(information, column)
        assert np.linalg.eigvalsh(information - less).min() > -1e-9
        return float(step @ less @ step), column.shape[1]

    np.testing.assert_allclose(squared(1.01), (most, 1))
    np.testing.assert_allclose(squared(0.99), (0.99 * MIN_VARIANCE_DEFICIT * most, 0))


def compute_plane(stack: Stack, t: int, depth_model: FloatArray) -> FloatArray:
    """Return (4,) the plane of term t's depth model as n'X = m, world axes about g, of unit length and any sign."""
    slopes = depth_model[1:3] / stack.spread[t]
    normal = stack.inverse_depth[t] * np.append(slopes, depth_model[0] - slopes @ stack.anchor[t])
    world = stack.qx[t].T @ normal
    plane = np.append(world, 1.0 + world @ stack.a1[t])
    return np.asarray(plane / np.linalg.norm(plane))


def test_second_plane_gives_the_same_homography() -> None:
    stack, found = fit_from_truth("two cameras, flat", 3)
    assert compute_second_planes(*fit_from_truth("two cameras", 3)) == []
    # Exactly flat.
    found.candidate.depth_model[:, 3:], found.residual_depth[:] = 0.0, 0.0
    planes = compute_second_planes(stack, found)
    assert len(planes) == 2
    for t, other in enumerate(planes):
        maps = []
        for rotation, translation, depth_model in (found.candidate, other):
            slopes = depth_model[t, 1:3] / stack.spread[t]
            normal = stack.inverse_depth[t] * np.append(slopes, depth_model[t, 0] - slopes @ stack.anchor[t])
            tau = stack.qy[t] @ (rotation @ stack.a1[t] - stack.a2[t] + translation)
            maps.append(stack.qy[t] @ rotation @ stack.qx[t].T + np.outer(tau, normal))
        first, second = (m / np.linalg.norm(m) for m in maps)
        np.testing.assert_allclose(second, first, atol=1e-9)
        # The motion differs,
        assert np.degrees(Rotation.from_matrix(other.rotation @ found.candidate.rotation.T).magnitude()) > 0.5
        # but the plane is the same for both cameras.
        one, same = (compute_plane(stack, k, other.depth_model[k]) for k in range(2))
        np.testing.assert_allclose(np.outer(one, one), np.outer(same, same), atol=1e-9)
