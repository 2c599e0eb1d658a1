"""Reprojection errors of matches and their normal equations: reference implementation, derivatives, noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.limits import CUTOFF
from sylpose.relative_pose.match_cost import MatchEquations, Tolerance
from sylpose.relative_pose.terms import DEPTH_MODEL_SIZE, Candidate, Stack, locate_object, stack_terms
from sylpose.rig import Rig
from sylpose.simulate import Body, SimulatedPair, random_motion, simulate_matches
from tests.relative_pose.match_errors import compute_match_errors
from tests.scenes import BODY, get_true_motion, make_candidate, make_terms, make_zigzag_rig


def make_scene(
    seed: int, rig: Rig, turn: float = 5.0, body: Body = BODY, **options: object
) -> tuple[SimulatedPair, Stack, FloatArray]:
    """Return matches, their stacked terms, and the object's center."""
    rng = np.random.default_rng(seed)
    pair = simulate_matches(rig, body, random_motion(turn, 0.02, rng), rng=rng, **options)  # type: ignore[arg-type]
    data = make_terms(rig, pair.matches)
    center, radius = locate_object(data)
    return pair, stack_terms(data, center, radius), center


def project_point(
    stack: Stack,
    t: int,
    x: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    alpha: FloatArray,
    depth_offset: float = 0.0,
) -> FloatArray:
    """Return (2,) the prediction of the point x (2,) in the current frame by the depth model α.

    `depth_offset`: inverse depth added, in units of g's.
    """
    p, q = (x - stack.anchor[t]) / stack.spread[t]
    rho = stack.inverse_depth[t] * (alpha @ np.array([1, p, q, p * p, p * q, q * q]) + depth_offset)
    ray = stack.qx[t].T @ np.append(x, 1.0)
    seen = stack.qy[t] @ (rotation @ (ray + rho * stack.a1[t]) + rho * (translation - stack.a2[t]))
    return np.asarray(seen[:2] / seen[2])


