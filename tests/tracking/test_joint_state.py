"""Shared tracker state between two frames, and the uncertainty of poses that depend on other frames."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.results import MAX_ROTATION_SD
from sylpose.simulate import ring
from sylpose.tracking.camera_side.frame import count_ages, expand_ages
from sylpose.tracking.joint_side.joint_state import (
    Anchor,
    JointState,
    KnownFrames,
    MotionModel,
    SolvedFrame,
    add_reference_covariance,
    compute_viewpoints,
)
from sylpose.tracking.joint_side.object_model import ObjectModel
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.reports import PoseAgreement

RIG = ring(3, 1.5, 1000.0, height=(0.4, -0.1, 0.2))
DT = 1 / 30
TWIST = np.array([1.0, -2.0, 0.5, 0.3, 0.1, -0.4])
START = RigidTransform.from_components([0.03, -0.02, 0.05], Rotation.from_rotvec([0.2, 0.1, -0.3]))
STEP = RigidTransform.from_exp_coords(TWIST * DT)
RADIUS = 0.2
N_STRONG = TrackingOptions.min_strong_inliers


def pose_at(frames: float) -> RigidTransform:
    """Return the pose after so many frames at constant velocity."""
    return RigidTransform.from_exp_coords(TWIST * DT * frames) * START


def make_solved(number: int, pose: RigidTransform | None = None, covariance: FloatArray | None = None) -> SolvedFrame:
    pose = pose_at(number) if pose is None else pose
    covariance = 1e-6 * np.eye(6) if covariance is None else covariance
    n = len(RIG)
    views = compute_viewpoints(RIG, pose)
    return SolvedFrame(number, number * DT, np.zeros(n), pose, covariance, views, np.ones(n, bool), landmark_age=3.0)


def make_first_state() -> JointState:
    return JointState(ObjectModel(np.zeros(3), RADIUS), KnownFrames(make_solved(0), (make_solved(0),)))


def with_motion(state: JointState, **changes: Any) -> JointState:
    """Return the state with some fields of its motion replaced."""
    return replace(state, motion=replace(state.motion, **changes))


def with_frames(state: JointState, **changes: Any) -> JointState:
    """Return the state with some of its known frames replaced."""
    return replace(state, frames=replace(state.frames, **changes))


def make_state_after(frames: int) -> JointState:
    """Return the state after frames at constant velocity, all solved from tracked features."""
    state = with_frames(make_first_state(), anchor=Anchor(make_solved(0)))
    for k in range(1, frames + 1):
        state = state.add_solved_frame(make_solved(k), STEP, TrackingOptions(), has_new_features=False)
    return state


# --- from frame to frame


def test_first_frame_is_only_keyframe() -> None:
    state = make_first_state()
    assert state.last.number == 0
    assert [k.number for k in state.frames.keyframes] == [0]
    assert list(state.frames.by_number) == [0]
    np.testing.assert_array_equal(state.predict_pose(5.0).as_matrix(), START.as_matrix())


@pytest.mark.parametrize("ahead", [0.0, 1.0, 7.5])
def test_constant_velocity_prediction_is_exact(ahead: float) -> None:
    state = make_state_after(1)
    np.testing.assert_allclose(
        state.predict_pose((1 + ahead) * DT).as_matrix(), pose_at(1 + ahead).as_matrix(), atol=1e-12
    )
    # ... while a lost object is predicted at its last pose.
    lost = with_motion(state, is_lost=True)
    np.testing.assert_array_equal(lost.predict_pose((1 + ahead) * DT).as_matrix(), pose_at(1).as_matrix())


def test_velocity_uses_elapsed_time() -> None:
    """A skipped frame means twice the time and twice the motion."""
    state = make_first_state().add_solved_frame(make_solved(2), STEP * STEP, TrackingOptions(), has_new_features=False)
    np.testing.assert_allclose(state.predict_pose(3 * DT).as_matrix(), pose_at(3).as_matrix(), atol=1e-12)


def test_changing_rotation_about_center_is_no_translation() -> None:
    state, pose = make_first_state(), START
    for k, angle in enumerate((0.1, 0.2, 0.15), 1):
        turn = Rotation.from_rotvec([0, 0, angle])
        motion = RigidTransform.from_components(START.translation - turn.apply(START.translation), turn)
        pose = motion * pose
        state = state.add_solved_frame(make_solved(k, pose), motion, TrackingOptions(), has_new_features=False)
    assert state.motion.velocity.change_variance[3:].max() < 1e-20
    assert state.motion.velocity.change_variance[2] > 1


def test_accepted_frame_does_not_modify_old_state() -> None:
    old = make_state_after(3)
    keyframes, anchor, twist = old.frames.keyframes, old.frames.anchor, old.motion.velocity.twist.copy()
    far = RigidTransform.from_rotation(Rotation.from_rotvec([0, 1.0, 0]))
    new = old.add_solved_frame(make_solved(4, far * pose_at(3)), far, TrackingOptions(), has_new_features=True)
    assert (old.last.number, old.frames.keyframes, old.frames.anchor) == (3, keyframes, anchor)
    np.testing.assert_array_equal(old.motion.velocity.twist, twist)
    assert new.last.number == 4
    for change in ("motion", "frames", "object"):
        with pytest.raises(FrozenInstanceError):
            setattr(old, change, None)


@pytest.mark.parametrize(("anew", "turn", "kept"), [(True, 0.5, True), (False, 0.5, False), (True, 0.01, False)])
def test_keyframes_need_new_features_and_new_views(anew: bool, turn: float, kept: bool) -> None:
    motion = RigidTransform.from_rotation(Rotation.from_rotvec([0, turn, 0]))
    state = make_first_state().add_solved_frame(
        make_solved(1, motion * START), motion, TrackingOptions(), has_new_features=anew
    )
    assert [k.number for k in state.frames.keyframes] == ([0, 1] if kept else [0])
    assert state.last.number == 1


def make_agreement(features: int, strong: int) -> PoseAgreement:
    return replace(PoseAgreement(), n_inlier_features=features, n_moved=features, n_strong=strong)


@pytest.mark.parametrize(
    ("seen", "starves"),
    [
        ([(N_STRONG, N_STRONG)] * 3, False),
        ([(N_STRONG, N_STRONG - 1)] * 3, True),
        ([(N_STRONG + 200, 0)] * 3, True),  # low-contrast features do not count
        ([(3 * N_STRONG, 3 * N_STRONG), (0, 0), (0, 0)], False),
        ([(3 * N_STRONG, 3 * N_STRONG - 1), (0, 0), (5, 0)], True),
    ],
)
def test_state_is_feature_poor_with_few_strong_inliers(seen: list[tuple[int, int]], starves: bool) -> None:
    agreements = [make_agreement(*one) for one in seen]
    proven = with_motion(make_first_state(), has_moved=True)
    assert (
        proven.add_solved_frame(
            make_solved(1), STEP, TrackingOptions(), has_new_features=True, agreements=agreements
        ).is_feature_poor
        == starves
    )
    for was in (False, True):
        # Tracked features are a selection of many: they do not count.
        assert (
            replace(proven, is_feature_poor=was)
            .add_solved_frame(make_solved(1), STEP, TrackingOptions(), has_new_features=False, agreements=agreements)
            .is_feature_poor
            == was
        )
        # Nor do features that may be background.
        still = [replace(a, n_moved=0) for a in agreements]
        assert (
            replace(make_first_state(), is_feature_poor=was)
            .add_solved_frame(make_solved(1), STEP, TrackingOptions(), has_new_features=True, agreements=still)
            .is_feature_poor
            == was
        )


def test_anchor_ages_until_new_features_are_detected() -> None:
    state = make_state_after(4)
    assert state.frames.anchor is not None
    assert state.frames.anchor.age == 4
    assert state.frames.anchor.frame.number == 0
    assert state.add_solved_frame(make_solved(5), STEP, TrackingOptions(), has_new_features=True).frames.anchor is None
    assert (
        make_first_state()
        .add_solved_frame(make_solved(1), STEP, TrackingOptions(), has_new_features=False)
        .frames.anchor
        is None
    )


def test_known_frames_are_keyframes_anchor_and_recent() -> None:
    state = with_frames(
        make_state_after(3),
        anchor=Anchor(make_solved(2)),
        keyframes=(make_solved(0), make_solved(1)),
        recent=(make_solved(3),),
    )
    assert sorted(state.frames.by_number) == [0, 1, 2, 3]
    assert all(frame.number == number for number, frame in state.frames.by_number.items())
    assert state.frames.by_number[3] is state.last
    assert sorted(with_frames(state, anchor=None).frames.by_number) == [0, 1, 3]


# --- missing object


def set_velocity_change(state: JointState, turn: float, translation: float) -> JointState:
    """Set the velocity change such that the prediction after one frame has these standard deviations."""
    unsteady = (np.array([0, turn, 0, 0, 0, translation]) / DT) ** 2
    base = replace(state.last, covariance=np.zeros((6, 6)))
    return with_motion(with_frames(state, last=base), velocity=replace(state.motion.velocity, change_variance=unsteady))


def test_missed_frames_are_counted_and_extrapolated() -> None:
    state = set_velocity_change(make_state_after(3), 1e-6, 1e-6)
    for missed in range(1, 4):
        before = state
        state, covariance = state.coast((3 + missed) * DT, TrackingOptions())
        assert (before.motion.n_missed, state.motion.n_missed, state.motion.is_lost) == (missed - 1, missed, False)
        np.testing.assert_allclose(covariance, state.motion.velocity.predict_covariance(missed * DT, missed))
        # The prediction still starts at the last solved frame.
        assert state.last is before.last
    np.testing.assert_allclose(state.predict_pose(6 * DT).as_matrix(), pose_at(6).as_matrix(), atol=1e-12)


def test_prediction_includes_last_covariance() -> None:
    state = make_state_after(3)
    known = np.diag([1, 2, 3, 4, 5, 6.0]) * 1e-6
    state = with_frames(state, last=replace(state.last, covariance=known))
    state = with_motion(state, velocity=replace(state.motion.velocity, change_variance=np.full(6, 0.01)))
    _, covariance = state.coast(4 * DT, TrackingOptions())
    np.testing.assert_allclose(covariance, known + 0.01 * DT**2 * np.eye(6))


def test_too_many_missed_frames_mean_lost() -> None:
    state = set_velocity_change(make_state_after(3), 1e-9, 1e-9)
    for _ in range(TrackingOptions.max_coasting_frames):
        state, _ = state.coast(4 * DT, TrackingOptions())
        assert not state.motion.is_lost
    state, _ = state.coast(4 * DT, TrackingOptions())
    assert state.motion.is_lost


@pytest.mark.parametrize(
    ("turn", "shift", "lost"),
    [(0.98, 0, False), (1.02, 0, True), (0, 0.98, False), (0, 1.02, True), (0.98, 0.98, False)],
)
def test_uncertain_rotation_or_position_means_lost(turn: float, shift: float, lost: bool) -> None:
    state = set_velocity_change(make_state_after(3), turn * MAX_ROTATION_SD, shift * RADIUS)
    state, _ = state.coast(4 * DT, TrackingOptions())
    assert state.motion.is_lost == lost


def test_unknown_velocity_means_lost() -> None:
    state, covariance = make_first_state().coast(DT, TrackingOptions())
    assert state.motion.is_lost
    assert np.isposinf(np.diag(covariance)).all()


def test_lost_object_stays_lost_until_found() -> None:
    state, _ = with_motion(set_velocity_change(make_state_after(3), 1e-9, 1e-9), is_lost=True).coast(
        4 * DT, TrackingOptions()
    )
    assert state.motion.is_lost
    found = with_motion(state, next_hypothesis=9).add_solved_frame(
        make_solved(5), STEP * STEP, TrackingOptions(), has_new_features=True
    )
    assert (found.motion.is_lost, found.motion.n_missed, found.motion.next_hypothesis) == (False, 0, 0)


def test_velocity_after_missed_and_lost_frames() -> None:
    """While the object is lost only the ends of its path are known."""
    state = make_state_after(6)
    missed, _ = set_velocity_change(state, 1e-6, 1e-6).coast(7 * DT, TrackingOptions())
    found = missed.add_solved_frame(make_solved(8), STEP * STEP, TrackingOptions(), has_new_features=True)
    assert found.motion.velocity.n_frames == 1
    np.testing.assert_allclose(found.motion.velocity.twist, TWIST, atol=1e-10)
    np.testing.assert_array_equal(found.motion.velocity.change_variance, missed.motion.velocity.change_variance)
    again = with_motion(missed, is_lost=True).add_solved_frame(
        make_solved(8), STEP * STEP, TrackingOptions(), has_new_features=True
    )
    assert again.motion.velocity.n_frames == 0
    assert not again.motion.velocity.twist.any()
    # Without missed frames the velocity is kept.
    assert (
        state.add_solved_frame(make_solved(7), STEP, TrackingOptions(), has_new_features=True).motion.velocity.n_frames
        == state.motion.velocity.n_frames + 1
    )


def test_known_size_resets_state() -> None:
    state = with_frames(
        make_state_after(3), keyframes=(make_solved(0), make_solved(2)), recent=(make_solved(1), make_solved(2))
    )
    state = replace(state, object=replace(state.object, is_depth_guessed=True))
    assert sorted(state.frames.by_number) == [0, 1, 2, 3]
    young = state.reset_to_first_frame(0.05, 0.1 * np.eye(6))
    assert list(young.frames.by_number) == [0]
    assert (young.object.radius, young.object.is_depth_guessed) == (0.05, False)
    # Only the first frame's pose does not depend on depths from boxes.
    assert [(k.number, k.landmark_age) for k in young.frames.keyframes] == [(0, 1.0)]
    assert young.frames.keyframes[0] is young.last
    # Until a refinement, no pose is more certain than the motion that determined depth.
    np.testing.assert_array_equal(young.refinement.covariance, 0.1 * np.eye(6))
    assert state.last.landmark_age == state.frames.keyframes[0].landmark_age == 3.0
    assert (state.object.radius, state.object.is_depth_guessed) == (RADIUS, True)


# --- pose uncertainty


def make_inliers(**weights: float) -> PoseAgreement:
    """One camera's inliers per reference: `_3` is the frame 3."""
    numbers = tuple(int(name[1:]) for name in weights)
    return PoseAgreement(50, 60, numbers, tuple(weights.values()), count_ages(np.ones(50)), 50, 50, 0.3, True)


