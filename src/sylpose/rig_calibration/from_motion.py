"""Calibration of a rig from any moving rigid object: no board, no point observed by two cameras.

Each camera tracks the object alone (`camera_tracks`), relative motions give the extrinsics (`relative_motions`), and a
joint bundle adjustment refines them (`motion_bundle`). Whatever the motion does not determine is refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.bundle_adjustment.calibration_refinement import (
    N_CAMERA_PARAMETERS,
    N_LENS_PARAMETERS,
    ImplausibleLensError,
)
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.rig import Camera, Rig
from sylpose.rig_calibration.camera_tracks import RefinedTrack
from sylpose.rig_calibration.free_flight import FreeFlight
from sylpose.rig_calibration.instants import collect_instants, estimate_delays, move_to_frames, synchronize_tracks
from sylpose.rig_calibration.lens_errors import (
    LENS_WORDS,
    compute_consider_covariance,
    find_wrong_parameters,
    measure_lens_errors,
)
from sylpose.rig_calibration.motion_bundle import (
    FIXED_SD,
    LENS_COLUMNS,
    JointBundle,
    bundle_jointly,
    make_lens_prior,
)
from sylpose.rig_calibration.relative_motions import (
    MotionRefusedError,
    MotionTest,
    RelativeExtrinsics,
    add_test,
    solve_relative_extrinsics,
)
from sylpose.rig_calibration.result import Coverage, HalvesTest, RigCalibration
from sylpose.status import Status

# Noise of a camera in the joint refinement relative to its own track, above which the instants of the images are estimated
# (measured: docs/calibrating.md, 0.98 to 1.02 for sound ones), and above which a camera contradicts the others (measured:
# there, up to 1.4 for sound webcams, from 2.7 for a wrong track); share of the inliers of its own track that must remain
# (choice).
CLEAR_NOISE_RATIO, MAX_NOISE_RATIO, MIN_INLIER_RATIO = 1.1, 1.5, 0.8
# Rounds of instants and refinement at most, and the relative decrease of the noise below which a round is discarded as
# the last (choice).
MAX_INSTANT_ROUNDS, NOISE_TOLERANCE = 6, 0.02
# A parameter of a lens whose standard deviation exceeds this share of its prior's is not determined (choice: the motion has
# as much information as the prior).
MAX_LENS_SD_RATIO = 0.7
# Largest standard deviation of an accepted camera: radians about the worst axis, and share of the distance to the object
# (choice: three of them are a degree, and 5 %).
MAX_ROTATION_SD, MAX_PLACE_SD = np.radians(1.0) / 3.0, 0.05 / 3.0


@dataclass(frozen=True, eq=False)
class MotionCalibration:
    """Rig calibrated from a moving object.

    Attributes:
        calibration: the rig, of the cameras that were used, with its uncertainty; lengths are relative.
        tests: what was tested, all passed.
        left_out: names of cameras that are not in the rig, each with the reason.
        distance: mean distance of the first camera from the object.
        object_length: longest extent of the object's observed surface, in the same unit.
        freed: what was estimated of the lenses.
        covariance: (10 C, 10 C) of all cameras' errors relative to the first: by camera (w, d) of its pose, R = exp(w) R̂
            and d of its center in world axes, and its lens (`CalibrationPrior`); for the scale that keeps the rms distance
            of the cameras from the first, or as `rescale` sets it.
        coverage: of each camera's image.
        halves: comparison of calibrations from each half of the landmarks; None if one does not converge.
        times: (N,) seconds, of the frames in which the object was observed.
        reference_from_object: N poses of the object in them, in the first camera's axes and the lengths before `rescale`.
        flight: throws, in the same; None if they did not set the scale.
    """

    calibration: RigCalibration
    tests: tuple[MotionTest, ...]
    left_out: Mapping[str, str]
    distance: float
    object_length: float
    freed: tuple[str, ...]
    covariance: FloatArray
    coverage: tuple[Coverage, ...]
    halves: HalvesTest | None
    times: FloatArray
    reference_from_object: RigidTransform
    flight: FreeFlight | None = None


def calibrate_from_motion(
    cameras: Sequence[Camera],
    tracks: Sequence[RefinedTrack | None],
    free: Sequence[str] = (),
    *,
    is_timed: bool = True,
) -> MotionCalibration:
    """Calibrate a rig from its cameras' own tracks of one moving object.

    Args:
        cameras: C cameras with their lenses; their poses are not used.
        tracks: C tracks (`refine_track`); None for a camera that could not track the object.
        free: what is estimated of each lens: some of "focal", "principal", "distortion"; "fov" if focal lengths come
            from a field of view. What the motion contradicts of those given is estimated as well.
        is_timed: whether the tracks' times are in seconds; else they are in frames.

    Raises:
        MotionRefusedError: the motion does not determine the rig.
    """
    left_out = {
        camera.name: "it could not track the object" for camera, its in zip(cameras, tracks, strict=True) if its is None
    }
    observed = [its for its in tracks if its is not None]
    known = [camera for camera, its in zip(cameras, tracks, strict=True) if its is not None]
    recording = _Recording(known, observed, synchronize_tracks(observed) if observed else [], is_timed)
    found = _calibrate_consistent(recording, dict.fromkeys(free, ""))
    joint, warnings = found.fit.joint, [*found.warnings]
    noisy = int(np.argmax(joint.noise_ratio))
    if joint.noise_ratio[noisy] > CLEAR_NOISE_RATIO:
        warnings.append(
            f"{joint.rig[noisy].name} has {joint.noise_ratio[noisy]:.1f} times the noise of its own track: time stamps or "
            "lenses are inexact"
        )
    halves = _compare_halves(recording, found, joint)
    if halves is not None and halves.is_significant.any():
        worst = int(np.argmax(halves.ratio))
        warnings.append(
            f"calibrations from each half of the landmarks differ by more than their standard deviations, "
            f"{joint.rig[worst].name} by {np.degrees(halves.rotation[worst]):.2g} degrees: record more frames, with more of "
            "the object's sides"
        )
    used = recording.select_observed(found.start)
    return MotionCalibration(
        _make_calibration(found.fit, used, warnings),
        found.tests,
        {**left_out, **found.start.left_out},
        joint.distance,
        joint.object_length,
        tuple(found.fit.freed),
        found.fit.covariance,
        joint.coverage,
        halves,
        np.nanmean(collect_instants(used, found.start.frames), axis=1),
        joint.reference_from_object,
    )


@dataclass(frozen=True, eq=False)
class _Recording:
    """Cameras that track the object, their tracks as observed, and moved to common instants by their time stamps.

    `is_timed` is that of `calibrate_from_motion`.
    """

    cameras: Sequence[Camera]
    observed: Sequence[RefinedTrack]
    synchronized: Sequence[RefinedTrack]
    is_timed: bool

    def select_observed(self, start: RelativeExtrinsics) -> list[RefinedTrack]:
        """Return the tracks of the used cameras as observed, in the frames that have a pose."""
        return [self.observed[k].restrict(start.frames) for k in start.cameras]

    def select_synchronized(self, start: RelativeExtrinsics) -> list[RefinedTrack]:
        """Return the tracks of the used cameras at common instants, in the frames that have a pose."""
        return [self.synchronized[k].restrict(start.frames) for k in start.cameras]


# What is estimated of the lenses, each with a sentence on why, "" if that was requested.
_Freed = Mapping[str, str]


@dataclass(frozen=True, eq=False)
class _Fit:
    """Joint refinement of tracks.

    Attributes:
        joint: the refinement; its covariance is that for exact lenses, but for what is estimated of them.
        covariance: as that, with possible errors of the lenses.
        tracks: at common instants.
        freed: what is estimated of the lenses.
        warnings: what was estimated besides, and what is missing.
    """

    joint: JointBundle
    covariance: FloatArray
    tracks: tuple[RefinedTrack, ...]
    freed: _Freed
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Consistent:
    """Calibration of cameras that agree, with the tests passed, and what was done to reach it, in words."""

    start: RelativeExtrinsics
    fit: _Fit
    tests: tuple[MotionTest, ...]
    warnings: tuple[str, ...]


def _calibrate_consistent(recording: _Recording, free: _Freed) -> _Consistent:
    """Calibrate the cameras that pass all tests together; those that contradict the others are left out.

    Raises:
        MotionRefusedError: no two cameras pass; the error is that of all cameras together.
    """
    excluded, refusal = dict[str, str](), None
    while True:
        fit = None
        try:
            start = _relate_cameras(recording, excluded)
            tests, fit = [*start.tests], _fit(recording, start, free)
            _test_consistency(fit, [*tests])
            assert fit is not None
            start, fit, admitted = _admit_cameras(recording, start, fit, free)
            _test_consistency(fit, tests)
            _test_uncertainty(fit.joint, tests)
        except MotionRefusedError as error:
            refusal, failed = refusal or error, error.tests[-1]
            if fit is None or len(fit.joint.rig) < 3:
                raise refusal from None
            problem = "it contradicts the others"
            if failed.name.startswith("uncertainty"):
                # Fewer cameras may not reveal what is wrong with the lenses.
                free, problem = fit.freed, "a test fails with it"
            name = fit.joint.rig[find_least_consistent(fit.joint)].name
            if name in excluded:  # and admitted again
                raise refusal from None
            excluded[name] = f"{problem} ({failed.name}: {failed.value})"
        else:
            reasons = [reason for reason in fit.freed.values() if reason]
            return _Consistent(start, fit, tuple(tests), (*reasons, *fit.warnings, *admitted))


def _admit_cameras(
    recording: _Recording, start: RelativeExtrinsics, fit: _Fit, free: _Freed
) -> tuple[RelativeExtrinsics, _Fit, tuple[str, ...]]:
    """Add cameras that were left out, where the joint refinement with them is sound."""
    admitted = list[str]()
    for name, reason in start.left_out.items():
        index = [camera.name for camera in recording.cameras].index(name)
        extended = _extend(start, recording.synchronized[index], index, fit.joint)
        trial = None if extended is None else _fit(recording, extended, free)
        if extended is not None and trial is not None and _is_sound(trial.joint):
            left_out = {other: why for other, why in start.left_out.items() if other != name}
            start, fit = replace(extended, left_out=left_out), trial
            admitted.append(f"{name} was added by the joint refinement, although {reason}")
    if start.cameras != tuple(sorted(start.cameras)):
        start = _sort_cameras(start)
        refit = _fit(recording, start, free)
        _test_consistency(refit, [])
        assert refit is not None
        fit = refit
    return start, fit, tuple(admitted)


def _sort_cameras(start: RelativeExtrinsics) -> RelativeExtrinsics:
    """Return extrinsics with the cameras in the recording's order; the first of them may not be the reference."""
    order = np.argsort(start.cameras)
    return replace(
        start,
        cameras=tuple(sorted(start.cameras)),
        camera_from_reference=start.camera_from_reference[order],
        scales=start.scales[order],
        object_axes=start.object_axes[order],
        rotation_sd=start.rotation_sd[order],
        scale_sd=start.scale_sd[order],
    )


