"""Accuracy, speed and memory of `sylpose track` on two real recordings and on the demo.

    python benchmarks/main_job.py [--shared ../shared] [--method landmarks ...] [--demo-frames 60]
                                   [--smooth | --no-smooth]

Each run is `sylpose track` in a separate process, so that peak memory and import time are measured per run. Trajectories are
scored with shared/tools/score.py. Prints one Markdown table; docs/benchmarks.md contains the figures of the last run.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

RUN = """
import json, resource, sys, time
from sylpose import RunOptions, open_session, track_session
session, out, method, smooth = sys.argv[1:5]
start = time.perf_counter()
run = track_session(open_session(session), out, RunOptions(method=method, smooth=smooth == "yes"))
memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"frames": len(run.trajectory), "solved": int(run.trajectory.measured_mask.sum()),
                  "seconds": time.perf_counter() - start, "parts": run.seconds, "memory_mb": memory}))
"""


def measure(session: Path, truth: Path, score: Path, method: str, *, smooth: bool) -> dict[str, object]:
    """Track a recording in a separate process and score its trajectory."""
    with tempfile.TemporaryDirectory() as out:
        process = subprocess.run(
            [sys.executable, "-c", RUN, str(session), out, method, "yes" if smooth else "no"],
            capture_output=True,
            text=True,
            check=True,
        )
        result: dict[str, object] = json.loads(process.stdout.splitlines()[-1])
        score_process = subprocess.run(
            [sys.executable, str(score), f"{out}/trajectory.tum", str(truth), "--json"],
            capture_output=True,
            text=True,
            check=True,
        )
        result["score"] = json.loads(score_process.stdout)
    return result


def format_row(name: str, method: str, result: dict[str, object]) -> str:
    """Format one row of the table."""
    score, parts = result["score"], result["parts"]
    assert isinstance(score, dict)
    assert isinstance(parts, dict)
    deg, mm = score["since_start_deg"], score["since_start_mm"]
    frames, seconds, memory = result["frames"], result["seconds"], result["memory_mb"]
    assert isinstance(frames, int)
    assert isinstance(seconds, float)
    assert isinstance(memory, float)
    stage_times = ", ".join(f"{part} {spent:.1f}" for part, spent in parts.items())
    return (
        f"| {name} | {method} | {result['solved']} of {frames} | {deg['median']:.2f} / {deg['max']:.2f} / {deg['last']:.2f}"
        f" | {mm['median']:.2f} / {mm['max']:.2f} / {mm['last']:.2f} | "
        f"{frames / seconds:.1f} | {stage_times} | {memory:.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[2] / "shared")
    parser.add_argument("--method", nargs="+", default=["landmarks"])
    parser.add_argument("--smooth", action=argparse.BooleanOptionalAction, help="as for sylpose track; default: both")
    parser.add_argument("--demo-frames", type=int, default=60)
    options = parser.parse_args()
    score = options.shared / "tools" / "score.py"
    if not score.exists():
        sys.exit(f"{score} not found: pass the folder with the recordings and the scoring tool as --shared")

    from sylpose import simulate

    print(
        "| recording | method | frames solved | rotation error, deg: median / worst / last | "
        "position error, mm: median / worst / last | frames/s | seconds per stage | peak memory, MB |"
    )
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        demo = Path(folder) / "demo"
        simulate.write_sequence(demo, simulate.make_demo_scene(frames=options.demo_frames))
        for name, session in (
            ("temple", options.shared / "data" / "temple"),
            ("board4", options.shared / "data" / "board4"),
            (f"demo, {options.demo_frames} frames", demo),
        ):
            for method in options.method:
                for smooth in (False, True) if options.smooth is None else (options.smooth,):
                    measured = measure(session, session / "groundtruth.tum", score, method, smooth=smooth)
                    print(format_row(name, f"{method}, smoothed" if smooth else method, measured), flush=True)


if __name__ == "__main__":
    main()
