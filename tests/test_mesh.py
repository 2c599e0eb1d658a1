"""Meshes: validation, normals and connected parts; shape.glb read by another library."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from sylpose import Mesh
from sylpose.io.mesh_files import write_mesh


def make_cube(side: float = 2.0) -> Mesh:
    """Return a cube about the origin, its faces counterclockwise from outside."""
    vertices = side / 2 * np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    hull = ConvexHull(vertices)
    a, b, c = (vertices[hull.simplices[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    return Mesh(vertices, faces, np.tile(np.array([200, 100, 0], np.uint8), (8, 1)))


def test_normals_point_outwards() -> None:
    cube = make_cube()
    assert cube.size == 2.0
    assert np.linalg.norm(cube.face_normals, axis=1) == pytest.approx(4.0)
    assert ((cube.vertex_normals * cube.vertices).sum(axis=1) > 0.9).all()


def test_largest_part() -> None:
    cube = make_cube()
    far = Mesh(
        np.concatenate([[[9.0, 9, 9], [9, 9, 8], [9, 8, 9]], cube.vertices]),
        np.concatenate([[[0, 1, 2]], cube.faces + 3]),
    )
    part = far.largest_part()
    np.testing.assert_array_equal(part.vertices, cube.vertices)
    np.testing.assert_array_equal(part.faces, cube.faces)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": np.full((8, 3), np.nan)}, "vertices"),
        ({"vertices": np.zeros((8, 2))}, "vertices"),
        ({"faces": np.zeros((0, 3), int)}, "faces"),
        ({"faces": np.array([[0, 1, 8]])}, "8 vertices"),
        ({"faces": np.array([[0, 1, 0.5]])}, "8 vertices"),
        ({"colors": np.zeros((8, 3))}, "colors"),
    ],
)
def test_bad_meshes_are_refused(change: dict[str, np.ndarray], message: str) -> None:
    cube = make_cube()
    values = {"vertices": cube.vertices, "faces": cube.faces, "colors": cube.colors} | change
    with pytest.raises(ValueError, match=message):
        Mesh(**values)  # type: ignore[arg-type]


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1e-3), ("", 1.0)])
def test_glb_is_read_by_another_library(tmp_path: Path, unit: str, scale: float) -> None:
    trimesh = pytest.importorskip("trimesh")
    cube = make_cube()
    write_mesh(cube, tmp_path / "shape.glb", unit)
    found = trimesh.load(tmp_path / "shape.glb", force="mesh", process=False)
    np.testing.assert_allclose(found.vertices, scale * cube.vertices)
    np.testing.assert_array_equal(found.faces, cube.faces)
    assert found.volume == pytest.approx(8.0 * scale**3)
    content = (tmp_path / "shape.glb").read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    header = json.loads(content[20 : 20 + length])
    accessor = header["accessors"][header["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    start = 28 + length + header["bufferViews"][accessor["bufferView"]]["byteOffset"]
    # sRGB 200, 100, 0 in linear light.
    np.testing.assert_allclose(struct.unpack("<3f", content[start : start + 12]), [0.578, 0.127, 0.0], atol=1e-3)
