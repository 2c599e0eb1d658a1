"""`sylpose pose`: known points and markers of an object, from files, each frame separately."""

from __future__ import annotations

import csv
import struct
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.rendered_recordings import Recording, write_recording
from sylpose.boards.specification import parse_board
from sylpose.commands.main import main
from sylpose.commands.pose import PoseOptions, solve_poses
from sylpose.commands.report import _collect_stills
from sylpose.io import calibration
from sylpose.io.point_files import load_image_points, load_points
from sylpose.report.files import read_trajectory, read_tum
from sylpose.report.page import render_page
from sylpose.results import Trajectory
from sylpose.rig import Rig
from sylpose.runs.page import read_scenes
from sylpose.runs.run_metadata import SETTINGS, USED_CALIBRATION, open_source_recording
from sylpose.simulate import Actor, Scene, chamfered_box
from sylpose.status import FrameStatus, Observability
from tests.recordings import BOX, RIG, attach_target, compute_pose_error, moved_path

pytestmark = pytest.mark.usefixtures("undrawn")

FRAMES = 12
POINTS = {f"p{k}": place for k, place in enumerate(np.random.default_rng(1).uniform(-0.12, 0.12, (9, 3)))}


@pytest.fixture
def rig_file(tmp_path: Path) -> Path:
    calibration.save(RIG, tmp_path / "rig.toml")
    return tmp_path / "rig.toml"


def points_file(folder: Path, scale: float = 1.0) -> Path:
    lines = [f"{name},{x},{y},{z}" for name, (x, y, z) in ((n, scale * p) for n, p in POINTS.items())]
    (folder / "points.csv").write_text("name,x,y,z\n" + "\n".join(lines) + "\n")
    return folder / "points.csv"


def rows(noise: float = 0.5, seed: int = 0) -> list[tuple[str, int, str, float, float]]:
    """Return image points of all cameras, one in nine an outlier."""
    rng, out = np.random.default_rng(seed), []
    for k in range(FRAMES):
        places = moved_path(k).apply(np.array([*POINTS.values()]))
        for camera in RIG:
            pixels = camera.project(places) + noise * rng.normal(size=(len(places), 2))
            pixels[rng.integers(len(places))] += rng.uniform(30, 80, 2)
            out += [(camera.name, k, name, *pixel) for name, pixel in zip(POINTS, pixels.tolist(), strict=True)]
    return out


def table(path: Path, its: Iterable[tuple[object, ...]], header: str = "camera,frame,name,u,v") -> Path:
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in its)]) + "\n")
    return path


def solved(out: Path) -> Trajectory:
    return read_trajectory(out / "trajectory.csv")


def squares(trajectory: Trajectory) -> np.ndarray:
    """Return the NEES by frame; errors (w, d) are in the file's order."""
    off = np.array([compute_pose_error(pose, moved_path(pose.index)) for pose in trajectory])
    return np.array([(e / pose.sigma) @ (e / pose.sigma) / 6 for e, pose in zip(off, trajectory, strict=True)])


# --- points
# -------------------------------------------------------------------------------------------------------------


