"""`sylpose show`: show a result in 3D on a page in the browser."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path

from sylpose.atomic_io import replace_atomically
from sylpose.browser.result_player import ResultPlayer, render_standalone_page
from sylpose.browser.server import HOST, open_browser, serve_viewer
from sylpose.io import calibration
from sylpose.io.capture import Session
from sylpose.io.capture.random_access import RandomAccessReader
from sylpose.report.scene import Scene
from sylpose.runs import console_output
from sylpose.runs.scene import read_scene
from sylpose.runs.source_recording import open_source_recording
from sylpose.runs.view import find_calibration

__all__ = ["read_scenes", "run_show_command"]


def run_show_command(
    result: Path,
    calibration_file: Path | None,
    recording: Path | None,
    *,
    save: Path | None,
    host: str,
    port: int,
    browser: bool,
) -> None:
    """Serve a page with a result until Ctrl-C, or write it to a file.

    Args:
        result: folder of the run, or of one of its objects.
        calibration_file: a calibration; None for that of the run.
        recording: present folder of the recording; None if it was not moved.
        save: an HTML file to write instead of serving the page.
        host, port: address of the page.
        browser: open the page in the browser.

    Raises:
        ValueError, OSError: as `read_scenes` and `serve_viewer`; a file that cannot be written.
    """
    console = console_output.make_console()
    scenes = read_scenes(result, calibration_file)
    rig = calibration.load(find_calibration(result, calibration_file))
    session, reason = _try_open_recording(result, recording)
    first = next(iter(scenes.values()))
    objects = f", {len(scenes)} objects: {', '.join(scenes)}" if len(scenes) > 1 else ""
    console.print(f"{result}: {len(first.cameras)} cameras, {len(first.index)} frames{objects}", soft_wrap=True)
    if reason:
        console_output.print_warnings(console, [f"No images: {reason}"])
    with ExitStack() as stack:
        stills = None if session is None else stack.enter_context(RandomAccessReader(session))
        if save is not None:
            with replace_atomically(save) as part:
                part.write_text(render_standalone_page(scenes, rig, stills), encoding="utf-8")
            console_output.print_files(console, "File", [save])
            return
        server, url = stack.enter_context(serve_viewer(host, port))
        stack.enter_context(ResultPlayer(server, scenes, rig, stills, _format_title(result.resolve())))
        opened = browser and open_browser(url)
        console.print(f"{'Opened' if opened else 'Open'} {url} in a browser; press Ctrl-C to stop.", soft_wrap=True)
        if host != HOST:
            console_output.print_warnings(
                console, ["Anyone with this address can view the page, also from other computers, unencrypted."]
            )
        try:
            while True:
                time.sleep(0.2)
        except KeyboardInterrupt:
            return


def read_scenes(result: Path, calibration_file: Path | None = None) -> dict[str, Scene]:
    """Read the scenes of a run by object; "" is the name of a single object.

    Args:
        result: folder of the run, which has a subfolder for each of several objects.
        calibration_file: a calibration; None for that of the run.

    Raises:
        FileNotFoundError: no trajectory.
        ValueError: invalid files, or files of other cameras; no frames.
    """
    if not result.is_dir():
        raise FileNotFoundError(f"{result}: expected a folder that sylpose track wrote")
    folders = {"": result}
    if not (result / "trajectory.csv").is_file():
        found = sorted(file.parent for file in result.glob("*/trajectory.csv"))
        folders = {folder.name: folder for folder in found} or folders
    scenes = {name: read_scene(folder, calibration_file) for name, folder in folders.items()}
    if not any(len(scene.index) for scene in scenes.values()):
        raise ValueError(f"{result}: contains no frames to show")
    return scenes


def _format_title(result: Path) -> str:
    """Return the recording's name if the results are in its folder, else the folder's name."""
    return result.parent.name if result.name == "sylpose" else result.name


def _try_open_recording(result: Path, recording: Path | None) -> tuple[Session | None, str]:
    """Open the recording, or return why it is unavailable; with an explicit folder that is an error."""
    try:
        return open_source_recording(result, recording), ""
    except (ValueError, OSError) as error:
        if recording is not None:
            raise
        return None, str(error)
