"""Hints for drawing boxes: epipolar bands and suggested boxes in cameras without a box."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from sylpose.frames import Box
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.report.drawing import project_points
from sylpose.rig import Camera, Rig
from sylpose.tracking.joint_side.object_model import carve_box_volume

# Samples of a curve to find its visible part, and samples of that part (choice: a step in the image of a wide lens is a
# few pixels, over which no lens bends a line by a tenth of one).
N_SEARCH_SAMPLES, N_CURVE_SAMPLES = 361, 128
# Curves are kept up to this many image sizes outside the image (choice: lines that join their ends miss the image).
MARGIN = 2.0
# Points on each side of a box whose epipolar curves may bound the band (choice).
POINTS_PER_SIDE = 9
# A band that spans a larger angle about the baseline has its camera inside the other one's box (derived: otherwise it
# spans less than 180 degrees, reduced by the sampling of its outline and the bending by lenses).
MAX_BAND_ANGLE = 0.9 * np.pi
# Cameras whose baseline is below this share of their distance from the world's origin are coincident (rounding).
MIN_BASELINE_RATIO = 1e-9
# Smallest share of a suggested box that must be inside the image (choice: less would be a guess).
MIN_VISIBLE_RATIO = 0.25


@dataclass(frozen=True, eq=False)
class EpipolarBand:
    """Epipolar band: region of one camera's image that may show the content of another camera's box.

    Attributes:
        outline: (k, 2) pixels, a polygon that extends beyond the image border; empty if this camera itself is inside
            the box, so that its content can be anywhere.
        center_curve: (m, 2) pixels, the epipolar curve of the box center from near to far; empty if not visible in the
            image.
    """

    outline: FloatArray
    center_curve: FloatArray


@dataclass(frozen=True, eq=False)
class BoxHints:
    """Hints derived from the boxes of one object.

    Attributes:
        bands: bands by camera name, then by the name of the camera whose box defines them.
        boxes: suggested boxes by name of each camera without a box that sees the intersection of the others.
        error: error message if the boxes do not intersect in space; else "".
    """

    bands: dict[str, dict[str, EpipolarBand]] = field(default_factory=dict)
    boxes: dict[str, Box] = field(default_factory=dict)
    error: str = ""


def compute_box_hints(rig: Rig, boxes: Mapping[str, Box]) -> BoxHints:
    """Compute epipolar bands and suggested boxes in the other cameras from one object's boxes.

    Args:
        rig: the cameras.
        boxes: boxes of one object by camera name.
    """
    bands: dict[str, dict[str, EpipolarBand]] = {camera.name: {} for camera in rig}
    for camera, (name, box) in product(rig, boxes.items()):
        if name != camera.name:
            bands[camera.name][name] = compute_epipolar_band(rig[name], box, camera)
    if len(boxes) < 2:
        return BoxHints(bands)
    try:
        center, points = carve_box_volume(rig, boxes)
    except ValueError as error:
        return BoxHints(bands, error=str(error))
    # Boxes from one side leave the object's depth open: limit it to the object's width and height (choice).
    max_radius = max(_half_diagonal(rig[name], box, center) for name, box in boxes.items())
    points = points[np.linalg.norm(points - center, axis=1) <= max_radius]
    suggested = {camera.name: _compute_bounding_box(camera, points) for camera in rig if camera.name not in boxes}
    return BoxHints(bands, {name: box for name, box in suggested.items() if box is not None})


def compute_epipolar_band(other: Camera, box: Box, camera: Camera) -> EpipolarBand:
    """Compute the region of a camera's image that may show the content of another camera's box.

    Args:
        other: the camera with the box.
        box: the box in its recorded image, pixels.
        camera: camera in whose image the band is computed.
    """
    empty, baseline = np.empty((0, 2)), other.center - camera.center
    length = float(np.linalg.norm(baseline))
    if length <= MIN_BASELINE_RATIO * max(np.linalg.norm(other.center), np.linalg.norm(camera.center)):
        return EpipolarBand(empty, empty)
    baseline = baseline / length
    outline_rays = other.rays(_sample_outline(box))
    center_ray = other.rays([[box.x + (box.width - 1) / 2, box.y + (box.height - 1) / 2]])[0]
    curve = _project_ray(camera, baseline, center_ray)
    # Each ray lies in an epipolar plane: the rays with the extreme plane angles about the baseline bound the band.
    sideways = np.cross(baseline, center_ray)
    plane_angles = np.arctan2(outline_rays @ sideways, outline_rays @ np.cross(sideways, baseline))
    if np.ptp(plane_angles) > MAX_BAND_ANGLE:
        return EpipolarBand(empty, curve)
    # Find the outermost curves that pass near the image.
    order = np.argsort(plane_angles).tolist()
    curves: dict[int, FloatArray] = {}
    for ks in (order, order[::-1]):
        for k in ks:
            curves[k] = curves.get(k, _project_ray(camera, baseline, outline_rays[k]))
            if len(curves[k]):
                break
    visible = [k for k in order if len(curves.get(k, empty))]
    if len(visible) < 2:
        return EpipolarBand(empty, curve)
    first, last = visible[0], visible[-1]
    # At infinity the band ends at the box's outline: at its side farther from the epipole.
    n = len(outline_rays)
    sides = [[(first + step * k) % n for k in range((step * (last - first)) % n + 1)] for step in (1, -1)]
    far = min(sides, key=lambda side: float((outline_rays[side] @ baseline).mean()))
    far_edge = project_points(camera, camera.center + outline_rays[far])
    far_edge = far_edge[_is_near_image(camera, far_edge)]
    return EpipolarBand(np.concatenate([curves[first], far_edge, curves[last][::-1]]), curve)


def _sample_outline(box: Box) -> FloatArray:
    """Sample (4 `POINTS_PER_SIDE`, 2) pixels around a box in order, on the outer edges of its pixels."""
    share = np.arange(POINTS_PER_SIDE)[:, None] / POINTS_PER_SIDE
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [box.width, box.height] + [box.x - 0.5, box.y - 0.5]
    return np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])


def _project_ray(camera: Camera, baseline: FloatArray, ray: FloatArray) -> FloatArray:
    """Project a ray (3,) of the other camera, which is in direction `baseline`, into this camera's image.

    Seen from this camera the ray is an arc of directions, from the other camera's direction to the ray's own direction
    at infinity. No depths are needed to compute it.
    """
    perpendicular = ray - (ray @ baseline) * baseline
    length = float(np.linalg.norm(perpendicular))
    if length < MIN_BASELINE_RATIO:
        return np.empty((0, 2))
    perpendicular = perpendicular / length

    def project_angles(angles: FloatArray) -> FloatArray:
        directions = np.cos(angles)[:, None] * baseline + np.sin(angles)[:, None] * perpendicular
        return project_points(camera, camera.center + directions)

    end = float(np.arctan2(length, ray @ baseline))
    angles = np.linspace(0.0, end, N_SEARCH_SAMPLES)
    is_near = np.concatenate([[False], _is_near_image(camera, project_angles(angles)), [False]])
    runs = np.flatnonzero(np.diff(is_near.astype(int)))
    if not len(runs):
        return np.empty((0, 2))
    begin, stop = max(runs.reshape(-1, 2).tolist(), key=lambda run: run[1] - run[0])
    low, high = angles[max(begin - 1, 0)], angles[min(stop, N_SEARCH_SAMPLES - 1)]
    pixels = project_angles(np.linspace(low, high, N_CURVE_SAMPLES))
    return pixels[_is_near_image(camera, pixels)]


def _half_diagonal(camera: Camera, box: Box, point: FloatArray) -> float:
    """Return half the diagonal, in length units, of an object that fills a box at the depth of a point."""
    depth = float(camera.rotation[2] @ (point - camera.center))
    return 0.5 * float(np.hypot(box.width, box.height)) / camera.focal * depth


def _is_near_image(camera: Camera, pixels: FloatArray) -> BoolArray:
    """Return (n,) which pixels are in the image or near it."""
    size = np.array(camera.size)
    return np.asarray(((pixels > -MARGIN * size) & (pixels < (1 + MARGIN) * size)).all(axis=1))


def _compute_bounding_box(camera: Camera, points: FloatArray) -> Box | None:
    """Return the box of world points (n, 3) in whole pixels, clipped to the image; None if too little is inside."""
    pixels = project_points(camera, points)
    if not len(pixels) or not np.isfinite(pixels).all():
        return None
    low, high = np.floor(pixels.min(axis=0) + 0.5), np.ceil(pixels.max(axis=0) + 0.5)
    left_top, right_bottom = np.maximum(low, 0.0), np.minimum(high, np.array(camera.size))
    inside = right_bottom - left_top
    if (inside < 2).any() or inside.prod() < MIN_VISIBLE_RATIO * (high - low).prod():
        return None
    return Box(*left_top.tolist(), *inside.tolist())
