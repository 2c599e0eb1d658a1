"""How far apart in time cameras are, from how fast things move in the pictures of each.

The speed of the pictures rises and falls with the object's, in every camera at once: what one camera's speed over time must
be moved by to look like another's is how much later it is. Nothing needs to be tracked or calibrated for that. It is good to
a frame or better; `smoothing.trajectory.smooth` then finds the rest from the object's poses.
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

__all__ = ["Delays", "Pulse", "coarse_offsets", "image_speed", "small_grey", "split_offsets"]


# Pictures are made this wide: speeds matter, not details (choice: time).
WIDTH = 320
# Corners that are followed, and how many are needed for a speed (choice).
MAX_CORNERS, MIN_CORNERS = 200, 8
# Grey levels by which a picture must change to be looked at, at least; and how many times the noise
# (choice).
MIN_CHANGE, CHANGE = 6.0, 4.0
# Pixels from frame to frame below which speeds are not told apart (choice: what following corners is good to).
STILL = 0.1
# Two cameras are compared where at least so many samples, and this share of the shorter signal, overlap (choice).
MIN_SAMPLES, MIN_OVERLAP = 20, 0.5
# How probable a likeness by chance may be, over all lags; and by how many standard deviations it must surpass that of any
# other lag that is a peak of its own (choice).
MAX_CHANCE, CLEARER = 1e-3, 2.0
# Samples by which a pair may contradict the others before it is left out (choice).
AGREE = 1.5


@dataclass(frozen=True, eq=False)
class Pulse:
    """How fast one camera's pictures move.

    Attributes:
        times: (n,) seconds, increasing: midway between two frames, by the camera's own clock.
        speeds: (n,) pixels of the `WIDTH` wide picture, per frame.
    """

    times: FloatArray
    speeds: FloatArray


@dataclass(frozen=True, eq=False)
class Delays:
    """What the pulses of C cameras tell.

    Attributes:
        offsets: (C,) seconds by which each camera is late, the mean of those told 0; 0 for the others.
        sd: (C,) standard deviations, infinite where not told.
        told: (C,) which ones can be told relative to each other.
    """

    offsets: FloatArray
    sd: FloatArray
    told: BoolArray


def small_grey(image: Image) -> Image:
    """An image BGR (h, w, 3) as `image_speed` wants it: grey and at most `WIDTH` wide."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    scale = WIDTH / grey.shape[1]
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.0), dtype=np.uint8)


def image_speed(before: Image, after: Image) -> float:
    """Median displacement, pixels, of the corners where one picture differs from another; 0 where hardly anything does.

    Args:
        before, after: (h, w) of `small_grey`, of one static camera.
    """
    change = cv2.absdiff(before, after)
    changed = (change > max(MIN_CHANGE, CHANGE * float(np.median(change)))).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(
        before, MAX_CORNERS, 0.01, 4.0, mask=cv2.dilate(changed, np.ones((9, 9), np.uint8))
    )
    if corners is None or len(corners) < MIN_CORNERS:
        return 0.0
    there, found = _follow(before, after, corners)
    back, found_back = _follow(after, before, there)
    astray = np.linalg.norm((back - corners).reshape(-1, 2), axis=1)
    good = found & found_back & (astray < 0.5)
    if good.sum() < MIN_CORNERS:
        return 0.0
    return float(np.median(np.linalg.norm((there - corners).reshape(-1, 2)[good], axis=1)))


def _follow(before: Image, after: Image, corners: Any) -> tuple[Any, BoolArray]:
    """Where the corners (n, 1, 2) are in another picture, and (n,) which were found."""
    nothing: Any = None  # OpenCV's stubs do not agree between versions
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, nothing, winSize=(15, 15), maxLevel=3)
    return there, np.asarray(found).ravel() > 0


