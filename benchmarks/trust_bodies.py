"""Kinds of `benchmarks/trust.py`: several bodies, persons, hard surfaces, and bodies that are not rigid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_feature_poor import blur_textures, reduce_contrast
from benchmarks.kinds_scenes import draw_block, draw_body, draw_direction, index_by_name, make_board, texture_resolution
from benchmarks.trust_camera_faults import UP
from benchmarks.trust_effects import see_through, shine
from benchmarks.trust_light import transform_body
from benchmarks.trust_people import add_actors, add_person, hold_with, make_person, swing_arm, wave_arm
from benchmarks.trust_takes import (
    Take,
    draw_motion,
    draw_take,
    draw_trust_rig,
    pace_path,
    place_boxes,
    show_during,
    to_cameras,
)
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import Actor, TexturedBody
from sylpose.simulate.render import Path

__all__ = ["NOT_RIGID", "PEOPLE", "SEVERAL", "SURFACES"]


def shift_path(path: Path, offset: FloatArray) -> Path:
    """Shift a path by an offset (3,) in the world."""
    return lambda frame: RigidTransform.from_translation(offset) * path(frame)


def sideways_of(take: Take) -> FloatArray:
    """Return the horizontal direction (3,) to the right of the middle of the cameras."""
    return np.asarray(np.cross([0.0, 1.0, 0.0], -to_cameras(take.scene.rig)))


def replace_object(take: Take, path: Path, body: TexturedBody | None = None) -> Take:
    """Replace the object's path and body, and place its boxes again if there are any."""
    first, *others = take.scene.actors
    take = replace(take, scene=replace(take.scene, actors=(Actor(body or first.body, path), *others)))
    return take if take.boxes is None else place_boxes(take)


# --- people ---------------------------------------------------------------------------------------------------------------


def person_behind_object(rng: np.random.Generator) -> Take:
    """A person stands behind the object and gesticulates."""
    take = draw_take(rng)
    person = make_person(
        rng, take.scene.rig, take.radius, behind=float(rng.uniform(2.2, 3.2)), aside=rng.uniform(-0.7, 0.7)
    )
    return add_actors(take, person)


def person_beside(rng: np.random.Generator) -> Take:
    """A person stands beside the object and waves."""
    take = draw_take(rng)
    aside = float(rng.choice([-1, 1]) * rng.uniform(2.2, 3.2))
    person = make_person(
        rng, take.scene.rig, take.radius, behind=float(rng.uniform(0, 1.5)), aside=aside, left=wave_arm(rng, -1.0)
    )
    return add_actors(take, person)


def draw_held(
    rng: np.random.Generator, *, boxes: bool | None = None, arms: int = 2, begin: float = 0.0, frames: int = 40
) -> Take:
    """Draw an object that a person holds with one hand or both, and waves with the arms until then."""
    rig = draw_trust_rig(rng, share=float(rng.uniform(0.35, 0.5)))
    body = (make_board, draw_block)[int(rng.integers(2))]
    swing, period = float(rng.uniform(15, 40)), float(rng.uniform(30, 60))
    take = draw_take(
        rng,
        rig=rig,
        speed=(1.0, 1.0),
        travel=float(rng.uniform(0.2, 0.5)),
        frames=frames,
        boxes=boxes,
        body=body,
        pace=lambda t: swing * np.sin(2 * np.pi * max(t - begin, 0.0) / period),
    )
    path, radius = take.scene.actors[0].path, take.radius
    start, side = path(begin), sideways_of(take)
    held = []
    for i, sign in enumerate((-1.0, 1.0)):
        grip = start.inv().apply(start.translation + 0.75 * radius * sign * side + 0.25 * radius * to_cameras(rig[0]))
        before = wave_arm(rng, sign)
        held.append(hold_with(path, grip, begin, before if begin else None) if i < arms else swing_arm(rng, sign))
    person = make_person(
        rng,
        rig[0],
        radius,
        behind=float(rng.uniform(1.7, 2.3)),
        aside=float(rng.uniform(-0.3, 0.3)),
        left=held[0],
        right=held[1],
    )
    return add_actors(take, person)


