"""Kinds of scenes that need the fallback search: large motions, occluders, long focal lengths, few or ambiguous features.

They extend `benchmarks/kinds_scenes.py`. A kind's name, which is that of its function, is part of the seed.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_scenes import (
    Kind,
    Variation,
    compute_boxes,
    draw_block,
    draw_body,
    draw_rig,
    index_by_name,
    make_path,
    texture_resolution,
)
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.rig import Rig
from sylpose.simulate import Actor, Scene, TexturedBody, chamfered_box

__all__ = ["FALLBACK_SEARCH", "apply_weak_texture", "make_stepwise_variation"]

# Image sizes of full HD and five megapixels, and their focal length, pixels.
FULL_HD, FIVE_MP, LONG_FOCAL = (1920, 1080), (2448, 2048), 5000.0


def make_stepwise_variation(
    rng: np.random.Generator,
    degrees: float,
    rig: Rig,
    body: TexturedBody,
    radius: float,
    frames: int,
    occluders: tuple[Actor, ...] = (),
    drift: float = 0.05,
) -> Variation:
    """Make a variation with a constant rotation per frame and a random drift, with or without boxes.

    Args:
        rng: random generator.
        degrees: rotation per frame.
        rig, body, radius: cameras, object, and its radius.
        frames: number of frames.
        occluders: occluders in front of the object.
        drift: standard deviation of the translation per frame and axis, radii.
    """
    translations = np.cumsum(rng.normal(0, drift * radius, (frames, 3)), axis=0)
    path = make_path(rng, degrees * np.arange(float(frames)), translations)
    scene = Scene(rig, (Actor(body, path), *occluders), frames, int(rng.integers(1 << 30)))
    return Variation(scene, compute_boxes(scene, 1.05) if rng.random() < 0.5 else None, radius)


def draw_jumps(rng: np.random.Generator, degrees: float) -> Variation:
    """Make a variation of any body that rotates by `degrees` per frame."""
    rig, radius = draw_rig(rng, share=0.55)
    return make_stepwise_variation(rng, degrees, rig, draw_body(rng, rig, radius), radius, 24)


def jumps_15(rng: np.random.Generator) -> Variation:
    """15 degrees per frame."""
    return draw_jumps(rng, 15.0)


def jumps_20(rng: np.random.Generator) -> Variation:
    """20 degrees per frame."""
    return draw_jumps(rng, 20.0)


def jumps_25(rng: np.random.Generator) -> Variation:
    """25 degrees per frame."""
    return draw_jumps(rng, 25.0)


def draw_spaced_cameras(rng: np.random.Generator, cameras: int, spacing: float) -> Variation:
    """Make a variation with 10 to 20 degrees per frame and cameras `spacing` degrees apart."""
    rig, radius = draw_rig(rng, cameras, spacing=spacing, share=0.55)
    return make_stepwise_variation(rng, float(rng.uniform(10, 20)), rig, draw_body(rng, rig, radius), radius, 24)


def two_at_60(rng: np.random.Generator) -> Variation:
    """Two cameras 60 degrees apart."""
    return draw_spaced_cameras(rng, 2, 60.0)


def three_at_30(rng: np.random.Generator) -> Variation:
    """Three cameras, 30 degrees apart."""
    return draw_spaced_cameras(rng, 3, 30.0)


# --- occluders ------------------------------------------------------------------------------------------------------------


def make_static_box(
    position: FloatArray, sides: FloatArray, rotation: Rotation, rig: Rig, rng: np.random.Generator
) -> Actor:
    """Make a static textured box."""
    pose = RigidTransform.from_components(position, rotation)
    return Actor(chamfered_box(sides, texture_resolution(rig), seed=int(rng.integers(1 << 30))), lambda _: pose)


def rod(rng: np.random.Generator) -> Variation:
    """10 to 20 degrees per frame; a rod occludes the object in one camera or two."""
    rig, radius = draw_rig(rng, share=0.55)
    body, rods = draw_body(rng, rig, radius), []
    for c in rng.permutation(len(rig))[: int(rng.integers(1, 3))]:
        to_camera = rig.cameras[c].center / np.linalg.norm(rig.cameras[c].center)
        side = np.cross(to_camera, [0.0, 1.0, 0.0])
        position = 1.4 * radius * to_camera + rng.uniform(-0.3, 0.3) * radius * side
        rotation = Rotation.from_rotvec(rng.uniform(-0.6, 0.6) * to_camera)
        thickness = rng.uniform(0.12, 0.3) * radius
        rods.append(make_static_box(position, np.array([thickness, 5.0 * radius, thickness]), rotation, rig, rng))
    return make_stepwise_variation(rng, float(rng.uniform(10, 20)), rig, body, radius, 24, tuple(rods), drift=0.01)


def holder(rng: np.random.Generator) -> Variation:
    """10 to 20 degrees per frame, on a textured holder that also occludes the object's lower part."""
    rig, radius = draw_rig(rng, share=0.5)
    body = draw_body(rng, rig, radius)
    rotation = Rotation.from_rotvec([0.0, rng.uniform(0, np.pi), 0.0])
    below = make_static_box(np.array([0.0, 1.6 * radius, 0.0]), radius * np.array([2.2, 0.9, 2.2]), rotation, rig, rng)
    to_cameras = np.mean([camera.center for camera in rig], axis=0) * [1.0, 0.0, 1.0]
    front = 1.5 * radius * to_cameras / np.linalg.norm(to_cameras) + [0.0, rng.uniform(0.5, 0.9) * radius, 0.0]
    clamp = make_static_box(front, radius * rng.uniform([0.5, 0.5, 0.3], [1.4, 0.9, 0.5]), rotation, rig, rng)
    return make_stepwise_variation(rng, float(rng.uniform(10, 20)), rig, body, radius, 24, (below, clamp), drift=0.01)


