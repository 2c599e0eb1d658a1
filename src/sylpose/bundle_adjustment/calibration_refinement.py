"""Calibration errors: their prior, their estimation, and the corrected rig.

A camera's rotation and center, focal length, principal point and first radial coefficient may be wrong. A rotation or
translation common to all cameras is not an error: it only changes the world frame. The prior excludes it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.camera_parameters import CameraParameters
from sylpose.bundle_adjustment.kernels import LENS, ROTATION, TRANSLATION
from sylpose.bundle_adjustment.problem import Problem, State
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.rig import Camera, Rig

# Lens parameters of a camera: relative focal length; principal point, pixels; first radial coefficient (derived).
N_LENS_PARAMETERS = 4
# Parameters of a camera in a covariance: rotation, center, lens (derived).
N_CAMERA_PARAMETERS = 6 + N_LENS_PARAMETERS
# Typical calibration errors, one standard deviation: degrees; fraction of the cameras' distance from each other;
# fraction of the focal length; pixels; and of the radial coefficient (choice: from reports of users of Anipose and
# Caliscope).
ROTATION_SD_DEG, TRANSLATION_SD_RATIO, FOCAL_SD_RATIO, PRINCIPAL_POINT_SD_PX, RADIAL_SD = 0.5, 0.003, 0.01, 5.0, 0.02
# Typical reprojection error of a calibration, pixels. The errors of a lens are scaled by the reported one relative to it;
# the scale has a lower limit. That error contains no information on the cameras' poses (choice).
TYPICAL_ERROR_PX, MIN_ERROR_RATIO = 1.0, 0.2
# Rotation and translation of a moved camera, one standard deviation (choice).
MOVED_ROTATION_SD_DEG, MOVED_TRANSLATION_RATIO = 5.0, 0.03
# Scale of the prior for a calibration treated as exact (choice: a scale of 0 could not be undone).
NEAR_EXACT_SCALE = 1e-9
# Finite difference steps of the first radial coefficient and of the normalized point (choice).
RADIAL_STEP, POINT_STEP = 1e-4, 1e-4


class ImplausibleLensError(ValueError):
    """Error for an estimate of a lens that no camera has: the estimation diverged."""


@dataclass(frozen=True, eq=False)
class CalibrationPrior:
    """Prior standard deviations of the calibration errors of C cameras.

    Attributes:
        rotation_sd: (C,) radians about each axis.
        translation_sd: (C,) length units, of the center along each axis.
        lens: (C, 4) of the relative focal length; of the principal point, pixels, both coordinates; of the first radial
            coefficient.
        predecessor: (C,) a camera that was moved becomes two, one after the other: index of its predecessor, -1 without
            one. The predecessor's errors still apply; rotation and translation are relative to it, and its lens is
            shared.
        covariance: (10 C, 10 C) of the errors of the C cameras that were not moved, columns as in
            `CalibrationCorrection.values`, in place of the standard deviations; None: errors are independent. The
            calibration came from the same observations, which therefore do not change its uncertainty.
    """

    rotation_sd: FloatArray
    translation_sd: FloatArray
    lens: FloatArray
    predecessor: IntArray
    covariance: FloatArray | None = None

    @classmethod
    def from_covariance(cls, covariance: FloatArray) -> CalibrationPrior:
        """Return the uncertainty of C cameras that were calibrated from the same observations, (10 C, 10 C)."""
        variances = np.maximum(np.diag(covariance), 0.0).reshape(-1, 6 + N_LENS_PARAMETERS)
        rotation, translation = (np.sqrt(variances[:, k : k + 3].mean(axis=1)) for k in (0, 3))
        return cls(rotation, translation, np.sqrt(variances[:, 6:]), np.full(len(variances), -1), covariance)


@dataclass(frozen=True, eq=False)
class MovedCamera:
    """Camera whose pose changed at some frame.

    Attributes:
        camera: index in the rig.
        frame: number in the recording of the first frame after the change.
        rotation_sd: radians, prior standard deviation of the rotation about each axis, beyond what is known.
        rotation: (3,) rotation vector, camera's axes, by which its images are rotated back from then on.
    """

    camera: int
    frame: int
    rotation_sd: float = np.deg2rad(MOVED_ROTATION_SD_DEG)
    rotation: FloatArray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, eq=False)
class CalibrationCorrection:
    """Result of a calibration refinement.

    Attributes:
        rig: the corrected rig.
        values, sd: (C, 10) errors and their standard deviations: rotation (radians, camera's axes) and translation of
            the center (length units, world's axes), then the lens as in `CalibrationPrior`. For a moved camera relative
            to its predecessor.
        prior_sd: (C, 10) prior standard deviations, without the rotation and translation common to all cameras.
        covariance: (10 C, 10 C) of the values.
    """

    rig: Rig
    values: FloatArray
    sd: FloatArray
    prior_sd: FloatArray
    covariance: FloatArray


def compute_mean_camera_distance(rig: Iterable[Camera]) -> float:
    """Return the cameras' mean distance from their centroid; 1 for a single one."""
    centers = np.array([camera.center for camera in rig])
    return float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean()) or 1.0


def default_calibration_prior(rig: Rig) -> CalibrationPrior:
    """Return the typical errors of calibrations; smaller for lenses with a small reported reprojection error."""
    size = compute_mean_camera_distance(rig)
    errors_px = [camera.error_px for camera in rig]
    scales = np.array([1.0 if e is None else np.clip(e / TYPICAL_ERROR_PX, MIN_ERROR_RATIO, 1.0) for e in errors_px])
    lens = np.array([FOCAL_SD_RATIO, PRINCIPAL_POINT_SD_PX, PRINCIPAL_POINT_SD_PX, RADIAL_SD])
    rotation_sd, translation_sd = (
        np.full(len(rig), x) for x in (np.deg2rad(ROTATION_SD_DEG), TRANSLATION_SD_RATIO * size)
    )
    return CalibrationPrior(rotation_sd, translation_sd, scales[:, None] * lens, np.full(len(rig), -1))


def add_moved_cameras(rig: Rig, prior: CalibrationPrior, moved: Sequence[MovedCamera]) -> tuple[Rig, CalibrationPrior]:
    """Add a camera for each change of pose, in order of time: a copy with an uncertain pose."""
    translation_sd, current = MOVED_TRANSLATION_RATIO * compute_mean_camera_distance(rig), np.arange(len(rig))
    predecessors = []
    for i, m in enumerate(moved):
        predecessors.append(current[m.camera])
        current[m.camera] = len(rig) + i
    copies = [replace(rig.cameras[m.camera], name=f"{rig.cameras[m.camera].name} from frame {m.frame}") for m in moved]
    return Rig([*rig, *copies], rig.unit), CalibrationPrior(
        np.append(prior.rotation_sd, [m.rotation_sd for m in moved]),
        np.append(prior.translation_sd, np.full(len(moved), translation_sd)),
        np.vstack([prior.lens, prior.lens[[m.camera for m in moved]]]),
        np.append(prior.predecessor, np.array(predecessors, np.int64)),
        prior.covariance,
    )


def add_calibration_parameters(parameters: CameraParameters, rig: Rig, prior: CalibrationPrior) -> CameraParameters:
    """Add the calibration parameters: (C, K) columns become those of `kernels` up to the lens.

    They are fixed, except for the poses of moved cameras.
    """
    n, width, first = len(rig), LENS + N_LENS_PARAMETERS, np.flatnonzero(prior.predecessor < 0)
    k = 6 * n + N_LENS_PARAMETERS * len(first)
    own = np.zeros((n, width, k))
    for c in range(n):
        own[c, ROTATION:TRANSLATION, 6 * c : 6 * c + 3] = prior.rotation_sd[c] * np.eye(3)
        own[c, TRANSLATION:LENS, 6 * c + 3 : 6 * c + 6] = prior.translation_sd[c] * np.eye(3)
    pose_columns = (6 * first[:, None] + np.arange(6)).ravel()
    if prior.covariance is None:
        projector = _common_motion_projector([rig.cameras[c] for c in first], prior, first)
        own[:, :, pose_columns] = own[:, :, pose_columns] @ projector
        for i, c in enumerate(first.tolist()):
            lens = 6 * n + N_LENS_PARAMETERS * i
            own[c, LENS:, lens : lens + N_LENS_PARAMETERS] = np.diag(prior.lens[c])
    else:
        values, vectors = np.linalg.eigh(prior.covariance)
        columns = np.concatenate([pose_columns, np.arange(6 * n, k)])
        root = (vectors * np.sqrt(np.maximum(values, 0.0))).reshape(len(first), -1, len(columns))
        own[np.ix_(first, np.arange(ROTATION, width), columns)] = root
    for c, predecessor in enumerate(prior.predecessor.tolist()):
        if predecessor >= 0:
            own[c] += own[predecessor]
    mean, spread = np.zeros((n, width)), np.zeros((n, width, parameters.basis.shape[2] + k))
    mean[:, :ROTATION] = parameters.mean[:, :ROTATION]
    spread[:, :ROTATION, : parameters.basis.shape[2]] = parameters.basis[:, :ROTATION]
    spread[:, :, parameters.basis.shape[2] :] = own
    is_initial = np.repeat(prior.predecessor < 0, 6)
    added = np.concatenate([is_initial, np.ones(k - 6 * n, bool)])
    fixed = np.concatenate([parameters.fixed, added])
    # What the same observations determined, they neither scale nor update.
    is_calibration = np.concatenate([parameters.is_calibration, added & (prior.covariance is None)])
    return CameraParameters(mean, spread, parameters.n_offsets, is_calibration, 1.0, fixed)


def _common_motion_projector(rig: Sequence[Camera], prior: CalibrationPrior, indices: IntArray) -> FloatArray:
    """Return the (6 C, 6 C) projection that removes rotations and translations common to all cameras.

    It acts on rotations and translations in standard deviations.

    Args:
        indices: (C,) their indices in the prior.
    """
    centers, common = np.array([c.center for c in rig]), np.zeros((6 * len(rig), 6))
    centroid = centers.mean(axis=0)
    size = compute_mean_camera_distance(rig)
    for c, camera in enumerate(rig):
        rotation_sd, translation_sd = prior.rotation_sd[indices[c]], prior.translation_sd[indices[c]]
        # The world rotated by w: X' = X + w x (X - middle), so Q' = Q exp(-w) = exp(-Q w) Q.
        common[6 * c : 6 * c + 3, :3] = -camera.rotation / rotation_sd
        x, y, z = centers[c] - centroid
        common[6 * c + 3 : 6 * c + 6, :3] = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]) / translation_sd
        common[6 * c + 3 : 6 * c + 6, 3:] = size * np.eye(3) / translation_sd
    q = np.linalg.qr(common)[0]
    return np.asarray(np.eye(len(common)) - q @ q.T)


