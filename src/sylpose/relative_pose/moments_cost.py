"""The first look: the cost of a motion from each camera's 45 numbers, one part plane, one part epipolar.

It finds the minima that `match_cost`, the last word, decides between: a step costs the same whatever the number of matches.
Where a surface is a plane without relief, the two agree to first order in the image's size.

How far along its epipolar line a feature goes depends on its depth. Of that, a plane per term is assumed, its inverse
depth ρ = α·(1, u, v) unknown beside the motion (weak prior, from where the cameras' rays meet), and a relief about
it. A feature's distance from where the plane puts it, e = y - image(R x + ρ τ), then has noise s² = 2 σ² across the
epipolar line (both images' noise) and v = s² + relief along it. With n across and b along the line,

    e' V^-1 e = (n·e)² / s² + (b·e)² / v = (1 - κ) |e|² / s² + κ (n·e)² / s²,      κ = 1 - s² / v

and (n·e)² / s² is the epipolar residual in Sampson's form, r² / σ² with r² = (y'Ex)² / (|PEx|² + |PE'y|²). κ tells how much
the relief's parallax exceeds the noise: 0 for small motions and flat objects, where the plane halves the error, and
1 for large ones, where nothing but epipolar geometry is left. Neither the identity nor a planar object is special.

Both parts are quadratic in k = y ⊗ x once their denominators are taken at the mean rays (they hardly vary over a small
object), so a term's pair moments are all that is needed. κ is measured from the residuals and held fixed within an
iteration: letting the cost trade it against them is biased towards too much motion.

Source: Sampson error, Hartley & Zisserman, "Multiple View Geometry", section 11.4.3; the generalised epipolar constraint,
Pless 2003; plane and parallax, ibid. section 13.3; the mixture and its moments are ours (docs/method.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, leaf
from sylpose.relative_pose.plane_projection import Scratch, epipolar_rows, essential, homography, line, look, scratch
from sylpose.relative_pose.terms import Candidate, Stack

__all__ = [
    "Normal",
    "Sums",
    "along_variance",
    "along_variance_at",
    "equations_at",
    "misfit_at",
    "moments_into",
    "term_cost",
    "term_equations",
    "term_misfit",
]


# Weight of the prior relief in its estimate, as a number of matches (choice).
PRIOR_MATCHES = 3.0
# What may be noise, in standard deviations of its variance, is not taken for relief (choice).
NOISE_SIGMAS = 2.0


class Sums(NamedTuple):
    """What is left of the matches of T terms.

    Attributes:
        moments: (T, 9, 9) pair moments, weighted, each with a positive count.
        variance: (T,) σ² of an image coordinate, normalised units.
    """

    moments: FloatArray
    variance: FloatArray


class Normal(NamedTuple):
    """Normal equations in (w, d, α) of each of T terms: hessian (T, 9, 9), gradient (T, 9)."""

    hessian: FloatArray
    gradient: FloatArray


@leaf
def _square(m: FloatArray, row: FloatArray) -> float:
    """row' m row, of m (9, 9) symmetric and row (9,)."""
    total = 0.0
    for i in range(9):
        s = 0.0
        for j in range(i):
            s += m[i, j] * row[j]
        total += row[i] * (2.0 * s + m[i, i] * row[i])
    return float(total)


@leaf
def _plane_image(m: FloatArray, v: FloatArray, out: FloatArray) -> None:
    """out (9,), whose product with another homography's v is the moment of their e_f in both coordinates f.

    v (9,): a homography over the depth. e_f = y_f (v_3 x) - v_f x is linear in the rows f and 3 of y x'.
    """
    for i in range(3):
        s0, s1, s2 = 0.0, 0.0, 0.0
        for j in range(3):
            xx, y0, y1 = m[6 + i, 6 + j], m[i, 6 + j], m[3 + i, 6 + j]
            s0 += xx * v[j] - y0 * v[6 + j]
            s1 += xx * v[3 + j] - y1 * v[6 + j]
            s2 += (m[i, j] + m[3 + i, 3 + j]) * v[6 + j] - y0 * v[j] - y1 * v[3 + j]
        out[i], out[3 + i], out[6 + i] = s0, s1, s2


@leaf
def _epipolar_image(m: FloatArray, v: FloatArray, out: FloatArray) -> None:
    """out (9,) = m v."""
    for i in range(9):
        s = 0.0
        for j in range(9):
            s += m[i, j] * v[j]
        out[i] = s


