"""What is shown of a result in three dimensions, as arrays: cameras, the object, where it was in each frame, and images.

Whatever draws it (`report/page.py`, `sylpose show`) takes it from here, so that all show the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.report.plots import camera_colors
from sylpose.report.rigview import meeting_point, view_axes
from sylpose.results import Trajectory
from sylpose.rig import Camera, Rig

__all__ = ["GRID", "Cloud", "Scene", "Stills", "scene_of"]

# How deep a camera's frustum is drawn, and how long the axes of an object of unknown size are, as shares of the cameras'
# distance to what they look at (choice).
FRUSTUM, UNKNOWN_SIZE = 0.16, 0.05
# Points along each side of an image, between which what a lens bends is taken for straight (choice: to a hundredth of the
# image's width for the widest lenses).
GRID = 9


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points on an object, in its own frame.

    Attributes:
        points: (n, 3).
        cameras: (n,) the number of the camera that saw each.
        radius: of the object.
    """

    points: FloatArray
    cameras: IntArray
    radius: float


@dataclass(frozen=True, eq=False)
class Stills:
    """Small pictures of some frames.

    Attributes:
        index: (K,) numbers of these frames in the recording, in order.
        images: for each of them C images, JPEG files, or None where a camera had none.
    """

    index: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    images: tuple[tuple[bytes | None, ...], ...] = ()


@dataclass(frozen=True, eq=False)
class Scene:
    """C cameras, one object with n points, N frames. Lengths are in the calibration's unit, in the calibration's world.

    Attributes:
        unit: of lengths, or "".
        cameras: (C) names.
        sizes: (C, 2) of their images, pixels.
        matrices: (C, 3, 3) intrinsic, pixels; lenses are left out.
        world_from_camera: (C, 4, 4); a camera looks along its z, y is down.
        sheets: (C, GRID, GRID, 3) the end of each one's frustum, a plane in the world: where the rays of evenly spaced
            pixels meet it, lens included, by rows from the image's top left corner.
        colors: (C, 3) of 0 ... 255, red, green, blue: of the camera in everything that is drawn.
        axes: (3, 3) rows right, ahead and up: unit vectors in the world to look at the rig by (`rigview.view_axes`).
        center: (3,) what to look at, in the world.
        reach: how far the cameras are from it in the middle.
        index: (N,) numbers of the frames in the recording.
        times: (N,) seconds, or numbers of frames.
        world_from_object: (N, 4, 4); NaN where a frame has no pose.
        covariance: (N, 6, 6) of (w, d) in the world's axes (docs/conventions.md); of what was read from files its diagonal.
        measured: (N,) whether the pose was found in this frame's images.
        status: (N) words, `results.FrameStatus`.
        reason: (N) why a frame has no pose, or none that was measured; "" else.
        points: (n, 3) on the object, in its frame.
        point_cameras: (n,) number of the camera that saw each.
        axis_length: of the object's axes: its radius.
        stills: images of some of the frames.
    """

    unit: str
    cameras: tuple[str, ...]
    sizes: IntArray
    matrices: FloatArray
    world_from_camera: FloatArray
    sheets: FloatArray
    colors: IntArray
    axes: FloatArray
    center: FloatArray
    reach: float
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
    stills: Stills

    @property
    def corners(self) -> FloatArray:
        """(C, 4, 3) of the frusta's ends: top left, top right, bottom right, bottom left."""
        return self.sheets[:, [0, 0, -1, -1], [0, -1, -1, 0]]

    @property
    def point_colors(self) -> IntArray:
        """(n, 3) of 0 ... 255: of the camera that saw each."""
        return self.colors[self.point_cameras]


def scene_of(trajectory: Trajectory, rig: Rig, cloud: Cloud | None = None, stills: Stills | None = None) -> Scene:
    """A trajectory in front of the cameras that saw it.

    Args:
        trajectory: of the cameras of `rig`, in this order.
        rig: in the unit of the trajectory.
        cloud: what is known of the object; None for next to nothing.
        stills: images; None for none.

    Raises:
        ValueError: a trajectory of other cameras.
    """
    if trajectory.camera_names != rig.names:
        raise ValueError(
            f"trajectory: of the cameras {', '.join(trajectory.camera_names)}, the rig has {', '.join(rig.names)}"
        )
    centers = np.array([camera.center for camera in rig])
    center = _middle(trajectory, rig, centers)
    reach = float(np.median(np.linalg.norm(centers - center, axis=1))) or 1.0
    colors = np.array([_rgb(color) for color in camera_colors(len(rig))], np.int64)
    if cloud is None:
        cloud = Cloud(np.empty((0, 3)), np.empty(0, np.int64), UNKNOWN_SIZE * reach)
    return Scene(
        unit=trajectory.unit,
        cameras=rig.names,
        sizes=np.array([camera.size for camera in rig], np.int64),
        matrices=np.array([camera.matrix for camera in rig]),
        world_from_camera=np.array([camera.camera_from_world.inv().as_matrix() for camera in rig]),
        sheets=np.array([_sheet(camera, FRUSTUM * reach) for camera in rig]),
        colors=colors,
        axes=view_axes(rig),
        center=center,
        reach=reach,
        index=np.array([f.index for f in trajectory], np.int64),
        times=trajectory.times,
        world_from_object=_matrices(trajectory),
        covariance=np.array([f.covariance for f in trajectory]).reshape(-1, 6, 6),
        measured=trajectory.solved,
        status=tuple(f.status.value for f in trajectory),
        reason=tuple(f.reason for f in trajectory),
        points=cloud.points,
        point_cameras=cloud.cameras,
        axis_length=cloud.radius,
        stills=Stills() if stills is None else stills,
    )


def _middle(trajectory: Trajectory, rig: Rig, centers: FloatArray) -> FloatArray:
    """(3,) where the object was in the middle; without any pose, what the cameras look at."""
    places = trajectory.positions
    known = places[np.isfinite(places).all(axis=1)]
    if len(known):
        return np.asarray(np.median(known, axis=0))
    point = meeting_point(rig)
    if point is not None:
        return point
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()) or 1.0
    ahead = np.mean([camera.direction for camera in rig], axis=0)
    return np.asarray(centers.mean(axis=0) + 2 * spread * ahead)


def _matrices(trajectory: Trajectory) -> FloatArray:
    nothing = np.full((4, 4), np.nan)
    poses = [f.world_from_object for f in trajectory]
    return np.array([nothing if pose is None else pose.as_matrix() for pose in poses]).reshape(-1, 4, 4)


def _sheet(camera: Camera, depth: float) -> FloatArray:
    """(GRID, GRID, 3) of its image, in the world, in a plane `depth` before it."""
    across, down = (np.linspace(0, side - 1, GRID) for side in camera.size)
    rays = camera.rays(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    # At the rim of a very wide lens a flat end would go to infinity.
    points = camera.center + depth * rays / np.maximum(rays @ camera.direction, 0.4)[:, None]
    return np.asarray(points.reshape(GRID, GRID, 3))


def _rgb(color: str) -> Sequence[int]:
    return [int(color[k : k + 2], 16) for k in (1, 3, 5)]
