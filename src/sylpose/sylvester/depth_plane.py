"""Rotation estimator from second moments with a local depth plane per camera.

`solve_centralized` assumes that depth is uncorrelated with the image, which is not the case on a visible surface. Here
the points of camera c are near a plane: z = 1 + a'(X, Y) + residual depth, in units of the plane's depth at the mean
ray, onto which the camera is rotated. Between the frames that depth changes by the factor 1/s. With R_c the rotation in
the frame of camera c, of the upper-left block N and the third column (m, r33), a plane moves its image by the
homography

    H = s R_c E + (τ, 1) (-a', 1),   E = [I 0; a' 0],

τ the image of the mean ray. The residual of a match (x, y) is e = y_12 (H x)_3 - y_3 (H x)_12, linear in the nine
products k = y ⊗ x, so that pair moments M suffice: with e = A k, S = Σ ee' = A M A'. For residual depth ζ and noise σ,
e has the covariance

    V = σ² (I + F F') + ζ² s² m m',   F = s (N + m a') - τ a', the upper-left block of H,

and the cost is half of Σ_c tr V⁻¹ S + n (log det V - log det (I + F F')) + priors of a, s, ζ, σ: total least squares
if the residual depth is zero. Orthographic points have H = [F τ; 0 0 1] with F = s (N + m a').

The residual is linear in R too: for fixed a, s, τ and V the cost is quadratic on SO(3), and its minimum solves a
generalized Sylvester equation (orthographic: A_c = s² Q'P' V⁻¹ P Q, B_c = Q'E' S_xx E Q, C_c = s Q'P' V⁻¹ S_yx E Q).
Alternating between R and the other unknowns converges slowly (by a factor of 0.3 to 0.8 per iteration on our scenes).
Here all unknowns are optimized jointly by Fisher scoring with Marquardt damping; each camera's own unknowns are
eliminated, so the work grows linearly with the number of cameras.

In the compiled kernels a camera's unknowns are, in order: w (3) of R = exp(w) R̂; then its own: a (2), log s, τ (2),
log ζ, log σ.

Source: our derivation (docs/method/2-sylvester.md, "The depth plane"); the equation is Chen & Schonfeld's (2010).
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
from sylpose.geometry.normal_equations import OBSERVABLE_ROTATION_SD, UNOBSERVABLE_RATIO, find_unobservable_directions
from sylpose.geometry.numba_linalg import dot, kernel
from sylpose.geometry.validation import MAX_MAGNITUDE, check_list, check_real, format_value
from sylpose.moments import PairMoments
from sylpose.results import RotationEstimate
from sylpose.status import Status
from sylpose.sylvester.orthographic import ROUNDING_SHARE, compute_views, moment_matrices

# Priors. A uniform direction of the plane's normal: a density of (1 + |a|²)^-3/2 for its slopes (derived).
SLOPE_POWER = 1.5
# Standard deviation of log s: an approach by 5 % is fast (choice).
LOG_SCALE_SD = 0.05
# Residual depth, as a share of the points' spread, and the standard deviation of its logarithm (choice: vague).
RESIDUAL_DEPTH, LOG_RESIDUAL_DEPTH_SD = 0.3, 0.7
# Noise, as a share of the points' spread: equivalent to one additional coordinate with this noise (choice).
NOISE_PRIOR = 0.005


class Problem(NamedTuple):
    """Input data of the C cameras with enough matches.

    Attributes:
        rotation_x, rotation_y: (C, 3, 3) Q of the rotated camera in frames i and j.
        M: (C, 9, 9) moments of the rotated rays, of mean third coordinate 1; orthographic: of the centered points.
        n: (C,) number of matches minus those that determine the camera's own unknowns.
        spread: (C,) of the points, per coordinate.
        noise: (C,) of an image coordinate, if it is known.
        noise_known: False to estimate the noise.
        perspective: False for orthographic points.
    """

    rotation_x: FloatArray
    rotation_y: FloatArray
    M: FloatArray
    n: FloatArray
    spread: FloatArray
    noise: FloatArray
    noise_known: bool
    perspective: bool


@kernel
def _predict(p: Problem, c: int, R: FloatArray, own: FloatArray, Rc: FloatArray, H: FloatArray) -> None:
    """Write R_c (3, 3) and H (3, 3)."""
    Qx, Qy = p.rotation_x[c], p.rotation_y[c]
    for i in range(3):
        for j in range(3):
            Rc[i, j] = 0.0
            for k in range(3):
                for m in range(3):
                    Rc[i, j] += Qy[i, k] * R[k, m] * Qx[j, m]
    s = np.exp(own[2])
    H[0, 2], H[1, 2], H[2, 2] = own[3], own[4], 1.0
    for i in range(3):
        for j in range(2):
            if p.perspective:
                H[i, j] = s * (Rc[i, j] + Rc[i, 2] * own[j]) - H[i, 2] * own[j]
            else:
                H[i, j] = s * (Rc[i, j] + Rc[i, 2] * own[j]) if i < 2 else 0.0


@kernel
def _residual_matrix(H: FloatArray, A: FloatArray) -> None:
    """Write A (2, 9): y_12 (H x)_3 - y_3 (H x)_12 = A (y ⊗ x). Linear in H."""
    A[:] = 0.0
    for j in range(3):
        A[0, j] = A[1, 3 + j] = H[2, j]
        A[0, 6 + j], A[1, 6 + j] = -H[0, j], -H[1, j]


@kernel
def _covariances(H: FloatArray, Rc: FloatArray, own: FloatArray, G: FloatArray, V: FloatArray) -> None:
    """Write G = I + F F' and V = σ² G + ζ² s² m m' (2, 2)."""
    noise, relief = np.exp(2.0 * own[6]), np.exp(2.0 * (own[5] + own[2]))
    for i in range(2):
        for j in range(2):
            G[i, j] = H[i, 0] * H[j, 0] + H[i, 1] * H[j, 1] + (1.0 if i == j else 0.0)
            V[i, j] = noise * G[i, j] + relief * Rc[i, 2] * Rc[j, 2]


@kernel
def _invert(a: FloatArray, out: FloatArray) -> float:
    """Write the inverse of a (2, 2) to out and return the determinant of a."""
    det = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    out[0, 0], out[1, 1] = a[1, 1] / det, a[0, 0] / det
    out[0, 1], out[1, 0] = -a[0, 1] / det, -a[1, 0] / det
    return float(det)


@kernel
def compute_costs(problem: Problem, R: FloatArray, own: FloatArray) -> FloatArray:
    """Return the negative log posterior (S,) at R (S, 3, 3) and own (S, C, 7)."""
    M, n, spread, out = problem.M, problem.n, problem.spread, np.zeros(len(R))
    Rc, H, A = np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 9))
    G, V, W = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    for start in range(len(R)):
        for c in range(len(n)):
            q = own[start, c]
            _predict(problem, c, R[start], q, Rc, H)
            _residual_matrix(H, A)
            _covariances(H, Rc, q, G, V)
            ratio = _invert(V, W)
            ratio /= G[0, 0] * G[1, 1] - G[0, 1] * G[1, 0]
            fit = n[c] * np.log(ratio)
            for i in range(2):
                for j in range(2):
                    for k in range(9):
                        for m in range(9):
                            fit += W[i, j] * A[j, k] * M[c, k, m] * A[i, m]
            out[start] += 0.5 * fit + SLOPE_POWER * np.log1p(q[0] ** 2 + q[1] ** 2) + 0.5 * (q[2] / LOG_SCALE_SD) ** 2
            out[start] += 0.5 * ((q[5] - np.log(RESIDUAL_DEPTH * spread[c])) / LOG_RESIDUAL_DEPTH_SD) ** 2
            if not problem.noise_known:
                out[start] += q[6] + 0.5 * (NOISE_PRIOR * spread[c] * np.exp(-q[6])) ** 2
    return out


@kernel
def compute_derivatives(
    problem: Problem, R: FloatArray, own: FloatArray, searching: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Return gradient (S, C, 10) and Fisher information (S, C, 10, 10) of each camera's cost.

    The information treats V's factor I + F F' as constant, as in total least squares. With `searching`, curvature by w
    that is missing where m and the residuals are small is added, which limits the steps.
    """
    n, (starts, cameras, _) = problem.n, own.shape
    gradient, information = np.empty((starts, cameras, _N)), np.empty((starts, cameras, _N, _N))
    Rc, H, A = np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 9))
    G, V, W, G_inverse = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    AM, S, pull, by_V, by_G = np.empty((2, 9)), np.empty((2, 2)), np.empty((2, 9)), np.empty((2, 2)), np.empty((2, 2))
    dH, dA, WdAM = np.empty((10, 3, 3)), np.empty((10, 2, 9)), np.empty((10, 2, 9))
    dV, WdV, dAM, dm = np.empty((10, 2, 2)), np.empty((10, 2, 2)), np.empty((2, 9)), np.empty((3, 2))
    for start in range(len(R)):
        for c in range(len(n)):
            q, g, info = own[start, c], gradient[start, c], information[start, c]
            M, Qy = problem.M[c], problem.rotation_y[c]
            _predict(problem, c, R[start], q, Rc, H)
            _residual_matrix(H, A)
            _covariances(H, Rc, q, G, V)
            _invert(V, W)
            _invert(G, G_inverse)
            _prediction_derivatives(problem, c, q, Rc, H, G, dH, dV)
            for i in range(2):
                for k in range(9):
                    AM[i, k] = dot(A[i], M[:, k])
                for j in range(2):
                    S[i, j] = dot(AM[i], A[j])
            noise = np.exp(2.0 * q[6])
            for i in range(2):
                for j in range(2):
                    by_V[i, j] = n[c] * W[i, j]
                    for k in range(2):
                        for m in range(2):
                            by_V[i, j] -= W[i, k] * S[k, m] * W[m, j]
                    by_G[i, j] = noise * by_V[i, j] - n[c] * G_inverse[i, j]
                for k in range(9):
                    pull[i, k] = W[i, 0] * AM[0, k] + W[i, 1] * AM[1, k]
            for u in range(10):
                _residual_matrix(dH[u], dA[u])
                g[u] = 0.0
                for i in range(2):
                    for k in range(9):
                        g[u] += pull[i, k] * dA[u, i, k]
                        dAM[i, k] = dot(dA[u, i], M[:, k])
                    for j in range(2):
                        dF_F = dH[u, i, 0] * H[j, 0] + dH[u, i, 1] * H[j, 1]
                        g[u] += 0.5 * by_V[i, j] * dV[u, i, j] + by_G[i, j] * dF_F
                        WdV[u, i, j] = W[i, 0] * dV[u, 0, j] + W[i, 1] * dV[u, 1, j]
                for i in range(2):
                    for k in range(9):
                        WdAM[u, i, k] = W[i, 0] * dAM[0, k] + W[i, 1] * dAM[1, k]
            for u in range(10):
                for v in range(u + 1):
                    total = 0.0
                    for i in range(2):
                        for k in range(9):
                            total += WdAM[u, i, k] * dA[v, i, k]
                        for j in range(2):
                            total += 0.5 * n[c] * WdV[u, i, j] * WdV[v, j, i]
                    info[u, v] = info[v, u] = total
            # Residual depth below the noise adds ζ² to the cost; its curvature by log ζ is missing in the information.
            info[8, 8] += 2.0 * max(g[8], 0.0)
            if searching:
                # V grows with the square of w where m = 0; for residuals of covariance V this term is zero on average.
                excess = 0.5 * max(by_V[0, 0] + by_V[1, 1], 0.0) * np.exp(2.0 * (q[5] + q[2]))
                for u in range(3):
                    dm[u, 0] = Qy[1, u] * Rc[2, 2] - Qy[2, u] * Rc[1, 2]
                    dm[u, 1] = Qy[2, u] * Rc[0, 2] - Qy[0, u] * Rc[2, 2]
                for u in range(3):
                    for v in range(3):
                        info[u, v] += excess * (dm[u, 0] * dm[v, 0] + dm[u, 1] * dm[v, 1])
            _add_priors(q, problem.spread[c], problem.noise_known, g, info)
    return gradient, information


