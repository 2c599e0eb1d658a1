"""Values from elsewhere, checked against what records say of their fields: types, and shapes of arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

__all__ = ["Shapes", "check_shapes", "fields_of", "typed"]

# By field, a letter being the same number in all of a record.
Shapes = Mapping[str, tuple[int | str, ...]]


def fields_of(kind: Any) -> tuple[tuple[str, Any], ...]:
    """The fields of a dataclass or named tuple in order, those that are no arguments left out, and their types."""
    return _fields_of(kind)


@cache
def _fields_of(kind: Any) -> tuple[tuple[str, Any], ...]:
    hints = get_type_hints(kind)
    names = [field.name for field in fields(kind) if field.init] if is_dataclass(kind) else list(kind._fields)
    return tuple((name, hints[name]) for name in names)


def typed(hint: Any, value: Any) -> Any:
    """The value as a field's type has it: words become enumerations, whole numbers floats, lists tuples; of arrays the
    kind of their numbers counts, and 0 and 1 do for False and True. Types that are no data's are compared as they are.

    Raises:
        TypeError: it is of another type.
    """
    hint = _spelt_out(hint)
    origin, of = get_origin(hint), get_args(hint)
    if origin in (UnionType, Union):
        for part in of:
            try:
                return typed(part, value)
            except TypeError:
                continue
    elif origin is tuple and isinstance(value, (list, tuple)):
        if len(of) == 2 and of[1] is Ellipsis:
            return tuple(typed(of[0], part) for part in value)
        if len(value) == len(of):
            return tuple(typed(part, its) for part, its in zip(of, value, strict=True))
    elif origin in (list, Sequence) and isinstance(value, (list, tuple)):
        return type(value)(typed(of[0], part) for part in value)
    elif origin in (dict, Mapping) and isinstance(value, dict):
        return {typed(of[0], key): typed(of[1], its) for key, its in value.items()}
    elif origin is np.ndarray and isinstance(value, np.ndarray):
        wanted = np.dtype(get_args(of[1])[0]).kind
        if value.dtype.kind in {"b": "bi", "i": "iu"}.get(wanted, wanted):
            return value.astype(bool) if wanted == "b" and value.dtype.kind != "b" else value
    elif origin is Literal:
        if value in of:
            return value
    elif hint is None or hint is NoneType:
        if value is None:
            return value
    elif origin is None and isinstance(hint, type):
        return _plain(hint, value)
    elif isinstance(origin, type) and isinstance(value, origin):
        return value
    raise TypeError(type(value).__name__)


def _spelt_out(hint: Any) -> Any:
    """What an alias by `type` stands for, as NumPy's NDArray is one from 2.5 on; other types as they are."""
    meant = getattr(get_origin(hint) or hint, "__value__", None)
    if meant is None:
        return hint
    return meant[get_args(hint)] if get_args(hint) else meant


def _plain(kind: type[Any], value: Any) -> Any:
    """As `typed`, of a class without parameters."""
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
    """Raises ValueError, naming a field, where an array has another shape than it is to have."""
    lengths: dict[str, int] = {}
    for name, shape in shapes.items():
        value = getattr(record, name)
        if value is None:
            continue
        if len(value.shape) != len(shape) or any(
            n != (lengths.setdefault(wanted, n) if isinstance(wanted, str) else wanted)
            for n, wanted in zip(value.shape, shape, strict=True)
        ):
            raise ValueError(f"no {type(record).__name__}: {name} has the shape {value.shape}")
