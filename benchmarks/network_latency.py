"""Latency from a frame to its agreed pose, for `benchmarks/network.py --latency`."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.node_processes import RATE, SIZE, run_processes, write_looped_recording
from sylpose.io.capture import open_session
from sylpose.methods import MODES
from sylpose.network.simulation import track_by_nodes
from sylpose.network.wire_format import HEADER
from sylpose.simulate import make_demo_scene, write_sequence

__all__ = ["format_tables", "measure_processes", "measure_simulated"]

# Counted frames; frames of a loop (choice).
FRAMES, LOOP_FRAMES = 30, 31
# Processor time of a camera's frame, seconds, which sets the rate of the processes (measured: small images).
FRAME_CPU_S = 0.15
N_CORES = 2
ROUNDS_HEADER = (
    "| cameras | mode | rounds per frame | kB sent per frame | processor ms per camera and frame |\n" + "|---" * 5 + "|"
)
PROCESSES_HEADER = (
    "| processes | mode | input frames/s | ms from frame to agreed pose: median, 95 % | rounds per frame "
    "| kB sent per frame | poses not tracked, total |\n" + "|---" * 7 + "|"
)


def measure_simulated(cameras: int, mode: str) -> str:
    """Run over a simulated network in this process and format the table row."""
    with tempfile.TemporaryDirectory() as folder:
        turn = 90.0 * FRAMES / LOOP_FRAMES
        write_sequence(folder, make_demo_scene(frames=FRAMES, angle_deg=turn, n_cameras=cameras, size=SIZE))
        session = open_session(Path(folder))
        frames, rig = list(session.frames()), session.rig
        track_by_nodes(frames[:4], rig, mode=mode)  # loads compiled code
        start_time = time.process_time()
        outcome = track_by_nodes(frames, rig, mode=mode)
        processor_time = time.process_time() - start_time
    message_sizes = outcome.payload_sizes[0]
    rounds = len(message_sizes) / FRAMES
    sent = (sum(message_sizes) + HEADER.size * len(message_sizes)) / FRAMES
    return f"| {cameras} | {mode} | {rounds:.1f} | {sent / 1e3:.1f} | {1e3 * processor_time / FRAMES / cameras:.0f} |"


def measure_processes(cameras: int, mode: str) -> str:
    """Run as processes on this machine, at a rate that its cores can process, and format the table row."""
    frame_rate = round(min(3.0, 0.5 * N_CORES / (FRAME_CPU_S * cameras)), 2)
    names = [f"cam_{c}" for c in range(cameras)]
    with tempfile.TemporaryDirectory() as folder:
        recording = write_looped_recording(Path(folder) / "recording", cameras, LOOP_FRAMES, 2 * (FRAMES + 10) / RATE)
        with run_processes(recording, Path(folder) / "out", speed=frame_rate / RATE, mode=mode) as nodes:
            for name in names:
                nodes.start(name)
            nodes.wait_for_poses(names, FRAMES + 10, 60 + 8 * cameras + 2 * (FRAMES + 10) / frame_rate)
            # The first frames load compiled code.
            poses = [line.content for name in names for line in nodes.poses[name] if line.content["frame"] >= 10]
            states = [line.content for name in names for line in nodes.states[name] if line.content["frames"] > 10]
    active_states = [s for s in states if s["bytes_per_frame"] > 0]
    latency = [s["latency_ms"] for s in active_states]
    n_lost = sum(p["status"] != "tracked" for p in poses)
    return (
        f"| {cameras} | {mode} | {frame_rate:.2g} | {np.median(latency):.0f}, {np.quantile(latency, 0.95):.0f} "
        f"| {np.mean([s['rounds_per_frame'] for s in active_states]):.1f} "
        f"| {np.mean([s['bytes_per_frame'] for s in active_states]) / 1e3:.1f} | {n_lost}, {len(poses)} |"
    )


def format_tables(counts: Sequence[int], processes_up_to: int = 8) -> str:
    """Return the tables of the simulated network and of the processes."""
    lines = [ROUNDS_HEADER, *(measure_simulated(n, mode) for n in counts for mode in MODES), "", PROCESSES_HEADER]
    return "\n".join([*lines, *(measure_processes(n, mode) for n in counts if n <= processes_up_to for mode in MODES)])
