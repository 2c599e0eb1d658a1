"""Calibration of a rig from any moving rigid object: no board, no point observed by two cameras.

Each camera tracks the object alone (`camera_tracks`), relative motions give the extrinsics (`relative_motions`), and a
joint bundle adjustment refines them (`motion_bundle`). Whatever the motion does not determine is refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.bundle_adjustment.calibration_refinement import N_LENS_PARAMETERS
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, Rig
from sylpose.rig_calibration.camera_tracks import RefinedTrack
from sylpose.rig_calibration.motion_bundle import N_CAMERA_PARAMETERS, JointBundle, bundle_jointly
from sylpose.rig_calibration.relative_motions import (
    MotionRefusedError,
    MotionTest,
    RelativeExtrinsics,
    add_test,
    solve_relative_extrinsics,
)
from sylpose.rig_calibration.result import RigCalibration
from sylpose.status import Status

# Noise of a camera in the joint refinement relative to its own track, above which the cameras contradict each other
# (measured: docs/calibrating.md, 0.98 to 1.02 for sound ones, 1.1 to 1.8 with focal lengths 5 % wrong), and above which
# they are refused (choice); share of the inliers of its own track that must remain (choice).
CLEAR_NOISE_RATIO, MAX_NOISE_RATIO, MIN_INLIER_RATIO = 1.1, 3.0, 0.8
# Focal lengths are estimated if one differs by so many standard deviations from that given (choice: more than three,
# since standard deviations are up to 1.5 times too small).
FOCAL_SDS = 5.0
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
    """

    calibration: RigCalibration
    tests: tuple[MotionTest, ...]
    left_out: Mapping[str, str]
    distance: float
    object_length: float
    freed: tuple[str, ...]
    covariance: FloatArray

    def rescale(
        self, factor: float, unit: str, *, exact: tuple[str, str] | None = None, sd: float = 0.0
    ) -> MotionCalibration:
        """Return the same with lengths times a factor, in a unit.

        Args:
            factor: the factor.
            unit: unit of the result.
            exact: names of two cameras whose distance is known.
            sd: relative standard deviation of the factor.
        """
        cameras = []
        for camera in self.calibration.rig:
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
        covariance = J @ self.covariance @ J.T + sd**2 * np.outer(stretch, stretch)
        blocks = _extrinsics_covariance(rig, covariance)
        calibration = replace(self.calibration, rig=rig, extrinsics_covariance=blocks)
        distance, length = factor * self.distance, factor * self.object_length
        return replace(self, calibration=calibration, distance=distance, object_length=length, covariance=covariance)

    def locate(self, rig: Rig) -> MotionCalibration:
        """Return the same with its rig in another world, and the axes and unit of the covariance as well.

        Args:
            rig: the same cameras there.
        """
        old, new = (np.array([camera.center for camera in its]) for its in (self.calibration.rig, rig))
        factor = float(np.linalg.norm(new - new[0]) / np.linalg.norm(old - old[0]))
        J, axes = np.eye(len(self.covariance)), factor * rig[0].rotation.T @ self.calibration.rig[0].rotation
        for k in range(3, len(J), N_CAMERA_PARAMETERS):
            J[k : k + 3, k : k + 3] = axes
        covariance = J @ self.covariance @ J.T
        calibration = replace(self.calibration, rig=rig, extrinsics_covariance=_extrinsics_covariance(rig, covariance))
        distance, length = factor * self.distance, factor * self.object_length
        return replace(self, calibration=calibration, distance=distance, object_length=length, covariance=covariance)


