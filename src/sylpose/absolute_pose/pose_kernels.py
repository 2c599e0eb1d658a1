"""Compiled loops of `estimate_pose`: robust scores, the fit, the noise, and what is concluded from a pose.

All of them take the same `Views`: n matches sorted by camera.
"""

from __future__ import annotations

from math import lgamma
from typing import NamedTuple

import numpy as np

from sylpose.absolute_pose.views import MAX_SEARCH_MATCHES, MIN_MATCHES, Selection, Views
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import compute_covariance
from sylpose.geometry.normal_equations import UNOBSERVABLE_RATIO, UNOBSERVABLE_ROTATION_SD, add_rotated
from sylpose.geometry.numba_linalg import (
    apply_rotvec,
    cholesky_solve,
    compute_median,
    dot,
    kernel,
    leaf,
    so3_log,
    symmetric_eigen,
)
from sylpose.geometry.robust_loss import (
    BIQUARTIC_BOUND,
    DEFAULT_NOISE_PX,
    biquartic,
    biquartic_loss,
    biquartic_noise_response,
)

# A pose is due to chance if random matches give one as good with a higher expected number, and so is one of a minority of
# the matches if its inliers are mismatches with higher odds (choice).
MAX_FALSE_ALARMS = 0.01
# Degrees of freedom of the noise prior. Default noise: four matches, which leave two, may agree far better than they
# were measured. Given noise: known to an eighth of its size (choice).
DEFAULT_NOISE_FREEDOM, KNOWN_NOISE_FREEDOM = 2.0, 30.0
# Odds from which the better of two similar poses is accepted (measured: of flat models of 4 to 20 points with one
# camera and status OK, 1 in 250 is the mirror image; with odds of 3, 1 in 20) (choice).
CLEAR_ODDS = 20.0
# A camera supports a pose if this fraction of its matches are inliers; no more of all are a minority (choice:
# a majority).
MIN_INLIER_RATIO = 0.5
# Cutoff of the biquartic weights: nearly 1 up to two sigma, 0 beyond five (choice).
CUTOFF = 5.0
# For Gaussian noise: reduction of the mean weight and of the mean weighted square by these weights, and the factor
# missing in the information from the weights (derived).
_NOISE_RESPONSE = biquartic_noise_response(CUTOFF)
WEIGHT_LOSS, SQUARE_LOSS = 1.0 - _NOISE_RESPONSE.weight, 1.0 - _NOISE_RESPONSE.square
INFORMATION_GAIN = _NOISE_RESPONSE.gain
# Median of the squared length of two Gaussian coordinates, in variances of one (derived).
MEDIAN_SQUARE = 2.0 * np.log(2.0)
# The cutoff loses an inlier less often than once in exp(LOG_MISS_ODDS) with an uncertain noise level (choice).
LOG_MISS_ODDS = 8.0
# Distances due to rounding alone, pixels: a lower limit of the noise (choice).
ROUNDING_PX = 1e-6
# A camera has an individual noise level if its variance differs from the others' by so many standard deviations and it
# has so many degrees of freedom (choice).
MIN_DEVIATION_SIGMAS, MIN_OWN_FREEDOM = 4.0, 8.0
# Rounds of re-weighting (choice).
MAX_ITERATIONS = 50
# A search has converged if the loss decreases by less (choice: a hundredth of a standard deviation).
MIN_DECREASE = 1e-4
# Iterations of re-weighting with the median's noise (choice).
MEDIAN_ROUNDS = 3
# Normal equations process eight matches at a time, in a loop over lanes of one array with constant offsets, so that the
# processor handles several per instruction. Lanes, and the values of each: x, y, z of the point, its image, `to_pixels`
# and 1 or 0 to pad; sums of the loss, and of the products of six derivatives and a residual with the derivatives (derived).
LANES, LOSS, SUMS, N_VALUES = 8, 10, 11, 53


class Noise(NamedTuple):
    """The noise of each camera.

    Attributes:
        variances: (C,) of a coordinate, pixels squared.
        cutoffs: (C,) squared distances, pixels squared, from which on a match is an outlier.
    """

    variances: FloatArray
    cutoffs: FloatArray


class ModelPose(NamedTuple):
    """Rotation R (3, 3) and translation g (3,): a model point X, relative to the model's center, is at R X + g."""

    rotation: FloatArray
    translation: FloatArray


