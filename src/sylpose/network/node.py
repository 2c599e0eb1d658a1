"""One camera as a node: it sees its own images, tells the others numbers, and comes to the same poses as they do."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Protocol, TypeVar, cast

import numpy as np

from sylpose.frames import Box, FrameSet
from sylpose.landmarks.alignment import Sights, Start
from sylpose.landmarks.distributed_alignment import OneOfMany
from sylpose.methods import FEATURES, METHODS, MODES
from sylpose.network.codec import packed, unpacked
from sylpose.network.frame_announcement import ABSENT, NO_FRAME, WAITS, Roll, common, instant_of
from sylpose.network.membership import Answer, Ask, Enter, Heard, Tell
from sylpose.network.plausibility import objection
from sylpose.rig import Rig
from sylpose.tracking.camera import CameraPart
from sylpose.tracking.camera_executor import Alignment
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.joint_state import Joint
from sylpose.tracking.state_transfer import Handover, check_handover
from sylpose.tracking.tracked_frame import TrackedFrame
from sylpose.tracking.tracker import Tracking

__all__ = ["Again", "Node", "Shots", "track_by_node"]

T = TypeVar("T")

NOBODY: frozenset[int] = frozenset()
# Cameras' time stamps of one instant are less apart, seconds (choice: no camera waits so long for the others).
APART = 1.0
# Poses less than this apart, radians, and as a share of the distance, are one but for rounding (choice).
ALIKE = 1e-6
ANOTHER_FRAME = "from here on poses are told in another frame of the object"


class Again(Exception):
    """Somebody lied, and not all have heard the same: what was said since they last were alike counts for nothing.

    Attributes:
        outcast: for this node nothing counts any more, and it has a group to enter.
    """

    def __init__(self, outcast: bool) -> None:
        super().__init__("not all have heard the same")
        self.outcast = outcast


class Shots(Protocol):
    """One camera's frames; those of all cameras at one instant have the same number."""

    def newest(self, wanted: int) -> tuple[int, float | None]:
        """Waits for the frame of that number, or a later one.

        Returns:
            the number of the newest frame there is, and its own time stamp, seconds; `NO_FRAME` where no more come, `WAITS`
            where it has waited for long.
        """

    def time_of(self, number: int) -> float | None:
        """The time stamp of a frame, seconds; None without one."""

    def frame_set(self, number: int, times: Sequence[float | None]) -> FrameSet:
        """The frames of one instant, as far as this camera has them, with all cameras' time stamps."""


class Node:
    """A crew of which one camera is here (`tracking.camera_executor.Crew`).

    Args:
        camera: which one, of so many cameras of the rig.
        ask: of the node's presence among the others (`network.membership`), with the number of frames tracked.
        mode: of `MODES`: as in one process, or in fewer rounds (`landmarks.distributed_alignment`), the same at all cameras.

    Attributes:
        camera, cameras: as given.
        members: who took part in the last round.
        refused: camera -> why its first word of no meaning was taken for nothing.
        frames: that were tracked, as long as anybody in its group knows the object.
        since: index of the first frame since it has entered its group.
    """

    def __init__(self, camera: int, cameras: int, ask: Callable[[Ask, int], Answer], mode: str = MODES[0]) -> None:
        if mode not in MODES:
            raise ValueError(f"mode {mode!r}: expected {' or '.join(MODES)}")
        self.camera, self.cameras, self._ask, self._mode = camera, cameras, ask, mode
        self.members: tuple[int, ...] = ()
        self.refused: dict[int, str] = {}
        self.frames, self.since = 0, 0
        self._heard = Heard({}, NOBODY, False)
        self._joining: tuple[frozenset[int], bytes] = NOBODY, b""

    # --- a crew -------------------------------------------------------------------------------------------------------

    def each(self, do: Callable[[int], T], *, long: bool = False) -> list[T]:  # noqa: ARG002
        """See `Crew`."""
        mine = do(self.camera)
        return [mine if c == self.camera else cast(T, None) for c in range(self.cameras)]

    def ask(self, do: Callable[[int], T], nothing: T) -> list[T]:
        """See `Crew`."""
        return self._told(do(self.camera), nothing)

    def align(self, sights: Sequence[Sights], starts: Sequence[Start]) -> list[Alignment]:
        """See `Crew`."""
        compact = self._mode == "compact"
        mine = OneOfMany(sights[self.camera], self.camera, self.cameras, self._told, compact=compact)
        return [(one, self.each(lambda _, a=one: (a.weights[0], a.residuals[0]))) for one in mine.align(starts)]  # type: ignore[misc]

    def _told(self, mine: T, nothing: T, /) -> list[T]:
        heard = self._tell(packed(mine))
        return [self._read(c, heard.get(c), nothing) for c in range(self.cameras)]

    def _tell(self, own: bytes) -> Mapping[int, bytes]:
        """One agreed round. What this camera told comes back with the others' words: it goes on with what they heard."""
        heard = self._ask(Tell(own, *self._joining), self.frames)
        assert isinstance(heard, Heard)
        self._heard, self._joining = heard, (NOBODY, b"")
        if heard.again:
            raise Again(heard.outcast)
        self.members = tuple(heard.told)
        return heard.told

    def _read(self, camera: int, data: bytes | None, nothing: T) -> T:
        """What a camera told, as far as it means anything."""
        if data is None:
            return nothing
        try:
            told = unpacked(data, nothing)
            why = objection(told, camera)
        except ValueError as error:
            why = str(error)
        if why is None:
            return told
        self.refused.setdefault(camera, why)
        return nothing

    def confirm(self) -> None:
        """All have heard the same until here.

        Raises:
            Again: they have not.
        """
        self._tell(b"")

    # --- a member of a group ------------------------------------------------------------------------------------------

    def call(self, newest: int, time: float | None, knows: bool) -> list[Roll]:
        """The roll of all members. Arguments as in `Roll`."""
        stamp = np.nan if time is None else time
        mine = Roll(newest, stamp, tuple(sorted(self._heard.newcomers)), self._heard.outdone, knows)
        told = self._told(mine, ABSENT)
        return [told[c] for c in self.members]

    def take_in(self, newcomers: frozenset[int], knows: bytes) -> None:
        """With the next round others join, and are told what there is to know."""
        self._joining = newcomers, knows

    def enter(self) -> tuple[Handover, int] | None:
        """Waits for a group.

        Returns:
            what all know there, and the number of the next frame; None where this node founds one.
        """
        while True:
            entered = self._ask(Enter(), self.frames)
            assert not isinstance(entered, Heard)
            self._heard = Heard({}, entered.newcomers, False)
            if entered.knows is None:
                return None
            try:
                handover, wanted = unpacked(entered.knows, (Handover(Joint(), (), 0), 0))
                check_handover(handover, self.cameras)
            except ValueError:  # others may welcome it, too
                continue
            if wanted >= 0:
                return handover, wanted


