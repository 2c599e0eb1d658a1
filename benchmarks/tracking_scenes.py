"""The rendered sequences of the tracking benchmark, with known truth.

    python benchmarks/tracking_scenes.py NAME FOLDER [--frames N]

writes one of them as a session: videos, calibration.toml, boxes.toml (a table per object where there are two), and
timestamps.csv where the cameras' times matter.
With it goes the truth: groundtruth.tum and dataset.toml as `sylpose.simulate` writes them, vertices.txt (the body's
corners in the object's frame) and visible.csv (which share of these each camera shows in each frame), with _OBJECT in their
names where there are two, and, with clocks that differ, true_offsets.toml (seconds, positive for late ones).
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

from benchmarks.tracking_paths import Path as Motion
from benchmarks.tracking_paths import away, bump, crossing, loop, swings, tumble, window
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, Rig
from sylpose.simulate import Actor, Recording, Scene, TexturedBody, arc, chamfered_box, write_recording

__all__ = ["BUILDERS", "build", "make"]


SIZE = (640, 480)
DISTANCE = 1.5
OBJECT = 0.3
# The object's longest side fills 45 % of the image's height.
FOCAL = 0.45 * SIZE[1] * DISTANCE / OBJECT
TEXELS = 1.25 * FOCAL / DISTANCE
# Mild barrels, as of webcams.
LENSES = ((-0.11, 0.03, 0.0004, -0.0003, 0), (-0.08, 0.01, -0.0005, 0.0002, 0), (-0.13, 0.04, 0.0002, 0.0006, 0))
# 420 degrees in 300 frames.
SPEED_DEG = 1.4
SKEW_S = (-0.012, 0.003, 0.015, -0.006)
# Frames of the sequence that repeats itself.
PERIOD = 200
# A change of this makes new recordings of cached ones.
VERSION = 1


def rig_of() -> Rig:
    """Four cameras on an arc of 120 degrees, alternately above and below, each 1.5 m from the object."""
    heights = np.array([0.5, -0.2, 0.5, -0.2])
    cameras = []
    for i, height in enumerate(heights):
        camera = arc(4, 40.0, float(np.sqrt(DISTANCE**2 - height**2)), FOCAL, SIZE, height=height).cameras[i]
        cameras.append(replace(camera, distortion=np.array(LENSES[i % len(LENSES)], dtype=float)))
    return Rig(cameras, "m")


def block(seed: int = 0, size: float = OBJECT) -> TexturedBody:
    """The textured box, its edges cut off."""
    return chamfered_box(size * np.array([1.0, 0.74, 0.86]), TEXELS, seed=seed)


def many_faced(seed: int = 0, size: float = OBJECT, points: int = 60) -> TexturedBody:
    """The hull of random points on an ellipsoid."""
    rng = np.random.default_rng(seed)
    on_sphere = rng.standard_normal((points, 3))
    on_sphere /= np.linalg.norm(on_sphere, axis=1, keepdims=True)
    return TexturedBody.hull(on_sphere * size / 2 * np.array([1.0, 0.8, 0.9]), TEXELS, seed)


def steady(frames: int, seed: int) -> Motion:
    """Tumbles evenly and traces a closed path of about its own size in 300 frames."""
    rng = np.random.default_rng(seed)
    return tumble(frames, lambda t: np.full(len(t), SPEED_DEG), loop(300, 0.8 * OBJECT, rng), rng)


def board_before(camera: Camera, first: float, last: float, seed: int) -> Actor:
    """A board that hides everything from a camera between two frames (both included), and slides in and out sideways."""
    near, ramp = 0.2 * DISTANCE, 5
    half = 1.15 * near * np.array(SIZE) / FOCAL / 2
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [*half, 0.004]
    body = TexturedBody.hull(corners, FOCAL / near, seed)
    world_from_camera = camera.camera_from_world.inv()

    def path(frame: float) -> RigidTransform:
        aside = 2.2 * half[0] * (1 - float(window(frame, first, last, ramp)))
        return world_from_camera * RigidTransform.from_translation([aside, 0.0, near])

    return Actor(body, path)


def clean(body: TexturedBody, frames: int, seed: int) -> Recording:
    """One body before a standing background."""
    return Recording(Scene(rig_of(), (Actor(body, steady(frames, seed)),), frames, seed))


def occluded(frames: int, seed: int, cameras: Sequence[int], length: int) -> Recording:
    """The box, hidden from some cameras for a while from 45 % of the time on."""
    first = round(0.45 * frames)
    plain = clean(block(), frames, seed)
    boards = [board_before(plain.scene.rig.cameras[c], first + 1, first + length - 2, 40 + c) for c in cameras]
    return replace(plain, scene=replace(plain.scene, actors=(*plain.scene.actors, *boards)))


def gone(frames: int, seed: int) -> Recording:
    """The box leaves upwards, is seen by no camera for 30 frames in which it turns by some 25 degrees, and comes back
    elsewhere."""
    rng = np.random.default_rng(seed)
    leaves, ramp, held = round(0.4 * frames), 30, GONE_HELD
    back = leaves + 2 * ramp + held
    base = loop(300, 0.8 * OBJECT, rng)

    def speed(t: FloatArray) -> FloatArray:
        return np.asarray(SPEED_DEG - (SPEED_DEG - 25 / 31) * window(t, leaves + ramp - 14, back - ramp + 14, 6))

    def place(t: FloatArray) -> FloatArray:
        return base(t) + away(t, leaves, back, ramp, [0.1, -1.0, 0.0], [-0.1, 0.03, 0.1])

    return Recording(Scene(rig_of(), (Actor(block(), tumble(frames, speed, place, rng)),), frames, seed))


# Frames that the object stays at the height that it leaves to: 30 are then without a view of it.
GONE_HELD = 3


def clutter(frames: int, seed: int, *, boxes: bool) -> Recording:
    """The box before a room full of textured boxes, and another body that passes by from 30 to 75 % of the time."""
    rng = np.random.default_rng([seed, 7])
    plain = clean(block(), frames, seed)
    stands = []

    def standing(pose: RigidTransform) -> Motion:
        return lambda _: pose

    for k in range(24):
        angle, radius = np.deg2rad(rng.uniform(-80, 80)), rng.uniform(0.6, 1.1)
        center = [radius * np.sin(angle), rng.uniform(-0.55, 0.6), radius * np.cos(angle)]
        pose = RigidTransform.from_components(center, Rotation.random(rng=rng))
        sides = rng.uniform(0.1, 0.3, 3)
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * sides / 2
        stands.append(Actor(TexturedBody.hull(corners, TEXELS, 100 + k), standing(pose)))
    other = crossing([-1.1, -0.12, 0.38], [1.1, -0.02, 0.3], 0.3 * frames, 0.75 * frames)
    actors = (*plain.scene.actors, *stands, Actor(many_faced(9, 0.22, 40), other))
    return replace(plain, boxes=boxes, scene=replace(plain.scene, actors=actors))


def fast(frames: int, seed: int, exposure: float) -> Recording:
    """The box in bursts that get faster and faster, up to 15 degrees and a tenth of its distance per frame, alternately
    and at the end together."""
    rng = np.random.default_rng(seed)
    peaks = ((22, 4.0), (68, 8.0), (114, 11.0), (160, 13.0), (206, 15.0), (270.5, 15.4))
    sides = ((45, 8.0), (91, 6.0), (137, 4.5), (183, 3.5), (229.5, 2.8), (270.5, 2.8))
    base = loop(300, 0.3 * OBJECT, rng)

    def speed(t: FloatArray) -> FloatArray:
        return np.asarray(
            SPEED_DEG + np.sum([(peak - SPEED_DEG) * bump(t, middle, 4) for middle, peak in peaks], axis=0)
        )

    def place(t: FloatArray) -> FloatArray:
        return np.asarray(base(t) + 0.25 * swings(t, sides)[:, None] * np.array([0.95, 0.1, 0.3]))

    actor = Actor(block(), tumble(frames, speed, place, rng))
    return Recording(Scene(rig_of(), (actor,), frames, seed, exposure=exposure))


def dropped(frames: int, seed: int) -> Recording:
    """The box; 10 % of the frames are missing at random, and one camera dies at half of the time."""
    plain = clean(block(), frames, seed)
    rng = np.random.default_rng([seed, 3])
    shown = rng.random((frames, len(plain.scene.rig))) >= 0.1
    shown[0] = True  # the boxes are of this frame
    shown[~shown.any(axis=1), 0] = True
    shown[frames // 2 :, 1] = False
    shown[~shown.any(axis=1), 0] = True
    return replace(plain, shown=shown)


def skewed(frames: int, seed: int, *, stamped: bool) -> Recording:
    """The box at a speed that changes, by cameras that are exposed some milliseconds apart."""
    rng = np.random.default_rng(seed)
    base = loop(90, 0.8 * OBJECT, rng)

    def speed(t: FloatArray) -> FloatArray:
        return np.asarray(1.6 * SPEED_DEG * (1 + 0.8 * np.sin(t / 11)))

    actor = Actor(block(), tumble(frames, speed, base, rng))
    return Recording(Scene(rig_of(), (actor,), frames, seed), skew=SKEW_S, stamped=stamped)


def two(frames: int, seed: int) -> Recording:
    """A box and a many-faced body, side by side."""

    def beside(body: TexturedBody, side: float) -> Actor:
        rng = np.random.default_rng([seed, round(side + 1)])
        base, middle = loop(300, 0.1, rng), side * np.array([0.15, 0.12, 0.0])
        return Actor(body, tumble(frames, lambda t: np.full(len(t), side * SPEED_DEG), lambda t: base(t) + middle, rng))

    actors = (beside(block(3, 0.2), -1.0), beside(many_faced(4, 0.2), 1.0))
    return Recording(Scene(rig_of(), actors, frames, seed), objects=("block", "body"))


def long(frames: int, seed: int) -> Recording:
    """The box on a path and turn that close after 200 frames, again and again."""
    rng = np.random.default_rng(seed)
    base = loop(PERIOD, 0.8 * OBJECT, rng)

    def path(frame: float) -> RigidTransform:
        s = 2 * np.pi * frame / PERIOD
        wobble = Rotation.from_rotvec(0.35 * np.array([np.sin(s), 0.0, np.sin(2 * s)]))
        turn = Rotation.from_rotvec(s * np.array([0.36, 0.8, 0.48]))
        return RigidTransform.from_components(base(np.array([frame]))[0], wobble * turn)

    repeats = max(round(frames / PERIOD), 1)
    scene = Scene(rig_of(), (Actor(block(), path),), min(PERIOD, frames), seed)
    return Recording(scene, repeats=repeats, quality=23)


Builder = Callable[[int], Recording]
BUILDERS: dict[str, Builder] = {
    "box": lambda n: clean(block(), n, 1),
    "body": lambda n: clean(many_faced(), n, 2),
    "occluded-half": lambda n: occluded(n, 3, (0, 2), 20),
    "occluded-all": lambda n: occluded(n, 3, (0, 1, 2, 3), 8),
    "gone": lambda n: gone(n, 4),
    "clutter": lambda n: clutter(n, 5, boxes=True),
    "clutter-no-boxes": lambda n: clutter(n, 5, boxes=False),
    "fast": lambda n: fast(n, 6, 0.0),
    "blur": lambda n: fast(n, 6, 0.6),
    "dropped": lambda n: dropped(n, 7),
    "skewed": lambda n: skewed(n, 8, stamped=True),
    "skewed-unknown": lambda n: skewed(n, 8, stamped=False),
    "two": lambda n: two(n, 9),
    "long": lambda n: long(n, 10),
}
FRAMES = {"long": 10_000}


def build(name: str, frames: int | None = None) -> Recording:
    """A recording by its name; 300 frames (10,000 of "long") if not said.

    Raises:
        ValueError: no such name, or no frames.
    """
    if name not in BUILDERS:
        raise ValueError(f"no scene is named {name!r} ({', '.join(BUILDERS)})")
    frames = FRAMES.get(name, 300) if frames is None else frames
    if frames < 1:
        raise ValueError(f"frames must be at least 1, got {frames}")
    return BUILDERS[name](frames)


def make(name: str, folder: Path, frames: int | None = None) -> Path:
    """The folder of a recording in `folder`, rendered unless an earlier call did it."""
    recording = build(name, frames)
    out = folder / f"{name}-{recording.frames}"
    done = out / ".done"
    if not done.exists() or done.read_text() != str(VERSION):
        shutil.rmtree(out, ignore_errors=True)
        write_recording(recording, out)
        done.write_text(str(VERSION))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=BUILDERS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, help="300 by default, 10,000 of long")
    options = parser.parse_args()
    try:
        recording = build(options.name, options.frames)
    except ValueError as error:
        parser.error(str(error))
    write_recording(recording, options.folder)


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main()
