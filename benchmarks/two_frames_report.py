"""Results of the two-frame benchmark: their file, the table, what misses its target, what got worse than a baseline."""

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
    "Speed",
    "Tried",
    "failures",
    "fastest_as_good",
    "figures_of",
    "least_ratios",
    "load",
    "misses",
    "save",
    "setting_table",
    "settings",
    "speed_table",
    "speeds",
    "table",
    "too_slow",
    "worse_than",
]


# Median, 90th and 99th percentile.
QUANTILES = (0.5, 0.9, 0.99)
# A failure counts as an error of this size.
FAILED_DEG, FAILED_MM = 180.0, 1000.0
# Errors within this share of each other are a tie.
TIE = 1.05
# A peer too slow to solve at least so many scenes is shown, but not judged where another peer is.
ENOUGH_SCENES = 20
RESAMPLES = 400
# What counts as worse than the baseline: errors of the same scenes; time, in units of a loop that is timed beside it.
WORSE_ERROR, WORSE_TIME = 1.1, 1.4
# More than the cost per camera or per match may grow, when there are more of them, by no more than this.
LINEAR = 1.25
GROWTH = (
    ("base: ring of 4, 60 matches", "16 cameras", 4.0),
    ("16 cameras", "64 x 60", 4.0),
    ("base: ring of 4, 60 matches", "4 x 800", 800 / 60),
    ("pose: ring of 4, 60 points", "pose: 4 x 800", 800 / 60),
)


class Figures(NamedTuple):
    """Quantiles (median, p90, p99) of the rotation error (degrees) and of the centre's displacement (mm)."""

    deg: tuple[float, float, float]
    mm: tuple[float, float, float]


@dataclass(frozen=True)
class Tried:
    """One solver with one set of options, on the first `scenes` scenes of a row: errors, median time, failures.

    `ours_over_it`: our figures over its, on those scenes; the least that chance leaves of it (`least_ratios`).
    """

    options: str
    scenes: int
    figures: Figures
    ms: float
    failures: dict[str, int]
    ours_over_it: Figures | None = None


@dataclass(frozen=True)
class RowResult:
    """Everything about one row. `deg` and `mm` are ours, scene by scene; `loop_ms` is the unit of time (see WORSE_TIME)."""

    name: str
    ours: Tried
    peers: dict[str, list[Tried]]
    bound_depth_unknown: Figures
    bound_depth_known: Figures
    loop_ms: float
    deg: list[float]
    mm: list[float]

    @property
    def row(self) -> Row:
        """What the row is made of."""
        return next(row for row in ROWS if row.name == self.name)


@dataclass(frozen=True)
class Results:
    """A run of the benchmark. `first_call_s`: of a fresh process, its kernels compiled and cached by an earlier one."""

    versions: dict[str, str]
    import_s: float
    first_call_s: float
    rows: list[RowResult]


def figures_of(deg: Sequence[float] | FloatArray, mm: Sequence[float] | FloatArray) -> Figures:
    """Quantiles of errors, rounded as they are stored."""
    a, b, c = (_short(v) for v in np.quantile(deg, QUANTILES))
    d, e, f = (_short(v) for v in np.quantile(mm, QUANTILES))
    return Figures((a, b, c), (d, e, f))


def least_ratios(ours: Sequence[Sequence[float]], theirs: Sequence[Sequence[float]]) -> Figures:
    """Quantiles of ours over theirs, of errors (degrees, mm) of the same scenes: the first percentile of each ratio when the
    scenes are resampled (paired bootstrap). Where it is above 1, ours is worse by more than chance."""
    n = len(theirs[0])
    pick = np.random.default_rng(0).integers(n, size=(RESAMPLES, n))
    least = []
    for a, b in zip(ours, theirs, strict=True):
        ratios = [np.quantile(np.asarray(e)[:n][pick], QUANTILES, axis=1) for e in (a, b)]
        x, y, z = (_short(v) for v in np.quantile(ratios[0] / np.maximum(ratios[1], 1e-12), 0.01, axis=1))
        least.append((x, y, z))
    return Figures(*least)


def _short(value: float) -> float:
    return float(f"{value:.4g}")


