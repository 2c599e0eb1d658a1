"""What an estimator and the tracker say about their answers, each with a sentence for people."""

from __future__ import annotations

from enum import Enum

__all__ = ["FrameStatus", "Observable", "Status"]


class Status(Enum):
    """What an estimator says about its own answer. `status.text` is a sentence for people."""

    OK = "ok"
    TOO_FEW_MATCHES = "too few matches"
    SCALE_NOT_OBSERVABLE = "scale not observable"
    TURN_NOT_OBSERVABLE = "turn not observable"
    NO_MOTION = "no motion"
    NOT_CERTIFIED = "not certified"
    NOT_CONVERGED = "not converged"
    NOT_CONSISTENT = "no consistent motion"
    AMBIGUOUS = "ambiguous"
    MIXED = "more than one motion"
    MOSTLY_STILL = "mostly still"

    @property
    def text(self) -> str:
        """One sentence that says what the status means."""
        return _TEXTS[self]

    @property
    def has_pose(self) -> bool:
        """Whether a result of this status carries an answer that may be used."""
        return self in (Status.OK, Status.SCALE_NOT_OBSERVABLE, Status.NO_MOTION, Status.NOT_CERTIFIED)


_TEXTS = {
    Status.OK: "Everything that was asked for was found.",
    Status.TOO_FEW_MATCHES: "Too few matches on the object in all cameras together.",
    Status.SCALE_NOT_OBSERVABLE: "The turn and the translation's direction were found; how far it moved cannot be seen "
    "(one camera, or a translation without a turn).",
    Status.TURN_NOT_OBSERVABLE: "A part of the turn cannot be seen from these cameras.",
    Status.NO_MOTION: "The object did not move measurably: its matches stand still in every camera.",
    Status.NOT_CERTIFIED: "The best of all solutions that were found; that there is no better one is not proved.",
    Status.NOT_CONVERGED: "The solver did not settle within its bound of iterations.",
    Status.NOT_CONSISTENT: "No single rigid motion explains enough of the matches.",
    Status.AMBIGUOUS: "Two motions explain the matches about equally well, or about as many of them each, and which of them "
    "is the object's cannot be seen.",
    Status.MIXED: "One motion explains the matches nearly, and neighbours depart from it alike: two bodies move, or a "
    "camera is calibrated wrongly.",
    Status.MOSTLY_STILL: "Most matches stand still, and some move, by too little or too few to tell which are the object's.",
}


class FrameStatus(Enum):
    """What happened to a frame in the tracker. `status.text` is a sentence for people."""

    FIRST = "first frame"
    TRACKED = "tracked"
    RELOCALISED = "relocalised"
    COASTING = "coasting"
    UNCERTAIN = "uncertain"
    LOST = "lost"
    TOO_FEW_MATCHES = "too few matches"
    NO_MOTION = "no motion"
    NOT_CONSISTENT = "no consistent motion"
    ONLY_STILL = "only background"
    FOUND = "found"
    NOT_OBSERVABLE = "turn not observable"
    NO_POSE = "no consistent pose"

    @property
    def text(self) -> str:
        """One sentence that says what the status means."""
        return _FRAME_TEXTS[self]

    @property
    def has_pose(self) -> bool:
        """Whether a frame of this status has a pose."""
        return self in (
            FrameStatus.FIRST,
            FrameStatus.TRACKED,
            FrameStatus.RELOCALISED,
            FrameStatus.COASTING,
            FrameStatus.UNCERTAIN,
            FrameStatus.FOUND,
        )


_FRAME_TEXTS = {
    FrameStatus.FIRST: "The first frame with the object: the pose that all others are relative to.",
    FrameStatus.TRACKED: "The object was followed from the frame before.",
    FrameStatus.RELOCALISED: "The object was found again, by what was learnt of it before.",
    FrameStatus.COASTING: "The object was not found; it is taken to go on as it did, with growing uncertainty.",
    FrameStatus.UNCERTAIN: "What is seen hardly tells how the object is turned: its pose may be any of many.",
    FrameStatus.LOST: "The object was not found, for too long to say where it may be.",
    FrameStatus.TOO_FEW_MATCHES: "Too few features on the object in all cameras together, to begin with.",
    FrameStatus.NO_MOTION: "Nothing moved yet that could be taken for the object: its pose is not known.",
    FrameStatus.ONLY_STILL: "All that is seen stands still and was never seen to move: it may be the background, and what "
    "moved before is not seen. The object's pose is not known.",
    FrameStatus.FOUND: "The pose was found in this frame by itself, from points known on the object.",
    FrameStatus.NOT_OBSERVABLE: "How the object is turned cannot be told: other turns explain what is seen as well.",
    FrameStatus.NO_POSE: "No single pose explains enough of what is seen.",
    FrameStatus.NOT_CONSISTENT: "What moved was no rigid body, or not for long: its pose is not known.",
}


class Observable(Enum):
    """What of a frame's pose can be seen. `observable.text` is a sentence for people."""

    ALL = "all"
    NO_SCALE = "scale not observable"
    NO_LENGTH = "length not observable"

    @property
    def text(self) -> str:
        """One sentence that says what it means."""
        return _OBSERVABLE_TEXTS[self]


_OBSERVABLE_TEXTS = {
    Observable.ALL: "The whole pose can be seen.",
    Observable.NO_LENGTH: "The object has not turned: how far it moved follows from what is believed of its place and shape "
    "alone, until a turn tells it.",
    Observable.NO_SCALE: "With one camera, lengths are in units of the object's first distance.",
}