class Workspace(NamedTuple):
    """Workspace for one camera.

    Attributes:
        model: pose of the model in it.
        lanes: (N_VALUES LANES,) a batch of matches and sums over batches (`_add_batch`).
        lower: (7, 6) lower triangle of the normal equations in its axes.
    """

    model: ModelPose
    lanes: FloatArray
    lower: FloatArray


class Pose(NamedTuple):
    """Fitted pose of the model in the world.

    Attributes:
        model: the pose.
        squares, weights: (n,) squared reprojection errors, pixels, and robust weights.
        noise: estimated from the residuals.
        iterations: of the fit.
        freedom: degrees of freedom of the noise.
        converged: whether the fit converged.
    """

    model: ModelPose
    squares: FloatArray
    weights: FloatArray
    noise: Noise
    iterations: int
    freedom: float
    converged: bool


@kernel
def make_noise(views: Views, max_square: float) -> Noise:
    """Return the noise of the largest cutoff, for all cameras."""
    n = len(views.rotations)
    return Noise(np.full(n, max_square / (CUTOFF * CUTOFF)), np.full(n, max_square))


@kernel
def make_workspace() -> Workspace:
    """Allocate a workspace."""
    return Workspace(ModelPose(np.empty((3, 3)), np.empty(3)), np.empty(N_VALUES * LANES), np.empty((7, 6)))


@leaf
def _camera_from_model(views: Views, c: int, pose: ModelPose, workspace: Workspace) -> None:
    """Write the transform from the model to camera c to the workspace."""
    q, t, (r, g), out = views.rotations[c], views.translations[c], pose, workspace.model
    for i in range(3):
        out.translation[i] = t[i] + q[i, 0] * g[0] + q[i, 1] * g[1] + q[i, 2] * g[2]
        for j in range(3):
            out.rotation[i, j] = q[i, 0] * r[0, j] + q[i, 1] * r[1, j] + q[i, 2] * r[2, j]


@leaf
def _project_match(views: Views, k: int, workspace: Workspace) -> tuple[float, float, float, float, float]:
    """Project match k: depth, normalized image (2), reprojection error in pixels (2); for positive depths only."""
    x, y, z = views.points[k, 0], views.points[k, 1], views.points[k, 2]
    r, t = workspace.model
    depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
    inverse_depth = 1.0 / depth
    u = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]) * inverse_depth
    v = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]) * inverse_depth
    du, dv = u - views.images[k, 0], v - views.images[k, 1]
    jacobian = views.to_pixels
    return depth, u, v, jacobian[k, 0] * du + jacobian[k, 1] * dv, jacobian[k, 2] * du + jacobian[k, 3] * dv


@leaf
def compute_squares(views: Views, pose: ModelPose, out: FloatArray, workspace: Workspace) -> None:
    """Write squared reprojection errors, pixels, to out (n,); infinite behind a camera."""
    for c in range(len(views.rotations)):
        _camera_from_model(views, c, pose, workspace)
        for k in range(views.start[c], views.start[c + 1]):
            depth, _, _, r0, r1 = _project_match(views, k, workspace)
            out[k] = r0 * r0 + r1 * r1 if depth > 0.0 else np.inf


@leaf
def _compute_radius(views: Views) -> float:
    """Return the rms distance of the model points from the model's center."""
    square = 0.0
    for k in range(len(views.points)):
        for i in range(3):
            square += views.points[k, i] ** 2
    return float(np.sqrt(square / len(views.points)))


@leaf
def _compute_chance(views: Views, translation: FloatArray, weights: FloatArray, noise: Noise) -> tuple[int, float]:
    """Return the number of inliers and the sum of the logarithms of a random match's probability of being one.

    Inliers are the matches with weights (n,). The probability is the fraction of the object's image that a circle of
    `CUTOFF` sigma covers.
    """
    radius, n_inliers, log_share = _compute_radius(views), 0, 0.0
    for c in range(len(views.rotations)):
        camera_inliers = 0
        for k in range(views.start[c], views.start[c + 1]):
            camera_inliers += weights[k] > 0.0
        q, jacobian = views.rotations[c, 2], views.to_pixels[views.start[c]]
        depth = q[0] * translation[0] + q[1] * translation[1] + q[2] * translation[2] + views.translations[c, 2]
        size = np.sqrt(abs(jacobian[0] * jacobian[3] - jacobian[1] * jacobian[2])) * radius / max(depth, 1e-300)
        log_share += camera_inliers * np.log(min(max(CUTOFF**2 * noise.variances[c] / size**2, 1e-12), 1.0))
        n_inliers += camera_inliers
    return n_inliers, log_share


