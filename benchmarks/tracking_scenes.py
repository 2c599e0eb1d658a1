"""Rendered sequences of the tracking benchmark, with known truth.

    python benchmarks/tracking_scenes.py NAME FOLDER [--frames N]

Writes one sequence as a session: videos, calibration.toml, boxes.toml (a table per object if there are two), and
timestamps.csv if the cameras have different times. The truth consists of:

- groundtruth.tum and dataset.toml, as `sylpose.simulate` writes them;
- vertices.txt, the body's corners in the object's frame;
- visible.csv, the share of these corners that each camera sees in each frame;
- true_offsets.toml for cameras with clock offsets, in seconds, positive for a delay.

With two objects, the names of these files contain _OBJECT.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.rendered_recordings import Recording, write_recording
from benchmarks.tracking_paths import Path as Motion
from benchmarks.tracking_paths import (
    bump_profile,
    compute_excursion,
    make_closed_path,
    make_straight_path,
    make_tumbling_path,
    smooth_window,
    swing_profile,
)
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, Rig
from sylpose.simulate import Actor, Scene, TexturedBody, arc, chamfered_box

__all__ = ["BUILDERS", "build_recording", "render_recording"]


SIZE = (640, 480)
DISTANCE = 1.5
OBJECT = 0.3
# The object's longest side spans 45 % of the image height.
FOCAL = 0.45 * SIZE[1] * DISTANCE / OBJECT
TEXELS = 1.25 * FOCAL / DISTANCE
# Mild barrel distortion, as of webcams.
LENSES = ((-0.11, 0.03, 0.0004, -0.0003, 0), (-0.08, 0.01, -0.0005, 0.0002, 0), (-0.13, 0.04, 0.0002, 0.0006, 0))
# 420 degrees in 300 frames.
SPEED_DEG = 1.4
SKEW_S = (-0.012, 0.003, 0.015, -0.006)
# Frames per cycle of the periodic sequence.
PERIOD = 200
# Cached recordings of another version are rendered again.
VERSION = 1


def make_rig() -> Rig:
    """Return four cameras on an arc of 120 degrees, alternately above and below, each 1.5 m from the object."""
    heights = np.array([0.5, -0.2, 0.5, -0.2])
    cameras = []
    for i, height in enumerate(heights):
        camera = arc(4, 40.0, float(np.sqrt(DISTANCE**2 - height**2)), FOCAL, SIZE, height=height).cameras[i]
        cameras.append(replace(camera, distortion=np.array(LENSES[i % len(LENSES)], dtype=float)))
    return Rig(cameras, "m")


def make_block(seed: int = 0, size: float = OBJECT) -> TexturedBody:
    """Return a textured box with chamfered edges."""
    return chamfered_box(size * np.array([1.0, 0.74, 0.86]), TEXELS, seed=seed)


def make_polyhedron(seed: int = 0, size: float = OBJECT, points: int = 60) -> TexturedBody:
    """Return the textured convex hull of random points on an ellipsoid."""
    rng = np.random.default_rng(seed)
    on_sphere = rng.standard_normal((points, 3))
    on_sphere /= np.linalg.norm(on_sphere, axis=1, keepdims=True)
    return TexturedBody.from_hull(on_sphere * size / 2 * np.array([1.0, 0.8, 0.9]), TEXELS, seed)


def make_steady_motion(frames: int, seed: int) -> Motion:
    """Return a uniform tumbling motion along a closed path of about the object's size in 300 frames."""
    rng = np.random.default_rng(seed)
    return make_tumbling_path(
        frames, lambda t: np.full(len(t), SPEED_DEG), make_closed_path(300, 0.8 * OBJECT, rng), rng
    )


def make_occluder(camera: Camera, first: float, last: float, seed: int) -> Actor:
    """Return a board that occludes a camera's view between two frames, inclusive, and slides in and out sideways."""
    distance, ramp = 0.2 * DISTANCE, 5
    half = 1.15 * distance * np.array(SIZE) / FOCAL / 2
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [*half, 0.004]
    body = TexturedBody.from_hull(corners, FOCAL / distance, seed)
    world_from_camera = camera.camera_from_world.inv()

    def path(frame: float) -> RigidTransform:
        offset = 2.2 * half[0] * (1 - float(smooth_window(frame, first, last, ramp)))
        return world_from_camera * RigidTransform.from_translation([offset, 0.0, distance])

    return Actor(body, path)


def build_plain(body: TexturedBody, frames: int, seed: int) -> Recording:
    """Return a recording of one moving body in front of a static background."""
    return Recording(Scene(make_rig(), (Actor(body, make_steady_motion(frames, seed)),), frames, seed))


