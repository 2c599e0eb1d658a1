"""What the commands have in common: how they are asked, how they end, and options that several have."""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, NoReturn, ParamSpec, get_type_hints

import typer
from typer.models import OptionInfo

from sylpose.input_limits import SENTENCE, one_line
from sylpose.report.formats import FORMATS
from sylpose.units import METRES

__all__ = [
    "INTERRUPTED",
    "WRONG_INPUT",
    "Axes",
    "BoxesFile",
    "Browser",
    "CalibrationFile",
    "CameraFiles",
    "MasksFolder",
    "Offsets",
    "OutFolder",
    "Overlay",
    "PlotFormat",
    "Port",
    "Rate",
    "RefineCalibration",
    "Seed",
    "SessionPath",
    "Stop",
    "Unit",
    "Without",
    "World",
    "WorldFrame",
    "WorldFrom",
    "app",
    "examples",
    "fail",
    "one_of",
    "say",
    "spoken",
]

P = ParamSpec("P")

FAILED, WRONG_INPUT, INTERRUPTED = 1, 2, 130
# Options by the names that Python's functions have for them, where these are not the commands' own.
_IN_PYTHON = {
    "cameras": "--video",
    "known": "--object",
    "offsets": "--frame-offset",
    "plot_format": "--format",
    "up": "--world",
}


def examples(*lines: str) -> str:
    """Lines below a help text that are not run together."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


app = typer.Typer(
    name="sylpose",
    help="How a rigid object moves in 3D, from the videos of several calibrated cameras.",
    epilog=examples("sylpose demo", "sylpose check recording", "sylpose track recording"),
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def spoken(command: Callable[P, None]) -> Callable[P, None]:
    """Wrong input and interrupts end a command with a sentence and an exit code; bugs keep their traceback."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except KeyboardInterrupt as interrupt:
            say(str(interrupt) or "interrupted")
            raise typer.Exit(INTERRUPTED) from None
        except BrokenPipeError:  # nobody reads any more, which Typer handles
            raise
        except (ValueError, OSError) as error:
            if type(error).__name__ == "LinAlgError":  # a bug
                raise
            said = sentence_of(error)
            say(as_typed(said, options_of(command), kwargs) if isinstance(error, ValueError) else said)
            raise typer.Exit(WRONG_INPUT) from None

    return run


def options_of(command: Callable[..., None]) -> dict[str, str]:
    """A command's options by the names that arguments have in Python."""
    found: dict[str, str] = {}
    for name, hint in get_type_hints(command, include_extras=True).items():
        for its in getattr(hint, "__metadata__", ()):
            if isinstance(its, OptionInfo):
                # Typer has the first word where an option's default is, until it builds the command.
                words = [str(w) for w in (its.default, *(its.param_decls or ())) if str(w).startswith("--")]
                found[name] = words[0].partition("/")[0] if words else f"--{name.replace('_', '-')}"
    return found | {name: option for name, option in _IN_PYTHON.items() if option in found.values()}


def as_typed(sentence: str, options: Mapping[str, str], given: Mapping[str, object]) -> str:
    """A sentence about a wrong argument of a function with the option in its place that was typed.

    Such sentences begin with the argument's name, or with that of the session or file and then with it. What was typed
    itself, a folder called "start", say, is no argument's name.

    Args:
        options: as `options_of` has them.
        given: what the command was given.
    """
    typed = {str(value) for value in given.values()}
    for head in ("", *(f"{value}: " for value in given.values() if isinstance(value, Path))):
        found = re.match(r"[a-z_]+(?=: | must | cannot )", sentence.removeprefix(head))
        if sentence.startswith(head) and found and found[0] in options and found[0] not in typed:
            return f"{head}{options[found[0]]}{sentence.removeprefix(head)[found.end() :]}"
    return sentence


def say(sentence: str) -> None:
    # One line whatever was read, names of files included.
    print(f"sylpose: {one_line(sentence, SENTENCE)}", file=sys.stderr)


