"""Page images: resizing, encoding, undistortion."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sylpose.report.drawing import BACKGROUND_COLOR, MAX_TANGENT, build_undistortion_map, encode_jpeg, shrink_image
from sylpose.rig import Camera, make_look_at_camera

BENT = np.array([-0.28, 0.09, 0.001, -0.002, -0.01])


def camera(lens: str) -> Camera:
    its = make_look_at_camera("cam", (0, 0, -1), (0, 0, 0), 500, (640, 480))
    if lens == "fisheye":
        return replace(its, distortion=np.array([0.03, -0.02, 0.0, 0.0]), lens="fisheye")
    return replace(its, distortion=BENT if lens == "bent" else np.zeros(5))


@pytest.mark.parametrize("lens", ["straight", "bent", "fisheye"])
def test_undistorted_points_are_at_pinhole_projections(lens: str) -> None:
    """A dot at a point's distorted pixel appears at the point's position on the plane of the undistorted image."""
    its = camera(lens)
    straight = build_undistortion_map(its, 320)
    assert straight.size == (320, 240)
    for point in np.array([[0.0, 0, 0], [0.42, 0.3, 0], [-0.4, 0.2, 0], [0.3, -0.35, 0]]):
        pixel = its.project(point[None])[0]
        image = np.zeros((480, 640, 3), np.uint8)
        cv2.circle(image, (round(16 * pixel[0]), round(16 * pixel[1])), 16 * 5, (255, 255, 255), -1, cv2.LINE_AA, 4)
        seen = straight.apply(image).astype(float)[..., 0]
        seen[seen <= BACKGROUND_COLOR[0]] = 0
        v, u = np.indices(seen.shape)
        found = np.array([(u * seen).sum(), (v * seen).sum()]) / seen.sum()
        x = (its.camera_from_world.apply(point))[:2] / its.camera_from_world.apply(point)[2]
        wanted = (x - straight.low) / (straight.high - straight.low) * straight.size - 0.5
        assert np.linalg.norm(found - wanted) < 0.4
        if lens == "bent" and point.any():  # differs without undistortion
            assert np.linalg.norm(pixel / 2 - wanted) > 2


def test_wide_lens_is_cropped_to_its_middle() -> None:
    wide = replace(camera("fisheye"), matrix=np.array([[150.0, 0, 319.5], [0, 150, 239.5], [0, 0, 1]]))
    straight = build_undistortion_map(wide, 320)
    assert straight.low.tolist() == [-MAX_TANGENT, straight.low[1]]
    assert straight.high[0] == MAX_TANGENT
    assert straight.apply(np.full((480, 640), 200, np.uint8)).shape == (240, 320, 3)


def test_image_shrinking_and_encoding() -> None:
    image = np.zeros((120, 200, 3), np.uint8)
    image[:, 100:] = (10, 200, 90)
    assert shrink_image(image, 200) is image
    assert shrink_image(image, 50).shape == (30, 50, 3)
    assert shrink_image(image[..., 0], 20).shape == (12, 20)
    read = cv2.imdecode(np.frombuffer(encode_jpeg(image), np.uint8), cv2.IMREAD_COLOR)
    assert read is not None
    assert np.abs(read.astype(int) - image).mean() < 2
