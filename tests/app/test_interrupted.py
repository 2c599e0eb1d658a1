"""Runs that are broken off at any moment, refused, or out of room: nothing is lost, and `--resume` comes to the same bytes.

benchmarks/kills.py does it with signals, in hundreds of processes.
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

from sylpose import calibration
from sylpose.app.results_folder import EARLIER
from sylpose.app.run import has_ended, track_session
from sylpose.app.run_metadata import SETTINGS, USED
from sylpose.app.sync import Synced, write_offsets
from sylpose.atomic_io import beside, replacing
from sylpose.capture import Session, open_session
from sylpose.cli import main
from sylpose.sync.speed_correlation import Delays
from sylpose.tracking.tracked_frame import TrackedFrame

pytestmark = pytest.mark.usefixtures("undrawn")

STOP = 3
RESULTS = ("trajectory.tum", "trajectory.csv")
CHANGES = ("open", "os.rename", "os.remove", "os.truncate", "os.mkdir", "os.rmdir")


class PowerCut(BaseException):
    """Nothing more is written, whoever tries."""


class Cut:
    """Counts what changes files in a folder, and from some number on lets nothing of it happen."""

    def __init__(self) -> None:
        self.folder, self.count, self.at, self.full = "", 0, -1, False

    def arm(self, folder: Path, at: int = -1, full: bool = False) -> None:
        self.folder, self.count, self.at, self.full = str(folder), 0, at, full

    def __call__(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.folder or event not in CHANGES or not isinstance(args[0], (str, os.PathLike)):
            return
        if event == "open" and not (isinstance(args[2], int) and args[2] & os.O_ACCMODE):
            return
        if not os.fspath(args[0]).startswith(self.folder):
            return
        self.count += 1
        if 0 <= self.at < self.count:
            if self.full and event in ("open", "os.mkdir"):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), args[0])
            if not self.full:
                raise PowerCut


CUT = Cut()
sys.addaudithook(CUT)  # for good


@pytest.fixture(autouse=True)
def disarmed() -> Iterator[None]:
    yield
    CUT.arm(Path())
    CUT.folder = ""


@pytest.fixture(scope="module")
def opened(recording: Path) -> Session:
    return open_session(recording)


def run(session: Session, out: Path, smooth: bool, **options: Any) -> None:
    track_session(session, out, stop=STOP, smooth=smooth, overlay=False, checkpoint_seconds=0, workers=1, **options)


@pytest.fixture(scope="module")
def whole(opened: Session, tmp_path_factory: pytest.TempPathFactory) -> dict[bool, dict[str, bytes]]:
    """The texts of runs that nothing disturbed, with smoothing and without; and of one that is longer."""
    found = {}
    for smooth in (True, False):
        out = tmp_path_factory.mktemp("whole")
        run(opened, out, smooth)
        found[smooth] = texts(out)
    return found


def texts(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.suffix in (".tum", ".csv")}


EARLIER_RESULT = {"trajectory.tum": b"# an earlier\n", "trajectory.csv": b"index\n" + b"0\n" * 99}


def with_earlier(out: Path) -> Path:
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    for name, content in EARLIER_RESULT.items():
        (out / name).write_bytes(content)
    return out


@pytest.mark.parametrize(
    ("smooth", "full"),
    [
        pytest.param(True, False, id="smooth-cut"),
        pytest.param(True, True, id="smooth-full", marks=pytest.mark.slow),
        pytest.param(False, False, id="plain-cut", marks=pytest.mark.slow),
        pytest.param(False, True, id="plain-full"),
    ],
)
def test_at_any_moment(
    opened: Session, whole: dict[bool, dict[str, bytes]], tmp_path: Path, smooth: bool, full: bool
) -> None:
    """Over an earlier result, which stays until there is the new one."""
    out = with_earlier(tmp_path / "out")
    CUT.arm(out)
    run(opened, out, smooth)
    for at in np.unique(np.linspace(1 + full, CUT.count - 1 - smooth, 3, dtype=int)):
        with_earlier(out)
        CUT.arm(out, int(at), full)
        said = broken(opened, out, smooth)
        CUT.arm(Path("/nowhere"))
        assert said == "" or (full and "cannot write " in said and "\n" not in said)
        kept = [{n: (folder / n).read_bytes() for n in RESULTS if (folder / n).exists()} for folder in folders(out)]
        new = {name: whole[smooth][name] for name in RESULTS}
        merged = {name: {its.get(name) for its in kept} for name in RESULTS}
        assert all(merged[name] & {EARLIER_RESULT[name], new[name]} for name in RESULTS), at
        if not (out / "checkpoint.bin").exists():  # it had not begun, or was at its end
            if has_ended(opened, out):
                assert texts(out) in (EARLIER_RESULT, whole[smooth])
            run(opened, out, smooth)
        else:
            assert not has_ended(opened, out)
            run(opened, out, smooth, resume=True)
        assert texts(out) == whole[smooth], at
        left = {file.name for file in out.iterdir()}
        assert left == {*whole[smooth], "report.png", "report.html", SETTINGS, USED}, at


def broken(session: Session, out: Path, smooth: bool) -> str:
    """What a run says that cannot go on."""
    try:
        run(session, out, smooth)
    except PowerCut:
        return ""
    except OSError as error:
        return str(error)
    return ""


def folders(out: Path) -> list[Path]:
    return [out, *(entry for entry in out.iterdir() if entry.is_dir())]


def test_a_later_run_that_fails_takes_nothing(opened: Session, tmp_path: Path) -> None:
    out = with_earlier(tmp_path / "out")

    def breaks(tracked: TrackedFrame) -> None:
        if tracked.pose.index == 1:
            raise RuntimeError("a bug")

    for _ in range(2):  # and not the second time either
        with pytest.raises(RuntimeError):
            run(opened, out, False, on_frame=breaks)
        assert texts(out / EARLIER) == EARLIER_RESULT
        assert texts(out)["trajectory.csv"].count(b"\n") == 3  # what was computed
    run(opened, out, False)
    assert not (out / EARLIER).exists()


def test_a_resumed_run_that_fails_leaves_what_was_there(
    opened: Session, whole: dict[bool, dict[str, bytes]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def breaks(*_: object, **__: object) -> None:
        raise RuntimeError("a bug")

    with monkeypatch.context() as patch:
        patch.setattr("sylpose.app.results_folder.ResultsFolder.end", breaks)  # all is there but the end
        with pytest.raises(RuntimeError):
            run(opened, tmp_path, True)
    assert not has_ended(opened, tmp_path)
    before = texts(tmp_path)
    assert before == whole[True]
    with monkeypatch.context() as patch:
        patch.setattr("sylpose.app.outputs.smooth", breaks)
        with pytest.raises(RuntimeError):
            run(opened, tmp_path, True, resume=True)
    assert texts(tmp_path) == before
    run(opened, tmp_path, True, resume=True)
    assert texts(tmp_path) == before
    assert has_ended(opened, tmp_path)


def test_two_runs_in_one_folder(opened: Session, tmp_path: Path) -> None:
    said = list[str]()

    def another(_: TrackedFrame) -> None:
        with pytest.raises(ValueError, match="another run writes its results there") as refused:
            run(opened, tmp_path, False, resume=bool(said))
        said.append(str(refused.value))

    run(opened, tmp_path, False, on_frame=another)
    assert len(said) == STOP
    assert str(tmp_path) in said[0]
    run(opened, tmp_path, False)  # nobody is there any more


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
def test_arguments_are_looked_at_first(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], words: str
) -> None:
    out = with_earlier(tmp_path / "out")
    (out / "checkpoint.bin").write_bytes(b"of a run that was interrupted")
    before = {file: file.read_bytes() for file in out.iterdir()}
    assert main(["track", str(recording), "--out", str(out), "--no-overlay", *options]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert words in said
    assert {file: file.read_bytes() for file in out.iterdir()} == before


def test_results_do_not_go_into_the_recording(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (session / "link").symlink_to(session)
    before = sorted(session.rglob("*"))
    for out in (session, session / "link", session / "cam_0.mp4", session / "cam_0.mp4" / "results"):
        for command in ("track", "check"):
            assert main([command, str(session), "--out", str(out)]) == 2
            said = capsys.readouterr().err.splitlines()
            assert len(said) == 1
            assert f"--out {out}: " in said[0]
    assert sorted(session.rglob("*")) == before
    with pytest.raises(ValueError, match="--checkpoint must be a number of seconds"):
        track_session(open_session(session), checkpoint_seconds=float("nan"))
    assert sorted(session.rglob("*")) == before
    assert main(["sync", str(session), "--out", str(session / "cam_0.mp4")]) == 2
    assert "no file of offsets that could be replaced" in capsys.readouterr().err


def test_a_file_that_cannot_be_written_stays_as_it_was(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = session / "calibration.toml"
    rig, before = calibration.load(path), path.read_bytes()

    def half(part: Path, text: str, **_: Any) -> None:
        part.write_bytes(text.encode()[: len(text) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", half)
    with pytest.raises(OSError, match=r"cannot write .*calibration\.toml: no space left"):
        calibration.save(rig, path)
    assert path.read_bytes() == before
    assert not beside(path).exists()
    offsets = tmp_path / "offsets.toml"
    offsets.write_bytes(b"cam_0 = 0.1\n")
    none = np.empty(0)
    nothing = Synced((), 30.0, none, none, (), Delays(none, none, none > 0), none, none, 0, ())
    with pytest.raises(OSError, match=r"cannot write .*offsets\.toml: no space left"):
        write_offsets(nothing, offsets)
    assert offsets.read_bytes() == b"cam_0 = 0.1\n"


def test_replacing(tmp_path: Path) -> None:
    """Links are followed, permissions kept; what is no file is written to as it is."""
    target, link = tmp_path / "a.txt", tmp_path / "b.txt"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    with replacing(link) as part:
        assert part != target
        part.write_text("new")
        assert target.read_text() == "old"
    assert link.is_symlink()
    assert target.read_text() == "new"
    assert target.stat().st_mode & 0o777 == 0o640
    with replacing(tmp_path / "secret", mode=0o600) as part:
        part.write_text("x")
    assert (tmp_path / "secret").stat().st_mode & 0o777 == 0o600
    with replacing("/dev/null") as part:
        part.write_text("x")
    with replacing(tmp_path / "new" / "deep" / "a.txt") as part:
        part.write_text("x")
    assert (tmp_path / "new" / "deep" / "a.txt").read_text() == "x"
    with (
        pytest.raises(OSError, match=r"cannot write into .*secret: it is a file"),
        replacing(tmp_path / "secret" / "a.txt") as part,
    ):
        part.write_text("x")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.txt", "b.txt", "new", "secret"]
