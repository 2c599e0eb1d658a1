"""Euler angles: rotations as three angles about coordinate axes or any three given axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import format_value

# Cosine of the angle between consecutive axes that count as perpendicular (choice: the accuracy of three decimals).
MAX_AXES_COSINE = 2e-3
# Determinant of the axes, the middle angle's cosine or sine, below which the angles are in gimbal lock (choice).
MIN_DETERMINANT = 1e-3


@dataclass(frozen=True, eq=False)
class EulerAngles:
    """A sequence of three rotation axes.

    R = exp(a1 e1) exp(a2 e2) exp(a3 e3) for intrinsic angles (about the rotated axes), in reverse order for extrinsic
    ones (about the fixed axes).

    Attributes:
        names: of the three angles.
        axes: (3, 3) unit vectors e1, e2, e3 as rows, the second one perpendicular to the others.
        intrinsic: whether the angles are intrinsic.
        text: as parsed by `parse_euler_angles`.
    """

    names: tuple[str, str, str]
    axes: FloatArray
    intrinsic: bool
    text: str

    def from_rotation(self, rotation: Rotation) -> FloatArray:
        """Return (3,) radians, or (n, 3) of n rotations; ranges as of SciPy's `Rotation.as_davenport`."""
        order = "intrinsic" if self.intrinsic else "extrinsic"
        return np.asarray(rotation.as_davenport(self.axes, order, suppress_warnings=True))

    def to_rotation(self, angles: ArrayLike) -> Rotation:
        """Return the rotation, or n of them, of (3,) or (n, 3) angles in radians."""
        return Rotation.from_davenport(self.axes, "intrinsic" if self.intrinsic else "extrinsic", angles)

    def sigma(self, rotation: Rotation, covariance: ArrayLike) -> FloatArray:
        """Return (3,) standard deviations of the angles, radians, from the (3, 3) covariance of w in R = exp(w) R̂.

        NaN in gimbal lock, or for a covariance that is not finite. w = e1 da1 + R1 e2 da2 + R1 R2 e3 da3 for intrinsic
        angles, inverted.
        """
        covariance = np.asarray(covariance, dtype=float)
        if not np.isfinite(covariance).all():
            return np.full(3, np.nan)
        order = [0, 1, 2] if self.intrinsic else [2, 1, 0]
        previous_rotation, columns = Rotation.identity(), np.empty((3, 3))
        for k, angle in zip(order, self.from_rotation(rotation)[order], strict=True):
            columns[:, k] = previous_rotation.apply(self.axes[k])
            previous_rotation = previous_rotation * Rotation.from_rotvec(angle * self.axes[k])
        if abs(np.linalg.det(columns)) < MIN_DETERMINANT:
            return np.full(3, np.nan)
        angles_from_w = np.linalg.inv(columns)
        return np.asarray(np.sqrt(np.diag(angles_from_w @ covariance @ angles_from_w.T)))


def parse_euler_angles(text: str) -> EulerAngles:
    """Parse a sequence of axes: "XYZ", "zxz" or "0,0,1 1,0,0 0,1,0".

    Three capitals are rotated axes (intrinsic), small letters fixed axes (extrinsic), as in SciPy's
    `Rotation.as_euler`; three vectors are rotated axes, such as those of a joint.

    Raises:
        ValueError: anything else; consecutive axes that are not perpendicular.
    """
    axes: FloatArray
    if len(text) == 3 and (set(text) <= set("XYZ") or set(text) <= set("xyz")):
        axes = np.eye(3)[["xyz".index(letter) for letter in text.lower()]]
        names = [f"angle{k}_{letter}" for k, letter in enumerate(text, start=1)]
        intrinsic = text.isupper()
    else:
        try:
            axes = np.array([[float(cell) for cell in word.split(",")] for word in text.split()])
        except ValueError:
            axes = np.empty(0)
        if axes.shape != (3, 3) or not np.isfinite(axes).all() or not (np.abs(axes).max(axis=1) > 0).all():
            raise ValueError(
                "angles: expected three axes, such as XYZ (intrinsic), xyz (extrinsic) or "
                f'"0,0,1 1,0,0 0,1,0", got {format_value(text)}'
            )
        axes = axes / np.abs(axes).max(axis=1, keepdims=True)
        axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        names, intrinsic = ["angle1", "angle2", "angle3"], True
    if abs(axes[0] @ axes[1]) > MAX_AXES_COSINE or abs(axes[1] @ axes[2]) > MAX_AXES_COSINE:
        raise ValueError(f"angles: each axis must be perpendicular to the previous one, got {text!r}")
    if np.array_equal(np.abs(axes), np.round(np.abs(axes))):
        return EulerAngles((names[0], names[1], names[2]), axes, intrinsic, text)
    # Exactly perpendicular, with the middle axis unchanged.
    outer_axes = axes[[0, 2]] - np.outer(axes[[0, 2]] @ axes[1], axes[1])
    axes[[0, 2]] = outer_axes / np.linalg.norm(outer_axes, axis=1, keepdims=True)
    return EulerAngles((names[0], names[1], names[2]), axes, intrinsic, text)


# Definition in docs/conventions.md: R = R_y(pan) R_x(tilt) R_z(roll) (choice).
PAN_TILT_ROLL = EulerAngles(("pan", "tilt", "roll"), np.eye(3)[[1, 0, 2]], True, "YXZ")
