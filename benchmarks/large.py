"""What large images cost: until the object is known, while it is followed, and while it is gone.

    python benchmarks/large.py [--size 3264x2448] [--cameras 2] [--seeds 0:3]

Renders a painted body before furnished rooms that turns by 4 degrees a frame, fills a tenth to a half of the images' height
and is taken away for four frames in the middle. Tracks it image by image, with boxes and without, and prints the processor's
seconds per frame set: of those until the first pose, of those with a pose, the time of rendering and decoding not counted,
and of those in which it is gone; in how many frames it was found of those in which it is there; and how far off these are.
"""

from __future__ import annotations

import argparse
import time
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.kinds import compared
from benchmarks.kinds_scenes import Take, any_body, boxes_of, moving, rig_of
from sylpose import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.results import FramePose
from sylpose.simulate import Actor, Scene
from sylpose.tracking.tracker import Tracker

FRAMES, AWAY = 16, range(8, 12)
WRONG_DEG, SURE = 3.0, 5.0


class Costs(NamedTuple):
    """Seconds of the processor (F,) of each frame set, poses in order, and what they are off by: see `compared`."""

    seconds: FloatArray
    poses: list[FramePose]
    errors: FloatArray
    nees: FloatArray


def take_of(seed: int, cameras: int, size: tuple[int, int]) -> Take:
    """A variation."""
    rng = np.random.default_rng(seed)
    rig, radius = rig_of(rng, cameras, size=size, share=float(rng.uniform(0.1, 0.5)))
    path = moving(
        rng, 4.0 * np.arange(FRAMES, dtype=float), np.outer(np.arange(FRAMES), rng.uniform(-0.05, 0.05, 3)) * radius
    )
    gone = RigidTransform.from_translation([0.0, -40.0 * radius, 0.0])
    actor = Actor(any_body(rng, rig, radius), lambda k: gone if round(k) in AWAY else path(k))
    scene = Scene(rig, (actor,), FRAMES, int(rng.integers(1 << 30)))
    return Take(scene, boxes_of(scene, 1.05), radius)


def tracked(take: Take, frames: list[FrameSet], *, boxed: bool, seed: int) -> Costs:
    """A variation, tracked."""
    seconds, poses = np.zeros(len(frames)), []
    with Tracker(take.scene.rig, (take.boxes or {}) if boxed else {}, seed=seed) as tracker:
        for k, each in enumerate(frames):
            begun = time.process_time()
            poses += [decided.pose for decided in tracker.step(each)]
            seconds[k] = time.process_time() - begun
        poses += [decided.pose for decided in tracker.flush()]
    return Costs(seconds, poses, *compared(take, poses))


def line(costs: list[Costs]) -> str:
    """What is printed of several variations."""
    away = np.isin(np.arange(FRAMES), AWAY)
    first = [next((k for k, pose in enumerate(c.poses) if pose.world_from_object is not None), FRAMES) for c in costs]
    begun = [np.arange(FRAMES) > max(k, 0) for k in first]
    before = np.concatenate([c.seconds[~b] for c, b in zip(costs, begun, strict=True)])
    known = np.concatenate([c.seconds[b & ~away] for c, b in zip(costs, begun, strict=True)])
    gone = np.concatenate([c.seconds[b & away] for c, b in zip(costs, begun, strict=True)])
    there = np.concatenate([[p.seen for p, a in zip(c.poses, away, strict=True) if not a] for c in costs])
    off = np.concatenate([c.errors for c in costs])
    found = np.isfinite(off[:, 0]) & np.concatenate([[p.seen for p in c.poses] for c in costs])
    sure = found & (off[:, 0] > WRONG_DEG) & (off[:, 2] > SURE)
    return (
        f"seconds of the processor: {before.mean():.2f} until known, {known.mean():.2f} known, {gone.mean():.2f} gone; "
        f"found {there.sum()} of {len(there)}; off by {np.median(off[found, 0]):.3f} degrees, {off[found, 0].max():.2f} at "
        f"most, NEES {np.concatenate([c.nees for c in costs])[found].mean():.1f}; {sure.sum()} wrong and sure"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="3264x2448")
    parser.add_argument("--cameras", type=int, default=2)
    parser.add_argument("--seeds", default="0:3")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    for boxed in (True, False):
        costs = []
        for seed in range(*map(int, options.seeds.split(":"))):
            take = take_of(seed, options.cameras, (width, height))
            costs.append(tracked(take, list(take.frames()), boxed=boxed, seed=seed))
        print("boxes: " if boxed else "no boxes: ", line(costs), flush=True)


if __name__ == "__main__":
    main()
