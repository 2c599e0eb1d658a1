"""Views of a motion: consistent projections, uncertainty that rotates with the axes, lookup of camera names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import invert_information
from sylpose.moments import PairMoments
from sylpose.relative_pose.motion import estimate_motion
from sylpose.report.files import TrajectoryWriter, read_trajectory, read_tum
from sylpose.results import FramePose, Motion, RotationEstimate, Trajectory
from sylpose.rig import make_look_at_camera
from sylpose.simulate import ellipsoid, random_motion, ring, simulate_matches
from sylpose.status import FrameStatus, Status
from sylpose.sylvester.depth_plane import solve_depth_plane
from sylpose.view import resolve_viewpoint, trajectory_view, view_of_motion, view_of_pose, view_of_rotation

seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=12, deadline=None)


def random_transform(rng: np.random.Generator) -> RigidTransform:
    return RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))


def random_information(rng: np.random.Generator, n: int = 6) -> FloatArray:
    half = rng.normal(size=(n, n))
    return np.asarray(half @ half.T + np.eye(n))


def motion_with(
    rng: np.random.Generator, information: FloatArray | None = None, status: Status = Status.OK, found: bool = True
) -> Motion:
    info = random_information(rng) if information is None else information
    return Motion(
        status=status,
        motion=random_transform(rng) if found else None,
        center=rng.normal(size=3),
        information=info,
        covariance=invert_information(info),
        unobservable=rng.normal(size=(1, 6)) if status is not Status.OK else np.empty((0, 6)),
        inliers=(),
        residuals=np.empty(0),
        method="epipolar",
        iterations=1,
    )


def pose_with(rng: np.random.Generator, index: int, status: FrameStatus = FrameStatus.TRACKED) -> FramePose:
    found = status.has_pose
    covariance = invert_information(random_information(rng) if found else np.zeros((6, 6)))
    pose = random_transform(rng) if found else None
    return FramePose(index, index / 30, status, pose, covariance, np.array([7, 8]), np.array([0.5, 0.25]))


@pytest.mark.parametrize(("degrees", "uncertain"), [(15.0, False), (25.0, True)])
def test_pose_with_uncertain_rotation_is_uncertain(degrees: float, uncertain: bool) -> None:
    about = Rotation.random(rng=np.random.default_rng(0)).as_matrix()[0]
    covariance = np.diag([*np.full(3, 1e-6), *np.full(3, 100.0)])  # position variance does not matter
    covariance[:3, :3] += np.deg2rad(degrees) ** 2 * np.outer(about, about)
    for status in (FrameStatus.TRACKED, FrameStatus.RELOCALIZED):
        pose = replace(pose_with(np.random.default_rng(1), 3, status), covariance=covariance)
        judged = pose.mark_uncertain()
        assert judged.status is (FrameStatus.UNCERTAIN if uncertain else status)
        assert judged.is_measured is not uncertain
        assert judged.world_from_object is pose.world_from_object
    # No covariance raises the status; an infinite one is uncertain.
    uncertain_pose = replace(
        pose_with(np.random.default_rng(1), 3), status=FrameStatus.UNCERTAIN, covariance=covariance
    )
    assert uncertain_pose.is_observed
    assert uncertain_pose.mark_uncertain().status is FrameStatus.UNCERTAIN
    for unknown in (np.inf, np.nan):
        assert (
            replace(uncertain_pose, covariance=np.diag([unknown, *np.ones(5)])).mark_uncertain().status
            is FrameStatus.UNCERTAIN
        )
    for status in (FrameStatus.FIRST, FrameStatus.COASTING, FrameStatus.LOST):
        same = pose_with(np.random.default_rng(1), 3, status)
        assert same.mark_uncertain() is same


# --- The motion -------------------------------------------------------------------------------------------------------


@given(seeds)
@quick
def test_points_move_equally_in_camera_and_world(seed: int) -> None:
    rng = np.random.default_rng(seed)
    motion, camera, points = motion_with(rng), random_transform(rng), rng.normal(size=(5, 3))
    view = view_of_motion(motion, camera)
    assert motion.motion is not None
    assert view.motion is not None
    np.testing.assert_allclose(
        view.motion.apply(camera.apply(points)), camera.apply(motion.motion.apply(points)), atol=1e-12
    )
    Q, R, t = camera.rotation.as_matrix(), motion.motion.rotation.as_matrix(), motion.motion.translation
    np.testing.assert_allclose(view.motion.rotation.as_matrix(), Q @ R @ Q.T, atol=1e-12)
    o = -Q.T @ camera.translation
    np.testing.assert_allclose(view.motion.translation, Q @ (t + (R - np.eye(3)) @ o), atol=1e-12)
    moved = motion.motion.apply(motion.center) - motion.center
    np.testing.assert_allclose(view.center_translation, Q @ moved, atol=1e-12)


def test_view_of_an_extra_camera_projects_correctly() -> None:
    """An estimate of a rig viewed from a fifth camera gives the same pixels as projection from the world."""
    rng = np.random.default_rng(1)
    rig = ring(4, height=[0.4, -0.4, 0.4, -0.4])
    pair = simulate_matches(rig, ellipsoid(), random_motion(5, 0.03, rng), rng=rng)
    motion = estimate_motion(rig, pair.matches)
    virtual = make_look_at_camera("above", (0.1, -1.5, 0.2), (0, 0, 0), 800, (640, 480))
    view = view_of_motion(motion, virtual)
    assert motion.motion is not None
    assert view.motion is not None
    points = 0.1 * rng.normal(size=(20, 3))
    expected = virtual.project(motion.motion.apply(points))
    seen = view.motion.apply(virtual.camera_from_world.apply(points))
    normalized = seen[:, :2] / seen[:, 2:]
    np.testing.assert_allclose(virtual.denormalize(normalized), expected, atol=1e-9)


@given(seeds)
@quick
def test_views_compose_and_invert(seed: int) -> None:
    rng = np.random.default_rng(seed)
    motion, a, b_from_a = (
        motion_with(rng, status=Status.SCALE_NOT_OBSERVABLE),
        random_transform(rng),
        random_transform(rng),
    )
    first = view_of_motion(motion, a)
    as_motion = Motion(
        first.status,
        first.motion,
        first.center,
        first.information,
        first.covariance,
        first.unobservable,
        (),
        np.empty(0),
        "",
        0,
    )
    for again, direct in (
        (view_of_motion(as_motion, b_from_a), view_of_motion(motion, b_from_a * a)),
        (view_of_motion(as_motion, a.inv()), view_of_motion(motion, RigidTransform.identity())),
    ):
        assert again.motion is not None
        assert direct.motion is not None
        np.testing.assert_allclose(again.motion.as_matrix(), direct.motion.as_matrix(), atol=1e-11)
        for name in ("center", "information", "covariance", "unobservable"):
            np.testing.assert_allclose(getattr(again, name), getattr(direct, name), atol=1e-9, err_msg=name)


def test_identity_view_is_the_motion() -> None:
    motion = motion_with(np.random.default_rng(2))
    view = view_of_motion(motion, RigidTransform.identity())
    assert view.motion is not None
    assert motion.motion is not None
    np.testing.assert_allclose(view.motion.as_matrix(), motion.motion.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(view.covariance, motion.covariance, rtol=1e-9)
    np.testing.assert_allclose(view.sigma, np.sqrt(np.diag(motion.covariance)), rtol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_covariance_matches_sampled_motions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    motion, camera = motion_with(rng, 1e6 * random_information(rng)), random_transform(rng)
    view = view_of_motion(motion, camera)
    assert motion.motion is not None
    assert view.motion is not None
    w_d = rng.multivariate_normal(np.zeros(6), motion.covariance, 4000)
    rotations = Rotation.from_rotvec(w_d[:, :3]) * motion.motion.rotation
    ends = motion.motion.apply(motion.center) + w_d[:, 3:]
    samples = RigidTransform.from_components(ends - rotations.apply(motion.center), rotations)
    seen = camera * samples * camera.inv()
    turns = (seen.rotation * view.motion.rotation.inv()).as_rotvec()
    shifts = seen.apply(view.center) - view.motion.apply(view.center)
    sampled = np.cov(np.column_stack([turns, shifts]).T)
    scale = np.sqrt(np.diag(view.covariance))
    np.testing.assert_allclose(sampled / np.outer(scale, scale), view.covariance / np.outer(scale, scale), atol=0.08)
    np.testing.assert_allclose(view.information @ view.covariance, np.eye(6), atol=1e-8)


def test_unobservable_directions_rotate_with_the_axes() -> None:
    """Translation along the world's x is unobservable: so is the camera's z when it points that way."""
    rng = np.random.default_rng(3)
    motion = motion_with(rng, np.diag([1.0, 1, 1, 0, 4, 4]), Status.SCALE_NOT_OBSERVABLE)
    looks_along_x = RigidTransform.from_rotation(Rotation.from_matrix([[0, 0, -1], [0, 1, 0], [1, 0, 0]]))
    view = view_of_motion(motion, looks_along_x)
    np.testing.assert_allclose(np.diag(view.covariance), [1, 1, 1, 0.25, 0.25, np.inf])
    Q = looks_along_x.rotation.as_matrix()
    np.testing.assert_allclose(
        view.unobservable[0], [*(Q @ motion.unobservable[0, :3]), *(Q @ motion.unobservable[0, 3:])]
    )
    assert view.status is Status.SCALE_NOT_OBSERVABLE
    oblique = view_of_motion(motion, RigidTransform.from_rotation(Rotation.from_rotvec([0, 0.5, 0])))
    np.testing.assert_allclose(np.diag(oblique.covariance), [1, 1, 1, np.inf, 0.25, np.inf])


def test_view_of_missing_motion_has_no_motion() -> None:
    rng = np.random.default_rng(4)
    view = view_of_motion(
        motion_with(rng, np.zeros((6, 6)), Status.TOO_FEW_MATCHES, found=False), random_transform(rng)
    )
    assert view.motion is None
    assert view.status is Status.TOO_FEW_MATCHES
    assert np.isnan(view.pan_tilt_roll).all()
    assert np.isnan(view.center_translation).all()
    assert (np.diag(view.covariance) == np.inf).all()


def test_pan_tilt_roll_are_about_camera_axes() -> None:
    rng = np.random.default_rng(5)
    camera = random_transform(rng)
    for axis, expected in ((1, [0.3, 0, 0]), (0, [0, 0.3, 0]), (2, [0, 0, 0.3])):
        about = camera.rotation.inv().apply(np.eye(3)[axis])
        turn = Rotation.from_rotvec(0.3 * about).as_matrix()
        view = view_of_rotation(estimate_of(turn, np.eye(3)), camera)
        np.testing.assert_allclose(view.pan_tilt_roll, expected, atol=1e-12)


def estimate_of(rotation: FloatArray, information: FloatArray) -> RotationEstimate:
    return RotationEstimate(Status.ROTATION_NOT_OBSERVABLE, rotation, information, np.eye(3)[:1], 1)


# --- A rotation alone -------------------------------------------------------------------------------------------------


@given(seeds)
@quick
def test_rotation_view_matches_motion_view(seed: int) -> None:
    rng = np.random.default_rng(seed)
    information = np.zeros((6, 6))
    information[:3, :3], information[3:, 3:] = random_information(rng, 3), np.eye(3)
    motion, camera = motion_with(rng, information), random_transform(rng)
    assert motion.motion is not None
    whole = view_of_motion(motion, camera)
    assert whole.motion is not None
    alone = view_of_rotation(estimate_of(motion.motion.rotation.as_matrix(), information[:3, :3]), camera)
    np.testing.assert_allclose(alone.rotation, whole.motion.rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(alone.information, whole.information[:3, :3], atol=1e-9)
    np.testing.assert_allclose(alone.covariance, whole.covariance[:3, :3], atol=1e-9)
    np.testing.assert_allclose(alone.pan_tilt_roll, whole.pan_tilt_roll, atol=1e-9)
    np.testing.assert_allclose(alone.unobservable, camera.rotation.apply(np.eye(3)[:1]), atol=1e-12)


def test_view_of_missing_rotation_has_no_rotation() -> None:
    nothing = solve_depth_plane(np.array([np.eye(3)] * 2), [PairMoments.zero()] * 2)
    view = view_of_rotation(nothing, random_transform(np.random.default_rng(0)))
    assert view.status is nothing.status is Status.TOO_FEW_MATCHES
    assert np.isnan(view.rotation).all()
    assert np.isnan(view.pan_tilt_roll).all()
    assert (np.diag(view.covariance) == np.inf).all()


def test_bad_rotations_are_rejected() -> None:
    world = RigidTransform.identity()
    with pytest.raises(ValueError, match="not a rotation matrix"):
        view_of_rotation(estimate_of(2 * np.eye(3), np.eye(3)), world)
    with pytest.raises(ValueError, match="information has values that are not finite"):
        view_of_rotation(estimate_of(np.eye(3), np.full((3, 3), np.nan)), world)


# --- Poses and trajectories -------------------------------------------------------------------------------------------


@given(seeds)
@quick
def test_pose_view_maps_object_points_to_camera(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, camera, points = pose_with(rng, 3), random_transform(rng), rng.normal(size=(4, 3))
    seen = view_of_pose(pose, camera)
    assert pose.world_from_object is not None
    assert seen.world_from_object is not None
    np.testing.assert_allclose(
        seen.world_from_object.apply(points), camera.apply(pose.world_from_object.apply(points)), atol=1e-12
    )
    Q = np.kron(np.eye(2), camera.rotation.as_matrix())
    np.testing.assert_allclose(seen.covariance, Q @ pose.covariance @ Q.T, atol=1e-12)
    back = view_of_pose(seen, camera.inv())
    assert back.world_from_object is not None
    np.testing.assert_allclose(back.world_from_object.as_matrix(), pose.world_from_object.as_matrix(), atol=1e-11)
    np.testing.assert_allclose(back.covariance, pose.covariance, atol=1e-11)


def test_motion_between_viewed_poses_is_viewed_motion() -> None:
    rng = np.random.default_rng(6)
    camera = random_transform(rng)
    poses = [pose_with(rng, k) for k in range(2)]
    a, b = (p.world_from_object for p in poses)
    a_seen, b_seen = (view_of_pose(p, camera).world_from_object for p in poses)
    assert a is not None
    assert b is not None
    assert a_seen is not None
    assert b_seen is not None
    expected = camera * (b * a.inv()) * camera.inv()
    np.testing.assert_allclose((b_seen * a_seen.inv()).as_matrix(), expected.as_matrix(), atol=1e-11)


def test_viewed_trajectory_can_be_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    camera = random_transform(rng)
    statuses = (FrameStatus.TRACKED, FrameStatus.LOST, FrameStatus.COASTING, FrameStatus.TRACKED)
    frames = [pose_with(rng, k, status) for k, status in enumerate(statuses)]
    seen = trajectory_view(Trajectory(frames, ["a", "b"], "m"), camera)
    assert seen.unit == "m"
    assert seen.camera_names == ("a", "b")
    assert [f.status for f in seen] == [f.status for f in frames]
    assert seen[1].world_from_object is None
    assert (np.diag(seen[1].covariance) == np.inf).all()
    np.testing.assert_allclose(seen.rotation_angles, Trajectory(frames, ["a", "b"], "m").rotation_angles, atol=1e-12)
    with TrajectoryWriter(tmp_path, seen.camera_names, seen.unit) as writer:
        for pose in seen:
            writer.write(pose)
    read = read_trajectory(tmp_path / "trajectory.csv")
    np.testing.assert_allclose(read.positions, seen.positions, atol=1e-9)
    np.testing.assert_allclose(read[3].sigma, seen[3].sigma, rtol=1e-5)
    times, poses = read_tum(tmp_path / "trajectory.tum")
    assert len(times) == 2
    axes = RigidTransform.from_rotation(camera.rotation.inv())
    expected = [camera * f.world_from_object * axes for f in (frames[0], frames[3]) if f.world_from_object is not None]
    np.testing.assert_allclose(poses.as_matrix(), [e.as_matrix() for e in expected], atol=1e-9)


def test_viewed_trajectory_has_camera_as_world() -> None:
    """Orientation starts at zero, rotations are about the camera's axes, and positions are in its frame."""
    rng = np.random.default_rng(8)
    camera, step = random_transform(rng), Rotation.from_rotvec([0.0, 0.0, 0.3])
    about_z = camera.rotation.inv() * step * camera.rotation  # roll in the camera's axes
    poses = [RigidTransform.from_translation(rng.normal(size=3)) for _ in range(2)]
    poses[1] = RigidTransform.from_components(poses[1].translation, about_z)
    frames = [replace(pose_with(rng, k), world_from_object=pose) for k, pose in enumerate(poses)]
    seen = trajectory_view(Trajectory(frames, ["a", "b"]), camera)
    np.testing.assert_allclose(seen[0].pan_tilt_roll, 0, atol=1e-12)
    np.testing.assert_allclose(seen[1].pan_tilt_roll, [0, 0, 0.3], atol=1e-12)
    np.testing.assert_allclose(seen.positions, camera.apply([p.translation for p in poses]), atol=1e-12)


# --- Whose view -------------------------------------------------------------------------------------------------------


def test_cameras_are_looked_up_by_name() -> None:
    rig = ring(3)
    motion = motion_with(np.random.default_rng(8))
    by_name, by_camera = view_of_motion(motion, "cam_1", rig=rig), view_of_motion(motion, rig["cam_1"])
    by_pose = view_of_motion(motion, rig["cam_1"].camera_from_world)
    for view in (by_name, by_pose):
        np.testing.assert_array_equal(view.information, by_camera.information)
        np.testing.assert_array_equal(view.center, by_camera.center)


def test_unknown_camera_is_named() -> None:
    pose = pose_with(np.random.default_rng(9), 0)
    with pytest.raises(ValueError, match=r"camera: no 'cam_7' in the rig \(cam_0, cam_1\)"):
        view_of_pose(pose, "cam_7", rig=ring(2))
    with pytest.raises(ValueError, match="'cam_0' is given by name"):
        view_of_pose(pose, "cam_0")
    for wrong in (RigidTransform.identity(3), RigidTransform.from_translation([np.nan, 0, 0])):
        with pytest.raises(ValueError, match="single transform of finite values"):
            resolve_viewpoint(wrong)
