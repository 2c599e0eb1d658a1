"""Constant velocity: what it predicts, how far it is believed, and the cameras that are late."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import ellipsoid, ring
from sylpose.tracking.motion_model import MEMORY, SHORT, SPREAD, STEADY_FRAMES, SURPRISING, Velocity

CENTER = np.array([0.1, -0.2, 0.3])
DT = 1 / 30
# Half a turn and half a metre per second.
TWIST = np.array([1.8, -2.0, 1.2, 0.3, -0.5, 0.2])


def turned_by(angle: float) -> RigidTransform:
    """A turn about z through the centre."""
    return about_center(np.array([0.0, 0.0, angle]), np.zeros(3))


def about_center(turn: FloatArray, shift: FloatArray) -> RigidTransform:
    """The motion of (w, d) at the centre."""
    rotation = Rotation.from_rotvec(turn)
    return RigidTransform.from_components(CENTER + shift - rotation.apply(CENTER), rotation)


def steady(frames: int = STEADY_FRAMES) -> Velocity:
    """At TWIST, which changes by 0.01 rad/s and 0.002 length units/s a frame, in one direction each."""
    return Velocity(TWIST, np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.002]) ** 2, frames, DT)


def weighed(elapsed: float) -> FloatArray:
    """(6, 6) the information of what `steady` predicts."""
    return np.asarray(np.diag(np.repeat([(SPREAD * elapsed * 0.01) ** -2, (SPREAD * elapsed * 0.002) ** -2], 3)))


def off(velocity: Velocity, error: FloatArray, elapsed: float = DT) -> tuple[FloatArray, FloatArray]:
    """(R, d) that differ from what the velocity gives by an error (6,) of (w, d)."""
    ahead = velocity.motion(elapsed)
    rotation = (Rotation.from_rotvec(error[:3]) * ahead.rotation).as_matrix()
    return rotation, ahead.apply(CENTER) - CENTER + error[3:]


def error_of(velocity: Velocity, rotation: FloatArray, shift: FloatArray, elapsed: float = DT) -> FloatArray:
    """(6,) the inverse of `off`."""
    ahead = velocity.motion(elapsed)
    turn = (Rotation.from_matrix(rotation) * ahead.rotation.inv()).as_rotvec()
    return np.concatenate([turn, shift - (ahead.apply(CENTER) - CENTER)])


# --- what it predicts


@pytest.mark.parametrize("elapsed", [0.0, DT, 0.4, -0.2])
@pytest.mark.parametrize("axis_through", [CENTER, np.array([1.0, 0.5, -2.0])])
def test_constant_velocity_is_predicted_exactly_also_about_an_axis_off_the_centre(
    elapsed: float, axis_through: FloatArray
) -> None:
    turn = np.array([0.5, 1.0, -0.3])
    twist = np.concatenate([turn, np.cross(axis_through, turn) + np.array([0.1, 0.0, 0.2])])
    velocity, center = Velocity(), CENTER
    for dt in (DT, 2 * DT, DT, 1.5 * DT):
        motion = RigidTransform.from_exp_coords(twist * dt)
        velocity = velocity.learnt(motion, center, dt)
        center = motion.apply(center)
    predicted, expected = velocity.motion(elapsed), RigidTransform.from_exp_coords(twist * elapsed)
    np.testing.assert_allclose(predicted.as_matrix(), expected.as_matrix(), rtol=0, atol=1e-12)
    assert velocity.frames == 4
    # It did not change, and where it is going to be is known.
    assert np.sqrt(velocity.unsteady).max() < 1e-10


def test_nothing_known_nothing_moves() -> None:
    np.testing.assert_array_equal(Velocity().motion(3.0).as_matrix(), np.eye(4))


def test_learning_makes_a_new_one_and_leaves_the_old() -> None:
    old = steady()
    before = [a.copy() for a in (old.twist, old.unsteady)]
    new = old.learnt(turned_by(0.1), CENTER, DT)
    forgotten = old.forgotten(stands=True)
    assert new is not old
    assert forgotten is not old
    for a, b in zip((old.twist, old.unsteady), before, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (old.frames, old.interval) == (STEADY_FRAMES, DT)
    with pytest.raises(FrozenInstanceError):
        old.frames = 0  # type: ignore[misc]


def test_only_the_last_motion_counts() -> None:
    velocity = steady().learnt(turned_by(0.05), CENTER, DT)
    np.testing.assert_allclose(velocity.motion(DT).as_matrix(), turned_by(0.05).as_matrix(), atol=1e-12)


def test_the_usual_change_is_the_mean_square_of_the_changes() -> None:
    """Of a few all alike, of many the last ones most."""
    angles = [0.10, 0.13, 0.11, 0.16]
    velocity = Velocity()
    for angle in angles:
        velocity = velocity.learnt(turned_by(angle), CENTER, DT)
    expected = np.mean((np.diff(angles) / DT) ** 2) * np.array([0, 0, 1, 0, 0, 0])
    np.testing.assert_allclose(velocity.unsteady, expected, rtol=1e-9, atol=1e-20)
    # After many alike changes, one of none lowers it by its share alone.
    for k in range(40):
        velocity = velocity.learnt(turned_by(0.1 + 0.02 * (k % 2)), CENTER, DT)
    usual = (0.02 / DT) ** 2
    assert velocity.unsteady[2] == pytest.approx(usual, rel=1e-3)
    quiet = velocity.learnt(turned_by(0.12), CENTER, DT)
    assert quiet.unsteady[2] == pytest.approx(usual * (1 - 1 / MEMORY), rel=1e-3)


def test_a_change_of_place_is_the_centres() -> None:
    """A turn about the centre that changes moves the world's origin, but not the object."""
    velocity = Velocity().learnt(turned_by(0.1), CENTER, DT).learnt(turned_by(0.2), CENTER, DT)
    assert velocity.unsteady[3:].max() < 1e-20
    shifted = Velocity().learnt(turned_by(0.1), CENTER, DT)
    shifted = shifted.learnt(about_center(np.array([0, 0, 0.1]), np.array([0.03, 0, 0])), CENTER, DT)
    np.testing.assert_allclose(shifted.unsteady, [0, 0, 0, (0.03 / DT) ** 2, 0, 0], rtol=1e-9, atol=1e-20)


