"""Sylvester's equation A N + N B = C, and its generalised form Σ A_k X B_k = C, with singular ones refused.

The refinement's steps are of this kind (`distributed.refine`). The other estimators have the multiplier L among the
unknowns and solve the equation together with its constraint: nearly in closed form for one camera (`one_camera`), else
on SO(3) (`so3`).

`scipy.linalg.solve_sylvester` gives numbers of the order 1e14 where A and -B share an eigenvalue; here that is an error
that names it. An equation is singular where its least singular value, σ = min |A N + N B| / |N| (Frobenius norms; also
called sep(A, -B)), is at most `rcond` times the size of the data, |A| + |B| or Σ |A_k| |B_k|: rounding changes the
equation by about 1e-16 of that size, so N by about 1e-16 size / σ of itself. Both methods judge by this.

When to choose which, with times: docs/equation.md.

Source: R. H. Bartels, G. W. Stewart, "Solution of the matrix equation AX + XB = C", Communications of the ACM 15 (1972);
the generalised form by QZ: J. D. Gardiner et al., "Solution of the Sylvester matrix equation AXB' + CXD' = E", ACM
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
from sylpose.geometry.validation import items, number, real, shown

__all__ = ["Method", "SingularSylvesterError", "solve_generalized_sylvester", "solve_sylvester"]

Array = NDArray[Any]  # real or complex
Method = Literal["kronecker", "bartels-stewart"]

# Up to so many unknowns the Kronecker product is faster: two-sided, and of two general terms
# (measured: docs/equation.md#times).
FEW_UNKNOWNS, FEW_UNKNOWNS_OF_TERMS = 50, 200
# Its matrix has the square of this number of entries: 200 MB, and as much again for the inverse (choice).
MOST_UNKNOWNS = 5000
# Inverse iterations for σ. One finds a tiny σ but for the share that the start has in its direction, about
# 1 / sqrt(unknowns); the others make up for that share
# (measured: docs/equation.md#when-an-equation-is-singular).
ROUNDS = 3
# Rank and null direction of a singular generalised equation are reported up to so many unknowns (choice: time).
REPORTED_UNKNOWNS = 400
EPSILON = float(np.finfo(float).eps)


class SingularSylvesterError(ValueError):
    """A Sylvester's equation that has no solution, or many, or one that would be nothing but rounding."""


def solve_sylvester(
    A: ArrayLike, B: ArrayLike, C: ArrayLike, method: Method | None = None, rcond: float = 1e-12
) -> FloatArray:
    """Solve A N + N B = C.

    Args:
        A: (..., m, m).
        B: (..., n, n).
        C: (..., m, n). Leading axes broadcast.
        method: "kronecker", the dense system (A ⊗ I + I ⊗ B') vec(N) = vec(C): small equations and batches of them.
            "bartels-stewart", by the Schur forms of A and B, one member after the other: large equations. None: the
            first up to 50 unknowns m n, else the second.
        rcond: the equation is singular where its least singular value is at most this times the size of A and B.

    Returns:
        (..., m, n) N.

    Raises:
        SingularSylvesterError: naming the eigenvalues of A and -B that collide, and the member of the batch.
        ValueError: shapes that do not fit, complex, infinite or NaN values, too many unknowns for "kronecker" (5000), a
            solution beyond the range of floating point numbers.
    """
    a, b, c = _square(A, "A"), _square(B, "B"), _finite(C, "C")
    batch, method = _checked([a, b], c, method, rcond, FEW_UNKNOWNS)
    # With entries below 2 no product or sum of squares overflows; powers of two bring no rounding.
    exponent, of_c = np.maximum(_exponent(a), _exponent(b)), _exponent(c)
    a, b, c = np.ldexp(a, -exponent), np.ldexp(b, -exponent), np.ldexp(c, -of_c)
    size = _norm(a) + _norm(b)
    if method == "kronecker":
        solution, sigma = _by_kronecker(_system([a, np.eye(a.shape[-1])], [np.eye(b.shape[-1]), b]), c, size, rcond)
    else:
        solution, sigma = _by_schur(_schur_forms, [a, b], c)
    index = _first_singular(sigma, rcond * size, batch)
    if index is not None:
        unit = 2.0 ** _at(exponent[..., 0, 0], batch, index)
        pairs = _colliding(_member(a, batch, index), _member(b, batch, index), _at(sigma, batch, index), unit)
        raise SingularSylvesterError(f"A N + N B = C{_verdict(sigma, size, batch, index)}{pairs}")
    return _unscaled(solution, of_c - exponent)


