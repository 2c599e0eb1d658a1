"""Files that others wrote: limits before anything is parsed, and one short sentence for whatever is wrong with them.

Whatever a reader raises about a file's content leaves it through `told`, so that it names the file, is one line of bounded
length, and has no control characters of the file in it (SECURITY.md).
"""

from __future__ import annotations

import codecs
import csv
import os
import re
import stat
import tomllib
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

__all__ = [
    "MAX_DEPTH",
    "MAX_TABLE",
    "MAX_TEXT",
    "SENTENCE",
    "Unreadable",
    "bytes_of",
    "one_line",
    "parsed_toml",
    "regular_file",
    "resolved",
    "text_of",
    "told",
]

# Bytes of calibrations and settings (choice: a rig of some hundred cameras, in XML), of these in TOML, whose parser is slow
# (choice: as many), and of tables with a line per frame (choice: a day at 60 frames per second).
MAX_TEXT = 2**20
MAX_TOML = 2**18
MAX_TABLE = 2**29
# Values within values (choice: the deepest that people write is seven).
MAX_DEPTH = 32
# What a sentence says of a file, in characters (choice: three lines of a terminal).
SAID = 300
# What a command says in one sentence, with paths in it (choice).
SENTENCE = 1000
_DIGITS = re.compile(r"[0-9_]{309}")  # beyond it no number is a float
# `tomllib` needs memory and time by the square of a key's parts (a.b.c), which are all in one line: the squares of the
# lines' dots, summed (choice: 100 MB; a rig of 300 cameras has a tenth of it).
MAX_DOTS = 10**7


class Unreadable(ValueError):
    """What is wrong with a file: one line of bounded length that names it."""


@contextmanager
def told(path: Path | str) -> Iterator[None]:
    """Turns what is wrong with a file's content into one sentence that names the file.

    Raises:
        Unreadable: for any `ValueError` and for what parsers and conversions raise where numbers are too large, values
            nested too deep or too many. An `OSError` passes: it has the file's name.
    """
    try:
        yield
    except Unreadable:
        raise
    except RecursionError:
        raise Unreadable(f"{one_line(str(path), 2 * SAID)}: values are nested too deep in it") from None
    except (ValueError, OverflowError, MemoryError, csv.Error) as error:
        name = one_line(str(path), 2 * SAID)
        said = one_line(str(error) or "too much for this computer's memory", 2 * SAID + 2 * len(name))
        # Said of a file in the folder, or of the file already.
        head = said.startswith(name)
        said = said.removeprefix(name) if head else f": {said}"
        raise Unreadable(name + one_line(said, SAID)) from None


def one_line(text: str, limit: int = SAID) -> str:
    """Text as one line of at most `limit` characters, cut in the middle; characters that steer terminals are spelt out."""
    # What is cut away need not be looked at.
    text = text if len(text) <= 2 * limit else f"{text[:limit]}{text[-limit:]}"
    shown = "".join(c if unicodedata.category(c) not in _STEERING else _spelt(c) for c in " ".join(text.split()))
    head = limit * 2 // 3
    return shown if len(shown) <= limit else f"{shown[:head]} ... {shown[head + 5 - limit :]}"


def bytes_of(path: Path, limit: int = MAX_TEXT) -> bytes:
    """The content of a file.

    Raises:
        OSError: it is not there or cannot be read.
        Unreadable: it is no file but a pipe, a device or a folder; or larger than `limit` bytes.
    """
    with told(path), regular_file(path, limit) as file:
        data = file.read(limit + 1)
        if len(data) > limit:
            raise ValueError(_too_long(len(data), limit))
        return data


def regular_file(path: Path, limit: int) -> BinaryIO:
    """A file, opened.

    Raises:
        OSError: as `bytes_of`.
        ValueError: it is no file, or larger than `limit` bytes. For `told`.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("a file is expected, not a folder, a pipe or a device")
    if status.st_size > limit:
        raise ValueError(_too_long(status.st_size, limit))
    return path.open("rb")


def _too_long(size: int, limit: int) -> str:
    return f"{size} bytes, more than the {limit} that such a file may have"


def text_of(path: Path, limit: int = MAX_TEXT) -> str:
    """The content of a text file, UTF-8 with or without its mark; of XML UTF-16 with it, too.

    Raises:
        OSError, Unreadable: as `bytes_of`; it is no text, or has a number of more than 308 digits.
    """
    data = bytes_of(path, limit)
    with told(path):
        try:
            text = data.decode("utf-16" if data.startswith(_UTF16) else "utf-8-sig")
        except UnicodeDecodeError:
            raise ValueError("not text in UTF-8") from None
        if _DIGITS.search(text):
            raise ValueError("a number of more than 308 digits in it")
        return text


def parsed_toml(text: str, limit: int = MAX_TOML) -> dict[str, Any]:
    """The content of TOML.

    Raises:
        ValueError: it is none, has more than `limit` characters or lines with too many dots; RecursionError: nested too
            deep. For `told`.
    """
    if len(text) > limit:
        raise ValueError(f"{len(text)} characters, more than the {limit} that TOML may have")
    if sum(line.count(".") ** 2 for line in text.split("\n")) > MAX_DOTS:
        raise ValueError("too many dots in a line, which are for keys of many parts")
    return tomllib.loads(text)


def resolved(path: Path) -> Path:
    """The path without links in it; as it is where they lead in a circle."""
    return Path(os.path.realpath(path))


_UTF16 = (codecs.BOM_UTF16_LE + b"<\0", codecs.BOM_UTF16_BE + b"\0<")
# Unicode's classes of control characters, marks that turn the direction of writing, halves of characters, line ends, and
# what has no meaning.
_STEERING = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})


def _spelt(character: str) -> str:
    return ascii(character)[1:-1]
