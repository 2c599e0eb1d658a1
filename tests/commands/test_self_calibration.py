"""`sylpose calibrate` without a board, as typed: a rendered tumbling block, refusals, and wrong options."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from benchmarks.self_calibration import KINDS, make_scene
from sylpose.commands.main import main
from sylpose.io import calibration
from sylpose.report.files import read_trajectory, read_tum
from sylpose.runs.self_calibration import KnownLength, parse_free, parse_scale
from sylpose.simulate import Scene, arc, write_sequence
from tests.conftest import make_once

FRAMES = 36


def write_tumbling(folder: Path) -> None:
    """Render a block that tumbles by 200 degrees before two cameras."""
    kind = KINDS["near"]
    whole = make_scene(kind, 3)
    target = whole.object_poses().translation.mean(axis=0)
    rig = arc(2, 50.0, 1.2, 420.0, (320, 240), height=[0.1, 0.35], target=target)

    def path(frame: float) -> RigidTransform:
        return whole.actors[0].path(1.4 * frame)

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
    assert main(["calibrate", str(alone), "--intrinsics", str(alone / "calibration.toml"), *without, *out]) == 2
    assert "two cameras or more" in capsys.readouterr().err


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
    known = ["--self-calibrate", "--distance", f"cam_0:cam_1={distance:.6f}m"]
    assert main(["track", str(tumbling), "--out", str(out), "--no-overlay", *known]) == 0
    assert "passed" in capsys.readouterr().out
    rig = calibration.load(out / "calibration.toml")
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
    assert "self_calibrate = true" in (out / "settings.toml").read_text()


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
    ],
)
def test_track_refuses_options(
    change: list[str], message: str, session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["track", str(session), "--out", str(tmp_path / "out"), *change]) == 2
    assert message in capsys.readouterr().err
