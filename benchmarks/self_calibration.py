"""Extrinsics of rigs that calibrate themselves from a tumbling object: rendered, seeded recordings with known truth.

    python benchmarks/self_calibration.py [--kinds KIND ...] [--seeds N] [--first N]

Prints for each recording the errors of the worst camera in degrees and in percent of the distance to the object (after
fitting the scale), its stated standard deviations, the largest error of any component in standard deviations, and what
was left out or refused; for each kind the share of accepted recordings, and of cameras within three standard deviations.
Kinds marked "refused" must be refused: their motion does not determine the rig.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import Image
from sylpose.rig import Camera, Rig, intersect_rays
from sylpose.rig_calibration.camera_tracks import RefinedTrack, refine_track, track_alone
from sylpose.rig_calibration.from_motion import MotionCalibration, calibrate_from_motion
from sylpose.rig_calibration.relative_motions import MotionRefusedError
from sylpose.runs.precompile import compile_all
from sylpose.simulate import Actor, Scene, arc, compute_demo_truth, render_frames
from sylpose.simulate.recordings import FRAME_RATE, OBJECT_SHARE
from sylpose.simulate.render import chamfered_box

SIZE, DISTANCE = (640, 480), 1.2
SIDES = np.array([1.0, 0.74, 0.86])


@dataclass(frozen=True)
class Kind:
    """Kind of recording.

    Attributes:
        cameras, spacing_deg: number of cameras on an arc, and the angle between neighbors.
        frames: number of frames.
        angle_deg: length of the path of rotations.
        carried: extent of the path of positions, relative to the object's length.
        one_axis: whether the object rotates about one axis only.
        sides: of the object, relative to its length.
        focal_error: relative error of all focal lengths given.
        wrong_camera: whether camera 1 observes another object.
        late_frames: frames that camera 1 lacks at the beginning; it then has no box.
        is_refused: whether the motion does not determine the rig.
    """

    cameras: int = 4
    spacing_deg: float = 40.0
    frames: int = 75
    angle_deg: float = 300.0
    carried: float = 1.0
    one_axis: bool = False
    sides: tuple[float, float, float] = (1.0, 0.74, 0.86)
    focal_error: float = 0.0
    wrong_camera: bool = False
    late_frames: int = 0
    is_refused: bool = False


KINDS = {
    "near": Kind(),
    "far": Kind(spacing_deg=90.0),
    "opposite": Kind(cameras=2, spacing_deg=180.0),
    "little": Kind(angle_deg=40.0),
    "planar": Kind(angle_deg=150.0, sides=(1.0, 0.8, 0.05)),
    "focal": Kind(focal_error=0.05),
    "wrong": Kind(wrong_camera=True),
    "late": Kind(late_frames=25),
    "axis": Kind(one_axis=True, is_refused=True),
    "place": Kind(carried=0.0, is_refused=True),
}


def draw_smooth_path(rng: np.random.Generator) -> Callable[[float], np.ndarray]:
    """Return a smooth random curve of three coordinates over [0, 1]: four harmonics."""
    k = np.arange(1, 5)
    sines, cosines = rng.normal(size=(2, 4, 3)) / k[:, None]
    return lambda s: np.sin(np.pi * k * s) @ sines + (np.cos(np.pi * k * s) - 1.0) @ cosines


def make_scene(kind: Kind, seed: int) -> Scene:
    """Build a scene: a textured block that tumbles about changing axes and is carried about."""
    rng = np.random.default_rng([seed, 77])
    heights = rng.uniform(-0.3, 0.5, kind.cameras)
    rig = arc(kind.cameras, kind.spacing_deg, DISTANCE, 1.3 * max(SIZE), SIZE, height=heights)
    target = intersect_rays([c.center for c in rig], [c.direction for c in rig])
    resolution = np.array([c.focal / c.camera_from_world.apply(target)[2] for c in rig]).max()
    length = OBJECT_SHARE * min(SIZE) / resolution
    body = chamfered_box(length * np.array(kind.sides), 1.25 * resolution, seed=seed)
    turning, carrying = draw_smooth_path(rng), draw_smooth_path(rng)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    s = np.linspace(0.0, 1.0, 400)
    velocity = np.tile(axis, (len(s), 1)) if kind.one_axis else axis + np.array([0.8 * turning(x) for x in s])
    velocity *= np.radians(kind.angle_deg) / np.linalg.norm(velocity, axis=1).mean()
    rotations = [Rotation.identity()]
    for step in velocity[1:] / (len(s) - 1):
        rotations.append(Rotation.from_rotvec(step) * rotations[-1])
    rotation = Slerp(s, Rotation.concatenate(rotations))
    places = np.array([carrying(x) for x in s])
    places -= places.mean(axis=0)
    places *= 0.5 * kind.carried * length / np.abs(places).max()

    def path(frame: float) -> RigidTransform:
        x = float(np.clip(frame / (kind.frames - 1), 0.0, 1.0))
        return RigidTransform.from_components(target + [np.interp(x, s, column) for column in places.T], rotation(x))

    return Scene(rig, (Actor(body, path),), kind.frames, seed)


def track_scene(kind: Kind, seed: int) -> tuple[Rig, list[Camera], list[RefinedTrack | None], float]:
    """Return the true rig, the cameras as given, their tracks, and the first camera's distance from the object."""
    scene = make_scene(kind, seed)
    truth, images = compute_demo_truth(scene), list(render_frames(scene))
    other = make_scene(kind, seed + 1000)
    wrong = list(render_frames(replace(other, rig=scene.rig))) if kind.wrong_camera else images
    cameras, tracks = [], []
    for c, camera in enumerate(scene.rig):
        matrix = camera.matrix.copy()
        matrix[[0, 1], [0, 1]] *= 1.0 + kind.focal_error
        cameras.append(replace(camera, matrix=matrix))
        its: list[Image] = [frame[c] for frame in (wrong if c == 1 else images)]
        first = kind.late_frames if c == 1 else 0
        boxes = (compute_demo_truth(replace(other, rig=scene.rig)) if kind.wrong_camera and c == 1 else truth).boxes
        box = None if first or camera.name not in boxes else Box(*boxes[camera.name])
        frames = [replace(FrameSet.of([image], k / FRAME_RATE), index=k) for k, image in enumerate(its)][first:]
        tracks.append(refine_track(track_alone(frames, cameras[-1], box), cameras[-1]))
    distance = np.linalg.norm(scene.rig[0].camera_from_world.apply(truth.world_from_object.translation[0]))
    return scene.rig, cameras, tracks, float(distance)


