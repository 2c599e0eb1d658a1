"""Error messages name the option on the command line and the argument in Python."""

from __future__ import annotations

from pathlib import Path

import pytest

from sylpose.commands.app import map_option_names, substitute_option_name
from sylpose.commands.main import main
from sylpose.commands.track import TrackOptions
from sylpose.io import calibration
from sylpose.io.capture import open_session
from sylpose.report.files import write_trajectory
from sylpose.simulate import ring
from tests.io.exports.paths import make_trajectory


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a session with one image per camera, sufficient for errors raised at once."""
    import cv2
    import numpy as np

    folder = tmp_path_factory.mktemp("session")
    rig = ring(2, size=(64, 48))
    calibration.save(rig, folder / "calibration.toml")
    for name in rig.names:
        (folder / name).mkdir()
        cv2.imwrite(str(folder / name / "0.png"), np.zeros((48, 64, 3), np.uint8))
    write_trajectory(folder / "result", make_trajectory())
    return folder


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("track {} --euler XYQ --rate 5", "--euler: expected three axes"),
        ("track {} --video x=y", "{}: --video: 'x' is not a camera"),
        ("track {} --unit furlong", "--unit must be one of"),
        ("track {} --frame-offset cam_9=1", "{}: --frame-offset: cam_9 is not a camera"),
        ("track {} --start 9", "--start must be in 0 ... 0"),
        ("track {} --seed -1", "--seed: -1 is not"),
        ("track {} --simulate-nodes some", "--simulate-nodes: 'some' is neither of"),
        ("track {} --world up=0,0,0", "--world must be a direction"),
        ("track {} --rate -1", "{}: --rate: frames per second"),
        ("check {} --video x=y", "{}: --video: 'x' is not a camera"),
        ("check {} --unit furlong", "--unit must be one of"),
        ("view {}/result v --from 0 0 0 --euler XYQ", "--euler: expected three axes"),
        ("compare {}/result {}/result --within -1", "--within must be a number"),
        ("calibration convert {}/calibration.toml {}/c.yml --to foo", "--to must be one of"),
        ("calibration convert {}/calibration.toml {}/c.yml --unit foo", "--unit must be one of"),
        ("calibration convert {}/calibration.toml {}/c.yml --world up=0,0,0", "--world must be a direction"),
        ("demo --turn nan --out {}/demo", "--turn: nan is not a finite number"),
    ],
)
def test_errors_name_the_option(words: str, said: str, session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([word.replace("{}", str(session)) for word in words.split()]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("sylpose: " + said.replace("{}", str(session)))


def test_errors_of_live_sessions_name_the_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    calibration.save(ring(2, size=(64, 48)), tmp_path / "calibration.toml")
    (tmp_path / "live.toml").write_text("rate = 10.0\n[cameras]\ncam_0 = 0\ncam_1 = 1\n")
    assert main(["track", str(tmp_path), "--no-drop"]) == 2
    assert capsys.readouterr().err.startswith(f"sylpose: {tmp_path}: --no-drop: cameras and streams cannot wait")


def test_errors_in_python_name_the_argument(session: Path) -> None:
    with pytest.raises(ValueError, match="cameras: 'x' is not a camera"):
        open_session(session, cameras={"x": "y"})


def test_typed_values_are_not_taken_for_arguments() -> None:
    options = map_option_names(TrackOptions)
    assert options["offsets"] == "--frame-offset"
    assert options["plot_format"] == "--format"
    assert options["smooth"] == "--smooth"
    assert "session" not in options
    start = {"session": Path("start"), "camera": ["a=b"]}
    assert substitute_option_name("start: nothing in it", options, start) == "start: nothing in it"
    assert substitute_option_name("start: unit: not one", options, start) == "start: --unit: not one"
    for sentence in ("camera cam_0: unit", "units: m", "Unit must be", "unit", "stop.mp4: broken", "a/unit: no"):
        assert substitute_option_name(sentence, options, start) == sentence
