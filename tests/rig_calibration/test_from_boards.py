"""Calibration from simulated corners: exact without noise, honest covariances, outliers, delays, refusals."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.boards.detection import Detection
from sylpose.boards.specification import parse_board
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Camera, Rig
from sylpose.rig_calibration.board_bundle import N_CAMERA, Unknowns, Views, linearize, project
from sylpose.rig_calibration.board_views import choose_frames, collect_views
from sylpose.rig_calibration.from_boards import calibrate_from_boards
from sylpose.rig_calibration.result import CalibrationRefusedError
from tests.rig_calibration.board_scenes import (
    CHARUCO,
    BoardScene,
    draw_poses,
    list_lens,
    make_cameras,
    make_scene,
    observe,
    subtract_pose,
)

# Symmetric under half a rotation.
SYMMETRIC = "chessboard:7x5,square=40mm"


def calibrate(scene: BoardScene) -> Rig:
    return calibrate_from_boards(scene.rig, scene.board, scene.detections).rig


def assert_equal(found: Rig, truth: Rig, pose: float = 1e-5, lens: float = 1e-4) -> None:
    for a, b in zip(found, truth, strict=True):
        assert np.abs(subtract_pose(a, b)).max() < pose, a.name
        assert np.abs(list_lens(a) / list_lens(b) - 1).max() < lens, a.name


def test_derivatives_agree_with_differences() -> None:
    rng = np.random.default_rng(0)
    n, n_cameras, n_frames = 12, 2, 3
    points = np.column_stack([rng.uniform(-1, 1, (n, 2)), np.zeros(n)])
    at = Unknowns(
        np.column_stack([rng.uniform([500, 500, 200, 200], 600, (n_cameras, 4)), rng.normal(0, 0.05, (n_cameras, 8))]),
        Rotation.from_rotvec(rng.normal(0, 0.2, (n_cameras, 3))).as_matrix(),
        rng.normal([0, 0, 4], 0.1, (n_cameras, 3)),
        rng.normal(size=n_cameras),
        Rotation.from_rotvec(rng.normal(0, 0.3, (n_frames, 3))).as_matrix(),
        rng.normal(0, 0.3, (n_frames, 3)),
    )
    camera, frame = (grid.ravel() for grid in np.meshgrid(range(n_cameras), range(n_frames), indexing="ij"))
    n_views = len(camera)
    speeds = rng.normal(0, 5, (n_views, n, 2))
    views = Views(points, camera, frame, np.zeros((n_views, n, 2)), np.ones((n_views, n), bool), speeds)
    lin = linearize(views, at)
    no_cameras, no_boards = np.zeros((n_cameras, N_CAMERA)), np.zeros((n_frames, 6))
    for jacobian, k, is_camera in [
        *((lin.camera_jacobian[..., k], k, True) for k in range(N_CAMERA)),
        *((lin.board_jacobian[..., k], k, False) for k in range(6)),
    ]:
        step = np.zeros_like(no_cameras if is_camera else no_boards)
        step[:, k] = 1e-6
        ends = [
            project(views, at.move(sign * step, no_boards) if is_camera else at.move(no_cameras, sign * step))
            for sign in (1, -1)
        ]
        np.testing.assert_allclose(jacobian, (ends[0] - ends[1]).reshape(n_views, -1) / 2e-6, rtol=1e-5, atol=1e-4)


def test_exact_corners_give_the_exact_rig() -> None:
    scene = make_scene(0, noise=0.0)
    found = calibrate_from_boards(scene.rig, scene.board, scene.detections)
    assert_equal(found.rig, scene.rig)
    assert (found.rms_px < 1e-4).all()


@pytest.mark.slow
def test_covariances_hold() -> None:
    """Squared errors in units of the covariances have mean 1 (measured: 0.7 to 1.4 with these seeds)."""
    poses, lenses = [], []
    for seed in range(6):
        scene = make_scene(seed)
        found = calibrate_from_boards(scene.rig, scene.board, scene.detections)
        error = subtract_pose(found.rig[1], scene.rig[1])
        poses.append(error @ np.linalg.solve(found.extrinsics_covariance[1], error) / 6)
        for c, (a, b) in enumerate(zip(found.rig, scene.rig, strict=True)):
            lens = list_lens(a)[:4] - list_lens(b)[:4]
            lenses.append(lens @ np.linalg.solve(found.intrinsics_covariance[c][:4, :4], lens) / 4)
    assert 0.3 < np.mean(poses) < 2.0
    assert 0.3 < np.mean(lenses) < 2.0
    assert max(*poses, *lenses) < 6.0


def shift_view(rng: np.random.Generator, _f: int, _c: int, pixels: FloatArray) -> FloatArray:
    return np.asarray(pixels + rng.normal(0, 0.5, 2) + rng.normal(0, 0.1, pixels.shape))


@pytest.mark.slow
def test_shifts_of_views_do_not_bend_the_lenses() -> None:
    """Blur shifts all corners of a view: lenses are as exact as without it, and covariances hold (measured: 0.5, 0.8)."""
    poses, lenses, focal = [], [], []
    for seed in range(4):
        rng, board, rig = np.random.default_rng(seed), parse_board(CHARUCO, "m"), make_cameras(2)
        truth = rig.in_world(rig[0].camera_from_world)
        places = draw_poses(board, 24, rng)
        corners = observe(rig, board, places, partial(shift_view, rng))
        found = calibrate_from_boards(rig, board, corners)
        error = subtract_pose(found.rig[1], truth[1])
        poses.append(error @ np.linalg.solve(found.extrinsics_covariance[1], error) / 6)
        for c, (a, b) in enumerate(zip(found.rig, truth, strict=True)):
            lens = list_lens(a)[:4] - list_lens(b)[:4]
            lenses.append(lens @ np.linalg.solve(found.intrinsics_covariance[c][:4, :4], lens) / 4)
            focal.append(abs(a.focal / b.focal - 1))
        assert any("All corners of a view share an error" in text for text in found.warnings)
    assert 0.2 < np.mean(poses) < 2.0
    assert 0.2 < np.mean(lenses) < 2.0
    # A shift of 0.5 px moves the board by a pixel of 800; noise alone gives 0.1 % with so many views.
    assert np.median(focal) < 2e-3


def test_lengths_scale_with_the_board() -> None:
    scene = make_scene(2)
    double = parse_board(CHARUCO.replace("40mm", "80mm").replace("30mm", "60mm"), "m")
    rigs = [calibrate_from_boards(scene.rig, board, scene.detections).rig for board in (scene.board, double)]
    np.testing.assert_allclose(rigs[1][1].center, 2.0 * rigs[0][1].center, rtol=1e-3)
    np.testing.assert_allclose(list_lens(rigs[1][1])[:4], list_lens(rigs[0][1])[:4], rtol=1e-3)


def test_order_of_cameras_and_frames_does_not_matter() -> None:
    scene = make_scene(3, 3)
    found = calibrate(scene)
    order = [2, 0, 1]
    rig = Rig([scene.rig[c] for c in order], "m")
    # Every other frame in reverse keeps the halves of the cross-validation.
    detections = [[row[c] for c in order] for row in scene.detections[::-1]]
    other = calibrate_from_boards(rig, scene.board, detections).rig.in_world(RigidTransform.identity())
    moved = other.in_world(other["cam_0"].camera_from_world)
    for name in found.names:
        assert np.abs(subtract_pose(moved[name], found[name])).max() < 2e-3


def test_cameras_are_linked_through_others() -> None:
    scene = make_scene(4, 3, frames=30, noise=0.0)
    for f, row in enumerate(scene.detections):
        row[0 if f % 2 else 2] = Detection()
    assert_equal(calibrate(scene), scene.rig)


@pytest.mark.slow
def test_swapped_and_displaced_corners_are_outliers() -> None:
    scene, rng = make_scene(5), np.random.default_rng(0)
    for row in scene.detections:
        for c, its in enumerate(row):
            pixels = its.pixels.copy()
            if len(pixels) > 4:
                i, j, k = rng.choice(len(pixels), 3, replace=False)
                pixels[[i, j]] = pixels[[j, i]]
                pixels[k] += rng.normal(0, 40, 2)
            row[c] = replace(its, pixels=pixels)
    clean = make_scene(5)
    found = calibrate_from_boards(scene.rig, scene.board, scene.detections)
    reference = calibrate_from_boards(clean.rig, clean.board, clean.detections)
    sd = np.sqrt(np.diag(reference.extrinsics_covariance[1]))
    assert (np.abs(subtract_pose(found.rig[1], reference.rig[1])) < 2.0 * sd).all()
    assert (found.rms_px < 0.4).all()


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_symmetric_boards_are_turned_alike(seed: int) -> None:
    scene, rng = make_scene(seed, 3, noise=0.0, text=SYMMETRIC), np.random.default_rng(seed)
    for row in scene.detections:
        for c, its in enumerate(row):
            way = scene.board.symmetries[rng.integers(2)]
            row[c] = replace(its, indices=way[its.indices])
    assert_equal(calibrate(scene), scene.rig)


def test_circles_are_located_by_their_centers() -> None:
    """Detectors find the centroids of circles' images; with those as centers the focal length is 0.1 % off."""
    text, rig, rng = "circles:7x5,spacing=40mm,diameter=36mm", make_cameras(1), np.random.default_rng(0)
    board = parse_board(text, "m")
    angles = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    arms = 0.018 * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    poses = draw_poses(board, 20, rng)
    found = observe(rig, board, poses, lambda _f, _c, pixels: pixels)
    for pose, row in zip(poses, found, strict=True):
        rings = np.array([rig[0].project(pose.apply(point + arms)) for point in board.points[row[0].indices]])
        centroids = [cv2.moments(ring.astype(np.float32)) for ring in rings]
        row[0] = replace(row[0], pixels=np.array([[m["m10"] / m["m00"], m["m01"] / m["m00"]] for m in centroids]))
    result = calibrate_from_boards(rig, board, found)
    assert result.rms_px[0] < 5e-3
    assert abs(result.rig[0].focal / rig[0].focal - 1) < 1e-4


