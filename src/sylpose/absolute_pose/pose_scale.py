"""Whether a known model that cameras do not agree on has only the wrong size: another unit than the calibration's."""

from __future__ import annotations

import numpy as np

from sylpose.absolute_pose.pose_search import SAYS, best_poses, by_luck, of_each_camera
from sylpose.absolute_pose.pose_views import Views, agreeing
from sylpose.geometry.arrays import FloatArray

__all__ = ["other_size"]

# Sizes that differ by less are the calibration's or the model's errors, not another unit (choice).
OTHER = 1.2


def other_size(views: Views, top: float, thin: FloatArray, seed: int) -> float | None:
    """By how much the model would have to be larger for most cameras to agree on one pose, to two digits; None where they
    then do not either, or already do.

    A camera by itself sees an object of any size, in the same directions: a model that is s times too small is s times too
    near to each camera, and where these places are moved out s times they meet.

    Args:
        top: squared distance beyond which a match is wrong, pixels.
        thin: (3,) the direction in which the model extends least.
    """
    own = list(of_each_camera(views, top, thin, seed))
    if len(own) < 2:
        return None
    cameras = [c for c, _ in own]
    centers = -np.einsum("cij,ci->cj", views.turns[cameras], views.shifts[cameras])
    away = np.array([pose.place for _, pose in own]) - centers
    # The size at which center + size * away is the same for all, by least squares.
    centers, away = centers - centers.mean(axis=0), away - away.mean(axis=0)
    spread = float(np.sum(away * away))
    size = -float(np.sum(centers * away)) / spread if spread > 0.0 else 0.0
    if not np.isfinite(size) or size <= 0.0 or 1.0 / OTHER < size < OTHER:
        return None
    larger = views._replace(points=size * views.points)
    poses = best_poses(larger, top, thin, np.random.default_rng(seed))
    if not poses or by_luck(larger, poses[0]):
        return None
    say = agreeing(larger, poses[0].weights) >= SAYS * np.diff(views.start)
    return float(f"{size:.2g}") if np.count_nonzero(say[cameras]) > len(cameras) / 2 else None