def random_covariance(rng: np.random.Generator) -> FloatArray:
    root = rng.standard_normal((6, 6)) * np.repeat([1e-3, 2e-4], 3)[:, None]
    return np.asarray(root @ root.T)


def inverse_bounded(information: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(information + np.diag(np.repeat([np.pi**-2, RADIUS**-2], 3))))


INFORMATION = np.asarray(np.linalg.inv(random_covariance(np.random.default_rng(7))), dtype=np.float64)


def test_exact_reference_gives_inverse_information() -> None:
    known = {3: make_solved(3, covariance=np.zeros((6, 6)))}
    found = add_reference_covariance(INFORMATION, pose_at(9), [make_inliers(_3=40.0)], known, RADIUS)
    np.testing.assert_allclose(found, inverse_bounded(INFORMATION), rtol=1e-6, atol=1e-16)
    # The bound does not affect well-determined directions.
    np.testing.assert_allclose(found, np.linalg.inv(INFORMATION), rtol=1e-3, atol=1e-12)


def test_unobservable_directions_are_bounded() -> None:
    known = {3: make_solved(3, covariance=np.zeros((6, 6)))}
    nothing = add_reference_covariance(np.zeros((6, 6)), pose_at(9), [make_inliers(_3=40.0)], known, RADIUS)
    np.testing.assert_allclose(nothing, np.diag(np.repeat([np.pi**2, RADIUS**2], 3)), rtol=1e-9)
    blind = np.diag([1e6, 1e6, 1e6, 1e8, 1e8, 0.0])
    found = add_reference_covariance(blind, pose_at(9), [make_inliers(_3=40.0)], known, RADIUS)
    assert np.diag(found)[5] == pytest.approx(RADIUS**2)
    assert np.diag(found)[:5].max() < 2e-6


