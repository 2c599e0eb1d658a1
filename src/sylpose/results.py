"""What the estimators return: frozen results, each with a status that has human text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.display import Telling, Told, inliers_told, length, lengths, named, place_told, spread, turned, vector
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import carried, covariance_of
from sylpose.geometry.validation import kind_of, listed
from sylpose.rig import single_pose
from sylpose.status import FrameStatus, Observable, Status

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


@dataclass(frozen=True, eq=False, repr=False)
class Motion(Told):
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
        faults: a sentence for each camera that is recognised to be at fault: its calibration, its matches or its image;
            of `estimate_pose`, one for points of another size.
        rival: of AMBIGUOUS, the other motion that explains the matches, or as many of them, about as well; else None.
        second: the number of matches of a second body that moves otherwise over that of this one; 0 where none was seen.
        standing: the share of the matches that stand still while the object moves by little.
        camera_names: (C,) of the rig; unit: of its lengths, or "".
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
    camera_names: tuple[str, ...] = ()
    unit: str = ""

    @property
    def n_inliers(self) -> IntArray:
        """(C,) number of inliers per camera."""
        return np.array([int(mask.sum()) for mask in self.inliers], dtype=np.int64)

    def _told(self) -> Telling:
        status = f"{self.status.value}. {self.status.text}"
        names = self.camera_names or [f"camera {c}" for c in range(len(self.inliers))]
        of = [inliers_told(n, len(m), r) for n, m, r in zip(self.n_inliers, self.inliers, self.residuals, strict=True)]
        rows = [*named(list(zip(names, of, strict=True))), *(("at fault", fault) for fault in self.faults)]
        if self.motion is None:
            return Telling(self.status.value, rows, status)
        placed, center = self.method == "pose", self.motion.apply(self.center)
        by = center if placed else center - self.center
        sigma = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        said = [
            ("turned", turned(self.motion.rotation, self.covariance[:3, :3])),
            ("center at" if placed else "center moved by", lengths(by, sigma[3:], self.unit)),
        ]
        if self.rival is not None:
            said.append(("or else turned", turned(self.rival.rotation)))
        if len(self.unseen):
            said.append(("not seen", f"{len(self.unseen)} of the six directions of (w, d): `unseen`"))
        where = f"moved {length(float(np.linalg.norm(by)), self.unit)}"
        if placed:
            where = f"at {place_told(by)}"
        elif not np.isfinite(by @ self.covariance[3:, 3:] @ by) or self.status is Status.SCALE_NOT_OBSERVABLE:
            where = "how far it moved is not seen"
        brief = f"{self.status.value}, turned {turned(self.motion.rotation)}, {where}"
        return Telling(
            f"{brief}, {self.n_inliers.sum()} inliers in {len(self.inliers)} cameras", [*said, *rows], status
        )


@dataclass(frozen=True, eq=False, repr=False)
class RotationEstimate(Told):
    """A rotation and how well it is known: what every estimator of the paper's answers, with more of its own.

    Attributes:
        status: look at it first.
        rotation: (3, 3) R, X_j = R X_i + t in the world frame: the best guess where a part of the turn is not observable,
            NaN without any.
        information: (3, 3) of w, R = exp(w) R̂, world axes, 1/rad². It shows the directions that cannot be observed. Of
            estimators that ignore depth it counts what surfaces may have done (`sylvester.depth_bias`). Zero without
            an answer.
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

    def _told(self) -> Telling:
        rows = [("not seen", f"turns about {len(self.unseen)} of three axes: `unseen`")] if len(self.unseen) else []
        rows += [("iterations", str(self.iterations)), *self._told_besides()]
        status = f"{self.status.value}. {self.status.text}"
        if not np.isfinite(self.rotation).all():
            return Telling(self.status.value, rows, status)
        rotation = Rotation.from_matrix(self.rotation)
        said = [("turned", turned(rotation, self.covariance)), *rows]
        return Telling(f"{self.status.value}, turned {turned(rotation)}", said, status)

    def _told_besides(self) -> list[tuple[str, str]]:
        """Labels and what else an estimator has to say."""
        return []


def pan_tilt_roll(rotation: Rotation) -> FloatArray:
    """(3,) radians, R = R_y(pan) R_x(tilt) R_z(roll) (docs/conventions.md)."""
    return np.asarray(kind_of(rotation, Rotation, "rotation").as_euler("YXZ", suppress_warnings=True))


