"""One robust motion for all terms: outliers found, starts tried, noise measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sylpose.epipolar import Solution, TermData, Terms, minimize, normal_equations, sampson_residuals
from sylpose.features import STILL_PX
from sylpose.moments import PairMoments
from sylpose.results import Status
from sylpose.rig import nearest_point_to_rays
from sylpose.robust import affine_epipolar_inliers, bisquare, robust_sigma

__all__ = ["MIN_MATCHES", "Fit", "built_in_starts", "fit_terms", "no_fit", "object_place"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Eight matches in all cameras together leave two more equations than unknowns; fewer say nothing about themselves.
MIN_MATCHES = 8
# Noise of a SIFT keypoint is rarely below this; a smaller sigma would only pretend.
SIGMA_FLOOR_PX = 0.15
# Distances beyond this count as outliers when hypotheses are compared.
SCORE_CUTOFF_PX = 4.0
# A motion that fewer of the moving matches agree with than this may be one of chance: in simulations with nothing but
# mismatches 5 to 9 % agree with the best motion found.
CHANCE_SHARE = 0.2
# A camera that agrees with the others in fewer of its matches than this is set aside: junk alone reaches about a tenth.
CAMERA_MIN_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class Fit:
    """A robust fit of one motion to terms: what `estimate_motion` and the tracker share.

    Attributes:
        status: see `Status`.
        rotation: (3, 3) R and shift: (3,) d, X_j = R (X_i - g) + g + d; meaningless without `status.has_pose`.
        weights: per term (n,), 0 for outliers.
        residuals: per term (n,) signed epipolar distances, pixels.
        information: (6, 6) of (w, d) from the matches alone.
        information_with_prior: (6, 6) with what is known about the object's depth.
        iterations: of the solver, all rounds.
    """

    status: Status
    rotation: FloatArray
    shift: FloatArray
    weights: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    information: FloatArray
    information_with_prior: FloatArray
    iterations: int

    def with_matches(self, weights: Sequence[FloatArray], residuals: Sequence[FloatArray]) -> Fit:
        """The same fit, spoken of as one of other terms."""
        return replace(self, weights=tuple(weights), residuals=tuple(residuals))


def object_place(data: Sequence[TermData]) -> tuple[FloatArray, float]:
    """Where the object is and how large, from the matched points of the reference frame.

    Returns:
        center (3,), the point nearest to the rays through each camera's median point (at distance 1 with one camera);
        radius, length units: twice the median distance of points from it.
    """
    centers, rays, spreads = [], [], []
    for term in data:
        median = np.median(term.x[:, :2], axis=0)
        ray = np.append(median, 1.0) @ term.rotation_x
        centers.append(term.center_x)
        rays.append(ray / np.linalg.norm(ray))
        spreads.append(float(np.median(np.linalg.norm(term.x[:, :2] - median, axis=1))))
    counts = [len(term.x) for term in data]
    center = nearest_point_to_rays(centers, rays)
    depths = [abs(float(term.rotation_x[2] @ (center - term.center_x))) for term in data]
    radius = 2.0 * float(np.average(np.array(spreads) * depths, weights=counts))
    return center, max(radius, 1e-6 * float(np.mean(depths)))


def fit_terms(
    data: Sequence[TermData],
    center: FloatArray,
    radius: float,
    guesses: Sequence[tuple[FloatArray, FloatArray]],
    rng: np.random.Generator,
) -> Fit:
    """One robust motion for all terms: per-term RANSAC, solves from several starts, re-weighting with the solution.

    Args:
        data: T terms with at least one match each.
        center: (3,) g, the object's centre at the motion's start.
        radius: of the object.
        guesses: (R, d) tried as starts and as hypotheses, besides the built-in starts.
        rng: seeded.
    """
    moving = [_moves(term) for term in data]
    n_moving, n = sum(int(m.sum()) for m in moving), sum(len(m) for m in moving)
    if n < MIN_MATCHES:
        return no_fit(data, Status.TOO_FEW_MATCHES)
    if n_moving < max(MIN_MATCHES, 0.1 * n):
        return _still(data, moving)
    hypotheses = list(guesses)
    seeds = [
        mask & affine_epipolar_inliers(term.x[:, :2], term.y[:, :2], 3.0 / term.focal, rng)
        for term, mask in zip(data, moving, strict=True)
    ]
    weights = [mask.astype(float) for mask in seeds]
    iterations = 0
    if sum(w.sum() for w in weights) >= MIN_MATCHES:
        starts = built_in_starts(data, weights, center) + list(guesses)
        solutions = _solve(data, weights, np.ones(len(data)), center, radius, starts)
        iterations += solutions[0].iterations
        hypotheses += [(s.rotation, s.shift) for s in solutions]
    if not hypotheses:
        return no_fit(data, Status.TOO_FEW_MATCHES)
    # What stands still tells nothing between hypotheses: a background would vote for the identity.
    voters = [term.subset(mask) for term, mask in zip(data, moving, strict=True)]
    scored = sorted(hypotheses, key=lambda h: _robust_cost(voters, center, radius, h))
    best: Fit | None = None
    best_cost = np.inf
    for hypothesis in scored[:2]:
        fit = _refine(data, center, radius, hypothesis, iterations)
        cost = _robust_cost(voters, center, radius, (fit.rotation, fit.shift)) if fit.status.has_pose else np.inf
        if best is None or cost < best_cost:
            best, best_cost = fit, cost
    assert best is not None  # there is at least one hypothesis
    agreed = sum(int(((w > 0) & m).sum()) for w, m in zip(best.weights, moving, strict=True))
    if n_moving < 0.5 * n and (not best.status.has_pose or agreed < CAMERA_MIN_SHARE * n_moving):
        # Most matches stand still, and the moving ones do not agree on a motion: they are mismatches.
        return _still(data, moving)
    if best.status.has_pose and agreed < CHANCE_SHARE * n_moving:
        return no_fit(data, Status.NOT_CONSISTENT)
    return best


def _refine(
    data: Sequence[TermData],
    center: FloatArray,
    radius: float,
    hypothesis: tuple[FloatArray, FloatArray],
    iterations: int,
) -> Fit:
    """Re-weighting from one hypothesis: wide at first, then at the noise level that the residuals show."""
    rotation, shift = hypothesis
    sigma = np.full(len(data), 1.5)
    converged = False
    weights: list[FloatArray] = []
    for round_ in range(12):
        residuals, ratios = _all_residuals(data, center, rotation, shift)
        weights = [bisquare(r, max(4.0 * s, 6.0 - 2 * round_)) for r, s in zip(residuals, sigma, strict=True)]
        distances = [_segment_distance(term, center, radius, rotation, shift) for term in data]
        weights = [w * (e < max(SCORE_CUTOFF_PX, 8.0 - 2 * round_)) for w, e in zip(weights, distances, strict=True)]
        weights = _without_bad_cameras(weights)
        if sum(int((w > 0).sum()) for w in weights) < MIN_MATCHES:
            return no_fit(data, Status.NOT_CONSISTENT)
        sigma = np.array(
            [robust_sigma(r[w > 0], SIGMA_FLOOR_PX) for r, w in zip(residuals, weights, strict=True)]
        ).clip(max=2.0)
        solve_weights = [w / np.maximum(q, 0.1) for w, q in zip(weights, ratios, strict=True)]
        solution = _solve(data, solve_weights, sigma, center, radius, [(rotation, shift)])[0]
        iterations += solution.iterations
        change = np.linalg.norm(solution.rotation - rotation) * radius + np.linalg.norm(solution.shift - shift)
        rotation, shift, converged = solution.rotation, solution.shift, solution.converged
        if round_ >= 4 and change < 1e-6 * radius:
            break
    keep = [i for i, w in enumerate(weights) if w.sum() > 0]
    terms = _terms(data, solve_weights, sigma, center, radius, keep)
    information, _, _ = normal_equations(terms, rotation, shift, prior=False)
    with_prior, _, _ = normal_equations(terms, rotation, shift, prior=True)
    status = Status.OK if converged else Status.NOT_CONVERGED
    return Fit(status, rotation, shift, tuple(weights), tuple(residuals), information, with_prior, iterations)


def _solve(
    data: Sequence[TermData],
    weights: Sequence[FloatArray],
    sigma: FloatArray,
    center: FloatArray,
    radius: float,
    starts: Sequence[tuple[FloatArray, FloatArray]],
) -> list[Solution]:
    keep = [i for i, w in enumerate(weights) if w.sum() > 0]
    terms = _terms(data, weights, sigma, center, radius, keep)
    return minimize(terms, np.array([r for r, _ in starts]), np.array([d for _, d in starts]))


def _terms(
    data: Sequence[TermData],
    weights: Sequence[FloatArray],
    sigma: FloatArray,
    center: FloatArray,
    radius: float,
    keep: Sequence[int],
) -> Terms:
    moments = [PairMoments.from_matches(data[i].x, data[i].y, weights[i]) for i in keep]
    return Terms.build([data[i] for i in keep], moments, sigma[list(keep)], center, radius)


def built_in_starts(
    data: Sequence[TermData], weights: Sequence[FloatArray], center: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Turns of the expected size about the axes and the diagonals, each with the shift that the mean points show.

    The identity is never a start: the cost is 0/0 there (docs/method.md, "the identity trap").
    """
    centers, rays, spreads = [], [], []
    for term, w in zip(data, weights, strict=True):
        if w.sum() < 1:
            continue
        mean_x, mean_y = w @ term.x / w.sum(), w @ term.y / w.sum()
        # Where the centre g would be seen if it moved as the mean match did.
        g_camera = term.rotation_x @ (center - term.center_x)
        ray = (g_camera / g_camera[2] + mean_y - mean_x) @ term.rotation
        centers.append(term.center)
        rays.append(ray / np.linalg.norm(ray))
        relative = (term.y - mean_y) - (term.x - mean_x)
        spread = np.sqrt(w @ ((term.x - mean_x) ** 2).sum(axis=1) / w.sum())
        spreads.append(np.sqrt(w @ (relative**2).sum(axis=1) / w.sum()) / max(float(spread), 1e-12))
    angle = float(np.clip(np.median(spreads), 0.01, 0.7))
    moved = nearest_point_to_rays(centers, rays, near=center)
    axes = np.concatenate([np.eye(3), [[1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]] / np.sqrt(3.0)])
    turns = Rotation.from_rotvec(angle * np.concatenate([axes, -axes])).as_matrix()
    return [(turn, moved - center) for turn in turns]


