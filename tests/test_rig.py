"""Cameras and rigs, against OpenCV and by definition."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.rig import GRID_PX, Camera, LensModel, Rig, intersect_rays

MATRIX = np.array([[800.0, 0, 330], [0, 790, 235], [0, 0, 1]])
POSE = RigidTransform.from_components([0.1, -0.2, 3.0], Rotation.from_rotvec([0.4, -0.7, 0.3]))
# Coefficients of every lens model, of realistic size: the recordings' and a typical tilted sensor.
LENSES: dict[str, tuple[LensModel, list[float]]] = {
    "none": ("opencv", []),
    "4 terms": ("opencv", [-0.34, 0.1, -0.001, 0.003]),
    "5 terms": ("opencv", [0.19, -0.26, 0.003, -0.005, 0.11]),
    "8 terms": ("opencv", [0.3, -0.1, 0.001, 0.002, 0.05, 0.5, -0.05, 0.01]),
    "12 terms": ("opencv", [-0.2, 0.05, 0.001, 0.002, 0.01, 0.02, 0.01, 0.0, 0.002, -0.001, 0.001, 0.002]),
    "14 terms": ("opencv", [-0.2, 0.05, 0.001, 0.002, 0.01, 0.02, 0.01, 0.0, 0.002, -0.001, 0.001, 0.002, 0.02, -0.01]),
    "fisheye": ("fisheye", [0.05, -0.01, 0.004, -0.001]),
}


def camera(lens: str = "5 terms", name: str = "cam_0", pose: RigidTransform = POSE) -> Camera:
    model, distortion = LENSES[lens]
    return Camera(name, (640, 480), MATRIX, np.array(distortion), pose, model)


def points_in_view(cam: Camera, n: int, seed: int = 0) -> FloatArray:
    """Return (n, 3) world points that project into the image."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.5, 5, (n, 1))
    points_c = np.hstack([rng.uniform(-0.38, 0.38, (n, 1)), rng.uniform(-0.28, 0.28, (n, 1)), np.ones((n, 1))]) * z
    return np.ascontiguousarray(cam.camera_from_world.inv().apply(points_c))


@pytest.mark.parametrize("lens", LENSES)
def test_project_matches_opencv(lens: str) -> None:
    cam = camera(lens)
    points = points_in_view(cam, 50)
    rvec, tvec = POSE.rotation.as_rotvec(), POSE.translation
    if cam.lens == "fisheye":
        expected, _ = cv2.fisheye.projectPoints(points.reshape(-1, 1, 3), rvec, tvec, MATRIX, cam.distortion)
    else:
        expected, _ = cv2.projectPoints(points, rvec, tvec, MATRIX, cam.distortion)
    np.testing.assert_allclose(cam.project(points), expected.reshape(-1, 2), atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_project_matches_formula(lens: str) -> None:
    # Without a lens the projection is K (R X + t); with one it must differ.
    cam = camera(lens)
    points = points_in_view(cam, 20)
    points_c = points @ cam.rotation.T + cam.camera_from_world.translation
    pinhole = (points_c / points_c[:, 2:]) @ MATRIX.T
    assert np.allclose(cam.project(points), pinhole[:, :2], atol=1e-9) == (lens == "none")


@pytest.mark.parametrize("lens", LENSES)
@settings(max_examples=60, deadline=None)
@given(u=st.floats(0, 639), v=st.floats(0, 479))
def test_normalize_and_denormalize_are_inverse(lens: str, u: float, v: float) -> None:
    cam = camera(lens)
    pixels = np.array([[u, v]])
    # OpenCV's fisheye undistortion stops at its own tolerance of 1e-8 in the angle.
    np.testing.assert_allclose(cam.denormalize(cam.normalize(pixels)), pixels, atol=1e-4)
    normalized = np.array([[(u - 320) / 900, (v - 240) / 900]])
    np.testing.assert_allclose(cam.normalize(cam.denormalize(normalized)), normalized, atol=1e-7)


@pytest.mark.parametrize("lens", LENSES)
def test_rays_pass_through_projected_points(lens: str) -> None:
    cam = camera(lens)
    points = points_in_view(cam, 30)
    rays = cam.rays(cam.project(points))
    toward = points - cam.center
    np.testing.assert_allclose(rays, toward / np.linalg.norm(toward, axis=1, keepdims=True), atol=1e-7)


def test_non_contiguous_arrays() -> None:
    # cv2.fisheye of OpenCV 5 treats a non-contiguous array as a contiguous one.
    cam = camera("fisheye")
    pixels = np.random.default_rng(0).uniform(50, 400, (20, 4))
    np.testing.assert_array_equal(cam.normalize(pixels[:, :2]), cam.normalize(pixels[:, :2].copy()))
    normalized = (pixels - 240) / 800
    np.testing.assert_array_equal(cam.denormalize(normalized[:, :2]), cam.denormalize(normalized[:, :2].copy()))


def test_points_not_in_front_are_nan() -> None:
    cam = camera(pose=RigidTransform.identity())
    pixels = cam.project([[0, 0, 1], [0, 0, -1], [1, 0, 0]])
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1:]).all()
    assert np.isnan(cam.project([[0, 0, -1]])).all()


