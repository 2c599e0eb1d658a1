"""The command line: files, output, exit codes, invalid input and interrupts."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

import sylpose
from sylpose.commands import demo
from sylpose.commands.main import main
from sylpose.display import format_length
from sylpose.frames import FrameSet
from sylpose.io import calibration
from sylpose.io.capture import Session, open_session
from sylpose.methods import FEATURES, METHODS
from sylpose.report.files import read_trajectory, read_tum
from sylpose.report.rigview import find_axes_intersection
from sylpose.rig import Camera, Rig, make_look_at_camera
from sylpose.runs import check as checks
from sylpose.runs.check import preview_moving_object
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.frame_solvers import SOLVERS
from sylpose.tracking.tracker import Tracker
from tests.conftest import FRAMES
from tests.paths import DATA
from tests.recordings import write_box_recording

pytestmark = pytest.mark.usefixtures("undrawn")

OUTPUTS = {"trajectory.tum", "trajectory.csv", "tracked.tum", "tracked.csv", "report.png", "report.html", "overlay.mp4"}
OUTPUTS |= {"settings.toml", "calibration.used.toml"}  # no object.npz: 12 frames give too few landmarks


class Result:
    """Exit code and output of a command."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err


Command = Callable[..., Result]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Command:
    """Return a function that runs a command in this process."""

    def command(*args: object) -> Result:
        capsys.readouterr()
        code = main([str(arg) for arg in args])
        return Result(code, *capsys.readouterr())

    return command


def error_message(result: Result) -> str:
    """Return the error message of a rejected command: one line, no traceback, exit code 2."""
    assert result.code == 2, result.out + result.err
    lines = result.err.strip().splitlines()
    assert len(lines) == 1, result.err
    assert lines[0].startswith("sylpose: ")
    return lines[0]


def rewrite_calibration(session: Path, change: Callable[[str], str]) -> None:
    path = session / "calibration.toml"
    path.write_text(change(path.read_text()))


def subset(session: Path, names: list[str]) -> None:
    """Keep only some cameras of a session."""
    rig = calibration.load(session / "calibration.toml")
    calibration.save(rig.subset(names), session / "calibration.toml")
    for name in set(rig.names) - set(names):
        (session / f"{name}.mp4").unlink()
    (session / "boxes.toml").unlink()


def remux(source: Path, target: Path, frames: int | None = None, **options: str) -> None:
    """Copy a video's packets, all or the first few."""
    with av.open(str(source)) as a, av.open(str(target), "w", options=options) as b:
        stream = b.add_stream_from_template(a.streams.video[0])
        packets = [p for p in a.demux(a.streams.video[0]) if p.dts is not None]
        for packet in packets[:frames]:
            packet.stream = stream
            b.mux(packet)


def truncate_video(path: Path, share: float) -> None:
    """Truncate a video as after a power failure: its header at the front is complete, its frames are not."""
    whole = path.with_suffix(".tmp.mp4")
    remux(path, whole, movflags="faststart")
    path.write_bytes(whole.read_bytes()[: int(share * whole.stat().st_size)])
    whole.unlink()


def n_video_frames(path: Path) -> int:
    with av.open(str(path)) as container:
        return sum(1 for _ in container.decode(video=0))


# --- tracking --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tracked(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """Run the whole command once in its own process; return its output folder and the completed process."""
    out = tmp_path_factory.mktemp("out")
    done = subprocess.run(
        [sys.executable, "-m", "sylpose", "track", str(recording), "--out", str(out)],
        capture_output=True,
        text=True,
        check=False,
    )
    return out, done


