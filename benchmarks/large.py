"""Tracking in large images: the same scene in several sizes; processor time while an object is absent.

    python benchmarks/large.py [--frames 14] [--turn 4.0]
    python benchmarks/large.py --absent [--size 3264x2448] [--cameras 2] [--seeds 0:3]

The demo scene is rendered by 4 cameras of 3264x2448 and reduced to full HD (without the upper and lower border) and VGA.
Noise and blur are those of each size. The object fills a third of the image height or more. Each recording is tracked in a
process of its own. *Followed* are the frame sets after the first poses that are solved without SIFT before them. Processor
time, of all threads, includes decoding and the search for what moves.

With `--absent`, a textured body in cluttered rooms rotates by 4 degrees per frame, fills 10 to 50 % of the image height and
is absent for four frames in the middle. It is tracked image by image, with and without boxes. Prints the processor time per
frame set, without rendering and decoding: until the first pose, with the object present, and with the object absent; the
number of frames in which the object was localized; and the errors of these frames.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.kinds import compute_errors
from benchmarks.kinds_scenes import Variation, compute_boxes, draw_body, draw_rig, make_path
from sylpose import FrameSet, open_session
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.results import FramePose
from sylpose.rig import Camera, Rig
from sylpose.runs.candidates import select_candidate
from sylpose.runs.options import RunOptions
from sylpose.runs.system_resources import return_large_arrays
from sylpose.simulate import Actor, Scene, make_demo_scene, render_frames
from sylpose.simulate.recordings import create_session_folder, write_videos
from sylpose.status import FrameStatus
from sylpose.tracking.tracker import Tracker

FRAMES, ABSENT_FRAMES = 16, range(8, 12)
WRONG_DEG, SURE_SDS = 3.0, 5.0
# Image sizes, the rendered one first; noise, gray levels, and blur, pixels.
SIZES = ((3264, 2448), (1920, 1080), (640, 480))
DISTURBANCES = ((1.5, 0.0), (5.0, 1.0))


class TrackingCosts(NamedTuple):
    """Processor seconds (F,) per frame set, poses, and their errors and NEES (see `compared`)."""

    seconds: FloatArray
    poses: list[FramePose]
    errors: FloatArray
    nees: FloatArray


def draw_variation(seed: int, cameras: int, size: tuple[int, int]) -> Variation:
    """Draw a variation."""
    rng = np.random.default_rng(seed)
    rig, radius = draw_rig(rng, cameras, size=size, share=float(rng.uniform(0.1, 0.5)))
    path = make_path(
        rng, 4.0 * np.arange(FRAMES, dtype=float), np.outer(np.arange(FRAMES), rng.uniform(-0.05, 0.05, 3)) * radius
    )
    absent_pose = RigidTransform.from_translation([0.0, -40.0 * radius, 0.0])
    actor = Actor(draw_body(rng, rig, radius), lambda k: absent_pose if round(k) in ABSENT_FRAMES else path(k))
    scene = Scene(rig, (actor,), FRAMES, int(rng.integers(1 << 30)))
    return Variation(scene, compute_boxes(scene, 1.05), radius)


def track_variation(variation: Variation, frames: list[FrameSet], *, with_boxes: bool, seed: int) -> TrackingCosts:
    """Track a variation."""
    seconds, poses = np.zeros(len(frames)), []
    with Tracker(variation.scene.rig, (variation.boxes or {}) if with_boxes else {}, seed=seed) as tracker:
        for k, frame_set in enumerate(frames):
            start_time = time.process_time()
            poses += [decided.pose for decided in tracker.step(frame_set)]
            seconds[k] = time.process_time() - start_time
        poses += [decided.pose for decided in tracker.flush()]
    return TrackingCosts(seconds, poses, *compute_errors(variation, poses))


def format_summary(costs: list[TrackingCosts]) -> str:
    """Format the summary of several variations."""
    is_absent = np.isin(np.arange(FRAMES), ABSENT_FRAMES)
    first = [next((k for k, pose in enumerate(c.poses) if pose.world_from_object is not None), FRAMES) for c in costs]
    is_initialized = [np.arange(FRAMES) > max(k, 0) for k in first]
    initializing = np.concatenate([c.seconds[~b] for c, b in zip(costs, is_initialized, strict=True)])
    tracking = np.concatenate([c.seconds[b & ~is_absent] for c, b in zip(costs, is_initialized, strict=True)])
    absent = np.concatenate([c.seconds[b & is_absent] for c, b in zip(costs, is_initialized, strict=True)])
    is_localized = np.concatenate(
        [[p.is_observed for p, a in zip(c.poses, is_absent, strict=True) if not a] for c in costs]
    )
    errors = np.concatenate([c.errors for c in costs])
    found = np.isfinite(errors[:, 0]) & np.concatenate([[p.is_observed for p in c.poses] for c in costs])
    is_wrong_and_sure = found & (errors[:, 0] > WRONG_DEG) & (errors[:, 2] > SURE_SDS)
    return (
        f"processor seconds: {initializing.mean():.2f} initializing, {tracking.mean():.2f} tracking, "
        f"{absent.mean():.2f} absent; "
        f"localized in {is_localized.sum()} of {len(is_localized)}; "
        f"error {np.median(errors[found, 0]):.3f}°, {errors[found, 0].max():.2f}° "
        f"at most, NEES {np.concatenate([c.nees for c in costs])[found].mean():.1f}; "
        f"{is_wrong_and_sure.sum()} wrong and sure"
    )


class SizeCosts(NamedTuple):
    """Tracking of one recording: share of frame sets followed, degrees (n,), processor seconds per frame set, peak MB."""

    followed: float
    degrees: FloatArray
    seconds: float
    megabytes: float


def reduce_rig(rig: Rig, size: tuple[int, int]) -> Rig:
    """Return the cameras of reduced images, of which the upper and lower border is cut off."""
    cameras, scale = [], size[0] / rig.cameras[0].size[0]
    for camera in rig:
        matrix = np.diag([scale, scale, 1.0]) @ camera.matrix
        matrix[:2, 2] += 0.5 * (scale - 1.0)
        matrix[1, 2] -= (round(scale * camera.size[1]) - size[1]) // 2
        cameras.append(Camera(camera.name, size, matrix, camera.distortion, camera.camera_from_world))
    return Rig(cameras, rig.unit)


def reduce_and_disturb(
    frames: Sequence[Sequence[Image]], size: tuple[int, int], noise: float, blur: float
) -> Iterator[list[Image]]:
    """Yield the images reduced to a size, blurred and noisy."""
    rng = np.random.default_rng(0)
    for images in frames:
        reduced = []
        for image in images:
            scale = size[0] / image.shape[1]
            small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image
            top = (small.shape[0] - size[1]) // 2
            small = small[top : top + size[1]]
            small = cv2.GaussianBlur(small, (0, 0), blur) if blur else small
            noisy = small + noise * rng.standard_normal(small.shape, np.float32)
            reduced.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
        yield reduced


def track_size(folder: str, truth: RigidTransform) -> SizeCosts:
    """Track a recording whose true poses are known."""
    return_large_arrays()
    session, poses, n_followed, n_frames = open_session(folder), list[FramePose](), 0, 0
    start = time.process_time()
    candidate = select_candidate(session, RunOptions())
    with Tracker(session.rig, candidate=candidate) as tracker:
        for frames in session.frames():
            number, known = tracker.next_number, bool(poses)
            poses += [decided.pose for decided in tracker.step(frames)]
            anchor = tracker.snapshot.state.frames.anchor
            n_frames += known
            is_tracked = known and poses[-1].status is FrameStatus.TRACKED
            n_followed += is_tracked and anchor is not None and anchor.frame.number < number
        poses += [decided.pose for decided in tracker.flush()]
    seconds = (time.process_time() - start) / session.n_frames
    errors = [
        (pose.world_from_object * poses[0].world_from_object.inv() * truth[0] * truth[k].inv()).rotation.magnitude()
        for k, pose in enumerate(poses)
        if pose.world_from_object is not None and poses[0].world_from_object is not None
    ]
    status = Path("/proc/self/status").read_text(encoding="ascii").split("VmHWM:")[1]
    return SizeCosts(n_followed / n_frames, np.degrees(errors[1:]), seconds, int(status.split()[0]) / 1024)


def compare_sizes(frames: int, turn: float) -> None:
    """Print a row for each size and disturbance."""
    scene = make_demo_scene(frames=frames, angle_deg=turn * frames, size=SIZES[0], noise=0.0)
    rendered, truth = list(render_frames(scene)), scene.object_poses()
    print(
        "| noise; blur | image | followed | poses | degrees: median, worst | s per frame set | ratio to full HD | peak MB |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for noise, blur in DISTURBANCES:
        costs = list[SizeCosts]()
        for size in SIZES:
            rig = reduce_rig(scene.rig, size)
            with tempfile.TemporaryDirectory() as folder:
                write_videos(
                    create_session_folder(folder, rig), rig, reduce_and_disturb(rendered, size, noise, blur), frames
                )
                with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
                    costs.append(pool.submit(track_size, folder, truth).result())
        for size, own in zip(SIZES, costs, strict=True):
            print(
                f"| {noise:g}; {blur:g} | {size[0]}x{size[1]} | {100 * own.followed:.0f} % "
                f"| {len(own.degrees) + 1} of {frames} | {np.median(own.degrees):.3f}, {own.degrees.max():.3f} "
                f"| {own.seconds:.2f} | {own.seconds / costs[1].seconds:.2f} | {own.megabytes:.0f} |",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="3264x2448")
    parser.add_argument("--cameras", type=int, default=2)
    parser.add_argument("--seeds", default="0:3")
    parser.add_argument("--absent", action="store_true", help="an object that is absent for a while")
    parser.add_argument("--frames", type=int, default=14)
    parser.add_argument("--turn", type=float, default=4.0, help="degrees per frame")
    options = parser.parse_args()
    if not options.absent:
        compare_sizes(options.frames, options.turn)
        return
    width, height = map(int, options.size.split("x"))
    for with_boxes in (True, False):
        costs = []
        for seed in range(*map(int, options.seeds.split(":"))):
            variation = draw_variation(seed, options.cameras, (width, height))
            costs.append(track_variation(variation, list(variation.frames()), with_boxes=with_boxes, seed=seed))
        print("boxes: " if with_boxes else "no boxes: ", format_summary(costs), flush=True)


if __name__ == "__main__":
    main()
