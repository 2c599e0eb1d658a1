"""How an object goes on from the last frame: at constant velocity, as well as it has kept to that so far."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import turn_by
from sylpose.geometry.rigid import rotvec, turn_of
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.rig import Rig

__all__ = ["Velocity"]


# The weight of constant velocity beside a frame's matches: its standard deviation is this many times the usual change of
# velocity. It counts once so many frames in a row were solved (choice).
SPREAD, STEADY_FRAMES = 5.0, 5
# What constant velocity and a fit may differ by (chi-squared of six: chance exceeds it once in a thousand times).
SURPRISING = chi_squared_bound(6)
# The usual change is a mean over about so many frames (choice).
MEMORY = 5
# A velocity is not taken from an interval shorter than this share of the usual one (choice).
SHORT = 0.2


@dataclass(frozen=True, eq=False)
class Velocity:
    """The last motion, and how much the motion changes from frame to frame.

    Attributes:
        twist: (6,) exponential coordinates per second, rotation first, in the world.
        unsteady: (6,) mean square of the changes of the turn and of the centre's velocity, per second.
        frames: solved in a row.
        interval: the usual one between them, seconds.
    """

    twist: FloatArray = field(default_factory=lambda: np.zeros(6))
    unsteady: FloatArray = field(default_factory=lambda: np.zeros(6))
    frames: int = 0
    interval: float = 0.0

    def motion(self, elapsed: float) -> RigidTransform:
        """What it gives for some seconds."""
        return RigidTransform.from_exp_coords(self.twist * elapsed)

    def learnt(self, motion: RigidTransform, center: FloatArray, elapsed: float) -> Velocity:
        """With the motion (of which the centre (3,) is at its start) of the next frame taken in."""
        # Of two frames at nearly the same time, the difference of the poses is mostly their errors.
        if self.frames and elapsed < SHORT * self.interval:
            return self
        elapsed = max(elapsed, 1e-9)
        interval, unsteady = elapsed, self.unsteady
        # The first motion is a change by itself.
        if self.frames:
            interval = self.interval + (elapsed - self.interval) / MEMORY
            change = self._surprise(turn_of(motion), motion.apply(center) - center, center, elapsed) / elapsed
            unsteady = unsteady + (change**2 - unsteady) / min(self.frames, MEMORY)
        return Velocity(motion.as_exp_coords() / elapsed, unsteady, self.frames + 1, interval)

    def forgotten(self, *, stands: bool) -> Velocity:
        """After frames that were not solved: the usual change stays, the velocity too unless it `stands`."""
        return replace(self, frames=0, twist=np.zeros(6) if stands else self.twist)

    def spread(self, elapsed: float, missed: int) -> FloatArray:
        """(6, 6) covariance of (w, d) of its motion after some seconds, in which so many frames were missed; infinite while
        nothing is known of it."""
        if not self.unsteady.any():  # two motions have not been seen yet
            return np.full((6, 6), np.inf)
        return np.asarray(np.diag(self.unsteady) * missed * elapsed**2)

    def added_to(
        self, rotation: FloatArray, shift: FloatArray, information: FloatArray, center: FloatArray, elapsed: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A motion since the last frame, with what constant velocity says as one more measurement.

        It is a weak one, and matters where the matches say little: when all but a corner of the object is hidden. Where they
        contradict it, the object has started, stopped or turned round.

        Args:
            rotation: (3, 3) R; shift: (3,) d; information: (6, 6) of (w, d).
            center: (3,) of the object in the last frame, `elapsed` seconds ago.

        Returns:
            the three, corrected.
        """
        # What stood all the time, by all that is known, tells nothing of how it moves.
        if self.frames < STEADY_FRAMES or not self.unsteady.any():
            return rotation, shift, information
        error = self._surprise(rotation, shift, center, elapsed)
        sd = np.maximum(SPREAD * elapsed * np.sqrt(_by_parts(self.unsteady)), 1e-12)
        prediction, both = np.diag(sd**-2), information + np.diag(sd**-2)
        # error' (covariance of the fit + diag(sd²))^-1 error, without inverting what the matches may not have seen.
        weighted = prediction @ error
        if weighted @ error - weighted @ np.linalg.solve(both, weighted) > SURPRISING:
            return rotation, shift, information
        step = -np.linalg.solve(both, prediction @ error)
        corrected = np.empty((3, 3))
        turn_by(np.asarray(step[:3], float), rotation, corrected)
        return corrected, shift + step[3:], both

    def rig_seen_at_once(
        self, rig: Rig, late: FloatArray, center: FloatArray, motion: RigidTransform, elapsed: float
    ) -> Rig:
        """The rig as it would have to stand to see at one instant what its cameras saw each at its own.

        Args:
            late: (C,) seconds after that instant.
            center: (3,) of the object.
            motion: of the object within `elapsed` seconds, which tells its speed.
        """
        twist = motion.as_exp_coords() / max(elapsed, 1e-9)
        if not late.any() or not twist.any():
            return rig
        # A speed that changes from frame to frame by as much as it is says little about an instant in between.
        speed = np.concatenate([twist[:3], np.cross(twist[:3], center) + twist[3:]])
        square, change = _by_parts(speed**2), _by_parts(self.unsteady)
        speed = speed * square / np.maximum(square + change, 1e-300)
        twist = np.concatenate([speed[:3], speed[3:] - np.cross(speed[:3], center)])
        cameras = [
            replace(
                camera, camera_from_world=camera.camera_from_world * RigidTransform.from_exp_coords(twist * seconds)
            )
            for camera, seconds in zip(rig, late, strict=True)
        ]
        return Rig(cameras, rig.unit)

    def _surprise(self, rotation: FloatArray, shift: FloatArray, center: FloatArray, elapsed: float) -> FloatArray:
        """(6,) of (w, d): by how much a motion differs from what constant velocity gives."""
        ahead = self.motion(elapsed)
        turn = rotvec(rotation @ turn_of(ahead).T)
        return np.concatenate([turn, shift - (ahead.apply(center) - center)])


def _by_parts(squares: FloatArray) -> FloatArray:
    """(6,) the sums of the first three and of the last three, each three times."""
    return np.repeat(squares.reshape(2, 3).sum(axis=1), 3)
