"""Axes of an object from points on it: correct by construction, in any frame; degenerate input is rejected."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.absolute_pose.object_axes import (
    MIN_POINTS,
    axes_from_extent,
    axes_from_plane,
    axes_from_points,
    estimate_axes_sd,
    fit_plane,
    fit_plane_to_points,
)
from sylpose.geometry.arrays import FloatArray

OTHER_FRAME = RigidTransform.from_components([0.3, -0.2, 0.5], Rotation.from_rotvec([0.4, -1.1, 0.7]))


def face(rng: np.random.Generator, n: int = 200, noise: float = 0.0) -> FloatArray:
    """Return (n, 3) points on a rectangle of 0.4 x 0.2 at z = 0.1."""
    return rng.uniform([-0.2, -0.1, 0.1], [0.2, 0.1, 0.1], (n, 3)) + noise * rng.normal(size=(n, 3))


def test_three_points_define_the_axes() -> None:
    origin, x, xy = np.random.default_rng(3).normal(size=(3, 3))
    new = axes_from_points(origin, x, xy)
    np.testing.assert_allclose(new.apply(origin), 0.0, atol=1e-14)
    on_x, in_plane = new.apply(x), new.apply(xy)
    np.testing.assert_allclose(on_x[1:], 0.0, atol=1e-14)
    assert on_x[0] == pytest.approx(np.linalg.norm(x - origin))
    assert in_plane[2] == pytest.approx(0.0, abs=1e-14)
    assert in_plane[1] > 0


def test_axes_move_with_the_object() -> None:
    """Points given in another frame have the same coordinates in the new frame."""
    rng = np.random.default_rng(1)
    points, three = face(rng), rng.normal(size=(3, 3))
    there, moved = OTHER_FRAME.apply(three), OTHER_FRAME.apply(points)
    np.testing.assert_allclose(axes_from_points(*three).apply(three), axes_from_points(*there).apply(there), atol=1e-12)
    normal, middle, _ = fit_plane(points, 0.3, np.zeros(3), np.random.default_rng(0))
    other, elsewhere, _ = fit_plane(moved, 0.3, OTHER_FRAME.translation, np.random.default_rng(0))
    np.testing.assert_allclose(OTHER_FRAME.rotation.apply(normal), other, atol=1e-9)
    np.testing.assert_allclose(OTHER_FRAME.apply(middle), elsewhere, atol=1e-9)


def test_largest_plane_with_outward_normal() -> None:
    rng = np.random.default_rng(5)
    side = rng.uniform([0.2, -0.1, -0.1], [0.2, 0.1, 0.1], (90, 3))
    stray = rng.uniform(-0.2, 0.2, (60, 3))
    points = np.concatenate([face(rng, noise=0.0005), side, stray])
    normal, middle, good = fit_plane(points, 0.25, np.zeros(3), np.random.default_rng(0))
    assert np.degrees(np.arccos(normal[2])) < 0.2
    assert middle[2] == pytest.approx(0.1, abs=2e-4)
    assert good[:200].all()
    assert good[200:].sum() < 15
    assert fit_plane(points, 0.25, np.array([0, 0, 1.0]), np.random.default_rng(0))[0][2] < -0.99
    new = axes_from_plane(normal, middle, np.array([0.1, 0.05, 0.3]), np.array([0.2, 0.05, 0.3]))
    np.testing.assert_allclose(new.apply([0.1, 0.05, 0.1]), 0.0, atol=1e-3)  # the origin is projected onto it
    np.testing.assert_allclose(new.rotation.as_matrix(), np.eye(3), atol=5e-3)
    # Without a point on X, that is the old X projected to the plane.
    np.testing.assert_allclose(axes_from_plane(normal, middle).rotation.as_matrix(), np.eye(3), atol=5e-3)
    upright = axes_from_plane(np.array([1.0, 0.0, 0.0]), np.zeros(3))
    np.testing.assert_allclose(upright.rotation.apply([0.0, 1.0, 0.0]), [1.0, 0.0, 0.0], atol=1e-14)


def test_extents_are_ordered_with_fixed_signs() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform([-0.1, -0.3, -0.2], [0.1, 0.3, 0.2], (400, 3)) + np.array([0.5, 0.6, 0.7])
    far = np.concatenate([points, 30 * rng.normal(size=(12, 3))])
    for these in (points, far):
        new = axes_from_extent(these)
        np.testing.assert_allclose(new.inv().translation, [0.5, 0.6, 0.7], atol=0.03)
        axes = new.inv().rotation.as_matrix().T
        np.testing.assert_allclose(axes[[0, 2]], [[0, 1, 0], [1, 0, 0]], atol=0.15)  # x is the old y, z the old x
        assert (np.ptp(new.apply(points), axis=0)[:2] > np.ptp(new.apply(points), axis=0)[1:]).all()
        assert np.linalg.det(axes) == pytest.approx(1.0)
    # Rotated by 180 degrees, the same axes have the same signs.
    half = Rotation.from_rotvec([0, 0, np.pi])
    np.testing.assert_allclose(axes_from_extent(half.apply(points)).rotation.as_matrix(), axes, atol=0.3)


def test_drawn_sd_matches_scatter_of_fits() -> None:
    """For a noisy plane, the scatter of many fits against the estimate of one."""
    off, text = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        points = face(rng, 60, 0.002)
        normal, middle, good = fit_plane(points, 0.25, np.zeros(3), rng)
        found, on = axes_from_plane(normal, middle), points[good]
        off.append(found.rotation.apply([0, 0, 1.0])[:2])

        def again(rng: np.random.Generator, on: FloatArray = on, normal: FloatArray = normal) -> RigidTransform:
            return axes_from_plane(*fit_plane_to_points(on[rng.integers(0, len(on), len(on))], normal))

        text.append(estimate_axes_sd(found, again))
    true, reported = np.sqrt(np.mean(np.square(off), axis=0)), np.sqrt(np.mean(np.square(text), axis=0))[[1, 0]]
    assert (reported / true > 0.6).all()
    assert (reported / true < 1.6).all()
    never = estimate_axes_sd(RigidTransform.identity(), lambda _: axes_from_points(*np.zeros((3, 3))))
    np.testing.assert_allclose(never[:3], np.pi)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.zeros((3, 3)), "the origin and the point on \\+X are the same"),
        (np.outer([0, 1, 2], [1, 1, 1]), "the three points lie on a line"),
    ],
)
def test_degenerate_points_are_rejected(points: FloatArray, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        axes_from_points(*points.astype(float))


def test_missing_plane_or_extent_is_rejected() -> None:
    rng = np.random.default_rng(0)
    line = np.outer(rng.uniform(-1, 1, 50), [1.0, 2.0, 0.5])
    ball = rng.normal(size=(60, 3))
    for points, words in (
        (face(rng, MIN_POINTS - 1), "11 landmarks are too few for a plane"),
        (line, "on a line"),
        (0.3 * ball, "landmarks lie on a plane, and not spread"),
    ):
        with pytest.raises(ValueError, match=words):
            fit_plane(points, 1.0, np.zeros(3), rng)
    with pytest.raises(ValueError, match="11 landmarks are too few for principal directions"):
        axes_from_extent(face(rng, MIN_POINTS - 1))
    with pytest.raises(ValueError, match="lies above the origin"):
        axes_from_plane(np.array([0, 0, 1.0]), np.zeros(3), np.zeros(3), np.array([0, 0, 1.0]))
