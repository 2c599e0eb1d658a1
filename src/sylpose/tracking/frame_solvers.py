"""How the tracker finds one frame's pose from its matches with earlier frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from sylpose.landmarks.alignment import Aligned, Sights, align
from sylpose.landmarks.alignment_kernels import CUTOFF
from sylpose.landmarks.places import Landmarks
from sylpose.numerics.arrays import BoolArray, FloatArray, IntArray
from sylpose.paper.known_depth import solve_2d3d
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.tracking.frame import Pair, Reference, still
from sylpose.two_frames.fit import MIN_MATCHES, Fit, no_fit
from sylpose.two_frames.paper_methods import ESTIMATORS, paper_fit
from sylpose.two_frames.solver import fit_terms

__all__ = ["SOLVERS", "best_landmarks", "usual_age"]

Hypothesis = tuple[FloatArray, FloatArray]
# (rig, pairs, current frame, base, radius, guess of (R, d) from the base, rng) -> one weight array per pair in the fit.
Solver = Callable[[Rig, Sequence[Pair], Reference, Reference, float, Hypothesis, np.random.Generator], Fit]

# Above this mean robust cost most landmarks contradict the pose that was started from: other starts are tried.
POOR_COST = 0.6
# So many sights of a feature leave its depth a guess.
YOUNG = 3
# Weight of a landmark that stands still and never moved, while others move.
STILL_TRUST = 0.05
# A depth is known where it moves the landmark's image by less than this, pixels; the 2D-3D equation wants so many.
KNOWN_PX, KNOWN = 1.0, 30
# Depths and motion are found in turns so often at most, until the rotation changes by less.
POSIT_ROUNDS, POSIT_SETTLED = 20, 1e-6
# Landmarks with less trust are no evidence that a pose is right.
TRUSTED = 0.06


def solve_epipolar(
    rig: Rig,
    pairs: Sequence[Pair],
    _current: Reference,
    base: Reference,
    radius: float,
    guess: Hypothesis,
    rng: np.random.Generator,
) -> Fit:
    """Epipolar geometry against all references at once; what is known of the features' depth is not used."""
    data = [pair.term(rig, base) for pair in pairs]
    return fit_terms(data, base.world_from_object.translation, radius, [guess], rng)


def solve_paper(
    method: str,
    rig: Rig,
    pairs: Sequence[Pair],
    _current: Reference,
    base: Reference,
    radius: float,
    guess: Hypothesis,
    rng: np.random.Generator,
) -> Fit:
    """One of the paper's estimators, against the last solved frame alone; the other references are left out."""
    center = base.world_from_object.translation
    data = [pair.term(rig, base) for pair in pairs]
    near = [i for i, pair in enumerate(pairs) if pair.reference is base]
    fit = fit_terms([data[i] for i in near], center, radius, [guess], rng)
    if fit.status is Status.OK:
        fit = paper_fit(method, [data[i] for i in near], fit, center, rig.names)
    none = no_fit(data, fit.status)
    weights, residuals = list(none.weights), list(none.residuals)
    for i, w, r in zip(near, fit.weights, fit.residuals, strict=True):
        weights[i], residuals[i] = w, r
    return fit.with_matches(weights, residuals)


def solve_landmarks(
    rig: Rig,
    pairs: Sequence[Pair],
    current: Reference,
    base: Reference,
    radius: float,
    guess: Hypothesis,
    rng: np.random.Generator,
) -> Fit:
    """Alignment with the landmarks of all references; from other starts where the guess is contradicted."""
    sights = _trusted([_sights(rig, pairs, current, base, camera) for camera in range(len(rig))], base.age)
    data = [pair.term(rig, base) for pair in pairs]
    if sum(len(s.points) for s in sights) < MIN_MATCHES:
        return no_fit(data, Status.TOO_FEW_MATCHES)
    aligned = align(sights, *guess)
    # While all depths are guesses, a turn the other way with the depths reversed explains nearly as much (the mirrored
    # solution of few cameras and small turns); epipolar geometry is asked for its opinion.
    young = max(pair.reference.landmarks[pair.camera].seen.max() for pair in pairs) <= YOUNG
    if young or aligned.cost > POOR_COST:
        other = fit_terms(data, base.world_from_object.translation, radius, [guess], rng)
        if other.status is Status.OK:
            again = align(sights, other.rotation, other.shift, first_px=4.0)
            aligned = min(aligned, again, key=lambda a: a.cost)
    fit = _fit_of(aligned, pairs, len(rig))
    if fit.status.has_pose and _by_chance(sights, aligned, current):
        return no_fit(data, Status.NOT_CONSISTENT)
    return fit


