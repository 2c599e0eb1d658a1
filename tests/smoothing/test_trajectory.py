"""Smoothing: what it makes of a tracker's frames, measured, coasting and lost ones, and of pieces that nothing ties."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.calibration_refinement import corrected, usual_doubt
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.results import FramePose, FrameStatus, Status
from sylpose.rig import Rig
from sylpose.simulate import ellipsoid, ring
from sylpose.smoothing.trajectory import Smoothed, Track, _worth_using, smooth
from sylpose.tracking.joint_state import Nudge
from sylpose.tracking.tracked_frame import Sightings, TrackedFrame

RIG = ring(3, 1.5, 1000.0, height=(0.4, -0.1, 0.3))
RADIUS = 0.15
BODY = ellipsoid((RADIUS, 0.1, 0.12), n=400)
POINTS, NORMALS = BODY.points.copy(), BODY.normals.copy()  # SciPy's rotations take no read-only arrays
FRAMES = 24


def truth(k: int) -> RigidTransform:
    """About 2 degrees per frame, along a curve, from the identity."""
    turn = Rotation.from_rotvec(np.deg2rad(2.0 * k + 3.0 * np.sin(k / 5)) * np.array([0.1, 0.99, 0.1]))
    return RigidTransform.from_components([0.03 * np.sin(k / 6), 0.02 * np.cos(k / 5) - 0.02, 0.004 * k], turn)


def tracked(
    n: int = FRAMES,
    *,
    noise_px: float = 0.3,
    rig: Rig = RIG,
    coasting: tuple[int, ...] = (),
    lost: tuple[int, ...] = (),
    apart_from: int = 1000,
    nudged: tuple[Nudge, Rig] | None = None,
    seed: int = 0,
) -> list[Track]:
    """What a tracker with errors of 0.3 degrees and 2 mm would give; landmarks have other numbers from a frame on; from a
    nudge on the cameras are those of another rig."""
    rng, out = np.random.default_rng(seed), []
    cell = np.eye(6) * np.repeat([1e-5, 1e-5], 3)
    for k in range(n):
        pose = truth(k)
        found = pose
        if k:
            shake = Rotation.from_rotvec(np.deg2rad(0.3) * rng.standard_normal(3))
            found = RigidTransform.from_components(
                pose.translation + 0.002 * rng.standard_normal(3), shake * pose.rotation
            )
        status = FrameStatus.FIRST if k == 0 else FrameStatus.TRACKED
        nudges = (nudged[0],) if nudged is not None and k >= nudged[0].frame else ()
        now = nudged[1] if nudged is not None and nudges else rig
        sights: tuple[Sightings, ...] = tuple(
            see(pose, c, now, noise_px, rng, len(POINTS) * (c + len(rig) * (k >= apart_from))) for c in range(len(rig))
        )
        if k in coasting:
            status, sights = FrameStatus.COASTING, ()
        if k in lost:
            status, sights = FrameStatus.LOST, ()
        here = FramePose(
            k,
            k / 30.0,
            status,
            None if k in lost else found,
            np.zeros((6, 6)) if k == 0 else cell,
            np.zeros(len(rig), np.int64),
            np.full(len(rig), np.nan),
        )
        out.append(Track(here, sights, np.zeros(len(rig)), RADIUS, nudges))
    return out


def see(
    pose: RigidTransform, camera: int, rig: Rig, noise_px: float, rng: np.random.Generator, first: int
) -> Sightings:
    c, points = rig.cameras[camera], pose.apply(POINTS)
    to_camera = c.center - points
    facing = np.einsum("ni,ni->n", pose.rotation.apply(NORMALS), to_camera)
    visible = np.flatnonzero(facing > 0.25 * np.linalg.norm(to_camera, axis=1))
    local = c.camera_from_world.apply(points[visible])
    image = local[:, :2] / local[:, 2:] + noise_px / c.focal * rng.standard_normal((len(visible), 2))
    place = POINTS[visible] + 0.01 * rng.standard_normal((len(visible), 3))
    return Sightings(first + visible, image, place, np.ones(len(visible), bool))


def errors(smoothed: Smoothed) -> FloatArray:
    """(N, 6) of (w, d), NaN rows for frames without a pose."""
    out = np.full((len(smoothed.poses), 6), np.nan)
    for k, pose in enumerate(smoothed.poses):
        if pose.world_from_object is not None:
            true, found = truth(k), pose.world_from_object
            turn = (true.rotation * found.rotation.inv()).as_rotvec()
            out[k] = np.concatenate([turn, true.translation - found.translation])
    return out


def hardly_known(frame: Track, degrees: float) -> Track:
    """Turned by so much about an axis about which that is not known."""
    axis = np.array([0.0, 1.0, 0.0])
    there = frame.pose.world_from_object
    assert there is not None
    turned = RigidTransform.from_components(
        there.translation, Rotation.from_rotvec(np.deg2rad(degrees) * axis) * there.rotation
    )
    covariance = frame.pose.covariance.copy()
    covariance[:3, :3] += np.deg2rad(30.0) ** 2 * np.outer(axis, axis)
    pose = replace(frame.pose, world_from_object=turned, covariance=covariance).judged()
    assert pose.status is FrameStatus.UNCERTAIN
    return replace(frame, pose=pose)


def test_smoothing_may_know_how_a_frame_is_turned_that_tracking_did_not() -> None:
    frames = [hardly_known(f, 8.0) if 8 <= k < 16 else f for k, f in enumerate(tracked())]
    found = smooth(frames, RIG)
    assert all(p.status is FrameStatus.TRACKED for p in found.poses[1:])
    assert np.rad2deg(np.abs(errors(found)[:, :3])).max() < 0.2


def test_an_uncertain_frame_that_ties_nothing_keeps_its_pose_and_its_doubt() -> None:
    # On a curve through its neighbours it would be as sure as they are.
    blind = (Sightings(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 3)), np.empty(0, bool)),) * len(RIG)
    frames = [replace(hardly_known(f, 8.0), sightings=blind) if 8 <= k < 16 else f for k, f in enumerate(tracked())]
    found = smooth(frames, RIG)
    for k in range(8, 16):
        assert found.poses[k].status is FrameStatus.UNCERTAIN
        np.testing.assert_array_equal(found.poses[k].covariance, frames[k].pose.covariance)
        now, before = found.poses[k].world_from_object, frames[k].pose.world_from_object
        assert now is not None
        assert before is not None
        np.testing.assert_allclose(now.as_matrix(), before.as_matrix())
    assert found.poses[20].status is FrameStatus.TRACKED


def test_exact_without_noise() -> None:
    frames = tracked(noise_px=0.0)
    found = smooth(frames, RIG)
    assert found.status is Status.OK
    assert np.abs(errors(found)).max() < 1e-5
    assert [p.status for p in found.poses] == [f.pose.status for f in frames]
    assert not found.offsets.any()
    first = found.poses[0]
    assert first is frames[0].pose


def test_better_than_before_and_says_how_good() -> None:
    frames = tracked()
    found = smooth(frames, RIG)
    assert found.status is Status.OK
    e = errors(found)
    assert np.abs(e[:, :3]).max() < np.deg2rad(0.15)
    assert np.abs(e[:, 3:]).max() < 1e-3
    np.testing.assert_allclose(found.sigma_px, 0.3, rtol=0.1)
    normalised = [
        x @ np.linalg.solve(p.covariance, x) for x, p in zip(e[1:], found.poses[1:], strict=True)
    ]  # 6 on average, but one draw: all frames share the first one's error
    assert 0.87 < np.mean(normalised) < 17.0  # one in a hundred on either side
    assert all(p.inliers.sum() > 200 for p in found.poses[1:])
    assert 0.2 < np.nanmedian([p.residuals for p in found.poses[1:]]) / np.sqrt(2) < 0.4


def test_a_camera_that_was_nudged_stands_elsewhere() -> None:
    """Its images are turned back; that it was shifted, too, only what it sees of the object tells."""
    values = np.zeros((3, 14))
    values[1, 7:10] = shift = np.array([0.012, -0.015, 0.009])
    nudge, doubt = Nudge(1, 10, np.deg2rad([0.5, 1.5, -1.0]), 1e-4), usual_doubt(RIG)
    frames = tracked(nudged=(nudge, corrected(RIG, values)), seed=2)
    as_if = smooth([replace(frame, nudges=()) for frame in frames], RIG, doubt=doubt)
    found = smooth(frames, RIG, doubt=doubt)
    assert [(m.camera, m.frame) for m in found.moved] == [(1, 10)]
    assert found.correction is None
    wrong, e = (np.abs(errors(s)[10:]) for s in (as_if, found))
    assert e[:, :3].max() < min(np.deg2rad(0.15), 0.1 * wrong[:, :3].max())
    assert e[:, 3:].max() < min(1.5e-3, 0.1 * wrong[:, 3:].max())
    # Hardly less certain than if nothing had happened.
    sigmas = [s.poses[-1].sigma for s in (found, smooth(tracked(seed=2), RIG, doubt=doubt))]
    assert (sigmas[0] < 2.0 * sigmas[1]).all()
    said = smooth(frames, RIG, doubt=doubt, recalibrate=True).correction
    assert said is not None
    off, sd, believed = said.values[3] - np.concatenate([np.zeros(3), shift, np.zeros(4)]), said.sd[3], said.believed[3]
    assert (np.abs(off[:6]) < 4.0 * sd[:6]).all()
    assert (sd[3:6] < 0.3 * believed[3:6]).all()
    assert not said.values[3, 6:].any()  # one lens, before and after
    np.testing.assert_array_equal(said.rig.cameras[3].matrix, said.rig.cameras[1].matrix)
    assert smooth(frames, RIG).moved == ()  # nothing is doubted


def test_one_camera() -> None:
    rig = Rig(RIG.cameras[:1])
    found = smooth(tracked(rig=rig, noise_px=0.1), rig)
    assert found.status is Status.OK
    # The scale is whatever the first poses and places say: what is left of the turn is good.
    assert np.rad2deg(np.abs(errors(found)[:, :3])).max() < 0.3


def test_coasting_frames_go_between_their_neighbours() -> None:
    gap = (9, 10, 11, 12)
    found = smooth(tracked(coasting=gap), RIG)
    assert [found.poses[k].status for k in gap] == [FrameStatus.COASTING] * 4
    e = errors(found)
    assert np.abs(e[list(gap), :3]).max() < np.deg2rad(0.1)  # the tracker's were off by 0.3 degrees
    assert np.abs(e[list(gap), 3:]).max() < 1e-3
    for k in gap:
        assert np.linalg.eigvalsh(found.poses[k].covariance - found.poses[8].covariance).min() >= 0.0


def test_coasting_at_the_end_is_carried_along() -> None:
    frames = tracked(coasting=(22, 23))
    found = smooth(frames, RIG)
    last, was = found.poses[21].world_from_object, frames[21].pose.world_from_object
    then, now = frames[23].pose.world_from_object, found.poses[23].world_from_object
    assert last is not None
    assert was is not None
    assert then is not None
    assert now is not None
    relative, expected = last.inv() * now, was.inv() * then
    np.testing.assert_allclose(relative.as_matrix(), expected.as_matrix(), atol=1e-12)


def test_lost_frames_stay_lost() -> None:
    frames = tracked(coasting=(8, 9), lost=(10, 11, 12))
    found = smooth(frames, RIG)
    assert [p.world_from_object is None for p in found.poses] == [k in (10, 11, 12) for k in range(FRAMES)]
    e = errors(found)
    assert np.nanmax(np.abs(np.delete(e, (8, 9), axis=0)[:, :3])) < np.deg2rad(0.15)
    # Nothing is known of the way between: coasting ones are carried along with the last measured one, 7.
    last, was, then = (p.world_from_object for p in (found.poses[7], frames[7].pose, frames[9].pose))
    now = found.poses[9].world_from_object
    assert last is not None
    assert was is not None
    assert then is not None
    assert now is not None
    np.testing.assert_allclose((last.inv() * now).as_matrix(), (was.inv() * then).as_matrix(), atol=1e-12)


def test_a_piece_that_nothing_ties_stays_as_tracked() -> None:
    frames = tracked(apart_from=14, coasting=(12, 13))
    found = smooth(frames, RIG)
    assert found.status is Status.OK
    assert np.abs(errors(found)[:12, :3]).max() < np.deg2rad(0.15)
    for k in range(14, FRAMES):
        assert found.poses[k] is frames[k].pose


def test_time_offsets() -> None:
    late = np.array([0.004, -0.003, -0.001])
    frames = tracked(40, noise_px=0.0)
    own = [tracked_at(k, late) for k in range(40)]
    frames = [replace(f, sightings=s) for f, s in zip(frames, own, strict=True)]
    found = smooth(frames, RIG, offsets_sd=0.02)
    assert found.status is Status.OK
    np.testing.assert_allclose(found.offsets, late, atol=3e-4)
    stamped = smooth([replace(f, late=late) for f in frames], RIG)
    assert np.abs(errors(stamped)[:, :3]).max() < np.deg2rad(0.15)


def tracked_at(k: int, late: FloatArray) -> tuple[Sightings, ...]:
    """What cameras see that are late, without noise but for the places' own."""
    rng = np.random.default_rng(k)
    poses = [truth(k + s * 30.0) for s in late]
    return tuple(see(p, c, RIG, 0.0, rng, len(POINTS) * c) for c, p in enumerate(poses))


