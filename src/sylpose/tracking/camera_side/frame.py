"""One camera's data of a frame, and its matches between two frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.features.sift import Features, match_features, match_guided
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.landmarks.landmark_filter import Landmarks, LandmarkTable
from sylpose.matches import STATIC_PX
from sylpose.relative_pose.terms import TermData
from sylpose.rig import Camera

# A feature that is static where the object's surface moved by this many pixels is background (choice).
BACKGROUND_PX = 4.0
# Low-contrast features are localized less precisely: they are static within this many pixels, if that is at most this
# share of the motion of a point on the object (choice).
MAX_FAINT_STATIC_PX, MAX_STATIC_RATIO = 4.0, 0.2
# Half length of a landmark's search range, in standard deviations of its depth (choice).
DEPTH_SEARCH_SDS = 2.0
# Points are added to the object's cloud once their depth is known to this relative precision (choice).
MAX_RELATIVE_DEPTH_SD = 0.1


@dataclass(eq=False)
class CameraFrame:
    """One camera's data of one frame, never shared with other cameras.

    Attributes:
        features: of its image.
        background: (n,) which features were static where the object moved; filled in during matching.
        table: the camera's landmarks.
        landmark_ids: (n,) the features' landmarks in it, once the frame is solved.
        static_px: displacements below this are within the keypoint noise, pixels.
    """

    features: Features
    background: BoolArray
    table: LandmarkTable
    landmark_ids: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    static_px: float = STATIC_PX

    @property
    def landmarks(self) -> Landmarks:
        """(n) landmarks of the features, as estimated so far."""
        return self.table.get(self.landmark_ids)


@dataclass(frozen=True, eq=False)
class FrameMatches:
    """One camera's matches between an earlier frame and the current one.

    Attributes:
        reference: the earlier frame's number.
        earlier: the camera's data of it.
        indices: (n, 2) into the earlier and the current frame's features.
        pixels_i, pixels_j: (n, 2) as recorded.
        normalized_i, normalized_j: (n, 2).
    """

    reference: int
    earlier: CameraFrame
    indices: IntArray
    pixels_i: FloatArray
    pixels_j: FloatArray
    normalized_i: FloatArray
    normalized_j: FloatArray

    @classmethod
    def from_indices(cls, reference: int, earlier: CameraFrame, later: Features, indices: IntArray) -> FrameMatches:
        """Build the matches from feature indices (n, 2)."""
        a, (i, j) = earlier.features, indices.T
        return cls(reference, earlier, indices, a.pixels[i], later.pixels[j], a.normalized[i], later.normalized[j])

    def __len__(self) -> int:
        return len(self.indices)

    def subset(self, mask: BoolArray) -> FrameMatches:
        """Return the matches where the mask (n,) is True."""
        return replace(
            self,
            indices=self.indices[mask],
            pixels_i=self.pixels_i[mask],
            pixels_j=self.pixels_j[mask],
            normalized_i=self.normalized_i[mask],
            normalized_j=self.normalized_j[mask],
        )

    @property
    def landmarks(self) -> Landmarks:
        """(n) landmarks of the matches, from the earlier frame."""
        return self.earlier.table.get(self.earlier.landmark_ids[self.indices[:, 0]])

    @property
    def observation_counts(self) -> IntArray:
        """(n,) number of frames in which each match's landmark was observed."""
        return self.earlier.table.observation_counts(self.earlier.landmark_ids[self.indices[:, 0]])

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


@dataclass(frozen=True, eq=False)
class DetectedFeatures:
    """A camera's detected features in a frame, pixels.

    Attributes:
        features: (n, 2) all features.
        rejected: (m, 2) features that match known landmarks but do not agree with the pose, or without a pose.
    """

    features: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    rejected: FloatArray = field(default_factory=lambda: np.empty((0, 2)))


def collect_detected_features(
    features: Features, pairs: Sequence[FrameMatches] = (), weights: Sequence[FloatArray] | None = None
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
    indices = match_features(a, b) if indices is None else indices
    known = earlier.background[indices[:, 0]]
    is_still = np.linalg.norm(a.pixels[indices[:, 0]] - b.pixels[indices[:, 1]], axis=1) < current.static_px
    current.background[indices[known & is_still, 1]] = True
    return FrameMatches.from_indices(reference, earlier, b, indices[~known & ~current.background[indices[:, 1]]])


def match_near_pose(
    reference: int,
    earlier: CameraFrame,
    current: CameraFrame,
    camera: Camera,
    pose: RigidTransform,
    radius_px: float,
    offset_px: tuple[float, float] = (0.0, 0.0),
) -> FrameMatches:
    """Match the earlier frame's landmarks with features near their projections.

    Args:
        pose: world_from_object, of the current frame.
        radius_px: search radius, pixels, in addition to the range left open by the landmarks' depth.
        offset_px: offset of the search from the projections; with an offset, matches are found by chance only.
    """
    landmarks = earlier.landmarks
    depth_offsets = DEPTH_SEARCH_SDS * landmarks.depth_error
    ends = np.stack(
        [camera.project(pose.apply(landmarks.mean + s * depth_offsets).reshape(-1, 3)) for s in (-1, 1)], axis=1
    )
    ends[earlier.background] = np.nan
    indices = match_guided(earlier.features, current.features, ends + np.array(offset_px), radius_px)
    return FrameMatches.from_indices(reference, earlier, current.features, indices[~current.background[indices[:, 1]]])


def collect_features(pairs: Sequence[FrameMatches]) -> IntArray:
    """Return the current frame's feature (n,) of each match."""
    return np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 1] for pair in pairs)])


