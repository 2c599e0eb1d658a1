"""Effects on the images of a take: image faults, light, compression, overlays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from benchmarks.kinds_scenes import compress_h264, compress_jpeg, rotate_view
from benchmarks.trust_takes import Effect, Film, Take
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.simulate import Actor

ImageChange = Callable[[Take, int, int, Image], Image]


def change_images(change: ImageChange, cameras: Sequence[int] | None = None) -> Effect:
    """Make an effect that changes each image (take, camera, frame, image) of the cameras (None: of all)."""

    def effect(take: Take, film: Film) -> Film:
        return [
            [change(take, c, k, image) for k, image in enumerate(images)] if cameras is None or c in cameras else images
            for c, images in enumerate(film)
        ]

    return effect


def flip(horizontal: bool, vertical: bool, cameras: Sequence[int] | None = None) -> Effect:
    """Flip the images: mirrored, or turned by 180 degrees with both."""
    rows, columns = (slice(None, None, -1 if flipped else 1) for flipped in (vertical, horizontal))
    return change_images(lambda _take, _c, _k, image: np.ascontiguousarray(image[rows, columns]), cameras)


def exchange(order: Sequence[int]) -> Effect:
    """Give camera c the images of camera order[c]."""
    return lambda _take, film: [film[c] for c in order]


def freeze(camera: int, frame: int) -> Effect:
    """Repeat a camera's image from a frame on, bit by bit."""
    return lambda _take, film: [
        [images[min(k, frame)] for k in range(len(images))] if c == camera else images for c, images in enumerate(film)
    ]


def zoom(camera: int, factor: float, begin: int) -> Effect:
    """Magnify a camera's images about their middle from a frame on."""

    def change(_take: Take, _c: int, k: int, image: Image) -> Image:
        if k < begin:
            return image
        height, width = image.shape[:2]
        matrix = np.array([[factor, 0, (1 - factor) * (width - 1) / 2], [0, factor, (1 - factor) * (height - 1) / 2]])
        return np.asarray(cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REFLECT), dtype=np.uint8)

    return change_images(change, [camera])


def rotate_cameras(rotations: FloatArray) -> Effect:
    """Rotate the cameras about their centers by rotation vectors (frames, C, 3), in camera axes."""

    def change(take: Take, c: int, k: int, image: Image) -> Image:
        rotation = rotations[k, c]
        return rotate_view(image, take.scene.rig.cameras[c], rotation) if rotation.any() else image

    return change_images(change)


def scale_brightness(gain: FloatArray) -> Effect:
    """Multiply the images by gains (frames, C)."""
    return change_images(
        lambda _take, c, k, image: np.clip(np.rint(image * np.float32(gain[k, c])), 0, 255).astype(np.uint8)
    )


def compress(codec: str, quality: int) -> Effect:
    """Compress and decompress: "jpeg" with a quality, or "h264" with a rate factor."""
    if codec == "jpeg":
        return change_images(lambda _take, _c, _k, image: compress_jpeg(image, quality))
    return lambda _take, film: [compress_h264(images, quality) for images in film]


def cover(overlays: Sequence[Image], masks: Sequence[Image], cameras: Sequence[int] | None = None) -> Effect:
    """Cover the images by static overlays with masks of 0 to 255, per camera."""

    def change(_take: Take, c: int, _k: int, image: Image) -> Image:
        share = (masks[c] / np.float32(255))[..., None]
        return np.rint(image * (1 - share) + overlays[c] * share).astype(np.uint8)

    return change_images(change, cameras)


def make_net(rng: np.random.Generator, size: tuple[int, int]) -> tuple[Image, Image]:
    """Draw a net of slightly irregular threads; return image and mask."""
    width, height = size
    mask = np.zeros((height, width), np.uint8)
    step, angle = rng.uniform(14, 30), rng.uniform(0, np.pi / 2)
    for direction in (angle, angle + np.pi / 2):
        along, across = (np.array([np.cos(a), np.sin(a)]) for a in (direction, direction + np.pi / 2))
        for offset in np.arange(-width, width, step):
            middle = np.array([width, height]) / 2 + (offset + rng.normal(0, 1.5)) * across
            ends = np.rint([middle - width * along, middle + width * along]).astype(int)
            cv2.line(mask, tuple(ends[0]), tuple(ends[1]), 255, int(rng.integers(1, 3)), cv2.LINE_AA)
    color = rng.uniform(20, 230, 3)
    grain = rng.normal(0, 25, (height, width, 1))
    return np.clip(color + grain, 0, 255).astype(np.uint8), mask


