"""Initialization without boxes: what moves against the static background is the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.relative_pose.motion import make_motion_about
from sylpose.relative_pose.observability import classify_observability
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.terms import MIN_MATCHES, Fit, TermData, locate_object, make_failed_fit
from sylpose.results import FrameStatus, Status
from sylpose.rig import Rig
from sylpose.tracking.camera import compute_static_px
from sylpose.tracking.camera_executor import CameraExecutor
from sylpose.tracking.frame import FrameMatches, find_static, select_inliers
from sylpose.tracking.frame_solvers import gather_terms, scatter_fit
from sylpose.tracking.reports import InitialMatches, MovingMatches

__all__ = ["FirstMotion", "estimate_first_motion", "estimate_jitter", "is_ambiguous", "is_continuing_motion"]

# Another motion with this share of the object's inliers may be the object as well (choice).
AMBIGUITY_RATIO = 0.5
# Keypoints displaced by less than this, pixels, may be static. They define the noise if more than this share of them is
# displaced by less than half of it (choice).
MAX_STATIC_PX, MIN_STATIC_RATIO = 4.0, 0.65
# Median of the Rayleigh distribution in standard deviations (derived).
RAYLEIGH_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))
# A camera detects a motion with at least so many inliers, whose median displacement exceeds this, pixels, and so many
# times the noise of static keypoints (choice).
MIN_SIGNIFICANT_MATCHES, MIN_DISPLACEMENT_PX, MIN_DISPLACEMENT_SIGMAS = 6, 3.5, 7.0
# A rigid motion must exceed the log-likelihood of displacements in random directions by this much per unknown (choice:
# Akaike's criterion requires 1, Bayes' half the logarithm of the number of matches).
MIN_LOG_GAIN_PER_UNKNOWN = 5.0
# Unknowns of a motion, and of each camera's surface (derived).
MOTION_UNKNOWNS, SURFACE_UNKNOWNS = 6, 6
# Between consecutive frames, the rotation since the first frame changes by at most this share, or this angle, radians
# (choice).
MAX_ROTATION_CHANGE_RATIO, MAX_ROTATION_CHANGE = 0.6, np.radians(0.75)
# This share of all matches is wrong without any motion (choice).
OUTLIER_RATIO = 0.05
# Largest rms residual of moving matches as a share of their displacement (choice).
MAX_RESIDUAL_RATIO = 0.35
# Minimum keypoint noise, pixels (choice).
MIN_NOISE_PX = 0.15


@dataclass(frozen=True, eq=False)
class FirstMotion:
    """Motion since a frame, of the only object that moves.

    Attributes:
        fit: of the moving matches.
        center: (3,) point that the motion is about.
        inlier_center: (3,) center of its inliers.
        radius: of its inliers about `inlier_center`; NaN without any.
        n_inliers: number of inliers.
        displacement_px: median displacement of the inliers; NaN without any.
        n_cameras: number of cameras that detect it, with enough inliers displaced far enough.
        is_significant: whether it exceeds the noise of static keypoints.
        is_observable: whether it is fully observable, including rotation angle and length of translation.
        failure_status: status to report if this is not the object's motion: too few matches, no motion, or no rigid
            motion.
        inliers: per camera, local.
    """

    fit: Fit
    center: FloatArray
    inlier_center: FloatArray
    radius: float
    n_inliers: int
    displacement_px: float
    n_cameras: int
    is_significant: bool
    is_observable: bool
    failure_status: FrameStatus
    inliers: Sequence[Sequence[FrameMatches]]

    @property
    def motion(self) -> RigidTransform:
        """Motion of the object since the frame."""
        return make_motion_about(self.center, self.fit.rotation, self.fit.translation)


def is_continuing_motion(earlier: RigidTransform | None, later: RigidTransform | None) -> bool:
    """Return whether two frames' motions since the same frame may belong to one continuing body.

    With few cameras and a planar object a second motion fits as well; that one differs in each frame.

    Args:
        earlier, later: motions, in order of time.
    """
    if earlier is None or later is None:
        return False
    angle = max(earlier.rotation.magnitude(), later.rotation.magnitude())
    return bool(
        (later.rotation * earlier.rotation.inv()).magnitude()
        <= max(MAX_ROTATION_CHANGE_RATIO * angle, MAX_ROTATION_CHANGE)
    )


def estimate_jitter(pair: FrameMatches) -> float:
    """Estimate the scatter of static keypoints in each direction, pixels; a minimum if almost none is static."""
    displacement = np.linalg.norm(pair.pixels_i - pair.pixels_j, axis=1)
    near = displacement[displacement < MAX_STATIC_PX]
    # A slowly moving object shows all these displacements equally often.
    is_slow = np.count_nonzero(near < MAX_STATIC_PX / 2) <= MIN_STATIC_RATIO * len(near)
    return MIN_NOISE_PX if is_slow else max(float(np.median(near)) / RAYLEIGH_MEDIAN, MIN_NOISE_PX)


def estimate_first_motion(
    executor: CameraExecutor,
    rig: Rig,
    pairs: Sequence[Sequence[FrameMatches]],
    first_number: int,
    rng: np.random.Generator,
) -> FirstMotion:
    """Estimate the motion since the frame with the number `first_number`, from its moving matches.

    Args:
        pairs: per camera, local: matches.
    """
    matches = sum(
        executor.all_gather(lambda c: sum(len(pair) for pair in pairs[c] if pair.reference == first_number), 0)
    )
    first_pairs = executor.map_cameras(lambda c: [pair for pair in pairs[c] if pair.reference == first_number])
    jitter = executor.map_cameras(lambda c: [estimate_jitter(pair) for pair in first_pairs[c]])

    def select_moving(c: int) -> list[FrameMatches]:
        return [
            pair.subset(~find_static(pair, compute_static_px(px)))
            for pair, px in zip(first_pairs[c], jitter[c], strict=True)
        ]

    moving = executor.map_cameras(select_moving)

    def create_reports(c: int) -> InitialMatches:
        reports = [
            MovingMatches(
                pair.to_term(c, rig.cameras[c]),
                np.linalg.norm(pair.pixels_i - pair.pixels_j, axis=1),
                px,
                len(all_matches) - len(pair),
            )
            for pair, all_matches, px in zip(moving[c], first_pairs[c], jitter[c], strict=True)
            if len(pair)
        ]
        return InitialMatches(tuple(reports))

    records = [found.reports for found in executor.all_gather(create_reports, InitialMatches())]
    terms = [[record.term for record in of_camera] for of_camera in records]
    data, undefined_point = gather_terms(terms), np.full(3, np.nan)
    failure_status = FrameStatus.TOO_FEW_MATCHES if matches < MIN_MATCHES else FrameStatus.NO_MOTION
    if sum(map(len, data)) > max(MIN_MATCHES, OUTLIER_RATIO * matches):
        failure_status = FrameStatus.NOT_CONSISTENT
    if not data:
        fit = make_failed_fit(data, Status.TOO_FEW_MATCHES)
        return FirstMotion(
            fit,
            undefined_point,
            undefined_point,
            np.nan,
            0,
            np.nan,
            0,
            False,
            False,
            failure_status,
            executor.map_cameras(lambda _: []),
        )
    center, radius = locate_object(data)
    fit = fit_terms(data, center, radius, [], rng)
    flat_reports = [record for of_camera in records for record in of_camera]
    is_consistent = ~_find_poor_terms(fit, flat_reports)
    if 2 <= is_consistent.sum() < len(is_consistent):
        # In the other cameras, inliers are static keypoints with the largest jitter.
        consistent_terms = [term for term, consistent in zip(data, is_consistent, strict=True) if consistent]
        center, radius = locate_object(consistent_terms)
        fit = _expand_fit(fit_terms(consistent_terms, center, radius, [], rng), data, is_consistent)
    detects_motion, is_likelier = _test_significance(fit, flat_reports)
    match_weights = scatter_fit(fit, terms)
    inliers = [
        (term.subset(w > 0), record.displacement_px[w > 0])
        for term, record, w in zip(data, flat_reports, fit.weights, strict=True)
    ]
    inliers = [(term, shift) for term, shift in inliers if len(term)]
    inlier_center, size = locate_object([term for term, _ in inliers]) if inliers else (undefined_point, np.nan)
    displacement = np.concatenate([np.empty(0), *(shift for _, shift in inliers)])
    n_cameras = int(detects_motion.sum())
    return FirstMotion(
        fit,
        center,
        inlier_center,
        size,
        len(displacement),
        float(np.median(displacement)) if len(displacement) else np.nan,
        n_cameras,
        is_likelier and n_cameras >= min(2, len(rig)),
        fit.status is Status.OK and classify_observability(fit, size)[0].status is Status.OK,
        failure_status,
        executor.map_cameras(
            lambda c: select_inliers([pair for pair in moving[c] if len(pair)], [w for w, _ in match_weights[c]])
        ),
    )


def _find_poor_terms(fit: Fit, reports: Sequence[MovingMatches]) -> BoolArray:
    """Return the cameras (T,) in which a fit leaves much of its inliers' displacement unexplained."""
    is_poor = np.zeros(len(reports), bool)
    for t, (record, w, across) in enumerate(zip(reports, fit.weights, fit.residuals, strict=True)):
        good = w > 0
        if good.any():
            rms = float(np.sqrt(np.mean(across[good] ** 2)))
            is_poor[t] = rms > MAX_RESIDUAL_RATIO * float(np.median(record.displacement_px[good]))
    return is_poor


