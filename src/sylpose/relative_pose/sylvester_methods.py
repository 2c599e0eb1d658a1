"""The paper's estimators as methods of `estimate_motion` and the tracker.

None of them rejects outliers: they are given the inliers of a robust fit, as pair moments, and their rotation takes the
place of the fit's. The displacement follows from the means. Cameras at fault are left out and named
(`sylvester.camera_faults`).

Source: Chen & Schonfeld (2010); docs/method.md, "The paper".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.relative_pose.fit import Fit
from sylpose.relative_pose.terms import TermData
from sylpose.results import RotationEstimate, Status
from sylpose.sylvester.camera_faults import diagnose
from sylpose.sylvester.centralized import solve_centralized
from sylpose.sylvester.depth_plane import solve_depth_plane
from sylpose.sylvester.distributed.simulation import solve_exchange, solve_gossip, solve_refine
from sylpose.sylvester.one_camera import OneCameraSolution, solve_one_camera, solve_unconstrained
from sylpose.sylvester.translation import translation_from_means, translation_from_moments

__all__ = ["ESTIMATORS", "UNBIASED", "paper_fit"]

Moments = Sequence[PairMoments]

# Fewer matches have no second moments (derived).
SPREAD = 3


# (rotations (C, 3, 3), C moments, the robust fit's R) -> the estimate.
Estimator = Callable[[FloatArray, Moments, FloatArray], RotationEstimate]


def _several(solve: Callable[[FloatArray, Moments], RotationEstimate]) -> Estimator:
    """Of several cameras; of one alone, `solve_one_camera`'s."""

    def estimate(Q: FloatArray, moments: Moments, guess: FloatArray) -> RotationEstimate:
        return solve(Q, moments) if len(Q) > 1 else ESTIMATORS["one-camera"](Q, moments, guess)

    return estimate


def _one(solve: Callable[[FloatArray, PairMoments], OneCameraSolution]) -> Estimator:
    """Of the camera with the most matches; of its two mirrored answers the one nearer to the robust fit's, which it cannot
    tell itself."""

    def estimate(Q: FloatArray, moments: Moments, guess: FloatArray) -> RotationEstimate:
        c = int(np.argmax([m.count for m in moments]))
        return solve(Q[c], moments[c]).nearest(guess)

    return estimate


# The keys are names of methods (`methods`).
ESTIMATORS: dict[str, Estimator] = {
    "sylvester": _several(solve_centralized),
    "depth-plane": lambda Q, moments, _: solve_depth_plane(Q, moments),
    "exchange": _several(solve_exchange),
    "refine": _several(solve_refine),
    "gossip": _several(solve_gossip),
    "one-camera": _one(solve_one_camera),
    "unconstrained": _one(solve_unconstrained),
}
# Those whose displacement may follow from epipolar geometry: a bias of the others' rotation would turn into a shift.
UNBIASED = {"depth-plane"}


def paper_fit(method: str, data: Sequence[TermData], robust: Fit, center: FloatArray, names: Sequence[str]) -> Fit:
    """One of the paper's estimates in place of a robust fit's motion.

    Args:
        method: a key of `ESTIMATORS`.
        data: the terms of the fit, one per camera, all of the same reference.
        robust: a fit whose status is OK.
        center: (3,) g.
        names: of the rig's cameras.

    Returns:
        the fit with its motion, information, status and `faults` replaced; the weights stay the robust fit's.
    """
    seen = [i for i, w in enumerate(robust.weights) if (w > 0).sum() >= SPREAD]
    if not seen:
        return replace(robust, status=Status.TURN_NOT_OBSERVABLE)
    Q = np.array([data[i].rotation for i in seen])
    inliers = [PairMoments.from_matches(data[i].x, data[i].y, robust.weights[i]) for i in seen]
    diagnosis = diagnose(Q, inliers, names=[names[data[i].camera] for i in seen])
    # Where it cannot be told which cameras are wrong, all of them are heard, as by the robust fit.
    trust = diagnosis.weights if diagnosis.consistent else np.ones(len(seen))
    moments = [m.weighted(float(t)) for t, m in zip(trust, inliers, strict=True)]
    faults = tuple(dict.fromkeys((*robust.faults, *(fault.text for fault in diagnosis.faults if fault is not None))))
    try:
        turn = ESTIMATORS[method](Q, moments, robust.rotation)
        centers = np.array([data[i].center for i in seen])
        off = 0.0 if method in UNBIASED else min(float(np.trace(turn.covariance)), np.pi**2)
        shift, of_shift = translation_from_means(Q, centers, moments, turn.rotation, center, off=off)
        known, believed = np.zeros((6, 6)), np.zeros((6, 6))
        if method in UNBIASED:
            believed[3:, 3:] = of_shift
            shift, known = translation_from_moments(Q, centers, moments, turn.rotation, center, shift, of_shift)
            known[:3, :3] += _seen(turn)
        else:
            known[:3, :3], known[3:, 3:] = turn.information, of_shift
    except ValueError:
        # No spread in any camera, or an object behind one: nothing to estimate a turn from.
        return replace(robust, status=Status.TURN_NOT_OBSERVABLE, faults=faults)
    return replace(
        robust,
        # What of the turn is not seen, `verdict.observed` says: the information knows little or nothing of it.
        status=Status.OK if turn.status is Status.TURN_NOT_OBSERVABLE else turn.status,
        rotation=turn.rotation,
        shift=shift,
        information=known + believed,
        information_without_depth=known,
        iterations=robust.iterations + turn.iterations,
        faults=faults,
    )


def _seen(turn: RotationEstimate) -> FloatArray:
    """(3, 3) the information of the turn, without the directions that the estimator says it has not seen."""
    seen = np.eye(3) - turn.unseen.T @ turn.unseen
    return np.asarray(seen @ turn.information @ seen)
