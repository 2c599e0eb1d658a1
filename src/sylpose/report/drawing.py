"""Drawing into images, preview pictures, undistortion and JPEG files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from sylpose.atomic_io import replace_atomically
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.rig import Camera, Rig

Color = tuple[int, int, int]
Matches = tuple[FloatArray, FloatArray]

# Colors in BGR, OpenCV's order.
WHITE, GRAY, DARK = (245, 245, 245), (150, 150, 150), (28, 26, 24)
AXIS_COLORS: tuple[Color, ...] = ((70, 70, 255), (80, 220, 60), (255, 140, 50))

SHIFT = 4  # OpenCV's fractional bits: lines are drawn to a sixteenth of a pixel


# Opacity of what is drawn over an image (choice: the image below stays visible).
OPACITY = 0.75


def draw_matches(
    tile: Image,
    pair: Matches,
    features: FloatArray,
    scale: float,
    text_scale: float,
    colors: tuple[Color, Color, Color],
) -> None:
    """Draw features (n, 2) as small dots, matches as trails from the previous frame with larger dots, semi-transparent.

    The colors are those of trails, of the matches' dots and of the features' dots.
    """
    before, now = (np.asarray(p, dtype=float).reshape(-1, 2) for p in pair)
    is_drawn = np.isfinite(before).all(axis=1) & np.isfinite(now).all(axis=1)
    before, now, features = before[is_drawn], now[is_drawn], features[np.isfinite(features).all(axis=1)]
    if not len(now) + len(features):
        return
    hidden = np.isin(features @ [1, 1j], now @ [1, 1j])  # by a match's larger dot
    sizes, points = [len(before), len(now)], np.concatenate([before, now, features[~hidden]])
    radii = max(1.4, 1.7 * text_scale), max(1.8, 2.6 * text_scale)
    # Only the points' surroundings are copied and blended, which saves time.
    corner = np.maximum(np.floor((points.min(axis=0) + 0.5) * scale - radii[1] - 2.0), 0.0).astype(int)
    end = np.maximum(np.ceil((points.max(axis=0) + 0.5) * scale + radii[1] + 2.0), corner).astype(int)
    part = tile[corner[1] : end[1], corner[0] : end[0]]
    if not part.size:
        return
    layer = part.copy()
    starts, ends, others = np.split(
        _to_fixed_point(points, scale) - corner.astype(np.int32) * 2**SHIFT, np.cumsum(sizes)
    )
    _draw_dots(layer, others, radii[0], colors[2])
    cv2.polylines(layer, list(np.stack([starts, ends], axis=1)), False, colors[0], 1, cv2.LINE_AA, SHIFT)
    _draw_dots(layer, ends, radii[1], colors[1])
    cv2.addWeighted(layer, OPACITY, part, 1.0 - OPACITY, 0, dst=part)


def _draw_dots(picture: Image, points: NDArray[np.int32], radius: float, color: Color) -> None:
    """Draw dots at fixed-point positions (n, 2)."""
    fixed_radius = round(radius * 2**SHIFT)
    for point in points.tolist():
        cv2.circle(picture, point, fixed_radius, color, -1, cv2.LINE_AA, SHIFT)


def draw_crosses(tile: Image, pixels: FloatArray, scale: float, text_scale: float, color: Color) -> None:
    """Draw small crosses at pixels (n, 2)."""
    arm = round(max(2.5, 3.2 * text_scale) * 2**SHIFT)
    strokes = arm * np.array([[[-1, -1], [1, 1]], [[-1, 1], [1, -1]]], np.int32)
    lines = (_to_fixed_point(pixels, scale)[:, None, None] + strokes).reshape(-1, 2, 2)
    cv2.polylines(tile, list(lines), False, color, 1, cv2.LINE_AA, SHIFT)


def _to_fixed_point(pixels: FloatArray, scale: float) -> NDArray[np.int32]:
    """Convert pixels (n, 2) to OpenCV's fixed-point numbers in a tile scaled by `scale`."""
    return np.asarray(np.round(((pixels + 0.5) * scale - 0.5) * 2**SHIFT), np.int32)


