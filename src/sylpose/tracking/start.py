"""The start without boxes: what moves against the standing background is the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sylpose.numerics.arrays import FloatArray
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.tracking.crew import Crew
from sylpose.tracking.frame import Pair, inliers_of, still
from sylpose.tracking.frame_solvers import dealt, gathered
from sylpose.tracking.records import Moved
from sylpose.two_frames.fit import Fit, no_fit
from sylpose.two_frames.solver import fit_terms
from sylpose.two_frames.terms import object_place

__all__ = ["FirstMotion", "first_motion", "is_ambiguous"]

# Another motion with this share of the object's inliers might be the object as well (choice).
RIVAL_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class FirstMotion:
    """The motion since a frame in which nothing but the object is going to move.

    Attributes:
        fit: of what moves.
        center: (3,) that it is about.
        radius: of its inliers about the middle of them, `middle` (3,); NaN without any.
        count: number of inliers.
        shift_px: by how much they are displaced, in the middle; NaN without any.
        inliers: by camera, each its own.
    """

    fit: Fit
    center: FloatArray
    middle: FloatArray
    radius: float
    count: int
    shift_px: float
    inliers: Sequence[Sequence[Pair]]


def first_motion(
    crew: Crew, rig: Rig, pairs: Sequence[Sequence[Pair]], first: int, rng: np.random.Generator
) -> FirstMotion:
    """The motion since the frame with the number `first`, from what moves of the matches with it.

    Args:
        pairs: by camera, each its own.
    """

    def moving_of(c: int) -> list[Pair]:
        moving = [pair.subset(~still(pair)) for pair in pairs[c] if pair.reference == first]
        return [pair for pair in moving if len(pair)]

    moving = crew.each(moving_of)

    def moved(c: int) -> list[Moved]:
        return [
            Moved(pair.term(c, rig.cameras[c]), np.linalg.norm(pair.pixels_i - pair.pixels_j, axis=1))
            for pair in moving[c]
        ]

    records = crew.ask(moved)
    terms = [[record.term for record in of_camera] for of_camera in records]
    data, nowhere = gathered(terms), np.full(3, np.nan)
    if not data:
        fit = no_fit(data, Status.TOO_FEW_MATCHES)
        return FirstMotion(fit, nowhere, nowhere, np.nan, 0, np.nan, crew.each(lambda _: []))
    center, radius = object_place(data)
    fit = fit_terms(data, center, radius, [], rng)
    agreement = dealt(fit, terms)
    shifts = [record.shift_px for of_camera in records for record in of_camera]
    good = [(term.subset(w > 0), shift[w > 0]) for term, shift, w in zip(data, shifts, fit.weights, strict=True)]
    good = [(term, shift) for term, shift in good if len(term)]
    middle, size = object_place([term for term, _ in good]) if good else (nowhere, np.nan)
    displacement = np.concatenate([np.empty(0), *(shift for _, shift in good)])
    return FirstMotion(
        fit,
        center,
        middle,
        size,
        len(displacement),
        float(np.median(displacement)) if len(displacement) else np.nan,
        crew.each(lambda c: inliers_of(moving[c], [w for w, _ in agreement[c]])),
    )


def is_ambiguous(
    crew: Crew,
    rig: Rig,
    pairs: Sequence[Sequence[Pair]],
    first: int,
    found: FirstMotion,
    rng: np.random.Generator,
) -> bool:
    """Whether something else than the object moved as a rigid body too, and nearly as much of it was seen.

    Args:
        pairs: by camera, each its own: all matches since the frame with the number `first`.
        found: what is taken for the object's motion.
    """

    def others_of(c: int) -> list[Pair]:
        taken = np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 0] for pair in found.inliers[c])])
        return [pair.subset(~np.isin(pair.indices[:, 0], taken)) for pair in pairs[c]]

    other = first_motion(crew, rig, crew.each(others_of), first, rng)
    return other.fit.status is Status.OK and other.count > RIVAL_SHARE * found.count
