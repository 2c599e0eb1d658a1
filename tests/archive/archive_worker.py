"""Substitute for the tracking: the file `do` in a recording determines what a worker does with it."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np

from sylpose.archive import contract
from sylpose.archive.contract import RunSettings, Summary
from sylpose.archive.recordings import Recording, TrackingOptions, find_recordings
from sylpose.io.stores import Store


def make_recordings(folder: Path, **orders: str) -> list[Recording]:
    """Create recordings with these names and instructions."""
    for name, order in orders.items():
        (folder / name).mkdir(parents=True, exist_ok=True)
        (folder / name / "do").write_text(order)
        (folder / name / "calibration.toml").touch()
        (folder / name / "cam_0.mp4").touch()
    return find_recordings([str(folder)], TrackingOptions())[0]


def count_work(folder: Path, name: str) -> int:
    log = folder / name / "sylpose" / "log"
    return len(log.read_text()) if log.exists() else 0


def do_work(recording: Recording, folder: Path, threads: int) -> Summary:
    """Write two files, unless instructed otherwise; leave a mark each time."""
    source = Path(recording.path)
    order, _, rest = (source / "do").read_text().partition(" ")
    (source / "sylpose").mkdir(exist_ok=True)  # not among the inputs
    (source / "sylpose" / "parent").write_text(str(os.getppid()))
    (source / "sylpose" / "pid").write_text(str(os.getpid()))
    with (source / "sylpose" / "log").open("a") as log:
        log.write(".")
    first = (source / "sylpose" / "log").stat().st_size == 1
    (folder / "results" / "half").write_text("")
    if order == "die" or (order == "die-once" and first):
        os.kill(os.getpid(), signal.SIGKILL)
    elif order == "exit":
        os._exit(3)
    elif order == "sleep" or (order == "sleep-once" and first):
        time.sleep(float(rest))
    elif order == "wait":  # for a file, with a timeout for failed tests
        deadline = time.monotonic() + 60
        while not Path(rest).exists() and time.monotonic() < deadline:
            time.sleep(0.02)
    elif order == "io" or (order == "io-once" and first):
        raise OSError("the disk is on strike")
    elif order == "wrong":
        raise ValueError("cam_0 is upside down")
    elif order == "bug":
        raise IndexError("off by one")
    elif order == "memory":
        np.ones(int(rest), np.uint8)
    elif order == "interrupt":
        raise KeyboardInterrupt
    (folder / "results" / "half").unlink()
    (folder / "results" / "mug").mkdir()
    (folder / "results" / "mug" / "trajectory.csv").write_text(f"{recording.name} {recording.seed}")
    (folder / "results" / "threads").write_text(f"{threads} {os.environ.get('OPENBLAS_NUM_THREADS')}")
    return Summary(status="done", frames=7, coverage=0.5, faults=("cam_1 was moved",))


def make_settings(out: Store, **changes: Any) -> RunSettings:
    """Return the settings of a run "a" that does the substitute work."""
    return RunSettings(out, do_work, **{"run": "a"} | changes)


def read_owner(store: Store) -> str:
    """Return the process that holds a recording and may still be at work; empty without any."""
    return contract._read_live_claim(store, contract._list_claims(store))[1]
