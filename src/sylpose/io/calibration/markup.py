"""YAML, JSON and XML parsing to plain values: dicts, lists, numbers, strings; and XML to elements.

OpenCV's parsers are not used: they crash the process on deeply nested files. Numbers are floats, booleans 1 and 0.
"""

from __future__ import annotations

import json
import re
from typing import Any
from xml.etree import ElementTree

import yaml

from sylpose.input_limits import MAX_DEPTH

__all__ = ["parse_json", "parse_opencv_xml", "parse_xml", "parse_yaml", "parse_yaml_documents"]

DOCTYPE_ERROR = "XML with a document type (<!DOCTYPE>) is not supported"
_NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_LITERALS = {
    "true": 1.0,
    "false": 0.0,
    ".inf": float("inf"),
    "+.inf": float("inf"),
    "-.inf": -float("inf"),
} | dict.fromkeys((".nan", "-.nan", "+.nan"), float("nan"))
# OpenCV's JSON dialect has comments, and \' for an apostrophe; strings are kept unchanged.
_OPENCV_JSON = re.compile(r"\"(?:\\.|[^\"\\])*\"|/\*.*?\*/|//[^\n]*", re.DOTALL)
_YAML_LOADER: Any = getattr(yaml, "CBaseLoader", yaml.BaseLoader)


def parse_json(text: str) -> Any:
    """Parse JSON, including OpenCV's dialect.

    Raises:
        ValueError, RecursionError: with the reason, to be wrapped by `input_errors`.
    """
    try:
        return json.loads(text, object_pairs_hook=_build_unique_dict)
    except json.JSONDecodeError as error:
        plain = _OPENCV_JSON.sub(lambda m: m[0].replace("\\'", "'") if m[0][0] == '"' else " ", text)
        try:
            return json.loads(plain, object_pairs_hook=_build_unique_dict)
        except json.JSONDecodeError:
            raise ValueError(f"not valid JSON: {error}") from None


def parse_yaml(text: str) -> Any:
    """Parse the first YAML document, with or without OpenCV's header.

    Raises:
        ValueError: with the reason, to be wrapped by `input_errors`.
    """
    return next(iter(parse_yaml_documents(text, 1)), None)


def parse_yaml_documents(text: str, max_documents: int = 1000) -> list[Any]:
    """Parse the first `max_documents` YAML documents of a text.

    Raises:
        ValueError: with the reason, to be wrapped by `input_errors`.
    """
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
            if len(stack) > MAX_DEPTH:
                raise ValueError(f"values are nested more than {MAX_DEPTH} deep")
        elif isinstance(event, yaml.CollectionEndEvent):
            finished = stack.pop()
            stack[-1].append(
                _build_unique_dict(zip(finished[::2], finished[1::2], strict=True))
                if isinstance(finished, _OpenMap)
                else finished
            )
        elif isinstance(event, yaml.DocumentEndEvent) and len(stack[0]) >= max_documents:
            break
    return stack[0]


class _OpenMap(list[Any]):
    """Open mapping, as alternating keys and values."""


def parse_opencv_xml(text: str) -> Any:
    """Parse OpenCV's XML: elements `_` form a sequence; text is a number, a string, or a sequence of several.

    Raises:
        ValueError: with the reason, to be wrapped by `input_errors`.
    """
    parser = ElementTree.XMLParser(target=_ValueBuilder())
    try:
        parser.feed(text)
        return parser.close()
    except ElementTree.ParseError as error:
        raise ValueError(f"not valid XML: {error}") from None


def parse_xml(text: str) -> ElementTree.Element:
    """Parse any XML and return its root.

    Raises:
        ValueError: with the reason, to be wrapped by `input_errors`; also for a document type, which may define
            entities.
    """
    parser = ElementTree.XMLParser(target=_ElementBuilder())
    try:
        parser.feed(text)
        root = parser.close()
    except ElementTree.ParseError as error:
        raise ValueError(f"not valid XML: {error}") from None
    assert isinstance(root, ElementTree.Element)
    return root


class _ElementBuilder(ElementTree.TreeBuilder):
    """Element builder that rejects deep nesting and document types."""

    _depth = 0

    def doctype(self, *_: Any) -> None:
        raise ValueError(DOCTYPE_ERROR)

    def start(self, tag: str, attrs: dict[Any, Any], /) -> ElementTree.Element:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise ValueError(f"elements are nested more than {MAX_DEPTH} deep")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)


class _ValueBuilder:
    """`ElementTree` parser target that builds plain values."""

    def __init__(self) -> None:
        self._stack: list[tuple[list[tuple[str, Any]], list[str]]] = [([], [])]

    def doctype(self, *_: Any) -> None:
        raise ValueError(DOCTYPE_ERROR)

    def start(self, tag: str, _: dict[str, str]) -> None:
        if len(self._stack) == 1 and tag != "opencv_storage":
            raise ValueError(f"not OpenCV's XML: the first element must be <opencv_storage>, got <{tag}>")
        self._stack.append(([], []))
        if len(self._stack) > MAX_DEPTH:
            raise ValueError(f"elements are nested more than {MAX_DEPTH} deep")

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


def _parse_xml_text(text: str) -> Any:
    """Parse the text between two XML tags."""
    if len(text) > 1 and text[0] == text[-1] == '"':
        return text[1:-1]
    values = [_parse_scalar(word) for word in text.split()]
    return values if len(values) > 1 else values[0] if values else None


def _parse_scalar(text: str) -> Any:
    """Parse a scalar without quotes."""
    if _NUMBER.fullmatch(text):
        return float(text)
    return None if text.lower() in ("", "~", "null") else _LITERALS.get(text.lower(), text)


def _build_unique_dict(pairs: Any) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for key, value in pairs:
        if not isinstance(key, str):
            raise ValueError("a key must be a word, not a list or a map")
        if key in content:
            raise ValueError(f"duplicate key {key!r}")
        content[key] = value
    return content
