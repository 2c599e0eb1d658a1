"""`moments_cost` and `match_cost` are the same cost to first order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.match_cost import Tolerance
from sylpose.relative_pose.moments_cost import NormalEquations, build_view_equations
from sylpose.relative_pose.terms import Candidate, TermData, stack_terms
from tests.relative_pose.match_errors import compute_match_errors
from tests.scenes import make_moment_sums, make_view

# Standard deviation of the noise, as a share of the object's size.
NOISE = 1e-3
# A cutoff that no match reaches.
NO_CUTOFF = 1e6


def build_both_equations(size: float, seed: int) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Return Hessian (9, 9) and gradient (9,) by (w, d, α), without the priors, of `moments_cost` and `match_cost`.

    A plane without residual depth, of image size `size`, moves by about as much; the candidate differs from the truth
    by noise.
    """
    rng = np.random.default_rng(seed)
    q = Rotation.random(rng=rng).as_matrix()
    x = size * rng.uniform(-1, 1, (40, 2))
    slopes = rng.uniform(-0.5, 0.5, 2)
    rotation = Rotation.from_rotvec(size * rng.uniform(-1, 1, 3)).as_matrix()
    translation = size**2 * rng.uniform(-1, 1, 3)
    points = np.column_stack([x, np.ones(40)]) / (1.0 + x @ slopes)[:, None] @ q - q[2]
    after = (points @ rotation.T + translation + q[2]) @ q.T
    sigma = NOISE * size
    y = after[:, :2] / after[:, 2:] + sigma * rng.standard_normal((40, 2))
    stack = stack_terms([TermData(0, x, y, q, -q[2], 1.0)], np.zeros(3), 2.0 * size)
    plane = np.array([1.0, *(slopes * stack.spread[0])]) + 0.1 * NOISE * rng.standard_normal(3)
    off = Rotation.from_rotvec(NOISE * rng.standard_normal(3)).as_matrix() @ rotation
    moved = translation + sigma * rng.standard_normal(3)

    normal = NormalEquations(np.zeros((1, 9, 9)), np.zeros((1, 9)))
    view = make_view(stack, 0, Candidate(off, moved, plane[None]))
    build_view_equations(stack, make_moment_sums(stack, sigma), 0, 0.0, plane, view, normal)
    hessian, gradient = normal.hessian[0], normal.gradient[0]
    hessian[6:, 6:] -= np.diag(stack.plane_sd[0] ** -2)
    gradient[6:] -= (plane - stack.plane_mean[0]) / stack.plane_sd[0] ** 2

    quadric = np.array([[*plane, 0.0, 0.0, 0.0]])
    _, equations = compute_match_errors(
        stack, 0, Candidate(off, moved, quadric), Tolerance(sigma**2, 0.0, 0.0, NO_CUTOFF)
    )
    lower = np.tril(equations.matrix[:9, :9])
    rotation_blocks = np.eye(9)
    rotation_blocks[:3, :3] = rotation_blocks[3:6, 3:6] = q
    full = rotation_blocks.T @ (lower + np.tril(lower, -1).T) @ rotation_blocks
    return (hessian, gradient), (full, -rotation_blocks.T @ equations.right[:9])


def compute_relative_gap(size: float) -> tuple[float, float]:
    """Return the relative difference of Hessians and of gradients, means over some scenes."""
    gaps = []
    for seed in range(8):
        (first, first_slope), (last, last_slope) = build_both_equations(size, seed)
        unit = 1.0 / np.sqrt(np.diag(last))
        matrices = np.linalg.norm((first - last) * np.outer(unit, unit)) / np.linalg.norm(last * np.outer(unit, unit))
        slopes = np.linalg.norm((first_slope - last_slope) * unit) / np.linalg.norm(last_slope * unit)
        gaps.append((float(matrices), float(slopes)))
    return tuple(np.mean(gaps, axis=0))


@pytest.mark.parametrize("size", [0.1, 0.02])
def test_costs_of_a_flat_object_agree_to_first_order(size: float) -> None:
    """They differ by a sixth of the object's image size, and by half as much at half the size."""
    large, small = np.array(compute_relative_gap(size)), np.array(compute_relative_gap(0.5 * size))
    assert (large < 0.3 * size).all()
    assert (small < 0.6 * large).all()
    # They are not identical: `moments_cost` takes denominators at the mean rays.
    assert (large > 0.02 * size).all()
