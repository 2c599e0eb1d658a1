"""Page of a calibration: calibration.html, with the rig, coverage of the images, residuals and cross-validation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from string import Template

import numpy as np

from sylpose import __version__
from sylpose.atomic_io import replace_atomically
from sylpose.display import format_length
from sylpose.report.page import compute_hash, escape_html, load_asset
from sylpose.report.plots import camera_colors
from sylpose.report.rigview import compute_view_axes
from sylpose.rig import Rig
from sylpose.rig_calibration.board_checks import Coverage
from sylpose.rig_calibration.from_boards import BoardCalibration

HEADER = ("Camera", "views", "corners", "residual", "fx", "fy", "cx", "cy", "rotation", "position")
# Width of a drawing, its margin, and the length of an optical axis relative to the rig (choice).
WIDTH, MARGIN, AXIS_RATIO = 480, 40, 0.25


def write_calibration_page(calibration: BoardCalibration, title: str, board: str, file: Path) -> None:
    """Write the page of a calibration.

    Args:
        calibration: the result.
        title: name of the recording.
        board: description of the board.
        file: the page; replaced if it exists.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    with replace_atomically(file) as part:
        part.write_text(render_calibration(calibration, title, board), encoding="utf-8", newline="\n")


def render_calibration(calibration: BoardCalibration, title: str, board: str) -> str:
    """Render the page as HTML text; the arguments are those of `write_calibration_page`."""
    rig, style = calibration.rig, load_asset("report.css") + load_asset("certificate.css")
    facts = {
        "Created": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "Cameras": f"{len(rig)}: {', '.join(rig.names)}",
        "Board": board,
    }
    header = "".join(f"<th{' class=number' * (i > 0)}>{name}</th>" for i, name in enumerate(HEADER))
    coverage = zip(rig, calibration.coverage, strict=True)
    return Template(load_asset("calibration.html")).substitute(
        style=style,
        style_hash=compute_hash(style),
        version=escape_html(__version__),
        title=escape_html(title),
        facts="".join(f"<div><dt>{label}</dt><dd>{escape_html(text)}</dd></div>" for label, text in facts.items()),
        notices=_render_notice([*calibration.unobservable, *calibration.warnings]),
        header=header,
        rows=_render_rows(build_camera_rows(calibration)),
        rig=_draw_rig(rig, (0, 1), "From above") + _draw_rig(rig, (0, 2), "From the side"),
        halves=_render_halves(calibration),
        coverage="".join(_draw_coverage(camera.name, camera.size, its) for camera, its in coverage),
    )


def build_camera_rows(calibration: BoardCalibration) -> list[list[str]]:
    """Return the cells of `HEADER` for each camera."""
    rows = []
    for c, camera in enumerate(calibration.rig):
        lens_sd = np.sqrt(np.diag(calibration.intrinsics_covariance[c]))
        pose_sd = np.sqrt(np.diag(calibration.extrinsics_covariance[c]))
        values = camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        row = [
            camera.name,
            str(calibration.n_views[c]),
            str(calibration.n_points[c]),
            f"{calibration.rms_px[c]:.2f} px",
        ]
        row += [f"{value:.1f} ± {sd:.2g}" for value, sd in zip(values, lens_sd, strict=False)]
        position = format_length(float(np.linalg.norm(pose_sd[3:])), calibration.rig.unit)
        is_first = not pose_sd.any()
        row += ["-", "-"] if is_first else [f"± {math.degrees(np.linalg.norm(pose_sd[:3])):.2g}°", f"± {position}"]
        rows.append(row)
    return rows


def _render_rows(rows: Sequence[Sequence[str]]) -> str:
    return "".join(
        f"<tr><td>{escape_html(first)}</td>"
        + "".join(f'<td class="number">{escape_html(cell)}</td>' for cell in rest)
        + "</tr>"
        for first, *rest in rows
    )


def _render_notice(sentences: Sequence[str]) -> str:
    if not sentences:
        return ""
    items = "".join(f"<li>{escape_html(sentence)}</li>" for sentence in sentences)
    return f'<div class="notices"><section class="notice"><h2>What to improve</h2><ul>{items}</ul></section></div>'


