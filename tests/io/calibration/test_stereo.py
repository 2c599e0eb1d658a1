"""OpenCV stereo calibrations: output of its sample, in two files or one, and common variants."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.io import calibration
from sylpose.rig import Rig
from tests.io.calibration.reference_projections import (
    OTHER_TURN,
    TURN,
    apply_brown,
    assert_projects,
    points_in_front,
    write_file,
)

# Output of samples/cpp/stereo_calib.cpp.
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


def format_extrinsics() -> str:
    """Format extrinsics with rectification matrices, which must not be mistaken for poses."""
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, matrix in [("R", TURN), ("T", SHIFT[:, None]), ("R1", OTHER_TURN), ("R2", OTHER_TURN.T)]:
        storage.write(name, np.ascontiguousarray(matrix))
    for name in ("P1", "P2"):
        storage.write(name, np.ones((3, 4)))
    storage.write("Q", np.eye(4))
    return str(storage.releaseAndGetString())


def lookup_sizes(names: Any) -> dict[str, tuple[int, int]]:
    return dict.fromkeys(names, SIZE)


def first(point: FloatArray) -> tuple[float, float]:
    x, y = apply_brown(point[0] / point[2], point[1] / point[2], [-0.28, 0.1, -0.02], [0.001, -0.002])
    return 536.5 * x + 342.25, 537.5 * y + 235.5


def second(point: FloatArray) -> tuple[float, float]:
    a, b, c = (sum(TURN[i, j] * point[j] for j in range(3)) + SHIFT[i] for i in range(3))
    x, y = apply_brown(a / c, b / c, [-0.29, 0.11, 0.01], [-0.001, 0.003])
    return 542.0 * x + 327.5, 541.5 * y + 248.25


def check(rig: Rig, names: tuple[str, str] = ("1", "2")) -> None:
    assert rig.names == names
    assert_projects(rig.cameras[0], points_in_front(np.eye(3), np.zeros(3)), first)
    assert_projects(rig.cameras[1], points_in_front(TURN, SHIFT), second)


@pytest.mark.parametrize("given", ["intrinsics.yml", "extrinsics.yml"])
def test_two_files(given: str, tmp_path: Path) -> None:
    write_file(tmp_path / "intrinsics.yml", INTRINSICS)
    write_file(tmp_path / "extrinsics.yml", format_extrinsics())
    check(calibration.load(tmp_path / given, lookup_sizes))
    assert calibration.format_name(tmp_path / given) == "OpenCV stereo"


def test_one_file(tmp_path: Path) -> None:
    text = INTRINSICS + format_extrinsics().partition("---\n")[2]
    check(calibration.load(write_file(tmp_path / "stereo.yml", text), lookup_sizes))
    check(calibration.load(write_file(tmp_path / "stereo.yml", text + "image_width: 640\nimage_height: 480\n")))


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
def test_key_variants(a: str, b: str, c: str, d: str, names: tuple[str, str], tmp_path: Path) -> None:
    check(calibration.load(write_file(tmp_path / "a.json", json.dumps(dictionary((a, b, c, d))))), names)


def test_more_cameras_with_own_poses(tmp_path: Path) -> None:
    data = dictionary() | {"K3": dictionary()["K2"], "D3": dictionary()["D2"]}
    data |= {"R1": np.eye(3).tolist(), "T1": [0, 0, 0], "R2": TURN.tolist(), "T2": SHIFT.tolist()}
    data |= {"R3": TURN.tolist(), "T3": SHIFT.tolist()}
    rig = calibration.load(write_file(tmp_path / "a.json", json.dumps(data)))
    assert rig.names == ("1", "2", "3")
    assert_projects(rig["3"], points_in_front(TURN, SHIFT), second)
    del data["T3"]
    with pytest.raises(ValueError, match=r"a\.json: 3 camera matrices and one R and T"):
        calibration.load(write_file(tmp_path / "a.json", json.dumps(data)))


@pytest.mark.parametrize(
    ("missing", "added", "message"),
    [
        ({"R", "T"}, {}, "this is one of two files of an OpenCV stereo calibration, camera matrices without R and T; "),
        (
            {"R", "T"},
            {"R1": [0, 0, 0], "R2": [0, 0, 0]},
            r"R1 and R2 only rectify images\); it requires R and T",
        ),
        (
            {"K1", "K2", "D1", "D2"},
            {},
            "R and T alone; it requires camera matrices and lenses .*intrinsics.yml next to it",
        ),
        ({"D2"}, {}, "camera 2: no distortion next to 'K2'"),
        ({"imageSize"}, {}, "has no image size of 1, 2"),
        (set(), {"xi1": 0.5}, "xi1: cv2.omnidir's model is not supported"),
        ({"K2"}, {"K2": 3}, "camera 2: the matrix must be 3x3"),
        ({"R"}, {"R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "camera 2: .* a reflection"),
    ],
)
def test_invalid_stereo_files_are_rejected(
    missing: set[str], added: dict[str, Any], message: str, tmp_path: Path
) -> None:
    data = {key: value for key, value in dictionary().items() if key not in missing} | added
    with pytest.raises(ValueError, match=rf"stereo\.json: .*{message}"):
        calibration.load(write_file(tmp_path / "stereo.json", json.dumps(data)))


def test_camera_nodes_with_pose_are_not_stereo(tmp_path: Path) -> None:
    """Camera nodes, and R and T of something else."""
    node = {"K": dictionary()["K1"], "D": dictionary()["D1"], "size": SIZE, "R": [0, 0, 0], "T": [0, 0, 1]}
    data = {"left": node, "right": node, "R": [0.1, 0, 0], "T": [1, 2, 3]}
    assert calibration.format_name(write_file(tmp_path / "a.json", json.dumps(data))) == "OpenCV FileStorage"


def test_fisheye(tmp_path: Path) -> None:
    data = dictionary() | {"D1": [0.1, 0.01, 0, 0], "D2": [0.1, 0, 0, 0.02], "fisheye": True}
    rig = calibration.load(write_file(tmp_path / "a.json", json.dumps(data)))
    assert [camera.lens for camera in rig] == ["fisheye", "fisheye"]


# Arrays of NumPy and Matlab


def make_arrays(**changes: Any) -> dict[str, Any]:
    """Return VIAME's arrays: calibration_matrices.npz."""
    matrix = np.array([[500.5, 0, 320.25], [0, 501.5, 240.5], [0, 0, 1]])
    arrays = {"cameraMatrixL": matrix, "cameraMatrixR": matrix + np.diag([10, 20, 0]), "R": TURN}
    lens = np.array([[-0.1, 0.02, 0.001, -0.002, 0.01]])
    arrays |= {"distCoeffsL": lens, "distCoeffsR": -lens, "T": np.array([[-0.5], [0.25], [0.1]])}
    return {key: value for key, value in (arrays | changes).items() if value is not None}


