"""Targets rendered through the rig's lenses are found where they are, within what is said of the error; nothing else is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.boards.board_pose import Sighting, find_board, joined
from sylpose.boards.detection import Detection, detect
from sylpose.boards.specification import EXAMPLES, Board, parse_board
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.simulate import demo_scene, render_frames
from tests.boards.drawing import above, rendered

CHARUCO = "charuco:5x6,square=40mm,marker=28mm,dict=4X4_50"
# Of each kind one, and of those that look the same turned the others; the error in degrees that is not exceeded (measured: a
# half of it).
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
SEEDS = 4


def as_turned(board: Board, turn: int) -> RigidTransform:
    """The target's frame after one of the turns that look the same, in its own."""
    here, there = board.points, board.points[board.alike[turn]]
    rotation, _ = Rotation.align_vectors(there - there.mean(axis=0), here - here.mean(axis=0))
    return RigidTransform.from_components(there.mean(axis=0) - rotation.apply(here.mean(axis=0)), rotation)


def error(found: Sighting, board: Board, truth: RigidTransform) -> FloatArray:
    """(6,) of (w, d), against the nearest of the frames that look the same."""
    motion = found.motion.motion
    assert motion is not None, found.motion.status
    errors = []
    for turn in range(len(board.alike)):
        its = truth * as_turned(board, turn)
        turned = (its.rotation * motion.rotation.inv()).as_rotvec()
        errors.append(np.concatenate([turned, its.apply(found.motion.center) - motion.apply(found.motion.center)]))
    return min(errors, key=lambda one: float(np.linalg.norm(one[:3])))


@pytest.mark.parametrize("text", KINDS)
def test_it_is_found_where_it_is_within_its_covariance(text: str) -> None:
    """Rolled cameras, lenses, noise. The squares of errors by their covariance are 6 in the mean if it is right; less where
    detectors are better than the half pixel that `estimate_pose` believes of few points."""
    board = parse_board(text, "m")
    squares, turns, seen = [], [], 0
    for seed in range(SEEDS):
        rig, truth = above(board, 2 + seed % 2, np.random.default_rng([seed, 5]), size=(400, 300))
        found = find_board(rig, rendered(rig, board, truth, seed=seed), board)
        seen += len(found.cameras)
        assert found.motion.status is Status.OK
        assert found.problems == ()
        off = error(found, board, truth)
        squares.append(float(off @ np.linalg.solve(found.motion.covariance, off)))
        turns.append(float(np.degrees(np.linalg.norm(off[:3]))))
    # Grids of circles that are seen at a slant are missed now and then.
    assert seen >= (0.6 if "circles" in text else 1.0) * 2.5 * SEEDS
    assert 1e-3 < np.mean(squares) < 8.0
    assert max(turns) < KINDS[text]


@pytest.mark.parametrize("text", [CHARUCO, "aprilgrid:3x2,size=88mm,gap=0.3"])
def test_a_part_of_it_is_enough(text: str) -> None:
    """A half of the image is hidden; no point is invented there."""
    board = parse_board(text, "m")
    parts = located = 0
    for seed in range(3):
        rig, truth = above(board, 2, np.random.default_rng([seed, 6]), size=(400, 300))
        images = [image.copy() for image in rendered(rig, board, truth, seed=seed)]
        for image in images:
            image[:, 200:] = 127
        found = find_board(rig, images, board)
        for camera, points, pixels in zip(rig, found.points, found.pixels, strict=True):
            parts += 0 < len(pixels) < len(board.points)
            # Corners a little beyond are where edges lead.
            assert (pixels[:, 0] < 210).all()
            if len(pixels):
                assert np.abs(camera.project(truth.apply(points)) - pixels).max() < 1.0
        if found.motion.status is Status.TURN_NOT_OBSERVABLE:
            assert len(found.cameras) == 1  # of few points, whose mirror image is about as likely
            continue
        located += 1
        assert np.degrees(np.linalg.norm(error(found, board, truth)[:3])) < 0.5
    assert parts >= 4
    assert located >= 2


