"""The distributed estimators run in one process: cameras that exchange bytes over a network that may fail.

    solve_exchange, solve_refine, solve_gossip    one call each, by default undisturbed
    run                                           any cameras' steps, over any network

What one camera does is in `exchange`, `refine` and `gossip`; here is only what carries their packets, counts them and
looks at the answers from outside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, Protocol, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sylpose.display import proof_told
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import checked_rotations
from sylpose.geometry.validation import items, kind_of, listed, number, one_of, whole
from sylpose.moments import PairMoments
from sylpose.results import RotationEstimate, Status
from sylpose.sylvester.centralized import status_of, unseen_turns
from sylpose.sylvester.distributed.exchange import exchange_start, exchange_step
from sylpose.sylvester.distributed.fault_decision import UNKNOWN, Verdict
from sylpose.sylvester.distributed.fault_injection import Nonsense, garbled
from sylpose.sylvester.distributed.gossip import gossip_start, gossip_step
from sylpose.sylvester.distributed.messages import Inbox, Packet
from sylpose.sylvester.distributed.refine import refine_start, refine_step
from sylpose.sylvester.orthographic import quadratic_of, views_of
from sylpose.sylvester.so3 import is_certified

__all__ = ["Agreement", "Disturbances", "Nonsense", "run", "solve_exchange", "solve_gossip", "solve_refine"]

MOST_ROUNDS = 10**6  # of a simulated network: more would take days (choice)
AGREED = 1e-7  # radians between the answers of cameras that agree: ten times what is asked of each (choice)


@dataclass(frozen=True)
class Disturbances:
    """What goes wrong on a simulated network.

    Attributes:
        loss: share of the packets that get lost, each link by itself.
        delay: a packet is late by 0 to so many rounds, drawn for each; later ones may overtake it.
        dies: camera -> round from which on it does nothing.
        joins: camera -> round in which it starts.
        returns: camera -> round in which it starts anew, after it has died.
        apart: from which round on, until which, whom none but each other hear.
        nonsense: camera -> what comes of its packets (`garbled`).
        seed: of all that is drawn.

    Raises:
        ValueError: a share outside [0, 1), a negative delay, a return before a death, an unknown kind of nonsense.
    """

    loss: float = 0.0
    delay: int = 0
    dies: Mapping[int, int] = field(default_factory=dict)
    joins: Mapping[int, int] = field(default_factory=dict)
    returns: Mapping[int, int] = field(default_factory=dict)
    apart: tuple[int, int, frozenset[int]] = (0, 0, frozenset())
    nonsense: Mapping[int, Nonsense] = field(default_factory=dict)
    seed: int = 0

    def __post_init__(self) -> None:
        loss = number(self.loss, "loss", least=0.0, most=1.0)
        if loss == 1.0:
            raise ValueError(f"loss must be in [0, 1), got {self.loss}")
        whole(self.delay, "delay", most=MOST_ROUNDS)
        whole(self.seed, "seed")
        for name in ("dies", "joins", "returns", "nonsense"):
            for camera, value in kind_of(getattr(self, name), Mapping, name).items():
                whole(camera, f"{name}: camera")
                if name != "nonsense":
                    whole(value, f"{name}[{camera}]", most=MOST_ROUNDS)
        begin, end, group = items(kind_of(self.apart, (tuple, list), "apart"), "apart", 3, "parts")
        whole(begin, "apart[0]"), whole(end, "apart[1]")
        for camera in items(kind_of(group, (frozenset, set, tuple, list), "apart[2]"), "apart[2]"):
            whole(camera, "apart[2]: camera")
        early = [c for c, back in self.returns.items() if not self.dies.get(c, back) < back]
        if early:
            raise ValueError(f"cameras {early} return before they have died")
        for kind in self.nonsense.values():
            one_of(kind, get_args(Nonsense), "nonsense")


UNDISTURBED = Disturbances()


class Stepping(Protocol):
    """What `run` asks of the state of any camera."""

    @property
    def done(self) -> bool: ...


class CameraState(Stepping, Protocol):
    """What the state of every scheme tells."""

    @property
    def verdict(self) -> Verdict: ...
    @property
    def refused(self) -> dict[int, str]: ...


State = TypeVar("State", bound=Stepping)
Scheme = TypeVar("Scheme", bound=CameraState)


@dataclass(frozen=True, eq=False, repr=False)
class Agreement(RotationEstimate):
    """What C cameras came to.

    Attributes:
        status: NOT_CONVERGED unless all live cameras that nobody refused, nor found at fault, converged to one rotation;
            then NOT_CONSISTENT where one of them does not know which cameras are at fault; then as that of the centralised
            estimator: TURN_NOT_OBSERVABLE, NOT_CERTIFIED or OK.
        rotation: (3, 3) the one they agree on, X_j = R X_i + t in the world frame: the first such camera's. NaN if none
            converged.
        information, unseen: (3, 3) and (k, 3) as in `CentralizedSolution`, as that camera found it.
        iterations: rounds until the last camera was done.
        certified: multipliers prove `rotation` the global optimum for the cameras in `used`. Checked from outside,
            with everybody's moments: in `refine` no camera could.
        rotations: (C, 3, 3) each camera's answer, NaN where it has none.
        converged: (C,) as each camera says of itself.
        spread: largest angle between `rotation` and that of another such camera, radians.
        used: the cameras whose evidence is in `rotation`.
        faults: camera -> what is wrong with what it saw, as the others found.
        refused: camera -> why another one did not listen to it.
        sent, received: (C,) bytes; a packet to several cameras is sent once.
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
        """The same as `iterations`."""
        return self.iterations

    def _told_besides(self) -> list[tuple[str, str]]:
        apart = f"within {np.degrees(self.spread):.2g}° of each other"
        done = f"{int(self.converged.sum())} of {len(self.converged)} converged, {apart}"
        faults = [("at fault", f"camera {c}: {text}") for c, text in sorted(self.faults.items())]
        refused = [("refused", f"camera {c}: {text}") for c, text in sorted(self.refused.items())]
        sent = ("sent", f"{int(self.sent.sum())} bytes by all cameras together")
        return [("cameras", done), sent, proof_told(self.certified), *faults, *refused]


