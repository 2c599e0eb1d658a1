"""One camera's landmark observations: for a frame's pose, and how they agree with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import rotation_matrix_of
from sylpose.geometry.robust_loss import SIGMA_OF_MEDIAN
from sylpose.landmarks.alignment import LandmarkMatches
from sylpose.landmarks.camera_terms import CUTOFF, REFERENCE_NOISE_PX
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.rig import Camera
from sylpose.tracking.camera_side.frame import (
    CameraFrame,
    FrameMatches,
    collect_features,
    find_static,
    measure_displacement,
    select_inliers,
)
from sylpose.tracking.joint_side.keyframes import SolvedFrame
from sylpose.tracking.reports import InlierStatistics, LandmarkAges, PoseAgreement

# For one camera: (weights, residuals in pixels) of each of its pairs.
MatchWeights = list[tuple[FloatArray, FloatArray]]

# Weight of a static landmark that never moved, while others move: boxes may contain ten times as much wall as object
# (choice).
STATIC_WEIGHT = 0.005
# Landmarks with less weight, such as young ones among old, do not support a pose (choice).
MIN_EVIDENCE_WEIGHT = 0.06
# Landmarks whose depth is known to this share of the object's radius describe its surface (choice).
SURFACE_DEPTH_SD_RATIO = 0.1
# A landmark has moved with the object if the pose leaves at most this share of its displacement since its first
# observation unexplained (choice).
MAX_UNEXPLAINED_RATIO = 0.5


@dataclass(frozen=True, eq=False)
class LandmarkObservations:
    """One camera's landmark observations in one frame, input to the joint refinement of all poses.

    Attributes:
        landmark_ids: (n,) landmark numbers, unique per camera and object feature.
        normalized: (n, 2) undistorted normalized image points.
        positions: (n, 3) estimated landmark positions, object's frame.
        has_moved: (n,) whether the landmark is known to have moved with the object; otherwise it may be background.
    """

    landmark_ids: IntArray
    normalized: FloatArray
    positions: FloatArray
    has_moved: BoolArray


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
    index = collect_features(pairs)
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
    return count_ages(observations.prior_weight, int(is_moving.sum()), oldest, depth_sd)


def count_ages(frame_counts: FloatArray, n_moving: int = 0, oldest: int = 0, depth_sd: float = np.nan) -> LandmarkAges:
    """Build the histogram from each landmark's number of frames (n,)."""
    counts = np.bincount(frame_counts.astype(np.int64))
    values = np.flatnonzero(counts)
    return LandmarkAges(values.astype(float), counts[values].astype(float), n_moving, oldest, depth_sd)


def expand_ages(ages_by_camera: Sequence[LandmarkAges]) -> FloatArray:
    """Return the sorted ages (n,) of all cameras' landmarks, in frames."""
    values = np.concatenate([ages.values for ages in ages_by_camera])
    return np.sort(np.repeat(values, np.concatenate([ages.counts for ages in ages_by_camera]).astype(np.int64)))


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


def split_by_pair(weights: FloatArray, residuals: FloatArray, pairs: Sequence[FrameMatches]) -> MatchWeights:
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
        return InlierStatistics(matches)
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
    inliers, tried = (_count_unique(observations.feature[chosen]) for chosen in (is_inlier, is_evidence))
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


# --- agreement with a pose ----------------------------------------------------------------------------------------------


def measure_agreement(
    pairs: Sequence[FrameMatches], match_weights: MatchWeights, current: CameraFrame
) -> PoseAgreement:
    """Summarize one camera's agreement with a solution."""
    inliers = select_inliers(pairs, [w for w, _ in match_weights])
    squares = np.concatenate([np.empty(0), *(r[w > 0] ** 2 for w, r in match_weights)])
    indices, tried = collect_features(inliers), collect_features(pairs)
    is_inlier = np.concatenate([np.empty(0, bool), *(w > 0 for w, _ in match_weights)])
    all_landmarks = Landmarks.concatenate([pair.landmarks for pair in pairs])
    inlier_landmarks = all_landmarks.subset(is_inlier)
    is_moving = np.concatenate([np.empty(0, bool), *(~find_static(pair) for pair in inliers)])
    return PoseAgreement(
        n_inlier_matches=len(indices),
        n_matches=len(tried),
        references=tuple(pair.reference for pair in pairs),
        weights=tuple(float(w.sum()) for w, _ in match_weights),
        ages=count_ages(inlier_landmarks.n_observations.astype(float)),
        n_inlier_features=_count_unique(indices),
        n_moved=_count_unique(indices[find_moved(inliers, inlier_landmarks, match_weights, current.static_px)]),
        n_known_moved=_count_unique(tried[all_landmarks.has_moved]),
        residual_px=float(np.sqrt(squares.mean())) if len(squares) else np.nan,
        has_features=len(current.features) > 0,
        n_strong=_count_unique(indices[~current.features.faint[indices]]),
        noise_px=estimate_noise(np.sqrt(squares)),
        n_moving=_count_unique(indices[is_moving]),
        n_features=_count_unique(tried),
    )


def _count_unique(features: IntArray) -> int:
    """Count unique features."""
    return int(np.count_nonzero(np.bincount(features)))


