"""Axes of an object by points on it: three points, a plane through many, or the directions in which they extend.

All of them return `new_from_old`: the transform that tells points of the frame that they are given in in the new one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.robust_loss import biquartic_losses, biquartic_weights, robust_sigma

__all__ = ["FEWEST", "by_extent", "by_plane", "by_points", "drawn_sd", "on_plane"]

# Points that a plane, or an extent, is told by at least (choice).
FEWEST = 12
# A plane is where most points are within this share of the object's radius (choice: surfaces have some relief), of so many
# that go through three of them (derived: a plane with a third of the points is missed less than once in 50,000 times).
RELIEF, DRAWN = 0.03, 300
# A plane's own points scatter by no less than this share of the radius (choice), and weigh nothing beyond so many standard
# deviations.
SMOOTH, CUTOFF = 0.002, 5.0
ROUNDS = 10
# Directions that are told apart by less than this sine, radians, tell no axes (choice).
ALONG = 0.02
# A plane has to extend by so many times what its points scatter by, in both directions (choice).
FLAT = 4.0
# Points further than so many robust standard deviations from the middle are not the object's (choice).
FAR = 5.0
# Draws that tell how uncertain a frame is: its standard deviations to a tenth or so (derived).
DRAWS = 60


def by_points(origin: FloatArray, x: FloatArray, xy: FloatArray) -> RigidTransform:
    """Origin at the first point, the second on the +X axis, the third in the XY plane where y is positive; Z = X x Y.

    Raises:
        ValueError: points that are one, or on a line.
    """
    along, other = _unit(x - origin, "the origin and the point on +X"), xy - origin
    off = other - (other @ along) * along
    if not np.linalg.norm(off) > ALONG * max(float(np.linalg.norm(other)), 1e-300):
        raise ValueError("the three points lie on a line, which tells no plane")
    return _frame(origin, along, np.cross(along, off))


def by_plane(
    normal: FloatArray, middle: FloatArray, origin: FloatArray | None = None, x: FloatArray | None = None
) -> RigidTransform:
    """Z is the plane's normal; the origin a point of it, X leads to another or, without one, is what the old X leaves in the
    plane, or else the old Y.

    Args:
        normal, middle: (3,) of the plane, as `on_plane` has them.
        origin: (3,) that is put into the plane; None: its middle.
        x: (3,) a point.

    Raises:
        ValueError: points that are one above the other.
    """
    start = middle if origin is None else origin - ((origin - middle) @ normal) * normal
    usual = np.eye(3)[0 if abs(normal[0]) < 0.9 else 1]
    along = usual if x is None else x - start
    inside = along - (along @ normal) * normal
    if not np.linalg.norm(inside) > ALONG * max(float(np.linalg.norm(along)), 1e-300):
        raise ValueError("the point on +X lies above the origin, which tells no direction in the plane")
    return _frame(start, _unit(inside, "the origin and the point on +X"), normal)


def on_plane(
    points: FloatArray, radius: float, outwards: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """The plane on which most of the points are.

    Args:
        points: (n, 3); radius: of the object.
        outwards: (3,) a point on the side that the normal leads away from: the object's middle.

    Returns:
        normal (3,); middle (3,) of its points; (n,) which these are.

    Raises:
        ValueError: too few points, or on no plane.
    """
    if len(points) < FEWEST:
        raise ValueError(f"{len(points)} landmarks are too few for a plane, at least {FEWEST} are needed")
    best, normal, middle = np.inf, np.zeros(3), np.zeros(3)
    for k in rng.integers(0, len(points), (DRAWN, 3)):
        a, b, c = points[k]
        across = np.cross(b - a, c - a)
        size = float(np.linalg.norm(across))
        if size <= (RELIEF * radius) ** 2:
            continue
        cost = float(biquartic_losses((((points - a) @ across) / size / (RELIEF * radius)) ** 2).sum())
        if cost < best:
            best, normal, middle = cost, across / size, a
    if best == np.inf:
        raise ValueError("the landmarks lie on a line, which tells no plane")
    most = RELIEF * radius / 2.0
    sigma = RELIEF * radius / CUTOFF
    for _ in range(ROUNDS):
        off = (points - middle) @ normal
        weights = biquartic_weights((off / (CUTOFF * sigma)) ** 2)
        normal, middle, flat = _least(points, weights)
        sigma = min(max(robust_sigma(off[weights > 0], 0.0), SMOOTH * radius), most)
    good = np.abs((points - middle) @ normal) < CUTOFF * sigma
    if good.sum() < FEWEST or not flat > FLAT * sigma:
        raise ValueError(f"only {int(good.sum())} of {len(points)} landmarks lie on a plane, and not spread over it")
    return (normal if normal @ (middle - outwards) > 0 else -normal), middle, good


def plane_of(points: FloatArray, like: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normal (3,), on the same side as another one, and middle (3,) of points (n, 3) that are on a plane."""
    normal, middle, _ = _least(points, np.ones(len(points)))
    return (normal if normal @ like > 0 else -normal), middle


def by_extent(points: FloatArray) -> RigidTransform:
    """Origin at the points' middle, X along the direction in which they extend most, Z in which they do least, Y = Z x X; of
    X and of Z the component that is largest, in the old frame, is positive.

    Points far away from the others do not count.

    Raises:
        ValueError: too few points.
    """
    if len(points) < FEWEST:
        raise ValueError(f"{len(points)} landmarks are too few to tell in which directions it extends ({FEWEST})")
    good = np.ones(len(points), bool)
    for _ in range(ROUNDS):
        middle = points[good].mean(axis=0)
        _, vectors = np.linalg.eigh(np.cov(points[good].T))
        along = (points - middle) @ vectors
        good = (np.abs(along) < FAR * np.array([robust_sigma(a, 1e-300) for a in along.T])).all(axis=1)
    x, z = (v * np.sign(v[np.argmax(np.abs(v))]) for v in (vectors[:, 2], vectors[:, 0]))
    return _frame(middle, x, z)


def drawn_sd(found: RigidTransform, draw: Callable[[np.random.Generator], RigidTransform], seed: int = 0) -> FloatArray:
    """(6,) standard deviations of a frame: radians about its axes, lengths along them, by draws of what it is told by; a
    draw that tells none counts as a half turn."""
    rng, off = np.random.default_rng(seed), []
    for _ in range(DRAWS):
        try:
            between = draw(rng) * found.inv()
        except ValueError:
            off.append(np.repeat([np.pi, 0.0], 3))
            continue
        off.append(np.concatenate([between.rotation.as_rotvec(), between.translation]))
    return np.asarray(np.sqrt(np.mean(np.square(off), axis=0)))


def _least(points: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Of weighted points, the direction in which they extend least, their middle, and by how much they extend in the
    second one."""
    total = max(float(weights.sum()), 1e-300)
    middle = weights @ points / total
    off = points - middle
    values, vectors = np.linalg.eigh((off * weights[:, None]).T @ off / total)
    return vectors[:, 0], middle, float(np.sqrt(max(values[1], 0.0)))


def _unit(vector: FloatArray, between: str) -> FloatArray:
    length = float(np.linalg.norm(vector))
    if not length > 0.0:
        raise ValueError(f"{between} are the same")
    return np.asarray(vector / length)


def _frame(origin: FloatArray, x: FloatArray, z: FloatArray) -> RigidTransform:
    """new_from_old of a frame with this origin, X and Z axes (of any length, square to each other)."""
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    axes = Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z]))
    return RigidTransform.from_components(origin, axes).inv()
