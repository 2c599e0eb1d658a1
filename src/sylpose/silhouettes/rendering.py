"""Rendering of a mesh into a camera: which face each pixel shows, and how near it is."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import BoolArray, FloatArray, FloatImage, Image, IntArray
from sylpose.geometry.numba_linalg import leaf
from sylpose.mesh import Mesh
from sylpose.rig import Camera

# Longer sides of images are reduced by whole factors, pixels (choice: the target of 0.5 % of an object that fills a third
# of the image is then 2 pixels).
MAX_SIDE = 1024
# Gray level of faces that are seen from the side.
AMBIENT = 60


class Rendering(NamedTuple):
    """Rendering of a mesh.

    Attributes:
        face: (h, w) number of the face at the pixel's center; -1 without one.
        inverse_depth: (h, w) of that face; 0 without one.
    """

    face: NDArray[np.int32]
    inverse_depth: FloatImage

    @property
    def mask(self) -> BoolArray:
        """(h, w) whether the pixel shows the mesh."""
        return np.asarray(self.face >= 0)


def zoom_camera(camera: Camera, window: tuple[IntArray, IntArray] | None = None, factor: float = 1.0) -> Camera:
    """Return the camera of a part of the image that is enlarged or reduced.

    Args:
        camera: of the whole image.
        window: (2,) first pixel of the part and (2,) the one after its last; None: the whole image.
        factor: ratio of the sizes; the part's size must become an integer.
    """
    first, end = (np.zeros(2), np.array(camera.size)) if window is None else window
    matrix = camera.matrix * factor
    # Pixels are numbered by their centers.
    matrix[:2, 2] = (camera.matrix[:2, 2] - first + 0.5) * factor - 0.5
    matrix[2, 2] = 1
    width, height = (round(float(side) * factor) for side in end - first)
    return replace(camera, matrix=matrix, size=(width, height))


def reduce_camera(camera: Camera) -> Camera:
    """Return the camera of images that `reduce_image` has reduced."""
    step = -(-max(camera.size) // MAX_SIDE)
    return zoom_camera(camera, (np.zeros(2, int), step * (np.array(camera.size) // step)), 1 / step)


def reduce_image(image: Image) -> Image:
    """Return an image (h, w) or (h, w, 3) in color, reduced by a whole factor to a handy size."""
    return _reduce(image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8))


def reduce_mask(mask: BoolArray) -> BoolArray:
    """Return a mask (h, w), reduced as `reduce_image` does."""
    return np.asarray(_reduce(np.where(mask, 255, 0).astype(np.uint8)) > 127)


def _reduce(image: Image) -> Image:
    height, width = image.shape[:2]
    step = -(-max(height, width) // MAX_SIDE)
    cropped, size = image[: height - height % step, : width - width % step], (width // step, height // step)
    return cropped if step == 1 else np.asarray(cv2.resize(cropped, size, interpolation=cv2.INTER_AREA), np.uint8)


def render_mesh(mesh: Mesh, camera: Camera, world_from_object: RigidTransform) -> Rendering:
    """Render a mesh; faces that reach behind the camera are omitted."""
    in_world = world_from_object.apply(mesh.vertices)
    pixels = camera.project(in_world)
    depth = camera.camera_from_world.apply(in_world)[:, 2]
    width, height = camera.size
    out = Rendering(np.full((height, width), -1, np.int32), np.zeros((height, width), np.float32))
    with np.errstate(divide="ignore"):
        _fill_faces(np.ascontiguousarray(pixels), 1.0 / depth, np.ascontiguousarray(mesh.faces), *out)
    return out


def draw_mask(mesh: Mesh, camera: Camera, vertices: FloatArray) -> BoolArray:
    """Return the mask (h, w) of a mesh with its vertices (n, 3) elsewhere in the world."""
    mask = np.zeros(camera.size[::-1], bool)
    _fill_mask(camera.project(vertices), mesh.faces, mask)
    return mask


@leaf
def _fill_mask(pixels: FloatArray, faces: IntArray, mask: BoolArray) -> None:
    """Set the pixels inside of any face, from the vertices' pixels (n, 2), row by row."""
    height, width = mask.shape
    for m in range(len(faces)):
        i, j, k = faces[m, 0], faces[m, 1], faces[m, 2]
        ax, ay, bx, by, cx, cy = pixels[i, 0], pixels[i, 1], pixels[j, 0], pixels[j, 1], pixels[k, 0], pixels[k, 1]
        if not abs((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)) > 0.0:  # NaN, too
            continue
        top, bottom = max(min(ay, by, cy), 0.0), min(max(ay, by, cy), height - 1.0)
        if top > bottom:
            continue
        for y in range(int(np.ceil(top)), int(bottom) + 1):
            left, right = np.inf, -np.inf
            for px, py, qx, qy in ((ax, ay, bx, by), (bx, by, cx, cy), (cx, cy, ax, ay)):
                if min(py, qy) <= y <= max(py, qy):
                    x = px + (y - py) / (qy - py) * (qx - px) if py != qy else px
                    left, right = min(left, x), max(right, x)
            for u in range(int(np.ceil(min(max(left, 0.0), width))), int(min(max(right, -1.0), width - 1.0)) + 1):
                mask[y, u] = True


@leaf
def _fill_faces(
    pixels: FloatArray, inverse_depth: FloatArray, faces: IntArray, face: NDArray[np.int32], nearest: FloatImage
) -> None:
    """Write the nearest face of each pixel and its inverse depth, from the vertices' pixels (n, 2) and depths (n,)."""
    height, width = face.shape
    for m in range(len(faces)):
        i, j, k = faces[m, 0], faces[m, 1], faces[m, 2]
        ax, ay, bx, by, cx, cy = pixels[i, 0], pixels[i, 1], pixels[j, 0], pixels[j, 1], pixels[k, 0], pixels[k, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not abs(area) > 0.0:  # NaN, too
            continue
        left, right = max(min(ax, bx, cx), 0.0), min(max(ax, bx, cx), width - 1.0)
        top, bottom = max(min(ay, by, cy), 0.0), min(max(ay, by, cy), height - 1.0)
        if left > right or top > bottom:
            continue
        for y in range(int(np.ceil(top)), int(bottom) + 1):
            for x in range(int(np.ceil(left)), int(right) + 1):
                u = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                v = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                if u >= 0.0 and v >= 0.0 and u + v <= 1.0:
                    value = u * inverse_depth[i] + v * inverse_depth[j] + (1.0 - u - v) * inverse_depth[k]
                    if value > nearest[y, x]:
                        nearest[y, x] = value
                        face[y, x] = m


def shade_mesh(mesh: Mesh, rendering: Rendering, camera: Camera, world_from_object: RigidTransform) -> Image:
    """Return a picture (h, w, 3), BGR, of a rendered mesh as lit by a lamp at the camera; black without the mesh."""
    normals = world_from_object.rotation.apply(mesh.face_normals)
    light = normals @ -camera.direction / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
    levels = np.rint(AMBIENT + (255 - AMBIENT) * np.clip(light, 0, 1)).astype(np.uint8)
    shown = np.where(rendering.mask, levels[rendering.face], 0).astype(np.uint8)
    return np.repeat(shown[..., None], 3, axis=2)
