"""Hand-eye calibration: exact, with errors as large as stated, against OpenCV, degenerate motions refused by name."""

from __future__ import annotations

import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.commands.main import main
from sylpose.geometry.arrays import FloatArray
from sylpose.hand_eye import HandEye, interpolate_robot, solve_hand_eye
from sylpose.report.files import write_trajectory, write_tum
from sylpose.results import FramePose, Trajectory
from sylpose.status import FrameStatus

WORLD = RigidTransform.from_components([0.8, -0.3, 1.2], Rotation.from_rotvec([2.0, -1.5, 0.7]))
OBJECT = RigidTransform.from_components([0.02, 0.05, 0.11], Rotation.from_rotvec([-0.4, 0.9, 2.0]))
TIMES = np.arange(40) / 10.0
# Depth is less certain, and rotations are correlated with positions.
FACTOR = np.diag([1e-3, 2e-3, 4e-3, 5e-4, 5e-4, 3e-3]) @ (np.eye(6) + 0.3 * np.eye(6, k=3))
COVARIANCE = FACTOR @ FACTOR.T


def move_robot(times: FloatArray, axes: FloatArray | None = None) -> RigidTransform:
    """Return base_from_flange: positions over half a meter, rotations about `axes` (3, 3), default several."""
    axes = np.eye(3) if axes is None else axes
    phases = np.outer(times, [1.0, 1.7, 2.3])
    positions = [0.5, 0.0, 0.4] + 0.25 * np.sin(phases + np.arange(3.0))
    return RigidTransform.from_components(positions, Rotation.from_rotvec(0.6 * np.sin(phases) @ axes))


def track(robot: RigidTransform, seed: int | None = None, scale: float = 1.0) -> RigidTransform:
    errors = np.zeros((len(robot), 6))
    if seed is not None:
        errors = scale * np.random.default_rng(seed).normal(size=(len(robot), 6)) @ FACTOR.T
    poses = WORLD * robot * OBJECT
    rotation = Rotation.from_rotvec(errors[:, :3]) * poses.rotation
    return RigidTransform.from_components(poses.translation + errors[:, 3:], rotation)


def subtract(a: RigidTransform, b: RigidTransform) -> FloatArray:
    return np.concatenate([(a.rotation * b.rotation.inv()).as_rotvec(), a.translation - b.translation])


def solve(tracked: RigidTransform, robot: RigidTransform) -> HandEye:
    covariance = np.tile(COVARIANCE, (len(robot), 1, 1))
    covariance[0] = 0.0  # the first frame defines the object's frame
    return solve_hand_eye(tracked, covariance, robot)


