"""The rotation that most cameras agree on, each of them judged by the affine map that its matches give.

Each camera's matches give an affine map y = F x. The object's rotation R as that camera sees it allows F = s (N + m a'),
N the upper-left 2x2 block and m the rest of the first two rows of Q R Q', for a plane z = a'x of depths and a scale s near
1. So each camera has the four numbers of F - N to be judged by, with a covariance that holds the noise of its matches, the
unknown plane and scale, and what perspective leaves out (θ is the angle of R):

    V = cov(F) + λ σ_a² mm' ⊗ I + σ_s² vec(N) vec(N)' + (τ₀² + τ₁² θ²) I,
    score = min over λ >= 1 of vec(F - N)' V⁻¹ vec(F - N) + log λ + 1/λ - 1.

λ says how steep the plane is, and what that costs: a normal that may point anywhere has slopes a of density
(1 + |a|²)^(-3/2) / 2π, a Cauchy distribution, which is a normal one of variance λ, and log λ + 1/λ is what λ adds to
-2 log-likelihood (of log λ). So a board seen at 80 degrees from its normal is no wonder, where slopes of a normal
distribution would have it impossible; the two numbers of F across m, which no slope explains, are judged as before.

The rotation is searched for from small groups of cameras, so that bad ones do not hide behind what they do to the estimate.
Of two rotations that explain the scores, the smaller turn is likelier: the larger one explains anything, log det V says.

Source: method.md, section 3 (the depth plane); noise in x: W. Fuller, Measurement Error Models (1987); the search is ours.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import transpose
from sylpose.sylvester.orthographic import ROUNDING, Views

__all__ = [
    "FAULT",
    "AffineFits",
    "Scores",
    "affine_fits",
    "agreed_rotation",
    "normal_equations",
    "score",
    "settled",
    "turned",
]


# What is believed of a camera's view: slopes of the plane of depths (choice), change of scale (choice: an object that comes
# 5 % nearer is a fast one), and what is no affine image at all, without a turn and per radian of it
# (measured: docs/benchmarks.md#bad-sensors, no good camera named).
SLOPE, SCALE, LEFT_OVER, LEFT_OVER_PER_RADIAN = 0.5, 0.05, 0.003, 0.03
# λ is one of these: planes of up to 89.9 degrees. Between them the score would be less by no more than 0.3 (derived).
STEEP = 4.0 ** np.arange(11)
# Of the squares along x, what noise may have made: no more than this share of those along the wider direction (choice: of
# more noise than a tenth of the object's size, nothing is left to be judged), and in either at least so much is not noise
# (choice: F along a line that is as narrow as its noise is worth nothing, and its covariance says so). How far the noise may
# be off, relative (derived: root mean square of the least of two eigenvalues, of twenty matches).
NOISE_SHARE, NOT_NOISE, NOISE_DOUBT = 0.01, 0.1, 0.4
# A camera is at fault above this score: of good ones, boxes and ellipsoids in perspective, 99 in 100 are below 4
# (measured: docs/benchmarks.md#bad-sensors, no good camera of 12,400 is named).
FAULT = 12.0
# -2 log-likelihood of a camera at fault: its F may be anywhere, and few cameras are. An F larger than a rotation needs
# slopes here, too: so much is added per log |F|² (derived: F = m a', any m, slopes a of a Cauchy distribution, whose length
# has a density ~ |a|⁻², in four dimensions). By how much one set of faulty cameras must be likelier than any other: a factor
# of exp(3) = 20 (choice).
AT_FAULT, AT_FAULT_FALLS, MARGIN = 0.0, 5.0, 6.0
# More than so many cameras, all below this score: nothing is searched for. Fewer can all agree on something wrong (choice).
FEW, AGREED = 4, 4.0
# Fewer matches than this are not judged: an affine map with a place takes three (choice).
MIN_MATCHES = 6.0
# Matches are on one line whose smaller spread is at most this share of the larger: the root of rounding's (derived).
ON_A_LINE = 1e-9
# The search starts from no more groups, and goes on with the best (choice: time).
GROUPS, KEPT = 40, 8
# A step turns by no more than this, radians: V, held fixed in it, changes with the turn (choice). A shorter one than
# `SETTLED` is none (choice).
LONGEST_STEP, SETTLED = 0.3, 1e-6
_SKEW = -np.cross(np.eye(3)[:, None], np.eye(3))


class AffineFits(NamedTuple):
    """The affine maps of the n cameras that can be judged.

    Attributes:
        camera: (n,) indices of the cameras.
        F: (n, 2, 2) y = F x on centred points.
        noise: (n, 4, 4) covariance of vec(F), from what the map leaves and from how well the noise of x is known.
        axes_x, axes_y: (n, 3, 3) of the camera in frames i and j, in the world.
        weight: (n,) Σ w.
    """

    camera: IntArray
    F: FloatArray
    noise: FloatArray
    axes_x: FloatArray
    axes_y: FloatArray
    weight: FloatArray

    def subset(self, rows: IntArray) -> AffineFits:
        """The fits that an index array picks."""
        return AffineFits._make(field[rows] for field in self)


class Scores(NamedTuple):
    """Of K rotations and n cameras.

    Attributes:
        squared: (K, n) the scores.
        unlikely: (K, n) the least over λ of the score's terms plus log det V.
        difference: (K, n, 4) vec(F - N).
        precision: (K, n, 4, 4) V⁻¹.
        jacobian: (K, n, 4, 3) of vec(N + m a') by w, R = exp(w) R.
        slopes: (K, n, 2) the a that suit each camera there.
    """

    squared: FloatArray
    unlikely: FloatArray
    difference: FloatArray
    precision: FloatArray
    jacobian: FloatArray
    slopes: FloatArray


def affine_fits(views: Views) -> AffineFits:
    """Of the cameras with at least `MIN_MATCHES` matches that are not all on one line."""
    spread = np.linalg.eigvalsh(views.s_xx)
    enough = (views.weights >= MIN_MATCHES) & (spread[:, 0] > ON_A_LINE * spread[:, 1])
    enough &= spread[:, 1] > 10 * ROUNDING * views.total
    v = views.subset(enough)
    misfit = v.s_yy - v.s_yx @ np.linalg.solve(v.s_xx, transpose(v.s_yx))
    misfit = (misfit + transpose(misfit)) / 2
    values, vectors = np.linalg.eigh(misfit)
    misfit = (vectors * np.maximum(values, 0.0)[:, None]) @ transpose(vectors)
    variance = misfit / (v.weights - 3)[:, None, None]
    inverse, in_x = _without_noise(v)
    F = v.s_yx @ inverse
    noise = np.einsum("cij,ckl->cikjl", variance, inverse @ v.s_xx @ inverse).reshape(-1, 4, 4)
    doubt = NOISE_DOUBT * in_x[:, None] * (F @ inverse).reshape(-1, 4)
    noise += doubt[:, :, None] * doubt[:, None]
    return AffineFits(np.flatnonzero(enough), F, noise, v.rotation_x, v.rotation_y, v.weights)


def _without_noise(v: Views) -> tuple[FloatArray, FloatArray]:
    """The inverse of s_xx without the noise of x (n, 2, 2), and what that is taken to be along each direction (n,).

    Least squares make F too small along a direction in which the image is hardly wider than the noise of x: a board that is
    seen from its side. Whatever the depths, (x, y) lie near a hyperplane; how near, says the noise.
    """
    scatter = np.block([[v.s_xx, transpose(v.s_yx)], [v.s_yx, v.s_yy]])
    spread, axes = np.linalg.eigh(v.s_xx)
    in_x = np.clip(np.linalg.eigvalsh(scatter)[:, 0], 0.0, NOISE_SHARE * spread[:, 1])
    true = np.maximum(spread - in_x[:, None], NOT_NOISE * spread)
    return (axes / true[:, None]) @ transpose(axes), in_x


def score(fits: AffineFits, rotations: FloatArray) -> Scores:
    """The scores of all cameras at K rotations (K, 3, 3)."""
    to_y = fits.axes_y[:, :2]
    from_x = transpose(fits.axes_x)
    seen = to_y @ rotations[:, None] @ from_x
    N, m = seen[..., :2], seen[..., 2]
    shape = N.shape[:2]
    n = N.reshape(*shape, 4)
    angle = Rotation.from_matrix(rotations).magnitude()
    left_over = LEFT_OVER**2 + (LEFT_OVER_PER_RADIAN * angle) ** 2
    V = fits.noise + SCALE**2 * n[..., :, None] * n[..., None, :] + left_over[:, None, None, None] * np.eye(4)
    level = np.linalg.inv(V)
    difference = fits.F.reshape(-1, 4) - n
    # What slopes add to V has two directions; along these, λ is found for all its values at once.
    leaning = (m[..., :, None, None] * np.eye(2)).reshape(*shape, 4, 2)
    weight, directions = np.linalg.eigh(transpose(leaning) @ level @ leaning)
    weight = np.maximum(weight, 0.0)
    toward = level @ leaning @ directions
    pull = (transpose(toward) @ difference[..., None])[..., 0]
    steep = SLOPE**2 * STEEP[:, None, None, None]
    price = np.log(STEEP) + 1 / STEEP - 1
    added = price[:, None, None] - (pull**2 / (weight + 1 / steep)).sum(axis=-1)  # (λ, K, n)
    likeliest = added.argmin(axis=0)
    gain = 1 / (weight + 1 / steep[likeliest][..., 0, 0, :])
    precision = level - (toward * gain[..., None, :]) @ transpose(toward)
    squared = (difference * (level @ difference[..., None])[..., 0]).sum(axis=-1)
    wider = added + np.log1p(steep * weight).sum(axis=-1)
    unlikely = squared + np.linalg.slogdet(V)[1] + wider.min(axis=0)
    slopes = (directions @ (gain * pull)[..., None])[..., 0]
    turned = (to_y[:, None] @ _SKEW) @ rotations[:, None, None] @ from_x[:, None]  # (K, n, 3, 2, 3): by w
    jacobian = (turned[..., :2] + turned[..., 2:] * slopes[..., None, None, :]).reshape(*shape, 3, 4)
    return Scores(squared + added.min(axis=0), unlikely, difference, precision, transpose(jacobian), slopes)


def _refined(
    fits: AffineFits, rotations: FloatArray, masks: BoolArray, bound: int = 12
) -> tuple[FloatArray, FloatArray]:
    """K rotations at which the scores of the cameras in K masks (K, n) are least, by Gauss-Newton with V held, and
    their information (K, 3, 3). A turn of about one radian is expected, no more."""
    information = np.empty((0, 3, 3))
    for _ in range(bound):
        information, gradient = normal_equations(fits, rotations, masks)
        rotations, length = turned(rotations, information, gradient)
        information += np.eye(3)
        if length.max() < SETTLED:
            break
    return rotations, information


def normal_equations(fits: AffineFits, rotations: FloatArray, masks: BoolArray) -> tuple[FloatArray, FloatArray]:
    """What the cameras in K masks (K, n) say of w, R = exp(w) R, at K rotations: information (K, 3, 3), gradient (K, 3)."""
    s = score(fits, rotations)
    weighted = transpose(s.jacobian) @ s.precision * masks[..., None, None]
    return (weighted @ s.jacobian).sum(axis=1), (weighted @ s.difference[..., None]).sum(axis=1)[..., 0]


def turned(rotations: FloatArray, information: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """K rotations after a step by `normal_equations`, a turn of about one radian being expected, and how far the step wanted
    to go (K,), radians."""
    step = np.linalg.solve(np.eye(3) + information, gradient[..., None])[..., 0]
    length = np.linalg.norm(step, axis=1)
    step /= np.maximum(length / LONGEST_STEP, 1.0)[:, None]
    return Rotation.from_rotvec(step).as_matrix() @ rotations, length


def agreed_rotation(fits: AffineFits, plain: FloatArray) -> tuple[FloatArray, bool]:
    """The likeliest rotation (3, 3), at which some cameras may be at fault, and whether it is certain which ones are.

    Args:
        fits: n cameras.
        plain: (3, 3) a rotation to start from, besides the identity.
    """
    n = len(fits.camera)
    starts = np.stack([np.eye(3), plain])
    R, _ = _refined(fits, starts, np.ones((2, n), dtype=bool))
    worst = score(fits, R).squared.max(axis=1)
    if n > FEW and worst.min() <= AGREED:
        return R[np.argmin(worst)], True
    groups = _groups(n)
    R, _ = _refined(fits, np.repeat(starts, len(groups), axis=0), np.concatenate([groups, groups]))
    R = R[np.argsort(_cost(fits, score(fits, R)), kind="stable")[:KEPT]]
    for _ in range(3):
        # Those who agree with a group join it; those of it that do not, leave.
        R, _ = _refined(fits, R, score(fits, R).squared <= FAULT)
    at = score(fits, R)
    cost, inside = _cost(fits, at), at.squared <= FAULT
    best = int(np.argmin(cost))
    otherwise = inside[:, ~inside[best]].any(axis=1)  # with a camera inside that is outside of the best
    return R[best], not bool((cost[otherwise] < cost[best] + MARGIN).any())


def _cost(fits: AffineFits, scores: Scores) -> FloatArray:
    """(K,) -2 log-likelihood where each camera is either good or at fault."""
    size = np.maximum((fits.F**2).sum(axis=(1, 2)) / 2, 1.0)  # 1 for a rotation about the viewing direction
    return np.asarray(np.minimum(scores.unlikely, AT_FAULT + AT_FAULT_FALLS * np.log(size)).sum(axis=1))


def _groups(n: int) -> BoolArray:
    """(g, n) masks: all cameras, and groups of three (of n - 1 where there are no more than three)."""
    members = list(combinations(range(n), 3 if n > 3 else max(n - 1, 1)))
    if len(members) > GROUPS:
        members = [members[i] for i in np.random.default_rng(0).choice(len(members), GROUPS, replace=False)]
    masks = np.zeros((len(members) + 1, n), dtype=bool)
    masks[0] = True
    for mask, member in zip(masks[1:], members, strict=True):
        mask[list(member)] = True
    return masks


def settled(fits: AffineFits, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The rotation (3, 3) of all cameras that agree with one near R, and the scores (n,) of all at it; of those that do not
    agree, with the uncertainty of that rotation in V."""
    information = np.eye(3)
    inside = np.zeros(len(fits.camera), dtype=bool)
    for _ in range(5):
        before, inside = inside, score(fits, R[None]).squared[0] <= FAULT
        if (inside == before).all():
            break
        (R,), (information,) = _refined(fits, R[None], inside[None])
    at = score(fits, R[None])
    scores, outside = at.squared[0].copy(), ~inside
    if inside.any():
        J, difference = at.jacobian[0][outside], at.difference[0][outside]
        V = np.linalg.inv(at.precision[0][outside]) + J @ np.linalg.inv(information) @ transpose(J)
        scores[outside] = (difference * np.linalg.solve(V, difference[..., None])[..., 0]).sum(axis=1)
    return R, scores
