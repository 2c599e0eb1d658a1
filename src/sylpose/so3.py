"""Minima of a quadratic cost on SO(3), with a certificate: what the paper's estimators all come down to.

With r the row-major vec of R, the cost is 1/2 r'Hr - h'r, H positive semidefinite. Its stationary points on SO(3) solve
K r = h with K = H + L ⊗ I and a symmetric 3x3 multiplier L, for costs of the form Σ A_c R B_c a generalised Sylvester's
equation. If K is positive definite, R is the global minimum, because for every other rotation
cost(R2) - cost(R) = 1/2 (r2 - r)' K (r2 - r).

Source: the equation is Chen & Schonfeld's (2010); the dual, the certificate and the search are ours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sylpose.equation import kron, transpose

__all__ = ["STATIONARY", "cost_of", "derivatives", "minimize", "multiplier_of"]

FloatArray = NDArray[np.float64]

# K must be this much above singular, relative to H's mean eigenvalue of 1, to certify: well above rounding.
CERTIFICATE = 1e-9
# Stationary to this: the largest tangent derivative of the cost, H's mean eigenvalue being 1.
STATIONARY = 1e-8
# Curvature less negative than this is none.
FLAT = 1e-6
# Minima nearer than this (radians) are one; a minimum where two mirrored ones merge is found to some 1e-4 only.
SAME = 1e-3

_ROWS, _COLUMNS = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
# Orthonormal basis of the symmetric 3x3 matrices, what L ⊗ I is made of, and the generators [e_k]x of rotation.
_SYMMETRIC = np.zeros((6, 3, 3))
_SYMMETRIC[range(6), _ROWS, _COLUMNS] = _SYMMETRIC[range(6), _COLUMNS, _ROWS] = [1, 1, 1, *[np.sqrt(0.5)] * 3]
_SYMMETRIC_KRON = kron(_SYMMETRIC, np.eye(3))
_SKEW = -np.cross(np.eye(3)[:, None], np.eye(3))
_STARTS = Rotation.create_group("O").as_matrix()


def minimize(H: FloatArray, h: FloatArray) -> tuple[FloatArray, bool, int]:
    """Minimise 1/2 r'Hr - h'r over SO(3), H positive semidefinite with trace 9.

    Returns (k, 3, 3) minima, best first; whether the first is certified as the global one; iterations.
    """
    rotation, iterations = _dual_newton(H, h)
    if rotation is not None and _certified(H, h, rotation):
        return rotation[None], True, iterations
    # The dual can also creep along the boundary past a maximum inside: the certificate is asked for again.
    candidates, more = _local_minima(H, h)
    certified = _certified(H, h, candidates[0])
    return candidates[:1] if certified else candidates, certified, iterations + more


def _certified(H: FloatArray, h: FloatArray, rotation: FloatArray) -> bool:
    gradient, _ = derivatives(H, h, rotation)
    K = H + kron(multiplier_of(H, h, rotation), np.eye(3))
    return bool(np.abs(gradient).max() < STATIONARY and np.linalg.eigvalsh(K)[0] > CERTIFICATE)


def multiplier_of(H: FloatArray, h: FloatArray, rotation: FloatArray) -> FloatArray:
    """L = (C - Σ A R B) R': symmetric where the rotation is stationary."""
    L = (h - H @ rotation.ravel()).reshape(3, 3) @ rotation.T
    return np.asarray((L + L.T) / 2)


