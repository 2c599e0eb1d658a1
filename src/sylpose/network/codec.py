"""Records of numbers as bytes, and back: what cameras tell each other (`tracking.reports`) on a wire.

MessagePack; a record is its number in `RECORDS` and its fields in order, an array its numbers in as few bytes as keep
them all (`network.arrays`).
What arrives is bounded and checked against the types of the fields before any of it is used, and nothing in it can name a
function: it is data.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, cast

import msgspec
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.record_validation import Shapes, check_shapes, fields_of, typed
from sylpose.landmarks.alignment import Sights
from sylpose.landmarks.messages import Judges, Says
from sylpose.network.arrays import array_packed, array_unpacked
from sylpose.network.frame_announcement import Roll
from sylpose.relative_pose.terms import TermData
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.joint_state import Joint, Nudge
from sylpose.tracking.klt_frontend import Anchor
from sylpose.tracking.motion_model import Velocity
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.reports import (
    Ages,
    Agreed,
    Chance,
    Following,
    Known,
    Middle,
    Moved,
    Recognised,
    Seen,
    Sighted,
    Stance,
)
from sylpose.tracking.state_transfer import Handover, Waited

__all__ = ["LARGEST", "RECORDS", "packed", "unpacked"]

T = TypeVar("T")

# A longer message is refused unread, bytes: the matches of a first motion are the most that is ever sent, 50,000 of
# them (choice).
LARGEST = 4_000_000
# No number of a pose comes near it (choice).
LARGEST_NUMBER = 1e30
# What may be sent, and the shapes of its arrays. The order is the wire's: new ones go to the end.
SHAPES: dict[type[Any], Shapes] = {
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
    Sighted: {
        "frame": ("n",),
        "landmark": ("n",),
        "image": ("n", 2),
        "known": ("m",),
        "place": ("m", 3),
        "moved": ("m",),
    },
    Handover: {},
    Waited: {"times": ("n",), "late": ("n",)},
    Joint: {"refined": (6, 6)},
    ObjectModel: {"center": (3,), "points": ("n", 3)},
    SolvedFrame: {"late": ("n",), "covariance": (6, 6), "viewpoints": ("n", 3), "sees": ("n",)},
    Anchor: {},
    Velocity: {"twist": (6,), "unsteady": (6,)},
    Nudge: {"turn": (3,)},
    Roll: {},
}
RECORDS = tuple(SHAPES)
# Codes of MessagePack's extension types: records have their number in `RECORDS` (choice).
_POSE, _ARRAYS = 100, 101


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
    if isinstance(value, np.ndarray) and value.dtype.kind == "b":
        return _plain(value.astype(np.int64))
    if isinstance(value, np.ndarray):
        return msgspec.msgpack.Ext(_ARRAYS, array_packed(value))
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
    if code == _ARRAYS:
        return array_unpacked(data)
    if code == _POSE:
        numbers = np.frombuffer(data, "<f8") if len(data) == 56 else np.full(7, np.nan)
        # The largest part of a unit quaternion is half at least.
        if not (np.abs(numbers) < LARGEST_NUMBER).all() or not 0.4 < np.abs(numbers[:4]).max() < 1.1:
            raise ValueError("no pose")
        return RigidTransform.from_components(numbers[4:], Rotation.from_quat(numbers[:4]))
    if not 0 <= code < len(RECORDS):
        raise ValueError(f"no record has the number {code}")
    try:
        content_of = msgspec.msgpack.decode(data, ext_hook=_extension)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"no record: {error}") from None
    kind = RECORDS[code]
    hints = fields_of(kind)
    if not isinstance(content_of, list) or len(content_of) != len(hints):
        raise ValueError(f"no {kind.__name__}: it has {len(hints)} fields")
    record = kind(*(_checked(kind, name, hint, v) for (name, hint), v in zip(hints, content_of, strict=True)))
    check_shapes(record, SHAPES[kind])
    return record


def _checked(kind: type[Any], name: str, hint: Any, value: Any) -> Any:
    """The value of a field, if it is of its type."""
    try:
        return typed(hint, value)
    except TypeError:
        what = "is missing" if value is None else f"is a {type(value).__name__}"
        raise ValueError(f"no {kind.__name__}: {name} {what}") from None


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
