"""Runs interrupted at any moment, rejected, or out of disk space: nothing is lost, and `--resume` gives the same bytes.

benchmarks/kills.py does the same with signals in hundreds of processes.
"""

from __future__ import annotations

import errno
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sylpose.atomic_io import partial_path, replace_atomically
from sylpose.commands.main import main
from sylpose.io import calibration
from sylpose.io.capture import Session, open_session
from sylpose.runs.options import RunOptions
from sylpose.runs.results_folder import EARLIER, ResultsFolder
from sylpose.runs.run import has_finished, track_session
from sylpose.runs.run_metadata import SETTINGS, USED_CALIBRATION
from sylpose.sync.estimation import TimeOffsets, write_offsets
from sylpose.sync.speed_correlation import OffsetEstimate
from sylpose.tracking.context import TrackedFrame

pytestmark = pytest.mark.usefixtures("undrawn")

STOP = 3
RESULTS = ("trajectory.tum", "trajectory.csv")
CHANGES = ("open", "os.rename", "os.remove", "os.truncate", "os.mkdir", "os.rmdir")


class PowerCut(BaseException):
    """Simulated power failure: no file operation succeeds any more."""


class FileFailures:
    """Audit hook that counts file changes in a folder, and makes them fail from a given number on."""

    def __init__(self) -> None:
        self.folder, self.count, self.first_failure, self.is_disk_full = "", 0, -1, False

    def arm(self, folder: Path, first_failure: int = -1, is_disk_full: bool = False) -> None:
        self.folder, self.count, self.first_failure, self.is_disk_full = str(folder), 0, first_failure, is_disk_full

    def __call__(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.folder or event not in CHANGES or not isinstance(args[0], (str, os.PathLike)):
            return
        if event == "open" and not (isinstance(args[2], int) and args[2] & os.O_ACCMODE):
            return
        if not os.fspath(args[0]).startswith(self.folder):
            return
        self.count += 1
        if 0 <= self.first_failure < self.count:
            if self.is_disk_full and event in ("open", "os.mkdir"):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), args[0])
            if not self.is_disk_full:
                raise PowerCut


FILE_FAILURES = FileFailures()
sys.addaudithook(FILE_FAILURES)  # cannot be removed


@pytest.fixture(autouse=True)
def disarmed() -> Iterator[None]:
    yield
    FILE_FAILURES.arm(Path())
    FILE_FAILURES.folder = ""


@pytest.fixture(scope="module")
def opened(recording: Path) -> Session:
    return open_session(recording)


def run(session: Session, out: Path, smooth: bool, on_frame: Any = None, **options: Any) -> None:
    options |= {"stop": STOP, "smooth": smooth, "overlay": False, "checkpoint_seconds": 0, "workers": 1}
    track_session(session, out, RunOptions(**options), on_frame=on_frame)


@pytest.fixture(scope="module")
def whole(opened: Session, tmp_path_factory: pytest.TempPathFactory) -> dict[bool, dict[str, bytes]]:
    """Return the text files of uninterrupted runs, with and without smoothing."""
    found = {}
    for smooth in (True, False):
        out = tmp_path_factory.mktemp("whole")
        run(opened, out, smooth)
        found[smooth] = read_texts(out)
    return found


def read_texts(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.suffix in (".tum", ".csv")}


EARLIER_RESULT = {"trajectory.tum": b"# an earlier\n", "trajectory.csv": b"index\n" + b"0\n" * 99}


def prepare_earlier_result(out: Path) -> Path:
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    for name, content in EARLIER_RESULT.items():
        (out / name).write_bytes(content)
    return out