def estimate_noise(residuals: FloatArray) -> float:
    """Estimate the standard deviation of inlier residuals (n,); NaN without any.

    It is the rms, or the median-based estimate if smaller, since a few of many low-contrast features may be far off.
    """
    if not len(residuals):
        return np.nan
    return float(min(np.sqrt(np.mean(residuals**2)), SIGMA_OF_MEDIAN * np.median(np.abs(residuals))))


@dataclass(frozen=True, eq=False)
class ReobservedFeatures:
    """Features of one camera's frame that were observed before.

    Attributes:
        inliers: their matches with earlier frames.
        index: (k,) into the frame's features.
        landmarks: (k) the most certain landmark that each is matched with.
        surface_points: (m, 3) positions of landmarks certain enough to describe the surface.
    """

    inliers: Sequence[FrameMatches]
    index: IntArray
    landmarks: Landmarks
    surface_points: FloatArray

    @classmethod
    def empty(cls) -> ReobservedFeatures:
        """Return an empty set: all features are new."""
        return cls([], np.empty(0, np.int64), Landmarks.empty(), np.empty((0, 3)))

    @classmethod
    def from_matches(
        cls, pairs: Sequence[FrameMatches], match_weights: MatchWeights, static_px: float, radius: float
    ) -> ReobservedFeatures:
        """Build from a frame's matches that agree with its pose.

        A landmark has moved if any landmark matched with its feature has, or if it moves now: it agrees with the pose,
        far from where it was first observed.

        Args:
            match_weights: weights and residuals, pixels, (n,) per pair.
            static_px: smaller displacements may be static.
            radius: of the object.
        """
        inliers = select_inliers(pairs, [w for w, _ in match_weights])
        if not inliers:
            return cls.empty()
        landmarks = Landmarks.concatenate([pair.landmarks for pair in inliers])
        index, sd = collect_features(inliers), landmarks.depth_sd
        # Of equally certain landmarks the oldest is used: rounding, which differs between machines, must not decide.
        order = np.lexsort((landmarks.id, sd.astype(np.float32), index))
        _, first = np.unique(index[order], return_index=True)
        pick = order[first]
        has_moved = find_moved(inliers, landmarks, match_weights, static_px)
        has_feature_moved = np.zeros(int(index.max()) + 1, bool)
        np.logical_or.at(has_feature_moved, index, has_moved)
        # The origin is that of the oldest landmark matched with the feature.
        best = replace(
            landmarks.subset(pick),
            has_moved=has_feature_moved[index[pick]],
            origin=_find_oldest_origins(index, landmarks)[index[pick]],
        )
        return cls(inliers, index[pick], best, best.mean[sd[pick] < SURFACE_DEPTH_SD_RATIO * radius])


def find_moved(
    inliers: Sequence[FrameMatches], landmarks: Landmarks, match_weights: MatchWeights, static_px: float
) -> BoolArray:
    """Return which inlier matches (n,) are known not to be background.

    Their landmark, `landmarks` (n), has moved before or moves now.

    Args:
        match_weights, static_px: as in `ReobservedFeatures.from_matches`.
    """
    residual = np.concatenate([np.empty(0), *(np.abs(r[w > 0]) for w, r in match_weights)])
    displacement = measure_displacement(
        landmarks, np.concatenate([np.empty((0, 2)), *(pair.pixels_j for pair in inliers)])
    )
    return np.asarray(
        landmarks.has_moved | ((displacement > static_px) & (residual < MAX_UNEXPLAINED_RATIO * displacement))
    )


def _find_oldest_origins(index: IntArray, landmarks: Landmarks) -> FloatArray:
    """Return for each feature (m, 2) the origin of its oldest matched landmark.

    Args:
        index: (n,) feature of each landmark in `landmarks`.
    """
    origin = np.zeros((int(index.max()) + 1, 2))
    order = np.argsort(-landmarks.id, kind="stable")
    origin[index[order]] = landmarks.origin[order]
    return origin


def select_shown_matches(
    inliers: Sequence[FrameMatches], current: CameraFrame, previous: int, previous_pixels: FloatArray | None
) -> tuple[FloatArray, FloatArray] | None:
    """Return one camera's inliers against the last solved frame, for `TrackedFrame.matches`.

    Args:
        inliers: matches with earlier frames that agree with the pose.
        current: the camera's current frame.
        previous: the last solved frame's number.
        previous_pixels: (m, 2) pixels of the first m features in that frame, if they were tracked by KLT.
    """
    if previous_pixels is not None:
        index = np.unique(collect_features(inliers))
        index = index[index < len(previous_pixels)]
        index = index[np.isfinite(previous_pixels[index]).all(axis=1)]
        return previous_pixels[index], current.features.pixels[index]
    with_previous = [pair for pair in inliers if pair.reference == previous]
    return (with_previous[0].pixels_i, with_previous[0].pixels_j) if with_previous else None


def record_observations(inliers: Sequence[FrameMatches], current: CameraFrame) -> LandmarkObservations:
    """Collect one camera's observations: inlier features and newly observed ones."""
    landmarks = current.landmarks
    index = np.union1d(collect_features(inliers), np.flatnonzero(landmarks.n_observations == 1))
    return LandmarkObservations(
        landmarks.id[index], current.features.normalized[index], landmarks.mean[index], landmarks.has_moved[index]
    )
