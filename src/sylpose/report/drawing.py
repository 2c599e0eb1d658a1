"""Lines, points and letters drawn into images, to a fraction of a pixel."""

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
    "GREY",
    "WHITE",
    "draw_axes",
    "draw_crosses",
    "draw_dots",
    "draw_matches",
    "in_colour",
    "pen",
    "polyline",
    "project",
    "write",
]

Color = tuple[int, int, int]
Matches = tuple[FloatArray, FloatArray]

# BGR, as OpenCV draws.
WHITE, GREY, DARK = (245, 245, 245), (150, 150, 150), (28, 26, 24)
AXIS_COLORS: tuple[Color, ...] = ((70, 70, 255), (80, 220, 60), (255, 140, 50))

SHIFT = 4  # OpenCV's fractional bits: lines are drawn to a sixteenth of a pixel


def draw_matches(tile: Image, pair: Matches, scale: float, text: float, trail: Color, dot: Color) -> None:
    """Trails from the frame before, blended so that what is under many of them is still seen."""
    before, now = ((np.asarray(p, dtype=float).reshape(-1, 2) + 0.5) * scale - 0.5 for p in pair)
    if not len(now):
        return
    layer = tile.copy()
    trails = [np.round(np.stack([b, a]) * 2**SHIFT).astype(np.int32) for b, a in zip(before, now, strict=True)]
    cv2.polylines(layer, trails, False, trail, 1, cv2.LINE_AA, SHIFT)
    radius = round(max(1.8, 2.6 * text) * 2**SHIFT)
    for point in np.round(now * 2**SHIFT).astype(int):
        cv2.circle(layer, (int(point[0]), int(point[1])), radius, dot, -1, cv2.LINE_AA, SHIFT)
    cv2.addWeighted(layer, 0.75, tile, 0.25, 0, dst=tile)


def draw_dots(tile: Image, pixels: FloatArray, scale: float, text: float, color: Color) -> None:
    """Small dots at pixels (n, 2), half transparent."""
    layer, radius = tile.copy(), round(max(1.4, 1.7 * text) * 2**SHIFT)
    for x, y in _fixed(pixels, scale):
        cv2.circle(layer, (int(x), int(y)), radius, color, -1, cv2.LINE_AA, SHIFT)
    cv2.addWeighted(layer, 0.8, tile, 0.2, 0, dst=tile)


def draw_crosses(tile: Image, pixels: FloatArray, scale: float, text: float, color: Color) -> None:
    """Small crosses at pixels (n, 2)."""
    arm = round(max(2.5, 3.2 * text) * 2**SHIFT)
    lines = [[(x - arm, y + s * arm), (x + arm, y - s * arm)] for x, y in _fixed(pixels, scale) for s in (-1, 1)]
    cv2.polylines(tile, [np.array(line, np.int32) for line in lines], False, color, 1, cv2.LINE_AA, SHIFT)


def _fixed(pixels: FloatArray, scale: float) -> IntArray:
    """Pixels (n, 2) of the image as OpenCV's fixed-point numbers of a tile that is `scale` times as large."""
    return np.asarray(np.round(((pixels + 0.5) * scale - 0.5) * 2**SHIFT), np.int64)


def draw_axes(
    tile: Image,
    camera: Camera,
    world_from_object: RigidTransform,
    length: float,
    scale: float,
    text: float,
    faint: bool = False,
) -> None:
    """The object's axes, the farthest first; through the lens, so they may be curved. `faint`: pale and dashed."""
    width = max(2, round(text * 2.2))
    origin = world_from_object.translation
    directions = world_from_object.rotation.as_matrix().T
    depths = np.linalg.norm(origin + length * directions - camera.center, axis=1)
    steps = np.linspace(0, 1, 13)[:, None]
    for k in np.argsort(-depths):
        pixels = project(camera, origin + steps * length * directions[k])
        # A line that leaves the lens's field of view ends there.
        hidden = np.flatnonzero(np.isnan(pixels[:, 0]))
        line = (pixels[: hidden[0] if hidden.size else None] + 0.5) * scale - 0.5
        if len(line) < 2:
            continue
        color = AXIS_COLORS[k]
        if faint:
            color = _pale(color)
            for dash in zip(line[::2], line[1::2], strict=False):
                polyline(tile, np.array(dash), color, width)
        else:
            polyline(tile, line, DARK, width + 2)
            polyline(tile, line, color, width)
        outward = line[-1] - line[0]
        reach = np.linalg.norm(outward)
        tip = line[-1] + outward / max(float(reach), 1e-9) * 14 * text
        if len(line) == len(steps):
            write(tile, "xyz"[k], tip, 0.8 * text, color, centered=True)


def project(camera: Camera, points: FloatArray) -> FloatArray:
    """World points (n, 3) -> pixels (n, 2); NaN behind the camera, and where the lens model does not hold.

    Far outside of the image a polynomial lens model folds back into it; such a pixel's ray is not the point's.
    """
    pixels = camera.project(points)
    seen = np.asarray(np.isfinite(pixels).all(axis=1))
    toward = points[seen] - camera.center
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    seen[seen] = (camera.rays(pixels[seen]) * toward).sum(axis=1) > np.cos(1e-2)
    pixels[~seen] = np.nan
    return pixels


def _pale(color: Color) -> Color:
    """Halfway to grey."""
    return ((color[0] + 150) // 2, (color[1] + 150) // 2, (color[2] + 150) // 2)


def pen(size: float) -> int:
    """Width of letters of that size, pixels."""
    return max(1, round(1.3 * size))


def write(
    picture: Image, words: str, at: Sequence[float] | FloatArray, size: float, color: Color, centered: bool = False
) -> int:
    """Draws from the base line's left end, or centred; returns the width in pixels."""
    (width, height), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, size, pen(size))
    if not np.isfinite(at).all() or max(abs(at[0]), abs(at[1])) > 1e5:
        return int(width)
    x, y = (at[0] - width / 2, at[1] + height / 2) if centered else (at[0], at[1])
    place = (round(x), round(y))
    if centered:
        # An outline. Not a thicker pen: in OpenCV 5 that makes the letters wider.
        for dx, dy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            beside = (place[0] + dx, place[1] + dy)
            cv2.putText(picture, words, beside, cv2.FONT_HERSHEY_SIMPLEX, size, DARK, pen(size), cv2.LINE_AA)
    cv2.putText(picture, words, place, cv2.FONT_HERSHEY_SIMPLEX, size, color, pen(size), cv2.LINE_AA)
    return int(width)


def in_colour(image: Image) -> Image:
    """An image (h, w, 3) BGR or (h, w) grey as one with colours."""
    return image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)


def polyline(picture: Image, line: FloatArray, color: Color, width: int, closed: bool = False) -> None:
    """A line through points (n, 2), pixels; those far outside are left out."""
    # Beyond this OpenCV's fixed-point numbers overflow; a point so far outside says nothing to the eye.
    inside = line[np.isfinite(line).all(axis=1) & (np.abs(line) < 1e5).all(axis=1)]
    if len(inside) > 1:
        points = np.round(inside * 2**SHIFT).astype(np.int32)
        cv2.polylines(picture, [points], closed, color, width, cv2.LINE_AA, SHIFT)
