"""Coarse time offsets between cameras, by correlation of image speeds.

The image speed rises and falls with the object's speed in all cameras simultaneously. The lag at which one camera's
speed signal correlates best with another's is their time offset. This requires neither tracking nor calibration. The
result is good to a frame or better; `smoothing.smooth` then refines it from the object poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.special import ndtr

from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray

# Width to which images are downscaled: speeds matter, not details (choice: time).
IMAGE_WIDTH = 320
# Largest number of tracked corners, and least number for a speed (choice).
MAX_CORNERS, MIN_CORNERS = 200, 8
# Least change of a pixel, gray levels, to be considered; and as a multiple of the noise (choice).
MIN_CHANGE, CHANGE_NOISE_FACTOR = 6.0, 4.0
# Speed resolution, pixels per frame (choice: the precision of corner tracking).
SPEED_RESOLUTION_PX = 0.1
# Least overlap of two cameras: samples, and share of the shorter signal (choice).
MIN_SAMPLES, MIN_OVERLAP = 20, 0.5
# Largest probability of a chance correlation, over all lags; and number of standard deviations by which the best peak
# must exceed any other peak (choice).
MAX_CHANCE_PROBABILITY, MIN_PEAK_MARGIN = 1e-3, 2.0
# Largest disagreement of a camera pair with the others before it is rejected, samples (choice).
MAX_LAG_RESIDUAL = 1.5


@dataclass(frozen=True, eq=False)
class SpeedSignal:
    """Image speed of one camera over time.

    Attributes:
        times: (n,) seconds, increasing: midway between two frames, by the camera's clock.
        speeds: (n,) pixels of the `IMAGE_WIDTH` wide image, per frame.
    """

    times: FloatArray
    speeds: FloatArray


@dataclass(frozen=True, eq=False)
class OffsetEstimate:
    """Estimated time offsets of C cameras.

    Attributes:
        offsets: (C,) delay of each camera, seconds; zero mean over the determined ones; 0 for the others.
        sd: (C,) standard deviations, infinite if not determined.
        is_determined: (C,) cameras whose offsets relative to each other are determined.
    """

    offsets: FloatArray
    sd: FloatArray
    is_determined: BoolArray


def to_small_gray(image: Image) -> Image:
    """Convert an image BGR (h, w, 3) to the input of `compute_image_speed`.

    It is gray, blurred and at most `IMAGE_WIDTH` wide.
    """
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    scale = IMAGE_WIDTH / gray.shape[1]
    if scale < 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(gray, (0, 0), 1.0), dtype=np.uint8)


def compute_image_speed(before: Image, after: Image) -> float:
    """Compute the median displacement of corners in the changed areas of two images, pixels.

    Args:
        before, after: (h, w) of `to_small_gray`, of one static camera.

    Returns:
        The displacement; 0 if hardly anything changes.
    """
    change = cv2.absdiff(before, after)
    changed = (change > max(MIN_CHANGE, CHANGE_NOISE_FACTOR * float(np.median(change)))).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(
        before, MAX_CORNERS, 0.01, 4.0, mask=cv2.dilate(changed, np.ones((9, 9), np.uint8))
    )
    if corners is None or len(corners) < MIN_CORNERS:
        return 0.0
    forward, found = _track_corners(before, after, corners)
    backward, found_back = _track_corners(after, before, forward)
    round_trip_error = np.linalg.norm((backward - corners).reshape(-1, 2), axis=1)
    good = found & found_back & (round_trip_error < 0.5)
    if good.sum() < MIN_CORNERS:
        return 0.0
    return float(np.median(np.linalg.norm((forward - corners).reshape(-1, 2)[good], axis=1)))


def _track_corners(before: Image, after: Image, corners: Any) -> tuple[Any, BoolArray]:
    """Track the corners (n, 1, 2) into another image; return positions and success (n,)."""
    nothing: Any = None  # OpenCV's stubs do not agree between versions
    tracked, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, nothing, winSize=(15, 15), maxLevel=3)
    return tracked, np.asarray(found).ravel() > 0


def estimate_coarse_offsets(speed_signals: Sequence[SpeedSignal], rate: float, max_lag: float) -> OffsetEstimate:
    """Estimate the delay of each camera by correlating image speeds.

    Logarithms of the speeds are correlated (a camera at half the distance sees twice the speed), at all lags for all
    pairs of cameras. Of the significant pairs, the most precise ones that connect all cameras give an initial solution;
    pairs consistent with it enter the weighted least-squares solution.

    Args:
        speed_signals: speed signals of C cameras.
        rate: frames per second.
        max_lag: largest offset between two cameras, seconds.

    Raises:
        ValueError: a rate or lag that is not positive.
    """
    for name, value in (("rate", rate), ("max_lag", max_lag)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be positive, got {value}")
    n = len(speed_signals)
    signals, max_samples = _resample_log_speeds(speed_signals, rate), round(max_lag * rate)
    estimates = [(a, b, _estimate_lag(signals[a], signals[b], max_samples)) for a, b in combinations(range(n), 2)]
    pairs = [(a, b, *found) for a, b, found in estimates if found is not None]
    if not pairs:
        return OffsetEstimate(np.zeros(n), np.full(n, np.inf), np.zeros(n, bool))
    first, second = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    lags, sds = np.array([p[2] for p in pairs]), np.array([p[3] for p in pairs])
    graph = coo_array((sds, (first, second)), shape=(n, n)).tocsr()
    _, part = connected_components(graph, directed=False)
    is_determined = np.asarray(part == np.bincount(part).argmax())
    used = is_determined[first]
    first, second, lags, sds = first[used], second[used], lags[used], sds[used]

    rows = np.arange(len(lags))
    design = np.zeros((len(lags), n))
    design[rows, second], design[rows, first] = 1.0, -1.0
    tree = minimum_spanning_tree(graph).toarray()
    kept = tree[first, second] > 0
    offsets, covariance = _solve_offsets(design[kept], lags[kept], sds[kept], is_determined)
    is_consistent = np.abs(design @ offsets - lags) < np.maximum(MAX_LAG_RESIDUAL, 3.0 * sds)
    offsets, covariance = _solve_offsets(design[is_consistent], lags[is_consistent], sds[is_consistent], is_determined)
    sd = np.where(is_determined, np.sqrt(np.maximum(np.diag(covariance), 0.0)), np.inf)
    return OffsetEstimate(offsets / rate, sd / rate, is_determined)


def split_offsets(seconds: ArrayLike, rate: float) -> tuple[IntArray, FloatArray]:
    """Split delays into whole frames and remainders that are as close together as possible.

    Args:
        seconds: (C,) delay of each camera's images relative to their timestamps.
        rate: frames per second.

    Returns:
        frames: (C,) offsets as for `open_session`, the largest 0, so that all cameras have an image in the first frame
            set; all 0 if no two cameras are more than a frame apart.
        remainder: (C,) seconds, zero mean; frames / rate + remainder equals `seconds` up to a common constant.
    """
    delays = np.atleast_1d(np.asarray(seconds, dtype=float)) * rate
    frames = np.zeros(len(delays), np.int64)
    if np.ptp(delays) > 1.0:
        # Modulo one frame interval, the delays lie on a circle, which is cut in the widest gap between neighbors.
        phases = np.sort(delays % 1.0)
        gaps = np.diff(np.append(phases, phases[0] + 1.0))
        first = phases[(gaps.argmax() + 1) % len(phases)]
        frames = np.floor(delays - first + 1e-9).astype(np.int64)
    remainder = delays - frames
    return frames - frames.max(), np.asarray((remainder - remainder.mean()) / rate)


def _solve_offsets(
    design: FloatArray, lags: FloatArray, sds: FloatArray, is_determined: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Solve weighted least squares with zero mean over the determined cameras; return offsets and covariance."""
    normal = design.T @ (design / sds[:, None] ** 2)
    inverse = np.linalg.pinv(normal, rcond=1e-9, hermitian=True)
    offsets = inverse @ design.T @ (lags / sds**2)
    return np.where(is_determined, offsets - offsets[is_determined].mean(), 0.0), np.asarray(inverse)


