"""Kernels that other kernels call: compiled for their callers, and once more if Python calls them.

The kernels are made by each test, since those that are loaded from the disk cache are not linked.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

import sylpose.runs.precompile  # noqa: F401 imports all modules with kernels of tracking
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.kernel_cache import _KernelCache
from sylpose.geometry.numba_linalg import kernel, leaf

VALUES = np.array([1.0, 2.0, 4.0])


class Kernels(NamedTuple):
    """Kernels, each of which calls the one before."""

    scale: Callable[[FloatArray, float], None]
    cumulate: Callable[[FloatArray, float], FloatArray]
    cumulate_twice: Callable[[FloatArray, float], FloatArray]


def forget(function: Any) -> Any:
    """Disable the disk cache of a kernel."""
    function._cache = NullCache()
    return function


@pytest.fixture
def kernels() -> Kernels:
    @leaf
    def scale(values: FloatArray, factor: float) -> None:
        for i in range(values.shape[0]):
            values[i] *= factor

    @kernel
    def cumulate(values: FloatArray, factor: float) -> FloatArray:
        if not factor > 0.0:
            raise ValueError("the factor must be positive", values[0])
        out = values.copy()
        scale(out, factor)
        return np.cumsum(out)

    @kernel
    def cumulate_twice(values: FloatArray, factor: float) -> FloatArray:
        return cumulate(cumulate(values, factor), 1.0)

    return Kernels(forget(scale), forget(cumulate), forget(cumulate_twice))


def test_result_does_not_depend_on_who_calls(kernels: Kernels) -> None:
    expected = np.cumsum(np.cumsum(0.5 * VALUES))
    assert np.array_equal(kernels.cumulate_twice(VALUES, 0.5), expected)
    assert np.array_equal(kernels.cumulate(kernels.cumulate(VALUES, 0.5), 1.0), expected)
    scaled = VALUES.copy()
    kernels.scale(scaled, 0.5)
    assert np.array_equal(scaled, 0.5 * VALUES)


def test_errors_of_callees_are_raised(kernels: Kernels) -> None:
    with pytest.raises(ValueError, match="the factor must be positive") as raised:
        kernels.cumulate_twice(VALUES, 0.0)
    assert raised.value.args == ("the factor must be positive", 1.0)


def test_other_code_may_use_what_was_compiled_for_callees(kernels: Kernels) -> None:
    """Numba shares the code of `numpy.cumsum`, which it compiled for a callee, with functions of the user."""
    kernels.cumulate_twice(VALUES, 1.0)

    def total(values: FloatArray) -> float:
        return float(np.cumsum(values)[-1] + np.cumsum(values.copy())[0])

    compiled: Any = numba.njit(total)
    assert compiled(VALUES) == 8.0


def test_kernel_that_calls_itself() -> None:
    @kernel
    def factorial(n: int) -> int:
        if n < 2:
            return 1
        return n * factorial(n - 1)

    @kernel
    def choose(n: int, k: int) -> int:
        return factorial(n) // (factorial(k) * factorial(n - k))

    assert forget(choose)(6, 2) == 15
    assert forget(factorial)(5) == 120


def test_kernels_call_only_kernels() -> None:
    """Python could not call another function of Numba, once it was compiled for a kernel that calls it."""
    modules = [module for name, module in sys.modules.items() if name.startswith("sylpose.")]
    dispatchers: list[Any] = [one for module in modules for one in vars(module).values() if isinstance(one, Dispatcher)]
    assert len(dispatchers) > 100
    assert all(isinstance(dispatcher._cache, _KernelCache) for dispatcher in dispatchers)
