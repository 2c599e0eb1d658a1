"""One robust motion for all terms, and what can be said of it: the front of the compiled solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sylpose.matches import STILL_PX
from sylpose.numerics.arrays import BoolArray, FloatArray
from sylpose.numerics.compiled import kernel, rotvec_of
from sylpose.numerics.matrices import forget
from sylpose.results import Status
from sylpose.two_frames.match_cost import match_equations
from sylpose.two_frames.reweight import CUTOFF
from sylpose.two_frames.robust_fit import robust_fit
from sylpose.two_frames.terms import SURFACE, Stack, TermData, stack_terms

__all__ = ["MIN_MATCHES", "Fit", "fit_terms", "no_fit", "warm_up"]

Hypothesis = tuple[FloatArray, FloatArray]

# Eight matches in all cameras together leave two more equations than unknowns; fewer say nothing about themselves.
MIN_MATCHES = 8
# Where the moving matches of a camera go further than this, those that stand still are background.
FAR_PX = 6.0
# Quadruples that a term's seeds are drawn with, at most.
QUADRUPLES = 300
# A solver whose last step was a standard deviation long (this is half its square) had not converged.
CONVERGED = 0.5
# Chi-square of six unknowns that chance exceeds once in a thousand times: what no motion at all must cost more.
CERTAIN_MOTION = 22.5
# Points that depart from a line by no more than this, in standard deviations of their noise, lie on it.
ROD_SIGMAS = 2.5
# So large a share of inliers is not had by chance.
CERTAIN_SHARE = 0.7
# Times that partners are exchanged to measure chance, at most, and with how many matches once or twice will do.
EXCHANGES, EXCHANGED = 8, 1000


@dataclass(frozen=True, eq=False)
class Fit:
    """A robust fit of one motion to terms: what `estimate_motion` and the tracker share.

    Attributes:
        status: see `Status`.
        rotation: (3, 3) R and shift: (3,) d, X_j = R (X_i - g) + g + d; meaningless without `status.has_pose`.
        weights: per term (n,), 0 for outliers.
        residuals: per term (n,) signed epipolar distances, pixels.
        information: (6, 6) of (w, d).
        information_without_depth: (6, 6) the same when nothing is believed of its surfaces, neither how far away they are
            nor how curved.
        iterations: of the solver, all rounds.
        faults: a sentence for each camera that is recognised to be at fault.
    """

    status: Status
    rotation: FloatArray
    shift: FloatArray
    weights: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    information: FloatArray
    information_without_depth: FloatArray
    iterations: int
    faults: tuple[str, ...] = ()

    def with_matches(self, weights: Sequence[FloatArray], residuals: Sequence[FloatArray]) -> Fit:
        """The same fit, spoken of as one of other terms."""
        return replace(self, weights=tuple(weights), residuals=tuple(residuals))


def fit_terms(
    data: Sequence[TermData],
    center: FloatArray,
    radius: float,
    guesses: Sequence[Hypothesis],
    rng: np.random.Generator,
) -> Fit:
    """One robust motion for all terms: per-term RANSAC, minima from several starts, re-weighting.

    Args:
        data: T terms with at least one match each.
        center: (3,) g, the object's centre at the motion's start.
        radius: of the object.
        guesses: (R, d) tried as starts besides the built-in ones.
        rng: seeded.
    """
    if sum(len(term) for term in data) < MIN_MATCHES:
        return no_fit(data, Status.TOO_FEW_MATCHES)
    stack = stack_terms(data, center, radius)
    n, n_matches = len(stack.focal), len(stack.x)
    usable = np.ones(n_matches, dtype=bool)
    _not_background(stack, usable)
    rotation, shift = np.eye(3), np.zeros(3)
    weights, across = np.zeros(n_matches), np.zeros(n_matches)
    sigma_px = np.ones(n)
    information, without_depth, noise = np.zeros((3, 6, 6))
    iterations, promise = robust_fit(
        stack,
        usable,
        rng.random((QUADRUPLES, 4)),
        np.array([r for r, _ in guesses]).reshape(-1, 3, 3),
        np.array([d for _, d in guesses]).reshape(-1, 3),
        rotation,
        shift,
        weights,
        across,
        sigma_px,
        information,
        without_depth,
        noise,
    )
    status = Status.OK
    if not (weights > 0).sum() >= MIN_MATCHES or not _is_consistent(stack, usable, weights, rotation, shift, sigma_px):
        status = Status.NOT_CONSISTENT
    rod = _rod(stack, weights, sigma_px)
    # About a rod the solver circles: that is no failure.
    if status is Status.OK and not ((promise < CONVERGED or rod is not None) and np.isfinite(information).all()):
        status = Status.NOT_CONVERGED
    if status is not Status.OK:
        return no_fit(data, status)
    # σ is estimated: the covariance is that of Student's distribution.
    freedom = int((weights > 0).sum()) - 6
    known = max(freedom - 2, 1) / freedom
    information, without_depth = (known * _without_noise(part, noise) for part in (information, without_depth))
    if _stands_still(stack, weights, across, sigma_px, rotation, shift, information):
        status, rotation, shift = Status.NO_MOTION, np.eye(3), np.zeros(3)
    if rod is not None:
        information, without_depth = forget(information, rod), forget(without_depth, rod)
    return Fit(
        status,
        rotation,
        shift,
        tuple(np.split(weights, stack.offsets[1:-1])),
        tuple(np.split(across, stack.offsets[1:-1])),
        information,
        without_depth,
        int(iterations),
    )


def _stands_still(
    stack: Stack,
    weights: FloatArray,
    across: FloatArray,
    sigma_px: FloatArray,
    rotation: FloatArray,
    shift: FloatArray,
    information: FloatArray,
) -> bool:
    """Whether the motion found may be none: it is no further from none than chance takes it, by its own information
    (Wald's test), and none explains the inliers about as well.

    The second asks what the first cannot: a turn that the cameras hardly see has little information and moves the
    matches all the same. Of a match's two coordinates the fit leaves one; the other, along its epipolar line, is counted as
    if it were all noise.
    """
    motion = np.concatenate([np.empty(3), shift])
    rotvec_of(rotation, motion[:3])
    if motion @ information @ motion >= CERTAIN_MOTION:
        return False
    counts = np.diff(stack.offsets)
    stood = 0.5 * ((stack.y - stack.x) ** 2).sum(axis=1) * np.repeat(stack.focal / sigma_px, counts) ** 2
    moved = (across / np.repeat(sigma_px, counts)) ** 2 + 1.0
    return bool(weights @ (stood - moved) < CERTAIN_MOTION)


def _rod(stack: Stack, weights: FloatArray, sigma_px: FloatArray) -> FloatArray | None:
    """(6,) the turn about itself, of points that lie on one line in every camera up to noise; else None.

    Noise across the line, with the surface bent to fit it, would pass for structure that shows this turn.
    """
    normals = np.zeros((3, 3))
    if not _on_lines(stack, weights, sigma_px, normals):
        return None
    return np.concatenate([np.linalg.eigh(normals)[1][:, 0], np.zeros(3)])


@kernel
def _on_lines(stack: Stack, weights: FloatArray, sigma_px: FloatArray, normals: FloatArray) -> bool:
    """Whether all terms' inliers lie on lines in both images; normals (3, 3) becomes the sum of n n' over the planes through
    the current cameras and those lines.
    """
    lined, inliers = 0, 0
    for t in range(stack.focal.shape[0]):
        for frame in range(2):
            points = stack.y if frame == 1 else stack.x
            n, mx, my, xx, xy, yy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(stack.offsets[t], stack.offsets[t + 1]):
                if weights[i] > 0.0:
                    n += 1
                    mx += points[i, 0]
                    my += points[i, 1]
            inliers += n
            # Two points always lie on a line.
            if n < 3:
                continue
            lined += n
            mx, my = mx / n, my / n
            for i in range(stack.offsets[t], stack.offsets[t + 1]):
                if weights[i] > 0.0:
                    dx, dy = points[i, 0] - mx, points[i, 1] - my
                    xx += dx * dx / (n - 1)
                    xy += dx * dy / (n - 1)
                    yy += dy * dy / (n - 1)
            # The smaller eigenvalue of the points' covariance.
            least = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
            if least > (ROD_SIGMAS * sigma_px[t] / stack.focal[t]) ** 2:
                return False
            if frame == 1:
                angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
                a, b = -np.sin(angle), np.cos(angle)
                normal = np.empty(3)
                for k in range(3):
                    normal[k] = a * stack.qy[t, 0, k] + b * stack.qy[t, 1, k] - (a * mx + b * my) * stack.qy[t, 2, k]
                length = normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
                for k in range(3):
                    for j in range(3):
                        normals[k, j] += normal[k] * normal[j] / length
    return lined > inliers // 2


def _without_noise(information: FloatArray, noise: FloatArray) -> FloatArray:
    """Information (6, 6) less the part that noise alone put there.

    With both as quadratic forms in axes where the information is the identity: (1 - ν)² of each axis is left, the
    sandwich H J'J^-1 H of M-estimation with H = J'J - noise. A trace always stays.
    """
    largest = float(np.diag(information).max())
    if not largest > 1e-100:
        return information
    unit = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12 * largest))
    values, vectors = np.linalg.eigh(information * np.outer(unit, unit))
    root = np.sqrt(np.maximum(values, 1e-14 * float(values[-1])))
    to_identity = unit[:, None] * vectors / root
    spoilt, axes = np.linalg.eigh(to_identity.T @ noise @ to_identity)
    half = (vectors * root / unit[:, None]) @ axes * np.clip(1.0 - spoilt, 1e-3, 1.0)
    return np.asarray(half @ half.T)


@kernel
def _not_background(stack: Stack, usable: BoolArray) -> None:
    """usable (N,): matches that may lie on the object. In a camera that sees it move by far, what stands still does not."""
    for t in range(stack.focal.shape[0]):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        moving, count = np.empty(last - first), 0
        for i in range(first, last):
            dx, dy = stack.y[i, 0] - stack.x[i, 0], stack.y[i, 1] - stack.x[i, 1]
            far = np.sqrt(dx * dx + dy * dy) * stack.focal[t]
            usable[i] = far > STILL_PX
            if usable[i]:
                moving[count] = far
                count += 1
        if count == 0 or np.median(moving[:count]) <= FAR_PX:
            usable[first:last] = True


def _is_consistent(
    stack: Stack,
    usable: BoolArray,
    weights: FloatArray,
    rotation: FloatArray,
    shift: FloatArray,
    sigma_px: FloatArray,
) -> bool:
    """Whether more matches agree with the fit than would by chance.

    Chance is measured: with the partners exchanged among a camera's matches, those that still agree do so by chance. The
    best of many hypotheses finds more of them, hence the factor; six it can always satisfy.
    """
    inliers, total = int((weights > 0).sum()), int(usable.sum())
    if inliers >= CERTAIN_SHARE * total:
        return True
    exchanges = min(EXCHANGES, 1 + EXCHANGED // total)
    by_chance = 0.0
    distance, across, along, parallax, agree = np.empty((5, len(weights)))
    no_noise, equations = np.empty((0, 0)), np.empty((6 + SURFACE, 8 + SURFACE))
    for k in range(1, exchanges + 1):
        y = stack.y.copy()
        for first, last in zip(stack.offsets, stack.offsets[1:], strict=False):
            index = first + np.flatnonzero(usable[first:last])
            # By far, since neighbours in the list may be neighbours in the image, or the same match again.
            y[index] = np.roll(y[index], k * max(1, len(index) // (exchanges + 1)), axis=0)
        mixed = stack._replace(y=y)
        agree[:] = 0.0
        for t, (first, last) in enumerate(zip(stack.offsets, stack.offsets[1:], strict=False)):
            # What is set aside, and a match that cannot be exchanged with another, tells nothing.
            if not (weights[first:last] > 0).any() or usable[first:last].sum() <= k:
                continue
            variance, relief, surface = (sigma_px[t] / stack.focal[t]) ** 2, stack.relief[t], stack.surface_mean[t]
            match_equations(
                mixed,
                t,
                usable,
                rotation,
                shift,
                surface,
                variance,
                relief,
                relief,
                CUTOFF,
                distance,
                across,
                along,
                parallax,
                agree,
                equations,
                no_noise,
            )
        other = usable & (y != stack.y).any(axis=1)
        by_chance += float((agree[other] > 0.0).sum()) * total / max(int(other.sum()), 1) / exchanges
    return inliers > 12 + 4.0 * by_chance


def no_fit(data: Sequence[TermData], status: Status) -> Fit:
    """What is returned for a status without a pose."""
    weights = tuple(np.zeros(len(term)) for term in data)
    nothing = np.zeros((6, 6))
    return Fit(status, np.eye(3), np.zeros(3), weights, weights, nothing, nothing, 0)


def warm_up() -> None:
    """Compiles what `fit_terms` runs, or loads it where that has been done: a third of a second, half a minute once."""
    x = np.random.default_rng(0).uniform(-0.1, 0.1, (12, 2))
    data = [TermData(k, x, x + 0.01 * k, np.eye(3), np.array([k - 0.5, 0.0, -1.0]), 1000.0) for k in range(2)]
    fit_terms(data, np.zeros(3), 0.1, [], np.random.default_rng(0))
