"""Folder of a recording, shared by the tests of capture."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.io.capture.test_capture import make_calibration


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A session folder with a calibration of two cameras and nothing else."""
    make_calibration(tmp_path)
    return tmp_path
