"""Simulator: visibility, noise, outliers and motion of simulated matches and rendered sequences equal the specification."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from sylpose import simulate
from sylpose.geometry.arrays import FloatArray
from sylpose.io import calibration
from sylpose.rig import Camera, Rig
from sylpose.simulate import Body, OutlierKind, SimulatedPair

LENS = (-0.2, 0.05, 0.001, -0.001, 0.01)


def in_camera(motion: RigidTransform, camera: Camera) -> RigidTransform:
    return camera.camera_from_world * motion * camera.camera_from_world.inv()


def epipolar_distances(camera: Camera, motion: RigidTransform, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the distances (n,) of y from the epipolar lines of x (Sampson), normalized units."""
    moved = in_camera(motion, camera)
    tx, ty, tz = moved.translation
    essential = np.array([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]]) @ moved.rotation.as_matrix()
    x, y = np.column_stack([x, np.ones(len(x))]), np.column_stack([y, np.ones(len(y))])
    ex, ey = x @ essential.T, y @ essential
    scale = np.sqrt((ex[:, :2] ** 2).sum(1) + (ey[:, :2] ** 2).sum(1))
    return np.asarray(np.einsum("ni,ni->n", y, ex) / scale)


def make_pair(rig: Rig, body: Body | None = None, seed: int = 0, turn: float = 8.0, **options: Any) -> SimulatedPair:
    rng = np.random.default_rng(seed)
    motion = simulate.random_motion(turn, 0.03, rng)
    body = simulate.ellipsoid((0.15, 0.1, 0.12)) if body is None else body
    return simulate.simulate_matches(rig, body, motion, rng=rng, **options)


# --- rigs


@pytest.mark.parametrize(
    "rig",
    [
        simulate.ring(5, 2.0, 900, (640, 480), height=0.4, target=(1, 2, 3)),
        simulate.arc(3, 20, 1.0, height=(0.1, -0.2, 0.3), target=(1, 2, 3), distortion=LENS),
        simulate.dome(9, target=(1, 2, 3)),
        simulate.dome(1, lowest_deg=89.9999999999, target=(1, 2, 3)),
    ],
)
def test_rigs_look_at_the_target_and_are_upright(rig: Rig) -> None:
    assert rig.names == tuple(f"cam_{i}" for i in range(len(rig)))
    for camera in rig:
        middle = (np.array(camera.size) - 1) / 2
        np.testing.assert_allclose(camera.project([[1, 2, 3]]), [middle], atol=1e-6)
        np.testing.assert_allclose(camera.rotation[0, 1], 0, atol=1e-12)  # x is horizontal
        assert camera.rotation[1, 1] >= 0  # y points down


def test_rigs_have_the_given_distances_and_angles() -> None:
    ring = simulate.ring(4, 2.0, height=1.0)
    np.testing.assert_allclose(ring["cam_0"].center, [0, -1, -2], atol=1e-12)
    np.testing.assert_allclose(ring["cam_1"].center, [2, -1, 0], atol=1e-12)
    arc = simulate.arc(3, 30, 1.5)
    np.testing.assert_allclose(arc["cam_1"].center, [0, 0, -1.5], atol=1e-12)
    assert arc["cam_0"].direction @ arc["cam_2"].direction == pytest.approx(np.cos(np.deg2rad(60)))
    dome = simulate.dome(20, 1.5, lowest_deg=15)
    np.testing.assert_allclose([np.linalg.norm(c.center) for c in dome], 1.5)
    assert max(c.center[1] for c in dome) <= -1.5 * np.sin(np.deg2rad(15))


# --- bodies


@pytest.mark.parametrize("body", [simulate.ellipsoid((0.2, 0.1, 0.15)), simulate.box((0.3, 0.2, 0.1))])
def test_closed_bodies_have_outward_normals_and_are_centered(body: Body) -> None:
    np.testing.assert_allclose(np.linalg.norm(body.normals, axis=1), 1)
    assert (np.einsum("ni,ni->n", body.points, body.normals) > 0).all()
    np.testing.assert_allclose(body.points.mean(axis=0), 0, atol=0.01)
    np.testing.assert_allclose(body.normals.mean(axis=0), 0, atol=0.05)  # closed surface, uniform by area


def test_invalid_body_raises() -> None:
    with pytest.raises(ValueError, match=r"normals must be \(3, 3\)"):
        Body(np.zeros((3, 3)), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="finite"):
        Body(np.full((3, 3), np.nan), np.zeros((3, 3)))


