"""One robust motion: its inliers are the inliers, its noise is the noise, cameras gone wrong are set aside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import BODY, around, data_of, epipolar_px, truth, turn_between
from scipy.spatial.transform import Rotation

from sylpose.quadric import match_equations
from sylpose.reweight import CUTOFF
from sylpose.robust_fit import robust_fit
from sylpose.rig import Rig
from sylpose.simulate import SimulatedPair, arc, random_motion, simulate_matches
from sylpose.terms import SURFACE, Stack, object_place, stack_terms

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


class Robust(NamedTuple):
    """What `robust_fit` fills."""

    rotation: FloatArray
    shift: FloatArray
    weights: FloatArray
    across: FloatArray
    sigma_px: FloatArray
    information: FloatArray
    without_depth: FloatArray
    noise: FloatArray
    iterations: int
    promise: float


def fitted(stack: Stack, usable: BoolArray | None = None, seed: int = 0) -> Robust:
    n, n_matches = len(stack.focal), len(stack.x)
    places = (
        np.eye(3),
        np.zeros(3),
        np.zeros(n_matches),
        np.zeros(n_matches),
        np.ones(n),
        *np.zeros((3, 6, 6)),
    )
    iterations, promise = robust_fit(
        stack,
        np.ones(n_matches, dtype=bool) if usable is None else usable,
        np.random.default_rng(seed).random((300, 4)),
        np.empty((0, 3, 3)),
        np.empty((0, 3)),
        *places,
    )
    return Robust(*places, iterations, promise)


def scene(seed: int, rig: Rig, turn: float = 5.0, **options: object) -> tuple[SimulatedPair, Stack, FloatArray]:
    """Matches, the problem that they make, and its centre."""
    rng = np.random.default_rng(seed)
    pair = simulate_matches(rig, BODY, random_motion(turn, 0.02, rng), rng=rng, **options)  # type: ignore[arg-type]
    data = data_of(rig, pair.matches)
    center, radius = object_place(data)
    return pair, stack_terms(data, center, radius), center


def split(stack: Stack, values: FloatArray) -> list[FloatArray]:
    return np.split(values, stack.offsets[1:-1])


@pytest.mark.parametrize(
    ("kind", "share"),
    [*(("uniform", share) for share in (0.1, 0.3, 0.5)), *(("second_motion", share) for share in (0.1, 0.3, 0.4))],
)
def test_inliers_are_the_inliers(kind: str, share: float) -> None:
    """Matches that stand still are told before (`sylpose.fit`)."""
    rig, kept, caught = around(4), [], []
    for seed in range(5):
        pair, stack, center = scene(seed, rig, 8.0, per_camera=100, outliers=share, outlier_kind=kind)
        data = data_of(rig, pair.matches)
        for term, w, wrong in zip(data, split(stack, fitted(stack).weights), pair.is_outlier, strict=True):
            # A mismatch that the true motion explains cannot be told from a match, nor does it harm.
            far = np.abs(epipolar_px(term, center, *truth(pair, center))) > 4
            kept += list(w[~wrong] > 0)
            caught += list(w[wrong & far] == 0)
    assert np.mean(kept) > 0.98
    assert np.mean(caught) > 0.98


@pytest.mark.parametrize("outliers", [0.0, 0.3])
@pytest.mark.parametrize("noise_px", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("rig", [around(4), arc(2, 40)], ids=["around4", "arc2"])
def test_the_noise_is_measured(rig: Rig, noise_px: float, outliers: float) -> None:
    ratios = []
    for seed in range(6):
        _, stack, _ = scene(seed, rig, per_camera=100, noise_px=noise_px, outliers=outliers)
        ratios.append(fitted(stack).sigma_px / noise_px)
    assert 0.85 < np.mean(ratios) < 1.15
    assert np.max(np.abs(np.mean(ratios, axis=1) - 1)) < 0.3  # in each scene


def test_a_camera_noisier_than_the_others_is_believed_less() -> None:
    rig = around(4)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        motion = random_motion(5, 0.02, rng)
        pairs = [simulate_matches(rig, BODY, motion, rng=np.random.default_rng(seed), noise_px=s) for s in (0.3, 1.5)]
        matches = [*pairs[0].matches[:3], pairs[1].matches[3]]
        data = data_of(rig, matches)
        sigma = fitted(stack_terms(data, *object_place(data))).sigma_px
        assert sigma[3] > 2.5 * sigma[:3].max()


def test_residuals_are_measured_in_pixels() -> None:
    _, stack, _ = scene(0, around(4), per_camera=300)
    found = fitted(stack)
    assert np.std(found.across[found.weights > 0]) == pytest.approx(0.5, rel=0.1)


def test_a_junk_camera_is_set_aside() -> None:
    rig = around(4)
    for seed in range(8):
        pair, stack, center = scene(seed, rig, junk=("cam_1",))
        found = fitted(stack)
        agree = [np.mean(w > 0) for w in split(stack, found.weights)]
        assert agree[1] < 0.15
        assert min(agree[0], agree[2], agree[3]) > 0.9
        rotation, shift = truth(pair, center)
        assert turn_between(found.rotation, rotation) < 1.0
        assert np.linalg.norm(found.shift - shift) < 0.005


def test_matches_that_are_not_usable_are_not_used() -> None:
    pair, stack, center = scene(2, around(4), outliers=0.3)
    usable = ~np.concatenate(pair.is_outlier)
    found = fitted(stack, usable)
    assert (found.weights[~usable] == 0).all()
    assert turn_between(found.rotation, truth(pair, center)[0]) < 0.6


def test_the_same_input_gives_the_same_to_the_last_bit() -> None:
    _, stack, _ = scene(3, around(4), outliers=0.3)
    for a, b in zip(fitted(stack), fitted(stack), strict=True):
        np.testing.assert_array_equal(a, b)


def test_other_draws_give_nearly_the_same() -> None:
    for seed in range(5):
        _, stack, _ = scene(seed, around(4), outliers=0.3)
        a, b = fitted(stack, seed=1), fitted(stack, seed=2)
        assert turn_between(a.rotation, b.rotation) < 0.02
        np.testing.assert_allclose(a.shift, b.shift, atol=1e-4)


def test_weights_and_information_make_sense() -> None:
    _, stack, _ = scene(4, around(4), outliers=0.3)
    found = fitted(stack)
    assert ((found.weights >= 0) & (found.weights <= 1)).all()
    assert found.promise < 0.02
    assert 0 < found.iterations < 500
    for matrix in (found.information, found.without_depth):
        np.testing.assert_allclose(matrix, matrix.T, rtol=1e-9)
        assert np.linalg.eigvalsh(matrix).min() > 0


def test_nothing_usable_is_no_fit() -> None:
    _, stack, _ = scene(5, around(2))
    found = fitted(stack, np.zeros(len(stack.x), bool))
    assert found.promise == np.inf
    assert not found.weights.any()


def test_junk_alone_does_not_pass_for_noise() -> None:
    """When nothing agrees, the noise level must not grow until everything does."""
    rig, passed = around(4), 0
    for seed in range(10):
        _, stack, _ = scene(seed, rig, junk=rig.names)
        passed += bool(np.mean(fitted(stack).weights > 0) > 0.5)
    assert passed <= 1


# --- one match: a naive twin ------------------------------------------------------------------------------------------


def image(
    stack: Stack, t: int, x: FloatArray, rotation: FloatArray, shift: FloatArray, alpha: FloatArray, nearer: float = 0.0
) -> FloatArray:
    """(2,) where the surface α puts the point x (2,) in the current frame; `nearer`: inverse depth added, of g's."""
    p, q = (x - stack.anchor[t]) / stack.spread[t]
    rho = stack.inverse_depth[t] * (alpha @ np.array([1, p, q, p * p, p * q, q * q]) + nearer)
    ray = stack.qx[t].T @ np.append(x, 1.0)
    seen = stack.qy[t] @ (rotation @ (ray + rho * stack.a1[t]) + rho * (shift - stack.a2[t]))
    return np.asarray(seen[:2] / seen[2])


