"""Where the commands speak: consoles, and sentences on stderr."""

from __future__ import annotations

import sys

from rich.console import Console

from sylpose.input_limits import SENTENCE, one_line

__all__ = ["make_console", "say"]


def make_console(*, stderr: bool = False, quiet: bool = False) -> Console:
    """A console that never breaks lines where nobody looks at them: in files and pipes."""
    console = Console(stderr=stderr, quiet=quiet, highlight=False, emoji=False, markup=False)
    if not console.is_terminal:
        console.width = 10_000
    return console


def say(sentence: str) -> None:
    """What went wrong, on stderr."""
    print(f"sylpose: {one_line(sentence, SENTENCE)}", file=sys.stderr)