def _all_residuals(
    data: Sequence[TermData], center: FloatArray, rotation: FloatArray, shift: FloatArray
) -> tuple[list[FloatArray], list[FloatArray]]:
    pairs = [sampson_residuals(term, center, rotation, shift) for term in data]
    return [r for r, _ in pairs], [q for _, q in pairs]


def _robust_cost(
    data: Sequence[TermData], center: FloatArray, radius: float, hypothesis: tuple[FloatArray, FloatArray]
) -> float:
    """Truncated squares of all matches' distances: counts outliers, measures inliers."""
    distances = (_segment_distance(term, center, radius, *hypothesis) for term in data)
    return float(sum(np.minimum(e**2, SCORE_CUTOFF_PX**2).sum() for e in distances))


def _moves(term: TermData) -> BoolArray:
    """(n,) matches displaced by more than the noise."""
    return np.asarray(np.linalg.norm(term.y - term.x, axis=1) * term.focal > STILL_PX)


def _segment_distance(
    term: TermData, center: FloatArray, radius: float, rotation: FloatArray, shift: FloatArray
) -> FloatArray:
    """(n,) distance, pixels, of each match from where a point on the object can be in frame j.

    The epipolar residual says nothing along the line: a mismatch that happens to lie on it passes, and the identity
    "explains" everything. But the object is no deeper than its radius (1.5 of them allowed), which leaves a segment of
    the line; without motion it is a point.
    """
    z = (term.rotation_x @ (center - term.center_x))[2]
    turned = term.x @ term.rotation_x @ rotation.T
    offset = rotation @ (term.center_x - center) - (term.center - center) + shift
    ends = []
    for depth in (max(z - 1.5 * radius, 0.2 * z), z + 1.5 * radius):
        p = (depth * turned + offset) @ term.rotation.T
        ends.append(p[:, :2] / np.where(p[:, 2:] > 1e-6 * abs(z), p[:, 2:], np.inf))
    a, b = ends
    line = b - a
    square = np.maximum((line**2).sum(axis=1), 1e-300)
    along = np.clip(((term.y[:, :2] - a) * line).sum(axis=1) / square, 0.0, 1.0)
    return np.asarray(np.linalg.norm(term.y[:, :2] - a - along[:, None] * line, axis=1) * term.focal)


def _without_bad_cameras(weights: Sequence[FloatArray]) -> list[FloatArray]:
    """Sets aside terms that agree in too few of their matches, when others agree in many."""
    share = np.array([(w > 0).mean() if len(w) >= 6 else 1.0 for w in weights])
    if share.max() < 2 * CAMERA_MIN_SHARE:
        return list(weights)
    return [w if s >= CAMERA_MIN_SHARE else np.zeros_like(w) for w, s in zip(weights, share, strict=True)]


def _still(data: Sequence[TermData], moving: Sequence[BoolArray]) -> Fit:
    """The object did not move: the identity is measured here, by matches that stand still, not assumed."""
    weights = tuple((~m).astype(float) for m in moving)
    information = np.zeros((6, 6))
    residuals = tuple(np.linalg.norm(term.y - term.x, axis=1) * term.focal for term in data)
    return Fit(Status.NO_MOTION, np.eye(3), np.zeros(3), weights, residuals, information, information, 0)


def no_fit(data: Sequence[TermData], status: Status) -> Fit:
    weights = tuple(np.zeros(len(term.x)) for term in data)
    nothing = np.zeros((6, 6))
    return Fit(status, np.eye(3), np.zeros(3), weights, weights, nothing, nothing, 0)
