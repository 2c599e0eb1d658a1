"""Shared by the tests: one small rendered recording, made once per run."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import settings

from sylpose.simulate import demo_scene, write_sequence

# The same examples in every run: what fails fails again. No deadline: machines are shared.
settings.register_profile("seeded", derandomize=True, deadline=None)
settings.load_profile("seeded")

FRAMES = 12


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three videos of 12 frames, 320x240, calibration, boxes and truth: the first quarter of a turn by 60 degrees. Read
    only; nothing may be written into it."""
    folder = tmp_path_factory.mktemp("recording")
    scene = demo_scene(frames=4 * FRAMES, turn_deg=60.0, size=(320, 240), n_cameras=3)
    write_sequence(folder, replace(scene, frames=FRAMES), boxes=True)
    return folder


@pytest.fixture
def session(recording: Path, tmp_path: Path) -> Path:
    """A copy of `recording`, to be changed."""
    return Path(shutil.copytree(recording, tmp_path / "session"))
