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

All keep step (`keeping_step`). Each then knows how all V changed in the last steps, and extrapolates them (`anderson`), all
alike: 25 to 35 steps instead of 50 and, for views near one plane, of a thousand. Where all have settled at a saddle, or the
extrapolation has led astray, they leap (`leaping`): 72 and 40 bytes more.

When all have settled each says once what surfaces may have done to the common rotation (`sylvester.depth_bias`), so
that all know
the covariance that the centralised estimator has: 640 bytes more.

Whether there is a rotation that suits everybody's matches they find on the way (`votes`: 88 bytes more in two to five
messages). Where there is none, or the common rotation is further from it than surfaces explain, one calls for the evidence,
and so does who finds that another has not come to the same rotation, that a camera has died or come late, or that there is
no end: all show their moments, and each has the verdict on them (`showing`). So moments are kept back as long as nobody
doubts, and bad cameras and liars are found by what they show. Nor is the scheme secret: about ten rounds of V are enough to
work out H_c and h_c.

Source: C. Chen, D. Schonfeld, "Pose estimation from multiple cameras based on Sylvester's equation" (2010), for the
scheme; S. Boyd et al., "Distributed optimization and statistical learning via ADMM" (2011), sections 3 and 7. The rest
is ours.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import symmetric_of, upper_of
from sylpose.moments import PairMoments
from sylpose.sylvester.affine_consensus import AffineFits, affine_fits
from sylpose.sylvester.camera_faults import TRUSTED, doubt_of, stand_still
from sylpose.sylvester.depth_bias import information_of, sums_of
from sylpose.sylvester.distributed import saddle_escape
from sylpose.sylvester.distributed.anderson_acceleration import History, extended, extrapolated
from sylpose.sylvester.distributed.evidence import SURFACES, evidence_of, noise_of, packed_sums, unpacked_sums
from sylpose.sylvester.distributed.evidence_exchange import AGREED, SHOW, agreeing, answered, concluded, shown_by
from sylpose.sylvester.distributed.fault_decision import UNKNOWN, Verdict
from sylpose.sylvester.distributed.joint_consistency import IDLE, VOTE, Search, begun, searched, vote_of
from sylpose.sylvester.distributed.lockstep import Link, heard, packets, said
from sylpose.sylvester.distributed.messages import Inbox, Message, Packet
from sylpose.sylvester.equation import solve_generalized_sylvester
from sylpose.sylvester.one_camera import solve_one_camera
from sylpose.sylvester.orthographic import Views, terms_of, views_of
from sylpose.sylvester.so3 import FLAT, Quadratic, derivatives

__all__ = ["RefineState", "refine_start", "refine_step"]


# p_c over trace(H_c), and over-relaxation (measured: docs/benchmarks.md#distributed, plain and extrapolated).
PENALTY, RELAXATION = 0.1, 1.6
# Relative change of a message that is none: well above rounding's 1e-16, well below 1e-8 rad (choice).
SETTLED = 1e-11
# Relative change of a message from which on a rotation that suits all is sought (choice: a tenth of a degree a
# step).
NEAR = 1e-3
# The common rotation is wrong, and not merely biased, where it is further from the one that suits all than this, squared, in
# units of its covariance, or has a camera's score above this (measured: docs/benchmarks.md#distributed, boxes and ellipsoids
# before rigs that are not level have 11 and 60 at most, with three cameras once 30).
FAR, WRONG = 25.0, 100.0
# Steps after which there will be no end (choice: twice the most of all rigs and recordings,
# docs/benchmarks.md#distributed).
LONG = 150
# A first message so many times the median of all is nonsense: a camera may have a thousand times the matches of another,
# nearer by (choice).
HUGE = 1e5

# V, 9 numbers; perhaps a vote; a report, 13 more; a curve, 5 more, or what is said of surfaces (derived).
REPORT, CURVE = 13, 5
PARTS = (0, REPORT, REPORT + CURVE, REPORT + SURFACES)
SIZES = (*(9 + n for n in PARTS), *(9 + VOTE + n for n in PARTS))


