"""Marker corners as intersections of fitted edges.

They are more accurate than separately detected corners, which blur pulls inwards.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from sylpose.geometry.arrays import FloatArray, Image
from sylpose.rig import Camera

# Second map of cv2.remap: None, since the first map has both coordinates.
NO_SECOND_MAP: Any = None

# Sampling of an edge. Along it: the share of its length, and the maximum number of intensity profiles and their density
# per pixel. Across it: the reach in bit widths, its bounds in pixels, and the step (choice: adjacent bits must stay
# outside).
EDGE_SHARE, MAX_PROFILES, PROFILES_PER_PX = 0.76, 60, 0.7
REACH_BITS, MIN_REACH, MAX_REACH, SAMPLE_STEP = 0.7, 1.5, 8.0, 0.25
# Slopes below this share of a profile's steepest are ignored (choice); profiles with less than this share of the median
# contrast, or whose distance from the edge exceeds this multiple of the median, are rejected (choice).
MIN_SLOPE_RATIO, MIN_CONTRAST_RATIO, OUTLIER_RATIO = 0.25, 0.5, 3.0
# Number of passes that recenter the windows on the edges (choice: out of focus they are as wide as the windows).
N_PASSES = 2
# Minimum number of profiles per edge, and maximum movement of a corner, pixels (choice).
MIN_PROFILES, MAX_MOVE_PX = 4, 2.5


def refine_marker_corners(gray: Image, camera: Camera, corners: FloatArray, bits: int) -> FloatArray:
    """Refine the corners of a dark marker on light ground.

    Args:
        gray: (h, w).
        camera: that took the image.
        corners: (4, 2) in the image as recorded, in order around the marker, accurate to a pixel or two.
        bits: along a side of the marker, border included.

    Returns:
        (4, 2) intersections of edges that are straight after undistortion; the given corners if edges are not found.
    """
    refined = corners
    for _ in range(N_PASSES):
        refined = _refine_once(gray, camera, refined, bits)
    return refined if np.linalg.norm(refined - corners, axis=1).max() <= MAX_MOVE_PX else corners


def _refine_once(gray: Image, camera: Camera, corners: FloatArray, bits: int) -> FloatArray:
    lines = [_fit_edge(gray, camera, corners[k], corners[(k + 1) % 4], corners.mean(axis=0), bits) for k in range(4)]
    found_lines = [line for line in lines if line is not None]
    if len(found_lines) < 4:
        return corners
    intersections = np.cross(np.roll(found_lines, 1, axis=0), found_lines)
    return (
        camera.denormalize(intersections[:, :2] / intersections[:, 2:])
        if (np.abs(intersections[:, 2]) > 1e-12).all()
        else corners
    )


def _fit_edge(
    gray: Image, camera: Camera, start: FloatArray, end: FloatArray, inside: FloatArray, bits: int
) -> FloatArray | None:
    """Fit the line (3,) along an edge in normalized coordinates; None if there is none."""
    edge = end - start
    length = float(np.linalg.norm(edge))
    n_profiles = int(np.clip(PROFILES_PER_PX * length, MIN_PROFILES, MAX_PROFILES))
    fractions = 0.5 + EDGE_SHARE * (np.arange(n_profiles) / (n_profiles - 1) - 0.5)
    outward = np.array([edge[1], -edge[0]]) / max(length, 1e-12)
    if outward @ (start - inside) < 0:
        outward = -outward
    reach = float(np.clip(REACH_BITS * length / bits, MIN_REACH, MAX_REACH))
    steps = np.arange(-reach, reach + SAMPLE_STEP / 2, SAMPLE_STEP)
    places = (start + fractions[:, None] * edge)[:, None] + steps[:, None] * outward
    profiles = cv2.remap(gray, places.astype(np.float32), NO_SECOND_MAP, cv2.INTER_LINEAR).astype(float)
    slopes = np.maximum(np.diff(profiles, axis=1), 0.0)
    steepest = slopes.max(axis=1, keepdims=True)
    slopes[slopes < MIN_SLOPE_RATIO * steepest] = 0.0
    contrast = np.ptp(profiles, axis=1)
    is_sharp = (steepest[:, 0] > 0) & (contrast > MIN_CONTRAST_RATIO * np.median(contrast))
    if is_sharp.sum() < MIN_PROFILES:
        return None
    slopes = slopes[is_sharp]
    offset = slopes @ (steps[:-1] + SAMPLE_STEP / 2) / slopes.sum(axis=1)
    points = camera.normalize((start + fractions[is_sharp][:, None] * edge) + offset[:, None] * outward)
    for _ in range(2):
        mean = points.mean(axis=0)
        normal = np.linalg.svd(points - mean)[2][1]
        distances = np.abs((points - mean) @ normal)
        is_inlier = distances <= OUTLIER_RATIO * max(float(np.median(distances)), 1e-12) * 1.5
        if is_inlier.sum() < MIN_PROFILES:
            return None
        points = points[is_inlier]
    mean = points.mean(axis=0)
    normal = np.linalg.svd(points - mean)[2][1]
    return np.array([*normal, -normal @ mean])
