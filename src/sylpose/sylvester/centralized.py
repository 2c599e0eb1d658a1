"""Rotation estimator for all cameras jointly, by Sylvester's equation, with a global optimality certificate.

Each camera observes y = N x + noise on centered points, with N the upper-left 2x2 block of the rotation in that
camera's frame. With P = [1 0 0; 0 1 0] and Q the camera's rotation, least squares over all cameras is a quadratic cost
on SO(3) whose stationary points solve a generalized Sylvester equation:

    Σ A_c R B_c + L R = Σ C_c,   R'R = I,   L = L' (3x3 multiplier),
    A_c = Q'P'PQ,   B_c = Q'P' S_xx P Q,   C_c = Q'P' S_yx P Q.

With row-major vec this is K r = h, K = H + L ⊗ I, H = Σ A_c ⊗ B_c, h = vec(Σ C_c). If K is positive definite, R is the
global optimum, because cost(R2) - cost(R) = 1/2 (r2 - r)' K (r2 - r) for every other rotation. Otherwise additional
multipliers certify nearly every unique optimum (`sylvester.so3_sos_certificate`).

The depth of the points is ignored, as in the paper. The estimate is unbiased only if depth is uncorrelated with the
image position. If all viewing directions lie in a plane, a rotation about its normal is not observed to first order.
The certificate concerns the cost, not the error of the rotation. The possible bias by surfaces is part of `information`
(`sylvester.depth_bias`) and of the status.

Source: C. Chen, D. Schonfeld, "Pose estimation from multiple cameras based on Sylvester's equation", Computer Vision
and Image Understanding 114 (2010); the derivation is ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sylpose.display import Printable
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.normal_equations import (
    OBSERVABLE_ROTATION_SD,
    UNOBSERVABLE_RATIO,
    UNOBSERVABLE_ROTATION_SD,
    find_unobservable_directions,
)
from sylpose.geometry.validation import check_rotations
from sylpose.moments import PairMoments
from sylpose.results import RotationEstimate
from sylpose.status import Status
from sylpose.sylvester.depth_bias import information_with_depth_bias
from sylpose.sylvester.orthographic import Views, build_costs, moment_matrices
from sylpose.sylvester.so3 import ZERO_CURVATURE, evaluate_cost, minimize_batch

# Cameras needed: each contributes the four numbers of an affine map and has three unknowns of its own (two slopes and a
# scale), so three cameras determine the three parameters of the rotation (derived).
MIN_CAMERAS = 3


def find_unobservable_rotations(information: FloatArray, rotation: FloatArray, cameras: int) -> FloatArray:
    """Return the unit directions of the rotation vector w that are not observable.

    A direction is not observable if its standard deviation exceeds half of the rotation angle and one degree (or in any
    case `UNOBSERVABLE_ROTATION_SD`), or is over a thousand times that of the best observed axis (rounding). With fewer
    than three cameras the least observable direction is always returned.

    Args:
        information: (..., 3, 3) of w, 1/rad²; if several, all have the first one's eigenvalues (mirrored solutions).
        rotation: (3, 3) the estimated rotation (the first one); NaN without any.
        cameras: number of cameras with matches.

    Returns:
        (..., k, 3) unit vectors.
    """
    angle = np.arccos(np.clip((np.trace(np.nan_to_num(rotation)) - 1) / 2, -1, 1))
    limit = min(max(UNOBSERVABLE_RATIO * float(angle), OBSERVABLE_ROTATION_SD), UNOBSERVABLE_ROTATION_SD)
    unobservable = find_unobservable_directions(information, limit, min_ratio=ZERO_CURVATURE)
    if unobservable.shape[-2] == 0 and cameras < MIN_CAMERAS:
        unobservable = np.linalg.eigh(information)[1][..., :1].swapaxes(-1, -2)
    return unobservable


def rotation_status(converged: bool, certified: bool, unobservable: FloatArray) -> Status:
    """Return the status of a rotation, for all estimators that ignore depth.

    It is the first that applies of `NOT_CONVERGED`, `ROTATION_NOT_OBSERVABLE` (`unobservable`, the (k, 3) directions of
    `find_unobservable_rotations`, is not empty), `NOT_CERTIFIED`, `OK`.
    """
    if not converged:
        return Status.NOT_CONVERGED
    if len(unobservable):
        return Status.ROTATION_NOT_OBSERVABLE
    return Status.OK if certified else Status.NOT_CERTIFIED


@dataclass(frozen=True, eq=False, repr=False)
class CentralizedSolution(RotationEstimate):
    """Least-squares rotation of all cameras, orthographic views.

    Attributes:
        status: see `rotation_status`.
        rotation: (3, 3) the first of `candidates`.
        information: (3, 3) of w, from noise and the possible bias by surfaces (`sylvester.depth_bias`).
        noise_information: (3, 3) information if depth is uncorrelated with the image: the Hessian of the cost on SO(3)
            over the residual variance (weighted mean square per coordinate; at least 1e-12 of the points' own).
        unobservable: (k, 3) directions that are not observable (`find_unobservable_rotations`).
        iterations: Newton steps on the dual and, where that gave no certificate, on SO(3) and of the certificate.
        candidates: (k, 3, 3) rotations: the global optimum if certified, else all local minima found, best first
            (for instance the mirrored pair of a single camera). Along unobservable directions they sample a continuum.
        costs: (k,) half the sum of squared residuals of each, in units in which H has the mean eigenvalue 1.
        certified: `rotation` is proved to be the unique global optimum of the cost, and its cost is below that of the
            zero matrix (`QuadraticCost.is_better_than_zero`). Surfaces may still bias it. True for a single camera only
            if its two mirrored rotations coincide.
        converged: `rotation` is a stationary point of the cost.
        multiplier: (3, 3) L of Sylvester's equation at `rotation`, in the units of `costs`.
    """

    candidates: FloatArray
    costs: FloatArray
    certified: bool
    converged: bool
    multiplier: FloatArray
    noise_information: FloatArray

    @property
    def cost(self) -> float:
        """Return the cost at `rotation`."""
        return float(self.costs[0])


@dataclass(frozen=True, eq=False, repr=False)
class CentralizedBatch(Printable):
    """Solutions of N problems in arrays: a sequence of `CentralizedSolution`.

    The attributes are those of `CentralizedSolution`. Its other fields (status, information, unobservable) are computed
    when an item is accessed, because this takes longer than the solution.

    Attributes:
        candidates: (N, k, 3, 3), NaN beyond each problem's count.
        counts: (N,) number of candidates.
        costs: (N, k), NaN beyond each problem's count.
        certified, converged: (N,).
        multiplier, noise_information: (N, 3, 3).
        iterations: (N,).
        views: arrays (N, ...) of `Views`, from which the other fields follow.
    """

    candidates: FloatArray
    counts: IntArray
    costs: FloatArray
    certified: BoolArray
    converged: BoolArray
    multiplier: FloatArray
    noise_information: FloatArray
    iterations: IntArray
    views: tuple[FloatArray, ...]

    @property
    def rotations(self) -> FloatArray:
        """(N, 3, 3) best candidate of each problem."""
        return self.candidates[:, 0]

    def __len__(self) -> int:
        return len(self.counts)

    def __iter__(self) -> Iterator[CentralizedSolution]:
        return (self[n] for n in range(len(self)))

    def __getitem__(self, n: int) -> CentralizedSolution:
        k, certified, converged = self.counts[n], bool(self.certified[n]), bool(self.converged[n])
        rotation, minima = self.candidates[n, 0], (self.candidates[n, :k], self.costs[n, :k], certified, converged)
        views = Views(*(a[n] for a in self.views))
        information = information_with_depth_bias(views, rotation)
        unobservable = find_unobservable_rotations(information, rotation, int((views.weights > 0).sum()))
        status, iterations = rotation_status(converged, certified, unobservable), int(self.iterations[n])
        at_minimum = self.multiplier[n], self.noise_information[n]
        return CentralizedSolution(status, rotation, information, unobservable, iterations, *minima, *at_minimum)


def solve_centralized(rotations: ArrayLike, moments: Sequence[PairMoments], *, aim: bool = True) -> CentralizedSolution:
    """Estimate the object's rotation between two frames from the second moments of all cameras' matches.

    Views are orthographic with one scale per camera; depth changes between the frames are not modeled. Cameras are
    weighted by the spread of their points in normalized units; a camera without matches contributes nothing. The result
    is exact for noise-free orthographic data if each camera's depths are uncorrelated with the image positions in frame
    i, three viewing directions are linearly independent and no camera's points are collinear.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments.
        aim: rotate each camera, in each frame, onto the mean ray of its matches first: perspective images are
            orthographic to first order only about that ray. False for orthographic points, whose mean is not a
            direction.

    Returns:
        The rotation with its information and certificate.

    Raises:
        ValueError: shapes do not match, matrices are not rotations, or the matches have no spread.
    """
    matrices = moment_matrices(moments)
    Q = check_rotations(rotations, len(matrices))
    return solve_centralized_batch(Q, matrices[None], aim=aim)[0]


def solve_centralized_batch(rotations: ArrayLike, moments: ArrayLike, *, aim: bool = True) -> CentralizedBatch:
    """Solve N problems of C cameras each; results are identical to the bit to `solve_centralized`.

    Args:
        rotations: (N, C, 3, 3) Q of camera_from_world, or (C, 3, 3) if all problems have the same cameras.
        moments: N lists of C `PairMoments`, or their matrices (N, C, 9, 9); zero for a camera without matches.
        aim: as in `solve_centralized`.

    Raises:
        ValueError: as `solve_centralized`, or moments are not finite or not symmetric.
    """
    q, views = build_costs(rotations, moments, aim=aim)
    minima = minimize_batch(q.H, q.h)
    best = q.evaluate(minima.candidates[:, 0])
    costs = evaluate_cost(q.H[:, None], q.h[:, None], minima.candidates) + q.constant[:, None]
    certified = minima.certified & q.is_better_than_zero(minima.candidates[:, 0])
    at_minimum = best.stationary, best.multiplier / q.scale[:, None, None], best.information
    scaled = costs / q.scale[:, None]
    return CentralizedBatch(
        minima.candidates, minima.counts, scaled, certified, *at_minimum, minima.iterations, tuple(views)
    )
