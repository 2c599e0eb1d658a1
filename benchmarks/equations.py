"""Sylvester's equation, A N + N B = C and Σ A_k X B_k = C, by both methods: times, accuracy, singular equations.

    python benchmarks/equations.py [--repeat 5] [--trials 200]

Prints docs/equation.md's tables in Markdown, single thread. SciPy's `solve_sylvester`, which tests no rank, stands beside.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import math
import time
import warnings
from collections.abc import Callable

import numpy as np
from scipy import linalg

from sylpose.geometry.arrays import FloatArray
from sylpose.sylvester.equation import Method, SingularSylvesterError, solve_generalized_sylvester, solve_sylvester

Solve = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]

SIZES = (2, 3, 6, 7, 8, 9, 14, 16, 30, 100, 300)
BATCH = 1000
# What a table leaves out: a dense system of more unknowns, or the systems of a batch of more entries together (1.6 GB).
MOST_UNKNOWNS, MOST_ENTRIES = 1000, 2 * 10**8
# And batches of a method that solves one equation after the other.
MOST_BATCHED_SIZE = 16


def with_method(method: Method) -> Solve:
    return lambda a, b, c: solve_sylvester(a, b, c, method)


SOLVERS: dict[str, Solve] = {
    "Kronecker": with_method("kronecker"),
    "Bartels-Stewart": with_method("bartels-stewart"),
    "SciPy": lambda a, b, c: np.asarray(linalg.solve_sylvester(a, b, c)),
}


def fits(method: str, n: int, batch: int) -> bool:
    if method == "Kronecker":
        return n * n <= MOST_UNKNOWNS and batch * n**4 <= MOST_ENTRIES
    return batch == 1 or n <= MOST_BATCHED_SIZE


def seconds(run: Callable[[], object], repeat: int) -> float:
    """Of the processor, the median: others on the machine count little. Fewer runs of what takes long."""
    times: list[float] = []
    run()
    while len(times) < repeat and (not times or sum(times) < 5):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return float(np.median(times))


def written(time_in_seconds: float) -> str:
    """Three digits, no more than were measured."""
    microseconds = 1e6 * time_in_seconds
    for unit, size in (("s", 1e6), ("ms", 1e3)):
        if microseconds >= size:
            return f"{microseconds / size:.3g} {unit}"
    return f"{microseconds:.3g} µs"


def regular(rng: np.random.Generator, batch: int, n: int) -> FloatArray:
    """Eigenvalues in a disc about 3 of radius 1: far from those of its negative."""
    return rng.normal(size=(batch, n, n)) / math.sqrt(n) + 3 * np.eye(n)


def two_sided_times(rng: np.random.Generator, repeat: int) -> None:
    columns = [(name, batch) for name in SOLVERS for batch in (1, BATCH)]
    print("| m = n |" + "".join(f" {name}, {'alone' if batch == 1 else 'in 1,000'} |" for name, batch in columns))
    print("|---|" + "---|" * len(columns))
    for n in SIZES:
        cells = []
        for name, batch in columns:
            if fits(name, n, batch):
                a, b, c = regular(rng, batch, n), regular(rng, batch, n), rng.normal(size=(batch, n, n))
                solve = SOLVERS[name]
                cells.append(written(seconds(lambda: solve(a, b, c), repeat) / batch))  # noqa: B023
            else:
                cells.append("")
        print(f"| {n} | {' | '.join(cells)} |")


def generalized_times(rng: np.random.Generator, repeat: int) -> None:
    columns: list[tuple[str, Method, int, int]] = [
        ("Kronecker", "kronecker", 2, 1),
        ("Kronecker", "kronecker", 2, BATCH),
        ("Kronecker", "kronecker", 16, BATCH),
        ("Bartels-Stewart", "bartels-stewart", 2, 1),
        ("Bartels-Stewart", "bartels-stewart", 2, BATCH),
    ]
    names = [f"{name}, K = {k}, {'alone' if batch == 1 else 'in 1,000'}" for name, _, k, batch in columns]
    print("| m = n | " + " | ".join(names) + " |")
    print("|---|" + "---|" * len(columns))
    for n in SIZES:
        cells = []
        for name, method, k, batch in columns:
            if fits(name, n, batch):
                a, b = ([regular(rng, batch, n) for _ in range(k)] for _ in range(2))
                c = rng.normal(size=(batch, n, n))
                cells.append(
                    written(seconds(lambda: solve_generalized_sylvester(a, b, c, method), repeat) / batch)  # noqa: B023
                )
            else:
                cells.append("")
        print(f"| {n} | {' | '.join(cells)} |")


def basis(rng: np.random.Generator, n: int, condition: float) -> FloatArray:
    u, v = (linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2))
    return np.asarray(u @ np.diag(np.geomspace(1, condition, n)) @ v)


def similar(rng: np.random.Generator, form: FloatArray, condition: float) -> FloatArray:
    u = basis(rng, len(form), condition)
    return np.asarray(u @ form @ np.linalg.inv(u))


def accuracy(rng: np.random.Generator, trials: int) -> None:
    """Of a known N: A and -B symmetric, one pair of eigenvalues apart by a gap."""
    n = 9
    print("| gap | size / σ · 2.2e-16 |" + "".join(f" {name}: error | residual |" for name in SOLVERS))
    print("|---|---|" + "---|---|" * len(SOLVERS))
    for gap in (1.0, 1e-3, 1e-6, 1e-9):
        errors: dict[str, list[tuple[float, float]]] = {name: [] for name in SOLVERS}
        bound = 0.0
        for _ in range(trials):
            # 1, 0, -1 ... of A; 1 + gap, 2 + gap ... of -B.
            steps = np.arange(n)
            a, b = similar(rng, np.diag(1.0 - steps), 1), similar(rng, -np.diag(1 + gap + steps), 1)
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


def forms() -> dict[str, tuple[FloatArray, FloatArray]]:
    """A and B before a change of basis."""
    pair, block = np.array([[1.0, 2], [-2, 1]]), 2 * np.eye(3) + np.eye(3, k=1)
    far = np.diag([1e9, 1e9], 1)
    return {
        "one shared real eigenvalue": (np.diag([1.0, 2, 3]), -np.diag([2.0, -4, -5])),
        "a shared complex pair": (linalg.block_diag(pair, 3.0), -linalg.block_diag(pair, -4.0)),
        "Jordan blocks of 3 with one eigenvalue": (block, -block),
        "eigenvalues 0.5 apart, far from normal": (np.diag([1.0, 2, 3]) + far, -np.diag([1.5, 2.5, 3.5]) - far),
        "regular: eigenvalues 1e-6 apart": (np.diag([1.0, 2, 3]), -np.diag([2.0 + 1e-6, -4, -5])),
        "regular: Jordan blocks of 3, 0.1 apart": (block, -block + 0.1 * np.eye(3)),
    }


def singular(rng: np.random.Generator, trials: int) -> None:
    print("| 3x3, in a random basis | Kronecker refuses | Bartels-Stewart refuses | SciPy's median largest entry |")
    print("|---|---|---|---|")
    for kind, (form_a, form_b) in forms().items():
        refused = dict.fromkeys(("Kronecker", "Bartels-Stewart"), 0)
        largest = []
        for _ in range(trials):
            a, b = similar(rng, form_a, 10), similar(rng, form_b, 10)
            c = rng.normal(size=(3, 3))
            for name in refused:
                try:
                    SOLVERS[name](a, b, c)
                except SingularSylvesterError:
                    refused[name] += 1
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                largest.append(float(np.abs(SOLVERS["SciPy"](a, b, c)).max()))
        counts = " | ".join(f"{n} of {trials}" for n in refused.values())
        print(f"| {kind} | {counts} | {np.median(largest):.0e} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--trials", type=int, default=200)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    print("Time per equation, A N + N B = C\n")
    two_sided_times(rng, options.repeat)
    print("\nTime per equation, Σ A_k X B_k = C\n")
    generalized_times(rng, options.repeat)
    print("\nAccuracy, 9x9, medians\n")
    accuracy(rng, options.trials)
    print("\nSingular or not\n")
    singular(rng, options.trials)


if __name__ == "__main__":
    main()
