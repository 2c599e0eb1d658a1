"""Sylvester's equation A N + N B = C, and its generalised form Σ A_k X B_k = C, with singular ones refused.

`scipy.linalg.solve_sylvester` gives numbers of the order 1e14 where A and -B share an eigenvalue; here that is an error
that names it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["SingularSylvesterError", "kron", "solve_generalized_sylvester", "solve_sylvester", "transpose"]

FloatArray = NDArray[np.float64]


class SingularSylvesterError(ValueError):
    """A Sylvester's equation that has no solution, or many."""


def solve_sylvester(A: ArrayLike, B: ArrayLike, C: ArrayLike, rcond: float = 1e-12) -> FloatArray:
    """Solve A N + N B = C by the Kronecker product, (A ⊗ I + I ⊗ B') vec(N) = vec(C).

    Args:
        A: (..., m, m).
        B: (..., n, n).
        C: (..., m, n). Leading axes broadcast.
        rcond: the equation is singular where the system's smallest singular value is at most this times its largest.

    Returns:
        (..., m, n) N.

    Raises:
        SingularSylvesterError: naming the eigenvalues of A and -B that collide.
        ValueError: shapes that do not fit, values that are not finite.
    """
    a, b, c = _square(A, "A"), _square(B, "B"), _finite(C, "C")
    system = kron(a, np.eye(b.shape[-1])) + kron(np.eye(a.shape[-1]), np.swapaxes(b, -1, -2))
    index = _first_singular(system, rcond)
    if index is not None:
        shape = system.shape[:-2]
        one_a = np.broadcast_to(a, (*shape, *a.shape[-2:]))[index]
        one_b = np.broadcast_to(b, (*shape, *b.shape[-2:]))[index]
        raise SingularSylvesterError(f"A N + N B = C{_where(index)} is singular: {_collisions(one_a, one_b)}")
    return _solve_vec(system, c, (a.shape[-1], b.shape[-1]))


def solve_generalized_sylvester(
    As: Sequence[ArrayLike], Bs: Sequence[ArrayLike], C: ArrayLike, rcond: float = 1e-12
) -> FloatArray:
    """Solve Σ A_k X B_k = C by the Kronecker product, Σ (A_k ⊗ B_k') vec(X) = vec(C).

    Args:
        As: K arrays (..., m, m).
        Bs: K arrays (..., n, n).
        C: (..., m, n). Leading axes broadcast.
        rcond: as in `solve_sylvester`.

    Returns:
        (..., m, n) X.

    Raises:
        SingularSylvesterError: giving the rank of the system.
        ValueError: shapes that do not fit, values that are not finite.
    """
    if len(As) != len(Bs) or len(As) == 0:
        raise ValueError(f"As and Bs must be equally many, at least one; got {len(As)} and {len(Bs)}")
    terms_a = [_square(a, f"As[{k}]") for k, a in enumerate(As)]
    terms_b = [_square(b, f"Bs[{k}]") for k, b in enumerate(Bs)]
    if len({a.shape[-1] for a in terms_a}) > 1 or len({b.shape[-1] for b in terms_b}) > 1:
        raise ValueError("all As must have one size, and all Bs one size")
    c = _finite(C, "C")
    system: FloatArray = sum(
        (kron(a, np.swapaxes(b, -1, -2)) for a, b in zip(terms_a, terms_b, strict=True)), start=np.zeros(())
    )
    index = _first_singular(system, rcond)
    if index is not None:
        rank = int(np.linalg.matrix_rank(system[index], rtol=rcond))
        raise SingularSylvesterError(
            f"Σ A_k X B_k = C{_where(index)} is singular: it has rank {rank} for {system.shape[-1]} unknowns"
        )
    return _solve_vec(system, c, (terms_a[0].shape[-1], terms_b[0].shape[-1]))


def _finite(array: ArrayLike, name: str) -> FloatArray:
    out = np.asarray(array, dtype=float)
    if out.ndim < 2 or not np.isfinite(out).all():
        raise ValueError(f"{name} must be a finite matrix or a stack of them, got shape {out.shape}")
    return out


def _square(array: ArrayLike, name: str) -> FloatArray:
    out = _finite(array, name)
    if out.shape[-1] != out.shape[-2]:
        raise ValueError(f"{name} must be square, got shape {out.shape}")
    return out


def kron(a: FloatArray, b: FloatArray) -> FloatArray:
    """Kronecker product over the last two axes, leading axes broadcast."""
    out = a[..., :, None, :, None] * b[..., None, :, None, :]
    rows, columns = a.shape[-2] * b.shape[-2], a.shape[-1] * b.shape[-1]
    return np.asarray(out.reshape(*out.shape[:-4], rows, columns))


def transpose(a: FloatArray) -> FloatArray:
    """Of the last two axes."""
    return np.asarray(np.swapaxes(a, -1, -2))


def _first_singular(system: FloatArray, rcond: float) -> tuple[int, ...] | None:
    values = np.linalg.svd(system, compute_uv=False)
    singular = values[..., -1] <= rcond * values[..., 0]
    return tuple(int(i) for i in np.argwhere(singular)[0]) if singular.any() else None


def _where(index: tuple[int, ...]) -> str:
    return f" at index {', '.join(map(str, index))} of the batch" if index else ""


def _collisions(a: FloatArray, b: FloatArray) -> str:
    of_a, of_minus_b = np.linalg.eigvals(a), np.linalg.eigvals(-b)
    gaps = np.abs(of_a[:, None] - of_minus_b)
    # The closest pair at least: of matrices far from normal, equal eigenvalues come out apart by more than rounding.
    near = max(float(gaps.min()), 1e-9 * float(max(np.abs(of_a).max(), np.abs(of_minus_b).max())))
    pairs = (f"{of_a[i]:.9g} of A with {of_minus_b[j]:.9g} of -B" for i, j in np.argwhere(gaps <= near))
    return f"eigenvalues collide, {'; '.join(pairs)}"


def _solve_vec(system: FloatArray, c: FloatArray, shape: tuple[int, int]) -> FloatArray:
    if c.shape[-2:] != shape:
        raise ValueError(f"C must be {shape[0]}x{shape[1]} to fit the other matrices, got shape {c.shape}")
    vec = np.linalg.solve(system, c.reshape(*c.shape[:-2], -1, 1))
    return np.asarray(vec.reshape(*vec.shape[:-2], *shape))
