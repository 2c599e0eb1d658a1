"""Consistency of the tracker's covariance on rendered sequences with known truth.

    python benchmarks/uncertainty.py [--sequences 3] [--frames 30]

The measure is the squared error of the pose since the first frame in units of its covariance (NEES). Its mean is 6 for a
consistent covariance, less for a pessimistic one and more for an optimistic one.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np

from sylpose import simulate
from sylpose.frames import FrameSet
from sylpose.tracking.tracker import track


def render_frame_sets(scene: simulate.Scene) -> Iterator[FrameSet]:
    """Render a scene as input for the tracker."""
    for k, images in enumerate(simulate.render_frames(scene)):
        no_values = (None,) * len(images)
        yield FrameSet(k, float(k), no_values, tuple(images), no_values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=int, default=3)
    parser.add_argument("--frames", type=int, default=30)
    options = parser.parse_args()
    print("| sequence | frame | rotation, deg: error / sd | position, mm: error / sd | NEES |\n|---|---|---|---|---|")
    all_nees = []
    for seed in range(options.sequences):
        scene = simulate.make_demo_scene(
            frames=options.frames, angle_deg=1.5 * options.frames, seed=seed, size=(480, 360)
        )
        truth = simulate.compute_demo_truth(scene).world_from_object
        first = None
        for tracked in track(render_frame_sets(scene), scene.rig):
            pose = tracked.pose
            if pose.world_from_object is None:
                continue
            if first is None:
                first = pose
                continue
            start = first.world_from_object
            assert start is not None
            expected = truth[pose.index] * truth[first.index].inv() * start
            rotation_error = (expected.rotation * pose.world_from_object.rotation.inv()).as_rotvec()
            error = np.concatenate([rotation_error, expected.translation - pose.world_from_object.translation])
            nees = float(error @ np.linalg.solve(pose.covariance, error))
            all_nees.append(nees)
            if pose.index in (1, 3, 7, 15, options.frames - 1):
                degrees, sd = np.rad2deg([np.linalg.norm(error[:3]), np.linalg.norm(pose.sigma[:3])])
                mm, sd_mm = 1e3 * np.linalg.norm(error[3:]), 1e3 * np.linalg.norm(pose.sigma[3:])
                print(f"| {seed} | {pose.index} | {degrees:.3f} / {sd:.3f} | {mm:.2f} / {sd_mm:.2f} | {nees:.1f} |")
    print(f"\nNEES over all {len(all_nees)} frames: mean {np.mean(all_nees):.1f}, maximum {max(all_nees):.1f}")


if __name__ == "__main__":
    main()
