"""Meshes from files of other programs: units, merged vertices, and files that are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sylpose.io.mesh_files import read_mesh, write_mesh
from tests.test_mesh import make_cube

trimesh = pytest.importorskip("trimesh")


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb"])
def test_all_formats_have_the_same_surface(tmp_path: Path, suffix: str) -> None:
    cube = make_cube()
    trimesh.Trimesh(cube.vertices, cube.faces, process=False).export(tmp_path / f"cube.{suffix}")
    found = read_mesh(tmp_path / f"cube.{suffix}")
    # STL repeats the vertices of each face.
    assert found.vertices.shape == (8, 3)
    corners = [{tuple(corner) for corner in mesh.vertices[mesh.faces].reshape(-1, 9)} for mesh in (found, cube)]
    assert {tuple(sorted(c)) for c in corners[0]} == {tuple(sorted(c)) for c in corners[1]}
    assert (found.vertex_normals * found.vertices).sum() > 0


def test_lengths_are_converted(tmp_path: Path) -> None:
    trimesh.Trimesh(*_surface()).export(tmp_path / "cube.stl")
    assert read_mesh(tmp_path / "cube.stl").size == 2.0
    assert read_mesh(tmp_path / "cube.stl", "mm").size == 2000.0
    assert read_mesh(tmp_path / "cube.stl", "m", "mm").size == pytest.approx(0.002)
    write_mesh(make_cube(), tmp_path / "own.glb", "mm")
    assert read_mesh(tmp_path / "own.glb", "mm").size == pytest.approx(2.0)


def _surface() -> tuple[np.ndarray, np.ndarray]:
    cube = make_cube()
    return cube.vertices, cube.faces


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("part.step", b"ISO-10303-21;", "a mesh is expected"),
        ("part.stl", b"", "part.stl"),
        ("part.stl", b"solid x\nendsolid x\n", "part.stl"),
        ("part.stl", bytes(80) + b"\xff\xff\xff\xff", "part.stl"),
        ("part.obj", b"v 0 0 0\nv 1 0 0\n", "part.obj"),
        ("part.obj", b"v 0 0 0\nv 1 0 0\nv nan 0 1\nf 1 2 3\n", "part.obj"),
        ("part.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n", "part.ply"),
        ("part.glb", b"glTF\2\0\0\0\0\0\0\0", "part.glb"),
        ("part.glb", b"PK\3\4", "part.glb"),
    ],
)
def test_files_that_are_no_meshes(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_mesh(tmp_path / name)
    assert "\n" not in str(caught.value)
