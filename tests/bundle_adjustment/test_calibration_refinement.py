"""Calibration refinement: exact without noise, more accurate with it, and correct uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.calibration import (
    align_rigs,
    compute_pose_errors,
    normalize_by,
    perturb_rig,
    score_calibration,
    simulate_poses,
    track_rendered,
)
from benchmarks.translation_only import simulate_tracks
from sylpose.bundle_adjustment.bundle import BundleOptions, BundleResult, Observations, bundle_adjust
from sylpose.bundle_adjustment.calibration_refinement import (
    MovedCamera,
    add_calibration_parameters,
    add_moved_cameras,
    correct_rig,
    default_calibration_prior,
    linearize_lenses,
)
from sylpose.bundle_adjustment.camera_parameters import default_depth_prior, make_camera_parameters
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import box, ring
from sylpose.smoothing import smooth_tracks
from sylpose.status import Status
from sylpose.tracking.window import bundle_frames

LENS = (-0.2, 0.05, 0.0004, -0.0003, 0)
RIG = ring(4, 1.5, 1000.0, height=(0.4, -0.1, 0.2, 0.5), distortion=LENS)
BODY = box((0.3, 0.24, 0.26))
TRUE = simulate_poses(14, 100.0)


def refine(reported: Rig, seen: Observations, *, recalibrate: bool = True) -> BundleResult:
    return bundle_adjust(
        reported,
        seen,
        TRUE,
        BODY.radius,
        BundleOptions(calibration_prior=default_calibration_prior(reported), recalibrate=recalibrate),
    )


def compute_remaining_errors(rig: Rig) -> FloatArray:
    """Return (2,) rms calibration errors of the cameras, degrees and millimeters."""
    return np.asarray(np.sqrt((align_rigs(rig, RIG)[3] ** 2).mean(axis=0)))


@pytest.mark.parametrize("lens", [np.zeros(4), np.array([0.02, 8.0, -5.0, 0.03])])
def test_lens_slopes(lens: FloatArray) -> None:
    rng = np.random.default_rng(0)
    image, cameras = rng.uniform(-0.4, 0.4, (40, 2)), np.repeat(np.arange(4), 10)
    moved, slopes = linearize_lenses(RIG, cameras, image, [lens] * 4)
    values = np.zeros((4, 14))
    for change in (np.zeros(4), np.array([1e-4, 0.1, 0.1, 1e-4])):
        values[:, 10:] = lens + change
        now = correct_rig(RIG, values)
        pixels = [c.denormalize(image[cameras == k]) for k, c in enumerate(RIG)]
        expected = np.concatenate([c.normalize(p) for c, p in zip(now, pixels, strict=True)])
        np.testing.assert_allclose(moved + slopes[:, :2] @ (lens + change), expected, atol=2e-7)
    np.testing.assert_allclose(
        slopes[:, 2, 0], 1.0 / (1.0 + lens[0]), atol=1e-4
    )  # a pixel's size is proportional to the focal length


def test_lens_that_folds_has_slopes() -> None:
    """A step too far in the distortion turns the image inside out near its border: no slope becomes NaN."""
    image = np.column_stack([np.linspace(0.42, 0.47, 40_000), np.zeros(40_000)])
    lens = np.array([0.0, 0.0, 0.0, -1.5])
    areas = np.diff(
        correct_rig(RIG, np.tile(np.concatenate([np.zeros(10), lens]), (4, 1))).cameras[0].denormalize(image)[:, 0]
    )
    assert (areas > 0).any()
    assert (areas < 0).any()
    moved, slopes = linearize_lenses(RIG, np.zeros(len(image), np.int64), image, [lens] * 4)
    assert np.isfinite(slopes).all()
    assert np.isfinite(moved).all()


def test_common_rotation_is_not_an_error() -> None:
    prior = default_calibration_prior(RIG)
    shared = add_calibration_parameters(
        make_camera_parameters(4, None, np.arange(4), *default_depth_prior(0.2, 4)), RIG, prior
    )
    covariance = shared.flat_basis @ shared.flat_basis.T
    for turn, shift in ((np.array([1e-4, 2e-4, -1e-4]), np.zeros(3)), (np.zeros(3), np.array([1e-3, 0.0, 2e-3]))):
        world = RigidTransform.from_components(shift, Rotation.from_rotvec(turn))
        common = np.zeros((4, 14))
        for c, camera in enumerate(RIG):
            moved = camera.camera_from_world * world.inv()
            common[c, 4:7] = (moved.rotation * camera.camera_from_world.rotation.inv()).as_rotvec() / prior.rotation_sd[
                c
            ] ** 2
            common[c, 7:10] = (moved.inv().translation - camera.center) / prior.translation_sd[c] ** 2
        size = np.sum(
            common
            * common
            * np.concatenate(
                [
                    np.zeros(4),
                    prior.rotation_sd[:1].repeat(3) ** 2,
                    prior.translation_sd[:1].repeat(3) ** 2,
                    np.zeros(4),
                ]
            )
        )
        assert common.ravel() @ covariance @ common.ravel() < 1e-6 * size


@pytest.mark.parametrize("recalibrate", [False, True])
def test_uninformative_groups_add_nothing(recalibrate: bool) -> None:
    rig = Rig(RIG.cameras[:1])
    seen = simulate_tracks(BODY, TRUE, rig, 40, 0.3, 0)
    found = bundle_adjust(
        rig,
        seen,
        TRUE,
        BODY.radius,
        BundleOptions(calibration_prior=default_calibration_prior(rig), recalibrate=recalibrate),
    )
    assert np.median(found.variance_inflation) < 1.4


def test_exact_without_noise() -> None:
    seen = simulate_tracks(BODY, TRUE, RIG, 40, 0.0, 0)
    found = refine(RIG, seen)
    assert found.correction is not None
    assert found.status is Status.OK
    assert compute_remaining_errors(found.correction.rig)[0] < 0.01
    reported = perturb_rig(RIG, 2.0, 1)
    found = refine(reported, normalize_by(seen, RIG, reported))
    assert found.correction is not None
    before, after = compute_remaining_errors(reported), compute_remaining_errors(found.correction.rig)
    assert (after < 0.1 * before).all()
    assert [c.name for c in found.correction.rig] == [c.name for c in RIG]


def test_five_times_more_accurate_and_consistent() -> None:
    ratios: list[FloatArray] = []
    normalised: list[float] = []
    given: list[float] = []
    for seed in range(2):
        reported = perturb_rig(RIG, 3.0, seed)
        seen = normalize_by(simulate_tracks(BODY, TRUE, RIG, 50, 0.3, seed), RIG, reported)
        for recalibrate in (False, True):
            found = refine(reported, seen, recalibrate=recalibrate)
            now = reported if found.correction is None else found.correction.rig
            e = compute_pose_errors(found.corrected_poses, now, RIG, TRUE)[1:]
            nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.covariance[1:]), e)
            (normalised if recalibrate else given).append(np.median(nees))
        ratios.append(compute_remaining_errors(reported) / compute_remaining_errors(now))
        assert found.calibration_scale > 0.3
    assert np.median(ratios) > 5.0
    assert 0.5 < np.mean(normalised) < 25.0  # the similarity used for comparison has errors as well
    assert 0.2 < np.mean(given) < 25.0  # errors six times the prior are nearly recognized
    assert refine(RIG, seen, recalibrate=False).calibration_scale < 3.0


def test_exact_calibration_is_recognized() -> None:
    """It is hardly degraded, and its uncertainty is a small part of the poses'."""
    normalised: list[float] = []
    for seed in range(4):
        seen = simulate_tracks(BODY, TRUE, RIG, 50, 0.3, seed)
        found = refine(RIG, seen)
        assert found.correction is not None
        assert compute_remaining_errors(found.correction.rig)[0] < 0.05
        given = refine(RIG, seen, recalibrate=False)
        assert given.calibration_scale < 0.06
        e = compute_pose_errors(given.corrected_poses, RIG, RIG, TRUE)[1:]
        normalised.append(float(np.median(np.einsum("ni,nij,nj->n", e, np.linalg.inv(given.covariance[1:]), e))))
    assert 0.5 < np.mean(normalised) < 9.0