@kernel
def _prediction_derivatives(
    p: Problem, c: int, own: FloatArray, Rc: FloatArray, H: FloatArray, G: FloatArray, dH: FloatArray, dV: FloatArray
) -> None:
    """Write dH (10, 3, 3), and dV (10, 2, 2) without the part through F."""
    Qy, perspective = p.rotation_y[c], p.perspective
    dH[:] = 0.0
    dV[:] = 0.0
    s, noise, relief = np.exp(own[2]), np.exp(2.0 * own[6]), np.exp(2.0 * (own[5] + own[2]))
    rotated = np.empty((3, 3))
    for u in range(3):
        # exp(w) left of R is exp(Q w) left of R_c: the cross product of the axis Q e_u with each column.
        for j in range(3):
            rotated[0, j] = Qy[1, u] * Rc[2, j] - Qy[2, u] * Rc[1, j]
            rotated[1, j] = Qy[2, u] * Rc[0, j] - Qy[0, u] * Rc[2, j]
            rotated[2, j] = Qy[0, u] * Rc[1, j] - Qy[1, u] * Rc[0, j]
        for i in range(3):
            for j in range(2):
                dH[u, i, j] = s * (rotated[i, j] + rotated[i, 2] * own[j])
        for i in range(2):
            for j in range(2):
                dV[u, i, j] = relief * (rotated[i, 2] * Rc[j, 2] + Rc[i, 2] * rotated[j, 2])
    for i in range(3):
        for j in range(2):
            dH[3 + j, i, j] = s * Rc[i, 2]
            dH[5, i, j] = s * (Rc[i, j] + Rc[i, 2] * own[j])
            if perspective:
                dH[3 + j, i, j] -= H[i, 2]
    for b in range(2):
        dH[6 + b, b, 2] = 1.0
        if perspective:
            dH[6 + b, b, 0], dH[6 + b, b, 1] = -own[0], -own[1]
    if not perspective:
        dH[:, 2] = 0.0
    for i in range(2):
        for j in range(2):
            dV[5, i, j] = dV[8, i, j] = 2.0 * relief * Rc[i, 2] * Rc[j, 2]
            dV[9, i, j] = 2.0 * noise * G[i, j]


