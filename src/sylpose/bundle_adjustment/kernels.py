"""Compiled loops of the bundle adjustment: residuals, derivatives, triangulation, and each landmark's 3x3 system.

Observations are sorted by landmark, then by frame. A landmark X of the object is observed by camera c in frame k at p =
M (R X) + b, M = Q E and b = Q (t + u - o), where E and u move frame k's pose to the camera's timestamp.

In addition to the frames' poses there are *shared* parameters, which each camera has once for all frames: the columns
`TIME_OFFSET`, `DEPTH`, `ROTATION`, `TRANSLATION` and `LENS` below. Their prior, and which are free, is in
`camera_parameters`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import cholesky_solve, kernel, so3_log

# Residual of a landmark behind a camera, pixels: an outlier at any noise (choice).
BEHIND_PX = 1e6
# Columns of a camera's shared parameters (derived: consecutive): time offset, seconds, positive for a delay; depth of
# the observed surface in front of the object's origin, and its slopes to the right and downwards; then, only if the
# calibration is uncertain, rotation (camera's axes), translation of the center (world's axes), and lens.
TIME_OFFSET, DEPTH, ROTATION, TRANSLATION, LENS = 0, 1, 4, 7, 10


class SortedObservations(NamedTuple):
    """Observations sorted by landmark: n observations of m landmarks.

    Attributes:
        start: (m + 1,) landmark i has the observations start[i] to start[i + 1].
        frame, camera: (n,) indices; frames do not decrease within a landmark.
        image: (n, 2) normalized points.
        lens: (n, 3, L) derivatives of the normalized point by the camera's L lens parameters, and of the logarithm of a
            pixel's size there; L may be 0.
        free_index: (N,) number of each frame among the free ones, increasing, or -1 for a fixed frame.
        first_viewer: (m,) the camera that observed a landmark first.
        depth_direction: (m, 3) unit vector from the object's origin towards it at that time, object's frame.
        depth_basis: (m, 3) 1, and the landmark's offset to the right and below in that view: the basis in which its
            depth is linear.
    """

    start: IntArray
    frame: IntArray
    camera: IntArray
    image: FloatArray
    lens: FloatArray
    free_index: IntArray
    first_viewer: IntArray
    depth_direction: FloatArray
    depth_basis: FloatArray


class Views(NamedTuple):
    """N frames as observed by C cameras.

    Attributes:
        object_rotations: (N, 3, 3) R of world_from_object.
        camera_from_object, translations: (N, C, 3, 3) M and (N, C, 3) b, see the module.
        angular_velocity, linear_velocity: (N, C, 3) the object's angular velocity and its origin's velocity, camera's
            axes, per second.
        rotations: (C, 3, 3) Q of camera_from_world.
        rotvec_jacobians: (C, 3, 3) rotation per change of the camera's rotation vector.
        focals: (C,) pixels.
        parameters: (C, K) the cameras' shared parameters.
    """

    object_rotations: FloatArray
    camera_from_object: FloatArray
    translations: FloatArray
    angular_velocity: FloatArray
    linear_velocity: FloatArray
    rotations: FloatArray
    rotvec_jacobians: FloatArray
    focals: FloatArray
    parameters: FloatArray


class Linearization(NamedTuple):
    """Weighted observations of landmarks, linearized at poses and points.

    Attributes:
        observations, views: n observations of m landmarks, and the frames as observed.
        points: (m, 3) landmarks.
        weights: (n,) of the squared residuals, 1/pixels²; 0 for points behind their camera.
        prior: (2,) prior information, 1/length², on a landmark's depth at the surface, and on its position at the
            origin.
    """

    observations: SortedObservations
    views: Views
    points: FloatArray
    weights: FloatArray
    prior: FloatArray


class LandmarkSystem(NamedTuple):
    """Terms of one landmark with k observations; filled by `eliminate_landmark`.

    Attributes:
        e: (k, 2) residuals.
        pose_jacobian, shared_jacobian, point_jacobian: (k, 2, 6), (k, 2, K), (k, 2, 3) as of `compute_derivatives`.
        root: (3, 3) inverse of the Cholesky factor of the landmark's information.
        slope: (3,) root times its gradient.
    """

    e: FloatArray
    pose_jacobian: FloatArray
    shared_jacobian: FloatArray
    point_jacobian: FloatArray
    root: FloatArray
    slope: FloatArray


@kernel
def compute_residuals(observations: SortedObservations, views: Views, points: FloatArray, out: FloatArray) -> None:
    """Write the reprojection errors of landmarks (m, 3), projection minus observation, to out (n, 2), pixels."""
    y = np.empty(3)
    for i in range(points.shape[0]):
        for n in range(observations.start[i], observations.start[i + 1]):
            k, c = observations.frame[n], observations.camera[n]
            r, m, b = views.object_rotations[k], views.camera_from_object[k, c], views.translations[k, c]
            for a in range(3):
                y[a] = r[a, 0] * points[i, 0] + r[a, 1] * points[i, 1] + r[a, 2] * points[i, 2]
            z = m[2, 0] * y[0] + m[2, 1] * y[1] + m[2, 2] * y[2] + b[2]
            if z > 1e-9:
                focal = views.focals[c] * compute_pixel_scale(observations, views, n)
                for a in range(2):
                    p = m[a, 0] * y[0] + m[a, 1] * y[1] + m[a, 2] * y[2] + b[a]
                    image = observations.image[n, a]
                    for j in range(observations.lens.shape[2]):
                        image += observations.lens[n, a, j] * views.parameters[c, LENS + j]
                    out[n, a] = focal * (p / z - image)
            else:
                out[n, 0], out[n, 1] = BEHIND_PX, 0.0


@kernel
def compute_pixel_scale(observations: SortedObservations, views: Views, n: int) -> float:
    """Return the size of observation n's pixel relative to that of the given lens.

    Without this factor, a longer focal length would reduce all residuals.
    """
    out, c = 1.0, observations.camera[n]
    for j in range(observations.lens.shape[2]):
        out += observations.lens[n, 2, j] * views.parameters[c, LENS + j]
    return out


@kernel
def compute_derivatives(
    observations: SortedObservations, views: Views, point: FloatArray, n: int, o: int, out: LandmarkSystem
) -> None:
    """Write the residual and the derivatives, pixels, of observation n to row o of its landmark's system.

    They are by (w, d) (2, 6), by its camera's shared parameters (2, K) and by the landmark (2, 3). The landmark must be
    in front of the camera. The columns `DEPTH` are not written: no residual depends on them.
    """
    e, pose_jacobian, shared_jacobian = out.e[o], out.pose_jacobian[o], out.shared_jacobian[o]
    point_jacobian = out.point_jacobian[o]
    k, c = observations.frame[n], observations.camera[n]
    r, m, b, q = views.object_rotations[k], views.camera_from_object[k, c], views.translations[k, c], views.rotations[c]
    angular_velocity, linear_velocity = views.angular_velocity[k, c], views.linear_velocity[k, c]
    y0 = r[0, 0] * point[0] + r[0, 1] * point[1] + r[0, 2] * point[2]
    y1 = r[1, 0] * point[0] + r[1, 1] * point[1] + r[1, 2] * point[2]
    y2 = r[2, 0] * point[0] + r[2, 1] * point[1] + r[2, 2] * point[2]
    g0 = m[0, 0] * y0 + m[0, 1] * y1 + m[0, 2] * y2
    g1 = m[1, 0] * y0 + m[1, 1] * y1 + m[1, 2] * y2
    g2 = m[2, 0] * y0 + m[2, 1] * y1 + m[2, 2] * y2
    p0, p1, z = g0 + b[0], g1 + b[1], g2 + b[2]
    scale_factor = compute_pixel_scale(observations, views, n)
    focal = views.focals[c] * scale_factor
    scale = focal / z
    # Velocity of the point in the camera's axes.
    v0 = angular_velocity[1] * g2 - angular_velocity[2] * g1 + linear_velocity[0]
    v1 = angular_velocity[2] * g0 - angular_velocity[0] * g2 + linear_velocity[1]
    v2 = angular_velocity[0] * g1 - angular_velocity[1] * g0 + linear_velocity[2]
    has_calibration = views.parameters.shape[1] > ROTATION
    for a in range(2):
        image = (p0 if a == 0 else p1) / z
        observed = observations.image[n, a]
        h0 = scale * (m[a, 0] - image * m[2, 0])
        h1 = scale * (m[a, 1] - image * m[2, 1])
        h2 = scale * (m[a, 2] - image * m[2, 2])
        pose_jacobian[a, 0] = y1 * h2 - y2 * h1
        pose_jacobian[a, 1] = y2 * h0 - y0 * h2
        pose_jacobian[a, 2] = y0 * h1 - y1 * h0
        for j in range(3):
            pose_jacobian[a, 3 + j] = scale * (q[a, j] - image * q[2, j])
            point_jacobian[a, j] = h0 * r[0, j] + h1 * r[1, j] + h2 * r[2, j]
        shared_jacobian[a, TIME_OFFSET] = scale * ((v0 if a == 0 else v1) - image * v2)
        if has_calibration:
            # The derivative by p is scale (1, 0, -image) or scale (0, 1, -image), and p moves by the rotation x p.
            x, y = (scale, 0.0) if a == 0 else (0.0, scale)
            t0 = -p1 * scale * image - z * y
            t1 = z * x + p0 * scale * image
            t2 = p0 * y - p1 * x
            for j in range(3):
                rotvec_jacobian = views.rotvec_jacobians[c]
                turn = t0 * rotvec_jacobian[0, j] + t1 * rotvec_jacobian[1, j] + t2 * rotvec_jacobian[2, j]
                shared_jacobian[a, ROTATION + j] = turn
                shared_jacobian[a, TRANSLATION + j] = -pose_jacobian[a, 3 + j]
            for j in range(observations.lens.shape[2]):
                observed += observations.lens[n, a, j] * views.parameters[c, LENS + j]
                shared_jacobian[a, LENS + j] = -focal * observations.lens[n, a, j]
        e[a] = focal * (image - observed)
        for j in range(observations.lens.shape[2]):
            shared_jacobian[a, LENS + j] += e[a] * observations.lens[n, 2, j] / scale_factor


@kernel
def make_landmark_system(at: Linearization) -> LandmarkSystem:
    """Allocate the terms of a landmark."""
    longest, start = 0, at.observations.start
    for i in range(start.shape[0] - 1):
        longest = max(longest, start[i + 1] - start[i])
    e, pose_jacobian, point_jacobian = np.empty((longest, 2)), np.empty((longest, 2, 6)), np.empty((longest, 2, 3))
    shared_jacobian = np.zeros((longest, 2, at.views.parameters.shape[1]))
    return LandmarkSystem(e, pose_jacobian, shared_jacobian, point_jacobian, np.zeros((3, 3)), np.empty(3))


@kernel
def eliminate_landmark(at: Linearization, i: int, system: LandmarkSystem) -> bool:
    """Compute all terms of landmark i: its observations' residuals and derivatives, and its 3x3 system.

    Returns:
        False if no observation has weight: the landmark is then not moved.
    """
    observations, views, weights, e, root, slope = (
        at.observations,
        at.views,
        at.weights,
        system.e,
        system.root,
        system.slope,
    )
    depth_prior, lateral_prior = at.prior
    point, first, last = at.points[i], observations.start[i], observations.start[i + 1]
    u, r = observations.depth_direction[i], depth_prior * compute_depth_residual(at, i)
    v00, v10 = lateral_prior + depth_prior * u[0] * u[0], depth_prior * u[1] * u[0]
    v11, v20 = lateral_prior + depth_prior * u[1] * u[1], depth_prior * u[2] * u[0]
    v22, v21 = lateral_prior + depth_prior * u[2] * u[2], depth_prior * u[2] * u[1]
    g0 = lateral_prior * point[0] + r * u[0]
    g1 = lateral_prior * point[1] + r * u[1]
    g2 = lateral_prior * point[2] + r * u[2]
    has_weight = False
    for n in range(first, last):
        w = weights[n]
        if w <= 0.0:
            continue
        has_weight = True
        o = n - first
        compute_derivatives(observations, views, point, n, o, system)
        for a in range(2):
            x, y, z = system.point_jacobian[o, a]
            r = w * e[o, a]
            v00 += w * x * x
            v10 += w * y * x
            v11 += w * y * y
            v20 += w * z * x
            v21 += w * z * y
            v22 += w * z * z
            g0 += r * x
            g1 += r * y
            g2 += r * z
    l00 = np.sqrt(v00)
    l10, l20 = v10 / l00, v20 / l00
    l11 = np.sqrt(v11 - l10 * l10)
    l21 = (v21 - l20 * l10) / l11
    l22 = np.sqrt(v22 - l20 * l20 - l21 * l21)
    root[0, 0], root[1, 1], root[2, 2] = 1.0 / l00, 1.0 / l11, 1.0 / l22
    root[1, 0] = -l10 / (l00 * l11)
    root[2, 1] = -l21 / (l11 * l22)
    root[2, 0] = (l10 * l21 - l20 * l11) / (l00 * l11 * l22)
    slope[0] = root[0, 0] * g0
    slope[1] = root[1, 0] * g0 + root[1, 1] * g1
    slope[2] = root[2, 0] * g0 + root[2, 1] * g1 + root[2, 2] * g2
    return has_weight


@kernel
def compute_depth_residual(at: Linearization, i: int) -> float:
    """Return how much nearer to its viewer landmark i is than its viewer's surface."""
    observations, point = at.observations, at.points[i]
    u, parameters = observations.depth_direction[i], at.views.parameters[observations.first_viewer[i]]
    out: float = u[0] * point[0] + u[1] * point[1] + u[2] * point[2]
    for j in range(3):
        out -= observations.depth_basis[i, j] * parameters[DEPTH + j]
    return out


