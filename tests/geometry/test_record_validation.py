"""Values against types: an alias is what it stands for."""

from __future__ import annotations

from types import GenericAlias, SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

from sylpose.geometry.record_validation import typed

T = TypeVar("T", bound=np.generic)


def aliased(number: type[np.generic]) -> Any:
    """NDArray of such numbers as NumPy 2.5 spells it, which takes Python 3.12."""
    array: Any = np.ndarray
    dtype: Any = np.dtype
    alias: Any = SimpleNamespace(__value__=array[tuple[Any, ...], dtype[T]])
    return GenericAlias(alias, (number,))


@pytest.mark.parametrize("hint", [NDArray[np.float64], aliased(np.float64)], ids=["plain", "alias"])
def test_arrays_are_taken_by_the_kind_of_their_numbers(hint: Any) -> None:
    values = np.zeros(3)
    assert typed(hint, values) is values
    (same,) = typed(tuple[hint, ...], [values])
    assert same is values
    for wrong in (np.zeros(3, int), [0.0, 0.0], 1.0):
        with pytest.raises(TypeError):
            typed(hint, wrong)


def test_an_alias_without_parameters() -> None:
    alias: Any = SimpleNamespace(__value__=float)
    assert typed(alias, 1) == 1.0
    with pytest.raises(TypeError):
        typed(alias, "1")
