"""Sensor errors: a camera with a wrong calibration, junk matches or a frozen image, recognised and named.

Each camera is judged by how far its matches are from what the rotation that most cameras agree on allows (`affine_votes`).
What kind of fault it has, its own moments say: whatever the object's rotation and the plane of its depths, the affine map
y = F x has |F'u| = s, near 1, for the u that is normal to m. A camera whose F is too small for every u is junk; one whose
matches do not move, though the others say so, is frozen; of the rest the calibration is doubted.

Source: Chen & Schonfeld (2010) name sensor errors; the test is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import fdtri

from sylpose.display import Telling, Told
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.matrices import checked_rotation, transpose
from sylpose.geometry.validation import items, listed, whole
from sylpose.moments import PairMoments
from sylpose.results import RotationEstimate, Status
from sylpose.sylvester.affine_consensus import (
    FAULT,
    LEFT_OVER,
    SCALE,
    AffineFits,
    affine_fits,
    agreed_rotation,
    score,
    settled,
)
from sylpose.sylvester.centralized import CentralizedSolution, solve_centralized
from sylpose.sylvester.orthographic import views_of

__all__ = [
    "Diagnosis",
    "Fault",
    "FaultKind",
    "RobustSolution",
    "diagnose",
    "doubt_of",
    "solve_robust",
    "stand_still",
    "suspect_cameras",
]

FaultKind = Literal["calibration", "frozen", "junk"]

# A camera is trusted in full up to this score, and not at all from `FAULT` on: half of that (choice).
TRUSTED = 6.0
# Of a camera at fault: junk where no rotation comes nearer than this score to what its matches say (measured:
# docs/benchmarks.md#bad-sensors, the kind is right in all).
JUNK = 4.0
# A camera stands still where chance makes its matches' displacements as large at least this often (choice; F-test).
STILL = 1e-4
# One that stands still is not displaced by more than this share of how far its places are apart, squared (choice).
LITTLE = 0.1
# The rotation is searched for with no more cameras than this (choice: time).
SEARCHED = 24
# Squares of displacements up to this share of those of the places are rounding (derived).
NO_MOTION = 1e-12
_TEXTS: dict[FaultKind, str] = {
    "calibration": "its matches fit a rotation, but not that of the other cameras: its calibration is wrong, it was moved, "
    "or its images are mirrored, exchanged or of something else",
    "frozen": "it sees no motion while the other cameras do: its image is frozen",
    "junk": "no rotation explains its matches: they are junk",
}


@dataclass(frozen=True)
class Fault:
    """What is wrong with a camera.

    Attributes:
        camera: its name, or its index as text.
        kind: "calibration" (its matches fit a rotation, but not that of the other cameras: its camera_from_world is wrong,
            or its images are mirrored or another camera's), "junk" (no rotation explains its matches), or "frozen" (it sees
            no motion while the others do).
        score: squared distance of its affine map from what the others' rotation allows, in standard deviations.
        text: a sentence that names the camera.
    """

    camera: str
    kind: FaultKind
    score: float
    text: str


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Told):
    """What the cameras' moments say of the cameras.

    Attributes:
        consistent: more than half of the cameras that could be judged, junk and frozen ones aside, agree on a rotation, and
            who disagrees is certain.
        text: a sentence: what was found, or why it cannot be told.
        rotation: (3, 3) what the cameras are judged by, world frame.
        scores: (C,) as `Fault.score`; NaN for cameras with too few matches or none spread over two dimensions.
        weights: (C,) 0 for a camera at fault, 1 for one that is trusted (or cannot be judged), between them in doubt.
        faults: (C,) None for a camera that is not at fault.
    """

    consistent: bool
    text: str
    rotation: FloatArray
    scores: FloatArray
    weights: FloatArray
    faults: tuple[Fault | None, ...]

    def _told(self) -> Telling:
        return Telling(self.text)


@dataclass(frozen=True, eq=False, repr=False)
class RobustSolution(RotationEstimate):
    """The rotation of the cameras that can be relied upon.

    Attributes:
        status: that of `solution`; but NOT_CONSISTENT where no majority of cameras agrees,
            or it is not certain which one is wrong (`diagnosis.text`): `solution` is then the likeliest.
        rotation, information, unseen, iterations: those of `solution`.
        solution: the centralised estimate with the cameras' weights; None where every camera is junk.
        diagnosis: what is wrong with which camera.
    """

    solution: CentralizedSolution | None
    diagnosis: Diagnosis

    @property
    def weights(self) -> FloatArray:
        """(C,) of the cameras."""
        return self.diagnosis.weights

    @property
    def faults(self) -> tuple[Fault | None, ...]:
        """(C,) None for a camera that is not at fault."""
        return self.diagnosis.faults

    def _told_besides(self) -> list[tuple[str, str]]:
        return [("cameras", self.diagnosis.text)]


def solve_robust(
    rotations: ArrayLike, moments: Sequence[PairMoments], *, names: Sequence[str] | None = None, aim: bool = True
) -> RobustSolution:
    """The centralised estimate of the cameras that are not at fault, with what is wrong with the others.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments.
        names: C, for the faults' texts; None for the indices.
        aim: as in `views_of`.

    Raises:
        ValueError: as `solve_centralized`; names that are not C.
    """
    moments = listed(moments, PairMoments, "moments")
    diagnosis = diagnose(rotations, moments, names=names, aim=aim)
    Q = np.asarray(rotations, dtype=float)
    kept = np.flatnonzero(diagnosis.weights > 0).tolist()
    if len(kept) == 0:
        nothing = np.full((3, 3), np.nan), np.zeros((3, 3)), np.eye(3)
        return RobustSolution(Status.NOT_CONSISTENT, *nothing, 0, None, diagnosis)
    weighted = [moments[c].weighted(float(diagnosis.weights[c])) for c in kept]
    s = solve_centralized(Q[kept], weighted, aim=aim)
    status = s.status if diagnosis.consistent else Status.NOT_CONSISTENT
    return RobustSolution(status, s.rotation, s.information, s.unseen, s.iterations, s, diagnosis)


def diagnose(
    rotations: ArrayLike, moments: Sequence[PairMoments], *, names: Sequence[str] | None = None, aim: bool = True
) -> Diagnosis:
    """Which cameras are at fault, judged by the rotation that most of them agree on; for any estimator to go on with
    (drop the moments of weight 0, scale the others).

    Two cameras that disagree are seen to, but not which is wrong; of three or four cameras it is often not certain, junk and
    frozen ones aside, because few affine maps leave much open. A fault that does not show in the matches (a wrong
    calibration while the object hardly turns) is not found, and does little harm.

    Args:
        rotations, moments, names, aim: as in `solve_robust`.

    Raises:
        ValueError: as `views_of`; names that are not C.
    """
    moments = listed(moments, PairMoments, "moments")
    labels = _labels(names, len(moments))
    fits = affine_fits(views_of(rotations, moments, aim=aim))
    still, junk = stand_still(moments, fits), _junk(fits)
    kinds = _kinds(still, junk > JUNK)
    voters = np.flatnonzero(junk <= FAULT)
    if len(voters) == 0:
        return _report(labels, fits, kinds, np.eye(3), junk, True)
    # A still object cannot be seen to move: where two or more cameras see motion, they are heard and the still ones are not.
    moving = voters[~still[voters]]
    heard = moving if len(moving) > 1 else voters
    some = heard[np.linspace(0, len(heard) - 1, min(len(heard), SEARCHED)).astype(int)]
    Q = np.asarray(rotations, dtype=float)[fits.camera[some]]
    plain = solve_centralized(Q, [moments[c] for c in fits.camera[some]], aim=aim).rotation
    R, certain = agreed_rotation(fits.subset(some), plain)
    R, of_heard = settled(fits.subset(heard), R)
    scores = np.maximum(score(fits, R[None]).squared[0], junk)
    scores[heard] = of_heard
    return _report(labels, fits, kinds, R, scores, certain)


def suspect_cameras(
    rotations: ArrayLike,
    moments: Sequence[PairMoments],
    rotation: ArrayLike,
    *,
    at_fault: Sequence[int] = (),
    names: Sequence[str] | None = None,
    aim: bool = True,
) -> Diagnosis:
    """Which cameras are at fault if the object's rotation is `rotation`, found by any other means.

    Args:
        rotations, moments, names, aim: as in `solve_robust`.
        rotation: (3, 3) R, world frame. It is taken as exact.
        at_fault: cameras that are known to be so by other means (matches that no epipolar line is near to, say): what is
            wrong with them is all that is asked.

    Raises:
        ValueError: as `views_of`; names that are not C; a matrix that is no rotation.
    """
    R = checked_rotation(rotation)
    moments = listed(moments, PairMoments, "moments")
    known = [whole(c, f"at_fault[{k}]", most=len(moments) - 1) for k, c in enumerate(items(at_fault, "at_fault"))]
    labels = _labels(names, len(moments))
    fits = affine_fits(views_of(rotations, moments, aim=aim))
    still, junk = stand_still(moments, fits), _junk(fits)
    scores = np.maximum(score(fits, R[None]).squared[0], junk)
    scores[np.isin(fits.camera, np.array(known, dtype=np.int64))] = np.inf
    return _report(labels, fits, _kinds(still, junk > JUNK), R, scores, True)


def doubt_of(fits: AffineFits, rotation: FloatArray | None = None) -> float:
    """What a camera can tell of itself: the largest `Fault.score` of these cameras if the object's rotation is this one
    (3, 3), taken as exact; if it is whatever suits each of them best, without one. 0 if none can be judged."""
    scores = _junk(fits)
    if rotation is not None:
        scores = np.maximum(score(fits, rotation[None]).squared[0], scores)
    return float(scores.max(initial=0.0))


def _junk(fits: AffineFits) -> FloatArray:
    """(n,) score of the rotation that suits a camera best: 0 unless |F'u| < 1 for all u."""
    u, values, v = np.linalg.svd(fits.F)
    along = (u[:, :, 0, None] * v[:, None, 0]).reshape(-1, 4)
    variance = np.einsum("ci,cij,cj->c", along, fits.noise, along) + SCALE**2 + LEFT_OVER**2
    return np.asarray(np.maximum(1 - values[:, 0], 0.0) ** 2 / variance)