def solve_generalized_sylvester(
    As: Sequence[ArrayLike], Bs: Sequence[ArrayLike], C: ArrayLike, method: Method | None = None, rcond: float = 1e-12
) -> FloatArray:
    """Solve Σ A_k X B_k = C.

    Args:
        As: K arrays (..., m, m).
        Bs: K arrays (..., n, n).
        C: (..., m, n). Leading axes broadcast.
        method: "kronecker", the dense system Σ (A_k ⊗ B_k') vec(X) = vec(C). "bartels-stewart", for K <= 2 only, by the
            generalised Schur forms (QZ) of A_1, A_2 and B_1, B_2, none of which need be regular. None: the second
            for K <= 2 and more than 200 unknowns, else the first.
        rcond: the equation is singular where its least singular value is at most this times Σ |A_k| |B_k|.

    Returns:
        (..., m, n) X.

    Raises:
        SingularSylvesterError: giving, up to 400 unknowns, the system's rank and a direction that it does not see; for
            K = 2 the eigenvalues of the pencils A_1 - λ A_2 and B_2 + λ B_1 that collide.
        ValueError: shapes that do not fit, complex, infinite or NaN values, too many unknowns for "kronecker" (5000), K > 2
            for "bartels-stewart", a solution beyond the range of floating point numbers.
    """
    As, Bs = items(As, "As"), items(Bs, "Bs")
    if len(As) != len(Bs) or len(As) == 0:
        raise ValueError(f"As and Bs must be equally many, at least one; got {len(As)} and {len(Bs)}")
    a = [_square(x, f"As[{k}]") for k, x in enumerate(As)]
    b = [_square(x, f"Bs[{k}]") for k, x in enumerate(Bs)]
    if len({x.shape[-1] for x in a}) > 1 or len({x.shape[-1] for x in b}) > 1:
        raise ValueError("all As must have one size, and all Bs one size")
    c = _finite(C, "C")
    batch, method = _checked([*a, *b], c, method, rcond, FEW_UNKNOWNS_OF_TERMS, terms=len(a))
    # Each B to entries below 2, each A to what its term is of the largest.
    of_b = [_exponent(x) for x in b]
    exponent = np.max(np.broadcast_arrays(*(_exponent(x) + e for x, e in zip(a, of_b, strict=True))), axis=0)
    of_c = _exponent(c)
    c = np.ldexp(c, -of_c)
    a = [np.ldexp(x, e - exponent) for x, e in zip(a, of_b, strict=True)]
    b = [np.ldexp(x, -e) for x, e in zip(b, of_b, strict=True)]
    size = np.sum(np.broadcast_arrays(*(_norm(x) * _norm(y) for x, y in zip(a, b, strict=True))), axis=0)
    if method == "kronecker":
        solution, sigma = _by_kronecker(_system(a, b), c, size, rcond)
    else:
        # One term is two with a zero.
        pencils = [a[0], a[1], b[0], b[1]] if len(a) == 2 else [a[0], 0 * a[0], b[0], 0 * b[0]]
        solution, sigma = _by_schur(_qz_forms, pencils, c)
    index = _first_singular(sigma, rcond * size, batch)
    if index is not None:
        a, b = ([_member(x, batch, index) for x in terms] for terms in (a, b))
        reasons = ""
        if c.shape[-2] * c.shape[-1] <= REPORTED_UNKNOWNS:
            reasons = _rank(_system(a, b), rcond * _at(size, batch, index), c.shape)
        if len(a) == 2:
            unit = 2.0 ** _at(np.clip(of_b[1] - of_b[0], -1000, 1000)[..., 0, 0], batch, index)
            reasons += _colliding_pencils(a, b, _at(sigma, batch, index), unit)
        raise SingularSylvesterError(f"Σ A_k X B_k = C{_verdict(sigma, size, batch, index)}{reasons}")
    return _unscaled(solution, of_c - exponent)


# --- Input ------------------------------------------------------------------------------------------------------------


def _finite(array: ArrayLike, name: str) -> FloatArray:
    out = real(array, "a finite matrix or a stack of them", name)
    if out.ndim < 2 or 0 in out.shape[-2:] or not np.isfinite(out).all():
        raise ValueError(f"{name} must be a finite matrix or a stack of them, got shape {out.shape}")
    return out


