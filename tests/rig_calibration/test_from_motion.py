"""Rigs calibrated from simulated observations of one object: exact, honest, and wrong lenses are noticed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.calibration_refinement import N_CAMERA_PARAMETERS, CalibrationPrior
from sylpose.geometry.arrays import FloatArray
from sylpose.io.calibration.world import World, transform_rig
from sylpose.results import FramePose
from sylpose.rig import Camera, Rig
from sylpose.rig_calibration.camera_tracks import RefinedTrack, refine_track, reverse_depth
from sylpose.rig_calibration.from_motion import (
    MotionCalibration,
    calibrate_from_motion,
    find_unobservable,
    locate,
    rescale,
)
from sylpose.rig_calibration.motion_bundle import (
    bundle_jointly,
    make_lens_prior,
    transform_covariance,
)
from sylpose.rig_calibration.relative_motions import MotionRefusedError, solve_relative_extrinsics
from sylpose.simulate import arc, box
from sylpose.smoothing import Track, smooth_tracks
from sylpose.status import FrameStatus
from sylpose.tracking.camera_side.frame import LandmarkObservations
from tests.rig_calibration.test_relative_motions import RADIUS, tumble

NOISE_PX = 0.3


def observe(rig: Rig, path: RigidTransform, seed: int = 0, noise: float = NOISE_PX) -> list[list[Track]]:
    """Return what each camera's tracker would yield: visible points of a box, and poses that drift."""
    rng, all_tracks = np.random.default_rng(seed), []
    body = box((0.2, 0.15, 0.17), 400, seed)
    for camera in rig:
        poses = camera.camera_from_world * path
        unit = float(np.linalg.norm(poses.translation[0]))
        # The track's axes of the object are the camera's in the first frame, with the origin at the body's center.
        first = poses[0].rotation
        points, normals = first.apply(body.points.copy()) / unit, first.apply(body.normals.copy())
        drift = np.cumsum(rng.normal(scale=2e-3, size=(len(path), 3)), axis=0)
        tracks = []
        for k in range(len(path)):
            R = poses[k].rotation * first.inv()
            t = poses[k].translation / unit
            seen = np.flatnonzero(np.einsum("ni,ni->n", R.apply(normals), -(R.apply(points) + t)) > 0.2)
            seen = seen[rng.random(len(seen)) < 0.7]
            projected = R.apply(points[seen]) + t
            image = projected[:, :2] / projected[:, 2:] + noise / camera.focal * rng.normal(size=(len(seen), 2))
            pose = RigidTransform.from_components(t * (1.0 + drift[k, 0]), Rotation.from_rotvec(drift[k]) * R)
            status = FrameStatus.TRACKED if k else FrameStatus.FIRST
            frame = FramePose(k, k / 30, status, pose, 1e-6 * np.eye(6), np.array([len(seen)]), np.array([noise]))
            moved = np.ones(len(seen), bool)
            # Depths of landmarks are rough.
            rough = points[seen] * (1.0 + 0.1 * rng.normal(size=(len(seen), 1)))
            observations = (LandmarkObservations(seen, image, rough, moved),)
            tracks.append(Track(frame, observations, np.zeros(1), RADIUS / unit))
        all_tracks.append(tracks)
    return all_tracks


@cache
def refine(seed: int = 0, *, one_axis: bool = False) -> list[RefinedTrack | None]:
    all_tracks = observe(RIG, make_path(seed, one_axis=one_axis), seed)
    return [refine_track(its, camera) for its, camera in zip(all_tracks, RIG, strict=True)]


@cache
def calibrate(seed: int = 0) -> MotionCalibration:
    return calibrate_from_motion(RIG.cameras, refine(seed))


def make_path(seed: int, *, one_axis: bool = False) -> RigidTransform:
    """Return every second pose of a tumbling object."""
    return tumble(seed, one_axis=one_axis)[::2]


def errors_of(found: MotionCalibration, rig: Rig) -> tuple[FloatArray, FloatArray]:
    """Return (C, 6) errors of each camera_from_world after fitting the scale, and (C, 6) standard deviations."""
    own = found.calibration.rig
    first = rig[own[0].name].camera_from_world
    truth = [rig[camera.name].camera_from_world * first.inv() for camera in own]
    centers, expected = np.array([c.center for c in own]), np.array([t.inv().translation for t in truth])
    scale = (centers * expected).sum() / (centers**2).sum()
    errors = np.array(
        [
            np.concatenate(
                [
                    (t.rotation * c.camera_from_world.rotation.inv()).as_rotvec(),
                    t.translation / scale - c.camera_from_world.translation,
                ]
            )
            for t, c in zip(truth, own, strict=True)
        ]
    )
    return errors, np.sqrt(np.array([np.diag(c) for c in found.calibration.extrinsics_covariance]))


