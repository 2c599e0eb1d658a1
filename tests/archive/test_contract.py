"""The contract: processed once, `done.json` written last, and mutual exclusion of workers under failures."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from sylpose.archive import claims, contract
from sylpose.archive.claims import CLAIM_LIFETIME, Claim, RecordingHeldError, hold_claim, host_id
from sylpose.archive.contract import mark_crashed, process_recording, read_record
from sylpose.archive.stores import Store, open_store
from tests.archive.archive_worker import SETTINGS, count_work, make_recordings

NUMBERS = itertools.count()


@pytest.fixture(params=["folder", "memory"])
def out(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    """A destination: a folder, and an object store."""
    return open_store(tmp_path / "out ü#1" if request.param == "folder" else f"memory://{next(NUMBERS)}/results")


def files_in(out: Store, name: str = "one") -> set[str]:
    return {file.name for file in out.join(name).files()}


FILES = {"mug/trajectory.csv", "threads", "done.json"}


def test_recording_is_processed_once(out: Store, tmp_path: Path) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    first, second = process_recording(one, out, SETTINGS), process_recording(one, out, replace(SETTINGS, run="b"))
    assert first == second
    assert first.is_done
    assert count_work(tmp_path / "in", "one") == 1
    assert files_in(out) == FILES
    assert out.join("one").read("mug/trajectory.csv") == b"one 0"


@pytest.mark.parametrize("changed", ["options", "inputs"])
def test_changed_recording_is_processed_again(out: Store, tmp_path: Path, changed: str) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    process_recording(one, out, SETTINGS)
    out.join("one").write("notes.txt", b"mine")
    if changed == "inputs":
        (one,) = make_recordings(tmp_path / "in", one="work ")
    else:
        one = msgspec.structs.replace(one, options=msgspec.structs.replace(one.options, seed=5))
    assert process_recording(one, out, SETTINGS).is_done
    assert count_work(tmp_path / "in", "one") == 2
    # Foreign files are kept.
    assert files_in(out) == FILES | {"notes.txt"}
    assert out.join("one").read("mug/trajectory.csv") == f"one {one.options.seed}".encode()


def test_done_json_is_removed_first_and_written_last(
    out: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    process_recording(one, out, SETTINGS)
    done: list[str] = []
    for what in ("write", "remove"):

        def noted(self: Store, name: str, *rest: object, what: str = what, do: object = getattr(Store, what)) -> None:
            if self.url.endswith("one") and not name.startswith("claim"):
                done.append(f"{what} {name}")
            do(self, name, *rest)  # type: ignore[operator]

        monkeypatch.setattr(Store, what, noted)
    process_recording(msgspec.structs.replace(one, inputs="others"), out, SETTINGS)
    assert done[0] == "remove done.json"
    assert done[-1] == "write done.json"
    assert done.count("write done.json") == 1


def test_incomplete_results_do_not_count(out: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    with monkeypatch.context() as patch:

        def full(self: Store, name: str, content: bytes | Path, write: object = Store.write) -> None:
            if name == "threads":
                raise OSError("cannot write threads: no space left")
            write(self, name, content)  # type: ignore[operator]

        patch.setattr(Store, "write", full)
        summary = process_recording(one, out, SETTINGS)
    assert (summary.status, summary.error) == ("i/o error", "cannot write threads: no space left")
    assert files_in(out) == {"mug/trajectory.csv"}
    assert process_recording(one, out, SETTINGS).is_done
    assert files_in(out) == FILES


def test_only_one_of_many_workers_works(tmp_path: Path, out: Store) -> None:
    go = tmp_path / "go"
    (one,) = make_recordings(tmp_path / "in", one=f"wait {go}")
    with ThreadPoolExecutor(8) as pool:
        runs = [pool.submit(process_recording, one, out, replace(SETTINGS, run=str(k))) for k in range(8)]
        next(as_completed(runs))  # workers without the claim return immediately
        go.touch()
        found = [run.result().status for run in runs]
    assert count_work(tmp_path / "in", "one") == 1
    assert sorted(set(found)) == ["done", "held"]
    assert files_in(out) == FILES


def test_concurrent_runs_process_each_recording_once(tmp_path: Path) -> None:
    """Several simultaneous commands; each recording is processed once."""
    out = open_store(f"memory://{next(NUMBERS)}")
    recordings = make_recordings(tmp_path / "in", **{f"r{k}": "sleep 0.02" for k in range(6)})

    def work(run: int) -> None:
        left = list(recordings)
        while left:
            left = [r for r in left if process_recording(r, out, replace(SETTINGS, run=str(run))).status == "held"]

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    assert [count_work(tmp_path / "in", r.name) for r in recordings] == [1] * 6
    assert {name for r in recordings for name in files_in(out, r.name)} == FILES


def ended_process() -> int:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    return child.pid


def claim(host: str, pid: int, run: str = "b", age: float = 0.0) -> bytes:
    now = time.time()
    return msgspec.json.encode(Claim(host, pid, run, now - 3 * age, now - age))


@pytest.mark.parametrize(
    ("content", "held"),
    [
        (lambda: claim("elsewhere", 1), True),
        (lambda: claim("elsewhere", 1, age=CLAIM_LIFETIME - 20), True),
        (lambda: claim("elsewhere", 1, age=CLAIM_LIFETIME + 1), False),
        (lambda: claim(host_id(), os.getpid()), True),
        (lambda: claim(host_id(), ended_process()), False),
        (lambda: claim("elsewhere", 1, run="a"), False),
        (lambda: b'{"host": "el', False),
    ],
    ids=["other computer", "renewed", "expired", "this computer", "dead", "own run", "broken"],
)
def test_claim_is_respected_while_worker_lives(out: Store, tmp_path: Path, content: object, held: bool) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    out.join("one").create("claim-000003.json", content())  # type: ignore[operator]
    assert (process_recording(one, out, SETTINGS).status == "held") == held
    assert files_in(out) == ({"claim-000003.json"} if held else FILES)


def test_interrupt_after_claim_releases_it(out: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    create = Store.create

    def interrupted(self: Store, name: str, content: bytes) -> bool:
        assert create(self, name, content)
        raise KeyboardInterrupt

    monkeypatch.setattr(Store, "create", interrupted)
    with pytest.raises(KeyboardInterrupt), hold_claim(out, "a"):
        pass
    assert claims.read_current_claim(out) is None

    def interrupted_by_others(self: Store, name: str, _: bytes) -> bool:
        assert create(self, name, claim("elsewhere", 1))
        raise KeyboardInterrupt

    monkeypatch.setattr(Store, "create", interrupted_by_others)
    with pytest.raises(KeyboardInterrupt), hold_claim(out, "a"):
        pass
    assert claims.read_current_claim(out) is not None


def test_claim_is_renewed_until_superseded(out: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims, "RENEW_INTERVAL", 0.02)
    with hold_claim(out, "a") as mine:
        with pytest.raises(RecordingHeldError, match=f"process {os.getpid()}"), hold_claim(out, "b"):
            pass
        first = claims.read_current_claim(out)
        deadline = time.monotonic() + 60
        while claims.read_current_claim(out) == first and time.monotonic() < deadline:
            time.sleep(0.02)
        last = claims.read_current_claim(out)
        assert first is not None
        assert last is not None
        assert last.renewed > first.renewed
        assert last.since == pytest.approx(first.since, abs=0.1)
        counted = [mine.is_current]
        with hold_claim(out, "a") as next_one:
            assert next_one.is_current
            counted.append(mine.is_current)
        assert [*counted, mine.is_current] == [True, False, False]
    assert out.names() == []


def test_superseded_worker_publishes_nothing(out: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker that was suspended for longer than its claim was valid."""
    (one,) = make_recordings(tmp_path / "in", one="work")
    worked = contract._run_work

    def stopped_meanwhile(*args: object) -> object:
        out.join("one").create("claim-000001.json", claim("elsewhere", 1))
        return worked(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(contract, "_run_work", stopped_meanwhile)
    assert process_recording(one, out, SETTINGS).status == "held"
    assert files_in(out) == {"claim-000001.json"}


@pytest.mark.parametrize(
    ("order", "status", "error", "times"),
    [
        ("io", "i/o error", "the disk is on strike (tried 3 times)", 3),
        ("io-once", "done", "", 2),
        ("wrong", "wrong input", "cam_0 is upside down", 1),
        ("bug", "bug", "IndexError: off by one (failed.json has the traceback)", 1),
        ("memory 1000000000000000", "crashed", "it exceeded the memory limit of one recording", 1),
    ],
)
def test_failures_are_classified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, order: str, status: str, error: str, times: int
) -> None:
    monkeypatch.setattr(contract, "FIRST_RETRY_S", 0.0)
    out = open_store(tmp_path / "out")
    (one,) = make_recordings(tmp_path / "in", one=order)
    summary = process_recording(one, out, SETTINGS)
    assert (summary.status, summary.error) == (status, error)
    assert count_work(tmp_path / "in", "one") == times
    assert files_in(out) == (FILES if status == "done" else {"failed.json"})
    record = read_record(out.join("one"))
    assert record is not None
    assert record.summary == summary
    assert ("off by one" in record.traceback) == (status == "bug")
    # Wrong input is not retried until it changes or a retry is requested.
    process_recording(one, out, SETTINGS)
    assert count_work(tmp_path / "in", "one") == times * (1 if status in ("wrong input", "done") else 2)
    process_recording(one, out, replace(SETTINGS, retry_failed=True))
    again = count_work(tmp_path / "in", "one")
    assert (again > times) == (status != "done")
    make_recordings(tmp_path / "in", one="work now")
    (one,) = make_recordings(tmp_path / "in", one="work now")
    assert process_recording(one, out, SETTINGS).is_done
    assert files_in(out) == FILES


