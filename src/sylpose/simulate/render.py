"""Rendering: textured convex bodies that move in front of the cameras of a rig, with a room behind them.

Each visible face is a homography of its texture, evaluated through the lens on a finer grid of pixels and averaged
down; nothing else about a picture needs a 3D engine as long as the bodies are convex.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray, FloatImage, Image, IntArray
from sylpose.rig import Camera, Rig
from sylpose.simulate.textures import FACE_HUES, face_texture, room

__all__ = ["Actor", "Scene", "TexturedBody", "chamfered_box", "render_frames"]

Path = Callable[[float], RigidTransform]

# OpenCV's way of saying that both coordinates are in the first map.
NO_MAP: Any = None

# Samples per pixel in each direction; segments per edge, which a lens bends; poses per exposure with motion blur.
FINER = 2
EDGE_SEGMENTS = 6
BLUR_POSES = 7
# Texels around a face's outline, for interpolation.
MARGIN = 2
# From where the light comes (the world's up is -y), and the share of it that reaches every face.
LIGHT = np.array([-0.45, -0.8, -0.4]) / np.linalg.norm([-0.45, -0.8, -0.4])
AMBIENT = 0.62


@dataclass(frozen=True, eq=False)
class TexturedBody:
    """A convex polyhedron with a picture on each face.

    Attributes:
        vertices: (v, 3) in the body's frame.
        faces: per face its vertices' indices, in order around it.
        normals: (f, 3) outward unit normals.
        textures: per face a BGR picture.
        plane_from_texture: (f, 3, 3): a texture's pixel (u, v, 1) lies at this matrix times it in the body's frame.
    """

    vertices: FloatArray
    faces: tuple[IntArray, ...]
    normals: FloatArray
    textures: tuple[Image, ...]
    plane_from_texture: FloatArray

    @classmethod
    def hull(cls, points: ArrayLike, texels_per_unit: float, seed: int = 0) -> TexturedBody:
        """The convex hull of points (n, 3), each face with its own texture of that resolution.

        Raises:
            ValueError: points without volume, or a resolution that is not positive.
        """
        points = np.asarray(points, dtype=float)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 4 or np.linalg.matrix_rank(points - points[0]) < 3:
            raise ValueError("a body needs at least 4 points (n, 3) that are not all in one plane")
        if not texels_per_unit > 0:
            raise ValueError(f"texels_per_unit must be positive, got {texels_per_unit}")
        rng = np.random.default_rng(seed)
        hull = ConvexHull(points)
        # The hull's triangles that share a plane are one face.
        size = np.abs(points).max()
        planes = np.round(hull.equations / [1, 1, 1, size], 6) + 0.0
        _, first, face_of = np.unique(planes, axis=0, return_index=True, return_inverse=True)
        normals = hull.equations[first, :3]
        faces, textures, frames = [], [], []
        for i, normal in enumerate(normals):
            corners = np.unique(hull.simplices[face_of.ravel() == i])
            # Seen from outside, a texture's u runs to the right and v down, as near to the body's y as the face allows.
            down = np.array([0.0, 1.0, 0.0]) if abs(normal[1]) < 0.99 else np.array([0.0, 0.0, normal[1]])
            e2 = down - (down @ normal) * normal
            e2 /= np.linalg.norm(e2)
            e1 = np.cross(normal, e2)
            flat = points[corners] @ np.stack([e1, e2], axis=1)
            around = flat - flat.mean(axis=0)
            turn = np.argsort(np.arctan2(around[:, 1], around[:, 0]))
            corners, flat = corners[turn], flat[turn]
            low = flat.min(axis=0) - MARGIN / texels_per_unit
            outline = (flat - low) * texels_per_unit
            width, height = np.ceil(outline.max(axis=0)).astype(int) + MARGIN + 1
            faces.append(corners)
            textures.append(face_texture(int(width), int(height), outline, FACE_HUES[i % len(FACE_HUES)], rng))
            axes = np.stack([e1, e2], axis=1)
            origin = points[corners[0]] + axes @ (low - flat[0])
            frames.append(np.column_stack([axes / texels_per_unit, origin]))
        return cls(points, tuple(faces), normals, tuple(textures), np.array(frames))


def chamfered_box(sides: ArrayLike, texels_per_unit: float, *, chamfer: float = 0.16, seed: int = 0) -> TexturedBody:
    """A box (3 sides) whose edges and corners are cut off by `chamfer` of the shortest side: 26 faces."""
    half = np.asarray(sides, dtype=float) / 2
    cut = half - chamfer * 2 * half.min()
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    corners = np.concatenate([signs * np.where(np.arange(3) == axis, half, cut) for axis in range(3)])
    return TexturedBody.hull(corners, texels_per_unit, seed)


@dataclass(frozen=True, eq=False)
class Actor:
    """A body and how it moves: `path(frame)` is its world_from_body, for fractions of frames too."""

    body: TexturedBody
    path: Path


@dataclass(frozen=True, eq=False)
class Scene:
    """What there is to be rendered.

    Attributes:
        rig: the cameras.
        actors: the object first; others may pass in front of it (an occluder) or beside it (a distractor).
        frames: how many.
        seed: of the rooms behind and of the noise.
        noise: standard deviation, grey levels.
        exposure: how long the shutter is open, in frames; 0 freezes the motion. Exposures are centred on the frames.
    """

    rig: Rig
    actors: tuple[Actor, ...]
    frames: int
    seed: int = 0
    noise: float = 1.5
    exposure: float = 0.0

    def poses(self) -> RigidTransform:
        """(frames,) the first actor's world_from_object."""
        return RigidTransform.concatenate([self.actors[0].path(float(k)) for k in range(self.frames)])


