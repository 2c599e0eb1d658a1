"""Where cameras look: a camera whose calibration is off does not see the object where the others do.

The rays through the middles of what the cameras see of one object about meet. That tells of a calibration that is off by 10
degrees when its motion does not, but by itself it accuses nobody: of an object half of which is hidden the rays miss each
other as much (measured: docs/benchmarks.md#hard-pairs). So it only speaks for a camera that is about to be accused.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sylpose.relative_pose.terms import TermData, object_place

__all__ = ["another_looks_elsewhere", "missed"]

# Rays miss each other by more than they do without another camera, squares in radii of the object (measured: ibid., 0.3 at
# most without a fault and with nothing hidden, 0.9 in the middle for a camera that is off by 10 degrees).
ELSEWHERE = 0.6


def another_looks_elsewhere(data: Sequence[TermData], accused: TermData) -> bool:
    """Whether the terms' rays about meet once another than the accused is left out, and not once that one is."""
    without = [missed([term for term in data if term is not other]) for other in data]
    mine = next(squares for squares, term in zip(without, data, strict=True) if term is accused)
    return mine > min(without) + ELSEWHERE


def missed(data: Sequence[TermData]) -> float:
    """The sum of the squares of what terms' median rays miss the point nearest to all of them by, in radii of the object."""
    center, radius = object_place(data)
    rays = np.array([np.append(np.median(term.x, axis=0), 1.0) @ term.rotation_x for term in data])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    way = center - np.array([term.center_x for term in data])
    beside = way - np.einsum("ti,ti->t", way, rays)[:, None] * rays
    return float((beside**2).sum()) / radius**2
