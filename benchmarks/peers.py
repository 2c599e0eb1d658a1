"""Conversions between sylpose and PoseLib or COLMAP for the benchmarks."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, Rig

__all__ = ["from_colmap_pose", "from_poselib_result", "pinhole_parameters", "to_poselib_matches", "to_poselib_rig"]


def pinhole_parameters(camera: Camera) -> list[float]:
    """Return fx, fy, cx, cy of the undistorted camera, pixels.

    COLMAP's pixel centers are at half integers, sylpose's at integers. The offset is the same for points and principal
    point and cancels.
    """
    (fx, _, cx), (_, fy, cy) = camera.matrix[:2].tolist()
    return [fx, fy, cx, cy]


def to_poselib_rig(rig: Rig) -> tuple[list[Any], list[Any]]:
    """Return PoseLib's cameras and their poses in the rig."""
    import poselib

    cameras, poses = [], []
    for camera in rig:
        cameras.append(poselib.Camera("PINHOLE", pinhole_parameters(camera), *camera.size))
        pose = poselib.CameraPose()
        pose.R, pose.t = camera.rotation, camera.camera_from_world.translation
        poses.append(pose)
    return cameras, poses


def to_poselib_matches(views: Iterable[tuple[FloatArray, FloatArray]]) -> list[Any]:
    """Return PoseLib's matches within each camera from the pixels (n, 2) in both frames."""
    import poselib

    matches = []
    for c, (x, y) in enumerate(views):
        pairs = poselib.PairwiseMatches()
        pairs.cam_id1 = pairs.cam_id2 = c
        pairs.x1, pairs.x2 = x, y
        matches.append(pairs)
    return matches


def from_poselib_result(found: tuple[Any, dict[str, Any]]) -> RigidTransform | None:
    """Convert a result of PoseLib; None if there are no inliers or the pose is not finite."""
    pose, info = found
    if not info["num_inliers"] or not np.isfinite([*pose.q, *pose.t]).all():
        return None
    return RigidTransform.from_components(pose.t, Rotation.from_matrix(pose.R))


def from_colmap_pose(pose: Any) -> RigidTransform:
    """Convert a pose of COLMAP."""
    return RigidTransform.from_components(pose.translation, Rotation.from_matrix(pose.rotation.matrix()))
