"""Smoothing of tracked frames: measured, coasting and lost ones, and disconnected parts."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import smoothing
from sylpose.bundle_adjustment.bundle import BundleResult
from sylpose.bundle_adjustment.calibration_refinement import correct_rig, default_calibration_prior
from sylpose.bundle_adjustment.scale_prior import bundle_adjust_with_scale
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.results import FramePose
from sylpose.rig import Rig
from sylpose.simulate import ellipsoid, ring
from sylpose.smoothing import SmoothedTrajectory, Track, _select_observations, smooth, smooth_tracks
from sylpose.status import FrameStatus, Status
from sylpose.tracking.camera_side.frame import LandmarkObservations
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.joint_side.joint_state import Nudge
from sylpose.tracking.tracker import track
from tests.clips import RATE, track_turning_clip, turning_clip

RIG = ring(3, 1.5, 1000.0, height=(0.4, -0.1, 0.3))
RADIUS = 0.15
BODY = ellipsoid((RADIUS, 0.1, 0.12), n=400)
POINTS, NORMALS = BODY.points.copy(), BODY.normals.copy()  # SciPy's rotations do not accept read-only arrays
FRAMES = 24


def truth(k: int) -> RigidTransform:
    """Return a pose that rotates about 2 degrees per frame, along a curve, from the identity."""
    turn = Rotation.from_rotvec(np.deg2rad(2.0 * k + 3.0 * np.sin(k / 5)) * np.array([0.1, 0.99, 0.1]))
    return RigidTransform.from_components([0.03 * np.sin(k / 6), 0.02 * np.cos(k / 5) - 0.02, 0.004 * k], turn)


def make_tracks(
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
    """Return frames of a tracker with errors of 0.3 degrees and 2 mm.

    Landmark numbers change at one frame; after a camera motion the cameras are those of another rig.
    """
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
        matches: tuple[LandmarkObservations, ...] = tuple(
            see(pose, c, now, noise_px, rng, len(POINTS) * (c + len(rig) * (k >= apart_from))) for c in range(len(rig))
        )
        if k in coasting:
            status, matches = FrameStatus.COASTING, ()
        if k in lost:
            status, matches = FrameStatus.LOST, ()
        here = FramePose(
            k,
            k / 30.0,
            status,
            None if k in lost else found,
            np.zeros((6, 6)) if k == 0 else cell,
            np.zeros(len(rig), np.int64),
            np.full(len(rig), np.nan),
        )
        out.append(Track(here, matches, np.zeros(len(rig)), RADIUS, nudges))
    return out


def see(
    pose: RigidTransform, camera: int, rig: Rig, noise_px: float, rng: np.random.Generator, first: int
) -> LandmarkObservations:
    c, points = rig.cameras[camera], pose.apply(POINTS)
    to_camera = c.center - points
    facing = np.einsum("ni,ni->n", pose.rotation.apply(NORMALS), to_camera)
    visible = np.flatnonzero(facing > 0.25 * np.linalg.norm(to_camera, axis=1))
    local = c.camera_from_world.apply(points[visible])
    image = local[:, :2] / local[:, 2:] + noise_px / c.focal * rng.standard_normal((len(visible), 2))
    place = POINTS[visible] + 0.01 * rng.standard_normal((len(visible), 3))
    return LandmarkObservations(first + visible, image, place, np.ones(len(visible), bool))


def errors(smoothed: SmoothedTrajectory) -> FloatArray:
    """Return the (N, 6) error of (w, d), NaN rows for frames without a pose."""
    out = np.full((len(smoothed.poses), 6), np.nan)
    for k, pose in enumerate(smoothed.poses):
        if pose.world_from_object is not None:
            true, found = truth(k), pose.world_from_object
            turn = (true.rotation * found.rotation.inv()).as_rotvec()
            out[k] = np.concatenate([turn, true.translation - found.translation])
    return out


def with_uncertain_rotation(frame: Track, degrees: float) -> Track:
    """Rotate a frame about an axis about which its rotation is uncertain."""
    axis = np.array([0.0, 1.0, 0.0])
    there = frame.pose.world_from_object
    assert there is not None
    turned = RigidTransform.from_components(
        there.translation, Rotation.from_rotvec(np.deg2rad(degrees) * axis) * there.rotation
    )
    covariance = frame.pose.covariance.copy()
    covariance[:3, :3] += np.deg2rad(30.0) ** 2 * np.outer(axis, axis)
    pose = replace(frame.pose, world_from_object=turned, covariance=covariance).mark_uncertain()
    assert pose.status is FrameStatus.UNCERTAIN
    return replace(frame, pose=pose)


def test_cameras_that_disagree_widen_the_covariance() -> None:
    tracks = make_tracks(8)
    plain = smooth_tracks(tracks, RIG).poses
    # The median of the recording is 2; frame 3 was tracked while the cameras disagreed more. 0.1 narrows nothing.
    ratios = [np.nan, 2.0, 2.0, 4.0, 2.0, 2.0, 0.1, np.nan]
    wide = smooth_tracks(
        [replace(t, pose=replace(t.pose, f_ratio=f)) for t, f in zip(tracks, ratios, strict=True)], RIG
    ).poses
    for one, other, factor in zip(plain, wide, [1, 2, 2, 4, 2, 2, 2, 2], strict=True):
        np.testing.assert_allclose(other.covariance, factor * one.covariance, rtol=1e-9)


def test_errors_common_to_frames_keep_their_share_of_the_tracked_covariance() -> None:
    rng = np.random.default_rng(0)
    # Every two frames have the same errors of 0.3 pixels: they correlate by a half.
    noise = 3e-4 * rng.standard_normal((FRAMES // 2, len(RIG), len(POINTS), 2))
    common = [
        replace(
            track,
            observations=tuple(
                replace(seen, normalized=seen.normalized + noise[k // 2, c, seen.landmark_ids % len(POINTS)])
                for c, seen in enumerate(track.observations)
            ),
        )
        for k, track in enumerate(make_tracks(noise_px=0.0))
    ]
    independent = make_tracks()
    for tracks, share in ((independent, 0.0), (common, 0.5)):
        poses, tracked = smooth_tracks(tracks, RIG).poses, tracks[1].pose.covariance
        least = min(np.linalg.eigvals(np.linalg.solve(tracked, pose.covariance)).real.min() for pose in poses[1:])
        assert least > share - 0.1
        assert (least < 0.1) == (share == 0.0)


def test_change_beyond_the_tracked_uncertainty_is_part_of_the_covariance() -> None:
    turned, k = make_tracks(), 12
    pose = turned[k].pose
    assert pose.world_from_object is not None
    turn = Rotation.from_rotvec([0.0, 0.04, 0.0])  # 13 standard deviations
    there = RigidTransform.from_components(pose.world_from_object.translation, turn * pose.world_from_object.rotation)
    turned[k] = replace(turned[k], pose=replace(pose, world_from_object=there))
    plain, found = smooth_tracks(make_tracks(), RIG), smooth_tracks(turned, RIG)
    refined = found.poses[k]
    assert refined.world_from_object is not None
    change = (refined.world_from_object.rotation * there.rotation.inv()).as_rotvec()
    assert change[1] == pytest.approx(-0.04, abs=0.015)
    added = refined.covariance - plain.poses[k].covariance
    np.testing.assert_allclose(added[:3, :3], np.outer(change, change), atol=1e-6)
    # No other frame is affected, nor any where the rig is estimated as well, which moves poses.
    for other in {*range(1, FRAMES)} - {k}:
        assert np.trace(found.poses[other].covariance) < 1.1 * np.trace(plain.poses[other].covariance)
    recalibrated = smooth_tracks(turned, RIG, calibration_prior=default_calibration_prior(RIG), recalibrate=True)
    assert recalibrated.poses[k].covariance[1, 1] < 0.1 * added[1, 1]


def test_smoothing_recovers_uncertain_rotations_without_raising_their_status() -> None:
    frames = [with_uncertain_rotation(f, 8.0) if 8 <= k < 16 else f for k, f in enumerate(make_tracks())]
    found = smooth_tracks(frames, RIG)
    assert [p.status for p in found.poses] == [f.pose.status for f in frames]
    assert np.rad2deg(np.abs(errors(found)[:, :3])).max() < 0.2


def test_refinement_that_does_not_converge_is_discarded(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, refine = make_tracks(), bundle_adjust_with_scale

    def fail(*arguments: Any, **options: Any) -> BundleResult:
        return replace(refine(*arguments, **options), status=Status.NOT_CONVERGED)

    monkeypatch.setattr(smoothing, "bundle_adjust_by_keyframes", fail)
    found = smooth_tracks(frames, RIG)
    assert found.status is Status.NOT_CONVERGED
    assert found.poses == tuple(f.pose for f in frames)


def test_disconnected_uncertain_frame_is_unchanged() -> None:
    # On a curve through its neighbors its covariance would be as small as theirs.
    blind = (LandmarkObservations(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 3)), np.empty(0, bool)),) * len(
        RIG
    )
    frames = [
        replace(with_uncertain_rotation(f, 8.0), observations=blind) if 8 <= k < 16 else f
        for k, f in enumerate(make_tracks())
    ]
    found = smooth_tracks(frames, RIG)
    for k in range(8, 16):
        assert found.poses[k].status is FrameStatus.UNCERTAIN
        np.testing.assert_array_equal(found.poses[k].covariance, frames[k].pose.covariance)
        now, before = found.poses[k].world_from_object, frames[k].pose.world_from_object
        assert now is not None
        assert before is not None
        np.testing.assert_allclose(now.as_matrix(), before.as_matrix())
    assert found.poses[20].status is FrameStatus.TRACKED


def test_exact_without_noise() -> None:
    frames = make_tracks(noise_px=0.0)
    found = smooth_tracks(frames, RIG)
    assert found.status is Status.OK
    assert np.abs(errors(found)).max() < 1e-5
    assert [p.status for p in found.poses] == [f.pose.status for f in frames]
    assert not found.offsets.any()
    first = found.poses[0]
    assert first is frames[0].pose


def test_more_accurate_and_consistent() -> None:
    frames = make_tracks()
    found = smooth_tracks(frames, RIG)
    assert found.status is Status.OK
    e = errors(found)
    assert np.abs(e[:, :3]).max() < np.deg2rad(0.15)
    assert np.abs(e[:, 3:]).max() < 1e-3
    np.testing.assert_allclose(found.sigma_px, 0.3, rtol=0.1)
    normalised = [
        x @ np.linalg.solve(p.covariance, x) for x, p in zip(e[1:], found.poses[1:], strict=True)
    ]  # 6 on average, but one draw: all frames share the first one's error
    assert 0.87 < np.mean(normalised) < 17.0  # one in a hundred on each side
    assert all(p.inliers.sum() > 200 for p in found.poses[1:])
    assert 0.2 < np.nanmedian([p.residuals for p in found.poses[1:]]) / np.sqrt(2) < 0.4


def test_camera_motion_is_estimated() -> None:
    """Its images are rotated back; its translation is only determined by the object's observations."""
    values = np.zeros((3, 14))
    values[1, 7:10] = shift = np.array([0.012, -0.015, 0.009])
    nudge, prior = Nudge(1, 10, np.deg2rad([0.5, 1.5, -1.0]), 1e-4), default_calibration_prior(RIG)
    frames = make_tracks(nudged=(nudge, correct_rig(RIG, values)), seed=2)
    without_motion = smooth_tracks([replace(frame, nudges=()) for frame in frames], RIG, calibration_prior=prior)
    found = smooth_tracks(frames, RIG, calibration_prior=prior)
    assert [(m.camera, m.frame) for m in found.moved_cameras] == [(1, 10)]
    assert found.correction is None
    wrong, e = (np.abs(errors(s)[10:]) for s in (without_motion, found))
    assert e[:, :3].max() < min(np.deg2rad(0.15), 0.1 * wrong[:, :3].max())
    assert e[:, 3:].max() < min(1.5e-3, 0.1 * wrong[:, 3:].max())
    # Hardly less certain than without a camera motion.
    sigmas = [s.poses[-1].sigma for s in (found, smooth_tracks(make_tracks(seed=2), RIG, calibration_prior=prior))]
    assert (sigmas[0] < 2.0 * sigmas[1]).all()
    text = smooth_tracks(frames, RIG, calibration_prior=prior, recalibrate=True).correction
    assert text is not None
    off, sd, prior_sd = text.values[3] - np.concatenate([np.zeros(3), shift, np.zeros(4)]), text.sd[3], text.prior_sd[3]
    assert (np.abs(off[:6]) < 4.0 * sd[:6]).all()
    assert (sd[3:6] < 0.3 * prior_sd[3:6]).all()
    assert not text.values[3, 6:].any()  # one lens, before and after
    np.testing.assert_array_equal(text.rig.cameras[3].matrix, text.rig.cameras[1].matrix)
    assert smooth_tracks(frames, RIG).moved_cameras == ()  # without a calibration prior