def draw_axes(
    tile: Image, camera: Camera, pose: RigidTransform, length: float, scale: float, text_scale: float, faint: bool
) -> None:
    """Draw the axes of a pose in the world, farthest first.

    The lens model may bend them. With `faint` they are pale and dashed.
    """
    width = max(2, round(text_scale * 2.2))
    matrix = pose.as_matrix()
    origin, directions = matrix[:3, 3], matrix[:3, :3].T
    depths = np.linalg.norm(origin + length * directions - camera.center, axis=1)
    steps = np.linspace(0, 1, 13)
    points = origin + length * steps[:, None] * directions[:, None]
    lines = project_points(camera, points.reshape(-1, 3)).reshape(3, -1, 2)
    for k in np.argsort(-depths):
        pixels = lines[k]
        # A line ends where it leaves the lens's field of view.
        hidden = np.flatnonzero(np.isnan(pixels[:, 0]))
        line = (pixels[: hidden[0] if hidden.size else None] + 0.5) * scale - 0.5
        if len(line) < 2:
            continue
        color = AXIS_COLORS[k]
        if faint:
            color = _fade_color(color)
            for dash in zip(line[::2], line[1::2], strict=False):
                draw_polyline(tile, np.array(dash), color, width)
        else:
            draw_polyline(tile, line, DARK, width + 2)
            draw_polyline(tile, line, color, width)
        outward = line[-1] - line[0]
        reach = np.linalg.norm(outward)
        tip = line[-1] + outward / max(float(reach), 1e-9) * 14 * text_scale
        if len(line) == len(steps):
            draw_text(tile, "xyz"[k], tip, 0.8 * text_scale, color, centered=True)


def project_points(camera: Camera, points: FloatArray) -> FloatArray:
    """Project world points (n, 3) to pixels (n, 2).

    Returns NaN behind the camera and where the lens model is invalid: far outside the image a polynomial model folds
    back into it, so the ray of such a pixel misses the point.
    """
    pixels = camera.project(points)
    seen = np.asarray(np.isfinite(pixels).all(axis=1))
    toward = points[seen] - camera.center
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    seen[seen] = (camera.rays(pixels[seen]) * toward).sum(axis=1) > np.cos(1e-2)
    pixels[~seen] = np.nan
    return pixels


def _fade_color(color: Color) -> Color:
    """Mix a color with gray in equal parts."""
    return ((color[0] + 150) // 2, (color[1] + 150) // 2, (color[2] + 150) // 2)


def stroke_width(size: float) -> int:
    """Return the stroke width in pixels for text of that size."""
    return max(1, round(1.3 * size))


def draw_text(
    picture: Image, text: str, position: Sequence[float] | FloatArray, size: float, color: Color, centered: bool = False
) -> int:
    """Draw text from its baseline's left end, or centered, and return its width in pixels."""
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, stroke_width(size))
    if not np.isfinite(position).all() or max(abs(position[0]), abs(position[1])) > 1e5:
        return int(width)
    x, y = (position[0] - width / 2, position[1] + height / 2) if centered else (position[0], position[1])
    # Centered text has an outline. A thicker pen would widen the letters in OpenCV 5.
    outline = [(dx, dy, DARK) for dx in (-1, 1) for dy in (-1, 1)] if centered else []
    for dx, dy, ink in (*outline, (0, 0, color)):
        place = round(x) + dx, round(y) + dy
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, ink, stroke_width(size), cv2.LINE_AA)
    return int(width)


def to_bgr(image: Image) -> Image:
    """Convert an image (h, w, 3) BGR or (h, w) gray to BGR."""
    return image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)


def draw_polyline(picture: Image, line: FloatArray, color: Color, width: int, closed: bool = False) -> None:
    """Draw a line through points (n, 2) in pixels, skipping those far outside the image."""
    # Beyond this, OpenCV's fixed-point numbers overflow; such points are invisible anyway.
    inside = line[np.isfinite(line).all(axis=1) & (np.abs(line) < 1e5).all(axis=1)]
    if len(inside) > 1:
        points = np.round(inside * 2**SHIFT).astype(np.int32)
        cv2.polylines(picture, [points], closed, color, width, cv2.LINE_AA, SHIFT)


# Height of each camera's picture, pixels.
TILE_HEIGHT = 360
# Axis length relative to the cameras' distance, and floor lines to each side of the origin (choice).
AXIS_RATIO, FLOOR_LINES = 0.15, 4


class View(NamedTuple):
    """View of an object.

    Attributes:
        label: its number, or "" if it is the only one.
        frames: images of C cameras.
        outlines: by camera, outline (k, 2) in pixels, or None if the object is not visible or unknown.
        features: by camera, features (n, 2) in pixels, or none at all.
    """

    label: str
    frames: FrameSet
    outlines: Sequence[FloatArray | None]
    features: Sequence[FloatArray] = ()


