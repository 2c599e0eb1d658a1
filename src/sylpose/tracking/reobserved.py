"""One camera's features with known landmarks, and which of these have moved with the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.tracking.frame import FrameMatches, measure_displacement, select_inliers

__all__ = ["SURFACE_DEPTH_SD_RATIO", "ReobservedFeatures", "find_moved"]

# Landmarks whose depth is known to this share of the object's radius describe its surface (choice).
SURFACE_DEPTH_SD_RATIO = 0.1
# A landmark has moved with the object if the pose leaves at most this share of its displacement since its first
# observation unexplained (choice).
MAX_UNEXPLAINED_RATIO = 0.5


@dataclass(frozen=True, eq=False)
class ReobservedFeatures:
    """Features of one camera's frame that were observed before.

    Attributes:
        inliers: their matches with earlier frames.
        index: (k,) into the frame's features.
        landmarks: (k) the most certain landmark that each is matched with.
        surface_points: (m, 3) positions of landmarks certain enough to describe the surface.
    """

    inliers: Sequence[FrameMatches]
    index: IntArray
    landmarks: Landmarks
    surface_points: FloatArray

    @classmethod
    def empty(cls) -> ReobservedFeatures:
        """Return an empty set: all features are new."""
        return cls([], np.empty(0, np.int64), Landmarks.empty(), np.empty((0, 3)))

    @classmethod
    def from_matches(
        cls,
        pairs: Sequence[FrameMatches],
        match_weights: Sequence[tuple[FloatArray, FloatArray]],
        static_px: float,
        radius: float,
    ) -> ReobservedFeatures:
        """Build from a frame's matches that agree with its pose.

        A landmark has moved if any landmark matched with its feature has, or if it moves now: it agrees with the pose,
        far from where it was first observed.

        Args:
            match_weights: weights and residuals, pixels, (n,) per pair.
            static_px: smaller displacements may be static.
            radius: of the object.
        """
        inliers = select_inliers(pairs, [w for w, _ in match_weights])
        if not inliers:
            return cls.empty()
        landmarks = Landmarks.concatenate([pair.landmarks for pair in inliers])
        index, sd = np.concatenate([pair.indices[:, 1] for pair in inliers]), landmarks.depth_sd
        # Of equally certain landmarks the oldest is used: rounding, which differs between machines, must not decide.
        order = np.lexsort((landmarks.id, sd.astype(np.float32), index))
        _, first = np.unique(index[order], return_index=True)
        pick = order[first]
        has_moved = find_moved(inliers, landmarks, match_weights, static_px)
        has_feature_moved = np.zeros(int(index.max()) + 1, bool)
        np.logical_or.at(has_feature_moved, index, has_moved)
        # The origin is that of the oldest landmark matched with the feature.
        best = replace(
            landmarks.subset(pick),
            has_moved=has_feature_moved[index[pick]],
            origin=_find_oldest_origins(index, landmarks)[index[pick]],
        )
        return cls(inliers, index[pick], best, best.mean[sd[pick] < SURFACE_DEPTH_SD_RATIO * radius])


def find_moved(
    inliers: Sequence[FrameMatches],
    landmarks: Landmarks,
    match_weights: Sequence[tuple[FloatArray, FloatArray]],
    static_px: float,
) -> BoolArray:
    """Return which inlier matches (n,) are known not to be background.

    Their landmark, `landmarks` (n), has moved before or moves now.

    Args:
        match_weights, static_px: as in `ReobservedFeatures.from_matches`.
    """
    residual = np.concatenate([np.empty(0), *(np.abs(r[w > 0]) for w, r in match_weights)])
    displacement = measure_displacement(
        landmarks, np.concatenate([np.empty((0, 2)), *(pair.pixels_j for pair in inliers)])
    )
    return np.asarray(
        landmarks.has_moved | ((displacement > static_px) & (residual < MAX_UNEXPLAINED_RATIO * displacement))
    )


def _find_oldest_origins(index: IntArray, landmarks: Landmarks) -> FloatArray:
    """Return for each feature (m, 2) the origin of its oldest matched landmark.

    Args:
        index: (n,) feature of each landmark in `landmarks`.
    """
    origin = np.zeros((int(index.max()) + 1, 2))
    order = np.argsort(-landmarks.id, kind="stable")
    origin[index[order]] = landmarks.origin[order]
    return origin
