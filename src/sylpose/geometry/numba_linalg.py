"""Compiled loops: Numba's decorators, typed, small linear algebra for them, and duplicate rows.

Compiled code is cached on disk, so only the first call after an installation or an update compiles; later processes
load it in a fraction of a second. Kernels read and write plain float64 arrays, allocate little and call no LAPACK: six
unknowns do not need it, and each LAPACK call would add a second of compilation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import types
from numba.core.options import DefaultOptions

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.kernel_cache import enable_cache, set_callee

# Maximum sweeps of Jacobi's method: five or six are enough (choice).
MAX_SWEEPS = 30

# Numba's option to omit reference counting; versions without it count (choice).
NO_REFCOUNT: Any = {"_nrt": False} if hasattr(DefaultOptions, "_nrt") else {}

# Knuth's 64 bit multiplier, and the shift of the product, whose upper bits depend on all bits of the number (choice).
HASH_MULTIPLIER, HASH_SHIFT = 6364136223846793005, 29

F = TypeVar("F", bound=Callable[..., object])


def kernel(function: F) -> F:
    """Compile a function of arrays and numbers on its first call, with its types kept for type checkers.

    Division by zero gives inf or NaN as in NumPy, and the interpreter's lock is released while it runs.
    """
    return cast(F, _make_dispatcher(function))


def leaf(function: F) -> F:
    """Compile as `kernel`, without reference counting: for functions that allocate no arrays.

    Reference counting takes a hundred cycles for each array of a record, in and out again, as long as many of these
    functions run.
    """
    return cast(F, _make_dispatcher(function, **NO_REFCOUNT))


def _make_dispatcher(function: Callable[..., object], **options: Any) -> Any:
    """Return Numba's dispatcher of a function, with the disk cache, and another compilation for its callers."""
    njit: Any = partial(numba.njit, error_model="numpy", no_cfunc_wrapper=True, **options)
    dispatcher = enable_cache(njit(nogil=True)(function))
    if dispatcher is not function:
        callee = njit(no_cpython_wrapper=True)(function)
        set_callee(dispatcher, callee)
        resolve_call, unliteral = callee.get_call_template, cast(Any, types.unliteral)

        def resolve_without_literals(args: Sequence[Any], kws: Mapping[str, Any]) -> Any:
            # Numba would compile a callee for each number, True and False that callers write; also for the first values
            # of their variables, until it infers that these change.
            return resolve_call([unliteral(a) for a in args], {name: unliteral(a) for name, a in kws.items()})

        dispatcher.get_call_template = resolve_without_literals
    return dispatcher


