"""Rigs calibrated from simulated observations of one object: exact, honest, and wrong lenses are noticed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.results import FramePose
from sylpose.rig import Rig
from sylpose.rig_calibration.camera_tracks import RefinedTrack, refine_track, reverse_depth
from sylpose.rig_calibration.from_motion import MotionCalibration, calibrate_from_motion
from sylpose.rig_calibration.motion_bundle import N_CAMERA_PARAMETERS, transform_covariance
from sylpose.rig_calibration.relative_motions import MotionRefusedError
from sylpose.simulate import arc, box
from sylpose.smoothing import Track
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


RIG = arc(3, 50.0, 1.2, 800.0, (640, 480), height=[0.1, 0.4, -0.2])


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
    doubled = found.rescale(2.0, "mm")
    assert doubled.calibration.rig.unit == "mm"
    np.testing.assert_allclose(doubled.calibration.rig[1].center, 2.0 * found.calibration.rig[1].center)
    np.testing.assert_allclose(
        doubled.calibration.extrinsics_covariance[1][3:, 3:],
        4.0 * found.calibration.extrinsics_covariance[1][3:, 3:],
    )
    # The scale of a rig from relative lengths is that of the distance of two cameras; the object is as long as it was.
    truth = float(np.linalg.norm(RIG[0].center - RIG[1].center))
    metric = found.rescale(truth / float(np.linalg.norm(found.calibration.rig[1].center)), "m")
    assert metric.object_length == pytest.approx(np.linalg.norm([0.2, 0.15, 0.17]), rel=0.15)


def test_wrong_focal_lengths_are_estimated() -> None:
    """They contradict the motion, so they are not held."""
    path = make_path(1)
    wrong = []
    for camera in RIG:
        matrix = camera.matrix.copy()
        matrix[[0, 1], [0, 1]] *= 1.05
        wrong.append(replace(camera, matrix=matrix))
    tracks = []
    for its, camera in zip(observe(RIG, path, 1), wrong, strict=True):
        scaled = [
            replace(t, observations=tuple(replace(o, normalized=o.normalized / 1.05) for o in t.observations))
            for t in its
        ]
        tracks.append(refine_track(scaled, camera))
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


def test_camera_left_out_is_added_by_the_joint_refinement() -> None:
    """Its own poses are noisier than stated, so its rotations contradict the others; its observations do not."""
    tracks, rng = refine(), np.random.default_rng(0)
    noisy = tracks[2]
    assert noisy is not None
    poses = noisy.track.camera_from_object
    errors = Rotation.from_rotvec(np.radians(4.0) * rng.normal(size=(len(poses), 3)))
    wrong = RigidTransform.from_components(poses.translation, errors * poses.rotation)
    poor = replace(noisy, track=replace(noisy.track, camera_from_object=wrong))
    found = calibrate_from_motion(RIG.cameras, [tracks[0], tracks[1], poor])
    assert not found.left_out
    assert found.calibration.rig.names == RIG.names
    assert any("cam_2 was added" in warning for warning in found.calibration.warnings)
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
