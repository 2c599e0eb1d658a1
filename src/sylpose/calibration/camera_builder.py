"""From the numbers of a calibration file to a `Camera`: the checks that all formats share."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar
from xml.etree.ElementTree import Element

import msgspec
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, LensModel, Rig

__all__ = [
    "LENSES",
    "Sizes",
    "attribute",
    "convert",
    "from_opengl",
    "lens_named",
    "lens_terms",
    "make_camera",
    "make_pose",
    "make_rig",
    "matrix_of",
    "numbers",
    "plain",
    "pose_of_matrix",
    "rigid",
    "sizes_of",
]

T = TypeVar("T", bound=msgspec.Struct)

# (width, height) by name, for cameras whose calibration does not say how large their images are: of those that are known.
Sizes = Callable[[Sequence[str]], Mapping[str, tuple[int, int]]]

# The lens models of OpenCV by the names that formats give them, in small letters.
LENSES: dict[str, LensModel] = {
    **dict.fromkeys(
        ("opencv", "standard", "pinhole", "perspective", "plumb_bob", "radtan", "radial-tangential"), "opencv"
    ),
    **dict.fromkeys(("brown", "brown_conrady", "rational", "rational_polynomial", "thin_prism", "tilted"), "opencv"),
    **dict.fromkeys(("fisheye", "equidistant", "kannala_brandt"), "fisheye"),
}
# Of OpenCV's standard model, in order.
TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
# A camera that looks along -z with y up (OpenGL, Blender, OptiTrack, Qualisys): its axes turned to ours.
from_opengl = RigidTransform.from_rotation(Rotation.from_quat([1.0, 0.0, 0.0, 0.0]))

# Beyond it products overflow, long before a camera is looked at (choice).
MAX_NUMBER = 1e50
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


def pose_of_matrix(path: Path, name: str, what: str, value: Any) -> RigidTransform:
    """The pose of a 3x4 or 4x4 matrix [R t], by rows or as 12 or 16 numbers.

    Args:
        what: the matrix's name in the file.

    Raises:
        ValueError: naming file and camera, for another shape or last row, and as `make_pose`.
    """
    matrix = _array(value, f"{path}: camera {name}: {what}")
    if matrix.size in (12, 16):
        matrix = matrix.reshape(-1, 4)
    if matrix.shape not in ((3, 4), (4, 4)) or (len(matrix) == 4 and not np.array_equal(matrix[3], [0, 0, 0, 1])):
        raise ValueError(f"{path}: camera {name}: {what} must be a 3x4 or 4x4 matrix [R t]")
    return make_pose(path, name, matrix[:3, :3], matrix[:3, 3])


def matrix_of(fx: float, fy: float, cx: float, cy: float) -> FloatArray:
    """(3, 3) the intrinsic matrix."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def lens_named(word: Any, where: str, what: str) -> LensModel:
    """OpenCV's model by the name that a file has for it under its key `what`.

    Raises:
        ValueError: a model that OpenCV does not have.
    """
    if str(word).lower() not in LENSES:
        raise ValueError(f"{where}: {what} {word!r} is not known; known are {', '.join(LENSES)}")
    return LENSES[str(word).lower()]


def numbers(value: Any, n: int | tuple[int, ...], what: str) -> FloatArray:
    """(n,) numbers, of a list of any shape or of a text with blanks or commas between them.

    Args:
        n: how many they must be, or may be.

    Raises:
        ValueError: naming `what`, for another number of them, what is none, and what is not finite.
    """
    words = re.split(r"[\s,]+", value.strip()) if isinstance(value, str) else value
    array = _array(words, what).ravel()
    if array.size not in (n if isinstance(n, tuple) else (n,)):
        raise ValueError(
            f"{what} must be {n if isinstance(n, int) else ' or '.join(map(str, n))} numbers, got {array.size}"
        )
    return array


def plain(value: Any, what: str) -> Any:
    """A value in which OpenCV's own matrices, and ROS's, are lists of rows.

    Raises:
        ValueError: naming `what`, for a matrix without rows, cols and as much data.
    """
    if not isinstance(value, dict):
        return value
    try:
        return np.reshape(value["data"], (int(value["rows"]), int(value["cols"]))).tolist()
    except (KeyError, TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} must be a matrix with rows, cols and as much data") from None


def attribute(element: Element | None, name: str, where: str, n: int = 1) -> FloatArray:
    """(n,) the numbers in an attribute of an XML element.

    Raises:
        ValueError: naming the attribute, where it, or the element, is not there or has other than n numbers.
    """
    if element is None or (value := element.get(name)) is None:
        raise ValueError(f"{where}: missing {name!r}")
    return numbers(value, n, f"{where}: {name}")


def lens_terms(camera: Camera, n: int, model: str) -> FloatArray:
    """(n,) the first n of a camera's terms of OpenCV's standard lens, of which a format's model has no more.

    Raises:
        ValueError: naming the camera and the terms that it has and the model has not; for a fisheye lens.
    """
    if camera.lens == "fisheye":
        raise ValueError(f"camera {camera.name}: {model} does not have its lens, OpenCV's fisheye")
    terms = np.zeros(len(TERMS))
    terms[: len(camera.distortion)] = camera.distortion
    if more := [TERMS[i] for i in range(n, len(TERMS)) if terms[i]]:
        raise ValueError(f"camera {camera.name}: {model} does not have the terms {', '.join(more)} of its lens")
    return terms[:n]


def sizes_of(path: Path, names: Sequence[str], sizes: Sizes | None) -> dict[str, tuple[int, int]]:
    """The sizes of the images of cameras of which the file does not say them.

    Raises:
        ValueError: naming the file and the cameras whose images nothing tells the size of.
    """
    known = {} if sizes is None else dict(sizes(names))
    if missing := [name for name in names if name not in known]:
        raise ValueError(
            f"{path}: does not say how large the images of {', '.join(missing)} are, and no videos of these names tell it; "
            "sylpose calibration convert --size WIDTHxHEIGHT does"
        )
    return known


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
    if (np.abs(array) > MAX_NUMBER).any():
        raise ValueError(f"{what} has values beyond {MAX_NUMBER:g}, which are of nothing that is measured")
    return array
