"""Shared fixtures: small rendered recordings, made once for all processes that run the tests."""

from __future__ import annotations

import gc
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from filelock import FileLock
from hypothesis import settings
from scipy.spatial.transform import RigidTransform

from sylpose.io.object_files import OBJECT_FILE, load_object
from sylpose.report.files import read_trajectory
from sylpose.tracking.known_object import KnownObject
from tests.chromium import launch_browser
from tests.recordings import mapping_path, write_box_recording
from tests.remembered import REMEMBERED
from tests.saved import BOX_RESULT, FRAMES, copy_result, write_turn_recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from playwright.sync_api import Browser

# The same examples in every run, so that failures are reproducible. No deadline: machines are shared. More examples of
# each property: HYPOTHESIS_PROFILE=thorough.
settings.register_profile("seeded", derandomize=True, deadline=None, max_examples=20)
settings.register_profile("thorough", derandomize=True, deadline=None, max_examples=300)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "seeded"))

__all__ = ["FRAMES"]

# What importing all tests makes stays: looking for garbage among it takes a third of the time.
gc.disable()

# `--fast` leaves out files with one of these words: they render, track, draw, run commands, simulate networks, start
# processes or draw many scenes.
EXPENSIVE = re.compile(
    r"\b(Monte Carlo|subprocess|runpy|commands\.main|distributed\.solvers|track_session|simulation|render_\w+"
    r"|write_recording|bundle_adjust|process_recording|archive\.run|pages\.notebooks|tests\.(clips|recordings|chromium|boards)"
    r"|(?:from|import) benchmarks|report\.(plots|drawing|page)|tracking\.tracker|sylpose\.smoothing)\b"
)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--fast", action="store_true", help="only files of plain functions (`EXPENSIVE` in tests/conftest.py)"
    )


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave expensive files out of the fast lane before they are imported."""
    if not config.getoption("--fast") or not collection_path.match("test_*.py"):
        return None
    return EXPENSIVE.search(collection_path.read_text(encoding="utf-8")) is not None or None


def pytest_collection_finish() -> None:
    """Collect garbage again, but not among what has been imported."""
    gc.freeze()
    gc.enable()


def make_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder of this name with the files that a function writes into it, once for all processes."""
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent
    folder = base / name
    with FileLock(base / f"{name}.lock"):
        if not folder.exists():
            part = base / f"{name}.part"
            shutil.rmtree(part, ignore_errors=True)  # of a worker in which `make` failed
            part.mkdir()
            make(part)
            part.rename(folder)
    return folder


@pytest.fixture(scope="session", autouse=True)
def remembered() -> Iterator[None]:
    """Detect the keypoints of an image once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sylpose.features.sift._cv2", REMEMBERED)
        yield


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Render three videos of 12 frames, 320x240, with calibration, boxes and ground truth: a quarter of a 60 degree
    rotation.

    Read only; tests must not write into it.
    """
    return make_once(tmp_path_factory, "recording", write_turn_recording)


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
    from matplotlib.figure import Figure  # half a second, which tests without drawings do not need

    pixel = cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes()

    def savefig(_: Figure, path: Path | str, **__: object) -> None:
        Path(path).write_bytes(pixel)

    monkeypatch.setattr(Figure, "savefig", savefig)
    monkeypatch.setattr("sylpose.report.plots.draw_trajectory_figure", lambda *_, **__: Figure())
    monkeypatch.setattr("sylpose.report.page.render_page", lambda *_: "")


@pytest.fixture(scope="session")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the first frames of a recording and the saved results of all; read-only."""

    def make(folder: Path) -> None:
        write_box_recording(folder, mapping_path, 2)
        copy_result(BOX_RESULT, folder / "sylpose")

    return make_once(tmp_path_factory, "first", make)


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