def test_reference_covariance_is_added() -> None:
    """The object has not rotated since."""
    C = random_covariance(np.random.default_rng(0))
    found = add_reference_covariance(
        INFORMATION, pose_at(3), [make_inliers(_3=40.0)], {3: make_solved(3, covariance=C)}, RADIUS
    )
    np.testing.assert_allclose(found, inverse_bounded(INFORMATION) + C, rtol=1e-9, atol=1e-18)
    # It is a considerable part of the sum.
    assert np.linalg.norm(C) > 0.1 * np.linalg.norm(found)


@pytest.mark.parametrize("turn", [0.3, 2.0, 3.1])
def test_reference_error_rotates_with_object(turn: float) -> None:
    """A reference error (w, d) displaces its landmarks on the object, and so the frames solved with them.

    In the object's axes the error is the same. It is computed from the poses themselves, without a formula for their
    errors.
    """
    rng = np.random.default_rng(1)
    reference = make_solved(3)
    motion = RigidTransform.from_components([0.1, 0.3, -0.2], Rotation.from_rotvec(turn * np.array([0.6, 0, 0.8])))
    now = motion * reference.world_from_object
    expected = np.zeros((6, 6))
    errors = rng.standard_normal((40, 6)) * np.repeat([1e-3, 2e-4], 3)
    for w, d in zip(errors[:, :3], errors[:, 3:], strict=True):
        before = reference.world_from_object
        wrong = RigidTransform.from_components(before.translation + d, Rotation.from_rotvec(w) * before.rotation)
        # A point at X on the object is estimated at wrong^-1 before X; all agrees with the images at:
        found = now * (before.inv() * wrong)
        off = np.concatenate([(found.rotation * now.rotation.inv()).as_rotvec(), found.translation - now.translation])
        expected += np.outer(off, off) / len(errors)
    C = errors.T @ errors / len(errors)
    known = {3: replace(reference, covariance=C)}
    found_covariance = add_reference_covariance(INFORMATION, now, [make_inliers(_3=40.0)], known, RADIUS)
    inherited = found_covariance - inverse_bounded(INFORMATION)
    np.testing.assert_allclose(inherited, expected, rtol=0, atol=1e-5 * np.abs(expected).max())
    # Without rotation it would be different.
    assert np.abs(C - expected).max() > 0.05 * np.abs(expected).max()


