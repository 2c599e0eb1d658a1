"""Fusing observations of a feature adds information: equal to least squares, in any order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.landmark_filter import (
    RAY_SIGMA_PX,
    DepthPrior,
    Landmarks,
    add_observations,
    compute_rays,
    initialize_landmarks,
    predict_depths,
    update_landmarks,
)
from sylpose.rig import Camera
from sylpose.simulate import ellipsoid, ring

RADIUS = 0.15
WORLD_FROM_OBJECT = RigidTransform.from_components([0.02, -0.03, 0.05], Rotation.from_rotvec([0.3, -0.2, 0.1]))


@pytest.fixture(scope="module")
def cameras() -> Sequence[Camera]:
    """Return six cameras around the object, 1.5 m away, with lens distortion."""
    return ring(6, 1.5, 1000.0, height=0.3, distortion=(-0.1, 0.02, 0.0, 0.0)).cameras


def features_at(pixels: FloatArray, camera: Camera) -> Features:
    return Features(pixels, camera.normalize(pixels), np.zeros((len(pixels), 128), np.float32))


def observe(points: FloatArray, camera: Camera, noise: FloatArray | float = 0.0) -> Features:
    """Return features of points (n, 3) in the object's frame."""
    return features_at(camera.project(WORLD_FROM_OBJECT.apply(points)) + noise, camera)


def observe_first(
    points: FloatArray, camera: Camera, off: float, sd: float, noise: FloatArray | float = 0.0
) -> Landmarks:
    """Return new landmarks whose predicted depth has the error `off` and the standard deviation `sd`."""
    object_from_world = WORLD_FROM_OBJECT.inv()
    distance = np.linalg.norm(points - object_from_world.apply(camera.center), axis=1) + off
    return initialize_landmarks(
        observe(points, camera, noise), camera, object_from_world, distance, np.full(len(points), float(sd))
    )


def surface(n: int, seed: int = 0) -> FloatArray:
    return ellipsoid((RADIUS, 0.1, 0.12), n=n, seed=seed).points


def test_rays_pass_through_their_points(cameras: Sequence[Camera]) -> None:
    points = surface(30)
    center, directions = compute_rays(observe(points, cameras[1]), cameras[1], WORLD_FROM_OBJECT.inv())
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    along = points - center
    np.testing.assert_allclose(np.cross(directions, along), 0, atol=1e-7)
    assert (np.einsum("ni,ni->n", directions, along) > 0).all()


def test_first_observation_constrains_across_its_ray(cameras: Sequence[Camera]) -> None:
    camera, points = cameras[0], surface(20)
    landmarks = observe_first(points, camera, 0.04, 0.1)
    center, directions = compute_rays(observe(points, camera), camera, WORLD_FROM_OBJECT.inv())
    np.testing.assert_allclose(landmarks.mean, points + 0.04 * directions, atol=1e-7)
    np.testing.assert_allclose(landmarks.depth_sd, 0.1)
    np.testing.assert_allclose(
        np.abs(np.einsum("ni,ni->n", landmarks.depth_error, directions)), 0.1, rtol=1e-9, err_msg="s r, up to its sign"
    )
    covariance = np.linalg.inv(landmarks.information)
    distance = np.linalg.norm(landmarks.mean - center, axis=1)
    across = np.sqrt((np.trace(covariance, axis1=1, axis2=2) - 0.1**2) / 2)
    np.testing.assert_allclose(across, RAY_SIGMA_PX * distance / camera.focal, rtol=1e-6)
    assert (landmarks.n_observations == 1).all()


def test_depth_error_is_the_longest_covariance_axis(cameras: Sequence[Camera]) -> None:
    points = surface(25)
    landmarks = observe_first(points, cameras[0], 0.02, 0.1)
    landmarks = add_observations(landmarks, observe(points, cameras[1]), cameras[1], WORLD_FROM_OBJECT.inv())
    for information, error, sd in zip(landmarks.information, landmarks.depth_error, landmarks.depth_sd, strict=True):
        values, vectors = np.linalg.eigh(np.linalg.inv(information))
        np.testing.assert_allclose(sd, np.sqrt(values[-1]), rtol=1e-6)
        np.testing.assert_allclose(np.abs(error), np.abs(np.sqrt(values[-1]) * vectors[:, -1]), rtol=1e-4, atol=1e-9)


def test_observations_add_information(cameras: Sequence[Camera]) -> None:
    points = surface(15)
    landmarks = observe_first(points, cameras[0], 0.05, 0.1)
    for k, camera in enumerate(cameras[1:], start=2):
        again = add_observations(landmarks, observe(points, camera), camera, WORLD_FROM_OBJECT.inv())
        assert (np.linalg.eigvalsh(again.information - landmarks.information) > -1e-6).all()
        assert (again.depth_sd <= landmarks.depth_sd * (1 + 1e-12)).all()
        assert (again.n_observations == k).all()
        landmarks = again
    assert (landmarks.depth_sd < 0.004).all()