def test_one_camera() -> None:
    rig = Rig(RIG.cameras[:1])
    found = smooth_tracks(make_tracks(rig=rig, noise_px=0.1), rig)
    assert found.status is Status.OK
    # The scale is that of the initial poses and positions: the remaining rotation error is small.
    assert np.rad2deg(np.abs(errors(found)[:, :3])).max() < 0.3


def test_coasting_frames_are_interpolated() -> None:
    gap = (9, 10, 11, 12)
    found = smooth_tracks(make_tracks(coasting=gap), RIG)
    assert [found.poses[k].status for k in gap] == [FrameStatus.INTERPOLATED] * 4
    e = errors(found)
    assert np.abs(e[list(gap), :3]).max() < np.deg2rad(0.1)  # the tracker's were off by 0.3 degrees
    assert np.abs(e[list(gap), 3:]).max() < 1e-3
    for k in gap:
        assert np.linalg.eigvalsh(found.poses[k].covariance - found.poses[8].covariance).min() >= 0.0


def test_coasting_at_the_end_follows_the_last_pose() -> None:
    frames = make_tracks(coasting=(22, 23))
    found = smooth_tracks(frames, RIG)
    last, was = found.poses[21].world_from_object, frames[21].pose.world_from_object
    then, now = frames[23].pose.world_from_object, found.poses[23].world_from_object
    assert last is not None
    assert was is not None
    assert then is not None
    assert now is not None
    relative, expected = last.inv() * now, was.inv() * then
    np.testing.assert_allclose(relative.as_matrix(), expected.as_matrix(), atol=1e-12)


