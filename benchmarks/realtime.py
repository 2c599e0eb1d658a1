"""How fast are frame sets tracked, beside OpenCV's bare followers and detector on the same images?

    python benchmarks/realtime.py [--cameras 4] [--size 640x480] [--frames 240] [--turn 1.0] [--features klt] [--jobs 0]

Renders a body that turns by so many degrees a frame, tracks it image by image as a live session does, and after each frame
set lets OpenCV alone do its part on the same images, by as many threads: `calcOpticalFlowPyrLK` with its own defaults
(21 x 21, three levels) of as many points as the tracker had, in images that it makes grey, or SIFT with its defaults.
Prints frame sets per second, the median and the 99th percentile of a frame set's time, once the first twelve are over (they
are refined together at every step), and both as ratios to the bare ones; by the wall and by the processor's clock. With
`--rate` frame sets come at that rate, as from cameras, and a frame set's time is until its pose is there since it came,
waiting for the ones before included. With `--jobs`, so many processes that do nothing but compute run beside it.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, NamedTuple

import cv2
import numpy as np

from sylpose import FrameSet
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.simulate import demo_scene, demo_truth, render_frames
from sylpose.tracking.tracker import Tracker

# Frame sets at the start that are not counted.
FIRST = 12
POINTS = 170

_cv2: Any = cv2


class Times(NamedTuple):
    """Milliseconds of each frame set, (n,): until its pose is there since it came; by the wall and by the processor's clock,
    of the tracker and of OpenCV alone; degrees (n,) that each pose is off, NaN without one."""

    latency: FloatArray
    wall: FloatArray
    processor: FloatArray
    bare_wall: FloatArray
    bare_processor: FloatArray
    degrees: FloatArray


def busy() -> None:
    """A job that computes."""
    while True:
        np.linalg.svd(np.random.default_rng(0).standard_normal((60, 60)))


@contextmanager
def jobs(count: int) -> Iterator[None]:
    """So many other jobs run meanwhile."""
    running = [multiprocessing.Process(target=busy, daemon=True) for _ in range(count)]
    for job in running:
        job.start()
    try:
        yield
    finally:
        for job in running:
            job.terminate()


def bare_following(before: Image, now: Image, points: FloatArray) -> Image:
    """OpenCV's followers alone; the image, grey."""
    grey: Image = _cv2.cvtColor(now, cv2.COLOR_BGR2GRAY)
    if len(points):
        _cv2.calcOpticalFlowPyrLK(before, grey, points.astype(np.float32), None)
    return grey


def bare_detection(now: Image) -> None:
    """OpenCV's SIFT alone, of the whole image."""
    _cv2.SIFT_create().detectAndCompute(_cv2.cvtColor(now, cv2.COLOR_BGR2GRAY), None)


def measured(
    cameras: int, size: tuple[int, int], frames: int, turn: float, features: str, seed: int, rate: float
) -> Times:
    """A rendered body, tracked; see the module."""
    scene = demo_scene(frames=frames, turn_deg=turn * frames, size=size, n_cameras=cameras, seed=seed)
    truth, nothing = demo_truth(scene), (None,) * cameras
    boxes = {name: Box(*box) for name, box in truth.boxes.items()}
    out: list[tuple[float, ...]] = []
    greys: list[Image] = []
    with (
        ThreadPoolExecutor(min(cameras, os.cpu_count() or 1)) as pool,
        Tracker(scene.rig, boxes, features=features) as tracker,
    ):
        every = list(render_frames(scene))
        came = time.perf_counter()
        for k, images in enumerate(every):
            # Those at the start, which are not counted, do not make others wait.
            came = max(came + 1.0 / rate, time.perf_counter() if k < FIRST else 0.0) if rate else time.perf_counter()
            time.sleep(max(came - time.perf_counter(), 0.0))
            wall, processor = time.perf_counter(), time.process_time()
            decided = tracker.step(FrameSet(k, k / 30.0, nothing, images, nothing))
            latency, wall = time.perf_counter() - came, time.perf_counter() - wall
            processor = time.process_time() - processor
            points = [
                np.empty((0, 2)) if not decided or m is None else m[0][:POINTS]
                for m in (decided[-1].matches if decided else nothing)
            ]
            bare, bare_processor = time.perf_counter(), time.process_time()
            if features == "sift":
                list(pool.map(bare_detection, images))
            elif greys:
                greys = list(pool.map(bare_following, greys, images, points))
            else:
                greys = [_cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]
            bare, bare_processor = time.perf_counter() - bare, time.process_time() - bare_processor
            came += bare  # the cameras wait for that
            pose = decided[-1].pose.world_from_object if decided else None
            off = np.nan if pose is None else (truth.world_from_object[k].inv() * pose).rotation.magnitude()
            out.append(
                (1e3 * latency, 1e3 * wall, 1e3 * processor, 1e3 * bare, 1e3 * bare_processor, float(np.degrees(off)))
            )
    return Times(*np.array(out[FIRST:]).T)


def line(times: Times) -> str:
    """What is printed."""
    rate, bare_rate = 1e3 / times.wall.mean(), 1e3 / times.bare_wall.mean()
    ratios = times.wall.mean() / times.bare_wall.mean(), times.processor.mean() / times.bare_processor.mean()
    usual = np.median(times.processor) / np.median(times.bare_processor)
    return (
        f"{rate:.1f} frame sets per second (bare {bare_rate:.0f}), median {np.median(times.latency):.0f} ms, "
        f"99 % {np.quantile(times.latency, 0.99):.0f} ms (bare {np.quantile(times.bare_wall, 0.99):.0f}); processor "
        f"{times.processor.mean():.0f} ms (bare {times.bare_processor.mean():.0f}); ratios: wall {ratios[0]:.1f}, "
        f"processor {ratios[1]:.1f}, of medians {usual:.1f}; {np.isnan(times.degrees).sum()} without a pose, "
        f"off by {np.nanmedian(times.degrees):.3f} degrees, {np.nanmax(times.degrees):.3f} at most"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--turn", type=float, default=1.0, help="degrees per frame")
    parser.add_argument("--features", nargs="+", default=["klt"], choices=["klt", "sift"])
    parser.add_argument("--rate", type=float, default=0.0, help="frame sets per second that come; 0: as they are taken")
    parser.add_argument("--jobs", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    with jobs(options.jobs):
        for features in options.features:
            of = options.cameras, (width, height), options.frames, options.turn, features, options.seed, options.rate
            measured(*of[:2], 20, *of[3:])  # compiles, or loads
            times = measured(*of)
            print(f"{features}: {line(times)}", flush=True)


if __name__ == "__main__":
    main()
