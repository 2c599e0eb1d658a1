"""`sylpose view`: a finished trajectory as a camera sees it, a real one or a virtual one."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import __version__, calibration
from sylpose.app import console_output
from sylpose.app.run_metadata import USED, WORLD, world_said
from sylpose.calibration.world import load_world, told_in
from sylpose.geometry.euler_angles import PAN_TILT_ROLL, Angles, angles_of
from sylpose.report.files import read_trajectory, write_trajectory
from sylpose.report.plots import plot_trajectory
from sylpose.results import Trajectory
from sylpose.rig import Camera, Rig, camera_at
from sylpose.units import METRES
from sylpose.view import trajectory_view

__all__ = ["calibration_of", "looked_up", "read_result", "standing", "view_aloud", "write_view"]

# A view in the camera's axes does not depend on what its image would be like.
FOCAL, SIZE = 1000.0, (1280, 960)


def view_aloud(
    result: Path,
    name: str,
    given: Path | None,
    eye: tuple[float, float, float] | None,
    at: tuple[float, float, float] | None,
    out: Path | None,
    plot_format: str = "png",
    angles: str | None = None,
) -> None:
    """Writes a run's trajectory as a camera sees it, and says into which files.

    Args:
        result: folder of the run, or its trajectory.csv.
        name: of a camera of the calibration, or with `eye` for the view.
        given: a calibration; None for that of the run.
        eye, at: where a virtual camera stands and what it looks at.
        out: folder for the files; None: beside the trajectory.
        plot_format: what the picture's name ends with.
        angles: three more, about the camera's axes, as `geometry.euler_angles.angles_of` reads them.

    Raises:
        ValueError, OSError: as the functions below; options that exclude each other.
    """
    trajectory = read_result(result)
    if eye is not None:
        if given is not None:
            raise ValueError("--from places a camera, --calibration looks one up: give one of them")
        camera = standing(name, eye, at, trajectory, z_up=world_said(result) is not None)
    elif at is not None:
        raise ValueError("--at needs --from X Y Z: where the camera stands")
    else:
        camera = looked_up(name, calibration_of(result, given), result)
    about = None if angles is None else angles_of(angles)
    folder = out if out is not None else result if result.is_dir() else result.parent
    console_output.print_files(
        console_output.make_console(), "Files", write_view(trajectory, name, camera, folder, plot_format, about)
    )


def read_result(path: Path) -> Trajectory:
    """The trajectory of a run: `trajectory.csv` in the folder that `sylpose track` wrote, or such a file itself.

    Raises:
        FileNotFoundError: naming what is not there.
        ValueError: a file that is no trajectory.
    """
    file = path / "trajectory.csv" if path.is_dir() else path
    if not file.is_file():
        raise FileNotFoundError(
            f"{file}: no such file; a folder that sylpose track wrote, or its trajectory.csv, is expected"
        )
    return read_trajectory(file)


def calibration_of(result: Path, given: Path | None) -> Path:
    """The calibration that a camera's name is looked up in: the given one, the one that the run used, or, of runs that
    kept none, that of the session that the run's folder lies in.

    Raises:
        ValueError: none was given and there is none, or several.
    """
    if given is not None:
        return given
    if (used := _beside(result, USED)) is not None:
        return used
    folder = result if result.is_dir() else result.parent
    for session in (folder.parent, folder.parent.parent):
        try:
            return calibration.find(session)
        except (ValueError, OSError):
            continue
    raise ValueError(f"{result}: no calibration beside it to look the camera up in; say --calibration FILE")


def looked_up(name: str, file: Path, result: Path | None = None) -> Camera:
    """A camera of a calibration; as the world and the unit of a result have it, where there is one.

    Raises:
        ValueError: a name that it does not have.
    """
    rig = calibration.load(file)
    if name not in rig.names:
        raise ValueError(f"{file}: no camera {name!r} in it ({', '.join(rig.names)})")
    return (rig if result is None else _as_told(rig, result))[name]


def _as_told(rig: Rig, result: Path) -> Rig:
    """A calibration in the unit of a result and, if by that the cameras that it shares with the result's stand nearer to
    where these stand, in its world; one that shares none is in that already."""
    used = _beside(result, USED)
    if used is None:
        return rig
    then = calibration.load(used)
    shared = [name for name in rig.names if name in then.names]
    ways, world = [rig], _beside(result, WORLD)
    if world is not None and shared:
        ways.append(told_in(rig, load_world(world, rig)))
    ways = [way.in_unit(then.unit) if {way.unit, then.unit} <= METRES.keys() else way for way in ways]
    return min(ways, key=lambda way: sum(np.linalg.norm(way[name].center - then[name].center) for name in shared))


def _beside(result: Path, name: str) -> Path | None:
    """A file of the run; of several objects, each has a folder in the run's."""
    folder = result if result.is_dir() else result.parent
    return next((run / name for run in (folder, folder.parent) if (run / name).is_file()), None)


def standing(
    name: str,
    eye: tuple[float, float, float],
    at: tuple[float, float, float] | None,
    trajectory: Trajectory,
    z_up: bool = False,
) -> Camera:
    """A virtual camera at a point, upright, that looks at another one: where the object was first, if nothing is said.

    Args:
        z_up: the world has its z axis up, as worlds of one's own; calibrations mostly have y down.

    Raises:
        ValueError: numbers that are not finite; both are one point; a trajectory without poses.
    """
    for option, point in (("--from", eye), ("--at", at)):
        if point is not None and not all(map(math.isfinite, point)):
            raise ValueError(f"{option}: three finite numbers are expected, got {' '.join(map(str, point))}")
    if at is None:
        seen = [pose.position for pose in trajectory if pose.world_from_object is not None]
        if not seen:
            raise ValueError("the trajectory has no poses: nothing to look at")
        at = tuple(seen[0])
    y_down_from_z_up = RigidTransform.from_rotation(Rotation.from_euler("x", 90.0 if z_up else 0.0, degrees=True))
    camera = camera_at(name, y_down_from_z_up.apply(eye), y_down_from_z_up.apply(at), FOCAL, SIZE)
    return replace(camera, camera_from_world=camera.camera_from_world * y_down_from_z_up)


def write_view(
    trajectory: Trajectory,
    name: str,
    camera: Camera,
    folder: Path,
    plot_format: str = "png",
    angles: Angles | None = None,
) -> list[Path]:
    """Writes view_NAME.tum, .csv and a picture, the trajectory with the camera in the world's place; returns these files.

    A trajectory that was read from its file has standard deviations only: they are turned as if they were independent.

    Raises:
        ValueError: a name that is no file's.
        OSError: naming the file or folder that cannot be written.
    """
    if not name or any(c in name for c in '/\\:*?"<>|'):
        raise ValueError(f"{name!r} cannot be part of a file's name")
    view = trajectory_view(trajectory, camera)
    stem = f"view_{name}"
    files = write_trajectory(folder, view, stem=stem, world=name, angles=angles)
    picture = folder / f"{stem}.{plot_format}"
    note = f"{folder.resolve().name}, as {name} sees it, sylpose {__version__}"
    plot_trajectory(view, picture, note=note, angles=angles or PAN_TILT_ROLL)
    return [*files, picture]
