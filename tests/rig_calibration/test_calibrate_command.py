"""`sylpose calibrate` as typed, on a rendered video of a board, and on real recordings."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.boards.detection import detect
from sylpose.boards.specification import parse_board
from sylpose.commands.main import main
from sylpose.io.capture import open_session
from sylpose.io.capture.session import open_uncalibrated
from sylpose.io.rig_files import load_calibration
from sylpose.rig import Rig
from sylpose.runs.calibrate import choose_unit, complete_board
from sylpose.simulate import Actor, Scene, arc
from sylpose.simulate.recordings import write_sequence
from tests.boards.drawing import compute_middle, make_plate
from tests.paths import DATA

BOARD = "charuco:5x4,square=40mm,marker=30mm,dict=4X4_50"
FRAMES = 26
REAL_BOARD = "charuco:4x5,square=54mm,marker=40.5mm,dict=4X4_50,inverted=1"


def run(*args: object) -> int:
    return main(["calibrate", *map(str, args)])


def move(frame: float) -> RigidTransform:
    """Return the pose of a board that is carried about and tilted, facing the cameras at negative z."""
    t = 0.9 * frame
    tilt = Rotation.from_rotvec([0.7 * np.sin(1.3 * t), 0.7 * np.cos(t), 0.4 * np.sin(0.7 * t)])
    place = [0.14 * np.sin(0.8 * t), 0.1 * np.cos(1.7 * t), 0.1 * np.sin(0.9 * t)]
    rotation = tilt * Rotation.from_rotvec([np.pi, 0, 0])
    middle = compute_middle(parse_board(BOARD, "m"))
    return RigidTransform.from_components(place - rotation.apply(middle), rotation)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    board = parse_board(BOARD, "m")
    rig = Rig(arc(2, 40.0, 0.6, 620.0, (480, 360), distortion=(-0.09, 0.02, 0.0003, -0.0002, 0.0)).cameras, "m")
    folder = tmp_path_factory.mktemp("board") / "recording"
    write_sequence(folder, Scene(rig, (Actor(make_plate(board), move),), FRAMES, seed=0))
    (folder / "calibration.toml").rename(folder.parent / "truth.toml")
    return folder


def test_board_is_completed_from_the_images(recording: Path) -> None:
    """The dictionary is found, and the markers' size so well that corners are the same to a fiftieth of a pixel."""
    session = open_uncalibrated(recording)
    text = complete_board(session, "charuco:5x4,square=40mm")
    assert text.startswith("charuco:5x4,square=40mm,dict=4X4_50,marker=")
    found, board = parse_board(text, "m"), parse_board(BOARD, "m")
    assert abs(found.marker_ratio / board.marker_ratio - 1.0) < 0.02
    image, n = next(session.frames(4, 5)).images[0], 0
    assert image is not None
    exact, its = detect(image, session.rig[0], board), detect(image, session.rig[0], found)
    _, rows, own = np.intersect1d(exact.indices, its.indices, return_indices=True)
    n += len(rows)
    assert n > 6
    assert np.abs(exact.pixels[rows] - its.pixels[own]).max() < 0.02
    assert complete_board(session, BOARD) == BOARD
    known = complete_board(session, "charuco:5x4,square=40mm,dict=4X4_50")
    assert parse_board(known, "m").marker_ratio == pytest.approx(found.marker_ratio)
    with pytest.raises(ValueError, match="no markers of any dictionary lie as on this board"):
        complete_board(session, "charuco:9x12,square=40mm")
    with pytest.raises(ValueError, match="square is missing"):
        complete_board(session, "charuco:9x12")


