"""SO(3) and small linear algebra: axioms near zero, near 180 degrees, and between."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import types
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import apply_rotvec, cholesky, cholesky_solve, so3_exp, so3_log, solve_factored
from sylpose.geometry.robust_loss import bisquare

SEEDS = st.integers(0, 2**32 - 1)
SOME = settings(max_examples=25)
# Both sides of every branch: the series of exp ends at 1e-6, log's half of the sine at 1e-9 / 2, its 180 degree branch
# at a trace of -0.9, which is 2.824.
ANGLES = [0.0, 1e-300, 1e-12, 4e-10, 1e-9, 1e-7, 0.99e-6, 1.01e-6, 1e-3, 1.0, 2.0, 2.82, 2.83, np.pi - 1e-3]
HALF = [np.pi - 1e-7, np.pi - 1e-9, np.pi]
AXES = [
    np.array(axis, dtype=float) / np.linalg.norm(axis)
    for axis in ([1, 0, 0], [0, -1, 0], [0, 0, 1], [1, 1, 1], [-1, 2, -3], [1, 1e-9, 0], [1e-5, -1, 1])
]
every_angle = pytest.mark.parametrize("angle", [*ANGLES, *HALF])
every_axis = pytest.mark.parametrize("axis", AXES, ids=lambda a: "{:.0e},{:.0e},{:.0e}".format(*a))


def exp(w: FloatArray) -> FloatArray:
    out = np.full((3, 3), np.nan)
    so3_exp(np.asarray(w, dtype=float), out)
    return out


def log(rotation: FloatArray) -> FloatArray:
    out = np.full(3, np.nan)
    so3_log(np.ascontiguousarray(rotation), out)
    return out


def turned(w: FloatArray, rotation: FloatArray) -> FloatArray:
    out = np.full((3, 3), np.nan)
    apply_rotvec(np.asarray(w, dtype=float), np.ascontiguousarray(rotation), out)
    return out


def some_turn(seed: int) -> FloatArray:
    """Return a rotation vector with one of the angles and any axis."""
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    return np.asarray(rng.choice([*ANGLES, *HALF]) * axis / np.linalg.norm(axis))


# --- exp and log ------------------------------------------------------------------------------------------------------


@every_axis
@every_angle
def test_exp_is_the_rotation_of_its_vector(angle: float, axis: FloatArray) -> None:
    rotation = exp(angle * axis)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(angle * axis).as_matrix(), rtol=0, atol=3e-15)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=3e-15)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=3e-15)
    # Small rotations keep their digits: the antisymmetric part is the sine, to the last digit.
    sines = 0.5 * (rotation - rotation.T)[[2, 0, 1], [1, 2, 0]]
    np.testing.assert_allclose(sines, np.sin(angle) * axis, rtol=1e-9, atol=1e-16 if angle < 1e-2 else 1e-15)


def test_zero_vector_is_the_identity() -> None:
    np.testing.assert_array_equal(exp(np.zeros(3)), np.eye(3))
    np.testing.assert_array_equal(log(np.eye(3)), np.zeros(3))


@every_axis
@every_angle
def test_log_is_the_inverse_of_exp(angle: float, axis: FloatArray) -> None:
    w = angle * axis
    found = log(exp(w))
    if angle == np.pi:
        # A rotation by 180 degrees is also one about the opposite axis.
        assert min(np.linalg.norm(found - w), np.linalg.norm(found + w)) < 1e-7
    else:
        # Rounding of R, 1e-16, by the sine that remains.
        np.testing.assert_allclose(found, w, rtol=1e-9, atol=1e-15 + (1e-15 if angle < 3 else 2e-8))
    np.testing.assert_allclose(exp(found), exp(w), atol=2e-8 if angle > 3 else 1e-14)


@SOME
@given(SEEDS)
def test_exp_is_the_inverse_of_log(seed: int) -> None:
    rotation = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    np.testing.assert_allclose(exp(log(rotation)), rotation, atol=1e-12)
    assert np.linalg.norm(log(rotation)) <= np.pi + 1e-12
    np.testing.assert_allclose(log(rotation), Rotation.from_matrix(rotation).as_rotvec(), atol=1e-9)


# --- the group --------------------------------------------------------------------------------------------------------


@SOME
@given(SEEDS)
def test_opposite_rotation_is_the_inverse(seed: int) -> None:
    w = some_turn(seed)
    np.testing.assert_allclose(exp(-w), exp(w).T, atol=1e-15)
    np.testing.assert_allclose(turned(-w, exp(w)), np.eye(3), atol=1e-14)


@SOME
@given(SEEDS)
def test_turn_by_is_composition(seed: int) -> None:
    a, b = some_turn(seed), some_turn(seed + 1)
    expected = (Rotation.from_rotvec(a) * Rotation.from_rotvec(b)).as_matrix()
    np.testing.assert_allclose(turned(a, exp(b)), expected, atol=1e-14)
    # The identity on each side.
    np.testing.assert_array_equal(turned(np.zeros(3), exp(b)), exp(b))
    np.testing.assert_allclose(turned(a, np.eye(3)), exp(a), atol=1e-16)


@SOME
@given(SEEDS)
def test_composition_is_associative(seed: int) -> None:
    a, b, c = (some_turn(seed + k) for k in range(3))
    ab = turned(a, exp(b))
    np.testing.assert_allclose(ab @ exp(c), turned(a, turned(b, exp(c))), atol=1e-14)


@SOME
@given(SEEDS)
def test_conjugation_rotates_the_axis(seed: int) -> None:
    w, by = some_turn(seed), exp(some_turn(seed + 1))
    np.testing.assert_allclose(by @ exp(w) @ by.T, exp(by @ w), atol=2e-14)


@SOME
@given(SEEDS, st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_rotations_about_one_axis_add(seed: int, a: float, b: float) -> None:
    axis = np.random.default_rng(seed).standard_normal(3)
    np.testing.assert_allclose(
        turned(a * axis, exp(b * axis)), exp((a + b) * axis), atol=3e-15 * float(1 + axis @ axis)
    )


# --- Cholesky ---------------------------------------------------------------------------------------------------------


def positive(seed: int, n: int, condition: float) -> FloatArray:
    """A symmetric matrix (n, n) with eigenvalues from 1 down to 1 / condition."""
    rng = np.random.default_rng(seed)
    axes, _ = np.linalg.qr(rng.standard_normal((n, n)))
    matrix = axes * np.geomspace(1.0, 1.0 / condition, n) @ axes.T
    return np.asarray(0.5 * (matrix + matrix.T))


@SOME
@given(SEEDS, st.integers(1, 8), st.sampled_from([1.0, 1e3, 1e8, 1e12]))
def test_cholesky_matches_numpy(seed: int, n: int, condition: float) -> None:
    a = positive(seed, n, condition)
    factor = a.copy()
    assert cholesky(factor)
    lower = np.tril(factor)
    np.testing.assert_allclose(lower @ lower.T, a, rtol=0, atol=1e-14)
    np.testing.assert_allclose(lower, np.linalg.cholesky(a), rtol=0, atol=1e-15 * max(10.0, condition))
    # Elements above the diagonal are neither read nor written.
    np.testing.assert_array_equal(np.triu(factor, 1), np.triu(a, 1))


@SOME
@given(SEEDS, st.integers(1, 8), st.sampled_from([1.0, 1e3, 1e8]))
def test_solutions_solve(seed: int, n: int, condition: float) -> None:
    a, x = positive(seed, n, condition), np.random.default_rng(seed).standard_normal(n)
    b, factored = a @ x, a.copy()
    found = b.copy()
    assert cholesky_solve(factored, found)
    # Backward stable: the residual is rounding whatever the condition, the error grows with it.
    np.testing.assert_allclose(a @ found, b, rtol=0, atol=1e-14 * float(np.linalg.norm(x)) * n)
    np.testing.assert_allclose(found, x, rtol=0, atol=1e-14 * condition * float(np.linalg.norm(x)) * n)
    again = b.copy()
    solve_factored(factored, again)
    np.testing.assert_array_equal(again, found)


@pytest.mark.parametrize("n", [1, 3, 6])
def test_indefinite_matrix_is_rejected(n: int) -> None:
    none = [np.zeros((n, n)), -np.eye(n), np.full((n, n), np.nan), np.diag([*np.ones(n - 1), -1e-12])]
    if n > 1:
        none.append(np.ones((n, n)))  # singular: the second pivot is exactly zero
    for a in none:
        b = np.ones(n)
        assert not cholesky(a.copy())
        assert not cholesky_solve(a.copy(), b)
        np.testing.assert_array_equal(b, np.ones(n))


@SOME
@given(SEEDS, st.integers(2, 6))
def test_near_singular_is_factored_or_rejected(seed: int, n: int) -> None:
    """At a condition of 1e17 rounding decides, but a factor must multiply back."""
    a = positive(seed, n, 1e17)
    factor = a.copy()
    if cholesky(factor):
        lower = np.tril(factor)
        np.testing.assert_allclose(lower @ lower.T, a, rtol=0, atol=1e-14)
        assert (np.diag(lower) > 0).all()


def test_numbers_in_callers_do_not_select_another_kernel() -> None:
    """Otherwise each of them, and each True and False, would be compiled separately."""
    kernel: Any = bisquare
    literal: Any = types.literal
    _, _, arguments, _ = kernel.get_call_template([literal(3)], {})
    assert not any(isinstance(argument, types.Literal) for argument in arguments)
