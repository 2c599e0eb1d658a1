"""Detection of a camera that moves during a recording, and accuracy of the poses afterwards.

    python benchmarks/camera_motion.py [--seeds N] [--degrees 0 0.5 1 2 5 10] [--shift 0] [--background 2] [--still]

The object rotates in rendered images; one of four cameras rotates about its center and translates at frame 25. --shift is
the translation in percent of the camera's distance from the object. --background is the distance of the background as a
multiple of that distance: a translation then looks like a small additional rotation. With --still the background does not
move in the image, like a screen behind the object that carries no information.

The table gives for each rotation and translation:

- the scenes in which the background reveals the camera (`tracking/state_machine.py`), the delay of the reported
  frame and the error of the reported angle;
- the scenes in which the camera is found inconsistent with the others (`report/camera_consistency.py`), and the number of
  false alarms of other cameras;
- the errors of the poses after the motion and their median NEES (should be about 6), as tracked, smoothed, and with the
  calibration refined;
- the errors of that camera's refined rotation and translation, also in standard deviations.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.calibration import compute_pose_errors
from benchmarks.kinds_scenes import rotate_view
from sylpose import FramePose, FrameSet, Rig, Trajectory
from sylpose.bundle_adjustment.calibration_refinement import default_calibration_prior
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.report.camera_consistency import find_disagreements
from sylpose.simulate import DemoTruth, Scene, compute_demo_truth, make_demo_scene, render_frames
from sylpose.smoothing import SmoothedTrajectory, Track, smooth_tracks
from sylpose.tracking.tracker import track

FRAMES, MOTION_FRAME, TURN_DEG, SIZE = 60, 25, 70.0, (320, 240)
FAULT_PATTERN = re.compile(r"camera (\S+) was nudged at frame (\d+): the background turned by (\S+) degrees")


class CameraMotion(NamedTuple):
    """Motion of a camera at a frame.

    Attributes:
        camera: index of the camera.
        rotation: rotation in camera axes.
        translation: (3,) translation of the center in world axes.
        background: distance of the background from the camera; 0: the background does not move in the image.
        frame: first frame after the motion.
    """

    camera: int
    rotation: Rotation
    translation: FloatArray
    background: float
    frame: int = MOTION_FRAME


class PoseScores(NamedTuple):
    """Errors (n, 2) of the poses after the motion, degrees and millimeters, and their NEES (n,)."""

    errors: FloatArray
    nees: FloatArray


class SceneResult(NamedTuple):
    """Result of one scene.

    Attributes:
        detections: delay in frames and error of the angle in degrees, for each report of the right camera.
        inconsistencies: delays in frames after which the right camera was found inconsistent.
        n_false_alarms: number of reports of other cameras.
        poses: scores of the poses as tracked, smoothed and refined.
        refined_errors: (4,) errors of the camera's refined rotation and translation, degrees and millimeters, then in
            standard deviations; NaN if the camera was not detected.
    """

    detections: list[tuple[int, float]]
    inconsistencies: list[int]
    n_false_alarms: int
    poses: tuple[PoseScores, PoseScores, PoseScores]
    refined_errors: FloatArray


def draw_camera_motion(scene: Scene, camera: int, degrees: float, share: float, background: float) -> CameraMotion:
    """Draw a rotation by `degrees` about a random axis and a translation by a share of the distance from the object."""
    rng, center = np.random.default_rng(scene.seed), scene.rig.cameras[camera].center
    axis, direction = rng.normal(size=(2, 3))
    distance = float(np.linalg.norm(center - scene.object_poses()[0].translation))
    rotation = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
    return CameraMotion(
        camera, rotation, share * distance * direction / np.linalg.norm(direction), background * distance
    )


def render_images(scene: Scene, camera_motion: CameraMotion) -> list[tuple[Image, ...]]:
    """Render the scene's images with the motion of the camera."""
    camera = scene.rig.cameras[camera_motion.camera]
    if camera_motion.background:
        # At the background's depth the translation looks like a rotation.
        parallax = np.cross(camera.rotation @ camera_motion.translation, [0.0, 0.0, 1.0]) / camera_motion.background
        apparent_rotation = camera_motion.rotation * Rotation.from_rotvec(parallax)
    else:
        apparent_rotation = Rotation.identity()
    # Rendered with a static background, then rotated as a whole.
    pose = apparent_rotation.inv() * camera_motion.rotation * camera.camera_from_world.rotation
    moved_pose = RigidTransform.from_components(-pose.apply(camera.center + camera_motion.translation), pose)
    cameras = list(scene.rig)
    cameras[camera_motion.camera] = replace(camera, camera_from_world=moved_pose)
    first, then = render_frames(scene), render_frames(replace(scene, rig=Rig(cameras, "m")))
    images = []
    for k, (one, other) in enumerate(zip(first, then, strict=True)):
        frame_images = list(one if k < camera_motion.frame else other)
        if k >= camera_motion.frame:
            frame_images[camera_motion.camera] = rotate_view(
                frame_images[camera_motion.camera], camera, apparent_rotation.inv().as_rotvec()
            )
        images.append(tuple(frame_images))
    return images