@kernel
def _add_priors(own: FloatArray, spread: float, noise_known: bool, g: FloatArray, info: FloatArray) -> None:
    """Add the priors in place; if the noise is known, its unknown is fixed."""
    slope = 2.0 * SLOPE_POWER / (1.0 + own[0] ** 2 + own[1] ** 2)
    for i in range(2):
        g[3 + i] += slope * own[i]
        info[3 + i, 3 + i] += slope
    g[5] += own[2] / LOG_SCALE_SD**2
    info[5, 5] += 1.0 / LOG_SCALE_SD**2
    g[8] += (own[5] - np.log(RESIDUAL_DEPTH * spread)) / LOG_RESIDUAL_DEPTH_SD**2
    info[8, 8] += 1.0 / LOG_RESIDUAL_DEPTH_SD**2
    if noise_known:
        info[9], info[:, 9], g[9], info[9, 9] = 0.0, 0.0, 0.0, 1.0
    else:
        excess = (NOISE_PRIOR * spread * np.exp(-own[6])) ** 2
        g[9] += 1.0 - excess
        info[9, 9] += 2.0 * excess


# Minimum noise as a share of the spread, so that fits are not dominated by rounding: far below that of any image
# (choice).
MIN_NOISE = 1e-4
# Initial noise, as a share of the spread: a large value smooths the cost, which leaves few minima; a small one finds
# others (measured: docs/history/benchmarks.md#the-depth-plane, OK and not).
LARGE_INITIAL_NOISE, SMALL_INITIAL_NOISE = 0.2, 0.02
# Matches that determine a camera's own five unknowns (offset, plane and scale), two coordinates each
# (derived).
MATCHES_PER_OWN_UNKNOWNS = 2.5
# Minimum number of matches that leaves redundancy (derived).
MIN_MATCHES = 3

