"""Compiled cost of a motion: derivatives, reference implementations from its formulas, symmetries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.relative_pose.moments_cost import (
    PRIOR_MATCHES,
    MomentSums,
    NormalEquations,
    build_view_equations,
    compute_moments,
    compute_view_misfit,
    estimate_view_variance,
    evaluate_term,
    make_term_view,
)
from sylpose.relative_pose.terms import Candidate, Stack, TermData, stack_terms
from sylpose.rig import Rig
from sylpose.simulate import SimulatedPair, arc, plane, random_motion, simulate_matches
from tests.scenes import (
    BODY,
    compute_epipolar_px,
    compute_variance,
    get_true_motion,
    make_candidate,
    make_moment_sums,
    make_terms,
    make_view,
    make_zigzag_rig,
    transform_terms,
)

SEEDS = st.integers(0, 2**32 - 1)
KAPPAS = [0.0, 0.3, 1.0]
RADIUS = 0.15
SIGMA_PX = 0.5
FEW = settings(max_examples=6)


def make_scene(seed: int, rig: Rig | None = None, noise_px: float = 0.5) -> SimulatedPair:
    rng = np.random.default_rng(seed)
    motion = random_motion(rng.uniform(1, 20), rng.uniform(0.005, 0.05), rng)
    return simulate_matches(
        make_zigzag_rig(4) if rig is None else rig, BODY, motion, rng=rng, noise_px=noise_px, per_camera=30
    )


def make_scene_terms(seed: int, *, earlier: bool) -> tuple[list[TermData], FloatArray]:
    """Return three terms and the object's center; optionally of an earlier reference (a1 is not a2)."""
    pair = make_scene(seed, make_zigzag_rig(3))
    data = make_terms(make_zigzag_rig(3), pair.matches)
    if not earlier:
        return data, pair.center
    known = random_motion(8.0, 0.05, np.random.default_rng(seed))
    return [replace(t, start_from_reference=known) for t in data], np.asarray(known.apply(pair.center))


def draw_motion(seed: int) -> tuple[FloatArray, FloatArray]:
    """Return a motion (R, d) away from the identity."""
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    rotation = Rotation.from_rotvec(rng.uniform(0.02, 0.5) * axis / np.linalg.norm(axis))
    return rotation.as_matrix(), 0.05 * rng.standard_normal(3)


def draw_depth_model(seed: int, stack: Stack, t: int) -> FloatArray:
    steps = np.random.default_rng(seed).uniform(-1, 1, 3)
    return np.asarray(stack.plane_mean[t] + stack.plane_sd[t] * steps)


# --- reference implementations: loops over matches, directly from the formulas ----------------------------------------


def make_skew_matrix(v: FloatArray) -> FloatArray:
    return np.cross(np.eye(3), v)


