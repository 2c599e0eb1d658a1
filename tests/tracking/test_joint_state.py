"""What all cameras know alike: the state between two frames, and how sure a frame's pose is that rests on others'."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.simulate import ring
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.joint_state import (
    COASTING_SHIFT,
    COASTING_TURN,
    MAX_COASTING,
    STARVES,
    Joint,
    covariance_with_references,
)
from sylpose.tracking.keyframes import viewpoints
from sylpose.tracking.klt_frontend import Anchor
from sylpose.tracking.motion_model import Velocity
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.reports import Ages, Agreed, total_ages

RIG = ring(3, 1.5, 1000.0, height=(0.4, -0.1, 0.2))
DT = 1 / 30
TWIST = np.array([1.0, -2.0, 0.5, 0.3, 0.1, -0.4])
START = RigidTransform.from_components([0.03, -0.02, 0.05], Rotation.from_rotvec([0.2, 0.1, -0.3]))
STEP = RigidTransform.from_exp_coords(TWIST * DT)
RADIUS = 0.2


def at(frames: float) -> RigidTransform:
    """The pose after so many frames at constant velocity."""
    return RigidTransform.from_exp_coords(TWIST * DT * frames) * START


def solved(number: int, pose: RigidTransform | None = None, covariance: FloatArray | None = None) -> SolvedFrame:
    pose = at(number) if pose is None else pose
    covariance = 1e-6 * np.eye(6) if covariance is None else covariance
    n = len(RIG)
    views = viewpoints(RIG, pose)
    return SolvedFrame(number, number * DT, np.zeros(n), pose, covariance, views, np.ones(n, bool), age=3.0)


def begun() -> Joint:
    return Joint(ObjectModel(np.zeros(3), RADIUS)).begun(solved(0))


def after(frames: int) -> Joint:
    """Solved frame by frame at constant velocity, all by followed features."""
    joint = replace(begun(), anchor=Anchor(solved(0)))
    for k in range(1, frames + 1):
        joint = joint.accepted(solved(k), STEP, anew=False)
    return joint


# --- from frame to frame


def test_the_first_frame_is_the_only_keyframe_and_what_is_known() -> None:
    joint = begun()
    assert joint.base.number == 0
    assert [k.number for k in joint.keyframes] == [0]
    assert list(joint.known) == [0]
    np.testing.assert_array_equal(joint.predicted(5.0).as_matrix(), START.as_matrix())


@pytest.mark.parametrize("ahead", [0.0, 1.0, 7.5])
def test_constant_velocity_is_predicted_exactly_after_one_step(ahead: float) -> None:
    joint = after(1)
    np.testing.assert_allclose(joint.predicted((1 + ahead) * DT).as_matrix(), at(1 + ahead).as_matrix(), atol=1e-12)
    # ... while what is lost is where it was seen last.
    lost = replace(joint, lost=True)
    np.testing.assert_array_equal(lost.predicted((1 + ahead) * DT).as_matrix(), at(1).as_matrix())


def test_the_velocity_is_of_the_time_that_has_passed() -> None:
    """A frame that was left out is twice the time and twice the motion."""
    joint = begun().accepted(solved(2), STEP * STEP, anew=False)
    np.testing.assert_allclose(joint.predicted(3 * DT).as_matrix(), at(3).as_matrix(), atol=1e-12)


def test_a_turn_about_the_objects_centre_that_changes_is_no_change_of_its_place() -> None:
    joint, pose = begun(), START
    for k, angle in enumerate((0.1, 0.2, 0.15), 1):
        turn = Rotation.from_rotvec([0, 0, angle])
        motion = RigidTransform.from_components(START.translation - turn.apply(START.translation), turn)
        pose = motion * pose
        joint = joint.accepted(solved(k, pose), motion, anew=False)
    assert joint.velocity.unsteady[3:].max() < 1e-20
    assert joint.velocity.unsteady[2] > 1


def test_accepted_makes_a_new_state_and_leaves_the_old() -> None:
    old = after(3)
    keyframes, anchor, twist = old.keyframes, old.anchor, old.velocity.twist.copy()
    far = RigidTransform.from_rotation(Rotation.from_rotvec([0, 1.0, 0]))
    new = old.accepted(solved(4, far * at(3)), far, anew=True)
    assert (old.base.number, old.keyframes, old.anchor) == (3, keyframes, anchor)
    np.testing.assert_array_equal(old.velocity.twist, twist)
    assert new.base.number == 4
    for change in ("missed", "lost", "last"):
        with pytest.raises(FrozenInstanceError):
            setattr(old, change, None)


@pytest.mark.parametrize(("anew", "turn", "kept"), [(True, 0.5, True), (False, 0.5, False), (True, 0.01, False)])
def test_keyframes_are_kept_of_frames_with_features_of_their_own_from_new_sides(
    anew: bool, turn: float, kept: bool
) -> None:
    motion = RigidTransform.from_rotation(Rotation.from_rotvec([0, turn, 0]))
    joint = begun().accepted(solved(1, motion * START), motion, anew=anew)
    assert [k.number for k in joint.keyframes] == ([0, 1] if kept else [0])
    assert joint.base.number == 1


def agreeing(features: int, strong: int) -> Agreed:
    return replace(Agreed.none(), features=features, moved=features, strong=strong)


@pytest.mark.parametrize(
    ("seen", "starves"),
    [
        ([(STARVES, STARVES)] * 3, False),
        ([(STARVES, STARVES - 1)] * 3, True),
        ([(STARVES + 200, 0)] * 3, True),  # what is faint does not count
        ([(3 * STARVES, 3 * STARVES), (0, 0), (0, 0)], False),
        ([(3 * STARVES, 3 * STARVES - 1), (0, 0), (5, 0)], True),
    ],
)
def test_it_starves_where_few_features_of_the_usual_contrast_agree(seen: list[tuple[int, int]], starves: bool) -> None:
    agreed = [agreeing(*one) for one in seen]
    proven = replace(begun(), proven=True)
    assert proven.accepted(solved(1), STEP, anew=True, agreed=agreed).starves == starves
    for was in (False, True):
        # What is followed are some features of many: they do not tell.
        assert replace(proven, starves=was).accepted(solved(1), STEP, anew=False, agreed=agreed).starves == was
        # Nor does what may be background.
        still = [replace(a, moved=0) for a in agreed]
        assert replace(begun(), starves=was).accepted(solved(1), STEP, anew=True, agreed=still).starves == was


def test_an_anchor_ages_until_a_frame_has_features_of_its_own() -> None:
    joint = after(4)
    assert joint.anchor is not None
    assert joint.anchor.age == 4
    assert joint.anchor.frame.number == 0
    assert joint.accepted(solved(5), STEP, anew=True).anchor is None
    assert begun().accepted(solved(1), STEP, anew=False).anchor is None


def test_known_are_the_keyframes_the_anchor_and_the_last_ones() -> None:
    joint = replace(after(3), anchor=Anchor(solved(2)), keyframes=(solved(0), solved(1)), recent=(solved(3),))
    assert sorted(joint.known) == [0, 1, 2, 3]
    assert all(frame.number == number for number, frame in joint.known.items())
    assert joint.known[3] is joint.base
    assert sorted(replace(joint, anchor=None).known) == [0, 1, 3]


# --- without the object


def steady(joint: Joint, turn: float, shift: float) -> Joint:
    """The usual change of the velocity such that after one frame the prediction's standard deviations are these."""
    unsteady = (np.array([0, turn, 0, 0, 0, shift]) / DT) ** 2
    base = replace(joint.base, covariance=np.zeros((6, 6)))
    return replace(joint, last=base, velocity=replace(joint.velocity, unsteady=unsteady))


