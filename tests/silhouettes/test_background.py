"""Background of a static camera: noise, gain, plain objects that turn in place; outlines below a pixel."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sylpose.geometry.arrays import BoolArray, Image
from sylpose.silhouettes.background import estimate_background, find_silhouette, level_images

SIZE = (96, 128)


def make_wall(rng: np.random.Generator) -> np.ndarray:
    """Return a wall with smooth texture of all colors."""
    coarse = rng.uniform(40, 180, (12, 16, 3))
    return np.asarray(cv2.resize(coarse, SIZE[::-1], interpolation=cv2.INTER_CUBIC))


def draw_disc(center: tuple[float, float], radius: float) -> np.ndarray:
    """Return the share (h, w) of each pixel that a disc covers."""
    fine = (np.arange(8) - 3.5) / 8
    y = (np.arange(SIZE[0])[:, None] + fine).reshape(-1, 1)
    x = (np.arange(SIZE[1])[:, None] + fine).reshape(1, -1)
    inside = (x - center[0]) ** 2 + (y - center[1]) ** 2 < radius**2
    return np.asarray(inside.reshape(SIZE[0], 8, SIZE[1], 8).mean(axis=(1, 3)))


def photograph(
    rng: np.random.Generator, wall: np.ndarray, share: np.ndarray, color: float, noise: float, gain: float = 1.0
) -> Image:
    picture = wall * (1 - share[..., None]) + color * share[..., None]
    return np.asarray(np.clip(np.rint(gain * picture + rng.normal(0, noise, picture.shape)), 0, 255), np.uint8)


@pytest.mark.parametrize("noise", [0.0, 1.0, 4.0])
def test_noise_of_a_static_scene(noise: float) -> None:
    rng = np.random.default_rng(1)
    wall = make_wall(rng)
    images = [photograph(rng, wall, np.zeros(SIZE), 0.0, noise) for _ in range(25)]
    background = estimate_background(images)
    # Rounding adds a twelfth to the variance; of equal images nothing is left but the least noise.
    expected = np.sqrt(noise**2 + 1 / 12)
    assert background.noise == pytest.approx(expected, rel=0.06)
    assert background.is_known.all()
    assert np.abs(background.color - wall).mean() < 0.5 + noise / 4


def test_gain_is_removed() -> None:
    rng = np.random.default_rng(2)
    wall = make_wall(rng)
    gains = rng.uniform(0.7, 1.1, 21)
    images = [photograph(rng, wall, draw_disc((30 + 3 * k, 50), 14), 240.0, 1.0, g) for k, g in enumerate(gains)]
    leveled = np.stack(level_images(images)).astype(float)
    outside = np.ones(SIZE, bool)
    outside[30:70] = False
    brightness = leveled[:, outside].mean(axis=(1, 2))
    assert np.ptp(brightness) / brightness.mean() < 0.01


def test_outline_is_exact_below_a_pixel() -> None:
    """The area of a disc of little contrast, whose threshold is far from half of the contrast."""
    rng = np.random.default_rng(3)
    wall = make_wall(rng)
    discs = [draw_disc((25 + 3.7 * k, 48.3), 15.2) for k in range(21)]
    images = [photograph(rng, wall, disc, 250.0, 1.5) for disc in discs]
    background = estimate_background(level_images(images))
    near = [cv2.dilate((disc > 0).astype(np.uint8), np.ones((9, 9), np.uint8)) for disc in discs]
    areas = [(find_silhouette(background, image).share * part).sum() for image, part in zip(images, near, strict=True)]
    true_area = np.pi * 15.2**2
    # A hundredth of the area is a twelfth of a pixel of the outline.
    assert abs(np.median(areas) / true_area - 1) < 0.01


def wobbling_square(rng: np.random.Generator, n: int = 31) -> tuple[list[Image], list[BoolArray]]:
    """Return images of a plain square that turns in place and drifts a little, and its masks."""
    wall, images, masks = make_wall(rng), [], []
    for k in range(n):
        angle, at = 0.2 * k, np.array([64 + 6 * np.sin(k / 3), 48 + 4 * np.cos(k / 4)])
        corners = at + 22 * np.array([[np.cos(angle + q), np.sin(angle + q)] for q in np.pi / 2 * np.arange(4)])
        mask = np.zeros(SIZE, np.uint8)
        cv2.fillConvexPoly(mask, np.rint(corners * 256).astype(np.int32), (1,), cv2.LINE_8, 8)
        images.append(photograph(rng, wall, mask.astype(float), 120.0, 1.5))
        masks.append(mask > 0)
    return images, masks


def test_plain_object_is_not_its_own_background() -> None:
    """Its middle covers the same pixels in all images: these are not known, and no silhouette has a hole there."""
    images, masks = wobbling_square(np.random.default_rng(4))
    background = estimate_background(level_images(images))
    always = np.all(masks, axis=0)
    assert always.sum() > 100
    assert not background.is_known[always].any()
    missed = [
        np.mean(find_silhouette(background, image).share[mask] < 0.5) for image, mask in zip(images, masks, strict=True)
    ]
    assert np.max(missed) < 0.05


def test_images_without_the_object_reveal_its_background() -> None:
    rng = np.random.default_rng(5)
    images, masks = wobbling_square(rng)
    around = np.ones((5, 5), np.uint8)
    covered = [cv2.dilate(mask.astype(np.uint8), around) > 0 for mask in masks]
    background = estimate_background(images, [np.asarray(mask) for mask in covered])
    seen = np.sum(~np.stack(covered), axis=0) >= 3
    assert background.is_known[seen].mean() > 0.99
    assert not background.is_known[np.all(covered, axis=0)].any()
    for image, mask in zip(images, masks, strict=True):
        share = find_silhouette(background, image).share
        assert np.mean((share > 0.5)[seen] != mask[seen]) < 0.01