def _relate_cameras(recording: _Recording, excluded: Mapping[str, str]) -> RelativeExtrinsics:
    """Solve the extrinsics of all cameras but some from relative motions."""
    kept = [k for k, camera in enumerate(recording.cameras) if camera.name not in excluded]
    found = solve_relative_extrinsics([recording.synchronized[k].track for k in kept])
    cameras = tuple(kept[c] for c in found.cameras)
    return replace(found, cameras=cameras, left_out={**found.left_out, **excluded})


def find_least_consistent(joint: JointBundle) -> int:
    """Return the camera with too few inliers, or the most noise relative to its own track; else the least known one.

    A camera is as well known as its rotation from the median of the others, which does not depend on the reference.
    """
    if joint.inlier_ratio.min() <= MIN_INLIER_RATIO:
        return int(np.argmin(joint.inlier_ratio))
    if joint.worst_noise_ratio > CLEAR_NOISE_RATIO:
        return int(np.argmax(joint.noise_ratio))
    n = len(joint.rig)
    blocks = joint.covariance.reshape(n, N_CAMERA_PARAMETERS, n, N_CAMERA_PARAMETERS)[:, :3, :, :3].swapaxes(1, 2)
    # Rotations in the axes of the first camera.
    R = np.array([camera.rotation for camera in joint.rig])
    blocks = np.einsum("aji,abjk,bkl->abil", R, blocks, R, optimize=True)
    own = np.einsum("aaij->aij", blocks)
    relative = np.trace(own[:, None] + own - blocks - blocks.swapaxes(2, 3), axis1=2, axis2=3)
    return int(np.argmax([np.median(np.delete(relative[c], c)) for c in range(n)]))


