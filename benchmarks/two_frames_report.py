"""Results of the two-frame benchmark: file, tables, missed targets and regressions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from rich import box
from rich.table import Table

from benchmarks.two_frames_scenes import ROWS, Row
from sylpose.geometry.arrays import FloatArray

__all__ = [
    "Figures",
    "Results",
    "RowResult",
    "Setting",
    "SolverResult",
    "Speed",
    "compute_figures",
    "compute_ratio_limits",
    "compute_settings",
    "compute_speeds",
    "find_failures",
    "find_misses",
    "find_regressions",
    "find_slow_rows",
    "is_as_accurate",
    "load",
    "make_setting_table",
    "make_speed_table",
    "make_table",
    "save",
    "select_fastest",
]


# Median, 90th and 99th percentile.
QUANTILES = (0.5, 0.9, 0.99)
# A failure counts as an error of this size.
FAILED_DEG, FAILED_MM = 180.0, 1000.0
# Errors within this share of each other are a tie.
TIE_RATIO = 1.05
# A peer that solves fewer scenes, since it is slow, is shown but not compared if another peer is.
MIN_SCENES = 20
N_RESAMPLES = 400
# Limits of a regression: factor of the errors on the same scenes; factor of the time in units of the reference loop.
WORSE_ERROR, WORSE_TIME = 1.1, 1.4
# Largest growth of the time per camera or per match when their number increases.
MAX_LINEAR_RATIO = 1.25
GROWTH = (
    ("base: ring of 4, 60 matches", "16 cameras", 4.0),
    ("16 cameras", "64 x 60", 4.0),
    ("base: ring of 4, 60 matches", "4 x 800", 800 / 60),
    ("pose: ring of 4, 60 points", "pose: 4 x 800", 800 / 60),
)


class Figures(NamedTuple):
    """Quantiles (median, p90, p99) of the rotation error (degrees) and of the translation error of the center (mm)."""

    deg: tuple[float, float, float]
    mm: tuple[float, float, float]


@dataclass(frozen=True)
class SolverResult:
    """Results of one solver with one option set on the first `scenes` scenes of a row.

    `ours_over_it` is the ratio of sylpose's figures to its figures on those scenes, lower confidence limit
    (`compute_ratio_limits`).
    """

    options: str
    scenes: int
    figures: Figures
    ms: float
    failures: dict[str, int]
    ours_over_it: Figures | None = None


@dataclass(frozen=True)
class RowResult:
    """Results of one row. `deg` and `mm` are sylpose's errors per scene; `loop_ms` is the unit of time (WORSE_TIME)."""

    name: str
    ours: SolverResult
    peers: dict[str, list[SolverResult]]
    bound_depth_unknown: Figures
    bound_depth_known: Figures
    loop_ms: float
    deg: list[float]
    mm: list[float]

    @property
    def row(self) -> Row:
        """Parameters of the row."""
        return next(row for row in ROWS if row.name == self.name)


@dataclass(frozen=True)
class Results:
    """Results of a run. `first_call_s` is the time in a fresh process whose kernels an earlier one has compiled."""

    versions: dict[str, str]
    import_s: float
    first_call_s: float
    rows: list[RowResult]


def compute_figures(deg: Sequence[float] | FloatArray, mm: Sequence[float] | FloatArray) -> Figures:
    """Return the quantiles of errors, rounded as stored."""
    a, b, c = (_round(v) for v in np.quantile(deg, QUANTILES))
    d, e, f = (_round(v) for v in np.quantile(mm, QUANTILES))
    return Figures((a, b, c), (d, e, f))


def compute_ratio_limits(ours: Sequence[Sequence[float]], theirs: Sequence[Sequence[float]]) -> Figures:
    """Return lower limits of the ratios of sylpose's error quantiles to a peer's, on the same scenes (degrees, mm).

    They are the first percentiles of the ratios over resampled scenes (paired bootstrap). A value above 1 means that
    sylpose is worse by more than chance.
    """
    n = len(theirs[0])
    pick = np.random.default_rng(0).integers(n, size=(N_RESAMPLES, n))
    least = []
    for a, b in zip(ours, theirs, strict=True):
        ratios = [np.quantile(np.asarray(e)[:n][pick], QUANTILES, axis=1) for e in (a, b)]
        x, y, z = (_round(v) for v in np.quantile(ratios[0] / np.maximum(ratios[1], 1e-12), 0.01, axis=1))
        least.append((x, y, z))
    return Figures(*least)


