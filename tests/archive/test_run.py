"""Local processes: those that die cost only what they were at; others' claims are waited for; threads and memory bounded."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from sylpose.app.system_resources import cores, memory_of_machine
from sylpose.archive import run, stores
from sylpose.archive.claims import claimed, process_lives
from sylpose.archive.contract import How, Summary
from sylpose.archive.processes import Processes, default_jobs
from sylpose.archive.recordings import Recording
from sylpose.archive.run import Died, run_all, shard_of
from sylpose.archive.stores import Place, place
from sylpose.archive.summary import gathered
from tests.archive.archive_worker import HOW, recordings_in, times_worked
from tests.archive.s3 import s3_server


def ran(
    recordings: list[Recording], out: Place, jobs: int = 2, how: How = HOW, memory: int | None = None
) -> dict[str, Summary]:
    found: dict[str, Summary] = {}

    def take(recording: Recording, summary: Summary) -> None:
        assert recording.name not in found
        found[recording.name] = summary

    with Processes(out, how, jobs, memory) as workers:
        run_all(recordings, out, how, workers, take)
    return found


def test_workers_that_die_cost_only_what_they_were_at(tmp_path: Path) -> None:
    folder, out = tmp_path / "in", place(tmp_path / "out")
    orders = {"a": "work", "b": "die", "c": "die-once", "d": "exit", "e": "wrong", "f": "work"}
    found = ran(recordings_in(folder, **orders), out, how=replace(HOW, threads=3))
    assert {name: summary.status for name, summary in found.items()} == {
        "a": "done",
        "b": "crashed",
        "c": "done",
        "d": "crashed",
        "e": "wrong input",
        "f": "done",
    }
    assert found["b"].error == "the worker was ended by SIGKILL: out of memory?, 2 times"
    assert found["d"].error == "the worker ended with exit code 3, 2 times"
    assert [times_worked(folder, name) for name in "abcdef"] == [1, 2, 2, 2, 1, 1]
    assert [row.status for row in gathered(out)] == [found[name].status for name in "abcdef"]
    assert out.read("f/threads") == b"3 3"
    assert not any("claim" in file.name for file in out.files())


def test_memory_is_bounded(tmp_path: Path) -> None:
    if os.uname().sysname != "Linux":
        pytest.skip("RLIMIT_DATA is Linux's")
    out = place(tmp_path / "out")
    recordings = recordings_in(tmp_path / "in", large="memory 3000000000", small="memory 1000000")
    found = ran(recordings, out, jobs=1, memory=2 << 30)
    assert found["large"].error == "more memory was needed than one recording may have"
    assert found["small"].is_done


def test_what_others_hold_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "LOOK_AGAIN", 0.1)
    monkeypatch.setattr(run, "WAIT", 0.05)
    out = place(tmp_path / "out")
    (one,) = recordings_in(tmp_path / "in", one="work")
    held, let_go = threading.Event(), threading.Event()

    def other() -> None:
        with claimed(out.below("one"), "b"):
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

    with Processes(out, HOW, 1) as workers:
        run_all([one], out, HOW, workers, lambda _, summary: found.append(summary), look)
    thread.join()
    assert [summary.status for summary in found] == ["done"]
    assert (0, 1) in looks


def test_an_interrupt_ends_all_workers_and_leaves_nothing(tmp_path: Path) -> None:
    folder, out, scratch = tmp_path / "in", place(tmp_path / "out"), tmp_path / "scratch"
    recordings = recordings_in(folder, a="sleep 600", b="sleep 600")
    start = time.monotonic()

    def look(*_: int) -> None:
        if all(times_worked(folder, name) for name in "ab"):
            raise KeyboardInterrupt

    workers = Processes(out, replace(HOW, scratch=str(scratch)), 2)
    with pytest.raises(KeyboardInterrupt), workers:
        run_all(recordings, out, HOW, workers, lambda *_: None, look)
    assert time.monotonic() - start < 300
    assert not any(worker.process.is_alive() for worker in workers._workers)
    assert out.files() == []
    assert list(scratch.iterdir()) == []


class Mortal:
    """Workers on computers that go away, so many times."""

    def __init__(self, times: int) -> None:
        self.times, self.at = times, list[Recording]()

    def has_room(self) -> bool:
        return not self.at

    def submit(self, recording: Recording) -> None:
        self.at.append(recording)

    def running(self) -> int:
        return len(self.at)

    def outcomes(self, seconds: float) -> list[tuple[Recording, Summary | Died]]:
        assert seconds > 0
        self.times -= 1
        dead = self.times >= 0
        return [(self.at.pop(), Died("the computer went away", with_node=True) if dead else Summary(status="done"))]


@pytest.mark.parametrize(("times", "status"), [(9, "done"), (10, "crashed")])
def test_computers_that_go_away_are_not_the_recordings_fault(tmp_path: Path, times: int, status: str) -> None:
    found: list[Summary] = []
    recordings, out = recordings_in(tmp_path / "in", one="work"), place(tmp_path / "out")
    run_all(recordings, out, HOW, Mortal(times), lambda _, summary: found.append(summary))
    assert [summary.status for summary in found] == [status]


def test_shards_are_a_partition(tmp_path: Path) -> None:
    recordings = recordings_in(tmp_path, **{f"r{k:02}": "work" for k in range(10)})
    shards = [shard_of(recordings, f"{k}/3") for k in (1, 2, 3)]
    assert sorted(r.name for shard in shards for r in shard) == [r.name for r in recordings]
    assert {len(shard) for shard in shards} == {3, 4}
    assert shard_of(recordings, "12/12") == []
    for wrong in ("0/3", "4/3", "3", "a/b", "1/0", "-1/3", "1/3/3"):
        with pytest.raises(ValueError, match="1/N to N/N"):
            shard_of(recordings, wrong)


def test_as_many_jobs_as_there_are_cores_and_memory_for() -> None:
    assert 1 <= default_jobs(1) <= cores()
    assert default_jobs(10_000) == 1
    assert (memory_of_machine() or 1 << 30) >= 1 << 30


def test_processes_on_an_object_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spoken to as S3, by credentials in the environment; two runs at once do each recording once."""
    bucket: dict[str, bytes] = {}
    with s3_server(bucket) as address:
        settings = {"ENDPOINT": address, "ALLOW_HTTP": "true", "ACCESS_KEY_ID": "a", "SECRET_ACCESS_KEY": "b"}
        for name, value in (settings | {"REGION": "us-east-1"}).items():
            monkeypatch.setenv(f"AWS_{name}", value)
        monkeypatch.setattr(run, "LOOK_AGAIN", 0.1)
        stores._store.cache_clear()
        out = place("s3://lab/results of may")
        recordings = recordings_in(tmp_path / "in", a="sleep 0.2", b="die-once", c="wrong", d="work")
        found: list[dict[str, Summary]] = [{}, {}]

        def batch(k: int) -> None:
            found[k] = ran(recordings[:: 1 - 2 * k], out, jobs=1, how=replace(HOW, run=str(k)))

        threads = [threading.Thread(target=batch, args=(k,)) for k in (0, 1)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert [{name: found[k][name].status for name in "abcd"} for k in (0, 1)] == [
            {"a": "done", "b": "done", "c": "wrong input", "d": "done"}
        ] * 2
        assert [times_worked(tmp_path / "in", name) for name in "abcd"] == [1, 2, 1, 1]
        assert [row.status for row in gathered(out)] == ["done", "done", "wrong input", "done"]
        files = ("done.json", "mug/trajectory.csv", "threads")
        expected = {f"results of may/{name}/{file}" for name in "abd" for file in files}
        assert set(bucket) == expected | {"results of may/c/failed.json"}
        assert bucket["results of may/a/mug/trajectory.csv"] == b"a 0"


MAIN = """
from pathlib import Path
from sylpose.archive.processes import Processes
from sylpose.archive.run import run_all
from sylpose.archive.stores import place
from tests.archive.archive_worker import HOW, recordings_in

if __name__ == "__main__":
    with Processes(place("out"), HOW, 2) as workers:
        run_all(recordings_in(Path("in")), place("out"), HOW, workers, print)
"""


def test_workers_whose_command_is_killed_finish_and_end(tmp_path: Path) -> None:
    folder, out = tmp_path / "in", tmp_path / "out"
    go = tmp_path / "go"
    recordings_in(folder, a=f"wait {go}", b=f"wait {go}", c="work")
    (tmp_path / "main.py").write_text(MAIN)
    command = subprocess.Popen([sys.executable, "main.py"], cwd=tmp_path)
    deadline = time.monotonic() + 120
    while not all(times_worked(folder, name) for name in "ab") and time.monotonic() < deadline:
        time.sleep(0.02)
    workers = [int((folder / name / "sylpose" / "pid").read_text()) for name in "ab"]
    command.kill()
    command.wait()
    go.touch()
    while any(process_lives(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert {path.relative_to(out).as_posix() for path in out.rglob("*.json")} == {"a/done.json", "b/done.json"}
