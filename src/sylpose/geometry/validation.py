"""Validation of arguments: types, shapes and ranges, with error messages that name the argument.

Nothing is reshaped: a transposed or homogeneous array would be different points, and give a wrong but plausible result.
Public functions validate once, on entry; internal functions do not.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral, Real
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import BoolArray, FloatArray

T = TypeVar("T")

# Largest coordinate: its fourth power, and sums of very many, are in range (choice).
MAX_MAGNITUDE = 1e30
# Largest offset of a camera's time stamps, seconds: manually set clocks are hours apart (choice).
MAX_TIME_OFFSET = 86_400.0
# Largest deviation of a rotation from an orthogonal matrix, from rounding (choice).
ORTHOGONALITY_TOLERANCE = 1e-6
_INFINITY = float("inf")
# Characters of a value in a message (choice).
MAX_VALUE_LENGTH = 60


def check_rows(values: ArrayLike, width: int, name: str, *, single: bool = False) -> FloatArray:
    """Return the values as a contiguous float array (n, width); (0, width) for anything empty.

    Args:
        single: whether one row (width,) is accepted as well.

    Raises:
        ValueError: naming the argument: another shape, or values that are not real numbers.
    """
    array = check_real(values, f"(n, {width})", name)
    if array.size == 0:
        return np.empty((0, width))
    if single and array.shape == (width,):
        array = array[None]
    if array.ndim != 2 or array.shape[1] != width:
        raise ValueError(f"{name} must be (n, {width}), got shape {array.shape}")
    return np.ascontiguousarray(array, dtype=float)


def check_finite_rows(values: ArrayLike, width: int, name: str, *, maximum: float = np.inf) -> FloatArray:
    """Return the values as `check_rows` does; they must be finite and at most `maximum`.

    Raises:
        ValueError: as `check_rows`; values that are not finite, or too large.
    """
    array = check_rows(values, width, name)
    _check_range(array, name, maximum)
    return array


def check_finite(
    values: ArrayLike, shape: Sequence[int | str], name: str, *, maximum: float = MAX_MAGNITUDE
) -> FloatArray:
    """Return the values as a float array of a shape, in which a letter matches any length.

    Raises:
        ValueError: naming the argument: another shape, values that are not real, not finite or beyond `maximum`.
    """
    array = check_real(values, _format_shape(shape, {}), name)
    check_shape(array.shape, shape, name)
    _check_range(array, name, maximum)
    return array


def check_shape(
    shape: Sequence[int], expected: Sequence[int | str], name: str, lengths: dict[str, int] | None = None
) -> None:
    """Check the shape of an array.

    Args:
        shape: the shape.
        expected: the expected shape, in which a letter is any length.
        name: of the array.
        lengths: lengths by letter, shared by the arrays of a record and extended.

    Raises:
        ValueError: naming the array.
    """
    lengths = {} if lengths is None else lengths
    before = dict(lengths)
    if len(shape) != len(expected) or any(
        n != (lengths.setdefault(size, n) if isinstance(size, str) else size)
        for n, size in zip(shape, expected, strict=True)
    ):
        raise ValueError(f"{name} must be {_format_shape(expected, before)}, got shape {shape}")


def _format_shape(shape: Sequence[int | str], lengths: Mapping[str, int]) -> str:
    sizes = [str(lengths.get(size, size) if isinstance(size, str) else size) for size in shape]
    return f"({', '.join(sizes)}{',' if len(sizes) == 1 else ''})"


def are_rotations(matrices: FloatArray) -> bool | BoolArray:
    """Return whether matrices (..., 3, 3) are rotations, up to rounding."""
    # Entries of a rotation are at most 1 in magnitude; others are not multiplied, which could overflow.
    bounded = np.where((np.abs(matrices) < 2.0).all(axis=(-2, -1), keepdims=True), matrices, 0.0)
    off = np.abs(bounded @ bounded.swapaxes(-2, -1) - np.eye(3)).max(axis=(-2, -1))
    is_orthogonal = np.asarray(off <= ORTHOGONALITY_TOLERANCE)
    # The determinant of others could divide by subnormal pivots.
    orthogonal = np.where(is_orthogonal[..., None, None], bounded, np.eye(3))
    is_rotation: bool | BoolArray = is_orthogonal & (np.linalg.det(orthogonal) > 0)
    return is_rotation


def check_rotations(rotations: ArrayLike, n: int, name: str = "rotations") -> FloatArray:
    """Return (n, 3, 3) rotation matrices, checked.

    Raises:
        ValueError: naming the first matrix that is not a rotation.
    """
    out = check_real(rotations, "(C, 3, 3)", name)
    if out.ndim != 3 or out.shape[1:] != (3, 3) or len(out) != n or n == 0:
        raise ValueError(f"{name} must be (C, 3, 3) for C = {n} moments, C >= 1; got shape {out.shape}")
    if not np.all(good := are_rotations(out)):
        raise ValueError(f"{name}[{int(np.argmin(good))}] is not a rotation matrix")
    return out


def check_rotation(rotation: ArrayLike, name: str = "rotation") -> FloatArray:
    """Return a (3, 3) rotation matrix, checked.

    Raises:
        ValueError: naming the argument.
    """
    out = check_finite(rotation, (3, 3), name)
    if not are_rotations(out):
        raise ValueError(f"{name} is not a rotation matrix")
    return out


def check_number(
    value: Any,
    name: str,
    *,
    above: float | None = None,
    minimum: float = -MAX_MAGNITUDE,
    maximum: float = MAX_MAGNITUDE,
) -> float:
    """Return one finite number from `minimum` to `maximum`, and greater than `above` if that is given.

    Raises:
        ValueError: naming the argument, the value and what was expected.
    """
    expected = "a finite number"
    if above is not None or (minimum, maximum) != (-MAX_MAGNITUDE, MAX_MAGNITUDE):
        lower = f" of at least {minimum:g}" if minimum > -MAX_MAGNITUDE else ""
        lower = lower if above is None else f" above {above:g}"
        expected = f"a finite number{lower}{' and' if lower and maximum < MAX_MAGNITUDE else ''}"
        expected += f" of at most {maximum:g}" if maximum < MAX_MAGNITUDE else ""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if not isinstance(value, Real):
        raise ValueError(f"{name}: {format_value(value)} is not {expected}")
    try:
        out = float(value)
    except OverflowError:
        out = np.inf
    if not minimum <= out <= maximum or (above is not None and not out > above):
        raise ValueError(f"{name}: {format_value(value)} is not {expected}")
    return out


def check_integer(value: Any, name: str, *, minimum: int = 0, maximum: int = 2**62) -> int:
    """Return one integer from `minimum` to `maximum`.

    Raises:
        ValueError: naming the argument.
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or not minimum <= int(value) <= maximum:
        raise ValueError(f"{name}: {format_value(value)} is not a whole number from {minimum} to {maximum}")
    return int(value)