def build_occluded(frames: int, seed: int, cameras: Sequence[int], length: int) -> Recording:
    """Return the box, occluded in some cameras for `length` frames from 45 % of the sequence on."""
    first = round(0.45 * frames)
    plain = build_plain(make_block(), frames, seed)
    boards = [make_occluder(plain.scene.rig.cameras[c], first + 1, first + length - 2, 40 + c) for c in cameras]
    return replace(plain, scene=replace(plain.scene, actors=(*plain.scene.actors, *boards)))


def build_disappearance(frames: int, seed: int) -> Recording:
    """Return the box leaving upwards, invisible for 30 frames, and returning elsewhere, rotated by about 25 degrees."""
    rng = np.random.default_rng(seed)
    leaves, ramp, hold_frames = round(0.4 * frames), 30, GONE_HOLD_FRAMES
    return_frame = leaves + 2 * ramp + hold_frames
    base = make_closed_path(300, 0.8 * OBJECT, rng)

    def speed(t: FloatArray) -> FloatArray:
        return np.asarray(
            SPEED_DEG - (SPEED_DEG - 25 / 31) * smooth_window(t, leaves + ramp - 14, return_frame - ramp + 14, 6)
        )

    def position(t: FloatArray) -> FloatArray:
        return base(t) + compute_excursion(t, leaves, return_frame, ramp, [0.1, -1.0, 0.0], [-0.1, 0.03, 0.1])

    return Recording(
        Scene(make_rig(), (Actor(make_block(), make_tumbling_path(frames, speed, position, rng)),), frames, seed)
    )


# Frames that the object stays at its highest position; it is then invisible for 30 frames.
GONE_HOLD_FRAMES = 3


def build_clutter(frames: int, seed: int, *, boxes: bool) -> Recording:
    """Return the box in front of static boxes; another body passes by from 30 to 75 % of the sequence."""
    rng = np.random.default_rng([seed, 7])
    plain = build_plain(make_block(), frames, seed)
    static_actors = []

    def constant_pose(pose: RigidTransform) -> Motion:
        return lambda _: pose

    for k in range(24):
        angle, radius = np.deg2rad(rng.uniform(-80, 80)), rng.uniform(0.6, 1.1)
        center = [radius * np.sin(angle), rng.uniform(-0.55, 0.6), radius * np.cos(angle)]
        pose = RigidTransform.from_components(center, Rotation.random(rng=rng))
        sides = rng.uniform(0.1, 0.3, 3)
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * sides / 2
        static_actors.append(Actor(TexturedBody.from_hull(corners, TEXELS, 100 + k), constant_pose(pose)))
    passing_path = make_straight_path([-1.1, -0.12, 0.38], [1.1, -0.02, 0.3], 0.3 * frames, 0.75 * frames)
    actors = (*plain.scene.actors, *static_actors, Actor(make_polyhedron(9, 0.22, 40), passing_path))
    return replace(plain, boxes=boxes, scene=replace(plain.scene, actors=actors))


def build_fast(frames: int, seed: int, exposure: float) -> Recording:
    """Return the box in bursts of increasing speed, up to 15 degrees and a tenth of its distance per frame.

    Rotation and translation alternate; the last burst combines both.
    """
    rng = np.random.default_rng(seed)
    peaks = ((22, 4.0), (68, 8.0), (114, 11.0), (160, 13.0), (206, 15.0), (270.5, 15.4))
    sides = ((45, 8.0), (91, 6.0), (137, 4.5), (183, 3.5), (229.5, 2.8), (270.5, 2.8))
    base = make_closed_path(300, 0.3 * OBJECT, rng)

    def speed(t: FloatArray) -> FloatArray:
        return np.asarray(
            SPEED_DEG + np.sum([(peak - SPEED_DEG) * bump_profile(t, middle, 4) for middle, peak in peaks], axis=0)
        )

    def position(t: FloatArray) -> FloatArray:
        return np.asarray(base(t) + 0.25 * swing_profile(t, sides)[:, None] * np.array([0.95, 0.1, 0.3]))

    actor = Actor(make_block(), make_tumbling_path(frames, speed, position, rng))
    return Recording(Scene(make_rig(), (actor,), frames, seed, exposure=exposure))


