"""The ways to say where an object's frame is: each gives the transform to it, and how certain that is."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.absolute_pose.object_axes import by_extent, by_plane, by_points, drawn_sd, on_plane, plane_of
from sylpose.app.point_selection import Picked, Result, known_well, picked, result_of
from sylpose.geometry.arrays import FloatArray
from sylpose.tracking.known_object import KnownObject

__all__ = ["LARGEST", "Found", "Points", "extent_frame", "moved_frame", "one_of_draws", "plane_frame", "points_frame"]

LARGEST = "largest"
# Landmarks within this share of the object's radius from a picked point are on the plane that is meant (choice).
AROUND = 0.3


class Found(NamedTuple):
    """A frame that was found: the transform to it, its standard deviations (6,), and how."""

    new_from_object: RigidTransform
    sd: FloatArray
    said: str


class Points:
    """Points that are picked, each where it is asked for; the result that pixels are of is read when it is needed."""

    def __init__(self, known: KnownObject, source: Path, result: Path | None) -> None:
        self.known, self._source, self._path = known, source, result
        self._result: Result | None = None

    @property
    def result(self) -> Result:
        """Of a run that has seen it: the one that is said, or where its file lies."""
        if self._result is None:
            self._result = result_of(self._source.parent if self._path is None else self._path, self.known)
        return self._result

    def __call__(self, option: str, words: str) -> Picked:
        result = self.result if words.lstrip().startswith("@") else None
        with _named(option):
            return picked(words.strip(), self.known, result)


@contextmanager
def _named(option: str) -> Iterator[None]:
    """Within it a ValueError gets an option's name."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{option} {error}") from None


def points_frame(points: Points, *words: str) -> Found:
    """By an origin, a point on +X and one in the XY plane."""
    origin, x, xy = (points(option, word) for option, word in zip(("--origin", "--x", "--xy"), words, strict=True))

    def drawn(draw: Callable[[Picked], FloatArray]) -> RigidTransform:
        return by_points(draw(origin), draw(x), draw(xy))

    found = drawn(lambda p: p.place)
    return Found(found, drawn_sd(found, lambda rng: drawn(one_of_draws(rng))), "three points")


def one_of_draws(rng: np.random.Generator) -> Callable[[Picked], FloatArray]:
    """Where picked points may be as well, in one draw."""
    poses = dict[int, FloatArray]()
    return lambda point: point.drawn(rng, poses)


def plane_frame(points: Points, plane: Sequence[str], origin: str | None, x: str | None) -> Found:
    """By the largest plane, or that at picked points."""
    known = points.known
    on, said = known_well(known), "largest plane"
    if list(plane) != [LARGEST]:
        at = np.array([points("--plane", word).place for word in plane])
        far = np.linalg.norm(on[:, None] - at, axis=2).min(axis=1)
        on, said = on[far < AROUND * known.radius], f"plane at {len(at)} picked point{'s' if len(at) > 1 else ''}"
    rng, middle = np.random.default_rng(0), known.frame.from_learnt.translation
    with _named("--plane:"):
        normal, center, good = on_plane(on, known.radius, middle, rng)
    start = None if origin is None else points("--origin", origin)
    along = None if x is None else points("--x", x)
    on = on[good]

    def drawn(normal: FloatArray, center: FloatArray, draw: Callable[[Picked], FloatArray]) -> RigidTransform:
        return by_plane(normal, center, None if start is None else draw(start), None if along is None else draw(along))

    found = drawn(normal, center, lambda p: p.place)
    sd = drawn_sd(
        found,
        lambda rng: drawn(*plane_of(on[rng.integers(0, len(on), len(on))], normal), one_of_draws(rng)),
    )
    return Found(found, sd, f"{said}, {len(on)} landmarks")


def extent_frame(known: KnownObject) -> Found:
    """By the directions in which the landmarks extend."""
    on = known_well(known)
    with _named("--extent:"):
        found = by_extent(on)
    sd = drawn_sd(found, lambda rng: by_extent(on[rng.integers(0, len(on), len(on))]))
    return Found(found, sd, f"extent of {len(on)} landmarks")


def moved_frame(points: Points, origin: str | None, turn: str | None) -> Found:
    """Plainly moved and turned; as certain as the present frame is, and the picked origin."""
    at = Picked(np.zeros(3), np.zeros((3, 3))) if origin is None else points("--origin", origin)
    angles = np.zeros(3)
    if turn is not None:
        try:
            angles = np.array([float(cell) for cell in turn.split(",")])
        except ValueError:
            angles = np.empty(0)
        if angles.shape != (3,) or not np.isfinite(angles).all():
            raise ValueError(f"--turn: three angles in degrees, with commas between them, are expected, got {turn!r}")
    axes, sd = Rotation.from_euler("xyz", angles, degrees=True), points.known.frame.sd
    found = RigidTransform.from_components(at.place, axes).inv()

    def drawn(rng: np.random.Generator) -> RigidTransform:
        off = rng.normal(size=6) * sd
        there = RigidTransform.from_components(one_of_draws(rng)(at), axes).inv()
        return there * RigidTransform.from_components(off[3:], Rotation.from_rotvec(off[:3]))

    certain = at.certain and not sd.any()
    said = " and ".join(w for w, given in (("origin moved", origin), ("axes turned", turn)) if given)
    before = points.known.frame.said
    return Found(
        found, np.zeros(6) if certain else drawn_sd(found, drawn), f"{before}, {said}"[-200:] if before else said
    )
