"""report.html: a result as one self-contained file that opens in any browser.

The page embeds its script (three.js and uPlot, from `web/`), style, numbers and images, and its security policy
forbids loading anything else. It has a bounded number of frames and images, packed for the script. File contents are
inserted as text, never as markup.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

import msgspec
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.euler_angles import EulerAngles
from sylpose.input_limits import MAX_SENTENCE_LENGTH, input_errors, read_bytes, to_one_line
from sylpose.report.camera_consistency import describe_camera_problems
from sylpose.report.failure_reasons import explain_missing_poses
from sylpose.report.plots import (
    X_COLOR,
    Y_COLOR,
    Z_COLOR,
    angle_labels,
    camera_colors,
    choose_length_unit,
    compute_frame_angles,
    count_inliers,
    summarize_trajectory,
)
from sylpose.report.scene import IMAGE_GRID, Scene, Thumbnails
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Camera, Rig
from sylpose.status import DOUBTFUL, PREDICTED, FrameStatus, Observability

# The page stays below this size, so that it can be mailed (choice). Limits within it: bytes of the encoded images, and
# number of values of all frames (base64 adds half as many bytes again).
MAX_BYTES = 5_000_000
MAX_IMAGE_BYTES, MAX_VALUES, MAX_FRAMES = 3_200_000, 200_000, 2000
# Points drawn on the object, and in all images of one frame together (choice: a cloud that shows its shape).
MAX_POINTS, MAX_IMAGE_POINTS = 6000, 480
# Maximum number of distinct reasons and of distinct faults listed frame by frame.
MAX_SENTENCES = 300
# Times that start beyond this are given relative to the first one, seconds: a day and more is a clock's (choice).
MAX_ABSOLUTE_TIME = 1e5
# Points along an axis drawn into an image; lenses bend it.
AXIS_SAMPLES = 5
# Image coordinates are integers, in fractions of width and height with this denominator; `MISSING_COORDINATE` marks
# missing ones.
COORDINATE_STEPS, MISSING_COORDINATE = 8192, -32768

# Severity, by which one frame is chosen to represent a group.
_SEVERITY = {**dict.fromkeys(DOUBTFUL, 3), **dict.fromkeys(PREDICTED, 2), FrameStatus.RELOCALIZED: 1}


def select_frames(trajectory: Trajectory, max_frames: int) -> IntArray:
    """Select at most `max_frames` frames to show.

    Returns:
        (n,) positions, in order. Each represents a group of consecutive frames and is the worst of them, so that short
        failures are not left out.
    """
    n = len(trajectory)
    group_size = -(-n // max_frames)
    ranks = np.array([_compute_severity(frame) for frame in trajectory])
    if group_size <= 1:
        return np.arange(n)
    starts = np.arange(0, n, group_size)
    return np.array([start + int(np.argmax(ranks[start : start + group_size])) for start in starts])


def _compute_severity(frame: FramePose) -> int:
    if frame.world_from_object is None:
        return 5
    return 4 if frame.faults else _SEVERITY.get(frame.status, 0)


def build_page_data(trajectory: Trajectory, scene: Scene, angles: EulerAngles) -> dict[str, Any]:
    """Build the page's data except for images, as JSON types.

    Arrays are little-endian in base64 ("f": float32, "i": int32, "h": int16). Positions are relative to `scene.center`,
    so that float32 is precise enough wherever the world's origin is.
    """
    cameras = len(scene.cameras)
    max_frames = max(2, min(MAX_FRAMES, MAX_VALUES // (27 + 4 * cameras)))
    selected = select_frames(trajectory, max_frames)
    frames = [trajectory[int(k)] for k in selected]
    shown = Trajectory(frames, trajectory.camera_names, trajectory.unit)
    poses = scene.world_from_object[selected]
    solved, start_time = trajectory.measured_mask, float(trajectory.times[0])
    start = trajectory.positions[solved][0] if solved.any() else scene.center
    moved = float(np.abs(trajectory.positions[solved] - start).max(initial=0.0))
    move_scale, move_unit = choose_length_unit(moved, trajectory.unit)
    sigma = np.array([f.sigma if f.world_from_object is not None else np.full(6, np.nan) for f in frames])
    sigma[~np.isfinite(sigma)] = np.nan
    sd_scale, sd_unit = choose_length_unit(float(np.nanmax(sigma[:, 3:], initial=0.0)), trajectory.unit)
    statuses = list(dict.fromkeys(f.status for f in frames))
    reasons, faults = _deduplicate([f.reason for f in frames]), _deduplicate(["; ".join(f.faults) for f in frames])
    points = scene.points[:: max(1, -(-len(scene.points) // MAX_POINTS))]
    point_cameras = scene.point_cameras[:: max(1, -(-len(scene.points) // MAX_POINTS))]
    counts, errors = count_inliers(frames)
    return {
        "total": len(trajectory),
        "shown": len(selected),
        "drawnPoints": len(points),
        "unit": trajectory.unit or "units",
        "inSeconds": not np.array_equal(trajectory.times, [f.index for f in trajectory]),
        "cameras": list(scene.cameras),
        "colors": camera_colors(cameras),
        "angles": [label for label, _ in angle_labels(angles)],
        "angleAxes": [(X_COLOR, Y_COLOR, Z_COLOR).index(color) for _, color in angle_labels(angles)],
        "moved": [move_scale, move_unit],
        "sd": [sd_scale, sd_unit],
        "statuses": [[s.value, s.text, s.has_pose] for s in statuses],
        "reasons": reasons[0],
        "faults": faults[0],
        "index": _pack_base64([f.index for f in frames], "i"),
        "start": start_time,
        "since": start_time if abs(start_time) > MAX_ABSOLUTE_TIME else 0.0,
        "time": _pack_base64(shown.times - trajectory.times[0]),
        "place": _pack_base64(poses[:, :3, 3] - scene.center),
        "begin": (start - scene.center).astype(np.float32).tolist(),  # rounded like positions, since it is one of them
        "turned": _pack_base64(poses[:, :3, :3]),
        "sigma": _pack_base64(sigma * ([180 / np.pi] * 3 + [1.0] * 3)),
        "angle": _pack_base64(np.degrees(compute_frame_angles(shown, angles))),
        "turn": _pack_base64(np.degrees(trajectory.rotation_angles[selected])),
        "status": _pack_base64([statuses.index(f.status) for f in frames], "i"),
        "reason": _pack_base64(reasons[1], "i"),
        "fault": _pack_base64(faults[1], "i"),
        "inliers": _pack_base64(counts),
        "residuals": _pack_base64(errors),
        "matches": _pack_base64([_fill_per_camera(f.matches, cameras) for f in frames]),
        "doubt": _pack_base64([_fill_per_camera(f.variance_inflation, cameras) for f in frames]),
        "center": scene.center.tolist(),
        "reach": scene.camera_distance,
        "axes": scene.axes.tolist(),
        "axisLength": scene.axis_length,
        "grid": IMAGE_GRID,
        "sheets": _pack_base64(scene.image_planes - scene.center),
        "eyes": _pack_base64(scene.world_from_camera[:, :3, 3] - scene.center),
        "looks": _pack_base64(scene.world_from_camera[:, :3, 2]),
        "sizes": scene.sizes.tolist(),
        "points": _pack_base64(points),
        "pointCameras": _pack_base64(point_cameras, "i"),
    }


def build_page_images(trajectory: Trajectory, scene: Scene, rig: Rig) -> dict[str, Any]:
    """Build the page's images, of as many frames as fit, with the object's axes and points in them.

    Args:
        trajectory: trajectory of the object.
        scene: scene of this trajectory.
        rig: whose lenses took the images.
    """
    stills = _thin_out(scene.thumbnails)
    at = {int(number): k for k, number in enumerate(scene.index)}
    shown = [(int(number), images) for number, images in zip(stills.index, stills.images, strict=True) if number in at]
    axes, points = [], []
    max_points = max(16, MAX_IMAGE_POINTS // len(rig))
    for number, _ in shown:
        pose = trajectory[at[number]].world_from_object
        for c, camera in enumerate(rig):
            camera_points = scene.points[scene.point_cameras == c]
            camera_points = camera_points[:: max(1, -(-len(camera_points) // max_points))][:max_points]
            ends = scene.axis_length * np.eye(3)[:, None] * np.linspace(0, 1, AXIS_SAMPLES)[:, None]
            axes.append(_quantize_pixels(camera, pose, ends.reshape(-1, 3), 3 * AXIS_SAMPLES))
            points.append(_quantize_pixels(camera, pose, camera_points, max_points))
    return {
        "index": [number for number, _ in shown],
        "files": [[None if file is None else base64.b64encode(file).decode() for file in files] for _, files in shown],
        "perAxis": AXIS_SAMPLES,
        "perImage": max_points,
        "grain": COORDINATE_STEPS,
        "axes": _pack_base64(axes, "h"),
        "points": _pack_base64(points, "h"),
    }


def _thin_out(stills: Thumbnails) -> Thumbnails:
    """Drop every second frame until the images fit the size limit; none are left if one frame is too large."""
    while sum(4 * len(file) // 3 for files in stills.images for file in files if file) > MAX_IMAGE_BYTES:
        if len(stills.images) == 1:
            return Thumbnails()
        stills = Thumbnails(stills.index[::2], stills.images[::2])
    return stills


def _quantize_pixels(camera: Camera, pose: RigidTransform | None, points: FloatArray, n: int) -> IntArray:
    """Quantize the pixels of the object's points, (n, 2), in steps of the image's width and height.

    Padding, points far outside the image or without a projection, and all without a pose are `MISSING_COORDINATE`.
    """
    out = np.full((n, 2), MISSING_COORDINATE, np.int64)
    if pose is not None and len(points):
        with np.errstate(invalid="ignore"):
            fractions = (camera.project(pose.apply(points)) + 0.5) / camera.size
            is_near = (np.abs(fractions) < 3).all(axis=1)
        out[: len(points)][is_near] = np.round(fractions[is_near] * COORDINATE_STEPS)
    return out


def _fill_per_camera(values: ArrayLike, cameras: int) -> FloatArray:
    array = np.asarray(values, dtype=float)
    return array if len(array) else np.full(cameras, np.nan)


def _deduplicate(sentences: Sequence[str]) -> tuple[list[str], list[int]]:
    """Return the distinct sentences, the first one empty, and each sentence's index among them."""
    indices: dict[str, int] = {"": 0}
    for sentence in sentences:
        if len(indices) < MAX_SENTENCES:
            indices.setdefault(sentence, len(indices))
    rest = len(indices)
    positions = [indices.get(sentence, rest) for sentence in sentences]
    return [*indices, "see trajectory.csv: too many distinct sentences for this page"], positions


