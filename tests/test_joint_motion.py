"""Relative poses and helical axes: against simulated joints, with errors as large as stated, and as typed by a user."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.commands.main import main
from sylpose.geometry.arrays import FloatArray
from sylpose.joint_motion import compute_helical_axes, fit_mean_axis, relate_trajectories
from sylpose.report.files import read_trajectory, write_trajectory
from sylpose.results import FramePose, Trajectory
from sylpose.status import FrameStatus

N = 40
RNG = np.random.default_rng(0)
FACTOR = RNG.normal(size=(6, 6)) * np.repeat([1e-3, 5e-4], 3)[:, None]
COVARIANCE = FACTOR @ FACTOR.T
AXIS, POINT = np.array([0.48, 0.64, 0.6]), np.array([0.1, -0.2, 0.05])
POINT = POINT - (POINT @ AXIS) * AXIS
ANGLES = np.radians(np.linspace(0.0, 80.0, N))


def hinge(angle: float, pitch: float = 0.02) -> RigidTransform:
    """Rotate about an axis, with a translation of `pitch` per radian along it."""
    rotation = Rotation.from_rotvec(angle * AXIS)
    return RigidTransform.from_components(POINT - rotation.apply(POINT) + pitch * angle * AXIS, rotation)


FIRST = RigidTransform.from_components([0.3, 0.1, -0.2], Rotation.from_rotvec([0.2, -0.4, 0.3]))
A_FROM_B = RigidTransform.concatenate([hinge(angle) * FIRST for angle in ANGLES])
WORLD_FROM_A = RigidTransform.from_components(
    RNG.normal(size=(N, 3)).cumsum(axis=0) * 0.05, Rotation.from_rotvec(RNG.normal(size=(N, 3)).cumsum(axis=0) * 0.2)
)


def make_trajectory(
    poses: RigidTransform, covariance: FloatArray, seed: int | None = None, unit: str = "m"
) -> Trajectory:
    errors = np.zeros((len(poses), 6))
    if seed is not None:
        errors = np.random.default_rng(seed).multivariate_normal(np.zeros(6), covariance, len(poses))
    frames = []
    for k, (pose, error) in enumerate(zip(poses, errors, strict=True)):
        disturbed = RigidTransform.from_components(
            pose.translation + error[3:], Rotation.from_rotvec(error[:3]) * pose.rotation
        )
        counts = np.array([20])
        frames.append(FramePose(k, k / 30, FrameStatus.TRACKED, disturbed, covariance, counts, np.ones(1)))
    return Trajectory(frames, ["cam_0"], unit)


def test_covariance_of_relative_poses() -> None:
    """Both sides, for a joint that is far from the origins of the objects and of the world."""
    squares = []
    for seed in range(20):
        a = make_trajectory(WORLD_FROM_A, COVARIANCE, 2 * seed)
        b = make_trajectory(WORLD_FROM_A * A_FROM_B, 4.0 * COVARIANCE, 2 * seed + 1)
        for frame, truth in zip(relate_trajectories(a, b), A_FROM_B, strict=True):
            assert frame.world_from_object is not None
            w = (frame.world_from_object.rotation * truth.rotation.inv()).as_rotvec()
            error = np.r_[w, frame.position - truth.translation]
            squares.append(error @ np.linalg.solve(frame.covariance, error))
    assert np.mean(squares) == pytest.approx(6.0, abs=0.5)


def test_world_does_not_matter() -> None:
    world = RigidTransform.from_components([5.0, 2.0, -7.0], Rotation.from_rotvec([1.0, 2.0, -0.5]))
    jacobian = np.kron(np.eye(2), world.rotation.as_matrix())
    moved = jacobian @ COVARIANCE @ jacobian.T
    expected = relate_trajectories(
        make_trajectory(WORLD_FROM_A, COVARIANCE), make_trajectory(WORLD_FROM_A * A_FROM_B, COVARIANCE)
    )
    found = relate_trajectories(
        make_trajectory(world * WORLD_FROM_A, moved), make_trajectory(world * WORLD_FROM_A * A_FROM_B, moved)
    )
    for f, e in zip(found, expected, strict=True):
        assert f.world_from_object is not None
        assert e.world_from_object is not None
        np.testing.assert_allclose(f.world_from_object.as_matrix(), e.world_from_object.as_matrix(), atol=1e-12)
        np.testing.assert_allclose(f.covariance, e.covariance, atol=1e-15)


def test_helical_axes() -> None:
    axes = compute_helical_axes(make_trajectory(A_FROM_B, 1e-8 * np.eye(6)))
    np.testing.assert_allclose(axes.angle, ANGLES, atol=1e-9)
    np.testing.assert_allclose(axes.axis[1:], np.tile(AXIS, (N - 1, 1)), atol=1e-9)
    np.testing.assert_allclose(axes.point[1:], np.tile(POINT, (N - 1, 1)), atol=1e-9)
    np.testing.assert_allclose(axes.slide[1:], 0.02 * ANGLES[1:], atol=1e-9)
    assert np.isnan(axes.axis[0]).all()
    mean = fit_mean_axis(axes)
    assert mean is not None
    np.testing.assert_allclose(mean, (AXIS, POINT), atol=1e-9)


def test_standard_deviations_of_helical_axes() -> None:
    found = [compute_helical_axes(make_trajectory(A_FROM_B, COVARIANCE, seed)) for seed in range(150)]
    last = N - 1
    for name, sd, truth in (("angle", "angle_sd", ANGLES[-1]), ("slide", "slide_sd", 0.02 * ANGLES[-1])):
        errors = np.array([getattr(axes, name)[last] - truth for axes in found])
        assert np.sqrt(np.mean(errors**2)) == pytest.approx(np.mean([getattr(x, sd)[last] for x in found]), rel=0.2)
    for name, sd, true in (("axis", "axis_sd", AXIS), ("point", "point_sd", POINT)):
        errors = np.array([getattr(axes, name)[last] - true for axes in found])
        rms = np.sqrt((errors**2).sum(axis=1).mean() / 2)
        assert rms == pytest.approx(np.mean([getattr(x, sd)[last] for x in found]), rel=0.2)
    # Angles that are not significant have no axis.
    assert np.isnan(compute_helical_axes(make_trajectory(A_FROM_B, 1e4 * COVARIANCE)).axis[:5]).all()


def write_pair(folder: Path, **units: str) -> list[str]:
    a = make_trajectory(WORLD_FROM_A, COVARIANCE, unit=units.get("a", "m"))
    b = make_trajectory(WORLD_FROM_A * A_FROM_B, COVARIANCE, unit=units.get("b", "m"))
    for name, trajectory in (("femur", a), ("tibia", b)):
        write_trajectory(folder / name, trajectory)
    return ["relative", str(folder / "femur"), str(folder / "tibia"), "--out", str(folder / "knee")]


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*write_pair(tmp_path), "--euler", "ZXY"]) == 0
    printed = capsys.readouterr().out
    assert "40 with a measured pose of both objects" in printed
    assert "direction (0.4800, 0.6400, 0.6000)" in " ".join(printed.split())
    with (tmp_path / "knee" / "joint.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    expected = np.degrees(np.unwrap(A_FROM_B.rotation.as_euler("ZXY"), axis=0))
    found = [[float(row[f"angle{k}_{letter}_deg"]) for k, letter in enumerate("ZXY", start=1)] for row in rows]
    np.testing.assert_allclose(found, expected, atol=1e-8)
    assert 0.01 < float(rows[20]["angle1_Z_sd_deg"]) < 1.0
    assert float(rows[-1]["helical_deg"]) == pytest.approx(80.0)
    assert rows[0]["axis_x"] == ""
    poses = read_trajectory(tmp_path / "knee" / "relative.csv")
    assert np.abs(poses.positions - A_FROM_B.translation).max() < 1e-9
    out = tmp_path / "velocity.csv"
    assert main(["export", str(tmp_path / "knee" / "relative.csv"), "--out", str(out), "--velocity"]) == 0


@pytest.mark.parametrize(
    ("options", "units", "message"),
    [
        (["--euler", "XX"], {}, "--euler: expected three axes"),
        (["--reference", "99"], {}, "--reference: frame 99 has no measured pose of both objects"),
        ([], {"a": "m", "b": ""}, "A is in m and B in an unspecified unit"),
        (["--within", "-1"], {}, "--within must be a number of seconds"),
    ],
)
def test_wrong_input(
    options: list[str], units: dict[str, str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*write_pair(tmp_path, **units), *options]) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1


def test_units_are_converted() -> None:
    """A in meters, B in millimeters."""
    scaled = RigidTransform.from_components(
        1e3 * (WORLD_FROM_A * A_FROM_B).translation, (WORLD_FROM_A * A_FROM_B).rotation
    )
    found = relate_trajectories(
        make_trajectory(WORLD_FROM_A, COVARIANCE), make_trajectory(scaled, COVARIANCE, unit="mm")
    )
    np.testing.assert_allclose(found.positions, 1e3 * A_FROM_B.translation, atol=1e-9)
    assert found.unit == "mm"
