"""What is shown of a finished run in three dimensions, read from the files in its folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sylpose import calibration
from sylpose.app.calibration_refinement import REFINED
from sylpose.app.object_files import DRAWN, OBJECT, load_object
from sylpose.app.view import calibration_of, read_result
from sylpose.report.scene import Cloud, Scene, Stills, scene_of
from sylpose.results import Trajectory
from sylpose.rig import Rig
from sylpose.tracking.known_object import KnownObject

__all__ = ["calibration_used", "cloud_of", "read_cloud", "read_scene", "rig_of"]


def read_scene(result: Path, given: Path | None = None, stills: Stills | None = None) -> Scene:
    """The cameras, the object and its way, of a run.

    Args:
        result: folder of the run, of several objects one object's, or its trajectory.csv.
        given: a calibration; None for that of the run.
        stills: images of some frames.

    Raises:
        FileNotFoundError: there is no trajectory.
        ValueError: files that are not what they should be, or of other cameras.
    """
    trajectory = read_result(result)
    folder = result if result.is_dir() else result.parent
    rig = rig_of(trajectory, calibration_used(folder) if given is None else given)
    return scene_of(trajectory, rig, read_cloud(folder / OBJECT, rig.names), stills)


def calibration_used(folder: Path) -> Path:
    """That the poses in a run's folder are of: refined with them, or as it was given.

    Raises:
        ValueError: there is none.
    """
    refined = folder / REFINED
    return refined if refined.is_file() else calibration_of(folder, None)


def rig_of(trajectory: Trajectory, file: Path) -> Rig:
    """The rig of a calibration, in the unit that the trajectory is told in: with one camera that is a distance, which no
    calibration knows.

    Raises:
        ValueError: of other cameras.
    """
    rig = calibration.load(file)
    if rig.names != trajectory.camera_names:
        raise ValueError(
            f"{file}: it has the cameras {', '.join(rig.names)}, the trajectory {', '.join(trajectory.camera_names)}"
        )
    return Rig(rig.cameras, trajectory.unit)


def read_cloud(file: Path, names: tuple[str, ...]) -> Cloud | None:
    """Of object.npz, for cameras of these names; None where there is no such file.

    Raises:
        ValueError: naming the file, which is none of an object, or of other cameras.
    """
    if not file.is_file():
        return None
    known = load_object(file)
    if unknown := {*known.camera_names} - {*names}:
        raise ValueError(f"{file}: it is of {', '.join(sorted(unknown))}, no cameras of the calibration")
    return cloud_of(known, names)


def cloud_of(known: KnownObject, names: tuple[str, ...]) -> Cloud:
    """The places of landmarks that are known well, as in object.ply."""
    points, cameras = [np.empty((0, 3))], [np.empty(0, np.int64)]
    for name, memory in known._cameras.items():
        good = memory.landmarks.depth_sd < DRAWN * known.radius
        points.append(memory.landmarks.mean[good])
        cameras.append(np.full(int(good.sum()), names.index(name)))
    return Cloud(np.concatenate(points), np.concatenate(cameras), known.radius)
