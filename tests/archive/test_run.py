"""Local processes: crashes are isolated, claims of others are awaited, threads and memory are bounded."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from pathlib import Path

import pytest

from sylpose.archive import run
from sylpose.archive.contract import RunSettings, Summary, collect_summaries, hold_claim
from sylpose.archive.recordings import Recording
from sylpose.archive.run import ProcessWorkers, WorkerDeathError, process_all
from sylpose.commands.batch import select_shard
from sylpose.io import stores
from sylpose.io.stores import open_store
from sylpose.runs.system_resources import available_cores, available_memory, choose_default_jobs
from tests.archive.archive_worker import count_work, make_recordings, make_settings
from tests.archive.s3 import s3_server


def run_recordings(
    recordings: list[Recording], settings: RunSettings, jobs: int = 2, memory: int | None = None
) -> dict[str, Summary]:
    found: dict[str, Summary] = {}

    def take(recording: Recording, summary: Summary) -> None:
        assert recording.name not in found
        found[recording.name] = summary

    with ProcessWorkers(settings, jobs, memory) as workers:
        process_all(recordings, settings, workers, take)
    return found


def test_dead_worker_loses_only_its_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "RETRY_INTERVAL", 0.1)
    monkeypatch.setattr(run, "MAX_ATTEMPTS", 2)
    folder, out = tmp_path / "in", open_store(tmp_path / "out")
    orders = {"a": "io-once", "b": "die", "c": "die-once", "d": "exit", "e": "wrong", "f": "work"}
    found = run_recordings(make_recordings(folder, **orders), make_settings(out, threads=3))
    assert {name: summary.status for name, summary in found.items()} == {
        "a": "done",
        "b": "crashed",
        "c": "done",
        "d": "crashed",
        "e": "wrong input",
        "f": "done",
    }
    assert found["b"].error == "the worker was killed by SIGKILL: out of memory?, 2 times"
    assert found["d"].error == "the worker ended with exit code 3, 2 times"
    assert [count_work(folder, name) for name in "abcdef"] == [2, 2, 2, 2, 1, 1]
    assert {name: s.status for name, s in collect_summaries(out).items()} == {n: s.status for n, s in found.items()}
    assert out.read("f/threads") == b"3 3"
    assert not any("claim" in file.name for file in out.files())


def test_memory_is_bounded(tmp_path: Path) -> None:
    if os.uname().sysname != "Linux":
        pytest.skip("RLIMIT_DATA is Linux's")
    out = open_store(tmp_path / "out")
    recordings = make_recordings(tmp_path / "in", large="memory 3000000000", small="memory 1000000")
    found = run_recordings(recordings, make_settings(out), jobs=1, memory=2 << 30)
    assert found["large"].error == "it exceeded the memory limit of one recording"
    assert found["small"].status == "done"


def test_recordings_held_by_others_are_awaited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "RETRY_INTERVAL", 0.1)
    monkeypatch.setattr(run, "WORKER_CHECK_INTERVAL", 0.05)
    out = open_store(tmp_path / "out")
    (one,) = make_recordings(tmp_path / "in", one="work")
    held, let_go = threading.Event(), threading.Event()

    def other() -> None:
        with hold_claim(out.join("one"), "b"):
            held.set()
            let_go.wait(60)

    thread = threading.Thread(target=other)
    thread.start()
    held.wait(60)
    looks: list[tuple[int, int]] = []
    found: list[Summary] = []

    def look(running: int, waits: int) -> None:
        looks.append((running, waits))
        if waits:
            let_go.set()

    settings = make_settings(out)
    with ProcessWorkers(settings, 1) as workers:
        process_all([one], settings, workers, lambda _, summary: found.append(summary), look)
    thread.join()
    assert [summary.status for summary in found] == ["done"]
    assert (0, 1) in looks


def test_failed_disk_is_retried_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "RETRY_INTERVAL", 1.0)
    one, two = make_recordings(tmp_path / "in", one="io-once", two="work")
    looks, settings = list[tuple[int, int]](), make_settings(open_store(tmp_path / "out"))
    found: dict[str, Summary] = {}

    def look(running: int, later: int) -> None:
        looks.append((running, later))

    with ProcessWorkers(settings, 1) as workers:
        start = time.monotonic()
        process_all([one, two], settings, workers, lambda r, s: found.update({r.name: s}), look)
    assert {name: summary.status for name, summary in found.items()} == {"two": "done", "one": "done"}
    assert list(found) == ["two", "one"]
    assert (0, 1) in looks
    assert time.monotonic() - start > run.RETRY_INTERVAL


def test_idle_worker_that_died_costs_no_attempt(tmp_path: Path) -> None:
    one, two = make_recordings(tmp_path / "in", one="work", two="work")
    with ProcessWorkers(make_settings(open_store(tmp_path / "out")), 1) as workers:
        assert workers.submit(one).result(60).status == "done"
        (process,) = workers._processes
        process.kill()
        process.join()
        assert workers.submit(two).result(60).status == "done"


def test_interrupt_ends_all_workers_without_files(tmp_path: Path) -> None:
    folder, out, scratch = tmp_path / "in", open_store(tmp_path / "out"), tmp_path / "scratch"
    recordings = make_recordings(folder, a="sleep 600", b="sleep 600")
    start = time.monotonic()

    def look(*_: int) -> None:
        if all(count_work(folder, name) for name in "ab"):
            raise KeyboardInterrupt

    settings = make_settings(out, scratch=str(scratch))
    workers = ProcessWorkers(settings, 2)
    with pytest.raises(KeyboardInterrupt), workers:
        process_all(recordings, settings, workers, lambda *_: None, look)
    assert time.monotonic() - start < 300
    assert not any(process.is_alive() for process in workers._processes)
    assert out.files() == []
    assert list(scratch.iterdir()) == []


class MortalWorkers:
    """Workers on computers that are lost a given number of times."""

    def __init__(self, times: int) -> None:
        self.times = times

    def capacity(self) -> int:
        return 1

    def submit(self, recording: Recording) -> Future[Summary]:
        assert recording.name == "one"
        self.times -= 1
        future = Future[Summary]()
        if self.times >= 0:
            future.set_exception(WorkerDeathError("the computer was lost"))
        else:
            future.set_result(Summary(status="done"))
        return future


@pytest.mark.parametrize(("times", "status"), [(2, "done"), (3, "crashed")])
def test_lost_computers_cost_an_attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, times: int, status: str
) -> None:
    monkeypatch.setattr(run, "RETRY_INTERVAL", 0.1)
    found: list[Summary] = []
    recordings, settings = make_recordings(tmp_path / "in", one="work"), make_settings(open_store(tmp_path / "out"))
    process_all(recordings, settings, MortalWorkers(times), lambda _, summary: found.append(summary))
    assert [summary.status for summary in found] == [status]
    assert found[0].error == ("" if status == "done" else "the computer was lost, 3 times")


def test_shards_partition_recordings(tmp_path: Path) -> None:
    recordings = make_recordings(tmp_path, **{f"r{k:02}": "work" for k in range(10)})
    shards = [select_shard(recordings, f"{k}/3") for k in (1, 2, 3)]
    assert sorted(r.name for shard in shards for r in shard) == [r.name for r in recordings]
    assert {len(shard) for shard in shards} == {3, 4}
    assert select_shard(recordings, "12/12") == []
    for wrong in ("0/3", "4/3", "3", "a/b", "1/0", "-1/3", "1/3/3"):
        with pytest.raises(ValueError, match="1/N to N/N"):
            select_shard(recordings, wrong)


def test_default_jobs_fit_cores_and_memory() -> None:
    assert 1 <= choose_default_jobs(1) <= available_cores()
    assert choose_default_jobs(10_000) == 1
    assert (available_memory() or 1 << 30) >= 1 << 30


def test_processes_on_an_object_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the S3 protocol, with credentials in the environment; two simultaneous runs process each recording once."""
    pytest.importorskip("obstore", reason="the extra `archive`")
    bucket: dict[str, bytes] = {}
    with s3_server(bucket) as address:
        settings = {"ENDPOINT": address, "ALLOW_HTTP": "true", "ACCESS_KEY_ID": "a", "SECRET_ACCESS_KEY": "b"}
        for name, value in (settings | {"REGION": "us-east-1"}).items():
            monkeypatch.setenv(f"AWS_{name}", value)
        monkeypatch.setattr(run, "RETRY_INTERVAL", 0.1)
        stores._connect.cache_clear()
        out = open_store("s3://lab/results of may")
        recordings = make_recordings(tmp_path / "in", a="sleep 0.2", b="die-once", c="wrong", d="work")
        found: list[dict[str, Summary]] = [{}, {}]

        def batch(k: int) -> None:
            found[k] = run_recordings(recordings[:: 1 - 2 * k], make_settings(out, run=str(k)), jobs=1)

        threads = [threading.Thread(target=batch, args=(k,)) for k in (0, 1)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert [{name: found[k][name].status for name in "abcd"} for k in (0, 1)] == [
            {"a": "done", "b": "done", "c": "wrong input", "d": "done"}
        ] * 2
        assert [count_work(tmp_path / "in", name) for name in "abcd"] == [1, 2, 1, 1]
        assert [summary.status for summary in collect_summaries(out).values()] == [
            "done",
            "done",
            "wrong input",
            "done",
        ]
        files = ("done.json", "mug/trajectory.csv", "threads")
        expected = {f"results of may/{name}/{file}" for name in "abd" for file in files}
        assert set(bucket) == expected | {"results of may/c/failed.json"}
        assert bucket["results of may/a/mug/trajectory.csv"] == b"a 0"


MAIN = """
from pathlib import Path
from sylpose.archive.run import ProcessWorkers, process_all
from sylpose.io.stores import open_store
from tests.archive.archive_worker import make_recordings, make_settings

if __name__ == "__main__":
    settings = make_settings(open_store("out"))
    with ProcessWorkers(settings, 2) as workers:
        process_all(make_recordings(Path("in")), settings, workers, print)
"""


def is_running(pid: int) -> bool:
    """Orphans that ended may remain as zombies."""
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def test_workers_end_after_driver_is_killed(tmp_path: Path) -> None:
    folder, out = tmp_path / "in", tmp_path / "out"
    go = tmp_path / "go"
    make_recordings(folder, a=f"wait {go}", b=f"wait {go}", c="work")
    (tmp_path / "main.py").write_text(MAIN)
    command = subprocess.Popen([sys.executable, "main.py"], cwd=tmp_path)
    deadline = time.monotonic() + 120
    while not all(count_work(folder, name) for name in "ab") and time.monotonic() < deadline:
        time.sleep(0.02)
    workers = [int((folder / name / "sylpose" / "pid").read_text()) for name in "ab"]
    command.kill()
    command.wait()
    go.touch()
    while any(is_running(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert {path.relative_to(out).as_posix() for path in out.rglob("*.json")} == {"a/done.json", "b/done.json"}
