"""Limits and sizes of the tracker that decide what a user gets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from sylpose.features.sift import MAX_FEATURES
from sylpose.geometry.validation import check_integer, check_number
from sylpose.relative_pose.camera_evidence import MAX_F_RATIO, MAX_POOLED_F_RATIO


@dataclass(frozen=True, kw_only=True)
class TrackingOptions:
    """Limits and sizes of the tracker, checked when they are made.

    All benchmarks have the defaults; docs/history/benchmarks.md#trust has the effect of half and twice the values. A larger
    limit (`max_`) accepts more, a larger minimum (`min_`) less.

    Attributes:
        max_f_ratio: largest F ratio of a frame in which cameras do not contradict each other
            (`relative_pose.camera_evidence`).
        max_pooled_f_ratio: largest median F ratio of the last frames in which they do not.
        n_pooled_f_ratios: number of these frames.
        max_rival_ratio: largest share of the tracked body's matches that another body has without making it ambiguous
            which one is the object: one that moves at the same time, or at other times only, as a person who leaves first; a
            single body leaves none.
        max_rival_ratio_monocular: the same for one camera, in which a part of the object fits another motion.
        max_relocalized_rotation_sd: largest standard deviation of the rotation, radians, of a relocalized pose from
            which landmarks are learned, and of the next two.
        min_score: least number of inlier features of a pose, weighted by their noise; a different body of the same
            outline has about twenty.
        max_coasting_frames: number of frames for which the pose of a missing object is extrapolated.
        min_first_motion_px: least median displacement of a first motion that is not fully observable, pixels.
        min_displacement_px: least median displacement of a motion that a camera detects, pixels,
        min_displacement_sds: and in standard deviations of its keypoint noise.
        min_log_gain_per_unknown: least log-likelihood gain of a rigid motion over random displacements, per unknown
            (Akaike's criterion: 1).
        max_residual_ratio: largest rms residual of moving matches as a share of their displacement.
        max_start_features: number of features per camera while the object may be anywhere in the image.
        max_buffered_frames: number of frames that are kept, or read in advance, until the object moves.
        max_features: number of features per camera in the object's region without KLT, and if it rotates fast.
        max_klt_features: the same with KLT tracking.
        n_anchor_features: number of features per camera of a frame in which KLT tracks begin.
        min_strong_inliers: number of inlier features per camera below which low-contrast features are detected too.
        max_keyframes: number of keyframes.
        min_keyframe_rotation: least rotation between the viewpoints of keyframes, radians.
        max_reference_keyframes: number of keyframes per camera that all features of a frame are matched with.
        n_recent_frames: number of recent frames that are refined with the keyframes; poses change once more are known.
        min_refinement_rotation: rotation since the last refinement after which the next one is due early, radians.
        max_window_frames: number of frames refined jointly while tracking.
        max_window_landmarks: number of landmarks per camera refined jointly while tracking.
        search_pixels: number of pixels per camera examined in a frame in which the object is lost.
        likely_search_pixels: the same where the object is likely.
        min_relocalization_inliers: least number of inliers of a relocalized pose.
        max_relocalization_error_px: largest reprojection error of these inliers, pixels.
        max_relocalization_descriptor_ratio: largest ratio of the descriptor distances to the best and second-best match.

    Raises:
        ValueError: a value out of its range.
    """

    max_f_ratio: float = MAX_F_RATIO
    max_pooled_f_ratio: float = MAX_POOLED_F_RATIO
    n_pooled_f_ratios: int = 15
    max_rival_ratio: float = 0.1
    max_rival_ratio_monocular: float = 0.5
    max_relocalized_rotation_sd: float = 0.005
    min_score: float = 20.0
    max_coasting_frames: int = 15
    min_first_motion_px: float = 8.0
    min_displacement_px: float = 3.5
    min_displacement_sds: float = 7.0
    min_log_gain_per_unknown: float = 5.0
    max_residual_ratio: float = 0.35
    max_start_features: int = 4000
    max_buffered_frames: int = 60
    max_features: int = MAX_FEATURES
    max_klt_features: int = 400
    n_anchor_features: int = 350
    min_strong_inliers: int = 60
    max_keyframes: int = 100
    min_keyframe_rotation: float = float(np.radians(6.0))
    max_reference_keyframes: int = 4
    n_recent_frames: int = 8
    min_refinement_rotation: float = float(np.radians(10.0))
    max_window_frames: int = 32
    max_window_landmarks: int = 150
    search_pixels: int = 50_000
    likely_search_pixels: int = 200_000
    min_relocalization_inliers: int = 24
    max_relocalization_error_px: float = 8.0
    max_relocalization_descriptor_ratio: float = 0.9

    def __post_init__(self) -> None:
        for field in fields(self):
            value, minimum = getattr(self, field.name), _MINIMA.get(field.name, 1)
            if isinstance(field.default, int):
                checked: float = check_integer(value, field.name, minimum=int(minimum), maximum=_MAX_COUNT)
            elif field.name in _RATIOS:
                checked = check_number(value, field.name, above=0.0, maximum=1.0)
            elif field.name in _ANGLES:
                checked = check_number(value, field.name, above=0.0, maximum=float(np.pi))
            else:
                checked = check_number(value, field.name, minimum=0.0)
            object.__setattr__(self, field.name, checked)

    @property
    def changes(self) -> Mapping[str, float]:
        """The values that are not the default, by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}


# Least values of numbers of which one is not enough: the first motion and a refinement need two frames, a pose four
# matches, a search some pixels (derived).
_MINIMA = {"max_buffered_frames": 2, "max_keyframes": 3, "max_window_frames": 4, "search_pixels": 1024}
_MINIMA |= {"likely_search_pixels": 1024, "min_relocalization_inliers": 4, "min_strong_inliers": 0}
# Sizes beyond this need more memory than any computer has (derived).
_MAX_COUNT = 10**9
_RATIOS = ("max_rival_ratio", "max_rival_ratio_monocular", "max_relocalization_descriptor_ratio")
_ANGLES = ("max_relocalized_rotation_sd", "min_keyframe_rotation", "min_refinement_rotation")
