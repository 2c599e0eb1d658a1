"""`sylpose experiments`: run the paper's studies, with a table and a figure of each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from sylpose.commands.app import command, option
from sylpose.commands.options import SeedOptions

# Prefix of all files written; other files of the folder are not touched.
PREFIX = "paper_"
INDEX = f"{PREFIX}index.md"


@dataclass(frozen=True, kw_only=True)
class ExperimentsOptions(SeedOptions):
    """Options of `sylpose experiments`.

    Attributes:
        out: Write tables and figures here.
        only: Run only this study. Repeatable; an unknown name lists them.
        quick: Use few trials: half a minute instead of five.
    """

    out: Annotated[Path, option("--out DIR")] = Path("sylpose_experiments")
    only: Annotated[tuple[str, ...], option("--only STUDY")] = ()
    quick: Annotated[bool, option("--quick")] = False


@command("Run the paper's experiments: tables and figures.")
def experiments(options: ExperimentsOptions) -> None:
    """Simulate the paper's estimators: accuracy, robustness and computing time.

    Writes paper_STUDY.csv and paper_STUDY.png for each study and paper_index.md into OUT; other files there are kept.

    Examples:
        sylpose experiments
        sylpose experiments --only noise --only cameras --out noise --quick
    """
    import time

    from sylpose.atomic_io import make_output_folder, replace_atomically
    from sylpose.experiments import STUDIES
    from sylpose.runs import console_output

    known = [study.name for study in STUDIES]
    for name in options.only:
        if name not in known:
            raise ValueError(f"no study {name!r}; available: {', '.join(known)}")
    studies = [study for study in STUDIES if not options.only or study.name in options.only]
    folder = make_output_folder(options.out)
    console, files = console_output.make_console(), list[Path]()
    quick = ", --quick" if options.quick else ""
    index = [f"# The paper's experiments\n\n`sylpose experiments`, seed {options.seed}{quick}.\n"]

    def write_text(file: Path, text: str, newline: str | None = None) -> None:
        with replace_atomically(file) as part:
            part.write_text(text, encoding="utf-8", newline=newline)

    write_text(folder / INDEX, index[0])
    for k, study in enumerate(studies):
        trials, start = study.quick_trials if options.quick else study.trials, time.perf_counter()
        csv, png = (folder / f"{PREFIX}{study.name}.{kind}" for kind in ("csv", "png"))
        try:
            with console.status(f"{study.name}: {study.question} ({k + 1} of {len(studies)}) ..."):
                table = study.run(options.seed, trials)
                write_text(csv, table.to_csv(), newline="")
                study.draw(table, png)
        except KeyboardInterrupt:
            finished = f"{k} of {len(studies)} studies; finished results are in {folder}"
            raise KeyboardInterrupt(f"interrupted after {finished}") from None
        findings = study.summarize(table)
        files += [csv, png]
        # The index lists the studies of this run; each study's files are complete when the next one starts.
        lines, question = "\n".join(f"- {sentence}" for sentence in findings), study.question
        head = f"## {study.name}\n\n{question} [Table]({csv.name}), {trials} trials."
        index.append(f"{head}\n\n{lines}\n\n![{question}]({png.name})\n")
        write_text(folder / INDEX, "\n".join(index))
        console.print(f"{study.name}: {study.question} [{time.perf_counter() - start:.0f} s]")
        for sentence in findings:
            console.print(f"  {sentence}", soft_wrap=True)
    console_output.print_files(console, "Files", [*files, folder / INDEX])