def matched(
    stack: Stack,
    t: int,
    rotation: FloatArray,
    shift: FloatArray,
    alpha: FloatArray,
    variance: float,
    reliefs: tuple[float, float],
    cutoff: float,
    usable: BoolArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`match_equations`: distance, across, along, parallax and weights (5, n) of term t; J'WJ (12, 12), lower; J'We."""
    n = len(stack.x)
    distance, across, along, parallax, weights = filled = np.full((5, n), np.nan)
    equations = np.empty((6 + SURFACE, 8 + SURFACE))
    match_equations(
        stack,
        t,
        np.ones(n, bool) if usable is None else usable,
        rotation,
        shift,
        alpha,
        variance,
        *reliefs,
        cutoff,
        distance,
        across,
        along,
        parallax,
        weights,
        equations,
    )
    mine = slice(stack.offsets[t], stack.offsets[t + 1])
    return filled[:, mine], equations[:, : 6 + SURFACE], equations[:, 6 + SURFACE]


def derivative(function: Callable[[FloatArray], FloatArray], size: int, step: float = 1e-6) -> FloatArray:
    """(m, size) central differences at zero."""
    return np.column_stack([(function(s) - function(-s)) / (2 * step) for s in step * np.eye(size)])


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_equations_of_matches_equal_a_loop_over_them(seed: int) -> None:
    rng, rig = np.random.default_rng(seed), around(2)
    pair, stack, center = scene(seed, rig, 8.0, per_camera=12)
    if seed % 2:
        known = random_motion(8.0, 0.05, rng)
        data = [replace(term, base_from_reference=known) for term in data_of(rig, pair.matches)]
        center = np.asarray(known.apply(center))
        stack = stack_terms(data, center, 0.15)
    t, n = 1, len(stack.x)
    rotation, shift = random_motion(6.0, 0.0, rng).rotation.as_matrix(), 0.02 * rng.standard_normal(3)
    spread = 1.0 / np.sqrt(np.diag(stack.surface_information[t]))
    alpha = stack.surface_mean[t] + 0.5 * spread * rng.uniform(-1, 1, SURFACE)
    variance, relief, shared = float((3.0 / stack.focal[t]) ** 2), 0.7 * stack.relief[t], 1.3 * stack.relief[t]
    cutoff, usable = 20.0, rng.random(n) > 0.2
    (distance, across, along, parallax, weights), matrix, right = matched(
        stack, t, rotation, shift, alpha, variance, (relief, shared), cutoff, usable
    )
    expected, expected_right = np.zeros((12, 12)), np.zeros(12)
    for k, i in enumerate(range(stack.offsets[t], stack.offsets[t + 1])):
        x = stack.x[i]
        e = stack.y[i] - image(stack, t, x, rotation, shift, alpha)
        by_x = derivative(partial(lambda x, s: image(stack, t, x + s, rotation, shift, alpha), x), 2)
        by_depth = derivative(partial(lambda x, s: image(stack, t, x, rotation, shift, alpha, s[0]), x), 1)[:, 0]
        b = by_depth / np.linalg.norm(by_depth)
        normal = np.array([-b[1], b[0]])
        both = np.eye(2) + by_x @ by_x.T
        noise_n, noise_b = normal @ both @ normal, b @ both @ b
        spare = (relief * np.linalg.norm(by_depth)) ** 2
        d2 = (normal @ e) ** 2 / (variance * noise_n) + (b @ e) ** 2 / (variance * noise_b + spare)
        w = max(1 - d2 / cutoff**2, 0.0) ** 2 if usable[i] else 0.0
        assert across[k] == pytest.approx(normal @ e / np.sqrt(noise_n), rel=1e-5, abs=1e-9)
        assert along[k] == pytest.approx(b @ e / np.sqrt(noise_b), rel=1e-5, abs=1e-9)
        assert parallax[k] == pytest.approx(np.linalg.norm(by_depth) / np.sqrt(noise_b), rel=1e-5)
        assert distance[k] == pytest.approx(d2, rel=1e-4)
        assert weights[k] == pytest.approx(w, rel=1e-4, abs=1e-9)

        def by_all(nearer: float, x: FloatArray = x) -> FloatArray:
            """(2, 12) by (w, d), in the camera's axes, and α."""

            def moved(s: FloatArray) -> FloatArray:
                to_world = stack.qy[t].T
                turned = Rotation.from_rotvec(to_world @ s[:3]).as_matrix() @ rotation
                return image(stack, t, x, turned, shift + to_world @ s[3:6], alpha + s[6:], nearer)

            return derivative(moved, 12)

        row = b @ by_all(0.0)
        w_along = w / (variance * noise_b + (shared * np.linalg.norm(by_depth)) ** 2)
        expected += w_along * np.outer(row, row)
        expected_right += w_along * row * (b @ e)
        # Across the line the match's own depth, as far as it can be told from noise.
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


def test_a_point_behind_the_camera_is_infinitely_far() -> None:
    _, stack, _ = scene(0, around(2))
    through = -3.0 * stack.qy[0, 2]
    filled, matrix, right = matched(stack, 0, np.eye(3), through, stack.surface_mean[0], 1e-6, (0.1, 0.1), CUTOFF)
    assert np.isinf(filled[0]).all()
    assert not filled[4].any()
    assert not matrix.any()
    assert not right.any()


def test_no_motion_is_nothing_special() -> None:
    """At the identity there is no parallax: all numbers are finite, and distances are those between the frames."""
    _, stack, _ = scene(0, around(2), 0.1)
    variance, mine = float((0.5 / stack.focal[0]) ** 2), slice(stack.offsets[0], stack.offsets[1])
    filled, matrix, right = matched(stack, 0, np.eye(3), np.zeros(3), stack.surface_mean[0], variance, (0.1, 0.1), 1e6)
    squares = np.sum((stack.y[mine] - stack.x[mine]) ** 2, axis=1)
    np.testing.assert_allclose(filled[0], squares / (2 * variance), rtol=1e-6)
    assert np.isfinite(matrix[np.tril_indices(12)]).all()
    assert np.isfinite(right).all()
