"""`sylpose batch`: its files, output and exit codes; its results equal those of `sylpose track`."""

from __future__ import annotations

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from sylpose.archive import worker
from sylpose.archive.contract import RunSettings, collect_summaries, hold_claim, process_recording, read_record
from sylpose.archive.recordings import TrackingOptions, find_recordings
from sylpose.commands import batch_display
from sylpose.commands.main import main
from sylpose.io.capture import open_session
from sylpose.io.stores import open_store
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from tests.archive.archive_worker import count_work, do_work, make_recordings, make_settings

COLUMNS = ["recording", "status", "frames", "coverage", "residual_px", "faults", "seconds", "error"]


@pytest.fixture
def substitute_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the tracking by `archive_worker`."""
    monkeypatch.setattr(worker, "track_recording", do_work)


def table(out: Path) -> dict[str, dict[str, str]]:
    with (out / "summary.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == COLUMNS
    return {row["recording"]: row for row in rows}


@pytest.mark.usefixtures("undrawn")
def test_results_equal_track_command(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From one object store to another, and to a folder."""
    monkeypatch.setattr(worker, "compile_once_per_computer", lambda: None)
    pytest.importorskip("obstore", reason="the extra `archive`")
    store = open_store("memory://lab/archive")
    for path in recording.iterdir():
        store.write(f"day 1/turn/{path.name}", path)
    ((found,), _) = find_recordings([store.url], TrackingOptions(overlay=False, every=2, stop=7, seed=3))
    assert found.name == "day 1/turn"
    out = open_store("memory://results")
    settings = RunSettings(out, worker.track_recording, threads=2, scratch=str(tmp_path / "scratch"))
    summary = process_recording(found, settings)
    run = track_session(open_session(recording), tmp_path / "track", RunOptions(overlay=False, every=2, stop=7, seed=3))
    for path in (tmp_path / "track").iterdir():
        if path.suffix in (".csv", ".tum"):
            assert out.join("day 1/turn").read(path.name) == path.read_bytes(), path.name
    assert summary.status == "done"
    assert (summary.frames, summary.coverage) == (len(run.trajectory), 1.0)
    assert summary.residual_px is not None
    assert 0.02 < summary.residual_px < 0.5
    record = read_record(out.join("day 1/turn"))
    assert record is not None
    assert set(record.files) == {path.name for path in (tmp_path / "track").iterdir()}
    assert list((tmp_path / "scratch").iterdir()) == []


def test_errors_name_original_not_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "compile_once_per_computer", lambda: None)
    pytest.importorskip("obstore", reason="the extra `archive`")
    open_store("memory://broken/r").write("calibration.toml", b"?")
    open_store("memory://broken/r").write("cam_0.mp4", b"?")
    ((found,), _) = find_recordings(["memory://broken"], TrackingOptions())
    summary = process_recording(found, RunSettings(open_store(tmp_path / "out"), worker.track_recording))
    assert summary.status == "wrong input"
    assert summary.error.startswith("memory://broken/r/calibration.toml: not valid TOML")


@pytest.mark.usefixtures("substitute_work")
def test_batch_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = tmp_path / "in", tmp_path / "out"
    orders = {"a": "work", "b": "wrong", "c": "work"}
    make_recordings(folder, **orders)
    command = ["batch", str(folder), "--out", str(out), "--jobs", "1"]
    assert main([*command, "--status"]) == 0
    assert "Recordings    3: 3 waiting" in capsys.readouterr().out
    assert main(command) == 1
    message = capsys.readouterr()
    assert "3 recordings, 1 at a time" in message.out
    assert "Recordings    3: 2 done, 1 wrong input" in message.out
    assert "! b: cam_0 is upside down" in message.out
    assert "a: cam_1 was moved" in message.out
    assert message.err.splitlines()[-1] == "sylpose: 1 of 3 recordings without a trajectory"
    rows = table(out)
    assert rows["a"] | {"seconds": ""} == dict(
        zip(COLUMNS, ("a", "done", "7", "0.5", "", "cam_1 was moved", "", ""), strict=True)
    )
    assert rows["b"]["error"] == "cam_0 is upside down"
    assert [(name, row["frames"], row["coverage"]) for name, row in rows.items()] == [
        ("a", "7", "0.5"),
        ("b", "", ""),
        ("c", "7", "0.5"),
    ]
    # Again: nothing is done; with another seed, everything; changes are detected beforehand.
    assert main(command) == 1
    assert "3 of them are already finished" in capsys.readouterr().out
    assert [count_work(folder, name) for name in "abc"] == [1, 1, 1]
    (folder / "b" / "do").write_text("work now")
    assert main([*command, "--status"]) == 0
    assert table(out)["b"]["status"] == "outdated"
    assert main(command) == 0
    assert [count_work(folder, name) for name in "abc"] == [1, 2, 1]
    capsys.readouterr()
    with hold_claim(open_store(out).join("c"), "x"):
        assert main(["batch", "--status", "--out", str(out)]) == 0
    assert "Recordings    3: 2 done, 1 running" in capsys.readouterr().out


