"""The start without boxes: what moves against the standing background is the object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sylpose.numerics.arrays import FloatArray
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.tracking.frame import Pair, Reference, inliers_of, still
from sylpose.two_frames.fit import Fit, no_fit
from sylpose.two_frames.solver import fit_terms
from sylpose.two_frames.terms import object_place

__all__ = ["displacement", "first_motion", "is_ambiguous"]


# Another motion with this share of the object's inliers might be the object as well.
RIVAL_SHARE = 0.5


def first_motion(
    rig: Rig, pairs: Sequence[Pair], first: Reference, rng: np.random.Generator
) -> tuple[Fit, FloatArray, list[Pair]]:
    """The motion since a frame in which nothing but the object is going to move, from what moves.

    Returns:
        the fit, the center (3,) that it is about, and its inliers.
    """
    moving = [pair.subset(~still(pair)) for pair in pairs if pair.reference is first]
    moving = [pair for pair in moving if len(pair)]
    data = [pair.term(rig, first) for pair in moving]
    if not data:
        return no_fit(data, Status.TOO_FEW_MATCHES), np.full(3, np.nan), []
    center, radius = object_place(data)
    fit = fit_terms(data, center, radius, [], rng)
    return fit, center, inliers_of(moving, fit.weights)


def displacement(pairs: Sequence[Pair]) -> float:
    """By how much matches are displaced, pixels, in the middle."""
    return float(np.median(np.concatenate([np.linalg.norm(p.pixels_i - p.pixels_j, axis=1) for p in pairs])))


def is_ambiguous(
    rig: Rig, pairs: Sequence[Pair], first: Reference, inliers: Sequence[Pair], rng: np.random.Generator
) -> bool:
    """Whether something else than the object moved as a rigid body too, and nearly as much of it was seen.

    Args:
        pairs: all matches since the first frame.
        inliers: those on what is taken for the object.
    """
    others = []
    for pair in pairs:
        taken = [p.indices[:, 0] for p in inliers if p.camera == pair.camera]
        others.append(pair.subset(~np.isin(pair.indices[:, 0], np.concatenate([np.empty(0, np.int64), *taken]))))
    fit, _, found = first_motion(rig, others, first, rng)
    return fit.status is Status.OK and sum(map(len, found)) > RIVAL_SHARE * sum(map(len, inliers))