def build_dropped(frames: int, seed: int) -> Recording:
    """Return the box with 10 % of the frames missing at random; one camera fails after half of the sequence."""
    plain = build_plain(make_block(), frames, seed)
    rng = np.random.default_rng([seed, 3])
    shown = rng.random((frames, len(plain.scene.rig))) >= 0.1
    shown[0] = True  # the boxes belong to this frame
    shown[~shown.any(axis=1), 0] = True
    shown[frames // 2 :, 1] = False
    shown[~shown.any(axis=1), 0] = True
    return replace(plain, recorded=shown)


def build_skewed(frames: int, seed: int, *, stamped: bool) -> Recording:
    """Return the box at varying speed, with cameras exposed some milliseconds apart."""
    rng = np.random.default_rng(seed)
    base = make_closed_path(90, 0.8 * OBJECT, rng)

    def speed(t: FloatArray) -> FloatArray:
        return np.asarray(1.6 * SPEED_DEG * (1 + 0.8 * np.sin(t / 11)))

    actor = Actor(make_block(), make_tumbling_path(frames, speed, base, rng))
    return Recording(Scene(make_rig(), (actor,), frames, seed), time_offsets=SKEW_S, with_timestamps=stamped)


def build_two_objects(frames: int, seed: int) -> Recording:
    """Return a box and a polyhedron, side by side."""

    def make_actor(body: TexturedBody, side: float) -> Actor:
        rng = np.random.default_rng([seed, round(side + 1)])
        base, middle = make_closed_path(300, 0.1, rng), side * np.array([0.15, 0.12, 0.0])
        return Actor(
            body,
            make_tumbling_path(frames, lambda t: np.full(len(t), side * SPEED_DEG), lambda t: base(t) + middle, rng),
        )

    actors = (make_actor(make_block(3, 0.2), -1.0), make_actor(make_polyhedron(4, 0.2), 1.0))
    return Recording(Scene(make_rig(), actors, frames, seed), objects=("block", "body"))


def build_long(frames: int, seed: int) -> Recording:
    """Return the box in a periodic motion of 200 frames."""
    rng = np.random.default_rng(seed)
    base = make_closed_path(PERIOD, 0.8 * OBJECT, rng)

    def path(frame: float) -> RigidTransform:
        s = 2 * np.pi * frame / PERIOD
        wobble = Rotation.from_rotvec(0.35 * np.array([np.sin(s), 0.0, np.sin(2 * s)]))
        rotation = Rotation.from_rotvec(s * np.array([0.36, 0.8, 0.48]))
        return RigidTransform.from_components(base(np.array([frame]))[0], wobble * rotation)

    repeats = max(round(frames / PERIOD), 1)
    scene = Scene(make_rig(), (Actor(make_block(), path),), min(PERIOD, frames), seed)
    return Recording(scene, repeats=repeats, quality=23)


Builder = Callable[[int], Recording]
BUILDERS: dict[str, Builder] = {
    "box": lambda n: build_plain(make_block(), n, 1),
    "body": lambda n: build_plain(make_polyhedron(), n, 2),
    "occluded-half": lambda n: build_occluded(n, 3, (0, 2), 20),
    "occluded-all": lambda n: build_occluded(n, 3, (0, 1, 2, 3), 8),
    "gone": lambda n: build_disappearance(n, 4),
    "clutter": lambda n: build_clutter(n, 5, boxes=True),
    "clutter-no-boxes": lambda n: build_clutter(n, 5, boxes=False),
    "fast": lambda n: build_fast(n, 6, 0.0),
    "blur": lambda n: build_fast(n, 6, 0.6),
    "dropped": lambda n: build_dropped(n, 7),
    "skewed": lambda n: build_skewed(n, 8, stamped=True),
    "skewed-unknown": lambda n: build_skewed(n, 8, stamped=False),
    "two": lambda n: build_two_objects(n, 9),
    "long": lambda n: build_long(n, 10),
}
FRAMES = {"long": 10_000}


def build_recording(name: str, frames: int | None = None) -> Recording:
    """Build a recording by its name, by default with 300 frames (10,000 for "long").

    Raises:
        ValueError: the name is unknown, or `frames` is less than 1.
    """
    if name not in BUILDERS:
        raise ValueError(f"unknown scene {name!r} (known: {', '.join(BUILDERS)})")
    frames = FRAMES.get(name, 300) if frames is None else frames
    if frames < 1:
        raise ValueError(f"frames must be at least 1, got {frames}")
    return BUILDERS[name](frames)


def render_recording(name: str, folder: Path, frames: int | None = None) -> Path:
    """Return the folder of a recording below `folder`; render the recording if it is not there yet."""
    recording = build_recording(name, frames)
    out = folder / f"{name}-{recording.frames}"
    done_file = out / ".done"
    if not done_file.exists() or done_file.read_text() != str(VERSION):
        shutil.rmtree(out, ignore_errors=True)
        write_recording(recording, out)
        done_file.write_text(str(VERSION))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=BUILDERS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, help="default: 300, of long 10,000")
    options = parser.parse_args()
    try:
        recording = build_recording(options.name, options.frames)
    except ValueError as error:
        parser.error(str(error))
    write_recording(recording, options.folder)


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main()
