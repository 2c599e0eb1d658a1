"""Files of a certificate: certificate.html for people, certificate.json and certificate.csv for programs."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sylpose import __version__
from sylpose.atomic_io import make_output_folder, replace_atomically
from sylpose.display import format_length
from sylpose.geometry.arrays import FloatArray
from sylpose.io.capture import Session
from sylpose.report.page import escape_html
from sylpose.report.plots import choose_length_unit
from sylpose.report.static_page import StaticPage, render_figure, render_notice, render_section, render_table
from sylpose.runs.certify import (
    POSITION,
    ROTATION,
    Agreement,
    BarTest,
    Certificate,
    ConsistencyTest,
    Estimate,
    SessionCertificate,
)
from sylpose.runs.checkpoint import compute_fingerprint

CERTIFICATE_FILES = ("certificate.html", "certificate.json", "certificate.csv")
# Size of a chart, and its margins left and below, in its own units.
WIDTH, HEIGHT, LEFT, BOTTOM = 560, 220, 52, 24
# Colors of the parts, visible on light and dark pages (Okabe & Ito); the cameras' own colors mean single cameras.
PART_COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7", "#8A8A8A")
# Intervals between ticks, at most (choice).
MAX_INTERVALS = 5

# What a test sees, and what it cannot see.
LIMITS = {
    "parts": (
        "Parts of the cameras",
        "image noise, mismatches and drift; errors of calibration, lens and timing that differ between cameras",
        "what all cameras share: a wrong scale of the rig, a common error of focal length or clock, rolling shutter in the "
        "same direction, an object that deforms, another body that all cameras follow",
    ),
    "direction": (
        "Forwards against backwards",
        "mismatches and drift, dependence on where tracking begins",
        "whatever is the same in both directions: calibration, lenses, timing, and most of the noise of the images; it is "
        "a lower bound of the error",
    ),
    "stated": (
        "Factor on the stated standard deviations",
        "the size of the stated standard deviations, on average over the frames, against the differences of the parts",
        "as parts of the cameras; whether single frames are worse than stated",
    ),
    "bar": (
        "Stiff bar",
        "errors that differ between the two ends or change with place and direction: drift, noise, distortion",
        "a constant wrong length (there is no reference length), errors that are the same at both ends",
    ),
}
# How certificates compared with known motions (measured: benchmarks/certify.py --seeds 10:12).
VALIDATION = (
    "Certificates of 34 rendered recordings with known motion: the certified rms error was at least 0.49 of the true one, "
    "2.4 (rotation) and 2.9 (position) times it in the median, and the 95 % bound was above it in 59 of 61 cases."
)


def write_certificate(certificate: SessionCertificate, session: Session, folder: Path) -> list[Path]:
    """Write the page, the numbers and the differences of all frames; return the files.

    Args:
        certificate: of the session.
        session: the recording.
        folder: created if missing; earlier files in it are replaced.

    Raises:
        OSError: a file cannot be written; the message names it.
    """
    files = [make_output_folder(folder) / name for name in CERTIFICATE_FILES]
    facts = {"recording": session.path.resolve().name, "created": datetime.now(UTC).isoformat(timespec="minutes")}
    facts |= {"sylpose": __version__, "calibration": compute_fingerprint(session)["calibration"]}
    with (
        replace_atomically(files[0]) as page,
        replace_atomically(files[1]) as content,
        replace_atomically(files[2]) as table,
    ):
        page.write_text(render_certificate(certificate, facts), encoding="utf-8", newline="\n")
        content.write_text(json.dumps(facts | build_certificate_json(certificate), indent=1) + "\n", encoding="utf-8")
        with table.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file).writerows(build_difference_rows(certificate))
    return files


# --- numbers --------------------------------------------------------------------------------------------------------------


def build_certificate_json(certificate: SessionCertificate) -> dict[str, Any]:
    """Return all numbers, angles in degrees and lengths in the unit; null for what is unknown."""
    content: dict[str, Any] = {"objects": [_object_json(item) for item in certificate.objects], "bar": None}
    if (bar := certificate.bar) is not None:
        content["bar"] = {
            "objects": [bar.a, bar.b],
            "frames": len(bar.index),
            "coverage": bar.coverage,
            "mean_length": bar.length,
            "length_deviation": bar.length_statistics,
            "rotation_deviation_deg": {key: math.degrees(value) for key, value in bar.rotation_statistics.items()},
            "extent": bar.extent.tolist(),
            "turn_deg": math.degrees(bar.turn),
        }
    limits = {name: {"test": test, "sees": sees, "cannot_see": cannot} for name, (test, sees, cannot) in LIMITS.items()}
    return content | {"limits": limits, "validation": VALIDATION, "problems": [*certificate.problems]}


def _object_json(item: Certificate) -> dict[str, Any]:
    return {
        "object": item.name,
        "unit": item.unit,
        "cameras": [*item.cameras],
        "frames": item.n_frames,
        "measured": item.n_measured,
        "turn_deg": math.degrees(item.turn),
        "path": item.path,
        "stated_sd": {"rotation_deg": _number(math.degrees(item.stated[0])), "position": _number(item.stated[1])},
        "rotation_deg": _estimate_json(item.rotation, math.degrees(1.0)),
        "position": _estimate_json(item.position, 1.0),
        "tests": [_test_json(test) for test in item.tests],
        "remarks": [*item.remarks],
    }


def _estimate_json(estimate: Estimate | None, scale: float) -> dict[str, Any] | None:
    if estimate is None:
        return None
    return {
        "error": scale * estimate.error,
        "bound_95": scale * estimate.bound,
        "is_lower_bound": estimate.is_lower_bound,
        "largest": scale * estimate.largest,
        "factor": _number(estimate.factor),
        "factor_95": [_number(value) for value in estimate.factor_interval],
        "degrees_of_freedom": estimate.freedom,
        "independent_frames": estimate.n_effective,
        "basis": estimate.basis,
    }


def _test_json(test: ConsistencyTest) -> dict[str, Any]:
    content: dict[str, Any] = {"kind": test.kind, "a": test.a, "b": test.b, "coverage": test.coverage}
    for name, agreement, scale in (
        ("rotation_deg", test.rotation, math.degrees(1.0)),
        ("position", test.position, 1.0),
    ):
        content[name] = agreement and {
            "difference": scale * agreement.difference,
            "error": scale * agreement.error,
            "largest": scale * agreement.largest,
            "factor": _number(agreement.factor),
            "in_bounds": _number(agreement.in_bounds),
            "independent_frames": agreement.n_effective,
            "degrees_of_freedom": agreement.freedom,
        }
    return content | {"reason": test.reason}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def build_difference_rows(certificate: SessionCertificate) -> list[list[str]]:
    """Return the rows of certificate.csv: a header, then each frame of each test, and of the bar.

    Differences are in degrees and length units; standard deviations are those stated for the two results.
    """
    axes = "xyz"
    header = ["object", "test", "a", "b", "frame", "time", *(f"w{axis}_deg" for axis in axes)]
    header += [*(f"d{axis}" for axis in axes), "a_sd_deg", "b_sd_deg", "a_sd", "b_sd"]
    rows = [header]
    for item in certificate.objects:
        for test in item.tests:
            if (found := test.differences) is None:
                continue
            sds = [
                scale * _sizes(covariance, part)
                for part, scale in ((ROTATION, math.degrees(1.0)), (POSITION, 1.0))
                for covariance in (found.covariance_a, found.covariance_b)
            ]
            table = np.column_stack([np.degrees(found.rotation), found.position, *sds])
            for k, time, row in zip(found.index, found.times, table, strict=True):
                cells = [f"{value:.6g}" if math.isfinite(value) else "" for value in row]
                rows.append([item.name, test.kind, test.a, test.b, str(k), f"{time:.6f}", *cells])
    if (bar := certificate.bar) is not None:
        for k, time, length, turn in zip(
            bar.index, bar.times, bar.length_deviations, bar.rotation_deviations, strict=True
        ):
            cells = [f"{math.degrees(turn):.6g}", "", "", f"{length:.6g}", *[""] * 6]
            rows.append(["", "bar", bar.a, bar.b, str(k), f"{time:.6f}", *cells])
    return rows


def _sizes(covariance: FloatArray, part: slice) -> FloatArray:
    return np.asarray(np.sqrt(np.trace(covariance[:, part, part], axis1=1, axis2=2)))


# --- texts ----------------------------------------------------------------------------------------------------------------


class Quantity(NamedTuple):
    """A quantity with its accuracy, and how its values are shown.

    Attributes:
        name: "rotation" or "position".
        estimate: its accuracy, None if it is unknown.
        scale: factor from radians or length units to what is shown.
        unit: its unit.
    """

    name: str
    estimate: Estimate | None
    scale: float
    unit: str

    def format(self, value: float) -> str:
        """Format a value with its unit, to two significant digits."""
        return f"{self.format_number(value)}{'' if self.unit == '°' else ' '}{self.unit}"

    def format_number(self, value: float) -> str:
        """Format a value without its unit, to two significant digits."""
        return format_number(self.scale * value)


def list_quantities(item: Certificate) -> tuple[Quantity, Quantity]:
    """Return rotation and position of an object."""
    largest = item.position.bound if item.position is not None else 0.0
    scale, unit = choose_length_unit(largest, item.unit)
    return (
        Quantity("rotation", item.rotation, math.degrees(1.0), "°"),
        Quantity("position", item.position, scale, unit),
    )


def format_number(value: float) -> str:
    """Format a number to two significant digits; "-" if it is unknown."""
    if not math.isfinite(value):
        return "-"
    decimals = min(max(1 - math.floor(math.log10(abs(value))), 0), 9) if value else 0
    return f"{value:.{decimals}f}"


def format_error(quantity: Quantity) -> tuple[str, str]:
    """Format an error, and what it is."""
    if (estimate := quantity.estimate) is None:
        return "not certified", "no test determines it"
    if estimate.is_lower_bound:
        return f"at least {quantity.format(estimate.error)}", "not certified: repeatability only, a lower bound"
    bound, largest = quantity.format(estimate.bound), quantity.format(estimate.largest)
    text = f"rms; 95 % upper bound {bound}; largest in a frame {largest}"
    if estimate.basis == "direction":
        text += "; from the difference between forwards and backwards"
    return quantity.format(estimate.error), text


def format_factor(estimate: Estimate | None) -> tuple[str, str]:
    """Format the factor on standard deviations, and its interval."""
    if estimate is None or not math.isfinite(estimate.factor):
        return "not certified", "no part of the cameras determines the factor"
    low, high = map(format_number, estimate.factor_interval)
    frames = format_number(estimate.n_effective)
    text = f"multiply the stated ones by this; 95 %: {low} to {high}, from {frames} independent frames"
    return f"× {format_number(estimate.factor)}", text


def describe_accuracy(item: Certificate) -> str:
    """Return one sentence on the accuracy of an object's result."""
    quantities = list_quantities(item)
    errors = [
        f"{q.format(q.estimate.error)} in {q.name}"
        for q in quantities
        if q.estimate is not None and not q.estimate.is_lower_bound
    ]
    if not errors:
        return "Nothing is certified: no part of the cameras followed the object."
    missing = [q.name for q in quantities if q.estimate is None or q.estimate.is_lower_bound]
    rest = f" {missing[0].capitalize()} is not certified." if missing else ""
    lost = item.n_frames - item.n_measured
    where = f" in the {item.n_measured} of {item.n_frames} frames that have a pose" if lost else ""
    return (
        f"The motion since the first frame is accurate to {' and '.join(errors)} (rms){where}, apart from errors that all "
        f"cameras share.{rest}"
    )


