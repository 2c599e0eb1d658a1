"""Rigid bodies as point sets: surfaces sampled uniformly by area, centered at the origin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import check_bool, check_finite, check_integer

# Maximum number of points of a body, and its longest and inverse shortest side (choice).
MAX_POINTS, MAX_SIDE_LENGTH = 10**7, 1e9


@dataclass(frozen=True, eq=False)
class Body:
    """Points of a rigid body, in the body's frame.

    Attributes:
        points: (n, 3).
        normals: (n, 3) outward unit normals: a point is visible from that side only; a point with a zero normal is
            visible from all sides.

    Raises:
        ValueError: shapes do not match, there are no points, or values are not finite.
    """

    points: FloatArray
    normals: FloatArray

    def __post_init__(self) -> None:
        points = np.array(check_finite(self.points, ("n", 3), "a body's points"))
        normals = np.array(check_finite(self.normals, (len(points), 3), "a body's normals"))
        if len(points) == 0:
            raise ValueError("a body needs at least one point")
        points.setflags(write=False)
        normals.setflags(write=False)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "normals", normals)

    @property
    def radius(self) -> float:
        """Largest distance of a point from the origin."""
        return float(np.linalg.norm(self.points, axis=1).max())


def ellipsoid(semi_axes: ArrayLike = (0.15, 0.15, 0.15), n: int = 4000, seed: int = 0) -> Body:
    """Sample `n` points on an ellipsoid with the given semi-axes (3,), uniformly by area."""
    rng, axes = _make_rng(n, seed), _check_lengths(semi_axes, 3, "semi_axes")
    on_sphere = _normalize(rng.standard_normal((8 * n, 3)))
    stretch = np.linalg.norm(on_sphere / axes, axis=1)  # surface per solid angle, up to a factor
    kept = rng.choice(len(on_sphere), n, replace=False, p=stretch / stretch.sum())
    return Body(on_sphere[kept] * axes, _normalize(on_sphere[kept] / axes))


def box(sides: ArrayLike = (0.3, 0.2, 0.25), n: int = 4000, seed: int = 0) -> Body:
    """Sample `n` points on the six faces of a box with the given sides (3,), uniformly by area."""
    rng, half = _make_rng(n, seed), _check_lengths(sides, 3, "sides") / 2
    areas = np.prod(half) / half
    axis = rng.choice(3, n, p=areas / areas.sum())
    sign = rng.choice([-1.0, 1.0], n)
    points = rng.uniform(-1, 1, (n, 3)) * half
    normals = np.zeros((n, 3))
    normals[np.arange(n), axis] = sign
    points[np.arange(n), axis] = sign * half[axis]
    return Body(points, normals)


def plane(sides: ArrayLike = (0.3, 0.3), n: int = 4000, seed: int = 0, *, two_sided: bool = True) -> Body:
    """Sample `n` points of a flat board in the x-y plane, of given width and height; if one-sided, visible from -z."""
    rng, half = _make_rng(n, seed), _check_lengths(sides, 2, "sides") / 2
    two_sided = check_bool(two_sided, "two_sided")
    points = np.column_stack([rng.uniform(-1, 1, (n, 2)) * half, np.zeros(n)])
    return Body(points, np.tile([0.0, 0.0, 0.0 if two_sided else -1.0], (n, 1)))


def cloud(semi_axes: ArrayLike = (0.15, 0.15, 0.15), n: int = 4000, seed: int = 0) -> Body:
    """Sample `n` points uniformly inside an ellipsoid with the given semi-axes (3,), visible from all sides."""
    rng, axes = _make_rng(n, seed), _check_lengths(semi_axes, 3, "semi_axes")
    inside = _normalize(rng.standard_normal((n, 3))) * np.cbrt(rng.uniform(0, 1, (n, 1)))
    return Body(inside * axes, np.zeros((n, 3)))


def _make_rng(n: int, seed: int) -> np.random.Generator:
    """Check the number of points and return the random generator."""
    check_integer(n, "n", minimum=1, maximum=MAX_POINTS)
    return np.random.default_rng(check_integer(seed, "seed"))


def _check_lengths(values: ArrayLike, n: int, name: str) -> FloatArray:
    out = check_finite(values, (n,), name, maximum=MAX_SIDE_LENGTH)
    if not (out >= 1 / MAX_SIDE_LENGTH).all():
        raise ValueError(f"{name} must be lengths from {1 / MAX_SIDE_LENGTH:g} to {MAX_SIDE_LENGTH:g}, got {out}")
    return out


def _normalize(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