def _fit(recording: _Recording, start: RelativeExtrinsics, free: _Freed) -> _Fit | None:
    """Refine with the simplest model that explains the observations; None if that does not converge."""
    cameras = [recording.cameras[k] for k in start.cameras]
    fit = _fit_lenses(cameras, recording.select_synchronized(start), start, free)
    if fit is None or fit.joint.worst_noise_ratio <= CLEAR_NOISE_RATIO:
        return fit
    # Lenses may have been estimated because the time stamps are wrong.
    as_given = fit.joint if fit.freed is free else _bundle(cameras, fit.tracks, start, free)
    timed = None if as_given is None else _fit_instants(recording, start, free, as_given)
    is_better = timed is not None and CLEAR_NOISE_RATIO * timed.joint.worst_noise_ratio < fit.joint.worst_noise_ratio
    return timed if is_better else fit


def _fit_lenses(
    cameras: Sequence[Camera], tracks: Sequence[RefinedTrack], start: RelativeExtrinsics, free: _Freed
) -> _Fit | None:
    """Refine; also those parameters of the lenses that the motion contradicts."""
    while True:
        uncertain = _bundle(cameras, tracks, start, free, is_exact=False)
        errors = None if uncertain is None else measure_lens_errors(cameras, uncertain, [*free])
        wrong = {} if errors is None else dict(find_wrong_parameters([its.name for its in cameras], errors))
        if not wrong:
            break
        free = {**free, **wrong}
    joint = _bundle(cameras, tracks, start, free)
    if joint is None:
        return None
    if errors is None:
        warning = "standard deviations do not include errors of the lenses: their refinement did not converge"
        return _Fit(joint, joint.covariance, tuple(tracks), free, (warning,))
    return _Fit(joint, joint.covariance + compute_consider_covariance(errors), tuple(tracks), free, ())


