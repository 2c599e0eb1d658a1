"""Views of a board as arrays, and the choice of few that cover each camera's image and tilts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sylpose.boards.detection import Detection
from sylpose.boards.specification import Board
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.rig_calibration.board_bundle import Views
from sylpose.rig_calibration.board_start import measure_spacing

# Fewest corners of a view, of boards that have them: four determine a homography, without a check (choice).
MIN_CORNERS = 6
# A view's corners are not in line: smallest over largest singular value of their places on the board (choice: of a row of
# six corners and one next to it 0.2).
MIN_SPREAD = 0.1
# A view that differs less from the chosen ones repeats them: mean displacement of corners in distances of neighbors
# (choice).
MIN_NOVELTY = 0.25


def collect_views(board: Board, detections: Sequence[Sequence[Detection]]) -> Views:
    """Collect the views with enough corners of detections by frame and camera."""
    found = [
        (c, f, its)
        for f, by_camera in enumerate(detections)
        for c, its in enumerate(by_camera)
        if _is_view(board.points[its.indices], len(board.points))
    ]
    shape = len(found), len(board.points)
    pixels, seen = np.zeros((*shape, 2)), np.zeros(shape, bool)
    for v, (_, _, its) in enumerate(found):
        pixels[v, its.indices], seen[v, its.indices] = its.pixels, True
    camera, frame = (np.array([row[k] for row in found], dtype=np.int64) for k in (0, 1))
    views = Views(board.points, camera, frame, pixels, seen, np.zeros((*shape, 2)))
    return replace(views, speeds=_measure_speeds(views))


def _is_view(points: FloatArray, n: int) -> bool:
    """Return whether corners (m, 3) of a board with n are enough, and not in line."""
    if len(points) < min(MIN_CORNERS, n):
        return False
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(values[1] >= MIN_SPREAD * values[0])


def _measure_speeds(views: Views) -> FloatArray:
    """Return the velocities (V, N, 2) of the corners from the views before and after, pixels per frame; 0 without both.

    A one-sided difference would be that of half a frame before or after.
    """
    row = {key: v for v, key in enumerate(zip(views.camera.tolist(), views.frame.tolist(), strict=True))}
    speeds = np.zeros(views.pixels.shape)
    for (c, f), v in row.items():
        before, after = row.get((c, f - 1)), row.get((c, f + 1))
        if before is not None and after is not None:
            both = views.seen[before] & views.seen[after] & views.seen[v]
            speeds[v, both] = (views.pixels[after, both] - views.pixels[before, both]) / 2
    return speeds


def choose_frames(views: Views, n_cameras: int, max_views: int) -> BoolArray:
    """Choose frames whose views differ most, until each camera has so many views or all others repeat them.

    In each step the frame is taken whose views are farthest from those chosen, summed over the cameras that need more;
    farther than it moves per frame, since motion blurs. Frames seen by several cameras are thereby preferred.

    Returns:
        (V,) mask of the views of the chosen frames.
    """
    n_views, frames = len(views.frame), np.unique(views.frame)
    spacing = np.array([measure_spacing(p[s]) for p, s in zip(views.pixels, views.seen, strict=True)])
    speed = np.linalg.norm(views.speeds, axis=2).sum(axis=1) / views.seen.sum(axis=1) / spacing
    extent = np.ptp(views.pixels.reshape(-1, 2), axis=0).max(initial=1.0)
    novelty, chosen = np.full(n_views, 1.0) * extent / spacing, np.zeros(n_views, bool)
    column = np.searchsorted(frames, views.frame)
    while True:
        counts = np.bincount(views.camera[chosen], minlength=n_cameras)
        is_needed = ~chosen & (counts[views.camera] < max_views) & (novelty >= MIN_NOVELTY)
        if not is_needed.any():
            return chosen
        value = np.bincount(column, np.where(is_needed, novelty / (1.0 + speed), 0.0), minlength=len(frames))
        added = views.frame == frames[int(np.argmax(value))]
        chosen |= added
        for v in np.flatnonzero(added):
            own = np.flatnonzero(views.camera == views.camera[v])
            novelty[own] = np.minimum(novelty[own], _measure_displacement(views, int(v), own) / spacing[own])


def _measure_displacement(views: Views, view: int, others: IntArray) -> FloatArray:
    """Return the mean displacement of corners from a view to others, pixels; of their means if none is common."""
    both = views.seen[others] & views.seen[view]
    lengths = np.linalg.norm(views.pixels[others] - views.pixels[view], axis=2)
    n = both.sum(axis=1)
    means = [(views.pixels[v][views.seen[v]]).mean(axis=0) for v in (view, *others)]
    apart = np.linalg.norm(np.array(means[1:]) - means[0], axis=1)
    return np.asarray(np.where(n > 0, (lengths * both).sum(axis=1) / np.maximum(n, 1), apart))
