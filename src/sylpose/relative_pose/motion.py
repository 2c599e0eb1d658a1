"""Public two-frame estimation: `estimate_motion` fits the object's motion to the matches of all cameras."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from math import sqrt

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from sylpose.geometry import validation
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import invert_information, make_motion_about, remove_direction
from sylpose.geometry.numba_linalg import index_distinct_rows, kernel, leaf
from sylpose.geometry.robust_loss import NoisePx, NoiseUnits, chi_squared_bound, make_noise_units
from sylpose.matches import STATIC_PX, Matches
from sylpose.methods import MOTION_METHODS
from sylpose.relative_pose.faulty_cameras import solve_without_faulty_cameras
from sylpose.relative_pose.observability import classify_observability
from sylpose.relative_pose.second_motion import select_larger_body
from sylpose.relative_pose.solver import fit_terms, locate_and_fit
from sylpose.relative_pose.sylvester_methods import ESTIMATORS, apply_estimator
from sylpose.relative_pose.terms import MIN_MATCHES, Solution, TermData, change_center, locate_object, make_failed_fit
from sylpose.results import Motion
from sylpose.rig import Rig, check_single_pose
from sylpose.status import Status

# The square of what exceeds chance, in variances (chi-squared, once in a thousand times).
MAX_CHANCE_SQUARE = chi_squared_bound(1)


def estimate_motion(
    rig: Rig,
    matches: Sequence[Matches],
    *,
    method: str = "epipolar",
    initial: RigidTransform | None = None,
    center: ArrayLike | None = None,
    radius: float | None = None,
    noise_px: NoisePx | None = None,
    seed: int = 0,
) -> Motion:
    """Estimate the object's motion between two frames from matches within each camera.

    Args:
        rig: C cameras.
        matches: C sets of matches, in the rig's order; `Matches.empty()` for a camera without matches. Copies count
            once (`find_first_copies`).
        method: "epipolar" (perspective, six degrees of freedom, robust:
            docs/method/3-pose.md, "Two frames") or one of the
            paper's estimators, applied to the pair moments of its inliers: "sylvester" or "depth-plane" (with a planar
            depth model).
        initial: initial guess of the motion (while tracking, the previous motion), tried in addition to the built-in
            starts.
        center: (3,) the object's center in frame i, world; None: the point nearest to the cameras' mean rays, at the
            distance that the matches show.
        radius: approximate radius of the object, length units (twice the median distance of its points from the
            center); None: from the spread of the matches.
        noise_px: (C,) standard deviation of a keypoint coordinate in each camera, pixels; in the rig's order, or a
            mapping from camera names. It weights the cameras, scales the thresholds in pixels and is a lower bound of
            the noise; a larger noise is still estimated from the matches. An infinite value excludes the camera. For
            the paper's estimators it only affects the selection of inliers. None: the noise is estimated from the
            matches alone.
        seed: of the outlier rejection. The same input and seed give the same result.

    Returns:
        `Motion`; check its `status` first. One camera alone gives SCALE_NOT_OBSERVABLE: its translation is then in
        units of the distance to the object, unless `center` is given.

    Raises:
        ValueError: the number of matches differs from the number of cameras; an unknown method; a center that is not
            finite or behind a camera that has matches; a radius that is not positive; noise of other cameras, or an
            invalid noise.

    Source: Chen & Schonfeld 2010 for the paper's estimators; docs/method/3-pose.md for the rest.
    """
    matches = validation.check_list(matches, Matches, "matches", len(validation.check_type(rig, Rig, "rig")))
    validation.check_choice(method, MOTION_METHODS, "method")
    seed = validation.check_integer(seed, "seed")
    if radius is not None:
        radius = validation.check_number(radius, "radius", above=0.0)
    if initial is not None:
        check_single_pose(initial, "initial")
    if center is not None:
        center = validation.check_finite(center, (3,), "center")
    units = NoiseUnits(np.ones(len(rig)), 0.0) if noise_px is None else make_noise_units(noise_px, rig.names)
    first = [find_first_copies(m.x, m.y, STATIC_PX / camera.focal) for camera, m in zip(rig, matches, strict=True)]
    rows = [np.flatnonzero(own == np.arange(len(own))) for own in first]
    if sum(map(len, rows)) == sum(map(len, matches)):
        return _estimate(rig, matches, method, initial, center, radius, units, seed)
    distinct = [Matches(m.x[own], m.y[own]) for m, own in zip(matches, rows, strict=True)]
    result = _estimate(rig, distinct, method, initial, center, radius, units, seed)
    masks = zip(result.inliers, rows, first, strict=True)
    return replace(result, inliers=tuple(mask[np.searchsorted(own, index)] for mask, own, index in masks))


@kernel
def find_first_copies(x: FloatArray, y: FloatArray, tolerance: float) -> IntArray:
    """Return for each match (n,) the index of the first one that it is a copy of, or its own.

    Copies are no independent measurements: one keypoint with several orientations or at several scales, a file that was
    read twice. They would make an estimator overconfident, and one mismatch a majority. Equal matches are copies; others
    that are nearer than the tolerance in both images are, if there are more of them than by chance: of independent matches,
    the number of pairs grows with the square of the distance, along contours with the distance itself. Pairs between one and
    four times the tolerance show which.
    """
    n, rows, inverse = index_distinct_rows(x, y)
    rows = rows[:n]
    x, y = x[rows], y[rows]
    wider = 1 if n > 0 and np.ptp(x[:, 1]) > np.ptp(x[:, 0]) else 0
    along, n_near, n_around, n_beyond = x[:, wider].copy(), 0, 0, 0
    order, place, first = np.argsort(along), np.empty(n, np.int64), np.arange(n)
    for k in range(n):
        place[order[k]] = k
        for m in range(k + 1, n):
            i, j = order[k], order[m]
            if along[j] - along[i] > 4.0 * tolerance:
                break
            distance = _measure_distance(x, y, i, j)
            n_near += distance <= tolerance
            n_around += distance <= 2.0 * tolerance
            n_beyond += distance <= 4.0 * tolerance
    inner, outer = n_around - n_near + 1, n_beyond - n_around + 1
    share = min(inner / outer * (1.0 + sqrt(MAX_CHANCE_SQUARE * (1.0 / inner + 1.0 / outer))), 0.5)
    excess = n_near - share * n_around
    if excess > 0.0 and excess * excess > MAX_CHANCE_SQUARE * share * (1.0 - share) * n_around:
        for i in range(n):
            for step in (-1, 1):
                m = place[i] + step
                while 0 <= m < n and abs(along[order[m]] - along[i]) <= tolerance:
                    j = order[m]
                    if j < first[i] and first[j] == j and _measure_distance(x, y, i, j) <= tolerance:
                        first[i] = j
                    m += step
    return rows[first[inverse]]


@leaf
def _measure_distance(x: FloatArray, y: FloatArray, i: int, j: int) -> float:
    """Return the distance of two matches, the larger one of the two images, in either direction."""
    return float(max(abs(x[i, 0] - x[j, 0]), abs(x[i, 1] - x[j, 1]), abs(y[i, 0] - y[j, 0]), abs(y[i, 1] - y[j, 1])))


def _estimate(
    rig: Rig,
    matches: Sequence[Matches],
    method: str,
    initial: RigidTransform | None,
    center: FloatArray | None,
    radius: float | None,
    units: NoiseUnits,
    seed: int,
) -> Motion:
    """Run `estimate_motion` with checked arguments, on matches without duplicates."""
    data = [
        TermData(c, m.x, m.y, camera.rotation, camera.center, camera.focal * per_px)
        for c, (camera, m, per_px) in enumerate(zip(rig, matches, units.per_px.tolist(), strict=True))
        if len(m) and per_px > 0.0
    ]
    if sum(len(term) for term in data) < MIN_MATCHES:
        failed = Solution(make_failed_fit(data, Status.TOO_FEW_MATCHES), np.full(3, np.nan), 1.0)
        return replace(_build_motion(rig, matches, data, failed, units.per_px), method=method, unit="")
    if center is not None:
        _check_center(center, rig, data)
    rng = np.random.default_rng(seed)

    def solve(terms: Sequence[TermData], start: Solution | None = None) -> Solution:
        guesses = [] if initial is None else [(initial.rotation.as_matrix(), initial.translation)]
        if start is not None:
            guesses.append(change_center((start.fit.rotation, start.fit.translation), start.center, np.zeros(3)))
        if center is None:
            return locate_and_fit(terms, guesses, rng, radius, units.sigma)
        size = locate_object(terms, center)[1] if radius is None else radius
        guesses = [change_center(guess, np.zeros(3), center) for guess in guesses]
        return Solution(fit_terms(terms, center, size, guesses, rng, units.sigma), center, size)

    solution = solve(data)
    solution, second_body_ratio = select_larger_body(data, solution, rig, solve, units.sigma) or (solution, 0.0)
    if second_body_ratio == 0.0 and solution.fit.status is not Status.TOO_FEW_MATCHES:
        is_mixed = solution.fit.is_mixed
        solution = solve_without_faulty_cameras(data, solution, rig, solve)
        if is_mixed and solution.fit.may_be_two:
            # Two bodies make cameras disagree as well: without one of them they are still there.
            solution = solution._replace(fit=replace(solution.fit, is_mixed=True))
    if method in ESTIMATORS and solution.fit.status is Status.OK:
        solution = solution._replace(fit=apply_estimator(method, data, solution.fit, solution.center, rig.names))
    # One camera alone does not determine the object's distance; only a given center does.
    unit = rig.unit if center is not None or len(data) > 1 else ""
    motion = _build_motion(rig, matches, data, solution, units.per_px)
    return replace(motion, method=method, second_body_ratio=second_body_ratio, unit=unit)


def estimate_motions(
    rig: Rig,
    pairs: Iterable[Sequence[Matches]],
    *,
    method: str = "epipolar",
    noise_px: NoisePx | None = None,
    seed: int = 0,
    threads: int = 1,
) -> list[Motion]:
    """Estimate the motions of many frame pairs of one rig.

    Args:
        rig: C cameras.
        pairs: for each frame pair its C sets of matches, as for `estimate_motion`.
        method, noise_px, seed: as in `estimate_motion`; the same for every pair.
        threads: number of pairs processed in parallel; the compiled part, two thirds of the work, runs concurrently.

    Returns:
        the result of `estimate_motion` for each pair, in order, identical to the last bit.

    Raises:
        ValueError: as `estimate_motion`; fewer than one thread.
    """
    validation.check_integer(threads, "threads", minimum=1)
    match_sets = [
        validation.check_list(pair, Matches, f"pairs[{k}]", len(validation.check_type(rig, Rig, "rig")))
        for k, pair in enumerate(validation.check_sequence(pairs, "pairs"))
    ]

    def estimate_pair(matches: Sequence[Matches]) -> Motion:
        return estimate_motion(rig, matches, method=method, noise_px=noise_px, seed=seed)

    if threads == 1:
        return [estimate_pair(matches) for matches in match_sets]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(estimate_pair, match_sets))


def _build_motion(
    rig: Rig, matches: Sequence[Matches], data: Sequence[TermData], solution: Solution, per_px: FloatArray
) -> Motion:
    """Convert a fit into the public result and flag unobservable directions."""
    fit, center, radius = solution
    inliers = [np.zeros(len(m), bool) for m in matches]
    residuals = np.full(len(rig), np.nan)
    for term, w, r in zip(data, fit.weights, fit.residuals, strict=True):
        residuals[term.camera] = _compute_rms(w, r, inliers[term.camera]) / float(per_px[term.camera])
    fit, unobservable = classify_observability(fit, radius)
    has_motion = fit.status.has_pose or len(unobservable) > 0
    if fit.status.has_pose and fit.status is not Status.NO_MOTION and (fit.is_mixed or fit.alternative is not None):
        fit, unobservable = replace(fit, status=Status.MIXED if fit.is_mixed else Status.AMBIGUOUS), np.empty((0, 6))
    information = fit.information_without_depth if len(unobservable) else fit.information
    if fit.status is Status.SCALE_NOT_OBSERVABLE:
        for row in unobservable:
            # The linearized information contains a prior on a length that is not observable: remove it.
            information = remove_direction(information, row)
    alternative = fit.alternative if fit.status is Status.AMBIGUOUS else None
    return Motion(
        status=fit.status,
        motion=make_motion_about(center, fit.rotation, fit.translation) if has_motion else None,
        center=center,
        information=information,
        covariance=invert_information(information),
        unobservable=unobservable,
        inliers=tuple(inliers),
        residuals=residuals,
        method="epipolar",
        iterations=fit.iterations,
        faults=fit.faults,
        alternative=None if alternative is None else make_motion_about(center, *alternative),
        static_ratio=fit.static_ratio,
        camera_names=rig.names,
    )


@kernel
def _compute_rms(weights: FloatArray, residuals: FloatArray, inliers: BoolArray) -> float:
    """Return the RMS residual of the inliers, NaN without any; `inliers` (n,) receives the inlier mask."""
    count, squares = 0, 0.0
    for i in range(len(weights)):
        inliers[i] = weights[i] > 0.0
        if inliers[i]:
            count += 1
            squares += residuals[i] * residuals[i]
    return float(np.sqrt(squares / count)) if count > 0 else np.nan


def _check_center(g: FloatArray, rig: Rig, data: Sequence[TermData]) -> None:
    """Raise ValueError if the given center (3,) is behind a camera with matches."""
    for term in data:
        if term.rotation[2] @ (g - term.center) <= 0:
            raise ValueError(f"center: {g.tolist()} is behind camera {rig.names[term.camera]}, which has matches")
