"""Runs that are broken off, at random and at aimed moments, and what `--resume` makes of them.

    python benchmarks/kills.py --random 200 --aimed 100
    python benchmarks/kills.py --aimed 30 --what full       only full disks

A small recording is tracked, with and without `--smooth`, into a new folder or over an earlier, longer result. The run ends
by SIGKILL or SIGTERM after a random time, or right before one of its operations on files in the results' folder, or that
operation and all later ones fail as on a full disk; or no file may grow beyond a random size. Then `--resume`, as often as
it takes. Counted is what must not be: other bytes in the trajectories than a run has that was not disturbed, other files
beside them, an exit that is neither 0 nor 2, more than one sentence, a finished result that is gone or shorter while the
run is not at its end. Needs POSIX.
"""

from __future__ import annotations

import argparse
import errno
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sylpose.cli import main as sylpose
from sylpose.simulate import demo_scene, write_sequence

__all__ = ["Break", "broken", "made", "operations", "trials"]

# Frames of the recording; of those tracked; of the earlier result's (choice: seconds a run).
FRAMES, STOP, EARLIER = 12, 7, 9
RESULTS = ("trajectory.tum", "trajectory.csv")
# Operations that change files or folders, as Python's audit hooks name them.
CHANGES = ("open", "os.rename", "os.remove", "os.truncate", "os.mkdir", "os.rmdir")


@dataclass(frozen=True)
class Break:
    """How a run is broken off.

    Attributes:
        how: "kill" or "term"; "full": the disk is full from then on; "size": no file grows beyond `at` bytes.
        at: the number of an operation on files, or (a float) seconds.
        smooth: whether the run is one with `--smooth`.
        over: whether there is an earlier result in the folder.
        overlay: whether it draws one.
    """

    how: str
    at: float
    smooth: bool
    over: bool
    overlay: bool = False


def made(folder: Path) -> Path:
    """The recording, and results of it that were not disturbed, in `smooth`, `plain` and `earlier`."""
    scene = demo_scene(frames=4 * FRAMES, turn_deg=60.0, size=(320, 240), n_cameras=3)
    recording = folder / "recording"
    recording.mkdir()
    write_sequence(recording, replace(scene, frames=FRAMES), boxes=True)
    for name in ("smooth", "plain"):
        code, said = _run(_asked(recording, folder / name, _options(name == "smooth", overlay=False)))
        assert code == 0, f"{code}: {said}"
    earlier = ["track", str(recording), "--stop", str(EARLIER), "--no-overlay", "--out", str(folder / "earlier")]
    assert _run(earlier)[0] == 0
    return recording


def operations(folder: Path, smooth: bool, over: bool, overlay: bool = False) -> int:
    """How many operations on files a run takes from its start to its end."""
    out = _empty(folder / "out")
    if over:
        shutil.copytree(folder / "earlier", out)
    counted = folder / "counted"
    _run(_asked(folder / "recording", out, _options(smooth, overlay)), out, "count", 0, counted)
    return len(counted.read_bytes())


def broken(folder: Path, how: Break) -> list[str]:
    """What went wrong with a run that was broken off and resumed; nothing if all is as it should be."""
    out, wrong = _empty(folder / "out"), list[str]()
    if how.over:
        shutil.copytree(folder / "earlier", out)
    args = _asked(folder / "recording", out, _options(how.smooth, how.overlay))
    code, said = _run(args, out, how.how, how.at)
    if how.how in ("full", "size") and code not in (0, 2):
        wrong.append(f"broke with {code}: {said[-300:]}")
    if how.over and code != 0 and not _is_kept(folder, out, how.smooth):
        wrong.append("the earlier result is gone")
    if code == 2 and len(said.strip().splitlines()) > 2:
        wrong.append(f"said more than a sentence: {said[-300:]}")
    if code == 0:
        return wrong + _compared(folder, out, how)
    before = {name: (out / name).read_bytes() for name in RESULTS if (out / name).exists()}
    code, said = _run([*args, "--resume"], out)
    untouched = how.over and before == {name: (folder / "earlier" / name).read_bytes() for name in RESULTS}
    if (code == 2 and "no interrupted run" in said) or (untouched and "has ended" in said):  # it had not begun
        after = {name: (out / name).read_bytes() for name in RESULTS if (out / name).exists()}
        # The earlier results may have come back that were being moved.
        back = how.over and after == {name: (folder / "earlier" / name).read_bytes() for name in RESULTS}
        if after != before and not back:
            wrong.append("refused, and changed something")
        code, said = _run(args, out)
    elif "has ended" in said and _compared(folder, out, how):
        wrong.append(f"said to have ended: {said[-200:]}")
    if code != 0:
        wrong.append(f"resumed with {code}: {said[-300:]}")
    return wrong + _compared(folder, out, how)