def test_lost_frames_stay_lost() -> None:
    frames = make_tracks(coasting=(8, 9), lost=(10, 11, 12))
    found = smooth_tracks(frames, RIG)
    assert [p.world_from_object is None for p in found.poses] == [k in (10, 11, 12) for k in range(FRAMES)]
    e = errors(found)
    assert np.nanmax(np.abs(np.delete(e, (8, 9), axis=0)[:, :3])) < np.deg2rad(0.15)
    # The path between is unknown: coasting poses move along with the last measured one, 7.
    last, was, then = (p.world_from_object for p in (found.poses[7], frames[7].pose, frames[9].pose))
    now = found.poses[9].world_from_object
    assert last is not None
    assert was is not None
    assert then is not None
    assert now is not None
    np.testing.assert_allclose((last.inv() * now).as_matrix(), (was.inv() * then).as_matrix(), atol=1e-12)


def test_disconnected_part_is_unchanged() -> None:
    frames = make_tracks(apart_from=14, coasting=(12, 13))
    found = smooth_tracks(frames, RIG)
    assert found.status is Status.OK
    assert np.abs(errors(found)[:12, :3]).max() < np.deg2rad(0.15)
    for k in range(14, FRAMES):
        assert found.poses[k] is frames[k].pose


def test_time_offsets() -> None:
    late = np.array([0.004, -0.003, -0.001])
    frames = make_tracks(40, noise_px=0.0)
    own = [make_delayed_tracks(k, late) for k in range(40)]
    frames = [replace(f, observations=s) for f, s in zip(frames, own, strict=True)]
    found = smooth_tracks(frames, RIG, offsets_sd=0.02)
    assert found.status is Status.OK
    np.testing.assert_allclose(found.offsets, late, atol=3e-4)
    stamped = smooth_tracks([replace(f, time_offsets=late) for f in frames], RIG)
    assert np.abs(errors(stamped)[:, :3]).max() < np.deg2rad(0.15)


