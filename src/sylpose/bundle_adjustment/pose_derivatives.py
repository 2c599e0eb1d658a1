"""Time derivatives of poses that are known frame by frame."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray

# Poses that determine a polynomial of the fourth degree (derived).
STENCIL_SIZE = 5


def differentiate_quadratic(rotations: FloatArray, translations: FloatArray, times: FloatArray) -> FloatArray:
    """Differentiate poses by parabolas through three neighbors.

    Args:
        rotations: (N, 3, 3) rotations.
        translations: (N, 3) translations.
        times: (N,) increasing.

    Returns:
        (N, 2, 6) first and second time derivatives.
    """
    out = np.zeros((len(times), 2, 6))
    if len(times) < 2:
        return out
    gap = np.diff(times)[:, None]
    rotation_steps = Rotation.from_matrix(rotations[1:] @ rotations[:-1].transpose(0, 2, 1)).as_rotvec()
    velocity = np.hstack([rotation_steps, np.diff(translations, axis=0)]) / gap
    if len(times) == 2:
        out[:, 0] = velocity
        return out
    gap_before, gap_after = gap[:-1], gap[1:]
    out[1:-1, 0] = (gap_after * velocity[:-1] + gap_before * velocity[1:]) / (gap_before + gap_after)
    out[1:-1, 1] = 2.0 * (velocity[1:] - velocity[:-1]) / (gap_before + gap_after)
    out[0, 1], out[-1, 1] = out[1, 1], out[-2, 1]
    out[0, 0] = out[1, 0] - gap[0] * out[1, 1]
    out[-1, 0] = out[-2, 0] + gap[-1] * out[-2, 1]
    return out


def differentiate_quartic(rotations: FloatArray, translations: FloatArray, times: FloatArray) -> FloatArray:
    """Differentiate poses by polynomials of the fourth degree through five neighbors.

    Arguments and result are as of `differentiate_quadratic`, which also applies to the two frames at each end.

    Parabolas underestimate the speed of an oscillating motion by (2 pi / frames of a period)² / 6, and time offsets
    would be overestimated by the same factor.
    """
    out = differentiate_quadratic(rotations, translations, times)
    if len(times) < STENCIL_SIZE:
        return out
    stencil = np.arange(len(times) - STENCIL_SIZE + 1)[:, None] + np.arange(STENCIL_SIZE)
    middle = stencil[:, STENCIL_SIZE // 2]
    stencil_rotations, middle_inverse = rotations[stencil], rotations[middle].transpose(0, 2, 1)
    rotation_changes = (
        Rotation.from_matrix((stencil_rotations @ middle_inverse[:, None]).reshape(-1, 3, 3))
        .as_rotvec()
        .reshape(*stencil.shape, 3)
    )
    change = np.concatenate([rotation_changes, translations[stencil] - translations[middle, None]], axis=2)
    out[middle] = _stencil_weights(times)[:, 1:3] @ change
    return out


def compute_velocity_variance(times: FloatArray) -> FloatArray:
    """Return (N,) approximate variance of the speeds of `differentiate_quartic`.

    The poses are independent, with unit variance.
    """
    out = 0.5 / np.gradient(times) ** 2
    out[[0, -1]] *= 13.0  # one-sided differences of three poses at the ends
    if len(times) >= STENCIL_SIZE:
        out[STENCIL_SIZE // 2 : -(STENCIL_SIZE // 2)] = (_stencil_weights(times)[:, 1] ** 2).sum(axis=1)
    return np.asarray(out)


def _stencil_weights(times: FloatArray) -> FloatArray:
    """Return (N - 4, 5, 5) finite difference weights of five values at the middle one.

    Row k gives the k-th derivative of the polynomial through them.
    """
    stencil = np.arange(len(times) - STENCIL_SIZE + 1)[:, None] + np.arange(STENCIL_SIZE)
    time_differences = times[stencil] - times[stencil[:, STENCIL_SIZE // 2], None]
    scale = time_differences[:, -1:] - time_differences[:, :1]
    powers = (time_differences / scale)[..., None] ** np.arange(STENCIL_SIZE)
    factorials = np.array([1.0, 1.0, 2.0, 6.0, 24.0])
    return np.asarray(np.linalg.inv(powers) * (factorials / scale ** np.arange(STENCIL_SIZE))[..., None])
