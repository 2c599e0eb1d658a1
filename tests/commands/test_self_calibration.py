"""`sylpose calibrate` without a board, as typed: a rendered tumbling block, refusals, and wrong options."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.self_calibration import KINDS, make_scene
from sylpose.commands.main import main
from sylpose.io import calibration
from sylpose.io.calibration.world import World, parse_up_world, transform_rig
from sylpose.io.capture import open_session
from sylpose.report.files import read_trajectory, read_tum
from sylpose.rig import Rig
from sylpose.rig_calibration.free_flight import FreeFlight
from sylpose.rig_calibration.from_motion import MotionCalibration, locate
from sylpose.rig_calibration.result import GRID, Coverage, RigCalibration
from sylpose.runs import run as runs
from sylpose.runs import self_calibration
from sylpose.runs.options import RunOptions
from sylpose.runs.page import read_run
from sylpose.runs.self_calibration import KnownLength, describe_flight, parse_free, parse_scale
from sylpose.simulate import Actor, Scene, arc, write_sequence
from sylpose.simulate.render import chamfered_box
from tests.conftest import make_once
from tests.rig_calibration.test_free_flight import DOWN, UNIT, throw

FRAMES = 36


def write_tumbling(folder: Path, late_frames: int = 0) -> None:
    """Render a block that tumbles by 200 degrees before two cameras, which are late by so many frames."""
    kind = KINDS["near"]
    whole = make_scene(kind, 3)
    target = whole.object_poses().translation.mean(axis=0)
    rig = arc(2, 50.0, 1.2, 420.0, (320, 240), height=[0.1, 0.35], target=target)

    def path(frame: float) -> RigidTransform:
        return whole.actors[0].path(1.4 * (frame - late_frames))

    actor = type(whole.actors[0])(whole.actors[0].body, path)
    write_sequence(folder, Scene(rig, (actor,), FRAMES, 0, 1.0), boxes=True)


@pytest.fixture(scope="session")
def tumbling(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording with the true calibration; read-only."""
    return make_once(tmp_path_factory, "tumbling", write_tumbling)


