"""Fusing sights of a feature is adding information: the answers of least squares, whatever the order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.landmark_filter import (
    RAY_SIGMA_PX,
    Landmarks,
    depth_prior,
    learn_landmarks,
    new_landmarks,
    rays,
    seen_again,
)
from sylpose.rig import Camera
from sylpose.simulate import ellipsoid, ring

RADIUS = 0.15
WORLD_FROM_OBJECT = RigidTransform.from_components([0.02, -0.03, 0.05], Rotation.from_rotvec([0.3, -0.2, 0.1]))


@pytest.fixture(scope="module")
def cameras() -> Sequence[Camera]:
    """Six cameras around the object, 1.5 m away, with lens distortion."""
    return ring(6, 1.5, 1000.0, height=0.3, distortion=(-0.1, 0.02, 0.0, 0.0)).cameras


def features_at(pixels: FloatArray, camera: Camera) -> Features:
    return Features(pixels, camera.normalize(pixels), np.zeros((len(pixels), 128), np.float32))


def sight(points: FloatArray, camera: Camera, noise: FloatArray | float = 0.0) -> Features:
    """Features of points (n, 3) in the object's frame."""
    return features_at(camera.project(WORLD_FROM_OBJECT.apply(points)) + noise, camera)


def first_sight(
    points: FloatArray, camera: Camera, off: float, sd: float, noise: FloatArray | float = 0.0
) -> Landmarks:
    """New landmarks whose depth is guessed wrong by `off` and said to be good to `sd`."""
    object_from_world = WORLD_FROM_OBJECT.inv()
    distance = np.linalg.norm(points - object_from_world.apply(camera.center), axis=1) + off
    return new_landmarks(
        sight(points, camera, noise), camera, object_from_world, distance, np.full(len(points), float(sd))
    )


def surface(n: int, seed: int = 0) -> FloatArray:
    return ellipsoid((RADIUS, 0.1, 0.12), n=n, seed=seed).points


def test_rays_pass_through_their_points(cameras: Sequence[Camera]) -> None:
    points = surface(30)
    center, directions = rays(sight(points, cameras[1]), cameras[1], WORLD_FROM_OBJECT.inv())
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    along = points - center
    np.testing.assert_allclose(np.cross(directions, along), 0, atol=1e-7)
    assert (np.einsum("ni,ni->n", directions, along) > 0).all()


def test_a_first_sight_is_known_across_its_ray_and_guessed_along_it(cameras: Sequence[Camera]) -> None:
    camera, points = cameras[0], surface(20)
    landmarks = first_sight(points, camera, 0.04, 0.1)
    center, directions = rays(sight(points, camera), camera, WORLD_FROM_OBJECT.inv())
    np.testing.assert_allclose(landmarks.mean, points + 0.04 * directions, atol=1e-7)
    np.testing.assert_allclose(landmarks.depth_sd, 0.1)
    np.testing.assert_allclose(
        np.abs(np.einsum("ni,ni->n", landmarks.depth_error, directions)), 0.1, rtol=1e-9, err_msg="s r, up to its sign"
    )
    covariance = np.linalg.inv(landmarks.information)
    distance = np.linalg.norm(landmarks.mean - center, axis=1)
    across = np.sqrt((np.trace(covariance, axis1=1, axis2=2) - 0.1**2) / 2)
    np.testing.assert_allclose(across, RAY_SIGMA_PX * distance / camera.focal, rtol=1e-6)
    assert (landmarks.seen == 1).all()


def test_depth_error_is_the_longest_axis_of_the_covariance(cameras: Sequence[Camera]) -> None:
    points = surface(25)
    landmarks = first_sight(points, cameras[0], 0.02, 0.1)
    landmarks = seen_again(landmarks, sight(points, cameras[1]), cameras[1], WORLD_FROM_OBJECT.inv())
    for information, error, sd in zip(landmarks.information, landmarks.depth_error, landmarks.depth_sd, strict=True):
        values, vectors = np.linalg.eigh(np.linalg.inv(information))
        np.testing.assert_allclose(sd, np.sqrt(values[-1]), rtol=1e-6)
        np.testing.assert_allclose(np.abs(error), np.abs(np.sqrt(values[-1]) * vectors[:, -1]), rtol=1e-4, atol=1e-9)


def test_each_sight_adds_information_and_counts(cameras: Sequence[Camera]) -> None:
    points = surface(15)
    landmarks = first_sight(points, cameras[0], 0.05, 0.1)
    for k, camera in enumerate(cameras[1:], start=2):
        again = seen_again(landmarks, sight(points, camera), camera, WORLD_FROM_OBJECT.inv())
        assert (np.linalg.eigvalsh(again.information - landmarks.information) > -1e-6).all()
        assert (again.depth_sd <= landmarks.depth_sd * (1 + 1e-12)).all()
        assert (again.seen == k).all()
        landmarks = again
    assert (landmarks.depth_sd < 0.004).all()


