"""Nodes that are killed at any moment and started again. See `benchmarks/network.py --kills`."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.node_processes import RATE, Processes, as_installed, looped_recording, processes

__all__ = ["kills"]

# Frames per second, so that two cores suffice; seconds between two kills, at most, and for which a node is dead, at most;
# of a node that does not take part again (choice).
PACE, APART, DEAD, LOST = 3.0, 2.0, 1.0, 60.0


class Killed(NamedTuple):
    """One death. pause: the longest without a pose of those that lived, seconds; lost: of their poses, not tracked; links:
    seconds from its start until it listens, and pose: until its first pose, None where it did not come back."""

    name: str
    pause: float
    lost: int
    links: float
    pose: float | None


def kills(n: int, cameras: int = 4, seed: int = 0) -> str:
    """A table: medians and worst of so many kills."""
    rng, names = np.random.default_rng(seed), [f"cam_{c}" for c in range(cameras)]
    with tempfile.TemporaryDirectory() as folder:
        seconds = (60 + 15 * n) * PACE / RATE
        recording = looped_recording(Path(folder) / "recording", cameras, 31, seconds)
        with processes(recording, Path(folder) / "out", speed=PACE / RATE) as nodes:
            for name in names:
                nodes.start(name)
            nodes.wait_for(names, 10, 120)
            usual = pause(nodes, names, time.monotonic() - 3.0)
            done = []
            for _ in range(n):
                time.sleep(rng.uniform(0.0, APART))
                done.append(_kill(nodes, names, names[rng.integers(cameras)], rng.uniform(0.0, DEAD)))
                print(done[-1], file=sys.stderr, flush=True)
        imports = [_seconds_of("import sylpose.app.node") for _ in range(3)]
        nothing = [_seconds_of("pass") for _ in range(3)]
    came = [k.pose for k in done if k.pose is not None]
    pauses, links = [k.pause for k in done], [k.links for k in done]
    rows = [
        ("kills; came back", f"{n}; {len(came)}"),
        ("poses of the others that are not tracked", f"{sum(k.lost for k in done)}"),
        ("longest pause of the others, usual", f"{usual:.2f} s"),
        ("longest pause of the others, a kill: median, worst", f"{np.median(pauses):.2f}, {max(pauses):.2f} s"),
        ("from start to first pose: median, worst", f"{np.median(came):.2f}, {max(came):.2f} s"),
        ("of which until it listens: median, worst", f"{np.median(links):.2f}, {max(links):.2f} s"),
        ("of which Python's start; imports: median of three", f"{np.median(nothing):.2f}; {np.median(imports):.2f} s"),
    ]
    return "\n".join(f"| {what} | {value} |" for what, value in rows)


def _kill(nodes: Processes, names: list[str], name: str, dead: float) -> Killed:
    others = [other for other in names if other != name]
    died = time.monotonic()
    nodes.kill(name)
    time.sleep(dead)
    begun, before = time.monotonic(), len(nodes.poses[name])
    nodes.start(name)
    said, links, pose = nodes.out / f"{name}_{nodes.starts[name]}" / "said.txt", np.nan, None
    while time.monotonic() - begun < LOST and pose is None:
        time.sleep(0.005)
        if np.isnan(links) and said.exists() and "listens at" in said.read_text():
            links = time.monotonic() - begun
        if len(nodes.poses[name]) > before:
            pose = nodes.poses[name][before].heard - begun
    # The others have gone on by then, or stand still with it.
    time.sleep(1.0)
    lost = sum(line.said["status"] != "tracked" for o in others for line in nodes.poses[o] if line.heard > died)
    return Killed(name, pause(nodes, others, died), lost, links, pose)


def pause(nodes: Processes, names: list[str], since: float) -> float:
    """The longest time without a pose of one of these."""
    gaps = []
    for name in names:
        heard = [line.heard for line in nodes.poses[name]]
        last = max((t for t in heard if t <= since), default=since)
        gaps += list(np.diff([last, *(t for t in heard if t > since), time.monotonic()]))
    return float(max(gaps))


def _seconds_of(what: str) -> float:
    begun = time.monotonic()
    subprocess.run([sys.executable, "-c", what], check=True, env=as_installed())
    return time.monotonic() - begun
