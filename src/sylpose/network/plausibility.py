"""Plausibility checks of received payloads, which may be well-formed but impossible.

Plausible but false payloads are not detected here; they are handled by the variance inflation of disagreeing cameras.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import unpack_symmetric
from sylpose.landmarks.alignment import LandmarkMatches
from sylpose.landmarks.messages import DIAGONAL, EvaluationMessage, TermsMessage
from sylpose.relative_pose.camera_evidence import MAX_EXCESS, MIN_SIGMA_PX, CameraEvidence
from sylpose.relative_pose.camera_evidence import MIN_MATCHES as MIN_EVIDENCE_MATCHES
from sylpose.relative_pose.terms import TermData
from sylpose.tracking.reports import (
    BoxMotionReport,
    CameraObservations,
    CameraTerms,
    InitialMatches,
    InlierStatistics,
    KnownDepthMatches,
    LandmarkAges,
    MovingMatches,
    NewObservations,
    PoseAgreement,
    RelocalizationMatches,
    TrackingReport,
)

# A Hessian is that of a sum of squares if it is positive semi-definite up to this share of its diagonal (derived:
# rounding of 24 bits in the compact mode, after elimination of the depth model).
RELATIVE_ROUNDING = 1e-5
# Upper bound of counts and of lengths in pixels (choice).
MAX_COUNT = 1e7
# Upper bound of the rotational information per match (choice: 1e10 for an object in its place, but a diverging initial
# pose may bring it close to a camera).
MAX_INFORMATION_PER_MATCH = 1e20
# Upper bound of lengths in any unit (choice).
MAX_LENGTH = 1e9
# Largest normalized coordinate: 89.4 degrees off the optical axis (derived).
MAX_NORMALIZED = 100.0
# Records of counts, sums and lengths in pixels, all non-negative.
COUNT_RECORDS = (
    TrackingReport,
    MovingMatches,
    BoxMotionReport,
    LandmarkAges,
    InlierStatistics,
    KnownDepthMatches,
    PoseAgreement,
    NewObservations,
    CameraObservations,
    EvaluationMessage,
)
# Exceptions: positions and image points, which may be negative; and fields that are NaN if unknown (derived).
SIGNED_FIELDS = {"term", "observations", "ages", "image", "positions", "evidence", "evidence_reference"}
OPTIONAL_FIELDS = {
    "jitter_px",
    "center_displacement_px",
    "moving_displacement_px",
    "depth_sd",
    "residual_px",
    "noise_px",
}


def find_implausibility(payload: object, camera: int) -> str | None:
    """Return the reason why a payload of a camera is implausible; None if it is plausible."""
    parts = payload if isinstance(payload, tuple) else [payload]
    messages = [one for one in parts if isinstance(one, TermsMessage)]
    if messages and not _are_informations(np.array([one.upper for one in messages])):
        return "its pose information matrix is invalid"
    if not all(map(_has_enough_matches, messages)) or not all(_is_plausible(one, camera) for one in parts):
        return "its match statistics are impossible"
    return None


def _is_plausible(one: object, camera: int) -> bool:
    if isinstance(one, COUNT_RECORDS):
        names = [field.name for field in fields(one) if field.name not in SIGNED_FIELDS]
        if not all(_is_count(getattr(one, name), name in OPTIONAL_FIELDS) for name in names):
            return False
    match one:
        case InitialMatches():
            return all(_is_plausible(report, camera) for report in one.reports)
        case CameraTerms():
            return all(_is_plausible(term, camera) for term in one.terms)
        case MovingMatches():
            return len(one.displacement_px) == len(one.term) and _is_plausible(one.term, camera)
        case KnownDepthMatches():
            return len(one.weights) == len(one.observations.points) and _is_plausible(one.observations, camera)
        case PoseAgreement():
            fits = len(one.references) == len(one.weights) and one.n_strong <= one.n_inlier_features <= one.n_features
            return fits and _is_plausible(one.ages, camera) and _is_plausible(one.evidence, camera)
        case CameraEvidence():
            if not one.n:
                return bool(np.isnan(one.excess))
            noise = MIN_SIGMA_PX <= one.own_px <= MAX_COUNT and 0.0 <= one.joint_px <= MAX_COUNT
            return noise and MIN_EVIDENCE_MATCHES <= one.n <= MAX_COUNT and 0.0 <= one.excess <= MAX_EXCESS
        case LandmarkAges():
            return bool(one.counts.sum() < MAX_COUNT)
        case EvaluationMessage():
            return one.inliers <= one.matches
        case NewObservations() | CameraObservations():
            return _are_points(one.image, MAX_NORMALIZED) and _are_points(one.positions)
        case TermData():
            points = _are_points(one.x, MAX_NORMALIZED) and _are_points(one.y, MAX_NORMALIZED)
            is_own = one.camera == camera and 0.0 < one.focal < MAX_COUNT
            return points and is_own and _is_view(one.rotation, one.center)
        case LandmarkMatches():
            points = all(map(_are_points, (one.points, one.image, one.prior_weight)))
            return points and _is_view(one.rotation, one.center)
        case RelocalizationMatches():
            return _are_points(one.points) and _are_points(one.pixels)
        case np.ndarray():
            return _are_points(one)
        case bool() | int() | float():
            return not abs(one) > MAX_COUNT
    return True


def _has_enough_matches(message: TermsMessage) -> bool:
    """Return whether the information is possible for the number of matches."""
    has_valid_noise = np.isnan(message.noise_px) or 0.0 < message.noise_px < MAX_COUNT
    information = message.upper[DIAGONAL[:3]].sum()
    return bool(
        has_valid_noise
        and 0.0 <= message.weight_sum < MAX_COUNT
        and information <= MAX_INFORMATION_PER_MATCH * message.weight_sum
    )


def _is_count(value: object, allow_nan: bool) -> bool:
    """Return whether numbers are valid counts or measures.

    Args:
        value: the numbers.
        allow_nan: whether they may be NaN.
    """
    numbers = np.asarray(value, float)
    return bool(((numbers >= 0) & (numbers <= MAX_COUNT) | (np.isnan(numbers) & allow_nan)).all())


def _are_points(points: FloatArray, limit: float = MAX_LENGTH) -> bool:
    return bool(np.isfinite(points).all() and (np.abs(points) < limit).all())


def _is_view(rotation: FloatArray, center: FloatArray) -> bool:
    """Return whether a camera pose is valid."""
    return _are_points(center) and bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < RELATIVE_ROUNDING)


def _are_informations(upper: FloatArray) -> bool:
    """Return whether all (n, 27) have a finite gradient and a positive semi-definite Hessian."""
    if not np.isfinite(upper).all():
        return False
    hessian = np.array([unpack_symmetric(one) for one in upper[:, :21]])
    size = np.einsum("nii->ni", hessian)
    if (size < 0.0).any():
        return False
    unit = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
    hessian = hessian * unit[:, :, None] * unit[:, None, :] + RELATIVE_ROUNDING * np.eye(6)
    try:
        np.linalg.cholesky(hessian)
    except np.linalg.LinAlgError:
        return False
    return True