def coarse_offsets(pulses: Sequence[Pulse], rate: float, max_lag: float) -> Delays:
    """By how much each camera is late, from the likeness of their pulses.

    The logarithms of the speeds are correlated (a camera that is twice as near sees twice the speed), at all lags for all
    pairs of cameras; of the pairs that tell, the surest that connect all cameras give a start, and those that agree with
    it the weighted least-squares answer.

    Args:
        pulses: of C cameras.
        rate: frames per second.
        max_lag: seconds that two cameras may be apart.

    Raises:
        ValueError: a rate or lag that is not positive.
    """
    for name, value in (("rate", rate), ("max_lag", max_lag)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be positive, got {value}")
    n = len(pulses)
    signals = _on_grid(pulses, rate)
    pairs = [
        (a, b, *found)
        for a, b in combinations(range(n), 2)
        if (found := _lag(signals[a], signals[b], round(max_lag * rate))) is not None
    ]
    if not pairs:
        return Delays(np.zeros(n), np.full(n, np.inf), np.zeros(n, bool))
    first, second = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    lags, sds = np.array([p[2] for p in pairs]), np.array([p[3] for p in pairs])
    graph = coo_array((sds, (first, second)), shape=(n, n)).tocsr()
    _, part = connected_components(graph, directed=False)
    told = np.asarray(part == np.bincount(part).argmax())
    used = told[first]
    first, second, lags, sds = first[used], second[used], lags[used], sds[used]

    rows = np.arange(len(lags))
    design = np.zeros((len(lags), n))
    design[rows, second], design[rows, first] = 1.0, -1.0
    tree = minimum_spanning_tree(graph).toarray()
    kept = tree[first, second] > 0
    offsets, covariance = _solved(design[kept], lags[kept], sds[kept], told)
    agreed = np.abs(design @ offsets - lags) < np.maximum(AGREE, 3.0 * sds)
    offsets, covariance = _solved(design[agreed], lags[agreed], sds[agreed], told)
    sd = np.where(told, np.sqrt(np.maximum(np.diag(covariance), 0.0)), np.inf)
    return Delays(offsets / rate, sd / rate, told)


def split_offsets(seconds: ArrayLike, rate: float) -> tuple[IntArray, FloatArray]:
    """Whole frames and the rest of how late cameras are, so that the rests are as near together as can be.

    Args:
        seconds: (C,) by which each camera's images are later than their times say.
        rate: frames per second.

    Returns:
        frames: (C,) as `open_session` takes them as offsets, the largest 0, so that all cameras have an image at the first
            instant; all 0 when no two cameras are more than a frame apart.
        remainder: (C,) seconds, their mean 0; frames / rate + remainder is `seconds`, give or take a number for all.
    """
    late = np.atleast_1d(np.asarray(seconds, dtype=float)) * rate
    frames = np.zeros(len(late), np.int64)
    if np.ptp(late) > 1.0:
        # Seen modulo a frame, the cameras lie on a circle: it is cut in the widest gap between two neighbours.
        phases = np.sort(late % 1.0)
        gaps = np.diff(np.append(phases, phases[0] + 1.0))
        first = phases[(gaps.argmax() + 1) % len(phases)]
        frames = np.floor(late - first + 1e-9).astype(np.int64)
    rest = late - frames
    return frames - frames.max(), np.asarray((rest - rest.mean()) / rate)


def _solved(design: FloatArray, lags: FloatArray, sds: FloatArray, told: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Weighted least squares with the mean of those told 0, and the covariance."""
    normal = design.T @ (design / sds[:, None] ** 2)
    inverse = np.linalg.pinv(normal, rcond=1e-9, hermitian=True)
    offsets = inverse @ design.T @ (lags / sds**2)
    return np.where(told, offsets - offsets[told].mean(), 0.0), np.asarray(inverse)


def _on_grid(pulses: Sequence[Pulse], rate: float) -> FloatArray:
    """(C, n) logarithms of the speeds at common times, 1 / rate apart; NaN where a camera tells nothing."""
    start = min((float(p.times[0]) for p in pulses if len(p.times)), default=0.0)
    end = max((float(p.times[-1]) for p in pulses if len(p.times)), default=0.0)
    grid = start + np.arange(round((end - start) * rate) + 1) / rate
    signals = np.full((len(pulses), len(grid)), np.nan)
    for signal, pulse in zip(signals, pulses, strict=True):
        if len(pulse.times) < 2:
            continue
        after = np.clip(np.searchsorted(pulse.times, grid), 1, len(pulse.times) - 1)
        near = np.diff(pulse.times)[after - 1] < 2.5 / rate  # across one missing frame
        slack = 1e-3 / rate
        inside = (grid >= pulse.times[0] - slack) & (grid <= pulse.times[-1] + slack)
        known = near & inside
        signal[known] = np.interp(grid[known], pulse.times, np.log(pulse.speeds + STILL))
    return signals


def _lag(a: FloatArray, b: FloatArray, reach: int) -> tuple[float, float] | None:
    """Samples by which b is later than a, and its standard deviation; None where they do not tell."""
    enough = max(MIN_SAMPLES, MIN_OVERLAP * min(np.isfinite(a).sum(), np.isfinite(b).sum()))
    lags = np.arange(-reach, reach + 1)
    likeness = np.array([_correlation(*_overlap(a, b, int(lag)), enough) for lag in lags])
    peaks = 1 + np.flatnonzero((likeness[1:-1] >= likeness[:-2]) & (likeness[1:-1] > likeness[2:]))
    if not len(peaks):
        return None
    best = peaks[likeness[peaks].argmax()]
    if likeness[best] < np.nanmax(likeness):
        return None  # at the end of what could be compared: the peak is beyond it
    free = _degrees_of_freedom(*_overlap(a, b, int(lags[best])))
    if free <= 4.0:
        return None
    # Fisher's transform is about normal with this standard deviation.
    spread = 1.0 / np.sqrt(free - 3.0)
    heights = np.arctanh(np.minimum(likeness[peaks], 1 - 1e-9)) / spread
    height = np.arctanh(min(likeness[best], 1 - 1e-9)) / spread
    n = int(np.isfinite(np.add(*_overlap(a, b, int(lags[best])))).sum())
    tries = max(np.isfinite(likeness).sum() * free / n, 1.0)
    others = heights[peaks != best]
    if tries * ndtr(-height) > MAX_CHANCE or (len(others) and others.max() > height - CLEARER):
        return None
    before, top, after = likeness[best - 1 : best + 2]
    bend = 2 * top - before - after
    sd = np.sqrt((1 - top**2) / (free * bend))
    return float(lags[best] + 0.5 * (after - before) / bend), float(np.hypot(sd, 0.05))


def _overlap(a: FloatArray, b: FloatArray, lag: int) -> tuple[FloatArray, FloatArray]:
    """The samples that meet if b is late by so many."""
    n = max(len(a) - abs(lag), 0)
    return a[max(lag, 0) :][:n], b[max(-lag, 0) :][:n]


def _correlation(a: FloatArray, b: FloatArray, enough: float) -> float:
    """Of the samples where both are known; NaN where those are too few or do not change."""
    known = np.isfinite(a) & np.isfinite(b)
    if known.sum() < enough:
        return np.nan
    a, b = a[known] - a[known].mean(), b[known] - b[known].mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 1e-9 * len(a) else np.nan


def _degrees_of_freedom(a: FloatArray, b: FloatArray) -> float:
    """How many independent samples two signals are worth that change slowly (Bartlett's formula)."""
    n = int((np.isfinite(a) & np.isfinite(b)).sum())
    total = 1.0
    for lag in range(1, len(a) // 2):
        both = [_correlation(s[lag:], s[:-lag], MIN_SAMPLES / 2) for s in (a, b)]
        if not min(both) > 0:
            break
        total += 2.0 * (1.0 - lag / n) * both[0] * both[1]
    return n / total
