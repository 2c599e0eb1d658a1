"""The start without boxes: the object is what moves as a rigid body, and it is told apart from a second one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds import KINDS
from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.matches import STILL_PX
from sylpose.results import FrameStatus, Status
from sylpose.rig import Rig
from sylpose.simulate import arc, ellipsoid
from sylpose.tracking.camera_executor import OneProcess
from sylpose.tracking.frame import CameraFrame, Pair
from sylpose.tracking.initialization import RIVAL_SHARE, FirstMotion, first_motion, is_ambiguous
from sylpose.tracking.tracker import track
from tests.clips import statuses

FIRST = 3
AT = np.array([0.03, -0.02, 0.05])
ELSEWHERE = np.array([-0.35, 0.25, 0.1])


@cache
def rig_of(n: int) -> Rig:
    return arc(n, 80, 1.5, 1000.0, height=(0.4, -0.1, 0.2)[:n])


@pytest.fixture(params=[2, 3])
def rig(request: pytest.FixtureRequest) -> Rig:
    return rig_of(request.param)


@pytest.fixture
def crew(rig: Rig) -> Iterator[OneProcess]:
    one = OneProcess(len(rig), 1)
    yield one
    one.close()


def moved(at: FloatArray, turn: Sequence[float], shift: Sequence[float]) -> RigidTransform:
    """A motion about a place."""
    rotation = Rotation.from_rotvec(turn)
    return RigidTransform.from_components(at + shift - rotation.apply(at), rotation)


MOTION = moved(AT, [0.05, 0.09, -0.04], [0.01, -0.008, 0.012])
OTHER = moved(ELSEWHERE, [-0.08, 0.03, 0.07], [-0.02, 0.01, 0.0])


@dataclass(frozen=True)
class Body:
    """So many points that each camera sees of a body at a place, and how it moves."""

    count: int
    at: FloatArray
    motion: RigidTransform


OBJECT = Body(60, AT, MOTION)


def visible(rig: Rig, camera: int, body: Body) -> FloatArray:
    """(count, 3) points on the side of an ellipsoid that a camera sees."""
    sides = np.array([0.15, 0.1, 0.12])
    surface = ellipsoid((0.15, 0.1, 0.12), n=4000).points
    facing = np.einsum("ni,ni->n", surface / sides**2, rig.cameras[camera].center - body.at - surface) > 0
    chosen = np.random.default_rng([camera, body.count]).permutation(surface[facing])[: body.count]
    return np.asarray(body.at + chosen)


def pairs_of(
    rig: Rig, bodies: Sequence[Body], room: int = 50, noise_px: float = 0.0, reference: int = FIRST
) -> list[list[Pair]]:
    """By camera one pair of all matches: the bodies' in this order, then the room's, which stands still."""
    pairs = []
    for c, camera in enumerate(rig):
        rng = np.random.default_rng([c, 5])
        before = [camera.project(visible(rig, c, body)) for body in bodies]
        after = [camera.project(body.motion.apply(visible(rig, c, body))) for body in bodies]
        standing = rng.uniform([50, 50], [1200, 900], (room, 2))
        i, j = np.concatenate([*before, standing]), np.concatenate([*after, standing])
        j = j + noise_px * rng.standard_normal(j.shape)
        looks = np.zeros((len(i), 128), np.float32)
        earlier, later = (Features(p, camera.normalize(p), looks) for p in (i, j))
        frame = CameraFrame(earlier, np.zeros(len(i), bool), LandmarkTable())
        pairs.append([Pair.of(reference, frame, later, np.tile(np.arange(len(i))[:, None], 2))])
    return pairs


def found_in(crew: OneProcess, rig: Rig, pairs: Sequence[Sequence[Pair]]) -> FirstMotion:
    return first_motion(crew, rig, pairs, FIRST, np.random.default_rng(0))


def moving(pairs: Sequence[Sequence[Pair]], first: int, last: int) -> list[FloatArray]:
    """By camera the displacements in pixels of the features with some numbers, of those that do not stand still."""
    found = []
    for (pair,) in pairs:
        shift = np.linalg.norm(pair.pixels_j - pair.pixels_i, axis=1)[first:last]
        found.append(shift[shift >= STILL_PX])
    return found


def errors(found: FirstMotion) -> tuple[float, float]:
    """Radians, and the displacement's at the centre."""
    turn = (MOTION.rotation * Rotation.from_matrix(found.fit.rotation).inv()).magnitude()
    return float(turn), float(np.linalg.norm(MOTION.apply(found.center) - found.center - found.fit.shift))