def omit_empty(pairs: Iterable[FrameMatches]) -> list[FrameMatches]:
    """Return the pairs that have matches."""
    return [pair for pair in pairs if len(pair)]


def select_inliers(pairs: Sequence[FrameMatches], weights: Sequence[FloatArray]) -> list[FrameMatches]:
    """Select each pair's inliers, given its weights; omit pairs without any."""
    return omit_empty(pair.subset(w > 0) for pair, w in zip(pairs, weights, strict=True))


def find_static(pair: FrameMatches, static_px: float = STATIC_PX) -> BoolArray:
    """Return which matches (n,) are static in the image."""
    return np.asarray(np.linalg.norm(pair.pixels_i - pair.pixels_j, axis=1) < static_px)


def measure_displacement(landmarks: Landmarks, pixels: FloatArray) -> FloatArray:
    """Return each landmark's distance (n,) from its first observed pixel to its current one (n, 2)."""
    return np.asarray(np.linalg.norm(pixels - landmarks.origin, axis=1))


def find_background(
    pair: FrameMatches,
    current: CameraFrame,
    camera: Camera,
    pose_i: RigidTransform,
    pose_j: RigidTransform,
    radius: float,
) -> BoolArray:
    """Return which matches (n,) are static where a point on the object moved.

    Args:
        pose_i, pose_j: world_from_object.
        radius: of the object.
    """
    is_background = find_static(pair, current.static_px)
    at = np.flatnonzero(is_background)
    moved = _min_motion_px(pair.pixels_i[at], pair.normalized_i[at], camera, pose_i, pose_j, radius)
    is_background[at] = moved > BACKGROUND_PX - STATIC_PX + current.static_px
    return is_background


def drop_background(
    pair: FrameMatches,
    current: CameraFrame,
    camera: Camera,
    reference_pose: RigidTransform,
    predicted_pose: RigidTransform,
    radius: float,
) -> FrameMatches:
    """Remove static, never moved matches where a point on the object would have moved.

    They are marked as background as in `mark_background`, before the pose is known.

    Args:
        predicted_pose: predicted world_from_object. An object that stops instead is still tracked by landmarks that
            have moved.
    """
    displacement = np.linalg.norm(pair.pixels_i - pair.pixels_j, axis=1)
    background = (displacement < MAX_FAINT_STATIC_PX) & ~pair.landmarks.has_moved
    if not background.any():
        return pair
    at = np.flatnonzero(background)
    moved = _min_motion_px(pair.pixels_i[at], pair.normalized_i[at], camera, reference_pose, predicted_pose, radius)
    background[at] = (moved > BACKGROUND_PX) & (displacement[at] < np.maximum(MAX_STATIC_RATIO * moved, STATIC_PX))
    mark_background(pair, current, background)
    return pair.subset(~background)


def mark_background(pair: FrameMatches, current: CameraFrame, is_background: BoolArray) -> None:
    """Mark matches (n,) as background in both frames."""
    pair.earlier.background[pair.indices[is_background, 0]] = True
    current.background[pair.indices[is_background, 1]] = True


def mark_others_as_background(pairs: Sequence[FrameMatches], current: CameraFrame) -> None:
    """Mark all features of a frame except those of the given matches as background."""
    current.background[np.setdiff1d(np.arange(len(current.features)), collect_features(pairs))] = True


def _min_motion_px(
    pixels: FloatArray,
    normalized: FloatArray,
    camera: Camera,
    pose_i: RigidTransform,
    pose_j: RigidTransform,
    radius: float,
) -> FloatArray:
    """Return the least image motion (n,) of points on the object, over its depth range, pixels.

    Args:
        pixels: (n, 2) observations.
        normalized: (n, 2) the same, normalized.
    """
    middle = camera.camera_from_world.apply(pose_i.translation)[2]
    moves = pose_j.as_matrix() @ pose_i.inv().as_matrix() @ camera.camera_from_world.inv().as_matrix()
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
