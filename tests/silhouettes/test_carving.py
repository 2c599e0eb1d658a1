"""Visual hull: exact bodies from exact silhouettes, in any world; wrong silhouettes; bad input; rendering."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import FrameSet, carve_object
from sylpose.rig import Rig
from sylpose.runs.scan import Scan
from sylpose.silhouettes.background import Silhouette
from sylpose.silhouettes.carving import CarvedObject, _compare_silhouette
from sylpose.silhouettes.rendering import render_mesh
from sylpose.silhouettes.visual_hull import View, measure_outline_distances
from sylpose.simulate import arc
from tests.test_mesh import make_cube

pytest.importorskip("skimage")

RIG = arc(3, 50, 1.5, 500, (240, 180), height=0.4)
RADIUS = 0.2


@cache
def turned(n: int = 12) -> RigidTransform:
    """Return poses (n,) that show all sides."""
    rotation = Rotation.from_rotvec(np.linspace(0, 2 * np.pi, n, endpoint=False)[:, None] * [[0.6, 0.7, 0.4]])
    return RigidTransform.from_components(0.02 * np.cos(np.arange(3 * n).reshape(n, 3)), rotation)


def sphere_frames(rig: Rig, poses: RigidTransform) -> list[FrameSet]:
    """Return frames with exact masks of a sphere about the object's origin."""
    frames = []
    for k, place in enumerate(poses.translation):
        masks = []
        for camera in rig:
            u, v = np.meshgrid(np.arange(float(camera.size[0])), np.arange(float(camera.size[1])))
            rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
            to_place = place - camera.center
            miss = np.linalg.norm(np.cross(rays, to_place), axis=1)
            masks.append((miss < RADIUS).reshape(u.shape))
        frames.append(FrameSet.of([np.full((*mask.shape, 3), 90, np.uint8) for mask in masks], float(k), masks))
    return frames


@cache
def carved_sphere() -> CarvedObject:
    return carve_object(RIG, sphere_frames(RIG, turned()), turned())


def test_sphere_from_exact_silhouettes() -> None:
    found = carved_sphere()
    errors = np.abs(np.linalg.norm(found.mesh.vertices, axis=1) - RADIUS)
    # The target: 0.5 % of the size; and nowhere more than the grid and a pixel (2.5 mm) together.
    assert np.median(errors) < 0.005 * 2 * RADIUS
    assert errors.max() < found.spacing + 1.2 * 1.5 / 500 * 3
    assert found.used.all()
    assert not found.contradicting.any()
    assert found.agreement.min() > 0.97
    assert not found.unknown_outline.any()
    assert np.isnan(found.noise).all()
    volume = np.einsum("ij,ij->", found.mesh.vertices[found.mesh.faces[:, 0]], found.mesh.face_normals) / 6
    assert volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)  # positive: faces look outwards
    assert found.mesh.colors is not None
    assert np.median(found.mesh.colors) == 90


def check_sphere(found: CarvedObject) -> None:
    errors = np.abs(np.linalg.norm(found.mesh.vertices, axis=1) - RADIUS)
    assert np.median(errors) < 0.005 * 2 * RADIUS


def test_shape_does_not_depend_on_the_world() -> None:
    """The world moves: with it cameras and poses, and neither images nor the object."""
    new_from_world = RigidTransform.from_components([0.3, -2.0, 1.1], Rotation.from_rotvec([0.4, -1.0, 2.0]))
    moved = Rig([replace(c, camera_from_world=c.camera_from_world * new_from_world.inv()) for c in RIG])
    found = carve_object(moved, sphere_frames(RIG, turned()), new_from_world * turned())
    np.testing.assert_allclose(found.mesh.vertices, carved_sphere().mesh.vertices, atol=1e-4)


def test_single_wrong_silhouettes_are_not_used() -> None:
    frames = sphere_frames(RIG, turned())
    masks = list(frames[4].masks)
    elsewhere = np.zeros((180, 240), bool)
    elsewhere[:20, :20] = True
    masks[1] = elsewhere
    frames[4] = replace(frames[4], masks=tuple(masks))
    found = carve_object(RIG, frames, turned())
    assert np.argwhere(found.contradicting).tolist() == [[4, 1]]
    check_sphere(found)


