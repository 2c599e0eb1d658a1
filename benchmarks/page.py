"""Write docs/benchmarks.md from benchmarks/results/*.json.

    python benchmarks/page.py

The texts of its sections are in benchmarks/page.toml; `make bench-page` does the same.
"""

from __future__ import annotations

from pathlib import Path

from benchmarks.record import RESULTS, ROOT, Benchmark, Record, Table, load_page, load_record

__all__ = ["PAGE", "render"]

PAGE = ROOT / "docs" / "benchmarks.md"


def render(folder: Path = RESULTS) -> str:
    """Return the page's text: a section for each benchmark that has results."""
    head, benchmarks = load_page()
    sections = [head]
    for benchmark in benchmarks:
        path = folder / f"{benchmark.name}.json"
        if path.exists():
            sections.append(_format_section(benchmark, load_record(path)))
    return "\n".join(sections)


def _format_section(benchmark: Benchmark, result: Record) -> str:
    origin = f"{result.date}, sylpose {result.version} at {result.commit}, Python {result.python}, {result.machine}."
    parts = [f"## {benchmark.title}\n", benchmark.about + "\n", f"    {result.command}\n", origin + "\n"]
    parts += [_format_table(table) for table in result.tables]
    parts += [f"- {line.removeprefix('- ')}" for line in result.remarks]
    return "\n".join(parts) + "\n"


def _format_table(table: Table) -> str:
    lines = [f"### {table.title}\n"] if table.title else []
    lines.append("| " + " | ".join(table.header) + " |")
    lines.append("|---" * len(table.header) + "|")
    lines += ["| " + " | ".join(row) + " |" for row in table.rows]
    return "\n".join(lines) + "\n"


def main() -> None:
    PAGE.write_text(render(), encoding="utf-8")
    print(PAGE)


if __name__ == "__main__":
    main()