def test_track_writes_all_files(tracked: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    out, done = tracked
    assert done.returncode == 0, done.stderr
    assert {file.name for file in out.iterdir()} == OUTPUTS
    trajectory = read_trajectory(out / "trajectory.csv")
    assert [frame.index for frame in trajectory] == list(range(FRAMES))
    times, poses = read_tum(out / "trajectory.tum")
    assert len(times) == int(trajectory.measured_mask.sum()) >= FRAMES - 2
    assert np.allclose(np.diff(times), 1 / 30) or len(times) < FRAMES
    assert np.allclose(poses[0].rotation.as_matrix(), np.eye(3))
    assert n_video_frames(out / "overlay.mp4") == FRAMES
    with av.open(str(out / "overlay.mp4")) as video:
        assert video.streams.video[0].average_rate == 30
    assert cv2.imread(str(out / "report.png")) is not None


def test_track_prints_a_summary(tracked: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    out, done = tracked
    assert re.search(rf"Tracked +\d+ of {FRAMES} frames", done.stdout)
    for words in (
        "Rotation",
        "Translation",
        "cam_0",
        "cam_2",
        "frames/s",
        "tracking",
        *(str(out / f) for f in OUTPUTS),
    ):
        assert words in done.stdout
    assert "mm" in done.stdout


def test_track_is_quiet_and_plain_without_a_terminal(tracked: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    _, done = tracked
    assert done.stderr == ""
    assert "\x1b" not in done.stdout
    assert all(line == line.rstrip() for line in done.stdout.splitlines())


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs a pseudo-terminal")
def test_track_shows_progress_on_a_terminal(recording: Path, tmp_path: Path) -> None:
    leader, follower = os.openpty()
    command = [sys.executable, "-m", "sylpose", "track", str(recording), "--stop", "4", "--no-overlay"]
    process = subprocess.Popen([*command, "--out", str(tmp_path)], stdout=follower, stderr=follower)
    os.close(follower)
    output = b""
    while True:
        try:
            part = os.read(leader, 65536)
        except OSError:  # on Linux: the other side is closed
            break
        if not part:
            break
        output += part
    os.close(leader)
    assert process.wait() == 0
    for words in ("Tracking", "3 cameras", "frames/s", "inliers", "/4"):
        assert words in output.decode()


def test_default_output_folder_and_removal_of_old_files(run: Command, session: Path) -> None:
    out = session / "sylpose"
    out.mkdir()
    (out / "overlay.mp4").write_bytes(b"of an earlier run")
    result = run("track", session, "--start", 2, "--stop", 9, "--every", 3, "--no-overlay")
    assert result.code == 0, result.err
    assert {file.name for file in out.iterdir()} == OUTPUTS - {"overlay.mp4"}
    assert [frame.index for frame in read_trajectory(out / "trajectory.csv")] == [2, 5, 8]
    assert "boxes are assumed to be of frame 2" in result.out
    assert run("check", session).code == 0  # the outputs are not mistaken for cameras


def test_velocities(run: Command, recording: Path, tmp_path: Path) -> None:
    """Of refined poses; too few of them are reported, and the rest is written."""
    result = run("track", recording, "--no-overlay", "--velocity", "--out", tmp_path)
    assert result.code == 0, result.err
    assert "velocity.csv" in result.out
    header, *rows = (tmp_path / "velocity.csv").read_text().splitlines()
    columns = [dict(zip(header.split(","), row.split(","), strict=True)) for row in rows]
    trajectory = read_trajectory(tmp_path / "trajectory.csv")
    expected = trajectory.differentiate().linear
    found = [[float(row[name]) for name in ("vx", "vy", "vz")] for row in columns]
    assert (np.abs(found - expected.velocity) < 4.0 * expected.velocity_sd).all()
    result = run("track", recording, "--no-overlay", "--velocity", "--stop", 3, "--out", tmp_path / "short")
    assert "No velocity.csv: velocities need at least 12 measured poses, got 3" in " ".join(result.out.split())
    assert (tmp_path / "short" / "trajectory.csv").exists()


def test_every_reduces_the_overlay_frame_rate(run: Command, recording: Path, tmp_path: Path) -> None:
    assert run("track", recording, "--every", 3, "--no-smooth", "--out", tmp_path).code == 0
    assert n_video_frames(tmp_path / "overlay.mp4") == 4
    with av.open(str(tmp_path / "overlay.mp4")) as video:
        assert video.streams.video[0].average_rate == 10


# tests/tracking/test_tracker.py tests all of them.
@pytest.mark.parametrize(
    "method", ["epipolar", *(pytest.param(method, marks=pytest.mark.slow) for method in ("sylvester", "known-depth"))]
)
def test_other_methods_can_be_chosen(run: Command, recording: Path, tmp_path: Path, method: str) -> None:
    result = run("track", recording, "--stop", 3, "--no-overlay", "--no-smooth", "--method", method, "--out", tmp_path)
    assert result.code in (0, 1), result.err
    assert len(read_trajectory(tmp_path / "trajectory.csv")) == 3


def test_single_camera_is_tracked_and_scale_is_reported(run: Command, session: Path) -> None:
    subset(session, ["cam_1"])
    (session / "boxes.toml").write_text(f"cam_1 = {true_box(session, 'cam_1')}\n")
    result = run("track", session, "--no-overlay", "--no-smooth", "--stop", 4)
    assert result.code == 0, result.err
    assert "not observable with one camera" in result.out
    assert "first distances" in result.out
    assert read_trajectory(session / "sylpose" / "trajectory.csv").unit == "first distances"


def true_box(session: Path, name: str) -> list[int]:
    """Return the object's box in the first frame from ground truth."""
    camera = calibration.load(session / "calibration.toml")[name]
    _, poses = read_tum(session / "groundtruth.tum")
    depth = camera.camera_from_world.apply(poses[0].translation)[2]
    half = 0.11 * camera.focal / depth
    x, y = camera.project(poses[0].translation)[0]
    return [int(x - half), int(y - half), int(2 * half), int(2 * half)]


def test_track_prints_warnings_before_and_after_a_failure(run: Command, session: Path) -> None:
    """The calibration contains inverted poses."""
    (session / "boxes.toml").unlink()
    rig = calibration.load(session / "calibration.toml")
    inverse = Rig([replace(camera, camera_from_world=camera.camera_from_world.inv()) for camera in rig], rig.unit)
    calibration.save(inverse, session / "calibration.toml")
    # In a third frame one camera alone may see a motion.
    result = run("track", session, "--no-overlay", "--stop", 2)
    assert result.code == 1, result.out
    assert "probably contains world_from_camera" in " ".join(result.out.split())
    assert result.err.index("no frame could be solved") < result.err.index("probably contains world_from_camera")


def test_nothing_found_is_exit_code_1(run: Command, session: Path) -> None:
    (session / "boxes.toml").unlink()
    still = cv2.cvtColor(np.random.default_rng(0).integers(0, 255, (240, 320), np.uint8), cv2.COLOR_GRAY2BGR)
    for name in ("cam_0", "cam_1", "cam_2"):
        (session / f"{name}.mp4").unlink()
        (session / name).mkdir()
        for k in range(3):
            cv2.imwrite(str(session / name / f"{k}.png"), still)
    result = run("track", session)
    assert result.code == 1
    assert "no frame could be solved" in result.err
    assert f"sylpose box {session} draws them" in result.err
    assert {file.name for file in (session / "sylpose").iterdir()} == OUTPUTS
    with av.open(str(session / "sylpose" / "overlay.mp4")) as video:
        assert video.streams.video[0].average_rate == 2


# --- partial results are kept ----------------------------------------------------------------------------------------


def make_endless(session: Path, n: int = 300) -> None:
    """Replace a session's videos by folders of n images that play them back and forth."""
    order = [*range(FRAMES), *range(FRAMES - 2, 0, -1)]
    for name in ("cam_0", "cam_1", "cam_2"):
        folder = session / name
        folder.mkdir()
        with av.open(str(session / f"{name}.mp4")) as video:
            for k, frame in enumerate(video.decode(video=0)):
                cv2.imwrite(str(folder / f"{k}.bmp"), frame.to_ndarray(format="bgr24"))
        (session / f"{name}.mp4").unlink()
        for k in range(FRAMES, n):
            os.link(folder / f"{order[k % len(order)]}.bmp", folder / f"{k}.bmp")


@pytest.mark.skipif(sys.platform == "win32", reason="sends a POSIX signal")
@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_interrupt_keeps_partial_results(session: Path, how: signal.Signals) -> None:
    make_endless(session)
    out = session / "sylpose"
    process = subprocess.Popen(
        [sys.executable, "-m", "sylpose", "track", str(session)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Children of a shell that starts the tests in the background ignore SIGINT otherwise.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and process.poll() is None:
        if (out / "tracked.csv").exists() and (out / "tracked.csv").read_text().count("\n") > 4:
            break
        time.sleep(0.02)
    process.send_signal(how)
    _, err = process.communicate(timeout=60)
    stem = "trajectory" if how == signal.SIGINT else "tracked"  # when killed, it cannot rename its result
    for name in (f"{stem}.csv", f"{stem}.tum"):
        assert (out / name).read_text().endswith("\n")
    trajectory = read_trajectory(out / f"{stem}.csv")
    assert [frame.index for frame in trajectory] == list(range(len(trajectory)))
    assert 4 <= len(trajectory) < 300
    assert len(read_tum(out / f"{stem}.tum")[0]) in (trajectory.measured_mask.sum(), trajectory.measured_mask.sum() - 1)
    if how == signal.SIGINT:
        assert process.returncode == 130
        (sentence,) = err.strip().splitlines()
        output = re.fullmatch(
            r"sylpose: interrupted after (\d+) of 300 frames; the results so far are in (.*)", sentence
        )
        assert output is not None
        assert len(trajectory) == int(output[1])
        assert output[2] == str(out)
        assert cv2.imread(str(out / "report.png")) is not None
        assert len(trajectory) == n_video_frames(out / "overlay.mp4")


def test_exception_keeps_partial_results_and_its_traceback(
    run: Command, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    step = Tracker.step

    def breaks(self: Tracker, frames: FrameSet) -> list[TrackedFrame]:
        if frames.index == 3:
            raise np.linalg.LinAlgError("a ValueError, but a bug")
        return step(self, frames)

    monkeypatch.setattr(Tracker, "step", breaks)
    with pytest.raises(np.linalg.LinAlgError):
        run("track", recording, "--out", tmp_path)
    assert f"stopped after 3 of 12 frames; the results so far are in {tmp_path}" in capsys.readouterr().err
    assert len(read_trajectory(tmp_path / "trajectory.csv")) == 3
    assert n_video_frames(tmp_path / "overlay.mp4") == 3
    assert (tmp_path / "report.png").exists()


def test_offsets_in_use_are_printed(run: Command, session: Path, tmp_path: Path) -> None:
    (session / "offsets.toml").write_text("cam_0 = 0.0\ncam_1 = 0.004\ncam_2 = -0.002\n")
    result = run("track", session, "--stop", "2", "--no-overlay", "--no-smooth", "--out", tmp_path / "out")
    assert result.code == 0, result.err
    assert "Time offsets: cam_1 4 ms, cam_2 -2 ms (from --offsets, or offsets.toml in the recording)." in result.out


def test_progress_lines_without_a_terminal(
    run: Command, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sylpose.runs.progress.SECONDS_BETWEEN_LINES", 0.0)
    result = run("track", recording, "--stop", "3", "--no-overlay", "--no-smooth", "--out", tmp_path / "out")
    lines = [line for line in result.err.splitlines() if line.startswith("sylpose: tracked ")]
    assert [line.split(",")[0] for line in lines] == [f"sylpose: tracked {k} of 3 frames" for k in (1, 2, 3)]
    assert lines[-1].endswith("inliers")


def test_failure_of_the_overlay_is_reported(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Command
) -> None:
    def full(*_: Any) -> None:
        raise OSError("cannot write overlay.mp4: no space left on device")

    monkeypatch.setattr("sylpose.report.overlay.OverlayWriter.write", full)
    result = run("track", recording, "--stop", 3, "--no-smooth", "--out", tmp_path)
    assert result.code == 2
    assert "overlay.mp4: no space left" in result.err
    assert len(read_trajectory(tmp_path / "trajectory.csv")) >= 1
    assert (tmp_path / "report.png").exists()


def test_truncated_video_is_tracked_and_reported(run: Command, session: Path) -> None:
    truncate_video(session / "cam_1.mp4", 0.6)
    result = run("track", session, "--no-overlay", "--no-smooth")
    assert result.code == 0, result.err
    assert re.search(r"cam_1: cam_1.mp4 is cut off after \d+ of 12 frames", result.out)
    trajectory = read_trajectory(session / "sylpose" / "trajectory.csv")
    assert len(trajectory) == FRAMES
    assert trajectory[-1].inliers[1] == 0


def test_track_session_from_python(recording: Path, tmp_path: Path) -> None:
    seen: list[int] = []
    result = track_session(
        open_session(recording),
        tmp_path,
        RunOptions(stop=3, overlay=False),
        on_frame=lambda _, f: seen.append(f.pose.index),
    )
    assert seen == [0, 1, 2]
    assert len(result.trajectory) == 3
    assert {file.name for file in result.files} == OUTPUTS - {"overlay.mp4"}
    stages = {"search for what moves", "reading", "tracking", "saving", "smoothing", "plots"}
    assert set(result.seconds) == stages
    assert min(result.seconds.values()) >= 0
    with pytest.raises(ValueError, match="magic"):
        track_session(open_session(recording), tmp_path, RunOptions(method="magic"))
    with pytest.raises(ValueError, match="start"):
        track_session(open_session(recording), tmp_path / "new", RunOptions(start=99))
    with pytest.raises(ValueError, match="calibration_covariance"):
        track_session(open_session(recording), tmp_path / "new", RunOptions(calibration_covariance=np.eye(10)))
    assert not (tmp_path / "new").exists()


# --- bad input -------------------------------------------------------------------------------------------------------


def test_no_such_folder(run: Command, tmp_path: Path) -> None:
    assert "nowhere: no such folder" in error_message(run("track", tmp_path / "nowhere"))
    assert "nowhere: no such folder" in error_message(run("check", tmp_path / "nowhere"))


def test_invalid_input_gives_no_traceback(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sylpose", "track", str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr.startswith("sylpose: ")
    assert done.stderr.count("\n") == 1


def test_no_calibration_or_two(run: Command, session: Path) -> None:
    shutil.copy(session / "calibration.toml", session / "calibration_old.toml")
    assert "2 calibrations" in error_message(run("track", session))
    (session / "calibration_old.toml").unlink()
    (session / "calibration.toml").rename(session / "lenses.toml")
    assert "no calibration" in error_message(run("track", session))
    (session / "cam_1.mp4").rename(session / "1.mp4")
    result = run("check", session, "--calibration", session / "lenses.toml")
    assert result.code == 0, result.err
    assert "cam_1 (1.mp4)" in result.out  # names are matched tolerantly, and the match is shown


def test_camera_without_video_and_video_without_camera(run: Command, session: Path) -> None:
    (session / "cam_2.mp4").rename(session / "cam_7.mp4")
    output = error_message(run("track", session))
    assert "camera cam_2" in output
    assert "cam_7.mp4" in output


def test_unreadable_video(run: Command, session: Path) -> None:
    (session / "cam_1.mp4").write_bytes(b"no video")
    assert "cam_1.mp4" in error_message(run("track", session))


def test_size_that_does_not_match(run: Command, session: Path) -> None:
    rewrite_calibration(session, lambda text: text.replace("[320, 240]", "[640, 480]"))
    output = error_message(run("track", session))
    assert "320x240" in output
    assert "640x480" in output


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: re.sub(r"rotation = \[[^]]*\],?", "rotation = [", text, count=1), "calibration.toml"),
        (lambda text: re.sub(r"(\[\n +\[)[-0-9.e]+", r"\1nan", text, count=1), "cam_0"),
        (lambda text: re.sub(r"distortion = \[[^]]*\]\n", "", text, count=1), "distortion"),
    ],
    ids=["not TOML", "NaN", "missing key"],
)
def test_broken_calibration(run: Command, session: Path, change: Callable[[str], str], words: str) -> None:
    rewrite_calibration(session, change)
    assert words in error_message(run("track", session))


def test_invalid_rotation_matrix(run: Command, session: Path) -> None:
    path = session / "calibration.json"
    calibration.save(calibration.load(session / "calibration.toml"), path)
    (session / "calibration.toml").unlink()
    data = json.loads(path.read_text())
    rotation = data["cameras"][1]["R"]
    rotation["data"] = [2 * number for number in rotation["data"]]
    path.write_text(json.dumps(data))
    assert "cam_1" in error_message(run("track", session))


def test_box_outside_the_image_and_boxes_that_do_not_intersect(run: Command, session: Path) -> None:
    (session / "boxes.toml").write_text("cam_0 = [280, 10, 100, 100]\n")
    assert "cam_0" in error_message(run("track", session))
    (session / "boxes.toml").write_text("cam_0 = [0, 0, 40, 40]\ncam_2 = [270, 190, 40, 40]\n")
    assert "boxes" in error_message(run("track", session))
    result = run("check", session)
    assert "boxes" in error_message(result)
    assert "Camera" in result.out  # the rig's table is printed nevertheless
    assert "boxes.txt" in error_message(run("track", session, "--boxes", session / "boxes.txt"))


def test_empty_mask(run: Command, session: Path) -> None:
    (session / "masks").mkdir()
    cv2.imwrite(str(session / "masks" / "cam_0.png"), np.zeros((240, 320), np.uint8))
    output = error_message(run("track", session))
    assert "cam_0.png" in output
    assert "empty" in output


def test_offsets(run: Command, session: Path) -> None:
    for wrong in ("cam_1", "cam_1=x", "=3"):
        assert wrong in error_message(run("track", session, "--frame-offset", wrong))
    assert "cam_9" in error_message(run("track", session, "--frame-offset", "cam_9=2"))
    result = run("check", session, "--frame-offset", "cam_1=2", "--frame-offset", "cam_2=-1")
    assert result.code == 0
    assert "cam_1 has 2 to 13" in result.out


def test_different_frame_counts_are_reported(run: Command, session: Path) -> None:
    remux(session / "cam_2.mp4", session / "short.mp4", frames=9)
    (session / "short.mp4").replace(session / "cam_2.mp4")
    result = run("track", session, "--no-overlay", "--stop", 2)
    assert result.code == 0, result.err
    assert "different numbers of frames" in result.out
    assert "cam_2 has 0 to 8" in result.out


def test_out_that_cannot_be_written(run: Command, recording: Path, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    for out in (file, file / "below"):
        assert str(out) in error_message(run("track", recording, "--out", out))
        assert str(out) in error_message(run("check", recording, "--out", out))
    (tmp_path / "taken" / "trajectory.tum").mkdir(parents=True)
    assert "trajectory.tum" in error_message(run("track", recording, "--out", tmp_path / "taken"))


@pytest.mark.parametrize(
    "args",
    [("--start", "99"), ("--start", "5", "--stop", "5"), ("--every", "0"), ("--method", "magic"), ("--every", "x")],
)
def test_wrong_options(run: Command, recording: Path, tmp_path: Path, args: tuple[str, ...]) -> None:
    result = run("track", recording, "--out", tmp_path / "out", *args)
    assert result.code == 2
    assert args[0].strip("-") in result.err
    assert "Traceback" not in result.err
    assert not (tmp_path / "out").exists()


# --- check -----------------------------------------------------------------------------------------------------------


def test_check_prints_a_summary(run: Command, recording: Path, tmp_path: Path) -> None:
    result = run("check", recording, "--out", tmp_path)
    assert result.code == 0, result.err
    for words in (
        "3 cameras, 12 frames at 30 per second",
        "320x240",
        "sylpose TOML",
        "boxes meet",
        "cam_2",
    ):
        assert words in result.out
    assert "Ready to track" in result.out
    assert "Target: the object in the boxes of cam_0" in result.out
    assert cv2.imread(str(tmp_path / "rig.png")) is not None
    assert cv2.imread(str(tmp_path / "target.png")) is not None


def test_check_names_exchanged_videos(run: Command, recording: Path, tmp_path: Path) -> None:
    options = "--video", "cam_0=cam_2.mp4", "--video", "cam_1=cam_1.mp4", "--video", "cam_2=cam_0.mp4"
    result = run("check", recording, *options, "--out", tmp_path)
    assert result.code == 0, result.err
    text = " ".join((result.out + result.err).split())
    assert "the videos of cam_0 and cam_2 are exchanged: --video cam_0=cam_0.mp4 --video cam_2=cam_2.mp4" in text
    assert "Not ready to track" in text


def without_boxes(recording: Path) -> Session:
    """Open a recording; `preview_moving_object` ignores its boxes."""
    return open_session(recording)


def test_check_describes_the_moving_object_without_boxes(recording: Path) -> None:
    found = preview_moving_object(without_boxes(recording))
    assert found.description.startswith("what moves from frame 0 to ")
    assert found.description.count("cam_") == 3
    assert found.warnings == ()
    (view,) = found.views
    assert view.label == ""
    assert all(outline is not None and len(outline) > 3 for outline in view.outlines)


def test_check_warns_if_nothing_moves(tmp_path: Path) -> None:
    """A recording without motion is drawn nevertheless."""
    resting = write_box_recording(tmp_path, lambda _frame: RigidTransform.identity(), 3)
    found = preview_moving_object(open_session(resting))
    assert len(found.warnings) == 1
    assert "no rigid body was found to move" in found.warnings[0]
    assert found.views[0].outlines == (None,) * 4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["temple", "board4"])
def test_check_of_real_recordings(run: Command, tmp_path: Path, name: str) -> None:
    if not (DATA / name).is_dir():
        pytest.skip(f"no recording {name} in {DATA}")
    result = run("check", DATA / name, "--out", tmp_path)
    assert result.code == 0, result.err
    assert {"temple": "Anipose TOML", "board4": "Caliscope TOML"}[name] in result.out
    assert "4 cameras" in result.out


def rig_warnings(cameras: list[Camera], unit: str = "") -> list[str]:
    """Return the warnings about a rig."""
    rig = Rig(cameras, unit)
    return checks.check_rig_geometry(rig, checks.ObjectLocation(find_axes_intersection(rig), None, "the optical axes"))


def camera(name: str, eye: tuple[float, float, float], target: tuple[float, float, float]) -> Camera:
    return make_look_at_camera(name, eye, target, focal=500.0, size=(640, 480))


def test_rig_without_faults_has_no_warnings() -> None:
    origin = (0.0, 0.0, 0.0)
    assert rig_warnings([camera("a", (0, 0, -1), origin), camera("b", (1, 0, 0), origin)], "m") == []
    # A stereo pair with parallel axes has no intersection, which is no error.
    assert rig_warnings([camera("a", (0, 0, 0), (0, 0, 1)), camera("b", (0.1, 0, 0), (0.1, 0, 1))]) == []


def test_diverging_cameras_are_reported() -> None:
    cameras = [
        camera("a", (0, 0, 1), (0, 0, 2)),
        camera("b", (1, 0, 0), (2, 0, 0)),
        camera("c", (0, 1, 0), (0, 2, 0.1)),
    ]
    (output,) = rig_warnings(cameras)
    assert "cameras diverge" in output
    inverted = [
        Camera(c.name, c.size, c.matrix, c.distortion, c.camera_from_world.inv())
        for c in (camera("a", (0.3, 0.2, -1), (0, 0, 0)), camera("b", (1, 0.1, 0.2), (0, 0, 0)))
    ]
    (output,) = rig_warnings(inverted)
    assert "probably contains world_from_camera" in output


def test_misdirected_camera_is_named() -> None:
    origin = (0.0, 0.0, 0.0)
    cameras = [
        camera(name, (np.sin(t), 0, -np.cos(t)), origin) for name, t in zip("abcd", (-1, -0.4, 0.3, 1), strict=True)
    ]
    cameras.append(camera("astray", (0, 0, -1.2), (4, 0, -1.0)))
    (output,) = rig_warnings(cameras)
    assert output.startswith("astray:")


def test_distance_of_optical_axes_is_described_without_a_warning(session: Path) -> None:
    origin = (0.0, 0.0, 0.0)
    met = [camera("a", (0, 0, -1), origin), camera("b", (1, 0, 0), origin)]
    assert checks.describe_axis_miss(Rig(met, "m")) == ""
    assert checks.describe_axis_miss(Rig(met[:1], "m")) == ""
    skewed = Rig([camera("a", (0, 0.036, -1), (0, 0.036, 0)), camera("b", (1, -0.036, 0), (0, -0.036, 0))], "m")
    assert "miss each other by 36.0 mm, 4 % of" in checks.describe_axis_miss(skewed)
    assert rig_warnings(list(skewed), "m") == []
    assert checks.describe_axis_miss(open_session(session).rig) == ""


def test_coincident_cameras_and_suspicious_unit() -> None:
    origin = (0.0, 0.0, 0.0)
    cameras = [
        camera("a", (0, 0, -1500), origin),
        camera("b", (0, 0.1, -1500), origin),
        camera("c", (900, 0, 0), origin),
    ]
    one_place, unit = rig_warnings(cameras)
    assert "b and a" in one_place
    assert "millimeters" in unit
    assert not any("millimeters" in output for output in rig_warnings(cameras, "mm"))
    (alone,) = rig_warnings(cameras[:1])
    assert "Only one camera" in alone


def test_camera_in_another_unit_is_named() -> None:
    """A translation in mm among those in m: named, and not taken for a rig in millimeters."""
    origin = (0.0, 0.0, 0.0)
    eyes = {"a": (0.0, 0.0, -2.0), "b": (2.0, 0.0, 0.0), "c": (0.0, 0.5, 2.0), "d": (-2000.0, 0.0, 10.0)}
    (output,) = rig_warnings([camera(name, eye, origin) for name, eye in eyes.items()], "m")
    assert output.startswith("d: its distance from the world's origin is about 1000 times")


def session_warnings(session: Session) -> str:
    """Return all warnings and errors of `check` about a session."""
    places = {name: checks.locate_object(session.select_object(name)) for name in session.objects}
    return " ".join([*checks.list_warnings(session, places), *checks.list_errors(places)])


def test_box_that_does_not_fit_the_others_is_named(session: Path) -> None:
    opened = open_session(session)
    assert session_warnings(opened) == ""
    x, y, width, height = (getattr(opened.boxes["cam_1"], key) for key in ("x", "y", "width", "height"))
    shifted = f"cam_1 = [{x}, {y + 0.8 * height}, {width}, {height / 4}]"
    lines = [line for line in (session / "boxes.toml").read_text().splitlines() if "cam_1" not in line]
    (session / "boxes.toml").write_text("\n".join([*lines, shifted]))
    assert "cam_1" in session_warnings(open_session(session))
    (session / "boxes.toml").write_text(shifted)
    assert "Only one camera" in session_warnings(open_session(session))


# --- demo and score --------------------------------------------------------------------------------------------------


def test_demo(run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    args = ("--frames", 3, "--turn", 6, "--cameras", 3)
    result = run("demo", *args)
    assert result.code == 0, result.err
    assert "Against ground truth, motion since the first of 3 frames" in result.out
    assert re.search(r"stated sd +noise alone\nrotation( +[\d.]+°){4}\nposition( +[\d.]+ [mµ]m){4}\n", result.out)
    page = Path("sylpose_demo", "sylpose", "report.html")
    assert result.out.splitlines()[-1] == f"Open {page} in a browser."
    assert {file.name for file in (tmp_path / "sylpose_demo" / "sylpose").iterdir()} >= OUTPUTS

    # Run again with fewer cameras into the same folder; an inaccurate result gives exit code 1.
    monkeypatch.setattr(demo, "MAX_ERROR_DEG", 0.0)
    result = run("demo", "--frames", 2, "--turn", 3, "--cameras", 2)
    assert result.code == 1
    assert "the demo failed" in result.err


def test_demo_never_replaces_a_recording(run: Command, session: Path) -> None:
    before = (session / "cam_0.mp4").read_bytes()
    assert "not empty" in error_message(run("demo", "--out", session))
    assert (session / "cam_0.mp4").read_bytes() == before
    assert "at least 2 frames" in error_message(run("demo", "--out", session / "new", "--frames", 1))


# --- the rest --------------------------------------------------------------------------------------------------------


def test_calibration_convert(run: Command, recording: Path, tmp_path: Path) -> None:
    source, target = recording / "calibration.toml", tmp_path / "calibration.yml"
    result = run("calibration", "convert", source, target)
    assert result.code == 0
    assert "3 cameras" in result.out
    assert f"read from {source}, sylpose TOML" in result.out
    for a, b in zip(calibration.load(source), calibration.load(target), strict=True):
        assert np.array_equal(a.matrix, b.matrix)
        assert np.array_equal(a.camera_from_world.as_matrix(), b.camera_from_world.as_matrix())
    assert run("calibration", "convert", source, tmp_path / "two.toml", "--only", "cam_2", "--only", "cam_0").code == 0
    two = calibration.load(tmp_path / "two.toml")
    assert two.names == ("cam_2", "cam_0")
    assert np.array_equal(two["cam_0"].matrix, calibration.load(source)["cam_0"].matrix)
    pair = ("calibration", "convert", source, tmp_path / "pair.yml", "--to", "opencv-stereo")
    assert "--only" in error_message(run(*pair))
    assert "which are cam_2 and cam_0" in run(*pair, "--only", "cam_2", "--only", "cam_0").out
    assert "--only: 'cam_9' is no camera" in error_message(run(*pair, "--only", "cam_9"))
    assert "--only: a camera is given twice" in error_message(run(*pair, "--only", "cam_0", "--only", "cam_0"))
    assert "rig.txt" in error_message(run("calibration", "convert", source, tmp_path / "rig.txt"))
    assert run("calibration", "convert", source, tmp_path / "new" / "deep" / "rig.toml").code == 0
    assert "none.toml" in error_message(run("calibration", "convert", tmp_path / "none.toml", target))


def test_help_and_version(run: Command) -> None:
    assert run("--version").out == f"sylpose {sylpose.__version__}\n"
    for command in ((), ("track",), ("check",), ("demo",), ("calibration", "convert")):
        result = run(*command, "-h")
        assert result.code == 0
        assert "Examples:" in result.out
        assert run(*command, "--help").out == result.out
    assert all(name in run("track", "-h").out for name in (*METHODS, *FEATURES))
    assert tuple(SOLVERS) == METHODS
    assert run("trakc").code == 2


def test_lengths_are_readable() -> None:
    assert format_length(0.0831, "m") == "83.1 mm"
    assert format_length(1.5, "m") == "1.50 m"
    assert format_length(1234.4, "mm") == "1234 mm"
    assert format_length(0.0023, "") == "0.00230 units"
    assert format_length(0.0, "m") == "0 mm"


def test_import_is_light() -> None:
    code = "import sys, sylpose; print(sorted({'numpy', 'cv2', 'av', 'matplotlib', 'scipy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
    for name in sylpose.__all__:
        assert getattr(sylpose, name) is not None
        assert name in dir(sylpose)
    with pytest.raises(AttributeError, match="nonsense"):
        _ = sylpose.nonsense  # type: ignore[attr-defined]


def test_calibrations_are_converted_to_another_unit(tmp_path: Path, run: Command) -> None:
    pose = RigidTransform.from_components([0.25, 0, 2.0], Rotation.identity())
    matrix = np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
    source, target = tmp_path / "rig.toml", tmp_path / "out.toml"
    calibration.save(Rig([Camera("a", (640, 480), matrix, np.zeros(5), pose)]), source)
    assert "unknown unit" in error_message(run("calibration", "convert", source, target, "--unit", "mm"))
    assert not target.exists()
    assert run("calibration", "convert", source, target, "--is-in", "m", "--unit", "mm").code == 0
    results = calibration.load(target)
    assert results.unit == "mm"
    np.testing.assert_allclose(results["a"].camera_from_world.translation, [250, 0, 2000])
    assert "states that its unit is mm" in error_message(run("calibration", "convert", target, source, "--is-in", "m"))
    assert "one of m, cm, mm" in error_message(run("calibration", "convert", target, source, "--unit", "league"))


def test_results_in_another_unit_and_euler_convention(session: Path, tmp_path: Path, run: Command) -> None:
    """The poses are the same except for a factor of 1000; one video is named by an option."""
    (session / "cam_0.mp4").rename(session / "left.mp4")
    options = ["--stop", "4", "--no-overlay", "--no-smooth", "--video", "cam_0=left.mp4"]
    assert run("track", session, "--out", tmp_path / "m", *options).code == 0
    assert run("track", session, "--out", tmp_path / "mm", *options, "--unit", "mm", "--euler", "ZXZ").code == 0
    metres, millimetres = (read_trajectory(tmp_path / unit / "trajectory.csv") for unit in ("m", "mm"))
    assert (metres.unit, millimetres.unit) == ("m", "mm")
    assert metres.measured_mask.sum() == 4
    for a, b in zip(metres, millimetres, strict=True):
        assert a.world_from_object is not None
        assert b.world_from_object is not None
        # Iterations stop at a fraction of the standard deviation: rounding may add or save one.
        apart = (a.world_from_object.rotation * b.world_from_object.rotation.inv()).as_rotvec()
        assert (np.abs(apart) <= 0.05 * a.sigma[:3] + 1e-9).all()
        assert (np.abs(b.position / 1000 - a.position) <= 0.05 * a.sigma[3:] + 1e-9).all()
        np.testing.assert_allclose(b.sigma, a.sigma * ([1] * 3 + [1000] * 3), rtol=0.2, atol=1e-9)
    assert "angle2_X_deg" in (tmp_path / "mm" / "trajectory.csv").read_text().splitlines()[0]
    assert calibration.load(tmp_path / "mm" / "calibration.used.toml").unit == "mm"
    assert run("view", tmp_path / "mm", "cam_1", "--euler", "xyz").code == 0
    assert "angle1_x_deg" in (tmp_path / "mm" / "view_cam_1.csv").read_text().splitlines()[0]
    for option, value, output in (
        ("--unit", "league", "one of m, cm"),
        ("--euler", "XXY", "perpendicular"),
        ("--video", "cam_0", "NAME=FILE"),
        ("--video", "cam_0=gone.mp4", "gone.mp4"),
        ("--rate", 5, "image folders"),
    ):
        others = options[:4] if option == "--video" else options
        refused = run("track", session, "--out", tmp_path / "m", *others, option, value)
        assert output in error_message(refused)


def test_results_do_not_depend_on_the_unit(session: Path, tmp_path: Path) -> None:
    """Scaling lengths by a power of two, which is exact, scales the smoothed poses and changes nothing else."""
    opened, results = open_session(session), []
    for factor in (1.0, 1024.0):
        poses = [(camera, camera.camera_from_world) for camera in opened.rig]
        moved = [
            replace(camera, camera_from_world=RigidTransform.from_components(factor * p.translation, p.rotation))
            for camera, p in poses
        ]
        run = track_session(opened.with_rig(Rig(moved)), tmp_path / str(factor), RunOptions(stop=3, overlay=False))
        results.append(run.trajectory)
    for a, b in zip(*results, strict=True):
        assert a.status is b.status
        assert a.world_from_object is not None
        assert b.world_from_object is not None
        turn = b.world_from_object.rotation * a.world_from_object.rotation.inv()
        # Solving for the effect of calibration errors magnifies rounding: their information is a small difference.
        assert turn.magnitude() < 1e-10
        np.testing.assert_allclose(b.position, 1024 * a.position, rtol=0, atol=1e-9 * np.abs(b.position).max())
        np.testing.assert_allclose(b.sigma[:3], a.sigma[:3], rtol=1e-7)
        np.testing.assert_array_equal(b.inliers, a.inliers)
