"""From a frame to its agreed pose: what of it are images, what is the network. See `benchmarks/network.py --latency`."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.node_processes import RATE, SIZE, looped_recording, processes
from sylpose.capture import open_session
from sylpose.methods import MODES
from sylpose.network.simulation import track_by_nodes
from sylpose.network.wire_format import HEADER
from sylpose.simulate import render_sequence

__all__ = ["by_processes", "by_rounds", "table"]

# Frames that are counted; of a loop (choice).
FRAMES, TURN = 30, 31
# Seconds of processor time that a camera's frame takes, about: by that processes are paced (measured: small pictures).
WORK = 0.15
CORES = 2
HEAD_OF_ROUNDS = (
    "| cameras | mode | rounds per frame | kB told per frame | processor ms per camera and frame |\n" + "|---" * 5 + "|"
)
HEAD_OF_PROCESSES = (
    "| processes | mode | frames per second given | ms from frame to agreed pose: median, 95 % | rounds per frame "
    "| kB told per frame | not tracked, of |\n" + "|---" * 7 + "|"
)


def by_rounds(cameras: int, mode: str) -> str:
    """Over a simulated network, in this process: what is the machine's does not count."""
    with tempfile.TemporaryDirectory() as folder:
        render_sequence(folder, frames=FRAMES, turn_deg=90.0 * FRAMES / TURN, n_cameras=cameras, size=SIZE)
        session = open_session(Path(folder))
        frames, rig = list(session.frames()), session.rig
        track_by_nodes(frames[:4], rig, mode=mode)  # what is compiled is loaded
        begun = time.process_time()
        outcome = track_by_nodes(frames, rig, mode=mode)
        took = time.process_time() - begun
    told = outcome.told[0]
    rounds = len(told) / FRAMES
    sent = (sum(told) + HEADER.size * len(told)) / FRAMES
    return f"| {cameras} | {mode} | {rounds:.1f} | {sent / 1e3:.1f} | {1e3 * took / FRAMES / cameras:.0f} |"


def by_processes(cameras: int, mode: str) -> str:
    """As processes on this machine, given as many frames per second as its cores can work on."""
    pace = round(min(3.0, 0.5 * CORES / (WORK * cameras)), 2)
    names = [f"cam_{c}" for c in range(cameras)]
    with tempfile.TemporaryDirectory() as folder:
        recording = looped_recording(Path(folder) / "recording", cameras, TURN, 2 * (FRAMES + 10) / RATE)
        with processes(recording, Path(folder) / "out", speed=pace / RATE, mode=mode) as nodes:
            for name in names:
                nodes.start(name)
            nodes.wait_for(names, FRAMES + 10, 60 + 8 * cameras + 2 * (FRAMES + 10) / pace)
            # The first ones load what is compiled.
            poses = [line.said for name in names for line in nodes.poses[name] if line.said["frame"] >= 10]
            states = [line.said for name in names for line in nodes.states[name] if line.said["frames"] > 10]
    shown = [s for s in states if s["bytes_per_frame"] > 0]
    latency = [s["latency_ms"] for s in shown]
    lost = sum(p["status"] != "tracked" for p in poses)
    return (
        f"| {cameras} | {mode} | {pace:.2g} | {np.median(latency):.0f}, {np.quantile(latency, 0.95):.0f} "
        f"| {np.mean([s['rounds_per_frame'] for s in shown]):.1f} "
        f"| {np.mean([s['bytes_per_frame'] for s in shown]) / 1e3:.1f} | {lost}, {len(poses)} |"
    )


def table(counts: Sequence[int], processes_up_to: int = 8) -> str:
    """Both."""
    lines = [HEAD_OF_ROUNDS, *(by_rounds(n, mode) for n in counts for mode in MODES), "", HEAD_OF_PROCESSES]
    return "\n".join([*lines, *(by_processes(n, mode) for n in counts if n <= processes_up_to for mode in MODES)])
