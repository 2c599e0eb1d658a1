"""The joint refinement where turns are small: from two starts, and with what the object's shape tells of its size.

A small turn and a shift look much alike, with another relief of the surface (the bas-relief ambiguity); from where the
tracker was, the refinement may not find its way to the other, and noise may prefer the wrong one. So it also starts from no
turn at all. The better of the two is taken, and where it is not much better, they differ by what is not known.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.bundle_adjustment.bundle import Bundled, Observations, bundle, stays_of
from sylpose.bundle_adjustment.camera_parameters import SURFACE_RADII, on_surface
from sylpose.bundle_adjustment.covariance_inflation import bent
from sylpose.bundle_adjustment.lost_frames import agreed_of, counted_of, found_again
from sylpose.bundle_adjustment.problem import CUTOFF
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.robust_loss import biquartic_losses
from sylpose.landmarks.support_size import extent_of, size_of
from sylpose.rig import Rig

__all__ = ["SMALL_TURN", "bundle_sized", "gives_up", "length_is_open"]

# A length that is known to this share of it needs no more telling (choice).
TOLD = 0.005
# It is open when it is not, and makes most of what is not known of where the object is (choice).
MOST = 0.5
# Poses that turn by less than this in all, radians, may as well not turn. One start is believed, and the other not, when
# the other costs so many times as much: a wrong one was seen to cost a fifth less than the true one (measured:
# docs/benchmarks.md, "Kinds of scenes").
SMALL_TURN, MUCH_BETTER = 0.3, 1.5
# A start gives a frame up where it explains less than this share of what the other explains of it: that frame may be the
# only one that tells the surface, and all the others agree the better without it (choice).
GIVEN_UP = 0.7
# What each camera's surface has for itself beside the size, in radii (choice).
OWN_RADII = 0.1


def length_is_open(found: Bundled) -> bool:
    """Whether what was seen leaves the length of the path open: then it follows from what is believed of the object."""
    return bool(TOLD < found.length_sd < np.inf and found.length_share > MOST)


def bundle_sized(
    rig: Rig,
    seen: Observations,
    world_from_object: RigidTransform,
    radius: float,
    *,
    other: RigidTransform | None = None,
    **options: Any,
) -> Bundled:
    """`bundle`; where that leaves the length of the path open, once more with the surfaces as far away as they have to be
    for all cameras to see one body.

    Args:
        other: another path to start from, which may be likelier.
        options: of `bundle`.
    """
    found, rivals = _of_two_starts(rig, seen, world_from_object, radius, **options)
    if other is not None:
        second = bundle(rig, seen, other, radius, **{**options, "landmarks": None})
        if _likelier(second, found, seen):
            found, rivals = second, np.zeros_like(rivals)
    start = found_again(rig, seen, found, stays_of(options.get("fixed"), len(rivals)))
    if start is not None:
        second = bundle(rig, seen, start, radius, **{**options, "landmarks": found.landmarks})
        if _likelier(second, found, seen):
            found = second
    surfaces = _surfaces(rig, seen, found, radius) if len(rig) > 1 and length_is_open(found) else None
    if surfaces is not None:
        again = {**options, "landmarks": found.landmarks, "surfaces": surfaces}
        found = bundle(rig, seen, found.world_from_object, radius, **again)
    return replace(found, covariance=found.covariance + bent(rivals, found.away))


def _of_two_starts(
    rig: Rig, seen: Observations, world_from_object: RigidTransform, radius: float, **options: Any
) -> tuple[Bundled, FloatArray]:
    """`bundle` from the poses given and, if they turn little, from the same without a turn, which would not tell where the
    surfaces are: the one that costs less; and by what the other differs (N, 6, 6), of (w, d), where it is nearly as good."""
    found = bundle(rig, seen, world_from_object, radius, **options)
    first, none = world_from_object.rotation[0], np.zeros_like(found.covariance)
    if (world_from_object.rotation * first.inv()).magnitude().max() > SMALL_TURN:
        return found, none
    standing = RigidTransform.from_components(world_from_object.translation, first)
    other = bundle(rig, seen, standing, radius, **{**options, "landmarks": None, "surfaces_stay": True})
    counted = counted_of(seen)
    if gives_up(other, found, seen, counted):
        return found, none
    costs = _costs(found, other, seen, counted)
    best, second = found, other
    if costs[1] < costs[0]:
        again = {**options, "landmarks": other.landmarks}
        best, second = bundle(rig, seen, other.world_from_object, radius, **again), found
        if gives_up(best, found, seen, counted):
            return found, none
    if max(costs) > MUCH_BETTER * min(costs):
        return best, none
    turn = (second.world_from_object.rotation * best.world_from_object.rotation.inv()).as_rotvec()
    off = np.hstack([turn, second.world_from_object.translation - best.world_from_object.translation])
    return best, off[:, :, None] * off[:, None, :]


def _likelier(one: Bundled, other: Bundled, seen: Observations) -> bool:
    """Whether one explains more of the observations than another, and gives no frame up for it."""
    counted = counted_of(seen)
    costs = _costs(one, other, seen, counted)
    return costs[0] < costs[1] and not gives_up(one, other, seen, counted)


def _costs(one: Bundled, other: Bundled, seen: Observations, counted: BoolArray) -> list[float]:
    """What two refinements cost, with the same noise, of the observations (n,) that count."""
    sigma = np.fmin(one.sigma_px, other.sigma_px)[seen.camera]
    return [
        float(biquartic_losses((b.residuals[counted] / (CUTOFF * sigma[counted])) ** 2).sum()) for b in (one, other)
    ]


def gives_up(one: Bundled, other: Bundled, seen: Observations, counted: BoolArray) -> bool:
    """Whether one gives a frame up of which the other explains most of the observations (n,) that count."""
    of_one, saw = agreed_of(one, seen, counted)
    of_other, _ = agreed_of(other, seen, counted)
    return bool(((2 * of_other > saw) & (of_one < GIVEN_UP * of_other)).any())


def _surfaces(rig: Rig, seen: Observations, found: Bundled, radius: float) -> tuple[FloatArray, FloatArray] | None:
    """Mean (C,) and covariance (C, C) of `bundle`'s surfaces, by the body's shape; None where that says nothing."""
    first = found.world_from_object[0]
    counts = np.bincount(seen.landmark[found.weights > 0], minlength=len(found.landmarks))
    camera = np.zeros(len(found.landmarks), np.int64)
    camera[seen.landmark] = seen.camera
    centers = first.inv().apply(np.array([c.center for c in rig])).reshape(-1, 3)
    of_cameras = [found.landmarks[(camera == c) & (counts >= 2)] for c in range(len(rig))]
    larger, sd = size_of([extent_of(mine, o) for mine, o in zip(of_cameras, centers, strict=True)], radius)
    if not np.isfinite(sd):
        return None
    axes = [c.rotation[:2] @ first.rotation.as_matrix() for c in rig]
    heights = [_height(*own, radius) for own in zip(of_cameras, centers, axes, strict=True)]
    distances = np.linalg.norm(centers, axis=1)
    covariance = sd**2 * np.outer(distances, distances) + (OWN_RADII * radius) ** 2 * np.eye(len(rig))
    return np.array(heights) - larger * distances, covariance


def _height(points: FloatArray, center: FloatArray, axes: FloatArray, radius: float) -> float:
    """How far a camera's landmarks (n, 3) are in front of the origin, where their plane crosses its line of sight; what is
    usual without any.

    Args:
        center: (3,) of the camera, axes: (2, 3) its x and y axis, object's frame.
    """
    n = len(points)
    if not n:
        return SURFACE_RADII * radius
    toward, across = on_surface(points, np.tile(center, (n, 1)), np.tile(axes, (n, 1, 1)), radius)
    return float(np.linalg.lstsq(across, np.einsum("ni,ni->n", points, toward), rcond=None)[0][0])
