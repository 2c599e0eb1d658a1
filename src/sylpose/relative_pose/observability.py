"""Tests of a fitted motion: zero motion, collinear points, unobservable directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.normal_equations import (
    UNOBSERVABLE_RATIO,
    are_all_observable,
    find_unobservable_directions,
    has_rotation_direction,
)
from sylpose.geometry.numba_linalg import cholesky_solve, dot, kernel, so3_log
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.relative_pose.irls import IrlsFit
from sylpose.relative_pose.terms import Fit, Stack
from sylpose.status import Status

# Least increase of the cost without any motion (six unknowns) or without rotation (three); below it the motion or
# rotation may be zero (chi-squared, once in a thousand times).
MIN_MOTION_SQUARE, MIN_ROTATION_SQUARE = chi_squared_bound(6), chi_squared_bound(3)
# Points are collinear if they deviate from a line by at most this, in standard deviations of their noise (chi-squared, once
# in a thousand times).
MAX_ROD_SIGMAS = float(np.sqrt(chi_squared_bound(1)))
# They also count as collinear up to this deviation if they extend so many times as far along the line. The depth of so
# thin an object is hardly visible, and its apparent rotation about itself rests on the prior slopes (choice).
MAX_THIN_SIGMAS, MIN_THIN_RATIO = 9.0, 10.0


def classify_observability(fit: Fit, radius: float) -> tuple[Fit, FloatArray]:
    """Return the fit with its status set by its observability: OK, or an unobservable scale or rotation.

    Returns:
        the fit; the unobservable directions (k, 6) behind its status.
    """
    if fit.status not in (Status.OK, Status.NOT_CERTIFIED):
        return fit, np.empty((0, 6))
    information = fit.information, fit.information_without_depth
    directions = find_unobservable_motions(fit.rotation, fit.translation, *information, radius)
    if len(directions) == 0:
        return fit, directions
    is_rotation = has_rotation_direction(directions * ([radius] * 3 + [1.0] * 3))
    status = Status.ROTATION_NOT_OBSERVABLE if is_rotation else Status.SCALE_NOT_OBSERVABLE
    return replace(fit, status=status), directions


def find_unobservable_motions(
    rotation: FloatArray, translation: FloatArray, information: FloatArray, without_depth: FloatArray, radius: float
) -> FloatArray:
    """Find the directions (k, 6) of (w, d) that the matches do not determine, from the information of a `Fit`.

    The prior on the object's distance is not used.
    A rotation moves the object's surface by radius times angle, a translation by its length. In this metric the rows
    are orthonormal. A direction is unobservable if its standard deviation exceeds half of the motion itself
    (`UNOBSERVABLE_RATIO`): even the sign of its contribution is then uncertain. A translation without rotation has no
    observable length; a rotation within its noise must not suggest one.
    """
    size, is_observable, has_rotation = _measure_observability(
        rotation, translation, information, without_depth, radius
    )
    if is_observable and has_rotation:
        return np.empty((0, 6))
    scale = np.array([1.0 / radius] * 3 + [1.0] * 3)
    directions = find_unobservable_directions(without_depth, UNOBSERVABLE_RATIO * size * scale)
    if len(directions) == 0 and not has_rotation:
        directions = np.concatenate([np.zeros(3), translation / np.linalg.norm(translation)])[None]
    return np.asarray(directions * scale)


@kernel
def _measure_observability(
    rotation: FloatArray, translation: FloatArray, information: FloatArray, without_depth: FloatArray, radius: float
) -> tuple[float, bool, bool]:
    """Return the size of a motion, and whether it is observable; see `find_unobservable_motions`.

    Returns:
        displacement of the surface; whether the standard deviation of no direction exceeds the limit; whether the rotation
        is larger than the translation, or than its noise.
    """
    rotvec, limits = np.empty(3), np.empty(6)
    so3_log(rotation, rotvec)
    arc, length = radius * np.sqrt(dot(rotvec, rotvec)), np.sqrt(dot(translation, translation))
    size = np.hypot(arc, length)
    for i in range(6):
        limits[i] = UNOBSERVABLE_RATIO * size / (radius if i < 3 else 1.0)
    # The rotation's information, the translation eliminated.
    coupled, square = np.zeros(6), 0.0
    for i in range(6):
        for j in range(3):
            coupled[i] += information[i, j] * rotvec[j]
        square += coupled[i] * rotvec[i] if i < 3 else 0.0
    factor, eliminated = information[3:, 3:].copy(), coupled[3:].copy()
    if cholesky_solve(factor, eliminated):
        square -= dot(coupled[3:], eliminated)
    is_observable = are_all_observable(without_depth, limits, 0.0)
    return size, is_observable, not length > arc or square >= MIN_ROTATION_SQUARE


@kernel
def is_static(stack: Stack, fit: IrlsFit, information: FloatArray) -> bool:
    """Return whether the motion may be zero.

    Two tests must agree. The motion is no further from zero than by chance, given its information (Wald's test), and
    zero motion explains the inliers about as well. The second test covers weakly observed rotations, which have little
    information but displace the matches. The fit constrains one of a match's two coordinates; the other, along its
    epipolar line, is counted as pure noise.
    """
    motion, wald_square = np.empty(6), 0.0
    so3_log(fit.candidate.rotation, motion[:3])
    motion[3:] = fit.candidate.translation
    for i in range(6):
        for j in range(6):
            wald_square += motion[i] * information[i, j] * motion[j]
    if wald_square >= MIN_MOTION_SQUARE:
        return False
    likelihood_loss = 0.0
    for t in range(stack.focal.shape[0]):
        sigma_px = fit.sigma_px[t]
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            dx, dy = stack.y[i, 0] - stack.x[i, 0], stack.y[i, 1] - stack.x[i, 1]
            static_cost = 0.5 * (dx * dx + dy * dy) * (stack.focal[t] / sigma_px) ** 2
            if fit.weights[i] > 0.0:
                likelihood_loss += fit.weights[i] * (static_cost - (fit.residuals_px[i] / sigma_px) ** 2 - 1.0)
    return likelihood_loss < MIN_MOTION_SQUARE


def find_rod_axis(stack: Stack, fit: IrlsFit) -> FloatArray | None:
    """Return (6,) the rotation about itself of points that are collinear in every camera up to noise; else None.

    Noise across the line, with the depth model bent to fit it, would otherwise appear as structure that determines this
    rotation.
    """
    normals = np.zeros((3, 3))
    if not is_collinear(stack, fit.weights, fit.sigma_px, normals):
        return None
    return np.concatenate([np.linalg.eigh(normals)[1][:, 0], np.zeros(3)])


@kernel
def is_collinear(stack: Stack, weights: FloatArray, sigma_px: FloatArray, normals: FloatArray) -> bool:
    """Return whether all terms' inliers are collinear in both images.

    normals (3, 3) receives the sum of n n' over the planes through the current cameras and those lines.
    """
    collinear_count, inliers = 0, 0
    for t in range(stack.focal.shape[0]):
        for frame in range(2):
            points = stack.y if frame == 1 else stack.x
            n, mx, my, xx, xy, yy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(stack.offsets[t], stack.offsets[t + 1]):
                if weights[i] > 0.0:
                    n += 1
                    mx += points[i, 0]
                    my += points[i, 1]
            inliers += n
            # Two points are always collinear.
            if n < 3:
                continue
            collinear_count += n
            mx, my = mx / n, my / n
            for i in range(stack.offsets[t], stack.offsets[t + 1]):
                if weights[i] > 0.0:
                    dx, dy = points[i, 0] - mx, points[i, 1] - my
                    xx += dx * dx / (n - 1)
                    xy += dx * dy / (n - 1)
                    yy += dy * dy / (n - 1)
            # The smaller eigenvalue of the points' covariance.
            least = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
            noise, most = (sigma_px[t] / stack.focal[t]) ** 2, xx + yy - least
            thin = least <= MAX_THIN_SIGMAS**2 * noise and most > MIN_THIN_RATIO**2 * least
            if least > MAX_ROD_SIGMAS**2 * noise and not thin:
                return False
            if frame == 1:
                angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
                a, b = -np.sin(angle), np.cos(angle)
                normal = np.empty(3)
                for k in range(3):
                    normal[k] = a * stack.qy[t, 0, k] + b * stack.qy[t, 1, k] - (a * mx + b * my) * stack.qy[t, 2, k]
                length = normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
                for k in range(3):
                    for j in range(3):
                        normals[k, j] += normal[k] * normal[j] / length
    return collinear_count > inliers // 2
