"""Extrinsics from tracks of one object: exact without noise, honest with it, and each kind of failure refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.rig_calibration.relative_motions import (
    HALF_TURN,
    CameraTrack,
    MotionRefusedError,
    RelativeExtrinsics,
    find_time_offset,
    solve_relative_extrinsics,
)
from sylpose.simulate import arc

seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=8, deadline=None)
RADIUS, FRAMES = 0.12, 60


def tumble(seed: int, angle: float = 3.0, carried: float = 0.3, *, one_axis: bool = False) -> RigidTransform:
    """Return poses of an object that rotates by `angle` about changing axes and is carried about."""
    rng = np.random.default_rng(seed)
    knots = np.linspace(0.0, 1.0, 5)
    axes = np.tile(rng.normal(size=3), (4, 1)) if one_axis else rng.normal(size=(4, 3))
    steps = Rotation.from_rotvec(angle / 4 * axes / np.linalg.norm(axes, axis=1, keepdims=True))
    rotations = [Rotation.identity()]
    for step in steps:
        rotations.append(step * rotations[-1])
    times = np.linspace(0.0, 1.0, FRAMES)
    corners = carried * rng.uniform(-0.5, 0.5, size=(5, 3))
    places = np.stack([np.interp(times, knots, column) for column in corners.T], axis=1)
    return RigidTransform.from_components(places, Slerp(knots, Rotation.concatenate(rotations))(times))


def track_object(
    rig: Rig, world_from_object: RigidTransform, seed: int = 0, noise: float = 0.0, frames: slice = slice(None)
) -> list[CameraTrack]:
    """Return each camera's track, in its own unit and with its own axes of the object.

    Args:
        noise: of the rotations, radians; that of positions follows from it.
    """
    rng, tracks = np.random.default_rng([seed, 1]), []
    numbers = np.arange(len(world_from_object))[frames]
    for camera in rig:
        axes = RigidTransform.from_components(0.03 * rng.normal(size=3), Rotation.random(rng=rng))
        poses = camera.camera_from_world * world_from_object[numbers] * axes
        unit = float(np.linalg.norm(poses.translation[0]))
        n = len(numbers)
        errors = noise * rng.normal(size=(n, 3))
        position_errors = noise * RADIUS * rng.normal(size=(n, 3))
        directions = poses.translation / np.linalg.norm(poses.translation, axis=1, keepdims=True)
        along = noise * rng.normal(size=n)[:, None] * directions
        measured = RigidTransform.from_components(
            poses.translation / unit + position_errors + along, Rotation.from_rotvec(errors) * poses.rotation
        )
        covariance = np.tile(max(noise, 1e-6) ** 2 * np.eye(3), (n, 1, 1))
        tracks.append(CameraTrack(camera.name, numbers, measured, covariance, RADIUS / unit))
    return tracks


def errors_of(found: RelativeExtrinsics, rig: Rig) -> tuple[FloatArray, FloatArray]:
    """Return (C,) errors of rotations, radians, and of centers relative to the distance, after fitting the scale."""
    reference = rig[found.cameras[0]].camera_from_world
    truth = RigidTransform.concatenate([rig[c].camera_from_world * reference.inv() for c in found.cameras])
    centers, expected = (poses.inv().translation for poses in (found.camera_from_reference, truth))
    scale = (centers * expected).sum() / (centers**2).sum()
    distance = np.linalg.norm(reference.translation)
    rotations = (found.camera_from_reference.rotation * truth.rotation.inv()).magnitude()
    return rotations, np.linalg.norm(scale * centers - expected, axis=1) / distance


@given(seed=seeds)
@quick
def test_exact_without_noise(seed: int) -> None:
    rig = arc(4, 90.0, height=[0.1, 0.4, -0.2, 0.3])
    found = solve_relative_extrinsics(track_object(rig, tumble(seed), seed))
    assert found.cameras == (0, 1, 2, 3)
    rotations, centers = errors_of(found, rig)
    assert rotations.max() < 1e-6
    assert centers.max() < 1e-5
    # M_ci = S X_c T_i O_c, which is what the bundle adjustment starts from.
    tracks = track_object(rig, tumble(seed), seed)
    for c, track in enumerate(tracks):
        poses = found.camera_from_reference[c] * found.reference_from_object * found.object_axes[c]
        np.testing.assert_allclose(poses.translation / found.scales[c], track.camera_from_object.translation, atol=1e-5)
        assert (poses.rotation * track.camera_from_object.rotation.inv()).magnitude().max() < 1e-5


@given(seed=seeds)
@quick
def test_honest_with_noise(seed: int) -> None:
    rig = arc(3, 60.0, height=[0.1, 0.4, -0.2])
    found = solve_relative_extrinsics(track_object(rig, tumble(seed), seed, noise=2e-3))
    rotations, centers = errors_of(found, rig)
    # Errors about three axes.
    assert (rotations < 5.0 * found.rotation_sd + 1e-9).all()
    assert rotations.max() < np.radians(1.0)
    assert centers.max() < 0.03


def test_axes_of_world_and_object_do_not_matter() -> None:
    rig, path = arc(3, 60.0, height=[0.1, 0.4, -0.2]), tumble(1)
    tracks = track_object(rig, path, 1, noise=1e-3)
    change = RigidTransform.from_components([0.02, 0.01, -0.03], Rotation.from_rotvec([1.0, -0.4, 2.0]))
    # The same measurements, in other axes on the object.
    other = [replace(track, camera_from_object=track.camera_from_object * change) for track in tracks]
    found, changed = solve_relative_extrinsics(tracks), solve_relative_extrinsics(other)
    difference = found.camera_from_reference * changed.camera_from_reference.inv()
    assert difference.rotation.magnitude().max() < 1e-6
    assert np.abs(difference.translation).max() < 3e-3


def test_wrong_track_is_left_out() -> None:
    rig = arc(4, 40.0, height=[0.1, 0.4, -0.2, 0.3])
    tracks = track_object(rig, tumble(2), 2, noise=1e-3)
    tracks[2] = track_object(rig, tumble(3), 3, noise=1e-3)[2]
    found = solve_relative_extrinsics(tracks)
    assert found.cameras == (0, 1, 3)
    assert "rotates differently" in found.left_out["cam_2"]
    assert errors_of(found, rig)[0].max() < np.radians(0.5)


def test_cameras_without_common_frames_are_left_out() -> None:
    """Two pairs of cameras that track at different times: one pair is calibrated."""
    rig = arc(4, 40.0, height=[0.1, 0.4, -0.2, 0.3])
    halves = [track_object(rig, tumble(2), 2, noise=1e-3, frames=part) for part in (slice(30), slice(30, None))]
    found = solve_relative_extrinsics([*halves[0][:2], *halves[1][2:]])
    assert found.cameras == (0, 1)
    assert found.left_out.keys() == {"cam_2", "cam_3"}
    assert errors_of(found, rig)[0].max() < np.radians(0.5)


def test_late_camera_needs_no_common_start() -> None:
    rig = arc(3, 40.0, height=[0.1, 0.4, -0.2])
    tracks = track_object(rig, tumble(2), 2, noise=1e-3)
    tracks[0] = track_object(rig, tumble(2), 2, noise=1e-3, frames=slice(25, None))[0]
    found = solve_relative_extrinsics(tracks)
    assert found.cameras == (0, 1, 2)
    assert errors_of(found, rig)[0].max() < np.radians(0.5)
    assert len(found.frames) == FRAMES


def refusal(tracks: list[CameraTrack]) -> str:
    with pytest.raises(MotionRefusedError) as caught:
        solve_relative_extrinsics(tracks)
    assert not caught.value.tests[-1].passed
    assert all(test.passed for test in caught.value.tests[:-1])
    return str(caught.value)


@pytest.mark.parametrize("noise", [0.0, 1e-3, 5e-3])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_motions_that_do_not_suffice_are_refused(noise: float, seed: int) -> None:
    rig = arc(3, 40.0, height=[0.1, 0.4, -0.2])
    assert "about a second axis" in refusal(track_object(rig, tumble(seed, one_axis=True), seed, noise))
    assert "carry the object about" in refusal(track_object(rig, tumble(seed, carried=0.0), seed, noise))
    static = refusal(track_object(rig, tumble(seed, angle=0.0), seed, noise))
    assert "rotate it by 30 degrees" in static


def test_different_objects_are_refused() -> None:
    rig = arc(2, 40.0, height=[0.1, 0.4])
    tracks = [track_object(rig, tumble(seed), seed, noise=1e-3)[seed] for seed in range(2)]
    assert "observe the same object" in refusal(tracks)


def test_time_offset_is_found() -> None:
    rig = arc(2, 40.0, height=[0.1, 0.4])
    tracks = track_object(rig, tumble(4), 4, noise=5e-4)
    late = replace(tracks[1], frames=tracks[1].frames + 2)
    offset, ratio = find_time_offset(tracks[0], late)
    assert offset == pytest.approx(2.0, abs=0.2)
    assert ratio < 0.5
    assert find_time_offset(*tracks)[0] == 0.0
    assert "2.1 frames late: shift it with --frame-offset cam_1=-2" in refusal([tracks[0], late])


def test_depth_reversed_track_is_found() -> None:
    """It rotates by the same angles, and rotations close; only its places do not fit."""
    rig = arc(4, 40.0, height=[0.1, 0.4, -0.2, 0.3])
    tracks = track_object(rig, tumble(5), 5, noise=1e-3)
    for c in (0, 2):
        poses = tracks[c].camera_from_object
        turned = Rotation.from_matrix(HALF_TURN @ poses.rotation.as_matrix() @ HALF_TURN)
        wrong = list(tracks)
        wrong[c] = replace(tracks[c], camera_from_object=RigidTransform.from_components(poses.translation, turned))
        found = solve_relative_extrinsics(wrong)
        assert c not in found.cameras
        assert "reversed depth" in found.left_out[f"cam_{c}"]
        assert errors_of(found, rig)[0].max() < np.radians(0.5)
    with pytest.raises(MotionRefusedError, match="depth"):
        solve_relative_extrinsics([wrong[2], wrong[3]])
