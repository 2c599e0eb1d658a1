"""One camera's terms of a frame's pose: its matches with landmarks, how far they are trusted, and how many agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.rigid import turn_of
from sylpose.landmarks.alignment import Sights
from sylpose.landmarks.camera_terms import CUTOFF, VOTE_PX
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.rig import Camera
from sylpose.tracking.frame import CameraFrame, Pair, SolvedFrame, away
from sylpose.tracking.reports import Ages, Chance

__all__ = ["STILL_TRUST", "ages_of", "chance_of", "cut", "sights_of", "smear", "support_of", "usual_age", "with_trust"]

# Weight of a landmark that stands still and never moved, while others move: boxes may hold ten times as much wall as object
# (choice).
STILL_TRUST = 0.005
# Landmarks with less trust are no evidence that a pose is right: those, and young ones among old (choice).
TRUSTED = 0.06


def sights_of(
    camera: Camera, pairs: Sequence[Pair], current: CameraFrame, base: SolvedFrame
) -> tuple[Sights, BoolArray]:
    """A camera's matches of landmarks, carried to where the object was in the base frame, and (n,) which of them moved with
    the object or are somewhere else than where they were first seen; their trust is for now in how many frames they were
    seen.

    Args:
        camera: as it stood for this frame.
    """
    known = Landmarks.concatenate([pair.landmarks for pair in pairs])
    index = np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 1] for pair in pairs)])
    turn, center = turn_of(base.world_from_object), base.world_from_object.translation
    points, error = known.mean @ turn.T, known.depth_error @ turn.T
    outwards = np.sign(np.einsum("ni,ni->n", error, points + center - camera.center))
    # In how many frames each feature was seen, by the best known of its landmarks.
    seen = np.zeros(int(index.max(initial=-1)) + 1)
    np.maximum.at(seen, index, known.seen)
    moving = (away(known, current.features.pixels[index]) > current.still_px) | known.moved
    sights = Sights(
        points=points,
        depth_error=error * outwards[:, None],
        image=current.features.normalized[index],
        feature=index,
        trust=seen[index],
        rotation=camera.rotation,
        center=camera.center - center,
        focal=camera.focal,
    )
    return sights, moving


def ages_of(sights: Sights, moving: BoolArray, pairs: Sequence[Pair]) -> Ages:
    """In how many frames the landmarks were seen, of `sights_of`."""
    oldest = max((int(pair.earlier.table.seen(pair.earlier.numbers).max(initial=0)) for pair in pairs), default=0)
    depth_sd = float(np.median(np.linalg.norm(sights.depth_error, axis=1))) if len(sights.trust) else np.nan
    return Ages.of(sights.trust, int(moving.sum()), oldest, depth_sd)


def usual_age(seen: FloatArray) -> float:
    """The number of frames that a landmark must have been seen in to be trusted fully, from those of all (n,)."""
    return float(np.quantile(seen, 0.75)) if len(seen) else 1.0


def with_trust(sights: Sights, moving: BoolArray, usual: float, of_still: float) -> Sights:
    """The sights of `sights_of` with their trust.

    What has moved along for long deserves more of it than what has just come into view (a hand, say).

    Args:
        usual: age at which a landmark is trusted fully.
        of_still: what a landmark has of it that stands still and was never seen to move.
    """
    return replace(sights, trust=np.minimum(sights.trust / usual, 1.0) ** 2 * np.where(moving, 1.0, of_still))


def cut(weights: FloatArray, residuals: FloatArray, pairs: Sequence[Pair]) -> list[tuple[FloatArray, FloatArray]]:
    """Weights and residuals (n,) of a camera's sights, cut into the pairs that they were put together from."""
    cuts = np.cumsum([len(pair) for pair in pairs])[:-1]
    return list(zip(np.split(weights, cuts), np.split(residuals, cuts), strict=True)) if len(pairs) else []


def chance_of(
    sights: Sights,
    weights: FloatArray,
    residuals: FloatArray,
    rotation: FloatArray,
    shift: FloatArray,
    current: CameraFrame,
) -> Chance:
    """How many of a camera's features agree with a pose, and how many random matches would.

    A random match agrees when it falls into the ellipse around its landmark's image in which it counts as an inlier: that
    happens with the ellipse's share of the region that the camera's features fill. What is not trusted is no evidence, for a
    pose or against it.
    """
    matches = int((weights > 0).sum())
    if not len(sights.image):
        return Chance(matches, 0, 0, 0.0, 0)
    trusted = sights.trust > TRUSTED
    good = (weights > 0) & trusted
    sigma = np.sqrt(np.mean(residuals[good] ** 2)) / sights.focal if good.any() else 1.0 / sights.focal
    along = smear(sights, rotation, shift)
    region = float(np.prod(np.ptp(current.features.normalized, axis=0)))
    share = np.minimum(np.pi * CUTOFF**2 * sigma * np.hypot(sigma, along) / max(region, 1e-12), 1.0)
    # A feature that is matched with several landmarks is tried once.
    by_chance = float(share[trusted].sum() / max(np.bincount(sights.feature[trusted]).max(initial=0), 1))
    inliers, tried = (
        int(np.count_nonzero(np.bincount(features))) for features in (sights.feature[good], sights.feature[trusted])
    )
    return Chance(matches, inliers, tried, by_chance, 3)


def support_of(sights: Sights, weights: FloatArray, residuals: FloatArray) -> float:
    """How much of a camera's matches a pose explains, by trust and epipolar distances, at a noise that is the same for all
    poses: comparable between poses of the same sights, whatever noise each was fitted with."""
    near = np.maximum(1.0 - (residuals / (CUTOFF * VOTE_PX)) ** 2, 0.0) ** 2
    return float((sights.trust * np.where(weights > 0, near, 0.0)).sum())


def smear(sights: Sights, rotation: FloatArray, shift: FloatArray) -> FloatArray:
    """(n,) by how much one standard deviation of a landmark's depth moves its image, normalised units."""
    ends = [(sights.points + k * sights.depth_error) @ rotation.T + shift - sights.center for k in (0, 1)]
    near, far = (p @ sights.rotation.T for p in ends)
    return np.asarray(np.linalg.norm(near[:, :2] / near[:, 2:] - far[:, :2] / far[:, 2:], axis=1))
