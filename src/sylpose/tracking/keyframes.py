"""Keyframes: solved frames that later ones are matched against, because they show the object from another side.

Cameras stand still and the object turns, so what matters is from where in the object's own frame a camera looked. A new
frame is matched with keyframes in which a camera looked from nearby, the oldest of them first: an old pose has drifted
less, and the first keyframe of a side that is seen again closes the loop (docs/method.md, "Drift").
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.rig import Rig
from sylpose.tracking.frame import SolvedFrame

__all__ = ["MAX_KEYFRAMES", "inherited", "nearest_views", "references_of", "viewpoints", "with_keyframe"]


# So many keyframes are kept: a few for every side of the object (choice).
MAX_KEYFRAMES = 100
# A frame is a keyframe when the object has turned by this much since the nearest one, or come nearer or gone further by
# this factor, as seen from a camera (choice).
NEW_TURN, NEW_SCALE = np.radians(6.0), 1.2
# One reference from each ring of angles between the viewpoints: near ones match well, far ones stop the drift (choice).
RINGS = np.radians([0.0, 10.0, 18.0, 28.0])


def viewpoints(rig: Rig, world_from_object: RigidTransform) -> FloatArray:
    """(C, 3) the cameras' centres in the object's frame."""
    return np.asarray(world_from_object.inv().apply(np.array([camera.center for camera in rig])).reshape(-1, 3))


def _angles(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n, m) angles between viewpoints (n, 3) and (m, 3), seen from the object."""
    a, b = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300) for v in (a, b))
    return np.asarray(np.arccos(np.clip(a @ b.T, -1.0, 1.0)))


def _views(keyframes: Sequence[SolvedFrame], camera: int) -> FloatArray:
    """(K, 3) one camera's viewpoints; NaN where it saw no feature."""
    empty = np.full(3, np.nan)
    return np.array([k.viewpoints[camera] if k.sees[camera] else empty for k in keyframes]).reshape(-1, 3)


def references_of(
    keyframes: Sequence[SolvedFrame], camera: int, viewpoint: FloatArray, skip: SolvedFrame | None = None
) -> list[SolvedFrame]:
    """The keyframes that a camera's image is to be matched with: of each ring around its viewpoint (3,), the oldest.

    Args:
        skip: matched anyway.
    """
    if not keyframes:
        return []
    angle = _angles(viewpoint[None], _views(keyframes, camera))[0]
    chosen = []
    for inner, outer in pairwise(RINGS):
        ring = np.flatnonzero((angle >= inner) & (angle < outer))
        if len(ring) and not (skip is not None and keyframes[ring[0]].number == skip.number):
            chosen.append(keyframes[ring[0]])
    return chosen


def nearest_views(
    keyframes: Sequence[SolvedFrame], camera: int, viewpoint: FloatArray, count: int, reach: float = np.inf
) -> list[SolvedFrame]:
    """The `count` keyframes in which a camera looked from nearest to a viewpoint (3,), within an angle; nearest first."""
    if not keyframes:
        return []
    angle = np.nan_to_num(_angles(viewpoint[None], _views(keyframes, camera))[0], nan=np.inf)
    order = np.argsort(angle, kind="stable")[:count]
    return [keyframes[i] for i in order if np.isfinite(angle[i]) and angle[i] <= reach]


def with_keyframe(keyframes: tuple[SolvedFrame, ...], current: SolvedFrame) -> tuple[SolvedFrame, ...]:
    """The keyframes and a solved frame (in order of time), if it shows the object from a new side; without the one that is
    missed least when they get too many."""
    if keyframes and not _is_new(keyframes, current):
        return keyframes
    kept = [*keyframes, current]
    if len(kept) > MAX_KEYFRAMES:
        turns = np.array([k.world_from_object.rotation.as_matrix().ravel() for k in kept])
        # tr(A'B) = 1 + 2 cos: the larger, the more alike. Of the most alike two the newer goes; the first one stays.
        alike = np.tril(turns @ turns.T, -1) - 10.0 * np.triu(np.ones((len(turns), len(turns))))
        del kept[int(np.unravel_index(np.argmax(alike), alike.shape)[0])]
    return tuple(kept)


def inherited(poses: RigidTransform, covariances: FloatArray, stays: BoolArray) -> FloatArray:
    """(N, 6, 6) of (w, d): what frames take over from those that stay while they are refined; these are off alike, as they
    have ancestors in common, and errors turn with the object.

    Args:
        poses: N world_from_object; covariances: (N, 6, 6) of those that stay; stays: (N,) which of them do.
    """
    turns = np.zeros((len(stays), 6, 6))
    turns[:, :3, :3] = turns[:, 3:, 3:] = poses.rotation.as_matrix()
    back = turns[stays].transpose(0, 2, 1)
    usual = (back @ covariances[stays] @ turns[stays]).mean(axis=0)
    return np.asarray(turns @ usual @ turns.transpose(0, 2, 1))


def _is_new(keyframes: Sequence[SolvedFrame], current: SolvedFrame) -> bool:
    """Whether most cameras that see the object see it otherwise than in any keyframe."""
    new = []
    for camera in np.flatnonzero(current.sees).tolist():
        views, here = _views(keyframes, camera), current.viewpoints[camera]
        scale = np.linalg.norm(views, axis=1) / np.linalg.norm(here)
        alike = (_angles(here[None], views)[0] < NEW_TURN) & (scale < NEW_SCALE) & (scale > 1.0 / NEW_SCALE)
        new.append(not alike.any())
    return 2 * sum(new) > len(new)
