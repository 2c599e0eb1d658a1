"""One camera's data of a frame: features, the object's region, matches with earlier frames, landmark observations.

The region is the projection of a point cloud that fills the object.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import gammaln

from sylpose.features.patches import find_unmoved
from sylpose.features.sift import Features, match_features, match_guided
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import rotation_matrix_of
from sylpose.geometry.robust_loss import SIGMA_OF_MEDIAN, SIGNIFICANCE, chi_squared_bound
from sylpose.landmarks.alignment import AlignmentResult, LandmarkMatches
from sylpose.landmarks.camera_terms import CUTOFF, REFERENCE_NOISE_PX
from sylpose.landmarks.landmark_filter import KNOWN_DEPTH_RATIO, Landmarks, LandmarkTable
from sylpose.matches import MAX_STATIC_PX, STATIC_PX
from sylpose.relative_pose.camera_evidence import CLOCK_SD_FRAMES, CameraEvidence, compare_motions
from sylpose.relative_pose.camera_evidence import MIN_MATCHES as MIN_EVIDENCE_MATCHES
from sylpose.relative_pose.limits import CUTOFF as OUTLIER_SDS
from sylpose.relative_pose.limits import MIN_ERROR_PX, MISMATCH_PROBABILITY
from sylpose.relative_pose.second_motion import MIN_OUTLIER_RATIO
from sylpose.relative_pose.terms import MIN_MATCHES, TermData
from sylpose.rig import Camera
from sylpose.tracking.joint_side.joint_state import KnownMotion, SolvedFrame
from sylpose.tracking.reports import InlierStatistics, LandmarkAges, PoseAgreement

# Half length of a landmark's search range, in standard deviations of its depth (chi-squared, once in a thousand times).
DEPTH_SEARCH_SDS = float(np.sqrt(chi_squared_bound(1)))
# Points are added to the object's cloud once their depth is known to this relative precision (choice).
MAX_RELATIVE_DEPTH_SD = 0.1
# An outline (k, 2) in pixels; None: out of view.
Region = FloatArray | None
# Margin of the object's search region, as a share of its size in the image (choice).
REGION_MARGIN = 0.15
# Search radius around a landmark's projection, as a share of the object's radius in the image: at a predicted pose, and at a
# solved one (choice).
PREDICTED_RADIUS, SOLVED_RADIUS = 0.15, 0.03
# Directions in which an outline is dilated (choice).
DILATION_DIRECTIONS = np.array([[np.cos(angle), np.sin(angle)] for angle in np.linspace(0, 2 * np.pi, 9)[:-1]])
# Default arrays.
_no_pixels = partial(np.empty, (0, 2))
_no_indices: Callable[[], IntArray] = partial(np.array, [], np.int64)
# For one camera: (weights, residuals in pixels) of each of its pairs.
MatchWeights = list[tuple[FloatArray, FloatArray]]
# Weight of a static landmark that never moved, while others move: where the object has no more matches than the least share
# by which a camera sees a body, all static ones together weigh as much as the usual mismatches (derived).
STATIC_WEIGHT = MIN_OUTLIER_RATIO * MISMATCH_PROBABILITY
# An inlier share this large does not occur by chance; at 0.7 another body in the same place is tracked (measured:
# tests/tracking/test_disturbed.py) (choice).
MIN_CERTAIN_INLIER_RATIO = 0.8
# More than this share is most: of a landmark's displacement, which has to be explained by the object's motion, and of the
# weight of features, which noise reduces (choice).
MAJORITY = 0.5


def project_outline(camera: Camera, points: FloatArray, margin_ratio: float) -> Region:
    """Return the dilated outline of world points in a camera's image.

    Args:
        points: (n, 3) world.
        margin_ratio: margin on every side, as a share of the outline's longer side; at least 12 pixels.

    Returns:
        (k, 2) pixels, convex; None if the points are out of view.
    """
    pixels = camera.project(points)
    size = np.array(camera.size)
    # Lens models fold back far outside the image: projections there are invalid.
    pixels = pixels[((pixels > -size) & (pixels < 2 * size)).all(axis=1)]
    if len(pixels) < 3:
        return None
    outline = widen_outline(pixels, margin_ratio)
    return None if (outline.max(axis=0) < 0).any() or (outline.min(axis=0) > size - 1).any() else outline


def widen_outline(pixels: FloatArray, margin_ratio: float) -> FloatArray:
    """Return the dilated convex outline (k, 2) of pixels (n, 2); the margin is as in `project_outline`."""
    margin = max(12.0, margin_ratio * float(np.ptp(pixels, axis=0).max()))
    hull = cv2.convexHull(pixels.astype(np.float32)).reshape(-1, 2)
    widened = (hull[:, None] + margin * DILATION_DIRECTIONS).reshape(-1, 2).astype(np.float32)
    return np.asarray(cv2.convexHull(widened).reshape(-1, 2), dtype=float)


def rasterize_outline(outline: Region, size: tuple[int, int]) -> BoolArray:
    """Return a mask (h, w), True inside the outline (k, 2); all False without one."""
    mask = np.zeros((size[1], size[0]), np.uint8)
    if outline is not None:
        cv2.fillConvexPoly(mask, np.round(outline).astype(np.int32), 1)
    return mask.astype(bool)


@dataclass(eq=False)
class CameraFrame:
    """One camera's data of one frame, never shared with other cameras.

    Attributes:
        features: of its image.
        background: (n,) which features were static where the object moved; filled in during matching.
        table: the camera's landmarks.
        landmark_ids: (n,) the features' landmarks in it, once the frame is solved.
        noise_px: of the camera's keypoints, pixels; 0: unknown.
    """

    features: Features
    background: BoolArray
    table: LandmarkTable
    landmark_ids: IntArray = field(default_factory=_no_indices)
    noise_px: float = 0.0

    @property
    def static_px(self) -> float:
        """Keypoints displaced by less than this may be static, pixels."""
        return compute_keypoint_static_px(self.noise_px)

    @property
    def landmarks(self) -> Landmarks:
        """(n) landmarks of the features, as estimated so far."""
        return self.table.get(self.landmark_ids)

    def append(self, new: CameraFrame) -> CameraFrame:
        """Return the solved frame with more features."""
        features = Features.concatenate([self.features, new.features])
        background = np.concatenate([self.background, new.background])
        ids = np.concatenate([self.landmark_ids, new.landmark_ids])
        return CameraFrame(features, background, self.table, ids, self.noise_px)


@dataclass(frozen=True, eq=False)
class FrameMatches:
    """One camera's matches between an earlier frame and the current one.

    Attributes:
        reference: the earlier frame's number.
        earlier: the camera's data of it.
        indices: (n, 2) into the earlier and the current frame's features.
        pixels_i, pixels_j: (n, 2) as recorded.
        normalized_i, normalized_j: (n, 2).
        is_unmoved: (n,) whether the later image shows the same at the earlier position (`features.patches`).
    """

    reference: int
    earlier: CameraFrame
    indices: IntArray
    pixels_i: FloatArray
    pixels_j: FloatArray
    normalized_i: FloatArray
    normalized_j: FloatArray
    is_unmoved: BoolArray

    @classmethod
    def from_indices(cls, reference: int, earlier: CameraFrame, later: Features, indices: IntArray) -> FrameMatches:
        """Build the matches from feature indices (n, 2)."""
        a, (i, j) = earlier.features, indices.T
        is_unmoved = find_unmoved(a.patches[i], a.pixels[i], later.patches[j], later.pixels[j])
        points = a.pixels[i], later.pixels[j], a.normalized[i], later.normalized[j]
        return cls(reference, earlier, indices, *points, is_unmoved)

    def __len__(self) -> int:
        return len(self.indices)

    def subset(self, mask: BoolArray) -> FrameMatches:
        """Return the matches where the mask (n,) is True."""
        rows = np.flatnonzero(mask)
        points = self.pixels_i, self.pixels_j, self.normalized_i, self.normalized_j
        pixels_i, pixels_j, normalized_i, normalized_j = (own.take(rows, axis=0) for own in points)
        indices, is_unmoved = self.indices.take(rows, axis=0), self.is_unmoved[rows]
        return FrameMatches(
            self.reference, self.earlier, indices, pixels_i, pixels_j, normalized_i, normalized_j, is_unmoved
        )

    @property
    def landmarks(self) -> Landmarks:
        """(n) landmarks of the matches, from the earlier frame."""
        return self.earlier.table.get(self.earlier.landmark_ids[self.indices[:, 0]])

    def to_term(self, index: int, camera: Camera, previous_from_reference: RigidTransform | None = None) -> TermData:
        """Return the matches as a term of a motion estimate.

        Args:
            index: of the camera in the rig.
            camera: its calibration.
            previous_from_reference: motion of the object from the earlier frame to the frame that the estimated motion
                starts from; None if both are the same frame.
        """
        x, y = self.normalized_i, self.normalized_j
        return TermData(index, x, y, camera.rotation, camera.center, camera.focal, previous_from_reference)


# One camera's matches with several earlier frames; those of the local cameras.
Pairs = Sequence[FrameMatches]
CameraPairs = Sequence[Pairs]


@dataclass(frozen=True, eq=False)
class DetectedFeatures:
    """A camera's detected features in a frame, pixels.

    Attributes:
        features: (n, 2) all features.
        rejected: (m, 2) features that match known landmarks but do not agree with the pose, or without a pose.
    """

    features: FloatArray = field(default_factory=_no_pixels)
    rejected: FloatArray = field(default_factory=_no_pixels)


def collect_detected_features(
    features: Features, pairs: Pairs = (), weights: Sequence[FloatArray] | None = None
) -> DetectedFeatures:
    """Collect a frame's detected and rejected features.

    Args:
        pairs: matches with earlier frames.
        weights: (n,) per pair, of its matches in the pose; None without a pose.
    """
    is_matched, is_inlier = np.zeros(len(features), bool), np.zeros(len(features), bool)
    for k, pair in enumerate(pairs):
        is_matched[pair.indices[:, 1]] = True
        if weights is not None:
            is_inlier[pair.indices[weights[k] > 0, 1]] = True
    return DetectedFeatures(features.pixels, features.pixels[is_matched & ~is_inlier])


def match_frames(
    reference: int, earlier: CameraFrame, current: CameraFrame, indices: IntArray | None = None
) -> FrameMatches:
    """Match one camera's features with those of an earlier frame, without its known background.

    The background is passed on to the current frame.

    Args:
        indices: (m, 2) matches of features, if already known.
    """
    a, b = earlier.features, current.features
    matches = FrameMatches.from_indices(reference, earlier, b, match_features(a, b) if indices is None else indices)
    i, j = matches.indices.T
    current.background[j[earlier.background[i] & find_static(matches, current.noise_px)]] = True
    return matches.subset(~earlier.background[i] & ~current.background[j])


class SearchArea(NamedTuple):
    """Where landmarks are searched in a frame.

    Attributes:
        pose: world_from_object, of the frame.
        radius_px: search radius, pixels, in addition to the range left open by the landmarks' depth.
        offset_px: offset of the search from the projections; with an offset, matches are found by chance only.
    """

    pose: RigidTransform
    radius_px: float
    offset_px: tuple[float, float] = (0.0, 0.0)


def match_near_pose(
    reference: int, earlier: CameraFrame, current: CameraFrame, camera: Camera, area: SearchArea
) -> FrameMatches:
    """Match the earlier frame's landmarks with features near their projections."""
    landmarks = earlier.landmarks
    depth_offsets = DEPTH_SEARCH_SDS * landmarks.depth_error
    points = [area.pose.apply(landmarks.mean + s * depth_offsets).reshape(-1, 3) for s in (-1, 1)]
    ends = np.stack([camera.project(own) for own in points], axis=1)
    ends[earlier.background] = np.nan
    indices = match_guided(earlier.features, current.features, ends + np.array(area.offset_px), area.radius_px)
    return FrameMatches.from_indices(reference, earlier, current.features, indices[~current.background[indices[:, 1]]])