def test_nothing_is_found_where_there_is_none() -> None:
    """Rooms, and noise in blobs; another marker, another board."""
    boards = [parse_board(text, "m") for text in EXAMPLES]
    scene = demo_scene(frames=1, size=(320, 240), n_cameras=3)
    images = list(next(iter(render_frames(scene))))
    blobs = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(240, 320)), (0, 0), 3)
    images[2] = np.asarray(np.clip(127 + 1500 * blobs, 0, 255), dtype=np.uint8)
    other = parse_board("aruco:4X4_50,id=1,size=50mm", "m")
    rig, truth = above(other, 1, np.random.default_rng(0), size=(320, 240))
    images[1] = rendered(rig, other, truth)[0]
    for board in boards:
        found = find_board(scene.rig, images, board)
        assert found.motion.status is Status.TOO_FEW_MATCHES, board.text
        assert found.cameras == (), board.text


# --- what looks the same after a turn


def as_seen(
    board: Board, rig: Rig, truth: RigidTransform, turns: Sequence[int], rng: np.random.Generator
) -> list[Detection]:
    """What detectors see that cannot tell turns of the target: in each camera another."""
    seen = []
    for camera, turn in zip(rig, turns, strict=True):
        pixels = camera.project(truth.apply(board.points[board.alike[turn]]))
        seen.append(Detection(np.arange(len(board.points)), pixels + rng.normal(0, 0.1, pixels.shape)))
    return seen