def test_frames_missed_are_counted_and_it_is_taken_to_have_gone_on() -> None:
    joint = steady(after(3), 1e-6, 1e-6)
    for missed in range(1, 4):
        before = joint
        joint, covariance = joint.without((3 + missed) * DT)
        assert (before.missed, joint.missed, joint.lost) == (missed - 1, missed, False)
        np.testing.assert_allclose(covariance, joint.velocity.spread(missed * DT, missed))
        # The last solved frame is still what it goes on from.
        assert joint.base is before.base
    np.testing.assert_allclose(joint.predicted(6 * DT).as_matrix(), at(6).as_matrix(), atol=1e-12)


def test_the_last_poses_own_covariance_is_in_it() -> None:
    joint = after(3)
    known = np.diag([1, 2, 3, 4, 5, 6.0]) * 1e-6
    joint = replace(joint, last=replace(joint.base, covariance=known))
    joint = replace(joint, velocity=replace(joint.velocity, unsteady=np.full(6, 0.01)))
    _, covariance = joint.without(4 * DT)
    np.testing.assert_allclose(covariance, known + 0.01 * DT**2 * np.eye(6))


def test_after_too_many_frames_it_is_lost_however_certain() -> None:
    joint = steady(after(3), 1e-9, 1e-9)
    for _ in range(MAX_COASTING):
        joint, _ = joint.without(4 * DT)
        assert not joint.lost
    joint, _ = joint.without(4 * DT)
    assert joint.lost


