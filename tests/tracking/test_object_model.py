"""What all cameras know of the object itself: what boxes tell of it, and its cloud of points."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import ellipsoid, ring
from sylpose.tracking.object_model import MAX_POINTS, ObjectModel

AT = np.array([0.05, -0.03, 0.04])


@pytest.fixture(scope="module")
def rig() -> Rig:
    return ring(6, 1.5, 1000.0, height=(0.5, -0.4, 0.3, -0.5, 0.4, -0.3), distortion=(-0.1, 0.02, 0.0, 0.0))


def boxes_of(rig: Rig, points: FloatArray) -> dict[str, Box]:
    """Tight boxes around points."""
    boxes = {}
    for camera in rig:
        pixels = camera.project(points)
        low, size = pixels.min(axis=0), np.ptp(pixels, axis=0)
        boxes[camera.name] = Box(*low.tolist(), *(size + 1).tolist())
    return boxes


# --- boxes


@pytest.mark.parametrize("size", [0.05, 0.15, 0.3])
def test_boxes_of_a_ball_tell_its_centre_and_its_radius(rig: Rig, size: float) -> None:
    model = ObjectModel.in_boxes(rig, boxes_of(rig, AT + ellipsoid((size,) * 3, n=2000).points))
    assert model.center is not None
    assert np.linalg.norm(model.center - AT) < 0.015 * size
    # The boxes of six cameras allow the ball and what is in their corners.
    assert 1.05 < model.radius / size < 1.35
    assert model.bounded
    assert model.guessed


@pytest.mark.parametrize("sides", [(0.15, 0.1, 0.12), (0.3, 0.06, 0.1), (0.05, 0.25, 0.2)])
def test_boxes_of_a_body_tell_where_it_is_and_how_large(rig: Rig, sides: tuple[float, float, float]) -> None:
    surface = ellipsoid(sides, n=2000).points
    model = ObjectModel.in_boxes(rig, boxes_of(rig, AT + surface))
    assert model.center is not None
    largest = np.linalg.norm(surface, axis=1).max()
    assert np.linalg.norm(model.center - AT) < 0.015 * largest
    assert 0.8 < model.radius / largest < 1.2
    # The cloud is about the centre, and reaches to nearly all of the body's extremes.
    assert np.quantile(np.linalg.norm(model.points, axis=1), 0.95) == pytest.approx(model.radius)
    for axis in np.eye(3):
        assert np.ptp(model.points @ axis) > 0.9 * np.ptp(surface @ axis)
        assert abs((model.points @ axis).mean()) < 0.03 * largest


def test_the_radius_goes_with_the_object_and_the_cloud_is_as_large(rig: Rig) -> None:
    """In a world that is twice as large all is twice as large."""
    boxes = boxes_of(rig, AT + ellipsoid((0.15, 0.1, 0.12)).points)
    doubled = ring(
        6, 3.0, 1000.0, height=2 * np.array([0.5, -0.4, 0.3, -0.5, 0.4, -0.3]), distortion=(-0.1, 0.02, 0, 0)
    )
    one, two = ObjectModel.in_boxes(rig, boxes), ObjectModel.in_boxes(doubled, boxes)
    assert two.radius == pytest.approx(2 * one.radius, rel=1e-6)
    assert one.center is not None
    assert two.center is not None
    np.testing.assert_allclose(two.center, 2 * one.center, atol=1e-6)


def test_errors_name_the_camera(rig: Rig) -> None:
    with pytest.raises(ValueError, match="cam_9"):
        ObjectModel.in_boxes(rig, {"cam_9": Box(0, 0, 10, 10)})
    apart = {"cam_0": Box(0, 100, 50, 50), "cam_2": Box(600, 800, 50, 50)}
    with pytest.raises(ValueError, match="cam_0, cam_2"):
        ObjectModel.in_boxes(rig, apart)


def test_nothing_is_known_without_boxes() -> None:
    model = ObjectModel()
    assert model.center is None
    assert np.isnan(model.radius)
    assert model.points.shape == (0, 3)
    assert not model.bounded
    assert not model.guessed


# --- the cloud


def cloud(n: int, seed: int = 0) -> FloatArray:
    """(n, 3) no further than 1 from the middle."""
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (n, 3))


def test_points_are_added_to_those_that_are_there() -> None:
    one = ObjectModel(radius=1.0).with_points(cloud(100, 1), 0)
    two = one.with_points(cloud(50, 2), 0)
    np.testing.assert_array_equal(two.points, np.concatenate([cloud(100, 1), cloud(50, 2)]))


@pytest.mark.parametrize("radius", [0.1, 1.0])
def test_what_is_further_away_than_twice_the_radius_is_not_on_the_object(radius: float) -> None:
    directions = cloud(200) / np.linalg.norm(cloud(200), axis=1, keepdims=True)
    inside, outside = 1.99 * radius * directions, 2.01 * radius * directions
    model = ObjectModel(radius=radius).with_points(np.concatenate([outside, inside]), 0)
    np.testing.assert_array_equal(model.points, inside)


def test_while_the_radius_is_unknown_nothing_is_known_to_be_on_it() -> None:
    assert len(ObjectModel().with_points(cloud(50), 0).points) == 0


@pytest.mark.parametrize("n", [MAX_POINTS - 1, MAX_POINTS, MAX_POINTS + 1, 5 * MAX_POINTS])
def test_of_too_many_points_a_random_part_is_kept(n: int) -> None:
    points = cloud(n)
    kept = ObjectModel(radius=1.0).with_points(points, 0).points
    assert len(kept) == min(n, MAX_POINTS)
    rows = {tuple(p) for p in points.tolist()}
    assert len({tuple(p) for p in kept.tolist()} & rows) == len(kept)


def test_old_points_and_new_ones_are_as_likely_to_stay() -> None:
    old, new = cloud(MAX_POINTS, 1) - np.array([1.0, 0, 0]), cloud(MAX_POINTS, 2) + np.array([1.0, 0, 0])
    model = ObjectModel(radius=2.0).with_points(old, 0).with_points(new, 0)
    # Five standard deviations of a fair draw are 0.07.
    assert 0.43 < (model.points[:, 0] > 0).mean() < 0.57


def test_the_part_that_is_kept_depends_on_the_seed_alone() -> None:
    model, points = ObjectModel(radius=1.0), cloud(2 * MAX_POINTS)
    one, again, other = (model.with_points(points, seed).points for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)


def test_it_is_never_changed() -> None:
    model = ObjectModel(radius=1.0, points=cloud(10))
    model.with_points(cloud(2 * MAX_POINTS), 0)
    np.testing.assert_array_equal(model.points, cloud(10))
    with pytest.raises(FrozenInstanceError):
        model.radius = 2.0  # type: ignore[misc]
    more = model.with_points(cloud(5), 0)
    assert (more.center, more.radius, more.bounded, more.guessed) == (None, 1.0, False, False)
