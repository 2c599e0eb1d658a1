"""Content of the messages that cameras exchange: records (`tracking.reports`), encoded compactly.

Received data are bounded, and read as the types and shapes of the expected records (`serialization`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from sylpose.landmarks.alignment import LandmarkMatches
from sylpose.landmarks.messages import EvaluationMessage, TermsMessage
from sylpose.relative_pose.camera_evidence import CameraEvidence
from sylpose.relative_pose.terms import TermData
from sylpose.serialization import RecordType, Serializer
from sylpose.tracking.joint_side.joint_state import (
    Anchor,
    JointState,
    KnownFrames,
    MotionModel,
    Nudge,
    ObjectMotion,
    PoseEstimate,
    Refinement,
    SolvedFrame,
)
from sylpose.tracking.joint_side.object_model import ObjectModel
from sylpose.tracking.reports import (
    BoxMotionReport,
    CameraMotionReport,
    CameraObservations,
    CameraTerms,
    InitialMatches,
    InlierStatistics,
    KnownDepthMatches,
    LandmarkAges,
    MovingMatches,
    NewObservations,
    PoseAgreement,
    RelocalizationMatches,
    TrackingReport,
)
from sylpose.tracking.tracker import BufferedRecord, Handover

T = TypeVar("T")

# Longer messages are rejected without decoding, bytes: the matches of an initial motion, 50,000 of them, are the
# largest payload (choice).
MAX_PAYLOAD_BYTES = 4_000_000
# Frame numbers without a frame: at the end of a recording, and while none is available (derived).
NO_FRAME, FRAME_PENDING = -1, -2


@dataclass(frozen=True, eq=False)
class FrameAnnouncement:
    """Announcement of one camera before a frame: members agree on its number, on newcomers and on leaving the group.

    Attributes:
        newest: number of its newest frame, at least the requested one; `NO_FRAME` at the end, `FRAME_PENDING` if none
            is available yet.
        time: timestamp of that frame, seconds; NaN without one.
        newcomers: nodes that it would admit.
        is_outranked: whether it would leave for a larger group.
        has_object: whether it has landmarks by which it could relocalize the object.
    """

    newest: int
    time: float
    newcomers: tuple[int, ...]
    is_outranked: bool
    has_object: bool


# Announcement of a camera that is not a member.
ABSENT = FrameAnnouncement(NO_FRAME, np.nan, (), False, False)
_OBSERVATIONS: dict[str, tuple[int | str, ...]] = {
    "frame": ("n",),
    "landmark": ("n",),
    "image": ("n", 2),
    "landmark_ids": ("m",),
    "positions": ("m", 3),
}
_VIEW: dict[str, tuple[int | str, ...]] = {"rotation": (3, 3), "center": (3,)}
RECORDS = (
    RecordType(TermsMessage, {"upper": (27,)}),
    RecordType(EvaluationMessage),
    RecordType(TrackingReport),
    RecordType(MovingMatches, {"displacement_px": ("n",)}),
    RecordType(InitialMatches),
    RecordType(BoxMotionReport),
    RecordType(LandmarkAges, {"values": ("n",), "counts": ("n",)}),
    RecordType(InlierStatistics),
    RecordType(KnownDepthMatches, {"weights": ("n",)}),
    RecordType(PoseAgreement),
    RecordType(CameraEvidence),
    RecordType(RelocalizationMatches, {"points": ("n", 3), "pixels": ("n", 2)}),
    RecordType(CameraMotionReport, {"rotation": (3,)}),
    RecordType(NewObservations, _OBSERVATIONS),
    RecordType(TermData, {"x": ("n", 2), "y": ("n", 2), **_VIEW}),
    RecordType(
        LandmarkMatches,
        {
            "points": ("n", 3),
            "depth_error": ("n", 3),
            "image": ("n", 2),
            "feature": ("n",),
            "prior_weight": ("n",),
            **_VIEW,
        },
    ),
    RecordType(CameraTerms),
    RecordType(CameraObservations, {**_OBSERVATIONS, "has_moved": ("m",)}),
    RecordType(Handover),
    RecordType(BufferedRecord, {"times": ("n",), "time_offsets": ("n",)}),
    RecordType(JointState),
    RecordType(ObjectModel, {"center": (3,), "points": ("n", 3)}),
    RecordType(
        SolvedFrame,
        {"time_offsets": ("n",), "covariance": (6, 6), "viewpoints": ("n", 3), "is_visible": ("n",), "twist": (6,)},
    ),
    RecordType(Anchor),
    RecordType(MotionModel, {"twist": (6,), "change_variance": (6,)}),
    RecordType(Nudge, {"rotation": (3,)}),
    RecordType(FrameAnnouncement),
    RecordType(KnownFrames),
    RecordType(PoseEstimate, {"covariance": (6, 6)}),
    RecordType(ObjectMotion),
    RecordType(Refinement, {"covariance": (6, 6)}),
)
_SERIALIZER = Serializer(RECORDS)
# Encode a record, a number, an array, or a list or tuple of these; raise TypeError for an unsupported type.
encode = _SERIALIZER.encode


def decode(data: bytes, template: T) -> T:
    """Decode the output of `encode`.

    Args:
        data: the bytes.
        template: a value of the expected structure, types and, for an array, number of columns.

    Raises:
        ValueError: the reason why the bytes are no such value.
    """
    if len(data) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"{len(data)} bytes exceed the largest message")
    return cast(T, _SERIALIZER.decode(data, _type_like(template)))


def _type_like(template: Any) -> Any:
    if type(template) is tuple:
        return tuple[tuple(map(_type_like, template))]  # type: ignore[misc]
    if isinstance(template, np.ndarray):
        return Annotated[NDArray[template.dtype.type], ("n", *template.shape[1:])]
    if not isinstance(template, (bool, int, float, *_SERIALIZER.records)):
        raise TypeError(f"a {type(template).__name__} has no definite type")
    return type(template)


def choose_frame(announcements: Sequence[FrameAnnouncement], wanted: int) -> int:
    """Choose the next frame: the median of the newest frames, among cameras with any from `wanted` on.

    Returns:
        Its number; `FRAME_PENDING` if no camera has one yet, `NO_FRAME` at the end of all.
    """
    newest = sorted(announcement.newest for announcement in announcements if announcement.newest >= wanted)
    if newest:
        return newest[(len(newest) - 1) // 2]
    return FRAME_PENDING if any(announcement.newest == FRAME_PENDING for announcement in announcements) else NO_FRAME


def find_common_newcomers(announcements: Sequence[FrameAnnouncement]) -> frozenset[int]:
    """Return the newcomers that all members would admit."""
    return frozenset.intersection(*(frozenset(announcement.newcomers) for announcement in announcements))