def _fit_instants(recording: _Recording, start: RelativeExtrinsics, free: _Freed, joint: JointBundle) -> _Fit | None:
    """Refine with instants of all images that are estimated as well, from a refinement at the time stamps.

    None if the noise does not fall.
    """
    cameras, tracks = [recording.cameras[k] for k in start.cameras], recording.select_observed(start)
    stamps = collect_instants(tracks, start.frames)
    times, instants, moved = np.nanmean(stamps, axis=1), stamps, tracks
    for _ in range(MAX_INSTANT_ROUNDS):
        later = instants + estimate_delays(joint, times)
        trial = move_to_frames(tracks, cameras, start.frames, times, later, joint)
        refined = _bundle(cameras, trial, start, free)
        if refined is None or refined.worst_noise_ratio > (1.0 - NOISE_TOLERANCE) * joint.worst_noise_ratio:
            break
        joint, instants, moved = refined, later, trial
    if moved is tracks:
        return None
    fit = _fit_lenses(cameras, moved, start, free)
    if fit is None:
        return None
    errors = np.sqrt(np.nanmean((instants - stamps) ** 2, axis=0))
    worst = int(np.argmax(errors))
    error = f"{1e3 * errors[worst]:.2g} ms" if recording.is_timed else f"{errors[worst]:.2g} frames"
    warning = (
        "the instants of the images were estimated, since the motion contradicts their time stamps: "
        f"{cameras[worst].name} by {error}"
    )
    return replace(fit, warnings=(warning, *fit.warnings))


def _bundle(
    cameras: Sequence[Camera],
    tracks: Sequence[RefinedTrack],
    start: RelativeExtrinsics,
    free: _Freed,
    *,
    is_exact: bool = True,
) -> JointBundle | None:
    """Refine jointly; None if that does not converge."""
    try:
        joint = bundle_jointly(cameras, tracks, start, [*free], is_exact=is_exact)
    except (ImplausibleLensError, np.linalg.LinAlgError):
        return None
    return joint if joint.status is Status.OK else None


