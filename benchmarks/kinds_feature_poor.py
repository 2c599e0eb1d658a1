"""The kinds of scenes of `benchmarks/kinds.py` in which SIFT starves: faint or blurred paint, large steps from frame to
frame, an object that comes back elsewhere after it was gone. A part of `benchmarks/kinds_scenes.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_fallback_search import steps
from benchmarks.kinds_scenes import Kind, Take, any_body, boxes_of, moving, named, rig_of, unit
from sylpose.geometry.arrays import Image
from sylpose.simulate import Actor, Scene, TexturedBody

__all__ = ["STARVING"]

FRAMES = 16
# Where it is not, in radii: behind what the cameras see.
AWAY = 1000.0


def faded(body: TexturedBody, contrast: float) -> TexturedBody:
    """Its faces with so much of their contrast about their mean colours."""

    def of(texture: Image) -> Image:
        mean = texture.mean(axis=(0, 1))
        return np.asarray(np.clip(np.rint(mean + contrast * (texture - mean)), 0, 255), dtype=np.uint8)

    return replace(body, textures=tuple(of(texture) for texture in body.textures))


def softened(body: TexturedBody, texels: float) -> TexturedBody:
    """Its faces blurred by a Gaussian of that standard deviation."""
    return replace(
        body, textures=tuple(np.asarray(cv2.GaussianBlur(t, (0, 0), texels), np.uint8) for t in body.textures)
    )


def painted(rng: np.random.Generator, change: Callable[[TexturedBody], TexturedBody], low: float, high: float) -> Take:
    """Changed paint, so many degrees from frame to frame, with boxes."""
    rig, radius = rig_of(rng, share=0.6)
    take = steps(rng, float(rng.uniform(low, high)), rig, change(any_body(rng, rig, radius)), radius, FRAMES)
    return replace(take, boxes=boxes_of(take.scene, 1.05))


def faint(rng: np.random.Generator) -> Take:
    """4 to 12 % of the contrast, 4 to 12 degrees from frame to frame."""
    contrast = float(rng.uniform(0.04, 0.12))
    return painted(rng, lambda body: faded(body, contrast), 4.0, 12.0)


def faint_free(rng: np.random.Generator) -> Take:
    """The same without boxes."""
    return replace(faint(rng), boxes=None)


def blurred(rng: np.random.Generator) -> Take:
    """Paint without edges, blurred by 4 to 8 texels, 4 to 12 degrees from frame to frame."""
    texels = float(rng.uniform(4.0, 8.0))
    return painted(rng, lambda body: softened(body, texels), 4.0, 12.0)


def faint_jumps(rng: np.random.Generator) -> Take:
    """8 to 20 % of the contrast, 20 to 40 degrees from frame to frame."""
    contrast = float(rng.uniform(0.08, 0.2))
    return painted(rng, lambda body: faded(body, contrast), 20.0, 40.0)


def jumps_30(rng: np.random.Generator) -> Take:
    """30 degrees from frame to frame, rich paint."""
    return painted(rng, lambda body: body, 30.0, 30.0)


def jumps_40(rng: np.random.Generator) -> Take:
    """40 degrees from frame to frame, rich paint."""
    return painted(rng, lambda body: body, 40.0, 40.0)


def comes_back(rng: np.random.Generator, change: Callable[[TexturedBody], TexturedBody]) -> Take:
    """Turns by 5 degrees a frame for 10 frames, is gone for 4, comes back turned by 15 to 35 degrees against any of the
    earlier frames, and goes on from there."""
    rig, radius = rig_of(rng, share=0.5)
    body = change(any_body(rng, rig, radius))
    before, gone = 10, 4
    path = moving(rng, 5.0 * np.arange(30.0), np.zeros((30, 3)))
    turned = Rotation.from_rotvec(np.radians(rng.uniform(15, 35)) * unit(rng))
    beside = rng.uniform(-0.5, 0.5, 3) * radius
    like = int(rng.integers(before))

    def way(frame: float) -> RigidTransform:
        if frame < before:
            return path(frame)
        if frame < before + gone:
            return RigidTransform.from_translation(np.array([0.0, -AWAY * radius, 0.0]))
        pose = path(like + frame - before - gone)
        return RigidTransform.from_components(pose.translation + beside, turned * pose.rotation)

    scene = Scene(rig, (Actor(body, way),), 20, int(rng.integers(1 << 30)))
    return Take(scene, boxes_of(scene, 1.05), radius)


def back(rng: np.random.Generator) -> Take:
    """With rich paint."""
    return comes_back(rng, lambda body: body)


def back_faint(rng: np.random.Generator) -> Take:
    """With 10 to 20 % of its contrast."""
    contrast = float(rng.uniform(0.1, 0.2))
    return comes_back(rng, lambda body: faded(body, contrast))


def back_blurred(rng: np.random.Generator) -> Take:
    """With paint blurred by 4 to 8 texels."""
    texels = float(rng.uniform(4.0, 8.0))
    return comes_back(rng, lambda body: softened(body, texels))


STARVING: dict[str, Kind] = named(
    [faint, faint_free, blurred, faint_jumps, jumps_30, jumps_40, back, back_faint, back_blurred]
)
