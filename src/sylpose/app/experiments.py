"""`sylpose experiments`: runs the paper's studies one after the other and writes each one's table and figure."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from sylpose.app import console_output
from sylpose.atomic_io import output_folder, replacing
from sylpose.experiments import STUDIES, Study

__all__ = ["chosen", "run_studies"]

# Everything that is written is called so: of a folder's other files none is touched.
PREFIX = "paper_"
INDEX = f"{PREFIX}index.md"


def chosen(names: Sequence[str]) -> list[Study]:
    """The studies of these names, in their own order; all without names.

    Raises:
        ValueError: a name that no study has.
    """
    for name in names:
        if name not in {study.name for study in STUDIES}:
            raise ValueError(f"no study {name!r}; there are {', '.join(study.name for study in STUDIES)}")
    return [study for study in STUDIES if not names or study.name in names]


def run_studies(studies: Sequence[Study], out: Path, *, seed: int, quick: bool) -> list[Path]:
    """Runs studies and says what they find. Each one's files are complete when the next one starts.

    Args:
        out: made when it is not there. In it paper_NAME.csv and paper_NAME.png of each study and paper_index.md are
            replaced, and nothing else.
        quick: few trials.

    Returns:
        the files.

    Raises:
        KeyboardInterrupt: with a sentence that says how many studies are finished.
        ValueError: a negative seed.
        OSError: naming the folder or file that cannot be written.
    """
    if seed < 0:
        raise ValueError(f"--seed must not be negative, got {seed}")
    folder = output_folder(out)
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
                with replacing(csv) as part:
                    part.write_text(table.csv(), encoding="utf-8", newline="")
                study.draw(table, png)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"interrupted after {k} of {len(studies)} studies; what was computed is in {folder}"
            ) from None
        files += [csv, png]
        findings = study.findings(table)
        entries.append(_entry(study, trials, findings))
        _write_index(folder, entries, seed, quick)
        _print_study(console, study, findings, time.perf_counter() - start)
    return [*files, folder / INDEX]


def _print_study(console: Console, study: Study, findings: Sequence[str], seconds: float) -> None:
    console.print(f"{study.name}: {study.question} [{seconds:.0f} s]")
    for sentence in findings:
        console.print(f"  {sentence}", soft_wrap=True)


def _entry(study: Study, trials: int, findings: Sequence[str]) -> str:
    name = f"{PREFIX}{study.name}"
    lines = "\n".join(f"- {sentence}" for sentence in findings)
    head = f"## {study.name}\n\n{study.question} [Table]({name}.csv), {trials} trials."
    return f"{head}\n\n{lines}\n\n![{study.question}]({name}.png)\n"


def _write_index(folder: Path, entries: Sequence[str], seed: int, quick: bool) -> None:
    """The studies of this run; of an earlier run's the files stay, but are not listed."""
    with replacing(folder / INDEX) as part:
        head = f"# The paper's experiments\n\n`sylpose experiments`, seed {seed}{', --quick' if quick else ''}.\n"
        part.write_text("\n".join([head, *entries]), encoding="utf-8")
