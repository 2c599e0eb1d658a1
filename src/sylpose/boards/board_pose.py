"""Where a calibration target is, by all cameras that see it at one instant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.absolute_pose.pose import estimate_pose
from sylpose.boards.detection import Detection, detect
from sylpose.boards.specification import Board
from sylpose.frames import FrameSet, check_frames
from sylpose.geometry.arrays import FloatArray, Image, IntArray
from sylpose.geometry.validation import items, kind_of
from sylpose.results import Motion
from sylpose.rig import Camera, Rig

__all__ = ["Sighting", "find_board", "joined"]

# A size that is known less surely than to this share is not told (choice: a printer's scaling is a few percent).
SIZE_KNOWN = 0.0125
# Two cameras' rays that miss each other by more, pixels, are of no common point; their points are as good as this (choice).
MISSED_PX, USUAL_PX = 5.0, 0.5
# Points around a circle that stand for it (choice).
AROUND = 32
# Cameras that see a target so many pixels from where the others do are named (choice: a calibration that has not changed is
# good to one).
ELSEWHERE_PX = 3.0


@dataclass(frozen=True, eq=False)
class Sighting:
    """What C cameras see of a target at one instant.

    Attributes:
        points: (n_c, 3) by camera, in the target's frame; empty where it is not seen.
        pixels: (n_c, 2) by camera, in the image as recorded; of circles where their centres would be seen.
        motion: world_from_board with its status and covariance, as `estimate_pose` has it.
        alike: how many turns of the target look the same; beyond 1, the one that was taken is a choice: that whose x axis is
            most to the right in the image of the first camera that sees it.
        size: how large it is by where the rays of two cameras meet, as a share of how large it was said to be; None where
            nothing tells.
        problems: sentences on what looks wrong.
    """

    points: tuple[FloatArray, ...]
    pixels: tuple[FloatArray, ...]
    motion: Motion
    alike: int
    size: float | None
    problems: tuple[str, ...]

    @property
    def cameras(self) -> tuple[int, ...]:
        """Numbers of the cameras that see it."""
        return tuple(c for c, pixels in enumerate(self.pixels) if len(pixels))


def find_board(rig: Rig, images: Sequence[Image | None], board: Board, *, seed: int = 0) -> Sighting:
    """Looks for a target in the images of all cameras at one instant, and where it is.

    Args:
        rig: C cameras.
        images: C images (h, w) or (h, w, 3) BGR as recorded, None where a camera has none.
        board: of `parse_board`, in the rig's unit.
        seed: of the search. Same input and seed, same result.

    Raises:
        TypeError, ValueError: not one image per camera, of its size; this OpenCV has no detector for the target.
    """
    n = len(kind_of(rig, Rig, "rig"))
    images = items(images, "images", n)
    nothing = (None,) * n
    check_frames(FrameSet(0, 0.0, nothing, tuple(images), nothing), rig)
    board = kind_of(board, Board, "board")
    none = Detection(np.empty(0, np.int64), np.empty((0, 2)))
    seen = [none if image is None else detect(image, camera, board) for camera, image in zip(rig, images, strict=True)]
    return joined(rig, seen, board, seed=seed)


def joined(rig: Rig, seen: Sequence[Detection], board: Board, *, seed: int = 0) -> Sighting:
    """What the cameras see of a target, put together: of targets that look the same after a turn, all see the same turn.

    Cameras are taken one after the other, those that see most first; each with the turn by which it agrees best with those
    before.

    Args:
        seen: of each camera of the rig.
    """
    turns: dict[int, IntArray] = {}
    order = sorted((c for c, its in enumerate(seen) if len(its.numbers)), key=lambda c: -_extent(seen[c]))
    if len(board.alike) > 1:
        for c in order:
            ways = board.alike if turns else board.alike[:1]
            misfits = [_misfit(_fit(rig, seen, board, {**turns, c: way}, seed)) for way in ways]
            turns[c] = ways[misfits.index(min(misfits))]
        turns = _chosen(seen, board, turns)
    else:
        turns = dict.fromkeys(order, board.alike[0])
    points, pixels = _matches(seen, board, turns)
    motion = estimate_pose(rig, points, pixels, seed=seed)
    if board.diameter and motion.motion is not None:
        world_from_board = motion.motion
        pixels = tuple(
            its - _off_center(camera, world_from_board, where, board.diameter)
            for camera, where, its in zip(rig, points, pixels, strict=True)
        )
        motion = estimate_pose(rig, points, pixels, seed=seed)
    problems = [f"{rig.names[c]}: {its.problem}" for c, its in enumerate(seen) if its.problem]
    size = _size_seen(rig, seen, board)
    problems += _elsewhere(rig, points, pixels, motion)
    return Sighting(points, pixels, motion, len(board.alike), size, tuple(problems))


def _matches(
    seen: Sequence[Detection], board: Board, turns: Mapping[int, IntArray]
) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]:
    points, pixels = [], []
    for c, its in enumerate(seen):
        points.append(board.points[turns[c][its.numbers]] if c in turns else np.empty((0, 3)))
        pixels.append(its.pixels if c in turns else np.empty((0, 2)))
    return tuple(points), tuple(pixels)


def _fit(rig: Rig, seen: Sequence[Detection], board: Board, turns: Mapping[int, IntArray], seed: int) -> Motion:
    return estimate_pose(rig, *_matches(seen, board, turns), seed=seed)


def _misfit(motion: Motion) -> tuple[float, float]:
    """What is less for the better of two poses of the same matches: those that disagree, then the residual."""
    off = sum(int(np.count_nonzero(~its)) for its in motion.inliers)
    return off, float(np.nanmax(motion.residuals, initial=0.0))


def _off_center(camera: Camera, world_from_board: RigidTransform, centers: FloatArray, diameter: float) -> FloatArray:
    """(n, 2) pixels from where circles' centres (n, 3) are seen to the middles of what is seen of them, whose nearer parts
    look larger."""
    around = 2 * np.pi * np.arange(AROUND) / AROUND
    ring = diameter / 2 * np.column_stack([np.cos(around), np.sin(around), np.zeros(AROUND)])
    places = world_from_board.apply((centers[:, None] + ring).reshape(-1, 3))
    middles = camera.project(world_from_board.apply(centers).reshape(-1, 3))
    off = camera.project(places).reshape(-1, AROUND, 2) - middles[:, None]
    after = np.roll(off, -1, axis=1)
    areas = off[..., 0] * after[..., 1] - off[..., 1] * after[..., 0]
    # The centre of a polygon is that of its triangles, by their areas.
    return np.asarray((areas[..., None] * (off + after)).sum(axis=1) / (3 * areas.sum(axis=1, keepdims=True)))


def _extent(its: Detection) -> float:
    """How large it is in the image, pixels."""
    return float(np.linalg.norm(np.ptp(its.pixels, axis=0)))


def _chosen(seen: Sequence[Detection], board: Board, turns: Mapping[int, IntArray]) -> dict[int, IntArray]:
    """The same with the target turned so that its x axis is most to the right in the first camera's image."""
    if not turns:
        return {}
    first = min(turns)
    its = seen[first]

    def to_the_right(way: IntArray) -> float:
        x = board.points[way[turns[first][its.numbers]], 0]
        return float((x - x.mean()) @ (its.pixels[:, 0] - its.pixels[:, 0].mean()))

    best = max(board.alike, key=to_the_right)
    return {c: best[turn] for c, turn in turns.items()}


