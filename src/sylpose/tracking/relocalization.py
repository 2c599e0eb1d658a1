"""Finding an object again after it was lost: its landmarks, as the keyframes saw them, anywhere in the images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.absolute_pose.pose import estimate_pose
from sylpose.features.sift import match_features
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.tracking.frame import CameraFrame, SolvedFrame
from sylpose.tracking.keyframes import nearest_views
from sylpose.tracking.reports import Recognised

__all__ = ["LOOSE_RATIO", "RATIO", "pose_of", "recognised", "to_try"]

# Keyframes that each camera's image is compared with: those seen from nearest to where it looked from last, then others
# from all sides, in turn (choice).
NEAREST, OTHERS = 6, 6
# Landmarks whose depth is known to this share of the object's radius (choice).
KNOWN_DEPTH = 0.3
# Fewer matches that agree are not believed: a body of the same outline in the same place, or the object's unknown side,
# makes about twenty; the object itself hundreds (measured: tests/tracking/test_relocalization.py) (choice).
MIN_INLIERS = 24
MAX_ERROR_PX = 8.0
# Largest ratio of descriptors' distances to the best and the second best: as for other matches, and where that has found
# nothing. The pose is searched among them, and half of them may be wrong (measured: benchmarks/features.py) (choice).
RATIO, LOOSE_RATIO = 0.8, 0.9


def recognised(
    keyframes: Sequence[CameraFrame], current: CameraFrame, radius: float, ratio: float = RATIO
) -> Recognised:
    """A camera's features that look like landmarks of its keyframes.

    Args:
        current: with the features of the whole image.
        radius: of the object.
        ratio: see `match_features`.
    """
    points, pixels = [np.empty((0, 3))], [np.empty((0, 2))]
    for keyframe in keyframes:
        features, landmarks = keyframe.features, keyframe.landmarks
        good = (landmarks.depth_sd < KNOWN_DEPTH * radius) & ~keyframe.background
        index = match_features(features.subset(good), current.features, ratio)
        points.append(landmarks.mean[good][index[:, 0]])
        pixels.append(current.features.pixels[index[:, 1]])
    # A feature that several keyframes recognise counts once per landmark place.
    _, first = np.unique(np.round(np.concatenate(pixels), 1), axis=0, return_index=True)
    return Recognised(np.concatenate(points)[first], np.concatenate(pixels)[first])


def pose_of(rig: Rig, records: Sequence[Recognised]) -> RigidTransform | None:
    """world_from_object by what all cameras recognised; None if that is too little to be believed."""
    points, pixels = [record.points for record in records], [record.pixels for record in records]
    pose = estimate_pose(rig, points, pixels, max_error_px=MAX_ERROR_PX)
    usable = (Status.OK, Status.NOT_CONVERGED) if len(rig) > 1 else (Status.OK, Status.SCALE_NOT_OBSERVABLE)
    if pose.status not in usable or pose.motion is None or pose.n_inliers.sum() < MIN_INLIERS:
        return None
    return pose.motion


def to_try(keyframes: Sequence[SolvedFrame], camera: int, last: SolvedFrame, turn: int) -> list[SolvedFrame]:
    """The keyframes that a camera's image is compared with.

    Args:
        keyframes: in order of time.
        last: the last solved frame.
        turn: in how many frames the object was not found; each time others are tried.
    """
    nearest = nearest_views(keyframes, camera, last.viewpoints[camera], NEAREST)
    tried = {k.number for k in nearest}
    others = [k for k in keyframes if k.sees[camera] and k.number not in tried]
    # Every frame tries others, so that all have been tried after a few.
    stride = max(len(others) // OTHERS, 1)
    return nearest + others[turn % stride :: stride]
