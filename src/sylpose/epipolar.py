"""Six degrees of freedom from pair moments: the multi-camera epipolar cost and its Levenberg-Marquardt solver.

A **term** is what one camera saw between a reference frame and the current one. Its rays are turned into the world's
axes, so that all terms share one pair of unknowns: the motion X_j = R (X_i - g) + g + d about the object's centre g.
With a1 = (camera's centre at frame i) - g and a2 = (the same at frame j) - g, a match (x, y) of world-axes rays has

    y' G x = 0,      G = [τ]× R,      τ = R a1 - a2 + d

and the cost is a sum over terms of vec(G)' M vec(G) / vec(G)' D vec(G): the Sampson error with its denominator
taken at the mean rays (it hardly varies over a small object). A static camera has a1 = a2. When the reference is not the
frame that the motion starts from, the known motion between the two moves the camera instead, so several references are
more terms of the same cost.

Each term also knows roughly how far away the object is (the point nearest to the cameras' rays, give or take the
object's radius). Where its mean match goes along the epipolar line is one more residual, weak on purpose: it decides
only what epipolar geometry leaves open, such as the length of a translation.

Source: Sampson error, Hartley & Zisserman, "Multiple View Geometry", section 11.4.3; the generalised epipolar
constraint, Pless 2003; moments and world-axes form, docs/method.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.moments import PairMoments

__all__ = ["Solution", "TermData", "Terms", "minimize", "normal_equations", "sampson_residuals"]

FloatArray = NDArray[np.float64]

# [e_k]x for the three axes: (3, 3, 3).
_GENERATORS = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], float
)


@dataclass(frozen=True, eq=False)
class TermData:
    """The matches of one camera between one reference frame and the current frame.

    Attributes:
        camera: index in the rig.
        x, y: (n, 3) homogeneous normalised points (third coordinate 1) in the reference and in the current frame.
        rotation: (3, 3) Q of camera_from_world.
        center: (3,) the camera's centre, world.
        focal: pixels per normalised unit.
        base_from_reference: moves the object from where it was in the reference frame to the frame that the motion
            starts from; None for that frame itself.
    """

    camera: int
    x: FloatArray
    y: FloatArray
    rotation: FloatArray
    center: FloatArray
    focal: float
    base_from_reference: RigidTransform | None = None

    def subset(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> TermData:
        """The matches that a mask or an index array picks."""
        return replace(self, x=self.x[index], y=self.y[index])

    @property
    def center_x(self) -> FloatArray:
        """(3,) the camera's centre seen from the object at the motion's start."""
        if self.base_from_reference is None:
            return self.center
        return np.asarray(self.base_from_reference.apply(self.center))

    @property
    def rotation_x(self) -> FloatArray:
        """(3, 3) Q of the camera that the object, at the motion's start, sees the reference frame from."""
        if self.base_from_reference is None:
            return self.rotation
        return np.asarray(self.rotation @ self.base_from_reference.rotation.as_matrix().T)


@dataclass(frozen=True, eq=False)
class Terms:
    """All terms of one problem, as stacked arrays (T terms). See the module's text for the symbols.

    Attributes:
        factor: (T, 9, 9) L with L L' = M, in units of pixels / sigma.
        denominator: (T, 9, 9) D.
        a1, a2: (T, 3).
        prior_point: (T, 3) the mean matched point at its assumed depth, relative to g, at the motion's start.
        prior_image: (T, 2) mean of y, camera axes, normalised.
        prior_rotation: (T, 3, 3) Q of the current camera.
        prior_depth_sd: (T,) standard deviation of that depth.
        prior_sigma: (T,) floor of the prior's image error, normalised units.
    """

    factor: FloatArray
    denominator: FloatArray
    a1: FloatArray
    a2: FloatArray
    prior_point: FloatArray
    prior_image: FloatArray
    prior_rotation: FloatArray
    prior_depth_sd: FloatArray
    prior_sigma: FloatArray

    @classmethod
    def build(
        cls,
        data: Sequence[TermData],
        moments: Sequence[PairMoments],
        sigma_px: FloatArray,
        center: FloatArray,
        radius: float,
    ) -> Terms:
        """Stack the terms.

        Args:
            data: T terms; of these only the geometry is read.
            moments: T pair moments of the terms' matches, camera axes, each with a positive count.
            sigma_px: (T,) image noise, pixels.
            center: (3,) g.
            radius: of the object, length units: how far a feature's depth may be from the centre's.
        """
        factors, denominators, priors, images = [], [], [], []
        for term, m, sigma in zip(data, moments, sigma_px, strict=True):
            to_world = np.kron(term.rotation, term.rotation_x)
            values, vectors = np.linalg.eigh(to_world.T @ m.matrix @ to_world)
            factors.append(vectors * np.sqrt(np.maximum(values, 0.0)) * (term.focal / sigma))
            mean_x, mean_y = np.append(m.mean_x, 1.0) @ term.rotation_x, np.append(m.mean_y, 1.0) @ term.rotation
            b1 = np.einsum("ai,j->aij", term.rotation[:2], mean_x).reshape(2, 9)
            b2 = np.einsum("i,aj->aij", mean_y, term.rotation_x[:2]).reshape(2, 9)
            denominators.append(b1.T @ b1 + b2.T @ b2)
            depth = float((term.rotation_x @ (center - term.center_x))[2])
            priors.append(depth * mean_x + term.center_x - center)
            images.append(m.mean_y)
        focal = np.array([term.focal for term in data])
        return cls(
            factor=np.array(factors),
            denominator=np.array(denominators),
            a1=np.array([term.center_x for term in data]) - center,
            a2=np.array([term.center for term in data]) - center,
            prior_point=np.array(priors),
            prior_image=np.array(images),
            prior_rotation=np.array([term.rotation for term in data]),
            prior_depth_sd=np.full(len(data), radius),
            prior_sigma=2.0 / focal,
        )


