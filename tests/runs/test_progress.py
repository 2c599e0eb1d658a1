"""Progress of a run: calls of a function, a bar in a terminal, a line in a notebook, or nothing."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from sylpose.io.capture import open_session
from sylpose.runs.options import RunOptions
from sylpose.runs.progress import NotebookProgress, show_progress
from sylpose.runs.run import track_session

pytestmark = pytest.mark.usefixtures("undrawn")

# Number of frames tracked; fewer are faster.
N = 4


def test_callback_is_called_for_each_frame(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reported: list[tuple[int, int | None]] = []
    frames: list[int] = []
    track_session(
        open_session(recording),
        tmp_path,
        RunOptions(stop=N, overlay=False, smooth=False),
        progress=lambda done, total: reported.append((done, total)),
        on_frame=lambda _, tracked: frames.append(tracked.pose.index),
    )
    # It works with the other callbacks, and nothing is printed.
    assert reported == [(k, N) for k in range(1, N + 1)]
    assert frames == list(range(N))
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""


def test_resumed_run_continues_counting(recording: Path, tmp_path: Path) -> None:
    reported: list[object] = []
    with pytest.raises(KeyboardInterrupt):
        track_session(
            open_session(recording),
            tmp_path,
            RunOptions(overlay=False, smooth=False, stop=N),
            interrupted=lambda: len(reported) > 0,
            on_frame=lambda *frame: reported.append(frame),
        )
    message: list[tuple[int, int | None]] = []
    track_session(
        open_session(recording),
        tmp_path,
        RunOptions(overlay=False, smooth=False, stop=N, resume=True),
        progress=lambda *numbers: message.append(numbers),
    )
    first = message[0][0]
    assert first > 0
    assert [done for done, _ in message] == list(range(first, N + 1))
    assert {total for _, total in message} == {N}


def test_no_progress_by_default(recording: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    track_session(open_session(recording), tmp_path, RunOptions(stop=2, overlay=False))
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


def test_bar_in_terminal(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich then treats any output as a terminal
    track_session(open_session(recording), tmp_path, RunOptions(stop=N, overlay=False), progress=True)
    shown = capfd.readouterr().err
    assert "Tracking" in shown
    assert f"{N}/{N}" in shown
    assert "3 cameras" in shown


class Shown:
    """Fake of a notebook's output that records what is shown."""

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
    """Simulate a notebook."""
    shown, module = Shown(), ModuleType("IPython.display")
    module.display = shown.display  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))
    monkeypatch.setitem(sys.modules, "IPython", ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", module)
    return shown


def test_line_in_notebook(
    recording: Path, tmp_path: Path, notebook: Shown, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sylpose.runs.progress.MIN_UPDATE_SECONDS", 0.0)
    track_session(open_session(recording), tmp_path, RunOptions(stop=N, overlay=False), progress=True)
    assert notebook.lines[0] == "Tracking"
    (half,) = (line for line in notebook.lines if " 2 of 4 frames" in line)
    assert half.count("█") == half.count("░") == 15
    assert any(line.startswith("Refining all poses jointly, round ") for line in notebook.lines)
    assert notebook.lines[-1].startswith(f"{N} frames in ")
    assert capfd.readouterr().err == ""


def test_notebook_line_update_rate(notebook: Shown) -> None:
    line, frame = NotebookProgress(1000, 1), Any
    for _ in range(999):
        line.update(frame)  # type: ignore[arg-type]
    assert len(notebook.lines) < 100
    line.update(frame)  # type: ignore[arg-type]
    assert "1000 of 1000 frames" in notebook.lines[-1]


def test_frames_of_several_objects_are_counted_once() -> None:
    reported: list[tuple[int, int | None]] = []
    with show_progress(lambda *numbers: reported.append(numbers), 3, None, 2) as shown:
        shown.skip(4)
        for _ in range(6):
            shown.update(Any)  # type: ignore[arg-type]
        shown.report_smoothing_round(1)
    assert reported == [(4, None), (5, None), (6, None), (7, None)]


@pytest.mark.parametrize("wrong", [3, "yes", [1]])
def test_invalid_progress_is_rejected(recording: Path, tmp_path: Path, wrong: Any) -> None:
    with pytest.raises(TypeError, match="progress must be True, None or a function"):
        track_session(open_session(recording), tmp_path / "out", RunOptions(overlay=False), progress=wrong)
