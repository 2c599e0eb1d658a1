"""3D scene of a finished run, read from the files in its folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sylpose.io import calibration
from sylpose.io.object_files import MAX_DRAWN_DEPTH_SD, OBJECT_FILE, load_object
from sylpose.report.scene import PointCloud, Scene, Thumbnails, build_scene
from sylpose.results import Trajectory
from sylpose.rig import Rig
from sylpose.runs.calibration_refinement import REFINED
from sylpose.runs.view import find_calibration, read_result
from sylpose.tracking.known_object import KnownObject

__all__ = ["find_used_calibration", "load_rig", "make_cloud", "read_cloud", "read_scene", "read_scenes"]


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
    trajectory = read_result(result)
    folder = result if result.is_dir() else result.parent
    rig = load_rig(trajectory, find_used_calibration(folder) if calibration_file is None else calibration_file)
    return build_scene(trajectory, rig, read_cloud(folder / OBJECT_FILE, rig.names), stills)


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


def find_used_calibration(folder: Path) -> Path:
    """Return the calibration file of the poses in a run's folder: the refined one, or else the one used.

    Raises:
        ValueError: no calibration.
    """
    refined = folder / REFINED
    return refined if refined.is_file() else find_calibration(folder, None)


def load_rig(trajectory: Trajectory, file: Path) -> Rig:
    """Load the rig of a calibration with the trajectory's unit, which with one camera differs from the calibration's.

    Raises:
        ValueError: a calibration of other cameras.
    """
    rig = calibration.load(file)
    if rig.names != trajectory.camera_names:
        raise ValueError(
            f"{file}: it has the cameras {', '.join(rig.names)}, the trajectory {', '.join(trajectory.camera_names)}"
        )
    return Rig(rig.cameras, trajectory.unit)


def read_cloud(file: Path, names: tuple[str, ...]) -> PointCloud | None:
    """Read the point cloud of object.npz for cameras with these names; return None if the file does not exist.

    Raises:
        ValueError: naming the file: not an object, or of other cameras.
    """
    if not file.is_file():
        return None
    known = load_object(file)
    if unknown := {*known.camera_names} - {*names}:
        raise ValueError(f"{file}: it has the cameras {', '.join(sorted(unknown))}, which the calibration lacks")
    return make_cloud(known, names)


def make_cloud(known: KnownObject, names: tuple[str, ...]) -> PointCloud:
    """Return the point cloud of the landmarks with a small depth sd, as in object.ply."""
    points, cameras = [np.empty((0, 3))], [np.empty(0, np.int64)]
    for name, memory in known._cameras.items():
        precise = memory.landmarks.depth_sd < MAX_DRAWN_DEPTH_SD * known.radius
        points.append(memory.landmarks.mean[precise])
        cameras.append(np.full(int(precise.sum()), names.index(name)))
    return PointCloud(np.concatenate(points), np.concatenate(cameras), known.radius)