@pytest.mark.parametrize(
    ("smooth", "full", "shares"),
    [
        pytest.param(True, False, (0.5, 1.0), id="smooth-cut"),
        pytest.param(True, True, (0.0, 0.3, 0.7, 1.0), id="smooth-full", marks=pytest.mark.slow),
        pytest.param(False, False, (0.0, 0.3, 0.7, 1.0), id="plain-cut", marks=pytest.mark.slow),
        pytest.param(False, True, (0.7,), id="plain-full"),
    ],
)
def test_interruption_at_any_moment(
    opened: Session,
    whole: dict[bool, dict[str, bytes]],
    tmp_path: Path,
    smooth: bool,
    full: bool,
    shares: tuple[float, ...],
) -> None:
    """An earlier result stays until the new one is complete."""
    out = prepare_earlier_result(tmp_path / "out")
    FILE_FAILURES.arm(out)
    run(opened, out, smooth)
    first, last = 1 + full, FILE_FAILURES.count - 1 - smooth
    for at in (int(first + share * (last - first)) for share in shares):
        prepare_earlier_result(out)
        FILE_FAILURES.arm(out, at, full)
        output = run_until_failure(opened, out, smooth)
        FILE_FAILURES.arm(Path("/nowhere"))
        assert output == "" or (full and "cannot write " in output and "\n" not in output)
        kept = [{n: (folder / n).read_bytes() for n in RESULTS if (folder / n).exists()} for folder in folders(out)]
        new = {name: whole[smooth][name] for name in RESULTS}
        merged = {name: {its.get(name) for its in kept} for name in RESULTS}
        assert all(merged[name] & {EARLIER_RESULT[name], new[name]} for name in RESULTS), at
        if not (out / "checkpoint.bin").exists():  # the run had not begun or had ended
            if has_finished(opened, out):
                assert read_texts(out) in (EARLIER_RESULT, whole[smooth])
            run(opened, out, smooth)
        else:
            assert not has_finished(opened, out)
            run(opened, out, smooth, resume=True)
        assert read_texts(out) == whole[smooth], at
        left = {file.name for file in out.iterdir()}
        assert left == {*whole[smooth], "report.png", "report.html", SETTINGS, USED_CALIBRATION}, at


def run_until_failure(session: Session, out: Path, smooth: bool) -> str:
    """Return the error message of an interrupted run."""
    try:
        run(session, out, smooth)
    except PowerCut:
        return ""
    except OSError as error:
        return str(error)
    return ""


def folders(out: Path) -> list[Path]:
    return [out, *(entry for entry in out.iterdir() if entry.is_dir())]


def test_failing_run_keeps_the_earlier_result(opened: Session, tmp_path: Path) -> None:
    out = prepare_earlier_result(tmp_path / "out")

    def breaks(_: str, tracked: TrackedFrame) -> None:
        if tracked.pose.index == 1:
            raise RuntimeError("a bug")

    for _ in range(2):  # the second failure must not lose it either
        with pytest.raises(RuntimeError):
            run(opened, out, False, on_frame=breaks)
        assert read_texts(out / EARLIER) == EARLIER_RESULT
        assert read_texts(out)["trajectory.csv"].count(b"\n") == 3  # partial results
    run(opened, out, False)
    assert not (out / EARLIER).exists()


def test_failing_resumed_run_keeps_the_files(
    opened: Session, whole: dict[bool, dict[str, bytes]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def breaks(*_: object, **__: object) -> None:
        raise RuntimeError("a bug")

    with monkeypatch.context() as patch:
        patch.setattr("sylpose.runs.results_folder.ResultsFolder.end", breaks)  # fail just before the end
        with pytest.raises(RuntimeError):
            run(opened, tmp_path, True)
    assert not has_finished(opened, tmp_path)
    before = read_texts(tmp_path)
    assert before == whole[True]
    with monkeypatch.context() as patch:
        patch.setattr("sylpose.runs.outputs.smooth_tracks", breaks)
        with pytest.raises(RuntimeError):
            run(opened, tmp_path, True, resume=True)
    assert read_texts(tmp_path) == before
    run(opened, tmp_path, True, resume=True)
    assert read_texts(tmp_path) == before
    assert has_finished(opened, tmp_path)


def test_files_of_the_user_stay(tmp_path: Path) -> None:
    """The surface of an earlier scan moves with its run; a model that somebody keeps there does not."""
    for name in ("trajectory.csv", "shape.glb", "shape.png", "object.glb", "object.png"):
        (tmp_path / name).write_text("earlier")
    ResultsFolder(tmp_path).move_earlier_results()
    assert {path.name for path in tmp_path.iterdir()} == {EARLIER, "object.glb", "object.png"}
    assert {path.name for path in (tmp_path / EARLIER).iterdir()} == {"trajectory.csv", "shape.glb", "shape.png"}


def test_two_runs_in_one_folder(opened: Session, tmp_path: Path) -> None:
    output = list[str]()

    def another(*_: object) -> None:
        with pytest.raises(ValueError, match="another run is writing its results there") as refused:
            run(opened, tmp_path, False, resume=bool(output))
        output.append(str(refused.value))

    run(opened, tmp_path, False, on_frame=another)
    assert len(output) == STOP
    assert str(tmp_path) in output[0]
    run(opened, tmp_path, False)  # the folder is no longer locked


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--seed", "-1"], "seed: -1 is not a whole number"),
        (["--every", "0"], "every must be at least 1"),
        (["--start", "-1"], "start must be in 0 ... 11"),
        (["--stop", "0"], "stop must be greater than start"),
        (["--boxes", "nowhere.toml"], "nowhere.toml"),
        (["--offsets", "nowhere.toml"], "nowhere.toml"),
        (["--frame-offset", "cam_9=1"], "cam_9"),
        (["--resume", "--every", "0"], "every must be at least 1"),
    ],
)
def test_arguments_are_validated_before_files_change(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], words: str
) -> None:
    out = prepare_earlier_result(tmp_path / "out")
    (out / "checkpoint.bin").write_bytes(b"of a run that was interrupted")
    before = {file: file.read_bytes() for file in out.iterdir()}
    assert main(["track", str(recording), "--out", str(out), "--no-overlay", *options]) == 2
    (output,) = capsys.readouterr().err.splitlines()
    assert words in output
    assert {file: file.read_bytes() for file in out.iterdir()} == before


