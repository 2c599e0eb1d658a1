"""Generate the API page from the signatures and docstrings of all public names."""

from __future__ import annotations

import dataclasses
import enum
import inspect
import re
from collections.abc import Iterator, Sequence
from typing import Any

import sylpose

__all__ = ["GROUPS", "markdown"]

# All of `sylpose.__all__`, by purpose.
GROUPS: dict[str, tuple[str, ...]] = {
    "Recordings": (
        "open_session",
        "Session",
        "Source",
        "Timeline",
        "open_live",
        "LiveSession",
        "Device",
        "Grab",
        "load_calibration",
    ),
    "Tracking": (
        "track_session",
        "RunOptions",
        "TrackingOptions",
        "Run",
        "track",
        "smooth",
        "TrackedFrame",
        "LandmarkObservations",
        "Nudge",
        "DetectedFeatures",
        "KnownObject",
        "load_object",
        "save_object",
        "carve_object",
        "CarvedObject",
        "Mesh",
    ),
    "Results": (
        "Trajectory",
        "Kinematics",
        "Derivatives",
        "FramePose",
        "FrameStatus",
        "Observability",
        "Motion",
        "Status",
        "RotationEstimate",
        "load_trajectory",
        "save_trajectory",
        "plot_trajectory",
        "to_dataframe",
    ),
    "Cameras and what they saw": ("Camera", "Rig", "FrameSet", "Box", "Matches", "PairMoments"),
    "The world's and the object's frame": (
        "World",
        "load_world",
        "world_with_up",
        "ObjectFrame",
        "Board",
        "parse_board",
        "find_board",
        "BoardObservation",
    ),
    "Calibrating a rig": (
        "calibrate_session",
        "calibrate_from_boards",
        "Detection",
        "RigCalibration",
        "BoardCalibration",
        "Coverage",
        "HalvesTest",
        "CalibrationRefusedError",
        "self_calibrate",
        "KnownLength",
        "MotionCalibration",
        "FreeFlight",
        "MotionTest",
        "MotionRefusedError",
    ),
    "Two frames, known points": ("estimate_motion", "estimate_motions", "estimate_pose"),
    "Another camera's view": (
        "view_of_motion",
        "MotionView",
        "view_of_rotation",
        "RotationView",
        "view_of_pose",
        "trajectory_view",
    ),
    "The paper": (
        "solve_one_camera",
        "OneCameraSolution",
        "solve_centralized",
        "CentralizedSolution",
        "solve_centralized_batch",
        "CentralizedBatch",
        "solve_depth_plane",
        "DepthPlaneSolution",
        "solve_robust",
        "RobustSolution",
        "Diagnosis",
        "Fault",
        "solve_2d3d",
        "solve_3d3d",
        "KnownDepthSolution",
        "solve_exchange",
        "solve_refine",
        "solve_gossip",
        "DistributedSolution",
        "NetworkFaults",
    ),
    "Sylvester's equation": ("solve_sylvester", "solve_generalized_sylvester", "SingularSylvesterError"),
}
# Sections of docstrings, and their titles on the page.
SECTIONS = {
    "Args": "Arguments",
    "Attributes": "Attributes",
    "Returns": "Returns",
    "Yields": "Yields",
    "Raises": "Raises",
}
# Longer signatures have a line for each parameter.
WIDTH = 96
INTRODUCTION = """# API

All public names of `sylpose`, generated from their docstrings. Arrays are NumPy's, with their shapes in parentheses:
C cameras, n points, N problems or frames. Rotations and rigid transforms are SciPy's `Rotation` and `RigidTransform`.
[conventions](../docs/conventions.md) defines symbols, frames and units; [choosing](../docs/choosing.md) helps to select
a function. Names that are not listed here may change.
"""


def markdown() -> str:
    """Generate the page."""
    parts = [INTRODUCTION]
    for title, names in GROUPS.items():
        listed = " · ".join(f"[`{name}`](#{name.lower()})" for name in names)
        parts += [f"## {title}\n\n{listed}\n", *(_entry(name) for name in names)]
    return "\n".join(parts)


def _entry(name: str) -> str:
    """Describe one class or function."""
    thing = getattr(sylpose, name)
    parts = [f"### {name}\n"]
    if isinstance(thing, type) and issubclass(thing, enum.Enum):
        members = [f'- `{member.name}`, "{member.value}": {getattr(member, "text", "")}' for member in thing]
        return "\n".join([*parts, _prose(_doc(thing), name), "", *members, ""])
    if not isinstance(thing, type):
        return "\n".join([*parts, _code(name, thing), "", _prose(_doc(thing), name), ""])
    if not issubclass(thing, BaseException):
        parts.append(_code(name, thing) + "\n")
    bases = [base.__name__ for base in thing.__bases__ if base.__name__ in sylpose.__all__]
    if bases:
        parts.append(f"All that {' and '.join(_linked(f'`{base}`', name) for base in bases)} has, and more.\n")
    parts += [_prose(_doc(thing), name), ""]
    for member, value in _members(thing):
        said = _prose(_doc(value), name)
        if isinstance(value, property):
            parts.append(f"**`.{member}`**: {said}\n")
        else:
            parts.append(f"**`.{member}()`**\n\n{_code(member, value)}\n\n{said}\n")
    return "\n".join(parts)


