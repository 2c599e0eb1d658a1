"""Simulation of the distributed estimators in one process: nodes that exchange bytes over a network with faults.

    solve_exchange, solve_refine, solve_gossip    one call each, without faults by default
    run_network                                   steps of any nodes, over any network

The steps of a node are in `exchange`, `refine` and `gossip`; this module transports and counts their packets and
evaluates the results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, Protocol, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sylpose.display import format_optimality
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import check_rotations
from sylpose.geometry.validation import (
    check_choice,
    check_integer,
    check_list,
    check_number,
    check_sequence,
    check_type,
)
from sylpose.moments import PairMoments
from sylpose.results import RotationEstimate, Status
from sylpose.sylvester.centralized import find_unobservable_rotations, rotation_status
from sylpose.sylvester.distributed.exchange import start_exchange, step_exchange
from sylpose.sylvester.distributed.fault_decision import NO_ESTIMATE, NodeEstimate
from sylpose.sylvester.distributed.fault_injection import PacketFault, inject_fault
from sylpose.sylvester.distributed.gossip import start_gossip, step_gossip
from sylpose.sylvester.distributed.messages import Inbox, Packet
from sylpose.sylvester.distributed.refine import start_refine, step_refine
from sylpose.sylvester.orthographic import build_cost, compute_views
from sylpose.sylvester.so3 import is_certified

__all__ = [
    "DistributedSolution",
    "NetworkFaults",
    "PacketFault",
    "run_network",
    "solve_exchange",
    "solve_gossip",
    "solve_refine",
]

MAX_ROUNDS = 10**6  # maximum number of rounds of a simulated network: more would take days (choice)
AGREEMENT_ANGLE = 1e-7  # radians between the results of nodes that agree: ten times each node's tolerance (choice)


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
        packet_faults: camera -> kind of fault of its packets (`inject_fault`).
        seed: seed of the random generator.

    Raises:
        ValueError: a share is outside [0, 1), a delay is negative, a restart precedes the failure, or a kind is
            unknown.
    """

    loss: float = 0.0
    delay: int = 0
    dies: Mapping[int, int] = field(default_factory=dict)
    joins: Mapping[int, int] = field(default_factory=dict)
    returns: Mapping[int, int] = field(default_factory=dict)
    partition: tuple[int, int, frozenset[int]] = (0, 0, frozenset())
    packet_faults: Mapping[int, PacketFault] = field(default_factory=dict)
    seed: int = 0

    def __post_init__(self) -> None:
        loss = check_number(self.loss, "loss", minimum=0.0, maximum=1.0)
        if loss == 1.0:
            raise ValueError(f"loss must be in [0, 1), got {self.loss}")
        check_integer(self.delay, "delay", maximum=MAX_ROUNDS)
        check_integer(self.seed, "seed")
        for name in ("dies", "joins", "returns", "packet_faults"):
            for camera, value in check_type(getattr(self, name), Mapping, name).items():
                check_integer(camera, f"{name}: camera")
                if name != "packet_faults":
                    check_integer(value, f"{name}[{camera}]", maximum=MAX_ROUNDS)
        parts = check_type(self.partition, (tuple, list), "partition")
        begin, end, group = check_sequence(parts, "partition", 3, "parts")
        check_integer(begin, "partition[0]"), check_integer(end, "partition[1]")
        for camera in check_sequence(check_type(group, (frozenset, set, tuple, list), "partition[2]"), "partition[2]"):
            check_integer(camera, "partition[2]: camera")
        early = [c for c, back in self.returns.items() if not self.dies.get(c, back) < back]
        if early:
            raise ValueError(f"cameras {early}: the restart in `returns` must be after the failure in `dies`")
        for kind in self.packet_faults.values():
            check_choice(kind, get_args(PacketFault), "packet_faults")


NO_FAULTS = NetworkFaults()


class StepState(Protocol):
    """Interface of a node's state that `run_network` requires."""

    @property
    def done(self) -> bool: ...


class SchemeState(StepState, Protocol):
    """Interface of a node's state, common to all schemes."""

    @property
    def estimate(self) -> NodeEstimate: ...
    @property
    def refused(self) -> dict[int, str]: ...


State = TypeVar("State", bound=StepState)
Scheme = TypeVar("Scheme", bound=SchemeState)


