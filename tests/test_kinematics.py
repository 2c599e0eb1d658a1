"""Velocities and accelerations: against known motions, with errors as large as stated, equivariant, in files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.commands.main import main
from sylpose.geometry.arrays import FloatArray
from sylpose.kinematics import Derivatives, Kinematics, estimate_kinematics
from sylpose.report.files import write_trajectory
from sylpose.results import FramePose, Trajectory
from sylpose.status import FrameStatus

Truth = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
# Standard deviations and correlations of the noise, radians and meters.
NOISE = np.diag([1e-3, 2e-3, 4e-3, 5e-4, 1e-3, 2e-3]) @ (np.eye(6) + 0.3 * np.eye(6, k=1))
COVARIANCE = NOISE @ NOISE.T


def simulate(seed: int, n: int = 150, rate: float = 60.0) -> tuple[FloatArray, RigidTransform, Truth]:
    """Return irregular times, noise-free poses and derivatives of sums of sines; the object turns several times."""
    rng = np.random.default_rng(seed)
    times = np.sort(np.arange(n) / rate + rng.uniform(-0.4, 0.4, n) / rate)
    frequencies, phases = 2 * np.pi * rng.uniform(0.2, 1.0, (3, 3)), rng.uniform(0.0, 6.0, (3, 3))
    amplitudes = 0.1 * rng.normal(size=(3, 3))

    def position(order: int) -> FloatArray:
        arguments = times[:, None, None] * frequencies + phases + order * np.pi / 2
        return np.asarray((amplitudes * frequencies**order * np.sin(arguments)).sum(axis=1))

    def rotation(t: FloatArray) -> Rotation:
        vectors = 5.0 * (amplitudes * np.sin(t[:, None, None] * frequencies[::-1] + phases)).sum(axis=1)
        return Rotation.from_rotvec(vectors) * Rotation.from_rotvec(np.outer(t, [1.0, 2.0, 0.5]))

    def angular(t: FloatArray, h: float = 1e-4) -> FloatArray:
        return np.asarray((rotation(t + h) * rotation(t - h).inv()).as_rotvec() / (2 * h))

    acceleration = (angular(times + 1e-3) - angular(times - 1e-3)) / 2e-3
    poses = RigidTransform.from_components(position(0), rotation(times))
    return times, poses, (position(1), position(2), angular(times), acceleration)


def disturb(poses: RigidTransform, seed: int, factors: FloatArray | float = 1.0) -> RigidTransform:
    errors = np.random.default_rng(seed + 1000).normal(size=(len(poses), 6)) @ NOISE.T
    errors = errors * np.broadcast_to(factors, (len(poses),))[:, None]
    rotation = Rotation.from_rotvec(errors[:, :3]) * poses.rotation
    return RigidTransform.from_components(poses.translation + errors[:, 3:], rotation)


def mean_nees(found: Kinematics, truth: Truth) -> FloatArray:
    """Return (4,) mean normalized squared errors of v, a, w, dw, per degree of freedom."""
    result = []
    for d, (velocity, acceleration) in ((found.linear, truth[:2]), (found.angular, truth[2:])):
        for k, error in enumerate((d.velocity - velocity, d.acceleration - acceleration)):
            block = d.covariance[:, 3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
            solved = np.linalg.solve(block, error[..., None])[..., 0]
            result.append(float((error * solved).sum(axis=1).mean()) / 3.0)
    return np.array(result)


def assert_between(values: FloatArray, low: float, high: float) -> None:
    assert (values > low).all(), values
    assert (values < high).all(), values


def test_errors_are_as_large_as_stated() -> None:
    """Both sides: smooth motions are the easy case, so errors are somewhat smaller than stated."""
    found, weighted, constant = [], [], []
    for seed in range(8):
        times, poses, truth = simulate(seed)
        stated = np.tile(COVARIANCE, (len(times), 1, 1))
        kinematics = estimate_kinematics(times, disturb(poses, seed), stated)
        assert kinematics.linear.noise_sd == pytest.approx(np.sqrt(np.trace(COVARIANCE[3:, 3:]) / 3), rel=0.25)
        found.append(mean_nees(kinematics, truth))
        # Noise that varies, with covariances that state it, times an unknown factor.
        factors = np.where(np.arange(len(times)) % 50 < 25, 1.0, 6.0)
        noisy = disturb(poses, seed, factors)
        other = estimate_kinematics(times, noisy, 7.0 * factors[:, None, None] ** 2 * stated)
        assert other.linear.uses_stated_shape
        assert other.angular.uses_stated_shape
        weighted.append(mean_nees(other, truth))
        constant.append(np.linalg.norm(estimate_kinematics(times, noisy, stated).linear.velocity - truth[0]))
        constant[-1] /= np.linalg.norm(other.linear.velocity - truth[0])
    for nees in (found, weighted):
        assert_between(np.mean(nees, axis=0), 0.3, 1.3)
    assert np.mean(constant) > 1.2  # the stated covariances help


def test_covariances_that_do_not_fit_the_noise_are_not_used() -> None:
    """A common error of all poses, as of the calibration, has a large covariance of another shape."""
    nees = []
    for seed in range(6):
        times, poses, truth = simulate(seed)
        stated = np.tile(np.diag([1.0, 1e-4, 1e-4, 1.0, 1e-4, 1e-4]), (len(times), 1, 1))
        stated[0] = 0.0  # the first frame defines the object's frame
        kinematics = estimate_kinematics(times, disturb(poses, seed), stated)
        assert not kinematics.linear.uses_stated_shape
        assert not kinematics.angular.uses_stated_shape
        nees.append(mean_nees(kinematics, truth))
    assert_between(np.mean(nees, axis=0), 0.3, 1.3)


def test_correlated_noise() -> None:
    """Errors of tracked features last for some frames; taken for white, velocities would be off by 1.6 sd."""
    nees, correlations = [], []
    for seed in range(6):
        times, poses, truth = simulate(seed)
        errors = np.random.default_rng(seed).normal(size=(len(times), 6)) @ NOISE.T
        for k in range(1, len(errors)):
            errors[k] = 0.6 * errors[k - 1] + 0.8 * errors[k]
        rotation = Rotation.from_rotvec(errors[:, :3]) * poses.rotation
        disturbed = RigidTransform.from_components(poses.translation + errors[:, 3:], rotation)
        kinematics = estimate_kinematics(times, disturbed, np.tile(COVARIANCE, (len(times), 1, 1)))
        nees.append(mean_nees(kinematics, truth))
        correlations += [kinematics.linear.correlation, kinematics.angular.correlation]
    assert_between(np.mean(nees, axis=0), 0.4, 1.6)
    assert 0.3 < np.mean(correlations) < 0.7


def test_jerky_motion() -> None:
    """White-noise jerk, the roughest motion with a finite acceleration: errors are as large as stated."""
    rate, n, sub, nees = 50.0, 150, 40, []
    for seed in range(6):
        rng, h = np.random.default_rng(seed), 1.0 / (50.0 * 40)
        acceleration = np.cumsum(rng.normal(size=(n * sub, 6)) * np.sqrt(h), axis=0)
        velocity = np.cumsum(acceleration * h, axis=0)
        position = np.cumsum(velocity * h, axis=0)[:, 3:]
        rotations, rotation = [], Rotation.identity()
        for vector in velocity[:, :3] * h:
            rotation = Rotation.from_rotvec(vector) * rotation
            rotations.append(rotation.as_quat())
        at = slice(sub - 1, None, sub)
        poses = RigidTransform.from_components(position[at], Rotation.from_quat(rotations[at]))
        stated = np.tile(COVARIANCE, (n, 1, 1))
        kinematics = estimate_kinematics(np.arange(n) / rate, disturb(poses, seed), stated)
        a, v = acceleration[at], velocity[at]
        nees.append(mean_nees(kinematics, (v[:, 3:], a[:, 3:], v[:, :3], a[:, :3])))
    assert_between(np.mean(nees, axis=0), 0.6, 1.8)


def assert_equal(found: Derivatives, expected: Derivatives, transform: FloatArray, scale: float) -> None:
    both = np.kron(np.eye(2), transform)
    for name in ("velocity", "acceleration"):
        moved = scale * getattr(expected, name) @ transform.T
        np.testing.assert_allclose(getattr(found, name), moved, rtol=1e-5, atol=1e-5 * np.abs(moved).max())
    moved = scale**2 * both @ expected.covariance @ both.T
    np.testing.assert_allclose(found.covariance, moved, rtol=1e-4, atol=1e-4 * np.abs(moved).max())
    assert found.noise_sd == pytest.approx(scale * expected.noise_sd)


def test_equivariance() -> None:
    """Another world and unit of length transform the results; another unit of time scales them."""
    times, poses, _ = simulate(3, n=60)
    poses, stated = disturb(poses, 3), np.tile(COVARIANCE, (60, 1, 1))
    expected = estimate_kinematics(times, poses, stated)
    world = RigidTransform.from_components([4.0, -3.0, 9.0], Rotation.from_rotvec([1.0, -2.0, 0.7]))
    Q = world.rotation.as_matrix()
    moved = world * poses
    scaled = RigidTransform.from_components(1000.0 * moved.translation, moved.rotation)
    jacobian = np.kron(np.diag([1.0, 1000.0]), Q)
    found = estimate_kinematics(times, scaled, jacobian @ stated @ jacobian.T)
    assert_equal(found.linear, expected.linear, Q, 1000.0)
    assert_equal(found.angular, expected.angular, Q, 1.0)
    slow = estimate_kinematics(1e9 + 8.0 * times, poses, stated)
    np.testing.assert_allclose(8.0 * slow.linear.velocity, expected.linear.velocity, atol=1e-4)
    np.testing.assert_allclose(64.0 * slow.angular.acceleration_sd, expected.angular.acceleration_sd, rtol=1e-2)
    assert 8.0 * slow.linear.half_gain == pytest.approx(expected.linear.half_gain, rel=1e-3)


def test_gain_is_as_stated() -> None:
    """A sine of the half-gain frequency comes out with half of its amplitude, at the steady rate of the statement."""
    times, rng = np.arange(240) / 60.0, np.random.default_rng(0)
    stated = np.tile(np.eye(6), (240, 1, 1))
    positions = 0.1 * np.sin(4.0 * times[:, None] + [0.0, 2.0, 4.0]) + 1e-3 * rng.normal(size=(240, 3))
    poses = RigidTransform.from_components(positions, Rotation.from_rotvec(1e-3 * rng.normal(size=(240, 3))))
    base = estimate_kinematics(times, poses, stated).linear
    f = base.half_gain
    # Small enough not to change the estimate of the filter.
    wave = 1e-6 * np.outer(np.sin(2 * np.pi * f * times), [1.0, 0.0, 0.0])
    added = RigidTransform.from_components(poses.translation + wave, poses.rotation)
    response = (estimate_kinematics(times, added, stated).linear.velocity - base.velocity)[60:180, 0] / 1e-6
    expected = 2 * np.pi * f * np.cos(2 * np.pi * f * times)[60:180]
    assert response @ expected / (expected @ expected) == pytest.approx(0.5, abs=0.06)


def test_objects_at_rest_and_exact_data() -> None:
    n, rng = 300, np.random.default_rng(0)
    errors = 1e-3 * rng.normal(size=(n, 6))
    still = RigidTransform.from_components(errors[:, 3:], Rotation.from_rotvec(errors[:, :3]))
    found = estimate_kinematics(np.arange(n) / 100.0, still, np.tile(np.eye(6), (n, 1, 1)))
    for d in (found.linear, found.angular):
        assert_between(d.velocity_sd, 0.0, 2e-3)
        assert (np.abs(d.velocity) < 5 * d.velocity_sd).all()
        assert (d.acceleration_sd > 0).all()
    exact = RigidTransform.from_components(np.zeros((20, 3)), Rotation.identity(20))
    found = estimate_kinematics(np.arange(20.0), exact, np.zeros((20, 6, 6)))
    assert not found.linear.velocity.any()
    assert not found.angular.velocity.any()
    times, poses, truth = simulate(1)
    found = estimate_kinematics(times, poses, np.full((len(times), 6, 6), np.inf))
    np.testing.assert_allclose(found.linear.velocity, truth[0], atol=1e-4)
    np.testing.assert_allclose(found.angular.velocity, truth[2], atol=2e-3)


def test_gaps_and_bursts() -> None:
    """Two parts long apart, and one of a few frames, which has no result; two frames at almost one time."""
    times, poses, truth = simulate(4, n=80)
    noisy, stated = disturb(poses, 4), np.tile(COVARIANCE, (80, 1, 1))
    apart = times + np.where(np.arange(80) >= 40, 500.0, 0.0) + np.where(np.arange(80) >= 75, 500.0, 0.0)
    found = estimate_kinematics(apart, noisy, stated)
    assert np.isnan(found.linear.velocity[75:]).all()
    for d, velocity in ((found.linear, truth[0]), (found.angular, truth[2])):
        assert_between(np.abs(d.velocity - velocity)[:75] / d.velocity_sd[:75], -1.0, 6.0)
    alone = estimate_kinematics(times[:40], noisy[:40], stated[:40])
    np.testing.assert_allclose(found.linear.velocity[:40], alone.linear.velocity, rtol=1e-6)
    burst = np.sort(np.r_[times[:-1], times[40] + 1e-7])
    found = estimate_kinematics(burst, noisy, stated)
    assert np.isfinite(found.angular.covariance).all()
    assert np.abs(found.angular.velocity).max() < 20.0


def make_trajectory(n: int = 40) -> tuple[Trajectory, Truth]:
    times, poses, truth = simulate(5, n=n)
    noisy, frames = disturb(poses, 5), []
    for k in range(n):
        status = FrameStatus.COASTING if k in (10, 11) else FrameStatus.TRACKED
        counts = np.array([30, 40])
        frames.append(FramePose(k, float(times[k]), status, noisy[k], COVARIANCE, counts, np.full(2, 0.2)))
    return Trajectory(frames, ["cam_0", "cam_1"], "m"), truth


def test_trajectory() -> None:
    trajectory, truth = make_trajectory()
    found = trajectory.differentiate()
    mask = trajectory.measured_mask
    np.testing.assert_equal(np.isfinite(found.linear.velocity).all(axis=1), mask)
    error = (found.linear.velocity - truth[0])[mask] / found.linear.velocity_sd[mask]
    assert 0.3 < np.sqrt((error**2).mean()) < 2.0


def test_export(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trajectory, _ = make_trajectory()
    write_trajectory(tmp_path, trajectory)
    out = tmp_path / "velocity.csv"
    assert main(["export", str(tmp_path), "--out", str(out), "--velocity", "--start", "5"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Velocities are those of a smoothing spline without phase; position: gain 1/(1+(f/" in printed
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    expected = trajectory.differentiate()
    assert rows[0]["index"] == "5"
    assert rows[5]["vx"] == rows[5]["wz_sd_deg"] == ""
    assert float(rows[0]["vy"]) == pytest.approx(expected.linear.velocity[5, 1], abs=0.2)
    assert float(rows[0]["dwx_sd_deg"]) == pytest.approx(np.degrees(expected.angular.acceleration_sd[5, 0]), rel=0.3)


def test_wrong_input_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trajectory, _ = make_trajectory(8)
    write_trajectory(tmp_path, trajectory)
    result = ["export", str(tmp_path), "--velocity", "--out"]
    assert main([*result, str(tmp_path / "a.csv")]) == 2
    assert "velocities need at least 12 measured poses, got 8" in capsys.readouterr().err
    assert main([*result, str(tmp_path / "a.bvh")]) == 2
    assert "--velocity: bvh has no columns for velocities; csv and parquet do" in capsys.readouterr().err
    times, poses, _ = simulate(0, n=20)
    with pytest.raises(ValueError, match="times that increase"):
        estimate_kinematics(np.r_[times[:-1], times[-2]], poses, np.tile(COVARIANCE, (20, 1, 1)))