def _compare_halves(recording: _Recording, found: _Consistent, joint: JointBundle) -> HalvesTest | None:
    """Calibrate from each half of the landmarks and compare; None if one does not converge.

    Args:
        recording: the cameras.
        found: what is used of it.
        joint: the calibration from all landmarks: the difference has four times its covariance.
    """
    cameras, rigs = [recording.cameras[k] for k in found.start.cameras], []
    for half in (0, 1):
        parts = []
        for its in found.fit.tracks:
            parts.append(replace(its, observations=its.observations.select(its.observations.landmark % 2 == half)))
        trial = _bundle(cameras, parts, found.start, found.fit.freed)
        if trial is None:
            return None
        rigs.append(trial.rig)
    centers = [np.array([camera.center for camera in rig]) for rig in (joint.rig, *rigs)]
    # Each in the scale of the whole, by the rms distance of the cameras from the first.
    sizes = [np.sqrt((its**2).sum()) for its in centers]
    a, b = (its * (sizes[0] / size) for its, size in zip(centers[1:], sizes[1:], strict=True))
    w = np.array(
        [(x.camera_from_world * y.camera_from_world.inv()).rotation.as_rotvec() for x, y in zip(*rigs, strict=True)]
    )
    ratio, is_significant = np.ones(len(cameras)), np.zeros(len(cameras), bool)
    for c in range(1, len(cameras)):
        pose = slice(c * N_CAMERA_PARAMETERS, c * N_CAMERA_PARAMETERS + 6)
        difference, inverse = np.concatenate([w[c], a[c] - b[c]]), np.linalg.pinv(4.0 * joint.covariance[pose, pose])
        square = float(difference @ inverse @ difference)
        ratio[c], is_significant[c] = square / 6.0, square > chi_squared_bound(6)
    w[0], position = 0.0, np.linalg.norm(a - b, axis=1)
    position[0] = 0.0
    return HalvesTest(np.linalg.norm(w, axis=1), position, np.full(len(w), np.nan), ratio, is_significant)


def measure_worst_sds(joint: JointBundle) -> tuple[FloatArray, FloatArray]:
    """Return (C,) standard deviations about the worst axis, radians, and along it, relative to the distance."""
    starts = range(0, len(joint.covariance), N_CAMERA_PARAMETERS)
    rotation, place = (
        np.sqrt([max(np.linalg.eigvalsh(joint.covariance[k : k + 3, k : k + 3])[-1], 0.0) for k in rows])
        for rows in (starts, [k + 3 for k in starts])
    )
    return rotation, place / joint.distance


def _is_sound(joint: JointBundle) -> bool:
    """Return whether all cameras of a refinement agree, and the last one is determined."""
    rotation, place = measure_worst_sds(joint)
    return bool(
        joint.worst_noise_ratio < MAX_NOISE_RATIO
        and joint.inlier_ratio.min() > MIN_INLIER_RATIO
        and rotation[-1] < MAX_ROTATION_SD
        and place[-1] < MAX_PLACE_SD
    )


def _test_consistency(fit: _Fit | None, tests: list[MotionTest]) -> None:
    """Test whether the refinement converged, and all cameras agree.

    Raises:
        MotionRefusedError: they are not.
    """
    add_test(
        tests,
        "joint refinement",
        fit is not None,
        "not converged" if fit is None else "converged",
        "convergence",
        "record more frames, in which the object rotates by 30 degrees and more and is carried about",
    )
    assert fit is not None
    joint, names = fit.joint, fit.joint.rig.names
    noisy, poor = int(np.argmax(joint.noise_ratio)), int(np.argmin(joint.inlier_ratio))
    add_test(
        tests,
        "noise, cameras together",
        joint.noise_ratio[noisy] < MAX_NOISE_RATIO,
        f"{joint.noise_ratio[noisy]:.2f} of their own ({names[noisy]})",
        f"below {MAX_NOISE_RATIO:g}",
        f"{names[noisy]} contradicts the others: check its intrinsics and time stamps, or estimate the lenses "
        "(--free focal,principal,distortion)",
    )
    add_test(
        tests,
        "inliers, cameras together",
        joint.inlier_ratio[poor] > MIN_INLIER_RATIO,
        f"{joint.inlier_ratio[poor]:.0%} of their own ({names[poor]})",
        f"{MIN_INLIER_RATIO:.0%}",
        f"{names[poor]} contradicts the others: check that it observes the same object, and its intrinsics",
    )