def test_effect_of_held_calibration_errors_is_estimated() -> None:
    """Rotations become twice as accurate at least, those of an exact rig hardly change; the covariance is theirs."""
    for size, most in ((0.0, 1.1), (0.1, 0.5), (0.3, 0.5)):
        ratios: list[float] = []
        normalised: list[float] = []
        for seed in range(3):
            reported = perturb_rig(RIG, size, seed)
            seen = normalize_by(simulate_tracks(BODY, TRUE, RIG, 50, 0.3, seed), RIG, reported)
            found = refine(reported, seen, recalibrate=False)
            held, e = (
                compute_pose_errors(poses, reported, RIG, TRUE)[1:]
                for poses in (found.world_from_object, found.corrected_poses)
            )
            ratios.append(float(np.sqrt((e[:, :3] ** 2).mean() / (held[:, :3] ** 2).mean())))
            normalised.append(float(np.median(np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.covariance[1:]), e))))
        assert np.exp(np.log(ratios).mean()) < most
        assert 1.0 < np.mean(normalised) < 9.0
        assert not found.calibration_change[0].any()


def test_joint_refinement_while_tracking_includes_calibration_errors() -> None:
    normalised: list[float] = []
    for seed in range(2):
        reported = perturb_rig(RIG, 0.3, seed)
        seen = normalize_by(simulate_tracks(BODY, TRUE, RIG, 50, 0.3, seed), RIG, reported)
        landmarks, times = np.zeros((int(seen.landmark.max()) + 1, 3)), np.arange(len(TRUE), dtype=float)
        found = bundle_frames(reported, seen, TRUE, landmarks, times, None, BODY.radius)
        e = compute_pose_errors(found.world_from_object, reported, RIG, TRUE)[1:]
        normalised.append(float(np.median(np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.covariance[1:]), e))))
    assert 0.5 < np.mean(normalised) < 12.0  # without the prior of calibration errors it is 70


