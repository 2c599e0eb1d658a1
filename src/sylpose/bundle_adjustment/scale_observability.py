"""Observability of the surfaces' depths, and so of the path's length, from the recording's rotations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.bundle_adjustment.kernels import DEPTH
from sylpose.bundle_adjustment.problem import LATERAL_SD_RADII, Fit, FitSummary, Problem, State
from sylpose.geometry.arrays import BoolArray, FloatArray

__all__ = ["estimate_noise_ratio", "is_scale_from_noise"]


# Surface depths are fixed at their prior if more than this fraction of the apparent information on them is noise
# (measured: docs/history/benchmarks.md, "Slides").
MAX_NOISE_RATIO = 0.3
# Rotations with an rms of so many times their noise dominate it, so the information from noise is not computed (choice:
# in squares this leaves it a fraction of 1e-4).
CLEAR_ROTATION_RATIO = 100.0
# Minimum number of random draws; recordings with fewer frames are drawn repeatedly (choice).
MIN_DRAWS = 24


def is_scale_from_noise(problem: Problem, fit: Fit, summary: FitSummary, connected: BoolArray) -> bool:
    """Return whether the information on the surfaces' depths is due to noise, or absent."""
    rotations = fit.state.rotations @ fit.state.rotations[problem.first_fixed_frame].T
    mean_square = float((Rotation.from_matrix(rotations[connected]).magnitude() ** 2).mean())
    noise = float(np.trace(summary.covariance[connected, :3, :3], axis1=1, axis2=2).mean())
    if mean_square > CLEAR_ROTATION_RATIO**2 * noise:
        return False
    try:
        return estimate_noise_ratio(problem, fit, summary, connected) > MAX_NOISE_RATIO
    except np.linalg.LinAlgError:
        return True


def estimate_noise_ratio(problem: Problem, fit: Fit, summary: FitSummary, connected: BoolArray) -> float:
    """Return the fraction of the apparent information on surface depths or path length that is due to noise.

    Depths and path lengths are determined by rotations. Estimated rotations are never zero, and the refinement uses the
    spurious information in their noise. So the information of the estimate is compared with that of rotations that are
    only noise. It is compared for the depths, which drift does not affect, and for the path, which cameras with little
    of the surface do not affect; the better determined one counts. The object may hardly have moved: a path as long as
    its size is added to its own.
    """
    state, observations = fit.state, problem.observations
    scaled = connected[observations.frame] * fit.weights / summary.sigma[observations.camera] ** 2
    rng, covariance = np.random.default_rng(0), np.where(connected[:, None, None], summary.covariance, 0.0)
    roots = np.linalg.cholesky(covariance[:, :3, :3] + 1e-18 * np.eye(3))
    right = problem.rotations[0, 0]
    translation = right * np.copysign(problem.radius, right @ (state.translations[-1] - state.translations[0]))
    shifted_state = replace(
        state, translations=state.translations + np.linspace(0.0, 1.0, len(roots))[:, None] * translation
    )
    fixed_rotation, draws = state.rotations[problem.first_fixed_frame], max(1, MIN_DRAWS // len(roots))
    noise = np.zeros(2)
    for _ in range(draws):
        noise_rotation = Rotation.from_rotvec(np.einsum("nij,nj->ni", roots, rng.standard_normal((len(roots), 3))))
        noisy_state = replace(
            shifted_state,
            rotations=noise_rotation.as_matrix() @ fixed_rotation,
            pose_derivatives=state.pose_derivatives * np.repeat([0.0, 1.0], 3),
        )
        noise += [
            _depth_information(problem, noisy_state, scaled),
            _scale_information(problem, noisy_state, scaled, connected),
        ]
    information = [
        _depth_information(problem, shifted_state, scaled),
        _scale_information(problem, shifted_state, scaled, connected),
    ]
    return float((noise / draws / information).min())


def _scale_information(problem: Problem, state: State, scaled: FloatArray, connected: BoolArray) -> float:
    """Return the information on the path's relative length, without a prior of the surfaces."""
    weak_prior, moving = np.full(2, (LATERAL_SD_RADII * problem.radius) ** -2.0), problem.observations.free_index >= 0
    path = np.where(connected[:, None], state.translations - state.translations[problem.first_fixed_frame], 0.0)[moving]
    solver = problem.build_system(state, problem.view_frames(state), scaled, weak_prior).factorize()
    return float((path**2).sum()) ** 2 / solver.pattern_variance(np.hstack([np.zeros_like(path), path]))


def _depth_information(problem: Problem, state: State, scaled: FloatArray) -> float:
    """Return the information on the surfaces' relative distance, averaged over the landmarks, without a prior of it."""
    fixed_problem, observations, is_depth = (
        problem.fix_depths(),
        problem.observations,
        problem.camera_parameters.depth_mask,
    )
    information = fixed_problem.build_system(state, fixed_problem.view_frames(state), scaled).factorize().information
    cross = information[np.ix_(is_depth, ~is_depth)]
    own = information[np.ix_(is_depth, is_depth)] - cross @ np.linalg.solve(
        information[np.ix_(~is_depth, ~is_depth)] + np.eye(int((~is_depth).sum())), cross.T
    )
    spread = problem.camera_parameters.basis[:, DEPTH][:, is_depth]
    used = np.add.reduceat(scaled, observations.start[:-1]) > 0
    landmarks = np.bincount(observations.first_viewer[used], minlength=len(problem.focals))
    # The landmarks' distance from the surfaces has a small variance, which is removed from that of the surfaces.
    variance = spread @ np.linalg.pinv(own, hermitian=True) @ spread.T
    variance -= np.diag(1.0 / (np.maximum(landmarks, 1) * fixed_problem.landmark_prior[0]))
    mean = landmarks / landmarks.sum() / np.linalg.norm(problem.centers - state.translations[0], axis=1)
    return 1.0 / float(mean @ variance @ mean)
