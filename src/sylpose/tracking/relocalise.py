"""Finding an object again after it was lost: its landmarks, as the keyframes saw them, anywhere in the images."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import match_features
from sylpose.known_model.pose import estimate_pose
from sylpose.numerics.arrays import FloatArray
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.tracking.frame import Reference
from sylpose.tracking.keyframes import nearest_views

__all__ = ["relocalise"]


# Keyframes that each camera's image is compared with: those seen from nearest to where it looked from last, then others
# from all sides, in turn.
NEAREST, OTHERS = 6, 6
# Landmarks whose depth is known to this share of the object's radius.
KNOWN_DEPTH = 0.3
# Fewer matches that agree are not believed: a body of the same outline in the same place, or the object's unknown side,
# makes about twenty; the object itself hundreds.
MIN_INLIERS = 24
MAX_ERROR_PX = 8.0


def relocalise(
    rig: Rig,
    keyframes: Sequence[Reference],
    current: Reference,
    last: Reference,
    radius: float,
    missed: int,
    pool: Executor,
) -> RigidTransform | None:
    """world_from_object by the keyframes' landmarks alone, wherever the object is; None if it is not found.

    Args:
        keyframes: in order of time.
        current: with the features of the whole images.
        last: the last solved frame.
        radius: of the object.
        missed: in how many frames it was not found; each time other keyframes are tried.
        pool: one job per camera.
    """

    def run(c: int) -> tuple[FloatArray, FloatArray]:
        points, pixels = [np.empty((0, 3))], [np.empty((0, 2))]
        for reference in _to_try(keyframes, c, last, missed):
            features, landmarks = reference.features[c], reference.landmarks[c]
            good = (landmarks.depth_sd < KNOWN_DEPTH * radius) & ~reference.background[c]
            index = match_features(features.subset(good), current.features[c])
            points.append(landmarks.mean[good][index[:, 0]])
            pixels.append(current.features[c].pixels[index[:, 1]])
        # A feature that several keyframes recognise counts once per landmark place.
        _, first = np.unique(np.round(np.concatenate(pixels), 1), axis=0, return_index=True)
        return np.concatenate(points)[first], np.concatenate(pixels)[first]

    matches = list(pool.map(run, range(len(rig))))
    pose = estimate_pose(rig, [m[0] for m in matches], [m[1] for m in matches], max_error_px=MAX_ERROR_PX)
    usable = (Status.OK, Status.NOT_CONVERGED) if len(rig) > 1 else (Status.OK, Status.SCALE_NOT_OBSERVABLE)
    if pose.status not in usable or pose.motion is None or pose.n_inliers.sum() < MIN_INLIERS:
        return None
    return pose.motion


def _to_try(keyframes: Sequence[Reference], camera: int, last: Reference, turn: int) -> list[Reference]:
    nearest = nearest_views(keyframes, camera, last.viewpoints[camera], NEAREST)
    others = [k for k in keyframes if len(k.features[camera]) and not any(k is n for n in nearest)]
    # Every frame tries others, so that all have been tried after a few.
    stride = max(len(others) // OTHERS, 1)
    return nearest + others[turn % stride :: stride]
