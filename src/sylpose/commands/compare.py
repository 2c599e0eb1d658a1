"""`sylpose compare`: errors of one trajectory against another as a table, a plot and JSON."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from sylpose.commands.app import OUTPUT, CommandOptions, command, option
from sylpose.commands.options import PlotFormat
from sylpose.units import METERS

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform

    from sylpose.comparison import Alignment, Comparison
    from sylpose.geometry.arrays import FloatArray


# Same as in `comparison`, repeated here to avoid importing NumPy.
ALIGNMENTS = ("first", "none", "se3", "sim3", "both")
PRINTED_STATISTICS = ("rmse", "median", "max")
# Smaller errors are shown as 0: rounding, in degrees and in lengths of any unit (choice).
ROUNDING_ERROR = 1e-9


@dataclass(frozen=True, kw_only=True)
class CompareOptions(CommandOptions):
    """Options of `sylpose compare`.

    Attributes:
        a: Trajectory: a recording that was tracked, a folder of sylpose track, a trajectory.csv or a .tum.
        b: Reference trajectory, in the same formats.
        align: Align A to B before comparing. first: the object's frame (motion since the first common pose); none; se3,
            sim3: the world frame, rigidly or with scale, fitted to positions; both: the world and the object's frame.
        step: Compute relative errors over N poses.
        within: Match poses within this time difference; default: half of B's smallest step.
        out: Write compare.json and compare.png here.
    """

    a: Annotated[Path, typer.Argument(metavar="A")]
    b: Annotated[Path, typer.Argument(metavar="B")]
    align: Annotated[str, option(f"--align {'|'.join(ALIGNMENTS)}", choices=ALIGNMENTS)] = "first"
    step: Annotated[int, option("--step N")] = 1
    within: Annotated[float | None, option("--within SEC")] = None
    out: Annotated[Path, option("--out DIR", OUTPUT)] = Path()
    plot_format: PlotFormat = "png"


@command("Compute the errors between two trajectories.")
def compare(options: CompareOptions) -> None:
    """Compute absolute and relative pose errors of A with respect to B.

    Prints a table and writes compare.png and compare.json. Errors are expressed in B's frames.

    Examples:
        sylpose compare recording truth.tum
        sylpose compare first/sylpose second/sylpose --align none --out compared
    """
    import json

    from rich.text import Text
    from scipy.spatial.transform import RigidTransform

    from sylpose.atomic_io import make_output_folder, replace_atomically
    from sylpose.comparison import compare_trajectories
    from sylpose.display import format_length
    from sylpose.report.plots import plot_comparison
    from sylpose.runs import console_output
    from sylpose.runs.run_metadata import find_result

    a, b, align, step = find_result(options.a), find_result(options.b), options.align, options.step
    times, poses, unit_a = read_motion(a)
    reference_times, reference, unit_b = read_motion(b)
    unit, alignment = unit_b or unit_a, cast("Alignment", align)
    if unit_a in METERS and unit_b in METERS:
        scale = METERS[unit_a] / METERS[unit_b]
        poses = RigidTransform.from_components(scale * poses.translation, poses.rotation)
    result = compare_trajectories(
        times, poses, reference_times, reference, align=alignment, step=step, max_time_diff=options.within
    )
    console = console_output.make_console()
    summary = f": {len(result.times)} of {result.n_reference} poses, aligned by {align}"
    console.print(Text.assemble((f"{a} against {b}", "bold"), summary), soft_wrap=True)
    if align == "sim3":
        console.print(f"Scale: {result.scale:.6g}")
    content, rows = _build_json_content(result, step, unit), []
    relative = "pose-to-pose" if step == 1 else f"{step}-pose"
    for label, errors in (("absolute", content["absolute"]), (relative, content["relative"])):
        values = ([errors[key][name] for name in PRINTED_STATISTICS] for key in ("rotation_deg", "position"))
        rotation, position = ([v if v > ROUNDING_ERROR else 0.0 for v in row] for row in values)
        rows.append([f"{label} rotation", *(f"{value:.3g}°" for value in rotation)])
        rows.append([f"{label} position", *(format_length(value, unit) for value in position)])
    console_output.print_table(console, ("Error", *PRINTED_STATISTICS), rows)
    console_output.print_warnings(console, describe_mismatches(a, b, unit_a, unit_b, align))
    folder = make_output_folder(options.out)
    files = [folder / "compare.json", folder / f"compare.{options.plot_format}"]
    with replace_atomically(files[0]) as part:
        part.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    plot_comparison(result, files[1], unit=unit, title=f"{a} against {b}")
    console_output.print_files(console, "Files", files)


def read_motion(path: Path) -> tuple[FloatArray, RigidTransform, str]:
    """Read the measured poses of a run's folder, a trajectory.csv or a TUM file.

    Returns:
        times (n,), n poses world_from_object, and the length unit or "".

    Raises:
        ValueError: the file contains no pose; the message names it.
        OSError: the file cannot be read.
    """
    import numpy as np
    from scipy.spatial.transform import RigidTransform

    from sylpose.report.files import read_tum
    from sylpose.runs.view import load_trajectory

    if path.is_file() and path.suffix.lower() in (".tum", ".txt"):
        (times, poses), unit = read_tum(path), ""
    else:
        trajectory = load_trajectory(path)
        frames = [frame for frame in trajectory if frame.is_measured]
        matrices = [f.world_from_object.as_matrix() for f in frames if f.world_from_object is not None]
        poses = RigidTransform.from_matrix(np.array(matrices).reshape(-1, 4, 4))
        times, unit = np.array([frame.time for frame in frames]), trajectory.unit
    if not len(times):
        raise ValueError(f"{path}: contains no pose")
    return times, poses, unit


def describe_mismatches(a: Path, b: Path, unit_a: str, unit_b: str, align: str) -> list[str]:
    """Describe differences of units, worlds and calibrations for which the alignment does not compensate."""
    from sylpose.runs.run_metadata import read_settings, read_world_definition, settings_table

    found = []
    if unit_a != unit_b and not {unit_a, unit_b} <= METERS.keys() and align != "sim3":
        units = [unit or "an unspecified unit" for unit in (unit_a, unit_b)]
        found.append(
            f"A is in {units[0]}, B in {units[1]}: lengths are compared unscaled; --align sim3 estimates the scale."
        )
    settings = [read_settings(path) for path in (a, b)]
    # A TUM file has no settings, even if its folder has some.
    are_runs = all(settings) and all(path.is_dir() or path.suffix.lower() == ".csv" for path in (a, b))
    if align == "both" or not are_runs:
        return found
    remedy = "--align both compensates for that."
    worlds = [read_world_definition(path) or "its calibration's" for path in (a, b)]
    digests = {str(settings_table(run_settings, "checksums").get("calibration")) for run_settings in settings}
    if worlds[0] != worlds[1]:
        found.append(f"A and B use different worlds ({worlds[0]}; {worlds[1]}): {remedy}")
    elif unit_a == unit_b and len(digests) > 1:
        found.append(f"A and B use different calibrations, so their worlds may differ: {remedy}")
    return found


def _build_json_content(result: Comparison, step: int, unit: str) -> dict[str, Any]:
    """Return the content of compare.json: statistics and all errors, in degrees and length units."""
    import numpy as np

    from sylpose.comparison import compute_statistics

    content: dict[str, Any] = {"align": result.align, "step": step, "poses": len(result.times)}
    content |= {"of": result.n_reference, "unit": unit, "scale": result.scale}
    for name, rotation, position in (
        ("absolute", result.rotation, result.position),
        ("relative", result.relative_rotation, result.relative_position),
    ):
        content[name] = {
            "rotation_deg": compute_statistics(np.degrees(rotation)),
            "position": compute_statistics(position),
            "rotation_deg_of_each": np.degrees(rotation).tolist(),
            "position_of_each": position.tolist(),
        }
    return content | {"times": result.times.tolist()}