# --- the object's motion


@pytest.mark.parametrize("room", [0, 50, 400])
def test_what_moves_among_the_standing_is_the_object(crew: OneProcess, rig: Rig, room: int) -> None:
    """Without noise it is found exactly, however much stands still."""
    pairs = pairs_of(rig, [OBJECT], room)
    found = found_in(crew, rig, pairs)
    assert found.fit.status is Status.OK
    turn, shift = errors(found)
    assert turn < 2e-5
    assert shift < 2e-5
    # All of the object, and nothing else.
    displaced = moving(pairs, 0, OBJECT.count)
    assert found.count == sum(len(shift) for shift in displaced) > 0.9 * OBJECT.count * len(rig)
    assert found.shift_px == np.median(np.concatenate(displaced))
    for (inliers,), shifts in zip(found.inliers, displaced, strict=True):
        assert inliers.reference == FIRST
        assert len(inliers) == len(shifts)
        assert inliers.indices.max() < OBJECT.count


def test_where_it_is_and_how_large(crew: OneProcess, rig: Rig) -> None:
    found = found_in(crew, rig, pairs_of(rig, [OBJECT]))
    # An ellipsoid of 0.1 to 0.15, of which each camera sees one side.
    assert np.linalg.norm(found.middle - AT) < 0.3 * 0.15
    assert 0.1 < found.radius < 0.25
    np.testing.assert_array_equal(found.middle, found.center)


def test_noise_makes_errors_of_its_size(crew: OneProcess, rig: Rig) -> None:
    """0.3 pixels of a body that is 100 to 200 pixels large."""
    found = found_in(crew, rig, pairs_of(rig, [OBJECT], noise_px=0.3))
    assert found.fit.status is Status.OK
    turn, shift = errors(found)
    assert 1e-4 < turn < 1e-2
    assert 1e-4 < shift < 5e-3
    assert found.count > 0.9 * OBJECT.count * len(rig)


@pytest.mark.parametrize("count", [10, 20])
def test_something_small_that_moves_otherwise_is_left_out(crew: OneProcess, rig: Rig, count: int) -> None:
    pairs = pairs_of(rig, [OBJECT, Body(count, ELSEWHERE, OTHER)])
    found = found_in(crew, rig, pairs)
    assert max(errors(found)) < 2e-5
    assert found.count == sum(len(shift) for shift in moving(pairs, 0, OBJECT.count))
    # The centre that the motion is about is of all that moves, the object's place of the object alone.
    assert np.linalg.norm(found.middle - AT) < 0.3 * 0.15
    assert np.linalg.norm(found.center - found.middle) > 0.01


def test_what_moves_as_one_body_is_one_object(crew: OneProcess, rig: Rig) -> None:
    pairs = pairs_of(rig, [OBJECT, Body(50, ELSEWHERE, MOTION)])
    found = found_in(crew, rig, pairs)
    assert max(errors(found)) < 2e-5
    assert found.count > 0.95 * sum(len(shift) for shift in moving(pairs, 0, 110))
    assert found.radius > 0.3
    assert not is_ambiguous(crew, rig, pairs, FIRST, found, np.random.default_rng(1))


def assert_nothing(found: FirstMotion, cameras: int) -> None:
    assert found.fit.status is Status.TOO_FEW_MATCHES
    assert found.count == 0
    assert np.isnan(found.shift_px)
    assert np.isnan(found.radius)
    assert np.isnan(found.center).all()
    assert np.isnan(found.middle).all()
    assert found.center.shape == found.middle.shape == (3,)
    assert list(found.inliers) == [[]] * cameras


def test_while_nothing_moves_there_is_no_object(crew: OneProcess, rig: Rig) -> None:
    pairs = pairs_of(rig, [])
    assert_nothing(found_in(crew, rig, pairs), len(rig))
    standing = Body(60, AT, RigidTransform.identity())
    pairs = pairs_of(rig, [standing])
    found = found_in(crew, rig, pairs)
    assert_nothing(found, len(rig))
    assert not is_ambiguous(crew, rig, pairs, FIRST, found, np.random.default_rng(1))


def test_no_matches_no_motion(crew: OneProcess, rig: Rig) -> None:
    assert_nothing(found_in(crew, rig, [[] for _ in rig]), len(rig))
    empty = [[pair.subset(np.zeros(len(pair), bool)) for pair in of] for of in pairs_of(rig, [OBJECT])]
    assert_nothing(found_in(crew, rig, empty), len(rig))


