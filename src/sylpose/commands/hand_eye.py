"""`sylpose hand-eye`: calibrate a robot against the tracker."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sylpose.commands.app import INPUT, OUTPUT, CommandOptions, command, option
from sylpose.commands.options import ResultPath
from sylpose.units import METERS

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform

    from sylpose.geometry.arrays import FloatArray
    from sylpose.hand_eye import HandEye
    from sylpose.results import FramePose

FILE = "hand_eye.toml"


@dataclass(frozen=True, kw_only=True)
class HandEyeOptions(CommandOptions):
    """Options of `sylpose hand-eye`.

    Attributes:
        robot: Poses base_from_flange of the robot: a .tum (time tx ty tz qx qy qz qw), or a trajectory.csv.
        eye_in_hand: Assume that the cameras are on the flange and the object stands still; default: the object is on
            the flange.
        robot_unit: Set the length unit of ROBOT; default: that of RESULT.
        time_offset: Add this to ROBOT's times.
        out: Write hand_eye.toml here.
    """

    result: ResultPath
    robot: Annotated[Path, typer.Argument(metavar="ROBOT")]
    eye_in_hand: Annotated[bool, option("--eye-in-hand", INPUT)] = False
    robot_unit: Annotated[str | None, option(f"--robot-unit {'|'.join(METERS)}", INPUT)] = None
    time_offset: Annotated[float, option("--time-offset SEC", INPUT)] = 0.0
    out: Annotated[Path, option("--out DIR", OUTPUT)] = Path()


@command("Calibrate a robot: its base and flange in the tracker's frames.", name="hand-eye")
def hand_eye(options: HandEyeOptions) -> None:
    """Solve A X = X B: find the robot's base in the world and the object on its flange, with standard deviations.

    The object is mounted on the flange and the cameras stand still; with --eye-in-hand the cameras are on the flange
    and the object stands still. The robot must rotate about two axes. Writes hand_eye.toml.

    Examples:
        sylpose hand-eye recording robot.tum
        sylpose hand-eye recording robot.tum --eye-in-hand --robot-unit mm
    """
    import numpy as np

    from sylpose.atomic_io import make_output_folder, replace_atomically
    from sylpose.commands.compare import read_motion
    from sylpose.display import format_length
    from sylpose.hand_eye import interpolate_robot, solve_hand_eye
    from sylpose.runs import console_output
    from sylpose.runs.view import load_trajectory

    trajectory = load_trajectory(options.result)
    times, robot, unit = read_motion(options.robot)
    robot = _convert_unit(robot, options.robot_unit or unit, trajectory.unit)
    frames = [frame for frame in trajectory if frame.is_measured]
    found, robot = interpolate_robot(np.array([frame.time for frame in frames]), times + options.time_offset, robot)
    robot = robot.inv() if options.eye_in_hand else robot
    poses, covariance = _stack([frames[k] for k in found])
    solution = solve_hand_eye(poses, covariance, robot)
    file = make_output_folder(options.out) / FILE
    names = (
        ("world_from_flange", "base_from_object") if options.eye_in_hand else ("world_from_base", "flange_from_object")
    )
    with replace_atomically(file) as part:
        part.write_text(_format_solution(solution, names, trajectory.unit, len(found)), encoding="utf-8")
    console = console_output.make_console()
    rows = []
    for name, pose, c in (
        (names[0], solution.world_from_robot, solution.world_covariance),
        (names[1], solution.robot_from_object, solution.object_covariance),
    ):
        sd = np.sqrt(np.diag(c))
        angles = np.degrees(pose.rotation.as_rotvec())
        rows.append([name, *(" ".join(f"{v:.4f}" for v in values) for values in (pose.translation, angles))])
        rows.append(["  sd", *(" ".join(f"{v:.2g}" for v in values) for values in (sd[3:], np.degrees(sd[:3])))])
    header = ("Transform", f"position, {trajectory.unit or 'units'}", "rotation vector, °")
    console_output.print_table(console, header, rows)
    used = solution.used
    rms = [float(np.sqrt(np.mean(r[used] ** 2))) for r in (solution.rotation_residual, solution.position_residual)]
    position = format_length(rms[1], trajectory.unit)
    facts = [("Poses", f"{len(found)} of {len(frames)} tracked ones, at times of the robot; {used.sum()} agree")]
    facts.append(
        ("Residual", f"{np.degrees(rms[0]):.3g}°, {position} (rms); variance factor {solution.variance_factor:.3g}")
    )
    console_output.print_facts(console, facts)
    console_output.print_files(console, "File", [file])


def _convert_unit(robot: RigidTransform, unit: str, target: str) -> RigidTransform:
    """Convert the robot's lengths to those of the result; those without a unit have it already."""
    from scipy.spatial.transform import RigidTransform

    if unit and unit not in METERS:
        raise ValueError(f"--robot-unit must be one of {', '.join(METERS)}, got {unit!r}")
    if not unit or unit == target:
        return robot
    if target not in METERS:
        raise ValueError(f"--robot-unit {unit}: the result's unit is {target or 'unknown'}; track with --unit")
    return RigidTransform.from_components(robot.translation * (METERS[unit] / METERS[target]), robot.rotation)


def _stack(frames: list[FramePose]) -> tuple[RigidTransform, FloatArray]:
    """Return the poses and covariances (n, 6, 6) of measured frames."""
    import numpy as np
    from scipy.spatial.transform import RigidTransform

    poses = RigidTransform.concatenate([f.world_from_object for f in frames if f.world_from_object is not None])
    return poses, np.array([frame.covariance for frame in frames])


def _format_solution(solution: HandEye, names: tuple[str, str], unit: str, n: int) -> str:
    """Return the content of hand_eye.toml."""
    import numpy as np

    lines = [f'unit = "{unit}"', f"poses = {n}", f"variance_factor = {solution.variance_factor:.6g}"]
    lines += [f"axis_spread = {solution.axis_spread:.6g}"]
    for name, pose, covariance in (
        (names[0], solution.world_from_robot, solution.world_covariance),
        (names[1], solution.robot_from_object, solution.object_covariance),
    ):
        lines += ["", f"[{name}]", f"translation = {pose.translation.tolist()}"]
        lines += [f"quaternion = {pose.rotation.as_quat().tolist()}  # x y z w"]
        lines += ["# covariance of (w, d): rotation vector in radians, then position"]
        lines += [f"covariance = [\n{''.join(f'  {row},{chr(10)}' for row in np.asarray(covariance).tolist())}]"]
    return "\n".join(lines) + "\n"
