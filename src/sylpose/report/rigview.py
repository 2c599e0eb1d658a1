"""Pictures of the rig from above and from the side, and a table of its cameras, for `sylpose check`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.report.plots import INK, camera_colors, create_figure, save_figure
from sylpose.rig import Camera, Rig, intersect_rays

# Optical axes closer to parallel than this have no useful intersection (choice).
MIN_AXIS_ANGLE = np.radians(2)
OBJECT_COLOR = "#D55E00"
OBJECT_STYLE: dict[str, Any] = {
    "color": OBJECT_COLOR,
    "marker": "P",
    "markersize": 9,
    "markeredgecolor": "white",
    "linestyle": "",
}
OBJECT_LINE_STYLE: dict[str, Any] = {"color": "#888888", "linewidth": 0.9, "linestyle": ":"}
BASELINE_STYLE: dict[str, Any] = {"color": "#555555", "linewidth": 1.0, "linestyle": "--"}
TEXT_HALO: list[patheffects.AbstractPathEffect] = [patheffects.withStroke(linewidth=3, foreground="white")]


@dataclass(frozen=True)
class CameraView:
    """Geometry of one camera in its rig: a row of the table that `sylpose check` prints. Angles in degrees.

    Attributes:
        name: name of the camera.
        size: (width, height) in pixels.
        field_of_view: (horizontal, vertical) between the midpoints of the image's edges, lens included.
        distance: to the center, in the calibration's unit; NaN without a center.
        off_axis: angle between the optical axis and the direction to the center; NaN without a center.
        angles: (C,) between its optical axis and those of all cameras, in the rig's order; 0 for itself.
        baselines: (C,) distances to all cameras, in the calibration's unit.
    """

    name: str
    size: tuple[int, int]
    field_of_view: tuple[float, float]
    distance: float
    off_axis: float
    angles: tuple[float, ...]
    baselines: tuple[float, ...]


def find_axes_intersection(rig: Rig) -> FloatArray | None:
    """Find the point (3,) nearest to all optical axes, in world coordinates.

    Returns:
        None for a single camera, for axes within 2 degrees of parallel, or for a point that is not in front of most
        cameras.
    """
    centers, directions = _camera_centers(rig), _camera_directions(rig)
    # The second largest singular value is the axes' spread about their common direction.
    if len(rig) < 2 or np.linalg.svd(directions, compute_uv=False)[1] < np.sqrt(len(rig)) * np.sin(MIN_AXIS_ANGLE / 2):
        return None
    point = intersect_rays(centers, directions)
    in_front = ((point - centers) * directions).sum(axis=1) > 0
    return point if in_front.mean() > 0.5 else None


def describe_rig(rig: Rig, center: ArrayLike | None = None) -> list[CameraView]:
    """Compute the table of cameras, one row each, in the rig's order.

    Args:
        rig: the cameras.
        center: (3,) position of the object in the world; None for `find_axes_intersection`.

    Raises:
        ValueError: a center that is not three finite numbers.
    """
    point = _resolve_center(rig, center)
    centers, directions = _camera_centers(rig), _camera_directions(rig)
    rows = []
    for i, camera in enumerate(rig):
        distance = off_axis = float("nan")
        if point is not None:
            distance = float(np.linalg.norm(point - centers[i]))
            off_axis = _angle_between(directions[i], point - centers[i])
        angles = tuple(_angle_between(directions[i], other) for other in directions)
        baselines = tuple(float(d) for d in np.linalg.norm(centers - centers[i], axis=1))
        field_of_view = _compute_field_of_view(camera)
        rows.append(CameraView(camera.name, camera.size, field_of_view, distance, off_axis, angles, baselines))
    return rows


def compute_view_axes(rig: Rig) -> FloatArray:
    """Compute the axes for viewing the rig from above: (3, 3) unit rows right, ahead, up in the world.

    The plane right-ahead is the best fit to the cameras' centers and viewing directions, whatever the world's axes
    are. Up is the side toward which most images have their upper edge. Ahead is the cameras' mean viewing direction,
    or that of the first one if they surround the object.
    """
    centers, directions = _camera_centers(rig), _camera_directions(rig)
    ups = np.array([-camera.rotation[1] for camera in rig])
    offsets = centers - centers.mean(axis=0)
    spread = np.sqrt((offsets**2).sum(axis=1).mean())
    direction_offsets = directions - directions.mean(axis=0)
    # The spread of centers and directions spans the plane. Cameras in a ring that look down share a component outside
    # of it. That component only has weight where the rest is degenerate (cameras in a row, side by side), and the
    # images' own up has the least weight.
    scatter = direction_offsets.T @ direction_offsets + 0.03 * directions.T @ directions - 0.003 * ups.T @ ups
    if spread > 0:
        scatter += offsets.T @ offsets / spread**2
    up = np.linalg.eigh(scatter)[1][:, 0]
    votes = ups @ up
    if (np.sign(votes).sum(), votes.sum()) < (0, 0):
        up = -up
    for ahead in (directions.mean(axis=0), directions[0], ups[0]):
        ahead = ahead - (ahead @ up) * up
        if np.linalg.norm(ahead) > 0.3:
            break
    ahead /= np.linalg.norm(ahead)
    return np.array([np.cross(ahead, up), ahead, up])


def plot_rig(rig: Rig, path: Path | str, center: ArrayLike | None = None, radius: float | None = None) -> None:
    """Plot the rig from above and from the side.

    The panels show fields of view, the object, distances to it and distances between neighboring cameras.

    Args:
        rig: the cameras.
        path: path of the picture (.png, .pdf, .svg); replaced if it exists.
        center: (3,) position of the object in the world; None for `find_axes_intersection`.
        radius: radius of the object, in the calibration's unit; None if unknown.

    Raises:
        ValueError: a center that is not three finite numbers, a radius that is not positive.
        OSError: the file cannot be written; the message names it.
    """
    point = _resolve_center(rig, center)
    if radius is not None and not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"the object's radius must be a positive number, got {radius}")
    centers = _camera_centers(rig)
    if point is not None:
        reach = float(np.median(np.linalg.norm(centers - point, axis=1)))
    else:
        reach = 2 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()) or 1.0
    length = 0.3 * reach
    axes = compute_view_axes(rig)
    origin = centers.mean(axis=0) if point is None else point
    corners = np.concatenate([_compute_frustum(camera, length) for camera in rig])
    shown = (np.concatenate([corners, origin[None]]) - origin) @ axes.T
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.12 * float((high - low).max())
    low, high = low - margin, high + margin

    width, depth, height = high - low
    # Both panels share one scale, in inches per unit, chosen to fill a page together.
    inches = min(8.5 / width, 6.5 / depth, 11.0 / (depth + height))
    figure = create_figure(max(width * inches, 6.0) + 1.2, (depth + height) * inches + 2.0)
    top_panel, side_panel = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [depth, height]})
    unit = rig.unit or "units"
    distances = None if point is None else np.linalg.norm(centers - point, axis=1)
    for panel, rows, name in (
        (top_panel, axes[[0, 1]], "from above"),
        (side_panel, axes[[0, 2]], "from the side, looking ahead"),
    ):
        places = (centers - origin) @ rows.T
        _draw_cameras(panel, rig, places, rows, origin, length)
        if point is not None:
            _draw_object(panel, places, radius)
        if panel is top_panel:
            _draw_distances(panel, places, centers, distances)
        panel.set_aspect("equal")
        panel.set_title(f"The rig {name}", loc="left", color=INK, fontsize=12, fontweight="bold")
        panel.grid(True, color="#E4E4E4", linewidth=0.7)
        panel.set_axisbelow(True)
        panel.spines[:].set_color("#CCCCCC")
        panel.tick_params(colors=INK, labelbottom=True)
    if len(rig) > 1 or point is not None:
        _draw_legend(figure, unit, point is not None, center is None)
    top_panel.set_xlim(low[0], high[0])
    top_panel.set_ylim(low[1], high[1])
    side_panel.set_ylim(low[2], high[2])
    top_panel.set_ylabel(f"ahead ({unit})", color=INK)
    side_panel.set_ylabel(f"up ({unit})", color=INK)
    side_panel.set_xlabel(f"right ({unit})", color=INK)
    save_figure(figure, path)


def _draw_cameras(
    panel: Axes, rig: Rig, places: FloatArray, rows: FloatArray, origin: FloatArray, length: float
) -> None:
    """Draw fields of view, viewing directions and names."""
    middle = places.mean(axis=0)
    for camera, place, color in zip(rig, places, camera_colors(len(rig)), strict=True):
        outline = ((_compute_frustum(camera, length) - origin) @ rows.T).astype(np.float32)
        hull = cv2.convexHull(outline).reshape(-1, 2)
        panel.add_patch(Polygon(hull, facecolor=color, edgecolor=color, alpha=0.25, linewidth=1.2))
        arrow = 1.25 * length * rows @ camera.direction
        if np.linalg.norm(arrow) > 0.2 * length:
            style = {"arrowstyle": "-|>", "color": color, "linewidth": 1.6, "shrinkA": 0, "shrinkB": 0}
            panel.annotate("", place + arrow, place, arrowprops=style)
        panel.plot(*place, "o", color=color, markersize=7)
        # The name is placed behind the camera; if it looks along the viewing direction, away from the other cameras.
        behind = -(rows @ camera.direction)
        if np.linalg.norm(behind) < 0.3:
            behind = place - middle if np.linalg.norm(place - middle) > 1e-9 else np.array([0.0, 1.0])
        x, y = (15 * behind / np.linalg.norm(behind)).tolist()
        look: dict[str, Any] = {"color": INK, "fontsize": 11, "fontweight": "bold", "path_effects": TEXT_HALO}
        look["ha"] = "left" if x > 6 else "right" if x < -6 else "center"
        look["va"] = "bottom" if y > 6 else "top" if y < -6 else "center"
        panel.annotate(camera.name, place, xytext=(x, y), textcoords="offset points", **look)


def _draw_object(panel: Axes, places: FloatArray, radius: float | None) -> None:
    """Draw the object at (0, 0) and lines to it."""
    for place in places:
        panel.plot([place[0], 0], [place[1], 0], **OBJECT_LINE_STYLE, zorder=1)
    if radius is not None:
        panel.add_patch(Circle((0, 0), radius, facecolor=OBJECT_COLOR, alpha=0.25, edgecolor=OBJECT_COLOR))
    panel.plot(0, 0, **OBJECT_STYLE)


def _draw_distances(panel: Axes, places: FloatArray, centers: FloatArray, distances: FloatArray | None) -> None:
    """Label the lines to the object and between neighbors with their lengths in space."""
    if distances is not None:
        for place, distance in zip(places, distances, strict=True):
            _draw_label(panel, 0.42 * place, f"{distance:.3g}", "#666666")
    for i, j in _find_adjacent_pairs(places):
        panel.plot(*places[[i, j]].T, **BASELINE_STYLE, zorder=1)
        _draw_label(panel, places[[i, j]].mean(axis=0), f"{np.linalg.norm(centers[i] - centers[j]):.3g}", INK)


def _draw_legend(figure: Figure, unit: str, has_object: bool, is_estimate: bool) -> None:
    entries = [(BASELINE_STYLE, f"between neighbors ({unit})")]
    if has_object:
        where = "nearest point to the optical axes" if is_estimate else "object"
        entries = [(OBJECT_STYLE, where), (OBJECT_LINE_STYLE, f"distance ({unit})"), *entries]
    lines = [Line2D([], [], **style, label=label) for style, label in entries]
    # Outside the panels, since any corner of them may contain a camera.
    figure.legend(handles=lines, loc="outside lower center", ncols=3, frameon=False, fontsize=9)


def _find_adjacent_pairs(places: FloatArray) -> list[tuple[int, int]]:
    """Find pairs of adjacent cameras around (0, 0), the object or the cameras' mean; an arc stays open."""
    n = len(places)
    if n < 2:
        return []
    bearings = np.arctan2(places[:, 1], places[:, 0])
    order = np.argsort(bearings)
    gaps = np.mod(np.roll(bearings[order], -1) - bearings[order], 2 * np.pi)
    pairs = [(int(order[k]), int(order[(k + 1) % n])) for k in range(n)]
    if n == 2 or gaps.max() > np.radians(100):
        pairs.pop(int(np.argmax(gaps)))
    return pairs


