"""Sylvester equations A N + N B = C and Σ A_k X B_k = C by both methods: times, accuracy, singular equations.

    python benchmarks/equations.py [--repeat 5] [--trials 200]

Prints the Markdown tables of docs/equation.md, single thread. SciPy's `solve_sylvester`, which checks no rank, is compared.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import math
import time
import warnings
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy import linalg

from sylpose.geometry.arrays import FloatArray
from sylpose.sylvester.equation import Method, SingularSylvesterError, solve_generalized_sylvester, solve_sylvester

Solve = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]

SIZES = (2, 3, 6, 7, 8, 9, 14, 16, 30, 100, 300)
BATCH = 1000
# The tables leave out dense systems with more unknowns, and batches whose systems have more entries together (1.6 GB).
MAX_UNKNOWNS, MAX_ENTRIES = 1000, 2 * 10**8
# They also leave out larger batches of a method that solves the equations sequentially.
MAX_BATCHED_SIZE = 16


def make_solver(method: Method) -> Solve:
    return lambda a, b, c: solve_sylvester(a, b, c, method)


SOLVERS: dict[str, Solve] = {
    "Kronecker": make_solver("kronecker"),
    "Bartels-Stewart": make_solver("bartels-stewart"),
    "SciPy": lambda a, b, c: np.asarray(linalg.solve_sylvester(a, b, c)),
}


def is_feasible(method: str, n: int, batch: int) -> bool:
    if method == "Kronecker":
        return n * n <= MAX_UNKNOWNS and batch * n**4 <= MAX_ENTRIES
    return batch == 1 or n <= MAX_BATCHED_SIZE


def measure_processor_time(run: Callable[[], object], repeat: int) -> float:
    """Return the median processor time, robust to other load; slow functions run fewer times."""
    times: list[float] = []
    run()
    while len(times) < repeat and (not times or sum(times) < 5):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return float(np.median(times))


def format_time(time_in_seconds: float) -> str:
    """Format a time with three digits."""
    microseconds = 1e6 * time_in_seconds
    for unit, size in (("s", 1e6), ("ms", 1e3)):
        if microseconds >= size:
            return f"{microseconds / size:.3g} {unit}"
    return f"{microseconds:.3g} µs"


def draw_regular(rng: np.random.Generator, batch: int, n: int) -> FloatArray:
    """Draw matrices with eigenvalues in a disc of radius 1 about 3, far from those of their negatives."""
    return rng.normal(size=(batch, n, n)) / math.sqrt(n) + 3 * np.eye(n)


def print_two_sided_times(rng: np.random.Generator, repeat: int) -> None:
    columns = [(name, batch) for name in SOLVERS for batch in (1, BATCH)]
    print("| m = n |" + "".join(f" {name}, {'single' if batch == 1 else 'batch'} |" for name, batch in columns))
    print("|---|" + "---|" * len(columns))
    for n in SIZES:
        cells = []
        for name, batch in columns:
            if is_feasible(name, n, batch):
                a, b, c = draw_regular(rng, batch, n), draw_regular(rng, batch, n), rng.normal(size=(batch, n, n))
                solve = SOLVERS[name]
                cells.append(format_time(measure_processor_time(lambda: solve(a, b, c), repeat) / batch))  # noqa: B023
            else:
                cells.append("")
        print(f"| {n} | {' | '.join(cells)} |")


def print_generalized_times(rng: np.random.Generator, repeat: int) -> None:
    columns: list[tuple[str, Method, int, int]] = [
        ("Kronecker", "kronecker", 2, 1),
        ("Kronecker", "kronecker", 2, BATCH),
        ("Kronecker", "kronecker", 16, BATCH),
        ("Bartels-Stewart", "bartels-stewart", 2, 1),
        ("Bartels-Stewart", "bartels-stewart", 2, BATCH),
    ]
    names = [f"{name}, K = {k}, {'single' if batch == 1 else 'batch'}" for name, _, k, batch in columns]
    print("| m = n | " + " | ".join(names) + " |")
    print("|---|" + "---|" * len(columns))
    for n in SIZES:
        cells = []
        for name, method, k, batch in columns:
            if is_feasible(name, n, batch):
                a, b = ([draw_regular(rng, batch, n) for _ in range(k)] for _ in range(2))
                c = rng.normal(size=(batch, n, n))
                cells.append(
                    format_time(
                        measure_processor_time(partial(solve_generalized_sylvester, a, b, c, method), repeat) / batch
                    )
                )
            else:
                cells.append("")
        print(f"| {n} | {' | '.join(cells)} |")


def draw_basis(rng: np.random.Generator, n: int, condition: float) -> FloatArray:
    u, v = (linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2))
    return np.asarray(u @ np.diag(np.geomspace(1, condition, n)) @ v)


def change_basis(rng: np.random.Generator, form: FloatArray, condition: float) -> FloatArray:
    u = draw_basis(rng, len(form), condition)
    return np.asarray(u @ form @ np.linalg.inv(u))


def print_accuracy(rng: np.random.Generator, trials: int) -> None:
    """Print the errors for a known N, with symmetric A and -B whose closest eigenvalues differ by a gap."""
    n = 9
    print("| gap | size / σ · 2.2e-16 |" + "".join(f" {name}: error | residual |" for name in SOLVERS))
    print("|---|---|" + "---|---|" * len(SOLVERS))
    for gap in (1.0, 1e-3, 1e-6, 1e-9):
        errors: dict[str, list[tuple[float, float]]] = {name: [] for name in SOLVERS}
        bound = 0.0
        for _ in range(trials):
            # 1, 0, -1 ... of A; 1 + gap, 2 + gap ... of -B.
            steps = np.arange(n)
            a, b = change_basis(rng, np.diag(1.0 - steps), 1), change_basis(rng, -np.diag(1 + gap + steps), 1)
            x = rng.normal(size=(n, n))
            c = a @ x + x @ b
            size = np.linalg.norm(a, 2) + np.linalg.norm(b, 2)
            bound = float(size / gap * np.finfo(float).eps)
            for name, solve in SOLVERS.items():
                solution = solve(a, b, c)
                error = np.linalg.norm(solution - x) / np.linalg.norm(x)
                residual = np.linalg.norm(a @ solution + solution @ b - c) / (size * np.linalg.norm(solution))
                errors[name].append((float(error), float(residual)))
        cells = [f"{value:.1e}" for name in SOLVERS for value in np.median(errors[name], axis=0)]
        print(f"| {gap:g} | {bound:.1e} | {' | '.join(cells)} |")


def make_forms() -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return A and B before the change of basis, by name."""
    pair, block = np.array([[1.0, 2], [-2, 1]]), 2 * np.eye(3) + np.eye(3, k=1)
    far = np.diag([1e9, 1e9], 1)
    return {
        "shared real eigenvalue": (np.diag([1.0, 2, 3]), -np.diag([2.0, -4, -5])),
        "shared complex pair": (linalg.block_diag(pair, 3.0), -linalg.block_diag(pair, -4.0)),
        "Jordan blocks of 3 with one eigenvalue": (block, -block),
        "eigenvalues 0.5 apart, far from normal": (np.diag([1.0, 2, 3]) + far, -np.diag([1.5, 2.5, 3.5]) - far),
        "regular: eigenvalues 1e-6 apart": (np.diag([1.0, 2, 3]), -np.diag([2.0 + 1e-6, -4, -5])),
        "regular: Jordan blocks of 3, 0.1 apart": (block, -block + 0.1 * np.eye(3)),
    }


