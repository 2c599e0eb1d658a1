"""Nodes for a long time: does their memory grow, and is any frame lost? See `benchmarks/network.py --soak`."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.node_processes import RATE, looped_recording, processes, rss_mb
from sylpose.geometry.arrays import FloatArray
from sylpose.report.files import read_trajectory

__all__ = ["HEAD", "growth", "soak"]

# Frames per second, so that four nodes take less than one core; seconds between two samples of memory (choice); that count
# as warm-up: many times over the object has shown all its sides (choice).
SLOWLY, EVERY, WARM_UP = 2.0, 10.0, 300.0
# Samples of which the mean counts as one, so that the errors of two have less to do with each other (choice: a minute).
TOGETHER = 6
HEAD = (
    "| node | frames | poses | not tracked | missing | not with all | MB after warm-up | at the end | most "
    "| MB per hour | share of a core |\n" + "|---" * 11 + "|"
)


def soak(minutes: float, cameras: int = 4, frames: int = 31, samples: Path | None = None) -> str:
    """A table of the nodes; what was sampled also as lines of a file, if one is named: seconds, MB and seconds of processor
    time of each."""
    seconds, names = 60 * minutes, [f"cam_{c}" for c in range(cameras)]
    with tempfile.TemporaryDirectory() as folder:
        # So many seconds at this speed.
        recording = looped_recording(Path(folder) / "recording", cameras, frames, seconds * SLOWLY / RATE)
        with processes(recording, Path(folder) / "out", speed=SLOWLY / RATE) as nodes:
            for name in names:
                nodes.start(name)
            nodes.wait_for(names, 1, 120)
            begun, rows = time.monotonic(), list[list[float]]()
            pids = [nodes.running[name].pid for name in names]
            while len(nodes.alive()) == cameras:
                now = time.monotonic() - begun
                rows.append([now, *(rss_mb(pid) for pid in pids), *(processor_seconds(pid) for pid in pids)])
                if samples is not None:
                    with samples.open("a") as file:
                        file.write(",".join(f"{x:.3f}" for x in rows[-1]) + "\n")
                time.sleep(max(begun + EVERY * len(rows) - time.monotonic(), 0.0))
            for name in names:
                nodes.running[name].wait(60)
            results = {name: read_trajectory(Path(folder) / "out" / f"{name}_0" / f"{name}.csv") for name in names}
            without = {name: sum(len(line.said["took_part"]) < cameras for line in nodes.poses[name]) for name in names}
    # The last ones may be of a process that is ending.
    table = np.array(rows)[:-1]
    lines = []
    for k, name in enumerate(names):
        found, memory, warm = results[name], table[:, 1 + k], table[:, 0] > min(WARM_UP, 0.5 * seconds)
        slope, sigma = growth(table[warm, 0], memory[warm])
        solved = sum(pose.world_from_object is not None for pose in found)
        numbers = {pose.index for pose in found}
        used = np.diff(table[warm, 1 + cameras + k][[0, -1]])[0] / np.diff(table[warm, 0][[0, -1]])[0]
        cells = [
            name,
            f"{len(found):,}",
            f"{solved:,}",
            f"{sum(pose.status.value != 'tracked' for pose in found)}",
            f"{len({*range(max(numbers) + 1)} - numbers)}",
            f"{without[name]}",
            f"{memory[warm][0]:.1f}",
            f"{memory[-1]:.1f}",
            f"{memory.max():.1f}",
            f"{slope:+.2f} ± {sigma:.2f}",
            f"{used:.2f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def growth(times: FloatArray, memory: FloatArray) -> tuple[float, float]:
    """MB per hour and its standard deviation: a straight line through the means of a minute each."""
    n = len(times) // TOGETHER
    if n < 3:
        return float("nan"), float("nan")
    t = times[: n * TOGETHER].reshape(n, TOGETHER).mean(axis=1) / 3600
    y = memory[: n * TOGETHER].reshape(n, TOGETHER).mean(axis=1)
    t -= t.mean()
    slope = t @ y / (t @ t)
    left = y - y.mean() - slope * t
    return float(slope), float(np.sqrt(left @ left / (n - 2) / (t @ t)))


def processor_seconds(pid: int) -> float:
    """Of a process so far."""
    try:
        parts = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:  # it has ended
        return 0.0
    return (int(parts[11]) + int(parts[12])) / os.sysconf("SC_CLK_TCK")