def draw_views(path: Path, names: Sequence[str], views: Sequence[View]) -> None:
    """Draw views of an object, or of several, one row below the other.

    Args:
        path: path of the picture.
        names: names of C cameras.
        views: the rows.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    drawn = list[Image]()
    for label, frames, outlines, features in views:
        tiles = list[Image]()
        for c, (image, name, outline) in enumerate(zip(frames.images, names, outlines, strict=True)):
            tile, scale = _make_tile(image)
            if features:
                for x, y in np.round((features[c] + 0.5) * scale - 0.5).astype(int).tolist():
                    cv2.circle(tile, (x, y), 2, AXIS_COLORS[1], -1, cv2.LINE_AA)
            if outline is not None:
                pixels = (outline + 0.5) * scale - 0.5
                draw_polyline(tile, pixels, AXIS_COLORS[1], 2, closed=True)
                x, y = np.clip(pixels.mean(axis=0), 12, np.array(tile.shape[1::-1]) - 12).astype(int).tolist()
                draw_text(tile, label, (x - 8, y + 8), 1.0, WHITE)
            draw_text(tile, name, (8, 22), 0.6, WHITE)
            tiles.append(tile)
        drawn.append(np.hstack(tiles))
    _save(path, np.vstack(drawn))


def draw_surface(path: Path, names: Sequence[str], images: Sequence[Image], surfaces: Sequence[Image]) -> None:
    """Draw the outline of a surface into an image of each camera, and the surface below; write them as PNG.

    Args:
        path: the file.
        names: of the cameras.
        images: (h, w, 3) BGR.
        surfaces: (h, w, 3) pictures of the surface from the same cameras; 0 where it is not.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    columns = []
    for name, image, surface in zip(names, images, surfaces, strict=True):
        mask = np.asarray((surface > 0).any(axis=2), np.uint8)
        outlines, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        outlined = cv2.drawContours(
            image.copy(), outlines, -1, AXIS_COLORS[0], max(1, round(image.shape[0] / TILE_HEIGHT))
        )
        tiles = [_make_tile(np.asarray(picture, np.uint8))[0] for picture in (outlined, surface)]
        draw_text(tiles[0], name, (8, 24), 0.6, WHITE)
        columns.append(np.vstack(tiles))
    _save(path, np.hstack(columns))


def draw_world_axes(path: Path, images: Sequence[Image | None], rig: Rig) -> None:
    """Draw the images side by side, each with the world's axes and grid lines of its floor, z = 0.

    The grid lines are one axis length apart.

    Args:
        path: path of the picture.
        images: images of the rig's cameras, (h, w, 3) BGR or (h, w) gray, or None.
        rig: the cameras.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    distance = float(np.median([np.linalg.norm(camera.center) for camera in rig]))
    length = _round_length(AXIS_RATIO * distance)
    tiles = [_make_tile(image, camera) for image, camera in zip(images, rig, strict=True)]
    ends = length * FLOOR_LINES
    steps = np.linspace(-ends, ends, 12 * FLOOR_LINES + 1)
    for (tile, scale), camera in zip(tiles, rig, strict=True):
        layer = tile.copy()
        for offset in np.linspace(-ends, ends, 2 * FLOOR_LINES + 1):
            for xy in ([steps, np.full_like(steps, offset)], [np.full_like(steps, offset), steps]):
                line = project_points(camera, np.column_stack([*xy, np.zeros_like(steps)]))
                for part in np.split(line, np.flatnonzero(np.isnan(line[:, 0]))):
                    draw_polyline(layer, (part[np.isfinite(part[:, 0])] + 0.5) * scale - 0.5, WHITE, 1)
        cv2.addWeighted(layer, 0.5, tile, 0.5, 0, dst=tile)
        draw_axes(tile, camera, RigidTransform.identity(), length, scale, 0.8, faint=False)
        draw_text(tile, f"{camera.name}   axes {length:g} {rig.unit}".rstrip(), (8, 22), 0.6, WHITE)
    _save(path, np.hstack([tile for tile, _ in tiles]))


def _round_length(value: float) -> float:
    """Round to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-12)))
    return float(min((1, 2, 5, 10), key=lambda n: abs(n * power - value)) * power)


def _make_tile(image: Image | None, camera: Camera | None = None) -> tuple[Image, float]:
    """Return a picture to draw into and its scale relative to the image; a dark one without an image."""
    if image is None and camera is not None:
        image = np.full((camera.size[1], camera.size[0], 3), DARK, np.uint8)
    if image is None:
        return np.full((TILE_HEIGHT, TILE_HEIGHT, 3), DARK, np.uint8), 1.0
    scale = TILE_HEIGHT / image.shape[0]
    return np.asarray(cv2.resize(to_bgr(image), (max(1, round(scale * image.shape[1])), TILE_HEIGHT)), np.uint8), scale


def _save(path: Path, picture: Image) -> None:
    is_encoded, data = cv2.imencode(".png", picture)
    if not is_encoded:
        raise OSError(f"{path}: the picture cannot be written")
    with replace_atomically(path) as part:
        part.write_bytes(data.tobytes())


