"""Minima of quadratic costs on SO(3): the certificate against a semidefinite relaxation and against random starts."""

from __future__ import annotations

import warnings
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sylpose.numerics.arrays import FloatArray
from sylpose.paper import so3
from tests.scenes import angle, random_rotations

seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=25, deadline=None)


def camera_cost(seed: int, cameras: int, noise: float = 0.1) -> tuple[FloatArray, FloatArray]:
    """Σ |y - P Q R Q' P' x|² of random cameras, points with depth: H (9, 9) of trace 9, h (9,)."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(0.7 * rng.normal(size=3)).as_matrix()
    H, h = np.zeros((9, 9)), np.zeros(9)
    for Q in random_rotations(rng, cameras):
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
    """(k, 10, 10) symmetric F with z'Fz = 0 for every z = (1, vec(R)), R a rotation: R'R = I, RR' = I, and each row and
    column the cross product of the two others."""
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
    """The semidefinite relaxation over Z = zz', z = (1, r), its rank forgotten: a bound of the cost, and r (3, 3)."""
    cp: Any = import_module("cvxpy")

    objective = np.zeros((10, 10))
    objective[1:, 1:], objective[0, 1:], objective[1:, 0] = H / 2, -h / 2, -h / 2
    Z = cp.Variable((10, 10), PSD=True)
    equations = orthonormality().reshape(-1, 100) @ cp.vec(Z, order="C") == 0
    problem = cp.Problem(cp.Minimize(cp.trace(objective @ Z)), [Z[0, 0] == 1, equations])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-10, tol_gap_rel=1e-10, tol_feas=1e-10)
    return float(problem.value), np.asarray(Z.value[0, 1:]).reshape(3, 3)


def test_the_relaxation_holds_every_rotation() -> None:
    R = random_rotations(np.random.default_rng(0), 50)
    z = np.column_stack([np.ones(50), R.reshape(50, 9)])
    np.testing.assert_allclose(np.einsum("ni,kij,nj->nk", z, orthonormality(), z), 0, atol=1e-12)
    mirrored = z * [1, *[-1] * 9]
    assert np.abs(np.einsum("ni,kij,nj->nk", mirrored, orthonormality(), mirrored)).max() > 0.1


@pytest.mark.parametrize("cameras", [1, 2, 3, 4])
@pytest.mark.parametrize("noise", [0.01, 0.3])
def test_certified_answers_are_those_of_a_semidefinite_relaxation_and_others_obey_its_bound(
    cameras: int, noise: float
) -> None:
    certified = 0
    for seed in range(6):
        H, h = camera_cost(seed, cameras, noise)
        candidates, sure, _ = so3.minimize(H, h)
        cost = float(so3.cost_of(H, h, candidates[0]))
        bound, r = relaxation(H, h)
        assert bound <= cost + 1e-6 * abs(cost)
        # It is tight in all of these, so that it proves the best of the uncertified minima as well.
        assert bound == pytest.approx(cost, rel=1e-6)
        if sure:
            assert np.abs(r - candidates[0]).max() < 1e-3  # what the bound allows where K is nearly singular
        certified += sure
    assert {1: certified == 0, 2: certified < 6, 3: certified > 0, 4: certified > 2}[cameras]


@given(seeds, st.integers(1, 5), st.floats(0.0, 0.5))
@quick
def test_the_certificate_proves_what_it_says(seed: int, cameras: int, noise: float) -> None:
    """cost(R2) - cost(R) = 1/2 (r2 - r)'K(r2 - r), K positive definite if certified; K r = h whether it is or not."""
    H, h = camera_cost(seed, cameras, noise)
    candidates, certified, _ = so3.minimize(H, h)
    R = candidates[0]
    K = H + np.kron(so3.multiplier_of(H, h, R), np.eye(3))
    np.testing.assert_allclose(K @ R.ravel(), h, atol=1e-7)
    others = random_rotations(np.random.default_rng(seed), 100)
    difference = (others - R).reshape(-1, 9)
    gap = so3.cost_of(H, h, others) - so3.cost_of(H, h, R)
    np.testing.assert_allclose(gap, 0.5 * np.einsum("ni,ij,nj->n", difference, K, difference), atol=1e-6)
    # To the bit only as far as rounding in two ways of computing an eigenvalue allows.
    assert certified == (np.linalg.eigvalsh(K)[0] > 1e-9) or abs(np.linalg.eigvalsh(K)[0]) < 1e-8
    assert not (cameras == 1 and certified)
    assert (gap > -1e-12).all()


# --- All minima -------------------------------------------------------------------------------------------------------


def settled(H: FloatArray, h: FloatArray, starts: FloatArray) -> FloatArray:
    """Where Newton's method with absolute curvature, all starts at once, takes them: (n, 3, 3) minima."""
    R = starts
    for _ in range(80):
        gradient, hessian = so3.derivatives(H, h, R)
        values, vectors = np.linalg.eigh(hessian)
        along = np.einsum("nji,nj->ni", vectors, gradient) / np.maximum(np.abs(values), 0.1)
        R = Rotation.from_rotvec(-np.einsum("nij,nj->ni", vectors, along)).as_matrix() @ R
    gradient, hessian = so3.derivatives(H, h, R)
    done = (np.abs(gradient).max(axis=1) < 1e-8) & (np.linalg.eigvalsh(hessian)[:, 0] > 1e-4)
    return np.asarray(R[done])


