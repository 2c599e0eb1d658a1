"""`sylpose view`: a finished trajectory in a camera's frame, from the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.commands.main import main
from sylpose.io import calibration
from sylpose.report.files import TrajectoryWriter, read_trajectory, read_tum
from sylpose.results import FramePose
from sylpose.rig import Rig
from sylpose.simulate import ring
from sylpose.status import FrameStatus


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """Return a session's folder with a finished run of four poses in it."""
    rig = ring(3, height=0.5)
    calibration.save(rig, tmp_path / "calibration.toml")
    with TrajectoryWriter(tmp_path / "sylpose", rig.names, "m") as writer:
        for k in range(4):
            pose = RigidTransform.from_components([0.01 * k, 0.02, 0.0], Rotation.from_rotvec([0, 0.1 * k, 0]))
            writer.write(
                FramePose(k, k / 30, FrameStatus.TRACKED, pose, 1e-6 * np.eye(6), np.full(3, 9), np.full(3, 0.2))
            )
    return tmp_path


def rig_of(session: Path) -> Rig:
    return calibration.load(session / "calibration.toml")


def test_view_of_a_camera_of_the_session(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(session / "sylpose"), "cam_1"]) == 0
    output = capsys.readouterr().out
    folder = session / "sylpose"
    for suffix in ("tum", "csv", "png"):
        assert (folder / f"view_cam_1.{suffix}").stat().st_size > 0
        assert f"view_cam_1.{suffix}" in output
    assert "cam_1_from_object" in (folder / "view_cam_1.tum").read_text().splitlines()[0]
    camera = rig_of(session)["cam_1"]
    _, seen = read_tum(folder / "view_cam_1.tum")
    _, poses = read_tum(folder / "trajectory.tum")
    np.testing.assert_allclose(seen.translation, camera.camera_from_world.apply(poses.translation), atol=1e-9)
    turn = camera.camera_from_world.rotation
    np.testing.assert_allclose(seen.rotation.as_matrix(), (turn * poses.rotation * turn.inv()).as_matrix(), atol=1e-9)
    assert len(read_trajectory(folder / "view_cam_1.csv")) == 4


def test_view_of_a_virtual_camera(session: Path, tmp_path: Path) -> None:
    out = tmp_path / "views"
    where = ["--from", "0", "-2", "0.001", "--out", str(out)]
    arguments = ["view", str(session / "sylpose" / "trajectory.csv"), "top", *where]
    assert main(arguments) == 0
    _, seen = read_tum(out / "view_top.tum")
    # It is aimed at the object's first position, two units away.
    np.testing.assert_allclose(seen.translation[0], [0, 0, np.hypot(2.02, np.hypot(0.001, 0))], atol=1e-6)
    assert main([*arguments, "--at", "0.5", "0", "0"]) == 0
    _, again = read_tum(out / "view_top.tum")
    assert abs(again.translation[0, :2]).max() > 0.3


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["cam_9"], "no camera 'cam_9' in it (cam_0, cam_1, cam_2)"),
        (["top", "--at", "0", "0", "0"], "--at requires --from"),
        (["top", "--from", "0", "0", "9", "--calibration", "x.toml"], "exclude each other"),
        (["top", "--from", "0", "0.02", "0"], "its center equals its target"),
        (["top", "--from", "nan", "0", "0"], "--from: expected three finite numbers"),
        (["a/b", "--from", "0", "0", "9"], "which file names cannot contain"),
        (["cam_1", "--calibration", "nothing.toml"], "nothing.toml"),
    ],
)
def test_invalid_arguments_are_rejected(
    session: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    assert main(["view", str(session / "sylpose"), *arguments]) == 2
    output = capsys.readouterr().err
    assert sentence in output
    assert len(output.strip().splitlines()) == 1


def test_missing_results_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(tmp_path), "cam_1"]) == 2
    assert ": no result in it; expected a recording that was tracked" in capsys.readouterr().err


def test_calibration_is_required(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (session / "calibration.toml").rename(session / "rig_of_last_week.toml")
    assert main(["view", str(session / "sylpose"), "cam_1"]) == 2
    assert "--calibration FILE" in capsys.readouterr().err
    given = str(session / "rig_of_last_week.toml")
    assert main(["view", str(session / "sylpose"), "cam_1", "--calibration", given]) == 0


def test_commands_accept_the_recording(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The folder of the recording stands for the results in it."""
    results = session / "sylpose"
    for words in (["view", session, "cam_1"], ["export", session, "--out", session / "a.csv"], ["report", session]):
        assert main(list(map(str, words))) == 0, capsys.readouterr()
    assert (results / "view_cam_1.csv").is_file()
    assert str(results / "report.html") in capsys.readouterr().out
    assert main(["compare", str(session), str(results), "--out", str(session / "compared")]) == 0
