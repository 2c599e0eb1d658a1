"""Which of several alignments of the same sights is taken, and what is known of it where another explains them as well."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.landmarks.alignment import Aligned
from sylpose.numerics.arrays import FloatArray

__all__ = ["chosen"]

# Poses whose mean robust costs differ by less explain the matches alike (choice).
ALIKE = 0.01


def chosen(found: Sequence[Aligned], rotation: FloatArray, shift: FloatArray) -> tuple[int, FloatArray]:
    """Which one explains the sights best; of those that explain them alike, the one nearest to a prediction.

    Args:
        found: of the same sights, from different starts.
        rotation: (3, 3) and shift: (3,), where the object is predicted to be.

    Returns:
        its index; (6, 6) what is known of it: its own information, less by what the farthest of those alike differs.
    """
    least = min(range(len(found)), key=lambda k: found[k].vote)
    alike = [k for k, one in enumerate(found) if one.vote < found[least].vote + ALIKE and one.converged]
    best = min(alike, key=lambda k: _distance(found[k], rotation, shift), default=least)
    one = found[best]
    offs = [np.zeros(6), *(_off(one, found[k].rotation, found[k].shift) for k in alike)]
    off = max(offs, key=lambda x: float(x @ one.information @ x))
    told = one.information @ off
    # The covariance and off off', inverted.
    return best, one.information - np.outer(told, told) / (1.0 + off @ told)


def _off(one: Aligned, rotation: FloatArray, shift: FloatArray) -> FloatArray:
    """(6,) (w, d) from an alignment to a pose."""
    turn = Rotation.from_matrix(rotation @ one.rotation.T).as_rotvec()
    return np.concatenate([turn, shift - one.shift])


def _distance(one: Aligned, rotation: FloatArray, shift: FloatArray) -> float:
    """Squared, by what the alignment knows."""
    off = _off(one, rotation, shift)
    return float(off @ one.information @ off)
