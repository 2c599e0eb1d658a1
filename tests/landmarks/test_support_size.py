"""A body's size from what several cameras see of its surface, with no point in common."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.support_size import DIRECTIONS, Extent, extent_of, size_of
from sylpose.rig import Rig
from sylpose.simulate import Body, arc, box, ellipsoid, plane

RADIUS, DISTANCE = 0.15, 1.5


def extents(
    rig: Rig, body: Body, turn: FloatArray, larger: float, rng: np.random.Generator, seen: float
) -> list[Extent]:
    """What cameras would take for the body's surface, all of it so many times too large and too far away.

    Args:
        seen: share of the points that are features where the surface faces the camera; where it is seen obliquely, less.
    """
    points, normals = body.points @ turn.T, body.normals @ turn.T
    found = []
    for camera in rig:
        rays = points - camera.center
        facing = -np.einsum("ni,ni->n", rays, normals) / np.linalg.norm(rays, axis=1)
        visible = rng.random(len(points)) < np.where(facing > 0.15, facing, 0.0) * seen
        deep = larger + rng.normal(0, 0.003, (int(visible.sum()), 1))
        found.append(extent_of(camera.center + rays[visible] * deep, camera.center))
    return found


def body_of(kind: str, sides: FloatArray, seed: int) -> Body:
    """One whose radius is about `RADIUS`."""
    if kind == "box":
        return box(2 * RADIUS * sides / np.linalg.norm(sides), 1500, seed)
    if kind == "ellipsoid":
        return ellipsoid(RADIUS * sides, 1500, seed)
    return (
        box([2 * RADIUS, 0.03, 0.03], 1500, seed) if kind == "rod" else plane([0.25, 0.18], 1500, seed, two_sided=False)
    )


def errors(kind: str, cameras: int, spacing: float, scenes: int) -> tuple[FloatArray, FloatArray]:
    """(n,) of the sizes found, and their standard deviations."""
    rng, off, sds, rig = np.random.default_rng(3), [], [], arc(cameras, spacing, DISTANCE)
    for seed in range(scenes):
        body = body_of(kind, rng.uniform(0.6, 1.0, 3), seed)
        larger = 1.0 + rng.normal(0, 0.04)
        turn = Rotation.from_rotvec(rng.normal(0, 0.4, 3)) if kind == "board" else Rotation.random(rng=rng)
        found, sd = size_of(extents(rig, body, turn.as_matrix(), larger, rng, 0.35), RADIUS)
        off.append(found - (1.0 / larger - 1.0))
        sds.append(sd)
    return np.array(off), np.array(sds)


@pytest.mark.parametrize("kind", ["box", "ellipsoid", "rod", "board"])
@pytest.mark.parametrize(("cameras", "spacing"), [(2, 60.0), (4, 60.0)])
def test_a_size_is_found_without_a_common_point(kind: str, cameras: int, spacing: float) -> None:
    off, sds = errors(kind, cameras, spacing, 60)
    told = sds < 0.03
    assert told.mean() > 0.9
    # Believed of its place alone, it would be off by 0.04.
    assert np.sqrt(np.mean(off[told] ** 2)) < 0.012
    squares = (off[told] / sds[told]) ** 2
    assert 0.01 < squares.mean() < 1.5
    assert squares.max() < 9.0


def test_it_follows_the_size_exactly_where_features_are_dense() -> None:
    rng, rig = np.random.default_rng(0), arc(4, 60.0, DISTANCE)
    body = ellipsoid([0.15, 0.12, 0.1], 60_000)
    found = [size_of(extents(rig, body, np.eye(3), larger, rng, 1.0), RADIUS)[0] for larger in (0.95, 1.0, 1.05)]
    np.testing.assert_allclose(np.diff(found), [1.0 - 1.0 / 0.95, 1.0 / 1.05 - 1.0], atol=2e-3)


def test_a_body_that_is_half_hidden_from_a_camera_makes_it_less_certain() -> None:
    rng, rig = np.random.default_rng(1), arc(3, 60.0, DISTANCE)
    whole = extents(rig, ellipsoid([0.15, 0.12, 0.1], 4000), np.eye(3), 1.0, rng, 0.35)
    half = ellipsoid([0.15, 0.12, 0.1], 4000)
    left = half.points[:, 0] < -0.03
    hidden = [*whole[:2], *extents(rig, Body(half.points[left], half.normals[left]), np.eye(3), 1.0, rng, 0.35)[2:]]
    size, sd = size_of(hidden, RADIUS)
    assert sd > 1.2 * size_of(whole, RADIUS)[1]
    assert abs(size) < 4 * sd


def test_opposite_cameras_and_single_ones_tell_nothing() -> None:
    rng, body = np.random.default_rng(2), ellipsoid([0.15, 0.12, 0.1], 4000)
    opposite = extents(arc(2, 180.0, DISTANCE), body, np.eye(3), 1.1, rng, 0.35)
    assert size_of(opposite, RADIUS)[1] == np.inf
    assert size_of(opposite[:1], RADIUS)[1] == np.inf
    assert size_of([], RADIUS) == (0.0, np.inf)
    few = extent_of(body.points[:10], np.array([0.0, 0.0, -1.5]))
    assert np.isnan(few.height).all()


def test_directions_are_even() -> None:
    np.testing.assert_allclose(np.linalg.norm(DIRECTIONS, axis=1), 1.0)
    np.testing.assert_allclose(DIRECTIONS.T @ DIRECTIONS / len(DIRECTIONS), np.eye(3) / 3, atol=1e-3)
