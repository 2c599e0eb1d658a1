"""report.html: a result as one self-contained file that opens in any browser.

The page embeds its script (three.js and uPlot, from `web/`), style, numbers and images, and its security policy
forbids loading anything else. File contents are inserted as text, never as markup.
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

from sylpose.atomic_io import replace_atomically
from sylpose.geometry.euler_angles import EulerAngles
from sylpose.input_limits import MAX_SENTENCE_LENGTH, input_errors, read_bytes, to_one_line
from sylpose.report.camera_consistency import describe_camera_problems
from sylpose.report.failure_reasons import explain_missing_poses
from sylpose.report.page_data import build_page_data, build_page_images
from sylpose.report.plots import summarize_trajectory
from sylpose.report.scene import Scene, Thumbnails
from sylpose.results import Observability, Trajectory
from sylpose.rig import Rig

__all__ = ["PageHeader", "read_stills", "render_page", "write_page"]

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


def write_page(
    path: Path | str, trajectory: Trajectory, scene: Scene, rig: Rig, angles: EulerAngles, header: PageHeader
) -> None:
    """Write the page, replacing an existing file.

    Raises:
        ValueError: a trajectory without frames.
        OSError: the file cannot be written; the message names it.
    """
    page = render_page(trajectory, scene, rig, angles, header)
    with replace_atomically(path) as part:
        part.write_text(page, encoding="utf-8", newline="\n")


def render_page(trajectory: Trajectory, scene: Scene, rig: Rig, angles: EulerAngles, header: PageHeader) -> str:
    """Render the page as HTML text.

    Args:
        trajectory: trajectory of at least one frame.
        scene: scene of this trajectory (`build_scene`).
        rig: whose lenses took the scene's images.
        angles: the three angles to show.
        header: other texts of the page.
    """
    summary_text, data = summarize_trajectory(trajectory), build_page_data(trajectory, scene, angles)
    images = build_page_images(trajectory, scene, rig)
    has_failed = not any(f.world_from_object is not None for f in trajectory)
    script, style = _load_asset("report.js"), _load_asset("report.css")
    return Template(_load_asset("page.html")).substitute(
        script_hash=_compute_hash(script),
        style_hash=_compute_hash(style),
        script=script,
        style=style,
        version=_escape_html(header.version),
        title=_escape_html(header.title),
        kind=" failed-run" if has_failed else "",
        summary=_escape_html(f"{summary_text[:1].upper()}{summary_text[1:]}."),
        facts="".join(
            f"<div><dt>{_escape_html(label)}</dt><dd>{_escape_html(words)}</dd></div>" for label, words in header.facts
        ),
        notices=_render_notices(trajectory, header, has_failed=has_failed),
        videos=_render_videos(header.videos),
        time_axis=_describe_time_axis(data),
        statuses=_render_statuses(trajectory),
        cameras="".join(_render_row(row, numbers=len(row) - 1) for row in header.cameras),
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
    return "".join(f"<li>{_escape_html(sentence)}</li>" for sentence in shown)


def _render_videos(names: Sequence[str]) -> str:
    if not names:
        return ""
    links = ", ".join(f'<a href="{_escape_html(quote(name))}">{_escape_html(name)}</a>' for name in names)
    return f"<p><small>All frames (video in the same folder): {links}</small></p>"


def _render_statuses(trajectory: Trajectory) -> str:
    counts = Counter(frame.status for frame in trajectory)
    rows = [(status.value, str(count), status.text) for status, count in counts.most_common()]
    seen = Counter(frame.observability for frame in trajectory if frame.world_from_object is not None)
    rows += [(o.value, str(n), o.text) for o, n in seen.most_common() if o is not Observability.ALL]
    return "".join(_render_row(row, numbers=1) for row in rows)


def _render_row(cells: Sequence[str], numbers: int) -> str:
    """Render a table row: a name, the given number of numeric cells, and text cells."""
    kinds = ["", *[' class="number"'] * numbers, *[' class="said"'] * len(cells)]
    return (
        f"<tr>{''.join(f'<td{kind}>{_escape_html(cell)}</td>' for cell, kind in zip(cells, kinds, strict=False))}</tr>"
    )


def _render_settings(tables: Mapping[str, Sequence[tuple[str, str]]]) -> str:
    if not tables:
        return ""
    parts = [
        f"<h3>{_escape_html(name)}</h3>" * bool(name)
        + f"<table><tbody>{''.join(_render_row(r, numbers=0) for r in rows)}</tbody></table>"
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
    return "".join(f"<p>{_escape_html(sentence)}</p>" for sentence in sentences)


def _escape_html(text: str) -> str:
    """Escape text for HTML content and attributes; spell out control characters."""
    return html.escape(to_one_line(text, MAX_SENTENCE_LENGTH), quote=True)


def _dump_json(value: object) -> str:
    """Dump JSON that cannot end its HTML element."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


@cache
def _load_asset(name: str) -> str:
    return (ASSETS_DIR / name).read_text(encoding="utf-8")


def _compute_hash(text: str) -> str:
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
