"""Triangle meshes: the surface of an object."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sylpose.geometry.arrays import FloatArray, Image, IntArray
from sylpose.geometry.validation import check_finite, check_real

# Largest coordinate and number of vertices or faces (choice).
MAX_COORDINATE, MAX_ELEMENTS = 1e12, 10**7


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh in an object's frame.

    Attributes:
        vertices: (n, 3).
        faces: (m, 3) numbers of vertices, counterclockwise from outside.
        colors: (n, 3) RGB of the vertices, or None.

    Raises:
        ValueError: naming the attribute: another shape, not finite, no faces, or a face of missing vertices.
    """

    vertices: FloatArray
    faces: IntArray
    colors: Image | None = None

    def __post_init__(self) -> None:
        vertices = np.array(check_finite(self.vertices, ("n", 3), "vertices", maximum=MAX_COORDINATE))
        faces = check_real(self.faces, "(m, 3)", "faces")
        if faces.ndim != 2 or faces.shape[1] != 3 or not 0 < len(faces) <= MAX_ELEMENTS:
            raise ValueError(f"faces must be (m, 3) with at least one triangle, got shape {faces.shape}")
        if not ((faces >= 0) & (faces < len(vertices)) & (faces == np.round(faces))).all():
            raise ValueError(f"faces must be numbers of the {len(vertices)} vertices")
        colors = None if self.colors is None else np.array(self.colors)
        if colors is not None and (colors.shape != vertices.shape or colors.dtype != np.uint8):
            raise ValueError(f"colors must be uint8 {vertices.shape}, got {colors.dtype} {colors.shape}")
        for name, values in (("vertices", vertices), ("faces", np.array(faces, np.int64)), ("colors", colors)):
            if values is not None:
                values.setflags(write=False)
            object.__setattr__(self, name, values)

    @property
    def checksum(self) -> str:
        """BLAKE2b checksum of vertices and faces."""
        content = np.ascontiguousarray(self.vertices).tobytes() + np.ascontiguousarray(self.faces).tobytes()
        return hashlib.blake2b(content, digest_size=16).hexdigest()

    @property
    def size(self) -> float:
        """Longest side of the bounding box."""
        return float(np.ptp(self.vertices, axis=0).max())

    @property
    def face_normals(self) -> FloatArray:
        """(m, 3) outward normals with the length of twice the face's area."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.asarray(np.cross(b - a, c - a))

    @property
    def vertex_normals(self) -> FloatArray:
        """(n, 3) outward unit normals, means over the faces by their areas; 0 without any."""
        normals, of_faces = np.zeros_like(self.vertices), self.face_normals
        for k in range(3):
            np.add.at(normals, self.faces[:, k], of_faces)
        return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300))

    @cached_property
    def edges(self) -> IntArray:
        """(k, 4) numbers of each edge's two vertices, and of the vertices opposite of it in its two faces.

        The last one is -1 of an edge with another number of faces.
        """
        n = len(self.vertices)
        ends = np.concatenate([self.faces[:, [k, (k + 1) % 3]] for k in range(3)])
        opposite = np.concatenate([self.faces[:, (k + 2) % 3] for k in range(3)])
        keys = ends.min(axis=1) * n + ends.max(axis=1)
        order = np.argsort(keys, kind="stable")
        _, first, counts = np.unique(keys[order], return_index=True, return_counts=True)
        second = order[np.minimum(first + 1, len(order) - 1)]
        last = np.where(counts == 2, opposite[second], -1)
        return np.column_stack([ends[order[first]], opposite[order[first]], last])

    def largest_part(self) -> Mesh:
        """Return the connected part with most faces."""
        n, (i, j, k) = len(self.vertices), self.faces.T
        ends = np.concatenate([i, j]), np.concatenate([j, k])
        _, part = connected_components(coo_array((np.ones(len(ends[0]), bool), ends), (n, n)), directed=False)
        kept = part == np.bincount(part[self.faces[:, 0]]).argmax()
        number = np.cumsum(kept) - 1
        colors = None if self.colors is None else self.colors[kept]
        return Mesh(self.vertices[kept], number[self.faces[kept[self.faces[:, 0]]]], colors)
