"""Files that were damaged or mean ill: a result or one sentence, never anything else (SECURITY.md). 100,000 of them:
benchmarks/fuzz.py."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.fuzz import ALLOWED, Kind, Verdict, case, isolated, kinds, run_batch, verdict

CASES = 25


@pytest.mark.parametrize("name", kinds())
def test_whole_files_are_read(name: str, tmp_path: Path) -> None:
    kind = kinds()[name]
    for whole in kind.whole:
        file = tmp_path / kind.name
        file.write_bytes(whole)
        found = verdict(kind, file)
        # What the manifests name is not there.
        assert found.word == ("sentence" if "manifest" in name else "result"), found.said


@pytest.mark.parametrize("name", kinds())
def test_changed_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    found = list(run_batch(name, range(10**6, 10**6 + CASES), tmp_path))
    wrong = [(seed, told) for seed, told in found if told.word not in ALLOWED]
    assert not wrong
    assert len(found) == CASES


def test_cases_are_seeded() -> None:
    assert case("yaml", 7) == case("yaml", 7)
    assert len({case("yaml", seed) for seed in range(20)}) > 15


def test_what_is_not_allowed_is_seen(tmp_path: Path) -> None:
    def read(said: str) -> Verdict:
        def fail(path: Path) -> None:
            raise ValueError(said.format(path))

        return verdict(Kind("a.toml", (), fail), tmp_path / "a.toml")

    assert read("{}: wrong").word == "sentence"
    assert read("wrong").word == "without the file's name"
    assert read("{}: wr\nong").word == "no line"
    assert read("{}: " + 1000 * "wrong").word == "no line"
    nothing: dict[str, int] = {}
    assert verdict(Kind("a", (), lambda _: nothing["a"]), tmp_path / "a").word == "KeyError"


def test_batches_have_a_process_of_their_own() -> None:
    assert [seed for seed, _ in isolated("offsets", range(3, 6))] == [3, 4, 5]
