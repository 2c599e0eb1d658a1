"""Arrays that users give: of the shape and kind that is asked for, or a sentence that names the argument.

Nothing is reshaped: a transposed or homogeneous array would be other points, and a wrong answer that looks right.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sylpose.numerics.arrays import FloatArray

__all__ = ["finite_rows", "rows"]


def rows(values: ArrayLike, width: int, name: str, *, single: bool = False) -> FloatArray:
    """The values as an array (n, width) of floats, row by row in memory; (0, width) of anything empty.

    Args:
        single: one row (width,) is taken, too.

    Raises:
        ValueError: naming the argument: another shape, or no real numbers.
    """
    try:
        array = np.asarray(values)
    except ValueError:  # rows of different lengths
        raise ValueError(f"{name} must be (n, {width}), got rows of different lengths") from None
    if array.size == 0:
        return np.empty((0, width))
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{name} must be real numbers, got {array.dtype}")
    if single and array.shape == (width,):
        array = array[None]
    if array.ndim != 2 or array.shape[1] != width:
        raise ValueError(f"{name} must be (n, {width}), got shape {array.shape}")
    return np.ascontiguousarray(array, dtype=float)


def finite_rows(values: ArrayLike, width: int, name: str) -> FloatArray:
    """The same, without NaN and infinity.

    Raises:
        ValueError: as `rows`; values that are not finite.
    """
    array = rows(values, width, name)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has values that are not finite")
    return array