# Successful searches take 13 to 30; longer ones are slow searches from mirrored starts (choice).
MAX_ITERATIONS = 60
# Initial Marquardt damping; maximum steps of the rotation (radians) and of a camera's own unknowns, about the range in
# which the model is linear (choice).
INITIAL_DAMPING, MAX_ROTATION_STEP, MAX_OWN_STEP = 1e-3, 0.5, 1.5
# Converged if the predicted decrease (log-likelihood) is less: some 1e-5 standard deviations (derived: root of twice
# this).
DECREASE_TOLERANCE = 1e-10
# Accepted predicted decrease if the iteration limit ends a search: 0.05 standard deviations (derived, likewise).
LOOSE_DECREASE_TOLERANCE = 1e-3
# Another minimum makes the result uncertain if it is less likely by a factor of at least exp(-this): three standard
# deviations, 3²/2 (derived). It is distinct if it is at least as many standard deviations away by the information.
ALTERNATIVE_MARGIN = 4.5

_W = slice(0, 3)  # a camera's unknowns: w of R = exp(w) R̂, followed by its own
_N_OWN = 7  # a (2), log s, τ (2), log ζ, log σ
_N = 3 + _N_OWN
# All signs of three numbers but + + +.
_SIGNS = 1 - 2 * np.array(list(np.ndindex(2, 2, 2)))[1:]


