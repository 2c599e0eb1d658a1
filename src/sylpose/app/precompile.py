"""What tracking compiles after an installation or an update, by processes beside each other.

    python -m sylpose.app.precompile [PART ...]

compiles all of it, or some parts one after another. What is compiled is kept beside the sources, or where else it can be
(`geometry/cache_folders.py`): every later process loads it.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.app.console_output import make_console
from sylpose.app.system_resources import cores
from sylpose.bundle_adjustment.bundle import Observations, bundle
from sylpose.features import klt, static_background
from sylpose.features.sift import Features
from sylpose.geometry.cache_folders import CHOSEN, place_of
from sylpose.geometry.kernel_cache import announced, folder_of, is_kept
from sylpose.geometry.matrices import covariance_of
from sylpose.landmarks.alignment import Sights, align
from sylpose.landmarks.landmark_filter import new_landmarks, seen_again
from sylpose.relative_pose import robust_fit
from sylpose.relative_pose.precompile import warm_up, warm_up_reweighting, warm_up_search, warm_up_verdicts
from sylpose.simulate import ring

__all__ = ["PARTS", "TOTAL", "compile_all", "compile_aloud", "is_compiled", "kept_in"]


def following() -> None:
    """Features from image to image."""
    image = np.random.default_rng(0).integers(0, 255, (120, 160), np.uint8)
    klt.advance(klt.begin(image, [[60.0, 60.0], [80.0, 50.0]]), image, image)
    static_background.begin(image)


def landmarks() -> None:
    """A frame's pose by landmarks."""
    rig, points = ring(3, height=(0.4, -0.1, 0.2)), np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
    sights = [
        Sights(
            points=points,
            depth_error=0.01 * (points - camera.center),
            image=camera.normalize(camera.project(points)),
            feature=np.arange(len(points)),
            trust=np.ones(len(points)),
            rotation=camera.rotation,
            center=camera.center,
            focal=camera.focal,
        )
        for camera in rig
    ]
    align(sights, np.eye(3), np.zeros(3))
    covariance_of(np.eye(6))
    camera, n = rig["cam_0"], len(points)
    pixels = camera.project(points)
    features = Features(pixels, camera.normalize(pixels), np.zeros((n, 128), np.float32))
    known = new_landmarks(features, camera, RigidTransform.identity(), np.ones(n), np.full(n, 0.1))
    known = seen_again(known, features, camera, RigidTransform.identity())
    known.depth_error  # noqa: B018 a property, which is computed


def refining() -> None:
    """All poses together."""
    rig, points = ring(3, height=(0.4, -0.1, 0.2)), np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
    turns = [Rotation.from_rotvec(0.02 * k * np.array([0.05, -0.03, 0.08])) for k in range(4)]
    images = np.array([[c.normalize(c.project(turn.apply(points))) for c in rig] for turn in turns])
    frame, camera, landmark = (index.ravel() for index in np.indices(images.shape[:3]))
    poses = RigidTransform.from_components(np.zeros((len(turns), 3)), Rotation.concatenate(turns))
    seen = Observations(frame, camera, landmark + len(points) * camera, images.reshape(-1, 2))
    bundle(rig, seen, poses, 0.1, offsets_sd=0.1)


# Their processor seconds (measured: docs/benchmarks.md, "The first start"), the longest first: together they take as long as
# that one, where there are cores enough.
PARTS: dict[str, tuple[float, Callable[[], None]]] = {
    "search": (33.0, warm_up_search),
    "landmarks": (18.0, landmarks),
    "reweighting": (16.0, warm_up_reweighting),
    "verdicts": (16.0, warm_up_verdicts),
    "refining": (12.0, refining),
    "following": (2.0, following),
}
# What is left then, the fit as a whole, by this process.
REST = 10.0
TOTAL = REST + sum(seconds for seconds, _ in PARTS.values())


def is_compiled() -> bool:
    """Whether that has been done: what is compiled last is there, of its present sources and for this processor. What is
    missing all the same is compiled when it is called."""
    return is_kept(robust_fit.robust_fit)


def kept_in() -> Path | None:
    """The folder that the fit as a whole is kept in; None where no folder can be written."""
    return folder_of(robust_fit.robust_fit)


def compile_all(watch: Callable[[float], None] | None = None) -> None:
    """Compiles what tracking needs, by as many processes as there are cores, or loads it where that has been done.

    Where nothing can be kept, processes would not help each other: then what is called is compiled here.

    Args:
        watch: told how many seconds of `TOTAL` one part more has been, as parts end.
    """
    watch = watch or (lambda _: None)
    if kept_in() is not None and not is_compiled():
        # One core does it in one process, which imports once.
        run = _compiled_elsewhere if cores() > 1 else (lambda part: PARTS[part][1]())
        with ThreadPoolExecutor(min(cores(), len(PARTS))) as pool:
            of = {pool.submit(run, part): seconds for part, (seconds, _) in PARTS.items()}
            for done in as_completed(of):
                done.result()
                watch(of[done])
    warm_up()
    watch(REST)


def compile_aloud(console: Console) -> None:
    """`compile_all`, and a line that says so where that has not been done or said, with its progress below on a terminal."""
    said = announced()
    if is_compiled():
        with console.status("Loading ..."):
            compile_all()
        return
    folder = kept_in()
    often, where = "after an installation or an update", f"kept in {folder and place_of(folder)}"
    if folder is None:
        often, where = "at every start", f"no folder can be written to keep it in, {CHOSEN}=FOLDER names one"
    if not said:  # by a kernel that was needed before
        console.print(f"Compiling for one to two minutes, {often}; {where}.", soft_wrap=True)
    columns = (TextColumn("Compiling"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=None if folder is None else TOTAL)
        compile_all(lambda seconds: progress.advance(task, seconds))


def _compiled_elsewhere(part: str) -> None:
    """A process that fails has not helped."""
    command = [sys.executable, "-W", "ignore", "-m", "sylpose.app.precompile", part]
    subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)


def main(parts: Sequence[str]) -> None:
    """Compiles some parts, or all and says so."""
    for part in parts:
        PARTS[part][1]()
    if not parts:
        compile_aloud(make_console())


if __name__ == "__main__":
    main(sys.argv[1:])
