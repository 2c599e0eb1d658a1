"""Calibrations of Matlab, Metashape and NeRF, by their own formulas."""

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

SHIFT = np.array([-120.5, 3.25, 15.0])


# Matlab


def make_matlab(newer: bool = False, **changes: Any) -> dict[str, Any]:
    """Format jsonencode(toStruct(stereoParams)); matrices of old versions apply to row vectors."""
    first = np.array([[800.5, 0, 321.0], [0, 801.5, 241.0], [0, 0, 1]])
    lenses = []
    for k, matrix in (([-0.2, 0.05], first), ([-0.3, 0.1, -0.02], first + np.diag([10, 20, 0]))):
        lens = {"RadialDistortion": k, "TangentialDistortion": [0.001, -0.002], "ImageSize": [480, 640]}
        lens["WorldUnits"] = "millimeters"
        lens |= {"K": matrix.tolist()} if newer else {"IntrinsicMatrix": matrix.T.tolist()}
        lenses.append(lens)
    pose: dict[str, Any] = {"RotationOfCamera2": TURN.T.tolist(), "TranslationOfCamera2": SHIFT.tolist()}
    if newer:
        pose = {"PoseCamera2": {"Dimensionality": 3, "R": TURN.tolist(), "Translation": SHIFT.tolist()}}
    data = {"CameraParameters1": lenses[0], "CameraParameters2": lenses[1], "Version": {}} | pose | changes
    return {key: value for key, value in data.items() if value is not None}


@pytest.mark.parametrize("newer", [False, True])
def test_matlab(newer: bool, tmp_path: Path) -> None:
    rig = calibration.load(write_file(tmp_path / "stereo.json", json.dumps(make_matlab(newer))))
    assert (rig.names, rig.unit, rig.cameras[0].size) == (("1", "2"), "mm", (640, 480))

    def first(point: FloatArray) -> tuple[float, float]:
        """Project row vectors, [x y z] K', with pixels from (1, 1)."""
        x, y = apply_brown(point[0] / point[2], point[1] / point[2], [-0.2, 0.05], [0.001, -0.002])
        return 800.5 * x + 321.0 - 1, 801.5 * y + 241.0 - 1

    def second(point: FloatArray) -> tuple[float, float]:
        row = [sum(point[i] * TURN.T[i, j] for i in range(3)) + SHIFT[j] for j in range(3)]
        x, y = apply_brown(row[0] / row[2], row[1] / row[2], [-0.3, 0.1, -0.02], [0.001, -0.002])
        return 810.5 * x + 321.0 - 1, 821.5 * y + 241.0 - 1

    assert_projects(rig["1"], points_in_front(np.eye(3), np.zeros(3)), first)
    assert_projects(rig["2"], points_in_front(TURN, SHIFT), second)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"RotationOfCamera2": None}, "these are Matlab's stereoParameters without PoseCamera2, or RotationOfCamera2"),
        ({"CameraParameters2": {}}, "camera 2: missing RadialDistortion and K, or IntrinsicMatrix"),
        (
            {"CameraParameters1": {"MappingCoefficients": [1, 2, 3, 4]}},
            r"camera 1: Matlab's fisheye model \(Scaramuzza's\)",
        ),
        (
            {"CameraParameters1": make_matlab()["CameraParameters1"] | {"ImageSize": []}},
            "no image size of 1, and",
        ),
        (
            {"CameraParameters1": make_matlab()["CameraParameters1"] | {"ImageSize": [3]}},
            "camera 1: ImageSize must be 2 numbers",
        ),
        (
            {"CameraParameters1": make_matlab()["CameraParameters1"] | {"RadialDistortion": 1}},
            "RadialDistortion must be 2 or 3",
        ),
    ],
)
def test_invalid_matlab_is_rejected(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"stereo\.json: .*{message}"):
        calibration.load(write_file(tmp_path / "stereo.json", json.dumps(make_matlab(**changes))))


def test_matlab_of_one_camera(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="these are Matlab's parameters of one camera"):
        calibration.load(write_file(tmp_path / "a.json", json.dumps(make_matlab()["CameraParameters1"])))


