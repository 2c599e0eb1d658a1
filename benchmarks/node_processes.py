"""Processes of `sylpose node` for benchmarks: recordings, starts, kills, and received output."""

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

from sylpose.commands.network import build_node_command
from sylpose.methods import MODES
from sylpose.network.zenoh_transport import LOOPBACK, LinkSettings, watch_network
from sylpose.simulate import make_demo_scene, render_frames
from sylpose.simulate.recordings import create_session_folder, write_videos

__all__ = [
    "RATE",
    "NodeLine",
    "NodeProcesses",
    "make_environment",
    "read_rss_mb",
    "run_processes",
    "write_looped_recording",
]

RATE = 30.0  # frames per second of a recording
# Small images, of which two cores process a few hundred per second (choice).
SIZE = (320, 240)


class NodeLine(NamedTuple):
    """Line of a node: time of arrival in seconds, and content."""

    arrival: float
    content: dict[str, Any]


def write_looped_recording(folder: Path, cameras: int, frames: int, seconds: float, *, seed: int = 0) -> Path:
    """Write a recording of the demo's block, which rotates by 90 degrees in `frames` frames and back, repeatedly."""
    scene = make_demo_scene(frames=frames, angle_deg=90.0, seed=seed, size=SIZE, n_cameras=cameras)
    forward_images = list(render_frames(scene))
    images = forward_images + forward_images[-2:0:-1]
    repeats = max(1, round(seconds * RATE / len(images)))
    create_session_folder(folder, scene.rig)
    write_videos(folder, scene.rig, images, len(images), repeats=repeats)
    return folder


class NodeProcesses:
    """Nodes that process a recording, each in its own process.

    Args:
        recording: folder of the recording.
        out: folder of the results.
        speed, mode: as for `sylpose node`.
        wait: time that nodes wait for each other, seconds.

    Attributes:
        poses, states: received lines of each node, by name.
    """

    def __init__(
        self, recording: Path, out: Path, *, speed: float = 1.0, wait: float = 60.0, mode: str = MODES[0]
    ) -> None:
        self.recording, self.out, self.speed, self.wait, self.mode = recording, out, speed, wait, mode
        self.network = f"bench-{os.getpid()}-{time.monotonic_ns() // 1000}"
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.starts: dict[str, int] = {}
        self.poses: dict[str, list[NodeLine]] = {}
        self.states: dict[str, list[NodeLine]] = {}
        self._changed = threading.Condition()
        self._session = watch_network(
            LinkSettings(LOOPBACK),
            self.network,
            lambda _, name, line: self._append_line(self.states, name, line),
            lambda name, line: self._append_line(self.poses, name, line),
        )

    def _append_line(self, lines: dict[str, list[NodeLine]], name: str, line: str) -> None:
        with self._changed:
            lines.setdefault(name, []).append(NodeLine(time.monotonic(), json.loads(line)))
            self._changed.notify_all()

    def start(self, name: str) -> None:
        """Start a node; each start has a new folder: NAME_0, NAME_1, ..."""
        k = self.starts[name] = self.starts.get(name, -1) + 1
        folder = self.out / f"{name}_{k}"
        folder.mkdir(parents=True, exist_ok=True)
        command = build_node_command(name, self.recording, folder, self.network, self.speed, self.wait, self.mode)
        with (folder / "log.txt").open("wb") as log:
            self.running[name] = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=make_environment())

    def kill(self, name: str) -> None:
        """Kill a node by SIGKILL."""
        self.running[name].kill()
        self.running[name].wait()

    def running_names(self) -> list[str]:
        """Return the names of the running nodes."""
        return [name for name, process in self.running.items() if process.poll() is None]

    def wait_for_poses(self, names: Sequence[str], frames: int, seconds: float) -> None:
        """Wait until each node has sent the poses of `frames` frames.

        Raises:
            TimeoutError: a node has sent fewer after `seconds`.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: all(len(self.poses.get(n, [])) >= frames for n in names), seconds):
                raise TimeoutError({n: len(self.poses.get(n, [])) for n in names})

    def close(self) -> None:
        """Kill all nodes and close the connection."""
        for process in self.running.values():
            if process.poll() is None:
                process.kill()
                process.wait()
        self._session.close()


@contextmanager
def run_processes(recording: Path, out: Path, **options: Any) -> Iterator[NodeProcesses]:
    """Create `NodeProcesses` that end with the block."""
    nodes = NodeProcesses(recording, out, **options)
    try:
        yield nodes
    finally:
        nodes.close()


def make_environment() -> dict[str, str]:
    """Return an environment in which Python caches bytecode, as after an installation."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def read_rss_mb(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:  # it has ended
        return 0.0
    return next((int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmRSS:")), 0.0)
