"""Target poses from rendered images are correct within their covariance, and nothing else is detected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.boards.board_pose import BoardObservation, combine_detections, find_board
from sylpose.boards.detection import Detection, detect
from sylpose.boards.specification import EXAMPLES, Board, parse_board
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.rig import Rig
from sylpose.simulate import make_demo_scene, render_frames
from sylpose.status import Status
from tests.boards.drawing import make_rig_above, render_target

CHARUCO = "charuco:5x6,square=40mm,marker=28mm,dict=4X4_50"
# One of each kind, and further symmetric ones; maximum error in degrees (measured: a half of it).
KINDS = {
    CHARUCO: 0.08,
    "chessboard:6x5,square=25mm": 0.06,
    "chessboard:5x5,square=25mm": 0.06,
    "chessboard:4x4,square=25mm": 0.08,
    "circles:6x4,spacing=30mm,diameter=18mm": 0.02,
    "acircles:4x7,spacing=20mm,diameter=12mm": 0.02,
    "apriltag:36h11,id=3,size=80mm": 0.06,
    "aruco:5X5_100,id=42,size=50mm": 0.08,
    "aprilgrid:3x2,size=88mm,gap=0.3": 0.03,
}
# Those that others resemble.
SIMILAR = ("chessboard:5x5,square=25mm", "chessboard:4x4,square=25mm")
SEEDS = 2
# Boards in strongly distorted images, with the largest error in pixels where the lens is unknown (measured: a half of it).
DISTORTED = {"aprilgrid:4x4,size=88mm,gap=0.3": 0.4, "charuco:7x8,square=40mm,marker=28mm,dict=4X4_50": 0.1}


def frame_after_symmetry(board: Board, turn: int) -> RigidTransform:
    """Return the target's frame after one of its symmetries, in its original frame."""
    here, there = board.points, board.points[board.symmetries[turn]]
    rotation, _ = Rotation.align_vectors(there - there.mean(axis=0), here - here.mean(axis=0))
    return RigidTransform.from_components(there.mean(axis=0) - rotation.apply(here.mean(axis=0)), rotation)


def compute_error(found: BoardObservation, board: Board, truth: RigidTransform) -> FloatArray:
    """Return the error (6,) of (w, d), relative to the nearest of the equivalent frames."""
    motion = found.motion.motion
    assert motion is not None, found.motion.status
    errors = []
    for turn in range(len(board.symmetries)):
        its = truth * frame_after_symmetry(board, turn)
        turned = (its.rotation * motion.rotation.inv()).as_rotvec()
        errors.append(np.concatenate([turned, its.apply(found.motion.center) - motion.apply(found.motion.center)]))
    return min(errors, key=lambda one: float(np.linalg.norm(one[:3])))


@pytest.mark.parametrize(
    "text", [pytest.param(text, marks=pytest.mark.slow) if text in SIMILAR else text for text in KINDS]
)
def test_pose_error_is_within_covariance(text: str) -> None:
    """Rolled cameras, lenses, noise. Squared errors normalized by their covariance average 6 if it is right, and less
    if
    detectors are better than the half pixel that `estimate_pose` assumes for few points.
    """
    board = parse_board(text, "m")
    squares, turns, seen = [], [], 0
    for seed in range(SEEDS):
        rig, truth = make_rig_above(board, 2 + seed % 2, np.random.default_rng([seed, 5]), size=(400, 300))
        found = find_board(rig, render_target(rig, board, truth, seed=seed), board)
        seen += len(found.cameras)
        assert found.motion.status is Status.OK
        assert found.problems == ()
        off = compute_error(found, board, truth)
        squares.append(float(off @ np.linalg.solve(found.motion.covariance, off)))
        turns.append(float(np.degrees(np.linalg.norm(off[:3]))))
    # Circle grids seen obliquely are missed occasionally.
    assert seen >= (0.6 if "circles" in text else 1.0) * 2.5 * SEEDS
    assert 1e-3 < np.mean(squares) < 8.0
    assert max(turns) < KINDS[text]


