"""Finished trajectories, the cameras of their runs and virtual ones, and trajectories in their frames."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import __version__
from sylpose.geometry.euler_angles import PAN_TILT_ROLL, EulerAngles
from sylpose.io import calibration
from sylpose.io.calibration.world import load_world, transform_rig
from sylpose.report.files import read_trajectory, write_trajectory
from sylpose.report.plots import save_trajectory_plot
from sylpose.results import Trajectory
from sylpose.rig import Camera, Rig, make_look_at_camera
from sylpose.runs.run_metadata import TRAJECTORY, USED_CALIBRATION, WORLD, find_result
from sylpose.units import METERS
from sylpose.view import trajectory_view

Point = tuple[float, float, float]
# Intrinsics of virtual cameras; a trajectory in the camera's frame does not depend on them.
VIRTUAL_FOCAL, VIRTUAL_SIZE = 1000.0, (1280, 960)


def load_trajectory(path: Path | str) -> Trajectory:
    """Load the trajectory of a run.

    Args:
        path: folder that `sylpose track` wrote, the recording's folder with it, or a trajectory.csv. Covariances have
            only their diagonal.

    Raises:
        FileNotFoundError: a file is missing; the message names it, and the folders of several objects or takes.
        ValueError: not a trajectory.
    """
    path = find_result(Path(path))
    file = path / TRAJECTORY if path.is_dir() else path
    if not file.is_file():
        if objects := [str(folder.parent) for folder in sorted(path.glob(f"*/{TRAJECTORY}"))]:
            raise FileNotFoundError(f"{path}: has several results; select one of {', '.join(objects)}")
        problem = "no result in it" if path.is_dir() else "no such file or folder"
        expected = f"a recording that was tracked, the folder that sylpose track wrote, or a {TRAJECTORY}"
        raise FileNotFoundError(f"{path}: {problem}; expected {expected}")
    return read_trajectory(file)


def find_calibration(result: Path, calibration_file: Path | None) -> Path:
    """Return the calibration file of a result.

    That is the given one, or the one that the run used, or for runs without a copy that of the session around the
    folder.

    Raises:
        ValueError: no calibration, or several.
    """
    if calibration_file is not None:
        return calibration_file
    if (used := _find_run_file(result, USED_CALIBRATION)) is not None:
        return used
    folder = result if result.is_dir() else result.parent
    for session in (folder.parent, folder.parent.parent):
        try:
            return calibration.find(session)
        except (ValueError, OSError):
            continue
    raise ValueError(f"{result}: no calibration found for the camera; give --calibration FILE")


def load_camera(name: str, file: Path, result: Path | None = None) -> Camera:
    """Load a camera of a calibration, in the world and unit of a result if one is given.

    Raises:
        ValueError: an unknown camera.
    """
    rig = calibration.load(file)
    if name not in rig.names:
        raise ValueError(f"{file}: no camera {name!r} in it ({', '.join(rig.names)})")
    return (rig if result is None else _convert_to_result(rig, result))[name]


def _convert_to_result(rig: Rig, result: Path) -> Rig:
    """Convert a calibration to the unit and world of a result.

    The world is only changed if that brings the cameras that both share closer together. A calibration without shared
    cameras is assumed to be in the result's world.
    """
    used = _find_run_file(result, USED_CALIBRATION)
    if used is None:
        return rig
    used_rig = calibration.load(used)
    shared = [name for name in rig.names if name in used_rig.names]
    candidates, world = [rig], _find_run_file(result, WORLD)
    if world is not None and shared:
        candidates.append(transform_rig(rig, load_world(world, rig)))
    if {rig.unit, used_rig.unit} <= METERS.keys():
        candidates = [candidate.in_unit(used_rig.unit) for candidate in candidates]

    def distance(candidate: Rig) -> float:
        return sum(float(np.linalg.norm(candidate[name].center - used_rig[name].center)) for name in shared)

    return min(candidates, key=distance)


def _find_run_file(result: Path, name: str) -> Path | None:
    """Find a file of the run in the result's folder or its parent, which contains the folders of several objects."""
    folder = result if result.is_dir() else result.parent
    return next((run / name for run in (folder, folder.parent) if (run / name).is_file()), None)


def make_virtual_camera(
    name: str, position: Point, target: Point | None, trajectory: Trajectory, z_up: bool = False
) -> Camera:
    """Create an upright virtual camera at a point, looking at another one.

    Args:
        name: name of the camera.
        position: its position in the world.
        target: the point that it looks at; None for the object's first position.
        trajectory: the object's trajectory.
        z_up: the world's z axis points up, as in user-defined worlds; in calibrations y usually points down.

    Raises:
        ValueError: numbers that are not finite; equal points; a trajectory without poses.
    """
    for option, point in (("--from", position), ("--at", target)):
        if point is not None and not all(map(math.isfinite, point)):
            raise ValueError(f"{option}: expected three finite numbers, got {' '.join(map(str, point))}")
    if target is None:
        positions = [pose.position for pose in trajectory if pose.world_from_object is not None]
        if not positions:
            raise ValueError("the trajectory has no poses to look at")
        target = tuple(positions[0])
    y_down_from_z_up = RigidTransform.from_rotation(Rotation.from_euler("x", 90.0 if z_up else 0.0, degrees=True))
    center, at = y_down_from_z_up.apply(position), y_down_from_z_up.apply(target)
    camera = make_look_at_camera(name, center, at, VIRTUAL_FOCAL, VIRTUAL_SIZE)
    return replace(camera, camera_from_world=camera.camera_from_world * y_down_from_z_up)


def write_view(
    trajectory: Trajectory, name: str, camera: Camera, folder: Path, plot_format: str, angles: EulerAngles | None
) -> list[Path]:
    """Write view_NAME.tum, .csv and a plot with the trajectory in the camera's frame, and return these files.

    A trajectory read from a file has only standard deviations, which are rotated as if they were independent.

    Raises:
        ValueError: a name that cannot be part of a file name.
        OSError: a file or folder cannot be written; the message names it.
    """
    if not name or any(c in name for c in '/\\:*?"<>|'):
        raise ValueError(f"{name!r} cannot be part of a file's name")
    view = trajectory_view(trajectory, camera)
    stem = f"view_{name}"
    files = write_trajectory(folder, view, stem=stem, world=name, angles=angles)
    plot_path = folder / f"{stem}.{plot_format}"
    note = f"{folder.resolve().name}, in the frame of {name}, sylpose {__version__}"
    save_trajectory_plot(view, plot_path, note=note, angles=angles or PAN_TILT_ROLL)
    return [*files, plot_path]
