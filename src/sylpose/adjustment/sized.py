"""The joint refinement where turns are small: from two starts, and with what the object's shape tells of its size.

A small turn and a shift look much alike, with another relief of the surface (the bas-relief ambiguity); from where the
tracker was, the refinement may not find its way to the other, and noise may prefer the wrong one. So it also starts from no
turn at all. The better of the two is taken, and where it is not much better, they differ by what is not known.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.adjustment.bundle import Bundled, Observations, bundle
from sylpose.adjustment.problem import CUTOFF
from sylpose.landmarks.shape import extent_of, size_of
from sylpose.numerics.arrays import FloatArray
from sylpose.numerics.robust import biquartic_losses
from sylpose.rig import Rig

__all__ = ["bundle_sized", "length_is_open"]

# A length that is known to this share of it needs no more telling (choice).
TOLD = 0.005
# It is open when it is not, and makes most of what is not known of where the object is (choice).
MOST = 0.5
# Poses that turn by less than this in all, radians, may as well not turn. One start is believed, and the other not, when
# the other costs so many times as much: a wrong one was seen to cost a fifth less than the true one (measured:
# docs/benchmarks.md, "Kinds of scenes").
SMALL_TURN, MUCH_BETTER = 0.3, 1.5
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
    found, rivals = _of_two_starts(rig, seen, world_from_object, radius, **options)
    if len(rig) < 2 or not length_is_open(found):
        return found
    surfaces = _surfaces(rig, seen, found, radius)
    if surfaces is None:
        return found
    sized = bundle(
        rig, seen, found.world_from_object, radius, **{**options, "landmarks": found.landmarks, "surfaces": surfaces}
    )
    return replace(sized, covariance=sized.covariance + rivals)


def _of_two_starts(
    rig: Rig, seen: Observations, world_from_object: RigidTransform, radius: float, **options: Any
) -> tuple[Bundled, FloatArray]:
    """`bundle` from the poses given and, if they turn little, from the same without a turn: the one that costs less."""
    found = bundle(rig, seen, world_from_object, radius, **options)
    first, none = world_from_object.rotation[0], np.zeros_like(found.covariance)
    if (world_from_object.rotation * first.inv()).magnitude().max() > SMALL_TURN:
        return found, none
    standing = RigidTransform.from_components(
        world_from_object.translation, Rotation.from_quat(np.tile(first.as_quat(), (len(world_from_object), 1)))
    )
    other = bundle(rig, seen, standing, radius, **{**options, "landmarks": None})
    sigma = np.fmin(found.sigma_px, other.sigma_px)[seen.camera]
    counted = np.bincount(seen.landmark)[seen.landmark] > 1
    costs = [
        float(biquartic_losses((b.residuals[counted] / (CUTOFF * sigma[counted])) ** 2).sum()) for b in (found, other)
    ]
    best, second = (found, other) if costs[0] <= costs[1] else (other, found)
    if max(costs) > MUCH_BETTER * min(costs):
        return best, none
    turn = (second.world_from_object.rotation * best.world_from_object.rotation.inv()).as_rotvec()
    off = np.hstack([turn, second.world_from_object.translation - best.world_from_object.translation])
    rivals = off[:, :, None] * off[:, None, :]
    return replace(best, covariance=best.covariance + rivals), rivals


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
