"""A calibration target in one image, by OpenCV's detectors (cv2.aruco of OpenCV 4.8 or newer)."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from sylpose.boards.marker_corners import corners_of_edges
from sylpose.boards.specification import Board
from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.rig import Camera

__all__ = ["Detection", "detect", "markers_in"]

# Squares of a chessboard are looked at in this share of their middle (choice), and so many of the neighbours must differ as
# black and white do (choice: shadows and glare spoil some).
MIDDLE, DIFFER = 0.25, 0.8
# Corners are refined in windows of so many pixels to each side: a share of their distance, at least and at most (choice).
WINDOW, LEAST_WINDOW, MOST_WINDOW = 0.35, 2, 5
# Markers whose corners are so far, pixels, from where the board's others say are no markers of it; a corner between two that
# would be moved further from there is hidden (choice: a lens is calibrated to one).
FITS_PX, MOVED_PX = 2.0, 1.5


@dataclass(frozen=True, eq=False)
class Detection:
    """What one image shows of a target.

    Attributes:
        numbers: (n,) rows of `Board.points`, none twice; whether they are to be turned by one of `Board.alike` is not known.
        pixels: (n, 2) in the image as recorded.
        problem: a sentence about what was not taken, or "".
    """

    numbers: IntArray
    pixels: FloatArray
    problem: str = ""


def detect(image: Image, camera: Camera, board: Board) -> Detection:
    """Looks for a target in an image.

    Args:
        image: (h, w) or (h, w, 3) BGR, as the camera recorded it.

    Returns:
        of no points where it is not seen; where a marker is seen several times, of none of these.

    Raises:
        ValueError: this OpenCV has no detector for it.
    """
    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    if board.kind == "chessboard":
        return _chessboard(board, grey)
    if board.kind in ("circles", "acircles"):
        return _circles(board, grey)
    if board.kind == "charuco":
        return _charuco(board, grey, camera)
    return _markers(board, grey, camera)


def markers_in(
    image: Image, camera: Camera, marker: Board, numbers: Collection[int]
) -> tuple[IntArray, FloatArray, str]:
    """Looks for several markers of one kind at once.

    Args:
        image: as in `detect`.
        marker: one of them.
        numbers: of those that are looked for.

    Returns:
        numbers (m,) of those that are seen once; their corners (m, 4, 2) as `Board.points` of each has them; and a sentence
        about those that are seen more than once, or "".

    Raises:
        ValueError: as `detect`.
    """
    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    first = min(numbers, default=0)
    which, places, problem = _tags(replace(marker, first_id=first), grey, camera, max(numbers, default=0) - first + 1)
    which = which + first
    mine = np.isin(which, list(numbers))
    return which[mine], np.roll(places, 2, axis=1)[mine] if marker.half_turned else places[mine], problem


def _nothing(problem: str = "") -> Detection:
    return Detection(np.empty(0, np.int64), np.empty((0, 2)), problem)


def _chessboard(board: Board, grey: Image) -> Detection:
    columns, rows = board.size
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    found, corners = cv2.findChessboardCornersSB(grey, board.size, flags=flags)
    if not found or corners is None or len(corners) != columns * rows:
        return _nothing()
    # The sector based detector finds boards surely, and corners to a tenth of a pixel only.
    grid = np.asarray(corners, dtype=float).reshape(rows, columns, 2)
    apart = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min()) for axis in (0, 1))
    grid = _from_the_front(_refined(grey, grid.reshape(-1, 2), WINDOW * apart).reshape(grid.shape))
    dark = _dark_squares(grey, grid)
    if dark is None:
        return _nothing("what looks like the board's corners has no squares of black and white between them")
    # The square at the origin is a dark one, where a turn makes it so.
    if not dark and (columns + rows) % 2:
        grid = np.rot90(grid, 2)
    elif not dark and columns == rows and columns % 2:
        grid = np.rot90(grid)
    return Detection(np.arange(columns * rows), np.ascontiguousarray(grid.reshape(-1, 2)))


def _circles(board: Board, grey: Image) -> Detection:
    columns, rows = board.size
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.kind == "acircles" else cv2.CALIB_CB_SYMMETRIC_GRID
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        found, centers = cv2.findCirclesGrid(grey, board.size, flags=flags)
        if found and centers is not None and len(centers) == columns * rows:
            break
    else:
        return _nothing()
    grid = np.asarray(centers, dtype=float).reshape(rows, columns, 2)
    grid = _from_the_front(grid)
    # Rows are counted down the page where every other one is shifted.
    grid = grid[::-1] if board.kind == "acircles" else grid
    return Detection(np.arange(columns * rows), np.ascontiguousarray(grid.reshape(-1, 2)))


def _charuco(board: Board, grey: Image, camera: Camera) -> Detection:
    aruco = _aruco()
    dictionary = _dictionary(aruco, board.dictionary)
    square = float(board.points[:, 0].min())
    seen, places, problem = _tags(board, grey, camera, board.size[0] * board.size[1] // 2)
    centers, plane = np.empty((0, 2)), _Plane(np.empty(0, bool), np.eye(3))
    # Boards of an even number of rows began with a square of the other colour before OpenCV 4.6.
    for legacy in (False, True)[: 2 - board.size[1] % 2]:
        drawn = aruco.CharucoBoard(board.size, square, board.marker_share * square, dictionary)
        if legacy:
            drawn.setLegacyPattern(True)
        # Down the page from its upper left end, as OpenCV has them.
        flat = np.array(drawn.getObjPoints(), dtype=float).reshape(-1, 4, 3)[..., :2]
        flat = np.stack([flat[..., 0], board.size[1] * square - flat[..., 1]], axis=-1)[seen]
        its = _plane(flat, places, camera)
        if np.count_nonzero(its.fits) > len(centers):
            centers, plane = flat[its.fits].mean(axis=1), its
    # A corner lies between two markers, half a square's diagonal from the middle of each.
    apart = np.linalg.norm(board.points[:, None, :2] - centers, axis=2)
    between = np.flatnonzero((apart < 0.9 * square).sum(axis=1) == 2)
    if not len(between):
        return _nothing(problem)
    there = np.column_stack([board.points[between, :2], np.ones(len(between))]) @ plane.image_from_board.T
    start = camera.denormalize(there[:, :2] / there[:, 2:])
    # The markers' corners are as near as that.
    side = float(np.linalg.norm(places - np.roll(places, 1, axis=1), axis=2).min())
    found = _refined(grey, start, side * (1.0 / board.marker_share - 1.0) / 2.0)
    good = np.linalg.norm(found - start, axis=1) <= MOVED_PX
    return Detection(between[good], found[good], problem)


@dataclass(frozen=True, eq=False)
class _Plane:
    """Which markers (n,) of a board lie in its plane, and (3, 3) where its points are seen, in normalised coordinates."""

    fits: BoolArray
    image_from_board: FloatArray


def _plane(flat: FloatArray, places: FloatArray, camera: Camera) -> _Plane:
    """The markers whose corners (n, 4, 2) on the board and in the image fit together; others are no markers of it."""
    none = _Plane(np.zeros(len(flat), bool), np.eye(3))
    if not len(flat):
        return none
    seen = camera.normalize(places.reshape(-1, 2))
    matrix: Any = cv2.findHomography(flat.reshape(-1, 2), seen, cv2.RANSAC, FITS_PX / camera.focal)[0]
    if matrix is None:
        return none
    there = cv2.perspectiveTransform(flat.reshape(-1, 1, 2), matrix)[:, 0]
    off = np.linalg.norm(there - seen, axis=1).reshape(-1, 4).max(axis=1) * camera.focal
    return _Plane(off <= FITS_PX, np.asarray(matrix, dtype=float))


def _markers(board: Board, grey: Image, camera: Camera) -> Detection:
    which, places, problem = _tags(board, grey, camera, board.size[0] * board.size[1])
    if board.half_turned:
        places = np.roll(places, 2, axis=1)
    if board.kind == "aprilgrid":
        which, places, said = _as_in_grid(board, camera, which, places)
        problem = problem or said
    return Detection((4 * which[:, None] + np.arange(4)).ravel(), places.reshape(-1, 2), problem)


def _tags(board: Board, grey: Image, camera: Camera, n: int) -> tuple[IntArray, FloatArray, str]:
    """Which of the board's n markers are seen (m,), their corners (m, 4, 2) as OpenCV orders them, and a sentence about
    those that are seen more than once and left out."""
    aruco = _aruco()
    dictionary = _dictionary(aruco, board.dictionary)
    corners, numbers, _ = aruco.ArucoDetector(dictionary, _parameters(aruco, board)).detectMarkers(grey)
    which = np.array([] if numbers is None else numbers, dtype=np.int64).ravel() - board.first_id
    places = np.array(corners, dtype=float).reshape(-1, 4, 2)
    mine = (which >= 0) & (which < n)
    once = mine & np.array([np.count_nonzero(which == one) == 1 for one in which], dtype=bool)
    twice = sorted({int(one) + board.first_id for one in which[mine & ~once]})
    problem = f"marker {', '.join(map(str, twice))} is seen more than once" if twice else ""
    bits = dictionary.markerSize + 2 * board.border
    refined = [corners_of_edges(grey, camera, its, bits) for its in places[once]]
    return which[once], np.array(refined).reshape(-1, 4, 2), problem


def _as_in_grid(board: Board, camera: Camera, which: IntArray, places: FloatArray) -> tuple[IntArray, FloatArray, str]:
    """The tags (n,) that are the grid's, and their corners (n, 4, 2) in the order of `Board.points`.

    Printed grids disagree in which way up the tags are: of the four ways it is the one by which most tags are in one plane.
    """
    none = np.empty(0, np.int64), np.empty((0, 4, 2))
    if len(which) < 2:
        return *none, "a single tag does not tell which way up the tags of the grid are" if len(which) else ""
    flat = board.points[:, :2].reshape(-1, 4, 2)[which]
    # Around against the clock, as seen.
    ways = [np.roll(places[:, ::-1], turn, axis=1) for turn in range(4)]
    planes = [_plane(flat, way, camera) for way in ways]
    counts = [np.count_nonzero(plane.fits) for plane in planes]
    best = int(np.argmax(counts))
    fits = planes[best].fits
    return (which[fits], ways[best][fits], "") if counts[best] > 1 else (*none, "its tags are not in one plane")


def _refined(grey: Image, corners: FloatArray, window: float) -> FloatArray:
    """The same corners of squares (n, 2) where the gradients around them say, in windows of so many pixels to each side."""
    reach = int(np.clip(window, LEAST_WINDOW, MOST_WINDOW))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    start = corners.reshape(-1, 1, 2).astype(np.float32)
    refined = cv2.cornerSubPix(grey, start, (reach, reach), (-1, -1), criteria)
    return np.asarray(refined, dtype=float).reshape(-1, 2)


def _from_the_front(grid: FloatArray) -> FloatArray:
    """Points (rows, columns, 2) in an order in which x goes to the right where y goes up, as the front of a board shows."""
    return grid if _handedness(grid) < 0 else grid[::-1]


def _handedness(grid: FloatArray) -> float:
    """Twice the area, pixels, around a grid's corners: along its first row, then on; y of pixels goes down."""
    around = np.array([grid[0, 0], grid[0, -1], grid[-1, -1], grid[-1, 0]])
    after = np.roll(around, -1, axis=0)
    return float((around[:, 0] * after[:, 1] - around[:, 1] * after[:, 0]).sum())


