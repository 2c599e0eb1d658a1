"""Reports that cameras exchange: small frozen records of numbers, without images or features.

The report of a camera without an image has the default values.

A frame's decisions depend on these records alone (`joint_state`, `state_machine`), so all cameras that receive the same
records make the same decisions (docs/map.md, "Two halves").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.landmarks.alignment import LandmarkMatches
from sylpose.relative_pose.camera_evidence import CameraEvidence
from sylpose.relative_pose.terms import TermData

# Positions that need little precision are rounded to this share of the object's radius, or finer (choice).
POSITION_GRID_RATIO = 1.0 / 256.0
# Default arrays.
_no_numbers, _zero_vector = partial(np.zeros, 0), partial(np.zeros, 3)
_no_pixels, _no_points = partial(np.zeros, (0, 2)), partial(np.zeros, (0, 3))


def _no_indices() -> IntArray:
    return np.zeros(0, np.int64)


def quantize_positions(points: FloatArray, radius: float) -> FloatArray:
    """Round points (n, 3) to a grid relative to the object's radius, to save bytes."""
    grid = 2.0 ** np.floor(np.log2(POSITION_GRID_RATIO * radius))
    return np.asarray(np.round(points / grid) * grid)


@dataclass(frozen=True, eq=False)
class TrackingReport:
    """Status of one camera's KLT tracks.

    Attributes:
        n_tracked: number of features still tracked.
        n_alive: number of the anchor's features not known to be off the object.
        expects_object: whether the camera has an image and the object should be visible in it.
        has_previous_image: whether it had a previous image to track from.
    """

    n_tracked: int = 0
    n_alive: int = 0
    expects_object: bool = False
    has_previous_image: bool = False


@dataclass(frozen=True, eq=False)
class MovingMatches:
    """One camera's moving matches with one earlier frame.

    Attributes:
        term: the matches.
        displacement_px: (n,) image displacement of each, pixels.
        jitter_px: scatter of static keypoints in each direction, pixels.
        n_static: number of static matches.
    """

    term: TermData
    displacement_px: FloatArray
    jitter_px: float
    n_static: int


@dataclass(frozen=True, eq=False)
class CameraTerms:
    """One camera's matches with each of several earlier frames; none without an image."""

    terms: tuple[TermData, ...] = ()


@dataclass(frozen=True, eq=False)
class InitialMatches:
    """One camera's moving matches with the first frame; none without its images."""

    reports: tuple[MovingMatches, ...] = ()


@dataclass(frozen=True, eq=False)
class BoxMotionReport:
    """Image motion in one camera's box since its features were first observed.

    Attributes:
        n_center: number of features at the box's center.
        center_displacement_px: median displacement of their matches.
        is_center_static: whether that is within the static threshold.
        n_moving: number of moving features in the whole box.
        moving_displacement_px: their median displacement.
    """

    n_center: int = 0
    center_displacement_px: float = np.nan
    is_center_static: bool = False
    n_moving: int = 0
    moving_displacement_px: float = np.nan


@dataclass(frozen=True, eq=False)
class LandmarkAges:
    """Histogram of the number of frames in which one camera's landmarks were observed.

    Attributes:
        values: (k,) numbers of frames.
        counts: (k,) numbers of landmarks observed in so many frames.
        n_moving: number of landmarks that move or have moved.
        depth_sd: median standard deviation of their depth, length units; NaN without any.
    """

    values: FloatArray = field(default_factory=_no_numbers)
    counts: FloatArray = field(default_factory=_no_numbers)
    n_moving: int = 0
    depth_sd: float = np.nan


@dataclass(frozen=True, eq=False)
class InlierStatistics:
    """Support for a pose in one camera, compared with random matches.

    Attributes:
        n_inlier_matches: number of inlier matches; a feature may have several.
        n_inlier_features, n_features: number of features.
        expected_by_chance: expected number of inliers if matches were random.
        n_unknowns: number of unknowns added by the camera's depth model.
    """

    n_inlier_matches: int = 0
    n_inlier_features: int = 0
    n_features: int = 0
    expected_by_chance: float = 0.0
    n_unknowns: int = 0


@dataclass(frozen=True, eq=False)
class KnownDepthMatches:
    """One camera's landmarks of known depth that agree with a pose.

    Attributes:
        observations: the matches.
        weights: (n,) 0 for matches that are not used.
    """

    observations: LandmarkMatches = field(default_factory=LandmarkMatches.empty)
    weights: FloatArray = field(default_factory=_no_numbers)