def test_pose_from_points_and_pixels(tmp_path: Path, rig_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pixels, out = table(tmp_path / "pixels.csv", rows()), tmp_path / "out"
    arguments = ["pose", str(points_file(tmp_path)), str(pixels), "--calibration", str(rig_file), "--out", str(out)]
    assert main([*arguments, "--rate", "50"]) == 0
    trajectory = solved(out)
    assert [pose.status for pose in trajectory] == [FrameStatus.LOCALIZED] * FRAMES
    assert all(pose.observability is Observability.ALL for pose in trajectory)
    off = np.array([compute_pose_error(pose, moved_path(pose.index)) for pose in trajectory])
    assert np.degrees(np.linalg.norm(off[:, :3], axis=1)).max() < 1.0
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.002
    assert 0.3 < squares(trajectory).mean() < 3.0
    np.testing.assert_allclose(trajectory.times, np.arange(FRAMES) / 50)
    assert trajectory.unit == "m"
    assert all(
        (pose.inliers >= 7).all() and (pose.inliers <= 8).all() for pose in trajectory
    )  # of 9 points, one is an outlier
    assert all((pose.matches == len(POINTS)).all() for pose in trajectory)
    assert 0.2 < np.mean([pose.residuals for pose in trajectory]) < 1.2
    assert len(read_tum(out / "trajectory.tum")[0]) == FRAMES
    assert f"Found         {FRAMES} of {FRAMES} frames" in capsys.readouterr().out
    assert main(["view", str(out), "cam_2"]) == 0
    # A second run is identical to the byte; another one is in another unit.
    first = (out / "trajectory.csv").read_bytes()
    assert main([*arguments, "--rate", "50"]) == 0
    assert (out / "trajectory.csv").read_bytes() == first
    assert main([*arguments, "--unit", "mm", "--is-in", "m"]) == 0
    np.testing.assert_allclose(solved(out).positions, 1000 * trajectory.positions, atol=1e-3)


def test_model_unit_mismatch_is_reported(tmp_path: Path, rig_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pixels = table(tmp_path / "pixels.csv", rows())
    arguments = [
        "pose",
        str(points_file(tmp_path)),
        str(pixels),
        "--calibration",
        str(rig_file),
        "--out",
        str(tmp_path),
    ]
    assert main([*arguments, "--is-in", "mm"]) == 1
    assert not any(pose.is_observed for pose in solved(tmp_path))
    # Frames without a pose have no standard deviations.
    lines = csv.DictReader((tmp_path / "trajectory.csv").open())
    assert [line["rx_sd_deg"] + line["tx_sd"] for line in lines] == [""] * FRAMES
    assert "if they were 1000 times as large: are they in another unit" in " ".join(capsys.readouterr().out.split())


def test_frames_are_independent(tmp_path: Path, rig_file: Path) -> None:
    """Poses do not depend on other frames; frames with too few points have no pose and a reason."""
    its, points = rows(), points_file(tmp_path)
    few: list[tuple[object, ...]] = [
        row for row in its if row[1] not in (3, 4) or (row[0] == "cam_0" and row[2] in ("p1", "p2", "p3"))
    ]
    few = [row if row[1] != 4 else (*row[:3], "", "") for row in few]
    tables: dict[str, list[tuple[object, ...]]] = {"all": [*its], "few": few}
    for name, these in tables.items():
        pixels = table(tmp_path / f"{name}.csv", these)
        arguments = ["pose", str(points), str(pixels), "--calibration", str(rig_file), "--out", str(tmp_path / name)]
        assert main(arguments) == 0
    every, some = (solved(tmp_path / name) for name in ("all", "few"))
    for a, b in zip(every, some, strict=True):
        if b.index in (3, 4):
            assert b.status is FrameStatus.TOO_FEW_MATCHES
            assert b.world_from_object is None
            assert ("3 points observed" if b.index == 3 else "0 points observed") in b.reason
        else:
            np.testing.assert_array_equal(a.position, b.position)
    assert len(read_tum(tmp_path / "few" / "trajectory.tum")[0]) == FRAMES - 2


def test_ambiguous_planar_poses_are_rejected(tmp_path: Path) -> None:
    """Solve a small distant flat object: frames with observable tilt are correct, others have no pose."""
    rig = Rig(RIG.cameras[:1], "m")
    calibration.save(rig, tmp_path / "rig.toml")
    flat = {f"p{k}": place for k, place in enumerate(0.03 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]))}
    (tmp_path / "flat.csv").write_text("name,x,y,z\n" + "".join(f"{n},{x},{y},{z}\n" for n, (x, y, z) in flat.items()))
    rng, its, true = np.random.default_rng(0), [], []
    for k in range(20):
        turn = Rotation.from_rotvec(rng.uniform(0.2, 0.5) * np.array([*rng.normal(size=2), 0]) * [1, 1, 0])
        pose = RigidTransform.from_components(0.1 * rng.normal(size=3), turn)
        true.append(pose)
        pixels = rig.cameras[0].project(pose.apply([*flat.values()])) + 0.4 * rng.normal(size=(4, 2))
        its += [("cam_0", k, name, *pixel) for name, pixel in zip(flat, pixels.tolist(), strict=True)]
    pixels_file = table(tmp_path / "pixels.csv", its)
    arguments = ["pose", str(tmp_path / "flat.csv"), str(pixels_file), "--calibration", str(tmp_path / "rig.toml")]
    main([*arguments, "--out", str(tmp_path / "out")])
    statuses = [pose.status for pose in solved(tmp_path / "out")]
    assert statuses.count(FrameStatus.ROTATION_NOT_OBSERVABLE) > 5
    for pose in solved(tmp_path / "out"):
        assert (pose.world_from_object is None) == (not pose.status.has_pose)
        if pose.is_measured:
            off = compute_pose_error(pose, true[pose.index])
            assert np.degrees(np.linalg.norm(off[:3])) < 4.0 * np.degrees(np.linalg.norm(pose.sigma[:3])) + 1.0