@leaf
def _add_squares(
    k: int, rows: FloatArray, image: FloatArray, weight: float, hessian: FloatArray, gradient: FloatArray
) -> float:
    """Adds row k's products with those before it, weighted, to the normal equations, row 0 being the residual's and the
    others its derivatives; returns the cost, of row 0."""
    for j in range(k + 1):
        # In parts, which do not wait for each other.
        s = image[0] * rows[j, 0] + image[1] * rows[j, 1] + image[2] * rows[j, 2]
        s += image[3] * rows[j, 3] + image[4] * rows[j, 4] + image[5] * rows[j, 5]
        s = weight * (s + (image[6] * rows[j, 6] + image[7] * rows[j, 7] + image[8] * rows[j, 8]))
        if k == 0:
            return float(0.5 * s)
        if j == 0:
            gradient[k - 1] += s
        else:
            hessian[k - 1, j - 1] += s
            if j != k:
                hessian[j - 1, k - 1] += s
    return 0.0


@kernel
def term_equations(
    stack: Stack,
    sums: Sums,
    t: int,
    kappa: float,
    candidate: Candidate,
    normal: Normal,
    full: bool,
) -> float:
    """One term's cost and, if `full`, its normal equations in (w, d, α).

    Args:
        candidate: with planes as surfaces.
        normal: of all terms; the term's own part is filled.

    Returns:
        half the weighted sum of squares, prior of α included.
    """
    at = scratch()
    if not full:
        return term_cost(stack, sums, t, kappa, candidate, at)
    look(stack, t, candidate, at)
    return equations_at(stack, sums, t, kappa, candidate.surface[t], at, normal)


@leaf
def term_cost(stack: Stack, sums: Sums, t: int, kappa: float, candidate: Candidate, at: Scratch) -> float:
    """One term's cost, as `term_equations` has it."""
    look(stack, t, candidate, at)
    m, variance = sums.moments[t], sums.variance[t]
    cost = _prior(stack, t, candidate.surface[t])
    row = at.rows[0]
    if kappa < 1.0:
        depth = homography(at, m[8, 6] / m[8, 8], m[8, 7] / m[8, 8])
        for i in range(3):
            for j in range(3):
                row[3 * i + j] = at.h[0, i, j] / depth
        _plane_image(m, row, at.image)
        square = 0.0
        for i in range(9):
            square += at.image[i] * row[i]
        cost += 0.25 * (1.0 - kappa) / variance * square
    if kappa > 0.0:
        cost += 0.5 * kappa / variance * misfit_at(sums, t, at)
    return cost


@leaf
def _prior(stack: Stack, t: int, surface: FloatArray) -> float:
    """What the departure of α (3,) from its mean costs."""
    cost = 0.0
    for j in range(3):
        off = (surface[j] - stack.plane_mean[t, j]) / stack.plane_sd[t, j]
        cost += 0.5 * off * off
    return cost


@leaf
def equations_at(
    stack: Stack, sums: Sums, t: int, kappa: float, surface: FloatArray, at: Scratch, normal: Normal
) -> float:
    """`term_equations` once it was looked there (`look`)."""
    m, variance = sums.moments[t], sums.variance[t]
    hessian, gradient = normal.hessian[t], normal.gradient[t]
    rc, tc, turned, plane, h, e, rows, image = at
    qy, unit, anchor, spread = stack.qy[t], stack.inverse_depth[t], stack.anchor[t], stack.spread[t]
    count = m[8, 8]
    x0, x1, y0, y1 = m[8, 6] / count, m[8, 7] / count, m[8, 2] / count, m[8, 5] / count
    depth = homography(at, x0, x1)
    essential(at)
    # Their derivatives by w, d and α.
    for k in range(3):
        q0, q1, q2 = qy[0, k], qy[1, k], qy[2, k]
        d0, d1, d2 = q1 * turned[2] - q2 * turned[1], q2 * turned[0] - q0 * turned[2], q0 * turned[1] - q1 * turned[0]
        for j in range(3):
            r0, r1, r2 = rc[0, j], rc[1, j], rc[2, j]
            u0, u1, u2 = q1 * r2 - q2 * r1, q2 * r0 - q0 * r2, q0 * r1 - q1 * r0
            e[4 + k, 0, j], e[4 + k, 1, j], e[4 + k, 2, j] = u0, u1, u2
            e[1 + k, 0, j] = tc[1] * u2 - tc[2] * u1 + d1 * r2 - d2 * r1
            e[1 + k, 1, j] = tc[2] * u0 - tc[0] * u2 + d2 * r0 - d0 * r2
            e[1 + k, 2, j] = tc[0] * u1 - tc[1] * u0 + d0 * r1 - d1 * r0
            p = plane[j]
            h[1 + k, 0, j], h[1 + k, 1, j], h[1 + k, 2, j] = u0 + d0 * p, u1 + d1 * p, u2 + d2 * p
            h[4 + k, 0, j], h[4 + k, 1, j], h[4 + k, 2, j] = q0 * p, q1 * p, q2 * p
    for i in range(3):
        slope = tc[i] * unit / spread
        h[7, i, 2] = tc[i] * unit
        h[8, i, 0] = h[9, i, 1] = slope
        h[8, i, 2], h[9, i, 2] = -slope * anchor[0], -slope * anchor[1]
    hessian[:] = 0.0
    gradient[:] = 0.0
    cost = _prior(stack, t, surface)
    if kappa < 1.0:
        for k in range(10):
            by = (h[k, 2, 0] * x0 + h[k, 2, 1] * x1 + h[k, 2, 2]) / depth if k > 0 else 0.0
            for i in range(3):
                for j in range(3):
                    rows[k, 3 * i + j] = (h[k, i, j] - by * h[0, i, j]) / depth
            _plane_image(m, rows[k], image)
            cost += _add_squares(k, rows, image, 0.5 * (1.0 - kappa) / variance, hessian, gradient)
    if kappa > 0.0 and epipolar_rows(e, 7, x0, x1, y0, y1, rows) > 0.0:
        for k in range(7):
            _epipolar_image(m, rows[k], image)
            cost += _add_squares(k, rows, image, kappa / variance, hessian, gradient)
    for j in range(3):
        sd = stack.plane_sd[t, j]
        gradient[6 + j] += (surface[j] - stack.plane_mean[t, j]) / (sd * sd)
        hessian[6 + j, 6 + j] += 1.0 / (sd * sd)
    return cost


