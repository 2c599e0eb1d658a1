"""`sylpose report`: rebuild the report page of a finished run with the available images."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path

import numpy as np

from sylpose.input_limits import input_errors, read_bytes
from sylpose.report.formats import PAGE_FILE
from sylpose.report.page import IMAGES_ELEMENT_ID
from sylpose.report.scene import Thumbnails
from sylpose.runs import console_output
from sylpose.runs.page import write_report_page
from sylpose.runs.run_metadata import SETTINGS, find_run_folder, read_settings, settings_table
from sylpose.runs.source_recording import open_source_recording
from sylpose.runs.thumbnails import ThumbnailAlbum

__all__ = ["run_report_command"]

# Largest size in bytes of a page whose images are reused; no page is as large.
MAX_PAGE_BYTES = 2**25


def run_report_command(result: Path) -> None:
    """Rebuild the pages of a finished run, one per object, and print their paths.

    Args:
        result: folder of the run or of one of its objects, or a file in it.

    Raises:
        FileNotFoundError: no trajectory.
        ValueError, OSError: invalid files, or files that cannot be written.
    """
    folder = result if result.is_dir() else result.parent
    objects = sorted(file.parent for file in folder.glob("*/trajectory.csv") if (folder / SETTINGS).is_file())
    folders = [folder] if (folder / "trajectory.csv").exists() or not objects else objects
    console, pages = console_output.make_console(), list[Path]()
    for folder_of_object in folders:
        stills, warning = _collect_stills(folder_of_object)
        pages.append(write_report_page(folder_of_object, stills))
        if warning:
            console_output.print_warnings(console, [warning])
    console_output.print_files(console, "Files" if len(pages) > 1 else "File", pages)


def _collect_stills(folder: Path) -> tuple[Thumbnails, str]:
    """Return the images of the existing page, or else of the unchanged recording, or else none with the reason."""
    if (folder / PAGE_FILE).is_file():
        return _read_stills(folder / PAGE_FILE), ""
    settings = read_settings(folder)
    try:
        session = open_source_recording(folder)
    except (ValueError, OSError) as error:
        return Thumbnails(), f"{folder}: the page has no images: {error}"
    options, album = settings_table(settings, "options"), ThumbnailAlbum(len(session.rig))
    start, every, stop = (options.get(name) for name in ("start", "every", "stop"))
    if not all(isinstance(number, int | None) for number in (start, every, stop)):
        raise ValueError(f"{find_run_folder(folder) / SETTINGS}: start, stop and every must be whole numbers")
    for frames in session.frames(start or 0, stop, every or 1, lambda _: None):
        album.put(frames)
    return album.stills(), ""


def _read_stills(page: Path) -> Thumbnails:
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
            data = json.loads(found[1])
            index = np.array([int(number) for number in data["index"]], np.int64)
            images = tuple(
                tuple(None if file is None else base64.b64decode(file, validate=True) for file in files)
                for files in data["files"]
            )
        except (KeyError, TypeError) as error:
            raise ValueError(f"its images are not in sylpose's format ({error!r})") from None
        if len(index) != len(images):
            raise ValueError("its images are not in sylpose's format")
        return Thumbnails(index, images)
