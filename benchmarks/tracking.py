"""Tracking benchmark: rendered sequences with known truth and two real recordings, compared with peers.

    python benchmarks/tracking.py [--scenes DIR] [--only box body ...] [--frames N] [--no-peers] [--smooth]
                                  [--features sift|klt|auto] [--json FILE] [--compare BASELINE]

Each run is `sylpose track --no-overlay` in a separate process, so that peak memory is measured per run; each peer also has
a separate process. The sequences (tracking_scenes.py) are rendered once and kept in DIR. "long", 10,000 frames for memory
growth, only runs if --only names it. Prints a Markdown table row by row, then the requirements. The exit code is 1 if
a figure is worse than in BASELINE, a file written by --json.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tracking_report import (
    HEADER,
    Row,
    find_regressions,
    format_requirements,
    format_row,
    load,
    save,
    score_trajectory,
)
from benchmarks.tracking_scenes import BUILDERS, build_recording, render_recording

RUN = """
import json, pathlib, resource, sys, time
from sylpose import RunOptions, open_session, track_session
from sylpose.relative_pose.solver import warm_up
session, out, options = sys.argv[1:4]
warm_up()
memory, status = [], pathlib.Path("/proc/self/statm")
def watch(*_):
    memory.append(int(status.read_text().split()[1]) if status.exists() else 0)
start = time.perf_counter()
run = track_session(open_session(session), out, RunOptions(overlay=False, **json.loads(options)), on_frame=watch)
seconds = time.perf_counter() - start
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
parts = getattr(run, "seconds", {})
print(json.dumps({"frames": len(memory), "seconds": seconds, "parts": parts, "peak": peak, "memory": memory}))
"""
LIMIT_S, PEER_LIMIT_S = 3600.0, 900.0
# Scenes of the peers. COLMAP's mapping only uses every fifth frame.
PEER_SCENES = ("box", "body")
PEER_EVERY = {"poselib": 1, "pycolmap": 5}
RECORDINGS = ("board4", "board4, no boxes", "temple")
OPTIONAL_SCENES = ("long",)
# Memory growth compares the last tenth of the frames with the frame at this share of the sequence.
WARM_UP_SHARE = 0.2


def run_json_process(arguments: Sequence[object], limit_s: float) -> tuple[dict[str, Any], str]:
    """Run a Python process that prints JSON in its last line; return the JSON, or the reason of the failure."""
    try:
        process = subprocess.run(
            [sys.executable, *map(str, arguments)], capture_output=True, text=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        return {}, f"stopped after {limit_s:.0f} s"
    if process.returncode:
        error_lines = process.stderr.strip().splitlines()
        return {}, error_lines[-1] if error_lines else f"exit code {process.returncode}"
    return json.loads(process.stdout.strip().splitlines()[-1]), ""


def run_sylpose(data: str, session: Path, options: dict[str, object]) -> Iterator[Row]:
    """Track a recording with sylpose; yield a row for each object."""
    label = " ".join(["sylpose", *(str(k if v is True else v) for k, v in options.items() if v is not False)])
    truths = sorted(session.glob("groundtruth*.tum"))
    center = None
    if len(truths) == 1:
        center = np.array(tomllib.loads((session / "dataset.toml").read_text())["center_world"])
    with tempfile.TemporaryDirectory() as out:
        result, failed = run_json_process(["-c", RUN, session, out, json.dumps(options)], LIMIT_S)
        row = Row(data, label, failed=failed)
        if result:
            memory, n = result["memory"], result["frames"]
            tracking = result["parts"].get("tracking")
            row = replace(
                row,
                fps=n / result["seconds"],
                tracking_fps=n / tracking if tracking else None,
                memory_mb=result["peak"],
                growth=max(memory[-max(n // 10, 1) :]) / max(memory[int(WARM_UP_SHARE * n)], 1),
            )
        for truth in truths:
            name = truth.stem.removeprefix("groundtruth").removeprefix("_")
            # An object's name is in the file name or in the folder name.
            found = [tum for tum in sorted(Path(out).rglob("trajectory.tum")) if name in str(tum.relative_to(out))]
            object_row = replace(row, data=f"{data}: {name}" if name else data)
            if found and not failed:
                object_row = score_trajectory(object_row, found[0], truth, center)
            elif not failed:
                object_row = replace(object_row, failed="no trajectory was written")
            yield object_row


def run_peer(name: str, data: str, session: Path) -> Row:
    """Run a peer on a rendered recording."""
    every = PEER_EVERY[name]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "peer.tum"
        script = Path(__file__).with_name("tracking_peers.py")
        result, failed = run_json_process([script, name, session, out, "--every", every], PEER_LIMIT_S)
        row = Row(data, name, failed=failed)
        if result:
            row = replace(
                row, total=result["frames"], fps=result["frames"] / result["seconds"], memory_mb=result["peak"]
            )
        if out.exists():
            return score_trajectory(row, out, session / "groundtruth.tum", every=every)
        return row if failed else replace(row, failed="no poses")


def prepare_recording(name: str, shared: Path, folder: Path) -> Path:
    """Return the folder of a real recording; a variant without boxes is a folder of links without boxes.toml."""
    base, _, variant = name.partition(", ")
    source = (shared / "data" / base).resolve()
    if not variant:
        return source
    folder.mkdir(parents=True, exist_ok=True)
    for entry in source.iterdir():
        link = folder / entry.name
        if entry.name != "boxes.toml" and not link.exists():
            os.symlink(entry, link)
    return folder


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, help="folder of the rendered sequences; default: a temporary one")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=[*BUILDERS, *RECORDINGS], help="run only these")
    parser.add_argument("--frames", type=int, help="length of rendered sequences; default: 300, of long 10,000")
    parser.add_argument("--peers", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--smooth", action="store_true", help="as for sylpose track")
    parser.add_argument("--features", choices=["sift", "klt", "auto"], help="as for sylpose track")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to this file")
    parser.add_argument("--compare", type=Path, metavar="BASELINE", help="compare with this file of --json")
    parser.add_argument("--shared", type=Path, default=Path(__file__).resolve().parents[2] / "shared")
    arguments = parser.parse_args()
    names = arguments.only or [name for name in (*BUILDERS, *RECORDINGS) if name not in OPTIONAL_SCENES]
    options: dict[str, object] = {}
    if arguments.features:
        options["features"] = arguments.features
    options["smooth"] = arguments.smooth
    try:
        baseline_rows = load(arguments.compare) if arguments.compare else []
        for name in names:
            if name in BUILDERS:
                build_recording(name, arguments.frames)
    except ValueError as error:
        parser.error(str(error))

    rows: list[Row] = []

    def add_row(row: Row) -> None:
        rows.append(row)
        print(format_row(row), flush=True)
        if arguments.json:
            save(rows, arguments.json)

    print(HEADER)
    with tempfile.TemporaryDirectory() as temporary:
        for name in names:
            if name in RECORDINGS:
                session = prepare_recording(name, arguments.shared, Path(temporary) / name)
                if not session.is_dir() or not any(session.iterdir()):
                    print(f"{session} not found: skipping {name}", file=sys.stderr)
                    continue
            else:
                session = render_recording(name, arguments.scenes or Path(temporary), arguments.frames)
            for row in run_sylpose(name, session, options):
                add_row(row)
            if arguments.peers and name in PEER_SCENES:
                for peer_name in PEER_EVERY:
                    add_row(run_peer(peer_name, name, session))
    print()
    print(format_requirements(rows))
    worse = list(find_regressions(rows, baseline_rows))
    if worse:
        print("\nWorse than the baseline:\n" + "\n".join(f"- {text}" for text in worse))
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
