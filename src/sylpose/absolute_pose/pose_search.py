"""The search for the pose of a known model: from samples of three matches to the best robust fits, and whether chance or
other cameras say as much against one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import lgamma

import numpy as np

from sylpose.absolute_pose.pose_kernels import by_chance, drawn_good, fit, minimize, score, search
from sylpose.absolute_pose.pose_noise import CUTOFF, Noise
from sylpose.absolute_pose.pose_views import Views, agreeing, part_of
from sylpose.geometry.arrays import FloatArray

__all__ = ["MIN_MATCHES", "SAYS", "Pose", "best_poses", "by_luck", "contradicted", "of_each_camera"]

# Three matches have several exact poses; the fourth decides (derived).
MIN_MATCHES = 4
# Samples: at least, at most, and the chance that none of them was free of outliers (choice).
MIN_SAMPLES, MAX_SAMPLES, MISSED = 20, 3000, 1e-4
# Poses are searched with at most so many matches, evenly from the cameras (choice).
SEARCHED = 500
# Poses that are followed, the steps that improve each, and the rounds of re-weighting (choice).
KEPT, SEARCH_STEPS, ROUNDS = 6, 5, 50
# A start that scores worse than the best by this factor and this many matches is not followed (choice).
WORSE, WORSE_BY = 2.0, 3.0
# Poses that differ by less than this angle are one (choice).
SAME_TURN = 0.05
# A pose counts as chance when random matches would show one as good more often than this (choice).
BY_CHANCE = 0.01
# A camera says the pose that so large a share of its matches agree with (choice: a majority).
SAYS = 0.5


@dataclass(frozen=True, eq=False)
class Pose:
    """A fitted pose: rotation and place in the kernels' terms, and what the fit says of itself."""

    rotation: FloatArray
    place: FloatArray
    squares: FloatArray
    weights: FloatArray
    noise: Noise
    rounds: int
    freedom: float
    settled: bool


def best_poses(views: Views, top: float, thin: FloatArray, rng: np.random.Generator) -> list[Pose]:
    """Search, follow the best distinct poses, fit the best two to all matches; best first.

    Args:
        top: squared distance beyond which a match is wrong.
        thin: (3,) the direction in which the model extends least.
    """
    few = _subset(views, rng)
    rotations, places, scores = np.zeros((KEPT, 3, 3)), np.zeros((KEPT, 3)), np.full(KEPT + 1, np.inf)
    done, wanted = 0, MIN_SAMPLES
    while done < wanted:
        draws = rng.random((min(wanted - done, 200), 6))
        search(few, draws, top, SEARCH_STEPS, rotations, places, scores)
        done += len(draws)
        wanted = _samples(few, rotations[0], places[0], top) if scores[0] < np.inf else MAX_SAMPLES
    starts = [(rotations[k], places[k]) for k in range(KEPT) if scores[k] < np.inf]
    if not starts:
        return []
    mirrored = _mirrored(*starts[0], thin)
    minimize(few, *mirrored, _largest_noise(views, top), 10, 1e-3)
    poses: list[Pose] = []
    for rotation, place in [*starts, mirrored]:
        if score(few, rotation, place, top, np.inf) > WORSE * scores[0] + WORSE_BY or _known(poses, rotation):
            continue
        pose = _fitted(few, rotation, place, top)
        if pose is not None and not _known(poses, pose.rotation):
            poses.append(pose)
    poses = _best_first(few, poses)
    if few is not views:
        fitted = [_fitted(views, pose.rotation, pose.place, top) for pose in poses[:2]]
        poses = _best_first(views, [pose for pose in fitted if pose is not None])
    return poses


def _best_first(views: Views, poses: list[Pose]) -> list[Pose]:
    return sorted(poses, key=lambda pose: _log_chance(views, pose)) if len(poses) > 1 else poses


