"""The examples run on a simulated recording and print the expected output."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from tests.conftest import FRAMES
from tests.paths import REPOSITORY

EXAMPLES = REPOSITORY / "examples"


def run_example(
    name: str, args: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> list[str]:
    monkeypatch.setattr("sys.argv", [name, *args])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out.splitlines()


def test_track_videos(recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    lines = run_example("track_videos.py", [str(recording)], monkeypatch, capsys)
    assert len(lines) == FRAMES
    assert "pan 0.00°" in lines[0]
    assert lines[-1].startswith("  0.367 s")


def test_track_videos_requires_a_recording(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"usage: python examples/track_videos\.py RECORDING"):
        run_example("track_videos.py", [], monkeypatch, capsys)


def test_own_arrays(recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    lines = run_example("own_arrays.py", [str(recording)], monkeypatch, capsys)
    assert lines.count("Motion: ok. The estimate converged and every requested quantity is observable.") == 3
    assert sum("360 bytes" in line for line in lines) == 3
