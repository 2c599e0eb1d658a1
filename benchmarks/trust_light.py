"""Kinds of `benchmarks/trust.py`: objects that come late or rest, light, compression, shutters, and moving backgrounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_scenes import DISTANCE, draw_direction, index_by_name
from benchmarks.trust_effects import cast_shadows, compress, rotate_cameras, scale_brightness, shine
from benchmarks.trust_people import add_actors
from benchmarks.trust_takes import Take, draw_photo, draw_take, make_panel, show_during, to_cameras
from sylpose.geometry.arrays import FloatArray
from sylpose.simulate import Actor, TexturedBody

__all__ = ["LATE", "LIGHT", "MOVING_BACKGROUND"]

# Distance at which an object that comes in late starts, in its radii.
ENTRY_RADII = 9.0


# --- late and resting objects ---------------------------------------------------------------------------------------------


def enter(rng: np.random.Generator, share: float) -> Take:
    """Let the object come in from the side within a few frames, after a share of the take; no boxes."""
    frames = 40
    take = draw_take(rng, frames=frames, boxes=False, travel=0.2)
    arrival, n_entering = share * frames, float(rng.uniform(5, 10))
    sideways = np.cross([0.0, 1.0, 0.0], to_cameras(take.scene.rig)) * rng.choice([-1.0, 1.0])
    actor = take.scene.actors[0]

    def path(frame: float) -> RigidTransform:
        remaining = ENTRY_RADII * take.radius * max(arrival - frame, 0.0) / n_entering
        return RigidTransform.from_translation(remaining * sideways) * actor.path(frame)

    take = replace(take, scene=replace(take.scene, actors=(Actor(actor.body, path),)))
    sizes = [camera.size for camera in take.scene.rig]
    seen = (
        k
        for k in range(frames)
        if any(
            ((outline >= 0) & (outline < size)).all(axis=1).any()
            for c, size in enumerate(sizes)
            for outline in take.outlines(c, k)
        )
    )
    return replace(take, first=next(seen, 0))


def late_third(rng: np.random.Generator) -> Take:
    """The object comes in after a third of the take."""
    return enter(rng, 1 / 3)


def late_half(rng: np.random.Generator) -> Take:
    """The object comes in after half of the take."""
    return enter(rng, 1 / 2)


def rests_long(rng: np.random.Generator) -> Take:
    """The object rests for two thirds of the take, then moves."""
    begin = float(rng.integers(24, 30))
    return draw_take(rng, frames=40, pace=lambda frame: max(frame - begin, 0.0))


def rests_between(rng: np.random.Generator) -> Take:
    """The object moves, rests for fifteen frames, and moves on."""
    begin = float(rng.integers(8, 14))
    return draw_take(rng, frames=40, pace=lambda frame: min(frame, begin) + max(frame - begin - 15, 0.0))


def put_down(rng: np.random.Generator) -> Take:
    """The object is put down after a third of the take and stays."""
    end = float(rng.integers(12, 18))
    return draw_take(rng, frames=40, pace=lambda frame: min(frame, end))


def creeping(rng: np.random.Generator) -> Take:
    """The object moves by some hundredths of a degree per frame, later faster."""
    speed = float(rng.uniform(0.02, 0.1))
    return draw_take(
        rng, frames=40, speed=(1.0, 1.0), travel=0.1, pace=lambda t: speed * t + max(t - 25, 0.0) ** 2 / 15
    )


# --- light and recording --------------------------------------------------------------------------------------------------


def draw_with_gain(rng: np.random.Generator, common: bool, steps: FloatArray | None = None) -> Take:
    """Draw a take with brightness that drifts by a few percent per frame, or with the given steps (frames,)."""
    take = draw_take(rng)
    frames, n = take.scene.frames, len(take.scene.rig)
    changes = rng.normal(0, 0.04, (frames, 1 if common else n))
    gain = np.clip(np.exp(np.cumsum(changes, axis=0)), 0.4, 1.6) if steps is None else steps[:, None]
    return replace(take, effects=(scale_brightness(np.broadcast_to(gain, (frames, n))),))


def exposure_steps(rng: np.random.Generator) -> Take:
    """The exposure of each camera jumps two or three times by up to 40 %."""
    take = draw_take(rng)
    frames, n = take.scene.frames, len(take.scene.rig)
    gain = np.ones((frames, n))
    for c in range(n):
        for _ in range(int(rng.integers(2, 4))):
            gain[int(rng.integers(2, frames)) :, c] *= rng.choice([0.6, 0.75, 1.3, 1.5])
    return replace(take, effects=(scale_brightness(np.clip(gain, 0.35, 1.7)),))


def exposure_wanders(rng: np.random.Generator) -> Take:
    """The exposure of each camera wanders."""
    return draw_with_gain(rng, common=False)


def light_dims(rng: np.random.Generator) -> Take:
    """The light goes down to a fifth to a half."""
    return draw_with_gain(rng, common=True, steps=np.linspace(1.0, rng.uniform(0.2, 0.5), 30))


def flicker(rng: np.random.Generator) -> Take:
    """The light flickers by up to 25 % from frame to frame."""
    beat = rng.uniform(0.8, 2.8) * np.arange(30) + rng.uniform(0, 6)
    return draw_with_gain(rng, common=True, steps=0.85 + rng.uniform(0.1, 0.25) * np.sin(beat))


def draw_compressed(rng: np.random.Generator, codec: str, quality: int) -> Take:
    """Draw a take with compressed images."""
    return replace(draw_take(rng), effects=(compress(codec, quality),))


def low_jpeg(rng: np.random.Generator) -> Take:
    """JPEG of quality 10 to 40."""
    return draw_compressed(rng, "jpeg", int(rng.integers(10, 41)))


def low_h264(rng: np.random.Generator) -> Take:
    """H.264 at rate factors of 30 to 40."""
    return draw_compressed(rng, "h264", int(rng.integers(30, 41)))


def rolling_shutter(rng: np.random.Generator) -> Take:
    """The rows of an image are exposed one after the other, within half to all of the frame time."""
    share = float(rng.uniform(0.5, 1.0))
    return replace(draw_take(rng, frames=24), slices=tuple(share * (np.arange(8) / 7 - 0.5)))


def interlaced(rng: np.random.Generator) -> Take:
    """Even and odd rows are exposed half a frame apart."""
    return replace(draw_take(rng), slices=(-0.25, 0.25), interlaced=True)


def motion_blur(rng: np.random.Generator) -> Take:
    """Exposures of half to all of the frame time."""
    take = draw_take(rng, frames=24)
    return replace(take, scene=replace(take.scene, exposure=float(rng.uniform(0.5, 1.0))))


def trembling(rng: np.random.Generator) -> Take:
    """The cameras tremble by 0.03 to 0.2 degrees."""
    take = draw_take(rng)
    shape = (take.scene.frames, len(take.scene.rig), 3)
    rotations = np.radians(rng.uniform(0.03, 0.2)) * rng.standard_normal(shape)
    return replace(take, effects=(rotate_cameras(rotations),))


def sagging_camera(rng: np.random.Generator) -> Take:
    """One camera turns steadily by 1 to 4 degrees in all, as a loose tripod head."""
    take = draw_take(rng)
    rotations = np.zeros((take.scene.frames, len(take.scene.rig), 3))
    total = np.radians(rng.uniform(1, 4)) * draw_direction(rng)
    rotations[:, int(rng.integers(len(take.scene.rig)))] = np.linspace(0, 1, take.scene.frames)[:, None] * total
    return replace(take, effects=(rotate_cameras(rotations),))


# --- backgrounds that move ------------------------------------------------------------------------------------------------


def shadows(rng: np.random.Generator) -> Take:
    """The object's shadow wanders over the wall."""
    take = draw_take(rng)
    frames, n = take.scene.frames, len(take.scene.rig)
    size = take.scene.rig.cameras[0].size[1]
    shifts = size * (rng.uniform(0.1, 0.35, (1, n, 2)) * rng.choice([-1, 1], (1, n, 2)))
    shifts = shifts + size * np.linspace(0, 0.3, frames)[:, None, None] * rng.uniform(-1, 1, (1, n, 2))
    return replace(take, effects=(cast_shadows(shifts, float(rng.uniform(0.3, 0.6)), float(rng.uniform(0.9, 1.5))),))


