"""Is the length of a motion without turns as uncertain as the smoothed poses say? Slides, turns and mixtures of known truth.

    python benchmarks/translation_only.py [--seeds 8] [--rendered] [--frames 20]

Bodies of several shapes slide in eight directions, turn, or do both, in front of two to four cameras. Their tracks are
simulated (or, with --rendered, images of a block are tracked), the radius told is right, 0.7 and 1.5 times what it is, and
the origin is off by some of it. For each row: the mean and the worst NEES of the last pose since the first one (six degrees
of freedom: 6 on average if the covariance is right), the error of the path's length and what `length_sd` says of it.
"""

from __future__ import annotations

import argparse
from itertools import product

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import FrameSet, track
from sylpose.bundle_adjustment.bundle import Bundled, Observations
from sylpose.bundle_adjustment.scale_prior import bundle_sized
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import Actor, Scene, arc, box, chamfered_box, demo_truth, ellipsoid, render_frames, ring
from sylpose.simulate.bodies import Body
from sylpose.smoothing.trajectory import Track, smooth

BODIES = {
    "ellipsoid": ellipsoid((0.15, 0.1, 0.12)),
    "box": box((0.24, 0.18, 0.2)),
    "board": box((0.3, 0.2, 0.01)),
    "rod": box((0.3, 0.05, 0.05)),
}
RIGS = {
    "4 around": ring(4, 1.5, 1000.0, height=(0.4, -0.1, 0.2, 0.5)),
    "3 in 60°": arc(3, 30.0, 1.5, 1000.0, height=(0.2, -0.2, 0.1)),
    "2 in 40°": arc(2, 40.0, 1.5, 1000.0, height=(0.2, -0.1)),
}
DIRECTIONS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [1, 1, 0], [1, 0, 1], [1, -1, 1]])
# How far each motion goes, and by how much it turns, degrees (choice).
MOTIONS = {"slide": (0.22, 0.0), "2°": (0.22, 2.0), "mixture": (0.22, 15.0), "turn": (0.0, 30.0)}
RADII = (0.7, 1.0, 1.5)
# The origin is off by so much of the radius in each direction, one standard deviation: boxes are not exact (choice).
ORIGIN_OFF = 0.1


def path(frames: int, direction: FloatArray, motion: str) -> RigidTransform:
    """Poses from the identity on."""
    length, degrees = MOTIONS[motion]
    s = np.linspace(0.0, 1.0, frames)[:, None]
    axis = np.array([0.3, 0.9, 0.2]) / np.linalg.norm([0.3, 0.9, 0.2])
    return RigidTransform.from_components(
        s * length * direction / np.linalg.norm(direction), Rotation.from_rotvec(np.deg2rad(degrees) * s * axis)
    )


def tracks(body: Body, poses: RigidTransform, rig: Rig, n: int, noise_px: float, seed: int) -> Observations:
    """What each camera sees of its own n features, which last as long as they are visible."""
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
            free = np.flatnonzero(visible)
            for b in rng.choice(free, min(n - len(active), len(free)), replace=False):
                active.append((count, int(b)))
                count += 1
            if not active:
                continue
            seen = camera.camera_from_world.apply(world[[b for _, b in active]])
            rows += [(k, c, i) for i, _ in active]
            images.append(seen[:, :2] / seen[:, 2:] + noise_px / camera.focal * rng.standard_normal((len(active), 2)))
    frame, seen_by, landmark = np.array(rows).T
    return Observations(frame, seen_by, landmark, np.concatenate(images))


def error(truth: RigidTransform, found: RigidTransform) -> FloatArray:
    """(6,) of (w, d)."""
    return np.concatenate([(truth.rotation * found.rotation.inv()).as_rotvec(), truth.translation - found.translation])


def row_of(name: str, results: list[tuple[float, float, float, float]]) -> str:
    """One line of the table, of (NEES, relative error of the length, length_sd, length_share)."""
    nees, off, sd, share = np.array(results).T
    return (
        f"| {name} | {nees.mean():.1f} | {nees.max():.1f} | {100 * np.sqrt((off**2).mean()):.2f} "
        f"| {100 * np.median(sd):.2f} | {np.median(share):.2f} |"
    )


def judged(
    truth: RigidTransform, found: RigidTransform, covariance: FloatArray, length_sd: float, share: float
) -> tuple[float, float, float, float]:
    """NEES of a pose, the relative error of its displacement, and what was said of it."""
    e, d = error(truth, found), truth.translation
    length = float(np.linalg.norm(d))
    off = float(found.translation @ d) / length**2 - 1.0 if length > 1e-9 else np.nan
    return float(e @ np.linalg.solve(covariance, e)), off, length_sd, share