def make_bouguet(**changes: Any) -> dict[str, Any]:
    """Return the variables of Calib_Results_stereo.mat."""
    data = {"nx": 640, "ny": 480, "om": Rotation.from_matrix(TURN).as_rotvec().reshape(3, 1), "dX": 30.0}
    for side, k, sign in (("left", 0, 1), ("right", 1, -1)):
        data |= {
            f"fc_{side}": np.array([[500.5 + 10 * k], [501.5 + 20 * k]]),
            f"cc_{side}": np.array([[320.25], [240.5]]),
        }
        data |= {f"kc_{side}": sign * np.array([[-0.1], [0.02], [0.001], [-0.002], [0.01]]), f"alpha_c_{side}": 0.0}
    data |= {"T": np.array([[-0.5], [0.25], [0.1]])}
    return {key: value for key, value in (data | changes).items() if value is not None}


def check_arrays(path: Path) -> None:
    rig = calibration.load(path, lambda names: dict.fromkeys(names, (640, 480)))
    assert (calibration.format_name(path), rig.names) == ("stereo arrays", ("left", "right"))
    shift = np.array([-0.5, 0.25, 0.1])
    for k, (name, turn, t, sign) in enumerate((("left", np.eye(3), np.zeros(3), 1), ("right", TURN, shift, -1))):

        def pixel(point: FloatArray, k: int = k, turn: Any = turn, t: Any = t, sign: int = sign) -> tuple[float, float]:
            a, b, c = turn @ point + t
            x, y = apply_brown(a / c, b / c, [-sign * 0.1, sign * 0.02, sign * 0.01], [sign * 0.001, -sign * 0.002])
            return (500.5 + 10 * k) * x + 320.25, (501.5 + 20 * k) * y + 240.5

        assert rig[name].size == (640, 480)
        assert_projects(rig[name], points_in_front(turn, t), pixel)


def test_arrays_of_numpy_and_matlab(tmp_path: Path) -> None:
    np.savez(tmp_path / "calibration_matrices.npz", **make_arrays())
    by_columns: dict[str, Any] = {key: np.asfortranarray(value) for key, value in make_arrays().items()}
    np.savez_compressed(tmp_path / "by_columns.npz", **by_columns)
    savemat(tmp_path / "calibration.mat", make_arrays())
    savemat(tmp_path / "Calib_Results_stereo.mat", make_bouguet(), do_compression=True)
    savemat(tmp_path / "viame.mat", {"Cal": make_bouguet()})
    for path in sorted(tmp_path.iterdir()):
        check_arrays(path)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (make_arrays(T=None), "camera matrices without R and T|it requires R and T"),
        (make_arrays(distCoeffsR=None), "camera right: no distortion next to"),
        (make_bouguet(alpha_c_left=0.01), "camera left: the matrix has skew"),
        (make_bouguet(fc_left=np.ones(3)), "fc_left must be 2 numbers"),
        (make_bouguet(om=None), "camera matrices without R and T|it requires R and T"),
    ],
)
def test_invalid_arrays_are_rejected(data: dict[str, Any], message: str, tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", data)
    with pytest.raises(ValueError, match=message):
        calibration.load(tmp_path / "a.mat", lambda names: dict.fromkeys(names, (640, 480)))


def test_arrays_of_objects_are_not_loaded(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **make_arrays(R=np.array([{}], dtype=object)))
    with pytest.raises(ValueError, match="NumPy arrays have no standard names"):
        calibration.load(tmp_path / "a.npz")
