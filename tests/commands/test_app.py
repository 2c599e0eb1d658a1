"""Command line: live cameras, growing folders, time offsets and lost objects."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.commands.main import main
from sylpose.geometry.arrays import Image
from sylpose.io.capture import live, open_session
from sylpose.io.capture.frame_assembly import Grab
from sylpose.report.files import read_trajectory
from sylpose.results import FramePose, Trajectory
from sylpose.runs import console_output
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.runs.run_result import Run
from sylpose.status import FrameStatus, Observability
from sylpose.sync.offsets import load_offsets
from sylpose.tracking.context import Candidate
from tests.saved import TURN_RESULT

pytestmark = pytest.mark.usefixtures("undrawn")

CAMERAS = ("cam_0", "cam_1", "cam_2")


def images(path: Path) -> list[Image]:
    with av.open(str(path)) as video:
        return [np.asarray(frame.to_ndarray(format="bgr24"), np.uint8) for frame in video.decode(video=0)]


def error_message(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    """Return the one-line error message of a command that fails with exit code 2."""
    capsys.readouterr()
    assert main([str(arg) for arg in args]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


# --- statuses ---------------------------------------------------------------------------------------------------------


def test_summary_counts_measured_frames(capsys: pytest.CaptureFixture[str]) -> None:
    saved = read_trajectory(TURN_RESULT / "trajectory.csv")
    frames = [*saved][:6]
    frames[3] = replace(frames[3], status=FrameStatus.COASTING)
    frames[4] = replace(frames[4], status=FrameStatus.LOST, world_from_object=None)
    frames[5] = replace(frames[5], status=FrameStatus.RELOCALIZED)
    changed = Run({"object": Trajectory(frames, saved.camera_names)}, (), (), {"tracking": 1.0})
    console_output.print_summary(console_output.make_console(), changed, 6)
    assert "4 of 6 frames (1 relocalized), coasting 1, lost 1" in capsys.readouterr().out


@pytest.mark.parametrize("straight", [0, 3])
def test_summary_reports_frames_with_uncertain_distance(capsys: pytest.CaptureFixture[str], straight: int) -> None:
    frames = [
        FramePose(
            k,
            k / 30,
            FrameStatus.TRACKED,
            RigidTransform.from_translation([0.1 * k, 0, 0]),
            np.eye(6),
            np.full(3, 50),
            np.full(3, 0.4),
            Observability.NO_TRANSLATION_SCALE if k < straight else Observability.ALL,
        )
        for k in range(5)
    ]
    console_output.print_summary(
        console_output.make_console(), Run({"object": Trajectory(frames, CAMERAS)}, (), (), {"tracking": 1.0}), 5
    )
    output = capsys.readouterr().out
    assert ("uncertain in 3 frames: without rotation" in output) == bool(straight)
    assert ("Distance" in output) == bool(straight)


def test_images_without_times_are_tracked(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in CAMERAS:
        (session / name).mkdir()
        for k, image in enumerate(images(session / f"{name}.mp4")[:3]):
            cv2.imwrite(str(session / name / f"{k}.bmp"), image)
        (session / f"{name}.mp4").unlink()
    assert main(["track", str(session), "--no-overlay", "--no-smooth"]) == 0
    assert len(read_trajectory(session / "sylpose" / "trajectory.csv")) == 3
    assert "3 of 3 frames" in capsys.readouterr().out
    assert not (session / "sylpose" / "tracked.csv").exists()


def test_result_is_smoothed_by_default(session: Path, tmp_path: Path) -> None:
    rounds: list[int] = []
    for name, options in (("as tracked", ["--no-smooth"]), ("smoothed", []), ("paper", ["--method", "sylvester"])):
        assert (
            main(["track", str(session), "--no-overlay", "--stop", "3", "--out", str(tmp_path / name), *options]) == 0
        )
    run = track_session(
        open_session(session), tmp_path / "run", RunOptions(stop=3, overlay=False), on_smoothing=rounds.append
    )
    assert rounds[:2] == [1, 2]
    files = {name: (tmp_path / name).iterdir() for name in ("as tracked", "smoothed", "paper", "run")}
    names = {name: {file.name for file in found} for name, found in files.items()}
    assert names["smoothed"] == names["run"] == names["as tracked"] | {"tracked.csv", "tracked.tum"}
    assert names["paper"] == names["as tracked"]
    contents = {name: (tmp_path / name / "trajectory.csv").read_bytes() for name in names}
    assert (tmp_path / "smoothed" / "tracked.csv").read_bytes() == contents["as tracked"]
    assert contents["run"] == contents["smoothed"] != contents["as tracked"]
    assert len(run.trajectory) == 3


def test_notes_of_frames_become_problems_of_the_run(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Candidate, "is_ambiguous", lambda *_: True)
    run = track_session(
        replace(open_session(recording), _boxes={}), tmp_path, RunOptions(stop=3, overlay=False, smooth=False)
    )
    assert any("another one moves as well" in problem for problem in run.problems)


# --- offsets ----------------------------------------------------------------------------------------------------------


def test_camera_offsets_are_read(tmp_path: Path) -> None:
    path = tmp_path / "offsets.toml"
    path.write_text("cam_0 = 0.0042\n2 = -1\n")
    assert load_offsets(path, CAMERAS) == {"cam_0": 0.0042, "cam_2": -1.0}
    for content, words in (
        ("cam_9 = 1", "cam_9 is not a camera"),
        ("cam_0 = true", "cam_0 must be a number of seconds \\(at most a day\\), got True"),
        ('cam_0 = "1"', "cam_0 must be a number of seconds \\(at most a day\\), got '1'"),
        ("cam_0 = nan", "number of seconds"),
        ("[cam_0]\nx = 1", "number of seconds"),
        ("cam_0", "cam_0 = 0.0042 are expected"),
    ):
        path.write_text(content)
        with pytest.raises(ValueError, match=f"offsets.toml: .*{words}"):
            load_offsets(path, CAMERAS)


def test_offsets_change_the_result(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    track = ("track", str(session), "--no-overlay", "--no-smooth", "--stop", "3")
    assert main([*track, "--out", str(tmp_path / "none")]) == 0
    (tmp_path / "given.toml").write_text("cam_1 = 0.01\n")
    assert main([*track, "--offsets", str(tmp_path / "given.toml"), "--out", str(tmp_path / "given")]) == 0
    (session / "offsets.toml").write_text("cam_1 = 0.01\n")
    assert main([*track, "--out", str(tmp_path / "found")]) == 0
    none, given, found = ((tmp_path / name / "trajectory.csv").read_bytes() for name in ("none", "given", "found"))
    assert found == given != none
    (session / "offsets.toml").write_text("cam_7 = 0.01\n")
    assert "cam_7 is not a camera" in error_message(capsys, *track)
    assert "nowhere.toml: no such file" in error_message(capsys, *track, "--offsets", tmp_path / "nowhere.toml")


def test_offsets_need_times(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in CAMERAS:
        (session / name).mkdir()
        cv2.imwrite(str(session / name / "0.png"), images(session / f"{name}.mp4")[0])
        (session / f"{name}.mp4").unlink()
    (session / "offsets.toml").write_text("cam_1 = 0.01\n")
    assert "neither timestamps nor a frame rate" in error_message(capsys, "track", session)


# --- live -------------------------------------------------------------------------------------------------------------


# Frames per second, low enough for a busy machine; longest wait for the tracker, which may be slow; the frame that one
# camera lacks.
RATE, DELAY, MISSING = 2, 60, 4
# Number of frames.
LIVE_FRAMES = 8


class Player:
    """Simulated camera that plays a video in real time, optionally in a loop."""

    def __init__(self, frames: list[Image], forever: bool = False, missing: int = -1) -> None:
        self._frames, self._forever, self._missing, self._next = frames, forever, missing, 0
        self._start = time.monotonic()

    def read(self) -> Grab | None:
        while self._next == self._missing:
            self._next += 1
        if self._next >= len(self._frames) and not self._forever:
            return None
        time.sleep(max(0.0, self._start + self._next / RATE - time.monotonic()))
        k = self._next % (2 * len(self._frames) - 2)
        image = self._frames[min(k, 2 * len(self._frames) - 2 - k)]
        self._next += 1
        return Grab((image.shape[1], image.shape[0]), lambda: image)

    def close(self) -> None:
        pass


@pytest.fixture
def cameras(session: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, bool]:
    """Replace the session's videos by live cameras that play them; returns the playback options."""
    sources = "".join(f"{name} = {c}\n" for c, name in enumerate(CAMERAS))
    (session / "live.toml").write_text(f"max_delay = {DELAY}\nrate = {RATE}\n[sources]\n{sources}")
    played = {c: images(session / f"{name}.mp4")[:LIVE_FRAMES] for c, name in enumerate(CAMERAS)}
    how = {"forever": False}

    def opener(source: int | str, *_: object) -> Player:
        return Player(played[int(source)], how["forever"], missing=MISSING if source == 1 else -1)

    monkeypatch.setattr(live, "open_live", partial(live.open_live, opener=opener))
    monkeypatch.setattr("sylpose.io.capture.streams.RETRY_DELAYS", ())
    return how


