"""`sylpose relative`: motion of one object in another one's frame, with joint angles and helical axes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sylpose.commands.app import INPUT, OUTPUT, CommandOptions, command, option
from sylpose.commands.options import EulerAxes

if TYPE_CHECKING:
    from sylpose.geometry.arrays import FloatArray
    from sylpose.geometry.euler_angles import EulerAngles
    from sylpose.joint_motion import HelicalAxes
    from sylpose.results import Trajectory


@dataclass(frozen=True, kw_only=True)
class RelativeOptions(CommandOptions):
    """Options of `sylpose relative`.

    Attributes:
        a: Object that is the frame of reference: a folder of sylpose track, or its trajectory.csv.
        b: Object whose motion is expressed in A's frame; the same formats.
        angles: Set the axes of the joint angles: XYZ (intrinsic axes), xyz (extrinsic axes), or three vectors, "0,0,1
            1,0,0 0,1,0".
        reference: Compute helical axes since this frame; default: the first common one.
        within: Match poses within this time difference; default: half of B's smallest step.
        out: Write the results here.
    """

    a: Annotated[Path, typer.Argument(metavar="A")]
    b: Annotated[Path, typer.Argument(metavar="B")]
    angles: EulerAxes = "XYZ"
    reference: Annotated[int | None, option("--reference N", INPUT, min=0)] = None
    within: Annotated[float | None, option("--within SEC", INPUT)] = None
    out: Annotated[Path, option("--out DIR", OUTPUT)] = Path()


@command("Express one object's motion in another one's frame.")
def relative(options: RelativeOptions) -> None:
    """Compute the poses of B in the frame of A, with standard deviations, joint angles and helical axes.

    Writes relative.csv and relative.tum (a_from_b, as trajectory.csv) and joint.csv (angles and helical axes). Both
    objects must come from one recording. sylpose export and sylpose compare accept relative.csv.

    Examples:
        sylpose relative recording/sylpose/thigh recording/sylpose/shank
        sylpose relative femur tibia --euler ZXY --out knee
        sylpose export relative.csv --out knee.sto
    """
    from sylpose.atomic_io import make_output_folder
    from sylpose.geometry.euler_angles import parse_euler_angles
    from sylpose.io.exports.text import write_csv
    from sylpose.joint_motion import compute_helical_axes, relate_trajectories
    from sylpose.report.files import write_trajectory
    from sylpose.runs import console_output
    from sylpose.runs.run_metadata import find_result, read_settings, read_world_definition, settings_table
    from sylpose.runs.view import load_trajectory

    a, b = find_result(options.a), find_result(options.b)
    angles = parse_euler_angles(options.angles or "XYZ")
    worlds = [read_world_definition(path) or "its calibration's" for path in (a, b)]
    if worlds[0] != worlds[1]:
        raise ValueError(f"{a} and {b} use different worlds ({worlds[0]}; {worlds[1]}): track both with one --world")
    trajectory = relate_trajectories(load_trajectory(a), load_trajectory(b), options.within)
    indices = [frame.index for frame in trajectory]
    if options.reference is not None and options.reference not in indices:
        raise ValueError(f"--reference: frame {options.reference} has no measured pose of both objects")
    reference = 0 if options.reference is None else indices.index(options.reference)
    axes = compute_helical_axes(trajectory, reference)
    folder = make_output_folder(options.out)
    files = write_trajectory(folder, trajectory, stem="relative", world="a", angles=angles)
    write_csv(_build_table(trajectory, angles, axes), folder / "joint.csv")
    console = console_output.make_console()
    console_output.print_facts(console, _summarize(trajectory, angles, axes))
    settings = [settings_table(read_settings(path), "checksums").get("calibration") for path in (a, b)]
    if None not in settings and settings[0] != settings[1]:
        console_output.print_warnings(console, ["A and B use different calibrations, so their worlds may differ."])
    console_output.print_files(console, "Files", [*files, folder / "joint.csv"])


def _build_table(trajectory: Trajectory, angles: EulerAngles, axes: HelicalAxes) -> dict[str, list[float]]:
    """Return the columns of joint.csv."""
    import numpy as np

    values, sds = _compute_angles(trajectory, angles)
    table: dict[str, list[float]] = {
        "index": [frame.index for frame in trajectory],
        "time": [frame.time for frame in trajectory],
    }
    for k, name in enumerate(angles.names):
        table |= {f"{name}_deg": values[:, k].tolist(), f"{name}_sd_deg": sds[:, k].tolist()}
    table |= {"helical_deg": np.degrees(axes.angle).tolist(), "helical_sd_deg": np.degrees(axes.angle_sd).tolist()}
    for name, vectors in (("axis", axes.axis), ("point", axes.point)):
        table |= {f"{name}_{letter}": vectors[:, k].tolist() for k, letter in enumerate("xyz")}
    table |= {"axis_sd_deg": np.degrees(axes.axis_sd).tolist(), "point_sd": axes.point_sd.tolist()}
    return table | {"slide": axes.slide.tolist(), "slide_sd": axes.slide_sd.tolist()}


def _compute_angles(trajectory: Trajectory, angles: EulerAngles) -> tuple[FloatArray, FloatArray]:
    """Return (n, 3) joint angles, continuous over time, and their standard deviations, degrees."""
    import numpy as np

    poses = [(frame.world_from_object, frame.covariance) for frame in trajectory]
    values = np.array([angles.from_rotation(pose.rotation) for pose, _ in poses if pose is not None])
    sds = np.array([angles.sigma(pose.rotation, c[:3, :3]) for pose, c in poses if pose is not None])
    return np.degrees(np.unwrap(values, axis=0)), np.degrees(sds)


def _summarize(trajectory: Trajectory, angles: EulerAngles, axes: HelicalAxes) -> list[tuple[str, str]]:
    """Return lines on the joint's motion."""
    import numpy as np

    from sylpose.display import format_length, format_vector
    from sylpose.joint_motion import fit_mean_axis

    values, sds = _compute_angles(trajectory, angles)
    facts = [("Frames", f"{len(trajectory)} with a measured pose of both objects")]
    for k, name in enumerate(angles.names):
        sd = np.nanmedian(sds[:, k]) if np.isfinite(sds[:, k]).any() else np.nan
        facts.append((name, f"{values[:, k].min():.2f}° to {values[:, k].max():.2f}° (median sd {sd:.2g}°)"))
    facts.append(("Helical angle", f"{np.degrees(axes.angle.max()):.2f}° at most"))
    if (mean := fit_mean_axis(axes)) is not None:
        slide = axes.slide[np.isfinite(axes.slide)]
        words = f"direction {format_vector(mean[0], 4)}, point {format_vector(mean[1], 4)} in A's frame"
        facts.append(
            ("Mean axis", f"{words}, slide {format_length(float(np.abs(slide).max()), trajectory.unit)} at most")
        )
    return facts
