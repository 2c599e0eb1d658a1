"""The paper's estimators as methods of `estimate_motion` and the tracker.

None of them rejects outliers: they receive the inliers of a robust fit, as pair moments, and their rotation replaces
that of the fit. The translation follows from the means. Faulty cameras are left out and named
(`sylvester.camera_faults`).

Source: Chen & Schonfeld (2010); docs/method/2-sylvester.md, "The paper".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.relative_pose.terms import Fit, TermData
from sylpose.results import RotationEstimate
from sylpose.status import Status
from sylpose.sylvester.camera_faults import diagnose_cameras
from sylpose.sylvester.centralized import solve_centralized
from sylpose.sylvester.depth_plane import solve_depth_plane
from sylpose.sylvester.one_camera import solve_one_camera
from sylpose.sylvester.translation import refine_translation, solve_translation_from_means

Moments = Sequence[PairMoments]

# Minimum number of matches with second moments (derived).
MIN_SPREAD_MATCHES = 3


def _solve_sylvester(Q: FloatArray, moments: Moments, guess: FloatArray) -> RotationEstimate:
    """Return the centralized estimate; of a single camera's two mirrored ones that nearer to the guess (3, 3)."""
    return solve_centralized(Q, moments) if len(Q) > 1 else solve_one_camera(Q[0], moments[0]).select_nearest(guess)


# Name of the method (`methods`): (rotations (C, 3, 3), C moments, the robust fit's R) -> the estimate.
ESTIMATORS: dict[str, Callable[[FloatArray, Moments, FloatArray], RotationEstimate]] = {
    "sylvester": _solve_sylvester,
    "depth-plane": lambda Q, moments, _: solve_depth_plane(Q, moments),
}
# Methods whose translation may follow from epipolar geometry: a bias of the others' rotation would turn into a
# translation.
UNBIASED_METHODS = {"depth-plane"}


def apply_estimator(method: str, data: Sequence[TermData], robust: Fit, g: FloatArray, names: Sequence[str]) -> Fit:
    """Replace a robust fit's motion by one of the paper's estimates.

    Args:
        method: a key of `ESTIMATORS`.
        data: the terms of the fit, one per camera, all of the same reference.
        robust: a fit whose status is OK.
        g: (3,) the object's center.
        names: of the rig's cameras.

    Returns:
        the fit with its motion, information, status and `faults` replaced; the weights stay the robust fit's.
    """
    used = [i for i, w in enumerate(robust.weights) if (w > 0).sum() >= MIN_SPREAD_MATCHES]
    if not used:
        return replace(robust, status=Status.ROTATION_NOT_OBSERVABLE)
    Q = np.array([data[i].rotation for i in used])
    inliers = [PairMoments.from_matches(data[i].x, data[i].y, robust.weights[i]) for i in used]
    diagnosis = diagnose_cameras(Q, inliers, names=[names[data[i].camera] for i in used])
    # If the faulty cameras cannot be identified, use all of them, as the robust fit does.
    camera_weights = diagnosis.weights if diagnosis.consistent else np.ones(len(used))
    moments = [m.scale_weights(float(t)) for t, m in zip(camera_weights, inliers, strict=True)]
    faults = tuple(dict.fromkeys((*robust.faults, *(fault.text for fault in diagnosis.faults if fault is not None))))
    try:
        estimate = ESTIMATORS[method](Q, moments, robust.rotation)
        centers = np.array([data[i].center for i in used])
        rotation_variance = 0.0 if method in UNBIASED_METHODS else min(float(np.trace(estimate.covariance)), np.pi**2)
        known = Q, centers, moments, estimate.rotation, g
        translation, from_means = solve_translation_from_means(*known, rotation_variance=rotation_variance)
        information, prior_information = np.zeros((6, 6)), np.zeros((6, 6))
        if method in UNBIASED_METHODS:
            prior_information[3:, 3:] = from_means
            translation, information = refine_translation(*known, translation, from_means)
            information[:3, :3] += _project_information(estimate)
        else:
            information[:3, :3], information[3:, 3:] = estimate.information, from_means
    except ValueError:
        # No spread in any camera, or an object behind one: the rotation cannot be estimated.
        return replace(robust, status=Status.ROTATION_NOT_OBSERVABLE, faults=faults)
    return replace(
        robust,
        # `classify_observability` reports unobservable rotations: the information about them is small or zero.
        status=Status.OK if estimate.status is Status.ROTATION_NOT_OBSERVABLE else estimate.status,
        rotation=estimate.rotation,
        translation=translation,
        information=information + prior_information,
        information_without_depth=information,
        iterations=robust.iterations + estimate.iterations,
        faults=faults,
    )


def _project_information(estimate: RotationEstimate) -> FloatArray:
    """Return (3, 3) the information of the rotation, without its unobservable directions."""
    projector = np.eye(3) - estimate.unobservable.T @ estimate.unobservable
    return np.asarray(projector @ estimate.information @ projector)