class Member(NamedTuple):
    """What a camera knows of one that takes part, itself included.

    Attributes:
        V: (3, 3) as it enters the mean.
        change: relative change by the last message.
        vote: in its newest message, while a rotation that suits all is sought (`votes`). Else empty.
        report: in its newest message, if it has settled or is to leap: of its evidence at its Z the Hessian (6), cost, size
            and weight; how much it doubts; Z as a rotation vector; then the numbers of a curve, or of surfaces. Else empty.
    """

    V: FloatArray
    change: float
    vote: FloatArray
    report: FloatArray


@dataclass(frozen=True, eq=False)
class RefineState:
    """One camera of `refine`.

    Attributes:
        camera_rotation, moments: (3, 3) Q and what it saw: shown when somebody calls for it. views: the same as it is used;
            fits: its affine image, and whether it stands `still`.
        evidence, penalty, gain: its H_c, h_c; p_c; p_c times the solutions of A_c R B_c + p_c R = E_k, columns of (9, 9).
        link: what it has said and heard. Message n of all is what step n is made with.
        members: the cameras that take part.
        history: of all members' V (`anderson`).
        search: for a rotation that suits all (`votes`), begun once Z is nearly known.
        astray: the extrapolation has led astray; settled or not, a leap is to come.
        line: axis (3,) and rotation that the curve in its last message is of, if there is one.
        leapt: a leap, no step of ADMM, led to its last message. leaps: how many there were.
        rotation: (3, 3) Z, what all steps so far come to; None where nobody has evidence.
        shown: camera -> what it has shown, once all have.
        verdict: what it has come to.
        round: rounds, at most `bound`. done: nothing will be sent any more.
    """

    camera_rotation: FloatArray
    moments: PairMoments
    aim: bool
    views: Views
    fits: AffineFits
    still: bool
    evidence: Quadratic
    penalty: float
    gain: FloatArray
    bound: int
    link: Link
    members: dict[int, Member] = field(default_factory=dict)
    history: History = ()
    search: Search = IDLE
    astray: bool = False
    line: tuple[FloatArray, FloatArray] | None = None
    leapt: bool = False
    leaps: int = 0
    rotation: FloatArray | None = None
    shown: dict[int, FloatArray] = field(default_factory=dict)
    verdict: Verdict = UNKNOWN
    round: int = 0
    done: bool = False

    @property
    def camera(self) -> int:
        """Its number."""
        return self.link.camera

    @property
    def refused(self) -> dict[int, str]:
        """Camera -> why nothing is read of it any more."""
        return self.link.refused

    @property
    def awaited(self) -> tuple[int, ...]:
        """Those whose message is needed for the next step and not there."""
        step = self.link.number
        return self.link.missing(self.members if 0 < step < SHOW else self.link.others)


def refine_start(
    camera: int, others: Iterable[int], rotation: ArrayLike, moments: PairMoments, *, aim: bool = True, bound: int = 500
) -> tuple[RefineState, list[Packet]]:
    """A camera and its first message: its own solution (`solve_one_camera`), the mean of the two mirrored ones that it
    cannot tell apart. A camera whose matches no rotation explains calls for the evidence at once.

    Args:
        camera: its number, from 0 on. others: those that it may hear.
        rotation: (3, 3) Q of its camera_from_world. moments: its own.
        aim: as in `solve_centralized`.
        bound: rounds after which it gives up.
    """
    Q = np.array(rotation, dtype=float)
    e = evidence_of(Q, moments, aim=aim)
    views = views_of(Q[None], [moments], aim=aim)
    own = solve_one_camera(Q, moments, aim=aim).rotations.mean(axis=0)
    penalty, gain, V = 0.0, np.zeros((9, 9)), np.zeros((3, 3))
    if not np.isfinite(own).all():
        e = Quadratic.zero()
    if e.weight > 0:
        penalty = PENALTY * float(np.trace(e.H))
        A, B = terms_of(views)[:2]
        right_sides = np.eye(9).reshape(9, 3, 3)
        solved = solve_generalized_sylvester([A[0], penalty * np.eye(3)], [B[0], np.eye(3)], right_sides)
        gain, V = penalty * solved.reshape(9, 9).T, penalty * own
    link = Link(camera, tuple(c for c in others if c != camera), Message(0, True, False, V.ravel()))
    fits = affine_fits(views)
    s = RefineState(
        Q, moments, aim, views, fits, bool(stand_still([moments], fits).any()), e, penalty, gain, bound, link
    )
    if doubt_of(s.fits) > TRUSTED:
        s = _called(s)
    return s, packets(s.link)