def simulated(
    name: str, rig: Rig, motion: str, direction: FloatArray, factor: float, seed: int, frames: int
) -> Bundled:
    """The refinement of simulated tracks, begun from disturbed poses."""
    rng, body = np.random.default_rng(seed), BODIES[name]
    turned = Rotation.random(rng=rng)
    body = Body(turned.apply(body.points.copy()), turned.apply(body.normals.copy()))
    body = Body(body.points + ORIGIN_OFF * body.radius * rng.standard_normal(3), body.normals)
    truth = path(frames, direction, motion)
    shake = np.vstack([np.zeros((1, 6)), rng.standard_normal((frames - 1, 6)) * np.repeat([0.005, 0.003], 3)])
    start = RigidTransform.from_components(
        truth.translation + shake[:, 3:], Rotation.from_rotvec(shake[:, :3]) * truth.rotation
    )
    return bundle_sized(rig, tracks(body, truth, rig, 60, 0.4, seed), start, factor * body.radius)


def rendered(
    direction: FloatArray, motion: str, factor: float, seed: int, frames: int
) -> list[tuple[float, float, float, float]]:
    """A block's images, tracked and smoothed."""
    size = (320, 240)
    rig = arc(4, 40.0, 1.2, 320.0, size, height=(0.3, -0.1, 0.2, 0.1))
    turned = Rotation.random(rng=np.random.default_rng(seed))
    poses = path(frames, direction, motion) * RigidTransform.from_rotation(turned)
    body = chamfered_box(np.array([0.24, 0.18, 0.2]), 400.0, seed=seed)
    middle = 0.5 * poses[-1].translation

    def at(frame: float) -> RigidTransform:
        pose = poses[int(np.clip(round(frame), 0, frames - 1))]
        return RigidTransform.from_components(pose.translation - middle, pose.rotation)

    scene = Scene(rig, (Actor(body, at),), frames, seed)
    truth = demo_truth(scene)
    boxes = {}
    for name, (x, y, w, h) in truth.boxes.items():
        boxes[name] = Box(
            round(x + 0.5 * w * (1 - factor)), round(y + 0.5 * h * (1 - factor)), round(factor * w), round(factor * h)
        )
    nothing = (None,) * len(rig)
    sets = [FrameSet(k, k / 30, nothing, images, nothing) for k, images in enumerate(render_frames(scene))]
    found = smooth([Track.of(f) for f in track(sets, rig, boxes)], rig)
    last, first = found.poses[-1], found.poses[0].world_from_object
    if last.world_from_object is None or first is None:
        return []
    moved = truth.world_from_object[-1] * truth.world_from_object[0].inv()
    whole = moved * first
    e = error(whole, last.world_from_object)
    d = whole.translation - first.translation
    length = float(d @ d)
    off = (
        float((last.world_from_object.translation - first.translation) @ d) / length - 1.0 if length > 1e-9 else np.nan
    )
    return [(float(e @ np.linalg.solve(last.covariance, e)), off, found.length_sd, found.length_share)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--rendered", action="store_true")
    parser.add_argument("--motions", nargs="+", default=list(MOTIONS), choices=list(MOTIONS))
    options = parser.parse_args()
    print("| what | NEES mean | worst | length off, % rms | length_sd, % | share |")
    print("|---|---|---|---|---|---|")
    for motion in options.motions:
        if options.rendered:
            for factor in RADII:
                results: list[tuple[float, float, float, float]] = []
                for seed, direction in product(range(options.seeds), DIRECTIONS):
                    results += rendered(direction, motion, factor, seed, options.frames)
                print(row_of(f"{motion}, block, boxes x {factor}", results), flush=True)
            continue
        for (where, rig), name in product(RIGS.items(), BODIES):
            results = []
            for seed, (i, direction), factor in product(range(options.seeds), enumerate(DIRECTIONS), RADII):
                found = simulated(name, rig, motion, direction, factor, 100 * seed + i, options.frames)
                truth = path(options.frames, direction, motion)[-1]
                results.append(
                    judged(
                        truth, found.world_from_object[-1], found.covariance[-1], found.length_sd, found.length_share
                    )
                )
            print(row_of(f"{motion}, {where}, {name}", results), flush=True)


if __name__ == "__main__":
    main()
