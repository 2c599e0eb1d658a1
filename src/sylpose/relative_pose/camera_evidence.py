"""Evidence of one camera for or against the joint motion: its own best motion explains its matches as well, or better.

A camera that sees one rigid motion explains its matches alone, by an essential matrix: five unknowns. All C cameras
together have one motion with six unknowns. If the joint motion fits a camera's matches much worse than the camera's own
motion does, rig and images contradict each other: a wrong calibration, images that are mirrored, exchanged, frozen or
late, another body. No noise level is assumed: the camera's own fit measures it, and no camera is the reference.

    own fit of camera c:   RSS_c over its n_c inliers,  s_c² = RSS_c / (n_c - 5)
    joint fit:             J_c = min over δ of  RSS_c(R, t, δ) / s_c² + |δ / s_δ|²
    excess                 D_c = J_c - RSS_c / s_c²,  at most about five without a contradiction
    F ratio                F = Σ_c D_c / (5 C - 6)

(R, t) is the motion in question, as the tracker found it: its own error is part of the excess. Residuals are Sampson
distances in pixels of the same matches in both fits. δ are errors that users must expect: a rotation of the camera, its
focal length, its rotation between the two images, and in recordings its clock. Matches whose errors are alike in a part of
the image (edges along which features slide, a mask, compression) are fewer measurements than matches: J_c and RSS_c are
divided by the design effect of the camera's own residuals.

The own fit is one of least trimmed squares that begins with the matches that the joint motion explains best. Another body
may have more matches; that is no contradiction while the object's matches agree. Once converged, it begins again with more
of them: a fit to the best ones may be trimmed to their errors.

Source: G. C. Chow, Econometrica 28, 1960 (the test); R. T. Birge, Phys. Rev. 40, 1932 (the ratio of external to internal
consistency); P. J. Rousseeuw and K. Van Driessen, Data Mining and Knowledge Discovery 12, 2006 (concentration steps);
L. Kish, Survey Sampling, 1965 (the design effect). Their use on epipolar geometry is ours
(docs/method/5-uncertainty.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import apply_rotvec, cholesky_solve, compute_median, dot, kernel, leaf, so3_log
from sylpose.geometry.robust_loss import SIGMA_OF_MEDIAN
from sylpose.relative_pose.limits import MAX_ROUNDS, MAX_STEPS, MIN_SHARE, ROUGHLY_CONVERGED_DECREASE
from sylpose.relative_pose.terms import TermData, concatenate_terms, find_usable

# Calibration errors that are no contradiction, standard deviations: rotation, radians, and relative focal length (choice:
# 0.3 degrees and 1 %, as a good calibration may be off).
ROTATION_ERROR_SD, FOCAL_ERROR_SD = 0.0052, 0.01
# Rotation of a camera between the two images, standard deviation, radians, if it trembles (choice: 0.1 degrees).
TREMBLE_SD = 0.0017
# Standard deviation of the time between two images of a camera relative to that of the others, in intervals between frames:
# shutters open for a part of an interval, webcams deliver unevenly (choice).
CLOCK_SD_FRAMES = 0.1
# Unknowns of these errors: a rotation, the focal length, another rotation, the share of the motion (derived).
N_NUISANCES = 8
# Unknowns of a camera's own motion, and of the joint one (derived).
N_OWN, N_JOINT = 5, 6
# A camera needs twice as many matches as unknowns to have a fit of its own (derived).
MIN_MATCHES = 2 * N_OWN
# Smallest noise of a camera, pixels: frozen images have none (choice).
MIN_SIGMA_PX = 0.05
# A camera's own motion begins with `MIN_SHARE` of its matches, those that the joint motion explains best: where other things
# move, too, the object may have as few. Its inliers are within so many standard deviations (choice).
MAX_SIGMAS = 3.0
# Standard deviation of normal residuals of which this share is smaller than 1 (derived).
SIGMA_OF_SHARE = 1.0 / float(ndtri(0.5 + 0.5 * MIN_SHARE))
# A motion that moves the camera relative to the object by less than this share of its distance has no epipolar geometry:
# every match would fit (derived: far below the smallest measurable motion).
MIN_BASELINE = 1e-4
# Cameras contradict each other beyond this F ratio (choice: right motions have at most 4 without outliers, and 1 in 100 of
# those with 30 to 60 % outliers more than 70; half of the mirrored, turned and exchanged pairs of frames have more than 30).
MAX_F_RATIO = 30.0
# So do they if the median of several F ratios, of two in the middle the smaller one, exceeds this; while tracking, of the
# last known ones, once the least number is known (choice: sensitivity in docs/history/benchmarks.md#trust).
MAX_POOLED_F_RATIO, MIN_POOLED = 5.0, 3
# For this at least so many cameras have to remain without the worst: any two nearly agree (derived: 4 constraints of 10
# unknowns).
MIN_KEPT_POOLED = 3
# Of a camera's matches, this share that the joint motion explains best is compared (choice).
KEPT_SHARE = 0.9
# An explanation of a contradiction reduces the F ratio at least by this factor (choice).
MIN_REDUCTION = 3.0
# The ratio without a contradiction: explanations with ratios below it are alike (derived).
EXPECTED_RATIO = 1.0
# No excess is larger: a million times what the largest contradictions have (derived: keeps sums finite).
MAX_EXCESS = 1e12
# Axes of rotations (derived).
AXES = np.eye(3)
# Cells per image axis in which errors may be alike (choice).
N_CELLS = 4


@dataclass(frozen=True)
class CameraEvidence:
    """How well one camera's own motion and the joint motion explain its matches.

    Attributes:
        n: number of matches, the inliers of its own motion; 0 without evidence.
        own_px: noise about its own motion, pixels.
        joint_px: rms residual of the same matches about the joint motion, pixels.
        excess: D_c, see the module; NaN without evidence.
    """

    n: int = 0
    own_px: float = float("nan")
    joint_px: float = float("nan")
    excess: float = float("nan")


@kernel
def compute_f_ratio(excess: FloatArray, min_kept: int = 2, n_own: int = N_OWN) -> float:
    """Return the F ratio of the cameras' excess (C,) over fits of so many unknowns; NaN if fewer than two have evidence.

    An excess of NaN is a camera without evidence. One camera may be at fault, or see another body for a while, and a robust
    joint motion does not follow it: the ratio is that without the worst, if as many as `min_kept` remain. With C all count.
    """
    ordered = np.sort(excess[np.isfinite(excess)])
    n = len(ordered) - 1 if len(ordered) > min_kept else len(ordered)
    constraints = n_own * n - N_JOINT
    return float(ordered[:n].sum() / constraints) if constraints > 0 else np.nan


def explains_as_well(f_ratio: float, best: float) -> bool:
    """Return whether an explanation of a contradiction with this F ratio is about as good as the best one."""
    return f_ratio <= max(MIN_REDUCTION * best, EXPECTED_RATIO)


@kernel
def pool_f_ratios(ratios: FloatArray) -> float:
    """Return the median of F ratios, of two in the middle the smaller one; NaN if none is known.

    A single pair of frames may have outliers, or show another body; a camera that moves contradicts some of them.
    """
    known = np.sort(ratios[~np.isnan(ratios)])
    return known[(len(known) - 1) // 2] if len(known) else np.nan


@kernel
def compare_motions(
    x: FloatArray,
    y: FloatArray,
    focal: float,
    rotation: FloatArray,
    translation: FloatArray,
    share_sd: float,
) -> tuple[int, float, float, float]:
    """Compare a camera's own motion with the joint one.

    Args:
        x, y: (n, 2) its matches, normalized; inliers of the joint motion or not.
        focal: focal length, pixels.
        rotation, translation: (3, 3) R and (3,) t of the joint motion in its axes, y ~ R x + t / depth, in units of
            the object's distance.
        share_sd: standard deviation of the share of the motion that the camera sees, from its clock.

    Returns:
        the fields of `CameraEvidence`.
    """
    if len(x) < MIN_MATCHES or not np.sqrt(dot(translation, translation)) > MIN_BASELINE:
        return 0, np.nan, np.nan, np.nan
    n = len(x)
    own, residuals = np.empty(n), np.empty(n)
    own_rotation, own_translation = rotation.copy(), translation.copy()
    # Least trimmed squares, from the matches that the joint motion explains best: other bodies may have more.
    _compute_residuals(x, y, focal, rotation, translation, residuals)
    sizes = np.abs(residuals)
    # A fit to hardly more matches than it has unknowns would be trimmed to its own errors.
    last = max(int(MIN_SHARE * n), min(n, 2 * MIN_MATCHES) - 1)
    limit = np.partition(sizes, last)[last]
    for i in range(n):
        own[i] = 1.0 if sizes[i] <= limit else 0.0
    return _measure_excess(x, y, focal, own, own_rotation, own_translation, rotation, translation, share_sd)


def measure_excess(
    data: Sequence[TermData], center: FloatArray, rotation: FloatArray, translation: FloatArray
) -> FloatArray:
    """Compare the own motion of each term with the joint one.

    Args:
        data: T terms.
        center: (3,) g, the point that the joint motion is about.
        rotation, translation: (3, 3) R and (3,) d of the joint motion.

    Returns:
        (T,) the excess; NaN without evidence.
    """
    return compare_terms(data, center, rotation, translation)[:, 3]


def compare_terms(
    data: Sequence[TermData], center: FloatArray, rotation: FloatArray, translation: FloatArray
) -> FloatArray:
    """Return (T, 4) what `compare_motions` returns for each of T terms; see `measure_excess`."""
    compared = np.empty((len(data), 4))
    if data:
        _compare_terms(compared, center, rotation, translation, *concatenate_terms(data))
    return compared


@kernel
def _compare_terms(
    compared: FloatArray,
    center: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    x: FloatArray,
    y: FloatArray,
    offsets: IntArray,
    rotations_x: FloatArray,
    rotations: FloatArray,
    centers_x: FloatArray,
    centers: FloatArray,
    focal: FloatArray,
) -> None:
    """Compare the motions of concatenated terms (`compare_terms`)."""
    for t in range(len(focal)):
        before, after = x[offsets[t] : offsets[t + 1]], y[offsets[t] : offsets[t + 1]]
        usable = find_usable(before, after, focal[t])
        moved = _transfer_motion(rotations_x[t], rotations[t], centers_x[t], centers[t], center, rotation, translation)
        own = compare_motions(before[usable], after[usable], focal[t], moved[0], moved[1], 0.0)
        compared[t, 0], compared[t, 1], compared[t, 2], compared[t, 3] = own


def measure_distances(term: TermData, center: FloatArray, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Measure the distances (n,) of a term's matches from the epipolar lines of the joint motion, pixels.

    Args:
        center, rotation, translation: as for `measure_excess`.
    """
    residuals = np.empty(len(term))
    _compute_residuals(term.x, term.y, term.focal, *transfer_motion(term, center, rotation, translation), residuals)
    return np.abs(residuals)


