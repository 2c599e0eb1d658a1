"""`sylpose scan`: the shape of a tracked object, from its silhouettes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from sylpose.commands.app import INPUT, OUTPUT, CommandOptions, command, option
from sylpose.commands.options import ResultPath

# Frames at most, all of which are held in memory (choice: 3 GB with four full HD cameras).
MAX_FRAMES = 120


@dataclass(frozen=True, kw_only=True)
class ScanOptions(CommandOptions):
    """Options of `sylpose scan`.

    Attributes:
        recording: Read the images from here if the recording was moved.
        n_frames: Use at most so many frames, spread over the recording.
        out: Write shape.glb and shape.png here; default: RESULT.
    """

    result: ResultPath
    recording: Annotated[Path | None, option("--recording DIR", INPUT)] = None
    n_frames: Annotated[int, option("--frames N", INPUT, min=2, max=MAX_FRAMES)] = 31
    out: Annotated[Path | None, option("--out DIR", OUTPUT)] = None


@command("Estimate a tracked object's shape from its silhouettes.")
def scan(options: ScanOptions) -> None:
    """Estimate the shape of a tracked object from its silhouettes in all cameras and frames (visual hull).

    Silhouettes are what differs from the static background, or the masks in the recording's folder. Writes shape.glb
    (glTF 2.0, in the object's frame) and shape.png. Requires the extra `shape`: pip install 'sylpose[shape]'.

    Examples:
        sylpose scan recording
        sylpose scan results --recording moved/recording --frames 60
    """
    import numpy as np

    from sylpose.atomic_io import make_output_folder
    from sylpose.display import format_length
    from sylpose.runs import console_output
    from sylpose.runs.run_metadata import find_result
    from sylpose.runs.scan import scan_result, write_scan

    result, console = find_result(options.result), console_output.make_console()
    found = scan_result(result, options.recording, options.n_frames)
    carved, unit = found.carved, found.rig.unit
    default = result if result.is_dir() else result.parent
    files = write_scan(found, make_output_folder(options.out or default))
    sides = " x ".join(format_length(float(side), unit) for side in np.ptp(carved.mesh.vertices, axis=0))
    facts = [
        ("Size", f"{sides}, along the axes of the object's frame"),
        ("Surface", f"{len(carved.mesh.faces)} triangles of {format_length(carved.spacing, unit)}"),
        ("Silhouettes", f"{int(carved.used.sum())} of {len(found.frames)} frames and {len(found.rig)} cameras"),
        ("Agreement", f"{100 * float(np.nanmedian(carved.agreement)):.1f} % of the area, median"),
    ]
    console_output.print_facts(console, facts)
    console_output.print_warnings(console, found.warnings)
    console_output.print_files(console, "Files", files)
