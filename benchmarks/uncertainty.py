"""Whether the tracker's covariance is of the size of its errors, on rendered sequences with known truth.

    python benchmarks/uncertainty.py [--sequences 3] [--frames 30]

The errors of the pose since the first frame, normalised by its covariance (NEES): 6 on average if it is right, less if it
is too wide, more if it is too narrow.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np

from sylpose import simulate
from sylpose.frames import FrameSet
from sylpose.tracking.tracker import track


def frame_sets(scene: simulate.Scene) -> Iterator[FrameSet]:
    """The rendered images as the tracker takes them."""
    for k, images in enumerate(simulate.render_frames(scene)):
        none = (None,) * len(images)
        yield FrameSet(k, float(k), none, tuple(images), none)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=int, default=3)
    parser.add_argument("--frames", type=int, default=30)
    options = parser.parse_args()
    print("| sequence | frame | degrees: error / sd | mm: error / sd | NEES |\n|---|---|---|---|---|")
    everything = []
    for seed in range(options.sequences):
        scene = simulate.demo_scene(frames=options.frames, turn_deg=1.5 * options.frames, seed=seed, size=(480, 360))
        truth = simulate.demo_truth(scene).world_from_object
        first = None
        for tracked in track(frame_sets(scene), scene.rig):
            pose = tracked.pose
            if pose.world_from_object is None:
                continue
            if first is None:
                first = pose
                continue
            start = first.world_from_object
            assert start is not None
            expected = truth[pose.index] * truth[first.index].inv() * start
            turn = (expected.rotation * pose.world_from_object.rotation.inv()).as_rotvec()
            error = np.concatenate([turn, expected.translation - pose.world_from_object.translation])
            nees = float(error @ np.linalg.solve(pose.covariance, error))
            everything.append(nees)
            if pose.index in (1, 3, 7, 15, options.frames - 1):
                degrees, sd = np.rad2deg([np.linalg.norm(error[:3]), np.linalg.norm(pose.sigma[:3])])
                mm, sd_mm = 1e3 * np.linalg.norm(error[3:]), 1e3 * np.linalg.norm(pose.sigma[3:])
                print(f"| {seed} | {pose.index} | {degrees:.3f} / {sd:.3f} | {mm:.2f} / {sd_mm:.2f} | {nees:.1f} |")
    print(f"\nNEES over all {len(everything)} frames: mean {np.mean(everything):.1f}, worst {max(everything):.1f}")


if __name__ == "__main__":
    main()
