"""Cameras and rigs: calibration in memory, projection and undistortion (OpenCV's lens models)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import index
from typing import Any, Literal, SupportsIndex, overload

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.display import Printable
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.lens_distortion import N_TERMS, project_points
from sylpose.geometry.validation import (
    check_finite,
    check_finite_rows,
    check_integer,
    check_list,
    check_number,
    check_real,
    check_rows,
    check_sequence,
    check_type,
    format_value,
)
from sylpose.input_limits import to_one_line
from sylpose.units import METERS

LensModel = Literal["opencv", "fisheye"]

# Numbers of coefficients of OpenCV's standard model; its fisheye model has exactly 4.
OPENCV_TERMS = (4, 5, 8, 12, 14)
# Plausibility limits of a camera: pixels a side, the maximum of OpenCV's functions; pixels in all, four times those of
# 8K (choice); focal lengths and principal points, in pixels (choice: 1e4 of the longest lenses); distortion terms, of
# which the high ones of long lenses are large (choice); lengths, which float64 still resolves to a thousandth (choice).
MAX_IMAGE_SIDE, MAX_PIXELS = 32766, 2**27
MAX_FOCAL_PX, MAX_DISTORTION, MAX_LENGTH = 1e9, 1e9, 1e12
# Length of a camera's name, which becomes part of file names: below the limit of file systems, with room for a prefix
# and a suffix (choice).
MAX_NAME_LENGTH = 100
# Largest grid to which stored image points are rounded, pixels: a tenth of the noise of the best features (choice).
GRID_PX = 1.0 / 128.0
# Below this ratio of the least to the largest eigenvalue of their normal equations, the square of half the angle between
# two lines, nearly parallel lines leave the point undetermined along them: 3 degrees (choice).
MIN_EIGENVALUE_RATIO = 1e-3

# OpenCV 4 and 5 have different names for the function with a stopping criterion.
_undistort: Any = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)


@dataclass(frozen=True, eq=False, repr=False)
class Camera(Printable):
    """One calibrated, static camera.

    Attributes:
        name: unique within its rig.
        size: (width, height) in pixels.
        matrix: (3, 3) intrinsic matrix, pixels.
        distortion: (4 | 5 | 8 | 12 | 14,) OpenCV coefficients, or (4,) for `lens="fisheye"`; empty means none.
        camera_from_world: pose of the world in the camera, X_c = R X_w + t.
        lens: OpenCV's standard model or its fisheye model.
        error_px: rms reprojection error reported by the calibration, pixels; None if not reported.

    Raises:
        ValueError: naming the camera: a name that is not usable in file names; a size, matrix or distortion of the
            wrong shape, not finite or implausible; an invalid pose.
    """

    name: str
    size: tuple[int, int]
    matrix: FloatArray
    distortion: FloatArray
    camera_from_world: RigidTransform
    lens: LensModel = "opencv"
    error_px: float | None = None

    def __post_init__(self) -> None:
        check_camera_name(self.name)
        matrix, size = self._to_finite_array("matrix"), self._to_finite_array("size")
        distortion = self._to_finite_array("distortion").ravel()
        if matrix.shape != (3, 3):
            raise self._error(f"the matrix must be 3x3, got shape {matrix.shape}")
        focal, middle = matrix[[0, 1], [0, 1]], matrix[:2, 2]
        if (focal <= 0).any() or not np.allclose(matrix[2], [0, 0, 1]):
            raise self._error("the matrix must have positive focal lengths and (0, 0, 1) as last row")
        if matrix[0, 1] != 0 or matrix[1, 0] != 0:
            raise self._error("the matrix has skew, which OpenCV's lens models do not support")
        if (focal < 1 / MAX_FOCAL_PX).any() or max(focal.max(), np.abs(middle).max()) > MAX_FOCAL_PX:
            raise self._error(
                f"the matrix has an implausible focal length or principal point: {focal} and {middle} pixels"
            )
        if size.shape != (2,) or (size < 1).any() or (size != size.round()).any():
            raise self._error(f"the size must be (width, height) in pixels, got {format_value(self.size)}")
        if size.max() > MAX_IMAGE_SIDE or size.prod() > MAX_PIXELS:
            limits = f"{MAX_IMAGE_SIDE} pixels a side or {MAX_PIXELS} in all"
            raise self._error(f"the size {size[0]:g} x {size[1]:g} is more than {limits}")
        if not isinstance(self.lens, str) or self.lens not in ("opencv", "fisheye"):
            raise self._error(f"lens must be 'opencv' or 'fisheye', got {format_value(self.lens)}")
        allowed = OPENCV_TERMS if self.lens == "opencv" else (4,)
        if distortion.size == 0:
            distortion = np.zeros(5 if self.lens == "opencv" else 4)
        if distortion.size not in allowed:
            raise self._error(f"{distortion.size} distortion terms; the {self.lens} model takes {allowed}")
        if np.abs(distortion).max() > MAX_DISTORTION:
            raise self._error(f"a distortion term is beyond {MAX_DISTORTION:g}")
        if self.error_px is not None:
            check_number(self.error_px, f"camera {self.name}: error_px", minimum=0.0)
        if not isinstance(self.camera_from_world, RigidTransform) or not self.camera_from_world.single:
            raise self._error("camera_from_world must be a single transform")
        if not np.abs(self.camera_from_world.as_matrix()).max() <= MAX_LENGTH:  # also rejects NaN
            raise self._error(f"camera_from_world has values that are not finite or lengths beyond {MAX_LENGTH:g}")
        matrix.setflags(write=False)
        distortion.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "size", (int(size[0]), int(size[1])))

    def _error(self, problem: str) -> ValueError:
        return ValueError(f"camera {self.name}: {problem}")

    def _to_finite_array(self, field_name: str) -> FloatArray:
        try:
            array = np.array(getattr(self, field_name))
            array = np.array(array, dtype=float) if array.dtype.kind in "biufO" else np.array(None, dtype=float)
        except (TypeError, ValueError, OverflowError):
            array = np.array(np.nan)
        if not np.isfinite(array).all():
            raise self._error(f"the {field_name} has values that are not finite numbers")
        return array

    @cached_property
    def focal(self) -> float:
        """Geometric mean of the two focal lengths, pixels; converts normalized units to pixels."""
        return float(np.sqrt(self.matrix[0, 0] * self.matrix[1, 1]))

    @cached_property
    def rotation(self) -> FloatArray:
        """(3, 3) rotation matrix Q of camera_from_world."""
        return _read_only(self.camera_from_world.rotation.as_matrix())

    @cached_property
    def center(self) -> FloatArray:
        """(3,) the camera's center in the world, o = -Q'q."""
        return _read_only(self.camera_from_world.inv().translation)

    @cached_property
    def _translation(self) -> FloatArray:
        """(3,) t of camera_from_world."""
        return _read_only(self.camera_from_world.translation)

    @cached_property
    def _distortion_terms(self) -> FloatArray | None:
        """(12,) coefficients for `geometry.lens_distortion`; None for lenses that only OpenCV handles."""
        if self.lens == "fisheye" or self.distortion[N_TERMS:].any():
            return None
        return _read_only(np.pad(self.distortion[:N_TERMS], (0, max(N_TERMS - len(self.distortion), 0))))

    @property
    def direction(self) -> FloatArray:
        """(3,) unit vector, the optical axis in the world."""
        return np.asarray(self.rotation[2])

    def normalize(self, pixels: ArrayLike) -> FloatArray:
        """Undistort pixels of the image as recorded.

        Args:
            pixels: (n, 2).

        Returns:
            (n, 2) normalized points on the plane z = 1.
        """
        # Contiguous: OpenCV's fisheye functions ignore strides.
        points = check_rows(pixels, 2, "pixels", single=True).reshape(-1, 1, 2)
        if points.size == 0:
            return np.empty((0, 2))
        if self.lens == "fisheye":
            out = cv2.fisheye.undistortPoints(points, self.matrix, self.distortion)
        else:
            # OpenCV's default of 5 fixed-point steps leaves errors of some hundredths of a pixel at the edge of wide
            # lenses.
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
            out = _undistort(points, self.matrix, self.distortion, R=None, P=None, criteria=criteria)
        return np.asarray(out, dtype=float).reshape(-1, 2)

    def project(self, points: ArrayLike) -> FloatArray:
        """Project world points to distorted pixels.

        Args:
            points: (n, 3) in the world frame.

        Returns:
            (n, 2) pixels; NaN for points not in front of the camera.
        """
        points = check_rows(points, 3, "points", single=True)
        if self._distortion_terms is not None:
            out = np.empty((len(points), 2))
            project_points(points, self.rotation, self._translation, self.matrix, self._distortion_terms, out)
            return out
        points_c = points @ self.rotation.T + self._translation
        pixels = np.full((len(points_c), 2), np.nan)
        front = points_c[:, 2] > 1e-9
        if not front.any():
            return pixels
        normalized = points_c[front, :2] / points_c[front, 2:]
        pixels[front] = self.denormalize(normalized)
        return pixels

    def normalize_to_grid(self, pixels: ArrayLike) -> FloatArray:
        """Undistort pixels and round the result to a power-of-two grid of at most `GRID_PX` pixels.

        Rounded points are sent in few bytes and arrive without loss.
        """
        grid = 2.0 ** np.floor(np.log2(GRID_PX / self.focal))
        return np.asarray(np.round(self.normalize(pixels) / grid) * grid)

    def denormalize(self, normalized: ArrayLike) -> FloatArray:
        """Distort normalized points: the inverse of `normalize`.

        Args:
            normalized: (n, 2) points on the plane z = 1.

        Returns:
            (n, 2) pixels of the image as recorded.
        """
        points = check_rows(normalized, 2, "normalized", single=True)
        if points.size == 0:
            return np.empty((0, 2))
        if self.lens == "fisheye":
            out = cv2.fisheye.distortPoints(points.reshape(-1, 1, 2), self.matrix, self.distortion)
            return np.asarray(out, dtype=float).reshape(-1, 2)
        homogeneous, out = np.column_stack([points, np.ones(len(points))]), np.empty((len(points), 2))
        if self._distortion_terms is not None:
            project_points(homogeneous, np.eye(3), np.zeros(3), self.matrix, self._distortion_terms, out)
        else:
            out, _ = cv2.projectPoints(homogeneous, np.zeros(3), np.zeros(3), self.matrix, self.distortion)
        return np.asarray(out, dtype=float).reshape(-1, 2)

    def rays(self, pixels: ArrayLike) -> FloatArray:
        """Return unit directions of pixels in the world, from the camera's center.

        Args:
            pixels: (n, 2) of the image as recorded.

        Returns:
            (n, 3) unit directions.
        """
        normalized = self.normalize(pixels)
        directions = np.column_stack([normalized, np.ones(len(normalized))]) @ self.rotation
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False, repr=False)
class Rig(Printable):
    """Rig of cameras in a fixed order.

    `rig["cam_0"]` and `rig[0]` are cameras, `rig[:2]` is a rig, and `"cam_0" in rig` looks for a name.

    Args:
        cameras: at least one, with unique names.
        unit: the calibration's length unit if known ("m", "mm"), else "".

    Raises:
        ValueError: no camera, or two of the same name.
    """

    cameras: tuple[Camera, ...]
    unit: str = ""
    _index: dict[str, int] = field(init=False, repr=False)

    def __init__(self, cameras: Sequence[Camera], unit: str = "") -> None:
        cameras = check_list(cameras, Camera, "cameras")
        object.__setattr__(self, "cameras", tuple(cameras))
        object.__setattr__(self, "unit", check_type(unit, str, "unit"))
        object.__setattr__(self, "_index", {camera.name: i for i, camera in enumerate(cameras)})
        if not cameras:
            raise ValueError("cameras: a rig needs at least one camera")
        if len(self._index) != len(self.cameras):
            raise ValueError(f"cameras: two cameras of the same name in {', '.join(c.name for c in cameras)}")

    def __len__(self) -> int:
        return len(self.cameras)

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __contains__(self, camera: object) -> bool:
        """Return whether a camera, or one of this name, is in the rig."""
        return camera in (self._index if isinstance(camera, str) else self.cameras)

    @overload
    def __getitem__(self, key: str | SupportsIndex) -> Camera: ...

    @overload
    def __getitem__(self, key: slice) -> Rig: ...

    def __getitem__(self, key: str | SupportsIndex | slice) -> Camera | Rig:
        """Return a camera by its name or number, or the rig of a slice.

        Raises:
            KeyError: a name that is not in the rig.
            IndexError: a number that is not in the rig, or a slice without cameras.
            TypeError: another type of key.
        """
        names = to_one_line(", ".join(self.names), 200)
        if isinstance(key, slice):
            if not (cameras := self.cameras[key]):
                raise IndexError(f"no camera in this slice of the rig's {len(self)} ({names})")
            return Rig(cameras, self.unit)
        if isinstance(key, str):
            if key not in self._index:
                raise KeyError(f"no camera {format_value(key)} in the rig ({names})")
            return self.cameras[self._index[key]]
        if isinstance(key, bool) or not hasattr(key, "__index__"):
            raise TypeError(f"a camera is selected by its name or number, got {format_value(key)}")
        if not -len(self) <= (number := index(key)) < len(self):
            raise IndexError(f"no camera {number} in the rig of {len(self)} ({names}); numbers begin at 0")
        return self.cameras[number]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras, in order."""
        return tuple(camera.name for camera in self.cameras)

    def subset(self, names: Sequence[str]) -> Rig:
        """Return the rig of the named cameras, in the order given.

        Raises:
            KeyError: a name that is not in the rig.
            TypeError, ValueError: no names, or one twice.
        """
        if not (names := check_list(names, str, "names")) or len(set(names)) < len(names):
            raise ValueError(f"names: expected at least one and no duplicates, got {len(names)}")
        return Rig([self[name] for name in names], self.unit)

    def in_unit(self, unit: str) -> Rig:
        """Return the same rig with its lengths in another unit.

        Args:
            unit: "m", "cm", "mm", "um", "in" or "ft".

        Raises:
            ValueError: another unit, or a rig of unknown unit.
        """
        if check_type(unit, str, "unit") not in METERS:
            raise ValueError(f"unit must be one of {', '.join(METERS)}, got {format_value(unit)}")
        if self.unit not in METERS:
            unit_text = f"in {format_value(self.unit)}" if self.unit else "in an unknown unit"
            raise ValueError(f"unit: the calibration is {unit_text}, which cannot be converted to {unit}")
        scale = METERS[self.unit] / METERS[unit]
        poses = [camera.camera_from_world for camera in self]
        scaled_poses = [RigidTransform.from_components(scale * pose.translation, pose.rotation) for pose in poses]
        return self if unit == self.unit else self._with_extrinsics(scaled_poses, unit)

    def in_world(self, new_from_world: RigidTransform) -> Rig:
        """Return the same rig expressed in another world frame.

        A pose `world_from_object` becomes `new_from_world * world_from_object`.

        Raises:
            TypeError, ValueError: not a single transform of finite values.
        """
        world_from_new = check_single_pose(new_from_world, "new_from_world").inv()
        return self._with_extrinsics([camera.camera_from_world * world_from_new for camera in self], self.unit)

    def _with_extrinsics(self, camera_from_world: Sequence[RigidTransform], unit: str) -> Rig:
        """Return the rig with other extrinsics, one pose per camera, in a length unit."""
        pairs = zip(self, camera_from_world, strict=True)
        return Rig([replace(camera, camera_from_world=pose) for camera, pose in pairs], unit)


