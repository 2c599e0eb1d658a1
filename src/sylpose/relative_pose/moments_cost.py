"""Cost of a motion from 45 second moments per camera: a planar part and an epipolar part.

The search uses it to find the minima that `match_cost` then refines: a step costs the same whatever the number of
matches. If the surface is a plane without residual depth, both costs agree to first order in the image size.

The position of a feature along its epipolar line depends on its depth. The depth model is a plane per term, with
inverse depth ρ = α·(1, u, v) unknown in addition to the motion (weak prior, from the intersection of the cameras'
rays), and a residual depth. A feature's distance from its prediction, e = y - image(R x + ρ τ), then has the noise
s² = 2 σ² across the epipolar line (both images' noise) and v = s² + residual depth along it. With n across and b
along the line,

    e' V^-1 e = (n·e)² / s² + (b·e)² / v = (1 - κ) |e|² / s² + κ (n·e)² / s²,      κ = 1 - s² / v

and (n·e)² / s² is the epipolar residual in Sampson's form, r² / σ² with r² = (y'Ex)² / (|PEx|² + |PE'y|²). κ measures
how far the parallax of the residual depth exceeds the noise. It is 0 for small motions and flat objects, where the
plane halves the error, and 1 for large motions, where only epipolar geometry is left. Neither the identity nor a planar
object is special.

Both parts are quadratic in k = y ⊗ x once their denominators are evaluated at the mean rays (they hardly vary over a
small object), so a term's pair moments are sufficient. κ is estimated from the residuals and fixed within an iteration:
minimizing over it would bias the motion towards large values.

Source: Sampson error, Hartley & Zisserman, "Multiple View Geometry", section 11.4.3; the generalized epipolar
constraint, Pless 2003; plane and parallax, ibid. section 13.3; the mixture and its moments are ours
(docs/method/3-pose.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import kernel, leaf
from sylpose.relative_pose.terms import COINCIDENCE_TOLERANCE, Candidate, Stack, transform_to_camera

# Weight of the prior in the estimate of the residual depth, as a number of matches (choice).
PRIOR_MATCHES = 3.0
# An excess below this many standard deviations of the noise variance is not residual depth (choice).
NOISE_SIGMAS = 2.0


class MomentSums(NamedTuple):
    """Second moments of the matches of T terms.

    Attributes:
        moments: (T, 9, 9) pair moments, weighted, each with a positive count.
        variance: (T,) σ² of an image coordinate, normalized units.
    """

    moments: FloatArray
    variance: FloatArray


class NormalEquations(NamedTuple):
    """Normal equations in (w, d, α) of each of T terms: hessian (T, 9, 9), gradient (T, 9)."""

    hessian: FloatArray
    gradient: FloatArray


class TermView(NamedTuple):
    """View of one term's camera: work arrays that are allocated once for all steps of a search.

    Attributes:
        rc, tc, rotated_center: the motion in the camera's axes (`transform_to_camera`).
        plane: (3,) the inverse depth is plane·(u, v, 1).
        h, e: (10, 3, 3), (7, 3, 3) the homography and the essential matrix, followed by their derivatives.
        rows, image: (10, 9), (9,).
    """

    rc: FloatArray
    tc: FloatArray
    rotated_center: FloatArray
    plane: FloatArray
    h: FloatArray
    e: FloatArray
    rows: FloatArray
    image: FloatArray


@kernel
def make_term_view() -> TermView:
    """Allocate a view."""
    rc, tc, rotated_center, plane = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    h, e, rows, image = np.zeros((10, 3, 3)), np.zeros((7, 3, 3)), np.empty((10, 9)), np.empty(9)
    return TermView(rc, tc, rotated_center, plane, h, e, rows, image)


@leaf
def update_view(stack: Stack, t: int, candidate: Candidate, view: TermView) -> None:
    """Set the view of term t's camera, motion and plane, for functions of a `TermView`."""
    transform_to_camera(stack, t, candidate, view.rc, view.tc, view.rotated_center)
    unit, anchor, spread, plane = stack.inverse_depth[t], stack.anchor[t], stack.spread[t], view.plane
    plane[0] = unit * candidate.depth_model[t, 1] / spread
    plane[1] = unit * candidate.depth_model[t, 2] / spread
    plane[2] = unit * candidate.depth_model[t, 0] - plane[0] * anchor[0] - plane[1] * anchor[1]


@leaf
def compute_homography(view: TermView, x0: float, x1: float) -> float:
    """Compute the homography R + τ plane'; return the depth of (x0, x1)."""
    for i in range(3):
        for j in range(3):
            view.h[0, i, j] = view.rc[i, j] + view.tc[i] * view.plane[j]
    return float(view.h[0, 2, 0] * x0 + view.h[0, 2, 1] * x1 + view.h[0, 2, 2])


