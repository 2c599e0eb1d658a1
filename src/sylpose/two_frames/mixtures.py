"""More than one motion among the matches that one motion was fitted to: bodies that were taken for one.

Two bodies side by side that move nearly alike are explained by one motion and a bent surface, with residuals that are too
large by a little: nothing that a robust weight sees. But residuals across epipolar lines are noise, which neighbours do not
share, and a wrong motion is wrong for neighbours alike (`alike`).

Source: contiguity, Moran, Biometrika 37, 1950.
"""

from __future__ import annotations

import numpy as np

from sylpose.numerics.compiled import kernel
from sylpose.two_frames.reweight import Reweighted
from sylpose.two_frames.terms import Stack

__all__ = ["alike", "is_mixed"]

# Neighbours of a match in the image that its residual is compared with, and of a camera's matches so many at most (choice).
NEIGHBOURS, COMPARED = 3, 120
# Matches of less weight, which may be another's, are not compared (choice).
COUNTS = 0.3
# Cameras of fewer matches are not asked (choice).
JUDGED = 8
# Residuals are alike where their correlation exceeds nothing by so many standard deviations, of about 1.3 (measured: 150
# scenes of each of ten settings of benchmarks/nees.py, 4.2 at most), and this itself: with many matches calibrations that
# are off by a little show, too (choice).
ALIKE, ALIKE_AT_LEAST = 5.0, 0.15
# ... and what they share is more than this, pixels: less is rounding, lenses and keypoints (choice).
ALIKE_PX = 0.1


@kernel
def alike(stack: Stack, found: Reweighted) -> tuple[float, float, float]:
    """How alike the residuals of neighbours are: their correlation, that in its standard deviations, and their covariance,
    square pixels."""
    total, shared, pairs = 0.0, 0.0, 0
    index, nearest, squares = np.empty(COMPARED, np.int64), np.empty(NEIGHBOURS, np.int64), np.empty(NEIGHBOURS)
    for t in range(stack.focal.shape[0]):
        first, last = stack.offsets[t], stack.offsets[t + 1]
        n, stride = 0, 1 + (last - first) // COMPARED
        for i in range(first, last, stride):
            if found.weights[i] > COUNTS:
                index[n] = i
                n += 1
        if n < JUDGED:
            continue
        for k in range(n):
            i = index[k]
            squares[:], nearest[:] = np.inf, i
            for k2 in range(n):
                j = index[k2]
                square = (stack.x[i, 0] - stack.x[j, 0]) ** 2 + (stack.x[i, 1] - stack.x[j, 1]) ** 2
                # The same match again tells nothing.
                if square < squares[NEIGHBOURS - 1] and square > 0.0:
                    place = NEIGHBOURS - 1
                    while place > 0 and square < squares[place - 1]:
                        squares[place], nearest[place] = squares[place - 1], nearest[place - 1]
                        place -= 1
                    squares[place], nearest[place] = square, j
            for place in range(NEIGHBOURS):
                if squares[place] < np.inf:
                    both = found.across[i] * found.across[nearest[place]]
                    shared += both
                    total += both / found.sigma_px[t] ** 2
                    pairs += 1
    if pairs == 0:
        return 0.0, 0.0, 0.0
    return total / pairs, total / np.sqrt(pairs), shared / pairs


def is_mixed(correlation: float, deviations: float, covariance: float) -> bool:
    """Whether what neighbours share is more than one motion and noise explain."""
    return bool(deviations > ALIKE and correlation > ALIKE_AT_LEAST and covariance > ALIKE_PX**2)
