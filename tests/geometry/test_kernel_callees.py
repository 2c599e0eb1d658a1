"""Kernels that other kernels call: compiled for their callers, and once more if Python calls them."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, leaf


@leaf
def scale(values: FloatArray, factor: float) -> None:
    """Scale an array in place."""
    for i in range(values.shape[0]):
        values[i] *= factor


@kernel
def cumulate(values: FloatArray, factor: float) -> FloatArray:
    """Return the cumulated sum of a scaled copy."""
    if not factor > 0.0:
        raise ValueError("the factor must be positive")
    out = values.copy()
    scale(out, factor)
    return np.cumsum(out)


@kernel
def cumulate_twice(values: FloatArray, factor: float) -> FloatArray:
    """Cumulate twice."""
    return cumulate(cumulate(values, factor), 1.0)


VALUES = np.array([1.0, 2.0, 4.0])


def test_result_does_not_depend_on_who_calls() -> None:
    expected = np.cumsum(np.cumsum(0.5 * VALUES))
    assert np.array_equal(cumulate_twice(VALUES, 0.5), expected)
    assert np.array_equal(cumulate(cumulate(VALUES, 0.5), 1.0), expected)
    scaled = VALUES.copy()
    scale(scaled, 0.5)
    assert np.array_equal(scaled, 0.5 * VALUES)


def test_errors_of_callees_are_raised() -> None:
    with pytest.raises(ValueError, match="the factor must be positive"):
        cumulate_twice(VALUES, 0.0)


def test_other_code_may_use_what_was_compiled_for_callees() -> None:
    """Numba shares the code of `numpy.cumsum`, which it compiled for a callee, with functions of the user."""
    cumulate_twice(VALUES, 1.0)

    def total(values: FloatArray) -> float:
        return float(np.cumsum(values)[-1] + np.cumsum(values.copy())[0])

    compiled: Any = numba.njit(total)
    assert compiled(VALUES) == 8.0