def _test_uncertainty(joint: JointBundle, tests: list[MotionTest]) -> None:
    """Test whether standard deviations are small.

    Raises:
        MotionRefusedError: they are not.
    """
    names = joint.rig.names
    rotation, place = measure_worst_sds(joint)
    r, p = int(np.argmax(rotation)), int(np.argmax(place))
    add_test(
        tests,
        "uncertainty of rotations",
        rotation[r] < MAX_ROTATION_SD,
        f"{np.degrees(rotation[r]):.2g} degrees ({names[r]})",
        f"{np.degrees(MAX_ROTATION_SD):.2g} degrees",
        "rotate the object by more, about all axes",
    )
    add_test(
        tests,
        "uncertainty of places",
        place[p] < MAX_PLACE_SD,
        f"{place[p]:.1%} of the distance ({names[p]})",
        f"{MAX_PLACE_SD:.1%}",
        "carry the object about by more than its own size, besides rotating it",
    )


def _extend(
    start: RelativeExtrinsics, track: RefinedTrack, index: int, joint: JointBundle
) -> RelativeExtrinsics | None:
    """Return the extrinsics with one more camera, related to the refined poses of the object; None if it cannot be."""
    frames, rows, _ = np.intersect1d(start.frames, track.track.frames, return_indices=True)
    # The poses of all cameras together are more precise than its own.
    variance = max(float(np.median(track.track.variance)), 1e-12)
    rig = replace(
        track.track,
        name="rig",
        frames=frames,
        camera_from_object=joint.reference_from_object[rows],
        rotation_covariance=np.tile(variance * np.eye(3), (len(rows), 1, 1)),
    )
    try:
        found = solve_relative_extrinsics([rig, track.track], min_agreeing=0.0)
    except MotionRefusedError:
        return None
    return replace(
        start,
        cameras=(*start.cameras, index),
        camera_from_reference=RigidTransform.concatenate([start.camera_from_reference, found.camera_from_reference[1]]),
        scales=np.append(start.scales, found.scales[1]),
        object_axes=RigidTransform.concatenate([start.object_axes, found.object_axes[1]]),
        rotation_sd=np.append(start.rotation_sd, found.rotation_sd[1]),
        scale_sd=np.append(start.scale_sd, found.scale_sd[1]),
    )


def rescale(
    found: MotionCalibration, factor: float, unit: str, *, exact: tuple[str, str] | None = None, sd: float = 0.0
) -> MotionCalibration:
    """Return a calibration with lengths times a factor, in a unit.

    Args:
        found: the calibration, in the axes of its first camera.
        factor: the factor.
        unit: unit of the result.
        exact: names of two cameras whose distance is known.
        sd: relative standard deviation of the factor.
    """
    cameras = []
    for camera in found.calibration.rig:
        pose = camera.camera_from_world
        scaled = RigidTransform.from_components(factor * pose.translation, pose.rotation)
        cameras.append(replace(camera, camera_from_world=scaled))
    rig, n = Rig(cameras, unit), len(cameras)
    lengths = np.ones((n, N_CAMERA_PARAMETERS))
    lengths[:, 3:6] = factor
    stretch = np.zeros((n, N_CAMERA_PARAMETERS))
    stretch[:, 3:6] = [camera.center for camera in rig]
    J = np.diag(lengths.ravel())
    if exact is not None:
        a, b = map(rig.names.index, exact)
        gradient = np.zeros((n, N_CAMERA_PARAMETERS))
        gradient[a, 3:6] = rig[a].center - rig[b].center
        gradient[b, 3:6] = -gradient[a, 3:6]
        J = J - np.outer(stretch, gradient.ravel() @ J) / (gradient.ravel() @ stretch.ravel())
    covariance = J @ found.covariance @ J.T + sd**2 * np.outer(stretch, stretch)
    blocks = _extrinsics_covariance(rig, covariance)
    calibration = replace(found.calibration, rig=rig, extrinsics_covariance=blocks)
    halves = None if found.halves is None else replace(found.halves, position=factor * found.halves.position)
    distance, length = factor * found.distance, factor * found.object_length
    return replace(
        found, calibration=calibration, distance=distance, object_length=length, covariance=covariance, halves=halves
    )


