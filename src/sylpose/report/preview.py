"""What is going to be followed, and the world's axes, drawn into the first frame of each camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.atomic_io import replacing
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.report.drawing import AXIS_COLORS, DARK, WHITE, draw_axes, in_colour, polyline, project, write
from sylpose.rig import Camera, Rig

__all__ = ["draw_followed", "draw_world"]

# Height of each camera's picture, pixels.
HEIGHT = 360
# Lengths of axes by the cameras' distance, and lines of the floor to each side of the origin (choice).
AXIS, LINES = 0.15, 4


def draw_followed(
    path: Path, images: Sequence[Image | None], names: Sequence[str], outlines: Sequence[FloatArray | None]
) -> None:
    """The images beside each other, each with an outline.

    Args:
        images: of C cameras, (h, w, 3) BGR or (h, w) grey, or None.
        outlines: (k, 2) pixels, or None.

    Raises:
        OSError: naming the file that cannot be written.
    """
    tiles = [_tile(image) for image in images]
    for (tile, scale), name, outline in zip(tiles, names, outlines, strict=True):
        if outline is not None:
            polyline(tile, (outline + 0.5) * scale - 0.5, AXIS_COLORS[1], 2, closed=True)
        write(tile, name, (8, 22), 0.6, WHITE)
    _save(path, [tile for tile, _ in tiles])


def draw_world(path: Path, images: Sequence[Image | None], rig: Rig) -> None:
    """The images beside each other, each with the world's axes and lines of its floor, z = 0, an axis's length apart.

    Args:
        images: of the rig's cameras, (h, w, 3) BGR or (h, w) grey, or None.

    Raises:
        OSError: naming the file that cannot be written.
    """
    away = float(np.median([np.linalg.norm(camera.center) for camera in rig]))
    length = _round_number(AXIS * away)
    tiles = [_tile(image, camera) for image, camera in zip(images, rig, strict=True)]
    ends = length * LINES
    steps = np.linspace(-ends, ends, 12 * LINES + 1)
    for (tile, scale), camera in zip(tiles, rig, strict=True):
        layer = tile.copy()
        for at in np.linspace(-ends, ends, 2 * LINES + 1):
            for along in ([steps, np.full_like(steps, at)], [np.full_like(steps, at), steps]):
                line = project(camera, np.column_stack([*along, np.zeros_like(steps)]))
                for part in np.split(line, np.flatnonzero(np.isnan(line[:, 0]))):
                    polyline(layer, (part[np.isfinite(part[:, 0])] + 0.5) * scale - 0.5, WHITE, 1)
        cv2.addWeighted(layer, 0.5, tile, 0.5, 0, dst=tile)
        draw_axes(tile, camera, RigidTransform.identity(), length, scale, 0.8)
        write(tile, f"{camera.name}   axes {length:g} {rig.unit}".rstrip(), (8, 22), 0.6, WHITE)
    _save(path, [tile for tile, _ in tiles])


def _round_number(value: float) -> float:
    """The nearest 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-12)))
    return float(min((1, 2, 5, 10), key=lambda n: abs(n * power - value)) * power)


def _tile(image: Image | None, camera: Camera | None = None) -> tuple[Image, float]:
    """A picture to draw into, and how many times the image's size it has; a dark one without an image."""
    if image is None and camera is not None:
        image = np.full((camera.size[1], camera.size[0], 3), DARK, np.uint8)
    if image is None:
        return np.full((HEIGHT, HEIGHT, 3), DARK, np.uint8), 1.0
    scale = HEIGHT / image.shape[0]
    return np.asarray(cv2.resize(in_colour(image), (max(1, round(scale * image.shape[1])), HEIGHT)), np.uint8), scale


def _save(path: Path, tiles: Sequence[Image]) -> None:
    done, data = cv2.imencode(".png", np.hstack(list(tiles)))
    if not done:
        raise OSError(f"{path}: the picture cannot be written")
    with replacing(path) as part:
        part.write_bytes(data.tobytes())
