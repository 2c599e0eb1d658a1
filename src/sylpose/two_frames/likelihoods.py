"""How likely each match is under a motion, and what a mixture of motions does not tell of one.

Source: what mixtures do not tell, Louis, Journal of the Royal Statistical Society B 44, 1982, equation 3.1.
"""

from __future__ import annotations

import numpy as np

from sylpose.numerics.arrays import BoolArray, FloatArray
from sylpose.two_frames.match_cost import Tolerance, match_equations, matched, no_equations, no_matched
from sylpose.two_frames.reweight import CUTOFF, GAIN, INDEPENDENT, Reweighted, reduce_term, surface_prior
from sylpose.two_frames.terms import SURFACE, Stack

__all__ = ["WRONG", "anywhere", "cost_of", "going", "missing"]

# A match may lie anywhere in a square of so many spreads, with this probability (choice).
ANYWHERE, WRONG = 4.0, 0.05


def going(stack: Stack, found: Reweighted) -> FloatArray:
    """(N,) densities of the matches if they have the motion, per square pixel."""
    out, every = np.zeros(len(stack.x)), np.ones(len(stack.x), dtype=bool)
    for t, (first, last) in enumerate(zip(stack.offsets, stack.offsets[1:], strict=False)):
        variance, relief = (found.sigma_px[t] / stack.focal[t]) ** 2, found.relief[t]
        m = matched(stack, t, found.candidate, Tolerance(variance, relief, relief, CUTOFF), every, noise=False)[0]
        spread = np.sqrt(1.0 + (relief * m.parallax) ** 2 / variance)
        out[first:last] = np.exp(-0.5 * np.minimum(m.distance, 1e3)) / (4.0 * np.pi * found.sigma_px[t] ** 2 * spread)
    return out


def anywhere(stack: Stack) -> FloatArray:
    """(N,) densities of the matches if they are wrong, per square pixel."""
    return np.repeat(1.0 / (ANYWHERE * stack.spread * stack.focal) ** 2, np.diff(stack.offsets))


def cost_of(stack: Stack, usable: BoolArray, density: FloatArray) -> float:
    """The negative log-likelihood of densities (N,) per square pixel, as `reweight` has it."""
    least = np.log(0.5 * anywhere(stack))
    return float(np.minimum(least - np.log(np.maximum(density, 1e-300)), 0.0)[usable].sum())


def missing(stack: Stack, found: Reweighted, moving: FloatArray) -> FloatArray:
    """(6, 6) Louis's missing information about (w, d), the surfaces following the motion as they do in the fit."""
    n_matches, total = len(stack.x), np.zeros((7, 7))
    out, right, gain, prior = np.zeros((6, 6)), np.zeros(7), np.zeros((SURFACE, 8)), np.zeros((SURFACE, SURFACE))
    matches, equations, turned = no_matched(n_matches), no_equations(False, True), np.zeros((6, 6))
    for t in range(len(stack.focal)):
        mass = found.weights[stack.offsets[t] : stack.offsets[t + 1]].sum()
        shared = found.relief[t] * np.sqrt(max(1.0, mass / INDEPENDENT))
        tolerance = Tolerance((found.sigma_px[t] / stack.focal[t]) ** 2, found.relief[t], shared, CUTOFF)
        match_equations(stack, t, moving, found.candidate, tolerance, matches, equations)
        surface_prior(stack, t, found.candidate.surface[t], found.place[0], prior)
        if not reduce_term(stack, t, found.candidate.surface[t], found.place[0], prior, equations, total, right, gain):
            continue
        # Motion and surface, (12,), per unit of motion in world axes.
        turned[:3, :3] = turned[3:, 3:] = stack.qy[t]
        ways = np.vstack([turned, -gain[:, :6]])
        out += GAIN * (ways.T @ equations.missing @ ways)
    return out