def _round(value: float) -> float:
    return float(f"{value:.4g}")


def save(results: Results, path: Path) -> None:
    """Write the results as JSON, one row per line, so that changes of a committed file are readable."""
    head = msgspec.json.encode(replace(results, rows=[])).decode().removesuffix("]}")
    rows = ",\n".join(msgspec.json.encode(row).decode() for row in results.rows)
    path.write_text(f"{head}\n{rows}\n]}}\n")


def load(path: Path) -> Results:
    """Read results that `save` wrote.

    Raises:
        ValueError: the file cannot be read.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=Results)
    except (OSError, msgspec.DecodeError) as error:
        raise ValueError(f"{path}: not a file of results that this benchmark wrote ({error})") from None


class Comparison(NamedTuple):
    """One figure of sylpose compared with the better peer, on the scenes that both solved."""

    figure: str  # such as "median deg"
    own: float
    peer: float
    solver: str
    lower_limit: float  # lower confidence limit of the ratio of sylpose's figure to the peer's
    gain: float  # required ratio of the peer's figure to sylpose's
    floor_unknown: float  # the bounds, on all scenes
    floor_known: float

    @property
    def ratio(self) -> float:
        """Ratio of sylpose's figure to the peer's."""
        return self.own / max(self.peer, 1e-12)

    @property
    def is_missed(self) -> bool:
        """Return whether the target is missed; a tie is enough if no gain is required."""
        return self.ratio > (TIE_RATIO if self.gain == 1 else 1 / self.gain)

    @property
    def is_chance(self) -> bool:
        """Return whether other scenes of the row may reverse the result."""
        return self.lower_limit <= 1 / self.gain


def compare_with_peers(result: RowResult) -> list[Comparison]:
    """Compare the median and the 90th percentile of both errors with the best peer and options in each."""
    comparable = {
        solver: tried
        for solver, tried in result.peers.items()
        if all(t.scenes >= min(MIN_SCENES, result.ours.scenes) for t in tried)
        and any(2 * sum(t.failures.values()) <= t.scenes for t in tried)
    }
    out = []
    for unit in ("deg", "mm"):
        for q, (name, gain) in enumerate(zip(("median", "p90"), result.row.gain, strict=True)):
            candidates = []
            # A peer with few scenes only counts if no other solves the row, and only by its median.
            for solver, tried in (comparable or (result.peers if q == 0 else {})).items():
                for t in tried:
                    ours = compute_figures(result.deg[: t.scenes], result.mm[: t.scenes])
                    a, b = getattr(ours, unit)[q], getattr(t.figures, unit)[q]
                    least = getattr(t.ours_over_it, unit)[q] if t.ours_over_it else 0.0
                    floors = _bounds(result, unit, q)
                    candidates.append(Comparison(f"{name} {unit}", a, b, solver, least, gain, *floors))
            if candidates:
                out.append(max(candidates, key=lambda c: c.ratio))
    return out


def _bounds(result: RowResult, unit: str, q: int) -> tuple[float, float]:
    unknown, known = (getattr(b, unit)[q] for b in (result.bound_depth_unknown, result.bound_depth_known))
    return unknown, known


def format_verdict(result: RowResult) -> str:
    """Summarize a row by the figure in which sylpose is worst compared with the better peer."""
    found = compare_with_peers(result)
    if not found:
        return ""
    worst = max(found, key=lambda c: (c.lower_limit > 1, c.ratio))
    if worst.ratio > TIE_RATIO:
        word = "WORSE" if worst.lower_limit > 1 else "tie within chance,"
        return f"{word} x{worst.ratio:.2f} ({worst.figure}, {worst.solver})"
    return "tie" if worst.ratio > 1 / TIE_RATIO else f"better x{1 / worst.ratio:.2f}"


def make_table(results: Results, markdown: bool) -> Table:
    """Return the table of all rows."""
    solvers = [s for s in ("poselib", "pycolmap") if any(s in r.peers for r in results.rows)]
    of_solvers = [name for solver in ("sylpose", *solvers) for name in (f"{solver} deg", "mm", "ms")]
    out = _new_table(("row", *of_solvers, "bound deg", "mm", "sylpose / bound", "verdict"), markdown)
    for r in results.rows:
        cells = [r.name, *_own_cells(r)]
        for solver in solvers:
            cells += _format_cells(r, r.peers.get(solver, []))
        pose = r.row.problem == "pose"
        both = [r.bound_depth_known] if pose else [r.bound_depth_unknown, r.bound_depth_known]
        for unit in ("deg", "mm"):
            cells.append(" | ".join("/".join(f"{v:.2g}" for v in getattr(b, unit)[:2]) for b in both))
        cells.append(" | ".join(f"{r.ours.figures.deg[0] / b.deg[0]:.2f}" for b in both))
        # A bar inside a cell would end it in Markdown.
        out.add_row(*(cell.replace(" | ", "; ") for cell in cells), format_verdict(r))
    return out


def _own_cells(row: RowResult) -> list[str]:
    errors = ["/".join(f"{v:.2g}" for v in getattr(row.ours.figures, unit)) for unit in ("deg", "mm")]
    return [*errors, f"{row.ours.ms:.2f}"]


def _format_cells(row: RowResult, tried: Sequence[SolverResult]) -> list[str]:
    """Format errors and time: the best options per figure, and those of `select_fastest`."""
    if not tried:
        return ["", "", ""]
    cells = []
    for unit in ("deg", "mm"):
        best = [min(getattr(t.figures, unit)[q] for t in tried) for q in range(len(QUANTILES))]
        cells.append("/".join(f"{v:.2g}" for v in best))
    cells.append(f"{select_fastest(row, tried)[0].ms:.2f}")
    return cells


def find_misses(results: Results, by_chance: bool) -> list[str]:
    """Return a line for each row that misses its accuracy target, the largest miss first.

    Args:
        results: results of a run.
        by_chance: return the rows whose misses may all be chance; otherwise the other ones.
    """
    lines = []
    for r in results.rows:
        missed = [c for c in compare_with_peers(r) if c.is_missed]
        if not missed or all(c.is_chance for c in missed) != by_chance:
            continue
        figures = []
        for c in missed:
            bound = f"x{c.peer / c.floor_unknown:.2f}"
            if r.row.problem == "motion":
                bound += f", depths known x{c.peer / c.floor_known:.2f}"
            wanted = f", wanted x{c.gain:g}" if c.gain > 1 else ""
            chance = ", may be chance" if c.is_chance and not by_chance else ""
            against = f"{c.figure} {c.own:.3g} to {c.solver}'s {c.peer:.3g}"
            figures.append(f"{against}: x{1 / c.ratio:.2f} smaller{wanted} (bound {bound}{chance})")
        lines.append((max(c.ratio * c.gain for c in missed), f"{r.name}: " + "; ".join(figures)))
    return [line for _, line in sorted(lines, reverse=True)]


def is_as_accurate(row: RowResult, t: SolverResult) -> bool:
    """Return whether a peer's option set is as accurate as sylpose in a row, within chance.

    None of the medians and 90th percentiles of its errors is larger than sylpose's by more than resampling the scenes may
    change: the paired bootstrap interval of the ratio (`compute_ratio_limits`), symmetric in the logarithm, includes 1.
    """
    ours = compute_figures(row.deg[: t.scenes], row.mm[: t.scenes])
    if t.ours_over_it is None:
        return False
    for unit in ("deg", "mm"):
        for q in range(2):
            ratio = getattr(ours, unit)[q] / max(getattr(t.figures, unit)[q], 1e-12)
            if ratio**2 < getattr(t.ours_over_it, unit)[q]:
                return False
    return True


def select_fastest(row: RowResult, tried: Sequence[SolverResult]) -> tuple[SolverResult, bool]:
    """Return a peer's best option set for a row, and whether it is as accurate as sylpose there.

    It is the fastest of the sets that are as accurate (`is_as_accurate`); without one, the fastest whose medians and 90th
    percentiles are within 5 % (`TIE_RATIO`) of the peer's best, or else the set that comes nearest to these.
    """
    if good := [t for t in tried if is_as_accurate(row, t)]:
        return min(good, key=lambda t: t.ms), True
    best = {(u, q): min(getattr(t.figures, u)[q] for t in tried) for u in ("deg", "mm") for q in range(2)}

    def excess(t: SolverResult) -> float:
        return float(max(getattr(t.figures, u)[q] / max(value, 1e-12) for (u, q), value in best.items()))

    least = min(map(excess, tried))
    return min((t for t in tried if excess(t) <= max(TIE_RATIO, least)), key=lambda t: t.ms), False


def _select_rows(results: Results, problem: str) -> list[tuple[RowResult, list[SolverResult]]]:
    """Return the rows of a problem in which PoseLib finds a pose in half of the scenes or more."""
    rows = [(r, r.peers.get("poselib", [])) for r in results.rows if r.row.problem == problem]
    return [(r, tried) for r, tried in rows if any(2 * sum(t.failures.values()) <= t.scenes for t in tried)]


class Speed(NamedTuple):
    """PoseLib at its best setting for a row (`select_fastest`), and whether it is as accurate as sylpose there."""

    problem: str
    row: str
    ms: float
    peer: SolverResult
    is_as_accurate: bool

    @property
    def ratio(self) -> float:
        """PoseLib's time over sylpose's."""
        return self.peer.ms / self.ms


def compute_speeds(results: Results) -> list[Speed]:
    """Return the comparison of times for each row in which PoseLib finds poses, the least favorable to sylpose first."""
    rows = [(r, tried) for problem in ("motion", "pose") for r, tried in _select_rows(results, problem)]
    found = [Speed(r.row.problem, r.name, r.ours.ms, *select_fastest(r, tried)) for r, tried in rows]
    return sorted(found, key=lambda s: (s.problem, not s.is_as_accurate, s.ratio))


def make_speed_table(results: Results, markdown: bool) -> Table:
    """Return `compute_speeds` as a table; first, each problem's rows in which PoseLib is as accurate, in one line."""
    found = compute_speeds(results)
    out = _new_table(("row", "sylpose ms", "PoseLib ms", "ratio", "as accurate", "its setting"), markdown)
    for problem in dict.fromkeys(s.problem for s in found):
        rows = [s for s in found if s.problem == problem]
        if ratios := [s.ratio for s in rows if s.is_as_accurate]:
            figures = f"median {np.median(ratios):.2f}, {min(ratios):.2f} to {max(ratios):.2f}"
            out.add_row(f"{problem}", "", "", figures, f"{len(ratios)} of {len(rows)} rows", "best for each row")
    for s in found:
        out.add_row(
            s.row,
            f"{s.ms:.2f}",
            f"{s.peer.ms:.2f}",
            f"{s.ratio:.2f}",
            "yes" if s.is_as_accurate else "no setting",
            s.peer.options,
        )
    return out