@kernel
def triangulate_rays(observations: SortedObservations, views: Views, prior: float, out: FloatArray) -> None:
    """Write the points nearest to their rays and, weakly, to the origin to out (m, 3).

    Rays are weighted by the inverse squared size of a pixel at the object.
    """
    ray, center, a = np.empty(3), np.empty(3), np.empty((3, 3))
    for i in range(out.shape[0]):
        for p in range(3):
            a[p], out[i, p] = 0.0, 0.0
            a[p, p] = prior
        for n in range(observations.start[i], observations.start[i + 1]):
            k, c = observations.frame[n], observations.camera[n]
            r, m, b = views.object_rotations[k], views.camera_from_object[k, c], views.translations[k, c]
            x, y = observations.image[n, 0], observations.image[n, 1]
            # M R rotates the object's axes into the camera's.
            for p in range(3):
                ray[p], center[p] = 0.0, 0.0
                for q in range(3):
                    direction = m[0, q] * x + m[1, q] * y + m[2, q]
                    ray[p] += r[q, p] * direction
                    center[p] -= r[q, p] * (m[0, q] * b[0] + m[1, q] * b[1] + m[2, q] * b[2])
            square = x * x + y * y + 1.0
            weight = views.focals[c] ** 2 / (b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
            along = (ray[0] * center[0] + ray[1] * center[1] + ray[2] * center[2]) / square
            for p in range(3):
                a[p, p] += weight
                out[i, p] += weight * (center[p] - along * ray[p])
                for q in range(3):
                    a[p, q] -= weight * ray[p] * ray[q] / square
        cholesky_solve(a, out[i])


@kernel
def compute_rotvecs(rotations: FloatArray, out: FloatArray) -> None:
    """Write the rotation vectors of rotation matrices (n, 3, 3) to out (n, 3)."""
    for k in range(rotations.shape[0]):
        so3_log(rotations[k], out[k])
