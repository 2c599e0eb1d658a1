"""How long the paper's estimators take, from moments, single thread, against what must hold.

    python benchmarks/paper_times.py [--repeat 7] [SECTION ...]

Prints tables in Markdown, all in CPU time of one thread, the least of the repeats: what others do on the machine only adds.
Exit code 1 if a bound is exceeded.
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
# What a first call costs, in a process of its own.
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


def seconds(run: Callable[[], object], repeat: int) -> float:
    """The least of the repeats, after one run that does not count."""
    run()
    times = []
    for _ in range(repeat):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return min(times)


def moments_of(rig: Rig, seed: int, per_camera: int = 60) -> list[PairMoments]:
    """5 degrees of turn, 0.5 px of noise."""
    rng = np.random.default_rng(seed)
    pair = simulate_matches(rig, BODY, random_motion(5.0, 0.02, rng), rng=rng, per_camera=per_camera)
    return [PairMoments.from_matches(m.x, m.y) for m in pair.matches]


def rotations_of(rig: Rig) -> FloatArray:
    return np.array([camera.rotation for camera in rig])


def around(n: int) -> Rig:
    """`n` cameras all around, alternately above and below."""
    return arc(n, 360.0 / n, height=[0.4 * (-1) ** k for k in range(n)])


def many_problems(repeat: int) -> bool:
    """In a batch, and alone. Without a certificate (one or two cameras, narrow arcs) all minima are searched."""
    print(f"\n## Centralised, {PROBLEMS:,} problems\n")
    print("| cameras | certified | in a batch, µs each | alone, µs: median, 99 % |\n|---|---|---|---|")
    holds = True
    rigs = {f"{n} around": around(n) for n in (1, 2, 4, 8)} | {"4, 10 degrees apart": arc(4, 10.0)}
    for name, rig in rigs.items():
        Q, problems = rotations_of(rig), [moments_of(rig, seed) for seed in range(PROBLEMS)]
        matrices = np.array([[m.matrix for m in moments] for moments in problems])
        batch = seconds(lambda Q=Q, M=matrices: solve_centralized_batch(Q, M), repeat) / PROBLEMS  # type: ignore[misc]
        alone = [seconds(lambda Q=Q, m=m: solve_centralized(Q, m), 3) for m in problems[:100]]  # type: ignore[misc]
        median, most = np.percentile(alone, [50, 99])
        certified = solve_centralized_batch(Q, matrices).certified.mean()
        print(f"| {name} | {certified:.0%} | {1e6 * batch:.0f} | {1e6 * median:.0f}, {1e6 * most:.0f} |")
        if len(rig) == 4:
            holds &= batch <= 150e-6 and most <= 1e-3
    print(f"\nFour cameras, at most 150 µs in a batch and 1 ms alone: {verdict(holds)}.")
    return holds


def many_cameras(repeat: int) -> bool:
    """One problem of up to 10,000 cameras."""
    print("\n## Centralised, one problem\n")
    print("| cameras | ms | µs per camera |\n|---|---|---|")
    rig = dome(max(COUNTS))
    Q, moments = rotations_of(rig), moments_of(rig, 0, per_camera=20)
    # Evenly over the dome, however many.
    order = np.random.default_rng(0).permutation(len(Q))
    times = {}
    for n in COUNTS:
        cameras, some = Q[order[:n]], [moments[c] for c in order[:n]]
        times[n] = seconds(lambda q=cameras, m=some: solve_centralized(q, m), repeat)  # type: ignore[misc]
        print(f"| {n:,} | {1e3 * times[n]:.2f} | {1e6 * times[n] / n:.1f} |")
    slope, start = np.polyfit(list(times), list(times.values()), 1, w=1 / np.array(list(times.values())))
    print(f"\nA straight line: {1e6 * start:.0f} µs and {1e6 * slope:.2f} µs per camera (relative least squares).")
    ratio = (times[10_000] / 10_000) / (times[100] / 100)
    holds = times[10_000] <= 50e-3 and ratio <= 2
    print(
        f"\n10,000 cameras at most 50 ms, per camera at most 2 times as at 100 (it is {ratio:.2f} times): {verdict(holds)}."
    )
    return holds


def first_call(_: int) -> bool:
    """Import, and the first call with nothing compiled and with all compiled by an earlier process."""
    print("\n## The first call of a process\n")
    print("| | import, s | first call, s |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name in ("nothing compiled yet", "compiled before"):
            environment = os.environ | {"NUMBA_CACHE_DIR": folder}
            done = subprocess.run([sys.executable, "-c", FIRST_CALL], env=environment, check=True, capture_output=True)
            loading, call = map(float, done.stdout.split())
            print(f"| {name} | {loading:.2f} | {call:.2f} |")
    return True


def verdict(holds: bool) -> str:
    return "holds" if holds else "**does not hold**"


SECTIONS = {"many_problems": many_problems, "many_cameras": many_cameras, "first_call": first_call}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "sections", nargs="*", metavar="SECTION", help=f"of {', '.join(SECTIONS)}; all if none is named"
    )
    parser.add_argument("--repeat", type=int, default=7)
    options = parser.parse_args()
    unknown = set(options.sections) - set(SECTIONS)
    if unknown:
        parser.error(f"no section {', '.join(sorted(unknown))}")
    results = [SECTIONS[name](options.repeat) for name in options.sections or SECTIONS]
    sys.exit(0 if all(results) else 1)


if __name__ == "__main__":
    main()
