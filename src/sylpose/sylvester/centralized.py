"""The rotation of an object from Sylvester's equation, all cameras together, with a certificate.

Each camera sees y = N x + noise on centred points, N the upper-left 2x2 block of the rotation as that camera sees it.
With P = [1 0 0; 0 1 0] and Q the camera's rotation, the least squares over all cameras is a quadratic cost on SO(3)
whose stationary points solve a generalised Sylvester's equation:

    Σ A_c R B_c + L R = Σ C_c,   R'R = I,   L = L' (3x3 multiplier),
    A_c = Q'P'PQ,   B_c = Q'P' S_xx P Q,   C_c = Q'P' S_yx P Q.

With row-major vec it is K r = h, K = H + L ⊗ I, H = Σ A_c ⊗ B_c, h = vec(Σ C_c). If K is positive definite, R is the
global optimum, because cost(R2) - cost(R) = 1/2 (r2 - r)' K (r2 - r) for every other rotation. Where it is not, more
multipliers prove nearly all that is the only one (`sylvester.so3_sos_certificate`).

The depth of the points is ignored, as in the paper: unbiased only where depth is uncorrelated with the image position,
and blind to the first order of a turn about the normal of the plane that all viewing directions lie in. The certificate is
of the cost: it does not say that the rotation is right. What surfaces may have done to it is in `information`
(`sylvester.depth_bias`), and in the status.

Source: C. Chen, D. Schonfeld, "Pose estimation from multiple cameras based on Sylvester's equation", Computer Vision
and Image Understanding 114 (2010); the derivation is ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sylpose.display import Telling, Told, proof_told
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.matrices import checked_rotations
from sylpose.geometry.observability import LEAST_TURN, UNSEEN_SHARE, UNSEEN_TURN, unseen_directions
from sylpose.moments import PairMoments
from sylpose.results import RotationEstimate, Status
from sylpose.sylvester.depth_bias import information_on_surfaces
from sylpose.sylvester.orthographic import Views, matrices_of, quadratics_of
from sylpose.sylvester.so3 import FLAT, cost_of, minimize_batch

__all__ = [
    "CentralizedBatch",
    "CentralizedSolution",
    "solve_centralized",
    "solve_centralized_batch",
    "status_of",
    "unseen_turns",
]


# Of so many cameras: each has four numbers to tell, of an affine map, and two slopes and a scale of its own that are not
# known; the turn's three are left over from three on (derived).
DETERMINED = 3


def unseen_turns(information: FloatArray, rotation: FloatArray, cameras: int) -> FloatArray:
    """The unit directions (..., k, 3) of w that are not seen: the standard deviation exceeds half of the turn (and a degree,
    and in any case `UNSEEN_TURN`), or is more than a thousand times that about the best seen axis: rounding. Of fewer than
    three cameras at least the one that is seen least.

    Args:
        information: (..., 3, 3) of w, 1/rad²; of several, all with the first one's eigenvalues (mirrored solutions).
        rotation: (3, 3) the turn that was found, the first one's; NaN without any.
        cameras: how many have matches.
    """
    turn = np.arccos(np.clip((np.trace(np.nan_to_num(rotation)) - 1) / 2, -1, 1))
    limit = min(max(UNSEEN_SHARE * float(turn), LEAST_TURN), UNSEEN_TURN)
    unseen = unseen_directions(information, limit, flat=FLAT)
    if unseen.shape[-2] == 0 and cameras < DETERMINED:
        unseen = np.linalg.eigh(information)[1][..., :1].swapaxes(-1, -2)
    return unseen


def status_of(converged: bool, certified: bool, unseen: FloatArray) -> Status:
    """What a rotation is worth, the same for all estimators that ignore depth: the first of NOT_CONVERGED,
    TURN_NOT_OBSERVABLE where there are `unseen_turns` (k, 3), NOT_CERTIFIED, OK that holds."""
    if not converged:
        return Status.NOT_CONVERGED
    if len(unseen):
        return Status.TURN_NOT_OBSERVABLE
    return Status.OK if certified else Status.NOT_CERTIFIED


@dataclass(frozen=True, eq=False, repr=False)
class CentralizedSolution(RotationEstimate):
    """The rotation that all cameras agree on best, orthographic views.

    Attributes:
        status: see `status_of`.
        rotation: (3, 3) the first of `candidates`.
        information: (3, 3) of noise and of what surfaces may have done (`sylvester.depth_bias`).
        noise_information: (3, 3) what it would be if depth were known to be uncorrelated with the image: the Hessian of the
            cost on SO(3) over the residuals' variance (weighted mean square per coordinate; at least 1e-12 of the points'
            own).
        unseen: (k, 3) `unseen_turns`.
        iterations: Newton steps, on the dual and, where that gave no certificate, on SO(3) and of the proof.
        candidates: (k, 3, 3) rotations: the global optimum when proved, else all local minima found, best first
            (a single camera's mirrored pair, for instance). Where a direction is not observable they sample a continuum.
        costs: (k,) half the sum of squared residuals of each, in units in which H has the mean eigenvalue 1.
        certified: `rotation` is proved to be the one global optimum of the cost, however far surfaces have taken that from
            the truth, and leaves less than none at all would (`Quadratic.explained`). Of a single camera only where its two
            mirrored turns are one.
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
        """The cost at `rotation`."""
        return float(self.costs[0])

    def _told_besides(self) -> list[tuple[str, str]]:
        return [proof_told(self.certified, len(self.candidates))]


@dataclass(frozen=True, eq=False, repr=False)
class CentralizedBatch(Told):
    """N problems' solutions in arrays: a sequence of `CentralizedSolution`, whose attributes these are. What else these have
    (status, information, unseen) is found when one of them is asked for: it takes longer than the solution.

    Attributes:
        candidates: (N, k, 3, 3), NaN from each problem's count on.
        counts: (N,) of candidates.
        costs: (N, k), NaN likewise.
        certified, converged: (N,).
        multiplier, noise_information: (N, 3, 3).
        iterations: (N,).
        views: arrays (N, ...): of each camera's views, which the rest follows from.
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
        """(N, 3, 3) the best of each."""
        return self.candidates[:, 0]

    def _told(self) -> Telling:
        return Telling(f"{len(self)} problems, {int(self.certified.sum())} of them with the global optimum proved")

    def __len__(self) -> int:
        return len(self.counts)

    def __iter__(self) -> Iterator[CentralizedSolution]:
        return (self[n] for n in range(len(self)))

    def __getitem__(self, n: int) -> CentralizedSolution:
        k, certified, converged = self.counts[n], bool(self.certified[n]), bool(self.converged[n])
        rotation = self.candidates[n, 0]
        views = Views(*(a[n] for a in self.views))
        information = information_on_surfaces(views, rotation)
        unseen = unseen_turns(information, rotation, int((views.weights > 0).sum()))
        return CentralizedSolution(
            status=status_of(converged, certified, unseen),
            rotation=rotation,
            information=information,
            unseen=unseen,
            iterations=int(self.iterations[n]),
            candidates=self.candidates[n, :k],
            costs=self.costs[n, :k],
            certified=certified,
            converged=converged,
            multiplier=self.multiplier[n],
            noise_information=self.noise_information[n],
        )


def solve_centralized(rotations: ArrayLike, moments: Sequence[PairMoments], *, aim: bool = True) -> CentralizedSolution:
    """The object's rotation between two frames from the second moments of all cameras' matches.

    Views are orthographic, of one scale per camera: depth that changes between the frames is not modelled. Cameras
    weigh by the spread of their points in normalised units; a camera without matches adds nothing. Exact for noise-free
    orthographic data in which every camera's points have depths uncorrelated with their images in frame i, if three
    viewing directions are linearly independent and each camera's points are not collinear.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments.
        aim: turn each camera, in each frame, onto the mean ray of its matches first: perspective images are orthographic
            to first order only about that ray. False for points that are orthographic, whose mean is no direction.

    Raises:
        ValueError: shapes that do not fit, matrices that are no rotations, matches without any spread.
    """
    matrices = matrices_of(moments)
    Q = checked_rotations(rotations, len(matrices))
    return solve_centralized_batch(Q, matrices[None], aim=aim)[0]


def solve_centralized_batch(rotations: ArrayLike, moments: ArrayLike, *, aim: bool = True) -> CentralizedBatch:
    """`solve_centralized` for N problems of C cameras each: the same answers to the bit, whatever the others are.

    Args:
        rotations: (N, C, 3, 3) Q of camera_from_world, or (C, 3, 3) where all problems have the same cameras.
        moments: N lists of C `PairMoments`, or their matrices (N, C, 9, 9); zero for a camera without matches.
        aim: as in `solve_centralized`.

    Raises:
        ValueError: as `solve_centralized`; moments that are not finite or not symmetric.
    """
    q, views = quadratics_of(rotations, moments, aim=aim)
    found = minimize_batch(q.H, q.h)
    best = q.at(found.candidates[:, 0])
    costs = cost_of(q.H[:, None], q.h[:, None], found.candidates) + q.constant[:, None]
    return CentralizedBatch(
        candidates=found.candidates,
        counts=found.counts,
        costs=costs / q.scale[:, None],
        certified=found.certified & q.explained(found.candidates[:, 0]),
        converged=best.stationary,
        multiplier=best.multiplier / q.scale[:, None, None],
        noise_information=best.information,
        iterations=found.iterations,
        views=tuple(views),
    )
