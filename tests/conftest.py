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
from scipy.spatial.transform import RigidTransform

from sylpose.io.capture import open_session
from sylpose.io.object_files import OBJECT_FILE, load_object
from sylpose.report.files import read_trajectory
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.simulate import make_demo_scene, write_sequence
from sylpose.tracking.known_object import KnownObject
from tests.chromium import launch_browser
from tests.recordings import FIRST, mapping_path, write_box_recording

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
    """For `tests.chromium.opened`."""
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


@pytest.fixture(scope="session")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording's folder with its results in it; read-only."""
    folder = write_box_recording(tmp_path_factory.mktemp("first") / "take", mapping_path, FIRST)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sylpose.report.plots.save_trajectory_plot", lambda *_, **__: None)
        track_session(open_session(folder), options=RunOptions(overlay=False))
    return folder


@pytest.fixture(scope="session")
def known(first: Path) -> KnownObject:
    """Return the object model of the first recording."""
    return load_object(first / "sylpose" / OBJECT_FILE)


@pytest.fixture(scope="session")
def actor_from_object(first: Path) -> RigidTransform:
    """Return the object frame of the first recording, defined by its first measured pose."""
    pose = next(p for p in read_trajectory(first / "sylpose" / "trajectory.csv") if p.world_from_object is not None)
    assert pose.world_from_object is not None
    return mapping_path(pose.index).inv() * pose.world_from_object