def describe_for_paper(certificate: SessionCertificate) -> list[str]:
    """Return a text for a paper: a paragraph per object, and one on the bar."""
    paragraphs = []
    for item in certificate.objects:
        of = f" of {item.name}" if len(certificate.objects) > 1 else ""
        sentences = [
            f"Poses{of} were measured with sylpose {__version__} from {_count(len(item.cameras), 'camera')}; "
            f"{item.n_measured} of {item.n_frames} frames had a measured pose."
        ]
        parts = sum(test.kind == "part" and test.rotation is not None for test in item.tests)
        errors, factors = list[str](), list[str]()
        for quantity in list_quantities(item):
            if (estimate := quantity.estimate) is None or estimate.is_lower_bound:
                continue
            errors.append(
                f"{quantity.format(estimate.error)} in {quantity.name} (rms; 95 % upper bound "
                f"{quantity.format(estimate.bound)}, {format_number(estimate.n_effective)} effectively independent frames)"
            )
            low, high = map(format_number, estimate.factor_interval)
            factors.append(f"{format_number(estimate.factor)} ({quantity.name}; 95 %: {low} to {high})")
        if errors:
            sentences += [
                f"The error of the motion since the first frame was {' and '.join(errors)}, estimated from the recording "
                f"itself by tracking it with {_count(parts, 'part')} of the cameras (jackknife) and backwards.",
                "The estimate excludes errors that all cameras share, such as a wrong scale of the calibration.",
                f"Stated standard deviations were multiplied by {' and '.join(factors)}.",
            ]
        else:
            sentences.append("Its accuracy could not be certified.")
        paragraphs.append(" ".join(sentences))
    if (bar := certificate.bar) is not None:
        (_, *lengths), (_, *angles) = build_bar_rows(bar, certificate.objects[0].unit)
        paragraphs.append(
            f"The relative pose of two objects on a stiff bar (ASTM E3064, {len(bar.index)} frames) deviated from its "
            f"mean by {lengths[0]} and {angles[0]} (rms), {lengths[1]} and {angles[1]} (maximum), {lengths[2]} and "
            f"{angles[2]} (99.7th percentile)."
        )
    return paragraphs


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}{'' if n == 1 else 's'}"


