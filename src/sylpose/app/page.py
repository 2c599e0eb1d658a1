"""report.html of a run, made of the files in its folder alone."""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sylpose import __version__
from sylpose.app import console_output
from sylpose.app.object_files import OBJECT
from sylpose.app.run_metadata import SETTINGS, root_of, settings_of, table
from sylpose.app.scene import calibration_used, read_cloud, rig_of
from sylpose.app.view import read_result
from sylpose.geometry.euler_angles import PAN_TILT_ROLL, angles_of
from sylpose.input_limits import told
from sylpose.report.formats import PAGE
from sylpose.report.page import Head, write_page
from sylpose.report.scene import Stills, scene_of
from sylpose.results import Trajectory

__all__ = ["make_page"]

# Of the packages in settings.toml, those that are named at the top.
_NAMED = {"numpy": "NumPy", "opencv": "OpenCV"}
_VIDEO = re.compile(r"overlay(_(\d+))?\.mp4")


def make_page(folder: Path, stills: Stills) -> Path:
    """Writes report.html into the folder of a run or, of several objects, of one of them; returns its path.

    Raises:
        FileNotFoundError: there is no trajectory.
        ValueError: it has no frames; files that are not what they should be.
        OSError: naming the file that cannot be written.
    """
    trajectory, settings = read_result(folder), settings_of(folder)
    rig = rig_of(trajectory, calibration_used(folder))
    scene = scene_of(trajectory, rig, read_cloud(folder / OBJECT, rig.names), stills)
    asked = settings.get("options", {}).get("angles")
    with told(root_of(folder) / SETTINGS):
        angles = PAN_TILT_ROLL if asked is None else angles_of(str(asked))
    write_page(folder / PAGE, trajectory, scene, rig, angles, _head(folder, trajectory, settings))
    return folder / PAGE


def _head(folder: Path, trajectory: Trajectory, settings: Mapping[str, Any]) -> Head:
    root, facts = root_of(folder), list[tuple[str, str]]()
    title = Path(str(settings.get("recording") or folder.resolve())).name or "sylpose"
    options, versions, sums = (table(settings, name) for name in ("options", "versions", "checksums"))
    if isinstance(begun := settings.get("begun"), datetime):
        facts.append(("Begun", f"{begun.astimezone(UTC):%Y-%m-%d %H:%M} UTC"))
    if "method" in options:
        refined = ", refined together" if options.get("smooth") else ""
        facts += [("Method", f"{options['method']}{refined}"), ("Features", str(options.get("features", "")))]
    if "model" in options:
        facts.append(("Object", Path(str(options["model"])).name))
    facts += [("Cameras", str(len(trajectory.camera_names))), ("Unit of length", trajectory.unit or "not said")]
    if "calibration" in settings:
        digest = f", {str(sums['calibration'])[:12]}" if "calibration" in sums else ""
        facts.append(("Calibration", f"{Path(str(settings['calibration'])).name}{digest}"))
    made = [f"sylpose {versions['sylpose']}"] if "sylpose" in versions else []
    made += [f"{said} {v}" for name, said in _NAMED.items() for k, v in versions.items() if str(k).startswith(name)]
    if made:
        facts.append(("Versions", ", ".join(made)))
    return Head(
        title=title if root == folder else f"{title}, {folder.name}",
        version=__version__,
        facts=facts,
        settings=_told(settings),
        noticed=[str(said) for said in noticed] if isinstance(noticed := settings.get("noticed"), list) else [],
        cameras=console_output.per_camera(trajectory),
        videos=_videos(root, "" if root == folder else "../"),
    )


def _told(settings: Mapping[str, Any]) -> dict[str, list[tuple[str, str]]]:
    """All that settings.toml has, by its tables; first what stands before them."""
    tables = {"": {key: value for key, value in settings.items() if not isinstance(value, dict) and key != "noticed"}}
    tables |= {name: table for name, table in settings.items() if isinstance(table, dict)}
    return {name: [(key, _said(value)) for key, value in table.items()] for name, table in tables.items() if table}


def _said(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _videos(root: Path, before: str) -> list[str]:
    """Names of the overlay's parts, in order, as links."""
    found = [match for file in root.glob("overlay*.mp4") if (match := _VIDEO.fullmatch(file.name))]
    return [f"{before}{match[0]}" for match in sorted(found, key=lambda match: int(match[2] or -1))]