@pytest.mark.usefixtures("cameras")
def test_live_cameras_are_tracked_to_their_end(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["track", str(session)]) == 0
    output = capsys.readouterr()
    assert f"session: 3 cameras, live at {RATE} per second" in output.out
    assert "Left out in total: frame" in output.out
    out = session / "sylpose"
    # Whether there are enough landmarks for an object.npz depends on how many frames are processed in time.
    assert {file.name for file in out.iterdir()} - {"object.npz", "object.ply"} == {
        *("trajectory.tum", "trajectory.csv", "report.png", "report.html", "overlay.mp4"),
        *("settings.toml", "calibration.used.toml"),
    }
    trajectory = read_trajectory(out / "trajectory.csv")
    assert len(trajectory) >= LIVE_FRAMES - 2
    assert trajectory.measured_mask.mean() > 0.8
    assert "without cam_1" in output.out


def test_ctrl_c_ends_live_cameras_with_all_files(
    session: Path, cameras: dict[str, bool], capsys: pytest.CaptureFixture[str]
) -> None:
    cameras["forever"] = True
    csv = session / "sylpose" / "trajectory.csv"

    def interrupt() -> None:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and not (csv.exists() and csv.read_text().count("\n") > 3):
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        assert main(["track", str(session), "--no-overlay", "--features", "sift"]) == 0
    finally:
        thread.join()
        signal.signal(signal.SIGINT, before)
    assert "Tracked" in capsys.readouterr().out
    assert len(read_trajectory(csv)) >= 3
    assert (session / "sylpose" / "report.png").exists()


