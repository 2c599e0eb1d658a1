"""Keyframes: solved frames that later frames are matched with, from all sides of the object.

Cameras are static and the object rotates, so a keyframe is characterized by the camera's viewpoint in the object's
frame. A new frame is matched with keyframes of similar viewpoints, oldest first: an old pose has drifted less, and the
first keyframe of a side that is observed again closes the loop (docs/method/4-tracking.md, "Drift").
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.rig import Rig
from sylpose.tracking.frame import SolvedFrame

__all__ = [
    "MAX_KEYFRAMES",
    "add_keyframe",
    "compute_viewpoints",
    "find_nearest_views",
    "inherit_covariance",
    "select_references",
]


# Maximum number of keyframes: a few for every side of the object (choice).
MAX_KEYFRAMES = 100
# A frame becomes a keyframe when the object has rotated by this much relative to the nearest one, or its distance has
# changed by this factor, in a camera's view (choice).
MIN_NEW_ROTATION, MIN_NEW_SCALE = np.radians(6.0), 1.2
# One reference is taken from each ring of angles between viewpoints: near ones match well, far ones limit drift
# (choice).
RING_ANGLES = np.radians([0.0, 10.0, 18.0, 28.0])


def compute_viewpoints(rig: Rig, world_from_object: RigidTransform) -> FloatArray:
    """Return the camera centers (C, 3) in the object's frame."""
    return np.asarray(world_from_object.inv().apply(np.array([camera.center for camera in rig])).reshape(-1, 3))


def _compute_angles(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the angles (n, m) between viewpoints (n, 3) and (m, 3), seen from the object."""
    a, b = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300) for v in (a, b))
    return np.asarray(np.arccos(np.clip(a @ b.T, -1.0, 1.0)))


def _get_viewpoints(keyframes: Sequence[SolvedFrame], camera: int) -> FloatArray:
    """Return one camera's viewpoints (K, 3); NaN where it has no features."""
    empty = np.full(3, np.nan)
    return np.array([k.viewpoints[camera] if k.is_visible[camera] else empty for k in keyframes]).reshape(-1, 3)


def select_references(
    keyframes: Sequence[SolvedFrame], camera: int, viewpoint: FloatArray, skip: SolvedFrame | None = None
) -> list[SolvedFrame]:
    """Select the oldest keyframe in each ring around a camera's viewpoint (3,).

    Args:
        skip: a frame that is matched anyway.
    """
    if not keyframes:
        return []
    angle = _compute_angles(viewpoint[None], _get_viewpoints(keyframes, camera))[0]
    chosen = []
    for inner, outer in pairwise(RING_ANGLES):
        ring = np.flatnonzero((angle >= inner) & (angle < outer))
        if len(ring) and not (skip is not None and keyframes[ring[0]].number == skip.number):
            chosen.append(keyframes[ring[0]])
    return chosen


def find_nearest_views(
    keyframes: Sequence[SolvedFrame], camera: int, viewpoint: FloatArray, count: int, max_angle: float = np.inf
) -> list[SolvedFrame]:
    """Return up to `count` keyframes nearest to a camera viewpoint (3,), nearest first.

    Args:
        max_angle: maximum angle, radians.
    """
    if not keyframes:
        return []
    angle = np.nan_to_num(_compute_angles(viewpoint[None], _get_viewpoints(keyframes, camera))[0], nan=np.inf)
    order = np.argsort(angle, kind="stable")[:count]
    return [keyframes[i] for i in order if np.isfinite(angle[i]) and angle[i] <= max_angle]


def add_keyframe(keyframes: tuple[SolvedFrame, ...], current: SolvedFrame) -> tuple[SolvedFrame, ...]:
    """Add a solved frame (in order of time) if it shows the object from a new side.

    If there are too many keyframes, the most redundant one is removed.
    """
    if keyframes and not _is_new(keyframes, current):
        return keyframes
    kept = [*keyframes, current]
    if len(kept) > MAX_KEYFRAMES:
        rotations = np.array([k.world_from_object.rotation.as_matrix().ravel() for k in kept])
        # tr(A'B) = 1 + 2 cos: the larger, the more similar. Of the most similar pair the newer is removed; the first
        # one stays.
        similarity = np.tril(rotations @ rotations.T, -1) - 10.0 * np.triu(np.ones((len(rotations), len(rotations))))
        del kept[int(np.unravel_index(np.argmax(similarity), similarity.shape)[0])]
    return tuple(kept)


def inherit_covariance(poses: RigidTransform, covariances: FloatArray, is_fixed: BoolArray) -> FloatArray:
    """Return the covariance (N, 6, 6) of (w, d) that frames inherit from fixed ones.

    The errors of fixed frames have common ancestors, so they are fully correlated, and rotate with the object.

    Args:
        poses: N world_from_object.
        covariances: (N, 6, 6) of the fixed frames.
        is_fixed: (N,) which frames are fixed.
    """
    rotations = np.zeros((len(is_fixed), 6, 6))
    rotations[:, :3, :3] = rotations[:, 3:, 3:] = poses.rotation.as_matrix()
    inverse_rotations = rotations[is_fixed].transpose(0, 2, 1)
    mean = (inverse_rotations @ covariances[is_fixed] @ rotations[is_fixed]).mean(axis=0)
    return np.asarray(rotations @ mean @ rotations.transpose(0, 2, 1))


def _is_new(keyframes: Sequence[SolvedFrame], current: SolvedFrame) -> bool:
    """Return whether most cameras with features have a view unlike that in any keyframe."""
    new = []
    for camera in np.flatnonzero(current.is_visible).tolist():
        views, viewpoint = _get_viewpoints(keyframes, camera), current.viewpoints[camera]
        scale = np.linalg.norm(views, axis=1) / np.linalg.norm(viewpoint)
        is_similar = (
            (_compute_angles(viewpoint[None], views)[0] < MIN_NEW_ROTATION)
            & (scale < MIN_NEW_SCALE)
            & (scale > 1.0 / MIN_NEW_SCALE)
        )
        new.append(not is_similar.any())
    return 2 * sum(new) > len(new)