def correct_rig(rig: Rig, values: FloatArray) -> Rig:
    """Return the rig with corrections (C, K), columns as in `kernels`."""
    return Rig([_correct_camera(camera, v) for camera, v in zip(rig, values, strict=True)], rig.unit)


def _correct_camera(camera: Camera, values: FloatArray) -> Camera:
    rotation = Rotation.from_rotvec(values[ROTATION:TRANSLATION]) * camera.camera_from_world.rotation
    center = camera.center + values[TRANSLATION:LENS]
    pose = RigidTransform.from_components(-rotation.apply(center), rotation)
    return replace(_correct_lens(camera, values[LENS : LENS + N_LENS_PARAMETERS]), camera_from_world=pose)


def _correct_lens(camera: Camera, lens: FloatArray) -> Camera:
    matrix, distortion = camera.matrix.copy(), camera.distortion.copy()
    matrix[[0, 1], [0, 1]] *= 1.0 + lens[0]
    matrix[:2, 2] += lens[1:3]
    distortion[0] += lens[3]
    try:
        return replace(camera, matrix=matrix, distortion=distortion)
    except ValueError as error:
        raise ImplausibleLensError(str(error)) from error


def linearize_lenses(
    rig: Rig, cameras: IntArray, image: FloatArray, lens: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Linearize normalized points in the lens parameters.

    Args:
        rig: the cameras.
        cameras: (n,) camera of each point.
        image: (n, 2) points normalized by the rig.
        lens: C corrections (4,) at which to linearize.

    Returns:
        (n, 2) points at zero correction, to which the derivatives times a correction are added, and
        `SortedObservations.lens` (n, 3, 4).
    """
    jacobians, points = np.zeros((len(image), 3, N_LENS_PARAMETERS)), image.copy()
    for c, camera in enumerate(rig):
        own = cameras == c
        if not own.any():
            continue
        corrected_camera, x = camera, image[own]
        if np.any(lens[c]):
            corrected_camera = _correct_lens(camera, lens[c])
            x = corrected_camera.normalize(camera.denormalize(x))
        h = np.array([0.0, 0.0, 0.0, RADIAL_STEP])
        upper, lower = _correct_lens(corrected_camera, h), _correct_lens(corrected_camera, -h)
        lens_jacobian = np.empty((len(x), 2, N_LENS_PARAMETERS))
        lens_jacobian[:, :, 0] = corrected_camera.denormalize(x) - corrected_camera.matrix[:2, 2]
        lens_jacobian[:, :, 1:3] = np.eye(2)
        lens_jacobian[:, :, 3] = (upper.denormalize(x) - lower.denormalize(x)) / (2 * RADIAL_STEP)
        # The pixel is constant.
        (ux, uy), (vx, vy) = _pixel_jacobian(corrected_camera, x).transpose(1, 2, 0)
        inverse = np.array([[vy, -uy], [-vx, ux]]) / (ux * vy - uy * vx)
        jacobians[own, :2] = -inverse.transpose(2, 0, 1) @ lens_jacobian
        # A pixel's area depends on the focal length by its square and, of the other parameters, only on the last one.
        area = [_measure_pixel_area(camera, x) for camera in (upper, lower)]
        # Half the derivative of its logarithm; where a lens folds, the area is negative.
        jacobians[own, 2, 0] = 1.0
        jacobians[own, 2, -1] = (area[0] - area[1]) / ((area[0] + area[1]) * 2 * RADIAL_STEP)
        jacobians[own, :, 0] /= 1.0 + lens[c][0]  # relative to the corrected focal length
        points[own] = x - jacobians[own, :2] @ lens[c]
    return points, jacobians


def _pixel_jacobian(camera: Camera, x: FloatArray) -> FloatArray:
    """Return (n, 2, 2) derivatives of pixels by normalized points (n, 2)."""
    h, axes = POINT_STEP, np.eye(2)
    return np.stack([(camera.denormalize(x + h * u) - camera.denormalize(x - h * u)) / (2 * h) for u in axes], axis=2)


def _measure_pixel_area(camera: Camera, x: FloatArray) -> FloatArray:
    """Return (n,) determinants of the derivatives of pixels by normalized points (n, 2)."""
    (ux, uy), (vx, vy) = _pixel_jacobian(camera, x).transpose(1, 2, 0)
    return np.asarray(ux * vy - uy * vx)


def add_calibration_errors(problem: Problem, state: State, rig: Rig, prior: CalibrationPrior) -> tuple[Problem, State]:
    """Add calibration errors to a problem and its state; they are zero and fixed."""
    parameters = add_calibration_parameters(problem.camera_parameters, rig, prior)
    z = np.concatenate([state.z, np.zeros(parameters.basis.shape[2] - len(state.z))])
    problem = replace(problem, camera_parameters=parameters)
    return relinearize_lenses(problem, problem.observations.image, rig, z), replace(state, z=z)


def free_calibration(problem: Problem) -> Problem:
    """Return the problem with calibration errors estimated."""
    parameters = problem.camera_parameters
    return replace(problem, camera_parameters=replace(parameters, fixed=parameters.fixed & ~parameters.is_calibration))


def rescale_calibration_prior(
    problem: Problem, state: State, scale: float, *, keeps_lenses: bool = False
) -> tuple[Problem, State]:
    """Scale the prior of calibration errors, relative to the initial one, without changing the state.

    Args:
        keeps_lenses: whether the prior of the lenses is not scaled.
    """
    parameters = problem.camera_parameters
    is_scaled = parameters.is_calibration & ~(keeps_lenses & (parameters.basis[:, LENS:] != 0.0).any(axis=(0, 1)))
    factors = np.where(is_scaled, scale / parameters.scale, 1.0)
    parameters = replace(parameters, basis=parameters.basis * factors, scale=scale)
    return replace(problem, camera_parameters=parameters), replace(state, z=state.z / factors)


def relinearize_lenses(problem: Problem, image: FloatArray, rig: Rig, z: FloatArray) -> Problem:
    """Linearize the lenses at z (k,); image (n, 2) are the points as normalized by the rig."""
    lens = problem.camera_parameters.evaluate(z)[:, LENS:]
    points, jacobians = linearize_lenses(rig, problem.observations.camera, image, list(lens))
    return replace(problem, observations=problem.observations._replace(image=points, lens=jacobians))


def make_correction(
    parameters: CameraParameters, rig: Rig, predecessor: IntArray, z: FloatArray, covariance: FloatArray
) -> CalibrationCorrection:
    """Make the correction from the shared parameters.

    Args:
        predecessor: (C,) as in `CalibrationPrior`.
        z: (k,) the shared parameters.
        covariance: (k, k) of z.
    """
    basis = parameters.basis[:, ROTATION:]
    spread = basis - (predecessor >= 0)[:, None, None] * basis[predecessor]
    flat = spread.reshape(-1, spread.shape[2])
    total = flat @ covariance @ flat.T
    sd = np.sqrt(np.maximum(np.diag(total), 0.0)).reshape(spread.shape[:2])
    corrected = correct_rig(rig, parameters.evaluate(z))
    return CalibrationCorrection(corrected, spread @ z, sd, np.linalg.norm(spread, axis=2), total)
