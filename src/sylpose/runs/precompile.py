"""Compilation of the tracking kernels after an installation or an update, by parallel processes.

    python -m sylpose.runs.precompile [PART ...]

compiles all kernels, or the given parts sequentially. Compiled kernels are cached next to the sources, or in another
writable folder (`geometry/kernel_cache.py`), from where later processes load them.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import cache
from pathlib import Path

import numpy as np
from filelock import FileLock
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.bundle import BundleOptions, Observations, bundle_adjust
from sylpose.features import klt, static_background
from sylpose.features.sift import Features
from sylpose.geometry.kernel_cache import CACHE_DIR_VARIABLE, cache_folder, display_folder, is_cached, mark_announced
from sylpose.geometry.matrices import invert_information
from sylpose.landmarks.alignment import LandmarkMatches, align
from sylpose.landmarks.landmark_filter import add_observations, initialize_landmarks
from sylpose.relative_pose import robust_fit
from sylpose.relative_pose.solver import warm_up, warm_up_diagnostics, warm_up_irls, warm_up_search
from sylpose.runs.console_output import make_console
from sylpose.runs.system_resources import available_cores
from sylpose.simulate import ring


def compile_klt() -> None:
    """Compile KLT tracking from image to image."""
    image = np.random.default_rng(0).integers(0, 255, (120, 160), np.uint8)
    klt.track_features(klt.start_tracks(image, [[60.0, 60.0], [80.0, 50.0]]), image, image)
    static_background.detect_corners(image)


def compile_landmarks() -> None:
    """Compile the alignment of landmarks and their update."""
    rig, points = ring(3, height=(0.4, -0.1, 0.2)), np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
    observations = [
        LandmarkMatches(
            points=points,
            depth_error=0.01 * (points - camera.center),
            image=camera.normalize(camera.project(points)),
            feature=np.arange(len(points)),
            prior_weight=np.ones(len(points)),
            rotation=camera.rotation,
            center=camera.center,
            focal=camera.focal,
        )
        for camera in rig
    ]
    align(observations, np.eye(3), np.zeros(3))
    invert_information(np.eye(6))
    camera, n = rig["cam_0"], len(points)
    pixels = camera.project(points)
    features = Features(pixels, camera.normalize(pixels), np.zeros((n, 128), np.float32))
    known = initialize_landmarks(features, camera, RigidTransform.identity(), np.ones(n), np.full(n, 0.1))
    known = add_observations(known, features, camera, RigidTransform.identity())
    known.depth_error  # noqa: B018 computing the property compiles it


def compile_bundle_adjustment() -> None:
    """Compile the bundle adjustment of all poses."""
    rig, points = ring(3, height=(0.4, -0.1, 0.2)), np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
    rotations = [Rotation.from_rotvec(0.02 * k * np.array([0.05, -0.03, 0.08])) for k in range(4)]
    images = np.array([[c.normalize(c.project(turn.apply(points))) for c in rig] for turn in rotations])
    frame, camera, landmark = (index.ravel() for index in np.indices(images.shape[:3]))
    poses = RigidTransform.from_components(np.zeros((len(rotations), 3)), Rotation.concatenate(rotations))
    observations = Observations(frame, camera, landmark + len(points) * camera, images.reshape(-1, 2))
    bundle_adjust(rig, observations, poses, 0.1, BundleOptions(offsets_sd=0.1))


# Processor seconds of each part (measured: docs/history/benchmarks.md, "The first start"), longest first: with enough cores
# the total time is that of the longest.
PARTS: dict[str, tuple[float, Callable[[], None]]] = {
    "search": (33.0, warm_up_search),
    "landmarks": (18.0, compile_landmarks),
    "reweighting": (16.0, warm_up_irls),
    "verdicts": (16.0, warm_up_diagnostics),
    "refining": (12.0, compile_bundle_adjustment),
    "following": (2.0, compile_klt),
}
# Processor seconds of the remaining kernel, the complete fit, which this process compiles last.
REST_SECONDS = 10.0
TOTAL_SECONDS = REST_SECONDS + sum(seconds for seconds, _ in PARTS.values())


def is_compiled() -> bool:
    """Return whether the kernel that is compiled last is cached for the current sources and this processor.

    Other kernels that are missing are compiled when they are called.
    """
    return is_cached(robust_fit.fit_robust_motion)


def find_kernel_cache() -> Path | None:
    """Return the cache folder of the compiled kernels, or None if no folder can be written."""
    return cache_folder(robust_fit.fit_robust_motion)


def compile_all(on_progress: Callable[[float], None] | None = None) -> None:
    """Compile the tracking kernels with one process per core, or load them if they are cached.

    Without a cache folder, processes cannot share their results, and everything is compiled in this process.

    Args:
        on_progress: called after each part with its seconds, which add up to `TOTAL_SECONDS`.
    """
    on_progress = on_progress or (lambda _: None)
    if find_kernel_cache() is not None and not is_compiled():
        # With a single core, one process avoids repeated imports.
        run = _compile_in_subprocess if available_cores() > 1 else (lambda part: PARTS[part][1]())
        with ThreadPoolExecutor(min(available_cores(), len(PARTS))) as pool:
            seconds_by_future = {pool.submit(run, part): seconds for part, (seconds, _) in PARTS.items()}
            for done in as_completed(seconds_by_future):
                done.result()
                on_progress(seconds_by_future[done])
    warm_up()
    on_progress(REST_SECONDS)


@cache
def compile_once_per_computer() -> None:
    """Compile all kernels unless they are cached; other processes of the user wait for the first."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    with FileLock(Path(tempfile.gettempdir()) / f"sylpose-compiling-{user}.lock"):
        if not is_compiled():
            compile_all()


def compile_with_progress(console: Console) -> None:
    """Run `compile_all` with a message and, on a terminal, a progress bar; no message if the kernels are cached."""
    is_announced = mark_announced()
    if is_compiled():
        with console.status("Loading ..."):
            compile_all()
        return
    folder = find_kernel_cache()
    occasion, location = "after an installation or an update", f"cached in {folder and display_folder(folder)}"
    if folder is None:
        occasion, location = "at every start", f"no cache folder is writable, set one with {CACHE_DIR_VARIABLE}=FOLDER"
    if not is_announced:  # a kernel that was needed earlier has announced it
        console.print(f"Compiling for one to two minutes, {occasion}; {location}.", soft_wrap=True)
    columns = (TextColumn("Compiling"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=None if folder is None else TOTAL_SECONDS)
        compile_all(lambda seconds: progress.advance(task, seconds))


def _compile_in_subprocess(part: str) -> None:
    """Compile a part in another process; failures are ignored, as the kernels are compiled again when called."""
    command = [sys.executable, "-W", "ignore", "-m", "sylpose.runs.precompile", part]
    subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)


def main(parts: Sequence[str]) -> None:
    """Compile the given parts, or all of them with a progress bar."""
    for part in parts:
        PARTS[part][1]()
    if not parts:
        compile_with_progress(make_console())


if __name__ == "__main__":
    main(sys.argv[1:])
