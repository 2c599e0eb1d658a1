"""Records of numbers as bytes, and back: what cameras tell each other (`tracking.records`) on a wire.

MessagePack; a record is its number in `RECORDS` and its fields in order, an array its little-endian numbers, of a table
after how many columns it has.
What arrives is bounded and checked against the types of the fields before any of it is used, and nothing in it can name a
function: it is data.
"""

from __future__ import annotations

import struct
from dataclasses import fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, TypeVar, cast, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.landmarks.alignment import Sights
from sylpose.landmarks.told import Has, Judges, Says
from sylpose.tracking.records import Ages, Agreed, Chance, Following, Known, Middle, Moved, Recognised, Stance
from sylpose.tracking.window import Seen
from sylpose.two_frames.terms import TermData

__all__ = ["LARGEST", "RECORDS", "packed", "unpacked"]

T = TypeVar("T")

# A longer message is refused unread, bytes: the matches of a first motion are the most that is ever sent, 50,000 of them;
# and tables that have more columns (choice).
LARGEST, MOST_COLUMNS = 4_000_000, 6
# What may be sent, and the shapes of its arrays, a letter being the same number in all of a record. The order is the wire's:
# new ones go to the end.
SHAPES: dict[type[Any], dict[str, tuple[int | str, ...]]] = {
    Has: {},
    Says: {"upper": (27,)},
    Judges: {},
    Following: {},
    Moved: {"shift_px": ("n",)},
    Middle: {},
    Ages: {"values": ("n",), "counts": ("n",)},
    Chance: {},
    Known: {"weights": ("n",)},
    Agreed: {},
    Recognised: {"points": ("n", 3), "pixels": ("n", 2)},
    Stance: {"turn": (3,)},
    Seen: {"frame": ("n",), "landmark": ("n",), "image": ("n", 2), "known": ("m",), "place": ("m", 3)},
    TermData: {"x": ("n", 2), "y": ("n", 2), "rotation": (3, 3), "center": (3,)},
    Sights: {
        "points": ("n", 3),
        "depth_error": ("n", 3),
        "image": ("n", 2),
        "feature": ("n",),
        "trust": ("n",),
        "rotation": (3, 3),
        "center": (3,),
    },
}
RECORDS = tuple(SHAPES)
# Codes of MessagePack's extension types: records have their number in `RECORDS` (choice).
_POSE, _ARRAYS = 100, 101
_DTYPES = {"f": np.dtype("<f8"), "i": np.dtype("<i8")}
_KINDS = [(kind, dimensions) for kind in _DTYPES for dimensions in (1, 2)]
_COLUMNS = struct.Struct("<I")


def packed(told: object) -> bytes:
    """A record, a number, an array, or a list or tuple of these.

    Raises:
        TypeError: something else.
    """
    return msgspec.msgpack.encode(_plain(told))


def unpacked(data: bytes, nothing: T) -> T:
    """The inverse of `packed`, of the same kind as `nothing` is.

    Raises:
        ValueError: why these bytes are no such thing.
    """
    if len(data) > LARGEST:
        raise ValueError(f"{len(data)} bytes are more than any message has")
    try:
        told = msgspec.msgpack.decode(data, ext_hook=_extension)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"no message: {error}") from None
    return cast(T, _like(told, nothing))


def _plain(value: Any) -> Any:
    if is_dataclass(value) and type(value) in RECORDS:
        content = [_plain(getattr(value, field.name)) for field in fields(value)]
        return msgspec.msgpack.Ext(RECORDS.index(type(value)), msgspec.msgpack.encode(content))
    if isinstance(value, np.ndarray):
        kind = (value.dtype.kind, value.ndim)
        if kind not in _KINDS:
            raise TypeError(f"an array of {value.ndim} dimensions of {value.dtype} is not sent")
        columns = _COLUMNS.pack(value.shape[1]) if value.ndim == 2 else b""
        code = _ARRAYS + _KINDS.index(kind)
        return msgspec.msgpack.Ext(code, columns + value.astype(_DTYPES[kind[0]]).tobytes())
    if isinstance(value, RigidTransform):
        numbers = np.concatenate([value.rotation.as_quat(), value.translation])
        return msgspec.msgpack.Ext(_POSE, numbers.astype("<f8").tobytes())
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if value is None or isinstance(value, (bool, int, float)):
        return value
    raise TypeError(f"{type(value).__name__} is not sent")


