"""`sylpose experiments`: sequential run of the paper's studies, with a table and a figure of each."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from sylpose.atomic_io import make_output_folder, replace_atomically
from sylpose.experiments import STUDIES, Study
from sylpose.runs import console_output

__all__ = ["run_studies", "select_studies"]

# Prefix of all files written; other files of the folder are not touched.
PREFIX = "paper_"
INDEX = f"{PREFIX}index.md"


def select_studies(names: Sequence[str]) -> list[Study]:
    """Return the studies of the given names in their standard order; all if there are no names.

    Raises:
        ValueError: there is no study of that name.
    """
    for name in names:
        if name not in {study.name for study in STUDIES}:
            raise ValueError(f"no study {name!r}; available: {', '.join(study.name for study in STUDIES)}")
    return [study for study in STUDIES if not names or study.name in names]


def run_studies(studies: Sequence[Study], out: Path, *, seed: int, quick: bool) -> list[Path]:
    """Run studies and print their findings; each study's files are complete when the next one starts.

    Args:
        studies: the studies to run.
        out: output folder, created if missing. Only paper_NAME.csv and paper_NAME.png of each study and
            paper_index.md in it are replaced.
        seed: seed of the random numbers, not negative.
        quick: run few trials.

    Returns:
        the files.

    Raises:
        KeyboardInterrupt: interrupted by the user; the message has the number of finished studies.
        ValueError: a negative seed.
        OSError: the folder or a file cannot be written; the message names it.
    """
    if seed < 0:
        raise ValueError(f"--seed must not be negative, got {seed}")
    folder = make_output_folder(out)
    console = console_output.make_console()
    files: list[Path] = []
    entries: list[str] = []
    _write_index(folder, entries, seed, quick)
    for k, study in enumerate(studies):
        trials = study.quick_trials if quick else study.trials
        start = time.perf_counter()
        try:
            with console.status(f"{study.name}: {study.question} ({k + 1} of {len(studies)}) ..."):
                table = study.run(seed, trials)
                csv, png = (folder / f"{PREFIX}{study.name}.{kind}" for kind in ("csv", "png"))
                with replace_atomically(csv) as part:
                    part.write_text(table.to_csv(), encoding="utf-8", newline="")
                study.draw(table, png)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"interrupted after {k} of {len(studies)} studies; finished results are in {folder}"
            ) from None
        files += [csv, png]
        findings = study.summarize(table)
        entries.append(_format_entry(study, trials, findings))
        _write_index(folder, entries, seed, quick)
        _print_study(console, study, findings, time.perf_counter() - start)
    return [*files, folder / INDEX]


def _print_study(console: Console, study: Study, findings: Sequence[str], seconds: float) -> None:
    console.print(f"{study.name}: {study.question} [{seconds:.0f} s]")
    for sentence in findings:
        console.print(f"  {sentence}", soft_wrap=True)


def _format_entry(study: Study, trials: int, findings: Sequence[str]) -> str:
    name = f"{PREFIX}{study.name}"
    lines = "\n".join(f"- {sentence}" for sentence in findings)
    head = f"## {study.name}\n\n{study.question} [Table]({name}.csv), {trials} trials."
    return f"{head}\n\n{lines}\n\n![{study.question}]({name}.png)\n"


def _write_index(folder: Path, entries: Sequence[str], seed: int, quick: bool) -> None:
    """Write the index of this run's studies; files of earlier runs remain but are not listed."""
    with replace_atomically(folder / INDEX) as part:
        head = f"# The paper's experiments\n\n`sylpose experiments`, seed {seed}{', --quick' if quick else ''}.\n"
        part.write_text("\n".join([head, *entries]), encoding="utf-8")