def collect_features(pairs: Pairs) -> IntArray:
    """Return the current frame's feature (n,) of each match."""
    return np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 1] for pair in pairs)])


def omit_empty(pairs: Iterable[FrameMatches]) -> list[FrameMatches]:
    """Return the pairs that have matches."""
    return [pair for pair in pairs if len(pair)]


def select_inliers(pairs: Pairs, weights: Sequence[FloatArray]) -> list[FrameMatches]:
    """Select each pair's inliers, given its weights; omit pairs without any."""
    return omit_empty(pair.subset(w > 0) for pair, w in zip(pairs, weights, strict=True))


def compute_static_px(noise_px: float) -> float:
    """Return the displacement, pixels, below which features of this noise are static: inliers of no motion."""
    return min(OUTLIER_SDS * max(noise_px, MIN_ERROR_PX), MAX_STATIC_PX)


def compute_keypoint_static_px(noise_px: float) -> float:
    """Return the displacement, pixels, below which keypoints may be static: they scatter more than tracked features."""
    return max(compute_static_px(noise_px), STATIC_PX)


def find_static(pair: FrameMatches, noise_px: float = 0.0) -> BoolArray:
    """Return which matches (n,) are static in the image, at most displaced by noise of this standard deviation."""
    displacement = np.linalg.norm(pair.pixels_i - pair.pixels_j, axis=1)
    return np.asarray((displacement < compute_static_px(noise_px)) | pair.is_unmoved)


