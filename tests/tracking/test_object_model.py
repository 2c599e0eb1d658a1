"""Object model: center and size from boxes, and the point cloud."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import ellipsoid, ring
from sylpose.tracking.joint_side.object_model import MAX_CLOUD_POINTS, ObjectModel

AT = np.array([0.05, -0.03, 0.04])


@pytest.fixture(scope="module")
def rig() -> Rig:
    return ring(6, 1.5, 1000.0, height=(0.5, -0.4, 0.3, -0.5, 0.4, -0.3), distortion=(-0.1, 0.02, 0.0, 0.0))


def make_boxes(rig: Rig, points: FloatArray) -> dict[str, Box]:
    """Tight boxes around points."""
    boxes = {}
    for camera in rig:
        pixels = camera.project(points)
        low, size = pixels.min(axis=0), np.ptp(pixels, axis=0)
        boxes[camera.name] = Box(*low.tolist(), *(size + 1).tolist())
    return boxes


# --- boxes


@pytest.mark.parametrize("size", [0.05, 0.15, 0.3])
def test_boxes_of_ball_give_center_and_radius(rig: Rig, size: float) -> None:
    model = ObjectModel.from_boxes(rig, make_boxes(rig, AT + ellipsoid((size,) * 3, n=2000).points))
    assert model.center is not None
    assert np.linalg.norm(model.center - AT) < 0.015 * size
    # The boxes of six cameras contain the ball and the space in their corners.
    assert 1.05 < model.radius / size < 1.35
    assert model.is_bounded
    assert model.is_depth_guessed


@pytest.mark.parametrize("sides", [(0.15, 0.1, 0.12), (0.3, 0.06, 0.1), (0.05, 0.25, 0.2)])
def test_boxes_of_body_give_position_and_size(rig: Rig, sides: tuple[float, float, float]) -> None:
    surface = ellipsoid(sides, n=2000).points
    model = ObjectModel.from_boxes(rig, make_boxes(rig, AT + surface))
    assert model.center is not None
    largest = np.linalg.norm(surface, axis=1).max()
    assert np.linalg.norm(model.center - AT) < 0.015 * largest
    assert 0.8 < model.radius / largest < 1.2
    # The cloud surrounds the center and covers nearly all of the body.
    assert np.quantile(np.linalg.norm(model.points, axis=1), 0.95) == pytest.approx(model.radius)
    for axis in np.eye(3):
        assert np.ptp(model.points @ axis) > 0.9 * np.ptp(surface @ axis)
        assert abs((model.points @ axis).mean()) < 0.03 * largest


def test_radius_and_cloud_scale_with_world(rig: Rig) -> None:
    """In a world twice as large everything is twice as large."""
    boxes = make_boxes(rig, AT + ellipsoid((0.15, 0.1, 0.12)).points)
    doubled = ring(
        6, 3.0, 1000.0, height=2 * np.array([0.5, -0.4, 0.3, -0.5, 0.4, -0.3]), distortion=(-0.1, 0.02, 0, 0)
    )
    one, two = ObjectModel.from_boxes(rig, boxes), ObjectModel.from_boxes(doubled, boxes)
    assert two.radius == pytest.approx(2 * one.radius, rel=1e-6)
    assert one.center is not None
    assert two.center is not None
    np.testing.assert_allclose(two.center, 2 * one.center, atol=1e-6)


def test_errors_name_camera(rig: Rig) -> None:
    with pytest.raises(ValueError, match="cam_9"):
        ObjectModel.from_boxes(rig, {"cam_9": Box(0, 0, 10, 10)})
    apart = {"cam_0": Box(0, 100, 50, 50), "cam_2": Box(600, 800, 50, 50)}
    with pytest.raises(ValueError, match="cam_0, cam_2"):
        ObjectModel.from_boxes(rig, apart)


def test_model_without_boxes_is_empty() -> None:
    model = ObjectModel()
    assert model.center is None
    assert np.isnan(model.radius)
    assert model.points.shape == (0, 3)
    assert not model.is_bounded
    assert not model.is_depth_guessed


# --- the cloud


def make_cloud(n: int, seed: int = 0) -> FloatArray:
    """(n, 3) points within distance 1 from the center."""
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (n, 3))


def test_points_are_appended() -> None:
    one = ObjectModel(radius=1.0).add_points(make_cloud(100, 1), 0)
    two = one.add_points(make_cloud(50, 2), 0)
    np.testing.assert_array_equal(two.points, np.concatenate([make_cloud(100, 1), make_cloud(50, 2)]))


@pytest.mark.parametrize("radius", [0.1, 1.0])
def test_points_beyond_twice_the_radius_are_dropped(radius: float) -> None:
    directions = make_cloud(200) / np.linalg.norm(make_cloud(200), axis=1, keepdims=True)
    inside, outside = 1.99 * radius * directions, 2.01 * radius * directions
    model = ObjectModel(radius=radius).add_points(np.concatenate([outside, inside]), 0)
    np.testing.assert_array_equal(model.points, inside)


def test_unknown_radius_adds_no_points() -> None:
    assert len(ObjectModel().add_points(make_cloud(50), 0).points) == 0


@pytest.mark.parametrize("n", [MAX_CLOUD_POINTS - 1, MAX_CLOUD_POINTS, MAX_CLOUD_POINTS + 1, 5 * MAX_CLOUD_POINTS])
def test_excess_points_are_subsampled(n: int) -> None:
    points = make_cloud(n)
    kept = ObjectModel(radius=1.0).add_points(points, 0).points
    assert len(kept) == min(n, MAX_CLOUD_POINTS)
    rows = {tuple(p) for p in points.tolist()}
    assert len({tuple(p) for p in kept.tolist()} & rows) == len(kept)


def test_old_and_new_points_are_kept_equally_likely() -> None:
    old, new = (
        make_cloud(MAX_CLOUD_POINTS, 1) - np.array([1.0, 0, 0]),
        make_cloud(MAX_CLOUD_POINTS, 2) + np.array([1.0, 0, 0]),
    )
    model = ObjectModel(radius=2.0).add_points(old, 0).add_points(new, 0)
    # Five standard deviations of a fair draw are 0.07.
    assert 0.43 < (model.points[:, 0] > 0).mean() < 0.57


def test_subsample_depends_on_seed_only() -> None:
    model, points = ObjectModel(radius=1.0), make_cloud(2 * MAX_CLOUD_POINTS)
    one, again, other = (model.add_points(points, seed).points for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)


def test_model_is_immutable() -> None:
    model = ObjectModel(radius=1.0, points=make_cloud(10))
    model.add_points(make_cloud(2 * MAX_CLOUD_POINTS), 0)
    np.testing.assert_array_equal(model.points, make_cloud(10))
    with pytest.raises(FrozenInstanceError):
        model.radius = 2.0  # type: ignore[misc]
    more = model.add_points(make_cloud(5), 0)
    assert (more.center, more.radius, more.is_bounded, more.is_depth_guessed) == (None, 1.0, False, False)