def trials(folder: Path, random: int, aimed: int, what: Sequence[str], seed: int) -> Counter[str]:
    """Breaks runs off and says what went wrong; returns how many of each kind, and how many of them did."""
    rng, count = np.random.default_rng(seed), Counter[str]()
    kinds = [(smooth, over, overlay) for smooth in (True, False) for over in (False, True) for overlay in (False, True)]
    steps = {kind: operations(folder, *kind) for kind in kinds}
    begin = time.monotonic()
    _run(_asked(folder / "recording", _empty(folder / "out"), _options(True, True)))
    seconds = time.monotonic() - begin
    for k in range(random + aimed):
        smooth, over, overlay = kinds[k % len(kinds)]
        how = str(rng.choice(list(what)))
        if how == "size":
            at: float = int(10 ** rng.uniform(1.5, 6.5))
        elif k < random and how != "full":
            at = float(rng.uniform(0.02, 1.1 * seconds))
        else:
            at = int(rng.integers(steps[smooth, over, overlay]))
        breaks = Break(how, at, smooth, over, overlay)
        wrong = broken(folder, breaks)
        kind = f"{how}, {'aimed' if isinstance(at, int) else 'random'}, {'smooth' if smooth else 'plain'}"
        count[kind] += 1
        count[f"{kind}: wrong"] += bool(wrong)
        for sentence in wrong:
            print(f"{breaks}: {sentence}", flush=True)
    return count


def _options(smooth: bool, overlay: bool) -> list[str]:
    return ["--smooth" if smooth else "--no-smooth", *([] if overlay else ["--no-overlay"])]


def _asked(recording: Path, out: Path, options: Sequence[str]) -> list[str]:
    return ["track", str(recording), *options, "--stop", str(STOP), "--checkpoint", "0", "--out", str(out)]


def _empty(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def _is_kept(folder: Path, out: Path, smooth: bool) -> bool:
    """Whether the earlier result is somewhere in the results' folder, or there is the new one."""
    whole = folder / ("smooth" if smooth else "plain")
    for name in RESULTS:
        contents = [file.read_bytes() for file in out.rglob(name)]
        if not {(folder / "earlier" / name).read_bytes(), (whole / name).read_bytes()} & set(contents):
            return False
    return True


def _compared(folder: Path, out: Path, how: Break) -> list[str]:
    """What is not as in the run that was not disturbed."""
    whole = folder / ("smooth" if how.smooth else "plain")
    names = {file.name for file in whole.iterdir()}
    texts = [name for name in names if name.endswith((".tum", ".csv"))]
    wrong = [f"{name} has other bytes" for name in texts if _bytes(whole / name) != _bytes(out / name)]
    there = (
        {file.name for file in out.iterdir() if not file.name.startswith(("overlay", ".lock"))}
        if out.exists()
        else set()
    )
    return wrong + [f"{name} is there or missing" for name in sorted(there ^ names)]


def _bytes(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


def _run(
    args: Sequence[str], out: Path | None = None, how: str = "", at: float = 0, counted: Path | None = None
) -> tuple[int, str]:
    """A command in a process of its own, which is broken off; its exit code (less than 0: the signal), and what it said."""
    reading, writing = os.pipe()  # not a file, which may not grow either; it holds all that is said
    with open(reading, "rb") as said:
        pid = os.fork()
        if not pid:
            _become(args, out, how, at, writing, counted)
        os.close(writing)
        if isinstance(at, float) and how in ("kill", "term"):
            time.sleep(at)
            os.kill(pid, signal.SIGKILL if how == "kill" else signal.SIGTERM)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        return code, said.read().decode(errors="replace")


def _become(args: Sequence[str], out: Path | None, how: str, at: float, said: int, counted: Path | None) -> None:
    code = 70
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.dup2(said, 2)
        os.dup2(said if "--resume" in args else os.open(os.devnull, os.O_WRONLY), 1)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        if how == "size":
            resource.setrlimit(resource.RLIMIT_FSIZE, (int(at), resource.RLIM_INFINITY))
        elif out is not None and isinstance(at, int) and how:
            _watch(out, how, at, None if counted is None else counted.open("wb", buffering=0))
        code = sylpose(list(args))
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)


def _watch(out: Path, how: str, at: int, counted: Any) -> None:
    """Ends this process, or fills its disk, right before the operation of a number in a folder."""
    number, folder = 0, str(out.resolve())

    def heard(event: str, args: tuple[Any, ...]) -> None:
        nonlocal number
        if event not in CHANGES or not isinstance(args[0], (str, os.PathLike)):
            return
        if event == "open" and not (isinstance(args[2], int) and args[2] & os.O_ACCMODE):
            return
        if not os.path.abspath(os.fspath(args[0])).startswith(folder):
            return
        number += 1
        if counted is not None:
            os.write(counted.fileno(), b".")
        elif number - 1 >= at and how == "full" and event in ("open", "os.mkdir"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), args[0])
        elif number - 1 == at and how in ("kill", "term"):
            os.kill(os.getpid(), signal.SIGKILL if how == "kill" else signal.SIGTERM)

    sys.addaudithook(heard)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--random", type=int, default=0)
    parser.add_argument("--aimed", type=int, default=20)
    parser.add_argument("--what", nargs="+", default=["kill", "term", "full", "size"])
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    cv2.setNumThreads(0)  # threads do not live on in processes that are forked
    with tempfile.TemporaryDirectory() as folder:
        made(Path(folder))
        count = trials(Path(folder), asked.random, asked.aimed, asked.what, asked.seed)
    print("\n| broken off by | runs | wrong |\n|---|---|---|")
    for kind in sorted(count):
        if not kind.endswith(": wrong"):
            print(f"| {kind} | {count[kind]} | {count[f'{kind}: wrong']} |")


if __name__ == "__main__":
    main()
