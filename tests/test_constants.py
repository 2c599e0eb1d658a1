"""Comments of constants state their origin: (derived), (chi-squared), (measured: where) or (choice)."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "sylpose"
# Packages in which this is required.
ROOMS = (
    "geometry",
    "relative_pose",
    "absolute_pose",
    "bundle_adjustment",
    "smoothing",
    "kinematics",
    "sylvester",
    "landmarks",
    "tracking",
)
ORIGIN = re.compile(r"\((derived|chi-squared|measured|choice)\b")


def constants_of(path: Path) -> list[tuple[str, str]]:
    """Return a module's numeric constants, each with the comments above it and on its line.

    Consecutive constants without a comment between them share one.
    """
    text = path.read_text(encoding="utf-8")
    lines, found = text.splitlines(), []
    for node in ast.parse(text).body:
        if not isinstance(node, ast.Assign):
            continue
        names = [n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)]
        numbers = [n for n in ast.walk(node.value) if isinstance(n, ast.Constant) and isinstance(n.value, int | float)]
        if not numbers or not all(name.isupper() and name[0] != "_" for name in names):
            continue
        at = node.lineno - 1
        while at > 0 and lines[at - 1].strip() and not lines[at - 1].startswith(("#", " ", "@", ")")):
            at -= 1
        comment: list[str] = []
        while at > 0 and lines[at - 1].startswith("#"):
            at -= 1
            comment.insert(0, lines[at])
        comment.append(lines[node.end_lineno - 1] if node.end_lineno else "")
        found.append((", ".join(names), " ".join(comment)))
    return found


@pytest.mark.parametrize("room", ROOMS)
def test_constants_state_their_origin(room: str) -> None:
    modules = sorted((SOURCE / room).rglob("*.py")) or [SOURCE / f"{room}.py"]
    found = [(f"{path.name}: {names}", comment) for path in modules for names, comment in constants_of(path)]
    assert found
    assert [name for name, comment in found if not ORIGIN.search(comment)] == []
