"""Normal equations with a camera's unknowns eliminated: the same solution as with all unknowns."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.normal_equations import (
    UNOBSERVABLE_RATIO,
    add_rotated,
    compute_image_row,
    eliminate_block,
    is_length_observable,
    rotate_rows,
)

SEEDS = st.integers(0, 2**32 - 1)
OWN = st.sampled_from([1, 3, 6, 7])
SOME = settings(max_examples=30)


def system(rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
    """Return a positive definite matrix (n, n), with very different units, and a right side (n,)."""
    j = rng.standard_normal((n + 3, n)) * 10.0 ** rng.uniform(-2, 2, n)
    return j.T @ j, j.T @ rng.standard_normal(n + 3)


@SOME
@given(SEEDS, OWN, st.sampled_from([3, 6]))
def test_elimination_preserves_the_solution(seed: int, k: int, n: int) -> None:
    matrix, right = system(np.random.default_rng(seed), n + k)
    block, coupled = matrix[n:, n:].copy(), np.column_stack([matrix[n:, :n], right[n:]])
    kept = np.column_stack([matrix[:n, :n], right[:n]])
    assert eliminate_block(block, coupled, kept)
    x = np.linalg.solve(kept[:, :n], kept[:, n])
    z = coupled[:, n] - coupled[:, :n] @ x
    units = np.sqrt(np.diag(matrix))
    np.testing.assert_allclose(units * np.append(x, z), units * np.linalg.solve(matrix, right), rtol=1e-7, atol=1e-9)
    # The remainder is the marginal information of the others: the inverse of their block of the inverse.
    left = np.linalg.inv(np.linalg.inv(matrix / units / units[:, None])[:n, :n])
    np.testing.assert_allclose(kept[:, :n] / units[:n] / units[:n, None], left, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(
        np.tril(block) @ np.tril(block).T, matrix[n:, n:], rtol=1e-9, atol=1e-12 * units.max() ** 2
    )


@SOME
@given(SEEDS, OWN)
def test_only_the_lower_triangle_is_read(seed: int, k: int) -> None:
    matrix, right = system(np.random.default_rng(seed), 6 + k)
    found = []
    for block in (matrix[6:, 6:].copy(), np.tril(matrix[6:, 6:])):
        coupled, kept = np.column_stack([matrix[6:, :6], right[6:]]), np.column_stack([matrix[:6, :6], right[:6]])
        assert eliminate_block(block, coupled, kept)
        found.append((coupled, kept))
    for a, b in zip(*found, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("block", [np.zeros((3, 3)), np.diag([1.0, -1.0, 1.0]), np.full((3, 3), np.nan)])
def test_singular_block_is_reported(block: FloatArray) -> None:
    assert not eliminate_block(block.copy(), np.ones((3, 7)), np.ones((6, 7)))


@SOME
@given(SEEDS)
def test_forms_and_rows_are_rotated(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = Rotation.random(rng=rng).as_matrix()
    both = np.kron(np.eye(2), q)
    matrix, _ = system(rng, 6)
    total = np.ones((6, 7))
    # Arbitrary values above the diagonal and beyond the motion's part.
    add_rotated(np.block([[np.tril(matrix) + np.triu(np.full((6, 6), np.nan), 1), np.full((6, 2), np.nan)]]), q, total)
    np.testing.assert_allclose(total[:, :6], 1.0 + both.T @ matrix @ both, rtol=1e-9, atol=1e-9 * np.abs(matrix).max())
    assert (total[:, 6] == 1.0).all()
    rows, out = rng.standard_normal((4, 6)), np.zeros((4, 7))
    rotate_rows(rows, q, out)
    np.testing.assert_allclose(out[:, :6], rows @ both, atol=1e-12)
    assert not out[:, 6].any()


@SOME
@given(SEEDS, st.floats(0.1, 10.0))
def test_row_is_directional_image_derivative(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    s, place = rng.standard_normal(3), np.array([0.3, -0.2, 6.0])
    angle = rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(angle), np.sin(angle)])

    def image(step: FloatArray) -> float:
        p = place + Rotation.from_rotvec(step[:3]).apply(s) + step[3:]
        return float(direction @ p[:2] / p[2])

    h = 1e-6
    expected = [(image(h * e) - image(-h * e)) / (2 * h) for e in np.eye(6)]
    x, y, z = place + s
    row = np.empty(6)
    # With everything known up to a scale, the row by (w, d) does not change.
    n0, n1 = direction
    s0, s1, s2 = scale * s
    compute_image_row(n0, n1, x / z, y / z, scale * z, s0, s1, s2, scale, row)
    np.testing.assert_allclose(row, expected, rtol=1e-6, atol=1e-8)


def test_length_is_judged_along_the_translation() -> None:
    translations, covariance = np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]]), np.zeros((3, 6, 6))
    covariance[:, 3, 3], covariance[:, 0, 0] = (2.01 * UNOBSERVABLE_RATIO) ** 2, 1e6
    assert is_length_observable(translations, covariance).tolist() == [False, True, True]
    covariance[:, 3, 3] = (1.99 * UNOBSERVABLE_RATIO) ** 2
    assert is_length_observable(translations, covariance).all()
