"""Small image patches around features, by which a feature that has not moved is recognized.

A keypoint of the static background is found up to several pixels from its place in another frame: its position is that of
an extremum, which noise and neighbors shift. What the image shows there is the same. So a feature has not moved if the
later image, at the feature's earlier position, differs from the earlier one by no more than it does at the position that
it was matched with. Both differences contain the same noise, change of light and compression, so no level of any of them
is assumed.

    has not moved:  D(p_i) <= F (D(p_j) + q),  D(p) = mean over the patch of (I_j(p + o) - I_i(p_i + o) - mean)^2

with q the variance of rounding two images to gray levels, and F a quantile of the ratio of two variances. An object with
texture has another brightness there as soon as it moved by about half of a pixel.

What has moved far, or is covered, is not matched at all. Then the later image shows something else at the place
(`find_replaced`): nowhere near it is correlated with the earlier patch.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from sylpose.geometry.arrays import BoolArray, FloatArray, Image
from sylpose.geometry.numba_linalg import kernel

# Patches are compared within this radius, pixels (choice), if displaced by less than the second value (choice: of keypoints
# of a static background 99 in 100 are). Sensitivity of the radius and of the ratio:
# docs/history/benchmarks.md#features-that-have-not-moved.
RADIUS, REACH = 3, 4
# Side of the stored patches: bilinear interpolation at any such displacement (derived).
SIDE = 2 * (RADIUS + REACH) + 2
# Largest ratio of the two differences (derived: 99 % quantile of the F distribution with 48 and 48 degrees of freedom).
MAX_VARIANCE_RATIO = 1.97
# Variance of the difference of two rounded gray values (derived).
ROUNDING_VARIANCE = 2.0 / 12.0
# A patch shows texture if its variance is at least so many times that of the noise (derived: then the correlation of two
# images of it is 0.8, and of 49 pixels in 94 of 100 cases above that of half of the variance, by simulation).
MIN_TEXTURE_RATIO = 5.0

Patches = NDArray[np.uint8]


@kernel
def sample_patches(image: Image, pixels: FloatArray, step: FloatArray, corner: FloatArray) -> Patches:
    """Sample patches around features, at whole pixels of the camera.

    Args:
        image: (h, w) gray.
        pixels: (n, 2) in the camera's image.
        step: (2,) pixels of the camera per pixel of the image.
        corner: (2,) the camera's pixel at the center of the image's first pixel.

    Returns:
        (n, SIDE, SIDE), beginning at floor(pixels) - RADIUS - REACH. Pixels beyond the image's border repeat it.
    """
    height, width = image.shape
    patches = np.empty((len(pixels), SIDE, SIDE), np.uint8)
    for n in range(len(pixels)):
        for i in range(SIDE):
            v = np.floor(pixels[n, 1]) - (RADIUS + REACH) + i
            y = min(max((v - corner[1]) / step[1], 0.0), height - 1.0)
            row = int(y)
            below, fy = min(row + 1, height - 1), y - row
            for j in range(SIDE):
                u = np.floor(pixels[n, 0]) - (RADIUS + REACH) + j
                x = min(max((u - corner[0]) / step[0], 0.0), width - 1.0)
                column = int(x)
                right, fx = min(column + 1, width - 1), x - column
                upper = (1.0 - fx) * image[row, column] + fx * image[row, right]
                lower = (1.0 - fx) * image[below, column] + fx * image[below, right]
                patches[n, i, j] = np.uint8((1.0 - fy) * upper + fy * lower + 0.5)
    return patches


@kernel
def find_unmoved(before: Patches, pixels_before: FloatArray, after: Patches, pixels_after: FloatArray) -> BoolArray:
    """Find the matches (n,) whose patches have not moved between two images of a static camera.

    Args:
        before, after: (n, SIDE, SIDE) `sample_patches`; one that is black everywhere is unknown.
        pixels_before, pixels_after: (n, 2).
    """
    is_unmoved = np.zeros(len(before), np.bool_)
    for n in range(len(before)):
        u, v = pixels_before[n, 0] - pixels_after[n, 0], pixels_before[n, 1] - pixels_after[n, 1]
        if not (abs(u) < REACH and abs(v) < REACH) or not (before[n].any() and after[n].any()):
            continue
        x, y = pixels_before[n, 0] - np.floor(pixels_before[n, 0]), pixels_before[n, 1] - np.floor(pixels_before[n, 1])
        s, t = pixels_after[n, 0] - np.floor(pixels_after[n, 0]), pixels_after[n, 1] - np.floor(pixels_after[n, 1])
        at_old = _measure_difference(before[n], x, y, after[n], s + u, t + v)
        at_new = _measure_difference(before[n], x, y, after[n], s, t)
        is_unmoved[n] = at_old <= MAX_VARIANCE_RATIO * (at_new + ROUNDING_VARIANCE)
    return is_unmoved


@kernel
def _measure_difference(a: Patches, x: float, y: float, b: Patches, s: float, t: float) -> float:
    """Return the variance of the difference of two patches, at these offsets from their middle pixels."""
    total, squares = 0.0, 0.0
    for i in range(-RADIUS, RADIUS + 1):
        for j in range(-RADIUS, RADIUS + 1):
            difference = _interpolate(b, s + j, t + i) - _interpolate(a, x + j, y + i)
            total += difference
            squares += difference * difference
    n = (2 * RADIUS + 1) ** 2
    return float(squares / n - (total / n) ** 2)


@kernel
def _interpolate(patch: Patches, x: float, y: float) -> float:
    """Return the gray value at an offset from a patch's middle pixel, bilinear."""
    at_x, at_y = x + (RADIUS + REACH), y + (RADIUS + REACH)
    column, row = int(at_x), int(at_y)
    fx, fy = at_x - column, at_y - row
    upper = (1.0 - fx) * patch[row, column] + fx * patch[row, column + 1]
    lower = (1.0 - fx) * patch[row + 1, column] + fx * patch[row + 1, column + 1]
    return float((1.0 - fy) * upper + fy * lower)