def test_deeplabcut_tables(tmp_path: Path, rig_file: Path) -> None:
    its = rows()
    files = []
    for camera in RIG.names:
        head = [
            "scorer" + 3 * len(POINTS) * ",net",
            "bodyparts," + ",".join(f"{name},{name},{name}" for name in POINTS),
            "coords" + len(POINTS) * ",x,y,likelihood",
        ]
        lines = []
        for k in range(FRAMES):
            here = [row for row in its if row[0] == camera and row[1] == k]
            # Points with a low likelihood are far off.
            lines.append(f"{k}," + ",".join(f"{u},{v},0.99" if n != "p0" else "1.0,2.0,0.2" for _, _, n, u, v in here))
        files.append(tmp_path / f"{camera}DLC_resnet50_boxshuffle1_1000.csv")
        files[-1].write_text("\n".join([*head, *lines]) + "\n")
    arguments = ["pose", str(points_file(tmp_path, 1000.0)), "--calibration", str(rig_file), "--is-in", "mm"]
    assert main([*arguments, *map(str, files), "--out", str(tmp_path / "a")]) == 0
    trajectory = solved(tmp_path / "a")
    assert all(pose.is_measured for pose in trajectory)
    assert 0.3 < squares(trajectory).mean() < 3.0
    assert all((pose.matches == len(POINTS) - 1).all() for pose in trajectory)
    # Files with other names, assigned by --video.
    named = [
        f"--video={name}={file.rename(tmp_path / f'{k}.csv')}"
        for k, (name, file) in enumerate(zip(RIG.names, files, strict=True))
    ]
    assert main([*arguments, *named, "--out", str(tmp_path / "b")]) == 0
    assert (tmp_path / "a" / "trajectory.csv").read_bytes() == (tmp_path / "b" / "trajectory.csv").read_bytes()
    with pytest.raises(ValueError, match=r"0\.csv: its name begins with no camera's name"):
        load_image_points([tmp_path / "0.csv"], ("left", "right"))


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian", "obj", "toml"])
def test_vertices_are_named_by_index(form: str, tmp_path: Path) -> None:
    places = np.array([*POINTS.values()]).astype(np.float32)
    path = tmp_path / f"model.{form if form in ('obj', 'toml') else 'ply'}"
    if form == "obj":
        lines = ["# a mesh", "o box", *(f"v {x} {y} {z}" for x, y, z in places.tolist()), "vn 0 0 1", "f 1 2 3"]
        path.write_text("\n".join(lines))
    elif form == "toml":
        path.write_text("unit = 'm'\n[points]\n" + "".join(f"{k} = {p}\n" for k, p in enumerate(places.tolist())))
    else:
        head = f"ply\nformat {form} 1.0\ncomment by hand\nelement vertex {len(places)}\nproperty float x\nproperty float y\n"
        head += (
            "property float z\nproperty uchar red\nelement face 1\nproperty list uchar int vertex_index\nend_header\n"
        )
        order = ">" if form == "binary_big_endian" else "<"
        body = b"".join(struct.pack(f"{order}fffB", *place, 7) for place in places.tolist())
        if form == "ascii":
            body = "\n".join(f"{x} {y} {z} 7" for x, y, z in places.tolist()).encode() + b"\n3 0 1 2\n"
        path.write_bytes(head.encode() + body)
    model = load_points(path)
    assert [*model.points] == [str(k) for k in range(len(places))]
    np.testing.assert_allclose([*model.points.values()], places, rtol=1e-6)


