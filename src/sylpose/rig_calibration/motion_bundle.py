"""Joint bundle adjustment of cameras that calibrate themselves from one object: extrinsics, lenses, poses, landmarks.

It is the bundle adjustment of smoothing with a wide prior of the extrinsics. Cameras share the object's poses, not its
landmarks. Its result is expressed in the first camera's axes, without the common scale, which nothing determines.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.bundle import ROUGH_PX, BundleOptions, Observations, bundle_adjust
from sylpose.bundle_adjustment.calibration_refinement import (
    N_CAMERA_PARAMETERS,
    CalibrationPrior,
    default_calibration_prior,
)
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.rig import Camera, Rig
from sylpose.rig_calibration.camera_tracks import RefinedTrack
from sylpose.rig_calibration.relative_motions import RelativeExtrinsics
from sylpose.rig_calibration.result import Coverage, measure_cells
from sylpose.status import Status

# Prior of the extrinsics from relative motions: radians, and share of the distance to the object (choice: several times
# their errors, docs/calibrating.md, so that it hardly matters).
ROTATION_SD, PLACE_SD = np.radians(10.0), 0.3
# Prior of a lens that is estimated: relative focal length, principal point as share of the image's width, first radial
# coefficient (choice: a focal length known to 5 %).
LENS_SD = {"focal": 0.05, "principal": 0.02, "distortion": 0.1}
# Lens parameters in the order of a covariance (derived).
LENS_COLUMNS = ("focal", "principal", "principal", "distortion")
# Relative focal length from a field of view, "fov" (choice: a guess good to 20 %).
FOV_SD = 0.2
# Prior of a lens that is not estimated: small enough not to matter (derived).
FIXED_SD = 1e-9
# Factor of all standard deviations beyond the inflation of the bundle adjustment (measured: benchmarks/self_calibration.py,
# `--small`, errors are 1.1 times the standard deviations in the rms of 119 cameras with exact lenses).
SD_FACTOR = 1.1
# Iterations at most (choice).
MAX_ITERATIONS = 50
# The object's length is measured by points with so many observations between these quantiles, in so many directions
# (choice).
MIN_OBSERVATIONS, EXTENT_QUANTILES, EXTENT_DIRECTIONS = 5, (0.005, 0.995), 200


@dataclass(frozen=True, eq=False)
class JointBundle:
    """Result of the joint refinement.

    Attributes:
        status: OK if it converged.
        rig: C cameras in the axes of the first.
        covariance: (10 C, 10 C) of (w, d) of each camera's pose in the first camera's axes, R = exp(w) R̂ and d of its
            center, and of its lens (`CalibrationPrior`); for the scale that keeps the rms distance of the cameras from
            the first.
        noise_ratio, inlier_ratio: (C,) noise, and share of inliers, relative to each camera's own track.
        n_points: (C,) number of inliers.
        sigma_px: (C,) noise, pixels.
        distance: mean distance of the first camera from the object.
        object_length: longest extent of the object's observed surface.
        reference_from_object: N poses of the object.
        observations: of all cameras, normalized by `rig`; their landmarks are numbered through the tracks.
        landmarks: (M, 3) object's frame.
        weights: (n,) of the observations, in [0, 1].
        coverage: of each camera's image by inliers.
    """

    status: Status
    rig: Rig
    covariance: FloatArray
    noise_ratio: FloatArray
    inlier_ratio: FloatArray
    n_points: IntArray
    sigma_px: FloatArray
    distance: float
    object_length: float
    reference_from_object: RigidTransform
    observations: Observations
    landmarks: FloatArray
    weights: FloatArray
    coverage: tuple[Coverage, ...]

    @property
    def worst_noise_ratio(self) -> float:
        """The largest of `noise_ratio`."""
        return float(self.noise_ratio.max())


def bundle_jointly(
    cameras: Sequence[Camera],
    tracks: Sequence[RefinedTrack],
    start: RelativeExtrinsics,
    free: Sequence[str] = (),
    *,
    is_exact: bool = True,
) -> JointBundle:
    """Refine extrinsics, and lenses on request, with all poses and landmarks.

    Args:
        cameras: C cameras with their lenses; their poses are not used.
        tracks: C tracks, in the order of `start.cameras`, in its frames; all images of a frame taken at one instant.
        start: extrinsics from relative motions.
        free: what else is estimated of each lens, some of `LENS_SD`, or "fov" for a focal length from a field of view.
        is_exact: as in `make_lens_prior`.

    Raises:
        ImplausibleLensError: an estimated lens is none.
        LinAlgError: a system of equations is singular.
    """
    n = len(cameras)
    rig = Rig([replace(c, camera_from_world=X) for c, X in zip(cameras, start.camera_from_reference, strict=True)])
    observations, landmarks = _merge_observations(tracks, start)
    place_sd = PLACE_SD * float(np.linalg.norm(start.reference_from_object.translation, axis=1).mean())
    lenses = np.array([make_lens_prior(camera, free, is_exact=is_exact) for camera in cameras])
    options = BundleOptions(
        landmarks=landmarks,
        calibration_prior=CalibrationPrior(np.full(n, ROTATION_SD), np.full(n, place_sd), lenses, np.full(n, -1)),
        recalibrate=True,
        rough_px=ROUGH_PX,
        max_iterations=MAX_ITERATIONS,
    )
    radius = float(np.median([s * t.track.radius for s, t in zip(start.scales, tracks, strict=True)]))
    result = bundle_adjust(rig, observations, start.reference_from_object, radius, options)
    assert result.correction is not None
    corrected = result.correction.rig
    poses = corrected[0].camera_from_world * result.world_from_object
    is_inlier = result.weights > 0
    total, inliers = (np.bincount(observations.camera[mask], minlength=n) for mask in (slice(None), is_inlier))
    counts = np.bincount(observations.landmark[is_inlier], minlength=len(landmarks))
    return JointBundle(
        result.status,
        Rig(
            [
                replace(c, camera_from_world=c.camera_from_world * corrected[0].camera_from_world.inv())
                for c in corrected
            ]
        ),
        SD_FACTOR**2 * transform_covariance(corrected, result.correction.covariance),
        result.sigma_px / np.array([t.sigma_px for t in tracks]),
        inliers / total / np.array([t.inlier_ratio for t in tracks]),
        np.asarray(inliers, np.int64),
        result.sigma_px,
        float(np.linalg.norm(poses.translation, axis=1).mean()),
        _measure_extent(result.landmarks[counts >= MIN_OBSERVATIONS]),
        poses,
        _renormalize(observations, rig, corrected) if free or not is_exact else observations,
        result.landmarks,
        result.weights,
        tuple(_measure_coverage(rig, observations, result.residuals, is_inlier)),
    )


def _measure_coverage(
    rig: Rig, observations: Observations, residuals: FloatArray, is_inlier: BoolArray
) -> Iterator[Coverage]:
    """Yield where in its image each camera observed the object, with residuals (n, 2) of the observations, pixels."""
    for c, camera in enumerate(rig):
        own = (observations.camera == c) & is_inlier
        yield Coverage(
            *measure_cells(camera.denormalize(observations.image[own]), (residuals[own] ** 2).sum(axis=1), camera.size),
            np.nan,
        )


def _merge_observations(tracks: Sequence[RefinedTrack], start: RelativeExtrinsics) -> tuple[Observations, FloatArray]:
    """Return all cameras' observations, and landmarks in the reference's axes of the object."""
    parts, landmarks, offset = [], [], 0
    for c, its in enumerate(tracks):
        rows, own = np.searchsorted(start.frames, its.track.frames), its.observations
        parts.append((rows[own.frame], np.full(len(own), c), own.landmark + offset, own.image))
        landmarks.append(start.object_axes[c].apply(start.scales[c] * its.landmarks))
        offset += len(its.landmarks)
    return Observations(*(np.concatenate(values) for values in zip(*parts, strict=True))), np.concatenate(landmarks)


def _renormalize(observations: Observations, rig: Rig, corrected: Rig) -> Observations:
    """Return observations as normalized by corrected lenses."""
    image = observations.image.copy()
    for c, (before, after) in enumerate(zip(rig, corrected, strict=True)):
        own = observations.camera == c
        image[own] = after.normalize(before.denormalize(image[own]))
    return replace(observations, image=image)


def make_lens_prior(camera: Camera, free: Sequence[str], *, is_exact: bool = True) -> FloatArray:
    """Return (4,) standard deviations of a lens, as in `CalibrationPrior`.

    Args:
        camera: the camera.
        free: what is estimated, as in `bundle_jointly`.
        is_exact: whether the rest is exact; else it has the errors of a typical calibration, or of none with "fov",
            whatever the calibration states itself.
    """
    units = np.array([1.0, camera.size[0], camera.size[0], 1.0])
    wide = units * [LENS_SD[name] for name in LENS_COLUMNS]
    typical = default_calibration_prior(Rig([replace(camera, error_px=None)])).lens[0]
    rest = FIXED_SD * units if is_exact else wide if "fov" in free else typical
    sds = np.where([is_estimated(name, free) for name in LENS_COLUMNS], wide, rest)
    sds[0] = FOV_SD if "fov" in free else sds[0]
    return sds


def is_estimated(name: str, free: Sequence[str]) -> bool:
    """Return whether a parameter of the lenses is estimated, from what is estimated as in `bundle_jointly`."""
    return name in free or (name == "focal" and "fov" in free)


def transform_covariance(rig: Rig, covariance: FloatArray) -> FloatArray:
    """Return the covariance of a rig's errors in the first camera's axes, without the common scale.

    Args:
        rig: C cameras in any world.
        covariance: (10 C, 10 C) as of `CalibrationCorrection`: rotations in the camera's axes, centers in the world's.
    """
    n, width = len(rig), N_CAMERA_PARAMETERS
    J, stretch = np.eye(n * width), np.zeros(n * width)
    Q, origin = rig[0].rotation, rig[0].center
    for c, camera in enumerate(rig):
        w, d = slice(c * width, c * width + 3), slice(c * width + 3, c * width + 6)
        center = Q @ (camera.center - origin)
        # Pose in the first camera's axes: R = Q_c Q', o = Q (o_c - o_0).
        J[w, :3] -= camera.rotation @ Q.T
        J[d, d] = Q
        J[d, 3:6] -= Q
        J[d, :3] -= np.cross(np.eye(3), center)
        stretch[d] = center
    scale_free = np.eye(n * width) - np.outer(stretch, stretch) / (stretch @ stretch)
    J = scale_free @ J
    return np.asarray(J @ covariance @ J.T)


def _measure_extent(points: FloatArray) -> float:
    """Return the longest extent of points (n, 3); NaN without any."""
    if not len(points):
        return np.nan
    directions = Rotation.random(EXTENT_DIRECTIONS, rng=np.random.default_rng(0)).apply([0.0, 0.0, 1.0])
    low, high = np.quantile(points @ directions.T, EXTENT_QUANTILES, axis=0)
    return float((high - low).max())
