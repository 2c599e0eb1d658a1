"""Distributed estimator "refine" of the paper: consensus ADMM on Sylvester's equations, one node's step.

Each node starts from its own solution and refines it with those of the others. It sends a 3x3 matrix, 72 bytes per
round. A step is a pure function (state, inbox) -> (state, packets) of bytes, so that it runs identically in one process
(`simulation`), in several, or on several machines. `exchange` and `gossip` have the same interface.

With H_c, h_c of camera c (`so3.QuadraticCost`) and its penalty p_c = 0.1 trace(H_c), node c sends
V_c = p_c R_c + Y_c, Y_c its multiplier. From the V of all nodes each one computes

    Z = the rotation nearest to Σ V_c,   A_c R_c B_c + p_c R_c = C_c + 2 p_c Z - V_c,   V_c += 1.6 p_c (R_c - Z),

ADMM in the form of Douglas & Rachford, over-relaxed. The second equation is the camera's own Sylvester equation, with
p_c in place of the multiplier. Its left side is constant: it is solved once for nine right-hand sides, and a step is a
product. As the nearest rotation does not depend on scale, penalties may differ and need not be exchanged. At a fixed
point R_c = Z for all c and Σ (C_c - A_c Z B_c) = L Z with L = L', the centralized equation.

The nodes proceed in lockstep (`lockstep`). Each therefore has the last changes of all V and extrapolates them
identically (`anderson_acceleration`): 25 to 35 steps instead of 50 or, for views near one plane, a thousand. If all
nodes have converged to a saddle, or the extrapolation has diverged, they restart (`saddle_escape`): 72 and 40 more
bytes.

After convergence each node sends its surface sums at the common rotation once (`sylvester.depth_bias`), which give the
covariance of the centralized estimator: 640 more bytes.

During refinement the nodes also search for a rotation that is consistent with the matches of all cameras
(`joint_consistency`: 88 more bytes in two to five messages). A node requests the evidence if there is none, if the
common rotation differs from it by more than surfaces explain, if another node has a different rotation, if a node has
stopped or joined late, or if there is no convergence. All nodes then send their moments and solve with fault detection
(`evidence_exchange`). So moments are sent only if there is a disagreement, and faulty cameras are identified by their
moments. The scheme is not confidential: H_c and h_c can be computed from about ten rounds of V.

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
from sylpose.geometry.matrices import pack_upper, unpack_symmetric
from sylpose.moments import PairMoments
from sylpose.sylvester.affine_consensus import AffineFits, fit_affine_maps
from sylpose.sylvester.camera_faults import FULL_WEIGHT_SCORE, find_static_views, max_fault_score
from sylpose.sylvester.depth_bias import compute_surface_sums, information_from_sums
from sylpose.sylvester.distributed import saddle_escape
from sylpose.sylvester.distributed.anderson_acceleration import History, extend_history, extrapolate
from sylpose.sylvester.distributed.evidence import (
    SURFACE_SUMS_SIZE,
    compute_evidence,
    pack_sums,
    relative_noise,
    unpack_sums,
)
from sylpose.sylvester.distributed.evidence_exchange import (
    AGREEMENT_TOLERANCE,
    EVIDENCE_MESSAGE,
    check_majority,
    send_digests,
    send_evidence,
    solve_uncontradicted,
)
from sylpose.sylvester.distributed.fault_decision import NO_ESTIMATE, NodeEstimate
from sylpose.sylvester.distributed.joint_consistency import (
    NO_SEARCH,
    VOTE_SIZE,
    SearchState,
    compute_vote,
    start_search,
    step_search,
)
from sylpose.sylvester.distributed.lockstep import Link, make_packets, process_inbox, set_message
from sylpose.sylvester.distributed.messages import Inbox, Message, Packet
from sylpose.sylvester.equation import solve_generalized_sylvester
from sylpose.sylvester.one_camera import solve_one_camera
from sylpose.sylvester.orthographic import Views, compute_terms, compute_views
from sylpose.sylvester.so3 import ZERO_CURVATURE, QuadraticCost, compute_derivatives

__all__ = ["RefineState", "start_refine", "step_refine"]


# p_c over trace(H_c), and over-relaxation (measured: docs/history/benchmarks.md#distributed, plain and extrapolated).
PENALTY, RELAXATION = 0.1, 1.6
# Convergence tolerance of the relative change of a message: well above rounding's 1e-16, well below 1e-8 rad (choice).
CHANGE_TOLERANCE = 1e-11
# Relative change of a message below which the joint consistency search starts (choice: a tenth of a degree per
# step).
SEARCH_START_CHANGE = 1e-3
# The common rotation is wrong, not merely biased, if its squared distance from the consistent one exceeds this, in
# units of its covariance, or if a camera's score exceeds this (measured: docs/history/benchmarks.md#distributed, boxes and
# ellipsoids with cameras at different heights have 11 and 60 at most, with three cameras once 30).
MAX_SQUARED_BIAS, MAX_FAULT_SCORE = 25.0, 100.0
# Number of steps after which no convergence is expected (choice: twice the maximum of all rigs and recordings,
# docs/history/benchmarks.md#distributed).
MAX_EXPECTED_STEPS = 150
# Factor over the median at which a first message is rejected: a camera may have a thousand times the matches of another
# and be nearer (choice).
MAX_SIZE_RATIO = 1e5

# Message sizes: V, 9 numbers; optionally a vote; a report, 13 more; a curve, 5 more, or surface sums (derived).
REPORT_SIZE, CURVE_SIZE = 13, 5
PART_SIZES = (0, REPORT_SIZE, REPORT_SIZE + CURVE_SIZE, REPORT_SIZE + SURFACE_SUMS_SIZE)
MESSAGE_SIZES = (*(9 + n for n in PART_SIZES), *(9 + VOTE_SIZE + n for n in PART_SIZES))


class Member(NamedTuple):
    """Latest data of a participating node, possibly the node itself.

    Attributes:
        V: (3, 3) extrapolated V.
        change: relative change by the last message.
        vote: vote in its newest message, during the joint consistency search; otherwise empty.
        report: that of its newest message, if it has converged or will restart: Hessian (6), cost, size and weight of
            its evidence at its Z; its fault score; Z as a rotation vector; then the numbers of a curve, or surface
            sums. Otherwise empty.
    """

    V: FloatArray
    change: float
    vote: FloatArray
    report: FloatArray


@dataclass(frozen=True, eq=False)
class RefineState:
    """State of one node of `refine`.

    Attributes:
        camera_rotation, moments: (3, 3) Q and pair moments, sent on request.
        aim: as in `solve_centralized`.
        views, fits: second moments and affine maps of `moments`.
        is_static: whether its matches are static.
        evidence, penalty, gain: H_c, h_c; p_c; p_c times the solutions of A_c R B_c + p_c R = E_k, columns of (9, 9).
        max_rounds: maximum number of rounds.
        link: sent and received messages. Step n uses message n of all nodes.
        members: the participating nodes.
        history: history of all members' V (`anderson_acceleration`).
        search: joint consistency search (`joint_consistency`), started once Z is nearly constant.
        has_diverged: the extrapolation has diverged; a restart follows, even without convergence.
        curve_line: axis (3,) and rotation of the curve in its last message, if there is one.
        has_restarted: its last message results from a restart, not from an ADMM step.
        n_restarts: number of restarts.
        rotation: (3, 3) Z after the last step; None if no node has evidence.
        received_evidence: camera -> evidence received, once all have sent it.
        estimate: the result.
        round: number of rounds so far, at most `max_rounds`.
        done: nothing more will be sent.
    """

    camera_rotation: FloatArray
    moments: PairMoments
    aim: bool
    views: Views
    fits: AffineFits
    is_static: bool
    evidence: QuadraticCost
    penalty: float
    gain: FloatArray
    max_rounds: int
    link: Link
    members: dict[int, Member] = field(default_factory=dict)
    history: History = ()
    search: SearchState = NO_SEARCH
    has_diverged: bool = False
    curve_line: tuple[FloatArray, FloatArray] | None = None
    has_restarted: bool = False
    n_restarts: int = 0
    rotation: FloatArray | None = None
    received_evidence: dict[int, FloatArray] = field(default_factory=dict)
    estimate: NodeEstimate = NO_ESTIMATE
    round: int = 0
    done: bool = False

    @property
    def camera(self) -> int:
        """Number of this node."""
        return self.link.camera

    @property
    def refused(self) -> dict[int, str]:
        """Camera -> reason why its messages are rejected."""
        return self.link.refused

    @property
    def missing_nodes(self) -> tuple[int, ...]:
        """Nodes whose messages for the next step are missing."""
        step = self.link.number
        return self.link.missing(self.members if 0 < step < EVIDENCE_MESSAGE else self.link.others)


def start_refine(
    camera: int,
    others: Iterable[int],
    rotation: ArrayLike,
    moments: PairMoments,
    *,
    aim: bool = True,
    max_rounds: int = 500,
) -> tuple[RefineState, list[Packet]]:
    """Create a node and its first message.

    The message contains the mean of the two mirrored solutions of its own camera (`solve_one_camera`). A node whose
    matches no rotation explains requests the evidence at once.

    Args:
        camera: number of this node, from 0.
        others: numbers of the other nodes.
        rotation: (3, 3) Q of this node's camera_from_world.
        moments: pair moments of this node.
        aim: as in `solve_centralized`.
        max_rounds: maximum number of rounds.
    """
    Q = np.array(rotation, dtype=float)
    e = compute_evidence(Q, moments, aim=aim)
    views = compute_views(Q[None], [moments], aim=aim)
    initial_rotation = solve_one_camera(Q, moments, aim=aim).rotations.mean(axis=0)
    penalty, gain, V = 0.0, np.zeros((9, 9)), np.zeros((3, 3))
    if not np.isfinite(initial_rotation).all():
        e = QuadraticCost.zero()
    if e.weight > 0:
        penalty = PENALTY * float(np.trace(e.H))
        A, B = compute_terms(views)[:2]
        right_sides = np.eye(9).reshape(9, 3, 3)
        solutions = solve_generalized_sylvester([A[0], penalty * np.eye(3)], [B[0], np.eye(3)], right_sides)
        gain, V = penalty * solutions.reshape(9, 9).T, penalty * initial_rotation
    link = Link(camera, tuple(c for c in others if c != camera), Message(0, True, False, V.ravel()))
    fits = fit_affine_maps(views)
    s = RefineState(
        Q, moments, aim, views, fits, bool(find_static_views([moments], fits).any()), e, penalty, gain, max_rounds, link
    )
    if max_fault_score(s.fits) > FULL_WEIGHT_SCORE:
        s = _request_evidence(s)
    return s, make_packets(s.link)


def step_refine(state: RefineState, inbox: Inbox) -> tuple[RefineState, list[Packet]]:
    """Process the messages received; once those of all nodes are there, make one step; send the state."""
    n = 1 + len(state.link.others)
    link = process_inbox(
        state.link, inbox, MESSAGE_SIZES, {EVIDENCE_MESSAGE: 54, EVIDENCE_MESSAGE + 1: n, EVIDENCE_MESSAGE + 2: 9}
    )
    s = replace(state, round=state.round + 1, link=link)
    if link.number < EVIDENCE_MESSAGE and _has_problem(s):
        s = _request_evidence(s)
        return replace(s, done=s.round >= s.max_rounds), make_packets(s.link)
    repeat_to = tuple(c for c in s.missing_nodes if not link.is_gone(c))
    if not repeat_to:
        s = replace(s, done=True) if s.estimate.converged else _advance(s)
    return replace(s, done=s.done or s.round >= s.max_rounds), make_packets(s.link, repeat_to)


def _has_problem(s: RefineState) -> bool:
    """Return whether the messages show a problem: a late or lost node, a request, or no convergence."""
    has_late_node = s.members and any(
        s.link.missed_rounds[c] == 0 for c in s.link.others if c not in s.members and c not in s.refused
    )
    has_lost_node = not s.estimate.converged and any(s.link.is_gone(c) for c in s.missing_nodes) and s.link.number > 0
    has_request = any(n >= EVIDENCE_MESSAGE for _, n in s.link.waiting)
    return bool(has_late_node or has_lost_node or has_request or s.link.behind or s.link.number >= MAX_EXPECTED_STEPS)


def _request_evidence(s: RefineState) -> RefineState:
    """Send this node's evidence, which makes the others do so."""
    return replace(s, link=send_evidence(s.link, s.camera_rotation, s.moments), estimate=NO_ESTIMATE)