# --- markers
# ------------------------------------------------------------------------------------------------------------

SIDE = 0.09
# Markers on three faces of the box, each with center, x to the right, y up.
FACES = {
    2: ([0.0, 0.0, -BOX[2] / 2], [1, 0, 0], [0, -1, 0]),
    5: ([-BOX[0] / 2, 0.0, 0.01], [0, 0, -1], [0, -1, 0]),
    7: ([0.0, -BOX[1] / 2, 0.0], [1, 0, 0], [0, 0, 1]),
}


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of a box with markers on it."""
    body = chamfered_box(BOX, 600)
    for number, (center, x, y) in FACES.items():
        axes = np.column_stack([x, y, np.cross(x, y)]).astype(float)
        place = RigidTransform.from_components(center, Rotation.from_matrix(axes))
        body = attach_target(body, parse_board(f"apriltag:36h11,id={number},size={SIDE}"), place)
    folder = tmp_path_factory.mktemp("cube") / "take"
    write_recording(Recording(Scene(RIG, (Actor(body, moved_path),), 6, 3)), folder)
    return folder


def layout(folder: Path, scale: float = 1.0, unit: str = "m") -> Path:
    text = f'unit = "{unit}"\nfamily = "apriltag:36h11"\nsize = {scale * SIDE}\n'
    for number, (center, x, y) in FACES.items():
        text += f"\n[markers.{number}]\n"
        if number == 5:
            c, across, up = (np.array(v, float) for v in (center, x, y))
            ends = [c + SIDE / 2 * (a * across + b * up) for a, b in ((-1, 1), (1, 1), (1, -1), (-1, -1))]
            text += f"corners = {(scale * np.array(ends)).tolist()}\n"
        else:
            text += f"center = {(scale * np.array(center)).tolist()}\nx = {x}\ny = {y}\n"
    (folder / "cube.toml").write_text(text)
    return folder / "cube.toml"


def test_markers_in_recording(cube: Path, tmp_path: Path) -> None:
    assert main(["pose", str(layout(tmp_path)), str(cube), "--out", str(tmp_path / "out")]) == 0
    trajectory = solved(tmp_path / "out")
    assert [pose.status for pose in trajectory] == [FrameStatus.LOCALIZED] * 6
    off = np.array([compute_pose_error(pose, moved_path(pose.index)) for pose in trajectory])
    assert np.degrees(np.linalg.norm(off[:, :3], axis=1)).max() < 0.5
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.002
    assert squares(trajectory).mean() < 4.0
    assert all(pose.matches.sum() >= 12 for pose in trajectory)
    np.testing.assert_allclose(trajectory.times, np.arange(6) / 30, atol=1e-6)
    # In millimeters, for some frames.
    arguments = ["pose", str(layout(tmp_path, 1000.0, "mm")), str(cube), "--out", str(tmp_path / "mm")]
    assert main([*arguments, "--start", "1", "--stop", "6", "--every", "2"]) == 0
    some = solved(tmp_path / "mm")
    assert [pose.index for pose in some] == [1, 3, 5]
    np.testing.assert_allclose(some.positions, trajectory.positions[1::2], atol=1e-9)


def test_marker_result_can_be_shown_and_reported(cube: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sylpose.report.page.render_page", render_page)  # drawn
    model, out = layout(tmp_path), tmp_path / "out"
    arguments = ["pose", str(model), str(cube), "--out", str(out)]
    assert main([*arguments, "--every", "2"]) == 0
    files = {"trajectory.tum", "trajectory.csv", "report.png", "report.html", SETTINGS, USED_CALIBRATION}
    assert {file.name for file in out.iterdir()} == files
    message = tomllib.loads((out / SETTINGS).read_text(encoding="utf-8"))
    assert (message["recording"], message["options"]["model"]) == (str(cube.resolve()), str(model.resolve()))
    assert (message["options"]["every"], message["options"]["unit"], message["rate"]) == (2, "m", pytest.approx(30))
    again = open_source_recording(out)
    assert (again.rig.names, again.n_frames) == (RIG.names, 6)
    assert read_scenes(out)[""].index.tolist() == [0, 2, 4]
    # With the images of the page, and with those of the recording.
    for remove in (False, True):
        if remove:
            (out / "report.html").unlink()
        stills, why = _collect_stills(out)
        assert (stills.index.tolist(), why) == ([0, 2, 4], "")
        assert all(image is not None for images in stills.images for image in images)
        assert main(["report", str(out)]) == 0
    # Another pose run replaces the result completely; one that fails before its first frame keeps it.
    assert main([*arguments, "--stop", "2"]) == 0
    assert {file.name for file in out.iterdir()} == files
    assert len(solved(out)) == 2
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sylpose.runs.correspondences.detect_markers", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            solve_poses(PoseOptions(model=model, observations=(cube,), out=out))
    assert len(solved(out)) == 2
    assert {file.name for file in out.iterdir()} == files


def test_table_result_records_its_inputs(tmp_path: Path, rig_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sylpose.report.page.render_page", render_page)  # drawn
    its, out = rows(), tmp_path / "out"
    pixels = table(tmp_path / "pixels.csv", [*its, ("cam_0", 0, "strange", 5, 5)])
    arguments = ["pose", str(points_file(tmp_path)), str(pixels), "--calibration", str(rig_file), "--out", str(out)]
    assert main(arguments) == 0
    message = tomllib.loads((out / SETTINGS).read_text(encoding="utf-8"))
    assert message["tables"] == [str(pixels.resolve())]
    assert message["warnings"] == ["1 point of the tables is not in the object model: strange"]
    assert len(message["checksums"][str(pixels.resolve())]) == 32
    assert main(["report", str(out)]) == 0
    assert len(read_scenes(out)[""].index) == FRAMES
    with pytest.raises(ValueError, match=r"tables of pixels: there is no recording"):
        open_source_recording(out)


def test_inward_markers_cause_warning(cube: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = layout(tmp_path).read_text()
    (tmp_path / "cube.toml").write_text(text.replace("y = [0, 0, 1]", "y = [0, 0, -1]"))
    assert load_points(layout(tmp_path)).markers.inward_markers == ()  # type: ignore[union-attr]
    (tmp_path / "cube.toml").write_text(text.replace("y = [0, 0, 1]", "y = [0, 0, -1]"))
    assert main(["pose", str(tmp_path / "cube.toml"), str(cube), "--out", str(tmp_path / "out"), "--stop", "2"]) == 0
    assert "marker 7 faces inwards" in capsys.readouterr().out
    # The other markers are used.
    assert np.degrees(np.linalg.norm(compute_pose_error(solved(tmp_path / "out")[0], moved_path(0))[:3])) < 1.0


def test_missing_markers(cube: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without detections every frame has a failure status, and the exit code is 1."""
    text = layout(tmp_path).read_text().replace("markers.2]", "markers.12]")
    text = text.replace("markers.5]", "markers.15]").replace("markers.7]", "markers.17]")
    (tmp_path / "other.toml").write_text(text)
    assert main(["pose", str(tmp_path / "other.toml"), str(cube), "--out", str(tmp_path / "out")]) == 1
    assert "the object was not found in any frame. Too few features" in capsys.readouterr().err
    assert all(pose.status is FrameStatus.TOO_FEW_MATCHES for pose in solved(tmp_path / "out"))