# --- matches


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), turn=st.floats(0.1, 40), cameras=st.integers(1, 6))
def test_without_noise_matches_are_exact(seed: int, turn: float, cameras: int) -> None:
    rig = simulate.ring(cameras, height=0.3)
    made = make_pair(rig, seed=seed, turn=turn, noise_px=0)
    for camera, matches, depth in zip(rig, made.matches, made.depths, strict=True):
        assert len(matches) == 60
        points = np.column_stack([matches.x, np.ones(60)]) * depth[:, None]
        moved = in_camera(made.motion, camera).apply(points)
        np.testing.assert_allclose(moved[:, :2] / moved[:, 2:], matches.y, atol=1e-12)
        assert np.abs(epipolar_distances(camera, made.motion, matches.x, matches.y)).max() < 1e-12


def test_without_noise_matches_are_exact_through_a_lens() -> None:
    rig = simulate.dome(4, distortion=LENS)
    made = make_pair(rig, noise_px=0)
    for camera, matches in zip(rig, made.matches, strict=True):
        assert np.abs(epipolar_distances(camera, made.motion, matches.x, matches.y)).max() < 1e-9


def test_orthographic_matches_satisfy_the_paper_s_model_exactly() -> None:
    rig = simulate.dome(3)
    made = make_pair(rig, noise_px=0, orthographic=True)
    for camera, matches, depth in zip(rig, made.matches, made.depths, strict=True):
        scale = camera.camera_from_world.apply(made.center)[2]
        points = np.column_stack([matches.x * scale, depth])
        moved = in_camera(made.motion, camera).apply(points)
        np.testing.assert_allclose(moved[:, :2] / scale, matches.y, atol=1e-12)


def test_only_points_that_face_the_camera_in_both_frames_are_matched() -> None:
    rig, body, start = (
        simulate.ring(6, height=0.5),
        simulate.ellipsoid(),
        RigidTransform.from_translation([0.02, 0, 0.1]),
    )
    made = make_pair(rig, body, turn=50, noise_px=0, start=start)
    np.testing.assert_allclose(made.center, [0.02, 0, 0.1])
    for camera, matches, depth in zip(rig, made.matches, made.depths, strict=True):
        seen = np.column_stack([matches.x, np.ones(60)]) * depth[:, None]
        points = (start.inv() * camera.camera_from_world.inv()).apply(seen)
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.15, atol=1e-9)  # on the body's surface
        for pose in (start, made.motion * start):
            normals = pose.rotation.apply(points)
            assert (np.einsum("ni,ni->n", normals, camera.center - pose.apply(points)) > 0).all()


def test_one_sided_plane_is_visible_from_one_side() -> None:
    rig = simulate.ring(2)
    one = make_pair(rig, simulate.plane(two_sided=False), turn=1)
    both = make_pair(rig, simulate.plane(two_sided=True), turn=1)
    assert [len(m) for m in one.matches] == [60, 0]
    assert [len(m) for m in both.matches] == [60, 60]


def test_points_outside_the_image_are_not_matched() -> None:
    rig = simulate.ring(3, focal=4000)
    made = make_pair(rig, simulate.cloud((0.3, 0.3, 0.3)), noise_px=0)
    for camera, matches in zip(rig, made.matches, strict=True):
        for points in (matches.x, matches.y):
            pixels = camera.denormalize(points)
            assert (pixels >= -1e-9).all()
            assert (pixels <= np.array(camera.size) - 1 + 1e-9).all()
    few = make_pair(rig, simulate.cloud(n=20), noise_px=0)
    assert all(len(m) <= 20 for m in few.matches)


def test_noise_level_in_both_frames() -> None:
    rig = simulate.ring(4, distortion=LENS)
    noisy, clean = (make_pair(rig, per_camera=1000, noise_px=sigma) for sigma in (0.7, 0.0))
    for camera, a, b in zip(rig, noisy.matches, clean.matches, strict=True):
        for p, q in ((a.x, b.x), (a.y, b.y)):
            error = camera.denormalize(p) - camera.denormalize(q)
            np.testing.assert_allclose(error.std(axis=0), 0.7, rtol=0.1)
            np.testing.assert_allclose(error.mean(axis=0), 0, atol=0.1)


