"""Detection of a calibration target in one image, by OpenCV's detectors (cv2.aruco of OpenCV 4.8 or newer).

Marker corners are intersections of fitted edges. They are more accurate than separately detected corners, which blur
pulls inwards.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from sylpose.boards.specification import Board
from sylpose.geometry.arrays import FloatArray, Image, IntArray
from sylpose.rig import Camera

# Chessboard squares are sampled in this share of their middle (choice); this share of neighbors must differ like black
# and white (choice: shadows and glare spoil some).
SAMPLE_RATIO, MIN_CONTRAST_SHARE = 0.25, 0.8
# Half width of corner refinement windows: a share of the corners' distance, with minimum and maximum in pixels
# (choice).
WINDOW_RATIO, MIN_WINDOW, MAX_WINDOW = 0.35, 2, 5
# Two markers whose corners deviate more from a common plane, pixels, do not belong to one board; a corner between two
# markers that moves further in refinement is hidden (choice: a lens bends so small a part by less).
MAX_FIT_ERROR_PX, MAX_REFINEMENT_PX = 2.0, 1.5
# Tags of a grid that are compared with each: one of them may not belong to it (choice).
N_NEAREST_TAGS = 3


@dataclass(frozen=True, eq=False)
class Detection:
    """Target points detected in one image.

    Attributes:
        indices: (n,) rows of `Board.points`, unique, up to a symmetry in `Board.symmetries`.
        pixels: (n, 2) in the image as recorded.
        problem: a sentence about rejected detections, or "".
    """

    indices: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    pixels: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    problem: str = ""


def detect(image: Image, camera: Camera, board: Board) -> Detection:
    """Detect a target in an image.

    Args:
        image: (h, w) or (h, w, 3) BGR, as the camera recorded it.
        camera: that took it.
        board: the target.

    Returns:
        empty if not detected; a marker seen several times is left out.

    Raises:
        ValueError: this OpenCV has no detector for it.
    """
    gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    gray = 255 - gray if board.is_inverted else gray
    if board.kind == "chessboard":
        return _detect_chessboard(board, gray)
    if board.kind in ("circles", "acircles"):
        return _detect_circles(board, gray)
    return (_detect_charuco if board.kind == "charuco" else _detect_board_markers)(board, gray, camera)


def detect_markers(
    image: Image, camera: Camera, marker: Board, ids: Collection[int]
) -> tuple[IntArray, FloatArray, str]:
    """Detect several markers of one kind at once.

    Args:
        image: as in `detect`.
        camera: as in `detect`.
        marker: one of them.
        ids: IDs of the requested markers.

    Returns:
        IDs (m,) of the markers seen exactly once; their corners (m, 4, 2) in the order of `Board.points`; and a
        sentence about those seen more than once, or "".

    Raises:
        ValueError: as `detect`.
    """
    gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    first, n = min(ids, default=0), max(ids, default=0) - min(ids, default=0) + 1
    indices, corners, problem = _detect_tags(replace(marker, first_id=first), gray, camera, n)
    is_requested = np.isin(indices + first, list(ids))
    corners = np.roll(corners, 2, axis=1) if marker.is_upside_down else corners
    return indices[is_requested] + first, corners[is_requested], problem


def _detect_chessboard(board: Board, gray: Image) -> Detection:
    columns, rows = board.size
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    found, corners = cv2.findChessboardCornersSB(gray, board.size, flags=flags)
    if not found or corners is None or len(corners) != columns * rows:
        return Detection()
    # The sector-based detector finds boards reliably, but corners only to a tenth of a pixel.
    grid = np.asarray(corners, dtype=float).reshape(rows, columns, 2)
    min_distance = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min()) for axis in (0, 1))
    grid = _orient_to_front(_refine_corners(gray, grid.reshape(-1, 2), WINDOW_RATIO * min_distance).reshape(grid.shape))
    dark = _is_first_square_dark(gray, grid)
    if dark is None:
        return Detection(problem="the detected corners have no black and white squares between them")
    # The square at the origin is dark, if a rotation achieves this.
    if not dark and (columns + rows) % 2:
        grid = np.rot90(grid, 2)
    elif not dark and columns == rows and columns % 2:
        grid = np.rot90(grid)
    return Detection(np.arange(columns * rows), np.ascontiguousarray(grid.reshape(-1, 2)))


def _detect_circles(board: Board, gray: Image) -> Detection:
    columns, rows = board.size
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.kind == "acircles" else cv2.CALIB_CB_SYMMETRIC_GRID
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        found, centers = cv2.findCirclesGrid(gray, board.size, flags=flags)
        if found and centers is not None and len(centers) == columns * rows:
            break
    else:
        return Detection()
    grid = np.asarray(centers, dtype=float).reshape(rows, columns, 2)
    grid = _orient_to_front(grid)
    # Rows of asymmetric grids are counted down the page.
    grid = grid[::-1] if board.kind == "acircles" else grid
    return Detection(np.arange(columns * rows), np.ascontiguousarray(grid.reshape(-1, 2)))


def _detect_charuco(board: Board, gray: Image, camera: Camera) -> Detection:
    aruco = load_aruco()
    dictionary = load_dictionary(aruco, board.dictionary)
    square = float(board.points[:, 0].min())
    marker_indices, marker_corners, problem = _detect_tags(board, gray, camera, board.size[0] * board.size[1] // 2)
    between, start = np.empty(0, np.int64), np.empty((0, 2))
    # Before OpenCV 4.6, boards with an even number of rows began with a square of the other color.
    for legacy in (False, True)[: 2 - board.size[1] % 2]:
        drawn = aruco.CharucoBoard(board.size, square, board.marker_ratio * square, dictionary)
        if legacy:
            drawn.setLegacyPattern(True)
        # OpenCV's coordinates begin at the upper left, with y down the page.
        flat = np.array(drawn.getObjPoints(), dtype=float).reshape(-1, 4, 3)[..., :2]
        flat = np.stack([flat[..., 0], board.size[1] * square - flat[..., 1]], axis=-1)[marker_indices]
        indices, pixels = _interpolate_corners(board.points[:, :2], square, flat, marker_corners)
        if len(indices) > len(between):
            between, start = indices, pixels
    if not len(between):
        return Detection(problem=problem)
    # The window must not reach the markers' corners.
    side = float(np.linalg.norm(marker_corners - np.roll(marker_corners, 1, axis=1), axis=2).min())
    found = _refine_corners(gray, start, side * (1.0 / board.marker_ratio - 1.0) / 2.0)
    is_stable = np.linalg.norm(found - start, axis=1) <= MAX_REFINEMENT_PX
    return Detection(between[is_stable], found[is_stable], problem)


def _interpolate_corners(
    corners: FloatArray, square: float, board_markers: FloatArray, image_markers: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Interpolate the corners of squares between two markers each, whatever the lens: it hardly bends so small a part.

    Args:
        corners: (N, 2) on the board.
        square: side of a square.
        board_markers, image_markers: (m, 4, 2) corners of the markers.

    Returns:
        Indices (n,) of corners whose two markers are in one plane, and their pixels (n, 2).
    """
    # A corner lies half a square's diagonal from the middle of each of its markers.
    distances = np.linalg.norm(corners[:, None] - board_markers.mean(axis=1), axis=2)
    is_near = distances < 0.9 * square
    found, pixels = [], []
    for k in np.flatnonzero(is_near.sum(axis=1) == 2):
        matrix = _fit_plane(board_markers[is_near[k]], image_markers[is_near[k]])
        if matrix is not None:
            found.append(int(k))
            pixels.append(cv2.perspectiveTransform(corners[k].reshape(1, 1, 2), matrix)[0, 0])
    return np.array(found, dtype=np.int64), np.array(pixels, dtype=float).reshape(-1, 2)


