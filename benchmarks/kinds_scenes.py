"""Kinds of scenes of `benchmarks/kinds.py`: static phases, backgrounds and pure translations.

Each kind is a function that draws a variation from a random generator. Its name is part of the seed. Other groups are in
`benchmarks/kinds_fallback_search.py` and `benchmarks/kinds_feature_poor.py`.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import av
import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import Box, FrameSet
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.rig import Camera, Rig
from sylpose.simulate import Actor, Scene, TexturedBody, arc, chamfered_box, render_frames
from sylpose.simulate.render import Path

__all__ = [
    "GROUPS",
    "Kind",
    "Variation",
    "compute_boxes",
    "draw_block",
    "draw_body",
    "draw_rig",
    "index_by_name",
    "make_path",
    "texture_resolution",
]

SIZE = (480, 360)
DISTANCE = 1.5


@dataclass(frozen=True, eq=False)
class Variation:
    """Variation of a kind of scene.

    Attributes:
        scene: the scene; its first actor is the object.
        boxes: boxes in the first frame, or None.
        radius: radius of the object.
        gain: (frames, C) brightness factors, or None.
        nudge: (camera, frame, rotation vector) of a camera that rotates about its center from a frame on, contrary to its
            calibration; or None.
        codec: image compression, "jpeg QUALITY" or "h264 CRF", which makes static keypoints jitter; or None.
    """

    scene: Scene
    boxes: Mapping[str, Box] | None
    radius: float
    gain: FloatArray | None = None
    nudge: tuple[int, int, FloatArray] | None = None
    codec: str | None = None

    def frames(self) -> Iterator[FrameSet]:
        """Render the frame sets for the tracker."""
        no_values = (None,) * len(self.scene.rig)
        images: Iterable[Sequence[Image]] = (
            [self._disturb_image(c, k, image) for c, image in enumerate(seen)]
            for k, seen in enumerate(render_frames(self.scene))
        )
        if self.codec is not None:
            name, quality = self.codec.split()
            if name == "jpeg":
                images = ([compress_jpeg(image, int(quality)) for image in seen] for seen in images)
            else:
                images = zip(*(compress_h264(list(of), int(quality)) for of in zip(*images, strict=True)), strict=True)
        for k, seen in enumerate(images):
            yield FrameSet(k, k / 30.0, no_values, tuple(seen), no_values)

    def _disturb_image(self, c: int, k: int, image: Image) -> Image:
        if self.nudge is not None and self.nudge[0] == c and k >= self.nudge[1]:
            image = rotate_view(image, self.scene.rig.cameras[c], self.nudge[2])
        if self.gain is not None:
            image = np.clip(np.rint(image * self.gain[k, c]), 0, 255).astype(np.uint8)
        return image


def compress_jpeg(image: Image, quality: int) -> Image:
    """Compress and decompress an image as JPEG."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)


# Without "asm=0" the encoder's choices depend on the memory next to the image.
H264 = {"preset": "veryfast", "threads": "1", "x264-params": "asm=0"}


def compress_h264(images: Sequence[Image], crf: int) -> list[Image]:
    """Compress and decompress images as H.264 video."""
    height, width = images[0].shape[:2]
    # The codec's blocks must not reach beyond the image into uninitialized memory.
    images = [np.pad(image, ((0, -height % 16), (0, -width % 16), (0, 0)), "edge") for image in images]
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as video:
        stream = video.add_stream("libx264", rate=30, options=H264 | {"crf": str(crf)})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for image in images:
            video.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        video.mux(stream.encode())
    file.seek(0)
    with av.open(file, "r") as written:
        decoded = (frame.to_ndarray(format="bgr24") for frame in written.decode(video=0))
        return [np.ascontiguousarray(image[:height, :width], dtype=np.uint8) for image in decoded]


def rotate_view(image: Image, camera: Camera, rotvec: FloatArray) -> Image:
    """Warp an image as if the camera were rotated about its center by a rotation vector (3,) in camera axes."""
    width, height = camera.size
    u, v = np.meshgrid(np.arange(float(width)), np.arange(float(height)))
    rays = np.column_stack([camera.normalize(np.column_stack([u.ravel(), v.ravel()])), np.ones(u.size)])
    unrotated = Rotation.from_rotvec(rotvec).apply(rays) @ camera.rotation + camera.center
    source = camera.project(unrotated).reshape(height, width, 2).astype(np.float32)
    return np.asarray(cv2.remap(image, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))


