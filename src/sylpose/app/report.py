"""`sylpose report`: the page of a finished run made anew, with the images that there are."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path

import numpy as np

from sylpose.app import console_output
from sylpose.app.page import make_page
from sylpose.app.run_metadata import SETTINGS, root_of, settings_of, table
from sylpose.app.source_recording import recording_of
from sylpose.app.thumbnails import Album
from sylpose.input_limits import bytes_of, told
from sylpose.report.formats import PAGE
from sylpose.report.page import IMAGES
from sylpose.report.scene import Stills

__all__ = ["report_aloud"]

# Bytes of a page whose images are taken over: more than any has.
LARGEST = 2**25


def report_aloud(result: Path) -> None:
    """Makes the pages of a finished run anew, and says which: one, or one for each object.

    Raises:
        FileNotFoundError: there is no trajectory.
        ValueError, OSError: files that are not what they should be, or cannot be written.
    """
    folder = result if result.is_dir() else result.parent
    objects = sorted(file.parent for file in folder.glob("*/trajectory.csv") if (folder / SETTINGS).is_file())
    folders = [folder] if (folder / "trajectory.csv").exists() or not objects else objects
    console, pages = console_output.make_console(), list[Path]()
    for its in folders:
        stills, said = _images_again(its)
        pages.append(make_page(its, stills))
        if said:
            console_output.print_warnings(console, [said])
    console_output.print_files(console, "Files" if len(pages) > 1 else "File", pages)


def _images_again(folder: Path) -> tuple[Stills, str]:
    """The images of the page that is there, else of the recording, if that is as it was; else none, and why."""
    if (folder / PAGE).is_file():
        return _stills_in(folder / PAGE), ""
    settings = settings_of(folder)
    try:
        session = recording_of(folder)
    except (ValueError, OSError) as error:
        return Stills(), f"{folder}: a page without images: {error}"
    options, album = table(settings, "options"), Album(len(session.rig))
    start, every, stop = (options.get(name) for name in ("start", "every", "stop"))
    if not all(isinstance(number, int | None) for number in (start, every, stop)):
        raise ValueError(f"{root_of(folder) / SETTINGS}: start, stop and every must be whole numbers")
    for frames in session.frames(start or 0, stop, every or 1, lambda _: None):
        album.put(frames)
    return album.stills(), ""


def _stills_in(page: Path) -> Stills:
    """The images of a page.

    Raises:
        ValueError: naming the file: it is no such page.
    """
    content = bytes_of(page, LARGEST).decode("utf-8", "replace")
    with told(page):
        found = re.search(f'<script type="application/json" id="{IMAGES}">(.*?)</script>', content, re.S)
        if found is None:
            raise ValueError("no page of sylpose; remove it, and one is made without it")
        try:
            said = json.loads(found[1])
            index = np.array([int(number) for number in said["index"]], np.int64)
            images = tuple(
                tuple(None if file is None else base64.b64decode(file, validate=True) for file in files)
                for files in said["files"]
            )
        except (KeyError, TypeError) as error:
            raise ValueError(f"its images are not as sylpose writes them ({error!r})") from None
        if len(index) != len(images):
            raise ValueError("its images are not as sylpose writes them")
        return Stills(index, images)