@leaf
def compute_log_false_alarms(views: Views, pose: Pose) -> float:
    """Return the logarithm of the number of false alarms (NFA).

    This is the expected number of poses as good as this one from random matches. A random match is an inlier with a
    probability equal to the fraction of the object's image that a circle of `CUTOFF` sigma covers; the inliers, and the
    three of them that determine the pose, may be chosen. This balances the number of inliers against their accuracy: of
    poses of the same data the one with the smallest value is the best.

    Source: Moisan & Stival, a contrario RANSAC, 2004.
    """
    n = len(pose.weights)
    k, log_share = _compute_chance(views, pose.model.translation, pose.weights, pose.noise)
    choices = lgamma(n + 1.0) - lgamma(n - k + 1.0) - lgamma(4.0) - lgamma(k - 2.0)
    return float(np.log(n) + choices + (k - 3.0) / k * log_share)


@leaf
def _compute_local_inlier_ratio(views: Views, weights: FloatArray, n_inliers: int) -> float:
    """Return the inlier ratio near the inliers, weighted by their numbers of neighbors: matches of the same camera.

    A neighbor is nearer than the rms distance of the model points from the center; an inlier is its own neighbor. Of many
    inliers, a part is examined.
    """
    max_square, step = _compute_radius(views) ** 2, 1 + n_inliers // MAX_SEARCH_MATCHES
    n_near, n_near_inliers, index = 0, 0, 0
    for c in range(len(views.rotations)):
        first, last = views.start[c], views.start[c + 1]
        for k in range(first, last):
            if not weights[k] > 0.0:
                continue
            index += 1
            if index % step != 0:
                continue
            for m in range(first, last):
                square = 0.0
                for i in range(3):
                    square += (views.points[m, i] - views.points[k, i]) ** 2
                if square < max_square:
                    n_near += 1
                    n_near_inliers += weights[m] > 0.0
    return n_near_inliers / n_near


@leaf
def is_by_chance(views: Views, pose: Pose) -> bool:
    """Return whether random matches could give a pose as good.

    If all matches are inliers, there was no choice among them, and only the matches beyond the minimal three count as
    evidence.
    """
    k, log_share = _compute_chance(views, pose.model.translation, pose.weights, pose.noise)
    if k < len(pose.weights):
        return bool(compute_log_false_alarms(views, pose) > np.log(MAX_FALSE_ALARMS))
    return bool((k - 3.0) / k * log_share > np.log(MAX_FALSE_ALARMS))


@leaf
def may_be_other_side(views: Views, pose: Pose) -> bool:
    """Return whether a minority of inliers may be mismatches of a side that looks alike.

    Such matches are not random: edges and corners agree with a wrong pose, in numbers that random matches never reach. But
    they are less exact, and the matches between them disagree, while a right pose explains nearly all matches of the region
    that it shows. So inliers must also have low odds of being mismatches: (1 - e) p / e, with e the inlier ratio near
    inliers, and p the probability of a random match being one (geometric mean).
    """
    k, log_share = _compute_chance(views, pose.model.translation, pose.weights, pose.noise)
    if k > MIN_INLIER_RATIO * len(pose.weights):
        return False
    ratio = _compute_local_inlier_ratio(views, pose.weights, k)
    return not (1.0 - ratio) * np.exp(log_share / k) < MAX_FALSE_ALARMS * ratio


@leaf
def compute_score(views: Views, pose: ModelPose, max_square: float, bound: float, workspace: Workspace) -> float:
    """Return the sum of the matches' losses, each between 0 and 1; stop beyond `bound`.

    The cutoff is sqrt(max_square) pixels.
    """
    total = 0.0
    for c in range(len(views.rotations)):
        _camera_from_model(views, c, pose, workspace)
        for k in range(views.start[c], views.start[c + 1]):
            depth, _, _, r0, r1 = _project_match(views, k, workspace)
            ratio = (r0 * r0 + r1 * r1) / max_square if depth > 0.0 else 2.0
            total += biquartic_loss(ratio) / BIQUARTIC_BOUND
            if total > bound:
                return total
    return total