@pytest.mark.parametrize("n", [0, 1])
def test_nothing_to_refine(n: int) -> None:
    frames = tracked(n)
    found = smooth(frames, RIG)
    assert found.status is Status.TOO_FEW_MATCHES
    assert found.poses == tuple(f.pose for f in frames)
    assert found.rounds == 0


def test_no_landmark_twice() -> None:
    frames = tracked(6)
    frames = [
        replace(f, sightings=tuple(replace(s, landmark=s.landmark + 10**6 * k) for s in f.sightings))
        for k, f in enumerate(frames)
    ]
    found = smooth(frames, RIG)
    assert found.status is Status.TOO_FEW_MATCHES
    assert found.poses == tuple(f.pose for f in frames)


def test_rarely_seen_landmarks_count_where_there_are_no_others() -> None:
    # 200 landmarks seen in frames 0 to 9; 50 seen in frames 0 and 1; 50 in frames 9 and 10; 50 seen once.
    landmark = np.concatenate([np.tile(np.arange(200), 10), *[np.arange(n, n + 50) for n in (200, 200, 250, 250, 300)]])
    frame = np.concatenate([np.repeat(np.arange(10), 200), np.repeat([0, 1, 9, 10, 3], 50)])
    used = _worth_using(frame.astype(np.int64), landmark.astype(np.int64), np.ones(350, bool))
    counts = np.bincount(landmark, used, minlength=350)
    assert (counts[:200] == 10).all()
    assert not counts[200:250].any()
    assert (counts[250:300] == 2).all()
    assert not counts[300:].any()


