"""The command line: register the commands and run one."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from sylpose import __version__
from sylpose.commands.app import app

# Importing a module registers its commands; the order is that of `--help`.
from sylpose.commands import track, batch, check, box, sync, certify, scan, demo, show, view, report, experiments  # noqa: F401 # isort: skip
from sylpose.commands import export, compare, relative, calibrate, hand_eye, node, network, pose, doctor, object  # noqa: F401 # isort: skip
from sylpose.commands import calibration  # noqa: F401 # isort: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Args:
        argv: arguments without the program's name; by default those of the process.

    Returns:
        0 on success, 1 if nothing was found, 2 for wrong input, 130 if interrupted.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # print "?" on terminals without "°"
            stream.reconfigure(errors="replace")
    # Keep OpenCV from printing warnings about images that it cannot decode.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    try:
        app(args=None if argv is None else list(argv), prog_name="sylpose")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


def _show_version(requested: bool) -> None:
    if requested:
        print(f"sylpose {__version__}")
        raise typer.Exit


Version = typer.Option("--version", help="Show the version and exit.", is_eager=True, callback=_show_version)


@app.callback()
def _root(version: Annotated[bool, Version] = False) -> None:
    pass