def person_holding(rng: np.random.Generator) -> Take:
    """A person holds the object with both hands."""
    return draw_held(rng)


def one_handed(rng: np.random.Generator) -> Take:
    """A person holds the object with one hand; the other arm swings."""
    return draw_held(rng, arms=1)


def waves_then_lifts(rng: np.random.Generator) -> Take:
    """A person waves with both arms before taking the object."""
    return draw_held(rng, begin=float(rng.integers(16, 24)))


def waves_long(rng: np.random.Generator) -> Take:
    """A person waves for ten seconds, at ten frames per second, before lifting the object."""
    return replace(draw_held(rng, begin=100.0, frames=130), rate=10.0)


def arm_across(rng: np.random.Generator) -> Take:
    """A person's arm reaches over the object from in front."""
    take = draw_take(rng)
    path, front, side = take.scene.actors[0].path, to_cameras(take.scene.rig), sideways_of(take)
    period, reach = float(rng.uniform(15, 40)), float(rng.uniform(0.3, 0.8))

    def sweep(frame: float) -> RigidTransform:
        place = path(0.0).translation + take.radius * (1.1 * front + reach * np.sin(2 * np.pi * frame / period) * side)
        return RigidTransform.from_translation(place)

    arm = hold_with(sweep, np.zeros(3))
    person = make_person(rng, take.scene.rig, take.radius, behind=0.3, aside=2.3, left=arm)
    return add_actors(take, person)


def passer_by(rng: np.random.Generator) -> Take:
    """A person passes between cameras and object."""
    take = draw_take(rng, frames=40)
    speed = float(rng.uniform(0.15, 0.3))
    person = make_person(rng, take.scene.rig, take.radius, behind=-2.2, aside=-20 * speed, walk=speed)
    return add_actors(take, person)


def person_walks_behind(rng: np.random.Generator) -> Take:
    """A person walks by behind the object."""
    take = draw_take(rng, frames=40)
    speed = float(rng.uniform(0.08, 0.25) * rng.choice([-1, 1]))
    person = make_person(rng, take.scene.rig, take.radius, behind=3.0, aside=-20 * speed, walk=speed)
    return add_actors(take, person)


def two_persons(rng: np.random.Generator) -> Take:
    """Two persons behind the object."""
    return add_person(add_person(draw_take(rng), rng), rng)


def fingers(rng: np.random.Generator) -> Take:
    """Fingers hold the object and shift on it now and then; the hand moves with it."""
    take = draw_take(rng, body=draw_block)
    radius, rig, path = take.radius, take.scene.rig, take.scene.actors[0].path
    half, side = np.abs(take.scene.actors[0].body.vertices).max(axis=0), float(rng.choice([-1, 1]))
    # On the face that looks at the cameras in the middle of the take.
    facing = path(take.scene.frames / 2).rotation.inv().apply(to_cameras(rig))
    across = int(np.argmax(np.abs(facing)))
    along, beside = (axis for axis in range(3) if axis != across)
    actors = []
    for i in range(4):
        sides = radius * np.where(np.arange(3) == along, 0.5, 0.12)
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * sides / 2
        finger = reduce_contrast(
            TexturedBody.from_hull(corners, texture_resolution(rig), int(rng.integers(1 << 30))), 0.5
        )
        place = np.zeros(3)
        place[[along, beside]] = side * 0.7 * half[along], (0.45 - 0.3 * i) * half[beside]
        place[across] = np.sign(facing[across]) * (half[across] + 0.06 * radius)
        slip, period = 0.1 * radius * rng.uniform(0, 1), float(rng.uniform(15, 40))

        def on_object(
            frame: float, place: FloatArray = place, slip: float = slip, period: float = period
        ) -> RigidTransform:
            moved = place + slip * np.sin(2 * np.pi * frame / period) * (np.arange(3) == along)
            return path(frame) * RigidTransform.from_translation(moved)

        actors.append(Actor(finger, on_object))
    return add_actors(take, tuple(actors))


