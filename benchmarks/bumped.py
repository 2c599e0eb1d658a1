"""Is a camera that is bumped into named, and only that one, and how good are the poses afterwards? Rendered turns; one of
four cameras is turned about its centre from frame 25 on.

    python benchmarks/bumped.py [--seeds N] [--degrees 0 0.5 1 2 5 10] [--still]

With --still the background does not turn with the camera, as a screen behind the object that tells nothing. Prints for each
angle in how many scenes the camera was named by its background (`tracking/nudges.py`), how many frames after the bump the
turn was said to begin and by how many degrees its angle was off; in how many it was found to disagree with the others
(`report/disagreement.py`); how often any other camera was named; and the errors of the poses from the bump on.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_scenes import turned
from sylpose import FramePose, FrameSet, Rig, Trajectory, track
from sylpose.frames import Box
from sylpose.numerics.arrays import FloatArray, Image
from sylpose.report.disagreement import disagreements
from sylpose.simulate import DemoTruth, Scene, demo_scene, demo_truth, render_frames

FRAMES, BUMP, TURN_DEG, SIZE = 60, 25, 70.0, (320, 240)
SAID = re.compile(r"camera (\S+) was nudged at frame (\d+): the background turned by (\S+) degrees")


class Bumped(NamedTuple):
    """What came of it: frames after the bump and degrees said of the right camera, frames after which it disagreed, how
    often another was named, and (n, 2) degrees and millimetres of the poses from the bump on."""

    named: list[tuple[int, float]]
    disagrees: list[int]
    others: int
    errors: FloatArray


def images_of(scene: Scene, camera: int, turn: Rotation, *, still: bool) -> list[tuple[Image, ...]]:
    """The scene's images, with a camera that is turned from frame `BUMP` on."""
    images, cameras = list(render_frames(scene)), list(scene.rig)
    if not still:
        for k in range(BUMP, len(images)):
            seen = list(images[k])
            seen[camera] = turned(seen[camera], cameras[camera], turn.inv().as_rotvec())
            images[k] = tuple(seen)
        return images
    now = RigidTransform.from_rotation(turn) * cameras[camera].camera_from_world
    cameras[camera] = replace(cameras[camera], camera_from_world=now)
    return images[:BUMP] + list(render_frames(replace(scene, rig=Rig(cameras, "m"))))[BUMP:]


def bumped(seed: int, degrees: float, camera: int, *, still: bool) -> Bumped:
    """A camera turns by some degrees about an axis of its own."""
    scene = demo_scene(frames=FRAMES, turn_deg=TURN_DEG, size=SIZE, n_cameras=4, seed=seed)
    axis = np.random.default_rng(seed).normal(size=3)
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
    images, truth, nothing = images_of(scene, camera, turn, still=still), demo_truth(scene), (None,) * 4
    frames = [FrameSet(k, k / 30, nothing, seen, nothing) for k, seen in enumerate(images)]
    poses = [f.pose for f in track(frames, scene.rig, {name: Box(*box) for name, box in truth.boxes.items()})]
    found = {said.groups() for pose in poses for fault in pose.faults if (said := SAID.match(fault))}
    doubted = disagreements(Trajectory(poses, scene.rig.names))
    mine, right = f"cam_{camera}", {f"cam_{camera}"} if degrees else set()
    return Bumped(
        sorted((int(frame) - BUMP, float(angle) - degrees) for name, frame, angle in found if name == mine),
        [d.first - BUMP for d in doubted if d.camera == mine and d.first >= BUMP],
        sum(name not in right for name in [d.camera for d in doubted] + [name for name, _, _ in found]),
        errors(poses, truth),
    )


def errors(poses: Sequence[FramePose], truth: DemoTruth) -> FloatArray:
    """(n, 2) of the poses from the bump on: degrees, and millimetres of the object's centre."""
    first, rows = poses[0].world_from_object, []
    assert first is not None
    center = truth.world_from_object[0].translation
    for pose in poses[BUMP:]:
        if pose.measured and pose.world_from_object is not None:
            found = pose.world_from_object * first.inv()
            true = truth.world_from_object[pose.index] * truth.world_from_object[0].inv()
            off = np.degrees((found.rotation * true.rotation.inv()).magnitude())
            rows.append((off, 1e3 * np.linalg.norm(found.apply(center) - true.apply(center))))
    return np.array(rows).reshape(-1, 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--degrees", type=float, nargs="+", default=[0.0, 0.5, 1.0, 2.0, 5.0, 10.0])
    parser.add_argument("--still", action="store_true", help="the background does not turn with the camera")
    options = parser.parse_args()
    print(
        "| bumped by | named | frames after | angle off, degrees | disagrees | others named | degrees: median, worst | "
        "mm: median, worst |"
    )
    print("|" + "---|" * 8)
    for degrees in options.degrees:
        runs = [bumped(seed, degrees, seed % 4, still=options.still) for seed in range(options.seeds)]
        said = [one for run in runs for one in run.named]
        off = np.concatenate([run.errors for run in runs])
        cells = [
            f"{degrees:g}°",
            f"{sum(bool(run.named) for run in runs)} of {len(runs)}",
            ", ".join(str(late) for late, _ in said),
            f"{max(abs(angle) for _, angle in said):.2f}" if said else "",
            f"{sum(bool(degrees and run.disagrees) for run in runs)}",
            f"{sum(run.others for run in runs)}",
            f"{np.median(off[:, 0]):.2f}, {off[:, 0].max():.2f}",
            f"{np.median(off[:, 1]):.1f}, {off[:, 1].max():.1f}",
        ]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