@dataclass(frozen=True, eq=False, repr=False)
class DistributedSolution(RotationEstimate):
    """Common result of C nodes.

    Attributes:
        status: `NOT_CONVERGED` unless all live nodes that were neither rejected nor found at fault converged to one
            rotation; `NOT_CONSISTENT` if for one of them the set of faulty cameras is uncertain; otherwise that of the
            centralized estimator: `ROTATION_NOT_OBSERVABLE`, `NOT_CERTIFIED` or `OK`.
        rotation: (3, 3) common rotation, X_j = R X_i + t in the world frame, of the first such node. NaN if none
            converged.
        information, unobservable: (3, 3) and (k, 3) as in `CentralizedSolution`, of that node.
        iterations: rounds until the last node was done.
        certified: multipliers certify `rotation` as the global optimum for the cameras in `used`. Checked with the
            moments of all cameras, which no node of `refine` has.
        rotations: (C, 3, 3) result of each node; NaN without one.
        converged: (C,) as reported by each node.
        spread: largest angle between `rotation` and that of another such node, radians.
        used: the cameras whose evidence is in `rotation`.
        faults: camera -> fault of its matches, as found by the other nodes.
        refused: camera -> reason why another node rejected its messages.
        sent, received: (C,) bytes; a packet to several nodes is sent once.
    """

    certified: bool
    rotations: FloatArray
    converged: BoolArray
    spread: float
    used: tuple[int, ...]
    faults: dict[int, str]
    refused: dict[int, str]
    sent: IntArray
    received: IntArray

    @property
    def rounds(self) -> int:
        """Number of rounds (same as `iterations`)."""
        return self.iterations

    def _extra_rows(self) -> list[tuple[str, str]]:
        distance_text = f"within {np.degrees(self.spread):.2g}° of each other"
        done = f"{int(self.converged.sum())} of {len(self.converged)} converged, {distance_text}"
        faults = [("at fault", f"camera {c}: {text}") for c, text in sorted(self.faults.items())]
        refused = [("refused", f"camera {c}: {text}") for c, text in sorted(self.refused.items())]
        sent = ("sent", f"{int(self.sent.sum())} bytes in total by all cameras")
        return [("cameras", done), sent, format_optimality(self.certified), *faults, *refused]


def solve_exchange(
    rotations: ArrayLike,
    moments: Sequence[PairMoments],
    *,
    aim: bool = True,
    rounds: int = 1,
    network_faults: NetworkFaults = NO_FAULTS,
) -> DistributedSolution:
    """Run "exchange": every node sends its moments to all others and solves with those received.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments.
        aim: as in `solve_centralized`; if True, nodes reject moments of points more than 89 degrees off the axis. If
            False, points may have any unit in which no moment exceeds 1e30: coordinates up to about 1e6.
        rounds: number of times the moments are sent; more than one if messages are lost.
        network_faults: faults of the network.

    Returns:
        The common result of the nodes.

    Raises:
        ValueError: as `solve_centralized`, or the number of rounds is invalid.
    """
    Q, moments = _check_input(rotations, moments, aim, network_faults)
    rounds = check_integer(rounds, "rounds", minimum=1, maximum=MAX_ROUNDS)
    starts = [lambda c=c: start_exchange(c, Q, moments[c], aim=aim, rounds=rounds) for c in range(len(Q))]
    return _combine_results(Q, moments, aim, run_network(starts, step_exchange, network_faults, rounds + 1))


def solve_refine(
    rotations: ArrayLike,
    moments: Sequence[PairMoments],
    *,
    aim: bool = True,
    max_rounds: int = 500,
    network_faults: NetworkFaults = NO_FAULTS,
) -> DistributedSolution:
    """Run "refine", the paper's scheme: nodes exchange 3x3 matrices in rounds.

    It finds a minimum, not always the global one if there are several (for instance collinear points): the status is
    then `NOT_CERTIFIED`. For random matches it may find none.

    Args:
        rotations, moments, aim, network_faults: as in `solve_exchange`.
        max_rounds: maximum number of rounds.

    Returns:
        The common result of the nodes.

    Raises:
        ValueError: as `solve_exchange`.
    """
    Q, moments = _check_input(rotations, moments, aim, network_faults)
    max_rounds = check_integer(max_rounds, "max_rounds", minimum=1, maximum=MAX_ROUNDS)
    cameras = range(len(Q))
    starts = [lambda c=c: start_refine(c, cameras, Q[c], moments[c], aim=aim, max_rounds=max_rounds) for c in cameras]
    return _combine_results(Q, moments, aim, run_network(starts, step_refine, network_faults, max_rounds + 1))