def check_camera_name(name: str) -> None:
    """Check that a camera's name is usable in file names and messages.

    Raises:
        ValueError: empty, a folder's name (".", ".."), too long, or with path separators or characters that are not
            text: control characters, bidirectional marks, surrogates.
    """
    if not isinstance(name, str) or name.strip() in ("", ".", "..") or len(name) > MAX_NAME_LENGTH:
        raise ValueError(
            f"a camera's name must be a word of at most {MAX_NAME_LENGTH} characters, got {format_value(name)}"
        )
    wrong = sorted({c for c in name if c in "/\\" or to_one_line(f"a{c}b") != f"a{c}b"})
    if wrong:
        raise ValueError(
            f"camera {to_one_line(name)}: its name has {', '.join(map(ascii, wrong))}, which file names cannot contain"
        )


def check_single_pose(pose: Any, name: str) -> RigidTransform:
    """Return the transform after checking that it is a single one of finite values.

    Raises:
        TypeError, ValueError: naming the argument.
    """
    pose = check_type(pose, RigidTransform, name)
    if not pose.single or not np.abs(pose.as_matrix()).max() <= MAX_LENGTH:
        raise ValueError(f"{name} must be a single transform of finite values, of lengths of at most {MAX_LENGTH:g}")
    return pose


def _read_only(array: FloatArray) -> FloatArray:
    out = np.array(array)
    out.setflags(write=False)
    return out


