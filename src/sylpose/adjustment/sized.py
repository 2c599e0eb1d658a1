"""The joint refinement with what the object's shape tells of its size, where no turn has told it."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.adjustment.bundle import Bundled, Observations, bundle
from sylpose.landmarks.shape import extent_of, size_of
from sylpose.numerics.arrays import FloatArray
from sylpose.rig import Rig

__all__ = ["bundle_sized", "length_is_open"]

# A length that is known to this share of it needs no more telling (choice).
TOLD = 0.005
# It is open when it is not, and makes most of what is not known of where the object is (choice).
MOST = 0.5
# What each camera's surface has for itself beside the size, in radii (choice).
OWN_RADII = 0.1


def length_is_open(found: Bundled) -> bool:
    """Whether what was seen leaves the length of the path open: then it follows from what is believed of the object."""
    return bool(TOLD < found.length_sd < np.inf and found.length_share > MOST)


def bundle_sized(
    rig: Rig, seen: Observations, world_from_object: RigidTransform, radius: float, **options: Any
) -> Bundled:
    """`bundle`; where that leaves the length of the path open, once more with the surfaces as far away as they have to be
    for all cameras to see one body."""
    found = bundle(rig, seen, world_from_object, radius, **options)
    if len(rig) < 2 or not length_is_open(found):
        return found
    surfaces = _surfaces(rig, seen, found, radius)
    if surfaces is None:
        return found
    return bundle(
        rig, seen, found.world_from_object, radius, **{**options, "landmarks": found.landmarks, "surfaces": surfaces}
    )


def _surfaces(rig: Rig, seen: Observations, found: Bundled, radius: float) -> tuple[FloatArray, FloatArray] | None:
    """Mean (C,) and covariance (C, C) of `bundle`'s surfaces, by the body's shape; None where that says nothing."""
    first = found.world_from_object[0]
    used = found.weights > 0
    counts = np.bincount(seen.landmark[used], minlength=len(found.landmarks))
    camera = np.zeros(len(found.landmarks), np.int64)
    camera[seen.landmark] = seen.camera
    centers = first.inv().apply(np.array([c.center for c in rig])).reshape(-1, 3)
    extents, heights, distances = [], np.zeros(len(rig)), np.zeros(len(rig))
    for c, center in enumerate(centers):
        mine = found.landmarks[(camera == c) & (counts >= 2)]
        extents.append(extent_of(mine, center))
        distances[c] = np.linalg.norm(center)
        toward = center / distances[c]
        heights[c] = _height(mine, toward, first, rig, c, radius) if len(mine) else 0.5 * radius
    larger, sd = size_of(extents, radius)
    if not np.isfinite(sd):
        return None
    covariance = sd**2 * np.outer(distances, distances) + (OWN_RADII * radius) ** 2 * np.eye(len(rig))
    return heights - larger * distances, covariance


def _height(points: FloatArray, toward: FloatArray, first: RigidTransform, rig: Rig, c: int, radius: float) -> float:
    """How far a camera's landmarks (n, 3) are in front of the origin, where their plane crosses its line of sight."""
    axes = rig.cameras[c].rotation[:2] @ first.rotation.as_matrix()
    axes = axes - np.outer(axes @ toward, toward)
    across = np.column_stack([np.ones(len(points)), np.clip(points @ axes.T, -radius, radius)])
    return float(np.linalg.lstsq(across, points @ toward, rcond=None)[0][0])