@pytest.mark.usefixtures("substitute_work")
def test_shards_process_their_part_and_status_collects_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_recordings(tmp_path / "in", **dict.fromkeys("abcde", "work"))
    for k in (1, 2):
        assert (
            main(["batch", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--jobs", "1", "--shard", f"{k}/2"])
            == 0
        )
        assert f"recordings, shard {k}/2 of 5" in capsys.readouterr().out
        assert not (tmp_path / "out" / "summary.csv").exists()
    assert main(["batch", "--status", "--out", str(tmp_path / "out")]) == 0
    assert set(table(tmp_path / "out")) == set("abcde")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["in"], "--out DEST is missing"),
        (["--out", "out"], "SOURCE is missing"),
        (["in", "--out", "out", "--jobs", "2", "--ray", "auto"], "exclude each other"),
        (["in", "--out", "out", "--shard", "0/3"], "--shard: one of 1/N to N/N"),
        (["nowhere", "--out", "out"], "no such folder"),
        (["--status", "--out", "out"], "contains no results of sylpose batch"),
        (["in", "--out", "in/a/do"], "cannot"),
        (["in", "--out", "out", "--ray", "auto"], "python3 -m pip install 'sylpose[cluster]'"),
        (["in", "--out", "out", "--start", "5", "--stop", "5"], "--stop must be greater"),
    ],
)
def test_invalid_usage_gives_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    make_recordings(tmp_path / "in", a="work")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main(["batch", *words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.usefixtures("substitute_work")
def test_batch_runs_outside_main_thread(tmp_path: Path) -> None:
    """Only a main thread can handle signals."""
    make_recordings(tmp_path / "in", a="work")
    command = ["batch", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--jobs", "1"]
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(main, command).result(120) == 0


def test_long_tables_are_truncated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = open_store(tmp_path / "out")
    recordings = make_recordings(tmp_path / "in", **{f"r{k:03}": "work" for k in range(40)}, s="wrong")
    for recording in recordings:
        process_recording(recording, make_settings(out))
    assert main(["batch", "--status", "--out", str(tmp_path / "out")]) == 0
    assert len(collect_summaries(out)) == len(table(tmp_path / "out")) == 41
    message = capsys.readouterr().out
    assert message.count(" done ") <= batch_display.MAX_ROWS + 1
    assert "Not shown     11: see summary.csv" in message


@pytest.mark.slow
def test_interrupt_exits_130_without_partial_results(recording: Path, tmp_path: Path) -> None:
    """By SIGTERM, as SLURM at the time limit; Ctrl-C is equivalent."""
    for name in ("a", "b"):
        shutil.copytree(recording, tmp_path / "in" / name)
    out, scratch = tmp_path / "out", tmp_path / "scratch"
    command = [sys.executable, "-m", "sylpose", "batch", "in", "--out", "out", "--scratch", "scratch", "--jobs", "1"]
    run = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, env=dict(os.environ))
    deadline = time.monotonic() + 60
    while not list(out.glob("*/claim-*")) and time.monotonic() < deadline and run.poll() is None:
        time.sleep(0.02)
    run.send_signal(signal.SIGTERM)
    assert run.stderr is not None
    message = run.stderr.read()
    assert run.wait(60) == 130
    assert message == "sylpose: interrupted after 0 of 2; finished results are kept, repeat the command to resume\n"
    assert [path for path in out.rglob("*") if path.is_file()] == [out / "batch.txt"]
    assert list(scratch.glob("*")) == []
