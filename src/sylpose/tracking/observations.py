"""One camera's landmark observations for a frame's pose, with weights and statistics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.rigid import rotation_matrix_of
from sylpose.landmarks.alignment import LandmarkMatches
from sylpose.landmarks.camera_terms import CUTOFF, REFERENCE_NOISE_PX
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.rig import Camera
from sylpose.tracking.frame import CameraFrame, FrameMatches, SolvedFrame, measure_displacement
from sylpose.tracking.reports import InlierStatistics, LandmarkAges

__all__ = [
    "STATIC_WEIGHT",
    "build_observations",
    "compute_depth_smear",
    "compute_full_weight_age",
    "compute_inlier_statistics",
    "compute_support",
    "split_by_pair",
    "summarize_ages",
    "weight_observations",
]

# Weight of a static landmark that never moved, while others move: boxes may contain ten times as much wall as object
# (choice).
STATIC_WEIGHT = 0.005
# Landmarks with less weight, such as young ones among old, do not support a pose (choice).
MIN_EVIDENCE_WEIGHT = 0.06


def build_observations(
    camera: Camera, pairs: Sequence[FrameMatches], current: CameraFrame, previous: SolvedFrame
) -> tuple[LandmarkMatches, BoolArray]:
    """Build a camera's landmark observations relative to the object's last pose.

    Args:
        camera: with its pose at this frame.
        pairs: matches with earlier frames.

    Returns:
        the observations, with the number of frames of each landmark in place of its weight; (n,) whether the landmark
        has moved with the object or is displaced from where it was first observed.
    """
    landmarks = Landmarks.concatenate([pair.landmarks for pair in pairs])
    index = np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 1] for pair in pairs)])
    rotation, center = rotation_matrix_of(previous.world_from_object), previous.world_from_object.translation
    points, error = landmarks.mean @ rotation.T, landmarks.depth_error @ rotation.T
    outwards = np.sign(np.einsum("ni,ni->n", error, points + center - camera.center))
    # Age of each feature in frames: that of its oldest landmark.
    frame_counts = np.zeros(int(index.max(initial=-1)) + 1)
    np.maximum.at(frame_counts, index, landmarks.n_observations)
    is_moving = (
        measure_displacement(landmarks, current.features.pixels[index]) > current.static_px
    ) | landmarks.has_moved
    observations = LandmarkMatches(
        points=points,
        depth_error=error * outwards[:, None],
        image=current.features.normalized[index],
        feature=index,
        prior_weight=frame_counts[index],
        rotation=camera.rotation,
        center=camera.center - center,
        focal=camera.focal,
    )
    return observations, is_moving


def summarize_ages(observations: LandmarkMatches, is_moving: BoolArray, pairs: Sequence[FrameMatches]) -> LandmarkAges:
    """Summarize the ages of the landmarks of `build_observations`."""
    oldest = max(
        (int(pair.earlier.table.observation_counts(pair.earlier.landmark_ids).max(initial=0)) for pair in pairs),
        default=0,
    )
    depth_sd = (
        float(np.median(np.linalg.norm(observations.depth_error, axis=1))) if len(observations.prior_weight) else np.nan
    )
    return LandmarkAges.from_frame_counts(observations.prior_weight, int(is_moving.sum()), oldest, depth_sd)


def compute_full_weight_age(ages: FloatArray) -> float:
    """Return the age in frames at which a landmark gets full weight, from all ages (n,)."""
    return float(np.quantile(ages, 0.75)) if len(ages) else 1.0


def weight_observations(
    observations: LandmarkMatches, is_moving: BoolArray, full_weight_age: float, static_weight: float
) -> LandmarkMatches:
    """Replace the ages in the observations of `build_observations` by weights.

    Landmarks that have long moved with the object get more weight than new ones (on a hand, for example).

    Args:
        full_weight_age: age of full weight.
        static_weight: factor for static landmarks that never moved.
    """
    return replace(
        observations,
        prior_weight=np.minimum(observations.prior_weight / full_weight_age, 1.0) ** 2
        * np.where(is_moving, 1.0, static_weight),
    )


def split_by_pair(
    weights: FloatArray, residuals: FloatArray, pairs: Sequence[FrameMatches]
) -> list[tuple[FloatArray, FloatArray]]:
    """Split the weights and residuals (n,) of a camera's observations by pair."""
    cuts = np.cumsum([len(pair) for pair in pairs])[:-1]
    return list(zip(np.split(weights, cuts), np.split(residuals, cuts), strict=True)) if len(pairs) else []


def compute_inlier_statistics(
    observations: LandmarkMatches,
    weights: FloatArray,
    residuals: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    current: CameraFrame,
) -> InlierStatistics:
    """Count a camera's features that agree with a pose, and those expected by chance.

    A random match agrees when it falls into the inlier ellipse around its landmark's projection. The probability is the
    ellipse's share of the region covered by the camera's features. Landmarks of low weight are not counted.
    """
    matches = int((weights > 0).sum())
    if not len(observations.image):
        return InlierStatistics(matches, 0, 0, 0.0, 0)
    is_evidence = observations.prior_weight > MIN_EVIDENCE_WEIGHT
    is_inlier = (weights > 0) & is_evidence
    sigma = (
        np.sqrt(np.mean(residuals[is_inlier] ** 2)) / observations.focal
        if is_inlier.any()
        else 1.0 / observations.focal
    )
    along = compute_depth_smear(observations, rotation, translation)
    region = float(np.prod(np.ptp(current.features.normalized, axis=0)))
    share = np.minimum(np.pi * CUTOFF**2 * sigma * np.hypot(sigma, along) / max(region, 1e-12), 1.0)
    # A feature matched with several landmarks is counted once.
    expected_by_chance = float(
        share[is_evidence].sum() / max(np.bincount(observations.feature[is_evidence]).max(initial=0), 1)
    )
    inliers, tried = (
        int(np.count_nonzero(np.bincount(features)))
        for features in (observations.feature[is_inlier], observations.feature[is_evidence])
    )
    return InlierStatistics(matches, inliers, tried, expected_by_chance, 3)


def compute_support(observations: LandmarkMatches, weights: FloatArray, residuals: FloatArray) -> float:
    """Return the weighted number of matches that agree with a pose by epipolar distance.

    The noise level is fixed, so values are comparable between poses of the same observations, whatever noise each was
    fitted with.
    """
    near = np.maximum(1.0 - (residuals / (CUTOFF * REFERENCE_NOISE_PX)) ** 2, 0.0) ** 2
    return float((observations.prior_weight * np.where(weights > 0, near, 0.0)).sum())


def compute_depth_smear(observations: LandmarkMatches, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return the image motion (n,) for one standard deviation of a landmark's depth, normalized units."""
    ends = [
        (observations.points + k * observations.depth_error) @ rotation.T + translation - observations.center
        for k in (0, 1)
    ]
    near, far = (p @ observations.rotation.T for p in ends)
    return np.asarray(np.linalg.norm(near[:, :2] / near[:, 2:] - far[:, :2] / far[:, 2:], axis=1))
