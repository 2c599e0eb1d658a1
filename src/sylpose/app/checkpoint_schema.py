"""What a run that is not at its end consists of, and of what kinds of objects: nothing else is read from a checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from sylpose.app.serialization import Kind
from sylpose.bundle_adjustment.bundle import Observations
from sylpose.features.klt import Patches, Tracks
from sylpose.features.sift import Features
from sylpose.features.static_background import Backdrop, Steadied, Turn
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.report.files import WriterState
from sylpose.results import FramePose
from sylpose.rig import Camera, Rig
from sylpose.smoothing.trajectory import Track
from sylpose.tracking.anchor_preparation import looked_for
from sylpose.tracking.camera import CameraPart
from sylpose.tracking.camera_motion_detection import View, Watch
from sylpose.tracking.frame import CameraFrame, Frame, SolvedFrame
from sylpose.tracking.joint_state import Joint, Nudge, Refinement
from sylpose.tracking.klt_frontend import Anchor, CameraAnchor, Followed, Renewal
from sylpose.tracking.motion_model import Velocity
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.reports import Seen
from sylpose.tracking.state_machine import Waiting
from sylpose.tracking.tracked_frame import Sightings
from sylpose.tracking.tracker import Memory
from sylpose.tracking.window import bundled_together

__all__ = ["FUNCTIONS", "KINDS", "OutputState", "RunState"]


@dataclass(frozen=True, eq=False)
class OutputState:
    """How far an `ObjectOutput` has come; `n_tracks` is the length in bytes of what is kept for smoothing."""

    writer: WriterState = field(default_factory=lambda: WriterState(0, 0, None))
    n_tracks: int = 0


@dataclass(frozen=True, eq=False)
class RunState:
    """All that the next frames depend on.

    Attributes:
        position: number of frames that were taken in.
        trackers, outputs: by object.
    """

    position: int
    trackers: dict[str, Memory]
    outputs: dict[str, OutputState]


def _check_table(table: LandmarkTable) -> None:
    rows: Landmarks = vars(table)["_rows"]
    if not 0 <= vars(table)["_used"] <= len(rows.id):
        raise ValueError("no table of landmarks: more are used than there are")


def _check_output(state: OutputState) -> None:
    if min(state.writer.tum_bytes, state.writer.csv_bytes, state.n_tracks) < 0:
        raise ValueError("files of less than no bytes")


_PART = {
    "index": int,
    "camera": Camera,
    "frames": dict[int, CameraFrame],
    "anchor": CameraAnchor | None,
    "renewal": Renewal | None,
    "surroundings": Features,
    "table": LandmarkTable,
    "noise_px": float,
    "view": View,
    "watch": Watch,
}
_WATCH = {
    "camera": Camera,
    "backdrop": Backdrop | None,
    "stood": BoolArray,
    "steady": Steadied | None,
    "turned": Turn | None,
    "since": int,
    "odd": int,
    "pause": int,
}
_KINDS = (
    Kind(RunState),
    Kind(OutputState, check=_check_output),
    Kind(WriterState, {"quaternion": (4,)}),
    Kind(Memory),
    Kind(Joint, {"refined": (6, 6)}),
    Kind(ObjectModel, {"center": (3,), "points": ("n", 3)}),
    Kind(SolvedFrame, {"late": ("c",), "covariance": (6, 6), "viewpoints": ("c", 3), "sees": ("c",)}),
    Kind(Anchor),
    Kind(Velocity, {"twist": (6,), "unsteady": (6,)}),
    Kind(Nudge, {"turn": (3,)}),
    Kind(Refinement, {"names": ("m",)}),
    Kind(Seen, {"frame": ("n",), "landmark": ("n",), "image": ("n", 2), "known": ("m",), "place": ("m", 3)}),
    Kind(Observations, {"frame": ("n",), "camera": ("n",), "landmark": ("n",), "image": ("n", 2)}),
    Kind(Waiting),
    Kind(Frame, {"late": ("c",)}),
    Kind(FrameSet),
    Kind(CameraFrame, {"background": ("n",), "numbers": ("m",)}),
    Kind(CameraPart, fields=_PART, plain=True),
    Kind(CameraAnchor, {"alive": ("n",)}),
    Kind(Renewal, {"rows": ("n",)}),
    Kind(Followed, {"rows": ("m",), "before": ("m", 2)}),
    Kind(Watch, {"stood": ("n",)}, _WATCH, plain=True),
    Kind(Backdrop, {"small": ("h", "w"), "pixels": ("n", 2), "patches": ("n", "s")}),
    Kind(Turn, {"rotation": (3, 3)}),
    Kind(Steadied, {"rotation": (3, 3)}, {"camera": Camera, "rotation": FloatArray}),
    Kind(Features, {"pixels": ("n", 2), "normalized": ("n", 2), "descriptors": ("n", 128), "faint": ("n",)}),
    Kind(Patches, {"filters": ("n", "s", 8), "contrast": ("n",), "sd": ("n",)}),
    Kind(Tracks, {"pixels": ("n", 2), "warps": ("n", 2, 2), "followed": ("n",)}),
    Kind(
        Landmarks,
        {
            "mean": ("n", 3),
            "information": ("n", 3, 3),
            "seen": ("n",),
            "moved": ("n",),
            "origin": ("n", 2),
            "id": ("n",),
        },
    ),
    Kind(
        LandmarkTable,
        fields={"_rows": Landmarks, "_used": int, "_next": int},
        plain=True,
        check=_check_table,
    ),
    Kind(Camera),
    Kind(Rig),
    Kind(Track, {"late": ("c",)}),
    Kind(Sightings, {"landmark": ("n",), "normalized": ("n", 2), "place": ("n", 3), "moved": ("n",)}),
    Kind(FramePose, {"covariance": (6, 6), "inliers": ("c",), "residuals": ("c",)}),
)
# By the names that stand in checkpoints.
KINDS = {kind.type.__name__: kind for kind in _KINDS}
FUNCTIONS: dict[str, Callable[..., Any]] = {"bundled_together": bundled_together, "looked_for": looked_for}
