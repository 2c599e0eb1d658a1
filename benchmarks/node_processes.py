"""Processes of `sylpose node` for benchmarks: recordings for them, their starts and deaths, and what they say."""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from sylpose.app.network_demo import node_command
from sylpose.methods import MODES
from sylpose.network.zenoh_transport import LOOPBACK, Links, watch_network
from sylpose.simulate import demo_scene, render_frames
from sylpose.simulate.recording_files import session_folder, write_videos

__all__ = ["RATE", "Line", "Processes", "as_installed", "looped_recording", "processes", "rss_mb"]

RATE = 30.0  # frames per second of a recording
# Small pictures, of which two cores can work on a few hundred in a second (choice).
SIZE = (320, 240)


class Line(NamedTuple):
    """What a node said: when it was heard, seconds; what."""

    heard: float
    said: dict[str, Any]


def looped_recording(folder: Path, cameras: int, frames: int, seconds: float, *, seed: int = 0) -> Path:
    """Cameras before the demo's block, which turns by 90 degrees in so many frames and back again, for so long."""
    scene = demo_scene(frames=frames, turn_deg=90.0, seed=seed, size=SIZE, n_cameras=cameras)
    there = list(render_frames(scene))
    images = there + there[-2:0:-1]
    repeats = max(1, round(seconds * RATE / len(images)))
    session_folder(folder, scene.rig)
    write_videos(folder, scene.rig, images, len(images), repeats=repeats)
    return folder


class Processes:
    """Nodes on a recording, a process each.

    Args:
        recording: its folder; out: where results go.
        speed, mode: as of `sylpose node`. wait: seconds for which they wait for each other.

    Attributes:
        poses, states: by name, what each has said.
    """

    def __init__(
        self, recording: Path, out: Path, *, speed: float = 1.0, wait: float = 60.0, mode: str = MODES[0]
    ) -> None:
        self.recording, self.out, self.speed, self.wait, self.mode = recording, out, speed, wait, mode
        self.network = f"bench-{os.getpid()}-{time.monotonic_ns() // 1000}"
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.starts: dict[str, int] = {}
        self.poses: dict[str, list[Line]] = {}
        self.states: dict[str, list[Line]] = {}
        self._news = threading.Condition()
        self._session = watch_network(
            Links(LOOPBACK),
            self.network,
            lambda _, name, line: self._heard(self.states, name, line),
            lambda name, line: self._heard(self.poses, name, line),
        )

    def _heard(self, lines: dict[str, list[Line]], name: str, line: str) -> None:
        with self._news:
            lines.setdefault(name, []).append(Line(time.monotonic(), json.loads(line)))
            self._news.notify_all()

    def start(self, name: str) -> None:
        """Each time with a folder of its own: NAME_0, NAME_1, ..."""
        k = self.starts[name] = self.starts.get(name, -1) + 1
        folder = self.out / f"{name}_{k}"
        folder.mkdir(parents=True, exist_ok=True)
        command = node_command(name, self.recording, folder, self.network, self.speed, self.wait, self.mode)
        with (folder / "said.txt").open("wb") as said:
            self.running[name] = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT, env=as_installed())

    def kill(self, name: str) -> None:
        """As `kill -9` does."""
        self.running[name].kill()
        self.running[name].wait()

    def alive(self) -> list[str]:
        """The names of those that run."""
        return [name for name, process in self.running.items() if process.poll() is None]

    def wait_for(self, names: Sequence[str], frames: int, seconds: float) -> None:
        """Until each has said poses of so many frames.

        Raises:
            TimeoutError: it has not.
        """
        with self._news:
            if not self._news.wait_for(lambda: all(len(self.poses.get(n, [])) >= frames for n in names), seconds):
                raise TimeoutError({n: len(self.poses.get(n, [])) for n in names})

    def close(self) -> None:
        """End all."""
        for process in self.running.values():
            if process.poll() is None:
                process.kill()
                process.wait()
        self._session.close()


@contextmanager
def processes(recording: Path, out: Path, **options: Any) -> Iterator[Processes]:
    """`Processes` that end with the block."""
    of = Processes(recording, out, **options)
    try:
        yield of
    finally:
        of.close()


def as_installed() -> dict[str, str]:
    """The environment in which Python keeps what it has compiled, as after an installation."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def rss_mb(pid: int) -> float:
    """Memory of a process that is in use, MB."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:  # it has ended
        return 0.0
    return next((int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmRSS:")), 0.0)