def print_singular(rng: np.random.Generator, trials: int) -> None:
    print("| 3x3, random basis | Kronecker rejects | Bartels-Stewart rejects | SciPy: median of the largest entry |")
    print("|---|---|---|---|")
    for kind, (form_a, form_b) in make_forms().items():
        n_rejected = dict.fromkeys(("Kronecker", "Bartels-Stewart"), 0)
        largest = []
        for _ in range(trials):
            a, b = change_basis(rng, form_a, 10), change_basis(rng, form_b, 10)
            c = rng.normal(size=(3, 3))
            for name in n_rejected:
                try:
                    SOLVERS[name](a, b, c)
                except SingularSylvesterError:
                    n_rejected[name] += 1
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                largest.append(float(np.abs(SOLVERS["SciPy"](a, b, c)).max()))
        counts = " | ".join(f"{n} of {trials}" for n in n_rejected.values())
        print(f"| {kind} | {counts} | {np.median(largest):.0e} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--trials", type=int, default=200)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    print("Time per equation, A N + N B = C, single or in a batch of 1,000\n")
    print_two_sided_times(rng, options.repeat)
    print("\nTime per equation, Σ A_k X B_k = C, single or in a batch of 1,000\n")
    print_generalized_times(rng, options.repeat)
    print("\nAccuracy, 9x9, medians\n")
    print_accuracy(rng, options.trials)
    print("\nDetection of singular equations\n")
    print_singular(rng, options.trials)


if __name__ == "__main__":
    main()
