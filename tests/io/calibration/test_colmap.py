"""COLMAP models, text and binary, and rig_config: formulas, pixels beginning at 0.5, one pose per camera."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.io import calibration
from sylpose.rig import Rig
from tests.io.calibration.reference_projections import assert_projects, points_in_front, write_file

CAMERAS = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 3
1 OPENCV 640 480 500.5 501.5 320.25 240.75 -0.1 0.02 0.001 -0.002
2 FULL_OPENCV 800 600 610 611 400 300 0.2 -0.1 0.001 0.002 0.03 0.1 -0.05 0.01
7 SIMPLE_RADIAL_FISHEYE 1024 768 450 512 384 0.05
"""
# QW QX QY QZ, TX TY TZ
POSES = {
    1: ([0.8, 0.4, -0.2, 0.4], [0.1, -0.2, 0.5]),
    2: ([-0.5, 0.1, 0.7, 0.5], [-1.0, 0.3, 2.0]),
    7: ([0.1, 0.5, -0.5, 0.7], [0.3, 1.2, -0.4]),
}


def format_images(names: dict[str, int], poses: dict[str, tuple[list[float], list[float]]] | None = None) -> str:
    """Format images.txt from lens IDs by image name; every second image has no points."""
    text = "# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
    for k, (name, camera) in enumerate(names.items()):
        q, t = (poses or {}).get(name, POSES[camera])
        text += " ".join(map(str, [k + 1, *q, *t, camera, name])) + "\n"
        text += "\n" if k % 2 else "320.5 17.25 -1 12.5 8 63390\n"
    return text


RIG = {"left/0.png": 1, "left/1.png": 1, "right/0.png": 2, "right/1.png": 2, "deep/down/top/0.png": 7}


def transform_point(camera: int, point: FloatArray) -> FloatArray:
    """Transform a point to the camera by COLMAP's documented formula of quaternion (w, x, y, z) and translation."""
    (w, x, y, z), t = POSES[camera]
    matrix = [
        [1 - 2 * y * y - 2 * z * z, 2 * x * y - 2 * w * z, 2 * x * z + 2 * w * y],
        [2 * x * y + 2 * w * z, 1 - 2 * x * x - 2 * z * z, 2 * y * z - 2 * w * x],
        [2 * x * z - 2 * w * y, 2 * y * z + 2 * w * x, 1 - 2 * x * x - 2 * y * y],
    ]
    return np.array([sum(matrix[i][j] * point[j] for j in range(3)) + t[i] for i in range(3)])


def left(point: FloatArray) -> tuple[float, float]:
    a, b, c = transform_point(1, point)
    u, v = a / c, b / c
    r2 = u * u + v * v
    radial = -0.1 * r2 + 0.02 * r2 * r2
    du = u * radial + 2 * 0.001 * u * v + -0.002 * (r2 + 2 * u * u)
    dv = v * radial + 2 * -0.002 * u * v + 0.001 * (r2 + 2 * v * v)
    return 500.5 * (u + du) + 320.25 - 0.5, 501.5 * (v + dv) + 240.75 - 0.5


def right(point: FloatArray) -> tuple[float, float]:
    a, b, c = transform_point(2, point)
    u, v = a / c, b / c
    r2 = u * u + v * v
    radial = (1 + 0.2 * r2 - 0.1 * r2**2 + 0.03 * r2**3) / (1 + 0.1 * r2 - 0.05 * r2**2 + 0.01 * r2**3)
    x = u * radial + 2 * 0.001 * u * v + 0.002 * (r2 + 2 * u * u)
    y = v * radial + 2 * 0.002 * u * v + 0.001 * (r2 + 2 * v * v)
    return 610 * x + 400 - 0.5, 611 * y + 300 - 0.5


def top(point: FloatArray) -> tuple[float, float]:
    a, b, c = transform_point(7, point)
    r = np.hypot(a, b)
    theta = np.arctan2(r, c)
    scale = (theta + 0.05 * theta**3) / r
    return 450 * scale * a + 512 - 0.5, 450 * scale * b + 384 - 0.5