def measure_displacement(landmarks: Landmarks, pixels: FloatArray) -> FloatArray:
    """Return each landmark's distance (n,) from its first observed pixel to its current one (n, 2)."""
    return np.asarray(np.linalg.norm(pixels - landmarks.origin, axis=1))


def find_background(pair: FrameMatches, current: CameraFrame, camera: Camera, motion: KnownMotion) -> BoolArray:
    """Return which matches (n,) are static where a point on the object moved."""
    is_background = find_static(pair, current.noise_px)
    at = np.flatnonzero(is_background)
    moved = _min_motion_px(pair, at, camera, motion)
    is_background[at] = moved > 2.0 * compute_static_px(current.noise_px)
    return is_background


def drop_background(pairs: Pairs, current: CameraFrame, camera: Camera, motion: KnownMotion) -> list[FrameMatches]:
    """Remove static, never moved matches where a point on the object would have moved; omit pairs without others.

    They are marked as background as in `mark_background`, before the pose is known.

    Args:
        motion: predicted motion. An object that stops instead is still tracked by landmarks that have moved.
    """
    remaining = []
    for pair in pairs:
        background = find_background(pair, current, camera, motion) & ~pair.landmarks.has_moved
        mark_background(pair, current, background)
        remaining.append(pair.subset(~background))
    return omit_empty(remaining)