@leaf
def _build_normal_equations(
    views: Views, pose: ModelPose, noise: Noise, hessian: FloatArray, gradient: FloatArray, workspace: Workspace
) -> float:
    """Write hessian (6, 6) and gradient (6,) by (w, d) of the re-weighted squares, in variances; return the loss."""
    gradient[:] = 0.0
    hessian[:] = 0.0
    lanes, lower, loss = workspace.lanes, workspace.lower, 0.0
    for c in range(len(views.rotations)):
        _camera_from_model(views, c, pose, workspace)
        q, last, per_variance = views.rotations[c], views.start[c + 1], 1.0 / noise.variances[c]
        lanes[LOSS * LANES :] = 0.0
        for first in range(views.start[c], last, LANES):
            _load_batch(views, first, min(LANES, last - first), lanes)
            _add_batch(workspace.model, noise.cutoffs[c], lanes)
        loss += 0.5 * noise.cutoffs[c] * per_variance * _sum_lanes(lanes, LOSS)
        for i in range(7):
            for j in range(min(i + 1, 6)):
                lower[i, j] = per_variance * _sum_lanes(lanes, SUMS + 6 * i + j)
        add_rotated(lower, q, hessian)
        for i in range(3):
            gradient[i] += lower[6, 0] * q[0, i] + lower[6, 1] * q[1, i] + lower[6, 2] * q[2, i]
            gradient[3 + i] += lower[6, 3] * q[0, i] + lower[6, 4] * q[1, i] + lower[6, 5] * q[2, i]
    return loss


@leaf
def _load_batch(views: Views, first: int, count: int, lanes: FloatArray) -> None:
    """Load `count` matches from `first` on, padded with copies of the last one without weight."""
    for k in range(LANES):
        m = first + min(k, count - 1)
        for j in range(3):
            lanes[j * LANES + k] = views.points[m, j]
        for j in range(2):
            lanes[(3 + j) * LANES + k] = views.images[m, j]
        for j in range(4):
            lanes[(5 + j) * LANES + k] = views.to_pixels[m, j]
        lanes[9 * LANES + k] = 1.0 if k < count else 0.0


@leaf
def _add_batch(pose: ModelPose, cutoff: float, lanes: FloatArray) -> None:
    """Add the losses, weighted derivatives and residuals of a batch to its sums, by (w, d) in the camera's axes.

    Args:
        pose: of the model in the camera.
        cutoff: squared distance, pixels squared.
        lanes: of the workspace.
    """
    r, t = pose.rotation, pose.translation
    r00, r01, r02, r10, r11, r12 = r[0, 0], r[0, 1], r[0, 2], r[1, 0], r[1, 1], r[1, 2]
    r20, r21, r22, t0, t1, t2 = r[2, 0], r[2, 1], r[2, 2], t[0], t[1], t[2]
    per_cutoff = 1.0 / cutoff
    for k in range(LANES):
        x, y, z = lanes[k], lanes[LANES + k], lanes[2 * LANES + k]
        # The point relative to the model's center.
        p0, p1, p2 = r00 * x + r01 * y + r02 * z, r10 * x + r11 * y + r12 * z, r20 * x + r21 * y + r22 * z
        in_front = p2 + t2 > 0.0
        per_depth = 1.0 / (p2 + t2 if in_front else 1.0)
        u, v = (p0 + t0) * per_depth, (p1 + t1) * per_depth
        du, dv = u - lanes[3 * LANES + k], v - lanes[4 * LANES + k]
        j00, j01, j10, j11 = lanes[5 * LANES + k], lanes[6 * LANES + k], lanes[7 * LANES + k], lanes[8 * LANES + k]
        e0, e1 = j00 * du + j01 * dv, j10 * du + j11 * dv
        ratio = (e0 * e0 + e1 * e1) * per_cutoff
        is_inlier = in_front and ratio < 1.0
        # Zeros instead of large numbers, which times a weight of 0 might not be 0.
        ratio, e0, e1 = ratio if is_inlier else 0.0, e0 if is_inlier else 0.0, e1 if is_inlier else 0.0
        u, v, per_depth = u if is_inlier else 0.0, v if is_inlier else 0.0, per_depth if is_inlier else 0.0
        square, usable = ratio * ratio, lanes[9 * LANES + k]
        loss = ratio * (1.0 - square * (2.0 / 3.0 - 0.2 * square)) if is_inlier else BIQUARTIC_BOUND
        lanes[LOSS * LANES + k] += usable * loss
        weight = usable * (1.0 - square) * (1.0 - square)
        g0, g1, h0, h1 = j00 * per_depth, j01 * per_depth, j10 * per_depth, j11 * per_depth
        g2, h2 = -(g0 * u + g1 * v), -(h0 * u + h1 * v)
        a = (p1 * g2 - p2 * g1, p2 * g0 - p0 * g2, p0 * g1 - p1 * g0, g0, g1, g2, e0)
        b = (p1 * h2 - p2 * h1, p2 * h0 - p0 * h2, p0 * h1 - p1 * h0, h0, h1, h2, e1)
        for i in range(7):
            weighted_a, weighted_b = weight * a[i], weight * b[i]
            for j in range(min(i + 1, 6)):
                lanes[(SUMS + 6 * i + j) * LANES + k] += weighted_a * a[j] + weighted_b * b[j]