def stand_still(moments: Sequence[PairMoments], fits: AffineFits) -> BoolArray:
    """(n,) cameras whose matches do not move by more than their noise."""
    if len(fits.camera) == 0:
        return np.zeros(0, dtype=bool)
    M = np.array([moments[c].matrix for c in fits.camera])
    i, j, n = [6, 7], [2, 5], fits.weight
    xx, yy, yx = M[:, i][:, :, i], M[:, j][:, :, j], M[:, j][:, :, i]
    d, s = M[:, j, 8] - M[:, i, 8], M[:, j, 8] + M[:, i, 8]
    mean = (d**2).sum(axis=1) / n
    dd = np.trace(xx + yy - yx - transpose(yx), axis1=1, axis2=2) - mean
    # d = y - x as a function of s = x + y: the noise of d is not in s, as it is in x, where the image may be narrow.
    ss = xx + yy + yx + transpose(yx) - s[:, :, None] * s[:, None] / n[:, None, None]
    ds = yy - xx + yx - transpose(yx) - d[:, :, None] * s[:, None] / n[:, None, None]
    by_place = (ds * transpose(np.linalg.solve(ss, transpose(ds)))).sum(axis=(1, 2))
    # F-test of the affine map's six numbers; what rounding leaves is no motion. Half of a turn looks like noise in d.
    noise = np.maximum(dd - by_place, 0.0) / (2 * n - 6)
    rounding = NO_MOTION * np.trace(M, axis1=1, axis2=2)
    little = dd <= LITTLE * np.trace(ss, axis1=1, axis2=2)
    return np.asarray(little & (mean + by_place <= 6 * noise * fdtri(6, 2 * n - 6, 1 - STILL) + rounding))


