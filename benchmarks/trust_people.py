"""Articulated textured persons for `benchmarks/trust.py`: trunk, head, and two arms of two links with hands.

Lengths are for an object of 0.2 m radius, and are scaled with the object's. A person looks at the cameras.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_feature_poor import reduce_contrast
from benchmarks.kinds_scenes import texture_resolution
from benchmarks.trust_takes import PERSON_RADIUS, Take, to_cameras
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import Actor, TexturedBody
from sylpose.simulate.render import Path

__all__ = ["Arm", "add_actors", "add_person", "hold_with", "make_person", "swing_arm", "wave_arm"]

TRUNK, HEAD = np.array([0.40, 0.62, 0.22]), np.array([0.09, 0.13, 0.11])
SHOULDER, NECK = np.array([0.25, -0.26, 0.0]), np.array([0.0, -0.47, -0.02])
UPPER_ARM, FOREARM = 0.30, 0.27
LIMB, HAND = (0.10, 0.08), np.array([0.09, 0.16, 0.05])

# Elbow and hand in the world, of a trunk's pose, a shoulder, the scale and a time.
Arm = Callable[[RigidTransform, FloatArray, float, float], tuple[FloatArray, FloatArray]]


def swing_arm(rng: np.random.Generator, side: float) -> Arm:
    """Let an arm swing, as when walking or gesturing."""
    amplitude, period, phase = rng.uniform([0.2, 20.0, 0.0], [0.7, 50.0, 2 * np.pi])
    lift, bend, outwards = rng.uniform([0.0, 0.3, 0.05], [0.8, 1.5, 0.4])

    def arm(trunk: RigidTransform, shoulder: FloatArray, scale: float, frame: float) -> tuple[FloatArray, FloatArray]:
        swing = amplitude * np.sin(2 * np.pi * frame / period + phase)
        upper = Rotation.from_euler("zx", [-side * outwards, -lift - swing])
        lower = upper * Rotation.from_euler("x", -bend - 0.6 * swing)
        elbow = shoulder + trunk.rotation.apply(upper.apply([0.0, scale * UPPER_ARM, 0.0]))
        return elbow, elbow + trunk.rotation.apply(lower.apply([0.0, scale * FOREARM, 0.0]))

    return arm


def wave_arm(rng: np.random.Generator, side: float) -> Arm:
    """Let a raised arm wave."""
    period, phase, amplitude = rng.uniform([12.0, 0.0, 0.3], [25.0, 2 * np.pi, 0.8])

    def arm(trunk: RigidTransform, shoulder: FloatArray, scale: float, frame: float) -> tuple[FloatArray, FloatArray]:
        wave = amplitude * np.sin(2 * np.pi * frame / period + phase)
        upper = Rotation.from_euler("z", -side * (1.6 + 0.3 * wave))
        lower = Rotation.from_euler("z", -side * (2.8 + wave))
        elbow = shoulder + trunk.rotation.apply(upper.apply([0.0, scale * UPPER_ARM, 0.0]))
        return elbow, elbow + trunk.rotation.apply(lower.apply([0.0, scale * FOREARM, 0.0]))

    return arm


def hold_with(path: Path, grip: FloatArray, begin: float = 0.0, before: Arm | None = None) -> Arm:
    """Keep a hand at a point (3,) of a moving object, from a time on; until then the arm moves as `before`."""

    def arm(trunk: RigidTransform, shoulder: FloatArray, scale: float, frame: float) -> tuple[FloatArray, FloatArray]:
        hand = path(frame).apply(grip)
        if before is not None and frame < begin:
            elbow, free = before(trunk, shoulder, scale, frame)
            share = np.clip((frame - begin + 6.0) / 6.0, 0.0, 1.0)  # the hand approaches within six frames
            if share == 0:
                return elbow, free
            hand = (1 - share) * free + share * hand
        return _bend_elbow(shoulder, hand, scale), hand

    return arm


def _bend_elbow(shoulder: FloatArray, hand: FloatArray, scale: float) -> FloatArray:
    """Place the elbow below the line from shoulder to hand, at the links' lengths where the hand is within reach."""
    line = hand - shoulder
    distance = float(np.linalg.norm(line))
    along = line / max(distance, 1e-9)
    a, b = scale * UPPER_ARM, scale * FOREARM
    if distance >= a + b:
        return np.asarray(shoulder + a / (a + b) * line)
    to_foot = (a**2 - b**2 + distance**2) / max(2 * distance, 1e-9)
    below = np.array([0.0, 1.0, 0.0]) - along[1] * along
    height = np.sqrt(max(a**2 - to_foot**2, 0.0))
    return np.asarray(shoulder + to_foot * along + height * below / max(float(np.linalg.norm(below)), 1e-9))


def _link_pose(start: FloatArray, end: FloatArray, sideways: FloatArray) -> RigidTransform:
    """Return the pose of a link, its y axis from start to end, its center in their middle."""
    y = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    z = np.cross(sideways, y)
    z /= max(float(np.linalg.norm(z)), 1e-9)
    rotation = Rotation.from_matrix(np.column_stack([np.cross(y, z), y, z]))
    return RigidTransform.from_components((start + end) / 2, rotation)


