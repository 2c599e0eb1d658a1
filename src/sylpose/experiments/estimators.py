"""The estimators as the studies compare them, and the one measure of error: the angle to the true rotation."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.experiments.scenes import Problem
from sylpose.geometry.arrays import FloatArray
from sylpose.sylvester.camera_faults import RobustSolution, solve_robust
from sylpose.sylvester.centralized import solve_centralized
from sylpose.sylvester.depth_plane import solve_depth_plane
from sylpose.sylvester.one_camera import OneCameraSolution, solve_one_camera, solve_unconstrained
from sylpose.sylvester.orthographic import quadratic_of, views_of

__all__ = [
    "Answer",
    "Estimator",
    "angle_deg",
    "centralized",
    "depth_plane",
    "error_deg",
    "mean_of_single",
    "named",
    "one_camera",
    "only_good",
    "other_mirror",
    "robust",
    "unconstrained_centralized",
    "unconstrained_one_camera",
]


class Answer(NamedTuple):
    """What an estimator says.

    Attributes:
        rotations: (k, 3, 3) those between which it cannot tell: one as a rule, two mirrored ones of a single camera,
            none where it has no answer.
        certified: whether it is proved to be the global optimum; None where the estimator proves nothing.
    """

    rotations: FloatArray
    certified: bool | None = None


Estimator = Callable[[Problem], Answer]
NONE = np.empty((0, 3, 3))


def angle_deg(a: FloatArray, b: FloatArray) -> float:
    """Between two rotation matrices, degrees."""
    return float(np.degrees(Rotation.from_matrix(a @ b.T).magnitude()))


def error_deg(answer: Answer, truth: FloatArray) -> float:
    """The angle between estimate and truth; of mirrored answers the better one's; NaN without an answer."""
    return min((angle_deg(r, truth) for r in answer.rotations), default=np.nan)


def centralized(problem: Problem) -> Answer:
    """The paper's estimator, all cameras together."""
    solution = solve_centralized(problem.rotations, problem.moments, aim=problem.aim)
    return Answer(solution.rotation[None], solution.certified)


def unconstrained_centralized(problem: Problem) -> Answer:
    """Least squares for any 3x3 matrix, all cameras together, then the rotation nearest to it."""
    q = quadratic_of(views_of(problem.rotations, problem.moments, aim=problem.aim))
    u, _, vt = np.linalg.svd(np.linalg.lstsq(q.H, q.h, rcond=1e-9)[0].reshape(3, 3))
    return Answer((u * [1, 1, np.linalg.det(u @ vt)] @ vt)[None])


def one_camera(problem: Problem) -> Answer:
    """The paper's estimator for the first camera alone: two mirrored answers."""
    return _mirrored(solve_one_camera(problem.rotations[0], problem.moments[0], aim=problem.aim))


def other_mirror(problem: Problem) -> Answer:
    """What the first camera alone cannot tell from the truth: of its two answers the one that is farther from it."""
    rotations = one_camera(problem).rotations
    return Answer(np.array(sorted(rotations, key=lambda R: angle_deg(R, problem.truth))[1:]))


def mean_of_single(problem: Problem) -> Answer:
    """The mean of all answers of all cameras, each alone."""
    own = [one_camera(problem.only([c])).rotations for c in range(len(problem.moments))]
    return Answer(Rotation.from_matrix(np.concatenate(own)).mean().as_matrix()[None])


def unconstrained_one_camera(problem: Problem) -> Answer:
    """Least squares for the first camera alone, adjusted afterwards: two mirrored answers."""
    return _mirrored(solve_unconstrained(problem.rotations[0], problem.moments[0], aim=problem.aim))


def _mirrored(solution: OneCameraSolution) -> Answer:
    return Answer(solution.rotations[np.isfinite(solution.rotations).all(axis=(1, 2))])


def depth_plane(problem: Problem) -> Answer:
    """All cameras together, each with a plane for the depth of what it sees."""
    solution = solve_depth_plane(problem.rotations, problem.moments, aim=problem.aim)
    return Answer(solution.rotation[None] if np.isfinite(solution.rotation).all() else NONE)


def only_good(problem: Problem) -> Answer:
    """All cameras but those that are known to be bad."""
    return centralized(problem.only([c for c in range(len(problem.moments)) if c not in problem.bad]))


def robust(problem: Problem) -> Answer:
    """All cameras together, the bad ones to be recognised."""
    solution = _robust(problem).solution
    return Answer(NONE) if solution is None else Answer(solution.rotation[None], solution.certified)


def named(problem: Problem) -> set[int]:
    """The cameras that `robust` says are bad."""
    return {c for c, fault in enumerate(_robust(problem).faults) if fault is not None}


def _robust(problem: Problem) -> RobustSolution:
    return solve_robust(problem.rotations, problem.moments, aim=problem.aim)