@pytest.mark.parametrize(("share", "learns"), [(0.99, False), (1.01, True)])
def test_two_frames_at_nearly_the_same_time_teach_nothing(share: float, learns: bool) -> None:
    velocity = Velocity().learnt(turned_by(0.1), CENTER, DT).learnt(turned_by(0.1), CENTER, DT)
    again = velocity.learnt(turned_by(0.3), CENTER, share * SHORT * DT)
    assert (again is not velocity) == learns
    # The first ever is taken whatever its interval, as there is no usual one.
    assert Velocity().learnt(turned_by(0.1), CENTER, 0.0).frames == 1
    # So is the first after a gap.
    assert velocity.forgotten(stands=False).learnt(turned_by(0.1), CENTER, 0.01 * DT).frames == 1


def test_the_usual_interval_goes_with_the_frames() -> None:
    """What was nearly the same time at one rate is the usual interval at another."""
    velocity, fast = Velocity().learnt(turned_by(0.1), CENTER, DT), 0.5 * SHORT * DT
    intervals = [2 * DT, 3 * DT, 2 * DT, 0.5 * DT]
    expected = DT
    for interval in intervals:
        velocity = velocity.learnt(turned_by(0.1), CENTER, interval)
        expected += (interval - expected) / MEMORY
    assert velocity.interval == pytest.approx(expected)
    for _ in range(30):
        velocity = velocity.learnt(turned_by(0.1), CENTER, 0.3 * velocity.interval)
    assert velocity.learnt(turned_by(0.3), CENTER, fast) is not velocity


@pytest.mark.parametrize("stands", [True, False])
def test_what_is_forgotten_is_the_velocity_of_what_stands_and_never_the_usual_change(stands: bool) -> None:
    velocity = steady()
    forgotten = velocity.forgotten(stands=stands)
    assert forgotten.frames == 0
    np.testing.assert_array_equal(forgotten.twist, np.zeros(6) if stands else TWIST)
    np.testing.assert_array_equal(forgotten.unsteady, velocity.unsteady)
    assert forgotten.interval == velocity.interval


def test_after_a_gap_the_first_motion_is_no_change() -> None:
    again = steady().forgotten(stands=True).learnt(turned_by(1.0), CENTER, DT)
    np.testing.assert_array_equal(again.unsteady, steady().unsteady)
    assert again.frames == 1


# --- how far it is believed


def test_the_spread_is_infinite_until_two_motions_were_seen() -> None:
    one = Velocity().learnt(turned_by(0.1), CENTER, DT)
    for unknown in (Velocity(), one):
        assert np.isposinf(unknown.spread(DT, 1)).all()
    two = one.learnt(turned_by(0.13), CENTER, DT)
    assert np.isfinite(two.spread(DT, 1)).all()
    assert two.spread(DT, 1)[2, 2] > 0