def solve_gossip(
    rotations: ArrayLike,
    moments: Sequence[PairMoments],
    *,
    graph: Iterable[tuple[int, int]] | None = None,
    aim: bool = True,
    max_rounds: int = 1000,
    network_faults: NetworkFaults = NO_FAULTS,
) -> DistributedSolution:
    """Run "gossip": average consensus of the evidence over a graph.

    Args:
        rotations, moments, aim, network_faults: as in `solve_exchange`.
        graph: pairs of connected cameras; None for a ring in the given order.
        max_rounds: maximum number of rounds.

    Returns:
        The common result of the nodes.

    Raises:
        ValueError: as `solve_exchange`, or the graph is not connected.
    """
    Q, moments = _check_input(rotations, moments, aim, network_faults)
    max_rounds = check_integer(max_rounds, "max_rounds", minimum=1, maximum=MAX_ROUNDS)
    n = len(Q)
    pairs = [(c, (c + 1) % n) for c in range(n)][: n if n > 2 else n - 1] if graph is None else _check_graph(graph, n)
    starts = [lambda c=c: start_gossip(c, n, pairs, Q[c], moments[c], aim=aim, max_rounds=max_rounds) for c in range(n)]
    return _combine_results(Q, moments, aim, run_network(starts, step_gossip, network_faults, max_rounds + 1))


class SimulationResult(NamedTuple, Generic[State]):
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
    packet_modifiers: Mapping[int, Callable[[bytes, int], bytes]] | None = None,
) -> SimulationResult[State]:
    """Run the nodes, one step per round, until all live ones are done.

    Args:
        starts: per node, creates its state and first packets.
        step: step function of a node.
        network_faults: faults of the network.
        max_rounds: maximum number of rounds after the last start.
        packet_modifiers: camera -> function that falsifies its packets, given the data and the receiver.
    """
    n = len(starts)
    rng = np.random.default_rng(network_faults.seed)
    states: list[State | None] = [None] * n
    in_transit: dict[int, list[tuple[int, int, bytes]]] = {}  # round of arrival -> (to, from, data)
    sent, received = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    rounds = 0
    last = max((*network_faults.joins.values(), *network_faults.returns.values()), default=0)
    begin, end, group = network_faults.partition
    for now in range(max_rounds + last + 1):
        inboxes: list[list[tuple[int, bytes]]] = [[] for _ in range(n)]
        for to, sender, data in in_transit.pop(now, []):
            inboxes[to].append((sender, data))
        active = False
        for c in range(n):
            state = states[c]
            restart_round = network_faults.returns.get(c)
            if now == restart_round:
                state = None
            dead = now >= network_faults.dies.get(c, now + 1) and (restart_round is None or now < restart_round)
            active |= dead and restart_round is not None
            if dead or (state is not None and state.done):
                continue
            active = True
            if now < network_faults.joins.get(c, 0):
                continue
            received[c] += sum(len(data) for _, data in inboxes[c])
            states[c], packets = starts[c]() if state is None else step(state, inboxes[c])
            for packet in packets:
                kind = network_faults.packet_faults.get(c)
                for k, to in enumerate(packet.to):
                    # A packet with the same data for all receivers is sent once.
                    if packet_modifiers is not None and c in packet_modifiers:
                        data = packet_modifiers[c](packet.data, to)
                        sent[c] += len(data)
                    elif k == 0 or kind == "two-faced":
                        data = packet.data if kind is None else inject_fault(kind, packet.data, to, rng)
                        sent[c] += len(data)
                    if rng.random() >= network_faults.loss and not (
                        begin <= now < end and (c in group) != (to in group)
                    ):
                        delay = int(rng.integers(network_faults.delay + 1))
                        in_transit.setdefault(now + 1 + delay, []).append((to, c, data))
        if not active:
            break
        rounds = now
    alive = [c not in network_faults.dies or c in network_faults.returns for c in range(n)]
    return SimulationResult(states, alive, rounds, sent, received)