def refine_step(state: RefineState, inbox: Inbox) -> tuple[RefineState, list[Packet]]:
    """Hear the others; once all have been heard, take one step; say where one is."""
    n = 1 + len(state.link.others)
    link = heard(state.link, inbox, SIZES, {SHOW: 54, SHOW + 1: n, SHOW + 2: 9})
    s = replace(state, round=state.round + 1, link=link)
    if link.number < SHOW and _in_doubt(s):
        s = _called(s)
        return replace(s, done=s.round >= s.bound), packets(s.link)
    again = tuple(c for c in s.awaited if not link.gone(c))
    if not again:
        s = replace(s, done=True) if s.verdict.converged else _advanced(s)
    return replace(s, done=s.done or s.round >= s.bound), packets(s.link, again)


def _in_doubt(s: RefineState) -> bool:
    """Whether something is not as it should be, as far as its messages show."""
    late = s.members and any(s.link.silent[c] == 0 for c in s.link.others if c not in s.members and c not in s.refused)
    died = not s.verdict.converged and any(s.link.gone(c) for c in s.awaited) and s.link.number > 0
    calls = any(n >= SHOW for _, n in s.link.waiting)
    return bool(late or died or calls or s.link.behind or s.link.number >= LONG)


def _called(s: RefineState) -> RefineState:
    """Shows its evidence, which makes the others do so."""
    return replace(s, link=shown_by(s.link, s.camera_rotation, s.moments), verdict=UNKNOWN)


def _advanced(s: RefineState) -> RefineState:
    """With everybody's messages."""
    if s.link.number < SHOW:
        return _refined(_updated(s))
    if s.link.number == SHOW:
        link, shown = answered(s.link, s.aim)
        return replace(s, link=link, shown=shown)
    if s.link.number == SHOW + 1:
        link, verdict = concluded(s.link, s.shown, s.aim)
        return replace(s, link=link, verdict=verdict, rotation=verdict.rotation)
    return replace(s, verdict=agreeing(s.link, s.verdict), done=True)


def _updated(s: RefineState) -> RefineState:
    """With what all have sent, this camera included; extrapolated."""
    news = {**s.link.there(), s.camera: s.link.sent}
    size = {c: float(np.linalg.norm(m.values[:9])) for c, m in news.items()}
    usual = np.median([v for v in size.values() if v > 0] or [0.0])
    huge = [c for c in news if c != s.camera and size[c] > HUGE * usual]
    if s.link.number == 0:
        s = replace(s, link=s.link.refusing(dict.fromkeys(huge, "values that no camera has")))
        news = {c: news[c] for c in news if c not in huge}
    members = {}
    for c in sorted(news):  # sums come out the same at every camera
        V, old = news[c].values[:9].reshape(3, 3), s.members.get(c)
        change = 1.0 if old is None else float(np.linalg.norm(V - old.V)) / (size[c] or 1.0)
        parts = news[c].values[9:]
        n = VOTE if len(parts) - VOTE in PARTS else 0
        members[c] = Member(V, change, parts[:n], parts[n:])
    history: History = ()
    if s.link.number > 0 and not s.leapt:
        before = np.array([s.members[c].V for c in members])
        history, jumped = extended(s.history, before, np.array([m.V for m in members.values()]) - before)
        s = replace(s, astray=s.astray or (jumped and s.leaps < saddle_escape.LEAPS))
        V = extrapolated(history)
        members = {c: m._replace(V=v) for (c, m), v in zip(members.items(), V, strict=True)}
    return replace(s, members=members, history=history)


