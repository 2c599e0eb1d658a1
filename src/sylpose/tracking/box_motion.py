"""Motion in boxes before the object has moved: that of the object, or of something else.

A box contains more than the object. A person passing behind it, or a wall, is visible near the box's edges. The object
is at the center, so motion at the center is the object's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sylpose.features.sift import Features
from sylpose.geometry.arrays import BoolArray
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.tracking.context import Region, TrackerContext
from sylpose.tracking.frame import CameraFrame, Frame, FrameMatches, measure_displacement
from sylpose.tracking.joint_state import MIN_MOVED_FEATURES, JointState
from sylpose.tracking.reports import BoxMotionReport

__all__ = ["count_center_features", "is_box_center_static", "select_static_matches"]

# The center of a box is this share of its width and height (choice).
CENTER_RATIO = 0.5
# The center is static if its displacement is within the noise and below this share of that of moving features, both
# medians (choice: a body rotating about itself moves its center by about a third).
MAX_CENTER_MOTION_RATIO = 0.15


def is_box_center_static(
    context: TrackerContext, state: JointState, frame: Frame, pairs: Sequence[Sequence[FrameMatches]]
) -> bool:
    """Return whether something moves in the boxes but not at their centers, in most cameras.

    Args:
        pairs: per camera, local: the frame's matches.
    """
    first = state.keyframes[0].world_from_object
    points = first.apply(state.object.points)

    def create_report(c: int) -> BoxMotionReport:
        outline = context.rig.cameras[c].project(points)
        outline = outline[np.isfinite(outline).all(axis=1)]
        if not len(outline) or not pairs[c]:
            return BoxMotionReport.empty()
        low, high = outline.min(axis=0), outline.max(axis=0)
        landmarks = Landmarks.concatenate([pair.landmarks for pair in pairs[c]])
        displacement = measure_displacement(landmarks, np.concatenate([pair.pixels_j for pair in pairs[c]]))
        offset = np.abs(landmarks.origin - 0.5 * (low + high)) / np.maximum(0.5 * (high - low), 1e-9)
        is_center, is_moving = (offset < CENTER_RATIO).all(axis=1), displacement > frame.cameras[c].static_px
        feature = np.concatenate([pair.indices[:, 1] for pair in pairs[c]])
        counts = [len(np.unique(feature[some])) for some in (is_center, is_moving)]
        pixels = [float(np.median(displacement[some])) if some.any() else np.nan for some in (is_center, is_moving)]
        return BoxMotionReport(counts[0], pixels[0], pixels[0] <= frame.cameras[c].static_px, counts[1], pixels[1])

    reports = context.executor.all_gather(create_report, BoxMotionReport.empty())
    displacements = [report.moving_displacement_px for report in reports if report.n_moving >= MIN_MOVED_FEATURES]
    usable = [report for report in reports if report.n_center >= MIN_MOVED_FEATURES]
    max_displacement = MAX_CENTER_MOTION_RATIO * float(np.median(displacements)) if displacements else 0.0
    return 2 * sum(
        report.is_center_static and report.center_displacement_px < max_displacement for report in usable
    ) > len(usable)


def count_center_features(context: TrackerContext, c: int, features: Features, region: Region) -> int:
    """Count a camera's features in the center of the object's region."""
    if region is None:
        return 0
    middle = region.mean(axis=0)
    return int(context.camera_trackers[c].find_inside(features, middle + CENTER_RATIO * (region - middle)).sum())


def select_static_matches(
    context: TrackerContext, frame: Frame, pairs: Sequence[Sequence[FrameMatches]]
) -> list[list[FrameMatches]]:
    """Select matches of features that have not moved since they were first observed; per camera, local."""

    def select_in_camera(c: int) -> list[FrameMatches]:
        kept = [pair.subset(_is_static(pair, frame.cameras[c])) for pair in pairs[c]]
        return [pair for pair in kept if len(pair)]

    return context.executor.map_cameras(select_in_camera)


def _is_static(pair: FrameMatches, current: CameraFrame) -> BoolArray:
    return np.asarray(measure_displacement(pair.landmarks, pair.pixels_j) <= current.static_px)
