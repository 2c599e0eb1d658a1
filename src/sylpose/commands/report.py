"""`sylpose report`: rebuild the report page of a finished run with the available images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sylpose.commands.app import CommandOptions, command

if TYPE_CHECKING:
    from sylpose.report.scene import Thumbnails


@dataclass(frozen=True, kw_only=True)
class ReportOptions(CommandOptions):
    """Options of `sylpose report`.

    Attributes:
        result: Recording that was tracked, or the folder that sylpose track wrote.
    """

    result: Annotated[Path, typer.Argument(metavar="RESULT")]


@command("Rebuild the report page of a finished run.")
def report(options: ReportOptions) -> None:
    """Rebuild report.html of a finished run, for example after editing its files or after an update of sylpose.

    It is built from the files in the folder; images come from the existing page, or else from the recording.

    Examples:
        sylpose report recording
    """
    from sylpose.runs import console_output
    from sylpose.runs.page import write_report_page
    from sylpose.runs.run_metadata import SETTINGS, TRAJECTORY, find_result

    folder = find_result(options.result if options.result.is_dir() else options.result.parent)
    objects = sorted(file.parent for file in folder.glob(f"*/{TRAJECTORY}") if (folder / SETTINGS).is_file())
    folders = [folder] if (folder / TRAJECTORY).exists() or not objects else objects
    console, pages = console_output.make_console(), list[Path]()
    for folder_of_object in folders:
        stills, warning = _collect_stills(folder_of_object)
        pages.append(write_report_page(folder_of_object, stills))
        console_output.print_warnings(console, [warning] if warning else [])
    console_output.print_files(console, "Files" if len(pages) > 1 else "File", pages)


def _collect_stills(folder: Path) -> tuple[Thumbnails, str]:
    """Return the images of the existing page, or else of the unchanged recording, or else none with the reason."""
    from sylpose.report.files import PAGE_FILE
    from sylpose.report.page import read_stills
    from sylpose.report.scene import Thumbnails
    from sylpose.runs.page import ThumbnailAlbum
    from sylpose.runs.run_metadata import find_settings, open_source_recording, read_settings, settings_table

    if (folder / PAGE_FILE).is_file():
        return read_stills(folder / PAGE_FILE), ""
    settings = read_settings(folder)
    try:
        session = open_source_recording(folder)
    except (ValueError, OSError) as error:
        return Thumbnails(), f"{folder}: the page has no images: {error}"
    options, album = settings_table(settings, "options"), ThumbnailAlbum(len(session.rig))
    start, every, stop = (options.get(name) for name in ("start", "every", "stop"))
    if not all(isinstance(number, int | None) for number in (start, every, stop)):
        raise ValueError(f"{find_settings(folder)}: start, stop and every must be whole numbers")
    for frames in session.frames(start or 0, stop, every or 1, lambda _: None):
        album.put(frames)
    return album.stills(), ""