def solve_exchange(
    rotations: ArrayLike,
    moments: Sequence[PairMoments],
    *,
    aim: bool = True,
    rounds: int = 1,
    disturbances: Disturbances = UNDISTURBED,
) -> Agreement:
    """Every camera sends its moments to all, `rounds` times, and solves with what it heard.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments.
        aim: as in `solve_centralized`; cameras refuse moments of points more than 89 degrees off the axis then. Not aimed
            the points may have any unit in which no moment exceeds 1e30: coordinates up to about 1e6.
        rounds: how often they send; more than once where messages are lost.
        disturbances: of the network.

    Raises:
        ValueError: as `solve_centralized`; a number of rounds that is none.
    """
    Q, moments = _checked(rotations, moments, aim, disturbances)
    rounds = whole(rounds, "rounds", least=1, most=MOST_ROUNDS)
    starts = [lambda c=c: exchange_start(c, Q, moments[c], aim=aim, rounds=rounds) for c in range(len(Q))]
    return _agreement(Q, moments, aim, run(starts, exchange_step, disturbances, rounds + 1))


def solve_refine(
    rotations: ArrayLike,
    moments: Sequence[PairMoments],
    *,
    aim: bool = True,
    bound: int = 500,
    disturbances: Disturbances = UNDISTURBED,
) -> Agreement:
    """The paper's scheme: cameras send rotations, round after round.

    It finds a minimum, not always the least one where there are several (collinear points, say): NOT_CERTIFIED then. Of
    matches that mean nothing it may find none.

    Args:
        rotations, moments, aim, disturbances: as `solve_exchange`.
        bound: rounds at most.

    Raises:
        ValueError: as `solve_exchange`.
    """
    Q, moments = _checked(rotations, moments, aim, disturbances)
    bound = whole(bound, "bound", least=1, most=MOST_ROUNDS)
    everyone = range(len(Q))
    starts = [lambda c=c: refine_start(c, everyone, Q[c], moments[c], aim=aim, bound=bound) for c in everyone]
    return _agreement(Q, moments, aim, run(starts, refine_step, disturbances, bound + 1))