# --- page -----------------------------------------------------------------------------------------------------------------


def render_certificate(certificate: SessionCertificate, facts: dict[str, str]) -> str:
    """Render the page as HTML text.

    Args:
        certificate: of a recording.
        facts: "recording", "created", "sylpose" and "calibration".
    """
    remarks = [text for item in certificate.objects for text in item.remarks]
    kinds = ["parts", "direction", "stated"] + ["bar"] * (certificate.bar is not None)
    limits = render_table(("test", "sees", "cannot see"), [LIMITS[kind] for kind in kinds], numbers=0)
    paper = "".join(f'<p class="paper">{escape_html(text)}</p>' for text in describe_for_paper(certificate))
    body = [_render_object(item, is_named=len(certificate.objects) > 1) for item in certificate.objects]
    if certificate.bar is not None:
        body.append(_render_bar(certificate.bar, certificate.objects[0].unit))
    body.append(render_section("What each number rests on, and what it cannot see", limits, VALIDATION))
    body.append(render_section("Text for a paper", paper))
    note = (
        "Errors are those of the motion since the first frame with a pose, rotation in world axes and position of the "
        "object's center. certificate.json has all numbers, certificate.csv the differences of all frames."
    )
    return StaticPage(
        "certificate",
        facts["recording"],
        _collect_facts(certificate, facts),
        [render_notice("Tests that are incomplete", remarks), render_notice("Files", certificate.problems)],
        body,
        [note],
        facts["sylpose"],
    ).render()