def test_exact_rays_intersect_in_the_point(cameras: Sequence[Camera]) -> None:
    points = surface(15)
    landmarks = observe_first(points, cameras[0], 0.05, 1e4)
    for camera in cameras[1:3]:
        landmarks = add_observations(landmarks, observe(points, camera), camera, WORLD_FROM_OBJECT.inv())
    np.testing.assert_allclose(landmarks.mean, points, atol=1e-6)


def test_order_of_observations_does_not_matter(cameras: Sequence[Camera]) -> None:
    rng = np.random.default_rng(1)
    points = surface(20)
    noise = rng.normal(0, 1, (len(cameras), len(points), 2))

    def fused(order: Sequence[int]) -> Landmarks:
        landmarks = observe_first(points, cameras[0], 0.01, 0.05, noise[0])
        for i in order:
            seen = observe(points, cameras[i], noise[i])
            landmarks = add_observations(landmarks, seen, cameras[i], WORLD_FROM_OBJECT.inv())
        return landmarks

    one, other = fused([1, 2, 3, 4, 5]), fused([4, 2, 5, 1, 3])
    # The order matters only for the weights, which use the present distance estimate.
    np.testing.assert_allclose(one.mean, other.mean, atol=0.03 * one.depth_sd.max())
    np.testing.assert_allclose(one.depth_sd, other.depth_sd, rtol=0.02)


def test_without_prior_equals_least_squares_triangulation(cameras: Sequence[Camera]) -> None:
    rng = np.random.default_rng(2)
    points, object_from_world = surface(20), WORLD_FROM_OBJECT.inv()
    matches = [observe(points, camera, rng.normal(0, 1, (len(points), 2))) for camera in cameras[:4]]
    landmarks = initialize_landmarks(
        matches[0],
        cameras[0],
        object_from_world,
        np.linalg.norm(points - object_from_world.apply(cameras[0].center), axis=1),
        np.full(len(points), 1e6),
    )
    for camera, seen in zip(cameras[1:4], matches[1:], strict=True):
        landmarks = add_observations(landmarks, seen, camera, object_from_world)
    for k in range(len(points)):
        # Weighted distances to all rays, in one problem.
        rows, right = [], []
        for camera, seen in zip(cameras[:4], matches, strict=True):
            center, directions = compute_rays(seen, camera, object_from_world)
            across = np.linalg.svd(directions[k : k + 1])[2][1:]
            weight = 1 / np.linalg.norm(points[k] - center)
            rows.append(weight * across)
            right.append(weight * across @ center)
        expected = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
        np.testing.assert_allclose(landmarks.mean[k], expected, atol=2e-5)


def test_covariance_is_consistent(cameras: Sequence[Camera]) -> None:
    # One point, many times: the depth prediction and the image noise are drawn from their distributions.
    rng = np.random.default_rng(3)
    n, depth_sd = 4000, 0.03
    points = np.tile([[0.05, -0.03, -0.1]], (n, 1))
    used = [cameras[0], cameras[1], cameras[5]]
    noise = rng.normal(0, RAY_SIGMA_PX, (3, n, 2))
    object_from_world = WORLD_FROM_OBJECT.inv()
    center = object_from_world.apply(used[0].center)
    distance = np.linalg.norm(points - center, axis=1) + rng.normal(0, depth_sd, n)
    landmarks = initialize_landmarks(
        observe(points, used[0], noise[0]), used[0], object_from_world, distance, np.full(n, depth_sd)
    )
    one = landmarks.mean - points
    for camera, shift in zip(used[1:], noise[1:], strict=True):
        landmarks = add_observations(landmarks, observe(points, camera, shift), camera, object_from_world)
    for errors in (one, landmarks.mean - points):
        assert np.linalg.norm(errors.mean(axis=0)) < 0.1 * errors.std()
    error = landmarks.mean - points
    # Normalized squares average 3 for 3 unknowns, equally in all directions.
    squares = np.einsum("ni,nij,nj->n", error, landmarks.information, error)
    assert squares.mean() == pytest.approx(3, rel=0.1)
    text = np.linalg.inv(landmarks.information).mean(axis=0)
    ratio = np.linalg.eigvals(np.linalg.solve(text, np.cov(error.T)))
    np.testing.assert_allclose(ratio.real, 1, atol=0.15)


# --- depth of what was never seen before


def test_depth_prior_uses_surrounding_points(cameras: Sequence[Camera]) -> None:
    camera = cameras[2]
    cloud = surface(3000)
    world = WORLD_FROM_OBJECT.apply(cloud)
    distance = np.linalg.norm(world - camera.center, axis=1)
    front = distance < np.median(distance)  # one layer: the visible surface
    probes = np.flatnonzero(front)[::40]
    guess, sd = predict_depths(
        observe(cloud[probes], camera), camera, WORLD_FROM_OBJECT, DepthPrior(cloud[front], RADIUS)
    )
    error = guess - distance[probes]
    assert np.median(np.abs(error)) < 0.05 * RADIUS
    assert (np.abs(error) < 4 * sd).all()


