"""Calibrations from Python: files, folders of several files, and recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

import sylpose
from sylpose.io import calibration
from sylpose.simulate import ring


def test_calibrations_are_loaded_from_files_and_folders(tmp_path: Path) -> None:
    rig = ring(3)
    calibration.save(rig, tmp_path / "calibration.toml")
    calibration.save(rig, tmp_path / "colmap", "colmap")
    for path in (tmp_path / "calibration.toml", str(tmp_path / "calibration.toml"), tmp_path, tmp_path / "colmap"):
        assert sylpose.load_calibration(path).names == rig.names


def test_missing_calibrations_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"{tmp_path.name}: no calibration in it"):
        sylpose.load_calibration(tmp_path)
    with pytest.raises(OSError, match=r"none\.toml"):
        sylpose.load_calibration(tmp_path / "none.toml")