def mark_background(pair: FrameMatches, current: CameraFrame, is_background: BoolArray) -> None:
    """Mark matches (n,) as background in both frames."""
    pair.earlier.background[pair.indices[is_background, 0]] = True
    current.background[pair.indices[is_background, 1]] = True


def mark_others_as_background(pairs: Pairs, current: CameraFrame) -> None:
    """Mark all features of a frame except those of the given matches as background."""
    current.background[np.setdiff1d(np.arange(len(current.features)), collect_features(pairs))] = True


def _min_motion_px(pair: FrameMatches, at: IntArray, camera: Camera, motion: KnownMotion) -> FloatArray:
    """Return the least image motion (m,) of points on the object at some matches (m,), over its depth range, pixels."""
    pixels, normalized, radius = pair.pixels_i[at], pair.normalized_i[at], motion.radius
    pose_i = motion.earlier[pair.reference]
    middle = camera.camera_from_world.apply(pose_i.translation)[2]
    moves = motion.pose.as_matrix() @ pose_i.inv().as_matrix() @ camera.camera_from_world.inv().as_matrix()
    along = np.column_stack([normalized, np.ones(len(normalized))]) @ moves[:3, :3].T
    moved = np.full(len(pixels), np.inf)
    for depth in (middle - radius, middle, middle + radius):
        expected = camera.project(max(depth, 0.1 * middle) * along + moves[:3, 3])
        moved = np.fmin(moved, np.linalg.norm(expected - pixels, axis=1))
    return moved


