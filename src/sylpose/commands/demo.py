"""`sylpose demo`: tracking of a built-in synthetic recording, and its errors against ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from sylpose.commands.app import command, exit_with_failures, option
from sylpose.commands.options import DisplayOptions, SeedOptions

if TYPE_CHECKING:
    from rich.console import Console

    from sylpose.geometry.arrays import FloatArray
    from sylpose.io.capture import Session
    from sylpose.runs.run_result import Run
    from sylpose.smoothing import Track

# Rotation error beyond which the demo counts as failed (choice: a hundred times the usual error, docs/benchmarks.md).
MAX_ERROR_DEG = 2.0
# The demo may replace the contents of a folder with this file.
MARKER_FILE = "sylpose-demo.txt"


@dataclass(frozen=True, kw_only=True)
class DemoOptions(SeedOptions):
    """Options of `sylpose demo`.

    Attributes:
        out: Write the recording and the results here.
        frames: Render N frames at 30 per second.
        turn: Set the object's total rotation.
        cameras: Set the number of cameras.
    """

    out: Annotated[Path, option("--out DIR")] = Path("sylpose_demo")
    frames: Annotated[int, option("--frames N")] = 60
    turn: Annotated[float, option("--turn DEG")] = 90.0
    cameras: Annotated[int, option("--cameras N")] = 4


@command("Render and track a recording with ground truth.")
def demo(options: DemoOptions) -> None:
    """Render a recording with ground truth, track it from its videos and compare.

    A textured block rotates and drifts in front of the cameras. Exit code 0 if the rotation error is below 2 degrees in
    all frames.

    Examples:
        sylpose demo
        sylpose demo --turn 120 --cameras 3 --out block
    """
    from sylpose.commands.track_display import track_in_terminal
    from sylpose.io.capture import open_session
    from sylpose.runs import console_output
    from sylpose.runs.options import RunOptions
    from sylpose.smoothing import Track

    console, out = console_output.make_console(), options.out
    rendering = f"Rendering {options.frames} frames of {options.cameras} cameras ..."
    if not console.is_terminal:  # on a terminal the status line below shows it
        console.print(rendering)
    with console.status(rendering):
        render_demo(out, frames=options.frames, turn_deg=options.turn, n_cameras=options.cameras, seed=options.seed)
    session = open_session(out)
    tracks = list[Track]()
    track_in_terminal(
        session,
        None,
        RunOptions(seed=options.seed),
        DisplayOptions(),
        on_frame=lambda frame: tracks.append(Track.from_tracked(frame)),
        on_end=lambda run: _compare_with_truth(console, session, run, tracks),
    )


def _compare_with_truth(console: Console, session: Session, run: Run, tracks: Sequence[Track]) -> None:
    """Print the errors, their standard deviations, and the part of these that is image noise.

    Args:
        console: where to print.
        session, run: the demo's.
        tracks: all frames, as tracked.

    Raises:
        Exit: frames are missing, or the errors are too large.
    """
    import numpy as np
    from rich.text import Text

    from sylpose.comparison import compare_trajectories
    from sylpose.display import format_length
    from sylpose.report.files import read_tum
    from sylpose.runs import console_output
    from sylpose.runs.check import explain_failures
    from sylpose.smoothing import smooth_tracks

    if problems := explain_failures(session, run):
        exit_with_failures(problems)
    truth, unit = read_tum(session.path / "groundtruth.tum"), session.rig.unit
    errors = compare_trajectories(*read_tum(run.files[0]), *truth)
    rotation, missing = np.degrees(errors.rotation), errors.n_reference - len(errors.times)
    console.print()
    console.print(
        Text.assemble(("Against ground truth", "bold"), f", motion since the first of {len(errors.times)} frames")
    )

    def format_sd(sigma: FloatArray) -> list[str]:
        return [f"{np.degrees(np.linalg.norm(sigma[:3])):.2f}°", format_length(float(np.linalg.norm(sigma[3:])), unit)]

    lengths = [format_length(x, unit) for x in (errors.position.max(), errors.position[-1])]
    stated, noise = format_sd(run.trajectory[-1].sigma), format_sd(smooth_tracks(tracks, session.rig).poses[-1].sigma)
    rows = [["rotation", f"{rotation.max():.2f}°", f"{rotation[-1]:.2f}°", stated[0], noise[0]]]
    rows.append(["position", *lengths, stated[1], noise[1]])
    console_output.print_table(console, ("Error", "worst", "at the end", "stated sd", "noise alone"), rows)
    console.print(
        "The stated standard deviation (sd) at the end covers image noise and calibration errors of usual size."
    )
    console.print("The calibration of this rendered recording is exact: its errors are those of the noise alone.")
    if missing or rotation.max() > MAX_ERROR_DEG:
        exit_with_failures([f"the demo failed: {missing} frames missing, errors above"])


def render_demo(out: Path, *, frames: int, turn_deg: float, n_cameras: int, seed: int) -> None:
    """Write the built-in recording into a folder that is new, empty or from an earlier demo.

    Raises:
        ValueError: fewer than two frames, or the folder contains other files.
        OSError: the folder or a file cannot be written; the message names it.
    """
    from sylpose.atomic_io import make_output_folder, output_errors, replace_atomically
    from sylpose.geometry.validation import check_number
    from sylpose.simulate import make_demo_scene, write_sequence

    if frames < 2:
        raise ValueError(f"the demo needs at least 2 frames, got {frames}")
    check_number(turn_deg, "--turn")
    make_output_folder(out)
    if any(out.iterdir()) and not (out / MARKER_FILE).exists():
        raise ValueError(f"{out}: is not empty and not from an earlier demo; the demo would replace files in it")
    with output_errors(out):
        with replace_atomically(out / MARKER_FILE) as part:
            part.write_text("Written by `sylpose demo`, which replaces it without confirmation.\n")
        for old in out.glob("cam_*.mp4"):  # an earlier demo may have had more cameras
            old.unlink()
        write_sequence(out, make_demo_scene(frames=frames, angle_deg=turn_deg, n_cameras=n_cameras, seed=seed))
