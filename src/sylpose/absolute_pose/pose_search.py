"""Search for the pose of a known model: from samples of three matches to the best robust fits.

Includes tests of whether a pose may be due to chance, and of whether other cameras contradict it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import lgamma

import numpy as np

from sylpose.absolute_pose.pose_kernels import (
    CUTOFF,
    Noise,
    Views,
    compute_chance,
    compute_score,
    fit_pose,
    make_workspace,
    minimize,
    sample_inlier_ratio,
    search_samples,
)
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray

# Three matches have several exact poses; the fourth decides (derived).
MIN_MATCHES = 4
# Minimum and maximum number of samples, and the probability that none is free of outliers (choice).
MIN_SAMPLES, MAX_SAMPLES, MISS_PROBABILITY = 20, 3000, 1e-4
# Maximum number of matches used in the search, evenly from the cameras (choice).
MAX_SEARCH_MATCHES = 500
# Poses kept, refinement steps of each, and iterations of re-weighting (choice).
N_KEPT, SEARCH_STEPS, MAX_ITERATIONS = 6, 5, 50
# A start is discarded if its score exceeds the best by this factor and this number of matches (choice).
MAX_SCORE_RATIO, MAX_SCORE_EXCESS = 2.0, 3.0
# Poses that differ by a smaller angle, radians, are duplicates (choice).
SAME_ROTATION = 0.05
# A pose is due to chance if random matches give one as good with a higher expected number (choice).
MAX_FALSE_ALARMS = 0.01
# A camera supports a pose if this fraction of its matches are inliers (choice: a majority).
MIN_INLIER_RATIO = 0.5


@dataclass(frozen=True, eq=False)
class Pose:
    """Fitted pose: rotation and translation as in the kernels, and the fit's diagnostics."""

    rotation: FloatArray
    translation: FloatArray
    squares: FloatArray
    weights: FloatArray
    noise: Noise
    iterations: int
    freedom: float
    converged: bool


def search_poses(views: Views, max_square: float, thin_axis: FloatArray, rng: np.random.Generator) -> list[Pose]:
    """Search for distinct poses, refine them, and fit the best two to all matches; best first.

    Args:
        max_square: squared distance beyond which a match is an outlier.
        thin_axis: (3,) the direction in which the model extends least.
    """
    subset = _select_subset(views, rng)
    rotations, translations, scores = np.zeros((N_KEPT, 3, 3)), np.zeros((N_KEPT, 3)), np.full(N_KEPT + 1, np.inf)
    n_done, n_samples = 0, MIN_SAMPLES
    while n_done < n_samples:
        draws = rng.random((min(n_samples - n_done, 200), 6))
        search_samples(subset, draws, max_square, SEARCH_STEPS, rotations, translations, scores)
        n_done += len(draws)
        n_samples = MAX_SAMPLES
        if scores[0] < np.inf:
            n_samples = _required_samples(subset, rotations[0], translations[0], max_square)
    starts = [(rotations[k], translations[k]) for k in range(N_KEPT) if scores[k] < np.inf]
    if not starts:
        return []
    mirrored = _mirror_pose(*starts[0], thin_axis)
    minimize(subset, *mirrored, _max_noise(views, max_square), 10, 1e-3)
    poses: list[Pose] = []
    workspace, max_score = make_workspace(), MAX_SCORE_RATIO * scores[0] + MAX_SCORE_EXCESS
    for rotation, translation in [*starts, mirrored]:
        score = compute_score(subset, rotation, translation, max_square, np.inf, workspace)
        if score > max_score or _is_known(poses, rotation):
            continue
        pose = _fit_pose(subset, rotation, translation, max_square)
        if pose is not None and not _is_known(poses, pose.rotation):
            poses.append(pose)
    poses = _sort_by_false_alarms(subset, poses)
    if subset is not views:
        fitted = [_fit_pose(views, pose.rotation, pose.translation, max_square) for pose in poses[:2]]
        poses = _sort_by_false_alarms(views, [pose for pose in fitted if pose is not None])
    return poses


