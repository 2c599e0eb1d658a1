"""Which of several alignments of the same sights is taken, and what is known of it where another explains them as well."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.rigid import rotvec
from sylpose.landmarks.alignment import Aligned

__all__ = ["chosen", "doubted"]

# Poses whose mean robust costs differ by less explain the matches alike (choice).
ALIKE = 0.01
# Poses less than this apart are the same one, in standard deviations, squared: the first is as good as any (choice).
SAME = 1.0


def chosen(found: Sequence[Aligned], rotation: FloatArray, shift: FloatArray) -> tuple[int, FloatArray]:
    """Which one explains the sights best; of different ones that explain them alike, the one nearest to a prediction.

    Args:
        found: of the same sights, from different starts.
        rotation: (3, 3) and shift: (3,), where the object is predicted to be.

    Returns:
        its index; (6,) (w, d) from it to the farthest of those alike: what is not known of it beside its own covariance.
    """
    least = min(range(len(found)), key=lambda k: found[k].vote)
    alike = [k for k, one in enumerate(found) if one.vote < found[least].vote + ALIKE and one.converged]
    # Distances by what one of them knows, the same for all: a sloppy one is not nearer for it.
    scale = found[least].information
    best = alike[0] if alike else least
    for k in alike:
        apart = _square(_off(found[best], found[k].rotation, found[k].shift), scale)
        nearer = _square(_off(found[k], rotation, shift), scale) < _square(_off(found[best], rotation, shift), scale)
        best = k if nearer and apart > SAME else best
    offs = [_off(found[best], found[k].rotation, found[k].shift) for k in alike]
    off = max(offs, key=lambda off: _square(off, scale), default=np.zeros(6))
    return best, off if _square(off, scale) > SAME else np.zeros(6)


def doubted(information: FloatArray, off: FloatArray) -> FloatArray:
    """(6, 6) information, of (w, d), less by a difference (6,) that may be: the covariance and off off', inverted."""
    told = information @ off
    return np.asarray(information - np.outer(told, told) / (1.0 + off @ told))


def _off(one: Aligned, rotation: FloatArray, shift: FloatArray) -> FloatArray:
    """(6,) (w, d) from an alignment to a pose."""
    return np.concatenate([rotvec(rotation @ one.rotation.T), shift - one.shift])


def _square(off: FloatArray, information: FloatArray) -> float:
    return float(off @ information @ off)
