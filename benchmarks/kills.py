"""Recovery by `--resume` from runs that are interrupted at random or chosen moments.

    python benchmarks/kills.py --random 200 --aimed 100
    python benchmarks/kills.py --aimed 30 --what full       only full disks

A small recording is tracked, with and without `--smooth`, into a new folder or over an earlier, longer result. There are
three interruptions. SIGKILL or SIGTERM ends the run after a random time or right before one of its file operations in the
results folder. Or this operation and all later ones fail as on a full disk. Or no file may grow beyond a random size. Then
the run is resumed until it ends. Failures are: trajectories that differ by a byte from those of an undisturbed run, other
files in the folder, an exit code other than 0 or 2, more than one sentence of output, and an earlier result that is lost or
shorter before the run has ended. Needs POSIX.
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

from sylpose.commands.main import main as sylpose
from sylpose.simulate import make_demo_scene, write_sequence

__all__ = ["Interruption", "count_operations", "create_recording", "interrupt_and_resume", "run_trials"]

# Frames of the recording, tracked frames, and frames of the earlier result (choice: seconds per run).
FRAMES, STOP, EARLIER_STOP = 12, 7, 9
RESULTS = ("trajectory.tum", "trajectory.csv")
# Audit events of operations that change files or folders.
CHANGE_EVENTS = ("open", "os.rename", "os.remove", "os.truncate", "os.mkdir", "os.rmdir")


@dataclass(frozen=True)
class Interruption:
    """Interruption of a run.

    Attributes:
        how: "kill" or "term"; "full": the disk is full from then on; "size": no file grows beyond `at` bytes.
        at: number of a file operation, or (a float) seconds.
        smooth: the run has `--smooth`.
        has_earlier_result: the folder contains an earlier result.
        overlay: the run draws an overlay.
    """

    how: str
    at: float
    smooth: bool
    has_earlier_result: bool
    overlay: bool = False


def create_recording(folder: Path) -> Path:
    """Create the recording and its undisturbed results in `smooth`, `plain` and `earlier`; return its folder."""
    scene = make_demo_scene(frames=4 * FRAMES, angle_deg=60.0, size=(320, 240), n_cameras=3)
    recording = folder / "recording"
    recording.mkdir()
    write_sequence(recording, replace(scene, frames=FRAMES), boxes=True)
    for name in ("smooth", "plain"):
        code, output = _run_interrupted(
            _make_command(recording, folder / name, _options(name == "smooth", overlay=False))
        )
        assert code == 0, f"{code}: {output}"
    earlier = ["track", str(recording), "--stop", str(EARLIER_STOP), "--no-overlay", "--out", str(folder / "earlier")]
    assert _run_interrupted(earlier)[0] == 0
    return recording


def count_operations(folder: Path, smooth: bool, has_earlier_result: bool, overlay: bool = False) -> int:
    """Count the file operations of an undisturbed run."""
    out = _remove_folder(folder / "out")
    if has_earlier_result:
        shutil.copytree(folder / "earlier", out)
    count_file = folder / "counted"
    _run_interrupted(_make_command(folder / "recording", out, _options(smooth, overlay)), out, "count", 0, count_file)
    return len(count_file.read_bytes())


def interrupt_and_resume(folder: Path, interruption: Interruption) -> list[str]:
    """Interrupt and resume a run; return the failures."""
    out, run_failures = _remove_folder(folder / "out"), list[str]()
    if interruption.has_earlier_result:
        shutil.copytree(folder / "earlier", out)
    args = _make_command(folder / "recording", out, _options(interruption.smooth, interruption.overlay))
    code, output = _run_interrupted(args, out, interruption.how, interruption.at)
    if interruption.how in ("full", "size") and code not in (0, 2):
        run_failures.append(f"failed with exit code {code}: {output[-300:]}")
    if interruption.has_earlier_result and code != 0 and not _is_kept(folder, out, interruption.smooth):
        run_failures.append("the earlier result is lost")
    if code == 2 and len(output.strip().splitlines()) > 2:
        run_failures.append(f"printed more than a sentence: {output[-300:]}")
    if code == 0:
        return run_failures + _find_differences(folder, out, interruption)
    contents_before = {name: (out / name).read_bytes() for name in RESULTS if (out / name).exists()}
    code, output = _run_interrupted([*args, "--resume"], out)
    is_untouched = interruption.has_earlier_result and contents_before == {
        name: (folder / "earlier" / name).read_bytes() for name in RESULTS
    }
    if (code == 2 and "no interrupted run" in output) or (is_untouched and "has ended" in output):  # it had not started
        contents_after = {name: (out / name).read_bytes() for name in RESULTS if (out / name).exists()}
        # Earlier results that were being moved may have been restored.
        is_restored = interruption.has_earlier_result and contents_after == {
            name: (folder / "earlier" / name).read_bytes() for name in RESULTS
        }
        if contents_after != contents_before and not is_restored:
            run_failures.append("refused to resume, but changed files")
        code, output = _run_interrupted(args, out)
    elif "has ended" in output and _find_differences(folder, out, interruption):
        run_failures.append(f"reported as ended: {output[-200:]}")
    if code != 0:
        run_failures.append(f"resumed with exit code {code}: {output[-300:]}")
    return run_failures + _find_differences(folder, out, interruption)


def run_trials(folder: Path, random: int, aimed: int, methods: Sequence[str], seed: int) -> Counter[str]:
    """Interrupt runs and print the failures; return the numbers of runs and of failed runs per kind."""
    rng, count = np.random.default_rng(seed), Counter[str]()
    kinds = [
        (smooth, has_earlier_result, overlay)
        for smooth in (True, False)
        for has_earlier_result in (False, True)
        for overlay in (False, True)
    ]
    steps = {kind: count_operations(folder, *kind) for kind in kinds}
    begin = time.monotonic()
    _run_interrupted(_make_command(folder / "recording", _remove_folder(folder / "out"), _options(True, True)))
    seconds = time.monotonic() - begin
    for k in range(random + aimed):
        smooth, has_earlier_result, overlay = kinds[k % len(kinds)]
        method = str(rng.choice(list(methods)))
        if method == "size":
            at: float = int(10 ** rng.uniform(1.5, 6.5))
        elif k < random and method != "full":
            at = float(rng.uniform(0.02, 1.1 * seconds))
        else:
            at = int(rng.integers(steps[smooth, has_earlier_result, overlay]))
        interruption = Interruption(method, at, smooth, has_earlier_result, overlay)
        run_failures = interrupt_and_resume(folder, interruption)
        kind = f"{method}, {'aimed' if isinstance(at, int) else 'random'}, {'smooth' if smooth else 'plain'}"
        count[kind] += 1
        count[f"{kind}: wrong"] += bool(run_failures)
        for sentence in run_failures:
            print(f"{interruption}: {sentence}", flush=True)
    return count


def _options(smooth: bool, overlay: bool) -> list[str]:
    return ["--smooth" if smooth else "--no-smooth", *([] if overlay else ["--no-overlay"])]


def _make_command(recording: Path, out: Path, options: Sequence[str]) -> list[str]:
    return ["track", str(recording), *options, "--stop", str(STOP), "--checkpoint", "0", "--out", str(out)]


def _remove_folder(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def _is_kept(folder: Path, out: Path, smooth: bool) -> bool:
    """Return whether the results folder contains the earlier result or the complete new one."""
    undisturbed = folder / ("smooth" if smooth else "plain")
    for name in RESULTS:
        contents = [file.read_bytes() for file in out.rglob(name)]
        if not {(folder / "earlier" / name).read_bytes(), (undisturbed / name).read_bytes()} & set(contents):
            return False
    return True


def _find_differences(folder: Path, out: Path, interruption: Interruption) -> list[str]:
    """Return the differences from the undisturbed run."""
    undisturbed = folder / ("smooth" if interruption.smooth else "plain")
    names = {file.name for file in undisturbed.iterdir()}
    texts = [name for name in names if name.endswith((".tum", ".csv"))]
    wrong = [f"{name} differs" for name in texts if _read_bytes(undisturbed / name) != _read_bytes(out / name)]
    present = (
        {file.name for file in out.iterdir() if not file.name.startswith(("overlay", ".lock"))}
        if out.exists()
        else set()
    )
    return wrong + [f"{name} is unexpected or missing" for name in sorted(present ^ names)]


def _read_bytes(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


def _run_interrupted(
    args: Sequence[str], out: Path | None = None, how: str = "", at: float = 0, count_file: Path | None = None
) -> tuple[int, str]:
    """Run a command in a forked process and interrupt it; return the exit code (negative: the signal) and the output."""
    reading, writing = os.pipe()  # not a file, whose size would be limited too; the pipe holds the whole output
    with open(reading, "rb") as output:
        pid = os.fork()
        if not pid:
            _run_child(args, out, how, at, writing, count_file)
        os.close(writing)
        if isinstance(at, float) and how in ("kill", "term"):
            time.sleep(at)
            os.kill(pid, signal.SIGKILL if how == "kill" else signal.SIGTERM)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        return code, output.read().decode(errors="replace")


def _run_child(
    args: Sequence[str], out: Path | None, how: str, at: float, output: int, count_file: Path | None
) -> None:
    code = 70
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.dup2(output, 2)
        os.dup2(output if "--resume" in args else os.open(os.devnull, os.O_WRONLY), 1)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        if how == "size":
            resource.setrlimit(resource.RLIMIT_FSIZE, (int(at), resource.RLIM_INFINITY))
        elif out is not None and isinstance(at, int) and how:
            _install_audit_hook(out, how, at, None if count_file is None else count_file.open("wb", buffering=0))
        code = sylpose(list(args))
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)


def _install_audit_hook(out: Path, how: str, at: int, count_file: Any) -> None:
    """End this process, or simulate a full disk, right before a file operation in a folder, given by its number."""
    number, folder = 0, str(out.resolve())

    def on_event(event: str, args: tuple[Any, ...]) -> None:
        nonlocal number
        if event not in CHANGE_EVENTS or not isinstance(args[0], (str, os.PathLike)):
            return
        if event == "open" and not (isinstance(args[2], int) and args[2] & os.O_ACCMODE):
            return
        if not os.path.abspath(os.fspath(args[0])).startswith(folder):
            return
        number += 1
        if count_file is not None:
            os.write(count_file.fileno(), b".")
        elif number - 1 >= at and how == "full" and event in ("open", "os.mkdir"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), args[0])
        elif number - 1 == at and how in ("kill", "term"):
            os.kill(os.getpid(), signal.SIGKILL if how == "kill" else signal.SIGTERM)

    sys.addaudithook(on_event)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--random", type=int, default=0)
    parser.add_argument("--aimed", type=int, default=20)
    parser.add_argument("--what", nargs="+", default=["kill", "term", "full", "size"])
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    cv2.setNumThreads(0)  # threads do not survive a fork
    with tempfile.TemporaryDirectory() as folder:
        create_recording(Path(folder))
        count = run_trials(Path(folder), arguments.random, arguments.aimed, arguments.what, arguments.seed)
    print("\n| interruption | runs | failures |\n|---|---|---|")
    for kind in sorted(count):
        if not kind.endswith(": wrong"):
            print(f"| {kind} | {count[kind]} | {count[f'{kind}: wrong']} |")


if __name__ == "__main__":
    main()