def draw_rig(
    rng: np.random.Generator,
    cameras: int | None = None,
    *,
    size: tuple[int, int] = SIZE,
    spacing: float | None = None,
    share: float = 0.5,
    distance: float = DISTANCE,
    focal: float | None = None,
) -> tuple[Rig, float]:
    """Draw cameras on an arc at varying heights; return the rig and an object radius for a share of the image height.

    Args:
        rng: random generator.
        cameras: number of cameras; None: 2 to 4.
        size: image size, pixels.
        spacing: degrees between neighbors; None: 25 to 70.
        share: share of the image height that the object fills.
        distance: distance of the cameras from the object.
        focal: focal length, pixels; None: 1.3 times the longer side.
    """
    n = int(rng.integers(2, 5)) if cameras is None else cameras
    step = float(rng.uniform(25, 70)) if spacing is None else spacing
    focal = 1.3 * max(size) if focal is None else focal
    heights = distance * rng.uniform(-0.3, 0.3, n)
    rig = arc(n, step, distance, focal, size, height=heights, first_deg=float(rng.uniform(0, 360)))
    return rig, 0.5 * share * size[1] * distance / focal


def texture_resolution(rig: Rig, distance: float = DISTANCE) -> float:
    """Return the texture resolution, pixels per unit of length, for a body at the target."""
    return 1.25 * max(camera.focal for camera in rig) / distance


def draw_block(rng: np.random.Generator, rig: Rig, radius: float, distance: float = DISTANCE) -> TexturedBody:
    """Draw a chamfered box whose half diagonal is about the radius."""
    sides = rng.uniform(0.6, 1.0, 3)
    return chamfered_box(
        2 * radius * sides / np.linalg.norm(sides), texture_resolution(rig, distance), seed=int(rng.integers(1 << 30))
    )


def make_board(rng: np.random.Generator, rig: Rig, radius: float, distance: float = DISTANCE) -> TexturedBody:
    """Make a flat board that faces the mean of the camera centers."""
    half = radius * np.array([0.8, 0.6, 0.02])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    to_cameras = np.mean([camera.center for camera in rig], axis=0)
    facing, _ = Rotation.align_vectors([to_cameras / np.linalg.norm(to_cameras), [0, -1, 0]], [[0, 0, -1], [0, -1, 0]])
    return TexturedBody.from_hull(facing.apply(corners), texture_resolution(rig, distance), int(rng.integers(1 << 30)))


def draw_rounded_body(rng: np.random.Generator, rig: Rig, radius: float, distance: float = DISTANCE) -> TexturedBody:
    """Draw the convex hull of random points on an ellipsoid."""
    points = rng.standard_normal((60, 3))
    points *= radius * rng.uniform(0.7, 1.0, 3) / np.linalg.norm(points, axis=1, keepdims=True)
    return TexturedBody.from_hull(points, texture_resolution(rig, distance), int(rng.integers(1 << 30)))


def draw_body(rng: np.random.Generator, rig: Rig, radius: float, distance: float = DISTANCE) -> TexturedBody:
    """Draw a block, a board or a rounded body."""
    return (draw_block, make_board, draw_rounded_body)[int(rng.integers(3))](rng, rig, radius, distance)


def draw_direction(rng: np.random.Generator) -> FloatArray:
    """Draw a random direction (3,)."""
    v = rng.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


