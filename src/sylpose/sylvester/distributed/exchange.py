"""Exchange of pair moments: each node passes on moments until all nodes have those of all cameras, then solves.

A node sends one message per round to its neighbors: the moments of one camera, those that it has sent least often
first, and whether it has all. If all are connected ("exchange"), one round suffices and a second confirms it; on a
sparse network ("gossip") moments travel from neighbor to neighbor. Lost and late messages cost rounds. A camera whose
moments never arrive is left out after many rounds without news.

All nodes with the same moments have the same result to the bit: the centralized estimate of the cameras that are not at
fault (`sylvester.camera_faults`), and the faults. A step is a pure function (state, inbox) -> (state, packets).

Source: A. Demers et al., "Epidemic algorithms for replicated database maintenance" (1987), for the gossip; that 45
numbers suffice is ours (`sylpose.moments`).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import connected_components

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.validation import check_rotations
from sylpose.moments import PairMoments
from sylpose.packets import Inbox, Packet
from sylpose.sylvester.camera_faults import solve_robust

# Kind, whether it is final, camera, number: 8 bytes.
_HEADER = struct.Struct("<BBHI")
# Rounds without a message after which a node counts as gone: by chance once in 3e10 at 30 % loss (derived).
MAX_MISSED_ROUNDS = 20


Graph = Iterable[tuple[int, int]]  # pairs of connected cameras


class Kind(IntEnum):
    """Protocol of a message."""

    REFINEMENT = 0
    MOMENTS = 1


class Message(NamedTuple):
    """Message of a node: a header of 8 bytes, then little-endian float64 values.

    Attributes:
        kind: the protocol.
        is_final: the sender needs nothing more.
        camera: the camera that the values are of.
        number: number of the round.
        values: (n,) float64.
    """

    kind: Kind
    is_final: bool
    camera: int
    number: int
    values: FloatArray


def encode(message: Message) -> bytes:
    """Encode a message."""
    return _HEADER.pack(*message[:4]) + np.asarray(message.values, dtype="<f8").tobytes()


def decode_inbox(inbox: Inbox, kind: Kind) -> Iterator[tuple[int, Message]]:
    """Yield the messages of a kind with their senders; damaged packets count as lost."""
    for sender, data in inbox:
        if len(data) >= _HEADER.size and len(data) % 8 == 0 and data[0] == kind:
            _, is_final, camera, number = _HEADER.unpack_from(data)
            values = np.frombuffer(data, "<f8", offset=_HEADER.size).astype(float)
            if np.isfinite(values).all():
                yield sender, Message(kind, bool(is_final), camera, number, values)


class NodeEstimate(NamedTuple):
    """Result of one node.

    Attributes:
        rotation, information: (3, 3) as in `CentralizedSolution`; NaN and zero if all cameras have junk matches.
        weights: camera -> its weight in the result, more than 0.
        faults: camera -> its fault, as a sentence.
        is_consistent: the set of faulty cameras is certain (`Diagnosis`).
    """

    rotation: FloatArray
    information: FloatArray
    weights: Mapping[int, float]
    faults: Mapping[int, str]
    is_consistent: bool


@dataclass(frozen=True, eq=False)
class ExchangeState:
    """State of one node. Each node has the rotations of all cameras and, at first, its own moments only.

    Attributes:
        camera: number of this node.
        rotations: (C, 3, 3) Q of camera_from_world.
        neighbors: the nodes that it is connected to.
        aim: as in `solve_centralized`.
        moments: camera -> moments, including this node's.
        n_sent: camera -> how often this node has sent its moments; 1 from the start if its own packets reach all
            neighbors of this node.
        complete: neighbors that have all moments.
        missed_rounds: neighbor -> rounds since its last message.
        quiet_rounds: rounds since the last new moments.
        round: number of steps so far.
        estimate: the result, once all moments are here or no more are expected.
        done: nothing more will be sent.
    """

    camera: int
    rotations: FloatArray
    neighbors: tuple[int, ...]
    aim: bool
    moments: Mapping[int, PairMoments]
    n_sent: Mapping[int, int]
    complete: frozenset[int] = frozenset()
    missed_rounds: Mapping[int, int] = field(default_factory=dict)
    quiet_rounds: int = 0
    round: int = 0
    estimate: NodeEstimate | None = None
    done: bool = False


def start_exchange(
    camera: int, rotations: ArrayLike, moments: PairMoments, *, graph: Graph | None = None, aim: bool = True
) -> tuple[ExchangeState, list[Packet]]:
    """Create a node and its first message.

    Args:
        camera: index of this node in `rotations`.
        rotations: (C, 3, 3) Q of camera_from_world of all cameras.
        moments: pair moments of this node.
        graph: pairs of cameras that are connected; None if all are.
        aim: as in `solve_centralized`.

    Raises:
        ValueError: the graph contains a camera that does not exist, or is not connected.
    """
    Q = np.array(rotations, dtype=float)
    n = len(check_rotations(Q, len(Q)))
    links = np.ones((n, n), dtype=bool) if graph is None else _build_links(n, graph)
    neighbors = tuple(int(c) for c in np.flatnonzero(links[camera]) if c != camera)
    covered = np.flatnonzero(links[list(neighbors)].all(axis=0)).tolist()
    s = ExchangeState(camera, Q, neighbors, aim, {camera: moments}, dict.fromkeys(covered, 1) | {camera: 0})
    return _send_moments(s)


def step_exchange(state: ExchangeState, inbox: Inbox) -> tuple[ExchangeState, list[Packet]]:
    """Process the messages received; pass moments on; solve once all have arrived."""
    s, n = state, len(state.rotations)
    moments, complete, active = dict(s.moments), set(s.complete), set()
    for sender, message in decode_inbox(inbox, Kind.MOMENTS):
        active.add(sender)
        if message.is_final:
            complete.add(sender)
        if message.camera < n and message.values.size and message.camera not in moments:
            with suppress(ValueError):  # a damaged packet
                moments[message.camera] = PairMoments.from_bytes(message.values.astype("<f8").tobytes())
    has_news = len(moments) > len(s.moments)
    s = replace(
        s,
        moments=moments,
        complete=frozenset(complete),
        missed_rounds={c: 0 if c in active else s.missed_rounds.get(c, 0) + 1 for c in s.neighbors},
        quiet_rounds=0 if has_news else s.quiet_rounds + 1,
        round=s.round + 1,
    )
    if len(moments) < n and s.quiet_rounds <= MAX_MISSED_ROUNDS + n:
        return _send_moments(replace(s, estimate=None))
    if has_news or s.estimate is None:
        s = replace(s, estimate=_solve(s))
    waits = any(c not in s.complete and s.missed_rounds[c] <= MAX_MISSED_ROUNDS for c in s.neighbors)
    # Neighbors whose messages crossed this node's last moments need no second copy.
    return _send_moments(replace(s, done=not waits), is_final=True, only_new=has_news or not waits)


def _send_moments(
    s: ExchangeState, *, is_final: bool = False, only_new: bool = False
) -> tuple[ExchangeState, list[Packet]]:
    """Send the moments that were sent least often; if `only_new`, none that were sent before."""
    camera = min(s.moments, key=lambda c: (s.n_sent.get(c, 0), c != s.camera, c))
    values, count = s.moments[camera].to_bytes(), s.n_sent.get(camera, 0)
    if only_new and count:
        values, count = b"", count - 1
    header = _HEADER.pack(Kind.MOMENTS, is_final, camera, s.round)
    packets = [Packet(s.neighbors, header + values)] if s.neighbors else []
    return replace(s, n_sent={**s.n_sent, camera: count + 1}), packets


def _solve(s: ExchangeState) -> NodeEstimate | None:
    """Solve with the moments of all cameras; None if there is no result."""
    cameras = sorted(s.moments)
    names = [str(c) for c in cameras]
    try:
        found = solve_robust(s.rotations[cameras], [s.moments[c] for c in cameras], names=names, aim=s.aim)
    except ValueError:  # no camera has any spread
        return None
    if found.solution is not None and not found.solution.converged:
        return None
    weights = {c: float(w) for c, w in zip(cameras, found.weights, strict=True) if w > 0}
    faults = {c: fault.text for c, fault in zip(cameras, found.faults, strict=True) if fault is not None}
    return NodeEstimate(found.rotation, found.information, weights, faults, found.diagnosis.consistent)


def _build_links(n: int, graph: Graph) -> BoolArray:
    """Return the (n, n) mask of connected nodes, each also with itself."""
    links = np.eye(n, dtype=bool)
    for i, j in graph:
        if not (0 <= i < n and 0 <= j < n and i != j):
            raise ValueError(f"the graph connects camera {i} to {j}: expected two different ones of 0 to {n - 1}")
        links[i, j] = links[j, i] = True
    component = connected_components(links, directed=False)[1]
    unreachable = np.flatnonzero(component != component[0]).tolist()
    if unreachable:
        cameras = ", ".join(map(str, unreachable))
        raise ValueError(f"the graph is not connected: cameras {cameras} cannot reach camera 0")
    return links
