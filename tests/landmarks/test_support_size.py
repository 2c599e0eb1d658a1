"""Size of a body from several cameras' views of its surface, without common points."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.support_size import DIRECTIONS, Extent, compute_extent, estimate_size
from sylpose.rig import Rig
from sylpose.simulate import Body, arc, box, ellipsoid, plane

RADIUS, DISTANCE = 0.15, 1.5


def extents(
    rig: Rig, body: Body, turn: FloatArray, larger: float, rng: np.random.Generator, seen: float
) -> list[Extent]:
    """Return the surfaces estimated by cameras, with a common factor of size and distance.

    Args:
        seen: fraction of the points that are features where the surface faces the camera; smaller at oblique angles.
    """
    points, normals = body.points @ turn.T, body.normals @ turn.T
    found = []
    for camera in rig:
        rays = points - camera.center
        facing = -np.einsum("ni,ni->n", rays, normals) / np.linalg.norm(rays, axis=1)
        visible = rng.random(len(points)) < np.where(facing > 0.15, facing, 0.0) * seen
        deep = larger + rng.normal(0, 0.003, (int(visible.sum()), 1))
        found.append(compute_extent(camera.center + rays[visible] * deep, camera.center))
    return found


def body_of(kind: str, sides: FloatArray, seed: int) -> Body:
    """Return a body with a radius of about `RADIUS`."""
    if kind == "box":
        return box(2 * RADIUS * sides / np.linalg.norm(sides), 1500, seed)
    if kind == "ellipsoid":
        return ellipsoid(RADIUS * sides, 1500, seed)
    return (
        box([2 * RADIUS, 0.03, 0.03], 1500, seed) if kind == "rod" else plane([0.25, 0.18], 1500, seed, two_sided=False)
    )


def errors(kind: str, cameras: int, spacing: float, scenes: int) -> tuple[FloatArray, FloatArray]:
    """Return (n,) errors of the sizes, and their standard deviations."""
    rng, off, sds, rig = np.random.default_rng(3), [], [], arc(cameras, spacing, DISTANCE)
    for seed in range(scenes):
        body = body_of(kind, rng.uniform(0.6, 1.0, 3), seed)
        larger = 1.0 + rng.normal(0, 0.04)
        turn = Rotation.from_rotvec(rng.normal(0, 0.4, 3)) if kind == "board" else Rotation.random(rng=rng)
        found, sd = estimate_size(extents(rig, body, turn.as_matrix(), larger, rng, 0.35), RADIUS)
        off.append(found - (1.0 / larger - 1.0))
        sds.append(sd)
    return np.array(off), np.array(sds)


@pytest.mark.parametrize("kind", ["box", "ellipsoid", "rod", "board"])
@pytest.mark.parametrize(("cameras", "spacing"), [(2, 60.0), (4, 60.0)])
def test_size_without_common_points(kind: str, cameras: int, spacing: float) -> None:
    off, sds = errors(kind, cameras, spacing, 60)
    reported = sds < 0.03
    assert reported.mean() > 0.9
    # From its position alone, the error would be 0.04.
    assert np.sqrt(np.mean(off[reported] ** 2)) < 0.012
    squares = (off[reported] / sds[reported]) ** 2
    assert 0.01 < squares.mean() < 1.5
    assert squares.max() < 9.0


def test_size_is_exact_for_dense_features() -> None:
    rng, rig = np.random.default_rng(0), arc(4, 60.0, DISTANCE)
    body = ellipsoid([0.15, 0.12, 0.1], 60_000)
    found = [estimate_size(extents(rig, body, np.eye(3), larger, rng, 1.0), RADIUS)[0] for larger in (0.95, 1.0, 1.05)]
    np.testing.assert_allclose(np.diff(found), [1.0 - 1.0 / 0.95, 1.0 / 1.05 - 1.0], atol=2e-3)


def test_partial_occlusion_increases_uncertainty() -> None:
    rng, rig = np.random.default_rng(1), arc(3, 60.0, DISTANCE)
    whole = extents(rig, ellipsoid([0.15, 0.12, 0.1], 4000), np.eye(3), 1.0, rng, 0.35)
    half = ellipsoid([0.15, 0.12, 0.1], 4000)
    left = half.points[:, 0] < -0.03
    hidden = [*whole[:2], *extents(rig, Body(half.points[left], half.normals[left]), np.eye(3), 1.0, rng, 0.35)[2:]]
    size, sd = estimate_size(hidden, RADIUS)
    assert sd > 1.2 * estimate_size(whole, RADIUS)[1]
    assert abs(size) < 4 * sd


def test_opposite_and_single_cameras_are_uninformative() -> None:
    rng, body = np.random.default_rng(2), ellipsoid([0.15, 0.12, 0.1], 4000)
    opposite = extents(arc(2, 180.0, DISTANCE), body, np.eye(3), 1.1, rng, 0.35)
    assert estimate_size(opposite, RADIUS)[1] == np.inf
    assert estimate_size(opposite[:1], RADIUS)[1] == np.inf
    assert estimate_size([], RADIUS) == (0.0, np.inf)
    few = compute_extent(body.points[:10], np.array([0.0, 0.0, -1.5]))
    assert np.isnan(few.height).all()


def test_directions_are_uniform() -> None:
    np.testing.assert_allclose(np.linalg.norm(DIRECTIONS, axis=1), 1.0)
    np.testing.assert_allclose(DIRECTIONS.T @ DIRECTIONS / len(DIRECTIONS), np.eye(3) / 3, atol=1e-3)