def solve_gossip(
    rotations: ArrayLike,
    moments: Sequence[PairMoments],
    *,
    graph: Iterable[tuple[int, int]] | None = None,
    aim: bool = True,
    bound: int = 1000,
    disturbances: Disturbances = UNDISTURBED,
) -> Agreement:
    """Average consensus of the evidence over a graph.

    Args:
        rotations, moments, aim, disturbances: as `solve_exchange`.
        graph: the pairs of cameras that hear each other; None for a ring in the order given.
        bound: rounds at most.

    Raises:
        ValueError: as `solve_exchange`; a graph that is not connected.
    """
    Q, moments = _checked(rotations, moments, aim, disturbances)
    bound = whole(bound, "bound", least=1, most=MOST_ROUNDS)
    n = len(Q)
    pairs = [(c, (c + 1) % n) for c in range(n)][: n if n > 2 else n - 1] if graph is None else _pairs(graph, n)
    starts = [lambda c=c: gossip_start(c, n, pairs, Q[c], moments[c], aim=aim, bound=bound) for c in range(n)]
    return _agreement(Q, moments, aim, run(starts, gossip_step, disturbances, bound + 1))


class Outcome(NamedTuple, Generic[State]):
    """Of `run`: the last state of each camera (None: never started) and whether it lived to the end, rounds, and
    bytes sent and received by each."""

    states: list[State | None]
    alive: list[bool]
    rounds: int
    sent: IntArray
    received: IntArray


def run(
    starts: Sequence[Callable[[], tuple[State, list[Packet]]]],
    step: Callable[[State, Inbox], tuple[State, list[Packet]]],
    disturbances: Disturbances,
    bound: int,
    liars: Mapping[int, Callable[[bytes, int], bytes]] | None = None,
) -> Outcome[State]:
    """Let cameras make steps, each once a round, until all that live are done, or `bound` after the last start.

    Args:
        liars: camera -> what becomes of its packets on the way to another.
    """
    n = len(starts)
    rng = np.random.default_rng(disturbances.seed)
    states: list[State | None] = [None] * n
    under_way: dict[int, list[tuple[int, int, bytes]]] = {}  # round of arrival -> (to, from, data)
    sent, received = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    rounds = 0
    last = max((*disturbances.joins.values(), *disturbances.returns.values()), default=0)
    begin, end, group = disturbances.apart
    for now in range(bound + last + 1):
        inboxes: list[list[tuple[int, bytes]]] = [[] for _ in range(n)]
        for to, sender, data in under_way.pop(now, []):
            inboxes[to].append((sender, data))
        active = False
        for c in range(n):
            state = states[c]
            back = disturbances.returns.get(c)
            if now == back:
                state = None
            dead = now >= disturbances.dies.get(c, now + 1) and (back is None or now < back)
            active |= dead and back is not None
            if dead or (state is not None and state.done):
                continue
            active = True
            if now < disturbances.joins.get(c, 0):
                continue
            received[c] += sum(len(data) for _, data in inboxes[c])
            states[c], packets = starts[c]() if state is None else step(state, inboxes[c])
            for packet in packets:
                kind = disturbances.nonsense.get(c)
                for k, to in enumerate(packet.to):
                    # Who says the same to all sends it once.
                    if liars is not None and c in liars:
                        data = liars[c](packet.data, to)
                        sent[c] += len(data)
                    elif k == 0 or kind == "two-faced":
                        data = packet.data if kind is None else garbled(kind, packet.data, to, rng)
                        sent[c] += len(data)
                    if rng.random() >= disturbances.loss and not (begin <= now < end and (c in group) != (to in group)):
                        late = int(rng.integers(disturbances.delay + 1))
                        under_way.setdefault(now + 1 + late, []).append((to, c, data))
        if not active:
            break
        rounds = now
    alive = [c not in disturbances.dies or c in disturbances.returns for c in range(n)]
    return Outcome(states, alive, rounds, sent, received)