@dataclass(frozen=True, eq=False, repr=False)
class DepthPlaneSolution(RotationEstimate):
    """Maximum a posteriori rotation with a local depth plane per camera.

    Attributes:
        status: `OK`; `TOO_FEW_MATCHES` (no result: no camera has three matches with spread); `ROTATION_NOT_OBSERVABLE`
            (one camera, or a direction whose standard deviation exceeds half of the rotation angle and one degree);
            `NOT_CERTIFIED` (a rotation beyond this one's uncertainty is nearly as likely); `NOT_CONVERGED`.
        information: (3, 3) of w, each camera's own unknowns eliminated.
        unobservable: (k, 3) unit directions of w with a standard deviation above half of the rotation angle and one
            degree; for a single camera at least its least observable direction.
        iterations: steps of all searches together.
        planes: (C, 2) slopes a of the depth in units of the depth at the camera's mean ray, along the x and y axes of
            the camera rotated onto that ray. This and the following fields are NaN for a camera with fewer than three
            matches.
        scales: (C,) s, scale change of the object's image.
        residual_depth: (C,) ζ, standard deviation of the depth about the plane, same units.
        sigma: (C,) noise of an image coordinate, normalized units.
        cost: negative log posterior up to a constant.
        converged: the search converged, or ended at the iteration limit within 0.05 standard deviations.
    """

    planes: FloatArray
    scales: FloatArray
    residual_depth: FloatArray
    sigma: FloatArray
    cost: float
    converged: bool


class SearchResult(NamedTuple):
    """End points of S searches: R (S, 3, 3), the cameras' own unknowns (S, C, 7), cost, convergence, iterations."""

    R: FloatArray
    own: FloatArray
    cost: FloatArray
    converged: BoolArray
    iterations: int


def solve_depth_plane(
    rotations: ArrayLike, moments: Sequence[PairMoments], *, noise: ArrayLike | None = None, aim: bool = True
) -> DepthPlaneSolution:
    """Estimate the object's rotation between two frames from the pair moments of two or more cameras.

    The result is exact for noise-free data if each camera observes points of one plane. It requires matches without
    outliers, and rotations over which a surface stays in view (tested up to 30 degrees). If all cameras look
    perpendicular to the rotation axis, only the change of their planes' images determines the angle: see `information`.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments; a weight of 1 is one match.
        noise: (C,) or one number, standard deviation of an image coordinate in normalized units (pixels over the focal
            length) in either frame; None: estimated with the other unknowns. At least 1e-4 of the points' spread is
            assumed.
        aim: False for orthographic points, whose mean is not a direction.

    Returns:
        The rotation with the depth plane, scale and noise of each camera.

    Raises:
        ValueError: shapes do not match, matrices are not rotations, or noise is not positive.
    """
    problem, used = build_problem(rotations, moments, noise, aim)
    own = np.full((len(used), _N_OWN), np.nan)
    R, information, unobservable = np.full((3, 3), np.nan), np.zeros((3, 3)), np.eye(3)
    status, cost, converged, iterations = Status.TOO_FEW_MATCHES, np.nan, False, 0
    if used.any():
        result = _search_all_starts(problem)
        # Among searches that end in the same minimum, prefer one that has converged.
        best = int(np.argmin(result.cost + np.where(result.converged, 0, LOOSE_DECREASE_TOLERANCE)))
        R, own[used], cost = result.R[best], result.own[best], float(result.cost[best])
        information = _information(problem, result.R[best : best + 1], result.own[best : best + 1])
        converged, iterations = bool(result.converged[best]), result.iterations
        turn = Rotation.from_matrix(R).magnitude()
        unobservable = find_unobservable_directions(information, max(UNOBSERVABLE_RATIO * turn, OBSERVABLE_ROTATION_SD))
        if used.sum() < 2 and len(unobservable) == 0:
            unobservable = np.linalg.eigh(information)[1][:, :1].T
        status = _classify(result, best, information, unobservable)
    cameras = own[:, :2], np.exp(own[:, 2]), np.exp(own[:, 5]), np.exp(own[:, 6])
    return DepthPlaneSolution(status, R, information, unobservable, iterations, *cameras, cost, converged)


