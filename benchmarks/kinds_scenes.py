"""The kinds of scenes of `benchmarks/kinds.py`: what moves, what stands still, who hides whom, which lens, how fast, how
little texture. Each makes a variation of itself from a random generator. Those of the group "thorough" are in
`benchmarks/kinds_fallback_search.py`.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import av
import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import Box, FrameSet
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.rig import Camera, Rig
from sylpose.simulate import Actor, Scene, TexturedBody, arc, chamfered_box, render_frames
from sylpose.simulate.render import Path

__all__ = ["GROUPS", "Kind", "Take", "any_body", "block", "boxes_of", "moving", "named", "rig_of", "texels"]

SIZE = (480, 360)
DISTANCE = 1.5


@dataclass(frozen=True, eq=False)
class Take:
    """A variation.

    Attributes:
        scene: its first actor is the object.
        boxes: in the first frame, or None.
        radius: of the object.
        gain: (frames, C) factors of the images' brightness, or None.
        nudge: (camera, frame, rotation vector): a camera that is turned from a frame on, about its centre, unknown to its
            calibration; or None.
        codec: what the images went through, "jpeg QUALITY" or "h264 CRF", so that keypoints of what stands still jitter; or
            None.
    """

    scene: Scene
    boxes: Mapping[str, Box] | None
    radius: float
    gain: FloatArray | None = None
    nudge: tuple[int, int, FloatArray] | None = None
    codec: str | None = None

    def frames(self) -> Iterator[FrameSet]:
        """As the tracker gets them."""
        nothing = (None,) * len(self.scene.rig)
        images: Iterable[Sequence[Image]] = (
            [self._seen(c, k, image) for c, image in enumerate(seen)]
            for k, seen in enumerate(render_frames(self.scene))
        )
        if self.codec is not None:
            name, quality = self.codec.split()
            if name == "jpeg":
                images = ([jpeg(image, int(quality)) for image in seen] for seen in images)
            else:
                images = zip(*(h264(list(of), int(quality)) for of in zip(*images, strict=True)), strict=True)
        for k, seen in enumerate(images):
            yield FrameSet(k, k / 30.0, nothing, tuple(seen), nothing)

    def _seen(self, c: int, k: int, image: Image) -> Image:
        if self.nudge is not None and self.nudge[0] == c and k >= self.nudge[1]:
            image = turned(image, self.scene.rig.cameras[c], self.nudge[2])
        if self.gain is not None:
            image = np.clip(np.rint(image * self.gain[k, c]), 0, 255).astype(np.uint8)
        return image


def jpeg(image: Image, quality: int) -> Image:
    """An image as a camera's JPEG has it."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)


# With its assembler routines the encoder's choices depend on what lies beside the image in memory.
H264 = {"preset": "veryfast", "threads": "1", "x264-params": "asm=0"}


def h264(images: Sequence[Image], crf: int) -> list[Image]:
    """Images as a compressed video has them."""
    height, width = images[0].shape[:2]
    # A codec's blocks that reach beyond the image hold whatever was in memory.
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


def turned(image: Image, camera: Camera, rotvec: FloatArray) -> Image:
    """What a camera sees after it was turned about its centre by a rotation vector, camera's axes."""
    width, height = camera.size
    u, v = np.meshgrid(np.arange(float(width)), np.arange(float(height)))
    rays = np.column_stack([camera.normalize(np.column_stack([u.ravel(), v.ravel()])), np.ones(u.size)])
    before = Rotation.from_rotvec(rotvec).apply(rays) @ camera.rotation + camera.center
    source = camera.project(before).reshape(height, width, 2).astype(np.float32)
    return np.asarray(cv2.remap(image, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))


def rig_of(
    rng: np.random.Generator,
    cameras: int | None = None,
    *,
    size: tuple[int, int] = SIZE,
    spacing: float | None = None,
    share: float = 0.5,
    distance: float = DISTANCE,
    focal: float | None = None,
) -> tuple[Rig, float]:
    """Cameras on an arc, at changing heights; and the radius of an object that fills a share of their images' height.

    Args:
        cameras: 2 to 4 if not said.
        spacing: degrees between neighbours, 25 to 70 if not said.
        focal: pixels; 1.3 times the longer side if not said.
    """
    n = int(rng.integers(2, 5)) if cameras is None else cameras
    step = float(rng.uniform(25, 70)) if spacing is None else spacing
    focal = 1.3 * max(size) if focal is None else focal
    heights = distance * rng.uniform(-0.3, 0.3, n)
    rig = arc(n, step, distance, focal, size, height=heights, first=float(rng.uniform(0, 360)))
    return rig, 0.5 * share * size[1] * distance / focal


