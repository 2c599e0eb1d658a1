"""Is a camera that is bumped into named, and only that one, and how good are the poses afterwards? Rendered turns; one of
four cameras is turned about its centre, and shifted, from frame 25 on.

    python benchmarks/camera_motion.py [--seeds N] [--degrees 0 0.5 1 2 5 10] [--shift 0] [--background 2] [--still]

--shift is a percentage of the camera's distance from the object, which the background is behind, so many times as far away:
as the camera is shifted, it seems to be turned by a little more or less. With --still the background does not move with the
camera, as a screen behind the object that tells nothing.

Prints for each angle and shift in how many scenes the camera was named by its background
(`tracking/camera_motion_correction.py`), how many
frames after the bump the turn was said to begin and by how many degrees its angle was off; in how many it was found to
disagree with the others (`report/camera_consistency.py`); how often any other camera was named. Then, as tracked,
smoothed, and
with the calibration refined: the errors of the poses from the bump on, and the median of their NEES (should be about 6); and
by how much the refined turn and shift of that camera are off, in all and in standard deviations.
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

from benchmarks.calibration import pose_errors
from benchmarks.kinds_scenes import turned
from sylpose import FramePose, FrameSet, Rig, Trajectory
from sylpose.bundle_adjustment.calibration_refinement import usual_doubt
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.report.camera_consistency import disagreements
from sylpose.simulate import DemoTruth, Scene, demo_scene, demo_truth, render_frames
from sylpose.smoothing.trajectory import Smoothed, Track, smooth
from sylpose.tracking.tracker import track

FRAMES, BUMP, TURN_DEG, SIZE = 60, 25, 70.0, (320, 240)
SAID = re.compile(r"camera (\S+) was nudged at frame (\d+): the background turned by (\S+) degrees")


class Bump(NamedTuple):
    """What happens to a camera at a frame: a turn, camera's axes, and a shift of its centre (3,), world's axes; and how far
    away from it the background is, length units, 0: it does not move with the camera."""

    camera: int
    turn: Rotation
    shift: FloatArray
    background: float
    frame: int = BUMP


class Scored(NamedTuple):
    """(n, 2) degrees and millimetres of the poses from the bump on, and (n,) their NEES."""

    errors: FloatArray
    nees: FloatArray


class Bumped(NamedTuple):
    """What came of it: frames after the bump and degrees said of the right camera, frames after which it disagreed, how
    often another was named; the poses as tracked, smoothed and refined; and (4,) degrees and millimetres that the refined
    turn and shift are off, and the same in standard deviations, NaN where the camera was not named."""

    named: list[tuple[int, float]]
    disagrees: list[int]
    others: int
    poses: tuple[Scored, Scored, Scored]
    stands: FloatArray


def bump_of(scene: Scene, camera: int, degrees: float, share: float, background: float) -> Bump:
    """By so many degrees about an axis of its own, and by a share of the camera's distance from the object."""
    rng, center = np.random.default_rng(scene.seed), scene.rig.cameras[camera].center
    axis, way = rng.normal(size=(2, 3))
    far = float(np.linalg.norm(center - scene.poses()[0].translation))
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
    return Bump(camera, turn, share * far * way / np.linalg.norm(way), background * far)


def images_of(scene: Scene, bump: Bump) -> list[tuple[Image, ...]]:
    """The scene's images, with a camera that is bumped into."""
    before = scene.rig.cameras[bump.camera]
    if bump.background:
        # What is at that depth behind the camera's middle moves by its shift as by a turn.
        aside = np.cross(before.rotation @ bump.shift, [0.0, 0.0, 1.0]) / bump.background
        seen = bump.turn * Rotation.from_rotvec(aside)
    else:
        seen = Rotation.identity()
    # Rendered before a background that stands still, then turned as a whole.
    pose = seen.inv() * bump.turn * before.camera_from_world.rotation
    place = RigidTransform.from_components(-pose.apply(before.center + bump.shift), pose)
    cameras = list(scene.rig)
    cameras[bump.camera] = replace(before, camera_from_world=place)
    first, then = render_frames(scene), render_frames(replace(scene, rig=Rig(cameras, "m")))
    images = []
    for k, (one, other) in enumerate(zip(first, then, strict=True)):
        now = list(one if k < bump.frame else other)
        if k >= bump.frame:
            now[bump.camera] = turned(now[bump.camera], before, seen.inv().as_rotvec())
        images.append(tuple(now))
    return images


def tracked(scene: Scene, bump: Bump) -> list[Track]:
    """Of every frame what smoothing needs."""
    nothing, truth = (None,) * len(scene.rig), demo_truth(scene)
    frames = [FrameSet(k, k / 30, nothing, seen, nothing) for k, seen in enumerate(images_of(scene, bump))]
    return [Track.of(f) for f in track(frames, scene.rig, {name: Box(*box) for name, box in truth.boxes.items()})]