@leaf
def _sum_lanes(lanes: FloatArray, value: int) -> float:
    """Return the sum of a value over the lanes."""
    a = lanes[value * LANES : (value + 1) * LANES]
    return float(((a[0] + a[4]) + (a[1] + a[5])) + ((a[2] + a[6]) + (a[3] + a[7])))


@leaf
def _compute_loss(squares: FloatArray, start: IntArray, noise: Noise) -> float:
    """Return the loss as in `_build_normal_equations` from the squared distances (n,)."""
    loss = 0.0
    for c in range(len(start) - 1):
        cutoff, camera_loss = noise.cutoffs[c], 0.0
        for k in range(start[c], start[c + 1]):
            camera_loss += biquartic_loss(squares[k] / cutoff)
        loss += 0.5 * cutoff / noise.variances[c] * camera_loss
    return loss


@leaf
def _copy_pose(target: ModelPose, source: ModelPose) -> None:
    for i in range(3):
        target.translation[i] = source.translation[i]
        for j in range(3):
            target.rotation[i, j] = source.rotation[i, j]


@leaf
def _solve_step(
    hessian: FloatArray, gradient: FloatArray, damping: float, damped: FloatArray, step: FloatArray
) -> float:
    """Write the damped step (6,) and return the decrease it predicts; infinite, without a step, if they are singular.

    Args:
        damped: (6, 6) workspace.
    """
    for i in range(6):
        for j in range(6):
            damped[i, j] = hessian[i, j]
        damped[i, i] *= 1.0 + damping
        step[i] = -gradient[i]
    return -0.5 * dot(step, gradient) if cholesky_solve(damped, step) else np.inf


@leaf
def _move_pose(pose: ModelPose, step: FloatArray, out: ModelPose) -> None:
    """Write the pose after a step (6,) of (w, d)."""
    apply_rotvec(step[:3], pose.rotation, out.rotation)
    for i in range(3):
        out.translation[i] = pose.translation[i] + step[3 + i]


@kernel
def minimize(views: Views, pose: ModelPose, noise: Noise, steps: int, damping: float) -> None:
    """Run Levenberg-Marquardt on the loss with constant noise, in place."""
    hessian, gradient = np.empty((6, 6)), np.empty(6)
    new_hessian, new_gradient = np.empty((6, 6)), np.empty(6)
    new, damped, step, workspace = (
        ModelPose(np.empty((3, 3)), np.empty(3)),
        np.empty((6, 6)),
        np.empty(6),
        make_workspace(),
    )
    loss = _build_normal_equations(views, pose, noise, hessian, gradient, workspace)
    for _ in range(steps):
        predicted_decrease = _solve_step(hessian, gradient, damping, damped, step)
        if predicted_decrease < MIN_DECREASE:
            break
        if predicted_decrease == np.inf:
            damping = max(10.0 * damping, 1e-8)
            continue
        _move_pose(pose, step, new)
        new_loss = _build_normal_equations(views, new, noise, new_hessian, new_gradient, workspace)
        if new_loss <= loss:
            _copy_pose(pose, new)
            hessian, new_hessian, gradient, new_gradient = new_hessian, hessian, new_gradient, gradient
            loss = new_loss
            damping = 0.1 * damping if damping > 1e-6 else 0.0
        else:
            damping = max(10.0 * damping, 1e-3)


