"""The motion between two frames, and the pose of a known object, against PoseLib and COLMAP on seeded scenes.

    python benchmarks/two_frames.py [--quick] [--rows "turn*"] [--scenes 100] [--peers poselib pycolmap | --no-peers]
        [--out results.json | --show results.json] [--compare benchmarks/two_frames_baseline.json] [--table markdown]

Errors are those of the rotation (degrees) and of the displacement of the object's centre (mm): median / 90th / 99th
percentile; no pose counts as 180 degrees and 1000 mm. Times are medians per call on one thread, of the processor, with the
input in the form that the library wants; the solvers take turns, scene by scene. Every solver works in a process of its own
with a time limit. A peer is tried with many option sets (PoseLib: 32 combinations of iterations, threshold and loss,
set by the true noise), and in each figure of its errors the best set counts: a choice in the peer's favor that no user can
make. Its time in a row is that of the fastest set that is as accurate as sylpose there, or else as its own best
(`fastest_as_good`). COLMAP takes a
second per motion, so it has only a few scenes of a row, too few to judge by where PoseLib copes with the row;
--colmap-scenes 25 gives it its full say, in an hour. A verdict is marked as chance where resampling the scenes might undo it
(paired bootstrap, 1 %).

The bound is Cramer and Rao's, from the true geometry and inliers: with depths unknown, then with depths known; errors drawn
from it are summarised as the solvers' are.

With --compare the exit code is 1 where something got worse than in the baseline: an error by more than 10 % on the same
scenes, a time by more than 40 % (in units of a loop that is timed beside it, since machines differ), or more failures.
"""

from __future__ import annotations

import argparse
import fnmatch
import importlib.metadata
import importlib.util
import sys
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

import sylpose
from benchmarks.two_frames_bound import bounds, sampled_errors
from benchmarks.two_frames_report import (
    FAILED_DEG,
    FAILED_MM,
    Results,
    RowResult,
    Tried,
    failures,
    figures_of,
    least_ratios,
    load,
    misses,
    save,
    setting_table,
    speed_table,
    table,
    too_slow,
    worse_than,
)
from benchmarks.two_frames_scenes import ROWS, Row, Scene, make_scene
from benchmarks.two_frames_solvers import LOADERS, Worker, options_of

PEERS = ("poselib", "pycolmap")
# Seconds per call. PoseLib takes 10 to 100 ms or for ever, COLMAP 1 to 6 s.
LIMIT_S = {"sylpose": 20.0, "poselib": 3.0, "pycolmap": 60.0}
# COLMAP's absolute pose takes up to 0.2 s, its relative pose a second or more (--colmap-scenes).
COLMAP_POSE_SCENES, COLMAP_MOTION_SCENES = 25, 3
# After so many hangs in a row, the rest of the row's scenes are counted as hangs without waiting for each.
HANGS = 2


class Turns:
    """One solver with one set of options, scene after scene: its answers."""

    def __init__(self, worker: Worker, label: str, options: dict[str, object]) -> None:
        self.deg: list[float] = []
        self.mm: list[float] = []
        self._worker, self._label, self._options = worker, label, options
        self._seconds: list[float] = []
        self._why, self._hung = Counter[str](), 0

    def take(self, scene: Scene) -> None:
        """Solves a scene."""
        deg, mm = FAILED_DEG, FAILED_MM
        if self._hung == HANGS:
            self._why["hang"] += 1
        else:
            answer = self._worker.solve(scene, self._options)
            self._hung = self._hung + 1 if answer.why == "hang" else 0
            self._seconds.append(answer.seconds)
            if answer.pose is None:
                self._why[answer.why] += 1
            else:
                deg, shift = scene.error(answer.pose)
                mm = min(shift, FAILED_MM)  # no answer is not better than a wrong one
        self.deg.append(deg)
        self.mm.append(mm)

    def tried(self) -> Tried:
        """All of them."""
        ms = 1e3 * float(np.median(self._seconds))
        figures = figures_of(self.deg, self.mm)
        return Tried(self._label, len(self.deg), figures, float(f"{ms:.4g}"), dict(self._why))


def run_row(row: Row, n: int, colmap_scenes: int, workers: dict[str, Worker]) -> RowResult:
    """One row, by all solvers: they take turns, so that whatever else the machine does slows down all of them."""
    scenes = [make_scene(row, index) for index in range(n)]
    covariances = [bounds(scene) for scene in scenes]
    unknown, known = (figures_of(*sampled_errors(of_scenes)) for of_scenes in zip(*covariances, strict=True))
    ours, loops = Turns(workers["sylpose"], "", {}), []
    peers = {
        solver: [Turns(workers[solver], *option) for option in options_of(solver, row.problem, row.noise).items()]
        for solver in PEERS
        if solver in workers
    }
    few = COLMAP_POSE_SCENES if row.problem == "pose" else colmap_scenes
    for index, scene in enumerate(scenes):
        loops.append(time_loop())
        ours.take(scene)
        for solver, turns in peers.items():
            for one in turns if solver != "pycolmap" or index < few else ():
                one.take(scene)
    errors = (ours.deg, ours.mm)
    tried = {
        solver: [replace(one.tried(), ours_over_it=least_ratios(errors, (one.deg, one.mm))) for one in turns]
        for solver, turns in peers.items()
    }
    loop_ms = float(f"{np.median(loops):.4g}")
    rounded = ([float(f"{value:.4g}") for value in values] for values in errors)
    return RowResult(row.name, ours.tried(), tried, unknown, known, loop_ms, *rounded)