def _collect_facts(certificate: SessionCertificate, facts: dict[str, str]) -> list[tuple[str, str]]:
    found = [("Created", facts["created"].replace("T", " ").replace("+00:00", " UTC"))]
    item = certificate.objects[0]
    found.append(("Cameras", f"{len(item.cameras)}: {', '.join(item.cameras)}"))
    if len(certificate.objects) == 1:
        found += _motion_facts(item)
    return [*found, ("Calibration", facts["calibration"][:12])]


def _motion_facts(item: Certificate) -> list[tuple[str, str]]:
    path = format_length(item.path, item.unit)
    return [
        ("Frames with a pose", f"{item.n_measured} of {item.n_frames}"),
        ("Motion", f"{math.degrees(item.turn):.0f}°, path of {path}"),
    ]


def _render_object(item: Certificate, *, is_named: bool) -> str:
    head = ""
    if is_named:
        text = "; ".join(f"{label.lower()} {value}" for label, value in _motion_facts(item))
        head = f"<h2>{escape_html(item.name)} <small>{escape_html(text)}</small></h2>"
    quantities = list_quantities(item)
    tiles = "".join(_render_tile(f"Error of {q.name}", *format_error(q)) for q in quantities)
    tiles += "".join(_render_tile(f"Standard deviations of {q.name}", *format_factor(q.estimate)) for q in quantities)
    charts = "".join(_render_chart_of(item, quantity) for quantity in quantities)
    names = ("test", "frames", *("difference", "error", "in bounds", "indep. frames") * 2)
    groups = "".join(f'<th colspan="4" class="group">{q.name}, {escape_html(q.unit)}</th>' for q in quantities)
    table = render_table(names, build_test_rows(item), numbers=9, groups=f"<th></th><th></th>{groups}")
    note = (
        "Frames: share of those with a pose that are compared. Difference: rms between the two results. Error: rms error of "
        "the result of all cameras that it implies. In bounds: share of the differences within their stated 95 % bounds. "
        "Independent frames: errors of successive frames are correlated, so that all frames together count as so many."
    )
    return (
        f'{head}<p class="lead">{escape_html(describe_accuracy(item))}</p><div class="tiles">{tiles}</div>'
        f'<div class="charts">{charts}</div>'
        f"{render_section('Tests', table, note)}"
    )