def check(rig: Rig) -> None:
    assert rig.names == ("left", "right", "top")
    assert [camera.size for camera in rig] == [(640, 480), (800, 600), (1024, 768)]
    seen: list[tuple[int, Callable[[FloatArray], tuple[float, float]]]] = [(1, left), (2, right), (7, top)]
    for camera, (number, pixel) in zip(rig, seen, strict=True):
        shift = np.array(POSES[number][1])
        turn = np.column_stack([transform_point(number, axis) - shift for axis in np.eye(3)])
        assert_projects(camera, points_in_front(turn, shift), pixel)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    write_file(tmp_path / "model" / "cameras.txt", CAMERAS)
    write_file(tmp_path / "model" / "images.txt", format_images(RIG))
    write_file(tmp_path / "model" / "points3D.txt", "# 3D point list\n1 0 0 1 255 0 0 0.5 1 0\n")
    return tmp_path / "model"


def write_binary(folder: Path, names: dict[str, int]) -> None:
    """Write the same model in COLMAP's binary format: little endian, model IDs instead of names."""
    numbers = {"OPENCV": 4, "FULL_OPENCV": 6, "SIMPLE_RADIAL_FISHEYE": 8}
    lines = [line.split() for line in CAMERAS.splitlines() if line[0] != "#"]
    data = struct.pack("<Q", len(lines))
    for key, name, width, height, *params in lines:
        data += struct.pack("<IiQQ", int(key), numbers[name], int(width), int(height))
        data += struct.pack(f"<{len(params)}d", *map(float, params))
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(names))
    for k, (name, camera) in enumerate(names.items()):
        q, t = POSES[camera]
        data += struct.pack("<I7dI", k + 1, *q, *t, camera) + name.encode() + b"\0"
        data += struct.pack("<Q", 2) + 2 * struct.pack("<ddq", 1.5, 2.5, -1)
    (folder / "images.bin").write_bytes(data)


@pytest.mark.parametrize("given", ["", "cameras.txt", "images.txt", "points3D.txt"])
def test_text(given: str, model: Path) -> None:
    check(calibration.load(model / given))
    assert calibration.format_name(model / given) == "COLMAP model"


@pytest.mark.parametrize("given", ["", "cameras.bin", "images.bin"])
def test_binary(given: str, model: Path) -> None:
    for file in model.iterdir():
        file.unlink()
    write_binary(model, RIG)
    check(calibration.load(model / given))


def test_pycolmap_agrees(model: Path, tmp_path: Path) -> None:
    """Compare with pycolmap: its binary conversion of the text, with rigs and frames, and its projections."""
    pycolmap = pytest.importorskip("pycolmap")
    reconstruction = pycolmap.Reconstruction(model)
    (tmp_path / "binary").mkdir()
    reconstruction.write_binary(tmp_path / "binary")
    assert (tmp_path / "binary" / "frames.bin").exists()
    check(calibration.load(tmp_path / "binary"))


# Rigs and frames of COLMAP 3.12 and newer

RIGS = """# Rig calib list with one line of data per calib:
1 3 CAMERA 1 IMU 9 0 CAMERA 2 1 0.8 0.4 -0.2 0.4 0.1 -0.2 0.5
2 1 CAMERA 7
"""
FRAMES = """# Frame list with one line of data per frame:
1 1 -0.5 0.1 0.7 0.5 -1.0 0.3 2.0 3 CAMERA 1 1 IMU 9 77 CAMERA 2 2
5 2 0.1 0.5 -0.5 0.7 0.3 1.2 -0.4 1 CAMERA 7 3
"""


@pytest.fixture
def rig_model(model: Path) -> Path:
    """Return a model whose images file has stale poses: rigs and frames contain the right ones."""
    stale = {"left/0.png": 1, "right/0.png": 2, "top/0.png": 7}
    write_file(model / "images.txt", format_images(stale))
    write_file(model / "rigs.txt", RIGS)
    write_file(model / "frames.txt", FRAMES)
    return model


def to_matrix(quaternion: list[float], translation: list[float]) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix(), translation
    return matrix


