"""A command takes one record of options, checked once, from the command line and from Python."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import typer

from sylpose.commands.app import app, command, option, pick
from sylpose.commands.main import main
from sylpose.commands.options import MethodOptions, RecordingOptions

group = typer.Typer(rich_markup_mode=None)
received: list[ProbeOptions] = []


@dataclass(frozen=True, kw_only=True)
class ProbeOptions(MethodOptions, RecordingOptions):
    """Options of the probe.

    Attributes:
        exact: Switch, described in the docstring over more than one line, which Click wraps again to the width of
            the terminal.
    """

    point: Annotated[tuple[float, float] | None, typer.Option(metavar="X Y", help="Set a point.")] = None
    count: Annotated[int, typer.Option(min=1, max=9, help="Set a number.")] = 2
    exact: Annotated[bool, option("--exact")] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.exact and self.count == 3:
            raise ValueError("count must not be 3")


@command("Probe.", group=group, notes="Note.")
def probe(options: ProbeOptions) -> None:
    """Receive options.

    Examples:
        sylpose probe recording
            --count 3
        sylpose probe other
    """
    received.append(options)


def run(*words: str) -> int:
    try:
        group(args=list(words), prog_name="sylpose")
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_options_arrive_as_one_record() -> None:
    assert (
        run("a", "--video", "x=1", "--video", "y=2", "--point", "1", "2.5", "--exact", "--calibration", "c.toml") == 0
    )
    expected = ProbeOptions(
        session=Path("a"), video=("x=1", "y=2"), point=(1.0, 2.5), exact=True, calibration=Path("c.toml")
    )
    assert received.pop() == expected
    assert run("a") == 0
    assert received.pop() == ProbeOptions(session=Path("a"))


def test_python_callers_may_pass_text_lists_and_integers() -> None:
    options = ProbeOptions(session="a", video=["x=1"], rate=30)  # type: ignore[arg-type]
    assert (options.session, options.video, type(options.rate)) == (Path("a"), ("x=1",), float)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("rate", "30", "rate must be float, got str"),
        ("count", True, "count must be int, got bool"),
        ("count", None, "count must be int, got NoneType"),
        ("video", "x=1", "video must be tuple, got str"),
        ("video", [1], "video must be str, got int"),
        ("point", (1.0,), "point must have 2 values, got 1"),
    ],
)
def test_wrong_types_are_refused(field: str, value: object, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        ProbeOptions(**{"session": Path("a"), field: value})  # type: ignore[arg-type]


def test_ranges_and_combinations_are_checked_once(capsys: pytest.CaptureFixture[str]) -> None:
    for count, message in ((0, "count must be at least 1, got 0"), (10, "count must be at most 9, got 10")):
        with pytest.raises(ValueError, match=message):
            ProbeOptions(session=Path("a"), count=count)
    with pytest.raises(ValueError, match="does not suit"):
        ProbeOptions(session=Path("a"), method="sylvester", features="klt")
    assert run("a", "--exact", "--count", "3") == 2
    assert capsys.readouterr().err == "sylpose: --count must not be 3\n"


def test_pick_returns_the_shared_options() -> None:
    options = ProbeOptions(session=Path("a"), rate=5.0, count=4)
    assert pick(options, RecordingOptions, masks=Path("m")) == RecordingOptions(
        session=Path("a"), rate=5.0, masks=Path("m")
    )


def test_every_option_has_a_help() -> None:
    main(["--version"])  # registers the commands
    commands = [typer.main.get_command(app)]
    for found in commands:
        commands += getattr(found, "commands", {}).values()
        for parameter in found.params:
            assert getattr(parameter, "help", None), f"{found.name} {parameter.name}"
    assert len(commands) > 20


def test_help_lists_inherited_options_and_notes(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    text = " ".join(capsys.readouterr().out.split())
    for words in (
        "Receive options.",
        "--exclude-camera CAM",
        "--count",
        "[default: 2",
        "--exact Switch, described in the docstring over more than one line, which Click wraps again",
        "Note.",
        "Examples: sylpose probe recording --count 3 sylpose probe other",
    ):
        assert words in text


def test_choices_hold_from_python_and_from_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="features: 'corners' is not one of auto, "):
        ProbeOptions(session=Path("a"), features="corners")
    assert run("a", "--features", "corners") == 2
    assert capsys.readouterr().err.startswith("sylpose: --features: 'corners' is not one of auto, ")
