"""`sylpose compare`: errors of one trajectory against another as a table, a plot and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from rich.text import Text
from scipy.spatial.transform import RigidTransform

from sylpose.atomic_io import make_output_folder, replace_atomically
from sylpose.comparison import Alignment, Comparison, compare_trajectories, compute_statistics
from sylpose.geometry.arrays import FloatArray
from sylpose.report.comparison import plot_comparison
from sylpose.report.files import read_tum
from sylpose.runs import console_output
from sylpose.runs.run_metadata import read_settings, read_world_definition, settings_table
from sylpose.runs.view import read_result
from sylpose.units import METERS

__all__ = ["build_json_content", "describe_mismatches", "read_motion", "run_compare_command"]

PRINTED_STATISTICS = ("rmse", "median", "max")
# Smaller errors are shown as 0: rounding, in degrees and in lengths of any unit (choice).
ROUNDING_ERROR = 1e-9


class _Motion(NamedTuple):
    """Trajectory to compare: times (n,), n poses world_from_object, and the length unit or ""."""

    times: FloatArray
    poses: RigidTransform
    unit: str


def run_compare_command(
    a: Path, b: Path, align: str, step: int, within: float | None, out: Path, plot_format: str = "png"
) -> None:
    """Compare trajectory A with B; print the errors and write `compare.json` and a plot.

    Args:
        a, b: run folders, trajectory.csv files or TUM files.
        align: alignment of A to B, as in `compare_trajectories`.
        step: number of poses between the two poses of a relative error.
        within: largest difference of the times of paired poses; None as in `compare_trajectories`.
        out: output folder.
        plot_format: file name extension of the plot.

    Raises:
        ValueError: as `compare_trajectories`; a file is not a trajectory.
        OSError: a file cannot be read or written; the message names it.
    """
    ours, theirs = read_motion(a), read_motion(b)
    poses = ours.poses
    if ours.unit in METERS and theirs.unit in METERS:
        scale = METERS[ours.unit] / METERS[theirs.unit]
        poses = RigidTransform.from_components(scale * poses.translation, poses.rotation)
    unit = theirs.unit or ours.unit
    result = compare_trajectories(
        ours.times, poses, theirs.times, theirs.poses, align=cast(Alignment, align), step=step, max_time_diff=within
    )
    console = console_output.make_console()
    console.print(
        Text.assemble(
            (f"{a} against {b}", "bold"), f": {len(result.times)} of {result.n_reference} poses, aligned by {align}"
        ),
        soft_wrap=True,
    )
    if align == "sim3":
        console.print(f"Scale: {result.scale:.6g}")
    rows = []
    for label, degrees, lengths in _list_errors(result, step):
        both = compute_statistics(np.degrees(degrees)), compute_statistics(lengths)
        rotation, position = ({name: v if v > ROUNDING_ERROR else 0.0 for name, v in values.items()} for values in both)
        rows.append([f"{label} rotation", *(f"{rotation[name]:.3g}°" for name in PRINTED_STATISTICS)])
        rows.append(
            [f"{label} position", *(console_output.format_length(position[name], unit) for name in PRINTED_STATISTICS)]
        )
    console_output.print_table(console, ("Error", *PRINTED_STATISTICS), rows)
    console_output.print_warnings(console, describe_mismatches(a, b, ours.unit, theirs.unit, align))
    folder = make_output_folder(out)
    files = [folder / "compare.json", folder / f"compare.{plot_format}"]
    with replace_atomically(files[0]) as part:
        part.write_text(json.dumps(build_json_content(result, step, unit), indent=1) + "\n", encoding="utf-8")
    plot_comparison(result, files[1], unit=unit, title=f"{a} against {b}")
    console_output.print_files(console, "Files", files)


def read_motion(path: Path) -> _Motion:
    """Read the measured poses of a run's folder, a trajectory.csv or a TUM file.

    Raises:
        ValueError: the file contains no pose; the message names it.
        OSError: the file cannot be read.
    """
    if path.is_file() and path.suffix.lower() in (".tum", ".txt"):
        times, poses = read_tum(path)
        motion = _Motion(times, poses, "")
    else:
        trajectory = read_result(path)
        frames = [frame for frame in trajectory if frame.is_measured and frame.world_from_object is not None]
        matrices = [frame.world_from_object.as_matrix() for frame in frames if frame.world_from_object is not None]
        poses = RigidTransform.from_matrix(np.array(matrices).reshape(-1, 4, 4))
        motion = _Motion(np.array([frame.time for frame in frames]), poses, trajectory.unit)
    if not len(motion.times):
        raise ValueError(f"{path}: contains no pose")
    return motion


def describe_mismatches(a: Path, b: Path, unit_a: str, unit_b: str, align: str) -> list[str]:
    """Describe differences of units, worlds and calibrations for which the alignment does not compensate."""
    found = []
    if unit_a != unit_b and not {unit_a, unit_b} <= METERS.keys() and align != "sim3":
        units = [unit or "an unspecified unit" for unit in (unit_a, unit_b)]
        found.append(
            f"A is in {units[0]}, B in {units[1]}: lengths are compared unscaled; --align sim3 estimates the scale."
        )
    settings = [read_settings(path if path.is_dir() else path.parent) for path in (a, b)]
    # A TUM file has no settings, even if its folder has some.
    if (
        align == "both"
        or not all(settings)
        or not all(path.is_dir() or path.suffix.lower() == ".csv" for path in (a, b))
    ):
        return found
    remedy = "--align both compensates for that."
    worlds = [read_world_definition(path) or "its calibration's" for path in (a, b)]
    digests = {str(settings_table(run_settings, "checksums").get("calibration")) for run_settings in settings}
    if worlds[0] != worlds[1]:
        found.append(f"A and B use different worlds ({worlds[0]}; {worlds[1]}): {remedy}")
    elif unit_a == unit_b and len(digests) > 1:
        found.append(f"A and B use different calibrations, so their worlds may differ: {remedy}")
    return found


def build_json_content(result: Comparison, step: int, unit: str) -> dict[str, Any]:
    """Return the content of compare.json: statistics and all errors, in degrees and length units."""
    content: dict[str, Any] = {
        "align": result.align,
        "step": step,
        "poses": len(result.times),
        "of": result.n_reference,
        "unit": unit,
        "scale": result.scale,
    }
    for name, (_, rotation, position) in zip(("absolute", "relative"), _list_errors(result, step), strict=True):
        content[name] = {
            "rotation_deg": compute_statistics(np.degrees(rotation)),
            "position": compute_statistics(position),
            "rotation_deg_of_each": np.degrees(rotation).tolist(),
            "position_of_each": position.tolist(),
        }
    return content | {"times": result.times.tolist()}


def _list_errors(result: Comparison, step: int) -> list[tuple[str, FloatArray, FloatArray]]:
    interval = "pose-to-pose" if step == 1 else f"{step}-pose"
    return [
        ("absolute", result.rotation, result.position),
        (interval, result.relative_rotation, result.relative_position),
    ]