# --- several bodies -------------------------------------------------------------------------------------------------------


def draw_pair(rng: np.random.Generator, *, boxes: bool, equal: bool, ratio: float = 1.0) -> Take:
    """Draw two objects side by side that move independently."""
    rig = draw_trust_rig(rng, share=0.35)
    take = draw_take(rng, rig=rig, boxes=False, travel=0.15)
    apart = 1.15 * (1 + ratio) / 2 * take.radius * sideways_of(take)
    actor = take.scene.actors[0]
    take = replace_object(take, shift_path(actor.path, -apart))
    body = actor.body if equal else draw_body(rng, rig[0], ratio * take.radius)
    path = shift_path(draw_motion(rng, take.radius, float(rng.uniform(1, 4)), travel=0.15), apart)
    take = add_actors(take, (Actor(body, path),))
    return place_boxes(take) if boxes else replace(take, truths=(take.scene.actors[0].path, path))


def equal_pair(rng: np.random.Generator) -> Take:
    """Two equal objects; without boxes either is accepted."""
    return draw_pair(rng, boxes=bool(rng.random() < 0.5), equal=True)


def larger_beside(rng: np.random.Generator) -> Take:
    """A larger moving body beside the object in the boxes."""
    return draw_pair(rng, boxes=True, equal=False, ratio=float(rng.uniform(1.2, 1.8)))


def two_objects(rng: np.random.Generator) -> Take:
    """Two different objects without boxes; either is accepted."""
    return draw_pair(rng, boxes=False, equal=False)


def equal_swap(rng: np.random.Generator) -> Take:
    """Two equal objects change places, one passing before the other."""
    rig = draw_trust_rig(rng, share=0.35)
    take = draw_take(rng, rig=rig, boxes=False, travel=0.1, speed=(0.5, 2.0))
    side, front, radius = sideways_of(take), to_cameras(rig[0]), take.radius
    actor, middle = take.scene.actors[0], take.scene.frames / 2

    def swapping(path: Path, sign: float) -> Path:
        def swapped(frame: float) -> RigidTransform:
            angle = np.pi * np.clip((frame - middle) / 16 + 0.5, 0, 1)
            place = 1.3 * radius * sign * (np.cos(angle) * side + np.sin(angle) * front)
            return RigidTransform.from_translation(place) * path(frame)

        return swapped

    other = swapping(draw_motion(rng, radius, float(rng.uniform(0.5, 2)), travel=0.1), -1.0)
    take = add_actors(replace_object(take, swapping(actor.path, 1.0)), (Actor(actor.body, other),))
    return place_boxes(take) if rng.random() < 0.5 else replace(take, truths=(take.scene.actors[0].path, other))


def turntable_pair(rng: np.random.Generator) -> Take:
    """Two objects on one turntable; an equal third one rests beside it."""
    rig = draw_trust_rig(rng, share=0.3)
    take = draw_take(rng, rig=rig, axis=UP, travel=0.0)
    side, path, radius = sideways_of(take), take.scene.actors[0].path, take.radius
    offset = 1.3 * radius * side

    def on_table(sign: float) -> Path:
        return lambda frame: path(frame) * RigidTransform.from_translation(sign * offset)

    take = replace_object(take, on_table(1.0))
    resting = RigidTransform.from_translation(-2.6 * radius * to_cameras(rig[0]))
    others = (
        Actor(draw_body(rng, rig[0], radius), on_table(-1.0)),
        Actor(take.scene.actors[0].body, lambda _frame: resting),
    )
    return add_actors(take, others)


def other_first(rng: np.random.Generator) -> Take:
    """Another body moves first and is put down; the object starts then. With boxes."""
    begin = float(rng.integers(12, 18))
    rig = draw_trust_rig(rng, share=0.35)
    take = draw_take(rng, rig=rig, boxes=False, frames=40, travel=0.15, pace=lambda frame: max(frame - begin, 0.0))
    apart = 1.2 * take.radius * sideways_of(take)
    take = replace_object(take, shift_path(take.scene.actors[0].path, -apart))
    motion = pace_path(draw_motion(rng, take.radius, float(rng.uniform(1, 4)), travel=0.2), lambda t: min(t, begin))
    return place_boxes(add_actors(take, (Actor(draw_body(rng, rig[0], take.radius), shift_path(motion, apart)),)))


