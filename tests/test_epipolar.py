"""The multi-camera epipolar cost: derivatives, naive twins, symmetries, and its minimum without noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import BODY, around, data_of, terms_of, truth
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import epipolar
from sylpose.epipolar import TermData, Terms, minimize, normal_equations, sampson_residuals
from sylpose.fit import built_in_starts, object_place
from sylpose.moments import PairMoments
from sylpose.rig import Rig
from sylpose.simulate import Body, SimulatedPair, arc, box, cloud, ellipsoid, random_motion, ring, simulate_matches

FloatArray = NDArray[np.float64]
SEEDS = st.integers(0, 2**32 - 1)


def scene(seed: int, rig: Rig | None = None, noise_px: float = 0.5, **kwargs: object) -> SimulatedPair:
    rng = np.random.default_rng(seed)
    motion = random_motion(rng.uniform(1, 20), rng.uniform(0.005, 0.05), rng)
    rig = around(4) if rig is None else rig
    return simulate_matches(rig, BODY, motion, rng=rng, noise_px=noise_px, per_camera=30, **kwargs)  # type: ignore[arg-type]


def candidate(seed: int) -> tuple[FloatArray, FloatArray]:
    """Some motion (R, d), away from the identity."""
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    rotation = Rotation.from_rotvec(rng.uniform(0.02, 0.5) * axis / np.linalg.norm(axis))
    return rotation.as_matrix(), 0.05 * rng.standard_normal(3)


def skew(v: FloatArray) -> FloatArray:
    return np.cross(np.eye(3), v)


def cost(terms: Terms, rotation: FloatArray, shift: FloatArray, *, prior: bool = False) -> float:
    return normal_equations(terms, rotation, shift, prior=prior)[2]


def carried(data: list[TermData], change: RigidTransform) -> list[TermData]:
    """The terms of a world that is moved as a whole."""
    turn = change.rotation.as_matrix()
    return [replace(t, rotation=t.rotation @ turn.T, center=np.asarray(change.apply(t.center))) for t in data]


# --- derivatives -----------------------------------------------------------------------------------------------------


def numeric_derivative(terms: Terms, rotation: FloatArray, shift: FloatArray, step: float = 1e-6) -> FloatArray:
    """(T, 10, 6) central differences of the residuals by (w, d)."""
    columns = []
    for k in range(6):
        ends = []
        for sign in (1.0, -1.0):
            delta = np.zeros(6)
            delta[k] = sign * step
            turned = Rotation.from_rotvec(delta[:3]).as_matrix() @ rotation
            ends.append(epipolar._residuals(terms, turned[None], (shift + delta[3:])[None])[0][0])
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(columns, axis=-1)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_derivatives_are_those_of_the_residuals(seed: int) -> None:
    pair = scene(seed)
    terms = terms_of(data_of(around(4), pair.matches), pair.center)
    rotation, shift = candidate(seed)
    # The prior's direction and weight are held fixed on purpose, which is exact where its residual is zero.
    mean = np.einsum("ij,tj->ti", rotation, terms.prior_point) - terms.a2 + shift
    seen = np.einsum("tij,tj->ti", terms.prior_rotation, mean)
    terms = replace(terms, prior_image=seen[:, :2] / seen[:, 2:])
    residuals, derivatives = epipolar._residuals(terms, rotation[None], shift[None])
    assert residuals.shape == (1, 4, 10)
    numeric = numeric_derivative(terms, rotation, shift)
    np.testing.assert_allclose(derivatives[0], numeric, atol=1e-6 * np.abs(numeric).max())


def test_candidates_do_not_see_each_other() -> None:
    terms = terms_of(data_of(around(4), scene(0).matches), np.zeros(3))
    rotations, shifts = (np.array(part) for part in zip(*(candidate(k) for k in range(5)), strict=True))
    together = epipolar._residuals(terms, rotations, shifts)
    for k in range(5):
        alone = epipolar._residuals(terms, rotations[k : k + 1], shifts[k : k + 1])
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_allclose(a[k], b[0], rtol=1e-10, atol=1e-10)


# --- naive twins -----------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_cost_equals_a_loop_over_matches(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig, pair = around(3), scene(seed, around(3))
    rotation, shift = candidate(seed)
    motion = RigidTransform.from_components(
        pair.center + shift - rotation @ pair.center, Rotation.from_matrix(rotation)
    )
    data, sigma = data_of(rig, pair.matches), np.array([0.5, 1.0, 2.0])
    weights = [rng.uniform(0, 1, len(m)) for m in pair.matches]
    moments = [PairMoments.from_matches(t.x, t.y, w) for t, w in zip(data, weights, strict=True)]
    expected = 0.0
    for term, camera, w, s in zip(data, rig, weights, sigma, strict=True):
        # docs/method.md: R_c = Q R Q', t_c from the motion seen in the camera's own axes, E = [t_c]x R_c.
        seen = camera.camera_from_world * motion * camera.camera_from_world.inv()
        essential = skew(np.asarray(seen.translation)) @ seen.rotation.as_matrix()
        mean_x, mean_y = np.average(term.x, axis=0, weights=w), np.average(term.y, axis=0, weights=w)
        g = np.sum((essential @ mean_x)[:2] ** 2) + np.sum((essential.T @ mean_y)[:2] ** 2)
        for x, y, weight in zip(term.x, term.y, w, strict=True):
            expected += 0.5 * weight * (camera.focal / s) ** 2 * float(y @ essential @ x) ** 2 / g
    terms = Terms.build(data, moments, sigma, pair.center, 0.15)
    assert cost(terms, rotation, shift) == pytest.approx(expected, rel=1e-9)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_sampson_residuals_equal_a_loop_over_matches(seed: int) -> None:
    rig, pair = around(2), scene(seed, around(2))
    rotation, shift = candidate(seed)
    motion = RigidTransform.from_components(
        pair.center + shift - rotation @ pair.center, Rotation.from_matrix(rotation)
    )
    for term, camera in zip(data_of(rig, pair.matches), rig, strict=True):
        seen = camera.camera_from_world * motion * camera.camera_from_world.inv()
        essential = skew(np.asarray(seen.translation)) @ seen.rotation.as_matrix()
        residuals, ratio = sampson_residuals(term, pair.center, rotation, shift)
        assert ratio.mean() == pytest.approx(1.0)
        for k, (x, y) in enumerate(zip(term.x, term.y, strict=True)):
            g = np.sum((essential @ x)[:2] ** 2) + np.sum((essential.T @ y)[:2] ** 2)
            assert residuals[k] == pytest.approx(camera.focal * (y @ essential @ x) / np.sqrt(g), abs=1e-6)


def test_sampson_residuals_of_no_matches() -> None:
    term = data_of(around(1), scene(0, around(1)).matches)[0].subset(np.zeros(30, bool))
    residuals, ratio = sampson_residuals(term, np.zeros(3), *candidate(0))
    assert residuals.shape == ratio.shape == (0,)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_the_truth_has_no_residual_without_noise(seed: int) -> None:
    rig, pair = around(4), scene(seed, noise_px=0)
    data = data_of(rig, pair.matches)
    rotation, shift = truth(pair, pair.center)
    assert cost(terms_of(data, pair.center), rotation, shift) < 1e-8
    for term in data:
        assert np.abs(sampson_residuals(term, pair.center, rotation, shift)[0]).max() < 1e-6


def test_residuals_measure_pixels() -> None:
    """Noise of 0.5 px in both images is a Sampson distance of 0.5 px, and a cost of half per match."""
    pair = scene(1)
    data = data_of(around(4), pair.matches)
    rotation, shift = truth(pair, pair.center)
    all_residuals = np.concatenate([sampson_residuals(t, pair.center, rotation, shift)[0] for t in data])
    assert np.sqrt(np.mean(all_residuals**2)) == pytest.approx(0.5, rel=0.15)
    assert cost(terms_of(data, pair.center), rotation, shift) == pytest.approx(0.5 * len(all_residuals), rel=0.3)


# --- symmetries of the cost ------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_cost_does_not_depend_on_the_world_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pair = scene(seed)
    data, (rotation, shift) = data_of(around(4), pair.matches), candidate(seed)
    change = RigidTransform.from_components(5 * rng.standard_normal(3), Rotation.random(rng=rng))
    turn = change.rotation.as_matrix()
    moved = terms_of(carried(data, change), np.asarray(change.apply(pair.center)))
    expected = cost(terms_of(data, pair.center), rotation, shift, prior=True)
    assert cost(moved, turn @ rotation @ turn.T, turn @ shift, prior=True) == pytest.approx(expected, rel=1e-8)


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.floats(1e-3, 1e3))
def test_cost_does_not_depend_on_the_unit_of_length(seed: int, scale: float) -> None:
    pair = scene(seed)
    data, (rotation, shift) = data_of(around(4), pair.matches), candidate(seed)
    scaled = terms_of([replace(t, center=scale * t.center) for t in data], scale * pair.center, scale * 0.15)
    expected = cost(terms_of(data, pair.center), rotation, shift, prior=True)
    assert cost(scaled, rotation, scale * shift, prior=True) == pytest.approx(expected, rel=1e-8)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_cost_does_not_depend_on_the_centre(seed: int) -> None:
    """(R, d) about one centre is (R, d') about another; only the prior knows where the object is."""
    pair = scene(seed)
    data, (rotation, shift) = data_of(around(4), pair.matches), candidate(seed)
    by = np.array([0.1, -0.05, 0.2])
    other = terms_of(data, pair.center + by)
    expected = cost(terms_of(data, pair.center), rotation, shift)
    assert cost(other, rotation, shift + rotation @ by - by) == pytest.approx(expected, rel=1e-8)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_cost_does_not_depend_on_any_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pair = scene(seed)
    data, motion = data_of(around(4), pair.matches), candidate(seed)
    shuffled = [t.subset(rng.permutation(len(t.x))) for t in data]  # an index array shuffles as well as it picks
    expected = cost(terms_of(data, pair.center), *motion, prior=True)
    assert cost(terms_of(data[::-1], pair.center), *motion, prior=True) == pytest.approx(expected, rel=1e-9)
    assert cost(terms_of(shuffled, pair.center), *motion, prior=True) == pytest.approx(expected, rel=1e-9)


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_splitting_a_cameras_matches_changes_next_to_nothing(seed: int) -> None:
    """Two cameras in one place, each with half of the matches: only the mean rays of the denominators differ."""
    pair = scene(seed, noise_px=0.2)
    data = data_of(around(4), pair.matches)
    half = np.arange(len(data[0].x)) % 2 == 0
    split = [data[0].subset(half), data[0].subset(~half), *data[1:]]
    rotation, shift = truth(pair, pair.center)
    (whole, *_), (parts, *_) = (
        minimize(terms_of(d, pair.center, 100.0), rotation[None], shift[None]) for d in (data, split)
    )
    turn = Rotation.from_matrix(whole.rotation @ parts.rotation.T).magnitude()
    assert np.rad2deg(turn) < 0.02
    assert np.linalg.norm(whole.shift - parts.shift) < 2e-4


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_both_frames_are_treated_alike(seed: int) -> None:
    """The cost of a motion is that of its inverse with the frames swapped."""
    pair = scene(seed)
    data, (rotation, shift) = data_of(around(4), pair.matches), candidate(seed)
    swapped = [replace(t, x=t.y, y=t.x) for t in data]
    expected = cost(terms_of(data, pair.center), rotation, shift)
    assert cost(terms_of(swapped, pair.center), rotation.T, -rotation.T @ shift) == pytest.approx(expected, rel=1e-8)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_an_earlier_reference_equals_the_composed_motion(seed: int) -> None:
    """Matches with an earlier frame and the known motion since: the cost of both motions one after the other."""
    rng = np.random.default_rng(seed)
    pair, center = scene(seed), np.array([0.02, 0.01, -0.03])
    rotation, shift = candidate(seed)
    known = random_motion(rng.uniform(0, 40), 0.1, rng)
    data = data_of(around(4), pair.matches)
    since = [replace(t, base_from_reference=known) for t in data]
    earlier = np.asarray(known.inv().apply(center))
    # X -> R (B X - g) + g + d, spoken of as a motion about B^-1 g.
    both, moved = rotation @ known.rotation.as_matrix(), center + shift - earlier
    expected = cost(terms_of(data, earlier), both, moved, prior=True)
    assert cost(terms_of(since, center), rotation, shift, prior=True) == pytest.approx(expected, rel=1e-8)
    for a, b in zip(since, data, strict=True):
        mine, theirs = sampson_residuals(a, center, rotation, shift), sampson_residuals(b, earlier, both, moved)
        np.testing.assert_allclose(mine[0], theirs[0], atol=1e-6)


# --- the minimum -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("body", [ellipsoid((0.15, 0.12, 0.1)), box(), cloud()], ids=["ellipsoid", "box", "cloud"])
@pytest.mark.parametrize("rig", [ring(4), around(3), arc(4, 25), arc(3, 40)], ids=["ring", "zigzag", "arc4", "arc3"])
def test_minimize_reaches_the_truth_without_noise(rig: Rig, body: Body) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        motion = random_motion(rng.uniform(1, 20), rng.uniform(0.005, 0.05), rng)
        pair = simulate_matches(rig, body, motion, rng=rng, noise_px=0)
        data = data_of(rig, pair.matches)
        center, radius = object_place(data)
        starts = built_in_starts(data, [np.ones(len(t.x)) for t in data], center)
        assert all(Rotation.from_matrix(r).magnitude() > 1e-3 for r, _ in starts)
        terms = terms_of(data, center, radius)
        # What the prior believes of the depths is not quite so: without it, the minimum is the truth itself.
        terms = replace(terms, prior_sigma=np.full(len(data), 1e6))
        best = minimize(terms, np.array([r for r, _ in starts]), np.array([d for _, d in starts]), iterations=60)[0]
        rotation, shift = truth(pair, center)
        assert Rotation.from_matrix(best.rotation @ rotation.T).magnitude() < 1e-6
        assert np.linalg.norm(best.shift - shift) < 1e-6
        assert best.cost < 1e-8


def test_minima_come_best_first_and_bounded() -> None:
    pair = scene(3)
    data = data_of(around(4), pair.matches)
    terms = terms_of(data, pair.center)
    starts = [candidate(k) for k in range(8)]
    rotations, shifts = np.array([r for r, _ in starts]), np.array([d for _, d in starts])
    found = minimize(terms, rotations, shifts, keep=4)
    assert len(found) == 4
    assert [s.cost for s in found] == sorted(s.cost for s in found)
    assert found[0].converged
    for s in found:
        assert s.iterations <= 40
        np.testing.assert_allclose(s.rotation @ s.rotation.T, np.eye(3), atol=1e-9)
        assert s.cost == pytest.approx(cost(terms, s.rotation, s.shift, prior=True))
    stopped = minimize(terms, rotations[:1], shifts[:1], iterations=1)[0]
    assert (stopped.iterations, stopped.converged) == (1, False)
    np.testing.assert_array_equal(rotations[0], starts[0][0])  # the starts are left as they were


def test_the_gradient_vanishes_at_the_minimum() -> None:
    pair = scene(4)
    terms = replace(terms_of(data_of(around(4), pair.matches), pair.center), prior_sigma=np.full(4, 1e6))
    best = minimize(terms, *(part[None] for part in truth(pair, pair.center)))[0]
    hessian, gradient, _ = normal_equations(terms, best.rotation, best.shift, prior=False)
    assert gradient @ np.linalg.solve(hessian, gradient) < 1e-6 * best.cost
