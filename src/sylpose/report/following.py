"""What is going to be followed, drawn into the first frame of each camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from sylpose.files import replacing
from sylpose.numerics.arrays import FloatArray, Image
from sylpose.report.drawing import AXIS_COLORS, DARK, WHITE, in_colour, polyline, write

__all__ = ["draw_followed"]

# Height of each camera's picture, pixels.
HEIGHT = 360


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
    tiles: list[Image] = []
    for image, name, outline in zip(images, names, outlines, strict=True):
        if image is None:
            tiles.append(np.full((HEIGHT, HEIGHT, 3), DARK, np.uint8))
        else:
            scale = HEIGHT / image.shape[0]
            tiles.append(
                np.asarray(cv2.resize(in_colour(image), (max(1, round(scale * image.shape[1])), HEIGHT)), np.uint8)
            )
            if outline is not None:
                polyline(tiles[-1], (outline + 0.5) * scale - 0.5, AXIS_COLORS[1], 2, closed=True)
        write(tiles[-1], name, (8, 22), 0.6, WHITE)
    done, data = cv2.imencode(".png", np.hstack(tiles))
    if not done:
        raise OSError(f"{path}: the picture cannot be written")
    with replacing(path) as part:
        part.write_bytes(data.tobytes())