# Their lenses are exact, and said to be so.
RIG = Rig([replace(its, error_px=0.0) for its in arc(3, 50.0, 1.2, 800.0, (640, 480), height=[0.1, 0.4, -0.2])])


def test_calibration_is_precise_and_honest() -> None:
    squares = []
    for seed in range(2):
        found = calibrate(seed)
        assert found.calibration.rig.names == RIG.names
        assert not found.left_out
        assert all(test.passed for test in found.tests)
        errors, sds = errors_of(found, RIG)
        assert np.degrees(np.linalg.norm(errors[:, :3], axis=1)).max() < 0.15
        assert (np.abs(errors[1:]) < 4.0 * sds[1:]).all()
        assert (sds[0] < 1e-12).all()
        squares.append(np.mean((errors[1:] / sds[1:]) ** 2))
    assert 0.1 < np.mean(squares) < 2.5


def test_scale_is_free_and_can_be_set() -> None:
    found = calibrate()
    doubled = rescale(found, 2.0, "mm")
    assert doubled.calibration.rig.unit == "mm"
    np.testing.assert_allclose(doubled.calibration.rig[1].center, 2.0 * found.calibration.rig[1].center)
    np.testing.assert_allclose(
        doubled.calibration.extrinsics_covariance[1][3:, 3:],
        4.0 * found.calibration.extrinsics_covariance[1][3:, 3:],
    )
    # The scale of a rig from relative lengths is that of the distance of two cameras; the object is as long as it was.
    truth = float(np.linalg.norm(RIG[0].center - RIG[1].center))
    metric = rescale(found, truth / float(np.linalg.norm(found.calibration.rig[1].center)), "m")
    assert metric.object_length == pytest.approx(np.linalg.norm([0.2, 0.15, 0.17]), rel=0.15)


def test_known_distance_is_exact_in_the_covariance() -> None:
    """The sd of a known distance is 0, that of the others in another world the same; a length's is relative."""
    found = calibrate()

    def distance_sd(its: MotionCalibration, a: int, b: int) -> float:
        rig, g = its.calibration.rig, np.zeros((len(RIG), N_CAMERA_PARAMETERS))
        between = rig[a].center - rig[b].center
        g[a, 3:6] = between / np.linalg.norm(between)
        g[b, 3:6] = -g[a, 3:6]
        return float(np.sqrt(max(float(g.ravel() @ its.covariance @ g.ravel()), 0.0)) / np.linalg.norm(between))

    names = found.calibration.rig.names
    known = rescale(found, 3.0, "m", exact=(names[1], names[2]))
    assert distance_sd(known, 1, 2) < 1e-3 * distance_sd(known, 0, 1)
    rough = rescale(found, 3.0, "m", sd=0.1)
    assert distance_sd(rough, 0, 1) == pytest.approx(0.1, rel=0.01)
    world = transform_rig(
        known.calibration.rig, World(RigidTransform.from_rotation(Rotation.random(rng=0)), unit="m", world_unit="m")
    )
    located = locate(known, world)
    assert distance_sd(located, 0, 2) == pytest.approx(distance_sd(known, 0, 2))
    turned, straight = (its.calibration.extrinsics_covariance for its in (located, known))
    np.testing.assert_allclose(turned, straight, rtol=1e-6, atol=1e-12 * np.abs(straight).max())


