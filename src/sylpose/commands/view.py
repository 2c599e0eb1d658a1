"""`sylpose view`: express a finished trajectory in the frame of a real or virtual camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sylpose.commands.app import INPUT, OUTPUT, CommandOptions, command, option
from sylpose.commands.options import EulerAxes, PlotFormat, ResultPath

Point = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class ViewOptions(CommandOptions):
    """Options of `sylpose view`.

    Attributes:
        camera: A camera's name; with --from, a name for the view.
        calibration: Look up CAMERA in this calibration; default: that of the run.
        eye: Place a virtual camera at this world position.
        at: Point the virtual camera here; default: the object's first position.
        out: Write the view here; default: RESULT.
    """

    result: ResultPath
    camera: Annotated[str, typer.Argument(metavar="CAMERA")]
    calibration: Annotated[Path | None, option("--calibration FILE", INPUT)] = None
    eye: Annotated[Point | None, option("--from X Y Z", INPUT)] = None
    at: Annotated[Point | None, option("--at X Y Z", INPUT)] = None
    out: Annotated[Path | None, option("--out DIR", OUTPUT)] = None
    plot_format: PlotFormat = "png"
    angles: EulerAxes = None

    def __post_init__(self) -> None:
        """Check that the camera is either virtual or of a calibration."""
        super().__post_init__()
        if self.eye is not None and self.calibration is not None:
            raise ValueError("--from (virtual camera) and --calibration (existing camera) exclude each other")
        if self.eye is None and self.at is not None:
            raise ValueError("--at requires --from X Y Z, the camera's position")


@command("Express a trajectory in a real or virtual camera's frame.")
def view(options: ViewOptions) -> None:
    """Express a finished trajectory in the frame of a camera: of the rig, of another calibration, or virtual.

    Writes view_CAMERA.tum (camera_from_object), view_CAMERA.csv and view_CAMERA.png.

    Examples:
        sylpose view recording cam_2
        sylpose view results top --calibration virtual.toml
        sylpose view results top --from 0 -2 0 --at 0 0 0
    """
    from sylpose.geometry.euler_angles import parse_euler_angles
    from sylpose.runs import console_output
    from sylpose.runs import view as views
    from sylpose.runs.run_metadata import find_result, read_world_definition

    result, name = find_result(options.result), options.camera
    trajectory = views.load_trajectory(result)
    if options.eye is not None:
        z_up = read_world_definition(result) is not None
        camera = views.make_virtual_camera(name, options.eye, options.at, trajectory, z_up)
    else:
        camera = views.load_camera(name, views.find_calibration(result, options.calibration), result)
    angles = None if options.angles is None else parse_euler_angles(options.angles)
    folder = options.out or (result if result.is_dir() else result.parent)
    files = views.write_view(trajectory, name, camera, folder, options.plot_format, angles)
    console_output.print_files(console_output.make_console(), "Files", files)
