"""Mesh files: shape.glb, the surface of an object as glTF 2.0."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sylpose.atomic_io import replace_atomically
from sylpose.io.exports.gltf import BufferBuilder, encode_binary
from sylpose.mesh import Mesh
from sylpose.units import METERS

SURFACE_FILE = "shape.glb"


def write_mesh(mesh: Mesh, path: Path, unit: str = "") -> None:
    """Write a mesh as a binary glTF file (.glb), with normals and colors of the vertices.

    Args:
        mesh: the mesh.
        path: the file; replaced if it exists.
        unit: of its lengths: those of glTF are meters. An unknown unit is kept.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    buffer, scale = BufferBuilder(), METERS.get(unit, 1.0)
    attributes = {
        "POSITION": buffer.add_accessor(scale * mesh.vertices, "VEC3", bounds=True),
        "NORMAL": buffer.add_accessor(mesh.vertex_normals, "VEC3"),
    }
    if mesh.colors is not None:
        # The colors of glTF are linear, those of images sRGB (IEC 61966-2-1).
        encoded = mesh.colors / 255.0
        linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
        attributes["COLOR_0"] = buffer.add_accessor(linear, "VEC3")
    indices = buffer.add_accessor(mesh.faces.ravel(), "SCALAR")
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "sylpose"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "object", "mesh": 0}],
        "meshes": [{"name": "surface", "primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    with replace_atomically(path) as part:
        part.write_bytes(encode_binary(content, bytes(buffer.data)))
