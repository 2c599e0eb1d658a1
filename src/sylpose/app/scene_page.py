"""Cameras, objects and where they went, drawn into a viser page from the arrays of `report.scene`.

Lengths are drawn in the cameras' distances, about the scene's middle, so that all scenes are alike to the page.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray, Image, IntArray
from sylpose.report.pictures import straightened
from sylpose.report.scene import Scene
from sylpose.results import FrameStatus
from sylpose.rig import Rig

__all__ = ["DEVIATIONS", "LAYERS", "NOTHING", "ScenePage", "pieces_of", "plain", "status_color"]

# The longer side of the images, pixels (choice: sharp enough beside the object, 20 kB each).
IMAGE = 480
# Pieces of a path (choice: more is not seen, and takes megabytes).
MOST_PIECES = 20_000
# Points on an object (choice).
MOST_POINTS = 20_000
# Standard deviations that are drawn, and of the object's radius, how large they are to look usually (choice).
DEVIATIONS, DOUBT_SIZE = 2.0, 0.7
# How deep a camera's frustum is, in the cameras' distances (choice).
FRUSTUM = 0.16
# The first look, in the cameras' distances: its field of view from top to bottom, a page's width, how high it is, the room
# around, and how near to the line to the middle a camera is in the way (choice).
FOV, ASPECT, ELEVATION, AROUND, FREE = np.deg2rad(40.0), 1.15, np.deg2rad(33.0), 1.15, 0.35
# How far an object is seen from that is looked at from near, in its radii (choice).
NEAR = 5.5
# Cells and sections of the floor, on a light page and on a dark one.
FLOOR = {False: ((236, 236, 236), (214, 214, 214)), True: ((44, 46, 50), (66, 69, 75))}
LAYERS = ("Cameras", "Images", "Path", "Axes", "Points", "Uncertainty", "Floor")
Rgb = tuple[int, int, int]

# What a frame was, in the path and beside its status: seen; seen again; carried on; hardly known; without a pose.
SEEN, NOTHING = (31, 119, 220), (150, 150, 150)
_COLORS: dict[str, Rgb] = {
    FrameStatus.RELOCALISED.value: (142, 68, 173),
    FrameStatus.COASTING.value: (243, 156, 18),
    FrameStatus.UNCERTAIN.value: (231, 76, 60),
}


def status_color(status: str) -> Rgb:
    """Of a frame with a pose of this status, `FrameStatus.value`."""
    return _COLORS.get(status, SEEN)


def plain(text: str) -> str:
    """Text as Markdown that says no more than that, whatever is in it."""
    return "".join(
        f"\\{c}" if c.isascii() and not c.isalnum() and not c.isspace() else c for c in " ".join(text.split())
    )


@dataclass(eq=False)
class Nodes:
    """What is drawn of one object, and what of it can be shown now."""

    axes: Any
    points: Any
    doubt: Any
    path: dict[Rgb, Any]
    larger: float = 1.0
    size: float = 0.0
    places: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    posed: bool = False
    doubtful: bool = False


class ScenePage:
    """A page of a viser server: the cameras of a scene, and objects in it.

    Args:
        server: of viser.
        scene: its cameras, its middle, its axes.
        rig: the same cameras, with their lenses.

    Attributes:
        visible: by layer of `LAYERS`; `refresh` after a change.
    """

    def __init__(self, server: Any, scene: Scene, rig: Rig) -> None:
        self.server, self._scene, self._api = server, scene, server.scene
        self.visible = dict.fromkeys(LAYERS, True)
        self._objects: dict[str, Nodes] = {}
        self._seen_from: int | None = None
        right, ahead, up = scene.axes
        self._api.set_up_direction(tuple(up))
        # Nothing is drawn that would be prettier for reflections and shadows, which slow graphics pay for with seconds.
        self._api.configure_default_lights(cast_shadow=False)
        self._api.configure_environment_map(hdri=None)
        server.initial_camera.fov = FOV
        server.initial_camera.look_at = (0.0, 0.0, 0.0)
        server.initial_camera.position = tuple(self._first_look())
        self._floor = self._api.add_grid(
            "/floor",
            width=4.0,
            height=4.0,
            cell_size=0.1,
            section_size=0.5,
            cell_thickness=0.6,
            section_thickness=1.0,
            cell_color=FLOOR[False][0],
            section_color=FLOOR[False][1],
            shadow_opacity=0.0,
            wxyz=_wxyz(np.column_stack([right, ahead, np.cross(right, ahead)])),
            position=tuple(self._low() * up),
        )
        self._lines: list[Any] = []
        self._labels: list[Any] = []
        self._images: list[Any] = []
        self._straight = [straightened(camera, IMAGE) for camera in rig]
        for c, name in enumerate(scene.cameras):
            self._camera(c, name)

    def _first_look(self) -> FloatArray:
        """(3,) from where all cameras are seen, the nearer the better, and none is in the way."""
        right, ahead, up = self._scene.axes
        eyes = self._at(self._scene.world_from_camera[:, :3, 3])
        best, nearest = -3.0 * ahead, np.inf
        for angle in np.deg2rad(np.arange(-180, 180, 10)):
            level = np.sin(angle) * right - np.cos(angle) * ahead
            view = np.cos(ELEVATION) * level + np.sin(ELEVATION) * up
            sideways = np.cross(up, view)
            above = np.cross(view, sideways) / np.linalg.norm(sideways)
            beside = eyes @ sideways / np.linalg.norm(sideways)
            room = np.tan(FOV / 2) * np.array([[ASPECT], [1.0]])
            away = float((eyes @ view + np.abs(np.stack([beside, eyes @ above])) / room).max())
            blocked = (eyes @ view > 0) & (np.hypot(beside, eyes @ above) < FREE)
            # Rather from behind the cameras, which shows their images, than from their other side.
            rank = away + 10.0 * float(blocked.sum()) + 0.3 * abs(float(angle))
            if rank < nearest:
                best, nearest = AROUND * max(away, 1.0) * view, rank
        return np.asarray(best)

    def _low(self) -> float:
        """Below everything that stands: the lowest camera, or the object."""
        up = self._scene.axes[2]
        heights = self._at(self._scene.world_from_camera[:, :3, 3]) @ up
        return float(min(heights.min(), -1.2 * self._scene.axis_length / self._scene.reach)) - 0.03

    def _at(self, points: FloatArray) -> FloatArray:
        """World points (..., 3) as they are drawn."""
        return np.asarray((points - self._scene.center) / self._scene.reach)

    def _camera(self, c: int, name: str) -> None:
        scene, straight = self._scene, self._straight[c]
        color = tuple(scene.colors[c].tolist())
        eye, turned = self._at(scene.world_from_camera[c, :3, 3]), scene.world_from_camera[c, :3, :3]
        (left, top), (right, bottom) = straight.low, straight.high
        end = np.array([[left, top, 1], [right, top, 1], [right, bottom, 1], [left, bottom, 1]])
        corners = eye + FRUSTUM * end @ turned.T
        around = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
        edges = np.concatenate([np.stack([np.broadcast_to(eye, (4, 3)), corners], axis=1), around])
        # Not below the camera's name, which may be any.
        self._lines.append(
            self._api.add_line_segments(
                f"/camera{c}", edges.astype(np.float32), color, thickness=2.0, thickness_units="screen"
            )
        )
        behind = eye - 0.04 * turned[:, 2]
        self._labels.append(self._api.add_label(f"/name{c}", name, position=tuple(behind), anchor="bottom-center"))
        self._images.append(
            self._api.add_image(
                f"/image{c}",
                np.zeros((2, 2, 3), np.uint8),
                float(right - left),
                float(bottom - top),
                format="jpeg",
                jpeg_quality=80,
                cast_shadow=False,
                receive_shadow=False,
                wxyz=_wxyz(turned),
                visible=False,
            )
        )
        self._hang(c, FRUSTUM)

    def _hang(self, c: int, depth: float) -> None:
        """A camera's image so far before it, as large as it is there."""
        straight, pose = self._straight[c], self._scene.world_from_camera[c]
        middle = np.append(0.5 * (straight.low + straight.high), 1.0)
        self._images[c].position = tuple(self._at(pose[:3, 3]) + depth * pose[:3, :3] @ middle)
        self._images[c].scale = depth

    def add(self, name: str) -> None:
        """An object, of which nothing is known yet."""
        key = f"/object{len(self._objects)}"
        axes = self._api.add_frame(key, visible=False)
        points = self._api.add_point_cloud(
            f"{key}/points",
            np.zeros((1, 3), np.float32),
            (0, 0, 0),
            point_shape="circle",
            precision="float32",
            visible=False,
        )
        doubt = self._api.add_icosphere(
            f"{key}_doubt", 1.0, (60, 140, 230), opacity=0.3, cast_shadow=False, receive_shadow=False, visible=False
        )
        path = {
            color: self._api.add_line_segments(
                f"{key}_path{k}",
                np.zeros((1, 2, 3), np.float32),
                color,
                thickness=3.0,
                thickness_units="screen",
                visible=False,
            )
            for k, color in enumerate((SEEN, *_COLORS.values()))
        }
        self._objects[name] = Nodes(axes, points, doubt, path)
        self.sized(name, self._scene.axis_length)

    def sized(self, name: str, radius: float, usual_sd: float = np.nan) -> None:
        """An object's radius, and how far off its place usually is, one standard deviation, in the scene's unit."""
        nodes, size = self._objects[name], radius / self._scene.reach
        nodes.size = size
        nodes.axes.axes_length, nodes.axes.axes_radius, nodes.axes.origin_radius = 1.25 * size, 0.03 * size, 0.05 * size
        nodes.points.point_size = 0.02 * size
        wanted = DOUBT_SIZE * radius / (DEVIATIONS * usual_sd) if usual_sd > 0 else 1.0
        nodes.larger = max(1.0, 10.0 ** float(np.floor(np.log10(wanted))))

    def larger(self, name: str) -> float:
        """How many times as large as they are an object's standard deviations are drawn, so that they are seen."""
        return self._objects[name].larger

    def points(self, name: str, points: FloatArray, colors: IntArray) -> None:
        """Points (n, 3) on an object in its frame, with colours (n, 3)."""
        every = max(1, -(-len(points) // MOST_POINTS))
        nodes = self._objects[name]
        if len(points):
            nodes.points.points = (points[::every] / self._scene.reach).astype(np.float32)
            nodes.points.colors = colors[::every].astype(np.uint8)
        self._shown(nodes)

    def path(self, name: str, places: FloatArray, statuses: Sequence[str]) -> None:
        """Where an object was, world (n, 3), NaN where it was not found; in the colours of the statuses (n)."""
        nodes = self._objects[name]
        nodes.places = self._at(places)
        for color, pieces in pieces_of(nodes.places, statuses).items():
            nodes.path[color].points = pieces
        self._paths(nodes)

    def pose(self, name: str, world_from_object: FloatArray | None, covariance: FloatArray | None) -> None:
        """Where an object is, (4, 4), or that it was not found; and how well its place is known, (6, 6) of (w, d)."""
        nodes = self._objects[name]
        nodes.posed = world_from_object is not None and bool(np.isfinite(world_from_object).all())
        nodes.doubtful = False
        if nodes.posed and world_from_object is not None:
            nodes.axes.wxyz = _wxyz(world_from_object[:3, :3])
            nodes.axes.position = tuple(self._at(world_from_object[:3, 3]))
            if covariance is not None and np.isfinite(covariance[3:, 3:]).all():
                values, vectors = np.linalg.eigh(covariance[3:, 3:])
                sizes = DEVIATIONS * nodes.larger * np.sqrt(np.maximum(values, 0.0)) / self._scene.reach
                # One of nothing is as good as none: the first frame defines what all others are relative to.
                nodes.doubtful = bool(sizes[-1] > 0)
                nodes.doubt.scale = tuple(np.maximum(sizes, 1e-4))
                nodes.doubt.wxyz = _wxyz(vectors * np.linalg.det(vectors))
                nodes.doubt.position = nodes.axes.position
        self._shown(nodes)

    def images(self, images: Sequence[Image | None]) -> None:
        """Of all cameras, BGR."""
        for node, straight, image in zip(self._images, self._straight, images, strict=True):
            if image is not None:
                node.image = np.ascontiguousarray(straight.of(image)[..., ::-1])
            node.visible = image is not None and self.visible["Images"]

    def refresh(self) -> None:
        """Shows the layers that are `visible`; images with the next ones."""
        for c, (lines, label) in enumerate(zip(self._lines, self._labels, strict=True)):
            lines.visible = self.visible["Cameras"] and c != self._seen_from  # it would be around the eye
            label.visible = self.visible["Cameras"]
        for node in self._images:
            node.visible = node.visible and self.visible["Images"]
        self._floor.visible = self.visible["Floor"] and self._seen_from is None
        for nodes in self._objects.values():
            self._paths(nodes)
            self._shown(nodes)

    def _paths(self, nodes: Nodes) -> None:
        for path in nodes.path.values():
            path.visible = self.visible["Path"] and bool(path.points.any())

    def darken(self, dark: bool) -> None:
        """The page's ground is dark, or light again."""
        self._floor.cell_color, self._floor.section_color = FLOOR[dark]
        for c, lines in enumerate(self._lines):
            color = self._scene.colors[c]
            lines.colors = (color + (255 - color) // 2 if dark else color).astype(np.uint8)

    def _shown(self, nodes: Nodes) -> None:
        nodes.axes.visible = nodes.posed
        nodes.axes.show_axes = self.visible["Axes"]
        nodes.points.visible = self.visible["Points"] and len(nodes.points.points) > 1
        nodes.doubt.visible = nodes.doubtful and self.visible["Uncertainty"]

    def look(self, client: Any, camera: int | None, near: str | None = None) -> None:
        """Lets who looks at the page see as a camera does, its image behind the object, or an object from near, or all."""
        with self.server.atomic():
            if self._seen_from is not None:
                self._hang(self._seen_from, FRUSTUM)
            if camera is not None:
                self._hang(camera, self._beyond(camera))
            self._seen_from = camera
            self.refresh()
        start = self.server.initial_camera
        up, eye, target, fov = self._scene.axes[2], start.position, start.look_at, start.fov
        if camera is not None:
            pose, straight = self._scene.world_from_camera[camera], self._straight[camera]
            middle = np.append(0.5 * (straight.low + straight.high), 1.0)
            up, eye = -pose[:3, 1], self._at(pose[:3, 3])
            target = eye + pose[:3, :3] @ middle
            fov = 2 * float(np.arctan(0.5 * (straight.high[1] - straight.low[1])))
        elif near is not None:
            nodes = self._objects[near]
            target = np.array(nodes.axes.position)
            eye = target + NEAR * nodes.size * eye / np.linalg.norm(eye)
        with client.atomic():
            client.camera.up_direction = tuple(up)
            client.camera.position, client.camera.look_at, client.camera.fov = tuple(eye), tuple(target), fov

    def _beyond(self, c: int) -> float:
        """A depth at which nothing of any object was before a camera."""
        pose = self._scene.world_from_camera[c]
        depths = [
            (nodes.places - self._at(pose[:3, 3])) @ pose[:3, 2] + 2 * nodes.size for nodes in self._objects.values()
        ]
        return float(np.nanmax(np.concatenate([[1.0], *depths])))


def pieces_of(places: FloatArray, statuses: Sequence[str]) -> dict[Rgb, NDArray[np.float32]]:
    """A path as pieces of lines (m, 2, 3) by colour: between frames that follow each other, both with a place.

    Of more than `MOST_PIECES` frames every n-th is taken; where one between them has no place, neither has the line.
    """
    n = len(places)
    chosen = np.arange(0, n, max(1, -(-n // MOST_PIECES)))
    lost = np.concatenate([[0], np.cumsum(~np.isfinite(places).all(axis=1))])
    a, b = chosen[:-1], chosen[1:]
    whole = lost[b + 1] == lost[a]
    a, b = a[whole], b[whole]
    lines = np.stack([places[a], places[b]], axis=1).astype(np.float32)
    colors = [status_color(statuses[k]) for k in b.tolist()]
    return {color: lines[[c == color for c in colors]] for color in dict.fromkeys(colors)}


def _wxyz(rotation: FloatArray) -> tuple[float, float, float, float]:
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return w, x, y, z
