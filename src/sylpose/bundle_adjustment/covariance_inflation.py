"""How much further than independent noise the parts of the evidence lie apart.

Errors are alike along a landmark's track, among neighbouring landmarks and, where the calibration is off, in all that one
camera sees. Least squares takes them for independent, and so trusts their mean too much. What groups of observations ask
for, each for itself, tells how alike they are: with independent noise, the parts x_g = A^-1 s_g of the step, s_g the
gradient of group g, have sum_g E[x_g x_g'] = A^-1 - sum_g A^-1 A_g A^-1 A_g A^-1, A_g its information; of this, what
concerns one frame is compared, and the second term is taken from the frames' own blocks of A and A_g.

Source: H. White, "Maximum likelihood estimation of misspecified models", 1982 (the sandwich), for groups: K.-Y. Liang,
S. L. Zeger, "Longitudinal data analysis using generalized linear models", 1986.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from sylpose.bundle_adjustment.group_scores import scores
from sylpose.bundle_adjustment.kernels import Sightings, Views
from sylpose.bundle_adjustment.reduced_system import Solver, System
from sylpose.geometry.arrays import FloatArray

__all__ = ["bent", "excess_variance"]


# Frames that a frame's figure is the median of (choice).
AMONG = 11
# Where the calibration is estimated, too, each camera has about as many unknowns as groups, and independent noise shows as
# this share of what it is (measured: simulated tracks of benchmarks/calibration.py, 0.66 by regions, 0.69 by cameras).
FITTED = 0.67
# Fewer degrees of freedom per frame than this among the groups say nothing (choice).
LEAST_FREEDOM = 1.0


def excess_variance(
    seen: Sightings,
    views: Views,
    points: FloatArray,
    weights: FloatArray,
    pull: FloatArray,
    system: System,
    solver: Solver,
    covariance: FloatArray,
) -> FloatArray:
    """(F,) by what each frame's variance is larger than the system of equations says, at least 1.

    It is larger the further from the fixed frames: what is alike in neighbouring frames adds up on the way.

    Regions of the object, an eighth of it as seen by one camera, disagree where errors are alike along tracks and among
    neighbours; cameras disagree where the calibration is off as well. There are few cameras, so neither is a precise
    figure: their excesses are added, which is on the safe side.

    Args: seen to pull as of the system at the optimum; solver: of the system, undamped; covariance: (F, 6, 6) its frames'.
    """
    moving = system.free[seen.frame] >= 0
    if not (moving & (weights > 0)).any():
        return np.ones(len(covariance))
    landmark = np.repeat(np.arange(len(points)), np.diff(seen.start))
    octant = (points > np.median(points, axis=0)) @ np.array([1, 2, 4])
    frames = len(covariance)
    excess, fitted = np.zeros(frames), (system.shared.kind > 0) & ~system.shared.held
    shown = FITTED if fitted.any() else 1.0
    # All sights of a landmark are in one group, as they share its place: also those of a camera that was moved.
    camera = seen.viewer[landmark]
    for group in (8 * camera + octant[landmark], camera):
        names, group = np.unique(group, return_inverse=True)
        by_pose, by_shared = np.zeros((frames, len(names), 6)), np.zeros((len(names), *views.shared.shape))
        shares = np.zeros((frames, len(names), 6, 6))
        scores(seen, views, points, weights, pull, group, by_pose, by_shared, shares)
        ratio = _ratio(by_pose, by_shared, shares, system, solver, covariance, shown)
        excess += np.maximum(median_filter(ratio, AMONG, mode="nearest") - 1.0, 0.0)
    return 1.0 + excess


def _ratio(
    by_pose: FloatArray,
    by_shared: FloatArray,
    shares: FloatArray,
    system: System,
    solver: Solver,
    covariance: FloatArray,
    shown: float,
) -> FloatArray:
    """(F,) scatter of the groups' parts, relative to what is shown of independent noise; the first three as of `scores`."""
    frames, groups, _ = by_pose.shape
    right = np.ascontiguousarray(by_pose.transpose(0, 2, 1)).reshape(6 * frames, groups)
    slope = system.shared.flat.T @ by_shared.reshape(groups, -1).T
    parts = solver.answer(right, slope)[0].reshape(frames, 6, groups)
    found = np.einsum("kig,kig->k", parts, np.linalg.solve(covariance, parts))
    own = np.linalg.solve(system.frame_blocks()[:, None], shares)
    expected = 6.0 - np.einsum("kgij,kgji->k", own, own)
    ratio = np.ones(frames)
    np.divide(found, shown * expected, out=ratio, where=expected > LEAST_FREEDOM)
    return ratio


def bent(covariance: FloatArray, away: FloatArray) -> FloatArray:
    """(N, 6, 6) covariances of (w, d), and what they lack where neither w nor where the surface is are known.

    Images hold the surface where it is seen, p from the object's origin; so d has an error w x p, and where both w and p are
    in doubt that is a product of the two, which no linear covariance has in it.

    Args:
        away: (N, 3, 3) covariance of p.
    """
    cross = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(2, 0, 1)
    out = covariance.copy()
    out[:, 3:, 3:] += np.einsum("abc,def,kbe,kcf->kad", cross, cross, covariance[:, :3, :3], away, optimize=True)
    return out