def test_the_spread_grows_with_the_frames_missed_and_the_square_of_time() -> None:
    velocity = steady()
    one = velocity.spread(DT, 1)
    np.testing.assert_allclose(one, np.diag(velocity.unsteady) * DT**2)
    np.testing.assert_allclose(velocity.spread(DT, 4), 4 * one)
    np.testing.assert_allclose(velocity.spread(3 * DT, 1), 9 * one)


def test_the_spread_is_the_variance_of_what_comes_next() -> None:
    """Of an object that has another velocity in every frame."""
    rng = np.random.default_rng(0)
    velocity, spreads, squares = Velocity(), [], []
    for k, angle in enumerate(rng.normal(0.1, 0.02, 600)):
        if k > MEMORY:
            spreads.append(velocity.spread(DT, 1)[2, 2])
            squares.append((velocity.motion(DT).rotation.as_rotvec()[2] - angle) ** 2)
        velocity = velocity.learnt(turned_by(angle), CENTER, DT)
    assert 0.85 < np.mean(spreads) / np.mean(squares) < 1.15


# --- one more measurement


@pytest.mark.parametrize(("frames", "counts"), [(0, False), (STEADY_FRAMES - 1, False), (STEADY_FRAMES, True)])
def test_it_counts_once_it_has_been_steady(frames: int, counts: bool) -> None:
    velocity = steady(frames)
    rotation, shift = off(velocity, np.full(6, 1e-4))
    found = velocity.added_to(rotation, shift, np.eye(6), CENTER, DT)
    assert (found[0] is not rotation) == (found[1] is not shift) == counts
    assert np.array_equal(found[2], np.eye(6)) != counts


@pytest.mark.parametrize(("part", "scale"), [(0, 0.01), (5, 0.002)])
@pytest.mark.parametrize(("share", "counts"), [(0.98, True), (1.02, False)])
def test_a_surprise_is_believed_to_the_matches(part: int, scale: float, share: float, counts: bool) -> None:
    """The object has started, stopped or turned round: to both sides of chi-squared's bound."""
    velocity, sharp = steady(), 1e14 * np.eye(6)
    error = np.zeros(6)
    error[part] = share * np.sqrt(SURPRISING) * SPREAD * DT * scale
    rotation, shift = off(velocity, error)
    _, _, information = velocity.added_to(rotation, shift, sharp, CENTER, DT)
    assert (information is not sharp) == counts
    # Matches that know no better are not surprised by the same.
    _, _, weak = velocity.added_to(rotation, shift, 1e-6 * np.eye(6), CENTER, DT)
    np.testing.assert_allclose(weak, weighed(DT), rtol=1e-6)


@pytest.mark.parametrize("strength", [1e-3, 0.1, 1.0, 10.0, 1e3])
def test_a_weak_measurement_is_pulled_to_the_prediction_and_a_strong_one_hardly(strength: float) -> None:
    """Of information that is so many times the prediction's, this share of the error is left."""
    velocity = steady()
    error = np.array([1e-4, -2e-4, 1e-4, 1e-4, 1e-4, -1e-4])
    found = velocity.added_to(*off(velocity, error), strength * weighed(DT), CENTER, DT)
    left = error_of(velocity, found[0], found[1])
    np.testing.assert_allclose(left, strength / (1 + strength) * error, rtol=1e-3, atol=1e-9)


def random_information(rng: np.random.Generator) -> FloatArray:
    """(6, 6), of any rank."""
    scale = np.repeat([300.0, 2000.0], 3)
    root = rng.standard_normal((6, int(rng.integers(1, 12)))) * scale[:, None]
    return np.asarray(root @ root.T)


def test_information_never_falls() -> None:
    rng = np.random.default_rng(1)
    velocity = steady()
    for _ in range(50):
        information = random_information(rng)
        error = np.repeat([1e-4, 2e-5], 3) * rng.standard_normal(6)
        _, _, both = velocity.added_to(*off(velocity, error), information, CENTER, DT)
        gained = np.linalg.eigvalsh(both - information)
        assert gained.min() > 0
        np.testing.assert_allclose(both - information, weighed(DT), rtol=1e-6, atol=1e-3)