def render_frames(scene: Scene) -> Iterator[tuple[Image, ...]]:
    """The frames of a scene in order, each one BGR image per camera (height, width, 3)."""
    cameras = [_CameraView(scene, camera, i) for i, camera in enumerate(scene.rig)]
    with ThreadPoolExecutor(min(len(cameras), 8)) as pool:
        for frame in range(scene.frames):
            yield tuple(pool.map(_CameraView.image, cameras, repeat(frame)))


class _CameraView:
    """One camera's renderer: what does not change from frame to frame is prepared once."""

    def __init__(self, scene: Scene, camera: Camera, index: int) -> None:
        self.scene, self.camera, self.index = scene, camera, index
        rng = np.random.default_rng([scene.seed, index])
        width, height = camera.size
        self.background = room(width, height, rng).astype(np.float32)
        # Frames take windows of one larger sheet of noise: drawing it anew would cost more than all the rest.
        self.sheet = rng.standard_normal((height + 97, width + 97, 3), dtype=np.float32) * np.float32(scene.noise)
        # One pixel of margin, so that the finer grid is interpolated at the border too.
        u, v = np.meshgrid(np.arange(-1.0, width + 1), np.arange(-1.0, height + 1))
        rays = camera.normalize(np.column_stack([u.ravel(), v.ravel()])).reshape(height + 2, width + 2, 2)
        fine = cv2.resize(rays.astype(np.float32), None, fx=FINER, fy=FINER, interpolation=cv2.INTER_LINEAR)
        self.rays = np.ascontiguousarray(fine[FINER:-FINER, FINER:-FINER])

    def image(self, frame: int) -> Image:
        """The picture (height, width, 3) of a frame."""
        if self.scene.exposure > 0:
            times = frame + self.scene.exposure * (np.arange(BLUR_POSES) / (BLUR_POSES - 1) - 0.5)
            canvas = np.mean([self._clean(float(t)) for t in times], axis=0)
        else:
            canvas = self._clean(float(frame))
        height, width = canvas.shape[:2]
        dy, dx = np.random.default_rng([self.scene.seed, self.index, frame]).integers(0, 97, 2)
        canvas = canvas + self.sheet[dy : dy + height, dx : dx + width]
        return np.asarray(np.clip(np.rint(canvas), 0, 255), dtype=np.uint8)

    def _clean(self, time: float) -> FloatImage:
        canvas = self.background.copy()
        posed = [(actor.body, actor.path(time)) for actor in self.scene.actors]
        # Far bodies first, so that near ones cover them.
        posed.sort(key=lambda item: -float(np.linalg.norm(item[1].translation - self.camera.center)))
        for body, pose in posed:
            self._draw(canvas, body, pose)
        return canvas

    def _draw(self, canvas: FloatImage, body: TexturedBody, world_from_body: RigidTransform) -> None:
        vertices = world_from_body.apply(body.vertices)
        normals = world_from_body.rotation.apply(body.normals)
        on_faces = vertices[[face[0] for face in body.faces]]
        visible = np.flatnonzero(np.einsum("fi,fi->f", normals, self.camera.center - on_faces) > 0)
        if not len(visible):
            return  # the camera is inside the body
        edges = [_outline(vertices[body.faces[f]]) for f in visible]
        projected = self.camera.project(np.concatenate(edges))
        if not np.isfinite(projected).all():
            return  # the body reaches behind the camera
        outlines = np.split(projected, np.cumsum([len(e) for e in edges])[:-1])
        window = _window(projected, self.camera.size)
        if window is None:
            return
        left, top, right, bottom = window
        fine = np.zeros(((bottom - top) * FINER, (right - left) * FINER, 3), np.uint8)
        cover = np.zeros(fine.shape[:2], np.uint8)
        rays = self.rays[top * FINER : bottom * FINER, left * FINER : right * FINER]
        pose = self.camera.camera_from_world * world_from_body
        rotation, translation = pose.rotation.as_matrix(), pose.translation
        for f, outline in zip(visible, outlines, strict=True):
            # In samples of the window: the centre of pixel 0 is the middle of its FINER samples.
            polygon = (outline - [left, top] + 0.5) * FINER - 0.5
            face_window = _window(polygon, (fine.shape[1], fine.shape[0]))
            if face_window is None:
                continue
            x0, y0, x1, y1 = face_window
            mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
            cv2.fillPoly(mask, [np.rint((polygon - [x0, y0]) * 256).astype(np.int32)], (255,), cv2.LINE_8, 8)
            in_camera = rotation @ body.plane_from_texture[f]
            in_camera[:, 2] += translation
            texture_from_ray = np.linalg.inv(in_camera).astype(np.float32)
            texels = cv2.transform(rays[y0:y1, x0:x1], texture_from_ray)
            # The third is one over the depth; outside the face it may be anything.
            texels = texels[..., :2] / np.maximum(texels[..., 2:], np.float32(1e-9))
            seen = cv2.remap(body.textures[f], texels, NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            shade = AMBIENT + (1 - AMBIENT) * max(float(normals[f] @ LIGHT), 0.0)
            seen = cv2.convertScaleAbs(seen, alpha=shade)
            cv2.copyTo(seen, mask, fine[y0:y1, x0:x1])
            cv2.copyTo(mask, mask, cover[y0:y1, x0:x1])
        size = (right - left, bottom - top)
        share = cv2.resize(cover, size, interpolation=cv2.INTER_AREA)[..., None] / np.float32(255)
        canvas[top:bottom, left:right] *= 1 - share
        canvas[top:bottom, left:right] += cv2.resize(fine, size, interpolation=cv2.INTER_AREA)


def _outline(corners: FloatArray) -> FloatArray:
    """Points along the edges of a polygon (n, 3) in space: (n EDGE_SEGMENTS, 3)."""
    along = np.arange(EDGE_SEGMENTS)[None, :, None] / EDGE_SEGMENTS
    following = np.roll(corners, -1, axis=0)
    return np.asarray((corners[:, None] * (1 - along) + following[:, None] * along).reshape(-1, 3))


def _window(points: FloatArray, size: Sequence[int]) -> tuple[int, int, int, int] | None:
    """The whole pixels (left, top, right, bottom), ends excluded, around points (n, 2), within an image; or None."""
    low = np.maximum(np.floor(points.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(points.max(axis=0)).astype(int) + 2, size)
    if (low >= high).any():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])
