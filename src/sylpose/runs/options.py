"""Options of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sylpose.bundle_adjustment.calibration_refinement import N_CAMERA_PARAMETERS
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.euler_angles import parse_euler_angles
from sylpose.geometry.validation import check_bool, check_choice, check_finite, check_integer, check_type, format_value
from sylpose.io.capture.session import check_frame_range
from sylpose.mesh import Mesh
from sylpose.methods import FEATURES, METHODS, MODES, resolve_features
from sylpose.report import PICTURE_FORMATS
from sylpose.tracking.known_object import KnownObject
from sylpose.tracking.options import TrackingOptions

# Seconds between two checkpoints (choice: acceptable loss of work).
CHECKPOINT_SECONDS = 20.0


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of `track_session`, checked when they are made.

    Attributes:
        method, features, seed: as in `track`.
        offsets: as in `track`; None for those of `offsets.toml` in the session's folder, if it exists.
        start, stop, every: frames start, start + every, ... below stop.
        overlay: write `overlay.mp4`.
        smooth: refine all poses jointly at the end (`sylpose.smoothing`); the poses as tracked go to `tracked.tum` and
            `tracked.csv`. None: for recordings of up to 10,000 frames, with the method "landmarks".
        refine_calibration: smooth, and refine the calibration with the poses; it goes to `calibration.refined.toml`.
        calibration_covariance: (10 C, 10 C) of the errors of a calibration from the same frames
            (`MotionCalibration.covariance`), for smoothing; None: typical errors of calibrations.
        velocity: write velocity.csv, the trajectory with velocities and accelerations (`Trajectory.differentiate`).
        plot_format: file format of the report: "png", "svg" or "pdf".
        angles: Euler angles in the report and additionally in trajectory.csv: "XYZ" (intrinsic axes), "xyz" (extrinsic
            axes), or three vectors, "0,0,1 1,0,0 0,1,0" (intrinsic).
        known: object model, or models by name, from another recording (`io.object_files`); poses are expressed in its
            frame. Boxes of these objects are not used.
        mesh: shape of the object, in the session's unit: it is tracked by its outlines instead of features
            (docs/shape.md), and poses are those of the mesh. Boxes are not used.
        candidate: number of the moving body to be tracked where there are no boxes, 1 for the one with the most matches,
            in the order of `sylpose check`; None: that one, with the status `ambiguous` if another one moves as well.
        tracking: limits and sizes, `options` of `track`.
        workers: as in `track`; the result does not depend on it.
        distributed: None for one process; "exact" or "compact" for one node per camera over a simulated network
            (`network.simulation`), for recordings only.
        resume: continue the interrupted run in the same folder, which must have had the same options.
        checkpoint_seconds: time between two checkpoints; 0 for one after every frame. Live sessions have none.

    Raises:
        ValueError: an unknown method, features that it cannot use, or another value out of its range.
    """

    method: str = METHODS[0]
    features: str = FEATURES[0]
    offsets: Mapping[str, float] | None = None
    start: int = 0
    stop: int | None = None
    every: int = 1
    overlay: bool = True
    smooth: bool | None = None
    refine_calibration: bool = False
    calibration_covariance: FloatArray | None = None
    velocity: bool = False
    plot_format: str = "png"
    angles: str | None = None
    known: KnownObject | Mapping[str, KnownObject] | None = None
    mesh: Mesh | None = None
    candidate: int | None = None
    seed: int = 0
    tracking: TrackingOptions = field(default_factory=TrackingOptions)
    workers: int | None = None
    distributed: str | None = None
    resume: bool = False
    checkpoint_seconds: float = CHECKPOINT_SECONDS

    def __post_init__(self) -> None:
        resolve_features(self.method, self.features)
        for name in ("overlay", "refine_calibration", "velocity", "resume"):
            check_bool(getattr(self, name), name)
        if self.smooth is not None:
            check_bool(self.smooth, "smooth")
        # `check_frame_range` and the session check the ranges of frames.
        for name in ("start", "every", *(["stop"] if self.stop is not None else [])):
            check_integer(getattr(self, name), name, minimum=-(2**62))
        check_integer(self.seed, "seed")
        check_type(self.tracking, TrackingOptions, "tracking")
        for name in ("workers", "candidate"):
            if getattr(self, name) is not None:
                check_integer(getattr(self, name), name, minimum=1)
        check_frame_range(self.start, self.stop, self.every)
        seconds: object = self.checkpoint_seconds  # callers may ignore its type
        if isinstance(seconds, bool) or not isinstance(seconds, (int, float)) or not seconds >= 0:
            raise ValueError(f"checkpoint_seconds must be a number of seconds, 0 or more, got {format_value(seconds)}")
        check_choice(self.plot_format, PICTURE_FORMATS, "plot_format")
        if self.angles is not None:
            parse_euler_angles(check_type(self.angles, str, "angles"))
        for name, kinds in (("offsets", Mapping), ("known", (KnownObject, Mapping))):
            if getattr(self, name) is not None:
                check_type(getattr(self, name), kinds, name)
        if self.calibration_covariance is not None:
            values = check_finite(self.calibration_covariance, ("10 C", "10 C"), "calibration_covariance")
            if len(values) % N_CAMERA_PARAMETERS or not len(values):
                raise ValueError(f"calibration_covariance must be (10 C, 10 C) for C cameras, got shape {values.shape}")
            scales = np.sqrt(np.abs(np.diag(values)))
            if (np.diag(values) < 0).any() or not np.allclose(values, values.T, atol=1e-9 * np.outer(scales, scales)):
                raise ValueError("calibration_covariance must be symmetric with variances of 0 or more")
            if self.refine_calibration:
                raise ValueError("refine_calibration: the recording itself has determined the calibration")
            if self.resume:
                raise ValueError("resume: a calibration_covariance is not kept for it; run without resume")
        if self.mesh is not None:
            check_type(self.mesh, Mesh, "mesh")
            self._refuse_with_mesh()
        if self.distributed is None:
            return
        if self.distributed not in MODES:
            raise ValueError(f"distributed: {self.distributed!r} is neither of {', '.join(MODES)}")
        if self.resume:
            raise ValueError("distributed: nodes write no checkpoints, so there is nothing to resume")
        if self.known:
            raise ValueError("distributed: nodes do not support known objects")

    def _refuse_with_mesh(self) -> None:
        """Refuse options of features, and of what tracking by outlines does not have.

        Raises:
            ValueError: naming the option.
        """
        excluded = {
            "method": self.method != METHODS[0],
            "features": self.features != FEATURES[0],
            "known": bool(self.known),
            "candidate": self.candidate is not None,
            "calibration_covariance": self.calibration_covariance is not None,
            "smooth": bool(self.smooth),
            "refine_calibration": self.refine_calibration,
            "distributed": self.distributed is not None,
            "resume": self.resume,
        }
        for name, is_set in excluded.items():
            if is_set:
                raise ValueError(f"{name}: not with a mesh, which is tracked by its outlines and without checkpoints")