def make_delayed_tracks(k: int, late: FloatArray) -> tuple[LandmarkObservations, ...]:
    """Return frames of cameras with time offsets, noise-free except for the positions."""
    rng = np.random.default_rng(k)
    poses = [truth(k + s * 30.0) for s in late]
    return tuple(see(p, c, RIG, 0.0, rng, len(POINTS) * c) for c, p in enumerate(poses))


@pytest.mark.parametrize("n", [0, 1])
def test_nothing_to_refine(n: int) -> None:
    frames = make_tracks(n)
    found = smooth_tracks(frames, RIG)
    assert found.status is Status.TOO_FEW_MATCHES
    assert found.poses == tuple(f.pose for f in frames)
    assert found.iterations == 0


def test_no_landmark_twice() -> None:
    frames = make_tracks(6)
    frames = [
        replace(f, observations=tuple(replace(s, landmark_ids=s.landmark_ids + 10**6 * k) for s in f.observations))
        for k, f in enumerate(frames)
    ]
    found = smooth_tracks(frames, RIG)
    assert found.status is Status.TOO_FEW_MATCHES
    assert found.poses == tuple(f.pose for f in frames)


def test_short_tracks_are_used_if_necessary() -> None:
    # 200 landmarks seen in frames 0 to 9; 50 seen in frames 0 and 1; 50 in frames 9 and 10; 50 seen once.
    landmark = np.concatenate([np.tile(np.arange(200), 10), *[np.arange(n, n + 50) for n in (200, 200, 250, 250, 300)]])
    frame = np.concatenate([np.repeat(np.arange(10), 200), np.repeat([0, 1, 9, 10, 3], 50)])
    used = _select_observations(frame.astype(np.int64), landmark.astype(np.int64), np.ones(350, bool))
    counts = np.bincount(landmark, used, minlength=350)
    assert (counts[:200] == 10).all()
    assert not counts[200:250].any()
    assert (counts[250:300] == 2).all()
    assert not counts[300:].any()


