"""docs/benchmarks.md is generated from the stored results, and results are read from what benchmarks print."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.page import PAGE, render
from benchmarks.record import (
    RESULTS,
    Benchmark,
    Record,
    Table,
    load_page,
    load_record,
    parse_output,
    record,
    save_record,
)

OUTPUT = """
## Times

| cameras | ms |
|--------|:---|
| 4 | 0.5 |
| 8 | 0.9 |

Linear: holds.

| a |
|---|
"""


def test_page_is_generated_from_the_results() -> None:
    assert PAGE.read_text(encoding="utf-8") == render(), "run make bench-page"


def test_every_stored_result_is_on_the_page() -> None:
    head, benchmarks = load_page()
    assert head.startswith("# Benchmarks")
    stored = {path.stem for path in RESULTS.glob("*.json")}
    assert stored
    assert stored <= {benchmark.name for benchmark in benchmarks}
    for name in stored:
        made = load_record(RESULTS / f"{name}.json")
        assert made.name == name
        assert made.tables
        assert all(len(row) == len(table.header) for table in made.tables for row in table.rows)


def test_tables_and_remarks_are_read_from_markdown() -> None:
    tables, remarks = parse_output(OUTPUT)
    assert tables == [Table("Times", ["cameras", "ms"], [["4", "0.5"], ["8", "0.9"]]), Table("", ["a"], [])]
    assert remarks == ["Linear: holds."]


def test_record_round_trip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tables, remarks = parse_output(OUTPUT)
    made = Record("certificate", "python x", "2026-01-01", "1 core", "abc", "0.1", "3.11", tables, remarks)
    monkeypatch.setattr("benchmarks.record.RESULTS", tmp_path)
    assert load_record(save_record(made)) == made
    text = render(tmp_path)
    assert "| 8 | 0.9 |" in text
    assert "- Linear: holds." in text
    assert "2026-01-01" in text


def test_invalid_result_file_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text("{}")
    for name in ("other.json", "missing.json"):
        with pytest.raises(ValueError, match=rf"{name}: not a file of results"):
            load_record(tmp_path / name)


def test_benchmark_without_rows_is_not_recorded(tmp_path: Path) -> None:
    script = tmp_path / "broken.py"
    script.write_text("print('| a |'); print('|---|'); raise SystemExit(3)")
    with pytest.raises(RuntimeError, match=r"printed no table with rows \(exit code 3\)"):
        record(Benchmark("broken", "Broken", str(script), ""))


def test_benchmark_that_fails_between_rows_is_not_recorded(tmp_path: Path) -> None:
    script = tmp_path / "broken.py"
    script.write_text("print('| a |'); print('|---|'); print('| 1 |', flush=True); raise ValueError('no recording')")
    with pytest.raises(RuntimeError, match=r"failed: ValueError: no recording"):
        record(Benchmark("broken", "Broken", str(script), ""))
