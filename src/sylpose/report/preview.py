"""Preview pictures: the object's regions and the world's axes in the first frame of each camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.atomic_io import replace_atomically
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.report.drawing import AXIS_COLORS, DARK, WHITE, draw_axes, draw_polyline, draw_text, project_points, to_bgr
from sylpose.rig import Camera, Rig

__all__ = ["draw_regions", "draw_world_axes"]

# Height of each camera's picture, pixels.
TILE_HEIGHT = 360
# Axis length relative to the cameras' distance, and floor lines to each side of the origin (choice).
AXIS_RATIO, FLOOR_LINES = 0.15, 4


def draw_regions(
    path: Path, images: Sequence[Image | None], names: Sequence[str], outlines: Sequence[FloatArray | None]
) -> None:
    """Draw the images side by side, each with its region's outline.

    Args:
        path: path of the picture.
        images: images of C cameras, (h, w, 3) BGR or (h, w) gray, or None.
        names: names of the cameras.
        outlines: (k, 2) pixels, or None.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    tiles = [_make_tile(image) for image in images]
    for (tile, scale), name, outline in zip(tiles, names, outlines, strict=True):
        if outline is not None:
            draw_polyline(tile, (outline + 0.5) * scale - 0.5, AXIS_COLORS[1], 2, closed=True)
        draw_text(tile, name, (8, 22), 0.6, WHITE)
    _save(path, [tile for tile, _ in tiles])


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
        draw_axes(tile, camera, RigidTransform.identity(), length, scale, 0.8)
        draw_text(tile, f"{camera.name}   axes {length:g} {rig.unit}".rstrip(), (8, 22), 0.6, WHITE)
    _save(path, [tile for tile, _ in tiles])


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


def _save(path: Path, tiles: Sequence[Image]) -> None:
    is_encoded, data = cv2.imencode(".png", np.hstack(list(tiles)))
    if not is_encoded:
        raise OSError(f"{path}: the picture cannot be written")
    with replace_atomically(path) as part:
        part.write_bytes(data.tobytes())
