"""`sylpose box`: where the objects are in the first frame, drawn by the user on a page in the browser."""

from __future__ import annotations

import shlex
import threading
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import msgspec

from sylpose.app import console_output
from sylpose.app.box_hints import hints
from sylpose.app.check import concerns
from sylpose.app.local_page import Answer, Get, LocalPage, as_json, open_browser
from sylpose.atomic_io import boxes_toml, replacing
from sylpose.capture import Session
from sylpose.capture.boxes import UNNAMED, boxes_in
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.input_limits import one_line
from sylpose.report.pictures import jpeg, smaller
from sylpose.tracking.region import volume_from_boxes

__all__ = ["Drawing", "box_aloud"]

# The page's own files.
PAGES = Path(__file__).parent / "pages"
KINDS = {"box.html": "text/html; charset=utf-8", "box.css": "text/css", "box.js": "text/javascript"}
# The longer side of an image on the page, pixels (choice: a large screen's); boxes are in those of the recording.
LONGEST = 2560
# Seconds between two looks at whether it has ended (choice).
ASK = 0.2

T = TypeVar("T")

Numbers = tuple[float, float, float, float]
Boxes = dict[str, dict[str, Box]]


@dataclass(eq=False)
class Drawing:
    """What the page is about, and what comes of it.

    Attributes:
        session: with the boxes that there are.
        start: the frame.
        images: of its cameras, None where one has none.
        out: where the boxes go.
        next: the command that goes on with them.
        saved: what was written, once `ended` is set.
    """

    session: Session
    start: int
    images: tuple[Image | None, ...]
    out: Path
    next: str
    saved: Boxes = field(default_factory=dict)
    ended: threading.Event = field(default_factory=threading.Event)

    def state(self, _: Mapping[str, str]) -> Answer:
        """What the page begins with."""
        rig = self.session.rig
        cameras = [
            {"name": camera.name, "width": camera.size[0], "height": camera.size[1], "image": image is not None}
            for camera, image in zip(rig, self.images, strict=True)
        ]
        boxes = {name: _numbers(self.session.of(name).boxes) for name in self.session.objects}
        recording = self.session.path.resolve().name
        return as_json({"recording": recording, "frame": self.start, "cameras": cameras, "boxes": boxes})

    def image(self, asked: Mapping[str, str]) -> Answer:
        """A camera's image."""
        shown = dict(zip(self.session.rig.names, self.images, strict=True)).get(asked.get("camera", ""))
        if shown is None:
            raise ValueError("no such camera, or it has no image")
        return Answer(jpeg(smaller(shown, LONGEST)), "image/jpeg")

    def hints(self, asked: Mapping[str, str]) -> Answer:
        """What the boxes of one object tell of it in the other cameras."""
        sent = _sent(asked.get("boxes", "").encode(), dict[str, Numbers])
        boxes = next(iter(self._checked({UNNAMED: sent}).values())) if sent else {}
        found = hints(self.session.rig, boxes)
        bands = {
            name: [
                {"of": of, "outline": _points(band.outline), "middle": _points(band.middle)} for of, band in its.items()
            ]
            for name, its in found.bands.items()
        }
        return as_json({"bands": bands, "boxes": _numbers(found.boxes), "wrong": found.wrong})

    def save(self, body: bytes) -> Answer:
        """Writes the boxes of all objects, and ends."""
        sent = {name: its for name, its in _sent(body, dict[str, dict[str, Numbers]]).items() if its}
        if not sent:
            raise ValueError("there is no box yet: drag one around the object, in two cameras or more")
        boxes = self._checked(sent)
        if self.session.masks is not None and {*boxes} != {*self.session.objects}:
            raise ValueError(
                f"{self.session.masks} has masks of {', '.join(self.session.objects)}: the boxes must be of the same "
                f"objects, not of {', '.join(boxes)}"
            )
        for name, its in boxes.items():
            if len(its) > 1:
                try:
                    volume_from_boxes(self.session.rig, its)
                except ValueError as error:
                    raise ValueError(str(error) if len(boxes) == 1 else f"{name}: {error}") from None
        with replacing(self.out) as part:
            part.write_text(_text(boxes), encoding="utf-8")
        self.saved = boxes
        return as_json({"file": str(self.out), "next": self.next}, then=self.ended.set)

    def page(self, port: int) -> LocalPage:
        """All of it, to be served."""

        def file(name: str) -> Get:
            return lambda _: Answer((PAGES / name).read_bytes(), KINDS[name])

        gets = {"": file("box.html"), "box.css": file("box.css"), "box.js": file("box.js")}
        gets |= {"state": self.state, "image": self.image, "hints": self.hints}
        return LocalPage(gets, {"boxes": self.save}, port)

    def _checked(self, sent: Mapping[str, Mapping[str, Numbers]]) -> Boxes:
        """As they are when they are read from the file."""
        given = {name: {camera: Box(*box) for camera, box in its.items()} for name, its in sent.items()}
        return boxes_in(_text(given), self.session.rig, Path(self.out.name))