def triangulate(pair: FrameMatches, camera: Camera, pose_i: RigidTransform, pose_j: RigidTransform) -> FloatArray:
    """Triangulate matches whose depth is well determined, (m, 3) in the object's frame.

    Two views of a moving object by one camera equal two views of a static object by a moving camera.

    Args:
        pose_i, pose_j: world_from_object.
    """
    object_from_world_i, object_from_world_j = pose_i.inv(), pose_j.inv()
    start, end = object_from_world_i.apply(camera.center), object_from_world_j.apply(camera.center)
    ones = np.ones((len(pair), 1))
    u = object_from_world_i.rotation.apply(np.hstack([pair.normalized_i, ones]) @ camera.rotation)
    v = object_from_world_j.rotation.apply(np.hstack([pair.normalized_j, ones]) @ camera.rotation)
    # Depths s, t with start + s u nearest to end + t v.
    across = np.cross(u, v)
    square = (across**2).sum(axis=1)
    sine = np.sqrt(square) / (np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1))
    good = sine > 1.0 / (MAX_RELATIVE_DEPTH_SD * camera.focal)  # relative depth error: one pixel over the sine
    offset = end - start
    s = np.einsum("ni,ni->n", np.cross(offset, v[good]), across[good]) / square[good]
    return np.asarray((start + s[:, None] * u[good])[s > 0])


# --- observations of landmarks ----------------------------------------------------------------------------------------


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
    camera: Camera, pairs: Pairs, current: CameraFrame, previous: SolvedFrame
) -> tuple[LandmarkMatches, BoolArray, LandmarkAges]:
    """Build a camera's landmark observations relative to the object's last pose.

    Args:
        camera: with its pose at this frame.
        pairs: matches with earlier frames.

    Returns:
        the observations, with the number of frames of each landmark in place of its weight; (n,) whether the landmark
        has moved with the object or is displaced from where it was first observed; a summary of the landmarks' ages.
    """
    index = collect_features(pairs)
    landmarks = Landmarks.concatenate([pair.landmarks for pair in pairs])
    rotation, center = rotation_matrix_of(previous.world_from_object), previous.world_from_object.translation
    points, error = landmarks.mean @ rotation.T, landmarks.depth_error @ rotation.T
    outwards = np.sign(np.einsum("ni,ni->n", error, points + center - camera.center))
    # Age of each feature in frames: that of its oldest landmark.
    frame_counts = np.zeros(int(index.max(initial=-1)) + 1)
    np.maximum.at(frame_counts, index, landmarks.n_observations)
    displacement = measure_displacement(landmarks, current.features.pixels[index])
    is_moving = (displacement > current.static_px) | landmarks.has_moved
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
    depth_sd = float(np.median(np.linalg.norm(observations.depth_error, axis=1))) if len(index) else np.nan
    ages = count_ages(observations.prior_weight, int(is_moving.sum()), depth_sd)
    return observations, is_moving, ages


# --- ages of landmarks ------------------------------------------------------------------------------------------------


def count_ages(frame_counts: FloatArray, n_moving: int = 0, depth_sd: float = np.nan) -> LandmarkAges:
    """Build the histogram from each landmark's number of frames (n,)."""
    counts = np.bincount(frame_counts.astype(np.int64))
    values = np.flatnonzero(counts)
    return LandmarkAges(values.astype(float), counts[values].astype(float), n_moving, depth_sd)


def expand_ages(ages_by_camera: Sequence[LandmarkAges]) -> FloatArray:
    """Return the sorted ages (n,) of all cameras' landmarks, in frames."""
    values = np.concatenate([ages.values for ages in ages_by_camera])
    return np.sort(np.repeat(values, np.concatenate([ages.counts for ages in ages_by_camera]).astype(np.int64)))


def compute_full_weight_age(ages_by_camera: Sequence[LandmarkAges]) -> float:
    """Return the age in frames at which a landmark gets full weight, from the ages of all cameras' landmarks."""
    ages = expand_ages(ages_by_camera)
    return float(np.quantile(ages, 0.75)) if len(ages) else 1.0


def has_enough_motion(ages_by_camera: Sequence[LandmarkAges]) -> bool:
    """Return whether enough landmarks have moved for static ones to be background.

    At least two cameras must see it, if there are two, since something may pass in front of one.
    """
    total = [float(ages.counts.sum()) for ages in ages_by_camera]
    seeing = [ages.n_moving for ages, n in zip(ages_by_camera, total, strict=True) if n >= MIN_MATCHES]
    cameras = sum(2 * moving >= MIN_MATCHES for moving in seeing)
    # Half of what moves may be mismatches.
    return sum(seeing) >= max(MIN_MATCHES, 2 * MISMATCH_PROBABILITY * sum(total)) and cameras >= min(2, len(seeing))


# --- agreement with a pose ----------------------------------------------------------------------------------------------


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


