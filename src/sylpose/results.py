"""What the estimators return: frozen results, each with a status that has human text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.numerics.arrays import BoolArray, FloatArray, IntArray
from sylpose.numerics.checked import kind_of, listed
from sylpose.numerics.matrices import covariance_of

__all__ = [
    "UNCERTAIN_TURN",
    "FramePose",
    "FrameStatus",
    "Motion",
    "Observable",
    "RotationEstimate",
    "Status",
    "Trajectory",
    "pan_tilt_roll",
]


# A pose whose turn is not known to this, radians about each axis, one standard deviation, is uncertain (choice).
UNCERTAIN_TURN = 0.35


class Status(Enum):
    """What an estimator says about its own answer. `status.text` is a sentence for people."""

    OK = "ok"
    TOO_FEW_MATCHES = "too few matches"
    SCALE_NOT_OBSERVABLE = "scale not observable"
    TURN_NOT_OBSERVABLE = "turn not observable"
    NO_MOTION = "no motion"
    NOT_CERTIFIED = "not certified"
    NOT_CONVERGED = "not converged"
    NOT_CONSISTENT = "no consistent motion"
    AMBIGUOUS = "ambiguous"
    MIXED = "more than one motion"
    MOSTLY_STILL = "mostly still"

    @property
    def text(self) -> str:
        """One sentence that says what the status means."""
        return _TEXTS[self]

    @property
    def has_pose(self) -> bool:
        """Whether a result of this status carries an answer that may be used."""
        return self in (Status.OK, Status.SCALE_NOT_OBSERVABLE, Status.NO_MOTION, Status.NOT_CERTIFIED)


_TEXTS = {
    Status.OK: "Everything that was asked for was found.",
    Status.TOO_FEW_MATCHES: "Too few matches on the object in all cameras together.",
    Status.SCALE_NOT_OBSERVABLE: "The turn and the translation's direction were found; how far it moved cannot be seen "
    "(one camera, or a translation without a turn).",
    Status.TURN_NOT_OBSERVABLE: "A part of the turn cannot be seen from these cameras.",
    Status.NO_MOTION: "The object did not move measurably: its matches stand still in every camera.",
    Status.NOT_CERTIFIED: "The best of all solutions that were found; that there is no better one is not proved.",
    Status.NOT_CONVERGED: "The solver did not settle within its bound of iterations.",
    Status.NOT_CONSISTENT: "No single rigid motion explains enough of the matches.",
    Status.AMBIGUOUS: "Two motions explain the matches about equally well, or about as many of them each, and which of them "
    "is the object's cannot be seen.",
    Status.MIXED: "One motion explains the matches nearly, and neighbours depart from it alike: two bodies move, or a "
    "camera is calibrated wrongly.",
    Status.MOSTLY_STILL: "Most matches stand still, and some move, by too little or too few to tell which are the object's.",
}


class FrameStatus(Enum):
    """What happened to a frame in the tracker. `status.text` is a sentence for people."""

    FIRST = "first frame"
    TRACKED = "tracked"
    RELOCALISED = "relocalised"
    COASTING = "coasting"
    UNCERTAIN = "uncertain"
    LOST = "lost"
    TOO_FEW_MATCHES = "too few matches"
    NO_MOTION = "no motion"
    NOT_CONSISTENT = "no consistent motion"
    ONLY_STILL = "only background"

    @property
    def text(self) -> str:
        """One sentence that says what the status means."""
        return _FRAME_TEXTS[self]

    @property
    def has_pose(self) -> bool:
        """Whether a frame of this status has a pose."""
        return self in (
            FrameStatus.FIRST,
            FrameStatus.TRACKED,
            FrameStatus.RELOCALISED,
            FrameStatus.COASTING,
            FrameStatus.UNCERTAIN,
        )


_FRAME_TEXTS = {
    FrameStatus.FIRST: "The first frame with the object: the pose that all others are relative to.",
    FrameStatus.TRACKED: "The object was followed from the frame before.",
    FrameStatus.RELOCALISED: "The object was found again, by what was learnt of it before.",
    FrameStatus.COASTING: "The object was not found; it is taken to go on as it did, with growing uncertainty.",
    FrameStatus.UNCERTAIN: "What is seen hardly tells how the object is turned: its pose may be any of many.",
    FrameStatus.LOST: "The object was not found, for too long to say where it may be.",
    FrameStatus.TOO_FEW_MATCHES: "Too few features on the object in all cameras together, to begin with.",
    FrameStatus.NO_MOTION: "Nothing moved yet that could be taken for the object: its pose is not known.",
    FrameStatus.ONLY_STILL: "All that is seen stands still and was never seen to move: it may be the background, and what "
    "moved before is not seen. The object's pose is not known.",
    FrameStatus.NOT_CONSISTENT: "What moved was no rigid body, or not for long: its pose is not known.",
}


class Observable(Enum):
    """What of a frame's pose can be seen. `observable.text` is a sentence for people."""

    ALL = "all"
    NO_SCALE = "scale not observable"
    NO_LENGTH = "length not observable"

    @property
    def text(self) -> str:
        """One sentence that says what it means."""
        return _OBSERVABLE_TEXTS[self]


