"""Distributed estimator "gossip": average consensus of the evidence over a sparse network, one node's step.

The centralized equation requires the sum of H and h over the cameras, or equivalently their mean. The nodes agree on
the mean of their evidence (56 numbers, 456 bytes with the header, per neighbor and round) and each solves by itself.
Once the means are nearly constant, the nodes also agree on the mean of the surface sums at that rotation
(`sylvester.depth_bias`; 81 more numbers), which gives the covariance of the centralized estimator.

The average consensus is ADMM on the edges of the graph: for each neighbor j a node i keeps z_ij and

    x_i = (a_i + Σ_j z_ij) / (1 + ρ d_i)          a_i its own evidence, d_i the number of its neighbors
    sends to j   q_ij = 2 ρ x_i - z_ij            and sets    z_ij <- 0.2 z_ij + 0.8 q_ji

At a fixed point every x is the mean, for any initial z. So a lost or delayed message only costs time, and a node that
leaves removes only its own evidence. Neither holds for averaging by weights (Metropolis) nor for push-sum. With
ρ = 1.5 / √(λ_2 λ_max), eigenvalues of the graph's Laplacian, it is as fast as accelerated averaging.

Mixed evidence does not identify the faulty camera. A node whose matches disagree with any rotation or with the common
one (`max_fault_score`) therefore requests the evidence. From then on all nodes forward the moments of the cameras, one
camera's per message, the least often forwarded first, until all nodes have all moments; each then solves with fault
detection. A node that forwards false moments is not detected. A node accepts only a result that its neighbors also
have.

Source: N. Bastianello, R. Carli, L. Schenato, M. Todescato, "Asynchronous distributed optimization over lossy networks
via relaxed ADMM: stability and linear convergence" (2021); the choice of ρ is ours, by experiment.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import shortest_path

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.sylvester.affine_consensus import AffineFits, fit_affine_maps
from sylpose.sylvester.camera_faults import FULL_WEIGHT_SCORE, max_fault_score
from sylpose.sylvester.depth_bias import compute_surface_sums, information_from_sums
from sylpose.sylvester.distributed.evidence import (
    EVIDENCE_SIZE,
    SURFACE_SUMS_SIZE,
    compute_evidence,
    pack_evidence,
    pack_sums,
    relative_noise,
    unpack_evidence,
    unpack_sums,
)
from sylpose.sylvester.distributed.fault_decision import NO_ESTIMATE, NodeEstimate
from sylpose.sylvester.distributed.flooding import (
    FLOODING_SIZE,
    FloodingState,
    make_packets,
    process_messages,
    start_flooding,
)
from sylpose.sylvester.distributed.lockstep import MAX_MISSED_ROUNDS
from sylpose.sylvester.distributed.messages import Inbox, Message, Packet, decode_inbox, encode, select_newest
from sylpose.sylvester.orthographic import Views, compute_views
from sylpose.sylvester.so3 import QuadraticCost, minimize

__all__ = ["GossipState", "start_gossip", "step_gossip"]


# Number of values in the final consensus: evidence, surface sums, and the weight of the nodes that have sent these
# (derived).
CONSENSUS_SIZE = EVIDENCE_SIZE + SURFACE_SUMS_SIZE + 1
RELAXATION = 0.8  # weight of new values in z: below 1 because of lost and delayed messages (choice)
CHANGE_TOLERANCE = 1e-12  # convergence tolerance of the change, relative to x: well above rounding's 1e-16 (choice)
# Rotations within this cost of the best are equivalent, as the means of the nodes differ by rounding. Among mirrored
# ones all nodes select the one with the largest weighted sum of entries; the weights distinguish all mirror images
# (choice: well above rounding's 1e-16).
EQUAL_COST = 1e-10
# Surface sums are sent when the evidence changes by less than `SURFACES_START_CHANGE`, and again if it then changes by
# more than `SURFACES_UPDATE_CHANGE`; both relative. They are scaled by `SURFACES_SCALE` relative to the evidence for
# the convergence test: a covariance need not be accurate to 1e-12 (choice).
SURFACES_START_CHANGE, SURFACES_UPDATE_CHANGE, SURFACES_SCALE = 1e-4, 1e-10, 1e-4
# All nodes have sent surface sums if the weight of those sent equals the total weight to this share (choice).
WEIGHT_TOLERANCE = 1e-6
_TIE_WEIGHTS = np.sqrt([2.0, 3, 5, 7, 11, 13, 17, 19, 23]).reshape(3, 3)


class Edge(NamedTuple):
    """State of the link to a neighbor.

    Attributes:
        z: (137,) ADMM variable of the edge.
        is_quiet: the neighbor has reported no change for more rounds than the graph's diameter.
        round: round of its newest message.
        missed_rounds: number of rounds without a message.
    """

    z: FloatArray
    is_quiet: bool
    round: int
    missed_rounds: int


@dataclass(frozen=True, eq=False)
class GossipState:
    """State of one node of `gossip`.

    Attributes:
        camera_rotation, moments: (3, 3) Q and pair moments, sent on request.
        aim: as in `solve_centralized`.
        views, fits: second moments and affine maps of `moments`.
        camera: number of this node.
        neighbors: numbers of the neighbors in the graph.
        n_cameras: number of nodes in the network.
        diameter: diameter of the graph, in links.
        penalty: ρ.
        own_values, mean: (137,) evidence of this node, and its estimate of the mean of all: H (45 numbers, upper
            triangle), h, constant and weight; then the surface sums (80 numbers) and the weight again, 0 until they are
            computed.
        max_rounds: maximum number of rounds.
        edges: neighbor -> link, for neighbors that are currently received.
        surfaces_mean: (56,) mean evidence at which the surface sums were last computed.
        quiet_rounds: number of times that all active neighbors were received since the mean or any z changed.
        waiting: neighbors not yet received since `quiet_rounds` was last increased.
        no_loss: no message of a neighbor was missed so far.
        flooding: moments received, once the evidence was requested (`flooding`).
        estimate: the result; `converged` once this node and its neighbors have been unchanged for more rounds than the
            diameter. The information uses the mean times `n_cameras` as the sum; the weights contain only this node and
            its neighbors.
        rounds_converged: number of rounds since convergence.
        refused: camera -> reason why a message was rejected.
        round: number of steps so far, at most `max_rounds`.
        done: nothing more will be sent.
    """

    camera_rotation: FloatArray
    moments: PairMoments
    aim: bool
    views: Views
    fits: AffineFits
    camera: int
    neighbors: tuple[int, ...]
    n_cameras: int
    diameter: int
    penalty: float
    own_values: FloatArray
    max_rounds: int
    mean: FloatArray
    edges: dict[int, Edge] = field(default_factory=dict)
    surfaces_mean: FloatArray = field(default_factory=lambda: np.zeros(EVIDENCE_SIZE))
    quiet_rounds: int = 0
    waiting: frozenset[int] = frozenset()
    no_loss: bool = True
    flooding: FloodingState | None = None
    estimate: NodeEstimate = NO_ESTIMATE
    rounds_converged: int = 0
    refused: dict[int, str] = field(default_factory=dict)
    round: int = 0
    done: bool = False


def start_gossip(
    camera: int,
    n_cameras: int,
    graph: Iterable[tuple[int, int]],
    rotation: ArrayLike,
    moments: PairMoments,
    *,
    aim: bool = True,
    max_rounds: int = 1000,
) -> tuple[GossipState, list[Packet]]:
    """Create a node and its first messages.

    Args:
        camera: number of this node, from 0.
        n_cameras: number of nodes.
        graph: pairs of nodes 0 .. n_cameras - 1 that are connected.
        rotation: (3, 3) Q of this node's camera_from_world.
        moments: pair moments of this node.
        aim: as in `solve_centralized`.
        max_rounds: maximum number of rounds.

    Raises:
        ValueError: the graph contains a node that does not exist, or is not connected.
    """
    laplacian = _build_laplacian(n_cameras, graph)
    distance = np.asarray(shortest_path(laplacian < 0, unweighted=True))
    unreachable = [str(c) for c in range(n_cameras) if not np.isfinite(distance[0, c])]
    if unreachable:
        raise ValueError(f"the graph is not connected: cameras {', '.join(unreachable)} cannot reach camera 0")
    values = np.linalg.eigvalsh(laplacian)
    penalty = 1.5 / float(np.sqrt(values[1] * values[-1])) if n_cameras > 1 else 1.0
    Q = np.array(rotation, dtype=float)
    own_values = np.concatenate(
        [pack_evidence(compute_evidence(Q, moments, aim=aim)), np.zeros(CONSENSUS_SIZE - EVIDENCE_SIZE)]
    )
    views = compute_views(Q[None], [moments], aim=aim)
    fits = fit_affine_maps(views)
    neighbors = tuple(int(c) for c in np.flatnonzero(laplacian[camera] < 0))
    diameter = int(distance.max())
    s = GossipState(
        Q,
        moments,
        aim,
        views,
        fits,
        camera,
        neighbors,
        n_cameras,
        diameter,
        penalty,
        own_values,
        max_rounds,
        own_values,
    )
    return _request_evidence(s) if max_fault_score(fits) > FULL_WEIGHT_SCORE else (s, _make_packets(s))


def step_gossip(state: GossipState, inbox: Inbox) -> tuple[GossipState, list[Packet]]:
    """Process the messages received; update and send the mean, or forward evidence; solve at convergence."""
    s = replace(state, round=state.round + 1)
    inbox = [(c, data) for c, data in inbox if c in s.neighbors]
    messages, refused = decode_inbox(inbox, (EVIDENCE_SIZE, CONSENSUS_SIZE, FLOODING_SIZE), s.refused)
    s = replace(s, refused=refused)
    if s.flooding is not None:
        return _forward_evidence(s, s.flooding, messages, {c for c, _ in inbox})
    if any(m.values.size == FLOODING_SIZE for m in messages.values()):
        s, packets = _request_evidence(s)
        return (s, packets) if s.flooding is None else _forward_evidence(s, s.flooding, messages, {c for c, _ in inbox})
    new_messages = select_newest(messages, {c: e.round for c, e in s.edges.items()})
    edges, change = {}, 0.0
    for c in sorted({*s.edges, *new_messages}):
        old, message = s.edges.get(c), new_messages.get(c)
        if message is not None:
            z = np.zeros(CONSENSUS_SIZE) if old is None else old.z
            step = RELAXATION * (np.pad(message.values, (0, CONSENSUS_SIZE - message.values.size)) - z)
            edges[c] = Edge(z + step, message.final, message.round, 0)
            change = max(change, float(np.linalg.norm(step)) / (2 * s.penalty))
        elif old is not None and (old.missed_rounds < MAX_MISSED_ROUNDS or old.is_quiet):
            edges[c] = old._replace(missed_rounds=old.missed_rounds + 1)
    total = np.sum([s.own_values, *(e.z for e in edges.values())], axis=0)
    mean = total / (1 + s.penalty * len(edges))
    change = max(change, float(np.linalg.norm(mean - s.mean)))
    if change > CHANGE_TOLERANCE * np.linalg.norm(mean) or edges.keys() != s.edges.keys():
        quiet, waiting = 0, frozenset(edges)
    else:
        quiet, waiting = s.quiet_rounds, s.waiting - new_messages.keys() - {c for c, e in edges.items() if e.is_quiet}
        if not waiting:
            quiet, waiting = quiet + 1, frozenset(edges)
    all_surfaces_sent = abs(mean[-1] - mean[EVIDENCE_SIZE - 1]) <= WEIGHT_TOLERANCE * mean[EVIDENCE_SIZE - 1]
    converged = all_surfaces_sent and quiet > s.diameter and all(e.is_quiet for e in edges.values())
    clean = s.no_loss and (new_messages.keys() == edges.keys() == set(s.neighbors) or s.round == 1)
    rounds_converged = s.rounds_converged + 1 if converged else 0
    just_quiet = quiet > 0 and s.quiet_rounds == 0
    s = replace(
        s, mean=mean, edges=edges, quiet_rounds=quiet, waiting=waiting, no_loss=clean, rounds_converged=rounds_converged
    )
    if change < SURFACES_START_CHANGE * np.linalg.norm(mean):
        s = _add_surface_sums(s)
    if (
        just_quiet
        and (rotation := _solve_rotation(_total_evidence(s))) is not None
        and max_fault_score(s.fits, rotation) > FULL_WEIGHT_SCORE
    ):
        return _request_evidence(s)
    done = _is_over(s, rounds_converged)
    return replace(s, estimate=_current_estimate(s) if done else NO_ESTIMATE, done=done), _make_packets(s)


def _is_over(s: GossipState, rounds_converged: int) -> bool:
    """Return whether the node may stop: the last message is repeated, for longer if messages were lost."""
    return s.round >= s.max_rounds or rounds_converged > (2 if s.no_loss else MAX_MISSED_ROUNDS)


def _request_evidence(s: GossipState) -> tuple[GossipState, list[Packet]]:
    """Send this node's evidence, which makes its neighbors do so."""
    passing = start_flooding(s.camera, s.neighbors, s.n_cameras, s.camera_rotation, s.moments, s.aim)
    passing, packets = make_packets(passing, s.round, s.no_loss)
    return replace(s, flooding=passing, done=s.round >= s.max_rounds), packets


