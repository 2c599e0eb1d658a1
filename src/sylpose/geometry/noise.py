"""What users know of the noise of keypoints: a standard deviation for each camera, as units in which all are alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import number, real

__all__ = ["LEAST_PX", "MOST_PX", "USUAL_PX", "NoisePx", "NoiseUnits", "noise_units"]

# (C,) in the order of cameras, or by their names.
NoisePx = ArrayLike | Mapping[str, float]
# The noise of keypoints that nobody says anything of, pixels (choice: SIFT has 0.3 to 0.7).
USUAL_PX = 0.5
# Noise that is said may be so small and so large, pixels, or infinite (choice: beyond any feature's).
LEAST_PX, MOST_PX = 1e-4, 1e6


class NoiseUnits(NamedTuple):
    """Units of the image plane in which all cameras have the same noise. Those of the camera with the least are pixels,
    unless it has more than usual: then what is far in pixels is not.

    Attributes:
        per_px: (C,) of one pixel; 0 where the noise is infinite.
        least: the noise, in these units. An estimator that measures more believes what it measures.
    """

    per_px: FloatArray
    least: float


def noise_units(noise_px: NoisePx, names: Sequence[str]) -> NoiseUnits:
    """Units by what is said of n cameras: their noise, standard deviations of an image coordinate in pixels.

    Args:
        noise_px: (n,) in the order of `names`, or a number by each of these.
        names: of the cameras.

    Raises:
        ValueError: not (n,), or not of these cameras; values that no noise has; infinite is one.
    """
    n = len(names)
    if isinstance(noise_px, Mapping):
        wrong = [f"{name!r} is no camera" for name in noise_px if name not in names]
        wrong += [f"camera {name} is missing" for name in names if name not in noise_px]
        if wrong:
            raise ValueError(f"noise_px: a number for each of {', '.join(names)} is expected, and {wrong[0]}")
        noise_px = [number(noise_px[name], f"noise_px[{name!r}]", most=np.inf) for name in names]
    noise = real(noise_px, f"({n},)", "noise_px")
    if noise.shape != (n,):
        raise ValueError(f"noise_px must be ({n},), a number for each camera, got shape {noise.shape}")
    if not (((noise >= LEAST_PX) & (noise <= MOST_PX)) | (noise == np.inf)).all():
        raise ValueError(
            f"noise_px must be from {LEAST_PX:g} to {MOST_PX:g} pixels, or infinite for a camera that is to have no say, "
            f"got {noise.tolist()}"
        )
    least = min(float(noise.min(initial=np.inf)), USUAL_PX)
    return NoiseUnits(least / noise, least)
