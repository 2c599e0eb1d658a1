"""Estimators with a common interface for the studies, and their error measure: the angle to the true rotation."""

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
from sylpose.sylvester.orthographic import build_cost, compute_views


class Estimate(NamedTuple):
    """Result of an estimator.

    Attributes:
        rotations: (k, 3, 3) equivalent rotations: usually one, two mirrored ones for a single camera, none without a
            result.
        certified: whether it is proved to be the global optimum; None if the estimator computes no certificate.
    """

    rotations: FloatArray
    certified: bool | None = None


Estimator = Callable[[Problem], Estimate]
NO_ROTATION = np.empty((0, 3, 3))


def angle_deg(a: FloatArray, b: FloatArray) -> float:
    """Return the angle between two rotation matrices, degrees."""
    return float(np.degrees(Rotation.from_matrix(a @ b.T).magnitude()))


def error_deg(estimate: Estimate, truth: FloatArray) -> float:
    """Return the angle between estimate and truth, degrees: the smallest of mirrored results; NaN without a result."""
    return min((angle_deg(r, truth) for r in estimate.rotations), default=np.nan)


def estimate_centralized(problem: Problem) -> Estimate:
    """Run the paper's estimator for all cameras jointly."""
    solution = solve_centralized(problem.rotations, problem.moments, aim=problem.aim)
    return Estimate(solution.rotation[None], solution.certified)


def estimate_unconstrained(problem: Problem) -> Estimate:
    """Solve least squares of all cameras for any 3x3 matrix, then project to the nearest rotation."""
    q = build_cost(compute_views(problem.rotations, problem.moments, aim=problem.aim))
    u, _, vt = np.linalg.svd(np.linalg.lstsq(q.H, q.h, rcond=1e-9)[0].reshape(3, 3))
    return Estimate((u * [1, 1, np.linalg.det(u @ vt)] @ vt)[None])


def estimate_one_camera(problem: Problem) -> Estimate:
    """Run the paper's estimator for the first camera alone: two mirrored results."""
    return _finite_rotations(solve_one_camera(problem.rotations[0], problem.moments[0], aim=problem.aim))


def estimate_other_mirror(problem: Problem) -> Estimate:
    """Return the worse of the first camera's two mirrored results, which it cannot distinguish."""
    rotations = estimate_one_camera(problem).rotations
    return Estimate(np.array(sorted(rotations, key=lambda R: angle_deg(R, problem.truth))[1:]))


def estimate_mean_of_single(problem: Problem) -> Estimate:
    """Return the mean of all single-camera results."""
    rotations = [estimate_one_camera(problem.subset([c])).rotations for c in range(len(problem.moments))]
    return Estimate(Rotation.from_matrix(np.concatenate(rotations)).mean().as_matrix()[None])


def estimate_one_unconstrained(problem: Problem) -> Estimate:
    """Solve unconstrained least squares for the first camera alone, then project: two mirrored results."""
    return _finite_rotations(solve_unconstrained(problem.rotations[0], problem.moments[0], aim=problem.aim))


def _finite_rotations(solution: OneCameraSolution) -> Estimate:
    return Estimate(solution.rotations[np.isfinite(solution.rotations).all(axis=(1, 2))])


def estimate_depth_plane(problem: Problem) -> Estimate:
    """Run the estimator with a local depth plane per camera, for all cameras jointly."""
    solution = solve_depth_plane(problem.rotations, problem.moments, aim=problem.aim)
    return Estimate(solution.rotation[None] if np.isfinite(solution.rotation).all() else NO_ROTATION)


def estimate_without_faulty(problem: Problem) -> Estimate:
    """Run the paper's estimator without the known faulty cameras."""
    return estimate_centralized(problem.subset([c for c in range(len(problem.moments)) if c not in problem.faulty]))


def estimate_robust(problem: Problem) -> Estimate:
    """Run the robust estimator, which detects the faulty cameras."""
    solution = _solve_robust(problem).solution
    return Estimate(NO_ROTATION) if solution is None else Estimate(solution.rotation[None], solution.certified)


def detected_faults(problem: Problem) -> set[int]:
    """Return the cameras that `estimate_robust` detects as faulty."""
    return {c for c, fault in enumerate(_solve_robust(problem).faults) if fault is not None}


def _solve_robust(problem: Problem) -> RobustSolution:
    return solve_robust(problem.rotations, problem.moments, aim=problem.aim)