def track_scene(scene: Scene, camera_motion: CameraMotion) -> list[Track]:
    """Track the scene; return the input of the smoother."""
    no_values, truth = (None,) * len(scene.rig), compute_demo_truth(scene)
    frames = [
        FrameSet(k, k / 30, no_values, seen, no_values) for k, seen in enumerate(render_images(scene, camera_motion))
    ]
    return [
        Track.from_tracked(f) for f in track(frames, scene.rig, {name: Box(*box) for name, box in truth.boxes.items()})
    ]


def evaluate_scene(scene: Scene, camera_motion: CameraMotion) -> SceneResult:
    """Track, smooth and refine a scene and score the results."""
    tracks = track_scene(scene, camera_motion)
    smoothed, refined = (
        smooth_tracks(tracks, scene.rig, calibration_prior=default_calibration_prior(scene.rig), recalibrate=r)
        for r in (False, True)
    )
    poses = [t.pose for t in tracks]
    detections = {
        fault_match.groups() for pose in poses for fault in pose.faults if (fault_match := FAULT_PATTERN.match(fault))
    }
    inconsistent = find_disagreements(Trajectory(poses, scene.rig.names))
    angle, name_of_moved = np.degrees(camera_motion.rotation.magnitude()), f"cam_{camera_motion.camera}"
    moved_names = {name_of_moved} if angle or camera_motion.translation.any() else set()
    truth, refined_rig = compute_demo_truth(scene), scene.rig if refined.correction is None else refined.correction.rig
    return SceneResult(
        sorted(
            (int(frame) - MOTION_FRAME, float(fault_match) - angle)
            for name, frame, fault_match in detections
            if name == name_of_moved
        ),
        [d.first - MOTION_FRAME for d in inconsistent if d.camera == name_of_moved and d.first >= MOTION_FRAME],
        sum(name not in moved_names for name in [d.camera for d in inconsistent] + [name for name, _, _ in detections]),
        (
            score_poses(poses, scene.rig, truth),
            score_poses(smoothed.poses, scene.rig, truth),
            score_poses(refined.poses, refined_rig.subset(scene.rig.names), truth),
        ),
        compute_refined_errors(refined, camera_motion),
    )


def score_poses(poses: Sequence[FramePose], rig: Rig, truth: DemoTruth) -> PoseScores:
    """Score the poses after the motion in the world of the true rig."""
    kept = [p for p in poses if p.is_measured and p.world_from_object is not None and p.index >= MOTION_FRAME]
    found = RigidTransform.concatenate(
        [p.world_from_object for p in (poses[0], *kept) if p.world_from_object is not None]
    )
    true = RigidTransform.concatenate([truth.world_from_object[p.index] for p in (poses[0], *kept)])
    e = compute_pose_errors(found, rig, truth.rig, true)[1:]
    nees = [x @ np.linalg.solve(p.covariance, x) for x, p in zip(e, kept, strict=True)]
    return PoseScores(
        np.column_stack([np.degrees(np.linalg.norm(e[:, :3], axis=1)), 1e3 * np.linalg.norm(e[:, 3:], axis=1)]),
        np.array(nees),
    )