def _refined(s: RefineState) -> RefineState:
    """One step of ADMM, or a leap, or a call for the evidence."""
    V, step = s.members[s.camera].V, s.link.number + 1
    total = np.sum([m.V for m in s.members.values()], axis=0)
    if not total.any():
        return replace(s, rotation=None, link=said(s.link, Message(step, True, False, V.ravel())))
    Z = _nearest_rotation(total)
    R = (s.gain @ (s.evidence.h + (2 * s.penalty * Z - V).ravel())).reshape(3, 3)  # times p
    V = V + RELAXATION * (R - s.penalty * Z)
    change = max(m.change for m in s.members.values())
    search = _searched(s) if s.search.begun else begun(Z) if change < NEAR else IDLE
    settled = change < SETTLED and search.over
    own = _report(s, Z) if settled or s.astray else np.zeros(0)
    reports = {c: own if c == s.camera else m.report for c, m in s.members.items()}
    verdict, line, leap = UNKNOWN, None, False
    if all(r.size for r in reports.values()):
        hessian, cost, size, weight = _unpacked(np.sum([r[:9] for r in reports.values()], axis=0))
        curvature, axes = np.linalg.eigh(hessian)
        if settled:
            others = Rotation.from_rotvec([r[10:13] for r in reports.values()]).as_matrix()
            if np.linalg.norm(others - Z, axis=(1, 2)).max() > AGREED or search.worst > TRUSTED:
                return _called(s)
        if settled and curvature[0] > -FLAT * curvature[2] and min(size, weight) > 0:
            if max(r[9] for r in reports.values()) > WRONG:
                return _called(s)
            noise = noise_of(cost, size, weight)
            told = _last_parts(s, reports)
            if all(values.size == SURFACES for values in told):
                information = information_of(unpacked_sums(np.sum(told, axis=0), noise), noise)
                off = Rotation.from_matrix(search.rotation @ Z.T).as_rotvec()
                if off @ information @ off > FAR:
                    return _called(s)
                verdict = Verdict(Z, information, True, weights=dict.fromkeys(s.members, 1.0))
            else:
                own = np.concatenate([own, packed_sums(sums_of(s.views, Z, size, noise), noise)])
        elif s.leaps < saddle_escape.LEAPS:
            line = (axes[:, 0], Z)
            own = np.concatenate([own, saddle_escape.curve_of(s.evidence, *line)])
            leap = s.line is not None and all(values.size == CURVE for values in _last_parts(s, reports))
        elif settled:
            return _called(s)
    if leap and s.line is not None:
        Z = saddle_escape.lowest(np.sum(_last_parts(s, reports), axis=0), *s.line)
        V = s.penalty * Z - (s.evidence.H @ Z.ravel() - s.evidence.h).reshape(3, 3)
        own, line, search = np.zeros(0), None, IDLE
    vote = vote_of(s.fits, s.still, search.rotation) if search.begun and not search.over else np.zeros(0)
    message = Message(step, True, settled and line is None and not leap, np.concatenate([V.ravel(), vote, own]))
    return replace(
        s,
        link=said(s.link, message),
        search=search,
        astray=s.astray and not leap,
        line=line,
        leapt=leap,
        leaps=s.leaps + leap,
        rotation=Z,
        verdict=verdict,
    )


def _searched(s: RefineState) -> Search:
    """A step further, if all have voted."""
    votes = {c: m.vote for c, m in s.members.items()}
    return searched(s.search, votes) if all(v.size for v in votes.values()) else s.search


def _last_parts(s: RefineState, reports: Mapping[int, FloatArray]) -> list[FloatArray]:
    """What the last message of each had after its report, this camera's included."""
    return [s.members[c].report[REPORT:] for c in reports]


def _report(s: RefineState, Z: FloatArray) -> FloatArray:
    """(13,) what it says of a rotation (`Member`)."""
    e = s.evidence
    hessian = derivatives(e.H, e.h, Z)[1]
    cost = max(float(e.cost(Z)), 0.0)
    return np.array(
        [*upper_of(hessian), cost, e.size, e.weight, doubt_of(s.fits, Z), *Rotation.from_matrix(Z).as_rotvec()]
    )


def _unpacked(report: FloatArray) -> tuple[FloatArray, float, float, float]:
    return symmetric_of(report[:6]), float(report[6]), float(report[7]), float(report[8])


def _nearest_rotation(M: FloatArray) -> FloatArray:
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