def make_dirt(rng: np.random.Generator, size: tuple[int, int]) -> tuple[Image, Image]:
    """Draw dried drops and dust on a lens; return image and mask."""
    width, height = size
    mask = np.zeros((height, width), np.uint8)
    for _ in range(int(rng.integers(40, 90))):
        center = (int(rng.integers(width)), int(rng.integers(height)))
        axes = (int(rng.integers(1, 9)), int(rng.integers(1, 9)))
        cv2.ellipse(
            mask, center, axes, float(rng.uniform(0, 180)), 0, 360, int(rng.integers(110, 255)), -1, cv2.LINE_AA
        )
    dark = rng.uniform(10, 70)
    return np.full((height, width, 3), dark, np.uint8), mask


def stamp(text: str, height_px: int, place: tuple[float, float], counting: bool) -> Effect:
    """Burn a text into all images at a place, as shares of the image size, with the frame's number if counting."""

    def change(_take: Take, c: int, k: int, image: Image) -> Image:
        image = image.copy()
        words = f"{text} {c + 1} {k:05d}" if counting else f"{text} {c + 1}"
        corner = (int(place[0] * image.shape[1]), int(place[1] * image.shape[0]))
        for color, thick in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(image, words, corner, cv2.FONT_HERSHEY_SIMPLEX, height_px / 22, color, thick, cv2.LINE_AA)
        return image

    return change_images(change)


def cast_shadows(shifts: FloatArray, darkness: float, size: float) -> Effect:
    """Darken the wall where shadows fall: the object's outline, moved by shifts (frames, C, 2), pixels, and scaled."""

    def change(take: Take, c: int, k: int, image: Image) -> Image:
        height, width = image.shape[:2]
        shadow = np.zeros((height, width), np.float32)
        for outline in take.outlines(c, k, take.scene.actors[:1]):
            middle = outline.mean(axis=0)
            moved = middle + shifts[k, c] + size * (outline - middle)
            cv2.fillConvexPoly(shadow, np.rint(moved).astype(np.int32), (1.0,))
        shadow = np.asarray(cv2.GaussianBlur(shadow, (0, 0), 3.0), np.float32)
        shadow[take.mask(c, k)] = 0
        return np.rint(image * (1 - darkness * shadow)[..., None]).astype(np.uint8)

    return change_images(change)


def shine(places: FloatArray, radius: float, strength: float, *, on_object: bool) -> Effect:
    """Add a bright spot: on the object at places (frames, C, 2) in units of its outline, or on the wall in image sizes."""

    def change(take: Take, c: int, k: int, image: Image) -> Image:
        height, width = image.shape[:2]
        u, v = np.meshgrid(np.arange(float(width)), np.arange(float(height)))
        place, size, total = places[k, c] * [width, height], radius * height, np.zeros((height, width))
        if on_object:
            outlines = take.outlines(c, k, take.scene.actors[:1])
            if not outlines:
                return image
            low, high = outlines[0].min(axis=0), outlines[0].max(axis=0)
            place, size = low + places[k, c] * (high - low), radius * float((high - low).mean())
        total = strength * np.exp(-((u - place[0]) ** 2 + (v - place[1]) ** 2) / (2 * size**2))
        mask = take.mask(c, k, take.scene.actors[:1])
        total[~mask if on_object else take.mask(c, k)] = 0
        return np.asarray(np.clip(np.rint(image + total[..., None]), 0, 255), dtype=np.uint8)

    return change_images(change)


def see_through(share: float, part: float) -> Effect:
    """Blend the lower part of the object's outline with the wall behind it."""

    def effect(take: Take, film: Film) -> Film:
        hidden: Sequence[Actor] = take.scene.actors[1:]
        empty = replace(take, scene=replace(take.scene, actors=tuple(hidden)), effects=())
        walls = [[np.asarray(i) for i in f.images if i is not None] for f in empty.frames()]

        def change(take: Take, c: int, k: int, image: Image) -> Image:
            mask = take.mask(c, k, take.scene.actors[:1])
            rows = np.flatnonzero(mask.any(axis=1))
            if not len(rows):
                return image
            mask[: int(rows[-1] - part * (rows[-1] - rows[0]))] = False
            mixed = np.rint((1 - share) * image + share * walls[k][c]).astype(np.uint8)
            return np.asarray(np.where(mask[..., None], mixed, image), dtype=np.uint8)

        return change_images(change)(take, film)

    return effect