def test_moved_camera() -> None:
    """Two cameras in one: before and after the move, with one lens."""
    values = np.zeros((4, 14))
    values[1, 4:7] = np.deg2rad([0.8, -1.5, 1.0])
    values[1, 7:10] = [0.004, 0.0, -0.006]
    after = correct_rig(RIG, values)
    both = [simulate_tracks(BODY, TRUE, rig, 50, 0.2, 3) for rig in (RIG, after)]
    late = [s.frame >= 7 for s in both]
    parts = [(s, keep) for s, keep in zip(both, (~late[0], late[1]), strict=True)]
    # The same random numbers give the same landmarks, which continue after the move.
    seen = Observations(
        *(np.concatenate([getattr(s, n)[k] for s, k in parts]) for n in ("frame", "camera", "landmark", "image"))
    )
    rig, prior = add_moved_cameras(RIG, default_calibration_prior(RIG), [MovedCamera(1, 7)])
    camera = np.where((seen.camera == 1) & (seen.frame >= 7), 4, seen.camera)
    found = bundle_adjust(
        rig, replace(seen, camera=camera), TRUE, BODY.radius, BundleOptions(calibration_prior=prior, recalibrate=True)
    )
    assert found.correction is not None
    assert found.correction.rig.names[4] == "cam_1 from frame 7"
    now = found.correction.rig.cameras
    step = (now[4].camera_from_world.rotation * now[1].camera_from_world.rotation.inv()).as_rotvec()
    assert np.rad2deg(np.linalg.norm(step - values[1, 4:7])) < 0.2
    np.testing.assert_array_equal(now[4].matrix, now[1].matrix)


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "seed"), [(0.0, 3), (3.0, 4)])
def test_correlated_errors_do_not_change_the_calibration(degrees: float, seed: int) -> None:
    """Tracked images, with correlated errors of neighboring features: an exact rig stays nearly exact, a wrong one is
    corrected."""
    tracked_frames, reported, rig, true = track_rendered(seed, degrees, frames=22)
    found = smooth_tracks(
        tracked_frames, reported, calibration_prior=default_calibration_prior(reported), recalibrate=True
    )
    assert found.correction is not None
    poses = [pose for pose in found.poses if pose.is_measured]
    stacked = RigidTransform.concatenate([p.world_from_object for p in poses if p.world_from_object is not None])
    covariance = np.array([pose.covariance for pose in poses])
    off, _, _, _, last, nees = score_calibration(
        stacked, covariance, found.correction.rig, rig, true[[p.index for p in poses]]
    )
    assert 0.2 < nees < 9.0
    if degrees:
        assert off < align_rigs(reported, rig)[3][:, 0].mean() / 5.0
    else:
        assert np.sqrt(np.mean((found.correction.values / found.correction.sd) ** 2)) < 1.0
        assert off < 0.25
        assert last < 5.0
