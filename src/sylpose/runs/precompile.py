"""Compilation of the tracking kernels after an installation or an update, by parallel processes.

    python -m sylpose.runs.precompile [PART ...]

compiles all kernels, or the given parts sequentially, and prints the names of the functions that it compiled. Compiled
kernels are cached next to the sources, or in another writable folder (`geometry/kernel_cache.py`), from where later
processes load them.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from filelock import FileLock
from numba.core.event import Event, Listener, install_listener
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.absolute_pose.pose import estimate_pose
from sylpose.bundle_adjustment.bundle import BundleOptions, Observations, bundle_adjust
from sylpose.features import klt, static_background
from sylpose.features.patches import find_unmoved, sample_patches
from sylpose.features.sift import FULL_RESOLUTION, Features, match_guided
from sylpose.geometry.kernel_cache import (
    cache_folder,
    describe_compilation,
    is_cached,
    mark_announced,
)
from sylpose.geometry.matrices import invert_information
from sylpose.input_limits import print_message
from sylpose.landmarks.alignment import LandmarkMatches, align, make_camera_state, stack_matches
from sylpose.landmarks.camera_terms import compute_camera_terms
from sylpose.landmarks.landmark_filter import add_observations, initialize_landmarks
from sylpose.relative_pose import uncertainty
from sylpose.relative_pose.affine_ransac import QUADRUPLES, find_inliers
from sylpose.relative_pose.solver import warm_up, warm_up_evidence
from sylpose.runs.console_output import make_console
from sylpose.runs.progress import SECONDS_BETWEEN_LINES
from sylpose.runs.system_resources import available_cores
from sylpose.simulate import ring


def compile_klt() -> None:
    """Compile what is done with images: KLT tracking, and the comparison of patches."""
    image = np.random.default_rng(0).integers(0, 255, (120, 160), np.uint8)
    pixels = np.array([[60.0, 60.0], [80.0, 50.0]])
    klt.track_features(klt.start_tracks(image, pixels), image, image)
    patches = sample_patches(image, pixels, FULL_RESOLUTION, np.zeros(2))
    find_unmoved(patches, pixels, patches, pixels)
    static_background.detect_corners(image)


def compile_landmarks() -> None:
    """Compile the alignment of landmarks, their update, and the search for matches that move alike."""
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
    stacked = stack_matches(observations[:1])
    compute_camera_terms(stacked, 0, np.eye(3), np.zeros(3), 1.0, True, make_camera_state(stacked), np.empty((6, 7)))
    find_inliers(observations[0].image, observations[0].image, 0.01, QUADRUPLES, np.empty(len(points)))
    invert_information(np.eye(6))
    camera, n = rig["cam_0"], len(points)
    pixels = camera.project(points)
    features = Features(pixels, camera.normalize(pixels), np.zeros((n, 128), np.float32))
    match_guided(features, features, np.stack([pixels, pixels], axis=1), 1.0)
    known = initialize_landmarks(features, camera, RigidTransform.identity(), np.ones(n), np.full(n, 0.1))
    known = add_observations(known, features, camera, RigidTransform.identity())
    known.depth_error  # noqa: B018 computing the property compiles it


def compile_absolute_pose() -> None:
    """Compile the pose of a known object, as in relocalization, also where cameras contradict each other."""
    rig, points = ring(2, height=(0.4, -0.1)), np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
    rotated = Rotation.from_rotvec([0.0, 0.0, 0.4]).apply(points)
    estimate_pose(rig, [points] * 2, [camera.project(x) for camera, x in zip(rig, (points, rotated), strict=True)])


def compile_bundle_adjustment() -> None:
    """Compile the bundle adjustment of all poses."""
    rig, points = ring(3, height=(0.4, -0.1, 0.2)), np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
    rotations = [Rotation.from_rotvec(0.02 * k * np.array([0.05, -0.03, 0.08])) for k in range(4)]
    images = np.array([[c.normalize(c.project(turn.apply(points))) for c in rig] for turn in rotations])
    frame, camera, landmark = (index.ravel() for index in np.indices(images.shape[:3]))
    poses = RigidTransform.from_components(np.zeros((len(rotations), 3)), Rotation.concatenate(rotations))
    observations = Observations(frame, camera, landmark + len(points) * camera, images.reshape(-1, 2))
    bundle_adjust(rig, observations, poses, 0.1, BundleOptions(offsets_sd=0.1))


def compile_tracking() -> None:
    """Compile what tracking needs besides the fit of a motion."""
    warm_up_evidence()
    compile_landmarks()
    compile_absolute_pose()
    compile_bundle_adjustment()
    compile_klt()


class Part(NamedTuple):
    """A part of the kernels.

    Attributes:
        compile: compiles it in this process.
        last: the kernel that it compiles last.
    """

    compile: Callable[[], None]
    last: object


# Longest first: about three fifths and two fifths of the time. More parts would take longer together: what several of them
# call is compiled in each (measured: docs/history/benchmarks.md, "The first start").
PARTS = {
    "solver": Part(warm_up, uncertainty.minimize_across_valley),
    "tracking": Part(compile_tracking, static_background.fill_patches),
}
# Number of functions compiled by all parts, those of both counted twice (measured: Numba 0.68; one process compiles fewer,
# and its progress ends early).
N_FUNCTIONS = 556
# Largest progress before all is compiled (choice).
MAX_PROGRESS = 0.99


def is_compiled() -> bool:
    """Return whether the last kernel of each part is cached for the current sources and this processor.

    Other kernels that are missing are compiled when they are called.
    """
    return all(is_cached(part.last) for part in PARTS.values())


def find_kernel_cache() -> Path | None:
    """Return the cache folder of the compiled kernels, or None if no folder can be written."""
    return cache_folder(uncertainty.minimize_across_valley)


def compile_all(on_progress: Callable[[float], None] | None = None) -> None:
    """Compile the tracking kernels with one process per part, or load them if they are cached.

    Without a cache folder, processes cannot share their results, and everything is compiled in this process.

    Args:
        on_progress: called after each compiled function, also in other threads, with the share of those that are compiled,
            in [0, 1].
    """
    if is_compiled():
        warm_up()
        return
    n_compiled, lock = 0, threading.Lock()

    def count(_: str) -> None:
        nonlocal n_compiled
        with lock:
            n_compiled += 1
            if on_progress is not None:
                on_progress(min(n_compiled / N_FUNCTIONS, MAX_PROGRESS))

    with install_listener("numba:compile", _CompilationListener(count)):
        # With a single core, one process avoids that anything is imported or compiled twice.
        is_parallel = available_cores() > 1 and find_kernel_cache() is not None
        run = partial(_compile_in_subprocess, on_compiled=count) if is_parallel else compile_part
        with ThreadPoolExecutor(min(available_cores(), len(PARTS)) if is_parallel else 1) as pool:
            for done in as_completed([pool.submit(run, part) for part in PARTS]):
                done.result()
        warm_up()
    if on_progress is not None:
        on_progress(1.0)


class _CompilationListener(Listener):
    """Listener of Numba that passes on the name of each function that was compiled."""

    def __init__(self, on_compiled: Callable[[str], None]) -> None:
        self._on_compiled = on_compiled

    def on_start(self, event: Event) -> None:
        pass

    def on_end(self, event: Event) -> None:
        self._on_compiled(event.data["dispatcher"].py_func.__qualname__)


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
        task, last_line = progress.add_task("", total=1.0), time.monotonic()

        def show(done: float) -> None:
            nonlocal last_line
            progress.update(task, completed=done)
            now = time.monotonic()
            if progress.disable and not console.quiet and now - last_line >= SECONDS_BETWEEN_LINES:
                last_line = now
                print_message(f"compiled {done:.0%}")

        compile_all(show)


def compile_part(part: str) -> None:
    """Compile a part in this process."""
    PARTS[part].compile()


def _compile_in_subprocess(part: str, on_compiled: Callable[[str], None]) -> None:
    """Compile a part in another process; failures are ignored, as the kernels are compiled again when called."""
    command = [sys.executable, "-W", "ignore", "-m", "sylpose.runs.precompile", part]
    streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, text=True, **streams) as process:
        for line in process.stdout or ():
            on_compiled(line.strip())


def main(parts: Sequence[str]) -> None:
    """Compile the given parts and print the names of compiled functions, or compile all parts with a progress bar."""
    with install_listener("numba:compile", _CompilationListener(partial(print, flush=True))):
        for part in parts:
            compile_part(part)
    if not parts:
        compile_with_progress(make_console())


if __name__ == "__main__":
    main(sys.argv[1:])