@dataclass(frozen=True, eq=False)
class Solution:
    """A minimum of the cost.

    Attributes:
        rotation: (3, 3) R.
        shift: (3,) d.
        cost: at the minimum, prior included; half the sum of squares.
        converged: whether the last step was negligible.
        iterations: number of steps tried.
    """

    rotation: FloatArray
    shift: FloatArray
    cost: float
    converged: bool
    iterations: int


def _skew(v: FloatArray) -> FloatArray:
    """(..., 3) -> (..., 3, 3) with [v]x u = v x u."""
    return np.asarray(np.einsum("...k,kij->...ij", v, _GENERATORS))


def _residuals(terms: Terms, rotation: FloatArray, shift: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Whitened residuals and their derivatives.

    Args:
        rotation: (S, 3, 3) and shift: (S, 3), S candidates at once.

    Returns:
        residuals (S, T, 10): nine epipolar ones and the prior's; derivatives (S, T, 10, 6) by (w, d).
    """
    turned = np.einsum("sij,tj->sti", rotation, terms.a1)
    tau = turned - terms.a2 + shift[:, None]
    rot = rotation[:, None]
    g = _skew(tau) @ rot
    # By w_k: [e_k x R a1]x R + [τ]x [e_k]x R; by d_k: [e_k]x R.
    turn_of_tau = np.einsum("kij,stj->stki", _GENERATORS, turned)
    generators_r = np.einsum("kij,sjl->skil", _GENERATORS, rotation)[:, None]
    by_w = _skew(turn_of_tau) @ rot[:, :, None] + _skew(tau)[:, :, None] @ generators_r
    by_d = np.broadcast_to(generators_r, by_w.shape)
    v = g.reshape(*g.shape[:2], 9)
    dv = np.concatenate([by_w, by_d], axis=2).reshape(*g.shape[:2], 6, 9)
    dvd = np.einsum("sti,tij->stj", v, terms.denominator)
    norm = np.sqrt(np.maximum(np.einsum("sti,sti->st", dvd, v), 1e-24))[..., None]
    r = np.einsum("sti,tij->stj", v, terms.factor) / norm
    dnorm = np.einsum("sti,stki->stk", dvd, dv) / norm  # derivative of the norm
    dr = (np.einsum("stki,tij->stjk", dv, terms.factor) - r[..., None] * dnorm[:, :, None, :]) / norm[..., None]
    rp, drp = _prior_residuals(terms, rotation, shift)
    return np.concatenate([r, rp], axis=2), np.concatenate([dr, drp], axis=2)


def _prior_residuals(terms: Terms, rotation: FloatArray, shift: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The depth prior's residual (S, T, 1) and derivative (S, T, 1, 6); its weight is held fixed (no derivative)."""
    turned = np.einsum("sij,tj->sti", rotation, terms.prior_point)
    q = terms.prior_rotation
    p = np.einsum("tij,stj->sti", q, turned - terms.a2 + shift[:, None])
    z = np.where(np.abs(p[..., 2:]) < 1e-9, 1e-9, p[..., 2:])
    image = p[..., :2] / z
    # Derivative of the image point by the point in camera axes: (S, T, 2, 3).
    jac = np.zeros((*p.shape[:2], 2, 3))
    jac[..., 0, 0] = jac[..., 1, 1] = 1.0 / z[..., 0]
    jac[..., 2] = -image / z
    jac_world = jac @ q
    # The line of sight in the reference frame, turned with the motion: where unknown depth moves the image point.
    ray = turned - np.einsum("sij,tj->sti", rotation, terms.a1)
    ray = ray / np.maximum(np.linalg.norm(ray, axis=-1, keepdims=True), 1e-12)
    along = np.einsum("stij,stj->sti", jac_world, ray)
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    unit = along / np.maximum(length, 1e-12)
    sd = np.sqrt((length[..., 0] * terms.prior_depth_sd) ** 2 + terms.prior_sigma**2)[..., None]
    r = np.einsum("sti,sti->st", unit, image - terms.prior_image)[..., None] / sd
    by_point = np.einsum("sti,stij->stj", unit, jac_world) / sd
    by_w = np.cross(turned, by_point)  # d(w x p) . n = w . (p x n)
    return r, np.concatenate([by_w, by_point], axis=-1)[:, :, None, :]


def normal_equations(
    terms: Terms, rotation: FloatArray, shift: FloatArray, *, prior: bool
) -> tuple[FloatArray, FloatArray, float]:
    """(J'J (6, 6), J'r (6,), half the sum of squares) at one candidate, with or without the depth prior."""
    r, dr = _residuals(terms, rotation[None], shift[None])
    if not prior:
        r, dr = r[:, :, :9], dr[:, :, :9]
    r, dr = r.reshape(-1), dr.reshape(-1, 6)
    return dr.T @ dr, dr.T @ r, 0.5 * float(r @ r)


def minimize(
    terms: Terms, rotations: FloatArray, shifts: FloatArray, *, iterations: int = 40, keep: int = 3
) -> list[Solution]:
    """Levenberg-Marquardt from several starts at once.

    Args:
        rotations: (S, 3, 3) and shifts: (S, 3), the starts; none may be the identity, where the cost is 0/0.
        iterations: bound on the number of steps.
        keep: starts that are followed to the end; the others are dropped after five steps.

    Returns:
        The minima reached, best first.
    """
    rotation, shift = rotations.copy(), shifts.copy()
    r, dr = _flat(*_residuals(terms, rotation, shift))
    cost = 0.5 * np.einsum("si,si->s", r, r)
    damping = np.full(len(rotation), 1e-3)
    converged = np.zeros(len(rotation), dtype=bool)
    step_count = 0
    for step_count in range(1, iterations + 1):
        if step_count == 6 and len(rotation) > keep:
            best = np.argsort(cost, kind="stable")[:keep]
            rotation, shift, r, dr, cost, damping, converged = (
                a[best] for a in (rotation, shift, r, dr, cost, damping, converged)
            )
        hessian = np.einsum("sik,sil->skl", dr, dr)
        gradient = np.einsum("sik,si->sk", dr, r)
        scale = np.einsum("skk->sk", hessian)
        damped = hessian + np.einsum("s,sk,kl->skl", damping, scale + 1e-12 * scale.max(), np.eye(6))
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
        # A turn of more than a radian in one step leaves the region that the derivatives speak of.
        step /= np.maximum(np.linalg.norm(step[:, :3], axis=1, keepdims=True), 1.0)
        new_rotation = Rotation.from_rotvec(step[:, :3]).as_matrix() @ rotation
        new_shift = shift + step[:, 3:]
        new_r, new_dr = _flat(*_residuals(terms, new_rotation, new_shift))
        new_cost = 0.5 * np.einsum("si,si->s", new_r, new_r)
        better = new_cost < cost
        predicted = -np.einsum("sk,sk->s", step, gradient)
        converged |= predicted <= 1e-10 * np.maximum(cost, 1e-30)
        converged |= better & (cost - new_cost <= 1e-10 * cost)
        rotation[better], shift[better], cost[better] = new_rotation[better], new_shift[better], new_cost[better]
        r[better], dr[better] = new_r[better], new_dr[better]
        damping = np.where(better, np.maximum(damping * 0.2, 1e-12), damping * 8.0)
        if converged.all():
            break
    order = np.argsort(cost, kind="stable")
    return [Solution(rotation[i], shift[i], float(cost[i]), bool(converged[i]), step_count) for i in order]


def _flat(r: FloatArray, dr: FloatArray) -> tuple[FloatArray, FloatArray]:
    return r.reshape(len(r), -1), dr.reshape(len(dr), -1, 6)


def sampson_residuals(
    term: TermData, center: FloatArray, rotation: FloatArray, shift: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Signed Sampson distance of every match of a term, in pixels, and its squared denominator relative to the mean.

    Returns:
        residuals (n,), ratio (n,): the second is what the cost's common denominator must be multiplied by.
    """
    tau = rotation @ (term.center_x - center) - (term.center - center) + shift
    essential = term.rotation @ _skew(tau) @ rotation @ term.rotation_x.T
    ex, ey = term.x @ essential.T, term.y @ essential
    denominator = (ex[:, :2] ** 2).sum(axis=1) + (ey[:, :2] ** 2).sum(axis=1)
    mean = max(float(np.mean(denominator)), 1e-24) if len(denominator) else 1.0
    residual = term.focal * np.einsum("ij,ij->i", term.y, ex) / np.sqrt(np.maximum(denominator, 1e-9 * mean))
    return residual, denominator / mean
