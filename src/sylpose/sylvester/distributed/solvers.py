"""Distributed estimators: nodes that exchange bytes over a simulated network, and their common result.

    solve_exchange    every node sends its moments to all others
    solve_gossip      the same over a sparse network: nodes pass moments on
    solve_refine      the paper's refinement: nodes exchange 3x3 matrices in rounds

The steps of a node are in `exchange` and `refine`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.validation import check_integer, check_list, check_rotations, check_sequence, check_type
from sylpose.moments import PairMoments
from sylpose.packets import MAX_ROUNDS, NO_FAULTS, Inbox, NetworkFaults, NetworkRun, NodeState, Packet, run_network
from sylpose.results import RotationEstimate
from sylpose.status import Status
from sylpose.sylvester.centralized import find_unobservable_rotations, rotation_status
from sylpose.sylvester.distributed.exchange import Graph, NodeEstimate, start_exchange, step_exchange
from sylpose.sylvester.distributed.refine import start_refine, step_refine
from sylpose.sylvester.orthographic import build_cost, compute_views
from sylpose.sylvester.so3 import is_certified

AGREEMENT_ANGLE = 1e-7  # radians between the results of nodes that agree: ten times each node's tolerance (choice)


class SolverState(NodeState, Protocol):
    """Interface of a node's state, common to all solvers."""

    @property
    def estimate(self) -> NodeEstimate | None: ...


State = TypeVar("State", bound=SolverState)


@dataclass(frozen=True, eq=False, repr=False)
class DistributedSolution(RotationEstimate):
    """Common result of C nodes.

    Attributes:
        status: `NOT_CONVERGED` unless all live nodes have one rotation; `NOT_CONSISTENT` if the set of faulty cameras
            is uncertain; otherwise that of the centralized estimator: `ROTATION_NOT_OBSERVABLE`, `NOT_CERTIFIED` or
            `OK`.
        rotation: (3, 3) common rotation, X_j = R X_i + t in the world frame, of the first live node. NaN if none has a
            result.
        information, unobservable: (3, 3) and (k, 3) as in `CentralizedSolution`, of that node.
        iterations: rounds until the last node was done.
        certified: multipliers certify `rotation` as the global optimum for the cameras in `used`. Checked with the
            moments of all cameras, which no node of `refine` has.
        rotations: (C, 3, 3) result of each node; NaN without one.
        converged: (C,) whether each node has a result.
        spread: largest angle between `rotation` and that of another live node, radians.
        used: the cameras whose evidence is in `rotation`.
        faults: camera -> its fault (`camera_faults`), as a sentence.
        sent, received: (C,) bytes; a packet to several nodes is sent once.
    """

    certified: bool
    rotations: FloatArray
    converged: BoolArray
    spread: float
    used: tuple[int, ...]
    faults: dict[int, str]
    sent: IntArray
    received: IntArray

    @property
    def rounds(self) -> int:
        """Number of rounds (same as `iterations`)."""
        return self.iterations


def solve_exchange(
    rotations: ArrayLike,
    moments: Sequence[PairMoments],
    *,
    aim: bool = True,
    max_rounds: int = 1000,
    network_faults: NetworkFaults = NO_FAULTS,
) -> DistributedSolution:
    """Run "exchange": every node sends its moments to all others and solves with those received.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments.
        aim: as in `solve_centralized`.
        max_rounds: maximum number of rounds. One suffices unless messages are lost or late.
        network_faults: faults of the network.

    Returns:
        The common result of the nodes: that of `solve_robust`, to the bit.

    Raises:
        ValueError: as `solve_centralized`, the number of rounds is invalid, or the faults name other cameras.
    """
    return _solve(rotations, moments, aim, max_rounds, network_faults, start_exchange, step_exchange)