def save(results: Results, path: Path) -> None:
    """JSON, one row a line, so that changes of a committed file can be read."""
    head = msgspec.json.encode(replace(results, rows=[])).decode().removesuffix("]}")
    rows = ",\n".join(msgspec.json.encode(row).decode() for row in results.rows)
    path.write_text(f"{head}\n{rows}\n]}}\n")


def load(path: Path) -> Results:
    """The results that `save` wrote.

    Raises:
        ValueError: a file that is not there or is something else.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=Results)
    except (OSError, msgspec.DecodeError) as error:
        raise ValueError(f"{path}: not a file of results that this benchmark wrote ({error})") from None


class Comparison(NamedTuple):
    """One figure of ours beside that of the better peer, on the scenes that both solved."""

    what: str  # "median degrees" and so on
    ours: float
    peer: float
    solver: str
    least: float  # what chance leaves of the ratio of ours to the peer's
    gain: float  # how many times smaller ours shall be
    floor_unknown: float  # the bounds, on all scenes
    floor_known: float

    @property
    def ratio(self) -> float:
        """Ours over the peer's."""
        return self.ours / max(self.peer, 1e-12)

    @property
    def missed(self) -> bool:
        """A tie is enough where no gain is wanted."""
        return self.ratio > (TIE if self.gain == 1 else 1 / self.gain)

    @property
    def by_chance(self) -> bool:
        """Whether other scenes of the same row might well show it otherwise."""
        return self.least <= 1 / self.gain


def comparisons(result: RowResult) -> list[Comparison]:
    """Median and 90th percentile of both errors, each against the peer and options that do best in it."""
    judged = {
        solver: tried
        for solver, tried in result.peers.items()
        if all(t.scenes >= min(ENOUGH_SCENES, result.ours.scenes) for t in tried)
        and any(2 * sum(t.failures.values()) <= t.scenes for t in tried)
    }
    out = []
    for unit in ("deg", "mm"):
        for q, (name, gain) in enumerate(zip(("median", "p90"), result.row.gain, strict=True)):
            rivals = []
            # A peer on few scenes is judged only where no other copes with the row, and by its median.
            for solver, tried in (judged or (result.peers if q == 0 else {})).items():
                for t in tried:
                    ours = figures_of(result.deg[: t.scenes], result.mm[: t.scenes])
                    a, b = getattr(ours, unit)[q], getattr(t.figures, unit)[q]
                    least = getattr(t.ours_over_it, unit)[q] if t.ours_over_it else 0.0
                    floors = _floors(result, unit, q)
                    rivals.append(Comparison(f"{name} {unit}", a, b, solver, least, gain, *floors))
            if rivals:
                out.append(max(rivals, key=lambda c: c.ratio))
    return out


def _floors(result: RowResult, unit: str, q: int) -> tuple[float, float]:
    unknown, known = (getattr(b, unit)[q] for b in (result.bound_depth_unknown, result.bound_depth_known))
    return unknown, known


def verdict(result: RowResult) -> str:
    """In a word: the figure of ours that does worst against the better peer."""
    found = comparisons(result)
    if not found:
        return ""
    worst = max(found, key=lambda c: (c.least > 1, c.ratio))
    if worst.ratio > TIE:
        word = "WORSE" if worst.least > 1 else "tie within chance,"
        return f"{word} x{worst.ratio:.2f} ({worst.what}, {worst.solver})"
    return "tie" if worst.ratio > 1 / TIE else f"better x{1 / worst.ratio:.2f}"


def table(results: Results, markdown: bool) -> Table:
    """One line per row."""
    solvers = [s for s in ("poselib", "pycolmap") if any(s in r.peers for r in results.rows)]
    out = Table(box=box.MARKDOWN if markdown else box.SIMPLE)
    out.add_column("row", no_wrap=True)
    for solver in ("ours", *solvers):
        for what in (f"{solver} deg", "mm", "ms"):
            out.add_column(what, justify="right", no_wrap=True)
    out.add_column("bound deg", justify="right", no_wrap=True)
    out.add_column("mm", justify="right", no_wrap=True)
    out.add_column("ours / bound", justify="right", no_wrap=True)
    out.add_column("verdict", no_wrap=True)
    for r in results.rows:
        cells = [r.name, *_cells(r.ours, [r.ours])]
        for solver in solvers:
            cells += _cells(r.ours, r.peers.get(solver, []))
        pose = r.row.problem == "pose"
        both = [r.bound_depth_known] if pose else [r.bound_depth_unknown, r.bound_depth_known]
        for unit in ("deg", "mm"):
            cells.append(" | ".join("/".join(f"{v:.2g}" for v in getattr(b, unit)[:2]) for b in both))
        cells.append(" | ".join(f"{r.ours.figures.deg[0] / b.deg[0]:.2f}" for b in both))
        # A bar inside a cell would end it in Markdown.
        out.add_row(*(cell.replace(" | ", "; ") for cell in cells), verdict(r))
    return out