def observe_jointly(found: MotionCalibration, path: RigidTransform, seed: int) -> list[Track]:
    """Return what a tracker of all cameras would yield: landmarks in the object's frame, rough poses."""
    rig, rng = found.calibration.rig, np.random.default_rng(seed)
    alone = observe(RIG, path, seed)
    tracks = []
    scale = float(np.linalg.norm(rig[1].center) / np.linalg.norm(RIG[1].center - RIG[0].center))
    poses = true_poses(path, scale)
    for k in range(len(path)):
        observations = []
        for c, camera in enumerate(RIG):
            its = alone[c][k].observations[0]
            # A camera's own landmarks are in its axes of the first frame, in units of the first distance.
            pose = camera.camera_from_world * path[0]
            points = pose.rotation.inv().apply(its.positions * float(np.linalg.norm(pose.translation)))
            points = poses[0].rotation.apply(points * scale)
            observations.append(replace(its, positions=points))
        R = poses[k].rotation * poses[0].rotation.inv()
        rough = Rotation.from_rotvec(0.01 * rng.normal(size=3) * (k > 0)) * R
        pose = RigidTransform.from_components(poses[k].translation, rough)
        # Rough poses are no evidence against refined ones.
        status = FrameStatus.UNCERTAIN if k else FrameStatus.FIRST
        frame = replace(alone[0][k].pose, world_from_object=pose, status=status)
        frame = replace(frame, inliers=np.full(3, 100), residuals=np.full(3, 0.3))
        tracks.append(Track(frame, tuple(observations), np.zeros(3), RADIUS * scale))
    return tracks


def true_poses(path: RigidTransform, scale: float) -> RigidTransform:
    """Return the object's poses in the axes of the first camera, in the calibration's lengths."""
    poses = RIG[0].camera_from_world * path
    return RigidTransform.from_components(scale * poses.translation, poses.rotation)


def test_poses_include_the_errors_of_the_calibration() -> None:
    """Squared errors over covariances are about 1 with the calibration's covariance, and far more without it."""
    squares: dict[bool, list[FloatArray]] = {True: [], False: []}
    for seed in range(3):
        path = make_path(seed)
        found = calibrate(seed)
        names = found.calibration.rig.names
        found = rescale(found, 1.0, "", exact=(names[0], names[1]))
        tracks, rig = observe_jointly(found, path, seed), found.calibration.rig
        truth = true_poses(path, float(np.linalg.norm(rig[1].center) / np.linalg.norm(RIG[1].center - RIG[0].center)))
        for is_included, its in squares.items():
            prior = CalibrationPrior.from_covariance(found.covariance * (1.0 if is_included else 1e-12))
            poses = smooth_tracks(tracks, rig, calibration_prior=prior).poses
            first = poses[0].world_from_object
            assert first is not None
            for k, pose in enumerate(poses[1:], start=1):
                assert pose.world_from_object is not None
                R = truth[k].rotation * truth[0].rotation.inv()
                w = (R * pose.world_from_object.rotation.inv()).as_rotvec()
                d = truth[k].translation - truth[0].translation
                d = d - pose.world_from_object.translation + first.translation
                blocks = zip((w, d), (slice(0, 3), slice(3, 6)), strict=True)
                its.append(np.array([e @ np.linalg.solve(pose.covariance[s, s], e) / 3.0 for e, s in blocks]))
    included, ignored = (np.mean(its, axis=0) for its in squares.values())
    # The lenses are exact, but small errors of theirs are included.
    assert ((included > 0.1) & (included < 1.5)).all()
    assert ignored[1] > 10.0 * included[1]


def observe_with(
    seed: int, focal: float = 1.0, principal: ArrayLike = 0.0, k1: float = 0.0, step: int = 2
) -> tuple[list[Camera], list[RefinedTrack | None]]:
    """Return cameras with wrong lenses and the tracks that they would have: their pixels are those of the true ones."""
    cameras, tracks = list[Camera](), list[RefinedTrack | None]()
    shifts = np.broadcast_to(principal, (len(RIG), 2))
    for its, camera, shift in zip(observe(RIG, tumble(seed)[::step], seed), RIG, shifts, strict=True):
        matrix = camera.matrix.copy()
        matrix[[0, 1], [0, 1]] *= focal
        matrix[:2, 2] += shift
        cameras.append(replace(camera, matrix=matrix, distortion=np.array([k1, 0.0, 0.0, 0.0])))
        wrong = []
        for t in its:
            seen = t.observations[0]
            normalized = cameras[-1].normalize(camera.denormalize(seen.normalized))
            wrong.append(replace(t, observations=(replace(seen, normalized=normalized),)))
        tracks.append(refine_track(wrong, cameras[-1]))
    return cameras, tracks


