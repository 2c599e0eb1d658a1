"""Whether what a camera tells can be true: what is well formed may still mean nothing, and must not harm those that hear it.

Of a lie that could be true nothing is known here: the cameras' doubt in each other is for that.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import symmetric_of
from sylpose.landmarks.alignment import Sights
from sylpose.landmarks.messages import DIAGONAL, Judges, Says
from sylpose.relative_pose.terms import TermData
from sylpose.tracking.reports import Ages, Agreed, Chance, Following, Known, Middle, Moved, Recognised, Seen, Sighted

__all__ = ["objection"]

# A hessian is that of a sum of squares if it is positive semi-definite up to this share of its diagonal (derived: rounding,
# of 24 bits in the compact mode, after a surface was eliminated).
ROUNDING = 1e-5
# Nothing that is counted, or measured in pixels, is more (choice).
MOST = 1e7
# About a turn, matches say no more than so much each (choice: 1e10 where the object is in its place, but a start that goes
# astray may lead it close to a camera).
MOST_EACH = 1e20
# No length is more, in any unit (choice).
FARTHEST = 1e9
# Normalised coordinates of what is 89.4 degrees off the axis (derived).
WIDEST = 100.0
# Records of counts, of sums and of lengths in pixels: nothing in them is negative.
COUNTS = (Following, Moved, Middle, Ages, Chance, Known, Agreed, Seen, Sighted, Judges)
# But for places and images; what is NaN where nothing is known of it (derived).
SIGNED = {"term", "sights", "ages", "image", "place"}
UNKNOWN = {"jitter_px", "middle_px", "moved_px", "depth_sd", "residual_px", "noise_px"}


def objection(told: object, camera: int) -> str | None:
    """Why it cannot be what a camera tells; None where it can."""
    parts = told if isinstance(told, (tuple, list)) else [told]
    says = [one for one in parts if isinstance(one, Says)]
    if says and not _are_informations(np.array([one.upper for one in says])):
        return "what it says of the pose is no information"
    if not all(map(_says_enough, says)) or not all(_is_sound(one, camera) for one in parts):
        return "what it says of its matches is of none"
    return None


def _is_sound(one: object, camera: int) -> bool:
    if isinstance(one, COUNTS):
        named = [(field.name, getattr(one, field.name)) for field in fields(one)]
        if not all(_is_count(value, name in UNKNOWN) for name, value in named if name not in SIGNED):
            return False
    match one:
        case Moved():
            return _is_sound(one.term, camera)
        case Known():
            return _is_sound(one.sights, camera)
        case Agreed():
            return (
                _is_sound(one.ages, camera)
                and len(one.references) == len(one.weights)
                and one.strong <= one.features <= one.tried_features
            )
        case Ages():
            return bool(one.counts.sum() < MOST)
        case Judges():
            return one.inliers <= one.matches
        case Seen() | Sighted():
            return _are_points(one.image, WIDEST) and _are_points(one.place)
        case TermData():
            points = _are_points(one.x, WIDEST) and _are_points(one.y, WIDEST)
            return points and one.camera == camera and 0.0 < one.focal < MOST and _is_view(one.rotation, one.center)
        case Sights():
            return all(map(_are_points, (one.points, one.image, one.trust))) and _is_view(one.rotation, one.center)
        case Recognised():
            return _are_points(one.points) and _are_points(one.pixels)
        case np.ndarray():
            return _are_points(one)
        case bool() | int() | float():
            return not abs(one) > MOST
    return True


def _says_enough(says: Says) -> bool:
    """Whether so many matches can say so much."""
    noise = np.isnan(says.level_px) or 0.0 < says.level_px < MOST
    return bool(noise and 0.0 <= says.mass < MOST and says.upper[DIAGONAL[:3]].sum() <= MOST_EACH * says.mass)


def _is_count(value: object, unknown: bool) -> bool:
    """Whether numbers are such as count or measure something.

    Args:
        unknown: whether they may be NaN.
    """
    numbers = np.asarray(value, float)
    return bool(((numbers >= 0) & (numbers <= MOST) | (np.isnan(numbers) & unknown)).all())


def _are_points(points: FloatArray, most: float = FARTHEST) -> bool:
    return bool(np.isfinite(points).all() and (np.abs(points) < most).all())


def _is_view(rotation: FloatArray, center: FloatArray) -> bool:
    """Whether a camera can stand like that."""
    return _are_points(center) and bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < ROUNDING)


def _are_informations(upper: FloatArray) -> bool:
    """Whether all (n, 27) have a positive semi-definite hessian, and a gradient with it."""
    if not np.isfinite(upper).all():
        return False
    hessian = np.array([symmetric_of(one) for one in upper[:, :21]])
    size = np.einsum("nii->ni", hessian)
    if (size < 0.0).any():
        return False
    unit = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
    hessian = hessian * unit[:, :, None] * unit[:, None, :] + ROUNDING * np.eye(6)
    try:
        np.linalg.cholesky(hessian)
    except np.linalg.LinAlgError:
        return False
    return True