def _cells(ours: Tried, tried: Sequence[Tried]) -> list[str]:
    """Errors and time: per figure the best options, and the fastest that are about as good (`fastest_as_good`)."""
    if not tried:
        return ["", "", ""]
    cells = []
    for unit in ("deg", "mm"):
        best = [min(getattr(t.figures, unit)[q] for t in tried) for q in range(len(QUANTILES))]
        cells.append("/".join(f"{v:.2g}" for v in best))
    cells.append(f"{fastest_as_good(ours, tried).ms:.2f}")
    return cells


def misses(results: Results, by_chance: bool) -> list[str]:
    """A line for each row that misses its target (issue 4, items 2, 3 and 6): first the one that misses most.

    Args:
        by_chance: the rows none of whose figures misses it by more than chance; else all others.
    """
    lines = []
    for r in results.rows:
        missed = [c for c in comparisons(r) if c.missed]
        if not missed or all(c.by_chance for c in missed) != by_chance:
            continue
        figures = []
        for c in missed:
            bound = f"x{c.peer / c.floor_unknown:.2f}"
            if r.row.problem == "motion":
                bound += f", depths known x{c.peer / c.floor_known:.2f}"
            wanted = f", wanted x{c.gain:g}" if c.gain > 1 else ""
            chance = ", may be chance" if c.by_chance and not by_chance else ""
            against = f"{c.what} {c.ours:.3g} to {c.solver}'s {c.peer:.3g}"
            figures.append(f"{against}: x{1 / c.ratio:.2f} smaller{wanted} (bound {bound}{chance})")
        lines.append((max(c.ratio * c.gain for c in missed), f"{r.name}: " + "; ".join(figures)))
    return [line for _, line in sorted(lines, reverse=True)]


def fastest_as_good(ours: Tried, tried: Sequence[Tried]) -> Tried:
    """Return a peer's fastest option set that is as accurate as sylpose, or else as accurate as the peer can be.

    As accurate: medians and 90th percentiles of both errors within 5 % (`TIE`) of sylpose's or, where no option set reaches
    these, of the best of all its option sets in each figure; where none does that either, the set that comes nearest.
    """
    figures = [(u, q) for u in ("deg", "mm") for q in range(2)]
    best = {(u, q): min(getattr(t.figures, u)[q] for t in tried) for u, q in figures}
    enough = {(u, q): max(value, getattr(ours.figures, u)[q]) for (u, q), value in best.items()}

    def excess(t: Tried) -> float:
        return float(max(getattr(t.figures, u)[q] / max(value, 1e-12) for (u, q), value in enough.items()))

    least = min(map(excess, tried))
    return min((t for t in tried if excess(t) <= max(TIE, least)), key=lambda t: t.ms)


def _rows_of(results: Results, problem: str) -> list[tuple[RowResult, list[Tried]]]:
    """The rows of a problem in which PoseLib finds a pose in half of the scenes or more."""
    rows = [(r, r.peers.get("poselib", [])) for r in results.rows if r.row.problem == problem]
    return [(r, tried) for r, tried in rows if any(2 * sum(t.failures.values()) <= t.scenes for t in tried)]


class Speed(NamedTuple):
    """PoseLib at its best setting for a row (`fastest_as_good`) and its time over sylpose's."""

    problem: str
    row: str
    ms: float
    peer: Tried

    @property
    def ratio(self) -> float:
        """PoseLib's time over sylpose's."""
        return self.peer.ms / self.ms


