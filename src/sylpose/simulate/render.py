"""Renderer of textured convex bodies that move in front of the cameras of a rig, with a room as background.

Each visible face is a homography of its texture, evaluated through the lens on a finer pixel grid and averaged down.
For convex bodies no 3D engine is needed.
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
from sylpose.simulate.textures import FACE_HUES, make_face_texture, make_room_image

Path = Callable[[float], RigidTransform]

# Second map argument of `cv2.remap` if the first contains both coordinates.
NO_SECOND_MAP: Any = None

# Samples per pixel in each direction; segments per edge, because lenses bend edges; poses per exposure with motion
# blur.
SUPERSAMPLING = 2
EDGE_SEGMENTS = 6
BLUR_POSES = 7
# Texels around a face's outline, for interpolation.
TEXTURE_MARGIN = 2
# Direction towards the light (the world's up is -y), and the ambient share that reaches every face.
LIGHT = np.array([-0.45, -0.8, -0.4]) / np.linalg.norm([-0.45, -0.8, -0.4])
AMBIENT = 0.62


@dataclass(frozen=True, eq=False)
class TexturedBody:
    """Convex polyhedron with a texture on each face.

    Attributes:
        vertices: (v, 3) in the body's frame.
        faces: per face its vertices' indices, in order around it.
        normals: (f, 3) outward unit normals.
        textures: per face a BGR image.
        plane_from_texture: (f, 3, 3) maps a texture's pixel (u, v, 1) to a point in the body's frame.
    """

    vertices: FloatArray
    faces: tuple[IntArray, ...]
    normals: FloatArray
    textures: tuple[Image, ...]
    plane_from_texture: FloatArray

    @classmethod
    def from_hull(cls, points: ArrayLike, texels_per_unit: float, seed: int = 0) -> TexturedBody:
        """Build the convex hull of points (n, 3), each face with its own texture of that resolution.

        Args:
            points: (n, 3) in the body's frame.
            texels_per_unit: resolution of the textures, per unit of length.
            seed: seed of the textures.

        Raises:
            ValueError: the points have no volume, or the resolution is not positive.
        """
        points = np.asarray(points, dtype=float)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 4 or np.linalg.matrix_rank(points - points[0]) < 3:
            raise ValueError("a body needs at least 4 points (n, 3) that are not all in one plane")
        if not texels_per_unit > 0:
            raise ValueError(f"texels_per_unit must be positive, got {texels_per_unit}")
        rng = np.random.default_rng(seed)
        hull = ConvexHull(points)
        # Triangles of the hull in the same plane form one face.
        size = np.abs(points).max()
        planes = np.round(hull.equations / [1, 1, 1, size], 6) + 0.0
        _, first, face_of = np.unique(planes, axis=0, return_index=True, return_inverse=True)
        normals = hull.equations[first, :3]
        faces, textures, frames = [], [], []
        for i, normal in enumerate(normals):
            corners = np.unique(hull.simplices[face_of.ravel() == i])
            # Viewed from outside, a texture's u points right and v down, as near to the body's y as the face allows.
            down = np.array([0.0, 1.0, 0.0]) if abs(normal[1]) < 0.99 else np.array([0.0, 0.0, normal[1]])
            e2 = down - (down @ normal) * normal
            e2 /= np.linalg.norm(e2)
            e1 = np.cross(normal, e2)
            flat = points[corners] @ np.stack([e1, e2], axis=1)
            offsets = flat - flat.mean(axis=0)
            order = np.argsort(np.arctan2(offsets[:, 1], offsets[:, 0]))
            corners, flat = corners[order], flat[order]
            low = flat.min(axis=0) - TEXTURE_MARGIN / texels_per_unit
            outline = (flat - low) * texels_per_unit
            width, height = np.ceil(outline.max(axis=0)).astype(int) + TEXTURE_MARGIN + 1
            faces.append(corners)
            textures.append(make_face_texture(int(width), int(height), outline, FACE_HUES[i % len(FACE_HUES)], rng))
            axes = np.stack([e1, e2], axis=1)
            origin = points[corners[0]] + axes @ (low - flat[0])
            frames.append(np.column_stack([axes / texels_per_unit, origin]))
        return cls(points, tuple(faces), normals, tuple(textures), np.array(frames))


def chamfered_box(sides: ArrayLike, texels_per_unit: float, *, chamfer: float = 0.16, seed: int = 0) -> TexturedBody:
    """Build a box with sides (3,) whose edges and corners are cut off by `chamfer` of the shortest side: 26 faces."""
    half = np.asarray(sides, dtype=float) / 2
    cut = half - chamfer * 2 * half.min()
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    corners = np.concatenate([signs * np.where(np.arange(3) == axis, half, cut) for axis in range(3)])
    return TexturedBody.from_hull(corners, texels_per_unit, seed)


@dataclass(frozen=True, eq=False)
class Actor:
    """Body with its motion: `path(frame)` is its world_from_body, also for fractional frames."""

    body: TexturedBody
    path: Path


@dataclass(frozen=True, eq=False)
class Scene:
    """Scene to be rendered.

    Attributes:
        rig: the cameras.
        actors: the object first; others may pass in front of it (an occluder) or next to it (a distractor).
        frames: number of frames.
        seed: seed of the background rooms and of the noise.
        noise: standard deviation, gray levels.
        exposure: exposure time, in frames; 0 means no motion blur. Exposures are centered on the frames.
    """

    rig: Rig
    actors: tuple[Actor, ...]
    frames: int
    seed: int = 0
    noise: float = 1.5
    exposure: float = 0.0

    def object_poses(self) -> RigidTransform:
        """Return the first actor's world_from_object (frames,)."""
        return RigidTransform.concatenate([self.actors[0].path(float(k)) for k in range(self.frames)])


