"""An object's frame and size: set by points, planes and extents, with what is said of them; results are told in them."""

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

from sylpose.app.object_files import CLOUD, OBJECT, load_object, save_object
from sylpose.app.objects import retold
from sylpose.app.run import track_session
from sylpose.app.run_metadata import USED
from sylpose.boards.specification import parse_board
from sylpose.capture import open_session
from sylpose.cli import main
from sylpose.report.files import read_trajectory, write_trajectory
from sylpose.results import FramePose, FrameStatus, Observable, Trajectory
from sylpose.rig import Rig
from sylpose.simulate import Actor, Recording, Scene, chamfered_box, write_recording
from sylpose.tracking.known_object import KnownObject
from sylpose.units import FIRST_DISTANCES
from tests.recordings import BOX, NEXT, RIG, elsewhere, errors, learning, marked, recorded, slide

pytestmark = pytest.mark.usefixtures("undrawn")

NEW_FROM_OBJECT = RigidTransform.from_components([0.5, -0.3, 0.2], Rotation.from_rotvec([0.5, -1.0, 0.8]))
# A corner of the box, another along its longest edge, and one along its second: actor's frame.
CORNERS = np.array([[-1, -1, 1], [1, -1, 1], [-1, 1, 1]]) * np.array(BOX) / 2


def seen_at(
    point: np.ndarray, frame: int, cameras: Sequence[str], off: Sequence[float] | np.ndarray = (0.0, 0.0)
) -> str:
    """A point of the actor as somebody would click on it."""
    place = learning(frame).apply(point)
    pixels = {name: RIG[name].project(place)[0] + off for name in cameras}
    return f"@{frame} " + " ".join(f"{name}={u:.2f},{v:.2f}" for name, (u, v) in pixels.items())


def frame_of(first: Path, out: Path, *options: str) -> KnownObject:
    assert main(["object", "frame", str(first / "sylpose" / OBJECT), str(out / "tool.npz"), *options]) == 0
    return load_object(out / "tool.npz")


def on_a_face(frame: int) -> tuple[np.ndarray, int, float]:
    """Three points (actor's frame) of the face that cam_1 sees best in a frame of the first take: an origin, and 6 cm along
    two edges; the axis that is square to the face, and where on it that is."""
    eye = learning(frame).inv().apply(RIG["cam_1"].center)
    side = int(np.argmax(np.abs(eye) / np.array(BOX)))
    a, b = [k for k in range(3) if k != side]
    points = np.zeros((3, 3))
    points[:, side] = face = np.sign(eye[side]) * BOX[side] / 2
    points[1, a], points[2, b] = 0.06, 0.06
    return points, side, float(face)


def turned_to(points: np.ndarray) -> RigidTransform:
    """The axes that three points tell."""
    x, y = points[1] - points[0], points[2] - points[0]
    axes = np.column_stack([x, y, np.cross(x, y)])
    return RigidTransform.from_rotation(Rotation.from_matrix(axes / np.linalg.norm(axes, axis=0)))


def actor_from_new(known: KnownObject, new: KnownObject, actor_from_object: RigidTransform) -> RigidTransform:
    return actor_from_object * (new.frame.from_learnt * known.frame.from_learnt.inv()).inv()


