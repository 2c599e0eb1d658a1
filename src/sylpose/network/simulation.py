"""Nodes in one process, over a simulated network: every claim of the network is a seeded test here."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import IntArray
from sylpose.methods import MODES
from sylpose.network.fault_injection import Lie, false_content, liar
from sylpose.network.frame_announcement import NO_FRAME
from sylpose.network.membership import Answer, Ask, Present, Tell, answer, asked, present_step
from sylpose.network.node import Node, track_by_node
from sylpose.network.rounds import PATIENCE
from sylpose.network.smoothing import smooth_by_node
from sylpose.network.wire_format import Welcome
from sylpose.network.worker_thread import Talk
from sylpose.rig import Rig
from sylpose.smoothing.trajectory import Smoothed
from sylpose.sylvester.distributed.messages import Inbox, Packet
from sylpose.sylvester.distributed.simulation import UNDISTURBED, Disturbances, run
from sylpose.tracking.tracked_frame import TrackedFrame

__all__ = ["Outcome", "track_by_nodes"]

# A node that is through answers those that have missed its last word for so many steps more (derived: longer than they
# wait).
LINGERS = 2 * PATIENCE.silent
# Frames that are held where all are at the same one (derived: that and the next).
HELD = 2
# Steps of the network, at most (choice: a day of frames).
MOST_STEPS = 10**7


@dataclass(frozen=True, eq=False)
class NodeState:
    """A node: its presence, and its work. `through`: steps since that ended; told: bytes of each round's word."""

    present: Present
    talk: Talk
    through: int = 0
    told: list[int] = field(default_factory=list)

    @property
    def done(self) -> bool:
        """Nothing will be sent any more."""
        return self.through > LINGERS


class Outcome(NamedTuple):
    """What came of a recording.

    Attributes:
        frames: by camera, what it said of each frame in which it took part.
        members: by camera, who took part in the end for all it knows; empty for one that never began.
        steps: of the network, until all were through.
        told: by camera, the bytes of what it told in each round, a header of 12 not counted.
        refused: by camera, whom it did not understand, and why.
        sent, received: (C,) bytes, repetitions included.
        smoothed: by camera, the refined trajectory, if that was asked for and the node lived.
    """

    frames: list[list[TrackedFrame]]
    members: list[tuple[int, ...]]
    steps: int
    told: list[list[int]]
    refused: list[dict[int, str]]
    sent: IntArray
    received: IntArray
    smoothed: list[Smoothed | None]


class Reel:
    """A recording that is read once, as far as anybody has asked for; so many of its last frames are kept, None for all."""

    def __init__(self, frames: Iterable[FrameSet], kept: int | None = None) -> None:
        self._frames, self._kept, self._read = iter(frames), kept, 0
        self._held: dict[int, FrameSet] = {}

    def has(self, number: int) -> bool:
        """Whether there is such a frame."""
        while self._read <= number:
            frame = next(self._frames, None)
            if frame is None:
                return False
            self._held[self._read] = frame
            self._read += 1
            if self._kept is not None:
                self._held.pop(self._read - 1 - self._kept, None)
        return True

    def __getitem__(self, number: int) -> FrameSet:
        """A frame; of one that there is not, somebody says that he has it, and nobody here has an image."""
        if self.has(number):
            return self._held[number]
        last = self._held[self._read - 1]
        nothing = (None,) * len(last.images)
        return replace(last, index=number, time=last.time + number - last.index, images=nothing, masks=nothing)


class Recorded:
    """One camera's frames of a recording, as fast as they are asked for."""

    def __init__(self, camera: int, frames: Reel) -> None:
        self._camera, self._frames = camera, frames

    def newest(self, wanted: int) -> tuple[int, float | None]:
        """See `Shots`."""
        return (wanted, self.time_of(wanted)) if self._frames.has(wanted) else (NO_FRAME, None)

    def time_of(self, number: int) -> float | None:
        """See `Shots`."""
        return self._frames[number].times[self._camera]

    def frame_set(self, number: int, times: Sequence[float | None]) -> FrameSet:
        """See `Shots`."""
        frame, c = self._frames[number], self._camera
        images = tuple(image if k == c else None for k, image in enumerate(frame.images))
        masks = tuple(mask if k == c else None for k, mask in enumerate(frame.masks))
        return replace(frame, times=tuple(times), images=images, masks=masks)


