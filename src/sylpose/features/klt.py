"""Features followed from image to image: faster than detecting and matching them anew, and more precise.

A feature's surroundings at its keyframe, a square patch, are found again in every later image in two steps: pyramidal
Lucas-Kanade from the image before says where, within a pixel or so; then the keyframe's own patch is laid over that place
with an affine warp, and with the brightness and contrast that fit. So errors do not add up over the images between, and a
feature is kept only while it looks as it did at its keyframe. When an object turns by 1.5 degrees per frame, following from
image to image alone is off by 0.6 pixels after 10 (median; the patch's change of shape is taken for motion, always the same
way), this by 0.06, and SIFT keypoints matched with the keyframe's by 0.23.

Sources: Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000 (OpenCV's); Shi & Tomasi, "Good
features to track", CVPR 1994 (affine comparison with the first patch); Baker & Matthews, "Lucas-Kanade 20 years on", IJCV
2004 (inverse compositional, with gain and bias projected out, part 3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.geometry.numba_linalg import kernel

__all__ = ["Patches", "Tracks", "advance", "begin", "evened", "grey"]

Filters = NDArray[np.float32]

# Patches reach so many pixels around their feature.
HALF = 6
# Noise of a patch, grey levels, and how far its rim may be off at the start, pixels: where a patch has little texture, the
# warp stays near its start.
NOISE, PRIOR_PX = 4.0, 2.0
# A patch whose texture gives its place no better than this, pixels, is not followed.
MAX_SD_PX = 0.3
# Steps of the registration, at most; it ends when the patch moves by less than this, pixels.
ROUNDS, SETTLED_PX = 10, 0.03
# The registration may move a feature by so much, pixels: further away, it has found something else.
REACH_PX = 2.0
# Least correlation with the keyframe's patch.
LIKENESS = 0.85
# From image to image: window, pixels; levels above the image itself; steps per level. The smaller the window, the less a
# change of shape is taken for motion.
WINDOW, LEVELS = (9, 9), 2
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03)
# Changes of the light are evened out over a square so wide, pixels. A smaller one would shorten the reach.
EVEN_PX = 51
# Pixels around the features that are looked at: the coarsest level's window and the motion.
MARGIN_PX = 40


@dataclass(frozen=True, eq=False)
class Patches:
    """What n features look like at their keyframe, ready to be laid over later images.

    Attributes:
        filters: (n, s, 8) float32, s = (2 HALF + 1)^2 samples row by row. A sampled patch times these gives the steps of
            the warp's six parameters, for a gain of one, then the gain, then the mean. About 5 kB per feature.
        contrast: (n,) the norm of the patch less its mean.
        sd: (n,) standard deviation of the patch's place, pixels, that its texture allows.
    """

    filters: Filters
    contrast: FloatArray
    sd: FloatArray

    def __len__(self) -> int:
        return len(self.contrast)


@dataclass(frozen=True, eq=False)
class Tracks:
    """n features of a keyframe, as far as they have been followed. Rows stay in order, lost ones too.

    Attributes:
        patches: at the keyframe.
        pixels: (n, 2) where they are now; NaN for those that are lost.
        warps: (n, 2, 2) from offsets in the keyframe's patch to offsets in the image, the last that was found.
        followed: (n,) False for those that are lost.
    """

    patches: Patches
    pixels: FloatArray
    warps: FloatArray
    followed: BoolArray

    def __len__(self) -> int:
        return len(self.pixels)

    def subset(self, rows: IntArray) -> Tracks:
        """Some of the rows (m,), in this order."""
        patches = Patches(self.patches.filters[rows], self.patches.contrast[rows], self.patches.sd[rows])
        return Tracks(patches, self.pixels[rows], self.warps[rows], self.followed[rows])

    def join(self, others: Tracks) -> Tracks:
        """These rows, then those."""
        a, b = self.patches, others.patches
        patches = Patches(
            np.concatenate([a.filters, b.filters]),
            np.concatenate([a.contrast, b.contrast]),
            np.concatenate([a.sd, b.sd]),
        )
        return Tracks(
            patches,
            np.concatenate([self.pixels, others.pixels]),
            np.concatenate([self.warps, others.warps]),
            np.concatenate([self.followed, others.followed]),
        )

    def keep(self, mask: BoolArray) -> Tracks:
        """The same features; those outside the mask (n,) are lost, such as outliers of a motion."""
        followed = self.followed & mask
        return replace(self, pixels=np.where(followed[:, None], self.pixels, np.nan), followed=followed)


def grey(image: Image) -> Image:
    """(h, w) of an image (h, w, 3) BGR or (h, w) grey, uint8: what `begin` and `advance` take. Made once per image, it
    serves for both pairs that the image is part of.

    Raises:
        ValueError: another shape or type.
    """
    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)) or not image.size:
        raise ValueError(f"an image must be uint8, (h, w, 3) BGR or (h, w), got {image.dtype} {image.shape}")
    return np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image, dtype=np.uint8)


def begin(image: Image, pixels: ArrayLike) -> Tracks:
    """The features (n, 2) of a keyframe, to be followed from here. Those too near to the rim of the image for a patch, and
    those on plain ground, are lost for good.

    Args:
        image: (h, w) grey.

    Raises:
        ValueError: an image that `grey` did not make, or pixels that are not (n, 2) and finite.
    """
    image, pixels = _checked(image, "image"), _points(pixels, "pixels")
    if not np.isfinite(pixels).all():
        raise ValueError("pixels: those of a keyframe must be finite")
    n, side = len(pixels), 2 * HALF + 3  # one more on each side, for derivatives
    corners = np.floor(pixels).astype(np.int64) - HALF - 1
    inside = ((corners >= 0) & (corners + side < np.array(image.shape[::-1]))).all(axis=1)
    corners[~inside] = 0
    offsets = np.arange(side + 1)
    if not inside.any():
        patches = np.zeros((n, side, side), np.float32)
    else:
        rows, columns = corners[:, 1, None] + offsets, corners[:, 0, None] + offsets
        values = image[rows[:, :, None], columns[:, None, :]].astype(np.float32)
        fx, fy = (pixels - np.floor(pixels)).astype(np.float32).T[..., None, None]
        values = values[:, :, :-1] + fx * (values[:, :, 1:] - values[:, :, :-1])
        patches = values[:, :-1] + fy * (values[:, 1:] - values[:, :-1])
    of_keyframe = _filters(patches)
    followed = inside & (of_keyframe.sd < MAX_SD_PX)
    of_keyframe.filters[~followed] = 0.0  # these resemble nothing, whatever is guessed
    tracks = Tracks(of_keyframe, pixels, np.tile(np.eye(2), (n, 1, 1)), followed)
    return tracks.keep(followed)


def advance(tracks: Tracks, previous: Image, current: Image, guess: ArrayLike | None = None) -> Tracks:
    """The features in the next image.

    Args:
        tracks: where they are in `previous`.
        previous, current: (h, w) grey, of the same size.
        guess: (n, 2) where they are expected in `current`, within about 4 pixels; without it, they may have moved by about 8
            since `previous`. Features that were lost are looked for where it is finite, and found if it is right within
            about 1.5 pixels: with `current` as `previous` too, and the places that its pose gives, those lost on the way to
            it are looked for again.

    Raises:
        ValueError: images that `grey` did not make or of two sizes, or a guess that is not (n, 2).
    """
    previous, current = _checked(previous, "previous"), _checked(current, "current")
    if previous.shape != current.shape:
        raise ValueError(f"images of one camera must have one size, got {previous.shape} and {current.shape}")
    start = tracks.pixels.copy() if guess is None else _points(guess, "guess")
    if len(start) != len(tracks):
        raise ValueError(f"guess: {len(start)} places for {len(tracks)} features")
    start = np.where(np.isfinite(start).all(axis=1, keepdims=True), start, tracks.pixels)
    flown = np.flatnonzero(tracks.followed)
    start[flown] = _flow(previous, current, tracks.pixels[flown], start[flown])
    tried = np.flatnonzero(np.isfinite(start).all(axis=1))
    places, warps, likeness = start[tried], tracks.warps[tried], np.zeros(len(tried))
    _register(current, tracks.patches.filters, tracks.patches.contrast, tried, places, warps, likeness)
    found = likeness > LIKENESS
    pixels, of_all, followed = np.full_like(start, np.nan), tracks.warps.copy(), np.zeros(len(tracks), bool)
    pixels[tried[found]], of_all[tried[found]], followed[tried[found]] = places[found], warps[found], True
    return Tracks(tracks.patches, pixels, of_all, followed)


def _checked(image: Image, name: str) -> Image:
    if image.dtype != np.uint8 or image.ndim != 2 or not image.size:
        raise ValueError(f"{name}: must be a grey image (h, w), uint8, got {image.dtype} {image.shape}")
    return np.ascontiguousarray(image)


def _points(points: ArrayLike, name: str) -> FloatArray:
    array = np.array(points, dtype=float)
    if array.size == 0:
        return np.empty((0, 2))
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"{name}: must be (n, 2), got {array.shape}")
    return array


def _filters(patches: Filters) -> Patches:
    """Of patches (n, side + 2, side + 2), sampled around the features with one pixel more on every side."""
    n, samples = len(patches), (2 * HALF + 1) ** 2
    along_u = (0.5 * (patches[:, 1:-1, 2:] - patches[:, 1:-1, :-2])).reshape(n, samples)
    along_v = (0.5 * (patches[:, 2:, 1:-1] - patches[:, :-2, 1:-1])).reshape(n, samples)
    v, u = (np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].reshape(2, -1) / HALF).astype(np.float32)
    # The derivatives by a shift and by a warp, the warp's in pixels at the patch's rim.
    slopes = np.stack([along_u, along_v, along_u * u, along_u * v, along_v * u, along_v * v], axis=1)
    texture = patches[:, 1:-1, 1:-1].reshape(n, samples)
    texture = texture - texture.mean(axis=1, keepdims=True)
    power = np.maximum((texture**2).sum(axis=1), np.float32(1e-3))
    # Less what brightness and contrast explain, so that neither moves the warp.
    slopes -= slopes.mean(axis=2, keepdims=True)
    slopes -= (slopes @ texture[:, :, None] / power[:, None, None]) * texture[:, None]
    normal = (slopes @ slopes.transpose(0, 2, 1)).astype(float) + (NOISE / PRIOR_PX) ** 2 * np.eye(6)
    inverse = np.linalg.inv(normal)
    steps = inverse @ slopes
    steps[:, 2:] /= HALF
    filters = np.empty((n, samples, 8), np.float32)
    filters[:, :, :6] = steps.transpose(0, 2, 1)
    filters[:, :, 6] = texture / power[:, None]
    filters[:, :, 7] = 1.0 / samples
    sd = NOISE * np.sqrt(0.5 * (inverse[:, 0, 0] + inverse[:, 1, 1]))
    return Patches(filters, np.sqrt(power.astype(float)), sd)


def _flow(previous: Image, current: Image, pixels: FloatArray, start: FloatArray) -> FloatArray:
    """Pyramidal Lucas-Kanade of points (n, 2) from the start (n, 2); NaN where it fails."""
    height, width = current.shape
    seen = ((start >= 0) & (start <= [width - 1, height - 1])).all(axis=1)
    flown = np.full_like(pixels, np.nan)
    if not seen.any():
        return flown
    # Pyramids cannot be kept from one call to the next: OpenCV takes them in C++, not in Python (its issue 7236). Of the
    # area around the features they cost a tenth of a millisecond.
    both = np.concatenate([pixels[seen], start[seen]])
    left, top = np.maximum(both.min(axis=0).astype(np.int64) - MARGIN_PX, 0)
    right, bottom = both.max(axis=0).astype(np.int64) + MARGIN_PX + 1
    window = slice(top, bottom), slice(left, right)
    corner = np.array([left, top], dtype=float)
    places, status, _ = cv2.calcOpticalFlowPyrLK(
        evened(previous[window]),
        evened(current[window]),
        (pixels[seen] - corner).astype(np.float32),
        (start[seen] - corner).astype(np.float32),
        winSize=WINDOW,
        maxLevel=LEVELS,
        criteria=CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    flown[seen] = np.where(status.reshape(-1, 1) > 0, places.reshape(-1, 2) + corner, np.nan)
    return flown


def evened(image: Image) -> Image:
    """Less what is brighter or darker over a wide area: Lucas-Kanade takes a change of the light for motion."""
    around = cv2.blur(image, (EVEN_PX, EVEN_PX))
    return np.asarray(cv2.addWeighted(image, 1.0, around, -1.0, 128.0), dtype=np.uint8)


@kernel
def _sample(image: Image, x: float, y: float, warp: FloatArray, out: Filters) -> bool:
    """The patch under a warp (2, 2) around (x, y), bilinear, row by row; False where it leaves the image."""
    height, width = image.shape
    reach_u, reach_v = HALF * (abs(warp[0, 0]) + abs(warp[0, 1])), HALF * (abs(warp[1, 0]) + abs(warp[1, 1]))
    # Written so that NaN is outside, too.
    if not (x - reach_u >= 0.0 and y - reach_v >= 0.0 and x + reach_u < width - 1.01 and y + reach_v < height - 1.01):
        return False
    # 32 bits suffice for a thousandth of a pixel, and run twice as fast.
    right, down, one = np.float32(warp[0, 0]), np.float32(warp[1, 0]), np.uint32(1)
    i = 0
    for v in range(-HALF, HALF + 1):
        u0, v0 = np.float32(x + warp[0, 1] * v - warp[0, 0] * HALF), np.float32(y + warp[1, 1] * v - warp[1, 0] * HALF)
        for k in range(2 * HALF + 1):
            at_u, at_v = u0 + right * np.float32(k), v0 + down * np.float32(k)
            column, row = np.uint32(at_u), np.uint32(at_v)
            fu, fv = at_u - np.float32(column), at_v - np.float32(row)
            a, b = np.float32(image[row, column]), np.float32(image[row, column + one])
            c, d = np.float32(image[row + one, column]), np.float32(image[row + one, column + one])
            above, below = a + fu * (b - a), c + fu * (d - c)
            out[i] = above + fv * (below - above)
            i += 1
    return True


@kernel
def _register(
    image: Image,
    filters: Filters,
    contrast: FloatArray,
    index: IntArray,
    places: FloatArray,
    warps: FloatArray,
    likeness: FloatArray,
) -> None:
    """Lays patches over an image.

    Args:
        filters, contrast: of all patches.
        index: (m,) which of them.
        places, warps: (m, 2), (m, 2, 2) from where they start, filled with where they come to rest.
        likeness: (m,) filled with the correlation there; -1 for those that leave the image or go astray.
    """
    samples = filters.shape[1]
    patch, sums = np.empty(samples, np.float32), np.empty(8, np.float32)
    for m in range(len(index)):
        filters_m, warp = filters[index[m]], warps[m]
        x, y = places[m, 0], places[m, 1]
        likeness[m] = -1.0
        settled = False
        for _ in range(ROUNDS + 1):
            if not _sample(image, x, y, warp, patch):
                break
            middle, square = patch[samples // 2], np.float32(0.0)
            sums[:] = 0.0
            for i in range(samples):
                value = patch[i] - middle  # small numbers lose less
                square += value * value
                for k in range(8):
                    sums[k] += filters_m[i, k] * value
            gain, power = float(sums[6]), float(square) - samples * float(sums[7]) ** 2
            if settled:
                likeness[m] = gain * contrast[index[m]] / np.sqrt(max(power, 1e-3))
                break
            if not gain > 0.1:
                break
            # The patch's own step I + A, t is undone before the warp W: W becomes W (I + A)^-1, the place moves by -W t.
            a, b, c, d = 1 + sums[2] / gain, sums[3] / gain, sums[4] / gain, 1 + sums[5] / gain
            area = a * d - b * c
            if not 0.3 < area < 3.0:
                break
            w00, w01, w10, w11 = warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1]
            warp[0, 0], warp[0, 1] = (w00 * d - w01 * c) / area, (w01 * a - w00 * b) / area
            warp[1, 0], warp[1, 1] = (w10 * d - w11 * c) / area, (w11 * a - w10 * b) / area
            du = (warp[0, 0] * sums[0] + warp[0, 1] * sums[1]) / gain
            dv = (warp[1, 0] * sums[0] + warp[1, 1] * sums[1]) / gain
            x, y = x - du, y - dv
            if np.hypot(x - places[m, 0], y - places[m, 1]) > REACH_PX:
                break
            settled = np.hypot(du, dv) < SETTLED_PX
        places[m, 0], places[m, 1] = x, y