def time_loop() -> float:
    """Milliseconds of a fixed piece of work of the kind that solvers do: the unit for times on different machines."""
    matrix = np.eye(6) + 0.1
    start = time.process_time()
    for _ in range(300):
        np.linalg.solve(matrix, matrix[0])
    sum(i * i for i in range(20000))
    return 1e3 * (time.process_time() - start)


def run(rows: list[Row], n: int, colmap_scenes: int, peers: list[str], console: Console) -> Results:
    """The whole benchmark."""
    warm_up = {
        problem: make_scene(next(r for r in ROWS if r.problem == problem), 10**6) for problem in ("motion", "pose")
    }
    with ExitStack() as stack:
        workers = {
            solver: stack.enter_context(Worker(LOADERS[solver], LIMIT_S[solver], warm_up["motion"]))
            for solver in ("sylpose", *peers)
        }
        workers["sylpose"].start()  # compiles, where nothing is cached
        import_s, first_call_s = workers["sylpose"].start()
        for problem in {row.problem for row in rows}:
            workers["sylpose"].solve(warm_up[problem], {})
        results = []
        for k, row in enumerate(rows):
            start = time.perf_counter()
            results.append(run_row(row, n, colmap_scenes, workers))
            console.print(f"{k + 1}/{len(rows)} {row.name}: {time.perf_counter() - start:.1f} s", highlight=False)
    versions = {"sylpose": sylpose.__version__, **{peer: importlib.metadata.version(peer) for peer in peers}}
    return Results(versions, round(import_s, 3), round(first_call_s, 3), results)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", default="*", help="names of rows, with * and ?")
    parser.add_argument("--scenes", type=int, default=None, help="per row (default 100; --quick: 20)")
    parser.add_argument("--quick", action="store_true", help="20 scenes per row, without COLMAP")
    parser.add_argument("--peers", nargs="+", choices=PEERS, default=None, help="those to compare with (default: both)")
    parser.add_argument("--colmap-scenes", type=int, default=COLMAP_MOTION_SCENES, help="of each row of motions")
    parser.add_argument("--no-peers", action="store_true", help="ours alone")
    parser.add_argument("--out", type=Path, help="write the results (JSON)")
    parser.add_argument(
        "--show", type=Path, metavar="JSON", help="print the tables of stored results (--out), run nothing"
    )
    parser.add_argument("--compare", type=Path, help="exit with 1 where something is worse than in this file")
    parser.add_argument("--table", choices=("text", "markdown"), default="text")
    options = parser.parse_args()

    rows = [row for row in ROWS if fnmatch.fnmatchcase(row.name, options.rows)]
    n = options.scenes if options.scenes is not None else 20 if options.quick else 100
    if not rows:
        parser.error(f"no row is named {options.rows!r}; there are: {'; '.join(row.name for row in ROWS)}")
    if min(n, options.colmap_scenes) < 1:
        parser.error(f"--scenes and --colmap-scenes must be at least 1, got {n} and {options.colmap_scenes}")
    try:
        baseline = load(options.compare) if options.compare else None
    except ValueError as error:
        parser.error(str(error))
    progress = Console(stderr=True)
    wanted = [] if options.no_peers else options.peers or (["poselib"] if options.quick else list(PEERS))
    peers = [peer for peer in wanted if importlib.util.find_spec(peer)]
    if len(peers) < len(wanted):
        missing = " and ".join(peer for peer in wanted if peer not in peers)
        progress.print(f"Not installed, so not compared with: {missing} (pip install 'sylpose[bench]').", markup=False)

    if options.show:
        results = load(options.show)
        peers = [peer for peer in PEERS if any(peer in row.peers for row in results.rows)]
    else:
        results = run(rows, n, options.colmap_scenes, peers, progress)
    if options.out:
        save(results, options.out)
    out = Console(width=400, highlight=False)
    out.print(table(results, options.table == "markdown"))
    if any("poselib" in row.peers for row in results.rows):
        out.print("\n## Time of PoseLib over time of sylpose, at PoseLib's best setting for each row\n", markup=False)
        out.print(speed_table(results, options.table == "markdown"))
        out.print("\n## Each setting of PoseLib over sylpose: time, and errors on the same scenes\n", markup=False)
        out.print(setting_table(results, options.table == "markdown"))
    out.print(
        f"import {results.import_s:.2f} s, first call of a fresh process {results.first_call_s:.2f} s; "
        f"{max(row.ours.scenes for row in results.rows)} scenes per row"
    )
    sections = {"No pose": list(failures(results))}
    if peers:
        sections["Misses its accuracy"] = misses(results, by_chance=False)
        sections["Misses its accuracy by what may be chance"] = misses(results, by_chance=True)
    sections["Too slow"] = list(too_slow(results))
    if baseline is not None:
        sections["Worse than the baseline"] = list(worse_than(results, baseline))
    # The page has the tables; what misses a target is for who works on the solvers.
    for title, lines in sections.items() if options.table == "text" or baseline is not None else ():
        out.print(f"\n{title}: {len(lines) or 'nothing'}", markup=False)
        for line in lines:
            out.print(f"- {line}", markup=False)
    return 1 if sections.get("Worse than the baseline") else 0


if __name__ == "__main__":
    sys.exit(main())