def make_path(
    rng: np.random.Generator, degrees: FloatArray, translations: FloatArray, start: FloatArray | None = None
) -> Path:
    """Make a path from rotation angles and translations.

    Args:
        rng: random generator.
        degrees: (frames,) rotation angle since the first frame, about a slightly varying axis.
        translations: (frames, 3) translation since the first frame.
        start: (3,) initial position.
    """
    axis, axis_variation, first_position = (
        draw_direction(rng),
        0.3 * draw_direction(rng),
        np.zeros(3) if start is None else start,
    )
    first = Rotation.from_rotvec(0.2 * draw_direction(rng))
    count = np.arange(len(degrees), dtype=float)

    def path(frame: float) -> RigidTransform:
        angle = np.interp(frame, count, degrees)
        position = first_position + np.array([np.interp(frame, count, translations[:, i]) for i in range(3)])
        about = axis + axis_variation * np.sin(np.radians(angle))
        rotation = Rotation.from_rotvec(np.radians(angle) * about / np.linalg.norm(about))
        return RigidTransform.from_components(position, rotation * first)

    return path


def ramp_after(n_static: int, frames: int, speed: float) -> FloatArray:
    """Return values (frames,) that are zero for `n_static` frames and then grow by `speed` per frame."""
    return speed * np.maximum(np.arange(frames) - n_static, 0.0)


def compute_boxes(scene: Scene, scale: float = 1.0, offsets: FloatArray | None = None) -> dict[str, Box]:
    """Compute the object's boxes in the first frame, scaled by `scale` and moved by a share (C, 2) of their size."""
    actor, boxes = scene.actors[0], {}
    corners = actor.path(0.0).apply(actor.body.vertices)
    for c, camera in enumerate(scene.rig):
        pixels = camera.project(corners)
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        middle, half = (low + high) / 2, scale * (high - low) / 2
        if offsets is not None:
            middle = middle + offsets[c] * (high - low)
        low, high = np.maximum(middle - half, 0), np.minimum(middle + half, np.array(camera.size) - 1)
        boxes[camera.name] = Box(*low, *(high - low))
    return boxes


# --- background: static phases, and other moving bodies -------------------------------------------------------------------


def draw_static_start(
    rng: np.random.Generator, speed: float, *, cameras: int | None = None, frames: int = 30
) -> Variation:
    """Draw an object that is static for 2 to 30 frames, then rotates by `speed` degrees per frame and drifts."""
    rig, radius = draw_rig(rng, cameras, share=rng.uniform(0.3, 0.6))
    n_static = int(rng.integers(2, 31))
    count = n_static + frames
    drift = 0.3 * radius * draw_direction(rng) / max(10.0, 10.0 / speed)
    path = make_path(rng, ramp_after(n_static, count, speed), ramp_after(n_static, count, 1.0)[:, None] * drift)
    scene = Scene(rig, (Actor(draw_body(rng, rig, radius), path),), count, int(rng.integers(1 << 30)))
    return Variation(scene, None, radius)


def stands_slow(rng: np.random.Generator) -> Variation:
    """Static, then 0.2 degrees per frame."""
    return draw_static_start(rng, 0.2, frames=60)


def stands_fast(rng: np.random.Generator) -> Variation:
    """Static, then 1 to 6 degrees per frame."""
    return draw_static_start(rng, float(rng.uniform(1.0, 6.0)))


def creeps(rng: np.random.Generator) -> Variation:
    """Hand-held: trembles by about a pixel per frame at first, then moves clearly."""
    rig, radius = draw_rig(rng, share=rng.uniform(0.25, 0.5))
    creep, count = int(rng.integers(8, 25)), 60
    trembling = np.cumsum(rng.normal(0, 0.15, count)) * (np.arange(count) < creep)
    degrees = np.where(
        np.arange(count) < creep, trembling, trembling[creep - 1] + ramp_after(creep - 1, count, rng.uniform(1, 3))
    )
    translations = np.cumsum(rng.normal(0, 0.004 * radius, (count, 3)), axis=0)
    translations += ramp_after(creep, count, 1.0)[:, None] * 0.02 * radius * draw_direction(rng)
    body = make_board(rng, rig, radius) if rng.random() < 0.7 else draw_body(rng, rig, radius)
    return Variation(
        Scene(rig, (Actor(body, make_path(rng, degrees, translations)),), count, int(rng.integers(1 << 30))),
        None,
        radius,
    )


