"""`sylpose doctor`."""

from __future__ import annotations

from typing import Annotated

import typer

from sylpose.commands.app import app, exit_with_failures, format_examples, report_errors

__all__ = ["doctor"]


@app.command(
    short_help="Check the installation.",
    epilog=format_examples("sylpose doctor", "sylpose doctor --json", "sylpose doctor --compile"),
)
@report_errors
def doctor(
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object, for programs and bug reports.")
    ] = False,
    compile_first: Annotated[
        bool, typer.Option("--compile", help="Compile the tracking kernels now, to save the time in the first run.")
    ] = False,
) -> None:
    """Check the installation and list missing optional packages.

    Shows versions, the OpenCV variant, cores and memory, the cache of compiled code, and the extras with their install
    commands. Exits with code 1 and a message for each required package that is missing or broken.
    """
    from sylpose.commands.doctor import run_doctor_command

    if problems := run_doctor_command(as_json=as_json, compile_first=compile_first):
        exit_with_failures(problems)
