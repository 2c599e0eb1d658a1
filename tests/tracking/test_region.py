"""Object region: the volume inside the boxes, and its outline in each image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, Rig, make_look_at_camera
from sylpose.simulate import arc, ring
from sylpose.tracking.camera_side.frame import project_outline, rasterize_outline
from sylpose.tracking.joint_side.object_model import carve_box_volume

CORNERS = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3) / 2.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    return ring(4, 1.5, 1000.0, height=(0.4, -0.1, 0.2, 0.5), distortion=(-0.1, 0.02, 0.0, 0.0))


def make_boxes(rig: Rig, points: FloatArray) -> dict[str, Box]:
    """Tight boxes around points, clipped to the images."""
    boxes = {}
    for camera in rig:
        pixels = camera.project(points)
        low = np.maximum(np.floor(pixels.min(axis=0)), 0).astype(int)
        high = np.minimum(np.ceil(pixels.max(axis=0)) + 1, camera.size).astype(int)
        boxes[camera.name] = Box(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
    return boxes


def make_block(sides: tuple[float, float, float], at: tuple[float, float, float], turn: float = 0.4) -> FloatArray:
    pose = RigidTransform.from_components(at, Rotation.from_rotvec([turn, -turn / 2, turn / 3]))
    return np.asarray(pose.apply(CORNERS * np.array(sides)))


def covers(points: FloatArray, corners: FloatArray, slack: float) -> bool:
    """Return whether the cloud's extent covers the corners in all tested directions, within `slack`."""
    directions = np.random.default_rng(0).standard_normal((200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return bool(((points @ directions.T).max(axis=0) + slack >= (corners @ directions.T).max(axis=0)).all())


# --- visual hull of the boxes


@settings(max_examples=20, deadline=None)
@given(
    sides=st.tuples(*[st.floats(0.08, 0.3)] * 3),
    at=st.tuples(*[st.floats(-0.1, 0.1)] * 3),
    turn=st.floats(-1.5, 1.5),
    n=st.integers(2, 5),
)
def test_hull_contains_object(
    sides: tuple[float, float, float], at: tuple[float, float, float], turn: float, n: int
) -> None:
    rig = ring(n, 1.5, 1000.0, height=0.3) if n > 2 else arc(2, 70, 1.5, 1000.0, height=0.3)
    corners = make_block(sides, at, turn)
    center, points = carve_box_volume(rig, make_boxes(rig, corners))
    # The grid spacing is a twentieth of its extent.
    assert covers(points, corners, 0.12 * max(sides))
    assert np.linalg.norm(center - np.array(at)) < 0.35 * max(sides)


@pytest.mark.parametrize("long_axis", [0, 1, 2])
def test_hull_contains_long_object_seen_end_on(long_axis: int) -> None:
    rig = arc(3, 90, 1.5, 1000.0)  # cam_1 looks along z, the others along x
    sides = [0.06, 0.06, 0.06]
    sides[long_axis] = 0.5
    corners = make_block((sides[0], sides[1], sides[2]), (0, 0, 0), turn=0)
    center, points = carve_box_volume(rig, make_boxes(rig, corners))
    assert covers(points, corners, 0.06)
    assert np.linalg.norm(center) < 0.03


def test_hull_projects_into_boxes(rig: Rig) -> None:
    boxes = make_boxes(rig, make_block((0.2, 0.3, 0.15), (0.05, 0, -0.05)))
    _, points = carve_box_volume(rig, boxes)
    for name, box in boxes.items():
        pixels = rig[name].project(points)
        slack = 0.04 * max(box.width, box.height)
        assert (pixels > [box.x - slack, box.y - slack]).all()
        assert (pixels < [box.x + box.width + slack, box.y + box.height + slack]).all()


def test_center_is_intersection_of_box_centers(rig: Rig) -> None:
    at = np.array([0.04, -0.06, 0.02])
    boxes = {}
    for camera in rig:
        u, v = camera.project(at)[0]
        boxes[camera.name] = Box(round(u) - 40, round(v) - 30, 81, 61)
    center, _ = carve_box_volume(rig, boxes)
    np.testing.assert_allclose(center, at, atol=2e-3)


def test_boxes_of_some_cameras_suffice(rig: Rig) -> None:
    corners = make_block((0.2, 0.3, 0.15), (0.05, 0, -0.05))
    all_boxes = make_boxes(rig, corners)
    center, points = carve_box_volume(rig, {name: all_boxes[name] for name in ("cam_3", "cam_1", "cam_0")})
    assert covers(points, corners, 0.04)
    assert np.linalg.norm(center - [0.05, 0, -0.05]) < 0.05


def test_single_camera_places_object_at_distance_one(rig: Rig) -> None:
    camera = rig.cameras[2]
    center, points = carve_box_volume(rig, {"cam_2": Box(600, 440, 100, 80)})
    assert np.linalg.norm(center - camera.center) == pytest.approx(1)
    middle = camera.project(center)[0]
    np.testing.assert_allclose(middle, [649.5, 479.5], atol=1e-3)
    pixels = camera.project(points)
    assert np.ptp(pixels, axis=0) == pytest.approx([100, 80], rel=0.2)


def test_box_at_image_border_is_unbounded_there() -> None:
    # cam_0 sees the object's right half: its box ends where the image does.
    looks_aside = make_look_at_camera("cam_0", (0, 0, -1.5), (0.9, 0, 0), 1000.0, (1280, 960))
    rig = Rig([looks_aside, *ring(4, 1.5, 1000.0, height=0.3).cameras[1:]])
    corners = make_block((0.3, 0.2, 0.2), (0, 0, 0), turn=0)
    pixels = looks_aside.project(corners)
    assert pixels[:, 0].min() < -30
    assert pixels[:, 0].max() > 100
    boxes = make_boxes(rig, corners)
    assert boxes["cam_0"].x == 0
    _, points = carve_box_volume(rig, boxes)
    assert covers(points, corners, 0.04)


@pytest.mark.parametrize(
    "boxes",
    [
        {"cam_0": Box(0, 100, 50, 50), "cam_1": Box(600, 800, 50, 50)},
        # Rays that intersect behind the cameras.
        {"cam_0": Box(100, 450, 60, 60), "cam_1": Box(1200, 450, 60, 60)},
        {"cam_0": Box(600, 450, 60, 60), "cam_1": Box(600, 450, 60, 60), "cam_2": Box(600, 20, 60, 60)},
    ],
)
def test_disjoint_boxes_are_rejected(boxes: dict[str, Box]) -> None:
    rig = arc(4, 25, 1.5, 1000.0)
    with pytest.raises(ValueError, match=r"boxes: the boxes of cam_0, cam_1(, cam_2)? do not intersect"):
        carve_box_volume(rig, boxes)


def test_box_of_unknown_camera_is_rejected(rig: Rig) -> None:
    with pytest.raises(ValueError, match="cam_9"):
        carve_box_volume(rig, {"cam_0": Box(600, 450, 60, 60), "cam_9": Box(600, 450, 60, 60)})


# --- outlines


def test_outline_surrounds_points_with_margin(rig: Rig) -> None:
    camera, corners = rig.cameras[1], make_block((0.2, 0.3, 0.15), (0.05, 0, -0.05))
    pixels = camera.project(corners)
    for growth in (0.1, 0.5):
        outline = project_outline(camera, corners, growth)
        assert outline is not None
        margin = max(12.0, growth * float(np.ptp(pixels, axis=0).max()))
        contour = outline.astype(np.float32).reshape(-1, 1, 2)
        assert cv2.isContourConvex(contour)
        inside = [cv2.pointPolygonTest(contour, (float(u), float(v)), True) for u, v in pixels]
        # The margin is an octagon, narrower than its circle between the corners.
        assert min(inside) > 0.9 * margin
        assert min(inside) < 1.1 * margin


def test_small_object_has_margin_of_twelve_pixels(rig: Rig) -> None:
    outline = project_outline(rig.cameras[0], make_block((0.01, 0.01, 0.01), (0, 0, 0)), 0.1)
    assert outline is not None
    assert (np.ptp(outline, axis=0) > 24).all()
    assert (np.ptp(outline, axis=0) < 40).all()


@pytest.mark.parametrize("at", [(5.0, 0.0, 0.0), (1.35, 0.0, 0.0), (0.0, 5.0, 0.0), (0.0, 0.0, -5.0)])
def test_no_outline_out_of_view(at: tuple[float, float, float]) -> None:
    camera = make_look_at_camera("cam_0", (0, 0, -1.5), (0, 0, 0), 1000.0, (1280, 960), (-0.3, 0.1, 0, 0))
    assert project_outline(camera, make_block((0.1, 0.1, 0.1), at), 0.15) is None


def test_partly_visible_object_has_outline() -> None:
    camera = make_look_at_camera("cam_0", (0, 0, -1.5), (0, 0, 0), 1000.0, (1280, 960))
    at_the_rim = (1.5 * 0.64, 0.0, 0.0)
    outline = project_outline(camera, make_block((0.2, 0.2, 0.2), at_the_rim), 0.15)
    assert outline is not None
    assert rasterize_outline(outline, camera.size)[:, -1].any()


# --- masks


def test_mask_is_true_inside_outline() -> None:
    outline = np.array([[10.2, 5.1], [30.4, 8.0], [25.0, 28.7], [12.0, 20.0]])
    mask = rasterize_outline(outline, (40, 30))
    assert mask.shape == (30, 40)
    assert mask.dtype == np.bool_
    for v, u in np.argwhere(mask | ~mask):
        distance = cv2.pointPolygonTest(outline.astype(np.float32), (float(u), float(v)), True)
        if abs(distance) > 1.5:
            assert mask[v, u] == (distance > 0)


def test_mask_is_clipped_to_image() -> None:
    mask = rasterize_outline(np.array([[-50.0, -40.0], [20.0, -40.0], [20.0, 10.0], [-50.0, 10.0]]), (64, 48))
    assert mask[:11, :21].all()
    assert mask.sum() == 11 * 21
    assert not rasterize_outline(np.array([[-50.0, -40.0], [-20.0, -40.0], [-20.0, -10.0]]), (64, 48)).any()


def test_region_and_mask_agree(rig: Rig) -> None:
    corners = make_block((0.2, 0.3, 0.15), (0.05, 0, -0.05))
    for camera in rig:
        outline = project_outline(camera, corners, 0.15)
        assert outline is not None
        mask = rasterize_outline(outline, camera.size)
        column, row = np.round(camera.project(corners)).astype(int).T
        assert mask[row, column].all()
        assert 0 < mask.mean() < 0.5


def test_camera_without_view_of_boxes(rig: Rig) -> None:
    away = Camera(
        "away", (640, 480), rig.cameras[0].matrix, np.empty(0), RigidTransform.from_translation([0.0, 0.0, -30.0])
    )
    wide = Rig([*rig.cameras, away])
    boxes = make_boxes(rig, make_block((0.2, 0.2, 0.2), (0, 0, 0)))
    center, points = carve_box_volume(wide, boxes)
    assert project_outline(away, points, 0.15) is None
    assert np.linalg.norm(center) < 0.05
