"""`sylpose show`: show a result in 3D on a page in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sylpose.commands.app import INPUT, LIVE, OUTPUT, command, option
from sylpose.commands.options import PageOptions


@dataclass(frozen=True, kw_only=True)
class ShowOptions(PageOptions):
    """Options of `sylpose show`.

    Attributes:
        result: Recording that was tracked, or the folder that sylpose track wrote.
        calibration: Read this calibration; default: the one of the run.
        recording: Read the images from here if the recording was moved.
        save: Write a self-contained page and exit.
        host: Serve the page at this address; 0.0.0.0: also for other computers.
    """

    result: Annotated[Path, typer.Argument(metavar="RESULT")]
    calibration: Annotated[Path | None, option("--calibration FILE", INPUT)] = None
    recording: Annotated[Path | None, option("--recording DIR", INPUT)] = None
    save: Annotated[Path | None, option("--save FILE.html", OUTPUT)] = None
    host: Annotated[str, option("--host HOST", LIVE)] = "127.0.0.1"


@command("Show a result in 3D on a page in the browser.")
def show(options: ShowOptions) -> None:
    """Show the cameras with their images, the object and its path in 3D on a page in the browser. Ctrl-C stops it.

    Requires the extra `viewer`: pip install 'sylpose[viewer]'.

    Examples:
        sylpose show recording
        sylpose show recording --save scene.html
    """
    import time
    from contextlib import ExitStack, suppress

    from sylpose.atomic_io import replace_atomically
    from sylpose.browser import server
    from sylpose.browser.viewer import ResultPlayer, render_standalone_page
    from sylpose.io import calibration
    from sylpose.io.capture.random_access import RandomAccessReader
    from sylpose.runs import console_output
    from sylpose.runs.page import read_scenes
    from sylpose.runs.run_metadata import find_result, open_source_recording
    from sylpose.runs.view import find_calibration

    console, result = console_output.make_console(), find_result(options.result)
    scenes = read_scenes(result, options.calibration)
    rig = calibration.load(find_calibration(result, options.calibration))
    session, warnings = None, list[str]()
    try:
        session = open_source_recording(result, options.recording)
    except (ValueError, OSError) as error:
        if options.recording is not None:
            raise
        warnings.append(f"No images: {error}")
    first = next(iter(scenes.values()))
    objects = f", {len(scenes)} objects: {', '.join(scenes)}" if len(scenes) > 1 else ""
    console.print(f"{result}: {len(first.cameras)} cameras, {len(first.index)} frames{objects}", soft_wrap=True)
    console_output.print_warnings(console, warnings)
    with ExitStack() as stack:
        stills = None if session is None else stack.enter_context(RandomAccessReader(session))
        if options.save is not None:
            with replace_atomically(options.save) as part:
                part.write_text(render_standalone_page(scenes, rig, stills), encoding="utf-8")
            console_output.print_files(console, "File", [options.save])
            return
        viewer, url = stack.enter_context(server.serve_viewer(options.host, options.port))
        folder = result.resolve()  # named like the recording that it is in
        title = folder.parent.name if folder.name == "sylpose" else folder.name
        stack.enter_context(ResultPlayer(viewer, scenes, rig, stills, title))
        opened = options.browser and server.open_browser(url)
        console.print(f"{'Opened' if opened else 'Open'} {url} in a browser; press Ctrl-C to stop.", soft_wrap=True)
        if options.host != server.HOST:
            warning = "Anyone with this address can view the page, also from other computers, unencrypted."
            console_output.print_warnings(console, [warning])
        with suppress(KeyboardInterrupt):
            while True:
                time.sleep(0.2)