def count_inliers(views: Views, weights: FloatArray) -> IntArray:
    """Return (C,) number of each camera's matches with a positive weight (n,)."""
    return np.asarray(np.add.reduceat(weights > 0.0, views.start[:-1], dtype=np.int64))


def select_matches(views: Views, mask: BoolArray) -> tuple[Views, BoolArray]:
    """Select some of the matches (n,), at least one, and return the mask of the cameras (C,) that have any of them."""
    start = np.concatenate([[0], np.cumsum(mask)])[views.start]
    has_matches = np.diff(start) > 0
    points, images, to_pixels = views.points[mask], views.images[mask], views.to_pixels[mask]
    starts, cameras = (
        np.append(start[:-1][has_matches], start[-1]),
        (views.rotations[has_matches], views.translations[has_matches]),
    )
    return Views(points, images, to_pixels, starts, *cameras, views.min_variance), has_matches


def _sort_by_false_alarms(views: Views, poses: list[Pose]) -> list[Pose]:
    return sorted(poses, key=lambda pose: _log_false_alarms(views, pose)) if len(poses) > 1 else poses


def _select_subset(views: Views, rng: np.random.Generator) -> Views:
    """Select about `MAX_SEARCH_MATCHES` matches at most, evenly from the cameras."""
    counts = np.diff(views.start)
    if counts.sum() <= MAX_SEARCH_MATCHES:
        return views
    # Cameras with few matches leave their quota to the others.
    quota = MAX_SEARCH_MATCHES // len(counts)
    for _ in range(3):
        has_more = counts > quota
        if not has_more.any():
            break
        quota = max(1, int((MAX_SEARCH_MATCHES - counts[~has_more].sum()) // has_more.sum()))
    picked = [
        first + (np.arange(n) if n <= quota else rng.choice(n, quota, replace=False))
        for first, n in zip(views.start[:-1], counts, strict=True)
    ]
    start = np.concatenate([[0], np.cumsum([len(p) for p in picked])])
    indices = np.concatenate(picked)
    points, images, to_pixels = views.points[indices], views.images[indices], views.to_pixels[indices]
    return views._replace(points=points, images=images, to_pixels=to_pixels, start=start)


def _required_samples(views: Views, rotation: FloatArray, translation: FloatArray, max_square: float) -> int:
    """Return the number of samples for which one is free of outliers except with probability `MISS_PROBABILITY`."""
    inlier_ratio = sample_inlier_ratio(views, rotation, translation, max_square)
    if inlier_ratio >= 1.0:
        return MIN_SAMPLES
    return int(np.clip(np.log(MISS_PROBABILITY) / np.log1p(-max(inlier_ratio, 1e-9)), MIN_SAMPLES, MAX_SAMPLES))


def _mirror_pose(rotation: FloatArray, translation: FloatArray, thin_axis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mirror pose of a flat object, which looks most alike from the cameras' center, the world's origin.

    Rotations by 180 degrees about the object's normal, then about the viewing direction, preserve its scaled
    orthographic image.
    """
    viewing_ray = translation / max(float(np.linalg.norm(translation)), 1e-300)
    half_turns = [2.0 * np.outer(axis, axis) - np.eye(3) for axis in (viewing_ray, thin_axis)]
    return half_turns[0] @ rotation @ half_turns[1], translation.copy()


def _is_known(poses: Sequence[Pose], rotation: FloatArray) -> bool:
    return any(np.linalg.norm(rotation - pose.rotation) < np.sqrt(2.0) * SAME_ROTATION for pose in poses)


def _max_noise(views: Views, max_square: float) -> Noise:
    """Return the noise of the largest cutoff, for all cameras."""
    return Noise(np.full(len(views.rotations), max_square / CUTOFF**2), np.full(len(views.rotations), max_square))


def _fit_pose(views: Views, rotation: FloatArray, translation: FloatArray, max_square: float) -> Pose | None:
    """Fit a pose robustly from a start; None if fewer than `MIN_MATCHES` inliers remain."""
    rotation, translation = rotation.copy(), translation.copy()
    squares, weights, noise = np.empty(len(views.points)), np.zeros(len(views.points)), _max_noise(views, max_square)
    convergence = fit_pose(views, rotation, translation, max_square, MAX_ITERATIONS, 1, squares, weights, noise)
    has_enough_inliers = np.count_nonzero(weights) >= MIN_MATCHES
    return Pose(rotation, translation, squares, weights, noise, *convergence) if has_enough_inliers else None


def _log_false_alarms(views: Views, pose: Pose) -> float:
    """Return the logarithm of the number of false alarms (NFA).

    This is the expected number of poses as good as this one from random matches. A random match is an inlier with a
    probability equal to the fraction of the object's image that a circle of `CUTOFF` sigma covers; the inliers, and the
    three of them that determine the pose, may be chosen. This balances the number of inliers against their accuracy: of
    poses of the same data the one with the smallest value is the best.

    Source: Moisan & Stival, a contrario RANSAC, 2004.
    """
    n, (k, log_share) = len(pose.weights), compute_chance(views, pose.translation, pose.weights, pose.noise)
    choices = lgamma(n + 1) - lgamma(n - k + 1) - lgamma(4) - lgamma(k - 2)
    return float(np.log(n) + choices + (k - 3) / k * log_share)


def is_by_chance(views: Views, pose: Pose) -> bool:
    """Return whether random matches could give a pose as good.

    If all matches are inliers, there was no choice among them, and only the matches beyond the minimal three count as
    evidence.
    """
    if not pose.weights.all():
        return bool(_log_false_alarms(views, pose) > np.log(MAX_FALSE_ALARMS))
    k, log_share = compute_chance(views, pose.translation, pose.weights, pose.noise)
    return bool((k - 3) / k * log_share > np.log(MAX_FALSE_ALARMS))


def find_single_camera_poses(
    views: Views, max_square: float, thin_axis: FloatArray, seed: int
) -> Iterator[tuple[int, Pose]]:
    """Yield the cameras that support a pose alone, with that pose.

    A majority of their matches, and more than `MIN_MATCHES`, are inliers, not by chance.
    """
    counts = np.diff(views.start)
    for c in np.flatnonzero(counts >= MIN_MATCHES):
        camera_views, _ = select_matches(views, np.repeat(np.arange(len(counts)) == c, counts))
        poses = search_poses(camera_views, max_square, thin_axis, np.random.default_rng(seed))
        min_inliers = max(MIN_MATCHES, MIN_INLIER_RATIO * counts[c])
        if poses and np.count_nonzero(poses[0].weights) > min_inliers and not is_by_chance(camera_views, poses[0]):
            yield int(c), poses[0]


def is_contradicted(views: Views, pose: Pose, max_square: float, thin_axis: FloatArray, seed: int) -> bool:
    """Return whether at least as many cameras support another pose, so that neither can be preferred.

    With two cameras, one may be miscalibrated; with several that support different poses, the model may be too large.
    Cameras with wrong matches support none.
    """
    inliers, counts = count_inliers(views, pose.weights), np.diff(views.start)
    is_opposing = (inliers < MIN_INLIER_RATIO * counts) & (counts - inliers >= MIN_MATCHES)
    n_supporting = int(np.count_nonzero(inliers >= MIN_INLIER_RATIO * counts))
    if not is_opposing.any() or is_opposing.sum() < n_supporting:
        return False
    others, has_matches = select_matches(views, (pose.weights == 0.0) & np.repeat(is_opposing, counts))
    if n_supporting <= 1:
        return any(True for _ in find_single_camera_poses(others, max_square, thin_axis, seed))
    poses = search_poses(others, max_square, thin_axis, np.random.default_rng(seed))
    if not poses or is_by_chance(others, poses[0]):
        return False
    has_more_inliers = count_inliers(others, poses[0].weights) > inliers[has_matches]
    return int(np.count_nonzero(has_more_inliers)) >= n_supporting