def intersect_rays(centers: ArrayLike, directions: ArrayLike, near: ArrayLike | None = None) -> FloatArray:
    """Return the point with the least sum of squared distances to lines in space.

    Args:
        centers: (n, 3) a point on each line.
        directions: (n, 3) unit directions.
        near: (3,) selects the point where the lines leave it undetermined (one line, or lines within about 3 degrees of
            each other): the one nearest to `near`. None: halfway between opposite lines, at distance 1 along others.

    Returns:
        (3,) the point.

    Raises:
        ValueError: wrong shapes, or directions that are not unit vectors.
    """
    centers = check_finite_rows(centers, 3, "centers", maximum=MAX_LENGTH)
    directions = check_finite(directions, (len(centers), 3), "directions")
    if len(centers) == 0 or np.abs(np.linalg.norm(directions, axis=1) - 1.0).max() > 1e-6:
        raise ValueError("directions must be unit vectors, at least one")
    if near is None:
        near = centers.mean(axis=0)
        mean = directions.mean(axis=0)
        if np.linalg.norm(mean) > 0.5:
            near = near + mean / np.linalg.norm(mean)
    near = check_finite(near, (3,), "near", maximum=MAX_LENGTH)
    projectors = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    offsets = np.einsum("nij,nj->i", projectors, centers - near)
    inverse = np.linalg.pinv(projectors.sum(axis=0), rcond=MIN_EIGENVALUE_RATIO, hermitian=True)
    return np.asarray(near + inverse @ offsets)