def test_delay_of_a_camera_is_estimated() -> None:
    """A camera whose images are taken 0.4 frames later, of a board that moves steadily."""
    board, rig, rng = parse_board(CHARUCO, "m"), make_cameras(2), np.random.default_rng(0)
    middle, found = board.points.mean(axis=0), []
    for f in range(90):
        row = []
        for c, camera in enumerate(rig):
            t = 0.07 * (f + 0.4 * c)
            tilt = Rotation.from_rotvec([0.6 * np.sin(1.3 * t), 0.6 * np.cos(t), 0.3 * np.sin(0.7 * t)])
            rotation = tilt * Rotation.from_rotvec([np.pi, 0, 0])
            place = [0.25 * np.sin(t), 0.15 * np.cos(1.7 * t), 0.2 * np.sin(0.9 * t)]
            pose = RigidTransform.from_components(place - rotation.apply(middle), rotation)
            row.append(observe(Rig([camera]), board, [pose], lambda _f, _c, p: p + rng.normal(0, 0.1, p.shape))[0][0])
        found.append(row)
    result = calibrate_from_boards(rig, board, found)
    assert abs(result.delay[1] - 0.4) < max(4.0 * result.delay_sd[1], 0.01)
    assert any("frames after those of cam_0" in text for text in result.warnings)
    truth = rig.in_world(rig[0].camera_from_world)
    assert np.degrees(np.linalg.norm(subtract_pose(result.rig[1], truth[1])[:3])) < 0.2