def solve_known_depth(
    rig: Rig,
    pairs: Sequence[Pair],
    current: Reference,
    base: Reference,
    radius: float,
    guess: Hypothesis,
    rng: np.random.Generator,
) -> Fit:
    """Sylvester's equation for points known in 3D (2D-3D), of the landmarks that `solve_landmarks` finds to agree and whose
    depth is known by now; where these are too few or leave a mirrored answer, that of `solve_landmarks` stands.

    The equation is of orthographic views: each image point is scaled by its landmark's depth, as the motion so far has it,
    and the two are found in turns (POSIT: D. DeMenthon, L. Davis, 1995).
    """
    fit = solve_landmarks(rig, pairs, current, base, radius, guess, rng)
    if fit.status is not Status.OK:
        return fit
    cameras = [_sights(rig, pairs, current, base, c)[0] for c in range(len(rig))]
    weights = [
        np.concatenate([np.empty(0), *(w for pair, w in zip(pairs, fit.weights, strict=True) if pair.camera == c)])
        for c in range(len(rig))
    ]
    known = [s.focal * _smear(s, fit.rotation, fit.shift) < KNOWN_PX for s in cameras]
    weights = [np.where(k, w, 0.0) for k, w in zip(known, weights, strict=True)]
    if sum(int((w > 0).sum()) for w in weights) < KNOWN:
        return fit
    rotations, centers = np.array([s.rotation for s in cameras]), np.array([s.center for s in cameras])
    points = [s.points for s in cameras]
    R, shift = guess
    rounds = 0
    for _ in range(POSIT_ROUNDS):
        images = [s.image * ((s.points @ R.T + shift - s.center) @ s.rotation[2])[:, None] for s in cameras]
        s = solve_2d3d(rotations, points, images, centers=centers, weights=weights)
        rounds += s.iterations
        if s.status is not Status.OK:
            return fit
        change = np.abs(s.rotation - R).max()
        R, shift = s.rotation, s.translation
        if change < POSIT_SETTLED:
            break
    # From the displacement of the points' mean to that of the object's centre, here the origin.
    about = np.eye(6)
    about[3:, :3] = -np.cross(np.eye(3), R @ s.center)
    information = about.T @ block_diag(s.information, s.displacement_information) @ about
    return replace(
        fit,
        rotation=R,
        shift=shift,
        information=information,
        information_without_depth=information,
        iterations=fit.iterations + rounds,
    )


def _by_chance(sights: Sequence[Sights], aligned: Aligned, current: Reference) -> bool:
    """Whether random matches would agree with the pose about as often.

    A random match agrees when it falls into the ellipse around its landmark's image in which it counts as an inlier: that
    happens with the ellipse's share of the region that the camera's features fill. The best of many poses finds more of
    them, hence the factor; twice as many as there are unknowns (six, and three of each camera's surface) can be satisfied
    by choice. What is not trusted is no evidence.
    """
    inliers, total, by_chance, unknowns = 0, 0, 0.0, 6
    for c, (sight, weights, residuals) in enumerate(zip(sights, aligned.weights, aligned.residuals, strict=True)):
        if not len(sight.image):
            continue
        good = (weights > 0) & (sight.trust > TRUSTED)
        inliers += len(np.unique(sight.feature[good]))
        total += len(np.unique(sight.feature))
        unknowns += 3
        sigma = np.sqrt(np.mean(residuals[good] ** 2)) / sight.focal if good.any() else 1.0 / sight.focal
        along = _smear(sight, aligned.rotation, aligned.shift)
        region = float(np.prod(np.ptp(current.features[c].normalized, axis=0)))
        share = np.minimum(np.pi * CUTOFF**2 * sigma * np.hypot(sigma, along) / max(region, 1e-12), 1.0)
        # A feature that is matched with several landmarks is tried once.
        by_chance += float(np.bincount(sight.feature, share).sum() / max(np.bincount(sight.feature).max(), 1))
    return inliers < 0.8 * total and inliers < 2 * unknowns + 4.0 * by_chance


def _smear(sight: Sights, rotation: FloatArray, shift: FloatArray) -> FloatArray:
    """(n,) by how much one standard deviation of a landmark's depth moves its image, normalised units."""
    ends = [(sight.points + k * sight.depth_error) @ rotation.T + shift - sight.center for k in (0, 1)]
    near, far = (p @ sight.rotation.T for p in ends)
    return np.asarray(np.linalg.norm(near[:, :2] / near[:, 2:] - far[:, :2] / far[:, 2:], axis=1))


