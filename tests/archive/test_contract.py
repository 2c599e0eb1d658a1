"""The contract: done once, `done.json` last, two workers kept apart, whatever happens to them."""

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
from sylpose.archive.claims import EXPIRES, Claim, Held, claimed, here
from sylpose.archive.contract import give_up, process, read_record
from sylpose.archive.stores import Place, place
from tests.archive.archive_worker import HOW, recordings_in, times_worked

NUMBERS = itertools.count()


@pytest.fixture(params=["folder", "memory"])
def out(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    """A destination: a folder, and an object store."""
    return place(tmp_path / "out ü#1" if request.param == "folder" else f"memory://{next(NUMBERS)}/results")


def files_in(out: Place, name: str = "one") -> set[str]:
    return {file.name for file in out.below(name).files()}


FILES = {"mug/trajectory.csv", "threads", "done.json"}


def test_done_once(out: Place, tmp_path: Path) -> None:
    (one,) = recordings_in(tmp_path / "in", one="work")
    first, second = process(one, out, HOW), process(one, out, replace(HOW, run="b"))
    assert first == second
    assert first.is_done
    assert times_worked(tmp_path / "in", "one") == 1
    assert files_in(out) == FILES
    assert out.below("one").read("mug/trajectory.csv") == b"one 0"


@pytest.mark.parametrize("changed", ["options", "inputs"])
def test_what_has_changed_is_done_again(out: Place, tmp_path: Path, changed: str) -> None:
    (one,) = recordings_in(tmp_path / "in", one="work")
    process(one, out, HOW)
    out.below("one").write("notes.txt", b"mine")
    if changed == "inputs":
        (one,) = recordings_in(tmp_path / "in", one="work ")
    else:
        one = msgspec.structs.replace(one, options=msgspec.structs.replace(one.options, seed=5))
    assert process(one, out, HOW).is_done
    assert times_worked(tmp_path / "in", "one") == 2
    # What somebody else has put there stays.
    assert files_in(out) == FILES | {"notes.txt"}
    assert out.below("one").read("mug/trajectory.csv") == f"one {one.options.seed}".encode()


def test_done_json_goes_first_and_comes_last(out: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (one,) = recordings_in(tmp_path / "in", one="work")
    process(one, out, HOW)
    done: list[str] = []
    for what in ("write", "remove"):

        def noted(self: Place, name: str, *rest: object, what: str = what, do: object = getattr(Place, what)) -> None:
            if self.url.endswith("one") and not name.startswith("claim"):
                done.append(f"{what} {name}")
            do(self, name, *rest)  # type: ignore[operator]

        monkeypatch.setattr(Place, what, noted)
    process(msgspec.structs.replace(one, inputs="others"), out, HOW)
    assert done[0] == "remove done.json"
    assert done[-1] == "write done.json"
    assert done.count("write done.json") == 1


def test_results_that_break_off_are_none(out: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (one,) = recordings_in(tmp_path / "in", one="work")
    with monkeypatch.context() as patch:

        def full(self: Place, name: str, content: bytes | Path, write: object = Place.write) -> None:
            if name == "threads":
                raise OSError("cannot write threads: no space left")
            write(self, name, content)  # type: ignore[operator]

        patch.setattr(Place, "write", full)
        summary = process(one, out, HOW)
    assert (summary.status, summary.error) == ("i/o error", "cannot write threads: no space left")
    assert files_in(out) == {"mug/trajectory.csv"}
    assert process(one, out, HOW).is_done
    assert files_in(out) == FILES


def test_of_many_workers_at_once_one_works(tmp_path: Path, out: Place) -> None:
    go = tmp_path / "go"
    (one,) = recordings_in(tmp_path / "in", one=f"wait {go}")
    with ThreadPoolExecutor(8) as pool:
        runs = [pool.submit(process, one, out, replace(HOW, run=str(k))) for k in range(8)]
        next(as_completed(runs))  # who is not at work has nothing to wait for
        go.touch()
        found = [run.result().status for run in runs]
    assert times_worked(tmp_path / "in", "one") == 1
    assert sorted(set(found)) == ["done", "held"]
    assert files_in(out) == FILES


def test_many_workers_wait_until_one_has_finished_all(tmp_path: Path) -> None:
    """As several commands at once do; each recording is worked on once."""
    out = place(f"memory://{next(NUMBERS)}")
    recordings = recordings_in(tmp_path / "in", **{f"r{k}": "sleep 0.02" for k in range(6)})

    def work(run: int) -> None:
        left = list(recordings)
        while left:
            left = [r for r in left if process(r, out, replace(HOW, run=str(run))).status == "held"]

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    assert [times_worked(tmp_path / "in", r.name) for r in recordings] == [1] * 6
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
        (lambda: claim("elsewhere", 1, age=EXPIRES - 20), True),
        (lambda: claim("elsewhere", 1, age=EXPIRES + 1), False),
        (lambda: claim(here(), os.getpid()), True),
        (lambda: claim(here(), ended_process()), False),
        (lambda: claim("elsewhere", 1, run="a"), False),
        (lambda: b'{"host": "el', False),
    ],
    ids=["other computer", "renewed", "expired", "this computer", "dead", "own run", "broken"],
)
def test_a_claim_is_respected_while_its_worker_lives(out: Place, tmp_path: Path, content: object, held: bool) -> None:
    (one,) = recordings_in(tmp_path / "in", one="work")
    out.below("one").create("claim-000003.json", content())  # type: ignore[operator]
    assert (process(one, out, HOW).status == "held") == held
    assert files_in(out) == ({"claim-000003.json"} if held else FILES)


def test_an_interrupt_right_after_the_claim_gives_it_back(out: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    create = Place.create

    def interrupted(self: Place, name: str, content: bytes) -> bool:
        assert create(self, name, content)
        raise KeyboardInterrupt

    monkeypatch.setattr(Place, "create", interrupted)
    with pytest.raises(KeyboardInterrupt), claimed(out, "a"):
        pass
    assert claims.holder(out) is None

    def interrupted_by_others(self: Place, name: str, _: bytes) -> bool:
        assert create(self, name, claim("elsewhere", 1))
        raise KeyboardInterrupt

    monkeypatch.setattr(Place, "create", interrupted_by_others)
    with pytest.raises(KeyboardInterrupt), claimed(out, "a"):
        pass
    assert claims.holder(out) is not None


def test_a_claim_is_renewed_until_it_is_superseded(out: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims, "BEAT", 0.02)
    with claimed(out, "a") as mine:
        with pytest.raises(Held, match=f"process {os.getpid()}"), claimed(out, "b"):
            pass
        first = claims.holder(out)
        deadline = time.monotonic() + 60
        while claims.holder(out) == first and time.monotonic() < deadline:
            time.sleep(0.02)
        last = claims.holder(out)
        assert first is not None
        assert last is not None
        assert last.renewed > first.renewed
        assert last.since == pytest.approx(first.since, abs=0.1)
        counted = [mine.counts]
        with claimed(out, "a") as next_one:
            assert next_one.counts
            counted.append(mine.counts)
        assert [*counted, mine.counts] == [True, False, False]
    assert out.names() == []


def test_who_was_superseded_publishes_nothing(out: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker that was stopped for longer than its claim was good for."""
    (one,) = recordings_in(tmp_path / "in", one="work")
    worked = contract._worked

    def stopped_meanwhile(*args: object) -> object:
        out.below("one").create("claim-000001.json", claim("elsewhere", 1))
        return worked(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(contract, "_worked", stopped_meanwhile)
    assert process(one, out, HOW).status == "held"
    assert files_in(out) == {"claim-000001.json"}


@pytest.mark.parametrize(
    ("order", "status", "error", "times"),
    [
        ("io", "i/o error", "the disk is on strike (tried 3 times)", 3),
        ("io-once", "done", "", 2),
        ("wrong", "wrong input", "cam_0 is upside down", 1),
        ("bug", "bug", "IndexError: off by one (failed.json has the traceback)", 1),
        ("memory 1000000000000000", "crashed", "more memory was needed than one recording may have", 1),
    ],
)
def test_what_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, order: str, status: str, error: str, times: int
) -> None:
    monkeypatch.setattr(contract, "PAUSE", 0.0)
    out = place(tmp_path / "out")
    (one,) = recordings_in(tmp_path / "in", one=order)
    summary = process(one, out, HOW)
    assert (summary.status, summary.error) == (status, error)
    assert times_worked(tmp_path / "in", "one") == times
    assert files_in(out) == (FILES if status == "done" else {"failed.json"})
    record = read_record(out.below("one"))
    assert record is not None
    assert record.summary == summary
    assert ("off by one" in record.traceback) == (status == "bug")
    # Wrong input stays wrong until it changes or somebody insists.
    process(one, out, HOW)
    assert times_worked(tmp_path / "in", "one") == times * (1 if status in ("wrong input", "done") else 2)
    process(one, out, replace(HOW, retry_failed=True))
    again = times_worked(tmp_path / "in", "one")
    assert (again > times) == (status != "done")
    recordings_in(tmp_path / "in", one="work now")
    (one,) = recordings_in(tmp_path / "in", one="work now")
    assert process(one, out, HOW).is_done
    assert files_in(out) == FILES


def test_an_interrupt_leaves_nothing(out: Place, tmp_path: Path) -> None:
    (one,) = recordings_in(tmp_path / "in", one="interrupt")
    scratch = tmp_path / "scratch"
    with pytest.raises(KeyboardInterrupt):
        process(one, out, replace(HOW, scratch=str(scratch)))
    assert files_in(out) == set()
    assert list(scratch.iterdir()) == []


def test_scratch_of_dead_workers_is_removed(out: Place, tmp_path: Path) -> None:
    (one,) = recordings_in(tmp_path / "in", one="work")
    left = tmp_path / f"sylpose-scratch-{here()}-{ended_process()}-x"
    others = [tmp_path / f"sylpose-scratch-{here()}-{os.getpid()}-x", tmp_path / "sylpose-scratch-elsewhere-1-x"]
    for folder in (left, *others):
        folder.mkdir()
    process(one, out, replace(HOW, scratch=str(tmp_path)))
    assert not left.exists()
    assert all(folder.exists() for folder in others)


def test_what_is_given_up_says_so_and_is_tried_by_the_next_run(out: Place, tmp_path: Path) -> None:
    (one,) = recordings_in(tmp_path / "in", one="work")
    out.below("one").create("claim-000000.json", claim(here(), ended_process()))
    assert give_up(one, out, HOW, "it died").error == "it died"
    assert files_in(out) == {"failed.json"}
    with claimed(out.below("one"), "b"):  # another run is at it by now
        assert give_up(one, out, HOW, "it died").status == "held"
    assert process(one, out, HOW).is_done
    assert give_up(one, out, HOW, "it died").is_done
    assert files_in(out) == FILES


def test_stores_say_what_they_cannot_do(tmp_path: Path) -> None:
    for where in (place(tmp_path), place("memory://nothing")):
        with pytest.raises(FileNotFoundError, match=r"cannot read .*/nowhere: no such file$"):
            where.fetch("nowhere", tmp_path / "copy")