def differentiate(function: Callable[[FloatArray], FloatArray], size: int, step: float = 1e-6) -> FloatArray:
    """Return (m, size) central differences at zero."""
    return np.column_stack([(function(s) - function(-s)) / (2 * step) for s in step * np.eye(size)])


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_equations_equal_a_loop_over_matches(seed: int) -> None:
    rng, rig = np.random.default_rng(seed), make_zigzag_rig(2)
    pair, stack, center = make_scene(seed, rig, 8.0, per_camera=12)
    if seed % 2:
        known = random_motion(8.0, 0.05, rng)
        data = [replace(term, start_from_reference=known) for term in make_terms(rig, pair.matches)]
        center = np.asarray(known.apply(center))
        stack = stack_terms(data, center, 0.15)
    t, n = 1, len(stack.x)
    rotation, translation = random_motion(6.0, 0.0, rng).rotation.as_matrix(), 0.02 * rng.standard_normal(3)
    spread = 1.0 / np.sqrt(np.diag(stack.depth_model_information[t]))
    alpha = stack.depth_model_mean[t] + 0.5 * spread * rng.uniform(-1, 1, DEPTH_MODEL_SIZE)
    variance, residual_depth, shared = (
        float((3.0 / stack.focal[t]) ** 2),
        0.7 * stack.residual_depth[t],
        1.3 * stack.residual_depth[t],
    )
    cutoff, usable = 20.0, rng.random(n) > 0.2
    there = make_candidate(stack, t, rotation, translation, alpha)
    matches, found = compute_match_errors(stack, t, there, Tolerance(variance, residual_depth, shared, cutoff), usable)
    distance, across, along, parallax, weights = matches
    matrix, right = found.matrix, found.right
    expected, expected_right = np.zeros((12, 12)), np.zeros(12)
    for k, i in enumerate(range(stack.offsets[t], stack.offsets[t + 1])):
        x = stack.x[i]
        e = stack.y[i] - project_point(stack, t, x, rotation, translation, alpha)
        by_x = differentiate(partial(lambda x, s: project_point(stack, t, x + s, rotation, translation, alpha), x), 2)
        by_depth = differentiate(
            partial(lambda x, s: project_point(stack, t, x, rotation, translation, alpha, s[0]), x), 1
        )[:, 0]
        b = by_depth / np.linalg.norm(by_depth)
        normal = np.array([-b[1], b[0]])
        both = np.eye(2) + by_x @ by_x.T
        noise_n, noise_b = normal @ both @ normal, b @ both @ b
        spare = (residual_depth * np.linalg.norm(by_depth)) ** 2
        d2 = (normal @ e) ** 2 / (variance * noise_n) + (b @ e) ** 2 / (variance * noise_b + spare)
        w = max(1 - d2 / cutoff**2, 0.0) ** 2 if usable[i] else 0.0
        assert across[k] == pytest.approx(normal @ e / np.sqrt(noise_n), rel=1e-5, abs=1e-9)
        assert along[k] == pytest.approx(b @ e / np.sqrt(noise_b), rel=1e-5, abs=1e-9)
        assert parallax[k] == pytest.approx(np.linalg.norm(by_depth) / np.sqrt(noise_b), rel=1e-5)
        assert distance[k] == pytest.approx(d2, rel=1e-4)
        assert weights[k] == pytest.approx(w, rel=1e-4, abs=1e-9)

        def by_all(nearer: float, x: FloatArray = x) -> FloatArray:
            """Return (2, 12) derivatives by (w, d), in the camera's axes, and α."""

            def moved(s: FloatArray) -> FloatArray:
                to_world = stack.qy[t].T
                turned = Rotation.from_rotvec(to_world @ s[:3]).as_matrix() @ rotation
                return project_point(stack, t, x, turned, translation + to_world @ s[3:6], alpha + s[6:], nearer)

            return differentiate(moved, 12)

        row = b @ by_all(0.0)
        w_along = w / (variance * noise_b + (shared * np.linalg.norm(by_depth)) ** 2)
        expected += w_along * np.outer(row, row)
        expected_right += w_along * row * (b @ e)
        # Across the line: the match's own depth, as far as it exceeds the noise.
        p, q = (x - stack.anchor[t]) / stack.spread[t]
        rho = alpha @ np.array([1, p, q, p * p, p * q, q * q])
        further = spare / (variance * noise_b + spare) * (b @ e) / np.linalg.norm(by_depth)
        row = normal @ by_all(float(np.clip(further, -0.5 * rho, 2.0 * rho)))[:, :6]
        expected[:6, :6] += w / (variance * noise_n) * np.outer(row, row)
        expected_right[:6] += w / (variance * noise_n) * row * (normal @ e)
    below = np.tril(np.ones((12, 12), bool))
    units = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        (matrix / units / units[:, None])[below], (expected / units / units[:, None])[below], atol=1e-4
    )
    size = np.abs(expected_right / units).max()
    np.testing.assert_allclose(right / units / size, expected_right / units / size, atol=1e-4)


def test_point_behind_the_camera_has_infinite_distance() -> None:
    _, stack, _ = make_scene(0, make_zigzag_rig(2))
    through = -3.0 * stack.qy[0, 2]
    there = Candidate(np.eye(3), through, stack.depth_model_mean)
    matches, found = compute_match_errors(stack, 0, there, Tolerance(1e-6, 0.1, 0.1, CUTOFF))
    assert np.isinf(matches.distance).all()
    assert not matches.weights.any()
    for nothing in found:
        assert not nothing.any()


def test_identity_is_not_singular() -> None:
    """At the identity there is no parallax: all values are finite, and distances are those between the frames."""
    _, stack, _ = make_scene(0, make_zigzag_rig(2), 0.1)
    variance, mine = float((0.5 / stack.focal[0]) ** 2), slice(stack.offsets[0], stack.offsets[1])
    there = Candidate(np.eye(3), np.zeros(3), stack.depth_model_mean)
    matches, found = compute_match_errors(stack, 0, there, Tolerance(variance, 0.1, 0.1, 1e6))
    squares = np.sum((stack.y[mine] - stack.x[mine]) ** 2, axis=1)
    np.testing.assert_allclose(matches.distance, squares / (2 * variance), rtol=1e-6)
    assert np.isfinite(found.matrix[np.tril_indices(12)]).all()
    for part in found[1:]:
        assert np.isfinite(part).all()


# --- derivative of the parallax by the motion -------------------------------------------------------------------------