@pytest.mark.parametrize("text", [CHARUCO, "aprilgrid:3x2,size=88mm,gap=0.3"])
def test_partly_hidden_target_is_detected(text: str) -> None:
    """Half of the image is hidden; no point is detected there."""
    board = parse_board(text, "m")
    parts = located = 0
    for seed in range(3):
        rig, truth = make_rig_above(board, 2, np.random.default_rng([seed, 6]), size=(400, 300))
        images = [image.copy() for image in render_target(rig, board, truth, seed=seed)]
        for image in images:
            image[:, 200:] = 127
        found = find_board(rig, images, board)
        for camera, points, pixels in zip(rig, found.points, found.pixels, strict=True):
            parts += 0 < len(pixels) < len(board.points)
            # Corners slightly beyond are extrapolated from edges.
            assert (pixels[:, 0] < 210).all()
            if len(pixels):
                assert np.abs(camera.project(truth.apply(points)) - pixels).max() < 1.0
        if found.motion.status is Status.ROTATION_NOT_OBSERVABLE:
            assert len(found.cameras) == 1  # with few points, the mirrored pose is about as likely
            continue
        located += 1
        assert np.degrees(np.linalg.norm(compute_error(found, board, truth)[:3])) < 0.5
    assert parts >= 4
    assert located >= 2


def test_missing_target_is_not_detected() -> None:
    """Rooms, blob noise, another marker, another board."""
    boards = [parse_board(text, "m") for text in EXAMPLES]
    scene = make_demo_scene(frames=1, size=(320, 240), n_cameras=3)
    images = list(next(iter(render_frames(scene))))
    blobs = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(240, 320)), (0, 0), 3)
    images[2] = np.asarray(np.clip(127 + 1500 * blobs, 0, 255), dtype=np.uint8)
    other = parse_board("aruco:4X4_50,id=1,size=50mm", "m")
    rig, truth = make_rig_above(other, 1, np.random.default_rng(0), size=(320, 240))
    images[1] = render_target(rig, other, truth)[0]
    for board in boards:
        found = find_board(scene.rig, images, board)
        assert found.motion.status is Status.TOO_FEW_MATCHES, board.text
        assert found.cameras == (), board.text


# --- symmetries


def simulate_detections(
    board: Board, rig: Rig, truth: RigidTransform, turns: Sequence[int], rng: np.random.Generator
) -> list[Detection]:
    """Simulate detections that do not distinguish symmetries: each camera returns another one."""
    seen = []
    for camera, turn in zip(rig, turns, strict=True):
        pixels = camera.project(truth.apply(board.points[board.symmetries[turn]]))
        seen.append(Detection(np.arange(len(board.points)), pixels + rng.normal(0, 0.1, pixels.shape)))
    return seen


