"""Constant-velocity model: prediction, weight of the prediction, and cameras with time offsets."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.limits import CUTOFF
from sylpose.rig import Rig
from sylpose.simulate import ellipsoid, ring
from sylpose.tracking.joint_side.joint_state import (
    AVERAGING_FRAMES,
    MAX_PREDICTION_ERROR,
    MIN_INTERVAL_RATIO,
    MotionModel,
    SolvedFrame,
    synchronize_rig,
)

CENTER = np.array([0.1, -0.2, 0.3])
DT = 1 / 30
# Half a rotation and half a meter per second.
TWIST = np.array([1.8, -2.0, 1.2, 0.3, -0.5, 0.2])


def make_rotation(angle: float) -> RigidTransform:
    """A rotation about z through the center."""
    return about_center(np.array([0.0, 0.0, angle]), np.zeros(3))


def about_center(turn: FloatArray, translation: FloatArray) -> RigidTransform:
    """The motion of (w, d) at the center."""
    rotation = Rotation.from_rotvec(turn)
    return RigidTransform.from_components(CENTER + translation - rotation.apply(CENTER), rotation)


def make_steady_model(frames: int = AVERAGING_FRAMES) -> MotionModel:
    """At TWIST, which changes by 0.01 rad/s and 0.002 length units/s per frame, in one direction each."""
    return MotionModel(TWIST, np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.002]) ** 2, frames, DT)


def prediction_information(elapsed: float) -> FloatArray:
    """(6, 6) information of the prediction of `make_steady_model`."""
    return np.asarray(np.diag(np.repeat([(CUTOFF * elapsed * 0.01) ** -2, (CUTOFF * elapsed * 0.002) ** -2], 3)))


def add_error(velocity: MotionModel, error: FloatArray, elapsed: float = DT) -> tuple[FloatArray, FloatArray]:
    """(R, d) that differ from the prediction by an error (6,) of (w, d)."""
    predicted_pose = velocity.predict_motion(elapsed)
    rotation = (Rotation.from_rotvec(error[:3]) * predicted_pose.rotation).as_matrix()
    return rotation, predicted_pose.apply(CENTER) - CENTER + error[3:]


def compute_error(
    velocity: MotionModel, rotation: FloatArray, translation: FloatArray, elapsed: float = DT
) -> FloatArray:
    """(6,) the inverse of `add_error`."""
    predicted_pose = velocity.predict_motion(elapsed)
    turn = (Rotation.from_matrix(rotation) * predicted_pose.rotation.inv()).as_rotvec()
    return np.concatenate([turn, translation - (predicted_pose.apply(CENTER) - CENTER)])


# --- prediction


@pytest.mark.parametrize("elapsed", [0.0, DT, 0.4, -0.2])
@pytest.mark.parametrize("axis_through", [CENTER, np.array([1.0, 0.5, -2.0])])
def test_prediction_is_exact_for_any_axis(elapsed: float, axis_through: FloatArray) -> None:
    turn = np.array([0.5, 1.0, -0.3])
    twist = np.concatenate([turn, np.cross(axis_through, turn) + np.array([0.1, 0.0, 0.2])])
    velocity, center = MotionModel(), CENTER
    for dt in (DT, 2 * DT, DT, 1.5 * DT):
        motion = RigidTransform.from_exp_coords(twist * dt)
        velocity = velocity.update(motion, center, dt)
        center = motion.apply(center)
    predicted, expected = velocity.predict_motion(elapsed), RigidTransform.from_exp_coords(twist * elapsed)
    np.testing.assert_allclose(predicted.as_matrix(), expected.as_matrix(), rtol=0, atol=1e-12)
    assert velocity.n_frames == 4
    # The velocity is constant, and the prediction is exact.
    assert np.sqrt(velocity.change_variance).max() < 1e-10


def test_unknown_velocity_predicts_no_motion() -> None:
    np.testing.assert_array_equal(MotionModel().predict_motion(3.0).as_matrix(), np.eye(4))


def test_update_does_not_modify_old_model() -> None:
    old = make_steady_model()
    before = [a.copy() for a in (old.twist, old.change_variance)]
    new = old.update(make_rotation(0.1), CENTER, DT)
    forgotten = old.reset(is_static=True)
    assert new is not old
    assert forgotten is not old
    for a, b in zip((old.twist, old.change_variance), before, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (old.n_frames, old.interval) == (AVERAGING_FRAMES, DT)
    with pytest.raises(FrozenInstanceError):
        old.n_frames = 0  # type: ignore[misc]


def test_prediction_uses_last_motion_only() -> None:
    velocity = make_steady_model().update(make_rotation(0.05), CENTER, DT)
    np.testing.assert_allclose(velocity.predict_motion(DT).as_matrix(), make_rotation(0.05).as_matrix(), atol=1e-12)


def test_change_variance_is_mean_square() -> None:
    """Few changes have equal weight; of many, the last ones have more."""
    angles = [0.10, 0.13, 0.11, 0.16]
    velocity = MotionModel()
    for angle in angles:
        velocity = velocity.update(make_rotation(angle), CENTER, DT)
    expected = np.mean((np.diff(angles) / DT) ** 2) * np.array([0, 0, 1, 0, 0, 0])
    np.testing.assert_allclose(velocity.change_variance, expected, rtol=1e-9, atol=1e-20)
    # After many equal changes, a zero change reduces the mean by its weight only.
    for k in range(40):
        velocity = velocity.update(make_rotation(0.1 + 0.02 * (k % 2)), CENTER, DT)
    usual = (0.02 / DT) ** 2
    assert velocity.change_variance[2] == pytest.approx(usual, rel=1e-3)
    quiet = velocity.update(make_rotation(0.12), CENTER, DT)
    assert quiet.change_variance[2] == pytest.approx(usual * (1 - 1 / AVERAGING_FRAMES), rel=1e-3)


def test_position_change_is_that_of_center() -> None:
    """A changing rotation about the center moves the world's origin, but not the object."""
    velocity = MotionModel().update(make_rotation(0.1), CENTER, DT).update(make_rotation(0.2), CENTER, DT)
    assert velocity.change_variance[3:].max() < 1e-20
    shifted = MotionModel().update(make_rotation(0.1), CENTER, DT)
    shifted = shifted.update(about_center(np.array([0, 0, 0.1]), np.array([0.03, 0, 0])), CENTER, DT)
    np.testing.assert_allclose(shifted.change_variance, [0, 0, 0, (0.03 / DT) ** 2, 0, 0], rtol=1e-9, atol=1e-20)


