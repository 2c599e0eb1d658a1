"""Shrinkage of landmark depths: noise is removed, true relief remains."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.translation_only import simulate_tracks
from sylpose.bundle_adjustment import problem
from sylpose.bundle_adjustment.bundle import bundle_adjust
from sylpose.bundle_adjustment.covariance_inflation import (
    add_second_order_terms,
    compute_depth_noise,
    shrink_depth_noise,
)
from sylpose.bundle_adjustment.kernels import Linearization, SortedObservations, Views, compute_residuals
from sylpose.geometry.arrays import FloatArray
from sylpose.simulate import arc, ellipsoid
from sylpose.simulate.bodies import Body

RIG = arc(3, 30.0, 1.5, 1000.0, height=(0.2, -0.2, 0.1))
ROUND = ellipsoid((0.15, 0.1, 0.12))


def capture_linearization(body: Body, degrees: float, seed: int, monkeypatch: pytest.MonkeyPatch) -> Linearization:
    """Return the argument of `shrink_depth_noise` for a body that translates and rotates."""
    turned = Rotation.from_rotvec([0.3, -0.2, 0.1])
    body = Body(turned.apply(body.points.copy()), turned.apply(body.normals.copy()))
    s = np.linspace(0.0, 1.0, 8)[:, None]
    poses = RigidTransform.from_components(
        s * np.array([0.0, 0.02, 0.2]), Rotation.from_rotvec(np.deg2rad(degrees) * s * np.array([0.3, 0.9, 0.2]))
    )
    calls: list[Linearization] = []

    def spy(at: Linearization) -> FloatArray:
        calls.append(at)
        return shrink_depth_noise(at)

    monkeypatch.setattr(problem, "shrink_depth_noise", spy)
    bundle_adjust(RIG, simulate_tracks(body, poses, RIG, 50, 0.4, seed), poses, 0.15)
    return calls[-1]


def make_rough_relief(at: Linearization, scatter: float, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return relief (m,) on planes, the same with noise, and the shrunk values."""
    seen, points = at.observations, at.points
    noise = np.zeros(len(points))
    compute_depth_noise(at, noise)
    rng, sd = np.random.default_rng(seed), np.sqrt(noise)
    above = np.einsum("mi,mi->m", seen.depth_direction, points)
    true = scatter * np.median(sd) * rng.standard_normal(len(points))
    noisy = true + sd * rng.standard_normal(len(points))
    on_planes = np.ascontiguousarray(points + (noisy - above)[:, None] * seen.depth_direction)
    left = np.einsum("mi,mi->m", seen.depth_direction, shrink_depth_noise(at._replace(points=on_planes)))
    used = noise > 0.0
    return true[used], noisy[used], left[used]


def test_noise_matches_each_landmark_system(monkeypatch: pytest.MonkeyPatch) -> None:
    at = capture_linearization(ROUND, 5.0, 0, monkeypatch)
    seen, views, points, weights, pull = at
    noise = np.full(len(points), np.nan)
    compute_depth_noise(at, noise)
    # Numerical derivatives, the landmark's covariance by inversion, and its part due to observation noise.
    slopes, h = np.empty((len(seen.frame), 2, 3)), 1e-5
    for j in range(3):
        ends = np.empty((2, len(seen.frame), 2))
        for end, sign in zip(ends, (1.0, -1.0), strict=True):
            compute_residuals(seen, views, np.ascontiguousarray(points + sign * h * np.eye(3)[j]), end)
        slopes[:, :, j] = (ends[0] - ends[1]) / (2.0 * h)
    information = np.add.reduceat(np.einsum("n,nai,naj->nij", weights, slopes, slopes), seen.start[:-1])
    beliefs = pull[0] * seen.depth_direction[:, :, None] * seen.depth_direction[:, None] + pull[1] * np.eye(3)
    moved = np.einsum("mij,mj->mi", np.linalg.inv(information + beliefs), seen.depth_direction)
    used = np.isfinite(noise)
    assert used.mean() > 0.8
    np.testing.assert_allclose(noise[used], np.einsum("mi,mij,mj->m", moved, information, moved)[used], rtol=1e-4)


def test_noise_is_removed_and_relief_remains(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plane keeps no relief; true relief remains, closer to its noise-free value."""
    at = capture_linearization(ROUND, 5.0, 0, monkeypatch)
    for seed in range(4):
        _, noisy, left = make_rough_relief(at, 0.0, seed)
        assert np.sum(left**2) < 0.15 * np.sum(noisy**2)
        true, noisy, left = make_rough_relief(at, 1.0, seed)
        assert np.sum((left - true) ** 2) < 0.3 * np.sum((noisy - true) ** 2)
        assert 0.3 < np.sum(left**2) / np.sum(true**2) < 2.0
        true, noisy, left = make_rough_relief(at, 10.0, seed)
        assert np.sum((left - true) ** 2) < 0.8 * np.sum((noisy - true) ** 2)
        assert 0.8 < np.sum(left**2) / np.sum(true**2) < 1.1


def test_camera_with_few_landmarks() -> None:
    """With too few landmarks there is no relief estimate: they are unchanged."""
    seen = SortedObservations(
        np.array([0, 2]),
        np.array([0, 1]),
        np.zeros(2, np.int64),
        np.zeros((2, 2)),
        np.zeros((2, 3, 0)),
        np.array([-1, 0]),
        np.zeros(1, np.int64),
        np.array([[0.0, 0.0, 1.0]]),
        np.array([[1.0, 0.0, 0.0]]),
    )
    still = np.zeros((2, 1, 3))
    eye = np.eye(3)
    views = Views(
        np.tile(eye, (2, 1, 1)),
        np.tile(eye, (2, 1, 1, 1)),
        np.tile([0.0, 0.0, 2.0], (2, 1, 1)),
        still,
        still,
        eye[None],
        eye[None],
        np.array([500.0]),
        np.zeros((1, 4)),
    )
    points = np.array([[0.1, 0.0, 0.05]])
    at = Linearization(seen, views, points, np.ones(2), np.array([1.0, 1e-3]))
    np.testing.assert_array_equal(shrink_depth_noise(at), points)


def test_product_of_two_uncertainties() -> None:
    rng = np.random.default_rng(0)
    roots = rng.standard_normal((2, 3, 3))
    turns, away = roots[0] @ roots[0].T, roots[1] @ roots[1].T
    covariance = np.eye(6)[None].copy()
    covariance[0, :3, :3] = turns
    w, p = (rng.standard_normal((400_000, 3)) @ root.T for root in roots)
    drawn = np.cross(w, p)
    added = add_second_order_terms(covariance, away[None])[0] - covariance[0]
    np.testing.assert_allclose(added[3:, 3:], drawn.T @ drawn / len(drawn), atol=0.02 * np.trace(added))
    assert not added[:3].any()
    assert not added[:, :3].any()
    np.testing.assert_array_equal(add_second_order_terms(covariance, np.zeros((1, 3, 3))), covariance)
