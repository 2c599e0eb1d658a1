"""Images taken at different instants: moved to common ones, by exact time stamps and without them."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import RigidTransform, RotationSpline

from sylpose.bundle_adjustment.bundle import Observations
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.rig_calibration.camera_tracks import RefinedTrack, refine_track
from sylpose.rig_calibration.from_motion import calibrate_from_motion
from sylpose.rig_calibration.instants import collect_instants, estimate_delays, move_to_frames, synchronize_tracks
from sylpose.rig_calibration.motion_bundle import JointBundle
from sylpose.rig_calibration.relative_motions import CameraTrack
from sylpose.simulate import arc
from sylpose.status import Status
from tests.rig_calibration.test_from_motion import errors_of, observe
from tests.rig_calibration.test_relative_motions import FRAMES, tumble

RIG = arc(3, 50.0, 1.2, 800.0, (640, 480), height=[0.1, 0.4, -0.2])
NUMBERS = np.arange(FRAMES // 2)


def move_object(seconds: FloatArray, seed: int = 0) -> RigidTransform:
    """Return poses of a smooth motion at instants (N,) near `NUMBERS` / 30."""
    knots = tumble(seed)[::6]
    at = np.linspace(-0.05, 1.05, len(knots))
    return RigidTransform.from_components(
        CubicSpline(at, knots.translation)(seconds), RotationSpline(at, knots.rotation)(seconds)
    )


def observe_exactly(camera: int, instants: FloatArray, points: FloatArray) -> RefinedTrack:
    """Return a track without noise, of points (M, 3) that are all visible in all frames, in the world's unit."""
    poses = RIG[camera].camera_from_world * move_object(instants)
    frame, landmark = (values.ravel() for values in np.indices((len(instants), len(points))))
    image = np.concatenate([(p := pose.apply(points))[:, :2] / p[:, 2:] for pose in poses])
    covariance = np.tile(1e-6 * np.eye(3), (len(instants), 1, 1))
    track = CameraTrack(RIG[camera].name, NUMBERS, poses, covariance, 0.1)
    observations = Observations(frame, np.zeros_like(frame), landmark, image)
    return RefinedTrack(track, instants, observations, points, 0.1, 1.0, 0.1)


def draw_recording(jitter: float, seed: int = 0) -> tuple[list[RefinedTrack], FloatArray]:
    """Return tracks of all cameras and their instants (N, C), which differ at random."""
    rng = np.random.default_rng(seed)
    instants = NUMBERS[:, None] / 30 + jitter * rng.normal(size=(len(NUMBERS), len(RIG)))
    points = rng.uniform(-0.08, 0.08, size=(40, 3))
    return [observe_exactly(c, instants[:, c], points) for c in range(len(RIG))], instants


def join(tracks: list[RefinedTrack], instants: FloatArray) -> JointBundle:
    """Return the true rig and the true poses at the mean instants, as a joint refinement of these tracks."""
    first = RIG[0].camera_from_world
    rig = Rig([replace(c, camera_from_world=c.camera_from_world * first.inv()) for c in RIG])
    parts = [t.observations for t in tracks]
    m, n = len(tracks[0].landmarks), len(RIG)
    observations = Observations(
        np.concatenate([o.frame for o in parts]),
        np.repeat(np.arange(n), [len(o) for o in parts]),
        np.concatenate([o.landmark + c * m for c, o in enumerate(parts)]),
        np.concatenate([o.image for o in parts]),
    )
    return JointBundle(
        status=Status.OK,
        rig=rig,
        covariance=np.zeros((10 * n, 10 * n)),
        noise_ratio=np.ones(n),
        inlier_ratio=np.ones(n),
        n_points=np.full(n, m),
        sigma_px=np.full(n, 0.1),
        distance=1.2,
        object_length=0.2,
        reference_from_object=first * move_object(instants.mean(axis=1)),
        observations=observations,
        landmarks=np.concatenate([t.landmarks for t in tracks]),
        weights=np.ones(len(observations.frame)),
        coverage=(),
    )