def _pack_base64(values: ArrayLike, kind: str = "f") -> str:
    types = {"f": "<f4", "i": "<i4", "h": "<i2"}
    return base64.b64encode(np.ascontiguousarray(np.asarray(values), types[kind]).tobytes()).decode()


ASSETS_DIR = Path(__file__).with_name("assets")
# Maximum number of sentences in a list; the list states how many are left out.
MAX_LIST_ITEMS = 30
# ID of the page element with the images.
IMAGES_ELEMENT_ID = "images-data"
# Largest size in bytes of a page whose images are reused; no page is as large.
MAX_PAGE_BYTES = 2**25


class _PageImages(msgspec.Struct, frozen=True):
    """Images in a page: numbers of the frames, and for each frame JPEG files or None."""

    index: list[int]
    files: list[list[bytes | None]]


@dataclass(frozen=True)
class PageHeader:
    """Texts of a page apart from the result itself.

    Attributes:
        title: title of the page.
        version: version of the sylpose that made the result.
        facts: labels and values at the top.
        settings: labels and values of the run's settings, by heading.
        input_warnings: sentences about problems found before the run.
        cameras: rows of a camera's name, its number of used frames, inliers and residual.
        videos: names of overlay videos, linked from the page.
    """

    title: str
    version: str
    facts: Sequence[tuple[str, str]] = ()
    settings: Mapping[str, Sequence[tuple[str, str]]] | None = None
    input_warnings: Sequence[str] = ()
    cameras: Sequence[Sequence[str]] = ()
    videos: Sequence[str] = ()


