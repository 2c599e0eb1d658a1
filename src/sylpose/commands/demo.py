"""`sylpose demo`: tracking of a built-in synthetic recording, and its errors against ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from rich.console import Console
from rich.text import Text
from scipy.spatial.transform import RigidTransform

from sylpose.atomic_io import make_output_folder, output_errors, replace_atomically
from sylpose.commands.track_command import run_track_command
from sylpose.comparison import associate_timestamps
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import check_number
from sylpose.io.capture import open_session
from sylpose.report.files import read_tum
from sylpose.runs import console_output
from sylpose.runs.session_warnings import explain_failures
from sylpose.simulate import DemoTruth, render_sequence

__all__ = ["MAX_ERROR_DEG", "DemoErrors", "compute_errors", "render_demo", "run_demo_command"]


# Rotation error beyond which the demo counts as failed (choice: a hundred times the usual error, docs/benchmarks.md).
MAX_ERROR_DEG = 2.0
# The demo may replace the contents of a folder with this file.
MARKER_FILE = "sylpose-demo.txt"


@dataclass(frozen=True, eq=False)
class DemoErrors:
    """Errors of the motion relative to the first pose that both estimate and ground truth have.

    Attributes:
        total: number of true poses.
        rotation: (n - 1,) rotation errors in degrees, for each of the n paired poses after the first.
        translation: (n - 1,) position errors of the object's center in length units.
    """

    total: int
    rotation: FloatArray
    translation: FloatArray

    @property
    def missing(self) -> int:
        """Number of true poses without an estimate."""
        return self.total - len(self.rotation) - 1


def run_demo_command(out: Path, *, frames: int, turn_deg: float, n_cameras: int, seed: int) -> list[str]:
    """Render the built-in recording, track it from its videos, and print the errors.

    Args:
        out: folder of the recording; results go into `sylpose` in it.
        frames: number of frames.
        turn_deg: total rotation of the object in degrees.
        n_cameras: number of cameras.
        seed: seed of the rendering and of the tracker.

    Returns:
        error messages; empty if all frames were solved to within `MAX_ERROR_DEG`.

    Raises:
        ValueError, OSError: as `render_demo` and `track_session`.
    """
    console = console_output.make_console()
    rendering = f"Rendering {frames} frames of {n_cameras} cameras ..."
    if not console.is_terminal:  # on a terminal the status line below shows it
        console.print(rendering)
    with console.status(rendering):
        truth = render_demo(out, frames=frames, turn_deg=turn_deg, n_cameras=n_cameras, seed=seed)
    session = open_session(out)
    run = run_track_command(session, None, seed=seed)
    if problems := explain_failures(session, run):
        return problems
    center = truth.world_from_object[0].translation
    result = compute_errors(*read_tum(run.files[0]), *read_tum(out / "groundtruth.tum"), center=center)
    console.print()
    _print_score(console, result, run.trajectory.unit)
    if result.missing or result.rotation.max() > MAX_ERROR_DEG:
        return [f"the demo failed: {result.missing} frames missing, errors above"]
    return []


def _print_score(console: Console, result: DemoErrors, unit: str) -> None:
    """Print the final and the largest errors."""
    found = result.total - result.missing
    console.print(Text.assemble(("Against ground truth", "bold"), f", motion since the first of {found} frames"))
    rows = [
        ["rotation", *(f"{value:.2f}°" for value in (result.rotation[-1], result.rotation.max()))],
        [
            "position",
            *(
                console_output.format_length(value, unit)
                for value in (result.translation[-1], result.translation.max())
            ),
        ],
    ]
    console_output.print_table(console, ("Error", "at the end", "worst"), rows)


def compute_errors(
    times: ArrayLike,
    world_from_object: RigidTransform,
    true_times: ArrayLike,
    true_world_from_object: RigidTransform,
    center: ArrayLike,
) -> DemoErrors:
    """Compute the errors of a trajectory against ground truth, independent of the choice of the object frame.

    Compares M_k = T_k T_0^-1, which maps world points on the object from the first paired pose to pose k.

    Args:
        times: (m,) times of the estimate; paired with the nearest true time within half the smallest true step.
        world_from_object: m estimated poses.
        true_times: (n,) at least two, increasing.
        true_world_from_object: n true poses.
        center: (3,) the object's center in the world at the first true pose.

    Raises:
        ValueError: no estimated pose, fewer than two true poses, or fewer than two pairs.
    """
    times, true_times = np.asarray(times, dtype=float), np.asarray(true_times, dtype=float)
    if len(true_times) < 2 or not len(times):
        raise ValueError(f"scoring needs two true poses and an estimate, got {len(true_times)} and {len(times)}")
    estimate_index, truth_index = associate_timestamps(times, true_times)
    if len(estimate_index) < 2:
        raise ValueError(f"only {len(estimate_index)} of {len(true_times)} true poses have an estimate at their time")
    estimate, truth = world_from_object[estimate_index], true_world_from_object[truth_index]
    motion, true_motion = estimate * estimate[0].inv(), truth * truth[0].inv()
    start = (truth[0] * true_world_from_object[0].inv()).apply(center)
    rotation = np.degrees((true_motion.rotation.inv() * motion.rotation).magnitude())
    translation = np.linalg.norm(motion.apply(start) - true_motion.apply(start), axis=1)
    return DemoErrors(len(true_times), rotation[1:], translation[1:])


def render_demo(out: Path, *, frames: int, turn_deg: float, n_cameras: int, seed: int) -> DemoTruth:
    """Write the built-in recording into a folder that is new, empty or from an earlier demo.

    Raises:
        ValueError: fewer than two frames, or the folder contains other files.
        OSError: the folder or a file cannot be written; the message names it.
    """
    if frames < 2:
        raise ValueError(f"the demo needs at least 2 frames, got {frames}")
    check_number(turn_deg, "--turn")
    if seed < 0:
        raise ValueError(f"--seed must not be negative, got {seed}")
    make_output_folder(out)
    if any(out.iterdir()) and not (out / MARKER_FILE).exists():
        raise ValueError(f"{out}: is not empty and not from an earlier demo; the demo would replace files in it")
    with output_errors(out):
        with replace_atomically(out / MARKER_FILE) as part:
            part.write_text("Written by `sylpose demo`, which replaces it without confirmation.\n")
        for old in out.glob("cam_*.mp4"):  # an earlier demo may have had more cameras
            old.unlink()
        return render_sequence(out, frames=frames, angle_deg=turn_deg, n_cameras=n_cameras, seed=seed)
