"""The rotation of an object from Sylvester's equation, all cameras together, with a certificate.

Each camera sees y = N x + noise on centred points, N the upper-left 2x2 block of the rotation as that camera sees it.
With P = [1 0 0; 0 1 0] and Q the camera's rotation, the least squares over all cameras is a quadratic cost on SO(3)
whose stationary points solve a generalised Sylvester's equation:

    Σ A_c R B_c + L R = Σ C_c,   R'R = I,   L = L' (3x3 multiplier),
    A_c = Q'P'PQ,   B_c = Q'P' S_xx P Q,   C_c = Q'P' S_yx P Q.

With row-major vec it is K r = h, K = H + L ⊗ I, H = Σ A_c ⊗ B_c, h = vec(Σ C_c). If K is positive definite, R is the
global optimum, because cost(R2) - cost(R) = 1/2 (r2 - r)' K (r2 - r) for every other rotation.

The depth of the points is ignored, as in the paper: unbiased only where depth is uncorrelated with the image position,
and blind to the first order of a turn about the normal of the plane that all viewing directions lie in.

Source: C. Chen, D. Schonfeld, "Pose estimation from multiple cameras based on Sylvester's equation", Computer Vision
and Image Understanding 114 (2010); the derivation is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from sylpose.equation import kron
from sylpose.moments import PairMoments

__all__ = [
    "CentralizedSolution",
    "solve_centralized",
    "translation_from_means",
]

FloatArray = NDArray[np.float64]


# --- All cameras: a quadratic cost on SO(3) ---------------------------------------------------------------------------

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


@dataclass(frozen=True, eq=False)
class CentralizedSolution:
    """The rotation that all cameras agree on best, orthographic views.

    Attributes:
        candidates: (k, 3, 3) rotations: the global optimum when `certified`, else all local minima found, best first
            (a single camera's mirrored pair, for instance). Where a direction is not observable they sample a continuum.
        costs: (k,) half the sum of squared residuals of each, in units in which H has the mean eigenvalue 1.
        certified: K is positive definite, so that `rotation` is the one global optimum. Never for a single camera.
        converged: `rotation` is a stationary point of the cost.
        multiplier: (3, 3) L of Sylvester's equation at `rotation`, in the units of `costs`.
        information: (3, 3) of w, R = exp(w) rotation, world axes, 1/rad²: the Hessian of the cost on SO(3) over the
            residuals' variance (weighted mean square per coordinate; at least 1e-12 of the points' own). It shows the
            directions that cannot be observed; it knows nothing of the model's bias.
        iterations: Newton steps, on the dual and, where that gave no certificate, on SO(3).
    """

    candidates: FloatArray
    costs: FloatArray
    certified: bool
    converged: bool
    multiplier: FloatArray
    information: FloatArray
    iterations: int

    @property
    def rotation(self) -> FloatArray:
        """(3, 3) the best rotation, X_j = R X_i + t in the world frame."""
        return np.asarray(self.candidates[0])

    @property
    def cost(self) -> float:
        """The cost at `rotation`."""
        return float(self.costs[0])


def solve_centralized(rotations: ArrayLike, moments: Sequence[PairMoments], *, aim: bool = True) -> CentralizedSolution:
    """The object's rotation between two frames from the second moments of all cameras' matches.

    Views are orthographic, of one scale per camera: depth that changes between the frames is not modelled. Cameras
    weigh by the spread of their points in normalised units; a camera without matches adds nothing. Exact for noise-free
    orthographic data in which every camera's points have depths uncorrelated with their images, if three viewing
    directions are linearly independent and each camera's points are not collinear.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments.
        aim: turn each camera, in each frame, onto the mean ray of its matches first: perspective images are orthographic
            to first order only about that ray. False for points that are orthographic, whose mean is no direction.

    Raises:
        ValueError: shapes that do not fit, matrices that are no rotations, matches without any spread.
    """
    q = _quadratic(_rotations(rotations, moments), moments, aim)
    candidates, certified, iterations = _minimize(q.H, q.h)
    rotation = candidates[0]
    gradient, hessian = _derivatives(q.H, q.h, rotation)
    costs = _cost(q.H, q.h, candidates) + q.constant
    return CentralizedSolution(
        candidates=candidates,
        costs=costs,
        certified=certified,
        converged=bool(np.abs(gradient).max() < STATIONARY),
        multiplier=_multiplier(q.H, q.h, rotation),
        information=hessian * q.scale / q.variance(rotation),
        iterations=iterations,
    )


class _Quadratic(NamedTuple):
    """Half the sum of squared residuals over `scale`: 1/2 r'Hr - h'r + constant, trace H = 9; weight = Σ w."""

    H: FloatArray
    h: FloatArray
    constant: float
    scale: float
    weight: float

    def variance(self, rotation: FloatArray) -> float:
        """Mean square residual per coordinate, normalised units."""
        cost = float(_cost(self.H, self.h, rotation)) + self.constant
        return max(cost, 1e-12 * max(self.constant, 1.0)) * self.scale / self.weight


def _rotations(rotations: ArrayLike, moments: Sequence[PairMoments]) -> FloatArray:
    out = np.asarray(rotations, dtype=float)
    if out.ndim != 3 or out.shape[1:] != (3, 3) or len(out) != len(moments) or len(out) == 0:
        raise ValueError(f"rotations must be (C, 3, 3) for C = {len(moments)} moments, C >= 1; got shape {out.shape}")
    finite = np.where(np.isfinite(out).all(axis=(1, 2), keepdims=True), out, 0)
    wrong = (np.abs(finite @ _t(finite) - np.eye(3)).max(axis=(1, 2)) > 1e-6) | (np.linalg.det(finite) < 0)
    if wrong.any():
        raise ValueError(f"rotations[{int(np.argmax(wrong))}] is not a rotation matrix")
    return out


def _quadratic(rotations: FloatArray, moments: Sequence[PairMoments], aim: bool) -> _Quadratic:
    """The cost of all cameras. The moments are centred here, all at once, for the sake of thousands of cameras."""
    M = np.array([m.matrix for m in moments])
    count = M[:, 8, 8]
    per_count = 1 / np.where(count > 0, count, 1)[:, None]
    Ex, Ey = M[:, 8, 6:8] * per_count, M[:, 8, [2, 5]] * per_count
    n = count[:, None, None]
    Sxx = M[:, 6:8, 6:8] - n * Ex[:, :, None] * Ex[:, None, :]
    Syx = M[:, [2, 5], 6:8] - n * Ey[:, :, None] * Ex[:, None, :]
    Syy = M[:, [[2], [5]], [2, 5]] - n * Ey[:, :, None] * Ey[:, None, :]
    # PQ, (C, 2, 3), of frames i and j. Turned by T onto a mean ray, δ away from it in the image, a point is P T Q X / Z
    # at exactly (P T P') δ.
    PQx = PQy = rotations[:, :2]
    if aim:
        Tx, Ty = _turn_to(Ex), _turn_to(Ey)
        PQx, PQy = Tx[:, :2] @ rotations, Ty[:, :2] @ rotations
        Jx, Jy = Tx[:, :2, :2], Ty[:, :2, :2]
        Sxx, Syx, Syy = Jx @ Sxx @ _t(Jx), Jy @ Syx @ _t(Jx), Jy @ Syy @ _t(Jy)
    A, B = _t(PQy) @ PQy, _t(PQx) @ Sxx @ PQx
    h = (_t(PQy) @ Syx @ PQx).sum(axis=0).ravel()
    # Σ A_c ⊗ B_c as one matrix product.
    H = (A.reshape(-1, 9).T @ B.reshape(-1, 9)).reshape(3, 3, 3, 3).transpose(0, 2, 1, 3).reshape(9, 9)
    scale = float(np.trace(H)) / 9
    # What centring leaves by rounding is no spread.
    if not scale > 1e-14 * float(np.trace(M, axis1=1, axis2=2).sum()):
        raise ValueError("no camera has matches that are spread over its image: there is nothing to turn")
    constant = float(np.trace(Syy, axis1=1, axis2=2).sum()) / 2
    return _Quadratic((H + H.T) / (2 * scale), h / scale, constant / scale, scale, float(count.sum()))


def _t(a: FloatArray) -> FloatArray:
    return np.swapaxes(a, -1, -2)


def _turn_to(x: FloatArray) -> FloatArray:
    """(C, 2) normalised points -> (C, 3, 3) the least rotations that take their rays to the z axis."""
    u = np.column_stack([x, np.ones(len(x))])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    T = np.empty((len(x), 3, 3))
    T[:, :2, :2] = np.eye(2) - u[:, :2, None] * u[:, None, :2] / (1 + u[:, 2, None, None])
    T[:, :2, 2] = -u[:, :2]
    T[:, 2] = u
    return T


def _minimize(H: FloatArray, h: FloatArray) -> tuple[FloatArray, bool, int]:
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
    gradient, _ = _derivatives(H, h, rotation)
    K = H + kron(_multiplier(H, h, rotation), np.eye(3))
    return bool(np.abs(gradient).max() < STATIONARY and np.linalg.eigvalsh(K)[0] > CERTIFICATE)


def _multiplier(H: FloatArray, h: FloatArray, rotation: FloatArray) -> FloatArray:
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


def _cost(H: FloatArray, h: FloatArray, rotations: FloatArray) -> FloatArray:
    """(...) 1/2 r'Hr - h'r of (..., 3, 3) rotations."""
    r = rotations.reshape(*rotations.shape[:-2], 9)
    return np.asarray((r * (0.5 * r @ H - h)).sum(axis=-1))


def _derivatives(H: FloatArray, h: FloatArray, rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gradient (..., 3) and Hessian (..., 3, 3) of the cost at exp(w) R, w = 0, of (..., 3, 3) rotations.

    exp(w) = I + W + W²/2 + ..., W² = ww' - |w|² I: with G the derivative by R and T = G R', the gradient is <W, T> and
    the Hessian J'HJ + (T + T')/2 - tr(T) I.
    """
    shape = rotations.shape[:-2]
    G = (rotations.reshape(*shape, 9) @ H - h).reshape(*shape, 3, 3)
    T = G @ _t(rotations)
    gradient = T.reshape(*shape, 9) @ _SKEW.reshape(3, 9).T
    J = (_SKEW @ rotations[..., None, :, :]).reshape(*shape, 3, 9)
    trace = np.trace(T, axis1=-2, axis2=-1)[..., None, None]
    return gradient, J @ H @ _t(J) + (T + _t(T)) / 2 - trace * np.eye(3)


