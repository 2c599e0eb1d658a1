"""Symmetric matrices as the numbers of one half."""

from __future__ import annotations

import numpy as np
import pytest

from sylpose.geometry.matrices import symmetric_of, upper_of


@pytest.mark.parametrize("n", [1, 2, 3, 6, 9])
def test_one_half_is_all_of_a_symmetric_matrix(n: int) -> None:
    half = np.random.default_rng(n).standard_normal((n, n))
    matrix = half + half.T
    numbers = upper_of(matrix)
    assert numbers.shape == (n * (n + 1) // 2,)
    np.testing.assert_array_equal(numbers[:n], matrix[0])
    np.testing.assert_array_equal(symmetric_of(numbers), matrix)
