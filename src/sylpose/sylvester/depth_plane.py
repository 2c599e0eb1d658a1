"""The rotation from second moments, with a plane for the depth that each camera sees: the paper's equation made practical.

`solve_centralized` takes depth as uncorrelated with the image. On a visible surface it is not. So let what camera c sees
lie about a plane: z = 1 + a'(X, Y) + relief, lengths in units of the plane's depth at the mean ray, to which the camera is
turned. Between the frames that depth changes by the factor 1/s. With R_c the rotation as camera c sees it, of
the upper-left block N and the third column (m, r33), a plane moves its image by the homography

    H = s R_c E + (τ, 1) (-a', 1),   E = [I 0; a' 0],

τ where the mean ray goes. The residual of a match (x, y) is e = y_12 (H x)_3 - y_3 (H x)_12, linear in the nine products
k = y ⊗ x, so that pair moments M are all that it takes: with e = A k, S = Σ ee' = A M A'. Points of relief ζ and noise σ
give e the covariance

    V = σ² (I + F F') + ζ² s² m m',   F = s (N + m a') - τ a', the upper-left block of H,

and the cost is half of Σ_c tr V⁻¹ S + n (log det V - log det (I + F F')) + priors of a, s, ζ, σ: total least squares
where there is no relief. Orthographic points have H = [F τ; 0 0 1] with F = s (N + m a').

The residual is linear in R too: for fixed a, s, τ and V the cost is a quadratic one on SO(3), whose minimum solves a
generalised Sylvester's equation (orthographic: A_c = s² Q'P' V⁻¹ P Q, B_c = Q'E' S_xx E Q, C_c = s Q'P' V⁻¹ S_yx E Q).
Taking turns between R and the rest settles slowly (by a factor of 0.3 to 0.8 a round on our scenes); here all unknowns move
together, by Fisher's scoring with Marquardt's damping, each camera's own eliminated: work grows linearly with the cameras.

Source: our derivation (docs/method.md, "The depth plane"); the equation is Chen & Schonfeld's (2010).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.matrices import kron, transpose
from sylpose.geometry.observability import LEAST_TURN, UNSEEN_SHARE, unseen_directions
from sylpose.geometry.validation import MOST, listed, real, shown
from sylpose.moments import PairMoments
from sylpose.results import RotationEstimate, Status
from sylpose.sylvester.depth_plane_kernels import RELIEF, costs, derivatives
from sylpose.sylvester.orthographic import ROUNDING, matrices_of, views_of

__all__ = [
    "DepthPlaneSolution",
    "Minima",
    "Problem",
    "cost_of",
    "derivatives_of",
    "problem_of",
    "search",
    "solve_depth_plane",
]


# Less noise than this share of the spread would leave nothing but rounding to fit: far below that of any image (choice).
LEAST_NOISE = 1e-4
# Noise to start from, as a share of the spread: much smooths the cost, so that few minima are left; little finds others
# (measured: docs/benchmarks.md#the-depth-plane, OK and not).
MUCH_NOISE, LITTLE_NOISE = 0.2, 0.02
# A camera has a place, a plane and a scale of its own: matches that these five numbers use up (derived: two
# coordinates each).
USED_UP = 2.5
# As many are left something to say (derived).
MIN_MATCHES = 3

# Searches that end well take 13 to 30; more are stragglers of those that start mirrored (choice).
ITERATIONS = 60
# Marquardt's damping at the start; the longest steps, of the rotation (radians) and of a camera's own: the model is linear
# about as far (choice).
DAMPING, LONGEST_TURN, LONGEST_OWN = 1e-3, 0.5, 1.5
# Steps that promise less (log-likelihood) are none: some 1e-5 standard deviations (derived: the root of twice as much).
SETTLED = 1e-10
# Where the bound of iterations ends a search, this is near enough: 0.05 standard deviations (derived, likewise).
NEAR = 1e-3
# A minimum that is less likely by no more than exp(-this) leaves doubt: three standard deviations, 3²/2 (derived). It is a
# stranger where it is as many away by this one's information.
RIVAL = 4.5

_W = slice(0, 3)  # a camera's unknowns: w of R = exp(w) R̂, then its own
_OWN = 7  # a (2), log s, τ (2), log ζ, log σ
_N = 3 + _OWN
# All signs of three numbers but + + +.
_SIGNS = 1 - 2 * np.array(list(np.ndindex(2, 2, 2)))[1:]


@dataclass(frozen=True, eq=False, repr=False)
class DepthPlaneSolution(RotationEstimate):
    """The rotation that all cameras agree on best, with what each believes of the depth that it sees.

    Attributes:
        status: OK; TOO_FEW_MATCHES (no answer: no camera has three matches with spread); TURN_NOT_OBSERVABLE (one
            camera, or a direction whose standard deviation exceeds half of the turn, and a degree); NOT_CERTIFIED
            (another rotation, beyond this one's uncertainty, is nearly as likely); NOT_CONVERGED.
        information: (3, 3) of w, what each camera believes of its own depth eliminated.
        unseen: (k, 3) unit directions of w with a standard deviation beyond half of the turn, and a degree; of one camera
            alone the one that it sees least, whatever it believes of its own depth.
        iterations: steps of all searches together.
        planes: (C, 2) slopes a of the depth in units of the depth at the camera's mean ray, along the x and y axes of the
            camera turned onto that ray. NaN in this and what follows for a camera without three matches.
        scales: (C,) s, by which the image of the object grows.
        relief: (C,) ζ, the standard deviation of the depth about the plane, same units.
        sigma: (C,) noise of an image coordinate, normalised units.
        cost: minus the logarithm of the likelihood and the priors, but for a constant.
        converged: the search settled, or its bound of iterations ended it within 0.05 standard deviations.
    """

    planes: FloatArray
    scales: FloatArray
    relief: FloatArray
    sigma: FloatArray
    cost: float
    converged: bool

    def _told_besides(self) -> list[tuple[str, str]]:
        return [("cameras", f"{int(np.isfinite(self.sigma).sum())} of {len(self.sigma)} with matches enough")]


class Problem(NamedTuple):
    """The C cameras that count.

    Attributes:
        rotation_x, rotation_y: (C, 3, 3) Q of the turned camera in frames i and j.
        M: (C, 9, 9) moments of the turned rays, of mean third coordinate 1; orthographic: of the centred points.
        n: (C,) matches, less those that a camera's own unknowns use up.
        spread: (C,) of the points, per coordinate.
        noise: (C,) where it is given.
    """

    rotation_x: FloatArray
    rotation_y: FloatArray
    M: FloatArray
    n: FloatArray
    spread: FloatArray
    noise: FloatArray | None
    perspective: bool


class Minima(NamedTuple):
    """Where S searches ended: R (S, 3, 3), the cameras' own unknowns (S, C, 7), cost, whether settled, steps."""

    R: FloatArray
    own: FloatArray
    cost: FloatArray
    converged: BoolArray
    iterations: int


def solve_depth_plane(
    rotations: ArrayLike, moments: Sequence[PairMoments], *, noise: ArrayLike | None = None, aim: bool = True
) -> DepthPlaneSolution:
    """The object's rotation between two frames from the pair moments of all cameras' matches, two cameras or more.

    Exact without noise where every camera sees points of one plane. It wants matches without outliers, and turns over
    which a surface stays in view (tried up to 30 degrees). Cameras that all look across the axis of the turn see its size
    by the change of their planes' images only: see `information`.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments; a weight of 1 is one match.
        noise: (C,) or one number, standard deviation of an image coordinate in normalised units (pixels over the focal
            length) in either frame; None: estimated with the rest. At least 1e-4 of the points' spread is assumed.
        aim: False for points that are orthographic, whose mean is no direction.

    Raises:
        ValueError: shapes that do not fit, matrices that are no rotations, noise that is not positive.
    """
    problem, used = problem_of(rotations, moments, noise, aim)
    own = np.full((len(used), _OWN), np.nan)
    R, information, unseen = np.full((3, 3), np.nan), np.zeros((3, 3)), np.eye(3)
    status, cost, converged, iterations = Status.TOO_FEW_MATCHES, np.nan, False, 0
    if used.any():
        found = _minima(problem)
        # Of searches that end in the same minimum, one that has settled.
        best = int(np.argmin(found.cost + np.where(found.converged, 0, NEAR)))
        R, own[used], cost = found.R[best], found.own[best], float(found.cost[best])
        information = _information(problem, found.R[best : best + 1], found.own[best : best + 1])
        converged, iterations = bool(found.converged[best]), found.iterations
        turn = Rotation.from_matrix(R).magnitude()
        unseen = unseen_directions(information, max(UNSEEN_SHARE * turn, LEAST_TURN))
        if used.sum() < 2 and len(unseen) == 0:
            unseen = np.linalg.eigh(information)[1][:, :1].T
        status = _status(found, best, information, unseen)
    return DepthPlaneSolution(
        status=status,
        rotation=R,
        planes=own[:, :2],
        scales=np.exp(own[:, 2]),
        relief=np.exp(own[:, 5]),
        sigma=np.exp(own[:, 6]),
        cost=cost,
        information=information,
        unseen=unseen,
        converged=converged,
        iterations=iterations,
    )


def problem_of(
    rotations: ArrayLike, moments: Sequence[PairMoments], noise: ArrayLike | None, aim: bool
) -> tuple[Problem, BoolArray]:
    """The cameras that count, and which of all these are."""
    moments = listed(moments, PairMoments, "moments")
    views = views_of(rotations, moments, aim=aim)
    sigma = None
    if noise is not None:
        sigma = real(noise, f"one number or one for each of {len(moments)} cameras", "noise")
        if sigma.shape not in ((), (len(moments),)) or not ((sigma > 0) & (sigma < MOST)).all():
            wanted = f"one number or one for each of {len(moments)} cameras"
            raise ValueError(f"noise must be positive, {wanted}; got {shown(noise)}")
    squares = np.trace(views.s_xx, axis1=1, axis2=2) + np.trace(views.s_yy, axis1=1, axis2=2)
    # What centring leaves by rounding is no spread.
    used = (views.weights >= MIN_MATCHES) & (squares > ROUNDING * views.total)
    views = views.subset(used)
    M = matrices_of(moments)[used]
    mean_x, mean_y = (M[:, 8, i] / M[:, 8, 8:] for i in ([6, 7, 8], [2, 5, 8]))
    if aim:
        Q = np.asarray(rotations, dtype=float)[used]
        to_x = views.rotation_x @ transpose(Q) / np.linalg.norm(mean_x, axis=1)[:, None, None]
        to_y = views.rotation_y @ transpose(Q) / np.linalg.norm(mean_y, axis=1)[:, None, None]
    else:
        to_x, to_y = np.tile(np.eye(3), (2, len(M), 1, 1))
        to_x[:, :2, 2], to_y[:, :2, 2] = -mean_x[:, :2], -mean_y[:, :2]
    to = kron(to_y, to_x)
    spread = np.sqrt(squares[used] / (4 * views.weights))
    if sigma is not None:
        sigma = np.maximum(np.broadcast_to(sigma, used.shape)[used], LEAST_NOISE * spread)
    Qx, Qy, turned = (np.ascontiguousarray(a) for a in (views.rotation_x, views.rotation_y, to @ M @ transpose(to)))
    return Problem(Qx, Qy, turned, views.weights - USED_UP, spread, sigma, aim), used


def _minima(problem: Problem) -> Minima:
    """What the search finds from the identity, and from there with parts of the turn the other way round."""
    # A noise that is given counts at the end only: the search wants to start from more.
    free = problem._replace(noise=None)
    start = np.zeros((15, len(problem.n), _OWN))
    noise = np.repeat([MUCH_NOISE, LITTLE_NOISE], [8, 7])[:, None]
    start[..., 5], start[..., 6] = np.log(RELIEF * problem.spread), np.log(noise * problem.spread)
    first = search(free, np.eye(3)[None], start[:1])
    turn = Rotation.from_matrix(first.R[0]).as_rotvec()
    # Other minima have, most often, the wrong sign along axes of the rig: of the distribution of its directions.
    directions = problem.rotation_x[:, 2]
    axes = np.linalg.eigh(directions.T @ directions)[1].T
    mirrored = Rotation.from_rotvec(((axes @ turn) * _SIGNS) @ axes).as_matrix()
    more = search(free, np.concatenate([mirrored, mirrored]), start[1:])
    found = Minima(
        np.concatenate([first.R, more.R]),
        np.concatenate([first.own, more.own]),
        np.concatenate([first.cost, more.cost]),
        np.concatenate([first.converged, more.converged]),
        first.iterations + more.iterations,
    )
    if problem.noise is None:
        return found
    found.own[..., 6] = np.log(problem.noise)
    last = search(problem, found.R, found.own)
    return last._replace(iterations=found.iterations + last.iterations)


def _status(found: Minima, best: int, information: FloatArray, unseen: FloatArray) -> Status:
    if len(unseen):
        return Status.TURN_NOT_OBSERVABLE
    if not found.converged[best]:
        return Status.NOT_CONVERGED
    apart = Rotation.from_matrix(found.R @ found.R[best].T).as_rotvec()
    stranger = np.einsum("si,ij,sj->s", apart, information, apart) > 2 * RIVAL
    return Status.NOT_CERTIFIED if (stranger & (found.cost < found.cost[best] + RIVAL)).any() else Status.OK


def search(problem: Problem, R: FloatArray, own: FloatArray) -> Minima:
    """Fisher's scoring with Marquardt's damping from S starts at once, rotations (S, 3, 3) and own unknowns (S, C, 7)."""
    cost = cost_of(problem, R, own)
    damping, converged = np.full(len(R), DAMPING), np.zeros(len(R), dtype=bool)
    iteration, promise = 0, np.full(len(R), np.inf)
    while iteration < ITERATIONS and not converged.all():
        iteration += 1
        gradient, hessian = derivatives_of(problem, R, own, searching=True)
        w, step, promise = _step(gradient, hessian, damping)
        length = np.maximum(np.linalg.norm(w, axis=1) / LONGEST_TURN, np.abs(step).max(axis=(1, 2)) / LONGEST_OWN)
        length = np.where(converged, 0, 1 / np.maximum(length, 1))
        new_R = Rotation.from_rotvec(length[:, None] * w).as_matrix() @ R
        new_own = own + length[:, None, None] * step
        new_cost = cost_of(problem, new_R, new_own)
        better = new_cost <= cost + 1e-12 * np.abs(cost)
        # A step that is uphill though it promised little is one of rounding; damping makes any step promise little.
        promise = promise * (1 + damping)
        converged = converged | (promise < SETTLED) | (~better & (promise < 1e3 * SETTLED))
        R = np.where(better[:, None, None], new_R, R)
        own = np.where(better[:, None, None], new_own, own)
        cost = np.where(better, new_cost, cost)
        damping = np.where(better, np.maximum(damping / 10, 1e-12), np.minimum(np.maximum(damping * 10, 1e-6), 1e10))
    return Minima(R, own, cost, converged | (promise < NEAR), iteration)


def _step(gradient: FloatArray, hessian: FloatArray, damping: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """w (S, 3), the step of the cameras' own (S, C, 7), and by how much they promise to lower the cost.

    Each camera's own unknowns are eliminated: the Schur complement.
    """
    damped = 1 + damping[:, None, None] * np.eye(3)
    of_w = gradient[..., _W].sum(axis=1)
    whole = hessian[..., _W, _W].sum(axis=1)
    mixed = hessian[..., _W, 3:]
    of_own = hessian[..., 3:, 3:] * (1 + damping[:, None, None, None] * np.eye(_OWN))
    solved = np.linalg.solve(of_own, np.concatenate([gradient[..., 3:, None], transpose(mixed)], axis=-1))
    reduced = whole * damped - (mixed @ solved[..., 1:]).sum(axis=1)
    # A direction that no camera sees gets no step.
    reduced[:, range(3), range(3)] += 1e-12 * np.trace(whole, axis1=1, axis2=2)[:, None] + 1e-300
    w = -np.linalg.solve(reduced, (of_w - (mixed @ solved[..., :1])[..., 0].sum(axis=1))[..., None])[..., 0]
    step = -solved[..., 0] - (solved[..., 1:] @ w[:, None, :, None])[..., 0]
    promise = -0.5 * ((of_w * w).sum(axis=1) + (gradient[..., 3:] * step).sum(axis=(1, 2)))
    return w, step, promise


def _information(problem: Problem, R: FloatArray, own: FloatArray) -> FloatArray:
    """(3, 3) of w at one guess, the cameras' own unknowns eliminated."""
    hessian = derivatives_of(problem, R, own)[1][0]
    mixed = hessian[:, _W, 3:]
    information = (hessian[:, _W, _W] - mixed @ np.linalg.solve(hessian[:, 3:, 3:], transpose(mixed))).sum(axis=0)
    return np.asarray((information + information.T) / 2)


def cost_of(problem: Problem, R: FloatArray, own: FloatArray) -> FloatArray:
    """(S,) minus the logarithm of likelihood and priors."""
    out = np.empty(len(R))
    costs(*_plain(problem), R, own, out)
    return out


def derivatives_of(
    problem: Problem, R: FloatArray, own: FloatArray, searching: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Gradient (S, C, 10) and Fisher's information (S, C, 10, 10) of each camera's cost, by w and its own unknowns."""
    gradient, information = np.empty((*own.shape[:2], _N)), np.empty((*own.shape[:2], _N, _N))
    derivatives(*_plain(problem), R, own, searching, gradient, information)
    return gradient, information


def _plain(
    problem: Problem,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, bool, bool]:
    """As the kernels take it."""
    Qx, Qy, M, n, spread, noise, perspective = problem
    return Qx, Qy, M, n, spread, perspective, noise is not None
