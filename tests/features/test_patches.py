"""A feature whose surroundings have not changed has not moved, wherever its keypoint was found."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sylpose.features.patches import (
    RADIUS,
    REACH,
    SIDE,
    Patches,
    estimate_noise_variance,
    find_replaced,
    find_unmoved,
    sample_patches,
)
from sylpose.geometry.arrays import BoolArray, FloatArray, Image


def make_image(seed: int = 0, noise: float = 0.0, shift: tuple[float, float] = (0.0, 0.0)) -> Image:
    """A texture of 160x120 pixels that is shifted by some pixels; sensor noise in gray levels."""
    rng = np.random.default_rng(5)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (160, 200)).astype(np.float32), (0, 0), 1.5)
    texture = 120 + (texture - texture.mean()) * (35 / texture.std())
    v, u = np.mgrid[20:140, 20:180].astype(np.float32)
    image = cv2.remap(texture, u - np.float32(shift[0]), v - np.float32(shift[1]), cv2.INTER_CUBIC)
    noisy = image + noise * np.random.default_rng(seed).standard_normal(image.shape)
    return np.asarray(np.clip(noisy, 0, 255).round(), np.uint8)


def draw_pixels(n: int = 200, margin: float = 12.0) -> FloatArray:
    return np.random.default_rng(1).uniform([margin, margin], [160 - margin, 120 - margin], (n, 2))


def sample(image: Image, pixels: FloatArray) -> Patches:
    return sample_patches(image, pixels, np.ones(2), np.zeros(2))


def compare(a: Image, b: Image, before: FloatArray, after: FloatArray) -> BoolArray:
    return find_unmoved(sample(a, before), before, sample(b, after), after)


def test_patch_contains_the_pixels_around() -> None:
    image, pixels = make_image(), np.array([[30.7, 40.2], [50.0, 60.0]])
    patches = sample(image, pixels)
    assert patches.shape == (2, SIDE, SIDE)
    reach = RADIUS + REACH
    np.testing.assert_array_equal(patches[0], image[40 - reach : 40 + reach + 2, 30 - reach : 30 + reach + 2])
    np.testing.assert_array_equal(patches[1, reach, reach], image[60, 50])


@pytest.mark.parametrize("noise", [0.0, 3.0, 8.0])
def test_mislocated_keypoints_of_a_static_image_have_not_moved(noise: float) -> None:
    """The share of errors is that of the quantile, 1 in 100, and fewer where the match fits worse than the old place."""
    pixels = draw_pixels()
    errors = np.random.default_rng(2).uniform(-2.5, 2.5, pixels.shape)
    a, b = make_image(1, noise), make_image(2, noise)
    assert compare(a, b, pixels, pixels + errors).mean() > 0.97
    assert compare(a, b, pixels, pixels).mean() > 0.97


@given(angle=st.floats(0, 6.3), length=st.floats(1.0, 3.9))
def test_shifted_texture_has_moved(angle: float, length: float) -> None:
    shift = length * np.cos(angle), length * np.sin(angle)
    pixels = draw_pixels(100)
    assert compare(make_image(1, 3.0), make_image(2, 3.0, shift), pixels, pixels + shift).mean() < 0.1


def test_gain_and_offset_of_the_light_are_no_motion() -> None:
    pixels, a = draw_pixels(), make_image(1, 2.0)
    darker = np.round(0.85 * make_image(2, 2.0) + 10).astype(np.uint8)
    assert compare(a, darker, pixels, pixels + 0.4).mean() > 0.97
    moved = np.round(0.85 * make_image(2, 2.0, (2.0, 1.0)) + 10).astype(np.uint8)
    assert compare(a, moved, pixels, pixels + np.array([2.0, 1.0])).mean() < 0.1


def test_reduced_image_is_sampled_at_the_camera_pixels() -> None:
    image = make_image()
    smaller = np.asarray(cv2.resize(image, (80, 60), interpolation=cv2.INTER_AREA), np.uint8)
    pixels, step = draw_pixels(margin=20), np.full(2, 2.0)
    reduced = sample_patches(smaller, pixels, step, 0.5 * (step - 1.0))
    blurred = np.asarray(cv2.resize(smaller, (160, 120), interpolation=cv2.INTER_LINEAR), np.uint8)
    difference = np.abs(reduced.astype(float) - sample(blurred, pixels))
    assert difference.max() <= 1.0  # rounding
    elsewhere = sample_patches(smaller, pixels + 1.0, step, 0.5 * (step - 1.0))
    assert find_unmoved(reduced, pixels, elsewhere, pixels + 1.0).all()


def test_far_or_unknown_patches_are_not_known_to_be_static() -> None:
    image, pixels = make_image(), draw_pixels()
    patches = sample(image, pixels)
    far = pixels + np.array([REACH + 0.01, 0.0])
    assert not find_unmoved(patches, pixels, sample(image, far), far).any()
    for a, b in ((patches, 0 * patches), (0 * patches, patches), (0 * patches, 0 * patches)):
        assert not find_unmoved(a, pixels, b, pixels).any()
    assert find_unmoved(patches[:0], pixels[:0], patches[:0], pixels[:0]).shape == (0,)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 2)])
def test_border_repeats_the_image(size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(1, 255, size).astype(np.uint8)
    pixels = np.array([[0.0, 0.0], [size[1] - 1.0, size[0] - 1.0], [-3.0, 50.0]])
    patches = sample(image, pixels)
    assert patches[0, 0, 0] == image[0, 0]
    assert patches[1, -1, -1] == image[-1, -1]
    assert find_unmoved(patches, pixels, patches, pixels).all()


@pytest.mark.parametrize(("gain", "noise"), [(0.6, 3.0), (1.0, 0.0), (1.0, 12.0), (1.3, 3.0)])
def test_replaced_places_are_found_in_any_light(gain: float, noise: float) -> None:
    pixels = draw_pixels()
    before = sample(make_image(1, noise), pixels)

    def compare_places(later: Image) -> tuple[BoolArray, BoolArray]:
        return find_replaced(before, sample(later, pixels), noise**2)

    relit = np.clip(gain * make_image(2, noise).astype(float) - 10, 0, 255).astype(np.uint8)
    is_known, is_replaced = compare_places(relit)
    assert is_known.mean() > 0.5
    assert is_replaced.mean() < 0.01
    assert compare_places(make_image(2, noise, (3.0, 2.0)))[1].mean() < 0.03  # within reach
    assert compare_places(relit[::-1, ::-1])[1].sum() > 0.4 * is_known.sum()
    assert compare_places(make_image(2, noise, (14.0, 9.0)))[1].sum() > 0.4 * is_known.sum()
    flat = np.full((120, 160), 90, np.uint8)
    np.testing.assert_array_equal(compare_places(flat)[1], is_known)


def test_places_without_texture_are_unknown() -> None:
    pixels = draw_pixels(5)
    known, unknown, flat = (
        sample(make_image(), pixels),
        np.zeros((5, SIDE, SIDE), np.uint8),
        np.full((5, SIDE, SIDE), 9, np.uint8),
    )
    for before, after in ((known, unknown), (unknown, known), (flat, known)):
        assert not np.any(find_replaced(before, after, 0.0))
    assert not np.any(find_replaced(known, known[::-1], 1e6))
    assert [own.shape for own in find_replaced(known[:0], known[:0], 1.0)] == [(0,), (0,)]


@pytest.mark.parametrize("noise", [1.0, 4.0, 9.0])
def test_noise_variance_of_a_scene_that_moves_in_part(noise: float) -> None:
    pixels = draw_pixels()
    before, after = sample(make_image(1, noise), pixels), sample(make_image(2, noise), pixels)
    after[::2] = after[1::2]  # half of the places show something else
    assert estimate_noise_variance(before, after) == pytest.approx(noise**2, rel=0.3)
    assert estimate_noise_variance(before[:0], after[:0]) == 0.0
