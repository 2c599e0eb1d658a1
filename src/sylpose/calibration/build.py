"""From the numbers of a calibration file to a `Camera`: the checks that all formats share."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.numerics.arrays import FloatArray
from sylpose.rig import Camera, LensModel, Rig

__all__ = ["convert", "make_camera", "make_pose", "make_rig", "rigid"]

T = TypeVar("T", bound=msgspec.Struct)

# Calibrations written with a few digits are still rotations to about 1e-4; a larger gap is a mistake in the file
# (choice: ten times those).
ROTATION_TOLERANCE = 1e-3
# Below this a rotation matrix is as good as float64 makes it, and is taken bit for bit (derived: thousands of
# roundings).
ROUNDING = 1e-12


def convert(table: Any, kind: type[T], where: str) -> T:
    """A table of a file as a typed struct.

    Raises:
        ValueError: beginning with `where`, and naming the key that is missing or of the wrong type.
    """
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        # "Object missing required field `size`" or "Expected `array`, got `str` - at `$.matrix[0]`"
        what, _, at = str(error).partition(" - at ")
        if missing := re.search("missing required field `(.+)`", what):
            raise ValueError(f"{where}: missing key {missing[1]!r}") from None
        key = at.strip("`").removeprefix("$.")
        raise ValueError(f"{where}: {key + ': ' if key else ''}{what[0].lower()}{what[1:]}") from None


def make_camera(
    path: Path,
    name: str,
    *,
    size: Any,
    matrix: Any,
    distortion: Any,
    camera_from_world: RigidTransform,
    lens: LensModel,
    error_px: float | None = None,
) -> Camera:
    """A `Camera` from the numbers in a file.

    Args:
        path, name: for the messages.
        size: (width, height).
        matrix: (3, 3).
        distortion: OpenCV's coefficients in any shape.
        camera_from_world, lens, error_px: as in `Camera`.

    Raises:
        ValueError: naming file and camera, for whatever `Camera` refuses.
    """
    where = f"{path}: camera {name}"
    width_height = _array(size, f"{where}: the size")
    if width_height.shape != (2,) or (width_height != width_height.round()).any():
        raise ValueError(f"{where}: the size must be two whole numbers (width, height), got {size}")
    numbers = _array(matrix, f"{where}: the matrix"), _array(distortion, f"{where}: the distortion")
    try:
        return Camera(name, (int(width_height[0]), int(width_height[1])), *numbers, camera_from_world, lens, error_px)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def make_pose(path: Path, name: str, rotation: Any, translation: Any) -> RigidTransform:
    """The pose X_b = R X_a + t from the numbers in a file.

    Args:
        path, name: for the messages.
        rotation: (3, 3) matrix, replaced by the nearest rotation, or a rotation vector of 3 (OpenCV's `rvec`, radians).
        translation: 3 numbers.

    Raises:
        ValueError: naming file and camera, for a wrong shape, a value that is not finite, or a matrix that is not
            a rotation to 1e-3.
    """
    return rigid(f"{path}: camera {name}", rotation, translation)


def rigid(where: str, rotation: Any, translation: Any) -> RigidTransform:
    """The same of anything; sentences begin with `where`."""
    r = _array(rotation, f"{where}: the rotation")
    t = _array(translation, f"{where}: the translation")
    if t.size != 3:
        raise ValueError(f"{where}: the translation must be 3 numbers, got {t.size}")
    if r.size == 3:
        return RigidTransform.from_components(t.ravel(), Rotation.from_rotvec(r.ravel()))
    if r.shape != (3, 3):
        raise ValueError(f"{where}: the rotation must be 3x3 or a rotation vector of 3, got shape {r.shape}")
    gap = float(np.abs(r.T @ r - np.eye(3)).max())
    if gap > ROTATION_TOLERANCE:
        raise ValueError(
            f"{where}: the rotation is not a rotation matrix: R'R is {gap:.2g} from the identity, "
            f"at most {ROTATION_TOLERANCE:g} is allowed"
        )
    if np.linalg.det(r) < 0:
        raise ValueError(f"{where}: the rotation is not a rotation matrix but a reflection: its determinant is -1")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = r, t.ravel()
    # SciPy's normalisation changes the last bit of half of all rotations; without it, saved files load exactly.
    return RigidTransform(pose, normalize=gap > ROUNDING)


def make_rig(path: Path, cameras: list[Camera], unit: str = "") -> Rig:
    """The rig of a file's cameras.

    Raises:
        ValueError: naming the file, for no camera or two of the same name.
    """
    try:
        return Rig(cameras, unit)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _array(value: Any, what: str) -> FloatArray:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} must be numbers, in rows of equal length") from None
    if not np.isfinite(array).all():
        raise ValueError(f"{what} has values that are not finite")
    return array