def test_images_with_an_empty_mask_do_not_show_the_object() -> None:
    frames = sphere_frames(RIG, turned())
    empty = np.zeros((180, 240), bool)
    for k in (2, 3, 7):
        frames[k] = replace(frames[k], masks=(empty, *frames[k].masks[1:]))
    found = carve_object(RIG, frames, turned())
    assert np.argwhere(~found.used).tolist() == [[2, 0], [3, 0], [7, 0]]
    assert not found.contradicting.any()
    check_sphere(found)
    with pytest.raises(ValueError, match="no image shows the object"):
        carve_object(RIG, [replace(frame, masks=(empty,) * 3) for frame in frames], turned())


def test_cameras_that_face_away_do_not_count() -> None:
    """They are most of the cameras; the masks in their images are of something else."""
    half_turn = RigidTransform.from_rotation(Rotation.from_rotvec([0, np.pi, 0]))
    away = [
        replace(camera, name=f"away_{n}", camera_from_world=half_turn * camera.camera_from_world)
        for n, camera in enumerate([*RIG, RIG[0]])
    ]
    rig = Rig([*RIG, *away])
    found = carve_object(rig, sphere_frames(rig, turned()), turned())
    assert found.used[:, :3].all()
    assert not found.used[:, 3:].any()
    assert not found.contradicting.any()
    check_sphere(found)


def test_few_images_without_a_mask_are_not_used_and_counted() -> None:
    frames = sphere_frames(RIG, turned())
    frames[6:] = [replace(frame, masks=(None, *frame.masks[1:])) for frame in frames[6:]]
    found = carve_object(RIG, frames, turned())
    assert np.argwhere(~found.used).tolist() == [[k, 0] for k in range(6, 12)]
    check_sphere(found)
    assert Scan(found, RIG, frames, turned()).warnings == ["Camera cam_0: 6 images without a mask are not used."]


def test_nothing_bounds_an_object_that_fills_the_image() -> None:
    width, height = RIG[0].size
    everywhere = Silhouette.from_mask(np.ones((height, width), bool))
    view = View(RIG[0], measure_outline_distances(everywhere))
    assert _compare_silhouette(make_cube(1.2), view, everywhere) == (1.0, 1.0)


def test_poses_that_are_not_those_of_the_silhouettes_are_refused() -> None:
    frames = sphere_frames(RIG, turned())
    aside = np.where(np.arange(12)[:, None] % 2, 0.3, -0.3) * [[1.0, 0.0, 0.0]]
    wrong = RigidTransform.from_components(turned().translation + aside, turned().rotation)
    with pytest.raises(ValueError, match="silhouettes"):
        carve_object(RIG, frames, wrong)


@pytest.mark.parametrize(
    ("n_poses", "with_masks", "message"),
    [
        (11, True, "world_from_object must be one pose for each of the 12 frames"),
        (12, False, "camera cam_0: 12 images without masks, of at least 15"),
    ],
)
def test_bad_input_is_refused(n_poses: int, with_masks: bool, message: str) -> None:
    frames = sphere_frames(RIG, turned())
    if not with_masks:
        frames = [FrameSet.of(frame.images, frame.time) for frame in frames]
    with pytest.raises(ValueError, match=message):
        carve_object(RIG, frames, turned()[:n_poses])


def test_rendering_of_a_cube() -> None:
    """The mask is the convex outline of the corners, up to the pixels of the border; depths are those of the front."""
    cube, camera = make_cube(0.3), RIG[0]
    pose = RigidTransform.from_rotation(Rotation.from_rotvec([0.3, 0.5, -0.2]))
    found = render_mesh(cube, camera, pose)
    outline = cv2.convexHull(camera.project(pose.apply(cube.vertices)).astype(np.float32))
    expected = np.zeros(found.mask.shape, np.uint8)
    cv2.fillConvexPoly(expected, np.rint(outline * 256).astype(np.int32), (1,), cv2.LINE_8, 8)
    border = cv2.dilate(expected, np.ones((3, 3), np.uint8)) - cv2.erode(expected, np.ones((3, 3), np.uint8))
    assert not ((found.mask != (expected > 0)) & (border == 0)).any()
    rows, columns = np.nonzero(found.mask & (border == 0))
    rays = camera.rays(np.column_stack([columns, rows]))
    depth = 1 / found.inverse_depth[rows, columns]
    points = camera.center + rays * (depth / (rays @ camera.direction))[:, None]
    in_cube = np.abs(pose.inv().apply(points))
    np.testing.assert_allclose(in_cube.max(axis=1), 0.15, atol=1e-5)
    towards = np.einsum("ni,ni->n", pose.rotation.apply(cube.face_normals[found.face[rows, columns]]), rays)
    assert (towards < 0).all()
