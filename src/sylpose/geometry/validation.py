"""What users give: of the shape and kind that is asked for, or a sentence that names the argument.

Nothing is reshaped: a transposed or homogeneous array would be other points, and a wrong answer that looks right. Public
functions ask once, at the door; what they call is unchecked.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral, Real
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray

__all__ = [
    "MOST",
    "finite",
    "finite_rows",
    "items",
    "kind_of",
    "listed",
    "number",
    "one_of",
    "real",
    "rows",
    "shown",
    "truth",
    "whole",
]

T = TypeVar("T")

# No coordinate is larger: its fourth power, and sums of a great many, are in range (choice).
MOST = 1e30
_INFINITY = float("inf")
# Characters of a value in a sentence (choice).
SAID = 60


def rows(values: ArrayLike, width: int, name: str, *, single: bool = False) -> FloatArray:
    """The values as an array (n, width) of floats, row by row in memory; (0, width) of anything empty.

    Args:
        single: one row (width,) is taken, too.

    Raises:
        ValueError: naming the argument: another shape, or no real numbers.
    """
    array = real(values, f"(n, {width})", name)
    if array.size == 0:
        return np.empty((0, width))
    if single and array.shape == (width,):
        array = array[None]
    if array.ndim != 2 or array.shape[1] != width:
        raise ValueError(f"{name} must be (n, {width}), got shape {array.shape}")
    return np.ascontiguousarray(array, dtype=float)


def finite_rows(values: ArrayLike, width: int, name: str, *, most: float = np.inf) -> FloatArray:
    """The same, without NaN and infinity, nor numbers beyond `most`.

    Raises:
        ValueError: as `rows`; values that are not finite, or too large.
    """
    array = rows(values, width, name)
    _in_range(array, name, most)
    return array


def finite(values: ArrayLike, shape: Sequence[int | str], name: str, *, most: float = MOST) -> FloatArray:
    """The values as an array of floats of this shape, a letter standing for any length.

    Raises:
        ValueError: naming the argument: another shape, no real numbers, values that are not finite or beyond `most`.
    """
    wanted = f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
    array = real(values, wanted, name)
    if array.ndim != len(shape) or any(
        isinstance(n, int) and n != its for n, its in zip(shape, array.shape, strict=True)
    ):
        raise ValueError(f"{name} must be {wanted}, got shape {array.shape}")
    _in_range(array, name, most)
    return array


def number(value: Any, name: str, *, above: float | None = None, least: float = -MOST, most: float = MOST) -> float:
    """One finite number, from `least` to `most`; more than `above`, where that is given.

    Raises:
        ValueError: naming the argument, what is wrong with it and what was expected.
    """
    wanted = "a finite number"
    if above is not None or (least, most) != (-MOST, MOST):
        lower = f" above {above:g}" if above is not None else f" of at least {least:g}" if least > -MOST else ""
        wanted = f"a finite number{lower}{' and' if lower and most < MOST else ''}"
        wanted += f" of at most {most:g}" if most < MOST else ""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if not isinstance(value, Real):
        raise ValueError(f"{name}: {shown(value)} is not {wanted}")
    try:
        out = float(value)
    except OverflowError:
        out = np.inf
    if not least <= out <= most or (above is not None and not out > above):
        raise ValueError(f"{name}: {shown(value)} is not {wanted}")
    return out


def whole(value: Any, name: str, *, least: int = 0, most: int = 2**62) -> int:
    """One whole number, from `least` to `most`.

    Raises:
        ValueError: naming the argument.
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or not least <= int(value) <= most:
        raise ValueError(f"{name}: {shown(value)} is not a whole number from {least} to {most}")
    return int(value)


def truth(value: Any, name: str) -> bool:
    """True or False.

    Raises:
        TypeError: naming the argument.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def one_of(value: Any, known: Iterable[str], name: str) -> str:
    """One of these words.

    Raises:
        ValueError: naming the argument, and the words.
    """
    words = tuple(known)
    if not isinstance(value, str) or value not in words:
        raise ValueError(f"{name}: {shown(value)} is not one of {', '.join(words)}")
    return value


def kind_of(value: Any, kind: type[T] | tuple[type[T], ...], name: str) -> T:
    """An object of this kind.

    Raises:
        TypeError: naming the argument.
    """
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        raise TypeError(f"{name} must be {' or '.join(k.__name__ for k in kinds)}, got {shown(value)}")
    return value


def listed(values: Any, kind: type[T], name: str, n: int | None = None, of: str = "") -> list[T]:
    """Objects of this kind, in order; `n` of them, one for each camera, or for each of what is said.

    Raises:
        TypeError: naming the argument: no sequence, or something of another kind in it.
        ValueError: not `n`.
    """
    out: list[T] = items(values, name, n, of, what=f"sequence of {kind.__name__}")
    for k, value in enumerate(out):
        if not isinstance(value, kind):
            raise TypeError(f"{name}[{k}] must be {kind.__name__}, got {shown(value)}")
    return out


def items(values: Any, name: str, n: int | None = None, of: str = "", what: str = "sequence") -> list[Any]:
    """The same, of what is looked at elsewhere.

    Raises:
        TypeError, ValueError: as `listed`.
    """
    if _no_list(values) or not isinstance(values, Iterable):
        raise TypeError(f"{name} must be a {what}, got {shown(values)}")
    out = list(values)
    if n is not None and len(out) != n:
        raise ValueError(f"{name}: {len(out)} for {n} {of or 'cameras'}; give one for each, in order")
    return out


def shown(value: Any) -> str:
    """A value in a sentence: itself where it is short, else what it is."""
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype} of shape {value.shape}"
    if value is None or isinstance(value, (bool, int, float, complex, str, np.generic)):
        try:
            said = ascii(value.item() if isinstance(value, np.generic) else value)
        except ValueError:  # numbers of thousands of digits are not written
            said = "a number of thousands of digits"
        return said if len(said) <= SAID else f"{said[: SAID - 3]}..."
    return f"an object of type {type(value).__name__}"[: 2 * SAID]


def _no_list(values: Any) -> bool:
    """Words and tables have an order of their own; an array without axes has none."""
    return isinstance(values, (str, bytes, Mapping)) or (isinstance(values, np.ndarray) and values.ndim == 0)


def real(values: ArrayLike, wanted: str, name: str) -> FloatArray:
    """The values as an array of real numbers of any shape; `wanted`: what is expected, for the sentence.

    Raises:
        ValueError: naming the argument.
    """
    try:
        array = np.asarray(values)
    except (ValueError, TypeError, OverflowError):  # rows of different lengths, mostly
        raise ValueError(f"{name} must be {wanted}, got rows of different lengths or no numbers") from None
    if array.dtype.kind not in "fiub" and array.size:
        raise ValueError(f"{name} must be real numbers, got {array.dtype}")
    if not array.size:
        return np.empty(array.shape)
    array = array.astype(float, copy=False)
    return array if array.flags.writeable else array.copy()  # compiled functions want them so


def _in_range(array: FloatArray, name: str, most: float) -> None:
    """In one pass over the numbers: NaN is at most nothing."""
    largest = float(np.maximum.reduce(np.abs(array), axis=None, initial=0.0))
    if not largest <= most or largest == _INFINITY:
        if largest < _INFINITY:
            raise ValueError(f"{name} has values beyond {most:g}: {largest:g}")
        raise ValueError(f"{name} has values that are not finite")
