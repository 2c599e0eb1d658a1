"""Interrupted runs resume from their checkpoint and yield the same files, byte for byte."""

from __future__ import annotations

import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sylpose.atomic_io import partial_path
from sylpose.commands.main import main
from sylpose.io import calibration
from sylpose.io.capture import open_session
from sylpose.report.files import TrajectoryWriter, read_trajectory
from sylpose.results import FramePose
from sylpose.rig import Rig
from sylpose.runs import checkpoint as checkpoints
from sylpose.runs.checkpoint import CHECKPOINT
from sylpose.runs.checkpoint_schema import SERIALIZER, RunState
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.joint_side.joint_state import JointState

pytestmark = pytest.mark.usefixtures("undrawn")

# Number of frames tracked; fewer are faster.
FRAMES = 5
STOP = ("--stop", str(FRAMES))
TRAJECTORIES = ("trajectory.tum", "trajectory.csv")
# Program that runs `sylpose` and is killed after writing a frame's line: `-c KILLED LINE arguments`.
KILLED = """
import os, signal, sys
from sylpose.commands.main import main
from sylpose.report.files import TrajectoryWriter
line = int(sys.argv[1])
write, written = TrajectoryWriter.write, []
def wrapped(self, pose):
    write(self, pose)
    written.append(pose)
    if len(written) == line:
        os.kill(os.getpid(), signal.SIGKILL)
TrajectoryWriter.write = wrapped
sys.exit(main(sys.argv[2:]))
"""


