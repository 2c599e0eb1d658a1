"""Conversion of values to types: an alias is resolved."""

from __future__ import annotations

from types import GenericAlias, SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

from sylpose.geometry.record_validation import convert_to_type

T = TypeVar("T", bound=np.generic)


def aliased(number: type[np.generic]) -> Any:
    """Return NDArray as NumPy 2.5 defines it, which requires Python 3.12."""
    array: Any = np.ndarray
    dtype: Any = np.dtype
    alias: Any = SimpleNamespace(__value__=array[tuple[Any, ...], dtype[T]])
    return GenericAlias(alias, (number,))


@pytest.mark.parametrize("hint", [NDArray[np.float64], aliased(np.float64)], ids=["plain", "alias"])
def test_arrays_are_accepted_by_dtype_kind(hint: Any) -> None:
    values = np.zeros(3)
    assert convert_to_type(hint, values) is values
    (same,) = convert_to_type(tuple[hint, ...], [values])
    assert same is values
    for wrong in (np.zeros(3, int), [0.0, 0.0], 1.0):
        with pytest.raises(TypeError):
            convert_to_type(hint, wrong)


def test_an_alias_without_parameters() -> None:
    alias: Any = SimpleNamespace(__value__=float)
    assert convert_to_type(alias, 1) == 1.0
    with pytest.raises(TypeError):
        convert_to_type(alias, "1")