@leaf
def cholesky(a: FloatArray) -> bool:
    """Replace a symmetric a (n, n) by its Cholesky factor (lower triangle) in place.

    Returns:
        False, with a half done, where a is not positive definite.
    """
    n = a.shape[0]
    for i in range(n):
        for j in range(i + 1):
            s = a[i, j]
            for k in range(j):
                s -= a[i, k] * a[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                a[i, i] = np.sqrt(s)
            else:
                a[i, j] = s / a[j, j]
    return True


@leaf
def solve_factored(a: FloatArray, b: FloatArray) -> None:
    """Replace b (n,) by x with L L' x = b, for a (n, n) whose lower triangle is L (`cholesky`)."""
    n = a.shape[0]
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= a[i, k] * b[k]
        b[i] = s / a[i, i]
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= a[k, i] * b[k]
        b[i] = s / a[i, i]


@leaf
def cholesky_solve(a: FloatArray, b: FloatArray) -> bool:
    """Solve a x = b in place: b (n,) becomes x, a (n, n) symmetric becomes its Cholesky factor (lower).

    Returns:
        False, with a half done, where a is not positive definite.
    """
    if not cholesky(a):
        return False
    solve_factored(a, b)
    return True


@leaf
def symmetric_eigen(a: FloatArray, values: FloatArray, vectors: FloatArray) -> None:
    """Compute eigenvalues (n,), ascending, and eigenvectors (n, n), the columns, of a small symmetric a (n, n).

    a is overwritten. Source: Jacobi's method, Golub & Van Loan, "Matrix Computations", section 8.5.
    """
    n = a.shape[0]
    for i in range(n):
        for j in range(n):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(MAX_SWEEPS):
        off, on = 0.0, 0.0
        for i in range(n):
            on += a[i, i] * a[i, i]
            for j in range(i):
                off += a[i, j] * a[i, j]
        # NaN ends the loop as well.
        if not off > 1e-30 * on:
            break
        for p in range(n):
            for q in range(p + 1, n):
                if a[p, q] == 0.0:
                    continue
                half = 0.5 * (a[q, q] - a[p, p]) / a[p, q]
                t = 1.0 / (abs(half) + np.sqrt(half * half + 1.0))
                t = t if half >= 0.0 else -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(n):
                    x, y = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * x - s * y, s * x + c * y
                for k in range(n):
                    x, y = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * x - s * y, s * x + c * y
                a[p, q] = a[q, p] = 0.0
                for k in range(n):
                    x, y = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = c * x - s * y, s * x + c * y
    for i in range(n):
        values[i] = a[i, i]
    for i in range(n):
        smallest = i
        for j in range(i + 1, n):
            if values[j] < values[smallest]:
                smallest = j
        if smallest != i:
            values[i], values[smallest] = values[smallest], values[i]
            for k in range(n):
                vectors[k, i], vectors[k, smallest] = vectors[k, smallest], vectors[k, i]


@leaf
def dot(a: FloatArray, b: FloatArray) -> float:
    """Return the scalar product of a and b (n,), summed from the first to the last."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@leaf
def compute_sum(values: FloatArray) -> float:
    """Return the sum of values (n,) in four independent partial sums, in the same order on every machine."""
    n = values.shape[0]
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    for k in range(n // 4):
        s0 += values[4 * k]
        s1 += values[4 * k + 1]
        s2 += values[4 * k + 2]
        s3 += values[4 * k + 3]
    for k in range(4 * (n // 4), n):
        s0 += values[k]
    return float((s0 + s1) + (s2 + s3))


@leaf
def compute_median(values: FloatArray) -> float:
    """Return the median of values (n,), n > 0, reordering them; NumPy's takes four times as long in compiled code.

    Source: Hoare's FIND, CACM 4, 1961, with unconditional moves, which avoid branch mispredictions.
    """
    n = values.shape[0]
    middle, low, high = n // 2, 0, n - 1
    while low < high:
        # Median of three as pivot, moved to the end.
        a, b, c = values[low], values[(low + high) // 2], values[high]
        pivot_index = (low + high) // 2
        if (a <= b) == (b <= c):
            pivot = b
        elif (b <= a) == (a <= c):
            pivot, pivot_index = a, low
        else:
            pivot, pivot_index = c, high
        values[pivot_index], values[high] = values[high], pivot
        boundary = low
        for i in range(low, high):
            value = values[i]
            values[i] = values[boundary]
            values[boundary] = value
            boundary += value < pivot
        values[high], values[boundary] = values[boundary], pivot
        if middle < boundary:
            high = boundary - 1
        elif middle == boundary:
            break
        elif boundary > low:
            low = boundary + 1
        else:
            # It is the smallest: all equal values go with it.
            low += 1
            for i in range(low, high + 1):
                value = values[i]
                values[i] = values[low]
                values[low] = value
                low += value <= pivot
            if middle < low:
                break
    if n % 2 == 1:
        return float(values[middle])
    lower_middle = values[0]
    for i in range(1, middle):
        lower_middle = max(lower_middle, values[i])
    return float(0.5 * (lower_middle + values[middle]))


@leaf
def so3_exp(w: FloatArray, out: FloatArray) -> None:
    """Write exp([w]x) of w (3,) to out (3, 3) by Rodrigues' formula."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if angle2 < 1e-12:
        s, c = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        s, c = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    x, y, z = w[0], w[1], w[2]
    out[0, 0] = 1.0 - c * (y * y + z * z)
    out[1, 1] = 1.0 - c * (x * x + z * z)
    out[2, 2] = 1.0 - c * (x * x + y * y)
    out[0, 1], out[1, 0] = c * x * y - s * z, c * x * y + s * z
    out[0, 2], out[2, 0] = c * x * z + s * y, c * x * z - s * y
    out[1, 2], out[2, 1] = c * y * z - s * x, c * y * z + s * x


@leaf
def apply_rotvec(w: FloatArray, rotation: FloatArray, out: FloatArray) -> None:
    """Write exp([w]x) rotation to out (3, 3), which must not be rotation."""
    so3_exp(w, out)
    for i in range(3):
        x, y, z = out[i, 0], out[i, 1], out[i, 2]
        for j in range(3):
            out[i, j] = x * rotation[0, j] + y * rotation[1, j] + z * rotation[2, j]


@kernel
def so3_log(rotation: FloatArray, out: FloatArray) -> None:
    """Write the rotation vector of a rotation matrix to out (3,): the inverse of `so3_exp`."""
    out[0] = rotation[2, 1] - rotation[1, 2]
    out[1] = rotation[0, 2] - rotation[2, 0]
    out[2] = rotation[1, 0] - rotation[0, 1]
    twice_sine = np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    trace = rotation[0, 0] + rotation[1, 1] + rotation[2, 2]
    angle = np.arctan2(twice_sine, trace - 1.0)
    if trace > -0.9:
        factor = angle / twice_sine if twice_sine > 1e-9 else 0.5
        for i in range(3):
            out[i] *= factor
        return
    # Near 180 degrees the antisymmetric part vanishes: the axis is the largest column of R + R' + (1 - trace) I.
    column = 0
    for k in range(1, 3):
        if rotation[k, k] > rotation[column, column]:
            column = k
    axis, length, sign = np.empty(3), 0.0, 0.0
    for i in range(3):
        axis[i] = rotation[i, column] + rotation[column, i] + (1.0 - trace if i == column else 0.0)
        length += axis[i] ** 2
        sign += axis[i] * out[i]
    length = np.sqrt(length) if sign >= 0.0 else -np.sqrt(length)
    for i in range(3):
        out[i] = angle * axis[i] / length


@kernel
def index_distinct_rows(a: FloatArray, b: FloatArray) -> tuple[int, IntArray, IntArray]:
    """Return the number of distinct rows, their indices (the first elements), and each row's position in them (n,)."""
    n, size, count = len(a), 4, 0
    while size < 2 * n:
        size *= 2
    # Hash table of rows with linear probing.
    table = np.full(size, -1, np.int64)
    rows, inverse = np.empty(n, np.int64), np.empty(n, np.int64)
    a_bits, b_bits = a.view(np.int64), b.view(np.int64)
    for i in range(n):
        hash_value = 0
        for part in (a_bits, b_bits):
            for k in range(part.shape[1]):
                hash_value = (hash_value ^ part[i, k]) * HASH_MULTIPLIER
                hash_value ^= hash_value >> HASH_SHIFT
        slot = hash_value & (size - 1)
        while table[slot] >= 0:
            same, first = True, rows[table[slot]]
            for k in range(a.shape[1]):
                same = same and a_bits[i, k] == a_bits[first, k]
            for k in range(b.shape[1]):
                same = same and b_bits[i, k] == b_bits[first, k]
            if same:
                break
            slot = (slot + 1) & (size - 1)
        if table[slot] < 0:
            table[slot] = count
            rows[count] = i
            count += 1
        inverse[i] = table[slot]
    return count, rows, inverse