def _fit_plane(board_markers: FloatArray, image_markers: FloatArray) -> FloatArray | None:
    """Fit a homography (3, 3) to the corners (2, 4, 2) of two markers on the board and in the image; None if none fits."""
    flat, seen = board_markers.reshape(-1, 1, 2), image_markers.reshape(-1, 2)
    matrix: Any = cv2.findHomography(flat, seen)[0]
    if matrix is None:
        return None
    errors = np.linalg.norm(cv2.perspectiveTransform(flat, matrix)[:, 0] - seen, axis=1)
    return np.asarray(matrix, dtype=float) if errors.max() <= MAX_FIT_ERROR_PX else None


def _detect_board_markers(board: Board, gray: Image, camera: Camera) -> Detection:
    indices, corners, problem = _detect_tags(board, gray, camera, board.size[0] * board.size[1])
    if board.is_upside_down:
        corners = np.roll(corners, 2, axis=1)
    if board.kind == "aprilgrid":
        indices, corners, grid_problem = _match_grid_tags(board, indices, corners)
        problem = problem or grid_problem
    return Detection((4 * indices[:, None] + np.arange(4)).ravel(), corners.reshape(-1, 2), problem)


def _detect_tags(board: Board, gray: Image, camera: Camera, n: int) -> tuple[IntArray, FloatArray, str]:
    """Detect the board's n markers.

    Returns:
        indices (m,), corners (m, 4, 2) in OpenCV's order, and a sentence about markers seen more than once, which are
        left out.
    """
    aruco = load_aruco()
    dictionary = load_dictionary(aruco, board.dictionary)
    corners, numbers, _ = aruco.ArucoDetector(dictionary, _make_parameters(aruco, board)).detectMarkers(gray)
    indices = np.array([] if numbers is None else numbers, dtype=np.int64).ravel() - board.first_id
    image_corners = np.array(corners, dtype=float).reshape(-1, 4, 2)
    is_of_board = (indices >= 0) & (indices < n)
    is_unique = is_of_board & np.array([np.count_nonzero(indices == index) == 1 for index in indices], dtype=bool)
    repeated_ids = sorted({int(index) + board.first_id for index in indices[is_of_board & ~is_unique]})
    problem = f"marker {', '.join(map(str, repeated_ids))} is seen more than once" if repeated_ids else ""
    bits = dictionary.markerSize + 2 * board.border
    refined = [refine_marker_corners(gray, camera, its, bits) for its in image_corners[is_unique]]
    return indices[is_unique], np.array(refined).reshape(-1, 4, 2), problem