def _square(array: ArrayLike, name: str) -> FloatArray:
    out = _finite(array, name)
    if out.shape[-1] != out.shape[-2]:
        raise ValueError(f"{name} must be square, got shape {out.shape}")
    return out


def _checked(
    matrices: list[FloatArray], c: FloatArray, method: Method | None, rcond: float, few: int, terms: int = 2
) -> tuple[tuple[int, ...], Method]:
    """The batch's shape and the method, from m x m (first) and n x n (last) matrices."""
    m, n = matrices[0].shape[-1], matrices[-1].shape[-1]
    if c.shape[-2:] != (m, n):
        raise ValueError(f"C must be {m}x{n} to fit the other matrices, got shape {c.shape}")
    leading = [x.shape[:-2] for x in (*matrices, c)]
    try:
        batch = np.broadcast_shapes(*leading)
    except ValueError:
        raise ValueError(f"the leading axes do not broadcast: {', '.join(map(str, leading))}") from None
    if not EPSILON <= number(rcond, "rcond") < 1:
        raise ValueError(f"rcond must be at least {EPSILON:.3g} and below 1, got {rcond}")
    if method is None:
        method = "kronecker" if m * n <= few or terms > 2 else "bartels-stewart"
    if not isinstance(method, str) or method not in ("kronecker", "bartels-stewart"):
        raise ValueError(f'method must be "kronecker" or "bartels-stewart", got {shown(method)}')
    if method == "kronecker" and m * n > MOST_UNKNOWNS:
        raise ValueError(f"{m}x{n} unknowns are too many for the Kronecker product: at most {MOST_UNKNOWNS}")
    if method == "bartels-stewart" and terms > 2:
        raise ValueError(f"Bartels-Stewart solves equations of at most two terms, got {terms}")
    return batch, method


def _exponent(x: FloatArray) -> NDArray[np.int_]:
    """(..., 1, 1) of the power of two that brings the largest entry into [1, 2); far below all others for zeros."""
    largest = np.abs(x).max(axis=(-2, -1), keepdims=True)
    return np.where(largest > 0, np.frexp(largest)[1] - 1, -9999)


def _unscaled(x: FloatArray, exponent: NDArray[np.int_]) -> FloatArray:
    with np.errstate(over="ignore"):
        out = np.ldexp(x, exponent)
    if not np.isfinite(out).all():
        raise ValueError("the solution is beyond the range of floating point numbers")
    return np.asarray(out)


def _norm(x: Array) -> FloatArray:
    """(...) an upper bound of the spectral norm, at most sqrt(n) times it: sqrt(|x|_1 |x|_inf)."""
    entries = np.abs(x)
    return np.asarray(np.sqrt(entries.sum(axis=-1).max(axis=-1)) * np.sqrt(entries.sum(axis=-2).max(axis=-1)))


# --- Methods: solution and σ, both without judging --------------------------------------------------------------------


def _system(a: Sequence[FloatArray], b: Sequence[FloatArray]) -> FloatArray:
    """Σ A_k ⊗ B_k', (..., m n, m n)."""
    return sum((kron(x, transpose(y)) for x, y in zip(a, b, strict=True)), start=np.zeros(()))


def _by_kronecker(system: FloatArray, c: FloatArray, size: FloatArray, rcond: float) -> tuple[FloatArray, FloatArray]:
    """X (..., m, n), and σ per system: exact where it may be at most rcond * size, else a lower bound."""
    try:
        inverse = np.linalg.inv(system)
    except np.linalg.LinAlgError:  # a pivot of one of them is exactly zero
        values = np.linalg.svd(system, compute_uv=False)[..., -1]
        return np.zeros(c.shape), np.where(values == values.min(), 0.0, values)
    with np.errstate(all="ignore"):  # inf and NaN where it is singular
        sigma = np.asarray(1 / _norm(inverse))
        # The inverse costs a third of the singular values, and tells that nearly all systems are regular.
        doubtful = ~(sigma > rcond * size)
        if doubtful.any():
            sigma[doubtful] = np.linalg.svd(system[doubtful], compute_uv=False)[..., -1]
        vec = c.reshape(*c.shape[:-2], system.shape[-1], 1)
        x = inverse @ vec
        # Two refinements make the residual as small as an elimination does, near singular too.
        for _ in range(2):
            x = x + inverse @ (vec - system @ x)
    return x.reshape(*x.shape[:-2], *c.shape[-2:]), sigma


