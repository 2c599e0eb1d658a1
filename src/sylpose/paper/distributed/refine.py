"""One rotation at every camera, by collaboration: one camera's step of the paper's distributed estimator, `refine`.

Each camera starts from its own solution and refines it with the others'. All that it sends is a matrix of the size of a
rotation, 72 bytes a round: consensus ADMM on Sylvester's equations. A step is a pure function (state, inbox) ->
(state, packets): nothing is shared, bytes come in and bytes go out, so that it runs the same in one process
(`simulated`), in many, or on many machines. `exchange` and `gossip` are schemes of the same kind.

With H_c, h_c of camera c (`so3.Quadratic`) and its penalty p_c = 0.1 trace(H_c), it sends
V_c = p_c R_c + Y_c, Y_c its multiplier. From the V of all cameras each one computes

    Z = the rotation nearest to Σ V_c,   A_c R_c B_c + p_c R_c = C_c + 2 p_c Z - V_c,   V_c += 1.6 p_c (R_c - Z),

ADMM in the form of Douglas & Rachford, over-relaxed. The middle one is the camera's own Sylvester's equation, p_c in the
place of the multiplier. Its left side stays what it is: it is solved once, for nine right sides, and a step is a product.
As the nearest rotation does not depend on scale, penalties may differ and no camera need know another's. Where nothing
changes any more, R_c = Z for all c and Σ (C_c - A_c Z B_c) = L Z with L = L', the centralised equation.

All keep step: a camera waits until it has heard everybody's last message and repeats its own meanwhile, so that loss and
delay cost rounds and change nothing. Each then knows how all V changed in the last steps, and extrapolates them
(Anderson), all alike: 25 to 35 steps instead of 50 and, for views near one plane, of a thousand.

Extrapolation finds where nothing changes, which may be a saddle; starts halfway between mirrored solutions are often near
one, and where the cameras see little of the depth it is far from both minima and hardly steeper than they. So where all
have settled at a saddle, or the extrapolation has led astray, they leap: all tell their Hessians (72 bytes more), then
their costs along the flattest axis of the sum, which are five numbers each (40 bytes more), and all start again from the
lowest point of that curve.

A camera that is not heard for long, or comes late, ends the keeping of step for good. The others then go on with the
last V that they know of each other: any messages lead to the same answer, but as slowly as plain ADMM does.

Nonsense is refused: wrong sizes, values that are not finite or far larger than all others', a rotation that never
settles. A camera that calmly insists on one false rotation is believed, as one with wrong matches is; that is for
`paper.bad_cameras` to find. Nor is the scheme secret: about ten rounds of V are enough to work out H_c and h_c.

Source: C. Chen, D. Schonfeld, "Pose estimation from multiple cameras based on Sylvester's equation" (2010), for the
scheme; S. Boyd et al., "Distributed optimization and statistical learning via ADMM" (2011), sections 3 and 7;
D. G. Anderson, "Iterative procedures for nonlinear integral equations" (1965). The rest is ours.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sylpose.moments import PairMoments
from sylpose.numerics.arrays import FloatArray
from sylpose.paper.distributed.evidence import evidence_of
from sylpose.paper.distributed.messages import Inbox, Message, Packet, encode, newest, read
from sylpose.paper.equation import solve_generalized_sylvester
from sylpose.paper.one_camera import solve_one_camera
from sylpose.paper.orthographic import terms_of, views_of
from sylpose.paper.so3 import FLAT, LEAST, Quadratic, derivatives

__all__ = ["PATIENCE", "RefineState", "refine_start", "refine_step"]


PENALTY = 0.1  # p_c over trace(H_c)
RELAXATION = 1.6
MEMORY = 10  # rounds that the extrapolation looks back
SETTLED = 1e-11  # relative change of a message that is none
PATIENCE = 20  # rounds of silence after which a camera is gone
LEAPS = 5  # off a saddle, at most so often
HUGE = 1e3  # a message this many times the median of all is nonsense
WANDERING = 0.3  # mean relative change of the messages of a camera that never settles

SIZES = (9, 18, 23)  # V, report, curve

_UPPER = np.triu_indices(3)


class Member(NamedTuple):
    """What a camera knows of one that takes part, itself included.

    Attributes:
        V: (3, 3) as it enters the mean.
        change: relative change by the last message; wander: its mean over the last ten or so.
        report: in its newest message, if it has settled or is to leap: Hessian (6), cost, size and weight of its
            evidence at its Z, then the five numbers of `_curve`. Else empty.
        final: it has settled.
        round: of its newest message. heard: messages so far.
    """

    V: FloatArray
    change: float
    wander: float
    report: FloatArray
    final: bool
    round: int
    heard: int


@dataclass(frozen=True, eq=False)
class RefineState:
    """One camera of `refine`.

    Attributes:
        evidence, penalty, gain: its H_c, h_c; p_c; p_c times the solutions of A_c R B_c + p_c R = E_k, columns of (9, 9).
        sent: its last message.
        members: the cameras that take part.
        history: (V, change of V) of the last rounds, all members in order.
        clean: all keep step.
        step: steps made: while `clean`, each with everybody's message of the same number.
        before: the message before `sent`, for those who have not got it yet.
        waiting: (camera, number) -> message that came and is yet to be used.
        silent: camera -> rounds since anything was heard of it.
        astray: the extrapolation has led astray; settled or not, a leap is to come.
        line: axis (3,) and rotation that the curve in `sent` is of, if there is one.
        leapt: a leap, no step of ADMM, led to `sent`. leaps: how many there were.
        rotation: (3, 3) Z, the answer so far; None where nobody has evidence.
        information: (3, 3) as in `CentralizedSolution`, from all reports; None until `converged`.
        converged: all have settled, at a minimum. lingered: steps since.
        refused: camera -> why a message was not read, or why nothing is read of it any more (`blocked`).
        round: rounds, at most `bound`. done: nothing will be sent any more.
    """

    camera: int
    others: tuple[int, ...]
    evidence: Quadratic
    penalty: float
    gain: FloatArray
    bound: int
    sent: Message
    members: dict[int, Member] = field(default_factory=dict)
    history: tuple[tuple[FloatArray, FloatArray], ...] = ()
    clean: bool = True
    step: int = 0
    before: Message | None = None
    waiting: dict[tuple[int, int], Message] = field(default_factory=dict)
    silent: dict[int, int] = field(default_factory=dict)
    astray: bool = False
    line: tuple[FloatArray, FloatArray] | None = None
    leapt: bool = False
    leaps: int = 0
    rotation: FloatArray | None = None
    information: FloatArray | None = None
    converged: bool = False
    lingered: int = 0
    refused: dict[int, str] = field(default_factory=dict)
    blocked: frozenset[int] = frozenset()
    round: int = 0
    done: bool = False

    @property
    def used(self) -> tuple[int, ...]:
        """The cameras that the answer is from."""
        return tuple(sorted(self.members))

    @property
    def missing(self) -> tuple[int, ...]:
        """Those whose message is needed for the next step and not there; nobody waits for one that talks nonsense."""
        expected = self.members if self.step else set(self.others) - self.refused.keys()
        return tuple(c for c in expected if c != self.camera and (c, self.step) not in self.waiting)


def refine_start(
    camera: int, others: Iterable[int], rotation: ArrayLike, moments: PairMoments, *, aim: bool = True, bound: int = 500
) -> tuple[RefineState, list[Packet]]:
    """A camera and its first message: its own solution (`solve_one_camera`), the mean of the two mirrored ones that it
    cannot tell apart.

    Args:
        camera: its number, from 0 on. others: those that it may hear.
        rotation: (3, 3) Q of its camera_from_world. moments: its own.
        aim: as in `solve_centralized`.
        bound: rounds after which it gives up.
    """
    e = evidence_of(rotation, moments, aim=aim)
    own = solve_one_camera(rotation, moments, aim=aim).rotations.mean(axis=0)
    penalty, gain, V = 0.0, np.zeros((9, 9)), np.zeros((3, 3))
    if not np.isfinite(own).all():
        e = Quadratic.zero()
    if e.weight > 0:
        penalty = PENALTY * float(np.trace(e.H))
        A, B = terms_of(views_of(np.asarray(rotation, dtype=float)[None], [moments], aim=aim))[:2]
        right_sides = np.eye(9).reshape(9, 3, 3)
        solved = solve_generalized_sylvester([A[0], penalty * np.eye(3)], [B[0], np.eye(3)], right_sides)
        gain, V = penalty * solved.reshape(9, 9).T, penalty * own
    message = Message(0, True, False, V.ravel())
    s = RefineState(camera, tuple(c for c in others if c != camera), e, penalty, gain, bound, message)
    return s, _packets(s)


def refine_step(state: RefineState, inbox: Inbox) -> tuple[RefineState, list[Packet]]:
    """Hear the others; once all have been heard, take one step; say where one is."""
    s, news = _awaited(replace(state, round=state.round + 1), inbox)
    if news is None:
        over = s.converged and all(s.silent[c] > PATIENCE for c in s.missing)
        return replace(s, done=over or s.round >= s.bound), _packets(s, again=s.missing)
    s = _without_strays(_updated(s, news))
    s = replace(s, step=s.step + 1, before=s.sent)
    V = s.members[s.camera].V
    total = np.sum([m.V for m in s.members.values()], axis=0)
    if not total.any():
        s = replace(s, rotation=None, converged=False, done=s.round >= s.bound)
        s = replace(s, sent=Message(s.step, s.clean, False, V.ravel()))
        return s, _packets(s)
    Z = _nearest_rotation(total)
    R = (s.gain @ (s.evidence.h + (2 * s.penalty * Z - V).ravel())).reshape(3, 3)  # times p
    V = V + RELAXATION * (R - s.penalty * Z)
    # A camera that hears nobody waits: the others may only be late.
    settled = max(m.change for m in s.members.values()) < SETTLED and (len(s.members) > 1 or s.round > PATIENCE)
    own = _report(s.evidence, Z) if settled or s.astray else np.zeros(0)
    reports = {c: own if c == s.camera else m.report for c, m in s.members.items()}
    information, line, leap = None, None, False
    if all(r.size for r in reports.values()):
        hessian, cost, size, weight = _unpacked(np.sum([r[:9] for r in reports.values()], axis=0))
        curvature, axes = np.linalg.eigh(hessian)
        if settled and curvature[0] > -FLAT * curvature[2] and weight > 0:
            information = hessian * (weight / max(cost, LEAST * size))
        elif s.leaps < LEAPS:
            line = (axes[:, 0], Z)
            own = np.concatenate([own, _curve(s.evidence, *line)])
            leap = s.line is not None and all(r.size > 9 for c, r in reports.items() if c != s.camera)
    if leap and s.line is not None:
        curves = [s.sent.values[18:] if c == s.camera else r[9:] for c, r in reports.items()]
        Z = _lowest(np.sum(curves, axis=0), *s.line)
        V = s.penalty * Z - (s.evidence.H @ Z.ravel() - s.evidence.h).reshape(3, 3)
        own, line = np.zeros(0), None
    converged = information is not None
    lingered = s.lingered + 1 if converged else 0
    s = replace(
        s,
        sent=Message(s.step, s.clean, settled and line is None and not leap, np.concatenate([V.ravel(), own])),
        astray=s.astray and not leap,
        line=line,
        leapt=leap,
        leaps=s.leaps + leap,
        rotation=Z,
        information=information,
        converged=converged,
        lingered=lingered,
        # Out of step, the last message may get lost: it is repeated.
        done=s.round >= s.bound or lingered > PATIENCE,
    )
    return s, _packets(s)


def _packets(s: RefineState, again: Iterable[int] = ()) -> list[Packet]:
    """Its message; to those who may lack it, the one before again."""
    packets = [Packet(s.others, encode(s.camera, s.sent))] if s.others else []
    late = tuple(again)
    return [*packets, Packet(late, encode(s.camera, s.before))] if late and s.before is not None else packets


def _awaited(s: RefineState, inbox: Inbox) -> tuple[RefineState, dict[int, Message] | None]:
    """What the next step is to be made with; None: no step yet, or never again."""
    inbox = [(c, data) for c, data in inbox if c in s.others and c not in s.blocked]
    news, refused = read(inbox, SIZES, s.refused)
    silent = {c: 0 if any(c == k for k, _ in news) else s.silent.get(c, 0) + 1 for c in s.others}
    waiting = {key: m for key, m in {**s.waiting, **news}.items() if key[1] >= s.step}
    s = replace(s, refused=refused, silent=silent, waiting=waiting)
    broken = any(n > s.step + 1 or not m.clean or (s.step and c not in s.members) for (c, n), m in waiting.items())
    if s.clean and not broken:
        if s.converged or any(silent[c] <= PATIENCE for c in s.missing):
            return s, None
        return s, {c: m for (c, n), m in waiting.items() if n == s.step}
    seen = {c: m.round for c, m in s.members.items()}
    return replace(s, waiting={}), newest({**waiting, **news}, seen)


def _updated(s: RefineState, news: dict[int, Message]) -> RefineState:
    """With what all have sent, this camera included; extrapolated while all know all."""
    news, refused = {**news, s.camera: s.sent}, dict(s.refused)
    size = {c: float(np.linalg.norm(m.values[:9])) for c, m in news.items()}
    usual = np.median([v for v in size.values() if v > 0] or [0.0])
    for c in news.keys() - {s.camera}:
        if size[c] > HUGE * usual or (news[c].values[15:18] < 0).any():
            refused.setdefault(c, "values that no camera has")
            del news[c]
    # Who has settled may be silent: its last message was final.
    members = {c: m for c, m in s.members.items() if s.silent.get(c, 0) <= PATIENCE or m.final}
    for c, message in news.items():
        V, old = message.values[:9].reshape(3, 3), s.members.get(c)
        change = 1.0 if old is None else float(np.linalg.norm(V - old.V)) / (size[c] or 1.0)
        wander = change if old is None else 0.9 * old.wander + 0.1 * change
        heard = 1 if old is None else old.heard + 1
        members[c] = Member(V, change, wander, message.values[9:], message.final, message.round, heard)
    members = dict(sorted(members.items()))  # sums come out the same at every camera
    # The first step makes all acquainted; from then on all must be heard in every one.
    expected = news.keys() if s.step == 0 else s.members.keys()
    clean = news.keys() == expected and all(m.clean and m.round == s.step for m in news.values())
    s = replace(s, refused=refused, clean=s.clean and clean, astray=s.astray and s.clean and clean)
    history: tuple[tuple[FloatArray, FloatArray], ...] = ()
    if s.clean and s.step > 0 and not s.leapt:
        V = np.array([s.members[c].V for c in members])
        step = np.array([m.V for m in members.values()]) - V
        if s.history:
            if np.linalg.norm(step) < 2 * min(np.linalg.norm(f) for _, f in s.history):
                history = s.history
            elif s.leaps < LEAPS:
                s = replace(s, astray=True)
        history = (*history, (V, step))[-MEMORY - 1 :]
        V = _extrapolated(history)
        members = {c: m._replace(V=v) for (c, m), v in zip(members.items(), V, strict=True)}
    return replace(s, members=members, history=history)


def _extrapolated(history: tuple[tuple[FloatArray, FloatArray], ...]) -> FloatArray:
    """Anderson's: the combination of the last V whose steps cancel best, with its own step. (C, 3, 3)."""
    V, step = history[-1]
    if len(history) < 4:
        return np.asarray(V + step)
    weight = 1 / np.sqrt(np.linalg.norm(V, axis=(1, 2)) + 1e-300)[:, None, None]
    steps = np.array([b - a for (_, a), (_, b) in pairwise(history)])
    images = np.array([(vb + b) - (va + a) for (va, a), (vb, b) in pairwise(history)])
    A = (weight * steps).reshape(len(steps), -1)
    unit = 1 / np.maximum(np.linalg.norm(A, axis=1), 1e-300)
    A = A * unit[:, None]
    mix = unit * np.linalg.solve(A @ A.T + 1e-12 * np.eye(len(A)), A @ (weight * step).ravel())
    return np.asarray(V + step - np.tensordot(mix, images, 1))


