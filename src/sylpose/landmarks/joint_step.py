"""The joint part of `alignment`: one step from what all cameras say, and whom to doubt.

A function of the cameras' numbers alone, the same at every camera that has heard them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.numba_linalg import cholesky, cholesky_solve, kernel, solve_factored, turn_by

__all__ = ["MAX_ROUNDS", "Round", "first_round", "joint_step", "measures_noise"]

# Rounds in which noise and doubt follow the residuals; then they are held, and the rest converges (choice).
SETTLING_ROUNDS = 5
MAX_ROUNDS = 40
SIGMA_FLOOR_PX = 0.2
# A camera's noise counts as that of so many matches more that have the rig's (choice).
RIG_MATCHES = 10.0
# How far a camera is from the others by chance: the mean of chi-squared with six degrees of freedom (chi-squared).
DISAGREEMENT = 6.0
# From so many times that on it is something else than chance (chi-squared: once in 160 times).
FAR_OFF = 3.0
DOUBT_ROUNDS = 8
# A camera that claims to know so many times as much of the rotation as the middle one is doubted the more for that where it
# disagrees (choice: more than most rigs' cameras differ by).
HEAVIER = 10.0
# No step turns further than this, radians (choice).
MAX_TURN = 0.5
# Converged when the step is a twentieth of its own standard deviation: what is left is not worth a round (choice).
SETTLED = 0.05**2


class Round(NamedTuple):
    """Where all cameras stand (C of them); filled in place.

    Attributes:
        rotation: (3, 3) and shift: (3,), the pose.
        sigma_px: (C,) each camera's noise, and rig_px: (1,) the rig's.
        doubt: (C,) by how much the variance of what each says is larger than its matches think.
        information: (6, 6) of (w, d), all cameras'.
        step: (6,) the last, and previous: (6,) the one before, both of (w, d), before extrapolation.
    """

    rotation: FloatArray
    shift: FloatArray
    sigma_px: FloatArray
    rig_px: FloatArray
    doubt: FloatArray
    information: FloatArray
    step: FloatArray
    previous: FloatArray


def first_round(rotation: FloatArray, shift: FloatArray, doubt: FloatArray, first_px: float) -> Round:
    """The start: a pose (3, 3), (3,), the doubt (C,) there is, and the noise that is assumed, pixels."""
    return Round(
        rotation.copy(),
        shift.copy(),
        np.full(len(doubt), first_px),
        np.array([first_px]),
        doubt.copy(),
        np.zeros((6, 6)),
        np.zeros(6),
        np.zeros(6),
    )


@kernel
def disagreement(reduced: FloatArray, doubt: FloatArray, found: FloatArray) -> None:
    """found (C,): how far each camera is from what the others say, chi-squared with six degrees of freedom.

    At the others' own solution x its gradient is g + H x, by chance H + H A⁻¹ H, A being the others' information.
    """
    n = len(doubt)
    others, x, off, spread, column = np.empty((6, 6)), np.empty(6), np.empty(6), np.empty((6, 6)), np.empty(6)
    for c in range(n):
        others[:] = 0.0
        x[:] = 0.0
        for o in range(n):
            if o != c:
                for i in range(6):
                    x[i] -= reduced[o, i, 6] / doubt[o]
                    for j in range(6):
                        others[i, j] += reduced[o, i, j] / doubt[o]
        found[c] = 0.0
        for i in range(6):
            others[i, i] += 1e-6 * others[i, i] + 1e-9 * reduced[c, i, i] + 1e-300
        if not cholesky(others):
            continue
        solve_factored(others, x)
        for j in range(6):
            off[j] = reduced[c, j, 6]
            for i in range(6):
                off[j] += reduced[c, j, i] * x[i]
                column[i] = reduced[c, i, j]
            solve_factored(others, column)
            for i in range(6):
                spread[i, j] = reduced[c, i, j]
                for k in range(6):
                    spread[i, j] += reduced[c, i, k] * column[k]
            spread[j, j] += 1e-9 * spread[j, j] + 1e-300
        column[:] = off
        if cholesky_solve(spread, column):
            for i in range(6):
                found[c] += off[i] * column[i]


@kernel
def doubt_cameras(reduced: FloatArray, doubt: FloatArray) -> None:
    """doubt (C,): by how much the variance of what each camera says is larger than its matches think.

    What one says weighs less in what the others are compared with the more it is doubted, so the odd one is found.
    """
    found, turns, voices = np.empty(len(doubt)), np.empty(len(doubt)), 0
    for c in range(len(doubt)):
        if np.trace(reduced[c, :, :6]) > 0.0:
            turns[voices] = reduced[c, 0, 0] + reduced[c, 1, 1] + reduced[c, 2, 2]
            voices += 1
    sure = HEAVIER * float(np.median(turns[:voices])) if voices > 0 else 0.0
    for _ in range(DOUBT_ROUNDS):
        disagreement(reduced, doubt, found)
        for c in range(len(doubt)):
            excess = max(1.0, found[c] / DISAGREEMENT)
            if voices > 2:
                # Beyond what chance explains the pull of a camera falls with its disagreement instead of levelling off.
                # Of two, nobody can tell which one is right.
                excess *= max(1.0, excess / FAR_OFF)
                if excess > FAR_OFF and sure > 0.0:
                    excess *= max(1.0, (reduced[c, 0, 0] + reduced[c, 1, 1] + reduced[c, 2, 2]) / sure)
            doubt[c] = np.sqrt(doubt[c] * excess)


@kernel
def measures_noise(count: int, first: int) -> bool:
    """Whether the noise follows the residuals in a round; `first` is the number of rounds that assume theirs."""
    return first <= count <= first + SETTLING_ROUNDS


@kernel
def _measure_noise(at: Round, mass: FloatArray, level: FloatArray) -> None:
    """Each camera's noise, drawn towards the rig's, from what each measured (C,), NaN for nothing, and the sums of their
    weights (C,)."""
    n, known, levels = len(mass), 0, np.empty(len(mass))
    for c in range(n):
        if np.isfinite(level[c]):
            at.sigma_px[c] = max(level[c], SIGMA_FLOOR_PX)
            levels[known] = at.sigma_px[c]
            known += 1
    if known == 0:
        at.rig_px[0] = at.sigma_px[0]
        return
    rig = float(np.median(levels[:known]))
    for c in range(n):
        own = at.sigma_px[c] if mass[c] > 0.0 else rig
        at.sigma_px[c] = np.sqrt((mass[c] * own * own + RIG_MATCHES * rig * rig) / (mass[c] + RIG_MATCHES))
    at.rig_px[0] = rig


@kernel
def joint_step(
    at: Round, reduced: FloatArray, mass: FloatArray, level: FloatArray, schedule: FloatArray, count: int, last: bool
) -> tuple[bool, bool]:
    """One step of Gauss-Newton, in place.

    Args:
        reduced: (C, 6, 7) what the cameras say (`camera_terms`), mass: (C,) the sums of their weights.
        level: (C,) their noise where `measures_noise`.
        schedule: (S,) noise that the first rounds assume, pixels.
        count: of the round, from 1.
        last: whether only the information is wanted.

    Returns:
        whether a step was taken; whether it was negligible.
    """
    n, first = len(mass), len(schedule)
    settling = count <= first + SETTLING_ROUNDS
    if count == 1 and (mass > 0.0).any():
        # At first all have about the same say, however many matches they have.
        middle = float(np.median(mass[mass > 0.0]))
        for c in range(n):
            at.doubt[c] = max(at.doubt[c], mass[c] / middle)
    if settling:
        doubt_cameras(reduced, at.doubt)
    factor, right, step = np.empty((6, 6)), np.zeros(6), at.step
    at.information[:] = 0.0
    for c in range(n):
        for i in range(6):
            right[i] += reduced[c, i, 6] / at.doubt[c]
            for j in range(6):
                at.information[i, j] += reduced[c, i, j] / at.doubt[c]
    if last:
        return False, True
    if measures_noise(count, first):
        _measure_noise(at, mass, level)
    for i in range(6):
        step[i] = -right[i]
        for j in range(6):
            factor[i, j] = at.information[i, j]
        factor[i, i] += 1e-9 * at.information[i, i] + 1e-300
    if not cholesky_solve(factor, step) or not np.isfinite(step).all():
        return False, False
    size = step @ at.information @ step
    if count > first:
        # Re-weighting converges linearly; Aitken's extrapolation of its steps makes that a few rounds.
        was = float(at.previous @ at.information @ at.previous)
        ratio = float(step @ at.information @ at.previous) / max(was, 1e-300)
        at.previous[:] = step
        if not settling and count % 3 == 0:
            step /= 1.0 - min(max(ratio, -1.0), 0.85)
    step /= max(1.0, np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2) / MAX_TURN)
    turned = np.empty((3, 3))
    turn_by(step[:3], at.rotation, turned)
    at.rotation[:] = turned
    for i in range(3):
        at.shift[i] += step[3 + i]
    if count < first:
        at.sigma_px[:] = schedule[count]
    return True, not settling and float(size) < SETTLED
