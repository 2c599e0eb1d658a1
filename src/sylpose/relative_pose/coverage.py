"""Test of camera directions: whether the rays to the object intersect.

The rays through the middle of what each camera sees of one object nearly meet. They reveal a calibration error of 10
degrees that the motion does not. By themselves they are no evidence against a camera: if half of an object is hidden,
the rays miss each other as much (measured: docs/history/benchmarks.md#hard-pairs). The test can therefore only exonerate a
suspected camera.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sylpose.relative_pose.terms import TermData, locate_object

__all__ = ["compute_ray_miss", "is_other_camera_misaligned"]

# Increase of the squared ray distances over those without another camera, in radii of the object (measured: ibid., 0.3
# at most without a fault and with nothing hidden, median 0.9 for a camera that is off by 10 degrees).
MIN_MISS_DIFFERENCE = 0.6


def is_other_camera_misaligned(data: Sequence[TermData], suspect: TermData) -> bool:
    """Return whether the rays nearly meet without another term, but not without the suspected one."""
    without = [compute_ray_miss([term for term in data if term is not other]) for other in data]
    suspect_square = next(squares for squares, term in zip(without, data, strict=True) if term is suspect)
    return suspect_square > min(without) + MIN_MISS_DIFFERENCE


def compute_ray_miss(data: Sequence[TermData]) -> float:
    """Return the sum of squared distances of the median rays from the point nearest to all, in radii of the object."""
    center, radius = locate_object(data)
    rays = np.array([np.append(np.median(term.x, axis=0), 1.0) @ term.rotation_x for term in data])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    offsets = center - np.array([term.center_x for term in data])
    misses = offsets - np.einsum("ti,ti->t", offsets, rays)[:, None] * rays
    return float((misses**2).sum()) / radius**2
