"""Tracking with one miscalibrated camera: errors, and whether the camera is reported.

    python benchmarks/miscalibrated.py [--scenes 16] [--first 0] [--frames 30]

The recording is the demo (four cameras, a block that rotates by 90 degrees). One camera's calibration is rotated by 2 to 15
degrees, log-uniform: about the object ("orbit"), about its optical axis ("roll"), about its center ("turn"), or about its
center with a translation of some centimeters. A frame is wrong and sure if the error of its rotation since the first frame
exceeds 3 degrees and has a probability below one in a million by its covariance. The remarks are those that `sylpose track`
prints at its end.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.frames import FrameSet
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.report.camera_consistency import describe_camera_problems
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Camera, Rig
from sylpose.simulate import make_demo_scene, render_frames
from sylpose.tracking.tracker import track

KINDS = ("orbit", "roll", "turn", "turn and shift")
DEGREES, TRANSLATION_SD_M = (2.0, 15.0), 0.05
WRONG_DEG, WRONG_NEES = 3.0, chi_squared_bound(3, 1e-6)


def perturb_camera(
    camera: Camera, kind: str, object_center: np.ndarray, rng: np.random.Generator
) -> tuple[Camera, float]:
    """Return a camera with a wrong pose, and the rotation in degrees.

    Args:
        camera: the camera.
        kind: one of `KINDS`.
        object_center: (3,) the object's center, world.
        rng: random generator.
    """
    degrees = float(np.exp(rng.uniform(*np.log(DEGREES))))
    axis = rng.normal(size=3)
    axis = np.array([0.0, 0.0, 1.0]) if kind == "roll" else axis / np.linalg.norm(axis)
    rotation = RigidTransform.from_rotation(Rotation.from_rotvec(np.radians(degrees) * axis))
    before, after = camera.camera_from_world, rotation * camera.camera_from_world
    if kind == "orbit":
        correction = RigidTransform.from_translation(before.apply(object_center) - after.apply(object_center))
        after = correction * after
    if kind == "turn and shift":
        after = RigidTransform.from_translation(TRANSLATION_SD_M * rng.normal(size=3)) * after
    return replace(camera, camera_from_world=after), degrees


def count_wrong_frames(poses: list[FramePose], truth: list[RigidTransform]) -> tuple[int, float]:
    """Count the frames that are wrong and sure; return also the largest rotation error of a measured frame, degrees."""
    first = next((pose for pose in poses if pose.world_from_object is not None), None)
    if first is None or first.world_from_object is None:
        return 0, 0.0
    start, true_start = first.world_from_object.rotation, truth[first.index].rotation
    count, max_error_deg = 0, 0.0
    for pose in poses:
        if not pose.is_measured or pose.world_from_object is None or pose is first:
            continue
        true = truth[pose.index].rotation * true_start.inv()
        error = (pose.world_from_object.rotation * start.inv() * true.inv()).as_rotvec()
        degrees = float(np.degrees(np.linalg.norm(error)))
        max_error_deg = max(max_error_deg, degrees)
        count += degrees > WRONG_DEG and error @ np.linalg.solve(pose.covariance[:3, :3], error) > WRONG_NEES
    return count, max_error_deg


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=16)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--frames", type=int, default=30)
    arguments = parser.parse_args()
    scene = make_demo_scene(frames=arguments.frames)
    no_values = (None,) * len(scene.rig)
    frames = [FrameSet(k, k / 30, no_values, images, no_values) for k, images in enumerate(render_frames(scene))]
    truth = [scene.actors[0].path(k) for k in range(arguments.frames)]
    total = Counter[str]()
    print(
        "| seed | calibration error | camera | frame statuses | wrong and sure | largest error, deg | remarks |\n"
        "|---|---|---|---|---|---|---|"
    )
    for seed in range(arguments.first, arguments.first + arguments.scenes):
        rng = np.random.default_rng(seed)
        c, kind = int(rng.integers(len(scene.rig))), KINDS[seed % len(KINDS)]
        cameras = list(scene.rig)
        cameras[c], degrees = perturb_camera(cameras[c], kind, truth[0].translation, rng)
        rig = Rig(cameras, unit=scene.rig.unit)
        poses = [frame.pose for frame in track(frames, rig)]
        found_remarks = describe_camera_problems(Trajectory(poses, rig.names, rig.unit))
        n_wrong, max_error_deg = count_wrong_frames(poses, truth)
        total.update(wrong=n_wrong, measured=sum(pose.is_measured for pose in poses), silent=not found_remarks)
        total["named"] += any(rig.names[c] in sentence for sentence in found_remarks)
        statuses = ", ".join(f"{status.value} {n}" for status, n in Counter(pose.status for pose in poses).items())
        print(
            f"| {seed} | {kind}, {degrees:.1f}° | {rig.names[c]} | {statuses} | "
            f"{n_wrong} | {max_error_deg:.2f} | {'; '.join(found_remarks)} |",
            flush=True,
        )
    print(
        f"\n{total['wrong']} of {total['measured']} measured frames wrong and sure; "
        f"of {arguments.scenes} scenes, the camera is "
        f"reported in {total['named']}; {total['silent']} have no remark"
    )


if __name__ == "__main__":
    main()