def build_problem(
    rotations: ArrayLike, moments: Sequence[PairMoments], noise: ArrayLike | None, aim: bool
) -> tuple[Problem, BoolArray]:
    """Return the data of the cameras with enough matches, and the mask (C,) of these cameras."""
    moments = check_list(moments, PairMoments, "moments")
    views = compute_views(rotations, moments, aim=aim)
    sigma, expected = np.zeros(()), f"one number or one for each of {len(moments)} cameras"
    if noise is not None:
        sigma = check_real(noise, expected, "noise")
        if sigma.shape not in ((), (len(moments),)) or not ((sigma > 0) & (sigma < MAX_MAGNITUDE)).all():
            raise ValueError(f"noise must be positive, {expected}; got {format_value(noise)}")
    squares = np.trace(views.s_xx, axis1=1, axis2=2) + np.trace(views.s_yy, axis1=1, axis2=2)
    # Excludes rounding errors of centering.
    used = (views.weights >= MIN_MATCHES) & (squares > ROUNDING_SHARE * views.total)
    views = views.subset(used)
    M = moment_matrices(moments)[used]
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
    sigma = np.maximum(np.broadcast_to(sigma, used.shape)[used], MIN_NOISE * spread)
    Qx, Qy, M = (np.ascontiguousarray(a) for a in (views.rotation_x, views.rotation_y, to @ M @ transpose(to)))
    n = views.weights - MATCHES_PER_OWN_UNKNOWNS
    return Problem(Qx, Qy, M, n, spread, sigma, noise is not None, aim), used


def _search_all_starts(problem: Problem) -> SearchResult:
    """Search from the identity, then from the result with parts of its rotation mirrored."""
    # A given noise is applied at the end only: the search needs larger noise to start from.
    free_noise = problem._replace(noise_known=False)
    start = np.zeros((15, len(problem.n), _N_OWN))
    noise = np.repeat([LARGE_INITIAL_NOISE, SMALL_INITIAL_NOISE], [8, 7])[:, None]
    start[..., 5], start[..., 6] = np.log(RESIDUAL_DEPTH * problem.spread), np.log(noise * problem.spread)
    first = search_minima(free_noise, np.eye(3)[None], start[:1])
    rotation_vector = Rotation.from_matrix(first.R[0]).as_rotvec()
    # Other minima usually have the wrong sign along principal axes of the rig's viewing directions.
    directions = problem.rotation_x[:, 2]
    axes = np.linalg.eigh(directions.T @ directions)[1].T
    mirrored = Rotation.from_rotvec(((axes @ rotation_vector) * _SIGNS) @ axes).as_matrix()
    more = search_minima(free_noise, np.concatenate([mirrored, mirrored]), start[1:])
    both = (np.concatenate(pair) for pair in zip(first[:4], more[:4], strict=True))
    result = SearchResult._make([*both, first.iterations + more.iterations])
    if not problem.noise_known:
        return result
    result.own[..., 6] = np.log(problem.noise)
    last = search_minima(problem, result.R, result.own)
    return last._replace(iterations=result.iterations + last.iterations)


def _classify(found: SearchResult, best: int, information: FloatArray, unobservable: FloatArray) -> Status:
    if len(unobservable):
        return Status.ROTATION_NOT_OBSERVABLE
    if not found.converged[best]:
        return Status.NOT_CONVERGED
    distance = Rotation.from_matrix(found.R @ found.R[best].T).as_rotvec()
    is_distinct = np.einsum("si,ij,sj->s", distance, information, distance) > 2 * ALTERNATIVE_MARGIN
    is_ambiguous = (is_distinct & (found.cost < found.cost[best] + ALTERNATIVE_MARGIN)).any()
    return Status.NOT_CERTIFIED if is_ambiguous else Status.OK


