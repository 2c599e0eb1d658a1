"""Fixtures: a first recording, tracked once for all tests that reuse its object model."""

from __future__ import annotations

from pathlib import Path

import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.app.object_files import OBJECT_FILE, load_object
from sylpose.app.run import track_session
from sylpose.capture import open_session
from sylpose.report.files import read_trajectory
from sylpose.tracking.known_object import KnownObject
from tests.recordings import FIRST, mapping_path, write_box_recording


@pytest.fixture(scope="session")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording's folder with its results in it; read-only."""
    folder = write_box_recording(tmp_path_factory.mktemp("first") / "take", mapping_path, FIRST)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sylpose.report.plots.plot_trajectory", lambda *_, **__: None)
        track_session(open_session(folder), overlay=False)
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
