"""Binary encoding of the records (`tracking.reports`) that cameras exchange.

The format is MessagePack: a record is its index in `RECORDS` with its fields in order, an array is losslessly
compressed (`network.arrays`). Received data is bounded and validated against the field types before use, and cannot
name a function.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, cast

import msgspec
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.record_validation import Shapes, check_shapes, convert_to_type, get_fields
from sylpose.landmarks.alignment import LandmarkMatches
from sylpose.landmarks.messages import EvaluationMessage, TermsMessage
from sylpose.network.arrays import decode_array, encode_array
from sylpose.network.frame_announcement import FrameAnnouncement
from sylpose.relative_pose.terms import TermData
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.joint_state import JointState, Nudge
from sylpose.tracking.klt_frontend import Anchor
from sylpose.tracking.motion_model import VelocityModel
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.reports import (
    BoxMotionReport,
    CameraMotionReport,
    CameraObservations,
    InlierStatistics,
    KnownDepthMatches,
    LandmarkAges,
    MovingMatches,
    NewObservations,
    PoseAgreement,
    RelocalizationMatches,
    TrackingReport,
)
from sylpose.tracking.state_transfer import BufferedRecord, Handover

__all__ = ["MAX_PAYLOAD_BYTES", "RECORDS", "decode", "encode"]

T = TypeVar("T")

# Longer messages are rejected without decoding, bytes: the matches of an initial motion, 50,000 of them, are the
# largest payload (choice).
MAX_PAYLOAD_BYTES = 4_000_000
# Upper bound of the numbers in a pose (choice).
MAX_POSE_NUMBER = 1e30
# Record types and the shapes of their arrays. The order is part of the wire format: append new types at the end.
SHAPES: dict[type[Any], Shapes] = {
    TermsMessage: {"upper": (27,)},
    EvaluationMessage: {},
    TrackingReport: {},
    MovingMatches: {"displacement_px": ("n",)},
    BoxMotionReport: {},
    LandmarkAges: {"values": ("n",), "counts": ("n",)},
    InlierStatistics: {},
    KnownDepthMatches: {"weights": ("n",)},
    PoseAgreement: {},
    RelocalizationMatches: {"points": ("n", 3), "pixels": ("n", 2)},
    CameraMotionReport: {"rotation": (3,)},
    NewObservations: {
        "frame": ("n",),
        "landmark": ("n",),
        "image": ("n", 2),
        "landmark_ids": ("m",),
        "positions": ("m", 3),
    },
    TermData: {"x": ("n", 2), "y": ("n", 2), "rotation": (3, 3), "center": (3,)},
    LandmarkMatches: {
        "points": ("n", 3),
        "depth_error": ("n", 3),
        "image": ("n", 2),
        "feature": ("n",),
        "prior_weight": ("n",),
        "rotation": (3, 3),
        "center": (3,),
    },
    CameraObservations: {
        "frame": ("n",),
        "landmark": ("n",),
        "image": ("n", 2),
        "landmark_ids": ("m",),
        "positions": ("m", 3),
        "has_moved": ("m",),
    },
    Handover: {},
    BufferedRecord: {"times": ("n",), "time_offsets": ("n",)},
    JointState: {"refined_covariance": (6, 6)},
    ObjectModel: {"center": (3,), "points": ("n", 3)},
    SolvedFrame: {"time_offsets": ("n",), "covariance": (6, 6), "viewpoints": ("n", 3), "is_visible": ("n",)},
    Anchor: {},
    VelocityModel: {"twist": (6,), "change_variance": (6,)},
    Nudge: {"rotation": (3,)},
    FrameAnnouncement: {},
}
RECORDS = tuple(SHAPES)
# Codes of MessagePack extension types; records use their index in `RECORDS` (choice).
_POSE, _ARRAYS = 100, 101


def encode(value: object) -> bytes:
    """Encode a record, number, array, or a list or tuple of these.

    Raises:
        TypeError: an unsupported type.
    """
    return msgspec.msgpack.encode(_to_plain(value))


def decode(data: bytes, template: T) -> T:
    """Decode the output of `encode`.

    Args:
        data: the bytes.
        template: a value of the expected structure and types.

    Raises:
        ValueError: the reason why the bytes are no such value.
    """
    if len(data) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"{len(data)} bytes exceed the largest message")
    try:
        value = msgspec.msgpack.decode(data, ext_hook=_decode_extension)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"not a message: {error}") from None
    return cast(T, _check_like(value, template))


def _to_plain(value: Any) -> Any:
    if is_dataclass(value) and type(value) in RECORDS:
        content = [_to_plain(getattr(value, field.name)) for field in fields(value)]
        return msgspec.msgpack.Ext(RECORDS.index(type(value)), msgspec.msgpack.encode(content))
    if isinstance(value, np.ndarray) and value.dtype.kind == "b":
        return _to_plain(value.astype(np.int64))
    if isinstance(value, np.ndarray):
        return msgspec.msgpack.Ext(_ARRAYS, encode_array(value))
    if isinstance(value, RigidTransform):
        numbers = np.concatenate([value.rotation.as_quat(), value.translation])
        return msgspec.msgpack.Ext(_POSE, numbers.astype("<f8").tobytes())
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (list, tuple)):
        return [_to_plain(part) for part in value]
    if value is None or isinstance(value, (bool, int, float)):
        return value
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _decode_extension(code: int, content: memoryview) -> Any:
    data = bytes(content)
    if code == _ARRAYS:
        return decode_array(data)
    if code == _POSE:
        numbers = np.frombuffer(data, "<f8") if len(data) == 56 else np.full(7, np.nan)
        # The largest component of a unit quaternion is at least one half.
        if not (np.abs(numbers) < MAX_POSE_NUMBER).all() or not 0.4 < np.abs(numbers[:4]).max() < 1.1:
            raise ValueError("not a pose")
        return RigidTransform.from_components(numbers[4:], Rotation.from_quat(numbers[:4]))
    if not 0 <= code < len(RECORDS):
        raise ValueError(f"no record has the number {code}")
    try:
        field_values = msgspec.msgpack.decode(data, ext_hook=_decode_extension)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"not a record: {error}") from None
    kind = RECORDS[code]
    hints = get_fields(kind)
    if not isinstance(field_values, list) or len(field_values) != len(hints):
        raise ValueError(f"not a {kind.__name__}: {len(hints)} fields were expected")
    record = kind(*(_check_field(kind, name, hint, v) for (name, hint), v in zip(hints, field_values, strict=True)))
    check_shapes(record, SHAPES[kind])
    return record


def _check_field(kind: type[Any], name: str, hint: Any, value: Any) -> Any:
    """Return a field's value if it has the field's type."""
    try:
        return convert_to_type(hint, value)
    except TypeError:
        problem = "is missing" if value is None else f"is a {type(value).__name__}"
        raise ValueError(f"not a {kind.__name__}: {name} {problem}") from None


def _check_like(value: Any, template: Any) -> Any:
    """Validate a decoded value against the structure and types of `template`."""
    if isinstance(template, tuple):
        if not isinstance(value, list) or len(value) != len(template):
            raise ValueError(f"{len(template)} values were expected")
        return tuple(_check_like(a, b) for a, b in zip(value, template, strict=True))
    if isinstance(template, np.ndarray):
        if not isinstance(value, np.ndarray) or value.ndim != template.ndim or value.dtype != template.dtype:
            raise ValueError(f"an array of {template.ndim} dimensions of {template.dtype} was expected")
        if value.ndim == 2 and value.shape[1] != template.shape[1]:
            raise ValueError(f"an array of {template.shape[1]} columns was expected")
        return value
    if isinstance(template, list):
        if not isinstance(value, list) or not all(type(part) in RECORDS for part in value):
            raise ValueError("a list of records was expected")
        return value
    kind = type(template)
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise ValueError(f"a {kind.__name__} was expected, not a {type(value).__name__}")
    return value