@dataclass(frozen=True, eq=False)
class PoseAgreement:
    """Agreement of one camera's matches with the frame's pose.

    Attributes:
        n_inlier_matches: number of inlier matches.
        n_matches: number of matches, inliers or not.
        references: numbers of the reference frames.
        weights: per reference frame, the sum of the weights of its matches.
        ages: of the inliers' landmarks.
        n_inlier_features: number of inlier features.
        n_moved: number of inlier features that move, or have moved, with the object.
        n_moving: number of inlier features that are not static in the image.
        residual_px: rms of the inliers' residuals, NaN without any.
        has_features: whether the camera has any feature in this frame.
        n_strong: number of inlier features that are not low-contrast.
        noise_px: robust standard deviation of the inliers' residuals; NaN without any.
        n_features: number of features that have matches, inliers or not.
        evidence: of its matches with one earlier frame for or against the pose.
        evidence_reference: number of that frame; -1 without evidence.
    """

    n_inlier_matches: int = 0
    n_matches: int = 0
    references: tuple[int, ...] = ()
    weights: tuple[float, ...] = ()
    ages: LandmarkAges = field(default_factory=LandmarkAges)
    n_inlier_features: int = 0
    n_moved: int = 0
    residual_px: float = np.nan
    has_features: bool = False
    n_moving: int = 0
    n_strong: int = 0
    noise_px: float = np.nan
    n_features: int = 0
    evidence: CameraEvidence = field(default_factory=CameraEvidence)
    evidence_reference: int = -1


# Of all cameras.
Agreements = Sequence[PoseAgreement]


@dataclass(frozen=True, eq=False)
class RelocalizationMatches:
    """One camera's features that match landmarks of its keyframes.

    Attributes:
        points: (n, 3) the landmarks, object's frame.
        pixels: (n, 2) the features.
    """

    points: FloatArray = field(default_factory=_no_points)
    pixels: FloatArray = field(default_factory=_no_pixels)


@dataclass(frozen=True, eq=False)
class NewObservations:
    """One camera's observations in several frames that it has not shared before.

    Every camera keeps them, so that later reports contain only new ones.

    Attributes:
        frame: (n,) frame numbers.
        landmark: (n,) landmark numbers.
        image: (n, 2) normalized points.
        landmark_ids: (m,) sorted numbers of the landmarks to use now.
        positions: (m, 3) their approximate positions on the object.
    """

    frame: IntArray = field(default_factory=_no_indices)
    landmark: IntArray = field(default_factory=_no_indices)
    image: FloatArray = field(default_factory=_no_pixels)
    landmark_ids: IntArray = field(default_factory=_no_indices)
    positions: FloatArray = field(default_factory=_no_points)

    def select(self, frames: Sequence[int], landmarks: IntArray | None = None) -> NewObservations:
        """Select the observations in some frames, and of some landmarks if given."""
        is_selected = np.isin(self.frame, frames)
        is_selected &= True if landmarks is None else np.isin(self.landmark, landmarks)
        return NewObservations(self.frame[is_selected], self.landmark[is_selected], self.image[is_selected])

    def merge(self, newer: NewObservations) -> NewObservations:
        """Merge with newer observations, sorted by frame and landmark."""
        frame, landmark = np.concatenate([self.frame, newer.frame]), np.concatenate([self.landmark, newer.landmark])
        order = np.lexsort([landmark, frame])
        return NewObservations(frame[order], landmark[order], np.concatenate([self.image, newer.image])[order])


@dataclass(frozen=True, eq=False)
class CameraObservations:
    """All of one camera's observations in some frames, input to their joint refinement.

    Attributes:
        frame: (n,) index into these frames.
        landmark: (n,) index into the landmarks.
        image: (n, 2) normalized points.
        landmark_ids: (m,) sorted landmark numbers.
        positions: (m, 3) approximate positions on the object.
        has_moved: (m,) 1 for landmarks known to have moved with it, else 0.
    """

    frame: IntArray = field(default_factory=_no_indices)
    landmark: IntArray = field(default_factory=_no_indices)
    image: FloatArray = field(default_factory=_no_pixels)
    landmark_ids: IntArray = field(default_factory=_no_indices)
    positions: FloatArray = field(default_factory=_no_points)
    has_moved: IntArray = field(default_factory=_no_indices)


@dataclass(frozen=True, eq=False)
class CameraMotionReport:
    """Camera motion estimated from one camera's background.

    Attributes:
        has_changed: whether the image no longer agrees with a static camera.
        rotation: (3,) estimated rotation vector since the camera was last static, camera's axes; 0 if no rotation
            explains the images.
        sd: standard deviation about the least certain axis, radians.
        first_frame: recording's number of the first frame that showed it.
        is_confirmed: whether two consecutive frames gave the same rotation.
    """

    has_changed: bool = False
    rotation: FloatArray = field(default_factory=_zero_vector)
    sd: float = 0.0
    first_frame: int = 0
    is_confirmed: bool = False

    @property
    def angle(self) -> float:
        """Estimated rotation angle, radians."""
        return float(np.linalg.norm(self.rotation))
