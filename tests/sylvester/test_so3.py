"""Minima of quadratic costs on SO(3): certificate against a semidefinite relaxation and random starts (Monte Carlo)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import kron
from sylpose.moments import PairMoments
from sylpose.rig import Rig
from sylpose.simulate import arc, ellipsoid, random_motion, simulate_matches
from sylpose.sylvester import so3, so3_sos_certificate
from sylpose.sylvester.orthographic import build_costs
from sylpose.sylvester.so3_sos_certificate import N_MULTIPLIERS, build_gram_matrix
from tests.scenes import compute_angle, draw_rotations

seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=12, deadline=None)


def camera_cost(seed: int, cameras: int, noise: float = 0.1) -> tuple[FloatArray, FloatArray]:
    """Return H (9, 9) of trace 9 and h (9,) of Σ |y - P Q R Q' P' x|² for random cameras and points with depth."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(0.7 * rng.normal(size=3)).as_matrix()
    H, h = np.zeros((9, 9)), np.zeros(9)
    for Q in draw_rotations(rng, cameras):
        X = rng.normal(size=(20, 3)) * rng.uniform(0.3, 2, size=3)
        Y = X @ (Q @ turn @ Q.T).T + noise * rng.normal(size=X.shape)
        for k in range(2):
            rows = (X[:, :2] @ Q[:2])[:, None, :] * Q[k, :, None]  # derivative of the k-th coordinate by R
            rows = rows.reshape(len(X), 9)
            H += rows.T @ rows
            h += rows.T @ Y[:, k]
    scale = np.trace(H) / 9
    return H / scale, h / scale


# --- The certificate --------------------------------------------------------------------------------------------------


@cache
def orthonormality() -> FloatArray:
    """Return (k, 10, 10) symmetric F with z'Fz = 0 for every z = (1, vec(R)), R a rotation.

    Constraints: R'R = I, RR' = I, and each row and column is the cross product of the two others.
    """
    out = []
    for of in (np.arange(9).reshape(3, 3), np.arange(9).reshape(3, 3).T):  # of the rows; of the columns
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            for other in range(i, 3):
                F = np.zeros((10, 10))
                F[0, 0] = -float(i == other)
                F[1 + of[i], 1 + of[other]] = 1
                out.append(F)
            for a in range(3):  # (row_j x row_k)_a = row_i,a
                b, c = (a + 1) % 3, (a + 2) % 3
                F = np.zeros((10, 10))
                F[1 + of[j, b], 1 + of[k, c]], F[1 + of[j, c], 1 + of[k, b]] = 1, -1
                F[0, 1 + of[i, a]] = -1
                out.append(F)
    return np.array([F + F.T for F in out]) / 2


def relaxation(H: FloatArray, h: FloatArray) -> tuple[float, FloatArray]:
    """Solve the semidefinite relaxation over Z = zz', z = (1, r), without the rank constraint: cost bound and r (3, 3)."""
    cp: Any = pytest.importorskip("cvxpy")

    objective = np.zeros((10, 10))
    objective[1:, 1:], objective[0, 1:], objective[1:, 0] = H / 2, -h / 2, -h / 2
    Z = cp.Variable((10, 10), PSD=True)
    equations = orthonormality().reshape(-1, 100) @ cp.vec(Z, order="C") == 0
    problem = cp.Problem(cp.Minimize(cp.trace(objective @ Z)), [Z[0, 0] == 1, equations])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-10, tol_gap_rel=1e-10, tol_feas=1e-10)
    return float(problem.value), np.asarray(Z.value[0, 1:]).reshape(3, 3)


def test_relaxation_contains_every_rotation() -> None:
    R = draw_rotations(np.random.default_rng(0), 50)
    z = np.column_stack([np.ones(50), R.reshape(50, 9)])
    np.testing.assert_allclose(np.einsum("ni,kij,nj->nk", z, orthonormality(), z), 0, atol=1e-12)
    mirrored = z * [1, *[-1] * 9]
    assert np.abs(np.einsum("ni,kij,nj->nk", mirrored, orthonormality(), mirrored)).max() > 0.1


@pytest.mark.parametrize("cameras", [1, 2, 3, 4])
@pytest.mark.parametrize("noise", [0.01, 0.3])
def test_certificate_agrees_with_the_semidefinite_relaxation(cameras: int, noise: float) -> None:
    certified = 0
    for seed in range(6):
        H, h = camera_cost(seed, cameras, noise)
        candidates, sure, _ = so3.minimize(H, h)
        cost = float(so3.evaluate_cost(H, h, candidates[0]))
        bound, r = relaxation(H, h)
        assert bound <= cost + 1e-6 * abs(cost)
        # It is tight in all of these; with one camera the result is between two mirrored minima.
        assert bound == pytest.approx(cost, rel=1e-6)
        if sure:
            assert np.abs(r - candidates[0]).max() < 1e-3  # tolerance of the bound where G is nearly singular
        certified += sure
    assert certified == (0 if cameras == 1 else 6)


