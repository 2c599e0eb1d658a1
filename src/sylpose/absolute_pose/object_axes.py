"""Axes of an object from points on it: three points, a plane through many, or the principal directions.

All functions return `new_from_old`, the transform of points from their present frame to the new one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.robust_loss import biquartic_losses, biquartic_weights, robust_sigma

# Minimum number of points of a plane or of principal directions (choice).
MIN_POINTS = 12
# Distance from a plane of its points, as a fraction of the object's radius (choice: surfaces have some relief), and
# number of planes sampled through three points (derived: a plane with a third of the points is missed less than once in
# 50,000 times).
MAX_RELIEF, N_SAMPLES = 0.03, 300
# Lower limit of the scatter of a plane's points, as a fraction of the radius (choice), and cutoff of their weights in
# standard deviations.
MIN_SIGMA_RATIO, CUTOFF = 0.002, 5.0
N_ITERATIONS = 10
# Sine of the angle below which directions are too close to define axes (choice).
MIN_SINE = 0.02
# Minimum extent of a plane in both directions relative to the scatter of its points (choice).
MIN_EXTENT_RATIO = 4.0
# Points farther than so many robust standard deviations from the center are outliers (choice).
MAX_DISTANCE_SIGMAS = 5.0
# Random draws for the uncertainty of a frame: its standard deviations to a tenth or so (derived).
N_DRAWS = 60


def axes_from_points(origin: FloatArray, x: FloatArray, xy: FloatArray) -> RigidTransform:
    """Return axes from the origin, a point on the +X axis, and one in the XY plane at positive y.

    Raises:
        ValueError: points that coincide or are on a line.
    """
    x_axis, other = _unit_vector(x - origin, "the origin and the point on +X"), xy - origin
    perpendicular = other - (other @ x_axis) * x_axis
    if not np.linalg.norm(perpendicular) > MIN_SINE * max(float(np.linalg.norm(other)), 1e-300):
        raise ValueError("the three points lie on a line, which does not define a plane")
    return _make_axes(origin, x_axis, np.cross(x_axis, perpendicular))


def axes_from_plane(
    normal: FloatArray, centroid: FloatArray, origin: FloatArray | None = None, x: FloatArray | None = None
) -> RigidTransform:
    """Return axes with Z along a plane's normal.

    The origin is a point projected to the plane. X points to another point; without one it is the old X projected to
    the plane, or else the old Y.

    Args:
        normal, centroid: (3,) of the plane, from `fit_plane`.
        origin: (3,) projected to the plane; None: its middle.
        x: (3,) a point.

    Raises:
        ValueError: points that coincide or are above each other.
    """
    start = centroid if origin is None else origin - ((origin - centroid) @ normal) * normal
    default_axis = np.eye(3)[0 if abs(normal[0]) < 0.9 else 1]
    direction = default_axis if x is None else x - start
    in_plane = direction - (direction @ normal) * normal
    if not np.linalg.norm(in_plane) > MIN_SINE * max(float(np.linalg.norm(direction)), 1e-300):
        raise ValueError("the point on +X lies above the origin, which gives no direction in the plane")
    return _make_axes(start, _unit_vector(in_plane, "the origin and the point on +X"), normal)


def fit_plane(
    points: FloatArray, radius: float, interior_point: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Fit the plane with the most points.

    Args:
        points: (n, 3).
        radius: of the object.
        interior_point: (3,) the object's center, which the normal points away from.
        rng: of the samples.

    Returns:
        normal (3,); centroid (3,) of its points; (n,) mask of these.

    Raises:
        ValueError: too few points, or no plane.
    """
    if len(points) < MIN_POINTS:
        raise ValueError(f"{len(points)} landmarks are too few for a plane, at least {MIN_POINTS} are needed")
    best, normal, centroid = np.inf, np.zeros(3), np.zeros(3)
    for k in rng.integers(0, len(points), (N_SAMPLES, 3)):
        a, b, c = points[k]
        across = np.cross(b - a, c - a)
        size = float(np.linalg.norm(across))
        if size <= (MAX_RELIEF * radius) ** 2:
            continue
        cost = float(biquartic_losses((((points - a) @ across) / size / (MAX_RELIEF * radius)) ** 2).sum())
        if cost < best:
            best, normal, centroid = cost, across / size, a
    if best == np.inf:
        raise ValueError("the landmarks lie on a line, which does not define a plane")
    max_sigma = MAX_RELIEF * radius / 2.0
    sigma = MAX_RELIEF * radius / CUTOFF
    for _ in range(N_ITERATIONS):
        distances = (points - centroid) @ normal
        weights = biquartic_weights((distances / (CUTOFF * sigma)) ** 2)
        normal, centroid, extent = _fit_weighted_plane(points, weights)
        sigma = min(max(robust_sigma(distances[weights > 0], 0.0), MIN_SIGMA_RATIO * radius), max_sigma)
    is_inlier = np.abs((points - centroid) @ normal) < CUTOFF * sigma
    if is_inlier.sum() < MIN_POINTS or not extent > MIN_EXTENT_RATIO * sigma:
        raise ValueError(
            f"only {int(is_inlier.sum())} of {len(points)} landmarks lie on a plane, and not spread over it"
        )
    return (normal if normal @ (centroid - interior_point) > 0 else -normal), centroid, is_inlier