def _checked(
    rotations: ArrayLike, moments: Sequence[PairMoments], aim: bool, disturbances: Disturbances
) -> tuple[FloatArray, list[PairMoments]]:
    """The rotations and moments; all errors that the centralised estimator would raise."""
    moments = listed(moments, PairMoments, "moments")
    Q = checked_rotations(rotations, len(moments))
    quadratic_of(views_of(Q, moments, aim=aim))
    its = kind_of(disturbances, Disturbances, "disturbances")
    unknown = {*its.dies, *its.joins, *its.returns, *its.nonsense, *its.apart[2]} - set(range(len(Q)))
    if unknown:
        raise ValueError(f"disturbances of cameras {sorted(unknown)}: there are cameras 0 to {len(Q) - 1}")
    return Q, moments


def _pairs(graph: Iterable[tuple[int, int]], n: int) -> list[tuple[int, int]]:
    """Raises TypeError, ValueError: no pairs of cameras."""
    out = []
    for k, pair in enumerate(items(graph, "graph")):
        a, b = items(pair, f"graph[{k}]", 2, "ends")
        out.append((whole(a, f"graph[{k}]", most=n - 1), whole(b, f"graph[{k}]", most=n - 1)))
    return out


def _agreement(Q: FloatArray, moments: Sequence[PairMoments], aim: bool, outcome: Outcome[Scheme]) -> Agreement:
    states = outcome.states
    verdicts = [UNKNOWN if s is None else s.verdict for s in states]
    refused = {c: why for s in reversed(states) if s is not None for c, why in s.refused.items()}
    trusted = [c for c, alive in enumerate(outcome.alive) if alive and c not in refused]
    faults = {c: why for k in reversed(trusted) for c, why in verdicts[k].faults.items() if c not in refused}
    judged = [c for c in trusted if c not in faults]
    good = [v for c in judged if (v := verdicts[c]).converged and v.rotation is not None]
    used = tuple(sorted({c for v in good for c in v.used}))
    rotation, information, certified, spread = np.full((3, 3), np.nan), np.zeros((3, 3)), False, np.inf
    if good and (first := good[0]).rotation is not None and first.information is not None:
        rotation, information = first.rotation, first.information
        others = [v.rotation for v in good if v.rotation is not None]
        spread = max(float(Rotation.from_matrix(rotation.T @ other).magnitude()) for other in others)
        weights = dict(sorted((c, w) for v in good for c, w in v.weights.items()))
        weighted = [moments[c].weighted(w) for c, w in weights.items()]
        certified = _certified(Q[list(weights)], weighted, aim, rotation)
    unseen = unseen_turns(information, rotation, sum(moments[c].count > 0 for c in used))
    agreed = len(good) == len(judged) > 0 and spread < AGREED
    status = status_of(agreed, certified, unseen)
    return Agreement(
        status=status if not agreed or all(v.consistent for v in good) else Status.NOT_CONSISTENT,
        rotation=rotation,
        information=information,
        unseen=unseen,
        iterations=outcome.rounds,
        certified=certified,
        rotations=np.array([np.full((3, 3), np.nan) if v.rotation is None else v.rotation for v in verdicts]),
        converged=np.array([v.converged for v in verdicts]),
        spread=spread,
        used=used,
        faults=dict(sorted(faults.items())),
        refused=dict(sorted(refused.items())),
        sent=outcome.sent,
        received=outcome.received,
    )


def _certified(Q: FloatArray, moments: Sequence[PairMoments], aim: bool, rotation: FloatArray) -> bool:
    """Whether a rotation is proved to be the one global minimum for these cameras together, and has to do with them."""
    q = quadratic_of(views_of(Q, moments, aim=aim))
    return bool(q.explained(rotation)) and is_certified(q.H, q.h, rotation)