def test_frontal_views_are_refused() -> None:
    with pytest.raises(CalibrationRefusedError, match=r"focal length is only known to .* %: show it the board tilted"):
        calibrate(make_scene(6, 1, tilt_deg=1.0))


def test_cameras_without_common_views_are_named() -> None:
    scene = make_scene(7, 3)
    for f, row in enumerate(scene.detections):
        for c in range(3):
            if (c == 2) == bool(f % 2):
                row[c] = Detection()
    with pytest.raises(CalibrationRefusedError, match="cam_0, cam_1 and one of cam_2"):
        calibrate(scene)


def test_cameras_without_the_board_are_named() -> None:
    scene = make_scene(8)
    for row in scene.detections:
        row[1] = Detection()
    with pytest.raises(CalibrationRefusedError, match=r"cam_1 sees the board in no frame.*--exclude-camera cam_1"):
        calibrate(scene)


def test_still_boards_count_once() -> None:
    scene = make_scene(9, frames=3, noise=0.05)
    rng = np.random.default_rng(0)
    rows = [
        [replace(its, pixels=its.pixels + rng.normal(0, 0.05, its.pixels.shape)) for its in row]
        for row in scene.detections
        for _ in range(100)
    ]
    views = collect_views(scene.board, rows)
    chosen = choose_frames(views, 2, 50)
    assert len(np.unique(views.frame[chosen])) == 3
    assert len(np.unique(views.frame[chosen] // 100)) == 3


def test_many_views_are_limited() -> None:
    scene = make_scene(10, frames=80)
    views = collect_views(scene.board, scene.detections)
    counts = np.bincount(views.camera[choose_frames(views, 2, 20)])
    assert (counts >= 20).all()
    assert (counts <= 40).all()


@pytest.mark.slow
def test_wide_lenses_get_more_coefficients() -> None:
    """A lens that k1 to k3 do not fit: the rational model is selected and fits to the noise."""
    # Padé approximation of an equidistant fisheye, atan(r) / r.
    distortion = (7 / 9, 64 / 945, 0.0, 0.0, 0.0, 10 / 9, 5 / 21, 0.0)
    narrow = make_cameras(1)[0]
    matrix = np.array([[330.0, 0, 639.5], [0, 330.0, 359.5], [0, 0, 1]])
    rig = Rig([Camera("wide", narrow.size, matrix, np.array(distortion), narrow.camera_from_world)], "m")
    board, rng = parse_board(CHARUCO, "m"), np.random.default_rng(0)
    poses = [RigidTransform.from_translation([0, 0, -0.55]) * pose for pose in draw_poses(board, 40, rng)]
    found = observe(rig, board, poses, lambda _f, _c, pixels: pixels + rng.normal(0, 0.05, pixels.shape))
    result = calibrate_from_boards(rig, board, found)
    assert len(result.rig[0].distortion) == 8
    assert result.rms_px[0] < 0.08


def test_wrong_arguments_are_named() -> None:
    scene = make_scene(0, frames=3)
    with pytest.raises(TypeError, match="rig"):
        calibrate_from_boards("rig", scene.board, scene.detections)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="board"):
        calibrate_from_boards(scene.rig, "board", scene.detections)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="detections"):
        calibrate_from_boards(scene.rig, scene.board, [row[:1] for row in scene.detections])
    with pytest.raises(ValueError, match="max_views"):
        calibrate_from_boards(scene.rig, scene.board, scene.detections, max_views=1)