def make_setting_table(results: Results, markdown: bool) -> Table:
    """Return `compute_settings` as a table: PoseLib over sylpose, medians of the rows."""
    header = ("problem, PoseLib's setting", "time", "median deg", "median mm", "p90 deg", "p90 mm", "as accurate in")
    out = _new_table(header, markdown)
    for s in compute_settings(results):
        ratios = (s.time, *s.errors, *s.tails)
        out.add_row(f"{s.problem}, {s.options}", *(f"{v:.2f}" for v in ratios), f"{s.as_accurate} of {s.rows} rows")
    return out


def _new_table(header: Sequence[str], markdown: bool) -> Table:
    out = Table(box=box.MARKDOWN if markdown else box.SIMPLE)
    for k, name in enumerate(header):
        out.add_column(name, justify="left" if k == 0 else "right", no_wrap=True)
    return out


class Setting(NamedTuple):
    """One of PoseLib's option sets over all rows of a problem.

    Attributes:
        time: its time over ours, median of the rows.
        errors: its median errors over ours on the same scenes, median of the rows: rotation, center.
        tails: the same of the 90th percentiles.
        rows, as_accurate: number of rows, and of those in which it is as accurate (`is_as_accurate`).
    """

    problem: str
    options: str
    time: float
    errors: tuple[float, float]
    tails: tuple[float, float]
    rows: int
    as_accurate: int


