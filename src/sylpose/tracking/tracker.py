"""The tracker in one process: the object's pose in every frame, each frame against several earlier ones."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sylpose.frames import Box, FrameSet, check_frames
from sylpose.geometry.validation import kind_of, number, shown, whole
from sylpose.input_limits import one_line
from sylpose.methods import FEATURES, METHODS, features_of
from sylpose.rig import Rig
from sylpose.tracking.camera import CameraPart
from sylpose.tracking.camera_executor import Crew, OneProcess
from sylpose.tracking.camera_motion_correction import with_nudges
from sylpose.tracking.context import Team
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.frame_solvers import SOLVERS
from sylpose.tracking.joint_state import Joint
from sylpose.tracking.known_object import KnownObject, learnt_of
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.object_transfer import KnownHere, begun_with, known_here
from sylpose.tracking.state_machine import Waiting, finish, next_frame
from sylpose.tracking.state_transfer import Handover, handed_over, taken_over
from sylpose.tracking.tracked_frame import TrackedFrame

MAX_LATE = 1e6  # seconds: cameras of one recording are not days apart (choice)

__all__ = ["Memory", "Tracker", "Tracking", "track"]


def track(
    frames: Iterable[FrameSet],
    rig: Rig,
    boxes: Mapping[str, Box] | None = None,
    *,
    method: str = METHODS[0],
    features: str = FEATURES[0],
    offsets: Mapping[str, float] | None = None,
    workers: int | None = None,
    seed: int = 0,
    known: KnownObject | None = None,
) -> Iterator[TrackedFrame]:
    """The object's pose in every frame, as the frames come.

    Args:
        frames: of the recording, in order: `session.frames()`.
        rig: C cameras. With one camera the object is put at distance 1 of it, and every frame's status says that the
            scale is not observable.
        boxes: where the object is in the first frame, per camera that sees it, pixels; None: the object is what moves
            against the standing background.
        method: "landmarks" (places of the features on the object grow certain over time: drifts least), "epipolar"
            (epipolar geometry against several references), one of the paper's estimators frame to frame (as in
            `estimate_motion`), or "known-depth" (Sylvester's equation for landmarks whose depth is known by now).
        features: "sift" (SIFT in every frame, as in the paper), "klt" (followed from image to image, SIFT only where that
            does not suffice: several times faster, and more precise; not for the paper's estimators, which want the
            matches with the frame before) or "auto": "klt" for the method "landmarks", else "sift".
        offsets: by camera, seconds by which its images are later than its time stamps say.
        known: the object, as another take has learnt it (`load_object`): poses are told in the frame that it had there,
            from the first frame on in which it is found.
        workers: threads for detection and matching; None: one per core, at most one per camera.
        seed: of the outlier rejection. The same input and seed give the same output, whatever the number of threads.

    Yields:
        One `TrackedFrame` per frame. Without boxes the first ones are held back until the object has moved.

    Raises:
        ValueError: an unknown method; a negative seed; boxes of cameras that the rig does not have, or that do not meet in
            space; a known object that other cameras saw, together with boxes, or with another method than "landmarks".
    """
    with Tracker(
        rig, boxes, method=method, features=features, offsets=offsets, workers=workers, seed=seed, known=known
    ) as tracker:
        for frame_set in _iterated(frames):
            yield from tracker.step(frame_set)
        yield from tracker.flush()


def _iterated(frames: Iterable[FrameSet]) -> Iterable[FrameSet]:
    if not isinstance(frames, Iterable) or isinstance(frames, (str, bytes, Mapping)):
        raise TypeError(f"frames must be a sequence of FrameSet, got {shown(frames)}")
    return frames


class Memory(NamedTuple):
    """All that is known between two frames, by all and by each camera here."""

    joint: Joint
    waiting: Sequence[Waiting]
    number: int
    parts: Sequence[CameraPart]


class Tracking:
    """The way through a recording, whoever the cameras' crew is.

    Args:
        parts: by camera, each its own.
        rig, boxes, method, features, offsets, seed, known: see `track`.

    Raises:
        ValueError: as `track`.
    """

    def __init__(
        self,
        rig: Rig,
        parts: Sequence[CameraPart],
        crew: Crew,
        boxes: Mapping[str, Box] | None,
        *,
        method: str,
        features: str,
        offsets: Mapping[str, float] | None,
        seed: int,
        known: KnownObject | None = None,
    ) -> None:
        follows = features_of(method, features) == "klt"
        whole(seed, "seed")
        for name, value in kind_of({} if offsets is None else offsets, Mapping, "offsets").items():
            if name not in rig.names:
                raise ValueError(f"offsets: no camera {shown(name)} in the rig ({one_line(', '.join(rig.names), 200)})")
            number(value, f"offsets: {name}", least=-MAX_LATE, most=MAX_LATE)
        for name, box in kind_of({} if boxes is None else boxes, Mapping, "boxes").items():
            kind_of(box, Box, f"boxes: {shown(name)}")
        late = np.array([(offsets or {}).get(name, 0.0) for name in rig.names])
        self._team = Team(rig, parts, crew, SOLVERS[method], follows, late, seed, method == METHODS[0])
        self._rig = rig
        self._joint = Joint(ObjectModel.in_boxes(rig, boxes) if boxes else ObjectModel())
        if known is not None:
            kind_of(known, KnownObject, "known")
            if boxes:
                raise ValueError("boxes: of an object that is known, none are wanted")
            if method != METHODS[0]:
                raise ValueError(f"method: an object that is known is tracked by {METHODS[0]!r}, not by {method!r}")
        # The object before these cameras, where it is known from another take.
        self.known: KnownHere | None = None if known is None else known_here(known, rig)
        self._waiting: Sequence[Waiting] = []
        self.number = 0  # of the next frame

    def step(self, frames: FrameSet) -> list[TrackedFrame]:
        """Take in the next frame.

        Returns:
            The frames that are now decided, in order: usually this one; none while the object has not moved yet and no
            boxes tell where it is, then those that waited for it and this one.
        """
        check_frames(frames, self._rig)
        here, note = self.known, ""
        if here is not None and not self.number:
            note = here.note
            self._joint = begun_with(here, self._rig, self._here(), frames.time)
            self.number = len(here.keyframes)
        index, self.number = self.number, self.number + 1
        self._joint, self._waiting, decided = next_frame(self._team, self._joint, self._waiting, index, frames)
        if here is None:
            return decided
        return [
            replace(tracked, pose=here.telling.of(tracked.pose), learnt=tracked.pose, note=tracked.note or note)
            for tracked in decided
        ]

    @property
    def memory(self) -> Memory:
        """All that is known by now, the cameras here included: until the next frame, whose way changes some of it."""
        return Memory(self._joint, self._waiting, self.number, self._here())

    def remembered(self) -> Memory:
        """The same, for longer: a copy."""
        # What is never written to need not be copied: images, descriptors, calibrations.
        constants: list[object] = [waiting.frames for waiting in self._waiting]
        constants += [own for part in self._here() for own in part.constants()]
        constants += [own.features for waiting in self._waiting for own in waiting.frame.cameras if own is not None]
        changing = self._here(), list(self._waiting)
        parts, waiting = copy.deepcopy(changing, {id(constant): constant for constant in constants})
        return Memory(self._joint, waiting, self.number, parts)

    def go_back(self, memory: Memory) -> None:
        """To what was known then; a memory serves once."""
        self._joint, self._waiting, self.number, parts = memory
        for part, its in zip(self._here(), parts, strict=True):
            vars(part).update(vars(its))

    def _here(self) -> list[CameraPart]:
        """The parts of the cameras in this process."""
        return [part for part in self._team.parts if part is not None]

    def learnt(self) -> KnownObject | None:
        """What is known of the object by now, for another take; None where that is next to nothing."""
        return learnt_of(self._rig, self._joint, self._here(), None if self.known is None else self.known.known)

    def handed_over(self) -> Handover:
        """What a camera has to know that is to take part from the next frame on."""
        return handed_over(self._joint, self._waiting, self.number)

    def take_over(self, handover: Handover, *, new: bool) -> None:
        """Go on from there, where the cameras here are `new` as if they had seen nothing so far."""
        team, mine = self._team, None if new else self._waiting
        self._joint, self._waiting, self.number = taken_over(handover, team.crew, team.parts, mine)

    @property
    def knows(self) -> bool:
        """Whether a camera here has seen anything of the object that it would know again."""
        return any(part.knows for part in self._here())

    @property
    def defining(self) -> SolvedFrame | None:
        """The frame whose pose defines the object's frame; None before the first pose."""
        return self._joint.keyframes[0] if self._joint.keyframes else None

    def begin_anew(self) -> None:
        """Where a pose is known of an object that no camera would know again: another one is looked for, by its motion,
        whose first pose defines its frame."""
        if self._joint.last is not None:
            self._joint = Joint(nudges=self._joint.nudges)
            for part in self._here():
                part.forget()

    def flush(self) -> list[TrackedFrame]:
        """The frames still undecided at the recording's end: the object moved little, or never."""
        waiting, self._waiting = self._waiting, []
        return with_nudges(self._team, self._joint, finish(self._team, waiting))


class Tracker(Tracking):
    """Follows one rigid object, frame by frame: a context manager around its worker threads.

    Args:
        rig, boxes, method, features, offsets, known, workers, seed: see `track`.

    Raises:
        ValueError: as `track`.
    """

    def __init__(
        self,
        rig: Rig,
        boxes: Mapping[str, Box] | None = None,
        *,
        method: str = METHODS[0],
        features: str = FEATURES[0],
        offsets: Mapping[str, float] | None = None,
        workers: int | None = None,
        seed: int = 0,
        known: KnownObject | None = None,
    ) -> None:
        kind_of(rig, Rig, "rig")
        if workers is not None:
            whole(workers, "workers", least=0)
        self._crew = OneProcess(len(rig), workers or min(len(rig), os.cpu_count() or 1))
        parts = [CameraPart(c, camera) for c, camera in enumerate(rig)]
        asked: dict[str, Any] = {"method": method, "features": features, "offsets": offsets, "seed": seed}
        super().__init__(rig, parts, self._crew, boxes, **asked, known=known)

    def __enter__(self) -> Tracker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the worker threads."""
        self._crew.close()