def search_minima(problem: Problem, R: FloatArray, own: FloatArray) -> SearchResult:
    """Run Fisher scoring with Marquardt damping from S starts: rotations (S, 3, 3) and own unknowns (S, C, 7)."""
    cost = compute_costs(problem, R, own)
    damping, converged = np.full(len(R), INITIAL_DAMPING), np.zeros(len(R), dtype=bool)
    iteration, decrease = 0, np.full(len(R), np.inf)
    while iteration < MAX_ITERATIONS and not converged.all():
        iteration += 1
        gradient, hessian = compute_derivatives(problem, R, own, True)
        w, step, decrease = _compute_step(gradient, hessian, damping)
        length = np.maximum(np.linalg.norm(w, axis=1) / MAX_ROTATION_STEP, np.abs(step).max(axis=(1, 2)) / MAX_OWN_STEP)
        length = np.where(converged, 0, 1 / np.maximum(length, 1))
        new_R = Rotation.from_rotvec(length[:, None] * w).as_matrix() @ R
        new_own = own + length[:, None, None] * step
        new_cost = compute_costs(problem, new_R, new_own)
        better = new_cost <= cost + 1e-12 * np.abs(cost)
        # An uphill step of small predicted decrease is due to rounding. Damping reduces the prediction: undo that
        # first.
        decrease = decrease * (1 + damping)
        converged = converged | (decrease < DECREASE_TOLERANCE) | (~better & (decrease < 1e3 * DECREASE_TOLERANCE))
        R = np.where(better[:, None, None], new_R, R)
        own = np.where(better[:, None, None], new_own, own)
        cost = np.where(better, new_cost, cost)
        damping = np.where(better, np.maximum(damping / 10, 1e-12), np.minimum(np.maximum(damping * 10, 1e-6), 1e10))
    return SearchResult(R, own, cost, converged | (decrease < LOOSE_DECREASE_TOLERANCE), iteration)


def _compute_step(
    gradient: FloatArray, hessian: FloatArray, damping: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return w (S, 3), the step of the cameras' own unknowns (S, C, 7), and the predicted decrease of the cost (S,).

    Each camera's own unknowns are eliminated by the Schur complement.
    """
    damped = 1 + damping[:, None, None] * np.eye(3)
    gradient_w = gradient[..., _W].sum(axis=1)
    whole = hessian[..., _W, _W].sum(axis=1)
    mixed = hessian[..., _W, 3:]
    hessian_own = hessian[..., 3:, 3:] * (1 + damping[:, None, None, None] * np.eye(_N_OWN))
    solved = np.linalg.solve(hessian_own, np.concatenate([gradient[..., 3:, None], transpose(mixed)], axis=-1))
    reduced = whole * damped - (mixed @ solved[..., 1:]).sum(axis=1)
    # No step along unobserved directions.
    reduced[:, range(3), range(3)] += 1e-12 * np.trace(whole, axis1=1, axis2=2)[:, None] + 1e-300
    w = -np.linalg.solve(reduced, (gradient_w - (mixed @ solved[..., :1])[..., 0].sum(axis=1))[..., None])[..., 0]
    step = -solved[..., 0] - (solved[..., 1:] @ w[:, None, :, None])[..., 0]
    decrease = -0.5 * ((gradient_w * w).sum(axis=1) + (gradient[..., 3:] * step).sum(axis=(1, 2)))
    return w, step, decrease


def _information(problem: Problem, R: FloatArray, own: FloatArray) -> FloatArray:
    """Return the information (3, 3) of w at one point, with the cameras' own unknowns eliminated."""
    hessian = compute_derivatives(problem, R, own)[1][0]
    mixed = hessian[:, _W, 3:]
    information = (hessian[:, _W, _W] - mixed @ np.linalg.solve(hessian[:, 3:, 3:], transpose(mixed))).sum(axis=0)
    return np.asarray((information + information.T) / 2)
