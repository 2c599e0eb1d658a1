"""What is in a calibration file, before it is known of which format it is, and which files lie beside it."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

from sylpose.calibration.markup import documents, elements, from_json, from_xml, from_yaml
from sylpose.input_limits import MAX_TEXT, parsed_toml, text_of, told

__all__ = ["Content", "beside", "content_of", "documents_beside", "plain_of", "text_in"]

Kind = Literal["toml", "plain", "xml", "unknown"]
# Of XML that is not OpenCV's, bytes (choice: masks and thresholds of a hundred cameras of a motion capture system).
MAX_XML = 2**24
# Files of one camera each (choice: more than rigs have).
MAX_FILES = 1000
_MARKUP = (".yml", ".yaml", ".json", ".xml")


class Content(NamedTuple):
    """A file's content by its kind.

    Attributes:
        kind: "toml"; "plain": YAML, JSON or OpenCV's XML; "xml": any other; "unknown".
        data: a dict; plain values; the root's `Element`; the text.
    """

    kind: Kind
    data: Any


def content_of(path: Path) -> Content:
    """The content of a text file, whose kind is told from its content, and where that may be several by its name.

    Raises:
        OSError: it cannot be read.
        ValueError: what its beginning or its name says it is, it is not; it is too large.
    """
    text = text_in(path)
    suffix, start = path.suffix.lower(), text[:1]
    if start == "<":
        return _xml(text)
    if len(text) > MAX_TEXT:
        raise ValueError(f"{len(text)} characters, more than the {MAX_TEXT} that such a file may have")
    if text.startswith(("%YAML", "---")):
        return Content("plain", from_yaml(text))
    # A list in JSON begins as a table of TOML does.
    if start == "{" or (start == "[" and suffix == ".json"):
        return Content("plain", from_json(text))
    try:
        return Content("toml", parsed_toml(text))
    except tomllib.TOMLDecodeError as error:
        # YAML without its header cannot be told from broken TOML but by the name.
        if suffix in (".yml", ".yaml"):
            return Content("plain", from_yaml(text))
        if suffix == ".toml":
            raise ValueError(f"not valid TOML: {error}") from None
        return Content("unknown", text)


def text_in(path: Path) -> str:
    """A file's text, without blanks before it.

    Raises:
        OSError, ValueError: as `reading.text_of`.
    """
    return text_of(path, MAX_XML).lstrip()


def plain_of(path: Path) -> Any:
    """The content of another file of YAML, JSON or OpenCV's XML.

    Raises:
        OSError, ValueError: as `content_of`; naming the file.
    """
    with told(path):
        kind, data = content_of(path)
        if kind != "plain":
            raise ValueError("not YAML, JSON or OpenCV's XML")
        return data


def beside(path: Path, part: str, other: str) -> Path | None:
    """The file whose name has `other` where that of `path` has `part`, in any letters; None where there is none."""
    stem = path.stem.lower()
    if part not in stem:
        return None
    wanted = stem.replace(part, other, 1)
    found = [file for file in sorted(path.parent.iterdir()) if file.stem.lower() == wanted]
    return next((file for file in found if file.suffix.lower() in _MARKUP and file.is_file()), None)


def documents_beside(path: Path, *words: str) -> Iterator[tuple[Path, Any]]:
    """The documents of a file of YAML and of all others in its folder in which one of these words stands.

    Raises:
        OSError, ValueError: naming the file, for one that cannot be read.
    """
    files = [file for file in sorted(path.parent.iterdir()) if file.suffix.lower() in (".yml", ".yaml")]
    for file in files[:MAX_FILES]:
        if not file.is_file() or (file.stat().st_size > MAX_TEXT and file != path):
            continue
        with told(file):
            text = text_of(file)
            if any(word in text for word in words):
                for document in documents(text):
                    yield file, document


def _xml(text: str) -> Content:
    head = text[:4096]
    if "<opencv_storage" not in head:
        return Content("xml", elements(text))
    if len(text) > MAX_TEXT:
        raise ValueError(f"{len(text)} characters, more than the {MAX_TEXT} that OpenCV's XML may have")
    return Content("plain", from_xml(text))
