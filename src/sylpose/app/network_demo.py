"""`sylpose network demo`: four nodes on a rendered recording, one of which is killed and started again in the middle."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from sylpose.app import console_output
from sylpose.app.demo import MAX_ERROR_DEG, render_demo, score
from sylpose.geometry.arrays import FloatArray
from sylpose.methods import MODES
from sylpose.network.zenoh_transport import LOOPBACK, Links, watch_network
from sylpose.report.files import read_trajectory, read_tum
from sylpose.report.network import NodeAnswer, plot_nodes

__all__ = ["network_demo_aloud", "node_command"]

# Frames of a node, as a share of all, when it is killed; seconds for which it is dead; seconds after which a node that says
# nothing is taken for stuck (choice).
KILLED_AT, DEAD, STUCK = 0.35, 1.0, 180.0
CAMERAS, RATE = 4, 30.0


def node_command(
    camera: str, recording: Path, out: Path, network: str, speed: float, wait: float = 60.0, mode: str = MODES[0]
) -> list[str]:
    """A node on a recording, as a user would start it."""
    asked = {
        "--calibration": recording / "calibration.toml",
        "--source": recording / f"{camera}.mp4",
        "--out": out,
        "--network": network,
        "--speed": speed,
        "--wait": wait,
        "--mode": mode,
    }
    options = [str(part) for item in asked.items() for part in item]
    return [sys.executable, "-m", "sylpose", "node", camera, *options]


def network_demo_aloud(out: Path, *, frames: int, speed: float, seed: int) -> list[str]:
    """Render, start four processes, kill one and start it again, draw.

    Returns:
        sentences that say what went wrong; none when all nodes that lived had every frame to `MAX_ERROR_DEG`.
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
        with (folder / "said.txt").open("wb") as said:
            return subprocess.Popen(
                node_command(name, out, folder, network, speed), stdout=said, stderr=subprocess.STDOUT
            )

    session = watch_network(Links(LOOPBACK), network, lambda *_: None, on_pose)
    console.print(f"{CAMERAS} nodes, a process each; {killed} is killed at frame {round(KILLED_AT * frames)}")
    processes = {name: start(name, results / name) for name in names}
    again: subprocess.Popen[bytes] | None = None
    died: int | None = None
    came: int | None = None
    at = 0.0
    try:
        until = time.monotonic() + STUCK
        while any(p.poll() is None for p in processes.values()) and time.monotonic() < until:
            time.sleep(0.02)
            if died is None and seen.get(killed, 0) >= KILLED_AT * frames:
                processes[killed].kill()
                processes[killed].wait()
                died, at = seen[killed], time.monotonic()
                console.print(f"frame {died}: {killed} is killed")
            if died is not None and again is None and time.monotonic() - at > DEAD:
                del seen[killed]
                again = processes[killed] = start(killed, results / f"{killed}_again")
            if again is not None and came is None and killed in seen:
                came = seen[killed]
                console.print(f"frame {came}: {killed} takes part again")
    finally:
        for process in processes.values():
            if process.poll() is None:
                process.kill()
                process.wait()
        session.close()
    away = None if died is None or came is None else (died / RATE, came / RATE)
    return _judged(out, results, names, killed, away, frames, truth.world_from_object[0].translation)


def _judged(
    out: Path,
    results: Path,
    names: list[str],
    killed: str,
    away: tuple[float, float] | None,
    frames: int,
    center: FloatArray,
) -> list[str]:
    """What came of it, as a table and a picture."""
    console, failures, rows, answers = console_output.make_console(), [], [], []
    true_times, truth = read_tum(out / "groundtruth.tum")
    for folder in [*names, f"{killed}_again"]:
        name, said = folder.removesuffix("_again"), results / folder / "said.txt"
        try:
            found = read_trajectory(results / folder / f"{name}.csv")
            errors = score(*read_tum(results / folder / f"{name}.tum"), true_times, truth, center)
        except (OSError, ValueError):
            failures.append(f"{folder}: found nothing; what it said is in {said}")
            continue
        solved = [pose for pose in found if pose.world_from_object is not None]
        worst = float(errors.rotation.max(initial=0.0))
        rows.append([folder, f"{solved[0].index} to {solved[-1].index}", f"{len(solved)}", f"{worst:.3f}"])
        label = name if folder == name else f"{name} again"
        answers.append(NodeAnswer(label, found, np.array([pose.time for pose in solved[1:]]), errors.rotation))
        if worst > MAX_ERROR_DEG:
            failures.append(f"{folder}: {worst:.1f} degrees off")
        if name != killed and len(solved) < frames:
            failures.append(f"{folder}: poses of {len(solved)} of {frames} frames")
    if away is None:
        failures.append(f"{killed}: was not killed, or did not come back")
    console_output.print_table(console, ["node", "frames", "poses", "worst, degrees"], rows)
    if answers:
        picture = out / "network.png"
        plot_nodes(answers, true_times, truth, away, picture)
        console_output.print_files(console, "Files", [picture])
    return failures
