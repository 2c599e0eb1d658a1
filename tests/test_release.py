"""Release contents: project metadata is consistent, and a wheel is checked for completeness."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from zipfile import ZipFile

import pytest
import yaml

from sylpose import __version__
from tests import installed
from tests.paths import REPOSITORY

PYPROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))
WORKFLOW = yaml.safe_load((REPOSITORY / ".github/workflows/ci.yml").read_text(encoding="utf-8"))
INFO = f"sylpose-{__version__}.dist-info/"


def text(name: str) -> str:
    return (REPOSITORY / name).read_text(encoding="utf-8")


def wheel_with(path: Path, names: set[str]) -> Path:
    with ZipFile(path, "w") as archive:
        for name in sorted(names):
            archive.writestr(name, "")
    return path


WHOLE = installed.package_files() | {f"{INFO}licenses/{name}" for name in installed.LEGAL} | {f"{INFO}METADATA"}


def test_complete_wheel_passes(tmp_path: Path) -> None:
    assert "LICENSE" in installed.LEGAL
    assert {"sylpose/py.typed", "sylpose/commands/doctor.py"} <= WHOLE
    assert installed.wheel_contents(wheel_with(tmp_path / "a.whl", WHOLE)) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"sylpose/py.typed"}, "a.whl lacks sylpose/py.typed"),
        ({f"{INFO}licenses/LICENSE"}, "a.whl lacks LICENSE"),
        ({"tests/paths.py"}, "a.whl has tests/paths.py, which is no part of the package"),
        ({"sylpose/__pycache__/rig.pyc"}, "a.whl has sylpose/__pycache__/rig.pyc, which is no part of the package"),
    ],
)
def test_incomplete_wheel_fails(tmp_path: Path, change: set[str], said: str) -> None:
    assert installed.wheel_contents(wheel_with(tmp_path / "a.whl", WHOLE ^ change)) == [said]


def test_all_claimed_python_versions_are_tested() -> None:
    claimed = re.findall(r":: (3\.\d+)$", "\n".join(PYPROJECT["project"]["classifiers"]), re.M)
    assert claimed[0] == PYPROJECT["project"]["requires-python"].removeprefix(">=")
    tried = WORKFLOW["jobs"]["test"]["strategy"]["matrix"]["python"]
    assert tried == claimed


def test_both_opencv_versions_are_tested() -> None:
    assert WORKFLOW["jobs"]["opencv"]["strategy"]["matrix"]["opencv"] == ["4", "5"]
    for name in re.findall(r"(?m)^OPENCV_TESTS := (.*)$", text("Makefile"))[0].split():
        assert (REPOSITORY / name).exists(), name


def test_image_copies_files_needed_by_the_build() -> None:
    """The image has the files that `pyproject.toml` needs to build, and it runs as an unprivileged user."""
    dockerfile = text("Dockerfile")
    (copied,) = re.findall(r"(?m)^COPY (.*) \./$", dockerfile)
    needed = {PYPROJECT["project"]["readme"], *PYPROJECT["project"]["license-files"], "pyproject.toml"}
    assert {file for file in needed if not file.startswith("src/")} <= set(copied.split())
    assert re.search(r"(?m)^COPY src src$", dockerfile)
    assert re.search(r"(?m)^USER \d+", dockerfile)
    for name in copied.split():
        assert (REPOSITORY / name).exists(), name


def test_paper_length_and_citations() -> None:
    head, body = text("paper/paper.md").split("\n---\n", 1)
    assert 750 <= len(re.findall(r"\w[\w'-]*", body)) <= 1750
    meta = yaml.safe_load(head.removeprefix("---\n"))
    assert meta["bibliography"] == "paper.bib"
    known = set(re.findall(r"(?m)^@\w+\{([\w-]+),", text("paper/paper.bib")))
    assert set(re.findall(r"@([\w-]+)", body)) == known
    for heading in ("Summary", "Statement of need", "State of the field"):
        assert f"\n# {heading}\n" in body
