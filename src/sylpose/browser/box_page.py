"""Page on which the user draws the objects' boxes in the first frame, as a file of boxes (`sylpose box`)."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import msgspec

from sylpose.atomic_io import format_boxes_toml, replace_atomically
from sylpose.browser.box_hints import EpipolarBand, compute_box_hints
from sylpose.browser.server import GetHandler, Response, json_response, serve_page
from sylpose.frames import Box
from sylpose.geometry.arrays import Image
from sylpose.input_limits import to_one_line
from sylpose.io.capture import Session
from sylpose.io.capture.boxes import DEFAULT_OBJECT_NAME, parse_boxes
from sylpose.report.drawing import encode_jpeg, shrink_image
from sylpose.tracking.joint_side.object_model import carve_box_volume

# Folder of the page's files.
PAGE_FOLDER = Path(__file__).parent / "pages"
MEDIA_TYPES = {"box.html": "text/html; charset=utf-8", "box.css": "text/css", "box.js": "text/javascript"}
# Longer side of an image on the page in pixels (choice: a large screen's); boxes use the recording's pixels.
MAX_IMAGE_SIDE = 2560

T = TypeVar("T")

Numbers = tuple[float, float, float, float]
Boxes = dict[str, dict[str, Box]]


@dataclass(eq=False)
class BoxEditor:
    """State of the page: its inputs and the boxes that were saved.

    Attributes:
        session: the recording, with its existing boxes.
        start: number of the frame in which boxes are drawn.
        images: image of each camera; None if a camera has none.
        out: file to which the boxes are written.
        next_command: command that continues with the boxes.
        saved: boxes that were written, once `ended` is set.
    """

    session: Session
    start: int
    images: tuple[Image | None, ...]
    out: Path
    next_command: str
    saved: Boxes = field(default_factory=dict)
    ended: threading.Event = field(default_factory=threading.Event)

    def send_state(self, _: Mapping[str, str]) -> Response:
        """Return the initial state of the page as JSON."""
        rig = self.session.rig
        cameras = [
            {"name": camera.name, "width": camera.size[0], "height": camera.size[1], "image": image is not None}
            for camera, image in zip(rig, self.images, strict=True)
        ]
        boxes = {name: _boxes_to_numbers(self.session.select_object(name).boxes) for name in self.session.objects}
        recording = self.session.path.resolve().name
        return json_response({"recording": recording, "frame": self.start, "cameras": cameras, "boxes": boxes})

    def send_image(self, query: Mapping[str, str]) -> Response:
        """Return a camera's image as JPEG."""
        image = dict(zip(self.session.rig.names, self.images, strict=True)).get(query.get("camera", ""))
        if image is None:
            raise ValueError("no such camera, or it has no image")
        return Response(encode_jpeg(shrink_image(image, MAX_IMAGE_SIDE)), "image/jpeg")

    def send_hints(self, query: Mapping[str, str]) -> Response:
        """Return epipolar bands and suggested boxes in the other cameras for one object's boxes."""
        numbers = _decode_json(query.get("boxes", "").encode(), dict[str, Numbers])
        boxes = next(iter(self._validate({DEFAULT_OBJECT_NAME: numbers}).values())) if numbers else {}
        found = compute_box_hints(self.session.rig, boxes)

        def encode(other: str, band: EpipolarBand) -> dict[str, object]:
            # On the page, the center of the first pixel is at (0.5, 0.5).
            outline, curve = ((pixels + 0.5).round(1).tolist() for pixels in (band.outline, band.center_curve))
            return {"of": other, "outline": outline, "middle": curve}

        bands = {name: [encode(*band) for band in by_other.items()] for name, by_other in found.bands.items()}
        return json_response({"bands": bands, "boxes": _boxes_to_numbers(found.boxes), "wrong": found.error})

    def save(self, body: bytes) -> Response:
        """Write the boxes of all objects and end the command."""
        decoded = _decode_json(body, dict[str, dict[str, Numbers]])
        sent = {name: by_camera for name, by_camera in decoded.items() if by_camera}
        if not sent:
            raise ValueError("there is no box yet: drag one around the object in at least two cameras")
        boxes = self._validate(sent)
        if self.session.masks is not None and {*boxes} != {*self.session.objects}:
            raise ValueError(
                f"{self.session.masks} has masks of {', '.join(self.session.objects)}: the boxes must be of the same "
                f"objects, not of {', '.join(boxes)}"
            )
        for name, by_camera in boxes.items():
            if len(by_camera) > 1:
                try:
                    carve_box_volume(self.session.rig, by_camera)
                except ValueError as error:
                    raise ValueError(str(error) if len(boxes) == 1 else f"{name}: {error}") from None
        with replace_atomically(self.out) as part:
            part.write_text(_format_boxes_toml(boxes), encoding="utf-8")
        self.saved = boxes
        return json_response({"file": str(self.out), "next": self.next_command}, on_sent=self.ended.set)

    def serve(self, port: int) -> AbstractContextManager[str]:
        """Serve the page; the context manager returns its URL."""

        def file(name: str) -> GetHandler:
            return lambda _: Response((PAGE_FOLDER / name).read_bytes(), MEDIA_TYPES[name])

        gets = {"": file("box.html"), "box.css": file("box.css"), "box.js": file("box.js")}
        gets |= {"state": self.send_state, "image": self.send_image, "hints": self.send_hints}
        return serve_page(gets, {"boxes": self.save}, port)

    def _validate(self, sent: Mapping[str, Mapping[str, Numbers]]) -> Boxes:
        """Validate boxes exactly as if they were read from a file."""
        given = {name: {camera: Box(*box) for camera, box in by_camera.items()} for name, by_camera in sent.items()}
        return parse_boxes(_format_boxes_toml(given), self.session.rig, Path(self.out.name))


def _decode_json(data: bytes, kind: type[T]) -> T:
    """Decode JSON sent by the page."""
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.MsgspecError as error:
        raise ValueError(f"boxes by camera are expected ({to_one_line(str(error))})") from None


def _format_boxes_toml(boxes: Mapping[str, Mapping[str, Box]]) -> str:
    """Return the content of boxes.toml; a single unnamed object gets no table."""
    named = {"" if list(boxes) == [DEFAULT_OBJECT_NAME] else name: by_camera for name, by_camera in boxes.items()}
    return format_boxes_toml({name: _boxes_to_numbers(by_camera) for name, by_camera in named.items()})


def _boxes_to_numbers(boxes: Mapping[str, Box]) -> dict[str, Numbers]:
    return {camera: (box.x, box.y, box.width, box.height) for camera, box in boxes.items()}
