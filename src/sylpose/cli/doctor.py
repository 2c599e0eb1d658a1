"""`sylpose doctor`."""

from __future__ import annotations

from typing import Annotated

import typer

from sylpose.cli.common import app, examples, fail, spoken

__all__ = ["doctor"]


@app.command(
    short_help="What is installed, and whether it works.",
    epilog=examples("sylpose doctor", "sylpose doctor --json", "sylpose doctor --compile"),
)
@spoken
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="As one object, for programs and reports.")] = False,
    compile_first: Annotated[
        bool, typer.Option("--compile", help="Compile what tracking needs now, so that the first run does not.")
    ] = False,
) -> None:
    """Versions, OpenCV's flavour, cores and memory, where compiled code is kept, extras and how to get them.

    Exit code 1, with sentences, where something that is needed is missing or broken.
    """
    from sylpose.app.doctor import doctor_aloud

    if problems := doctor_aloud(as_json=as_json, compile_first=compile_first):
        fail(problems)