def test_tracks_are_moved_to_common_instants() -> None:
    tracks, instants = draw_recording(2e-3)
    common = instants.mean(axis=1)
    np.testing.assert_array_equal(collect_instants(tracks, NUMBERS), instants)
    for c, its in enumerate(synchronize_tracks(tracks)):
        expected = observe_exactly(c, common, its.landmarks)
        before = np.abs(tracks[c].observations.image - expected.observations.image).max()
        after = np.abs(its.observations.image - expected.observations.image)[80:-80].max()
        # The motion is a spline of the third degree, in rotations nearly so.
        assert after < 0.05 * before
        difference = its.track.camera_from_object * expected.track.camera_from_object.inv()
        assert difference.rotation.magnitude()[2:-2].max() < 1e-4
        np.testing.assert_array_equal(its.times, common)


def test_simultaneous_tracks_remain() -> None:
    tracks, _ = draw_recording(0.0)
    for before, after in zip(tracks, synchronize_tracks(tracks), strict=True):
        np.testing.assert_allclose(after.observations.image, before.observations.image, atol=1e-12)


def test_delays_are_estimated() -> None:
    tracks, instants = draw_recording(3e-3)
    instants_of_late = instants + np.array([0.0, 8e-3, 0.0])
    late = [observe_exactly(c, instants_of_late[:, c], its.landmarks) for c, its in enumerate(tracks)]
    joint, times = join(late, instants), instants.mean(axis=1)
    delays = estimate_delays(joint, times)
    expected = instants_of_late - times[:, None]
    # A delay of all cameras is a motion of the object.
    delays, expected = (values - values.mean(axis=1, keepdims=True) for values in (delays, expected))
    assert np.abs(delays - expected)[2:-2].max() < 0.1 * np.abs(expected).max()
    moved = move_to_frames(late, RIG.cameras, NUMBERS, times, instants_of_late, joint)
    for c, its in enumerate(moved):
        exact = observe_exactly(c, times, its.landmarks).observations.image
        np.testing.assert_allclose(its.observations.image[80:-80], exact[80:-80], atol=2e-4)


def test_delays_follow_the_noise() -> None:
    """Without any delay, the estimates are shrunk to nothing."""
    tracks, instants = draw_recording(0.0)
    joint, rng = join(tracks, instants), np.random.default_rng(1)
    noisy = joint.observations.image + 0.1 / 800.0 * rng.normal(size=joint.observations.image.shape)
    delays = estimate_delays(replace(joint, observations=replace(joint.observations, image=noisy)), NUMBERS / 30)
    velocity = 1.2 * 800.0 / 30
    assert np.sqrt((delays**2).mean()) < 0.1 / velocity


@pytest.mark.parametrize("has_stamps", [True, False])
def test_webcams(has_stamps: bool) -> None:
    """Cameras that are not simultaneous, with time stamps or frame numbers: calibrated, and as exactly as stated."""
    rng, tracks = np.random.default_rng(5), list[RefinedTrack | None]()
    for c, camera in enumerate(RIG[:2]):
        instants = NUMBERS / 30 + 4e-3 * rng.normal(size=len(NUMBERS))
        its = observe(Rig([camera]), move_object(instants), c)[0]
        refined = refine_track(its, camera)
        assert refined is not None
        times = instants if has_stamps else NUMBERS.astype(float)
        tracks.append(replace(refined, times=times[refined.track.frames]))
    found = calibrate_from_motion(RIG[:2].cameras, tracks, is_timed=has_stamps)
    assert found.calibration.rig.names == RIG.names[:2]
    if not has_stamps:
        (delay,) = (match for text in found.calibration.warnings if (match := re.search(r"by ([0-9.]+) frames", text)))
        assert 0.03 < float(delay[1]) < 0.2
    errors, sds = errors_of(found, RIG)
    assert np.degrees(np.linalg.norm(errors[:, :3], axis=1)).max() < 0.3
    assert (np.abs(errors[1:]) < 4.0 * sds[1:]).all()
