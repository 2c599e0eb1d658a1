"""Uncertainty of the translation length without rotation: slides, rotations and mixtures with known truth.

    python benchmarks/translation_only.py [--seeds 8] [--rendered] [--frames 20]

Bodies of several shapes slide in eight directions, rotate, or do both, in front of two to four cameras. Their tracks are
simulated; with --rendered, images of a block are tracked. The given radius is 0.7, 1 and 1.5 times the true one, and the
origin has an error. Each row gives the mean and the largest NEES of the last pose relative to the first one (six degrees of
freedom, mean 6 for a consistent covariance), the error of the path's length, and `length_sd`.
"""

from __future__ import annotations

import argparse
from itertools import product

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import FrameSet, track
from sylpose.bundle_adjustment.bundle import BundleResult, Observations
from sylpose.bundle_adjustment.scale_prior import bundle_adjust_with_scale
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import Actor, Scene, arc, box, chamfered_box, compute_demo_truth, ellipsoid, render_frames, ring
from sylpose.simulate.bodies import Body
from sylpose.smoothing import Track, smooth_tracks

BODIES = {
    "ellipsoid": ellipsoid((0.15, 0.1, 0.12)),
    "box": box((0.24, 0.18, 0.2)),
    "board": box((0.3, 0.2, 0.01)),
    "rod": box((0.3, 0.05, 0.05)),
}
RIGS = {
    "ring of 4": ring(4, 1.5, 1000.0, height=(0.4, -0.1, 0.2, 0.5)),
    "3 in 60°": arc(3, 30.0, 1.5, 1000.0, height=(0.2, -0.2, 0.1)),
    "2 in 40°": arc(2, 40.0, 1.5, 1000.0, height=(0.2, -0.1)),
}
DIRECTIONS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [1, 1, 0], [1, 0, 1], [1, -1, 1]])
# Length of each motion, and its rotation in degrees (choice).
MOTIONS = {"slide": (0.22, 0.0), "2°": (0.22, 2.0), "mixture": (0.22, 15.0), "turn": (0.0, 30.0)}
RADIUS_FACTORS = (0.7, 1.0, 1.5)
# Standard deviation of the origin's error per axis, in radii, since boxes are inexact (choice).
ORIGIN_ERROR = 0.1


def simulate_poses(frames: int, direction: FloatArray, motion: str) -> RigidTransform:
    """Return the poses of a motion, starting at the identity."""
    length, degrees = MOTIONS[motion]
    s = np.linspace(0.0, 1.0, frames)[:, None]
    axis = np.array([0.3, 0.9, 0.2]) / np.linalg.norm([0.3, 0.9, 0.2])
    return RigidTransform.from_components(
        s * length * direction / np.linalg.norm(direction), Rotation.from_rotvec(np.deg2rad(degrees) * s * axis)
    )


def simulate_tracks(body: Body, poses: RigidTransform, rig: Rig, n: int, noise_px: float, seed: int) -> Observations:
    """Simulate the observations of `n` features per camera, which are tracked while they are visible."""
    rng, rows, images, count = np.random.default_rng(seed), [], [], 0
    points, normals = body.points.copy(), body.normals.copy()
    for c, camera in enumerate(rig):
        active: list[tuple[int, int]] = []
        for k, pose in enumerate(poses):
            world = pose.apply(points)
            to_camera = camera.center - world
            facing = np.einsum("ni,ni->n", pose.rotation.apply(normals), to_camera)
            visible = facing > 0.2 * np.linalg.norm(to_camera, axis=1)
            active = [(i, b) for i, b in active if visible[b] and rng.random() > 0.02]
            candidates = np.flatnonzero(visible)
            for b in rng.choice(candidates, min(n - len(active), len(candidates)), replace=False):
                active.append((count, int(b)))
                count += 1
            if not active:
                continue
            camera_points = camera.camera_from_world.apply(world[[b for _, b in active]])
            rows += [(k, c, i) for i, _ in active]
            images.append(
                camera_points[:, :2] / camera_points[:, 2:]
                + noise_px / camera.focal * rng.standard_normal((len(active), 2))
            )
    frame, camera_index, landmark = np.array(rows).T
    return Observations(frame, camera_index, landmark, np.concatenate(images))


def compute_pose_error(truth: RigidTransform, found: RigidTransform) -> FloatArray:
    """Return the pose error (6,): rotation vector, translation."""
    return np.concatenate([(truth.rotation * found.rotation.inv()).as_rotvec(), truth.translation - found.translation])


def format_row(name: str, results: list[tuple[float, float, float, float]]) -> str:
    """Format a table row from results (NEES, relative error of the length, length_sd, length_share)."""
    nees, length_errors, sd, share = np.array(results).T
    return (
        f"| {name} | {nees.mean():.1f} | {nees.max():.1f} | {100 * np.sqrt((length_errors**2).mean()):.2f} "
        f"| {100 * np.median(sd):.2f} | {np.median(share):.2f} |"
    )