def _match_grid_tags(board: Board, indices: IntArray, corners: FloatArray) -> tuple[IntArray, FloatArray, str]:
    """Select the grid's tags (n,), and their corners (n, 4, 2) in the order of `Board.points`.

    Printed grids differ in the tags' orientation: of the four, the one with most tags in one plane is taken. A tag is in
    the plane of one of its nearest tags, whatever the lens.
    """
    no_tags = np.empty(0, np.int64), np.empty((0, 4, 2))
    if len(indices) < 2:
        return *no_tags, "the tags' orientation in the grid is ambiguous from a single tag" if len(indices) else ""
    flat = board.points[:, :2].reshape(-1, 4, 2)[indices]
    distances = np.linalg.norm(flat.mean(axis=1)[:, None] - flat.mean(axis=1), axis=2)
    nearest = np.argsort(distances, axis=1)[:, 1 : 1 + N_NEAREST_TAGS]
    # Counterclockwise in the image.
    orientations = [np.roll(corners[:, ::-1], turn, axis=1) for turn in range(4)]
    masks = [
        np.array([any(_fit_plane(flat[[i, j]], way[[i, j]]) is not None for j in nearest[i]) for i in range(len(flat))])
        for way in orientations
    ]
    best = int(np.argmax([np.count_nonzero(mask) for mask in masks]))
    if np.count_nonzero(masks[best]) < 2:
        return *no_tags, "its tags are not in one plane"
    return indices[masks[best]], orientations[best][masks[best]], ""


