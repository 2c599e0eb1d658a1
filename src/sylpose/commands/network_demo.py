"""`sylpose network demo`: four nodes on a synthetic recording, one of which is killed and restarted."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from sylpose.commands.demo import MAX_ERROR_DEG, compute_errors, render_demo
from sylpose.geometry.arrays import FloatArray
from sylpose.methods import MODES
from sylpose.network.zenoh_transport import LOOPBACK, LinkSettings, watch_network
from sylpose.report.files import read_trajectory, read_tum
from sylpose.report.network import NodeResult, plot_nodes
from sylpose.runs import console_output

__all__ = ["build_node_command", "run_network_demo"]

# Share of the frames after which a node is killed; seconds until it is restarted; seconds after which the nodes are
# considered stuck (choice).
KILL_FRAME_RATIO, DOWN_SECONDS, STALL_TIMEOUT = 0.35, 1.0, 180.0
CAMERAS, RATE = 4, 30.0


def build_node_command(
    camera: str, recording: Path, out: Path, network: str, speed: float, wait: float = 60.0, mode: str = MODES[0]
) -> list[str]:
    """Return the command line of a node on a recording, as a user would type it."""
    values = {
        "--calibration": recording / "calibration.toml",
        "--source": recording / f"{camera}.mp4",
        "--out": out,
        "--network": network,
        "--speed": speed,
        "--wait": wait,
        "--mode": mode,
    }
    options = [str(part) for item in values.items() for part in item]
    return [sys.executable, "-m", "sylpose", "node", camera, *options]


def run_network_demo(out: Path, *, frames: int, speed: float, seed: int) -> list[str]:
    """Render a recording, track it by four processes, kill and restart one of them, and plot the results.

    Args:
        out: output folder.
        frames: number of frames.
        speed: playback speed as a multiple of the frame rate.
        seed: seed of the rendering.

    Returns:
        error messages; empty if all surviving nodes solved every frame to within `MAX_ERROR_DEG`.
    """
    console = console_output.make_console()
    truth = render_demo(out, frames=frames, turn_deg=90.0, n_cameras=CAMERAS, seed=seed)
    names = [f"cam_{c}" for c in range(CAMERAS)]
    killed, network = names[1], f"demo-{os.getpid()}"
    results = out / "nodes"
    seen: dict[str, int] = {}

    def on_pose(name: str, line: str) -> None:
        seen[name] = int(json.loads(line)["frame"])

    def start(name: str, folder: Path) -> subprocess.Popen[bytes]:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "output.txt").open("wb") as log:
            return subprocess.Popen(
                build_node_command(name, out, folder, network, speed), stdout=log, stderr=subprocess.STDOUT
            )

    session = watch_network(LinkSettings(LOOPBACK), network, lambda *_: None, on_pose)
    console.print(f"{CAMERAS} nodes, a process each; {killed} is killed at frame {round(KILL_FRAME_RATIO * frames)}")
    processes = {name: start(name, results / name) for name in names}
    restarted: subprocess.Popen[bytes] | None = None
    killed_frame: int | None = None
    rejoined_frame: int | None = None
    killed_time = 0.0
    try:
        deadline = time.monotonic() + STALL_TIMEOUT
        while any(p.poll() is None for p in processes.values()) and time.monotonic() < deadline:
            time.sleep(0.02)
            if killed_frame is None and seen.get(killed, 0) >= KILL_FRAME_RATIO * frames:
                processes[killed].kill()
                processes[killed].wait()
                killed_frame, killed_time = seen[killed], time.monotonic()
                console.print(f"frame {killed_frame}: {killed} is killed")
            if killed_frame is not None and restarted is None and time.monotonic() - killed_time > DOWN_SECONDS:
                del seen[killed]
                restarted = processes[killed] = start(killed, results / f"{killed}_again")
            if restarted is not None and rejoined_frame is None and killed in seen:
                rejoined_frame = seen[killed]
                console.print(f"frame {rejoined_frame}: {killed} has rejoined")
    finally:
        for process in processes.values():
            if process.poll() is None:
                process.kill()
                process.wait()
        session.close()
    downtime = None if killed_frame is None or rejoined_frame is None else (killed_frame / RATE, rejoined_frame / RATE)
    return _evaluate(out, results, names, killed, downtime, frames, truth.world_from_object[0].translation)


def _evaluate(
    out: Path,
    results: Path,
    names: list[str],
    killed: str,
    downtime: tuple[float, float] | None,
    frames: int,
    center: FloatArray,
) -> list[str]:
    """Print the nodes' errors as a table, plot them, and return error messages."""
    console, failures, rows, answers = console_output.make_console(), [], [], []
    true_times, truth = read_tum(out / "groundtruth.tum")
    for folder in [*names, f"{killed}_again"]:
        name, log = folder.removesuffix("_again"), results / folder / "output.txt"
        try:
            found = read_trajectory(results / folder / f"{name}.csv")
            errors = compute_errors(*read_tum(results / folder / f"{name}.tum"), true_times, truth, center)
        except (OSError, ValueError):
            failures.append(f"{folder}: no result; its output is in {log}")
            continue
        solved = [pose for pose in found if pose.world_from_object is not None]
        worst = float(errors.rotation.max(initial=0.0))
        rows.append([folder, f"{solved[0].index} to {solved[-1].index}", f"{len(solved)}", f"{worst:.3f}"])
        label = name if folder == name else f"{name} again"
        answers.append(NodeResult(label, found, np.array([pose.time for pose in solved[1:]]), errors.rotation))
        if worst > MAX_ERROR_DEG:
            failures.append(f"{folder}: {worst:.1f} degrees off")
        if name != killed and len(solved) < frames:
            failures.append(f"{folder}: poses of {len(solved)} of {frames} frames")
    if downtime is None:
        failures.append(f"{killed}: was not killed, or did not rejoin")
    console_output.print_table(console, ["node", "frames", "poses", "worst, degrees"], rows)
    if answers:
        picture = out / "network.png"
        plot_nodes(answers, true_times, truth, downtime, picture)
        console_output.print_files(console, "Files", [picture])
    return failures