@kernel
def fit_pose(views: Views, start: ModelPose, max_square: float) -> Pose:
    """Fit a pose robustly from a start by re-weighting with the noise estimated from the residuals.

    The median estimates the noise at first, because it tolerates outliers and an inexact start; then the weighted mean
    square does, which is more efficient without outliers. Each round takes one step of Levenberg-Marquardt.

    Args:
        max_square: squared distances beyond it are outliers whatever the noise.
    """
    pose, new = ModelPose(start.rotation.copy(), start.translation.copy()), ModelPose(np.empty((3, 3)), np.empty(3))
    n, noise, workspace = len(views.points), make_noise(views, max_square), make_workspace()
    squares, new_squares, weights = np.empty(n), np.empty(n), np.zeros(n)
    hessian, gradient, damped, step = np.empty((6, 6)), np.empty(6), np.empty((6, 6)), np.empty(6)
    damping, freedom, predicted_decrease, change = 1e-4, 1.0, np.inf, np.inf
    compute_squares(views, pose, squares, workspace)
    iteration = 0
    for iteration in range(MAX_ITERATIONS):
        previous_variance = noise.variances[0]
        if iteration < MEDIAN_ROUNDS:
            median, count = compute_median_square(squares, max_square)
            if count < 4:
                return Pose(pose, squares, weights, noise, iteration, 1.0, False)
            # Corrected for six fitted unknowns.
            variance = median / MEDIAN_SQUARE * count / max(count - 3.0, 1.0)
            for c in range(len(noise.cutoffs)):
                set_noise(noise, c, variance, views.min_variance, max(2.0 * count - 6.0, 1.0), max_square)
        else:
            compute_weights(squares, views.start, noise, weights)
            freedom = estimate_noise(squares, views.start, weights, views.min_variance, max_square, noise)
            change = abs(noise.variances[0] / previous_variance - 1.0)
        if iteration > MEDIAN_ROUNDS and predicted_decrease < 1e-10 and change < 1e-4:
            break
        loss = _build_normal_equations(views, pose, noise, hessian, gradient, workspace)
        predicted_decrease = _solve_step(hessian, gradient, damping, damped, step)
        if predicted_decrease == np.inf:
            damping = max(10.0 * damping, 1e-8)
            continue
        _move_pose(pose, step, new)
        compute_squares(views, new, new_squares, workspace)
        if _compute_loss(new_squares, views.start, noise) <= loss:
            _copy_pose(pose, new)
            squares, new_squares = new_squares, squares
            damping = 0.1 * damping if damping > 1e-6 else 0.0
        else:
            damping = max(10.0 * damping, 1e-3)
    compute_weights(squares, views.start, noise, weights)
    converged = predicted_decrease < 1e-4 and change < 0.1
    return Pose(pose, squares, weights, noise, iteration, freedom, converged)


@leaf
def compute_median_square(squares: FloatArray, max_square: float) -> tuple[float, int]:
    """Return the median of the squares below `max_square`, to a thousandth, and their number.

    Bisection needs no copy and no sorting.
    """
    count = 0
    for s in squares:
        count += s < max_square
    low, high = 0.0, max_square
    # The noise is anywhere between rounding and the cutoff: halve the exponent first.
    for _ in range(60):
        if high < 1.001 * low:
            break
        middle = np.sqrt(low * high) if low > 0.0 else 0.01 * high
        below = 0
        for s in squares:
            below += s < middle
        if 2 * below >= count:
            high = middle
        else:
            low = middle
        if high < ROUNDING_PX * ROUNDING_PX:
            break
    return high, count


@leaf
def compute_weights(squares: FloatArray, start: IntArray, noise: Noise, weights: FloatArray) -> None:
    """Write the weights (n,) of squared distances (n,)."""
    for c in range(len(start) - 1):
        for k in range(start[c], start[c + 1]):
            weights[k] = biquartic(squares[k] / noise.cutoffs[c])


@leaf
def set_noise(noise: Noise, c: int, variance: float, min_variance: float, freedom: float, max_square: float) -> None:
    """Set camera c's variance, at least `min_variance`, and its cutoff for so many degrees of freedom."""
    variance = max(variance, min_variance, ROUNDING_PX * ROUNDING_PX)
    # Few degrees of freedom may underestimate the noise: the cutoff is then Student's, not Gauss's.
    factor = max(CUTOFF * CUTOFF, freedom * (np.exp(min(2.0 * LOG_MISS_ODDS / freedom, 50.0)) - 1.0))
    noise.variances[c] = variance
    noise.cutoffs[c] = min(factor * variance, max_square)


