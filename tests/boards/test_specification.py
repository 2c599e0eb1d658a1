"""Target descriptions: their points, or a one-sentence error."""

from __future__ import annotations

import re

import numpy as np
import pytest

from sylpose.boards.specification import EXAMPLES, parse_board
from sylpose.units import parse_length


@pytest.mark.parametrize("text", EXAMPLES)
def test_examples_are_parsed_in_any_unit(text: str) -> None:
    in_meters, in_millimeters = parse_board(text, "m"), parse_board(text, "mm")
    np.testing.assert_allclose(1000 * in_meters.points, in_millimeters.points, rtol=1e-12)
    assert 0.01 < np.ptp(in_meters.points, axis=0).max() < 2
    assert in_meters.text == text
    for way in in_meters.symmetries:
        # A symmetry is a rotation of the body, not a mirror image.
        here, there = (p - p.mean(axis=0) for p in (in_meters.points, in_meters.points[way]))
        turn = np.linalg.lstsq(here[:, :2], there[:, :2], rcond=None)[0]
        np.testing.assert_allclose(here[:, :2] @ turn, there[:, :2], atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1)


def test_target_frames_are_upright() -> None:
    charuco = parse_board("charuco:5x7,square=2,marker=1,dict=DICT_4X4_50")
    assert charuco.points.shape == (24, 3)
    # OpenCV counts from the top of the page; the origin is the board's lower left corner.
    np.testing.assert_array_equal(charuco.points[[0, 3, 20]], [[2, 12, 0], [8, 12, 0], [2, 2, 0]])
    chessboard = parse_board("chessboard: 9 x 6 , square = 2")
    np.testing.assert_array_equal(chessboard.points[[0, 1, 9, 53]], [[0, 0, 0], [2, 0, 0], [0, 2, 0], [16, 10, 0]])
    marker = parse_board("aruco:4x4_50,id=0,size=2")
    np.testing.assert_array_equal(marker.points, [[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    grid = parse_board("AprilGrid:6x6,size=2,gap=0.5")
    np.testing.assert_array_equal(
        grid.points[[0, 1, 2, 3, 4, 24]], [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [3, 0, 0], [0, 3, 0]]
    )
    circles = parse_board("acircles:4x11,spacing=2,diameter=1")
    np.testing.assert_array_equal(circles.points[[0, 1, 4]], [[0, 20, 0], [4, 20, 0], [2, 18, 0]])


@pytest.mark.parametrize(
    ("text", "turns"),
    [("9x6", 1), ("6x9", 1), ("7x5", 2), ("8x6", 2), ("5x5", 2), ("6x6", 4)],
)
def test_chessboard_symmetries(text: str, turns: int) -> None:
    assert len(parse_board(f"chessboard:{text},square=1").symmetries) == turns


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("charucco:5x7", "'charucco:5x7' is not a board or marker; expected one such as charuco:5x7"),
        ("chessboard", "'chessboard' is not a board or marker"),
        ("chessboard:9x6", "square is missing; expected one such as chessboard:9x6,square=25mm"),
        (
            "chessboard:9by6,square=1",
            "columns and rows of inner corners are expected, such as 9x6, 3 to 100 each, got '9by6'",
        ),
        ("chessboard:2x6,square=1", "3 to 100 each"),
        ("chessboard:900x6,square=1", "3 to 100 each"),
        ("chessboard:9x6,square=0", "square must be a positive length such as 0.04 or 40mm, got '0'"),
        ("chessboard:9x6,square=nan", "square must be a positive length"),
        ("chessboard:9x6,square=1e99", "square must be a positive length"),
        ("chessboard:9x6,square=-1", "square must be a positive length"),
        ("chessboard:9x6,square=1parsec", "square: 'parsec' is not a unit of length (m, cm, mm, um, in, ft)"),
        ("chessboard:9x6,square=1,squares=2", "it has no 'squares' (known are square)"),
        ("chessboard:9x6,square", "KEY=VALUE is expected between the commas, got 'square'"),
        ("chessboard:9x6,square=1,Square=1", "'Square' is given twice"),
        ("charuco:5x7,square=1,marker=2,dict=4X4_50", "marker must be smaller than square"),
        ("charuco:5x7,square=1,marker=0.5", "a dictionary of markers is expected, such as 4X4_50, "),
        ("charuco:5x7,square=1,marker=0.5,dict=4X4_51", "got '4X4_51'"),
        ("acircles:4x10,spacing=1,diameter=0.5", "an odd number of rows is required"),
        ("circles:4x10,spacing=1,diameter=2", "diameter must be less than the distance between"),
        ("apriltag:36h12,id=1,size=1", "a dictionary of markers is expected"),
        ("apriltag:36h11,size=1", "id is missing"),
        ("apriltag:36h11,id=-1,size=1", "id must be a whole number from 0 to 10000, got '-1'"),
        ("apriltag:36h11,id=1,size=1,border=0", "border must be a whole number from 1 to 4, got '0'"),
        ("aprilgrid:6x6,size=1", "gap must be the space between two tags by a tag's size"),
        ("aprilgrid:6x6,size=1,gap=x", "gap must be the space between two tags by a tag's size"),
        ("chessboard:9x6,square=\x1b[31m", "square must be a positive length"),
    ],
)
def test_errors_are_one_sentence(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)) as caught:
        parse_board(text, "m")
    assert str(caught.value).isprintable()


def test_lengths_require_calibration_unit() -> None:
    assert parse_length("40mm", "square", "m") == pytest.approx(0.04)
    assert parse_length("1 in", "square", "cm") == pytest.approx(2.54)
    assert parse_length("0.04", "square", "") == 0.04
    with pytest.raises(ValueError, match="square is in mm, but the calibration has no unit"):
        parse_length("40mm", "square", "")
