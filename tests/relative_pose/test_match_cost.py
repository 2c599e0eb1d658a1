"""Where matches ought to be, and their normal equations: a naive twin, derivatives, what noise puts into them."""

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
from sylpose.relative_pose.irls import CUTOFF
from sylpose.relative_pose.match_cost import Equations, Tolerance, matched
from sylpose.relative_pose.terms import SURFACE, Candidate, Stack, object_place, stack_terms
from sylpose.rig import Rig
from sylpose.simulate import Body, SimulatedPair, random_motion, simulate_matches
from tests.scenes import BODY, around, at, data_of, truth


def scene(
    seed: int, rig: Rig, turn: float = 5.0, body: Body = BODY, **options: object
) -> tuple[SimulatedPair, Stack, FloatArray]:
    """Matches, the problem that they make, and its centre."""
    rng = np.random.default_rng(seed)
    pair = simulate_matches(rig, body, random_motion(turn, 0.02, rng), rng=rng, **options)  # type: ignore[arg-type]
    data = data_of(rig, pair.matches)
    center, radius = object_place(data)
    return pair, stack_terms(data, center, radius), center


def image(
    stack: Stack, t: int, x: FloatArray, rotation: FloatArray, shift: FloatArray, alpha: FloatArray, nearer: float = 0.0
) -> FloatArray:
    """(2,) where the surface α puts the point x (2,) in the current frame; `nearer`: inverse depth added, of g's."""
    p, q = (x - stack.anchor[t]) / stack.spread[t]
    rho = stack.inverse_depth[t] * (alpha @ np.array([1, p, q, p * p, p * q, q * q]) + nearer)
    ray = stack.qx[t].T @ np.append(x, 1.0)
    seen = stack.qy[t] @ (rotation @ (ray + rho * stack.a1[t]) + rho * (shift - stack.a2[t]))
    return np.asarray(seen[:2] / seen[2])


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
    there = at(stack, t, rotation, shift, alpha)
    matches, found = matched(stack, t, there, Tolerance(variance, relief, shared, cutoff), usable)
    distance, across, along, parallax, weights = matches
    matrix, right = found.matrix, found.right
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
    there = Candidate(np.eye(3), through, stack.surface_mean)
    matches, found = matched(stack, 0, there, Tolerance(1e-6, 0.1, 0.1, CUTOFF))
    assert np.isinf(matches.distance).all()
    assert not matches.weights.any()
    for nothing in found:
        assert not nothing.any()


def test_no_motion_is_nothing_special() -> None:
    """At the identity there is no parallax: all numbers are finite, and distances are those between the frames."""
    _, stack, _ = scene(0, around(2), 0.1)
    variance, mine = float((0.5 / stack.focal[0]) ** 2), slice(stack.offsets[0], stack.offsets[1])
    there = Candidate(np.eye(3), np.zeros(3), stack.surface_mean)
    matches, found = matched(stack, 0, there, Tolerance(variance, 0.1, 0.1, 1e6))
    squares = np.sum((stack.y[mine] - stack.x[mine]) ** 2, axis=1)
    np.testing.assert_allclose(matches.distance, squares / (2 * variance), rtol=1e-6)
    assert np.isfinite(found.matrix[np.tril_indices(12)]).all()
    for part in found[1:]:
        assert np.isfinite(part).all()


# --- what the motion does to the parallax ------------------------------------------------------------------------------


