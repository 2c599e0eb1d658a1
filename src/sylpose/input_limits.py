"""Limits for input files, and one short message on stderr for any problem with them.

Readers raise errors about a file's content through `input_errors`, so that the message names the file, is one line of
bounded length, and contains no control characters of the file (SECURITY.md).
"""

from __future__ import annotations

import codecs
import csv
import os
import re
import stat
import sys
import tomllib
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

# Bytes of calibrations and settings (choice: a rig of some hundred cameras, in XML), of these in TOML, whose parser is
# slow (choice: as many), and of tables with a line per frame (choice: a day at 60 frames per second).
MAX_TEXT_BYTES = 2**20
MAX_TOML_BYTES = 2**18
MAX_TABLE_BYTES = 2**29
# Nesting depth of values (choice: handwritten files have at most seven levels).
MAX_DEPTH = 32
# Length of a message about a file, in characters (choice: three lines of a terminal).
MAX_MESSAGE_LENGTH = 300
# Length of a command's message, including paths (choice).
MAX_SENTENCE_LENGTH = 1000
_DIGITS = re.compile(r"[0-9_]{309}")  # longer numbers overflow a float
# `tomllib` needs memory and time quadratic in the number of parts of a key (a.b.c), which are on one line: sum of the
# squares of the lines' dots (choice: 100 MB; a rig of 300 cameras needs a tenth of it).
MAX_SQUARED_DOTS = 10**7


class UnreadableFileError(ValueError):
    """Error about a file's content: one line of bounded length that names the file."""


@contextmanager
def input_errors(path: Path | str) -> Iterator[None]:
    """Turn errors about a file's content into one message that names the file.

    Raises:
        UnreadableFileError: for any `ValueError`, and for errors of parsers and conversions on numbers that are too
            large or values that are too many or nested too deep. An `OSError` passes unchanged: it names the file.
    """
    try:
        yield
    except UnreadableFileError:
        raise
    except RecursionError:
        raise UnreadableFileError(
            f"{to_one_line(str(path), 2 * MAX_MESSAGE_LENGTH)}: values are nested too deep in it"
        ) from None
    except (ValueError, OverflowError, MemoryError, csv.Error) as error:
        name = to_one_line(str(path), 2 * MAX_MESSAGE_LENGTH)
        message = to_one_line(str(error) or "not enough memory to read it", 2 * MAX_MESSAGE_LENGTH + 2 * len(name))
        # The message may already start with the name of the file, or of its folder.
        has_name = message.startswith(name)
        message = message.removeprefix(name) if has_name else f": {message}"
        raise UnreadableFileError(name + to_one_line(message, MAX_MESSAGE_LENGTH)) from None


def to_one_line(text: str, limit: int = MAX_MESSAGE_LENGTH) -> str:
    """Return text as one line of at most `limit` characters, cut in the middle.

    Control characters are escaped.
    """
    # The part that is cut away is not processed.
    text = text if len(text) <= 2 * limit else f"{text[:limit]}{text[-limit:]}"
    escaped = "".join(
        c if unicodedata.category(c) not in _CONTROL_CATEGORIES else _escape(c) for c in " ".join(text.split())
    )
    head = limit * 2 // 3
    return escaped if len(escaped) <= limit else f"{escaped[:head]} ... {escaped[head + 5 - limit :]}"


def print_message(message: str) -> None:
    """Print a message on stderr as one line that begins with "sylpose: "."""
    # Names of files may contain line breaks.
    print(f"sylpose: {to_one_line(message, MAX_SENTENCE_LENGTH)}", file=sys.stderr)


def read_bytes(path: Path, limit: int = MAX_TEXT_BYTES) -> bytes:
    """Return the content of a file.

    Raises:
        OSError: it does not exist or cannot be read.
        UnreadableFileError: not a regular file (a pipe, a device or a folder), or larger than `limit` bytes.
    """
    with input_errors(path), open_regular_file(path, limit) as file:
        data = file.read(limit + 1)
        if len(data) > limit:
            raise ValueError(_size_error(len(data), limit))
        return data


def open_regular_file(path: Path, limit: int) -> BinaryIO:
    """Open a regular file for reading.

    Raises:
        OSError: as `read_bytes`.
        ValueError: not a regular file, or larger than `limit` bytes. To be converted by `input_errors`.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("a file is expected, not a folder, a pipe or a device")
    if status.st_size > limit:
        raise ValueError(_size_error(status.st_size, limit))
    return path.open("rb")


def _size_error(size: int, limit: int) -> str:
    return f"{size} bytes, more than the {limit} allowed for such a file"


def read_text(path: Path, limit: int = MAX_TEXT_BYTES) -> str:
    """Return the content of a text file in UTF-8, with or without byte order mark, or in UTF-16 with one.

    Raises:
        OSError, UnreadableFileError: as `read_bytes`; not text, or with a number of more than 308 digits.
    """
    data = read_bytes(path, limit)
    with input_errors(path):
        try:
            is_utf16 = data.startswith(_UTF16) and not data.startswith(codecs.BOM_UTF32_LE)
            text = data.decode("utf-16" if is_utf16 else "utf-8-sig")
        except UnicodeDecodeError:
            raise ValueError("not text in UTF-8; save it with this encoding") from None
        if _DIGITS.search(text):
            raise ValueError("it has a number of more than 308 digits")
        return text


def parse_toml(text: str, limit: int = MAX_TOML_BYTES) -> dict[str, Any]:
    """Parse TOML.

    Raises:
        tomllib.TOMLDecodeError: invalid.
        ValueError: more than `limit` characters, or lines with too many dots.
        RecursionError: nested too deep. All are to be converted by `input_errors`.
    """
    if len(text) > limit:
        raise ValueError(f"{len(text)} characters, more than the {limit} allowed for TOML")
    if sum(line.count(".") ** 2 for line in text.split("\n")) > MAX_SQUARED_DOTS:
        raise ValueError("too many dots in a line")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        error.args = (f"not valid TOML: {error}",)
        raise


def resolve_path(path: Path) -> Path:
    """Return the path with its links resolved; circular links are left as they are."""
    return Path(os.path.realpath(path))


_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
# Unicode categories of control characters, bidirectional marks, surrogates, line separators and unassigned characters.
_CONTROL_CATEGORIES = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})


def _escape(character: str) -> str:
    return ascii(character)[1:-1]