def split_by_pair(weights: FloatArray, residuals: FloatArray, pairs: Pairs) -> MatchWeights:
    """Split the weights and residuals (n,) of a camera's observations by pair."""
    cuts = np.cumsum([len(pair) for pair in pairs])[:-1]
    return list(zip(np.split(weights, cuts), np.split(residuals, cuts), strict=True)) if len(pairs) else []


def compute_inlier_statistics(
    observations: LandmarkMatches,
    weights: FloatArray,
    residuals: FloatArray,
    pose: AlignmentResult,
    current: CameraFrame,
) -> InlierStatistics:
    """Count a camera's features that agree with a pose, and those expected by chance.

    A random match agrees when it falls into the inlier ellipse around its landmark's projection. The probability is the
    ellipse's share of the region covered by the camera's features. Landmarks of low weight are not counted.
    """
    matches = int((weights > 0).sum())
    if not len(observations.image):
        return InlierStatistics(matches)
    # Landmarks with less weight, such as young ones among old, do not support a pose.
    is_evidence = observations.prior_weight > MISMATCH_PROBABILITY
    is_inlier = (weights > 0) & is_evidence
    sigma = (
        np.sqrt(np.mean(residuals[is_inlier] ** 2)) / observations.focal
        if is_inlier.any()
        else 1.0 / observations.focal
    )
    along = compute_depth_smear(observations, pose.rotation, pose.translation)
    region = float(np.prod(np.ptp(current.features.normalized, axis=0)))
    share = np.minimum(np.pi * CUTOFF**2 * sigma * np.hypot(sigma, along) / max(region, 1e-12), 1.0)
    # A feature matched with several landmarks is counted once.
    expected_by_chance = float(
        share[is_evidence].sum() / max(np.bincount(observations.feature[is_evidence]).max(initial=0), 1)
    )
    inliers, tried = (_count_unique(observations.feature[chosen]) for chosen in (is_inlier, is_evidence))
    return InlierStatistics(matches, inliers, tried, expected_by_chance, 3)


def is_explained_by_chance(statistics: Sequence[InlierStatistics]) -> bool:
    """Return whether random matches would agree with a pose about as often.

    The number of false alarms is the expected number of choices of inliers, and of as many of them as there are unknowns
    (the pose's and those of each camera's depth model), with which all other inliers agree by chance. A match that is on its
    epipolar line determines one unknown.

    Source: Moisan & Stival, a contrario RANSAC, 2004.
    """
    inliers, tried = sum(one.n_inlier_features for one in statistics), sum(one.n_features for one in statistics)
    if inliers >= MIN_CERTAIN_INLIER_RATIO * tried:
        return False
    n_unknowns = 6 + sum(one.n_unknowns for one in statistics)
    # As many inliers as unknowns can be selected, and as many again.
    if inliers <= 2 * n_unknowns:
        return True
    # The logarithm of the multinomial coefficient: rejected matches, inliers that determine the pose, other inliers.
    choices = gammaln(tried + 1) - gammaln([tried - inliers + 1, n_unknowns + 1, inliers - n_unknowns + 1]).sum()
    expected = max(sum(one.expected_by_chance for one in statistics), 1e-12)
    return not choices + (inliers - n_unknowns) * np.log(expected / tried) <= np.log(SIGNIFICANCE)


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


def measure_agreement(pairs: Pairs, match_weights: MatchWeights, current: CameraFrame) -> PoseAgreement:
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
        residual_px=float(np.sqrt(squares.mean())) if len(squares) else np.nan,
        has_features=len(current.features) > 0,
        n_strong=_count_unique(indices[~current.features.faint[indices]]),
        noise_px=estimate_noise(np.sqrt(squares)),
        n_moving=_count_unique(indices[is_moving]),
        n_features=_count_unique(tried),
    )