# Metashape


SCALE, CHUNK_SHIFT = 0.5, np.array([10.0, -20.0, 5.0])


def make_metashape(**changes: str) -> str:
    """Format a Metashape export with two sensors, a chunk transform, and an unaligned camera."""
    pose = np.eye(4)
    pose[:3] = np.column_stack([TURN.T, [3.0, -4.0, 2.0]])
    other = np.eye(4)
    other[:3] = np.column_stack([OTHER_TURN.T, [-1.0, 2.0, 6.0]])
    words = {
        name: " ".join(map(str, m.ravel().tolist())) for name, m in (("a", pose), ("b", other), ("chunk", OTHER_TURN))
    }
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0">
 <chunk label="Chunk 1" enabled="true">
  <sensors next_id="2">
   <sensor id="0" label="unknown" type="frame">
    <resolution width="1920" height="1080"/>
    <calibration type="frame" class="initial"><resolution width="1920" height="1080"/><f>1</f></calibration>
    <calibration type="frame" class="adjusted">
     <resolution width="1920" height="1080"/>
     <f>1500.5</f><cx>12.25</cx><cy>-8.5</cy><b1>2.5</b1>
     <k1>-0.05</k1><k2>0.02</k2><k3>-0.004</k3><p1>0.0006</p1><p2>-0.0009</p2>
    </calibration>
   </sensor>
   <sensor id="1" label="GoPro" type="fisheye">
    <calibration type="fisheye" class="adjusted">
     <resolution width="1280" height="960"/><f>600</f><cx>1</cx><cy>2</cy><k1>0.04</k1><k2>-0.01</k2><k4>0.001</k4>
    </calibration>
   </sensor>
  </sensors>
  <cameras next_id="3">
   <camera id="0" sensor_id="0" label="cam_left.png"><transform>{words["a"]}</transform></camera>
   <group id="0" label="more">
    <camera id="1" sensor_id="1" label="cam_right"><transform>{words["b"]}</transform></camera>
    <camera id="2" sensor_id="1" label="lost"/>
   </group>
  </cameras>
  <transform>
   <rotation locked="true">{words["chunk"]}</rotation>
   <translation locked="true">{" ".join(map(str, CHUNK_SHIFT))}</translation>
   <scale locked="true">{SCALE}</scale>
  </transform>
 </chunk>
