"""Visual hull: the largest body that all silhouettes allow, from cameras and frames with known poses.

A. Laurentini, "The visual hull concept for silhouette-based image understanding", 1994. The hull's signed distance at a
point is the least of its signed distances to the outlines in all images; its zero is the surface. A few silhouettes are
wrong: points that nearly all images show deep inside the outline are inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import label, zoom

from sylpose.geometry.arrays import BoolArray, FloatArray, FloatImage
from sylpose.rig import Camera
from sylpose.silhouettes.background import Silhouette

# Second map argument of `cv2.remap` if the first contains both coordinates.
NO_SECOND_MAP: Any = None

# Subdivision of pixels for distances to the outline (derived: an eighth of a pixel, a tenth of the target).
SUBPIXELS = 4
# Points whose distances in all images are held at once (choice: tens of megabytes), and rows of OpenCV's maps (derived:
# they have less than 2^15).
CHUNK, MAX_MAP_ROWS = 50_000, 30_000
# A point has to be in this share of the images (derived: no other half of them would show less of it).
MIN_VISIBLE = 0.5
# Share of the images that may be wrong at a point that the others show inside, of at least so many images, and by how much
# inside, as a share of the region's side (measured: a plain block and an irregular body. With none, dents reach 9 % of
# the size, the 5th percentile; so, 1.1 %; at twice the depth 2.4 %; at half of it surfaces seen by few images grow.)
WRONG_SHARE, MIN_TO_DISCARD, CORE_DEPTH = 0.02, 20, 0.0125
# Grid points along the longest side of a region, coarse (choice: a body of a tenth of the region is found).
COARSE_POINTS = 49


@dataclass(frozen=True, eq=False)
class View:
    """Signed distances to the object's outline in one image.

    Attributes:
        camera: the camera, with the object's frame as its world.
        distance: (h, w) pixels, positive inside; inside is also what is not known.
    """

    camera: Camera
    distance: FloatImage

    def sample(self, points: FloatArray) -> FloatArray:
        """Return signed distances (n,) of points (n, 3) in the object's frame to the outline, at the point's depth.

        NaN for points that are not in the image.
        """
        pixels = self.camera.project(points)
        maps = np.where(np.isfinite(pixels), pixels, -1e4).astype(np.float32)[:, None]
        edge: dict[str, Any] = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": float("nan")}
        distances = [
            cv2.remap(self.distance, part, NO_SECOND_MAP, cv2.INTER_LINEAR, **edge)
            for part in np.array_split(maps, len(maps) // MAX_MAP_ROWS + 1)
        ]
        depth = points @ self.camera.rotation[2] + self.camera.camera_from_world.translation[2]
        return np.asarray(np.concatenate(distances)[:, 0] * depth / self.camera.focal, float)


@dataclass(frozen=True, eq=False)
class HullGrid:
    """Signed distances to the hull on a grid of points.

    Attributes:
        low: (3,) first point.
        spacing: distance of neighbors.
        distance: (i, j, k) signed distances, positive inside; -inf where too few images show the point.
    """

    low: FloatArray
    spacing: float
    distance: FloatImage

    def points(self, selected: BoolArray) -> FloatArray:
        """Return the selected points (n, 3)."""
        return np.asarray(self.low + self.spacing * np.argwhere(selected))

    def near_surface(self, cells: float) -> BoolArray:
        """Return which points are inside, or outside by at most some spacings: the largest connected part."""
        parts, n = label(self.distance > -cells * self.spacing)
        sizes = np.bincount(parts.ravel(), minlength=2)
        return np.asarray(parts == 1 + sizes[1:].argmax()) if n else np.zeros(parts.shape, bool)


def measure_outline_distances(silhouette: Silhouette) -> FloatImage:
    """Return the signed distance (h, w) of each pixel to the outline, positive inside."""
    share = silhouette.share
    height, width = share.shape
    is_inside = (share > 0.5).astype(np.uint8)
    if not is_inside.any():
        return np.full(share.shape, -float(height + width), np.float32)
    # Away from the object, whole pixels are exact enough; where nothing is known, everything is inside.
    out = np.where(is_inside > 0, cv2.distanceTransform(is_inside, cv2.DIST_L2, 5), 0).astype(np.float32)
    out = np.asarray(np.minimum(out, height + width) - cv2.distanceTransform(1 - is_inside, cv2.DIST_L2, 5), np.float32)
    rows, columns = (np.flatnonzero((np.abs(share - 0.5) < 0.5).any(axis=axis)) for axis in (1, 0))
    if len(rows):
        top, bottom = max(rows[0] - 2, 0), min(rows[-1] + 3, height)
        left, right = max(columns[0] - 2, 0), min(columns[-1] + 3, width)
        part = share[top:bottom, left:right]
        fine = cv2.resize(part, None, fx=SUBPIXELS, fy=SUBPIXELS, interpolation=cv2.INTER_LINEAR)
        is_inside = (fine > 0.5).astype(np.uint8)
        inner, outer = (cv2.distanceTransform(mask, cv2.DIST_L2, 5) for mask in (is_inside, 1 - is_inside))
        signed = np.where(is_inside > 0, inner - 0.5, 0.5 - outer)
        limit = np.float32(SUBPIXELS * (height + width))  # OpenCV's distance where there is no other side
        signed = np.clip(signed, -limit, limit).astype(np.float32)
        out[top:bottom, left:right] = cv2.resize(signed, part.shape[::-1], interpolation=cv2.INTER_AREA) / SUBPIXELS
    return np.asarray(out, np.float32)


def measure_hull(views: Sequence[View], points: FloatArray, core_depth: float) -> tuple[FloatArray, FloatArray]:
    """Return the signed distances (n,) of points (n, 3) to the hull, and without its least few distances.

    Args:
        views: the images.
        points: in the object's frame.
        core_depth: points deeper inside than this in nearly all images are inside, by the difference.

    Returns:
        Both distances; -inf for points that too few images show.
    """
    hull, nearly_all = np.full(len(points), -np.inf), np.full(len(points), -np.inf)
    n_wrong = int(np.ceil(WRONG_SHARE * len(views))) if len(views) >= MIN_TO_DISCARD else 0
    for first in range(0, len(points), CHUNK):
        rows = slice(first, first + CHUNK)
        distances = np.stack([view.sample(points[rows]) for view in views], axis=1).astype(np.float32)
        is_shown = np.isfinite(distances).sum(axis=1) >= MIN_VISIBLE * len(views)
        distances[np.isnan(distances)] = np.inf
        distances.partition((0, n_wrong), axis=1)
        nearly_all[rows] = np.where(is_shown, distances[:, n_wrong], -np.inf)
        hull[rows] = np.where(is_shown, np.maximum(distances[:, 0], distances[:, n_wrong] - core_depth), -np.inf)
    return hull, nearly_all


def carve_region(views: Sequence[View], low: FloatArray, high: FloatArray, refinements: int) -> HullGrid:
    """Carve the hull in a box.

    Args:
        views: the images.
        low, high: (3,) corners of the box in the object's frame.
        refinements: how often the spacing is halved, near the surface only.
    """
    spacing = float((high - low).max()) / (COARSE_POINTS - 1)
    core_depth = CORE_DEPTH * float((high - low).max())
    shape = np.ceil((high - low) / spacing - 1e-9).astype(int) + 1
    every = np.ones(shape, bool)
    grid = HullGrid(low, spacing, np.empty(shape, np.float32))
    grid.distance[every] = measure_hull(views, grid.points(every), core_depth)[0]
    for _ in range(refinements):
        # Distances change by at most the way: farther points cannot be at the surface. Their distance is interpolated.
        shape, spacing = 2 * shape - 1, spacing / 2
        coarse = np.nan_to_num(grid.distance, neginf=-1e3 * spacing)
        distance = zoom(coarse, shape / np.array(coarse.shape), order=1, grid_mode=False)
        grid = HullGrid(low, spacing, np.asarray(distance, np.float32))
        is_near = np.abs(grid.distance) < 4 * spacing
        grid.distance[is_near] = measure_hull(views, grid.points(is_near), core_depth)[0]
    return grid
