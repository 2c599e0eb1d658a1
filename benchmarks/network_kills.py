"""Nodes that are killed at random moments and restarted, for `benchmarks/network.py --kills`."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.node_processes import RATE, NodeProcesses, make_environment, run_processes, write_looped_recording

__all__ = ["kills"]

# Frames per second, so that two cores suffice; largest time between two kills, largest downtime, and timeout of a node's
# return, seconds (choice).
FRAME_RATE, MAX_INTERVAL_S, MAX_DOWNTIME_S, RETURN_TIMEOUT_S = 3.0, 2.0, 1.0, 60.0


class KillResult(NamedTuple):
    """Failure and restart of one node.

    Attributes:
        name: name of the node.
        max_pause: longest time without a pose of the other nodes, seconds.
        n_lost: number of their poses that are not tracked.
        seconds_to_listen: time from the restart until the node listens, seconds.
        seconds_to_pose: time from the restart to its first pose, seconds; None if there was none.
    """

    name: str
    max_pause: float
    n_lost: int
    seconds_to_listen: float
    seconds_to_pose: float | None


def kills(n: int, cameras: int = 4, seed: int = 0) -> str:
    """Kill nodes `n` times; return a table of medians and worst values."""
    rng, names = np.random.default_rng(seed), [f"cam_{c}" for c in range(cameras)]
    with tempfile.TemporaryDirectory() as folder:
        seconds = (60 + 15 * n) * FRAME_RATE / RATE
        recording = write_looped_recording(Path(folder) / "recording", cameras, 31, seconds)
        with run_processes(recording, Path(folder) / "out", speed=FRAME_RATE / RATE) as nodes:
            for name in names:
                nodes.start(name)
            nodes.wait_for_poses(names, 10, 120)
            usual_pause = compute_max_pause(nodes, names, time.monotonic() - 3.0)
            kill_results = []
            for _ in range(n):
                time.sleep(rng.uniform(0.0, MAX_INTERVAL_S))
                kill_results.append(
                    _kill_and_restart(nodes, names, names[rng.integers(cameras)], rng.uniform(0.0, MAX_DOWNTIME_S))
                )
                print(kill_results[-1], file=sys.stderr, flush=True)
        import_times = [_time_python("import sylpose.network.node, sylpose.network.zenoh_transport") for _ in range(3)]
        start_times = [_time_python("pass") for _ in range(3)]
    pose_times = [k.seconds_to_pose for k in kill_results if k.seconds_to_pose is not None]
    pauses, listen_times = [k.max_pause for k in kill_results], [k.seconds_to_listen for k in kill_results]
    rows = [
        ("kills; nodes that rejoined", f"{n}; {len(pose_times)}"),
        ("poses of the other nodes that are not tracked", f"{sum(k.n_lost for k in kill_results)}"),
        ("longest pause of the other nodes without a kill", f"{usual_pause:.2f} s"),
        (
            "longest pause of the other nodes after a kill: median, worst",
            f"{np.median(pauses):.2f}, {max(pauses):.2f} s",
        ),
        ("from restart to first pose: median, worst", f"{np.median(pose_times):.2f}, {max(pose_times):.2f} s"),
        ("from restart to listening: median, worst", f"{np.median(listen_times):.2f}, {max(listen_times):.2f} s"),
        ("start of Python; imports: median of three", f"{np.median(start_times):.2f}; {np.median(import_times):.2f} s"),
    ]
    return "\n".join(f"| {label} | {value} |" for label, value in rows)


def _kill_and_restart(nodes: NodeProcesses, names: list[str], name: str, downtime: float) -> KillResult:
    others = [other for other in names if other != name]
    kill_time = time.monotonic()
    nodes.kill(name)
    time.sleep(downtime)
    restart_time, n_poses_before = time.monotonic(), len(nodes.poses[name])
    nodes.start(name)
    log_file, seconds_to_listen, seconds_to_pose = nodes.out / f"{name}_{nodes.starts[name]}" / "log.txt", np.nan, None
    while time.monotonic() - restart_time < RETURN_TIMEOUT_S and seconds_to_pose is None:
        time.sleep(0.005)
        if np.isnan(seconds_to_listen) and log_file.exists() and "listens at" in log_file.read_text():
            seconds_to_listen = time.monotonic() - restart_time
        if len(nodes.poses[name]) > n_poses_before:
            seconds_to_pose = nodes.poses[name][n_poses_before].arrival - restart_time
    # After that the others have either continued or stopped with it.
    time.sleep(1.0)
    n_lost = sum(
        line.content["status"] != "tracked" for o in others for line in nodes.poses[o] if line.arrival > kill_time
    )
    return KillResult(name, compute_max_pause(nodes, others, kill_time), n_lost, seconds_to_listen, seconds_to_pose)


def compute_max_pause(nodes: NodeProcesses, names: list[str], since: float) -> float:
    """Return the longest time without a pose of one of these nodes."""
    gaps = []
    for name in names:
        arrival_times = [line.arrival for line in nodes.poses[name]]
        last = max((t for t in arrival_times if t <= since), default=since)
        gaps += list(np.diff([last, *(t for t in arrival_times if t > since), time.monotonic()]))
    return float(max(gaps))


def _time_python(code: str) -> float:
    start_time = time.monotonic()
    subprocess.run([sys.executable, "-c", code], check=True, env=make_environment())
    return time.monotonic() - start_time