def render_page(trajectory: Trajectory, scene: Scene, rig: Rig, angles: EulerAngles, header: PageHeader) -> str:
    """Render the page as HTML text.

    Args:
        trajectory: trajectory of at least one frame.
        scene: scene of this trajectory (`build_scene`).
        rig: whose lenses took the scene's images.
        angles: the three angles to show.
        header: other texts of the page.

    Raises:
        ValueError: a trajectory without frames.
    """
    summary_text, data = summarize_trajectory(trajectory), build_page_data(trajectory, scene, angles)
    images = build_page_images(trajectory, scene, rig)
    has_failed = not any(f.world_from_object is not None for f in trajectory)
    script, style = load_asset("report.js"), load_asset("report.css")
    return Template(load_asset("page.html")).substitute(
        script_hash=compute_hash(script),
        style_hash=compute_hash(style),
        script=script,
        style=style,
        version=escape_html(header.version),
        title=escape_html(header.title),
        kind=" failed-run" if has_failed else "",
        summary=escape_html(f"{summary_text[:1].upper()}{summary_text[1:]}."),
        facts="".join(
            f"<div><dt>{escape_html(label)}</dt><dd>{escape_html(words)}</dd></div>" for label, words in header.facts
        ),
        notices=_render_notices(trajectory, header, has_failed=has_failed),
        videos=_render_videos(header.videos),
        time_axis=_describe_time_axis(data),
        statuses=_render_statuses(trajectory),
        cameras="".join(render_row(row, numbers=len(row) - 1) for row in header.cameras),
        settings=_render_settings(header.settings or {}),
        notes=_render_notes(data, images, scene, header.version),
        data=_dump_json(data),
        images=_dump_json(images),
    )