def _refine_corners(gray: Image, corners: FloatArray, window: float) -> FloatArray:
    """Refine corners of squares (n, 2) by image gradients, in windows of this half width in pixels."""
    reach = int(np.clip(window, MIN_WINDOW, MAX_WINDOW))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    start = corners.reshape(-1, 1, 2).astype(np.float32)
    refined = cv2.cornerSubPix(gray, start, (reach, reach), (-1, -1), criteria)
    return np.asarray(refined, dtype=float).reshape(-1, 2)


def _orient_to_front(grid: FloatArray) -> FloatArray:
    """Order points (rows, columns, 2) so that x points right if y points up, as on the front of a board."""
    around = np.array([grid[0, 0], grid[0, -1], grid[-1, -1], grid[-1, 0]])
    after = np.roll(around, -1, axis=0)
    # Twice the signed area of the outline along the first row; pixel y points down.
    signed_area = float((around[:, 0] * after[:, 1] - around[:, 1] * after[:, 0]).sum())
    return grid if signed_area < 0 else grid[::-1]


def _is_first_square_dark(gray: Image, grid: FloatArray) -> bool | None:
    """Return whether the first square of a corner grid (rows, columns, 2) is dark; None if it is no chessboard."""
    blurred = cv2.blur(gray, (3, 3)).astype(float)
    corners = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]])
    middle = corners.mean(axis=0)
    samples = np.concatenate([middle[None], middle + SAMPLE_RATIO * (corners - middle)])
    height, width = gray.shape
    u = np.clip(np.rint(samples[..., 0]).astype(int), 0, width - 1)
    v = np.clip(np.rint(samples[..., 1]).astype(int), 0, height - 1)
    levels = blurred[v, u].mean(axis=0)
    rows, columns = levels.shape
    sign = np.where((np.arange(rows)[:, None] + np.arange(columns)) % 2, 1.0, -1.0)
    # Only neighbors are compared: light falls off over a board.
    across = (levels[:, 1:] - levels[:, :-1]) * -sign[:, :-1]
    along = (levels[1:] - levels[:-1]) * -sign[:-1]
    steps = np.concatenate([across.ravel(), along.ravel()])
    if not len(steps):
        return None
    brighter = float((steps > 0).mean())
    if max(brighter, 1 - brighter) < MIN_CONTRAST_SHARE:
        return None
    return brighter > 0.5


def load_aruco() -> Any:
    """Return OpenCV's module of markers.

    Raises:
        ValueError: this OpenCV is too old.
    """
    aruco = getattr(cv2, "aruco", None)
    if aruco is None or not hasattr(aruco, "CharucoDetector"):
        raise ValueError(f"markers and ChArUco boards need OpenCV 4.8 or newer, this is {cv2.__version__}")
    return aruco


def load_dictionary(aruco: Any, name: str) -> Any:
    """Return a dictionary of markers by OpenCV's name without DICT_.

    Raises:
        ValueError: this OpenCV does not have it.
    """
    number = getattr(aruco, f"DICT_{name}", None)
    if number is None:
        raise ValueError(f"OpenCV {cv2.__version__} does not have the markers {name}")
    return aruco.getPredefinedDictionary(number)


def _make_parameters(aruco: Any, board: Board) -> Any:
    parameters = aruco.DetectorParameters()
    # Accurate to a pixel; up to version 4.8, OpenCV's subpixel corners are biased towards those of adjacent squares.
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_CONTOUR
    parameters.markerBorderBits = board.border
    return parameters


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
    if not (np.abs(intersections[:, 2]) > 1e-12).all():
        return corners
    return camera.denormalize(intersections[:, :2] / intersections[:, 2:])


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