@pytest.mark.parametrize(("share", "learns"), [(0.99, False), (1.01, True)])
def test_very_short_interval_is_ignored(share: float, learns: bool) -> None:
    velocity = MotionModel().update(make_rotation(0.1), CENTER, DT).update(make_rotation(0.1), CENTER, DT)
    again = velocity.update(make_rotation(0.3), CENTER, share * MIN_INTERVAL_RATIO * DT)
    assert (again is not velocity) == learns
    # The first interval is always used, as there is no usual one.
    assert MotionModel().update(make_rotation(0.1), CENTER, 0.0).n_frames == 1
    # So is the first after a gap.
    assert velocity.reset(is_static=False).update(make_rotation(0.1), CENTER, 0.01 * DT).n_frames == 1


def test_usual_interval_adapts() -> None:
    """A very short interval at one frame rate is the usual one at another."""
    velocity, fast = MotionModel().update(make_rotation(0.1), CENTER, DT), 0.5 * MIN_INTERVAL_RATIO * DT
    intervals = [2 * DT, 3 * DT, 2 * DT, 0.5 * DT]
    expected = DT
    for interval in intervals:
        velocity = velocity.update(make_rotation(0.1), CENTER, interval)
        expected += (interval - expected) / AVERAGING_FRAMES
    assert velocity.interval == pytest.approx(expected)
    for _ in range(30):
        velocity = velocity.update(make_rotation(0.1), CENTER, 0.3 * velocity.interval)
    assert velocity.update(make_rotation(0.3), CENTER, fast) is not velocity