def _render_halves(calibration: BoardCalibration) -> str:
    if (halves := calibration.halves) is None:
        return "<p>The views are too few for a calibration from each half.</p>"
    names = ("Camera", "rotation", "position", "projection", "squared difference over covariance")
    header = "".join(f"<th{' class=number' * (i > 0)}>{name}</th>" for i, name in enumerate(names))
    rows = [
        [
            camera.name,
            f"{math.degrees(halves.rotation[c]):.2g}°",
            format_length(float(halves.position[c]), calibration.rig.unit),
            f"{halves.projection_px[c]:.2f} px",
            f"{halves.ratio[c]:.2g}{' (significant)' if halves.is_significant[c] else ''}",
        ]
        for c, camera in enumerate(calibration.rig)
    ]
    return (
        f'<div class="scroll"><table><thead><tr>{header}</tr></thead><tbody>{_render_rows(rows)}</tbody></table></div>'
        '<p class="note">Differences between calibrations from every other frame; the last column is about 1 if the '
        "standard deviations are right. Projection: of the board's places, rms.</p>"
    )


def _draw_rig(rig: Rig, rows: tuple[int, int], title: str) -> str:
    """Draw centers and optical axes of the cameras in two of the axes right, ahead, up, as an SVG figure."""
    axes = compute_view_axes(rig)[[*rows]]
    centers = np.array([camera.center for camera in rig]) @ axes.T
    directions = np.array([camera.direction for camera in rig]) @ axes.T
    extent = max(float(np.ptp(centers, axis=0).max()), 1e-9) if len(rig) > 1 else 1.0
    ends = centers + AXIS_RATIO * extent * directions
    both = np.concatenate([centers, ends])
    low, high = both.min(axis=0), both.max(axis=0)
    scale = (WIDTH - 2 * MARGIN) / max(float((high - low).max()), 1e-9)
    height = 2 * MARGIN + scale * float(high[1] - low[1])
    drawn = []
    for name, color, start, end in zip(rig.names, camera_colors(len(rig)), centers, ends, strict=True):
        (x, y), (u, v) = (MARGIN + scale * (np.array([start, end]) - low)).tolist()
        y, v = height - y, height - v
        drawn.append(f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{u:.1f}" y2="{v:.1f}" stroke="{color}" stroke-width="2"/>')
        drawn.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="{color}"/>')
        drawn.append(f'<text x="{x:.1f}" y="{y - 9:.1f}" text-anchor="middle">{escape_html(name)}</text>')
    return _render_figure(title, height, drawn)


def _draw_coverage(name: str, size: tuple[int, int], coverage: Coverage) -> str:
    """Draw the number of corners and their residual in the cells of an image, as an SVG figure."""
    n_rows, n_columns = coverage.counts.shape
    height = WIDTH * size[1] / size[0]
    width, cell = WIDTH / n_columns, height / n_rows
    top, drawn = max(int(coverage.counts.max()), 1), []
    for i in range(n_rows):
        for j in range(n_columns):
            share = coverage.counts[i, j] / top
            place = f'x="{j * width:.1f}" y="{i * cell:.1f}" width="{width:.1f}" height="{cell:.1f}"'
            drawn.append(f'<rect {place} fill="#0072B2" fill-opacity="{0.75 * share:.2f}" class="grid"/>')
            if coverage.counts[i, j]:
                at = f'x="{(j + 0.5) * width:.1f}" y="{(i + 0.5) * cell + 4:.1f}"'
                drawn.append(f'<text {at} text-anchor="middle">{coverage.rms_px[i, j]:.2f}</text>')
    text = f"{name}: {100 * coverage.share:.0f} % covered, tilted by up to {math.degrees(coverage.tilt):.0f}°"
    return _render_figure(text, height, drawn)


def _render_figure(title: str, height: float, drawn: Sequence[str]) -> str:
    label = escape_html(title)
    svg = f'<svg viewBox="0 0 {WIDTH} {height:.0f}" role="img" aria-label="{label}">{"".join(drawn)}</svg>'
    return f'<figure class="card"><h3>{label}</h3>{svg}</figure>'