def measure_errors(found: MotionCalibration, truth: Rig, distance: float) -> np.ndarray:
    """Return (C - 1, 5) errors of all cameras but the first: degrees and their sd, percent and their sd, worst z."""
    rig, first = found.calibration.rig, truth[found.calibration.rig[0].name].camera_from_world
    true_poses = [truth[camera.name].camera_from_world * first.inv() for camera in rig]
    expected, centers = np.array([p.inv().translation for p in true_poses]), np.array([c.center for c in rig])
    scale = (expected * centers).sum() / (centers**2).sum()
    rows = []
    for c in range(1, len(rig)):
        covariance, R = found.calibration.extrinsics_covariance[c], rig[c].rotation
        w = (true_poses[c].rotation * rig[c].camera_from_world.rotation.inv()).as_rotvec()
        d = true_poses[c].translation / scale - rig[c].camera_from_world.translation
        # Rotations and translations of camera_from_world go together; of its center, only places count.
        J = np.hstack([-R.T @ np.cross(np.eye(3), rig[c].camera_from_world.translation), -R.T])
        place, place_covariance = expected[c] / scale - centers[c], J @ covariance @ J.T
        z = np.abs(np.concatenate([w, d])) / np.sqrt(np.diag(covariance))
        sds = np.sqrt(np.trace(covariance[:3, :3])), np.sqrt(np.trace(place_covariance))
        share = 100.0 * scale / distance
        rows.append(
            [np.degrees(np.linalg.norm(w)), np.degrees(sds[0]), share * np.linalg.norm(place), share * sds[1], z.max()]
        )
    return np.array(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=[*KINDS], default=[*KINDS])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    args = parser.parse_args()
    compile_all()
    print("recording       degrees     sd   percent     sd  worst z  seconds  remarks")
    for name in args.kinds:
        kind, accepted, z = KINDS[name], 0, list[float]()
        for seed in range(args.first, args.first + args.seeds):
            began = time.perf_counter()
            truth, cameras, tracks, distance = track_scene(kind, seed)
            remark, numbers = "", "      -      -         -      -        -"
            try:
                found = calibrate_from_motion(cameras, tracks)
            except MotionRefusedError as error:
                remark = f"refused: {error.tests[-1].name}, {error.tests[-1].value}"
            else:
                accepted += 1
                errors = measure_errors(found, truth, distance)
                z += errors[:, 4].tolist()
                worst = errors.max(axis=0)
                numbers = f"{worst[0]:7.3f}{worst[1]:7.3f}{worst[2]:10.3f}{worst[3]:7.3f}{worst[4]:9.1f}"
                remark = "; ".join([*found.left_out, *found.freed])
            wrong = "WRONG " if kind.is_refused != remark.startswith("refused") else ""
            print(f"{name}:{seed:<10}{numbers}{time.perf_counter() - began:9.1f}  {wrong}{remark}", flush=True)
        within = f", {np.mean(np.array(z) < 3.0):.0%} of their cameras within 3 sd" if z else ""
        print(f"{name}: {accepted} of {args.seeds} accepted{within}", flush=True)


if __name__ == "__main__":
    main()
