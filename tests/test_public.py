"""The public API is closed: everything that its functions take, return or raise is public as well."""

from __future__ import annotations

import ast
import builtins
import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import pytest

import sylpose


def types_in(hint: Any) -> Iterator[type]:
    """Yield the classes of an annotation, including those of its parts."""
    if isinstance(hint, type):
        yield hint
    if isinstance(hint, (list, tuple)):
        parts: tuple[Any, ...] = tuple(hint)
    else:
        parts = (get_origin(hint), *get_args(hint))
    for part in parts:
        if part is not None and part is not hint:
            yield from types_in(part)


def functions_of(name: str) -> Iterator[Any]:
    """Yield the object exported under a name; for a class also its public methods and properties."""
    thing = getattr(sylpose, name)
    yield thing
    if isinstance(thing, type):
        for member, value in inspect.getmembers_static(thing):
            if not member.startswith("_"):
                value = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
                if inspect.isfunction(value):
                    yield value


def hints_of(function: Any) -> dict[str, Any]:
    """Return the annotations of the public parameters, attributes and the result."""
    return {name: hint for name, hint in get_type_hints(function).items() if not name.startswith("_")}


def raised_by(function: Any) -> set[str]:
    """Return the names of classes under "Raises:" in a docstring."""
    section = re.search(r"^Raises:\n((?:    .*\n?|\n)*)", inspect.getdoc(function) or "", re.MULTILINE)
    return set(re.findall(r"^    (\w+):", section[1], re.MULTILINE)) if section else set()


def test_stub_lists_each_public_name_once() -> None:
    """`__init__.pyi` has one import per name, under the same name, in the order of the modules."""
    tree = ast.parse(Path(str(sylpose.__file__)).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    aliases = [alias for node in imports for alias in node.names]
    assert len(imports) == len(aliases) == len(sylpose.__all__) == len(set(sylpose.__all__))
    assert all(alias.name == alias.asname for alias in aliases)
    assert sorted(alias.name for alias in aliases) == list(sylpose.__all__)


@pytest.mark.parametrize("name", sylpose.__all__)
def test_public_names_are_defined_in_their_modules(name: str) -> None:
    """A package's `__init__` exports names of its modules by `__all__`; a module defines its own."""
    module = sylpose._HOME_OF[name]
    loaded = import_module(module)
    home = getattr(getattr(loaded, name), "__module__", module)
    assert name in loaded.__all__ if hasattr(loaded, "__all__") else home == module


@pytest.mark.parametrize("name", sylpose.__all__)
def test_signatures_use_public_types_only(name: str) -> None:
    for function in functions_of(name):
        for what, hint in hints_of(function).items():
            ours = {t.__name__ for t in types_in(hint) if t.__module__.split(".")[0] == "sylpose"}
            assert ours <= set(sylpose.__all__), f"{function}: {what}"


@pytest.mark.parametrize("name", sylpose.__all__)
def test_raised_errors_are_public(name: str) -> None:
    for function in functions_of(name):
        known = {*sylpose.__all__, *dir(builtins)}
        assert raised_by(function) <= known, function


def test_helpers_find_nested_types_and_errors() -> None:
    """The helpers handle nested annotations, and errors with text over several lines."""
    assert {t.__name__ for t in types_in(dict[str, tuple[sylpose.Box | None, ...]])} >= {"dict", "tuple", "Box"}
    assert raised_by(sylpose.solve_sylvester) == {"SingularSylvesterError", "ValueError"}
    assert hints_of(sylpose.solve_refine)["return"] is sylpose.DistributedSolution
    assert {t.__name__ for t in types_in(hints_of(sylpose.TrackedFrame)["observations"])} >= {"LandmarkObservations"}