def _advance(s: RefineState) -> RefineState:
    """Advance by one step, given the messages of all nodes."""
    if s.link.number < EVIDENCE_MESSAGE:
        return _refine(_update_members(s))
    if s.link.number == EVIDENCE_MESSAGE:
        link, received_evidence = send_digests(s.link, s.aim)
        return replace(s, link=link, received_evidence=received_evidence)
    if s.link.number == EVIDENCE_MESSAGE + 1:
        link, estimate = solve_uncontradicted(s.link, s.received_evidence, s.aim)
        return replace(s, link=link, estimate=estimate, rotation=estimate.rotation)
    return replace(s, estimate=check_majority(s.link, s.estimate), done=True)


def _update_members(s: RefineState) -> RefineState:
    """Update the members with the messages of all nodes, and extrapolate their V."""
    messages = {**s.link.available(), s.camera: s.link.sent}
    size = {c: float(np.linalg.norm(m.values[:9])) for c, m in messages.items()}
    median_size = np.median([v for v in size.values() if v > 0] or [0.0])
    huge = [c for c in messages if c != s.camera and size[c] > MAX_SIZE_RATIO * median_size]
    if s.link.number == 0:
        s = replace(s, link=s.link.reject(dict.fromkeys(huge, "values that no camera can have")))
        messages = {c: messages[c] for c in messages if c not in huge}
    members = {}
    for c in sorted(messages):  # sums are identical at every node
        V, old = messages[c].values[:9].reshape(3, 3), s.members.get(c)
        change = 1.0 if old is None else float(np.linalg.norm(V - old.V)) / (size[c] or 1.0)
        parts = messages[c].values[9:]
        n = VOTE_SIZE if len(parts) - VOTE_SIZE in PART_SIZES else 0
        members[c] = Member(V, change, parts[:n], parts[n:])
    history: History = ()
    if s.link.number > 0 and not s.has_restarted:
        previous_V = np.array([s.members[c].V for c in members])
        history, has_diverged = extend_history(
            s.history, previous_V, np.array([m.V for m in members.values()]) - previous_V
        )
        s = replace(s, has_diverged=s.has_diverged or (has_diverged and s.n_restarts < saddle_escape.MAX_RESTARTS))
        V = extrapolate(history)
        members = {c: m._replace(V=v) for (c, m), v in zip(members.items(), V, strict=True)}
    return replace(s, members=members, history=history)


