"""Several moving bodies without boxes: what `sylpose check` draws, and what `sylpose track` says of them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.rendered_recordings import Recording, write_recording
from sylpose.commands.main import main
from sylpose.io.capture import open_session
from sylpose.report.files import read_trajectory
from sylpose.runs.candidates import select_candidate
from sylpose.runs.check import find_tracking_target
from sylpose.runs.options import RunOptions
from sylpose.status import FrameStatus
from tests.tracking.test_bodies import make_two_bodies

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture(scope="module")
def two_bodies(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("two_bodies")
    write_recording(Recording(make_two_bodies(8)), folder)
    (folder / "boxes.toml").unlink()
    return folder


def test_check_draws_all_bodies(two_bodies: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(two_bodies), "--out", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert "body 1, which moves from frame 0" in out
    assert "body 2, which moves from frame 0" in out
    assert "--object N" in out + err
    picture = cv2.imread(str(tmp_path / "target.png"))
    assert picture is not None
    # One row per body.
    assert np.isclose(picture.shape[0] / picture.shape[1], 2 * 240 / (3 * 320), rtol=0.01)


def test_check_searches_the_frames_that_are_tracked(
    two_bodies: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """So that number N is the same body for `sylpose track` with the same options."""
    options = ["--start", "2", "--stop", "7", "--every", "2"]
    assert main(["check", str(two_bodies), "--out", str(tmp_path), *options]) == 0
    assert "body 1, which moves from frame 2 to" in capsys.readouterr().out
    session = open_session(two_bodies)
    target = find_tracking_target(session, RunOptions(start=2, stop=7, every=2))
    chosen = select_candidate(session, RunOptions(start=2, stop=7, every=2, candidate=2))
    assert chosen is not None
    for drawn, features in zip(target.views[1].features or (), chosen.features, strict=True):
        np.testing.assert_array_equal(drawn, features)


def test_track_explains_ambiguity(two_bodies: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["track", str(two_bodies), "--out", str(tmp_path), "--no-overlay"]) == 1
    err = capsys.readouterr().err
    assert "--object N" in err
    assert "several bodies move" in err.lower()
    statuses = {pose.status for pose in read_trajectory(tmp_path / "trajectory.csv")}
    assert statuses == {FrameStatus.FIRST, FrameStatus.AMBIGUOUS}


def test_chosen_bodies_are_tracked(two_bodies: Path, tmp_path: Path) -> None:
    rotations = []
    for number in ("1", "2"):
        out = str(tmp_path / number)
        assert main(["track", str(two_bodies), "--out", out, "--no-overlay", "--object", number]) == 0
        poses = list(read_trajectory(tmp_path / number / "trajectory.csv"))
        assert {pose.status for pose in poses} == {FrameStatus.FIRST, FrameStatus.TRACKED}
        assert poses[-1].world_from_object is not None
        rotations.append(float(np.degrees(poses[-1].world_from_object.rotation.magnitude())))
    # 3 and 2.3 degrees per frame.
    np.testing.assert_allclose(sorted(rotations), [7 * np.degrees(0.04), 21.0], atol=0.5)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (["9"], "object 9: 2 bodies move"),
        (["0"], "--object: expected one number from 1 on"),
        (["1", "2"], "--object: expected one number from 1 on"),
    ],
)
def test_number_of_no_body(
    two_bodies: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], values: list[str], message: str
) -> None:
    options = [text for value in values for text in ("--object", value)]
    assert main(["track", str(two_bodies), "--out", str(tmp_path / "out"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