def compute_refined_errors(refined: SmoothedTrajectory, camera_motion: CameraMotion) -> FloatArray:
    """Compute `SceneResult.refined_errors` from the camera's last detected motion."""
    indices = [i for i, m in enumerate(refined.moved_cameras) if m.camera == camera_motion.camera]
    if refined.correction is None or not indices:
        return np.full(4, np.nan)
    i = len(refined.correction.values) - len(refined.moved_cameras) + indices[-1]
    values, sd = refined.correction.values[i, :6], refined.correction.sd[i, :6]
    estimated_rotation = Rotation.from_rotvec(refined.moved_cameras[indices[-1]].rotation) * Rotation.from_rotvec(
        values[:3]
    )
    errors = np.concatenate(
        [(camera_motion.rotation.inv() * estimated_rotation).as_rotvec(), values[3:] - camera_motion.translation]
    )
    parts, sizes = errors.reshape(2, 3), (errors / sd).reshape(2, 3)
    rotation_error, translation_error = np.linalg.norm(parts, axis=1)
    return np.array([np.degrees(rotation_error), 1e3 * translation_error, *np.sqrt((sizes**2).mean(axis=1))])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--degrees", type=float, nargs="+", default=[0.0, 0.5, 1.0, 2.0, 5.0, 10.0])
    parser.add_argument("--shift", type=float, nargs="+", default=[0.0], help="%% of the distance from the object")
    parser.add_argument("--background", type=float, default=2.0, help="distance in multiples of the object's")
    parser.add_argument("--still", action="store_true", help="keep the background static in the image")
    options = parser.parse_args()
    print(
        "| camera motion | detected by background | delay, frames | angle error, deg | inconsistent | false alarms | "
        "tracked: deg, mm, NEES | smoothed | refined | rotation error, deg (sd) | translation error, mm (sd) |"
    )
    print("|" + "---|" * 11)
    for degrees, percent in product(options.degrees, options.shift):
        runs = []
        for seed in range(options.first, options.first + options.seeds):
            scene = make_demo_scene(frames=FRAMES, angle_deg=TURN_DEG, size=SIZE, n_cameras=4, seed=seed)
            background = 0.0 if options.still else options.background
            runs.append(evaluate_scene(scene, draw_camera_motion(scene, seed % 4, degrees, percent / 100, background)))
        detections = [one for run in runs for one in run.detections]
        cells = [
            f"{degrees:g}°, {percent:g} %",
            f"{sum(bool(run.detections) for run in runs)} of {len(runs)}",
            ", ".join(str(late) for late, _ in detections),
            f"{max(abs(angle) for _, angle in detections):.2f}" if detections else "",
            f"{sum(bool((degrees or percent) and run.inconsistencies) for run in runs)}",
            f"{sum(run.n_false_alarms for run in runs)}",
        ]
        for scores in zip(*(run.poses for run in runs), strict=True):
            errors = np.concatenate([p.errors for p in scores])
            cells.append(
                f"{np.median(errors[:, 0]):.2f}, {errors[:, 0].max():.2f}; "
                f"{np.median(errors[:, 1]):.1f}, {errors[:, 1].max():.1f}; "
                + " ".join(f"{np.median(p.nees):.2g}" for p in scores)
            )
        refined_errors = [run.refined_errors for run in runs if np.isfinite(run.refined_errors).all()]
        cells += [" ".join(f"{s[j]:.2g} ({s[j + 2]:.1f})" for s in refined_errors) for j in (0, 1)]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
