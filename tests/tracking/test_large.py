"""Large images are searched downscaled: the object is found, and its features use all pixels."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from sylpose.features.sift import MAX_FEATURES, Features, detect_features
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import Image
from sylpose.rig import Camera
from sylpose.simulate import render_frames
from sylpose.status import FrameStatus
from sylpose.tracking import initialization
from sylpose.tracking.camera_side import camera as camera_module
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.tracker import track
from tests.clips import (
    HALF_DEGREE,
    SIZE,
    assert_valid,
    compute_pose_errors,
    hidden_clip,
    make_drifting_pose,
    moving_scene,
    statuses,
)

# Downscaled size of these images: half of their pixels.
PIXELS = SIZE[0] * SIZE[1] // 2


@pytest.fixture
def small_search_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (camera_module, initialization):
        monkeypatch.setattr(module, "MAX_SEARCH_PIXELS", PIXELS)


@cache
def render_picture() -> tuple[Image, Camera]:
    scene = moving_scene(make_drifting_pose, 1)
    return np.asarray(next(iter(render_frames(scene)))[0]), scene.rig.cameras[0]


@pytest.mark.parametrize("times", [2, 3])
def test_keypoints_of_downscaled_image_keep_positions(times: int) -> None:
    """An image with repeated pixels, downscaled, is the original."""
    image, camera = render_picture()
    repeated = image.repeat(times, axis=0).repeat(times, axis=1)
    small, reduced = detect_features(image, camera), detect_features(repeated, camera, max_pixels=SIZE[0] * SIZE[1])
    assert len(small) > 200
    np.testing.assert_allclose(reduced.pixels, times * (small.pixels + 0.5) - 0.5, atol=1e-9)
    np.testing.assert_array_equal(reduced.descriptors, small.descriptors)


def test_downscaled_image_respects_mask() -> None:
    image, camera = render_picture()
    mask = np.zeros(image.shape[:2], bool)
    mask[60:200, 90:260] = True
    inside = detect_features(image, camera, mask, max_pixels=mask.sum() // 2)
    assert len(inside) > 50
    row, column = np.round(inside.pixels).astype(int).T[::-1]
    assert mask[row, column].all()


def test_small_images_are_not_downscaled() -> None:
    image, camera = render_picture()
    same = detect_features(image, camera, max_pixels=SIZE[0] * SIZE[1])
    np.testing.assert_array_equal(same.pixels, detect_features(image, camera).pixels)


@pytest.mark.slow
@pytest.mark.usefixtures("small_search_limit")
@pytest.mark.parametrize("boxed", [True, False])
def test_object_is_found_and_relocalized(boxed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole images are downscaled, the object's regions are not: landmarks have full precision."""
    sizes: dict[bool, list[int]] = {True: [], False: []}

    def spy_detect(*args: Any, max_pixels: int | None = None, **kwargs: Any) -> Features:
        sizes[max_pixels is not None].append(int(args[2].sum()))
        return detect_features(*args, max_pixels=max_pixels, **kwargs)

    monkeypatch.setattr(camera_module, "detect_features", spy_detect)
    clip = hidden_clip()
    frames = list(track(clip.frames(), clip.rig, clip.boxes if boxed else None))
    assert_valid(frames)
    assert statuses(frames)[:7] == [FrameStatus.FIRST, *[FrameStatus.TRACKED] * 6]
    assert statuses(frames)[10:] == [FrameStatus.RELOCALIZED, *[FrameStatus.TRACKED] * 4]
    assert not any(frame.pose.is_measured for frame in frames[7:10])
    assert compute_pose_errors(frames, clip.truth)[[*range(6), *range(9, 14)], 0].max() < 2 * HALF_DEGREE
    assert max(sizes[True]) == SIZE[0] * SIZE[1]
    assert np.median(sizes[False]) < 0.4 * SIZE[0] * SIZE[1]
    assert max(sizes[False]) < SIZE[0] * SIZE[1]


@pytest.mark.usefixtures("small_search_limit")
def test_static_features_are_not_foreground() -> None:
    """In a large image, features in the object's outline that match static ones at the same place."""
    image, camera = render_picture()
    camera_tracker = CameraTracker(0, camera)
    assert camera_tracker.is_large
    search = camera_tracker.detect((image, None), None, MAX_FEATURES, max_pixels=PIXELS)
    outline = np.array([[60.0, 40.0], [260.0, 40.0], [260.0, 200.0], [60.0, 200.0]])
    images = FrameSet(0, 0.0, (None,), (image,), (None,))
    nothing, everything = np.zeros(len(search), bool), np.ones(len(search), bool)
    mine, others = camera_tracker.split_foreground(search, outline, nothing, images)
    assert camera_tracker.find_inside(mine, outline).all()
    assert len(mine) > np.count_nonzero(camera_tracker.find_inside(search, outline))
    some, rest = camera_tracker.split_foreground(search, outline, everything, images)
    assert len(some) < len(mine)
    assert len(rest) > len(others)
    assert camera_tracker.find_inside(some, outline).all()
