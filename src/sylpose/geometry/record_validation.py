"""Validation of external values against the annotations of records: types, and shapes of arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

__all__ = ["Shapes", "check_shapes", "convert_to_type", "get_fields"]

# Shapes by field; a letter is the same number throughout a record.
Shapes = Mapping[str, tuple[int | str, ...]]


def get_fields(kind: Any) -> tuple[tuple[str, Any], ...]:
    """Return the fields of a dataclass or named tuple in order, with their types; only those that are arguments."""
    return _get_fields(kind)


@cache
def _get_fields(kind: Any) -> tuple[tuple[str, Any], ...]:
    hints = get_type_hints(kind)
    names = [field.name for field in fields(kind) if field.init] if is_dataclass(kind) else list(kind._fields)
    return tuple((name, hints[name]) for name in names)


def convert_to_type(hint: Any, value: Any) -> Any:
    """Return a value converted to a field's type.

    Strings become enumerations, integers floats, lists tuples. Arrays must have the same kind of numbers, and 0 and 1
    are accepted for False and True. Other types are compared as they are.

    Raises:
        TypeError: it has another type.
    """
    hint = _resolve_alias(hint)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (UnionType, Union):
        for part in arguments:
            try:
                return convert_to_type(part, value)
            except TypeError:
                continue
    elif origin is tuple and isinstance(value, (list, tuple)):
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(convert_to_type(arguments[0], part) for part in value)
        if len(value) == len(arguments):
            return tuple(convert_to_type(part, item) for part, item in zip(arguments, value, strict=True))
    elif origin in (list, Sequence) and isinstance(value, (list, tuple)):
        return type(value)(convert_to_type(arguments[0], part) for part in value)
    elif origin in (dict, Mapping) and isinstance(value, dict):
        return {convert_to_type(arguments[0], key): convert_to_type(arguments[1], item) for key, item in value.items()}
    elif origin is np.ndarray and isinstance(value, np.ndarray):
        expected_kind = np.dtype(get_args(arguments[1])[0]).kind
        if value.dtype.kind in {"b": "bi", "i": "iu"}.get(expected_kind, expected_kind):
            return value.astype(bool) if expected_kind == "b" and value.dtype.kind != "b" else value
    elif origin is Literal:
        if value in arguments:
            return value
    elif hint is None or hint is NoneType:
        if value is None:
            return value
    elif origin is None and isinstance(hint, type):
        return _convert_plain(hint, value)
    elif isinstance(origin, type) and isinstance(value, origin):
        return value
    raise TypeError(type(value).__name__)


def _resolve_alias(hint: Any) -> Any:
    """Return the type that a `type` alias stands for, as NumPy's NDArray is one since 2.5; other types unchanged."""
    resolved = getattr(get_origin(hint) or hint, "__value__", None)
    if resolved is None:
        return hint
    return resolved[get_args(hint)] if get_args(hint) else resolved


def _convert_plain(kind: type[Any], value: Any) -> Any:
    """Convert as `convert_to_type`, for a class without parameters."""
    if issubclass(kind, Enum) and isinstance(value, str):
        try:
            return kind(value)
        except ValueError:
            raise TypeError(repr(value)) from None
    if kind is float and type(value) is int:
        return float(value)
    numbers = {float: np.floating, int: np.integer, bool: np.bool_}
    if (type(value) is kind) if kind in numbers else isinstance(value, kind):
        return value
    if isinstance(value, numbers.get(kind, ())):
        return value
    raise TypeError(type(value).__name__)


def check_shapes(record: object, shapes: Shapes) -> None:
    """Check the shapes of a record's arrays.

    Raises:
        ValueError: naming the field.
    """
    lengths: dict[str, int] = {}
    for name, shape in shapes.items():
        value = getattr(record, name)
        if value is None:
            continue
        if len(value.shape) != len(shape) or any(
            n != (lengths.setdefault(expected, n) if isinstance(expected, str) else expected)
            for n, expected in zip(value.shape, shape, strict=True)
        ):
            raise ValueError(f"no {type(record).__name__}: {name} has the shape {value.shape}")
