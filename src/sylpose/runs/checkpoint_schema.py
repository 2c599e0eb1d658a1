"""Schema of checkpoints: the state of an unfinished run and the object types that may be read from a file."""

from __future__ import annotations

from dataclasses import dataclass, field

from sylpose.bundle_adjustment.bundle import Observations
from sylpose.features.klt import Tracks
from sylpose.features.patches import SIDE
from sylpose.features.search_windows import SearchWindows
from sylpose.features.sift import Features
from sylpose.features.static_background import CameraRotation, RotationRectifier, StaticBackground
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.landmarks.landmark_filter import Landmarks, LandmarkTable
from sylpose.network import codec
from sylpose.report.files import WriterState
from sylpose.results import FramePose
from sylpose.rig import Camera, Rig
from sylpose.serialization import RecordType, Serializer
from sylpose.smoothing import Track
from sylpose.tracking.anchor_preparation import find_new_features
from sylpose.tracking.camera_side.camera import CameraAnchor, CameraTracker, NextAnchor, TrackedFeatures
from sylpose.tracking.camera_side.camera_motion import CameraMotionDetector, View
from sylpose.tracking.camera_side.frame import CameraFrame, LandmarkObservations
from sylpose.tracking.context import Frame
from sylpose.tracking.initialization import BufferedFrame
from sylpose.tracking.joint_side.joint_state import PendingRefinement
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.tracker import TrackerSnapshot
from sylpose.tracking.window import bundle_frames


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
    "windows": SearchWindows | None,
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
_LANDMARKS: dict[str, tuple[int | str, ...]] = {
    "mean": ("n", 3),
    "information": ("n", 3, 3),
    "n_observations": ("n",),
    "has_moved": ("n",),
    "origin": ("n", 2),
    "id": ("n",),
}
_FEATURES: dict[str, tuple[int | str, ...]] = {
    "pixels": ("n", 2),
    "normalized": ("n", 2),
    "descriptors": ("n", 128),
    "faint": ("n",),
    "patches": ("n", SIDE, SIDE),
}
_TRACKS: dict[str, tuple[int | str, ...]] = {
    "filters": ("n", "s", 8),
    "contrast": ("n",),
    "sd": ("n",),
    "pixels": ("n", 2),
    "warps": ("n", 2, 2),
    "tracked": ("n",),
}
_TABLE_FIELDS = {"_rows": Landmarks, "_used": int, "_next": int}
_SIGHTINGS: dict[str, tuple[int | str, ...]] = {
    "landmark_ids": ("n",),
    "normalized": ("n", 2),
    "positions": ("n", 3),
    "has_moved": ("n",),
}
RECORDS = (
    *codec.RECORDS,
    RecordType(RunState),
    RecordType(OutputState, check=_check_output),
    RecordType(WriterState, {"quaternion": (4,)}),
    RecordType(TrackerSnapshot),
    RecordType(TrackingOptions),
    RecordType(PendingRefinement, {"landmark_cameras": ("m",)}),
    RecordType(Observations, {"frame": ("n",), "camera": ("n",), "landmark": ("n",), "image": ("n", 2)}),
    RecordType(BufferedFrame),
    RecordType(Frame, {"time_offsets": ("c",)}),
    RecordType(FrameSet),
    RecordType(CameraFrame, {"background": ("n",), "landmark_ids": ("m",)}),
    RecordType(CameraTracker, fields=_CAMERA_TRACKER_FIELDS, sets_attributes=True),
    RecordType(CameraAnchor, {"is_alive": ("n",)}),
    RecordType(NextAnchor, {"rows": ("n",)}),
    RecordType(TrackedFeatures, {"rows": ("m",), "previous_pixels": ("m", 2)}),
    RecordType(CameraMotionDetector, {"is_static": ("n",)}, _MOTION_DETECTOR_FIELDS, sets_attributes=True),
    RecordType(StaticBackground, {"small_image": ("h", "w"), "pixels": ("n", 2), "patches": ("n", "s")}),
    RecordType(CameraRotation, {"rotation": (3, 3)}),
    RecordType(RotationRectifier, {"rotation": (3, 3)}, {"camera": Camera, "rotation": FloatArray}),
    RecordType(SearchWindows, {"bounds": ("n", 4), "ages": ("n",), "thumbnail": ("h", "w")}),
    RecordType(Features, _FEATURES),
    RecordType(Tracks, _TRACKS),
    RecordType(Landmarks, _LANDMARKS),
    RecordType(LandmarkTable, fields=_TABLE_FIELDS, sets_attributes=True, check=_check_table),
    RecordType(Camera),
    RecordType(Rig),
    RecordType(Track, {"time_offsets": ("c",)}),
    RecordType(LandmarkObservations, _SIGHTINGS),
    RecordType(FramePose, {"covariance": (6, 6), "inliers": ("c",), "residuals": ("c",)}),
)
SERIALIZER = Serializer(RECORDS, [bundle_frames, find_new_features])
