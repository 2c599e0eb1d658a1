"""The features of one camera's frame that were seen before: what is known of them, and which have moved with the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.tracking.frame import Pair, away, inliers_of

__all__ = ["KNOWN_DEPTH", "SeenAgain", "have_moved"]

# Landmarks whose depth is known to this share of the object's radius show where its surface is (choice).
KNOWN_DEPTH = 0.1
# A landmark has moved with the object where the pose leaves no more than this share of the way from where it was first seen
# unexplained (choice).
CLEARLY = 0.5


@dataclass(frozen=True, eq=False)
class SeenAgain:
    """The features of one camera's frame that were seen before.

    Attributes:
        inliers: the matches with earlier frames that say so.
        index: (k,) into the frame's features.
        known: (k) what is known of each, the best of the landmarks that it is matched with.
        surface: (m, 3) places of those that are known well enough to tell where the object's surface is.
    """

    inliers: Sequence[Pair]
    index: IntArray
    known: Landmarks
    surface: FloatArray

    @classmethod
    def none(cls) -> SeenAgain:
        """Nothing: all features are new."""
        return cls([], np.empty(0, np.int64), Landmarks.none(), np.empty((0, 3)))

    @classmethod
    def of(
        cls, pairs: Sequence[Pair], agreement: Sequence[tuple[FloatArray, FloatArray]], still_px: float, radius: float
    ) -> SeenAgain:
        """What a frame's matches say, of which some agree with its pose.

        A landmark has moved if any that its feature is matched with has, or does so now: it is where the pose says, and
        that is far from where it was first seen.

        Args:
            agreement: weights and residuals, pixels, (n,) of each pair.
            still_px: what is less far may stand still.
        """
        inliers = inliers_of(pairs, [w for w, _ in agreement])
        if not inliers:
            return cls.none()
        known = Landmarks.concatenate([pair.landmarks for pair in inliers])
        index, sd = np.concatenate([pair.indices[:, 1] for pair in inliers]), known.depth_sd
        # Of landmarks that are known alike, the oldest: rounding must not decide, which is another one elsewhere.
        order = np.lexsort((known.id, sd.astype(np.float32), index))
        _, first = np.unique(index[order], return_index=True)
        pick = order[first]
        moved = have_moved(inliers, known, agreement, still_px)
        ever = np.zeros(int(index.max()) + 1, bool)
        np.logical_or.at(ever, index, moved)
        # Where it was first seen is a matter of all that its feature is matched with: of the oldest.
        best = replace(known.subset(pick), moved=ever[index[pick]], origin=_oldest_origin(index, known)[index[pick]])
        return cls(inliers, index[pick], best, best.mean[sd[pick] < KNOWN_DEPTH * radius])


def have_moved(
    inliers: Sequence[Pair], known: Landmarks, agreement: Sequence[tuple[FloatArray, FloatArray]], still_px: float
) -> BoolArray:
    """(n,) which of the matches that agree with a frame's pose are known to be no background: whose landmark, `known` (n),
    has moved before, or does so now.

    Args: the rest as in `SeenAgain.of`.
    """
    residual = np.concatenate([np.empty(0), *(np.abs(r[w > 0]) for w, r in agreement)])
    far = away(known, np.concatenate([np.empty((0, 2)), *(pair.pixels_j for pair in inliers)]))
    return np.asarray(known.moved | ((far > still_px) & (residual < CLEARLY * far)))


def _oldest_origin(index: IntArray, known: Landmarks) -> FloatArray:
    """(m, 2) by feature, where the landmark with the lowest number was first seen that it (n,) is matched with."""
    origin = np.zeros((int(index.max()) + 1, 2))
    order = np.argsort(-known.id, kind="stable")
    origin[index[order]] = known.origin[order]
    return origin
