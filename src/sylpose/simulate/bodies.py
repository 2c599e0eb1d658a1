"""Bodies whose points move: closed surfaces sampled evenly, centred at the origin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import finite, truth, whole

# Points of a body, and its longest and inverse shortest side: more is no body (choice).
MOST_POINTS, LONGEST = 10**7, 1e9

__all__ = ["Body", "box", "cloud", "ellipsoid", "plane"]


@dataclass(frozen=True, eq=False)
class Body:
    """Points of a rigid body, in its own frame.

    Attributes:
        points: (n, 3).
        normals: (n, 3) outward unit normals: a camera sees a point only from that side; a zero normal is seen from
            everywhere.

    Raises:
        ValueError: shapes that do not fit, no points, or values that are not finite.
    """

    points: FloatArray
    normals: FloatArray

    def __post_init__(self) -> None:
        points = np.array(finite(self.points, ("n", 3), "a body's points"))
        normals = np.array(finite(self.normals, (len(points), 3), "a body's normals"))
        if len(points) == 0:
            raise ValueError("a body needs points, at least one")
        points.setflags(write=False)
        normals.setflags(write=False)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "normals", normals)

    @property
    def radius(self) -> float:
        """Largest distance of a point from the origin."""
        return float(np.linalg.norm(self.points, axis=1).max())


def ellipsoid(semi_axes: ArrayLike = (0.15, 0.15, 0.15), n: int = 4000, seed: int = 0) -> Body:
    """`n` points on an ellipsoid with the given semi-axes (3,), evenly by area."""
    rng, axes = _seeded(n, seed), _lengths(semi_axes, 3, "semi_axes")
    on_sphere = _unit(rng.standard_normal((8 * n, 3)))
    stretch = np.linalg.norm(on_sphere / axes, axis=1)  # surface per solid angle, up to a factor
    kept = rng.choice(len(on_sphere), n, replace=False, p=stretch / stretch.sum())
    return Body(on_sphere[kept] * axes, _unit(on_sphere[kept] / axes))


def box(sides: ArrayLike = (0.3, 0.2, 0.25), n: int = 4000, seed: int = 0) -> Body:
    """`n` points on the six faces of a box with the given sides (3,), evenly by area."""
    rng, half = _seeded(n, seed), _lengths(sides, 3, "sides") / 2
    areas = np.prod(half) / half
    axis = rng.choice(3, n, p=areas / areas.sum())
    sign = rng.choice([-1.0, 1.0], n)
    points = rng.uniform(-1, 1, (n, 3)) * half
    normals = np.zeros((n, 3))
    normals[np.arange(n), axis] = sign
    points[np.arange(n), axis] = sign * half[axis]
    return Body(points, normals)


def plane(sides: ArrayLike = (0.3, 0.3), n: int = 4000, seed: int = 0, *, two_sided: bool = True) -> Body:
    """`n` points of a flat board with the given width and height, in the x-y plane; one-sided, it is seen from -z."""
    rng, half = _seeded(n, seed), _lengths(sides, 2, "sides") / 2
    two_sided = truth(two_sided, "two_sided")
    points = np.column_stack([rng.uniform(-1, 1, (n, 2)) * half, np.zeros(n)])
    return Body(points, np.tile([0.0, 0.0, 0.0 if two_sided else -1.0], (n, 1)))


def cloud(semi_axes: ArrayLike = (0.15, 0.15, 0.15), n: int = 4000, seed: int = 0) -> Body:
    """`n` points evenly inside an ellipsoid with the given semi-axes (3,), each visible from everywhere."""
    rng, axes = _seeded(n, seed), _lengths(semi_axes, 3, "semi_axes")
    inside = _unit(rng.standard_normal((n, 3))) * np.cbrt(rng.uniform(0, 1, (n, 1)))
    return Body(inside * axes, np.zeros((n, 3)))


def _seeded(n: int, seed: int) -> np.random.Generator:
    """Once the number of points makes sense."""
    whole(n, "n", least=1, most=MOST_POINTS)
    return np.random.default_rng(whole(seed, "seed"))


def _lengths(values: ArrayLike, n: int, name: str) -> FloatArray:
    out = finite(values, (n,), name, most=LONGEST)
    if not (out >= 1 / LONGEST).all():
        raise ValueError(f"{name} must be lengths from {1 / LONGEST:g} to {LONGEST:g}, got {out}")
    return out


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