def _dark_squares(grey: Image, grid: FloatArray) -> bool | None:
    """Whether the square between the first four corners (rows, columns, 2) is a dark one; None where the squares do not
    look like those of a chessboard."""
    blurred = cv2.blur(grey, (3, 3)).astype(float)
    corners = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]])
    middle = corners.mean(axis=0)
    samples = np.concatenate([middle[None], middle + MIDDLE * (corners - middle)])
    height, width = grey.shape
    u = np.clip(np.rint(samples[..., 0]).astype(int), 0, width - 1)
    v = np.clip(np.rint(samples[..., 1]).astype(int), 0, height - 1)
    levels = blurred[v, u].mean(axis=0)
    rows, columns = levels.shape
    sign = np.where((np.arange(rows)[:, None] + np.arange(columns)) % 2, 1.0, -1.0)
    # Neighbours alone are compared: light falls off over a board.
    across = (levels[:, 1:] - levels[:, :-1]) * -sign[:, :-1]
    along = (levels[1:] - levels[:-1]) * -sign[:-1]
    steps = np.concatenate([across.ravel(), along.ravel()])
    if not len(steps):
        return None
    brighter = float((steps > 0).mean())
    if max(brighter, 1 - brighter) < DIFFER:
        return None
    return brighter > 0.5


def _aruco() -> Any:
    aruco = getattr(cv2, "aruco", None)
    if aruco is None or not hasattr(aruco, "CharucoDetector"):
        raise ValueError(f"markers and ChArUco boards need OpenCV 4.8 or newer, this is {cv2.__version__}")
    return aruco


def _dictionary(aruco: Any, name: str) -> Any:
    number = getattr(aruco, f"DICT_{name}", None)
    if number is None:
        raise ValueError(f"OpenCV {cv2.__version__} does not know the markers {name}")
    return aruco.getPredefinedDictionary(number)


def _parameters(aruco: Any, board: Board) -> Any:
    parameters = aruco.DetectorParameters()
    # Good to a pixel; OpenCV's sub-pixel corners are drawn to those of squares beside them, up to version 4.8.
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_CONTOUR
    parameters.markerBorderBits = board.border
    return parameters