_OBSERVABLE_TEXTS = {
    Observable.ALL: "The whole pose can be seen.",
    Observable.NO_LENGTH: "The object has not turned: how far it moved follows from what is believed of its place and shape "
    "alone, until a turn tells it.",
    Observable.NO_SCALE: "With one camera, lengths are in units of the object's first distance.",
}


@dataclass(frozen=True, eq=False)
class Motion:
    """The object's motion between two frames, with how well it is known.

    Attributes:
        status: see `Status`.
        motion: world points on the object at frame i -> at frame j, X_j = R X_i + t. None when `not status.has_pose`, but
            for a turn that is not observable, of which the part in `unseen` means nothing, and for AMBIGUOUS and MIXED: then
            the best guess.
        center: (3,) the object's centre at frame i, world; `information` refers to its displacement.
        information: (6, 6) of (w, d): R = exp(w) R̂, d the displacement of `center` (docs/conventions.md).
        covariance: (6, 6) its inverse; infinite variance along directions that nothing is known of.
        unseen: (k, 6) directions of (w, d) that the matches leave open, and that the status is about; empty when all six
            are seen. Where it is not, `information` is that of the matches alone; else it counts in what is believed of
            the object's place and shape.
        inliers: per camera a mask over its matches.
        residuals: (C,) per camera the rms epipolar residual of its inliers, pixels; NaN without inliers.
        method: the estimator that was used.
        iterations: of the solver.
        faults: a sentence for each camera that is recognised to be at fault: its calibration, its matches or its image.
        rival: of AMBIGUOUS, the other motion that explains the matches, or as many of them, about as well; else None.
        second: the number of matches of a second body that moves otherwise over that of this one; 0 where none was seen.
        standing: the share of the matches that stand still while the object moves by little.
    """

    status: Status
    motion: RigidTransform | None
    center: FloatArray
    information: FloatArray
    covariance: FloatArray
    unseen: FloatArray
    inliers: tuple[BoolArray, ...]
    residuals: FloatArray
    method: str
    iterations: int
    faults: tuple[str, ...] = ()
    rival: RigidTransform | None = None
    second: float = 0.0
    standing: float = 0.0

    @property
    def n_inliers(self) -> IntArray:
        """(C,) number of inliers per camera."""
        return np.array([int(mask.sum()) for mask in self.inliers], dtype=np.int64)


