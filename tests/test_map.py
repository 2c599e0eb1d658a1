"""docs/map.md: it lists every module, and what it states about functions and constants is correct."""

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
    """Return the cells of a section's table, without its header."""
    lines = [line for line in section(title).splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def mapped() -> dict[str, str]:
    """Return the tree's files by path, with their lines. A folder represents its `__init__.py`."""
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
    """Return the names that a module defines at top level."""
    names: set[str] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign):
            names |= {name.id for target in node.targets for name in ast.walk(target) if isinstance(name, ast.Name)}
    return names


def test_map_lists_every_module() -> None:
    files = {path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py")}
    assert files == set(mapped())


def test_lines_are_short_and_aligned() -> None:
    for path, line in mapped().items():
        assert len(line) <= 110, path


def test_names_are_defined_in_their_files() -> None:
    text = re.findall(r"`([\w/]+\.py)` \(((?:`\w+`(?:, )?)+)\)", MAP)
    assert len(text) > 25
    for file, names in text:
        assert set(re.findall(r"\w+", names)) <= names_of(PACKAGE / file), file


@pytest.mark.parametrize("title", ["How to choose an estimator", "Many problems at once"])
def test_public_functions_exist(title: str) -> None:
    """Unqualified names are public, or defined in the file that is named next to them."""
    for row in rows(title):
        cell = row[1] if title.startswith("How") else row[0]
        if ".py" not in cell:
            for name in re.findall(r"`(\w+)[\w.]*`", cell):
                assert hasattr(sylpose, name), name
    missing = {name for name in sylpose.__all__ if name.startswith(("solve", "estimate"))}
    assert missing <= set(re.findall(r"`(\w+)`", section(title))) | {"solve_centralized"}


def test_loops_have_the_stated_constants() -> None:
    text = 0
    for row in rows("The loops"):
        own = re.findall(r"`([\w/]+)\.py`", row[0])[0]
        for name, value, elsewhere in re.findall(r"`([A-Z_]+) = ([\d.e-]+)`(?: of `([\w/]+)\.py`)?", " ".join(row)):
            module = import_module(f"sylpose.{(elsewhere or own).replace('/', '.')}")
            assert getattr(module, name) == pytest.approx(float(value)), f"{module.__name__}.{name}"
            text += 1
    assert text > 12


def test_packages_have_docstrings() -> None:
    """The package's docstring refers to the map, and each package has a docstring."""
    assert "docs/map.md" in (sylpose.__doc__ or "")
    for path in PACKAGE.rglob("__init__.py"):
        assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))), path


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_map_is_linked(page: str) -> None:
    assert "(docs/map.md)" in (REPOSITORY / page).read_text(encoding="utf-8")