@given(seeds, st.integers(1, 5), st.floats(0.0, 0.5))
@quick
def test_certificate_identity(seed: int, cameras: int, noise: float) -> None:
    """cost(R2) - cost(R) = 1/2 (r2 - r)'K(r2 - r), K r = h, always; certified if K is positive definite."""
    H, h = camera_cost(seed, cameras, noise)
    candidates, certified, _ = so3.minimize(H, h)
    R = candidates[0]
    K = H + np.kron(so3.compute_multiplier(H, h, R), np.eye(3))
    np.testing.assert_allclose(K @ R.ravel(), h, atol=1e-7)
    others = draw_rotations(np.random.default_rng(seed), 100)
    difference = (others - R).reshape(-1, 9)
    gap = so3.evaluate_cost(H, h, others) - so3.evaluate_cost(H, h, R)
    np.testing.assert_allclose(gap, 0.5 * np.einsum("ni,ij,nj->n", difference, K, difference), atol=1e-6)
    assert certified or np.linalg.eigvalsh(K)[0] < 1e-8
    assert certified == so3.is_certified(H, h, R)
    assert not so3.is_certified(H, h, others[0])
    assert (gap > -1e-12).all()


def monomials(q: FloatArray) -> FloatArray:
    """Return the nine monomials (..., 9) of unit quaternions (c, x) (..., 4), as in `so3_sos_certificate`."""
    c, x = q[..., :1], q[..., 1:]
    return np.concatenate([c * x, x * x, np.sqrt(2) * np.roll(x, -1, -1) * np.roll(x, -2, -1)], axis=-1)


