"""Initialization without boxes: the object is the rigid body that moves, separated from a second one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds import KINDS, compute_errors
from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import relative_rotvec
from sylpose.landmarks.landmark_filter import LandmarkTable
from sylpose.matches import STATIC_PX
from sylpose.relative_pose.limits import MIN_ERROR_PX
from sylpose.rig import Rig
from sylpose.simulate import arc, ellipsoid
from sylpose.status import FrameStatus, Status
from sylpose.tracking import initialization, relocalization
from sylpose.tracking.camera_side.frame import CameraFrame, FrameMatches, compute_static_px
from sylpose.tracking.context import Context, Frame, FrameResult, LocalExecutor
from sylpose.tracking.first_motion import FirstMotion, estimate_first_motion, find_bodies, find_rivals
from sylpose.tracking.joint_side.joint_state import JointState
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.pose_search import SearchResult, find_pose
from sylpose.tracking.tracker import track
from tests.clips import statuses

FIRST = 3
AT = np.array([0.03, -0.02, 0.05])
ELSEWHERE = np.array([-0.35, 0.25, 0.1])


@cache
def make_rig(n: int) -> Rig:
    return arc(n, 80, 1.5, 1000.0, height=(0.4, -0.1, 0.2)[:n])


@pytest.fixture(params=[2, 3])
def rig(request: pytest.FixtureRequest) -> Rig:
    return make_rig(request.param)


@pytest.fixture
def executor(rig: Rig) -> Iterator[LocalExecutor]:
    one = LocalExecutor(len(rig), 1)
    yield one
    one.close()


def make_motion(at: FloatArray, turn: Sequence[float], translation: Sequence[float]) -> RigidTransform:
    """A motion about a point."""
    rotation = Rotation.from_rotvec(turn)
    return RigidTransform.from_components(at + translation - rotation.apply(at), rotation)


MOTION = make_motion(AT, [0.05, 0.09, -0.04], [0.01, -0.008, 0.012])
OTHER = make_motion(ELSEWHERE, [-0.08, 0.03, 0.07], [-0.02, 0.01, 0.0])


@dataclass(frozen=True)
class Body:
    """A body at a position with its motion, and its number of visible points per camera."""

    count: int
    at: FloatArray
    motion: RigidTransform


OBJECT = Body(60, AT, MOTION)


def visible_points(rig: Rig, camera: int, body: Body) -> FloatArray:
    """(count, 3) points on the side of an ellipsoid visible in a camera."""
    sides = np.array([0.15, 0.1, 0.12])
    surface = ellipsoid((0.15, 0.1, 0.12), n=4000).points
    facing = np.einsum("ni,ni->n", surface / sides**2, rig.cameras[camera].center - body.at - surface) > 0
    chosen = np.random.default_rng([camera, body.count]).permutation(surface[facing])[: body.count]
    return np.asarray(body.at + chosen)


def make_pairs(
    rig: Rig, bodies: Sequence[Body], room: int = 50, noise_px: float = 0.0, reference: int = FIRST, seed: int = 5
) -> list[list[FrameMatches]]:
    """Per camera one pair of all matches: the bodies' in this order, then those of the static room."""
    pairs = []
    for c, camera in enumerate(rig):
        rng = np.random.default_rng([c, seed])
        before = [camera.project(visible_points(rig, c, body)) for body in bodies]
        after = [camera.project(body.motion.apply(visible_points(rig, c, body))) for body in bodies]
        standing = rng.uniform([50, 50], [1200, 900], (room, 2))
        i, j = np.concatenate([*before, standing]), np.concatenate([*after, standing])
        j = j + noise_px * rng.standard_normal(j.shape)
        looks = np.zeros((len(i), 128), np.float32)
        earlier, later = (Features(p, camera.normalize(p), looks) for p in (i, j))
        frame = CameraFrame(earlier, np.zeros(len(i), bool), LandmarkTable())
        pairs.append([FrameMatches.from_indices(reference, frame, later, np.tile(np.arange(len(i))[:, None], 2))])
    return pairs


def make_context(executor: LocalExecutor, rig: Rig, seed: int = 0) -> Context:
    return Context(rig, (), executor, "landmarks", False, True, np.zeros(len(rig)), seed)


def estimate_motion(executor: LocalExecutor, rig: Rig, pairs: Sequence[Sequence[FrameMatches]]) -> FirstMotion:
    return estimate_first_motion(make_context(executor, rig), pairs, FIRST)