@dataclass(frozen=True, eq=False)
class RotationEstimate:
    """A rotation and how well it is known: what every estimator of the paper's answers, with more of its own.

    Attributes:
        status: look at it first.
        rotation: (3, 3) R, X_j = R X_i + t in the world frame: the best guess where a part of the turn is not observable,
            NaN without any.
        information: (3, 3) of w, R = exp(w) R̂, world axes, 1/rad². It shows the directions that cannot be observed. Of
            estimators that ignore depth it counts what surfaces may have done (`paper.surfaces`). Zero without an answer.
        unseen: (k, 3) unit directions of w that are not seen (docs/conventions.md, "Limits").
        iterations: of the solver; rounds, of those that exchange messages.
    """

    status: Status
    rotation: FloatArray
    information: FloatArray
    unseen: FloatArray
    iterations: int

    @property
    def covariance(self) -> FloatArray:
        """(3, 3) the inverse of `information`; infinite variances on the axes that share an unknown direction."""
        return covariance_of(self.information)


def pan_tilt_roll(rotation: Rotation) -> FloatArray:
    """(3,) radians, R = R_y(pan) R_x(tilt) R_z(roll) (docs/conventions.md)."""
    return np.asarray(kind_of(rotation, Rotation, "rotation").as_euler("YXZ", suppress_warnings=True))