def find_replaced(before: Patches, after: Patches, noise_variance: float) -> tuple[BoolArray, BoolArray]:
    """Find the places at which a later image of a static camera shows something else.

    Nowhere near such a place, within REACH, has the later image half of its variance in common with the earlier patch. A
    change of light does not matter, since this is a squared correlation.

    Args:
        before, after: (n, SIDE, SIDE) `sample_patches` at the same pixels; one that is black everywhere is unknown.
        noise_variance: of both images, squared gray values.

    Returns:
        (n,) known places, with at least so much texture that noise alone would not hide what is common; (n,) those of them
        that show something else.
    """
    side, a = 2 * RADIUS + 1, _select_middle(before)
    shifted = sliding_window_view(after[:, :-1, :-1].astype(float), (side, side), axis=(1, 2))
    b = shifted.reshape(len(after), (2 * REACH + 1) ** 2, side**2)
    a, b = a - a.mean(axis=1, keepdims=True), b - b.mean(axis=2, keepdims=True)
    common, variances = np.einsum("ni,nsi->ns", a, b), np.einsum("nsi,nsi->ns", b, b)
    total = (a * a).sum(axis=1)
    is_known = after.any(axis=(1, 2)) & (
        total > MIN_TEXTURE_RATIO * side**2 * (noise_variance + 0.5 * ROUNDING_VARIANCE)
    )
    is_common = (common > 0.0) & (2.0 * common**2 >= total[:, None] * variances)
    return np.asarray(is_known), np.asarray(is_known & ~is_common.any(axis=1))


def estimate_noise_variance(before: Patches, after: Patches) -> float:
    """Estimate the variance of the noise of two images of a static camera from patches at the same pixels.

    It is that of the quarter of the patches that differ least: the others may show what moves. 0 without patches.
    """
    difference = _select_middle(before) - _select_middle(after)
    return float(np.quantile(difference.var(axis=1), 0.25)) / 2.0 if len(before) else 0.0


def _select_middle(patches: Patches) -> FloatArray:
    """Return the pixels (n, (2 RADIUS + 1)^2) of patches that are compared without a displacement."""
    middle = slice(REACH, REACH + 2 * RADIUS + 1)
    return patches[:, middle, middle].reshape(len(patches), (2 * RADIUS + 1) ** 2).astype(float)
