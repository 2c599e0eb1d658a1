"""report.html and 3D scene of a run, read from the files in its folder, and thumbnails of its images."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from sylpose import __version__
from sylpose.atomic_io import replace_atomically
from sylpose.frames import FrameSet
from sylpose.geometry.euler_angles import PAN_TILT_ROLL, parse_euler_angles
from sylpose.input_limits import input_errors
from sylpose.io import calibration
from sylpose.io.exports.poses import Surroundings
from sylpose.io.object_files import MAX_DRAWN_DEPTH_SD, OBJECT_FILE, load_object
from sylpose.report.drawing import encode_thumbnail
from sylpose.report.files import PAGE_FILE
from sylpose.report.page import PageHeader, render_page
from sylpose.report.plots import camera_colors
from sylpose.report.scene import PointCloud, Scene, Thumbnails, build_scene
from sylpose.results import Trajectory
from sylpose.rig import Rig
from sylpose.runs import console_output
from sylpose.runs.calibration_refinement import REFINED
from sylpose.runs.run_metadata import USED_CALIBRATION, find_run_folder, find_settings, read_settings, settings_table
from sylpose.runs.view import find_calibration, load_trajectory
from sylpose.tracking.known_object import KnownObject

# Packages of settings.toml whose versions the page's header shows.
_SHOWN_PACKAGES = {"numpy": "NumPy", "opencv": "OpenCV"}
# Smallest number of frames that are kept, if the run has as many; at most twice as many (choice: one per second or two
# of a usual recording).
MIN_THUMBNAILS = 24
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
    (trajectory, rig, cloud), settings = read_run(folder), read_settings(folder)
    scene = build_scene(trajectory, rig, cloud, stills)
    axes = settings.get("options", {}).get("angles")
    with input_errors(find_settings(folder)):
        angles = PAN_TILT_ROLL if axes is None else parse_euler_angles(str(axes))
    page = render_page(trajectory, scene, rig, angles, _make_head(folder, trajectory, settings))
    with replace_atomically(folder / PAGE_FILE) as part:
        part.write_text(page, encoding="utf-8", newline="\n")
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
    for name, label in _SHOWN_PACKAGES.items():
        software += [f"{label} {version}" for package, version in versions.items() if str(package).startswith(name)]
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


def read_scene(result: Path, calibration_file: Path | None = None, stills: Thumbnails | None = None) -> Scene:
    """Read the cameras, the object and its path.

    Args:
        result: folder of the run, or of one of several objects, or its trajectory.csv.
        calibration_file: a calibration; None for that of the run.
        stills: images of some frames.

    Raises:
        FileNotFoundError: no trajectory.
        ValueError: invalid files, or files of other cameras.
    """
    return build_scene(*read_run(result, calibration_file), stills)


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


def read_run(result: Path, calibration_file: Path | None = None) -> tuple[Trajectory, Rig, PointCloud | None]:
    """Read the trajectory of a run, its cameras and the object's landmarks, if there are any.

    The calibration is the given one, or the refined one, or the one used. The rig has the trajectory's unit, which with
    one camera differs from the calibration's.

    Raises:
        FileNotFoundError: no trajectory.
        ValueError: no calibration; a calibration or an object of other cameras, or another file than an object.
    """
    trajectory, folder = load_trajectory(result), result if result.is_dir() else result.parent
    refined, object_file, cloud = folder / REFINED, folder / OBJECT_FILE, None
    # A refined calibration of an earlier run stays if the run has used it, of other cameras or in another unit perhaps.
    is_refined = bool(settings_table(read_settings(folder), "options").get("refine_calibration"))
    file = calibration_file or (refined if is_refined and refined.is_file() else find_calibration(folder, None))
    rig, names = calibration.load(file), trajectory.camera_names
    if rig.names != names:
        raise ValueError(f"{file}: it has the cameras {', '.join(rig.names)}, the trajectory {', '.join(names)}")
    if object_file.is_file():
        known = load_object(object_file)
        if unknown := {*known.camera_names} - {*names}:
            cameras = ", ".join(sorted(unknown))
            raise ValueError(f"{object_file}: it has the cameras {cameras}, which the calibration lacks")
        cloud = make_cloud(known, names)
    return trajectory, Rig(rig.cameras, trajectory.unit), cloud


def read_surroundings(result: Path) -> Surroundings:
    """Read the cameras and the object's points of a run, for exports; nothing if the run has no calibration.

    Raises:
        FileNotFoundError: no trajectory.
        ValueError: invalid files, or files of other cameras.
    """
    folder = result if result.is_dir() else result.parent
    if not any((run / USED_CALIBRATION).is_file() for run in (folder, folder.parent)):
        return Surroundings()
    if not load_trajectory(result).camera_names:
        return Surroundings()
    _, rig, cloud = read_run(result)
    if cloud is None:
        return Surroundings(rig.cameras)
    palette = [[int(color[k : k + 2], 16) / 255.0 for k in (1, 3, 5)] for color in camera_colors(len(rig))]
    return Surroundings(rig.cameras, cloud.points, np.array(palette)[cloud.cameras].reshape(-1, 3))


def make_cloud(known: KnownObject, names: tuple[str, ...]) -> PointCloud:
    """Return the point cloud of the landmarks with a small depth sd, as in object.ply."""
    points, cameras = [np.empty((0, 3))], [np.empty(0, np.int64)]
    for name, memory in known._cameras.items():
        precise = memory.landmarks.depth_sd < MAX_DRAWN_DEPTH_SD * known.radius
        points.append(memory.landmarks.mean[precise])
        cameras.append(np.full(int(precise.sum()), names.index(name)))
    return PointCloud(np.concatenate(points), np.concatenate(cameras), known.radius)


class ThumbnailAlbum:
    """Collection of thumbnails that drops every second frame whenever it has twice the intended number.

    The kept frames depend only on the number of frames.

    Args:
        cameras: number of cameras.
    """

    def __init__(self, cameras: int) -> None:
        self._cameras = cameras
        self._step = 1
        self._kept: list[tuple[int, tuple[bytes | None, ...]]] = []
        self._position = 0

    def put(self, frames: FrameSet) -> None:
        """Add the next frame of the run."""
        if self._position % self._step == 0:
            self._keep(frames)
        self._position += 1
        if len(self._kept) == 2 * MIN_THUMBNAILS:
            self._kept, self._step = self._kept[::2], 2 * self._step

    def restore(self, position: int, frames_kept: Iterable[FrameSet]) -> None:
        """Restore the state after the first `position` frames of a run.

        Args:
            position: number of frames.
            frames_kept: every `thumbnail_step(position)`-th of them.
        """
        self._step = thumbnail_step(position)
        for frames in frames_kept:
            self._keep(frames)
        self._position = position

    def _keep(self, frames: FrameSet) -> None:
        self._kept.append((frames.index, tuple(encode_thumbnail(image, self._cameras) for image in frames.images)))

    def stills(self) -> Thumbnails:
        """Return the thumbnails kept so far."""
        index = np.array([number for number, _ in self._kept], np.int64)
        return Thumbnails(index, tuple(images for _, images in self._kept))


def thumbnail_step(position: int) -> int:
    """Return the spacing of the frames kept after `position` frames."""
    step = 1
    while -(-position // step) >= 2 * MIN_THUMBNAILS:
        step *= 2
    return step
