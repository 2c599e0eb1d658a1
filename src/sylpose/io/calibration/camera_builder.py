"""Validated conversion from the numbers of a calibration file to a `Camera`, shared by all formats."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar
from xml.etree.ElementTree import Element

import msgspec
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, LensModel, Rig

T = TypeVar("T", bound=msgspec.Struct)

# Lookup of known image sizes, (width, height) by camera name, for calibrations that do not contain them.
SizeLookup = Callable[[Sequence[str]], Mapping[str, tuple[int, int]]]

# OpenCV's lens models by the lower-case names used in the formats.
LENS_MODELS: dict[str, LensModel] = {
    **dict.fromkeys(
        ("opencv", "standard", "pinhole", "perspective", "plumb_bob", "radtan", "radial-tangential"), "opencv"
    ),
    **dict.fromkeys(("brown", "brown_conrady", "rational", "rational_polynomial", "thin_prism", "tilted"), "opencv"),
    **dict.fromkeys(("fisheye", "equidistant", "kannala_brandt"), "fisheye"),
}
# Distortion coefficients of OpenCV's standard model, in order.
DISTORTION_TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
# Rotation from OpenGL camera axes, looking along -z with y up (OpenGL, Blender, OptiTrack, Qualisys), to OpenCV's.
OPENCV_FROM_OPENGL = RigidTransform.from_rotation(Rotation.from_quat([1.0, 0.0, 0.0, 0.0]))

# Products of larger numbers overflow, before a camera is validated (choice).
MAX_NUMBER = 1e50
# Calibrations written with few digits are rotations to about 1e-4; a larger deviation is a mistake in the file (choice:
# ten times those).
ROTATION_TOLERANCE = 1e-3
# Below this deviation a rotation matrix is exact to float64 and is used unchanged, bit for bit (derived: thousands of
# roundings).
ROUNDING_TOLERANCE = 1e-12


@dataclass(frozen=True)
class Entry:
    """Place in a file, whose text begins the messages about the numbers there.

    Attributes:
        path: the file.
        place: the place in it; "" for the file as a whole.
    """

    path: Path
    place: str = ""

    def __str__(self) -> str:
        return f"{self.path}: {self.place}" if self.place else str(self.path)

    def error(self, problem: str) -> ValueError:
        """Return an error that names the place."""
        return ValueError(f"{self}: {problem}")

    def convert_table(self, table: Any, kind: type[T]) -> T:
        """Convert a decoded table to a typed struct.

        Raises:
            ValueError: naming the key that is missing or of the wrong type.
        """
        try:
            return msgspec.convert(table, kind)
        except msgspec.ValidationError as error:
            # "Object missing required field `size`" or "Expected `array`, got `str` - at `$.matrix[0]`"
            what, _, at = str(error).partition(" - at ")
            if missing := re.search("missing required field `(.+)`", what):
                raise self.error(f"missing key {missing[1]!r}") from None
            key = at.strip("`").removeprefix("$.")
            raise self.error(f"{key + ': ' if key else ''}{what[0].lower()}{what[1:]}") from None

    def parse_numbers(self, value: Any, n: int | tuple[int, ...], what: str) -> FloatArray:
        """Parse (n,) numbers from a list of any shape, or from text separated by blanks or commas.

        Args:
            value: list or text.
            n: the required count, or the allowed counts.
            what: description of the value, for the messages.

        Raises:
            ValueError: naming `what`, for a wrong count, a value that is not a number, or one that is not finite.
        """
        words = re.split(r"[\s,]+", value.strip()) if isinstance(value, str) else value
        array = self._to_array(words, what).ravel()
        counts = (n,) if isinstance(n, int) else n
        if array.size not in counts:
            raise self.error(f"{what} must be {' or '.join(map(str, counts))} numbers, got {array.size}")
        return array

    def parse_number(self, value: Any, what: str) -> float:
        """Parse a single number, as `parse_numbers`."""
        return float(self.parse_numbers(value if isinstance(value, str) else [value], 1, what)[0])

    def parse_matrix(self, value: Any, what: str, columns: int = 3) -> FloatArray:
        """Parse a matrix (3, columns) as `parse_numbers`; OpenCV's and ROS' nodes are accepted."""
        return self.parse_numbers(self.to_plain(value, what), 3 * columns, what).reshape(3, columns)

    def to_plain(self, value: Any, what: str) -> Any:
        """Convert matrices of OpenCV and ROS to lists of rows; return other values unchanged.

        Raises:
            ValueError: naming `what`, for a matrix without rows, cols and matching data.
        """
        if not isinstance(value, dict):
            return value
        try:
            return np.reshape(value["data"], (int(value["rows"]), int(value["cols"]))).tolist()
        except (KeyError, TypeError, ValueError, OverflowError):
            raise self.error(f"{what} must be a matrix with rows, cols and matching data") from None

    def parse_attributes(self, element: Element | None, *names: str) -> FloatArray:
        """Parse one number from each of these attributes of an XML element.

        Raises:
            ValueError: naming the attribute, if it or the element is missing or it is no number.
        """
        return np.array([self.parse_attribute(element, name)[0] for name in names])

    def parse_attribute(self, element: Element | None, name: str, n: int = 1) -> FloatArray:
        """Parse the (n,) numbers in an attribute of an XML element, as `parse_attributes`."""
        if element is None or (value := element.get(name)) is None:
            raise self.error(f"missing {name!r}")
        return self.parse_numbers(value, n, name)

    def parse_lens_model(self, name: Any, what: str) -> LensModel:
        """Return OpenCV's lens model by the name in a file under its key `what`.

        Raises:
            ValueError: a model that OpenCV does not have.
        """
        if str(name).lower() not in LENS_MODELS:
            raise self.error(f"{what} {name!r} is not known; known are {', '.join(LENS_MODELS)}")
        return LENS_MODELS[str(name).lower()]

    def parse_quaternion(self, value: Any, problem: str) -> Rotation:
        """Parse a rotation given as a quaternion x, y, z, w.

        Raises:
            ValueError: with `problem`, unless its length is 1.
        """
        quaternion = np.asarray(value, dtype=float)
        if not abs(np.linalg.norm(quaternion) - 1.0) < 1e-3:
            raise self.error(problem)
        return Rotation.from_quat(quaternion)

    def make_pose(self, rotation: Any, translation: Any) -> RigidTransform:
        """Build the pose X_b = R X_a + t from the numbers in a file.

        Args:
            rotation: (3, 3) matrix, replaced by the nearest rotation, or a rotation vector of 3 (OpenCV's `rvec`,
                radians).
            translation: 3 numbers.

        Raises:
            ValueError: a wrong shape, a value that is not finite, or a matrix that is not a rotation to 1e-3.
        """
        r, t = self._to_array(rotation, "the rotation"), self._to_array(translation, "the translation")
        if t.size != 3:
            raise self.error(f"the translation must be 3 numbers, got {t.size}")
        if r.size == 3:
            return RigidTransform.from_components(t.ravel(), Rotation.from_rotvec(r.ravel()))
        if r.shape != (3, 3):
            raise self.error(f"the rotation must be 3x3 or a rotation vector of 3, got shape {r.shape}")
        gap = float(np.abs(r.T @ r - np.eye(3)).max())
        if gap > ROTATION_TOLERANCE:
            raise self.error(
                f"the rotation is not a rotation matrix: R'R is {gap:.2g} from the identity, "
                f"at most {ROTATION_TOLERANCE:g} is allowed"
            )
        if np.linalg.det(r) < 0:
            raise self.error("the rotation is not a rotation matrix but a reflection: its determinant is -1")
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = r, t.ravel()
        # SciPy's normalization changes the last bit of half of all rotations; without it, saved files load exactly.
        return RigidTransform(pose, normalize=gap > ROUNDING_TOLERANCE)

    def parse_pose_matrix(self, value: Any, what: str) -> RigidTransform:
        """Parse the pose of a 3x4 or 4x4 matrix [R t], by rows or as 12 or 16 numbers.

        Args:
            value: the matrix.
            what: the matrix's name in the file.

        Raises:
            ValueError: another shape or last row, and as `make_pose`.
        """
        matrix = self._to_array(value, what)
        if matrix.size in (12, 16):
            matrix = matrix.reshape(-1, 4)
        if matrix.shape not in ((3, 4), (4, 4)) or (len(matrix) == 4 and not np.array_equal(matrix[3], [0, 0, 0, 1])):
            raise self.error(f"{what} must be a 3x4 or 4x4 matrix [R t], a 4x4 one with last row (0, 0, 0, 1)")
        return self.make_pose(matrix[:3, :3], matrix[:3, 3])

    def _to_array(self, value: Any, what: str) -> FloatArray:
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError, OverflowError):
            raise self.error(f"{what} must be numbers, in rows of equal length") from None
        if not np.isfinite(array).all():
            raise self.error(f"{what} has values that are not finite")
        if (np.abs(array) > MAX_NUMBER).any():
            raise self.error(f"{what} has values beyond {MAX_NUMBER:g}, which are implausible")
        return array


@dataclass(frozen=True)
class CameraEntry(Entry):
    """Camera of the name `place` in a file."""

    def __str__(self) -> str:
        return f"{self.path}: camera {self.place}"

    def make_camera(
        self,
        size: Any,
        matrix: Any,
        distortion: Any,
        camera_from_world: RigidTransform,
        lens: LensModel = "opencv",
        error_px: float | None = None,
    ) -> Camera:
        """Build the `Camera` from the numbers in a file.

        Args:
            size: (width, height).
            matrix: (3, 3).
            distortion: OpenCV's coefficients in any shape.
            camera_from_world, lens, error_px: as in `Camera`.

        Raises:
            ValueError: anything that `Camera` rejects.
        """
        sides = self._to_array(size, "the size")
        if sides.shape != (2,) or (sides != sides.round()).any():
            raise self.error(f"the size must be two whole numbers (width, height), got {size}")
        arrays = self._to_array(matrix, "the matrix"), self._to_array(distortion, "the distortion")
        try:
            return Camera(self.place, (int(sides[0]), int(sides[1])), *arrays, camera_from_world, lens, error_px)
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from None


def drop_zero_error(error_px: float | None) -> float | None:
    """Return a reprojection error; None for 0, which programs write where they measured none (Pose2Sim always)."""
    return None if error_px == 0 else error_px


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> FloatArray:
    """Return the intrinsic matrix (3, 3)."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def standard_lens_terms(camera: Camera, n: int, model: str) -> FloatArray:
    """Return the first n terms of a camera's standard lens, for a format whose model has no more.

    Raises:
        ValueError: naming the camera and its terms that the model lacks; for a fisheye lens.
    """
    if camera.lens == "fisheye":
        raise ValueError(f"camera {camera.name}: {model} has no equivalent of its lens, OpenCV's fisheye")
    terms = np.zeros(len(DISTORTION_TERMS))
    terms[: len(camera.distortion)] = camera.distortion
    if unsupported := [DISTORTION_TERMS[i] for i in range(n, len(DISTORTION_TERMS)) if terms[i]]:
        raise ValueError(f"camera {camera.name}: {model} does not have the terms {', '.join(unsupported)} of its lens")
    return terms[:n]


def lookup_sizes(
    path: Path, names: Sequence[str], sizes: SizeLookup | None, given: Mapping[str, Any] = MappingProxyType({})
) -> dict[str, Any]:
    """Return the image sizes of cameras: those given in their file, otherwise those of their videos.

    Raises:
        ValueError: naming the file and the cameras of unknown image size.
    """
    if all(name in given for name in names):
        return dict(given)
    known = {**(sizes(names) if sizes is not None else {}), **given}
    if missing := [name for name in names if name not in known]:
        raise ValueError(
            f"{path}: has no image size of {', '.join(missing)}, and there are no videos of these names; "
            "set it with sylpose calibration convert --size WIDTHxHEIGHT"
        )
    return known


def make_rig(path: Path, cameras: list[Camera], unit: str = "") -> Rig:
    """Build the rig of a file's cameras.

    Raises:
        ValueError: naming the file, for no camera or two of the same name.
    """
    try:
        return Rig(cameras, unit)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