def _local_minima(H: FloatArray, h: FloatArray, bound: int = 60) -> tuple[FloatArray, int]:
    """All local minima on SO(3) that Newton's method reaches from the 24 rotations of the cube, all starts at once.

    Returns (k, 3, 3) rotations, best first, and the iterations.
    """
    R = _STARTS
    cost = _cost(H, h, R)
    iterations = 0
    while iterations < bound:
        iterations += 1
        gradient, hessian = _derivatives(H, h, R)
        values, vectors = np.linalg.eigh(hessian)
        # Absolute curvature: always downhill, away from saddles.
        along = (_t(vectors) @ gradient[..., None])[..., 0] / np.maximum(np.abs(values), 1e-9)
        step = -(vectors @ along[..., None])[..., 0]
        step /= np.maximum(np.linalg.norm(step, axis=-1, keepdims=True) / 0.5, 1.0)
        for _ in range(10):
            new = Rotation.from_rotvec(step).as_matrix() @ R
            new_cost = _cost(H, h, new)
            uphill = new_cost > cost + 1e-15 * np.abs(cost)
            if not uphill.any():
                break
            step[uphill] /= 2
        R, cost = np.where(uphill[:, None, None], R, new), np.where(uphill, cost, new_cost)
        size = np.abs(gradient).max(axis=-1)
        if ((size < 1e-12) | ((size < STATIONARY) & (values[:, 0] < -FLAT))).all():  # a saddle is left where it is
            break
    gradient, hessian = _derivatives(H, h, R)
    good = (np.abs(gradient).max(axis=-1) < STATIONARY) & (np.linalg.eigvalsh(hessian)[:, 0] > -FLAT)
    good[np.argmin(cost)] = True
    kept: list[FloatArray] = []
    for i in np.argsort(cost, kind="stable"):
        # |R1 - R2|² is twice the squared angle between near rotations.
        if good[i] and all(np.linalg.norm(R[i] - other) > SAME * np.sqrt(2) for other in kept):
            kept.append(R[i])
    return np.array(kept), iterations


