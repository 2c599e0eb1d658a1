"""Background of a static camera from images of a recording, and silhouettes: what differs from it.

A pixel's background is the mode of its values over the recording, if enough of them support it. The noise is one number
per camera: a pixel's own spread over time would contain the object. A plain object that turns in place is the mode of
its own pixels; its colors reveal it, and images in which it is known to be elsewhere replace it. The half-sample mode: T.
Robertson and J. Cryer, "An iterative procedure for estimating the mode", 1974.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.special import gammaln

from sylpose.geometry.arrays import BoolArray, FloatArray, FloatImage, Image
from sylpose.geometry.numba_linalg import kernel

# Fewest samples of a pixel that determine its background (derived: one more than agree by chance).
MIN_SAMPLES = 3
# A background is known where this share of the samples supports it (measured: features of an object that turns in
# place are kept from 64 to 99.7 %).
MIN_SUPPORT = 0.35
# Samples within this many standard deviations of the noise, and at least this many gray levels, support it (measured:
# compression and slow changes of light reach 6 levels).
SUPPORT_SDS, MIN_SUPPORT_LEVELS = 4.0, 6.0
# Rounds of both (measured: a noise of 4 levels is met to 2 %).
SUPPORT_ROUNDS = 3
# Least noise of whole gray levels (derived: rounding).
MIN_NOISE = 12.0**-0.5
# Degrees of freedom of the background's Student distribution (choice: tails of the fourth power).
T_FREEDOM = 4.0
# Bins per channel of the histogram of foreground colors (choice: wider than the noise), and the share of it that any
# color has (choice: a tenth).
COLOR_BINS, UNIFORM_SHARE = 16, 0.1
# Pixels from the outline to those outside whose share is computed, and to the color inside (derived: blur of a pixel, and
# one for the error of the outline).
OUTLINE_PX = 2
# Holes in a silhouette are not known to be background up to this share of its area (choice: a fourteenth of its diameter).
MAX_HOLE_SHARE = 0.005
# Step between the rows and columns that determine the gain (choice: thousands of pixels).
GAIN_STEP = 4
# Cutoff of the bisquare in standard deviations (derived: 95 % efficiency for normal errors).
GAIN_CUTOFF = 4.685
# Rounds of reweighting (measured: the gain changes by less than a thousandth after six).
GAIN_ROUNDS = 8


@dataclass(frozen=True, eq=False)
class Background:
    """Background of one static camera.

    Attributes:
        color: (h, w, 3) BGR, gray levels.
        is_known: (h, w) whether enough images support it.
        noise: standard deviation of a pixel's channel, gray levels.
        foreground_density: (16, 16, 16) probability density of the foreground's colors, per gray level cubed.
    """

    color: FloatImage
    is_known: BoolArray
    noise: float
    foreground_density: FloatArray


@dataclass(frozen=True, eq=False)
class Silhouette:
    """Silhouette of what is in front of the background.

    Attributes:
        share: (h, w) share of the pixel's area that the foreground covers: 0 to 1, in between along the outline; 1 where
            the background is not known.
        log_odds: (h, w) of being foreground, at even prior odds; 0 where the background is not known.
    """

    share: FloatImage
    log_odds: FloatImage

    @classmethod
    def from_mask(cls, mask: BoolArray) -> Silhouette:
        """Return the silhouette of a mask (h, w) that is given."""
        return cls(mask.astype(np.float32), np.where(mask, np.inf, -np.inf).astype(np.float32))


def estimate_background(images: Sequence[Image], covered: Sequence[BoolArray] | None = None) -> Background:
    """Estimate the background of a static camera from images that are spread over a recording.

    Args:
        images: (h, w, 3) BGR, some 31, of equal gain (`level_images`).
        covered: per image, (h, w) where the object may be: not used there. Without it, colors that are rather the
            foreground's than the background's are not known.
    """
    n, (height, width) = len(images), images[0].shape[:2]
    used = np.ones((n, height * width), bool) if covered is None else ~np.stack(covered).reshape(n, -1)
    samples, color = np.stack(images).reshape(n, -1, 3), np.zeros((height * width, 3), np.float32)
    support, noise, limit = np.zeros(height * width, np.int64), MIN_NOISE, MIN_SUPPORT_LEVELS
    for _ in range(SUPPORT_ROUNDS):  # the noise depends on the support, and the support on the noise
        variance = _fill_modes(samples, used, limit, color, support)
        noise = max(float(np.sqrt(variance)), MIN_NOISE)
        limit = max(SUPPORT_SDS * noise, MIN_SUPPORT_LEVELS)
    is_known = support >= np.maximum(MIN_SUPPORT * used.sum(axis=0), MIN_SAMPLES)
    uniform = np.full((COLOR_BINS,) * 3, 256.0**-3)
    background = Background(color.reshape(height, width, 3), is_known.reshape(height, width), noise, uniform)
    density = _estimate_color_density(
        np.concatenate([image[(_log_odds(image, background) > 0) & background.is_known] for image in images])
    )
    if covered is None:
        index = _color_bins(background.color)
        is_objects = density[index] > _estimate_color_density(background.color[background.is_known])[index]
        background = replace(background, is_known=background.is_known & ~is_objects)
    return replace(background, foreground_density=density)


@kernel
def _fill_modes(samples: Image, used: BoolArray, limit: float, color: FloatImage, support: FloatArray) -> float:
    """Write the mode (m, 3) of the used samples (n, m, 3) and the number (m,) of samples within a limit of it.

    The mode is replaced by the mean of these samples. Returns the variance of all of these samples about it.
    """
    n, m = used.shape
    values, squares, count = np.empty(n, np.float32), 0.0, 0
    for i in range(m):
        for c in range(3):
            size = 0
            for k in range(n):
                if used[k, i]:
                    value = np.float32(samples[k, i, c])
                    j = size
                    while j > 0 and values[j - 1] > value:
                        values[j] = values[j - 1]
                        j -= 1
                    values[j] = value
                    size += 1
            first = 0
            while size > 2:  # the half that is closest together
                half = (size + 1) // 2
                best, at = np.inf, first
                for j in range(first, first + size - half + 1):
                    width = values[j + half - 1] - values[j]
                    if width < best:
                        best, at = width, j
                first, size = at, half
            color[i, c] = 0.0 if size == 0 else 0.5 * (values[first] + values[first + size - 1])
        support[i] = 0
        mean0, mean1, mean2, square = 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            if used[k, i]:
                d0 = samples[k, i, 0] - color[i, 0]
                d1 = samples[k, i, 1] - color[i, 1]
                d2 = samples[k, i, 2] - color[i, 2]
                if abs(d0) < limit and abs(d1) < limit and abs(d2) < limit:
                    support[i] += 1
                    mean0, mean1, mean2 = mean0 + d0, mean1 + d1, mean2 + d2
                    square += d0 * d0 + d1 * d1 + d2 * d2
        if support[i] > 1:
            mean0, mean1, mean2 = mean0 / support[i], mean1 / support[i], mean2 / support[i]
            squares += square - support[i] * (mean0 * mean0 + mean1 * mean1 + mean2 * mean2)
            count += 3 * (support[i] - 1)
            color[i, 0] += mean0
            color[i, 1] += mean1
            color[i, 2] += mean2
    return squares / max(count, 1)


def _color_bins(colors: Image | FloatImage) -> tuple[Image, Image, Image]:
    levels = np.clip(colors, 0, 255).astype(np.uint8) // (256 // COLOR_BINS)
    return levels[..., 0], levels[..., 1], levels[..., 2]


def _estimate_color_density(colors: Image | FloatImage) -> FloatArray:
    """Estimate the density (16, 16, 16) of colors (n, 3): a smoothed histogram and a uniform part."""
    counts = np.zeros((COLOR_BINS,) * 3)
    np.add.at(counts, _color_bins(colors), 1.0)
    for axis in range(3):  # neighboring bins share what the noise exchanges
        padded = np.pad(counts, [(int(a == axis),) * 2 for a in range(3)], mode="edge")
        low, middle, high = (padded.take(range(k, k + COLOR_BINS), axis) for k in range(3))
        counts = (low + 2 * middle + high) / 4
    learned = counts / max(counts.sum(), 1.0) * (COLOR_BINS / 256) ** 3
    return np.asarray((1 - UNIFORM_SHARE) * learned + UNIFORM_SHARE * 256.0**-3)


def find_silhouette(background: Background, image: Image) -> Silhouette:
    """Find what is in front of the background in an image of the same camera.

    Args:
        background: of the camera.
        image: (h, w, 3) BGR, of equal gain (`level_images`).
    """
    colors = image.astype(np.float32)
    # A median: noise differs from pixel to pixel, an object does not.
    log_odds = np.asarray(cv2.medianBlur(_log_odds(image, background), 3), np.float32)
    log_odds[~background.is_known] = 0.0
    is_hole = _find_small_holes(log_odds)
    log_odds[is_hole] = 0.0
    return Silhouette(_refine_outline(colors, (log_odds >= 0).astype(np.uint8), background), log_odds)


def _find_small_holes(log_odds: FloatImage) -> BoolArray:
    """Return the small parts of the background that others surround: places of an object that look like it."""
    _, parts, statistics, _ = cv2.connectedComponentsWithStats((log_odds < 0).astype(np.uint8), connectivity=4)
    is_small = statistics[:, cv2.CC_STAT_AREA] < MAX_HOLE_SHARE * (log_odds > 0).sum()
    is_small[0] = False  # all others
    return np.asarray(is_small[parts])


def _refine_outline(colors: FloatImage, is_foreground: Image, background: Background) -> FloatImage:
    """Compute the share of the foreground, also along the outline, where it is mixed with the background.

    A threshold far below the contrast would move outlines outwards by half a pixel. The foreground's color is that of
    the nearest pixel inside.
    """
    side = np.ones((2 * OUTLINE_PX + 1,) * 2, np.uint8)
    inside, outside = cv2.erode(is_foreground, side), cv2.dilate(is_foreground, side)
    share = is_foreground.astype(np.float32)
    # Farther inside, another color is rather the object's texture.
    band = (outside > 0) & (cv2.erode(is_foreground, np.ones((3, 3), np.uint8)) == 0) & background.is_known
    if not inside.any() or not band.any():
        return share
    _, labels = cv2.distanceTransformWithLabels(1 - inside, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    inner = np.zeros((labels.max() + 1, 3), np.float32)
    inner[labels[inside > 0]] = cv2.blur(colors, (3, 3))[inside > 0]
    step = inner[labels[band]] - background.color[band]
    square = np.square(step).sum(axis=1)
    part = ((colors[band] - background.color[band]) * step).sum(axis=1) / np.maximum(square, 1e-6)
    is_visible = square > (SUPPORT_SDS * background.noise) ** 2
    share[band] = np.where(is_visible, np.clip(part, 0, 1), share[band])
    return share


def _log_odds(colors: Image | FloatImage, background: Background) -> FloatImage:
    """Return log densities of colors (h, w, 3), foreground against background."""
    foreground = np.log(background.foreground_density).astype(np.float32)[_color_bins(colors)]
    square = np.square(colors - background.color).sum(axis=2) / background.noise**2
    power = (T_FREEDOM + 3) / 2
    constant = gammaln(power) - gammaln(T_FREEDOM / 2) - 1.5 * np.log(T_FREEDOM * np.pi) - 3 * np.log(background.noise)
    return np.asarray(foreground - constant + power * np.log1p(square / T_FREEDOM), np.float32)


def level_images(images: Sequence[Image]) -> list[Image]:
    """Return the images of a static camera with gain and offset of each channel fitted to their median, robustly."""
    reference = np.median(np.stack(images), axis=0).astype(np.float32)
    return [level_image(image, reference) for image in images]


def level_image(image: Image, reference: FloatImage) -> Image:
    """Return an image with gain and offset of each channel fitted to a reference (h, w, 3), robustly."""
    table, channels = np.arange(256.0), []
    for channel in range(3):
        x, y = (of[::GAIN_STEP, ::GAIN_STEP, channel].ravel().astype(float) for of in (image, reference))
        gain, offset = 1.0, float(np.median(y - x))
        for _ in range(GAIN_ROUNDS):
            residual = y - gain * x - offset
            scale = max(1.4826 * float(np.median(np.abs(residual))), 1.0)
            weight = np.maximum(1 - np.square(residual / (GAIN_CUTOFF * scale)), 0) ** 2
            mean_x, mean_y = (float(np.average(v, weights=weight)) for v in (x, y))
            spread = float((weight * (x - mean_x) ** 2).sum())
            # Without contrast in the background there is an offset only.
            gain = float((weight * (x - mean_x) * (y - mean_y)).sum()) / spread if spread > weight.sum() else gain
            offset = mean_y - gain * mean_x
        channels.append(np.clip(np.rint(gain * table + offset), 0, 255).astype(np.uint8)[image[..., channel]])
    return np.stack(channels, axis=2)