def box_aloud(
    session: Session, out: Path | None, options: Sequence[str], *, start: int, port: int, browser: bool
) -> Path:
    """Boxes that are drawn on a page, from the headline to what to type next; returns the file.

    Args:
        session: with the boxes that there are.
        out: where the boxes go; None: boxes.toml in the recording.
        options: that `sylpose track` needs too for this recording.
        start: the frame that they are of.
        port: of the page; 0 for any.
        browser: open it there.

    Raises:
        KeyboardInterrupt: with a sentence; nothing was written.
        ValueError: a frame that the recording does not have, or in which no camera has an image.
        OSError: naming the port that is taken.
    """
    console = console_output.make_console()
    console.print(console_output.headline(session))
    words = ["sylpose", "track", str(session.path), *options, *(["--start", str(start)] if start else [])]
    words += [] if out is None else ["--boxes", str(out)]
    problems: list[str] = []
    with closing(session.frames(start, start + 1, on_problem=problems.append)) as frames:
        images = next(frames, None)
    console_output.print_warnings(console, problems)
    if images is None or all(image is None for image in images.images):
        raise ValueError(f"{session.path}: no camera has an image in frame {start}, to draw boxes in")
    file = session.path / "boxes.toml" if out is None else out
    drawing = Drawing(session, start, images.images, file, shlex.join(words))
    try:
        with drawing.page(port) as page:
            opened = browser and open_browser(page.url)
            console.print(f"{'Opened' if opened else 'Open'} {page.url} in a browser", soft_wrap=True)
            console.print("Save there writes the boxes and ends this; Ctrl-C leaves everything as it was.")
            while not drawing.ended.wait(ASK):  # Ctrl-C does not come through on Windows while one waits for good
                pass
    except KeyboardInterrupt:
        raise KeyboardInterrupt("interrupted; no boxes were written") from None
    boxes = drawing.saved
    console_output.print_warnings(console, concerns(replace(session, objects=tuple(boxes), _boxes=boxes), start))
    of = ", ".join(dict.fromkeys(camera for its in boxes.values() for camera in its))
    what = "Boxes" if len(boxes) == 1 else f"Boxes of {', '.join(boxes)}"
    console.print(f"{what} in {of}: {file}", soft_wrap=True)
    console.print(f"Next: {drawing.next}", soft_wrap=True)
    return file


def _sent(data: bytes, kind: type[T]) -> T:
    """What the page has sent."""
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.MsgspecError as error:
        raise ValueError(f"boxes by camera are expected ({one_line(str(error))})") from None


def _text(boxes: Mapping[str, Mapping[str, Box]]) -> str:
    """boxes.toml; of one object without a name, without a table."""
    named = {"" if list(boxes) == [UNNAMED] else name: its for name, its in boxes.items()}
    return boxes_toml({name: _numbers(its) for name, its in named.items()})


def _numbers(boxes: Mapping[str, Box]) -> dict[str, Numbers]:
    return {camera: (box.x, box.y, box.width, box.height) for camera, box in boxes.items()}


def _points(pixels: FloatArray) -> list[list[float]]:
    """As the page draws them: there the middle of the first pixel is at (0.5, 0.5), as boxes are from edge to edge."""
    return [[round(x, 1), round(y, 1)] for x, y in (pixels + 0.5).tolist()]