@pytest.mark.parametrize("kind", ["uniform", "static", "second_motion"])
def test_outlier_share_and_kind(kind: OutlierKind) -> None:
    rig = simulate.ring(4, height=0.3)
    made = make_pair(rig, noise_px=0, outliers=0.3, outlier_kind=kind, per_camera=200)
    for camera, matches, wrong, depth in zip(rig, made.matches, made.is_outlier, made.depths, strict=True):
        assert len(matches) == len(wrong) == 200
        assert wrong.sum() == 60
        np.testing.assert_array_equal(np.isnan(depth), wrong)
        residual = np.abs(epipolar_distances(camera, made.motion, matches.x, matches.y)) * camera.focal
        assert residual[~wrong].max() < 1e-9
        assert np.median(residual[wrong]) > 0.5
        assert (np.linalg.norm(matches.x - matches.y, axis=1)[wrong] == 0).all() == (kind == "static")


def test_second_motion_is_one_rigid_motion_in_all_cameras() -> None:
    rig, other = simulate.ring(4), simulate.random_motion(5, 0.02, np.random.default_rng(3))
    made = make_pair(rig, noise_px=0, outliers=0.5, outlier_kind=other)
    for camera, matches, wrong in zip(rig, made.matches, made.is_outlier, strict=True):
        assert np.abs(epipolar_distances(camera, other, matches.x[wrong], matches.y[wrong])).max() < 1e-12


def test_dead_and_junk_cameras() -> None:
    made = make_pair(simulate.ring(3), per_camera={"cam_0": 0}, junk=["cam_2"])
    assert [len(m) for m in made.matches] == [0, 60, 60]
    assert [int(w.sum()) for w in made.is_outlier] == [0, 0, 60]


def test_occlusion_removes_one_side() -> None:
    rig, body = simulate.ring(2), simulate.ellipsoid(n=500)
    free, hidden = (make_pair(rig, body, noise_px=0, per_camera=500, occlusion=share) for share in (0.0, 0.5))
    for a, b in zip(free.matches, hidden.matches, strict=True):
        assert len(b) == pytest.approx(len(a) / 2, abs=1)
        # A line in pixels is a line in normalized points, too: no occluded point is among the visible ones.
        shown = (a.x[:, None] == b.x[None]).all(axis=2).any(axis=1)
        assert np.linalg.norm(a.x[shown].mean(axis=0) - a.x[~shown].mean(axis=0)) > 0.05


