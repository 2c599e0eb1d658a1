"""What is exported of a trajectory: poses that were measured, and gaps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.results import Trajectory
from sylpose.units import METRES

__all__ = ["AXIS_M", "UP_UNKNOWN", "Poses", "runs_of"]

# How long the object's axes are where a format draws them, metres, or units where these are not known (choice: a hand's).
AXIS_M = 0.1
# Of formats that say which axis is up.
UP_UNKNOWN = (
    "axes are the calibration's, which does not say where up is, and the format takes y for it (track --world up=X,Y,Z "
    "would say it)"
)
# Of steps of time, that count as one rate (choice: time stamps of a millisecond at 100 frames a second, and half of that).
STEADY = 0.15


@dataclass(frozen=True, eq=False)
class Poses:
    """world_from_object in N frames.

    Attributes:
        name: of the object.
        indices: (N,) numbers of the frames in the recording.
        times: (N,) seconds, increasing.
        positions: (N, 3) of the object's centre; NaN in gaps.
        quaternions: (N, 4) w last, continuous in sign; NaN in gaps.
        unit: of lengths, or "".
        z_up: whether the world's z axis is known to go up; else nobody knows what does.
    """

    name: str
    indices: list[int]
    times: FloatArray
    positions: FloatArray
    quaternions: FloatArray
    unit: str
    z_up: bool = False

    @classmethod
    def of(cls, trajectory: Trajectory, name: str = "object", z_up: bool = False) -> Self:
        """The measured poses.

        Raises:
            ValueError: no pose was measured; times that do not increase; a name that is no text.
        """
        if not name.strip() or not name.isprintable():
            raise ValueError(f"the object's name must be text, got {name!r}")
        frames = list(trajectory)
        if not any(f.measured for f in frames):
            raise ValueError(f"no pose was measured in the {len(frames)} frames that are asked for: nothing to export")
        if any(b.time <= a.time for a, b in pairwise(frames)):
            raise ValueError("the frames' times do not increase")
        quaternions = np.full((len(frames), 4), np.nan)
        before = np.array([0.0, 0.0, 0.0, 1.0])
        for i, frame in enumerate(frames):
            if frame.measured and frame.world_from_object is not None:
                quaternion = frame.world_from_object.rotation.as_quat()
                before = quaternions[i] = -quaternion if quaternion @ before < 0 else quaternion
        positions = np.array([f.position if f.measured else np.full(3, np.nan) for f in frames])
        indices, times = [f.index for f in frames], np.array([f.time for f in frames])
        return cls(name, indices, times, positions, quaternions, trajectory.unit, z_up)

    def __len__(self) -> int:
        return len(self.times)

    @property
    def found(self) -> BoolArray:
        """(N,) frames with a pose."""
        return np.asarray(np.isfinite(self.positions).all(axis=1))

    @property
    def word(self) -> str:
        """The name without blanks."""
        return "_".join(self.name.split())

    @property
    def axis(self) -> float:
        """How long the object's axes are drawn, in its unit."""
        return AXIS_M / METRES.get(self.unit, 1.0)

    def in_unit(self, unit: str) -> Self:
        """The same with its lengths in a format's unit, where its own is known."""
        if self.unit not in METRES:
            return self
        return replace(self, positions=self.positions * (METRES[self.unit] / METRES[unit]), unit=unit)

    def with_y_up(self) -> Self:
        """The same for formats whose y axis goes up, in a world that is turned about x; as it is where up is not known."""
        if not self.z_up:
            return self
        found, turn = self.found, Rotation.from_euler("x", -90.0, degrees=True)
        positions, quaternions = self.positions.copy(), self.quaternions.copy()
        positions[found] = turn.apply(positions[found])
        quaternions[found] = (turn * Rotation.from_quat(quaternions[found])).as_quat()
        return replace(self, positions=positions, quaternions=quaternions, z_up=False)

    def rate(self, format_: str) -> float:
        """Frames per second, for a format that has one for all.

        Raises:
            ValueError: naming the format; frames that are not at a steady rate.
        """
        steps = np.diff(self.times)
        if not len(steps):
            return 1.0
        step = float(np.median(steps))
        if np.abs(steps - step).max() > STEADY * step:
            raise ValueError(
                f"{format_} has one rate for all frames, and these are {steps.min():g} to {steps.max():g} s apart; csv, "
                "tum, gltf, usd, rosbag and parquet have their times"
            )
        return float((len(self) - 1) / (self.times[-1] - self.times[0]))

    def markers(self) -> tuple[list[str], FloatArray]:
        """Four points on the object, its centre and the ends of its axes: names, and (N, 4, 3) places; NaN in gaps."""
        points = self.axis * np.vstack([np.zeros(3), np.eye(3)])
        found = self.found
        places = np.full((len(self), 4, 3), np.nan)
        turned = Rotation.from_quat(self.quaternions[found]).as_matrix()
        places[found] = np.einsum("nij,pj->npi", turned, points) + self.positions[found, None]
        return [f"{self.word}_{end}" for end in ("O", "X", "Y", "Z")], places

    def trimmed(self) -> Self:
        """Without gaps before the first pose and after the last one."""
        found = np.flatnonzero(self.found)
        kept = slice(int(found[0]), int(found[-1]) + 1)
        return replace(
            self,
            indices=self.indices[kept],
            times=self.times[kept],
            positions=self.positions[kept],
            quaternions=self.quaternions[kept],
        )


def runs_of(found: BoolArray) -> list[tuple[int, int]]:
    """First frame and the one behind the last of each run of frames with a pose."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], found, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(change[::2], change[1::2], strict=True)]