def test_exact_rays_meet_in_the_point(cameras: Sequence[Camera]) -> None:
    points = surface(15)
    landmarks = first_sight(points, cameras[0], 0.05, 1e4)
    for camera in cameras[1:3]:
        landmarks = seen_again(landmarks, sight(points, camera), camera, WORLD_FROM_OBJECT.inv())
    np.testing.assert_allclose(landmarks.mean, points, atol=1e-6)


def test_the_order_of_sights_does_not_matter(cameras: Sequence[Camera]) -> None:
    rng = np.random.default_rng(1)
    points = surface(20)
    noise = rng.normal(0, 1, (len(cameras), len(points), 2))

    def fused(order: Sequence[int]) -> Landmarks:
        landmarks = first_sight(points, cameras[0], 0.01, 0.05, noise[0])
        for i in order:
            seen = sight(points, cameras[i], noise[i])
            landmarks = seen_again(landmarks, seen, cameras[i], WORLD_FROM_OBJECT.inv())
        return landmarks

    one, other = fused([1, 2, 3, 4, 5]), fused([4, 2, 5, 1, 3])
    # Only through the weights, which are taken at the distance known so far, does the order have any say.
    np.testing.assert_allclose(one.mean, other.mean, atol=0.03 * one.depth_sd.max())
    np.testing.assert_allclose(one.depth_sd, other.depth_sd, rtol=0.02)


def test_without_a_prior_it_is_least_squares_triangulation(cameras: Sequence[Camera]) -> None:
    rng = np.random.default_rng(2)
    points, object_from_world = surface(20), WORLD_FROM_OBJECT.inv()
    sights = [sight(points, camera, rng.normal(0, 1, (len(points), 2))) for camera in cameras[:4]]
    landmarks = new_landmarks(
        sights[0],
        cameras[0],
        object_from_world,
        np.linalg.norm(points - object_from_world.apply(cameras[0].center), axis=1),
        np.full(len(points), 1e6),
    )
    for camera, seen in zip(cameras[1:4], sights[1:], strict=True):
        landmarks = seen_again(landmarks, seen, camera, object_from_world)
    for k in range(len(points)):
        # Weighted distances to the rays, all at once.
        rows, right = [], []
        for camera, seen in zip(cameras[:4], sights, strict=True):
            center, directions = rays(seen, camera, object_from_world)
            across = np.linalg.svd(directions[k : k + 1])[2][1:]
            weight = 1 / np.linalg.norm(points[k] - center)
            rows.append(weight * across)
            right.append(weight * across @ center)
        expected = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
        np.testing.assert_allclose(landmarks.mean[k], expected, atol=2e-5)


def test_the_covariance_is_that_of_the_errors(cameras: Sequence[Camera]) -> None:
    # One point, many times: the depth guess and the image noise are drawn as they are said to be.
    rng = np.random.default_rng(3)
    n, depth_sd = 4000, 0.03
    points = np.tile([[0.05, -0.03, -0.1]], (n, 1))
    used = [cameras[0], cameras[1], cameras[5]]
    noise = rng.normal(0, RAY_SIGMA_PX, (3, n, 2))
    object_from_world = WORLD_FROM_OBJECT.inv()
    center = object_from_world.apply(used[0].center)
    distance = np.linalg.norm(points - center, axis=1) + rng.normal(0, depth_sd, n)
    landmarks = new_landmarks(
        sight(points, used[0], noise[0]), used[0], object_from_world, distance, np.full(n, depth_sd)
    )
    one = landmarks.mean - points
    for camera, shift in zip(used[1:], noise[1:], strict=True):
        landmarks = seen_again(landmarks, sight(points, camera, shift), camera, object_from_world)
    for errors in (one, landmarks.mean - points):
        assert np.linalg.norm(errors.mean(axis=0)) < 0.1 * errors.std()
    error = landmarks.mean - points
    # Normalised squares average 3 for 3 unknowns, and no direction stands out.
    squares = np.einsum("ni,nij,nj->n", error, landmarks.information, error)
    assert squares.mean() == pytest.approx(3, rel=0.1)
    said = np.linalg.inv(landmarks.information).mean(axis=0)
    ratio = np.linalg.eigvals(np.linalg.solve(said, np.cov(error.T)))
    np.testing.assert_allclose(ratio.real, 1, atol=0.15)


# --- depth of what was never seen before


def test_depth_prior_reads_the_depth_of_the_points_around(cameras: Sequence[Camera]) -> None:
    camera = cameras[2]
    cloud = surface(3000)
    world = WORLD_FROM_OBJECT.apply(cloud)
    distance = np.linalg.norm(world - camera.center, axis=1)
    front = distance < np.median(distance)  # one layer: what is seen
    probes = np.flatnonzero(front)[::40]
    guess, sd = depth_prior(sight(cloud[probes], camera), camera, WORLD_FROM_OBJECT, cloud[front], RADIUS)
    error = guess - distance[probes]
    assert np.median(np.abs(error)) < 0.05 * RADIUS
    assert (np.abs(error) < 4 * sd).all()