def test_results_are_not_written_into_the_recording(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (session / "link").symlink_to(session)
    before = sorted(session.rglob("*"))
    for out in (session, session / "link", session / "cam_0.mp4", session / "cam_0.mp4" / "results"):
        for command in ("track", "check"):
            assert main([command, str(session), "--out", str(out)]) == 2
            output = capsys.readouterr().err.splitlines()
            assert len(output) == 1
            assert f"--out {out}: " in output[0]
    assert sorted(session.rglob("*")) == before
    with pytest.raises(ValueError, match="checkpoint_seconds must be a number of seconds"):
        track_session(open_session(session), options=RunOptions(checkpoint_seconds=float("nan")))
    assert sorted(session.rglob("*")) == before
    assert main(["sync", str(session), "--out", str(session / "cam_0.mp4")]) == 2
    assert "exists and is not a file of offsets" in capsys.readouterr().err


def test_failed_write_keeps_the_file(session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = session / "calibration.toml"
    rig, before = calibration.load(path), path.read_bytes()

    def half(part: Path, text: str, **_: Any) -> None:
        part.write_bytes(text.encode()[: len(text) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", half)
    with pytest.raises(OSError, match=r"cannot write .*calibration\.toml: no space left"):
        calibration.save(rig, path)
    assert path.read_bytes() == before
    assert not partial_path(path).exists()
    offsets = tmp_path / "offsets.toml"
    offsets.write_bytes(b"cam_0 = 0.1\n")
    none = np.empty(0)
    nothing = TimeOffsets((), 30.0, none, none, (), OffsetEstimate(none, none, none > 0), none, none, 0, none, ())
    with pytest.raises(OSError, match=r"cannot write .*offsets\.toml: no space left"):
        write_offsets(nothing, offsets)
    assert offsets.read_bytes() == b"cam_0 = 0.1\n"


def test_replacing(tmp_path: Path) -> None:
    """Links are followed, permissions kept, and devices written directly."""
    target, link = tmp_path / "a.txt", tmp_path / "b.txt"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    with replace_atomically(link) as part:
        assert part != target
        part.write_text("new")
        assert target.read_text() == "old"
    assert link.is_symlink()
    assert target.read_text() == "new"
    assert target.stat().st_mode & 0o777 == 0o640
    with replace_atomically(tmp_path / "secret", mode=0o600) as part:
        part.write_text("x")
    assert (tmp_path / "secret").stat().st_mode & 0o777 == 0o600
    with replace_atomically("/dev/null") as part:
        part.write_text("x")
    with replace_atomically(tmp_path / "new" / "deep" / "a.txt") as part:
        part.write_text("x")
    assert (tmp_path / "new" / "deep" / "a.txt").read_text() == "x"
    with (
        pytest.raises(OSError, match=r"cannot write into .*secret: it is a file"),
        replace_atomically(tmp_path / "secret" / "a.txt") as part,
    ):
        part.write_text("x")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.txt", "b.txt", "new", "secret"]