def _without_strays(s: RefineState) -> RefineState:
    """Without the cameras whose rotation still jumps about when everybody's should long have settled."""
    usual = float(np.median([m.wander for m in s.members.values()]))
    strays = {
        c
        for c, m in s.members.items()
        if c != s.camera and m.heard > 1.5 * PATIENCE and m.wander > max(WANDERING, 2 * usual)
    }
    if not strays:
        return s
    return replace(
        s,
        members={c: m for c, m in s.members.items() if c not in strays},
        history=(),
        clean=False,
        refused={**s.refused, **dict.fromkeys(strays, "its rotation never settles")},
        blocked=s.blocked | strays,
    )


def _report(e: Quadratic, rotation: FloatArray) -> FloatArray:
    hessian = derivatives(e.H, e.h, rotation)[1]
    return np.array([*hessian[_UPPER], max(float(e.cost(rotation)), 0.0), e.size, e.weight])


def _curve(e: Quadratic, axis: FloatArray, rotation: FloatArray) -> FloatArray:
    """(5,) of the cost at exp(a axis) R: the coefficients of 1, cos a, sin a, cos 2a, sin 2a, which is all there is."""
    angles = np.asarray(2 * np.pi / 5 * np.arange(5), dtype=float)
    costs = e.cost(Rotation.from_rotvec(angles[:, None] * axis).as_matrix() @ rotation) - e.constant
    return np.asarray(np.linalg.solve(_waves(angles), costs), dtype=float)


def _lowest(curve: FloatArray, axis: FloatArray, rotation: FloatArray) -> FloatArray:
    """(3, 3) the rotation at the lowest point of a curve."""
    angles = np.linspace(-np.pi, np.pi, 1001)
    lowest = angles[np.argmin(_waves(angles) @ curve)]
    return np.asarray(Rotation.from_rotvec(lowest * axis).as_matrix() @ rotation)


def _waves(a: FloatArray) -> FloatArray:
    return np.column_stack([np.ones_like(a), np.cos(a), np.sin(a), np.cos(2 * a), np.sin(2 * a)])


def _unpacked(report: FloatArray) -> tuple[FloatArray, float, float, float]:
    hessian = np.zeros((3, 3))
    hessian[_UPPER] = report[:6]
    return hessian + np.triu(hessian, 1).T, float(report[6]), float(report[7]), float(report[8])


def _nearest_rotation(M: FloatArray) -> FloatArray:
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
