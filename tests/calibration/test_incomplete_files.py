"""Files of a format without what makes it a calibration: the sentence names the format and what is missing."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks.fuzz_calibrations import SAMPLES
from sylpose import calibration
from sylpose.calibration.incomplete_files import unfinished


def text_of(sample: str) -> str:
    return SAMPLES[sample].whole[-1].decode()


def without(sample: str, pattern: str) -> str:
    """A whole file but for what is told; it must be in it."""
    text, n = re.subn(pattern, "", text_of(sample))
    assert n
    return text


def lacking(sample: str, *keys: str) -> str:
    data: dict[str, Any] = json.loads(text_of(sample))
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
    "stereo, M1": ("c.yml", without("stereo", MATRIX % "[MD]2"), "OpenCV stereo.*M1 D1 and M2 D2"),
    "stereo, D": ("c.yml", without("stereo", MATRIX % "M[12]"), "OpenCV stereo.*M1 D1 and M2 D2"),
    "stereo, R": ("c.yml", without("stereo, poses", MATRIX % "(?:T|R1|R2)"), "OpenCV stereo.*M1 D1 and M2 D2"),
    "stereo, no pose": ("c.yml", text_of("stereo"), "OpenCV stereo.*R and T"),
    "stereo, no lenses": ("c.yml", text_of("stereo, poses"), "OpenCV stereo.*M1 D1 M2 D2"),
    "Kalibr, no model": ("camchain.yaml", without("Kalibr", "  camera_model: .*\n"), "Kalibr.*(camera_model|lenses)"),
    "Kalibr, one lens": ("cam.yaml", "camera_model: pinhole\nintrinsics: 3\n", "Kalibr.*a row of intrinsics"),
    "rig_config": ("rig_config.json", '[{"cameras": []}]', "COLMAP rig_config.*image_prefix"),
    "COLMAP": ("cameras.txt", text_of("COLMAP cameras.txt"), "COLMAP.*images must lie beside"),
    "ROS, no model": ("l.yaml", without("ROS camera_info", "distortion_model: .*\n"), "ROS.*distortion_model"),
    "ROS, no P": ("l.yaml", without("ROS camera_info", r"projection_matrix:[\s\S]*"), "ROS.*K, P"),
    "ROS, no transform": ("tf.yaml", "transforms: []\n", "ROS.*a transform"),
    "ROS, no lens": ("tf.yaml", text_of("ROS transforms"), "ROS transforms without a camera_info"),
    "JARVIS, lens": ("C.yaml", without("JARVIS", MATRIX % "(?:intrinsicMatrix|R|T)"), "JARVIS.*intrinsicMatrix"),
    "JARVIS, no pose": ("C.yaml", without("JARVIS", MATRIX % "[RT]"), "JARVIS.*R and T"),
    "EasyMocap, names": ("intri.yml", 'names:\n  - "01"\n', "EasyMocap.*K_ and dist_"),
    "EasyMocap, no names": ("intri.yml", without("EasyMocap intri", "(?s)names:.*?(?=K_01)|K_02.*"), "EasyMocap.*names"),
    "Qualisys": ("a.qca.txt", "<calibration><cameras/></calibration>", "Qualisys.*a camera"),
    "Vicon": ("a.xcp", '<Cameras VERSION="1.0"/>', "Vicon.*a Camera"),
    "Vicon, no pose": ("a.xcp", "<Cameras><Camera/></Cameras>", "Vicon.*KeyFrame"),
    "OptiTrack": ("a.mcal", OPTI % "", "OptiTrack.*a Camera"),
    "OptiTrack, no pose": ("a.mcal", OPTI % "<Camera/>", "OptiTrack.*Extrinsic"),
    "Metashape": ("c.xml", "<document><chunk/></document>", "Metashape.*sensors and cameras"),
    "Metashape, no sensors": ("c.xml", without("Metashape", "(?s)<sensors>.*</sensors>"), "Metashape.*sensors"),
    "Metashape, no cameras": ("c.xml", without("Metashape", "(?s)<cameras>.*</cameras>"), "cameras.*Metashape"),
    "Metashape, none aligned": ("c.xml", without("Metashape", "(?s)<camera .*</camera>"), "Metashape is aligned.*transform"),
    "Matlab, no second": ("m.json", lacking("Matlab", "CameraParameters2"), "Matlab.*of one camera.*of two"),
    "Matlab, no first": ("m.json", lacking("Matlab", "CameraParameters1"), "Matlab.*of one camera.*of two"),
    "Matlab, pose": ("m.json", '{"PoseCamera2": {}}', "Matlab.*CameraParameters1 and CameraParameters2"),
    "NeRF, empty": ("transforms.json", lacking("NeRF", "frames")[:-1] + ', "frames": []}', "NeRF.*transform_matrix"),
    "NeRF, no poses": ("transforms.json", '{"frames": [{"file_path": "a"}]}', "NeRF.*transform_matrix"),
    "NeRF, no frames": ("transforms.json", lacking("NeRF", "frames"), "NeRF.*transform_matrix"),
    "MultiCamSelfCal": ("basename1.rad", text_of("MultiCamSelfCal, lens"), "MultiCamSelfCal.*Pmat"),
    "OpenCV": ("c.json", '{"camera_matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}', "a node per camera, each with its pose"),
}  # fmt: skip


@pytest.mark.parametrize("case", CAMERAS)
def test_the_format_and_what_is_missing_are_named(case: str, tmp_path: Path) -> None:
    name, text, said = CAMERAS[case]
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=rf"{re.escape(name)}: .*{said}") as raised:
        calibration.load(tmp_path / name)
    assert "not a calibration of a known format" not in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "text"), [("c.json", '{"foo": 1}'), ("c.xml", "<foo/>"), ("c.toml", "foo = 1\n"), ("c.json", "[]")]
)
def test_what_nothing_tells_is_of_no_known_format(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match="not a calibration of a known format"):
        calibration.load(tmp_path / name)


def test_nothing_is_said_of_other_content() -> None:
    for data in (None, 3, "names", [], [3], {}, {3: 4}, {"a": {"b": 1}}):
        assert unfinished("plain", data) is None
    assert unfinished("unknown", "text") is None
