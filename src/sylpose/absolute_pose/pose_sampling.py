"""Compiled search of `estimate_pose`: random samples of three matches, and robust fits of the best poses of samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.absolute_pose.p3p import solve_p3p
from sylpose.absolute_pose.pose_kernels import (
    ModelPose,
    Pose,
    Workspace,
    compute_log_false_alarms,
    compute_score,
    compute_squares,
    fit_pose,
    make_noise,
    make_workspace,
    minimize,
)
from sylpose.absolute_pose.views import MAX_SEARCH_MATCHES, MIN_MATCHES, Views
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.numba_linalg import HASH_MULTIPLIER, kernel, leaf

# Minimum and maximum number of samples, and the probability that none is free of outliers (choice).
MIN_SAMPLES, MAX_SAMPLES, MISS_PROBABILITY = 20, 3000, 1e-4
# Refinement steps of a sample's pose, half of those of the mirror pose (choice).
SEARCH_STEPS = 5
# Poses that differ by a smaller angle, radians, are duplicates (choice).
SAME_ROTATION = 0.05
# Poses kept (choice).
N_KEPT = 6
# A start is discarded if its score exceeds the best by this factor and this number of matches (choice).
MAX_SCORE_RATIO, MAX_SCORE_EXCESS = 2.0, 3.0
# So is one that fits less than this share of the matches that the best fits, if the odds against such a start exceed
# exp(CLEAR_LOG_ODDS). Below that, random poses show how little the best one explains (choice).
MIN_FIT_RATIO, CLEAR_LOG_ODDS = 0.5, 20.0
# Increment of the random numbers: Knuth's MMIX (derived).
RANDOM_INCREMENT = 1442695040888963407


class Search(NamedTuple):
    """Distinct poses found.

    Attributes:
        n_poses: their number.
        best: the pose with the fewest false alarms, if there is any.
        rotations, translations: (K, 3, 3) and (K, 3) of all of them, best first.
    """

    n_poses: int
    best: Pose
    rotations: FloatArray
    translations: FloatArray


@kernel
def search_poses(views: Views, max_square: float, seed: int) -> Search:
    """Search for distinct poses, refine them, and fit the best two to all matches.

    Args:
        max_square: squared distance beyond which a match is an outlier.
        seed: of the samples.
    """
    state = np.full(1, seed)
    for _ in range(2):
        _draw(state)  # the first numbers are linear in the seed
    subset = _select_subset(views, state) if len(views.points) > MAX_SEARCH_MATCHES else views
    rotations, translations, scores = np.zeros((N_KEPT, 3, 3)), np.zeros((N_KEPT, 3)), np.full(N_KEPT + 1, np.inf)
    search_samples(subset, state, max_square, rotations, translations, scores)
    best, n_fitted = scores[0], len(subset.points) - scores[0]
    max_score, max_clear = MAX_SCORE_RATIO * best + MAX_SCORE_EXCESS, best + (1.0 - MIN_FIT_RATIO) * n_fitted
    if n_fitted * np.log(max_clear / best) > CLEAR_LOG_ODDS:
        max_score = min(max_score, max_clear)
    n_starts = 0
    while n_starts < N_KEPT and scores[n_starts] < np.inf and scores[n_starts] <= max_score:
        n_starts += 1
    found = _fit_poses(subset, rotations, translations, n_starts, max_square)
    if len(subset.points) < len(views.points):
        found = _fit_poses(views, found.rotations, found.translations, min(found.n_poses, 2), max_square)
    return found


@kernel
def _fit_poses(
    views: Views, starts: FloatArray, start_translations: FloatArray, n_starts: int, max_square: float
) -> Search:
    """Fit poses robustly from the first of the starts, (K, 3, 3) and (K, 3); those with enough inliers are found."""
    rotations, translations, alarms = np.zeros((N_KEPT, 3, 3)), np.zeros((N_KEPT, 3)), np.full(N_KEPT, np.inf)
    nothing = ModelPose(rotations[0], translations[0])
    best, n_poses = Pose(nothing, np.empty(0), np.empty(0), make_noise(views, max_square), 0, 1.0, False), 0
    for s in range(n_starts):
        pose = fit_pose(views, ModelPose(starts[s], start_translations[s]), max_square)
        n_inliers = 0
        for weight in pose.weights:
            n_inliers += weight > 0.0
        if n_inliers >= MIN_MATCHES and _find_same(pose.model.rotation, rotations, alarms) == N_KEPT:
            false_alarms = compute_log_false_alarms(views, pose)
            if _insert_pose(pose.model, false_alarms, n_poses, rotations, translations, alarms) == 0:
                best = pose
            n_poses += 1
    return Search(n_poses, best, rotations, translations)


@leaf
def _draw(state: IntArray) -> float:
    """Return a random number, uniform in [0, 1), and advance the state (1,).

    Source: Knuth, "The Art of Computer Programming", 3.3.4: the linear congruential generator MMIX.
    """
    state[0] = state[0] * HASH_MULTIPLIER + RANDOM_INCREMENT
    return float(((state[0] >> 11) & 0x1FFFFFFFFFFFFF) * 2.0**-53)


@kernel
def _select_subset(views: Views, state: IntArray) -> Views:
    """Select `MAX_SEARCH_MATCHES` matches at most, or one per camera, evenly from the cameras."""
    n_cameras, start = len(views.rotations), views.start
    # Cameras with few matches leave their quota to the others.
    quota = max(1, MAX_SEARCH_MATCHES // n_cameras)
    for _ in range(3):
        n_few, n_more = 0, 0
        for c in range(n_cameras):
            if start[c + 1] - start[c] > quota:
                n_more += 1
            else:
                n_few += start[c + 1] - start[c]
        quota = max(1, (MAX_SEARCH_MATCHES - n_few) // max(n_more, 1))
    new_start = np.zeros(n_cameras + 1, np.int64)
    for c in range(n_cameras):
        new_start[c + 1] = new_start[c] + min(quota, start[c + 1] - start[c])
    n = new_start[n_cameras]
    points, images, to_pixels = np.empty((n, 3)), np.empty((n, 2)), np.empty((n, 4))
    for c in range(n_cameras):
        count = new_start[c + 1] - new_start[c]
        # One match at random of each of as many equal parts.
        size = (start[c + 1] - start[c]) / count
        for k in range(count):
            first, end = int(k * size), int((k + 1) * size)
            m = start[c] + first + int(_draw(state) * (end - first)) if size > 1.0 else start[c] + k
            points[new_start[c] + k], images[new_start[c] + k] = views.points[m], views.images[m]
            to_pixels[new_start[c] + k] = views.to_pixels[m]
    return Views(
        points, images, to_pixels, new_start, views.rotations, views.translations, views.min_variance, views.thin_axis
    )


@kernel
def _count_required_samples(views: Views, pose: ModelPose, max_square: float, workspace: Workspace) -> int:
    """Return the number of samples for which one is free of outliers except with probability `MISS_PROBABILITY`.

    Samples are those of `search_samples`; inliers of the pose are within sqrt(max_square) pixels.
    """
    squares = np.empty(len(views.points))
    compute_squares(views, pose, squares, workspace)
    n_cameras, n_inliers, camera_ratios = len(views.rotations), 0, 0.0
    for c in range(n_cameras):
        first, end, camera_inliers = views.start[c], views.start[c + 1], 0
        for k in range(first, end):
            camera_inliers += squares[k] < max_square
        n_inliers += camera_inliers
        camera_ratios += camera_inliers / (end - first)
    inlier_ratio = 0.5 * ((n_inliers / len(squares)) ** 3 + (camera_ratios / n_cameras) ** 3)
    if inlier_ratio >= 1.0:
        return MIN_SAMPLES
    required = np.log(MISS_PROBABILITY) / np.log1p(-max(inlier_ratio, 1e-9))
    return int(min(max(required, MIN_SAMPLES), MAX_SAMPLES))


@leaf
def _draw_sample(
    views: Views, state: IntArray, over_cameras: bool, origins: FloatArray, rays: FloatArray, model: FloatArray
) -> None:
    """Write the rays and model points (3, 3) of three random matches, uniform over all matches or over cameras."""
    for i in range(3):
        first, count = 0, len(views.points)
        if over_cameras:
            c = int(_draw(state) * len(views.rotations))
            first, count = views.start[c], views.start[c + 1] - views.start[c]
        k = first + int(_draw(state) * count)
        c = 0
        while k >= views.start[c + 1]:
            c += 1
        q, t = views.rotations[c], views.translations[c]
        u, v = views.images[k, 0], views.images[k, 1]
        length = np.sqrt(u * u + v * v + 1.0)
        for j in range(3):
            origins[i, j] = -(q[0, j] * t[0] + q[1, j] * t[1] + q[2, j] * t[2])
            rays[i, j] = (q[0, j] * u + q[1, j] * v + q[2, j]) / length
            model[i, j] = views.points[k, j]


@leaf
def _is_same_rotation(a: FloatArray, b: FloatArray) -> bool:
    """Return whether two rotations (3, 3) differ by less than `SAME_ROTATION`."""
    # The squared distance of two rotation matrices is 6 - 2 trace(A B^T), about twice the squared angle.
    trace = 0.0
    for i in range(3):
        for j in range(3):
            trace += a[i, j] * b[i, j]
    return bool(3.0 - trace < SAME_ROTATION * SAME_ROTATION)


@leaf
def _find_same(rotation: FloatArray, rotations: FloatArray, scores: FloatArray) -> int:
    """Return the index of the kept pose with about this rotation, or K if there is none."""
    for k in range(len(rotations)):
        if scores[k] < np.inf and _is_same_rotation(rotation, rotations[k]):
            return k
    return len(rotations)


@leaf
def _insert_pose(
    pose: ModelPose, score: float, k: int, rotations: FloatArray, translations: FloatArray, scores: FloatArray
) -> int:
    """Insert a pose, in the order of scores, in place of pose k, whose score is larger; return its index."""
    while k > 0 and score < scores[k - 1]:
        for i in range(3):
            translations[k, i] = translations[k - 1, i]
            for j in range(3):
                rotations[k, i, j] = rotations[k - 1, i, j]
        scores[k] = scores[k - 1]
        k -= 1
    for i in range(3):
        translations[k, i] = pose.translation[i]
        for j in range(3):
            rotations[k, i, j] = pose.rotation[i, j]
    scores[k] = score
    return k


@leaf
def _keep_pose(
    views: Views,
    pose: ModelPose,
    max_square: float,
    rotations: FloatArray,
    translations: FloatArray,
    scores: FloatArray,
    workspace: Workspace,
) -> int:
    """Insert a pose into those kept, in place of its duplicate or the worst; return its index, or K if it is worse."""
    k = min(_find_same(pose.rotation, rotations, scores), len(rotations) - 1)
    score = compute_score(views, pose, max_square, scores[k], workspace)
    return _insert_pose(pose, score, k, rotations, translations, scores) if score < scores[k] else len(rotations)


@leaf
def _mirror_pose(pose: ModelPose, thin_axis: FloatArray, out: ModelPose) -> None:
    """Write the mirror pose of a flat object, which looks most alike from the cameras' center, the world's origin.

    Rotations by 180 degrees about the object's normal, then about the viewing direction, preserve its scaled
    orthographic image.
    """
    r, t, mirrored = pose.rotation, pose.translation, out.rotation
    square = max(t[0] * t[0] + t[1] * t[1] + t[2] * t[2], 1e-300)
    for j in range(3):
        along = (t[0] * r[0, j] + t[1] * r[1, j] + t[2] * r[2, j]) / square
        for i in range(3):
            mirrored[i, j] = 2.0 * along * t[i] - r[i, j]
    for i in range(3):
        out.translation[i] = t[i]
        along = mirrored[i, 0] * thin_axis[0] + mirrored[i, 1] * thin_axis[1] + mirrored[i, 2] * thin_axis[2]
        for j in range(3):
            mirrored[i, j] = 2.0 * along * thin_axis[j] - mirrored[i, j]


@kernel
def search_samples(
    views: Views,
    state: IntArray,
    max_square: float,
    rotations: FloatArray,
    translations: FloatArray,
    scores: FloatArray,
) -> None:
    """Sample three matches at random; refine and keep each best pose so far, and at last the best one's mirror pose.

    Args:
        state: (1,) of the random numbers.
        max_square: squared distance beyond which a match is an outlier, pixels squared.
        rotations, translations, scores: (K, 3, 3), (K, 3), (K + 1,): the distinct poses kept, best first, and the score
            of the best sample; infinite scores initially.
    """
    n_kept, noise, workspace = len(translations), make_noise(views, max_square), make_workspace()
    origins, rays, model = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    found_rotations, found_translations = np.empty((8, 3, 3)), np.empty((8, 3))
    n_required, s = MAX_SAMPLES, 0
    while s < n_required:
        # Half of them uniform over cameras: one with many outliers must not dominate.
        _draw_sample(views, state, s % 2 == 1, origins, rays, model)
        s += 1
        best = -1
        for h in range(solve_p3p(origins, rays, model, found_rotations, found_translations)):
            found = ModelPose(found_rotations[h], found_translations[h])
            value = compute_score(views, found, max_square, scores[n_kept], workspace)
            if value < scores[n_kept]:
                scores[n_kept], best = value, h
        # Refining it would nearly always lead to a kept pose that is better already.
        if best < 0 or scores[_find_same(found_rotations[best], rotations, scores)] < scores[n_kept]:
            continue
        pose = ModelPose(found_rotations[best], found_translations[best])
        minimize(views, pose, noise, SEARCH_STEPS, 1e-3)
        if _keep_pose(views, pose, max_square, rotations, translations, scores, workspace) == 0:
            n_required = _count_required_samples(views, pose, max_square, workspace)
    if scores[0] < np.inf:
        mirrored = ModelPose(found_rotations[0], found_translations[0])
        _mirror_pose(ModelPose(rotations[0], translations[0]), views.thin_axis, mirrored)
        minimize(views, mirrored, noise, 2 * SEARCH_STEPS, 1e-3)
        _keep_pose(views, mirrored, max_square, rotations, translations, scores, workspace)