def moving_displacements(
    pairs: Sequence[Sequence[FrameMatches]], first: int, last: int, static_px: float = compute_static_px(MIN_ERROR_PX)
) -> list[FloatArray]:
    """Per camera the displacements, in pixels, of moving features within a range of numbers."""
    found = []
    for (pair,) in pairs:
        translation = np.linalg.norm(pair.pixels_j - pair.pixels_i, axis=1)[first:last]
        found.append(translation[translation >= static_px])
    return found


def motion_errors(motion: FirstMotion) -> tuple[float, float]:
    """Errors of rotation, radians, and of the translation at the center."""
    turn = (MOTION.rotation * Rotation.from_matrix(motion.fit.rotation).inv()).magnitude()
    return float(turn), float(np.linalg.norm(MOTION.apply(motion.center) - motion.center - motion.fit.translation))


# --- the object's motion


@pytest.mark.parametrize("share", [0.4, 0.8])
def test_bodies_that_move_alike_are_separated(executor: LocalExecutor, rig: Rig, share: float) -> None:
    """They move by some pixels, and the cameras do not see most of the same one."""
    motions = [
        make_motion(at, [share * x for x in rotvec], [share * x for x in (0.01, -0.008, 0.012)])
        for at, rotvec in ((AT, (0.05, 0.09, -0.04)), (ELSEWHERE, (-0.08, 0.03, 0.07)))
    ]
    bodies = [Body(n, at, motion) for n, at, motion in zip((60, 45), (AT, ELSEWHERE), motions, strict=True)]
    pairs = make_pairs(rig, bodies, room=0, noise_px=0.1)
    pairs[1] = [pair.subset(np.arange(len(pair)) >= 30) for pair in pairs[1]]
    found = estimate_motion(executor, rig, pairs)
    assert min((motion.rotation * found.motion.rotation.inv()).magnitude() for motion in motions) < 0.003
    assert found.compute_f_ratio() < 1.0


def test_exchanged_cameras_contradict_first_motion(executor: LocalExecutor, rig: Rig) -> None:
    """A right rig has no excess; a third camera leaves exchanged ones without a joint motion."""
    first, second, *others = make_pairs(rig, [OBJECT], noise_px=0.1)
    assert estimate_motion(executor, rig, [first, second, *others]).compute_f_ratio() < 1.0
    wrong = estimate_motion(executor, rig, [second, first, *others])
    if len(rig) == 2:
        assert wrong.compute_f_ratio() > TrackingOptions().max_pooled_f_ratio
    else:
        assert not wrong.fit.status.has_pose


@pytest.mark.parametrize("room", [0, 50, 400])
def test_moving_body_among_static_features_is_object(executor: LocalExecutor, rig: Rig, room: int) -> None:
    """Without noise the motion is exact, however many features are static."""
    pairs = make_pairs(rig, [OBJECT], room)
    found = estimate_motion(executor, rig, pairs)
    assert found.fit.status is Status.OK
    turn, translation = motion_errors(found)
    assert turn < 2e-5
    assert translation < 2e-5
    # All matches of the object, and no others.
    displaced = moving_displacements(pairs, 0, OBJECT.count)
    assert found.n_inliers == sum(len(translation) for translation in displaced) > 0.9 * OBJECT.count * len(rig)
    assert found.displacement_px == np.median(np.concatenate(displaced))
    for (inliers,), shifts in zip(found.inliers, displaced, strict=True):
        assert inliers.reference == FIRST
        assert len(inliers) == len(shifts)
        assert inliers.indices.max() < OBJECT.count


def test_center_and_radius(executor: LocalExecutor, rig: Rig) -> None:
    found = estimate_motion(executor, rig, make_pairs(rig, [OBJECT]))
    # An ellipsoid of 0.1 to 0.15, of which each camera sees one side.
    assert np.linalg.norm(found.inlier_center - AT) < 0.3 * 0.15
    assert 0.1 < found.radius < 0.25
    np.testing.assert_array_equal(found.inlier_center, found.center)


def test_errors_scale_with_noise(executor: LocalExecutor, rig: Rig) -> None:
    """0.3 pixels of a body that is 100 to 200 pixels large."""
    found = estimate_motion(executor, rig, make_pairs(rig, [OBJECT], noise_px=0.3))
    assert found.fit.status is Status.OK
    turn, translation = motion_errors(found)
    assert 1e-4 < turn < 1e-2
    assert 1e-4 < translation < 5e-3
    assert found.n_inliers > 0.9 * OBJECT.count * len(rig)


