"""OpenCV's stereo calibrations: what its sample writes, in two files or one, and what people write like it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sylpose import calibration
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from tests.calibration.reference_projections import OTHER_TURN, TURN, assert_projects, brown, in_front, write

# As samples/cpp/stereo_calib.cpp writes them.
INTRINSICS = """%YAML:1.0
---
M1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 536.5, 0., 342.25, 0., 537.5, 235.5, 0., 0., 1. ]
D1: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.28, 0.1, 0.001, -0.002, -0.02 ]
M2: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 542., 0., 327.5, 0., 541.5, 248.25, 0., 0., 1. ]
D2: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.29, 0.11, -0.001, 0.003, 0.01 ]
"""
SHIFT = np.array([-3.25, 0.5, 0.75])
SIZE = (640, 480)


def extrinsics() -> str:
    """With the matrices of rectification, which must not be mistaken for poses."""
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, matrix in [("R", TURN), ("T", SHIFT[:, None]), ("R1", OTHER_TURN), ("R2", OTHER_TURN.T)]:
        storage.write(name, np.ascontiguousarray(matrix))
    for name in ("P1", "P2"):
        storage.write(name, np.ones((3, 4)))
    storage.write("Q", np.eye(4))
    return str(storage.releaseAndGetString())


def sizes(names: Any) -> dict[str, tuple[int, int]]:
    return dict.fromkeys(names, SIZE)


def first(point: FloatArray) -> tuple[float, float]:
    x, y = brown(point[0] / point[2], point[1] / point[2], [-0.28, 0.1, -0.02], [0.001, -0.002])
    return 536.5 * x + 342.25, 537.5 * y + 235.5


def second(point: FloatArray) -> tuple[float, float]:
    a, b, c = (sum(TURN[i, j] * point[j] for j in range(3)) + SHIFT[i] for i in range(3))
    x, y = brown(a / c, b / c, [-0.29, 0.11, 0.01], [-0.001, 0.003])
    return 542.0 * x + 327.5, 541.5 * y + 248.25


def check(rig: Rig, names: tuple[str, str] = ("1", "2")) -> None:
    assert rig.names == names
    assert_projects(rig.cameras[0], in_front(np.eye(3), np.zeros(3)), first)
    assert_projects(rig.cameras[1], in_front(TURN, SHIFT), second)


@pytest.mark.parametrize("given", ["intrinsics.yml", "extrinsics.yml"])
def test_two_files(given: str, tmp_path: Path) -> None:
    write(tmp_path / "intrinsics.yml", INTRINSICS)
    write(tmp_path / "extrinsics.yml", extrinsics())
    check(calibration.load(tmp_path / given, sizes))
    assert calibration.format_of(tmp_path / given) == "OpenCV stereo"


def test_one_file(tmp_path: Path) -> None:
    text = INTRINSICS + extrinsics().partition("---\n")[2]
    check(calibration.load(write(tmp_path / "stereo.yml", text), sizes))
    check(calibration.load(write(tmp_path / "stereo.yml", text + "image_width: 640\nimage_height: 480\n")))


NAMES = [
    ("K1", "D1", "K2", "D2", ("1", "2")),
    ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2", ("1", "2")),
    ("camera_matrix_left", "dist_coeffs_left", "camera_matrix_right", "dist_coeffs_right", ("left", "right")),
    ("mtxL", "distL", "mtxR", "distR", ("left", "right")),
]


def dictionary(keys: tuple[str, str, str, str] = ("K1", "D1", "K2", "D2")) -> dict[str, Any]:
    first_matrix, first_lens, second_matrix, second_lens = keys
    return {
        first_matrix: [[536.5, 0, 342.25], [0, 537.5, 235.5], [0, 0, 1]],
        first_lens: [-0.28, 0.1, 0.001, -0.002, -0.02],
        second_matrix: [[542, 0, 327.5], [0, 541.5, 248.25], [0, 0, 1]],
        second_lens: [[-0.29, 0.11, -0.001, 0.003, 0.01]],
        "R": TURN.tolist(),
        "T": SHIFT[:, None].tolist(),
        "imageSize": SIZE,
    }


@pytest.mark.parametrize(("a", "b", "c", "d", "names"), NAMES)
def test_other_names(a: str, b: str, c: str, d: str, names: tuple[str, str], tmp_path: Path) -> None:
    check(calibration.load(write(tmp_path / "a.json", json.dumps(dictionary((a, b, c, d))))), names)


def test_more_cameras_with_poses_of_their_own(tmp_path: Path) -> None:
    data = dictionary() | {"K3": dictionary()["K2"], "D3": dictionary()["D2"]}
    data |= {"R1": np.eye(3).tolist(), "T1": [0, 0, 0], "R2": TURN.tolist(), "T2": SHIFT.tolist()}
    data |= {"R3": TURN.tolist(), "T3": SHIFT.tolist()}
    rig = calibration.load(write(tmp_path / "a.json", json.dumps(data)))
    assert rig.names == ("1", "2", "3")
    assert_projects(rig["3"], in_front(TURN, SHIFT), second)
    del data["T3"]
    with pytest.raises(ValueError, match=r"a\.json: 3 camera matrices and one R and T"):
        calibration.load(write(tmp_path / "a.json", json.dumps(data)))


@pytest.mark.parametrize(
    ("missing", "added", "message"),
    [
        ({"R", "T"}, {}, "this is one of two files of an OpenCV stereo calibration, camera matrices without R and T; "),
        (
            {"R", "T"},
            {"R1": [0, 0, 0], "R2": [0, 0, 0]},
            r"R1 and R2 are those that rectify images\); needed are R and T",
        ),
        (
            {"K1", "K2", "D1", "D2"},
            {},
            "R and T alone; needed are camera matrices and lenses .*intrinsics.yml beside it",
        ),
        ({"D2"}, {}, "camera 2: no distortion beside 'K2'"),
        ({"imageSize"}, {}, "does not say how large the images of 1, 2 are"),
        (set(), {"xi1": 0.5}, "xi1: cv2.omnidir's model is none that sylpose has"),
        ({"K2"}, {"K2": 3}, "camera 2: the matrix must be 3x3"),
        ({"R"}, {"R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "camera 2: .* a reflection"),
    ],
)
def test_what_cannot_be_used(missing: set[str], added: dict[str, Any], message: str, tmp_path: Path) -> None:
    data = {key: value for key, value in dictionary().items() if key not in missing} | added
    with pytest.raises(ValueError, match=rf"stereo\.json: .*{message}"):
        calibration.load(write(tmp_path / "stereo.json", json.dumps(data)))


def test_cameras_beside_a_pose_are_no_stereo(tmp_path: Path) -> None:
    """Nodes of cameras, and R and T of something else."""
    node = {"K": dictionary()["K1"], "D": dictionary()["D1"], "size": SIZE, "R": [0, 0, 0], "T": [0, 0, 1]}
    data = {"left": node, "right": node, "R": [0.1, 0, 0], "T": [1, 2, 3]}
    assert calibration.format_of(write(tmp_path / "a.json", json.dumps(data))) == "OpenCV FileStorage"


def test_fisheye(tmp_path: Path) -> None:
    data = dictionary() | {"D1": [0.1, 0.01, 0, 0], "D2": [0.1, 0, 0, 0.02], "fisheye": True}
    rig = calibration.load(write(tmp_path / "a.json", json.dumps(data)))
    assert [camera.lens for camera in rig] == ["fisheye", "fisheye"]
