"""YAML, JSON and XML as plain values: dicts, lists, numbers, strings; and any XML as elements.

Not by OpenCV, whose parsers end the process on files that are nested deep. Numbers are floats, true and false 1 and 0.
"""

from __future__ import annotations

import json
import re
from typing import Any
from xml.etree import ElementTree

import yaml

from sylpose.input_limits import MAX_DEPTH

__all__ = ["documents", "elements", "from_json", "from_xml", "from_yaml"]

NO_DOCTYPE = "XML with a document type (<!DOCTYPE>) is not read"
_NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_WORDS = {
    "true": 1.0,
    "false": 0.0,
    ".inf": float("inf"),
    "+.inf": float("inf"),
    "-.inf": -float("inf"),
} | dict.fromkeys((".nan", "-.nan", "+.nan"), float("nan"))
# OpenCV's own JSON has comments, and \' for an apostrophe; what is within strings stays.
_ODD_JSON = re.compile(r"\"(?:\\.|[^\"\\])*\"|/\*.*?\*/|//[^\n]*", re.DOTALL)
_YAML_LOADER: Any = getattr(yaml, "CBaseLoader", yaml.BaseLoader)


def from_json(text: str) -> Any:
    """The content of JSON, OpenCV's too.

    Raises:
        ValueError, RecursionError: with the reason, for `told`.
    """
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except json.JSONDecodeError as error:
        plain = _ODD_JSON.sub(lambda m: m[0].replace("\\'", "'") if m[0][0] == '"' else " ", text)
        try:
            return json.loads(plain, object_pairs_hook=_unique)
        except json.JSONDecodeError:
            raise ValueError(f"not valid JSON: {error}") from None


def from_yaml(text: str) -> Any:
    """The content of YAML's first document, with OpenCV's header or without any.

    Raises:
        ValueError: with the reason, for `told`.
    """
    return next(iter(documents(text, 1)), None)


def documents(text: str, most: int = 1000) -> list[Any]:
    """The contents of YAML's documents, of the first `most` of them.

    Raises:
        ValueError: with the reason, for `told`.
    """
    if text.startswith("%YAML"):  # OpenCV 4 writes %YAML:1.0, which is none of YAML's own
        text = "\n" + text.partition("\n")[2]
    text = re.sub(r"\\(.)", lambda m: "'" if m[1] == "'" else m[0], text)  # nor is \' of YAML
    try:
        return _from_events(text, most)
    except yaml.MarkedYAMLError as error:
        line = f" (line {error.problem_mark.line + 1})" if error.problem_mark else ""
        raise ValueError(f"not valid YAML: {error.problem or error.context}{line}") from None
    except yaml.YAMLError as error:  # characters that YAML does not have
        raise ValueError(f"not valid YAML: {error}") from None


def _from_events(text: str, most: int) -> list[Any]:
    """Without recursion: a list of what is open, each a list of its values, or of keys and values in turn."""
    stack: list[list[Any]] = [[]]
    for event in yaml.parse(text, Loader=_YAML_LOADER):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError("YAML's aliases (*name) are not read")
        if isinstance(event, yaml.ScalarEvent):
            key = isinstance(stack[-1], _Map) and len(stack[-1]) % 2 == 0
            stack[-1].append(event.value if key or event.style else _plain(event.value))
        elif isinstance(event, yaml.CollectionStartEvent):
            stack.append(_Map() if isinstance(event, yaml.MappingStartEvent) else [])
            if len(stack) > MAX_DEPTH:
                raise ValueError(f"values are nested more than {MAX_DEPTH} deep")
        elif isinstance(event, yaml.CollectionEndEvent):
            done = stack.pop()
            stack[-1].append(_unique(zip(done[::2], done[1::2], strict=True)) if isinstance(done, _Map) else done)
        elif isinstance(event, yaml.DocumentEndEvent) and len(stack[0]) >= most:
            break
    return stack[0]


class _Map(list[Any]):
    """Keys and values in turn."""


def from_xml(text: str) -> Any:
    """The content of OpenCV's XML: elements `_` are a sequence's, texts numbers or strings, several of them a sequence.

    Raises:
        ValueError: with the reason, for `told`.
    """
    parser = ElementTree.XMLParser(target=_Builder())
    try:
        parser.feed(text)
        return parser.close()
    except ElementTree.ParseError as error:
        raise ValueError(f"not valid XML: {error}") from None


def elements(text: str) -> ElementTree.Element:
    """The root of any XML.

    Raises:
        ValueError: with the reason, for `told`; for a document type, which may have entities, too.
    """
    parser = ElementTree.XMLParser(target=_Elements())
    try:
        parser.feed(text)
        root = parser.close()
    except ElementTree.ParseError as error:
        raise ValueError(f"not valid XML: {error}") from None
    assert isinstance(root, ElementTree.Element)
    return root


class _Elements(ElementTree.TreeBuilder):
    """Elements, but not nested deep, and without document types."""

    _depth = 0

    def doctype(self, *_: Any) -> None:
        raise ValueError(NO_DOCTYPE)

    def start(self, tag: str, attrs: dict[Any, Any], /) -> ElementTree.Element:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise ValueError(f"elements are nested more than {MAX_DEPTH} deep")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)


class _Builder:
    """What `ElementTree`'s parser tells of a document, as plain values."""

    def __init__(self) -> None:
        self._stack: list[tuple[list[tuple[str, Any]], list[str]]] = [([], [])]

    def doctype(self, *_: Any) -> None:
        raise ValueError(NO_DOCTYPE)

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
            value = _text("".join(texts).strip())
        elif all(name == "_" for name, _ in children):
            value = [value for _, value in children]
        else:
            value = _unique(children)
        self._stack[-1][0].append((tag, value))

    def close(self) -> Any:
        return self._stack[0][0][0][1]


def _text(text: str) -> Any:
    """What is between two tags of XML."""
    if len(text) > 1 and text[0] == text[-1] == '"':
        return text[1:-1]
    values = [_plain(word) for word in text.split()]
    return values if len(values) > 1 else values[0] if values else None


def _plain(text: str) -> Any:
    """A scalar without quotes."""
    if _NUMBER.fullmatch(text):
        return float(text)
    return None if text.lower() in ("", "~", "null") else _WORDS.get(text.lower(), text)


def _unique(pairs: Any) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for key, value in pairs:
        if not isinstance(key, str):
            raise ValueError("a key must be a word, not a list or a map")
        if key in content:
            raise ValueError(f"{key!r} is there twice")
        content[key] = value
    return content
