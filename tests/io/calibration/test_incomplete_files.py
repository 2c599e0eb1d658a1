"""Incomplete files of a format: the error names the format and what is missing."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks.fuzz_calibrations import SAMPLES
from sylpose.io import calibration
from sylpose.io.calibration.incomplete_files import describe_incomplete


def sample_text(sample: str) -> str:
    return SAMPLES[sample].samples[-1].decode()


def remove_pattern(sample: str, pattern: str) -> str:
    """Return a sample without the given pattern, which must occur in it."""
    text, n = re.subn(pattern, "", sample_text(sample))
    assert n
    return text


def remove_keys(sample: str, *keys: str) -> str:
    data: dict[str, Any] = json.loads(sample_text(sample))
    return json.dumps({key: value for key, value in data.items() if key not in keys})


MATRIX = r"%s: !!opencv-matrix\n(?:   .*\n){4}"
OPTI = "<calibrationProfile><Calibration><Cameras>%s</Cameras></Calibration></calibrationProfile>"
CAMERAS = {
    "sylpose, no format": ("c.toml", "[cameras.a]\nsize = [64, 48]\n", "sylpose TOML.*format ="),
    "sylpose, no cameras": ("c.toml", 'format = "sylpose-calibration-1"\n', "'cameras'"),
    "Caliscope, no camera": ("c.toml", "[cameras]\n", "Caliscope.*cameras"),
    "Caliscope, no pose": ("c.toml", "[cameras.0]\nport = 0\n", "Caliscope.*"),
    "Anipose, one key": ("c.toml", '[cam_0]\nname = "a"\nsize = [64, 48]\n', "Anipose.*a table for each camera"),
    "Anipose, metadata": ("c.toml", "[metadata]\nadjusted = true\n", "Anipose.*a table for each camera"),
    "stereo, M1": ("c.yml", remove_pattern("stereo", MATRIX % "[MD]2"), "OpenCV stereo.*M1 D1 and M2 D2"),
    "stereo, D": ("c.yml", remove_pattern("stereo", MATRIX % "M[12]"), "OpenCV stereo.*M1 D1 and M2 D2"),
    "stereo, R": ("c.yml", remove_pattern("stereo, poses", MATRIX % "(?:T|R1|R2)"), "OpenCV stereo.*M1 D1 and M2 D2"),
    "stereo, no pose": ("c.yml", sample_text("stereo"), "OpenCV stereo.*R and T"),
    "stereo, no lenses": ("c.yml", sample_text("stereo, poses"), "OpenCV stereo.*M1 D1 M2 D2"),
    "Kalibr, no model": ("camchain.yaml", remove_pattern("Kalibr", "  camera_model: .*\n"), "Kalibr.*(camera_model|lenses)"),
    "Kalibr, one lens": ("cam.yaml", "camera_model: pinhole\nintrinsics: 3\n", "Kalibr.*a row of intrinsics"),
    "rig_config": ("rig_config.json", '[{"cameras": []}]', "COLMAP rig_config.*image_prefix"),
    "COLMAP": ("cameras.txt", sample_text("COLMAP cameras.txt"), "COLMAP.*images must be next to"),
    "ROS, no model": ("l.yaml", remove_pattern("ROS camera_info", "distortion_model: .*\n"), "ROS.*distortion_model"),
    "ROS, no P": ("l.yaml", remove_pattern("ROS camera_info", r"projection_matrix:[\s\S]*"), "ROS.*K, P"),
    "ROS, no transform": ("tf.yaml", "transforms: []\n", "ROS.*a transform"),
    "ROS, no lens": ("tf.yaml", sample_text("ROS transforms"), "ROS transforms without a camera_info"),
    "JARVIS, lens": ("C.yaml", remove_pattern("JARVIS", MATRIX % "(?:intrinsicMatrix|R|T)"), "JARVIS.*intrinsicMatrix"),
    "JARVIS, no pose": ("C.yaml", remove_pattern("JARVIS", MATRIX % "[RT]"), "JARVIS.*R and T"),
    "EasyMocap, names": ("intri.yml", 'names:\n  - "01"\n', "EasyMocap.*K_ and dist_"),
    "EasyMocap, no names": (
        "intri.yml",
        remove_pattern("EasyMocap intri", "(?s)names:.*?(?=K_01)|K_02.*"),
        "EasyMocap.*names",
    ),
    "Qualisys": ("a.qca.txt", "<calibration><cameras/></calibration>", "Qualisys.*a camera"),
    "Vicon": ("a.xcp", '<Cameras VERSION="1.0"/>', "Vicon.*a Camera"),
    "Vicon, no pose": ("a.xcp", "<Cameras><Camera/></Cameras>", "Vicon.*KeyFrame"),
    "OptiTrack": ("a.mcal", OPTI % "", "OptiTrack.*a Camera"),
    "OptiTrack, no pose": ("a.mcal", OPTI % "<Camera/>", "OptiTrack.*Extrinsic"),
    "Metashape": ("c.xml", "<document><chunk/></document>", "Metashape.*sensors and cameras"),
    "Metashape, no sensors": ("c.xml", remove_pattern("Metashape", "(?s)<sensors>.*</sensors>"), "Metashape.*sensors"),
    "Metashape, no cameras": ("c.xml", remove_pattern("Metashape", "(?s)<cameras>.*</cameras>"), "cameras.*Metashape"),
    "Metashape, none aligned": (
        "c.xml",
        remove_pattern("Metashape", "(?s)<camera .*</camera>"),
        "Metashape is aligned.*transform",
    ),
    "Matlab, no second": ("m.json", remove_keys("Matlab", "CameraParameters2"), "Matlab.*of one camera.*of two"),
    "Matlab, no first": ("m.json", remove_keys("Matlab", "CameraParameters1"), "Matlab.*of one camera.*of two"),
    "Matlab, pose": ("m.json", '{"PoseCamera2": {}}', "Matlab.*CameraParameters1 and CameraParameters2"),
    "NeRF, empty": ("transforms.json", remove_keys("NeRF", "frames")[:-1] + ', "frames": []}', "NeRF.*transform_matrix"),
    "NeRF, no poses": ("transforms.json", '{"frames": [{"file_path": "a"}]}', "NeRF.*transform_matrix"),
    "NeRF, no frames": ("transforms.json", remove_keys("NeRF", "frames"), "NeRF.*transform_matrix"),
    "MultiCamSelfCal": ("basename1.rad", sample_text("MultiCamSelfCal, lens"), "MultiCamSelfCal.*Pmat"),
    "OpenCV": ("c.json", '{"camera_matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}', "one node per camera .* pose"),
}  # fmt: skip


@pytest.mark.parametrize("case", CAMERAS)
def test_format_and_missing_content_are_named(case: str, tmp_path: Path) -> None:
    name, text, pattern = CAMERAS[case]
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=rf"{re.escape(name)}: .*{pattern}") as raised:
        calibration.load(tmp_path / name)
    assert "not a calibration of a known format" not in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "text"), [("c.json", '{"foo": 1}'), ("c.xml", "<foo/>"), ("c.toml", "foo = 1\n"), ("c.json", "[]")]
)
def test_unrecognized_files_have_unknown_format(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match="not a calibration of a known format"):
        calibration.load(tmp_path / name)


def test_other_content_is_not_described() -> None:
    for data in (None, 3, "names", [], [3], {}, {3: 4}, {"a": {"b": 1}}):
        assert describe_incomplete("plain", data) is None
    assert describe_incomplete("unknown", "text") is None
