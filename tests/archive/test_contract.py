"""The contract: processed once, `done.json` written last, and mutual exclusion of workers under failures."""

from __future__ import annotations

import itertools
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import msgspec
import pytest

from sylpose.archive import contract
from sylpose.archive.contract import (
    CLAIM_LIFETIME,
    RecordingHeldError,
    collect_summaries,
    hold_claim,
    mark_crashed,
    process_recording,
    read_record,
)
from sylpose.io import stores
from sylpose.io.stores import ObjectStore, Store, StoredFile, open_store
from tests.archive.archive_worker import count_work, make_recordings, make_settings, read_owner

NUMBERS = itertools.count()


@pytest.fixture(params=["folder", "memory"])
def out(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    """A destination: a folder, and an object store."""
    if request.param == "folder":
        return open_store(tmp_path / "out ü#1")
    pytest.importorskip("obstore", reason="the extra `archive`")
    return open_store(f"memory://{next(NUMBERS)}/results")


def files_in(out: Store, name: str = "one") -> set[str]:
    return {file.name for file in out.join(name).files()}


FILES = {"mug/trajectory.csv", "threads", "done.json"}


def test_recording_is_processed_once(out: Store, tmp_path: Path) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    first, second = process_recording(one, make_settings(out)), process_recording(one, make_settings(out, run="b"))
    assert first == second
    assert first.status == "done"
    assert count_work(tmp_path / "in", "one") == 1
    assert files_in(out) == FILES
    assert out.join("one").read("mug/trajectory.csv") == b"one 0"


@pytest.mark.parametrize("changed", ["options", "inputs"])
def test_changed_recording_is_processed_again(out: Store, tmp_path: Path, changed: str) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    process_recording(one, make_settings(out))
    out.join("one").write("notes.txt", b"mine")
    if changed == "inputs":
        (one,) = make_recordings(tmp_path / "in", one="work ")
    else:
        one = msgspec.structs.replace(one, seed=5)
    assert process_recording(one, make_settings(out)).status == "done"
    assert count_work(tmp_path / "in", "one") == 2
    # Foreign files are kept.
    assert files_in(out) == FILES | {"notes.txt"}
    assert out.join("one").read("mug/trajectory.csv") == f"one {one.seed}".encode()


def test_done_json_is_removed_first_and_written_last(
    out: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    process_recording(one, make_settings(out))
    done: list[str] = []
    for what in ("write", "remove"):

        def noted(
            self: Store, name: str, *rest: object, what: str = what, do: object = getattr(type(out), what)
        ) -> None:
            if self.url.endswith("one") and not name.startswith("claim"):
                done.append(f"{what} {name}")
            do(self, name, *rest)  # type: ignore[operator]

        monkeypatch.setattr(type(out), what, noted)
    process_recording(msgspec.structs.replace(one, inputs="others"), make_settings(out))
    assert done[0] == "remove done.json"
    assert done[-1] == "write done.json"
    assert done.count("write done.json") == 1


def test_incomplete_results_do_not_count(out: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    with monkeypatch.context() as patch:

        def full(self: Store, name: str, content: bytes | Path, write: object = type(out).write) -> None:
            if name == "threads":
                raise OSError("cannot write threads: no space left")
            write(self, name, content)  # type: ignore[operator]

        patch.setattr(type(out), "write", full)
        summary = process_recording(one, make_settings(out))
    assert (summary.status, summary.error) == ("i/o error", "cannot write threads: no space left")
    assert files_in(out) == {"mug/trajectory.csv"}
    assert process_recording(one, make_settings(out)).status == "done"
    assert files_in(out) == FILES


def test_only_one_of_many_workers_works(tmp_path: Path, out: Store) -> None:
    go = tmp_path / "go"
    (one,) = make_recordings(tmp_path / "in", one=f"wait {go}")
    with ThreadPoolExecutor(8) as pool:
        runs = [pool.submit(process_recording, one, make_settings(out, run=str(k))) for k in range(8)]
        next(as_completed(runs))  # workers without the claim return immediately
        go.touch()
        found = [run.result().status for run in runs]
    assert count_work(tmp_path / "in", "one") == 1
    assert sorted(set(found)) == ["done", "held"]
    assert files_in(out) == FILES


def test_concurrent_runs_process_each_recording_once(tmp_path: Path) -> None:
    """Several simultaneous commands; each recording is processed once."""
    pytest.importorskip("obstore", reason="the extra `archive`")
    out = open_store(f"memory://{next(NUMBERS)}")
    recordings = make_recordings(tmp_path / "in", **{f"r{k}": "sleep 0.02" for k in range(6)})

    def work(run: int) -> None:
        left = list(recordings)
        while left:
            left = [r for r in left if process_recording(r, make_settings(out, run=str(run))).status == "held"]

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    assert [count_work(tmp_path / "in", r.name) for r in recordings] == [1] * 6
    assert {name for r in recordings for name in files_in(out, r.name)} == FILES


@pytest.mark.parametrize(
    ("content", "age", "held"),
    [
        (b"b\nprocess 1 of elsewhere", 0.0, True),
        (b"b\nprocess 1 of elsewhere", CLAIM_LIFETIME - 20, True),
        (b"b\nprocess 1 of elsewhere", CLAIM_LIFETIME + 20, False),
        (b"a\nprocess 1 of elsewhere", 0.0, False),
        (b"", 0.0, True),
        (b"\xff\xfe" * 1000, 0.0, True),
        (b"", CLAIM_LIFETIME + 20, False),
    ],
    ids=["another", "renewed", "expired", "own run", "being written", "broken", "empty and expired"],
)
def test_claim_is_respected_until_it_expires(
    out: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes, age: float, held: bool
) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    out.join("one").create("claim-000003", content)
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + age)
    summary = process_recording(one, make_settings(out))
    assert (summary.status == "held") == held
    assert ("process 1 of elsewhere" in summary.error) == (held and content.startswith(b"b"))
    assert files_in(out) == ({"claim-000003"} if held else FILES)


HOLD_AND_DIE = """
import os, sys
from sylpose.archive.contract import _make_scratch, hold_claim
from sylpose.io.stores import open_store

store = open_store(sys.argv[1])
with hold_claim(store, "b"), _make_scratch(store, sys.argv[2]):
    os._exit(0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere claims of dead processes expire")
def test_claim_of_dead_process_is_superseded_at_once(tmp_path: Path) -> None:
    """Its computer may be another one, where the same process ID is another process."""
    (one,) = make_recordings(tmp_path / "in", one="work")
    out = open_store(tmp_path / "out")
    subprocess.run([sys.executable, "-c", HOLD_AND_DIE, out.join("one").url, str(tmp_path)], check=True)
    claim = tmp_path / "out" / "one" / "claim-000000"
    process = claim.read_bytes()
    claim.write_bytes(process + b"0")
    assert process_recording(one, make_settings(out)).status == "held"
    claim.write_bytes(process)
    assert read_owner(out.join("one")) == ""
    assert process_recording(one, make_settings(out)).status == "done"
    assert files_in(out) == FILES


# The tests' own process by a name: workers must collect the same parameters.
@pytest.mark.parametrize("pid", ["1", "own", "x", "9" * 30, ""])
def test_claim_of_live_or_unknown_process_is_respected(tmp_path: Path, pid: str) -> None:
    pid = str(os.getpid()) if pid == "own" else pid
    store = open_store(tmp_path)
    store.create("claim-000000", f"b\nprocess 1 of here\n{pid} {contract._identify_computer()}".encode())
    assert read_owner(store) == "process 1 of here"


def test_claim_is_renewed_until_superseded(out: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contract, "RENEW_INTERVAL", 0.02)
    with hold_claim(out, "a") as is_current:
        with pytest.raises(RecordingHeldError, match=f"process {os.getpid()}"), hold_claim(out, "b"):
            pass
        assert read_owner(out) == (f"process {os.getpid()} of {socket.gethostname()}")
        (first,) = out.files()
        deadline = time.monotonic() + 60
        while out.files()[0].modified == first.modified and time.monotonic() < deadline:
            time.sleep(0.02)
        assert out.files()[0].modified > first.modified
        counted = [is_current()]
        with hold_claim(out, "a") as is_next_current:
            assert is_next_current()
            counted.append(is_current())
        assert [*counted, is_current()] == [True, False, False]
    assert out.files() == []
    assert read_owner(out) == ""


def test_summaries_cost_one_listing(out: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recordings = make_recordings(tmp_path / "in", a="work", b="wrong", c="work", d="work")
    for recording in recordings[:2]:
        process_recording(recording, make_settings(out))
    out.join("c").create("claim-000000", b"b\nprocess 1 of elsewhere")
    lists, files = list[str](), type(out).files

    def count_files(store: Store) -> list[StoredFile]:
        lists.append(store.url)
        return files(store)

    monkeypatch.setattr(type(out), "files", count_files)
    found = {name: summary.status for name, summary in collect_summaries(out).items()}
    assert found == {"a": "done", "b": "wrong input", "c": "running"}
    found = {name: summary.status for name, summary in collect_summaries(out, recordings).items()}
    assert found == {"a": "done", "b": "wrong input", "c": "running", "d": "waiting"}
    assert lists == [out.url] * 2


def test_only_one_of_many_supersedes_expired_claim(out: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    out.create("claim-000007", b"x\nprocess 1 of elsewhere")
    listed = threading.Barrier(8)
    list_claims = contract._list_claims

    def list_together(store: Store) -> dict[str, float]:
        found = list_claims(store)
        if "claim-000008" not in found:
            listed.wait(60)  # all see that it has expired
            return {"claim-000007": 0.0}
        return found

    monkeypatch.setattr(contract, "_list_claims", list_together)

    def hold(run: int) -> bool:
        try:
            with hold_claim(out, str(run)):
                tried.wait(60)
                return True
        except RecordingHeldError:
            tried.wait(60)
            return False

    tried = threading.Barrier(8)
    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(hold, range(8))) == 1
    assert out.files() == []


def test_superseded_worker_publishes_nothing(out: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker that was suspended for longer than its claim was valid."""
    (one,) = make_recordings(tmp_path / "in", one="work")
    worked = contract._run_work

    def stopped_meanwhile(*args: object) -> object:
        out.join("one").create("claim-000001", b"b\nprocess 1 of elsewhere")
        return worked(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(contract, "_run_work", stopped_meanwhile)
    assert process_recording(one, make_settings(out)).status == "held"
    assert files_in(out) == {"claim-000001"}


@pytest.mark.parametrize(
    ("order", "status", "error", "times"),
    [
        ("io", "i/o error", "the disk is on strike", 1),
        ("wrong", "wrong input", "cam_0 is upside down", 1),
        ("bug", "bug", "IndexError: off by one (failed.json has the traceback)", 1),
        ("memory 1000000000000000", "crashed", "it exceeded the memory limit of one recording", 1),
    ],
)
def test_failures_are_classified(tmp_path: Path, order: str, status: str, error: str, times: int) -> None:
    out = open_store(tmp_path / "out")
    (one,) = make_recordings(tmp_path / "in", one=order)
    summary = process_recording(one, make_settings(out))
    assert (summary.status, summary.error) == (status, error)
    assert count_work(tmp_path / "in", "one") == times
    assert files_in(out) == (FILES if status == "done" else {"failed.json"})
    record = read_record(out.join("one"))
    assert record is not None
    assert record.summary == summary
    assert ("off by one" in record.traceback) == (status == "bug")
    # Wrong input is not retried until it changes or a retry is requested.
    process_recording(one, make_settings(out))
    assert count_work(tmp_path / "in", "one") == times * (1 if status in ("wrong input", "done") else 2)
    process_recording(one, make_settings(out, retry_failed=True))
    again = count_work(tmp_path / "in", "one")
    assert (again > times) == (status != "done")
    make_recordings(tmp_path / "in", one="work now")
    (one,) = make_recordings(tmp_path / "in", one="work now")
    assert process_recording(one, make_settings(out)).status == "done"
    assert files_in(out) == FILES


def test_interrupt_leaves_no_files(out: Store, tmp_path: Path) -> None:
    (one,) = make_recordings(tmp_path / "in", one="interrupt")
    scratch = tmp_path / "scratch"
    with pytest.raises(KeyboardInterrupt):
        process_recording(one, make_settings(out, scratch=str(scratch)))
    assert files_in(out) == set()
    assert list(scratch.iterdir()) == []


def test_scratch_of_dead_workers_is_removed(out: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That of another recording is kept."""
    one, two = make_recordings(tmp_path / "in", one="work", two="work")
    scratch = tmp_path / "scratch"
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", lambda *_, **__: None)
        for recording in (one, two):
            process_recording(recording, make_settings(out, scratch=str(scratch)))
    assert len(list(scratch.iterdir())) == 2
    process_recording(msgspec.structs.replace(one, seed=5), make_settings(out, scratch=str(scratch)))
    assert len(list(scratch.iterdir())) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere only the same recording removes it")
def test_scratch_of_dead_processes_is_removed_with_any_recording(tmp_path: Path) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    out, scratch = open_store(tmp_path / "out"), tmp_path / "scratch"
    subprocess.run([sys.executable, "-c", HOLD_AND_DIE, out.join("two").url, str(scratch)], check=True)
    (left,) = scratch.iterdir()
    others = [scratch / left.name.replace("sylpose-scratch-", "sylpose-scratch"), scratch / f"{left.name[:32]}-1-2-x"]
    for folder in others:
        folder.mkdir()
    assert process_recording(one, make_settings(out, scratch=str(scratch))).status == "done"
    assert sorted(scratch.iterdir()) == sorted(others)


def test_abandoned_recording_is_retried_by_next_run(out: Store, tmp_path: Path) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    out.join("one").create("claim-000000", b"a\nthe process that died")
    assert mark_crashed(one, make_settings(out), "it died").error == "it died"
    assert files_in(out) == {"failed.json"}
    with hold_claim(out.join("one"), "b"):  # another run works on it meanwhile
        assert mark_crashed(one, make_settings(out), "it died").status == "held"
    assert process_recording(one, make_settings(out)).status == "done"
    assert mark_crashed(one, make_settings(out), "it died").status == "done"
    assert files_in(out) == FILES


def test_reason_of_a_crash_is_kept_if_it_cannot_be_written(
    out: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> bool:
        raise OSError("cannot write: no space left")

    (one,) = make_recordings(tmp_path / "in", one="work")
    monkeypatch.setattr(type(out), "create", fail)
    summary = mark_crashed(one, make_settings(out), "it died")
    assert (summary.status, summary.error) == ("crashed", "it died; cannot write: no space left")


def test_store_errors_are_described(tmp_path: Path) -> None:
    pytest.importorskip("obstore", reason="the extra `archive`")
    store = open_store("memory://nothing")
    assert isinstance(store, ObjectStore)
    with pytest.raises(FileNotFoundError, match=r"cannot read memory://nothing/nowhere: no such file$"):
        store.fetch("nowhere", tmp_path / "copy")
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="cannot write"):
        open_store(tmp_path / "file").write("name", b"")


def test_file_removed_while_it_is_listed_is_skipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "claim-000000").touch()
    assert [file.name for file in open_store(tmp_path).files()] == ["claim-000000"]
    monkeypatch.setattr(Path, "is_file", lambda path: path.unlink() is None)
    assert open_store(tmp_path).files() == []


def test_object_stores_need_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    stores._connect.cache_clear()
    monkeypatch.setitem(sys.modules, "obstore.store", None)
    with pytest.raises(ValueError, match=r"pip install 'sylpose\[archive\]'"):
        open_store("s3://bucket/x")
