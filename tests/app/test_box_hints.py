"""What boxes tell of the object in the other cameras, against projections that are computed otherwise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.app.box_hints import epipolar_band, epipolar_curve, hints
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, Rig, camera_at
from sylpose.simulate import demo_scene, demo_truth, dome

BENT = np.array([-0.28, 0.09, 0.001, -0.002, -0.01])
FISHEYE = np.array([0.03, -0.02, 0.004, -0.001])
LENSES = ("straight", "bent", "fisheye")


def with_lens(camera: Camera, lens: str) -> Camera:
    if lens == "fisheye":
        return replace(camera, distortion=FISHEYE, lens="fisheye")
    return replace(camera, distortion=BENT if lens == "bent" else np.zeros(5))


def rig_of(lens: str) -> Rig:
    return Rig([with_lens(camera, lens) for camera in dome(4)])


def seen(camera: Camera, points: FloatArray) -> FloatArray:
    """(n, 2) pixels of world points (n, 3): OpenCV's two lens models as its documentation has them, written out; NaN where
    `BENT` folds back."""
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


def inside(camera: Camera, pixels: FloatArray) -> bool:
    return bool(((pixels > 0) & (pixels < np.array(camera.size) - 1)).all())


def distance(line: FloatArray, point: FloatArray) -> float:
    """Of a point from a line through points (n, 2)."""
    a, b = line[:-1], line[1:]
    share = np.clip(((point - a) * (b - a)).sum(axis=1) / ((b - a) ** 2).sum(axis=1), 0, 1)
    return float(np.linalg.norm(a + share[:, None] * (b - a) - point, axis=1).min())


def depth_in(outline: FloatArray, point: FloatArray) -> float:
    """How far a point is inside of a polygon; negative outside."""
    return float(cv2.pointPolygonTest(outline.astype(np.float32), (float(point[0]), float(point[1])), True))


@pytest.mark.parametrize("lens", LENSES)
def test_a_point_is_on_the_curve_of_its_own_pixel(lens: str) -> None:
    rig, rng = rig_of(lens), np.random.default_rng(1)
    off, bent = [], []
    for _ in range(60):
        a, b = (rig.cameras[c] for c in rng.choice(4, 2, replace=False))
        point = rng.uniform(-0.4, 0.4, (1, 3))
        (in_a,), (in_b,) = seen(a, point), seen(b, point)
        if not inside(a, in_a) or not inside(b, in_b):
            continue
        curve = epipolar_curve(a, in_a, b)
        off.append(distance(curve, in_b))
        visible = curve[((curve > 0) & (curve < np.array(b.size) - 1)).all(axis=1)]
        bent.append(max(distance(visible[[0, -1]], pixel) for pixel in visible))
    assert len(off) > 30
    assert max(off) < 0.05
    # By how much curves are no lines: what would be missed without the lens.
    assert (max(bent) < 0.01) if lens == "straight" else (np.median(bent) > 2)


def test_a_curve_goes_from_near_to_far() -> None:
    rig = rig_of("bent")
    a, b = rig.cameras[:2]
    pixel = seen(a, np.zeros((1, 3)))[0]
    curve = epipolar_curve(a, pixel, b)
    ray = a.rays(pixel[None])[0]
    places = [
        int(np.argmin(np.linalg.norm(curve - seen(b, (a.center + s * ray)[None]), axis=1))) for s in (0.8, 1.2, 3)
    ]
    assert places == sorted(places)
    assert places[0] < places[2]


@pytest.mark.parametrize("lens", LENSES)
def test_what_is_in_the_box_is_in_the_band_and_little_else(lens: str) -> None:
    rig, rng = rig_of(lens), np.random.default_rng(2)
    a, checked, outside = rig.cameras[0], 0, []
    for _ in range(12):
        low, size = seen(a, rng.uniform(-0.2, 0.2, (1, 3)))[0] - 40, rng.uniform(40, 110, 2)
        box = Box(*low, *size)
        pixels = low + rng.uniform(0, 1, (40, 2)) * (size - 1)
        points = a.center + a.rays(pixels) * rng.uniform(0.4, 4, (40, 1))
        for b in rig.cameras[1:]:
            band = epipolar_band(a, box, b)
            for pixel in seen(b, points):
                if inside(b, pixel):
                    assert depth_in(band.outline, pixel) > -0.5
                    checked += 1
            # The corners of a box that is wider by 20 pixels on each side, at a distance at which this camera sees them.
            corners = low - 20 + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (size + 40 - 1)
            around = seen(b, a.center + a.rays(corners) * np.linalg.norm(a.center))
            if inside(b, around):
                outside.append(min(depth_in(band.outline, pixel) for pixel in around))
    assert checked > 300
    assert len(outside) > 10
    assert max(outside) < -5


def test_no_band_where_nothing_tells() -> None:
    a, b = dome(2).cameras
    twin = replace(a, name="twin", camera_from_world=a.camera_from_world)
    band = epipolar_band(a, Box(100, 100, 50, 50), twin)
    assert len(band.outline) == len(band.middle) == 0
    # A camera that is seen by the other one, right in the middle of the box: then the object is on any side of it.
    before = camera_at("before", 0.5 * a.center, b.center, 800, a.size)
    pixel = a.project(before.center)[0]
    assert len(epipolar_band(a, Box(pixel[0] - 20, pixel[1] - 20, 40, 40), before).outline) == 0
    # One that looks away from all of it.
    turned = Rotation.from_euler("y", 180, degrees=True) * a.camera_from_world.rotation
    pose = type(a.camera_from_world).from_components(-turned.apply(a.center + np.array([0.5, 0, 0])), turned)
    away = replace(a, name="away", camera_from_world=pose)
    band = epipolar_band(a, Box(600, 400, 50, 50), away)
    assert len(band.middle) == 0


def test_two_boxes_suggest_the_others() -> None:
    scene = demo_scene(frames=2, turn_deg=10, size=(640, 480), n_cameras=4)
    truth = {name: Box(*box) for name, box in demo_truth(scene).boxes.items()}
    assert hints(scene.rig, {}).boxes == hints(scene.rig, {"cam_0": truth["cam_0"]}).boxes == {}
    found = hints(scene.rig, {name: truth[name] for name in ("cam_0", "cam_2")})
    assert found.wrong == ""
    assert set(found.boxes) == {"cam_1", "cam_3"}
    assert set(found.bands["cam_1"]) == {"cam_0", "cam_2"}
    for name, box in found.boxes.items():
        its = truth[name]
        # All of the object, to the grid's spacing, and not much more.
        assert box.x < its.x + 0.03 * its.width
        assert box.y < its.y + 0.03 * its.height
        assert box.x + box.width > its.x + 0.97 * its.width
        assert box.y + box.height > its.y + 0.97 * its.height
        assert 1.0 < box.width * box.height / (its.width * its.height) < 2.6
        assert all(value == int(value) for value in (box.x, box.y, box.width, box.height))


def test_boxes_of_different_things_are_said() -> None:
    scene = demo_scene(frames=2, turn_deg=10, size=(640, 480), n_cameras=3)
    found = hints(scene.rig, {"cam_0": Box(300, 5, 40, 40), "cam_1": Box(300, 430, 40, 40)})
    assert "no place in space is inside the boxes of cam_0, cam_1" in found.wrong
    assert found.boxes == {}
    assert set(found.bands["cam_2"]) == {"cam_0", "cam_1"}