def _refine(s: RefineState) -> RefineState:
    """Make one ADMM step, or restart from a saddle, or request the evidence."""
    V, step = s.members[s.camera].V, s.link.number + 1
    total = np.sum([m.V for m in s.members.values()], axis=0)
    if not total.any():
        return replace(s, rotation=None, link=set_message(s.link, Message(step, True, False, V.ravel())))
    Z = _nearest_rotation(total)
    R = (s.gain @ (s.evidence.h + (2 * s.penalty * Z - V).ravel())).reshape(3, 3)  # times p
    V = V + RELAXATION * (R - s.penalty * Z)
    change = max(m.change for m in s.members.values())
    search = (
        _advance_search(s) if s.search.has_started else start_search(Z) if change < SEARCH_START_CHANGE else NO_SEARCH
    )
    has_converged = change < CHANGE_TOLERANCE and search.is_over
    own_report = _make_report(s, Z) if has_converged or s.has_diverged else np.zeros(0)
    reports = {c: own_report if c == s.camera else m.report for c, m in s.members.items()}
    estimate, line, restart = NO_ESTIMATE, None, False
    if all(r.size for r in reports.values()):
        hessian, cost, size, weight = _unpack_report(np.sum([r[:9] for r in reports.values()], axis=0))
        curvature, axes = np.linalg.eigh(hessian)
        if has_converged:
            others = Rotation.from_rotvec([r[10:13] for r in reports.values()]).as_matrix()
            if np.linalg.norm(others - Z, axis=(1, 2)).max() > AGREEMENT_TOLERANCE or search.worst > FULL_WEIGHT_SCORE:
                return _request_evidence(s)
        if has_converged and curvature[0] > -ZERO_CURVATURE * curvature[2] and min(size, weight) > 0:
            if max(r[9] for r in reports.values()) > MAX_FAULT_SCORE:
                return _request_evidence(s)
            noise = relative_noise(cost, size, weight)
            last_parts = _last_parts(s, reports)
            if all(values.size == SURFACE_SUMS_SIZE for values in last_parts):
                information = information_from_sums(unpack_sums(np.sum(last_parts, axis=0), noise), noise)
                rotation_offset = Rotation.from_matrix(search.rotation @ Z.T).as_rotvec()
                if rotation_offset @ information @ rotation_offset > MAX_SQUARED_BIAS:
                    return _request_evidence(s)
                estimate = NodeEstimate(Z, information, True, weights=dict.fromkeys(s.members, 1.0))
            else:
                own_report = np.concatenate(
                    [own_report, pack_sums(compute_surface_sums(s.views, Z, size, noise), noise)]
                )
        elif s.n_restarts < saddle_escape.MAX_RESTARTS:
            line = (axes[:, 0], Z)
            own_report = np.concatenate([own_report, saddle_escape.fit_cost_curve(s.evidence, *line)])
            restart = s.curve_line is not None and all(values.size == CURVE_SIZE for values in _last_parts(s, reports))
        elif has_converged:
            return _request_evidence(s)
    if restart and s.curve_line is not None:
        Z = saddle_escape.minimize_curve(np.sum(_last_parts(s, reports), axis=0), *s.curve_line)
        V = s.penalty * Z - (s.evidence.H @ Z.ravel() - s.evidence.h).reshape(3, 3)
        own_report, line, search = np.zeros(0), None, NO_SEARCH
    vote = (
        compute_vote(s.fits, s.is_static, search.rotation) if search.has_started and not search.is_over else np.zeros(0)
    )
    message = Message(
        step, True, has_converged and line is None and not restart, np.concatenate([V.ravel(), vote, own_report])
    )
    return replace(
        s,
        link=set_message(s.link, message),
        search=search,
        has_diverged=s.has_diverged and not restart,
        curve_line=line,
        has_restarted=restart,
        n_restarts=s.n_restarts + restart,
        rotation=Z,
        estimate=estimate,
    )


def _advance_search(s: RefineState) -> SearchState:
    """Advance the joint consistency search if all votes are there."""
    votes = {c: m.vote for c, m in s.members.items()}
    return step_search(s.search, votes) if all(v.size for v in votes.values()) else s.search


def _last_parts(s: RefineState, reports: Mapping[int, FloatArray]) -> list[FloatArray]:
    """Return the values after the report in the last message of each node."""
    return [s.members[c].report[REPORT_SIZE:] for c in reports]


def _make_report(s: RefineState, Z: FloatArray) -> FloatArray:
    """Return the report (13,) of this node at a rotation (`Member.report`)."""
    e = s.evidence
    hessian = compute_derivatives(e.H, e.h, Z)[1]
    cost = max(float(e.cost(Z)), 0.0)
    return np.array(
        [*pack_upper(hessian), cost, e.size, e.weight, max_fault_score(s.fits, Z), *Rotation.from_matrix(Z).as_rotvec()]
    )


def _unpack_report(report: FloatArray) -> tuple[FloatArray, float, float, float]:
    return unpack_symmetric(report[:6]), float(report[6]), float(report[7]), float(report[8])


def _nearest_rotation(M: FloatArray) -> FloatArray:
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
