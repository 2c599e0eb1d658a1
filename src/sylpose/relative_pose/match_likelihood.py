"""How likely each match is under a motion, and what a mixture of motions does not tell of one.

Source: what mixtures do not tell, Louis, Journal of the Royal Statistical Society B 44, 1982, equation 3.1.
"""

from __future__ import annotations

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.numba_linalg import kernel
from sylpose.relative_pose.irls import CUTOFF, GAIN, INDEPENDENT, Reweighted
from sylpose.relative_pose.match_cost import Tolerance, distances, match_equations, no_equations, no_matched
from sylpose.relative_pose.schur import make_room, reduce_term, surface_prior
from sylpose.relative_pose.terms import SURFACE, Stack

__all__ = ["WRONG", "anywhere", "cost_of", "going", "missing"]

# A match may lie anywhere in a square of so many spreads, with this probability (choice).
ANYWHERE, WRONG = 4.0, 0.05


@kernel
def going(stack: Stack, found: Reweighted) -> FloatArray:
    """(N,) densities of the matches if they have the motion, per square pixel."""
    n_matches = len(stack.x)
    out, every, matches = np.empty(n_matches), np.ones(n_matches), no_matched(n_matches)
    for t in range(len(stack.focal)):
        variance, relief = (found.sigma_px[t] / stack.focal[t]) ** 2, found.relief[t]
        distances(stack, t, every, found.candidate, Tolerance(variance, relief, relief, CUTOFF), matches)
        at_best = 1.0 / (4.0 * np.pi * found.sigma_px[t] ** 2)
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            spread = np.sqrt(1.0 + (relief * matches.parallax[i]) ** 2 / variance)
            out[i] = at_best * np.exp(-0.5 * min(matches.distance[i], 1e3)) / spread
    return out


def anywhere(stack: Stack) -> FloatArray:
    """(N,) densities of the matches if they are wrong, per square pixel."""
    return np.repeat(1.0 / (ANYWHERE * stack.spread * stack.focal) ** 2, np.diff(stack.offsets))


@kernel
def cost_of(stack: Stack, usable: BoolArray, density: FloatArray) -> float:
    """The negative log-likelihood of densities (N,) per square pixel, as `reweight` has it."""
    cost = 0.0
    for t in range(len(stack.focal)):
        least = 0.5 / (ANYWHERE * stack.spread[t] * stack.focal[t]) ** 2
        for i in range(stack.offsets[t], stack.offsets[t + 1]):
            if usable[i] and density[i] > least:
                cost -= np.log(density[i] / least)
    return cost


def missing(stack: Stack, found: Reweighted, moving: FloatArray) -> FloatArray:
    """(6, 6) Louis's missing information about (w, d), the surfaces following the motion as they do in the fit."""
    n_matches, total = len(stack.x), np.zeros((7, 7))
    out, right, gain, prior = np.zeros((6, 6)), np.zeros(7), np.zeros((SURFACE, 8)), np.zeros((SURFACE, SURFACE))
    matches, equations, turned = no_matched(n_matches), no_equations(False, True), np.zeros((6, 6))
    room = make_room()
    for t in range(len(stack.focal)):
        mass = found.weights[stack.offsets[t] : stack.offsets[t + 1]].sum()
        shared = found.relief[t] * np.sqrt(max(1.0, mass / INDEPENDENT))
        tolerance = Tolerance((found.sigma_px[t] / stack.focal[t]) ** 2, found.relief[t], shared, CUTOFF)
        match_equations(stack, t, moving, found.candidate, tolerance, matches, equations)
        surface_prior(stack, t, found.candidate.surface[t], found.place[0], prior)
        surface = found.candidate.surface[t]
        if not reduce_term(stack, t, surface, found.place[0], prior, equations, total, right, gain, room):
            continue
        # Motion and surface, (12,), per unit of motion in world axes.
        turned[:3, :3] = turned[3:, 3:] = stack.qy[t]
        ways = np.vstack([turned, -gain[:, :6]])
        out += GAIN * (ways.T @ equations.missing @ ways)
    return out
