"""How far a run has come: told to a function, shown as a bar in a terminal, as a line in a notebook, or not at all."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from sylpose.app.progress import NotebookLine, watched
from sylpose.app.run import track_session
from sylpose.capture import open_session
from tests.conftest import FRAMES

pytestmark = pytest.mark.usefixtures("undrawn")


def test_a_function_is_told_each_frame(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told: list[tuple[int, int | None]] = []
    frames: list[int] = []
    track_session(
        open_session(recording),
        tmp_path,
        stop=8,
        overlay=False,
        progress=lambda done, total: told.append((done, total)),
        on_frame=lambda tracked: frames.append(tracked.pose.index),
    )
    # Beside the other callbacks, and nothing is printed.
    assert told == [(k, 8) for k in range(1, 9)]
    assert frames == list(range(8))
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""


def test_a_resumed_run_goes_on_counting(recording: Path, tmp_path: Path) -> None:
    told: list[object] = []
    with pytest.raises(KeyboardInterrupt):
        track_session(
            open_session(recording), tmp_path, overlay=False, interrupted=lambda: len(told) > 0, on_frame=told.append
        )
    said: list[tuple[int, int | None]] = []
    track_session(
        open_session(recording), tmp_path, overlay=False, resume=True, progress=lambda *numbers: said.append(numbers)
    )
    first = said[0][0]
    assert first > 0
    assert [done for done, _ in said] == list(range(first, FRAMES + 1))
    assert {total for _, total in said} == {FRAMES}


def test_nothing_is_shown_unless_it_is_asked_for(
    recording: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    track_session(open_session(recording), tmp_path, stop=3, overlay=False)
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


def test_a_bar_in_a_terminal(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes anything for a terminal
    track_session(open_session(recording), tmp_path, stop=6, overlay=False, progress=True)
    shown = capfd.readouterr().err
    assert "Tracking" in shown
    assert "6/6" in shown
    assert "3 cameras" in shown


class Shown:
    """A notebook's output: what it has shown."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def display(self, line: object, *, display_id: bool) -> Shown:
        assert display_id
        self.update(line)
        return self

    def update(self, line: object) -> None:
        self.lines.append(repr(line))


@pytest.fixture
def notebook(monkeypatch: pytest.MonkeyPatch) -> Shown:
    """As if this were one."""
    shown, module = Shown(), ModuleType("IPython.display")
    module.display = shown.display  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))
    monkeypatch.setitem(sys.modules, "IPython", ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", module)
    return shown


def test_a_line_in_a_notebook(
    recording: Path, tmp_path: Path, notebook: Shown, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sylpose.app.progress.OFTEN", 0.0)
    track_session(open_session(recording), tmp_path, stop=6, overlay=False, progress=True)
    assert notebook.lines[0] == "Tracking"
    (half,) = (line for line in notebook.lines if " 3 of 6 frames" in line)
    assert half.count("█") == half.count("░") == 15
    assert any(line.startswith("Refining all poses together, round ") for line in notebook.lines)
    assert notebook.lines[-1].startswith("6 frames in ")
    assert capfd.readouterr().err == ""


def test_a_line_does_not_change_too_often(notebook: Shown) -> None:
    line, frame = NotebookLine(1000, 1), Any
    for _ in range(999):
        line.update(frame)  # type: ignore[arg-type]
    assert len(notebook.lines) < 100
    line.update(frame)  # type: ignore[arg-type]
    assert "1000 of 1000 frames" in notebook.lines[-1]


def test_of_several_objects_frames_are_counted_once() -> None:
    told: list[tuple[int, int | None]] = []
    with watched(lambda *numbers: told.append(numbers), 3, None, 2) as shown:
        shown.skip(4)
        for _ in range(6):
            shown.update(Any)  # type: ignore[arg-type]
        shown.smoothing(1)
    assert told == [(4, None), (5, None), (6, None), (7, None)]


@pytest.mark.parametrize("wrong", [3, "yes", [1]])
def test_what_is_no_progress_is_refused(recording: Path, tmp_path: Path, wrong: Any) -> None:
    with pytest.raises(TypeError, match="progress must be True, None or a function"):
        track_session(open_session(recording), tmp_path / "out", overlay=False, progress=wrong)
