"""Errors of the lenses that a calibration from motion holds as given: those that the motion contradicts, and the others.

A second joint refinement estimates them from a prior of typical calibration errors. What the motion contradicts must be
estimated. The rest stays as given, and its possible errors are part of the covariance of the extrinsics.

Source: S. F. Schmidt, "Application of state-space methods to navigation problems", 1966 (consider parameters).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sylpose.bundle_adjustment.calibration_refinement import (
    N_CAMERA_PARAMETERS,
    N_LENS_PARAMETERS,
    default_calibration_prior,
)
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.rig import Camera, Rig
from sylpose.rig_calibration.motion_bundle import LENS_COLUMNS, SD_FACTOR, JointBundle, is_estimated, make_lens_prior

# Parameters of lenses in sentences, with their unit and its factor (derived).
LENS_WORDS = {
    "focal": ("focal length", " %", 100.0),
    "principal": ("principal point", " pixels", 1.0),
    "distortion": ("distortion", "", 1.0),
}
# Information relative to the prior below which there is none (derived: far above rounding errors of a covariance).
MIN_INFORMATION = 1e-6
# Sizes of the errors at which their distribution is integrated (choice: it is smooth).
N_SIZES = 50


@dataclass(frozen=True, eq=False)
class LensErrors:
    """Errors of the H parameters of lenses that are held, as a joint refinement estimates them from their prior.

    Attributes:
        camera, column: (H,) of each.
        prior: (H,) standard deviations of typical errors.
        values: (H,) estimates, in units of the prior.
        covariance: (H, H) posterior, in the same units, of the refinement: before `SD_FACTOR`.
        sensitivity: (10 C, H) change of all parameters of the cameras with errors of one standard deviation.
        largest: size of the errors relative to the prior that the calibration states itself, by its reprojection error.
    """

    camera: IntArray
    column: IntArray
    prior: FloatArray
    values: FloatArray
    covariance: FloatArray
    sensitivity: FloatArray
    largest: float


def measure_lens_errors(cameras: Sequence[Camera], joint: JointBundle, free: Sequence[str]) -> LensErrors:
    """Measure the errors of the lenses that are held.

    Args:
        cameras: the C cameras as given.
        joint: refinement with typical errors of the lenses.
        free: what else is estimated of the lenses (`bundle_jointly`).
    """
    is_held = np.tile([not is_estimated(name, free) for name in LENS_COLUMNS], (len(cameras), 1))
    camera, column = np.nonzero(is_held)
    prior = np.array([make_lens_prior(its, free, is_exact=False) for its in cameras])[is_held]
    changes = np.array([measure_lens_change(*pair) for pair in zip(cameras, joint.rig, strict=True)])[is_held]
    rows = N_CAMERA_PARAMETERS * camera + N_CAMERA_PARAMETERS - N_LENS_PARAMETERS + column
    all_of_them = joint.covariance[:, rows] / prior / SD_FACTOR**2
    own = all_of_them[rows] / prior[:, None]
    sensitivity = all_of_them @ np.linalg.pinv(own, rcond=MIN_INFORMATION, hermitian=True)
    stated = default_calibration_prior(Rig(cameras)).lens[camera, column] / prior
    largest = 1.0 if "fov" in free else float(stated.max(initial=0.0))
    return LensErrors(camera, column, prior, changes / prior, own, sensitivity, largest)


def measure_lens_change(before: Camera, after: Camera) -> FloatArray:
    """Return (4,) relative focal length, principal point (pixels) and first radial coefficient of one lens from another."""
    center, radial = after.matrix[:2, 2] - before.matrix[:2, 2], after.distortion[0] - before.distortion[0]
    return np.array([after.focal / before.focal - 1.0, *center, radial])


def find_wrong_parameters(names: Sequence[str], errors: LensErrors) -> Iterator[tuple[str, str]]:
    """Yield which parameters of the lenses the motion contradicts, in all cameras together, each with a sentence.

    Args:
        names: of the C cameras.
        errors: of the parameters that are held.
    """
    # Of the estimates if the lenses are as given: (D + 1)^-1 D (D + 1)^-1, with D the information of the data.
    expected = SD_FACTOR**2 * (errors.covariance - errors.covariance @ errors.covariance)
    for name, (words, unit, factor) in LENS_WORDS.items():
        own = np.array([LENS_COLUMNS[k] == name for k in errors.column], bool)
        values, block = errors.values[own], expected[np.ix_(own, own)]
        square = values @ np.linalg.pinv(block, rcond=MIN_INFORMATION, hermitian=True) @ values
        if own.any() and square > chi_squared_bound(len(values)):
            sds = SD_FACTOR * np.sqrt(np.diag(errors.covariance)[own])
            k, size = int(np.argmax(np.abs(values) / sds)), factor * errors.prior[own]
            change = f"{names[errors.camera[own][k]]} by {size[k] * values[k]:+.2g} ± {size[k] * sds[k]:.1g}{unit}"
            yield name, f"{words}s were estimated, since the motion contradicts those given: {change}"


def compute_consider_covariance(errors: LensErrors) -> FloatArray:
    """Compute the (10 C, 10 C) covariance of the cameras' errors that errors of the held lenses cause.

    The size of the errors is unknown, up to the largest, with equal probability; the data may exclude some. The parameters
    are held, so that the estimates of their errors count, too.
    """
    values, vectors = np.linalg.eigh(errors.covariance)
    values = values.clip(MIN_INFORMATION, 1.0 - MIN_INFORMATION)
    # What the data alone measure in independent directions, and the variance of that.
    measured = (vectors.T @ errors.values) / (1.0 - values)
    noise = SD_FACTOR**2 * values / (1.0 - values)
    sizes = (errors.largest * (np.arange(N_SIZES) + 0.5) / N_SIZES)[:, None] ** 2
    logarithm = -0.5 * (np.log(sizes + noise) + measured**2 / (sizes + noise)).sum(axis=1)
    weights = np.exp(logarithm - logarithm.max())
    weights /= weights.sum()
    estimates = sizes / (sizes + noise) * measured
    moments = np.diag(weights @ (sizes * noise / (sizes + noise))) + (weights * estimates.T) @ estimates
    gain = errors.sensitivity @ vectors
    return np.asarray(gain @ moments @ gain.T)
