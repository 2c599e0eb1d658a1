"""Mesh files: shape.glb, the surface of an object as glTF 2.0; shapes from CAD and other programs."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from sylpose.atomic_io import replace_atomically
from sylpose.input_limits import input_errors, read_bytes
from sylpose.io.exports.gltf import BufferBuilder, encode_binary
from sylpose.mesh import Mesh
from sylpose.units import METERS

SURFACE_FILE = "shape.glb"
# Files that `read_mesh` reads, by suffix, and their largest size in bytes (choice: some million faces).
MESH_SUFFIXES, MAX_MESH_BYTES = (".stl", ".obj", ".ply", ".glb"), 2**28


def read_mesh(path: Path, unit: str = "", file_unit: str = "m") -> Mesh:
    """Read a triangle mesh from an STL, OBJ, PLY or GLB file, with equal vertices merged.

    Args:
        path: the file.
        unit: of the result; "" keeps the lengths.
        file_unit: of the file.

    Raises:
        OSError: the file cannot be read; the message names it.
        ValueError: naming the file: another suffix, no mesh, or no faces; trimesh is missing.
    """
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ValueError(f"{path}: a mesh is expected ({', '.join(MESH_SUFFIXES)})")
    data = read_bytes(path, MAX_MESH_BYTES)
    try:
        import trimesh
    except ImportError:
        raise ValueError(f"{path}: mesh files need trimesh: python3 -m pip install 'sylpose[shape]'") from None
    with input_errors(path):
        try:
            # Bytes, not the path: files that it refers to are not read.
            loaded = trimesh.load_mesh(BytesIO(data), file_type=path.suffix.lower()[1:])
            loaded.merge_vertices(merge_tex=True, merge_norm=True)
            vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces)
        except Exception as error:  # of many kinds, on files that are damaged
            raise ValueError(f"no mesh can be read from it ({type(error).__name__}: {error})") from None
        if not len(faces):
            raise ValueError("no faces in it; a surface of triangles is expected, not points or lines")
        return Mesh(vertices * (METERS[file_unit] / METERS[unit] if unit else 1.0), faces)


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