def calibrate_from_motion(
    cameras: Sequence[Camera], tracks: Sequence[RefinedTrack | None], free: Sequence[str] = ()
) -> MotionCalibration:
    """Calibrate a rig from its cameras' own tracks of one moving object.

    Args:
        cameras: C cameras with their lenses; their poses are not used.
        tracks: C tracks (`refine_track`); None for a camera that could not track the object.
        free: what is estimated of each lens: some of "focal", "principal", "distortion". Focal lengths are also
            estimated if those given contradict the motion.

    Raises:
        MotionRefusedError: the motion does not determine the rig.
    """
    both = list(zip(cameras, tracks, strict=True))
    left_out = {camera.name: "it could not track the object" for camera, its in both if its is None}
    pairs = [(camera, its) for camera, its in both if its is not None]
    start = solve_relative_extrinsics([its.track for _, its in pairs])
    tests, warnings, freed = list(start.tests), list[str](), tuple(free)
    joint = _bundle(pairs, start, freed)
    if "focal" not in freed:
        other = _bundle(pairs, start, (*freed, "focal"))
        change = "" if other is None else _describe_focal_change([pairs[k][0] for k in start.cameras], other)
        if change:
            joint, freed = other, (*freed, "focal")
            warnings.append(f"focal lengths were estimated, since the motion contradicts those given: {change}")
    if joint is not None and joint.noise_ratio.max() > CLEAR_NOISE_RATIO:
        other = _bundle(pairs, start, (*freed, "offsets"))
        if other is not None and CLEAR_NOISE_RATIO * other.noise_ratio.max() < joint.noise_ratio.max():
            joint, freed = other, (*freed, "offsets")
            warnings.append("time offsets of the cameras were estimated: their time stamps contradict the motion")
    joint = _test_bundle(joint, tests)
    for name, reason in start.left_out.items():
        index = next(k for k, (camera, _) in enumerate(pairs) if camera.name == name)
        extended = _extend(start, pairs[index][1], index, joint)
        trial = None if extended is None else _bundle(pairs, extended, freed)
        if extended is not None and trial is not None and _is_sound(trial):
            joint, start = trial, extended
            warnings.append(f"{name} was added by the joint refinement, although {reason}")
        else:
            left_out[name] = reason
    noisy = int(np.argmax(joint.noise_ratio))
    if joint.noise_ratio[noisy] > CLEAR_NOISE_RATIO:
        warnings.append(
            f"{joint.rig[noisy].name} has {joint.noise_ratio[noisy]:.1f} times the noise of its own track: time stamps or "
            "lenses are inexact"
        )
    calibration = _make_calibration(joint, [pairs[k][1] for k in start.cameras], warnings)
    return MotionCalibration(
        calibration, tuple(tests), left_out, joint.distance, joint.object_length, freed, joint.covariance
    )


def _bundle(
    pairs: Sequence[tuple[Camera, RefinedTrack]], start: RelativeExtrinsics, free: Sequence[str]
) -> JointBundle | None:
    """Refine jointly; None if that does not converge."""
    cameras, tracks = zip(*(pairs[k] for k in start.cameras), strict=True)
    try:
        joint = bundle_jointly(cameras, tracks, start, free)
    except ValueError:  # a lens became implausible
        return None
    return joint if joint.status is Status.OK else None


def _describe_focal_change(cameras: Sequence[Camera], joint: JointBundle) -> str:
    """Describe the focal length that differs most from that given; "" if none does."""
    sds = np.sqrt(np.diag(joint.covariance)[6::N_CAMERA_PARAMETERS])
    changes = np.array([after.focal / before.focal - 1.0 for after, before in zip(joint.rig, cameras, strict=True)])
    worst = int(np.argmax(np.abs(changes) / sds))
    if not abs(changes[worst]) > FOCAL_SDS * sds[worst]:
        return ""
    return f"{joint.rig[worst].name} by {100 * changes[worst]:+.2g} ± {100 * sds[worst]:.1g} %"


def measure_worst_sds(joint: JointBundle) -> tuple[FloatArray, FloatArray]:
    """Return (C,) standard deviations about the worst axis, radians, and along it, relative to the distance."""
    starts = range(0, len(joint.covariance), N_CAMERA_PARAMETERS)
    rotation, place = (
        np.sqrt([max(np.linalg.eigvalsh(joint.covariance[k : k + 3, k : k + 3])[-1], 0.0) for k in rows])
        for rows in (starts, [k + 3 for k in starts])
    )
    return rotation, place / joint.distance


def _is_sound(joint: JointBundle | None) -> bool:
    """Return whether a joint refinement passes all tests."""
    try:
        _test_bundle(joint, [])
    except MotionRefusedError:
        return False
    return True


def _test_bundle(joint: JointBundle | None, tests: list[MotionTest]) -> JointBundle:
    """Test whether the refinement converged, all cameras agree, and standard deviations are small.

    Raises:
        MotionRefusedError: they are not.
    """
    add_test(
        tests,
        "joint refinement",
        joint is not None,
        "not converged" if joint is None else "converged",
        "convergence",
        "record more frames, in which the object rotates by 30 degrees and more and is carried about",
    )
    assert joint is not None
    names = joint.rig.names
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
    return joint


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


def _make_calibration(joint: JointBundle, tracks: Sequence[RefinedTrack], warnings: Sequence[str]) -> RigCalibration:
    """Make the calibration, with covariances in the conventions of `RigCalibration`."""
    lenses = []
    for c, camera in enumerate(joint.rig):
        lens = slice(c * N_CAMERA_PARAMETERS + 6, (c + 1) * N_CAMERA_PARAMETERS)
        L = np.zeros((4 + len(camera.distortion), N_LENS_PARAMETERS))
        L[[0, 1], 0] = camera.matrix[[0, 1], [0, 1]]
        L[[2, 3, 4], [1, 2, 3]] = 1.0
        lenses.append(L @ joint.covariance[lens, lens] @ L.T)
    views = np.array([len(its.track.frames) for its in tracks])
    rms = np.sqrt(2.0) * joint.sigma_px
    extrinsics = _extrinsics_covariance(joint.rig, joint.covariance)
    return RigCalibration(joint.rig, extrinsics, tuple(lenses), views, joint.n_points, rms, (), tuple(warnings))


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
