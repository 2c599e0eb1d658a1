"""The command line: `sylpose track`, `batch`, `check`, `box`, `sync`, `show`, `view`, `report`, `demo`, `experiments`,
`export`, `compare`, `node`, `nodes`, `network`, `calibration`, `object`, `pose` and `doctor`.

Everything but the options is imported where it is used: the tracker and matplotlib take a second each, which `--help` does
not need.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from sylpose import __version__
from sylpose.cli.common import app

# Loading them gives them to the app, in the order of `--help`.
from sylpose.cli import track, batch, recordings, studies, results, network, calibrations, objects, poses, doctor  # isort: skip

__all__ = [
    "app",
    "batch",
    "calibrations",
    "doctor",
    "main",
    "network",
    "objects",
    "poses",
    "recordings",
    "results",
    "studies",
    "track",
]


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0, 1 nothing found, 2 wrong input, 130 interrupted."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a terminal without "°" gets "?" and not a crash
            stream.reconfigure(errors="replace")
    # OpenCV would write lines of its own about images that it cannot decode.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    try:
        app(args=None if argv is None else list(argv), prog_name="sylpose")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


def _version(asked: bool) -> None:
    if asked:
        print(f"sylpose {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Say the version and exit.", is_eager=True, callback=_version)
    ] = False,
) -> None:
    pass
