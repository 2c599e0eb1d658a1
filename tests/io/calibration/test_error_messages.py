"""Reprojection errors stored in calibrations are read, and kept in sylpose's own format."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from sylpose.io import calibration
from sylpose.rig import Rig
from sylpose.simulate import ring

CAMERA = """
[{table}]
name = "a"
size = [640, 480]
matrix = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0, 0.0]
rotation = [0.1, 0.2, 0.3]
translation = [0.0, 0.0, 1.0]
"""


def test_error_is_read(tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    path.write_text(CAMERA.format(table="cam_0") + "[metadata]\nadjusted = true\nerror = 0.41\n")
    assert calibration.load(path).cameras[0].error_px == 0.41
    path.write_text(CAMERA.format(table="cameras.0") + "error = 0.19\n")
    assert calibration.load(path).cameras[0].error_px == 0.19
    path.write_text(CAMERA.format(table="cam_0"))
    assert calibration.load(path).cameras[0].error_px is None


def test_error_is_kept(tmp_path: Path) -> None:
    rig = ring(2)
    with_error = Rig([replace(rig.cameras[0], error_px=0.25), rig.cameras[1]])
    calibration.save(with_error, tmp_path / "c.toml")
    assert [c.error_px for c in calibration.load(tmp_path / "c.toml")] == [0.25, None]
    with pytest.raises(ValueError, match="error_px"):
        replace(rig.cameras[0], error_px=-1.0)


@pytest.mark.parametrize("suffix", [".yml", ".json", ".xml"])
def test_error_is_kept_by_opencv(tmp_path: Path, suffix: str) -> None:
    rig = ring(2)
    with_error = Rig([replace(rig.cameras[0], error_px=0.25), rig.cameras[1]])
    calibration.save(with_error, tmp_path / f"c{suffix}")
    assert [c.error_px for c in calibration.load(tmp_path / f"c{suffix}")] == [0.25, None]


def test_opencv_error_keys(tmp_path: Path) -> None:
    """The error of all cameras, as in OpenCV's calibration sample, applies unless a camera has its own; an invalid
    value is reported with the camera's name."""
    path = tmp_path / "c.json"
    calibration.save(ring(2), path)
    data = json.loads(path.read_text())
    data["avg_reprojection_error"] = 0.4
    data["cameras"][1]["rms"] = 0.1
    path.write_text(json.dumps(data))
    assert [c.error_px for c in calibration.load(path)] == [0.4, 0.1]
    data["cameras"][1]["rms"] = "small"
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=r"c\.json: camera .*: the reprojection error must be a number of pixels"):
        calibration.load(path)
