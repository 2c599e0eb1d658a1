"""In boxes, until the object has moved: whether it is the object that moves, or something else in them.

A box holds more than the object. Somebody who passes by behind it is seen at the box's edges, around the object; a wall is
seen there, too. The object is at the middle: what the middle does is what it does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sylpose.features.sift import Features
from sylpose.geometry.arrays import BoolArray
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.tracking.context import Region, Team
from sylpose.tracking.frame import CameraFrame, Frame, Pair, away
from sylpose.tracking.joint_state import MIN_MOVED, Joint
from sylpose.tracking.reports import Middle

__all__ = ["in_the_middle", "middle_stands", "still_ones"]

# The middle of a box is this share of its width and height (choice).
MIDDLE = 0.5
# It stands where it stands still by itself, and is displaced by less than this share of what moves, both medians (choice:
# a body that turns about itself moves its middle by some third).
STANDS = 0.15


def middle_stands(team: Team, joint: Joint, frame: Frame, pairs: Sequence[Sequence[Pair]]) -> bool:
    """Whether something moves in the boxes, and what is at their middle does not, in most cameras that see it.

    Args:
        pairs: by camera, each its own: the frame's matches.
    """
    first = joint.keyframes[0].world_from_object
    points = first.apply(joint.object.points)

    def of(c: int) -> Middle:
        outline = team.rig.cameras[c].project(points)
        outline = outline[np.isfinite(outline).all(axis=1)]
        if not len(outline) or not pairs[c]:
            return Middle.none()
        low, high = outline.min(axis=0), outline.max(axis=0)
        known = Landmarks.concatenate([pair.landmarks for pair in pairs[c]])
        shift = away(known, np.concatenate([pair.pixels_j for pair in pairs[c]]))
        off = np.abs(known.origin - 0.5 * (low + high)) / np.maximum(0.5 * (high - low), 1e-9)
        middle, moved = (off < MIDDLE).all(axis=1), shift > frame.cameras[c].still_px
        feature = np.concatenate([pair.indices[:, 1] for pair in pairs[c]])
        counts = [len(np.unique(feature[some])) for some in (middle, moved)]
        pixels = [float(np.median(shift[some])) if some.any() else np.nan for some in (middle, moved)]
        return Middle(counts[0], pixels[0], pixels[0] <= frame.cameras[c].still_px, counts[1], pixels[1])

    told = team.crew.ask(of, Middle.none())
    moving = [middle.moved_px for middle in told if middle.moved >= MIN_MOVED]
    seeing = [middle for middle in told if middle.seen >= MIN_MOVED]
    least = STANDS * float(np.median(moving)) if moving else 0.0
    return 2 * sum(middle.still and middle.middle_px < least for middle in seeing) > len(seeing)


def in_the_middle(team: Team, c: int, features: Features, region: Region) -> int:
    """How many of a camera's features are in the middle of the object's region."""
    if region is None:
        return 0
    middle = region.mean(axis=0)
    return int(team.parts[c].inside(features, middle + MIDDLE * (region - middle)).sum())


def still_ones(team: Team, frame: Frame, pairs: Sequence[Sequence[Pair]]) -> list[list[Pair]]:
    """By camera, each its own: the matches of what is where it was seen first."""

    def of(c: int) -> list[Pair]:
        kept = [pair.subset(_stands(pair, frame.cameras[c])) for pair in pairs[c]]
        return [pair for pair in kept if len(pair)]

    return team.crew.each(of)


def _stands(pair: Pair, current: CameraFrame) -> BoolArray:
    return np.asarray(away(pair.landmarks, pair.pixels_j) <= current.still_px)
