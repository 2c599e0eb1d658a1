"""Errors name what was typed: the option on the command line, the argument in Python."""

from __future__ import annotations

from pathlib import Path

import pytest

from sylpose import calibration
from sylpose.capture import open_session
from sylpose.cli import main
from sylpose.cli.common import as_typed, options_of
from sylpose.cli.track import track
from sylpose.report.files import write_trajectory
from sylpose.simulate import ring
from tests.exports.paths import path


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One image of each camera, which is enough for what is refused at once."""
    import cv2
    import numpy as np

    folder = tmp_path_factory.mktemp("session")
    rig = ring(2, size=(64, 48))
    calibration.save(rig, folder / "calibration.toml")
    for name in rig.names:
        (folder / name).mkdir()
        cv2.imwrite(str(folder / name / "0.png"), np.zeros((48, 64, 3), np.uint8))
    write_trajectory(folder / "result", path())
    return folder


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("track {} --euler XYQ --rate 5", "--euler: three axes are expected"),
        ("track {} --video x=y", "{}: --video: 'x' is no camera"),
        ("track {} --unit furlong", "--unit must be one of"),
        ("track {} --frame-offset cam_9=1", "{}: --frame-offset: cam_9 is no camera"),
        ("track {} --start 9", "--start must be in 0 ... 0"),
        ("track {} --seed -1", "--seed: -1 is not"),
        ("track {} --simulate-nodes some", "--simulate-nodes: 'some' is neither of"),
        ("track {} --world up=0,0,0", "--world must be a direction"),
        ("track {} --rate -1", "{}: --rate: frames per second"),
        ("check {} --video x=y", "{}: --video: 'x' is no camera"),
        ("check {} --unit furlong", "--unit must be one of"),
        ("view {}/result v --from 0 0 0 --euler XYQ", "--euler: three axes are expected"),
        ("compare {}/result {}/result --within -1", "--within must be a number"),
        ("calibration convert {}/calibration.toml {}/c.yml --to foo", "--to must be one of"),
        ("calibration convert {}/calibration.toml {}/c.yml --unit foo", "--unit must be one of"),
        ("calibration convert {}/calibration.toml {}/c.yml --world up=0,0,0", "--world must be a direction"),
        ("demo --turn nan --out {}/demo", "--turn: nan is not a finite number"),
    ],
)
def test_the_option_is_named(words: str, said: str, session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([word.replace("{}", str(session)) for word in words.split()]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("sylpose: " + said.replace("{}", str(session)))


def test_in_python_the_argument_is(session: Path) -> None:
    with pytest.raises(ValueError, match="cameras: 'x' is no camera"):
        open_session(session, cameras={"x": "y"})


def test_what_was_typed_itself_is_no_argument() -> None:
    options = options_of(track)
    assert options["offsets"] == "--frame-offset"
    assert options["plot_format"] == "--format"
    assert options["smooth"] == "--smooth"
    assert "session" not in options
    start = {"session": Path("start"), "camera": ["a=b"]}
    assert as_typed("start: nothing in it", options, start) == "start: nothing in it"
    assert as_typed("start: unit: not one", options, start) == "start: --unit: not one"
    for sentence in ("camera cam_0: unit", "units: m", "Unit must be", "unit", "stop.mp4: broken", "a/unit: no"):
        assert as_typed(sentence, options, start) == sentence