def check_bool(value: Any, name: str) -> bool:
    """Return True or False.

    Raises:
        TypeError: naming the argument.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name} must be True or False, got {format_value(value)}")
    return bool(value)


def check_choice(value: Any, choices: Iterable[str], name: str) -> str:
    """Return the value if it is one of the choices.

    Raises:
        ValueError: naming the argument and the choices.
    """
    words = tuple(choices)
    if not isinstance(value, str) or value not in words:
        raise ValueError(f"{name}: {format_value(value)} is not one of {', '.join(words)}")
    return value


def check_type(value: Any, kind: type[T] | tuple[type[T], ...], name: str) -> T:
    """Return an object of this type.

    Raises:
        TypeError: naming the argument.
    """
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        raise TypeError(f"{name} must be {' or '.join(k.__name__ for k in kinds)}, got {format_value(value)}")
    return value


def check_list(values: Any, kind: type[T], name: str, n: int | None = None) -> list[T]:
    """Return a list of objects of this type.

    Args:
        n: required number: one per camera; None for any.

    Raises:
        TypeError: naming the argument: not a sequence, or an element of another type.
        ValueError: not `n` elements.
    """
    out: list[T] = check_sequence(values, name, n, description=f"sequence of {kind.__name__}")
    for k, value in enumerate(out):
        if not isinstance(value, kind):
            raise TypeError(f"{name}[{k}] must be {kind.__name__}, got {format_value(value)}")
    return out


def check_sequence(
    values: Any, name: str, n: int | None = None, unit: str = "", description: str = "sequence"
) -> list[Any]:
    """Return a list of elements of any type.

    Raises:
        TypeError, ValueError: as `check_list`.
    """
    if _is_not_sequence(values) or not isinstance(values, Iterable):
        raise TypeError(f"{name} must be a {description}, got {format_value(values)}")
    out = list(values)
    if n is not None and len(out) != n:
        raise ValueError(f"{name}: {len(out)} for {n} {unit or 'cameras'}; give one for each, in order")
    return out


def format_value(value: Any) -> str:
    """Format a value for a message: itself if it is short, else its type."""
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype} of shape {value.shape}"
    if value is None or isinstance(value, (bool, int, float, complex, str, np.generic)):
        try:
            text = ascii(value.item() if isinstance(value, np.generic) else value)
        except ValueError:  # Python does not convert numbers of thousands of digits
            text = "a number of thousands of digits"
        return text if len(text) <= MAX_VALUE_LENGTH else f"{text[: MAX_VALUE_LENGTH - 3]}..."
    return f"an object of type {type(value).__name__}"[: 2 * MAX_VALUE_LENGTH]


def _is_not_sequence(values: Any) -> bool:
    """Return whether values are not a plain sequence: strings, mappings, and arrays without axes."""
    return isinstance(values, (str, bytes, Mapping)) or (isinstance(values, np.ndarray) and values.ndim == 0)


def check_real(values: ArrayLike, expected: str, name: str) -> FloatArray:
    """Return the values as an array of real numbers of any shape; `expected` is the expected shape, for the message.

    Raises:
        ValueError: naming the argument.
    """
    try:
        array = np.asarray(values)
    except (ValueError, TypeError, OverflowError):  # usually rows of different lengths
        raise ValueError(f"{name} must be {expected}, got rows of different lengths or no numbers") from None
    if array.dtype.kind not in "fiub" and array.size:
        raise ValueError(f"{name} must be real numbers, got {array.dtype}")
    if not array.size:
        return np.empty(array.shape)
    array = array.astype(float, copy=False)
    return array if array.flags.writeable else array.copy()  # compiled functions require it


def _check_range(array: FloatArray, name: str, maximum: float) -> None:
    """Check magnitudes in one pass; comparisons with NaN are false."""
    largest = float(np.maximum.reduce(np.abs(array), axis=None, initial=0.0))
    if not largest <= maximum or largest == _INFINITY:
        if largest < _INFINITY:
            raise ValueError(f"{name} has values beyond {maximum:g}: {largest:g}")
        raise ValueError(f"{name} has values that are not finite")
