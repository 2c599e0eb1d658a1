"""report.html of a run, built only from the files in its folder."""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sylpose import __version__
from sylpose.geometry.euler_angles import PAN_TILT_ROLL, parse_euler_angles
from sylpose.input_limits import input_errors
from sylpose.io.object_files import OBJECT_FILE
from sylpose.report.formats import PAGE_FILE
from sylpose.report.page import PageHeader, write_page
from sylpose.report.scene import Thumbnails, build_scene
from sylpose.results import Trajectory
from sylpose.runs import console_output
from sylpose.runs.run_metadata import SETTINGS, find_run_folder, read_settings, settings_table
from sylpose.runs.scene import find_used_calibration, load_rig, read_cloud
from sylpose.runs.view import read_result

__all__ = ["write_report_page"]

# Packages of settings.toml whose versions the page's header shows.
_SHOWN_PACKAGES = {"numpy": "NumPy", "opencv": "OpenCV"}
_VIDEO = re.compile(r"overlay(_(\d+))?\.mp4")


def write_report_page(folder: Path, stills: Thumbnails) -> Path:
    """Write report.html into the folder of a run, or of one of its objects, and return its path.

    Args:
        folder: folder with the trajectory.
        stills: images of the scene.

    Raises:
        FileNotFoundError: no trajectory.
        ValueError: a trajectory without frames; invalid files.
        OSError: the file cannot be written; the message names it.
    """
    trajectory, settings = read_result(folder), read_settings(folder)
    rig = load_rig(trajectory, find_used_calibration(folder))
    scene = build_scene(trajectory, rig, read_cloud(folder / OBJECT_FILE, rig.names), stills)
    axes = settings.get("options", {}).get("angles")
    with input_errors(find_run_folder(folder) / SETTINGS):
        angles = PAN_TILT_ROLL if axes is None else parse_euler_angles(str(axes))
    write_page(folder / PAGE_FILE, trajectory, scene, rig, angles, _make_head(folder, trajectory, settings))
    return folder / PAGE_FILE


def _make_head(folder: Path, trajectory: Trajectory, settings: Mapping[str, Any]) -> PageHeader:
    root, facts = find_run_folder(folder), list[tuple[str, str]]()
    title = Path(str(settings.get("recording") or folder.resolve())).name or "sylpose"
    options, versions, checksums = (settings_table(settings, name) for name in ("options", "versions", "checksums"))
    if isinstance(started := settings.get("started"), datetime):
        facts.append(("Started", f"{started.astimezone(UTC):%Y-%m-%d %H:%M} UTC"))
    if "method" in options:
        refined = ", refined jointly" if options.get("smooth") else ""
        facts += [("Method", f"{options['method']}{refined}"), ("Features", str(options.get("features", "")))]
    if "model" in options:
        facts.append(("Object", Path(str(options["model"])).name))
    facts += [("Cameras", str(len(trajectory.camera_names))), ("Unit of length", trajectory.unit or "unknown")]
    if "calibration" in settings:
        digest = f", {str(checksums['calibration'])[:12]}" if "calibration" in checksums else ""
        facts.append(("Calibration", f"{Path(str(settings['calibration'])).name}{digest}"))
    software = [f"sylpose {versions['sylpose']}"] if "sylpose" in versions else []
    software += [
        f"{label} {version}"
        for name, label in _SHOWN_PACKAGES.items()
        for package, version in versions.items()
        if str(package).startswith(name)
    ]
    if software:
        facts.append(("Versions", ", ".join(software)))
    return PageHeader(
        title=title if root == folder else f"{title}, {folder.name}",
        version=__version__,
        facts=facts,
        settings=_settings_rows(settings),
        input_warnings=[str(text) for text in found] if isinstance(found := settings.get("warnings"), list) else [],
        cameras=console_output.build_camera_rows(trajectory),
        videos=_overlay_links(root, "" if root == folder else "../"),
    )


def _settings_rows(settings: Mapping[str, Any]) -> dict[str, list[tuple[str, str]]]:
    """Return the contents of settings.toml by table, first the keys outside of tables."""
    tables = {"": {key: value for key, value in settings.items() if not isinstance(value, dict) and key != "warnings"}}
    tables |= {name: table for name, table in settings.items() if isinstance(table, dict)}
    return {
        name: [(key, _format_value(value)) for key, value in table.items()] for name, table in tables.items() if table
    }


def _format_value(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _overlay_links(root: Path, prefix: str) -> list[str]:
    """Return links to the parts of the overlay video, in order."""
    found = [match for file in root.glob("overlay*.mp4") if (match := _VIDEO.fullmatch(file.name))]
    return [f"{prefix}{match[0]}" for match in sorted(found, key=lambda match: int(match[2] or -1))]
