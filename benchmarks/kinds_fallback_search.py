"""The kinds of scenes in which the object is hard to see: it jumps from frame to frame, something stands in front of it, the
lens is long, there is little on it to go by, or it looks alike from several sides. A part of `benchmarks/kinds_scenes.py`.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_scenes import Kind, Take, any_body, block, boxes_of, moving, named, rig_of, texels
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.rig import Rig
from sylpose.simulate import Actor, Scene, TexturedBody, chamfered_box

__all__ = ["THOROUGH", "plain_paint", "steps"]

# Full HD and five megapixels, and the focal length of their lens, pixels.
FULL_HD, FIVE_MP, LONG = (1920, 1080), (2448, 2048), 5000.0


def steps(
    rng: np.random.Generator,
    degrees: float,
    rig: Rig,
    body: TexturedBody,
    radius: float,
    frames: int,
    others: tuple[Actor, ...] = (),
    drift: float = 0.05,
) -> Take:
    """Turns by so much from frame to frame throughout, and drifts by so many radii; with boxes or without.

    Args:
        others: what stands before it.
    """
    way = np.cumsum(rng.normal(0, drift * radius, (frames, 3)), axis=0)
    path = moving(rng, degrees * np.arange(float(frames)), way)
    scene = Scene(rig, (Actor(body, path), *others), frames, int(rng.integers(1 << 30)))
    return Take(scene, boxes_of(scene, 1.05) if rng.random() < 0.5 else None, radius)


def jumps(rng: np.random.Generator, degrees: float) -> Take:
    """Turns by so many degrees from frame to frame throughout."""
    rig, radius = rig_of(rng, share=0.55)
    return steps(rng, degrees, rig, any_body(rng, rig, radius), radius, 24)


def jumps_15(rng: np.random.Generator) -> Take:
    """15 degrees from frame to frame."""
    return jumps(rng, 15.0)


def jumps_20(rng: np.random.Generator) -> Take:
    """20 degrees from frame to frame."""
    return jumps(rng, 20.0)


def jumps_25(rng: np.random.Generator) -> Take:
    """25 degrees from frame to frame."""
    return jumps(rng, 25.0)


def apart(rng: np.random.Generator, cameras: int, spacing: float) -> Take:
    """10 to 20 degrees from frame to frame, seen by so many cameras, neighbours so many degrees apart."""
    rig, radius = rig_of(rng, cameras, spacing=spacing, share=0.55)
    return steps(rng, float(rng.uniform(10, 20)), rig, any_body(rng, rig, radius), radius, 24)


def two_at_60(rng: np.random.Generator) -> Take:
    """Two cameras 60 degrees apart."""
    return apart(rng, 2, 60.0)


def three_at_30(rng: np.random.Generator) -> Take:
    """Three cameras, neighbours 30 degrees apart."""
    return apart(rng, 3, 30.0)


# --- something in front ---------------------------------------------------------------------------------------------------


def standing_at(place: FloatArray, sides: FloatArray, turn: Rotation, rig: Rig, rng: np.random.Generator) -> Actor:
    """A textured box that stands still."""
    pose = RigidTransform.from_components(place, turn)
    return Actor(chamfered_box(sides, texels(rig), seed=int(rng.integers(1 << 30))), lambda _: pose)


def rod(rng: np.random.Generator) -> Take:
    """10 to 20 degrees from frame to frame, a rod standing before it in one camera's view, sometimes two."""
    rig, radius = rig_of(rng, share=0.55)
    body, rods = any_body(rng, rig, radius), []
    for c in rng.permutation(len(rig))[: int(rng.integers(1, 3))]:
        to_camera = rig.cameras[c].center / np.linalg.norm(rig.cameras[c].center)
        side = np.cross(to_camera, [0.0, 1.0, 0.0])
        place = 1.4 * radius * to_camera + rng.uniform(-0.3, 0.3) * radius * side
        lean = Rotation.from_rotvec(rng.uniform(-0.6, 0.6) * to_camera)
        thick = rng.uniform(0.12, 0.3) * radius
        rods.append(standing_at(place, np.array([thick, 5.0 * radius, thick]), lean, rig, rng))
    return steps(rng, float(rng.uniform(10, 20)), rig, body, radius, 24, tuple(rods), drift=0.01)


def holder(rng: np.random.Generator) -> Take:
    """10 to 20 degrees from frame to frame, above a textured holder that stands in front of its lower part too."""
    rig, radius = rig_of(rng, share=0.5)
    body = any_body(rng, rig, radius)
    turn = Rotation.from_rotvec([0.0, rng.uniform(0, np.pi), 0.0])
    below = standing_at(np.array([0.0, 1.6 * radius, 0.0]), radius * np.array([2.2, 0.9, 2.2]), turn, rig, rng)
    to_cameras = np.mean([camera.center for camera in rig], axis=0) * [1.0, 0.0, 1.0]
    front = 1.5 * radius * to_cameras / np.linalg.norm(to_cameras) + [0.0, rng.uniform(0.5, 0.9) * radius, 0.0]
    clamp = standing_at(front, radius * rng.uniform([0.5, 0.5, 0.3], [1.4, 0.9, 0.5]), turn, rig, rng)
    return steps(rng, float(rng.uniform(10, 20)), rig, body, radius, 24, (below, clamp), drift=0.01)


# --- the lens -------------------------------------------------------------------------------------------------------------