def add_evidence(
    agreement: PoseAgreement,
    pairs: Pairs,
    current: CameraFrame,
    camera: Camera,
    c: int,
    solved: SolvedFrame,
    known_frames: Mapping[int, SolvedFrame],
) -> PoseAgreement:
    """Compare a camera's own motion with that of a pose, from the earlier frame since which its features moved most.

    Static matches are no evidence: they may be background, whose own motion is none.

    Args:
        agreement: with the pose, without evidence.
        pairs: the camera's matches with earlier frames, inliers or not.
        current: its data of the frame.
        camera, c: as calibrated, and its index.
        solved: the frame with its pose.
        known_frames: the earlier frames by number.
    """
    pose = solved.camera_from_object(camera, c)
    earlier = {pair.reference: known_frames[pair.reference].camera_from_object(camera, c) for pair in pairs}
    moving = [
        pair.subset(~find_static(pair, current.noise_px)) for pair in pairs if earlier[pair.reference] is not None
    ]
    usable = [pair for pair in moving if len(pair) >= MIN_EVIDENCE_MATCHES]
    if pose is None or not usable:
        return agreement
    # About the sum of squared displacements: patterns that repeat have mismatches that are a period long.
    moved = [len(pair) * np.median(((pair.pixels_j - pair.pixels_i) ** 2).sum(axis=1)) for pair in usable]
    pair = usable[int(np.argmax(moved))]
    first = earlier[pair.reference]
    assert first is not None
    rotation = pose[:3, :3] @ first[:3, :3].T
    translation = (pose[:3, 3] - rotation @ first[:3, 3]) / np.linalg.norm(first[:3, 3])
    # No clock ran from another recording to this one.
    is_known_object = known_frames[pair.reference].is_fixed
    share_sd = 0.0 if is_known_object else CLOCK_SD_FRAMES / abs(solved.number - pair.reference)
    compared = compare_motions(pair.normalized_i, pair.normalized_j, camera.focal, rotation, translation, share_sd)
    evidence = CameraEvidence(*compared)
    return replace(agreement, evidence=evidence, evidence_reference=pair.reference if evidence.n else -1)


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

    inliers: Pairs
    index: IntArray
    landmarks: Landmarks
    surface_points: FloatArray

    @classmethod
    def empty(cls) -> ReobservedFeatures:
        """Return an empty set: all features are new."""
        return cls([], np.empty(0, np.int64), Landmarks.empty(), np.empty((0, 3)))

    @classmethod
    def from_matches(
        cls, pairs: Pairs, match_weights: MatchWeights, static_px: float, radius: float
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
        return cls(inliers, index[pick], best, best.mean[sd[pick] < KNOWN_DEPTH_RATIO * radius])

    def omit_new_features(self, current: CameraFrame) -> tuple[ReobservedFeatures, CameraFrame]:
        """Return these features, and the frame without any others; the landmarks remain as they are."""
        indices = [np.searchsorted(self.index, pair.indices[:, 1]) for pair in self.inliers]
        inliers = [
            replace(pair, indices=np.column_stack([pair.indices[:, 0], index]))
            for pair, index in zip(self.inliers, indices, strict=True)
        ]
        features, background = current.features.subset(self.index), current.background[self.index]
        known = CameraFrame(features, background, current.table, self.landmarks.id, current.noise_px)
        return replace(self, inliers=inliers, index=np.arange(len(self.index))), known


def find_moved(inliers: Pairs, landmarks: Landmarks, match_weights: MatchWeights, static_px: float) -> BoolArray:
    """Return which inlier matches (n,) are known not to be background.

    Their landmark, `landmarks` (n), has moved before or moves now.

    Args:
        match_weights, static_px: as in `ReobservedFeatures.from_matches`.
    """
    residual = np.concatenate([np.empty(0), *(np.abs(r[w > 0]) for w, r in match_weights)])
    displacement = measure_displacement(
        landmarks, np.concatenate([np.empty((0, 2)), *(pair.pixels_j for pair in inliers)])
    )
    is_unmoved = np.concatenate([np.empty(0, bool), *(pair.is_unmoved for pair in inliers)])
    moves = (displacement > static_px) & (residual < MAJORITY * displacement) & ~is_unmoved
    return np.asarray(landmarks.has_moved | moves)


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
    inliers: Pairs, current: CameraFrame, previous: int, previous_pixels: FloatArray | None
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


def record_observations(inliers: Pairs, current: CameraFrame) -> LandmarkObservations:
    """Collect one camera's observations: inlier features and newly observed ones."""
    landmarks = current.landmarks
    index = np.union1d(collect_features(inliers), np.flatnonzero(landmarks.n_observations == 1))
    return LandmarkObservations(
        landmarks.id[index], current.features.normalized[index], landmarks.mean[index], landmarks.has_moved[index]
    )