# --- poses are told of it -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "smooth", [pytest.param(False, id="tracked", marks=pytest.mark.slow), pytest.param(True, id="smoothed")]
)
def test_another_frame_is_the_same_poses_told_of_it(tmp_path: Path, known: KnownObject, smooth: bool) -> None:
    """To rounding, with the same uncertainty: nothing that is decided depends on it."""
    session = open_session(recorded(tmp_path / "take", elsewhere, 6, seed=5))
    tool = known.in_frame(NEW_FROM_OBJECT, said="by hand")
    runs = [
        track_session(session, tmp_path / f"out{k}", overlay=False, smooth=smooth, known=its)
        for k, its in enumerate((known, tool))
    ]
    for a, b in zip(*(run.trajectory for run in runs), strict=True):
        assert a.world_from_object is not None
        assert b.world_from_object is not None
        assert (a.status, a.observable) == (b.status, b.observable)
        np.testing.assert_array_equal(a.inliers, b.inliers)
        np.testing.assert_allclose(
            (a.world_from_object * NEW_FROM_OBJECT.inv()).as_matrix(), b.world_from_object.as_matrix(), atol=1e-13
        )
        # An error that the first thinks as likely as the second does of what it becomes there.
        off = 1e-4 * np.random.default_rng(a.index).normal(size=6)
        wrong = RigidTransform.from_components(
            a.position + off[3:], Rotation.from_rotvec(off[:3]) * a.world_from_object.rotation
        )
        as_told = errors(b, wrong * NEW_FROM_OBJECT.inv())
        squares = [e @ np.linalg.solve(p.covariance, e) for e, p in ((errors(a, wrong), a), (as_told, b))]
        assert squares[1] == pytest.approx(squares[0], rel=2e-3)  # turns are not quite vectors
    # What the take has learnt is told in the frame that it was asked for.
    again = load_object(tmp_path / "out1" / OBJECT)
    assert (again.mark, again.frame.said) == (known.mark, "by hand")
    np.testing.assert_array_equal(again.frame.from_learnt.as_matrix(), tool.frame.from_learnt.as_matrix())
    plain = load_object(tmp_path / "out0" / OBJECT)
    np.testing.assert_allclose(NEW_FROM_OBJECT.apply(plain.places), again.places, atol=1e-12)


def test_the_covariance_of_another_frame_is_what_draws_come_to() -> None:
    rng = np.random.default_rng(4)
    root = rng.normal(size=(6, 6))
    covariance = 1e-6 * root @ root.T
    pose = FramePose(
        0, 0.0, FrameStatus.TRACKED, RigidTransform.identity(), covariance, np.ones(1, np.int64), np.zeros(1)
    )
    told = pose.of_frame(NEW_FROM_OBJECT)
    draws = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    poses = RigidTransform.from_components(draws[:, 3:], Rotation.from_rotvec(draws[:, :3])) * NEW_FROM_OBJECT.inv()
    off = np.hstack([draws[:, :3], poses.translation - told.position])
    np.testing.assert_allclose(np.cov(off.T), told.covariance, atol=0.1 * np.diag(told.covariance).max())
    # What is not known of the turn is not known of a place away from the origin; in the file there is no more than this.
    open_turn = replace(pose, covariance=np.diag([1e-6, 1e-6, np.inf, 1e-6, 1e-6, 1e-6]))
    assert np.isinf(open_turn.of_frame(NEW_FROM_OBJECT).sigma[[2, 3, 4]]).all()
    assert (retold(replace(pose, covariance=np.diag(np.diag(covariance))), NEW_FROM_OBJECT).sigma >= told.sigma).all()
    assert np.isfinite(retold(open_turn, RigidTransform.identity()).sigma[3:]).all()


# --- the ways to say it -------------------------------------------------------------------------------------------------