def test_interrupt_leaves_no_files(out: Store, tmp_path: Path) -> None:
    (one,) = make_recordings(tmp_path / "in", one="interrupt")
    scratch = tmp_path / "scratch"
    with pytest.raises(KeyboardInterrupt):
        process_recording(one, out, replace(SETTINGS, scratch=str(scratch)))
    assert files_in(out) == set()
    assert list(scratch.iterdir()) == []


def test_scratch_of_dead_workers_is_removed(out: Store, tmp_path: Path) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    left = tmp_path / f"sylpose-scratch-{host_id()}-{ended_process()}-x"
    others = [tmp_path / f"sylpose-scratch-{host_id()}-{os.getpid()}-x", tmp_path / "sylpose-scratch-elsewhere-1-x"]
    for folder in (left, *others):
        folder.mkdir()
    process_recording(one, out, replace(SETTINGS, scratch=str(tmp_path)))
    assert not left.exists()
    assert all(folder.exists() for folder in others)


def test_abandoned_recording_is_retried_by_next_run(out: Store, tmp_path: Path) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    out.join("one").create("claim-000000.json", claim(host_id(), ended_process()))
    assert mark_crashed(one, out, SETTINGS, "it died").error == "it died"
    assert files_in(out) == {"failed.json"}
    with hold_claim(out.join("one"), "b"):  # another run works on it meanwhile
        assert mark_crashed(one, out, SETTINGS, "it died").status == "held"
    assert process_recording(one, out, SETTINGS).is_done
    assert mark_crashed(one, out, SETTINGS, "it died").is_done
    assert files_in(out) == FILES


def test_store_errors_are_described(tmp_path: Path) -> None:
    for where in (open_store(tmp_path), open_store("memory://nothing")):
        with pytest.raises(FileNotFoundError, match=r"cannot read .*/nowhere: no such file$"):
            where.fetch("nowhere", tmp_path / "copy")