def test_wrong_principal_points() -> None:
    """Those that the motion contradicts are estimated; errors of the others are in the covariance."""
    wrong, tracks = observe_with(1, principal=20.0)
    found = calibrate_from_motion(wrong, tracks)
    assert found.freed == ("principal",)
    assert any("principal points were estimated" in warning for warning in found.calibration.warnings)
    errors, sds = errors_of(found, RIG)
    assert (np.abs(errors[1:]) < 4.0 * sds[1:]).all()
    squares = []
    for seed in range(2):
        cameras, tracks = observe_with(seed, principal=3.0 * np.random.default_rng(seed).normal(size=(len(RIG), 2)))
        found = calibrate_from_motion([replace(its, error_px=None) for its in cameras], tracks)
        assert found.freed == ()
        errors, sds = errors_of(found, RIG)
        squares.append(np.mean((errors[1:] / sds[1:]) ** 2))
    assert 0.1 < np.mean(squares) < 2.5


def test_focal_lengths_from_a_field_of_view() -> None:
    """They are 20 % off."""
    cameras, tracks = observe_with(2, focal=0.8)
    found = calibrate_from_motion(cameras, tracks, ("fov",))
    focal = np.array([camera.focal for camera in found.calibration.rig])
    np.testing.assert_allclose(focal, RIG[0].focal, rtol=0.015)
    sd = np.array([np.sqrt(c[0, 0]) for c in found.calibration.intrinsics_covariance])
    assert (np.abs(focal - RIG[0].focal) < 4.0 * sd).all()
    assert not found.calibration.unobservable
    assert np.degrees(np.linalg.norm(errors_of(found, RIG)[0][:, :3], axis=1)).max() < 0.3


@pytest.mark.parametrize(("name", "error"), [("principal", 8.0), ("distortion", 0.05)])
def test_principal_points_and_distortion_are_estimated(name: str, error: float) -> None:
    """Within four of the stated standard deviations, and better than given; what is held has none."""
    is_principal = name == "principal"
    cameras, tracks = observe_with(
        3, principal=error * is_principal, k1=error * (not is_principal), step=2 - is_principal
    )
    found = calibrate_from_motion(cameras, tracks, (name,))
    assert not found.calibration.unobservable
    for camera, true, covariance in zip(
        found.calibration.rig, RIG, found.calibration.intrinsics_covariance, strict=True
    ):
        sd = np.sqrt(np.diag(covariance))
        off = np.append(camera.matrix[:2, 2] - true.matrix[:2, 2], camera.distortion[0])
        own = off[:2] if is_principal else off[2:]
        assert (np.abs(own) < 4.0 * (sd[2:4] if is_principal else sd[4])).all()
        assert np.abs(own).max() < 0.6 * error
        assert not sd[:2].any()
        assert not (sd[4] if is_principal else sd[2:4]).any()


def test_lens_that_stays_at_its_prior_is_named() -> None:
    """With a prior much narrower than the information, standard deviations stay as they were."""
    joint = bundle_jointly(
        RIG.cameras, [t for t in refine() if t], solve_relative_extrinsics([t.track for t in refine() if t])
    )
    narrow = make_lens_prior(RIG[0], ("focal",))
    k = N_CAMERA_PARAMETERS
    covariance = joint.covariance.copy()
    for c in range(len(RIG)):
        covariance[c * k + 6, c * k + 6] = (0.9 if c == 1 else 0.1) ** 2 * narrow[0] ** 2
    sentences = [*find_unobservable(replace(joint, covariance=covariance), ("focal",))]
    assert sentences == ["cam_1: the motion does not determine focal length, which stayed as given or guessed"]


def test_wrong_focal_lengths_are_estimated() -> None:
    """They contradict the motion, so they are not held."""
    wrong, tracks = observe_with(1, focal=1.05)
    found = calibrate_from_motion(wrong, tracks)
    assert "focal" in found.freed
    assert any("focal lengths were estimated" in warning for warning in found.calibration.warnings)
    focal = np.array([camera.focal for camera in found.calibration.rig])
    np.testing.assert_allclose(focal, [camera.focal for camera in RIG], rtol=0.01)
    sd = np.array([np.sqrt(c[0, 0]) for c in found.calibration.intrinsics_covariance])
    assert (np.abs(focal - RIG[0].focal) < 4.0 * sd).all()


def test_camera_without_a_track_and_refusals() -> None:
    tracks = refine()
    found = calibrate_from_motion(RIG.cameras, [tracks[0], None, tracks[2]])
    assert found.left_out == {"cam_1": "it could not track the object"}
    assert found.calibration.rig.names == ("cam_0", "cam_2")
    with pytest.raises(MotionRefusedError):
        calibrate_from_motion(RIG.cameras, [tracks[0], None, None])
    with pytest.raises(MotionRefusedError, match="second axis"):
        calibrate_from_motion(RIG.cameras, refine(one_axis=True))