def speeds(results: Results) -> list[Speed]:
    """Return the comparison of times for each row in which PoseLib finds poses, the least favorable to sylpose first."""
    rows = [(r, tried) for problem in ("motion", "pose") for r, tried in _rows_of(results, problem)]
    found = [Speed(r.row.problem, r.name, r.ours.ms, fastest_as_good(r.ours, tried)) for r, tried in rows]
    return sorted(found, key=lambda s: (s.problem, s.ratio))


def speed_table(results: Results, markdown: bool) -> Table:
    """Return `speeds` as a table, after a line with the median and the least ratio of each problem."""
    found = speeds(results)
    out = _new_table(("row", "sylpose ms", "PoseLib ms", "ratio", "its setting"), markdown)
    for problem in dict.fromkeys(s.problem for s in found):
        ratios = [s.ratio for s in found if s.problem == problem]
        middle, least = np.median(ratios), min(ratios)
        out.add_row(
            f"{problem}, {len(ratios)} rows", "", "", f"median {middle:.2f}, least {least:.2f}", "best for each row"
        )
    for s in found:
        out.add_row(s.row, f"{s.ms:.2f}", f"{s.peer.ms:.2f}", f"{s.ratio:.2f}", s.peer.options)
    return out


def setting_table(results: Results, markdown: bool) -> Table:
    """Return `settings` as a table: PoseLib over sylpose, medians of the rows."""
    header = ("problem, PoseLib's setting", "time", "median deg", "median mm", "p90 deg", "p90 mm", "as accurate in")
    out = _new_table(header, markdown)
    for s in settings(results):
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
        rows, as_accurate: number of rows, and of those in which it is as accurate as sylpose within 5 %.
    """

    problem: str
    options: str
    time: float
    errors: tuple[float, float]
    tails: tuple[float, float]
    rows: int
    as_accurate: int


def settings(results: Results) -> Iterator[Setting]:
    """Yield every option set of PoseLib, per problem, the fastest first."""
    for problem in ("motion", "pose"):
        found: dict[str, list[tuple[float, list[float]]]] = {}
        for r, tried in _rows_of(results, problem):
            for t in tried:
                ours = figures_of(r.deg[: t.scenes], r.mm[: t.scenes])
                errors = [
                    getattr(t.figures, u)[q] / max(getattr(ours, u)[q], 1e-12) for q in range(2) for u in ("deg", "mm")
                ]
                found.setdefault(t.options, []).append((t.ms / r.ours.ms, errors))
        out = []
        for options, rows in found.items():
            a, b, c, d = (float(v) for v in np.median([errors for _, errors in rows], axis=0))
            time = float(np.median([ratio for ratio, _ in rows]))
            good = sum(max(errors) <= TIE for _, errors in rows)
            out.append(Setting(problem, options, time, (a, b), (c, d), len(rows), good))
        yield from sorted(out, key=lambda s: s.time)


def too_slow(results: Results) -> Iterator[str]:
    """Yield a line for each missed target of speed: cost linear in cameras and matches, a quick first call."""
    ms = {r.name: r.ours.ms for r in results.rows}
    for small, large, factor in GROWTH:
        if small in ms and large in ms and ms[large] > LINEAR * factor * ms[small]:
            yield f"{large}: x{ms[large] / ms[small]:.1f} the time of {small!r}, for x{factor:.1f} the data"
    if results.first_call_s > 1.0:
        yield f"the first call of a fresh process takes {results.first_call_s:.2f} s (wanted: 1 s at most)"


def failures(results: Results) -> Iterator[str]:
    """A line for each solver that gave no pose somewhere in a row."""
    for r in results.rows:
        for solver, tried in {"ours": [r.ours], **r.peers}.items():
            for t in tried:
                if t.failures:
                    how = ", ".join(f"{count} {why}" for why, count in t.failures.items())
                    yield f"{r.name}: {solver}{' (' + t.options + ')' if t.options else ''}: {how} of {t.scenes}"


def worse_than(results: Results, baseline: Results) -> Iterator[str]:
    """A sentence for each figure that got worse than the baseline's on the same scenes.

    The 99th percentile is left out: of 100 scenes, it is one scene's luck.
    """
    before = {r.name: r for r in baseline.rows}
    for now in results.rows:
        old = before.get(now.name)
        if old is None:
            continue
        n = min(len(now.deg), len(old.deg))
        new_figures, old_figures = (figures_of(r.deg[:n], r.mm[:n]) for r in (now, old))
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
