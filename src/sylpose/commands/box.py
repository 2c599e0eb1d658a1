"""`sylpose box`: draw the objects' boxes in the first frame on a page in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from sylpose.commands.app import INPUT, OUTPUT, command, option
from sylpose.commands.options import FrameOffset, PageOptions, RecordingOptions

# Seconds between two checks whether the boxes are saved (choice).
POLL_INTERVAL = 0.2


@dataclass(frozen=True, kw_only=True)
class BoxOptions(PageOptions, RecordingOptions):
    """Options of `sylpose box`.

    Attributes:
        out: Write the boxes here; default: SESSION/boxes.toml.
        start: Draw in this frame, the first to track.
    """

    out: Annotated[Path | None, option("--out FILE", OUTPUT)] = None
    frame_offset: FrameOffset = ()
    start: Annotated[int, option("--start N", INPUT)] = 0


@command("Draw object boxes on a page in the browser.")
def box(options: BoxOptions) -> None:
    """Draw boxes of one or several objects in the first frame of each camera, on a page in the browser.

    The page shows where the object of one box can be in the other cameras; from two boxes it suggests the rest.
    Existing boxes are loaded. Only this computer can open the page.

    Examples:
        sylpose box recording
        sylpose box recording --start 100 --out at_100.toml
    """
    import shlex
    from contextlib import closing
    from dataclasses import replace

    from sylpose.browser import server
    from sylpose.browser.box_page import BoxEditor
    from sylpose.io.capture.live import is_live
    from sylpose.runs import console_output
    from sylpose.runs.check import check_session

    start, out = options.start, options.out
    if is_live(options.session):
        raise ValueError(f"{options.session}: has live cameras; boxes can only be drawn in recordings")
    session = options.open(out if out is not None and out.exists() else None, options.frame_offset)
    console = console_output.make_console()
    console.print(console_output.format_headline(session))
    problems: list[str] = []
    with closing(session.frames(start, start + 1, on_problem=problems.append)) as frames:
        images = next(frames, None)
    console_output.print_warnings(console, problems)
    if images is None or all(image is None for image in images.images):
        raise ValueError(f"{session.path}: no camera has an image in frame {start} to draw boxes in")
    file = session.path / "boxes.toml" if out is None else out
    editor = BoxEditor(session, start, images.images, file, shlex.join(_continue_with_boxes(options)))
    try:
        with editor.serve(options.port) as url:
            opened = options.browser and server.open_browser(url)
            console.print(f"{'Opened' if opened else 'Open'} {url} in a browser", soft_wrap=True)
            console.print("Save on that page writes the boxes and ends this command; Ctrl-C changes nothing.")
            while not editor.ended.wait(POLL_INTERVAL):  # on Windows, Ctrl-C does not interrupt a wait without timeout
                pass
    except KeyboardInterrupt:
        raise KeyboardInterrupt("interrupted; no boxes were written") from None
    boxes = editor.saved
    console_output.print_warnings(console, check_session(replace(session, objects=tuple(boxes), _boxes=boxes), start))
    cameras = ", ".join(dict.fromkeys(camera for by_camera in boxes.values() for camera in by_camera))
    label = "Boxes" if len(boxes) == 1 else f"Boxes of {', '.join(boxes)}"
    console.print(f"{label} in {cameras}: {file}", soft_wrap=True)
    console.print(f"Next: {editor.next_command}", soft_wrap=True)


def _continue_with_boxes(options: BoxOptions) -> list[str]:
    """Return the command that tracks the recording with the boxes, with the options that it needs as well."""
    values: dict[str, tuple[object, ...]] = {
        "--calibration": (options.calibration,),
        "--masks": (options.masks,),
        "--frame-offset": options.frame_offset,
        "--video": options.video,
        "--exclude-camera": options.exclude_camera,
        "--rate": (options.rate,),
        "--start": (options.start or None,),
        "--boxes": (options.out,),
    }
    words = ((name, str(value)) for name, given in values.items() for value in given if value is not None)
    return ["sylpose", "track", str(options.session), *(word for pair in words for word in pair)]