def render_frames(scene: Scene) -> Iterator[tuple[Image, ...]]:
    """Render the frames of a scene in order: one BGR image (height, width, 3) per camera."""
    cameras = [_CameraView(scene, camera, i) for i, camera in enumerate(scene.rig)]
    with ThreadPoolExecutor(min(len(cameras), 8)) as pool:
        for frame in range(scene.frames):
            yield tuple(pool.map(_CameraView.render_image, cameras, repeat(frame)))


class _CameraView:
    """Renderer of one camera; data that is constant over the frames is computed once."""

    def __init__(self, scene: Scene, camera: Camera, index: int) -> None:
        self.scene, self.camera, self.index = scene, camera, index
        rng = np.random.default_rng([scene.seed, index])
        width, height = camera.size
        self.background = make_room_image(width, height, rng).astype(np.float32)
        # Frames use windows of one larger sheet of noise: new noise per frame would take longer than all other steps.
        self.sheet = rng.standard_normal((height + 97, width + 97, 3), dtype=np.float32) * np.float32(scene.noise)
        # A margin of one pixel, so that the finer grid is interpolated at the border too.
        u, v = np.meshgrid(np.arange(-1.0, width + 1), np.arange(-1.0, height + 1))
        rays = camera.normalize(np.column_stack([u.ravel(), v.ravel()])).reshape(height + 2, width + 2, 2)
        fine = cv2.resize(
            rays.astype(np.float32), None, fx=SUPERSAMPLING, fy=SUPERSAMPLING, interpolation=cv2.INTER_LINEAR
        )
        self.rays = np.ascontiguousarray(fine[SUPERSAMPLING:-SUPERSAMPLING, SUPERSAMPLING:-SUPERSAMPLING])

    def render_image(self, frame: int) -> Image:
        """Render the image (height, width, 3) of a frame."""
        if self.scene.exposure > 0:
            times = frame + self.scene.exposure * (np.arange(BLUR_POSES) / (BLUR_POSES - 1) - 0.5)
            canvas = np.mean([self._render_noise_free(float(t)) for t in times], axis=0)
        else:
            canvas = self._render_noise_free(float(frame))
        height, width = canvas.shape[:2]
        dy, dx = np.random.default_rng([self.scene.seed, self.index, frame]).integers(0, 97, 2)
        canvas = canvas + self.sheet[dy : dy + height, dx : dx + width]
        return np.asarray(np.clip(np.rint(canvas), 0, 255), dtype=np.uint8)

    def _render_noise_free(self, time: float) -> FloatImage:
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
        edges = [_sample_outline(vertices[body.faces[f]]) for f in visible]
        projected = self.camera.project(np.concatenate(edges))
        if not np.isfinite(projected).all():
            return  # the body reaches behind the camera
        outlines = np.split(projected, np.cumsum([len(e) for e in edges])[:-1])
        window = _bounding_window(projected, self.camera.size)
        if window is None:
            return
        left, top, right, bottom = window
        fine = np.zeros(((bottom - top) * SUPERSAMPLING, (right - left) * SUPERSAMPLING, 3), np.uint8)
        cover = np.zeros(fine.shape[:2], np.uint8)
        rays = self.rays[top * SUPERSAMPLING : bottom * SUPERSAMPLING, left * SUPERSAMPLING : right * SUPERSAMPLING]
        pose = self.camera.camera_from_world * world_from_body
        rotation, translation = pose.rotation.as_matrix(), pose.translation
        for f, outline in zip(visible, outlines, strict=True):
            # In samples of the window: the center of pixel 0 is the middle of its SUPERSAMPLING samples.
            polygon = (outline - [left, top] + 0.5) * SUPERSAMPLING - 0.5
            face_window = _bounding_window(polygon, (fine.shape[1], fine.shape[0]))
            if face_window is None:
                continue
            x0, y0, x1, y1 = face_window
            mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
            cv2.fillPoly(mask, [np.rint((polygon - [x0, y0]) * 256).astype(np.int32)], (255,), cv2.LINE_8, 8)
            in_camera = rotation @ body.plane_from_texture[f]
            in_camera[:, 2] += translation
            texture_from_ray = np.linalg.inv(in_camera).astype(np.float32)
            texels = cv2.transform(rays[y0:y1, x0:x1], texture_from_ray)
            # The third coordinate is the inverse depth; outside the face it is arbitrary.
            texels = texels[..., :2] / np.maximum(texels[..., 2:], np.float32(1e-9))
            face_image = cv2.remap(
                body.textures[f], texels, NO_SECOND_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            shade = AMBIENT + (1 - AMBIENT) * max(float(normals[f] @ LIGHT), 0.0)
            face_image = cv2.convertScaleAbs(face_image, alpha=shade)
            cv2.copyTo(face_image, mask, fine[y0:y1, x0:x1])
            cv2.copyTo(mask, mask, cover[y0:y1, x0:x1])
        size = (right - left, bottom - top)
        share = cv2.resize(cover, size, interpolation=cv2.INTER_AREA)[..., None] / np.float32(255)
        canvas[top:bottom, left:right] *= 1 - share
        canvas[top:bottom, left:right] += cv2.resize(fine, size, interpolation=cv2.INTER_AREA)


def _sample_outline(corners: FloatArray) -> FloatArray:
    """Return points (n EDGE_SEGMENTS, 3) along the edges of a polygon (n, 3) in space."""
    fractions = np.arange(EDGE_SEGMENTS)[None, :, None] / EDGE_SEGMENTS
    next_corners = np.roll(corners, -1, axis=0)
    return np.asarray((corners[:, None] * (1 - fractions) + next_corners[:, None] * fractions).reshape(-1, 3))


def _bounding_window(points: FloatArray, size: Sequence[int]) -> tuple[int, int, int, int] | None:
    """Return the pixel window (left, top, right, bottom), ends excluded, around points (n, 2) in an image; or None."""
    low = np.maximum(np.floor(points.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(points.max(axis=0)).astype(int) + 2, size)
    if (low >= high).any():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])
