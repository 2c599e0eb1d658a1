"""Run time against the number of cameras and of matches. The only study whose figures differ from run to run."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sylpose.experiments.figures import Reference, draw_lines
from sylpose.experiments.study import Study
from sylpose.experiments.table import Table, quartiles
from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.sylvester.centralized import solve_centralized

__all__ = ["STUDIES", "Fit", "straight_line"]


TIME_COLUMNS = ("repeats", "q25_ms", "median_ms", "q75_ms")
# Of so many cameras and more the first dual is enough, as a rule; with fewer there is also a search, and a proof by all
# multipliers (measured: docs/benchmarks.md#the-certificate).
BY_DUAL = 3
SOLVE, FORM = "estimate from moments", "form the moments"


class Fit(NamedTuple):
    """A straight line y = intercept + slope x, of least relative squares, since x goes over some decades.

    Attributes:
        r2: share of the (equally weighted) variance of y that it explains.
        deviation: the largest |y - line| / y.
    """

    intercept: float
    slope: float
    r2: float
    deviation: float

    def at(self, x: ArrayLike) -> FloatArray:
        """The line."""
        return np.asarray(self.intercept + self.slope * np.asarray(x, dtype=float))


def straight_line(x: ArrayLike, y: ArrayLike) -> Fit:
    """The line nearest to points whose y are positive, by relative distance."""
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    intercept, slope = np.linalg.lstsq(np.column_stack([1 / y, x / y]), np.ones(len(y)), rcond=None)[0]
    residual = y - intercept - slope * x
    r2 = 1 - float(residual @ residual) / float(np.sum((y - y.mean()) ** 2))
    return Fit(float(intercept), float(slope), r2, float(np.abs(residual / y).max()))


def _milliseconds(action: Callable[[], object], repeats: int) -> tuple[int, float, float, float]:
    """Repeats, and quartiles of the time that an action takes once it has been done once."""
    action()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(1000 * (time.perf_counter() - start))
    return repeats, *quartiles(times)


def _matches(rng: np.random.Generator, cameras: int, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(C, 3, 3) random Q, and (C, n, 2) orthographic points x, y, each camera's own, of a body that turns by 5°."""
    Q = Rotation.random(cameras, rng=rng).as_matrix()
    turn = Rotation.from_rotvec(np.deg2rad(5) * np.array([0.6, 0.0, 0.8])).as_matrix()
    points = 0.1 * rng.standard_normal((cameras, n, 3))
    x, y = points[..., :2], (points @ np.swapaxes(Q @ turn @ np.swapaxes(Q, 1, 2), 1, 2))[..., :2]
    noise = 5e-4 * rng.standard_normal((2, cameras, n, 2))
    return Q, x + noise[0], y + noise[1]


def run_cameras(seed: int, trials: int) -> Table:
    rng = np.random.default_rng(seed)
    Q, x, y = _matches(rng, 10_000, 20)
    moments = [PairMoments.from_matches(xc, yc) for xc, yc in zip(x, y, strict=True)]
    rows = []
    for n in (1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000):
        solve = partial(solve_centralized, Q[:n], moments[:n], aim=False)
        rows.append(("run time", SOLVE, n, *_milliseconds(solve, trials)))
    return Table(("scene", "method", "cameras", *TIME_COLUMNS), tuple(rows))


def cameras_fit(table: Table) -> Fit:
    """Milliseconds over the number of cameras, from `BY_DUAL` on."""
    n, times = table.numbers("cameras"), table.numbers("median_ms")
    return straight_line(n[n >= BY_DUAL], times[n >= BY_DUAL])


def cameras_findings(table: Table) -> list[str]:
    fit = cameras_fit(table)
    fewer = table.value("median_ms", cameras=2) - fit.at(2)
    per_camera = {n: 1000 * table.value("median_ms", cameras=n) / n for n in (100, 10_000)}
    return [
        f"Straight line: {fit.intercept:.2g} ms + {1000 * fit.slope:.3g} µs per camera, R² = {fit.r2:.4f}, off by at most "
        f"{100 * fit.deviation:.0f} % from {BY_DUAL} to 10,000 cameras.",
        f"Two cameras, which need a search and a proof besides, take {fewer:.2g} ms more than the line.",
        f"Per camera {per_camera[100]:.2g} µs with 100 and {per_camera[10_000]:.2g} µs with 10,000 cameras.",
    ]


def draw_cameras(table: Table, path: Path) -> None:
    fit = cameras_fit(table)
    draw_lines(
        table,
        path,
        title="Run time of the centralised estimate, from moments",
        x="cameras",
        x_label="cameras",
        y="ms",
        y_label="milliseconds",
        reference=Reference(f"{fit.intercept:.2g} ms + {1000 * fit.slope:.2g} µs per camera", fit.at),
    )


TIME_CAMERAS = Study(
    name="time_cameras",
    question="Does the time grow in a straight line with the number of cameras?",
    run=run_cameras,
    draw=draw_cameras,
    findings=cameras_findings,
    trials=21,
    quick_trials=5,
)


def run_matches(seed: int, trials: int) -> Table:
    rng = np.random.default_rng(seed)
    rows = []
    for n in (10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000):
        Q, x, y = _matches(rng, 4, n)

        def form(x: FloatArray = x, y: FloatArray = y) -> list[PairMoments]:
            return [PairMoments.from_matches(xc, yc) for xc, yc in zip(x, y, strict=True)]

        for method, action in ((FORM, form), (SOLVE, partial(solve_centralized, Q, form(), aim=False))):
            rows.append(("run time", method, n, *_milliseconds(action, trials)))
    return Table(("scene", "method", "matches", *TIME_COLUMNS), tuple(rows))


def forming_fit(table: Table) -> Fit:
    """Milliseconds to form the moments over the number of matches."""
    rows = table.where(method=FORM)
    return straight_line(rows.numbers("matches"), rows.numbers("median_ms"))


def matches_findings(table: Table) -> list[str]:
    fit, solve = forming_fit(table), table.where(method=SOLVE).numbers("median_ms")
    return [
        f"From moments, 4 cameras: {solve.min():.2g} to {solve.max():.2g} ms, whatever the number of matches.",
        f"Forming the moments: {fit.intercept:.2g} ms + {1000 * fit.slope:.2g} µs per match and camera, "
        f"R² = {fit.r2:.4f}, off by at most {100 * fit.deviation:.0f} % from 10 to 100,000 matches.",
    ]


def draw_matches(table: Table, path: Path) -> None:
    fit = forming_fit(table)
    draw_lines(
        table,
        path,
        title="Run time for 4 cameras",
        x="matches",
        x_label="matches per camera",
        y="ms",
        y_label="milliseconds",
        reference=Reference(f"{fit.intercept:.2g} ms + {1000 * fit.slope:.2g} µs per match", fit.at),
    )


TIME_MATCHES = Study(
    name="time_matches",
    question="Does the time depend on the number of matches?",
    run=run_matches,
    draw=draw_matches,
    findings=matches_findings,
    trials=41,
    quick_trials=9,
)

STUDIES = (TIME_CAMERAS, TIME_MATCHES)
