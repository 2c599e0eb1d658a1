"""Damaged or malicious files: a result or a one-line error, nothing else (SECURITY.md).

benchmarks/fuzz.py runs 100,000 of them.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.fuzz import (
    ALLOWED,
    Kind,
    Verdict,
    make_case,
    make_kinds,
    read_and_classify,
    run_batch,
    run_isolated_batch,
)

CASES = 25


@pytest.mark.parametrize("name", make_kinds())
def test_intact_files_are_read(name: str, tmp_path: Path) -> None:
    kind = make_kinds()[name]
    for whole in kind.samples:
        file = tmp_path / kind.name
        file.write_bytes(whole)
        found = read_and_classify(kind, file)
        # The files that the manifests refer to do not exist.
        assert found.outcome == ("sentence" if "manifest" in name else "result"), found.message


@pytest.mark.parametrize("name", make_kinds())
def test_changed_files_are_read_or_rejected(name: str, tmp_path: Path) -> None:
    found = list(run_batch(name, range(10**6, 10**6 + CASES), tmp_path))
    wrong = [(seed, reported) for seed, reported in found if reported.outcome not in ALLOWED]
    assert not wrong
    assert len(found) == CASES


def test_cases_are_seeded() -> None:
    assert make_case("yaml", 7) == make_case("yaml", 7)
    assert len({make_case("yaml", seed) for seed in range(20)}) > 15


def test_forbidden_outcomes_are_detected(tmp_path: Path) -> None:
    def read(text: str) -> Verdict:
        def fail(path: Path) -> None:
            raise ValueError(text.format(path))

        return read_and_classify(Kind("a.toml", (), fail), tmp_path / "a.toml")

    assert read("{}: wrong").outcome == "sentence"
    assert read("wrong").outcome == "without the file's name"
    assert read("{}: wr\nong").outcome == "no line"
    assert read("{}: " + 1000 * "wrong").outcome == "no line"
    nothing: dict[str, int] = {}
    assert read_and_classify(Kind("a", (), lambda _: nothing["a"]), tmp_path / "a").outcome == "KeyError"


@pytest.mark.slow
def test_batches_run_in_separate_processes() -> None:
    assert [seed for seed, _ in run_isolated_batch("offsets", range(3, 6))] == [3, 4, 5]
