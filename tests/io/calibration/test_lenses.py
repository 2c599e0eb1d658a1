"""Lenses without poses, in files as users have them: of one camera, of several, and what is missing in them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from sylpose.io import calibration
from sylpose.io.calibration.lenses import LensFile, load_lenses, parse_lens_files
from sylpose.simulate import ring

NAMES = ["cam_0", "cam_1"]
MATRIX = np.array([[800.0, 0.0, 321.5], [0.0, 810.0, 239.5], [0.0, 0.0, 1.0]])
DISTORTION = [-0.21, 0.05, 0.001, -0.002, 0.0]
SIZE = (640, 480)

# As cv2.FileStorage and the calibration sample of OpenCV write it.
OPENCV = """%YAML:1.0
---
calibration_time: "Tue 03 Mar 2026 10:00:00"
image_width: 640
image_height: 480
board_width: 9
flags: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 800., 0., 321.5, 0., 810., 239.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.21, 0.05, 0.001, -0.002, 0. ]
avg_reprojection_error: 0.31
"""
# As camera_calibration of ROS writes it.
ROS = """image_width: 640
image_height: 480
camera_name: cam_1
camera_matrix:
  rows: 3
  cols: 3
  data: [800.0, 0.0, 321.5, 0.0, 810.0, 239.5, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.21, 0.05, 0.001, -0.002, 0.0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
projection_matrix:
  rows: 3
  cols: 4
  data: [790.0, 0.0, 321.5, 0.0, 0.0, 805.0, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0]
"""
TABLE = """
[{name}]
size = [640, 480]
matrix = [[800.0, 0.0, 321.5], [0.0, 810.0, 239.5], [0.0, 0.0, 1.0]]
distortions = [-0.21, 0.05, 0.001, -0.002, 0.0]
"""
PLAIN_JSON = """{"K": [[800.0, 0, 321.5], [0, 810.0, 239.5], [0, 0, 1]], "dist": [[-0.21, 0.05, 0.001, -0.002, 0.0]]}"""
EASYMOCAP = """%YAML:1.0
---
names:
  - "cam_0"
  - "cam_1"
""" + "".join(
    f"""K_{name}: !!opencv-matrix
  rows: 3
  cols: 3
  dt: d
  data: [800.0, 0.0, 321.5, 0.0, 810.0, 239.5, 0.0, 0.0, 1.0]
dist_{name}: !!opencv-matrix
  rows: 1
  cols: 5
  dt: d
  data: [-0.21, 0.05, 0.001, -0.002, 0.0]
"""
    for name in NAMES
)


def sizes(names: object) -> dict[str, tuple[int, int]]:
    return dict.fromkeys([*names], SIZE)  # type: ignore[misc]


def write(folder: Path, name: str, text: str) -> Path:
    file = folder / name
    file.write_text(text, encoding="utf-8")
    return file


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("camera.yml", OPENCV, NAMES),
        ("lens.json", PLAIN_JSON, NAMES),
        ("lens.toml", TABLE.split("]\n", 1)[1], NAMES),
        ("calibration.toml", "".join(TABLE.format(name=name) for name in NAMES), NAMES),
        ("calibration.toml", "".join(TABLE.format(name=f"cameras.{name}") for name in NAMES), NAMES),
        ("intri.yml", EASYMOCAP, NAMES),
    ],
)
def test_one_file(name: str, text: str, expected: list[str], tmp_path: Path) -> None:
    rig = load_lenses([(None, write(tmp_path, name, text))], NAMES, sizes)
    assert [*rig.names] == expected
    for camera in rig:
        assert camera.size == SIZE
        np.testing.assert_array_equal(camera.matrix, MATRIX)
        np.testing.assert_array_equal(camera.distortion[:5], DISTORTION)
        np.testing.assert_array_equal(camera.camera_from_world.as_matrix(), np.eye(4))


def test_several_files(tmp_path: Path) -> None:
    """By the name in the file, the file's name, or as given."""
    ros, own = write(tmp_path, "ost.yaml", ROS), write(tmp_path, "cam_0.yml", OPENCV)
    assert {*load_lenses([(None, ros), (None, own)], NAMES, sizes).names} == {*NAMES}
    other = write(tmp_path, "left=1.yml", OPENCV)
    files = parse_lens_files([f"cam_0={other}", f"cam_1={ros}"])
    assert files == [("cam_0", other), ("cam_1", ros)]
    assert [*load_lenses(files, NAMES, sizes).names] == NAMES
    assert parse_lens_files([str(other)]) == [(None, other)]


def test_poses_are_ignored(tmp_path: Path) -> None:
    rig = ring(2, 2.0, 800.0, SIZE)
    calibration.save(rig, tmp_path / "rig.toml")
    found = load_lenses([(None, tmp_path / "rig.toml")], NAMES, sizes)
    assert found.names == rig.names
    assert all((camera.camera_from_world.as_matrix() == np.eye(4)).all() for camera in found)
    text = re.sub(
        r"\[cameras.cam_.\.camera_from_world\].*?translation[^\n]*", "", (tmp_path / "rig.toml").read_text(), flags=re.S
    )
    assert "camera_from_world]" not in text
    lens_only = write(tmp_path, "lenses.toml", text)
    np.testing.assert_array_equal(load_lenses([(None, lens_only)], NAMES, sizes)[1].matrix, rig[1].matrix)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"a.yml": OPENCV, "b.yml": OPENCV}, "a.yml: which camera is it"),
        ({"cam_0.yml": OPENCV, "cam_1.yml": "%YAML:1.0\n---\nboard: 3\n"}, "cam_1.yml"),
        ({"cam_0.yml": OPENCV, "cam_0.json": PLAIN_JSON}, "camera cam_0: it is also in another file"),
        ({"cam_0.yml": OPENCV}, "no lens of camera cam_1: give cam_1=FILE"),
        ({"cam_0.json": '{"K": [[800, 0, 320], [0, 800, 240], [0, 0, 1]]}'}, "camera cam_0: missing key 'distortion"),
        ({"cam_0.json": '{"K": [[800, 0], [0, 800]], "D": [0, 0, 0, 0]}'}, "camera cam_0: the matrix must be 3x3"),
        ({"lens.toml": TABLE.split("]\n", 1)[1].replace("640", "-1")}, "camera lens: the size"),
    ],
)
def test_errors_name_file_and_camera(files: dict[str, str], message: str, tmp_path: Path) -> None:
    paths: list[LensFile] = [(None, write(tmp_path, name, text)) for name, text in files.items()]
    with pytest.raises(ValueError, match=re.escape(message)):
        load_lenses(paths, NAMES, sizes)
