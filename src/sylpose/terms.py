"""The terms of one motion problem: what each camera saw between a reference frame and the current one.

A **term** is the matches of one camera between two frames. All terms share one pair of unknowns, the motion
X_j = R (X_i - g) + g + d about the object's centre g. With a1 = (camera's centre at frame i) - g and a2 = (the same at
frame j) - g, in the world's axes, a feature of inverse depth ρ on the ray x is seen in frame j along

    y ~ R x + ρ τ,      τ = R a1 - a2 + d

A static camera has a1 = a2. When the reference is not the frame that the motion starts from, the known motion between the
two moves the camera instead, so several references are more terms of the same problem.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from sylpose.compiled import kernel
from sylpose.rig import nearest_point_to_rays

__all__ = ["Stack", "TermData", "object_place", "stack_terms"]

FloatArray = NDArray[np.float64]

# What is believed of a camera's visible surface before anything is measured, in radii of the object: it lies nearer than the
# object's centre by so much, give or take so much; its slope has a standard deviation of 45 degrees' worth; it departs
# from its plane by so much. The results hardly change when any of these is doubled (docs/method.md).
SURFACE_NEARER, SURFACE_SD = 0.4, 0.5
SLOPE_SD = 1.0
RELIEF_SD = 0.4


@dataclass(frozen=True, eq=False)
class TermData:
    """The matches of one camera between one reference frame and the current frame.

    Attributes:
        camera: index in the rig.
        x, y: (n, 2) normalised points in the reference and in the current frame.
        rotation: (3, 3) Q of camera_from_world.
        center: (3,) the camera's centre, world.
        focal: pixels per normalised unit.
        base_from_reference: moves the object from where it was in the reference frame to the frame that the motion
            starts from; None for that frame itself.
    """

    camera: int
    x: FloatArray
    y: FloatArray
    rotation: FloatArray
    center: FloatArray
    focal: float
    base_from_reference: RigidTransform | None = None

    def __len__(self) -> int:
        return len(self.x)

    def subset(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> TermData:
        """The matches that a mask or an index array picks."""
        return replace(self, x=self.x[index], y=self.y[index])

    @cached_property
    def center_x(self) -> FloatArray:
        """(3,) the camera's centre seen from the object at the motion's start."""
        if self.base_from_reference is None:
            return self.center
        return np.asarray(self.base_from_reference.apply(self.center))

    @cached_property
    def rotation_x(self) -> FloatArray:
        """(3, 3) Q of the camera that the object, at the motion's start, sees the reference frame from."""
        if self.base_from_reference is None:
            return self.rotation
        return np.asarray(self.rotation @ self.base_from_reference.rotation.as_matrix().T)


class Stack(NamedTuple):
    """All terms of one problem as arrays, for the compiled solver (T terms, N matches in all).

    Attributes:
        x, y: (N, 2) normalised points, term after term.
        offsets: (T + 1,) term t has the matches offsets[t] to offsets[t + 1].
        qx, qy: (T, 3, 3) rotation of the camera in the reference frame and now.
        a1, a2: (T, 3) its centre, relative to g.
        anchor: (T, 2) median of x: where the surface's inverse depth is anchored.
        spread: (T,) of x about it.
        inverse_depth: (T,) of g in the reference frame.
        surface_mean, surface_sd: (T, 3) prior of the surface: inverse depth at the anchor in units of g's, and its slopes,
            per spread.
        relief: (T,) prior standard deviation of the inverse depth about that plane, in units of g's.
        focal: (T,) pixels per normalised unit.
    """

    x: FloatArray
    y: FloatArray
    offsets: NDArray[np.int64]
    qx: FloatArray
    qy: FloatArray
    a1: FloatArray
    a2: FloatArray
    anchor: FloatArray
    spread: FloatArray
    inverse_depth: FloatArray
    surface_mean: FloatArray
    surface_sd: FloatArray
    relief: FloatArray
    focal: FloatArray


def stack_terms(data: Sequence[TermData], center: FloatArray, radius: float) -> Stack:
    """Stack terms, each with a match at least.

    Args:
        center: (3,) g.
        radius: of the object, length units.
    """
    x, offsets = np.concatenate([term.x for term in data]), _offsets(data)
    qx, qy = np.array([term.rotation_x for term in data]), np.array([term.rotation for term in data])
    a1, a2 = np.array([term.center_x for term in data]) - center, np.array([term.center for term in data]) - center
    anchor, spread = np.empty((len(data), 2)), np.empty(len(data))
    _medians(x, offsets, anchor, spread)
    depth = np.maximum(np.abs(np.einsum("tj,tj->t", qx[:, 2], a1)), 1e-12)
    # An object that reaches to its camera: its depth is bounded as well as can be.
    share = np.minimum(radius / depth, 1.0)
    spread = np.maximum(spread, 1e-3 * share)
    mean = np.zeros((len(data), 3))
    mean[:, 0] = 1.0 / (1.0 - SURFACE_NEARER * share)
    return Stack(
        x=x,
        y=np.concatenate([term.y for term in data]),
        offsets=offsets,
        qx=qx,
        qy=qy,
        a1=a1,
        a2=a2,
        anchor=anchor,
        spread=spread,
        inverse_depth=1.0 / depth,
        surface_mean=mean,
        surface_sd=np.column_stack([SURFACE_SD * share, SLOPE_SD * spread, SLOPE_SD * spread]),
        relief=RELIEF_SD * share,
        focal=np.array([term.focal for term in data]),
    )


def object_place(data: Sequence[TermData]) -> tuple[FloatArray, float]:
    """Where the object is and how large, from the matched points of the reference frame.

    Returns:
        center (3,), the point nearest to the rays through each camera's median point (at distance 1 with one camera);
        radius, length units: twice the median distance of points from it.
    """
    anchor, spread = np.empty((len(data), 2)), np.empty(len(data))
    _medians(np.concatenate([term.x for term in data]), _offsets(data), anchor, spread)
    turns = np.array([term.rotation_x for term in data])
    centers = np.array([term.center_x for term in data])
    rays = np.einsum("ti,tij->tj", np.column_stack([anchor, np.ones(len(data))]), turns)
    center = nearest_point_to_rays(centers, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    depths = np.abs(np.einsum("tj,tj->t", turns[:, 2], center - centers))
    radius = 2.0 * float(np.average(spread * depths, weights=[len(term) for term in data]))
    return center, max(radius, 1e-6 * float(np.mean(depths)))


def _offsets(data: Sequence[TermData]) -> NDArray[np.int64]:
    return np.cumsum([0, *(len(term) for term in data)], dtype=np.int64)


@kernel
def _medians(x: FloatArray, offsets: NDArray[np.int64], anchor: FloatArray, spread: FloatArray) -> None:
    """Each term's median point (T, 2), and the median distance (T,) of its points from it."""
    for t in range(spread.shape[0]):
        mine = x[offsets[t] : offsets[t + 1]]
        far = np.empty(len(mine))
        for a in range(2):
            far[:] = mine[:, a]
            anchor[t, a] = np.median(far)
        for i in range(len(mine)):
            far[i] = np.sqrt((mine[i, 0] - anchor[t, 0]) ** 2 + (mine[i, 1] - anchor[t, 1]) ** 2)
        spread[t] = np.median(far)
