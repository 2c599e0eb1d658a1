"""Bundle adjustment by key frames: their selection, and results equal to those of all frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.calibration import normalize_by
from sylpose.bundle_adjustment import keyframes
from sylpose.bundle_adjustment.bundle import BundleOptions, BundleResult, Observations
from sylpose.bundle_adjustment.calibration_refinement import correct_rig, default_calibration_prior
from sylpose.bundle_adjustment.keyframes import bundle_adjust_by_keyframes, select_keyframes
from sylpose.bundle_adjustment.scale_prior import bundle_adjust_with_scale, find_lost_frames
from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.simulate import ellipsoid, ring
from sylpose.status import Status

RIG, RADIUS, FRAMES = ring(3, 1.5, 1000.0, height=(0.4, -0.1, 0.3)), 0.15, 120
BODY = ellipsoid((RADIUS, 0.1, 0.12), n=240)
OPTIONS = BundleOptions(times=np.arange(FRAMES) / 30.0)


def true_poses(n: int = FRAMES) -> RigidTransform:
    """Return a rotation of about a degree per frame, along a curve, from the identity."""
    k = np.arange(n)
    axis = np.array([0.1, 0.99, 0.1])
    rotation = Rotation.from_rotvec(np.deg2rad(k + 3.0 * np.sin(k / 9))[:, None] * axis)
    path = np.column_stack([0.05 * np.sin(k / 16), 0.03 * np.cos(k / 12) - 0.03, 0.0005 * k])
    return RigidTransform.from_components(path, rotation)


def observe(poses: RigidTransform, noise_px: float, bias_px: float = 0.0, seed: int = 0) -> Observations:
    """Return what the cameras see, with independent noise and an error that is constant along each landmark's track."""
    rng, parts = np.random.default_rng(seed), list[tuple[Any, ...]]()
    points, normals = BODY.points.copy(), BODY.normals.copy()
    for c, camera in enumerate(RIG):
        bias = bias_px * rng.standard_normal((len(points), 2))
        for k, pose in enumerate(poses):
            seen = pose.apply(points)
            sight = camera.center - seen
            facing = np.einsum("ni,ni->n", pose.rotation.apply(normals), sight)
            visible = np.flatnonzero(facing > 0.25 * np.linalg.norm(sight, axis=1))
            local = camera.camera_from_world.apply(seen[visible])
            error = bias[visible] + noise_px * rng.standard_normal((len(visible), 2))
            image = local[:, :2] / local[:, 2:] + error / camera.focal
            number, landmark = np.full(len(visible), k), visible + c * len(points)
            parts.append((number, np.full(len(visible), c), landmark, image))
    frame, camera_index, landmark, image = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Observations(frame.astype(int), camera_index.astype(int), landmark.astype(int), image)


def shake(poses: RigidTransform, seed: int = 0) -> RigidTransform:
    """Return poses with errors of 0.3 degrees and 2 mm, but the first."""
    rng = np.random.default_rng(seed)
    errors = np.hstack(
        [np.deg2rad(0.3) * rng.standard_normal((len(poses), 3)), 0.002 * rng.standard_normal((len(poses), 3))]
    )
    errors[0] = 0.0
    rotation = Rotation.from_rotvec(errors[:, :3]) * poses.rotation
    return RigidTransform.from_components(poses.translation + errors[:, 3:], rotation)


def errors_of(result: BundleResult, poses: RigidTransform) -> FloatArray:
    """Return the (N, 6) errors of (w, d)."""
    rotation = (poses.rotation * result.world_from_object.rotation.inv()).as_rotvec()
    return np.hstack([rotation, poses.translation - result.world_from_object.translation])


def refine(observations: Observations, poses: RigidTransform) -> BundleResult:
    return bundle_adjust_by_keyframes(RIG, observations, shake(poses), RADIUS, OPTIONS)