</document>
"""
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new, 1)
    return text


def test_metashape(tmp_path: Path) -> None:
    rig = calibration.load(write_file(tmp_path / "cameras.xml", make_metashape()))
    assert rig.names == ("cam_left", "cam_right")
    assert [camera.size for camera in rig] == [(1920, 1080), (1280, 960)]

    def in_camera(point: FloatArray, turn: FloatArray, center: FloatArray) -> FloatArray:
        """Transform world to chunk to camera, by the inverses of the file's transforms."""
        chunk = OTHER_TURN.T @ (point - CHUNK_SHIFT) / SCALE
        return np.array([sum(turn[i, j] * (chunk - center)[j] for j in range(3)) for i in range(3)])

    def left(point: FloatArray) -> tuple[float, float]:
        """Apply the manual's formulas of frame cameras, with pixels from the image's corner."""
        a, b, c = in_camera(point, TURN, np.array([3.0, -4.0, 2.0]))
        x, y = a / c, b / c
        r2 = x * x + y * y
        radial = 1 - 0.05 * r2 + 0.02 * r2**2 - 0.004 * r2**3
        xd = x * radial + 0.0006 * (r2 + 2 * x * x) + 2 * -0.0009 * x * y
        yd = y * radial + -0.0009 * (r2 + 2 * y * y) + 2 * 0.0006 * x * y
        return 1920 * 0.5 + 12.25 + xd * 1500.5 + xd * 2.5 - 0.5, 1080 * 0.5 - 8.5 + yd * 1500.5 - 0.5

    def right(point: FloatArray) -> tuple[float, float]:
        a, b, c = in_camera(point, OTHER_TURN, np.array([-1.0, 2.0, 6.0]))
        x, y = apply_equidistant(a / c, b / c, [0.04, -0.01, 0.0, 0.001])
        return 1280 * 0.5 + 1 + 600 * x - 0.5, 960 * 0.5 + 2 + 600 * y - 0.5

    for name, turn, center, pixel in (
        ("cam_left", TURN, [3.0, -4.0, 2.0], left),
        ("cam_right", OTHER_TURN, [-1.0, 2.0, 6.0], right),
    ):
        in_chunk = points_in_front(turn, -turn @ np.array(center))
        assert_projects(rig[name], SCALE * in_chunk @ OTHER_TURN.T + CHUNK_SHIFT, pixel)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<b1>2.5</b1>", "<b2>2.5</b2>", "camera cam_left: b2 of Metashape's frame model is not in OpenCV's"),
        ("<k3>", "<k4>0.1</k4><k3>", "camera cam_left: k4 of Metashape's frame model is not in OpenCV's"),
        ('type="fisheye" class', 'type="spherical" class', "camera cam_right: Metashape's 'spherical' camera model"),
        ("<f>1500.5</f>", "<fx>1500.5</fx>", "camera cam_left: its calibration has the format of an old PhotoScan"),
        ("<f>1500.5</f>", "", "camera cam_left: missing 'f'"),
        ('<sensor id="1"', '<sensor id="7"', "camera cam_right: its sensor 1 is not in this file"),
        ("<scale locked", "<scale old='", "not valid XML"),
        (f">{SCALE}</scale>", ">-1</scale>", "the chunk's transform: scale must be positive"),
        (
            'label="cam_right">',
            'label="cam_right" master_id="0">',
            "camera cam_right: multi-camera systems of Metashape",
        ),
    ],
)
def test_invalid_metashape_is_rejected(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"cameras\.xml: .*{message}"):
        calibration.load(write_file(tmp_path / "cameras.xml", make_metashape(**{old: new})))


def test_metashape_without_poses_or_with_several_chunks(tmp_path: Path) -> None:
    text = make_metashape()
    chunk = text.partition("<chunk")[2].partition("</chunk>")[0]
    file = write_file(tmp_path / "a.xml", text.replace("</chunk>", f"</chunk><chunk{chunk}</chunk>"))
    with pytest.raises(ValueError, match="2 chunks with cameras"):
        calibration.load(file)
    with pytest.raises(ValueError, match="no camera in this file of Metashape is aligned"):
        calibration.load(
            write_file(
                file,
                text.replace("<transform>0", "<was>0")
                .replace("<transform>-", "<was>-")
                .replace("</transform></camera>", "</was></camera>"),
            )
        )


# NeRF


def make_nerf(**changes: Any) -> dict[str, Any]:
    """Format transforms.json as instant-ngp's colmap2nerf: cameras look along -z with y up, in the world."""
    frames = []
    for name, turn, center in (("left", TURN, [1.0, 2.0, 3.0]), ("right", OTHER_TURN, [-2.0, 0.5, 1.0])):
        pose = np.eye(4)
        pose[:3] = np.column_stack([turn.T @ np.diag([1.0, -1.0, -1.0]), center])
        frames.append({"file_path": f"./images/{name}.png", "sharpness": 30.0, "transform_matrix": pose.tolist()})
    data: dict[str, Any] = {
        "camera_angle_x": 0.9,
        "fl_x": 700.5,
        "fl_y": 701.25,
        "k1": -0.05,
        "k2": 0.01,
        "p1": 0.001,
        "p2": -0.0005,
        "cx": 325.5,
        "cy": 242.25,
        "w": 640.0,
        "h": 480.0,
        "aabb_scale": 16,
        "frames": frames,
    }
    return {key: value for key, value in (data | changes).items() if value is not None}


def project_nerf(point: FloatArray, rotation: FloatArray, center: list[float]) -> tuple[float, float]:
    """Project with x right and y up over the distance along -z; image y points down."""
    camera_to_world = rotation.T @ np.diag([1.0, -1.0, -1.0])
    x, y, z = (sum(camera_to_world[i, j] * (point - center)[i] for i in range(3)) for j in range(3))
    return x / -z, -(y / -z)


