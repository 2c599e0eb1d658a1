"""Distributed refinement of the paper: consensus ADMM on Sylvester's equations, one node's step.

Each node starts from its own solution and refines it with those of the others. It sends a 3x3 matrix, 72 bytes per
round. A step is a pure function (state, inbox) -> (state, packets) of bytes, so that it runs identically in one process
(`packets.run_network`), in several, or on several machines.

With H_c, h_c of camera c (`so3.QuadraticCost`) and its penalty p_c = 0.1 trace(H_c), node c sends
V_c = p_c R_c + Y_c, Y_c its multiplier. From the V of all nodes each one computes

    Z = the rotation nearest to Σ V_c,   A_c R_c B_c + p_c R_c = C_c + 2 p_c Z - V_c,   V_c += 1.6 p_c (R_c - Z),

ADMM in the form of Douglas & Rachford, over-relaxed. The second equation is the camera's own Sylvester equation, with
p_c in place of the multiplier. Its left side is constant: it is solved once for nine right-hand sides, and a step is a
product. As the nearest rotation does not depend on scale, penalties may differ and need not be exchanged. At a fixed
point R_c = Z for all c and Σ (C_c - A_c Z B_c) = L Z with L = L', the centralized equation.

The nodes proceed in lockstep: each waits for the last message of all others and repeats its own meanwhile, so that lost
and late messages cost rounds, but do not change the result. Each therefore has the last changes of all V and
extrapolates them identically (Anderson acceleration): 25 to 35 steps instead of 50 or, for views near one plane, a
thousand.

Once V is constant, each node sends a report: the Hessian of its cost at Z and how well Z fits its matches.
If the sum of the Hessians shows a minimum, the nodes send their surface sums at Z (`sylvester.depth_bias`), which give
the covariance of the centralized estimator. If it shows a saddle (starts halfway between mirrored solutions are often
near one), or the extrapolation has diverged, they send their costs along its flattest axis, five numbers, and restart
from the lowest point of that curve.

If Z does not fit the matches of some camera, if a node has stopped or joined late, or if there is no convergence, the
nodes send their moments instead and solve with fault detection (`exchange`). Z ignores depth: its bias on visible
surfaces also has this effect, although no camera is at fault then and the result is the same. The scheme is not
confidential: H_c and h_c can be computed from about ten rounds of V.

Source: C. Chen, D. Schonfeld, "Pose estimation from multiple cameras based on Sylvester's equation" (2010), for the
scheme; S. Boyd et al., "Distributed optimization and statistical learning via ADMM" (2011), sections 3 and 7; D. G.
Anderson, "Iterative procedures for nonlinear integral equations" (1965). The rest is ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import pack_upper, unpack_symmetric
from sylpose.moments import PairMoments
from sylpose.packets import Inbox, Packet
from sylpose.sylvester.camera_faults import (
    FULL_WEIGHT_SCORE,
    AffineFits,
    find_static_views,
    fit_affine_maps,
    max_fault_score,
)
from sylpose.sylvester.depth_bias import SLOPE_GRID, SurfaceSums, compute_surface_sums, information_from_sums
from sylpose.sylvester.distributed.exchange import (
    MAX_MISSED_ROUNDS,
    ExchangeState,
    Kind,
    Message,
    NodeEstimate,
    decode_inbox,
    encode,
    start_exchange,
    step_exchange,
)
from sylpose.sylvester.equation import solve_generalized_sylvester
from sylpose.sylvester.one_camera import solve_one_camera
from sylpose.sylvester.orthographic import Views, build_cost, compute_terms, compute_views
from sylpose.sylvester.so3 import MIN_RELATIVE_VARIANCE, ZERO_CURVATURE, QuadraticCost, compute_derivatives

# p_c over trace(H_c), and over-relaxation (measured: docs/history/benchmarks.md#distributed, plain and extrapolated).
PENALTY, RELAXATION = 0.1, 1.6
# Number of past rounds in the extrapolation: more than the 9 unknowns of a rotation matrix (choice).
MAX_HISTORY = 10
# Convergence tolerance of the relative change of a message: well above rounding's 1e-16, well below 1e-8 rad (choice).
CHANGE_TOLERANCE = 1e-11
# Maximum number of restarts from a saddle (choice).
MAX_RESTARTS = 5
# Number of steps after which no convergence is expected (choice: twice the maximum of all rigs and recordings,
# docs/history/benchmarks.md#distributed).
MAX_EXPECTED_STEPS = 150
# Numbers of values after V: a report; a curve; surface sums, which are three matrices, body slopes, normal equations and
# log determinants (derived).
REPORT_SIZE, CURVE_SIZE, SUMS_SIZE = 11, 5, 3 * 6 + 18 + len(SLOPE_GRID) * (10 + 1)

# (V, change of V) of the last rounds, (C, 3, 3) each, members in order.
History = tuple[tuple[FloatArray, FloatArray], ...]


class CameraTerms(NamedTuple):
    """What a node computes from its own moments.

    Attributes:
        views, fits: second moments and affine maps.
        is_static: whether its matches do not move.
        cost: H_c, h_c.
        penalty, gain: p_c; p_c times the solutions of A_c R B_c + p_c R = E_k, columns of (9, 9).
    """

    views: Views
    fits: AffineFits
    is_static: bool
    cost: QuadraticCost
    penalty: float
    gain: FloatArray


class Saddle(NamedTuple):
    """Rotation (3, 3) at which the nodes have sent reports, the flattest axis (3,) there, and the relative noise."""

    rotation: FloatArray
    axis: FloatArray
    noise: float


@dataclass(frozen=True, eq=False)
class RefineState:
    """State of one node of `refine`.

    Attributes:
        exchange: this node's exchange of moments, not started unless `is_exchanging`.
        terms: what follows from its moments.
        sent, previous: its last message, and the one before, for nodes that lack it.
        waiting: (camera, number) -> values received and not used yet.
        missed_rounds: camera -> rounds since its last message.
        members: the participating nodes, in order; empty before the first step.
        V: (members, 3, 3) extrapolated V.
        history: their last values and changes.
        saddle: where the curves or surface sums of the last messages were computed.
        has_diverged: the extrapolation has diverged; a restart follows, even without convergence.
        has_restarted: the last message results from a restart, not from an ADMM step.
        n_restarts: number of restarts.
        rotation: (3, 3) Z after the last step; NaN before.
        round: number of rounds so far.
        estimate: the result.
        is_exchanging: the nodes send their moments instead.
        done: nothing more will be sent.
    """

    exchange: ExchangeState
    terms: CameraTerms
    sent: Message
    previous: Message | None = None
    waiting: Mapping[tuple[int, int], FloatArray] = field(default_factory=dict)
    missed_rounds: Mapping[int, int] = field(default_factory=dict)
    members: tuple[int, ...] = ()
    V: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 3)))
    history: History = ()
    saddle: Saddle | None = None
    has_diverged: bool = False
    has_restarted: bool = False
    n_restarts: int = 0
    rotation: FloatArray = field(default_factory=lambda: np.full((3, 3), np.nan))
    round: int = 0
    estimate: NodeEstimate | None = None
    is_exchanging: bool = False
    done: bool = False

    @property
    def camera(self) -> int:
        """Number of this node."""
        return self.exchange.camera

    @property
    def missing(self) -> tuple[int, ...]:
        """Nodes whose messages for the next step are missing."""
        nodes = self.members or self.exchange.neighbors
        return tuple(c for c in nodes if c != self.camera and (c, self.sent.number) not in self.waiting)

    def is_gone(self, c: int) -> bool:
        """Return whether a node counts as gone.

        A node with a result waits twice as long: another one may lack it, because a node has failed, and
        request moments.
        """
        return self.missed_rounds.get(c, 0) > MAX_MISSED_ROUNDS * (1 if self.estimate is None else 2)


def start_refine(
    camera: int, rotations: ArrayLike, moments: PairMoments, *, aim: bool = True
) -> tuple[RefineState, list[Packet]]:
    """Create a node and its first message: the mean of the two mirrored solutions of its own camera.

    Args:
        camera: index of this node in `rotations`.
        rotations: (C, 3, 3) Q of camera_from_world of all cameras; a step uses its own only.
        moments: pair moments of this node.
        aim: as in `solve_centralized`.
    """
    exchange = start_exchange(camera, rotations, moments, aim=aim)[0]
    Q = exchange.rotations[camera]
    views = compute_views(Q[None], [moments], aim=aim)
    initial_rotation = solve_one_camera(Q, moments, aim=aim).rotations.mean(axis=0)
    cost, penalty, gain, V = QuadraticCost.zero(), 0.0, np.zeros((9, 9)), np.zeros((3, 3))
    if np.isfinite(initial_rotation).all():  # else there is no spread
        cost = build_cost(views)
        penalty = PENALTY * float(np.trace(cost.H))
        A, B = compute_terms(views)[:2]
        right_sides = np.eye(9).reshape(9, 3, 3)
        solutions = solve_generalized_sylvester([A[0], penalty * np.eye(3)], [B[0], np.eye(3)], right_sides)
        gain, V = penalty * solutions.reshape(9, 9).T, penalty * initial_rotation
    fits = fit_affine_maps(views)
    terms = CameraTerms(views, fits, bool(find_static_views([moments], fits).any()), cost, penalty, gain)
    s = RefineState(exchange, terms, Message(Kind.REFINEMENT, False, camera, 0, V.ravel()))
    return s, _make_packets(s)


def step_refine(state: RefineState, inbox: Inbox) -> tuple[RefineState, list[Packet]]:
    """Process the messages received; once those of all nodes are here, make one step; send the state."""
    s, packets = replace(state, round=state.round + 1), list[Packet]()
    if not s.is_exchanging:
        s = _receive(s, inbox)
        repeat_to = tuple(c for c in s.missing if not s.is_gone(c))
        if not s.is_exchanging and not repeat_to:
            s = replace(s, done=True) if s.estimate is not None else _advance(s)
        packets = _make_packets(s, repeat_to)
    if s.is_exchanging:
        exchange, packets = step_exchange(s.exchange, inbox)
        found = exchange.estimate
        rotation = s.rotation if found is None else found.rotation
        s = replace(s, exchange=exchange, estimate=found, rotation=rotation, done=exchange.done)
    return s, packets


def _receive(s: RefineState, inbox: Inbox) -> RefineState:
    """Store the messages; start the exchange if a node sends its moments, is late or gone, or nothing converges."""
    waiting, active, is_late = dict(s.waiting), set(), False
    for sender, message in decode_inbox(inbox, Kind.REFINEMENT):
        n_extra = message.values.size - 9
        if message.camera == sender in s.exchange.neighbors and n_extra in (0, REPORT_SIZE, CURVE_SIZE, SUMS_SIZE):
            active.add(sender)
            waiting.setdefault((sender, message.number), message.values)
            # No node is two steps ahead, unless the others have started without this one.
            is_late |= message.number > s.sent.number + 1
    missed = {c: 0 if c in active else s.missed_rounds.get(c, 0) + 1 for c in s.exchange.neighbors}
    s = replace(s, waiting=waiting, missed_rounds=missed)
    is_late |= bool(s.members) and not active <= {*s.members}
    is_gone = bool(s.members) and s.estimate is None and any(s.is_gone(c) for c in s.missing)
    is_slow = s.sent.number >= MAX_EXPECTED_STEPS
    has_moments = any(decode_inbox(inbox, Kind.MOMENTS))
    return replace(s, is_exchanging=is_late or is_gone or is_slow or has_moments)


def _advance(s: RefineState) -> RefineState:
    """Make one step, given the messages of all nodes."""
    messages = {c: values for (c, number), values in s.waiting.items() if number == s.sent.number}
    messages[s.camera] = s.sent.values
    members = tuple(sorted(messages))  # sums are identical at every node
    values = [messages[c] for c in members]
    V = np.array([v[:9] for v in values]).reshape(-1, 3, 3)
    size = np.linalg.norm(V, axis=(1, 2))
    change = 1.0
    if s.members:
        step = V - s.V
        change = float((np.linalg.norm(step, axis=(1, 2)) / np.where(size > 0, size, 1.0)).max())
        if s.has_restarted:
            s = replace(s, history=())
        else:
            history, has_diverged = _extend_history(s.history, s.V, step)
            has_diverged = s.has_diverged or (has_diverged and s.n_restarts < MAX_RESTARTS)
            s, V = replace(s, history=history, has_diverged=has_diverged), _extrapolate(history)
    s = replace(s, members=members, V=V, has_restarted=False)
    total = V.sum(axis=0)
    if not total.any():  # no node has evidence
        return replace(s, is_exchanging=True)
    own, terms = V[members.index(s.camera)], s.terms
    Z = _nearest_rotation(total)
    R = (terms.gain @ (terms.cost.h + (2 * terms.penalty * Z - own).ravel())).reshape(3, 3)  # times p
    s = replace(s, rotation=Z)
    s, own, extra = _check_minimum(s, own + RELAXATION * (R - terms.penalty * Z), [v[9:] for v in values], change)
    message = Message(Kind.REFINEMENT, False, s.camera, s.sent.number + 1, np.append(own, extra))
    waiting = {key: v for key, v in s.waiting.items() if key[1] > s.sent.number}
    return replace(s, previous=s.sent, sent=message, waiting=waiting)


def _check_minimum(
    s: RefineState, V: FloatArray, extras: list[FloatArray], change: float
) -> tuple[RefineState, FloatArray, FloatArray]:
    """Return the state, this node's V, and the values that it sends with it.

    Args:
        s: the state with the rotation of this step.
        V: (3, 3) this node's next V.
        extras: the values that all nodes have sent with theirs.
        change: largest relative change of a message.
    """
    Z, nothing, terms = s.rotation, np.zeros(0), s.terms
    has_converged = change < CHANGE_TOLERANCE
    size = extras[0].size if len({e.size for e in extras}) == 1 else 0
    total = np.sum(extras, axis=0) if size else nothing
    if size == SUMS_SIZE and s.saddle is not None:
        information = information_from_sums(_unpack_sums(total, s.saddle.noise), s.saddle.noise)
        return replace(s, estimate=NodeEstimate(Z, information, dict.fromkeys(s.members, 1.0), {}, True)), V, nothing
    if size == CURVE_SIZE and s.saddle is not None:
        Z = _minimize_curve(total, s.saddle)
        V = terms.penalty * Z - (terms.cost.H @ Z.ravel() - terms.cost.h).reshape(3, 3)
        s = replace(s, rotation=Z, saddle=None, has_diverged=False, has_restarted=True, n_restarts=s.n_restarts + 1)
        return s, V, nothing
    if not (has_converged or s.has_diverged):
        return s, V, nothing
    if size != REPORT_SIZE:
        return s, V, _make_report(terms, Z)
    curvature, axes = np.linalg.eigh(unpack_symmetric(total[:6]))
    cost, points, weight = total[6:9].tolist()
    is_minimum = has_converged and curvature[0] > -ZERO_CURVATURE * curvature[2] and min(points, weight) > 0
    # As in `diagnose_cameras`: a camera with a high score may be at fault, and a static one if others move.
    is_suspicious = max(e[9] for e in extras) > FULL_WEIGHT_SCORE or len({e[10] for e in extras if e[8] > 0}) > 1
    if is_minimum and not is_suspicious:
        noise = max(cost / points, MIN_RELATIVE_VARIANCE) / weight
        sums = _pack_sums(compute_surface_sums(terms.views, Z, points, noise), noise)
        return replace(s, saddle=Saddle(Z, axes[:, 0], noise)), V, sums
    if not is_minimum and s.n_restarts < MAX_RESTARTS:
        saddle = Saddle(Z, axes[:, 0], 0.0)
        return replace(s, saddle=saddle), V, _fit_curve(terms.cost, saddle)
    return replace(s, is_exchanging=True), V, nothing


def _make_report(terms: CameraTerms, Z: FloatArray) -> FloatArray:
    """Return (11,) Hessian, cost, size and weight of the evidence at Z; fault score of the matches; 1 if static."""
    q = terms.cost
    hessian, cost = compute_derivatives(q.H, q.h, Z)[1], max(float(q.cost(Z)), 0.0)
    return np.array([*pack_upper(hessian), cost, q.size, q.weight, max_fault_score(terms.fits, Z), terms.is_static])


def _make_packets(s: RefineState, repeat_to: tuple[int, ...] = ()) -> list[Packet]:
    """Return the last message for all nodes, and the previous one for those in `repeat_to`."""
    others = s.exchange.neighbors
    out = [Packet(others, encode(s.sent))] if others else []
    return [*out, Packet(repeat_to, encode(s.previous))] if repeat_to and s.previous is not None else out


def _nearest_rotation(M: FloatArray) -> FloatArray:
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


# --- Surface sums: values that add like the sums ----------------------------------------------------------------------


def _pack_sums(sums: SurfaceSums, noise: float) -> FloatArray:
    """Pack surface sums, none of the values much larger than 1; `noise` is that of `compute_surface_sums`."""
    squares = [pack_upper(matrix) for matrix in sums[:3]]
    fits = [noise * pack_upper(fit) for fit in sums.normal_equations]
    return np.concatenate([*squares, sums.body_slopes.ravel(), *fits, sums.log_determinants])


def _unpack_sums(values: FloatArray, noise: float) -> SurfaceSums:
    """Unpack the values of `_pack_sums`."""
    hessian, camera_slopes, scales = (unpack_symmetric(part) for part in values[:18].reshape(3, 6))
    fits = np.array([unpack_symmetric(part) for part in values[36 : -len(SLOPE_GRID)].reshape(-1, 10)]) / noise
    return SurfaceSums(hessian, camera_slopes, scales, values[18:36].reshape(3, 6), fits, values[-len(SLOPE_GRID) :])


# --- Anderson acceleration --------------------------------------------------------------------------------------------


def _extend_history(history: History, V: FloatArray, step: FloatArray) -> tuple[History, bool]:
    """Append the last step; restart the history and return True if it is much longer than the previous ones."""
    has_diverged = bool(history) and not np.linalg.norm(step) < 2 * min(np.linalg.norm(f) for _, f in history)
    return (*(() if has_diverged else history), (V, step))[-MAX_HISTORY - 1 :], has_diverged


def _extrapolate(history: History) -> FloatArray:
    """Return the extrapolated V (C, 3, 3): the combination of the last V with the smallest step, plus that step."""
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


# --- Restart from a saddle --------------------------------------------------------------------------------------------


def _fit_curve(cost: QuadraticCost, saddle: Saddle) -> FloatArray:
    """Return the coefficients (5,) of the cost at exp(a axis) R, exactly: of 1, cos a, sin a, cos 2a, sin 2a."""
    angles = np.asarray(2 * np.pi / 5 * np.arange(5), dtype=float)
    costs = cost.cost(_rotate(saddle, angles)) - cost.constant
    return np.asarray(np.linalg.solve(_fourier_basis(angles), costs), dtype=float)


def _minimize_curve(curve: FloatArray, saddle: Saddle) -> FloatArray:
    """Return the rotation (3, 3) at the lowest point of a curve."""
    angles = np.linspace(-np.pi, np.pi, 1001)
    best_angle = angles[np.argmin(_fourier_basis(angles) @ curve)]
    return np.asarray(_rotate(saddle, np.array([best_angle]))[0])


def _rotate(saddle: Saddle, angles: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_rotvec(angles[:, None] * saddle.axis).as_matrix() @ saddle.rotation)


def _fourier_basis(a: FloatArray) -> FloatArray:
    return np.column_stack([np.ones_like(a), np.cos(a), np.sin(a), np.cos(2 * a), np.sin(2 * a)])