def test_epipolar_pose_has_its_covariance(executor: LocalExecutor, rig: Rig) -> None:
    """Of an object whose center is not that of the matches: errors of the rotation move it."""
    first_pose = RigidTransform.from_translation(AT + np.array([0.1, -0.05, 0.2]))
    true_pose, squares = MOTION * first_pose, []
    for seed in range(24):
        found = estimate_motion(executor, rig, make_pairs(rig, [OBJECT], noise_px=0.3, seed=seed))
        estimate = found.estimate_pose(first_pose, found.radius)
        moved = true_pose.translation - estimate.world_from_object.translation
        error = np.concatenate([relative_rotvec(estimate.world_from_object, true_pose), moved])
        squares.append(float(error @ np.linalg.solve(estimate.covariance, error)))
    # Six degrees of freedom each; robust estimates are on the safe side.
    assert 2.0 < np.mean(squares) < 9.0
    assert max(squares) < 27.0


def test_displacement_of_the_surface(executor: LocalExecutor, rig: Rig) -> None:
    """Of moving matches; none of static ones, and unknown without matches."""
    of_object, of_room, of_nothing = (
        estimate_motion(executor, rig, make_pairs(rig, bodies, room)).measure_displacement(AT)
        for bodies, room in (([OBJECT], 50), ([], 50), ([], 0))
    )
    shifts = [
        np.linalg.norm(MOTION.apply(p) - p, axis=1) for p in (visible_points(rig, c, OBJECT) for c in range(len(rig)))
    ]
    assert 0.5 * np.median(shifts) < of_object <= np.max(shifts)  # across the views only
    assert of_room == 0.0
    assert np.isnan(of_nothing)


@pytest.mark.parametrize("count", [10, 20])
def test_small_second_motion_is_rejected(executor: LocalExecutor, rig: Rig, count: int) -> None:
    pairs = make_pairs(rig, [OBJECT, Body(count, ELSEWHERE, OTHER)])
    found = estimate_motion(executor, rig, pairs)
    assert max(motion_errors(found)) < 2e-5
    least, most = (moving_displacements(pairs, 0, OBJECT.count, *limit) for limit in ((STATIC_PX,), ()))
    assert sum(map(len, least)) <= found.n_inliers <= sum(map(len, most))
    # The center of the motion is that of all moving matches; the object's position is that of its own.
    assert np.linalg.norm(found.inlier_center - AT) < 0.3 * 0.15
    assert np.linalg.norm(found.center - found.inlier_center) > 0.01


def test_common_motion_is_one_object(executor: LocalExecutor, rig: Rig) -> None:
    pairs = make_pairs(rig, [OBJECT, Body(50, ELSEWHERE, MOTION)])
    found = estimate_motion(executor, rig, pairs)
    assert max(motion_errors(found)) < 2e-5
    assert found.n_inliers > 0.95 * sum(len(shift) for shift in moving_displacements(pairs, 0, 110))
    assert found.radius > 0.3
    assert not find_rivals(make_context(executor, rig, 1), pairs, FIRST, found)


def test_cameras_count_once() -> None:
    """Tracked and matched features of one camera are not two cameras that see a motion."""
    rig = make_rig(3)
    pairs = make_pairs(rig, [OBJECT])
    is_tracked = np.arange(len(pairs[0][0])) % 2 == 0
    pairs[0] = [pairs[0][0].subset(is_tracked), pairs[0][0].subset(~is_tracked)]
    executor = LocalExecutor(3, 1)
    found = estimate_motion(executor, rig, pairs)
    assert found.n_cameras == 3
    assert found.is_significant
    found = estimate_motion(executor, rig, [pairs[0], [], []])
    assert found.n_cameras <= 1
    assert not found.is_significant
    executor.close()


def assert_no_motion(motion: FirstMotion, cameras: int) -> None:
    assert motion.fit.status is Status.TOO_FEW_MATCHES
    assert motion.n_inliers == 0
    assert np.isnan(motion.displacement_px)
    assert np.isnan(motion.radius)
    assert np.isnan(motion.center).all()
    assert np.isnan(motion.inlier_center).all()
    assert motion.center.shape == motion.inlier_center.shape == (3,)
    assert list(motion.inliers) == [[]] * cameras


