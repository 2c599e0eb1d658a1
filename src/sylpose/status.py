"""Statuses of estimates and tracked frames, each with one explanatory sentence."""

from __future__ import annotations

from enum import Enum
from typing import Self

# Values in result files of earlier versions, and the present ones.
_LEGACY_VALUES = {
    "turn not observable": "rotation not observable",
    "mostly still": "mostly static",
    "only background": "background only",
    "found": "localized",
    "length not observable": "translation scale not observable",
}


class _Described(Enum):
    """Value of a result that one sentence explains."""

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        """Accept the values of earlier versions, which result files may contain."""
        return next((member for member in cls if member.value == _LEGACY_VALUES.get(str(value))), None)

    @property
    def text(self) -> str:
        """One sentence that explains the value."""
        return _TEXTS[self]


class Status(_Described):
    """Outcome of an estimator. `status.text` explains it in one sentence."""

    OK = "ok"
    TOO_FEW_MATCHES = "too few matches"
    SCALE_NOT_OBSERVABLE = "scale not observable"
    ROTATION_NOT_OBSERVABLE = "rotation not observable"
    NO_MOTION = "no motion"
    NOT_CERTIFIED = "not certified"
    NOT_CONVERGED = "not converged"
    NOT_CONSISTENT = "no consistent motion"
    AMBIGUOUS = "ambiguous"
    MIXED = "more than one motion"
    MOSTLY_STATIC = "mostly static"

    @property
    def has_pose(self) -> bool:
        """Whether a result with this status has a usable estimate."""
        return self in (Status.OK, Status.SCALE_NOT_OBSERVABLE, Status.NO_MOTION, Status.NOT_CERTIFIED)


class FrameStatus(_Described):
    """Outcome of a frame in the tracker. `status.text` explains it in one sentence."""

    FIRST = "first frame"
    TRACKED = "tracked"
    RELOCALIZED = "relocalised"
    COASTING = "coasting"
    INTERPOLATED = "interpolated"
    UNCERTAIN = "uncertain"
    CONTRADICTED = "contradicted"
    AMBIGUOUS = "ambiguous"
    LOST = "lost"
    TOO_FEW_MATCHES = "too few matches"
    NO_MOTION = "no motion"
    NOT_CONSISTENT = "no consistent motion"
    BACKGROUND_ONLY = "background only"
    LOCALIZED = "localized"
    ROTATION_NOT_OBSERVABLE = "rotation not observable"
    NO_CONSISTENT_POSE = "no consistent pose"

    @property
    def has_pose(self) -> bool:
        """Whether a frame of this status has a pose."""
        located = FrameStatus.FIRST, FrameStatus.TRACKED, FrameStatus.RELOCALIZED, FrameStatus.LOCALIZED
        return self in (*located, *PREDICTED, *DOUBTFUL)


# Statuses of frames with a pose that no match determines.
PREDICTED = (FrameStatus.COASTING, FrameStatus.INTERPOLATED)
# Statuses of frames whose pose is not to be relied on, although the object was found.
DOUBTFUL = (FrameStatus.UNCERTAIN, FrameStatus.CONTRADICTED, FrameStatus.AMBIGUOUS)


class Observability(_Described):
    """Which part of a frame's pose is observable. `text` explains it in one sentence."""

    ALL = "all"
    NO_SCALE = "scale not observable"
    NO_TRANSLATION_SCALE = "translation scale not observable"


_TEXTS: dict[_Described, str] = {
    Status.OK: "The estimate converged and every requested quantity is observable.",
    Status.TOO_FEW_MATCHES: "Too few matches on the object in all cameras together.",
    Status.SCALE_NOT_OBSERVABLE: "Rotation and translation direction are estimated; the translation's length is not "
    "observable (one camera, or a translation without rotation).",
    Status.ROTATION_NOT_OBSERVABLE: "Part of the rotation is not observable from these cameras.",
    Status.NO_MOTION: "The object did not move measurably: its matches are static in every camera.",
    Status.NOT_CERTIFIED: "The best solution found; its global optimality is not proved.",
    Status.NOT_CONVERGED: "The solver did not converge within its iteration limit.",
    Status.NOT_CONSISTENT: "No single rigid motion explains enough of the matches, or the cameras contradict it.",
    Status.AMBIGUOUS: "Two motions explain the matches about equally well, or about as many matches each; the data do "
    "not decide which is the object's.",
    Status.MIXED: "One motion nearly explains the matches, with residuals that are alike among neighbors: two bodies "
    "move, or a camera is miscalibrated.",
    Status.MOSTLY_STATIC: "Most matches are static; the moving ones are too few, or move too little, to identify the "
    "object.",
    FrameStatus.FIRST: "The first frame with the object: all other poses are relative to it.",
    FrameStatus.TRACKED: "The object was tracked from the previous frame.",
    FrameStatus.RELOCALIZED: "The object was found again by its landmarks, or by its shape.",
    FrameStatus.COASTING: "The object was not found; its pose is predicted from its last motion, with growing "
    "uncertainty.",
    FrameStatus.INTERPOLATED: "The object was not found; the refinement of the whole recording interpolates its pose "
    "between the measured ones before and after.",
    FrameStatus.UNCERTAIN: "The observations hardly constrain the rotation: very different poses fit as well.",
    FrameStatus.CONTRADICTED: "The cameras contradict each other: no single motion explains the images of all of them, or "
    "the frame contradicts the rest of the recording.",
    FrameStatus.AMBIGUOUS: "Several bodies move at the same time, and which of them is the object is not known: the pose "
    "is that of the one with the most matches.",
    FrameStatus.LOST: "The object was not found, for too long to predict its pose or after a pose that is unreliable.",
    FrameStatus.TOO_FEW_MATCHES: "Too few features on the object in all cameras together to start.",
    FrameStatus.NO_MOTION: "Nothing has moved yet that could be the object: its pose is unknown.",
    FrameStatus.BACKGROUND_ONLY: "Everything observed is static and never moved: it may be background. What moved "
    "before is not visible, so the object's pose is unknown.",
    FrameStatus.LOCALIZED: "The pose was estimated from this frame alone, by known points on the object or by its shape.",
    FrameStatus.ROTATION_NOT_OBSERVABLE: "The rotation is not observable: other rotations explain the observations as "
    "well.",
    FrameStatus.NO_CONSISTENT_POSE: "No single pose explains enough of the observations.",
    FrameStatus.NOT_CONSISTENT: "Nothing could be followed as one rigid body for long enough: the pose is unknown.",
    Observability.ALL: "The whole pose is observable.",
    Observability.NO_TRANSLATION_SCALE: "The observations do not determine the length of the translation: it rests on "
    "the assumed distance and shape of the object, until the object rotates.",
    Observability.NO_SCALE: "With one camera, lengths are in units of the object's initial distance.",
}
