"""Dictionary and marker size of a ChArUco board whose description lacks them, from images of it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np

from sylpose.boards.detection import detect_markers, load_aruco, load_dictionary
from sylpose.boards.specification import DICTIONARIES, parse_board
from sylpose.geometry.arrays import FloatArray, Image, IntArray
from sylpose.rig import Camera

# A dictionary is that of the board if so many of its markers lie as on the board, in all images together (choice: twice
# what the homography of one image fits exactly).
MIN_MARKERS = 8
# Share of the markers in an image that must lie as on the board (choice: rows of another board may do so).
MIN_SHARE = 0.8
# Largest distance of a marker's middle from its place, in sides of a square (choice: lenses bend boards by less).
MAX_DISTANCE = 0.1


def is_incomplete(text: str) -> bool:
    """Return whether a text describes a ChArUco board without its dictionary or marker size."""
    words = text.replace(" ", "").lower()
    return words.startswith("charuco:") and not ("dict=" in words and "marker=" in words)


def complete_charuco(text: str, images: Iterable[tuple[Image, Camera]]) -> str:
    """Return the description of a ChArUco board with the dictionary and marker size that images show.

    The board's markers lie in alternate squares, so the side of a marker relative to a square follows from their places.

    Args:
        text: description of the board, with `square`.
        images: images, (h, w) or (h, w, 3), each with its camera; in some of them, four markers and more are visible.

    Raises:
        ValueError: a wrong description, or too few markers of any dictionary.
    """
    words = dict(re.findall(r"(\w+)\s*=\s*([^,\s]+)", text.lower()))
    layout = re.match(r"\s*charuco\s*:\s*(\d+)\s*x\s*(\d+)", text, re.IGNORECASE)
    square = re.fullmatch(r"([0-9.eE+-]+)\s*(\w*)", words.get("square", ""))
    if layout is None or square is None:
        # It is wrong even with the other values; this raises the error.
        parse_board(f"{text},marker=1e-9,dict=4X4_50", "m")
        raise ValueError(f"{text!r} is not a ChArUco board such as charuco:5x7,square=40mm")
    size, known = (int(layout[1]), int(layout[2])), words.get("dict")
    seen = list(images)
    if words.get("inverted") == "1":
        seen = [(255 - image, camera) for image, camera in seen]
    names: list[str] = _list_dictionaries(size) if known is None else [DICTIONARIES.get(str(known).upper(), str(known))]
    counts, ratios = dict[str, int](), dict[str, FloatArray]()
    for name in names:
        found = [_measure_ratios(size, name, image, camera) for image, camera in seen]
        ratios[name] = np.concatenate([np.empty(0), *found])
        counts[name] = len(ratios[name])
    best = max(names, key=counts.__getitem__)
    if counts[best] < MIN_MARKERS:
        raise ValueError(
            f"{text}: no markers of {'any dictionary' if known is None else known} lie as on this board in {len(seen)} "
            "images: check the numbers of squares, or give marker= and dict="
        )
    if known is None:
        text += f",dict={best}"
    if "marker" not in words:
        text += f",marker={float(np.median(ratios[best])) * float(square[1]):.6g}{square[2]}"
    return text


def _list_dictionaries(size: tuple[int, int]) -> list[str]:
    """Return the dictionaries with enough markers; of those that only add markers to one another, the smallest."""
    aruco, found = load_aruco(), dict[str, str]()
    for name in DICTIONARIES.values():
        if len(load_dictionary(aruco, name).bytesList) >= size[0] * size[1] // 2:
            found.setdefault(re.sub(r"(?<=X\d)_\d+$", "", name), name)
    return [*found.values()]


def _measure_ratios(size: tuple[int, int], dictionary: str, image: Image, camera: Camera) -> FloatArray:
    """Return (m,) sides of the markers that lie as on the board, relative to a square; (0,) for fewer than four."""
    aruco, n = load_aruco(), size[0] * size[1] // 2
    marker = parse_board(f"aruco:{dictionary},id=0,size=1")
    known = load_dictionary(aruco, dictionary)
    if len(known.bytesList) < n:  # OpenCV has no board of it
        return np.empty(0)
    ids, corners, _ = detect_markers(image, camera, marker, range(n))
    best = np.empty(0)
    # Before OpenCV 4.6, boards with an even number of rows began with a square of the other color.
    for legacy in (False, True)[: 2 - size[1] % 2]:
        board: Any = aruco.CharucoBoard(size, 1.0, 0.5, known)
        if legacy:
            board.setLegacyPattern(True)
        places = np.array(board.getObjPoints(), dtype=float).reshape(-1, 4, 3)[..., :2].mean(axis=1)
        found = _fit_board(places, ids, corners)
        best = max(best, found, key=len)
    return best


def _fit_board(places: FloatArray, ids: IntArray, corners: FloatArray) -> FloatArray:
    """Return sides of the markers (m, 4, 2) whose middles fit their places (n, 2) on the board, in units of these."""
    if len(ids) < 4:
        return np.empty(0)
    middles = _intersect_diagonals(corners)
    matrix: Any = cv2.findHomography(middles, places[ids], cv2.RANSAC, MAX_DISTANCE)[0]
    if matrix is None:
        return np.empty(0)
    flat = cv2.perspectiveTransform(corners.reshape(-1, 1, 2), matrix).reshape(-1, 4, 2)
    off = np.linalg.norm(cv2.perspectiveTransform(middles[:, None], matrix)[:, 0] - places[ids], axis=1)
    sides = np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=2).mean(axis=1)
    fits = (off < MAX_DISTANCE) & (sides < 1.0)
    return sides[fits] if fits.sum() >= max(4, MIN_SHARE * len(ids)) else np.empty(0)


def _intersect_diagonals(corners: FloatArray) -> FloatArray:
    """Return the (m, 2) middles of squares seen in perspective, (m, 4, 2)."""
    a, b, c, d = corners.transpose(1, 0, 2)
    along, across = c - a, d - b
    cross = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    start = b - a
    share = (start[:, 0] * across[:, 1] - start[:, 1] * across[:, 0]) / cross
    return np.asarray(a + share[:, None] * along)