def texels(rig: Rig, distance: float = DISTANCE) -> float:
    """Texture pixels per unit of length for a body at the target."""
    return 1.25 * max(camera.focal for camera in rig) / distance


def block(rng: np.random.Generator, rig: Rig, radius: float, distance: float = DISTANCE) -> TexturedBody:
    """A box with cut edges, its half diagonal about the radius."""
    sides = rng.uniform(0.6, 1.0, 3)
    return chamfered_box(
        2 * radius * sides / np.linalg.norm(sides), texels(rig, distance), seed=int(rng.integers(1 << 30))
    )


def board(rng: np.random.Generator, rig: Rig, radius: float, distance: float = DISTANCE) -> TexturedBody:
    """A flat one, which faces the middle of the cameras."""
    half = radius * np.array([0.8, 0.6, 0.02])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    to_cameras = np.mean([camera.center for camera in rig], axis=0)
    facing, _ = Rotation.align_vectors([to_cameras / np.linalg.norm(to_cameras), [0, -1, 0]], [[0, 0, -1], [0, -1, 0]])
    return TexturedBody.hull(facing.apply(corners), texels(rig, distance), int(rng.integers(1 << 30)))


def rounded(rng: np.random.Generator, rig: Rig, radius: float, distance: float = DISTANCE) -> TexturedBody:
    """The hull of random points on an ellipsoid."""
    points = rng.standard_normal((60, 3))
    points *= radius * rng.uniform(0.7, 1.0, 3) / np.linalg.norm(points, axis=1, keepdims=True)
    return TexturedBody.hull(points, texels(rig, distance), int(rng.integers(1 << 30)))


def any_body(rng: np.random.Generator, rig: Rig, radius: float, distance: float = DISTANCE) -> TexturedBody:
    """One of these."""
    return (block, board, rounded)[int(rng.integers(3))](rng, rig, radius, distance)


def unit(rng: np.random.Generator) -> FloatArray:
    """A random direction (3,)."""
    v = rng.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


def moving(rng: np.random.Generator, degrees: FloatArray, way: FloatArray, start: FloatArray | None = None) -> Path:
    """A path from its speeds.

    Args:
        degrees: (frames,) turned by frame k since the first, about an axis that sways a little.
        way: (frames, 3) moved by then.
        start: (3,) where it begins.
    """
    axis, sway, begin = unit(rng), 0.3 * unit(rng), np.zeros(3) if start is None else start
    first = Rotation.from_rotvec(0.2 * unit(rng))
    count = np.arange(len(degrees), dtype=float)

    def path(frame: float) -> RigidTransform:
        angle = np.interp(frame, count, degrees)
        place = begin + np.array([np.interp(frame, count, way[:, i]) for i in range(3)])
        about = axis + sway * np.sin(np.radians(angle))
        turn = Rotation.from_rotvec(np.radians(angle) * about / np.linalg.norm(about))
        return RigidTransform.from_components(place, turn * first)

    return path


def after(stands: int, frames: int, speed: float) -> FloatArray:
    """(frames,) zero while it stands, then growing by `speed` a frame."""
    return speed * np.maximum(np.arange(frames) - stands, 0.0)


def boxes_of(scene: Scene, grow: float = 1.0, shift: FloatArray | None = None) -> dict[str, Box]:
    """The object's boxes in the first frame, `grow` times as wide and high, moved by a share (C, 2) of their size."""
    actor, found = scene.actors[0], {}
    corners = actor.path(0.0).apply(actor.body.vertices)
    for c, camera in enumerate(scene.rig):
        pixels = camera.project(corners)
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        middle, half = (low + high) / 2, grow * (high - low) / 2
        if shift is not None:
            middle = middle + shift[c] * (high - low)
        low, high = np.maximum(middle - half, 0), np.minimum(middle + half, np.array(camera.size) - 1)
        found[camera.name] = Box(*low, *(high - low))
    return found


# --- background: what stands still, and what moves that is not the object ------------------------------------------------


def standing(rng: np.random.Generator, speed: float, *, cameras: int | None = None, frames: int = 30) -> Take:
    """Stands for 2 to 30 frames, then turns by `speed` degrees a frame and drifts."""
    rig, radius = rig_of(rng, cameras, share=rng.uniform(0.3, 0.6))
    stands = int(rng.integers(2, 31))
    count = stands + frames
    drift = 0.3 * radius * unit(rng) / max(10.0, 10.0 / speed)
    path = moving(rng, after(stands, count, speed), after(stands, count, 1.0)[:, None] * drift)
    scene = Scene(rig, (Actor(any_body(rng, rig, radius), path),), count, int(rng.integers(1 << 30)))
    return Take(scene, None, radius)


