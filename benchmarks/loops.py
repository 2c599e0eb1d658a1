"""Drift correction when a side of the object reappears: rendered rotations of 420 degrees, two to four cameras.

    python benchmarks/loops.py [--seeds N] [--features klt sift]

Errors of the motion since the start, in degrees and millimeters: the median and the worst frame of each sequence, and the
median of its last four frames, which show the same side as the first ones. Prints a row per sequence and the means.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose import FrameSet, track
from sylpose.comparison import compare_trajectories
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import compute_demo_truth, make_demo_scene, render_frames

FRAMES, ROTATION_DEG, SIZE = 56, 420.0, (320, 240)
CAMERAS = (3, 4, 2, 3)


class RenderedSequence(NamedTuple):
    """Rendered recording and the object's true poses."""

    rig: Rig
    frames: list[FrameSet]
    boxes: Mapping[str, Box]
    world_from_object: RigidTransform


def render_demo(**options: Any) -> RenderedSequence:
    """Render the demo with the given options of `make_demo_scene`."""
    scene = make_demo_scene(**options)
    truth, no_values = compute_demo_truth(scene), (None,) * len(scene.rig)
    frames = [FrameSet(k, float(k), no_values, images, no_values) for k, images in enumerate(render_frames(scene))]
    return RenderedSequence(
        scene.rig, frames, {name: Box(*box) for name, box in truth.boxes.items()}, truth.world_from_object
    )


def render_sequence(seed: int) -> RenderedSequence:
    """Render the sequence of a seed."""
    return render_demo(
        frames=FRAMES, angle_deg=ROTATION_DEG, size=SIZE, n_cameras=CAMERAS[seed % len(CAMERAS)], seed=seed
    )


def errors_of(seed: int, features: str) -> FloatArray:
    """Track a sequence; return its errors (6,) in degrees and millimeters: median, worst, end."""
    sequence = render_sequence(seed)
    tracked = track(sequence.frames, sequence.rig, sequence.boxes, features=features)
    solved = [f.pose for f in tracked if f.pose.world_from_object is not None]
    poses = RigidTransform.concatenate([p.world_from_object for p in solved])
    times = np.array([p.time for p in solved])
    errors = compare_trajectories(times, poses, np.arange(FRAMES, dtype=float), sequence.world_from_object)
    errors_deg_mm = np.column_stack([np.degrees(errors.rotation[1:]), 1e3 * errors.position[1:]])
    return np.concatenate(
        [np.median(errors_deg_mm, axis=0), errors_deg_mm.max(axis=0), np.median(errors_deg_mm[-4:], axis=0)]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--features", nargs="+", default=["klt", "sift"])
    options = parser.parse_args()
    print("| seed | cameras | features | rotation error, deg: median / worst / end | position error, mm |")
    print("|---|---|---|---|---|")
    rows = []
    for seed in range(options.seeds):
        for features in options.features:
            rows.append(errors_of(seed, features))
            print(format_row(str(seed), str(CAMERAS[seed % len(CAMERAS)]), features, rows[-1]), flush=True)
    print(format_row("mean", "", "", np.mean(rows, axis=0)))


def format_row(seed: str, cameras: str, features: str, row: FloatArray) -> str:
    """Format one row of the table."""
    deg, mm = (" / ".join(f"{x:.3f}" for x in row[k::2]) for k in (0, 1))
    return f"| {seed} | {cameras} | {features} | {deg} | {mm} |"


if __name__ == "__main__":
    main()