def _doc(thing: Any) -> str:
    return inspect.getdoc(thing) or ""


def _members(thing: type) -> Iterator[tuple[str, Any]]:
    """Yield a class's own public properties and methods, in the order of the source."""
    fields = {field.name for field in dataclasses.fields(thing)} if dataclasses.is_dataclass(thing) else set()
    for member, value in vars(thing).items():
        if member.startswith("_") or member in fields or not _doc(value):
            continue
        value = getattr(value, "__func__", value)
        if isinstance(value, property) or inspect.isfunction(value) or hasattr(value, "func"):
            yield member, property(value.func) if hasattr(value, "func") else value


def _code(name: str, thing: Any) -> str:
    """Format a signature as a block of Python."""
    signature = inspect.signature(thing)
    if isinstance(thing, type):
        signature = signature.replace(return_annotation=inspect.Signature.empty)
    parameters = [p for p in signature.parameters.values() if p.name not in ("self", "cls") and p.name[0] != "_"]
    said = [_parameter(p) for p in parameters]
    stars = [k for k, p in enumerate(parameters) if p.kind is inspect.Parameter.KEYWORD_ONLY]
    if stars and not any(p.kind is inspect.Parameter.VAR_POSITIONAL for p in parameters):
        said.insert(stars[0], "*")
    result = signature.return_annotation
    end = ")" if result is inspect.Signature.empty else f") -> {result if isinstance(result, str) else result.__name__}"
    line = f"{name}({', '.join(said)}{end}"
    if len(line) > WIDTH:
        line = f"{name}(\n" + "".join(f"    {one},\n" for one in said) + end
    return f"```python\n{line}\n```"


def _parameter(parameter: inspect.Parameter) -> str:
    """Format a parameter with its type and its default."""
    kinds: dict[Any, str] = {inspect.Parameter.VAR_POSITIONAL: "*", inspect.Parameter.VAR_KEYWORD: "**"}
    said: str = kinds.get(parameter.kind, "") + parameter.name
    if parameter.annotation is not parameter.empty:
        said += f": {parameter.annotation if isinstance(parameter.annotation, str) else parameter.annotation.__name__}"
    if parameter.default is parameter.empty:
        return said
    value = repr(parameter.default)
    return f"{said} = {'...' if value.startswith('<') else value}"


def _prose(doc: str, own: str) -> str:
    """Convert a docstring to Markdown: sections become lists, public names links."""
    parts: list[str] = []
    section: str | None = None
    for block in _blocks(doc):
        head, _, rest = block.partition("\n")
        if head.rstrip(":") in SECTIONS and head.endswith(":"):
            section = SECTIONS[head.rstrip(":")]
            parts.append(f"*{section}*\n\n{_items(inspect.cleandoc(rest))}")
        elif block.startswith("    "):
            parts.append(f"```text\n{inspect.cleandoc(block)}\n```")
        else:
            parts.append(block)
    return _linked("\n\n".join(parts), own)


def _blocks(doc: str) -> Iterator[str]:
    """Paragraphs, and sections with all that is indented below them."""
    lines: list[str] = []
    inside = False
    for line in [*doc.splitlines(), ""]:
        if inside and line and not line.startswith(" "):
            yield "\n".join(lines).rstrip()
            lines, inside = [], False
        if not inside and not line:
            if lines:
                yield "\n".join(lines)
            lines = []
            continue
        if line.rstrip(":") in SECTIONS and line.endswith(":"):
            if lines:
                yield "\n".join(lines)
            lines, inside = [], True
        lines.append(line)
    if lines:
        yield "\n".join(lines).rstrip()


def _items(text: str) -> str:
    """Convert entries `name: description`, possibly of several lines, to a list; keep other lines."""
    found: list[str] = []
    for line in text.splitlines():
        name = re.match(r"((?:\*{0,2}\w+)(?:, \w+)*): (.*)", line)
        if name:
            found.append(f"- `{name[1]}`: {name[2]}")
        elif line.startswith(" ") and found:
            found.append(f"  {line.strip()}")
        else:
            found.append(f"{'  ' if found and found[-1].startswith(('- ', '  ')) else ''}{line.strip()}")
    return "\n".join(found)


def _linked(text: str, own: str) -> str:
    """Link public names in backticks to their descriptions."""

    def link(match: re.Match[str]) -> str:
        name = match[1]
        return f"[`{name}`](#{name.lower()})" if name in sylpose.__all__ and name != own else match[0]

    parts: Sequence[str] = re.split(r"(?s)(```.*?```)", text)
    return "".join(part if part.startswith("```") else re.sub(r"`(\w+)`", link, part) for part in parts)
