"""Is a camera that is bumped into named, and only that one? Rendered turns; one of four cameras is turned from frame 25 on.

    python benchmarks/bumped.py [--seeds N] [--degrees 0 0.5 1 2 5 10]

Prints for each angle in how many scenes the camera was named, how many frames after the bump, and how often another was.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import FrameSet, Rig, Trajectory, track
from sylpose.frames import Box
from sylpose.report.disagreement import Disagreement, disagreements
from sylpose.simulate import demo_scene, demo_truth, render_frames

FRAMES, BUMP, TURN_DEG, SIZE = 60, 25, 70.0, (320, 240)


def named(seed: int, degrees: float, camera: int) -> list[Disagreement]:
    """Who is named when a camera turns by some degrees about an axis of its own."""
    scene = demo_scene(frames=FRAMES, turn_deg=TURN_DEG, size=SIZE, n_cameras=4, seed=seed)
    images, boxes, cameras = list(render_frames(scene)), demo_truth(scene).boxes, list(scene.rig)
    axis = np.random.default_rng(seed).normal(size=3)
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
    cameras[camera] = replace(
        cameras[camera], camera_from_world=RigidTransform.from_rotation(turn) * cameras[camera].camera_from_world
    )
    images[BUMP:] = list(render_frames(replace(scene, rig=Rig(cameras, "m"))))[BUMP:]
    nothing = (None,) * 4
    frames = [FrameSet(k, k / 30, nothing, seen, nothing) for k, seen in enumerate(images)]
    poses = [f.pose for f in track(frames, scene.rig, {name: Box(*box) for name, box in boxes.items()})]
    return disagreements(Trajectory(poses, scene.rig.names))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--degrees", type=float, nargs="+", default=[0.0, 0.5, 1.0, 2.0, 5.0, 10.0])
    options = parser.parse_args()
    print("| bumped by | named | frames after | others named |")
    print("|---|---|---|---|")
    for degrees in options.degrees:
        right, wrong, after = 0, 0, []
        for seed in range(options.seeds):
            camera = seed % 4
            found = named(seed, degrees, camera)
            mine = [d for d in found if degrees and d.camera == f"cam_{camera}" and d.first >= BUMP]
            right, wrong = right + bool(mine), wrong + len(found) - len(mine)
            after += [d.first - BUMP for d in mine[:1]]
        late = ", ".join(map(str, sorted(after)))
        print(f"| {degrees:g}° | {right} of {options.seeds} | {late} | {wrong} |", flush=True)


if __name__ == "__main__":
    main()
