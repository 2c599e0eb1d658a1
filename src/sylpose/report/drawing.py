"""Subpixel drawing of lines, points and text into images."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray, Image, IntArray
from sylpose.rig import Camera

__all__ = [
    "AXIS_COLORS",
    "DARK",
    "GRAY",
    "WHITE",
    "draw_axes",
    "draw_crosses",
    "draw_dots",
    "draw_matches",
    "draw_polyline",
    "draw_text",
    "project_points",
    "stroke_width",
    "to_bgr",
]

Color = tuple[int, int, int]
Matches = tuple[FloatArray, FloatArray]

# Colors in BGR, OpenCV's order.
WHITE, GRAY, DARK = (245, 245, 245), (150, 150, 150), (28, 26, 24)
AXIS_COLORS: tuple[Color, ...] = ((70, 70, 255), (80, 220, 60), (255, 140, 50))

SHIFT = 4  # OpenCV's fractional bits: lines are drawn to a sixteenth of a pixel


def draw_matches(tile: Image, pair: Matches, scale: float, text_scale: float, trail: Color, dot: Color) -> None:
    """Draw trails from the previous frame, blended so that the image below stays visible."""
    before, now = ((np.asarray(p, dtype=float).reshape(-1, 2) + 0.5) * scale - 0.5 for p in pair)
    if not len(now):
        return
    layer = tile.copy()
    trails = [np.round(np.stack([b, a]) * 2**SHIFT).astype(np.int32) for b, a in zip(before, now, strict=True)]
    cv2.polylines(layer, trails, False, trail, 1, cv2.LINE_AA, SHIFT)
    radius = round(max(1.8, 2.6 * text_scale) * 2**SHIFT)
    for point in np.round(now * 2**SHIFT).astype(int):
        cv2.circle(layer, (int(point[0]), int(point[1])), radius, dot, -1, cv2.LINE_AA, SHIFT)
    cv2.addWeighted(layer, 0.75, tile, 0.25, 0, dst=tile)


def draw_dots(tile: Image, pixels: FloatArray, scale: float, text_scale: float, color: Color) -> None:
    """Draw small semi-transparent dots at pixels (n, 2)."""
    layer, radius = tile.copy(), round(max(1.4, 1.7 * text_scale) * 2**SHIFT)
    for x, y in _to_fixed_point(pixels, scale):
        cv2.circle(layer, (int(x), int(y)), radius, color, -1, cv2.LINE_AA, SHIFT)
    cv2.addWeighted(layer, 0.8, tile, 0.2, 0, dst=tile)


def draw_crosses(tile: Image, pixels: FloatArray, scale: float, text_scale: float, color: Color) -> None:
    """Draw small crosses at pixels (n, 2)."""
    arm = round(max(2.5, 3.2 * text_scale) * 2**SHIFT)
    lines = [
        [(x - arm, y + s * arm), (x + arm, y - s * arm)] for x, y in _to_fixed_point(pixels, scale) for s in (-1, 1)
    ]
    cv2.polylines(tile, [np.array(line, np.int32) for line in lines], False, color, 1, cv2.LINE_AA, SHIFT)


def _to_fixed_point(pixels: FloatArray, scale: float) -> IntArray:
    """Convert pixels (n, 2) to OpenCV's fixed-point numbers in a tile scaled by `scale`."""
    return np.asarray(np.round(((pixels + 0.5) * scale - 0.5) * 2**SHIFT), np.int64)


def draw_axes(
    tile: Image,
    camera: Camera,
    world_from_object: RigidTransform,
    length: float,
    scale: float,
    text_scale: float,
    faint: bool = False,
) -> None:
    """Draw the object's axes, farthest first.

    The lens model may bend them. With `faint` they are pale and dashed.
    """
    width = max(2, round(text_scale * 2.2))
    origin = world_from_object.translation
    directions = world_from_object.rotation.as_matrix().T
    depths = np.linalg.norm(origin + length * directions - camera.center, axis=1)
    steps = np.linspace(0, 1, 13)[:, None]
    for k in np.argsort(-depths):
        pixels = project_points(camera, origin + steps * length * directions[k])
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
    place = (round(x), round(y))
    if centered:
        # Draws an outline. A thicker pen would widen the letters in OpenCV 5.
        for dx, dy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            offset_place = (place[0] + dx, place[1] + dy)
            cv2.putText(
                picture, text, offset_place, cv2.FONT_HERSHEY_SIMPLEX, size, DARK, stroke_width(size), cv2.LINE_AA
            )
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, color, stroke_width(size), cv2.LINE_AA)
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
