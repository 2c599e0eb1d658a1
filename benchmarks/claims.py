"""Two of the paper's claims tested with the tracker: occlusion and views of any camera, in one process and by nodes.

    python benchmarks/claims.py [--frames 24] [--shares 0 30 60 90 100]

The demo has four cameras and a box that rotates by 1.5 degrees per frame. From the fifth frame on, a panel occludes a share
of the width of the object's box in two of the cameras; 100 occludes the whole image. Errors are those of the motion since
the first frame, median and worst. The last column compares the views of all cameras, including the occluded ones and a
virtual one: the largest difference between the error angle in a camera's view and the error angle in the world, in radians.
The rows of nodes show the result of the first occluded camera. Method "landmarks".
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.live import compute_error_norms
from benchmarks.loops import RenderedSequence, render_demo
from sylpose import FramePose, track, view_of_pose
from sylpose.methods import MODES
from sylpose.network.simulation import track_by_nodes

# Occluded cameras, and the first occluded frame.
OCCLUDED, FIRST_OCCLUDED = (0, 1), 4
# A virtual camera above the object, looking down.
VIRTUAL = RigidTransform.from_components([0.0, 0.0, 2.0], Rotation.from_euler("xz", [200.0, 30.0], degrees=True))


def occlude(scene: RenderedSequence, percent: float, rng: np.random.Generator) -> RenderedSequence:
    """Occlude the scene by static panels with random patterns."""
    centers = scene.world_from_object.translation
    frames, panels = [], dict[int, npt.NDArray[np.uint8]]()
    for k, frame in enumerate(scene.frames):
        images = list(frame.images)
        for c in OCCLUDED if k >= FIRST_OCCLUDED and percent > 0 else ():
            image, camera = images[c], scene.rig.cameras[c]
            assert image is not None
            panel = panels.setdefault(c, rng.integers(60, 200, (*image.shape[:2], 1), dtype=np.uint8))
            box = scene.boxes[camera.name]
            center_u = float(camera.project(centers[k][None])[0, 0])
            edge = int(np.clip(center_u + (percent / 100 - 0.5) * (box.width), 0, image.shape[1]))
            image = image.copy()
            width = image.shape[1] if percent >= 100 else edge
            image[:, :width] = panel[:, :width] if image.ndim == 3 else panel[:, :width, 0]
            images[c] = image
        frames.append(replace(frame, images=tuple(images)))
    return scene._replace(frames=frames)


def format_row(scene: RenderedSequence, poses: Sequence[FramePose]) -> str:
    """Format the number of poses, their errors, and the difference between the views."""
    measured = [k for k, pose in enumerate(poses) if pose.is_measured and k > 0]
    errors = np.array([compute_error_norms(scene, 0, poses[0], k, poses[k]) for k in measured])
    max_difference = 0.0
    for view in (*scene.rig.cameras, VIRTUAL):
        camera_from_world = view.camera_from_world if hasattr(view, "camera_from_world") else view
        true = [camera_from_world * scene.world_from_object[k] for k in range(len(poses))]
        for k, (angle, _) in zip(measured, errors, strict=True):
            first, current = (view_of_pose(poses[i], view).world_from_object for i in (0, k))
            assert first is not None
            assert current is not None
            rotation_error = (current * first.inv()).rotation * (true[k] * true[0].inv()).rotation.inv()
            max_difference = max(max_difference, abs(rotation_error.magnitude() - np.radians(angle)))
    (deg, mm), (max_deg, max_mm) = np.median(errors, axis=0), errors.max(axis=0)
    return f"{len(measured) + 1} of {len(poses)} | {deg:.3f}, {max_deg:.3f} | {mm:.2f}, {max_mm:.2f} | {max_difference:.0e}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--shares", type=float, nargs="+", default=[0, 30, 60, 90, 100])
    options = parser.parse_args()
    scene = render_demo(frames=options.frames, angle_deg=1.5 * options.frames)
    print(
        "| occluded in two of four cameras | tracked by | frames measured | rotation error, deg: median, worst "
        "| position error, mm: median, worst | difference of views, rad |"
    )
    print("|---|---|---|---|---|---|")
    for percent in options.shares:
        occluded = occlude(scene, percent, np.random.default_rng(1))
        single_process = [frame.pose for frame in track(occluded.frames, occluded.rig, occluded.boxes)]
        print(f"| {percent:.0f} % | one process | {format_row(occluded, single_process)} |", flush=True)
        for mode in MODES:
            outcome = track_by_nodes(occluded.frames, occluded.rig, occluded.boxes, mode=mode)
            node_poses = [[frame.pose for frame in outcome.frames[c]] for c in range(len(scene.rig))]
            print(f"| | nodes, {mode} | {format_row(occluded, node_poses[OCCLUDED[0]])} |", flush=True)


if __name__ == "__main__":
    main()