def test_three_points_by_pixels_in_two_cameras(
    first: Path,
    known: KnownObject,
    actor_from_object: RigidTransform,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    rng, asked = np.random.default_rng(7), []
    for option, corner in zip(("--origin", "--x", "--xy"), CORNERS, strict=True):
        asked += [option, seen_at(corner, 20, RIG.names[:3], rng.normal(size=2))]
    new = frame_of(first, tmp_path, *asked)
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


def test_one_camera_is_enough_where_it_has_seen_the_surface(
    first: Path, known: KnownObject, actor_from_object: RigidTransform, tmp_path: Path
) -> None:
    """Points in a face that the camera sees, as it sees them."""
    frame = 3
    points, side, face = on_a_face(frame)
    asked = []
    for option, point in zip(("--origin", "--x", "--xy"), points, strict=True):
        asked += [option, seen_at(point, frame, ["cam_1"])]
    new = frame_of(first, tmp_path, *asked)
    places = actor_from_new(known, new, actor_from_object).apply([[0, 0, 0], [0.06, 0, 0], [0, 0.06, 0]])
    assert np.abs(places[:, side] - face).max() < 0.006
    assert np.linalg.norm(places - points, axis=1).max() < 0.008
    assert 0.0005 < np.linalg.norm(new.frame.sd[3:]) < 0.02


def test_the_largest_plane_is_a_face(
    first: Path, known: KnownObject, actor_from_object: RigidTransform, tmp_path: Path
) -> None:
    new = frame_of(first, tmp_path, "--plane", "largest")
    found = actor_from_new(known, new, actor_from_object)
    normal = found.rotation.apply([0, 0, 1.0])
    side = int(np.argmax(np.abs(normal)))
    assert np.degrees(np.arccos(np.abs(normal[side]))) < 0.6
    assert found.translation[side] == pytest.approx(np.sign(normal[side]) * BOX[side] / 2, abs=0.002)  # outwards
    # At a landmark of another face, that one; the origin is put into it, X leads to a point.
    there = actor_from_object.inv().apply(np.roll(np.eye(3), 1, axis=1)[side] * np.array(BOX) / 2)
    near = "near " + ",".join(f"{v:.4f}" for v in there)
    options = ("--plane", near, "--origin", near, "--x", "0,0,0.5")
    other = actor_from_new(known, frame_of(first, tmp_path, *options), actor_from_object)
    assert np.abs(other.rotation.apply([0, 0, 1.0])).argmax() != side
    assert np.abs(other.rotation.apply([0, 0, 1.0])).max() > np.cos(np.radians(1.5))
    towards = other.inv().apply(actor_from_object.apply([0, 0, 0.5]))
    assert towards[1] == pytest.approx(0.0, abs=1e-9)
    assert towards[0] > 0


def test_its_extent_and_plain_turns(first: Path, known: KnownObject, tmp_path: Path) -> None:
    new = frame_of(first, tmp_path, "--extent")
    good = new.places[new.depth_sd < 0.1 * new.radius]
    spread = good.std(axis=0)
    assert spread[0] > spread[1] > spread[2]
    assert np.linalg.norm(np.median(good, axis=0)) < 0.3 * new.radius
    assert 0.0 < new.frame.sd[:3].max() < 0.3
    assert main(["object", "frame", str(tmp_path / "tool.npz"), str(tmp_path / "two.npz"), "--turn", "0,0,90"]) == 0
    two = load_object(tmp_path / "two.npz")
    np.testing.assert_allclose(two.places, new.places @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), atol=1e-12)
    # As certain as before, about the axes that it has now.
    np.testing.assert_allclose(two.frame.sd, new.frame.sd[[1, 0, 2, 4, 3, 5]], rtol=0.5)
    assert "axes turned" in two.frame.said
    moved = frame_of(first, tmp_path, "--origin", "0.1,0,-0.05")
    np.testing.assert_allclose(moved.places, known.places - [0.1, 0, -0.05], atol=1e-12)
    assert not moved.frame.sd.any()


def test_what_is_in_a_file_is_shown(first: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["object", "show", str(first / "sylpose" / OBJECT)]) == 0
    said = capsys.readouterr().out
    known = load_object(first / "sylpose" / OBJECT)
    # A tenth of the radius, of which the medians are a part, whatever the rest of the landmarks.
    bound, unit = re.findall(r"known well: to ([0-9.]+) (m+) in depth", said)[0]
    assert float(bound) / {"mm": 1000, "m": 1}[unit] == pytest.approx(0.1 * known.radius, rel=0.01)
    medians = re.findall(r"(?m)^cam_\d +\d+ +\d+ +([0-9.]+) mm", said)
    assert len(medians) == len(known._cameras)
    assert all(0.0 < float(sd) < 100.0 * known.radius for sd in medians)
    for words in ("landmarks", "their median sd", "Keyframes", "Radius", "Extent", "Unit          m", "cam_0", "cam_3"):
        assert words in said


# --- what is on it ------------------------------------------------------------------------------------------------------