def test_static_landmarks_are_used_if_necessary() -> None:
    """Short tracks that never moved may be background: 90 landmarks in frames 0 to 9; in frames 8 to 11, 60 that never
    moved and 60 that did; in frames 12 and 13 ten that never moved, the only ones there."""
    often, seldom = np.repeat(np.arange(10), 90), np.repeat(np.arange(8, 12), 60)
    landmark = np.concatenate([np.tile(np.arange(90), 10), *[np.tile(np.arange(n, n + 60), 4) for n in (100, 200)]])
    landmark = np.concatenate([landmark, np.tile(np.arange(300, 310), 2)]).astype(np.int64)
    frame = np.concatenate([often, seldom, seldom, np.repeat([12, 13], 10)]).astype(np.int64)
    moved = np.arange(310) >= 200
    moved[300:] = False
    counts = np.bincount(landmark, _select_observations(frame, landmark, moved), minlength=310)
    assert (counts[:90] == 10).all()  # long tracks, whether they moved or not
    assert not counts[100:160].any()
    assert (counts[200:260] == 4).all()
    assert (counts[300:] == 2).all()


def test_contradicted_frame_keeps_its_tracked_pose_as_contradicted() -> None:
    """It keeps the tracker's pose and covariance, moved along with its neighbors, but is no longer certain."""
    frames, k, rng = make_tracks(), 14, np.random.default_rng(5)
    junk = [replace(s, normalized=rng.uniform(-0.1, 0.1, s.normalized.shape)) for s in frames[k].observations]
    frames[k] = replace(frames[k], observations=tuple(junk))
    found = smooth_tracks(frames, RIG)
    assert found.status is Status.OK
    before, now = frames[k - 1].pose.world_from_object, found.poses[k - 1].world_from_object
    reported, kept = frames[k].pose.world_from_object, found.poses[k].world_from_object
    assert before is not None
    assert now is not None
    assert reported is not None
    assert kept is not None
    expected = now * before.inv() * reported
    np.testing.assert_allclose(kept.as_matrix(), expected.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(found.poses[k].covariance, frames[k].pose.covariance)
    assert found.poses[k].status is FrameStatus.CONTRADICTED
    others = np.delete(errors(found), k, axis=0)
    assert np.abs(others[:, :3]).max() < np.deg2rad(0.15)


def test_contradicted_frames_do_not_bend_the_others() -> None:
    """The tracker followed another body for eleven frames, from landmarks that the first frame has in common."""
    frames, wrong = make_tracks(), range(1, 12)
    drift = Rotation.from_rotvec([0.0, 0.02, 0.0])
    for k in wrong:
        there, other = truth(k), RigidTransform.from_rotation(drift**k)
        seen = tuple(
            see(other * there, c, RIG, 0.3, np.random.default_rng(k), len(POINTS) * c) for c in range(len(RIG))
        )
        pose = replace(frames[k].pose, world_from_object=other * there, status=FrameStatus.CONTRADICTED)
        frames[k] = replace(frames[k], pose=pose, observations=seen)
    found = smooth_tracks(frames, RIG)
    assert found.status is Status.OK
    assert {found.poses[k].status for k in wrong} == {FrameStatus.CONTRADICTED}
    assert np.abs(errors(found)[wrong.stop :, :3]).max() < np.deg2rad(0.15)


def test_track_keeps_no_images() -> None:
    image = np.zeros((480, 640, 3), np.uint8)
    frames = FrameSet(3, 0.1, (None,) * 3, (image,) * 3, (None,) * 3)
    matches = tuple((np.zeros((300, 2)), np.zeros((300, 2))) for _ in range(3))
    track = make_tracks(2)[1]
    yielded = TrackedFrame(track.pose, frames, matches, (None,) * 3, RADIUS, track.observations, track.time_offsets)
    kept = Track.from_tracked(yielded)
    assert kept.pose is yielded.pose
    assert kept.observations is yielded.observations
    sights = sum(len(s.landmark_ids) for s in kept.observations)
    assert len(pickle.dumps(kept)) < 48 * sights + 4000  # a number, two and three coordinates of eight bytes each


def test_images_in_memory_are_tracked_and_smoothed() -> None:
    """The README's way: frame sets of arrays, numbered by the tracker, and a trajectory as `track_session` makes it."""
    clip, known = turning_clip(), track_turning_clip(with_boxes=True)
    frames = [FrameSet.of(images, k / RATE) for k, images in enumerate(clip.images)]
    found = smooth(track(frames, clip.rig, clip.boxes), clip.rig)
    prior = default_calibration_prior(clip.rig)
    expected = smooth_tracks([Track.from_tracked(frame) for frame in known], clip.rig, calibration_prior=prior)
    assert (found.camera_names, found.unit, [pose.index for pose in found]) == (clip.rig.names, "m", [*range(8)])
    for pose, reference in zip(found, expected.poses, strict=True):
        assert pose.world_from_object is not None
        assert reference.world_from_object is not None
        assert np.array_equal(pose.world_from_object.as_matrix(), reference.world_from_object.as_matrix())
        assert np.array_equal(pose.covariance, reference.covariance)


def test_frames_that_cannot_be_smoothed_are_returned_with_a_warning() -> None:
    clip, known = turning_clip(), track_turning_clip(with_boxes=True)
    with pytest.warns(UserWarning, match=r"The poses are as tracked\."):
        found = smooth(known[:1], clip.rig)
    assert found[0] is known[0].pose
    with pytest.raises(ValueError, match=r"frames\[0\]: tracked with 3 cameras, the rig has 2"):
        smooth(known, clip.rig[:2])
    with pytest.raises(TypeError, match=r"frames\[0\] must be TrackedFrame, got 3"):
        smooth([3], clip.rig)  # type: ignore[list-item]
    learned = replace(known[0], learned_pose=known[0].pose)
    with pytest.raises(ValueError, match="known from another recording; use `track_session`"):
        smooth([learned], clip.rig)


def test_frame_sets_of_wrong_images_are_rejected() -> None:
    clip = turning_clip()
    image = clip.images[0][0]
    with pytest.raises(TypeError, match="images must be a list with one image for each camera, got an array of uint8"):
        FrameSet.of(image, 0.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"images\[1\] must be an array of uint8, got an array of float32"):
        FrameSet.of([image, image.astype(np.float32)], 0.0)
    with pytest.raises(ValueError, match="masks: 1 for 2 images"):
        FrameSet.of([image, None], 0.0, [None])
    with pytest.raises(ValueError, match="2 images for 3 cameras"):
        list(track([FrameSet.of([image, image], 0.0)], clip.rig))