def _forward_evidence(
    s: GossipState, passing: FloodingState, messages: Mapping[tuple[int, int], Message], active: Collection[int]
) -> tuple[GossipState, list[Packet]]:
    # Consensus messages that are still in transit are ignored, not rejected.
    evidence_messages = {key: message for key, message in messages.items() if message.values.size == FLOODING_SIZE}
    passing = process_messages(passing, evidence_messages, active)
    clean = s.no_loss and all(n <= 1 for n in passing.missed_rounds.values())
    passing, packets = make_packets(passing, s.round, clean)
    s = replace(s, flooding=passing, no_loss=clean, estimate=passing.estimate, refused={**passing.refused, **s.refused})
    return replace(s, done=_is_over(s, passing.rounds_converged)), packets


def _make_packets(s: GossipState) -> list[Packet]:
    out = []
    for c in s.neighbors:
        z = s.edges[c].z if c in s.edges else np.zeros(CONSENSUS_SIZE)
        values = 2 * s.penalty * s.mean - z
        values = values if values[EVIDENCE_SIZE:].any() else values[:EVIDENCE_SIZE]
        message = Message(s.round, s.no_loss, s.quiet_rounds > s.diameter, values)
        out.append(Packet((c,), encode(s.camera, message)))
    return out


def _total_evidence(s: GossipState) -> QuadraticCost:
    """Return the evidence of all cameras."""
    return unpack_evidence(s.n_cameras * s.mean[:EVIDENCE_SIZE])


