"""Tracking speed compared with OpenCV's KLT tracker and SIFT detector alone on the same images.

    python benchmarks/realtime.py [--cameras 4] [--size 640x480] [--frames 240] [--turn 1.0] [--features klt] [--jobs 0]

Renders a body that rotates by `--turn` degrees per frame and tracks it image by image, like a live session. After each frame
set, OpenCV alone processes the same images with as many threads. That is `calcOpticalFlowPyrLK` with its defaults (21 x 21,
three levels) for as many points as the tracker had, including the conversion to gray, or SIFT with its defaults. Prints
frame sets per second, the median and the 99th percentile of the time per frame set, and ratios to OpenCV alone, in wall and
processor time. The first twelve frame sets, which are all refined at every step, do not count.

With `--rate`, frame sets arrive at that rate, as from cameras, and the time of a frame set is its latency from arrival to
pose. With `--jobs`, that many compute-bound processes run in parallel.
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
from sylpose.simulate import compute_demo_truth, make_demo_scene, render_frames
from sylpose.tracking.tracker import Tracker

# Number of initial frame sets that do not count.
N_WARM_UP = 12
MAX_POINTS = 170

_cv2: Any = cv2


class Times(NamedTuple):
    """Times (n,) per frame set in milliseconds, and rotation errors (n,) in degrees, NaN without a pose.

    Attributes:
        latency: from the arrival of the images to the pose.
        wall, processor: wall and processor time of the tracker.
        opencv_wall, opencv_processor: wall and processor time of OpenCV alone.
        degrees: rotation error.
    """

    latency: FloatArray
    wall: FloatArray
    processor: FloatArray
    opencv_wall: FloatArray
    opencv_processor: FloatArray
    degrees: FloatArray


def compute_forever() -> None:
    """Compute forever."""
    while True:
        np.linalg.svd(np.random.default_rng(0).standard_normal((60, 60)))


@contextmanager
def run_busy_jobs(count: int) -> Iterator[None]:
    """Run `count` compute-bound processes during the block."""
    running = [multiprocessing.Process(target=compute_forever, daemon=True) for _ in range(count)]
    for job in running:
        job.start()
    try:
        yield
    finally:
        for job in running:
            job.terminate()


def run_opencv_klt(previous_gray: Image, image: Image, points: FloatArray) -> Image:
    """Run OpenCV's KLT tracker alone; return the image in gray."""
    gray: Image = _cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if len(points):
        _cv2.calcOpticalFlowPyrLK(previous_gray, gray, points.astype(np.float32), None)
    return gray


def run_opencv_sift(image: Image) -> None:
    """Run OpenCV's SIFT alone on the whole image."""
    _cv2.SIFT_create().detectAndCompute(_cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), None)


def measure_times(
    cameras: int, size: tuple[int, int], frames: int, degrees_per_frame: float, features: str, seed: int, rate: float
) -> Times:
    """Track a rendered body and time OpenCV alone on the same images; see the module."""
    scene = make_demo_scene(
        frames=frames, angle_deg=degrees_per_frame * frames, size=size, n_cameras=cameras, seed=seed
    )
    truth, no_values = compute_demo_truth(scene), (None,) * cameras
    boxes = {name: Box(*box) for name, box in truth.boxes.items()}
    out: list[tuple[float, ...]] = []
    gray_images: list[Image] = []
    with (
        ThreadPoolExecutor(min(cameras, os.cpu_count() or 1)) as pool,
        Tracker(scene.rig, boxes, features=features) as tracker,
    ):
        image_sets = list(render_frames(scene))
        arrival = time.perf_counter()
        for k, images in enumerate(image_sets):
            # The initial frame sets, which do not count, must not delay the others.
            arrival = (
                max(arrival + 1.0 / rate, time.perf_counter() if k < N_WARM_UP else 0.0)
                if rate
                else time.perf_counter()
            )
            time.sleep(max(arrival - time.perf_counter(), 0.0))
            wall, processor = time.perf_counter(), time.process_time()
            decided = tracker.step(FrameSet(k, k / 30.0, no_values, images, no_values))
            latency, wall = time.perf_counter() - arrival, time.perf_counter() - wall
            processor = time.process_time() - processor
            points = [
                np.empty((0, 2)) if not decided or m is None else m[0][:MAX_POINTS]
                for m in (decided[-1].matches if decided else no_values)
            ]
            opencv_time, bare_processor = time.perf_counter(), time.process_time()
            if features == "sift":
                list(pool.map(run_opencv_sift, images))
            elif gray_images:
                gray_images = list(pool.map(run_opencv_klt, gray_images, images, points))
            else:
                gray_images = [_cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]
            opencv_time, bare_processor = time.perf_counter() - opencv_time, time.process_time() - bare_processor
            arrival += opencv_time  # OpenCV's time does not count as latency
            pose = decided[-1].pose.world_from_object if decided else None
            rotation_error = np.nan if pose is None else (truth.world_from_object[k].inv() * pose).rotation.magnitude()
            out.append(
                (
                    1e3 * latency,
                    1e3 * wall,
                    1e3 * processor,
                    1e3 * opencv_time,
                    1e3 * bare_processor,
                    float(np.degrees(rotation_error)),
                )
            )
    return Times(*np.array(out[N_WARM_UP:]).T)


def format_summary(times: Times) -> str:
    """Format the summary."""
    rate, bare_rate = 1e3 / times.wall.mean(), 1e3 / times.opencv_wall.mean()
    ratios = times.wall.mean() / times.opencv_wall.mean(), times.processor.mean() / times.opencv_processor.mean()
    median_ratio = np.median(times.processor) / np.median(times.opencv_processor)
    return (
        f"{rate:.1f} frame sets per second (OpenCV {bare_rate:.0f}), latency: median {np.median(times.latency):.0f} ms, "
        f"99 % {np.quantile(times.latency, 0.99):.0f} ms (OpenCV {np.quantile(times.opencv_wall, 0.99):.0f}); processor "
        f"{times.processor.mean():.0f} ms (OpenCV {times.opencv_processor.mean():.0f}); ratios: wall {ratios[0]:.1f}, "
        f"processor {ratios[1]:.1f}, of medians {median_ratio:.1f}; {np.isnan(times.degrees).sum()} without a pose, "
        f"rotation error {np.nanmedian(times.degrees):.3f} degrees, {np.nanmax(times.degrees):.3f} at most"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--turn", type=float, default=1.0, help="degrees per frame")
    parser.add_argument("--features", nargs="+", default=["klt"], choices=["klt", "sift"])
    parser.add_argument("--rate", type=float, default=0.0, help="frame sets per second; 0: as fast as possible")
    parser.add_argument("--jobs", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    with run_busy_jobs(options.jobs):
        for features in options.features:
            parameters = (
                options.cameras,
                (width, height),
                options.frames,
                options.turn,
                features,
                options.seed,
                options.rate,
            )
            measure_times(*parameters[:2], 20, *parameters[3:])  # warm-up: compiles, or loads compiled code
            times = measure_times(*parameters)
            print(f"{features}: {format_summary(times)}", flush=True)


if __name__ == "__main__":
    main()
