"""Consoles of the commands, and messages on stderr."""

from __future__ import annotations

import sys

from rich.console import Console

from sylpose.input_limits import MAX_SENTENCE_LENGTH, to_one_line

__all__ = ["make_console", "print_to_stderr"]


def make_console(*, stderr: bool = False, quiet: bool = False) -> Console:
    """Create a console that does not wrap lines when its output goes to a file or a pipe."""
    console = Console(stderr=stderr, quiet=quiet, highlight=False, emoji=False, markup=False)
    if not console.is_terminal:
        console.width = 10_000
    return console


def print_to_stderr(message: str) -> None:
    """Print a message to stderr, prefixed by the program's name."""
    print(f"sylpose: {to_one_line(message, MAX_SENTENCE_LENGTH)}", file=sys.stderr)
