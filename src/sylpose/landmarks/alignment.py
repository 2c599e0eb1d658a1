"""The pose that best aligns landmarks of uncertain depth with where their features are now.

Each match is a landmark X, known well across the ray it was first seen along and less well, by a standard deviation s,
along it, and an image point y. Depths are off in two ways: each for itself, and all of a camera's together, since the
object's surface is not where it was thought to be. So the landmark is at X + s r (a1 + a2 u + a3 v + ε), with r the ray,
(u, v) the place in the image, ε and the camera's three a's of unit variance. The a's are unknowns beside the six of the
motion; ε goes into the weight V = σ² I + J s² r r' J' of the image residual. A landmark that was seen once constrains only
across its epipolar line, one that is well known constrains both ways as in solvePnP, and everything in between is in
between. There is no identity trap and no degenerate object. V is held fixed within an iteration (quasi-likelihood):
letting the cost trade V against the residuals is biased towards too much motion (docs/method.md, "Better than two
frames").

Three things keep many matches from being believed too much. Neighbours' depths are off alike, so along their lines only a
few of a camera's matches count as independent. Each camera has its own noise σ. And a camera that disagrees with the
others, as one does that was moved or calibrated badly, is believed the less the more it disagrees: by the chi-squared of
its pose against theirs, a smooth function without a cliff. Should they disagree, each camera is left out once, and of the
poses so found the one is taken that all cameras but one agree on best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sylpose.landmarks.alignment_kernels import CUTOFF, Stacked, iterate, linearise
from sylpose.numerics.arrays import FloatArray, IntArray

__all__ = ["FIRST_PX", "Aligned", "Sights", "align"]


# Noise that the first, forgiving rounds assume, pixels: from a bad prediction to a keypoint's own noise.
SCHEDULE_PX = (32.0, 16.0, 8.0, 4.0, 2.0, 1.0)
FIRST_PX = SCHEDULE_PX[0]
# Cameras disagree when one of them is doubted by this factor, has this many times the rig's noise, or this much less of its
# matches agree than of another's.
DOUBTED, NOISY, FEWER = 3.0, 2.0, 0.6
# Poses are compared by the robust cost at this noise, pixels; another one than the first has to be better by a margin.
VOTE_PX, VOTE_MARGIN = 0.5, 0.01
# A camera with fewer matches has no opinion of its own.
MIN_VOTES = 3
# Doubt in a camera that was left out, when it is heard again.
LEFT_OUT = 1e4


@dataclass(frozen=True, eq=False)
class Sights:
    """One camera's matches between landmarks and the current frame.

    Attributes:
        points: (n, 3) landmarks relative to g, world axes, at the pose that the motion starts from.
        depth_error: (n, 3) s r: the direction in which each is least known, one standard deviation long, away from the
            camera.
        image: (n, 2) normalised points in the current frame.
        feature: (n,) which feature of the current frame each is about. A feature may be matched with landmarks of several
            references: they then share its weight, and one that contradicts the pose takes all of them with it.
        trust: (n,) in (0, 1], multiplies the weights.
        rotation: (3, 3) Q of camera_from_world.
        center: (3,) the camera's centre relative to g.
        focal: pixels per normalised unit.
    """

    points: FloatArray
    depth_error: FloatArray
    image: FloatArray
    feature: IntArray
    trust: FloatArray
    rotation: FloatArray
    center: FloatArray
    focal: float


@dataclass(frozen=True, eq=False)
class Aligned:
    """The motion X -> R (X - g) + g + d that aligns them.

    Attributes:
        rotation: (3, 3); shift: (3,).
        information: (6, 6) of (w, d).
        weights: per camera (n,), 0 for outliers.
        residuals: per camera (n,) pixels, across the direction that unknown depth leaves open: the epipolar distance.
        cost: robust, mean over the matches by trust, between 0 and 1: comparable between starts.
        converged: whether the last step was negligible and three matches at least agree.
        iterations: of Gauss-Newton.
        sigma_px: (C,) each camera's noise.
        doubt: (C,) 1, or more for cameras that disagree with the others: what they say has so many times the variance that
            their matches give it.
        surface: (C, 3) a.
    """

    rotation: FloatArray
    shift: FloatArray
    information: FloatArray
    weights: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    cost: float
    converged: bool
    iterations: int
    sigma_px: FloatArray = field(default_factory=lambda: np.empty(0))
    doubt: FloatArray = field(default_factory=lambda: np.empty(0))
    surface: FloatArray = field(default_factory=lambda: np.empty((0, 3)))


def align(sights: Sequence[Sights], rotation: FloatArray, shift: FloatArray, first_px: float = FIRST_PX) -> Aligned:
    """Robust Gauss-Newton from one start.

    Args:
        rotation: (3, 3) and shift: (3,), the start.
        first_px: noise that the first round assumes; the start should be right within a few times that.

    Raises:
        ValueError: no cameras.
    """
    if not sights:
        raise ValueError("alignment needs the sights of one camera at least, got none")
    stacked = stack(sights)
    schedule = [s for s in SCHEDULE_PX if s <= first_px] or list(SCHEDULE_PX[-1:])
    start = np.asarray(rotation, float), np.asarray(shift, float)
    no_doubt = np.ones(len(sights))
    joint = _solve(stacked, schedule, *start, no_doubt)
    voters = [c for c, sight in enumerate(sights) if len(sight.image) >= MIN_VOTES]
    if len(voters) < 3 or not _disagree(joint, voters):
        return joint
    candidates = [joint]
    for c in voters:
        without = _solve(stacked, schedule, *start, no_doubt, left_out=c)
        doubt = np.where(np.arange(len(sights)) == c, LEFT_OUT, 1.0)
        candidates.append(_solve(stacked, SCHEDULE_PX[-1:], without.rotation, without.shift, doubt))
    costs = [_vote(stacked, candidate, voters) for candidate in candidates]
    costs[0] -= VOTE_MARGIN
    return candidates[int(np.argmin(costs))]


def stack(sights: Sequence[Sights]) -> Stacked:
    """All cameras' matches after each other."""
    points, error, image, trust = (
        np.ascontiguousarray(np.concatenate(part), float)
        for part in zip(*((s.points, s.depth_error, s.image, s.trust) for s in sights), strict=True)
    )
    return Stacked(
        points=points,
        depth_error=error,
        image=image,
        trust=trust,
        feature=np.concatenate([s.feature for s in sights]).astype(np.int64),
        basis=np.concatenate([_basis(s.image) for s in sights]),
        offsets=np.cumsum([0, *(len(s.image) for s in sights)], dtype=np.int64),
        rotation=np.array([s.rotation for s in sights], float),
        center=np.array([s.center for s in sights], float),
        focal=np.array([s.focal for s in sights], float),
    )


