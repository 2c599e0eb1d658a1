"""Motion between two frames and pose of a known object, compared with PoseLib and COLMAP on seeded scenes.

    python benchmarks/two_frames.py [--quick] [--rows "turn*"] [--scenes 100] [--peers poselib pycolmap | --no-peers]
        [--out results.json | --show results.json] [--compare benchmarks/two_frames_baseline.json] [--table markdown]

Errors are those of the rotation (degrees) and of the translation of the object's center (mm): median / 90th / 99th
percentile. A missing pose counts as 180 degrees and 1000 mm. Times are medians of the processor time per call on one thread,
with the input in the library's own types; the solvers alternate scene by scene. Each solver runs in a separate process with
a time limit. A peer runs with many option sets (PoseLib: 32 combinations of iterations, threshold and loss, set by the true
noise). In each figure of its errors its best set counts, a choice in the peer's favor that no user can make. Its time in a
row is that of its fastest set that is as accurate as sylpose there, or else as its own best (`select_fastest`).

COLMAP takes a second per motion, so it only solves a few scenes per row, too few for a comparison if PoseLib solves the row;
--colmap-scenes 25 gives it enough, in an hour. A verdict is marked as chance if resampling the scenes might reverse it
(paired bootstrap, 1 %).

The Cramér-Rao bound uses the true geometry and inliers, with unknown depths, then with known depths. Errors sampled from it
are summarized like those of the solvers.

With --compare the exit code is 1 if a figure is worse than in the baseline: an error by more than 10 % on the same scenes, a
time by more than 40 % (in units of a reference loop, since machines differ), or more failures.
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
from benchmarks.two_frames_bound import compute_bounds, sample_errors
from benchmarks.two_frames_report import (
    FAILED_DEG,
    FAILED_MM,
    Results,
    RowResult,
    SolverResult,
    compute_figures,
    compute_ratio_limits,
    find_failures,
    find_misses,
    find_regressions,
    find_slow_rows,
    load,
    make_setting_table,
    make_speed_table,
    make_table,
    save,
)
from benchmarks.two_frames_scenes import ROWS, Row, Scene, make_scene
from benchmarks.two_frames_solvers import LOADERS, Worker, make_option_sets

PEERS = ("poselib", "pycolmap")
# Time limits per call, seconds. PoseLib takes 10 to 100 ms or hangs, COLMAP takes 1 to 6 s.
LIMIT_S = {"sylpose": 20.0, "poselib": 3.0, "pycolmap": 60.0}
# COLMAP's absolute pose takes up to 0.2 s, its relative pose a second or more (--colmap-scenes).
COLMAP_POSE_SCENES, COLMAP_MOTION_SCENES = 25, 3
# After this many consecutive hangs, the remaining scenes of the row count as hangs.
MAX_HANGS = 2


class SolverRun:
    """Results of one solver with one option set, scene by scene."""

    def __init__(self, worker: Worker, label: str, options: dict[str, object]) -> None:
        self.deg: list[float] = []
        self.mm: list[float] = []
        self._worker, self._label, self._options = worker, label, options
        self._seconds: list[float] = []
        self._failures, self._n_hangs = Counter[str](), 0

    def solve_scene(self, scene: Scene) -> None:
        """Solve a scene."""
        deg, mm = FAILED_DEG, FAILED_MM
        if self._n_hangs == MAX_HANGS:
            self._failures["hang"] += 1
        else:
            answer = self._worker.solve(scene, self._options)
            self._n_hangs = self._n_hangs + 1 if answer.failure == "hang" else 0
            self._seconds.append(answer.seconds)
            if answer.pose is None:
                self._failures[answer.failure] += 1
            else:
                deg, shift = scene.compute_error(answer.pose)
                mm = min(shift, FAILED_MM)  # a missing answer must not be better than a wrong one
        self.deg.append(deg)
        self.mm.append(mm)

    def summarize(self) -> SolverResult:
        """Summarize the results."""
        ms = 1e3 * float(np.median(self._seconds))
        figures = compute_figures(self.deg, self.mm)
        return SolverResult(self._label, len(self.deg), figures, float(f"{ms:.4g}"), dict(self._failures))


def run_row(row: Row, n: int, colmap_scenes: int, workers: dict[str, Worker]) -> RowResult:
    """Run one row by all solvers; they alternate, so that other load slows all of them alike."""
    scenes = [make_scene(row, index) for index in range(n)]
    covariances = [compute_bounds(scene) for scene in scenes]
    unknown, known = (compute_figures(*sample_errors(of_scenes)) for of_scenes in zip(*covariances, strict=True))
    own_run, loops = SolverRun(workers["sylpose"], "", {}), []
    peers = {
        solver: [
            SolverRun(workers[solver], *option) for option in make_option_sets(solver, row.problem, row.noise).items()
        ]
        for solver in PEERS
        if solver in workers
    }
    n_colmap = COLMAP_POSE_SCENES if row.problem == "pose" else colmap_scenes
    for index, scene in enumerate(scenes):
        loops.append(time_loop())
        own_run.solve_scene(scene)
        for solver, solver_runs in peers.items():
            for solver_run in solver_runs if solver != "pycolmap" or index < n_colmap else ():
                solver_run.solve_scene(scene)
    errors = (own_run.deg, own_run.mm)
    tried = {
        solver: [
            replace(solver_run.summarize(), ours_over_it=compute_ratio_limits(errors, (solver_run.deg, solver_run.mm)))
            for solver_run in solver_runs
        ]
        for solver, solver_runs in peers.items()
    }
    loop_ms = float(f"{np.median(loops):.4g}")
    rounded = ([float(f"{value:.4g}") for value in values] for values in errors)
    return RowResult(row.name, own_run.summarize(), tried, unknown, known, loop_ms, *rounded)


def time_loop() -> float:
    """Return the milliseconds of a fixed workload similar to that of solvers: the unit of times on different machines."""
    matrix = np.eye(6) + 0.1
    start = time.process_time()
    for _ in range(300):
        np.linalg.solve(matrix, matrix[0])
    sum(i * i for i in range(20000))
    return 1e3 * (time.process_time() - start)


def run(rows: list[Row], n: int, colmap_scenes: int, peers: list[str], console: Console) -> Results:
    """Run the whole benchmark."""
    warm_up = {
        problem: make_scene(next(r for r in ROWS if r.problem == problem), 10**6) for problem in ("motion", "pose")
    }
    with ExitStack() as stack:
        workers = {
            solver: stack.enter_context(Worker(LOADERS[solver], LIMIT_S[solver], warm_up["motion"]))
            for solver in ("sylpose", *peers)
        }
        workers["sylpose"].start()  # compiles if nothing is cached
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
    parser.add_argument("--peers", nargs="+", choices=PEERS, default=None, help="peers to compare with (default: both)")
    parser.add_argument("--colmap-scenes", type=int, default=COLMAP_MOTION_SCENES, help="scenes per row of motions")
    parser.add_argument("--no-peers", action="store_true", help="run sylpose only")
    parser.add_argument("--out", type=Path, help="write the results (JSON)")
    parser.add_argument(
        "--show", type=Path, metavar="JSON", help="print the tables of stored results (--out), run nothing"
    )
    parser.add_argument("--compare", type=Path, help="exit with 1 if a figure is worse than in this file")
    parser.add_argument("--table", choices=("text", "markdown"), default="text")
    options = parser.parse_args()

    rows = [row for row in ROWS if fnmatch.fnmatchcase(row.name, options.rows)]
    n = options.scenes if options.scenes is not None else 20 if options.quick else 100
    if not rows:
        parser.error(f"no row matches {options.rows!r}; the rows are: {'; '.join(row.name for row in ROWS)}")
    if min(n, options.colmap_scenes) < 1:
        parser.error(f"--scenes and --colmap-scenes must be at least 1, got {n} and {options.colmap_scenes}")
    try:
        baseline = load(options.compare) if options.compare else None
    except ValueError as error:
        parser.error(str(error))
    progress = Console(stderr=True)
    requested_peers = [] if options.no_peers else options.peers or (["poselib"] if options.quick else list(PEERS))
    peers = [peer for peer in requested_peers if importlib.util.find_spec(peer)]
    if len(peers) < len(requested_peers):
        missing = " and ".join(peer for peer in requested_peers if peer not in peers)
        progress.print(f"Not installed, so not compared with: {missing} (pip install 'sylpose[bench]').", markup=False)

    if options.show:
        results = load(options.show)
        peers = [peer for peer in PEERS if any(peer in row.peers for row in results.rows)]
    else:
        results = run(rows, n, options.colmap_scenes, peers, progress)
    if options.out:
        save(results, options.out)
    out = Console(width=400, highlight=False)
    out.print(make_table(results, options.table == "markdown"))
    if any("poselib" in row.peers for row in results.rows):
        out.print("\n## Time of PoseLib over time of sylpose, at PoseLib's best setting for each row\n", markup=False)
        out.print(make_speed_table(results, options.table == "markdown"))
        out.print("\n## Each setting of PoseLib over sylpose: time, and errors on the same scenes\n", markup=False)
        out.print(make_setting_table(results, options.table == "markdown"))
    out.print(
        f"import {results.import_s:.2f} s, first call of a fresh process {results.first_call_s:.2f} s; "
        f"{max(row.ours.scenes for row in results.rows)} scenes per row"
    )
    sections = {"No pose": list(find_failures(results))}
    if peers:
        sections["Misses the accuracy target"] = find_misses(results, by_chance=False)
        sections["Misses the accuracy target, possibly by chance"] = find_misses(results, by_chance=True)
    sections["Too slow"] = list(find_slow_rows(results))
    if baseline is not None:
        sections["Worse than the baseline"] = list(find_regressions(results, baseline))
    # The page only shows the tables; missed targets are for developers.
    for title, lines in sections.items() if options.table == "text" or baseline is not None else ():
        out.print(f"\n{title}: {len(lines) or 'nothing'}", markup=False)
        for line in lines:
            out.print(f"- {line}", markup=False)
    return 1 if sections.get("Worse than the baseline") else 0


if __name__ == "__main__":
    sys.exit(main())
