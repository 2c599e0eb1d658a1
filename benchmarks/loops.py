"""Is drift undone where the object shows a side again? Rendered turns by 420 degrees, seeded, two to four cameras.

    python benchmarks/loops.py [--seeds N] [--features klt sift]

Errors since the start against the truth, in degrees and millimetres: the median and the worst frame of each turn, and the
median of its last four frames, which show what the first ones did. Prints a line for each turn and their means.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose import FrameSet, track
from sylpose.app.demo import score
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import demo_scene, demo_truth, render_frames

FRAMES, TURN_DEG, SIZE = 56, 420.0, (320, 240)
CAMERAS = (3, 4, 2, 3)


class Turn(NamedTuple):
    """A rendered recording, and where the object is."""

    rig: Rig
    frames: list[FrameSet]
    boxes: Mapping[str, Box]
    world_from_object: RigidTransform


def rendered(**options: Any) -> Turn:
    """The project's demo with other options than its own (`demo_scene`)."""
    scene = demo_scene(**options)
    truth, nothing = demo_truth(scene), (None,) * len(scene.rig)
    frames = [FrameSet(k, float(k), nothing, images, nothing) for k, images in enumerate(render_frames(scene))]
    return Turn(scene.rig, frames, {name: Box(*box) for name, box in truth.boxes.items()}, truth.world_from_object)


def turn_of(seed: int) -> Turn:
    """The turn with that seed."""
    return rendered(frames=FRAMES, turn_deg=TURN_DEG, size=SIZE, n_cameras=CAMERAS[seed % len(CAMERAS)], seed=seed)


def errors_of(seed: int, features: str) -> FloatArray:
    """(6,) degrees and millimetres: median, worst, end."""
    turn = turn_of(seed)
    tracked = track(turn.frames, turn.rig, turn.boxes, features=features)
    solved = [f.pose for f in tracked if f.pose.world_from_object is not None]
    poses = RigidTransform.concatenate([p.world_from_object for p in solved])
    found = score(
        [p.time for p in solved],
        poses,
        np.arange(FRAMES),
        turn.world_from_object,
        turn.world_from_object[0].translation,
    )
    both = np.column_stack([found.rotation, 1e3 * found.displacement])
    return np.concatenate([np.median(both, axis=0), both.max(axis=0), np.median(both[-4:], axis=0)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--features", nargs="+", default=["klt", "sift"])
    options = parser.parse_args()
    print("| seed | cameras | features | degrees: median / worst / end | mm |")
    print("|---|---|---|---|---|")
    rows = []
    for seed in range(options.seeds):
        for features in options.features:
            rows.append(errors_of(seed, features))
            print(line(str(seed), str(CAMERAS[seed % len(CAMERAS)]), features, rows[-1]), flush=True)
    print(line("mean", "", "", np.mean(rows, axis=0)))


def line(seed: str, cameras: str, features: str, row: FloatArray) -> str:
    """One line of the table."""
    deg, mm = (" / ".join(f"{x:.3f}" for x in row[k::2]) for k in (0, 1))
    return f"| {seed} | {cameras} | {features} | {deg} | {mm} |"


if __name__ == "__main__":
    main()
