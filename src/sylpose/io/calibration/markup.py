"""Text files parsed to plain values (dicts, lists, numbers, strings) or XML elements; their kind is detected.

OpenCV's parsers are not used: they crash the process on deeply nested files. Numbers are floats, booleans 1 and 0.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple
from xml.etree import ElementTree

import yaml
from defusedxml import DTDForbidden
from defusedxml.ElementTree import DefusedXMLParser

from sylpose.input_limits import MAX_DEPTH, MAX_TEXT_BYTES, input_errors, parse_toml, read_text

# Maximum bytes of XML that is not OpenCV's (choice: masks and thresholds of a hundred cameras of a motion capture
# system).
MAX_XML_BYTES = 2**24
# Maximum number of single-camera files (choice: more than rigs have).
MAX_FILES = 1000
_MARKUP = (".yml", ".yaml", ".json", ".xml")
_NUMBER = re.compile(r"[-+]?(?:[0-9]++\.?[0-9]*+|\.[0-9]++)(?:[eE][-+]?[0-9]++)?")
_LITERALS = {
    "true": 1.0,
    "false": 0.0,
    **dict.fromkeys((".inf", "+.inf"), float("inf")),
    "-.inf": -float("inf"),
    **dict.fromkeys((".nan", "-.nan", "+.nan"), float("nan")),
    **dict.fromkeys(("", "~", "null")),
}
# OpenCV's JSON dialect has comments, and \' for an apostrophe; strings are kept unchanged. One that does not end is
# matched up to the end of the text: searched again from each of its characters, it would take quadratic time.
_OPENCV_JSON = re.compile(r"\"(?:\\.|[^\"\\])*+(?:\"|\\?\Z)|/\*.*?(\*/|\Z)|//[^\n]*", re.DOTALL)
_YAML_LOADER: Any = getattr(yaml, "CBaseLoader", yaml.BaseLoader)


class Content(NamedTuple):
    """Content of a file, by kind.

    Attributes:
        kind: "toml"; "plain": YAML, JSON or OpenCV's XML; "xml": any other; "unknown".
        data: a dict; plain values; the root's `Element`; the text.
    """

    kind: Literal["toml", "plain", "xml", "unknown"]
    data: Any


def read_content(path: Path) -> Content:
    """Read and parse a text file whose kind is detected from its content, or from its name if ambiguous.

    Raises:
        OSError: it cannot be read.
        ValueError: it is invalid for the kind given by its beginning or its name; it is too large.
    """
    text = read_text(path, MAX_XML_BYTES).lstrip()
    suffix, start = path.suffix.lower(), text[:1]
    if start == "<" and "<opencv_storage" not in text[:4096]:
        return Content("xml", _parse_xml(text, _ElementBuilder()))
    if len(text) > MAX_TEXT_BYTES:
        raise ValueError(f"{len(text)} characters, more than the {MAX_TEXT_BYTES} that such a file may have")
    if start == "<":
        return Content("plain", _parse_xml(text, _ValueBuilder()))
    if text.startswith(("%YAML", "---")):
        return Content("plain", _parse_yaml(text))
    # A JSON list begins like a TOML table.
    if start == "{" or (start == "[" and suffix == ".json"):
        return Content("plain", _parse_json(text))
    try:
        return Content("toml", parse_toml(text))
    except tomllib.TOMLDecodeError:
        # YAML without its header differs from broken TOML only by the name.
        if suffix in (".yml", ".yaml"):
            return Content("plain", _parse_yaml(text))
        if suffix == ".toml":
            raise
        return Content("unknown", text)


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
                for document in _parse_yaml_documents(text):
                    yield file, document


def _parse_json(text: str) -> Any:
    """Parse JSON, including OpenCV's dialect."""
    try:
        return json.loads(text, object_pairs_hook=_build_unique_dict)
    except json.JSONDecodeError as error:
        try:
            return json.loads(_OPENCV_JSON.sub(_to_standard_json, text), object_pairs_hook=_build_unique_dict)
        except json.JSONDecodeError:
            raise ValueError(f"not valid JSON: {error}") from None


def _to_standard_json(match: re.Match[str]) -> str:
    """Return the standard form of a string or comment of OpenCV's dialect; a comment that does not end is kept."""
    if match[0][0] == '"':
        return match[0].replace("\\'", "'")
    return match[0] if match[1] == "" else " "


def _parse_yaml(text: str) -> Any:
    """Parse the first YAML document, with or without OpenCV's header."""
    return next(iter(_parse_yaml_documents(text, 1)), None)


