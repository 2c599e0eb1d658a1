"""Compiled: a term's equations without its surface, and what is believed of surfaces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.normal_equations import add_turned, eliminate, turn_rows
from sylpose.geometry.numba_linalg import kernel, leaf
from sylpose.relative_pose.match_cost import Equations
from sylpose.relative_pose.terms import SURFACE, Stack

__all__ = ["Room", "make_room", "reduce_term", "surface_prior"]

# Fitting α to noise makes the parallax, and so the motion, look larger than it is. Integrating α out of the likelihood
# instead takes that back where surfaces are as curved as is believed, and too much of it where they are flatter: this share
# of it lies between, and is hardly worse than either at its best (measured: docs/benchmarks.md#two-frames).
INTEGRATED = 0.5
# The slopes' prior is Cauchy's in two dimensions, Student's with one degree of freedom: 1 + 2 (derived).
TAIL = 3.0


class Room(NamedTuple):
    """For `reduce_term`, taken once for all terms: block, inverse (6, 6), kept (7, 8)."""

    block: FloatArray
    inverse: FloatArray
    kept: FloatArray


@kernel
def make_room() -> Room:
    """Empty."""
    return Room(np.empty((SURFACE, SURFACE)), np.empty((SURFACE, SURFACE)), np.empty((7, 8)))


@leaf
def reduce_term(
    stack: Stack,
    t: int,
    surface: FloatArray,
    place: float,
    prior: FloatArray,
    equations: Equations,
    total: FloatArray,
    right: FloatArray,
    gain: FloatArray,
    room: Room,
) -> bool:
    """Adds term t's equations, its surface eliminated, to total (7, 7) and right (7,), in world axes: of (w, d) and of how
    far away the object is, z, which moves the mean of α by (stack.place[t], 0, ...) z.

    gain (6, 8) becomes the surface's answer: α changes by gain[:, 7] - gain[:, :7] (w, d, z).
    """
    block, inverse, kept = room
    for i in range(7):
        for j in range(8):
            kept[i, j] = 0.0
    q, by_place = stack.qy[t], stack.place[t]
    turn_rows(equations.matrix[SURFACE:], q, gain)
    add_turned(equations.matrix, q, kept)
    kept[6, 6] = by_place * by_place * prior[0, 0]
    for k in range(SURFACE):
        gain[k, 6] = -by_place * prior[k, 0]
        gain[k, 7] = equations.right[6 + k]
        for j in range(SURFACE):
            off = surface[j] - stack.surface_mean[t, j] - (by_place * place if j == 0 else 0.0)
            gain[k, 7] -= prior[k, j] * off
            if k == 0:
                kept[6, 7] += by_place * prior[0, j] * off
            block[k, j] = equations.matrix[6 + k, 6 + j] + prior[k, j]
    if not eliminate(block, gain, kept):
        return False
    # What the data say of α, as a number of unknowns: trace of block^-1 (block - prior).
    unknowns = float(SURFACE)
    for c in range(SURFACE):
        # Column c of the factor's inverse, times its own products.
        for i in range(c, SURFACE):
            s = 1.0 if i == c else 0.0
            for k in range(c, i):
                s -= block[i, k] * inverse[k, c]
            inverse[i, c] = s / block[i, i]
    for i in range(SURFACE):
        for j in range(i + 1):
            s = 0.0
            for k in range(i, SURFACE):
                s += inverse[k, i] * inverse[k, j]
            unknowns -= (1.0 if i == j else 2.0) * s * prior[i, j]
    # The derivative of log det(block) / 2, from the likelihood with α integrated out.
    pull = INTEGRATED * unknowns / max(equations.squares[0], 1e-300)
    for i in range(6):
        h, j = i // 3, i % 3
        for a in range(3):
            right[i] += q[a, j] * (equations.right[3 * h + a] - pull * equations.stretch[3 * h + a])
    for i in range(7):
        right[i] += kept[i, 7]
        for j in range(7):
            total[i, j] += kept[i, j]
    return True


@leaf
def surface_prior(stack: Stack, t: int, surface: FloatArray, place: float, prior: FloatArray) -> float:
    """prior (6, 6): information about α; returns what α's departure from its mean costs, the object being at `place`.

    Slopes are heavy-tailed (a Cauchy distribution in two dimensions): a plane may be seen at a grazing angle.
    """
    steep, cost, mean, information = 0.0, 0.0, stack.surface_mean[t], stack.surface_information[t]
    moved = stack.place[t] * place
    for k in range(SURFACE):
        part, off = 0.0, surface[k] - mean[k] - (moved if k == 0 else 0.0)
        for j in range(SURFACE):
            prior[k, j] = information[k, j]
            part += prior[k, j] * (surface[j] - mean[j] - (moved if j == 0 else 0.0))
        if k == 1 or k == 2:
            steep += part * off
        else:
            cost += 0.5 * part * off
    for k in range(1, 3):
        prior[k, k] *= TAIL / (1.0 + steep)
    return float(cost + 0.5 * TAIL * np.log(1.0 + steep))
