"""`sylpose compare`: how far two trajectories are apart, as a table, a picture and numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from rich.text import Text
from scipy.spatial.transform import RigidTransform

from sylpose.app import console_output
from sylpose.app.run_metadata import settings_of, table, world_said
from sylpose.app.view import read_result
from sylpose.atomic_io import output_folder, replacing
from sylpose.comparison import Alignment, Comparison, compared, statistics
from sylpose.geometry.arrays import FloatArray
from sylpose.report.comparison import plot_comparison
from sylpose.report.files import read_tum
from sylpose.units import METRES

__all__ = ["compare_aloud", "may_differ", "numbers_of", "read_motion"]

SHOWN = ("rmse", "median", "max")
# What is less is rounding: degrees, and lengths in any unit (choice).
NOTHING = 1e-9


class _Motion(NamedTuple):
    """Times (n,), n poses world_from_object, and the unit of lengths or ""."""

    times: FloatArray
    poses: RigidTransform
    unit: str


def compare_aloud(
    a: Path, b: Path, align: str, step: int, within: float | None, out: Path, plot_format: str = "png"
) -> None:
    """Says how far A is from B; writes `compare.json` and a picture into `out`.

    Raises:
        ValueError: as `compared`, and files that are no trajectories.
        OSError: naming the file that cannot be read or written.
    """
    ours, theirs = read_motion(a), read_motion(b)
    poses = ours.poses
    if ours.unit in METRES and theirs.unit in METRES:
        scale = METRES[ours.unit] / METRES[theirs.unit]
        poses = RigidTransform.from_components(scale * poses.translation, poses.rotation)
    unit = theirs.unit or ours.unit
    result = compared(
        ours.times, poses, theirs.times, theirs.poses, align=cast(Alignment, align), step=step, within=within
    )
    console = console_output.make_console()
    console.print(
        Text.assemble(
            (f"{a} against {b}", "bold"), f": {len(result.times)} of {result.total} poses, aligned by {align}"
        ),
        soft_wrap=True,
    )
    if align == "sim3":
        console.print(f"Scale: {result.scale:.6g}")
    rows = []
    for label, degrees, lengths in _errors(result, step):
        both = statistics(np.degrees(degrees)), statistics(lengths)
        turned, moved = ({name: v if v > NOTHING else 0.0 for name, v in its.items()} for its in both)
        rows.append([f"{label} turn", *(f"{turned[name]:.3g}°" for name in SHOWN)])
        rows.append([f"{label} position", *(console_output.length(moved[name], unit) for name in SHOWN)])
    console_output.print_table(console, ("Error", *SHOWN), rows)
    console_output.print_warnings(console, may_differ(a, b, ours.unit, theirs.unit, align))
    folder = output_folder(out)
    files = [folder / "compare.json", folder / f"compare.{plot_format}"]
    with replacing(files[0]) as part:
        part.write_text(json.dumps(numbers_of(result, step, unit), indent=1) + "\n", encoding="utf-8")
    plot_comparison(result, files[1], unit=unit, title=f"{a} against {b}")
    console_output.print_files(console, "Files", files)


def read_motion(path: Path) -> _Motion:
    """The measured poses of a run's folder, a trajectory.csv or a TUM file.

    Raises:
        ValueError: naming the file, where it has none.
        OSError: it cannot be read.
    """
    if path.is_file() and path.suffix.lower() in (".tum", ".txt"):
        times, poses = read_tum(path)
        motion = _Motion(times, poses, "")
    else:
        trajectory = read_result(path)
        frames = [frame for frame in trajectory if frame.measured and frame.world_from_object is not None]
        matrices = [frame.world_from_object.as_matrix() for frame in frames if frame.world_from_object is not None]
        poses = RigidTransform.from_matrix(np.array(matrices).reshape(-1, 4, 4))
        motion = _Motion(np.array([frame.time for frame in frames]), poses, trajectory.unit)
    if not len(motion.times):
        raise ValueError(f"{path}: no pose in it")
    return motion


def may_differ(a: Path, b: Path, unit_a: str, unit_b: str, align: str) -> list[str]:
    """Sentences on what A and B are told in that is not the same, and that the alignment does not allow for."""
    found = []
    if unit_a != unit_b and not {unit_a, unit_b} <= METRES.keys() and align != "sim3":
        units = [unit or "a unit that is not said" for unit in (unit_a, unit_b)]
        found.append(
            f"A is in {units[0]}, B in {units[1]}: lengths are compared as they are; --align sim3 scales them to fit."
        )
    settings = [settings_of(path if path.is_dir() else path.parent) for path in (a, b)]
    # A TUM file has none of its own, whatever it lies beside.
    if (
        align == "both"
        or not all(settings)
        or not all(path.is_dir() or path.suffix.lower() == ".csv" for path in (a, b))
    ):
        return found
    allow = "--align both allows for another world."
    worlds = [world_said(path) or "its calibration's" for path in (a, b)]
    digests = {str(table(its, "checksums").get("calibration")) for its in settings}
    if worlds[0] != worlds[1]:
        found.append(f"A and B are told in different worlds ({worlds[0]}; {worlds[1]}): {allow}")
    elif unit_a == unit_b and len(digests) > 1:
        found.append(f"A and B are of calibrations that differ, and their worlds may, too: {allow}")
    return found


def numbers_of(result: Comparison, step: int, unit: str) -> dict[str, Any]:
    """What compare.json has: statistics and every error, degrees and lengths."""
    content: dict[str, Any] = {
        "align": result.align,
        "step": step,
        "poses": len(result.times),
        "of": result.total,
        "unit": unit,
        "scale": result.scale,
    }
    for name, (_, rotation, position) in zip(("absolute", "relative"), _errors(result, step), strict=True):
        content[name] = {
            "rotation_deg": statistics(np.degrees(rotation)),
            "position": statistics(position),
            "rotation_deg_of_each": np.degrees(rotation).tolist(),
            "position_of_each": position.tolist(),
        }
    return content | {"times": result.times.tolist()}


def _errors(result: Comparison, step: int) -> list[tuple[str, FloatArray, FloatArray]]:
    over = "from pose to pose," if step == 1 else f"over {step} poses,"
    return [
        ("absolute", result.rotation, result.position),
        (over, result.relative_rotation, result.relative_position),
    ]
