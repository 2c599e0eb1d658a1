"""docs/map.md: every module has its line and every line its module; what is said of functions and constants is so."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pathlib import Path

import pytest

import sylpose
from tests.paths import REPOSITORY

PACKAGE = REPOSITORY / "src" / "sylpose"
MAP = (REPOSITORY / "docs" / "map.md").read_text(encoding="utf-8")


def section(title: str) -> str:
    return re.split(r"^## ", MAP.partition(f"\n## {title}\n")[2], maxsplit=1, flags=re.M)[0]


def rows(title: str) -> list[list[str]]:
    """The cells of a section's table, without its header."""
    lines = [line for line in section(title).splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def mapped() -> dict[str, str]:
    """The tree's files by path: their lines. A folder stands for its `__init__.py`."""
    found: dict[str, str] = {}
    folders: list[str] = []
    for line in section("The tree").partition("src/sylpose/\n")[2].partition("```")[0].splitlines():
        name, _, words = line.strip().partition("  ")
        depth = (len(line) - len(line.lstrip())) // 2 - 1
        assert words.strip(), f"no words for {name}"
        folders[depth:] = [name] if name.endswith("/") else []
        path = "".join(folders) + ("__init__.py" if name.endswith("/") else name)
        assert path not in found, path
        found[path] = line
    return found


def names_of(path: Path) -> set[str]:
    """What a module defines at its top."""
    names: set[str] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign):
            names |= {name.id for target in node.targets for name in ast.walk(target) if isinstance(name, ast.Name)}
    return names


def test_every_module_has_a_line_and_every_line_a_module() -> None:
    files = {path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py")}
    assert files == set(mapped())


def test_lines_are_short_and_in_columns() -> None:
    for path, line in mapped().items():
        assert len(line) <= 110, path


def test_what_is_said_to_be_in_a_file_is_there() -> None:
    said = re.findall(r"`([\w/]+\.py)` \(((?:`\w+`(?:, )?)+)\)", MAP)
    assert len(said) > 25
    for file, names in said:
        assert set(re.findall(r"\w+", names)) <= names_of(PACKAGE / file), file


@pytest.mark.parametrize("title", ["How to choose an estimator", "Many problems at once"])
def test_public_functions_are_called_so(title: str) -> None:
    """Names alone are public ones, or of the file that is named beside them."""
    for row in rows(title):
        cell = row[1] if title.startswith("How") else row[0]
        if ".py" not in cell:
            for name in re.findall(r"`(\w+)[\w.]*`", cell):
                assert hasattr(sylpose, name), name
    missing = {name for name in sylpose.__all__ if name.startswith(("solve", "estimate"))}
    assert missing <= set(re.findall(r"`(\w+)`", section(title))) | {"solve_centralized"}


def test_the_loops_have_the_constants_that_are_said() -> None:
    said = 0
    for row in rows("The loops"):
        own = re.findall(r"`([\w/]+)\.py`", row[0])[0]
        for name, value, elsewhere in re.findall(r"`([A-Z_]+) = ([\d.e-]+)`(?: of `([\w/]+)\.py`)?", " ".join(row)):
            module = import_module(f"sylpose.{(elsewhere or own).replace('/', '.')}")
            assert getattr(module, name) == pytest.approx(float(value)), f"{module.__name__}.{name}"
            said += 1
    assert said > 12


def test_the_story_is_told_once_more_in_each_docstring() -> None:
    """The package's docstring says where the map is, and each room's says something."""
    assert "docs/map.md" in (sylpose.__doc__ or "")
    for path in PACKAGE.rglob("__init__.py"):
        assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))), path


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_the_map_is_linked(page: str) -> None:
    assert "(docs/map.md)" in (REPOSITORY / page).read_text(encoding="utf-8")
