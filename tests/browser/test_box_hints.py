"""Epipolar bands and suggested boxes, against independently computed projections."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.browser.box_hints import compute_box_hints, compute_epipolar_band
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, Rig, make_look_at_camera
from sylpose.simulate import compute_demo_truth, dome, make_demo_scene

DISTORTION = np.array([-0.28, 0.09, 0.001, -0.002, -0.01])
FISHEYE = np.array([0.03, -0.02, 0.004, -0.001])
LENSES = ("straight", "bent", "fisheye")


def with_lens(camera: Camera, lens: str) -> Camera:
    if lens == "fisheye":
        return replace(camera, distortion=FISHEYE, lens="fisheye")
    return replace(camera, distortion=DISTORTION if lens == "bent" else np.zeros(5))


def rig_of(lens: str) -> Rig:
    return Rig([with_lens(camera, lens) for camera in dome(4)])


def project_points(camera: Camera, points: FloatArray) -> FloatArray:
    """Project world points (n, 3) to pixels (n, 2) by OpenCV's documented lens models; NaN where `DISTORTION` folds."""
    x, y, z = (camera.camera_from_world.rotation.apply(points) + camera.camera_from_world.translation).T
    x, y = x / z, y / z
    d = camera.distortion
    x[(z <= 0) | (x**2 + y**2 > 4)] = np.nan
    r2 = x**2 + y**2
    if camera.lens == "fisheye":
        r = np.sqrt(r2)
        angle = np.arctan(r)
        bent = angle * (1 + d[0] * angle**2 + d[1] * angle**4 + d[2] * angle**6 + d[3] * angle**8)
        x, y = x * bent / r, y * bent / r
    else:
        radial = 1 + d[0] * r2 + d[1] * r2**2 + d[4] * r2**3
        x, y = (
            x * radial + 2 * d[2] * x * y + d[3] * (r2 + 2 * x**2),
            y * radial + d[2] * (r2 + 2 * y**2) + 2 * d[3] * x * y,
        )
    fx, fy, cx, cy = camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    return np.column_stack([fx * x + cx, fy * y + cy])


def epipolar_curve(other: Camera, pixel: FloatArray, camera: Camera) -> FloatArray:
    """Return the curve of a pixel: that of the center of a box of one pixel."""
    return compute_epipolar_band(other, Box(float(pixel[0]), float(pixel[1]), 1.0, 1.0), camera).center_curve


def is_inside(camera: Camera, pixels: FloatArray) -> bool:
    return bool(((pixels > 0) & (pixels < np.array(camera.size) - 1)).all())


def distance(line: FloatArray, point: FloatArray) -> float:
    """Return the distance of a point from a polyline (n, 2)."""
    a, b = line[:-1], line[1:]
    share = np.clip(((point - a) * (b - a)).sum(axis=1) / ((b - a) ** 2).sum(axis=1), 0, 1)
    return float(np.linalg.norm(a + share[:, None] * (b - a) - point, axis=1).min())


def signed_distance(outline: FloatArray, point: FloatArray) -> float:
    """Return the signed distance of a point from a polygon's outline, positive inside."""
    return float(cv2.pointPolygonTest(outline.astype(np.float32), (float(point[0]), float(point[1])), True))


@pytest.mark.parametrize("lens", LENSES)
def test_point_lies_on_its_epipolar_curve(lens: str) -> None:
    rig, rng = rig_of(lens), np.random.default_rng(1)
    off, bent = [], []
    for _ in range(60):
        a, b = (rig.cameras[c] for c in rng.choice(4, 2, replace=False))
        point = rng.uniform(-0.4, 0.4, (1, 3))
        (in_a,), (in_b,) = project_points(a, point), project_points(b, point)
        if not is_inside(a, in_a) or not is_inside(b, in_b):
            continue
        curve = epipolar_curve(a, in_a, b)
        off.append(distance(curve, in_b))
        visible = curve[((curve > 0) & (curve < np.array(b.size) - 1)).all(axis=1)]
        bent.append(max(distance(visible[[0, -1]], pixel) for pixel in visible))
    assert len(off) > 30
    assert max(off) < 0.05
    # Deviation of the curves from straight lines: the error without the lens model.
    assert (max(bent) < 0.01) if lens == "straight" else (np.median(bent) > 2)


