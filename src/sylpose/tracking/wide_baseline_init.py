"""Alternative initial path from wide-baseline motions, to check sequential poses.

If the object rotates slowly, is nearly planar or is visible in few cameras, its first small rotation barely separates
motion from depth. A wrong depth then makes each next pose consistent with the previous ones, and joint refinement ends
in the nearest local minimum with false certainty. Two distant frames are free of this: the landmarks observed in both
are matches, which one large motion explains or not, with depth unknown (`estimate_motion`). If that motion contradicts
the path, the path is bent to agree with it, as another start of the refinement, and the likelier result is used.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.bundle import Observations
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.matches import Matches
from sylpose.relative_pose.motion import estimate_motion
from sylpose.results import Status
from sylpose.rig import Rig

__all__ = ["find_alternative_path"]

# Shorter paths are not checked: the next frames may contradict what few frames agree on (choice).
MIN_PATH_FRAMES = 16
# Two frames are compared if so many landmarks are observed in both, by at least two cameras; the motion is valid if
# this share of them are inliers (choice).
MIN_SHARED_LANDMARKS, MIN_CAMERAS, MIN_INLIER_RATIO = 60, 2, 0.75
# A motion contradicts a path if it excludes the path's (chi-squared, once in a thousand times) and differs by more than
# this rotation, radians, or share of the object's radius. Smaller differences are left to the refinement (choice).
MAX_CHI_SQUARED = chi_squared_bound(6)
MIN_ROTATION, MIN_TRANSLATION = np.deg2rad(0.5), 0.03
# Approximate number of links of a path that are checked; links over so many frames are split in halves (choice).
MAX_LINKS, LONG_LINK_FRAMES = 6, 8


def find_alternative_path(
    rig: Rig, observations: Observations, path: RigidTransform, radius: float
) -> RigidTransform | None:
    """Return the path bent to agree with motions between distant frames, or None.

    From the last frame backward, each link leads to the earliest frame that shares enough landmarks; the frame halfway
    is checked as well. None means that these motions do not contradict the path.

    Args:
        observations: landmark observations of all frames.
        path: N poses.
        radius: of the object.
    """
    if len(path) < MIN_PATH_FRAMES:
        return None
    nodes = [len(path) - 1]
    while nodes[-1] > 0 and len(nodes) <= MAX_LINKS:
        earlier = _find_earliest(observations, nodes[-1])
        if earlier is None:
            break
        if nodes[-1] - earlier >= LONG_LINK_FRAMES:
            nodes.append((earlier + nodes[-1]) // 2)
        nodes.append(earlier)
    pairs = list(pairwise(reversed(nodes)))
    deviations = [_compute_deviation(rig, observations, path, *pair, radius) for pair in pairs]
    if all(deviation is None for deviation in deviations):
        return None
    poses = list(path)
    # Poses before the first link stay.
    for (earlier, later), deviation in zip(pairs, deviations, strict=True):
        poses[earlier + 1 :] = _bend_path(path, poses[earlier], earlier, later, deviation)
    return RigidTransform.concatenate(poses)


def _find_shared(observations: Observations, first: int, second: int) -> list[tuple[IntArray, IntArray]]:
    """Return per camera the observations of common landmarks in two frames."""
    out = []
    for camera in range(int(observations.camera.max(initial=-1)) + 1):
        indices = [np.flatnonzero((observations.frame == k) & (observations.camera == camera)) for k in (first, second)]
        _, a, b = np.intersect1d(
            observations.landmark[indices[0]], observations.landmark[indices[1]], return_indices=True
        )
        out.append((indices[0][a], indices[1][b]))
    return out


def _find_earliest(observations: Observations, later: int) -> int | None:
    """Return the earliest frame that shares enough landmarks with a later one."""
    is_later = observations.frame == later
    is_shared = (observations.frame < later) & np.isin(observations.landmark, observations.landmark[is_later])
    counts = np.bincount(observations.frame[is_shared], minlength=later)
    for k in np.flatnonzero(counts >= MIN_SHARED_LANDMARKS).tolist():
        if len(np.unique(observations.camera[is_shared & (observations.frame == k)])) >= MIN_CAMERAS:
            return int(k)
    return None


def _compute_deviation(
    rig: Rig, observations: Observations, path: RigidTransform, earlier: int, later: int, radius: float
) -> FloatArray | None:
    """Compare the later pose with the motion between two frames.

    Returns:
        (6,) (w, d) from the later pose to the one by that motion, about the object's center; None if the motion is
        unknown or does not contradict the path.
    """
    pairs = _find_shared(observations, earlier, later)
    matches = [Matches(observations.image[a], observations.image[b]) for a, b in pairs]
    matches += [Matches.empty()] * (len(rig) - len(matches))
    found = estimate_motion(rig, matches, center=path[earlier].translation, radius=radius)
    if found.status is not Status.OK or found.motion is None or found.faults or found.second_body_ratio > 0.0:
        return None
    if found.n_inliers.sum() < MIN_INLIER_RATIO * sum(len(m) for m in matches):
        return None
    corrected = found.motion * path[earlier]
    rotation = (corrected.rotation * path[later].rotation.inv()).as_rotvec()
    deviation = np.concatenate([rotation, corrected.translation - path[later].translation])
    is_relevant = np.linalg.norm(rotation) > MIN_ROTATION or np.linalg.norm(deviation[3:]) > MIN_TRANSLATION * radius
    return deviation if is_relevant and deviation @ found.information @ deviation > MAX_CHI_SQUARED else None


def _bend_path(
    path: RigidTransform, start: RigidTransform, earlier: int, later: int, deviation: FloatArray | None
) -> list[RigidTransform]:
    """Bend the poses after the earlier frame, which gets a new pose.

    Up to the later frame an increasing share of its correction is applied, in proportion to the rotation.
    """
    correction = start * path[earlier].inv()
    angles = (path.rotation * path[earlier].rotation.inv()).magnitude()
    total_angle, out = max(float(angles[later]), 1e-9), []
    for k in range(earlier + 1, len(path)):
        pose = correction * path[k]
        if deviation is not None:
            share = min(float(angles[k]) / total_angle, 1.0) if k < later else 1.0
            rotation = Rotation.from_rotvec(share * deviation[:3])
            pose = RigidTransform.from_components(pose.translation + share * deviation[3:], rotation * pose.rotation)
        out.append(pose)
    return out
