"""`sylpose demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.commands.app import GroupedCommand, app, exit_with_failures, format_examples, report_errors
from sylpose.commands.options import Seed

__all__ = ["demo"]


@app.command(
    cls=GroupedCommand,
    short_help="Render and track a recording with ground truth.",
    epilog=format_examples("sylpose demo", "sylpose demo --turn 120 --cameras 3 --out block"),
)
@report_errors
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Write the recording and the results here.")] = Path(
        "sylpose_demo"
    ),
    frames: Annotated[int, typer.Option(metavar="N", help="Render N frames at 30 per second.")] = 60,
    turn: Annotated[float, typer.Option(metavar="DEG", help="Set the object's total rotation.")] = 90.0,
    cameras: Annotated[int, typer.Option(metavar="N", help="Set the number of cameras.")] = 4,
    seed: Seed = 0,
) -> None:
    """Render a recording with ground truth, track it from its videos and compare.

    A textured block rotates and drifts in front of the cameras. Exit code 0 if the rotation error is below 2 degrees in
    all frames.
    """
    from sylpose.commands.demo import run_demo_command

    if failures := run_demo_command(out, frames=frames, turn_deg=turn, n_cameras=cameras, seed=seed):
        exit_with_failures(failures)
