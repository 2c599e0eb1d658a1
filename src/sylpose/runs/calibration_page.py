"""Page of a calibration: calibration.html, with the rig, coverage of the images, residuals and cross-validation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from sylpose import __version__
from sylpose.atomic_io import replace_atomically
from sylpose.display import format_length
from sylpose.report.page import escape_html
from sylpose.report.plots import camera_colors
from sylpose.report.rigview import compute_view_axes
from sylpose.report.static_page import StaticPage, render_figure, render_notice, render_section, render_table
from sylpose.rig import Rig
from sylpose.rig_calibration.from_boards import BoardCalibration
from sylpose.rig_calibration.from_motion import MotionCalibration
from sylpose.rig_calibration.result import Coverage, HalvesTest
from sylpose.runs import self_calibration
from sylpose.runs.calibrate import write_calibration

HEADER = ("Camera", "views", "corners", "residual", "fx", "fy", "cx", "cy", "rotation", "position")
MOTION_HEADER = ("Camera", "rotation vector, °", "sd", "place, {}", "sd", "focal length", "frames", "residual")
LENS_WORDS = {"focal": "focal lengths", "principal": "principal points", "distortion": "distortion"}
# Width of a drawing, its margin, and the length of an optical axis relative to the rig (choice).
WIDTH, MARGIN, AXIS_RATIO = 480, 40, 0.25


def write_page(text: str, file: Path) -> None:
    """Write a page; an existing file is replaced.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    with replace_atomically(file) as part:
        part.write_text(text, encoding="utf-8", newline="\n")


def write_motion_calibration(found: MotionCalibration, file: Path, title: str) -> tuple[list[Path], str]:
    """Write a calibration from motion, and its page next to it.

    Args:
        found: the calibration.
        file: output file, of any format of calibrations.
        title: name of the recording.

    Returns:
        the files, and a sentence on what the format cannot hold, or "".

    Raises:
        OSError, ValueError: as `write_calibration`.
    """
    lost = write_calibration(found.calibration, file, self_calibration.describe_tests(found))
    page = file.with_suffix(".html")
    write_page(render_motion_calibration(found, title), page)
    return [file, page], lost


def render_board_calibration(calibration: BoardCalibration, title: str, board: str) -> str:
    """Render the page of a calibration from boards as HTML text.

    Args:
        calibration: the result.
        title: name of the recording.
        board: description of the board.
    """
    rows = build_camera_rows(calibration)
    note = "Pixels, ± 1 standard deviation. Rotation and position: standard deviations relative to the first camera."
    lenses = render_section("Lenses and poses", render_table(HEADER, rows, len(HEADER) - 1), note)
    footer = "Corners per cell of each image, darker for more; the number is their rms residual in pixels. The lens is "
    return _make_page(
        calibration.rig,
        title,
        [("Board", board)],
        [*calibration.unobservable, *calibration.warnings],
        [lenses],
        render_section(
            "Two halves of the frames",
            _render_halves(
                calibration.rig,
                calibration.halves,
                "frame",
                "The frames are too few for a calibration from each half.",
            ),
        ),
        calibration.coverage,
        f"{footer}extrapolated in empty cells.",
    )


def render_motion_calibration(found: MotionCalibration, title: str) -> str:
    """Render the page of a calibration from motion as HTML text.

    Args:
        found: the result.
        title: name of the recording.
    """
    unit = found.calibration.rig.unit
    header = [name.format(unit or "relative") for name in MOTION_HEADER]
    rows = self_calibration.build_camera_rows(found)
    note = "± 1 standard deviation of rotation and place, relative to the first camera."
    tests = [(test.name, test.value, test.limit) for test in found.tests]
    body = [
        render_section("Poses", render_table(header, rows, len(header) - 1), note),
        render_section("Tests", render_table(("test", "result", "needs"), tests, 0), "All passed; else it is refused."),
        render_section(
            "Not observable", f"<ul>{''.join(f'<li>{escape_html(its)}</li>' for its in describe_limits(found))}</ul>"
        ),
    ]
    lengths = format_length(found.object_length, unit), format_length(found.distance, unit)
    return _make_page(
        found.calibration.rig,
        title,
        [
            ("Object", f"{lengths[0]} long, {lengths[1]} away"),
            *([("Gravity", self_calibration.describe_flight(found))] if found.flight else []),
        ],
        self_calibration.list_warnings(found),
        body,
        render_section(
            "Two halves of the landmarks",
            _render_halves(
                found.calibration.rig,
                found.halves,
                "landmark",
                "The calibration from one half of the landmarks did not converge.",
            ),
        ),
        found.coverage,
        "Observations per cell of each image, darker for more; the number is their rms residual in pixels.",
    )