@dataclass(frozen=True, eq=False)
class FramePose:
    """The object's pose in one frame.

    Attributes:
        index: frame number in the recording.
        time: seconds, or the frame number for image folders without time stamps.
        status: what happened to the frame; when `not status.has_pose`, `world_from_object` is None.
        world_from_object: the pose.
        covariance: (6, 6) of (w, d), docs/conventions.md; zero in the first frame, whose pose is the definition.
        inliers: (C,) matches used per camera.
        residuals: (C,) rms residual of the inliers per camera, pixels; NaN without inliers.
        observable: what of the pose can be seen.
        doubt: (C,) 1, or more for a camera that disagrees with the others: what it says has so many times the variance that
            its matches give it; infinite for one of whose matches next to none agree; NaN where it is not known.
        faults: a sentence for each camera that is recognised to be at fault.
        matches: (C,) features per camera that match what is known of the object, the inliers among them; empty where that
            is not known.
        reason: why there is no pose, or none that was measured; "" where there is one.
    """

    index: int
    time: float
    status: FrameStatus
    world_from_object: RigidTransform | None
    covariance: FloatArray
    inliers: IntArray
    residuals: FloatArray
    observable: Observable = Observable.ALL
    doubt: FloatArray = field(default_factory=lambda: np.empty(0))
    faults: tuple[str, ...] = ()
    matches: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    reason: str = ""

    @property
    def measured(self) -> bool:
        """Whether the pose was found in this frame's images: False without one, and where it is carried on only, or hardly
        known."""
        return self.world_from_object is not None and self.status not in (FrameStatus.COASTING, FrameStatus.UNCERTAIN)

    @property
    def seen(self) -> bool:
        """Whether the object was found in this frame's images, however well that tells its pose."""
        return self.measured or self.status is FrameStatus.UNCERTAIN

    def judged(self) -> Self:
        """The same as `UNCERTAIN` where the object was seen but how it is turned is hardly known, and not so where it is."""
        if not self.seen or self.status is FrameStatus.FIRST:
            return self
        about = self.covariance[:3, :3]
        if not np.isfinite(about).all() or np.linalg.eigvalsh(about)[-1] > UNCERTAIN_TURN**2:
            return replace(self, status=FrameStatus.UNCERTAIN)
        return replace(self, status=FrameStatus.TRACKED) if self.status is FrameStatus.UNCERTAIN else self

    @property
    def sigma(self) -> FloatArray:
        """(6,) standard deviations: rotation about the world's x, y, z (radians), then position x, y, z."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def pan_tilt_roll(self) -> FloatArray:
        """(3,) radians, R = R_y(pan) R_x(tilt) R_z(roll) (docs/conventions.md); NaN without a pose."""
        if self.world_from_object is None:
            return np.full(3, np.nan)
        return pan_tilt_roll(self.world_from_object.rotation)

    @property
    def position(self) -> FloatArray:
        """(3,) the object's centre in the world; NaN without a pose."""
        if self.world_from_object is None:
            return np.full(3, np.nan)
        return np.asarray(self.world_from_object.translation)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The object's pose in every frame of a recording: a sequence of `FramePose`.

    Attributes:
        frames: in order of time; frames that could not be solved are there with their status and no pose.
        camera_names: (C,) what the per-camera columns refer to.
        unit: the calibration's length unit, or "".
    """

    frames: tuple[FramePose, ...]
    camera_names: tuple[str, ...]
    unit: str = ""

    def __init__(self, frames: Sequence[FramePose], camera_names: Sequence[str], unit: str = "") -> None:
        object.__setattr__(self, "frames", tuple(listed(frames, FramePose, "frames")))
        object.__setattr__(self, "camera_names", tuple(listed(camera_names, str, "camera_names")))
        object.__setattr__(self, "unit", kind_of(unit, str, "unit"))

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[FramePose]:
        return iter(self.frames)

    def __getitem__(self, i: int) -> FramePose:
        return self.frames[i]

    @property
    def times(self) -> FloatArray:
        """(N,) times of all frames."""
        return np.array([f.time for f in self.frames])

    @property
    def solved(self) -> BoolArray:
        """(N,) in which frames the pose was found."""
        return np.array([f.measured for f in self.frames], dtype=bool)

    @property
    def positions(self) -> FloatArray:
        """(N, 3) the object's centre in the world; NaN rows where there is no pose."""
        return np.array([f.position for f in self.frames]).reshape(-1, 3)

    def columns(self) -> dict[str, Any]:
        """All frames as columns of N values, called as those of trajectory.csv: lists of words, arrays of numbers.

        NaN where there is no value; an infinite standard deviation is unbounded.
        """
        frames, n = self.frames, len(self.frames)
        poses = [f.world_from_object for f in frames]
        quaternions = np.array([np.full(4, np.nan) if p is None else p.rotation.as_quat() for p in poses]).reshape(n, 4)
        angles = np.degrees([f.pan_tilt_roll for f in frames]).reshape(n, 3)
        sigmas = np.array([f.sigma for f in frames]).reshape(n, 6)
        sigmas = np.where(np.array([p is None for p in poses]).reshape(n, 1), np.nan, sigmas) * (
            [180 / np.pi] * 3 + [1] * 3
        )
        found: dict[str, Any] = {"index": np.array([f.index for f in frames], dtype=np.int64), "time": self.times}
        found |= {"status": [f.status.value for f in frames], "observable": [f.observable.value for f in frames]}
        found["unit"] = [self.unit] * n
        of_rows = (("tx ty tz", self.positions), ("qx qy qz qw", quaternions), ("pan_deg tilt_deg roll_deg", angles))
        for names, rows in (*of_rows, ("rx_sd_deg ry_sd_deg rz_sd_deg tx_sd ty_sd tz_sd", sigmas)):
            found |= dict(zip(names.split(), rows.T, strict=True))
        for c, name in enumerate(self.camera_names):
            found[f"inliers_{name}"] = np.array([f.inliers[c] for f in frames], dtype=np.int64)
            found[f"residual_px_{name}"] = np.array([f.residuals[c] for f in frames], dtype=float)
            for what in ("doubt", "matches"):  # which are empty where they are not known
                known = [float(v[c]) if len(v := getattr(f, what)) else np.nan for f in frames]
                found[f"{what}_{name}"] = np.array(known)
        return found | {"faults": ["; ".join(f.faults) for f in frames], "reason": [f.reason for f in frames]}

    def to_dataframe(self) -> Any:
        """`columns` as a pandas DataFrame.

        Raises:
            ImportError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise ImportError("to_dataframe needs pandas: pip install 'sylpose[export]'") from None
        return pandas.DataFrame(self.columns())

    @property
    def turn(self) -> FloatArray:
        """(N,) angle turned since the first solved frame, radians in [0, pi]; NaN where there is no pose."""
        poses = [f.world_from_object for f in self.frames]
        first = next((p for p in poses if p is not None), None)
        if first is None:
            return np.full(len(poses), np.nan)
        back = first.rotation.inv()
        return np.array([np.nan if p is None else (p.rotation * back).magnitude() for p in poses])