def stands_slow(rng: np.random.Generator) -> Take:
    """Then 0.2 degrees a frame."""
    return standing(rng, 0.2, frames=60)


def stands_fast(rng: np.random.Generator) -> Take:
    """Then 1 to 6 degrees a frame."""
    return standing(rng, float(rng.uniform(1.0, 6.0)))


def creeps(rng: np.random.Generator) -> Take:
    """Held in a hand: hardly moves at first (a pixel or so a frame, to and fro), then moves well."""
    rig, radius = rig_of(rng, share=rng.uniform(0.25, 0.5))
    creep, count = int(rng.integers(8, 25)), 60
    trembling = np.cumsum(rng.normal(0, 0.15, count)) * (np.arange(count) < creep)
    degrees = np.where(
        np.arange(count) < creep, trembling, trembling[creep - 1] + after(creep - 1, count, rng.uniform(1, 3))
    )
    way = np.cumsum(rng.normal(0, 0.004 * radius, (count, 3)), axis=0)
    way += after(creep, count, 1.0)[:, None] * 0.02 * radius * unit(rng)
    body = board(rng, rig, radius) if rng.random() < 0.7 else any_body(rng, rig, radius)
    return Take(Scene(rig, (Actor(body, moving(rng, degrees, way)),), count, int(rng.integers(1 << 30))), None, radius)


def held_compressed(rng: np.random.Generator) -> Take:
    """A board held in a hand, 10 to 40 % of the image, before a wall whose keypoints jitter: the images were compressed."""
    rig, radius = rig_of(rng, share=rng.uniform(0.4, 0.9))
    creep, count = int(rng.integers(8, 16)), 45
    trembling = np.cumsum(rng.normal(0, 0.12, count)) * (np.arange(count) < creep)
    speed = float(rng.uniform(1, 3))
    degrees = np.where(np.arange(count) < creep, trembling, trembling[creep - 1] + after(creep - 1, count, speed))
    way = np.cumsum(rng.normal(0, 0.003 * radius, (count, 3)), axis=0)
    way += after(creep, count, 1.0)[:, None] * 0.02 * radius * unit(rng)
    scene = Scene(
        rig, (Actor(board(rng, rig, radius), moving(rng, degrees, way)),), count, int(rng.integers(1 << 30)), noise=3.0
    )
    codec = f"jpeg {rng.integers(40, 80)}" if rng.random() < 0.4 else f"h264 {rng.integers(26, 36)}"
    return Take(scene, None, radius, codec=codec)


def passer(rng: np.random.Generator, rig: Rig, radius: float) -> Actor:
    """A person's coat, say: something larger that walks by behind the object, seen from the cameras."""
    middle = np.mean([camera.center for camera in rig], axis=0)
    away = -middle / np.linalg.norm(middle)
    side = np.cross(away, [0.0, 1.0, 0.0])
    sides = radius * rng.uniform([1.0, 2.5, 0.6], [1.8, 4.0, 1.2])
    body = chamfered_box(2 * sides / 2, texels(rig), seed=int(rng.integers(1 << 30)))
    begin, speed = rng.uniform(-4, -2) * radius, rng.uniform(0.05, 0.2) * radius
    behind = rng.uniform(2.2, 3.5) * radius

    def path(frame: float) -> RigidTransform:
        place = behind * away + (begin + speed * frame) * side
        turn = Rotation.from_rotvec([0.0, 0.1 * np.sin(0.3 * frame), 0.05 * np.sin(0.5 * frame)])
        return RigidTransform.from_components(place, turn)

    return Actor(body, path)


def with_passer(rng: np.random.Generator, *, boxed: bool) -> Take:
    """A person walks by behind the object, which stands a while and then moves."""
    plain = standing(rng, float(rng.uniform(0.5, 4.0)))
    other = passer(rng, plain.scene.rig, plain.radius)
    scene = replace(plain.scene, actors=(*plain.scene.actors, other))
    return replace(plain, scene=scene, boxes=boxes_of(scene, 1.1) if boxed else None)


def person_behind(rng: np.random.Generator) -> Take:
    """With boxes of the object: without them nothing says which of the two is meant."""
    return with_passer(rng, boxed=True)


def wide_boxes(rng: np.random.Generator) -> Take:
    """Boxes with more wall than object in them."""
    plain = standing(rng, float(rng.choice([0.2, 0.5, 1.0, 3.0])), frames=40)
    n = len(plain.scene.rig)
    return replace(plain, boxes=boxes_of(plain.scene, rng.uniform(1.5, 2.2), rng.uniform(-0.2, 0.2, (n, 2))))