@pytest.mark.parametrize("stands", [True, False])
def test_reset_keeps_change_variance(stands: bool) -> None:
    velocity = make_steady_model()
    forgotten = velocity.reset(is_static=stands)
    assert forgotten.n_frames == 0
    np.testing.assert_array_equal(forgotten.twist, np.zeros(6) if stands else TWIST)
    np.testing.assert_array_equal(forgotten.change_variance, velocity.change_variance)
    assert forgotten.interval == velocity.interval


def test_first_motion_after_gap_is_no_change() -> None:
    again = make_steady_model().reset(is_static=True).update(make_rotation(1.0), CENTER, DT)
    np.testing.assert_array_equal(again.change_variance, make_steady_model().change_variance)
    assert again.n_frames == 1


# --- predicted covariance


def test_covariance_is_infinite_before_two_motions() -> None:
    one = MotionModel().update(make_rotation(0.1), CENTER, DT)
    for unknown in (MotionModel(), one):
        assert np.isposinf(unknown.predict_covariance(DT, 1)).all()
    two = one.update(make_rotation(0.13), CENTER, DT)
    assert np.isfinite(two.predict_covariance(DT, 1)).all()
    assert two.predict_covariance(DT, 1)[2, 2] > 0


def test_covariance_grows_with_missed_frames_and_time() -> None:
    velocity = make_steady_model()
    one = velocity.predict_covariance(DT, 1)
    np.testing.assert_allclose(one, np.diag(velocity.change_variance) * DT**2)
    np.testing.assert_allclose(velocity.predict_covariance(DT, 4), 4 * one)
    np.testing.assert_allclose(velocity.predict_covariance(3 * DT, 1), 9 * one)


def test_covariance_is_variance_of_next_motion() -> None:
    """For an object with a different velocity in every frame."""
    rng = np.random.default_rng(0)
    velocity, spreads, squares = MotionModel(), [], []
    for k, angle in enumerate(rng.normal(0.1, 0.02, 600)):
        if k > AVERAGING_FRAMES:
            spreads.append(velocity.predict_covariance(DT, 1)[2, 2])
            squares.append((velocity.predict_motion(DT).rotation.as_rotvec()[2] - angle) ** 2)
        velocity = velocity.update(make_rotation(angle), CENTER, DT)
    assert 0.85 < np.mean(spreads) / np.mean(squares) < 1.15


# --- fusion with the prediction


@pytest.mark.parametrize(("frames", "counts"), [(0, False), (AVERAGING_FRAMES - 1, False), (AVERAGING_FRAMES, True)])
def test_prediction_is_used_after_steady_frames(frames: int, counts: bool) -> None:
    velocity = make_steady_model(frames)
    rotation, translation = add_error(velocity, np.full(6, 1e-4))
    found = velocity.fuse(rotation, translation, np.eye(6), CENTER, DT)
    assert (found[0] is not rotation) == (found[1] is not translation) == counts
    assert np.array_equal(found[2], np.eye(6)) != counts


@pytest.mark.parametrize(("part", "scale"), [(0, 0.01), (5, 0.002)])
@pytest.mark.parametrize(("share", "counts"), [(0.98, True), (1.02, False)])
def test_contradicting_matches_override_prediction(part: int, scale: float, share: float, counts: bool) -> None:
    """The object has started, stopped or reversed: on both sides of the chi-squared bound."""
    velocity, sharp = make_steady_model(), 1e14 * np.eye(6)
    error = np.zeros(6)
    error[part] = share * np.sqrt(MAX_PREDICTION_ERROR) * CUTOFF * DT * scale
    rotation, translation = add_error(velocity, error)
    _, _, information = velocity.fuse(rotation, translation, sharp, CENTER, DT)
    assert (information is not sharp) == counts
    # Uncertain matches do not contradict the same prediction.
    _, _, weak = velocity.fuse(rotation, translation, 1e-6 * np.eye(6), CENTER, DT)
    np.testing.assert_allclose(weak, prediction_information(DT), rtol=1e-6)


