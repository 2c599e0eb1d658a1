"""MC-Calib and CMU Panoptic: files as these programs write them, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sylpose.geometry.arrays import FloatArray
from sylpose.io import calibration
from tests.io.calibration.reference_projections import (
    OTHER_TURN,
    TURN,
    apply_brown,
    apply_equidistant,
    assert_projects,
    points_in_front,
    write_file,
)

SHIFT = np.array([0.7, -0.2, 0.1])


def format_matrix(key: str, values: FloatArray) -> str:
    rows, columns = values.shape
    data = ", ".join(map(repr, values.ravel().tolist()))
    return (
        f"   {key}: !!opencv-matrix\n      rows: {rows}\n      cols: {columns}\n      dt: d\n      data: [ {data} ]\n"
    )


def format_mc_calib(group: int = 0, lens_type: int = 1) -> str:
    """Format calibrated_cameras_data.yml of a standard camera and a fisheye, posed in the first one's frame."""
    pose = np.eye(4)
    pose[:3] = np.column_stack([TURN, SHIFT])
    matrix = np.array([[800.5, 0, 321.0], [0, 801.5, 241.0], [0, 0, 1]])
    text = "%YAML:1.0\n---\nnb_camera: 2\n"
    lenses = ((0, [0.01, -0.02, 0.001, 0.002, 0.003]), (lens_type, [0.02, -0.01, 0.003, 0.001]))
    for k, ((kind, terms), world_from_camera) in enumerate(zip(lenses, (np.eye(4), pose), strict=True)):
        text += f"camera_{k}:\n" + format_matrix("camera_matrix", matrix)
        text += format_matrix("distortion_vector", np.array([terms]))
        text += f"   distortion_type: {kind}\n   camera_group: {group * k}\n   img_width: 640\n   img_height: 480\n"
        text += format_matrix("camera_pose_matrix", world_from_camera)
    return text


def test_mc_calib(tmp_path: Path) -> None:
    path = write_file(tmp_path / "calibrated_cameras_data.yml", format_mc_calib())
    rig = calibration.load(path)
    assert calibration.format_name(path) == "MC-Calib"
    assert rig.names == ("camera_0", "camera_1")
    assert [camera.lens for camera in rig] == ["opencv", "fisheye"]

    def first(point: FloatArray) -> tuple[float, float]:
        x, y = apply_brown(point[0] / point[2], point[1] / point[2], [0.01, -0.02, 0.003], [0.001, 0.002])
        return 800.5 * x + 321.0, 801.5 * y + 241.0

    def second(point: FloatArray) -> tuple[float, float]:
        a, b, c = TURN.T @ (point - SHIFT)
        x, y = apply_equidistant(a / c, b / c, [0.02, -0.01, 0.003, 0.001])
        return 800.5 * x + 321.0, 801.5 * y + 241.0

    assert_projects(rig["camera_0"], points_in_front(np.eye(3), np.zeros(3)), first)
    assert_projects(rig["camera_1"], points_in_front(TURN.T, -TURN.T @ SHIFT), second)
    np.testing.assert_allclose(rig["camera_1"].center, SHIFT, atol=1e-12)


def test_mc_calib_folder(tmp_path: Path) -> None:
    """The files of boards next to it are not calibrations of cameras."""
    path = write_file(tmp_path / "calibrated_cameras_data.yml", format_mc_calib())
    for name in ("calibrated_objects_data.yml", "calibrated_objects_pose_data.yml", "detected_keypoints_data.yml"):
        write_file(tmp_path / name, "%YAML:1.0\n---\nobject_0:\n   points: 3\n")
    assert calibration.find(tmp_path) == path
    assert calibration.load(tmp_path).names == ("camera_0", "camera_1")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (format_mc_calib(group=1), "MC-Calib found no pose between its 2 groups of cameras, camera_0 and camera_1"),
        (format_mc_calib(lens_type=2), "camera camera_1: distortion_type must be 0 .* or 1 .*, got 2"),
        (format_mc_calib().replace("camera_pose_matrix", "pose", 1), "camera camera_0: missing 'camera_pose_matrix'"),
        (format_mc_calib().replace("img_width: 640", "img_width: 0", 1), "camera camera_0: the size"),
    ],
)
def test_invalid_mc_calib_is_rejected(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"c\.yml: .*{message}"):
        calibration.load(write_file(tmp_path / "c.yml", text))


def make_panoptic(**changes: Any) -> dict[str, Any]:
    """Return two cameras as in calibration_171204_pose1.json."""
    first = {"name": "00_00", "type": "hd", "resolution": [1920, 1080], "panel": 0, "node": 0}
    first |= {"K": [[1395.5, 0, 951.25], [0, 1392.75, 561.5], [0, 0, 1]]}
    first |= {"distCoef": [-0.23, 0.21, 0.001, -0.0005, -0.014], "R": TURN.tolist(), "t": [[-50.0], [143.5], [278.25]]}
    second = first | {"name": "01_02", "type": "vga", "panel": 1, "node": 2, "R": OTHER_TURN.tolist()} | changes
    return {"calibDataSource": "160422_calib_norm", "cameras": [first, second]}


def test_panoptic(tmp_path: Path) -> None:
    path = write_file(tmp_path / "calibration_171204_pose1.json", json.dumps(make_panoptic()))
    rig = calibration.load(path)
    assert (calibration.format_name(path), rig.names, rig.unit) == ("CMU Panoptic", ("00_00", "01_02"), "cm")
    shift = np.array([-50.0, 143.5, 278.25])
    for name, turn in (("00_00", TURN), ("01_02", OTHER_TURN)):

        def pixel(point: FloatArray, turn: FloatArray = turn) -> tuple[float, float]:
            a, b, c = turn @ point + shift
            x, y = apply_brown(a / c, b / c, [-0.23, 0.21, -0.014], [0.001, -0.0005])
            return 1395.5 * x + 951.25, 1392.75 * y + 561.5

        assert_projects(rig[name], points_in_front(turn, shift), pixel)


def test_invalid_panoptic_is_rejected(tmp_path: Path) -> None:
    for changes, message in (({"distCoef": [1, 2]}, "2 distortion terms"), ({"R": None}, "missing key 'R'")):
        with pytest.raises(ValueError, match=f"camera 01_02: {message}"):
            calibration.load(write_file(tmp_path / "c.json", json.dumps(make_panoptic(**changes))))
