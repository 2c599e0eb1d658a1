"""The compiled cost of a motion: derivatives, naive twins written from its formulas, symmetries."""

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
    Normal,
    Sums,
    along_variance,
    moments_into,
    term_equations,
    term_misfit,
)
from sylpose.relative_pose.terms import Candidate, Stack, TermData, stack_terms
from sylpose.rig import Rig
from sylpose.simulate import SimulatedPair, arc, plane, random_motion, simulate_matches
from tests.scenes import BODY, around, at, carried, data_of, epipolar_px, sums_of, truth, variance_of

SEEDS = st.integers(0, 2**32 - 1)
KAPPAS = [0.0, 0.3, 1.0]
RADIUS = 0.15
SIGMA_PX = 0.5
FEW = settings(max_examples=15)


def scene(seed: int, rig: Rig | None = None, noise_px: float = 0.5) -> SimulatedPair:
    rng = np.random.default_rng(seed)
    motion = random_motion(rng.uniform(1, 20), rng.uniform(0.005, 0.05), rng)
    return simulate_matches(around(4) if rig is None else rig, BODY, motion, rng=rng, noise_px=noise_px, per_camera=30)


def data_of_scene(seed: int, *, earlier: bool) -> tuple[list[TermData], FloatArray]:
    """Three terms and the object's centre; of an earlier reference (a1 is not a2) if so wanted."""
    pair = scene(seed, around(3))
    data = data_of(around(3), pair.matches)
    if not earlier:
        return data, pair.center
    known = random_motion(8.0, 0.05, np.random.default_rng(seed))
    return [replace(t, base_from_reference=known) for t in data], np.asarray(known.apply(pair.center))


def candidate(seed: int) -> tuple[FloatArray, FloatArray]:
    """Some motion (R, d), away from the identity."""
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    rotation = Rotation.from_rotvec(rng.uniform(0.02, 0.5) * axis / np.linalg.norm(axis))
    return rotation.as_matrix(), 0.05 * rng.standard_normal(3)


def some_surface(seed: int, stack: Stack, t: int) -> FloatArray:
    steps = np.random.default_rng(seed).uniform(-1, 1, 3)
    return np.asarray(stack.plane_mean[t] + stack.plane_sd[t] * steps)


# --- naive twins: loops over matches, straight from the formulas ------------------------------------------------------


def skew(v: FloatArray) -> FloatArray:
    return np.cross(np.eye(3), v)


