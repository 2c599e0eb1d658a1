"""The tracking benchmark: rendered sequences with known truth and the two real recordings, with peers beside it.

    python benchmarks/tracking.py [--scenes DIR] [--only box body ...] [--frames N] [--no-peers] [--smooth]
                                  [--features sift|klt|auto] [--json FILE] [--compare BASELINE]

Each run is the main job, `sylpose track --no-overlay`, in a process of its own, so that its peak memory is its own; so is
each peer's. The rendered sequences (tracking_scenes.py) are kept in DIR and rendered once. "long", 10,000 frames to watch
the memory, only runs where --only names it. Prints a Markdown table as it goes, then what must hold; exit code 1 where
something got worse than BASELINE, a file of --json.
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

from benchmarks.tracking_report import HEADER, Row, line, load, must_hold, save, score, worse_than
from benchmarks.tracking_scenes import BUILDERS, build, make

RUN = """
import json, pathlib, resource, sys, time
from sylpose import open_session, track_session
from sylpose.relative_pose.precompile import warm_up
session, out, options = sys.argv[1:4]
warm_up()
memory, status = [], pathlib.Path("/proc/self/statm")
def watch(_):
    memory.append(int(status.read_text().split()[1]) if status.exists() else 0)
start = time.perf_counter()
run = track_session(open_session(session), out, overlay=False, on_frame=watch, **json.loads(options))
seconds = time.perf_counter() - start
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
parts = getattr(run, "seconds", {})
print(json.dumps({"frames": len(memory), "seconds": seconds, "parts": parts, "peak": peak, "memory": memory}))
"""
LIMIT_S, PEER_LIMIT_S = 3600.0, 900.0
# The peers run on these, COLMAP's mapping on every fifth frame only.
PEER_SCENES = ("box", "body")
PEER_EVERY = {"poselib": 1, "pycolmap": 5}
RECORDINGS = ("board4", "board4, no boxes", "temple")
ON_REQUEST = ("long",)
# The memory is flat when the last tenth of the frames has no more than the frame at this share of them.
SETTLED = 0.2


def call(arguments: Sequence[object], limit_s: float) -> tuple[dict[str, Any], str]:
    """A process that prints JSON in its last line: what it printed, or why it failed."""
    try:
        done = subprocess.run(
            [sys.executable, *map(str, arguments)], capture_output=True, text=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        return {}, f"ended after {limit_s:.0f} s"
    if done.returncode:
        said = done.stderr.strip().splitlines()
        return {}, said[-1] if said else f"exit code {done.returncode}"
    return json.loads(done.stdout.strip().splitlines()[-1]), ""


def track(data: str, session: Path, options: dict[str, object]) -> Iterator[Row]:
    """Ours, on a recording: a row for each of its objects."""
    by = " ".join(["sylpose", *(str(k if v is True else v) for k, v in options.items() if v is not False)])
    truths = sorted(session.glob("groundtruth*.tum"))
    center = None
    if len(truths) == 1:
        center = np.array(tomllib.loads((session / "dataset.toml").read_text())["center_world"])
    with tempfile.TemporaryDirectory() as out:
        said, failed = call(["-c", RUN, session, out, json.dumps(options)], LIMIT_S)
        row = Row(data, by, failed=failed)
        if said:
            memory, n = said["memory"], said["frames"]
            tracking = said["parts"].get("tracking")
            row = replace(
                row,
                fps=n / said["seconds"],
                tracking_fps=n / tracking if tracking else None,
                memory_mb=said["peak"],
                growth=max(memory[-max(n // 10, 1) :]) / max(memory[int(SETTLED * n)], 1),
            )
        for truth in truths:
            name = truth.stem.removeprefix("groundtruth").removeprefix("_")
            # An object's files are named after it, or in a folder of its name.
            found = [tum for tum in sorted(Path(out).rglob("trajectory.tum")) if name in str(tum.relative_to(out))]
            mine = replace(row, data=f"{data}: {name}" if name else data)
            if found and not failed:
                mine = score(mine, found[0], truth, center)
            elif not failed:
                mine = replace(mine, failed="no trajectory was written")
            yield mine


def peer(name: str, data: str, session: Path) -> Row:
    """A peer, on a rendered recording."""
    every = PEER_EVERY[name]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "peer.tum"
        script = Path(__file__).with_name("tracking_peers.py")
        said, failed = call([script, name, session, out, "--every", every], PEER_LIMIT_S)
        row = Row(data, name, failed=failed)
        if said:
            row = replace(row, total=said["frames"], fps=said["frames"] / said["seconds"], memory_mb=said["peak"])
        if out.exists():
            return score(row, out, session / "groundtruth.tum", every=every)
        return row if failed else replace(row, failed="no poses")


def recording(name: str, shared: Path, folder: Path) -> Path:
    """The folder of a real recording, without its boxes where these are not to be used."""
    base, _, without = name.partition(", ")
    source = (shared / "data" / base).resolve()
    if not without:
        return source
    folder.mkdir(parents=True, exist_ok=True)
    for entry in source.iterdir():
        link = folder / entry.name
        if entry.name != "boxes.toml" and not link.exists():
            os.symlink(entry, link)
    return folder


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, help="where rendered sequences are kept; a temporary folder if not said")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=[*BUILDERS, *RECORDINGS], help="these only")
    parser.add_argument("--frames", type=int, help="of the rendered sequences; 300 by default, 10,000 of long")
    parser.add_argument("--peers", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--smooth", action="store_true", help="as of sylpose track")
    parser.add_argument("--features", choices=["sift", "klt", "auto"], help="as of sylpose track")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    parser.add_argument("--compare", type=Path, metavar="BASELINE", help="a file of --json")
    parser.add_argument("--shared", type=Path, default=Path(__file__).resolve().parents[2] / "shared")
    asked = parser.parse_args()
    names = asked.only or [name for name in (*BUILDERS, *RECORDINGS) if name not in ON_REQUEST]
    options: dict[str, object] = {}
    if asked.features:
        options["features"] = asked.features
    options["smooth"] = asked.smooth
    try:
        old = load(asked.compare) if asked.compare else []
        for name in names:
            if name in BUILDERS:
                build(name, asked.frames)
    except ValueError as error:
        parser.error(str(error))

    rows: list[Row] = []

    def show(row: Row) -> None:
        rows.append(row)
        print(line(row), flush=True)
        if asked.json:
            save(rows, asked.json)

    print(HEADER)
    with tempfile.TemporaryDirectory() as temporary:
        for name in names:
            if name in RECORDINGS:
                session = recording(name, asked.shared, Path(temporary) / name)
                if not session.is_dir() or not any(session.iterdir()):
                    print(f"{session} is not there: {name} is left out", file=sys.stderr)
                    continue
            else:
                session = make(name, asked.scenes or Path(temporary), asked.frames)
            for row in track(name, session, options):
                show(row)
            if asked.peers and name in PEER_SCENES:
                for other in PEER_EVERY:
                    show(peer(other, name, session))
    print()
    print(must_hold(rows))
    worse = list(worse_than(rows, old))
    if worse:
        print("\nWorse than the baseline:\n" + "\n".join(f"- {text}" for text in worse))
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