def _solve_rotation(evidence: QuadraticCost) -> FloatArray | None:
    """Return the rotation (3, 3) that minimizes the cost; None if there is no evidence, or it is invalid."""
    if not (evidence.scale > 0 and evidence.weight > 0):
        return None
    candidates = minimize(evidence.H, evidence.h)[0]
    costs = evidence.cost(candidates) / evidence.scale
    if not np.isfinite(costs).all():
        return None
    # Not `<`: a faulty node may send a constant so large that adding `EQUAL_COST` does not change it.
    best = candidates[costs <= costs.min() + EQUAL_COST]
    return np.asarray(best[np.argmax((_TIE_WEIGHTS * best).sum(axis=(1, 2)))])


def _current_estimate(s: GossipState) -> NodeEstimate:
    """Return the result for the current mean."""
    evidence = _total_evidence(s)
    rotation = _solve_rotation(evidence)
    weights = dict.fromkeys([s.camera, *s.edges], 1.0)
    if rotation is None or not s.rounds_converged:
        return NodeEstimate(rotation, weights=weights)
    noise = _evidence_noise(evidence, rotation)
    surfaces = s.n_cameras * s.mean[EVIDENCE_SIZE:-1] / (SURFACES_SCALE * np.linalg.norm(s.mean[:EVIDENCE_SIZE]))
    return NodeEstimate(rotation, information_from_sums(unpack_sums(surfaces, noise), noise), True, weights=weights)


