"""Two of the paper's claims, asked of the tracker: occlusion, and any camera's view. In one process, and by nodes.

    python benchmarks/claims.py [--frames 24] [--shares 0 30 60 90 100]

The demo (four cameras, a box that turns by 1.5 degrees a frame). From the fifth frame on a panel hides a share of the width
of the object's box in two of the cameras, on one side of a line across each image; 100 is all of the image. Errors of the
motion since the first frame, degrees and millimetres, medians and worst. Views: by how much at most the angle by which each
camera's view of that motion is off, the hidden ones' and a virtual one's too, differs from the angle in the world; radians.
Nodes say it as the first of the hidden cameras has it. Method "landmarks".
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.live import error
from benchmarks.loops import Turn, rendered
from sylpose import FramePose, track, view_of_pose
from sylpose.methods import MODES
from sylpose.network.simulation import track_by_nodes

# Cameras that something hides, and from which frame on.
HIDDEN, FROM = (0, 1), 4
# A camera that is not there: above, looking down.
VIRTUAL = RigidTransform.from_components([0.0, 0.0, 2.0], Rotation.from_euler("xz", [200.0, 30.0], degrees=True))


def hidden(scene: Turn, percent: float, rng: np.random.Generator) -> Turn:
    """The scene behind panels that stand still, with a pattern of their own."""
    centers = scene.world_from_object.translation
    frames, panels = [], dict[int, npt.NDArray[np.uint8]]()
    for k, frame in enumerate(scene.frames):
        images = list(frame.images)
        for c in HIDDEN if k >= FROM and percent > 0 else ():
            image, camera = images[c], scene.rig.cameras[c]
            assert image is not None
            panel = panels.setdefault(c, rng.integers(60, 200, (*image.shape[:2], 1), dtype=np.uint8))
            box = scene.boxes[camera.name]
            middle = float(camera.project(centers[k][None])[0, 0])
            edge = int(np.clip(middle + (percent / 100 - 0.5) * (box.width), 0, image.shape[1]))
            image = image.copy()
            part = image.shape[1] if percent >= 100 else edge
            image[:, :part] = panel[:, :part] if image.ndim == 3 else panel[:, :part, 0]
            images[c] = image
        frames.append(replace(frame, images=tuple(images)))
    return scene._replace(frames=frames)


def row(scene: Turn, poses: Sequence[FramePose]) -> str:
    """Poses, errors, and the views' share of them."""
    have = [k for k, pose in enumerate(poses) if pose.measured and k > 0]
    errors = np.array([error(scene, 0, poses[0], k, poses[k]) for k in have])
    apart = 0.0
    for view in (*scene.rig.cameras, VIRTUAL):
        turn = view.camera_from_world if hasattr(view, "camera_from_world") else view
        true = [turn * scene.world_from_object[k] for k in range(len(poses))]
        for k, (angle, _) in zip(have, errors, strict=True):
            first, now = (view_of_pose(poses[i], view).world_from_object for i in (0, k))
            assert first is not None
            assert now is not None
            off = (now * first.inv()).rotation * (true[k] * true[0].inv()).rotation.inv()
            apart = max(apart, abs(off.magnitude() - np.radians(angle)))
    (deg, mm), (most, far) = np.median(errors, axis=0), errors.max(axis=0)
    return f"{len(have) + 1} of {len(poses)} | {deg:.3f}, {most:.3f} | {mm:.2f}, {far:.2f} | {apart:.0e}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--shares", type=float, nargs="+", default=[0, 30, 60, 90, 100])
    options = parser.parse_args()
    scene = rendered(frames=options.frames, turn_deg=1.5 * options.frames)
    print("| hidden in two of four | tracked | measured | degrees: median, worst | mm | views: apart, rad |")
    print("|---|---|---|---|---|---|")
    for percent in options.shares:
        behind = hidden(scene, percent, np.random.default_rng(1))
        alone = [frame.pose for frame in track(behind.frames, behind.rig, behind.boxes)]
        print(f"| {percent:.0f} % | one process | {row(behind, alone)} |", flush=True)
        for mode in MODES:
            outcome = track_by_nodes(behind.frames, behind.rig, behind.boxes, mode=mode)
            said = [[frame.pose for frame in outcome.frames[c]] for c in range(len(scene.rig))]
            print(f"| | nodes, {mode} | {row(behind, said[HIDDEN[0]])} |", flush=True)


if __name__ == "__main__":
    main()
