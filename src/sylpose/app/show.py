"""`sylpose show`: a result in three dimensions, on a page in the browser."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path

from sylpose import calibration
from sylpose.app import console_output
from sylpose.app.local_page import HOST, open_browser
from sylpose.app.result_player import Player, saved_page
from sylpose.app.scene import read_scene
from sylpose.app.source_recording import recording_of
from sylpose.app.view import calibration_of
from sylpose.app.viewer_server import viewer_server
from sylpose.atomic_io import replacing
from sylpose.capture import Session
from sylpose.capture.random_access import SingleFrames
from sylpose.report.scene import Scene

__all__ = ["read_scenes", "show_aloud"]


def show_aloud(
    result: Path,
    given: Path | None,
    moved: Path | None,
    *,
    save: Path | None,
    host: str,
    port: int,
    browser: bool,
) -> None:
    """Shows a result until Ctrl-C, or writes it into a file.

    Args:
        result: folder of the run, or of one of its objects.
        given: a calibration; None for that of the run.
        moved: where the recording is now; None: where it was.
        save: an HTML file that shows the same, to be written instead.
        host, port: where the page listens.
        browser: open it there.

    Raises:
        ValueError, OSError: as `read_scenes` and `viewer_server`; a file that cannot be written.
    """
    console = console_output.make_console()
    scenes = read_scenes(result, given)
    rig = calibration.load(calibration_of(result, given))
    session, why = _recording(result, moved)
    first = next(iter(scenes.values()))
    objects = f", {len(scenes)} objects: {', '.join(scenes)}" if len(scenes) > 1 else ""
    console.print(f"{result}: {len(first.cameras)} cameras, {len(first.index)} frames{objects}", soft_wrap=True)
    if why:
        console_output.print_warnings(console, [f"No images: {why}"])
    with ExitStack() as stack:
        stills = None if session is None else stack.enter_context(SingleFrames(session))
        if save is not None:
            with replacing(save) as part:
                part.write_text(saved_page(scenes, rig, stills), encoding="utf-8")
            console_output.print_files(console, "File", [save])
            return
        server, url = stack.enter_context(viewer_server(host, port))
        stack.enter_context(Player(server, scenes, rig, stills, _title(result.resolve())))
        opened = browser and open_browser(url)
        console.print(f"{'Opened' if opened else 'Open'} {url} in a browser; Ctrl-C ends it.", soft_wrap=True)
        if host != HOST:
            console_output.print_warnings(
                console, ["Who knows this address can see it, from other computers too, unencrypted."]
            )
        try:
            while True:
                time.sleep(0.2)
        except KeyboardInterrupt:
            return


def read_scenes(result: Path, given: Path | None = None) -> dict[str, Scene]:
    """By object, what is shown of a run; "" for one that has no name.

    Args:
        result: folder of the run, which may have a folder for each of several objects.
        given: a calibration; None for that of the run.

    Raises:
        FileNotFoundError: there is no trajectory.
        ValueError: files that are not what they should be, or of other cameras; no frame.
    """
    if not result.is_dir():
        raise FileNotFoundError(f"{result}: a folder that sylpose track wrote is expected")
    folders = {"": result}
    if not (result / "trajectory.csv").is_file():
        found = sorted(file.parent for file in result.glob("*/trajectory.csv"))
        folders = {folder.name: folder for folder in found} or folders
    scenes = {name: read_scene(folder, given) for name, folder in folders.items()}
    if not any(len(scene.index) for scene in scenes.values()):
        raise ValueError(f"{result}: no frame in it that could be shown")
    return scenes


def _title(result: Path) -> str:
    """The recording's name, where the results are in it."""
    return result.parent.name if result.name == "sylpose" else result.name


def _recording(result: Path, moved: Path | None) -> tuple[Session | None, str]:
    """The recording, or why there is none; where somebody said where it is, that is an error."""
    try:
        return recording_of(result, moved), ""
    except (ValueError, OSError) as error:
        if moved is not None:
            raise
        return None, str(error)
