"""Constant-velocity motion model with an adaptive uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import rotation_matrix_of, rotvec
from sylpose.geometry.numba_linalg import apply_rotvec
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.rig import Rig

# Standard deviation of the constant-velocity prior, in units of the usual change of velocity. The prior is used once so
# many consecutive frames were solved (choice).
PREDICTION_SDS, MIN_STEADY_FRAMES = 5.0, 5
# Largest accepted difference between prediction and fit (chi-squared of six: chance exceeds it once in a thousand
# times).
MAX_PREDICTION_ERROR = chi_squared_bound(6)
# Number of frames over which the usual change is averaged (choice).
AVERAGING_FRAMES = 5
# The velocity is not updated from an interval shorter than this share of the usual one (choice).
MIN_INTERVAL_RATIO = 0.2


@dataclass(frozen=True, eq=False)
class VelocityModel:
    """Constant-velocity model: the last motion and its variability.

    Attributes:
        twist: (6,) exponential coordinates per second, rotation first, in the world.
        change_variance: (6,) mean squared changes of angular velocity and of the center's velocity, per second.
        n_frames: number of consecutive solved frames.
        interval: usual time between them, seconds.
    """

    twist: FloatArray = field(default_factory=lambda: np.zeros(6))
    change_variance: FloatArray = field(default_factory=lambda: np.zeros(6))
    n_frames: int = 0
    interval: float = 0.0

    def predict_motion(self, elapsed: float) -> RigidTransform:
        """Predict the motion over some seconds."""
        return RigidTransform.from_exp_coords(self.twist * elapsed)

    def update(self, motion: RigidTransform, center: FloatArray, elapsed: float) -> VelocityModel:
        """Update with the motion to the next frame.

        Args:
            motion: of the object.
            center: (3,) of the object at its start.
            elapsed: seconds.
        """
        # Over a very short interval the pose difference is mostly noise.
        if self.n_frames and elapsed < MIN_INTERVAL_RATIO * self.interval:
            return self
        elapsed = max(elapsed, 1e-9)
        interval, change_variance = elapsed, self.change_variance
        # The first motion is a change by itself.
        if self.n_frames:
            interval = self.interval + (elapsed - self.interval) / AVERAGING_FRAMES
            change = (
                self._compute_prediction_error(
                    rotation_matrix_of(motion), motion.apply(center) - center, center, elapsed
                )
                / elapsed
            )
            change_variance = change_variance + (change**2 - change_variance) / min(self.n_frames, AVERAGING_FRAMES)
        return VelocityModel(motion.as_exp_coords() / elapsed, change_variance, self.n_frames + 1, interval)

    def reset(self, *, is_static: bool) -> VelocityModel:
        """Reset after unsolved frames.

        The variability is kept, and so is the velocity unless the object `is_static`.
        """
        return replace(self, n_frames=0, twist=np.zeros(6) if is_static else self.twist)

    def predict_covariance(self, elapsed: float, n_missed: int) -> FloatArray:
        """Predict the covariance (6, 6) of (w, d) of the motion; infinite while it is unknown.

        Args:
            elapsed: seconds.
            n_missed: number of unsolved frames within that time.
        """
        if not self.change_variance.any():  # fewer than two motions so far
            return np.full((6, 6), np.inf)
        return np.asarray(np.diag(self.change_variance) * n_missed * elapsed**2)

    def fuse(
        self, rotation: FloatArray, translation: FloatArray, information: FloatArray, center: FloatArray, elapsed: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Fuse a motion since the last frame with the constant-velocity prediction.

        The prediction is weak and matters where matches provide little, as when all but a corner of the object is
        hidden. It is ignored if the matches contradict it: then the object has started, stopped or reversed.

        Args:
            rotation: (3, 3) R.
            translation: (3,) d.
            information: (6, 6) of (w, d).
            center: (3,) of the object in the last frame, `elapsed` seconds ago.

        Returns:
            the three, corrected.
        """
        # An object that has been static so far gives no information on its motion.
        if self.n_frames < MIN_STEADY_FRAMES or not self.change_variance.any():
            return rotation, translation, information
        error = self._compute_prediction_error(rotation, translation, center, elapsed)
        sd = np.maximum(PREDICTION_SDS * elapsed * np.sqrt(_sum_by_parts(self.change_variance)), 1e-12)
        prediction, fused_information = np.diag(sd**-2), information + np.diag(sd**-2)
        # error' (covariance of the fit + diag(sd²))^-1 error, without inverting an information matrix that may be
        # singular.
        weighted = prediction @ error
        if weighted @ error - weighted @ np.linalg.solve(fused_information, weighted) > MAX_PREDICTION_ERROR:
            return rotation, translation, information
        step = -np.linalg.solve(fused_information, prediction @ error)
        corrected = np.empty((3, 3))
        apply_rotvec(np.asarray(step[:3], float), rotation, corrected)
        return corrected, translation + step[3:], fused_information

    def synchronize_rig(
        self, rig: Rig, time_offsets: FloatArray, center: FloatArray, motion: RigidTransform, elapsed: float
    ) -> Rig:
        """Return the rig with camera poses corrected for their time offsets.

        With these poses, the moving object appears as if all images were taken at the same time.

        Args:
            time_offsets: (C,) time offsets, seconds.
            center: (3,) of the object.
            motion: of the object within `elapsed` seconds, which gives its velocity.
        """
        twist = motion.as_exp_coords() / max(elapsed, 1e-9)
        if not time_offsets.any() or not twist.any():
            return rig
        # A velocity that changes between frames by its own size is no estimate for the times between.
        velocity = np.concatenate([twist[:3], np.cross(twist[:3], center) + twist[3:]])
        square, change = _sum_by_parts(velocity**2), _sum_by_parts(self.change_variance)
        velocity = velocity * square / np.maximum(square + change, 1e-300)
        twist = np.concatenate([velocity[:3], velocity[3:] - np.cross(velocity[:3], center)])
        cameras = [
            replace(
                camera, camera_from_world=camera.camera_from_world * RigidTransform.from_exp_coords(twist * seconds)
            )
            for camera, seconds in zip(rig, time_offsets, strict=True)
        ]
        return Rig(cameras, rig.unit)

    def _compute_prediction_error(
        self, rotation: FloatArray, translation: FloatArray, center: FloatArray, elapsed: float
    ) -> FloatArray:
        """Return the difference (6,) of (w, d) between a motion and the prediction."""
        predicted_pose = self.predict_motion(elapsed)
        rotation_error = rotvec(rotation @ rotation_matrix_of(predicted_pose).T)
        return np.concatenate([rotation_error, translation - (predicted_pose.apply(center) - center)])


def _sum_by_parts(squares: FloatArray) -> FloatArray:
    """Return the sums of the first and the last three elements, each repeated three times (6,)."""
    return np.repeat(squares.reshape(2, 3).sum(axis=1), 3)