def compute_settings(results: Results) -> Iterator[Setting]:
    """Yield every option set of PoseLib, per problem, the fastest first."""
    for problem in ("motion", "pose"):
        found: dict[str, list[tuple[float, list[float], bool]]] = {}
        for r, tried in _select_rows(results, problem):
            for t in tried:
                ours = compute_figures(r.deg[: t.scenes], r.mm[: t.scenes])
                errors = [
                    getattr(t.figures, u)[q] / max(getattr(ours, u)[q], 1e-12) for q in range(2) for u in ("deg", "mm")
                ]
                found.setdefault(t.options, []).append((t.ms / r.ours.ms, errors, is_as_accurate(r, t)))
        out = []
        for options, rows in found.items():
            a, b, c, d = (float(v) for v in np.median([errors for _, errors, _ in rows], axis=0))
            time = float(np.median([ratio for ratio, *_ in rows]))
            good = sum(is_good for *_, is_good in rows)
            out.append(Setting(problem, options, time, (a, b), (c, d), len(rows), good))
        yield from sorted(out, key=lambda s: s.time)


def find_slow_rows(results: Results) -> Iterator[str]:
    """Yield a line for each missed target of speed: cost linear in cameras and matches, a quick first call."""
    ms = {r.name: r.ours.ms for r in results.rows}
    for small, large, factor in GROWTH:
        if small in ms and large in ms and ms[large] > MAX_LINEAR_RATIO * factor * ms[small]:
            yield f"{large}: x{ms[large] / ms[small]:.1f} the time of {small!r}, for x{factor:.1f} the data"
    if results.first_call_s > 1.0:
        yield f"the first call of a fresh process takes {results.first_call_s:.2f} s (wanted: 1 s at most)"