# JPEG quality of 100 (choice): edges are preserved at a twentieth of the bytes. The second is for thumbnails, of which
# some dozens of frames must fit into a page.
JPEG_QUALITY, THUMBNAIL_QUALITY = 90, 68
# Thumbnail width in pixels with up to four cameras; narrower with more, so that all together keep the same size
# (choice: an object a tenth as wide as the image still has fifty pixels).
THUMBNAIL_WIDTH, MIN_THUMBNAIL_WIDTH, FULL_WIDTH_CAMERAS = 448, 128, 4
# Undistorted images cover at most this much of the plane z = 1 to each side of its middle: 132 degrees (choice).
MAX_TANGENT = 2.25
# BGR of pixels outside the camera's image.
BACKGROUND_COLOR = (60, 60, 60)


def encode_thumbnail(image: Image | None, cameras: int) -> bytes | None:
    """Encode a small JPEG file; None without an image.

    Args:
        image: (h, w, 3) BGR or (h, w) gray.
        cameras: number of cameras.
    """
    if image is None:
        return None
    width = max(MIN_THUMBNAIL_WIDTH, round(THUMBNAIL_WIDTH * min(1.0, FULL_WIDTH_CAMERAS / cameras) ** 0.5))
    return encode_jpeg(_shrink_to_width(image, width), THUMBNAIL_QUALITY)


def shrink_image(image: Image, max_side: int) -> Image:
    """Shrink an image (h, w, 3) or (h, w) so that its longer side has at most `max_side` pixels."""
    height, width = image.shape[:2]
    return _shrink_to_width(image, max(1, round(max_side * width / max(height, width))))


def _shrink_to_width(image: Image, width: int) -> Image:
    """Shrink an image to at most this width."""
    # Halving first takes a sixth of the time of a single resize.
    while image.shape[1] >= 2 * width and min(image.shape[:2]) > 1:
        image = _resize(image, image.shape[1] // 2, image.shape[0] // 2, cv2.INTER_AREA)
    if image.shape[1] > width:
        image = _resize(image, width, max(1, round(width / image.shape[1] * image.shape[0])), cv2.INTER_LINEAR)
    return image


def _resize(image: Image, width: int, height: int, interpolation: int) -> Image:
    return np.asarray(cv2.resize(image, (width, height), interpolation=interpolation), np.uint8)


def encode_jpeg(image: Image, quality: int = JPEG_QUALITY) -> bytes:
    """Encode an image (h, w, 3) BGR or (h, w) as a JPEG file.

    Raises:
        ValueError: the image cannot be encoded.
    """
    is_encoded, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not is_encoded:
        raise ValueError("image: cannot be encoded as JPEG")
    return data.tobytes()


@dataclass(frozen=True, eq=False)
class UndistortionMap:
    """Pixel map that removes the lens distortion from a camera's images.

    Attributes:
        low, high: (2,) bounds of the result in the plane z = 1 of the camera: left and top, right and bottom.
        size: (width, height) of the resulting images.
        map_x, map_y: (height, width) source x and y of each pixel, in the image scaled to `size`.
    """

    low: FloatArray
    high: FloatArray
    size: tuple[int, int]
    map_x: NDArray[np.float32]
    map_y: NDArray[np.float32]

    def apply(self, image: Image) -> Image:
        """Undistort a camera's image (h, w, 3) or (h, w) to (height, width, 3); gray where it has no source."""
        small = _shrink_to_width(to_bgr(image), self.size[0])
        rest: dict[str, Any] = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": BACKGROUND_COLOR}
        return np.asarray(cv2.remap(small, self.map_x, self.map_y, cv2.INTER_LINEAR, **rest), np.uint8)


def build_undistortion_map(camera: Camera, max_side: int) -> UndistortionMap:
    """Build the undistortion map for images whose longer side has `max_side` pixels.

    Of a very wide lens, only the middle is covered.
    """
    width, height = camera.size
    steps_along_edge = np.linspace(0.0, 1.0, 33)[:, None]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    border = np.concatenate(
        [a + steps_along_edge * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )
    bounds = np.clip(camera.normalize(border), -MAX_TANGENT, MAX_TANGENT)
    low, high = bounds.min(axis=0), bounds.max(axis=0)
    scale = max_side / max(width, height)
    size = max(2, round(scale * width)), max(2, round(scale * height))
    steps = [(np.arange(n) + 0.5) / n for n in size]
    grid = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
    pixels = _project_normalized(camera, low + grid * (high - low))
    places = (pixels + 0.5) * (np.array(size) / camera.size) - 0.5
    # Pixels without a source are mapped far outside the image.
    map_x, map_y = np.where(np.isfinite(places), places, -10.0).astype(np.float32).T.copy().reshape(2, size[1], size[0])
    return UndistortionMap(low, high, size, map_x, map_y)


def _project_normalized(camera: Camera, normalized: FloatArray) -> FloatArray:
    """Project points (n, 2) of the camera's plane z = 1 to pixels (n, 2); NaN where the lens model folds back."""
    directions = np.column_stack([normalized, np.ones(len(normalized))]) @ camera.rotation
    return project_points(camera, camera.center + directions)
