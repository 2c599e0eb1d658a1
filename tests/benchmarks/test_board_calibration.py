"""`benchmarks/board_calibration.py`: its scenes and measures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks.board_calibration import KINDS, Found, draw_scene, format_row, measure, run_stereo_chain


@pytest.mark.parametrize("kind", KINDS)
def test_scenes_have_corners_of_all_cameras(kind: str) -> None:
    rig, board, detections = draw_scene(kind, 0, 2, 14)
    assert all(sum(len(row[c].indices) > 0 for row in detections) > 6 for c in range(len(rig)))
    assert max(its.indices.max(initial=-1) for row in detections for its in row) < len(board.points)


def test_truth_has_no_error() -> None:
    rig, _, _ = draw_scene("noise", 0, 2, 1)
    found = measure(Found(rig, np.tile(np.eye(6), (2, 1, 1))), rig)
    assert all(max(values) < 1e-9 for values in found.values())


def test_opencv_calibrates_these_scenes() -> None:
    """The comparison is with a method that works."""
    rig, board, detections = draw_scene("noise", 0, 2, 14)
    found = measure(run_stereo_chain(rig, board, detections, flags=cv2.CALIB_USE_INTRINSIC_GUESS), rig)
    assert max(found["rotation"]) < 1.5
    row = {"kind": "noise", "method": "stereo", "failed": 0, "seconds": 1.0, "ratio": 1.0, "nees": None}
    row |= {f"{key}{end}": 1.0 for key in ("rotation", "center", "focal") for end in ("", "_max")}
    assert format_row(row).startswith("| noise | stereo | 1 / 1 |")