# --- Translation ------------------------------------------------------------------------------------------------------


def translation_from_means(
    rotations: ArrayLike, centers: ArrayLike, moments: Sequence[PairMoments], rotation: ArrayLike, center: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """The displacement d of the object's centre from the means of the cameras' matches, given the rotation.

    Weak perspective: all that a camera sees of the object is at the depth Z of the centre g, so its mean point in frame
    i is s = o + Z Q'(x̄, 1). It turns with the object about g and moves by d, to s_j = g + R (s - g) + d, and is seen at
    ȳ: with (u, v) = Q (s_j - o), u the first two coordinates, u - ȳ v = 0. That is linear in d; the residuals (u - ȳ v) / Z
    are image distances, weighted by the matches' count. The visible surface is in truth nearer than g by some
    ρ: an error of up to ρ times the angle of the turn, per camera, which cameras on opposite sides cancel.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        centers: (C, 3) the cameras' centres o in the world.
        moments: C pair moments of normalised points.
        rotation: (3, 3) R of the object's motion, world frame.
        center: (3,) the object's centre g in frame i, world.

    Returns:
        d: (3,) of least length where a direction is not observable (one camera: along its ray).
        information: (3, 3) of d, over the larger of two variances: the matches' residual variance about R and, from two
            cameras on, that which the means' residuals imply. Zero along what is not observable.

    Raises:
        ValueError: shapes that do not fit, no rotations, no matches, a centre that is not in front of a camera.
    """
    Q = _rotations(rotations, moments)
    R = _rotations(np.asarray(rotation, dtype=float)[None], [PairMoments.zero()])[0]
    o, g = np.asarray(centers, dtype=float), np.asarray(center, dtype=float)
    if o.shape != (len(Q), 3) or g.shape != (3,) or not (np.isfinite(o).all() and np.isfinite(g).all()):
        raise ValueError(f"centers must be ({len(Q)}, 3) and center (3,), finite; got {o.shape} and {g.shape}")
    seen = np.array([m.count > 0 for m in moments])
    if not seen.any():
        raise ValueError("no camera has matches")
    depth = np.einsum("ci,ci->c", Q[:, 2], g - o)
    if (depth[seen] <= 0).any():
        raise ValueError(f"the object's centre is not in front of camera {int(np.argmax(seen & (depth <= 0)))}")
    variance = _quadratic(Q, moments, aim=True).variance(R)

    Q, o, depth = Q[seen], o[seen], depth[seen]
    used = [m for m, s in zip(moments, seen, strict=True) if s]
    x = np.array([[*m.mean_x, 1.0] for m in used])
    y = np.array([[*m.mean_y, 1.0] for m in used])
    offset = o + depth[:, None] * np.einsum("cji,cj->ci", Q, x) - g
    # Per camera the two rows [I, -ȳ] Q / Z, times the square root of the weight.
    weight = np.sqrt([m.count for m in used]) / depth
    rows = weight[:, None, None] * (Q[:, :2] - y[:, :2, None] * Q[:, 2:])
    target = np.einsum("cki,ci->ck", rows, o - g - offset @ R.T).ravel()
    jacobian = rows.reshape(-1, 3)
    d = np.linalg.lstsq(jacobian, target, rcond=1e-9)[0]
    if len(used) > 1:
        residuals = target - jacobian @ d
        variance = max(variance, float(residuals @ residuals) / (2 * len(used) - 3))
    return np.asarray(d), np.asarray(jacobian.T @ jacobian / variance)
