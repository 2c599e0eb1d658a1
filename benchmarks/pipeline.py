"""Processor time of `track_session` per frame set, by stage, compared with bare decoding and Lucas-Kanade tracking.

    python benchmarks/pipeline.py [--size 640x480] [--cameras 4] [--frames 60:180] [--turn 1.0] [--functions 0]

Renders the demo scene and tracks it with the defaults, with overlay and report. The *bare loop* decodes the same videos by
the same reader, converts to gray and calls `calcOpticalFlowPyrLK` with OpenCV's defaults for 170 corners per camera.

A recording of each of the two lengths of `--frames` is tracked. The cost of a frame set is the difference of their processor
times per frame set; *start and end* is the rest: opening, initialization, final plots and files. Kernels are loaded before.

All threads are sampled; the processor time of a thread since its last sample belongs to the stage of the innermost function
that the table of stages contains. *Native threads* are those of encoders and decoders, which have no Python frames. Further
runs leave outputs out. With `--functions N`, the N most expensive functions (inclusive) are printed.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
from collections import defaultdict
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import cv2

import sylpose
from sylpose import Session, open_session, track_session
from sylpose.geometry.arrays import Image
from sylpose.runs.options import RunOptions
from sylpose.simulate import make_demo_scene, write_sequence

__all__ = ["STAGES", "Costs", "find_stage"]

SOURCE = str(Path(sylpose.__file__).parent)
# Points per camera of the bare loop, as many as the tracker has.
N_POINTS = 170
# Seconds between samples: a stage of 1 ms per frame set has some 20 samples in 120 frame sets.
SAMPLE_SECONDS = 0.005
# Modules of each stage, and functions (module:function) that differ from their module; the first that fits counts.
STAGES = {
    "reading and decoding": ("io.capture",),
    "gray conversion and KLT": ("features.klt",),
    "SIFT": ("features.sift",),
    "camera motion, background": ("features.static_background", "tracking.camera_side.camera_motion"),
    "window refinement": ("tracking.window",),
    "next anchor": ("tracking.anchor_preparation",),
    "learning": ("tracking.map_update", "landmarks.landmark_filter"),
    "pose": ("tracking.frame_solvers", "tracking.pose_search", "landmarks.alignment", "landmarks.joint_step"),
    "camera's matches": ("tracking.camera_side",),
    "first frames": ("tracking.initialization", "tracking.first_motion", "tracking.bodies", "runs.candidates"),
    "other tracking": ("tracking",),
    "smoothing": ("smoothing",),
    "thumbnails": ("runs.page:ThumbnailAlbum",),
    "overlay": ("report.overlay",),
    "report": ("report.plots", "report.page", "runs.page"),
    "files": ("runs.outputs", "report.files"),
    "other of the run": ("runs",),
}
OTHER, NATIVE, IDLE = "other", "native threads", "idle"

_cv2: Any = cv2


Seconds = defaultdict[str, float]
_ThreadId = tuple[int, int]


class Costs(NamedTuple):
    """Processor seconds of a block: in total, by stage and by function (inclusive)."""

    seconds: float
    stages: Seconds
    functions: Seconds


class _Sampler:
    """Thread that samples all other threads, each known by its identifiers in Python and in the operating system."""

    def __init__(self) -> None:
        self._is_finished = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._clocks = {thread: clock for thread, _, clock in _read_threads()}
        self._clocks[threading.get_ident(), threading.get_native_id()] = time.thread_time()
        self._own_seconds = 0.0
        self._stages: dict[_ThreadId, Seconds] = {}
        self._functions: dict[_ThreadId, Seconds] = {}
        self._start = time.process_time()
        self._thread.start()

    def _run(self) -> None:
        while not self._is_finished.wait(SAMPLE_SECONDS):
            for thread, frame, clock in _read_threads():
                self._add(thread, frame, clock - self._clocks.get(thread, 0.0))
                self._clocks[thread] = clock
        self._own_seconds = time.thread_time()

    def _add(self, thread: _ThreadId, frame: FrameType | None, seconds: float) -> None:
        stage, functions = None, set[str]()
        while frame is not None:
            if (path := frame.f_code.co_filename).startswith(SOURCE):
                module = path.removeprefix(SOURCE)[1:-3].replace("/", ".")
                function = getattr(frame.f_code, "co_qualname", frame.f_code.co_name)
                stage = stage or find_stage(module, function)
                functions.add(f"{module}:{function}")
            frame = frame.f_back
        # What a worker did before it was sampled while it waits is divided as its other samples.
        self._stages.setdefault(thread, defaultdict(float))[(stage or OTHER) if functions else IDLE] += seconds
        own = self._functions.setdefault(thread, defaultdict(float))
        for name in functions:
            own[name] += seconds

    def finish(self) -> Costs:
        """Stop and return the costs."""
        self._is_finished.set()
        self._thread.join()
        seconds = time.process_time() - self._start - self._own_seconds
        costs = Costs(seconds, defaultdict(float), defaultdict(float))
        for thread, seen in self._stages.items():
            total, known = sum(seen.values()), sum(seen.values()) - seen.pop(IDLE, 0.0)
            if not known:
                costs.stages[OTHER] += total
                continue
            for stage, seconds in seen.items():
                costs.stages[stage] += seconds * total / known
            for name, seconds in self._functions[thread].items():
                costs.functions[name] += seconds * total / known
        costs.stages[NATIVE] = costs.seconds - sum(costs.stages.values())
        return costs


def _read_threads() -> list[tuple[_ThreadId, FrameType, float]]:
    """Return the identifiers, frame and processor seconds of each thread but this one."""
    found, natives = [], {thread.ident: thread.native_id for thread in threading.enumerate()}
    for ident, frame in sys._current_frames().items():
        native = natives.get(ident)
        if native is not None and native != threading.get_native_id():
            with suppress(OSError):  # it has ended
                found.append(((ident, native), frame, time.clock_gettime(time.pthread_getcpuclockid(ident))))
    return found


@cache
def find_stage(module: str, function: str) -> str | None:
    """Return the stage of a function of the package, None if its callers decide."""
    for stage, places in STAGES.items():
        for place in places:
            its_module, _, its_function = place.partition(":")
            is_in_module = module == its_module or module.startswith(f"{its_module}.")
            if is_in_module and its_function in ("", function.partition(".")[0], function):
                return stage
    return None


def track_frames(session: Session, frames: int, options: RunOptions) -> Costs:
    """Track the first frames of a session and return the costs."""
    with tempfile.TemporaryDirectory() as out:
        sampler = _Sampler()
        run = track_session(session, out, replace(options, stop=frames))
        costs = sampler.finish()
    if lost := int((~run.trajectory.measured_mask).sum()):
        print(f"{lost} of {frames} frames without a measured pose")
    return costs


def measure_bare_loop(session: Session, frames: int) -> float:
    """Return the processor seconds per frame set of decoding, conversion to gray and Lucas-Kanade tracking."""
    previous: list[Image] = []
    corners: list[Any] = []
    start = time.process_time()
    for frame_set in session.frames(0, frames):
        images = [image for image in frame_set.images if image is not None]
        gray = [_cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]
        for pair in zip(previous, gray, corners, strict=False):
            _cv2.calcOpticalFlowPyrLK(*pair, None)
        if not corners:
            corners, start = [_cv2.goodFeaturesToTrack(one, N_POINTS, 1e-3, 3) for one in gray], time.process_time()
        previous = gray
    return (time.process_time() - start) / (frames - 1)


def format_milliseconds(seconds: float, bare: float) -> str:
    """Format a cost per frame set in milliseconds and relative to the bare loop."""
    return f"{1e3 * seconds:.1f} | {seconds / bare:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--frames", default="60:180", help="lengths of the two recordings")
    parser.add_argument("--turn", type=float, default=1.0, help="degrees per frame")
    parser.add_argument("--functions", type=int, default=0)
    parser.add_argument("--defaults-only", action="store_true", help="omit the runs without outputs")
    options = parser.parse_args()
    short, long = map(int, options.frames.split(":"))
    width, height = map(int, options.size.split("x"))
    scene = make_demo_scene(frames=long, angle_deg=options.turn * long, size=(width, height), n_cameras=options.cameras)
    with tempfile.TemporaryDirectory() as folder:
        write_sequence(Path(folder), scene)
        session = open_session(Path(folder))
        track_frames(session, min(short, 30), RunOptions())  # loads or compiles kernels
        sys.setswitchinterval(1e-4)  # a thread that computes in Python lets the sampler run
        bare = measure_bare_loop(session, short)
        variants = {"defaults": RunOptions()}
        if not options.defaults_only:
            variants["no overlay"] = RunOptions(overlay=False)
            variants["no overlay, no smoothing"] = RunOptions(overlay=False, smooth=False)
        runs = {name: [track_frames(session, n, chosen) for n in (short, long)] for name, chosen in variants.items()}
    n_frames = long - short
    print("| run | ms per frame set | ratio to the bare loop | start and end, s |")
    print("|---|---|---|---|")
    print(f"| bare loop | {format_milliseconds(bare, bare)} | |")
    for name, (first, second) in runs.items():
        slope = (second.seconds - first.seconds) / n_frames
        print(f"| {name} | {format_milliseconds(slope, bare)} | {first.seconds - slope * short:.1f} |")
    first, second = runs["defaults"]
    print("\n| stage, defaults | ms per frame set | ratio to the bare loop | start and end, s |")
    print("|---|---|---|---|")
    slopes = {stage: (second.stages[stage] - first.stages[stage]) / n_frames for stage in second.stages}
    for stage, slope in sorted(slopes.items(), key=lambda item: -item[1]):
        print(f"| {stage} | {format_milliseconds(slope, bare)} | {first.stages[stage] - slope * short:.1f} |")
    functions = {name: second.functions[name] - first.functions[name] for name in second.functions}
    for name, seconds in sorted(functions.items(), key=lambda item: -item[1])[: options.functions]:
        print(f"{1e3 * seconds / n_frames:8.2f} ms  {name}")


if __name__ == "__main__":
    main()
