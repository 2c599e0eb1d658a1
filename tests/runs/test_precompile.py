"""Kernels are compiled once after an installation, by parallel processes."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

import sylpose
from sylpose.geometry import kernel_cache
from sylpose.relative_pose import robust_fit
from sylpose.relative_pose.solver import warm_up
from sylpose.runs import precompile
from sylpose.runs.console_output import make_console


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the parts compiled in other processes; the remaining kernel is not compiled."""
    arguments: list[str] = []
    monkeypatch.setattr(precompile, "_compile_in_subprocess", arguments.append)
    monkeypatch.setattr(precompile, "available_cores", lambda: 2)
    return arguments


@pytest.fixture
def installed(elsewhere: list[str], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Simulate a new installation: no kernel is cached before its part is compiled."""
    monkeypatch.setattr(precompile, "is_compiled", lambda: len(elsewhere) > 0)
    return elsewhere


def test_compiled_kernels_are_reused(elsewhere: list[str]) -> None:
    warm_up()
    assert precompile.is_compiled()
    precompile.compile_all()
    assert not elsewhere


def test_outdated_kernels_count_as_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    warm_up()
    with monkeypatch.context() as other:
        other.setattr(kernel_cache, "compute_digest", lambda _: "of other sources")
        assert not precompile.is_compiled()
    kernel: Any = robust_fit.fit_robust_motion
    monkeypatch.setattr(type(kernel.targetctx.codegen()), "magic_tuple", lambda _: ("another", "processor", ""))
    assert not precompile.is_compiled()


def test_each_part_is_compiled_once(installed: list[str]) -> None:
    done: list[float] = []
    precompile.compile_all(done.append)
    assert sorted(installed) == sorted(precompile.PARTS)
    assert done[-1] == 1.0
    precompile.compile_all()
    assert len(installed) == len(precompile.PARTS)


def test_no_processes_without_cache_folder(installed: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precompile, "find_kernel_cache", lambda: None)
    precompile.compile_all()
    assert not installed


def test_single_core_compiles_in_one_process(installed: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[str] = []
    monkeypatch.setattr(precompile, "available_cores", lambda: 1)
    monkeypatch.setattr(precompile, "PARTS", {"a": (1.0, lambda: ran.append("a")), "b": (2.0, lambda: ran.append("b"))})
    precompile.compile_all()
    assert (ran, installed) == (["a", "b"], [])


@pytest.mark.parametrize("name", ["__pycache__", "chosen"])
def test_progress_is_the_new_machine_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """It grows from kernel to kernel, also where outdated ones are replaced, and ends before all is compiled."""
    monkeypatch.setattr(precompile, "CODE_BYTES", 1000.0)
    monkeypatch.setattr(precompile, "WATCH_SECONDS", 0.01)
    monkeypatch.setattr(precompile, "display_folder", lambda _: tmp_path)
    folder = tmp_path / "features" / name if name == "__pycache__" else tmp_path / name
    folder.mkdir(parents=True)
    (folder / "old.nbc").write_bytes(bytes(400))
    (folder / "used.nbc").write_bytes(bytes(300))
    done, reported = list[float](), threading.Event()

    def report(share: float) -> None:
        done.append(share)
        reported.set()

    with precompile._watch_cache(folder, report):
        for kernel, size, expected in (("a", 200, 0.2), ("old", 401, 0.601), ("b", 900, 0.99)):
            (folder / f"{kernel}.nbc").write_bytes(bytes(size))
            deadline = time.monotonic() + 60.0
            while (not done or done[-1] < expected) and time.monotonic() < deadline:
                reported.wait(0.1)
            assert done[-1] == pytest.approx(expected)
    assert done == sorted(done)
    assert done[-1] == 1.0


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.usefixtures("installed")
def test_compilation_message(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, kept: bool) -> None:
    monkeypatch.setattr(kernel_cache, "_logged", set())
    if not kept:
        monkeypatch.setattr(precompile, "find_kernel_cache", lambda: None)
    precompile.compile_with_progress(make_console())
    precompile.compile_with_progress(make_console())
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("Compiling for one to two minutes ")
    wanted = f"after an installation or an update; cached in {Path(sylpose.__file__).parent}."
    if not kept:
        wanted = "at every start, as no folder is writable for their cache: set NUMBA_CACHE_DIR=FOLDER."
    assert line.endswith(wanted)


@pytest.mark.usefixtures("installed")
def test_compilation_message_is_not_repeated(
    capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_cache, "_logged", set())
    kernel_cache._log_compilation(Path("kernels"))
    precompile.compile_with_progress(make_console())
    assert [record.getMessage()[:17] for record in caplog.records] == ["sylpose compiles "]
    assert capsys.readouterr().out == ""


def test_no_message_if_compiled(capsys: pytest.CaptureFixture[str]) -> None:
    warm_up()
    precompile.compile_with_progress(make_console())
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("part", sorted(precompile.PARTS))
def test_every_part_runs(part: str) -> None:
    precompile.main([part])


def test_compile_part_by_name() -> None:
    command = [sys.executable, "-m", "sylpose.runs.precompile", "following"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.usefixtures("installed")
def test_progress_lines_without_a_terminal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precompile, "SECONDS_BETWEEN_LINES", 0.0)
    monkeypatch.setattr(precompile, "compile_all", lambda on_progress: on_progress(0.37))
    precompile.compile_with_progress(make_console(quiet=True))
    assert capsys.readouterr().err == ""
    precompile.compile_with_progress(make_console())
    assert capsys.readouterr().err == "sylpose: compiled 37%\n"