def _trusted(sights: Sequence[tuple[Sights, BoolArray]], before: float) -> list[Sights]:
    """Sights with their trust, given as in how many frames each was seen, and whether each moves or did.

    What has moved along for long deserves more of it than what has just come into view (a hand, say). A landmark that
    stands still and was never seen to move gets next to none once others do: a background that is not known as such yet
    agrees with itself as well as the object does, and is often larger.

    Args:
        before: the age that was usual in the last frame. Where all that is old has vanished at once, something else is seen.
    """
    seen = np.concatenate([s.trust for s, _ in sights])
    usual = max(usual_age(seen), before)
    moving = sum(int(m.sum()) for _, m in sights)
    background = STILL_TRUST if moving >= max(MIN_MATCHES, 0.1 * len(seen)) else 1.0
    return [replace(s, trust=np.minimum(s.trust / usual, 1.0) ** 2 * np.where(m, 1.0, background)) for s, m in sights]


def usual_age(seen: FloatArray) -> float:
    """The number of frames that a landmark must have been seen in to be trusted fully, from those of all (n,)."""
    return float(np.quantile(seen, 0.75)) if len(seen) else 1.0


def _sights(rig: Rig, pairs: Sequence[Pair], current: Reference, base: Reference, c: int) -> tuple[Sights, BoolArray]:
    """One camera's matches of landmarks, carried to where the object was in the base frame, and which of them move or did;
    their trust is for now in how many frames they were seen."""
    camera, mine = rig.cameras[c], [pair for pair in pairs if pair.camera == c]
    known = Landmarks.concatenate([pair.reference.landmarks[c].subset(pair.indices[:, 0]) for pair in mine])
    index = np.concatenate([np.empty(0, np.int64), *(pair.indices[:, 1] for pair in mine)])
    turn, center = base.world_from_object.rotation, base.world_from_object.translation
    points = turn.apply(known.mean).reshape(-1, 3)
    error = turn.apply(known.depth_error).reshape(-1, 3)
    away = np.sign(np.einsum("ni,ni->n", error, points + center - camera.center))
    # In how many frames each feature was seen, by the best known of its landmarks.
    seen = np.zeros(int(index.max(initial=-1)) + 1)
    np.maximum.at(seen, index, known.seen)
    moving = np.concatenate([np.empty(0, bool), *(~still(pair) for pair in mine)]) | known.moved
    sights = Sights(
        points=points,
        depth_error=error * away[:, None],
        image=current.features[c].normalized[index],
        feature=index,
        trust=seen[index],
        rotation=camera.rotation,
        center=camera.center - center,
        focal=camera.focal,
    )
    return sights, moving


def _fit_of(aligned: Aligned, pairs: Sequence[Pair], n_cameras: int) -> Fit:
    """The alignment as a fit: its per-camera arrays cut into the pairs that they were put together from."""
    weights, residuals = [], []
    done = [0] * n_cameras
    for pair in pairs:
        part = slice(done[pair.camera], done[pair.camera] + len(pair))
        weights.append(aligned.weights[pair.camera][part])
        residuals.append(aligned.residuals[pair.camera][part])
        done[pair.camera] = part.stop
    status = Status.OK if aligned.converged else Status.NOT_CONVERGED
    if sum(int((w > 0).sum()) for w in weights) < MIN_MATCHES:
        status = Status.NOT_CONSISTENT
    return Fit(
        status,
        aligned.rotation,
        aligned.shift,
        tuple(weights),
        tuple(residuals),
        aligned.information,
        aligned.information,
        aligned.iterations,
    )


def best_landmarks(pairs: Sequence[Pair], camera: int) -> tuple[IntArray, Landmarks]:
    """For each feature of the current frame that is matched at all, the best known of the landmarks it is matched with.

    It has moved if any of them has, or does so now.

    Returns:
        index (k,) into the current frame's features; their landmarks (k).
    """
    mine = [pair for pair in pairs if pair.camera == camera and len(pair)]
    if not mine:
        return np.empty(0, np.int64), Landmarks.none()
    known = Landmarks.concatenate([pair.reference.landmarks[camera].subset(pair.indices[:, 0]) for pair in mine])
    index = np.concatenate([pair.indices[:, 1] for pair in mine])
    order = np.lexsort([known.depth_sd, index])
    _, first = np.unique(index[order], return_index=True)
    pick = order[first]
    moved = known.moved | np.concatenate([~still(pair) for pair in mine])
    ever = np.zeros(int(index.max()) + 1, bool)
    np.logical_or.at(ever, index, moved)
    return index[pick], replace(known.subset(pick), moved=ever[index[pick]])


SOLVERS: dict[str, Solver] = {
    "landmarks": solve_landmarks,
    "epipolar": solve_epipolar,
    **{method: partial(solve_paper, method) for method in ESTIMATORS},
    "known-depth": solve_known_depth,
}
