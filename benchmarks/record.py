"""Run benchmarks and store their tables for docs/benchmarks.md.

    python benchmarks/record.py [NAME ...]      # all of them without a name: two hours or more
    python benchmarks/page.py                   # then write the page

Each benchmark prints its figures as Markdown tables. Its output goes to benchmarks/results/NAME.json, together with the
command, date, machine, commit and version.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

import msgspec

import sylpose
from sylpose.runs.system_resources import available_cores

__all__ = ["RESULTS", "ROOT", "Benchmark", "Record", "Table", "load_page", "load_record", "parse_output", "record"]

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGE_TEXTS = ROOT / "benchmarks" / "page.toml"


class Benchmark(NamedTuple):
    """A benchmark of the page.

    Attributes:
        name: of its file of results.
        title: heading on the page.
        command: script and options, as given to Python.
        about: what is measured, and how to read the tables.
    """

    name: str
    title: str
    command: str
    about: str


def load_page(path: Path = PAGE_TEXTS) -> tuple[str, list[Benchmark]]:
    """Return the page's head and its benchmarks, in order, from benchmarks/page.toml."""
    texts = tomllib.loads(path.read_text(encoding="utf-8"))
    return texts["head"], [Benchmark(**entry) for entry in texts["benchmark"]]


class Table(msgspec.Struct, frozen=True):
    """A Markdown table of a benchmark's output, below its heading."""

    title: str
    header: list[str]
    rows: list[list[str]]


class Record(msgspec.Struct, frozen=True):
    """One run of a benchmark: where and when it ran, and what it printed."""

    name: str
    command: str
    date: str
    machine: str
    commit: str
    version: str
    python: str
    tables: list[Table]
    remarks: list[str]


def parse_output(text: str) -> tuple[list[Table], list[str]]:
    """Split a benchmark's output into its Markdown tables and its remaining lines.

    A line that begins with `#` is the title of the next table.
    """
    tables: list[Table] = []
    remarks: list[str] = []
    title, lines = "", text.splitlines()
    k = 0
    while k < len(lines):
        line = lines[k].strip()
        if line.startswith("|") and k + 1 < len(lines) and re.fullmatch(r"\|[-:| ]+", lines[k + 1].strip()):
            header, k = _split_cells(line), k + 2
            rows = []
            while k < len(lines) and lines[k].strip().startswith("|"):
                rows.append(_split_cells(lines[k]))
                k += 1
            tables.append(Table(title, header, rows))
            title = ""
            continue
        if line.startswith("#"):
            title = line.lstrip("# ")
        elif line:
            remarks.append(line)
        k += 1
    return tables, remarks


def _split_cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().removeprefix("|").removesuffix("|").split("|")]


def record(benchmark: Benchmark) -> Record:
    """Run a benchmark and return what it printed.

    Raises:
        RuntimeError: it failed, or printed no table or one without rows.
    """
    script, *options = shlex.split(benchmark.command)
    environment = os.environ | {"COLUMNS": "400", "PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}"}
    process = subprocess.run(
        [sys.executable, script, *options], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    # Exit code 1 may mean a missed target: the tables are complete then.
    if "Traceback (most recent call last)" in process.stderr:
        raise RuntimeError(f"{benchmark.command} failed: {process.stderr.strip().splitlines()[-1]}")
    tables, remarks = parse_output(process.stdout)
    if not tables or not all(table.rows for table in tables):
        raise RuntimeError(f"{benchmark.command} printed no table with rows (exit code {process.returncode})")
    return Record(
        benchmark.name,
        f"python {benchmark.command}",
        datetime.date.today().isoformat(),
        _describe_machine(),
        _find_commit(),
        sylpose.__version__,
        platform.python_version(),
        tables,
        remarks,
    )


def _describe_machine() -> str:
    """Return the processor and the number of its cores that this process may use."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists() and (found := re.search(r"(?m)^model name\s*:\s*(.*)$", info.read_text())):
        model = found[1]
    return f"{available_cores()} cores of {model}"


def _find_commit() -> str:
    """Return the abbreviated commit, with a plus sign if tracked files differ from it."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
        return done.stdout.strip()

    return git("rev-parse", "--short=8", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")


def load_record(path: Path) -> Record:
    """Read a file of results.

    Raises:
        ValueError: it cannot be read.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=Record)
    except (OSError, msgspec.DecodeError) as error:
        raise ValueError(f"{path}: not a file of results ({error})") from None


def save_record(result: Record) -> Path:
    """Write a record to its file in benchmarks/results, indented, so that changes are readable."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{result.name}.json"
    path.write_bytes(msgspec.json.format(msgspec.json.encode(result), indent=1) + b"\n")
    return path


def main() -> int:
    _, benchmarks = load_page()
    names = [benchmark.name for benchmark in benchmarks]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(names))
    options = parser.parse_args()
    if unknown := set(options.names) - set(names):
        parser.error(f"no benchmark {', '.join(sorted(unknown))}; there are: {', '.join(names)}")
    failed = 0
    for benchmark in benchmarks:
        if options.names and benchmark.name not in options.names:
            continue
        try:
            print(save_record(record(benchmark)))
        except RuntimeError as error:
            print(error, file=sys.stderr)
            failed = 1
    return failed


if __name__ == "__main__":
    sys.exit(main())