def test_nerf(tmp_path: Path) -> None:
    rig = calibration.load(write_file(tmp_path / "transforms.json", json.dumps(make_nerf())))
    assert rig.names == ("left", "right")

    def pixel(point: FloatArray) -> tuple[float, float]:
        x, y = apply_brown(*project_nerf(point, OTHER_TURN, [-2.0, 0.5, 1.0]), [-0.05, 0.01], [0.001, -0.0005])
        return 700.5 * x + 325.5 - 0.5, 701.25 * y + 242.25 - 0.5

    points = points_in_front(OTHER_TURN, -OTHER_TURN @ np.array([-2.0, 0.5, 1.0]))
    assert_projects(rig["right"], points, pixel)


def test_nerf_field_of_view(tmp_path: Path) -> None:
    """Blender's variant has only a field of view, and no image size."""
    data = {"camera_angle_x": 0.9, "frames": make_nerf()["frames"]}
    for frame, name in zip(data["frames"], ("r_0", "r_1"), strict=True):
        frame["file_path"] = f"./train/{name}"
    file = write_file(tmp_path / "transforms.json", json.dumps(data))
    with pytest.raises(ValueError, match="has no image size of r_0, r_1"):
        calibration.load(file)
    rig = calibration.load(file, lambda names: dict.fromkeys(names, (800, 600)))

    def pixel(point: FloatArray) -> tuple[float, float]:
        x, y = project_nerf(point, TURN, [1.0, 2.0, 3.0])
        focal = 0.5 * 800 / np.tan(0.5 * 0.9)
        return focal * x + 800 / 2 - 0.5, focal * y + 600 / 2 - 0.5

    assert_projects(rig["r_0"], points_in_front(TURN, -TURN @ np.array([1.0, 2.0, 3.0])), pixel)


def test_nerf_fisheye_without_model_is_rejected(tmp_path: Path) -> None:
    file = write_file(tmp_path / "transforms.json", json.dumps(make_nerf(is_fisheye=True)))
    with pytest.raises(ValueError, match="camera left: is_fisheye is only supported with camera_model OPENCV_FISHEYE"):
        calibration.load(file)
    write_file(file, json.dumps(make_nerf(is_fisheye=True, camera_model="OPENCV_FISHEYE")))
    assert {camera.lens for camera in calibration.load(file)} == {"fisheye"}


def test_nerf_lenses_per_frame_in_folders(tmp_path: Path) -> None:
    """Several frames per camera, in one folder each; one camera is a fisheye."""
    frames = []
    for frame in make_nerf()["frames"]:
        name = Path(frame["file_path"]).stem
        frames += [frame | {"file_path": f"images/{name}/{k}.png"} for k in range(3)]
    frames = [f | {"camera_model": "OPENCV_FISHEYE", "fl_x": 500} if "right" in f["file_path"] else f for f in frames]
    rig = calibration.load(write_file(tmp_path / "transforms.json", json.dumps(make_nerf(frames=frames))))
    assert rig.names == ("left", "right")
    assert [camera.lens for camera in rig] == ["opencv", "fisheye"]
    frames[0] = frames[0] | {"transform_matrix": frames[-1]["transform_matrix"]}
    with pytest.raises(ValueError, match="camera left: its 3 images do not have one pose"):
        calibration.load(write_file(tmp_path / "transforms.json", json.dumps(make_nerf(frames=frames))))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera left: camera_model 'EQUIRECTANGULAR' is not supported"),
        (
            {"fl_x": None, "fl_y": None, "camera_angle_x": None},
            "camera left: transforms.json has neither fl_x nor camera",
        ),
        ({"k4": 0.1}, "camera left: k4 is not in OpenCV's lens model"),
        ({"w": "wide"}, "camera left: w and h must be numbers"),
        (
            {"frames": [{"file_path": "a.png", "transform_matrix": [[1]]}]},
            "camera a: transform_matrix must be a 3x4 or 4x4",
        ),
    ],
)
def test_invalid_nerf_is_rejected(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"transforms\.json: .*{message}"):
        calibration.load(write_file(tmp_path / "transforms.json", json.dumps(make_nerf(**changes))))
