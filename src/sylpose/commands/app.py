"""Shared parts of the commands: the app, options records, error handling, grouped help and common options.

A command is a function of one frozen record of options (`command`). Command modules import everything but their options
in function bodies: the tracker and matplotlib take a second each to load, which `--help` does not need.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import MISSING, dataclass, fields
from inspect import Parameter, Signature, cleandoc
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperCommand
from typer.models import OptionInfo

from sylpose.input_limits import print_message

T = TypeVar("T")
OptionsT = TypeVar("OptionsT", bound="CommandOptions")

FAILED, WRONG_INPUT, INTERRUPTED = 1, 2, 130
# Sections of `--help`, in their order; options without a section come first, under "Options".
INPUT, OBJECT, OUTPUT, LIVE, ADVANCED = _SECTIONS = ("Input", "Object", "Output", "Live", "Advanced")
# Options whose argument in the Python functions has another name than in the command.
_OPTION_BY_ARGUMENT = {
    "cameras": "--video",
    "lossless": "--no-drop",
    "max_time_diff": "--within",
    "offsets": "--frame-offset",
    "up": "--world",
    "without": "--exclude-camera",
    "checkpoint_seconds": "--checkpoint",
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


@dataclass(frozen=True, kw_only=True)
class CommandOptions:
    """Options of a command; each field is `Annotated` with its `option` or `typer.Argument`.

    The help of an option is its text in the "Attributes" of the record's docstring, or for options that several
    commands share (`commands.options`), its text here.

    Commands that are called from Python accept text for paths, sequences for tuples and integers for floats.

    Attributes:
        boxes: Read the object's boxes in the first frame; default: SESSION/boxes.toml if present.
        frame_offset: Set by how many frames a camera starts late. Repeatable.
        angles: Add three Euler angles to the CSV and plot them: XYZ (intrinsic axes), xyz (extrinsic axes), or three
            vectors, "0,0,1 1,0,0 0,1,0".
        unit: Set the length unit of the results; default: the calibration's.
        world: Set the world frame, z up: a board on the floor (chessboard:9x6,square=25mm), up=0,-1,0 in the
            calibration's frame, or a file (world.toml, or three points: docs/formats.md).
        out: Write the results here; default: SESSION/sylpose.
        stop: Stop before this frame; default: the end.
        overlay: Write overlay.mp4.
        smooth: Refine all poses jointly at the end; default: for recordings.
        refine_calibration: Smooth and also estimate the calibration's errors; write calibration.refined.toml.
        seed: Set the random seed; equal seeds give equal results.
        plot_format: Set the file format of plots.
        result: Recording that was tracked, the folder that sylpose track wrote, or its trajectory.csv.

    Raises:
        TypeError, ValueError: naming the field: another type, or out of its range.
    """

    def __post_init__(self) -> None:
        """Convert and check each field; a record that restricts combinations extends this method."""
        record: Any = type(self)
        for name, hint in _resolve_hints(record).items():
            value, info = getattr(self, name), hint.__metadata__[0]
            choices = getattr(info, "choices", ())  # arguments have none
            converted = _convert_value(get_args(hint)[0], value, name)
            for item in converted if isinstance(converted, tuple) else (converted,):
                if choices and item not in choices:
                    raise ValueError(f"{name}: {item!r} is not one of {', '.join(choices)}")
                if isinstance(item, (int, float)) and not isinstance(item, bool):
                    _check_range(item, info.min, info.max, name)
            object.__setattr__(self, name, converted)


@functools.cache
def _resolve_hints(record: type[Any]) -> dict[str, Any]:
    """Return the annotation of each field, with its help from the docstrings of the record and its bases."""
    hints, texts, found = get_type_hints(record, include_extras=True), dict[str, str](), dict[str, Any]()
    for base in reversed(record.__mro__):
        section = cleandoc(base.__doc__ or "").partition("\nAttributes:\n")[2]
        texts |= re.findall(r"^    (\w+): (.+(?:\n {8}.+)*)", section, re.M)
    for field in fields(record):
        kind, info = get_args(hints[field.name])
        if text := texts.get(field.name):
            info = copy(info)
            info.help = " ".join(text.split())
        found[field.name] = Annotated[kind, info]
    return found


def _convert_value(hint: Any, value: Any, name: str) -> Any:
    """Return the value as a type that options have: a class, tuple or optional one."""
    if get_origin(hint) in (Union, UnionType):
        return None if value is None else _convert_value(get_args(hint)[0], value, name)
    if get_origin(hint) is tuple and isinstance(value, (list, tuple)):
        kinds = get_args(hint)
        kinds = kinds[:1] * len(value) if kinds[-1] is Ellipsis else kinds
        if len(value) != len(kinds):
            raise TypeError(f"{name} must have {len(kinds)} values, got {len(value)}")
        return tuple(_convert_value(kind, item, name) for kind, item in zip(kinds, value, strict=True))
    if hint is Path and isinstance(value, str):
        return Path(value)
    if hint is float and type(value) is int:
        return float(value)
    kind = get_origin(hint) or hint
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise TypeError(f"{name} must be {kind.__name__}, got {type(value).__name__}")
    return value


def _check_range(value: float, minimum: float | None, maximum: float | None, name: str) -> None:
    if minimum is not None and not value >= minimum:
        raise ValueError(f"{name} must be at least {minimum:g}, got {value}")
    if maximum is not None and not value <= maximum:
        raise ValueError(f"{name} must be at most {maximum:g}, got {value}")


def command(
    summary: str, *, group: typer.Typer = app, name: str | None = None, notes: str = ""
) -> Callable[[Callable[[OptionsT], None]], Callable[[OptionsT], None]]:
    """Register a function of one options record as a command; its fields become the options, in their order.

    The function's docstring is the help; its "Examples" end it. An example continues in lines that are indented more.

    Args:
        summary: short help, for the list of commands.
        group: the app, or one of its groups (`object`).
        name: the command's name; by default the function's.
        notes: text before the examples.
    """

    def register(function: Callable[[OptionsT], None]) -> Callable[[OptionsT], None]:
        (record,) = (hint for key, hint in get_type_hints(function).items() if key != "return")
        hints = _resolve_hints(record)
        repeatable = {key for key, hint in hints.items() if get_args(get_args(hint)[0])[-1:] == (Ellipsis,)}

        @functools.wraps(function)
        def run(**values: Any) -> None:
            with _report_errors(record, values):
                function(record(**{key: value or () if key in repeatable else value for key, value in values.items()}))

        parameters = []
        for field in fields(record):
            hint, default = hints[field.name], Parameter.empty if field.default is MISSING else field.default
            if field.name in repeatable:  # Typer has no tuples of any length
                kind = get_args(get_args(hint)[0])[0]
                hint, default = Annotated[list[kind] | None, hint.__metadata__[0]], None  # type: ignore[valid-type]
            parameters.append(Parameter(field.name, Parameter.KEYWORD_ONLY, default=default, annotation=hint))
        run.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        run.__doc__, _, examples = cleandoc(function.__doc__ or "").partition("\n\nExamples:\n    ")
        lines = re.sub(r"\n {8,}", " ", examples).split("\n    ")
        epilog = notes + ("\n" if notes else "") + format_examples(*lines)
        group.command(name, cls=GroupedCommand, short_help=summary, epilog=epilog)(run)
        return function

    return register


@contextmanager
def _report_errors(record: Any, values: Mapping[str, object]) -> Iterator[None]:
    """Turn wrong input and interrupts into a one-line message and an exit code; bugs keep their traceback."""
    try:
        yield
    except KeyboardInterrupt as interrupt:
        print_message(str(interrupt) or "interrupted")
        raise typer.Exit(INTERRUPTED) from None
    except BrokenPipeError:  # the reader has closed the pipe; Typer handles it
        raise
    except (ValueError, OSError) as error:
        if type(error).__name__ == "LinAlgError":  # a bug
            raise
        message = str(error) or type(error).__name__
        if isinstance(error, ValueError):
            message = substitute_option_name(message, map_option_names(record), values)
        elif error.filename is not None and error.strerror:
            message = f"{error.filename}: {error.strerror.lower()}"
        print_message(message)
        raise typer.Exit(WRONG_INPUT) from None


def map_option_names(record: Any) -> dict[str, str]:
    """Map the names of a record's fields, and of the functions' arguments, to the options."""
    found: dict[str, str] = {}
    for name, hint in _resolve_hints(record).items():
        info = hint.__metadata__[0]
        if isinstance(info, OptionInfo):
            # Until Typer builds the command, it keeps the first declaration in `default`.
            words = [str(word) for word in (info.default, *(info.param_decls or ())) if str(word).startswith("--")]
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


def option(words: str, section: str | None = None, choices: Sequence[str] = (), **more: Any) -> Any:
    """Describe an option of a command, apart from its help.

    Args:
        words: its names and its metavar, "--boxes FILE".
        section: its section of `--help`; None for "Options".
        choices: the values that the record accepts; () for all.
        more: further arguments of `typer.Option`: min, max, callback, show_default.
    """
    names = [word for word in words.split() if word.startswith("-")]
    metavar = words.removeprefix(" ".join(names)).strip() or None
    info = typer.Option(*names, metavar=metavar, rich_help_panel=section, **more)
    info.choices = tuple(choices)
    return info


def pick(options: CommandOptions, record: type[T], **changes: object) -> T:
    """Return another record of the options with the same names.

    Args:
        options: options of a command.
        record: a dataclass.
        changes: fields with other values or names.
    """
    names = [field.name for field in fields(record) if hasattr(options, field.name)]  # type: ignore[arg-type]
    return record(**({name: getattr(options, name) for name in names} | changes))


def exit_with_failures(messages: Sequence[str]) -> NoReturn:
    """Print the messages and exit with code 1."""
    for message in messages:
        print_message(message)
    raise typer.Exit(FAILED)