def killed(line: int, *args: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", KILLED, str(line), *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def whole(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results of an uninterrupted run."""
    out = tmp_path_factory.mktemp("whole")
    assert main(["track", str(recording), *STOP, "--no-overlay", "--out", str(out)]) == 0
    return out


def same(a: Path, b: Path) -> bool:
    return all((a / name).read_bytes() == (b / name).read_bytes() for name in TRAJECTORIES)


# --- real interrupts --------------------------------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform == "win32", reason="sends a POSIX signal")
def test_resume_killed_run(recording: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ("track", recording, *STOP, "--out", tmp_path, "--checkpoint", 0)
    assert killed(4, *args).returncode == -signal.SIGKILL
    assert len(read_trajectory(tmp_path / "tracked.csv")) == 4
    assert (tmp_path / CHECKPOINT).exists()
    assert main([*map(str, args), "--resume"]) == 0
    message = capsys.readouterr().out
    assert f"Resuming after 3 of {FRAMES} frames." in message  # the fourth frame was only partly written
    assert re.search(rf"Tracked +\d+ of {FRAMES} frames", message)
    assert same(tmp_path, whole)
    assert (tmp_path / "report.png").exists()
    assert (tmp_path / "overlay.mp4").exists()
    assert (tmp_path / "overlay_3.mp4").exists()
    assert "overlay_3.mp4" in message
    assert not (tmp_path / CHECKPOINT).exists()
    # A new run removes the old run's second video.
    assert main([*map(str, args), "--stop", "1"]) == 1  # a single frame has no motion
    assert [file.name for file in tmp_path.glob("overlay*")] == ["overlay.mp4"]


@pytest.mark.skipif(sys.platform == "win32", reason="sends a POSIX signal")
def test_ctrl_c_saves_checkpoint(
    recording: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    args = ["track", str(recording), *STOP, "--out", str(tmp_path), "--no-overlay"]
    write, written = TrajectoryWriter.write, list[FramePose]()

    def interrupted_there(self: TrajectoryWriter, pose: FramePose) -> None:
        write(self, pose)
        written.append(pose)
        if len(written) == 3:
            os.kill(os.getpid(), signal.SIGINT)

    # Tests started in the background may ignore SIGINT.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(TrajectoryWriter, "write", interrupted_there)
            assert main(args) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    message = capsys.readouterr().err
    assert message == f"sylpose: interrupted after 3 of {FRAMES} frames; the results so far are in {tmp_path}\n"
    assert main([*args, "--resume"]) == 0
    assert same(tmp_path, whole)


# --- exactness --------------------------------------------------------------------------------------------------------


class PowerCutError(Exception):
    pass


def interrupted(session: Path, out: Path, after: int, **options: Any) -> None:
    """Start a run that fails after a number of frames."""
    seen: list[TrackedFrame] = []

    def breaks(_: str, tracked: TrackedFrame) -> None:
        seen.append(tracked)
        if len(seen) == after:
            raise PowerCutError

    with pytest.raises(PowerCutError):
        track_session(open_session(session), out, RunOptions(overlay=False, **options), on_frame=breaks)


@pytest.mark.parametrize(
    ("options", "after"),
    [
        pytest.param({"method": "epipolar", "stop": 5}, 3, marks=pytest.mark.slow),
        pytest.param({"method": "sylvester", "start": 1, "every": 2, "stop": 8}, 3, marks=pytest.mark.slow),
        ({"features": "klt", "offsets": {"cam_1": 0.002}, "smooth": False, "stop": 5}, 3),
        pytest.param({"smooth": True, "stop": 4}, 3, marks=pytest.mark.slow),  # as `test_resume_killed_run`
        pytest.param({"smooth": False, "stop": 6}, 4, marks=pytest.mark.slow),
        pytest.param({"stop": 4}, 4, marks=pytest.mark.slow),
        ({"smooth": False, "stop": 3, "checkpoint_seconds": 20}, 2),
    ],
    ids=["epipolar", "every other frame", "klt", "smooth", "not smooth", "after the last frame", "from the start"],
)
def test_resumed_run_is_exact(session: Path, tmp_path: Path, options: dict[str, Any], after: int) -> None:
    if "every" in options:
        (session / "boxes.toml").unlink()  # without boxes, the first frames are buffered with their images
    track_session(open_session(session), tmp_path / "whole", RunOptions(overlay=False, **options))
    interrupted(session, tmp_path / "part", after, **{"checkpoint_seconds": 0, **options})
    run = track_session(open_session(session), tmp_path / "part", RunOptions(overlay=False, resume=True, **options))
    assert same(tmp_path / "part", tmp_path / "whole")
    assert {f.name for f in (tmp_path / "part").iterdir()} == {f.name for f in run.files}
    assert np.array_equal(
        run.trajectory.measured_mask, read_trajectory(tmp_path / "whole" / "trajectory.csv").measured_mask
    )


@pytest.mark.parametrize("where", [pytest.param("smooth", marks=pytest.mark.slow), "write_trajectory"])
def test_resume_after_failure_while_finishing(
    recording: Path, whole: Path, tmp_path: Path, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = open_session(recording)
    options: dict[str, Any] = {"stop": FRAMES, "overlay": False, "checkpoint_seconds": 0}

    def breaks(*_: object, **__: object) -> None:
        raise PowerCutError

    shutil.copytree(whole, tmp_path / "part")  # results of an earlier run are not used
    with monkeypatch.context() as patch:
        patch.setattr(f"sylpose.runs.outputs.{where}", breaks)
        with pytest.raises(PowerCutError):
            track_session(session, tmp_path / "part", RunOptions(**options))
    assert (tmp_path / "part" / CHECKPOINT).exists()
    assert len(read_trajectory(tmp_path / "part" / "tracked.csv")) == FRAMES
    run = track_session(session, tmp_path / "part", RunOptions(resume=True, **options))
    assert same(tmp_path / "part", whole)
    assert {f.name for f in (tmp_path / "part").iterdir()} == {f.name for f in run.files}


# --- what cannot be resumed -------------------------------------------------------------------------------------------


def refused(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    """Run a command that fails and return its one-line message."""
    capsys.readouterr()
    assert main(["track", *map(str, args), "--no-overlay", "--resume"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_nothing_to_resume(recording: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {file: file.read_bytes() for file in whole.iterdir()}
    assert main(["track", str(recording), *STOP, "--out", str(whole), "--resume"]) == 0
    assert "has ended; there is nothing to resume" in capsys.readouterr().out
    assert {file: file.read_bytes() for file in whole.iterdir()} == before
    message = refused(capsys, recording, "--out", tmp_path / "new")
    assert "no interrupted run to resume" in message
    assert not (tmp_path / "new").exists()


def test_other_options_or_another_session(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = session / "sylpose"
    interrupted(session, out, 2)
    before = {file: file.read_bytes() for file in out.iterdir()}
    for option, value, words in (
        ("--method", "epipolar", "method landmarks, not epipolar"),
        ("--seed", 1, "seed 0, not 1"),
        ("--stop", 9, "stop none, not 9"),
        ("--features", "klt", "features auto, not klt"),
        ("--set", "max_keyframes=50", "tracking none, not "),
    ):
        message = refused(capsys, session, option, value)
        assert words in message
        assert "checkpoint.bin" in message
    assert "timestamps or offsets" in refused(capsys, session, "--frame-offset", "cam_0=1")
    # Each change is detected before the earlier ones.
    (session / "cam_1.mp4").write_bytes((session / "cam_2.mp4").read_bytes())
    assert "images changed since" in refused(capsys, session)
    rig = calibration.load(session / "calibration.toml")
    calibration.save(Rig(rig.cameras, "mm"), session / "calibration.toml")
    assert "calibration changed since" in refused(capsys, session)
    (session / "boxes.toml").unlink()
    assert "boxes changed since" in refused(capsys, session)
    assert {file: file.read_bytes() for file in out.iterdir()} == before


@pytest.fixture(scope="module")
def stopped(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results of a run that failed after its first frame of two; read only."""
    out = tmp_path_factory.mktemp("stopped")
    interrupted(recording, out, 1, stop=2)
    return out


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:-200], "damaged"),
        (lambda data: data[: len(data) // 2] + b"x" + data[len(data) // 2 + 1 :], "damaged"),
        (lambda _: b"", "damaged"),
        (lambda _: pickle.dumps("something else"), "not a sylpose checkpoint"),
        (lambda data: data.replace(b"checkpoint 3", b"checkpoint 2", 1), "written by another version of sylpose"),
    ],
    ids=["cut", "changed", "empty", "foreign", "of another version"],
)
def test_damaged_checkpoint(
    recording: Path,
    stopped: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[bytes], bytes],
    words: str,
) -> None:
    path = tmp_path / CHECKPOINT
    shutil.copytree(stopped, tmp_path, dirs_exist_ok=True)
    path.write_bytes(change(path.read_bytes()))
    message = refused(capsys, recording, "--out", tmp_path, "--stop", 2)
    assert words in message
    assert str(path) in message


def test_checkpoint_of_another_version_or_code(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    args = (recording, "--out", tmp_path, "--stop", 2)
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "__version__", "0.0.9")
        interrupted(recording, tmp_path, 1, stop=2)
    assert "written by sylpose 0.0.9, this is" in refused(capsys, *args)
    interrupted(recording, tmp_path, 1, stop=2)
    with monkeypatch.context() as patch:
        patch.delitem(SERIALIZER.records, JointState)
        with pytest.raises(ValueError, match="a modified sylpose"):
            checkpoints.load_checkpoint(tmp_path / CHECKPOINT, *header(tmp_path / CHECKPOINT))


def header(path: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Return the options and session of a checkpoint."""
    data = json.loads(path.read_bytes().splitlines()[1])
    return data["options"], data["session"]


def test_changed_files_are_rejected(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    interrupted(recording, tmp_path, 2, stop=3, checkpoint_seconds=0)
    (tmp_path / "tracked.csv").write_text("")
    assert "tracked.csv" in refused(capsys, recording, "--out", tmp_path, "--stop", 3)
    (tmp_path / "tracked.tum").unlink()
    assert "tracked.tum" in refused(capsys, recording, "--out", tmp_path, "--stop", 3)


def test_unwritable_checkpoint_is_reported(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save, saved = checkpoints.save_checkpoint, list[Path]()

    def full(path: Path, *state: Any) -> None:
        saved.append(path)
        if len(saved) > 1:
            raise OSError(f"cannot write {path}: no space left on device")
        save(path, *state)

    monkeypatch.setattr("sylpose.runs.checkpoint.save_checkpoint", full)
    run = track_session(
        open_session(recording), tmp_path, RunOptions(stop=2, overlay=False, smooth=False, checkpoint_seconds=0)
    )
    assert len(run.trajectory) == 2
    (message,) = run.problems
    assert "checkpoint.bin: no space left" in message


def test_failed_checkpoint_keeps_previous_one(tmp_path: Path) -> None:
    path = tmp_path / CHECKPOINT
    checkpoints.save_checkpoint(path, {}, {}, RunState(1, {}, {}))
    partial_path(path).mkdir()  # it cannot be written there
    with pytest.raises(OSError, match=r"cannot write .*checkpoint\.bin: "):
        checkpoints.save_checkpoint(path, {}, {}, RunState(2, {}, {}))
    assert checkpoints.load_checkpoint(path, {}, {}).position == 1
