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
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

import numpy as np
from filelock import FileLock
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.bundle import BundleOptions, Observations, bundle_adjust
from sylpose.features import klt, static_background
from sylpose.features.sift import Features
from sylpose.geometry.kernel_cache import (
    cache_folder,
    describe_compilation,
    display_folder,
    is_cached,
    mark_announced,
)
from sylpose.geometry.matrices import invert_information
from sylpose.input_limits import print_message
from sylpose.landmarks.alignment import LandmarkMatches, align
from sylpose.landmarks.landmark_filter import add_observations, initialize_landmarks
from sylpose.relative_pose import robust_fit
from sylpose.relative_pose.solver import warm_up, warm_up_diagnostics, warm_up_evidence, warm_up_irls, warm_up_search
from sylpose.runs.console_output import make_console
from sylpose.runs.progress import SECONDS_BETWEEN_LINES
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
    "evidence": (23.0, warm_up_evidence),
    "landmarks": (18.0, compile_landmarks),
    "reweighting": (16.0, warm_up_irls),
    "verdicts": (16.0, warm_up_diagnostics),
    "refining": (12.0, compile_bundle_adjustment),
    "following": (2.0, compile_klt),
}
# Machine code of all kernels in the cache, bytes: it grows in proportion to the time, within a tenth (measured: x86-64,
# two cores). On another processor the last step of the progress is longer or shorter.
CODE_BYTES = 28.4e6
# Seconds between two looks at the cache, and largest progress before all is compiled (choice).
WATCH_SECONDS, MAX_PROGRESS = 0.5, 0.99


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
        on_progress: called twice a second, in another thread, with the share of the machine code that is in the cache,
            in [0, 1]; not without a cache folder.
    """
    folder = find_kernel_cache()
    if folder is None or is_compiled():
        warm_up()
        return
    with _watch_cache(folder, on_progress or (lambda _: None)):
        # With a single core, one process avoids repeated imports.
        run = _compile_in_subprocess if available_cores() > 1 else (lambda part: PARTS[part][1]())
        with ThreadPoolExecutor(min(available_cores(), len(PARTS))) as pool:
            for done in as_completed([pool.submit(run, part) for part in PARTS]):
                done.result()
        warm_up()  # the remaining kernel, the complete fit, needs all others


@contextmanager
def _watch_cache(folder: Path, on_progress: Callable[[float], None]) -> Iterator[None]:
    """Report how much machine code is new in the cache of all kernels.

    Args:
        folder: cache folder of one kernel.
        on_progress: called with the share of `CODE_BYTES`.
    """
    root, pattern = display_folder(folder), "**/__pycache__/*.nbc" if folder.name == "__pycache__" else "*/*.nbc"

    def look() -> dict[Path, tuple[int, int]]:
        found = dict[Path, tuple[int, int]]()
        with suppress(OSError):  # a file that another process replaces
            for file in root.glob(pattern):
                state = file.stat()
                found[file] = state.st_mtime_ns, state.st_size
        return found

    def watch() -> None:
        done = 0.0
        while not is_ended.wait(WATCH_SECONDS):
            new = sum(size for file, (time_ns, size) in look().items() if before.get(file) != (time_ns, size))
            done = max(done, min(new / CODE_BYTES, MAX_PROGRESS))
            on_progress(done)

    before, is_ended = look(), threading.Event()
    thread = threading.Thread(target=watch, name="sylpose-compiling", daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_ended.set()
        thread.join()
    on_progress(1.0)


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
    if not is_announced:  # a kernel that was needed earlier has announced it
        console.print(f"Compiling for one to two minutes {describe_compilation(folder)}.", soft_wrap=True)
    columns = (TextColumn("Compiling"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    remaining = TimeRemainingColumn(compact=True)
    with Progress(*columns, remaining, console=console, transient=True, disable=not console.is_terminal) as progress:
        task, last_line = progress.add_task("", total=None if folder is None else 1.0), time.monotonic()

        def show(done: float) -> None:
            nonlocal last_line
            progress.update(task, completed=done)
            now = time.monotonic()
            if progress.disable and not console.quiet and now - last_line >= SECONDS_BETWEEN_LINES:
                last_line = now
                print_message(f"compiled {done:.0%}")

        compile_all(show)


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