def log_parallax(
    stack: Stack,
    t: int,
    x: FloatArray,
    rotation: FloatArray,
    shift: FloatArray,
    alpha: FloatArray,
    place: FloatArray | None = None,
) -> float:
    """Logarithm of how far a unit of inverse depth moves the image of x (2,); `place` (u, v, z) holds that image still."""
    p, q = (x - stack.anchor[t]) / stack.spread[t]
    rho = stack.inverse_depth[t] * (alpha @ np.array([1, p, q, p * p, p * q, q * q]))
    tau = stack.qy[t] @ (rotation @ stack.a1[t] - stack.a2[t] + shift)
    seen = stack.qy[t] @ rotation @ stack.qx[t].T @ np.append(x, 1.0) + rho * tau
    u, v, z = (seen[0] / seen[2], seen[1] / seen[2], seen[2]) if place is None else place
    return float(np.log(stack.inverse_depth[t] * np.hypot(tau[0] - u * tau[2], tau[1] - v * tau[2]) / z))


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_the_stretch_of_the_parallax_is_its_derivative(seed: int) -> None:
    """Exactly where the image is held still; that it moves as well changes little, as the motion is small."""
    rng, rig = np.random.default_rng(seed), around(2)
    pair, stack, center = scene(seed, rig, 5.0, per_camera=12)
    t, (rotation, shift) = 1, truth(pair, center)
    to_world = stack.qy[t].T
    spread = 1.0 / np.sqrt(np.diag(stack.surface_information[t]))
    alpha = stack.surface_mean[t] + 0.3 * spread * rng.uniform(-1, 1, SURFACE)
    variance, shared = float((3.0 / stack.focal[t]) ** 2), 1.3 * stack.relief[t]
    there = at(stack, t, rotation, shift, alpha)
    matches, found = matched(stack, t, there, Tolerance(variance, stack.relief[t], shared, 20.0))
    held, free, squares = np.zeros(6), np.zeros(6), 0.0
    for k, i in enumerate(range(stack.offsets[t], stack.offsets[t + 1])):
        x = stack.x[i]
        p, q = (x - stack.anchor[t]) / stack.spread[t]
        rho = stack.inverse_depth[t] * (alpha @ np.array([1, p, q, p * p, p * q, q * q]))
        seen = stack.qy[t] @ (rotation @ (stack.qx[t].T @ np.append(x, 1.0) + rho * stack.a1[t]))
        seen += rho * stack.qy[t] @ (shift - stack.a2[t])
        place = np.array([seen[0] / seen[2], seen[1] / seen[2], seen[2]])

        def after(still: FloatArray | None, s: FloatArray, x: FloatArray = x) -> FloatArray:
            turned = Rotation.from_rotvec(to_world @ s[:3]).as_matrix() @ rotation
            return np.array([log_parallax(stack, t, x, turned, shift + to_world @ s[3:], alpha, still)])

        length = np.exp(log_parallax(stack, t, x, rotation, shift, alpha))
        noise_b = (length / matches.parallax[k]) ** 2
        w = matches.weights[k] / (variance * noise_b + (shared * length) ** 2) * length**2
        squares += w
        held += w * derivative(partial(after, place), 6)[0]
        free += w * derivative(partial(after, None), 6)[0]
    stretch = found.stretch
    units = np.array([stack.inverse_depth[t]] * 3 + [1.0] * 3)  # a turn moves the camera, as the object sees it
    np.testing.assert_allclose(stretch * units, held * units, atol=1e-5 * np.abs(held * units).max())
    np.testing.assert_allclose(stretch * units, free * units, atol=0.2 * np.abs(free * units).max())
    assert found.squares[0] == pytest.approx(squares, rel=1e-6)


# --- what noise puts into the equations -----------------------------------------------------------------------------------


def rod() -> Body:
    """Points on a line through the centre."""
    places = np.linspace(-0.15, 0.15, 400)[:, None] * np.array([0.48, 0.6, 0.64])
    return Body(places, np.zeros_like(places))


def full(matrix: FloatArray) -> FloatArray:
    """(6, 6) of (w, d), from the lower triangle of J'WJ, a turn by how far it moves the object's surface."""
    units = np.array([1 / 0.15] * 3 + [1.0] * 3)
    lower = np.tril(matrix[:6, :6])
    return np.asarray((lower + np.tril(lower, -1).T) * np.outer(units, units))