# --- the lens -------------------------------------------------------------------------------------------------------------


def draw_long_focal(rng: np.random.Generator, size: tuple[int, int], focal: float, frames: int) -> Variation:
    """Make a variation with 10 to 20 degrees per frame that fills the image; a rod may occlude one camera's view."""
    rig, radius = draw_rig(rng, size=size, share=rng.uniform(0.7, 0.9), distance=1.5, focal=focal)
    occluders: tuple[Actor, ...] = ()
    if rng.random() < 0.5:
        camera = rig.cameras[int(rng.integers(len(rig)))]
        to_camera = camera.center / np.linalg.norm(camera.center)
        sides = radius * np.array([0.2, 6.0, 0.2])
        occluders = (make_static_box(1.4 * radius * to_camera, sides, Rotation.identity(), rig, rng),)
    return make_stepwise_variation(
        rng, float(rng.uniform(10, 20)), rig, draw_body(rng, rig, radius), radius, frames, occluders, drift=0.01
    )


def long_lens(rng: np.random.Generator) -> Variation:
    """The views of `full-hd` in small images."""
    return draw_long_focal(rng, SMALL_SIZE, LONG_FOCAL * SMALL_SIZE[0] / FULL_HD[0], 16)


def full_hd(rng: np.random.Generator) -> Variation:
    """Full HD, f = 5,000 px."""
    return draw_long_focal(rng, FULL_HD, LONG_FOCAL, 8)


def five_mp(rng: np.random.Generator) -> Variation:
    """Five megapixels, f = 5,000 px."""
    return draw_long_focal(rng, FIVE_MP, LONG_FOCAL, 6)


# A quarter of full HD.
SMALL_SIZE = (480, 270)


# --- appearance -----------------------------------------------------------------------------------------------------------


def plain(rng: np.random.Generator) -> Variation:
    """8 to 15 degrees per frame; weak texture with some marks on each face, which give 60 to 200 matches."""
    rig, radius = draw_rig(rng, share=0.6)
    body = apply_weak_texture(draw_body(rng, rig, radius), rng)
    return make_stepwise_variation(rng, float(rng.uniform(8, 15)), rig, body, radius, 24)


