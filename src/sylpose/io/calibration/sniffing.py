"""Content detection of calibration files before their format is known, and access to the files next to them."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

from sylpose.input_limits import MAX_TEXT_BYTES, input_errors, parse_toml, read_text
from sylpose.io.calibration.markup import parse_json, parse_opencv_xml, parse_xml, parse_yaml, parse_yaml_documents

__all__ = ["Content", "find_sibling_file", "read_content", "read_folder_documents", "read_plain", "read_stripped_text"]

Kind = Literal["toml", "plain", "xml", "unknown"]
# Maximum bytes of XML that is not OpenCV's (choice: masks and thresholds of a hundred cameras of a motion capture
# system).
MAX_XML = 2**24
# Maximum number of single-camera files (choice: more than rigs have).
MAX_FILES = 1000
_MARKUP = (".yml", ".yaml", ".json", ".xml")


class Content(NamedTuple):
    """Content of a file, by kind.

    Attributes:
        kind: "toml"; "plain": YAML, JSON or OpenCV's XML; "xml": any other; "unknown".
        data: a dict; plain values; the root's `Element`; the text.
    """

    kind: Kind
    data: Any


def read_content(path: Path) -> Content:
    """Read and parse a text file whose kind is detected from its content, or from its name if ambiguous.

    Raises:
        OSError: it cannot be read.
        ValueError: it is invalid for the kind given by its beginning or its name; it is too large.
    """
    text = read_text(path)
    suffix, start = path.suffix.lower(), text[:1]
    if start == "<":
        return _parse_xml_content(text)
    if len(text) > MAX_TEXT_BYTES:
        raise ValueError(f"{len(text)} characters, more than the {MAX_TEXT_BYTES} that such a file may have")
    if text.startswith(("%YAML", "---")):
        return Content("plain", parse_yaml(text))
    # A JSON list begins like a TOML table.
    if start == "{" or (start == "[" and suffix == ".json"):
        return Content("plain", parse_json(text))
    try:
        return Content("toml", parse_toml(text))
    except tomllib.TOMLDecodeError as error:
        # YAML without its header differs from broken TOML only by the name.
        if suffix in (".yml", ".yaml"):
            return Content("plain", parse_yaml(text))
        if suffix == ".toml":
            raise ValueError(f"not valid TOML: {error}") from None
        return Content("unknown", text)


def read_stripped_text(path: Path) -> str:
    """Read a file's text, without leading blanks.

    Raises:
        OSError, ValueError: as `input_limits.read_text`.
    """
    return read_text(path, MAX_XML).lstrip()


def read_plain(path: Path) -> Any:
    """Read another file of YAML, JSON or OpenCV's XML.

    Raises:
        OSError, ValueError: as `read_content`; naming the file.
    """
    with input_errors(path):
        kind, data = read_content(path)
        if kind != "plain":
            raise ValueError("not YAML, JSON or OpenCV's XML")
        return data


def find_sibling_file(path: Path, part: str, other: str) -> Path | None:
    """Find the file in the same folder whose name has `other` instead of `part`, ignoring case; None if missing."""
    stem = path.stem.lower()
    if part not in stem:
        return None
    sibling_stem = stem.replace(part, other, 1)
    found = [file for file in sorted(path.parent.iterdir()) if file.stem.lower() == sibling_stem]
    return next((file for file in found if file.suffix.lower() in _MARKUP and file.is_file()), None)


def read_folder_documents(path: Path, *words: str) -> Iterator[tuple[Path, Any]]:
    """Yield the YAML documents in the folder of `path` whose file contains one of these words.

    Raises:
        OSError, ValueError: naming the file, for one that cannot be read.
    """
    files = [file for file in sorted(path.parent.iterdir()) if file.suffix.lower() in (".yml", ".yaml")]
    for file in files[:MAX_FILES]:
        if not file.is_file() or (file.stat().st_size > MAX_TEXT_BYTES and file != path):
            continue
        with input_errors(file):
            text = read_text(file)
            if any(word in text for word in words):
                for document in parse_yaml_documents(text):
                    yield file, document


def _parse_xml_content(text: str) -> Content:
    head = text[:4096]
    if "<opencv_storage" not in head:
        return Content("xml", parse_xml(text))
    if len(text) > MAX_TEXT_BYTES:
        raise ValueError(f"{len(text)} characters, more than the {MAX_TEXT_BYTES} that OpenCV's XML may have")
    return Content("plain", parse_opencv_xml(text))