def camera_view(
    stack: Stack, t: int, rotation: FloatArray, shift: FloatArray, surface: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """R and τ in the camera's axes, the homography of the surface's plane, the essential matrix."""
    r = stack.qy[t] @ rotation @ stack.qx[t].T
    tau = stack.qy[t] @ (rotation @ stack.a1[t] - stack.a2[t] + shift)
    # ρ = (α0 + (α1, α2)·(x - anchor) / spread) times the inverse depth of the object's centre.
    slopes = surface[1:] / stack.spread[t]
    of_plane = stack.inverse_depth[t] * np.append(slopes, surface[0] - slopes @ stack.anchor[t])
    return r, tau, r + np.outer(tau, of_plane), skew(tau) @ r


def term_matches(stack: Stack, t: int) -> tuple[FloatArray, FloatArray]:
    """Homogeneous x and y (n, 3) of a term."""
    part = slice(stack.offsets[t], stack.offsets[t + 1])
    ones = np.ones((stack.offsets[t + 1] - stack.offsets[t], 1))
    return np.hstack([stack.x[part], ones]), np.hstack([stack.y[part], ones])


def weighted_residuals(
    stack: Stack,
    t: int,
    weights: FloatArray,
    variance: float,
    kappa: float,
    rotation: FloatArray,
    shift: FloatArray,
    surface: FloatArray,
) -> FloatArray:
    """All residuals of a term, each over its standard deviation: half their square is the cost."""
    _, _, homography, essential = camera_view(stack, t, rotation, shift, surface)
    x, y = term_matches(stack, t)
    mean_x, mean_y = np.average(x, axis=0, weights=weights), np.average(y, axis=0, weights=weights)
    depth = homography[2] @ mean_x
    g = np.sum((essential @ mean_x)[:2] ** 2) + np.sum((essential.T @ mean_y)[:2] ** 2)
    found = []
    for xi, yi, w in zip(x, y, weights, strict=True):
        transfer = (yi[:2] * (homography[2] @ xi) - homography[:2] @ xi) / depth
        found += list(np.sqrt(w * (1 - kappa) / (2 * variance)) * transfer)
        found.append(np.sqrt(w * kappa / variance) * (yi @ essential @ xi) / np.sqrt(g))
    found += list((surface - stack.plane_mean[t]) / stack.plane_sd[t])
    return np.array(found)


def moved(
    step: FloatArray, rotation: FloatArray, shift: FloatArray, surface: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The unknowns after a step (w, d, α)."""
    return Rotation.from_rotvec(step[:3]).as_matrix() @ rotation, shift + step[3:6], surface + step[6:]


def equations(
    stack: Stack,
    t: int,
    weights: FloatArray,
    kappa: float,
    rotation: FloatArray,
    shift: FloatArray,
    surface: FloatArray,
    *,
    full: bool = True,
) -> tuple[FloatArray, FloatArray, float]:
    """`term_equations` at noise of SIGMA_PX: Hessian, gradient, cost."""
    n = len(stack.focal)
    normal = Normal(np.full((n, 9, 9), np.nan), np.full((n, 9), np.nan))
    sums = sums_of_term(stack, t, weights, variance_of(stack, SIGMA_PX))
    value = term_equations(stack, sums, t, kappa, at(stack, t, rotation, shift, surface), normal, full)
    return normal.hessian[t], normal.gradient[t], value


def sums_of_term(stack: Stack, t: int, weights: FloatArray, variance: FloatArray) -> Sums:
    """Of one term, weighted; of the others nothing."""
    moments = np.full((len(stack.focal), 9, 9), np.nan)
    moments[t] = PairMoments.from_matches(*term_matches(stack, t), weights).matrix
    return Sums(moments, variance)


def cost(
    stack: Stack, kappa: float, rotation: FloatArray, shift: FloatArray, surfaces: FloatArray | None = None
) -> float:
    """Of all terms, at their expected surfaces unless said otherwise."""
    alpha = stack.plane_mean if surfaces is None else surfaces
    counts = np.diff(stack.offsets)
    return sum(
        equations(stack, t, np.ones(n), kappa, rotation, shift, alpha[t], full=False)[2] for t, n in enumerate(counts)
    )


@pytest.mark.parametrize("kappa", KAPPAS)
@pytest.mark.parametrize("earlier", [False, True], ids=["static", "earlier"])
@FEW
@given(seed=SEEDS)
def test_cost_and_derivatives_are_those_of_a_loop_over_matches(earlier: bool, kappa: float, seed: int) -> None:
    data, center = data_of_scene(seed, earlier=earlier)
    stack = stack_terms(data, center, RADIUS)
    assert np.allclose(stack.a1, stack.a2) != earlier
    rng, (rotation, shift) = np.random.default_rng(seed), candidate(seed)
    t = int(rng.integers(len(data)))
    weights, surface = rng.uniform(0, 1, len(data[t])), some_surface(seed, stack, t)
    variance = float(variance_of(stack, SIGMA_PX)[t])

    def residuals(step: FloatArray) -> FloatArray:
        at = moved(step, rotation, shift, surface)
        return weighted_residuals(stack, t, weights, variance, kappa, *at)

    here, size = residuals(np.zeros(9)), 1e-6
    jacobian = np.column_stack([(residuals(s) - residuals(-s)) / (2 * size) for s in size * np.eye(9)])
    hessian, gradient, value = equations(stack, t, weights, kappa, rotation, shift, surface)
    assert value == pytest.approx(0.5 * here @ here, rel=1e-8)
    expected = jacobian.T @ jacobian
    units = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(hessian / np.outer(units, units), expected / np.outer(units, units), atol=1e-6)
    largest = np.linalg.norm(here)
    np.testing.assert_allclose(gradient / units / largest, jacobian.T @ here / units / largest, atol=1e-6)
    np.testing.assert_array_equal(hessian, hessian.T)
    # The cost alone is the same number.
    assert equations(stack, t, weights, kappa, rotation, shift, surface, full=False)[2] == pytest.approx(
        value, rel=1e-12
    )


@pytest.mark.parametrize("kappa", KAPPAS)
@FEW
@given(seed=SEEDS)
def test_the_gradient_is_that_of_the_cost(kappa: float, seed: int) -> None:
    """Denominators included: nothing in the cost is held fixed but κ."""
    data, center = data_of_scene(seed, earlier=True)
    stack, (rotation, shift) = stack_terms(data, center, RADIUS), candidate(seed)
    surface, weights, size = some_surface(seed, stack, 1), np.ones(len(data[1])), 1e-5
    hessian, gradient, _ = equations(stack, 1, weights, kappa, rotation, shift, surface)
    numeric = np.zeros(9)
    # Steps of a like effect in all unknowns, by the curvature.
    units = np.sqrt(np.diag(hessian) / np.diag(hessian).max())
    for k in range(9):
        step = size * np.eye(9)[k] / units[k]
        ends = [
            equations(stack, 1, weights, kappa, *moved(s, rotation, shift, surface), full=False)[2]
            for s in (step, -step)
        ]
        numeric[k] = (ends[0] - ends[1]) / (2 * size)
    scale = np.abs(numeric).max()
    np.testing.assert_allclose(gradient / units / scale, numeric / scale, atol=2e-5)


@FEW
@given(SEEDS)
def test_the_variance_along_the_line_equals_a_loop_over_matches(seed: int) -> None:
    data, center = data_of_scene(seed, earlier=bool(seed % 2))
    stack, (rotation, shift) = stack_terms(data, center, RADIUS), candidate(seed)
    rng = np.random.default_rng(seed)
    for t, term in enumerate(data):
        surface, weights = some_surface(seed, stack, t), rng.uniform(0, 1, len(term))
        variance = float(variance_of(stack, rng.uniform(0.2, 5))[t])
        x, y = term_matches(stack, t)
        _, tau, homography, _ = camera_view(stack, t, rotation, shift, surface)
        mean = homography @ np.average(x, axis=0, weights=weights)
        line = (tau[:2] - mean[:2] / mean[2] * tau[2]) / mean[2]
        parallax = np.linalg.norm(line)
        squares = 0.0
        for xi, yi, w in zip(x, y, weights, strict=True):
            transfer = (yi[:2] * (homography[2] @ xi) - homography[:2] @ xi) / mean[2]
            squares += w * (transfer @ line / parallax) ** 2
        believed = 2 * variance + (stack.plane_relief[t] * stack.inverse_depth[t] * parallax) ** 2
        free = max(weights.sum() - 3, 0)
        logs = free * np.log(max(squares / max(free, 1), 2 * variance)) + PRIOR_MATCHES * np.log(believed)
        expected = np.exp(logs / (free + PRIOR_MATCHES))
        sums = sums_of_term(stack, t, weights, np.full(len(data), variance))
        kappa, v = along_variance(stack, sums, t, at(stack, t, rotation, shift, surface))
        if kappa > 0:
            assert v == pytest.approx(expected, rel=1e-7)
        else:
            # What may be noise is noise.
            assert expected < 2 * variance * (1 + 2.1 * np.sqrt(2 / (weights.sum() + PRIOR_MATCHES)))
            assert v == pytest.approx(2 * variance)
        assert kappa == pytest.approx(1 - 2 * variance / v)
        assert 0 <= kappa < 1


@FEW
@given(SEEDS)
def test_epipolar_squares_equal_a_loop_over_matches(seed: int) -> None:
    data, center = data_of_scene(seed, earlier=True)
    stack, (rotation, shift) = stack_terms(data, center, RADIUS), candidate(seed)
    sums = sums_of(stack, SIGMA_PX)
    for t in range(len(data)):
        ones = np.ones(len(data[t]))
        alone = weighted_residuals(stack, t, ones, 1.0, 1.0, rotation, shift, stack.plane_mean[t])
        assert term_misfit(stack, sums, t, Candidate(rotation, shift, stack.plane_mean)) == pytest.approx(
            alone @ alone, rel=1e-7
        )


@FEW
@given(SEEDS, st.integers(0, 40))
def test_moments_are_pair_moments(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    x, y, weights = rng.standard_normal((n, 2)), rng.standard_normal((n, 2)), rng.uniform(0, 1, n)
    weights[::3] = 0.0
    found = np.full((9, 9), np.nan)
    moments_into(x, y, weights, found)
    np.testing.assert_allclose(found, PairMoments.from_matches(x, y, weights).matrix, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(found, found.T)


# --- what the residuals are -------------------------------------------------------------------------------------------


@FEW
@given(SEEDS)
def test_the_truth_has_no_epipolar_residual_without_noise(seed: int) -> None:
    pair = scene(seed, noise_px=0)
    data = data_of(around(4), pair.matches)
    rotation, shift = truth(pair, pair.center)
    assert cost(stack_terms(data, pair.center, RADIUS), 1.0, rotation, shift) < 1e-8
    for term in data:
        assert np.abs(epipolar_px(term, pair.center, rotation, shift)).max() < 1e-6


@FEW
@given(SEEDS)
def test_a_plane_leaves_nothing_at_all_without_noise(seed: int) -> None:
    """The inverse depth of a planar object is linear in the image: the right surface explains every point."""
    rng, rig = np.random.default_rng(seed), arc(3, 30)
    motion = random_motion(rng.uniform(1, 20), rng.uniform(0.005, 0.05), rng)
    pair = simulate_matches(rig, plane(), motion, rng=rng, noise_px=0, per_camera=30)
    data = data_of(rig, pair.matches)
    stack, (rotation, shift) = stack_terms(data, pair.center, RADIUS), truth(pair, pair.center)
    for t, (term, depths) in enumerate(zip(data, pair.depths, strict=True)):
        basis = np.column_stack([np.ones(len(term)), (term.x - stack.anchor[t]) / stack.spread[t]])
        surface, *_ = np.linalg.lstsq(basis, 1 / depths / stack.inverse_depth[t], rcond=None)
        off = (surface - stack.plane_mean[t]) / stack.plane_sd[t]
        for kappa in KAPPAS:
            found = equations(stack, t, np.ones(len(term)), kappa, rotation, shift, surface)[2]
            assert found == pytest.approx(0.5 * off @ off, abs=1e-8)


def test_residuals_measure_pixels() -> None:
    """Noise of 0.5 px in both images is an epipolar distance of 0.5 px, and a cost of half per match."""
    pair = scene(1)
    data = data_of(around(4), pair.matches)
    rotation, shift = truth(pair, pair.center)
    found = np.concatenate([epipolar_px(t, pair.center, rotation, shift) for t in data])
    assert np.sqrt(np.mean(found**2)) == pytest.approx(0.5, rel=0.15)
    stack = stack_terms(data, pair.center, RADIUS)
    assert cost(stack, 1.0, rotation, shift) == pytest.approx(0.5 * len(found), rel=0.3)


@pytest.mark.parametrize("kappa", KAPPAS)
def test_no_motion_is_nothing_special(kappa: float) -> None:
    """At the identity the epipolar part says nothing, and all numbers stay finite."""
    data, center = data_of_scene(0, earlier=False)
    stack = stack_terms(data, center, RADIUS)
    for t, term in enumerate(data):
        surface = stack.plane_mean[t]
        found = equations(stack, t, np.ones(len(term)), kappa, np.eye(3), np.zeros(3), surface)
        moves = term.focal * np.linalg.norm(term.y - term.x, axis=1)
        assert found[2] == pytest.approx(0.5 * (1 - kappa) / 2 * np.sum((moves / SIGMA_PX) ** 2), rel=1e-9)
        assert np.isfinite(found[0]).all()
        assert np.isfinite(found[1]).all()


# --- symmetries -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kappa", KAPPAS)
@FEW
@given(seed=SEEDS)
def test_cost_does_not_depend_on_the_world_frame(kappa: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pair, (rotation, shift) = scene(seed), candidate(seed)
    data = data_of(around(4), pair.matches)
    change = RigidTransform.from_components(5 * rng.standard_normal(3), Rotation.random(rng=rng))
    turn = change.rotation.as_matrix()
    there = stack_terms(carried(data, change), np.asarray(change.apply(pair.center)), RADIUS)
    expected = cost(stack_terms(data, pair.center, RADIUS), kappa, rotation, shift)
    assert cost(there, kappa, turn @ rotation @ turn.T, turn @ shift) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("kappa", KAPPAS)
@FEW
@given(seed=SEEDS, scale=st.floats(1e-3, 1e3))
def test_cost_does_not_depend_on_the_unit_of_length(kappa: float, seed: int, scale: float) -> None:
    pair, (rotation, shift) = scene(seed), candidate(seed)
    data = data_of(around(4), pair.matches)
    scaled = stack_terms([replace(t, center=scale * t.center) for t in data], scale * pair.center, scale * RADIUS)
    expected = cost(stack_terms(data, pair.center, RADIUS), kappa, rotation, shift)
    assert cost(scaled, kappa, rotation, scale * shift) == pytest.approx(expected, rel=1e-8)


@FEW
@given(SEEDS)
def test_the_epipolar_part_does_not_depend_on_the_centre(seed: int) -> None:
    """(R, d) about one centre is (R, d') about another; only the plane part knows where the object is."""
    pair, (rotation, shift) = scene(seed), candidate(seed)
    data, by = data_of(around(4), pair.matches), np.array([0.1, -0.05, 0.2])
    other = stack_terms(data, pair.center + by, RADIUS)
    expected = cost(stack_terms(data, pair.center, RADIUS), 1.0, rotation, shift)
    assert cost(other, 1.0, rotation, shift + rotation @ by - by) == pytest.approx(expected, rel=1e-8)


@FEW
@given(SEEDS)
def test_the_epipolar_part_treats_both_frames_alike(seed: int) -> None:
    """The cost of a motion is that of its inverse with the frames swapped."""
    pair, (rotation, shift) = scene(seed), candidate(seed)
    data = data_of(around(4), pair.matches)
    swapped = stack_terms([replace(t, x=t.y, y=t.x) for t in data], pair.center, RADIUS)
    expected = cost(stack_terms(data, pair.center, RADIUS), 1.0, rotation, shift)
    assert cost(swapped, 1.0, rotation.T, -rotation.T @ shift) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("kappa", KAPPAS)
@FEW
@given(seed=SEEDS)
def test_cost_does_not_depend_on_the_order_of_matches(kappa: float, seed: int) -> None:
    pair, (rotation, shift) = scene(seed), candidate(seed)
    data, rng = data_of(around(4), pair.matches), np.random.default_rng(seed)
    shuffled = [t.subset(rng.permutation(len(t))) for t in data]  # an index array shuffles as well as it picks
    expected = cost(stack_terms(data, pair.center, RADIUS), kappa, rotation, shift)
    assert cost(stack_terms(shuffled, pair.center, RADIUS), kappa, rotation, shift) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("kappa", KAPPAS)
@FEW
@given(seed=SEEDS)
def test_an_earlier_reference_equals_the_composed_motion(kappa: float, seed: int) -> None:
    """Matches with an earlier frame and the known motion since: the cost of both motions one after the other."""
    rng = np.random.default_rng(seed)
    pair, center, (rotation, shift) = scene(seed), np.array([0.02, 0.01, -0.03]), candidate(seed)
    known = random_motion(rng.uniform(0, 40), 0.1, rng)
    data = data_of(around(4), pair.matches)
    since = [replace(t, base_from_reference=known) for t in data]
    earlier = np.asarray(known.inv().apply(center))
    # X -> R (B X - g) + g + d, spoken of as a motion about B^-1 g.
    both, further = rotation @ known.rotation.as_matrix(), center + shift - earlier
    before, after = stack_terms(data, earlier, RADIUS), stack_terms(since, center, RADIUS)
    assert cost(after, kappa, rotation, shift) == pytest.approx(cost(before, kappa, both, further), rel=1e-8)
    for a, b in zip(since, data, strict=True):
        np.testing.assert_allclose(
            epipolar_px(a, center, rotation, shift), epipolar_px(b, earlier, both, further), atol=1e-6
        )
