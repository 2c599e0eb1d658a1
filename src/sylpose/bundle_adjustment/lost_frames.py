"""Relocalization of frames that a refinement lost.

A robust refinement does not recover a pose that starts far from the truth: it treats all observations of the frame as
outliers, agrees better with all other frames, and the pose drifts. Its landmarks are known from these other frames, so
the pose can be estimated independently (`absolute_pose`), whatever it was before.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.absolute_pose.pose import estimate_pose
from sylpose.bundle_adjustment.bundle import BundleResult, Observations
from sylpose.geometry.arrays import BoolArray, IntArray
from sylpose.results import Status
from sylpose.rig import Rig

# A frame is lost if at most this fraction of its observations are inliers and it has at least so many (choice).
MAX_INLIER_RATIO, MIN_OBSERVATIONS = 0.5, 12


def find_repeated_observations(observations: Observations) -> BoolArray:
    """Return (n,) mask of the informative observations: those of landmarks observed more than once."""
    return np.asarray(np.bincount(observations.landmark)[observations.landmark] > 1)


def count_frame_inliers(
    result: BundleResult, observations: Observations, repeated: BoolArray
) -> tuple[IntArray, IntArray]:
    """Return for each frame (N,) the number of counted observations (n,) that are inliers, and their total number."""
    frames = len(result.covariance)
    inliers, totals = (
        np.bincount(observations.frame[mask], minlength=frames) for mask in (repeated & (result.weights > 0), repeated)
    )
    return inliers, totals


def find_lost_frames(result: BundleResult, observations: Observations) -> BoolArray:
    """Return (N,) mask of the lost frames."""
    inliers, totals = count_frame_inliers(result, observations, find_repeated_observations(observations))
    return np.asarray((totals >= MIN_OBSERVATIONS) & (inliers <= MAX_INLIER_RATIO * totals))


def relocalize_lost_frames(
    rig: Rig, observations: Observations, result: BundleResult, fixed_mask: BoolArray
) -> RigidTransform | None:
    """Return the poses (N,) with lost frames relocalized by the landmarks; None if none succeeds.

    Args:
        fixed_mask: (N,) fixed frames.
    """
    lost = find_lost_frames(result, observations)
    # Landmarks supported by observations in other frames.
    is_support = (result.weights > 0) & ~lost[observations.frame]
    supported = np.bincount(observations.landmark, is_support, minlength=len(result.landmarks)) > 1
    poses, has_new_pose = list(result.world_from_object), False
    for k in np.flatnonzero(lost & ~fixed_mask).tolist():
        camera_indices = [
            np.flatnonzero((observations.frame == k) & (observations.camera == c) & supported[observations.landmark])
            for c in range(len(rig))
        ]
        points = [result.landmarks[observations.landmark[own]] for own in camera_indices]
        pixels = [camera.denormalize(observations.image[own]) for camera, own in zip(rig, camera_indices, strict=True)]
        estimate = estimate_pose(rig, points, pixels)
        if estimate.status is Status.OK and estimate.motion is not None:
            poses[k], has_new_pose = estimate.motion, True
    return RigidTransform.concatenate(poses) if has_new_pose else None