def test_matches_are_deterministic_per_camera() -> None:
    rig = simulate.ring(5)
    for kind in ("uniform", "static", "second_motion"):
        first, again = (make_pair(rig, outliers=0.2, outlier_kind=kind) for _ in range(2))
        part = make_pair(rig.subset(["cam_3", "cam_1"]), outliers=0.2, outlier_kind=kind)
        for i, name in enumerate(rig.names):
            np.testing.assert_array_equal(first.matches[i].y, again.matches[i].y)
            if name in ("cam_3", "cam_1"):
                np.testing.assert_array_equal(part.matches[("cam_3", "cam_1").index(name)].y, first.matches[i].y)
    other = make_pair(rig, seed=1)
    assert not np.array_equal(other.matches[0].x, first.matches[0].x)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"per_camera": {"cam_9": 0}}, "cam_9"),
        ({"per_camera": {"cam_1": -1}}, "per_camera"),
        ({"junk": ["side"]}, "side"),
        ({"outliers": 1.2}, "outliers"),
        ({"occlusion": 1.0}, "occlusion"),
        ({"outlier_kind": "odd"}, "outlier_kind"),
        ({"noise_px": -1}, "noise_px"),
    ],
)
def test_invalid_arguments_raise(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_pair(simulate.ring(2), **options)


@given(turn=st.floats(0, 179), shift=st.floats(0, 2), seed=st.integers(0, 1000))
def test_random_motion_angle_and_distance(turn: float, shift: float, seed: int) -> None:
    motion = simulate.random_motion(turn, shift, np.random.default_rng(seed), center=(1, 2, 3))
    assert np.rad2deg(motion.rotation.magnitude()) == pytest.approx(turn, abs=1e-9)
    assert np.linalg.norm(motion.apply([1, 2, 3]) - [1, 2, 3]) == pytest.approx(shift, abs=1e-9)


# --- rendering


@pytest.fixture(scope="module")
def scene() -> simulate.Scene:
    return simulate.make_demo_scene(frames=20)


def test_rendered_features_match_the_ground_truth(scene: simulate.Scene) -> None:
    truth = simulate.compute_demo_truth(scene)
    images = [
        frame for k, frame in enumerate(simulate.render_frames(dataclasses.replace(scene, frames=7))) if k in (5, 6)
    ]
    poses = scene.object_poses()
    motion = poses[6] * poses[5].inv()
    assert np.rad2deg(motion.rotation.magnitude()) > 3
    sift, matcher = cv2.SIFT.create(), cv2.BFMatcher(crossCheck=True)
    for i, camera in enumerate(scene.rig):
        hull = cv2.convexHull(camera.project(poses[5].apply(truth.vertices)).astype(np.float32))
        (keys_i, words_i), (keys_j, words_j) = (
            sift.detectAndCompute(cv2.cvtColor(pictures[i], cv2.COLOR_BGR2GRAY), None) for pictures in images
        )
        pairs = np.array([(keys_i[m.queryIdx].pt, keys_j[m.trainIdx].pt) for m in matcher.match(words_i, words_j)])
        on_object = np.array([cv2.pointPolygonTest(hull, (float(u), float(v)), True) > 3 for u, v in pairs[:, 0]])
        near = np.linalg.norm(pairs[:, 0] - pairs[:, 1], axis=1) < 60
        x, y = (camera.normalize(pairs[on_object & near, k]) for k in (0, 1))
        residual = np.abs(epipolar_distances(camera, motion, x, y)) * camera.focal
        assert len(x) > 150
        assert np.median(residual) < 0.2
        assert np.mean(residual < 1) > 0.75


def test_body_is_rendered_at_its_pose(scene: simulate.Scene) -> None:
    clean = dataclasses.replace(scene, noise=0.0, frames=1)
    with_body, empty = (next(simulate.render_frames(s)) for s in (clean, dataclasses.replace(clean, actors=())))
    body, pose = scene.actors[0].body, scene.object_poses()[0]
    truth = simulate.compute_demo_truth(scene)
    for camera, image, background in zip(scene.rig, with_body, empty, strict=True):
        drawn = np.abs(image.astype(int) - background).max(axis=2) > 4
        rows, columns = np.flatnonzero(drawn.any(axis=1)), np.flatnonzero(drawn.any(axis=0))
        corners = camera.project(pose.apply(truth.vertices))
        np.testing.assert_allclose([columns[0], rows[0]], corners.min(axis=0), atol=1)
        np.testing.assert_allclose([columns[-1], rows[-1]], corners.max(axis=0), atol=1)
        x, y, width, height = truth.boxes[camera.name]
        assert drawn[y : y + height, x : x + width].sum() == pytest.approx(drawn.sum(), rel=0.002)
        # The most frontal face shows its texture, texel by texel.
        face = int(np.argmin(body.normals @ camera.direction))
        texture = body.textures[face].astype(float).mean(axis=2)
        v, u = (a.ravel() for a in np.mgrid[20 : texture.shape[0] - 20 : 3, 20 : texture.shape[1] - 20 : 3])
        texels = np.column_stack([u, v, np.ones(len(u))])
        pixels = camera.project(pose.apply(texels @ body.plane_from_texture[face].T)).astype(np.float32)
        seen = cv2.remap(image, pixels[None], None, cv2.INTER_LINEAR)[0].astype(float).mean(axis=1)  # type: ignore[call-overload]
        assert np.corrcoef(seen, texture[v, u])[0, 1] > 0.9


def test_demo_rotation_and_visibility() -> None:
    for seed in range(5):
        truth = simulate.compute_demo_truth(simulate.make_demo_scene(frames=30, angle_deg=80, seed=seed))
        poses = truth.world_from_object
        np.testing.assert_allclose(poses[0].rotation.as_matrix(), np.eye(3), atol=1e-12)
        assert np.rad2deg(poses[-1].rotation.magnitude()) == pytest.approx(80)
        path = np.linalg.norm(np.diff(poses.translation, axis=0), axis=1).sum()
        assert path > np.ptp(truth.vertices, axis=0).max() / 2
        for camera in truth.rig:
            pixels = np.concatenate([camera.project(pose.apply(truth.vertices)) for pose in poses])
            assert (pixels > 0).all()
            assert (pixels < np.array(camera.size) - 1).all()


def test_rendering_is_deterministic_and_seeded() -> None:
    small: dict[str, Any] = {"frames": 2, "size": (160, 120), "n_cameras": 2}
    a, b, c = (list(simulate.render_frames(simulate.make_demo_scene(seed=s, **small))) for s in (0, 0, 1))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)
    assert not np.array_equal(a[0], a[1])
    assert not np.array_equal(a[0][0], a[0][1])