@pytest.mark.parametrize("strength", [1e-3, 0.1, 1.0, 10.0, 1e3])
def test_fusion_weights_by_information(strength: float) -> None:
    """With information of so many times the prediction's, this share of the error remains."""
    velocity = make_steady_model()
    error = np.array([1e-4, -2e-4, 1e-4, 1e-4, 1e-4, -1e-4])
    found = velocity.fuse(*add_error(velocity, error), strength * prediction_information(DT), CENTER, DT)
    left = compute_error(velocity, found[0], found[1])
    np.testing.assert_allclose(left, strength / (1 + strength) * error, rtol=1e-3, atol=1e-9)


def random_information(rng: np.random.Generator) -> FloatArray:
    """(6, 6), of any rank."""
    scale = np.repeat([300.0, 2000.0], 3)
    root = rng.standard_normal((6, int(rng.integers(1, 12)))) * scale[:, None]
    return np.asarray(root @ root.T)


def test_information_never_decreases() -> None:
    rng = np.random.default_rng(1)
    velocity = make_steady_model()
    for _ in range(50):
        information = random_information(rng)
        error = np.repeat([1e-4, 2e-5], 3) * rng.standard_normal(6)
        _, _, both = velocity.fuse(*add_error(velocity, error), information, CENTER, DT)
        gained = np.linalg.eigvalsh(both - information)
        assert gained.min() > 0
        np.testing.assert_allclose(both - information, prediction_information(DT), rtol=1e-6, atol=1e-3)


def test_fusion_is_product_of_gaussians() -> None:
    """Kalman gain of the prediction's covariance, with the matches as measurement: up to the square of angles."""
    rng = np.random.default_rng(2)
    velocity = make_steady_model()
    for _ in range(50):
        information = random_information(rng) + np.diag(np.repeat([10.0, 100.0], 3))
        prior, measured = np.linalg.inv(prediction_information(DT)), np.linalg.inv(information)
        error = np.repeat([3e-4, 6e-5], 3) * rng.uniform(-1, 1, 6)
        expected = prior @ np.linalg.solve(prior + measured, error)
        rotation, translation, both = velocity.fuse(*add_error(velocity, error), information, CENTER, DT)
        np.testing.assert_allclose(compute_error(velocity, rotation, translation), expected, rtol=0, atol=1e-7)
        # ... which is a considerable part of the correction.
        assert np.abs(expected - error).max() > 1e-6
        posterior = prior - prior @ np.linalg.solve(prior + measured, prior)
        np.testing.assert_allclose(both @ posterior, np.eye(6), atol=1e-4)


# --- time offsets


@pytest.fixture(scope="module")
def rig() -> Rig:
    return ring(3, 1.5, 1000.0, height=(0.4, -0.1, 0.2), distortion=(-0.1, 0.02, 0.0, 0.0))


TIME_OFFSETS = np.array([0.01, -0.02, 0.005])
MOTION = RigidTransform.from_exp_coords(TWIST * DT)


def test_zero_offsets_keep_cameras(rig: Rig) -> None:
    assert synchronize_rig(rig, np.zeros(3), TWIST) is rig


def test_static_object_needs_no_time_correction(rig: Rig) -> None:
    twist = make_steady_model().estimate_twist(CENTER, RigidTransform.identity(), DT)
    assert synchronize_rig(rig, TIME_OFFSETS, twist) is rig


@pytest.mark.parametrize("elapsed", [DT, 0.2])
def test_time_correction_is_exact_for_uniform_motion(rig: Rig, elapsed: float) -> None:
    """Exactly, while no velocity change has been observed."""
    motion = RigidTransform.from_exp_coords(TWIST * elapsed)
    twist = MotionModel(n_frames=9).estimate_twist(CENTER, motion, elapsed)
    np.testing.assert_allclose(twist, TWIST, atol=1e-9)
    at_once = synchronize_rig(rig, TIME_OFFSETS, twist)
    points = CENTER + ellipsoid((0.15, 0.1, 0.12), n=50).points
    assert at_once.names == rig.names
    assert at_once.unit == rig.unit
    for camera, moved, seconds in zip(rig, at_once, TIME_OFFSETS, strict=True):
        seen = camera.project(RigidTransform.from_exp_coords(TWIST * seconds).apply(points))
        np.testing.assert_allclose(moved.project(points), seen, rtol=0, atol=1e-6)
        assert np.linalg.norm(camera.project(points) - seen, axis=1).max() > 2
        np.testing.assert_array_equal(moved.matrix, camera.matrix)