def _dual_newton(H: FloatArray, h: FloatArray, bound: int = 40) -> tuple[FloatArray | None, int]:
    """Maximise the concave dual d(L) = -1/2 h'K⁻¹h - 1/2 tr L where K = H + L ⊗ I is positive definite.

    Its gradient is 1/2 (RR' - I), r = K⁻¹h. H is positive semidefinite, so that any positive multiple of the identity
    is a start inside. Returns the rotation and the steps; None when the maximum is on the boundary or R is a reflection.
    """
    basis = _SYMMETRIC.reshape(6, 9)
    multiplier = 0.01 * np.array([1.0, 1, 1, 0, 0, 0])
    value, step, slope, length = -np.inf, np.zeros(6), 0.0, 1.0
    for iteration in range(bound):
        values, vectors = np.linalg.eigh(H + (multiplier @ _SYMMETRIC_KRON.reshape(6, 81)).reshape(9, 9))
        if values[0] < CERTIFICATE:
            return None, iteration
        root = vectors / np.sqrt(values)  # K⁻¹ = root root'
        whitened = root.T @ h
        new_value = -0.5 * float(whitened @ whitened + multiplier[:3].sum())
        if new_value < value + 1e-4 * length * slope - 1e-13 * abs(value):
            length /= 2
            multiplier = multiplier - length * step
            continue
        value = new_value
        r = root @ whitened
        R = r.reshape(3, 3)
        excess = R @ R.T - np.eye(3)
        if np.abs(excess).max() < 1e-11:
            # A Newton-Schulz step onto the rotations: what is left of `excess` is its square.
            return (R - 0.5 * excess @ R if np.linalg.det(R) > 0 else None), iteration
        gradient = 0.5 * basis @ excess.ravel()
        jacobian = _SYMMETRIC_KRON @ r @ root
        curvature = jacobian @ jacobian.T
        # Singular where R is (one camera): then the step is long, and what follows ends it at the boundary.
        curvature[np.diag_indices(6)] += 1e-14 * (np.trace(curvature) + 1)
        step = np.linalg.solve(curvature, gradient)
        slope = float(gradient @ step)
        edge = np.linalg.eigvalsh(root.T @ (step @ _SYMMETRIC_KRON.reshape(6, 81)).reshape(9, 9) @ root)[0]
        length = 1.0 if edge > -0.7 else -0.7 / edge  # at most 0.7 of the way to the boundary
        multiplier = multiplier + length * step
    return None, bound


def cost_of(H: FloatArray, h: FloatArray, rotations: FloatArray) -> FloatArray:
    """(...) 1/2 r'Hr - h'r of (..., 3, 3) rotations."""
    r = rotations.reshape(*rotations.shape[:-2], 9)
    return np.asarray((r * (0.5 * r @ H - h)).sum(axis=-1))


def derivatives(H: FloatArray, h: FloatArray, rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gradient (..., 3) and Hessian (..., 3, 3) of the cost at exp(w) R, w = 0, of (..., 3, 3) rotations.

    exp(w) = I + W + W²/2 + ..., W² = ww' - |w|² I: with G the derivative by R and T = G R', the gradient is <W, T> and
    the Hessian J'HJ + (T + T')/2 - tr(T) I.
    """
    shape = rotations.shape[:-2]
    G = (rotations.reshape(*shape, 9) @ H - h).reshape(*shape, 3, 3)
    T = G @ transpose(rotations)
    gradient = T.reshape(*shape, 9) @ _SKEW.reshape(3, 9).T
    J = (_SKEW @ rotations[..., None, :, :]).reshape(*shape, 3, 9)
    trace = np.trace(T, axis1=-2, axis2=-1)[..., None, None]
    return gradient, J @ H @ transpose(J) + (T + transpose(T)) / 2 - trace * np.eye(3)


def _local_minima(H: FloatArray, h: FloatArray, bound: int = 60) -> tuple[FloatArray, int]:
    """All local minima on SO(3) that Newton's method reaches from the 24 rotations of the cube, all starts at once.

    Returns (k, 3, 3) rotations, best first, and the iterations.
    """
    R = _STARTS
    cost = cost_of(H, h, R)
    iterations = 0
    while iterations < bound:
        iterations += 1
        gradient, hessian = derivatives(H, h, R)
        values, vectors = np.linalg.eigh(hessian)
        # Absolute curvature: always downhill, away from saddles.
        along = (transpose(vectors) @ gradient[..., None])[..., 0] / np.maximum(np.abs(values), 1e-9)
        step = -(vectors @ along[..., None])[..., 0]
        step /= np.maximum(np.linalg.norm(step, axis=-1, keepdims=True) / 0.5, 1.0)
        for _ in range(10):
            new = Rotation.from_rotvec(step).as_matrix() @ R
            new_cost = cost_of(H, h, new)
            uphill = new_cost > cost + 1e-15 * np.abs(cost)
            if not uphill.any():
                break
            step[uphill] /= 2
        R, cost = np.where(uphill[:, None, None], R, new), np.where(uphill, cost, new_cost)
        size = np.abs(gradient).max(axis=-1)
        if ((size < 1e-12) | ((size < STATIONARY) & (values[:, 0] < -FLAT))).all():  # a saddle is left where it is
            break
    gradient, hessian = derivatives(H, h, R)
    good = (np.abs(gradient).max(axis=-1) < STATIONARY) & (np.linalg.eigvalsh(hessian)[:, 0] > -FLAT)
    good[np.argmin(cost)] = True
    kept: list[FloatArray] = []
    for i in np.argsort(cost, kind="stable"):
        # |R1 - R2|² is twice the squared angle between near rotations.
        if good[i] and all(np.linalg.norm(R[i] - other) > SAME * np.sqrt(2) for other in kept):
            kept.append(R[i])
    return np.array(kept), iterations
