"""What is compiled once after an installation is so by processes beside each other, and not again."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sylpose.app import compiling
from sylpose.two_frames.warming import warm_up


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The parts that other processes are asked for."""
    asked: list[str] = []
    monkeypatch.setattr(compiling, "_compiled_elsewhere", asked.append)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    return asked


def test_what_is_compiled_is_not_compiled_again(elsewhere: list[str]) -> None:
    warm_up()
    assert compiling.is_compiled()
    compiling.compile_all()
    assert not elsewhere


def test_after_an_installation_each_part_is_compiled_once(
    elsewhere: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert not compiling.is_compiled()
    compiling.compile_all()
    assert sorted(elsewhere) == sorted(compiling.PARTS)
    # What numba keeps there is found.
    (tmp_path / "two_frames_1").mkdir()
    (tmp_path / "two_frames_1" / "robust_fit.robust_fit-58.py311.nbi").touch()
    assert compiling.is_compiled()


def test_where_nothing_can_be_kept_no_process_is_started(
    elsewhere: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "missing"))
    compiling.compile_all()
    assert not elsewhere


@pytest.mark.parametrize("part", sorted(compiling.PARTS))
def test_every_part_runs(part: str) -> None:
    compiling.main([part])


def test_a_part_by_its_name() -> None:
    command = [sys.executable, "-m", "sylpose.app.compiling", "following"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
