"""Alignment of meshes with outlines: derivatives, exact silhouettes, any world, round bodies, occluders, covariance."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import Mesh
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.silhouettes.background import Silhouette
from sylpose.silhouettes.contours import (
    Alignment,
    Outline,
    align_contours,
    differentiate_contour,
    measure_contour,
    move,
)
from sylpose.silhouettes.rendering import render_mesh, zoom_camera
from sylpose.simulate import arc
from tests.test_mesh import make_cube

RIG = arc(3, 60, 1.5, 400, (240, 180), height=0.4)
RADIUS = 0.25


def join(*parts: Mesh) -> Mesh:
    """Return the meshes as one about the middle of its box, with the common radius."""
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)])
    return Mesh(vertices * RADIUS / np.linalg.norm(vertices, axis=1).max(), faces)


def make_box(sides: Sequence[float], center: Sequence[float] = (0, 0, 0)) -> Mesh:
    cube = make_cube(1.0)
    return Mesh(cube.vertices * sides + center, cube.faces)


def make_bracket() -> Mesh:
    """Return an irregular body without symmetry."""
    return join(
        make_box([1.6, 0.4, 0.5]), make_box([0.4, 1.2, 0.5], [0.6, 0.6, 0]), make_box([0.3, 0.3, 0.7], [-0.6, 0, 0.4])
    )


def make_vase(n: int = 60) -> Mesh:
    """Return a body of revolution about z."""
    heights = np.linspace(-1, 1, 9)
    radii = 0.5 + 0.2 * np.sin(2 * heights + 1)
    angles = 2 * np.pi * np.arange(n) / n
    rings = [
        np.column_stack([r * np.cos(angles), r * np.sin(angles), np.full(n, z)])
        for r, z in zip(radii, heights, strict=True)
    ]
    low = n * np.arange(len(rings) - 1)[:, None] + np.arange(n)
    ahead = n * np.arange(len(rings) - 1)[:, None] + (np.arange(n) + 1) % n
    sides = [np.stack([low, ahead, ahead + n], axis=-1), np.stack([low, ahead + n, low + n], axis=-1)]
    ends = [len(rings) * n, len(rings) * n + 1]
    first, second, last = np.arange(n), (np.arange(n) + 1) % n, n * (len(rings) - 1)
    caps = [
        np.column_stack([np.full(n, ends[0]), second, first]),
        np.column_stack([np.full(n, ends[1]), last + first, last + second]),
    ]
    vertices = np.concatenate([*rings, [[0, 0, heights[0]], [0, 0, heights[-1]]]])
    return join(Mesh(vertices, np.concatenate([*(side.reshape(-1, 3) for side in sides), *caps])))


def draw_outlines(mesh: Mesh, rig: Rig, pose: RigidTransform, occluder: bool = False) -> list[Outline]:
    """Return the outlines of exact silhouettes; with an occluder a third of the image is foreground as well."""
    outlines = []
    for camera in rig:
        fine = render_mesh(mesh, zoom_camera(camera, None, 8), pose).mask.astype(np.float32)
        share = np.asarray(cv2.resize(fine, camera.size, interpolation=cv2.INTER_AREA), np.float32)
        if occluder:
            share[:, : int(camera.project(pose.translation)[0, 0]) - 8] = 1.0
        outlines.append(Outline.of(camera, Silhouette(share, np.where(share > 0.5, 1, -1).astype(np.float32))))
    return outlines


def draw_pose(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    return RigidTransform.from_components(rng.uniform(-0.05, 0.05, 3), Rotation.random(rng=rng))


def disturb(pose: RigidTransform, seed: int, degrees: float = 6.0) -> RigidTransform:
    step = np.random.default_rng(seed).standard_normal(6) * np.repeat([np.radians(degrees) / 3**0.5, 0.01], 3)
    return move(pose, pose.translation, step)


def align(mesh: Mesh, outlines: Sequence[Outline], start: RigidTransform) -> Alignment:
    found = align_contours(mesh, outlines, start)
    assert found is not None
    return found


def error_of(found: RigidTransform, true: RigidTransform) -> FloatArray:
    """Return the error (6,) of (w, d)."""
    return np.concatenate([(found.rotation * true.rotation.inv()).as_rotvec(), found.translation - true.translation])


def test_derivative_of_the_outline() -> None:
    """The residual changes as the derivative predicts, where faces meet in edges."""
    mesh, pose = make_bracket(), draw_pose(1)
    (outline,) = draw_outlines(mesh, RIG[:1], pose)
    contour = measure_contour(mesh, outline, pose)
    assert contour is not None
    # Observed distances are rounded to an eighth of a pixel.
    assert np.nanmedian(np.abs(contour.residuals)) < 0.125
    derivative = differentiate_contour(contour, RIG[0], pose.translation)
    for k, size in enumerate(np.repeat([0.03, 0.006], 3)):
        seen = [
            draw_outlines(mesh, RIG[:1], move(pose, pose.translation, sign * size * np.eye(6)[k]))[0]
            for sign in (1, -1)
        ]
        u, v = contour.pixels.astype(int).T
        moved = (seen[0].distance[v, u] - seen[1].distance[v, u]) / (2 * size)
        error = np.abs(moved - derivative[:, k])
        # Half of the points within 0.1 pixels of the observed motion of up to 3 pixels.
        assert np.median(error) * size < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_pose_from_exact_silhouettes(seed: int) -> None:
    mesh, pose = make_bracket(), draw_pose(seed)
    found = align(mesh, draw_outlines(mesh, RIG, pose), disturb(pose, seed))
    error = error_of(found.world_from_object, pose)
    assert np.degrees(np.linalg.norm(error[:3])) < 0.1
    assert np.linalg.norm(error[3:]) < 5e-4 * 1.5
    assert found.has_converged
    assert found.inliers.sum() > 0.95 * found.points.sum()
    assert np.degrees(np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1])) < 0.2


def test_errors_agree_with_the_covariance() -> None:
    """Squared errors relative to the covariance have a mean of about 6, the number of unknowns."""
    mesh, squares = make_bracket(), []
    for seed in range(12):
        pose = draw_pose(seed)
        found = align(mesh, draw_outlines(mesh, RIG, pose), disturb(pose, seed, 3.0))
        error = error_of(found.world_from_object, pose)
        squares.append(float(error @ np.linalg.solve(found.covariance, error)))
    assert 0.5 < np.mean(squares) < 18


def test_reduced_outlines_are_known() -> None:
    camera = RIG.cameras[0]
    width, height = camera.size
    mask = np.zeros((height, width), bool)
    mask[height // 4 : height // 2, width // 4 : width // 2] = True
    outline = Outline.of(camera, Silhouette.from_mask(mask))
    for step in range(1, 60):
        assert outline.reduce(step).is_known.mean() == outline.is_known.mean() == 1.0


def test_pose_does_not_depend_on_the_world() -> None:
    mesh, pose = make_bracket(), draw_pose(5)
    new_from_world = RigidTransform.from_components([0.3, -2.0, 1.1], Rotation.from_rotvec([0.4, -1.0, 2.0]))
    outlines, start = draw_outlines(mesh, RIG, pose), disturb(pose, 5)
    found = align(mesh, outlines, start)
    moved_rig = RIG.in_world(new_from_world)
    moved = align(mesh, draw_outlines(mesh, moved_rig, new_from_world * pose), new_from_world * start)
    error = error_of(new_from_world.inv() * moved.world_from_object, found.world_from_object)
    np.testing.assert_allclose(error, 0, atol=2e-4)
    turn = np.kron(np.eye(2), new_from_world.rotation.as_matrix())
    np.testing.assert_allclose(moved.covariance, turn @ found.covariance @ turn.T, atol=0.3 * found.covariance.max())


def test_axis_of_a_body_of_revolution_is_not_observable() -> None:
    mesh, pose = make_vase(), draw_pose(7)
    found = align(mesh, draw_outlines(mesh, RIG, pose), disturb(pose, 7, 3.0))
    values, vectors = np.linalg.eigh(found.covariance[:3, :3])
    assert np.degrees(np.sqrt(values[2])) > 60
    axis = pose.rotation.apply([0, 0, 1])
    assert abs(vectors[:, 2] @ axis) > 0.999
    # The rest is known.
    assert np.degrees(np.sqrt(values[1])) < 1
    assert np.linalg.norm(np.cross(found.world_from_object.rotation.apply([0, 0, 1]), axis)) < np.radians(0.5)


def test_occluder_is_an_outlier() -> None:
    """A wall of foreground covers a part of the object in all cameras."""
    mesh, pose = make_bracket(), draw_pose(2)
    found = align(mesh, draw_outlines(mesh, RIG, pose, occluder=True), disturb(pose, 2, 3.0))
    error = error_of(found.world_from_object, pose)
    assert np.degrees(np.linalg.norm(error[:3])) < 1
    assert found.inliers.sum() < 0.9 * found.points.sum()


def test_nothing_in_view() -> None:
    mesh, pose = make_bracket(), draw_pose(3)
    outlines = draw_outlines(mesh, RIG, pose)
    behind = RigidTransform.from_translation([0, 0, 100.0])
    assert align_contours(mesh, outlines, behind * pose) is None