@pytest.mark.parametrize("index", [1, 2])
def test_camera_left_out_is_added_by_the_joint_refinement(index: int) -> None:
    """Its own poses are noisier than stated, so its rotations contradict the others; its observations do not.

    The others lack two of its frames, the first and one between.
    """
    tracks, rng = [its for its in refine() if its is not None], np.random.default_rng(0)
    noisy = tracks[index]
    frames = np.delete(noisy.track.frames, [0, 20])
    tracks = [its if k == index else its.restrict(frames) for k, its in enumerate(tracks)]
    poses = noisy.track.camera_from_object
    errors = Rotation.from_rotvec(np.radians(4.0) * rng.normal(size=(len(poses), 3)))
    wrong = RigidTransform.from_components(poses.translation, errors * poses.rotation)
    poor = replace(noisy, track=replace(noisy.track, camera_from_object=wrong))
    found = calibrate_from_motion(RIG.cameras, [poor if k == index else its for k, its in enumerate(tracks)])
    assert not found.left_out
    assert found.calibration.rig.names == RIG.names
    assert any(f"cam_{index} was added" in warning for warning in found.calibration.warnings)
    assert np.degrees(np.linalg.norm(errors_of(found, RIG)[0][:, :3], axis=1)).max() < 0.2


def test_depth_reversed_start_is_recovered() -> None:
    """A track that begins with the wrong one of two depths ends with the right one."""
    path = make_path(2)
    its = observe(RIG, path, 2)[0]
    reversed_tracks = []
    for t in its:
        assert t.pose.world_from_object is not None
        poses = RigidTransform.concatenate([t.pose.world_from_object])
        turned, positions = reverse_depth(poses, t.observations[0].positions)
        pose = replace(t.pose, world_from_object=turned[0])
        reversed_tracks.append(replace(t, pose=pose, observations=(replace(t.observations[0], positions=positions),)))
    straight, other = refine_track(its, RIG[0]), refine_track(reversed_tracks, RIG[0])
    assert straight is not None
    assert other is not None
    difference = straight.track.camera_from_object.rotation * other.track.camera_from_object.rotation.inv()
    assert np.degrees(difference.magnitude()).max() < 0.2
    assert max(straight.reversal_ratio, other.reversal_ratio) < 0.8


def test_covariance_in_first_camera() -> None:
    """Against finite differences of the poses themselves."""
    rng = np.random.default_rng(0)
    width, n = N_CAMERA_PARAMETERS, len(RIG)
    root = np.zeros((n * width, n * width))
    for c in range(n):
        k = c * width
        root[k : k + 6, k : k + 6] = rng.normal(size=(6, 6))
    covariance = transform_covariance(RIG, root @ root.T)

    def poses_of(values: FloatArray) -> FloatArray:
        out, first = [], None
        for c, camera in enumerate(RIG):
            w, d = values[c * width : c * width + 3], values[c * width + 3 : c * width + 6]
            rotation = Rotation.from_rotvec(w) * camera.camera_from_world.rotation
            pose = RigidTransform.from_components(-rotation.apply(camera.center + d), rotation)
            first = pose if first is None else first
            out.append(pose * first.inv())
        centers = np.array([p.inv().translation for p in out])
        expected = np.array([c.center for c in RIG])
        expected = RIG[0].camera_from_world.apply(expected.copy())
        centers *= np.sqrt((expected**2).sum() / (centers**2).sum())
        start = [(c.camera_from_world * RIG[0].camera_from_world.inv()).rotation for c in RIG]
        return np.array(
            [
                np.concatenate([(p.rotation * s.inv()).as_rotvec(), center - e])
                for p, s, center, e in zip(out, start, centers, expected, strict=True)
            ]
        )

    h, J = 1e-6, np.zeros((6 * n, n * width))
    for k in range(n * width):
        step = np.zeros(n * width)
        step[k] = h
        J[:, k] = ((poses_of(step) - poses_of(-step)) / (2 * h)).ravel()
    numeric = J @ root @ root.T @ J.T
    rows = np.concatenate([np.arange(c * width, c * width + 6) for c in range(n)])
    np.testing.assert_allclose(covariance[np.ix_(rows, rows)], numeric, atol=1e-6)
