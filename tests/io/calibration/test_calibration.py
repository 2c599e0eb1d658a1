"""Calibration files: real ones, every format, round trips, and invalid input."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.io import calibration
from sylpose.rig import Camera, LensModel, Rig
from tests.paths import DATA

SUFFIXES = (".toml", ".yml", ".yaml", ".json", ".xml")


def recording_path(name: str) -> Path:
    if not (DATA / name).is_dir():
        pytest.skip(f"the recording {name} is not here")
    return DATA / name


def random_rig(seed: int = 0, unit: str = "m") -> Rig:
    """Return a rig with one camera per number of distortion terms, and names that require quoting."""
    rng = np.random.default_rng(seed)
    lenses: list[tuple[LensModel, int]] = [("opencv", n) for n in (4, 5, 8, 12, 14)] + [("fisheye", 4)]
    names = ["cam_0", "left camera", "Kamera é", 'the "top" one', "3", "it's a.b"]
    cameras = []
    for name, (lens, n) in zip(names, lenses, strict=True):
        matrix = np.array([[rng.uniform(500, 900), 0, 320.25], [0, rng.uniform(500, 900), 239.75], [0, 0, 1]])
        pose = RigidTransform.from_components(rng.normal(size=3), Rotation.from_rotvec(rng.normal(size=3)))
        cameras.append(Camera(name, (640, 480), matrix, rng.normal(size=n) / 10, pose, lens))
    return Rig(cameras, unit)


def assert_same(a: Rig, b: Rig) -> None:
    """Assert equality bit for bit."""
    assert a.names == b.names
    for x, y in zip(a, b, strict=True):
        assert (x.size, x.lens) == (y.size, y.lens)
        np.testing.assert_array_equal(x.matrix, y.matrix)
        np.testing.assert_array_equal(x.distortion, y.distortion)
        np.testing.assert_array_equal(x.camera_from_world.as_matrix(), y.camera_from_world.as_matrix())


def write_file(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def same_pose(pose: RigidTransform, rvec: Any, tvec: Any) -> bool:
    rotation, _ = cv2.Rodrigues(np.array(rvec, dtype=float))
    matrix = pose.as_matrix()
    return bool(np.allclose(matrix[:3, :3], rotation, atol=1e-12) and np.array_equal(matrix[:3, 3], tvec))


# The real files


def test_temple() -> None:
    path = calibration.find(recording_path("temple"))
    rig = calibration.load(path)
    tables = tomllib.loads(path.read_text())
    assert rig.names == ("cam_0", "cam_1", "cam_2", "cam_3")
    assert rig.unit == ""
    for camera in rig:
        table = tables[camera.name]
        assert list(camera.size) == table["size"] == [640, 480]
        np.testing.assert_array_equal(camera.matrix, table["matrix"])
        np.testing.assert_array_equal(camera.distortion, table["distortions"])
        assert camera.lens == "opencv"
        assert same_pose(camera.camera_from_world, table["rotation"], table["translation"])


def test_board4() -> None:
    path = calibration.find(recording_path("board4"))
    rig = calibration.load(path)
    tables = tomllib.loads(path.read_text())["cameras"]
    assert rig.names == ("cam_0", "cam_1", "cam_2", "cam_3")
    for i, camera in enumerate(rig):
        table = tables[str(i)]
        assert list(camera.size) == [1280, 720]
        np.testing.assert_array_equal(camera.matrix, table["matrix"])
        np.testing.assert_array_equal(camera.distortion, table["distortions"])
        np.testing.assert_allclose(camera.rotation, table["rotation"], atol=1e-12)
        np.testing.assert_array_equal(camera.camera_from_world.translation, table["translation"])


@pytest.mark.parametrize("name", ["temple", "board4"])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_real_files_round_trip(name: str, suffix: str, tmp_path: Path) -> None:
    rig = calibration.load(calibration.find(recording_path(name)))
    calibration.save(rig, tmp_path / f"calibration{suffix}")
    assert_same(rig, calibration.load(tmp_path / f"calibration{suffix}"))


# Saving and loading


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("unit", ["", "mm"])
def test_round_trip_is_exact(suffix: str, unit: str, tmp_path: Path) -> None:
    for seed in range(5):
        rig = random_rig(seed, unit)
        calibration.save(rig, tmp_path / f"a{suffix}")
        back = calibration.load(tmp_path / f"a{suffix}")
        assert_same(rig, back)
        assert back.unit == unit


def test_conversion_through_all_formats_is_lossless(tmp_path: Path) -> None:
    rig = random_rig()
    converted = rig
    for suffix in (*SUFFIXES, ".toml"):
        calibration.save(converted, tmp_path / f"a{suffix}")
        converted = calibration.load(tmp_path / f"a{suffix}")
    assert_same(rig, converted)


def test_format_is_detected_from_content(tmp_path: Path) -> None:
    rig = random_rig()
    for suffix in SUFFIXES:
        calibration.save(rig, tmp_path / f"a{suffix}")
        text = (tmp_path / f"a{suffix}").read_text(encoding="utf-8")
        assert_same(rig, calibration.load(write_file(tmp_path / "calibration.txt", "\ufeff" + text)))


def test_native_format(tmp_path: Path) -> None:
    calibration.save(random_rig(), tmp_path / "a.toml")
    text = (tmp_path / "a.toml").read_text(encoding="utf-8")
    data = tomllib.loads(text)
    camera = random_rig().cameras[0]
    assert data["format"] == "sylpose-calibration-1"
    assert data["unit"] == "m"
    table = data["cameras"]["cam_0"]
    assert table["size"] == [640, 480]
    assert table["lens"] == "opencv"
    assert table["distortion"] == camera.distortion.tolist()
    pose = table["camera_from_world"]
    x = np.array([0.3, -0.2, 4.0])
    np.testing.assert_allclose(
        np.array(pose["rotation"]) @ x + pose["translation"], camera.camera_from_world.apply(x), atol=1e-12
    )
    assert text.startswith("#")
    assert "X_camera = rotation X_world + translation" in text


def test_written_filestorage_is_read_by_opencv(tmp_path: Path) -> None:
    rig = random_rig()
    for suffix in (".yml", ".json", ".xml"):
        calibration.save(rig, tmp_path / f"a{suffix}")
        storage = cv2.FileStorage(str(tmp_path / f"a{suffix}"), cv2.FILE_STORAGE_READ)
        node = storage.getNode("cameras").at(1)
        assert node.getNode("name").string() == "left camera"
        np.testing.assert_array_equal(node.getNode("camera_matrix").mat(), rig.cameras[1].matrix)


def test_save_requires_a_known_suffix(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"a\.csv: a calibration is written as one of \.toml"):
        calibration.save(random_rig(), tmp_path / "a.csv")


# TOML formats and their variants

ANIPOSE = """
[cam_0]
name = "left"
size = [640, 480]
matrix = [[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.1, 0.0, 0.0, 0.0, 0.0]
rotation = [0.1, 0.2, 0.3]
translation = [1.0, 2.0, 3.0]

[cam_1]
name = "right"
size = [640.0, 480.0]
fisheye = true
matrix = [[800, 0, 320], [0, 800, 240], [0, 0, 1]]
distortions = [[0.1, 0.0, 0.0, 0.0]]
rotation = [0.0, 0.0, 0.0]
translation = [[1.0], [2.0], [3.0]]

[metadata]
adjusted = false
error = 0.0
"""
CALISCOPE = """
[cameras.0]
cam_id = 0
size = [640, 480]
matrix = [[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.1, 0.0, 0.0, 0.0, 0.0]
rotation = [0.1, 0.2, 0.3]
translation = [1.0, 2.0, 3.0]
ignore = false

[cameras.1]
cam_id = 1
size = [640, 480]
ignore = true

[cameras.12]
size = [640, 480]
matrix = [[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.1, 0.0, 0.0, 0.0]
rotation = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
translation = [1.0, 2.0, 3.0]
fisheye = true
exposure = "null"
"""
OWN = """
format = "sylpose-calibration-1"
[cameras.left]
size = [640, 480]
matrix = [[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]]
distortion = [0.1, 0.0, 0.0, 0.0]
camera_from_world = { rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]], translation = [1.0, 2.0, 3.0] }
"""


def test_anipose(tmp_path: Path) -> None:
    rig = calibration.load(write_file(tmp_path / "calibration.toml", ANIPOSE))
    assert rig.names == ("left", "right")
    assert [c.lens for c in rig] == ["opencv", "fisheye"]
    assert rig["right"].size == (640, 480)
    assert rig["right"].distortion.shape == (4,)
    assert same_pose(rig["left"].camera_from_world, [0.1, 0.2, 0.3], [1, 2, 3])
    assert same_pose(rig["right"].camera_from_world, [0, 0, 0], [1, 2, 3])


def test_caliscope(tmp_path: Path) -> None:
    rig = calibration.load(write_file(tmp_path / "camera_array.toml", CALISCOPE))
    assert rig.names == ("cam_0", "cam_12")
    assert [c.lens for c in rig] == ["opencv", "fisheye"]
    assert same_pose(rig["cam_0"].camera_from_world, [0.1, 0.2, 0.3], [1, 2, 3])
    assert same_pose(rig["cam_12"].camera_from_world, [0, 0, np.pi / 2], [1, 2, 3])


CALISCOPE_CONFIG = """CALISCOPE_VERSION = "0.2.1"
creation_date = "2023-09-27"
fps_recording = 20
[charuco]
columns = 4
rows = 5
[cam_0]
port = 0
size = [1280, 720]
rotation_count = 0
error = 0.19
matrix = [[900.0, 0.0, 639.5], [0.0, 901.0, 359.5], [0.0, 0.0, 1.0]]
distortions = [0.1, -0.2, 0.0, 0.0, 0.01]
exposure = "null"
grid_count = 20
ignore = false
verified_resolutions = [[1280, 720]]
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
translation = [1.0, 2.0, 3.0]
[cam_3]
port = 3
size = [640, 480]
rotation_count = 1
error = 0.0
matrix = [[800.0, 0.0, 319.5], [0.0, 801.0, 239.5], [0.0, 0.0, 1.0]]
distortions = [0.1, -0.2, 0.0, 0.0, 0.01]
ignore = false
rotation = [0.1, 0.2, 0.3]
translation = [1.0, 2.0, 3.0]
[cam_4]
port = 4
size = [640, 480]
rotation_count = 0
ignore = true
[stereo_0_3]
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
translation = [[1.0], [2.0], [3.0]]
RMSE = 0.5
"""


def test_caliscope_config(tmp_path: Path) -> None:
    """Read config.toml of older versions, with other tables, and without pairs of cameras."""
    rig = calibration.load(write_file(tmp_path / "config.toml", CALISCOPE_CONFIG))
    assert rig.names == ("cam_0", "cam_3")
    assert [camera.error_px for camera in rig] == [0.19, None]
    assert same_pose(rig["cam_0"].camera_from_world, [0, 0, 0], [1, 2, 3])
    assert same_pose(rig["cam_3"].camera_from_world, [0.1, 0.2, 0.3], [1, 2, 3])
    text = CALISCOPE_CONFIG.replace("rotation = [0.1, 0.2, 0.3]\n", "")
    with pytest.raises(ValueError, match="camera cam_3: no rotation and translation: calibrate its pose"):
        calibration.load(write_file(tmp_path / "config.toml", text))


@pytest.mark.parametrize(("error", "known"), [("0.0", None), ("0", None), ("0.25", 0.25)])
def test_error_of_zero_is_unknown(error: str, known: float | None, tmp_path: Path) -> None:
    """Pose2Sim writes `error = 0.0` into every calibration, OpenCV's users 0 for none."""
    rig = calibration.load(write_file(tmp_path / "a.toml", ANIPOSE.replace("error = 0.0", f"error = {error}")))
    assert [camera.error_px for camera in rig] == [known, known]
    text = next(iter(STORAGE.values())) + f"avg_reprojection_error: {error}\n"
    assert calibration.load(write_file(tmp_path / "a.yml", text)).cameras[0].error_px == known


def test_rounded_rotation_becomes_the_nearest_one(tmp_path: Path) -> None:
    exact = Rotation.from_rotvec([0.3, -0.5, 0.7])
    rows = np.round(exact.as_matrix(), 4).tolist()
    text = OWN.replace("[[1, 0, 0], [0, 1, 0], [0, 0, 1]]", str(rows))
    rotation = calibration.load(write_file(tmp_path / "a.toml", text)).cameras[0].rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    u, _, vt = np.linalg.svd(np.array(rows))
    np.testing.assert_allclose(rotation, u @ vt, atol=1e-14)


# OpenCV's FileStorage: common layouts

LENS = "distortion_coefficients: [0.1, 0.0, 0.0, 0.0, 0.0]"
K = "[[800.0, 0, 320], [0, 800, 240], [0, 0, 1]]"
STORAGE: dict[str, str] = {
    "one node per camera, OpenCV's matrices": f"""%YAML:1.0
---
date: "today"
board: {{ name: "charuco", size: [5, 7] }}
cam_0:
   image_width: 640
   image_height: 480
   camera_matrix: !!opencv-matrix
      rows: 3
      cols: 3
      dt: d
      data: [ 800., 0., 320., 0., 800., 240., 0., 0., 1. ]
   {LENS}
   R: !!opencv-matrix
      rows: 3
      cols: 1
      dt: d
      data: [ 0.1, 0.2, 0.3 ]
   T: !!opencv-matrix
      rows: 3
      cols: 1
      dt: d
      data: [ 1., 2., 3. ]
""",
    "YAML without its header, other names": f"""# written by hand
cam_0:
  image_size: [640, 480]
  K: {K}
  dist: [[0.1, 0, 0, 0, 0]]
  rvec: [0.1, 0.2, 0.3]
  tvec: [1.0, 2.0, 3.0]
""",
    "YAML's lists in lines": f"""
cam_0:
  image_size: [640, 480]
  K:
  - [800.0, 0, 320]
  - [0, 800, 240]
  - [0, 0, 1]
  {LENS}
  R: [0.1, 0.2, 0.3]
  T:
  - 1.0
  - 2
  - 3e0
""",
    "ROS's matrices": f"""%YAML 1.2
---
cam_0:
  image_width: 640
  image_height: 480
  camera_matrix: {{ rows: 3, cols: 3, data: [800, 0, 320, 0, 800, 240, 0, 0, 1] }}
  distortion_model: plumb_bob
  {LENS}
  rotation: [0.1, 0.2, 0.3]
  translation: [1, 2, 3]
""",
    "a sequence": f"""%YAML:1.0
---
cameras:
   - name: cam_0
     image_size: [640, 480]
     camera_matrix: {K}
     {LENS}
     R: [0.1, 0.2, 0.3]
     T: [1, 2, 3]
""",
    "JSON": json.dumps(
        {
            "cam_0": {
                "K": [[800, 0, 320], [0, 800, 240], [0, 0, 1]],
                "D": [0.1, 0, 0, 0, 0],
                "size": [640, 480],
                "fisheye": False,
                "R": Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix().tolist(),
                "t": [[1], [2], [3]],
            }
        }
    ),
    "Multical": json.dumps(
        {
            "cameras": {
                "cam_0": {
                    "model": "standard",
                    "image_size": [640, 480],
                    "K": [[800, 0, 320], [0, 800, 240], [0, 0, 1]],
                    "dist": [[0.1, 0, 0, 0, 0]],
                }
            },
            "camera_poses": {
                "cam_0_to_cam_9": {
                    "R": Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix().tolist(),
                    "T": [1, 2, 3],
                }
            },
        }
    ),
    "XML": """<?xml version="1.0"?>
<opencv_storage>
<cam_0>
  <image_size>640 480</image_size>
  <camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
    <data>800. 0. 320. 0. 800. 240. 0. 0. 1.</data></camera_matrix>
  <distortion_coefficients>0.1 0. 0. 0. 0.</distortion_coefficients>
  <fisheye>false</fisheye>
  <R>0.1 0.2 0.3</R>
  <T>1. 2. 3.</T>
</cam_0>
</opencv_storage>
""",
    "JSON with a comment, as OpenCV writes it": """{
    // hello
    "cam_0": { "K": [[800, 0, 320], [0, 800, 240], [0, 0, 1]], "D": [0.1, 0, 0, 0, 0], "size": [640, 480],
        "R": [0.1, 0.2, 0.3], "T": [1, 2, 3] } }
""",
}


@pytest.mark.parametrize("layout", STORAGE)
def test_filestorage_layouts(layout: str, tmp_path: Path) -> None:
    rig = calibration.load(write_file(tmp_path / "calibration.yml", STORAGE[layout]))
    assert rig.names == ("cam_0",)
    camera = rig.cameras[0]
    assert camera.size == (640, 480)
    assert camera.lens == "opencv"
    np.testing.assert_array_equal(camera.matrix, [[800, 0, 320], [0, 800, 240], [0, 0, 1]])
    np.testing.assert_array_equal(camera.distortion, [0.1, 0, 0, 0, 0])
    assert same_pose(camera.camera_from_world, [0.1, 0.2, 0.3], [1, 2, 3])


def json_camera(**changes: Any) -> dict[str, Any]:
    """Return a camera's node; a change to None removes a key."""
    node = {
        "camera_matrix": [[800, 0, 320], [0, 800, 240], [0, 0, 1]],
        "distortion_coefficients": [0.1, 0, 0, 0],
        "image_width": 640,
        "image_height": 480,
        "R": [0.1, 0.2, 0.3],
        "T": [1.0, 2.0, 3.0],
    }
    return {key: value for key, value in (node | changes).items() if value is not None}


def load_json(tmp_path: Path, **changes: Any) -> Camera:
    text = json.dumps({"cam_0": json_camera(), "cam_1": json_camera(**changes)})
    return calibration.load(write_file(tmp_path / "calibration.json", text))["cam_1"]


@pytest.mark.parametrize(
    "changes",
    [
        {"fisheye": True},
        {"fisheye": 1},
        {"lens": "fisheye"},
        {"distortion_model": "equidistant", "camera_model": "pinhole"},
    ],
)
def test_filestorage_fisheye(changes: dict[str, Any], tmp_path: Path) -> None:
    assert load_json(tmp_path, **changes).lens == "fisheye"


def test_filestorage_poses_as_one_matrix(tmp_path: Path) -> None:
    pose = RigidTransform.from_components([1, 2, 3], Rotation.from_rotvec([0.1, 0.2, 0.3]))
    for key, matrix in [
        ("camera_from_world", pose.as_matrix()),
        ("extrinsics", pose.as_matrix()[:3]),
        ("world_from_camera", pose.inv().as_matrix()),
    ]:
        camera = load_json(tmp_path, R=None, T=None, **{key: matrix.tolist()})
        np.testing.assert_allclose(camera.camera_from_world.as_matrix(), pose.as_matrix(), atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_matrix": None}, r"missing key 'camera_matrix' \(or cameraMatrix, K,"),
        ({"distortion_coefficients": None}, "missing key 'distortion_coefficients'"),
        ({"image_width": None}, "missing key 'image_width'"),
        ({"image_width": None, "image_height": None}, "missing key 'image_width'"),
        ({"R": None}, "missing key 'R'"),
        ({"T": None}, "missing key 'T'"),
        ({"K": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "camera_matrix and K are synonyms"),
        ({"camera_matrix": [[1, 0], [0, 1]]}, "the matrix must be 3x3"),
        ({"camera_matrix": [[1, 0], [0]]}, "the matrix must be numbers, in rows of equal length"),
        ({"camera_matrix": "see elsewhere"}, "the matrix must be numbers"),
        ({"camera_matrix": {"rows": 3, "cols": 3, "data": [1]}}, "must be a matrix with rows, cols and matching data"),
        ({"distortion_coefficients": [0.1, 0.2]}, "2 distortion terms"),
        ({"fisheye": True, "distortion_coefficients": [0.1] * 5}, "5 distortion terms; the fisheye model"),
        ({"distortion_coefficients": [float("nan"), 0, 0, 0]}, "the distortion has values that are not finite"),
        ({"image_width": 640.5}, "two whole numbers"),
        ({"T": [1, 2]}, "the translation must be 3 numbers"),
        ({"T": [1, 2, float("inf")]}, "the translation has values that are not finite"),
        ({"R": [1, 2, 3, 4]}, "the rotation must be 3x3 or a rotation vector of 3"),
        ({"R": [[1, 0, 0], [0, 1, 0], [0, 0, 1.01]]}, "not a rotation matrix: R'R is 0.02 from the identity"),
        ({"R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "a reflection"),
        ({"extrinsics": np.eye(4).tolist()}, "its pose is given twice"),
        ({"R": None, "T": None, "extrinsics": np.eye(3).tolist()}, "camera_from_world must be a 3x4 or 4x4"),
        ({"fisheye": "maybe"}, "fisheye must be true or false, got 'maybe'"),
        ({"fisheye": True, "distortion_model": "plumb_bob"}, "both fisheye and not fisheye"),
        ({"distortion_model": "mirror"}, "distortion_model 'mirror' is not known"),
    ],
)
def test_bad_filestorage_camera(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"calibration\.json: camera cam_1: .*{message}") as caught:
        load_json(tmp_path, **changes)
    assert "\n" not in str(caught.value)


# Invalid TOML: (file, old text, new text, message)

MATRIX = "matrix = [[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]]"
BAD_TOML: dict[str, tuple[str, str, str, str]] = {
    "missing key": (ANIPOSE, MATRIX, "", "camera cam_0: missing key 'matrix'"),
    "missing size": (ANIPOSE, "size = [640, 480]", "", "camera cam_0: missing key 'size'"),
    "wrong type": (ANIPOSE, MATRIX, 'matrix = "K"', "camera cam_0: matrix: expected `array`, got `str`"),
    "wrong size": (ANIPOSE, "[640, 480]", "[640]", "camera cam_0: size: expected `array` of length 2"),
    "matrix shape": (ANIPOSE, ", [0.0, 0.0, 1.0]]", "]", "camera left: the matrix must be 3x3"),
    "matrix nan": (ANIPOSE, "[[800.0", "[[nan", "camera left: the matrix has values that are not finite"),
    "terms": (ANIPOSE, "[0.1, 0.0, 0.0, 0.0, 0.0]", "[0.1, 0.0]", "camera left: 2 distortion terms"),
    "rotation": (
        ANIPOSE,
        "[0.1, 0.2, 0.3]",
        "[0.1, 0.2]",
        "camera left: the rotation must be 3x3 or a rotation vector",
    ),
    "same name": (ANIPOSE, '"right"', '"left"', "two cameras of the same name in left, left"),
    "same table": (ANIPOSE, "[cam_1]", "[cam_0]", "not valid TOML: .*cam_0"),
    "no pose": (CALISCOPE, "rotation = [0.1, 0.2, 0.3]", "", "camera cam_0: no rotation and translation"),
    "null pose": (CALISCOPE, "rotation = [0.1, 0.2, 0.3]", 'rotation = "null"', "camera cam_0: no rotation and"),
    "no lens": (CALISCOPE, MATRIX, "", "camera cam_0: missing key 'matrix'"),
    "not a rotation": (
        CALISCOPE,
        "[0.0, -1.0, 0.0]",
        "[0.0, -1.1, 0.0]",
        "camera cam_12: the rotation is not a rotation",
    ),
    "reflection": (CALISCOPE, "[0.0, -1.0, 0.0]", "[0.0, 1.0, 0.0]", "camera cam_12: .* a reflection"),
    "all ignored": ("[cameras.0]\nignore = true", "", "", "no camera in this Caliscope file"),
    "no table": ("[cameras]\n0 = 1", "", "", r"camera cam_0: expected a table \[cameras.0\]"),
    "no cameras": ("[cameras]", "", "", "no camera in this Caliscope file"),
    "version": (OWN, "calibration-1", "calibration-9", "the format is 'sylpose-calibration-9'"),
    "unknown key": (OWN, "format", 'units = "m"\nformat', "unknown field `units`"),
    "unknown camera key": (OWN, "size", "zoom = 1\nsize", "camera left: object contains unknown field `zoom`"),
    "lens": (OWN, "size", 'lens = "mirror"\nsize', "camera left: lens: invalid enum value 'mirror'"),
    "unit": (OWN, "format", "unit = 1\nformat", "unit: expected `str`, got `int`"),
    "pose key": (OWN, "translation", "position", "camera left: .*unknown field `position`"),
    "own without cameras": ('format = "sylpose-calibration-1"', "", "", "missing key 'cameras'"),
    "something else": (
        "[tool.ruff]\nline-length = 1",
        "",
        "",
        "not a calibration of a known format; known are sylpose",
    ),
    "own without format": (OWN, 'format = "sylpose-calibration-1"', "", "sylpose TOML, without format ="),
    "not TOML": ("hello there", "", "", "not valid TOML"),
    "empty": ("", "", "", "not a calibration of a known format"),
}


@pytest.mark.parametrize("bad", BAD_TOML)
def test_bad_toml(bad: str, tmp_path: Path) -> None:
    text, old, new, message = BAD_TOML[bad]
    assert old in text
    with pytest.raises(ValueError, match=rf"calibration\.toml: .*{message}") as caught:
        calibration.load(write_file(tmp_path / "calibration.toml", text.replace(old, new, 1) if old else text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", '{"cam_0": ', "not valid JSON"),
        ("a.json", '{"cam_0": {}, "cam_0": {}}', "duplicate key 'cam_0'"),
        ("a.json", '{"name": "npm"}', "not a calibration of a known format"),
        ("a.json", '{"cameras": 3}', "'cameras' must be a map or a sequence"),
        ("a.json", '{"cameras": []}', "cameras: a rig needs at least one camera"),
        ("a.json", '{"cameras": [{"K": 1}]}', r"cameras\[0\] must be a map with a key 'name'"),
        ("a.json", '{"cameras": [3]}', r"cameras\[0\] must be a map"),
        (
            "a.json",
            json.dumps({"cameras": [json_camera(name="a")] * 2}),
            "cameras: two cameras of the same name in a, a",
        ),
        ("a.json", json.dumps({"unit": 3, "cam_0": json_camera()}), "unit must be a string"),
        ("a.json", json.dumps(json_camera()), "contains a single lens"),
        ("a.yml", "%YAML:1.0\n---\na: 1\na: 2\n", "duplicate key 'a'"),
        ("a.yml", "cam_0: [\n", "not valid YAML: .*line 2"),
        ("a.yml", "cam_0: &a\n  K: 1\ncam_1: *a\n", "YAML aliases"),
        ("a.yml", "", "not a calibration of a known format"),
        ("a.xml", "<opencv_storage><a>", "not valid XML"),
        ("a.xml", "<html></html>", "not a calibration of a known format"),
        ("a.txt", "hello there", "not a calibration of a known format; known are sylpose, Anipose, Caliscope"),
    ],
)
def test_bad_files(name: str, text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"{name}: {message}") as caught:
        calibration.load(write_file(tmp_path / name, text))
    assert "\n" not in str(caught.value)


def test_not_text(tmp_path: Path) -> None:
    (tmp_path / "calibration.toml").write_bytes(b"\xfa\xfe\x00\x80")
    with pytest.raises(ValueError, match=r"calibration\.toml: not text in UTF-8"):
        calibration.load(tmp_path / "calibration.toml")


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"calibration\.toml"):
        calibration.load(tmp_path / "calibration.toml")


# Finding the calibration of a session


@pytest.mark.parametrize(
    "name",
    [
        *("calibration.toml", "camera_array.toml", "calibration.yml", "calibration.yaml", "calibration.json"),
        *("calibration.xml", "Calib.toml", "Calib_scene.toml", "camera_calibration.yml", "rig.toml", "cameras.json"),
    ],
)
def test_find(name: str, tmp_path: Path) -> None:
    for other in ("dataset.toml", "boxes.toml", "session.toml", "timestamps.csv", "cam_0.mp4", "calibration.png"):
        write_file(tmp_path / other, "")
    (tmp_path / "calibration").mkdir()
    write_file(tmp_path / name, "")
    assert calibration.find(tmp_path) == tmp_path / name
    assert calibration.find(str(tmp_path)) == tmp_path / name


def test_find_none(tmp_path: Path) -> None:
    write_file(tmp_path / "dataset.toml", "")
    with pytest.raises(ValueError, match="no calibration in it; expected one such as"):
        calibration.find(tmp_path)


def test_find_two(tmp_path: Path) -> None:
    write_file(tmp_path / "camera_array.toml", "")
    write_file(tmp_path / "calibration.yml", "")
    with pytest.raises(ValueError, match=r"2 calibrations \(calibration.yml, camera_array.toml\)"):
        calibration.find(tmp_path)


def test_find_no_folder(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere: no such folder"):
        calibration.find(tmp_path / "nowhere")


@pytest.mark.parametrize(
    "name",
    [
        *("camchain.yaml", "results-camchain.yaml", "take.qca.txt", "Trial.xcp", "system.mcal", "transforms.json"),
        *("intri.yml", "intrinsics.yml", "stereo_params.pickle", "camera1.Pmat.cal", "rig_config.json"),
    ],
)
def test_find_by_program_names(name: str, tmp_path: Path) -> None:
    for other in (
        "boxes.toml",
        "timestamps.csv",
        "cam_0.mp4",
        "extri.yml",
        "extrinsics.yml",
        "camera2.Pmat.cal",
        "cameras.txt",
    ):
        write_file(tmp_path / other, "")
    write_file(tmp_path / name, "")
    assert calibration.find(tmp_path) == tmp_path / name
    write_file(tmp_path / "calibration.toml", "")
    assert calibration.find(tmp_path) == tmp_path / "calibration.toml"


@pytest.mark.parametrize(
    "names",
    [
        *(("hires_cam1_params.mat", "hires_cam2_params.mat"), ("a.cameramodel", "b.cameramodel"), ("a.krtd", "b.krtd")),
        *(("cam1.tif.ori", "cam2.tif.ori"), ("mayaCam_1.csv", "mayaCam_2.csv"), ("scene_camera_a.json",)),
        *(("wand_dltCoefs.csv",), ("20210101_Label3D_dannce.mat",), ("scene_camera.json",)),
    ],
)
def test_find_files_of_other_programs(names: tuple[str, ...], tmp_path: Path) -> None:
    """Files of one camera each are one calibration, represented by the first one."""
    for name in names:
        write_file(tmp_path / name, "")
    assert calibration.find(tmp_path) == tmp_path / names[0]
    write_file(tmp_path / "calibration.toml", "")
    assert calibration.find(tmp_path) == tmp_path / "calibration.toml"


@pytest.mark.parametrize("name", ["calibration", "calib_2024", "sparse/0"])
def test_find_folders(name: str, tmp_path: Path) -> None:
    rig = random_rig()
    (tmp_path / "calibration_images").mkdir()  # contains no calibration
    write_file(tmp_path / "calibration_images" / "0.png", "")
    (tmp_path / name).mkdir(parents=True)
    calibration.save(rig, tmp_path / name / "calibration.toml")
    assert calibration.find(tmp_path) == tmp_path / name
    assert_same(rig, calibration.load(tmp_path / name))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("stereoParams.mat", r"Matlab files are not supported; write stereoParams as JSON"),
        ("system.cal", r"\.cal is not supported; use OptiTrack's \.mcal"),
        ("calibration.csv", "tables are not supported as calibrations"),
        ("stereo.npz", "NumPy arrays have no standard names"),
    ],
)
def test_unsupported_files_name_alternatives(name: str, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"Frame,X\n" if name.endswith(".csv") else b"\x93\xff\x00")
    with pytest.raises(ValueError, match=rf"{name}: {message}"):
        calibration.load(tmp_path / name)


def test_known_formats_are_listed_completely(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"known are sylpose, .* and KWIVER$"):
        calibration.load(write_file(tmp_path / "a.txt", "hello there"))


def test_folders_with_several(tmp_path: Path) -> None:
    for name in ("calib_a.toml", "calib_b.toml"):
        calibration.save(random_rig(), tmp_path / name)
    with pytest.raises(ValueError, match=r"calib_a\.toml, calib_b\.toml; specify which one to use"):
        calibration.load(tmp_path)


def test_folders_without_a_calibration(tmp_path: Path) -> None:
    write_file(tmp_path / "notes.txt", "")
    with pytest.raises(ValueError, match="no calibration of a known format in this folder; known are sylpose"):
        calibration.load(tmp_path)


def test_format_of(tmp_path: Path) -> None:
    for name, text, format_ in (
        ("a.toml", ANIPOSE, "Anipose TOML"),
        ("a.toml", CALISCOPE, "Caliscope TOML"),
        ("a.toml", OWN, "sylpose TOML"),
        ("a.yml", next(iter(STORAGE.values())), "OpenCV FileStorage"),
    ):
        assert calibration.format_name(write_file(tmp_path / name, text)) == format_
