"""What is compiled once after an installation is so by processes beside each other, and not again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import sylpose
from sylpose.app import compiling
from sylpose.app.text import make_console
from sylpose.numerics import kernel_cache
from sylpose.two_frames import robust_fit
from sylpose.two_frames.warming import warm_up


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The parts that other processes are asked for; what would be left then is not done."""
    asked: list[str] = []
    monkeypatch.setattr(compiling, "_compiled_elsewhere", asked.append)
    monkeypatch.setattr(compiling, "cores", lambda: 2)
    return asked


@pytest.fixture
def installed(elsewhere: list[str], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """As after an installation: nothing is there, if no part has been compiled."""
    monkeypatch.setattr(compiling, "is_compiled", lambda: len(elsewhere) > 0)
    return elsewhere


def test_what_is_compiled_is_not_compiled_again(elsewhere: list[str]) -> None:
    warm_up()
    assert compiling.is_compiled()
    compiling.compile_all()
    assert not elsewhere


def test_what_is_of_other_sources_or_another_processor_is_not_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    warm_up()
    with monkeypatch.context() as other:
        other.setattr(kernel_cache, "digest", lambda _: "of other sources")
        assert not compiling.is_compiled()
    kernel: Any = robust_fit.robust_fit
    monkeypatch.setattr(type(kernel.targetctx.codegen()), "magic_tuple", lambda _: ("another", "processor", ""))
    assert not compiling.is_compiled()


def test_after_an_installation_each_part_is_compiled_once(installed: list[str]) -> None:
    seconds: list[float] = []
    compiling.compile_all(seconds.append)
    assert sorted(installed) == sorted(compiling.PARTS)
    assert sum(seconds) == pytest.approx(compiling.TOTAL)
    compiling.compile_all()
    assert len(installed) == len(compiling.PARTS)


def test_where_nothing_can_be_kept_no_process_is_started(installed: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "kept_in", lambda: None)
    compiling.compile_all()
    assert not installed


def test_one_core_compiles_in_one_process(installed: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[str] = []
    monkeypatch.setattr(compiling, "cores", lambda: 1)
    monkeypatch.setattr(compiling, "PARTS", {"a": (1.0, lambda: ran.append("a")), "b": (2.0, lambda: ran.append("b"))})
    seconds: list[float] = []
    compiling.compile_all(seconds.append)
    assert (ran, seconds, installed) == (["a", "b"], [1.0, 2.0, compiling.REST], [])


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.usefixtures("installed")
def test_it_is_said_that_it_compiles_for_how_long_and_where_it_is_kept(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, kept: bool
) -> None:
    monkeypatch.setattr(kernel_cache, "_said", set())
    if not kept:
        monkeypatch.setattr(compiling, "kept_in", lambda: None)
    compiling.compile_aloud(make_console())
    compiling.compile_aloud(make_console())
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("Compiling for one to two minutes, ")
    wanted = f"after an installation or an update; kept in {Path(sylpose.__file__).parent}."
    if not kept:
        wanted = "at every start; no folder can be written to keep it in, NUMBA_CACHE_DIR=FOLDER names one."
    assert line.endswith(wanted)


@pytest.mark.usefixtures("installed")
def test_it_is_not_said_again_where_a_kernel_has_said_it(
    capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_cache, "_said", set())
    kernel_cache._announce(Path("kernels"))
    compiling.compile_aloud(make_console())
    assert [record.getMessage()[:17] for record in caplog.records] == ["sylpose compiles "]
    assert capsys.readouterr().out == ""


def test_nothing_is_said_where_it_has_been_done(capsys: pytest.CaptureFixture[str]) -> None:
    warm_up()
    compiling.compile_aloud(make_console())
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("part", sorted(compiling.PARTS))
def test_every_part_runs(part: str) -> None:
    compiling.main([part])


def test_a_part_by_its_name() -> None:
    command = [sys.executable, "-m", "sylpose.app.compiling", "following"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
