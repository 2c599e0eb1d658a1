"""Frames that a refinement gave up: found again among the landmarks, and refined once more.

Where a pose starts far from where its frame was seen, a robust refinement does not bring it back: it counts all that the
frame saw as outliers, agrees the better with all other frames, and the pose strays. Its landmarks are known from these other
frames, so it can be found by itself (`absolute_pose`), whatever it was before.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.absolute_pose.pose import estimate_pose
from sylpose.bundle_adjustment.bundle import Bundled, Observations
from sylpose.geometry.arrays import BoolArray, IntArray
from sylpose.results import Status
from sylpose.rig import Rig

__all__ = ["agreed_of", "counted_of", "found_again", "given_up"]

# A frame is given up where no more than this share agrees of what it saw, this being at least so much (choice).
AGREED, LEAST = 0.5, 12


def counted_of(seen: Observations) -> BoolArray:
    """(n,) the observations that say something: those of landmarks that are seen more than once."""
    return np.asarray(np.bincount(seen.landmark)[seen.landmark] > 1)


def agreed_of(found: Bundled, seen: Observations, counted: BoolArray) -> tuple[IntArray, IntArray]:
    """Of each frame (N), how many of the observations that count (n,) agree with a refinement, and how many there are."""
    frames = len(found.covariance)
    agreed, saw = (np.bincount(seen.frame[some], minlength=frames) for some in (counted & (found.weights > 0), counted))
    return agreed, saw


def given_up(found: Bundled, seen: Observations) -> BoolArray:
    """(N,) the frames that a refinement gave up."""
    agreed, saw = agreed_of(found, seen, counted_of(seen))
    return np.asarray((saw >= LEAST) & (agreed <= AGREED * saw))


def found_again(rig: Rig, seen: Observations, found: Bundled, stays: BoolArray) -> RigidTransform | None:
    """The poses (N), those of frames that were given up as the landmarks tell them; None where they tell of none.

    Args:
        stays: (N,) frames whose poses stay.
    """
    lost = given_up(found, seen)
    # Known from where others saw them.
    good = np.bincount(seen.landmark, (found.weights > 0) & ~lost[seen.frame], minlength=len(found.landmarks)) > 1
    poses, again = list(found.world_from_object), False
    for k in np.flatnonzero(lost & ~stays).tolist():
        of_cameras = [
            np.flatnonzero((seen.frame == k) & (seen.camera == c) & good[seen.landmark]) for c in range(len(rig))
        ]
        points = [found.landmarks[seen.landmark[mine]] for mine in of_cameras]
        pixels = [camera.denormalize(seen.image[mine]) for camera, mine in zip(rig, of_cameras, strict=True)]
        told = estimate_pose(rig, points, pixels)
        if told.status is Status.OK and told.motion is not None:
            poses[k], again = told.motion, True
    return RigidTransform.concatenate(poses) if again else None