@pytest.mark.parametrize(
    ("turn", "shift", "lost"),
    [(0.98, 0, False), (1.02, 0, True), (0, 0.98, False), (0, 1.02, True), (0.98, 0.98, False)],
)
def test_it_is_lost_once_its_turn_or_its_place_is_uncertain(turn: float, shift: float, lost: bool) -> None:
    joint, _ = steady(after(3), turn * COASTING_TURN, shift * COASTING_SHIFT * RADIUS).without(4 * DT)
    assert joint.lost == lost


def test_of_a_velocity_that_is_not_known_nothing_follows() -> None:
    joint, covariance = begun().without(DT)
    assert joint.lost
    assert np.isposinf(np.diag(covariance)).all()


def test_what_is_lost_stays_lost_until_it_is_found() -> None:
    joint, _ = replace(steady(after(3), 1e-9, 1e-9), lost=True).without(4 * DT)
    assert joint.lost
    found = replace(joint, seen_again=2).accepted(solved(5), STEP * STEP, anew=True)
    assert (found.lost, found.missed, found.seen_again) == (False, 0, 0)


def test_what_was_missed_has_its_last_velocity_and_what_was_lost_none() -> None:
    """Of the way back nothing is known but its ends."""
    joint = after(6)
    missed, _ = steady(joint, 1e-6, 1e-6).without(7 * DT)
    found = missed.accepted(solved(8), STEP * STEP, anew=True)
    assert found.velocity.frames == 1
    np.testing.assert_allclose(found.velocity.twist, TWIST, atol=1e-10)
    np.testing.assert_array_equal(found.velocity.unsteady, missed.velocity.unsteady)
    again = replace(missed, lost=True).accepted(solved(8), STEP * STEP, anew=True)
    assert again.velocity.frames == 0
    assert not again.velocity.twist.any()
    # Nothing was missed: it goes on.
    assert joint.accepted(solved(7), STEP, anew=True).velocity.frames == joint.velocity.frames + 1


def test_once_its_size_is_known_landmarks_are_young_again() -> None:
    joint = replace(after(3), keyframes=(solved(0), solved(2)), recent=(solved(1), solved(2)))
    joint = replace(joint, object=replace(joint.object, guessed=True))
    assert sorted(joint.known) == [0, 1, 2, 3]
    young = joint.relearnt(0.05)
    assert list(young.known) == [0]
    assert (young.object.radius, young.object.guessed) == (0.05, False)
    # Only the first frame's pose does not follow from what the boxes told of depths.
    assert [(k.number, k.age) for k in young.keyframes] == [(0, 1.0)]
    assert young.keyframes[0] is young.base
    assert joint.base.age == joint.keyframes[0].age == 3.0
    assert (joint.object.radius, joint.object.guessed) == (RADIUS, True)


# --- how sure a pose is


def agreed(**weights: float) -> Agreed:
    """One camera's inliers, by reference: `_3` is the frame 3."""
    numbers = tuple(int(name[1:]) for name in weights)
    return Agreed(50, 60, numbers, tuple(weights.values()), Ages.of(np.ones(50)), 50, 50, 50, 0.3, True)


