"""`sylpose demo`: the built-in recording and how well it was tracked, motion since the start against the known truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from rich.console import Console
from rich.text import Text
from scipy.spatial.transform import RigidTransform

from sylpose.app import console_output
from sylpose.app.track_command import track_aloud, why_nothing
from sylpose.atomic_io import output_folder, replacing, writing
from sylpose.capture import open_session
from sylpose.comparison import pairs_in_time
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.validation import number
from sylpose.report.files import read_tum
from sylpose.simulate import DemoTruth, render_sequence

__all__ = ["MAX_ERROR_DEG", "Score", "demo_aloud", "render_demo", "score"]


# Of the turn, beyond which the demo counts as failed (choice: a hundred times what it comes to, docs/benchmarks.md).
MAX_ERROR_DEG = 2.0
# In a folder with this file the demo may replace what it finds.
MARK = "sylpose-demo.txt"


@dataclass(frozen=True, eq=False)
class Score:
    """Errors of the motion since the first pose that estimate and truth both have.

    Attributes:
        total: number of true poses.
        rotation: (n - 1,) degrees, for each of the n paired poses after the first.
        displacement: (n - 1,) of the object's centre, length units.
    """

    total: int
    rotation: FloatArray
    displacement: FloatArray

    @property
    def missing(self) -> int:
        """True poses without an estimate."""
        return self.total - len(self.rotation) - 1


def demo_aloud(out: Path, *, frames: int, turn_deg: float, n_cameras: int, seed: int) -> list[str]:
    """Render the built-in recording, track it from its videos, compare, and say all of it.

    Args:
        out: folder of the recording; results go into `sylpose` in it.

    Returns:
        sentences that say what went wrong; none when the motion was found in all frames to `MAX_ERROR_DEG`.

    Raises:
        ValueError, OSError: as `render_demo` and `track_session`.
    """
    console = console_output.make_console()
    rendering = f"Rendering {frames} frames of {n_cameras} cameras ..."
    if not console.is_terminal:  # which shows it while it lasts
        console.print(rendering)
    with console.status(rendering):
        truth = render_demo(out, frames=frames, turn_deg=turn_deg, n_cameras=n_cameras, seed=seed)
    session = open_session(out)
    run = track_aloud(session, None, seed=seed)
    if nothing := why_nothing(session, run):
        return nothing
    center = truth.world_from_object[0].translation
    result = score(*read_tum(run.files[0]), *read_tum(out / "groundtruth.tum"), center=center)
    console.print()
    _print_score(console, result, run.trajectory.unit)
    if result.missing or result.rotation.max() > MAX_ERROR_DEG:
        return [f"the demo did not come out right: {result.missing} frames missing, errors above"]
    return []


def _print_score(console: Console, result: Score, unit: str) -> None:
    """The errors at the end and at their worst."""
    found = result.total - result.missing
    console.print(Text.assemble(("Against the truth", "bold"), f", motion since the first of {found} frames"))
    rows = [
        ["turn", *(f"{value:.2f}°" for value in (result.rotation[-1], result.rotation.max()))],
        [
            "position",
            *(console_output.length(value, unit) for value in (result.displacement[-1], result.displacement.max())),
        ],
    ]
    console_output.print_table(console, ("Error", "at the end", "worst"), rows)


def score(
    times: ArrayLike,
    world_from_object: RigidTransform,
    true_times: ArrayLike,
    true_world_from_object: RigidTransform,
    center: ArrayLike,
) -> Score:
    """Compare a trajectory with the truth; the two object frames may differ by any fixed transform.

    What is compared is M_k = T_k T_0^-1, which takes world points on the object from the first paired pose to pose k.

    Args:
        times: (m,) and their m poses; paired with the truth's by the nearest time, within half its smallest step.
        true_times: (n,) at least two, increasing, and their n poses.
        center: (3,) the object's centre in the world at the first true pose.

    Raises:
        ValueError: no poses, fewer than two true ones, or no two poses that can be paired.
    """
    times, true_times = np.asarray(times, dtype=float), np.asarray(true_times, dtype=float)
    if len(true_times) < 2 or not len(times):
        raise ValueError(f"to score takes two true poses and an estimate, got {len(true_times)} and {len(times)}")
    ours, theirs = pairs_in_time(times, true_times)
    if len(ours) < 2:
        raise ValueError(f"only {len(ours)} of {len(true_times)} true poses have an estimate at their time")
    estimate, truth = world_from_object[ours], true_world_from_object[theirs]
    motion, true_motion = estimate * estimate[0].inv(), truth * truth[0].inv()
    start = (truth[0] * true_world_from_object[0].inv()).apply(center)
    rotation = np.degrees((true_motion.rotation.inv() * motion.rotation).magnitude())
    displacement = np.linalg.norm(motion.apply(start) - true_motion.apply(start), axis=1)
    return Score(len(true_times), rotation[1:], displacement[1:])


def render_demo(out: Path, *, frames: int, turn_deg: float, n_cameras: int, seed: int) -> DemoTruth:
    """Write the built-in recording into a folder that is new, empty or an earlier demo's.

    Raises:
        ValueError: fewer than two frames, or a folder with something else in it.
        OSError: naming the folder or file that cannot be written.
    """
    if frames < 2:
        raise ValueError(f"the demo needs at least 2 frames, got {frames}")
    number(turn_deg, "--turn")
    if seed < 0:
        raise ValueError(f"--seed must not be negative, got {seed}")
    output_folder(out)
    if any(out.iterdir()) and not (out / MARK).exists():
        raise ValueError(f"{out}: is not empty and no earlier demo's; the demo would replace files in it")
    with writing(out):
        with replacing(out / MARK) as part:
            part.write_text("Written by `sylpose demo`, which replaces it without asking.\n")
        for old in out.glob("cam_*.mp4"):  # an earlier demo may have had more cameras
            old.unlink()
        return render_sequence(out, frames=frames, turn_deg=turn_deg, n_cameras=n_cameras, seed=seed)
