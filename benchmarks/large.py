"""Processor time of tracking in large images: during initialization, tracking and loss of the object.

    python benchmarks/large.py [--size 3264x2448] [--cameras 2] [--seeds 0:3]

Renders a textured body in cluttered rooms. It rotates by 4 degrees per frame, fills 10 to 50 % of the image height and is
absent for four frames in the middle. It is tracked image by image, with and without boxes. Prints the processor time per
frame set, without rendering and decoding: until the first pose, with the object present, and with the object absent; the
number of frames in which the object was localized; and the errors of these frames.
"""

from __future__ import annotations

import argparse
import time
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.kinds import compute_errors
from benchmarks.kinds_scenes import Variation, compute_boxes, draw_body, draw_rig, make_path
from sylpose import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.results import FramePose
from sylpose.simulate import Actor, Scene
from sylpose.tracking.tracker import Tracker

FRAMES, ABSENT_FRAMES = 16, range(8, 12)
WRONG_DEG, SURE_SDS = 3.0, 5.0


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="3264x2448")
    parser.add_argument("--cameras", type=int, default=2)
    parser.add_argument("--seeds", default="0:3")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    for with_boxes in (True, False):
        costs = []
        for seed in range(*map(int, options.seeds.split(":"))):
            variation = draw_variation(seed, options.cameras, (width, height))
            costs.append(track_variation(variation, list(variation.frames()), with_boxes=with_boxes, seed=seed))
        print("boxes: " if with_boxes else "no boxes: ", format_summary(costs), flush=True)


if __name__ == "__main__":
    main()