def random_covariance(rng: np.random.Generator) -> FloatArray:
    root = rng.standard_normal((6, 6)) * np.repeat([1e-3, 2e-4], 3)[:, None]
    return np.asarray(root @ root.T)


def inverse_bounded(information: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(information + np.diag(np.repeat([np.pi**-2, RADIUS**-2], 3))))


INFORMATION = np.asarray(np.linalg.inv(random_covariance(np.random.default_rng(7))), dtype=np.float64)


def test_of_a_reference_without_error_it_is_the_inverse_of_the_information() -> None:
    known = {3: solved(3, covariance=np.zeros((6, 6)))}
    found = covariance_with_references(INFORMATION, at(9), [agreed(_3=40.0)], known, RADIUS)
    np.testing.assert_allclose(found, inverse_bounded(INFORMATION), rtol=1e-6, atol=1e-16)
    # The bound is far from what is known well.
    np.testing.assert_allclose(found, np.linalg.inv(INFORMATION), rtol=1e-3, atol=1e-12)


def test_what_cannot_be_observed_is_as_uncertain_as_half_a_turn_and_the_objects_size() -> None:
    known = {3: solved(3, covariance=np.zeros((6, 6)))}
    nothing = covariance_with_references(np.zeros((6, 6)), at(9), [agreed(_3=40.0)], known, RADIUS)
    np.testing.assert_allclose(nothing, np.diag(np.repeat([np.pi**2, RADIUS**2], 3)), rtol=1e-9)
    blind = np.diag([1e6, 1e6, 1e6, 1e8, 1e8, 0.0])
    found = covariance_with_references(blind, at(9), [agreed(_3=40.0)], known, RADIUS)
    assert np.diag(found)[5] == pytest.approx(RADIUS**2)
    assert np.diag(found)[:5].max() < 2e-6


def test_a_references_covariance_is_added() -> None:
    """It has not turned since."""
    C = random_covariance(np.random.default_rng(0))
    found = covariance_with_references(INFORMATION, at(3), [agreed(_3=40.0)], {3: solved(3, covariance=C)}, RADIUS)
    np.testing.assert_allclose(found, inverse_bounded(INFORMATION) + C, rtol=1e-9, atol=1e-18)
    # It is no small part of the sum.
    assert np.linalg.norm(C) > 0.1 * np.linalg.norm(found)


@pytest.mark.parametrize("turn", [0.3, 2.0, 3.1])
def test_a_references_error_turns_with_the_object(turn: float) -> None:
    """A reference that is off by (w, d) puts its landmarks elsewhere on the object, and a frame that is solved with these is
    off by as much, as seen from the object. Seen so: the poses themselves, without a formula for their errors."""
    rng = np.random.default_rng(1)
    reference = solved(3)
    motion = RigidTransform.from_components([0.1, 0.3, -0.2], Rotation.from_rotvec(turn * np.array([0.6, 0, 0.8])))
    now = motion * reference.world_from_object
    expected = np.zeros((6, 6))
    errors = rng.standard_normal((40, 6)) * np.repeat([1e-3, 2e-4], 3)
    for w, d in zip(errors[:, :3], errors[:, 3:], strict=True):
        before = reference.world_from_object
        wrong = RigidTransform.from_components(before.translation + d, Rotation.from_rotvec(w) * before.rotation)
        # What is at X on the object is thought to be at wrong^-1 before X; all agrees with the images at:
        found = now * (before.inv() * wrong)
        off = np.concatenate([(found.rotation * now.rotation.inv()).as_rotvec(), found.translation - now.translation])
        expected += np.outer(off, off) / len(errors)
    C = errors.T @ errors / len(errors)
    known = {3: replace(reference, covariance=C)}
    found_covariance = covariance_with_references(INFORMATION, now, [agreed(_3=40.0)], known, RADIUS)
    inherited = found_covariance - inverse_bounded(INFORMATION)
    np.testing.assert_allclose(inherited, expected, rtol=0, atol=1e-5 * np.abs(expected).max())
    # Unturned it would be something else.
    assert np.abs(C - expected).max() > 0.05 * np.abs(expected).max()


