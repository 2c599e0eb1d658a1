"""What the benchmarks give to PoseLib and COLMAP, and take from them, in these libraries' own forms."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, Rig

__all__ = ["colmap_pose", "pinhole_of", "poselib_matches", "poselib_pose", "poselib_rig"]


def pinhole_of(camera: Camera) -> list[float]:
    """fx, fy, cx, cy, pixels, of the camera without its lens. COLMAP's pixel centres are at half integers, ours at integers:
    the same shift in points and principal point changes nothing."""
    (fx, _, cx), (_, fy, cy) = camera.matrix[:2].tolist()
    return [fx, fy, cx, cy]


def poselib_rig(rig: Rig) -> tuple[list[Any], list[Any]]:
    """PoseLib's cameras and their poses in the rig."""
    import poselib

    cameras, poses = [], []
    for camera in rig:
        cameras.append(poselib.Camera("PINHOLE", pinhole_of(camera), *camera.size))
        pose = poselib.CameraPose()
        pose.R, pose.t = camera.rotation, camera.camera_from_world.translation
        poses.append(pose)
    return cameras, poses


def poselib_matches(views: Iterable[tuple[FloatArray, FloatArray]]) -> list[Any]:
    """PoseLib's matches within each camera, from their pixels (n, 2) in both frames."""
    import poselib

    matches = []
    for c, (x, y) in enumerate(views):
        pairs = poselib.PairwiseMatches()
        pairs.cam_id1 = pairs.cam_id2 = c
        pairs.x1, pairs.x2 = x, y
        matches.append(pairs)
    return matches


def poselib_pose(found: tuple[Any, dict[str, Any]]) -> RigidTransform | None:
    """What a solver of PoseLib found; None where no match agrees or the pose is not finite."""
    pose, info = found
    if not info["num_inliers"] or not np.isfinite([*pose.q, *pose.t]).all():
        return None
    return RigidTransform.from_components(pose.t, Rotation.from_matrix(pose.R))


def colmap_pose(pose: Any) -> RigidTransform:
    """A pose of COLMAP's."""
    return RigidTransform.from_components(pose.translation, Rotation.from_matrix(pose.rotation.matrix()))