def test_calibrate_writes_the_rig(tumbling: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = calibration.load(tumbling / "calibration.toml")
    distance = float(np.linalg.norm(truth[0].center - truth[1].center))
    # As users have it: one lens for all cameras, without poses.
    lenses = tmp_path / "lens.json"
    lenses.write_text(json.dumps({"K": truth[0].matrix.tolist(), "dist": truth[0].distortion.tolist()}))
    out = tmp_path / "rig.toml"
    arguments = ["calibrate", str(tumbling), "--intrinsics", str(lenses), "--out", str(out)]
    assert main([*arguments, "--distance", f"cam_0:cam_1={1000 * distance:.3f}mm", "--unit", "m"]) == 0
    printed = capsys.readouterr().out
    assert "passed" in printed
    assert "failed" not in printed
    assert "scale is unknown" not in printed
    found = calibration.load(out)
    assert found.unit == "m"
    expected = truth[1].camera_from_world * truth[0].camera_from_world.inv()
    error = found[1].camera_from_world * expected.inv()
    assert np.degrees(error.rotation.magnitude()) < 0.5
    assert np.linalg.norm(found[1].center - expected.inv().translation) < 0.02 * distance
    assert np.linalg.norm(found[1].center) == pytest.approx(distance, rel=1e-6)
    assert "# cam_1: fx fy" in out.read_text()
    assert "# spread of rotation axes" in out.read_text()
    page = out.with_suffix(".html").read_text()
    for text in ("Two halves of the landmarks", "Not observable", "spread of rotation axes", "From above", "cam_1"):
        assert text in page


def measure_error(file: Path, truth: Rig) -> float:
    """Return the error of the second camera's rotation, degrees."""
    found = calibration.load(file)
    rotations = [rig[1].rotation @ rig[0].rotation.T for rig in (found, truth)]
    return float(np.degrees(Rotation.from_matrix(rotations[0] @ rotations[1].T).magnitude()))


@pytest.mark.slow
def test_late_camera(tumbling: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its delay is not known: refused. By offsets.toml, as `sylpose track` reads it, or by --frame-offset: right."""
    folder, truth = Path(shutil.copytree(tumbling, tmp_path / "late")), calibration.load(tumbling / "calibration.toml")
    (folder / "boxes.toml").unlink()  # of frames that all cameras share
    write_tumbling(tmp_path / "other", 3)
    shutil.copy(tmp_path / "other" / "cam_1.mp4", folder)
    out = tmp_path / "rig.toml"
    arguments = ["calibrate", str(folder), "--intrinsics", str(folder / "calibration.toml"), "--out", str(out)]
    assert main(arguments) == 1
    assert "times agree" in capsys.readouterr().err
    assert main([*arguments, "--frame-offset", "cam_1=-3"]) == 0
    assert measure_error(out, truth) < 0.5
    (folder / "offsets.toml").write_text("cam_1 = -0.1")
    assert main(arguments) == 0
    assert "Time offsets: cam_1 -100 ms" in capsys.readouterr().out
    assert measure_error(out, truth) < 0.5


@pytest.mark.slow
def test_throws_give_meters_and_the_vertical(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Rendered in units of 0.83 m; gravity is known in the axes of the first camera."""
    folder, out = tmp_path / "recording", tmp_path / "rig.toml"
    poses = throw(2, 0.0, 1, spin_rate=1.5)[1][12:84]
    rig = arc(2, 50.0, 1.8, 420.0, (320, 240), height=[0.1, 0.35])
    path = rig[0].camera_from_world.inv() * poses
    actor = Actor(chamfered_box(0.4 * np.array([1.0, 0.74, 0.86]), 350.0, seed=4), lambda frame: path[int(frame)])
    write_sequence(folder, Scene(rig, (actor,), len(poses), 0), boxes=True)
    arguments = ["calibrate", str(folder), "--intrinsics", str(folder / "calibration.toml"), "--out", str(out)]
    assert main([*arguments, "--throw"]) == 0
    match = re.search(
        r"2 throws: scale ± ([0-9.]+) %.*--world up=([-0-9.,]+)\)", " ".join(capsys.readouterr().out.split())
    )
    assert match is not None
    found = calibration.load(out)
    ratio = np.linalg.norm(found[1].center) / np.linalg.norm(rig[1].center - rig[0].center) / UNIT
    assert found.unit == "m"
    assert abs(ratio - 1.0) < max(0.04 * float(match[1]), 0.01)
    assert np.degrees(np.arccos(-DOWN @ np.fromstring(match[2], sep=","))) < 1.0


def test_refused_recording_writes_no_file(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Twelve frames of a rotation about one axis do not determine the cameras."""
    out = session / "rig.toml"
    assert main(["calibrate", str(session), "--intrinsics", str(session / "calibration.toml"), "--out", str(out)]) == 1
    printed = capsys.readouterr()
    assert "failed" in printed.out
    assert "nothing was written" in printed.err
    assert "rotate" in printed.err
    assert not out.exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--free", "focal,skew"], "--free must be some of focal,principal,distortion, got 'skew'"),
        (["--distance", "cam_0=1m"], "--distance must be CAM:CAM=LENGTH"),
        (["--distance", "cam_0:cam_9=1m"], "two of the cameras cam_0, cam_1, cam_2"),
        (["--distance", "cam_0:cam_1=far"], "--distance must be a positive length"),
        (
            ["--distance", "cam_0:cam_1=1m", "--object-length", "1m"],
            "--distance and --object-length exclude each other",
        ),
        (["--throw", "--object-length", "1m"], "--object-length and --throw exclude each other"),
        (["--fov", "60"], "--fov and --intrinsics exclude each other"),
    ],
)
def test_wrong_options(change: list[str], message: str, session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = session / "rig.toml"
    lenses = str(session / "calibration.toml")
    assert main(["calibrate", str(session), "--intrinsics", lenses, "--out", str(out), *change]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_missing_lenses_and_cameras(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "rig.toml")]
    assert main(["calibrate", str(session), *out]) == 2
    assert "--intrinsics" in capsys.readouterr().err
    alone = Path(shutil.copytree(session, tmp_path / "alone"))
    without = ["--exclude-camera", "cam_1", "--exclude-camera", "cam_2"]
    lens = shutil.copy(alone / "calibration.toml", tmp_path / "lens.toml")
    for lenses in (str(alone / "calibration.toml"), f"cam_0={lens}"):  # the others need no lens
        assert main(["calibrate", str(alone), "--intrinsics", lenses, *without, *out]) == 2
        assert "two cameras or more" in capsys.readouterr().err
    assert main(["calibrate", str(alone), "--intrinsics", f"cam_0={lens}", "--exclude-camera", "cam_1", *out]) == 2
    assert "no lens of camera cam_2: give cam_2=FILE, or leave the camera out" in capsys.readouterr().err
    assert main(["calibrate", str(alone), "--fov", "exif", *out]) == 2
    assert "--fov: no focal length in the EXIF of cam_0, cam_1, cam_2" in capsys.readouterr().err


def test_option_values() -> None:
    assert parse_free(" focal, distortion") == ("focal", "distortion")
    assert parse_free("") == ()
    assert parse_scale("a:b=1.5m", None, ["a", "b"]) == KnownLength(1.5, "m", ("a", "b"))
    assert parse_scale(None, "0.3", ["a", "b"]) == KnownLength(0.3, "")
    assert parse_scale(None, None, ["a", "b"]) is None


def test_track_calibrates_and_tracks_on(tumbling: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The poses are those of the truth in the first camera's axes, within what is stated."""
    truth = calibration.load(tumbling / "calibration.toml")
    distance = float(np.linalg.norm(truth[0].center - truth[1].center))
    out = tmp_path / "out"
    out.mkdir()
    for name in ("calibration.toml", "calibration.estimated.toml", "calibration.estimated.html"):
        (out / name).write_text("of a user, or of an earlier run")
    known = ["--self-calibrate", "--distance", f"cam_0:cam_1={distance:.6f}m"]
    assert main(["track", str(tumbling), "--out", str(out), "--no-overlay", *known]) == 0
    assert "passed" in capsys.readouterr().out
    rig = calibration.load(out / "calibration.estimated.toml")
    used = calibration.load(out / "calibration.used.toml")
    assert used.unit == rig.unit == "m"
    np.testing.assert_array_equal(used[1].matrix, rig[1].matrix)
    np.testing.assert_allclose(used[1].center, rig[1].center)
    _, path = read_tum(tumbling / "groundtruth.tum")
    poses = truth[0].camera_from_world * path
    found = read_trajectory(out / "trajectory.csv")
    squares = []
    for k, frame in enumerate(found):
        if k and frame.is_measured:
            assert frame.world_from_object is not None
            R = poses[k].rotation * poses[0].rotation.inv()
            w = (R * frame.world_from_object.rotation.inv()).as_rotvec()
            squares.append(float(w @ np.linalg.solve(frame.covariance[:3, :3], w)) / 3.0)
    assert len(squares) > 0.9 * FRAMES
    assert np.mean(squares) < 4.0
    settings = (out / "settings.toml").read_text()
    assert "self_calibrate = true" in settings
    assert f'calibration = "{out / "calibration.estimated.toml"}"' in settings
    assert "<svg" in (out / "calibration.estimated.html").read_text()
    assert (out / "calibration.toml").read_text() == "of a user, or of an earlier run"
    assert not (out / "earlier_results").exists()
    # Results without it do not keep it.
    assert main(["track", str(tumbling), "--out", str(out), "--no-overlay", "--no-smooth", "--stop", "3"]) in (0, 1)
    assert not list(out.rglob("calibration.estimated.*"))
    assert (out / "calibration.toml").exists()


def make_found(rig: Rig, flight: FreeFlight | None = None) -> MotionCalibration:
    """Return a calibration in the axes of its first camera."""
    first = rig[0].camera_from_world.inv()
    rig = Rig([replace(camera, camera_from_world=camera.camera_from_world * first) for camera in rig])
    n, zeros = len(rig), np.zeros(len(rig))
    lenses = tuple(np.zeros((4 + len(camera.distortion),) * 2) for camera in rig)
    counts = np.ones(n, int)
    coverage = (Coverage(np.ones(GRID[::-1], int), np.ones(GRID[::-1]), np.nan),) * n
    return MotionCalibration(
        RigCalibration(rig, np.zeros((n, 6, 6)), lenses, counts, counts, zeros),
        (),
        {},
        1.0,
        0.5,
        (),
        1e-6 * np.eye(10 * n),
        coverage,
        None,
        np.zeros(1),
        RigidTransform.identity(1),
        flight,
    )


def test_calibration_outlives_a_run_that_does_not_begin(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is written before tracking; results of the earlier run are kept apart from it."""

    def fail(*_: object, **__: object) -> None:
        raise ValueError("no such body")

    out, truth = tmp_path / "out", calibration.load(session / "calibration.toml")
    out.mkdir()
    for name in ("trajectory.csv", "calibration.estimated.toml"):
        (out / name).write_text("earlier")
    monkeypatch.setattr(self_calibration, "self_calibrate", lambda *_, **__: make_found(truth))
    monkeypatch.setattr(runs, "write_run_metadata", fail)
    assert main(["track", str(session), "--out", str(out), "--self-calibrate"]) == 2
    assert "no such body" in capsys.readouterr().err
    assert calibration.load(out / "calibration.estimated.toml").names == truth.names
    for name in ("trajectory.csv", "calibration.estimated.toml"):
        assert (out / "earlier_results" / name).read_text() == "earlier"
    assert not (out / "trajectory.csv").exists()


def test_earlier_results_return_if_a_run_does_not_begin(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if the run uses their calibration, which stays, as it does after a run."""
    out, truth = tmp_path / "out", calibration.load(session / "calibration.toml")
    out.mkdir()
    calibration.save(truth, out / "calibration.estimated.toml")
    (out / "calibration.estimated.html").write_text("earlier")
    (out / "trajectory.csv").write_text("earlier")
    there = open_session(session, calibration=out / "calibration.estimated.toml")
    with monkeypatch.context() as patch:
        patch.setattr(runs, "write_run_metadata", lambda *_, **__: 1 / 0)
        for its in (there, session):
            with pytest.raises(ZeroDivisionError):
                runs.track_session(its, out)
            assert (out / "trajectory.csv").read_text() == "earlier"
            assert (out / "calibration.estimated.html").read_text() == "earlier"
            assert calibration.load(out / "calibration.estimated.toml").names == truth.names
    options = RunOptions(stop=3, overlay=False, smooth=False)
    runs.track_session(there, out, options)
    assert (out / "calibration.estimated.html").exists()
    # Another calibration's results, with a covariance of its own: the file is of earlier ones.
    covariance = 1e-6 * np.eye(10 * len(truth))
    runs.track_session(session, out, replace(options, calibration_covariance=covariance))
    assert not list(out.rglob("calibration.estimated.*"))


@pytest.mark.parametrize("name", ["calibration.refined.toml", "calibration.refined.end.toml"])
def test_a_refined_calibration_there_stays_if_a_run_uses_it(session: Path, tmp_path: Path, name: str) -> None:
    """The page shows the cameras that the run used, not those at the start of an earlier run."""
    out, truth = tmp_path / "out", calibration.load(session / "calibration.toml")
    out.mkdir()
    for file in ("calibration.refined.toml", "calibration.refined.end.toml"):
        calibration.save(Rig(truth.cameras[::-1], truth.unit), out / file)
    calibration.save(truth, out / name)
    (out / "trajectory.csv").write_text("earlier")
    there = open_session(session, calibration=out / name)
    options = RunOptions(stop=3, overlay=False, smooth=False)
    runs.track_session(there, out, options)
    assert [file.name for file in out.glob("calibration.refined*")] == [name]
    assert read_run(out)[1].names == truth.names
    # The run used one camera of those in the file.
    runs.track_session(open_session(session, calibration=out / name, without=truth.names[1:]), out, options)
    assert read_run(out)[1].names == truth.names[:1]


@pytest.mark.parametrize(
    ("offsets", "message"),
    [({"cam_9": 0.1}, "offsets: no camera 'cam_9' in the rig"), ({"cam_0": np.nan}, "offsets: cam_0: nan is not")],
)
def test_offsets_of_python_callers_are_checked(
    session: Path, tmp_path: Path, offsets: dict[str, float], message: str
) -> None:
    opened = open_session(session)
    with pytest.raises(ValueError, match=message):
        self_calibration.self_calibrate(opened, offsets=offsets)
    with pytest.raises(ValueError, match=message):
        runs.track_session(opened, tmp_path / "out", RunOptions(offsets=offsets))


def test_vertical_is_in_the_axes_of_the_calibration(session: Path) -> None:
    """The advice, taken, makes the vertical the z axis."""
    rig = calibration.load(session / "calibration.toml")
    gravity = np.array([1.0, 9.0, -3.0])
    flight = FreeFlight(gravity, np.zeros(3), 1e-6 * np.eye(6), ((0, 8), (9, 18)), 1e-3)
    found = make_found(rig, flight)
    turned = transform_rig(found.calibration.rig, World(RigidTransform.from_rotation(Rotation.from_rotvec([1, 2, 3]))))
    for its in (found, locate(found, turned)):
        match = re.search(r"--world (up=[-0-9.,]+)", describe_flight(its))
        assert match is not None
        world = parse_up_world(match[1], "")
        assert world is not None
        up = transform_rig(its.calibration.rig, world)[0].rotation.T @ flight.up
        np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=2e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--free", "focal"], "--free: only with --self-calibrate"),
        (["--distance", "cam_0:cam_1=1m"], "--distance: only with --self-calibrate"),
        (["--throw"], "--throw: only with --self-calibrate"),
        (["--self-calibrate", "--fov", "200"], "--fov must be 1 to 130 degrees"),
        (["--self-calibrate", "--resume"], "--resume: not with --self-calibrate"),
        (["--self-calibrate", "--refine-calibration"], "--refine-calibration: not with --self-calibrate"),
        (["--self-calibrate", "--follow"], "--self-calibrate: only recordings can be tracked twice"),
        # Before the calibration, which takes minutes and would be refused here with exit code 1.
        (["--self-calibrate", "--set", "size=1"], "--set: 'size' is not one of"),
        (["--self-calibrate", "--unit", "mm"], "--unit: give a length"),
        (["--self-calibrate", "--distance", "cam_0:cam_1=1m", "--unit", "ell"], "--unit: 'ell' is not one of"),
        (["--self-calibrate", "--offsets", "none.toml"], "none.toml"),
        (["--self-calibrate", "--world", "up=high"], "'up=high': up=0,-1,0 or up=-y is expected"),
        (["--self-calibrate", "--world", "chessboard:9x6,square=25mm"], "the calibration has no unit"),
        (["--self-calibrate", "--stream", "tcp://a:1"], "--stream: expected - for stdout or udp://HOST:PORT"),
        (["--self-calibrate", "--object", "none.npz"], "none.npz"),
        (["--self-calibrate", "--object", "2"], "object 2: boxes or masks select the object; omit the number"),
        (["--self-calibrate", "--out", "."], "this is the recording's folder"),
    ],
)
def test_track_refuses_options(
    change: list[str],
    message: str,
    session: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(session)
    assert main(["track", str(session), "--out", str(tmp_path / "out"), *change]) == 2
    assert message in capsys.readouterr().err
