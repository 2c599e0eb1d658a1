"""3D scene of a result as arrays: cameras, object poses, object points and thumbnails.

All viewers (`report/page.py`, `sylpose show`) draw from it, so that they are consistent.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.report.plots import camera_colors
from sylpose.report.rigview import compute_view_axes, find_axes_intersection
from sylpose.results import Trajectory
from sylpose.rig import Camera, Rig

# Frustum depth, and axis length for an object of unknown size, relative to the cameras' distance from the object
# (choice).
FRUSTUM_DEPTH_RATIO, DEFAULT_AXIS_RATIO = 0.16, 0.05
# Points along each side of an image, between which lens distortion is approximated as linear (choice: to a hundredth of
# the image's width for the widest lenses).
IMAGE_GRID = 9


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points on an object, in its own frame.

    Attributes:
        points: (n, 3).
        cameras: (n,) index of the camera that observed each point.
        radius: radius of the object.
    """

    points: FloatArray
    cameras: IntArray
    radius: float


@dataclass(frozen=True, eq=False)
class Thumbnails:
    """Thumbnails of some frames.

    Attributes:
        index: (K,) numbers of these frames in the recording, in order.
        images: for each of them C JPEG files, or None where a camera had no image.
    """

    index: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    images: tuple[tuple[bytes | None, ...], ...] = ()


@dataclass(frozen=True, eq=False)
class Scene:
    """Scene of C cameras, one object with n points, and N frames.

    Lengths are in the calibration's unit, in the calibration's world.

    Attributes:
        unit: unit of lengths, or "".
        cameras: (C) names.
        sizes: (C, 2) of their images, pixels.
        world_from_camera: (C, 4, 4); a camera looks along its z, y is down.
        image_planes: (C, GRID, GRID, 3) far plane of each frustum in the world: intersections with the rays of evenly
            spaced pixels, lens included, by rows from the image's top left corner.
        colors: (C, 3) of 0 ... 255, red, green, blue: of the camera in all drawings.
        axes: (3, 3) rows right, ahead and up: unit vectors in the world for viewing the rig
            (`rigview.compute_view_axes`).
        center: (3,) point to look at, in the world.
        camera_distance: median distance of the cameras from it.
        index: (N,) numbers of the frames in the recording.
        times: (N,) seconds, or numbers of frames.
        world_from_object: (N, 4, 4); NaN where a frame has no pose.
        covariance: (N, 6, 6) of (w, d) in the world's axes (docs/conventions.md); only its diagonal if read from files.
        measured: (N,) whether the pose was found in this frame's images.
        status: (N) values of `results.FrameStatus`.
        reason: (N) why a frame has no measured pose; "" otherwise.
        points: (n, 3) on the object, in its frame.
        point_cameras: (n,) index of the camera that observed each point.
        axis_length: length of the object's axes: its radius.
        thumbnails: thumbnails of some frames.
    """

    unit: str
    cameras: tuple[str, ...]
    sizes: IntArray
    world_from_camera: FloatArray
    image_planes: FloatArray
    colors: IntArray
    axes: FloatArray
    center: FloatArray
    camera_distance: float
    index: IntArray
    times: FloatArray
    world_from_object: FloatArray
    covariance: FloatArray
    measured: BoolArray
    status: tuple[str, ...]
    reason: tuple[str, ...]
    points: FloatArray
    point_cameras: IntArray
    axis_length: float
    thumbnails: Thumbnails

    @property
    def point_colors(self) -> IntArray:
        """Return the color (n, 3) of 0 ... 255 of the camera that observed each point."""
        return self.colors[self.point_cameras]


def build_scene(
    trajectory: Trajectory, rig: Rig, cloud: PointCloud | None = None, thumbnails: Thumbnails | None = None
) -> Scene:
    """Build the scene of a trajectory in front of its cameras.

    Args:
        trajectory: trajectory of the cameras of `rig`, in this order.
        rig: in the unit of the trajectory.
        cloud: points on the object; None if unknown.
        thumbnails: thumbnails; None for none.

    Raises:
        ValueError: a trajectory of other cameras.
    """
    if trajectory.camera_names != rig.names:
        raise ValueError(
            f"trajectory: of the cameras {', '.join(trajectory.camera_names)}, the rig has {', '.join(rig.names)}"
        )
    centers = np.array([camera.center for camera in rig])
    center = _compute_center(trajectory, rig, centers)
    camera_distance = float(np.median(np.linalg.norm(centers - center, axis=1))) or 1.0
    colors = np.array([list(bytes.fromhex(color[1:])) for color in camera_colors(len(rig))], np.int64)
    if cloud is None:
        cloud = PointCloud(np.empty((0, 3)), np.empty(0, np.int64), DEFAULT_AXIS_RATIO * camera_distance)
    return Scene(
        unit=trajectory.unit,
        cameras=rig.names,
        sizes=np.array([camera.size for camera in rig], np.int64),
        world_from_camera=np.array([camera.camera_from_world.inv().as_matrix() for camera in rig]),
        image_planes=np.array([_compute_image_plane(camera, FRUSTUM_DEPTH_RATIO * camera_distance) for camera in rig]),
        colors=colors,
        axes=compute_view_axes(rig),
        center=center,
        camera_distance=camera_distance,
        index=np.array([f.index for f in trajectory], np.int64),
        times=trajectory.times,
        world_from_object=_pose_matrices(trajectory),
        covariance=np.array([f.covariance for f in trajectory]).reshape(-1, 6, 6),
        measured=trajectory.measured_mask,
        status=tuple(f.status.value for f in trajectory),
        reason=tuple(f.reason for f in trajectory),
        points=cloud.points,
        point_cameras=cloud.cameras,
        axis_length=cloud.radius,
        thumbnails=Thumbnails() if thumbnails is None else thumbnails,
    )


def _compute_center(trajectory: Trajectory, rig: Rig, centers: FloatArray) -> FloatArray:
    """Compute the object's median position (3,); without any pose, the point that the cameras look at."""
    places = trajectory.positions
    valid_positions = places[np.isfinite(places).all(axis=1)]
    if len(valid_positions):
        return np.asarray(np.median(valid_positions, axis=0))
    point = find_axes_intersection(rig)
    if point is not None:
        return point
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()) or 1.0
    ahead = np.mean([camera.direction for camera in rig], axis=0)
    return np.asarray(centers.mean(axis=0) + 2 * spread * ahead)


def _pose_matrices(trajectory: Trajectory) -> FloatArray:
    missing = np.full((4, 4), np.nan)
    poses = [f.world_from_object for f in trajectory]
    return np.array([missing if pose is None else pose.as_matrix() for pose in poses]).reshape(-1, 4, 4)


def _compute_image_plane(camera: Camera, depth: float) -> FloatArray:
    """Compute the image's grid points (GRID, GRID, 3) in the world, on a plane at distance `depth`."""
    across, down = (np.linspace(0, side - 1, IMAGE_GRID) for side in camera.size)
    rays = camera.rays(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    # At the border of a very wide lens, a flat end would extend to infinity.
    points = camera.center + depth * rays / np.maximum(rays @ camera.direction, 0.4)[:, None]
    return np.asarray(points.reshape(IMAGE_GRID, IMAGE_GRID, 3))
