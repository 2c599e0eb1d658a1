"""Detection of faulty cameras: wrong calibration, junk matches or a frozen image.

Each camera is scored by the distance of its matches from the consensus rotation of the cameras (`affine_consensus`).
Its own moments determine the kind of fault: for any rotation and any plane of depths, the affine map y = F x has |F'u|
= s, near 1, for the u that is normal to m. A camera whose F is too small for every u has junk matches; one whose
matches do not move while those of others do is frozen; otherwise its calibration is wrong.

Source: Chen & Schonfeld (2010) name sensor errors; the test is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import fdtri

from sylpose.display import Printable
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.geometry.matrices import transpose
from sylpose.geometry.validation import check_integer, check_list, check_rotation, check_sequence
from sylpose.moments import PairMoments
from sylpose.results import RotationEstimate
from sylpose.status import Status
from sylpose.sylvester.affine_consensus import (
    FAULT_SCORE,
    NON_AFFINE_SD,
    SCALE_SD,
    AffineFits,
    compute_scores,
    find_consensus_rotation,
    fit_affine_maps,
    refine_consensus,
)
from sylpose.sylvester.centralized import CentralizedSolution, solve_centralized
from sylpose.sylvester.orthographic import compute_views

FaultKind = Literal["calibration", "frozen", "junk"]

# A camera has full weight up to this score, half of `FAULT_SCORE`, and none from `FAULT_SCORE` on (choice).
FULL_WEIGHT_SCORE = 6.0
# A camera at fault has junk matches if no rotation gives it a score below this (measured:
# docs/history/benchmarks.md#bad-sensors, the kind is right in all).
JUNK_SCORE = 4.0
# Matches are static if noise explains their displacements at this significance level (choice; F-test).
STATIC_SIGNIFICANCE = 1e-4
# Squared displacements of static matches are at most this share of their squared spread (choice).
STATIC_SHARE = 0.1
# Maximum number of cameras in the search for the rotation (choice: time).
MAX_CAMERAS_SEARCHED = 24
# Squared displacements up to this share of the points' squares are rounding (derived).
ROUNDING_SHARE = 1e-12
_FAULT_TEXTS: dict[FaultKind, str] = {
    "calibration": "its matches fit a rotation, but not that of the other cameras: its calibration is wrong, "
    "it was moved, or its images are mirrored, exchanged or of another object",
    "frozen": "its matches do not move while those of the other cameras do: its image is frozen",
    "junk": "no rotation explains its matches: they are junk",
}


@dataclass(frozen=True)
class Fault:
    """Fault of a camera.

    Attributes:
        camera: its name, or its index as text.
        kind: "calibration" (its matches fit a rotation, but not that of the other cameras: its camera_from_world is
            wrong, or its images are mirrored or another camera's), "junk" (no rotation explains its matches), or
            "frozen" (its matches do not move while those of the others do).
        score: squared distance of its affine map from the others' rotation, in standard deviations.
        text: a sentence with the camera's name.
    """

    camera: str
    kind: FaultKind
    score: float
    text: str


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Printable):
    """Diagnosis of all cameras from their moments.

    Attributes:
        consistent: more than half of the cameras with a score, except junk and frozen ones, agree on a rotation, and
            the set of those that disagree is certain.
        text: a sentence with the faults found, or the reason why they are uncertain.
        rotation: (3, 3) rotation that the scores refer to, world frame.
        scores: (C,) as `Fault.score`; NaN for cameras with too few or collinear matches.
        weights: (C,) 0 for a camera at fault, 1 for a good one (or one without a score), between them near the
            threshold.
        faults: (C,) None for a camera that is not at fault.
    """

    consistent: bool
    text: str
    rotation: FloatArray
    scores: FloatArray
    weights: FloatArray
    faults: tuple[Fault | None, ...]


@dataclass(frozen=True, eq=False, repr=False)
class RobustSolution(RotationEstimate):
    """Rotation estimated from the cameras that are not at fault.

    Attributes:
        status: that of `solution`, or `NOT_CONSISTENT` if no majority of cameras agrees or the faulty camera is
            uncertain (`diagnosis.text`); `solution` is then the likeliest.
        rotation, information, unobservable, iterations: those of `solution`.
        solution: the centralized estimate with the cameras' weights; None if all cameras have junk matches.
        diagnosis: the fault of each camera.
    """

    solution: CentralizedSolution | None
    diagnosis: Diagnosis

    @property
    def weights(self) -> FloatArray:
        """(C,) weights of the cameras."""
        return self.diagnosis.weights

    @property
    def faults(self) -> tuple[Fault | None, ...]:
        """(C,) None for a camera that is not at fault."""
        return self.diagnosis.faults


def solve_robust(
    rotations: ArrayLike, moments: Sequence[PairMoments], *, names: Sequence[str] | None = None, aim: bool = True
) -> RobustSolution:
    """Estimate the rotation from the cameras that are not at fault, and diagnose the others.

    Args:
        rotations: (C, 3, 3) Q of camera_from_world.
        moments: C pair moments.
        names: C camera names for the faults' texts; None for the indices.
        aim: as in `compute_views`.

    Returns:
        The weighted centralized estimate with its diagnosis.

    Raises:
        ValueError: as `solve_centralized`, or the number of names is not C.
    """
    moments = check_list(moments, PairMoments, "moments")
    diagnosis = diagnose_cameras(rotations, moments, names=names, aim=aim)
    Q = np.asarray(rotations, dtype=float)
    kept = np.flatnonzero(diagnosis.weights > 0).tolist()
    if len(kept) == 0:
        nothing = np.full((3, 3), np.nan), np.zeros((3, 3)), np.eye(3)
        return RobustSolution(Status.NOT_CONSISTENT, *nothing, 0, None, diagnosis)
    weighted = [moments[c].scale_weights(float(diagnosis.weights[c])) for c in kept]
    s = solve_centralized(Q[kept], weighted, aim=aim)
    status = s.status if diagnosis.consistent else Status.NOT_CONSISTENT
    return RobustSolution(status, s.rotation, s.information, s.unobservable, s.iterations, s, diagnosis)


def diagnose_cameras(
    rotations: ArrayLike, moments: Sequence[PairMoments], *, names: Sequence[str] | None = None, aim: bool = True
) -> Diagnosis:
    """Find the cameras at fault by the consensus rotation, as input weights for any estimator.

    Estimators drop the moments of weight 0 and scale the others. With two cameras a disagreement is detected, but not
    the faulty camera. With three or four it is often uncertain, except for junk and frozen ones. A fault that does not
    affect the matches (a wrong calibration while the object hardly rotates) is not found and has little effect.

    Args:
        rotations, moments, names, aim: as in `solve_robust`.

    Returns:
        The faults and weights of all cameras.

    Raises:
        ValueError: as `compute_views`, or the number of names is not C.
    """
    moments = check_list(moments, PairMoments, "moments")
    cameras = _fit_cameras(rotations, moments, names, aim)
    fits, static, junk = cameras.fits, cameras.static, cameras.junk
    voters = np.flatnonzero(junk <= FAULT_SCORE)
    if len(voters) == 0:
        return _build_diagnosis(cameras, np.eye(3), junk, True)
    # A static object cannot appear to move: if two or more cameras observe motion, those without motion do not vote.
    moving = voters[~static[voters]]
    voting = moving if len(moving) > 1 else voters
    sample = voting[np.linspace(0, len(voting) - 1, min(len(voting), MAX_CAMERAS_SEARCHED)).astype(int)]
    Q = np.asarray(rotations, dtype=float)[fits.camera[sample]]
    initial = solve_centralized(Q, [moments[c] for c in fits.camera[sample]], aim=aim).rotation
    R, certain = find_consensus_rotation(fits.subset(sample), initial)
    R, voting_scores = refine_consensus(fits.subset(voting), R)
    scores = np.maximum(compute_scores(fits, R[None]).scores[0], junk)
    scores[voting] = voting_scores
    return _build_diagnosis(cameras, R, scores, certain)


def find_faulty_cameras(
    rotations: ArrayLike,
    moments: Sequence[PairMoments],
    rotation: ArrayLike,
    *,
    at_fault: Sequence[int] = (),
    names: Sequence[str] | None = None,
    aim: bool = True,
) -> Diagnosis:
    """Find the cameras at fault for a known rotation of the object.

    Args:
        rotations, moments, names, aim: as in `solve_robust`.
        rotation: (3, 3) R, world frame, assumed exact.
        at_fault: indices of cameras already known to be at fault (for instance by large epipolar residuals); only the
            kind of their fault is determined.

    Returns:
        The faults and weights of all cameras.

    Raises:
        ValueError: as `compute_views`, the number of names is not C, or rotation is not a rotation matrix.
    """
    R = check_rotation(rotation)
    moments = check_list(moments, PairMoments, "moments")
    faulty = [
        check_integer(c, f"at_fault[{k}]", maximum=len(moments) - 1)
        for k, c in enumerate(check_sequence(at_fault, "at_fault"))
    ]
    cameras = _fit_cameras(rotations, moments, names, aim)
    scores = np.maximum(compute_scores(cameras.fits, R[None]).scores[0], cameras.junk)
    scores[np.isin(cameras.fits.camera, np.array(faulty, dtype=np.int64))] = np.inf
    return _build_diagnosis(cameras, R, scores, True)


def max_fault_score(fits: AffineFits, rotation: FloatArray | None = None) -> float:
    """Return the largest `Fault.score` of these cameras at a rotation (3, 3), assumed exact.

    Without a rotation, each camera is scored at its own best one. 0 if no camera can be scored.
    """
    scores = _junk_scores(fits)
    if rotation is not None:
        scores = np.maximum(compute_scores(fits, rotation[None]).scores[0], scores)
    return float(scores.max(initial=0.0))


class _CameraFits(NamedTuple):
    """Names of all cameras, and fits, static matches and junk scores (n,) of those that can be scored."""

    labels: list[str]
    fits: AffineFits
    static: BoolArray
    junk: FloatArray

    @property
    def kinds(self) -> list[FaultKind]:
        """(n,) kind of the fault of each camera, if it is at fault."""
        is_junk = self.junk > JUNK_SCORE
        return ["junk" if j else "frozen" if s else "calibration" for s, j in zip(self.static, is_junk, strict=True)]


def _fit_cameras(
    rotations: ArrayLike, moments: Sequence[PairMoments], names: Sequence[str] | None, aim: bool
) -> _CameraFits:
    n = len(moments)
    labels = [str(c) for c in range(n)] if names is None else check_list(names, str, "names", n)
    fits = fit_affine_maps(compute_views(rotations, moments, aim=aim))
    return _CameraFits(labels, fits, find_static_views(moments, fits), _junk_scores(fits))


def _junk_scores(fits: AffineFits) -> FloatArray:
    """Return each camera's score (n,) at its own best rotation: 0 unless |F'u| < 1 for all u."""
    u, values, v = np.linalg.svd(fits.F)
    along = (u[:, :, 0, None] * v[:, None, 0]).reshape(-1, 4)
    variance = np.einsum("ci,cij,cj->c", along, fits.noise, along) + SCALE_SD**2 + NON_AFFINE_SD**2
    return np.asarray(np.maximum(1 - values[:, 0], 0.0) ** 2 / variance)


def find_static_views(moments: Sequence[PairMoments], fits: AffineFits) -> BoolArray:
    """Return the mask (n,) of cameras whose matches do not move by more than their noise."""
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
    explained = (ds * transpose(np.linalg.solve(ss, transpose(ds)))).sum(axis=(1, 2))
    # F-test of the affine map's six numbers; displacements within rounding are no motion. A half turn looks like noise
    # in d.
    noise = np.maximum(dd - explained, 0.0) / (2 * n - 6)
    rounding = ROUNDING_SHARE * np.trace(M, axis1=1, axis2=2)
    is_small = dd <= STATIC_SHARE * np.trace(ss, axis1=1, axis2=2)
    return np.asarray(
        is_small & (mean + explained <= 6 * noise * fdtri(6, 2 * n - 6, 1 - STATIC_SIGNIFICANCE) + rounding)
    )


def _build_diagnosis(cameras: _CameraFits, R: FloatArray, camera_scores: FloatArray, certain: bool) -> Diagnosis:
    """Build the diagnosis from the scores (n,); `certain`: whether the set of faulty cameras is certain."""
    labels, fits, kinds = cameras.labels, cameras.fits, cameras.kinds
    at_fault = camera_scores > FAULT_SCORE
    is_junk = (cameras.junk > JUNK_SCORE) & at_fault
    disagreeing = at_fault & ~is_junk
    agree, against = int((~at_fault).sum()), int((disagreeing & ~cameras.static).sum())
    # One camera against one other is no majority.
    majority = agree > against and (agree > 1 or not disagreeing.any())
    consistent = len(camera_scores) == 0 or (majority and (certain or not disagreeing.any()))
    score_weights = np.clip((FAULT_SCORE - camera_scores) / (FAULT_SCORE - FULL_WEIGHT_SCORE), 0.0, 1.0)
    weights, scores = np.ones(len(labels)), np.full(len(labels), np.nan)
    weights[fits.camera] = score_weights if majority else np.where(is_junk, 0.0, 1.0)
    scores[fits.camera] = camera_scores
    faults: list[Fault | None] = [None] * len(labels)
    for k in np.flatnonzero(at_fault if consistent else is_junk).tolist():
        c = int(fits.camera[k])
        faults[c] = Fault(labels[c], kinds[k], float(camera_scores[k]), f"camera {labels[c]}: {_FAULT_TEXTS[kinds[k]]}")
    sentences = [fault.text for fault in faults if fault is not None]
    if not consistent and disagreeing.any():
        likeliest = ", ".join(labels[c] for c in fits.camera[disagreeing])
        sentences.append(f"the cameras disagree, and it is not certain which one is wrong (the likeliest: {likeliest})")
    text = "; ".join(sentences) or "no camera is at fault"
    return Diagnosis(consistent, f"{text[0].upper()}{text[1:]}.", R, scores, weights, tuple(faults))