def light_patch(rng: np.random.Generator) -> Take:
    """A patch of light, such as a reflection of the sun, wanders over the wall."""
    take = draw_take(rng)
    frames, n = take.scene.frames, len(take.scene.rig)
    ends = rng.uniform(0, 1, (2, 1, n, 2))
    share = np.linspace(0, 1, frames)[:, None, None]
    places = (1 - share) * ends[0] + share * ends[1]
    return replace(take, effects=(shine(places, float(rng.uniform(0.05, 0.15)), 120.0, on_object=False),))


def screen_video(rng: np.random.Generator) -> Take:
    """A screen behind the object shows a video in which a photograph slides and zooms."""
    take = draw_take(rng)
    front = to_cameras(take.scene.rig)
    width, radius, texels = float(rng.uniform(2.5, 4.5)), take.radius, 250.0
    photo = draw_photo(rng, (480, 360))
    pan = rng.uniform(-3.0, 3.0, 2)
    turn = Rotation.from_matrix(np.column_stack([np.cross([0.0, 1.0, 0.0], -front), [0.0, 1.0, 0.0], -front]))
    place = radius * (-2.5 * front + rng.uniform(-1.5, 1.5) * turn.as_matrix()[:, 0] + [0, rng.uniform(-1, 1), 0])
    pose = RigidTransform.from_components(place, turn)
    screens: list[Actor] = []
    body: TexturedBody | None = None
    for k in range(take.scene.frames):
        zoom, (du, dv) = 1.0 + 0.2 * np.sin(k / 12), np.rint(k * pan).astype(int)
        view = np.roll(photo, (dv, du), axis=(0, 1))
        rows, columns = int(300 / zoom), int(400 / zoom)
        image = view[30 : 30 + rows, 40 : 40 + columns]
        body = make_panel(width * radius, 0.7 * width * radius, 0.02, texels, image)
        screens.append(Actor(body, show_during(lambda _frame: pose, k - 0.5, k + 0.5)))
    return add_actors(take, tuple(screens))