def occluder(rng: np.random.Generator) -> Take:
    """A board passes close before the object."""
    take = draw_take(rng, frames=40)
    front, side, radius = to_cameras(take.scene.rig), sideways_of(take), take.radius
    body, speed = make_board(rng, take.scene.rig, 1.2 * radius), float(rng.uniform(0.1, 0.25))
    path = lambda frame: RigidTransform.from_translation(radius * (1.6 * front + speed * (frame - 20) * side))  # noqa: E731
    return add_actors(take, (Actor(body, path),))


def taken_away(rng: np.random.Generator) -> Take:
    """The object vanishes for eight frames and comes back as it was moved on."""
    take = draw_take(rng, frames=40)
    path, body = take.scene.actors[0].path, take.scene.actors[0].body
    begin = float(rng.integers(12, 20))
    seen, later = show_during(path, -np.inf, begin), show_during(path, begin + 8)
    hidden = Actor(body, lambda frame: seen(frame) if frame < begin else later(frame))
    return replace(take, scene=replace(take.scene, actors=(hidden,)), truths=(path,))


# --- surfaces -------------------------------------------------------------------------------------------------------------


def repaint(take: Take, body: TexturedBody) -> Take:
    """Replace the object's body."""
    first, *others = take.scene.actors
    return replace(take, scene=replace(take.scene, actors=(Actor(body, first.path), *others)))


def checkered(rng: np.random.Generator) -> Take:
    """A repeated pattern on all faces."""
    take, cell = draw_take(rng), int(rng.integers(8, 18))
    body, textures = take.scene.actors[0].body, []
    for texture in take.scene.actors[0].body.textures:
        rows, columns = np.indices(texture.shape[:2]) // cell
        light = ((rows + columns) % 2 == 0)[..., None]
        grain = rng.normal(0, 4, (*texture.shape[:2], 1))
        textures.append(np.clip(np.where(light, 215, 45) + grain, 0, 255).astype(np.uint8).repeat(3, axis=2))
    return repaint(take, replace(body, textures=tuple(textures)))


def faint(rng: np.random.Generator) -> Take:
    """Little texture: 8 to 25 % of the contrast, and blurred."""
    take = draw_take(rng)
    body = reduce_contrast(take.scene.actors[0].body, float(rng.uniform(0.08, 0.25)))
    return repaint(take, blur_textures(body, float(rng.uniform(0.5, 2.0))))


def glossy(rng: np.random.Generator) -> Take:
    """A highlight stays where the light is while the object moves under it."""
    take = draw_take(rng)
    frames, n = take.scene.frames, len(take.scene.rig)
    places = rng.uniform(0.25, 0.75, (1, n, 2)) + 0.15 * np.sin(np.arange(frames) / 9)[:, None, None]
    return replace(take, effects=(shine(places, float(rng.uniform(0.1, 0.25)), 150.0, on_object=True),))


def transparent(rng: np.random.Generator) -> Take:
    """The wall shines through a half of the object."""
    take = draw_take(rng)
    return replace(take, effects=(see_through(float(rng.uniform(0.4, 0.8)), float(rng.uniform(0.3, 0.7))),))


def spinning_sphere(rng: np.random.Generator) -> Take:
    """A textured ball that turns about its axis."""

    def ball(rng: np.random.Generator, rig: Rig, radius: float) -> TexturedBody:
        points = rng.standard_normal((90, 3))
        points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
        return TexturedBody.from_hull(points, texture_resolution(rig), int(rng.integers(1 << 30)))

    return draw_take(rng, body=ball, axis=draw_direction(rng), travel=0.0)


