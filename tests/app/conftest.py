"""The first take, tracked once for all tests that go on with what it has learnt."""

from __future__ import annotations

from pathlib import Path

import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.app.object_files import OBJECT, load_object
from sylpose.app.run import track_session
from sylpose.capture import open_session
from sylpose.report.files import read_trajectory
from sylpose.tracking.known_object import KnownObject
from tests.recordings import FIRST, learning, recorded


@pytest.fixture(scope="session")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with its results in it. Read only."""
    folder = recorded(tmp_path_factory.mktemp("first") / "take", learning, FIRST)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sylpose.report.plots.plot_trajectory", lambda *_, **__: None)
        track_session(open_session(folder), overlay=False)
    return folder


@pytest.fixture(scope="session")
def known(first: Path) -> KnownObject:
    """What it has learnt of the object."""
    return load_object(first / "sylpose" / OBJECT)


@pytest.fixture(scope="session")
def actor_from_object(first: Path) -> RigidTransform:
    """The frame that the object got in the first take, by its first pose, which is right by definition."""
    pose = next(p for p in read_trajectory(first / "sylpose" / "trajectory.csv") if p.world_from_object is not None)
    assert pose.world_from_object is not None
    return learning(pose.index).inv() * pose.world_from_object