def _check_input(
    rotations: ArrayLike, moments: Sequence[PairMoments], aim: bool, network_faults: NetworkFaults
) -> tuple[FloatArray, list[PairMoments]]:
    """Check the input and return rotations and moments; raises all errors of the centralized estimator."""
    moments = check_list(moments, PairMoments, "moments")
    Q = check_rotations(rotations, len(moments))
    build_cost(compute_views(Q, moments, aim=aim))
    faults = check_type(network_faults, NetworkFaults, "network_faults")
    unknown = {*faults.dies, *faults.joins, *faults.returns, *faults.packet_faults, *faults.partition[2]} - set(
        range(len(Q))
    )
    if unknown:
        raise ValueError(f"network_faults: no cameras {sorted(unknown)}; there are cameras 0 to {len(Q) - 1}")
    return Q, moments


def _check_graph(graph: Iterable[tuple[int, int]], n: int) -> list[tuple[int, int]]:
    """Return the pairs of cameras.

    Raises:
        TypeError, ValueError: the graph does not consist of pairs of cameras.
    """
    out = []
    for k, pair in enumerate(check_sequence(graph, "graph")):
        a, b = check_sequence(pair, f"graph[{k}]", 2, "ends")
        out.append((check_integer(a, f"graph[{k}]", maximum=n - 1), check_integer(b, f"graph[{k}]", maximum=n - 1)))
    return out


def _combine_results(
    Q: FloatArray, moments: Sequence[PairMoments], aim: bool, outcome: SimulationResult[Scheme]
) -> DistributedSolution:
    states = outcome.states
    estimates = [NO_ESTIMATE if s is None else s.estimate for s in states]
    refused = {c: why for s in reversed(states) if s is not None for c, why in s.refused.items()}
    accepted = [c for c, alive in enumerate(outcome.is_alive) if alive and c not in refused]
    faults = {c: why for k in reversed(accepted) for c, why in estimates[k].faults.items() if c not in refused}
    without_faults = [c for c in accepted if c not in faults]
    good = [v for c in without_faults if (v := estimates[c]).converged and v.rotation is not None]
    used = tuple(sorted({c for v in good for c in v.used}))
    rotation, information, certified, spread = np.full((3, 3), np.nan), np.zeros((3, 3)), False, np.inf
    if good and (first := good[0]).rotation is not None and first.information is not None:
        rotation, information = first.rotation, first.information
        others = [v.rotation for v in good if v.rotation is not None]
        spread = max(float(Rotation.from_matrix(rotation.T @ other).magnitude()) for other in others)
        weights = dict(sorted((c, w) for v in good for c, w in v.weights.items()))
        weighted = [moments[c].scale_weights(w) for c, w in weights.items()]
        certified = _is_certified(Q[list(weights)], weighted, aim, rotation)
    unobservable = find_unobservable_rotations(information, rotation, sum(moments[c].count > 0 for c in used))
    agreed = len(good) == len(without_faults) > 0 and spread < AGREEMENT_ANGLE
    status = rotation_status(agreed, certified, unobservable)
    return DistributedSolution(
        status=status if not agreed or all(v.consistent for v in good) else Status.NOT_CONSISTENT,
        rotation=rotation,
        information=information,
        unobservable=unobservable,
        iterations=outcome.rounds,
        certified=certified,
        rotations=np.array([np.full((3, 3), np.nan) if v.rotation is None else v.rotation for v in estimates]),
        converged=np.array([v.converged for v in estimates]),
        spread=spread,
        used=used,
        faults=dict(sorted(faults.items())),
        refused=dict(sorted(refused.items())),
        sent=outcome.sent,
        received=outcome.received,
    )


def _is_certified(Q: FloatArray, moments: Sequence[PairMoments], aim: bool, rotation: FloatArray) -> bool:
    """Return whether a rotation is certified as the unique global minimum and better than the zero matrix."""
    q = build_cost(compute_views(Q, moments, aim=aim))
    return bool(q.is_better_than_zero(rotation)) and is_certified(q.H, q.h, rotation)