@pytest.mark.parametrize("share", [0.2, 1.0], ids=["little relief", "relief"])
@pytest.mark.parametrize("turn", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("body", [rod(), BODY], ids=["rod", "ellipsoid"])
def test_noise_is_counted_as_what_it_puts_into_the_equations(body: Body, turn: float, share: float) -> None:
    """The mean of J'WJ over noisy matches exceeds that of the matches without noise by so much, at the same surface."""
    rng, rig, t, draws = np.random.default_rng(0), around(2), 0, 400
    pair = simulate_matches(rig, body, random_motion(turn, 0.005, rng), rng=rng, noise_px=0.0)
    stack, (rotation, shift) = stack_terms(data_of(rig, pair.matches), pair.center, 0.15), truth(pair, pair.center)
    mine = slice(stack.offsets[t], stack.offsets[t + 1])
    p, q = ((stack.x[mine] - stack.anchor[t]) / stack.spread[t]).T
    basis = np.column_stack([np.ones_like(p), p, q, p * p, p * q, q * q])
    off = 1 / pair.depths[t] / stack.inverse_depth[t] - basis @ stack.surface_mean[t]
    alpha = stack.surface_mean[t] + np.linalg.lstsq(basis, off, rcond=1e-6)[0]
    sigma, relief = 0.5 / stack.focal[t], share * stack.relief[t]

    def equations(noise: FloatArray) -> Equations:
        noisy = stack._replace(x=stack.x + noise[0], y=stack.y + noise[1])
        there = at(stack, t, rotation, shift, alpha)
        return matched(noisy, t, there, Tolerance(sigma**2, relief, relief, 1e6))[1]

    exact = equations(np.zeros((2, *stack.x.shape)))
    expected, there = full(exact.noise), full(exact.matrix)
    noise = sigma * rng.standard_normal((draws, 2, *stack.x.shape))
    # Each draw and its opposite: what is linear in the noise cancels.
    more = np.mean([full(equations(s * n).matrix) - there for n in noise for s in (1, -1)], axis=0)
    values, vectors = np.linalg.eigh(expected)
    main = vectors[:, -1]
    # To a tenth, and to a small part of what is there anyway: so far the draws scatter.
    there_main = float(main @ there @ main)
    assert main @ more @ main == pytest.approx(values[-1], abs=0.1 * values[-1] + 1e-3 * there_main)
    np.testing.assert_allclose(np.linalg.eigvalsh(full(equations(noise[0]).noise))[-1], values[-1], rtol=0.02)
    size = np.sqrt(np.diag(there))
    assert (np.abs(more - expected) < 0.1 * values[-1] + 5e-3 * np.outer(size, size)).all()
    if body is not BODY:
        # About itself a rod shows no turn, but noise does: to a tenth what comes of depths; of places, not too little.
        axis = np.append(stack.qy[t] @ rotation @ np.array([0.48, 0.6, 0.64]), np.zeros(3))
        assert abs(axis @ there @ axis) < 1e-6 * values[-1]
        of_noise = float(axis @ expected @ axis)
        assert 0.85 * (axis @ more @ axis) < of_noise < 1.15 * (axis @ more @ axis) + 3000


def test_noise_is_counted_only_where_it_is_wanted() -> None:
    """All else is the same without."""
    pair, stack, center = scene(0, around(2))
    there = Candidate(*truth(pair, center), stack.surface_mean)
    tolerance = Tolerance(float((0.5 / stack.focal[0]) ** 2), 0.1, 0.1, CUTOFF)
    (matches, with_it), (same, without) = (
        matched(stack, 0, there, tolerance, noise=wanted) for wanted in (True, False)
    )
    for a, b in zip((*matches, *with_it[:4]), (*same, *without[:4]), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not without.noise.size
    np.testing.assert_allclose(with_it.noise, with_it.noise.T, rtol=1e-12)
    assert np.linalg.eigvalsh(full(with_it.noise)).min() > -1e-9 * np.trace(full(with_it.noise))