def track_by_node(
    node: Node,
    rig: Rig,
    shots: Shots,
    boxes: Mapping[str, Box] | None = None,
    *,
    enters: bool = False,
    method: str = METHODS[0],
    features: str = FEATURES[0],
    offsets: Mapping[str, float] | None = None,
    seed: int = 0,
) -> Iterator[TrackedFrame]:
    """`track`, by one camera that knows its own images alone.

    Args:
        node: the camera among all of the rig, each of which calls this with the same other arguments.
        shots: its images.
        enters: whether it has a group to enter; else it begins in one.
        rig, boxes, method, features, offsets, seed: as `track`.

    Yields:
        As `track`, the frames in which it took part.

    Raises:
        ValueError: as `track`.
    """
    parts = [cast(CameraPart, CameraPart(c, own) if c == node.camera else None) for c, own in enumerate(rig)]
    tracking = Tracking(rig, parts, node, boxes, method=method, features=features, offsets=offsets, seed=seed)
    wanted, taken_in, found = 0, -1, list[TrackedFrame]()
    defining: SolvedFrame | None = None
    while True:
        if enters:
            entered, enters = node.enter(), False
            if entered is not None:
                handover, wanted = entered
                taken_in = wanted
                node.since = -1
                tracking.take_over(handover, new=True)
        # What all have heard alike so far.
        memory = tracking.remembered()
        try:
            rolls = node.call(*shots.newest(wanted), knows=tracking.knows)
            known = any(roll.knows for roll in rolls)
            node.frames = tracking.number if known else 0
            if all(roll.outdone for roll in rolls):
                enters = True
                continue
            if not known:
                # Who has seen the object is gone, and nobody here would know it again.
                tracking.begin_anew()
            newcomers = common(rolls)
            # Once before each frame: who comes again and again, and never takes part, must not keep the others from it.
            if newcomers and taken_in != wanted:
                taken_in = wanted
                knows = packed((tracking.handed_over(), wanted))
                # All go on with what was sent, in which numbers may be rounded.
                tracking.take_over(unpacked(knows, (tracking.handed_over(), wanted))[0], new=False)
                node.take_in(newcomers, knows)
                continue
            number = instant_of(rolls, wanted)
            if number == WAITS:
                continue
            if number == NO_FRAME:
                found = tracking.flush()
            else:
                frames = shots.frame_set(number, _times(node, shots, rolls, number))
                found = tracking.step(frames)
            node.confirm()
        except Again as again:
            tracking.go_back(memory)
            enters = again.outcast
            continue
        if number == NO_FRAME:
            break
        node.since = node.since if node.since >= 0 else frames.index
        wanted = number + 1
        if tracking.defining is not None and found:
            if defining is not None and not _same_frame(defining, tracking.defining):
                found[0] = _with_fault(found[0], ANOTHER_FRAME)
            defining = tracking.defining
        yield from found
    yield from found


def _same_frame(one: SolvedFrame, other: SolvedFrame) -> bool:
    """Whether two frames define the same frame of the object: they are of one time, and have one pose."""
    a, b = one.world_from_object, other.world_from_object
    turned, far = (a.rotation * b.rotation.inv()).magnitude(), np.linalg.norm(a.translation - b.translation)
    return bool(
        one.time == other.time and turned < ALIKE and far < ALIKE * np.linalg.norm(one.viewpoints, axis=1).max()
    )


def _with_fault(tracked: TrackedFrame, sentence: str) -> TrackedFrame:
    return replace(tracked, pose=replace(tracked.pose, faults=(*tracked.pose.faults, sentence)))


def _times(node: Node, shots: Shots, rolls: Sequence[Roll], number: int) -> tuple[float | None, ...]:
    """By camera the time stamp of a frame."""
    by_camera = {c: roll.time for c, roll in zip(node.members, rolls, strict=True)}
    if any(roll.newest >= 0 and roll.newest != number for roll in rolls):
        own = shots.time_of(number)
        told = node.ask(lambda _: np.nan if own is None else own, np.nan)
        by_camera = {c: told[c] for c in node.members}
    blind = {c for c, roll in zip(node.members, rolls, strict=True) if roll.newest < 0}
    times = {c: time for c, time in by_camera.items() if np.isfinite(time) and c not in blind}
    middle = float(np.median(list(times.values()))) if times else 0.0
    for c, time in list(times.items()):
        if abs(time - middle) > APART:
            off = f"its clock is {abs(time - middle):.3g} s off the others'"
            node.refused.setdefault(c, f"{off}: its time stamps are not used")
            del times[c]
    return tuple(times.get(c) for c in range(node.cameras))