def locate(found: MotionCalibration, rig: Rig) -> MotionCalibration:
    """Return a calibration with its rig in another world, and the axes and unit of the covariance as well.

    Args:
        found: the calibration.
        rig: the same cameras there.
    """
    old, new = (np.array([camera.center for camera in its]) for its in (found.calibration.rig, rig))
    factor = float(np.linalg.norm(new - new[0]) / np.linalg.norm(old - old[0]))
    J, axes = np.eye(len(found.covariance)), factor * rig[0].rotation.T @ found.calibration.rig[0].rotation
    for k in range(3, len(J), N_CAMERA_PARAMETERS):
        J[k : k + 3, k : k + 3] = axes
    covariance = J @ found.covariance @ J.T
    calibration = replace(found.calibration, rig=rig, extrinsics_covariance=_extrinsics_covariance(rig, covariance))
    halves = None if found.halves is None else replace(found.halves, position=factor * found.halves.position)
    distance, length = factor * found.distance, factor * found.object_length
    return replace(
        found, calibration=calibration, distance=distance, object_length=length, covariance=covariance, halves=halves
    )


def _make_calibration(fit: _Fit, tracks: Sequence[RefinedTrack], warnings: Sequence[str]) -> RigCalibration:
    """Make the calibration, with covariances in the conventions of `RigCalibration`."""
    joint, freed, lenses = fit.joint, tuple(fit.freed), list[FloatArray]()
    for c, camera in enumerate(joint.rig):
        lens = slice(c * N_CAMERA_PARAMETERS + 6, (c + 1) * N_CAMERA_PARAMETERS)
        L = np.zeros((4 + len(camera.distortion), N_LENS_PARAMETERS))
        L[[0, 1], 0] = camera.matrix[[0, 1], [0, 1]]
        L[[2, 3, 4], [1, 2, 3]] = 1.0
        L[:, make_lens_prior(camera, freed) <= FIXED_SD * camera.size[0]] = 0.0
        lenses.append(L @ fit.covariance[lens, lens] @ L.T)
    views = np.array([len(its.track.frames) for its in tracks])
    rms = np.sqrt(2.0) * joint.sigma_px
    extrinsics = _extrinsics_covariance(joint.rig, fit.covariance)
    unobservable = tuple(find_unobservable(joint, freed))
    return RigCalibration(
        joint.rig, extrinsics, tuple(lenses), views, joint.n_points, rms, unobservable, tuple(warnings)
    )


def find_unobservable(joint: JointBundle, freed: Sequence[str]) -> Iterator[str]:
    """Yield a sentence per camera whose lens the motion does not determine: it stayed at its prior."""
    sds = np.sqrt(np.maximum(np.diag(joint.covariance), 0.0)).reshape(-1, N_CAMERA_PARAMETERS)[:, 6:]
    for camera, own in zip(joint.rig, sds, strict=True):
        prior = make_lens_prior(camera, freed)
        is_free = (own > MAX_LENS_SD_RATIO * prior) & (prior > FIXED_SD * camera.size[0])
        stayed = dict.fromkeys(LENS_WORDS[name][0] for name, its in zip(LENS_COLUMNS, is_free, strict=True) if its)
        if stayed:
            yield f"{camera.name}: the motion does not determine {' and '.join(stayed)}, which stayed as given or guessed"


def _extrinsics_covariance(rig: Rig, covariance: FloatArray) -> FloatArray:
    """Return (C, 6, 6) covariances in the conventions of `RigCalibration` from those of `MotionCalibration`."""
    blocks = np.zeros((len(rig), 6, 6))
    for c, camera in enumerate(rig):
        pose = slice(c * N_CAMERA_PARAMETERS, c * N_CAMERA_PARAMETERS + 6)
        # t = -R o: its error is w x t - R d.
        J = np.eye(6)
        J[3:, :3], J[3:, 3:] = -np.cross(np.eye(3), camera.camera_from_world.translation), -camera.rotation
        blocks[c] = J @ covariance[pose, pose] @ J.T
        # A known distance has no variance, which must not become negative by rounding.
        np.fill_diagonal(blocks[c], np.maximum(np.diag(blocks[c]), 0.0))
    return blocks
