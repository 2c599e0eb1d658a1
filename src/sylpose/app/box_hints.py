"""What boxes in some cameras tell of where the object is in the others: bands of epipolar curves, and boxes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sylpose.frames import Box
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.report.drawing import project
from sylpose.rig import Camera, Rig
from sylpose.tracking.region import volume_from_boxes

__all__ = ["Band", "Hints", "epipolar_band", "epipolar_curve", "hints"]

# A curve is looked at in so many places first, and drawn by so many in and around the image (choice: a step in the image of
# a wide lens is a few pixels, in which no lens bends a line by a tenth of one).
LOOKED_AT, DRAWN = 361, 128
# How far around the image that is, in images (choice: what ends there is joined by straight lines, that miss it).
MARGIN = 2.0
# Points on each side of a box whose curves may bound its band (choice).
ON_A_SIDE = 9
# A band that spans more than this about the line through both cameras has one of them inside its box (derived: one that has
# not spans less than half a turn; less by what its rim is sampled and lenses bend).
WIDEST = 0.9 * np.pi
# Cameras nearer to each other than this share of how far they are from the world's origin are in one place (rounding).
ONE_PLACE = 1e-9
# Of a suggested box that is cut off by the image's rim so much is inside at least (choice: less would be a guess).
LEAST_INSIDE = 0.25


@dataclass(frozen=True, eq=False)
class Band:
    """Where in one camera's image something is that is inside a box of another camera, at whatever distance.

    Attributes:
        outline: (k, 2) pixels, a polygon that goes beyond the image's rim; empty where the other camera itself is inside the
            box: then that can be anywhere.
        middle: (m, 2) pixels, the curve of the box's middle, from near to far; empty where the image does not show it.
    """

    outline: FloatArray
    middle: FloatArray


@dataclass(frozen=True, eq=False)
class Hints:
    """What the boxes of one object tell, by camera.

    Attributes:
        bands: of each camera, by the camera whose box tells it.
        boxes: of cameras without a box that see where the others meet: a box around that.
        wrong: a sentence where they meet nowhere; else "".
    """

    bands: dict[str, dict[str, Band]] = field(default_factory=dict)
    boxes: dict[str, Box] = field(default_factory=dict)
    wrong: str = ""


def hints(rig: Rig, boxes: Mapping[str, Box]) -> Hints:
    """What the boxes of one object, by camera, tell of it in the other cameras."""
    bands = {
        camera.name: {name: epipolar_band(rig[name], box, camera) for name, box in boxes.items() if name != camera.name}
        for camera in rig
    }
    if len(boxes) < 2:
        return Hints(bands)
    try:
        center, points = volume_from_boxes(rig, boxes)
    except ValueError as error:
        return Hints(bands, wrong=str(error))
    # Boxes from one side leave open how deep the object is: hardly deeper than it is wide and high (choice).
    reach = max(_half_diagonal(rig[name], box, center) for name, box in boxes.items())
    points = points[np.linalg.norm(points - center, axis=1) <= reach]
    around = {camera.name: _box_around(camera, points) for camera in rig if camera.name not in boxes}
    return Hints(bands, {name: box for name, box in around.items() if box is not None})


def epipolar_curve(seen_by: Camera, pixel: FloatArray, camera: Camera) -> FloatArray:
    """Where a camera sees what another one sees at a pixel, at whatever distance.

    Args:
        seen_by: the other camera.
        pixel: (2,) of its image as recorded.
        camera: whose image the curve is in.

    Returns:
        (n, 2) pixels of the image as recorded, from near to far: a curve in the image and around it; empty where it does
        not come near the image, and of cameras in one place.
    """
    ray = seen_by.rays(pixel[None])[0]
    towards = _baseline(seen_by, camera)
    return np.empty((0, 2)) if towards is None else _curve(camera, towards, ray)


def epipolar_band(seen_by: Camera, box: Box, camera: Camera) -> Band:
    """Where a camera sees what is inside a box of another one, at whatever distance."""
    nothing = np.empty((0, 2))
    towards = _baseline(seen_by, camera)
    if towards is None:
        return Band(nothing, nothing)
    rim = seen_by.rays(_rim(box))
    middle = seen_by.rays([[box.x + (box.width - 1) / 2, box.y + (box.height - 1) / 2]])[0]
    curve = _curve(camera, towards, middle)
    # Each ray is in a plane through both cameras: those that are turned the most about their connection bound the band.
    sideways = np.cross(towards, middle)
    turned = np.arctan2(rim @ sideways, rim @ np.cross(sideways, towards))
    if np.ptp(turned) > WIDEST:
        return Band(nothing, curve)
    # The outermost that come near the image.
    order = np.argsort(turned).tolist()
    curves: dict[int, FloatArray] = {}
    for ks in (order, order[::-1]):
        for k in ks:
            curves[k] = curves.get(k, _curve(camera, towards, rim[k]))
            if len(curves[k]):
                break
    shown = [k for k in order if len(curves.get(k, nothing))]
    if len(shown) < 2:
        return Band(nothing, curve)
    first, last = shown[0], shown[-1]
    # Where they end at infinity the box's rim ends it too: that side of it which is farther from the other camera.
    sides = [[(first + step * k) % len(rim) for k in range((step * (last - first)) % len(rim) + 1)] for step in (1, -1)]
    far = min(sides, key=lambda side: float((rim[side] @ towards).mean()))
    between = project(camera, camera.center + rim[far])
    return Band(np.concatenate([curves[first], between[_around(camera, between)], curves[last][::-1]]), curve)


def _rim(box: Box) -> FloatArray:
    """(4 `ON_A_SIDE`, 2) pixels around a box, in order, on the outer edges of its pixels."""
    share = np.arange(ON_A_SIDE)[:, None] / ON_A_SIDE
    low = np.array([box.x, box.y]) - 0.5
    right, down = np.array([box.width, 0.0]), np.array([0.0, box.height])
    corners = [low, low + right, low + right + down, low + down]
    return np.concatenate([a + share * (b - a) for a, b in zip(corners, [*corners[1:], low], strict=True)])


def _baseline(seen_by: Camera, camera: Camera) -> FloatArray | None:
    """(3,) unit vector from a camera to the other one; None where they are in one place."""
    towards = seen_by.center - camera.center
    length = float(np.linalg.norm(towards))
    if length <= ONE_PLACE * max(np.linalg.norm(seen_by.center), np.linalg.norm(camera.center)):
        return None
    return np.asarray(towards / length)


def _curve(camera: Camera, towards: FloatArray, ray: FloatArray) -> FloatArray:
    """The image of a ray (3,) that begins at the camera in the direction `towards`.

    Seen from this camera it is an arc, from that camera's place to the ray's own direction at infinity: which way a point
    of it is, is known without any distance.
    """
    across = ray - (ray @ towards) * towards
    length = float(np.linalg.norm(across))
    if length < ONE_PLACE:
        return np.empty((0, 2))
    across = across / length

    def seen(angles: FloatArray) -> FloatArray:
        directions = np.cos(angles)[:, None] * towards + np.sin(angles)[:, None] * across
        return project(camera, camera.center + directions)

    end = float(np.arctan2(length, ray @ towards))
    angles = np.linspace(0.0, end, LOOKED_AT)
    runs = np.flatnonzero(np.diff(np.concatenate([[False], _around(camera, seen(angles)), [False]]).astype(int)))
    if not len(runs):
        return np.empty((0, 2))
    begin, stop = max(runs.reshape(-1, 2).tolist(), key=lambda run: run[1] - run[0])
    pixels = seen(np.linspace(angles[max(begin - 1, 0)], angles[min(stop, LOOKED_AT - 1)], DRAWN))
    return pixels[_around(camera, pixels)]


def _half_diagonal(camera: Camera, box: Box, point: FloatArray) -> float:
    """Of what fills a box and is as far away as a point."""
    depth = float(camera.rotation[2] @ (point - camera.center))
    return 0.5 * float(np.hypot(box.width, box.height)) / camera.focal * depth


def _around(camera: Camera, pixels: FloatArray) -> BoolArray:
    """(n,) which pixels are in the image or near it."""
    size = np.array(camera.size)
    return np.asarray(((pixels > -MARGIN * size) & (pixels < (1 + MARGIN) * size)).all(axis=1))


def _box_around(camera: Camera, points: FloatArray) -> Box | None:
    """The box of world points (n, 3) in whole pixels, as far as it is in the image; None where little of it is."""
    pixels = project(camera, points)
    if not len(pixels) or not np.isfinite(pixels).all():
        return None
    low, high = np.floor(pixels.min(axis=0) + 0.5), np.ceil(pixels.max(axis=0) + 0.5)
    left_top, right_bottom = np.maximum(low, 0.0), np.minimum(high, np.array(camera.size))
    inside = right_bottom - left_top
    if (inside < 2).any() or inside.prod() < LEAST_INSIDE * (high - low).prod():
        return None
    return Box(*left_top.tolist(), *inside.tolist())
