"""Known keypoint noise: a standard deviation per camera, as units in which all cameras have equal noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import check_number, check_real

__all__ = ["DEFAULT_NOISE_PX", "MAX_NOISE_PX", "MIN_NOISE_PX", "NoisePx", "NoiseUnits", "make_noise_units"]

# (C,) in the order of cameras, or by their names.
NoisePx = ArrayLike | Mapping[str, float]
# Default noise of keypoints, pixels (choice: SIFT has 0.3 to 0.7).
DEFAULT_NOISE_PX = 0.5
# Smallest and largest finite noise accepted, pixels (choice: beyond that of any feature).
MIN_NOISE_PX, MAX_NOISE_PX = 1e-4, 1e6


class NoiseUnits(NamedTuple):
    """Units of the image plane in which all cameras have the same noise.

    They are pixels for the camera with the least noise, unless that is above the default: then distances are scaled
    down.

    Attributes:
        per_px: (C,) units per pixel; 0 where the noise is infinite.
        sigma: the noise in these units. Estimators that measure a larger noise use the measured one.
    """

    per_px: FloatArray
    sigma: float


def make_noise_units(noise_px: NoisePx, names: Sequence[str]) -> NoiseUnits:
    """Make units of the image plane in which n cameras have equal noise.

    Args:
        noise_px: (n,) standard deviations of an image coordinate, pixels, in the order of `names`; or a mapping from
            names to them.
        names: of the cameras.

    Raises:
        ValueError: not (n,), or not of these cameras; values out of range. Infinite noise is allowed.
    """
    n = len(names)
    if isinstance(noise_px, Mapping):
        wrong = [f"{name!r} is not a camera" for name in noise_px if name not in names]
        wrong += [f"camera {name} is missing" for name in names if name not in noise_px]
        if wrong:
            raise ValueError(f"noise_px: expected a number for each of {', '.join(names)}, but {wrong[0]}")
        noise_px = [check_number(noise_px[name], f"noise_px[{name!r}]", maximum=np.inf) for name in names]
    noise = check_real(noise_px, f"({n},)", "noise_px")
    if noise.shape != (n,):
        raise ValueError(f"noise_px must be ({n},), a number for each camera, got shape {noise.shape}")
    if not (((noise >= MIN_NOISE_PX) & (noise <= MAX_NOISE_PX)) | (noise == np.inf)).all():
        raise ValueError(
            f"noise_px must be from {MIN_NOISE_PX:g} to {MAX_NOISE_PX:g} pixels, or infinite for a camera to ignore, "
            f"got {noise.tolist()}"
        )
    sigma = min(float(noise.min(initial=np.inf)), DEFAULT_NOISE_PX)
    return NoiseUnits(sigma / noise, sigma)