def sentence_of(error: ValueError | OSError) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror.lower()}"
    return str(error) or type(error).__name__


SessionPath = Annotated[
    Path,
    typer.Argument(metavar="SESSION", help="Folder with one video (cam_0.mp4) or one folder of images per camera."),
]
CalibrationFile = Annotated[
    Path | None,
    typer.Option("--calibration", metavar="PATH", help="Calibration, a file or folder; found in SESSION if there."),
]
BoxesFile = Annotated[
    Path | None,
    typer.Option("--boxes", metavar="FILE", help="The object's boxes in the first frame; SESSION/boxes.toml if any."),
]
MasksFolder = Annotated[
    Path | None, typer.Option("--masks", metavar="DIR", help="Masks of the object; SESSION/masks if there is one.")
]
Offsets = Annotated[
    list[str] | None,
    typer.Option(
        "--frame-offset", metavar="CAM=N", help="A camera that starts N frames late; may be given several times."
    ),
]
Axes = Annotated[
    str | None,
    typer.Option(
        "--euler",
        metavar="AXES",
        help="Three more angles in the CSV, and those of the plots: XYZ (axes that turn along), xyz (that stand), or three "
        'vectors, "0,0,1 1,0,0 0,1,0".',
    ),
]
CameraFiles = Annotated[
    list[str] | None,
    typer.Option(
        "--video", metavar="NAME=FILE", help="A camera's video or folder, where its name does not tell; several times."
    ),
]
Without = Annotated[
    list[str] | None,
    typer.Option(
        "--exclude-camera", metavar="CAM", help="Leave a camera out, one without a video, say; several times."
    ),
]
Rate = Annotated[
    float | None,
    typer.Option("--rate", metavar="HZ", help="Frames per second of folders of images; for times in seconds."),
]
Unit = Annotated[
    str | None,
    typer.Option(
        "--unit", metavar="|".join(METRES), help="Of all lengths in the results; the calibration's by default."
    ),
]
World = Annotated[
    str | None,
    typer.Option(
        "--world",
        metavar="WORLD",
        help="A world of your own, z up: a board on the floor (chessboard:9x6,square=25mm), up=0,-1,0 in the calibration's, "
        "or a file (world.toml, or three points: docs/formats.md).",
    ),
]
WorldFrame = Annotated[
    int | None, typer.Option("--world-frame", metavar="N", min=0, help="The frame that shows the board; the first one.")
]
WorldFrom = Annotated[
    Path | None,
    typer.Option("--world-from", metavar="DIR", help="Images or videos that show the board, instead of SESSION."),
]
OutFolder = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="Where the results go; SESSION/sylpose by default.")
]
Stop = Annotated[int | None, typer.Option(metavar="N", help="The frame to stop before; all by default.")]
Overlay = Annotated[bool, typer.Option("--overlay/--no-overlay", help="Write overlay.mp4.")]
Port = Annotated[int, typer.Option("--port", metavar="N", min=0, max=65535, help="Of the page; 0: any that is free.")]
Browser = Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")]
RefineCalibration = Annotated[
    bool, typer.Option("--refine-calibration", help="Smooth; write calibration.refined.toml, too.")
]
Seed = Annotated[
    int, typer.Option("--seed", metavar="N", help="Of everything random: the same seed gives the same result.")
]


def one_of(choices: Sequence[str]) -> Callable[[str], str]:
    def check(name: str) -> str:
        if name not in choices:
            raise typer.BadParameter(f"{name!r} is not one of {', '.join(choices)}")
        return name

    return check


PlotFormat = Annotated[
    str,
    typer.Option("--format", metavar="|".join(FORMATS), help="Of pictures of trajectories.", callback=one_of(FORMATS)),
]


def fail(sentences: Sequence[str]) -> NoReturn:
    for sentence in sentences:
        say(sentence)
    raise typer.Exit(FAILED)