@leaf
def compute_essential(view: TermView) -> None:
    """Compute the essential matrix."""
    rc, tc, e = view.rc, view.tc, view.e
    for j in range(3):
        e[0, 0, j] = tc[1] * rc[2, j] - tc[2] * rc[1, j]
        e[0, 1, j] = tc[2] * rc[0, j] - tc[0] * rc[2, j]
        e[0, 2, j] = tc[0] * rc[1, j] - tc[1] * rc[0, j]


@leaf
def build_epipolar_rows(e: FloatArray, n: int, x0: float, x1: float, y0: float, y1: float, rows: FloatArray) -> float:
    """Compute vec(E) / √g and its derivatives as rows (n, 9); return g, Sampson's denominator at the mean rays."""
    p0 = e[0, 0, 0] * x0 + e[0, 0, 1] * x1 + e[0, 0, 2]
    p1 = e[0, 1, 0] * x0 + e[0, 1, 1] * x1 + e[0, 1, 2]
    o0 = e[0, 0, 0] * y0 + e[0, 1, 0] * y1 + e[0, 2, 0]
    o1 = e[0, 0, 1] * y0 + e[0, 1, 1] * y1 + e[0, 2, 1]
    g = p0 * p0 + p1 * p1 + o0 * o0 + o1 * o1
    if not g > COINCIDENCE_TOLERANCE**2:  # without a baseline it is rounding
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


@leaf
def _quadratic_form(m: FloatArray, row: FloatArray) -> float:
    """Return row' m row for m (9, 9) symmetric and row (9,)."""
    total = 0.0
    for i in range(9):
        s = 0.0
        for j in range(i):
            s += m[i, j] * row[j]
        total += row[i] * (2.0 * s + m[i, i] * row[i])
    return float(total)


@leaf
def _apply_plane_moments(m: FloatArray, v: FloatArray, out: FloatArray) -> None:
    """Set out (9,) so that its product with another homography's v is the moment of e_f over both coordinates f.

    v (9,): a homography divided by the depth. e_f = y_f (v_3 x) - v_f x is linear in the rows f and 3 of y x'.
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
def _add_products(
    k: int, rows: FloatArray, image: FloatArray, weight: float, hessian: FloatArray, gradient: FloatArray
) -> float:
    """Add the weighted products of row k with rows 0 to k to the normal equations.

    Row 0 is the residual, the others are its derivatives. Return the cost for row 0.
    """
    for j in range(k + 1):
        # Independent partial sums shorten the dependency chain.
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


@leaf
def evaluate_term(stack: Stack, sums: MomentSums, t: int, kappa: float, candidate: Candidate, view: TermView) -> float:
    """Set the view and return one term's cost, as `build_view_equations` does."""
    update_view(stack, t, candidate, view)
    m, variance = sums.moments[t], sums.variance[t]
    cost = _compute_prior_cost(stack, t, candidate.depth_model[t])
    row = view.rows[0]
    if kappa < 1.0:
        depth = compute_homography(view, m[8, 6] / m[8, 8], m[8, 7] / m[8, 8])
        for i in range(3):
            for j in range(3):
                row[3 * i + j] = view.h[0, i, j] / depth
        _apply_plane_moments(m, row, view.image)
        square = 0.0
        for i in range(9):
            square += view.image[i] * row[i]
        cost += 0.25 * (1.0 - kappa) / variance * square
    if kappa > 0.0:
        cost += 0.5 * kappa / variance * compute_view_misfit(sums, t, view)
    return cost


@leaf
def _compute_prior_cost(stack: Stack, t: int, depth_model: FloatArray) -> float:
    """Return the prior cost of α (3,)."""
    cost = 0.0
    for j in range(3):
        deviation = (depth_model[j] - stack.plane_mean[t, j]) / stack.plane_sd[t, j]
        cost += 0.5 * deviation * deviation
    return cost


