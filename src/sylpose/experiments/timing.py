"""Run time studies: number of cameras and of matches. The only studies whose results differ between runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sylpose.experiments.study import Lines, ReferenceCurve, Study, Table, compute_quartiles
from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.sylvester.centralized import solve_centralized

TIME_COLUMNS = ("repeats", "q25_ms", "median_ms", "q75_ms")
TIME_AXIS = ("ms", "milliseconds")
# Number of cameras from which the first dual is usually sufficient; fewer also need a search and the certificate by all
# multipliers (measured: docs/history/benchmarks.md#the-certificate).
MIN_CAMERAS_DUAL = 3
SOLVE_METHOD, FORM_METHOD = "estimate from moments", "form the moments"


class LineFit(NamedTuple):
    """Straight line y = intercept + slope x, fitted by relative least squares, since x spans several decades.

    Attributes:
        r2: share of the (equally weighted) variance of y that it explains.
        deviation: the largest |y - line| / y.
    """

    intercept: float
    slope: float
    r2: float
    deviation: float

    def evaluate(self, x: ArrayLike) -> FloatArray:
        """Evaluate the line at x."""
        return np.asarray(self.intercept + self.slope * np.asarray(x, dtype=float))


def fit_line(x: ArrayLike, y: ArrayLike) -> LineFit:
    """Fit a line to points with positive y, by relative least squares."""
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    intercept, slope = np.linalg.lstsq(np.column_stack([1 / y, x / y]), np.ones(len(y)), rcond=None)[0]
    residual = y - intercept - slope * x
    r2 = 1 - float(residual @ residual) / float(np.sum((y - y.mean()) ** 2))
    return LineFit(float(intercept), float(slope), r2, float(np.abs(residual / y).max()))


def _measure_milliseconds(action: Callable[[], object], repeats: int) -> tuple[int, float, float, float]:
    """Return the number of repeats and the quartiles of an action's run time, after one warm-up run."""
    action()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(1000 * (time.perf_counter() - start))
    return repeats, *compute_quartiles(times)


def _draw_with_fit(figure: Lines, fit_table: Callable[[Table], LineFit], unit: str) -> Callable[[Table, Path], None]:
    """Return a function that draws a table of times with the line fitted to it."""

    def draw(table: Table, path: Path) -> None:
        fit = fit_table(table)
        label = f"{fit.intercept:.2g} ms + {1000 * fit.slope:.2g} µs per {unit}"
        figure._replace(reference=ReferenceCurve(label, fit.evaluate)).draw(table, path)

    return draw


def _random_matches(rng: np.random.Generator, cameras: int, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return random Q (C, 3, 3) and orthographic points x, y (C, n, 2) per camera of a body rotated by 5°."""
    Q = Rotation.random(cameras, rng=rng).as_matrix()
    rotation = Rotation.from_rotvec(np.deg2rad(5) * np.array([0.6, 0.0, 0.8])).as_matrix()
    points = 0.1 * rng.standard_normal((cameras, n, 3))
    x, y = points[..., :2], (points @ np.swapaxes(Q @ rotation @ np.swapaxes(Q, 1, 2), 1, 2))[..., :2]
    noise = 5e-4 * rng.standard_normal((2, cameras, n, 2))
    return Q, x + noise[0], y + noise[1]


def run_cameras(seed: int, trials: int) -> Table:
    rng = np.random.default_rng(seed)
    Q, x, y = _random_matches(rng, 10_000, 20)
    moments = [PairMoments.from_matches(xc, yc) for xc, yc in zip(x, y, strict=True)]
    rows = []
    for n in (1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000):
        solve = partial(solve_centralized, Q[:n], moments[:n], aim=False)
        rows.append(("run time", SOLVE_METHOD, n, *_measure_milliseconds(solve, trials)))
    return Table(("scene", "method", "cameras", *TIME_COLUMNS), tuple(rows))


def fit_cameras(table: Table) -> LineFit:
    """Fit milliseconds over the number of cameras, from `MIN_CAMERAS_DUAL` on."""
    n, times = table.column_values("cameras"), table.column_values("median_ms")
    return fit_line(n[n >= MIN_CAMERAS_DUAL], times[n >= MIN_CAMERAS_DUAL])


def summarize_cameras(table: Table) -> list[str]:
    fit = fit_cameras(table)
    fewer = table.value("median_ms", cameras=2) - fit.evaluate(2)
    per_camera = {n: 1000 * table.value("median_ms", cameras=n) / n for n in (100, 10_000)}
    return [
        f"Straight line: {fit.intercept:.2g} ms + {1000 * fit.slope:.3g} µs per camera, R² = {fit.r2:.4f}, off by at most "
        f"{100 * fit.deviation:.0f} % from {MIN_CAMERAS_DUAL} to 10,000 cameras.",
        f"Two cameras, which also need a search and a certificate, take {fewer:.2g} ms more than the line.",
        f"Per camera {per_camera[100]:.2g} µs with 100 and {per_camera[10_000]:.2g} µs with 10,000 cameras.",
    ]


TIME_CAMERAS = Study(
    "time_cameras",
    "Does the time grow linearly with the number of cameras?",
    run_cameras,
    _draw_with_fit(
        Lines("Run time of the centralized estimate, from moments", "cameras", "cameras", *TIME_AXIS),
        fit_cameras,
        "camera",
    ),
    summarize_cameras,
    trials=21,
    quick_trials=5,
)


def run_matches(seed: int, trials: int) -> Table:
    rng = np.random.default_rng(seed)
    rows = []
    for n in (10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000):
        Q, x, y = _random_matches(rng, 4, n)

        def form(x: FloatArray = x, y: FloatArray = y) -> list[PairMoments]:
            return [PairMoments.from_matches(xc, yc) for xc, yc in zip(x, y, strict=True)]

        for method, action in ((FORM_METHOD, form), (SOLVE_METHOD, partial(solve_centralized, Q, form(), aim=False))):
            rows.append(("run time", method, n, *_measure_milliseconds(action, trials)))
    return Table(("scene", "method", "matches", *TIME_COLUMNS), tuple(rows))


def fit_forming(table: Table) -> LineFit:
    """Fit milliseconds for forming the moments over the number of matches."""
    rows = table.filter_rows(method=FORM_METHOD)
    return fit_line(rows.column_values("matches"), rows.column_values("median_ms"))


def summarize_matches(table: Table) -> list[str]:
    fit, solve = fit_forming(table), table.filter_rows(method=SOLVE_METHOD).column_values("median_ms")
    return [
        f"From moments, 4 cameras: {solve.min():.2g} to {solve.max():.2g} ms, independent of the number of matches.",
        f"Forming the moments: {fit.intercept:.2g} ms + {1000 * fit.slope:.2g} µs per match and camera, "
        f"R² = {fit.r2:.4f}, off by at most {100 * fit.deviation:.0f} % from 10 to 100,000 matches.",
    ]


TIME_MATCHES = Study(
    "time_matches",
    "Does the time depend on the number of matches?",
    run_matches,
    _draw_with_fit(Lines("Run time for 4 cameras", "matches", "matches per camera", *TIME_AXIS), fit_forming, "match"),
    summarize_matches,
    trials=41,
    quick_trials=9,
)

STUDIES = (TIME_CAMERAS, TIME_MATCHES)