def _resample_log_speeds(speed_signals: Sequence[SpeedSignal], rate: float) -> FloatArray:
    """Resample the logarithms of the speeds to common times.

    Returns:
        (C, n), sampled at 1 / rate; NaN where a camera has no samples.
    """
    start = min((float(p.times[0]) for p in speed_signals if len(p.times)), default=0.0)
    end = max((float(p.times[-1]) for p in speed_signals if len(p.times)), default=0.0)
    grid = start + np.arange(round((end - start) * rate) + 1) / rate
    signals = np.full((len(speed_signals), len(grid)), np.nan)
    for signal, pulse in zip(signals, speed_signals, strict=True):
        if len(pulse.times) < 2:
            continue
        after = np.clip(np.searchsorted(pulse.times, grid), 1, len(pulse.times) - 1)
        near = np.diff(pulse.times)[after - 1] < 2.5 / rate  # across one missing frame
        slack = 1e-3 / rate
        inside = (grid >= pulse.times[0] - slack) & (grid <= pulse.times[-1] + slack)
        known = near & inside
        signal[known] = np.interp(grid[known], pulse.times, np.log(pulse.speeds + SPEED_RESOLUTION_PX))
    return signals


def _estimate_lag(a: FloatArray, b: FloatArray, max_lag: int) -> tuple[float, float] | None:
    """Return the delay of b relative to a in samples, with its standard deviation; None if insignificant."""
    min_samples = max(MIN_SAMPLES, MIN_OVERLAP * min(np.isfinite(a).sum(), np.isfinite(b).sum()))
    lags = np.arange(-max_lag, max_lag + 1)
    correlations = np.array([_correlate(*_align_samples(a, b, int(lag)), min_samples) for lag in lags])
    peaks = 1 + np.flatnonzero((correlations[1:-1] >= correlations[:-2]) & (correlations[1:-1] > correlations[2:]))
    if not len(peaks):
        return None
    best = peaks[correlations[peaks].argmax()]
    if correlations[best] < np.nanmax(correlations):
        return None  # at the end of the compared lags: the peak is beyond
    degrees_of_freedom = _count_effective_samples(*_align_samples(a, b, int(lags[best])))
    if degrees_of_freedom <= 4.0:
        return None
    # Fisher's transform is approximately normal with this standard deviation.
    spread = 1.0 / np.sqrt(degrees_of_freedom - 3.0)
    z_scores = np.arctanh(np.minimum(correlations[peaks], 1 - 1e-9)) / spread
    best_z_score = np.arctanh(min(correlations[best], 1 - 1e-9)) / spread
    n = int(np.isfinite(np.add(*_align_samples(a, b, int(lags[best])))).sum())
    tries = max(np.isfinite(correlations).sum() * degrees_of_freedom / n, 1.0)
    others = z_scores[peaks != best]
    if tries * ndtr(-best_z_score) > MAX_CHANCE_PROBABILITY or (
        len(others) and others.max() > best_z_score - MIN_PEAK_MARGIN
    ):
        return None
    before, top, after = correlations[best - 1 : best + 2]
    curvature = 2 * top - before - after
    sd = np.sqrt((1 - top**2) / (degrees_of_freedom * curvature))
    return float(lags[best] + 0.5 * (after - before) / curvature), float(np.hypot(sd, 0.05))


def _align_samples(a: FloatArray, b: FloatArray, lag: int) -> tuple[FloatArray, FloatArray]:
    """Return the samples that coincide if b is delayed by `lag`."""
    n = max(len(a) - abs(lag), 0)
    return a[max(lag, 0) :][:n], b[max(-lag, 0) :][:n]


def _correlate(a: FloatArray, b: FloatArray, min_samples: float) -> float:
    """Compute the correlation over samples known in both; NaN if they are too few or constant."""
    known = np.isfinite(a) & np.isfinite(b)
    if known.sum() < min_samples:
        return np.nan
    a, b = a[known] - a[known].mean(), b[known] - b[known].mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 1e-9 * len(a) else np.nan


def _count_effective_samples(a: FloatArray, b: FloatArray) -> float:
    """Compute the effective number of independent samples of two autocorrelated signals (Bartlett's formula)."""
    n = int((np.isfinite(a) & np.isfinite(b)).sum())
    total = 1.0
    for lag in range(1, len(a) // 2):
        both = [_correlate(s[lag:], s[:-lag], MIN_SAMPLES / 2) for s in (a, b)]
        if not min(both) > 0:
            break
        total += 2.0 * (1.0 - lag / n) * both[0] * both[1]
    return n / total
