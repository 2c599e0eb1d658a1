"""Bundle adjustment: SciPy's optimum, exact without noise, correct uncertainty, time offsets and missing data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

import sylpose.bundle_adjustment.bundle as bundle_module
import sylpose.bundle_adjustment.reduced_system as bundle_system
from sylpose.bundle_adjustment.bundle import BundleOptions, BundleResult, Observations, bundle_adjust
from sylpose.bundle_adjustment.camera_parameters import SLOPE_SD, default_depth_prior
from sylpose.bundle_adjustment.kernels import (
    LandmarkSystem,
    SortedObservations,
    Views,
    compute_derivatives,
    compute_residuals,
)
from sylpose.bundle_adjustment.problem import DEPTH_SD_RADII, LATERAL_SD_RADII, Problem, _inverse_left_jacobian
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, Rig
from sylpose.simulate import ellipsoid, ring
from sylpose.status import Status

RADIUS = 0.15
RIG = ring(4, 1.5, 1000.0, height=(0.4, -0.1, 0.2, 0.5))
BODY = ellipsoid((RADIUS, 0.1, 0.12), n=3000)
POINTS, NORMALS = BODY.points.copy(), BODY.normals.copy()  # SciPy's rotations do not accept read-only arrays


def path(instants: ArrayLike, *, steady: bool = False) -> RigidTransform:
    """Return poses at times in frames: about 3 degrees each, along a screw or a nonuniform path."""
    k = np.asarray(instants, float)
    if steady:
        return RigidTransform.from_exp_coords(k[:, None] * np.array([0.01, 0.05, 0.02, 0.001, 0.002, -0.001]))
    axis = np.array([0.3, 1.0, 0.2]) / np.linalg.norm([0.3, 1.0, 0.2])
    turn = Rotation.from_rotvec((np.deg2rad(3) * k + 0.2 * np.sin(k / 4))[:, None] * axis)
    place = 0.04 * np.column_stack([np.sin(k / 5), np.cos(k / 4) - 1.0, np.sin(k / 3)])
    start = RigidTransform.from_rotation(Rotation.from_matrix(turn[:1].as_matrix()[0]).inv())
    return RigidTransform.from_components(place, turn) * start


def tracks(
    poses: list[RigidTransform], n: int, noise_px: float, seed: int, longest: int = 12, rig: Rig = RIG
) -> Observations:
    """Return each camera's observations of its n features at its poses; vanishing features are replaced."""
    rng, rows, images, count = np.random.default_rng(seed), [], [], 0
    for c, (camera, own) in enumerate(zip(rig, poses, strict=True)):
        active: list[tuple[int, int, int]] = []
        for k, pose in enumerate(own):
            points = pose.apply(POINTS)
            to_camera = camera.center - points
            facing = np.einsum("ni,ni->n", pose.rotation.apply(NORMALS), to_camera)
            visible = facing > 0.25 * np.linalg.norm(to_camera, axis=1)
            active = [(i, b, left - 1) for i, b, left in active if left > 1 and visible[b]]
            for b in rng.choice(np.flatnonzero(visible), n - len(active), replace=False):
                active.append((count, int(b), int(rng.integers(5 if k else 2, longest))))
                count += 1
            seen = camera.camera_from_world.apply(points[[b for _, b, _ in active]])
            rows += [(k, c, i) for i, _, _ in active]
            images.append(seen[:, :2] / seen[:, 2:] + noise_px / camera.focal * rng.standard_normal((len(active), 2)))
    frame, seen_by, landmark = np.array(rows).T
    return Observations(frame, seen_by, landmark, np.concatenate(images))


def disturb_poses(poses: RigidTransform, turn_deg: float = 0.5, shift: float = 0.003) -> RigidTransform:
    """Return the poses, all but the first disturbed."""
    rng = np.random.default_rng(7)
    w, d = rng.standard_normal((2, len(poses), 3))
    w[0] = d[0] = 0.0
    return RigidTransform.from_components(
        poses.translation + shift * d, Rotation.from_rotvec(np.deg2rad(turn_deg) * w) * poses.rotation
    )


def error(truth: RigidTransform, found: RigidTransform) -> FloatArray:
    """Return the (N, 6) error of (w, d)."""
    return np.hstack([(truth.rotation * found.rotation.inv()).as_rotvec(), truth.translation - found.translation])