def test_depth_prior_is_bounded_by_the_radius(cameras: Sequence[Camera]) -> None:
    camera, cloud = cameras[0], surface(400)
    rng = np.random.default_rng(4)
    anywhere = features_at(rng.uniform(0, 900, (200, 2)), camera)
    distance, sd = predict_depths(anywhere, camera, WORLD_FROM_OBJECT, DepthPrior(cloud, RADIUS))
    assert (sd <= RADIUS).all()
    assert (sd >= 0.05 * RADIUS).all()
    # Far from the object only its size is known.
    assert sd.max() == RADIUS
    middle = np.linalg.norm(WORLD_FROM_OBJECT.translation - camera.center)
    assert (np.abs(distance - middle) <= 1.01 * RADIUS).all()
    # Flat and dense: the lower bound.
    flat = np.column_stack([rng.uniform(-0.1, 0.1, (2000, 2)), np.zeros(2000)])
    facing = RigidTransform.from_components([0, 0, 0], Rotation.from_matrix(camera.rotation.T))
    _, least = predict_depths(
        features_at(camera.project(facing.apply(flat[:50])), camera), camera, facing, DepthPrior(flat, 100 * RADIUS)
    )
    np.testing.assert_allclose(least, least.min())
    assert least.min() > 0


@pytest.mark.parametrize("n_points", [0, 3])
def test_depth_prior_without_a_cloud_is_the_center(cameras: Sequence[Camera], n_points: int) -> None:
    camera = cameras[1]
    features = observe(surface(5), camera)
    distance, sd = predict_depths(features, camera, WORLD_FROM_OBJECT, DepthPrior(surface(10)[:n_points], RADIUS))
    np.testing.assert_allclose(distance, np.linalg.norm(WORLD_FROM_OBJECT.translation - camera.center))
    np.testing.assert_allclose(sd, RADIUS)


def test_depth_prior_ignores_points_behind_the_camera(cameras: Sequence[Camera]) -> None:
    camera, cloud = cameras[0], surface(300)
    features = observe(surface(20, seed=5), camera)
    behind = WORLD_FROM_OBJECT.inv().apply(camera.center - camera.direction * np.linspace(0.5, 2, 50)[:, None])
    with_them = predict_depths(features, camera, WORLD_FROM_OBJECT, DepthPrior(np.concatenate([cloud, behind]), RADIUS))
    np.testing.assert_array_equal(
        with_them, predict_depths(features, camera, WORLD_FROM_OBJECT, DepthPrior(cloud, RADIUS))
    )


def test_depth_prior_without_features(cameras: Sequence[Camera]) -> None:
    distance, sd = predict_depths(Features.empty(), cameras[0], WORLD_FROM_OBJECT, DepthPrior(surface(50), RADIUS))
    assert distance.shape == sd.shape == (0,)


# --- a solved frame's landmarks


def test_update_keeps_known_and_adds_new(cameras: Sequence[Camera]) -> None:
    camera, points = cameras[1], surface(12)
    index = np.array([7, 2, 9])
    known = observe_first(points[index], cameras[0], 0.01, 0.05)
    before = known.mean.copy(), known.information.copy()
    features = observe(points, camera)
    learnt = update_landmarks(features, camera, WORLD_FROM_OBJECT, DepthPrior(surface(200), RADIUS), known, index)
    assert len(learnt) == 12
    again = add_observations(known, features.subset(index), camera, WORLD_FROM_OBJECT.inv())
    np.testing.assert_allclose(learnt.mean[index], again.mean)
    np.testing.assert_allclose(learnt.information[index], again.information)
    assert learnt.n_observations.tolist() == [1, 1, 2, 1, 1, 1, 1, 2, 1, 2, 1, 1]
    others = np.setdiff1d(np.arange(12), index)
    distance, sd = predict_depths(features, camera, WORLD_FROM_OBJECT, DepthPrior(surface(200), RADIUS))
    new = initialize_landmarks(features, camera, WORLD_FROM_OBJECT.inv(), distance, sd)
    np.testing.assert_allclose(learnt.mean[others], new.mean[others])
    # The keyframe's landmarks are unchanged.
    np.testing.assert_array_equal(known.mean, before[0])
    np.testing.assert_array_equal(known.information, before[1])


def test_update_without_features_or_landmarks(cameras: Sequence[Camera]) -> None:
    nothing = np.empty(0, np.int64)
    learnt = update_landmarks(
        Features.empty(), cameras[0], WORLD_FROM_OBJECT, DepthPrior(surface(50), RADIUS), Landmarks.empty(), nothing
    )
    assert len(learnt) == 0
    assert learnt.information.shape == (0, 3, 3)
    assert learnt.depth_sd.shape == (0,)
    assert learnt.depth_error.shape == (0, 3)


def test_subset_and_concatenate_are_inverse(cameras: Sequence[Camera]) -> None:
    landmarks = observe_first(surface(9), cameras[0], 0.0, 0.1)
    mask = np.arange(9) < 4
    back = Landmarks.concatenate([landmarks.subset(mask), landmarks.subset(np.arange(4, 9))])
    np.testing.assert_array_equal(back.mean, landmarks.mean)
    np.testing.assert_array_equal(back.information, landmarks.information)
    np.testing.assert_array_equal(back.n_observations, landmarks.n_observations)
    assert len(Landmarks.concatenate([])) == 0