def test_occlusion_order_follows_distance() -> None:
    block = simulate.chamfered_box((0.1, 0.1, 0.1), 500)
    rig = simulate.arc(1, 0, 1.0, 400, (160, 120))
    pictures = {}
    for name, depth in (("front", -0.4), ("behind", 0.4)):
        other = simulate.Actor(block, lambda _, z=depth: RigidTransform.from_translation([0, 0, z]))  # type: ignore[misc]
        scene = simulate.make_demo_scene(rig=rig, frames=1, other_actors=[other], noise=0)
        pictures[name] = next(simulate.render_frames(scene))[0]
    alone = next(simulate.render_frames(simulate.make_demo_scene(rig=rig, frames=1, noise=0)))[0]
    assert np.abs(pictures["front"][55:65, 75:85].astype(int) - alone[55:65, 75:85]).mean() > 5
    np.testing.assert_array_equal(pictures["behind"][55:65, 75:85], alone[55:65, 75:85])


def test_motion_blur_affects_the_object_only() -> None:
    sharp, blurred = (
        next(simulate.render_frames(simulate.make_demo_scene(frames=5, n_cameras=1, noise=0, exposure=e)))
        for e in (0.0, 0.8)
    )
    detail = [
        float(cv2.Laplacian(cv2.cvtColor(image[0], cv2.COLOR_BGR2GRAY), cv2.CV_64F).std()) for image in (sharp, blurred)
    ]
    assert detail[1] < 0.8 * detail[0]
    np.testing.assert_array_equal(sharp[0][:40], blurred[0][:40])


def test_written_sequence_can_be_read(tmp_path: Path) -> None:
    scene = simulate.make_demo_scene(frames=4, size=(320, 240), n_cameras=2)
    truth = simulate.write_sequence(tmp_path / "demo", scene, boxes=True)
    folder = tmp_path / "demo"
    rig = calibration.load(folder / "calibration.toml")
    assert rig.names == truth.rig.names
    rows = np.loadtxt(folder / "groundtruth.tum")
    np.testing.assert_allclose(rows[:, 0], truth.times)
    np.testing.assert_allclose(rows[:, 1:4], truth.world_from_object.translation, atol=1e-8)
    np.testing.assert_allclose(np.abs(rows[0, 4:]), [0, 0, 0, 1], atol=1e-9)
    assert tomllib.loads((folder / "boxes.toml").read_text()) == {n: list(b) for n, b in truth.boxes.items()}
    center = tomllib.loads((folder / "dataset.toml").read_text())["center_world"]
    np.testing.assert_allclose(center, truth.world_from_object[0].translation, atol=1e-8)
    scene = simulate.make_demo_scene(frames=4, size=(320, 240), n_cameras=2)
    for i, frame in enumerate(simulate.render_frames(scene)):
        for k, camera in enumerate(rig):
            with av.open(str(folder / f"{camera.name}.mp4")) as file:
                images = [f.to_ndarray(format="gray") for f in file.decode(video=0)]
                assert len(images) == 4
            gray = cv2.cvtColor(frame[k], cv2.COLOR_BGR2GRAY).astype(float)
            assert np.abs(images[i] - gray).mean() < 4


def test_invalid_scenes_raise(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one frame"):
        simulate.make_demo_scene(frames=0)
    with pytest.raises(ValueError, match="64 pixels"):
        simulate.make_demo_scene(size=(32, 32))
    cameras = simulate.ring(2).cameras
    turned = dataclasses.replace(cameras[1], camera_from_world=RigidTransform.from_translation([0, 0, -9]))
    with pytest.raises(ValueError, match="does not look"):
        simulate.make_demo_scene(rig=Rig([cameras[0], turned]))
    with pytest.raises(ValueError, match="even"):
        simulate.write_sequence(tmp_path, simulate.make_demo_scene(size=(641, 480), frames=1))
    with pytest.raises(ValueError, match="not all in one plane"):
        simulate.TexturedBody.from_hull([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], 100)


@pytest.mark.skipif("libx264" not in av.codecs_available, reason="this PyAV has no libx264")
def test_videos_are_encoded_reproducibly(tmp_path: Path) -> None:
    """Neither by several threads nor with the macroblock tree, which reads memory that it has not written."""
    simulate.write_sequence(tmp_path, simulate.make_demo_scene(frames=2, size=(64, 64), n_cameras=2))
    video = (tmp_path / "cam_0.mp4").read_bytes()
    assert b"mbtree=0" in video
    assert b" threads=1 " in video