def test_static_scene_has_no_object(executor: LocalExecutor, rig: Rig) -> None:
    pairs = make_pairs(rig, [])
    assert_no_motion(estimate_motion(executor, rig, pairs), len(rig))
    standing = Body(60, AT, RigidTransform.identity())
    pairs = make_pairs(rig, [standing])
    found = estimate_motion(executor, rig, pairs)
    assert_no_motion(found, len(rig))
    assert not find_rivals(make_context(executor, rig, 1), pairs, FIRST, found)


def test_no_matches_give_no_motion(executor: LocalExecutor, rig: Rig) -> None:
    assert_no_motion(estimate_motion(executor, rig, [[] for _ in rig]), len(rig))
    empty = [[pair.subset(np.zeros(len(pair), bool)) for pair in of] for of in make_pairs(rig, [OBJECT])]
    assert_no_motion(estimate_motion(executor, rig, empty), len(rig))


def test_matches_with_other_frames_are_ignored(executor: LocalExecutor, rig: Rig) -> None:
    other = make_pairs(rig, [OBJECT], reference=FIRST + 1)
    assert_no_motion(estimate_motion(executor, rig, other), len(rig))
    pairs = make_pairs(rig, [OBJECT])
    wrong = make_pairs(rig, [Body(60, AT, OTHER)], reference=FIRST + 1)
    found = estimate_motion(executor, rig, [[*a, *b] for a, b in zip(wrong, pairs, strict=True)])
    assert max(motion_errors(found)) < 2e-5
    assert {pair.reference for inliers in found.inliers for pair in inliers} == {FIRST}


def test_too_few_matches_give_no_motion(executor: LocalExecutor, rig: Rig) -> None:
    """Three points per camera do not determine a motion."""
    found = estimate_motion(executor, rig, make_pairs(rig, [Body(3 if len(rig) == 2 else 2, AT, MOTION)]))
    assert found.fit.status is Status.TOO_FEW_MATCHES
    assert found.n_inliers == 0
    assert np.isnan(found.displacement_px)
    assert np.isnan(found.radius)
    assert list(found.inliers) == [[]] * len(rig)


def test_equal_seeds_give_equal_motions(executor: LocalExecutor, rig: Rig) -> None:
    pairs = make_pairs(rig, [OBJECT], noise_px=0.3)
    one, again = estimate_motion(executor, rig, pairs), estimate_motion(executor, rig, pairs)
    np.testing.assert_array_equal(one.fit.rotation, again.fit.rotation)
    np.testing.assert_array_equal(one.fit.translation, again.fit.translation)


# --- two moving bodies


@pytest.mark.parametrize("count", [20, 40, 60])
def test_bodies_are_found_with_their_motions(executor: LocalExecutor, rig: Rig, count: int) -> None:
    """The one with more matches first. A few matches agree with both motions."""
    pairs = make_pairs(rig, [OBJECT, Body(count, ELSEWHERE, OTHER)])
    found = find_bodies(make_context(executor, rig), pairs, FIRST)
    assert len(found) == 2
    assert found[0].n_inliers >= found[1].n_inliers
    for truth in (MOTION, OTHER):
        errors = [(truth.inv() * body.motion).rotation.magnitude() for body in found]
        assert min(errors) < np.radians(0.2)
    owners = [{int(i) for pairs in body.inliers for pair in pairs for i in pair.indices[:, 0]} for body in found]
    assert not owners[0] & owners[1]


def test_bodies_of_static_scene(executor: LocalExecutor, rig: Rig) -> None:
    assert not find_bodies(make_context(executor, rig), make_pairs(rig, []), FIRST)


@pytest.mark.parametrize("count", [20, 40])
def test_second_body_is_rival(executor: LocalExecutor, rig: Rig, count: int) -> None:
    pairs = make_pairs(rig, [OBJECT, Body(count, ELSEWHERE, OTHER)])
    found = estimate_motion(executor, rig, pairs)
    assert find_rivals(make_context(executor, rig, 1), pairs, FIRST, found)


@pytest.mark.parametrize("more", [-1, 1])
def test_rival_threshold(executor: LocalExecutor, rig: Rig, more: int) -> None:
    """On both sides of the threshold, with a second body of known feature count."""
    pairs = make_pairs(rig, [OBJECT, Body(40, ELSEWHERE, OTHER)])
    found = estimate_motion(executor, rig, pairs)
    rival = estimate_motion(executor, rig, make_pairs(rig, [Body(40, ELSEWHERE, OTHER)]))
    assert rival.fit.status is Status.OK
    assert rival.n_inliers > 0.9 * 40 * len(rig)
    larger = replace(found, n_inliers=round(rival.n_inliers / TrackingOptions.max_rival_ratio) + more)
    assert bool(find_rivals(make_context(executor, rig, 1), pairs, FIRST, larger)) == (more < 0)