def compute_camera_view(
    stack: Stack, t: int, rotation: FloatArray, translation: FloatArray, depth_model: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return R and τ in the camera's axes, the homography of the planar depth model, the essential matrix."""
    r = stack.qy[t] @ rotation @ stack.qx[t].T
    tau = stack.qy[t] @ (rotation @ stack.a1[t] - stack.a2[t] + translation)
    # ρ = (α0 + (α1, α2)·(x - anchor) / spread) times the inverse depth of the object's center.
    slopes = depth_model[1:] / stack.spread[t]
    of_plane = stack.inverse_depth[t] * np.append(slopes, depth_model[0] - slopes @ stack.anchor[t])
    return r, tau, r + np.outer(tau, of_plane), make_skew_matrix(tau) @ r


def get_term_matches(stack: Stack, t: int) -> tuple[FloatArray, FloatArray]:
    """Return homogeneous x and y (n, 3) of a term."""
    part = slice(stack.offsets[t], stack.offsets[t + 1])
    ones = np.ones((stack.offsets[t + 1] - stack.offsets[t], 1))
    return np.hstack([stack.x[part], ones]), np.hstack([stack.y[part], ones])


def compute_residuals(
    stack: Stack,
    t: int,
    weights: FloatArray,
    variance: float,
    kappa: float,
    rotation: FloatArray,
    translation: FloatArray,
    depth_model: FloatArray,
) -> FloatArray:
    """Return all residuals of a term, each over its standard deviation: half their square is the cost."""
    _, _, homography, essential = compute_camera_view(stack, t, rotation, translation, depth_model)
    x, y = get_term_matches(stack, t)
    mean_x, mean_y = np.average(x, axis=0, weights=weights), np.average(y, axis=0, weights=weights)
    depth = homography[2] @ mean_x
    g = np.sum((essential @ mean_x)[:2] ** 2) + np.sum((essential.T @ mean_y)[:2] ** 2)
    found = []
    for xi, yi, w in zip(x, y, weights, strict=True):
        transfer = (yi[:2] * (homography[2] @ xi) - homography[:2] @ xi) / depth
        found += list(np.sqrt(w * (1 - kappa) / (2 * variance)) * transfer)
        found.append(np.sqrt(w * kappa / variance) * (yi @ essential @ xi) / np.sqrt(g))
    found += list((depth_model - stack.plane_mean[t]) / stack.plane_sd[t])
    return np.array(found)


def apply_step(
    step: FloatArray, rotation: FloatArray, translation: FloatArray, depth_model: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the unknowns after a step (w, d, α)."""
    return Rotation.from_rotvec(step[:3]).as_matrix() @ rotation, translation + step[3:6], depth_model + step[6:]


def build_equations(
    stack: Stack,
    t: int,
    weights: FloatArray,
    kappa: float,
    rotation: FloatArray,
    translation: FloatArray,
    depth_model: FloatArray,
    *,
    full: bool = True,
) -> tuple[FloatArray, FloatArray, float]:
    """Return Hessian, gradient and cost of a term at noise of SIGMA_PX."""
    n = len(stack.focal)
    normal = NormalEquations(np.full((n, 9, 9), np.nan), np.full((n, 9), np.nan))
    sums = make_term_sums(stack, t, weights, compute_variance(stack, SIGMA_PX))
    candidate = make_candidate(stack, t, rotation, translation, depth_model)
    if full:
        value = build_view_equations(stack, sums, t, kappa, depth_model, make_view(stack, t, candidate), normal)
    else:
        value = evaluate_term(stack, sums, t, kappa, candidate, make_term_view())
    return normal.hessian[t], normal.gradient[t], value


def make_term_sums(stack: Stack, t: int, weights: FloatArray, variance: FloatArray) -> MomentSums:
    """Return the moment sums of one weighted term; the others are NaN."""
    moments = np.full((len(stack.focal), 9, 9), np.nan)
    moments[t] = PairMoments.from_matches(*get_term_matches(stack, t), weights).matrix
    return MomentSums(moments, variance)


def compute_cost(
    stack: Stack, kappa: float, rotation: FloatArray, translation: FloatArray, depth_models: FloatArray | None = None
) -> float:
    """Return the cost of all terms, at the mean of their prior by default."""
    alpha = stack.plane_mean if depth_models is None else depth_models
    counts = np.diff(stack.offsets)
    return sum(
        build_equations(stack, t, np.ones(n), kappa, rotation, translation, alpha[t], full=False)[2]
        for t, n in enumerate(counts)
    )


@pytest.mark.parametrize("kappa", KAPPAS)
@pytest.mark.parametrize("earlier", [False, True], ids=["static", "earlier"])
@FEW
@given(seed=SEEDS)
def test_cost_and_derivatives_equal_a_loop_over_matches(earlier: bool, kappa: float, seed: int) -> None:
    data, center = make_scene_terms(seed, earlier=earlier)
    stack = stack_terms(data, center, RADIUS)
    assert np.allclose(stack.a1, stack.a2) != earlier
    rng, (rotation, translation) = np.random.default_rng(seed), draw_motion(seed)
    t = int(rng.integers(len(data)))
    weights, depth_model = rng.uniform(0, 1, len(data[t])), draw_depth_model(seed, stack, t)
    variance = float(compute_variance(stack, SIGMA_PX)[t])

    def residuals(step: FloatArray) -> FloatArray:
        at = apply_step(step, rotation, translation, depth_model)
        return compute_residuals(stack, t, weights, variance, kappa, *at)

    here, size = residuals(np.zeros(9)), 1e-6
    jacobian = np.column_stack([(residuals(s) - residuals(-s)) / (2 * size) for s in size * np.eye(9)])
    hessian, gradient, value = build_equations(stack, t, weights, kappa, rotation, translation, depth_model)
    assert value == pytest.approx(0.5 * here @ here, rel=1e-8)
    expected = jacobian.T @ jacobian
    units = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(hessian / np.outer(units, units), expected / np.outer(units, units), atol=1e-6)
    largest = np.linalg.norm(here)
    np.testing.assert_allclose(gradient / units / largest, jacobian.T @ here / units / largest, atol=1e-6)
    np.testing.assert_array_equal(hessian, hessian.T)
    # Without derivatives the cost is the same.
    assert build_equations(stack, t, weights, kappa, rotation, translation, depth_model, full=False)[
        2
    ] == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("kappa", KAPPAS)
@FEW
@given(seed=SEEDS)
def test_gradient_is_the_derivative_of_the_cost(kappa: float, seed: int) -> None:
    """Including the denominators: only κ is fixed in the cost."""
    data, center = make_scene_terms(seed, earlier=True)
    stack, (rotation, translation) = stack_terms(data, center, RADIUS), draw_motion(seed)
    depth_model, weights, size = draw_depth_model(seed, stack, 1), np.ones(len(data[1])), 1e-5
    hessian, gradient, _ = build_equations(stack, 1, weights, kappa, rotation, translation, depth_model)
    numeric = np.zeros(9)
    # Scale the steps by the curvature.
    units = np.sqrt(np.diag(hessian) / np.diag(hessian).max())
    for k in range(9):
        step = size * np.eye(9)[k] / units[k]
        ends = [
            build_equations(stack, 1, weights, kappa, *apply_step(s, rotation, translation, depth_model), full=False)[2]
            for s in (step, -step)
        ]
        numeric[k] = (ends[0] - ends[1]) / (2 * size)
    scale = np.abs(numeric).max()
    np.testing.assert_allclose(gradient / units / scale, numeric / scale, atol=2e-5)


@FEW
@given(SEEDS)
def test_variance_along_the_line_equals_a_loop_over_matches(seed: int) -> None:
    data, center = make_scene_terms(seed, earlier=bool(seed % 2))
    stack, (rotation, translation) = stack_terms(data, center, RADIUS), draw_motion(seed)
    rng = np.random.default_rng(seed)
    for t, term in enumerate(data):
        depth_model, weights = draw_depth_model(seed, stack, t), rng.uniform(0, 1, len(term))
        variance = float(compute_variance(stack, rng.uniform(0.2, 5))[t])
        x, y = get_term_matches(stack, t)
        _, tau, homography, _ = compute_camera_view(stack, t, rotation, translation, depth_model)
        mean = homography @ np.average(x, axis=0, weights=weights)
        line = (tau[:2] - mean[:2] / mean[2] * tau[2]) / mean[2]
        parallax = np.linalg.norm(line)
        squares = 0.0
        for xi, yi, w in zip(x, y, weights, strict=True):
            transfer = (yi[:2] * (homography[2] @ xi) - homography[:2] @ xi) / mean[2]
            squares += w * (transfer @ line / parallax) ** 2
        prior_variance = 2 * variance + (stack.plane_residual_depth[t] * stack.inverse_depth[t] * parallax) ** 2
        free = max(weights.sum() - 3, 0)
        logs = free * np.log(max(squares / max(free, 1), 2 * variance)) + PRIOR_MATCHES * np.log(prior_variance)
        expected = np.exp(logs / (free + PRIOR_MATCHES))
        sums = make_term_sums(stack, t, weights, np.full(len(data), variance))
        view = make_view(stack, t, make_candidate(stack, t, rotation, translation, depth_model))
        kappa, v = estimate_view_variance(stack, sums, t, view)
        if kappa > 0:
            assert v == pytest.approx(expected, rel=1e-7)
        else:
            # An excess within the noise counts as noise.
            assert expected < 2 * variance * (1 + 2.1 * np.sqrt(2 / (weights.sum() + PRIOR_MATCHES)))
            assert v == pytest.approx(2 * variance)
        assert kappa == pytest.approx(1 - 2 * variance / v)
        assert 0 <= kappa < 1


@FEW
@given(SEEDS)
def test_epipolar_squares_equal_a_loop_over_matches(seed: int) -> None:
    data, center = make_scene_terms(seed, earlier=True)
    stack, (rotation, translation) = stack_terms(data, center, RADIUS), draw_motion(seed)
    sums = make_moment_sums(stack, SIGMA_PX)
    for t in range(len(data)):
        ones = np.ones(len(data[t]))
        alone = compute_residuals(stack, t, ones, 1.0, 1.0, rotation, translation, stack.plane_mean[t])
        view = make_view(stack, t, Candidate(rotation, translation, stack.plane_mean))
        assert compute_view_misfit(sums, t, view) == pytest.approx(alone @ alone, rel=1e-7)


@FEW
@given(SEEDS, st.integers(0, 40))
def test_moments_are_pair_moments(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    x, y, weights = rng.standard_normal((n, 2)), rng.standard_normal((n, 2)), rng.uniform(0, 1, n)
    weights[::3] = 0.0
    found = np.full((9, 9), np.nan)
    compute_moments(x, y, weights, found)
    np.testing.assert_allclose(found, PairMoments.from_matches(x, y, weights).matrix, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(found, found.T)


# --- residuals --------------------------------------------------------------------------------------------------------


@FEW
@given(SEEDS)
def test_true_motion_has_no_epipolar_residual_without_noise(seed: int) -> None:
    pair = make_scene(seed, noise_px=0)
    data = make_terms(make_zigzag_rig(4), pair.matches)
    rotation, translation = get_true_motion(pair, pair.center)
    assert compute_cost(stack_terms(data, pair.center, RADIUS), 1.0, rotation, translation) < 1e-8
    for term in data:
        assert np.abs(compute_epipolar_px(term, pair.center, rotation, translation)).max() < 1e-6


@FEW
@given(SEEDS)
def test_plane_has_no_residual_without_noise(seed: int) -> None:
    """The inverse depth of a planar object is linear in the image: the right depth model explains every point."""
    rng, rig = np.random.default_rng(seed), arc(3, 30)
    motion = random_motion(rng.uniform(1, 20), rng.uniform(0.005, 0.05), rng)
    pair = simulate_matches(rig, plane(), motion, rng=rng, noise_px=0, per_camera=30)
    data = make_terms(rig, pair.matches)
    stack, (rotation, translation) = stack_terms(data, pair.center, RADIUS), get_true_motion(pair, pair.center)
    for t, (term, depths) in enumerate(zip(data, pair.depths, strict=True)):
        basis = np.column_stack([np.ones(len(term)), (term.x - stack.anchor[t]) / stack.spread[t]])
        depth_model, *_ = np.linalg.lstsq(basis, 1 / depths / stack.inverse_depth[t], rcond=None)
        off = (depth_model - stack.plane_mean[t]) / stack.plane_sd[t]
        for kappa in KAPPAS:
            found = build_equations(stack, t, np.ones(len(term)), kappa, rotation, translation, depth_model)[2]
            assert found == pytest.approx(0.5 * off @ off, abs=1e-8)


def test_residuals_are_in_pixels() -> None:
    """Noise of 0.5 px in both images gives an epipolar distance of 0.5 px, and a cost of one half per match."""
    pair = make_scene(1)
    data = make_terms(make_zigzag_rig(4), pair.matches)
    rotation, translation = get_true_motion(pair, pair.center)
    found = np.concatenate([compute_epipolar_px(t, pair.center, rotation, translation) for t in data])
    assert np.sqrt(np.mean(found**2)) == pytest.approx(0.5, rel=0.15)
    stack = stack_terms(data, pair.center, RADIUS)
    assert compute_cost(stack, 1.0, rotation, translation) == pytest.approx(0.5 * len(found), rel=0.3)


@pytest.mark.parametrize("kappa", KAPPAS)
def test_identity_is_not_singular(kappa: float) -> None:
    """At the identity the epipolar part vanishes, and all values are finite."""
    data, center = make_scene_terms(0, earlier=False)
    stack = stack_terms(data, center, RADIUS)
    for t, term in enumerate(data):
        depth_model = stack.plane_mean[t]
        found = build_equations(stack, t, np.ones(len(term)), kappa, np.eye(3), np.zeros(3), depth_model)
        moves = term.focal * np.linalg.norm(term.y - term.x, axis=1)
        assert found[2] == pytest.approx(0.5 * (1 - kappa) / 2 * np.sum((moves / SIGMA_PX) ** 2), rel=1e-9)
        assert np.isfinite(found[0]).all()
        assert np.isfinite(found[1]).all()


# --- symmetries -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kappa", KAPPAS)
@FEW
@given(seed=SEEDS)
def test_cost_is_invariant_to_the_world_frame(kappa: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pair, (rotation, translation) = make_scene(seed), draw_motion(seed)
    data = make_terms(make_zigzag_rig(4), pair.matches)
    change = RigidTransform.from_components(5 * rng.standard_normal(3), Rotation.random(rng=rng))
    world_rotation = change.rotation.as_matrix()
    there = stack_terms(transform_terms(data, change), np.asarray(change.apply(pair.center)), RADIUS)
    expected = compute_cost(stack_terms(data, pair.center, RADIUS), kappa, rotation, translation)
    assert compute_cost(
        there, kappa, world_rotation @ rotation @ world_rotation.T, world_rotation @ translation
    ) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("kappa", KAPPAS)
@FEW
@given(seed=SEEDS, scale=st.floats(1e-3, 1e3))
def test_cost_is_invariant_to_the_length_unit(kappa: float, seed: int, scale: float) -> None:
    pair, (rotation, translation) = make_scene(seed), draw_motion(seed)
    data = make_terms(make_zigzag_rig(4), pair.matches)
    scaled = stack_terms([replace(t, center=scale * t.center) for t in data], scale * pair.center, scale * RADIUS)
    expected = compute_cost(stack_terms(data, pair.center, RADIUS), kappa, rotation, translation)
    assert compute_cost(scaled, kappa, rotation, scale * translation) == pytest.approx(expected, rel=1e-8)


@FEW
@given(SEEDS)
def test_epipolar_part_is_invariant_to_the_center(seed: int) -> None:
    """(R, d) about one center is (R, d') about another; only the planar part depends on the object's location."""
    pair, (rotation, translation) = make_scene(seed), draw_motion(seed)
    data, by = make_terms(make_zigzag_rig(4), pair.matches), np.array([0.1, -0.05, 0.2])
    other = stack_terms(data, pair.center + by, RADIUS)
    expected = compute_cost(stack_terms(data, pair.center, RADIUS), 1.0, rotation, translation)
    assert compute_cost(other, 1.0, rotation, translation + rotation @ by - by) == pytest.approx(expected, rel=1e-8)


@FEW
@given(SEEDS)
def test_epipolar_part_is_symmetric_in_the_frames(seed: int) -> None:
    """The cost of a motion equals that of its inverse with the frames swapped."""
    pair, (rotation, translation) = make_scene(seed), draw_motion(seed)
    data = make_terms(make_zigzag_rig(4), pair.matches)
    swapped = stack_terms([replace(t, x=t.y, y=t.x) for t in data], pair.center, RADIUS)
    expected = compute_cost(stack_terms(data, pair.center, RADIUS), 1.0, rotation, translation)
    assert compute_cost(swapped, 1.0, rotation.T, -rotation.T @ translation) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("kappa", KAPPAS)
@FEW
@given(seed=SEEDS)
def test_cost_is_invariant_to_the_order_of_matches(kappa: float, seed: int) -> None:
    pair, (rotation, translation) = make_scene(seed), draw_motion(seed)
    data, rng = make_terms(make_zigzag_rig(4), pair.matches), np.random.default_rng(seed)
    shuffled = [t.subset(rng.permutation(len(t))) for t in data]  # an index array may permute
    expected = compute_cost(stack_terms(data, pair.center, RADIUS), kappa, rotation, translation)
    assert compute_cost(stack_terms(shuffled, pair.center, RADIUS), kappa, rotation, translation) == pytest.approx(
        expected, rel=1e-9
    )


@pytest.mark.parametrize("kappa", KAPPAS)
@FEW
@given(seed=SEEDS)
def test_earlier_reference_equals_the_composed_motion(kappa: float, seed: int) -> None:
    """Matches with an earlier frame and the known motion since then: the cost equals that of the composed motion."""
    rng = np.random.default_rng(seed)
    pair, center, (rotation, translation) = make_scene(seed), np.array([0.02, 0.01, -0.03]), draw_motion(seed)
    known = random_motion(rng.uniform(0, 40), 0.1, rng)
    data = make_terms(make_zigzag_rig(4), pair.matches)
    since = [replace(t, start_from_reference=known) for t in data]
    earlier = np.asarray(known.inv().apply(center))
    # X -> R (B X - g) + g + d, expressed as a motion about B^-1 g.
    both, further = rotation @ known.rotation.as_matrix(), center + translation - earlier
    before, after = stack_terms(data, earlier, RADIUS), stack_terms(since, center, RADIUS)
    assert compute_cost(after, kappa, rotation, translation) == pytest.approx(
        compute_cost(before, kappa, both, further), rel=1e-8
    )
    for a, b in zip(since, data, strict=True):
        np.testing.assert_allclose(
            compute_epipolar_px(a, center, rotation, translation),
            compute_epipolar_px(b, earlier, both, further),
            atol=1e-6,
        )