def test_curve_runs_from_near_to_far() -> None:
    rig = rig_of("bent")
    a, b = rig.cameras[:2]
    pixel = project_points(a, np.zeros((1, 3)))[0]
    curve = epipolar_curve(a, pixel, b)
    ray = a.rays(pixel[None])[0]
    places = [
        int(np.argmin(np.linalg.norm(curve - project_points(b, (a.center + s * ray)[None]), axis=1)))
        for s in (0.8, 1.2, 3)
    ]
    assert places == sorted(places)
    assert places[0] < places[2]


@pytest.mark.parametrize("lens", LENSES)
def test_band_contains_the_box_content_and_little_else(lens: str) -> None:
    rig, rng = rig_of(lens), np.random.default_rng(2)
    a, checked, outside = rig.cameras[0], 0, []
    for _ in range(12):
        low, size = project_points(a, rng.uniform(-0.2, 0.2, (1, 3)))[0] - 40, rng.uniform(40, 110, 2)
        box = Box(*low, *size)
        pixels = low + rng.uniform(0, 1, (40, 2)) * (size - 1)
        points = a.center + a.rays(pixels) * rng.uniform(0.4, 4, (40, 1))
        for b in rig.cameras[1:]:
            band = compute_epipolar_band(a, box, b)
            for pixel in project_points(b, points):
                if is_inside(b, pixel):
                    assert signed_distance(band.outline, pixel) > -0.5
                    checked += 1
            # Corners of a box enlarged by 20 pixels on each side, at a distance at which this camera sees them.
            corners = low - 20 + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (size + 40 - 1)
            around = project_points(b, a.center + a.rays(corners) * np.linalg.norm(a.center))
            if is_inside(b, around):
                outside.append(min(signed_distance(band.outline, pixel) for pixel in around))
    assert checked > 300
    assert len(outside) > 10
    assert max(outside) < -5


def test_band_is_empty_in_degenerate_cases() -> None:
    a, b = dome(2).cameras
    twin = replace(a, name="twin", camera_from_world=a.camera_from_world)
    band = compute_epipolar_band(a, Box(100, 100, 50, 50), twin)
    assert len(band.outline) == len(band.center_curve) == 0
    # A camera inside the other one's box: the object may be in any direction.
    before = make_look_at_camera("before", 0.5 * a.center, b.center, 800, a.size)
    pixel = a.project(before.center)[0]
    assert len(compute_epipolar_band(a, Box(pixel[0] - 20, pixel[1] - 20, 40, 40), before).outline) == 0
    # A camera that looks away from the ray.
    turned = Rotation.from_euler("y", 180, degrees=True) * a.camera_from_world.rotation
    pose = type(a.camera_from_world).from_components(-turned.apply(a.center + np.array([0.5, 0, 0])), turned)
    away = replace(a, name="away", camera_from_world=pose)
    band = compute_epipolar_band(a, Box(600, 400, 50, 50), away)
    assert len(band.center_curve) == 0


def test_two_boxes_suggest_boxes_in_other_cameras() -> None:
    scene = make_demo_scene(frames=2, angle_deg=10, size=(640, 480), n_cameras=4)
    truth = {name: Box(*box) for name, box in compute_demo_truth(scene).boxes.items()}
    assert compute_box_hints(scene.rig, {}).boxes == compute_box_hints(scene.rig, {"cam_0": truth["cam_0"]}).boxes == {}
    found = compute_box_hints(scene.rig, {name: truth[name] for name in ("cam_0", "cam_2")})
    assert found.error == ""
    assert set(found.boxes) == {"cam_1", "cam_3"}
    assert set(found.bands["cam_1"]) == {"cam_0", "cam_2"}
    for name, box in found.boxes.items():
        its = truth[name]
        # Contains the whole object, to within the grid spacing, and little more.
        assert box.x < its.x + 0.03 * its.width
        assert box.y < its.y + 0.03 * its.height
        assert box.x + box.width > its.x + 0.97 * its.width
        assert box.y + box.height > its.y + 0.97 * its.height
        assert 1.0 < box.width * box.height / (its.width * its.height) < 2.6
        assert all(value == int(value) for value in (box.x, box.y, box.width, box.height))


def test_boxes_that_do_not_intersect_are_reported() -> None:
    scene = make_demo_scene(frames=2, angle_deg=10, size=(640, 480), n_cameras=3)
    found = compute_box_hints(scene.rig, {"cam_0": Box(300, 5, 40, 40), "cam_1": Box(300, 430, 40, 40)})
    assert "the boxes of cam_0, cam_1 do not intersect in space" in found.error
    assert found.boxes == {}
    assert set(found.bands["cam_2"]) == {"cam_0", "cam_1"}