@kernel
def estimate_noise(
    squares: FloatArray, start: IntArray, weights: FloatArray, min_variance: float, max_square: float, noise: Noise
) -> float:
    """Estimate the noise from the weighted squares: one level for all cameras except significantly different ones.

    Args:
        min_variance: lower limit of the variances.

    Returns:
        degrees of freedom.
    """
    n_cameras = len(start) - 1
    sums, counts = np.zeros(n_cameras), np.zeros(n_cameras)
    total = 0.0
    for c in range(n_cameras):
        n_inliers = 0
        for k in range(start[c], start[c + 1]):
            if weights[k] > 0.0:
                sums[c] += weights[k] * squares[k]
                counts[c] += weights[k]
                n_inliers += 1
        # The reduction by the weights of Gaussian noise goes with the fourth power of the cutoff.
        loss_factor = (CUTOFF * CUTOFF * noise.variances[c] / noise.cutoffs[c]) ** 2
        sums[c] /= 1.0 - min(loss_factor * SQUARE_LOSS, 0.5)
        counts[c] = 2.0 * min(counts[c] / (1.0 - min(loss_factor * WEIGHT_LOSS, 0.5)), float(n_inliers))
        total += counts[c]
    freedom = max(total - 6.0, 1.0)
    freedom_ratio = freedom / max(total, 1.0)
    has_own_noise = np.zeros(n_cameras, np.bool_)
    common = 1.0
    for _ in range(3):
        squared, free = 0.0, 0.0
        for c in range(n_cameras):
            if not has_own_noise[c]:
                squared, free = squared + sums[c], free + freedom_ratio * counts[c]
        if free <= 0.0:
            break
        common = max(squared / free, ROUNDING_PX * ROUNDING_PX)
        for c in range(n_cameras):
            own_freedom = freedom_ratio * counts[c]
            # A camera with mostly inconsistent matches has outliers, not noise.
            if own_freedom >= MIN_OWN_FREEDOM and counts[c] >= start[c + 1] - start[c]:
                ratio = np.log(max(sums[c] / own_freedom, ROUNDING_PX * ROUNDING_PX) / common)
                has_own_noise[c] = abs(ratio) > MIN_DEVIATION_SIGMAS * np.sqrt(2.0 / own_freedom + 2.0 / free)
    for c in range(n_cameras):
        variance = sums[c] / (freedom_ratio * counts[c]) if has_own_noise[c] else common
        set_noise(noise, c, variance, min_variance, freedom, max_square)
    return freedom


class Assessment(NamedTuple):
    """What follows from a fitted pose of C cameras with matches.

    Attributes:
        transform: (4, 4) world_from_object.
        information, covariance: (6, 6) of (w, d).
        limits: (6,) standard deviations beyond which (w, d) are unobservable: an angle, and half of the distance.
        is_observable: whether all directions of (w, d) are within the limits.
        alternative: index of a pose with a different rotation that explains the matches about as well, or -1.
        is_by_chance: whether random matches, or those of another side, could give a pose as good.
        n_supporting, n_opposing: number of cameras that support the pose, and of those that may support another one.
        inliers: (C,) number of inliers of each camera.
        all_inliers: whether all used matches are inliers.
        is_inlier: (n,) whether each given match is an inlier.
        residuals: rms error of the inliers of each camera of the rig, pixels; NaN without any.
    """

    transform: FloatArray
    information: FloatArray
    covariance: FloatArray
    limits: FloatArray
    is_observable: bool
    alternative: int
    is_by_chance: bool
    n_supporting: int
    n_opposing: int
    inliers: IntArray
    all_inliers: bool
    is_inlier: BoolArray
    residuals: FloatArray