def compute_log_parallax(
    stack: Stack,
    t: int,
    x: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    alpha: FloatArray,
    place: FloatArray | None = None,
) -> float:
    """Return the logarithm of the image displacement of x (2,) per unit of inverse depth.

    `place` (u, v, z) keeps the image position fixed.
    """
    p, q = (x - stack.anchor[t]) / stack.spread[t]
    rho = stack.inverse_depth[t] * (alpha @ np.array([1, p, q, p * p, p * q, q * q]))
    tau = stack.qy[t] @ (rotation @ stack.a1[t] - stack.a2[t] + translation)
    seen = stack.qy[t] @ rotation @ stack.qx[t].T @ np.append(x, 1.0) + rho * tau
    u, v, z = (seen[0] / seen[2], seen[1] / seen[2], seen[2]) if place is None else place
    return float(np.log(stack.inverse_depth[t] * np.hypot(tau[0] - u * tau[2], tau[1] - v * tau[2]) / z))


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_parallax_gradient_is_the_derivative(seed: int) -> None:
    """Exact with a fixed image position; its displacement changes little, as the motion is small."""
    rng, rig = np.random.default_rng(seed), make_zigzag_rig(2)
    pair, stack, center = make_scene(seed, rig, 5.0, per_camera=12)
    t, (rotation, translation) = 1, get_true_motion(pair, center)
    to_world = stack.qy[t].T
    spread = 1.0 / np.sqrt(np.diag(stack.depth_model_information[t]))
    alpha = stack.depth_model_mean[t] + 0.3 * spread * rng.uniform(-1, 1, DEPTH_MODEL_SIZE)
    variance, shared = float((3.0 / stack.focal[t]) ** 2), 1.3 * stack.residual_depth[t]
    there = make_candidate(stack, t, rotation, translation, alpha)
    matches, found = compute_match_errors(stack, t, there, Tolerance(variance, stack.residual_depth[t], shared, 20.0))
    fixed_gradient, free_gradient, squares = np.zeros(6), np.zeros(6), 0.0
    for k, i in enumerate(range(stack.offsets[t], stack.offsets[t + 1])):
        x = stack.x[i]
        p, q = (x - stack.anchor[t]) / stack.spread[t]
        rho = stack.inverse_depth[t] * (alpha @ np.array([1, p, q, p * p, p * q, q * q]))
        seen = stack.qy[t] @ (rotation @ (stack.qx[t].T @ np.append(x, 1.0) + rho * stack.a1[t]))
        seen += rho * stack.qy[t] @ (translation - stack.a2[t])
        place = np.array([seen[0] / seen[2], seen[1] / seen[2], seen[2]])

        def after(still: FloatArray | None, s: FloatArray, x: FloatArray = x) -> FloatArray:
            turned = Rotation.from_rotvec(to_world @ s[:3]).as_matrix() @ rotation
            return np.array([compute_log_parallax(stack, t, x, turned, translation + to_world @ s[3:], alpha, still)])

        length = np.exp(compute_log_parallax(stack, t, x, rotation, translation, alpha))
        noise_b = (length / matches.parallax[k]) ** 2
        w = matches.weights[k] / (variance * noise_b + (shared * length) ** 2) * length**2
        squares += w
        fixed_gradient += w * differentiate(partial(after, place), 6)[0]
        free_gradient += w * differentiate(partial(after, None), 6)[0]
    gradient = found.parallax_gradient
    units = np.array([stack.inverse_depth[t]] * 3 + [1.0] * 3)  # rotations move the camera relative to the object
    np.testing.assert_allclose(
        gradient * units, fixed_gradient * units, atol=1e-5 * np.abs(fixed_gradient * units).max()
    )
    np.testing.assert_allclose(gradient * units, free_gradient * units, atol=0.2 * np.abs(free_gradient * units).max())
    assert found.parallax_squares[0] == pytest.approx(squares, rel=1e-6)


# --- contribution of noise to the equations ---------------------------------------------------------------------------


def make_rod() -> Body:
    """Return points on a line through the center."""
    places = np.linspace(-0.15, 0.15, 400)[:, None] * np.array([0.48, 0.6, 0.64])
    return Body(places, np.zeros_like(places))


def symmetrize(matrix: FloatArray) -> FloatArray:
    """Return (6, 6) of (w, d) from the lower triangle of J'WJ, rotations scaled to displacements of the surface."""
    units = np.array([1 / 0.15] * 3 + [1.0] * 3)
    lower = np.tril(matrix[:6, :6])
    return np.asarray((lower + np.tril(lower, -1).T) * np.outer(units, units))


