"""Schema of checkpoints: the state of an unfinished run and the object types that may be read from a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from sylpose.bundle_adjustment.bundle import Observations
from sylpose.features.klt import TemplatePatches, Tracks
from sylpose.features.sift import Features
from sylpose.features.static_background import CameraRotation, RotationRectifier, StaticBackground
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.report.files import WriterState
from sylpose.results import FramePose
from sylpose.rig import Camera, Rig
from sylpose.serialization import SerializableType
from sylpose.smoothing.trajectory import Track
from sylpose.tracking.anchor_preparation import find_new_features
from sylpose.tracking.camera import CameraTracker
from sylpose.tracking.camera_motion_detection import CameraMotionDetector, View
from sylpose.tracking.frame import CameraFrame, Frame, SolvedFrame
from sylpose.tracking.joint_state import JointState, Nudge, Refinement
from sylpose.tracking.klt_frontend import Anchor, CameraAnchor, NextAnchor, TrackedFeatures
from sylpose.tracking.motion_model import VelocityModel
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.reports import NewObservations
from sylpose.tracking.state_machine import BufferedFrame
from sylpose.tracking.tracked_frame import LandmarkObservations
from sylpose.tracking.tracker import TrackerSnapshot
from sylpose.tracking.window import bundle_frames

__all__ = ["FUNCTIONS", "RECORD_TYPES", "OutputState", "RunState"]


@dataclass(frozen=True, eq=False)
class OutputState:
    """Progress of an `ObjectOutput`; `tracks_bytes` is the length in bytes of the data stored for smoothing."""

    writer: WriterState = field(default_factory=lambda: WriterState(0, 0, None))
    tracks_bytes: int = 0


@dataclass(frozen=True, eq=False)
class RunState:
    """Complete state of a run on which its next frames depend.

    Attributes:
        position: number of frames processed.
        trackers, outputs: state by object name.
    """

    position: int
    trackers: dict[str, TrackerSnapshot]
    outputs: dict[str, OutputState]


def _check_table(table: LandmarkTable) -> None:
    rows: Landmarks = vars(table)["_rows"]
    if not 0 <= vars(table)["_used"] <= len(rows.id):
        raise ValueError("no landmark table: more rows used than present")


def _check_output(state: OutputState) -> None:
    if min(state.writer.tum_bytes, state.writer.csv_bytes, state.tracks_bytes) < 0:
        raise ValueError("negative file sizes")


_CAMERA_TRACKER_FIELDS = {
    "index": int,
    "camera": Camera,
    "frames": dict[int, CameraFrame],
    "anchor": CameraAnchor | None,
    "next_anchor": NextAnchor | None,
    "background_features": Features,
    "table": LandmarkTable,
    "noise_px": float,
    "view": View,
    "motion_detector": CameraMotionDetector,
}
_MOTION_DETECTOR_FIELDS = {
    "camera": Camera,
    "background": StaticBackground | None,
    "is_static": BoolArray,
    "stabilizer": RotationRectifier | None,
    "last_rotation": CameraRotation | None,
    "first_frame": int,
    "n_changed": int,
    "pause": int,
}
_RECORD_TYPES = (
    SerializableType(RunState),
    SerializableType(OutputState, check=_check_output),
    SerializableType(WriterState, {"quaternion": (4,)}),
    SerializableType(TrackerSnapshot),
    SerializableType(JointState, {"refined_covariance": (6, 6)}),
    SerializableType(ObjectModel, {"center": (3,), "points": ("n", 3)}),
    SerializableType(
        SolvedFrame, {"time_offsets": ("c",), "covariance": (6, 6), "viewpoints": ("c", 3), "is_visible": ("c",)}
    ),
    SerializableType(Anchor),
    SerializableType(VelocityModel, {"twist": (6,), "change_variance": (6,)}),
    SerializableType(Nudge, {"rotation": (3,)}),
    SerializableType(Refinement, {"landmark_cameras": ("m",)}),
    SerializableType(
        NewObservations,
        {"frame": ("n",), "landmark": ("n",), "image": ("n", 2), "landmark_ids": ("m",), "positions": ("m", 3)},
    ),
    SerializableType(Observations, {"frame": ("n",), "camera": ("n",), "landmark": ("n",), "image": ("n", 2)}),
    SerializableType(BufferedFrame),
    SerializableType(Frame, {"time_offsets": ("c",)}),
    SerializableType(FrameSet),
    SerializableType(CameraFrame, {"background": ("n",), "landmark_ids": ("m",)}),
    SerializableType(CameraTracker, fields=_CAMERA_TRACKER_FIELDS, sets_attributes=True),
    SerializableType(CameraAnchor, {"is_alive": ("n",)}),
    SerializableType(NextAnchor, {"rows": ("n",)}),
    SerializableType(TrackedFeatures, {"rows": ("m",), "previous_pixels": ("m", 2)}),
    SerializableType(CameraMotionDetector, {"is_static": ("n",)}, _MOTION_DETECTOR_FIELDS, sets_attributes=True),
    SerializableType(StaticBackground, {"small_image": ("h", "w"), "pixels": ("n", 2), "patches": ("n", "s")}),
    SerializableType(CameraRotation, {"rotation": (3, 3)}),
    SerializableType(RotationRectifier, {"rotation": (3, 3)}, {"camera": Camera, "rotation": FloatArray}),
    SerializableType(
        Features, {"pixels": ("n", 2), "normalized": ("n", 2), "descriptors": ("n", 128), "faint": ("n",)}
    ),
    SerializableType(TemplatePatches, {"filters": ("n", "s", 8), "contrast": ("n",), "sd": ("n",)}),
    SerializableType(Tracks, {"pixels": ("n", 2), "warps": ("n", 2, 2), "tracked": ("n",)}),
    SerializableType(
        Landmarks,
        {
            "mean": ("n", 3),
            "information": ("n", 3, 3),
            "n_observations": ("n",),
            "has_moved": ("n",),
            "origin": ("n", 2),
            "id": ("n",),
        },
    ),
    SerializableType(
        LandmarkTable,
        fields={"_rows": Landmarks, "_used": int, "_next": int},
        sets_attributes=True,
        check=_check_table,
    ),
    SerializableType(Camera),
    SerializableType(Rig),
    SerializableType(Track, {"time_offsets": ("c",)}),
    SerializableType(
        LandmarkObservations,
        {"landmark_ids": ("n",), "normalized": ("n", 2), "positions": ("n", 3), "has_moved": ("n",)},
    ),
    SerializableType(FramePose, {"covariance": (6, 6), "inliers": ("c",), "residuals": ("c",)}),
)
# Keys are the type names written in checkpoints.
RECORD_TYPES = {kind.type.__name__: kind for kind in _RECORD_TYPES}
FUNCTIONS: dict[str, Callable[..., Any]] = {"bundle_frames": bundle_frames, "find_new_features": find_new_features}