def _subset(views: Views, rng: np.random.Generator) -> Views:
    """At most about `SEARCHED` of the matches, as many of each camera as it has, up to the same number."""
    counts = np.diff(views.start)
    if counts.sum() <= SEARCHED:
        return views
    # Cameras with few matches leave their share to the others.
    quota = SEARCHED // len(counts)
    for _ in range(3):
        open_ = counts > quota
        if not open_.any():
            break
        quota = max(1, int((SEARCHED - counts[~open_].sum()) // open_.sum()))
    picked = [
        first + (np.arange(n) if n <= quota else rng.choice(n, quota, replace=False))
        for first, n in zip(views.start[:-1], counts, strict=True)
    ]
    start = np.concatenate([[0], np.cumsum([len(p) for p in picked])])
    every = np.concatenate(picked)
    return views._replace(
        points=views.points[every], images=views.images[every], to_pixels=views.to_pixels[every], start=start
    )


def _samples(views: Views, rotation: FloatArray, place: FloatArray, top: float) -> int:
    """How many samples it takes that one, but for a chance of `MISSED`, is free of outliers."""
    share = drawn_good(views, rotation, place, top)
    if share >= 1.0:
        return MIN_SAMPLES
    return int(np.clip(np.log(MISSED) / np.log1p(-max(share, 1e-9)), MIN_SAMPLES, MAX_SAMPLES))


def _mirrored(rotation: FloatArray, place: FloatArray, thin: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The pose that looks most alike from the cameras' middle, which is the world's origin: a flat object tilted the other
    way. A half turn about its normal, then one about the line of sight, leave its scaled orthographic image as it was."""
    sight = place / max(float(np.linalg.norm(place)), 1e-300)
    half_turns = [2.0 * np.outer(axis, axis) - np.eye(3) for axis in (sight, thin)]
    return half_turns[0] @ rotation @ half_turns[1], place.copy()


def _known(poses: Sequence[Pose], rotation: FloatArray) -> bool:
    return any(np.linalg.norm(rotation - pose.rotation) < np.sqrt(2.0) * SAME_TURN for pose in poses)


def _largest_noise(views: Views, top: float) -> Noise:
    """The same in all cameras: what the largest cutoff allows."""
    return Noise(np.full(len(views.turns), top / CUTOFF**2), np.full(len(views.turns), top))


def _fitted(views: Views, rotation: FloatArray, place: FloatArray, top: float) -> Pose | None:
    """The robust fit from a start; None where fewer than `MIN_MATCHES` matches are left."""
    rotation, place = rotation.copy(), place.copy()
    squares, weights, noise = np.empty(len(views.points)), np.zeros(len(views.points)), _largest_noise(views, top)
    rounds, freedom, settled = fit(views, rotation, place, top, ROUNDS, 1, squares, weights, noise)
    if np.count_nonzero(weights) < MIN_MATCHES:
        return None
    return Pose(rotation, place, squares, weights, noise, rounds, freedom, settled)


def _log_chance(views: Views, pose: Pose) -> float:
    """The logarithm of how many poses as good as this one random matches would show, at most.

    A random match agrees with the share of the object's image that a circle of `CUTOFF` sigma covers; the agreeing
    matches, and the three among them that determine the pose, may be chosen. This weighs the number of matches that agree
    against how well they do: of poses of the same data the one with the least is the best.

    Source: Moisan & Stival, a contrario RANSAC, 2004.
    """
    n, (k, log_share) = len(pose.weights), by_chance(views, pose.place, pose.weights, pose.noise)
    choices = lgamma(n + 1) - lgamma(n - k + 1) - lgamma(4) - lgamma(k - 2)
    return float(np.log(n) + choices + (k - 3) / k * log_share)


def by_luck(views: Views, pose: Pose) -> bool:
    """Whether random matches might show a pose as good. Where all matches agree there is no choice that chance could have
    made, and it is those that a pose does not satisfy anyway that must agree."""
    if not pose.weights.all():
        return bool(_log_chance(views, pose) > np.log(BY_CHANCE))
    k, log_share = by_chance(views, pose.place, pose.weights, pose.noise)
    return bool((k - 3) / k * log_share > np.log(BY_CHANCE))


def of_each_camera(views: Views, top: float, thin: FloatArray, seed: int) -> Iterator[tuple[int, Pose]]:
    """The cameras that say a pose by themselves, and which one: a majority of their matches, and more than `MIN_MATCHES`,
    agree with it, by no luck."""
    counts = np.diff(views.start)
    for c in np.flatnonzero(counts >= MIN_MATCHES):
        own, _ = part_of(views, np.repeat(np.arange(len(counts)) == c, counts))
        poses = best_poses(own, top, thin, np.random.default_rng(seed))
        if (
            poses
            and np.count_nonzero(poses[0].weights) > max(MIN_MATCHES, SAYS * counts[c])
            and not by_luck(own, poses[0])
        ):
            yield int(c), poses[0]


def contradicted(views: Views, pose: Pose, top: float, thin: FloatArray, seed: int) -> bool:
    """Whether as many cameras say another pose, by which none is to be believed more: of two, that one is turned against its
    calibration; of several, each of which says one of its own, that the model is too large. Cameras of wrong matches say
    none."""
    agree, counts = agreeing(views, pose.weights), np.diff(views.start)
    contrary = (agree < SAYS * counts) & (counts - agree >= MIN_MATCHES)
    say = int(np.count_nonzero(agree >= SAYS * counts))
    if not contrary.any() or contrary.sum() < say:
        return False
    others, some = part_of(views, (pose.weights == 0.0) & np.repeat(contrary, counts))
    if say <= 1:
        return any(True for _ in of_each_camera(others, top, thin, seed))
    poses = best_poses(others, top, thin, np.random.default_rng(seed))
    if not poses or by_luck(others, poses[0]):
        return False
    instead = agreeing(others, poses[0].weights) > agree[some]
    return int(np.count_nonzero(instead)) >= say
