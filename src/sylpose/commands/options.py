"""Options that several commands share, as annotations and as records to inherit from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sylpose.commands.app import ADVANCED, INPUT, LIVE, OBJECT, OUTPUT, CommandOptions, make_choice_check
from sylpose.methods import FEATURES, METHODS, resolve_features
from sylpose.report.formats import PICTURE_FORMATS
from sylpose.units import METERS

__all__ = [
    "BoxesFile",
    "Browser",
    "CalibrationFile",
    "CameraFiles",
    "CameraOptions",
    "EulerAxes",
    "ExcludedCameras",
    "FrameOffsets",
    "MasksFolder",
    "MethodOptions",
    "OutFolder",
    "Overlay",
    "PageOptions",
    "PlotFormat",
    "Port",
    "RangeOptions",
    "Rate",
    "RecordingOptions",
    "RefineCalibration",
    "Seed",
    "SessionPath",
    "StopFrame",
    "Unit",
    "World",
    "WorldFrame",
    "WorldFrom",
    "WorldOptions",
]

SessionPath = Annotated[
    Path,
    typer.Argument(metavar="SESSION", help="Folder with one video (cam_0.mp4) or one folder of images per camera."),
]
CalibrationFile = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        metavar="PATH",
        help="Read the calibration from this file or folder; by default searched in SESSION.",
        rich_help_panel=INPUT,
    ),
]
BoxesFile = Annotated[
    Path | None,
    typer.Option(
        "--boxes",
        metavar="FILE",
        help="Read the object's boxes in the first frame; default: SESSION/boxes.toml if present.",
        rich_help_panel=OBJECT,
    ),
]
MasksFolder = Annotated[
    Path | None,
    typer.Option(
        "--masks",
        metavar="DIR",
        help="Read the object's masks; default: SESSION/masks if present.",
        rich_help_panel=OBJECT,
    ),
]
FrameOffsets = Annotated[
    list[str] | None,
    typer.Option(
        "--frame-offset",
        metavar="CAM=N",
        help="Set by how many frames a camera starts late. Repeatable.",
        rich_help_panel=INPUT,
    ),
]
EulerAxes = Annotated[
    str | None,
    typer.Option(
        "--euler",
        metavar="AXES",
        help="Add three Euler angles to the CSV and plot them: XYZ (intrinsic axes), xyz (extrinsic axes), or three "
        'vectors, "0,0,1 1,0,0 0,1,0".',
        rich_help_panel=OUTPUT,
    ),
]
CameraFiles = Annotated[
    list[str] | None,
    typer.Option(
        "--video",
        metavar="NAME=FILE",
        help="Assign a video or image folder to a camera if its name does not match. Repeatable.",
        rich_help_panel=INPUT,
    ),
]
ExcludedCameras = Annotated[
    list[str] | None,
    typer.Option(
        "--exclude-camera",
        metavar="CAM",
        help="Leave out a camera, for example one without a video. Repeatable.",
        rich_help_panel=INPUT,
    ),
]
Rate = Annotated[
    float | None,
    typer.Option(
        "--rate",
        metavar="HZ",
        help="Set the frame rate of image folders, for times in seconds.",
        rich_help_panel=INPUT,
    ),
]
Unit = Annotated[
    str | None,
    typer.Option(
        "--unit",
        metavar="|".join(METERS),
        help="Set the length unit of the results; default: the calibration's.",
        rich_help_panel=OUTPUT,
    ),
]
World = Annotated[
    str | None,
    typer.Option(
        "--world",
        metavar="WORLD",
        help="Set the world frame, z up: a board on the floor (chessboard:9x6,square=25mm), up=0,-1,0 in the calibration's "
        "frame, or a file (world.toml, or three points: docs/formats.md).",
        rich_help_panel=OUTPUT,
    ),
]
WorldFrame = Annotated[
    int | None,
    typer.Option(
        "--world-frame",
        metavar="N",
        min=0,
        help="Detect the world board in this frame of the recording or of --world-from; default: the first frame.",
        rich_help_panel=OUTPUT,
    ),
]
WorldFrom = Annotated[
    Path | None,
    typer.Option(
        "--world-from",
        metavar="DIR",
        help="Detect the world board in these images or videos instead of the session's.",
        rich_help_panel=OUTPUT,
    ),
]
OutFolder = Annotated[
    Path | None,
    typer.Option(
        "--out", metavar="DIR", help="Write the results here; default: SESSION/sylpose.", rich_help_panel=OUTPUT
    ),
]
StopFrame = Annotated[
    int | None, typer.Option(metavar="N", help="Stop before this frame; default: the end.", rich_help_panel=INPUT)
]
Overlay = Annotated[bool, typer.Option("--overlay/--no-overlay", help="Write overlay.mp4.", rich_help_panel=OUTPUT)]
Port = Annotated[
    int,
    typer.Option(
        "--port",
        metavar="N",
        min=0,
        max=65535,
        help="Serve the page on this port; 0: any free port.",
        rich_help_panel=LIVE,
    ),
]
Browser = Annotated[
    bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.", rich_help_panel=LIVE)
]
RefineCalibration = Annotated[
    bool,
    typer.Option(
        "--refine-calibration",
        help="Smooth and also estimate the calibration's errors; write calibration.refined.toml.",
        rich_help_panel=ADVANCED,
    ),
]
Seed = Annotated[
    int,
    typer.Option(
        "--seed",
        metavar="N",
        help="Set the random seed; equal seeds give equal results.",
        rich_help_panel=ADVANCED,
    ),
]


PlotFormat = Annotated[
    str,
    typer.Option(
        "--format",
        metavar="|".join(PICTURE_FORMATS),
        help="Set the file format of plots.",
        callback=make_choice_check(PICTURE_FORMATS),
        rich_help_panel=OUTPUT,
    ),
]


@dataclass(frozen=True, kw_only=True)
class CameraOptions(CommandOptions):
    """Calibration and videos of the cameras."""

    calibration: CalibrationFile = None
    video: Annotated[
        tuple[str, ...],
        typer.Option(
            "--video",
            metavar="NAME=FILE",
            help="Assign a video or image folder to a camera if its name does not match. Repeatable.",
            rich_help_panel=INPUT,
        ),
    ] = ()
    exclude_camera: Annotated[
        tuple[str, ...],
        typer.Option(
            metavar="CAM",
            help="Leave out a camera, for example one without a video. Repeatable.",
            rich_help_panel=INPUT,
        ),
    ] = ()
    rate: Rate = None


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(CameraOptions):
    """A recording and its calibration, videos and masks."""

    session: SessionPath
    masks: MasksFolder = None


@dataclass(frozen=True, kw_only=True)
class WorldOptions(CommandOptions):
    """World frame and length unit of the results."""

    unit: Unit = None
    world: World = None
    world_frame: WorldFrame = None
    world_from: WorldFrom = None


@dataclass(frozen=True, kw_only=True)
class RangeOptions(CommandOptions):
    """Frames to process."""

    start: Annotated[int, typer.Option(metavar="N", help="Start at this frame.", rich_help_panel=INPUT)] = 0
    stop: StopFrame = None


@dataclass(frozen=True, kw_only=True)
class MethodOptions(CommandOptions):
    """Estimation method and features."""

    method: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Select the estimation method, from those that sylpose track --help lists.",
            callback=make_choice_check(METHODS),
            rich_help_panel=ADVANCED,
        ),
    ] = METHODS[0]
    features: Annotated[
        str,
        typer.Option(
            metavar="|".join(FEATURES),
            help="Match SIFT in every frame, or track KLT between SIFT keyframes (faster, more precise); auto: KLT for "
            "landmarks, else SIFT.",
            callback=make_choice_check(FEATURES),
            rich_help_panel=ADVANCED,
        ),
    ] = FEATURES[0]

    def __post_init__(self) -> None:
        """Check that the method can use the features."""
        super().__post_init__()
        resolve_features(self.method, self.features)


@dataclass(frozen=True, kw_only=True)
class PageOptions(CommandOptions):
    """Page in the browser."""

    port: Port = 0
    browser: Browser = True
