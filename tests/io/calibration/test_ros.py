"""ROS camera_info with transforms between frames, as files and messages; stereo pairs; invalid files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sylpose.geometry.arrays import FloatArray
from sylpose.io import calibration
from sylpose.rig import Rig
from tests.io.calibration.reference_projections import (
    TURN,
    apply_brown,
    apply_equidistant,
    assert_projects,
    points_in_front,
    write_file,
)

# Output of camera_calibration.
LEFT = """image_width: 640
image_height: 480
camera_name: narrow_stereo/left
camera_matrix:
  rows: 3
  cols: 3
  data: [438.5, 0, 305.5, 0, 437.25, 239.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.36, 0.12, 0.0012, -0.0008, -0.01]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [393.5, 0, 322.5, 0, 0, 393.5, 241.25, 0, 0, 0, 1, 0]
"""
# Output of `ros2 topic echo --once /right/camera_info`, with its optical frame.
RIGHT = """header:
  stamp:
    sec: 12
    nanosec: 5
  frame_id: right_camera_optical_frame
height: 600
width: 800
distortion_model: equidistant
d:
- 0.01
- -0.02
- 0.003
- 0.0005
k: [500.0, 0.0, 400.0, 0.0, 501.0, 300.0, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [500.0, 0.0, 400.0, 0.0, 0.0, 501.0, 300.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
---
"""
# base -> left_optical, base -> mast -> right: (x, y, z, w), and the child's position in the parent.
TF = """transforms:
- header:
    frame_id: base_link
  child_frame_id: left_optical_frame
  transform:
    translation: {x: 0.5, y: -0.25, z: 1.0}
    rotation: {x: 0.1, y: -0.5, z: 0.5, w: 0.7}
- header:
    frame_id: /base_link
  child_frame_id: mast
  transform:
    translation: {x: 0.0, y: 0.125, z: 2.0}
    rotation: {x: 0.5, y: 0.5, z: -0.5, w: 0.5}
---
transforms:
- header:
    frame_id: mast
  child_frame_id: right_camera_optical_frame
  transform:
    translation: {x: -0.75, y: 0.0, z: 0.25}
    rotation: {x: 0.7, y: 0.1, z: 0.5, w: -0.5}
---
"""


def to_parent(point: FloatArray, shift: list[float], turn: list[float]) -> FloatArray:
    """Transform a child's point to the parent: p + 2 w (v x p) + 2 v x (v x p), and the translation."""
    v, w = np.array(turn[:3]), turn[3]
    return np.asarray(point + 2 * w * np.cross(v, point) + 2 * np.cross(v, np.cross(v, point)) + shift)


LEFT_IN_BASE = ([0.5, -0.25, 1.0], [0.1, -0.5, 0.5, 0.7])
MAST_IN_BASE = ([0.0, 0.125, 2.0], [0.5, 0.5, -0.5, 0.5])
RIGHT_IN_MAST = ([-0.75, 0.0, 0.25], [0.7, 0.1, 0.5, -0.5])


def in_base_of_right(point: FloatArray) -> FloatArray:
    return to_parent(to_parent(point, *RIGHT_IN_MAST), *MAST_IN_BASE)


def left_pixel(point: FloatArray) -> tuple[float, float]:
    x, y = apply_brown(point[0] / point[2], point[1] / point[2], [-0.36, 0.12, -0.01], [0.0012, -0.0008])
    return 438.5 * x + 305.5, 437.25 * y + 239.5


def right_pixel(point: FloatArray) -> tuple[float, float]:
    x, y = apply_equidistant(point[0] / point[2], point[1] / point[2], [0.01, -0.02, 0.003, 0.0005])
    return 500 * x + 400, 501 * y + 300


def check(rig: Rig) -> None:
    """Assert the projections of points in the cameras' own frames, expressed in the base frame."""
    assert rig.names == ("left", "right_camera")
    assert [camera.size for camera in rig] == [(640, 480), (800, 600)]
    points = points_in_front(np.eye(3), np.zeros(3))
    in_base = np.array([to_parent(p, *LEFT_IN_BASE) for p in points])
    np.testing.assert_allclose(rig.cameras[0].project(in_base), [left_pixel(p) for p in points], atol=1e-9)
    in_base = np.array([in_base_of_right(p) for p in points])
    np.testing.assert_allclose(rig.cameras[1].project(in_base), [right_pixel(p) for p in points], atol=1e-9)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in (("left.yaml", LEFT), ("right.yaml", RIGHT), ("tf_static.yaml", TF)):
        write_file(tmp_path / "ros" / name, text)
    return tmp_path / "ros"


@pytest.mark.parametrize("given", ["", "left.yaml", "right.yaml", "tf_static.yaml"])
def test_transforms(given: str, folder: Path) -> None:
    write_file(folder / "other.yaml", "a: &x 1\nb: *x\n")  # not of a camera: ignored
    check(calibration.load(folder / given))
    assert calibration.format_name(folder / given) == "ROS camera_info"


def test_stereo_from_rectification(folder: Path) -> None:
    """Poses from rectification: R rotates a camera's points to the rectified ones, P has the second one's position."""
    (folder / "tf_static.yaml").unlink()
    write_file(folder / "left.yaml", LEFT.replace("[1, 0, 0, 0, 1, 0, 0, 0, 1]", str(TURN.ravel().tolist())))
    rows = TURN.T.ravel().tolist()
    right = RIGHT.replace("r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]", f"r: {rows}")
    right = right.replace("400.0, 0.0, 0.0, 501.0", "400.0, -60.0, 0.0, 501.0")
    write_file(folder / "right.yaml", right)
    rig = calibration.load(folder)

    def seen(point: FloatArray, turn: FloatArray, baseline: float) -> FloatArray:
        moved = point - np.array([baseline, 0, 0])
        return np.array([sum(turn[j, i] * moved[j] for j in range(3)) for i in range(3)])

    points = points_in_front(TURN.T, np.zeros(3))
    assert_projects(rig.cameras[0], points, lambda p: left_pixel(seen(p, TURN, 0.0)))
    # Tx = -fx B: the second camera is at B = 0.12 to the right.
    points = points_in_front(TURN, np.zeros(3)) + np.array([0.12, 0, 0])
    assert_projects(rig.cameras[1], points, lambda p: right_pixel(seen(p, TURN.T, 0.12)))


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("tf_static.yaml", "child_frame_id: mast", "child_frame_id: pole", "do not connect base_link and mast"),
        (
            "tf_static.yaml",
            "left_optical_frame",
            "left_link",
            "camera left: no frame in the ROS transforms .* the optical",
        ),
        ("right.yaml", "right_camera_optical_frame", "elsewhere", "camera elsewhere: no frame .* is 'elsewhere'"),
        (
            "tf_static.yaml",
            "z: 0.5, w: 0.7",
            "z: 0.5, w: 0.9",
            "the transform of left_optical_frame: its rotation must be a",
        ),
        ("tf_static.yaml", "x: 0.1, y: -0.5", "y: -0.5", "the transform of left_optical_frame: missing rotation.x"),
        (
            "tf_static.yaml",
            "frame_id: base_link",
            "frame_id: left_optical_frame",
            "left_optical_frame is its own ancestor",
        ),
        ("left.yaml", "plumb_bob", "mei", "camera left: distortion_model 'mei' is not known"),
        (
            "left.yaml",
            "0, 0, 1]\ndistortion_model",
            "0, 1]\ndistortion_model",
            "camera left: K must be a matrix with rows",
        ),
    ],
)
def test_invalid_ros_files_are_rejected(file: str, old: str, new: str, message: str, folder: Path) -> None:
    text = (folder / file).read_text()
    assert old in text
    write_file(folder / file, text.replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        calibration.load(folder)


def test_camera_info_alone(folder: Path) -> None:
    (folder / "tf_static.yaml").unlink()
    with pytest.raises(
        ValueError, match=r"left\.yaml: this is a ROS camera_info, which does not contain the camera's pose"
    ):
        calibration.load(folder)
    write_file(folder / "tf_static.yaml", TF)
    (folder / "left.yaml").unlink()
    (folder / "right.yaml").unlink()
    with pytest.raises(ValueError, match="ROS transforms without a camera_info next to them"):
        calibration.load(folder)


BINNED = """header: {frame_id: left_optical_frame}
width: 1280
height: 960
distortion_model: plumb_bob
d: [-0.1, 0.02, 0.0, 0.0, 0.0]
k: [1664.0, 0.0, 639.5, 0.0, 1660.0, 479.5, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [1664.0, 0.0, 639.5, 0.0, 0.0, 1664.0, 479.5, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 2
binning_y: 4
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
"""


def load_binned(folder: Path, left: str) -> Rig:
    write_file(folder / "left.yaml", left)
    right = left.replace("left", "right").replace("639.5, 0.0, 0.0, 1664.0", "639.5, -332.8, 0.0, 1664.0")
    write_file(folder / "right.yaml", right)
    return calibration.load(folder / "left.yaml")


def test_binning_and_region_of_interest(tmp_path: Path) -> None:
    """K is that of the full sensor; a binned pixel's center is the middle of its pixels."""
    rig = load_binned(tmp_path, BINNED)
    assert [camera.size for camera in rig] == [(640, 240)] * 2
    expected = np.array([[832.0, 0, 319.5], [0, 415.0, 119.5], [0, 0, 1]])
    np.testing.assert_allclose(rig["left"].matrix, expected, rtol=1e-15)
    np.testing.assert_allclose(rig["right"].center - rig["left"].center, [0.2, 0, 0], atol=1e-12)
    region = "roi: {x_offset: 100, y_offset: 40, height: 800, width: 1001, do_rectify: true}"
    rig = load_binned(tmp_path, BINNED.replace(BINNED.splitlines()[-1], region))
    assert rig["left"].size == (500, 200)
    np.testing.assert_allclose(rig["left"].matrix[:2, 2], [269.5, 109.5], rtol=1e-15)
    full = calibration.load(write_file(tmp_path / "left.yaml", BINNED.replace("binning_x: 2\nbinning_y: 4", "")))
    assert full["left"].size == (1280, 960)
    # The same ray, seen by full sensor and region.
    ray = np.array([[0.1, -0.2, 3.0]])
    pixel = full["left"].project(ray) - [100, 40]
    np.testing.assert_allclose(rig["left"].project(ray), (pixel + 0.5) / [2, 4] - 0.5, atol=1e-11)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("binning_x: 2", "binning_x: 1.5", "binning_x and binning_y must be whole numbers"),
        ("width: 0", "width: 1300", "must be a region in the image of 1280x960"),
        ("x_offset: 0", "x_offset: 1280", "must be a region in the image of 1280x960"),
        ("x_offset: 0", "x_offset: a", "roi.x_offset, y_offset, width and height must be numbers"),
    ],
)
def test_invalid_regions_are_rejected(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        load_binned(tmp_path, BINNED.replace(old, new))