def _add_surface_sums(s: GossipState) -> GossipState:
    """Add this node's surface sums at the current rotation to its values, unless they are up to date."""
    mean, own_evidence, surfaces = s.mean[:EVIDENCE_SIZE], s.own_values[:EVIDENCE_SIZE], np.zeros(SURFACE_SUMS_SIZE)
    size = float(np.linalg.norm(mean))
    if np.linalg.norm(mean - s.surfaces_mean) <= SURFACES_UPDATE_CHANGE * size:
        return s
    evidence = _total_evidence(s)
    if own_evidence[-1] > 0 and (rotation := _solve_rotation(evidence)) is not None:
        noise = _evidence_noise(evidence, rotation)
        surfaces = pack_sums(compute_surface_sums(s.views, rotation, float(evidence.size), noise), noise)
    return replace(
        s,
        own_values=np.concatenate([own_evidence, SURFACES_SCALE * size * surfaces, own_evidence[-1:]]),
        surfaces_mean=mean,
    )


def _evidence_noise(evidence: QuadraticCost, rotation: FloatArray) -> float:
    return relative_noise(float(evidence.cost(rotation)), float(evidence.size), float(evidence.weight))


def _build_laplacian(n: int, graph: Iterable[tuple[int, int]]) -> FloatArray:
    out = np.zeros((n, n))
    for i, j in graph:
        if not (0 <= i < n and 0 <= j < n and i != j):
            raise ValueError(f"the graph connects camera {i} to {j}: expected two different ones of 0 to {n - 1}")
        out[i, j] = out[j, i] = -1
    return out - np.diag(out.sum(axis=1))