@pytest.fixture
def _by_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use key frames whatever the correlation of the errors."""
    monkeypatch.setattr(keyframes, "MIN_CORRELATION", -2.0)


def first_fixed(n: int) -> BoolArray:
    return np.asarray(np.arange(n) == 0)


def test_steps_between_key_frames_are_limited() -> None:
    poses = true_poses()
    observations, fixed = observe(poses, 0.0), first_fixed(FRAMES)
    fixed[77] = True
    is_key = select_keyframes(observations, poses, fixed)
    keys = np.flatnonzero(is_key)
    assert is_key[[0, 77, FRAMES - 1]].all()
    assert len(keys) < 0.5 * FRAMES
    assert np.diff(keys).max() <= keyframes.MAX_STEP
    rotation = (poses.rotation[keys[1:]] * poses.rotation[keys[:-1]].inv()).magnitude()
    assert rotation.max() < keyframes.MIN_ROTATION + np.deg2rad(1.5)


def test_new_landmarks_and_frames_without_any_make_key_frames() -> None:
    poses = true_poses()
    observations, fixed = observe(poses, 0.0), first_fixed(FRAMES)
    landmark = observations.landmark + np.where(observations.frame >= 50, 10_000, 0)
    kept = observations.frame != 90
    changed = Observations(*(x[kept] for x in (observations.frame, observations.camera, landmark, observations.image)))
    assert select_keyframes(changed, poses, fixed)[[50, 90]].all()


def test_all_frames_of_a_short_trajectory_are_key_frames() -> None:
    n = keyframes.MIN_FRAMES - 1
    assert select_keyframes(observe(true_poses(n), 0.0), true_poses(n), first_fixed(n)).all()


@pytest.mark.usefixtures("_by_keyframes")
def test_exact_without_noise() -> None:
    poses = true_poses()
    result = refine(observe(poses, 0.0), poses)
    assert result.status is Status.OK
    assert result.connected.all()
    # The weak priors and the last step's size remain, as with all frames.
    assert np.abs(errors_of(result, poses)).max() < 2e-5
    assert np.abs(result.residuals[result.weights > 0]).max() < 0.01
    assert (result.weights > 0).mean() > 0.99


@pytest.mark.parametrize("seed", range(3))
def test_errors_along_tracks_are_refined_as_well_as_by_all_frames(seed: int) -> None:
    poses = true_poses()
    observations = observe(poses, 0.05, 0.3, seed)
    by_keys = refine(observations, poses)
    by_all = bundle_adjust_with_scale(RIG, observations, shake(poses), RADIUS, OPTIONS)
    assert by_keys.status is by_all.status is Status.OK
    assert np.abs(by_keys.world_from_object.translation - by_all.world_from_object.translation).max() > 1e-6
    squares = [(errors_of(result, poses) ** 2).reshape(-1, 2, 3).sum(axis=(0, 2)) for result in (by_keys, by_all)]
    assert (squares[0] < 1.3**2 * squares[1]).all()  # of rotations, of translations
    covariance, errors = by_keys.covariance[1:], errors_of(by_keys, poses)[1:]
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariance), errors)
    assert 0.3 < np.median(nees) < 12.6  # of six, chi-squared: 95 % are below 12.6


def test_independent_errors_are_refined_by_all_frames() -> None:
    poses = true_poses()
    observations = observe(poses, 0.3)
    by_keys = refine(observations, poses)
    by_all = bundle_adjust_with_scale(RIG, observations, shake(poses), RADIUS, OPTIONS)
    np.testing.assert_allclose(errors_of(by_keys, poses), errors_of(by_all, poses), atol=2e-5)
    np.testing.assert_allclose(by_keys.covariance, by_all.covariance, rtol=0.02, atol=1e-12)


@pytest.mark.usefixtures("_by_keyframes")
def test_a_wrong_frame_between_key_frames_is_found() -> None:
    """Its observations are of another motion: they are outliers, and no neighbor changes."""
    poses = true_poses()
    clean = observe(poses, 0.05, 0.3)
    is_key = select_keyframes(clean, shake(poses), first_fixed(FRAMES))
    wrong = int(np.flatnonzero(~is_key)[20])
    rng, image = np.random.default_rng(1), clean.image.copy()
    at = clean.frame == wrong
    image[at] += 0.03 * rng.standard_normal((int(at.sum()), 2))
    spoiled = Observations(clean.frame, clean.camera, clean.landmark, image)
    result, expected = refine(spoiled, poses), refine(clean, poses)
    assert np.flatnonzero(find_lost_frames(result, spoiled)).tolist() == [wrong]
    others = np.arange(FRAMES) != wrong
    np.testing.assert_allclose(errors_of(result, poses)[others], errors_of(expected, poses)[others], atol=2e-4)


def test_unconnected_frames_are_reported() -> None:
    """Landmarks that are seen in one frame only connect nothing."""
    poses = true_poses()
    observations = observe(poses, 0.05, 0.3)
    at = observations.frame == 33
    landmark = observations.landmark + np.where(at, 10_000, 0)
    own = Observations(observations.frame, observations.camera, landmark, observations.image)
    assert np.flatnonzero(~refine(own, poses).connected).tolist() == [33]


def test_effect_of_calibration_errors_is_that_of_all_frames() -> None:
    values = np.zeros((3, 14))
    values[:, 4:7] = np.deg2rad([[0.2, -0.1, 0.1], [-0.1, 0.2, 0.0], [0.0, -0.2, 0.2]])
    poses, reported = true_poses(), correct_rig(RIG, values)
    seen, options = observe(poses, 0.05, 0.2), replace(OPTIONS, calibration_prior=default_calibration_prior(reported))
    seen = normalize_by(seen, RIG, reported)
    found, of_all = (
        adjust(reported, seen, shake(poses), RADIUS, options)
        for adjust in (bundle_adjust_by_keyframes, bundle_adjust_with_scale)
    )
    assert np.degrees(np.linalg.norm(of_all.calibration_change[:, :3], axis=1).max()) > 0.2
    np.testing.assert_allclose(found.calibration_change[:, :3], of_all.calibration_change[:, :3], atol=np.deg2rad(0.05))
    apart = found.corrected_poses.rotation * of_all.corrected_poses.rotation.inv()
    assert np.degrees(apart.magnitude().max()) < 0.05
    key = 71
    # A key frame with landmarks of its own is not connected, and not corrected: its neighbors are.
    alone = seen.frame == key
    landmark = np.where(alone, seen.landmark + seen.landmark.max() + 1, seen.landmark)
    found = bundle_adjust_by_keyframes(reported, replace(seen, landmark=landmark), shake(poses), RADIUS, options)
    near = [k for k in range(key - 3, key + 4) if found.connected[k]]
    assert len(near) > 3
    assert not found.connected[key]
    np.testing.assert_allclose(
        found.calibration_change[near, :3], of_all.calibration_change[near, :3], atol=np.deg2rad(0.05)
    )
