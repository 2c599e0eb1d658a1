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

from sylpose.numerics.arrays import FloatArray
from sylpose.numerics.compiled import kernel
from sylpose.two_frames.terms import Candidate, Stack

__all__ = ["Normal", "Sums", "along_variance", "moments_into", "term_equations", "term_misfit", "view_of"]


# Weight of the prior relief in its estimate, as a number of matches (choice).
PRIOR_MATCHES = 3.0
# What may be noise, in standard deviations of its variance, is not taken for relief (choice).
NOISE_SIGMAS = 2.0
# Sampson's denominator, in squares of the unit of length, of an epipolar geometry that is nothing but rounding (choice).
TINY = 1e-28


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


@kernel
def _cross(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@kernel
def view_of(
    stack: Stack,
    t: int,
    candidate: Candidate,
    rc: FloatArray,
    tc: FloatArray,
    turned: FloatArray,
) -> None:
    """The motion as term t's camera sees it: rc = Qy R Qx', tc = Qy τ, turned = Qy R a1."""
    rotation, shift = candidate.rotation, candidate.shift
    qx, qy, a1, a2 = stack.qx[t], stack.qy[t], stack.a1[t], stack.a2[t]
    for i in range(3):
        r0 = qy[i, 0] * rotation[0, 0] + qy[i, 1] * rotation[1, 0] + qy[i, 2] * rotation[2, 0]
        r1 = qy[i, 0] * rotation[0, 1] + qy[i, 1] * rotation[1, 1] + qy[i, 2] * rotation[2, 1]
        r2 = qy[i, 0] * rotation[0, 2] + qy[i, 1] * rotation[1, 2] + qy[i, 2] * rotation[2, 2]
        for j in range(3):
            rc[i, j] = r0 * qx[j, 0] + r1 * qx[j, 1] + r2 * qx[j, 2]
        turned[i] = r0 * a1[0] + r1 * a1[1] + r2 * a1[2]
        tc[i] = turned[i]
        for j in range(3):
            tc[i] += qy[i, j] * (shift[j] - a2[j])


@kernel
def _plane(stack: Stack, t: int, surface: FloatArray, out: FloatArray) -> None:
    """out (3,): ρ = out·(u, v, 1)."""
    unit, anchor, spread = stack.inverse_depth[t], stack.anchor[t], stack.spread[t]
    out[0] = unit * surface[1] / spread
    out[1] = unit * surface[2] / spread
    out[2] = unit * surface[0] - out[0] * anchor[0] - out[1] * anchor[1]


@kernel
def _line(rc: FloatArray, tc: FloatArray, plane: FloatArray, u: float, v: float, b: FloatArray) -> float:
    """The direction b (2,) in which depth moves the point (u, v) in the image; returns by how much, per inverse depth."""
    rho = plane[0] * u + plane[1] * v + plane[2]
    p0 = rc[0, 0] * u + rc[0, 1] * v + rc[0, 2] + rho * tc[0]
    p1 = rc[1, 0] * u + rc[1, 1] * v + rc[1, 2] + rho * tc[1]
    p2 = rc[2, 0] * u + rc[2, 1] * v + rc[2, 2] + rho * tc[2]
    b[0] = (tc[0] - p0 / p2 * tc[2]) / p2
    b[1] = (tc[1] - p1 / p2 * tc[2]) / p2
    length = np.sqrt(b[0] * b[0] + b[1] * b[1])
    if length > 0.0:
        b[0] /= length
        b[1] /= length
    else:
        b[0], b[1] = 1.0, 0.0
    return float(length)


@kernel
def _add_squares(
    m: FloatArray, v: FloatArray, n: int, size: int, weight: float, hessian: FloatArray, gradient: FloatArray
) -> float:
    """Adds weight v_k' m v_l to the normal equations, v[0] the residual's row and v[k] its derivatives; returns the cost."""
    row = np.empty(9)
    cost = 0.0
    for k in range(n):
        for i in range(size):
            s = 0.0
            for j in range(size):
                s += m[i, j] * v[k, j]
            row[i] = weight * s
        for j in range(k + 1):
            s = 0.0
            for i in range(size):
                s += row[i] * v[j, i]
            if k == 0:
                cost = 0.5 * s
            elif j == 0:
                gradient[k - 1] += s
            else:
                hessian[k - 1, j - 1] += s
                if j != k:
                    hessian[j - 1, k - 1] += s
    return cost


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
    m, variance, surface = sums.moments[t], sums.variance[t], candidate.surface[t]
    hessian, gradient = normal.hessian[t], normal.gradient[t]
    rc, tc, turned, plane = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    view_of(stack, t, candidate, rc, tc, turned)
    _plane(stack, t, surface, plane)
    qy, unit, anchor, spread = stack.qy[t], stack.inverse_depth[t], stack.anchor[t], stack.spread[t]
    count = m[8, 8]
    x0, x1, y0, y1 = m[8, 6] / count, m[8, 7] / count, m[8, 2] / count, m[8, 5] / count
    n = 10 if full else 1
    # The homography R + τ plane' and the essential matrix, then their derivatives by w, d and α.
    h, e = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    for j in range(3):
        e[0, 0, j] = tc[1] * rc[2, j] - tc[2] * rc[1, j]
        e[0, 1, j] = tc[2] * rc[0, j] - tc[0] * rc[2, j]
        e[0, 2, j] = tc[0] * rc[1, j] - tc[1] * rc[0, j]
        for i in range(3):
            h[0, i, j] = rc[i, j] + tc[i] * plane[j]
    if full:
        dt, u, v = np.empty(3), np.empty(3), np.empty(3)
        for k in range(3):
            q = qy[:, k]
            _cross(q, turned, dt)
            for j in range(3):
                _cross(q, rc[:, j], u)
                _cross(tc, u, v)
                e[4 + k, :, j] = u
                e[1 + k, :, j] = v
                _cross(dt, rc[:, j], v)
                for i in range(3):
                    e[1 + k, i, j] += v[i]
                    h[1 + k, i, j] = u[i] + dt[i] * plane[j]
                    h[4 + k, i, j] = q[i] * plane[j]
        for i in range(3):
            h[7, i, 2] = tc[i] * unit
            h[8, i, 0] = h[9, i, 1] = tc[i] * unit / spread
            h[8, i, 2] = -h[8, i, 0] * anchor[0]
            h[9, i, 2] = -h[9, i, 1] * anchor[1]
    hessian[: n - 1, : n - 1] = 0.0
    gradient[: n - 1] = 0.0
    rows = np.empty((n, 9))
    cost = 0.0
    if kappa < 1.0:
        block = np.empty((6, 6))
        depth = h[0, 2, 0] * x0 + h[0, 2, 1] * x1 + h[0, 2, 2]
        for f in range(2):
            # e_f = (y_f (h_3 x) - h_f x) / depth is linear in the rows f and 3 of y x'.
            for i in range(3):
                for j in range(3):
                    block[i, j] = m[3 * f + i, 3 * f + j]
                    block[i, 3 + j] = block[3 + j, i] = m[3 * f + i, 6 + j]
                    block[3 + i, 3 + j] = m[6 + i, 6 + j]
            for k in range(n):
                by = (h[k, 2, 0] * x0 + h[k, 2, 1] * x1 + h[k, 2, 2]) / depth if k > 0 else 0.0
                for j in range(3):
                    rows[k, j] = h[k, 2, j] / depth
                    rows[k, 3 + j] = -h[k, f, j] / depth
                if k > 0:
                    for j in range(6):
                        rows[k, j] -= by * rows[0, j]
            cost += _add_squares(block, rows, n, 6, 0.5 * (1.0 - kappa) / variance, hessian, gradient)
    if kappa > 0.0:
        g = _epipolar_rows(e, min(n, 7), x0, x1, y0, y1, rows)
        if g > 0.0:
            cost += _add_squares(m, rows, min(n, 7), 9, kappa / variance, hessian, gradient)
    for j in range(3):
        off = (surface[j] - stack.plane_mean[t, j]) / stack.plane_sd[t, j]
        cost += 0.5 * off * off
        if full:
            gradient[6 + j] += off / stack.plane_sd[t, j]
            hessian[6 + j, 6 + j] += 1.0 / stack.plane_sd[t, j] ** 2
    return cost


@kernel
def _epipolar_rows(e: FloatArray, n: int, x0: float, x1: float, y0: float, y1: float, rows: FloatArray) -> float:
    """vec(E) / √g and its derivatives as rows (n, 9); returns g, Sampson's denominator at the mean rays."""
    p0 = e[0, 0, 0] * x0 + e[0, 0, 1] * x1 + e[0, 0, 2]
    p1 = e[0, 1, 0] * x0 + e[0, 1, 1] * x1 + e[0, 1, 2]
    o0 = e[0, 0, 0] * y0 + e[0, 1, 0] * y1 + e[0, 2, 0]
    o1 = e[0, 0, 1] * y0 + e[0, 1, 1] * y1 + e[0, 2, 1]
    g = p0 * p0 + p1 * p1 + o0 * o0 + o1 * o1
    if not g > TINY:
        return 0.0
    root = np.sqrt(g)
    for k in range(n):
        by = 0.0
        if k > 0:
            d = e[k]
            by = (
                p0 * (d[0, 0] * x0 + d[0, 1] * x1 + d[0, 2])
                + p1 * (d[1, 0] * x0 + d[1, 1] * x1 + d[1, 2])
                + o0 * (d[0, 0] * y0 + d[1, 0] * y1 + d[2, 0])
                + o1 * (d[0, 1] * y0 + d[1, 1] * y1 + d[2, 1])
            ) / g
        for i in range(3):
            for j in range(3):
                rows[k, 3 * i + j] = e[k, i, j] / root
                if k > 0:
                    rows[k, 3 * i + j] -= by * rows[0, 3 * i + j]
    return float(g)


@kernel
def along_variance(
    stack: Stack,
    sums: Sums,
    t: int,
    candidate: Candidate,
) -> tuple[float, float]:
    """κ, and v: the variance of the residuals along the epipolar line, normalised units."""
    m, variance, surface = sums.moments[t], sums.variance[t], candidate.surface[t]
    rc, tc, turned, plane, b = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty(2)
    view_of(stack, t, candidate, rc, tc, turned)
    _plane(stack, t, surface, plane)
    count = m[8, 8]
    x0, x1 = m[8, 6] / count, m[8, 7] / count
    length = _line(rc, tc, plane, x0, x1, b)
    depth = 0.0
    row = np.empty(9)
    for j in range(3):
        h2 = rc[2, j] + tc[2] * plane[j]
        depth += h2 * (x0 if j == 0 else (x1 if j == 1 else 1.0))
        row[j], row[3 + j] = b[0] * h2, b[1] * h2
        row[6 + j] = -b[0] * (rc[0, j] + tc[0] * plane[j]) - b[1] * (rc[1, j] + tc[1] * plane[j])
    squares = 0.0
    for i in range(9):
        s = 0.0
        for j in range(9):
            s += m[i, j] * row[j]
        squares += s * row[i]
    squares = max(squares, 0.0) / (depth * depth)
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
def term_misfit(
    stack: Stack,
    sums: Sums,
    t: int,
    candidate: Candidate,
) -> float:
    """Σ w r²: the epipolar squares alone, normalised units."""
    m = sums.moments[t]
    rc, tc, turned = np.empty((3, 3)), np.empty(3), np.empty(3)
    view_of(stack, t, candidate, rc, tc, turned)
    e, row = np.empty((1, 3, 3)), np.empty((1, 9))
    for j in range(3):
        e[0, 0, j] = tc[1] * rc[2, j] - tc[2] * rc[1, j]
        e[0, 1, j] = tc[2] * rc[0, j] - tc[0] * rc[2, j]
        e[0, 2, j] = tc[0] * rc[1, j] - tc[1] * rc[0, j]
    count = m[8, 8]
    g = _epipolar_rows(e, 1, m[8, 6] / count, m[8, 7] / count, m[8, 2] / count, m[8, 5] / count, row)
    if not g > 0.0:
        return 0.0
    squares = 0.0
    for i in range(9):
        s = 0.0
        for j in range(9):
            s += m[i, j] * row[0, j]
        squares += s * row[0, i]
    return max(squares, 0.0)


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
