"""`sylpose sync`: estimate the time offsets between a recording's cameras and write offsets.toml."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from sylpose.commands.app import ADVANCED, OUTPUT, command, exit_with_failures, option
from sylpose.commands.options import BoxesFile, RangeOptions, RecordingOptions, SeedOptions

if TYPE_CHECKING:
    from sylpose.sync.estimation import TimeOffsets


# Warnings about cameras whose offset has this precision (`OffsetPrecision`).
_EXPLANATIONS = {
    "COARSE": "estimated from changes of speed, to whole frames; the poses do not constrain the fraction.",
    "UNOBSERVABLE": "not observable from the motion: the object's speed must change while this camera sees it.",
}


@dataclass(frozen=True, kw_only=True)
class SyncOptions(SeedOptions, RangeOptions, RecordingOptions):
    """Options of `sylpose sync`.

    Attributes:
        out: Write the offsets here; default: SESSION/offsets.toml.
        max_lag: Limit the time offset between two cameras.
    """

    boxes: BoxesFile = None
    out: Annotated[Path | None, option("--out FILE", OUTPUT)] = None
    max_lag: Annotated[float, option("--max-lag SEC", ADVANCED)] = 3.0


@command("Estimate the time offsets between the cameras.")
def sync(options: SyncOptions) -> None:
    """Estimate the time offsets between the cameras from the recorded motion.

    Writes offsets.toml, which sylpose track reads.

    Examples:
        sylpose sync recording
        sylpose sync recording --max-lag 10 --start 200 --stop 600
    """
    from functools import partial

    from rich.progress import track

    from sylpose.atomic_io import make_output_folder
    from sylpose.runs import console_output
    from sylpose.runs.precompile import compile_with_progress
    from sylpose.sync.estimation import OffsetPrecision, sync_session, write_offsets
    from sylpose.sync.offsets import OFFSETS_FILE, load_offsets

    session, out = options.open(options.boxes), options.out
    path = session.path / OFFSETS_FILE if out is None else out
    if out is not None:
        make_output_folder(out.parent)
    if out is not None and out.exists():
        try:
            load_offsets(out, session.rig.names)
        except (OSError, ValueError):
            raise ValueError(f"--out {out}: exists and is not a file of offsets, so it is not replaced") from None
    console, stderr = console_output.make_console(), console_output.make_console(stderr=True)
    console.print(console_output.format_headline(session))
    console_output.print_warnings(console, session.warnings)
    compile_with_progress(console)
    estimate = partial(sync_session, max_lag=options.max_lag, start=options.start, stop=options.stop, seed=options.seed)
    show = partial(track, console=stderr, transient=True, disable=not stderr.is_terminal)
    try:
        found = estimate(session, show_progress=lambda description, total, frames: show(frames, description, total))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; {path} is unchanged") from None
    console.print()
    header = ("Camera", "delay", "+- 1 sd", "frames", "residual", "offset")
    console_output.print_table(console, header, _table_rows(found))
    console.print()
    warnings = [*found.problems]
    for precision, text in _EXPLANATIONS.items():
        if names := [name for name, k in zip(found.cameras, found.precision, strict=True) if k.name == precision]:
            warnings.append(f"{', '.join(names)}: {text}")
    console_output.print_warnings(console, warnings)
    if {*found.precision} == {OffsetPrecision.UNOBSERVABLE}:
        exit_with_failures(["no time offset could be estimated; nothing was written"])
    write_offsets(found, path)
    console_output.print_files(console, "Offsets", [path])


def _table_rows(found: TimeOffsets) -> list[list[str]]:
    from sylpose.sync.estimation import OffsetPrecision

    rows = []
    for c, (name, precision) in enumerate(zip(found.cameras, found.precision, strict=True)):
        digits = 2 if precision is OffsetPrecision.FINE else 0
        values = ["-"] * 3
        if precision is not OffsetPrecision.UNOBSERVABLE:
            delay, sd, frames = 1e3 * found.offsets[c], 1e3 * found.sd[c], found.offsets[c] * found.rate
            values = [f"{delay:.{digits}f} ms", f"{sd:.{digits}f} ms", f"{frames:.{digits}f}"]
        residual = f"{found.before[c]:.2f} to {found.after[c]:.2f} px" if math.isfinite(found.before[c]) else "-"
        rows.append([name, *values, residual, precision.value])
    return rows
