"""Detection of a known model of the wrong size, for example in another unit than the calibration's."""

from __future__ import annotations

import numpy as np

from sylpose.absolute_pose.pose_search import MIN_INLIER_RATIO, find_single_camera_poses, is_by_chance, search_poses
from sylpose.absolute_pose.pose_views import Views, count_inliers
from sylpose.geometry.arrays import FloatArray

__all__ = ["estimate_model_scale"]

# Smaller size ratios are errors of the calibration or the model, not another unit (choice).
MIN_SIZE_RATIO = 1.2


def estimate_model_scale(views: Views, max_square: float, thin_axis: FloatArray, seed: int) -> float | None:
    """Estimate the factor by which the model must be scaled for cameras to agree on a pose.

    It is that of most cameras, to two digits.

    None where they do not agree then either, or already do. A single camera fits an object of any size in the same
    direction: a model that is s times too small is s times too near to each camera, and scaling these positions by s
    makes them coincide.

    Args:
        max_square: squared distance beyond which a match is an outlier, pixels.
        thin_axis: (3,) the direction in which the model extends least.
    """
    single_poses = list(find_single_camera_poses(views, max_square, thin_axis, seed))
    if len(single_poses) < 2:
        return None
    cameras = [c for c, _ in single_poses]
    centers = -np.einsum("cij,ci->cj", views.rotations[cameras], views.translations[cameras])
    offsets = np.array([pose.translation for _, pose in single_poses]) - centers
    # The size at which center + size * offset is equal for all, by least squares.
    centers, offsets = centers - centers.mean(axis=0), offsets - offsets.mean(axis=0)
    spread = float(np.sum(offsets * offsets))
    size = -float(np.sum(centers * offsets)) / spread if spread > 0.0 else 0.0
    if not np.isfinite(size) or size <= 0.0 or 1.0 / MIN_SIZE_RATIO < size < MIN_SIZE_RATIO:
        return None
    scaled_views = views._replace(points=size * views.points)
    poses = search_poses(scaled_views, max_square, thin_axis, np.random.default_rng(seed))
    if not poses or is_by_chance(scaled_views, poses[0]):
        return None
    is_supporting = count_inliers(scaled_views, poses[0].weights) >= MIN_INLIER_RATIO * np.diff(views.start)
    return float(f"{size:.2g}") if np.count_nonzero(is_supporting[cameras]) > len(cameras) / 2 else None
