"""Relocalization of a lost object: matches keyframe landmarks anywhere in the images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.absolute_pose.pose import estimate_pose
from sylpose.features.sift import match_features
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.tracking.frame import CameraFrame, SolvedFrame
from sylpose.tracking.keyframes import find_nearest_views
from sylpose.tracking.reports import RelocalizationMatches

__all__ = [
    "DESCRIPTOR_RATIO",
    "LOOSE_DESCRIPTOR_RATIO",
    "estimate_relocalized_pose",
    "match_keyframes",
    "select_keyframes",
]

# Number of keyframes compared per camera: those nearest to its last viewpoint, and others from all sides in rotation
# (choice).
N_NEAREST_KEYFRAMES, N_OTHER_KEYFRAMES = 6, 6
# Largest depth standard deviation of a landmark, as a share of the object's radius (choice).
MAX_DEPTH_SD_RATIO = 0.3
# Minimum number of inliers: a body of the same outline in the same place, or an unknown side of the object, gives about
# twenty, the object itself hundreds (measured: tests/tracking/test_relocalization.py) (choice).
MIN_INLIERS = 24
MAX_ERROR_PX = 8.0
# Largest ratio of the descriptor distances to the best and the second-best match: as elsewhere, and where that failed.
# The robust pose solver tolerates half of the matches being wrong (measured: benchmarks/features.py) (choice).
DESCRIPTOR_RATIO, LOOSE_DESCRIPTOR_RATIO = 0.8, 0.9


def match_keyframes(
    keyframes: Sequence[CameraFrame], current: CameraFrame, radius: float, ratio: float = DESCRIPTOR_RATIO
) -> RelocalizationMatches:
    """Match a camera's features with the landmarks of its keyframes.

    Args:
        current: with the features of the whole image.
        radius: of the object.
        ratio: see `match_features`.
    """
    points, pixels = [np.empty((0, 3))], [np.empty((0, 2))]
    for keyframe in keyframes:
        features, landmarks = keyframe.features, keyframe.landmarks
        is_usable = (landmarks.depth_sd < MAX_DEPTH_SD_RATIO * radius) & ~keyframe.background
        index = match_features(features.subset(is_usable), current.features, ratio)
        points.append(landmarks.mean[is_usable][index[:, 0]])
        pixels.append(current.features.pixels[index[:, 1]])
    # A feature matched in several keyframes counts once.
    _, first = np.unique(np.round(np.concatenate(pixels), 1), axis=0, return_index=True)
    return RelocalizationMatches(np.concatenate(points)[first], np.concatenate(pixels)[first])


def estimate_relocalized_pose(rig: Rig, records: Sequence[RelocalizationMatches]) -> RigidTransform | None:
    """Estimate world_from_object from all cameras' matches; None with too few inliers."""
    points, pixels = [record.points for record in records], [record.pixels for record in records]
    pose = estimate_pose(rig, points, pixels, max_error_px=MAX_ERROR_PX)
    usable = (Status.OK, Status.NOT_CONVERGED) if len(rig) > 1 else (Status.OK, Status.SCALE_NOT_OBSERVABLE)
    if pose.status not in usable or pose.motion is None or pose.n_inliers.sum() < MIN_INLIERS:
        return None
    return pose.motion


def select_keyframes(
    keyframes: Sequence[SolvedFrame], camera: int, last: SolvedFrame, n_missed: int
) -> list[SolvedFrame]:
    """Select the keyframes to compare a camera's image with.

    Args:
        keyframes: in order of time.
        last: the last solved frame.
        n_missed: number of frames since the object was lost; each uses other keyframes.
    """
    nearest = find_nearest_views(keyframes, camera, last.viewpoints[camera], N_NEAREST_KEYFRAMES)
    tried = {k.number for k in nearest}
    others = [k for k in keyframes if k.is_visible[camera] and k.number not in tried]
    # Each frame uses other keyframes, so that all are covered after a few.
    stride = max(len(others) // N_OTHER_KEYFRAMES, 1)
    return nearest + others[n_missed % stride :: stride]