@pytest.mark.parametrize("noise_px", [0.0, 0.3])
def test_object_itself_is_not_ambiguous(executor: LocalExecutor, rig: Rig, noise_px: float) -> None:
    pairs = make_pairs(rig, [OBJECT], noise_px=noise_px)
    found = estimate_motion(executor, rig, pairs)
    assert not find_rivals(make_context(executor, rig, 1), pairs, FIRST, found)


def test_faulty_camera_is_no_rival() -> None:
    """One camera of three shows the object with another motion."""
    rig = make_rig(3)
    pairs = make_pairs(rig, [OBJECT])
    pairs[2] = make_pairs(rig, [replace(OBJECT, motion=make_motion(AT, [-0.08, 0.03, 0.07], [0.0, 0.01, 0.0]))])[2]
    executor = LocalExecutor(3, 1)
    found = estimate_motion(executor, rig, pairs)
    assert not find_rivals(make_context(executor, rig, 1), pairs, FIRST, found)
    executor.close()


def test_starts_from_motions_of_adjacent_frames() -> None:
    # A checkered cube, 11 degrees per frame: two frames later its faces do not match those of the first frame.
    variation = KINDS["checkered"](np.random.default_rng([50, *b"checkered"]))
    tracked = list(track(list(islice(variation.frames(), 4)), variation.scene.rig))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 3
    errors, _ = compute_errors(variation, [frame.pose for frame in tracked])
    assert errors[:, 0].max() < 1.0


def test_buffered_frame_may_determine_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame before the end frame that determines the depth discards the end frame, which is solved once more."""
    solve, solved = initialization._solve_buffered_frame, list[int]()

    def solve_and_discard(context: Context, state: JointState, frame: Frame, pose: RigidTransform) -> FrameResult:
        solved.append(frame.number)
        state, tracked = solve(context, state, frame, pose)
        if solved == [2, 1]:
            frames = state.frames
            keyframes, recent = (
                tuple(f for f in known if f.number != 2) for known in (frames.keyframes, frames.recent)
            )
            state = replace(state, frames=replace(frames, keyframes=keyframes, recent=recent))
        return state, tracked

    monkeypatch.setattr(initialization, "_solve_buffered_frame", solve_and_discard)
    take = KINDS["jumps-15"](np.random.default_rng([1, *b"jumps-15"]))
    tracked = list(track(islice(take.frames(), 5), take.scene.rig, take.boxes, seed=1, workers=1))
    assert solved == [2, 1, 2]
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 4
    truth = take.scene.object_poses()
    for frame in tracked:
        pose = frame.pose.world_from_object
        assert pose is not None
        off = pose * (truth[frame.pose.index] * truth[0].inv() * tracked[0].pose.world_from_object).inv()
        assert np.degrees(off.rotation.magnitude()) < 1.0


@pytest.mark.parametrize(("is_found_again", "status"), [(False, FrameStatus.LOST), (True, FrameStatus.TRACKED)])
def test_scattered_buffered_frame_is_searched_again(
    monkeypatch: pytest.MonkeyPatch, is_found_again: bool, status: FrameStatus
) -> None:
    """A buffered frame whose features scatter as by chance is searched again; without a result it has no pose."""

    def find_scattered(context: Context, state: JointState, frame: Frame, pose: RigidTransform) -> SearchResult:
        state, candidate = find_pose(context, state, frame, pose)
        if candidate is not None and frame.number == 1:
            agreements = tuple(replace(agreement, noise_px=100.0) for agreement in candidate.agreements)
            candidate = replace(candidate, agreements=agreements)
        return state, candidate

    monkeypatch.setattr(initialization, "find_pose", find_scattered)
    if not is_found_again:
        monkeypatch.setattr(relocalization, "find_pose_with_all_features", lambda _, state, *__: (state, None))
    take = KINDS["jumps-15"](np.random.default_rng([1, *b"jumps-15"]))
    tracked = list(track(islice(take.frames(), 3), take.scene.rig, take.boxes, seed=1, workers=1))
    assert statuses(tracked) == [FrameStatus.FIRST, status, FrameStatus.TRACKED]