def make_person(
    rng: np.random.Generator,
    rig: Rig,
    radius: float,
    *,
    behind: float,
    aside: float,
    left: Arm | None = None,
    right: Arm | None = None,
    walk: float = 0.0,
) -> tuple[Actor, ...]:
    """Make a person near the object.

    Args:
        rng: random generator.
        rig: the cameras.
        radius: of the object.
        behind, aside: position of the trunk, in object radii: away from the cameras, and to the right of their middle.
        left, right: motions of the arms; None: drawn.
        walk: sideways speed, radii per frame.
    """
    scale, resolution = radius / PERSON_RADIUS, texture_resolution(rig)
    front = to_cameras(rig)
    basis = np.column_stack([np.cross([0.0, 1.0, 0.0], -front), [0.0, 1.0, 0.0], -front])
    upright, sideways = Rotation.from_matrix(basis), basis[:, 0]
    start = radius * (-behind * front + aside * sideways) + scale * np.array([0.0, rng.uniform(-0.1, 0.25), 0.0])
    sway, bob = rng.uniform([0.02, 0.005], [0.12, 0.03])
    period, phase = rng.uniform([25.0, 0.0], [70.0, 2 * np.pi])
    contrast = float(rng.uniform(0.35, 1.0))

    def trunk_path(frame: float) -> RigidTransform:
        t = 2 * np.pi * frame / period + phase
        lean = Rotation.from_euler(
            "yxz", [sway * np.sin(t), 0.5 * sway * np.cos(1.3 * t), 0.4 * sway * np.sin(0.7 * t)]
        )
        offset = walk * radius * frame * sideways + scale * bob * np.array(
            [np.sin(t), np.cos(1.7 * t), np.sin(0.8 * t)]
        )
        return RigidTransform.from_components(start + offset, upright * lean)

    def attach(place: FloatArray) -> Path:
        turn, speed = rng.uniform([0.05, 20.0], [0.4, 50.0])

        def path(frame: float) -> RigidTransform:
            turned = Rotation.from_euler("y", turn * np.sin(2 * np.pi * frame / speed))
            return trunk_path(frame) * RigidTransform.from_components(scale * place, turned)

        return path

    def limb(sides: FloatArray, ratio: float) -> TexturedBody:
        half = scale * np.asarray(sides) / 2
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
        body = TexturedBody.from_hull(corners, resolution, int(rng.integers(1 << 30)))
        return reduce_contrast(body, contrast * ratio)

    round_points = rng.standard_normal((24, 3))
    round_points *= scale * HEAD / np.linalg.norm(round_points, axis=1, keepdims=True)
    head = TexturedBody.from_hull(round_points, resolution, int(rng.integers(1 << 30)))
    actors = [Actor(limb(TRUNK, 1.0), trunk_path), Actor(reduce_contrast(head, 0.6), attach(NECK))]
    for side, given in ((-1.0, left), (1.0, right)):
        arm = swing_arm(rng, side) if given is None else given
        joint = scale * SHOULDER * [side, 1.0, 1.0]

        def link(which: int, arm: Arm = arm, joint: FloatArray = joint) -> Path:
            def path(frame: float) -> RigidTransform:
                trunk = trunk_path(frame)
                shoulder = trunk.apply(joint)
                elbow, hand = arm(trunk, shoulder, scale, frame)
                forearm = (hand - elbow) / max(float(np.linalg.norm(hand - elbow)), 1e-9)
                ends = (
                    (shoulder, elbow),
                    (elbow, hand),
                    (hand - 0.05 * scale * forearm, hand + 0.05 * scale * forearm),
                )
                start, end = ends[which]
                return _link_pose(start, end, sideways)

            return path

        sizes = (np.array([LIMB[0], UPPER_ARM, LIMB[0]]), np.array([LIMB[1], FOREARM, LIMB[1]]), HAND)
        actors += [
            Actor(limb(size, ratio), link(i)) for i, (size, ratio) in enumerate(zip(sizes, (1, 0.8, 0.6), strict=True))
        ]
    return tuple(actors)


def add_actors(take: Take, actors: tuple[Actor, ...]) -> Take:
    """Add actors to a take's scene."""
    return replace(take, scene=replace(take.scene, actors=(*take.scene.actors, *actors)))


def add_person(take: Take, rng: np.random.Generator) -> Take:
    """Add a person behind or beside the object, with swinging or waving arms."""
    arms = [(wave_arm if rng.random() < 0.3 else swing_arm)(rng, side) for side in (-1.0, 1.0)]
    aside = float(rng.uniform(0.0, 3.5) * rng.choice([-1, 1]))
    person = make_person(
        rng, take.scene.rig, take.radius, behind=float(rng.uniform(2.2, 4.0)), aside=aside, left=arms[0], right=arms[1]
    )
    return add_actors(take, person)
