"""The first look and the last word, `moments_cost` and `match_cost`, are one cost where nothing tells them apart."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.match_cost import Tolerance, matched
from sylpose.relative_pose.moments_cost import Normal, term_equations
from sylpose.relative_pose.terms import Candidate, TermData, stack_terms
from tests.scenes import sums_of

# Standard deviation of the noise, as a share of the object's size.
NOISE = 1e-3
# A cutoff that no match reaches.
NO_CUTOFF = 1e6


def both(size: float, seed: int) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Hessian (9, 9) and gradient (9,) by (w, d, α), without the priors, of the first look and the last word.

    A plane without relief, `size` in the image, moves by about as much; the candidate is some noise off the truth.
    """
    rng = np.random.default_rng(seed)
    q = Rotation.random(rng=rng).as_matrix()
    x = size * rng.uniform(-1, 1, (40, 2))
    slopes = rng.uniform(-0.5, 0.5, 2)
    rotation = Rotation.from_rotvec(size * rng.uniform(-1, 1, 3)).as_matrix()
    shift = size**2 * rng.uniform(-1, 1, 3)
    points = np.column_stack([x, np.ones(40)]) / (1.0 + x @ slopes)[:, None] @ q - q[2]
    after = (points @ rotation.T + shift + q[2]) @ q.T
    sigma = NOISE * size
    y = after[:, :2] / after[:, 2:] + sigma * rng.standard_normal((40, 2))
    stack = stack_terms([TermData(0, x, y, q, -q[2], 1.0)], np.zeros(3), 2.0 * size)
    plane = np.array([1.0, *(slopes * stack.spread[0])]) + 0.1 * NOISE * rng.standard_normal(3)
    off = Rotation.from_rotvec(NOISE * rng.standard_normal(3)).as_matrix() @ rotation
    moved = shift + sigma * rng.standard_normal(3)

    normal = Normal(np.zeros((1, 9, 9)), np.zeros((1, 9)))
    term_equations(stack, sums_of(stack, sigma), 0, 0.0, Candidate(off, moved, plane[None]), normal, True)
    hessian, gradient = normal.hessian[0], normal.gradient[0]
    hessian[6:, 6:] -= np.diag(stack.plane_sd[0] ** -2)
    gradient[6:] -= (plane - stack.plane_mean[0]) / stack.plane_sd[0] ** 2

    quadric = np.array([[*plane, 0.0, 0.0, 0.0]])
    _, equations = matched(stack, 0, Candidate(off, moved, quadric), Tolerance(sigma**2, 0.0, 0.0, NO_CUTOFF))
    lower = np.tril(equations.matrix[:9, :9])
    turn = np.eye(9)
    turn[:3, :3] = turn[3:6, 3:6] = q
    full = turn.T @ (lower + np.tril(lower, -1).T) @ turn
    return (hessian, gradient), (full, -turn.T @ equations.right[:9])


def gap(size: float) -> tuple[float, float]:
    """How far the two are apart, relative to what they are: Hessians and gradients, the mean of some scenes."""
    gaps = []
    for seed in range(8):
        (first, first_slope), (last, last_slope) = both(size, seed)
        unit = 1.0 / np.sqrt(np.diag(last))
        matrices = np.linalg.norm((first - last) * np.outer(unit, unit)) / np.linalg.norm(last * np.outer(unit, unit))
        slopes = np.linalg.norm((first_slope - last_slope) * unit) / np.linalg.norm(last_slope * unit)
        gaps.append((float(matrices), float(slopes)))
    return tuple(np.mean(gaps, axis=0))


@pytest.mark.parametrize("size", [0.1, 0.02])
def test_without_curvature_and_relief_both_agree_to_first_order(size: float) -> None:
    """They differ by a sixth of the object's size in the image, and by half as much at half the size."""
    large, small = np.array(gap(size)), np.array(gap(0.5 * size))
    assert (large < 0.3 * size).all()
    assert (small < 0.6 * large).all()
    # They are not the same: the first look takes denominators at the mean rays.
    assert (large > 0.02 * size).all()