# --- invalid input
# ------------------------------------------------------------------------------------------------------


def toml(text: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / "model.toml").write_text(text)
        return folder / "model.toml"

    return write


def other(name: str, text: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_text(text)
        return folder / name

    return write


HEAD = 'family = "apriltag:36h11"\nsize = 2\n[markers.3]\n'
PLY = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda folder: folder / "no.csv", "no.csv: no such file"),
        (other("a.stl", "solid"), "points are read from .csv, .toml, .ply, .obj"),
        (other("a.csv", "name,x,y\n"), "line 1: expected the columns name,x,y,z"),
        (other("a.csv", "name,x,y,z\na,1,2,3\na,1,2,3\n"), "line 3: the point 'a' occurs twice"),
        (other("a.csv", "name,x,y,z\na,1,2\n"), "line 2: expected 4 cells, got 3"),
        (other("a.csv", "name,x,y,z\na,1,2,nan\n"), "line 2: a: expected three numbers"),
        (other("a.csv", "name,x,y,z\n"), "contains no points"),
        (other("a.obj", "v 1 2\n"), "line 1: expected three numbers"),
        (other("a.obj", "v 1 2 inf\n"), "vertices are not finite"),
        (other("a.ply", "solid"), "not PLY"),
        (other("a.ply", PLY.replace("vertex 1", "vertex 2") + "1 2 3\n"), "it ends before its last vertex"),
        (other("a.ply", PLY.replace("property float z\n", "")), "no vertices with x, y and z"),
        (other("a.ply", PLY.replace("ascii", "binary_middle_endian")), "its format is binary_middle_endian"),
        (other("a.ply", PLY.replace("vertex 1", "vertex 99999999999")), "more than 1000000 points"),
        (toml("points = 3"), "points: expected a table"),
        (toml("[points]\na = [1, 2]"), "points: a: expected three numbers"),
        (toml("unit = 'parsec'"), "unit: expected one of m, cm"),
        (toml("point = 3"), "point: expected only unit, points, markers, family and size"),
        (toml("size = 3"), "size: only for markers, and there are none"),
        (toml("[markers.1]\ncenter = [0, 0, 0]"), "family: expected that of the markers"),
        (toml('family = "charuco:5x7"\n[markers.1]\ncorners = []'), "markers.1.corners: expected four points"),
        (
            toml('family = "x"\nsize = 1\n[markers.1]\ncenter = [0, 0, 0]\nx = [1, 0, 0]\ny = [0, 1, 0]'),
            "is not a",
        ),
        (toml(HEAD + "center = [0, 0, 0]"), "markers.3: expected corners, or center, x and y"),
        (toml(HEAD + "center = [0, 0, 0]\nx = [1, 0, 0]\ny = [1, 1, 0]"), "must be perpendicular"),
        (toml(HEAD + "corners = [[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]]"), "they do not form a square"),
        (
            toml(HEAD + "corners = [[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0]]"),
            "its sides are 9 long, but size is 2",
        ),
        (toml(HEAD.replace("markers.3", "markers.a") + "center = 1"), "expected tables by number"),
    ],
)
def test_invalid_models(
    write: Callable[[Path], Path],
    words: str,
    tmp_path: Path,
    rig_file: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pixels = table(tmp_path / "pixels.csv", rows())
    arguments = [
        "pose",
        str(write(tmp_path)),
        str(pixels),
        "--calibration",
        str(rig_file),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "line 1: expected the columns camera,frame,name,u,v; camera, frame, name, u, v missing"),
        ("camera,frame,name,u\n", "v missing"),
        ("camera,frame,name,u,v,w\n", "the column 'w' is unknown"),
        ("camera,frame,name,u,x,v\n", "the column 'x' is unknown or occurs twice"),
        ("camera,frame,name,u,v\ncam_7,0,p0,1,2\n", "line 2: no camera 'cam_7' in the calibration"),
        ("camera,frame,name,u,v\ncam_1,0.5,p0,1,2\n", "line 2: '0.5' is not a frame number"),
        ("camera,frame,name,u,v\ncam_1,-1,p0,1,2\n", "line 2: '-1' is not a frame number"),
        ("camera,frame,name,u,v\ncam_1,0,p0,1\n", "line 2: expected 5 cells, got 4"),
        ("camera,frame,name,u,v\ncam_1,0,p0,1,inf\n", "line 2: 1.0, inf is not a valid pixel"),
        ("camera,frame,name,u,v\ncam_1,0,p0,1,2\ncam_1,0,p0,1,2\n", "line 3: cam_1 has 'p0' twice in frame 0"),
        (
            "camera,frame,name,u,v\ncam_1,0,nose,1,2\n",
            "none of the tables' points (nose) is a point of the object",
        ),
        ("camera,frame,name,u,v,time\ncam_1,0,p0,1,2,0\ncam_2,0,p0,1,2,1\n", "line 3: frame 0 has no time, or two"),
        ("camera,frame,name,u,v,time\ncam_1,0,p0,1,2,3\ncam_2,1,p0,1,2,1\n", "times do not increase"),
        ("scorer,a,a\nbodyparts,p0,p0\ncoords,x,y\n0,1,2\n", "its name begins with no camera's name"),
        ("scorer,a\nindividuals,m\nbodyparts,p0\ncoords,x\n", "its name begins with no camera's name"),
    ],
)
def test_invalid_tables(
    text: str, words: str, tmp_path: Path, rig_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "pixels.csv").write_text(text)
    points = str(points_file(tmp_path))
    arguments = [
        "pose",
        points,
        str(tmp_path / "pixels.csv"),
        "--calibration",
        str(rig_file),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("scorer,a\nindividuals,m\nbodyparts,p0\ncoords,x\n", "has several individuals"),
        ("scorer,a\nbodyparts,p0\n", "lines 2 and 3 of a DeepLabCut table"),
        ("scorer,a,a\nbodyparts,p0,p0\ncoords,x,x\n", "line 3: x of p0 occurs twice"),
        ("scorer,a\nbodyparts,p0\ncoords,x\n", "line 3: expected x, y and likelihood of p0"),
        ("scorer,a,a\nbodyparts,p0,p0\ncoords,x,y\n0,1\n", "line 4: expected 3 cells, got 2"),
        ("scorer,a,a\nbodyparts,p0,p0\ncoords,x,y\n0,1,b\n", "line 4: 'b' is not a number"),
    ],
)
def test_invalid_deeplabcut_tables(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "cam_1DLC.csv").write_text(text)
    with pytest.raises(ValueError, match=rf"cam_1DLC\.csv: {words}"):
        load_image_points([tmp_path / "cam_1DLC.csv"], RIG.names)


