"""Large images, which are searched reduced: the object is found all the same, and its features are those of all pixels."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from sylpose.features.sift import MAX_FEATURES, Features, detect
from sylpose.geometry.arrays import Image
from sylpose.results import FrameStatus
from sylpose.rig import Camera
from sylpose.simulate import render_frames
from sylpose.tracking import camera as camera_module
from sylpose.tracking.camera import CameraPart
from sylpose.tracking.tracker import track
from tests.clips import HALF_DEGREE, SIZE, assert_valid, drifting, errors, hidden_clip, moving_scene, statuses

# What the images of this size are reduced to: half of their pixels.
PIXELS = SIZE[0] * SIZE[1] // 2


@pytest.fixture
def large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_module, "SEARCH_PIXELS", PIXELS)


@cache
def picture() -> tuple[Image, Camera]:
    scene = moving_scene(drifting, 1)
    return np.asarray(next(iter(render_frames(scene)))[0]), scene.rig.cameras[0]


@pytest.mark.parametrize("times", [2, 3])
def test_keypoints_of_a_reduced_image_are_where_they_are_in_the_image(times: int) -> None:
    """An image of which every pixel is repeated is that image again, reduced."""
    image, camera = picture()
    repeated = image.repeat(times, axis=0).repeat(times, axis=1)
    small, reduced = detect(image, camera), detect(repeated, camera, max_pixels=SIZE[0] * SIZE[1])
    assert len(small) > 200
    np.testing.assert_allclose(reduced.pixels, times * (small.pixels + 0.5) - 0.5, atol=1e-9)
    np.testing.assert_array_equal(reduced.descriptors, small.descriptors)


def test_a_reduced_image_is_searched_in_its_mask_only() -> None:
    image, camera = picture()
    mask = np.zeros(image.shape[:2], bool)
    mask[60:200, 90:260] = True
    inside = detect(image, camera, mask, max_pixels=mask.sum() // 2)
    assert len(inside) > 50
    row, column = np.round(inside.pixels).astype(int).T[::-1]
    assert mask[row, column].all()


def test_few_pixels_are_looked_at_as_they_are() -> None:
    image, camera = picture()
    same = detect(image, camera, max_pixels=SIZE[0] * SIZE[1])
    np.testing.assert_array_equal(same.pixels, detect(image, camera).pixels)


@pytest.mark.usefixtures("large")
@pytest.mark.parametrize("boxed", [pytest.param(True, marks=pytest.mark.slow), False])
def test_an_object_is_found_and_found_again(boxed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole images are reduced, the object's regions are not: what is learnt of it is as exact as they allow."""
    sizes: dict[bool, list[int]] = {True: [], False: []}

    def watched(*args: Any, max_pixels: int | None = None, **kwargs: Any) -> Features:
        sizes[max_pixels is not None].append(int(args[2].sum()))
        return detect(*args, max_pixels=max_pixels, **kwargs)

    monkeypatch.setattr(camera_module, "detect", watched)
    clip = hidden_clip()
    frames = list(track(clip.frames(), clip.rig, clip.boxes if boxed else None))
    assert_valid(frames)
    assert statuses(frames)[:7] == [FrameStatus.FIRST, *[FrameStatus.TRACKED] * 6]
    assert statuses(frames)[10:] == [FrameStatus.RELOCALISED, *[FrameStatus.TRACKED] * 4]
    assert not any(frame.pose.measured for frame in frames[7:10])
    assert errors(frames, clip.truth)[[*range(6), *range(9, 14)], 0].max() < 2 * HALF_DEGREE
    assert max(sizes[True]) == SIZE[0] * SIZE[1]
    assert np.median(sizes[False]) < 0.4 * SIZE[0] * SIZE[1]
    assert max(sizes[False]) < SIZE[0] * SIZE[1]


@pytest.mark.usefixtures("large")
def test_what_stood_is_not_the_objects() -> None:
    """Of a large image's features in the object's outline, those that look like what stood at the same place."""
    image, camera = picture()
    part = CameraPart(0, camera)
    assert part.is_large
    search = part.detect(image, None, None, MAX_FEATURES, reduced=True)
    outline = np.array([[60.0, 40.0], [260.0, 40.0], [260.0, 200.0], [60.0, 200.0]])
    nothing, everything = np.zeros(len(search), bool), np.ones(len(search), bool)
    mine, others = part.told_apart(image, None, search, outline, nothing)
    assert part.inside(mine, outline).all()
    assert len(mine) > np.count_nonzero(part.inside(search, outline))
    some, rest = part.told_apart(image, None, search, outline, everything)
    assert len(some) < len(mine)
    assert len(rest) > len(others)
    assert part.inside(some, outline).all()
