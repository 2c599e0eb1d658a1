"""`sylpose object`: what is in an object's file, its frame and its size set, a result told in another frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import calibration
from sylpose.app import console_output
from sylpose.app.object_boards import board_frame
from sylpose.app.object_files import CLOUD, OBJECT, load_object, save_object, write_cloud
from sylpose.app.object_frames import (
    Points,
    extent_frame,
    moved_frame,
    one_of_draws,
    plane_frame,
    points_frame,
)
from sylpose.app.point_selection import KNOWN_DEPTH, Picked, known_well, result_of
from sylpose.app.run_metadata import SETTINGS, USED
from sylpose.atomic_io import output_folder
from sylpose.geometry.arrays import FloatArray
from sylpose.input_limits import told
from sylpose.report.files import write_trajectory
from sylpose.report.plots import plot_trajectory
from sylpose.results import FramePose, Trajectory
from sylpose.tracking.known_object import KnownObject
from sylpose.units import FIRST_DISTANCES

__all__ = ["apply_aloud", "frame_aloud", "scale_aloud", "show_aloud"]

# Axes less certain than this, radians, are said to be (choice).
HARDLY = np.radians(5.0)
# Draws that tell how uncertain a distance is (choice).
DRAWS = 200


# --- show ------------------------------------------------------------------------------------------------------------


def show_aloud(path: Path) -> None:
    """Says what is in an object's file.

    Raises:
        FileNotFoundError, ValueError: as `load_object`.
    """
    known, console = load_object(path), console_output.make_console()
    console_output.print_facts(console, facts_of(known))
    rows = []
    for name, memory in known._cameras.items():
        sd = memory.landmarks.depth_sd
        well = sd[sd < KNOWN_DEPTH * known.radius]
        views = sum(len(features) > 0 for features in memory.features)
        middle = console_output.length(float(np.median(well)), known.unit) if len(well) else "-"
        rows.append([name, str(len(sd)), str(len(well)), middle, str(views)])
    console_output.print_table(console, ["camera", "landmarks", "known well", "their median sd", "in keyframes"], rows)


def facts_of(known: KnownObject) -> list[tuple[str, str]]:
    """What is said of an object."""
    good, unit = known_well(known), known.unit
    bound = console_output.length(KNOWN_DEPTH * known.radius, unit)
    turns = Rotation.concatenate([k.world_from_object.rotation for k in known._keyframes])
    angle = np.degrees((turns * turns[0].inv()).magnitude().max())
    facts = [
        (
            "Object",
            f"{known.mark}, {len(known.places)} landmarks, {len(good)} of them known well: to {bound} in depth",
        ),
        ("Keyframes", f"{len(known._keyframes)}, turned by {angle:.0f}° at most"),
        ("Radius", console_output.length(known.radius, unit)),
    ]
    if len(good):
        size = np.ptp(good, axis=0)
        facts.append(("Extent", " x ".join(console_output.length(float(s), unit) for s in size) + " along its axes"))
    if unit == FIRST_DISTANCES:
        facts.append(
            ("Unit", "the first distance from the one camera that has learnt it; sylpose object scale sets another")
        )
    else:
        sized = f", all lengths to {100 * known.scale_sd:.2g} %" if known.scale_sd else ""
        facts.append(("Unit", (unit or "that of the calibration, which does not say it") + sized))
    facts.append(("Frame", known.frame.said or "that of the take that has learnt it"))
    if known.frame.sd.any():
        facts.append(("", sd_words(known.frame.sd, unit)))
    moved, turned = known.frame.from_learnt.translation, known.frame.from_learnt.rotation.magnitude()
    if moved.any() or turned:
        far = console_output.length(float(np.linalg.norm(moved)), unit)
        facts.append(("", f"origin {far} from where it was learnt, axes turned by {np.degrees(turned):.1f}°"))
    return facts


def sd_words(sd: FloatArray, unit: str) -> str:
    """Standard deviations of a frame for people."""
    axes = ", ".join(f"{np.degrees(s):.2f}°" for s in sd[:3])
    return (
        f"origin to {console_output.length(float(np.linalg.norm(sd[3:])), unit)}, axes to {axes} about x, y, z (one sd)"
    )


# --- frame -----------------------------------------------------------------------------------------------------------


def frame_aloud(
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
    """Sets the frame of an object, writes it as another file, and says how certain it is.

    Args:
        origin, x, xy: points (`app.point_selection.picked`).
        plane: "largest", or points on it.
        extent: by the directions in which it extends.
        turn: "X,Y,Z" degrees about the present axes, in this order.
        board: that is on it, in a recording (`boards.specification.parse_board`).
        result: folder of a run that has seen it, for points that are pixels; None: where the object lies.

    Raises:
        FileNotFoundError, ValueError, OSError: files; options that do not go together; points that tell no frame.
    """
    known = load_object(source)
    ways = {"--xy": xy, "--plane": plane, "--extent": extent, "--turn": turn, "--board": board}
    asked = [name for name, given in ways.items() if given]
    points = {name for name, given in (("--origin", origin), ("--x", x)) if given}
    # With each way, the points that there may be.
    allowed = {"": {"--origin"}, "--xy": {"--origin", "--x"}, "--plane": {"--origin", "--x"}, "--turn": {"--origin"}}
    if not asked and "--origin" not in points:
        raise ValueError(
            "nothing says which frame: --origin, --x and --xy (three points), --plane, --extent, --board, --turn or --origin"
        )
    if more := [*asked[1:], *sorted(points - allowed.get("".join(asked[:1]), set()))]:
        raise ValueError(f"{' and '.join([*asked[:1], *more])}: these do not go together")
    if (board is None) != (recording is None):
        raise ValueError("--board and --recording: what is on the object, and a recording in which it is seen")
    if xy and len(points) < 2:
        raise ValueError("--xy: three points are --origin, --x and --xy")
    picks = Points(known, source, result)
    if board is not None and recording is not None:
        found = board_frame(picks.result, recording, board)
    elif plane:
        found = plane_frame(picks, plane, origin, x)
    elif extent:
        found = extent_frame(known)
    elif xy and x and origin:
        found = points_frame(picks, origin, x, xy)
    else:
        found = moved_frame(picks, origin, turn)
    with told(target):
        new = known.in_frame(*found)
    write_object(new, target)
    console = console_output.make_console()
    console_output.print_facts(console, [fact for fact in facts_of(new) if fact[0] in ("Frame", "", "Extent")])
    if found.sd[:3].max() > HARDLY:
        console_output.print_warnings(console, [f"its axes are hardly told: {sd_words(found.sd, known.unit)}"])
    console_output.print_files(console, "Files", [target, target.with_suffix(".ply")])


def write_object(known: KnownObject, target: Path) -> None:
    """The object's file, and its cloud beside it.

    Raises:
        ValueError: another ending; OSError: naming the file that cannot be written.
    """
    if target.suffix != ".npz":
        raise ValueError(f"{target}: an object's file ends in .npz")
    output_folder(target.parent)
    save_object(known, target)
    write_cloud(known, target.with_suffix(".ply"))


# --- scale -----------------------------------------------------------------------------------------------------------


def scale_aloud(
    source: Path,
    target: Path | None,
    between: tuple[str, str],
    distance: float,
    unit: str | None = None,
    result: Path | None = None,
) -> None:
    """Compares the distance of two points of an object with what it is said to be, and writes an object of one camera that
    much larger or smaller.

    Args:
        target: None: only say how far off it is.
        between: two points (`app.point_selection.picked`).
        distance: that they are apart.
        unit: of the distance.
        result: as in `frame_aloud`.

    Raises:
        FileNotFoundError, ValueError, OSError: as `frame_aloud`; an object whose lengths cameras have measured is written.
    """
    known = load_object(source)
    if not (np.isfinite(distance) and distance > 0):
        raise ValueError(f"--distance: a positive length is expected, got {distance}")
    points = Points(known, source, result)
    a, b = (points("--between", words) for words in between)
    apart = float(np.linalg.norm(b.place - a.place))
    if not apart > 0:
        raise ValueError("--between: the two points are one")
    sd = _apart_sd(a, b) / apart
    open_size = known.unit == FIRST_DISTANCES
    if not open_size and unit not in (None, known.unit):
        raise ValueError(f"--unit {unit}: the object's lengths are in {known.unit or 'a unit that is not said'}")
    console = console_output.make_console()
    if open_size:
        facts = [
            (
                "Apart",
                f"{console_output.length(apart, FIRST_DISTANCES)}, said to be {console_output.length(distance, unit or '')}",
            )
        ]
        facts.append(("Size", f"{distance / apart:.6g} times, to {100 * sd:.2g} % (one sd)"))
    else:
        off = apart / distance - 1.0
        measured, given = (console_output.length(value, known.unit) for value in (apart, distance))
        words = f"{measured} as measured, {given} as said"
        facts = [("Apart", words), ("Off", f"{100 * off:+.2f} %, measured to {100 * sd:.2g} % (one sd)")]
    console_output.print_facts(console, facts)
    if target is None:
        return
    if not open_size:
        raise ValueError(
            f"{source}: its lengths were measured by calibrated cameras; another size would contradict them in every take. "
            "If it is off, the calibration is: calibrate again, or scale the calibration's unit"
        )
    write_object(known.sized(distance / apart, unit or "", min(sd, 1.0)), target)
    console_output.print_files(console, "Files", [target, target.with_suffix(".ply")])


def _apart_sd(a: Picked, b: Picked) -> float:
    """Standard deviation of how far two points are apart."""
    rng, found = np.random.default_rng(0), []
    for _ in range(DRAWS):
        one = one_of_draws(rng)
        found.append(float(np.linalg.norm(one(b) - one(a))))
    return float(np.std(found))


# --- apply -----------------------------------------------------------------------------------------------------------


def apply_aloud(path: Path, result: Path, out: Path, plot_format: str = "png") -> None:
    """Tells the trajectory of a finished run in the frame of an object's file, in another folder.

    Args:
        path: of the object, in its new frame.
        result: folder of the run.
        out: folder for the files.

    Raises:
        FileNotFoundError, ValueError, OSError: files that are missing, a run of another object, the run's own folder.
    """
    known = load_object(path)
    its = result_of(result, known)
    if out.resolve() == path.resolve().parent or (out / SETTINGS).exists():
        raise ValueError(f"{out}: a run's results, or the object, are there; another folder is expected")
    trajectory = Trajectory(
        [retold(pose, its.frame_from_its) for pose in its.trajectory],
        its.trajectory.camera_names,
        its.trajectory.unit,
    )
    # What is left there of another run would be taken for this one's.
    for name in (OBJECT, CLOUD):
        (output_folder(out) / name).unlink(missing_ok=True)
    files = write_trajectory(out, trajectory)
    calibration.save(its.rig, out / USED)
    picture = out / f"report.{plot_format}"
    plot_trajectory(trajectory, picture, note=f"{result.resolve().name}, in the frame of {path.name}")
    save_object(replace(load_object(result / OBJECT), frame=known.frame), out / OBJECT)
    console_output.print_files(console_output.make_console(), "Files", [*files, picture, out / USED, out / OBJECT])


def retold(pose: FramePose, new_from_object: RigidTransform) -> FramePose:
    """A pose of which the standard deviations alone are known, of another frame; those of its place are then at most what
    they come to, however the errors of turn and place are correlated."""
    after = pose.of_frame(new_from_object)
    if pose.world_from_object is None or after.world_from_object is None:
        return pose
    x, y, z = np.abs(after.world_from_object.translation - pose.world_from_object.translation)
    lever = np.array([[0.0, z, y], [z, 0.0, x], [y, x, 0.0]])
    turned = np.where(lever > 0.0, lever * np.where(lever > 0.0, pose.sigma[:3], 0.0), 0.0).sum(axis=1)
    sd = np.concatenate([pose.sigma[:3], pose.sigma[3:] + turned])
    return replace(after, covariance=np.diag(sd**2))