def mirror(rng: np.random.Generator) -> Take:
    """A large mirror behind the object, at an angle to the cameras, shows it from the other side."""
    take = draw_take(rng, photos=False)
    angle = float(np.radians(rng.uniform(12, 25)) * rng.choice([-1, 1]))
    normal = Rotation.from_euler("y", angle).apply(to_cameras(take.scene.rig))
    plane = -float(rng.uniform(1.6, 2.6)) * take.radius
    linear, offset = np.eye(3) - 2 * np.outer(normal, normal), 2 * plane * normal
    actor = take.scene.actors[0]
    body = transform_body(actor.body, linear)

    def path(frame: float) -> RigidTransform:
        pose = actor.path(frame)
        rotation = Rotation.from_matrix(linear @ pose.rotation.as_matrix() @ linear)
        return RigidTransform.from_components(linear @ pose.translation + offset, rotation)

    return add_actors(take, (Actor(body, path),))


def transform_body(body: TexturedBody, linear: FloatArray) -> TexturedBody:
    """Transform a body linearly by a matrix (3, 3): reflected, stretched or sheared."""
    normals = body.normals @ np.linalg.inv(linear)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return replace(
        body, vertices=body.vertices @ linear.T, normals=normals, plane_from_texture=linear @ body.plane_from_texture
    )


def swaying_plant(rng: np.random.Generator) -> Take:
    """Leaves behind the object sway in the wind."""
    take = draw_take(rng)
    front, radius = to_cameras(take.scene.rig), take.radius
    leaves = []
    for _ in range(12):
        size = radius * rng.uniform(0.2, 0.5)
        body = make_panel(
            size, 1.8 * size, 0.02 * size, 1.25 * take.scene.rig.cameras[0].focal / DISTANCE, draw_photo(rng, (64, 96))
        )
        place = radius * (rng.uniform(-3.5, 3.5, 3) * [1, 0.6, 1] * 0.7 - 3.0 * front)
        amplitude, period, phase = rng.uniform([0.1, 12.0, 0.0], [0.5, 30.0, 2 * np.pi])
        about = draw_direction(rng)

        def path(
            frame: float,
            place: FloatArray = place,
            about: FloatArray = about,
            swing: tuple[float, float, float] = (amplitude, period, phase),
        ) -> RigidTransform:
            angle = swing[0] * np.sin(2 * np.pi * frame / swing[1] + swing[2])
            return RigidTransform.from_components(place, Rotation.from_rotvec(angle * about))

        leaves.append(Actor(body, path))
    return add_actors(take, tuple(leaves))


LATE = index_by_name([late_third, late_half, rests_long, rests_between, put_down, creeping])
LIGHT = index_by_name(
    [
        exposure_steps,
        exposure_wanders,
        light_dims,
        flicker,
        low_jpeg,
        low_h264,
        rolling_shutter,
        interlaced,
        motion_blur,
        trembling,
        sagging_camera,
    ]
)
MOVING_BACKGROUND = index_by_name([shadows, light_patch, screen_video, mirror, swaying_plant])
