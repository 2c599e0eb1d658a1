"""Frame and size of an object: set by points, planes and extents, with their uncertainty, and applied to results."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.rendered_recordings import Recording, write_recording
from sylpose.boards.specification import parse_board
from sylpose.commands.main import main
from sylpose.io.capture import open_session
from sylpose.io.object_files import CLOUD_FILE, OBJECT_FILE, load_object, save_object
from sylpose.report.files import read_trajectory, write_trajectory
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Rig
from sylpose.runs.object_frames import change_object_frame
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.runs.run_metadata import USED_CALIBRATION
from sylpose.simulate import Actor, Scene, chamfered_box
from sylpose.status import FrameStatus, Observability
from sylpose.tracking.known_object import KnownObject
from sylpose.units import INITIAL_DISTANCES
from tests.recordings import (
    BOX,
    RIG,
    attach_target,
    compute_pose_error,
    mapping_path,
    moved_path,
    slide,
    write_box_recording,
)

pytestmark = pytest.mark.usefixtures("undrawn")

NEW_FROM_OBJECT = RigidTransform.from_components([0.5, -0.3, 0.2], Rotation.from_rotvec([0.5, -1.0, 0.8]))
# Corners of the box in the actor's frame: an origin, one along the longest edge, one along the second.
CORNERS = np.array([[-1, -1, 1], [1, -1, 1], [-1, 1, 1]]) * np.array(BOX) / 2


def seen_at(
    point: np.ndarray, frame: int, cameras: Sequence[str], off: Sequence[float] | np.ndarray = (0.0, 0.0)
) -> str:
    """Return the pixel specification of a point of the actor, with an offset in pixels."""
    place = mapping_path(frame).apply(point)
    pixels = {name: RIG[name].project(place)[0] + off for name in cameras}
    return f"@{frame} " + " ".join(f"{name}={u:.2f},{v:.2f}" for name, (u, v) in pixels.items())


def frame_of(first: Path, out: Path, *options: str) -> KnownObject:
    assert main(["object", "frame", str(first / "sylpose" / OBJECT_FILE), str(out / "tool.npz"), *options]) == 0
    return load_object(out / "tool.npz")


def on_a_face(frame: int) -> tuple[np.ndarray, int, float]:
    """Return three points (actor's frame) on the face that cam_1 sees best, its normal axis and its offset.

    The points are an origin and points 6 cm along two edges.
    """
    eye = mapping_path(frame).inv().apply(RIG["cam_1"].center)
    side = int(np.argmax(np.abs(eye) / np.array(BOX)))
    a, b = [k for k in range(3) if k != side]
    points = np.zeros((3, 3))
    points[:, side] = face = np.sign(eye[side]) * BOX[side] / 2
    points[1, a], points[2, b] = 0.06, 0.06
    return points, side, float(face)


def turned_to(points: np.ndarray) -> RigidTransform:
    """Return the frame defined by three points."""
    x, y = points[1] - points[0], points[2] - points[0]
    axes = np.column_stack([x, y, np.cross(x, y)])
    return RigidTransform.from_rotation(Rotation.from_matrix(axes / np.linalg.norm(axes, axis=0)))


def actor_from_new(known: KnownObject, new: KnownObject, actor_from_object: RigidTransform) -> RigidTransform:
    return actor_from_object * (new.frame.from_learned * known.frame.from_learned.inv()).inv()


# --- poses in a new frame
# -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "smooth", [pytest.param(False, id="tracked", marks=pytest.mark.slow), pytest.param(True, id="smoothed")]
)
def test_poses_in_new_object_frame(tmp_path: Path, known: KnownObject, smooth: bool) -> None:
    """Results are equal up to rounding, with the same uncertainty: no decision depends on the frame."""
    session = open_session(write_box_recording(tmp_path / "take", moved_path, 4, seed=5))
    tool = known.to_frame(NEW_FROM_OBJECT, description="by hand")
    runs = [
        track_session(session, tmp_path / f"out{k}", RunOptions(overlay=False, smooth=smooth, known=its))
        for k, its in enumerate((known, tool))
    ]
    for a, b in zip(*(run.trajectory for run in runs), strict=True):
        assert a.world_from_object is not None
        assert b.world_from_object is not None
        assert (a.status, a.observability) == (b.status, b.observability)
        np.testing.assert_array_equal(a.inliers, b.inliers)
        np.testing.assert_allclose(
            (a.world_from_object * NEW_FROM_OBJECT.inv()).as_matrix(), b.world_from_object.as_matrix(), atol=1e-13
        )
        # The Mahalanobis distance of an error is the same in both frames.
        off = 1e-4 * np.random.default_rng(a.index).normal(size=6)
        wrong = RigidTransform.from_components(
            a.position + off[3:], Rotation.from_rotvec(off[:3]) * a.world_from_object.rotation
        )
        as_told = compute_pose_error(b, wrong * NEW_FROM_OBJECT.inv())
        squares = [e @ np.linalg.solve(p.covariance, e) for e, p in ((compute_pose_error(a, wrong), a), (as_told, b))]
        assert squares[1] == pytest.approx(squares[0], rel=2e-3)  # rotations are only approximately vectors
    # The model of the new run is expressed in the requested frame.
    again = load_object(tmp_path / "out1" / OBJECT_FILE)
    assert (again.fingerprint, again.frame.description) == (known.fingerprint, "by hand")
    np.testing.assert_array_equal(again.frame.from_learned.as_matrix(), tool.frame.from_learned.as_matrix())
    plain = load_object(tmp_path / "out0" / OBJECT_FILE)
    np.testing.assert_allclose(NEW_FROM_OBJECT.apply(plain.positions), again.positions, atol=1e-12)


def test_covariance_in_new_frame_matches_monte_carlo() -> None:
    rng = np.random.default_rng(4)
    root = rng.normal(size=(6, 6))
    covariance = 1e-6 * root @ root.T
    pose = FramePose(
        0, 0.0, FrameStatus.TRACKED, RigidTransform.identity(), covariance, np.ones(1, np.int64), np.zeros(1)
    )
    reported = pose.in_object_frame(NEW_FROM_OBJECT)
    draws = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    poses = RigidTransform.from_components(draws[:, 3:], Rotation.from_rotvec(draws[:, :3])) * NEW_FROM_OBJECT.inv()
    off = np.hstack([draws[:, :3], poses.translation - reported.position])
    np.testing.assert_allclose(np.cov(off.T), reported.covariance, atol=0.1 * np.diag(reported.covariance).max())
    # Rotation uncertainty adds to that of positions away from the origin; the file only has standard deviations.
    open_turn = replace(pose, covariance=np.diag([1e-6, 1e-6, np.inf, 1e-6, 1e-6, 1e-6]))
    assert np.isinf(open_turn.in_object_frame(NEW_FROM_OBJECT).sigma[[2, 3, 4]]).all()
    assert (
        change_object_frame(replace(pose, covariance=np.diag(np.diag(covariance))), NEW_FROM_OBJECT).sigma
        >= reported.sigma
    ).all()
    assert np.isfinite(change_object_frame(open_turn, RigidTransform.identity()).sigma[3:]).all()


# --- frame definitions
# --------------------------------------------------------------------------------------------------


def test_three_points_from_pixels_of_two_cameras(
    first: Path,
    known: KnownObject,
    actor_from_object: RigidTransform,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    rng, arguments = np.random.default_rng(7), []
    for option, corner in zip(("--origin", "--x", "--xy"), CORNERS, strict=True):
        arguments += [option, seen_at(corner, 20, RIG.names[:3], rng.normal(size=2))]
    new = frame_of(first, tmp_path, *arguments)
    assert "three points" in capsys.readouterr().out
    found = actor_from_new(known, new, actor_from_object)
    true = RigidTransform.from_components(CORNERS[0], Rotation.identity())
    off = (true.inv() * found).inv()
    wrong = np.concatenate([off.rotation.as_rotvec(), off.translation])
    assert np.degrees(np.linalg.norm(wrong[:3])) < 1.5
    assert np.linalg.norm(wrong[3:]) < 0.005
    assert (np.abs(wrong) < 4 * new.frame.sd).all()
    assert np.degrees(new.frame.sd[:3]).max() < 3.0
    assert new.frame.sd[3:].max() < 0.015
    assert (tmp_path / "tool.ply").stat().st_size > 1000


def test_pixels_of_one_camera_use_surface(
    first: Path, known: KnownObject, actor_from_object: RigidTransform, tmp_path: Path
) -> None:
    """Pick points on a face that the camera sees."""
    frame = 3
    points, side, face = on_a_face(frame)
    arguments = []
    for option, point in zip(("--origin", "--x", "--xy"), points, strict=True):
        arguments += [option, seen_at(point, frame, ["cam_1"])]
    new = frame_of(first, tmp_path, *arguments)
    places = actor_from_new(known, new, actor_from_object).apply([[0, 0, 0], [0.06, 0, 0], [0, 0.06, 0]])
    assert np.abs(places[:, side] - face).max() < 0.006
    assert np.linalg.norm(places - points, axis=1).max() < 0.008
    assert 0.0005 < np.linalg.norm(new.frame.sd[3:]) < 0.02


def test_largest_plane_is_a_face(
    first: Path, known: KnownObject, actor_from_object: RigidTransform, tmp_path: Path
) -> None:
    new = frame_of(first, tmp_path, "--plane", "largest")
    found = actor_from_new(known, new, actor_from_object)
    normal = found.rotation.apply([0, 0, 1.0])
    side = int(np.argmax(np.abs(normal)))
    assert np.degrees(np.arccos(np.abs(normal[side]))) < 0.6
    assert found.translation[side] == pytest.approx(np.sign(normal[side]) * BOX[side] / 2, abs=0.002)  # outward
    # A landmark of another face selects that face; the origin is projected into it, X points to a point.
    there = actor_from_object.inv().apply(np.roll(np.eye(3), 1, axis=1)[side] * np.array(BOX) / 2)
    near = "near " + ",".join(f"{v:.4f}" for v in there)
    options = ("--plane", near, "--origin", near, "--x", "0,0,0.5")
    other = actor_from_new(known, frame_of(first, tmp_path, *options), actor_from_object)
    assert np.abs(other.rotation.apply([0, 0, 1.0])).argmax() != side
    assert np.abs(other.rotation.apply([0, 0, 1.0])).max() > np.cos(np.radians(1.5))
    towards = other.inv().apply(actor_from_object.apply([0, 0, 0.5]))
    assert towards[1] == pytest.approx(0.0, abs=1e-9)
    assert towards[0] > 0


def test_extent_and_rotations(first: Path, known: KnownObject, tmp_path: Path) -> None:
    new = frame_of(first, tmp_path, "--extent")
    good = new.positions[new.depth_sd < 0.1 * new.radius]
    spread = good.std(axis=0)
    assert spread[0] > spread[1] > spread[2]
    assert np.linalg.norm(np.median(good, axis=0)) < 0.3 * new.radius
    assert 0.0 < new.frame.sd[:3].max() < 0.3
    assert main(["object", "frame", str(tmp_path / "tool.npz"), str(tmp_path / "two.npz"), "--turn", "0,0,90"]) == 0
    two = load_object(tmp_path / "two.npz")
    np.testing.assert_allclose(
        two.positions, new.positions @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), atol=1e-12
    )
    # The uncertainty is unchanged, but about the new axes.
    np.testing.assert_allclose(two.frame.sd, new.frame.sd[[1, 0, 2, 4, 3, 5]], rtol=0.5)
    assert "axes rotated" in two.frame.description
    moved = frame_of(first, tmp_path, "--origin", "0.1,0,-0.05")
    np.testing.assert_allclose(moved.positions, known.positions - [0.1, 0, -0.05], atol=1e-12)
    assert not moved.frame.sd.any()


def test_object_show(first: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["object", "show", str(first / "sylpose" / OBJECT_FILE)]) == 0
    message = capsys.readouterr().out
    known = load_object(first / "sylpose" / OBJECT_FILE)
    # The bound is a tenth of the radius, and the medians of the precise landmarks are below it.
    bound, unit = re.findall(r"with a depth sd below ([0-9.]+) (m+)", message)[0]
    assert float(bound) / {"mm": 1000, "m": 1}[unit] == pytest.approx(0.1 * known.radius, rel=0.01)
    medians = re.findall(r"(?m)^cam_\d +\d+ +\d+ +([0-9.]+) mm", message)
    assert len(medians) == len(known._cameras)
    assert all(0.0 < float(sd) < 100.0 * known.radius for sd in medians)
    for words in ("landmarks", "their median sd", "Keyframes", "Radius", "Extent", "Unit          m", "cam_0", "cam_3"):
        assert words in message


# --- boards on it
# ------------------------------------------------------------------------------------------------------

MARKER = "apriltag:36h11,id=5,size=90mm"
# At the center of the face that faces the cameras.
ACTOR_FROM_BOARD = RigidTransform.from_components(
    [0.02, -0.01, -BOX[2] / 2], Rotation.from_matrix([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
)


@pytest.fixture(scope="module")
def with_marker(
    tmp_path_factory: pytest.TempPathFactory, first: Path, known: KnownObject, actor_from_object: RigidTransform
) -> Path:
    """Return a recording of the object with a marker on it, and a result close to the ground truth."""
    folder = tmp_path_factory.mktemp("marked") / "take"
    body = attach_target(chamfered_box(BOX, 600), parse_board(MARKER, "m"), ACTOR_FROM_BOARD)
    write_recording(Recording(Scene(RIG, (Actor(body, moved_path),), 6, 3)), folder)
    some = np.ones(4, np.int64), np.full(4, 0.2)
    poses = [
        FramePose(
            k, k / 30, FrameStatus.TRACKED, moved_path(k) * actor_from_object, np.diag([1e-6] * 3 + [1e-7] * 3), *some
        )
        for k in range(6)
    ]
    write_trajectory(folder / "sylpose", Trajectory(poses, RIG.names, "m"))
    save_object(known, folder / "sylpose" / OBJECT_FILE)
    shutil.copy(first / "sylpose" / USED_CALIBRATION, folder / "sylpose")
    return folder


def test_marker_defines_frame(
    with_marker: Path, known: KnownObject, actor_from_object: RigidTransform, tmp_path: Path
) -> None:
    arguments = ["--board", MARKER, "--recording", str(with_marker)]
    new = frame_of(with_marker, tmp_path, *arguments)
    off = (ACTOR_FROM_BOARD.inv() * actor_from_new(known, new, actor_from_object)).inv()
    wrong = np.concatenate([off.rotation.as_rotvec(), off.translation])
    assert np.degrees(np.linalg.norm(wrong[:3])) < 1.0
    assert np.linalg.norm(wrong[3:]) < 0.002
    assert (np.abs(wrong) < 4 * new.frame.sd).all()
    assert np.degrees(new.frame.sd[:3]).max() < 2.0
    assert MARKER in new.frame.description


@pytest.mark.parametrize(
    ("board", "words"),
    [
        ("apriltag:36h11,id=6,size=90mm", "of 6 frames of .* it was detected in none"),
        ("apriltag:36h11,id=5", "size is missing"),
        ("chessboard:8x6,square=20mm", "it is symmetric under a rotation"),
        ("paper", "is not a board or marker"),
    ],
)
def test_invalid_boards(
    board: str, words: str, with_marker: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(with_marker / "sylpose" / OBJECT_FILE)
    arguments = ["object", "frame", file, str(tmp_path / "tool.npz"), "--board", board, "--recording", str(with_marker)]
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert re.search(words, err)
    assert err.count("\n") == 1


def test_board_not_attached_to_object_is_rejected(
    with_marker: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Use poses of another object."""
    take = Path(shutil.copytree(with_marker, tmp_path / "take"))
    poses = [
        replace(
            pose,
            world_from_object=slide(5 * pose.index) * RigidTransform.from_rotation(Rotation.from_rotvec([0, k, 0])),
        )
        for k, pose in enumerate(read_trajectory(take / "sylpose" / "trajectory.csv"))
    ]
    write_trajectory(take / "sylpose", Trajectory(poses, RIG.names, "m"))
    file = str(take / "sylpose" / OBJECT_FILE)
    arguments = ["object", "frame", file, str(tmp_path / "tool.npz"), "--board", MARKER, "--recording", str(take)]
    assert main(arguments) == 2
    assert "not attached, or hardly visible" in capsys.readouterr().err


# --- size
# ---------------------------------------------------------------------------------------------------------------


def test_measured_lengths_are_compared(first: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(first / "sylpose" / OBJECT_FILE)
    ends = [seen_at(corner, 20, RIG.names[:3]) for corner in CORNERS[:2]]
    arguments = ["object", "scale", file, "--between", *ends, "--distance", "0.28"]
    assert main(arguments) == 0
    off = float(re.search(r"Error\s+([+-][\d.]+) %", capsys.readouterr().out)[1])  # type: ignore[index]
    assert off == pytest.approx(100 * (0.3 / 0.28 - 1), abs=0.6)
    assert main([*arguments[:3], str(tmp_path / "tool.npz"), *arguments[3:]]) == 2
    err = capsys.readouterr().err
    assert "its lengths were measured by calibrated cameras" in err
    assert err.count("\n") == 1
    assert not (tmp_path / "tool.npz").exists()
    assert main([*arguments, "--unit", "mm"]) == 2
    assert "--unit mm: the object's lengths are in m" in capsys.readouterr().err


@pytest.fixture(scope="module")
def by_one(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of a single camera."""
    folder = write_box_recording(tmp_path_factory.mktemp("one") / "take", mapping_path, 30, rig=RIG.subset(["cam_1"]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sylpose.report.plots.save_trajectory_plot", lambda *_, **__: None)
        track_session(open_session(folder), options=RunOptions(overlay=False, smooth=False))
    return folder


def test_scale_of_single_camera_object(by_one: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With a size the object's distance is observable; without, other cameras cannot use the model."""
    file = by_one / "sylpose" / OBJECT_FILE
    known = load_object(file)
    assert known.unit == INITIAL_DISTANCES
    four = write_box_recording(tmp_path / "four", moved_path, 2, seed=5)
    assert main(["track", str(four), "--object", str(file)]) == 2
    assert "a single camera learned it" in capsys.readouterr().err
    frame, (points, _, _) = 3, on_a_face(3)
    arguments = [seen_at(point, frame, ["cam_1"]) for point in points]
    at = ["object", "frame", str(file), str(tmp_path / "framed.npz")]
    assert (
        main([*at, "--origin", arguments[0], "--x", arguments[1], "--xy", arguments[2], "--result", str(file.parent)])
        == 0
    )
    at = ["object", "scale", str(tmp_path / "framed.npz"), str(tmp_path / "tool.npz"), "--between", *arguments[1:]]
    apart = float(np.linalg.norm(points[2] - points[1]))
    assert main([*at, "--result", str(file.parent), "--distance", f"{apart:.6f}", "--unit", "m"]) == 0
    capsys.readouterr()
    sized = load_object(tmp_path / "tool.npz")
    assert sized.unit == "m"
    assert 0.001 < sized.scale_sd < 0.1
    actor_from_frame = RigidTransform.from_translation(points[0]) * turned_to(points)
    again = write_box_recording(tmp_path / "again", moved_path, 4, seed=5, rig=RIG.subset(["cam_1"]))
    for smooth in (False, True):
        run = track_session(open_session(again), options=RunOptions(overlay=False, smooth=smooth, known=sized))
        assert run.trajectory.unit == "m"
        assert all(pose.is_measured and pose.observability is Observability.ALL for pose in run.trajectory)
        wrong = np.array(
            [compute_pose_error(pose, moved_path(pose.index) * actor_from_frame) for pose in run.trajectory]
        )
        assert np.linalg.norm(wrong[:, 3:], axis=1).max() < 0.06  # of 1.5 m
        squares = []
        for off, pose in zip(wrong, run.trajectory, strict=True):
            assert pose.world_from_object is not None
            axes = block_diag(*[pose.world_from_object.rotation.as_matrix()] * 2)
            squares.append(off @ np.linalg.solve(pose.covariance + axes @ np.diag(sized.frame.sd**2) @ axes.T, off) / 6)
        assert 0.001 < np.mean(squares) < 3.0  # the clicks are more precise than assumed
        assert max(np.linalg.norm(pose.sigma[3:]) for pose in run.trajectory) < 0.3
    with pytest.raises(ValueError, match="calibrated cameras measured its lengths"):
        sized.scaled(2.0, "m")


# --- finished results
# ---------------------------------------------------------------------------------------------------


def test_apply_object_frame_to_result(
    first: Path, known: KnownObject, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_object(known.to_frame(NEW_FROM_OBJECT), tmp_path / "tool.npz")
    before = {file: file.read_bytes() for file in (first / "sylpose").iterdir() if file.is_file()}
    result, out = str(first / "sylpose"), tmp_path / "out"
    assert main(["object", "apply", str(tmp_path / "tool.npz"), result, str(out)]) == 0
    a, b = (read_trajectory(folder / "trajectory.csv") for folder in (first / "sylpose", out))
    for one, other in zip(a, b, strict=True):
        assert one.status is other.status
        if one.world_from_object is None or other.world_from_object is None:
            assert one.world_from_object is other.world_from_object
            continue
        reported = one.world_from_object * NEW_FROM_OBJECT.inv()
        np.testing.assert_allclose(other.world_from_object.as_matrix(), reported.as_matrix(), atol=1e-9)
        assert (other.sigma[3:] >= one.sigma[3:] - 1e-12).all()
    assert {file: file.read_bytes() for file in before} == before
    # The result has the new frame and the calibration for views; applying the old frame restores the original.
    assert main(["view", str(out), "cam_1"]) == 0
    assert main(["object", "apply", result + f"/{OBJECT_FILE}", str(out), str(tmp_path / "back")]) == 0
    for one, other in zip(a, read_trajectory(tmp_path / "back" / "trajectory.csv"), strict=True):
        np.testing.assert_allclose(other.position, one.position, atol=1e-9)
    capsys.readouterr()
    for folder in (result, str(tmp_path)):
        assert main(["object", "apply", str(tmp_path / "tool.npz"), result, folder]) == 2
        assert "contains the results of a run, or the object" in capsys.readouterr().err


# --- invalid input
# ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "no frame is given"),
        (["--x", "0,0,0"], "no frame is given"),
        (["--xy", "0,0,0", "--x", "1,0,0"], "--xy requires three points"),
        (["--extent", "--turn", "0,0,1"], "--extent and --turn: these options cannot be combined"),
        (["--extent", "--origin", "0,0,0"], "--extent and --origin: these options cannot be combined"),
        (["--origin", "0,0,0", "--x", "1,0,0"], "--x: these options cannot be combined"),
        (["--turn", "0,0,1", "--x", "1,0,0"], "--turn and --x: these options cannot be combined"),
        (["--board", "apriltag:36h11,id=3,size=8"], "--board and --recording"),
        (["--turn", "0,0"], "--turn: expected three angles in degrees"),
        (["--turn", "0,0,nan"], "--turn: expected three angles in degrees"),
        (["--origin", "0,0"], '--origin "0,0": expected 3 numbers separated by commas'),
        (["--origin", "here"], '--origin "here": expected 3 numbers separated by commas'),
        (["--origin", "near"], '--origin "near": expected 3 numbers'),
        (["--origin", "@x cam_0=1,2"], "a point is"),
        (["--origin", "@3"], "a point is"),
        (["--origin", "@3 cam_0"], "a point is"),
        (["--origin", "@3 cam_0=1"], "expected 2 numbers separated by commas"),
        (["--origin", "@3 cam_9=1,2"], "no camera cam_9 in"),
        (["--origin", "@900 cam_0=1,2"], "the object's pose in frame 900 is unknown"),
        (["--origin", "@3 cam_0=1,2"], "no landmark of cam_0 is near that ray"),
        (["--origin", "@3 cam_0=240,180 cam_2=100,20"], "miss each other by"),
        (["--origin", "0,0,0", "--x", "0,0,0", "--xy", "1,0,0"], "are the same"),
        (["--origin", "0,0,0", "--x", "1,0,0", "--xy", "2,0,0"], "lie on a line"),
        (["--plane", "9,9,9"], "--plane: 0 landmarks are too few for a plane"),
    ],
)
def test_invalid_object_frames(
    options: list[str], words: str, first: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["object", "frame", str(first / "sylpose" / OBJECT_FILE), str(tmp_path / "tool.npz"), *options]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_results_of_other_objects_are_rejected(
    first: Path, known: KnownObject, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_object(replace(known, fingerprint="abc"), tmp_path / "other.npz")
    file = str(first / "sylpose" / OBJECT_FILE)
    reported = ["--origin", "@3 cam_0=240,180"]
    at = ["object", "frame", str(tmp_path / "other.npz"), str(tmp_path / "tool.npz"), *reported]
    assert main([*at, "--result", str(first / "sylpose")]) == 2
    assert "the run has another object, or learned this one again" in capsys.readouterr().err
    assert main(at) == 2  # no trajectory next to it
    assert ": no result in it; expected a recording that was tracked" in capsys.readouterr().err
    assert main(["object", "frame", file, str(tmp_path / "tool.txt"), "--extent"]) == 2
    assert "tool.txt: the suffix of an object file must be .npz" in capsys.readouterr().err
    save_object(replace(known, rig=Rig(RIG.cameras, "mm")), tmp_path / "mm.npz")
    assert main(["object", "apply", str(tmp_path / "mm.npz"), str(first / "sylpose"), str(tmp_path / "o" / "out")]) == 2
    assert "its lengths are in m, those of the object in mm" in capsys.readouterr().err
    assert main(["object", "scale", file, "--between", "0,0,0", "0,0,0", "--distance", "1"]) == 2
    assert "--between: the two points coincide" in capsys.readouterr().err
    for more in (
        ["--distance", "1"],
        ["--between", "0,0,0", "1,0,0"],
        ["--between", "0,0,0", "1,0,0", "--distance", "-1"],
    ):
        assert main(["object", "scale", file, *more]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert (first / "sylpose" / CLOUD_FILE).exists()