@kernel
def assess_pose(
    selection: Selection,
    pose: Pose,
    rotations: FloatArray,
    translations: FloatArray,
    n_alternatives: int,
    per_px: FloatArray,
) -> Assessment:
    """Assess a fitted pose.

    Args:
        rotations, translations: (K, 3, 3) and (K, 3), `n_alternatives` of them alternatives.
        per_px: units of the image plane per pixel, for each camera of the rig.
    """
    views = selection.views
    n_cameras, min_distance = len(views.rotations), np.inf
    information, covariance, limits = np.empty((6, 6)), np.empty((6, 6)), np.full(6, UNOBSERVABLE_ROTATION_SD)
    _build_normal_equations(views, pose.model, pose.noise, information, np.empty(6), make_workspace())
    variance = compute_median(pose.noise.variances.copy())
    information *= INFORMATION_GAIN * _information_scale(pose, variance, views.min_variance)
    compute_covariance(information, covariance)
    inliers, residuals, n_supporting, n_opposing = np.zeros(n_cameras, np.int64), np.full(len(per_px), np.nan), 0, 0
    q, g, t = views.rotations, pose.model.translation, views.translations
    for c in range(n_cameras):
        squares = 0.0
        for k in range(views.start[c], views.start[c + 1]):
            if pose.weights[k] > 0.0:
                inliers[c] += 1
                squares += pose.squares[k]
        residuals[selection.cameras[c]] = np.sqrt(squares / inliers[c]) / per_px[selection.cameras[c]]
        count = views.start[c + 1] - views.start[c]
        is_supporting = inliers[c] >= MIN_INLIER_RATIO * count
        n_supporting += is_supporting
        n_opposing += not is_supporting and count - inliers[c] >= MIN_MATCHES
        square = 0.0
        for i in range(3):
            square += (q[c, i, 0] * g[0] + q[c, i, 1] * g[1] + q[c, i, 2] * g[2] + t[c, i]) ** 2
        min_distance = min(min_distance, np.sqrt(square))
    limits[3:] = UNOBSERVABLE_RATIO * min_distance
    values, in_limits = np.empty(6), np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            in_limits[i, j] = information[i, j] * limits[i] * limits[j]
    symmetric_eigen(in_limits, values, np.empty((6, 6)))
    alternative = _find_alternative(views, pose, variance, rotations, translations, n_alternatives)
    is_inlier = np.zeros(len(selection.used), np.bool_)
    for k in range(len(is_inlier)):
        is_inlier[k] = selection.used[k] >= 0 and pose.weights[selection.used[k]] > 0.0
    transform, center = np.eye(4), selection.center
    for i in range(3):
        r = pose.model.rotation[i]
        for j in range(3):
            transform[i, j] = r[j]
        transform[i, 3] = selection.origin[i] + g[i] - (r[0] * center[0] + r[1] * center[1] + r[2] * center[2])
    all_inliers = inliers.sum() == len(views.points)
    return Assessment(
        transform, information, covariance, limits, values[0] >= 1.0, alternative,
        is_by_chance(views, pose) or may_be_other_side(views, pose),
        n_supporting, n_opposing, inliers, all_inliers, is_inlier, residuals,
    )  # fmt: skip


@leaf
def _information_scale(pose: Pose, measured: float, known_variance: float) -> float:
    """Return the factor of a pose's information for its uncertain noise.

    The covariance becomes that of Student's distribution, and is not reduced by noise below the prior.

    Args:
        measured: variance of the noise, pixels squared.
        known_variance: known variance of the noise, or 0.
    """
    freedom, prior = KNOWN_NOISE_FREEDOM, known_variance
    total_freedom = pose.freedom + freedom
    if not known_variance > 0.0:
        freedom, prior, total_freedom = DEFAULT_NOISE_FREEDOM, DEFAULT_NOISE_PX * DEFAULT_NOISE_PX, pose.freedom
    variance_ratio = measured * (pose.freedom + freedom) / (pose.freedom * measured + freedom * prior)
    return max(total_freedom - 2.0, 0.5) / total_freedom * min(variance_ratio, 1.0)


@kernel
def _find_alternative(
    views: Views, pose: Pose, measured: float, rotations: FloatArray, translations: FloatArray, n_alternatives: int
) -> int:
    """Return `Assessment.alternative`; arguments as there and of `_information_scale`."""
    max_square, workspace, change, rotvec = CUTOFF * CUTOFF * measured, make_workspace(), np.empty((3, 3)), np.empty(3)
    is_known = views.min_variance > 0.0
    freedom = KNOWN_NOISE_FREEDOM if is_known else DEFAULT_NOISE_FREEDOM
    prior = freedom * (views.min_variance if is_known else DEFAULT_NOISE_PX * DEFAULT_NOISE_PX)
    best = 0.0
    for a in range(-1, n_alternatives):
        model = pose.model if a < 0 else ModelPose(rotations[a], translations[a])
        loss = BIQUARTIC_BOUND * max_square * compute_score(views, model, max_square, np.inf, workspace) + prior
        if a < 0:
            best = loss
        elif 0.5 * (pose.freedom + freedom) * np.log(loss / best) < np.log(CLEAR_ODDS):
            for i in range(3):
                for j in range(3):
                    change[i, j] = dot(model.rotation[i], pose.model.rotation[j])
            so3_log(change, rotvec)
            if np.sqrt(dot(rotvec, rotvec)) > UNOBSERVABLE_ROTATION_SD:
                return a
    return -1
