"""Viser page with cameras, objects and their paths, drawn from the arrays of `report.scene`.

Lengths are divided by the extent of the cameras and centered on the scene, so that the page's sizes fit all scenes.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sylpose.display import format_length
from sylpose.geometry.arrays import FloatArray, Image, IntArray
from sylpose.report.drawing import build_undistortion_map
from sylpose.report.scene import Scene
from sylpose.rig import Rig
from sylpose.status import DOUBTFUL, PREDICTED, FrameStatus

# Longer side of the images, pixels (choice: sharp enough next to the object, 20 kB each).
IMAGE_SIZE = 480
# Largest number of line segments of a path (choice: more are not visible and take megabytes).
MAX_PATH_SEGMENTS = 20_000
# Largest number of points of an object (choice).
MAX_POINTS = 20_000
# Drawn multiple of the standard deviation, and its usual size on the page as a share of the object's radius (choice).
DRAWN_SDS, ELLIPSOID_SIZE = 2.0, 0.7
# Depth of a camera's frustum, in the scene's extent (choice).
FRUSTUM_DEPTH = 0.16
# Initial view, lengths in the scene's extent: vertical field of view, aspect ratio, elevation, margin, and the distance
# from the line of view at which a camera blocks it (choice).
FOV, ASPECT, ELEVATION, VIEW_MARGIN, BLOCKING_DISTANCE = np.deg2rad(40.0), 1.15, np.deg2rad(33.0), 1.15, 0.35
# Distance of the close-up view of an object, in its radii (choice).
CLOSEUP_DISTANCE = 5.5
# Colors of the floor's cells and sections, on a light and on a dark page.
FLOOR_COLORS = {False: ((236, 236, 236), (214, 214, 214)), True: ((44, 46, 50), (66, 69, 75))}
# Options of nodes that lines share, and of those that surfaces share.
_LINES: dict[str, Any] = {"thickness_units": "screen"}
_SURFACE: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False, "visible": False}
LAYERS = ("Cameras", "Images", "Path", "Axes", "Points", "Uncertainty", "Floor")
Rgb = tuple[int, int, int]

# Colors of frames in the path and next to their status: tracked, relocalized, coasting or interpolated, uncertain or
# contradicted; without a pose.
TRACKED_COLOR, NO_POSE_COLOR = (31, 119, 220), (150, 150, 150)
_COLORS: dict[str, Rgb] = {
    FrameStatus.RELOCALIZED.value: (142, 68, 173),
    **{status.value: (243, 156, 18) for status in PREDICTED},
    **{status.value: (231, 76, 60) for status in DOUBTFUL},
}


def status_color(status: str) -> Rgb:
    """Return the color of a frame with a pose and this status, `FrameStatus.value`."""
    return _COLORS.get(status, TRACKED_COLOR)


def escape_markdown(text: str) -> str:
    """Escape text for Markdown, so that it is shown literally."""
    return re.sub(r"[!-/:-@[-`{-~]", r"\\\g<0>", " ".join(text.split()))


@dataclass(eq=False)
class ObjectNodes:
    """Scene nodes of one object, and their current state."""

    unit: str
    axes: Any
    points: Any
    ellipsoid: Any
    path: dict[Rgb, Any]
    enlargement: float = 1.0
    size: float = 0.0
    positions: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    has_ellipsoid: bool = False


class ScenePage:
    """Page of a viser server with the cameras of a scene and the objects in it.

    Args:
        server: a viser server.
        scene: the scene's cameras, center and axes.
        rig: the same cameras, with their lenses.

    Attributes:
        visible: visibility by layer of `LAYERS`; call `refresh` after a change.
    """

    def __init__(self, server: Any, scene: Scene, rig: Rig) -> None:
        self.server, self._scene, self._api = server, scene, server.scene
        self.visible = dict.fromkeys(LAYERS, True)
        self._objects: dict[str, ObjectNodes] = {}
        self._view_camera: int | None = None
        right, ahead, up = scene.axes
        self._api.set_up_direction(tuple(up))
        # Shadows and reflections do not help here, and cost seconds on slow graphics.
        self._api.configure_default_lights(cast_shadow=False)
        self._api.configure_environment_map(hdri=None)
        server.initial_camera.fov = FOV
        server.initial_camera.look_at = (0.0, 0.0, 0.0)
        server.initial_camera.position = tuple(self._choose_viewpoint())
        # The floor is below the lowest camera and the object.
        heights = self._to_page(scene.world_from_camera[:, :3, 3]) @ up
        height = float(min(heights.min(), -1.2 * scene.axis_length / scene.camera_distance)) - 0.03
        pose = {"wxyz": _wxyz(np.column_stack([right, ahead, np.cross(right, ahead)])), "position": tuple(height * up)}
        sizes = {"width": 4.0, "height": 4.0, "cell_size": 0.1, "section_size": 0.5, "shadow_opacity": 0.0}
        self._floor = self._api.add_grid("/floor", cell_thickness=0.6, section_thickness=1.0, **sizes, **pose)
        self._floor.cell_color, self._floor.section_color = FLOOR_COLORS[False]
        self._lines: list[Any] = []
        self._labels: list[Any] = []
        self._recorded_images: list[Any] = []
        self._rectified = [build_undistortion_map(camera, IMAGE_SIZE) for camera in rig]
        for c, name in enumerate(scene.cameras):
            self._add_camera(c, name)

    def _choose_viewpoint(self) -> FloatArray:
        """Choose the nearest viewpoint (3,) that shows all cameras without one of them blocking the view."""
        right, ahead, up = self._scene.axes
        centers = self._to_page(self._scene.world_from_camera[:, :3, 3])
        best, nearest = -3.0 * ahead, np.inf
        for angle in np.deg2rad(np.arange(-180, 180, 10)):
            level = np.sin(angle) * right - np.cos(angle) * ahead
            view = np.cos(ELEVATION) * level + np.sin(ELEVATION) * up
            sideways = np.cross(up, view)
            above = np.cross(view, sideways) / np.linalg.norm(sideways)
            horizontal = centers @ sideways / np.linalg.norm(sideways)
            half_size = np.tan(FOV / 2) * np.array([[ASPECT], [1.0]])
            distance = float((centers @ view + np.abs(np.stack([horizontal, centers @ above])) / half_size).max())
            blocked = (centers @ view > 0) & (np.hypot(horizontal, centers @ above) < BLOCKING_DISTANCE)
            # Prefer views from behind the cameras, which show their images.
            rank = distance + 10.0 * float(blocked.sum()) + 0.3 * abs(float(angle))
            if rank < nearest:
                best, nearest = VIEW_MARGIN * max(distance, 1.0) * view, rank
        return np.asarray(best)

    def _to_page(self, points: FloatArray) -> FloatArray:
        """Convert world points (..., 3) to page coordinates."""
        return np.asarray((points - self._scene.center) / self._scene.camera_distance)

    def _add_camera(self, c: int, name: str) -> None:
        scene, straight = self._scene, self._rectified[c]
        color = tuple(scene.colors[c].tolist())
        center, rotation = self._to_page(scene.world_from_camera[c, :3, 3]), scene.world_from_camera[c, :3, :3]
        (left, top), (right, bottom) = straight.low, straight.high
        end = np.array([[left, top, 1], [right, top, 1], [right, bottom, 1], [left, bottom, 1]])
        corners = center + FRUSTUM_DEPTH * end @ rotation.T
        around = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
        edges = np.concatenate([np.stack([np.broadcast_to(center, (4, 3)), corners], axis=1), around])
        # Node names use the index: a camera's name may contain any characters.
        lines, place = edges.astype(np.float32), tuple(center - 0.04 * rotation[:, 2])
        self._lines.append(self._api.add_line_segments(f"/camera{c}", lines, color, thickness=2.0, **_LINES))
        self._labels.append(self._api.add_label(f"/name{c}", name, position=place, anchor="bottom-center"))
        blank, size = np.zeros((2, 2, 3), np.uint8), (float(right - left), float(bottom - top))
        options = {"format": "jpeg", "jpeg_quality": 80, "wxyz": _wxyz(rotation), **_SURFACE}
        self._recorded_images.append(self._api.add_image(f"/image{c}", blank, *size, **options))
        self._place_image(c, FRUSTUM_DEPTH)

    def _place_image(self, c: int, depth: float) -> None:
        """Place a camera's image at a depth, scaled to fill its field of view."""
        straight, pose = self._rectified[c], self._scene.world_from_camera[c]
        middle = np.append(0.5 * (straight.low + straight.high), 1.0)
        self._recorded_images[c].position = tuple(self._to_page(pose[:3, 3]) + depth * pose[:3, :3] @ middle)
        self._recorded_images[c].scale = depth

    def add(self, name: str, unit: str) -> None:
        """Add an object without pose, points or path; `unit` is the length unit of its poses."""
        key, blank = f"/object{len(self._objects)}", np.zeros((1, 2, 3), np.float32)
        axes = self._api.add_frame(key, visible=False)
        look = {"point_shape": "circle", "precision": "float32", "visible": False}
        points = self._api.add_point_cloud(f"{key}/points", blank[0, :1], (0, 0, 0), **look)
        ellipsoid = self._api.add_icosphere(f"{key}_uncertainty", 1.0, (60, 140, 230), opacity=0.3, **_SURFACE)
        look = {"thickness": 3.0, "visible": False, **_LINES}
        path = {
            color: self._api.add_line_segments(f"{key}_path{k}", blank, color, **look)
            for k, color in enumerate(dict.fromkeys((TRACKED_COLOR, *_COLORS.values())))
        }
        self._objects[name] = ObjectNodes(unit, axes, points, ellipsoid, path)
        self.set_size(name, self._scene.axis_length)

    def set_size(self, name: str, radius: float, usual_sd: float = np.nan) -> None:
        """Set an object's radius and the usual standard deviation of its position, in the scene's unit."""
        nodes, size = self._objects[name], radius / self._scene.camera_distance
        nodes.size = size
        nodes.axes.axes_length, nodes.axes.axes_radius, nodes.axes.origin_radius = 1.25 * size, 0.03 * size, 0.05 * size
        nodes.points.point_size = 0.02 * size
        wanted = ELLIPSOID_SIZE * radius / (DRAWN_SDS * usual_sd) if usual_sd > 0 else 1.0
        nodes.enlargement = max(1.0, 10.0 ** float(np.floor(np.log10(wanted))))

    def set_points(self, name: str, points: FloatArray, colors: IntArray) -> None:
        """Set an object's points (n, 3), in its frame, and their colors (n, 3)."""
        every = max(1, -(-len(points) // MAX_POINTS))
        nodes = self._objects[name]
        if len(points):
            nodes.points.points = (points[::every] / self._scene.camera_distance).astype(np.float32)
            nodes.points.colors = colors[::every].astype(np.uint8)
        self._update_visibility(nodes)

    def set_path(self, name: str, places: FloatArray, statuses: Sequence[str]) -> None:
        """Set an object's path: world positions (n, 3), NaN if unknown, in the colors of their statuses (n)."""
        nodes = self._objects[name]
        nodes.positions = self._to_page(places)
        for color, pieces in split_path(nodes.positions, statuses).items():
            nodes.path[color].points = pieces
        self._update_paths(nodes)

    def set_pose(self, name: str, world_from_object: FloatArray | None, covariance: FloatArray | None) -> None:
        """Set an object's pose (4, 4), or None, and its covariance (6, 6) of (w, d)."""
        nodes = self._objects[name]
        nodes.axes.visible = nodes.has_ellipsoid = False
        if world_from_object is not None and np.isfinite(world_from_object).all():
            nodes.axes.visible = True
            nodes.axes.wxyz = _wxyz(world_from_object[:3, :3])
            nodes.axes.position = tuple(self._to_page(world_from_object[:3, 3]))
            if covariance is not None and np.isfinite(covariance[3:, 3:]).all():
                values, vectors = np.linalg.eigh(covariance[3:, 3:])
                sizes = DRAWN_SDS * nodes.enlargement * np.sqrt(np.maximum(values, 0.0)) / self._scene.camera_distance
                # The first frame has a zero covariance, as it defines the reference: draw none.
                nodes.has_ellipsoid = bool(sizes[-1] > 0)
                nodes.ellipsoid.scale = tuple(np.maximum(sizes, 1e-4))
                nodes.ellipsoid.wxyz = _wxyz(vectors * np.linalg.det(vectors))
                nodes.ellipsoid.position = nodes.axes.position
        self._update_visibility(nodes)

    def describe_pose(
        self, name: str, label: str, status: FrameStatus, reason: str, pose: FloatArray, covariance: FloatArray
    ) -> str:
        """Describe an object in a frame as Markdown.

        Args:
            name: the object.
            label: name to show; "" for a single object.
            status: status of the frame.
            reason: why it has this status; "" for the status's default text.
            pose: (4, 4) world_from_object, NaN without a pose.
            covariance: (6, 6) of (w, d).
        """
        has_pose, unit = bool(np.isfinite(pose).all()), escape_markdown(self._objects[name].unit)
        color = status_color(status.value) if has_pose else NO_POSE_COLOR
        title = f"**{escape_markdown(label)}{': ' if label else ''}{status.value}**"
        lines = [f"<span style='color:rgb{color}'>⬤</span> {title}", escape_markdown(reason or status.text)]
        if has_pose:
            sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
            lines.append(f"at {', '.join(f'{v:.4g}' for v in pose[:3, 3])} {unit}")
            if not np.isfinite(sigma).all():
                lines.append("uncertainty of the pose is unbounded")
            elif sigma.any():
                rotation_sd, position_sd = np.degrees(np.linalg.norm(sigma[:3])), float(np.linalg.norm(sigma[3:]))
                lines.append(f"sd {rotation_sd:.2g}° and {format_length(position_sd, unit)}")
                lines.append(f"(drawn {DRAWN_SDS * self._objects[name].enlargement:.0f} times as large)")
        return "  \n".join(lines)

    def set_images(self, images: Sequence[Image | None]) -> None:
        """Set the images (BGR) of all cameras."""
        for node, straight, image in zip(self._recorded_images, self._rectified, images, strict=True):
            if image is not None:
                node.image = np.ascontiguousarray(straight.apply(image)[..., ::-1])
            node.visible = image is not None and self.visible["Images"]

    def refresh(self) -> None:
        """Apply `visible` to all layers; hidden images reappear with the next ones."""
        for c, (lines, label) in enumerate(zip(self._lines, self._labels, strict=True)):
            lines.visible = self.visible["Cameras"] and c != self._view_camera  # the viewpoint is inside it
            label.visible = self.visible["Cameras"]
        for node in self._recorded_images:
            node.visible = node.visible and self.visible["Images"]
        self._floor.visible = self.visible["Floor"] and self._view_camera is None
        for nodes in self._objects.values():
            self._update_paths(nodes)
            self._update_visibility(nodes)

    def _update_paths(self, nodes: ObjectNodes) -> None:
        for path in nodes.path.values():
            path.visible = self.visible["Path"] and bool(path.points.any())

    def set_dark(self, dark: bool) -> None:
        """Switch the colors for a dark or a light background."""
        self._floor.cell_color, self._floor.section_color = FLOOR_COLORS[dark]
        for c, lines in enumerate(self._lines):
            color = self._scene.colors[c]
            lines.colors = (color + (255 - color) // 2 if dark else color).astype(np.uint8)

    def _update_visibility(self, nodes: ObjectNodes) -> None:
        nodes.axes.show_axes = self.visible["Axes"]
        nodes.points.visible = self.visible["Points"] and len(nodes.points.points) > 1
        nodes.ellipsoid.visible = nodes.has_ellipsoid and self.visible["Uncertainty"]

    def set_view(self, client: Any, camera: int | None, object_name: str | None = None) -> None:
        """Set a client's view: that of a camera with its image behind the object, a close-up of an object, or all."""
        with self.server.atomic():
            if self._view_camera is not None:
                self._place_image(self._view_camera, FRUSTUM_DEPTH)
            if camera is not None:
                self._place_image(camera, self._depth_behind_objects(camera))
            self._view_camera = camera
            self.refresh()
        start = self.server.initial_camera
        up, eye, target, fov = self._scene.axes[2], start.position, start.look_at, start.fov
        if camera is not None:
            pose, straight = self._scene.world_from_camera[camera], self._rectified[camera]
            middle = np.append(0.5 * (straight.low + straight.high), 1.0)
            up, eye = -pose[:3, 1], self._to_page(pose[:3, 3])
            target = eye + pose[:3, :3] @ middle
            fov = 2 * float(np.arctan(0.5 * (straight.high[1] - straight.low[1])))
        elif object_name is not None:
            nodes = self._objects[object_name]
            target = np.array(nodes.axes.position)
            eye = target + CLOSEUP_DISTANCE * nodes.size * eye / np.linalg.norm(eye)
        with client.atomic():
            client.camera.up_direction = tuple(up)
            client.camera.position, client.camera.look_at, client.camera.fov = tuple(eye), tuple(target), fov

    def _depth_behind_objects(self, c: int) -> float:
        """Return a depth behind all objects in a camera's view."""
        pose = self._scene.world_from_camera[c]
        center, ahead = self._to_page(pose[:3, 3]), pose[:3, 2]
        depths = [(nodes.positions - center) @ ahead + 2 * nodes.size for nodes in self._objects.values()]
        return float(np.nanmax(np.concatenate([[1.0], *depths])))


def split_path(positions: FloatArray, statuses: Sequence[str]) -> dict[Rgb, NDArray[np.float32]]:
    """Split a path into line segments (m, 2, 3) by color, between consecutive frames with positions.

    Paths of more than `MAX_PATH_SEGMENTS` frames are subsampled; a segment is omitted if a frame in between has no
    position.
    """
    n = len(positions)
    chosen = np.arange(0, n, max(1, -(-n // MAX_PATH_SEGMENTS)))
    n_missing = np.concatenate([[0], np.cumsum(~np.isfinite(positions).all(axis=1))])
    a, b = chosen[:-1], chosen[1:]
    complete = n_missing[b + 1] == n_missing[a]
    a, b = a[complete], b[complete]
    lines = np.stack([positions[a], positions[b]], axis=1).astype(np.float32)
    colors = [status_color(statuses[k]) for k in b.tolist()]
    return {color: lines[[c == color for c in colors]] for color in dict.fromkeys(colors)}


def _wxyz(rotation: FloatArray) -> tuple[float, float, float, float]:
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return w, x, y, z