def test_references_are_weighted_by_inliers() -> None:
    rng = np.random.default_rng(2)
    A, B = random_covariance(rng), random_covariance(rng)
    known = {3: make_solved(3, pose_at(5), A), 4: make_solved(4, pose_at(5), B)}
    of_cameras = [make_inliers(_3=10.0, _4=20.0), make_inliers(_4=40.0), make_inliers()]
    found = add_reference_covariance(INFORMATION, pose_at(5), of_cameras, known, RADIUS)
    expected = inverse_bounded(INFORMATION) + A / 7 + 6 * B / 7
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-18)


def test_correlated_reference_errors_are_not_averaged_away() -> None:
    """Ten references with the same error are as wrong as one; fully correlated ones never exceed the covariance."""
    rng = np.random.default_rng(3)
    C = random_covariance(rng)
    many = {k: make_solved(k, pose_at(5), C) for k in range(10)}
    ten = PoseAgreement(50, 60, tuple(range(10)), (5.0,) * 10, count_ages(np.ones(50)), 50, 50, 0.3, True)
    found = add_reference_covariance(INFORMATION, pose_at(5), [ten], many, RADIUS) - inverse_bounded(INFORMATION)
    np.testing.assert_allclose(found, C, rtol=1e-9, atol=1e-18)
    for share in (0.1, 0.5, 0.8):
        a, b = (rng.standard_normal((6, 6)) * 1e-3 for _ in range(2))
        known = {3: make_solved(3, pose_at(5), a @ a.T), 4: make_solved(4, pose_at(5), b @ b.T)}
        message = add_reference_covariance(
            INFORMATION, pose_at(5), [make_inliers(_3=share, _4=1 - share)], known, RADIUS
        )
        mean = share * a + (1 - share) * b
        slack = message - inverse_bounded(INFORMATION) - mean @ mean.T
        assert np.linalg.eigvalsh(slack).min() > -1e-12
        assert np.linalg.eigvalsh(slack).max() > 1e-9