def exposure_drift(rng: np.random.Generator) -> Take:
    """The cameras' gains wander, each its own way; with boxes or without."""
    plain = standing(rng, float(rng.choice([0.2, 1.0, 3.0])), frames=40)
    n = plain.scene.frames
    steps = rng.normal(0, 0.02, (n, len(plain.scene.rig)))
    gain = np.clip(np.exp(np.cumsum(steps, axis=0)), 0.5, 1.5)
    return replace(plain, gain=gain, boxes=boxes_of(plain.scene, 1.1) if rng.random() < 0.5 else None)


def nudged(rng: np.random.Generator) -> Take:
    """One of three or four cameras is nudged by 0.3 to 3 degrees, before, while or after the object stands; with boxes or
    without."""
    plain = standing(rng, float(rng.choice([0.5, 2.0])), cameras=int(rng.integers(3, 5)), frames=40)
    camera, frame = int(rng.integers(len(plain.scene.rig))), int(rng.integers(3, plain.scene.frames - 5))
    turn = np.radians(rng.uniform(0.3, 3.0)) * unit(rng)
    return replace(plain, nudge=(camera, frame, turn), boxes=boxes_of(plain.scene, 1.1) if rng.random() < 0.5 else None)


# --- slides: translation without a turn ----------------------------------------------------------------------------------


def slide(
    rng: np.random.Generator, grow: float | None, *, wobble: float = 0.0, shift: float = 0.0, cameras: int | None = None
) -> Take:
    """A straight path of one to two radii's length in 20 frames, any direction.

    Args:
        grow: how many times too wide the boxes are; None: no boxes.
        wobble: degrees that it turns to and fro by.
        shift: by which share of their size the boxes are displaced.
    """
    rig, radius = rig_of(rng, cameras, share=rng.uniform(0.3, 0.5))
    frames = 20
    way = np.linspace(0.0, 1.0, frames)[:, None] * radius * rng.uniform(1.0, 2.0) * unit(rng)
    degrees = wobble * np.sin(np.linspace(0, 2 * np.pi, frames))
    path = moving(rng, degrees, way - way[-1] / 2)
    scene = Scene(rig, (Actor(any_body(rng, rig, radius), path),), frames, int(rng.integers(1 << 30)))
    off = rng.uniform(-shift, shift, (len(rig), 2))
    return Take(scene, None if grow is None else boxes_of(scene, grow, off), radius)


def slide_free(rng: np.random.Generator) -> Take:
    """Without boxes."""
    return slide(rng, None)


def slide_boxed(rng: np.random.Generator) -> Take:
    """With boxes that fit."""
    return slide(rng, 1.0)


def slide_wide(rng: np.random.Generator) -> Take:
    """With boxes 1.3 times as large."""
    return slide(rng, 1.3, shift=0.1)


def slide_narrow(rng: np.random.Generator) -> Take:
    """With boxes 0.7 times as large."""
    return slide(rng, 0.7, shift=0.1)


def slide_wobbly(rng: np.random.Generator) -> Take:
    """It turns by up to a degree to and fro, as on a bad rail."""
    return slide(rng, 1.0 if rng.random() < 0.5 else None, wobble=float(rng.uniform(0.1, 1.0)))


def slide_then_turn(rng: np.random.Generator) -> Take:
    """A slide, and then a turn by 30 degrees, which tells how long it was."""
    plain = slide(rng, 1.0 if rng.random() < 0.5 else None)
    straight, count = plain.scene.actors[0].path, plain.scene.frames
    axis, angle = unit(rng), np.radians(2.0)

    def path(frame: float) -> RigidTransform:
        pose = straight(min(frame, count - 1.0))
        turn = Rotation.from_rotvec(max(frame - count + 1, 0.0) * angle * axis)
        return RigidTransform.from_components(pose.translation, turn * pose.rotation)

    scene = replace(plain.scene, actors=(Actor(plain.scene.actors[0].body, path),), frames=count + 15)
    return replace(plain, scene=scene)


Kind = Callable[[np.random.Generator], Take]


def named(kinds: Sequence[Kind]) -> dict[str, Kind]:
    """By their names, as commands have them."""
    return {kind.__name__.replace("_", "-"): kind for kind in kinds}


GROUPS: dict[str, dict[str, Kind]] = {
    "background": named(
        [stands_slow, stands_fast, creeps, held_compressed, person_behind, wide_boxes, exposure_drift, nudged]
    ),
    "slides": named([slide_free, slide_boxed, slide_wide, slide_narrow, slide_wobbly, slide_then_turn]),
}