@pytest.mark.parametrize("share", [0.2, 1.0], ids=["little relief", "relief"])
@pytest.mark.parametrize("turn", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("body", [make_rod(), BODY], ids=["rod", "ellipsoid"])
def test_noise_information_is_the_effect_of_noise(body: Body, turn: float, share: float) -> None:
    """The mean of J'WJ over noisy matches exceeds that of exact matches by this amount, at the same depth model."""
    rng, rig, t, draws = np.random.default_rng(0), make_zigzag_rig(2), 0, 400
    pair = simulate_matches(rig, body, random_motion(turn, 0.005, rng), rng=rng, noise_px=0.0)
    stack, (rotation, translation) = (
        stack_terms(make_terms(rig, pair.matches), pair.center, 0.15),
        get_true_motion(pair, pair.center),
    )
    mine = slice(stack.offsets[t], stack.offsets[t + 1])
    p, q = ((stack.x[mine] - stack.anchor[t]) / stack.spread[t]).T
    basis = np.column_stack([np.ones_like(p), p, q, p * p, p * q, q * q])
    off = 1 / pair.depths[t] / stack.inverse_depth[t] - basis @ stack.depth_model_mean[t]
    alpha = stack.depth_model_mean[t] + np.linalg.lstsq(basis, off, rcond=1e-6)[0]
    sigma, residual_depth = 0.5 / stack.focal[t], share * stack.residual_depth[t]

    def equations(noise: FloatArray) -> MatchEquations:
        noisy = stack._replace(x=stack.x + noise[0], y=stack.y + noise[1])
        there = make_candidate(stack, t, rotation, translation, alpha)
        return compute_match_errors(noisy, t, there, Tolerance(sigma**2, residual_depth, residual_depth, 1e6))[1]

    exact = equations(np.zeros((2, *stack.x.shape)))
    expected, there = symmetrize(exact.noise_information), symmetrize(exact.matrix)
    noise = sigma * rng.standard_normal((draws, 2, *stack.x.shape))
    # Each draw and its negative: terms that are linear in the noise cancel.
    more = np.mean([symmetrize(equations(s * n).matrix) - there for n in noise for s in (1, -1)], axis=0)
    values, vectors = np.linalg.eigh(expected)
    main = vectors[:, -1]
    # To a tenth, and to a small part of the exact matrix: the scatter of the draws.
    there_main = float(main @ there @ main)
    assert main @ more @ main == pytest.approx(values[-1], abs=0.1 * values[-1] + 1e-3 * there_main)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(symmetrize(equations(noise[0]).noise_information))[-1], values[-1], rtol=0.02
    )
    size = np.sqrt(np.diag(there))
    assert (np.abs(more - expected) < 0.1 * values[-1] + 5e-3 * np.outer(size, size)).all()
    if body is not BODY:
        # About itself a rod has no information, but noise adds some: to a tenth the part from depths; the part from
        # positions is not underestimated.
        axis = np.append(stack.qy[t] @ rotation @ np.array([0.48, 0.6, 0.64]), np.zeros(3))
        assert abs(axis @ there @ axis) < 1e-6 * values[-1]
        of_noise = float(axis @ expected @ axis)
        assert 0.85 * (axis @ more @ axis) < of_noise < 1.15 * (axis @ more @ axis) + 3000


def test_noise_information_is_optional() -> None:
    """All other values are the same without it."""
    pair, stack, center = make_scene(0, make_zigzag_rig(2))
    there = Candidate(*get_true_motion(pair, center), stack.depth_model_mean)
    tolerance = Tolerance(float((0.5 / stack.focal[0]) ** 2), 0.1, 0.1, CUTOFF)
    (matches, with_it), (same, without) = (
        compute_match_errors(stack, 0, there, tolerance, noise=wanted) for wanted in (True, False)
    )
    for a, b in zip((*matches, *with_it[:4]), (*same, *without[:4]), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not without.noise_information.size
    np.testing.assert_allclose(with_it.noise_information, with_it.noise_information.T, rtol=1e-12)
    assert np.linalg.eigvalsh(symmetrize(with_it.noise_information)).min() > -1e-9 * np.trace(
        symmetrize(with_it.noise_information)
    )
