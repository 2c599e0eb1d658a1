"""Whether a recording's own turns tell how far away the object's surfaces are, and so how long its path is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.bundle_adjustment.kernels import DEPTH
from sylpose.bundle_adjustment.problem import SIDE_RADII, Fit, Problem, State, Summary
from sylpose.geometry.arrays import BoolArray, FloatArray

__all__ = ["noise_share", "told_by_noise"]


# Surfaces stay where they are believed to be when more than this share of what seems to tell where they are is noise
# (measured: docs/benchmarks.md, "Slides").
NOISE_SHARE = 0.3
# Turns that are so many times their own noise, in the root mean square, tell more than it does: what noise would tell is not
# computed (choice: in squares this leaves it a share of 1e-4).
PLAIN_TURNS = 100.0
# Of recordings with fewer frames, the noise of turns is drawn more than once (choice).
ENOUGH_DRAWS = 24


def told_by_noise(problem: Problem, fit: Fit, summary: Summary, tied: BoolArray) -> bool:
    """Whether where the surfaces are is told by noise; so it is where nothing tells it."""
    turns = fit.state.turns @ fit.state.turns[problem.fixed].T
    turned = float((Rotation.from_matrix(turns[tied]).magnitude() ** 2).mean())
    noise = float(np.trace(summary.covariance[tied, :3, :3], axis1=1, axis2=2).mean())
    if turned > PLAIN_TURNS**2 * noise:
        return False
    try:
        return noise_share(problem, fit, summary, tied) > NOISE_SHARE
    except np.linalg.LinAlgError:
        return True


def noise_share(problem: Problem, fit: Fit, summary: Summary, tied: BoolArray) -> float:
    """What share of all that seems to tell how far away the surfaces are, or how long the path is, comes from noise.

    Distances, and with them lengths, are told by turns. Estimated ones are never nothing, and the refinement believes
    what their noise seems to tell. So what they tell is compared with what turns that are only noise would: of the
    distances, which drift does not touch, and of a path, to which cameras that see little of the surface do not
    matter; whichever is told better. That the object may have had next to no path does not matter either: it is given
    one of its own size, along with what it had.
    """
    state, seen = fit.state, problem.sightings
    scaled = tied[seen.frame] * fit.weights / summary.sigma[seen.camera] ** 2
    rng, covariance = np.random.default_rng(0), np.where(tied[:, None, None], summary.covariance, 0.0)
    roots = np.linalg.cholesky(covariance[:, :3, :3] + 1e-18 * np.eye(3))
    right = problem.rotations[0, 0]
    aside = right * np.copysign(problem.radius, right @ (state.places[-1] - state.places[0]))
    given = replace(state, places=state.places + np.linspace(0.0, 1.0, len(roots))[:, None] * aside)
    still, draws = state.turns[problem.fixed], max(1, ENOUGH_DRAWS // len(roots))
    noise = np.zeros(2)
    for _ in range(draws):
        turn = Rotation.from_rotvec(np.einsum("nij,nj->ni", roots, rng.standard_normal((len(roots), 3))))
        turned = replace(given, turns=turn.as_matrix() @ still, motion=state.motion * np.repeat([0.0, 1.0], 3))
        noise += [_told_of_distance(problem, turned, scaled), _told_of_length(problem, turned, scaled, tied)]
    told = [_told_of_distance(problem, given, scaled), _told_of_length(problem, given, scaled, tied)]
    return float((noise / draws / told).min())


def _told_of_length(problem: Problem, state: State, scaled: FloatArray, tied: BoolArray) -> float:
    """Information about the path's length relative to itself, when nothing is believed of the surfaces."""
    nothing, moving = np.full(2, (SIDE_RADII * problem.radius) ** -2.0), problem.sightings.free >= 0
    path = np.where(tied[:, None], state.places - state.places[problem.fixed], 0.0)[moving]
    solver = problem.system(state, problem.views(state), scaled, nothing).solver()
    return float((path**2).sum()) ** 2 / solver.variance(np.hstack([np.zeros_like(path), path]))


def _told_of_distance(problem: Problem, state: State, scaled: FloatArray) -> float:
    """Information about the surfaces' relative distance, averaged over the landmarks, when nothing is believed of it."""
    held, seen, which = problem.with_depths_held(), problem.sightings, problem.shared.depths
    told = held.system(state, held.views(state), scaled).solver().told
    cross = told[np.ix_(which, ~which)]
    own = told[np.ix_(which, which)] - cross @ np.linalg.solve(
        told[np.ix_(~which, ~which)] + np.eye(int((~which).sum())), cross.T
    )
    spread = problem.shared.spread[:, DEPTH][:, which]
    used = np.add.reduceat(scaled, seen.start[:-1]) > 0
    landmarks = np.bincount(seen.viewer[used], minlength=len(problem.focals))
    # Landmarks are held to the surfaces closely, but not quite: that is taken out of the surfaces' variance.
    variance = spread @ np.linalg.pinv(own, hermitian=True) @ spread.T
    variance -= np.diag(1.0 / (np.maximum(landmarks, 1) * held.pull[0]))
    mean = landmarks / landmarks.sum() / np.linalg.norm(problem.centers - state.places[0], axis=1)
    return 1.0 / float(mean @ variance @ mean)