@pytest.mark.parametrize(
    "text", ["chessboard:7x5,square=1", "chessboard:6x6,square=1", "circles:5x5,spacing=1,diameter=0.5"]
)
def test_all_cameras_come_to_the_same_turn(text: str) -> None:
    board = parse_board(text)
    n = len(board.alike)
    assert n == (2 if "7x5" in text else 4)
    for seed in range(24):
        rng = np.random.default_rng([seed, 7])
        rig, truth = above(board, 3, rng)
        turns = [seed % n, seed // n % n, seed // n**2 % n]
        found = joined(rig, as_seen(board, rig, truth, turns, rng), replace(board, diameter=0.0))
        assert found.motion.status is Status.OK
        assert found.problems == ()
        assert found.alike == n
        assert found.cameras == (0, 1, 2)
        off = error(found, board, truth)
        assert np.linalg.norm(off[:3]) < 2e-3
        # Which turn is a rule, not chance: of all, the x axis is most to the right for the first camera.
        motion = found.motion.motion
        assert motion is not None
        x = board.points[:, 0] - board.points[:, 0].mean()
        frames = [motion * as_turned(board, turn) for turn in range(n)]
        right = [float(x @ rig.cameras[0].project(its.apply(board.points))[:, 0]) for its in frames]
        assert right[0] == max(right)


@pytest.mark.parametrize("text", ["chessboard:6x5,square=1", "chessboard:5x5,square=1"])
def test_colours_tell_which_way_a_chessboard_is_turned(text: str) -> None:
    """Whatever the camera's roll: the square at the origin is a dark one."""
    board = parse_board(text)
    for seed in range(4):
        rig, truth = above(board, 2, np.random.default_rng([seed, 8]), size=(320, 240), tilt_deg=30.0)
        for image, camera in zip(rendered(rig, board, truth, seed=seed), rig, strict=True):
            seen = detect(image, camera, board)
            assert len(seen.numbers) == len(board.points)
            ways = [camera.project(truth.apply(board.points[way[seen.numbers]])) for way in board.alike]
            assert min(np.abs(way - seen.pixels).max() for way in ways) < 0.5


def test_boards_of_old_are_read_as_they_are() -> None:
    """OpenCV before 4.6 began boards of an even number of rows with a square of the other colour."""
    board = parse_board(CHARUCO, "m")
    rig, truth = above(board, 2, np.random.default_rng(9), size=(400, 300))
    found = find_board(rig, rendered(rig, board, truth, legacy=True), board)
    assert np.degrees(np.linalg.norm(error(found, board, truth)[:3])) < 0.1


def test_a_grid_is_read_whichever_way_up_its_tags_are_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    board = parse_board("aprilgrid:2x2,size=88mm,gap=0.3", "m")
    rig, truth = above(board, 1, np.random.default_rng(3), size=(400, 300))
    drawn = cv2.aruco.generateImageMarker
    for turn in range(4):
        monkeypatch.setattr(
            cv2.aruco, "generateImageMarker", lambda *a, k=turn, **b: np.ascontiguousarray(np.rot90(drawn(*a, **b), k))
        )
        found = find_board(rig, rendered(rig, board, truth), board)
        assert np.degrees(np.linalg.norm(error(found, board, truth)[:3])) < 0.1


def test_apriltags_are_upright_as_their_makers_have_them() -> None:
    """tag36h11 number 3 of AprilRobotics' images: black border, the code row by row from the top."""
    rows = ["00000000", "01110010", "00001110", "01001110", "01010010", "01100100", "00110000", "00000000"]
    bits = np.array([[int(bit) for bit in row] for row in rows], np.uint8)
    image = np.pad(bits.repeat(12, 0).repeat(12, 1) * 255, 40, constant_values=255)
    camera = above(parse_board("apriltag:36h11,id=3,size=1"), 1, np.random.default_rng(0), size=(176, 176))[0].cameras[
        0
    ]
    camera = replace(camera, distortion=np.zeros(5))
    for name, corner in (("apriltag:36h11", (40, 40)), ("aruco:APRILTAG_36h11", (136, 136))):
        seen = detect(image, camera, parse_board(f"{name},id=3,size=1"))
        np.testing.assert_allclose(seen.pixels[0] + 0.5, corner, atol=0.2)


# --- what looks wrong is said


def test_a_marker_that_is_there_twice_is_not_taken() -> None:
    board = parse_board("apriltag:36h11,id=3,size=80mm", "m")
    rig, truth = above(board, 1, np.random.default_rng(1), size=(320, 240), tilt_deg=20.0)
    image = rendered(rig, board, truth)[0]
    twice = np.hstack([image, image])[:, 160:480].copy()
    twice[:, :320] = np.asarray(cv2.resize(np.hstack([image, image]), (320, 120)))[:120].repeat(2, 0)
    found = find_board(rig, [twice], board)
    assert found.cameras == ()
    assert found.problems == ("cam_0: marker 3 is seen more than once",)


def test_how_large_it_is_seen_is_told() -> None:
    board, wrong = parse_board("chessboard:6x5,square=25mm", "m"), parse_board("chessboard:6x5,square=25", "m")
    rig, truth = above(board, 3, np.random.default_rng(2))
    seen = as_seen(board, rig, truth, [0, 0, 0], np.random.default_rng(2))
    sizes = [joined(rig, seen, its).size for its in (board, wrong)]
    assert sizes == [pytest.approx(1.0, abs=0.01), pytest.approx(0.001, abs=1e-5)]
    # One camera has nothing to tell it by.
    assert joined(rig, [seen[0], *[Detection(np.empty(0, np.int64), np.empty((0, 2)))] * 2], board).size is None


def test_a_camera_that_was_moved_is_named() -> None:
    board = parse_board("chessboard:6x5,square=25mm", "m")
    rig, truth = above(board, 4, np.random.default_rng(2))
    seen = as_seen(board, rig, truth, [0, 0, 0, 0], np.random.default_rng(2))
    seen[2] = Detection(seen[2].numbers, seen[2].pixels + np.array([12.0, 5.0]))
    said = joined(rig, seen, board).problems
    assert len(said) == 1
    assert said[0].startswith("cam_2 sees it elsewhere than the other cameras")


def test_cameras_without_an_image_see_nothing() -> None:
    board = parse_board(CHARUCO, "m")
    rig, truth = above(board, 2, np.random.default_rng(4), size=(400, 300))
    images: list[Image | None] = [*rendered(rig, board, truth)]
    images[0] = None
    found = find_board(rig, images, board)
    assert found.cameras == (1,)
    with pytest.raises(ValueError, match="images: 1 for 2 cameras"):
        find_board(rig, images[:1], board)


def test_an_opencv_without_detectors_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    board = parse_board(CHARUCO, "m")
    rig, _ = above(board, 1, np.random.default_rng(4))
    monkeypatch.delattr(cv2, "aruco")
    with pytest.raises(ValueError, match=r"need OpenCV 4\.8 or newer"):
        detect(np.zeros((360, 480), np.uint8), rig.cameras[0], board)