def test_incompatible_inputs(cube: Path, tmp_path: Path, rig_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points, pixels = str(points_file(tmp_path)), str(table(tmp_path / "pixels.csv", rows()))
    out = ["--out", str(tmp_path / "out")]
    timed = table(tmp_path / "timed.csv", [(*row, row[1] / 9) for row in rows()], "camera,frame,name,u,v,time")
    for arguments, words in (
        ([points, pixels], "--calibration FILE is required for tables of pixels"),
        ([points, str(cube)], "points.csv: it has no markers to detect"),
        (
            [str(layout(tmp_path)), pixels, "--calibration", str(rig_file)],
            "it has markers, which require a recording",
        ),
        ([str(layout(tmp_path)), str(cube), "--is-in", "mm"], "--is-in mm"),
        ([points, str(timed), "--calibration", str(rig_file), "--rate", "9"], "--rate: the tables have times"),
        ([points, pixels, "--calibration", str(rig_file), "--max-error", "0"], "--max-error must be"),
        ([points, pixels, "--calibration", str(rig_file), "--video", "x=y"], "no camera x in the calibration"),
        ([str(layout(tmp_path)), str(cube), "--out", str(cube)], "this is the recording's folder"),
    ):
        assert main(["pose", *out, *arguments]) == 2
        err = capsys.readouterr().err
        assert words in err
        assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "settings.toml").write_text("")
    assert main(["pose", *out, points, pixels, "--calibration", str(rig_file)]) == 2
    assert "contains the results of a run" in capsys.readouterr().err
