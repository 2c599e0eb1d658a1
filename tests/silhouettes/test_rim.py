"""Rims of meshes: against finely drawn images, any winding of the faces, and masks that agree with renderings."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sylpose import Mesh
from sylpose.rig import Camera
from sylpose.silhouettes.rendering import draw_mask, render_mesh, zoom_camera
from sylpose.silhouettes.rim import find_rim
from tests.silhouettes.test_contours import RIG, draw_pose, make_bracket, make_vase
from tests.test_mesh import make_cube

ZOOM = 16
BENT = replace(RIG[0], distortion=np.array([-0.3, 0.1, 0.002, -0.001, 0.0]))


@pytest.mark.parametrize(
    ("mesh", "camera"),
    # Images have straight edges between vertices: a bent lens needs short ones.
    [(make_bracket(), RIG[0]), (make_vase(), RIG[0]), (make_vase(), BENT)],
    ids=["bracket", "vase", "vase, bent lens"],
)
def test_rim_is_the_outline_of_a_fine_image(mesh: Mesh, camera: Camera) -> None:
    for seed in range(3):
        pose = draw_pose(seed)
        rim = find_rim(mesh, camera, pose)
        assert rim is not None
        fine = draw_mask(mesh, zoom_camera(camera, None, ZOOM), pose.apply(mesh.vertices)).astype(np.uint8)
        inner, outer = (cv2.distanceTransform(mask, cv2.DIST_L2, 0) for mask in (fine, 1 - fine))
        distance = np.where(fine > 0, inner - 0.5, 0.5 - outer) / ZOOM
        u, v = np.rint((rim.pixels + 0.5) * ZOOM - 0.5).astype(int).T
        # Where two edges cross, the last pixel of the hidden one counts as outline.
        assert np.quantile(np.abs(distance[v, u]), 0.95) < 0.1
        u, v = np.rint((rim.pixels + 3 * rim.normals + 0.5) * ZOOM - 0.5).astype(int).T
        assert np.median(distance[v, u]) == pytest.approx(-3, abs=0.1)
        pixels = np.random.default_rng(seed).uniform(rim.corner, rim.corner + rim.mask.shape[::-1], (500, 2))
        u, v = np.rint((pixels + 0.5) * ZOOM - 0.5).astype(int).T
        errors = np.abs(rim.measure_distances(pixels) - distance[v, u])
        assert np.quantile(errors, 0.95) < 0.25


def test_winding_does_not_matter() -> None:
    mesh, pose = make_bracket(), draw_pose(5)
    turned = np.random.default_rng(1).random(len(mesh.faces)) < 0.5
    mixed = Mesh(mesh.vertices, np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces))
    rims = [find_rim(of, RIG[0], pose) for of in (mesh, mixed)]
    pixels = [np.sort(rim.pixels.round(6), axis=0) for rim in rims if rim is not None]
    np.testing.assert_allclose(pixels[0], pixels[1])


def test_no_rim_out_of_view() -> None:
    mesh = make_bracket()
    for shift in ([0, 0, 50.0], [0, 50.0, 0]):
        assert find_rim(mesh, RIG[0], RigidTransform.from_translation(-np.array(shift))) is None


@pytest.mark.parametrize("camera", [RIG[0], BENT], ids=["pinhole", "bent lens"])
@pytest.mark.parametrize("depth", [1e-2, 1e-4, 1e-7])
def test_no_rim_of_a_mesh_that_touches_the_camera(camera: Camera, depth: float) -> None:
    """A vertex next to the camera's plane would be billions of pixels away, along edges of as many points."""
    corners = np.array([[1.0, 0.0, depth], [0.2, 0.3, 1.5], [-0.3, 0.1, 3.0], [0.1, -0.3, 2.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    mesh = Mesh(camera.camera_from_world.inv().apply(corners), faces)
    assert find_rim(mesh, camera, RigidTransform.identity()) is None
    assert draw_mask(mesh, camera, mesh.vertices).shape == camera.size[::-1]


def test_masks_are_those_of_renderings() -> None:
    for mesh in (make_bracket(), make_vase()):
        for seed in range(4):
            pose = draw_pose(seed)
            drawn = draw_mask(mesh, RIG[1], pose.apply(mesh.vertices))
            np.testing.assert_array_equal(drawn, render_mesh(mesh, RIG[1], pose).mask)


def test_edges_of_a_cube() -> None:
    cube = make_cube()
    assert len(cube.edges) == 18  # 12, and a diagonal of each side
    assert (cube.edges >= 0).all()
    opened = Mesh(cube.vertices, cube.faces[1:])
    assert np.count_nonzero(opened.edges[:, 3] < 0) == 3
