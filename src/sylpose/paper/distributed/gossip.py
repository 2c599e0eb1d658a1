"""One rotation at every camera of a sparse network: each hears its neighbours only. One camera's step.

What the centralised equation needs is a sum over the cameras, H and h; and it may as well be their mean. The cameras
agree on the mean of their evidence (56 numbers, 456 bytes with the header, per neighbour and round) and each solves
by itself. Average consensus as ADMM on the edges of the graph: for each neighbour j a camera i keeps z_ij and

    x_i = (a_i + Σ_j z_ij) / (1 + ρ d_i)          a_i its own evidence, d_i the number of its neighbours
    sends to j   q_ij = 2 ρ x_i - z_ij            and takes   z_ij <- 0.2 z_ij + 0.8 q_ji

Where nothing changes any more, every x is the mean, whatever the z were to start with. So a message that is lost or
late only costs time, and a camera that goes away takes its own evidence with it and nothing else, which holds neither
for averaging by weights (Metropolis) nor for push-sum. With ρ = 1.5 / √(λ_2 λ_max), of the graph's Laplacian, it is as
fast as accelerated averaging.

What is well formed and false cannot be told here, and so spoils everybody's answer: evidence has been mixed before it
arrives from anywhere but a neighbour.

Source: N. Bastianello, R. Carli, L. Schenato, M. Todescato, "Asynchronous distributed optimization over lossy networks
via relaxed ADMM: stability and linear convergence" (2021); the choice of ρ is ours, by experiment.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import shortest_path

from sylpose.moments import PairMoments
from sylpose.numerics.arrays import FloatArray
from sylpose.paper.distributed.evidence import EVIDENCE, evidence_of, packed, unpacked
from sylpose.paper.distributed.messages import Inbox, Message, Packet, encode, newest, read
from sylpose.paper.distributed.refine import PATIENCE
from sylpose.paper.so3 import minimize

__all__ = ["GossipState", "gossip_start", "gossip_step"]


RELAXATION = 0.8
STILL = 1e-12  # change, relative to x, that is none
# Rotations are as good as the best up to this much more cost: each camera has another mean, by rounding. Of mirrored ones
# all take that with the largest sum of entries, weighted by numbers that no mirror leaves alike.
EQUAL = 1e-10
_ORDER = np.sqrt([2.0, 3, 5, 7, 11, 13, 17, 19, 23]).reshape(3, 3)


class Edge(NamedTuple):
    """What a camera knows of a neighbour.

    Attributes:
        z: (56,) see above.
        still: the neighbour has seen no change for as long as news take to go everywhere.
        round: of its newest message. silent: rounds without one.
    """

    z: FloatArray
    still: bool
    round: int
    silent: int


@dataclass(frozen=True, eq=False)
class GossipState:
    """One camera of `gossip`.

    Attributes:
        neighbours: those that it may hear. edges: those that it does hear.
        n_cameras: of the network. diameter: links between those farthest apart.
        own, mean: (56,) its evidence, and what it takes for the mean of all: H (45 numbers, upper triangle), h, constant
            and weight.
        quiet: how often all neighbours were heard (but those that are still themselves) since the mean or any z changed.
        waiting: those not yet heard again.
        clean: no message of a neighbour was missed so far.
        rotation, information: (3, 3) as in `CentralizedSolution`; None until `done`, and where nobody has evidence. The
            information takes the mean times `n_cameras` for the sum.
        converged: this camera and its neighbours have been quiet for longer than news take to go everywhere.
        lingered: rounds since.
        refused: camera -> why a message was not read.
        round: steps made, at most `bound`. done: nothing will be sent any more.
    """

    camera: int
    neighbours: tuple[int, ...]
    n_cameras: int
    diameter: int
    penalty: float
    own: FloatArray
    bound: int
    mean: FloatArray
    edges: dict[int, Edge] = field(default_factory=dict)
    quiet: int = 0
    waiting: frozenset[int] = frozenset()
    clean: bool = True
    rotation: FloatArray | None = None
    information: FloatArray | None = None
    converged: bool = False
    lingered: int = 0
    refused: dict[int, str] = field(default_factory=dict)
    round: int = 0
    done: bool = False

    @property
    def used(self) -> tuple[int, ...]:
        """This camera and the neighbours that it hears; of those behind them it does not know."""
        return tuple(sorted({self.camera, *self.edges}))


def gossip_start(
    camera: int,
    n_cameras: int,
    graph: Iterable[tuple[int, int]],
    rotation: ArrayLike,
    moments: PairMoments,
    *,
    aim: bool = True,
    bound: int = 1000,
) -> tuple[GossipState, list[Packet]]:
    """A camera and its first messages.

    Args:
        camera: its number, from 0 on.
        graph: the pairs of all cameras 0 .. n_cameras - 1 that hear each other.
        rotation: (3, 3) Q of its camera_from_world. moments: its own.
        aim: as in `solve_centralized`.
        bound: rounds after which it gives up.

    Raises:
        ValueError: a graph with a camera that does not exist, or that is not connected.
    """
    laplacian = _laplacian(n_cameras, graph)
    distance = np.asarray(shortest_path(laplacian < 0, unweighted=True))
    cut_off = [str(c) for c in range(n_cameras) if not np.isfinite(distance[0, c])]
    if cut_off:
        raise ValueError(f"the graph is not connected: cameras {', '.join(cut_off)} cannot reach camera 0")
    values = np.linalg.eigvalsh(laplacian)
    penalty = 1.5 / float(np.sqrt(values[1] * values[-1])) if n_cameras > 1 else 1.0
    own = packed(evidence_of(rotation, moments, aim=aim))
    neighbours = tuple(int(c) for c in np.flatnonzero(laplacian[camera] < 0))
    s = GossipState(camera, neighbours, n_cameras, int(distance.max()), penalty, own, bound, own)
    return s, _packets(s)


def gossip_step(state: GossipState, inbox: Inbox) -> tuple[GossipState, list[Packet]]:
    """Hear the neighbours, mend the mean, say what it is; solve when all is still."""
    s = state
    inbox = [(c, data) for c, data in inbox if c in s.neighbours]
    messages, refused = read(inbox, (EVIDENCE,), s.refused)
    news = newest(messages, {c: e.round for c, e in s.edges.items()})
    edges, change = {}, 0.0
    for c in sorted({*s.edges, *news}):
        old, message = s.edges.get(c), news.get(c)
        if message is not None:
            z = np.zeros(EVIDENCE) if old is None else old.z
            step = RELAXATION * (message.values - z)
            edges[c] = Edge(z + step, message.final, message.round, 0)
            change = max(change, float(np.linalg.norm(step)) / (2 * s.penalty))
        elif old is not None and (old.silent < PATIENCE or old.still):
            edges[c] = old._replace(silent=old.silent + 1)
    total = np.sum([s.own, *(e.z for e in edges.values())], axis=0)
    mean = total / (1 + s.penalty * len(edges))
    change = max(change, float(np.linalg.norm(mean - s.mean)))
    if change > STILL * np.linalg.norm(mean) or edges.keys() != s.edges.keys():
        quiet, waiting = 0, frozenset(edges)
    else:
        quiet, waiting = s.quiet, s.waiting - news.keys() - {c for c, e in edges.items() if e.still}
        if not waiting:
            quiet, waiting = quiet + 1, frozenset(edges)
    converged = quiet > s.diameter and all(e.still for e in edges.values())
    clean = s.clean and (news.keys() == edges.keys() == set(s.neighbours) or s.round == 0)
    lingered = s.lingered + 1 if converged else 0
    s = replace(
        s,
        mean=mean,
        edges=edges,
        quiet=quiet,
        waiting=waiting,
        clean=clean,
        converged=converged,
        lingered=lingered,
        refused=refused,
        round=s.round + 1,
        # The last message may get lost: it is repeated, for much longer where messages do get lost.
        done=s.round + 1 >= s.bound or lingered > (2 if clean else PATIENCE),
    )
    return _solved(s) if s.done else s, _packets(s)


def _packets(s: GossipState) -> list[Packet]:
    out = []
    for c in s.neighbours:
        z = s.edges[c].z if c in s.edges else np.zeros(EVIDENCE)
        message = Message(s.round, s.clean, s.quiet > s.diameter, 2 * s.penalty * s.mean - z)
        out.append(Packet((c,), encode(s.camera, message)))
    return out


def _solved(s: GossipState) -> GossipState:
    evidence = unpacked(s.n_cameras * s.mean)
    if not (evidence.scale > 0 and evidence.weight > 0):
        return replace(s, converged=False)
    candidates = minimize(evidence.H, evidence.h)[0]
    costs = evidence.cost(candidates) / evidence.scale
    best = candidates[costs < costs.min() + EQUAL]
    rotation = best[np.argmax((_ORDER * best).sum(axis=(1, 2)))]
    return replace(s, rotation=rotation, information=evidence.at(rotation).information)


def _laplacian(n: int, graph: Iterable[tuple[int, int]]) -> FloatArray:
    out = np.zeros((n, n))
    for i, j in graph:
        if not (0 <= i < n and 0 <= j < n and i != j):
            raise ValueError(f"the graph joins camera {i} to {j}: expected two different ones of 0 to {n - 1}")
        out[i, j] = out[j, i] = -1
    return out - np.diag(out.sum(axis=1))
