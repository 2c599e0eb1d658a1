"""What stands still in one camera's images, and by what the camera was turned where all of it has moved at once.

Corners spread over a whole image are remembered with what they look like. As long as the camera stands most of them look
alike at their own places, which takes a tenth of a millisecond to see. Where they do not they are followed from that image,
and the rotation about the camera's centre is looked for that most of them agree on: a nudge is that in first order, whatever
the depth of what is seen.

Sources: corners of Shi & Tomasi, "Good features to track", CVPR 1994, followed by Bouguet's pyramids (`klt`); the rotation
between two sets of directions by Kabsch, Acta Cryst. A32, 1976, among random pairs (Fischler & Bolles, CACM 24, 1981).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.features.klt import evened, grey
from sylpose.features.sift import detect, match_features
from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.geometry.numba_linalg import kernel
from sylpose.rig import Camera

__all__ = ["FEWEST", "Backdrop", "Steadied", "Turn", "alike", "begin", "turn_since"]

# Images are made smaller, by whole numbers, until their longer side is no longer than this, pixels.
LONGEST_PX = 480
# Corners at most, no nearer to each other than this share of the longer side, and no weaker than this share of the
# strongest. Fewer than `FEWEST` say nothing.
MOST, APART, QUALITY, FEWEST = 120, 0.045, 0.01, 20
# Patches reach so many pixels of the smaller image around their corners, and need so much contrast: grey levels, the
# standard deviation. They are alike from this correlation on.
HALF, CONTRAST, LIKE = 4, 10.0, 0.75
# Contrast of the smaller images, grey levels: other light is not to be taken for motion.
EVEN = 30.0
# Pyramidal Lucas-Kanade: window, pixels, and levels above the image itself. Followed back, a corner is to be this near to
# where it was, pixels of the smaller image.
WINDOW, LEVELS, BACK_PX = (15, 15), 3, 0.7
# Where fewer than this share of the corners agree they may have gone too far to be followed: features are matched by looks.
ENOUGH = 0.6
# Pairs of corners whose rotations are tried; a corner agrees with one within this, pixels of the smaller image.
TRIED, AGREES_PX = 300, 2.0
# A corner that is displaced by less than this, pixels of the smaller image, stands still.
STILL_PX = 1.0
# Corners are followed to no better than this, pixels of the smaller image: they are no independent witnesses.
LEAST_PX = 0.1
# What is nearer than this to where an image that was turned back ends is not looked at, pixels.
RIM_PX = 8


@dataclass(frozen=True, eq=False)
class Backdrop:
    """Corners of one image.

    Attributes:
        small: (h, w) the image, grey, evened and made smaller by `step`.
        pixels: (n, 2) where they are in the image itself.
        patches: (n, s) what they look like there, less their means, of norm one.
        step: how many pixels of the image are one of the smaller one.
    """

    small: Image
    pixels: FloatArray
    patches: FloatArray
    step: int

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, eq=False)
class Turn:
    """By what a camera was turned since a backdrop's image.

    Attributes:
        rotation: (3, 3) from directions in the camera's axes then to those now.
        sd: standard deviation about the axis of which least is known, radians.
        asked: number of corners that were asked, and would still be in the image; agree: how many agree.
        still: how many stand still instead.
        spread: standard deviation of where those that agree are, in the direction in which it is least, over the image's
            shorter side.
        shift_px: by how much those that agree are displaced, in the middle, pixels of the image.
    """

    rotation: FloatArray
    sd: float
    asked: int
    agree: int
    still: int
    spread: float
    shift_px: float


def begin(image: Image, where: BoolArray | None = None) -> Backdrop:
    """The corners of an image (h, w, 3) or (h, w), in an area (h, w) of it; None: everywhere."""
    step = -(-max(image.shape[:2]) // LONGEST_PX)
    small = _small(image, step)
    mask = None if where is None else np.ascontiguousarray(where[::step, ::step], dtype=np.uint8)
    if mask is not None:
        mask = mask[: small.shape[0], : small.shape[1]]
    corners: Any = cv2.goodFeaturesToTrack(small, MOST, QUALITY, APART * max(small.shape), mask=mask)
    places = np.empty((0, 2)) if corners is None else np.asarray(corners, dtype=float).reshape(-1, 2)
    pixels = np.round(_in_image(places, step))
    reach = step * HALF
    inside = ((pixels >= reach) & (pixels < np.array(image.shape[1::-1]) - reach)).all(axis=1)
    patches, contrast = _patches(image, pixels[inside], step)
    kept = contrast > CONTRAST
    return Backdrop(small, pixels[inside][kept], patches[kept], step)


def alike(backdrop: Backdrop, image: Image) -> BoolArray:
    """(n,) which corners look in an image, at the same places, as they did, whatever the light."""
    patches, _ = _patches(image, backdrop.pixels, backdrop.step)
    return np.asarray((patches * backdrop.patches).sum(axis=1) > LIKE)


def turn_since(backdrop: Backdrop, image: Image, camera: Camera, asked: BoolArray) -> Turn | None:
    """The rotation of the camera since the backdrop's image that most of its corners agree on; None without any.

    Args:
        asked: (n,) which of the corners.
    """
    small, size = _small(image, backdrop.step), np.array(camera.size)
    pixels = backdrop.pixels[asked]
    places = _in_small(pixels, backdrop.step)
    if len(places) < 3:
        return None
    before = _directions(camera, pixels)
    limit = AGREES_PX * backdrop.step / camera.focal
    found: tuple[int, FloatArray, FloatArray, BoolArray] | None = None
    start = places
    for again in range(3):
        moved = _followed(backdrop.small, small, places, start)
        rotation, agrees = _agreed(before, _seen_at(camera, moved, backdrop.step), limit)
        if found is None or agrees.sum() > found[0]:
            found = int(agrees.sum()), rotation, moved, agrees
        if again == 0 and agrees.sum() < ENOUGH * len(places):
            rotation = _looked_up(backdrop, small, camera, limit)
        # Once more from where the corners should be.
        start = _in_small(_turned(camera, rotation, pixels), backdrop.step)
    assert found is not None
    count, rotation, moved, agrees = found
    if count < 3:
        return None
    there = _turned(camera, rotation, pixels)
    inside = ((there >= 0) & (there <= size - 1)).all(axis=1)
    displaced = backdrop.step * np.linalg.norm(moved - places, axis=1)
    off = there[agrees] - _in_image(moved[agrees], backdrop.step)
    noise = max(float(np.sqrt(np.mean(off**2))), LEAST_PX * backdrop.step)
    tells = np.einsum("ni,nj->ij", before[agrees], before[agrees])
    information = (count * np.eye(3) - tells) * (camera.focal / noise) ** 2
    return Turn(
        rotation,
        float(1.0 / np.sqrt(max(np.linalg.eigvalsh(information)[0], 1e-300))),
        int((inside | agrees).sum()),
        count,
        int((~agrees & (alike(backdrop, image)[asked] | (displaced < STILL_PX * backdrop.step))).sum()),
        float(np.sqrt(max(np.linalg.eigvalsh(np.cov(pixels[agrees].T))[0], 0.0))) / float(size.min()),
        float(np.median(displaced[agrees])),
    )


class Steadied:
    """Images of a camera that was turned by a rotation (3, 3), as they were if it had not been."""

    def __init__(self, camera: Camera, rotation: FloatArray) -> None:
        self.camera, self.rotation = camera, rotation
        width, height = camera.size
        u, v = np.meshgrid(np.arange(float(width)), np.arange(float(height)))
        source = _turned(camera, rotation, np.column_stack([u.ravel(), v.ravel()])).astype(np.float32)
        source = np.nan_to_num(source, nan=-1e4).reshape(height, width, 2)
        low, high = source.min(axis=2), (source - np.array([width - 1, height - 1])).max(axis=2)
        self.seen: BoolArray = (low >= 0) & (high <= 0)
        around = np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8)
        self.seen = cv2.erode(self.seen.astype(np.uint8), around).astype(bool)
        self._maps: Any = cv2.convertMaps(source, np.empty(0, np.float32), cv2.CV_16SC2)

    def image(self, image: Image) -> Image:
        """An image (h, w, 3) or (h, w) turned back; outside of `seen` (h, w) there is nothing to be seen in it."""
        return np.asarray(
            cv2.remap(image, self._maps[0], self._maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8
        )

    def mask(self, mask: BoolArray | None) -> BoolArray:
        """The object's mask (h, w), None: everywhere, turned back, without what is not seen."""
        if mask is None:
            return self.seen
        turned = cv2.remap(
            mask.astype(np.uint8), self._maps[0], self._maps[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT
        )
        return np.asarray(turned, dtype=bool) & self.seen


def _small(image: Image, step: int) -> Image:
    """Grey, smaller, evened, and of the usual contrast."""
    plain = grey(image)
    if step > 1:
        size = plain.shape[1] // step, plain.shape[0] // step
        plain = np.asarray(
            cv2.resize(plain[: step * size[1], : step * size[0]], size, interpolation=cv2.INTER_AREA), np.uint8
        )
    even = evened(plain)
    gain = EVEN / max(float(even.std()), CONTRAST)
    return np.asarray(cv2.convertScaleAbs(even, alpha=gain, beta=128.0 * (1.0 - gain)), np.uint8)


def _in_small(pixels: FloatArray, step: int) -> FloatArray:
    """Pixels (n, 2) of an image as those of the smaller one."""
    return np.asarray((pixels - (step - 1) / 2) / step)


def _in_image(places: FloatArray, step: int) -> FloatArray:
    """Pixels (n, 2) of the smaller image as those of the image."""
    return np.asarray(places * step + (step - 1) / 2)


def _patches(image: Image, pixels: FloatArray, step: int) -> tuple[FloatArray, FloatArray]:
    """(n, s) of norm one, and (n,) their contrast, grey levels: every `step`th pixel around whole pixels (n, 2)."""
    patches, contrast = np.empty((len(pixels), (2 * HALF + 1) ** 2)), np.empty(len(pixels))
    colours = image.reshape(*image.shape[:2], -1)
    _sample(colours, pixels.astype(np.int64), step, patches, contrast)
    return patches, contrast


@kernel
def _sample(image: Image, pixels: IntArray, step: int, patches: FloatArray, contrast: FloatArray) -> None:
    """Fills patches (n, s) and contrast (n,), see `_patches`, of an image (h, w, colours)."""
    colours, samples = image.shape[2], patches.shape[1]
    for n in range(len(pixels)):
        patch, i, mean = patches[n], 0, 0.0
        for v in range(-HALF, HALF + 1):
            for u in range(-HALF, HALF + 1):
                value = 0.0
                for k in range(colours):
                    value += image[pixels[n, 1] + step * v, pixels[n, 0] + step * u, k]
                patch[i] = value / colours
                mean += patch[i] / samples
                i += 1
        square = 0.0
        for i in range(samples):
            patch[i] -= mean
            square += patch[i] * patch[i]
        contrast[n] = np.sqrt(square / samples)
        norm = max(np.sqrt(square), 1e-9)
        for i in range(samples):
            patch[i] /= norm


def _looked_up(backdrop: Backdrop, small: Image, camera: Camera, limit: float) -> FloatArray:
    """The rotation (3, 3) that most features agree on that look alike in two images, however far they are apart."""
    a, b = detect(backdrop.small, camera), detect(small, camera)
    pairs = match_features(a, b)
    of = [_seen_at(camera, f.pixels[index], backdrop.step) for f, index in zip((a, b), pairs.T, strict=True)]
    return _agreed(of[0], of[1], limit)[0]


def _seen_at(camera: Camera, places: FloatArray, step: int) -> FloatArray:
    """(n, 3) directions, camera's axes, of places (n, 2) in the smaller image; NaN for those that are NaN."""
    out, seen = np.full((len(places), 3), np.nan), np.isfinite(places).all(axis=1)
    out[seen] = _directions(camera, _in_image(places[seen], step))
    return out


def _followed(small: Image, other: Image, places: FloatArray, start: FloatArray) -> FloatArray:
    """(n, 2) where points are in another image; NaN for those that are lost, or not found when followed back."""
    start = np.where(np.isfinite(start), start, places)
    options: dict[str, Any] = {"winSize": WINDOW, "maxLevel": LEVELS, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    points, start = places.astype(np.float32), start.astype(np.float32)
    there, forth, _ = cv2.calcOpticalFlowPyrLK(small, other, points, start.copy(), **options)
    # From its own place it would be found again too easily.
    back, found, _ = cv2.calcOpticalFlowPyrLK(other, small, there, there - (start - points), **options)
    good = (forth.ravel() > 0) & (found.ravel() > 0) & (np.linalg.norm(back - points, axis=1) < BACK_PX)
    inside = ((there >= 0) & (there <= np.array(other.shape[::-1]) - 1)).all(axis=1)
    return np.where((good & inside)[:, None], there.astype(float), np.nan)


def _directions(camera: Camera, pixels: FloatArray) -> FloatArray:
    """(n, 3) unit vectors, camera's axes."""
    rays = np.column_stack([camera.normalize(pixels), np.ones(len(pixels))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _turned(camera: Camera, rotation: FloatArray, pixels: FloatArray) -> FloatArray:
    """(n, 2) where what was seen at some pixels is after the camera was turned; NaN where not before it."""
    rays = _directions(camera, pixels) @ rotation.T
    out = np.full((len(pixels), 2), np.nan)
    front = rays[:, 2] > 0.05
    out[front] = camera.denormalize(rays[front, :2] / rays[front, 2:])
    return out


def _agreed(before: FloatArray, now: FloatArray, limit: float) -> tuple[FloatArray, BoolArray]:
    """The rotation (3, 3) that most directions (n, 3) agree on within an angle, and (n,) which do."""
    seen = np.flatnonzero(np.isfinite(now).all(axis=1))
    best = np.zeros(len(before), bool)
    if len(seen) < 3:
        return np.eye(3), best
    one, two = np.random.default_rng(0).choice(seen, (2, TRIED))
    a, b = _triads(before[one], before[two]), _triads(now[one], now[two])
    tried = b @ a.transpose(0, 2, 1)
    off = np.linalg.norm(before @ tried.transpose(0, 2, 1) - now, axis=2)
    best = off[int((off < limit).sum(axis=1).argmax())] < limit
    rotation = np.eye(3)
    for _ in range(3):
        if best.sum() < 3:
            break
        rotation = Rotation.align_vectors(now[best], before[best])[0].as_matrix()
        best = np.linalg.norm(before @ rotation.T - now, axis=1) < limit
    return np.asarray(rotation), np.asarray(best)


def _triads(one: FloatArray, two: FloatArray) -> FloatArray:
    """(m, 3, 3) right-handed axes, as columns, of pairs of directions (m, 3); NaN for two that are one."""
    across = np.cross(one, two)
    with np.errstate(invalid="ignore", divide="ignore"):
        across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([one, across, np.cross(one, across)], axis=2)