class _Triangular(NamedTuple):
    """An equation after Bartels and Stewart: X = out(solve(into(C))), `adjoint` solves with the transposed operator.

    `into` and `out` are orthogonal or unitary, so that σ is that of the triangular equation.
    """

    into: Callable[[Array], Array]
    solve: Callable[[Array], Array]
    adjoint: Callable[[Array], Array]
    out: Callable[[Array], Array]


def _by_schur(
    forms: Callable[..., _Triangular], matrices: list[FloatArray], c: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """X (..., m, n) and σ (...), one member of the batch after the other."""
    batch = np.broadcast_shapes(*(x.shape[:-2] for x in (*matrices, c)))
    solution, sigma = np.empty((*batch, *c.shape[-2:])), np.empty(batch)
    # One start for all, so that the same equation always gets the same σ.
    start = np.random.default_rng(0).standard_normal(c.shape[-2:])
    for i in np.ndindex(*batch):
        triangular = forms(*(_member(x, batch, i) for x in matrices))
        with np.errstate(all="ignore"):  # inf and NaN where it is singular
            sigma[i] = _least_singular_value(triangular, start)
            solution[i] = triangular.out(triangular.solve(triangular.into(_member(c, batch, i)))).real
    return solution, sigma


def _least_singular_value(triangular: _Triangular, x: Array) -> float:
    """σ by inverse iteration on the operator times its adjoint: at least the true one, and near it."""
    growth = 0.0
    for _ in range(ROUNDS):
        y = triangular.solve(x / np.linalg.norm(x))
        growth = float(np.linalg.norm(y))
        if not np.isfinite(growth):
            return 0.0
        x = triangular.adjoint(y / growth)
    return 1 / growth


def _schur_forms(a: FloatArray, b: FloatArray) -> _Triangular:
    """A N + N B, A = U T U', B = V S V': T Y + Y S with Y = U'N V."""
    t, u = linalg.schur(a, check_finite=False)
    s, v = linalg.schur(b, check_finite=False)

    def solve(f: Array, transposed: str = "N") -> Array:
        # Where eigenvalues collide to rounding LAPACK moves them apart by rounding, which σ then shows.
        y, scale, _ = linalg.lapack.dtrsyl(t, s, f, trana=transposed, tranb=transposed)
        return np.asarray(y / scale)

    return _Triangular(
        lambda c: np.asarray(u.T @ c @ v), solve, lambda f: solve(f, "T"), lambda y: np.asarray(u @ y @ v.T)
    )


def _qz_forms(a1: FloatArray, a2: FloatArray, b1: FloatArray, b2: FloatArray) -> _Triangular:
    """A1 X B1 + A2 X B2, A_k = Q S_k Z^H, B_k = U P_k V^H: S1 Y P1 + S2 Y P2 with Y = Z^H X U, all S and P triangular."""
    s1, s2, q, z = linalg.qz(a1, a2, output="complex", check_finite=False)
    p1, p2, u, v = linalg.qz(b1, b2, output="complex", check_finite=False)
    # Conjugated, transposed and reversed they are upper triangular again.
    s1r, s2r, p1r, p2r = (x.conj().T[::-1, ::-1] for x in (s1, s2, p1, p2))
    return _Triangular(
        lambda c: np.asarray(q.conj().T @ c @ v),
        lambda f: _solve_triangular(s1, s2, p1, p2, f),
        lambda f: _solve_triangular(s1r, s2r, p1r, p2r, f[::-1, ::-1])[::-1, ::-1],
        lambda y: np.asarray(z @ y @ u.conj().T),
    )


def _solve_triangular(s1: Array, s2: Array, p1: Array, p2: Array, f: Array) -> Array:
    """S1 Y P1 + S2 Y P2 = F, all upper triangular, column after column."""
    y = np.zeros(f.shape, complex)
    for j in range(f.shape[1]):
        known = f[:, j] - s1 @ (y[:, :j] @ p1[:j, j]) - s2 @ (y[:, :j] @ p2[:j, j])
        matrix = p1[j, j] * s1 + p2[j, j] * s2
        pivots = np.einsum("ii->i", matrix)
        # As LAPACK does: a pivot that is nothing but rounding is made rounding, which σ then shows.
        pivots[np.abs(pivots) < EPSILON] = EPSILON
        y[:, j] = linalg.solve_triangular(matrix, known, check_finite=False)
    return y


# --- What is singular -------------------------------------------------------------------------------------------------


def _first_singular(sigma: FloatArray, least: FloatArray, batch: tuple[int, ...]) -> tuple[int, ...] | None:
    # Of the zero operator, whose size is zero, Schur forms tell no σ.
    singular = np.broadcast_to(~(sigma > least) | (least == 0), batch)
    return tuple(int(i) for i in np.argwhere(singular)[0]) if singular.any() else None


def _member(x: Array, batch: tuple[int, ...], index: tuple[int, ...]) -> Array:
    return np.asarray(np.broadcast_to(x, (*batch, *x.shape[-2:]))[index])


def _at(x: Array, batch: tuple[int, ...], index: tuple[int, ...]) -> float:
    return float(np.broadcast_to(x, batch)[index])


def _verdict(sigma: FloatArray, size: FloatArray, batch: tuple[int, ...], index: tuple[int, ...]) -> str:
    where = f" at index {', '.join(map(str, index))} of the batch" if index else ""
    ratio = _at(sigma, batch, index) / max(_at(size, batch, index), 1e-300)
    return f"{where} is singular, σ is {ratio:.0e} of the size of the data"


def _colliding(a: FloatArray, b: FloatArray, sigma: float, unit: float) -> str:
    """Eigenvalues of A and -B, in units of `unit`."""
    first, second = np.linalg.eigvals(a), np.linalg.eigvals(-b)
    # Of normal matrices σ is the gap.
    near = max(10 * sigma, 1e-9 * float(np.abs(np.concatenate([first, second])).max()))
    with np.errstate(over="ignore"):
        return _closest(np.abs(first[:, None] - second), near, (unit * first, unit * second), ("A", "-B"))


def _colliding_pencils(a: list[FloatArray], b: list[FloatArray], sigma: float, unit: float) -> str:
    """Eigenvalues of A_1 - λ A_2 and B_2 + λ B_1, in units of `unit`: infinite ones where A_2 or B_1 is singular."""
    pairs = [linalg.eigvals(x, y, homogeneous_eigvals=True) for x, y in ((a[0], a[1]), (b[1], -b[0]))]
    first, second = (p / np.maximum(np.linalg.norm(p, axis=0), 1e-300) for p in pairs)
    gaps = np.abs(first[0][:, None] * second[1] - first[1][:, None] * second[0])
    values = []
    for p in (first, second):
        finite = np.abs(p[1]) > EPSILON
        beyond = np.where(np.abs(p[0]) > EPSILON, np.inf, np.nan)
        values.append(np.where(finite, unit * p[0] / np.where(finite, p[1], 1), beyond))
    return _closest(gaps, max(10 * sigma, 1e-9), values, ("A_1 - λ A_2", "B_2 + λ B_1"))


def _closest(gaps: FloatArray, near: float, values: Sequence[Array], names: tuple[str, str]) -> str:
    """The pairs of eigenvalues that are within `near`, or the closest one."""
    collide = bool(gaps.min() <= near)
    indices = np.argwhere(gaps <= (near if collide else gaps.min()))
    pairs = [
        f"{_number(values[0][i])} of {names[0]} with {_number(values[1][j])} of {names[1]}" for i, j in indices[:3]
    ]
    if len(indices) > 3:
        pairs.append(f"{len(indices) - 3} more")
    start = "eigenvalues collide," if collide else "the matrices are far from normal, closest eigenvalues"
    return f"; {start} {'; '.join(pairs)}"


def _number(x: complex) -> str:
    """Without minus zeros, without an imaginary part that is zero; NaN is an eigenvalue 0 / 0 of a singular pencil."""
    if np.isnan(x):
        return "any number"
    real, imaginary = x.real + 0.0, x.imag + 0.0
    return f"{complex(real, imaginary):.9g}" if imaginary else f"{real:.9g}"


def _rank(system: FloatArray, least: float, shape: tuple[int, ...]) -> str:
    _, values, rows = np.linalg.svd(system)
    null = np.round(rows[-1].reshape(shape[-2:]), 6) + 0.0  # no minus zeros
    text = " ".join(np.array2string(null, precision=3, threshold=36, separator=", ").split())
    return f"; it has rank {int((values > least).sum())} for {len(values)} unknowns and does not see X = {text}"