def bumped(scene: Scene, bump: Bump) -> Bumped:
    """Tracked, smoothed and refined."""
    tracks = tracked(scene, bump)
    smoothed, refined = (smooth(tracks, scene.rig, doubt=usual_doubt(scene.rig), recalibrate=r) for r in (False, True))
    poses = [t.pose for t in tracks]
    found = {said.groups() for pose in poses for fault in pose.faults if (said := SAID.match(fault))}
    doubted = disagreements(Trajectory(poses, scene.rig.names))
    angle, mine = np.degrees(bump.turn.magnitude()), f"cam_{bump.camera}"
    right = {mine} if angle or bump.shift.any() else set()
    truth, now = demo_truth(scene), scene.rig if refined.correction is None else refined.correction.rig
    return Bumped(
        sorted((int(frame) - BUMP, float(said) - angle) for name, frame, said in found if name == mine),
        [d.first - BUMP for d in doubted if d.camera == mine and d.first >= BUMP],
        sum(name not in right for name in [d.camera for d in doubted] + [name for name, _, _ in found]),
        (
            scored(poses, scene.rig, truth),
            scored(smoothed.poses, scene.rig, truth),
            scored(refined.poses, now.subset(scene.rig.names), truth),
        ),
        stands(refined, bump),
    )


def scored(poses: Sequence[FramePose], rig: Rig, truth: DemoTruth) -> Scored:
    """Of the poses from the bump on, in the world of the true rig."""
    kept = [p for p in poses if p.measured and p.world_from_object is not None and p.index >= BUMP]
    found = RigidTransform.concatenate(
        [p.world_from_object for p in (poses[0], *kept) if p.world_from_object is not None]
    )
    true = RigidTransform.concatenate([truth.world_from_object[p.index] for p in (poses[0], *kept)])
    e = pose_errors(found, rig, truth.rig, true)[1:]
    nees = [x @ np.linalg.solve(p.covariance, x) for x, p in zip(e, kept, strict=True)]
    return Scored(
        np.column_stack([np.degrees(np.linalg.norm(e[:, :3], axis=1)), 1e3 * np.linalg.norm(e[:, 3:], axis=1)]),
        np.array(nees),
    )


def stands(refined: Smoothed, bump: Bump) -> FloatArray:
    """As `Bumped.stands`, of the last time that the camera was moved."""
    which = [i for i, m in enumerate(refined.moved) if m.camera == bump.camera]
    if refined.correction is None or not which:
        return np.full(4, np.nan)
    i = len(refined.correction.values) - len(refined.moved) + which[-1]
    values, sd = refined.correction.values[i, :6], refined.correction.sd[i, :6]
    moved = Rotation.from_rotvec(refined.moved[which[-1]].turn) * Rotation.from_rotvec(values[:3])
    off = np.concatenate([(bump.turn.inv() * moved).as_rotvec(), values[3:] - bump.shift])
    parts, sizes = off.reshape(2, 3), (off / sd).reshape(2, 3)
    turn, shift = np.linalg.norm(parts, axis=1)
    return np.array([np.degrees(turn), 1e3 * shift, *np.sqrt((sizes**2).mean(axis=1))])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--first", type=int, default=0, help="seed to begin with")
    parser.add_argument("--degrees", type=float, nargs="+", default=[0.0, 0.5, 1.0, 2.0, 5.0, 10.0])
    parser.add_argument("--shift", type=float, nargs="+", default=[0.0], help="%% of the distance from the object")
    parser.add_argument("--background", type=float, default=2.0, help="times as far away as the object")
    parser.add_argument("--still", action="store_true", help="the background does not move with the camera")
    options = parser.parse_args()
    print(
        "| bumped by | named | frames after | angle off, degrees | disagrees | others named | tracked: degrees, mm, NEES | "
        "smoothed | refined | turn off: degrees, sd | shift off: mm, sd |"
    )
    print("|" + "---|" * 11)
    for degrees, percent in product(options.degrees, options.shift):
        runs = []
        for seed in range(options.first, options.first + options.seeds):
            scene = demo_scene(frames=FRAMES, turn_deg=TURN_DEG, size=SIZE, n_cameras=4, seed=seed)
            behind = 0.0 if options.still else options.background
            runs.append(bumped(scene, bump_of(scene, seed % 4, degrees, percent / 100, behind)))
        said = [one for run in runs for one in run.named]
        cells = [
            f"{degrees:g}°, {percent:g} %",
            f"{sum(bool(run.named) for run in runs)} of {len(runs)}",
            ", ".join(str(late) for late, _ in said),
            f"{max(abs(angle) for _, angle in said):.2f}" if said else "",
            f"{sum(bool((degrees or percent) and run.disagrees) for run in runs)}",
            f"{sum(run.others for run in runs)}",
        ]
        for which in zip(*(run.poses for run in runs), strict=True):
            off = np.concatenate([p.errors for p in which])
            cells.append(
                f"{np.median(off[:, 0]):.2f}, {off[:, 0].max():.2f}; {np.median(off[:, 1]):.1f}, {off[:, 1].max():.1f}; "
                + " ".join(f"{np.median(p.nees):.2g}" for p in which)
            )
        stood = [run.stands for run in runs if np.isfinite(run.stands).all()]
        cells += [" ".join(f"{s[j]:.2g} ({s[j + 2]:.1f})" for s in stood) for j in (0, 1)]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