def apply_weak_texture(body: TexturedBody, rng: np.random.Generator) -> TexturedBody:
    """Replace a body's textures by a plain color with some marks on each face."""
    color = rng.uniform(110, 170, 3)
    density = float(rng.uniform(1 / 1000, 1 / 350))
    return replace(body, textures=tuple(draw_marks(texture, color, density, rng) for texture in body.textures))


def draw_marks(texture: Image, color: FloatArray, density: float, rng: np.random.Generator) -> Image:
    """Return a texture of a plain color (3,) with faint marks, `density` per pixel."""
    height, width = texture.shape[:2]
    image = np.ascontiguousarray(np.broadcast_to(np.rint(color), (height, width, 3)).astype(np.uint8))
    for _ in range(rng.poisson(density * width * height)):
        shade = np.clip(color + rng.uniform(15, 70) * rng.choice([-1, 1]), 0, 255)
        corners = rng.uniform([0, 0], [width, height]) + rng.normal(0, rng.uniform(3, 7), (int(rng.integers(3, 6)), 2))
        hull = cv2.convexHull(np.rint(corners * 16).astype(np.int32))
        cv2.fillPoly(image, [hull], tuple(map(float, shade)), cv2.LINE_AA, 4)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), dtype=np.uint8)


def checkered(rng: np.random.Generator) -> Variation:
    """A checkered cube, 5 to 20 degrees per frame; all faces are equal except for dirt on most of them."""
    rig, radius = draw_rig(rng, share=0.6)
    side = 2 * radius / np.sqrt(3)
    corners = side / 2 * np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    body = TexturedBody.from_hull(corners, texture_resolution(rig), 0)
    count, dirt = int(rng.integers(4, 8)), float(rng.choice([0.0, 1 / 3000, 1 / 800]))
    body = replace(body, textures=tuple(draw_checkerboard(texture, count, dirt, rng) for texture in body.textures))
    return make_stepwise_variation(rng, float(rng.uniform(5, 20)), rig, body, radius, 24)


def draw_checkerboard(texture: Image, count: int, dirt: float, rng: np.random.Generator) -> Image:
    """Return a checkerboard texture of count x count fields with `dirt` specks per pixel."""
    height, width = texture.shape[:2]
    column, row = np.arange(width) * count // width, np.arange(height) * count // height
    dark = (column[None] + row[:, None]) % 2 == 0
    image = np.ascontiguousarray(np.repeat(np.where(dark, 60, 205).astype(np.uint8)[..., None], 3, axis=2))
    for _ in range(rng.poisson(dirt * width * height)):
        x, y = int(rng.uniform(0, width)), int(rng.uniform(0, height))
        cv2.circle(image, (x, y), int(rng.integers(1, 5)), tuple(map(float, rng.uniform(30, 230, 3))), -1, cv2.LINE_AA)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), dtype=np.uint8)


def alike_blocks(rng: np.random.Generator) -> Variation:
    """A box with the same picture on all faces, rotated by multiples of 90 degrees; 8 to 18 degrees per frame."""
    rig, radius = draw_rig(rng, share=0.6)
    body = draw_block(rng, rig, radius)
    largest = max(body.textures, key=lambda t: t.shape[0] * t.shape[1])

    def same(texture: Image) -> Image:
        picture = np.rot90(largest, int(rng.integers(4)))
        picture = np.tile(
            picture, (1 + texture.shape[0] // picture.shape[0], 1 + texture.shape[1] // picture.shape[1], 1)
        )
        return np.ascontiguousarray(picture[: texture.shape[0], : texture.shape[1]])

    body = replace(body, textures=tuple(same(texture) for texture in body.textures))
    return make_stepwise_variation(rng, float(rng.uniform(8, 18)), rig, body, radius, 24)


FALLBACK_SEARCH: dict[str, Kind] = index_by_name(
    [
        jumps_15,
        jumps_20,
        jumps_25,
        two_at_60,
        three_at_30,
        rod,
        holder,
        long_lens,
        plain,
        checkered,
        alike_blocks,
    ]
)
# These take minutes each: run few seeds.
LARGE: dict[str, Kind] = index_by_name([full_hd, five_mp])
