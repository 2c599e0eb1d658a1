"""Output of `sylpose track`: streams, quiet and verbose modes, and the recorded settings."""

from __future__ import annotations

import json
import shutil
import socket
import tomllib
from pathlib import Path

import numpy as np
import pytest

from sylpose import __version__
from sylpose.commands.main import main
from sylpose.commands.track_display import open_pose_stream
from sylpose.io import calibration
from sylpose.io.capture import open_session
from sylpose.report.files import format_pose_line, read_trajectory
from sylpose.results import FramePose
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.runs.run_metadata import SETTINGS, USED_CALIBRATION
from sylpose.status import FrameStatus

pytestmark = pytest.mark.usefixtures("undrawn")

ASKED = ("--no-overlay", "--no-smooth", "--stop", "3")


def test_stream_json_lines_to_stdout(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["track", str(recording), "--out", str(tmp_path), *ASKED, "--stream", "-"]) == 0
    out, err = capsys.readouterr()
    lines = [json.loads(line) for line in out.splitlines()]
    found = read_trajectory(tmp_path / "trajectory.csv")
    assert [line["frame"] for line in lines] == [*range(3)]
    for line, pose in zip(lines, found, strict=True):
        assert (line["status"], line["unit"], line["reason"]) == (pose.status.value, found.unit, pose.reason)
        np.testing.assert_allclose(line["position"], pose.position, atol=1e-9)
        np.testing.assert_allclose(np.radians(line["sigma_deg"]), pose.sigma[:3], rtol=1e-4, atol=1e-12)
        assert list(line["inliers"].values()) == pose.inliers.tolist()
    # All other output goes to stderr.
    assert "Tracked" in err


def test_stream_to_udp(recording: Path, tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as received:
        received.bind(("127.0.0.1", 0))
        received.settimeout(60)
        to = f"udp://127.0.0.1:{received.getsockname()[1]}"
        assert main(["track", str(recording), "--out", str(tmp_path), *ASKED, "--stream", to]) == 0
        frames = [json.loads(received.recv(1 << 16))["frame"] for _ in range(3)]
    assert frames == [*range(3)]


def test_udp_stream_without_receiver() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with open_pose_stream(f"udp://127.0.0.1:{port}") as tell:
        for _ in range(3):  # the system refuses from the second one on
            tell("{}")


@pytest.mark.parametrize(
    "to", ["", "udp:", "udp://", "udp://host", "udp://127.0.0.1:0", "udp://127.0.0.1:65536", "tcp://127.0.0.1:9000",
           "udp://no such host:9", "udp://..:9"]
)  # fmt: skip
def test_invalid_stream_destinations(
    to: str, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["track", str(recording), "--out", str(tmp_path / "out"), "--stream", to]) == 2
    out, err = capsys.readouterr()
    assert err.startswith("sylpose: --stream")
    assert err.count("\n") == 1
    assert not out
    assert not (tmp_path / "out").exists()


def test_quiet_prints_only_warnings(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["track", str(session), "--out", str(tmp_path / "a"), *ASKED, "-q"]) == 0
    assert capsys.readouterr() == ("", "")
    # A truncated video is reported.
    video = session / "cam_1.mp4"
    video.write_bytes(video.read_bytes()[: video.stat().st_size * 6 // 10])
    main(["track", str(session), "--out", str(tmp_path / "b"), "--no-overlay", "--no-smooth", "--quiet"])
    out, err = capsys.readouterr()
    assert out == ""
    assert "cam_1" in err


def test_verbose_prints_one_line_per_frame(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["track", str(recording), "--out", str(tmp_path), *ASKED, "--verbose"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("frame ")]
    assert len(lines) == 3
    assert "tracked, ±" in lines[-1]
    assert "cam_0 " in lines[-1]
    assert " of " in lines[-1]


def test_quiet_and_verbose_exclude_each_other(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["track", str(recording), "--out", str(tmp_path / "out"), "-q", "-v"]) == 2
    assert capsys.readouterr().err == "sylpose: --quiet and --verbose exclude each other\n"
    assert not (tmp_path / "out").exists()


def test_pose_line_of_unknown_values() -> None:
    pose = FramePose(3, 0.5, FrameStatus.LOST, None, np.full((6, 6), np.inf), np.zeros(2, int), np.full(2, np.nan))
    line = json.loads(format_pose_line(pose, ("a", "b"), "", object="cup"))
    assert next(iter(line)) == "object"
    assert line["position"] is line["quaternion"] is None
    assert line["sigma_deg"] == line["sigma_position"] == [None] * 3
    assert (line["inliers"], line["matches"]) == ({"a": 0, "b": 0}, {})


def test_result_contains_settings_and_calibration(recording: Path, tmp_path: Path) -> None:
    run = track_session(open_session(recording), tmp_path, RunOptions(overlay=False, smooth=False, stop=3, seed=3))
    assert {tmp_path / SETTINGS, tmp_path / USED_CALIBRATION} <= set(run.files)
    kept = tomllib.loads((tmp_path / SETTINGS).read_text())
    assert kept["recording"] == str(recording.resolve())
    assert (kept["options"]["seed"], kept["options"]["stop"], kept["options"]["smooth"]) == (3, 3, False)
    assert kept["versions"]["sylpose"] == __version__
    assert len(kept["checksums"]["calibration"]) == 32
    used, given = calibration.load(tmp_path / USED_CALIBRATION), open_session(recording).rig
    assert used.names == given.names
    for one, other in zip(used, given, strict=True):
        np.testing.assert_array_equal(one.camera_from_world.as_matrix(), other.camera_from_world.as_matrix())
        np.testing.assert_array_equal(one.matrix, other.matrix)


def test_view_uses_calibration_of_result(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "somewhere"
    assert main(["track", str(recording), "--out", str(out), *ASKED]) == 0
    moved = Path(shutil.move(out, tmp_path / "else"))
    assert main(["view", str(moved), "cam_1", "--format", "svg"]) == 0
    assert (moved / "view_cam_1.svg").exists()
    assert (moved / "view_cam_1.csv").exists()
    # Views of an earlier run are removed by a new run.
    assert main(["track", str(recording), "--out", str(moved), *ASKED, "--format", "pdf"]) == 0
    assert not list(moved.glob("view_*"))
    assert {file.name for file in moved.glob("report.*")} == {"report.pdf", "report.html"}
    assert main(["view", str(moved), "cam_9"]) == 2
    assert "no camera 'cam_9'" in capsys.readouterr().err
