"""`sylpose doctor`: its output for this installation and for broken ones."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import sylpose
from sylpose.commands.main import main
from sylpose.runs import installation
from sylpose.runs.installation import Diagnosis, diagnose
from sylpose.runs.precompile import compile_all
from tests.paths import REPOSITORY

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def name_of(requirement: str) -> str:
    found = re.match(r"[\w.-]+", requirement)
    assert found
    return found.group()


@pytest.fixture(autouse=True)
def use_project_requirements(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use the requirements of pyproject.toml: the installed metadata may be outdated."""
    lines = [*PROJECT["dependencies"]]
    for extra, inside in PROJECT["optional-dependencies"].items():
        lines += [f'{line}; extra == "{extra}"' for line in inside]
    monkeypatch.setattr(installation, "requires", lambda _: lines)


def test_working_installation(capsys: pytest.CaptureFixture[str]) -> None:
    compile_all()
    assert main(["doctor"]) == 0
    output = capsys.readouterr().out
    assert output.startswith(f"sylpose       {sylpose.__version__} in {Path(sylpose.__file__).parent}\n")
    assert f"numpy {np.__version__}" in output
    assert re.search(r"(?m)^Compiled code ready, cached in \S", output)
    assert re.search(r"(?m)^OpenCV        \d\.\d+\.\d+.*: opencv\S*", output)
    assert "works" in output.splitlines()[-1]


def test_json_output(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert set(output) == set(Diagnosis.__dataclass_fields__)
    assert output["problems"] == []
    assert output["versions"]["sylpose"] == sylpose.__version__
    # Every dependency was imported, and is listed by its module's name.
    needed = {installation._module_name(name_of(line)) for line in PROJECT["dependencies"]}
    assert needed <= set(output["versions"])
    for module in needed:
        assert output["versions"][module] != "?", module
    extras = set(PROJECT["optional-dependencies"])
    assert set(output["extras"]) == extras - installation.DEVELOPER_EXTRAS


def test_broken_libraries_are_reported(tmp_path: Path) -> None:
    """Break NumPy, which nearly every module needs, and an OpenCV with GUI on a machine without graphics."""
    for module, error in {"numpy": "no luck", "cv2": "libGL.so.1: cannot open shared object file"}.items():
        (tmp_path / module).mkdir()
        (tmp_path / module / "__init__.py").write_text(f'raise ImportError("{error}")')
    path = os.pathsep.join([str(tmp_path), str(REPOSITORY / "src")])
    done = subprocess.run(
        [sys.executable, "-m", "sylpose", "doctor"],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert "sylpose: numpy cannot be loaded (ImportError: no luck); python -m pip install 'numpy>=" in done.stderr
    assert "sylpose: cv2 cannot be loaded (ImportError: libGL" in done.stderr
    assert "opencv-python-headless needs no graphics" in done.stderr
    assert "Platform" in done.stdout
    assert "works" not in done.stdout


def test_outdated_versions_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [*PROJECT["dependencies"], "numpy>=99"]
    monkeypatch.setattr(installation, "requires", lambda _: lines)
    (problem,) = diagnose().problems
    assert problem.startswith(f"numpy is {np.__version__}, sylpose needs numpy>=99: ")


def test_several_opencv_packages_give_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    def installed(*names: str) -> Diagnosis:
        monkeypatch.setattr(
            installation, "distributions", lambda: [SimpleNamespace(metadata={"Name": name}) for name in names]
        )
        return diagnose()

    both = installed("opencv_python", "numpy", "opencv-contrib-python")
    (warning,) = both.warnings
    assert warning.startswith(
        "2 packages of OpenCV are installed into one folder, opencv-contrib-python and opencv-python:"
    )
    assert not both.problems
    none = installed("numpy")
    assert "not from a pip package" in none.facts["OpenCV"]
    assert not none.warnings


def test_missing_extras_are_listed_with_the_pip_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [*PROJECT["dependencies"], 'not-there>=1; extra == "archive"', 'numpy; extra == "archive"']
    monkeypatch.setattr(installation, "requires", lambda _: lines)
    assert main(["doctor"]) == 0
    assert "archive: python -m pip install 'not-there>=1'\n" in capsys.readouterr().out


def test_unwritable_cache_folder_gives_a_warning(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "folder"))
    (warning,) = diagnose().warnings
    assert warning.startswith(f"NUMBA_CACHE_DIR={tmp_path / 'file' / 'folder'} cannot be written")


def test_codecs_and_features_are_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    import av
    import cv2

    def broken() -> None:
        raise AttributeError("without it")

    monkeypatch.setattr(av, "codecs_available", {"mpeg4"})
    monkeypatch.setattr(cv2, "SIFT_create", broken)
    sift, decoding = diagnose().problems
    assert sift == "SIFT features cannot be detected by cv2 (AttributeError: without it)"
    assert decoding.startswith("videos cannot be decoded by av ")