def build_test_rows(item: Certificate) -> list[list[str]]:
    """Return a row of cells per test: names, share of frames, then four cells for rotation and four for position."""
    labels = {"part": "{a} | all", "split": "{a} | {b}", "direction": "{a} | {b}"}
    rows = []
    for test in item.tests:
        cells = [labels[test.kind].format(a=test.a, b=test.b), f"{100 * test.coverage:.0f} %"]
        for quantity, agreement in zip(list_quantities(item), (test.rotation, test.position), strict=True):
            cells += _format_agreement(agreement, quantity)
        rows.append(cells)
    return rows


def _format_agreement(agreement: Agreement | None, quantity: Quantity) -> list[str]:
    if agreement is None:
        return ["-"] * 4
    in_bounds = f"{100 * agreement.in_bounds:.0f} %" if math.isfinite(agreement.in_bounds) else "-"
    difference, error = (quantity.format_number(value) for value in (agreement.difference, agreement.error))
    return [difference, error, in_bounds, format_number(agreement.n_effective)]


def _render_tile(label: str, value: str, text: str) -> str:
    cells = map(escape_html, (label, value, text))
    return '<section class="card tile"><h3>{}</h3><b>{}</b><p>{}</p></section>'.format(*cells)


def build_bar_rows(bar: BarTest, unit: str) -> list[list[str]]:
    """Return the rows of length and relative rotation: rms, maximum and 99.7th percentile of the deviations."""
    scale, shown = choose_length_unit(max(bar.length_statistics.values()), unit)
    length, angle = Quantity("length", None, scale, shown), Quantity("relative rotation", None, math.degrees(1.0), "°")
    return [
        [length.name, *map(length.format, bar.length_statistics.values())],
        [angle.name, *map(angle.format, bar.rotation_statistics.values())],
    ]


def _render_bar(bar: BarTest, unit: str) -> str:
    names = ("deviation from the mean", "rms", "maximum", "99.7th percentile")
    table = render_table(names, build_bar_rows(bar, unit), numbers=3)
    extent = " x ".join(format_length(value, unit) for value in bar.extent)
    note = (
        f"{bar.a} and {bar.b}, mean distance {format_length(bar.length, unit)}, in {len(bar.index)} frames "
        f"({100 * bar.coverage:.0f} %). The bar turned by up to {math.degrees(bar.turn):.0f}° and its middle went through "
        f"{extent}. Statistics as in ASTM E3064; the reference is the mean, not a calibrated length."
    )
    scale, shown = choose_length_unit(max(bar.length_statistics.values()), unit)
    lengths = _Series("absolute deviation", bar.times, np.abs(bar.length_deviations), 0)
    angles = _Series("absolute deviation", bar.times, bar.rotation_deviations, 1)
    charts = render_chart(f"Deviation of the length, {shown}", [lengths], {}, scale)
    charts += render_chart("Deviation of the relative rotation, °", [angles], {}, math.degrees(1.0))
    return f'{render_section("Bar", table, note)}<div class="charts">{charts}</div>'


# --- charts ---------------------------------------------------------------------------------------------------------------


class _Series(NamedTuple):
    """Values (n,) over times (n,), with a label and the number of a color."""

    label: str
    times: FloatArray
    values: FloatArray
    color: int