def _describe_time_axis(data: Mapping[str, Any]) -> str:
    if not data["inSeconds"]:
        return "frames"
    return f"seconds since {data['since']:.3f}" if data["since"] else "seconds"


def _render_notices(trajectory: Trajectory, head: PageHeader, *, has_failed: bool) -> str:
    style_class = " failed" if has_failed else ""
    # Problems found before the run are the likeliest cause of failure, so they come first.
    parts = [("Problems found before the run", head.input_warnings, style_class)]
    if has_failed:
        parts.append(("Why there is no pose", explain_missing_poses(trajectory), style_class))
    parts.append(("Camera problems", describe_camera_problems(trajectory), ""))
    shown = [
        f'<section class="notice{kind}"><h2>{title}</h2><ul>{_render_items(sentences)}</ul></section>'
        for title, sentences, kind in parts
        if sentences
    ]
    return f'<div class="notices">{"".join(shown)}</div>' if shown else ""


def _render_items(sentences: Sequence[str]) -> str:
    shown = [*sentences[:MAX_LIST_ITEMS]]
    if len(sentences) > MAX_LIST_ITEMS:
        shown.append(f"and {len(sentences) - MAX_LIST_ITEMS} more")
    return "".join(f"<li>{escape_html(sentence)}</li>" for sentence in shown)