def _basis(image: FloatArray) -> FloatArray:
    """(n, 3): 1, u, v, the place in the image in units of its spread."""
    if len(image) == 0:
        return np.empty((0, 3))
    spread = max(float(np.linalg.norm(image.std(axis=0))), 1e-12)
    return np.column_stack([np.ones(len(image)), (image - np.median(image, axis=0)) / spread])


def _solve(
    stacked: Stacked,
    schedule: Sequence[float],
    rotation: FloatArray,
    shift: FloatArray,
    doubt: FloatArray,
    left_out: int = -1,
) -> Aligned:
    n = len(doubt)
    rotation, shift, doubt = rotation.copy(), shift.copy(), doubt.copy()
    surface, sigma_px, information = np.zeros((n, 3)), np.empty(n), np.empty((6, 6))
    weights, across, distance = (np.zeros(len(stacked.trust)) for _ in range(3))
    count, converged = iterate(
        stacked,
        np.array(schedule, float),
        left_out,
        rotation,
        shift,
        surface,
        sigma_px,
        doubt,
        weights,
        across,
        distance,
        information,
    )
    cost = float(stacked.trust @ _cost(distance)) / max(float(stacked.trust.sum()), 1e-12)
    cuts = stacked.offsets[1:-1]
    return Aligned(
        rotation,
        shift,
        information,
        tuple(np.split(weights, cuts)),
        tuple(np.split(across, cuts)),
        cost,
        bool(converged),
        count,
        sigma_px,
        doubt,
        surface,
    )


def _cost(distance: FloatArray) -> FloatArray:
    """(n,) bisquare cost, between 0 and 1."""
    return np.asarray(1.0 - np.maximum(1.0 - (distance / CUTOFF) ** 2, 0.0) ** 3)


def _disagree(joint: Aligned, voters: Sequence[int]) -> bool:
    shares = [float((joint.weights[c] > 0).mean()) for c in voters]
    noise = joint.sigma_px[voters]
    return bool(
        joint.doubt.max() > DOUBTED or noise.max() > NOISY * np.median(noise) or min(shares) < FEWER * max(shares)
    )


def _vote(stacked: Stacked, candidate: Aligned, voters: Sequence[int]) -> float:
    """Mean cost of all cameras but the worst: one vote each, however many matches they have."""
    n = len(stacked.trust)
    place, distance, across = np.empty((n, 13)), np.empty(n), np.empty(n)
    costs = []
    for c in voters:
        mine = slice(stacked.offsets[c], stacked.offsets[c + 1])
        pose = candidate.rotation, candidate.shift, candidate.surface[c]
        linearise(stacked, c, *pose, (VOTE_PX / stacked.focal[c]) ** 2, place, distance, across)
        costs.append(float(stacked.trust[mine] @ _cost(distance[mine])) / max(float(stacked.trust[mine].sum()), 1e-12))
    return float(np.mean(sorted(costs)[:-1]))