def _report(
    labels: Sequence[str],
    fits: AffineFits,
    kinds: Sequence[FaultKind],
    R: FloatArray,
    judged: FloatArray,
    certain: bool,
) -> Diagnosis:
    """What the scores (n,) of the cameras that could be judged mean; `certain`: who is at fault, if anyone is."""
    at_fault = judged > FAULT
    own = np.array([kind == "junk" for kind in kinds], dtype=bool) & at_fault
    accused = at_fault & ~own
    agree, against = int((~at_fault).sum()), sum(kinds[k] == "calibration" for k in np.flatnonzero(accused).tolist())
    # One camera's word against another's is none.
    majority = agree > against and (agree > 1 or not accused.any())
    consistent = len(judged) == 0 or (majority and (certain or not accused.any()))
    trust = np.clip((FAULT - judged) / (FAULT - TRUSTED), 0.0, 1.0)
    weights, scores = np.ones(len(labels)), np.full(len(labels), np.nan)
    weights[fits.camera] = trust if majority else np.where(own, 0.0, 1.0)
    scores[fits.camera] = judged
    faults: list[Fault | None] = [None] * len(labels)
    for k in np.flatnonzero(at_fault if consistent else own).tolist():
        c = int(fits.camera[k])
        faults[c] = Fault(labels[c], kinds[k], float(judged[k]), f"camera {labels[c]}: {_TEXTS[kinds[k]]}")
    said = [fault.text for fault in faults if fault is not None]
    if not consistent and accused.any():
        who = ", ".join(labels[c] for c in fits.camera[accused])
        said.append(f"the cameras disagree, and it is not certain which one is wrong (the likeliest: {who})")
    text = "; ".join(said) or "no camera is found to be at fault"
    return Diagnosis(consistent, f"{text[0].upper()}{text[1:]}.", R, scores, weights, tuple(faults))


def _kinds(still: BoolArray, junk: BoolArray) -> list[FaultKind]:
    return ["junk" if j else "frozen" if s else "calibration" for s, j in zip(still, junk, strict=True)]


def _labels(names: Sequence[str] | None, n: int) -> list[str]:
    return [str(c) for c in range(n)] if names is None else listed(names, str, "names", n)
