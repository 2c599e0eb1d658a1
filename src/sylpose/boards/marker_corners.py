"""The corners of a marker where its four edges meet: finer than corners found by themselves, which blur draws inwards."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from sylpose.geometry.arrays import FloatArray, Image
from sylpose.rig import Camera

__all__ = ["corners_of_edges"]

# OpenCV's way of saying that both coordinates are in the first map.
NO_MAP: Any = None

# An edge is looked at within this share of its length, at most so many times and so often by its length in pixels; across it
# so far, by the width of a bit and in pixels, in steps (choice: the bits beside it are not to be looked at).
WITHIN, MOST_LOOKS, LOOKS_PER_PX = 0.76, 60, 0.7
ACROSS_BITS, LEAST_ACROSS, MOST_ACROSS, STEP = 0.7, 1.5, 8.0, 0.25
# Of a profile's slopes those of this share of the steepest are of the edge (choice); looks of less than this share of the
# usual contrast, or so many times further off than usual, are not used (choice).
STEEP, CONTRAST, ASTRAY = 0.25, 0.5, 3.0
# Windows are moved to where edges were found so many times (choice: out of focus they are as wide as the windows).
PASSES = 2
# An edge is not fitted to fewer looks, and no corner moves further, pixels (choice).
FEWEST, MOST_MOVED = 4, 2.5


def corners_of_edges(grey: Image, camera: Camera, corners: FloatArray, bits: int) -> FloatArray:
    """Corners of a dark marker on light ground.

    Args:
        grey: (h, w).
        corners: (4, 2) in the image as recorded, around the marker, known to a pixel or two.
        bits: along a side of the marker, border included.

    Returns:
        (4, 2) likewise, where straight lines through the lens meet; those given where no edges are found.
    """
    refined = corners
    for _ in range(PASSES):
        refined = _pass(grey, camera, refined, bits)
    return refined if np.linalg.norm(refined - corners, axis=1).max() <= MOST_MOVED else corners


def _pass(grey: Image, camera: Camera, corners: FloatArray, bits: int) -> FloatArray:
    lines = [_line(grey, camera, corners[k], corners[(k + 1) % 4], corners.mean(axis=0), bits) for k in range(4)]
    known = [line for line in lines if line is not None]
    if len(known) < 4:
        return corners
    met = np.cross(np.roll(known, 1, axis=0), known)
    return camera.denormalize(met[:, :2] / met[:, 2:]) if (np.abs(met[:, 2]) > 1e-12).all() else corners


def _line(
    grey: Image, camera: Camera, start: FloatArray, end: FloatArray, inside: FloatArray, bits: int
) -> FloatArray | None:
    """(3,) the line along an edge, in normalised coordinates; None where there is none."""
    along = end - start
    length = float(np.linalg.norm(along))
    looks = int(np.clip(LOOKS_PER_PX * length, FEWEST, MOST_LOOKS))
    share = 0.5 + WITHIN * (np.arange(looks) / (looks - 1) - 0.5)
    outward = np.array([along[1], -along[0]]) / max(length, 1e-12)
    if outward @ (start - inside) < 0:
        outward = -outward
    reach = float(np.clip(ACROSS_BITS * length / bits, LEAST_ACROSS, MOST_ACROSS))
    steps = np.arange(-reach, reach + STEP / 2, STEP)
    places = (start + share[:, None] * along)[:, None] + steps[:, None] * outward
    profiles = cv2.remap(grey, places.astype(np.float32), NO_MAP, cv2.INTER_LINEAR).astype(float)
    slopes = np.maximum(np.diff(profiles, axis=1), 0.0)
    steepest = slopes.max(axis=1, keepdims=True)
    slopes[slopes < STEEP * steepest] = 0.0
    contrast = np.ptp(profiles, axis=1)
    good = (steepest[:, 0] > 0) & (contrast > CONTRAST * np.median(contrast))
    if good.sum() < FEWEST:
        return None
    slopes = slopes[good]
    offset = slopes @ (steps[:-1] + STEP / 2) / slopes.sum(axis=1)
    points = camera.normalize((start + share[good][:, None] * along) + offset[:, None] * outward)
    for _ in range(2):
        mean = points.mean(axis=0)
        normal = np.linalg.svd(points - mean)[2][1]
        off = np.abs((points - mean) @ normal)
        near = off <= ASTRAY * max(float(np.median(off)), 1e-12) * 1.5
        if near.sum() < FEWEST:
            return None
        points = points[near]
    mean = points.mean(axis=0)
    normal = np.linalg.svd(points - mean)[2][1]
    return np.array([*normal, -normal @ mean])
