"""Packets between the nodes of cameras, and a simulated network that loses, delays and separates them.

A node is a pure function (state, inbox) -> (state, packets). It therefore runs identically here, in several processes
and on several machines (`network.zenoh_transport`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from sylpose.geometry.arrays import IntArray
from sylpose.geometry.validation import check_integer, check_number, check_sequence, check_type

Inbox = Sequence[tuple[int, bytes]]  # (sending camera, received bytes)

MAX_ROUNDS = 10**6  # maximum number of rounds of a simulated network: more would take days (choice)


class Packet(NamedTuple):
    """Bytes for one or several nodes: sent once if the network supports multicast."""

    to: tuple[int, ...]
    data: bytes


@dataclass(frozen=True)
class NetworkFaults:
    """Faults of a simulated network.

    Attributes:
        loss: share of lost packets, independent for each link.
        delay: maximum delay of a packet in rounds, drawn uniformly from 0; later packets may overtake it.
        dies: camera -> round from which on it is down.
        joins: camera -> round in which it starts.
        returns: camera -> round in which it restarts after it was down.
        partition: network partition: first round, end round, and the cameras of the separated group.
        seed: seed of the random generator.

    Raises:
        ValueError: a share is outside [0, 1), a delay is negative, or a restart precedes the failure.
    """

    loss: float = 0.0
    delay: int = 0
    dies: Mapping[int, int] = field(default_factory=dict)
    joins: Mapping[int, int] = field(default_factory=dict)
    returns: Mapping[int, int] = field(default_factory=dict)
    partition: tuple[int, int, frozenset[int]] = (0, 0, frozenset())
    seed: int = 0

    def __post_init__(self) -> None:
        loss = check_number(self.loss, "loss", minimum=0.0, maximum=1.0)
        if loss == 1.0:
            raise ValueError(f"loss must be in [0, 1), got {self.loss}")
        check_integer(self.delay, "delay", maximum=MAX_ROUNDS)
        check_integer(self.seed, "seed")
        for name in ("dies", "joins", "returns"):
            for camera, value in check_type(getattr(self, name), Mapping, name).items():
                check_integer(camera, f"{name}: camera")
                check_integer(value, f"{name}[{camera}]", maximum=MAX_ROUNDS)
        parts = check_type(self.partition, (tuple, list), "partition")
        begin, end, group = check_sequence(parts, "partition", 3, "parts")
        check_integer(begin, "partition[0]"), check_integer(end, "partition[1]")
        for camera in check_sequence(check_type(group, (frozenset, set, tuple, list), "partition[2]"), "partition[2]"):
            check_integer(camera, "partition[2]: camera")
        early = [c for c, back in self.returns.items() if not self.dies.get(c, back) < back]
        if early:
            raise ValueError(f"cameras {early}: the restart in `returns` must be after the failure in `dies`")

    @property
    def cameras(self) -> set[int]:
        """All cameras that it names."""
        return {*self.dies, *self.joins, *self.returns, *self.partition[2]}

    def _is_down(self, camera: int, now: int) -> bool:
        """Return whether a camera that has started is down in a round."""
        return now >= self.dies.get(camera, now + 1) and now < self.returns.get(camera, now + 1)

    def _is_separated(self, a: int, b: int, now: int) -> bool:
        """Return whether two cameras are in different parts of the network in a round."""
        begin, end, group = self.partition
        return begin <= now < end and (a in group) != (b in group)


NO_FAULTS = NetworkFaults()


class NodeState(Protocol):
    """Interface of a node's state that `run_network` requires."""

    @property
    def done(self) -> bool: ...


State = TypeVar("State", bound=NodeState)


class NetworkRun(NamedTuple, Generic[State]):
    """Result of `run_network`.

    The last state of each node (None: never started), whether it was up at the end, the number of rounds, and the bytes
    sent and received by each node.
    """

    states: list[State | None]
    is_alive: list[bool]
    rounds: int
    sent: IntArray
    received: IntArray


def run_network(
    starts: Sequence[Callable[[], tuple[State, list[Packet]]]],
    step: Callable[[State, Inbox], tuple[State, list[Packet]]],
    network_faults: NetworkFaults,
    max_rounds: int,
    modify: Mapping[int, Callable[[bytes, int], bytes]] | None = None,
) -> NetworkRun[State]:
    """Run the nodes, one step per round, until all live ones are done.

    Args:
        starts: per node, creates its state and first packets.
        step: step function of a node.
        network_faults: faults of the network.
        max_rounds: maximum number of rounds after the last start.
        modify: camera -> function that modifies its packets, given the data and the receiver.
    """
    n, faults, modify = len(starts), network_faults, modify or {}
    rng = np.random.default_rng(faults.seed)
    states: list[State | None] = [None] * n
    in_transit: dict[int, list[tuple[int, int, bytes]]] = {}  # round of arrival -> (to, from, data)
    sent, received = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    rounds = 0
    last_start = max((*faults.joins.values(), *faults.returns.values()), default=0)
    for now in range(max_rounds + last_start + 1):
        inboxes: list[list[tuple[int, bytes]]] = [[] for _ in range(n)]
        for to, sender, data in in_transit.pop(now, []):
            inboxes[to].append((sender, data))
        active = False
        for c in range(n):
            state = None if now == faults.returns.get(c) else states[c]
            is_down = faults._is_down(c, now)
            active |= is_down and c in faults.returns
            if is_down or (state is not None and state.done):
                continue
            active = True
            if now < faults.joins.get(c, 0):
                continue
            received[c] += sum(len(data) for _, data in inboxes[c])
            states[c], packets = starts[c]() if state is None else step(state, inboxes[c])
            for packet in packets:
                # A packet with the same data for all receivers is sent once.
                copies = [modify[c](packet.data, to) for to in packet.to] if c in modify else [packet.data]
                sent[c] += sum(len(data) for data in copies)
                for k, to in enumerate(packet.to):
                    if rng.random() >= faults.loss and not faults._is_separated(c, to, now):
                        arrival = now + 1 + int(rng.integers(faults.delay + 1))
                        in_transit.setdefault(arrival, []).append((to, c, copies[k % len(copies)]))
        if not active:
            break
        rounds = now
    alive = [c not in faults.dies or c in faults.returns for c in range(n)]
    return NetworkRun(states, alive, rounds, sent, received)
