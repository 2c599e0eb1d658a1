"""Solvers for Sylvester's equation A N + N B = C and its generalized form Σ A_k X B_k = C.

The steps of the distributed refinement solve such equations (`distributed.refine`). In the other estimators the
multiplier L is unknown too, and the equation is solved together with its constraint: nearly in closed form for one
camera (`one_camera`), otherwise on SO(3) (`so3`).

Singular equations raise an error. `scipy.linalg.solve_sylvester` returns numbers of the order 1e14 where A and -B share
an eigenvalue; here the error message reports that eigenvalue. An equation is singular if its smallest singular value
σ = min |A N + N B| / |N| (Frobenius norms; also called sep(A, -B)) is at most `rcond` times the size of the data,
|A| + |B| or Σ |A_k| |B_k|. Rounding changes the equation by about 1e-16 of that size, so N by a relative 1e-16 size /
σ. Both methods use this criterion.

Choice of the method, and timings: docs/equation.md.

Source: R. H. Bartels, G. W. Stewart, "Solution of the matrix equation AX + XB = C", Communications of the ACM 15
    (1972);
the generalized form by QZ: J. D. Gardiner et al., "Solution of the Sylvester matrix equation AXB' + CXD' = E", ACM
Transactions on Mathematical Software 18 (1992).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import kron, transpose
from sylpose.geometry.validation import check_number, check_real, check_sequence, format_value

Array = NDArray[Any]  # real or complex
Method = Literal["kronecker", "bartels-stewart"]

# Number of unknowns up to which the Kronecker product is faster: two-sided equation, and two general terms
# (measured: docs/equation.md#times).
KRONECKER_UNKNOWNS, KRONECKER_UNKNOWNS_GENERAL = 50, 200
# The Kronecker matrix has the square of this number of entries: 200 MB, and as much again for its inverse (choice).
MAX_KRONECKER_UNKNOWNS = 5000
# Inverse iterations for σ. The first finds a tiny σ up to the start vector's component along its singular vector, about
# 1 / sqrt(unknowns); the others remove that factor
# (measured: docs/equation.md#when-an-equation-is-singular).
INVERSE_ITERATIONS = 3
# Rank and null vector of a singular generalized equation are reported up to this number of unknowns (choice: time).
MAX_REPORTED_UNKNOWNS = 400
EPSILON = float(np.finfo(float).eps)


class SingularSylvesterError(ValueError):
    """Singular Sylvester equation: no solution, many solutions, or one dominated by rounding errors."""


def solve_sylvester(
    A: ArrayLike, B: ArrayLike, C: ArrayLike, method: Method | None = None, rcond: float = 1e-12
) -> FloatArray:
    """Solve A N + N B = C.

    Args:
        A: (..., m, m).
        B: (..., n, n).
        C: (..., m, n). Leading axes broadcast.
        method: "kronecker" solves the dense system (A ⊗ I + I ⊗ B') vec(N) = vec(C): for small equations and batches.
            "bartels-stewart" uses the Schur forms of A and B and solves the batch sequentially: for large equations.
            None selects "kronecker" up to 50 unknowns m n, otherwise "bartels-stewart".
        rcond: the equation is singular if its smallest singular value is at most this times the size of A and B.

    Returns:
        (..., m, n) N.

    Raises:
        SingularSylvesterError: the equation is singular; the message lists the colliding eigenvalues of A and -B, and
            the index in the batch.
        ValueError: shapes do not match; values are complex, infinite or NaN; too many unknowns for "kronecker" (5000);
            the solution exceeds the range of floating point numbers.
    """
    a, b, c = _square_matrices(A, "A"), _square_matrices(B, "B"), _finite_matrices(C, "C")
    batch, method = _check_input([a, b], c, method, rcond, KRONECKER_UNKNOWNS)
    # With entries below 2 no product or sum of squares overflows; powers of two bring no rounding.
    exponent, rhs_exponent = np.maximum(_max_exponent(a), _max_exponent(b)), _max_exponent(c)
    a, b, c = np.ldexp(a, -exponent), np.ldexp(b, -exponent), np.ldexp(c, -rhs_exponent)
    size = _norm_bound(a) + _norm_bound(b)
    if method == "kronecker":
        system = _kronecker_system([a, np.eye(a.shape[-1])], [np.eye(b.shape[-1]), b])
        solution, sigma = _solve_kronecker(system, c, rcond * size)
    else:
        solution, sigma = _solve_schur(_reduce_schur, [a, b], c)
    index = _find_singular(sigma, rcond * size, batch)
    if index is not None:
        unit = 2.0 ** _select_value(exponent[..., 0, 0], batch, index)
        a, b = _select_matrix(a, batch, index), _select_matrix(b, batch, index)
        pairs = _describe_eigenvalues(a, b, _select_value(sigma, batch, index), unit)
        raise SingularSylvesterError(f"A N + N B = C{_describe_singularity(sigma, size, batch, index)}{pairs}")
    return _rescale(solution, rhs_exponent - exponent)


def solve_generalized_sylvester(
    As: Sequence[ArrayLike], Bs: Sequence[ArrayLike], C: ArrayLike, method: Method | None = None, rcond: float = 1e-12
) -> FloatArray:
    """Solve Σ A_k X B_k = C.

    Args:
        As: K arrays (..., m, m).
        Bs: K arrays (..., n, n).
        C: (..., m, n). Leading axes broadcast.
        method: "kronecker" solves the dense system Σ (A_k ⊗ B_k') vec(X) = vec(C). "bartels-stewart", for K <= 2 only,
            uses the generalized Schur forms (QZ) of A_1, A_2 and B_1, B_2, which may all be singular. None selects
            "bartels-stewart" for K <= 2 and more than 200 unknowns, otherwise "kronecker".
        rcond: the equation is singular if its smallest singular value is at most this times Σ |A_k| |B_k|.

    Returns:
        (..., m, n) X.

    Raises:
        SingularSylvesterError: the equation is singular; the message contains, up to 400 unknowns, the rank and a null
            vector of the system, and for K = 2 the colliding eigenvalues of the pencils A_1 - λ A_2 and B_2 + λ B_1.
        ValueError: shapes do not match; values are complex, infinite or NaN; too many unknowns for "kronecker" (5000);
            K > 2 for "bartels-stewart"; the solution exceeds the range of floating point numbers.
    """
    As, Bs = check_sequence(As, "As"), check_sequence(Bs, "Bs")
    if len(As) != len(Bs) or len(As) == 0:
        raise ValueError(f"As and Bs must have the same length, at least one; got {len(As)} and {len(Bs)}")
    a = [_square_matrices(x, f"As[{k}]") for k, x in enumerate(As)]
    b = [_square_matrices(x, f"Bs[{k}]") for k, x in enumerate(Bs)]
    if len({x.shape[-1] for x in a}) > 1 or len({x.shape[-1] for x in b}) > 1:
        raise ValueError("all As must have the same size, and all Bs the same size")
    c = _finite_matrices(C, "C")
    batch, method = _check_input([*a, *b], c, method, rcond, KRONECKER_UNKNOWNS_GENERAL, terms=len(a))
    # Scale each B to entries below 2, and each A by its term's size relative to the largest term.
    b_exponents = [_max_exponent(x) for x in b]
    exponent = np.max(np.broadcast_arrays(*(_max_exponent(x) + e for x, e in zip(a, b_exponents, strict=True))), axis=0)
    rhs_exponent = _max_exponent(c)
    c = np.ldexp(c, -rhs_exponent)
    a = [np.ldexp(x, e - exponent) for x, e in zip(a, b_exponents, strict=True)]
    b = [np.ldexp(x, -e) for x, e in zip(b, b_exponents, strict=True)]
    size = np.sum(np.broadcast_arrays(*(_norm_bound(x) * _norm_bound(y) for x, y in zip(a, b, strict=True))), axis=0)
    if method == "kronecker":
        solution, sigma = _solve_kronecker(_kronecker_system(a, b), c, rcond * size)
    else:
        # A single term is treated as two, the second one zero.
        pencils = [a[0], a[1], b[0], b[1]] if len(a) == 2 else [a[0], 0 * a[0], b[0], 0 * b[0]]
        solution, sigma = _solve_schur(_reduce_qz, pencils, c)
    index = _find_singular(sigma, rcond * size, batch)
    if index is not None:
        a, b = ([_select_matrix(x, batch, index) for x in terms] for terms in (a, b))
        reasons = ""
        if c.shape[-2] * c.shape[-1] <= MAX_REPORTED_UNKNOWNS:
            reasons = _describe_rank(_kronecker_system(a, b), rcond * _select_value(size, batch, index), c.shape)
        if len(a) == 2:
            unit = 2.0 ** _select_value(np.clip(b_exponents[1] - b_exponents[0], -1000, 1000)[..., 0, 0], batch, index)
            reasons += _describe_pencils(a, b, _select_value(sigma, batch, index), unit)
        raise SingularSylvesterError(f"Σ A_k X B_k = C{_describe_singularity(sigma, size, batch, index)}{reasons}")
    return _rescale(solution, rhs_exponent - exponent)


# --- Input ------------------------------------------------------------------------------------------------------------


def _finite_matrices(array: ArrayLike, name: str) -> FloatArray:
    out = check_real(array, "a finite matrix or a stack of them", name)
    if out.ndim < 2 or 0 in out.shape[-2:] or not np.isfinite(out).all():
        raise ValueError(f"{name} must be a finite matrix or a stack of them, got shape {out.shape}")
    return out


def _square_matrices(array: ArrayLike, name: str) -> FloatArray:
    out = _finite_matrices(array, name)
    if out.shape[-1] != out.shape[-2]:
        raise ValueError(f"{name} must be square, got shape {out.shape}")
    return out


def _check_input(
    matrices: list[FloatArray],
    c: FloatArray,
    method: Method | None,
    rcond: float,
    limit: int,
    terms: int = 2,
) -> tuple[tuple[int, ...], Method]:
    """Return the batch's shape and the method; the first matrix is m x m, the last n x n."""
    m, n = matrices[0].shape[-1], matrices[-1].shape[-1]
    if c.shape[-2:] != (m, n):
        raise ValueError(f"C must be {m}x{n} to fit the other matrices, got shape {c.shape}")
    leading = [x.shape[:-2] for x in (*matrices, c)]
    try:
        batch = np.broadcast_shapes(*leading)
    except ValueError:
        raise ValueError(f"the leading axes do not broadcast: {', '.join(map(str, leading))}") from None
    if not EPSILON <= check_number(rcond, "rcond") < 1:
        raise ValueError(f"rcond must be at least {EPSILON:.3g} and below 1, got {rcond}")
    if method is None:
        method = "kronecker" if m * n <= limit or terms > 2 else "bartels-stewart"
    if not isinstance(method, str) or method not in ("kronecker", "bartels-stewart"):
        raise ValueError(f'method must be "kronecker" or "bartels-stewart", got {format_value(method)}')
    if method == "kronecker" and m * n > MAX_KRONECKER_UNKNOWNS:
        raise ValueError(f"{m}x{n} unknowns are too many for the Kronecker product: at most {MAX_KRONECKER_UNKNOWNS}")
    if method == "bartels-stewart" and terms > 2:
        raise ValueError(f"Bartels-Stewart solves equations of at most two terms, got {terms}")
    return batch, method


def _max_exponent(x: FloatArray) -> NDArray[np.int_]:
    """Return (..., 1, 1) binary exponents of the largest entries; -9999 for zero matrices."""
    largest = np.abs(x).max(axis=(-2, -1), keepdims=True)
    return np.where(largest > 0, np.frexp(largest)[1] - 1, -9999)


def _rescale(x: FloatArray, exponent: NDArray[np.int_]) -> FloatArray:
    with np.errstate(over="ignore"):
        out = np.ldexp(x, exponent)
    if not np.isfinite(out).all():
        raise ValueError("the solution exceeds the range of floating point numbers")
    return np.asarray(out)


def _norm_bound(x: Array) -> FloatArray:
    """Return (...) upper bounds of the spectral norm, sqrt(|x|_1 |x|_inf), at most sqrt(n) times too large."""
    entries = np.abs(x)
    return np.asarray(np.sqrt(entries.sum(axis=-1).max(axis=-1)) * np.sqrt(entries.sum(axis=-2).max(axis=-1)))


# --- Methods: they return the solution and σ and do not check for singularity -----------------------------------------


def _kronecker_system(a: Sequence[FloatArray], b: Sequence[FloatArray]) -> FloatArray:
    """Return Σ A_k ⊗ B_k', (..., m n, m n)."""
    return sum((kron(x, transpose(y)) for x, y in zip(a, b, strict=True)), start=np.zeros(()))


def _solve_kronecker(system: FloatArray, c: FloatArray, limit: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return X (..., m, n) and σ per system: exact where it may be at most `limit`, else a lower bound."""
    try:
        inverse = np.linalg.inv(system)
    except np.linalg.LinAlgError:  # a pivot of one of them is exactly zero
        values = np.linalg.svd(system, compute_uv=False)[..., -1]
        return np.zeros(c.shape), np.where(values == values.min(), 0.0, values)
    with np.errstate(all="ignore"):  # inf and NaN where it is singular
        sigma = np.asarray(1 / _norm_bound(inverse))
        # The inverse takes a third of the time of the singular values and shows that nearly all systems are regular.
        uncertain = ~(sigma > limit)
        if uncertain.any():
            sigma[uncertain] = np.linalg.svd(system[uncertain], compute_uv=False)[..., -1]
        vec = c.reshape(*c.shape[:-2], system.shape[-1], 1)
        x = inverse @ vec
        # Two refinements give a residual as small as that of elimination, also for nearly singular systems.
        for _ in range(2):
            x = x + inverse @ (vec - system @ x)
    return x.reshape(*x.shape[:-2], *c.shape[-2:]), sigma


class _TriangularEquation(NamedTuple):
    """Triangular equation after Bartels and Stewart: X = recover(solve(transform_rhs(C))).

    `solve_adjoint` solves with the transposed operator. `transform_rhs` and `recover` are orthogonal or unitary, so
    that the triangular equation has the same σ.
    """

    transform_rhs: Callable[[Array], Array]
    solve: Callable[[Array], Array]
    solve_adjoint: Callable[[Array], Array]
    recover: Callable[[Array], Array]


def _solve_schur(
    reduce_equation: Callable[..., _TriangularEquation], matrices: list[FloatArray], c: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return X (..., m, n) and σ (...), solving the batch sequentially."""
    batch = np.broadcast_shapes(*(x.shape[:-2] for x in (*matrices, c)))
    solution, sigma = np.empty((*batch, *c.shape[-2:])), np.empty(batch)
    # The same start vector for all members: the same equation always gets the same σ.
    start = np.random.default_rng(0).standard_normal(c.shape[-2:])
    for i in np.ndindex(*batch):
        triangular = reduce_equation(*(_select_matrix(x, batch, i) for x in matrices))
        with np.errstate(all="ignore"):  # inf and NaN where it is singular
            sigma[i] = _min_singular_value(triangular, start)
            rhs = triangular.transform_rhs(_select_matrix(c, batch, i))
            solution[i] = triangular.recover(triangular.solve(rhs)).real
    return solution, sigma


def _min_singular_value(triangular: _TriangularEquation, x: Array) -> float:
    """Return σ by inverse iteration on the operator times its adjoint: a close upper bound."""
    growth = 0.0
    for _ in range(INVERSE_ITERATIONS):
        y = triangular.solve(x / np.linalg.norm(x))
        growth = float(np.linalg.norm(y))
        if not np.isfinite(growth):
            return 0.0
        x = triangular.solve_adjoint(y / growth)
    return 1 / growth


def _reduce_schur(a: FloatArray, b: FloatArray) -> _TriangularEquation:
    """Reduce A N + N B by A = U T U', B = V S V' to T Y + Y S with Y = U'N V."""
    t, u = linalg.schur(a, check_finite=False)
    s, v = linalg.schur(b, check_finite=False)

    def solve(f: Array, transposed: str = "N") -> Array:
        # LAPACK perturbs eigenvalues that coincide up to rounding; σ then shows it.
        y, scale, _ = linalg.lapack.dtrsyl(t, s, f, trana=transposed, tranb=transposed)
        return np.asarray(y / scale)

    return _TriangularEquation(
        lambda c: np.asarray(u.T @ c @ v), solve, lambda f: solve(f, "T"), lambda y: np.asarray(u @ y @ v.T)
    )


def _reduce_qz(a1: FloatArray, a2: FloatArray, b1: FloatArray, b2: FloatArray) -> _TriangularEquation:
    """Reduce A1 X B1 + A2 X B2 to S1 Y P1 + S2 Y P2, all S and P triangular.

    A_k = Q S_k Z^H, B_k = U P_k V^H, Y = Z^H X U.
    """
    s1, s2, q, z = linalg.qz(a1, a2, output="complex", check_finite=False)
    p1, p2, u, v = linalg.qz(b1, b2, output="complex", check_finite=False)
    # Conjugated, transposed and reversed, the matrices are upper triangular again.
    s1r, s2r, p1r, p2r = (x.conj().T[::-1, ::-1] for x in (s1, s2, p1, p2))
    return _TriangularEquation(
        lambda c: np.asarray(q.conj().T @ c @ v),
        lambda f: _solve_triangular(s1, s2, p1, p2, f),
        lambda f: _solve_triangular(s1r, s2r, p1r, p2r, f[::-1, ::-1])[::-1, ::-1],
        lambda y: np.asarray(z @ y @ u.conj().T),
    )


def _solve_triangular(s1: Array, s2: Array, p1: Array, p2: Array, f: Array) -> Array:
    """Solve S1 Y P1 + S2 Y P2 = F, all upper triangular, column by column."""
    y = np.zeros(f.shape, complex)
    for j in range(f.shape[1]):
        rhs = f[:, j] - s1 @ (y[:, :j] @ p1[:j, j]) - s2 @ (y[:, :j] @ p2[:j, j])
        matrix = p1[j, j] * s1 + p2[j, j] * s2
        pivots = np.einsum("ii->i", matrix)
        # As LAPACK does: a pivot below rounding is replaced by the rounding unit; σ then shows it.
        pivots[np.abs(pivots) < EPSILON] = EPSILON
        y[:, j] = linalg.solve_triangular(matrix, rhs, check_finite=False)
    return y


# --- Singular equations -----------------------------------------------------------------------------------------------


def _find_singular(sigma: FloatArray, threshold: FloatArray, batch: tuple[int, ...]) -> tuple[int, ...] | None:
    # Schur forms give no σ for the zero operator, whose size is zero.
    singular = np.broadcast_to(~(sigma > threshold) | (threshold == 0), batch)
    return tuple(int(i) for i in np.argwhere(singular)[0]) if singular.any() else None


def _select_matrix(x: Array, batch: tuple[int, ...], index: tuple[int, ...]) -> Array:
    return np.asarray(np.broadcast_to(x, (*batch, *x.shape[-2:]))[index])


def _select_value(x: Array, batch: tuple[int, ...], index: tuple[int, ...]) -> float:
    return float(np.broadcast_to(x, batch)[index])


def _describe_singularity(sigma: FloatArray, size: FloatArray, batch: tuple[int, ...], index: tuple[int, ...]) -> str:
    where = f" at index {', '.join(map(str, index))} of the batch" if index else ""
    ratio = _select_value(sigma, batch, index) / max(_select_value(size, batch, index), 1e-300)
    return f"{where} is singular, σ is {ratio:.0e} of the size of the data"


def _describe_eigenvalues(a: FloatArray, b: FloatArray, sigma: float, unit: float) -> str:
    """Describe the closest eigenvalues of A and -B, in units of `unit`."""
    first, second = np.linalg.eigvals(a), np.linalg.eigvals(-b)
    # For normal matrices σ equals the gap.
    near = max(10 * sigma, 1e-9 * float(np.abs(np.concatenate([first, second])).max()))
    with np.errstate(over="ignore"):
        return _describe_closest(np.abs(first[:, None] - second), near, (unit * first, unit * second), ("A", "-B"))


def _describe_pencils(a: list[FloatArray], b: list[FloatArray], sigma: float, unit: float) -> str:
    """Describe the closest eigenvalues of A_1 - λ A_2 and B_2 + λ B_1, in units of `unit`.

    They can be infinite if A_2 or B_1 is singular.
    """
    pairs = [linalg.eigvals(x, y, homogeneous_eigvals=True) for x, y in ((a[0], a[1]), (b[1], -b[0]))]
    first, second = (p / np.maximum(np.linalg.norm(p, axis=0), 1e-300) for p in pairs)
    gaps = np.abs(first[0][:, None] * second[1] - first[1][:, None] * second[0])
    values = []
    for p in (first, second):
        finite = np.abs(p[1]) > EPSILON
        beyond = np.where(np.abs(p[0]) > EPSILON, np.inf, np.nan)
        values.append(np.where(finite, unit * p[0] / np.where(finite, p[1], 1), beyond))
    return _describe_closest(gaps, max(10 * sigma, 1e-9), values, ("A_1 - λ A_2", "B_2 + λ B_1"))


def _describe_closest(gaps: FloatArray, tolerance: float, values: Sequence[Array], names: tuple[str, str]) -> str:
    """Describe the pairs of eigenvalues whose gap is within `tolerance`, or else the closest pair."""
    collide = bool(gaps.min() <= tolerance)
    indices = np.argwhere(gaps <= (tolerance if collide else gaps.min()))
    pairs = [
        f"{_format_number(values[0][i])} of {names[0]} with {_format_number(values[1][j])} of {names[1]}"
        for i, j in indices[:3]
    ]
    if len(indices) > 3:
        pairs.append(f"{len(indices) - 3} more")
    start = "eigenvalues collide," if collide else "the matrices are far from normal, closest eigenvalues"
    return f"; {start} {'; '.join(pairs)}"


def _format_number(x: complex) -> str:
    """Format without minus zeros or a zero imaginary part; NaN is an eigenvalue 0 / 0 of a singular pencil."""
    if np.isnan(x):
        return "any number"
    real, imaginary = x.real + 0.0, x.imag + 0.0
    return f"{complex(real, imaginary):.9g}" if imaginary else f"{real:.9g}"


def _describe_rank(system: FloatArray, threshold: float, shape: tuple[int, ...]) -> str:
    _, values, rows = np.linalg.svd(system)
    null = np.round(rows[-1].reshape(shape[-2:]), 6) + 0.0  # no minus zeros
    text = " ".join(np.array2string(null, precision=3, threshold=36, separator=", ").split())
    return f"; it has rank {int((values > threshold).sum())} for {len(values)} unknowns and the null vector X = {text}"