@pytest.mark.parametrize("alike", [0.3, 1.0])
def test_correlated_errors_add_up(alike: float) -> None:
    """In proportion to the correlation: the standard deviations of two equal errors add."""
    C = random_covariance(np.random.default_rng(4))
    known = {3: make_solved(3, pose_at(5), C)}
    same = np.asarray(np.linalg.inv(C) - np.diag(np.repeat([np.pi**-2, RADIUS**-2], 3)))
    found = add_reference_covariance(same, pose_at(5), [make_inliers(_3=40.0)], known, RADIUS, alike)
    np.testing.assert_allclose(found, (2 + 2 * alike) * C, rtol=1e-5, atol=1e-14)
    # It is a valid covariance for any two, and their sum without correlation.
    own = inverse_bounded(INFORMATION)
    other = add_reference_covariance(INFORMATION, pose_at(5), [make_inliers(_3=40.0)], known, RADIUS, alike)
    assert np.linalg.eigvalsh(other).min() > 0
    assert np.trace(own + C) < np.trace(other) < 2.001 * np.trace(own + C)


def test_no_reference_adds_no_covariance() -> None:
    found = add_reference_covariance(INFORMATION, pose_at(5), [make_inliers(), make_inliers()], {}, RADIUS)
    np.testing.assert_allclose(found, inverse_bounded(INFORMATION), rtol=1e-9, atol=1e-18)


# --- reports


def test_landmark_ages_of_all_cameras() -> None:
    rng = np.random.default_rng(4)
    seen = [rng.integers(1, 9, n).astype(float) for n in (30, 0, 7)]
    records = [count_ages(s) for s in seen]
    np.testing.assert_array_equal(expand_ages(records), np.sort(np.concatenate(seen)))
    # They are encoded in fewer numbers.
    assert len(records[0].values) == len(records[0].counts) <= 8
    assert records[0].counts.sum() == 30
    assert len(expand_ages([records[1]])) == 0


def test_default_state_is_empty() -> None:
    state = JointState()
    assert state.frames.last is None
    assert not state.frames.keyframes
    assert isinstance(state.motion.velocity, MotionModel)
    assert state.motion.velocity.n_frames == 0
    assert (state.motion.n_missed, state.motion.is_lost) == (0, False)