def test_only_cameras_with_offset_are_corrected(rig: Rig) -> None:
    at_once = synchronize_rig(rig, np.array([0.0, 0.01, 0.0]), TWIST)
    gaps = [np.linalg.norm(a.center - b.center) for a, b in zip(rig, at_once, strict=True)]
    assert max(gaps[0], gaps[2]) < 1e-12
    assert gaps[1] > 1e-3


def test_velocity_equal_to_its_change_has_half_weight(rig: Rig) -> None:
    speed = np.concatenate([TWIST[:3], np.cross(TWIST[:3], CENTER) + TWIST[3:]])
    unsteady = replace(make_steady_model(), change_variance=speed[[1, 2, 0, 5, 3, 4]] ** 2)
    found = synchronize_rig(rig, TIME_OFFSETS, unsteady.estimate_twist(CENTER, MOTION, DT))
    half = synchronize_rig(rig, TIME_OFFSETS / 2, TWIST)
    for a, b in zip(found, half, strict=True):
        np.testing.assert_allclose(a.camera_from_world.as_matrix(), b.camera_from_world.as_matrix(), atol=1e-12)


def test_weight_decreases_with_velocity_change(rig: Rig) -> None:
    moved = []
    for change in (0.0, 0.3, 1.0, 3.0, 30.0):
        velocity = MotionModel(change_variance=np.full(6, change**2))
        at_once = synchronize_rig(rig, TIME_OFFSETS, velocity.estimate_twist(CENTER, MOTION, DT))
        moved.append(np.linalg.norm(at_once.cameras[1].center - rig.cameras[1].center))
    assert (np.diff(moved) < 0).all()
    assert moved[-1] < 0.01 * moved[0]


def test_offset_error_is_the_distance_by_which_a_prediction_fails() -> None:
    """The points of an object that changes its velocity by one standard deviation move by about as much more."""
    change = np.array([0.3, -0.2, 0.1, 0.02, 0.01, -0.03])
    model = replace(make_steady_model(), change_variance=change**2, n_frames=9)
    predicted = model.predict_offset_error(TIME_OFFSETS, 0.1)
    points = 0.1 * ellipsoid((1.0, 1.0, 1.0), n=500).points
    for seconds, error in zip(TIME_OFFSETS, predicted, strict=True):
        moved = RigidTransform.from_exp_coords(change * seconds).apply(points)
        assert 0.5 * error < np.linalg.norm(moved - points, axis=1).mean() < error


def test_offset_error_is_unknown_before_several_motions() -> None:
    np.testing.assert_array_equal(MotionModel().predict_offset_error(np.array([0.0, 0.01]), 0.1), [0.0, np.inf])


def test_pose_in_a_camera_is_that_at_its_own_time(rig: Rig) -> None:
    pose = RigidTransform.from_translation(CENTER)
    empty = np.empty((3, 3))
    solved = SolvedFrame(0, 0.0, TIME_OFFSETS, pose, np.eye(6), empty, np.ones(3, bool), twist=TWIST)
    for c, camera in enumerate(rig):
        moved = RigidTransform.from_exp_coords(TWIST * TIME_OFFSETS[c]) * pose
        found = solved.camera_from_object(camera, c)
        assert found is not None
        expected = camera.camera_from_world * moved
        np.testing.assert_allclose(found, expected.as_matrix(), atol=1e-12)
        assert replace(solved, twist=np.full(6, np.nan)).camera_from_object(camera, c) is None