def describe_limits(found: MotionCalibration) -> list[str]:
    """Describe what a calibration from motion does not determine, one sentence each."""
    held = [words for name, words in LENS_WORDS.items() if name not in found.freed]
    if "fov" in found.freed:
        held = held[1:]
    sentences = ["The world: it is the frame of the first camera, or that of --world."]
    if not found.calibration.rig.unit:
        sentences.append("The scale: lengths are relative to the first camera's distance from the object.")
    if held:
        sentences.append(f"{', '.join(held).capitalize()}: held as given; --free estimates them.")
    return sentences


def _make_page(
    rig: Rig,
    title: str,
    facts: Sequence[tuple[str, str]],
    warnings: Sequence[str],
    sections: Sequence[str],
    halves: str,
    coverage: Sequence[Coverage],
    note: str,
) -> str:
    """Make a page: sections, the rig, cross-validation, the images."""
    rigs = _draw_rig(rig, (0, 1), "From above") + _draw_rig(rig, (0, 2), "From the side")
    images = "".join(_draw_coverage(camera.name, camera.size, its) for camera, its in zip(rig, coverage, strict=True))
    created = ("Created", f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC")
    return StaticPage(
        "calibration",
        title,
        [created, ("Cameras", f"{len(rig)}: {', '.join(rig.names)}"), *facts],
        [render_notice("What to improve", warnings)],
        [*sections, f'<div class="charts">{rigs}</div>', halves, f'<div class="charts">{images}</div>'],
        [note],
        __version__,
    ).render()


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


def _render_halves(rig: Rig, halves: HalvesTest | None, what: str, missing: str) -> str:
    if halves is None:
        return f"<p>{missing}</p>"
    has_board = bool(np.isfinite(halves.projection_px).all())
    names = ["Camera", "rotation", "position", *["projection"] * has_board, "squared difference over covariance"]
    rows = []
    for c, camera in enumerate(rig):
        row = [
            camera.name,
            f"{math.degrees(halves.rotation[c]):.2g}°",
            format_length(float(halves.position[c]), rig.unit),
            f"{halves.ratio[c]:.2g}{' (significant)' if halves.is_significant[c] else ''}",
        ]
        if has_board:
            row.insert(3, f"{halves.projection_px[c]:.2f} px")
        rows.append(row)
    note = (
        f"Differences between calibrations from every other {what}; the last column is about 1 if the standard deviations "
        "are right." + " Projection: of the board's places, rms." * has_board
    )
    return f'{render_table(names, rows, len(names) - 1)}<p class="note">{escape_html(note)}</p>'


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
        label = y + 20 if v < y else y - 9  # where the axis is not
        drawn.append(f'<text x="{x:.1f}" y="{label:.1f}" text-anchor="middle">{escape_html(name)}</text>')
    return render_figure(title, (WIDTH, height), drawn)


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
            drawn.append(f'<rect {place} fill="#0072B2" fill-opacity="{0.5 * share:.2f}" class="grid"/>')
            if coverage.counts[i, j]:
                at = f'x="{(j + 0.5) * width:.1f}" y="{(i + 0.5) * cell + 4:.1f}"'
                drawn.append(f'<text {at} text-anchor="middle">{coverage.rms_px[i, j]:.2f}</text>')
    text = f"{name}: {100 * coverage.share:.0f} % covered"
    if math.isfinite(coverage.tilt):
        text += f", tilted by up to {math.degrees(coverage.tilt):.0f}°"
    return render_figure(text, (WIDTH, height), drawn)