def test_no_points() -> None:
    for lens in LENSES:
        cam = camera(lens)
        empty = np.empty((0, 2))
        shapes = [a.shape for a in (cam.normalize(empty), cam.denormalize(empty), cam.project(np.empty((0, 3))))]
        assert shapes == [(0, 2)] * 3
        assert cam.rays(empty).shape == (0, 3)


def test_center_and_direction() -> None:
    cam = camera()
    np.testing.assert_allclose(POSE.apply(cam.center), 0, atol=1e-12)
    np.testing.assert_allclose(POSE.apply(cam.center + 2 * cam.direction), [0, 0, 2], atol=1e-12)
    assert cam.focal == pytest.approx(np.sqrt(800 * 790))


def test_arrays_are_read_only() -> None:
    cam = camera()
    with pytest.raises(ValueError, match="read-only"):
        cam.matrix[0, 0] = 1
    with pytest.raises(ValueError, match="read-only"):
        cam.distortion[0] = 1


BAD_CAMERAS: dict[str, tuple[dict[str, Any], str]] = {
    "matrix shape": ({"matrix": np.eye(2)}, "3x3, got shape"),
    "matrix nan": ({"matrix": np.full((3, 3), np.nan)}, "not finite"),
    "matrix implausible": ({"matrix": np.array([[800, 0, 1e308], [0, 800, 240], [0, 0, 1]])}, "implausible"),
    "focal implausible": ({"matrix": np.diag([1e-300, 1, 1])}, "implausible"),
    "matrix of words": ({"matrix": "K"}, "not finite numbers"),
    "size implausible": ({"size": (1e300, 1e300)}, "a side or"),
    "size huge": ({"size": (32_000, 32_000)}, "a side or"),
    "size of halves": ({"size": (640.5, 480)}, "width, height"),
    "distortion implausible": ({"distortion": np.array([0, 1e30, 0, 0])}, "term is beyond"),
    "pose implausible": ({"camera_from_world": RigidTransform.from_translation([0, 0, -1e308])}, "beyond"),
    "no pose": ({"camera_from_world": np.eye(4)}, "single transform"),
    "negative focal length": ({"matrix": np.diag([-1.0, 1, 1])}, "positive focal lengths"),
    "last row": ({"matrix": np.diag([1.0, 1, 2])}, "last row"),
    "size": ({"size": (0, 480)}, "width, height"),
    "size of one": ({"size": (640,)}, "width, height"),
    "terms": ({"distortion": np.zeros(6)}, "6 distortion terms"),
    "fisheye terms": ({"distortion": np.zeros(5), "lens": "fisheye"}, "5 distortion terms; the fisheye model"),
    "distortion inf": ({"distortion": np.array([0, 0, 0, np.inf])}, "not finite"),
    "lens": ({"lens": "mirror"}, "'opencv' or 'fisheye'"),
    "two poses": ({"camera_from_world": RigidTransform.identity(2)}, "single transform"),
    "pose nan": ({"camera_from_world": RigidTransform.from_translation([0, 0, np.nan])}, "not finite"),
}


@pytest.mark.parametrize("bad", BAD_CAMERAS)
def test_bad_camera(bad: str) -> None:
    changes, message = BAD_CAMERAS[bad]
    with pytest.raises(ValueError, match=f"camera cam_0: .*{message}"):
        replace(camera(), **changes)


@pytest.mark.parametrize(
    "name", ["", " ", ".", "..", "cam/_2", "cam\\_2", "a\0", "a\x1b[2J", "a\nb", "a\ud800", "a\u202eb", "a" * 101, None]
)
def test_unusable_names_are_rejected(name: Any) -> None:
    with pytest.raises(ValueError, match="name") as caught:
        replace(camera(), name=name)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("name", ["0", "cam_0", "left camera", "Kamera é", "カメラ", "a.b", "..a", "-"])
def test_common_names_are_accepted(name: str) -> None:
    assert replace(camera(), name=name).name == name


def test_rig() -> None:
    rig = Rig([camera(name=name) for name in ("left", "right", "top")], "mm")
    assert rig.names == ("left", "right", "top")
    assert len(rig) == 3
    assert [c.name for c in rig] == ["left", "right", "top"]
    assert rig["right"] is rig.cameras[1]
    part = rig.subset(["top", "left"])
    assert part.names == ("top", "left")
    assert part.unit == "mm"
    with pytest.raises(KeyError, match=r"no camera 'back' in the rig \(left, right, top\)"):
        rig["back"]