@leaf
def build_view_equations(
    stack: Stack, sums: MomentSums, t: int, kappa: float, alpha: FloatArray, view: TermView, out: NormalEquations
) -> float:
    """Fill term t's normal equations in (w, d, α) for a view set by `update_view`.

    Args:
        alpha: (3,) α, planar.
        out: of all terms; the part of term t is filled.

    Returns:
        the cost: half the weighted sum of squares, prior of α included.
    """
    m, variance = sums.moments[t], sums.variance[t]
    hessian, gradient = out.hessian[t], out.gradient[t]
    rc, tc, rotated_center, plane, h, e, rows, image = view
    qy, unit, anchor, spread = stack.qy[t], stack.inverse_depth[t], stack.anchor[t], stack.spread[t]
    count = m[8, 8]
    x0, x1, y0, y1 = m[8, 6] / count, m[8, 7] / count, m[8, 2] / count, m[8, 5] / count
    depth = compute_homography(view, x0, x1)
    compute_essential(view)
    # Derivatives with respect to w, d and α.
    for k in range(3):
        q0, q1, q2 = qy[0, k], qy[1, k], qy[2, k]
        d0 = q1 * rotated_center[2] - q2 * rotated_center[1]
        d1 = q2 * rotated_center[0] - q0 * rotated_center[2]
        d2 = q0 * rotated_center[1] - q1 * rotated_center[0]
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
    hessian[:], gradient[:], cost = 0.0, 0.0, _compute_prior_cost(stack, t, alpha)
    if kappa < 1.0:
        for k in range(10):
            depth_ratio = (h[k, 2, 0] * x0 + h[k, 2, 1] * x1 + h[k, 2, 2]) / depth if k > 0 else 0.0
            for i in range(3):
                for j in range(3):
                    rows[k, 3 * i + j] = (h[k, i, j] - depth_ratio * h[0, i, j]) / depth
            _apply_plane_moments(m, rows[k], image)
            cost += _add_products(k, rows, image, 0.5 * (1.0 - kappa) / variance, hessian, gradient)
    if kappa > 0.0 and build_epipolar_rows(e, 7, x0, x1, y0, y1, rows) > 0.0:
        for k in range(7):
            for i in range(9):
                s = 0.0
                for j in range(9):
                    s += m[i, j] * rows[k, j]
                image[i] = s
            cost += _add_products(k, rows, image, kappa / variance, hessian, gradient)
    for j in range(3):
        sd = stack.plane_sd[t, j]
        gradient[6 + j] += (alpha[j] - stack.plane_mean[t, j]) / (sd * sd)
        hessian[6 + j, 6 + j] += 1.0 / (sd * sd)
    return cost


@leaf
def estimate_view_variance(stack: Stack, sums: MomentSums, t: int, view: TermView) -> tuple[float, float]:
    """Return κ, and v: the variance along the epipolar line, normalized units, for a view set by `update_view`."""
    m, variance, rc, tc, plane, row = sums.moments[t], sums.variance[t], view.rc, view.tc, view.plane, view.rows[0]
    count = m[8, 8]
    x0, x1 = m[8, 6] / count, m[8, 7] / count
    # The image displacement of the mean per unit of inverse depth: its length and direction.
    rho = plane[0] * x0 + plane[1] * x1 + plane[2]
    p0 = rc[0, 0] * x0 + rc[0, 1] * x1 + rc[0, 2] + rho * tc[0]
    p1 = rc[1, 0] * x0 + rc[1, 1] * x1 + rc[1, 2] + rho * tc[1]
    p2 = rc[2, 0] * x0 + rc[2, 1] * x1 + rc[2, 2] + rho * tc[2]
    b0, b1 = (tc[0] - p0 / p2 * tc[2]) / p2, (tc[1] - p1 / p2 * tc[2]) / p2
    length, depth = np.sqrt(b0 * b0 + b1 * b1), 0.0
    if length > 0.0:
        b0, b1 = b0 / length, b1 / length
    else:
        length, b0, b1 = 0.0, 1.0, 0.0
    for j in range(3):
        h2 = rc[2, j] + tc[2] * plane[j]
        depth += h2 * (x0 if j == 0 else (x1 if j == 1 else 1.0))
        row[j], row[3 + j] = b0 * h2, b1 * h2
        row[6 + j] = -b0 * (rc[0, j] + tc[0] * plane[j]) - b1 * (rc[1, j] + tc[1] * plane[j])
    squares = max(_quadratic_form(m, row), 0.0) / (depth * depth)
    prior_variance = 2.0 * variance + (stack.plane_residual_depth[t] * stack.inverse_depth[t] * length) ** 2
    # The plane's three unknowns absorb a share of the squares.
    freedom = max(count - 3.0, 0.0)
    measured_variance = max(squares / max(freedom, 1.0), 2.0 * variance)
    # Average logarithms: the prior residual depth of other objects must not make a flat one unlikely.
    logarithms = freedom * np.log(measured_variance) + PRIOR_MATCHES * np.log(prior_variance)
    v = np.exp(logarithms / (freedom + PRIOR_MATCHES))
    # Noise alone makes v vary.
    noise = 2.0 * variance * (1.0 + NOISE_SIGMAS * np.sqrt(2.0 / (count + PRIOR_MATCHES)))
    if v > noise:
        return 1.0 - 2.0 * variance / v, v
    return 0.0, 2.0 * variance


@leaf
def compute_view_misfit(sums: MomentSums, t: int, view: TermView) -> float:
    """Return Σ w r²: the epipolar squares alone, normalized units, for a view set by `update_view`."""
    m = sums.moments[t]
    count = m[8, 8]
    compute_essential(view)
    g = build_epipolar_rows(view.e, 1, m[8, 6] / count, m[8, 7] / count, m[8, 2] / count, m[8, 5] / count, view.rows)
    return max(_quadratic_form(m, view.rows[0]), 0.0) if g > 0.0 else 0.0


@kernel
def compute_moments(x: FloatArray, y: FloatArray, weights: FloatArray, m: FloatArray) -> None:
    """Compute the pair moments m (9, 9) of weighted matches (`PairMoments.from_matches`, without its checks)."""
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