def test_depth_prior_is_bounded_by_the_radius(cameras: Sequence[Camera]) -> None:
    camera, cloud = cameras[0], surface(400)
    rng = np.random.default_rng(4)
    anywhere = features_at(rng.uniform(0, 900, (200, 2)), camera)
    distance, sd = depth_prior(anywhere, camera, WORLD_FROM_OBJECT, cloud, RADIUS)
    assert (sd <= RADIUS).all()
    assert (sd >= 0.05 * RADIUS).all()
    # Far from the object nothing is known but its size.
    assert sd.max() == RADIUS
    middle = np.linalg.norm(WORLD_FROM_OBJECT.translation - camera.center)
    assert (np.abs(distance - middle) <= 1.01 * RADIUS).all()
    # Flat and dense: the lower bound.
    flat = np.column_stack([rng.uniform(-0.1, 0.1, (2000, 2)), np.zeros(2000)])
    facing = RigidTransform.from_components([0, 0, 0], Rotation.from_matrix(camera.rotation.T))
    _, least = depth_prior(
        features_at(camera.project(facing.apply(flat[:50])), camera), camera, facing, flat, 100 * RADIUS
    )
    np.testing.assert_allclose(least, least.min())
    assert least.min() > 0


@pytest.mark.parametrize("n_points", [0, 3])
def test_depth_prior_without_a_cloud_is_the_middle(cameras: Sequence[Camera], n_points: int) -> None:
    camera = cameras[1]
    features = sight(surface(5), camera)
    distance, sd = depth_prior(features, camera, WORLD_FROM_OBJECT, surface(10)[:n_points], RADIUS)
    np.testing.assert_allclose(distance, np.linalg.norm(WORLD_FROM_OBJECT.translation - camera.center))
    np.testing.assert_allclose(sd, RADIUS)


def test_depth_prior_ignores_points_behind_the_camera(cameras: Sequence[Camera]) -> None:
    camera, cloud = cameras[0], surface(300)
    features = sight(surface(20, seed=5), camera)
    behind = WORLD_FROM_OBJECT.inv().apply(camera.center - camera.direction * np.linspace(0.5, 2, 50)[:, None])
    with_them = depth_prior(features, camera, WORLD_FROM_OBJECT, np.concatenate([cloud, behind]), RADIUS)
    np.testing.assert_array_equal(with_them, depth_prior(features, camera, WORLD_FROM_OBJECT, cloud, RADIUS))


def test_no_features_no_prior(cameras: Sequence[Camera]) -> None:
    distance, sd = depth_prior(Features.none(), cameras[0], WORLD_FROM_OBJECT, surface(50), RADIUS)
    assert distance.shape == sd.shape == (0,)


# --- a solved frame's landmarks


def test_learning_keeps_the_known_and_adds_the_new(cameras: Sequence[Camera]) -> None:
    camera, points = cameras[1], surface(12)
    index = np.array([7, 2, 9])
    known = first_sight(points[index], cameras[0], 0.01, 0.05)
    before = known.mean.copy(), known.information.copy()
    features = sight(points, camera)
    learnt = learn_landmarks(features, camera, WORLD_FROM_OBJECT, known, index, surface(200), RADIUS)
    assert len(learnt) == 12
    again = seen_again(known, features.subset(index), camera, WORLD_FROM_OBJECT.inv())
    np.testing.assert_allclose(learnt.mean[index], again.mean)
    np.testing.assert_allclose(learnt.information[index], again.information)
    assert learnt.seen.tolist() == [1, 1, 2, 1, 1, 1, 1, 2, 1, 2, 1, 1]
    others = np.setdiff1d(np.arange(12), index)
    distance, sd = depth_prior(features, camera, WORLD_FROM_OBJECT, surface(200), RADIUS)
    new = new_landmarks(features, camera, WORLD_FROM_OBJECT.inv(), distance, sd)
    np.testing.assert_allclose(learnt.mean[others], new.mean[others])
    # What the reference knew is still what it knew.
    np.testing.assert_array_equal(known.mean, before[0])
    np.testing.assert_array_equal(known.information, before[1])


def test_learning_without_features_or_knowledge(cameras: Sequence[Camera]) -> None:
    nothing = np.empty(0, np.int64)
    learnt = learn_landmarks(
        Features.none(), cameras[0], WORLD_FROM_OBJECT, Landmarks.none(), nothing, surface(50), RADIUS
    )
    assert len(learnt) == 0
    assert learnt.information.shape == (0, 3, 3)
    assert learnt.depth_sd.shape == (0,)
    assert learnt.depth_error.shape == (0, 3)


def test_subset_and_concatenate_undo_each_other(cameras: Sequence[Camera]) -> None:
    landmarks = first_sight(surface(9), cameras[0], 0.0, 0.1)
    mask = np.arange(9) < 4
    back = Landmarks.concatenate([landmarks.subset(mask), landmarks.subset(np.arange(4, 9))])
    np.testing.assert_array_equal(back.mean, landmarks.mean)
    np.testing.assert_array_equal(back.information, landmarks.information)
    np.testing.assert_array_equal(back.seen, landmarks.seen)
    assert len(Landmarks.concatenate([])) == 0