def _render_videos(names: Sequence[str]) -> str:
    if not names:
        return ""
    links = ", ".join(f'<a href="{escape_html(quote(name))}">{escape_html(name)}</a>' for name in names)
    return f"<p><small>All frames (video in the same folder): {links}</small></p>"


def _render_statuses(trajectory: Trajectory) -> str:
    counts = Counter(frame.status for frame in trajectory)
    rows = [(status.value, str(count), status.text) for status, count in counts.most_common()]
    seen = Counter(frame.observability for frame in trajectory if frame.world_from_object is not None)
    rows += [(o.value, str(n), o.text) for o, n in seen.most_common() if o is not Observability.ALL]
    return "".join(render_row(row, numbers=1) for row in rows)


def render_row(cells: Sequence[str], numbers: int = 0) -> str:
    """Render a table row: a name, the given number of numeric cells, and text cells."""
    kinds = ["", *[' class="number"'] * numbers, *[' class="said"'] * len(cells)]
    return (
        f"<tr>{''.join(f'<td{kind}>{escape_html(cell)}</td>' for cell, kind in zip(cells, kinds, strict=False))}</tr>"
    )


def _render_settings(tables: Mapping[str, Sequence[tuple[str, str]]]) -> str:
    if not tables:
        return ""
    parts = [
        f"<h3>{escape_html(name)}</h3>" * bool(name)
        + f"<table><tbody>{''.join(render_row(r, numbers=0) for r in rows)}</tbody></table>"
        for name, rows in tables.items()
    ]
    return (
        '<section class="card settings"><details><summary>Settings, checksums and versions</summary>'
        f"{''.join(parts)}</details></section>"
    )


def _render_notes(data: Mapping[str, Any], images: Mapping[str, Any], scene: Scene, version: str) -> str:
    """Render the notes on what the page leaves out, and its components."""
    sentences = []
    if data["shown"] < data["total"]:
        sentences.append(
            f"{data['shown']} of {data['total']} frames are shown, the worst of each group. trajectory.csv contains "
            "all."
        )
    if images["index"]:
        sentences.append(f"The page has reduced images of {len(images['index'])} frames and shows the nearest one.")
    if data["drawnPoints"] < len(scene.points):
        sentences.append(f"{data['drawnPoints']} of {len(scene.points)} points on the object are drawn.")
    sentences.append(
        f"Made by sylpose {version}; with three.js and uPlot, whose licenses (MIT) are in this page's script."
    )
    return "".join(f"<p>{escape_html(sentence)}</p>" for sentence in sentences)


def escape_html(text: str) -> str:
    """Escape text for HTML content and attributes; spell out control characters."""
    return html.escape(to_one_line(text, MAX_SENTENCE_LENGTH), quote=True)


def _dump_json(value: object) -> str:
    """Dump JSON that cannot end its HTML element."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


@cache
def load_asset(name: str) -> str:
    return (ASSETS_DIR / name).read_text(encoding="utf-8")


def compute_hash(text: str) -> str:
    """Compute the hash with which a browser verifies a script or style."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def read_stills(page: Path) -> Thumbnails:
    """Read the images of a page.

    Raises:
        ValueError: naming the file: not a report page.
    """
    content = read_bytes(page, MAX_PAGE_BYTES).decode("utf-8", "replace")
    with input_errors(page):
        found = re.search(f'<script type="application/json" id="{IMAGES_ELEMENT_ID}">(.*?)</script>', content, re.S)
        if found is None:
            raise ValueError("not a page of sylpose; remove it to create a new one")
        try:
            images = msgspec.json.decode(found[1], type=_PageImages)
        except msgspec.MsgspecError as error:
            raise ValueError(f"its images are not in sylpose's format ({error})") from None
        if len(images.index) != len(images.files):
            raise ValueError("its images are not in sylpose's format")
        return Thumbnails(np.array(images.index, np.int64), tuple(map(tuple, images.files)))
