"""Shared fixtures: one small rendered recording, made once per run."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from hypothesis import settings
from matplotlib.figure import Figure

from sylpose.simulate import make_demo_scene, write_sequence
from tests.browser import launch_browser

if TYPE_CHECKING:
    from playwright.sync_api import Browser

# The same examples in every run, so that failures are reproducible. No deadline: machines are shared.
settings.register_profile("seeded", derandomize=True, deadline=None)
settings.load_profile("seeded")

FRAMES = 12


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Render three videos of 12 frames, 320x240, with calibration, boxes and ground truth: a quarter of a 60 degree
    rotation.

    Read only; tests must not write into it.
    """
    folder = tmp_path_factory.mktemp("recording")
    scene = make_demo_scene(frames=4 * FRAMES, angle_deg=60.0, size=(320, 240), n_cameras=3)
    write_sequence(folder, replace(scene, frames=FRAMES), boxes=True)
    return folder


@pytest.fixture
def session(recording: Path, tmp_path: Path) -> Path:
    """Return a writable copy of `recording`."""
    return Path(shutil.copytree(recording, tmp_path / "session"))


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """For `tests.browser.opened`."""
    with launch_browser() as its:
        yield its


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace drawing of figures: their files are one pixel, and pages are empty.

    Drawing takes as long as tracking a few frames; tests/report and runs in separate processes test the drawings.
    """
    pixel = cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes()

    def savefig(_: Figure, path: Path | str, **__: object) -> None:
        Path(path).write_bytes(pixel)

    monkeypatch.setattr(Figure, "savefig", savefig)
    monkeypatch.setattr("sylpose.report.page.render_page", lambda *_: "")