def test_rendered_board_gives_the_rig(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "rig.toml"
    assert run(recording, "--board", BOARD, "--out", file) == 0
    out = capsys.readouterr().out
    assert "Files" in out
    assert "cam_1" in out
    found, truth = load_calibration(file), load_calibration(recording.parent / "truth.toml")
    assert found.unit == "m"
    assert "Standard deviations, those of poses relative to cam_0" in file.read_text(encoding="utf-8")
    relative = [rig[1].camera_from_world * rig[0].camera_from_world.inv() for rig in (found, truth)]
    error = relative[0] * relative[1].inv()
    assert np.degrees(error.rotation.magnitude()) < 0.5
    assert np.linalg.norm(relative[0].translation - relative[1].translation) < 6e-3
    for a, b in zip(found, truth, strict=True):
        assert abs(a.focal / b.focal - 1) < 0.01
        assert a.error_px is not None
        assert a.error_px < 0.3
    page = file.with_suffix(".html").read_text(encoding="utf-8")
    assert page.count("<svg") == 2 + len(found)
    assert "Two halves of the frames" in page
    assert open_session(recording, calibration=file).rig.names == found.names


def test_world_and_unit_of_the_board(recording: Path, tmp_path: Path) -> None:
    """The board of a frame is the world: its pose there is the identity, in millimeters."""
    file = tmp_path / "rig.toml"
    assert run(recording, "--board", BOARD, "--out", file, "--world", BOARD, "--world-frame", 3, "--unit", "mm") == 0
    found, truth = load_calibration(file), load_calibration(recording.parent / "truth.toml")
    expected = truth[0].camera_from_world * move(3)
    assert found.unit == "mm"
    assert np.linalg.norm(found[0].camera_from_world.translation / 1e3 - expected.translation) < 0.01


def test_wrong_input_is_one_sentence(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, text in (
        ((recording,), "--board: a description of the board is missing"),
        ((recording, "--board", "charuco:5x4"), "square is missing"),
        ((recording, "--board", BOARD, "--unit", "parsec"), "parsec"),
        ((tmp_path / "none", "--board", BOARD), "no such folder"),
        ((tmp_path, "--board", BOARD), "no videos"),
        ((recording, "--board", BOARD, "--exclude-camera", "left"), "left"),
    ):
        assert run(*arguments, *(() if text.startswith("--board:") else ("--out", tmp_path / "x.toml"))) == 2
        assert text in capsys.readouterr().err
    (recording / "calibration.toml").write_text("", encoding="utf-8")
    assert run(recording, "--board", BOARD) == 2
    assert "name the file to write with --out FILE" in capsys.readouterr().err
    (recording / "calibration.toml").unlink()


def test_refusal_writes_nothing(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "rig.toml"
    assert run(recording, "--board", BOARD, "--stop", 2, "--out", file) == 1
    assert "nothing was written" in capsys.readouterr().err
    assert not file.exists()


def test_detection_needs_no_lens(recording: Path) -> None:
    """Corners are detected as well with a pinhole of another focal length as with the true lens."""
    board, session = parse_board(BOARD, "m"), open_uncalibrated(recording)
    truth = load_calibration(recording.parent / "truth.toml")
    images = next(iter(session.frames(4, 5))).images
    for camera, other, image in zip(truth, session.rig, images, strict=True):
        assert image is not None
        found = [detect(image, its, board) for its in (camera, other)]
        assert len(found[0].indices) > 4
        np.testing.assert_array_equal(found[0].indices, found[1].indices)
        np.testing.assert_allclose(found[0].pixels, found[1].pixels, atol=0.02)


@pytest.mark.slow
def test_real_board(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Hand-held inverted ChArUco board, webcams that are not synchronized; compared with their calibration."""
    folder = DATA / "board4b"
    if not folder.is_dir():
        pytest.skip("the recording board4b is not here (../shared/data/board4b)")
    file = tmp_path / "rig.toml"
    assert run(folder, "--board", REAL_BOARD, "--out", file) == 0
    assert "cam_1: its images were taken" in capsys.readouterr().out
    found, theirs = load_calibration(file), load_calibration(folder / "calibration.toml")
    for name in ("cam_0", "cam_2", "cam_3"):
        assert abs(found[name].focal / theirs[name].focal - 1) < 0.05
        relative = [rig[name].camera_from_world * rig["cam_0"].camera_from_world.inv() for rig in (found, theirs)]
        assert np.degrees((relative[0] * relative[1].inv()).rotation.magnitude()) < 8.0


def test_real_camera_without_the_board(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = DATA / "board4"
    if not folder.is_dir():
        pytest.skip("the recording board4 is not here (../shared/data/board4)")
    assert run(folder, "--board", REAL_BOARD, "--stop", 12, "--out", tmp_path / "rig.toml") == 1
    assert "cam_1 sees the board in no frame" in capsys.readouterr().err


def test_sources_may_be_image_folders_with_names(recording: Path, tmp_path: Path) -> None:
    images = next(iter(open_uncalibrated(recording).frames(0, 1))).images
    for name in ("first", "second"):
        folder = tmp_path / "images" / name
        folder.mkdir(parents=True)
        for k, image in enumerate(images):
            assert image is not None
            cv2.imwrite(str(folder / f"{k:03}.png"), image)
    session = open_uncalibrated(tmp_path / "images", cameras={"left": "first", "right": "second"}, rate=5.0)
    assert (session.rig.names, session.n_frames, session.rate) == (("left", "right"), 2, 5.0)
    assert [camera.size for camera in session.rig] == [(480, 360)] * 2
    assert open_uncalibrated(tmp_path / "images", without=["first"]).rig.names == ("second",)
    with pytest.raises(ValueError, match=r"without: no camera of .* remains"):
        open_uncalibrated(tmp_path / "images", without=["first", "second"])


def test_units_are_those_of_the_board() -> None:
    assert choose_unit(BOARD, None) == "m"
    assert choose_unit(BOARD, "mm") == "mm"
    assert choose_unit("chessboard:9x6,square=25", None) == ""
