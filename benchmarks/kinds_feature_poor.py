"""Kinds of scenes with few SIFT matches: faint or blurred texture, large rotations, an object that returns elsewhere.

They extend `benchmarks/kinds_scenes.py`. A kind's name, which is that of its function, is part of the seed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_fallback_search import make_stepwise_variation
from benchmarks.kinds_scenes import (
    Kind,
    Variation,
    compute_boxes,
    draw_body,
    draw_direction,
    draw_rig,
    index_by_name,
    make_path,
)
from sylpose.geometry.arrays import Image
from sylpose.simulate import Actor, Scene, TexturedBody

__all__ = ["FEATURE_POOR"]

FRAMES = 16
# Distance of an absent object, in radii: outside all views.
AWAY_RADII = 1000.0


def reduce_contrast(body: TexturedBody, contrast: float) -> TexturedBody:
    """Scale the contrast of a body's textures about their mean colors."""

    def reduce(texture: Image) -> Image:
        mean = texture.mean(axis=(0, 1))
        return np.asarray(np.clip(np.rint(mean + contrast * (texture - mean)), 0, 255), dtype=np.uint8)

    return replace(body, textures=tuple(reduce(texture) for texture in body.textures))


def blur_textures(body: TexturedBody, texels: float) -> TexturedBody:
    """Blur a body's textures by a Gaussian with a standard deviation of `texels`."""
    return replace(
        body, textures=tuple(np.asarray(cv2.GaussianBlur(t, (0, 0), texels), np.uint8) for t in body.textures)
    )


def draw_repainted(
    rng: np.random.Generator, change: Callable[[TexturedBody], TexturedBody], low: float, high: float
) -> Variation:
    """Make a variation with changed textures, `low` to `high` degrees per frame, and boxes."""
    rig, radius = draw_rig(rng, share=0.6)
    variation = make_stepwise_variation(
        rng, float(rng.uniform(low, high)), rig, change(draw_body(rng, rig, radius)), radius, FRAMES
    )
    return replace(variation, boxes=compute_boxes(variation.scene, 1.05))


def faint(rng: np.random.Generator) -> Variation:
    """4 to 12 % of the contrast, 4 to 12 degrees per frame."""
    contrast = float(rng.uniform(0.04, 0.12))
    return draw_repainted(rng, lambda body: reduce_contrast(body, contrast), 4.0, 12.0)


def faint_free(rng: np.random.Generator) -> Variation:
    """`faint` without boxes."""
    return replace(faint(rng), boxes=None)


def blurred(rng: np.random.Generator) -> Variation:
    """Texture blurred by 4 to 8 texels, 4 to 12 degrees per frame."""
    texels = float(rng.uniform(4.0, 8.0))
    return draw_repainted(rng, lambda body: blur_textures(body, texels), 4.0, 12.0)


def faint_jumps(rng: np.random.Generator) -> Variation:
    """8 to 20 % of the contrast, 20 to 40 degrees per frame."""
    contrast = float(rng.uniform(0.08, 0.2))
    return draw_repainted(rng, lambda body: reduce_contrast(body, contrast), 20.0, 40.0)


def jumps_30(rng: np.random.Generator) -> Variation:
    """30 degrees per frame, rich texture."""
    return draw_repainted(rng, lambda body: body, 30.0, 30.0)


def jumps_40(rng: np.random.Generator) -> Variation:
    """40 degrees per frame, rich texture."""
    return draw_repainted(rng, lambda body: body, 40.0, 40.0)


def draw_return(rng: np.random.Generator, change: Callable[[TexturedBody], TexturedBody]) -> Variation:
    """Make a variation in which the object disappears for 4 frames after 10 frames of 5 degrees each.

    It returns rotated by 15 to 35 degrees against one of the earlier frames and continues from there.
    """
    rig, radius = draw_rig(rng, share=0.5)
    body = change(draw_body(rng, rig, radius))
    before, n_absent = 10, 4
    path = make_path(rng, 5.0 * np.arange(30.0), np.zeros((30, 3)))
    rotation = Rotation.from_rotvec(np.radians(rng.uniform(15, 35)) * draw_direction(rng))
    offset = rng.uniform(-0.5, 0.5, 3) * radius
    reference_frame = int(rng.integers(before))

    def absent_path(frame: float) -> RigidTransform:
        if frame < before:
            return path(frame)
        if frame < before + n_absent:
            return RigidTransform.from_translation(np.array([0.0, -AWAY_RADII * radius, 0.0]))
        pose = path(reference_frame + frame - before - n_absent)
        return RigidTransform.from_components(pose.translation + offset, rotation * pose.rotation)

    scene = Scene(rig, (Actor(body, absent_path),), 20, int(rng.integers(1 << 30)))
    return Variation(scene, compute_boxes(scene, 1.05), radius)


def back(rng: np.random.Generator) -> Variation:
    """Return with rich texture."""
    return draw_return(rng, lambda body: body)


def back_faint(rng: np.random.Generator) -> Variation:
    """Return with 10 to 20 % of the contrast."""
    contrast = float(rng.uniform(0.1, 0.2))
    return draw_return(rng, lambda body: reduce_contrast(body, contrast))


def back_blurred(rng: np.random.Generator) -> Variation:
    """Return with texture blurred by 4 to 8 texels."""
    texels = float(rng.uniform(4.0, 8.0))
    return draw_return(rng, lambda body: blur_textures(body, texels))


FEATURE_POOR: dict[str, Kind] = index_by_name(
    [faint, faint_free, blurred, faint_jumps, jumps_30, jumps_40, back, back_faint, back_blurred]
)
