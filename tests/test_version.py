"""The version is defined in one place; the citation is the same everywhere."""

from __future__ import annotations

import json
import re
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from urllib.parse import unquote, urlparse

import pytest

import sylpose
from sylpose.commands.main import main
from tests.paths import REPOSITORY


def text(name: str) -> str:
    return (REPOSITORY / name).read_text(encoding="utf-8")


def test_version_is_defined_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"sylpose {sylpose.__version__}\n"
    project = tomllib.loads(text("pyproject.toml"))
    assert "version" not in project["project"]
    assert project["project"]["dynamic"] == ["version"]
    assert project["tool"]["hatch"]["version"] == {"path": "src/sylpose/__init__.py"}
    # The value that hatchling reads.
    assert re.findall(r'(?m)^__version__ = "([\d.]+)"$', text("src/sylpose/__init__.py")) == [sylpose.__version__]
    assert "version:" not in text("CITATION.cff").replace("cff-version:", "")


def test_newest_changelog_entry_has_this_version() -> None:
    assert re.findall(r"(?m)^## \[([\d.]+)\]", text("CHANGELOG.md"))[0] == sylpose.__version__


def test_installed_package_has_this_version() -> None:
    try:
        installed = distribution("sylpose")
    except PackageNotFoundError:
        pytest.skip("not installed: run from its sources")
    url = json.loads(installed.read_text("direct_url.json") or "{}").get("url", "")
    if Path(unquote(urlparse(url).path)).resolve() != REPOSITORY.resolve():
        pytest.skip("what is installed is another tree")
    assert installed.version == sylpose.__version__, "python -m pip install --editable . brings it up to date"


def test_citations_agree() -> None:
    wanted = ("Chen", "Schonfeld", "Pose estimation from multiple cameras based on", "equation", "114", "2010")
    for name in ("CITATION.cff", "README.md", "docs/method.md", "docs/method/2-sylvester.md"):
        for words in (*wanted, "Computer Vision and Image Understanding"):
            assert words in re.sub(r"\s+", " ", text(name)), f"{name}: {words}"
