"""Cameras and rigs: calibration in memory, projection and undistortion (OpenCV's lens models)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.display import Telling, Told, named, place_told, vector
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.lens_distortion import TERMS, projected
from sylpose.geometry.validation import finite, finite_rows, items, kind_of, listed, number, real, rows, shown, whole
from sylpose.input_limits import one_line
from sylpose.units import METRES

__all__ = ["Camera", "Rig", "nearest_point_to_rays"]

LensModel = Literal["opencv", "fisheye"]

# Numbers of coefficients that OpenCV's standard model takes; its fisheye model takes exactly 4.
OPENCV_TERMS = (4, 5, 8, 12, 14)
# Beyond these nothing is a camera: pixels a side, as many as OpenCV's functions take; pixels in all, four times those of
# 8K (choice); focal lengths and principal points, in pixels (choice: 1e4 of the longest lenses); terms of the lens, of which
# the high ones of long lenses are large (choice); lengths, which float64 then still has to a thousandth (choice).
MAX_SIDE, MAX_PIXELS = 32766, 2**27
MAX_PX, MAX_TERM, MAX_LENGTH = 1e9, 1e9, 1e12
# Of a camera's name, which names files: no longer than file systems take, with something before and behind (choice).
MAX_NAME = 100
# Image points that are kept are rounded to this at most, pixels: a tenth of the noise of the best features (choice).
GRID_PX = 1.0 / 128.0

# OpenCV 4 takes a stopping criterion under another name than OpenCV 5.
_undistort: Any = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)


@dataclass(frozen=True, eq=False, repr=False)
class Camera(Told):
    """One calibrated, static camera.

    Attributes:
        name: unique within its rig.
        size: (width, height) in pixels.
        matrix: (3, 3) intrinsic matrix, pixels.
        distortion: (4 | 5 | 8 | 12 | 14,) OpenCV coefficients, or (4,) for `lens="fisheye"`; empty means none.
        camera_from_world: pose of the world in the camera, X_c = R X_w + t.
        lens: OpenCV's standard model or its fisheye model.
        error_px: what the calibration says of its own error, rms reprojection, pixels; None where it says nothing.

    Raises:
        ValueError: naming the camera, for a name that could not be a file's; a size, matrix or distortion of the wrong
            shape, not finite, not possible or beyond what any camera has; a pose that is none.
    """

    name: str
    size: tuple[int, int]
    matrix: FloatArray
    distortion: FloatArray
    camera_from_world: RigidTransform
    lens: LensModel = "opencv"
    error_px: float | None = None

    def __post_init__(self) -> None:
        check_name(self.name)
        matrix = _numbers(self, "matrix", self.matrix)
        distortion = _numbers(self, "distortion", self.distortion).ravel()
        if matrix.shape != (3, 3):
            raise ValueError(f"camera {self.name}: the matrix must be 3x3, got shape {matrix.shape}")
        focal, middle = matrix[[0, 1], [0, 1]], matrix[:2, 2]
        if (focal <= 0).any() or not np.allclose(matrix[2], [0, 0, 1]):
            raise ValueError(
                f"camera {self.name}: the matrix must have positive focal lengths and (0, 0, 1) as last row"
            )
        if matrix[0, 1] != 0 or matrix[1, 0] != 0:
            raise ValueError(f"camera {self.name}: the matrix has skew, which OpenCV's lens models do not know")
        if (focal < 1 / MAX_PX).any() or max(focal.max(), np.abs(middle).max()) > MAX_PX:
            raise ValueError(
                f"camera {self.name}: a focal length or principal point of the matrix is absurd: {focal} and {middle} pixels"
            )
        size = _numbers(self, "size", self.size)
        if size.shape != (2,) or (size < 1).any() or (size != size.round()).any():
            raise ValueError(f"camera {self.name}: the size must be (width, height) in pixels, got {shown(self.size)}")
        if size.max() > MAX_SIDE or size.prod() > MAX_PIXELS:
            raise ValueError(
                f"camera {self.name}: the size {size[0]:g} x {size[1]:g} is more than {MAX_SIDE} pixels a side or "
                f"{MAX_PIXELS} in all"
            )
        if not isinstance(self.lens, str) or self.lens not in ("opencv", "fisheye"):
            raise ValueError(f"camera {self.name}: lens must be 'opencv' or 'fisheye', got {shown(self.lens)}")
        allowed = OPENCV_TERMS if self.lens == "opencv" else (4,)
        if distortion.size == 0:
            distortion = np.zeros(5 if self.lens == "opencv" else 4)
        if distortion.size not in allowed:
            raise ValueError(
                f"camera {self.name}: {distortion.size} distortion terms; the {self.lens} model takes {allowed}"
            )
        if np.abs(distortion).max() > MAX_TERM:
            raise ValueError(f"camera {self.name}: a distortion term beyond {MAX_TERM:g} is that of no lens")
        if self.error_px is not None:
            number(self.error_px, f"camera {self.name}: error_px", least=0.0)
        if not isinstance(self.camera_from_world, RigidTransform) or not self.camera_from_world.single:
            raise ValueError(f"camera {self.name}: camera_from_world must be a single transform")
        if not np.abs(self.camera_from_world.as_matrix()).max() <= MAX_LENGTH:  # nor not a number
            raise ValueError(
                f"camera {self.name}: camera_from_world has values that are not finite, or lengths beyond {MAX_LENGTH:g}"
            )
        matrix.setflags(write=False)
        distortion.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "size", (int(size[0]), int(size[1])))

    @cached_property
    def focal(self) -> float:
        """Geometric mean of the two focal lengths, pixels: what turns normalised units into pixels."""
        return float(np.sqrt(self.matrix[0, 0] * self.matrix[1, 1]))

    @cached_property
    def rotation(self) -> FloatArray:
        """(3, 3) rotation matrix Q of camera_from_world."""
        return _read_only(self.camera_from_world.rotation.as_matrix())

    @cached_property
    def center(self) -> FloatArray:
        """(3,) the camera's centre in the world, o = -Q'q."""
        return _read_only(self.camera_from_world.inv().translation)

    @cached_property
    def _shift(self) -> FloatArray:
        """(3,) t of camera_from_world."""
        return _read_only(self.camera_from_world.translation)

    @cached_property
    def _terms(self) -> FloatArray | None:
        """(12,) coefficients as `geometry.lens_distortion` takes them; None for lenses that OpenCV alone knows."""
        if self.lens == "fisheye" or self.distortion[TERMS:].any():
            return None
        return _read_only(np.pad(self.distortion[:TERMS], (0, max(TERMS - len(self.distortion), 0))))

    @property
    def direction(self) -> FloatArray:
        """(3,) unit vector, the optical axis in the world."""
        return np.asarray(self.rotation[2])

    def _told(self) -> Telling:
        image = f"{self.size[0]} x {self.size[1]} pixels, focal length {self.focal:.0f}"
        lens = f"{self.lens} {vector(self.distortion, 4)}" if self.distortion.any() else "no distortion"
        place = f"at {place_told(self.center)}, looking along {vector(self.direction)}"
        return Telling(f"{self.name}, {image}", [("image", image), ("lens", lens), ("stands", place)])

    def normalize(self, pixels: ArrayLike) -> FloatArray:
        """Undistort: pixels (n, 2) of the image as recorded -> normalised points (n, 2) on the plane z = 1."""
        # Contiguous: OpenCV's fisheye functions ignore strides.
        points = rows(pixels, 2, "pixels", single=True).reshape(-1, 1, 2)
        if points.size == 0:
            return np.empty((0, 2))
        if self.lens == "fisheye":
            out = cv2.fisheye.undistortPoints(points, self.matrix, self.distortion)
        else:
            # OpenCV's default of 5 fixed-point steps leaves some hundredths of a pixel at the rim of wide lenses.
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
            out = _undistort(points, self.matrix, self.distortion, R=None, P=None, criteria=criteria)
        return np.asarray(out, dtype=float).reshape(-1, 2)

    def project(self, points: ArrayLike) -> FloatArray:
        """World points (n, 3) -> pixels (n, 2), lens included; NaN for points not in front of the camera."""
        points = rows(points, 3, "points", single=True)
        if self._terms is not None:
            out = np.empty((len(points), 2))
            projected(points, self.rotation, self._shift, self.matrix, self._terms, out)
            return out
        points_c = points @ self.rotation.T + self._shift
        pixels = np.full((len(points_c), 2), np.nan)
        front = points_c[:, 2] > 1e-9
        if not front.any():
            return pixels
        normalized = points_c[front, :2] / points_c[front, 2:]
        pixels[front] = self.denormalize(normalized)
        return pixels

    def normalize_to_grid(self, pixels: ArrayLike) -> FloatArray:
        """`normalize`, rounded to multiples of a power of two, at most `GRID_PX` pixels: numbers that are sent in few bytes
        and arrive as they are."""
        grid = 2.0 ** np.floor(np.log2(GRID_PX / self.focal))
        return np.asarray(np.round(self.normalize(pixels) / grid) * grid)

    def denormalize(self, normalized: ArrayLike) -> FloatArray:
        """Normalised points (n, 2) -> pixels (n, 2) of the image as recorded: the inverse of `normalize`."""
        points = rows(normalized, 2, "normalized", single=True)
        if points.size == 0:
            return np.empty((0, 2))
        if self.lens == "fisheye":
            out = cv2.fisheye.distortPoints(points.reshape(-1, 1, 2), self.matrix, self.distortion)
        else:
            homogeneous = np.column_stack([points, np.ones(len(points))])
            out, _ = cv2.projectPoints(homogeneous, np.zeros(3), np.zeros(3), self.matrix, self.distortion)
        return np.asarray(out, dtype=float).reshape(-1, 2)

    def rays(self, pixels: ArrayLike) -> FloatArray:
        """Pixels (n, 2) -> unit directions (n, 3) in the world, from the camera's centre."""
        normalized = self.normalize(pixels)
        directions = np.column_stack([normalized, np.ones(len(normalized))]) @ self.rotation
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False, repr=False)
class Rig(Told):
    """All cameras, in a fixed order.

    Args:
        cameras: at least one, names unique.
        unit: the calibration's length unit when it says one ("m", "mm"), else "".

    Raises:
        ValueError: no camera, or two of the same name.
    """

    cameras: tuple[Camera, ...]
    unit: str = ""
    _index: dict[str, int] = field(init=False, repr=False)

    def __init__(self, cameras: Sequence[Camera], unit: str = "") -> None:
        cameras = listed(cameras, Camera, "cameras")
        object.__setattr__(self, "cameras", tuple(cameras))
        object.__setattr__(self, "unit", kind_of(unit, str, "unit"))
        object.__setattr__(self, "_index", {camera.name: i for i, camera in enumerate(cameras)})
        if not cameras:
            raise ValueError("cameras: a rig needs at least one camera")
        if len(self._index) != len(self.cameras):
            raise ValueError(f"cameras: two cameras of the same name in {', '.join(c.name for c in cameras)}")

    def __len__(self) -> int:
        return len(self.cameras)

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __getitem__(self, name: str) -> Camera:
        if name not in self._index:
            raise KeyError(f"no camera {shown(name)} in the rig ({one_line(', '.join(self.names), 200)})")
        return self.cameras[self._index[name]]

    def _told(self) -> Telling:
        brief = f"{len(self)} camera{'s' if len(self) > 1 else ''}, lengths in {self.unit or 'a unit that is not said'}"
        return Telling(brief, named([(c.name, "; ".join(said for _, said in c._told().rows)) for c in self]))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras, in order."""
        return tuple(camera.name for camera in self.cameras)

    def subset(self, names: Sequence[str]) -> Rig:
        """The rig of the named cameras, in the order given.

        Raises:
            KeyError: a name that the rig does not have.
            TypeError, ValueError: no names, or one twice.
        """
        if not (names := listed(names, str, "names")) or len(set(names)) < len(names):
            raise ValueError(f"names: at least one is expected, and none twice; got {len(names)}")
        return Rig([self[name] for name in names], self.unit)

    def in_unit(self, unit: str) -> Rig:
        """The same rig with its lengths in another unit: "m", "cm", "mm", "um", "in" or "ft".

        Raises:
            ValueError: another unit; a rig that does not say its own.
        """
        if kind_of(unit, str, "unit") not in METRES:
            raise ValueError(f"unit must be one of {', '.join(METRES)}, got {shown(unit)}")
        if self.unit not in METRES:
            its = f"in {shown(self.unit)}" if self.unit else "in a unit that it does not say"
            raise ValueError(f"unit: the calibration is {its}, which cannot be told in {unit}")
        scale = METRES[self.unit] / METRES[unit]
        poses = [camera.camera_from_world for camera in self]
        moved = [RigidTransform.from_components(scale * pose.translation, pose.rotation) for pose in poses]
        return self if unit == self.unit else self._standing(moved, unit)

    def in_world(self, new_from_world: RigidTransform) -> Rig:
        """The same rig told in another world; a pose `world_from_object` in it is then `new_from_world * world_from_object`.

        Raises:
            TypeError, ValueError: this is no single transform of finite values.
        """
        world_from_new = single_pose(new_from_world, "new_from_world").inv()
        return self._standing([camera.camera_from_world * world_from_new for camera in self], self.unit)

    def _standing(self, camera_from_world: Sequence[RigidTransform], unit: str) -> Rig:
        moved = zip(self, camera_from_world, strict=True)
        return Rig([replace(camera, camera_from_world=pose) for camera, pose in moved], unit)


def check_name(name: str) -> None:
    """That a camera's name can be part of files' names, and of sentences.

    Raises:
        ValueError: it is empty, a folder's (".", ".."), too long, or has separators of paths or characters that are no
            text: control characters, marks that turn the direction of writing, halves of characters.
    """
    if not isinstance(name, str) or name.strip() in ("", ".", "..") or len(name) > MAX_NAME:
        raise ValueError(f"a camera's name must be a word of at most {MAX_NAME} characters, got {shown(name)}")
    wrong = sorted({c for c in name if c in "/\\" or one_line(f"a{c}b") != f"a{c}b"})
    if wrong:
        raise ValueError(
            f"camera {one_line(name)}: its name has {', '.join(map(ascii, wrong))}, which no file's name can"
        )


def single_pose(pose: Any, name: str) -> RigidTransform:
    """Raises TypeError, ValueError: naming the argument, that this is no single transform of finite values."""
    pose = kind_of(pose, RigidTransform, name)
    if not pose.single or not np.abs(pose.as_matrix()).max() <= MAX_LENGTH:
        raise ValueError(f"{name} must be a single transform of finite values, of lengths of at most {MAX_LENGTH:g}")
    return pose


def _numbers(camera: Camera, what: str, values: ArrayLike) -> FloatArray:
    try:
        array = np.array(values)
        array = np.array(array, dtype=float) if array.dtype.kind in "biufO" else np.array(None, dtype=float)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    if not np.isfinite(array).all():
        raise ValueError(f"camera {camera.name}: the {what} has values that are not finite numbers")
    return array


def _read_only(array: FloatArray) -> FloatArray:
    out = np.array(array)
    out.setflags(write=False)
    return out


def nearest_point_to_rays(centers: ArrayLike, directions: ArrayLike, near: ArrayLike | None = None) -> FloatArray:
    """The point with the least sum of squared distances to lines in space.

    Args:
        centers: (n, 3) a point on each line.
        directions: (n, 3) unit directions.
        near: (3,) where lines leave the point open (one line, or lines within about 3 degrees of each other), the point
            of them nearest to this; None: halfway between opposite lines, at distance 1 along others.

    Returns:
        (3,) the point.
    """
    centers = finite_rows(centers, 3, "centers", most=MAX_LENGTH)
    directions = finite(directions, (len(centers), 3), "directions")
    if len(centers) == 0 or np.abs(np.linalg.norm(directions, axis=1) - 1.0).max() > 1e-6:
        raise ValueError("directions must be unit vectors, at least one")
    if near is None:
        near = centers.mean(axis=0)
        mean = directions.mean(axis=0)
        if np.linalg.norm(mean) > 0.5:
            near = near + mean / np.linalg.norm(mean)
    near = finite(near, (3,), "near", most=MAX_LENGTH)
    projectors = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    offsets = np.einsum("nij,nj->i", projectors, centers - near)
    # Eigenvalues of the sum go down to about (angle / 2)^2 of the largest: 1e-3 cuts at 3 degrees between two lines.
    return np.asarray(near + np.linalg.pinv(projectors.sum(axis=0), rcond=1e-3, hermitian=True) @ offsets)


def camera_at(
    name: str,
    center: ArrayLike,
    target: ArrayLike,
    focal: float,
    size: tuple[int, int],
    distortion: ArrayLike = (),
) -> Camera:
    """A camera at `center` (3,) that looks at `target` (3,), upright (its y axis as near to the world's as can be),
    with the principal point in the image's middle.

    Raises:
        ValueError: a centre that is the target, or anything that `Camera` refuses.
    """
    check_name(name)
    center = finite(center, (3,), "center", most=MAX_LENGTH)
    forward = finite(target, (3,), "target", most=MAX_LENGTH) - center
    number(focal, "focal", above=0.0)
    width, height = (whole(side, "size", least=1, most=MAX_SIDE) for side in items(size, "size", 2, "sides"))
    if not np.linalg.norm(forward) > 0:
        raise ValueError(f"camera {name}: it stands at the point that it looks at")
    forward = forward / np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    if np.linalg.norm(right) < 1e-9:  # straight up or down: any roll is as good
        right = np.array([1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    rotation = Rotation.from_matrix(np.stack([right, np.cross(forward, right), forward]))
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    pose = RigidTransform.from_components(-rotation.apply(center), rotation)
    return Camera(name, (width, height), matrix, real(distortion, "(k,)", "distortion"), pose)