def equal_variances(problem: Problem, *_: FloatArray) -> FloatArray:
    return np.ones(len(problem.observations.frame))


def same(a: BundleResult, b: BundleResult, tolerance: float = 1e-9) -> bool:
    return bool(np.abs(error(a.world_from_object, b.world_from_object)).max() < tolerance)


@pytest.fixture(scope="module")
def short() -> tuple[RigidTransform, Observations]:
    poses = path(np.arange(12))
    return poses, tracks([poses] * 4, 30, 0.5, 0)


def test_exact_without_noise() -> None:
    poses = path(np.arange(30))
    seen = tracks([poses] * 4, 30, 0.0, 0)
    found = bundle_adjust(RIG, seen, disturb_poses(poses, 1.0, 0.005), 100.0 * RADIUS)
    assert found.status is Status.OK
    assert np.abs(error(poses, found.world_from_object)).max() < 1e-7
    often = np.bincount(seen.landmark)[seen.landmark] >= 2
    assert np.abs(found.residuals[often]).max() < 1e-4
    assert (found.weights[often] > 0.99).mean() > 0.999
    assert not found.weights[~often].any()


def test_landmarks_have_their_own_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of them is registered with four times the noise of the others: they count for less, as they should."""
    poses = path(np.arange(30))
    squares, nees = np.zeros(2), []
    for seed in range(6):
        seen = tracks([poses] * 4, 30, 0.15, seed, 25)
        rng = np.random.default_rng(100 + seed)
        noisy = rng.random(seen.landmark.max() + 1) < 1.0 / 3.0
        focal = np.array([camera.focal for camera in RIG])[seen.camera, None]
        added = np.sqrt(15.0) * 0.15 * noisy[seen.landmark, None] / focal * rng.standard_normal(seen.image.shape)
        seen = replace(seen, image=seen.image + added)
        found = [bundle_adjust(RIG, seen, disturb_poses(poses), RADIUS)]
        with monkeypatch.context() as patch:
            patch.setattr(Problem, "estimate_variance_ratio", equal_variances)
            found.append(bundle_adjust(RIG, seen, disturb_poses(poses), RADIUS))
        errors = [error(poses, its.world_from_object)[1:] for its in found]
        squares += [float((its[:, :3] ** 2).sum()) for its in errors]
        nees += [e @ np.linalg.solve(c, e) / 6.0 for e, c in zip(errors[0], found[0].covariance[1:], strict=True)]
    assert squares[0] < 0.85 * squares[1]
    assert 0.4 < np.mean(nees) < 1.5


def test_a_landmark_that_slides_is_not_its_own_inlier() -> None:
    """Its variance is large, but whether it is an outlier is decided with the noise of its camera."""
    poses = path(np.arange(30))
    seen = tracks([poses] * 4, 30, 0.15, 1, 25)
    slides = seen.landmark == np.bincount(seen.landmark).argmax()
    image = seen.image.copy()
    image[slides, 0] += 0.002 * (seen.frame[slides] - seen.frame[slides].mean())
    found = bundle_adjust(RIG, replace(seen, image=image), disturb_poses(poses), RADIUS)
    assert np.mean(found.weights[slides] > 0) < 0.5
    assert np.mean(found.weights[~slides] > 0) > 0.95


@given(st.integers(0, 10**6))
@settings(max_examples=20)
def test_derivatives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = RIG.cameras[seed % 4]
    turn, place, point = (
        Rotation.random(rng=rng).as_matrix(),
        0.1 * rng.standard_normal(3),
        0.1 * rng.standard_normal(3),
    )
    spin, drift = rng.standard_normal((2, 3))
    seen = SortedObservations(
        np.array([0, 1]),
        np.zeros(1, np.int64),
        np.zeros(1, np.int64),
        0.1 * rng.standard_normal((1, 2)),
        0.3 * rng.standard_normal((1, 3, 4)),
        np.zeros(1, np.int64),
        np.zeros(1, np.int64),
        np.zeros((1, 3)),
        np.zeros((1, 3)),
    )
    before = 0.05 * rng.standard_normal(14)  # offset, surface (3), turn (3), shift (3), lens (4)

    def views(x: FloatArray) -> Views:
        shared = before + x[6:20]
        q = Rotation.from_rotvec(shared[4:7]).as_matrix() @ camera.rotation
        late = shared[0] - before[0]
        carried = Rotation.from_rotvec(late * spin).as_matrix()
        b = q @ (place + x[3:6] + late * drift - camera.center - shared[7:10])
        r = Rotation.from_rotvec(x[:3]).as_matrix() @ turn
        m, b, qs, qd = (v[None, None] for v in (q @ carried, b, q @ spin, q @ drift))
        twist = np.asarray(np.linalg.inv(_inverse_left_jacobian(shared[None, 4:7])), float)
        return Views(r[None], m, b, qs, qd, q[None], twist, np.array([camera.focal]), shared[None])

    def residual(x: FloatArray) -> FloatArray:
        out = np.empty((1, 2))
        compute_residuals(seen, views(x), (point + x[20:])[None], out)
        return np.asarray(out[0])

    terms = np.empty((1, 2)), np.empty((1, 2, 6)), np.zeros((1, 2, 14)), np.empty((1, 2, 3))
    compute_derivatives(seen, views(np.zeros(23)), point, 0, 0, LandmarkSystem(*terms, np.empty((3, 3)), np.empty(3)))
    e, by_pose, by_shared, by_point = (part[0] for part in terms)
    h = 1e-6
    numeric = np.column_stack([(residual(h * u) - residual(-h * u)) / (2 * h) for u in np.eye(23)])
    np.testing.assert_allclose(e, residual(np.zeros(23)), rtol=1e-12)
    np.testing.assert_allclose(np.hstack([by_pose, by_shared, by_point]), numeric, rtol=1e-6, atol=2e-4)


@given(st.integers(0, 10**6))
@settings(max_examples=20)
def test_derivative_of_log(seed: int) -> None:
    rng = np.random.default_rng(seed)
    w = rng.standard_normal(3) * rng.choice([1e-7, 1e-2, 1.0])
    h = 1e-6
    numeric = np.column_stack(
        [
            ((Rotation.from_rotvec(h * u) * Rotation.from_rotvec(w)).as_rotvec()
             - (Rotation.from_rotvec(-h * u) * Rotation.from_rotvec(w)).as_rotvec()) / (2 * h)
            for u in np.eye(3)
        ]
    )  # fmt: skip
    np.testing.assert_allclose(_inverse_left_jacobian(w[None])[0], numeric, atol=1e-7)


def test_optimum_matches_scipy(monkeypatch: pytest.MonkeyPatch) -> None:
    # Converged to the last digit, with constant noise: the reported weights are then those of the last iteration.
    monkeypatch.setattr(bundle_module, "STEP_TOLERANCE", 1e-14)
    monkeypatch.setattr(Problem, "estimate_weighted_noise", lambda *_: np.array([0.4, 0.5, 0.6, 0.5]))
    monkeypatch.setattr(Problem, "estimate_variance_ratio", equal_variances)
    poses = path(np.arange(4))
    seen = tracks([poses] * 4, 10, 0.5, 3)
    start = disturb_poses(poses)
    given = bundle_adjust(RIG, seen, start, RADIUS).landmarks
    found = bundle_adjust(RIG, seen, start, RADIUS, BundleOptions(landmarks=given))
    names, landmark = np.unique(seen.landmark, return_inverse=True)
    sigma = found.sigma_px[seen.camera]
    # The same weights: least squares at the end of the re-weighting.
    weight = np.sqrt(found.weights) / sigma * np.array([c.focal for c in RIG])[seen.camera]
    q, o = np.array([c.rotation for c in RIG])[seen.camera], np.array([c.center for c in RIG])[seen.camera]

    # First viewer of each landmark: frames and cameras do not decrease within one.
    by_landmark = np.lexsort((seen.camera, seen.frame, landmark))
    first = by_landmark[np.searchsorted(landmark[by_landmark], np.arange(len(names)))]
    viewer, at = seen.camera[first], seen.frame[first]
    turns, centers = start.rotation.as_matrix()[at], np.array([c.center for c in RIG])[viewer]
    toward = np.einsum("mji,mj->mi", turns, centers - start.translation[at])
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    axes = np.einsum("mji,mkj->mki", turns, np.array([c.rotation for c in RIG])[viewer][:, :2])
    axes -= np.einsum("mki,mi->mk", axes, toward)[..., None] * toward[:, None]
    aside = np.clip(np.einsum("mki,mi->mk", axes, given[names]), -RADIUS, RADIUS)
    used = np.bincount(landmark, found.weights) > 0  # others do not constrain the surface
    mean, covariance = default_depth_prior(RADIUS, 4)
    root = np.linalg.inv(np.linalg.cholesky(covariance))

    def terms(x: FloatArray) -> FloatArray:
        steps, points = np.zeros((4, 6)), x[30:].reshape(-1, 3)
        depth, slopes = x[18:22], x[22:30].reshape(4, 2)
        steps[1:] = x[:18].reshape(3, 6)
        turn = Rotation.from_rotvec(steps[:, :3]) * start.rotation
        world = turn[seen.frame].apply(points[landmark]) + (start.translation + steps[:, 3:])[seen.frame]
        p = np.einsum("nij,nj->ni", q, world - o)
        e = weight[:, None] * (p[:, :2] / p[:, 2:] - seen.image)
        surface = depth[viewer] + np.einsum("mk,mk->m", slopes[viewer], aside)
        above = used * (np.einsum("mi,mi->m", toward, points) - surface) / (DEPTH_SD_RADII * RADIUS)
        prior_sd = [root @ (depth - mean), slopes.ravel() / SLOPE_SD, points.ravel() / (LATERAL_SD_RADII * RADIUS)]
        return np.concatenate([e.ravel(), above, *prior_sd])

    x0 = np.concatenate([np.zeros(18), mean, np.zeros(8), found.landmarks[names].ravel()])
    x = least_squares(terms, x0, x_scale="jac", xtol=1e-14, ftol=1e-14).x[:18].reshape(3, 6)
    turn = Rotation.from_rotvec(x[:, :3]) * start.rotation[1:]
    expected = RigidTransform.from_components(start.translation[1:] + x[:, 3:], turn)
    sd = np.sqrt(np.diagonal(found.covariance[1:], axis1=1, axis2=2))
    assert np.abs(error(expected, found.world_from_object[1:]) / sd).max() < 1e-4  # SciPy differentiates numerically


def test_other_axes(short: tuple[RigidTransform, Observations]) -> None:
    poses, seen = short
    start, found = disturb_poses(poses), bundle_adjust(RIG, seen, disturb_poses(poses), RADIUS)
    world = RigidTransform.from_components([3.0, -1.0, 2.0], Rotation.from_rotvec([0.4, -1.0, 0.7]))
    rig = Rig([
        Camera(c.name, c.size, c.matrix, c.distortion, c.camera_from_world * world.inv()) for c in RIG
    ])  # fmt: skip
    moved = bundle_adjust(rig, seen, world * start, RADIUS)
    assert np.abs(error(world * found.world_from_object, moved.world_from_object)).max() < 1e-9
    both = np.kron(np.eye(2), world.rotation.as_matrix())
    np.testing.assert_allclose(moved.covariance, both @ found.covariance @ both.T, atol=1e-6 * found.covariance.max())
    object_turn = RigidTransform.from_rotation(Rotation.from_rotvec([1.0, 0.2, -0.5]))
    turned = bundle_adjust(RIG, seen, start * object_turn, RADIUS)
    assert np.abs(error(found.world_from_object * object_turn, turned.world_from_object)).max() < 1e-9


def test_order_does_not_matter(short: tuple[RigidTransform, Observations]) -> None:
    poses, seen = short
    found = bundle_adjust(RIG, seen, disturb_poses(poses), RADIUS)
    order = np.random.default_rng(0).permutation(len(seen))
    mixed = Observations(seen.frame[order], seen.camera[order], seen.landmark[order], seen.image[order])
    again = bundle_adjust(RIG, mixed, disturb_poses(poses), RADIUS)
    assert same(found, again, 1e-14)
    np.testing.assert_array_equal(found.weights[order], again.weights)


def test_sparse_is_dense(short: tuple[RigidTransform, Observations], monkeypatch: pytest.MonkeyPatch) -> None:
    poses, seen = short
    dense = bundle_adjust(RIG, seen, disturb_poses(poses), RADIUS)
    monkeypatch.setattr(bundle_system, "DENSE_FRAMES", 0)
    monkeypatch.setattr(bundle_system, "DENSE_FILL_RATIO", 2.0)
    sparse = bundle_adjust(RIG, seen, disturb_poses(poses), RADIUS)
    assert same(dense, sparse)
    np.testing.assert_allclose(sparse.covariance, dense.covariance, atol=1e-9 * dense.covariance.max())


def test_outliers() -> None:
    poses, rng = path(np.arange(30)), np.random.default_rng(0)
    seen = tracks([poses] * 4, 40, 0.5, 1)
    wrong = rng.random(len(seen)) < 0.1
    image = seen.image + np.where(wrong[:, None], 0.04 * rng.standard_normal((len(seen), 2)), 0.0)
    clean, found = (bundle_adjust(RIG, s, disturb_poses(poses), RADIUS) for s in (seen, replace(seen, image=image)))
    assert found.status is Status.OK
    assert (found.weights[wrong] > 0).mean() < 0.02
    assert (found.weights[~wrong] == 0).mean() < 0.12
    np.testing.assert_allclose(found.sigma_px, 0.5, rtol=0.08)
    # With the same noise, so closer than two independent results; but not the same.
    e = error(clean.world_from_object, found.world_from_object)[-1]
    assert 0.05 < e @ np.linalg.solve(found.covariance[-1], e) < 6.0


def test_covariance() -> None:
    poses, normalised = path(np.arange(15)), []
    for seed in range(10):
        found = bundle_adjust(RIG, tracks([poses] * 4, 15, 0.5, seed, longest=8), disturb_poses(poses), RADIUS)
        e = error(poses, found.world_from_object)[-1]
        normalised.append(e @ np.linalg.solve(found.covariance[-1], e))
    assert 3.8 < np.mean(normalised) < 8.2  # 6 and two standard deviations of the mean of 10
    assert not found.covariance[0].any()


def test_covariance_of_little_noise() -> None:
    """Below the noise floor of outlier rejection the covariance is as small as the noise."""
    poses, normalised = path(np.arange(15)), []
    for seed in range(12):
        found = bundle_adjust(RIG, tracks([poses] * 4, 30, 0.04, seed), disturb_poses(poses), RADIUS)
        e = error(poses, found.world_from_object)[-1]
        normalised.append(e @ np.linalg.solve(found.covariance[-1], e))
        np.testing.assert_allclose(found.sigma_px, 0.04, rtol=0.15)
    assert 2.5 < np.mean(normalised) < 9.0


def test_covariance_of_correlated_errors() -> None:
    """Noise that hardly changes between observations of a landmark: a correlation of 4 in 5 parts."""
    poses, narrow, wide = path(0.4 * np.arange(15)), [], []
    for seed in range(12):
        seen, rng = tracks([poses] * 4, 40, 0.0, seed, longest=15), np.random.default_rng(seed)
        order, noise = np.lexsort((seen.frame, seen.landmark)), rng.standard_normal((len(seen), 2))
        same = np.diff(seen.landmark[order], prepend=-1) == 0
        for i in np.flatnonzero(same):
            noise[order[i]] = 0.8 * noise[order[i - 1]] + 0.6 * noise[order[i]]
        found = bundle_adjust(RIG, replace(seen, image=seen.image + 0.3 / 1000.0 * noise), disturb_poses(poses), RADIUS)
        e = error(poses, found.world_from_object)[-1]
        wide.append(e @ np.linalg.solve(found.covariance[-1], e))
        narrow.append(found.variance_inflation[-1] * wide[-1])
    assert np.mean(narrow) > 12.0
    assert 3.0 < np.mean(wide) < 10.0


def test_covariance_with_a_moved_camera() -> None:
    poses = path(np.arange(15))
    seen = tracks([poses] * 4, 40, 0.3, 0)
    straight = bundle_adjust(RIG, seen, disturb_poses(poses), RADIUS)
    first = RIG.cameras[0]
    turned = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, 0.05])) * first.camera_from_world
    rig = Rig([Camera(first.name, first.size, first.matrix, first.distortion, turned), *RIG.cameras[1:]])
    crooked = bundle_adjust(rig, seen, disturb_poses(poses), RADIUS)
    assert straight.variance_inflation.max() < 3.0
    assert crooked.variance_inflation[-1] > 5.0
    assert crooked.variance_inflation[0] == 1.0
    e = error(poses, crooked.world_from_object)[1:]
    normalised = np.einsum("ni,nij,nj->n", e, np.linalg.inv(crooked.covariance[1:]), e)
    assert (crooked.variance_inflation[1:] * normalised).mean() > 15.0 > 12.0 > normalised.mean()


def test_time_offsets() -> None:
    late, rate = np.array([0.004, -0.003, 0.001, -0.002]), 30.0
    times = np.arange(40) / rate
    own = [path((times + s) * rate) for s in late]
    truth, seen = path(times * rate), tracks(own, 40, 0.5, 0)
    found = bundle_adjust(RIG, seen, disturb_poses(truth), RADIUS, BundleOptions(times=times, offsets_sd=0.02))
    assert found.status is Status.OK
    assert abs(found.offsets.sum()) < 1e-12
    assert np.abs(found.offsets - late).max() < 4e-4
    assert found.offsets_sd.max() < 4e-4
    # The same from time stamps.
    stamped = bundle_adjust(RIG, seen, disturb_poses(truth), RADIUS, BundleOptions(times=times[:, None] + late))
    assert np.abs(error(found.world_from_object, stamped.world_from_object)).max() < 0.01
    np.testing.assert_allclose(stamped.sigma_px, 0.5, rtol=0.08)


def test_uniform_motion_does_not_constrain_time_offsets() -> None:
    late, rate = np.array([0.004, -0.003, 0.001, -0.002]), 30.0
    times = np.arange(30) / rate
    own = [path((times + s) * rate, steady=True) for s in late]
    truth = path(times * rate, steady=True)
    found = bundle_adjust(
        RIG, tracks(own, 30, 0.5, 0), disturb_poses(truth), RADIUS, BundleOptions(times=times, offsets_sd=0.02)
    )
    assert found.offsets_sd.min() > 0.01


def test_prior_holds_poses(short: tuple[RigidTransform, Observations]) -> None:
    poses, seen = short
    start = disturb_poses(poses)
    information = np.zeros((len(poses), 6, 6))
    information[-1] = 1e14 * np.eye(6)
    found = bundle_adjust(RIG, seen, start, RADIUS, BundleOptions(prior_information=information))
    assert np.abs(error(start, found.world_from_object)[-1]).max() < 1e-4  # SciPy differentiates numerically
    assert found.covariance[-1].max() < 2e-14


def test_disconnected_frames() -> None:
    poses = path(np.arange(10))
    seen = tracks([poses] * 4, 20, 0.5, 0)
    part = np.where(seen.frame < 5, 0, 1)
    apart = replace(seen, landmark=2 * seen.landmark + part)
    found = bundle_adjust(RIG, apart, disturb_poses(poses), RADIUS)
    assert found.status is Status.OK
    np.testing.assert_array_equal(found.connected, np.arange(10) < 5)
    assert np.isfinite(found.covariance).all()
    assert found.covariance[5:, 0, 0].min() > 0.1 > 1e3 * found.covariance[1:5, 0, 0].max()
    none = bundle_adjust(RIG, Observations(*(np.empty(0, int),) * 3, np.empty((0, 2))), poses, RADIUS)
    assert none.status is Status.TOO_FEW_MATCHES
    assert np.isnan(none.sigma_px).all()
    assert np.abs(error(poses, none.world_from_object)).max() < 1e-12


def test_start_behind_a_camera_recovers(short: tuple[RigidTransform, Observations]) -> None:
    poses, seen = short
    good = bundle_adjust(RIG, seen, poses, RADIUS)
    points = good.landmarks.copy()
    stray = seen.landmark[0]
    points[stray] = 10.0 * RIG.cameras[seen.camera[0]].center
    found = bundle_adjust(RIG, seen, poses, RADIUS, BundleOptions(landmarks=points))
    assert found.weights[seen.landmark == stray].all()
    assert np.abs(found.landmarks[stray] - good.landmarks[stray]).max() < 1e-3


def test_behind_a_camera(short: tuple[RigidTransform, Observations]) -> None:
    poses, seen = short
    first = RIG.cameras[0]
    about = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, np.pi, 0.0])) * first.camera_from_world
    away = Camera(first.name, first.size, first.matrix, first.distortion, about)
    found = bundle_adjust(Rig([away, *RIG.cameras[1:]]), seen, poses, RADIUS)
    assert found.status is Status.OK
    assert not found.weights[seen.camera == 0].any()
    assert np.isfinite(found.landmarks).all()
    e = error(poses, found.world_from_object)[-1]
    assert 0.87 < e @ np.linalg.solve(found.covariance[-1], e) < 17.0  # one in a hundred on each side


def test_bad_input(short: tuple[RigidTransform, Observations]) -> None:
    poses, seen = short
    for change, words in (
        ({"frame": seen.frame + 5}, "frame must be from 0 to 11"),
        ({"camera": seen.camera - 1}, "camera must be from 0 to 3"),
        ({"landmark": seen.landmark[1:]}, "landmark must be"),
        ({"image": np.full_like(seen.image, np.nan)}, "observations: image has values"),
    ):
        with pytest.raises(ValueError, match=words):
            bundle_adjust(RIG, replace(seen, **change), poses, RADIUS)
    for options, words in (
        ({"fixed": np.zeros(12, bool)}, "at least one frame"),
        ({"fixed": np.ones(3, bool)}, "fixed: shape"),
        ({"times": np.zeros(12)}, "must increase"),
        ({"prior_information": np.zeros((12, 6))}, "prior_information must be"),
        ({"landmarks": np.zeros((3, 2))}, "landmarks must be"),
        ({"offsets_sd": 0.0}, "offsets_sd"),
    ):
        with pytest.raises(ValueError, match=words):
            bundle_adjust(RIG, seen, poses, RADIUS, BundleOptions(**options))
    with pytest.raises(ValueError, match="radius"):
        bundle_adjust(RIG, seen, poses, -1.0)


def test_length_of_a_slide_follows_the_prior() -> None:
    """No number of landmarks and frames determines the length; a rotation does."""
    normalised, off_by, text = [], [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        way = rng.standard_normal(3)
        poses = RigidTransform.from_translation(np.linspace(0.0, 0.2, 8)[:, None] * way / np.linalg.norm(way))
        for factor in (0.7, 1.5):
            found = bundle_adjust(
                RIG, tracks([poses] * 4, 40, 0.4, seed), disturb_poses(poses, 0.2, 0.002), factor * RADIUS
            )
            e, d = error(poses, found.world_from_object)[-1], poses.translation[-1]
            normalised.append(e @ np.linalg.solve(found.covariance[-1], e))
            off_by.append(found.world_from_object.translation[-1] @ d / (d @ d) - 1.0)
            text.append(found.scale_sd)
            assert found.scale_variance_ratio > 0.9
            assert found.rests_on_prior.tolist() == [False, *[True] * 7]
    assert 1.5 < np.mean(normalised) < 9.0
    assert max(normalised) < 30.0
    assert 0.01 < np.sqrt(np.mean(np.square(off_by))) < 0.06
    assert 0.02 < min(text) < max(text) < 0.12
    turning = bundle_adjust(
        RIG, tracks([path(np.arange(12))] * 4, 30, 0.5, 0), disturb_poses(path(np.arange(12))), RADIUS
    )
    assert turning.scale_sd < 0.02
    assert turning.scale_variance_ratio < 0.6
    assert not turning.rests_on_prior.any()


def test_known_surface_depths() -> None:
    """The length of a slide follows from the depth prior."""
    poses = RigidTransform.from_translation(np.linspace(0.0, 1.0, 8)[:, None] * np.array([0.1, 0.1, 0.0]))
    seen, lengths = tracks([poses] * 4, 40, 0.4, 3), []
    for depth in (0.05, 0.08):
        found = bundle_adjust(
            RIG,
            seen,
            disturb_poses(poses, 0.2, 0.002),
            RADIUS,
            BundleOptions(depth_prior=(np.full(4, depth), 1e-6 * np.eye(4))),
        )
        lengths.append(float(np.linalg.norm(found.world_from_object.translation[-1])))
        assert found.scale_sd < 0.005
    # The nearer the surface, the shorter the path: proportional to its distance.
    assert 0.9 < (lengths[0] / lengths[1] - 1.0) / (0.03 / 1.5) < 1.2
    with pytest.raises(ValueError, match="positive definite"):
        bundle_adjust(RIG, seen, poses, RADIUS, BundleOptions(depth_prior=(np.zeros(4), -np.eye(4))))
    with pytest.raises(ValueError, match="depth_prior: mean must be"):
        bundle_adjust(RIG, seen, poses, RADIUS, BundleOptions(depth_prior=(np.zeros(3), np.eye(4))))