def evaluate_pose(
    truth: RigidTransform, found: RigidTransform, covariance: FloatArray, length_sd: float, share: float
) -> tuple[float, float, float, float]:
    """Return the NEES of a pose, the relative error of its translation, and the reported `length_sd` and share."""
    e, d = compute_pose_error(truth, found), truth.translation
    length = float(np.linalg.norm(d))
    length_error = float(found.translation @ d) / length**2 - 1.0 if length > 1e-9 else np.nan
    return float(e @ np.linalg.solve(covariance, e)), length_error, length_sd, share


def refine_simulated(
    name: str, rig: Rig, motion: str, direction: FloatArray, factor: float, seed: int, frames: int
) -> BundleResult:
    """Simulate tracks and refine them, starting from perturbed poses."""
    rng, body = np.random.default_rng(seed), BODIES[name]
    rotation = Rotation.random(rng=rng)
    body = Body(rotation.apply(body.points.copy()), rotation.apply(body.normals.copy()))
    body = Body(body.points + ORIGIN_ERROR * body.radius * rng.standard_normal(3), body.normals)
    truth = simulate_poses(frames, direction, motion)
    perturbation = np.vstack([np.zeros((1, 6)), rng.standard_normal((frames - 1, 6)) * np.repeat([0.005, 0.003], 3)])
    start = RigidTransform.from_components(
        truth.translation + perturbation[:, 3:], Rotation.from_rotvec(perturbation[:, :3]) * truth.rotation
    )
    return bundle_adjust_with_scale(rig, simulate_tracks(body, truth, rig, 60, 0.4, seed), start, factor * body.radius)


def refine_rendered(
    direction: FloatArray, motion: str, factor: float, seed: int, frames: int
) -> list[tuple[float, float, float, float]]:
    """Track and smooth rendered images of a block."""
    size = (320, 240)
    rig = arc(4, 40.0, 1.2, 320.0, size, height=(0.3, -0.1, 0.2, 0.1))
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    poses = simulate_poses(frames, direction, motion) * RigidTransform.from_rotation(rotation)
    body = chamfered_box(np.array([0.24, 0.18, 0.2]), 400.0, seed=seed)
    middle = 0.5 * poses[-1].translation

    def body_path(frame: float) -> RigidTransform:
        pose = poses[int(np.clip(round(frame), 0, frames - 1))]
        return RigidTransform.from_components(pose.translation - middle, pose.rotation)

    scene = Scene(rig, (Actor(body, body_path),), frames, seed)
    truth = compute_demo_truth(scene)
    boxes = {}
    for name, (x, y, w, h) in truth.boxes.items():
        boxes[name] = Box(
            round(x + 0.5 * w * (1 - factor)), round(y + 0.5 * h * (1 - factor)), round(factor * w), round(factor * h)
        )
    no_values = (None,) * len(rig)
    sets = [FrameSet(k, k / 30, no_values, images, no_values) for k, images in enumerate(render_frames(scene))]
    found = smooth_tracks([Track.from_tracked(f) for f in track(sets, rig, boxes)], rig)
    last, first = found.poses[-1], found.poses[0].world_from_object
    if last.world_from_object is None or first is None:
        return []
    true_motion = truth.world_from_object[-1] * truth.world_from_object[0].inv()
    true_pose = true_motion * first
    e = compute_pose_error(true_pose, last.world_from_object)
    d = true_pose.translation - first.translation
    length = float(d @ d)
    length_error = (
        float((last.world_from_object.translation - first.translation) @ d) / length - 1.0 if length > 1e-9 else np.nan
    )
    return [(float(e @ np.linalg.solve(last.covariance, e)), length_error, found.scale_sd, found.scale_variance_ratio)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--rendered", action="store_true")
    parser.add_argument("--motions", nargs="+", default=list(MOTIONS), choices=list(MOTIONS))
    options = parser.parse_args()
    print("| motion | NEES: mean | NEES: max | length error, RMS % | length_sd, % | length_share |")
    print("|---|---|---|---|---|---|")
    for motion in options.motions:
        if options.rendered:
            for factor in RADIUS_FACTORS:
                results: list[tuple[float, float, float, float]] = []
                for seed, direction in product(range(options.seeds), DIRECTIONS):
                    results += refine_rendered(direction, motion, factor, seed, options.frames)
                print(format_row(f"{motion}, block, boxes x {factor}", results), flush=True)
            continue
        for (rig_name, rig), name in product(RIGS.items(), BODIES):
            results = []
            for seed, (i, direction), factor in product(range(options.seeds), enumerate(DIRECTIONS), RADIUS_FACTORS):
                found = refine_simulated(name, rig, motion, direction, factor, 100 * seed + i, options.frames)
                truth = simulate_poses(options.frames, direction, motion)[-1]
                results.append(
                    evaluate_pose(
                        truth,
                        found.world_from_object[-1],
                        found.covariance[-1],
                        found.scale_sd,
                        found.scale_variance_ratio,
                    )
                )
            print(format_row(f"{motion}, {rig_name}, {name}", results), flush=True)


if __name__ == "__main__":
    main()