def test_poses_are_composed_from_rigs_and_frames(rig_model: Path) -> None:
    """The sensor's pose in the rig times the rig's in the world replaces the stale pose of each image."""
    rig = calibration.load(rig_model)
    assert rig.names == ("left", "right", "top")
    world = to_matrix([-0.5, 0.1, 0.7, 0.5], [-1.0, 0.3, 2.0])
    sensor = to_matrix([0.8, 0.4, -0.2, 0.4], [0.1, -0.2, 0.5])
    for name, expected in (("left", world), ("right", sensor @ world), ("top", to_matrix(*POSES[7]))):
        np.testing.assert_allclose(rig[name].camera_from_world.as_matrix(), expected, atol=1e-14)


def test_pycolmap_composes_the_same_poses(rig_model: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    reconstruction = pycolmap.Reconstruction(rig_model)
    expected = {
        image.name.partition("/")[0]: image.cam_from_world().matrix() for image in reconstruction.images.values()
    }
    (tmp_path / "binary").mkdir()
    reconstruction.write_binary(tmp_path / "binary")
    # Stale poses in images.bin as well: those of the camera at the origin.
    data = (tmp_path / "binary" / "images.bin").read_bytes()
    for image in reconstruction.images.values():
        pose = image.cam_from_world()
        x, y, z, w = pose.rotation.quat
        data = data.replace(struct.pack("<7d", w, x, y, z, *pose.translation), struct.pack("<7d", 1, *[0] * 6))
    (tmp_path / "binary" / "images.bin").write_bytes(data)
    for folder in (rig_model, tmp_path / "binary"):
        rig = calibration.load(folder)
        assert set(rig.names) == set(expected)
        for camera in rig:
            np.testing.assert_allclose(camera.camera_from_world.as_matrix()[:3], expected[camera.name], atol=1e-12)


def test_moving_rig_is_read_in_its_own_frame(rig_model: Path) -> None:
    """A rig that was moved for its calibration: only the poses of its cameras in the rig matter."""
    names = {"left/0.png": 1, "right/0.png": 2, "left/1.png": 1, "right/1.png": 2}
    write_file(rig_model / "images.txt", format_images(names))
    write_file(rig_model / "rigs.txt", RIGS.splitlines()[1])
    frame = FRAMES.splitlines()[1]
    moved = frame.replace("1 1 -0.5 0.1 0.7 0.5 -1.0", "2 1 0.5 0.5 0.5 0.5 -9.0")
    write_file(rig_model / "frames.txt", f"{frame}\n{moved.replace('CAMERA 1 1', 'CAMERA 1 3').replace('2 2', '2 4')}")
    rig = calibration.load(rig_model)
    assert rig.names == ("left", "right")
    np.testing.assert_array_equal(rig["left"].camera_from_world.as_matrix(), np.eye(4))
    expected = to_matrix([0.8, 0.4, -0.2, 0.4], [0.1, -0.2, 0.5])
    np.testing.assert_allclose(rig["right"].camera_from_world.as_matrix(), expected, atol=1e-14)
    # Without rigs, such images are those of moving cameras.
    write_file(rig_model / "rigs.txt", "1 1 CAMERA 1\n2 1 CAMERA 2\n")
    two_rigs = (rig_model / "frames.txt").read_text().replace("3 CAMERA 1", "1 CAMERA 1")
    lines = [line.partition(" IMU")[0] for line in two_rigs.splitlines()]
    seconds = [
        line.replace("CAMERA 1 1", "CAMERA 2 2").replace("CAMERA 1 3", "CAMERA 2 4").replace("1 1 -0.5", "3 2 -0.5")
        for line in lines
    ]
    seconds[1] = seconds[1].replace("2 1 0.5", "4 2 0.5")
    write_file(rig_model / "frames.txt", "\n".join([*lines, *seconds]))
    with pytest.raises(ValueError, match="images do not have one pose"):
        calibration.load(rig_model)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("rigs.txt", "2 1 0.8 0.4 -0.2 0.4 0.1 -0.2 0.5", "2 0", "camera 2 of rig 1 has no pose"),
        ("rigs.txt", "0.1 -0.2 0.5", "0.1 -0.2", "rigs.txt: line 2: expected RIG_ID NUM_SENSORS"),
        ("rigs.txt", "0.8", "8", "camera 2 of rig 1: its pose is not a unit quaternion"),
        ("frames.txt", "CAMERA 7 3", "CAMERA 7", "frames.txt: line 3: expected FRAME_ID RIG_ID"),
        ("frames.txt", "CAMERA 7 3", "CAMERA 7 4", "image top/0 is in no frame"),
        ("frames.txt", "5 2", "5 4", "camera 7 of rig 4 has no pose in rigs.txt"),
        ("frames.txt", "0.3 1.2", "nan 1.2", "a frame of rig 2: its pose"),
    ],
)  # fmt: skip
def test_invalid_rigs_are_rejected(file: str, old: str, new: str, message: str, rig_model: Path) -> None:
    text = (rig_model / file).read_text()
    assert old in text
    write_file(rig_model / file, text.replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        calibration.load(rig_model)


def test_rigs_without_frames_are_rejected(rig_model: Path) -> None:
    (rig_model / "frames.txt").unlink()
    with pytest.raises(ValueError, match=r"this COLMAP model has rigs\.txt without the other one"):
        calibration.load(rig_model)


# Assignment of images to cameras


def test_images_without_folders(model: Path) -> None:
    names = {"a.png": 1, "b.png": 2, "c.png": 7}
    write_file(model / "images.txt", format_images(names))
    assert calibration.load(model).names == ("a", "b", "c")
    # Several consistent images of each lens: as many cameras as lenses.
    write_file(model / "images.txt", format_images({"a0.png": 1, "a1.png": 1, "b0.png": 2, "b1.png": 2}))
    assert calibration.load(model).names == ("1", "2")
    # One lens for all: each image is a camera.
    poses = {"x.png": POSES[1], "y.png": POSES[2], "z.png": POSES[7]}
    write_file(model / "images.txt", format_images(dict.fromkeys(poses, 1), poses))
    rig = calibration.load(model)
    assert rig.names == ("x", "y", "z")
    np.testing.assert_array_equal(rig["x"].matrix, rig["z"].matrix)


def perturb_pose(degrees: float, distance: float) -> tuple[list[float], list[float]]:
    """Return lens 1's pose with another rotation and center."""
    q, t = POSES[1]
    rotation = Rotation.from_quat(np.roll(q, -1))
    other = Rotation.from_rotvec([0, np.radians(degrees), 0]) * rotation
    center = -rotation.inv().apply(t) + [distance, 0, 0]
    return np.roll(other.as_quat(), 1).tolist(), (-other.apply(center)).tolist()


def test_poses_of_one_camera_are_averaged(model: Path) -> None:
    names = dict.fromkeys([f"left/{k}.png" for k in range(4)], 1) | {"right/0.png": 2}
    off = [perturb_pose(0.05, 0), perturb_pose(-0.05, 0), perturb_pose(0, 1e-3), perturb_pose(0, -1e-3)]
    poses = {f"left/{k}.png": pose for k, pose in enumerate(off)}
    write_file(model / "images.txt", format_images(names, poses))
    found, exact = calibration.load(model)["left"].camera_from_world, perturb_pose(0, 0)
    np.testing.assert_allclose(found.translation, exact[1], atol=1e-6)
    assert (found.rotation * Rotation.from_quat(np.roll(exact[0], -1)).inv()).magnitude() < 1e-8


@pytest.mark.parametrize(("degrees", "shift"), [(3.0, 0.0), (0.0, 0.5)])
def test_moving_camera_is_rejected(degrees: float, shift: float, model: Path) -> None:
    names = {"left/0.png": 1, "left/1.png": 1, "right/0.png": 2}
    write_file(model / "images.txt", format_images(names, {"left/1.png": perturb_pose(degrees, shift)}))
    with pytest.raises(ValueError, match=r"images do not have one pose") as caught:
        calibration.load(model)
    # Their mean is halfway.
    assert "camera left: its 2 images" in str(caught.value)
    assert f"up to {degrees / 2:.2f} degrees and {shift / 2:.2g} units" in str(caught.value) or not shift


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("cameras.txt", "OPENCV 640", "FOV 640", "camera left: COLMAP's model FOV is not supported"),
        ("cameras.txt", "OPENCV 640", "RADIAL 640", "camera left: the parameters of RADIAL must be 5 numbers, got 8"),
        (
            "cameras.txt",
            "7 SIMPLE",
            "8 SIMPLE",
            "camera top: its images have a lens, 7, that is not in COLMAP's cameras",
        ),
        ("cameras.txt", "640 480", "640", "cameras.txt: line 4: expected CAMERA_ID MODEL WIDTH HEIGHT"),
        ("images.txt", "1 left/1.png", "2 left/1.png", "camera left: its 2 images have 2 lenses: 1, 2"),
        ("images.txt", "left/0.png", "", "images.txt: line 3: expected IMAGE_ID QW"),
        ("images.txt", "3 -0.5", "3 0.5e3", "images.txt: line 7: image right/0.png: its pose is not a unit quaternion"),
        ("images.txt", "2.0", "nan", "image right/0.png: its pose"),
    ],
)
def test_invalid_models_are_rejected(file: str, old: str, new: str, message: str, model: Path) -> None:
    text = (model / file).read_text()
    assert old in text
    write_file(model / file, text.replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        calibration.load(model)


def test_incomplete_model_is_rejected(model: Path) -> None:
    (model / "images.txt").unlink()
    with pytest.raises(ValueError, match=r"cameras\.txt: this is part of a COLMAP model, .*images must be next to it"):
        calibration.load(model)
    write_file(model / "images.txt", "# nothing\n")
    with pytest.raises(ValueError, match="no image of this COLMAP model has a pose"):
        calibration.load(model)


@pytest.mark.parametrize("cut", [4, 11, 40, 90, 150])
@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_truncated_binary_is_rejected(name: str, cut: int, model: Path) -> None:
    write_binary(model, RIG)
    data = (model / name).read_bytes()
    (model / name).write_bytes(data[:cut])
    with pytest.raises(ValueError, match=rf"{name}: the file is truncated"):
        calibration.load(model / name)


# rig_config


def make_rig_config(**changes: Any) -> list[dict[str, Any]]:
    q, t = POSES[2]
    second = {
        "image_prefix": "rig1/right/",
        "cam_from_rig_rotation": q,
        "cam_from_rig_translation": t,
        "camera_model_name": "FULL_OPENCV",
        "camera_params": [610, 611, 400, 300, 0.2, -0.1, 0.001, 0.002, 0.03, 0.1, -0.05, 0.01],
    }
    second = {key: value for key, value in (second | changes).items() if value is not None}
    first = {
        "image_prefix": "rig1/left/",
        "ref_sensor": True,
        "camera_model_name": "PINHOLE",
        "camera_params": [500, 501, 320, 240],
    }
    return [{"cameras": [first, second]}]


def test_rig_config(tmp_path: Path) -> None:
    file = write_file(tmp_path / "rig_config.json", json.dumps(make_rig_config()))
    rig = calibration.load(file, lambda names: dict.fromkeys(names, (640, 480)))
    assert rig.names == ("left", "right")
    points = points_in_front(np.eye(3), np.zeros(3))
    assert_projects(rig["left"], points, lambda p: (500 * p[0] / p[2] + 319.5, 501 * p[1] / p[2] + 239.5))
    shift = np.array(POSES[2][1])
    turn = np.column_stack([transform_point(2, axis) - shift for axis in np.eye(3)])
    assert_projects(rig["right"], points_in_front(turn, shift), right)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_params": None}, "camera right: this is a COLMAP rig_config without its camera_model_name"),
        ({"cam_from_rig_rotation": None}, "camera right: .* without its cam_from_rig_rotation"),
        ({"cam_from_rig_rotation": [1, 1, 0, 0]}, "camera right: .* is not a unit quaternion"),
    ],
)
def test_invalid_rig_config_is_rejected(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    file = write_file(tmp_path / "rig_config.json", json.dumps(make_rig_config(**changes)))
    with pytest.raises(ValueError, match=rf"rig_config\.json: {message}"):
        calibration.load(file, lambda names: dict.fromkeys(names, (640, 480)))
    file = write_file(tmp_path / "rig_config.json", json.dumps(make_rig_config() + make_rig_config()))
    with pytest.raises(ValueError, match="of 2 rigs, without the poses between them"):
        calibration.load(file)
