"""Trajectory data for export: measured poses and gaps."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.euler_angles import EulerAngles
from sylpose.results import Trajectory
from sylpose.rig import Camera
from sylpose.units import METERS

# Length of the object's axes where a format draws them, meters, or units if unknown (choice: size of a hand).
AXIS_LENGTH_M = 0.1
# Note for formats with a fixed up axis.
UP_UNKNOWN_NOTE = (
    "axes are the calibration's; its up direction is unknown, and the format assumes y (set it by track "
    "--world up=X,Y,Z)"
)
# Relative deviation of time steps accepted as one rate (choice: timestamps of a millisecond at 100 frames a second,
# and half of that).
MAX_STEP_DEVIATION = 0.15


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What formats for viewing contain besides the trajectory, in the trajectory's world and unit.

    Attributes:
        cameras: cameras of the recording.
        points: (n, 3) points on the object, in its own frame.
        colors: (n, 3) of them, in [0, 1].
    """

    cameras: tuple[Camera, ...] = ()
    points: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    colors: FloatArray = field(default_factory=lambda: np.empty((0, 3)))

    def scale(self, factor: float) -> Self:
        """Multiply all lengths by a factor."""
        cameras = []
        for camera in self.cameras:
            old = camera.camera_from_world
            new = RigidTransform.from_components(factor * old.translation, old.rotation)
            cameras.append(replace(camera, camera_from_world=new))
        return replace(self, cameras=tuple(cameras), points=factor * self.points)


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses world_from_object in N frames.

    Attributes:
        name: name of the object.
        indices: (N,) numbers of the frames in the recording.
        times: (N,) seconds, increasing.
        positions: (N, 3) of the object's center; NaN in gaps.
        quaternions: (N, 4) w last, continuous in sign; NaN in gaps.
        unit: unit of lengths, or "".
        z_up: whether the world's z axis is known to be up; otherwise the up direction is unknown.
        surroundings: cameras and points, for formats for viewing.
        angles: axes of the angles, for formats that have angles; None for the format's own.
    """

    name: str
    indices: list[int]
    times: FloatArray
    positions: FloatArray
    quaternions: FloatArray
    unit: str
    z_up: bool = False
    surroundings: Surroundings = field(default_factory=Surroundings)
    angles: EulerAngles | None = None

    @classmethod
    def from_trajectory(cls, trajectory: Trajectory, name: str = "object", z_up: bool = False) -> Self:
        """Select the measured poses of a trajectory.

        Raises:
            ValueError: no pose was measured; times that do not increase; a name that is not printable text.
        """
        if not name.strip() or not name.isprintable():
            raise ValueError(f"the object's name must be text, got {name!r}")
        frames = list(trajectory)
        if not any(f.is_measured for f in frames):
            raise ValueError(f"no pose was measured in the {len(frames)} selected frames: nothing to export")
        if any(b.time <= a.time for a, b in pairwise(frames)):
            raise ValueError("the frames' times do not increase")
        quaternions = np.full((len(frames), 4), np.nan)
        previous = np.array([0.0, 0.0, 0.0, 1.0])
        for i, frame in enumerate(frames):
            if frame.is_measured and frame.world_from_object is not None:
                quaternion = frame.world_from_object.rotation.as_quat()
                previous = quaternions[i] = -quaternion if quaternion @ previous < 0 else quaternion
        positions = np.array([f.position if f.is_measured else np.full(3, np.nan) for f in frames])
        indices, times = [f.index for f in frames], np.array([f.time for f in frames])
        return cls(name, indices, times, positions, quaternions, trajectory.unit, z_up)

    def __len__(self) -> int:
        return len(self.times)

    @property
    def has_pose(self) -> BoolArray:
        """Return a mask (N,) of the frames with a pose."""
        return np.asarray(np.isfinite(self.positions).all(axis=1))

    @property
    def identifier(self) -> str:
        """Return the name without blanks."""
        return "_".join(self.name.split())

    @property
    def axis_length(self) -> float:
        """Return the drawn length of the object's axes, in its unit."""
        return AXIS_LENGTH_M / METERS.get(self.unit, 1.0)

    def in_unit(self, unit: str) -> Self:
        """Convert lengths to a format's unit; unchanged if the own unit is unknown."""
        if self.unit not in METERS:
            return self
        factor = METERS[self.unit] / METERS[unit]
        return replace(self, positions=self.positions * factor, unit=unit, surroundings=self.surroundings.scale(factor))

    def note_unit(self, expected: str) -> list[str]:
        """Return a note if lengths are not in a format's unit, since the own one is unknown."""
        return [] if self.unit == expected else [f"lengths are in the calibration's unknown unit, not {expected}"]

    def with_y_up(self) -> Self:
        """Rotate the world about x for formats with y up; unchanged if up is unknown."""
        if not self.z_up:
            return self
        has_pose, rotation = self.has_pose, Rotation.from_euler("x", -90.0, degrees=True)
        positions, quaternions = self.positions.copy(), self.quaternions.copy()
        positions[has_pose] = rotation.apply(positions[has_pose])
        quaternions[has_pose] = (rotation * Rotation.from_quat(quaternions[has_pose])).as_quat()
        return replace(self, positions=positions, quaternions=quaternions, z_up=False)

    def compute_rate(self, format_: str) -> float:
        """Compute the frame rate, frames per second, for formats that have a single one.

        Raises:
            ValueError: naming the format; frames that are not at a steady rate.
        """
        steps = np.diff(self.times)
        if not len(steps):
            return 1.0
        step = float(np.median(steps))
        if np.abs(steps - step).max() > MAX_STEP_DEVIATION * step:
            raise ValueError(
                f"{format_} requires a constant rate, and frames are {steps.min():g} to {steps.max():g} s apart; csv, "
                "tum, gltf, usd, rosbag and parquet store frame times"
            )
        return float((len(self) - 1) / (self.times[-1] - self.times[0]))

    @property
    def typical_rate(self) -> float:
        """Return the frame rate by the median step, also of unsteady times; 1 for a single frame."""
        return round(1.0 / float(np.median(np.diff(self.times))), 6) if len(self) > 1 else 1.0

    def compute_markers(self) -> tuple[list[str], FloatArray]:
        """Compute four points on the object, its center and axis ends: names, and positions (N, 4, 3); NaN in gaps."""
        points = self.axis_length * np.vstack([np.zeros(3), np.eye(3)])
        found = self.has_pose
        positions = np.full((len(self), 4, 3), np.nan)
        rotations = Rotation.from_quat(self.quaternions[found]).as_matrix()
        positions[found] = np.einsum("nij,pj->npi", rotations, points) + self.positions[found, None]
        return [f"{self.identifier}_{end}" for end in ("O", "X", "Y", "Z")], positions

    def trim(self) -> Self:
        """Remove gaps before the first pose and after the last one."""
        valid = np.flatnonzero(self.has_pose)
        selection = slice(int(valid[0]), int(valid[-1]) + 1)
        columns = {name: getattr(self, name)[selection] for name in ("indices", "times", "positions", "quaternions")}
        return replace(self, **columns)


def look_along_minus_z(camera: Camera) -> RigidTransform:
    """Return world_from_camera with x right, y up and z backwards, as in glTF, USD and OpenGL."""
    backwards = RigidTransform.from_rotation(Rotation.from_euler("x", 180.0, degrees=True))
    return camera.camera_from_world.inv() * backwards


def find_runs(has_pose: BoolArray) -> list[tuple[int, int]]:
    """Find the runs of frames with a pose, each as (first, last + 1)."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], has_pose, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(change[::2], change[1::2], strict=True)]