def test_references_count_by_their_shares_of_inliers_in_all_cameras() -> None:
    rng = np.random.default_rng(2)
    A, B = random_covariance(rng), random_covariance(rng)
    known = {3: solved(3, at(5), A), 4: solved(4, at(5), B)}
    of_cameras = [agreed(_3=10.0, _4=20.0), agreed(_4=40.0), agreed()]
    found = covariance_with_references(INFORMATION, at(5), of_cameras, known, RADIUS)
    expected = inverse_bounded(INFORMATION) + A / 7 + 6 * B / 7
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-18)


def test_errors_of_references_with_common_ancestors_are_not_averaged_away() -> None:
    """Ten references with the same error are as wrong as one; and fully correlated ones never more than is said."""
    rng = np.random.default_rng(3)
    C = random_covariance(rng)
    many = {k: solved(k, at(5), C) for k in range(10)}
    ten = Agreed(50, 60, tuple(range(10)), (5.0,) * 10, Ages.of(np.ones(50)), 50, 50, 50, 0.3, True)
    found = covariance_with_references(INFORMATION, at(5), [ten], many, RADIUS) - inverse_bounded(INFORMATION)
    np.testing.assert_allclose(found, C, rtol=1e-9, atol=1e-18)
    for share in (0.1, 0.5, 0.8):
        a, b = (rng.standard_normal((6, 6)) * 1e-3 for _ in range(2))
        known = {3: solved(3, at(5), a @ a.T), 4: solved(4, at(5), b @ b.T)}
        said = covariance_with_references(INFORMATION, at(5), [agreed(_3=share, _4=1 - share)], known, RADIUS)
        mean = share * a + (1 - share) * b
        slack = said - inverse_bounded(INFORMATION) - mean @ mean.T
        assert np.linalg.eigvalsh(slack).min() > -1e-12
        assert np.linalg.eigvalsh(slack).max() > 1e-9


@pytest.mark.parametrize("alike", [0.3, 1.0])
def test_errors_that_go_on_as_the_turn_does_add_up(alike: float) -> None:
    """As much as the correlation says: the standard deviations of two errors that are the same add."""
    C = random_covariance(np.random.default_rng(4))
    known = {3: solved(3, at(5), C)}
    same = np.asarray(np.linalg.inv(C) - np.diag(np.repeat([np.pi**-2, RADIUS**-2], 3)))
    found = covariance_with_references(same, at(5), [agreed(_3=40.0)], known, RADIUS, alike)
    np.testing.assert_allclose(found, (2 + 2 * alike) * C, rtol=1e-5, atol=1e-14)
    # A covariance whatever the two are, and the sum of both where they have nothing to do with each other.
    own = inverse_bounded(INFORMATION)
    other = covariance_with_references(INFORMATION, at(5), [agreed(_3=40.0)], known, RADIUS, alike)
    assert np.linalg.eigvalsh(other).min() > 0
    assert np.trace(own + C) < np.trace(other) < 2.001 * np.trace(own + C)


def test_without_any_reference_there_is_nothing_to_inherit() -> None:
    found = covariance_with_references(INFORMATION, at(5), [agreed(), agreed()], {}, RADIUS)
    np.testing.assert_allclose(found, inverse_bounded(INFORMATION), rtol=1e-9, atol=1e-18)


# --- records


def test_ages_of_all_cameras_are_those_of_their_landmarks() -> None:
    rng = np.random.default_rng(4)
    seen = [rng.integers(1, 9, n).astype(float) for n in (30, 0, 7)]
    records = [Ages.of(s) for s in seen]
    np.testing.assert_array_equal(total_ages(records), np.sort(np.concatenate(seen)))
    # They are told in fewer numbers.
    assert len(records[0].values) == len(records[0].counts) <= 8
    assert records[0].counts.sum() == 30
    assert len(total_ages([records[1]])) == 0


def test_a_default_state_knows_nothing() -> None:
    joint = Joint()
    assert joint.last is None
    assert not joint.keyframes
    assert isinstance(joint.velocity, Velocity)
    assert joint.velocity.frames == 0
    assert (joint.missed, joint.seen_again, joint.lost) == (0, 0, False)