@given(seeds, st.integers(1, 4))
@quick
def test_excess_cost_is_a_form_in_nine_monomials(seed: int, cameras: int) -> None:
    rng = np.random.default_rng(seed)
    H, h = camera_cost(seed, cameras, 0.2)
    R = so3.minimize(H, h)[0][0]
    G, gradient = np.empty((9, 9)), np.empty(3)
    build_gram_matrix(H, h, R, G, gradient)
    np.testing.assert_allclose(G, G.T, atol=1e-12)
    np.testing.assert_allclose(gradient, 0, atol=1e-7)
    np.testing.assert_allclose(G[:3, :3], 2 * so3.compute_derivatives(H, h, R)[1], atol=1e-6)
    q = rng.normal(size=(50, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    m = monomials(q)
    gap = so3.evaluate_cost(H, h, Rotation.from_quat(q, scalar_first=True).as_matrix() @ R) - so3.evaluate_cost(H, h, R)
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", m, G, m), gap, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(m, axis=1), np.linalg.norm(q[:, 1:], axis=1))


def test_free_matrices_span_the_null_forms() -> None:
    q = np.random.default_rng(0).normal(size=(200, 4))
    m = monomials(q / np.linalg.norm(q, axis=1)[:, None])
    rows, columns = np.tril_indices(9)
    N = np.zeros((N_MULTIPLIERS, 9, 9))
    for matrix, entries, weights in zip(N, so3_sos_certificate._INDICES, so3_sos_certificate._WEIGHTS, strict=True):
        for (a, b), w in zip(entries, weights, strict=True):
            matrix[a, b] += w
            matrix[b, a] += w
    np.testing.assert_allclose(np.einsum("ni,kij,nj->nk", m, N, m), 0, atol=1e-13)
    assert np.linalg.matrix_rank(N.reshape(N_MULTIPLIERS, 81)) == N_MULTIPLIERS
    assert np.linalg.matrix_rank(m[:, rows] * m[:, columns]) == 45 - N_MULTIPLIERS


def cost_from_form(form: Callable[[FloatArray], FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return H and h of the cost that is a quartic form (n, 4) -> (n,) of the quaternion, up to a constant."""
    q = np.random.default_rng(0).normal(size=(300, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    r = Rotation.from_quat(q, scalar_first=True).as_matrix().reshape(-1, 9)
    rows, columns = np.tril_indices(9)
    design = np.column_stack([r[:, rows] * r[:, columns], r, np.ones(300)])
    found, *_ = np.linalg.lstsq(design, form(q), rcond=1e-12)
    np.testing.assert_allclose(design @ found, form(q), atol=1e-12)
    H = np.zeros((9, 9))
    H[rows, columns] = found[:45]
    H = H + H.T
    return H + (1e-3 - min(np.linalg.eigvalsh(H)[0], 0.0)) * np.eye(9), -found[45:54]  # |r| is constant


def lowest_cost(H: FloatArray, h: FloatArray, seed: int = 0) -> float:
    """Return the lowest cost reached from a thousand random starts."""
    return float(so3.evaluate_cost(H, h, newton_minima(H, h, draw_rotations(np.random.default_rng(seed), 1000))).min())


@pytest.mark.parametrize("share", [0.0, 0.02])
def test_nonnegative_form_without_sum_of_squares_is_not_certified(share: float) -> None:
    """Choi and Lam's form, c^4 + x²y² + y²z² + z²x² - 4 c x y z, is nonnegative but no sum of squares.

    Adding a little of a form with its only zero at (1, 1, 1, 1) leaves one global minimum, but still no sum of squares.
    """

    def form(q: FloatArray) -> FloatArray:
        c, x, y, z = q.T
        choi_lam = c**4 + (x * y) ** 2 + (y * z) ** 2 + (z * x) ** 2 - 4 * c * x * y * z
        return np.asarray(choi_lam + share * (1 - q.sum(axis=1) ** 2 / 4))

    H, h = cost_from_form(form)
    expected = Rotation.from_quat([0.5, 0.5, 0.5, 0.5], scalar_first=True).as_matrix()
    bound, _ = relaxation(H, h)
    assert bound < so3.evaluate_cost(H, h, expected) - 1e-4  # not tight
    candidates, certified, _ = so3.minimize(H, h)
    assert not certified
    assert so3.evaluate_cost(H, h, candidates[0]) == pytest.approx(so3.evaluate_cost(H, h, expected), abs=1e-9)
    if share:
        assert compute_angle(candidates[0], expected) < 1e-6
    assert not so3.is_certified(H, h, expected)
    # With a larger share it is a sum of squares.
    H, h = cost_from_form(lambda q: form(q) + 2 * (1 - q.sum(axis=1) ** 2 / 4))
    candidates, certified, _ = so3.minimize(H, h)
    assert certified
    assert compute_angle(candidates[0], expected) < 1e-6


@given(seeds, st.sampled_from([1, 2, 4, 9]), st.floats(0.01, 3.0))
@settings(max_examples=5, deadline=None)
def test_certified_minimum_is_global_for_random_costs(seed: int, rank: int, size: float) -> None:
    """Random costs."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(9, rank))
    H, h = half @ half.T, size * rng.normal(size=9)
    H *= 9 / np.trace(H)
    candidates, certified, _ = so3.minimize(H, h)
    least = lowest_cost(H, h, seed)
    assert so3.evaluate_cost(H, h, candidates[0]) < least + 1e-8
    if certified:
        # A higher minimum is never certified, nor is one of two equally good ones.
        for start in draw_rotations(rng, 20):
            other = newton_minima(H, h, start[None])
            if len(other) and compute_angle(other[0], candidates[0]) > 1e-3:
                assert not so3.is_certified(H, h, other[0])


@given(seeds, st.integers(2, 4))
@quick
def test_equivariant_under_rotations(seed: int, cameras: int) -> None:
    """R -> U R V: another object frame and another world frame."""
    H, h = camera_cost(seed, cameras, 0.3)
    U, V = draw_rotations(np.random.default_rng(seed), 2)
    T = np.kron(U, V.T)
    candidates, certified, _ = so3.minimize(H, h)
    turned, again, _ = so3.minimize(T @ H @ T.T, T @ h)
    assert certified == again
    if certified:
        assert compute_angle(turned[0], U @ candidates[0] @ V) < 1e-6


@pytest.mark.parametrize("factor", [1e-8, 1e8])
def test_certificate_is_independent_of_units(factor: float) -> None:
    for seed in range(10):
        H, h = camera_cost(seed, 1 + seed % 3, 0.3)
        candidates, certified, _ = so3.minimize(H, h)
        again, certified_again, _ = so3.minimize(factor * H, factor * h)
        assert certified == certified_again == so3.is_certified(factor * H, factor * h, candidates[0])
        assert min(compute_angle(one, candidates[0]) for one in again) < 1e-7


@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e-9, 1e-6])
def test_nearly_equal_minima_are_not_certified_wrongly(noise: float) -> None:
    """One camera, whose mirrored minima differ by a small term: a difference below rounding must not be certified."""
    for seed in range(20):
        H, h = camera_cost(seed, 1, 0.05)
        minima, certified, _ = so3.minimize(H, h)
        assert not certified
        tilted = h + noise * np.random.default_rng(seed).normal(size=9)
        candidates, certified, _ = so3.minimize(H, tilted)
        if certified:
            assert noise >= 1e-9
            others = newton_minima(H, tilted, minima)
            assert so3.evaluate_cost(H, tilted, candidates[0]) <= so3.evaluate_cost(H, tilted, others).min() + 1e-14


@pytest.mark.parametrize("rig", [arc(4, 10.0), arc(2, 180.0)])
def test_close_cameras_and_two_cameras_are_certified(rig: Rig) -> None:
    """K alone certifies less than half; benchmarks/certificate.py has all of 100."""
    moments = np.zeros((40, len(rig), 9, 9))
    for seed in range(40):
        rng = np.random.default_rng(seed)
        pair = simulate_matches(rig, ellipsoid((0.15, 0.12, 0.1)), random_motion(5.0, 0.02, rng), rng=rng)
        moments[seed] = [PairMoments.from_matches(m.x, m.y).matrix for m in pair.matches]
    q, _ = build_costs(np.array([camera.rotation for camera in rig]), moments)
    found = so3.minimize_batch(q.H, q.h)
    assert found.certified.mean() >= 0.95
    L = so3.compute_multiplier(q.H, q.h, found.candidates[:, 0])
    by_K = np.linalg.eigvalsh(q.H + kron(L, np.eye(3)))[:, 0] > 0
    assert by_K.mean() < 0.6
    assert (found.certified | ~by_K).all()


# --- All minima -------------------------------------------------------------------------------------------------------


def newton_minima(H: FloatArray, h: FloatArray, starts: FloatArray) -> FloatArray:
    """Return the minima (n, 3, 3) reached by Newton's method with absolute curvature, from all starts at once."""
    R = starts
    for _ in range(80):
        gradient, hessian = so3.compute_derivatives(H, h, R)
        values, vectors = np.linalg.eigh(hessian)
        along = np.einsum("nji,nj->ni", vectors, gradient) / np.maximum(np.abs(values), 0.1)
        R = Rotation.from_rotvec(-np.einsum("nij,nj->ni", vectors, along)).as_matrix() @ R
    gradient, hessian = so3.compute_derivatives(H, h, R)
    done = (np.abs(gradient).max(axis=1) < 1e-8) & (np.linalg.eigvalsh(hessian)[:, 0] > 1e-4)
    return np.asarray(R[done])


@pytest.mark.parametrize(
    "cameras", [1, pytest.param(2, marks=pytest.mark.slow), 3, pytest.param(4, marks=pytest.mark.slow)]
)
def test_random_starts_find_no_other_minimum(cameras: int) -> None:
    for seed in range(5):
        H, h = camera_cost(seed, cameras, noise=0.3)
        candidates, certified, _ = so3.minimize(H, h)
        found = newton_minima(H, h, draw_rotations(np.random.default_rng(seed), 1000))
        assert len(found) > 500
        assert so3.evaluate_cost(H, h, found).min() > so3.evaluate_cost(H, h, candidates[0]) - 1e-9
        if not certified:
            apart = np.linalg.norm(found[:, None] - candidates, axis=(2, 3)).min(axis=1)
            assert apart.max() < 1e-3


@given(seeds, st.integers(1, 3))
@quick
def test_candidates_are_different_minima_and_the_best_is_first(seed: int, cameras: int) -> None:
    H, h = camera_cost(seed, cameras, 0.2)
    candidates, certified, _ = so3.minimize(H, h)
    assert not (certified and len(candidates) > 1)
    assert (np.diff(so3.evaluate_cost(H, h, candidates)) >= -1e-13).all()
    gradient, hessian = so3.compute_derivatives(H, h, candidates)
    assert np.abs(gradient).max() < so3.GRADIENT_TOLERANCE
    assert np.linalg.eigvalsh(hessian).min() > -so3.ZERO_CURVATURE
    np.testing.assert_allclose(
        candidates @ np.swapaxes(candidates, 1, 2), np.broadcast_to(np.eye(3), candidates.shape), atol=1e-10
    )
    assert (np.linalg.det(candidates) > 0).all()
    for i, one in enumerate(candidates):
        assert all(compute_angle(one, other) > 0.9e-3 for other in candidates[:i])


def test_constant_cost_is_not_certified() -> None:
    for H in (np.eye(9), np.zeros((9, 9))):
        candidates, certified, _ = so3.minimize(H, np.zeros(9))
        assert not certified
        assert np.isfinite(candidates).all()


@given(seeds, st.floats(0, np.pi))
@quick
def test_an_unconstrained_optimum_that_is_a_rotation_is_found_and_certified(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(9, 12))
    H = half @ half.T
    H *= 9 / np.trace(H)
    R = Rotation.from_rotvec(size * draw_rotations(rng, 1)[0, 0]).as_matrix()
    candidates, certified, _ = so3.minimize(H, H @ R.ravel())
    assert certified
    assert compute_angle(candidates[0], R) < 1e-8


@given(seeds)
@quick
def test_with_full_depth_it_is_kabsch(seed: int) -> None:
    """A = I, B = S_xx (3x3): points known in 3D in both frames."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(10, 3))
    y = x @ draw_rotations(rng, 1)[0].T + 0.2 * rng.normal(size=x.shape)
    H, h = np.kron(np.eye(3), x.T @ x), (y.T @ x).ravel()
    scale = np.trace(H) / 9
    candidates, _, _ = so3.minimize(H / scale, h / scale)
    expected, _ = Rotation.align_vectors(y, x)
    assert compute_angle(candidates[0], expected.as_matrix()) < 1e-8


# --- Batches and derivatives ------------------------------------------------------------------------------------------


def test_batch_is_bit_identical_to_single_problems() -> None:
    costs = [camera_cost(seed, 1 + seed % 5) for seed in range(40)]
    H, h = np.array([c[0] for c in costs]), np.array([c[1] for c in costs])
    together = so3.minimize_batch(H, h)
    assert 5 < together.certified.sum() < 35
    for n in range(40):
        candidates, certified, iterations = so3.minimize(H[n], h[n])
        k = together.counts[n]
        np.testing.assert_array_equal(together.candidates[n, :k], candidates)
        assert np.isnan(together.candidates[n, k:]).all()
        assert (together.certified[n], together.iterations[n]) == (certified, iterations)
    backwards = so3.minimize_batch(H[::-1], h[::-1])
    np.testing.assert_array_equal(backwards.candidates[::-1, 0], together.candidates[:, 0])
    assert so3.minimize_batch(H[:0], h[:0]).candidates.shape == (0, 1, 3, 3)


def test_arguments_are_not_modified() -> None:
    H, h = camera_cost(0, 2)
    for array in (H, h):
        array.setflags(write=False)
    before = H.copy(), h.copy()
    candidates, _, _ = so3.minimize(H, h)
    so3.compute_derivatives(H, h, candidates)
    np.testing.assert_array_equal(H, before[0])
    np.testing.assert_array_equal(h, before[1])


@given(seeds)
@quick
def test_derivatives_against_finite_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(9, 9))
    H, h, R = half @ half.T / 9, rng.normal(size=9), draw_rotations(rng, 1)[0]

    def cost(w: FloatArray) -> float:
        return float(so3.evaluate_cost(H, h, Rotation.from_rotvec(w).as_matrix() @ R))

    gradient, hessian = so3.compute_derivatives(H, h, R)
    e = 1e-4 * np.eye(3)
    np.testing.assert_allclose(gradient, [(cost(d) - cost(-d)) / 2e-4 for d in e], atol=1e-6)
    numeric = [[(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / 4e-8 for a in e] for b in e]
    np.testing.assert_allclose(hessian, numeric, atol=1e-5)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3), (0,)])
def test_leading_axes(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    R = draw_rotations(rng, 6)[: int(np.prod(shape))].reshape(*shape, 3, 3)
    H, h = np.array([np.diag(rng.uniform(size=9)) for _ in range(3)]), rng.normal(size=(3, 9))
    if shape != (2, 3):
        H, h = H[0], h[0]
    costs, (gradient, hessian), L = (
        so3.evaluate_cost(H, h, R),
        so3.compute_derivatives(H, h, R),
        so3.compute_multiplier(H, h, R),
    )
    assert (costs.shape, gradient.shape, hessian.shape, L.shape) == (shape, (*shape, 3), (*shape, 3, 3), (*shape, 3, 3))
    for i in np.ndindex(*shape):
        one = (H[i[-1]], h[i[-1]]) if H.ndim == 3 else (H, h)
        assert costs[i] == pytest.approx(so3.evaluate_cost(*one, R[i]))
        np.testing.assert_allclose(gradient[i], so3.compute_derivatives(*one, R[i])[0])
        np.testing.assert_allclose(hessian[i], so3.compute_derivatives(*one, R[i])[1])
        np.testing.assert_allclose(L[i], so3.compute_multiplier(*one, R[i]))