@dataclass(frozen=True, eq=False, repr=False)
class FramePose(Told):
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

    def of_frame(self, new_from_object: RigidTransform) -> Self:
        """The pose of another frame of the object: of its axes, and of the place of its origin.

        Raises:
            TypeError, ValueError: this is no single transform of finite values.
        """
        new_from_object = single_pose(new_from_object, "new_from_object")
        before = self.world_from_object
        if before is None:
            return self
        after = before * new_from_object.inv()
        # An error of the turn moves an origin elsewhere: d + w x r.
        by, (x, y, z) = np.eye(6), after.translation - before.translation
        by[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        return replace(self, world_from_object=after, covariance=carried(self.covariance, by))

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

    def _told(self) -> Telling:
        rows = [("reason", self.reason)] if self.reason else []
        if self.world_from_object is not None:
            angles = np.degrees(self.pan_tilt_roll)
            rows += [
                ("pan, tilt, roll", f"{vector(angles)}°, ± {vector(np.degrees(self.sigma[:3]), 3)}° about x, y, z"),
                ("position", spread(self.position, self.sigma[3:])),
            ]
        if self.observable is not Observable.ALL:
            rows.append(("not seen", self.observable.text))
        of = self.matches if len(self.matches) else self.inliers
        for c, (n, most, residual) in enumerate(zip(self.inliers, of, self.residuals, strict=True)):
            rows.append((f"camera {c}", inliers_told(n, most, residual)))
        rows += [("at fault", fault) for fault in self.faults]
        status = f"frame {self.index}, time {self.time:.3f}: {self.status.value}"
        return Telling(status, rows, f"{status}. {self.status.text}")


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Told):
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

    @property
    def turn(self) -> FloatArray:
        """(N,) angle turned since the first solved frame, radians in [0, pi]; NaN where there is no pose."""
        turns = np.full(len(self), np.nan)
        rows = [k for k, frame in enumerate(self.frames) if frame.world_from_object is not None]
        poses = [pose for frame in self.frames if (pose := frame.world_from_object) is not None]
        if poses:
            turned = Rotation.from_quat([pose.rotation.as_quat() for pose in poses])
            turns[rows] = (turned * poses[0].rotation.inv()).magnitude()
        return turns

    def _told(self) -> Telling:
        found = [f for f in self if f.measured]
        brief = f"{len(found)} of {len(self)} frames with a pose"
        of = Counter(f.status for f in self).most_common()
        rows = [("frames", ", ".join(f"{status.value} {count}" for status, count in of))] if of else []
        if found:
            turn, moved = self.turn[self.solved], self.positions[self.solved]
            by = length(float(np.linalg.norm(moved[-1] - moved[0])), self.unit)
            path = length(float(np.linalg.norm(np.diff(moved, axis=0), axis=1).sum()), self.unit)
            last, most = np.degrees(turn[-1]), np.degrees(turn.max())
            brief += f", turned {last:.1f}°, moved {by}"
            rows += [
                ("time", f"{found[0].time:.3f} to {found[-1].time:.3f}"),
                ("turned", f"{last:.1f}° from the first to the last, {most:.1f}° at most"),
                ("moved", f"{by} from the first to the last, along a path of {path}"),
            ]
        cameras = []
        for c, name in enumerate(self.camera_names):
            used = [f for f in found if f.inliers[c] > 0]
            middle = (
                [np.median([f.inliers[c] for f in used]), np.median([f.residuals[c] for f in used])] if used else []
            )
            said = ", in the median {:.0f} inliers, residual {:.2f} px".format(*middle) if used else ""
            cameras.append((name, f"used in {len(used)} frames{said}"))
        return Telling(brief, [*rows, *named(cameras)])

    def plot(self, *, note: str = "") -> Any:
        """Angles, position, inliers and residuals over time, as in `report.png`: a `matplotlib.figure.Figure`, which a
        notebook shows.

        Args:
            note: a line below.

        Raises:
            ValueError: a trajectory without frames.
        """
        # What draws results, and makes tables of them, stands above them: it is looked up when it is asked for.
        return import_module("sylpose.report.plots").trajectory_figure(self, note=note)

    def to_dataframe(self) -> Any:
        """The columns of trajectory.csv (docs/formats.md) as a `pandas.DataFrame`, not rounded: NaN where there is no value.

        Raises:
            ModuleNotFoundError: pandas is not installed.
        """
        return import_module("sylpose.report.tables").dataframe(self)
