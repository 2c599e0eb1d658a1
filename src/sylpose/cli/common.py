"""Shared parts of the commands: the app, error handling, grouped help and common options."""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NoReturn, ParamSpec, get_type_hints

import typer
from typer.core import TyperCommand
from typer.models import OptionInfo

from sylpose.input_limits import MAX_SENTENCE_LENGTH, to_one_line
from sylpose.report.formats import PICTURE_FORMATS
from sylpose.units import METERS

__all__ = [
    "ADVANCED",
    "INPUT",
    "INTERRUPTED",
    "LIVE",
    "OBJECT",
    "OUTPUT",
    "WRONG_INPUT",
    "BoxesFile",
    "Browser",
    "CalibrationFile",
    "CameraFiles",
    "EulerAxes",
    "ExcludedCameras",
    "FrameOffsets",
    "GroupedCommand",
    "MasksFolder",
    "OutFolder",
    "Overlay",
    "PlotFormat",
    "Port",
    "Rate",
    "RefineCalibration",
    "Seed",
    "SessionPath",
    "StopFrame",
    "Unit",
    "World",
    "WorldFrame",
    "WorldFrom",
    "app",
    "exit_with_failures",
    "format_examples",
    "make_choice_check",
    "print_message",
    "report_errors",
]

P = ParamSpec("P")

FAILED, WRONG_INPUT, INTERRUPTED = 1, 2, 130
# Sections of `--help`, in their order; options without a section come first, under "Options".
INPUT, OBJECT, OUTPUT, LIVE, ADVANCED = _SECTIONS = ("Input", "Object", "Output", "Live", "Advanced")
# Options whose argument in the Python functions has another name than in the command.
_OPTION_BY_ARGUMENT = {
    "cameras": "--video",
    "known": "--object",
    "max_time_diff": "--within",
    "offsets": "--frame-offset",
    "plot_format": "--format",
    "up": "--world",
}


def format_examples(*lines: str) -> str:
    """Format example lines for an epilog; Click does not rewrap them."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


app = typer.Typer(
    name="sylpose",
    help="Measure how a rigid object moves in 3D from the videos of several calibrated cameras.",
    epilog=format_examples("sylpose demo", "sylpose check recording", "sylpose track recording"),
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


class GroupedCommand(TyperCommand):
    """Command whose `--help` lists the options by their `rich_help_panel`, as plain text."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write one section per panel; `--help` itself ends the last one."""
        sections: dict[str, list[tuple[str, str]]] = {name: [] for name in ("Arguments", "Options", *_SECTIONS)}
        last = []
        for param in self.get_params(ctx):
            if (record := param.get_help_record(ctx)) is None:
                continue
            if param.param_type_name == "argument":
                sections["Arguments"].append(record)
            elif "--help" in param.opts:
                last.append(record)
            else:
                sections[getattr(param, "rich_help_panel", None) or "Options"].append(record)
        used = [name for name in sections if name != "Arguments" and sections[name]] or ["Options"]
        sections[used[-1]] += last
        for name, records in sections.items():
            if records:
                with formatter.section(name):
                    formatter.write_dl(records)


def report_errors(command: Callable[P, None]) -> Callable[P, None]:
    """Turn wrong input and interrupts into a one-line message and an exit code; bugs keep their traceback."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except KeyboardInterrupt as interrupt:
            print_message(str(interrupt) or "interrupted")
            raise typer.Exit(INTERRUPTED) from None
        except BrokenPipeError:  # the reader has closed the pipe; Typer handles it
            raise
        except (ValueError, OSError) as error:
            if type(error).__name__ == "LinAlgError":  # a bug
                raise
            message = format_error(error)
            print_message(
                substitute_option_name(message, map_option_names(command), kwargs)
                if isinstance(error, ValueError)
                else message
            )
            raise typer.Exit(WRONG_INPUT) from None

    return run


def map_option_names(command: Callable[..., None]) -> dict[str, str]:
    """Map the names of a command's Python arguments to its options."""
    found: dict[str, str] = {}
    for name, hint in get_type_hints(command, include_extras=True).items():
        for info in getattr(hint, "__metadata__", ()):
            if isinstance(info, OptionInfo):
                # Until Typer builds the command, it keeps the first declaration in `default`.
                words = [str(w) for w in (info.default, *(info.param_decls or ())) if str(w).startswith("--")]
                found[name] = words[0].partition("/")[0] if words else f"--{name.replace('_', '-')}"
    return found | {name: option for name, option in _OPTION_BY_ARGUMENT.items() if option in found.values()}


def substitute_option_name(message: str, options: Mapping[str, str], arguments: Mapping[str, object]) -> str:
    """Replace the Python argument that an error message names by the option that was typed.

    Such messages begin with the argument's name, or with the session or file and then the name. A typed value, for
    example a folder called "start", is not taken for an argument.

    Args:
        message: the error message.
        options: options from `map_option_names`.
        arguments: the command's argument values by name.

    Returns:
        The message with the option's name; unchanged if it names no argument.
    """
    typed_values = {str(value) for value in arguments.values()}
    for prefix in ("", *(f"{value}: " for value in arguments.values() if isinstance(value, Path))):
        found = re.match(r"[a-z_]+(?=: | must | cannot )", message.removeprefix(prefix))
        if message.startswith(prefix) and found and found[0] in options and found[0] not in typed_values:
            return f"{prefix}{options[found[0]]}{message.removeprefix(prefix)[found.end() :]}"
    return message


def print_message(message: str) -> None:
    """Print a message on stderr as one line that begins with "sylpose: "."""
    # Names of files may contain line breaks: reduce the message to one line.
    print(f"sylpose: {to_one_line(message, MAX_SENTENCE_LENGTH)}", file=sys.stderr)


def format_error(error: ValueError | OSError) -> str:
    """Return the message of an error, with the file it concerns."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror.lower()}"
    return str(error) or type(error).__name__


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


def make_choice_check(choices: Sequence[str]) -> Callable[[str], str]:
    """Return a Typer callback that accepts only the given choices."""

    def check(name: str) -> str:
        if name not in choices:
            raise typer.BadParameter(f"{name!r} is not one of {', '.join(choices)}")
        return name

    return check


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


def exit_with_failures(messages: Sequence[str]) -> NoReturn:
    """Print the messages and exit with code 1."""
    for message in messages:
        print_message(message)
    raise typer.Exit(FAILED)