def find_failures(results: Results) -> Iterator[str]:
    """Yield a line for each solver that returned no pose in some scenes of a row."""
    for r in results.rows:
        for solver, tried in {"sylpose": [r.ours], **r.peers}.items():
            for t in tried:
                if t.failures:
                    how = ", ".join(f"{count} {why}" for why, count in t.failures.items())
                    yield f"{r.name}: {solver}{' (' + t.options + ')' if t.options else ''}: {how} of {t.scenes}"


def find_regressions(results: Results, baseline: Results) -> Iterator[str]:
    """Yield a sentence for each figure that is worse than in the baseline on the same scenes.

    The 99th percentile does not count, since it is a single scene of 100.
    """
    before = {r.name: r for r in baseline.rows}
    for now in results.rows:
        old = before.get(now.name)
        if old is None:
            continue
        n = min(len(now.deg), len(old.deg))
        new_figures, old_figures = (compute_figures(r.deg[:n], r.mm[:n]) for r in (now, old))
        for unit in ("deg", "mm"):
            for q, name in enumerate(("median", "p90")):
                a, b = getattr(new_figures, unit)[q], getattr(old_figures, unit)[q]
                if a > WORSE_ERROR * b:
                    yield f"{now.name}: {name} {unit} {a:.3g}, baseline {b:.3g} (over the first {n} scenes)"
        failed = [sum(deg >= FAILED_DEG for deg in r.deg[:n]) for r in (now, old)]
        if failed[0] > failed[1]:
            yield f"{now.name}: {failed[0]} of {n} scenes without a pose, baseline {failed[1]}"
        a, b = now.ours.ms / now.loop_ms, old.ours.ms / old.loop_ms
        if a > WORSE_TIME * b:
            yield f"{now.name}: {a / b:.2f} times the baseline's time ({now.ours.ms:.2f} ms here)"