def _render_chart_of(item: Certificate, quantity: Quantity) -> str:
    """Render the errors that the parts of the cameras imply, with the stated standard deviations."""
    series, stated = list[_Series](), None
    part = ROTATION if quantity.name == "rotation" else POSITION
    for test in item.tests:
        agreement = test.rotation if quantity.name == "rotation" else test.position
        if test.kind == "split" or agreement is None or test.differences is None or not agreement.difference:
            continue
        differences = test.differences.rotation if quantity.name == "rotation" else test.differences.position
        values = agreement.error / agreement.difference * np.linalg.norm(differences, axis=1)
        series.append(_Series(test.a, test.differences.times, values, len(series)))
        if stated is None:
            sizes = _sizes(test.differences.covariance_b, part)
            stated = _Series("stated standard deviation", test.differences.times, sizes, -1)
    if not series:
        return ""
    estimate, lines = quantity.estimate, dict[str, float]()
    if estimate is not None and not estimate.is_lower_bound:
        lines = {"rms": estimate.error, "bound": estimate.bound}
    shown = [*series, stated] if stated is not None else series
    title = f"Error of {quantity.name} over time as each test implies it, {quantity.unit}"
    return render_chart(title, shown, lines, quantity.scale)


def render_chart(title: str, series: Sequence[_Series], lines: dict[str, float], scale: float) -> str:
    """Render curves over time from zero, and horizontal lines ("rms", "bound"), as an SVG figure.

    The axis ends at the largest value that is not a stated standard deviation, which may be much larger.
    """
    top = 1.08 * max([float(np.max(s.values)) for s in series if s.color >= 0] + list(lines.values()) + [1e-12])
    begin, end = min(s.times[0] for s in series), max(s.times[-1] for s in series)
    span = float(end - begin) or 1.0

    def x(time: float) -> float:
        return LEFT + (WIDTH - LEFT - 8) * float(time - begin) / span

    def y(value: float) -> float:
        return (HEIGHT - BOTTOM) - (HEIGHT - BOTTOM - 8) * min(float(value) / top, 1.04)

    drawn = []
    for tick in choose_ticks(0.0, scale * top):
        at = y(tick / scale)
        drawn.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - 8}" y1="{at:.1f}" y2="{at:.1f}"/>')
        drawn.append(f'<text x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{tick:g}</text>')
    # Recordings without time stamps count frames.
    axis = "frame" if np.array_equal(series[0].times, np.round(series[0].times)) else "s"
    drawn.append(f'<text x="{WIDTH - 4}" y="{HEIGHT - 7}" text-anchor="end">{axis}</text>')
    for tick in choose_ticks(float(begin), float(end) - 0.07 * span):
        drawn.append(f'<text x="{x(tick):.1f}" y="{HEIGHT - 7}" text-anchor="middle">{tick:g}</text>')
    keys = []
    for s in series:
        points = " ".join(f"{x(t):.1f},{y(v):.1f}" for t, v in zip(s.times, s.values, strict=True) if math.isfinite(v))
        style = 'class="stated"' if s.color < 0 else f'class="part" stroke="{PART_COLORS[s.color % len(PART_COLORS)]}"'
        drawn.append(f'<polyline fill="none" {style} points="{points}"/>')
        keys.append((style, f"{s.label} (cut off)" if np.max(s.values) > 1.04 * top else s.label))
    for kind, value in lines.items():
        drawn.append(f'<line class="{kind}" x1="{LEFT}" x2="{WIDTH - 8}" y1="{y(value):.1f}" y2="{y(value):.1f}"/>')
        keys.append((f'class="{kind}"', {"rms": "certified rms error", "bound": "its 95 % upper bound"}[kind]))
    legend = "".join(
        f'<span><svg viewBox="0 0 22 8" aria-hidden="true"><line {style} x1="0" x2="22" y1="4" y2="4"/></svg>'
        f"{escape_html(label)}</span>"
        for style, label in keys
    )
    return render_figure(title, (WIDTH, HEIGHT), drawn, legend)


def choose_ticks(low: float, high: float) -> list[float]:
    """Choose round values within an interval: multiples of 1, 2 or 5 times a power of ten."""
    span = high - low
    if not span > 0 or not math.isfinite(span):
        return [low]
    power = 10.0 ** math.floor(math.log10(span / MAX_INTERVALS))
    step = next(step for step in (power, 2 * power, 5 * power, 10 * power) if span / step <= MAX_INTERVALS + 1e-9)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 12) for k in range(first, math.floor(high / step + 1e-9) + 1)]