def _extension(code: int, content: memoryview) -> Any:
    data = bytes(content)
    if _ARRAYS <= code < _ARRAYS + len(_KINDS):
        return _array(data, *_KINDS[code - _ARRAYS])
    if code == _POSE:
        numbers = np.frombuffer(data, "<f8") if len(data) == 56 else np.full(7, np.nan)
        if not np.isfinite(numbers).all() or not np.linalg.norm(numbers[:4]) > 0:
            raise ValueError("no pose")
        return RigidTransform.from_components(numbers[4:], Rotation.from_quat(numbers[:4]))
    if not 0 <= code < len(RECORDS):
        raise ValueError(f"no record has the number {code}")
    try:
        content_of = msgspec.msgpack.decode(data, ext_hook=_extension)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"no record: {error}") from None
    kind, hints = RECORDS[code], _hints(code)
    if not isinstance(content_of, list) or len(content_of) != len(hints):
        raise ValueError(f"no {kind.__name__}: it has {len(hints)} fields")
    record = kind(*(_checked(kind, name, hint, v) for (name, hint), v in zip(hints, content_of, strict=True)))
    lengths: dict[str, int] = {}
    for name, shape in SHAPES[kind].items():
        got = getattr(record, name).shape
        if len(got) != len(shape) or any(
            n != (lengths.setdefault(wanted, n) if isinstance(wanted, str) else wanted)
            for n, wanted in zip(got, shape, strict=True)
        ):
            raise ValueError(f"no {kind.__name__}: {name} has the shape {got}")
    return record


def _array(data: bytes, kind: str, dimensions: int) -> np.ndarray[Any, Any]:
    at, columns = 0, 1
    if dimensions == 2:
        if len(data) < _COLUMNS.size:
            raise ValueError("no array: too short")
        at, columns = _COLUMNS.size, _COLUMNS.unpack_from(data)[0]
    if (len(data) - at) % 8 or not 0 < columns <= MOST_COLUMNS or (len(data) - at) // 8 % columns:
        raise ValueError("no array: its shape is not that of its numbers")
    out = np.frombuffer(data, _DTYPES[kind], offset=at).astype(_DTYPES[kind].newbyteorder("="))
    return out.reshape(-1, columns) if dimensions == 2 else out


@cache
def _hints(number: int) -> list[tuple[str, Any]]:
    """The fields of a record in order, and their types."""
    hints = get_type_hints(RECORDS[number])
    return [(field.name, hints[field.name]) for field in fields(RECORDS[number])]


def _checked(kind: type[Any], name: str, hint: Any, value: Any) -> Any:
    """The value of a field, if it is of its type."""
    good = _typed(hint, value)
    if good is None and value is not None:
        raise ValueError(f"no {kind.__name__}: {name} is a {type(value).__name__}")
    if value is None and NoneType not in get_args(hint):
        raise ValueError(f"no {kind.__name__}: {name} is missing")
    return good


def _typed(hint: Any, value: Any) -> Any:
    """The value as its type has it; None where it is of another."""
    origin = get_origin(hint)
    if origin is UnionType:
        found = (_typed(part, value) for part in get_args(hint) if part is not NoneType)
        return next((one for one in found if one is not None), None)
    if origin is tuple:
        if not isinstance(value, list):
            return None
        parts = [_typed(get_args(hint)[0], part) for part in value]
        return None if any(part is None for part in parts) else tuple(parts)
    if origin is np.ndarray:
        whole = issubclass(get_args(get_args(hint)[1])[0], np.integer)
        return value if isinstance(value, np.ndarray) and (value.dtype.kind == "i") == whole else None
    if hint is float:
        return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None
    return value if type(value) is hint else None


def _like(told: Any, nothing: Any) -> Any:
    """What was told, if it is of the kind of another thing."""
    if isinstance(nothing, tuple):
        if not isinstance(told, list) or len(told) != len(nothing):
            raise ValueError(f"{len(nothing)} values were expected")
        return tuple(_like(a, b) for a, b in zip(told, nothing, strict=True))
    if isinstance(nothing, np.ndarray):
        if not isinstance(told, np.ndarray) or told.ndim != nothing.ndim or told.dtype != nothing.dtype:
            raise ValueError(f"an array of {nothing.ndim} dimensions of {nothing.dtype} was expected")
        if told.ndim == 2 and told.shape[1] != nothing.shape[1]:
            raise ValueError(f"an array of {nothing.shape[1]} columns was expected")
        return told
    if isinstance(nothing, list):
        if not isinstance(told, list) or not all(type(part) in RECORDS for part in told):
            raise ValueError("a list of records was expected")
        return told
    kind = type(nothing)
    if kind is float and type(told) is int:
        return float(told)
    if type(told) is not kind:
        raise ValueError(f"a {kind.__name__} was expected, not a {type(told).__name__}")
    return told
