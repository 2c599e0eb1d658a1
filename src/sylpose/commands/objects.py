"""`sylpose object`: show an object file, set its frame or size, and re-express a result in its frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.atomic_io import make_output_folder
from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import input_errors
from sylpose.io import calibration
from sylpose.io.object_files import CLOUD_FILE, OBJECT_FILE, load_object, save_object, write_cloud
from sylpose.report.files import write_trajectory
from sylpose.report.plots import plot_trajectory
from sylpose.results import FramePose, Trajectory
from sylpose.runs import console_output
from sylpose.runs.object_boards import estimate_board_frame
from sylpose.runs.object_frames import (
    PointParser,
    frame_from_extent,
    frame_from_plane,
    frame_from_points,
    make_joint_sampler,
    move_frame,
)
from sylpose.runs.point_selection import MAX_DEPTH_SD_RATIO, PickedPoint, precise_landmarks, read_object_run
from sylpose.runs.run_metadata import SETTINGS, USED_CALIBRATION
from sylpose.tracking.known_object import KnownObject
from sylpose.units import INITIAL_DISTANCES

__all__ = [
    "run_object_apply_command",
    "run_object_frame_command",
    "run_object_scale_command",
    "run_object_show_command",
]

# Axes with a larger standard deviation, radians, cause a warning (choice).
MAX_AXIS_SD = np.radians(5.0)
# Monte Carlo draws for the uncertainty of a distance (choice).
N_DRAWS = 200


# --- show ------------------------------------------------------------------------------------------------------------


def run_object_show_command(path: Path) -> None:
    """Print the contents of an object file.

    Raises:
        FileNotFoundError, ValueError: as `load_object`.
    """
    known, console = load_object(path), console_output.make_console()
    console_output.print_facts(console, object_facts(known))
    rows = []
    for name, memory in known._cameras.items():
        sd = memory.landmarks.depth_sd
        precise = sd[sd < MAX_DEPTH_SD_RATIO * known.radius]
        views = sum(len(features) > 0 for features in memory.features)
        median_sd = console_output.format_length(float(np.median(precise)), known.unit) if len(precise) else "-"
        rows.append([name, str(len(sd)), str(len(precise)), median_sd, str(views)])
    console_output.print_table(console, ["camera", "landmarks", "precise", "their median sd", "in keyframes"], rows)


def object_facts(known: KnownObject) -> list[tuple[str, str]]:
    """Return the labeled facts that are printed about an object."""
    precise, unit = precise_landmarks(known), known.unit
    bound = console_output.format_length(MAX_DEPTH_SD_RATIO * known.radius, unit)
    rotations = Rotation.concatenate([k.world_from_object.rotation for k in known._keyframes])
    angle = np.degrees((rotations * rotations[0].inv()).magnitude().max())
    facts = [
        (
            "Object",
            f"{known.fingerprint}, {len(known.positions)} landmarks, {len(precise)} of them with a depth sd below {bound}",
        ),
        ("Keyframes", f"{len(known._keyframes)}, rotated by up to {angle:.0f}°"),
        ("Radius", console_output.format_length(known.radius, unit)),
    ]
    if len(precise):
        size = np.ptp(precise, axis=0)
        facts.append(
            ("Extent", " x ".join(console_output.format_length(float(s), unit) for s in size) + " along its axes")
        )
    if unit == INITIAL_DISTANCES:
        facts.append(
            ("Unit", "the first distance from the only camera of its run; set another with sylpose object scale")
        )
    else:
        scale_text = f", all lengths to {100 * known.scale_sd:.2g} %" if known.scale_sd else ""
        facts.append(("Unit", (unit or "that of the calibration, which does not state it") + scale_text))
    facts.append(("Frame", known.frame.description or "that of the recording of its run"))
    if known.frame.sd.any():
        facts.append(("", format_frame_sd(known.frame.sd, unit)))
    offset, angle_from_learned = known.frame.from_learned.translation, known.frame.from_learned.rotation.magnitude()
    if offset.any() or angle_from_learned:
        distance = console_output.format_length(float(np.linalg.norm(offset)), unit)
        facts.append(
            ("", f"origin {distance} from that of its run, axes rotated by {np.degrees(angle_from_learned):.1f}°")
        )
    return facts


def format_frame_sd(sd: FloatArray, unit: str) -> str:
    """Format the standard deviations of a frame for printing."""
    axes = ", ".join(f"{np.degrees(s):.2f}°" for s in sd[:3])
    return (
        f"origin to {console_output.format_length(float(np.linalg.norm(sd[3:])), unit)}, "
        f"axes to {axes} about x, y, z (one sd)"
    )


# --- frame -----------------------------------------------------------------------------------------------------------


def run_object_frame_command(
    source: Path,
    target: Path,
    *,
    origin: str | None = None,
    x: str | None = None,
    xy: str | None = None,
    plane: Sequence[str] = (),
    extent: bool = False,
    turn: str | None = None,
    board: str | None = None,
    recording: Path | None = None,
    result: Path | None = None,
) -> None:
    """Set the frame of an object, write it to another file and print its uncertainty.

    Args:
        source: the object file.
        target: file for the object in its new frame.
        origin, x, xy: points (`runs.point_selection.parse_point`).
        plane: "largest", or points on a plane.
        extent: use the object's principal directions.
        turn: "X,Y,Z", angles in degrees about the present axes, in this order.
        board: a board on the object (`boards.specification.parse_board`).
        recording: recording in which the board is visible.
        result: folder of a run of the object, for pixel points; None for the folder of `source`.

    Raises:
        FileNotFoundError, ValueError, OSError: files; options that exclude each other; points that define no frame.
    """
    known = load_object(source)
    definitions = {"--xy": xy, "--plane": plane, "--extent": extent, "--turn": turn, "--board": board}
    requested = [name for name, given in definitions.items() if given]
    points = {name for name, given in (("--origin", origin), ("--x", x)) if given}
    # Points that each definition accepts.
    allowed = {"": {"--origin"}, "--xy": {"--origin", "--x"}, "--plane": {"--origin", "--x"}, "--turn": {"--origin"}}
    if not requested and "--origin" not in points:
        raise ValueError(
            "no frame is given: use --origin alone, --origin with --x and --xy, --plane, --extent, --board or --turn"
        )
    if conflicting := [*requested[1:], *sorted(points - allowed.get("".join(requested[:1]), set()))]:
        raise ValueError(f"{' and '.join([*requested[:1], *conflicting])}: these options cannot be combined")
    if (board is None) != (recording is None):
        raise ValueError(
            "--board and --recording require each other: a board on the object, and a recording that shows it"
        )
    if xy and len(points) < 2:
        raise ValueError("--xy requires three points: --origin, --x and --xy")
    point_parser = PointParser(known, source, result)
    if board is not None and recording is not None:
        new_frame = estimate_board_frame(point_parser.result, recording, board)
    elif plane:
        new_frame = frame_from_plane(point_parser, plane, origin, x)
    elif extent:
        new_frame = frame_from_extent(known)
    elif xy and x and origin:
        new_frame = frame_from_points(point_parser, origin, x, xy)
    else:
        new_frame = move_frame(point_parser, origin, turn)
    with input_errors(target):
        framed = known.to_frame(*new_frame)
    write_object(framed, target)
    console = console_output.make_console()
    console_output.print_facts(console, [fact for fact in object_facts(framed) if fact[0] in ("Frame", "", "Extent")])
    if new_frame.sd[:3].max() > MAX_AXIS_SD:
        console_output.print_warnings(console, [f"The axes are uncertain: {format_frame_sd(new_frame.sd, known.unit)}"])
    console_output.print_files(console, "Files", [target, target.with_suffix(".ply")])


def write_object(known: KnownObject, target: Path) -> None:
    """Write an object file, and its point cloud next to it.

    Raises:
        ValueError: the suffix is not .npz.
        OSError: the file cannot be written; the message names it.
    """
    if target.suffix != ".npz":
        raise ValueError(f"{target}: the suffix of an object file must be .npz")
    make_output_folder(target.parent)
    save_object(known, target)
    write_cloud(known, target.with_suffix(".ply"))


# --- scale -----------------------------------------------------------------------------------------------------------


def run_object_scale_command(
    source: Path,
    target: Path | None,
    between: tuple[str, str],
    distance: float,
    unit: str | None = None,
    result: Path | None = None,
) -> None:
    """Compare the distance of two object points with a known length; scale an object of a single camera to it.

    Args:
        source: the object file.
        target: file for the scaled object; None to only compare.
        between: two points (`runs.point_selection.parse_point`).
        distance: the known length between them.
        unit: unit of `distance`.
        result: as in `run_object_frame_command`.

    Raises:
        FileNotFoundError, ValueError, OSError: as `run_object_frame_command`; a target for an object with measured
            lengths.
    """
    known = load_object(source)
    if not (np.isfinite(distance) and distance > 0):
        raise ValueError(f"--distance: expected a positive length, got {distance}")
    points = PointParser(known, source, result)
    a, b = (points("--between", lengths_text) for lengths_text in between)
    measured_distance = float(np.linalg.norm(b.position - a.position))
    if not measured_distance > 0:
        raise ValueError("--between: the two points coincide")
    sd = _distance_sd(a, b) / measured_distance
    has_free_scale = known.unit == INITIAL_DISTANCES
    if not has_free_scale and unit not in (None, known.unit):
        raise ValueError(f"--unit {unit}: the object's lengths are in {known.unit or 'an unknown unit'}")
    console = console_output.make_console()
    if has_free_scale:
        facts = [
            (
                "Distance",
                f"{console_output.format_length(measured_distance, INITIAL_DISTANCES)}, "
                f"given as {console_output.format_length(distance, unit or '')}",
            )
        ]
        facts.append(("Scale", f"{distance / measured_distance:.6g}, to {100 * sd:.2g} % (one sd)"))
    else:
        error = measured_distance / distance - 1.0
        measured_text, given_text = (
            console_output.format_length(value, known.unit) for value in (measured_distance, distance)
        )
        lengths_text = f"{measured_text} measured, {given_text} given"
        facts = [("Distance", lengths_text), ("Error", f"{100 * error:+.2f} %, measured to {100 * sd:.2g} % (one sd)")]
    console_output.print_facts(console, facts)
    if target is None:
        return
    if not has_free_scale:
        raise ValueError(
            f"{source}: its lengths were measured by calibrated cameras, and scaling would contradict them in every "
            "recording. Correct the calibration instead: calibrate again or scale its unit"
        )
    write_object(known.scaled(distance / measured_distance, unit or "", min(sd, 1.0)), target)
    console_output.print_files(console, "Files", [target, target.with_suffix(".ply")])


def _distance_sd(a: PickedPoint, b: PickedPoint) -> float:
    """Return the standard deviation of the distance between two points."""
    rng, distances = np.random.default_rng(0), []
    for _ in range(N_DRAWS):
        sample = make_joint_sampler(rng)
        distances.append(float(np.linalg.norm(sample(b) - sample(a))))
    return float(np.std(distances))


# --- apply -----------------------------------------------------------------------------------------------------------


def run_object_apply_command(path: Path, result: Path, out: Path, plot_format: str = "png") -> None:
    """Re-express the trajectory of a finished run in the frame of an object file, in a new folder.

    Args:
        path: object file with the new frame.
        result: folder of the run.
        out: folder for the files.
        plot_format: suffix of the report plot.

    Raises:
        FileNotFoundError, ValueError, OSError: missing files, a run of another object, or the run's folder as `out`.
    """
    known = load_object(path)
    run = read_object_run(result, known)
    if out.resolve() == path.resolve().parent or (out / SETTINGS).exists():
        raise ValueError(f"{out}: contains the results of a run, or the object; choose another folder")
    trajectory = Trajectory(
        [change_object_frame(pose, run.frame_from_run) for pose in run.trajectory],
        run.trajectory.camera_names,
        run.trajectory.unit,
    )
    # Files left by another run would be taken for those of this one.
    for name in (OBJECT_FILE, CLOUD_FILE):
        (make_output_folder(out) / name).unlink(missing_ok=True)
    files = write_trajectory(out, trajectory)
    calibration.save(run.rig, out / USED_CALIBRATION)
    plot_path = out / f"report.{plot_format}"
    plot_trajectory(trajectory, plot_path, note=f"{result.resolve().name}, in the frame of {path.name}")
    save_object(replace(load_object(result / OBJECT_FILE), frame=known.frame), out / OBJECT_FILE)
    console_output.print_files(
        console_output.make_console(), "Files", [*files, plot_path, out / USED_CALIBRATION, out / OBJECT_FILE]
    )


def change_object_frame(pose: FramePose, new_from_object: RigidTransform) -> FramePose:
    """Re-express a pose with known standard deviations but unknown correlations in another object frame.

    The resulting standard deviations of the position are upper bounds for any correlation of rotation and position
    errors.
    """
    changed = pose.in_object_frame(new_from_object)
    if pose.world_from_object is None or changed.world_from_object is None:
        return pose
    x, y, z = np.abs(changed.world_from_object.translation - pose.world_from_object.translation)
    lever = np.array([[0.0, z, y], [z, 0.0, x], [y, x, 0.0]])
    lever_sd = np.where(lever > 0.0, lever * np.where(lever > 0.0, pose.sigma[:3], 0.0), 0.0).sum(axis=1)
    sd = np.concatenate([pose.sigma[:3], pose.sigma[3:] + lever_sd])
    return replace(changed, covariance=np.diag(sd**2))