def test_cameras_are_selected_by_number_name_and_slice() -> None:
    rig = Rig([camera(name=name) for name in ("left", "right", "top")], "mm")
    assert (rig[0].name, rig[-1].name, rig[np.int64(1)].name) == ("left", "top", "right")
    assert (rig[:2].names, rig[::-1].names, rig[1:].unit) == (("left", "right"), ("top", "right", "left"), "mm")
    assert "top" in rig
    assert "back" not in rig
    assert rig[1] in rig
    assert 1 not in rig
    for number in (3, -4):
        with pytest.raises(IndexError, match=rf"no camera {number} in the rig of 3 \(left, right, top\)"):
            rig[number]
    with pytest.raises(IndexError, match="no camera in this slice"):
        rig[3:]
    for key in (True, 1.0, None, ("left",)):
        with pytest.raises(TypeError, match="by its name or number"):
            rig[key]  # type: ignore[index]


def test_bad_rig() -> None:
    with pytest.raises(ValueError, match="at least one camera"):
        Rig([])
    with pytest.raises(ValueError, match="two cameras of the same name"):
        Rig([camera(), camera()])


def directions(rng: np.random.Generator, n: int) -> FloatArray:
    d = rng.normal(size=(n, 3))
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 8))
def test_intersecting_rays_give_their_intersection(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    point, d = rng.normal(size=3), directions(rng, n)
    if np.linalg.svd(d)[1][1] < 0.1:
        return  # nearly parallel
    centers = point - rng.uniform(0.5, 5, (n, 1)) * d
    np.testing.assert_allclose(intersect_rays(centers, d), point, atol=1e-9)


def test_ray_intersection_minimizes_distance() -> None:
    rng = np.random.default_rng(1)
    centers, d = rng.normal(size=(5, 3)), directions(rng, 5)

    def cost(point: FloatArray) -> float:
        return float((np.cross(point - centers, d) ** 2).sum())

    best = intersect_rays(centers, d)
    assert all(cost(best) < cost(best + step) for step in 1e-3 * directions(rng, 20))


def test_parallel_rays() -> None:
    d = np.array([[0, 0, 1.0]])
    # Where the lines leave the point undetermined: from `near`, or 1 along them, or halfway between opposite lines.
    np.testing.assert_allclose(intersect_rays([[1, 2, 3]], d, near=[5, 6, 7]), [1, 2, 7], atol=1e-12)
    np.testing.assert_allclose(intersect_rays([[1, 2, 3]], d), [1, 2, 4], atol=1e-12)
    two = intersect_rays([[1, 0, 3], [-1, 0, 5]], np.concatenate([d, -d]))
    np.testing.assert_allclose(two, [0, 0, 4], atol=1e-12)


@pytest.mark.parametrize("lens", LENSES)
def test_grid_points_are_close_and_dyadic(lens: str) -> None:
    c, pixels = camera(lens), np.random.default_rng(0).uniform(50, 430, (200, 2))
    exact, found = c.normalize(pixels), c.normalize_to_grid(pixels)
    assert 0 < np.abs(found - exact).max() * c.focal <= GRID_PX / 2
    np.testing.assert_array_equal(found * 2**20, np.rint(found * 2**20))


def test_rig_in_another_unit_has_same_projections() -> None:
    rng = np.random.default_rng(8)
    poses = [RigidTransform.from_components([0.1 * k, 0.2, 3.0], Rotation.random(rng=rng)) for k in range(3)]
    matrix = np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
    rig = Rig(
        [Camera(f"cam_{k}", (640, 480), matrix, np.array([0.1, 0, 0, 0]), pose) for k, pose in enumerate(poses)], "m"
    )
    points = rng.normal(size=(20, 3))
    for unit, scale in (("mm", 1000.0), ("cm", 100.0), ("um", 1e6), ("in", 1 / 0.0254), ("ft", 1 / 0.3048), ("m", 1.0)):
        other = rig.in_unit(unit)
        assert other.unit == unit
        for old, new in zip(rig, other, strict=True):
            np.testing.assert_allclose(new.project(scale * points), old.project(points), rtol=1e-9)
        back = other.in_unit("m")
        for old, new in zip(rig, back, strict=True):
            np.testing.assert_allclose(new.camera_from_world.as_matrix(), old.camera_from_world.as_matrix(), atol=1e-12)
    new_from_world = RigidTransform.from_components([1.0, 2.0, 3.0], Rotation.random(rng=rng))
    for old, new in zip(rig, rig.in_world(new_from_world), strict=True):
        np.testing.assert_allclose(new.project(new_from_world.apply(points)), old.project(points), rtol=1e-9)
    with pytest.raises(ValueError, match="one of m, cm, mm"):
        rig.in_unit("league")
    with pytest.raises(ValueError, match="in an unknown unit"):
        Rig(rig.cameras).in_unit("mm")
    with pytest.raises(ValueError, match="new_from_world"):
        rig.in_world(RigidTransform.identity(2))
