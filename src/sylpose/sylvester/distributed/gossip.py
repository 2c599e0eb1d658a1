"""One rotation at every camera of a sparse network: each hears its neighbours only. One camera's step.

What the centralised equation needs is a sum over the cameras, H and h; and it may as well be their mean. The cameras
agree on the mean of their evidence (56 numbers, 456 bytes with the header, per neighbour and round) and each solves
by itself. Once they are nearly still, each knows the rotation, and they agree as well on the mean of what surfaces may have
done to it (`sylvester.depth_bias`; 81 numbers more), for the covariance that the centralised estimator has.

Average consensus as ADMM on the edges of the graph: for each neighbour j a camera i keeps z_ij and

    x_i = (a_i + Σ_j z_ij) / (1 + ρ d_i)          a_i its own evidence, d_i the number of its neighbours
    sends to j   q_ij = 2 ρ x_i - z_ij            and takes   z_ij <- 0.2 z_ij + 0.8 q_ji

Where nothing changes any more, every x is the mean, whatever the z were to start with. So a message that is lost or
late only costs time, and a camera that goes away takes its own evidence with it and nothing else, which holds neither
for averaging by weights (Metropolis) nor for push-sum. With ρ = 1.5 / √(λ_2 λ_max), of the graph's Laplacian, it is as
fast as accelerated averaging.

Evidence has been mixed before it arrives from anywhere but a neighbour: who is at fault it does not tell. So a camera that
doubts, because no rotation explains its matches or because they do not allow what all have come to (`doubt_of`), calls for
the evidence: from then on all pass on each other's moments instead, one camera's with each message, what was passed on least
often first, until all have all; and each has the verdict on them. A camera that passes on what is false, of its own or of
others, is not found out; an answer that its neighbours do not have no camera takes for good.

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
from sylpose.sylvester.affine_consensus import AffineFits, affine_fits
from sylpose.sylvester.camera_faults import TRUSTED, doubt_of
from sylpose.sylvester.depth_bias import information_of, sums_of
from sylpose.sylvester.distributed.evidence import (
    EVIDENCE,
    SURFACES,
    evidence_of,
    noise_of,
    packed,
    packed_sums,
    unpacked,
    unpacked_sums,
)
from sylpose.sylvester.distributed.fault_decision import UNKNOWN, Verdict
from sylpose.sylvester.distributed.flooding import PASSED, Passing, begun, passed_on, passing_packets
from sylpose.sylvester.distributed.lockstep import PATIENCE
from sylpose.sylvester.distributed.messages import Inbox, Message, Packet, encode, newest, read
from sylpose.sylvester.orthographic import Views, views_of
from sylpose.sylvester.so3 import Quadratic, minimize

__all__ = ["GossipState", "gossip_start", "gossip_step"]


# What is agreed on in the end: evidence, surfaces, and the weight of those who have told of theirs (derived).
ALL = EVIDENCE + SURFACES + 1
RELAXATION = 0.8  # share of the news in z: below 1 for lost and late messages (choice)
STILL = 1e-12  # change, relative to x, that is none: well above rounding's 1e-16 (choice)
# Rotations are as good as the best up to this much more cost: each camera has another mean, by rounding. Of mirrored ones
# all take that with the largest sum of entries, weighted by numbers that no mirror leaves alike
# (choice: well above rounding's 1e-16).
EQUAL = 1e-10
# Surfaces are told of when the evidence changes by less than `NEAR`, and again where it is not the `SAME` any more; both
# relative. They count `LESS` than the evidence when it is asked whether anything changes: a covariance need not be known to
# 1e-12 (choice).
NEAR, SAME, LESS = 1e-4, 1e-10, 1e-4
# All have told of surfaces where the weights of these, and of all, are the same to this share (choice).
ALL_TOLD = 1e-6
_ORDER = np.sqrt([2.0, 3, 5, 7, 11, 13, 17, 19, 23]).reshape(3, 3)


class Edge(NamedTuple):
    """What a camera knows of a neighbour.

    Attributes:
        z: (137,) see above.
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
        camera_rotation, moments: (3, 3) Q and what it saw: shown when somebody calls for it. views: the same as it is used;
            fits: its affine image.
        neighbours: those that it may hear. edges: those that it does hear.
        n_cameras: of the network. diameter: links between those farthest apart.
        own, mean: (137,) what it has to say, and what it takes for the mean of all: H (45 numbers, upper triangle), h,
            constant and weight; what surfaces may have done, 0 until it is told: 80 numbers and the weight again.
        told: (56,) the mean of the evidence when it last told that.
        quiet: how often all neighbours were heard (but those that are still themselves) since the mean or any z changed.
        waiting: those not yet heard again.
        clean: no message of a neighbour was missed so far.
        passing: what it was shown, once somebody has called for that (`passing_on`).
        verdict: what it has come to; `converged` once this camera and its neighbours have been quiet for longer than news
            take to go everywhere. The information takes the mean times `n_cameras` for the sum, the weights speak of this
            camera and the neighbours that it hears: of those behind them it does not know.
        lingered: rounds since then.
        refused: camera -> why a message was not read.
        round: steps made, at most `bound`. done: nothing will be sent any more.
    """

    camera_rotation: FloatArray
    moments: PairMoments
    aim: bool
    views: Views
    fits: AffineFits
    camera: int
    neighbours: tuple[int, ...]
    n_cameras: int
    diameter: int
    penalty: float
    own: FloatArray
    bound: int
    mean: FloatArray
    edges: dict[int, Edge] = field(default_factory=dict)
    told: FloatArray = field(default_factory=lambda: np.zeros(EVIDENCE))
    quiet: int = 0
    waiting: frozenset[int] = frozenset()
    clean: bool = True
    passing: Passing | None = None
    verdict: Verdict = UNKNOWN
    lingered: int = 0
    refused: dict[int, str] = field(default_factory=dict)
    round: int = 0
    done: bool = False


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
    Q = np.array(rotation, dtype=float)
    own = np.concatenate([packed(evidence_of(Q, moments, aim=aim)), np.zeros(ALL - EVIDENCE)])
    views = views_of(Q[None], [moments], aim=aim)
    fits = affine_fits(views)
    neighbours = tuple(int(c) for c in np.flatnonzero(laplacian[camera] < 0))
    diameter = int(distance.max())
    s = GossipState(Q, moments, aim, views, fits, camera, neighbours, n_cameras, diameter, penalty, own, bound, own)
    return _called(s) if doubt_of(fits) > TRUSTED else (s, _packets(s))


def gossip_step(state: GossipState, inbox: Inbox) -> tuple[GossipState, list[Packet]]:
    """Hear the neighbours, mend the mean, say what it is; solve when all is still. Or pass on evidence, once called for."""
    s = replace(state, round=state.round + 1)
    inbox = [(c, data) for c, data in inbox if c in s.neighbours]
    messages, refused = read(inbox, (EVIDENCE, ALL, PASSED), s.refused)
    s = replace(s, refused=refused)
    if s.passing is not None:
        return _passed(s, s.passing, messages, {c for c, _ in inbox})
    if any(m.values.size == PASSED for m in messages.values()):
        s, packets = _called(s)
        return (s, packets) if s.passing is None else _passed(s, s.passing, messages, {c for c, _ in inbox})
    news = newest(messages, {c: e.round for c, e in s.edges.items()})
    edges, change = {}, 0.0
    for c in sorted({*s.edges, *news}):
        old, message = s.edges.get(c), news.get(c)
        if message is not None:
            z = np.zeros(ALL) if old is None else old.z
            step = RELAXATION * (np.pad(message.values, (0, ALL - message.values.size)) - z)
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
    all_told = abs(mean[-1] - mean[EVIDENCE - 1]) <= ALL_TOLD * mean[EVIDENCE - 1]
    converged = all_told and quiet > s.diameter and all(e.still for e in edges.values())
    clean = s.clean and (news.keys() == edges.keys() == set(s.neighbours) or s.round == 1)
    lingered = s.lingered + 1 if converged else 0
    just_quiet = quiet > 0 and s.quiet == 0
    s = replace(s, mean=mean, edges=edges, quiet=quiet, waiting=waiting, clean=clean, lingered=lingered)
    if change < NEAR * np.linalg.norm(mean):
        s = _telling(s)
    if just_quiet and (found := _rotation(_evidence(s))) is not None and doubt_of(s.fits, found) > TRUSTED:
        return _called(s)
    done = _over(s, lingered)
    return replace(s, verdict=_solved(s) if done else UNKNOWN, done=done), _packets(s)


def _over(s: GossipState, lingered: int) -> bool:
    """The last message may get lost: it is repeated, for much longer where messages do get lost."""
    return s.round >= s.bound or lingered > (2 if s.clean else PATIENCE)


def _called(s: GossipState) -> tuple[GossipState, list[Packet]]:
    """Shows its evidence, which makes its neighbours do so."""
    passing = begun(s.camera, s.neighbours, s.n_cameras, s.camera_rotation, s.moments, s.aim)
    passing, packets = passing_packets(passing, s.round, s.clean)
    return replace(s, passing=passing, done=s.round >= s.bound), packets


def _passed(
    s: GossipState, passing: Passing, messages: Mapping[tuple[int, int], Message], heard: Collection[int]
) -> tuple[GossipState, list[Packet]]:
    # What is still under way of the time before is no nonsense.
    shown = {key: message for key, message in messages.items() if message.values.size == PASSED}
    passing = passed_on(passing, shown, heard)
    clean = s.clean and all(n <= 1 for n in passing.silent.values())
    passing, packets = passing_packets(passing, s.round, clean)
    s = replace(s, passing=passing, clean=clean, verdict=passing.verdict, refused={**passing.refused, **s.refused})
    return replace(s, done=_over(s, passing.lingered)), packets


def _packets(s: GossipState) -> list[Packet]:
    out = []
    for c in s.neighbours:
        z = s.edges[c].z if c in s.edges else np.zeros(ALL)
        values = 2 * s.penalty * s.mean - z
        values = values if values[EVIDENCE:].any() else values[:EVIDENCE]
        message = Message(s.round, s.clean, s.quiet > s.diameter, values)
        out.append(Packet((c,), encode(s.camera, message)))
    return out


def _evidence(s: GossipState) -> Quadratic:
    """Of all cameras."""
    return unpacked(s.n_cameras * s.mean[:EVIDENCE])


def _rotation(evidence: Quadratic) -> FloatArray | None:
    """(3, 3) what it says; None where nobody has evidence, or it is none."""
    if not (evidence.scale > 0 and evidence.weight > 0):
        return None
    candidates = minimize(evidence.H, evidence.h)[0]
    costs = evidence.cost(candidates) / evidence.scale
    if not np.isfinite(costs).all():
        return None
    # Not `<`: what a camera that lies makes of the constant may be so large that nothing is added to it.
    best = candidates[costs <= costs.min() + EQUAL]
    return np.asarray(best[np.argmax((_ORDER * best).sum(axis=(1, 2)))])


def _solved(s: GossipState) -> Verdict:
    """What the mean says."""
    evidence = _evidence(s)
    rotation = _rotation(evidence)
    weights = dict.fromkeys([s.camera, *s.edges], 1.0)
    if rotation is None or not s.lingered:
        return Verdict(rotation, weights=weights)
    noise = _noise(evidence, rotation)
    surfaces = s.n_cameras * s.mean[EVIDENCE:-1] / (LESS * np.linalg.norm(s.mean[:EVIDENCE]))
    return Verdict(rotation, information_of(unpacked_sums(surfaces, noise), noise), True, weights=weights)


def _telling(s: GossipState) -> GossipState:
    """Tells what surfaces may have done to the rotation, unless it has."""
    mean, own, surfaces = s.mean[:EVIDENCE], s.own[:EVIDENCE], np.zeros(SURFACES)
    size = float(np.linalg.norm(mean))
    if np.linalg.norm(mean - s.told) <= SAME * size:
        return s
    evidence = _evidence(s)
    if own[-1] > 0 and (rotation := _rotation(evidence)) is not None:
        noise = _noise(evidence, rotation)
        surfaces = packed_sums(sums_of(s.views, rotation, float(evidence.size), noise), noise)
    return replace(s, own=np.concatenate([own, LESS * size * surfaces, own[-1:]]), told=mean)


def _noise(evidence: Quadratic, rotation: FloatArray) -> float:
    return noise_of(float(evidence.cost(rotation)), float(evidence.size), float(evidence.weight))


def _laplacian(n: int, graph: Iterable[tuple[int, int]]) -> FloatArray:
    out = np.zeros((n, n))
    for i, j in graph:
        if not (0 <= i < n and 0 <= j < n and i != j):
            raise ValueError(f"the graph joins camera {i} to {j}: expected two different ones of 0 to {n - 1}")
        out[i, j] = out[j, i] = -1
    return out - np.diag(out.sum(axis=1))