def _parse_yaml_documents(text: str, max_documents: int = 1000) -> list[Any]:
    """Parse the first `max_documents` YAML documents of a text."""
    if text.startswith("%YAML"):  # OpenCV 4 writes %YAML:1.0, which is not valid YAML
        text = "\n" + text.partition("\n")[2]
    text = re.sub(r"\\(.)", lambda m: "'" if m[1] == "'" else m[0], text)  # nor is \'
    try:
        return _build_documents(text, max_documents)
    except yaml.MarkedYAMLError as error:
        line = f" (line {error.problem_mark.line + 1})" if error.problem_mark else ""
        raise ValueError(f"not valid YAML: {error.problem or error.context}{line}") from None
    except yaml.YAMLError as error:  # characters that YAML does not allow
        raise ValueError(f"not valid YAML: {error}") from None


def _build_documents(text: str, max_documents: int) -> list[Any]:
    """Build documents from parser events without recursion.

    The stack contains the open collections, each a list of its values, or of alternating keys and values.
    """
    stack: list[list[Any]] = [[]]
    for event in yaml.parse(text, Loader=_YAML_LOADER):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError("YAML aliases (*name) are not supported")
        if isinstance(event, yaml.ScalarEvent):
            key = isinstance(stack[-1], _OpenMap) and len(stack[-1]) % 2 == 0
            stack[-1].append(event.value if key or event.style else _parse_scalar(event.value))
        elif isinstance(event, yaml.CollectionStartEvent):
            stack.append(_OpenMap() if isinstance(event, yaml.MappingStartEvent) else [])
            _check_depth(len(stack), "values")
        elif isinstance(event, yaml.CollectionEndEvent):
            finished = stack.pop()
            is_map = isinstance(finished, _OpenMap)
            pairs = zip(finished[::2], finished[1::2], strict=True) if is_map else ()
            stack[-1].append(_build_unique_dict(pairs) if is_map else finished)
        elif isinstance(event, yaml.DocumentEndEvent) and len(stack[0]) >= max_documents:
            break
    return stack[0]


class _OpenMap(list[Any]):
    """Open mapping, as alternating keys and values."""


def _parse_xml(text: str, target: Any) -> Any:
    """Parse XML without document type by the methods of an `ElementTree` parser target; return what it builds."""
    parser = DefusedXMLParser(target=target, forbid_dtd=True)
    try:
        parser.feed(text)
        return parser.close()
    except DTDForbidden:
        raise ValueError("XML with a document type (<!DOCTYPE>) is not supported") from None
    except ElementTree.ParseError as error:
        raise ValueError(f"not valid XML: {error}") from None


class _ElementBuilder(ElementTree.TreeBuilder):
    """Element builder that rejects deep nesting."""

    _depth = 0

    def start(self, tag: str, attrs: dict[Any, Any], /) -> ElementTree.Element:
        self._depth += 1
        _check_depth(self._depth, "elements")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)


class _ValueBuilder:
    """Builder of plain values from OpenCV's XML.

    Elements `_` form a sequence; text is a number, a string, or a sequence of several.
    """

    def __init__(self) -> None:
        self._stack: list[tuple[list[tuple[str, Any]], list[str]]] = [([], [])]

    def start(self, tag: str, _: dict[str, str]) -> None:
        if len(self._stack) == 1 and tag != "opencv_storage":
            raise ValueError(f"not OpenCV's XML: the first element must be <opencv_storage>, got <{tag}>")
        self._stack.append(([], []))
        _check_depth(len(self._stack), "elements")

    def data(self, text: str) -> None:
        self._stack[-1][1].append(text)

    def end(self, tag: str) -> None:
        children, texts = self._stack.pop()
        if not children:
            value = _parse_xml_text("".join(texts).strip())
        elif all(name == "_" for name, _ in children):
            value = [value for _, value in children]
        else:
            value = _build_unique_dict(children)
        self._stack[-1][0].append((tag, value))

    def close(self) -> Any:
        return self._stack[0][0][0][1]


def _check_depth(depth: int, nodes: str) -> None:
    if depth > MAX_DEPTH:
        raise ValueError(f"{nodes} are nested more than {MAX_DEPTH} deep")


def _parse_xml_text(text: str) -> Any:
    """Parse the text between two XML tags."""
    if len(text) > 1 and text[0] == text[-1] == '"':
        return text[1:-1]
    values = [_parse_scalar(word) for word in text.split()]
    return values if len(values) > 1 else values[0] if values else None


def _parse_scalar(text: str) -> Any:
    """Parse a scalar without quotes."""
    return float(text) if _NUMBER.fullmatch(text) else _LITERALS.get(text.lower(), text)


def _build_unique_dict(pairs: Any) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for key, value in pairs:
        if not isinstance(key, str):
            raise ValueError("a key must be a word, not a list or a map")
        if key in content:
            raise ValueError(f"duplicate key {key!r}")
        content[key] = value
    return content