@kernel
def along_variance(stack: Stack, sums: Sums, t: int, candidate: Candidate) -> tuple[float, float]:
    """κ, and v: the variance of the residuals along the epipolar line, normalised units."""
    at = scratch()
    look(stack, t, candidate, at)
    return along_variance_at(stack, sums, t, at)


@leaf
def along_variance_at(stack: Stack, sums: Sums, t: int, at: Scratch) -> tuple[float, float]:
    """`along_variance` once it was looked there (`look`)."""
    m, variance, rc, tc, plane, row = sums.moments[t], sums.variance[t], at.rc, at.tc, at.plane, at.rows[0]
    count = m[8, 8]
    x0, x1 = m[8, 6] / count, m[8, 7] / count
    length, b0, b1 = line(rc, tc, plane, x0, x1)
    depth = 0.0
    for j in range(3):
        h2 = rc[2, j] + tc[2] * plane[j]
        depth += h2 * (x0 if j == 0 else (x1 if j == 1 else 1.0))
        row[j], row[3 + j] = b0 * h2, b1 * h2
        row[6 + j] = -b0 * (rc[0, j] + tc[0] * plane[j]) - b1 * (rc[1, j] + tc[1] * plane[j])
    squares = max(_square(m, row), 0.0) / (depth * depth)
    believed = 2.0 * variance + (stack.plane_relief[t] * stack.inverse_depth[t] * length) ** 2
    # The plane's three unknowns have taken their share of the squares.
    free = max(count - 3.0, 0.0)
    seen = max(squares / max(free, 1.0), 2.0 * variance)
    # A mean of logarithms: what is believed of other objects' relief must not make a flat one unlikely.
    v = np.exp((free * np.log(seen) + PRIOR_MATCHES * np.log(believed)) / (free + PRIOR_MATCHES))
    # Noise alone scatters v.
    noise = 2.0 * variance * (1.0 + NOISE_SIGMAS * np.sqrt(2.0 / (count + PRIOR_MATCHES)))
    if v > noise:
        return 1.0 - 2.0 * variance / v, v
    return 0.0, 2.0 * variance


@kernel
def term_misfit(stack: Stack, sums: Sums, t: int, candidate: Candidate) -> float:
    """Σ w r²: the epipolar squares alone, normalised units."""
    at = scratch()
    look(stack, t, candidate, at)
    return misfit_at(sums, t, at)


@leaf
def misfit_at(sums: Sums, t: int, at: Scratch) -> float:
    """`term_misfit` once it was looked there (`look`)."""
    m = sums.moments[t]
    count = m[8, 8]
    essential(at)
    g = epipolar_rows(at.e, 1, m[8, 6] / count, m[8, 7] / count, m[8, 2] / count, m[8, 5] / count, at.rows)
    return max(_square(m, at.rows[0]), 0.0) if g > 0.0 else 0.0


@kernel
def moments_into(x: FloatArray, y: FloatArray, weights: FloatArray, m: FloatArray) -> None:
    """m (9, 9) becomes the pair moments of weighted matches (`PairMoments.from_matches`, without its checks)."""
    k = np.empty(9)
    m[:] = 0.0
    for i in range(x.shape[0]):
        w = weights[i]
        if w <= 0.0:
            continue
        for a in range(2):
            k[3 * a], k[3 * a + 1], k[3 * a + 2] = y[i, a] * x[i, 0], y[i, a] * x[i, 1], y[i, a]
        k[6], k[7], k[8] = x[i, 0], x[i, 1], 1.0
        for a in range(9):
            wk = w * k[a]
            for b in range(a + 1):
                m[a, b] += wk * k[b]
    for a in range(9):
        for b in range(a):
            m[b, a] = m[a, b]