def through_long_lens(rng: np.random.Generator, size: tuple[int, int], focal: float, frames: int) -> Take:
    """10 to 20 degrees from frame to frame; it fills the image, and a rod stands before it in one camera's view or none."""
    rig, radius = rig_of(rng, size=size, share=rng.uniform(0.7, 0.9), distance=1.5, focal=focal)
    others: tuple[Actor, ...] = ()
    if rng.random() < 0.5:
        camera = rig.cameras[int(rng.integers(len(rig)))]
        to_camera = camera.center / np.linalg.norm(camera.center)
        sides = radius * np.array([0.2, 6.0, 0.2])
        others = (standing_at(1.4 * radius * to_camera, sides, Rotation.identity(), rig, rng),)
    return steps(rng, float(rng.uniform(10, 20)), rig, any_body(rng, rig, radius), radius, frames, others, drift=0.01)


def long_lens(rng: np.random.Generator) -> Take:
    """Small images of what `full-hd` sees."""
    return through_long_lens(rng, SMALL, LONG * SMALL[0] / FULL_HD[0], 16)


def full_hd(rng: np.random.Generator) -> Take:
    """Full HD, f = 5,000 px."""
    return through_long_lens(rng, FULL_HD, LONG, 8)


def five_mp(rng: np.random.Generator) -> Take:
    """Five megapixels, f = 5,000 px."""
    return through_long_lens(rng, FIVE_MP, LONG, 6)


# Full HD made four times smaller.
SMALL = (480, 270)


# --- the looks ------------------------------------------------------------------------------------------------------------


def plain(rng: np.random.Generator) -> Take:
    """8 to 15 degrees from frame to frame, and little paint: some marks on each face, of which 60 to 200 are matched."""
    rig, radius = rig_of(rng, share=0.6)
    body = plain_paint(any_body(rng, rig, radius), rng)
    return steps(rng, float(rng.uniform(8, 15)), rig, body, radius, 24)


def plain_paint(body: TexturedBody, rng: np.random.Generator) -> TexturedBody:
    """A body in plain paint with some marks on each face."""
    colours = rng.uniform(110, 170, 3)
    density = float(rng.uniform(1 / 1000, 1 / 350))
    return replace(body, textures=tuple(marked(texture, colours, density, rng) for texture in body.textures))


def marked(texture: Image, colour: FloatArray, density: float, rng: np.random.Generator) -> Image:
    """Plain paint of a colour (3,) with faint marks on it, so many per pixel."""
    height, width = texture.shape[:2]
    image = np.ascontiguousarray(np.broadcast_to(np.rint(colour), (height, width, 3)).astype(np.uint8))
    for _ in range(rng.poisson(density * width * height)):
        shade = np.clip(colour + rng.uniform(15, 70) * rng.choice([-1, 1]), 0, 255)
        corners = rng.uniform([0, 0], [width, height]) + rng.normal(0, rng.uniform(3, 7), (int(rng.integers(3, 6)), 2))
        hull = cv2.convexHull(np.rint(corners * 16).astype(np.int32))
        cv2.fillPoly(image, [hull], tuple(map(float, shade)), cv2.LINE_AA, 4)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), dtype=np.uint8)


def checkered(rng: np.random.Generator) -> Take:
    """A checkered cube, 5 to 20 degrees from frame to frame: all faces alike, but for some dirt on most of them."""
    rig, radius = rig_of(rng, share=0.6)
    side = 2 * radius / np.sqrt(3)
    corners = side / 2 * np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    body = TexturedBody.hull(corners, texels(rig), 0)
    count, dirt = int(rng.integers(4, 8)), float(rng.choice([0.0, 1 / 3000, 1 / 800]))
    body = replace(body, textures=tuple(checks(texture, count, dirt, rng) for texture in body.textures))
    return steps(rng, float(rng.uniform(5, 20)), rig, body, radius, 24)


def checks(texture: Image, count: int, dirt: float, rng: np.random.Generator) -> Image:
    """A board of count x count fields, with so many specks per pixel."""
    height, width = texture.shape[:2]
    column, row = np.arange(width) * count // width, np.arange(height) * count // height
    dark = (column[None] + row[:, None]) % 2 == 0
    image = np.ascontiguousarray(np.repeat(np.where(dark, 60, 205).astype(np.uint8)[..., None], 3, axis=2))
    for _ in range(rng.poisson(dirt * width * height)):
        x, y = int(rng.uniform(0, width)), int(rng.uniform(0, height))
        cv2.circle(image, (x, y), int(rng.integers(1, 5)), tuple(map(float, rng.uniform(30, 230, 3))), -1, cv2.LINE_AA)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), dtype=np.uint8)


def alike_blocks(rng: np.random.Generator) -> Take:
    """A box whose faces all show the same picture, turned by quarters, 8 to 18 degrees from frame to frame."""
    rig, radius = rig_of(rng, share=0.6)
    body = block(rng, rig, radius)
    largest = max(body.textures, key=lambda t: t.shape[0] * t.shape[1])

    def same(texture: Image) -> Image:
        picture = np.rot90(largest, int(rng.integers(4)))
        picture = np.tile(
            picture, (1 + texture.shape[0] // picture.shape[0], 1 + texture.shape[1] // picture.shape[1], 1)
        )
        return np.ascontiguousarray(picture[: texture.shape[0], : texture.shape[1]])

    body = replace(body, textures=tuple(same(texture) for texture in body.textures))
    return steps(rng, float(rng.uniform(8, 18)), rig, body, radius, 24)


THOROUGH: dict[str, Kind] = named(
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
# Few seeds of these: they take minutes.
LARGE: dict[str, Kind] = named([full_hd, five_mp])