def _elsewhere(rig: Rig, points: Sequence[FloatArray], pixels: Sequence[FloatArray], motion: Motion) -> list[str]:
    """A sentence on each camera that sees the target elsewhere than the others."""
    found = []
    for camera, where, its in zip(rig, points, pixels, strict=True):
        if motion.motion is not None and len(its):
            off = np.linalg.norm(camera.project(motion.motion.apply(where).reshape(-1, 3)) - its, axis=1)
            far = float(np.median(np.nan_to_num(off, nan=np.inf)))
            if far > ELSEWHERE_PX:
                found.append(f"{camera.name} sees it elsewhere than the other cameras, {far:.0f} px off")
    return found


def _size_seen(rig: Rig, seen: Sequence[Detection], board: Board) -> float | None:
    """As `Sighting` has it, the median over pairs of cameras."""
    ratios = []
    with_points = [c for c, its in enumerate(seen) if len(its.numbers)]
    for i, a in enumerate(with_points):
        for b in with_points[i + 1 :]:
            pair = (rig.cameras[a], rig.cameras[b])
            met = [_met(pair, seen[a], seen[b], way) for way in board.alike]
            miss, points, numbers, doubt = min(met, key=lambda its: its[0])
            if miss > MISSED_PX or len(numbers) < 3 or doubt > SIZE_KNOWN:
                continue
            spreads = [np.linalg.norm(x - x.mean(axis=0)) for x in (points, board.points[numbers])]
            ratios.append(float(spreads[0] / spreads[1]))
    return float(np.median(ratios)) if ratios else None


def _met(
    pair: tuple[Camera, Camera], a: Detection, b: Detection, way: IntArray
) -> tuple[float, FloatArray, IntArray, float]:
    """Where the rays of two cameras meet, the target of the second one being turned.

    Returns:
        the median distance by which they miss each other, pixels; (m, 3) places of the m points that both see; their
        numbers; and by what share their size may be off.
    """
    numbers, in_a, in_b = np.intersect1d(a.numbers, way[b.numbers], return_indices=True)
    if not len(numbers):
        return np.inf, np.empty((0, 3)), numbers, np.inf
    one, other = pair[0].rays(a.pixels[in_a]), pair[1].rays(b.pixels[in_b])
    between = pair[1].center - pair[0].center
    cosine = (one * other).sum(axis=1)
    sine = np.maximum(1.0 - cosine**2, 1e-12)
    far = (one @ between - cosine * (other @ between)) / sine
    back = (cosine * (one @ between) - other @ between) / sine
    ends = pair[0].center + far[:, None] * one, pair[1].center + back[:, None] * other
    miss = np.linalg.norm(ends[0] - ends[1], axis=1) * pair[0].focal / np.maximum(far, 1e-12)
    extent = float(np.linalg.norm(np.ptp(a.pixels[in_a], axis=0)))
    doubt = USUAL_PX / (float(np.sqrt(np.median(sine))) * max(extent, 1e-12))
    good = (far > 0) & (back > 0)
    return float(np.median(np.where(good, miss, np.inf))), (ends[0] + ends[1]) / 2, numbers, doubt
