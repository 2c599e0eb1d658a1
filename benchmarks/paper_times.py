"""Run time of the paper's estimators from given moments, compared with required bounds.

    python benchmarks/paper_times.py [--repeat 7] [SECTION ...]

All times are CPU times of one thread, the minimum over the repeats, since other load on the machine can only add time.
Prints Markdown tables; the exit code is 1 if a bound is exceeded.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.rig import Rig
from sylpose.simulate import arc, dome, ellipsoid, random_motion, simulate_matches
from sylpose.sylvester.centralized import solve_centralized, solve_centralized_batch

BODY = ellipsoid((0.15, 0.12, 0.1))
COUNTS = (1, 2, 4, 10, 30, 100, 300, 1000, 3000, 10_000)
PROBLEMS = 1000
# Measures import and first call in a separate process.
FIRST_CALL = """
import time
start = time.process_time()
import numpy as np
from sylpose.sylvester.centralized import solve_centralized_batch
loaded = time.process_time()
k = np.random.default_rng(0).normal(size=(2, 3, 20, 9))
solve_centralized_batch(np.stack([np.eye(3)] * 3), np.swapaxes(k, 2, 3) @ k)
print(loaded - start, time.process_time() - loaded)
"""


def measure_cpu_time(run: Callable[[], object], repeat: int) -> float:
    """Return the minimum CPU time over the repeats, after one warm-up run."""
    run()
    times = []
    for _ in range(repeat):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return min(times)


def simulate_moments(rig: Rig, seed: int, per_camera: int = 60) -> list[PairMoments]:
    """Simulate a rotation of 5 degrees with 0.5 px of noise; return the moments of each camera."""
    rng = np.random.default_rng(seed)
    pair = simulate_matches(rig, BODY, random_motion(5.0, 0.02, rng), rng=rng, per_camera=per_camera)
    return [PairMoments.from_matches(m.x, m.y) for m in pair.matches]


def camera_rotations(rig: Rig) -> FloatArray:
    return np.array([camera.rotation for camera in rig])


def make_ring_rig(n: int) -> Rig:
    """Return a rig of `n` cameras on a circle, alternately above and below the object."""
    return arc(n, 360.0 / n, height=[0.4 * (-1) ** k for k in range(n)])


def time_many_problems(repeat: int) -> bool:
    """Time many problems, in a batch and one by one.

    Where the certificate fails (one or two cameras, narrow arcs) the solver searches all minima.
    """
    print(f"\n## Centralized solver, {PROBLEMS:,} problems\n")
    print("| cameras | certified | µs per problem, batch | µs, single: median, 99 % |\n|---|---|---|---|")
    holds = True
    rigs = {f"{n} on a ring": make_ring_rig(n) for n in (1, 2, 4, 8)} | {"4, 10° apart": arc(4, 10.0)}
    for name, rig in rigs.items():
        Q, problems = camera_rotations(rig), [simulate_moments(rig, seed) for seed in range(PROBLEMS)]
        matrices = np.array([[m.matrix for m in moments] for moments in problems])
        batch_time = measure_cpu_time(lambda Q=Q, M=matrices: solve_centralized_batch(Q, M), repeat) / PROBLEMS  # type: ignore[misc]
        single_times = [measure_cpu_time(lambda Q=Q, m=m: solve_centralized(Q, m), 3) for m in problems[:100]]  # type: ignore[misc]
        median, percentile_99 = np.percentile(single_times, [50, 99])
        certified = solve_centralized_batch(Q, matrices).certified.mean()
        print(f"| {name} | {certified:.0%} | {1e6 * batch_time:.0f} | {1e6 * median:.0f}, {1e6 * percentile_99:.0f} |")
        if len(rig) == 4:
            holds &= batch_time <= 150e-6 and percentile_99 <= 1e-3
    print(f"\nFour cameras: at most 150 µs per problem in a batch and 1 ms single: {format_verdict(holds)}.")
    return holds


def time_many_cameras(repeat: int) -> bool:
    """Time one problem of up to 10,000 cameras."""
    print("\n## Centralized solver, one problem\n")
    print("| cameras | ms | µs per camera |\n|---|---|---|")
    rig = dome(max(COUNTS))
    Q, moments = camera_rotations(rig), simulate_moments(rig, 0, per_camera=20)
    # A random subset covers the dome evenly for any number of cameras.
    order = np.random.default_rng(0).permutation(len(Q))
    times = {}
    for n in COUNTS:
        cameras, subset = Q[order[:n]], [moments[c] for c in order[:n]]
        times[n] = measure_cpu_time(lambda q=cameras, m=subset: solve_centralized(q, m), repeat)  # type: ignore[misc]
        print(f"| {n:,} | {1e3 * times[n]:.2f} | {1e6 * times[n] / n:.1f} |")
    slope, start = np.polyfit(list(times), list(times.values()), 1, w=1 / np.array(list(times.values())))
    print(f"\nLinear fit: {1e6 * start:.0f} µs + {1e6 * slope:.2f} µs per camera (relative least squares).")
    ratio = (times[10_000] / 10_000) / (times[100] / 100)
    holds = times[10_000] <= 50e-3 and ratio <= 2
    print(
        f"\n10,000 cameras: at most 50 ms, and at most 2 times the time per camera at 100 (measured {ratio:.2f}): "
        f"{format_verdict(holds)}."
    )
    return holds


def time_first_call(_: int) -> bool:
    """Time the import and the first call, with an empty and with a filled compilation cache."""
    print("\n## First call of a process\n")
    print("| compilation cache | import, s | first call, s |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name in ("empty", "filled"):
            environment = os.environ | {"NUMBA_CACHE_DIR": folder}
            process = subprocess.run(
                [sys.executable, "-c", FIRST_CALL], env=environment, check=True, capture_output=True
            )
            loading, call = map(float, process.stdout.split())
            print(f"| {name} | {loading:.2f} | {call:.2f} |")
    return True


def format_verdict(holds: bool) -> str:
    return "holds" if holds else "**does not hold**"


SECTIONS = {"many_problems": time_many_problems, "many_cameras": time_many_cameras, "first_call": time_first_call}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=f"one of {', '.join(SECTIONS)}; default: all")
    parser.add_argument("--repeat", type=int, default=7)
    options = parser.parse_args()
    unknown = set(options.sections) - set(SECTIONS)
    if unknown:
        parser.error(f"unknown section {', '.join(sorted(unknown))}")
    results = [SECTIONS[name](options.repeat) for name in options.sections or SECTIONS]
    sys.exit(0 if all(results) else 1)


if __name__ == "__main__":
    main()
