"""Kernels are compiled once after an installation, by parallel processes."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numba
import pytest

import sylpose
from sylpose.geometry import kernel_cache
from sylpose.relative_pose import uncertainty
from sylpose.runs import precompile
from sylpose.runs.console_output import make_console


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the parts compiled in other processes, and compile none."""
    arguments: list[str] = []
    monkeypatch.setattr(precompile, "warm_up", lambda: None)
    monkeypatch.setattr(precompile, "_compile_in_subprocess", lambda part, **_: arguments.append(part))
    monkeypatch.setattr(precompile, "available_cores", lambda: 2)
    return arguments


@pytest.fixture
def installed(elsewhere: list[str], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Simulate a new installation: no kernel is cached before its part is compiled."""
    monkeypatch.setattr(precompile, "is_compiled", lambda: len(elsewhere) > 0)
    return elsewhere


def compile_here() -> None:
    """Compile all parts, or load them."""
    for part in precompile.PARTS:
        precompile.compile_part(part)


def test_compiled_kernels_are_reused(elsewhere: list[str]) -> None:
    compile_here()
    assert precompile.is_compiled()
    precompile.compile_all()
    assert not elsewhere


def test_outdated_kernels_count_as_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    compile_here()
    with monkeypatch.context() as other:
        other.setattr(kernel_cache, "compute_digest", lambda _: "of other sources")
        assert not precompile.is_compiled()
    kernel: Any = uncertainty.minimize_across_valley
    monkeypatch.setattr(type(kernel.targetctx.codegen()), "magic_tuple", lambda _: ("another", "processor", ""))
    assert not precompile.is_compiled()


def test_each_part_is_compiled_once(installed: list[str]) -> None:
    done: list[float] = []
    precompile.compile_all(done.append)
    assert sorted(installed) == sorted(precompile.PARTS)
    assert done[-1] == 1.0
    precompile.compile_all()
    assert len(installed) == len(precompile.PARTS)


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replace the parts by two that record that they ran."""
    names: list[str] = []
    parts = {name: precompile.Part(partial(names.append, name), None) for name in "ab"}
    monkeypatch.setattr(precompile, "PARTS", parts)
    return names


def test_no_processes_without_cache_folder(
    installed: list[str], ran: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(precompile, "find_kernel_cache", lambda: None)
    precompile.compile_all()
    assert (ran, installed) == (["a", "b"], [])


def test_single_core_compiles_in_one_process(
    installed: list[str], ran: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(precompile, "available_cores", lambda: 1)
    precompile.compile_all()
    assert (ran, installed) == (["a", "b"], [])


def test_progress_is_the_share_of_functions(installed: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """It grows with each function that a process has compiled, and ends before all are."""

    def compile_three(part: str, on_compiled: Callable[[str], None]) -> None:
        installed.append(part)
        for name in "abc":
            on_compiled(name)

    monkeypatch.setattr(precompile, "_compile_in_subprocess", compile_three)
    monkeypatch.setattr(precompile, "N_FUNCTIONS", 10)
    done = list[float]()
    precompile.compile_all(done.append)
    assert done == pytest.approx([min(k / 10, 0.99) for k in range(1, 3 * len(precompile.PARTS) + 1)] + [1.0])


def test_functions_compiled_by_a_process_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    program, popen = [sys.executable, "-c", "print('first', 'second', sep=chr(10))"], subprocess.Popen
    names, commands = list[str](), list[list[str]]()

    def run(command: list[str], **options: Any) -> Any:
        commands.append(command)
        return popen(program, **options)

    monkeypatch.setattr(subprocess, "Popen", run)
    precompile._compile_in_subprocess("tracking", names.append)
    assert names == ["first", "second"]
    assert commands[0][-3:] == ["-m", "sylpose.runs.precompile", "tracking"]


def test_names_of_compiled_functions(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def double(value: float) -> float:
        return 2.0 * value

    compiled: Any = numba.njit(double)
    monkeypatch.setattr(precompile, "PARTS", {"new": precompile.Part(partial(compiled, 1.0), compiled)})
    precompile.main(["new", "new"])
    (name,) = capsys.readouterr().out.splitlines()
    assert name.endswith("double")
    precompile.main(["new"])
    assert capsys.readouterr().out == ""


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
    compile_here()
    precompile.compile_with_progress(make_console())
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("part", sorted(precompile.PARTS))
def test_every_part_runs(part: str) -> None:
    precompile.main([part])


def test_compile_part_by_name() -> None:
    precompile.compile_part("tracking")
    command = [sys.executable, "-m", "sylpose.runs.precompile", "tracking"]
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
