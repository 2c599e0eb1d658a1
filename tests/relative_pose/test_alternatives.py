"""Checks of weakly observed motions: self-consistency, planes, and distant equally likely motions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.honesty import compare_with_truth, solve
from benchmarks.honesty_kinds import make_problem
from sylpose.relative_pose.irls import IrlsFit, make_empty_irls_fit, make_irls_start, run_constrained_irls, run_irls
from sylpose.relative_pose.limits import SIGMA_FLOOR_PX
from sylpose.relative_pose.planes import fit_edge_on, triangulate_planes
from sylpose.relative_pose.robust_fit import RefinedMinima
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.terms import Stack, TermData, locate_object, stack_terms
from sylpose.relative_pose.uncertainty import (
    MAX_INCLUDED_SQUARE,
    compute_freedom,
    compute_square_root,
    displace_along_weak_direction,
    inflate,
    inflate_covariance,
    list_other_minima,
)
from sylpose.simulate import arc, plane, random_motion, simulate_matches
from sylpose.status import Status
from tests.scenes import make_terms


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
        ("two cameras, flat", 7040),  # the plane is seen edge on
        ("narrow, flat", 7078),
        ("two cameras, flat, wrong 30 to 50 %", 9022),  # an alternative is less certain than the motion
        ("narrow, flat", 9027),  # depends on how curved the surface is assumed to be
        ("two opposite, flat", 9127),  # the rays meet far from the object
        ("two opposite, flat", 7010),
        ("copies, few", 9017),  # few degrees of freedom
        ("two opposite, flat", 9909),  # the other minimum is found from more rotations
        ("two cameras, flat", 20012),  # as likely along the weakest direction
        ("all wrong", 9915),  # permuted matches show no motion at all
        ("all wrong", 10006),  # a minority of inliers
        ("x to the left", 9917),  # two kinds of axes explain the contradiction
    ],
)
def test_weakly_observed_motion_is_not_overconfident(kind: str, number: int) -> None:
    """Regression: each was off by 3 to 16 degrees, or by a comparable translation, with a small covariance."""
    problem = make_problem(kind, number)
    assert not compare_with_truth(problem, solve(problem)).wrong


def test_axes_of_pixels_explain_more_than_removed_cameras() -> None:
    """Three of eight cameras would be removed, as two kinds of axes reduce the contradiction."""
    motion = solve(make_problem("x to the left", 9917))
    assert motion.status is Status.NOT_CONSISTENT
    assert "to the left" in motion.faults[0]


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.03, -0.05), (0.6, -0.5)])
def test_planes_are_triangulated_exactly(slopes: tuple[float, float]) -> None:
    stack, found = fit_from_truth("two cameras", 1)
    found.weights[:] = 1.0
    planes = np.array([[1.0 + 0.02 * t, *slopes, 0.0, 0.0, 0.0] for t in range(2)])
    for t in range(2):
        match = slice(stack.offsets[t], stack.offsets[t + 1])
        x = stack.x[match]
        inverse_depth = stack.inverse_depth[t] * (planes[t, 0] + (x - stack.anchor[t]) / stack.spread[t] @ slopes)
        turned = stack.qy[t] @ found.candidate.rotation
        tau = turned @ stack.a1[t] + stack.qy[t] @ (found.candidate.translation - stack.a2[t])
        y = np.column_stack([x, np.ones(len(x))]) @ (turned @ stack.qx[t].T).T + np.outer(inverse_depth, tau)
        stack.y[match] = y[:, :2] / y[:, 2:]
    # Without noise, so that priors have no weight.
    exact = stack._replace(residual_depth=np.full(2, 1e-9))
    found.sigma_px[:] = 1e-6
    result, before = np.empty((2, 6)), found.candidate.depth_model[:, 1:3]
    change = triangulate_planes(exact, found, result)
    np.testing.assert_allclose(result, planes, atol=1e-6)
    prior_sd = 1.0 / np.sqrt(stack.depth_model_information[:, [1, 2], [1, 2]])
    assert change == pytest.approx(np.max(np.abs(planes[:, 1:3] - before) / prior_sd), rel=1e-3)


def test_planes_without_inliers_are_the_prior() -> None:
    stack, found = fit_from_truth("two cameras", 1)
    found.weights[:] = 0.0
    result = np.empty((2, 6))
    assert triangulate_planes(stack, found, result) == 0.0
    np.testing.assert_array_equal(result, stack.depth_model_mean)


@pytest.mark.parametrize("kind", ["two cameras", "two opposite, flat", "flat"])
def test_covariance_has_a_square_root(kind: str) -> None:
    _, found = fit_from_truth(kind, 1)
    root = compute_square_root(found.information, 0.2)
    np.testing.assert_allclose(root @ root.T @ found.information, np.eye(6), atol=1e-6)
    assert compute_square_root(np.zeros((6, 6)), 0.2).shape == (6, 0)


def test_square_root_does_not_depend_on_units() -> None:
    """Unobservable directions are bounded relative to the others."""
    in_m = np.diag([0.0, 40.0, 50.0, 1000.0, 900.0, 0.0])
    to_mm = np.array([1.0, 1.0, 1.0, 1e3, 1e3, 1e3])
    root = compute_square_root(in_m / np.outer(to_mm, to_mm), 200.0)
    covariance = root @ root.T / np.outer(to_mm, to_mm)
    expected = compute_square_root(in_m, 0.2)
    np.testing.assert_allclose(covariance, expected @ expected.T, rtol=1e-9)
    assert np.isfinite(covariance).all()


def test_plane_seen_edge_on_is_fitted() -> None:
    """From prior depths the motion is right, but the plane a rough surface."""
    stack, found = fit_from_truth("two cameras, flat", 7040)
    usable = np.ones(len(stack.x))
    start = found.candidate._replace(depth_model=stack.depth_model_mean)
    rough = make_irls_start(stack, start, found.sigma_px)
    _, _, cost = run_irls(stack, usable, rough, SIGMA_FLOOR_PX)
    steep = make_irls_start(stack, start, found.sigma_px)
    _, _, new_cost = fit_edge_on(stack, usable, steep, True)
    assert new_cost < cost - 50.0
    assert np.abs(steep.candidate.depth_model[0, 1:3]).min() > 5.0 * np.abs(rough.candidate.depth_model[0, 1:3]).max()
    # Where the surface faces the cameras, nothing changes.
    stack, found = fit_from_truth("two cameras", 1)
    again = make_irls_start(stack, found.candidate, found.sigma_px)
    _, _, same_cost = fit_edge_on(stack, np.ones(len(stack.x)), again, True)
    assert again.candidate.rotation == pytest.approx(found.candidate.rotation, abs=1e-3)
    assert np.isfinite(same_cost)


def test_freedom_is_what_motion_and_planes_leave() -> None:
    stack, found = fit_from_truth("two cameras", 1)
    first = int(stack.offsets[1])
    found.weights[:] = 0.0
    assert compute_freedom(stack, found) == 1.0
    found.weights[:10] = 0.5
    assert compute_freedom(stack, found) == pytest.approx((20 - 6 - 3) / 20)
    found.weights[first : first + 2] = 1.0
    assert compute_freedom(stack, found) == pytest.approx((24 - 6 - 3 - 2) / 24)
    with_empty = stack._replace(offsets=np.insert(stack.offsets, [0, 1, 2], [0, first, len(stack.x)]))
    assert compute_freedom(with_empty, found) == compute_freedom(stack, found)  # also with terms without matches
    found.weights[3:] = 0.0
    assert compute_freedom(stack, found) == pytest.approx(1 / 6)


@pytest.mark.parametrize(("kind", "number"), [("two opposite, flat", 9127), ("two opposite", 9008)])
def test_motion_between_opposite_cameras_is_found(kind: str, number: int) -> None:
    """Regression: their rays met several radii from the object."""
    outcome = compare_with_truth(problem := make_problem(kind, number), solve(problem))
    assert outcome.status is Status.OK
    assert outcome.degrees < 2.0
    assert outcome.nees < 20.0


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


def test_one_of_two_motions_of_a_plane_is_right() -> None:
    """Two cameras close together see two minima: without perspective, of a plane and of its second plane."""
    rig, errors, ambiguous = arc(2, 10.0, 2.5), [], 0
    for seed in range(24):
        rng = np.random.default_rng(seed)
        motion = random_motion(8.0, 0.01, rng)
        tilt = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3))
        facing, _ = Rotation.align_vectors([np.mean([camera.center for camera in rig], axis=0)], [[0.0, 0.0, 1.0]])
        start = RigidTransform.from_rotation(tilt * facing)
        pair = simulate_matches(rig, plane((0.3, 0.3)), motion, rng=rng, noise_px=0.3, start=start)
        data = make_terms(rig, pair.matches)
        fit = fit_terms(data, *locate_object(data), [], rng)
        found = [fit.rotation] if fit.alternative is None else [fit.rotation, fit.alternative[0]]
        ambiguous += len(found) - 1
        errors.append(np.degrees((Rotation.from_matrix(found) * motion.rotation.inv()).magnitude()).min())
    assert ambiguous > 8
    assert np.median(errors) < 2.0
    assert np.max(errors) < 6.0


def test_minima_are_listed_once() -> None:
    _, found = fit_from_truth("two cameras", 1)
    R, d, _ = found.candidate
    away = Rotation.from_rotvec([0.0, 0.3, 0.0]).as_matrix() @ R
    minima = RefinedMinima(
        np.stack([away, R, away, R]), np.stack([d, d, d, d + 0.5]), np.array([3.0, 1.0, 4.0, np.inf]), np.full(4, 50.0)
    )
    listed = list_other_minima(found, minima)
    assert len(listed) == 1
    np.testing.assert_array_equal(listed[0][0], away)


@pytest.mark.parametrize("loss", [-3.0, 0.0, 20.0])
def test_covariance_is_inflated_to_a_displaced_motion(loss: float) -> None:
    """Its squared distance becomes twice the loss, or what chance allows; a large covariance remains."""
    _, found = fit_from_truth("two cameras", 1)
    target = max(2.0 * loss, MAX_INCLUDED_SQUARE)
    for share in (0.9, 1.1, 30.0):
        step = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
        step *= np.sqrt(share * target / (step @ found.information @ step))
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ found.candidate.rotation
        displaced = found.candidate._replace(rotation=rotation)
        column = inflate_covariance(found.information, found, displaced, loss)
        inflated = inflate(found.information, column)
        assert float(step @ inflated @ step) == pytest.approx(min(share, 1.0) * target, rel=1e-6)
        assert column.shape[1] == (share > 1.0)


def test_displaced_motions_are_minima_across_the_weakest_direction() -> None:
    stack, found = fit_from_truth("narrow", 3)
    usable = np.ones(len(stack.x))
    displaced = displace_along_weak_direction(stack, usable, found, 0.15)
    _, _, cost = run_irls(stack, usable, make_irls_start(stack, found.candidate, found.sigma_px), SIGMA_FLOOR_PX)
    assert len(displaced) == 2
    assert all(c > cost - 1.0 for _, c in displaced)
    assert (
        displace_along_weak_direction(*fit_from_truth("solid", 1)[:1], usable, fit_from_truth("solid", 1)[1], 0.15)
        == []
    )


def test_inflation_adds_to_the_covariance() -> None:
    rng = np.random.default_rng(0)
    root, columns = rng.normal(size=(6, 6)), rng.normal(size=(6, 2))
    information = root @ root.T
    expected = np.linalg.inv(np.linalg.inv(information) + columns @ columns.T)
    np.testing.assert_allclose(inflate(information, columns), expected, rtol=1e-9, atol=1e-9)
    # So it does where a direction has no information.
    information[:, 0] = information[0, :] = 0.0
    assert np.all(np.linalg.eigvalsh(information - inflate(information, columns)) > -1e-9)
    assert inflate(information, np.empty((6, 0))) is information
