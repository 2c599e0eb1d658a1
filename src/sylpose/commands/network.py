"""`sylpose network`: keys for a network, and a demonstration by four nodes, one of which is killed and restarted."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sylpose.commands.app import CommandOptions, app, command, exit_with_failures, option
from sylpose.commands.node import require_zenoh
from sylpose.commands.options import SeedOptions
from sylpose.methods import MODES

# Share of the frames after which a node is killed; seconds until it is restarted; seconds without a frame of any node
# after which they are considered stuck, which includes their start; seconds that a node waits for the others (choice).
KILL_FRAME_RATIO, DOWN_SECONDS, STALL_TIMEOUT, NODE_PATIENCE = 0.35, 1.0, 300.0, 120.0
# Duration of the frames after the kill, in starts of a single process, as three nodes run meanwhile (choice).
STARTS_AFTER_KILL = 12.0
CAMERAS, RATE = tuple(f"cam_{c}" for c in range(4)), 30.0
KILLED = CAMERAS[1]

network_app = typer.Typer(
    help="Create keys for a network, or run a demonstration.", no_args_is_help=True, rich_markup_mode=None
)
app.add_typer(network_app, name="network")


@dataclass(frozen=True, kw_only=True)
class InitOptions(CommandOptions):
    """Options of `sylpose network init`.

    Attributes:
        folder: Folder for the keys.
        calibration: Create one key per camera of this calibration.
        host: Add a machine's name or address to the certificates. Repeatable.
    """

    folder: Annotated[Path, typer.Argument(metavar="DIR")]
    calibration: Annotated[Path, option("--calibration FILE")]
    host: Annotated[tuple[str, ...], option("--host NAME")] = ()


@command("Create a certificate authority and camera keys.", group=network_app)
def init(options: InitOptions) -> None:
    """Create a certificate authority and a key for each camera.

    Copy ca.pem, CAMERA.pem and CAMERA.key to that camera's machine. Keep ca.key here; it signs further keys.

    Examples:
        sylpose network init keys --calibration rig.toml --host cam0.lab --host cam1.lab
    """
    require_zenoh()
    from sylpose.io import calibration
    from sylpose.network.keys import make_keys
    from sylpose.runs import console_output

    if written := make_keys(options.folder, calibration.load(options.calibration).names, options.host):
        console_output.print_files(console_output.make_console(), "Files", written)
    else:
        print(f"{options.folder}: has all keys already")


@dataclass(frozen=True, kw_only=True)
class DemoOptions(SeedOptions):
    """Options of `sylpose network demo`.

    Attributes:
        out: Write the recording and the results here.
        frames: Render N frames.
        speed: Set the playback speed, less where nodes start slowly; 0: as fast as possible.
    """

    out: Annotated[Path, option("--out DIR")] = Path("sylpose_network_demo")
    frames: Annotated[int, option("--frames N", min=20)] = 60
    speed: Annotated[float, option("--speed X", min=0)] = 0.1


@command("Run four nodes on a rendered recording.", group=network_app, name="demo")
def network_demo(options: DemoOptions) -> None:
    """Run four nodes, one process each, on a rendered recording; kill and restart one midway.

    Plots all four results against the ground truth in OUT/network.png.

    Examples:
        sylpose network demo
        sylpose network demo --frames 120 --out block
    """
    require_zenoh()
    from sylpose.commands.demo import render_demo
    from sylpose.runs.console_output import make_console
    from sylpose.runs.precompile import compile_with_progress

    compile_with_progress(make_console())  # otherwise all nodes would wait for the first one
    render_demo(options.out, frames=options.frames, turn_deg=90.0, n_cameras=len(CAMERAS), seed=options.seed)
    downtime = _run_nodes(options)
    if failures := _evaluate(options, downtime):
        exit_with_failures(failures)


def build_node_command(
    camera: str,
    recording: Path,
    out: Path,
    network: str,
    speed: float,
    wait: float = STALL_TIMEOUT,
    mode: str = MODES[0],
    patience: float = NODE_PATIENCE,
) -> list[str]:
    """Return the command line of a node on a recording, as a user would type it."""
    options = ["--calibration", recording / "calibration.toml", "--source", recording / f"{camera}.mp4", "--out", out]
    options += ["--network", network, "--speed", speed, "--wait", wait, "--mode", mode, "--patience", patience]
    return [sys.executable, "-m", "sylpose", "node", camera, *map(str, options)]


def _choose_speed(options: DemoOptions) -> float:
    """Return a playback speed at which the restarted node rejoins before the recording ends."""
    import subprocess
    import time

    begin = time.monotonic()
    program = "from sylpose.relative_pose.solver import warm_up; from sylpose.network import node; warm_up()"
    subprocess.run([sys.executable, "-c", program], stdin=subprocess.DEVNULL, capture_output=True, check=False)
    needed = DOWN_SECONDS + STARTS_AFTER_KILL * (time.monotonic() - begin)
    return min(options.speed, (1.0 - KILL_FRAME_RATIO) * options.frames / (RATE * needed))


def _run_nodes(options: DemoOptions) -> tuple[float, float] | None:
    """Track the recording by one process per camera; kill and restart one.

    Returns:
        the times at which it was killed and at which it rejoined; None if it did not.
    """
    import json
    import os
    import subprocess
    import time

    from sylpose.network.zenoh_transport import LinkSettings, watch_network
    from sylpose.runs import console_output

    console, out, network = console_output.make_console(), options.out, f"demo-{os.getpid()}"
    kill_frame, seen = round(KILL_FRAME_RATIO * options.frames), dict[str, int]()

    def on_pose(name: str, line: str) -> None:
        seen[name] = int(json.loads(line)["frame"])

    def start(name: str, folder: str) -> subprocess.Popen[bytes]:
        results = out / "nodes" / folder
        results.mkdir(parents=True, exist_ok=True)
        with (results / "output.txt").open("wb") as log:
            line = build_node_command(name, out, results, network, speed)
            return subprocess.Popen(line, stdout=log, stderr=subprocess.STDOUT)

    session = watch_network(LinkSettings(), network, lambda *_: None, on_pose)
    speed = _choose_speed(options)
    pace = f"{speed:.2g} times the recording's speed" if speed else "full speed"
    console.print(f"{len(CAMERAS)} nodes, a process each, at {pace}; {KILLED} is killed at frame {kill_frame}")
    processes = {name: start(name, name) for name in CAMERAS}
    killed: tuple[int, float] | None = None  # frame and time
    restarted, rejoined = False, None
    try:
        last_news, known = time.monotonic(), dict[str, int]()
        while any(p.poll() is None for p in processes.values()) and time.monotonic() - last_news < STALL_TIMEOUT:
            time.sleep(0.02)
            if known != seen:
                last_news, known = time.monotonic(), dict(seen)
            if killed is None and seen.get(KILLED, 0) >= KILL_FRAME_RATIO * options.frames:
                processes[KILLED].kill()
                processes[KILLED].wait()
                killed = seen[KILLED], time.monotonic()
                console.print(f"frame {killed[0]}: {KILLED} is killed")
            if killed is not None and not restarted and time.monotonic() - killed[1] > DOWN_SECONDS:
                del seen[KILLED]
                processes[KILLED], restarted = start(KILLED, f"{KILLED}_again"), True
            if restarted and rejoined is None and KILLED in seen:
                rejoined = seen[KILLED]
                console.print(f"frame {rejoined}: {KILLED} has rejoined")
    finally:
        for process in processes.values():
            if process.poll() is None:
                process.kill()
                process.wait()
        session.close()
    return None if killed is None or rejoined is None else (killed[0] / RATE, rejoined / RATE)


def _evaluate(options: DemoOptions, downtime: tuple[float, float] | None) -> list[str]:
    """Print the nodes' errors as a table, plot them, and return error messages."""
    import numpy as np

    from sylpose.commands.demo import MAX_ERROR_DEG
    from sylpose.comparison import compare_trajectories
    from sylpose.report.files import read_trajectory, read_tum
    from sylpose.report.plots import NodeResult, plot_nodes
    from sylpose.runs import console_output

    console, failures, rows, answers = console_output.make_console(), [], [], []
    true_times, truth = read_tum(options.out / "groundtruth.tum")
    for folder in [*CAMERAS, f"{KILLED}_again"]:
        name, results = folder.removesuffix("_again"), options.out / "nodes" / folder
        try:
            found = read_trajectory(results / f"{name}.csv")
            errors = compare_trajectories(*read_tum(results / f"{name}.tum"), true_times, truth)
        except (OSError, ValueError):
            failures.append(f"{folder}: no result; its output is in {results / 'output.txt'}")
            continue
        solved = [pose for pose in found if pose.world_from_object is not None]
        rotation = np.degrees(errors.rotation[1:])
        worst = float(rotation.max(initial=0.0))
        rows.append([folder, f"{solved[0].index} to {solved[-1].index}", f"{len(solved)}", f"{worst:.3f}"])
        times = np.array([pose.time for pose in solved[1:]])
        answers.append(NodeResult(folder.replace("_again", " again"), found, times, rotation))
        if worst > MAX_ERROR_DEG:
            failures.append(f"{folder}: {worst:.1f} degrees off")
        if name != KILLED and len(solved) < options.frames:
            failures.append(f"{folder}: poses of {len(solved)} of {options.frames} frames")
    if downtime is None:
        failures.append(f"{KILLED}: was not killed, or did not rejoin")
    console_output.print_table(console, ["node", "frames", "poses", "worst, degrees"], rows)
    if answers:
        picture = options.out / "network.png"
        plot_nodes(answers, true_times, truth, downtime, picture)
        console_output.print_files(console, "Files", [picture])
    return failures