def fit_plane_to_points(points: FloatArray, reference_normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the normal (3,), on the side of `reference_normal`, and centroid (3,) of coplanar points (n, 3)."""
    normal, centroid, _ = _fit_weighted_plane(points, np.ones(len(points)))
    return (normal if normal @ reference_normal > 0 else -normal), centroid


def axes_from_extent(points: FloatArray) -> RigidTransform:
    """Return axes with the origin at the points' centroid, X along the largest extent, Z along the smallest, Y = Z x X.

    The largest components of X and of Z in the old frame are positive. Points far from the others are ignored.

    Raises:
        ValueError: too few points.
    """
    if len(points) < MIN_POINTS:
        raise ValueError(
            f"{len(points)} landmarks are too few for principal directions, at least {MIN_POINTS} are needed"
        )
    is_inlier = np.ones(len(points), bool)
    for _ in range(N_ITERATIONS):
        centroid = points[is_inlier].mean(axis=0)
        _, vectors = np.linalg.eigh(np.cov(points[is_inlier].T))
        coordinates = (points - centroid) @ vectors
        is_inlier = (
            np.abs(coordinates) < MAX_DISTANCE_SIGMAS * np.array([robust_sigma(a, 1e-300) for a in coordinates.T])
        ).all(axis=1)
    x, z = (v * np.sign(v[np.argmax(np.abs(v))]) for v in (vectors[:, 2], vectors[:, 0]))
    return _make_axes(centroid, x, z)


def estimate_axes_sd(estimate: RigidTransform, draw: Callable[[np.random.Generator], RigidTransform]) -> FloatArray:
    """Return (6,) standard deviations of axes, radians about them and lengths along them, from random draws.

    A draw that fails counts as a rotation of 180 degrees.
    """
    rng, errors = np.random.default_rng(0), []
    for _ in range(N_DRAWS):
        try:
            difference = draw(rng) * estimate.inv()
        except ValueError:
            errors.append(np.repeat([np.pi, 0.0], 3))
            continue
        errors.append(np.concatenate([difference.rotation.as_rotvec(), difference.translation]))
    return np.asarray(np.sqrt(np.mean(np.square(errors), axis=0)))


def _fit_weighted_plane(points: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return the direction of least extent of weighted points, their centroid, and the second smallest extent."""
    total = max(float(weights.sum()), 1e-300)
    centroid = weights @ points / total
    offsets = points - centroid
    values, vectors = np.linalg.eigh((offsets * weights[:, None]).T @ offsets / total)
    return vectors[:, 0], centroid, float(np.sqrt(max(values[1], 0.0)))


def _unit_vector(vector: FloatArray, description: str) -> FloatArray:
    length = float(np.linalg.norm(vector))
    if not length > 0.0:
        raise ValueError(f"{description} are the same")
    return np.asarray(vector / length)


def _make_axes(origin: FloatArray, x: FloatArray, z: FloatArray) -> RigidTransform:
    """Return new_from_old of axes with this origin, X and Z (perpendicular, of any length)."""
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    axes = Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z]))
    return RigidTransform.from_components(origin, axes).inv()