def test_it_is_the_product_of_two_gaussians_for_small_angles() -> None:
    """Kalman's gain of the prediction's covariance, with the matches as what is measured: up to the square of angles."""
    rng = np.random.default_rng(2)
    velocity = steady()
    for _ in range(50):
        information = random_information(rng) + np.diag(np.repeat([10.0, 100.0], 3))
        prior, measured = np.linalg.inv(weighed(DT)), np.linalg.inv(information)
        error = np.repeat([3e-4, 6e-5], 3) * rng.uniform(-1, 1, 6)
        expected = prior @ np.linalg.solve(prior + measured, error)
        rotation, shift, both = velocity.added_to(*off(velocity, error), information, CENTER, DT)
        np.testing.assert_allclose(error_of(velocity, rotation, shift), expected, rtol=0, atol=1e-7)
        # ... which is no small part of what was done.
        assert np.abs(expected - error).max() > 1e-6
        posterior = prior - prior @ np.linalg.solve(prior + measured, prior)
        np.testing.assert_allclose(both @ posterior, np.eye(6), atol=1e-4)


# --- cameras that are late


@pytest.fixture(scope="module")
def rig() -> Rig:
    return ring(3, 1.5, 1000.0, height=(0.4, -0.1, 0.2), distortion=(-0.1, 0.02, 0.0, 0.0))


LATE = np.array([0.01, -0.02, 0.005])
MOTION = RigidTransform.from_exp_coords(TWIST * DT)


def test_cameras_that_are_not_late_stay_where_they_are(rig: Rig) -> None:
    assert steady().rig_seen_at_once(rig, np.zeros(3), CENTER, MOTION, DT) is rig


def test_of_what_stands_all_cameras_see_the_same_whenever_they_look(rig: Rig) -> None:
    assert steady().rig_seen_at_once(rig, LATE, CENTER, RigidTransform.identity(), DT) is rig


@pytest.mark.parametrize("elapsed", [DT, 0.2])
def test_a_late_camera_sees_a_uniform_motion_as_one_that_is_moved_sees_the_instant(rig: Rig, elapsed: float) -> None:
    """Exactly, while the speed was never seen to change."""
    motion = RigidTransform.from_exp_coords(TWIST * elapsed)
    at_once = Velocity(frames=9).rig_seen_at_once(rig, LATE, CENTER, motion, elapsed)
    points = CENTER + ellipsoid((0.15, 0.1, 0.12), n=50).points
    assert at_once.names == rig.names
    assert at_once.unit == rig.unit
    for camera, moved, seconds in zip(rig, at_once, LATE, strict=True):
        seen = camera.project(RigidTransform.from_exp_coords(TWIST * seconds).apply(points))
        np.testing.assert_allclose(moved.project(points), seen, rtol=0, atol=1e-6)
        assert np.linalg.norm(camera.project(points) - seen, axis=1).max() > 2
        np.testing.assert_array_equal(moved.matrix, camera.matrix)


def test_only_late_cameras_are_moved(rig: Rig) -> None:
    at_once = Velocity().rig_seen_at_once(rig, np.array([0.0, 0.01, 0.0]), CENTER, MOTION, DT)
    gaps = [np.linalg.norm(a.center - b.center) for a, b in zip(rig, at_once, strict=True)]
    assert max(gaps[0], gaps[2]) < 1e-12
    assert gaps[1] > 1e-3


def test_a_speed_that_changes_by_as_much_as_it_is_is_believed_half(rig: Rig) -> None:
    speed = np.concatenate([TWIST[:3], np.cross(TWIST[:3], CENTER) + TWIST[3:]])
    unsteady = replace(steady(), unsteady=speed[[1, 2, 0, 5, 3, 4]] ** 2)
    found = unsteady.rig_seen_at_once(rig, LATE, CENTER, MOTION, DT)
    half = Velocity().rig_seen_at_once(rig, LATE / 2, CENTER, MOTION, DT)
    for a, b in zip(found, half, strict=True):
        np.testing.assert_allclose(a.camera_from_world.as_matrix(), b.camera_from_world.as_matrix(), atol=1e-12)


def test_the_less_steady_the_less_is_believed(rig: Rig) -> None:
    moved = []
    for change in (0.0, 0.3, 1.0, 3.0, 30.0):
        velocity = Velocity(unsteady=np.full(6, change**2))
        at_once = velocity.rig_seen_at_once(rig, LATE, CENTER, MOTION, DT)
        moved.append(np.linalg.norm(at_once.cameras[1].center - rig.cameras[1].center))
    assert (np.diff(moved) < 0).all()
    assert moved[-1] < 0.01 * moved[0]