def spinning_bottle(rng: np.random.Generator) -> Take:
    """A faintly textured bottle that turns about its axis."""

    def bottle(rng: np.random.Generator, rig: Rig, radius: float) -> TexturedBody:
        angles, half = np.linspace(0, 2 * np.pi, 24, endpoint=False), float(rng.uniform(0.3, 0.5)) * radius
        ring = half * np.column_stack([np.cos(angles), np.zeros(24), np.sin(angles)])
        points = np.concatenate([ring + np.array([0, y * radius, 0]) for y in (-0.85, 0.85)])
        body = TexturedBody.from_hull(points, texture_resolution(rig), int(rng.integers(1 << 30)))
        return reduce_contrast(body, float(rng.uniform(0.3, 1.0)))

    return draw_take(rng, body=bottle, axis=UP, travel=float(rng.choice([0.0, 0.2])))


def equal_faces(rng: np.random.Generator) -> Take:
    """A cube with the same picture on all faces."""

    def cube(rng: np.random.Generator, rig: Rig, radius: float) -> TexturedBody:
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * radius / np.sqrt(3)
        body = TexturedBody.from_hull(corners, texture_resolution(rig), int(rng.integers(1 << 30)))
        return replace(body, textures=(body.textures[0],) * len(body.textures))

    return draw_take(rng, body=cube, speed=(2.0, 5.0))


# --- not rigid ------------------------------------------------------------------------------------------------------------


def deforming(rng: np.random.Generator) -> Take:
    """A soft body that is stretched by 10 to 30 % as it moves, without rotating on the whole."""
    take = draw_take(rng)
    body, path = take.scene.actors[0].body, take.scene.actors[0].path
    strains, periods = rng.normal(0, rng.uniform(0.05, 0.15), (2, 3, 3)), rng.uniform(10, 40, 2)
    strains = (strains + strains.transpose(0, 2, 1)) / 2
    soft = []
    for k in range(take.scene.frames):
        linear = np.eye(3) + np.einsum("i,ijk->jk", np.sin(2 * np.pi * k / periods), strains)
        soft.append(Actor(transform_body(body, linear), show_during(path, k - 0.5, k + 0.5)))
    return replace(take, scene=replace(take.scene, actors=tuple(soft)), truths=(path,))


def hinged(rng: np.random.Generator) -> Take:
    """Two halves that hinge, as a book; either half is accepted."""
    rig = draw_trust_rig(rng, share=0.4)
    take = draw_take(rng, rig=rig, boxes=False, travel=0.2, body=draw_block)
    path, radius = take.scene.actors[0].path, take.radius
    amplitude, period = float(rng.uniform(0.3, 0.9)), float(rng.uniform(20, 50))

    def leaf(sign: float) -> Path:
        def on_hinge(frame: float) -> RigidTransform:
            angle = sign * amplitude * np.sin(2 * np.pi * frame / period)
            about = RigidTransform.from_rotation(Rotation.from_euler("y", angle))
            return path(frame) * about * RigidTransform.from_translation([sign * 0.75 * radius, 0.0, 0.0])

        return on_hinge

    paths = leaf(1.0), leaf(-1.0)
    bodies = [draw_block(rng, rig[0], 0.75 * radius) for _ in paths]
    actors = tuple(Actor(body, path) for body, path in zip(bodies, paths, strict=True))
    take = replace(take, scene=replace(take.scene, actors=actors), truths=paths)
    return place_boxes(take) if rng.random() < 0.5 else take


PEOPLE = index_by_name(
    [
        person_behind_object,
        person_beside,
        person_holding,
        one_handed,
        waves_then_lifts,
        waves_long,
        arm_across,
        passer_by,
        person_walks_behind,
        two_persons,
        fingers,
    ]
)
SEVERAL = index_by_name(
    [equal_pair, larger_beside, two_objects, equal_swap, turntable_pair, other_first, occluder, taken_away]
)
SURFACES = index_by_name([checkered, faint, glossy, transparent, spinning_sphere, spinning_bottle, equal_faces])
NOT_RIGID = index_by_name([deforming, hinged])
