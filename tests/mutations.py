"""Wrong and extreme arguments, made from valid ones (`test_arguments.py`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

__all__ = ["copy_arrays", "is_unchanged", "mutations"]

NUMBERS: tuple[Any, ...] = (
    *(-1, 0, 1, 2.5, -0.0, np.nan, np.inf, -np.inf, 1e300, -1e300, 1e-300, 5e-324, 10**400, 2**63, True, False),
    *(1j, "word", b"bytes", [], [1.0, 2.0], np.float64(0.1), np.array(2.0), np.ones(2)),
)
ANYTHING: tuple[Any, ...] = (
    None,
    3,
    0.5,
    np.nan,
    "word",
    "",
    "x" * 1000,
    "a\nb",
    b"bytes",
    [],
    {},
    [None],
    object(),
    int,
    np.ones((2, 2)),
)


def mutations(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the values that a value may be mistaken for, by name."""
    for k, other in enumerate(ANYTHING):
        yield f"anything {k}", other
    if isinstance(value, np.ndarray):
        yield from _arrays(value)
    elif isinstance(value, (bool, int, float, np.generic)):
        for k, other in enumerate(NUMBERS):
            yield f"number {k}", other
    elif isinstance(value, (list, tuple)):
        kind = type(value) if type(value) in (list, tuple) else list
        yield "fewer", kind(value[:-1])
        yield "more", kind([*value, *value[-1:]])
        yield "an iterator", iter(list(value))
        for k in range(min(len(value), 2)):
            for name, part in mutations(value[k]):
                yield f"[{k}]: {name}", kind([*value[:k], part, *value[k + 1 :]])
    elif isinstance(value, Mapping):
        for key in list(value)[:1]:
            for name, part in mutations(value[key]):
                yield f"[{key}]: {name}", {**value, key: part}
        yield "unknown key", {**value, "nobody": next(iter(value.values()), 0)}
    elif is_dataclass(value) and not isinstance(value, type):
        yield from _records(value)


def _records(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield records with other contents, as far as they can be made."""
    for field in fields(value):
        if field.init:
            for name, part in mutations(getattr(value, field.name)):
                with suppress(ValueError, TypeError):
                    yield f"{field.name}: {name}", replace(value, **{field.name: part})
    if {"x", "y"} <= {field.name for field in fields(value)}:
        for factor in (0.0, 1e-300, 1e-155, 1e-40, 1e-9, 1e3, 1e6, 1e8):
            with suppress(ValueError, TypeError):
                yield f"x and y times {factor}", replace(value, x=value.x * factor, y=value.y * factor)


def _arrays(a: np.ndarray[Any, Any]) -> Iterator[tuple[str, Any]]:
    yield "extra axis", a[None]
    yield "extra last axis", a[..., None]
    yield "no axis", a.ravel()
    yield "empty", a[:0]
    yield "list", a.tolist()
    yield "read only", _read_only(a)
    yield "reversed", a[::-1]
    yield "not contiguous", np.repeat(a, 2, axis=-1)[..., ::2] if a.ndim else a
    yield "Fortran's order", np.asfortranarray(a)
    yield "big endian", a.astype(a.dtype.newbyteorder(">"))
    for kind in (object, str, complex, bool, int, np.float16, np.float32, "datetime64[s]", "S8"):
        with np.errstate(all="ignore"):
            yield f"as {kind}", a.astype(np.int64).astype(kind) if kind == "datetime64[s]" else a.astype(kind)
    if a.ndim >= 1 and a.size:
        yield "fewer rows", a[:-1]
        yield "more rows", np.concatenate([a, a[-1:]])
        yield "fewer columns", a[..., :-1]
        yield "homogeneous", np.concatenate([a, np.ones((*a.shape[:-1], 1))], axis=-1)
        yield "one row", a[0]
        yield "ragged", [a[0].tolist(), [1.0]] if a.ndim > 1 else [1.0, [1.0]]
    if a.ndim >= 2 and a.size:
        yield "transposed", a.swapaxes(-1, -2)
        yield "repeated", np.broadcast_to(a[:1], a.shape)
    for number in (0.0, -1.0, 1.0, np.nan, np.inf, -np.inf, 1e300, -1e300, 1e155, 1e40, 1e-40, 1e-155, 1e-300, 5e-324):
        yield f"all {number}", np.full(a.shape, number)
        if a.size:
            with np.errstate(over="ignore", invalid="ignore"):
                yield f"times {number}", a * number
            one = np.array(a, dtype=float)
            one.flat[a.size // 2] = number
            yield f"one {number}", one


def _read_only(a: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    out = a.copy()
    out.setflags(write=False)
    return out


def copy_arrays(value: Any) -> Any:
    """Return a copy of arrays and of lists of arrays."""
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, (list, tuple)):
        return [copy_arrays(part) for part in value]
    return value


def is_unchanged(a: Any, b: Any) -> bool:
    """Return whether a value still equals its copy."""
    if isinstance(a, np.ndarray):
        return bool(a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes())
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(is_unchanged(x, y) for x, y in zip(a, b, strict=True))
    return True