def held_compressed(rng: np.random.Generator) -> Variation:
    """A hand-held board, 10 to 40 % of the image; compression makes the keypoints of the wall behind it jitter."""
    rig, radius = draw_rig(rng, share=rng.uniform(0.4, 0.9))
    creep, count = int(rng.integers(8, 16)), 45
    trembling = np.cumsum(rng.normal(0, 0.12, count)) * (np.arange(count) < creep)
    speed = float(rng.uniform(1, 3))
    degrees = np.where(np.arange(count) < creep, trembling, trembling[creep - 1] + ramp_after(creep - 1, count, speed))
    translations = np.cumsum(rng.normal(0, 0.003 * radius, (count, 3)), axis=0)
    translations += ramp_after(creep, count, 1.0)[:, None] * 0.02 * radius * draw_direction(rng)
    scene = Scene(
        rig,
        (Actor(make_board(rng, rig, radius), make_path(rng, degrees, translations)),),
        count,
        int(rng.integers(1 << 30)),
        noise=3.0,
    )
    codec = f"jpeg {rng.integers(40, 80)}" if rng.random() < 0.4 else f"h264 {rng.integers(26, 36)}"
    return Variation(scene, None, radius, codec=codec)


def draw_passerby(rng: np.random.Generator, rig: Rig, radius: float) -> Actor:
    """Draw a larger body, such as a person's coat, that passes behind the object."""
    middle = np.mean([camera.center for camera in rig], axis=0)
    direction = -middle / np.linalg.norm(middle)
    side = np.cross(direction, [0.0, 1.0, 0.0])
    sides = radius * rng.uniform([1.0, 2.5, 0.6], [1.8, 4.0, 1.2])
    body = chamfered_box(2 * sides / 2, texture_resolution(rig), seed=int(rng.integers(1 << 30)))
    begin, speed = rng.uniform(-4, -2) * radius, rng.uniform(0.05, 0.2) * radius
    behind = rng.uniform(2.2, 3.5) * radius

    def path(frame: float) -> RigidTransform:
        position = behind * direction + (begin + speed * frame) * side
        rotation = Rotation.from_rotvec([0.0, 0.1 * np.sin(0.3 * frame), 0.05 * np.sin(0.5 * frame)])
        return RigidTransform.from_components(position, rotation)

    return Actor(body, path)


def draw_with_passerby(rng: np.random.Generator, *, with_boxes: bool) -> Variation:
    """Draw an object that is static and then moves, with a person passing behind it."""
    plain = draw_static_start(rng, float(rng.uniform(0.5, 4.0)))
    other = draw_passerby(rng, plain.scene.rig, plain.radius)
    scene = replace(plain.scene, actors=(*plain.scene.actors, other))
    return replace(plain, scene=scene, boxes=compute_boxes(scene, 1.1) if with_boxes else None)


def person_behind(rng: np.random.Generator) -> Variation:
    """A person passes behind; boxes select the object, which would be ambiguous otherwise."""
    return draw_with_passerby(rng, with_boxes=True)


def wide_boxes(rng: np.random.Generator) -> Variation:
    """Boxes that contain more wall than object."""
    plain = draw_static_start(rng, float(rng.choice([0.2, 0.5, 1.0, 3.0])), frames=40)
    n = len(plain.scene.rig)
    return replace(plain, boxes=compute_boxes(plain.scene, rng.uniform(1.5, 2.2), rng.uniform(-0.2, 0.2, (n, 2))))


def exposure_drift(rng: np.random.Generator) -> Variation:
    """The gain of each camera varies independently; with or without boxes."""
    plain = draw_static_start(rng, float(rng.choice([0.2, 1.0, 3.0])), frames=40)
    n = plain.scene.frames
    steps = rng.normal(0, 0.02, (n, len(plain.scene.rig)))
    gain = np.clip(np.exp(np.cumsum(steps, axis=0)), 0.5, 1.5)
    return replace(plain, gain=gain, boxes=compute_boxes(plain.scene, 1.1) if rng.random() < 0.5 else None)


def nudged(rng: np.random.Generator) -> Variation:
    """One of three or four cameras rotates by 0.3 to 3 degrees at a random frame; with or without boxes."""
    plain = draw_static_start(rng, float(rng.choice([0.5, 2.0])), cameras=int(rng.integers(3, 5)), frames=40)
    camera, frame = int(rng.integers(len(plain.scene.rig))), int(rng.integers(3, plain.scene.frames - 5))
    rotation = np.radians(rng.uniform(0.3, 3.0)) * draw_direction(rng)
    return replace(
        plain, nudge=(camera, frame, rotation), boxes=compute_boxes(plain.scene, 1.1) if rng.random() < 0.5 else None
    )


