"""Memory growth and lost frames of nodes over a long time, for `benchmarks/network.py --soak`."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.node_processes import RATE, read_rss_mb, run_processes, write_looped_recording
from sylpose.geometry.arrays import FloatArray
from sylpose.report.files import read_trajectory

__all__ = ["TABLE_HEADER", "fit_growth", "soak"]

# Frames per second, so that four nodes take less than one core; seconds between two samples of memory (choice); seconds of
# warm-up, in which the object shows all its sides many times (choice).
FRAME_RATE, SAMPLE_INTERVAL_S, WARM_UP_S = 2.0, 10.0, 300.0
# Number of samples to average, which reduces the correlation of errors (choice: a minute).
SAMPLES_PER_MEAN = 6
TABLE_HEADER = (
    "| node | frames | poses | not tracked | missing frames | without all nodes | MB after warm-up | MB at the end "
    "| peak MB | MB per hour | share of a core |\n" + "|---" * 11 + "|"
)


def soak(minutes: float, cameras: int = 4, frames: int = 31, samples: Path | None = None) -> str:
    """Run nodes and return their table.

    Args:
        minutes: duration.
        cameras: number of nodes.
        frames: frames of a loop of the recording.
        samples: file for the samples, a line each: seconds, then MB and then processor seconds of each node.
    """
    seconds, names = 60 * minutes, [f"cam_{c}" for c in range(cameras)]
    with tempfile.TemporaryDirectory() as folder:
        # The duration at this speed.
        recording = write_looped_recording(Path(folder) / "recording", cameras, frames, seconds * FRAME_RATE / RATE)
        with run_processes(recording, Path(folder) / "out", speed=FRAME_RATE / RATE) as nodes:
            for name in names:
                nodes.start(name)
            nodes.wait_for_poses(names, 1, 120)
            start_time, rows = time.monotonic(), list[list[float]]()
            pids = [nodes.running[name].pid for name in names]
            while len(nodes.running_names()) == cameras:
                now = time.monotonic() - start_time
                rows.append([now, *(read_rss_mb(pid) for pid in pids), *(processor_seconds(pid) for pid in pids)])
                if samples is not None:
                    with samples.open("a") as file:
                        file.write(",".join(f"{x:.3f}" for x in rows[-1]) + "\n")
                time.sleep(max(start_time + SAMPLE_INTERVAL_S * len(rows) - time.monotonic(), 0.0))
            for name in names:
                nodes.running[name].wait(60)
            results = {name: read_trajectory(Path(folder) / "out" / f"{name}_0" / f"{name}.csv") for name in names}
            without = {
                name: sum(len(line.content["took_part"]) < cameras for line in nodes.poses[name]) for name in names
            }
    # The last ones may be of a process that is ending.
    table = np.array(rows)[:-1]
    lines = []
    for k, name in enumerate(names):
        found, memory, warm = results[name], table[:, 1 + k], table[:, 0] > min(WARM_UP_S, 0.5 * seconds)
        slope, sigma = fit_growth(table[warm, 0], memory[warm])
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


def fit_growth(times: FloatArray, memory: FloatArray) -> tuple[float, float]:
    """Fit a line to the means of a minute each; return MB per hour and the standard deviation."""
    n = len(times) // SAMPLES_PER_MEAN
    if n < 3:
        return float("nan"), float("nan")
    t = times[: n * SAMPLES_PER_MEAN].reshape(n, SAMPLES_PER_MEAN).mean(axis=1) / 3600
    y = memory[: n * SAMPLES_PER_MEAN].reshape(n, SAMPLES_PER_MEAN).mean(axis=1)
    t -= t.mean()
    slope = t @ y / (t @ t)
    residuals = y - y.mean() - slope * t
    return float(slope), float(np.sqrt(residuals @ residuals / (n - 2) / (t @ t)))


def processor_seconds(pid: int) -> float:
    """Return the processor time of a process so far, seconds."""
    try:
        parts = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:  # it has ended
        return 0.0
    return (int(parts[11]) + int(parts[12])) / os.sysconf("SC_CLK_TCK")
