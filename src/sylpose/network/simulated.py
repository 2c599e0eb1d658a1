"""Nodes in one process, over a simulated network: every claim of the network is a seeded test here."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from queue import SimpleQueue
from threading import Thread
from typing import Any, NamedTuple

from sylpose.frames import Box, FrameSet
from sylpose.network.agreed import PATIENCE, Agreeing, agree_next, agree_start, agree_step
from sylpose.network.node import Node, Round, track_by_node
from sylpose.numerics.arrays import IntArray
from sylpose.paper.distributed.messages import Inbox, Packet
from sylpose.paper.distributed.simulated import UNDISTURBED, Disturbances, run
from sylpose.rig import Rig
from sylpose.tracking.tracked_frame import TrackedFrame

__all__ = ["Outcome", "track_by_nodes"]

# A node that is through answers those that have missed its last word for so many steps more (derived: longer than they
# wait).
LINGERS = 2 * PATIENCE
# Steps of the network, at most (choice: a day of frames).
MOST_STEPS = 10**7


class Talk:
    """Work that tells others something now and then: it runs in a thread of its own, and stands still while it waits."""

    def __init__(self, work: Callable[[Round], None]) -> None:
        self._says: SimpleQueue[bytes | BaseException | None] = SimpleQueue()
        self._hears: SimpleQueue[Mapping[int, bytes] | None] = SimpleQueue()
        self._thread = Thread(target=self._run, args=(work,), daemon=True)
        self._thread.start()

    def _run(self, work: Callable[[Round], None]) -> None:
        try:
            work(self._tell)
            self._says.put(None)
        except BaseException as error:
            # Raised where the work is waited for.
            self._says.put(error)

    def _tell(self, own: bytes) -> Mapping[int, bytes]:
        self._says.put(own)
        heard = self._hears.get()
        if heard is None:
            raise SystemExit
        return heard

    def says(self) -> bytes | None:
        """What it tells next; None when it is through."""
        said = self._says.get()
        if isinstance(said, BaseException):
            raise said
        return said

    def hears(self, told: Mapping[int, bytes]) -> bytes | None:
        """Goes on with what all have told, up to what it tells next."""
        self._hears.put(told)
        return self.says()

    def end(self) -> None:
        """Ends it where it stands."""
        self._hears.put(None)
        self._thread.join()


@dataclass(frozen=True, eq=False)
class NodeState:
    """A node: its side of the rounds, and its work. `through`: steps since that ended; told: bytes of each round's word."""

    agreeing: Agreeing
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
        frames: by camera, what it said of each frame: all of them, or those until it died.
        members: by camera, who took part in the end for all it knows; empty for one that never began.
        steps: of the network, until all were through.
        told: by camera, the bytes of what it told in each round, a header of 8 not counted.
        refused: by camera, whom it did not understand, and why.
        sent, received: (C,) bytes, repetitions included.
    """

    frames: list[list[TrackedFrame]]
    members: list[tuple[int, ...]]
    steps: int
    told: list[list[int]]
    refused: list[dict[int, str]]
    sent: IntArray
    received: IntArray


def track_by_nodes(
    frames: Iterable[FrameSet],
    rig: Rig,
    boxes: Mapping[str, Box] | None = None,
    *,
    disturbances: Disturbances = UNDISTURBED,
    **options: Any,
) -> Outcome:
    """`track`, by cameras each of which sees its own images and hears what the others tell.

    Args:
        disturbances: of the network. Who joins late, or tells nonsense, is not simulated yet.
        options: as of `track`.

    Raises:
        ValueError: as `track`; disturbances that are not simulated.
    """
    if disturbances.joins or disturbances.nonsense:
        raise ValueError("disturbances: nodes that join late or tell nonsense are not simulated")
    recording, n = list(frames), len(rig)
    found: list[list[TrackedFrame]] = [[] for _ in range(n)]
    refused: list[dict[int, str]] = [{} for _ in range(n)]
    talks: list[Talk] = []

    def start(c: int) -> tuple[NodeState, list[Packet]]:
        def track(tell: Round) -> None:
            node = Node(c, n, tell)
            refused[c] = node.refused
            # As they come: what a node that dies has said by then is kept.
            for frame in track_by_node(node, rig, recording, boxes, **options):
                found[c].append(frame)

        talk = Talk(track)
        talks.append(talk)
        first = talk.says()
        if first is None:  # there is nothing to talk about
            return NodeState(agree_start(c, [c], b"")[0], talk, through=LINGERS + 1), []
        agreeing, packets = agree_start(c, range(n), first)
        return _gone_on(NodeState(agreeing, talk, told=[len(first)]), packets)

    try:
        outcome = run([partial(start, c) for c in range(n)], _step, disturbances, MOST_STEPS)
    finally:
        for talk in talks:
            talk.end()
    states = outcome.states
    return Outcome(
        found,
        [() if s is None else s.agreeing.members for s in states],
        outcome.rounds,
        [[] if s is None else s.told for s in states],
        [{**mine, **({} if s is None else s.agreeing.refused)} for mine, s in zip(refused, states, strict=True)],
        outcome.sent,
        outcome.received,
    )


def _step(state: NodeState, inbox: Inbox) -> tuple[NodeState, list[Packet]]:
    agreeing, packets = agree_step(state.agreeing, inbox)
    return _gone_on(replace(state, agreeing=agreeing, through=state.through + (state.through > 0)), packets)


def _gone_on(s: NodeState, packets: list[Packet]) -> tuple[NodeState, list[Packet]]:
    """As far as what was heard allows."""
    while s.agreeing.outcome is not None and not s.through:
        own = s.talk.hears(s.agreeing.outcome)
        if own is None:
            return replace(s, through=1), packets
        agreeing, more = agree_next(s.agreeing, own)
        s.told.append(len(own))
        s, packets = replace(s, agreeing=agreeing), packets + more
    return s, packets