def test_matches_with_other_frames_are_not_asked(crew: OneProcess, rig: Rig) -> None:
    other = pairs_of(rig, [OBJECT], reference=FIRST + 1)
    assert_nothing(found_in(crew, rig, other), len(rig))
    pairs = pairs_of(rig, [OBJECT])
    wrong = pairs_of(rig, [Body(60, AT, OTHER)], reference=FIRST + 1)
    found = found_in(crew, rig, [[*a, *b] for a, b in zip(wrong, pairs, strict=True)])
    assert max(errors(found)) < 2e-5
    assert {pair.reference for inliers in found.inliers for pair in inliers} == {FIRST}


def test_too_few_matches_are_no_motion(crew: OneProcess, rig: Rig) -> None:
    """Of three points in each camera nothing can be said."""
    found = found_in(crew, rig, pairs_of(rig, [Body(3 if len(rig) == 2 else 2, AT, MOTION)]))
    assert found.fit.status is Status.TOO_FEW_MATCHES
    assert found.count == 0
    assert np.isnan(found.shift_px)
    assert np.isnan(found.radius)
    assert list(found.inliers) == [[]] * len(rig)


def test_the_same_seed_the_same_motion(crew: OneProcess, rig: Rig) -> None:
    pairs = pairs_of(rig, [OBJECT], noise_px=0.3)
    one, again = found_in(crew, rig, pairs), found_in(crew, rig, pairs)
    np.testing.assert_array_equal(one.fit.rotation, again.fit.rotation)
    np.testing.assert_array_equal(one.fit.shift, again.fit.shift)


# --- which of two


@pytest.mark.parametrize(("count", "ambiguous"), [(10, False), (20, False), (40, True)])
def test_a_second_body_with_more_than_half_as_many_features_might_be_the_object(
    crew: OneProcess, rig: Rig, count: int, ambiguous: bool
) -> None:
    pairs = pairs_of(rig, [OBJECT, Body(count, ELSEWHERE, OTHER)])
    found = found_in(crew, rig, pairs)
    assert is_ambiguous(crew, rig, pairs, FIRST, found, np.random.default_rng(1)) == ambiguous


@pytest.mark.parametrize("more", [-1, 1])
def test_the_share_is_of_what_was_found(crew: OneProcess, rig: Rig, more: int) -> None:
    """To both sides of it, of a second body whose features are counted."""
    pairs = pairs_of(rig, [OBJECT, Body(40, ELSEWHERE, OTHER)])
    found = found_in(crew, rig, pairs)
    rival = found_in(crew, rig, pairs_of(rig, [Body(40, ELSEWHERE, OTHER)]))
    assert rival.fit.status is Status.OK
    assert rival.count > 0.9 * 40 * len(rig)
    larger = replace(found, count=int(rival.count / RIVAL_SHARE) + more)
    assert is_ambiguous(crew, rig, pairs, FIRST, larger, np.random.default_rng(1)) == (more < 0)


@pytest.mark.parametrize("noise_px", [0.0, 0.3])
def test_the_object_is_not_its_own_rival(crew: OneProcess, rig: Rig, noise_px: float) -> None:
    pairs = pairs_of(rig, [OBJECT], noise_px=noise_px)
    found = found_in(crew, rig, pairs)
    assert not is_ambiguous(crew, rig, pairs, FIRST, found, np.random.default_rng(1))
    # If it were not taken out it would be.
    blind = replace(found, inliers=[[] for _ in rig])
    assert is_ambiguous(crew, rig, pairs, FIRST, blind, np.random.default_rng(1))


def test_a_frame_that_waited_may_tell_where_the_surface_is() -> None:
    """Of two cameras the first motion leaves it open; the one that tells it makes the end of that motion forgotten."""
    take = KINDS["jumps-25"](np.random.default_rng([3, *b"jumps-25"]))
    tracked = list(track(islice(take.frames(), 5), take.scene.rig, take.boxes, seed=3))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 4
    truth = take.scene.poses()
    for frame in tracked:
        pose = frame.pose.world_from_object
        assert pose is not None
        off = pose * (truth[frame.pose.index] * truth[0].inv() * tracked[0].pose.world_from_object).inv()
        assert np.degrees(off.rotation.magnitude()) < 2.0
