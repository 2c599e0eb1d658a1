"""Kalibr camchains: chained poses, lenses by Kalibr's formulas, and invalid files."""

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

SHIFT, OTHER_SHIFT = np.array([-0.11, 0.02, 0.3]), np.array([0.05, -0.4, 0.1])


def format_matrix(turn: FloatArray, shift: FloatArray) -> str:
    """Format a matrix as in Kalibr's YAML files, one row per line."""
    rows = [*np.column_stack([turn, shift]).tolist(), [0.0, 0.0, 0.0, 1.0]]
    return "".join(f"  - {row}\n" for row in rows)


# Output of kalibr_calibrate_cameras.
CHAIN = f"""cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.29, 0.08, 0.0003, -0.0002]
  distortion_model: radtan
  intrinsics: [461.6, 460.3, 362.7, 246.5]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
{format_matrix(TURN, SHIFT)}  cam_overlaps: [0, 2]
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.02, -0.006, 0.001]
  distortion_model: equidistant
  intrinsics: [458.7, 457.3, 379.9, 255.2]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
cam2:
  T_cn_cnm1:
{format_matrix(OTHER_TURN, OTHER_SHIFT)}  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [400.0, 401.0, 320.0, 240.0]
  resolution: [640, 480]
"""


def transform_point(point: FloatArray, turn: FloatArray, shift: FloatArray) -> FloatArray:
    """Apply T_cn_cnm1 to a point of the previous camera."""
    return np.array([sum(turn[i, j] * point[j] for j in range(3)) + shift[i] for i in range(3)])


def cam0(point: FloatArray) -> tuple[float, float]:
    x, y = apply_brown(point[0] / point[2], point[1] / point[2], [-0.29, 0.08], [0.0003, -0.0002])
    return 461.6 * x + 362.7, 460.3 * y + 246.5


def cam1(point: FloatArray) -> tuple[float, float]:
    a, b, c = transform_point(point, TURN, SHIFT)
    x, y = apply_equidistant(a / c, b / c, [-0.01, 0.02, -0.006, 0.001])
    return 458.7 * x + 379.9, 457.3 * y + 255.2


def cam2(point: FloatArray) -> tuple[float, float]:
    a, b, c = transform_point(transform_point(point, TURN, SHIFT), OTHER_TURN, OTHER_SHIFT)
    return 400.0 * a / c + 320.0, 401.0 * b / c + 240.0


def test_chain(tmp_path: Path) -> None:
    rig = calibration.load(write_file(tmp_path / "camchain.yaml", CHAIN))
    assert rig.names == ("cam0", "cam1", "cam2")
    assert [camera.size for camera in rig] == [(752, 480), (752, 480), (640, 480)]
    assert_projects(rig["cam0"], points_in_front(np.eye(3), np.zeros(3)), cam0)
    assert_projects(rig["cam1"], points_in_front(TURN, SHIFT), cam1)
    last = OTHER_TURN @ TURN, OTHER_TURN @ SHIFT + OTHER_SHIFT
    assert_projects(rig["cam2"], points_in_front(*last), cam2)


def test_cameras_are_ordered_by_number(tmp_path: Path) -> None:
    """Ten cameras: cam10 comes after cam9, not after cam1."""
    first, _, rest = CHAIN.partition("cam1:\n")
    second = "cam1:\n" + rest.partition("cam2:\n")[0]
    more = [second.replace("cam1", f"cam{i}") for i in range(1, 11)]
    rig = calibration.load(write_file(tmp_path / "camchain.yaml", first + "".join(sorted(more))))
    assert rig.names == tuple(f"cam{i}" for i in range(11))
    step = np.eye(4)
    step[:3] = np.column_stack([TURN, SHIFT])
    for k, camera in enumerate(rig):
        np.testing.assert_allclose(camera.camera_from_world.as_matrix(), np.linalg.matrix_power(step, k), atol=1e-12)


def test_imu(tmp_path: Path) -> None:
    """Without a chain, poses come from the IMU's pose in each camera."""
    text = CHAIN.replace("T_cn_cnm1", "T_cam_imu").partition("cam2:\n")[0]
    text = text.replace("cam0:\n", f"cam0:\n  T_cam_imu:\n{format_matrix(OTHER_TURN, OTHER_SHIFT)}")
    rig = calibration.load(write_file(tmp_path / "camchain-imucam.yaml", text))
    assert_projects(rig["cam1"], points_in_front(TURN, SHIFT), cam1)
    points = points_in_front(OTHER_TURN, OTHER_SHIFT)
    assert_projects(rig["cam0"], points, lambda point: cam0(transform_point(point, OTHER_TURN, OTHER_SHIFT)))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("T_cn_cnm1", "T_x", "this is a Kalibr camchain without T_cn_cnm1 of cam1, cam2, "),
        (
            "camera_model: pinhole",
            "camera_model: ds",
            r"camera cam0: camera_model 'ds' \(double sphere\) is not supported",
        ),
        ("camera_model: pinhole", "camera_model: omni", r"camera_model 'omni' \(omnidirectional\)"),
        ("radtan", "fov", r"camera cam0: distortion_model 'fov' \(FOV\) is not supported"),
        ("resolution", "size", "camera cam0: missing key 'resolution'"),
        ("distortion_coeffs: [-0.29", "distortion: [-0.29", "camera cam0: missing key 'distortion_coeffs'"),
        ("[461.6, ", "[0.5, 461.6, ", "camera cam0: intrinsics must be 4 numbers, got 5"),
        (", 0.0003,", ",", "camera cam0: distortion_coeffs must be 4 numbers, got 3"),
        ("- [0.0, 0.0, 0.0, 1.0]", "- [0.0, 0.0, 1.0, 1.0]", "camera cam1: T_cn_cnm1 must be a 3x4 or 4x4 matrix"),
        ("camera_model", "model", "this is a Kalibr file of poses without lenses"),
    ],
)
def test_invalid_camchains_are_rejected(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in CHAIN
    with pytest.raises(ValueError, match=rf"camchain\.yaml: .*{message}"):
        calibration.load(write_file(tmp_path / "camchain.yaml", CHAIN.replace(old, new)))


def test_single_camera_is_rejected(tmp_path: Path) -> None:
    lens: dict[str, Any] = {"camera_model": "pinhole", "intrinsics": [1, 1, 0, 0], "resolution": [6, 4]}
    with pytest.raises(ValueError, match="this is a Kalibr file of one camera's lens alone"):
        calibration.load(write_file(tmp_path / "a.json", json.dumps(lens)))