def make_look_at_camera(
    name: str, center: ArrayLike, target: ArrayLike, focal: float, size: tuple[int, int], distortion: ArrayLike = ()
) -> Camera:
    """Make an upright camera at a center that looks at a target.

    Its y axis is as close to the world's as possible; the principal point is the image's center.

    Args:
        name: of the camera.
        center: (3,) position in the world.
        target: (3,) point on the optical axis.
        focal: focal length, pixels.
        size: (width, height) in pixels.
        distortion: coefficients as in `Camera`.

    Raises:
        ValueError: a center equal to the target, or any argument that `Camera` rejects.
    """
    check_camera_name(name)
    center = check_finite(center, (3,), "center", maximum=MAX_LENGTH)
    forward = check_finite(target, (3,), "target", maximum=MAX_LENGTH) - center
    check_number(focal, "focal", above=0.0)
    sides = check_sequence(size, "size", 2, "sides")
    width, height = (check_integer(side, "size", minimum=1, maximum=MAX_IMAGE_SIDE) for side in sides)
    if not np.linalg.norm(forward) > 0:
        raise ValueError(f"camera {name}: its center equals its target")
    forward = forward / np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    if np.linalg.norm(right) < 1e-9:  # looking straight up or down: roll is arbitrary
        right = np.array([1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    rotation = Rotation.from_matrix(np.stack([right, np.cross(forward, right), forward]))
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    pose = RigidTransform.from_components(-rotation.apply(center), rotation)
    return Camera(name, (width, height), matrix, check_real(distortion, "(k,)", "distortion"), pose)