@pytest.mark.parametrize(
    "text",
    [
        "chessboard:7x5,square=1",
        pytest.param("chessboard:6x6,square=1", marks=pytest.mark.slow),
        "circles:5x5,spacing=1,diameter=0.5",
    ],
)
def test_cameras_agree_on_symmetry(text: str) -> None:
    board = parse_board(text)
    n = len(board.symmetries)
    assert n == (2 if "7x5" in text else 4)
    for seed in range(24):
        rng = np.random.default_rng([seed, 7])
        rig, truth = make_rig_above(board, 3, rng)
        turns = [seed % n, seed // n % n, seed // n**2 % n]
        found = combine_detections(
            rig, simulate_detections(board, rig, truth, turns, rng), replace(board, diameter=0.0)
        )
        assert found.motion.status is Status.OK
        assert found.problems == ()
        assert found.n_symmetries == n
        assert found.cameras == (0, 1, 2)
        off = compute_error(found, board, truth)
        assert np.linalg.norm(off[:3]) < 2e-3
        # The choice is deterministic: x points as far right as possible in the first camera.
        motion = found.motion.motion
        assert motion is not None
        x = board.points[:, 0] - board.points[:, 0].mean()
        frames = [motion * frame_after_symmetry(board, turn) for turn in range(n)]
        right = [float(x @ rig.cameras[0].project(its.apply(board.points))[:, 0]) for its in frames]
        assert right[0] == max(right)


@pytest.mark.parametrize(
    "text", ["chessboard:6x5,square=1", pytest.param("chessboard:5x5,square=1", marks=pytest.mark.slow)]
)
def test_colors_resolve_chessboard_orientation(text: str) -> None:
    """For any camera roll, the square at the origin is dark."""
    board = parse_board(text)
    for seed in range(4):
        rig, truth = make_rig_above(board, 2, np.random.default_rng([seed, 8]), size=(320, 240), tilt_deg=30.0)
        for image, camera in zip(render_target(rig, board, truth, seed=seed), rig, strict=True):
            seen = detect(image, camera, board)
            assert len(seen.indices) == len(board.points)
            ways = [camera.project(truth.apply(board.points[way[seen.indices]])) for way in board.symmetries]
            assert min(np.abs(way - seen.pixels).max() for way in ways) < 0.5


def test_legacy_charuco_boards_are_detected() -> None:
    """OpenCV before 4.6 began boards with an even number of rows with a square of the other color."""
    board = parse_board(CHARUCO, "m")
    rig, truth = make_rig_above(board, 2, np.random.default_rng(9), size=(400, 300))
    found = find_board(rig, render_target(rig, board, truth, legacy=True), board)
    assert np.degrees(np.linalg.norm(compute_error(found, board, truth)[:3])) < 0.1


def test_aprilgrid_tag_orientation_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    board = parse_board("aprilgrid:2x2,size=88mm,gap=0.3", "m")
    rig, truth = make_rig_above(board, 1, np.random.default_rng(3), size=(400, 300))
    drawn = cv2.aruco.generateImageMarker
    for turn in range(4):
        monkeypatch.setattr(
            cv2.aruco, "generateImageMarker", lambda *a, k=turn, **b: np.ascontiguousarray(np.rot90(drawn(*a, **b), k))
        )
        found = find_board(rig, render_target(rig, board, truth), board)
        assert np.degrees(np.linalg.norm(compute_error(found, board, truth)[:3])) < 0.1


def test_apriltag_orientation_matches_apriltag_images() -> None:
    """tag36h11 number 3 of AprilRobotics' images: black border, the code row by row from the top."""
    rows = ["00000000", "01110010", "00001110", "01001110", "01010010", "01100100", "00110000", "00000000"]
    bits = np.array([[int(bit) for bit in row] for row in rows], np.uint8)
    image = np.pad(bits.repeat(12, 0).repeat(12, 1) * 255, 40, constant_values=255)
    camera = make_rig_above(parse_board("apriltag:36h11,id=3,size=1"), 1, np.random.default_rng(0), size=(176, 176))[
        0
    ].cameras[0]
    camera = replace(camera, distortion=np.zeros(5))
    for name, corner in (("apriltag:36h11", (40, 40)), ("aruco:APRILTAG_36h11", (136, 136))):
        seen = detect(image, camera, parse_board(f"{name},id=3,size=1"))
        np.testing.assert_allclose(seen.pixels[0] + 0.5, corner, atol=0.2)


# --- problems are reported


def test_duplicate_marker_is_rejected() -> None:
    board = parse_board("apriltag:36h11,id=3,size=80mm", "m")
    rig, truth = make_rig_above(board, 1, np.random.default_rng(1), size=(320, 240), tilt_deg=20.0)
    image = render_target(rig, board, truth)[0]
    twice = np.hstack([image, image])[:, 160:480].copy()
    twice[:, :320] = np.asarray(cv2.resize(np.hstack([image, image]), (320, 120)))[:120].repeat(2, 0)
    found = find_board(rig, [twice], board)
    assert found.cameras == ()
    assert found.problems == ("cam_0: marker 3 is seen more than once",)


def test_size_ratio_is_estimated() -> None:
    board, wrong = parse_board("chessboard:6x5,square=25mm", "m"), parse_board("chessboard:6x5,square=25", "m")
    rig, truth = make_rig_above(board, 3, np.random.default_rng(2))
    seen = simulate_detections(board, rig, truth, [0, 0, 0], np.random.default_rng(2))
    sizes = [combine_detections(rig, seen, its).size_ratio for its in (board, wrong)]
    assert sizes == [pytest.approx(1.0, abs=0.01), pytest.approx(0.001, abs=1e-5)]
    # A single camera cannot determine it.
    assert (
        combine_detections(rig, [seen[0], *[Detection(np.empty(0, np.int64), np.empty((0, 2)))] * 2], board).size_ratio
        is None
    )


def test_moved_camera_is_reported() -> None:
    board = parse_board("chessboard:6x5,square=25mm", "m")
    rig, truth = make_rig_above(board, 4, np.random.default_rng(2))
    seen = simulate_detections(board, rig, truth, [0, 0, 0, 0], np.random.default_rng(2))
    seen[2] = Detection(seen[2].indices, seen[2].pixels + np.array([12.0, 5.0]))
    problems = combine_detections(rig, seen, board).problems
    assert len(problems) == 1
    assert problems[0].startswith("cam_2 sees it at another position than the other cameras")


def test_cameras_without_image_have_no_detections() -> None:
    board = parse_board(CHARUCO, "m")
    rig, truth = make_rig_above(board, 2, np.random.default_rng(4), size=(400, 300))
    images: list[Image | None] = [*render_target(rig, board, truth)]
    images[0] = None
    found = find_board(rig, images, board)
    assert found.cameras == (1,)
    with pytest.raises(ValueError, match="images: 1 for 2 cameras"):
        find_board(rig, images[:1], board)


def test_opencv_without_detectors_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    board = parse_board(CHARUCO, "m")
    rig, _ = make_rig_above(board, 1, np.random.default_rng(4))
    monkeypatch.delattr(cv2, "aruco")
    with pytest.raises(ValueError, match=r"need OpenCV 4\.8 or newer"):
        detect(np.zeros((360, 480), np.uint8), rig.cameras[0], board)


@pytest.mark.parametrize("text", DISTORTED)
def test_detection_does_not_need_the_lens(text: str) -> None:
    """Markers at the border of a strongly distorted image are not in the plane that a pinhole camera expects."""
    board, rng = parse_board(text, "m"), np.random.default_rng(0)
    lens = (-0.35, 0.12, 0.0, 0.0, -0.01)
    rig, pose = make_rig_above(board, 1, rng, size=(800, 600), distance=1.5, tilt_deg=25, distortion=lens)
    image = render_target(rig, board, pose)[0]
    pinhole = replace(rig[0], distortion=np.zeros(5), matrix=np.diag([2.0, 2.0, 1.0]) @ rig[0].matrix)
    found, truth = detect(image, pinhole, board), rig[0].project(pose.apply(board.points).reshape(-1, 3))
    assert len(found.indices) > 0.9 * len(board.points)
    assert np.linalg.norm(found.pixels - truth[found.indices], axis=1).max() < DISTORTED[text]


def test_inverted_board_is_detected_in_the_negative() -> None:
    board, rng = parse_board(CHARUCO, "m"), np.random.default_rng(0)
    rig, pose = make_rig_above(board, 1, rng)
    image = render_target(rig, board, pose)[0]
    inverted = parse_board(f"{CHARUCO},inverted=1", "m")
    found, negative = detect(image, rig[0], board), detect(255 - image, rig[0], inverted)
    assert len(found.indices) > 0.5 * len(board.points)
    np.testing.assert_array_equal(negative.indices, found.indices)
    np.testing.assert_allclose(negative.pixels, found.pixels, atol=0.05)
    assert not len(detect(image, rig[0], inverted).indices)