def solve_gossip(
    rotations: ArrayLike,
    moments: Sequence[PairMoments],
    *,
    graph: Graph | None = None,
    aim: bool = True,
    max_rounds: int = 1000,
    network_faults: NetworkFaults = NO_FAULTS,
) -> DistributedSolution:
    """Run "gossip": `solve_exchange` over a sparse network, in which nodes pass moments on to their neighbors.

    Args:
        rotations, moments, aim, max_rounds, network_faults: as in `solve_exchange`.
        graph: pairs of connected cameras; None for a ring in the given order.

    Returns:
        The common result of the nodes: that of `solve_robust`, to the bit.

    Raises:
        ValueError: as `solve_exchange`, or the graph is not connected.
    """
    n = len(check_list(moments, PairMoments, "moments"))
    pairs = [(c, (c + 1) % n) for c in range(n if n > 2 else n - 1)] if graph is None else _check_graph(graph, n)
    start = partial(start_exchange, graph=pairs)
    return _solve(rotations, moments, aim, max_rounds, network_faults, start, step_exchange)


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
    then `NOT_CERTIFIED`.

    Args:
        rotations, moments, aim, max_rounds, network_faults: as in `solve_exchange`.

    Returns:
        The common result of the nodes: that of `solve_centralized`, or of `solve_robust` if it does not fit a camera.

    Raises:
        ValueError: as `solve_exchange`.
    """
    return _solve(rotations, moments, aim, max_rounds, network_faults, start_refine, step_refine)


def _solve(
    rotations: ArrayLike,
    moments: Sequence[PairMoments],
    aim: bool,
    max_rounds: int,
    network_faults: NetworkFaults,
    start: Callable[..., tuple[State, list[Packet]]],
    step: Callable[[State, Inbox], tuple[State, list[Packet]]],
) -> DistributedSolution:
    """Check the input as the centralized estimator does, run the nodes and combine their results."""
    moments = check_list(moments, PairMoments, "moments")
    Q = check_rotations(rotations, len(moments))
    build_cost(compute_views(Q, moments, aim=aim))
    max_rounds = check_integer(max_rounds, "max_rounds", minimum=1, maximum=MAX_ROUNDS)
    unknown = check_type(network_faults, NetworkFaults, "network_faults").cameras - {*range(len(Q))}
    if unknown:
        raise ValueError(f"network_faults: no cameras {sorted(unknown)}; there are cameras 0 to {len(Q) - 1}")
    starts = [partial(start, c, Q, moments[c], aim=aim) for c in range(len(Q))]
    return _combine_results(Q, moments, aim, run_network(starts, step, network_faults, max_rounds))


def _check_graph(graph: Graph, n: int) -> list[tuple[int, int]]:
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
    Q: FloatArray, moments: Sequence[PairMoments], aim: bool, outcome: NetworkRun[State]
) -> DistributedSolution:
    estimates = [None if s is None else s.estimate for s in outcome.states]
    live = [v for v, alive in zip(estimates, outcome.is_alive, strict=True) if alive]
    good = [v for v in live if v is not None]
    nothing = np.full((3, 3), np.nan)
    first = good[0] if good else NodeEstimate(nothing, np.zeros((3, 3)), {}, {}, True)
    weights = dict(sorted((c, w) for v in good for c, w in v.weights.items()))
    used = tuple(weights)
    certified, spread = False, 0.0 if good else np.inf
    if used:
        spread = max(float(Rotation.from_matrix(first.rotation.T @ v.rotation).magnitude()) for v in good)
        q = build_cost(compute_views(Q[list(used)], [moments[c].scale_weights(w) for c, w in weights.items()], aim=aim))
        certified = bool(q.is_better_than_zero(first.rotation)) and is_certified(q.H, q.h, first.rotation)
    n_used = sum(moments[c].count > 0 for c in used)
    unobservable = find_unobservable_rotations(first.information, first.rotation, n_used)
    agreed = len(good) == len(live) > 0 and spread < AGREEMENT_ANGLE
    is_consistent = not agreed or all(v.is_consistent for v in good)
    status = rotation_status(agreed, certified, unobservable) if is_consistent else Status.NOT_CONSISTENT
    common = status, first.rotation, first.information, unobservable, outcome.rounds
    rotations = np.array([nothing if v is None else v.rotation for v in estimates])
    converged = np.array([v is not None for v in estimates])
    faults = dict(sorted((c, text) for v in good for c, text in v.faults.items()))
    nodes = rotations, converged, spread, used, faults
    return DistributedSolution(*common, certified, *nodes, outcome.sent, outcome.received)