MARKER = "apriltag:36h11,id=5,size=90mm"
# In the middle of the face that looks at the cameras.
ACTOR_FROM_BOARD = RigidTransform.from_components(
    [0.02, -0.01, -BOX[2] / 2], Rotation.from_matrix([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
)


@pytest.fixture(scope="module")
def with_marker(
    tmp_path_factory: pytest.TempPathFactory, first: Path, known: KnownObject, actor_from_object: RigidTransform
) -> Path:
    """A recording of the object with a marker on it, and a result of it that is as good as the truth."""
    folder = tmp_path_factory.mktemp("marked") / "take"
    body = marked(chamfered_box(BOX, 600), parse_board(MARKER, "m"), ACTOR_FROM_BOARD)
    write_recording(Recording(Scene(RIG, (Actor(body, elsewhere),), 6, 3)), folder)
    some = np.ones(4, np.int64), np.full(4, 0.2)
    poses = [
        FramePose(
            k, k / 30, FrameStatus.TRACKED, elsewhere(k) * actor_from_object, np.diag([1e-6] * 3 + [1e-7] * 3), *some
        )
        for k in range(6)
    ]
    write_trajectory(folder / "sylpose", Trajectory(poses, RIG.names, "m"))
    save_object(known, folder / "sylpose" / OBJECT)
    shutil.copy(first / "sylpose" / USED, folder / "sylpose")
    return folder


def test_a_marker_on_it_is_its_frame(
    with_marker: Path, known: KnownObject, actor_from_object: RigidTransform, tmp_path: Path
) -> None:
    asked = ["--board", MARKER, "--recording", str(with_marker)]
    new = frame_of(with_marker, tmp_path, *asked)
    off = (ACTOR_FROM_BOARD.inv() * actor_from_new(known, new, actor_from_object)).inv()
    wrong = np.concatenate([off.rotation.as_rotvec(), off.translation])
    assert np.degrees(np.linalg.norm(wrong[:3])) < 1.0
    assert np.linalg.norm(wrong[3:]) < 0.002
    assert (np.abs(wrong) < 4 * new.frame.sd).all()
    assert np.degrees(new.frame.sd[:3]).max() < 2.0
    assert MARKER in new.frame.said


@pytest.mark.parametrize(
    ("board", "words"),
    [
        ("apriltag:36h11,id=6,size=90mm", "of 6 frames of .* it was not seen in any"),
        ("apriltag:36h11,id=5", "size is missing"),
        ("chessboard:8x6,square=20mm", "it looks the same after a turn"),
        ("paper", "is no board or marker"),
    ],
)
def test_boards_that_tell_no_frame(
    board: str, words: str, with_marker: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(with_marker / "sylpose" / OBJECT)
    asked = ["object", "frame", file, str(tmp_path / "tool.npz"), "--board", board, "--recording", str(with_marker)]
    assert main(asked) == 2
    err = capsys.readouterr().err
    assert re.search(words, err)
    assert err.count("\n") == 1


def test_a_board_that_goes_its_own_way_is_no_part_of_it(
    with_marker: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By poses of something else."""
    take = Path(shutil.copytree(with_marker, tmp_path / "take"))
    poses = [
        replace(
            pose,
            world_from_object=slide(5 * pose.index) * RigidTransform.from_rotation(Rotation.from_rotvec([0, k, 0])),
        )
        for k, pose in enumerate(read_trajectory(take / "sylpose" / "trajectory.csv"))
    ]
    write_trajectory(take / "sylpose", Trajectory(poses, RIG.names, "m"))
    file = str(take / "sylpose" / OBJECT)
    asked = ["object", "frame", file, str(tmp_path / "tool.npz"), "--board", MARKER, "--recording", str(take)]
    assert main(asked) == 2
    assert "no part of it, or hardly seen" in capsys.readouterr().err


# --- size ---------------------------------------------------------------------------------------------------------------


def test_lengths_that_cameras_have_measured_are_compared(
    first: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(first / "sylpose" / OBJECT)
    ends = [seen_at(corner, 20, RIG.names[:3]) for corner in CORNERS[:2]]
    asked = ["object", "scale", file, "--between", *ends, "--distance", "0.28"]
    assert main(asked) == 0
    off = float(re.search(r"Off\s+([+-][\d.]+) %", capsys.readouterr().out)[1])  # type: ignore[index]
    assert off == pytest.approx(100 * (0.3 / 0.28 - 1), abs=0.6)
    assert main([*asked[:3], str(tmp_path / "tool.npz"), *asked[3:]]) == 2
    err = capsys.readouterr().err
    assert "its lengths were measured by calibrated cameras" in err
    assert err.count("\n") == 1
    assert not (tmp_path / "tool.npz").exists()
    assert main([*asked, "--unit", "mm"]) == 2
    assert "--unit mm: the object's lengths are in m" in capsys.readouterr().err


@pytest.fixture(scope="module")
def by_one(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A take that one camera has seen alone."""
    folder = recorded(tmp_path_factory.mktemp("one") / "take", learning, 50, rig=RIG.subset(["cam_1"]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sylpose.report.plots.plot_trajectory", lambda *_, **__: None)
        track_session(open_session(folder), overlay=False, smooth=False)
    return folder


def test_what_one_camera_has_learnt_gets_a_size(
    by_one: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Then it tells how far away the object is; before that, no other cameras can use it."""
    file = by_one / "sylpose" / OBJECT
    known = load_object(file)
    assert known.unit == FIRST_DISTANCES
    four = recorded(tmp_path / "four", elsewhere, 4, seed=5)
    assert main(["track", str(four), "--object", str(file)]) == 2
    assert "one camera has learnt it" in capsys.readouterr().err
    frame, (points, _, _) = 3, on_a_face(3)
    asked = [seen_at(point, frame, ["cam_1"]) for point in points]
    at = ["object", "frame", str(file), str(tmp_path / "framed.npz")]
    assert main([*at, "--origin", asked[0], "--x", asked[1], "--xy", asked[2], "--result", str(file.parent)]) == 0
    at = ["object", "scale", str(tmp_path / "framed.npz"), str(tmp_path / "tool.npz"), "--between", *asked[1:]]
    apart = float(np.linalg.norm(points[2] - points[1]))
    assert main([*at, "--result", str(file.parent), "--distance", f"{apart:.6f}", "--unit", "m"]) == 0
    capsys.readouterr()
    sized = load_object(tmp_path / "tool.npz")
    assert sized.unit == "m"
    assert 0.001 < sized.scale_sd < 0.1
    actor_from_frame = RigidTransform.from_translation(points[0]) * turned_to(points)
    again = recorded(tmp_path / "again", elsewhere, NEXT - 6, seed=5, rig=RIG.subset(["cam_1"]))
    for smooth in (False, True):
        run = track_session(open_session(again), overlay=False, smooth=smooth, known=sized)
        assert run.trajectory.unit == "m"
        assert all(pose.measured and pose.observable is Observable.ALL for pose in run.trajectory)
        wrong = np.array([errors(pose, elsewhere(pose.index) * actor_from_frame) for pose in run.trajectory])
        assert np.linalg.norm(wrong[:, 3:], axis=1).max() < 0.06  # of 1.5 m
        squares = []
        for off, pose in zip(wrong, run.trajectory, strict=True):
            assert pose.world_from_object is not None
            axes = block_diag(*[pose.world_from_object.rotation.as_matrix()] * 2)
            squares.append(off @ np.linalg.solve(pose.covariance + axes @ np.diag(sized.frame.sd**2) @ axes.T, off) / 6)
        assert 0.001 < np.mean(squares) < 3.0  # the clicks are better than clicks are
        assert max(np.linalg.norm(pose.sigma[3:]) for pose in run.trajectory) < 0.3
    with pytest.raises(ValueError, match="cameras have measured its lengths"):
        sized.sized(2.0, "m")


# --- finished results ---------------------------------------------------------------------------------------------------


def test_a_finished_result_is_told_in_another_frame(
    first: Path, known: KnownObject, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_object(known.in_frame(NEW_FROM_OBJECT), tmp_path / "tool.npz")
    before = {file: file.read_bytes() for file in (first / "sylpose").iterdir() if file.is_file()}
    result, out = str(first / "sylpose"), tmp_path / "out"
    assert main(["object", "apply", str(tmp_path / "tool.npz"), result, str(out)]) == 0
    a, b = (read_trajectory(folder / "trajectory.csv") for folder in (first / "sylpose", out))
    for one, other in zip(a, b, strict=True):
        assert one.status is other.status
        if one.world_from_object is None or other.world_from_object is None:
            assert one.world_from_object is other.world_from_object
            continue
        told = one.world_from_object * NEW_FROM_OBJECT.inv()
        np.testing.assert_allclose(other.world_from_object.as_matrix(), told.as_matrix(), atol=1e-9)
        assert (other.sigma[3:] >= one.sigma[3:] - 1e-12).all()
    assert {file: file.read_bytes() for file in before} == before
    # It is a result like others: in that frame, and with the calibration for views of it. Back again is what it was.
    assert main(["view", str(out), "cam_1"]) == 0
    assert main(["object", "apply", result + f"/{OBJECT}", str(out), str(tmp_path / "back")]) == 0
    for one, other in zip(a, read_trajectory(tmp_path / "back" / "trajectory.csv"), strict=True):
        np.testing.assert_allclose(other.position, one.position, atol=1e-9)
    capsys.readouterr()
    for folder in (result, str(tmp_path)):
        assert main(["object", "apply", str(tmp_path / "tool.npz"), result, folder]) == 2
        assert "a run's results, or the object, are there" in capsys.readouterr().err


# --- what cannot be -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "nothing says which frame"),
        (["--x", "0,0,0"], "nothing says which frame"),
        (["--xy", "0,0,0", "--x", "1,0,0"], "--xy: three points are"),
        (["--extent", "--turn", "0,0,1"], "--extent and --turn: these do not go together"),
        (["--extent", "--origin", "0,0,0"], "--extent and --origin: these do not go together"),
        (["--origin", "0,0,0", "--x", "1,0,0"], "--x: these do not go together"),
        (["--turn", "0,0,1", "--x", "1,0,0"], "--turn and --x: these do not go together"),
        (["--board", "apriltag:36h11,id=3,size=8"], "--board and --recording"),
        (["--turn", "0,0"], "--turn: three angles in degrees"),
        (["--turn", "0,0,nan"], "--turn: three angles in degrees"),
        (["--origin", "0,0"], '--origin "0,0": 3 numbers with commas'),
        (["--origin", "here"], '--origin "here": 3 numbers with commas'),
        (["--origin", "near"], '--origin "near": 3 numbers'),
        (["--origin", "@x cam_0=1,2"], "a point is"),
        (["--origin", "@3"], "a point is"),
        (["--origin", "@3 cam_0"], "a point is"),
        (["--origin", "@3 cam_0=1"], "2 numbers with commas"),
        (["--origin", "@3 cam_9=1,2"], "no camera cam_9 in"),
        (["--origin", "@900 cam_0=1,2"], "the object's pose in frame 900 is not known"),
        (["--origin", "@3 cam_0=1,2"], "no landmark of cam_0 is near that line of sight"),
        (["--origin", "@3 cam_0=240,180 cam_2=100,20"], "pass each other by"),
        (["--origin", "0,0,0", "--x", "0,0,0", "--xy", "1,0,0"], "are the same"),
        (["--origin", "0,0,0", "--x", "1,0,0", "--xy", "2,0,0"], "lie on a line"),
        (["--plane", "9,9,9"], "--plane: 0 landmarks are too few for a plane"),
    ],
)
def test_frames_that_cannot_be(
    options: list[str], words: str, first: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["object", "frame", str(first / "sylpose" / OBJECT), str(tmp_path / "tool.npz"), *options]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_results_that_are_of_something_else(
    first: Path, known: KnownObject, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_object(replace(known, mark="abc"), tmp_path / "other.npz")
    file = str(first / "sylpose" / OBJECT)
    told = ["--origin", "@3 cam_0=240,180"]
    at = ["object", "frame", str(tmp_path / "other.npz"), str(tmp_path / "tool.npz"), *told]
    assert main([*at, "--result", str(first / "sylpose")]) == 2
    assert "the run has seen another object, or has learnt it anew" in capsys.readouterr().err
    assert main(at) == 2  # nothing beside it
    assert "trajectory.csv: no such file" in capsys.readouterr().err
    assert main(["object", "frame", file, str(tmp_path / "tool.txt"), "--extent"]) == 2
    assert "tool.txt: an object's file ends in .npz" in capsys.readouterr().err
    save_object(replace(known, rig=Rig(RIG.cameras, "mm")), tmp_path / "mm.npz")
    assert main(["object", "apply", str(tmp_path / "mm.npz"), str(first / "sylpose"), str(tmp_path / "o" / "out")]) == 2
    assert "its lengths are in m, those of the object in mm" in capsys.readouterr().err
    assert main(["object", "scale", file, "--between", "0,0,0", "0,0,0", "--distance", "1"]) == 2
    assert "--between: the two points are one" in capsys.readouterr().err
    for more in (
        ["--distance", "1"],
        ["--between", "0,0,0", "1,0,0"],
        ["--between", "0,0,0", "1,0,0", "--distance", "-1"],
    ):
        assert main(["object", "scale", file, *more]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert (first / "sylpose" / CLOUD).exists()