@pytest.mark.usefixtures("cameras")
def test_options_not_supported_by_live_cameras(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--resume: a live session" in error_message(capsys, "track", session, "--resume")
    assert "--frame-offset" in error_message(capsys, "track", session, "--frame-offset", "cam_0=1")
    assert "lossless" in error_message(capsys, "track", session, "--no-drop")
    (session / "live.toml").write_text("[sources]\ncam_0 = 0\n")
    assert "live.toml" in error_message(capsys, "track", session)
    (session / "live.toml").unlink()
    assert "rate: only for image folders" in error_message(capsys, "track", session, "--rate", 5)
    (session / "live.toml").write_text("[sources]\n" + "".join(f"{n} = {c}\n" for c, n in enumerate(CAMERAS)))
    opened = live.open_live(session)
    with pytest.raises(ValueError, match="live session cannot be resumed"):
        track_session(opened, options=RunOptions(resume=True))


def test_growing_folder_is_tracked_as_it_grows(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    played = {name: images(session / f"{name}.mp4") for name in CAMERAS}
    for name in CAMERAS:
        (session / f"{name}.mp4").unlink()
        (session / name).mkdir()

    def record() -> None:
        for k in range(LIVE_FRAMES):
            for name in CAMERAS:
                cv2.imwrite(str(session / name / "writing.bmp"), played[name][k])
                (session / name / "writing.bmp").rename(session / name / f"{k:03d}.png")
            time.sleep(0.05)
        (session / "DONE").touch()

    recorder = threading.Thread(target=record)
    recorder.start()
    command = ["track", str(session), "--follow", "--no-drop", "--rate", "30", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    recorder.join()
    assert f"of {LIVE_FRAMES} frames" in capsys.readouterr().out
    trajectory = read_trajectory(tmp_path / "out" / "trajectory.csv")
    assert [frame.index for frame in trajectory] == list(range(LIVE_FRAMES))
    assert trajectory.times[-1] == pytest.approx((LIVE_FRAMES - 1) / 30)


# --- start-up ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "apart"), [pytest.param("exact", 1e-8, marks=pytest.mark.slow), ("compact", 1e-3)])
def test_nodes_match_one_process(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], mode: str, apart: float
) -> None:
    options = ["track", str(session), "--stop", "3", "--no-overlay", "--no-smooth", "--out"]
    assert main([*options, str(tmp_path / "one")]) == 0
    expected = read_trajectory(tmp_path / "one" / "trajectory.csv")
    capsys.readouterr()
    # With the overlay, for which each node gives its camera's part.
    assert main([*(o for o in options if o != "--no-overlay"), str(tmp_path / mode), "--simulate-nodes", mode]) == 0
    assert "3 nodes exchanged" in " ".join(capsys.readouterr().out.split())
    found = read_trajectory(tmp_path / mode / "trajectory.csv")
    assert [f.status for f in found] == [f.status for f in expected]
    for a, b in zip(found, expected, strict=True):
        assert a.world_from_object is not None
        assert b.world_from_object is not None
        np.testing.assert_allclose(a.world_from_object.as_matrix(), b.world_from_object.as_matrix(), atol=apart)
    files = {f.name for f in (tmp_path / "one").iterdir()}
    assert {f.name for f in (tmp_path / mode).iterdir()} == files | {"overlay.mp4"}


def test_options_not_supported_by_nodes(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = error_message(capsys, "track", session, "--simulate-nodes", "exact", "--resume")
    assert "nodes write no checkpoints, so there is nothing to resume" in output
    assert "'quick' is neither of exact, compact" in error_message(
        capsys, "track", session, "--simulate-nodes", "quick"
    )


def test_help_does_not_import_heavy_modules() -> None:
    code = (
        "import sys\nfrom sylpose.commands.main import main\nmain(['track', '-h'])\n"
        "print(sorted({'numpy', 'cv2', 'av', 'matplotlib', 'scipy', 'numba', 'rich.console'} & set(sys.modules)))"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines()[-1] == "[]"
