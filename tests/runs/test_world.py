"""`--world`: results in a user-defined world frame are the same up to that transform, for all definitions."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform

from sylpose.archive.recordings import TrackingOptions, find_recordings
from sylpose.archive.worker import track_recording
from sylpose.boards.specification import parse_board
from sylpose.commands.main import main
from sylpose.io import calibration
from sylpose.io.calibration.world import load_world
from sylpose.io.capture import open_session
from sylpose.report.files import read_trajectory, read_tum
from sylpose.results import Trajectory
from sylpose.rig import Rig
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.runs.world import WorldSpec, apply_world_and_unit, resolve_session_world, resolve_world
from sylpose.simulate import render_frames, write_sequence
from sylpose.tracking.tracker import track
from tests.boards.drawing import make_floor_scene

pytestmark = pytest.mark.usefixtures("undrawn")

TAG = "apriltag:36h11,id=5,size=140mm"
FRAMES = 6


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of the demo's block with a tag on the floor; tag.npy is world_from_board."""
    folder = tmp_path_factory.mktemp("floor") / "recording"
    scene, world_from_board = make_floor_scene(parse_board(TAG, "m"), frames=FRAMES)
    write_sequence(folder, scene)
    np.save(folder / "tag.npy", world_from_board.as_matrix())
    return folder


@pytest.fixture(scope="module")
def world_from_tag(recording: Path) -> RigidTransform:
    return RigidTransform(np.load(recording / "tag.npy"))