def _expand_fit(fit: Fit, data: Sequence[TermData], is_chosen: BoolArray) -> Fit:
    """Extend a fit to the chosen terms (T,) to all terms; the others get no inliers."""
    weights, residuals = iter(fit.weights), iter(fit.residuals)
    zero_arrays = [np.zeros(len(term)) for term in data]
    return fit.with_matches(
        [next(weights) if chosen else zeros for zeros, chosen in zip(zero_arrays, is_chosen, strict=True)],
        [next(residuals) if chosen else zeros for zeros, chosen in zip(zero_arrays, is_chosen, strict=True)],
    )


def _test_significance(fit: Fit, reports: Sequence[MovingMatches]) -> tuple[BoolArray, bool]:
    """Test whether a fit is significant against keypoint noise and random displacements.

    A displacement of length d in a random direction has the density 1 / (π √(d² - r²)) of a component r. A rigid
    motion, which predicts the match's epipolar line, has a Gaussian density of the residual r.

    Returns:
        (T,) cameras that detect a motion beyond the noise of static keypoints; whether a rigid motion is likelier than
        independent displacements of the matches.
    """
    log_gain, detects_motion = 0.0, np.zeros(len(reports), bool)
    for t, (record, w, across) in enumerate(zip(reports, fit.weights, fit.residuals, strict=True)):
        good = w > 0
        if not good.any():
            continue
        r, translation = np.abs(across[good]), record.displacement_px[good]
        sigma = max(MIN_NOISE_PX, record.jitter_px, float(np.sqrt(np.mean(r**2))))
        by_chance = 1.0 / (np.pi * np.sqrt(np.maximum(translation**2 - r**2, sigma**2)))
        motion = np.exp(-0.5 * (r / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
        gain = float(np.log(motion / by_chance).sum()) - MIN_LOG_GAIN_PER_UNKNOWN * SURFACE_UNKNOWNS
        is_displaced = float(np.median(translation)) > max(
            MIN_DISPLACEMENT_PX, MIN_DISPLACEMENT_SIGMAS * record.jitter_px
        )
        detects_motion[t] = good.sum() >= MIN_SIGNIFICANT_MATCHES and is_displaced and gain > 0
        log_gain += gain
    return detects_motion, log_gain > MIN_LOG_GAIN_PER_UNKNOWN * MOTION_UNKNOWNS


def is_ambiguous(
    executor: CameraExecutor,
    rig: Rig,
    pairs: Sequence[Sequence[FrameMatches]],
    first_number: int,
    initial_motion: FirstMotion,
    rng: np.random.Generator,
) -> bool:
    """Return whether something else moved as a rigid body, with nearly as many inliers.

    Args:
        pairs: per camera, local: all matches since the frame with the number `first_number`.
        initial_motion: the motion accepted as the object's.
    """

    def select_others(c: int) -> list[FrameMatches]:
        object_indices = np.concatenate(
            [np.empty(0, np.int64), *(pair.indices[:, 0] for pair in initial_motion.inliers[c])]
        )
        return [pair.subset(~np.isin(pair.indices[:, 0], object_indices)) for pair in pairs[c]]

    other = estimate_first_motion(executor, rig, executor.map_cameras(select_others), first_number, rng)
    return (
        other.fit.status is Status.OK
        and other.is_significant
        and other.n_inliers > AMBIGUITY_RATIO * initial_motion.n_inliers
    )