def test_exact() -> None:
    robot = move_robot(TIMES)
    found = solve(track(robot), robot)
    np.testing.assert_allclose(found.world_from_robot.as_matrix(), WORLD.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(found.robot_from_object.as_matrix(), OBJECT.as_matrix(), atol=1e-9)


def test_errors_are_as_large_as_stated() -> None:
    """Both sides; and the covariances weigh: equal ones are less exact."""
    robot, squares, equal, weighted, factors = move_robot(TIMES), [], [], [], []
    for seed in range(60):
        tracked = track(robot, seed)
        found = solve(tracked, robot)
        factors.append(found.variance_factor)
        for pose, truth, c in (
            (found.world_from_robot, WORLD, found.world_covariance),
            (found.robot_from_object, OBJECT, found.object_covariance),
        ):
            error = subtract(pose, truth)
            squares.append(error @ np.linalg.solve(c, error))
        weighted.append(np.sum(subtract(found.robot_from_object, OBJECT)[3:] ** 2))
        plain = solve_hand_eye(tracked, np.tile(np.eye(6), (len(robot), 1, 1)), robot)
        equal.append(np.sum(subtract(plain.robot_from_object, OBJECT)[3:] ** 2))
    assert np.mean(squares) == pytest.approx(6.0, abs=1.2)
    assert np.mean(factors) == pytest.approx(1.0, abs=0.05)
    assert np.mean(equal) > 1.2 * np.mean(weighted)


def test_understated_errors_are_included() -> None:
    robot, squares = move_robot(TIMES), []
    for seed in range(30):
        found = solve(track(robot, seed, 5.0), robot)
        error = subtract(found.world_from_robot, WORLD)
        squares.append(error @ np.linalg.solve(found.world_covariance, error))
    assert np.mean(squares) == pytest.approx(6.0, abs=2.0)


def test_frames_do_not_matter() -> None:
    """Another base and another object frame transform the results."""
    robot = move_robot(TIMES)
    tracked, base = track(robot, 3), RigidTransform.from_components([1.0, 2.0, 3.0], Rotation.from_rotvec([1, -1, 2]))
    expected, found = solve(tracked, robot), solve(tracked * OBJECT.inv(), base * robot)
    other = expected.world_from_robot * base.inv()
    np.testing.assert_allclose(found.world_from_robot.rotation.as_matrix(), other.rotation.as_matrix(), atol=1e-2)
    scaled = solve(
        RigidTransform.from_components(1e3 * tracked.translation, tracked.rotation),
        RigidTransform.from_components(1e3 * robot.translation, robot.rotation),
    )
    # The covariances are not scaled: rotations weigh less, and results agree within the noise.
    assert np.abs(subtract(scaled.world_from_robot, expected.world_from_robot)[:3]).max() < 5e-3


@pytest.mark.skipif(not hasattr(cv2, "calibrateHandEye"), reason="OpenCV 5 does not have it in Python")
def test_against_opencv() -> None:
    """Cameras on the flange, as cv2.calibrateHandEye assumes; its result is within the noise of ours."""
    robot = move_robot(TIMES)
    # base_from_flange X cam_from_target: tracked = (robot⁻¹ ...), the object still in the base.
    flange_from_camera = WORLD.inv()
    tracked = (robot * flange_from_camera).inv() * OBJECT
    found = solve_hand_eye(tracked, np.tile(COVARIANCE, (len(robot), 1, 1)), robot.inv())
    rotation, translation = getattr(cv2, "calibrateHandEye")(  # noqa: B009
        list(robot.rotation.as_matrix()),
        list(robot.translation),
        list(tracked.rotation.as_matrix()),
        list(tracked.translation),
        method=1,  # CALIB_HAND_EYE_PARK
    )
    inverse = found.world_from_robot.inv()
    np.testing.assert_allclose(inverse.rotation.as_matrix(), rotation, atol=1e-6)
    np.testing.assert_allclose(inverse.translation, translation.ravel(), atol=1e-6)
    np.testing.assert_allclose(inverse.as_matrix(), flange_from_camera.as_matrix(), atol=1e-6)


def test_against_kronecker_products() -> None:
    """R_A R_X = R_X R_B as a null space (Andreff, Horaud, Espiau 1999): another linear method."""
    robot = move_robot(TIMES)
    tracked = track(robot, 1)
    A, B = tracked[1:] * tracked[0].inv(), robot[1:] * robot[0].inv()
    a, b = A.rotation.as_matrix(), B.rotation.as_matrix()
    rows = np.vstack([np.kron(x, np.eye(3)) - np.kron(np.eye(3), y.T) for x, y in zip(a, b, strict=True)])
    u, _, v = np.linalg.svd(np.linalg.svd(rows)[2][-1].reshape(3, 3))
    X = u @ v * np.sign(np.linalg.det(u @ v))
    x = np.linalg.lstsq((np.eye(3) - a).reshape(-1, 3), (A.translation - B.translation @ X.T).ravel(), rcond=None)[0]
    found = solve(tracked, robot).world_from_robot
    assert np.degrees((Rotation.from_matrix(X) * found.rotation.inv()).magnitude()) < 0.5
    np.testing.assert_allclose(found.translation, x, atol=5e-3)


@pytest.mark.parametrize(
    ("robot", "tracked", "message"),
    [
        (move_robot(TIMES, np.outer([1, 1, 1], [0.6, 0.0, 0.8])), None, "rotates about parallel axes only"),
        (move_robot(TIMES, 1e-3 * np.eye(3)), None, r"the robot rotates by 0\.\d degrees only: rotate it by 30"),
        (move_robot(TIMES), track(move_robot(TIMES + 1.0)), "rotate by different angles in .* one clock"),
        (move_robot(TIMES).inv(), track(move_robot(TIMES)), "fit only as their inverses: give base_from_flange"),
        (move_robot(TIMES[:3]), None, "at least 4 poses of both, got 3"),
    ],
)
def test_degenerate_motions_are_refused(robot: RigidTransform, tracked: RigidTransform | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        solve(track(robot, 0) if tracked is None else tracked, robot)


def test_wrong_poses_do_not_bend_the_solution() -> None:
    robot = move_robot(TIMES)
    matrices = track(robot, 5).as_matrix()
    wrong = RigidTransform.from_components([0.3, -0.2, 0.1], Rotation.from_rotvec([0.3, 0.2, -0.4]))
    matrices[[7, 20, 33]] = matrices[[7, 20, 33]] @ wrong.as_matrix()
    found = solve(RigidTransform.from_matrix(matrices), robot)
    error = subtract(found.world_from_robot, WORLD)
    assert error @ np.linalg.solve(found.world_covariance, error) < 22.5
    assert np.flatnonzero(~found.used).tolist() == [7, 20, 33]


def test_robot_that_stops() -> None:
    """Few poses of the robot, not at the times of frames."""
    times, stops = np.arange(0.0, 60.0, 1 / 30), np.arange(2.0, 58.0, 4.0) + 0.011
    found, poses = interpolate_robot(times, stops, move_robot(stops))
    np.testing.assert_allclose(times[found], stops, atol=0.017)
    np.testing.assert_allclose(poses.as_matrix(), move_robot(stops).as_matrix(), atol=1e-12)


def test_interpolation() -> None:
    times = np.array([0.31, 0.5, 2.0, 9.0])
    dense = np.arange(0.0, 5.0, 0.01)
    found, poses = interpolate_robot(times, dense, move_robot(dense))
    assert found.tolist() == [0, 1, 2]
    np.testing.assert_allclose(poses.as_matrix(), move_robot(times[:3]).as_matrix(), atol=1e-4)
    with pytest.raises(ValueError, match="both need one clock"):
        interpolate_robot(times + 100.0, dense, move_robot(dense))


def write_recording(folder: Path, seed: int = 0, *, eye_in_hand: bool = False) -> list[str]:
    """Write a result in meters, and a robot's log in millimeters at another rate."""
    robot = move_robot(TIMES)
    tracked = track(robot.inv() if eye_in_hand else robot, seed)
    frames = [
        FramePose(k, float(TIMES[k]), FrameStatus.TRACKED, tracked[k], COVARIANCE, np.array([9]), np.ones(1))
        for k in range(len(TIMES))
    ]
    write_trajectory(folder / "result", Trajectory(frames, ["cam_0"], "m"))
    dense = np.arange(-0.5, 5.0, 0.008)
    log = move_robot(dense)
    write_tum(folder / "robot.tum", dense, RigidTransform.from_components(1e3 * log.translation, log.rotation), "mm")
    return ["hand-eye", str(folder / "result"), str(folder / "robot.tum"), "--robot-unit", "mm", "--out", str(folder)]


@pytest.mark.parametrize("eye_in_hand", [False, True])
def test_command(eye_in_hand: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--eye-in-hand"] if eye_in_hand else []
    assert main([*write_recording(tmp_path, eye_in_hand=eye_in_hand), *options]) == 0
    printed = capsys.readouterr().out
    assert "40 of 40 tracked ones" in printed
    found = tomllib.loads((tmp_path / "hand_eye.toml").read_text())
    names = ("world_from_flange", "base_from_object") if eye_in_hand else ("world_from_base", "flange_from_object")
    for name, truth in zip(names, (WORLD, OBJECT), strict=True):
        assert name in printed
        pose = RigidTransform.from_components(found[name]["translation"], Rotation.from_quat(found[name]["quaternion"]))
        error, sd = subtract(pose, truth), np.sqrt(np.diag(found[name]["covariance"]))
        assert (np.abs(error) < 4.0 * sd).all()
        assert (sd < 5e-3).all()
    assert found["unit"] == "m"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--time-offset", "100"], "both need one clock"),
        (["--robot-unit", "furlong"], "--robot-unit must be one of"),
        (["--eye-in-hand"], "fit only as their inverses"),
    ],
)
def test_wrong_input(change: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*write_recording(tmp_path), *change]) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "hand_eye.toml").exists()
