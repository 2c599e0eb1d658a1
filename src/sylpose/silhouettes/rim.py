"""Rim of a mesh in a camera: the edges of its faces along the outline of its image, exact to the numbers' precision.

An edge is on the rim if both of its faces are on the same side of it in the image, and if nothing is on the other side.
The term is that of R. Cipolla and P. Giblin, "Visual motion of curves and surfaces", 2000.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.numba_linalg import leaf
from sylpose.mesh import Mesh
from sylpose.rig import Camera
from sylpose.silhouettes.rendering import draw_mask, zoom_camera

# Pixels about the object's image that are drawn (derived: more than the way to the outside).
MARGIN = 4
# Way from an edge to where the mask shows whether it is on the rim, pixels (derived: more than half of a pixel's diagonal).
OUTSIDE_PX = 1.0
# Pixels from one point of the rim to the next (derived: the pixels between which residuals are measured).
SPACING_PX = 1.0
# A mesh that reaches farther out of the image, in image sizes, reaches nearly behind the camera (choice: lens models end
# before).
MAX_REACH = 100.0


@dataclass(frozen=True, eq=False)
class Rim:
    """Rim of a mesh in a camera.

    Attributes:
        corner: (2,) first pixel of the window that was drawn, u and v.
        mask: (h, w) pixels of the window that show the mesh.
        points: (n, 3) of the rim, in the world.
        pixels: (n, 2) theirs.
        normals: (n, 2) outward unit normals there.
    """

    corner: IntArray
    mask: BoolArray
    points: FloatArray
    pixels: FloatArray
    normals: FloatArray

    def find_nearest(self, pixels: FloatArray | IntArray) -> IntArray:
        """Return the numbers (m,) of the points next to pixels (m, 2); the rim has some."""
        out = np.empty(len(pixels), np.int64)
        _find_nearest(np.ascontiguousarray(pixels, float), self.pixels, out)
        return out

    def measure_distances(self, pixels: FloatArray) -> FloatArray:
        """Return the signed distances (m,) of pixels (m, 2) to the rim, positive inside; -inf without any."""
        if not len(self.pixels):
            return np.full(len(pixels), -np.inf)
        nearest = self.find_nearest(pixels)
        away, normals = pixels - self.pixels[nearest], self.normals[nearest]
        along = (away * normals).sum(axis=1)
        # Next to an edge its distance is exact, elsewhere that of the point; the mask is right but for half a pixel.
        is_next = np.abs(away[:, 0] * normals[:, 1] - away[:, 1] * normals[:, 0]) <= SPACING_PX
        size = np.where(is_next, np.abs(along), np.linalg.norm(away, axis=1))
        is_inside = np.where(size < OUTSIDE_PX, along < 0, _look_up(self.mask, pixels - self.corner))
        return np.asarray(np.where(is_inside, size, -size))


def find_rim(mesh: Mesh, camera: Camera, world_from_object: RigidTransform) -> Rim | None:
    """Find the rim of a mesh; None if the mesh is not in the image, or reaches (nearly) behind the camera."""
    vertices = world_from_object.apply(mesh.vertices)
    pixels = camera.project(vertices)
    if not (np.abs(pixels) < MAX_REACH * max(camera.size)).all():  # NaN, too
        return None
    first = np.clip(np.floor(pixels.min(axis=0)) - MARGIN, 0, camera.size).astype(int)
    last = np.clip(np.ceil(pixels.max(axis=0)) + MARGIN + 1, 0, camera.size).astype(int)
    if (last <= first).any():
        return None
    mask = draw_mask(mesh, zoom_camera(camera, (first, last)), vertices)
    edges = mesh.edges
    a, b = pixels[edges[:, 0]], pixels[edges[:, 1]]
    along, sides = b - a, np.zeros((2, len(edges)))
    for side, k in zip(sides, (2, 3), strict=True):
        away = pixels[edges[:, k]] - a
        side[:] = along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0]
    # An edge with a single face has no other side.
    is_rim = (sides[0] * sides[1] > 0) | (edges[:, 3] < 0)
    edges, along, side = edges[is_rim], along[is_rim], sides[0, is_rim]
    counts = np.ceil(np.linalg.norm(along, axis=1) / SPACING_PX).astype(int)
    number = np.repeat(np.arange(len(edges)), counts)
    step = (np.arange(len(number)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[number]
    start, end = vertices[edges[number, 0]], vertices[edges[number, 1]]
    points = start + step[:, None] * (end - start)
    at = camera.project(points)
    tangent = camera.project(points + (end - start) * (0.5 / counts[number])[:, None]) - at
    normals = (
        np.stack([tangent[:, 1], -tangent[:, 0]], axis=1) / np.maximum(np.linalg.norm(tangent, axis=1), 1e-12)[:, None]
    )
    normals *= np.where(side[number] > 0, 1.0, -1.0)[:, None]
    is_outline = ~_look_up(mask, at + OUTSIDE_PX * normals - first)
    return Rim(first, mask, points[is_outline], np.ascontiguousarray(at[is_outline]), normals[is_outline])


def _look_up(mask: BoolArray, pixels: FloatArray) -> BoolArray:
    """Return the values (n,) of a mask at pixels (n, 2); False outside."""
    u, v = np.rint(pixels).astype(int).T
    is_in = (u >= 0) & (v >= 0) & (u < mask.shape[1]) & (v < mask.shape[0])
    out = np.zeros(len(pixels), bool)
    out[is_in] = mask[v[is_in], u[is_in]]
    return out


@leaf
def _find_nearest(pixels: FloatArray, among: FloatArray, out: IntArray) -> None:
    for i in range(len(pixels)):
        least = np.inf
        for k in range(len(among)):
            du, dv = among[k, 0] - pixels[i, 0], among[k, 1] - pixels[i, 1]
            square = du * du + dv * dv
            if square < least:
                least = square
                out[i] = k
