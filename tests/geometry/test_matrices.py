"""Symmetric matrices stored as one triangle."""

from __future__ import annotations

import numpy as np
import pytest

from sylpose.geometry.matrices import pack_upper, unpack_symmetric


@pytest.mark.parametrize("n", [1, 2, 3, 6, 9])
def test_symmetric_round_trip(n: int) -> None:
    half = np.random.default_rng(n).standard_normal((n, n))
    matrix = half + half.T
    numbers = pack_upper(matrix)
    assert numbers.shape == (n * (n + 1) // 2,)
    np.testing.assert_array_equal(numbers[:n], matrix[0])
    np.testing.assert_array_equal(unpack_symmetric(numbers), matrix)
