"""report.html: a result as one file that can be mailed, and opened in any browser without anything else.

The page has its script (three.js and uPlot in it, `web/`), its style, all numbers and the images in itself, and forbids
itself to load anything. Whatever comes from files is text in it, never markup.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

from sylpose.atomic_io import replacing
from sylpose.geometry.euler_angles import Angles
from sylpose.input_limits import SENTENCE, one_line
from sylpose.report.camera_consistency import remarks
from sylpose.report.failure_reasons import why_nothing
from sylpose.report.page_data import data_of, images_of
from sylpose.report.plots import summary
from sylpose.report.scene import Scene
from sylpose.results import Observable, Trajectory
from sylpose.rig import Rig

__all__ = ["IMAGES", "Head", "page_of", "write_page"]

ASSETS = Path(__file__).with_name("assets")
# Sentences of a list; where there are more, it says so.
MOST_SAID = 30
# The element of the page that has its images.
IMAGES = "images-data"


@dataclass(frozen=True)
class Head:
    """What a page says besides the result itself.

    Attributes:
        title: what it is of.
        version: of sylpose, which made the result.
        facts: labels and words, at its top.
        settings: by heading, labels and words of what was asked for.
        noticed: sentences about what looked wrong before the run.
        cameras: rows of a camera's name, in how many frames it was used, its inliers and its residual.
        videos: names of overlay videos, as links from the page.
    """

    title: str
    version: str
    facts: Sequence[tuple[str, str]] = ()
    settings: Mapping[str, Sequence[tuple[str, str]]] | None = None
    noticed: Sequence[str] = ()
    cameras: Sequence[Sequence[str]] = ()
    videos: Sequence[str] = ()


def write_page(path: Path | str, trajectory: Trajectory, scene: Scene, rig: Rig, angles: Angles, head: Head) -> None:
    """Writes the page; replaced when it is there.

    Raises:
        ValueError: a trajectory without frames.
        OSError: naming the file, when it cannot be written.
    """
    page = page_of(trajectory, scene, rig, angles, head)
    with replacing(path) as part:
        part.write_text(page, encoding="utf-8", newline="\n")


def page_of(trajectory: Trajectory, scene: Scene, rig: Rig, angles: Angles, head: Head) -> str:
    """The page as text.

    Args:
        trajectory: of at least one frame.
        scene: of it (`scene_of`).
        rig: whose lenses the scene's images were taken by.
        angles: which three are shown.
        head: what else it says.
    """
    said, data = summary(trajectory), data_of(trajectory, scene, angles)
    images = images_of(trajectory, scene, rig)
    failed = not any(f.world_from_object is not None for f in trajectory)
    script, style = _asset("report.js"), _asset("report.css")
    return Template(_asset("page.html")).substitute(
        script_hash=_hash(script),
        style_hash=_hash(style),
        script=script,
        style=style,
        version=_text(head.version),
        title=_text(head.title),
        kind=" failed-run" if failed else "",
        summary=_text(f"{said[:1].upper()}{said[1:]}."),
        facts="".join(f"<div><dt>{_text(label)}</dt><dd>{_text(words)}</dd></div>" for label, words in head.facts),
        notices=_notices(trajectory, head, failed=failed),
        videos=_videos(head.videos),
        time_axis=_time_axis(data),
        statuses=_statuses(trajectory),
        cameras="".join(_row(row, numbers=len(row) - 1) for row in head.cameras),
        settings=_settings(head.settings or {}),
        notes=_notes(data, images, scene, head.version),
        data=_json(data),
        images=_json(images),
    )


def _time_axis(data: Mapping[str, Any]) -> str:
    if not data["inSeconds"]:
        return "frames"
    return f"seconds since {data['since']:.3f}" if data["since"] else "seconds"


def _notices(trajectory: Trajectory, head: Head, *, failed: bool) -> str:
    wide = " failed" if failed else ""
    # What looked wrong before is the likeliest cause of what went wrong then.
    parts = [("What looked wrong before the run", head.noticed, wide)]
    if failed:
        parts.append(("Why there is no pose", why_nothing(trajectory), wide))
    parts.append(("What is to be said of the cameras", remarks(trajectory), ""))
    shown = [
        f'<section class="notice{kind}"><h2>{title}</h2><ul>{_items(said)}</ul></section>'
        for title, said, kind in parts
        if said
    ]
    return f'<div class="notices">{"".join(shown)}</div>' if shown else ""


def _items(sentences: Sequence[str]) -> str:
    shown = [*sentences[:MOST_SAID]]
    if len(sentences) > MOST_SAID:
        shown.append(f"and {len(sentences) - MOST_SAID} more")
    return "".join(f"<li>{_text(sentence)}</li>" for sentence in shown)


def _videos(names: Sequence[str]) -> str:
    if not names:
        return ""
    links = ", ".join(f'<a href="{_text(quote(name))}">{_text(name)}</a>' for name in names)
    return f"<p><small>All frames, where it lies beside this page: {links}</small></p>"


def _statuses(trajectory: Trajectory) -> str:
    counts = Counter(frame.status for frame in trajectory)
    rows = [(status.value, str(count), status.text) for status, count in counts.most_common()]
    seen = Counter(frame.observable for frame in trajectory if frame.world_from_object is not None)
    rows += [(o.value, str(n), o.text) for o, n in seen.most_common() if o is not Observable.ALL]
    return "".join(_row(row, numbers=1) for row in rows)


def _row(cells: Sequence[str], numbers: int) -> str:
    """A table's row: a name, so many numbers, and words."""
    kinds = ["", *[' class="number"'] * numbers, *[' class="said"'] * len(cells)]
    return f"<tr>{''.join(f'<td{kind}>{_text(cell)}</td>' for cell, kind in zip(cells, kinds, strict=False))}</tr>"


def _settings(tables: Mapping[str, Sequence[tuple[str, str]]]) -> str:
    if not tables:
        return ""
    parts = [
        f"<h3>{_text(name)}</h3>" * bool(name)
        + f"<table><tbody>{''.join(_row(r, numbers=0) for r in rows)}</tbody></table>"
        for name, rows in tables.items()
    ]
    return (
        '<section class="card settings"><details><summary>What was asked for, checksums and versions</summary>'
        f"{''.join(parts)}</details></section>"
    )


def _notes(data: Mapping[str, Any], images: Mapping[str, Any], scene: Scene, version: str) -> str:
    """What is left out of the page, and what it is made of."""
    said = []
    if data["shown"] < data["total"]:
        said.append(
            f"Shown are {data['shown']} of {data['total']} frames; of those that each stands for it is the one that went "
            "worst. trajectory.csv has all."
        )
    if images["index"]:
        said.append(f"Images are of {len(images['index'])} frames, made smaller; the one that is nearest is shown.")
    if data["drawnPoints"] < len(scene.points):
        said.append(f"Drawn are {data['drawnPoints']} of {len(scene.points)} points on the object.")
    said.append(f"Made by sylpose {version}; with three.js and uPlot, whose licences (MIT) are in this page's script.")
    return "".join(f"<p>{_text(sentence)}</p>" for sentence in said)


def _text(words: str) -> str:
    """Words as HTML has them, in an attribute too; characters that steer, such as the direction of writing, spelt out."""
    return html.escape(one_line(words, SENTENCE), quote=True)


def _json(value: object) -> str:
    """JSON that cannot end the element that it stands in."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


@cache
def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """What a browser compares a script or a style with before it takes it."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