def _draw_label(panel: Axes, place: FloatArray, content: str, color: str) -> None:
    text = panel.text(place[0], place[1], content, ha="center", va="center", fontsize=9.5, color=color)
    text.set_path_effects(TEXT_HALO)


def _compute_frustum(camera: Camera, length: float) -> FloatArray:
    """Compute (17, 3) points of the frustum: the camera's center and its image's border at depth `length`."""
    w, h = camera.size[0] - 1, camera.size[1] - 1
    s = np.linspace(0, 1, 5)[:4, None]
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=float)
    edge = np.concatenate([(1 - s) * a + s * b for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    rays = camera.rays(edge)
    # Limit the flat end of the frustum: at the border of a very wide lens it would extend to infinity.
    rays = rays / np.maximum(rays @ camera.direction, 0.4)[:, None]
    return np.asarray(np.concatenate([camera.center[None], camera.center + length * rays]))


def _compute_field_of_view(camera: Camera) -> tuple[float, float]:
    w, h = camera.size[0] - 1, camera.size[1] - 1
    left, right, top, bottom = camera.rays([[0, h / 2], [w, h / 2], [w / 2, 0], [w / 2, h]])
    return _angle_between(left, right), _angle_between(top, bottom)


def _angle_between(a: FloatArray, b: FloatArray) -> float:
    """Compute the angle between two vectors in degrees, accurate for small angles too."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def _camera_centers(rig: Rig) -> FloatArray:
    return np.array([camera.center for camera in rig])


def _camera_directions(rig: Rig) -> FloatArray:
    return np.array([camera.direction for camera in rig])


def _resolve_center(rig: Rig, center: ArrayLike | None) -> FloatArray | None:
    if center is None:
        return find_axes_intersection(rig)
    point = np.asarray(center, dtype=float)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"the object's center must be three finite numbers, got {center}")
    return point