def track_by_nodes(
    frames: Iterable[FrameSet],
    rig: Rig,
    boxes: Mapping[str, Box] | None = None,
    *,
    disturbances: Disturbances = UNDISTURBED,
    lies: Mapping[int, Lie] | None = None,
    mode: str = MODES[0],
    smooth: bool = False,
    on_frame: Callable[[int, TrackedFrame], None] | None = None,
    **options: Any,
) -> Outcome:
    """`track`, by cameras each of which sees its own images and hears what the others tell.

    Args:
        disturbances: of the network. lies: camera -> how it lies (`network.fault_injection`).
        mode: of the nodes, see `Node`.
        smooth: refine all poses together after the last frame (`smooth_by_node`).
        on_frame: called with a camera and each frame as it says it.
        options: as of `track`.

    Raises:
        ValueError: as `track`; disturbances that are not simulated.
    """
    if disturbances.nonsense:
        raise ValueError("disturbances: what nodes say is garbled by `lies`")
    n = len(rig)
    lies = lies or {}
    liars = {c: of for c, lie in lies.items() if (of := liar(lie, c, n, disturbances.seed)) is not None}
    # Undisturbed, one node works at a time, and none is a frame ahead: no more than that is held of a recording.
    recording = Reel(frames, HELD if disturbances == UNDISTURBED and not lies else None)
    smoothed: list[Smoothed | None] = [None] * n
    first = [c for c in range(n) if c not in disturbances.joins]
    found: list[list[TrackedFrame]] = [[] for _ in range(n)]
    refused: list[dict[int, str]] = [{} for _ in range(n)]
    talks: list[Talk] = []
    starts = [0] * n

    def start(c: int) -> tuple[NodeState, list[Packet]]:
        starts[c] += 1
        begins = starts[c] == 1 and c in first

        def track(ask: Callable[[Ask, int], Answer]) -> None:
            if c in lies and c not in liars:
                ask = _lying(ask, false_content(lies[c], c, disturbances.seed))
            node = Node(c, n, ask, mode)
            node.refused = refused[c]
            shots = Recorded(c, recording)
            # As they come: what a node that dies has said by then is kept.
            # Who tells nonsense and hears it himself may break; the others must not.
            with suppress(Exception) if c in lies else nullcontext():
                for frame in track_by_node(node, rig, shots, boxes, enters=not begins, **options):
                    found[c].append(frame)
                    if on_frame is not None:
                        on_frame(c, frame)
                if smooth:
                    smoothed[c] = smooth_by_node(node, rig, found[c])

        talk = Talk(track)
        talks.append(talk)
        group = Welcome(0, 0, frozenset(first), b"") if begins else None
        present = Present(c, n, incarnation=starts[c], wait=PATIENCE.silent, welcome=group)
        return _worked(NodeState(present, talk), [])

    try:
        outcome = run([partial(start, c) for c in range(n)], _step, disturbances, MOST_STEPS, liars)
    finally:
        for talk in talks:
            talk.end()
    states = outcome.states
    return Outcome(
        found,
        [() if s is None else s.present.members for s in states],
        outcome.rounds,
        [[] if s is None else s.told for s in states],
        [{**mine, **({} if s is None else s.present.all_refused)} for mine, s in zip(refused, states, strict=True)],
        outcome.sent,
        outcome.received,
        smoothed,
    )


def _lying(ask: Callable[[Ask, int], Answer], false: Callable[[bytes], bytes]) -> Callable[[Ask, int], Answer]:
    return lambda said, frames: ask(said._replace(own=false(said.own)) if isinstance(said, Tell) else said, frames)


def _step(state: NodeState, inbox: Inbox) -> tuple[NodeState, list[Packet]]:
    present, packets = present_step(state.present, inbox)
    state = replace(state, present=present, through=state.through + (state.through > 0))
    found, answered = answer(present)
    if answered is None:
        return state, packets
    state.talk.hears(answered)
    return _worked(replace(state, present=found), packets)


def _worked(s: NodeState, packets: list[Packet]) -> tuple[NodeState, list[Packet]]:
    """As far as what was heard allows."""
    while True:
        asks = s.talk.asks()
        if asks is None:
            return replace(s, through=1), packets
        present, more = asked(s.present, *asks)
        packets = packets + more
        if isinstance(asks[0], Tell):
            s.told.append(len(asks[0].own))
        if len(present.members) == 1:  # with nobody to wait for, a round is a step as well
            return replace(s, present=present), packets
        present, answered = answer(present)
        s = replace(s, present=present)
        if answered is None:
            return s, packets
        s.talk.hears(answered)