def test_what_never_moved_counts_where_there_is_hardly_anything_else() -> None:
    """Seldom seen, it may be background: 90 landmarks in frames 0 to 9; in frames 8 to 11, 60 that never moved and 60 that
    did; in frames 12 and 13 ten that never moved, the only ones there."""
    often, seldom = np.repeat(np.arange(10), 90), np.repeat(np.arange(8, 12), 60)
    landmark = np.concatenate([np.tile(np.arange(90), 10), *[np.tile(np.arange(n, n + 60), 4) for n in (100, 200)]])
    landmark = np.concatenate([landmark, np.tile(np.arange(300, 310), 2)]).astype(np.int64)
    frame = np.concatenate([often, seldom, seldom, np.repeat([12, 13], 10)]).astype(np.int64)
    moved = np.arange(310) >= 200
    moved[300:] = False
    counts = np.bincount(landmark, _worth_using(frame, landmark, moved), minlength=310)
    assert (counts[:90] == 10).all()  # often: whether it moved or not
    assert not counts[100:160].any()
    assert (counts[200:260] == 4).all()
    assert (counts[300:] == 2).all()


def test_a_frame_that_contradicts_all_others_is_carried_along_as_tracked() -> None:
    """What the tracker said of it stands, with its uncertainty, where its neighbours went."""
    frames, k, rng = tracked(), 14, np.random.default_rng(5)
    junk = [replace(s, normalized=rng.uniform(-0.1, 0.1, s.normalized.shape)) for s in frames[k].sightings]
    frames[k] = replace(frames[k], sightings=tuple(junk))
    found = smooth(frames, RIG)
    assert found.status is Status.OK
    before, now = frames[k - 1].pose.world_from_object, found.poses[k - 1].world_from_object
    told, kept = frames[k].pose.world_from_object, found.poses[k].world_from_object
    assert before is not None
    assert now is not None
    assert told is not None
    assert kept is not None
    expected = now * before.inv() * told
    np.testing.assert_allclose(kept.as_matrix(), expected.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(found.poses[k].covariance, frames[k].pose.covariance)
    assert found.poses[k].status is FrameStatus.TRACKED
    others = np.delete(errors(found), k, axis=0)
    assert np.abs(others[:, :3]).max() < np.deg2rad(0.15)


def test_a_track_keeps_no_images() -> None:
    image = np.zeros((480, 640, 3), np.uint8)
    frames = FrameSet(3, 0.1, (None,) * 3, (image,) * 3, (None,) * 3)
    matches = tuple((np.zeros((300, 2)), np.zeros((300, 2))) for _ in range(3))
    track = tracked(2)[1]
    yielded = TrackedFrame(track.pose, frames, matches, (None,) * 3, RADIUS, track.sightings, track.late)
    kept = Track.of(yielded)
    assert kept.pose is yielded.pose
    assert kept.sightings is yielded.sightings
    sights = sum(len(s.landmark) for s in kept.sightings)
    assert len(pickle.dumps(kept)) < 48 * sights + 4000  # a number, two and three coordinates of eight bytes each
