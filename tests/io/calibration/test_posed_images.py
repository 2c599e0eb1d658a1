"""BOP's scene_camera.json and the cameras.json of 3D Gaussian splatting."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sylpose.geometry.arrays import FloatArray
from sylpose.io import calibration
from tests.io.calibration.reference_projections import OTHER_TURN, TURN, assert_projects, points_in_front, write_file

SHIFTS = (np.array([-120.5, 3.25, 515.0]), np.array([20.0, -8.5, 610.25]))
TURNS = (TURN, OTHER_TURN)
SIZE = (640, 480)


def make_bop(k: int, **changes: Any) -> dict[str, Any]:
    """Return the entry of an image in scene_camera.json."""
    node = {
        "cam_K": [572.5, 0.0, 325.25, 0.0, 573.5, 242.0, 0.0, 0.0, 1.0],
        "cam_R_w2c": TURNS[k].ravel().tolist(),
        "cam_t_w2c": SHIFTS[k].tolist(),
        "depth_scale": 0.1,
    }
    return {key: value for key, value in (node | changes).items() if value is not None}


def known_sizes(names: Any) -> dict[str, tuple[int, int]]:
    return dict.fromkeys(names, SIZE)


def check_bop(path: Path, names: tuple[str, ...], with_sizes: bool = True) -> None:
    rig = calibration.load(path, known_sizes if with_sizes else None)
    assert (calibration.format_name(path), rig.names, rig.unit) == ("BOP scene_camera", names, "mm")
    for k, camera in enumerate(rig):

        def pixel(point: FloatArray, k: int = k) -> tuple[float, float]:
            a, b, c = TURNS[k] @ point + SHIFTS[k]
            return 572.5 * a / c + 325.25, 573.5 * b / c + 242.0

        assert camera.size == SIZE
        assert_projects(camera, points_in_front(TURNS[k], SHIFTS[k]), pixel)


def test_bop(tmp_path: Path) -> None:
    """Each image is a camera; its size is that of the dataset's camera.json."""
    scene = tmp_path / "lm" / "test" / "000001"
    path = write_file(scene / "scene_camera.json", json.dumps({"0": make_bop(0), "12": make_bop(1)}))
    check_bop(path, ("000000", "000012"))
    camera = {"cx": 325.25, "cy": 242.0, "fx": 572.5, "fy": 573.5, "depth_scale": 0.1, "width": 640, "height": 480}
    write_file(tmp_path / "lm" / "camera.json", json.dumps(camera))
    check_bop(path, ("000000", "000012"), with_sizes=False)


def test_bop_of_static_cameras_without_names(tmp_path: Path) -> None:
    """Images of the same lens and pose are one camera, named by the number of its lens."""
    other = [500.0, 0, 320, 0, 500, 240, 0, 0, 1]
    scene = {str(image): make_bop(image % 2, **({"cam_K": other} if image % 2 else {})) for image in range(4)}
    rig = calibration.load(write_file(tmp_path / "scene_camera.json", json.dumps(scene)), known_sizes)
    assert rig.names == ("0", "1")
    np.testing.assert_allclose(rig["1"].camera_from_world.translation, SHIFTS[1], atol=1e-12)


def test_bop_of_several_sensors(tmp_path: Path) -> None:
    """Scenes with a file of each sensor have static cameras, with any number of images."""
    for k, sensor in enumerate(("cam1", "cam2")):
        scene = {str(image): make_bop(k) for image in range(3)}
        write_file(tmp_path / f"scene_camera_{sensor}.json", json.dumps(scene))
    check_bop(tmp_path / "scene_camera_cam2.json", ("cam1", "cam2"))
    check_bop(tmp_path, ("cam1", "cam2"))
    moved = {"0": make_bop(0), "1": make_bop(1)}
    write_file(tmp_path / "scene_camera_cam1.json", json.dumps(moved))
    with pytest.raises(ValueError, match="camera cam1: its 2 images do not have one pose"):
        calibration.load(tmp_path / "scene_camera_cam2.json", known_sizes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cam_R_w2c": None}, "000001: missing cam_R_w2c: this BOP scene has no poses of its cameras"),
        ({"cam_K": None}, "000001: missing cam_K"),
        ({"cam_K": [1, 2]}, "000001: cam_K must be 9 numbers"),
        ({"cam_t_w2c": ["a", 0, 0]}, "000001: cam_t_w2c must be numbers"),
    ],
)
def test_invalid_bop_is_rejected(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = write_file(tmp_path / "scene_camera.json", json.dumps({"0": make_bop(0), "1": make_bop(1, **changes)}))
    with pytest.raises(ValueError, match=rf"scene_camera\.json: .*{message}"):
        calibration.load(path, known_sizes)


# 3D Gaussian splatting


def make_splat(k: int, name: str, **changes: Any) -> dict[str, Any]:
    """Return an entry as the program computes it: the inverse of camera_from_world."""
    pose = np.eye(4)
    pose[:3] = np.column_stack([TURNS[k], SHIFTS[k]])
    inverse = np.linalg.inv(pose)
    node = {"id": k, "img_name": name, "width": 641, "height": 480, "fx": 500.5, "fy": 501.5}
    return node | {"position": inverse[:3, 3].tolist(), "rotation": inverse[:3, :3].tolist()} | changes


@pytest.mark.parametrize("names", [("a", "b"), ("left/0001.png", "right/0001.png")])
def test_splat(names: tuple[str, str], tmp_path: Path) -> None:
    nodes = [make_splat(k, name) for k, name in enumerate(names)]
    path = write_file(tmp_path / "cameras.json", json.dumps(nodes))
    rig = calibration.load(path)
    assert calibration.format_name(path) == "3D Gaussian splatting"
    assert rig.names == tuple(name.partition("/")[0] for name in names)
    for k, camera in enumerate(rig):

        def pixel(point: FloatArray, k: int = k) -> tuple[float, float]:
            a, b, c = TURNS[k] @ point + SHIFTS[k]
            return 500.5 * a / c + 641 / 2 - 0.5, 501.5 * b / c + 480 / 2 - 0.5

        assert camera.size == (641, 480)
        assert_projects(camera, points_in_front(TURNS[k], SHIFTS[k]), pixel)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rotation": np.ones((3, 3)).tolist()}, "camera b: the rotation is not a rotation matrix"),
        ({"position": [1, 2]}, "camera b: position must be 3 numbers"),
        ({"width": "wide"}, "camera b: width must be numbers"),
        ({"position": None}, "camera b: position has values that are not finite"),
    ],
)
def test_invalid_splat_is_rejected(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    nodes = [make_splat(0, "a"), make_splat(1, "b", **changes)]
    with pytest.raises(ValueError, match=message):
        calibration.load(write_file(tmp_path / "cameras.json", json.dumps(nodes)))


def test_splat_without_poses_is_rejected(tmp_path: Path) -> None:
    nodes = [{"img_name": "a", "width": 640, "height": 480}]
    with pytest.raises(ValueError, match=r"cameras\.json: image 0: missing fx, fy, rotation, position"):
        calibration.load(write_file(tmp_path / "cameras.json", json.dumps(nodes)))