@pytest.mark.parametrize("cameras", [1, 2, 3, 4])
def test_a_thousand_random_starts_find_nothing_better_and_no_other_minimum(cameras: int) -> None:
    for seed in range(5):
        H, h = camera_cost(seed, cameras, noise=0.3)
        candidates, certified, _ = so3.minimize(H, h)
        found = settled(H, h, random_rotations(np.random.default_rng(seed), 1000))
        assert len(found) > 500
        assert so3.cost_of(H, h, found).min() > so3.cost_of(H, h, candidates[0]) - 1e-9
        if not certified:
            apart = np.linalg.norm(found[:, None] - candidates, axis=(2, 3)).min(axis=1)
            assert apart.max() < 1e-3


@given(seeds, st.integers(1, 3))
@quick
def test_candidates_are_different_minima_and_the_best_is_first(seed: int, cameras: int) -> None:
    H, h = camera_cost(seed, cameras, 0.2)
    candidates, certified, _ = so3.minimize(H, h)
    assert not (certified and len(candidates) > 1)
    assert (np.diff(so3.cost_of(H, h, candidates)) >= -1e-13).all()
    gradient, hessian = so3.derivatives(H, h, candidates)
    assert np.abs(gradient).max() < so3.STATIONARY
    assert np.linalg.eigvalsh(hessian).min() > -so3.FLAT
    np.testing.assert_allclose(
        candidates @ np.swapaxes(candidates, 1, 2), np.broadcast_to(np.eye(3), candidates.shape), atol=1e-10
    )
    assert (np.linalg.det(candidates) > 0).all()
    for i, one in enumerate(candidates):
        assert all(angle(one, other) > 0.9e-3 for other in candidates[:i])


def test_a_cost_without_any_preference_ends_and_certifies_nothing() -> None:
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
    R = Rotation.from_rotvec(size * random_rotations(rng, 1)[0, 0]).as_matrix()
    candidates, certified, _ = so3.minimize(H, H @ R.ravel())
    assert certified
    assert angle(candidates[0], R) < 1e-8


@given(seeds)
@quick
def test_with_full_depth_it_is_kabsch(seed: int) -> None:
    """A = I, B = S_xx (3x3): points known in 3D in both frames."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(10, 3))
    y = x @ random_rotations(rng, 1)[0].T + 0.2 * rng.normal(size=x.shape)
    H, h = np.kron(np.eye(3), x.T @ x), (y.T @ x).ravel()
    scale = np.trace(H) / 9
    candidates, _, _ = so3.minimize(H / scale, h / scale)
    expected, _ = Rotation.align_vectors(y, x)
    assert angle(candidates[0], expected.as_matrix()) < 1e-8


# --- Batches and derivatives ------------------------------------------------------------------------------------------


def test_a_batch_gives_each_problem_the_answer_that_it_has_alone_to_the_bit() -> None:
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


def test_what_is_given_is_left_as_it_was() -> None:
    H, h = camera_cost(0, 2)
    for array in (H, h):
        array.setflags(write=False)
    before = H.copy(), h.copy()
    candidates, _, _ = so3.minimize(H, h)
    so3.derivatives(H, h, candidates)
    np.testing.assert_array_equal(H, before[0])
    np.testing.assert_array_equal(h, before[1])


@given(seeds)
@quick
def test_derivatives_against_finite_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(9, 9))
    H, h, R = half @ half.T / 9, rng.normal(size=9), random_rotations(rng, 1)[0]

    def cost(w: FloatArray) -> float:
        return float(so3.cost_of(H, h, Rotation.from_rotvec(w).as_matrix() @ R))

    gradient, hessian = so3.derivatives(H, h, R)
    e = 1e-4 * np.eye(3)
    np.testing.assert_allclose(gradient, [(cost(d) - cost(-d)) / 2e-4 for d in e], atol=1e-6)
    numeric = [[(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / 4e-8 for a in e] for b in e]
    np.testing.assert_allclose(hessian, numeric, atol=1e-5)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3), (0,)])
def test_axes_before_the_matrices_are_problems(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    R = random_rotations(rng, 6)[: int(np.prod(shape))].reshape(*shape, 3, 3)
    H, h = np.array([np.diag(rng.uniform(size=9)) for _ in range(3)]), rng.normal(size=(3, 9))
    if shape != (2, 3):
        H, h = H[0], h[0]
    costs, (gradient, hessian), L = so3.cost_of(H, h, R), so3.derivatives(H, h, R), so3.multiplier_of(H, h, R)
    assert (costs.shape, gradient.shape, hessian.shape, L.shape) == (shape, (*shape, 3), (*shape, 3, 3), (*shape, 3, 3))
    for i in np.ndindex(*shape):
        one = (H[i[-1]], h[i[-1]]) if H.ndim == 3 else (H, h)
        assert costs[i] == pytest.approx(so3.cost_of(*one, R[i]))
        np.testing.assert_allclose(gradient[i], so3.derivatives(*one, R[i])[0])
        np.testing.assert_allclose(hessian[i], so3.derivatives(*one, R[i])[1])
        np.testing.assert_allclose(L[i], so3.multiplier_of(*one, R[i]))