@pytest.fixture(scope="module")
def as_calibrated(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results in the calibration's world."""
    out = tmp_path_factory.mktemp("results") / "plain"
    assert sylpose("track", recording, "--out", out, "--no-overlay", "-q") == 0
    return out


@pytest.fixture(scope="module")
def on_the_tag(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results in the tag's world."""
    out = tmp_path_factory.mktemp("results") / "tag"
    assert sylpose("track", recording, "--out", out, "--no-overlay", "-q", "--world", TAG) == 0
    return out


def sylpose(*arguments: object) -> int:
    """Run a command and return its exit code."""
    return main([str(argument) for argument in arguments])


def difference(a: RigidTransform, b: RigidTransform) -> tuple[float, float]:
    """Return the rotation angle in degrees and the distance between two transforms."""
    between = a * b.inv()
    return float(np.degrees(between.rotation.magnitude())), float(np.linalg.norm(a.translation - b.translation))


def compared(plain: Trajectory, told: Trajectory, world: RigidTransform, scale: float = 1.0) -> None:
    """Check that a trajectory is another one in a world frame; object axes equal the world's in the first frame."""
    turn = RigidTransform.from_rotation(world.rotation.inv())
    about = world.rotation.as_matrix()
    assert [pose.status for pose in plain] == [pose.status for pose in told]
    solved = 0
    for before, after in zip(plain, told, strict=True):
        if before.world_from_object is None or after.world_from_object is None:
            continue
        expected = world * before.world_from_object * turn
        expected = RigidTransform.from_components(scale * expected.translation, expected.rotation)
        degrees, length = difference(after.world_from_object, expected)
        sd = before.sigma
        # Equal up to rounding, which can change inliers and so a share of the uncertainty.
        assert degrees <= np.degrees(sd[:3].max()) + 1e-6
        assert length <= scale * sd[3:].max() + 1e-6
        # Files have no correlations; the sum of variances over all directions is the same.
        if before.index:
            for part in (slice(0, 3), slice(3, 6)):
                ratio = np.linalg.norm(after.sigma[part]) / np.linalg.norm(sd[part])
                assert 0.8 < ratio / (scale if part.start else 1.0) < 1.25
        solved += 1
    assert solved >= FRAMES - 2
    assert np.linalg.norm(about - np.eye(3)) > 0.5


# --- equal results


def test_results_in_board_world(
    recording: Path, as_calibrated: Path, on_the_tag: Path, world_from_tag: RigidTransform
) -> None:
    world = load_world(on_the_tag / "world.toml", calibration.load(recording / "calibration.toml"))
    degrees, length = difference(world.world_from_calibration, world_from_tag.inv())
    assert degrees < 0.5
    assert length < 0.003
    compared(
        read_trajectory(as_calibrated / "trajectory.csv"),
        read_trajectory(on_the_tag / "trajectory.csv"),
        world.world_from_calibration,
    )
    # z is up: the block is above the floor, while y points down in the calibration's world.
    heights = read_tum(on_the_tag / "trajectory.tum")[1].translation[:, 2]
    assert ((heights > 0.05) & (heights < 0.3)).all()


def test_covariances_rotate_with_world(recording: Path) -> None:
    """Compare full covariances, before they are reduced to standard deviations of axes."""
    session, runs = open_session(recording), []
    for requested in (None, WorldSpec("up=0.1,-1,0.3 origin=0.1,0.2,0")):
        opened = apply_world_and_unit(session, requested, None)
        frames = islice(opened.frames(), 6)
        runs.append((opened, [f.pose for f in track(frames, opened.rig, opened.boxes)]))
    world = runs[1][0].world
    assert world is not None
    turn = block_diag(*[world.world_from_calibration.rotation.as_matrix()] * 2)
    ratios, unrotated = list[float](), list[float]()
    for before, after in zip(runs[0][1], runs[1][1], strict=True):
        if before.index and before.world_from_object is not None and after.world_from_object is not None:
            for of, expected in ((ratios, turn @ before.covariance @ turn.T), (unrotated, before.covariance)):
                of += np.linalg.eigvals(np.linalg.solve(expected, after.covariance)).real.tolist()
    assert len(ratios) >= 12
    # Rounding may select other features.
    assert 0.5 < min(ratios) <= max(ratios) < 2.0
    assert min(unrotated) < 0.1
    assert max(unrotated) > 10


def test_world_definitions_agree(recording: Path, tmp_path: Path, world_from_tag: RigidTransform) -> None:
    """Define it by the board in the recording, in other images, by three points in pixels, and by a direction."""
    rig = calibration.load(recording / "calibration.toml")
    session = open_session(recording)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    scene = make_floor_scene(parse_board(TAG, "m"), frames=FRAMES)[0]
    for name, image in list(zip(rig.names, next(iter(render_frames(scene))), strict=True))[1:]:
        cv2.imwrite(str(pictures / f"{name}.png"), image)
    points = {"origin": (0, 0, 0), "x": (0.07, 0, 0), "xy": (0, 0.07, 0)}
    text = ""
    for name, place in points.items():
        text += f"[{name}]\n"
        for camera in rig:
            text += f"{camera.name} = {camera.project(world_from_tag.apply(place))[0].tolist()}\n"
    (tmp_path / "points.toml").write_text(text)
    up, origin = world_from_tag.rotation.apply([0, 0, 1]), world_from_tag.translation
    words = "up={},{},{} origin={},{},{}".format(*up, *origin)
    found = [resolve_session_world(session, WorldSpec(TAG, frame))[0] for frame in (None, 4)]
    found += [resolve_world(rig, WorldSpec(TAG, images=folder))[0] for folder in (pictures, recording)]
    found.append(resolve_world(rig, WorldSpec(str(tmp_path / "points.toml")))[0])
    for world in found:
        degrees, length = difference(world.world_from_calibration, world_from_tag.inv())
        assert degrees < 0.5
        assert length < 0.003
    direction = resolve_world(rig, WorldSpec(words))[0].world_from_calibration
    np.testing.assert_allclose(direction.apply(origin), 0, atol=1e-9)
    np.testing.assert_allclose(direction.rotation.apply(up), [0, 0, 1], atol=1e-9)


def test_world_file_of_run_is_exact(recording: Path, on_the_tag: Path, tmp_path: Path) -> None:
    """The file is exact, converts units, and is rejected for a calibration that is already in its world."""
    again, other = tmp_path / "again", tmp_path / "mm"
    assert sylpose("track", recording, "--out", again, "--no-overlay", "-q", "--world", on_the_tag / "world.toml") == 0
    for name in ("trajectory.csv", "calibration.used.toml", "world.toml"):
        assert (again / name).read_bytes() == (on_the_tag / name).read_bytes()
    assert f'world = "{TAG}, seen in frame 0 by cam_0' in (again / "settings.toml").read_text()
    options = ("--no-overlay", "-q", "--unit", "mm", "--world", on_the_tag / "world.toml", "--euler", "ZYX")
    assert sylpose("track", recording, "--out", other, *options) == 0
    reported = read_trajectory(other / "trajectory.csv")
    assert reported.unit == "mm"
    before = read_trajectory(on_the_tag / "trajectory.csv")
    for a, b in zip(before, reported, strict=True):
        if a.world_from_object is not None and b.world_from_object is not None:
            assert np.linalg.norm(1000 * a.position - b.position) <= b.sigma[3:].max() + 1e-6
    assert calibration.load(other / "calibration.used.toml").unit == "mm"
    settings = (other / "settings.toml").read_text()
    assert 'unit = "mm"' in settings
    assert "rate = 30.0" in settings


def test_resume_requires_same_world(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, stops = tmp_path / "out", iter(range(100))
    opened = apply_world_and_unit(open_session(recording), WorldSpec(TAG), None)
    with pytest.raises(KeyboardInterrupt):
        track_session(opened, out, RunOptions(overlay=False, checkpoint_seconds=0), interrupted=lambda: next(stops) > 2)
    assert sylpose("track", recording, "--out", out, "--no-overlay", "-q", "--resume") == 2
    assert "calibration changed since the interrupted run" in capsys.readouterr().err
    assert sylpose("track", recording, "--out", out, "--no-overlay", "-q", "--resume", "--world", TAG) == 0
    whole = tmp_path / "whole"
    assert sylpose("track", recording, "--out", whole, "--no-overlay", "-q", "--world", TAG) == 0
    assert (out / "trajectory.csv").read_bytes() == (whole / "trajectory.csv").read_bytes()


def test_stale_world_file_is_removed(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for options, there in ((("--world", "up=-y"), True), ((), False)):
        assert (
            sylpose("track", recording, "--out", out, "--no-overlay", "-q", "--no-smooth", "--stop", 3, *options) == 0
        )
        assert (out / "world.toml").exists() == there


# --- other commands


def test_views_are_independent_of_world(recording: Path, on_the_tag: Path, as_calibrated: Path, tmp_path: Path) -> None:
    """Also with a camera of the original calibration; a virtual camera is upright with z up."""
    used, given, plain = tmp_path / "used", tmp_path / "given", tmp_path / "plain"
    assert sylpose("view", on_the_tag, "cam_1", "--out", used) == 0
    assert sylpose("view", on_the_tag, "cam_1", "--out", given, "--calibration", recording / "calibration.toml") == 0
    assert sylpose("view", as_calibrated, "cam_1", "--out", plain) == 0
    ways = [read_tum(folder / "view_cam_1.tum")[1] for folder in (used, given, plain)]
    for way in ways[1:]:
        np.testing.assert_allclose(way.translation, ways[0].translation, atol=1e-3)
    assert sylpose("view", on_the_tag, "side", "--from", 0.3, -1, 0.15, "--at", 0, 0, 0.15, "--out", used) == 0
    # The camera looks along the floor: its y axis is opposite to the world's z axis.
    seen, there = read_tum(used / "view_side.tum")[1], read_tum(on_the_tag / "trajectory.tum")[1]
    np.testing.assert_allclose(np.diff(seen.translation[:, 1]), -np.diff(there.translation[:, 2]), atol=1e-9)


def test_convert_calibration_to_world(recording: Path, on_the_tag: Path, tmp_path: Path) -> None:
    from_board, from_file = tmp_path / "board.toml", tmp_path / "file.yml"
    assert (
        sylpose(
            "calibration",
            "convert",
            recording / "calibration.toml",
            from_board,
            "--world",
            TAG,
            "--world-from",
            recording,
        )
        == 0
    )
    assert from_board.read_bytes() == (on_the_tag / "calibration.used.toml").read_bytes()
    options = ("--world", on_the_tag / "world.toml", "--unit", "mm")
    assert sylpose("calibration", "convert", recording / "calibration.toml", from_file, *options) == 0
    for a, b in zip(calibration.load(from_board), calibration.load(from_file), strict=True):
        np.testing.assert_allclose(1000 * a.center, b.center, rtol=1e-12)


def test_check_plots_world_and_writes_file(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert sylpose("check", recording, "--out", tmp_path, "--world", TAG) == 0
    message = capsys.readouterr().out
    assert f"World         {TAG}, seen in frame 0 by cam_0, cam_1, cam_2, sd" in " ".join(message.split("\n"))
    picture = cv2.imread(str(tmp_path / "world.png"))
    assert picture is not None
    assert picture.shape == (360, 3 * 480, 3)
    # Axes in red, green and blue, as in the overlay.
    for color in ((70, 70, 255), (80, 220, 60), (255, 140, 50)):
        assert (np.abs(picture.astype(int) - color).max(axis=2) < 12).sum() > 30
    assert load_world(tmp_path / "world.toml", calibration.load(recording / "calibration.toml")).description.startswith(
        TAG
    )


def test_batch_with_world(recording: Path, on_the_tag: Path, tmp_path: Path) -> None:
    options = TrackingOptions(stop=3, smooth=False, overlay=False, unit="mm", world=str(on_the_tag / "world.toml"))
    ((found,), _) = find_recordings([str(recording)], options)
    summary = track_recording(found, tmp_path, 1)
    assert summary.status == "done"
    reported = calibration.load(tmp_path / "results" / "calibration.used.toml")
    for a, b in zip(reported, calibration.load(on_the_tag / "calibration.used.toml"), strict=True):
        np.testing.assert_allclose(a.center, 1000 * b.center, rtol=1e-9)
    assert read_trajectory(tmp_path / "results" / "trajectory.csv").unit == "mm"


# --- invalid worlds


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--world", "apriltag:36h11,id=6,size=140mm"), "no camera sees it in frame 0"),
        (("--world", "apriltag:36h11,id=5,size=14cm", "--world-frame", "8"), "the recording has frames 0 to 5"),
        (("--world", "apriltag:36h11,id=5,size=70mm"), "the board appears 2 times as large"),
        (("--world", "apriltag:36h11,id=5"), "size is missing; expected one such as apriltag:36h11,id=3,size=80mm"),
        (
            ("--world", TAG, "--world-from", "nowhere"),
            "nowhere: no such folder; --world-from must be a folder with images",
        ),
        (("--world", "nothing.toml"), "neither an existing file, nor a board such as charuco:5x7"),
        (("--world", "up=0,0,0"), "--world must be a direction"),
        (
            ("--world", "up=-y", "--world-frame", "1"),
            "--world-frame and --world-from require a board, but --world up=-y is none",
        ),
        (("--world-frame", "1"), "--world-frame and --world-from require --world"),
    ],
)
def test_invalid_worlds(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], said: str
) -> None:
    assert sylpose("check", recording, "--out", tmp_path, *options) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.startswith("sylpose: ")
    assert error.count("\n") == 1
    assert [*tmp_path.iterdir()] == []


def test_calibration_without_unit_message(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = tmp_path / "project" / "videos"
    session.mkdir(parents=True)
    for video in recording.glob("*.mp4"):
        (session / video.name).symlink_to(video)
    calibration.save(
        Rig(calibration.load(recording / "calibration.toml").cameras), tmp_path / "project/calibration.toml"
    )
    given = ("--calibration", tmp_path / "project/calibration.toml", "--out", tmp_path)
    message = {
        (
            "--unit",
            "mm",
        ): "does not state its unit; set it with sylpose calibration convert IN OUT --is-in m",
        (
            "--world",
            TAG,
        ): "size is in mm, but the calibration has no unit: give the length in calibration units, without a unit",
    }
    for options, words in message.items():
        assert sylpose("check", session, *given, *options) == 2
        error = capsys.readouterr().err
        assert error.strip().endswith(words)
    assert sylpose("check", session, *given, "--world", "apriltag:36h11,id=5,size=0.14") == 0
    assert sylpose("check", tmp_path) == 0  # the videos and the calibration of a project are found


def test_invalid_board_images(recording: Path, tmp_path: Path) -> None:
    rig = calibration.load(recording / "calibration.toml")
    for name, message in (
        ("else", "contains no image, video or image folder of cam_0, cam_1, cam_2"),
        ("cam_0", "not 320x240 pixels"),
    ):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((48, 64), np.uint8))
        with pytest.raises(ValueError, match=message):
            resolve_world(rig, WorldSpec(TAG, images=tmp_path))
    with pytest.raises(ValueError, match="--world-from DIR, with images of the board, is missing"):
        resolve_world(rig, WorldSpec(TAG))
