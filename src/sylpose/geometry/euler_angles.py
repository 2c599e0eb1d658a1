"""Three angles that tell a rotation: about axes of the coordinate systems, or about any three that are given."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray

__all__ = ["PAN_TILT_ROLL", "Angles", "angles_of"]

# Cosine of the angle between consecutive axes that count as square (choice: what three decimals leave of it).
SQUARE = 2e-3
# Of the middle angle's cosine or sine: nearer to it the two others cannot be told apart (choice).
LOCKED = 1e-3


@dataclass(frozen=True, eq=False)
class Angles:
    """What three angles turn about, one after the other.

    R = exp(a1 e1) exp(a2 e2) exp(a3 e3) where they are intrinsic (each about the axis as it was turned before), the other
    way round where they are extrinsic (each about the axis as it stands).

    Attributes:
        names: of the three angles.
        axes: (3, 3) unit vectors e1, e2, e3 as rows, the second one square to the others.
        intrinsic: which of the two.
        text: as `angles_of` reads it.
    """

    names: tuple[str, str, str]
    axes: FloatArray
    intrinsic: bool
    text: str

    def of(self, rotation: Rotation) -> FloatArray:
        """(3,) radians, or (n, 3) of n rotations: the middle one in the range of SciPy's `Rotation.as_davenport`."""
        order = "intrinsic" if self.intrinsic else "extrinsic"
        return np.asarray(rotation.as_davenport(self.axes, order, suppress_warnings=True))

    def rotation(self, angles: ArrayLike) -> Rotation:
        """The rotation, or n of them, of (3,) or (n, 3) angles in radians."""
        return Rotation.from_davenport(self.axes, "intrinsic" if self.intrinsic else "extrinsic", angles)

    def sigma(self, rotation: Rotation, covariance: ArrayLike) -> FloatArray:
        """(3,) standard deviations of the angles, radians, from the (3, 3) covariance of w in R = exp(w) R̂; NaN where the
        middle angle leaves the two others apart unknown, or where the covariance is not finite.

        w = e1 da1 + R1 e2 da2 + R1 R2 e3 da3 of intrinsic angles, inverted.
        """
        covariance = np.asarray(covariance, dtype=float)
        if not np.isfinite(covariance).all():
            return np.full(3, np.nan)
        order = [0, 1, 2] if self.intrinsic else [2, 1, 0]
        before, columns = Rotation.identity(), np.empty((3, 3))
        for k, angle in zip(order, self.of(rotation)[order], strict=True):
            columns[:, k] = before.apply(self.axes[k])
            before = before * Rotation.from_rotvec(angle * self.axes[k])
        if abs(np.linalg.det(columns)) < LOCKED:
            return np.full(3, np.nan)
        angles_from_w = np.linalg.inv(columns)
        return np.asarray(np.sqrt(np.diag(angles_from_w @ covariance @ angles_from_w.T)))


def angles_of(text: str) -> Angles:
    """What "XYZ", "zxz" or "0,0,1 1,0,0 0,1,0" mean.

    Three capitals are axes that turn along (intrinsic), small letters axes that stand (extrinsic), as in SciPy's
    `Rotation.as_euler`; three vectors are axes that turn along, such as those of a joint.

    Raises:
        ValueError: anything else; two axes in a row that are not square to each other.
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
                "angles: three axes are expected, such as XYZ (which turn along), xyz (which stand) or "
                f'"0,0,1 1,0,0 0,1,0", got {text!r}'
            )
        axes = axes / np.abs(axes).max(axis=1, keepdims=True)
        axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        names, intrinsic = ["angle1", "angle2", "angle3"], True
    if abs(axes[0] @ axes[1]) > SQUARE or abs(axes[1] @ axes[2]) > SQUARE:
        raise ValueError(f"angles: each axis must be square to the one before it, got {text!r}")
    if np.array_equal(np.abs(axes), np.round(np.abs(axes))):
        return Angles((names[0], names[1], names[2]), axes, intrinsic, text)
    # Exactly square, the middle axis as it was given.
    ends = axes[[0, 2]] - np.outer(axes[[0, 2]] @ axes[1], axes[1])
    axes[[0, 2]] = ends / np.linalg.norm(ends, axis=1, keepdims=True)
    return Angles((names[0], names[1], names[2]), axes, intrinsic, text)


# R = R_y(pan) R_x(tilt) R_z(roll), as docs/conventions.md has them (choice).
PAN_TILT_ROLL = Angles(("pan", "tilt", "roll"), np.eye(3)[[1, 0, 2]], True, "YXZ")