# --- slides: translation without rotation ---------------------------------------------------------------------------------


def draw_slide(
    rng: np.random.Generator,
    box_scale: float | None,
    *,
    wobble_deg: float = 0.0,
    box_offset: float = 0.0,
    cameras: int | None = None,
) -> Variation:
    """Draw a straight path of one to two radii in 20 frames, in any direction.

    Args:
        rng: random generator.
        box_scale: scale of the boxes; None: no boxes.
        wobble_deg: amplitude of an alternating rotation, degrees.
        box_offset: largest offset of the boxes, as a share of their size.
        cameras: number of cameras; None: 2 to 4.
    """
    rig, radius = draw_rig(rng, cameras, share=rng.uniform(0.3, 0.5))
    frames = 20
    translations = np.linspace(0.0, 1.0, frames)[:, None] * radius * rng.uniform(1.0, 2.0) * draw_direction(rng)
    degrees = wobble_deg * np.sin(np.linspace(0, 2 * np.pi, frames))
    path = make_path(rng, degrees, translations - translations[-1] / 2)
    scene = Scene(rig, (Actor(draw_body(rng, rig, radius), path),), frames, int(rng.integers(1 << 30)))
    off = rng.uniform(-box_offset, box_offset, (len(rig), 2))
    return Variation(scene, None if box_scale is None else compute_boxes(scene, box_scale, off), radius)


def slide_free(rng: np.random.Generator) -> Variation:
    """Without boxes."""
    return draw_slide(rng, None)


def slide_boxed(rng: np.random.Generator) -> Variation:
    """With boxes that fit."""
    return draw_slide(rng, 1.0)


def slide_wide(rng: np.random.Generator) -> Variation:
    """With boxes 1.3 times as large."""
    return draw_slide(rng, 1.3, box_offset=0.1)


def slide_narrow(rng: np.random.Generator) -> Variation:
    """With boxes 0.7 times as large."""
    return draw_slide(rng, 0.7, box_offset=0.1)


def slide_wobbly(rng: np.random.Generator) -> Variation:
    """Alternating rotation of up to a degree, as on an uneven rail."""
    return draw_slide(rng, 1.0 if rng.random() < 0.5 else None, wobble_deg=float(rng.uniform(0.1, 1.0)))


def slide_then_turn(rng: np.random.Generator) -> Variation:
    """A slide followed by a rotation of 30 degrees, which makes the slide's length observable."""
    plain = draw_slide(rng, 1.0 if rng.random() < 0.5 else None)
    straight, count = plain.scene.actors[0].path, plain.scene.frames
    axis, angle = draw_direction(rng), np.radians(2.0)

    def path(frame: float) -> RigidTransform:
        pose = straight(min(frame, count - 1.0))
        rotation = Rotation.from_rotvec(max(frame - count + 1, 0.0) * angle * axis)
        return RigidTransform.from_components(pose.translation, rotation * pose.rotation)

    scene = replace(plain.scene, actors=(Actor(plain.scene.actors[0].body, path),), frames=count + 15)
    return replace(plain, scene=scene)


Kind = Callable[[np.random.Generator], Variation]


Drawn = TypeVar("Drawn")


def index_by_name(
    kinds: Sequence[Callable[[np.random.Generator], Drawn]],
) -> dict[str, Callable[[np.random.Generator], Drawn]]:
    """Index kinds by their command-line names."""
    return {kind.__name__.replace("_", "-"): kind for kind in kinds}


GROUPS: dict[str, dict[str, Kind]] = {
    "background": index_by_name(
        [stands_slow, stands_fast, creeps, held_compressed, person_behind, wide_boxes, exposure_drift, nudged]
    ),
    "slides": index_by_name([slide_free, slide_boxed, slide_wide, slide_narrow, slide_wobbly, slide_then_turn]),
}
