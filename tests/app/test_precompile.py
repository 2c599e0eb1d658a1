"""What is compiled once after an installation is so by processes beside each other, and not again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import sylpose
from sylpose.app import precompile
from sylpose.app.console_output import make_console
from sylpose.geometry import kernel_cache
from sylpose.relative_pose import robust_fit
from sylpose.relative_pose.precompile import warm_up


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The parts that other processes are asked for; what would be left then is not done."""
    asked: list[str] = []
    monkeypatch.setattr(precompile, "_compiled_elsewhere", asked.append)
    monkeypatch.setattr(precompile, "cores", lambda: 2)
    return asked


@pytest.fixture
def installed(elsewhere: list[str], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """As after an installation: nothing is there, if no part has been compiled."""
    monkeypatch.setattr(precompile, "is_compiled", lambda: len(elsewhere) > 0)
    return elsewhere


def test_what_is_compiled_is_not_compiled_again(elsewhere: list[str]) -> None:
    warm_up()
    assert precompile.is_compiled()
    precompile.compile_all()
    assert not elsewhere


def test_what_is_of_other_sources_or_another_processor_is_not_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    warm_up()
    with monkeypatch.context() as other:
        other.setattr(kernel_cache, "digest", lambda _: "of other sources")
        assert not precompile.is_compiled()
    kernel: Any = robust_fit.robust_fit
    monkeypatch.setattr(type(kernel.targetctx.codegen()), "magic_tuple", lambda _: ("another", "processor", ""))
    assert not precompile.is_compiled()


def test_after_an_installation_each_part_is_compiled_once(installed: list[str]) -> None:
    seconds: list[float] = []
    precompile.compile_all(seconds.append)
    assert sorted(installed) == sorted(precompile.PARTS)
    assert sum(seconds) == pytest.approx(precompile.TOTAL)
    precompile.compile_all()
    assert len(installed) == len(precompile.PARTS)


def test_where_nothing_can_be_kept_no_process_is_started(installed: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precompile, "kept_in", lambda: None)
    precompile.compile_all()
    assert not installed


def test_one_core_compiles_in_one_process(installed: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[str] = []
    monkeypatch.setattr(precompile, "cores", lambda: 1)
    monkeypatch.setattr(precompile, "PARTS", {"a": (1.0, lambda: ran.append("a")), "b": (2.0, lambda: ran.append("b"))})
    seconds: list[float] = []
    precompile.compile_all(seconds.append)
    assert (ran, seconds, installed) == (["a", "b"], [1.0, 2.0, precompile.REST], [])


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.usefixtures("installed")
def test_it_is_said_that_it_compiles_for_how_long_and_where_it_is_kept(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, kept: bool
) -> None:
    monkeypatch.setattr(kernel_cache, "_said", set())
    if not kept:
        monkeypatch.setattr(precompile, "kept_in", lambda: None)
    precompile.compile_aloud(make_console())
    precompile.compile_aloud(make_console())
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
    precompile.compile_aloud(make_console())
    assert [record.getMessage()[:17] for record in caplog.records] == ["sylpose compiles "]
    assert capsys.readouterr().out == ""


def test_nothing_is_said_where_it_has_been_done(capsys: pytest.CaptureFixture[str]) -> None:
    warm_up()
    precompile.compile_aloud(make_console())
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("part", sorted(precompile.PARTS))
def test_every_part_runs(part: str) -> None:
    precompile.main([part])


def test_a_part_by_its_name() -> None:
    command = [sys.executable, "-m", "sylpose.app.precompile", "following"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