def transfer_motion(
    term: TermData, center: FloatArray, rotation: FloatArray, translation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the joint motion in the axes of a camera, (3, 3) and (3,), in units of the object's distance."""
    views = term.rotation_x, term.rotation, term.center_x, term.center
    return _transfer_motion(*views, center, rotation, translation)


@kernel
def _transfer_motion(
    rotation_x: FloatArray,
    rotation_y: FloatArray,
    center_x: FloatArray,
    center_y: FloatArray,
    center: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the joint motion in the axes of a camera, whose pose in both frames is given (`transfer_motion`)."""
    after, rotated = center_y - center, np.dot(rotation_y, rotation)
    moved = np.dot(rotated, center_x - center) + np.dot(rotation_y, translation - after)
    return np.dot(rotated, rotation_x.T), moved / np.sqrt(dot(after, after))


@kernel
def _measure_excess(
    x: FloatArray,
    y: FloatArray,
    focal: float,
    own: FloatArray,
    own_rotation: FloatArray,
    own_translation: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    share_sd: float,
) -> tuple[int, float, float, float]:
    """Fit a camera's own motion, beginning with the weighted matches; return what `compare_motions` does."""
    residuals, before, damping = np.empty(len(x)), np.empty(len(x)), 1e-3
    is_widened, narrow = False, own
    narrow_rotation, narrow_translation = own_rotation, own_translation
    for _ in range(MAX_ROUNDS):
        damping, has_converged = _fit_motion(x, y, own, own_rotation, own_translation, damping)
        before[:] = own
        if not _trim(x, y, focal, own, own_rotation, own_translation, residuals, False):
            if is_widened:
                break
            return 0, np.nan, np.nan, np.nan
        if has_converged and (own == before).all():
            if is_widened:
                break
            # It may be trimmed to the errors of a few matches.
            narrow, narrow_rotation, narrow_translation = own.copy(), own_rotation.copy(), own_translation.copy()
            is_widened = _trim(x, y, focal, own, own_rotation, own_translation, residuals, True)
    own[:] = before
    if dot(own, narrow) < KEPT_SHARE * narrow.sum():
        # Another body has more matches.
        own[:] = narrow
        _compute_residuals(x, y, focal, narrow_rotation, narrow_translation, residuals)
    count, squares = 0, 0.0
    for i in range(len(x)):
        if own[i] > 0.0:
            count += 1
            squares += residuals[i] ** 2
    sigma = max(np.sqrt(squares / (count - N_OWN)), MIN_SIGMA_PX)
    effective = sigma * sigma * compute_design_effect(y, own, residuals)
    # Outliers that the own motion happens to explain are the worst of the joint one.
    joint = np.empty(len(x))
    _compute_residuals(x, y, focal, rotation, translation, joint)
    sizes = np.sort(np.abs(joint[own > 0.0]))
    limit, own_squares = sizes[int(KEPT_SHARE * (count - 1))], 0.0
    for i in range(len(x)):
        own[i] = 1.0 if own[i] > 0.0 and abs(joint[i]) <= limit else 0.0
        own_squares += own[i] * residuals[i] ** 2
    joint_squares, joint_cost = _marginalize_calibration(x, y, focal, own, rotation, translation, effective, share_sd)
    excess = min(max(joint_cost - own_squares / effective, 0.0), MAX_EXCESS)
    return count, sigma, np.sqrt(joint_squares / own.sum()), excess


@leaf
def cross_rows(vector: FloatArray, matrix: FloatArray, out: FloatArray) -> None:
    """Write [vector]x matrix to out (3, 3)."""
    for j in range(3):
        out[0, j] = vector[1] * matrix[2, j] - vector[2] * matrix[1, j]
        out[1, j] = vector[2] * matrix[0, j] - vector[0] * matrix[2, j]
        out[2, j] = vector[0] * matrix[1, j] - vector[1] * matrix[0, j]


@kernel
def _compute_residuals(
    x: FloatArray, y: FloatArray, focal: float, rotation: FloatArray, translation: FloatArray, residuals: FloatArray
) -> None:
    """Write the Sampson distances (n,), pixels."""
    essential = np.empty((3, 3))
    cross_rows(translation, rotation, essential)
    for i in range(len(x)):
        residuals[i] = focal * _sampson(x, y, i, essential)


@leaf
def _match_lines(
    x: FloatArray, y: FloatArray, i: int, e: FloatArray
) -> tuple[float, float, float, float, float, float]:
    """Return y^T E x of match i, the directions (2) of its epipolar lines E x and E^T y, and their squared length."""
    x0, x1, y0, y1 = x[i, 0], x[i, 1], y[i, 0], y[i, 1]
    a0 = e[0, 0] * x0 + e[0, 1] * x1 + e[0, 2]
    a1 = e[1, 0] * x0 + e[1, 1] * x1 + e[1, 2]
    a2 = e[2, 0] * x0 + e[2, 1] * x1 + e[2, 2]
    b0 = e[0, 0] * y0 + e[1, 0] * y1 + e[2, 0]
    b1 = e[0, 1] * y0 + e[1, 1] * y1 + e[2, 1]
    return y0 * a0 + y1 * a1 + a2, a0, a1, b0, b1, a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1 + 1e-300


@leaf
def _sampson(x: FloatArray, y: FloatArray, i: int, e: FloatArray) -> float:
    """Return the Sampson distance of match i from the epipolar lines of E."""
    value, _, _, _, _, square = _match_lines(x, y, i, e)
    return float(value / np.sqrt(square))


@kernel
def linearize_distances(
    x: FloatArray, y: FloatArray, weights: FloatArray, e: FloatArray, derivatives: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the Sampson distances (n,) of the matches and their derivatives (n, k) along (k, 9) changes of E.

    Both are 0 for matches without weight.
    """
    distances, slopes = np.zeros(len(x)), np.zeros((len(x), 9))
    for i in range(len(x)):
        if not weights[i] > 0.0:
            continue
        x0, x1, y0, y1 = x[i, 0], x[i, 1], y[i, 0], y[i, 1]
        value, a0, a1, b0, b1, square = _match_lines(x, y, i, e)
        scale = 1.0 / np.sqrt(square)
        distances[i] = value * scale
        # E changes y^T E x, and the lengths of the lines.
        c, row = distances[i] / square, slopes[i]
        row[0], row[1] = y0 * x0 * scale - c * (a0 * x0 + b0 * y0), y0 * x1 * scale - c * (a0 * x1 + b1 * y0)
        row[3], row[4] = y1 * x0 * scale - c * (a1 * x0 + b0 * y1), y1 * x1 * scale - c * (a1 * x1 + b1 * y1)
        row[2], row[5], row[6], row[7] = (
            y0 * scale - c * a0,
            y1 * scale - c * a1,
            x0 * scale - c * b0,
            x1 * scale - c * b1,
        )
        row[8] = scale
    return distances, slopes @ derivatives.T


@kernel
def _fit_motion(
    x: FloatArray,
    y: FloatArray,
    weights: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    damping: float,
) -> tuple[float, bool]:
    """Reduce the squared Sampson distances of the weighted matches by some steps, in place; t has unit length.

    Returns:
        the damping to continue with; whether it has converged.
    """
    translation /= np.sqrt(dot(translation, translation)) + 1e-300
    essential, derivatives = np.empty((3, 3)), np.empty((6, 3, 3))
    factor, step, turned, moved = np.empty((6, 6)), np.empty(6), np.empty((3, 3)), np.empty(3)
    for _ in range(MAX_STEPS):
        cross_rows(translation, rotation, essential)
        for k in range(3):
            cross_rows(AXES[k], rotation, derivatives[3 + k])
            cross_rows(translation, derivatives[3 + k], derivatives[k])
        distances, slopes = linearize_distances(x, y, weights, essential, derivatives.reshape(6, 9))
        normal, gradient, cost = slopes.T @ slopes, slopes.T @ distances, dot(distances, distances)
        has_improved, least, new_cost = False, 1e-12 * np.trace(normal) + 1e-300, cost
        for _ in range(6):
            factor[:], step[:] = normal, -gradient
            for a in range(6):
                factor[a, a] += damping * normal[a, a] + least
            if cholesky_solve(factor, step):
                apply_rotvec(step[:3], rotation, turned)
                moved[:] = translation + step[3:]
                moved /= np.sqrt(dot(moved, moved)) + 1e-300
                new_cost = _sum_squares(x, y, weights, turned, moved)
                if new_cost < cost:
                    has_improved = True
                    break
            damping *= 8.0
        if not has_improved:
            return damping, True
        rotation[:], translation[:] = turned, moved
        damping = max(damping / 8.0, 1e-9)
        # The decrease of the log-likelihood with the noise that the residuals show.
        if (cost - new_cost) * weights.sum() < 2.0 * ROUGHLY_CONVERGED_DECREASE * cost:
            return damping, True
    return damping, False


@kernel
def _sum_squares(
    x: FloatArray, y: FloatArray, weights: FloatArray, rotation: FloatArray, translation: FloatArray
) -> float:
    essential, total = np.empty((3, 3)), 0.0
    cross_rows(translation, rotation, essential)
    for i in range(len(x)):
        if weights[i] > 0.0:
            total += _sampson(x, y, i, essential) ** 2
    return total


@kernel
def _trim(
    x: FloatArray,
    y: FloatArray,
    focal: float,
    weights: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    residuals: FloatArray,
    is_widened: bool,
) -> bool:
    """Set weights (n,) of matches within some standard deviations; False if too few are used.

    The standard deviation is from the median of those used; or widened, from the best of all, and too large if an object
    has few of them.
    """
    _compute_residuals(x, y, focal, rotation, translation, residuals)
    used, count = np.empty(len(x)), 0
    for i in range(len(x)):
        if is_widened or weights[i] > 0.0:
            used[count] = abs(residuals[i])
            count += 1
    if count < MIN_MATCHES:
        return False
    if is_widened:
        sigma = SIGMA_OF_SHARE * np.partition(used, int(MIN_SHARE * count))[int(MIN_SHARE * count)]
    else:
        sigma = SIGMA_OF_MEDIAN * compute_median(used[:count])
    for i in range(len(x)):
        weights[i] = 1.0 if abs(residuals[i]) <= MAX_SIGMAS * max(sigma, MIN_SIGMA_PX) else 0.0
    return True


@kernel
def compute_design_effect(y: FloatArray, weights: FloatArray, residuals: FloatArray) -> float:
    """Return the variance of cells' sums relative to independent residuals, at least 1."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for i in range(len(y)):
        if weights[i] > 0.0:
            for a in range(2):
                low[a], high[a] = min(low[a], y[i, a]), max(high[a], y[i, a])
    sums, squares = np.zeros((N_CELLS, N_CELLS)), 1e-300
    for i in range(len(y)):
        if weights[i] > 0.0:
            cell = np.empty(2, np.int64)
            for a in range(2):
                cell[a] = min(int(N_CELLS * (y[i, a] - low[a]) / max(high[a] - low[a], 1e-300)), N_CELLS - 1)
            sums[cell[0], cell[1]] += residuals[i]
            squares += residuals[i] ** 2
    return max(float((sums * sums).sum() / squares), 1.0)


@kernel
def _marginalize_calibration(
    x: FloatArray,
    y: FloatArray,
    focal: float,
    weights: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    variance: float,
    share_sd: float,
) -> tuple[float, float]:
    """Return the sum of squares about the joint motion, and its least cost over calibration errors, to first order."""
    essential, derivatives = np.empty((3, 3)), np.zeros((N_NUISANCES, 3, 3))
    cross_rows(translation, rotation, essential)
    # Both images turn with the camera, E' = exp(δ) E exp(-δ), or the second alone; the focal length scales the first two
    # coordinates. Of another share of the motion R turns as well; the length of E does not matter.
    rotvec, turned = np.empty(3), np.empty((3, 3))
    so3_log(rotation, rotvec)
    cross_rows(rotvec, rotation, turned)
    cross_rows(translation, turned, derivatives[7])
    for k in range(3):
        cross_rows(AXES[k], essential, derivatives[4 + k])
        cross_rows(AXES[k], essential.T.copy(), turned)
        derivatives[k] = derivatives[4 + k] + turned.T
    for a in range(3):
        for b in range(3):
            derivatives[3, a, b] = ((a < 2) + (b < 2)) * essential[a, b]
    distances, slopes = linearize_distances(x, y, weights, essential, derivatives.reshape(N_NUISANCES, 9))
    squares, scale = focal * focal * dot(distances, distances), focal * focal / variance
    normal, gradient = scale * (slopes.T @ slopes), scale * (slopes.T @ distances)
    for a in range(N_NUISANCES):
        sd = ROTATION_ERROR_SD if a < 3 else FOCAL_ERROR_SD if a == 3 else TREMBLE_SD if a < 7 else share_sd
        normal[a, a] += 1.0 / (sd * sd + 1e-30)
    step = gradient.copy()
    if not cholesky_solve(normal, step):
        return squares, squares / variance
    return squares, squares / variance - dot(gradient, step)
