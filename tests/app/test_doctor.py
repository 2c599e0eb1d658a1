"""`sylpose doctor`: what it says of this installation, and of broken ones."""

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
from sylpose.app import doctor
from sylpose.app.doctor import Diagnosis, diagnose
from sylpose.cli import main
from sylpose.relative_pose.precompile import warm_up
from tests.paths import REPOSITORY

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def name_of(requirement: str) -> str:
    found = re.match(r"[\w.-]+", requirement)
    assert found
    return found.group()


@pytest.fixture(autouse=True)
def as_it_stands_in_the_project(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is installed may be of another day."""
    lines = [*PROJECT["dependencies"]]
    for extra, inside in PROJECT["optional-dependencies"].items():
        lines += [f'{line}; extra == "{extra}"' for line in inside]
    monkeypatch.setattr(doctor, "requires", lambda _: lines)


def test_here_everything_works(capsys: pytest.CaptureFixture[str]) -> None:
    warm_up()
    assert main(["doctor"]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"sylpose       {sylpose.__version__} in {Path(sylpose.__file__).parent}\n")
    assert f"numpy {np.__version__}" in said
    assert re.search(r"(?m)^Compiled code there; what is compiled is kept in \S", said)
    assert re.search(r"(?m)^OpenCV        \d\.\d+\.\d+.*: opencv\S*", said)
    assert "works" in said.splitlines()[-1]


def test_for_programs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert set(said) == set(Diagnosis.__dataclass_fields__)
    assert said["problems"] == []
    assert said["versions"]["sylpose"] == sylpose.__version__
    # Every dependency was loaded, by its module's name.
    needed = {doctor._module_of(name_of(line)) for line in PROJECT["dependencies"]}
    assert needed <= set(said["versions"])
    for module in needed:
        assert said["versions"][module] != "?", module
    extras = set(PROJECT["optional-dependencies"])
    assert set(said["extras"]) == extras - doctor.NOT_FOR_USERS


def test_what_is_broken_is_said_without_it(tmp_path: Path) -> None:
    """NumPy, which nearly everything needs, and an OpenCV with windows where there are none."""
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


def test_versions_that_are_too_old_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [*PROJECT["dependencies"], "numpy>=99"]
    monkeypatch.setattr(doctor, "requires", lambda _: lines)
    (problem,) = diagnose().problems
    assert problem.startswith(f"numpy is {np.__version__}, sylpose needs numpy>=99: ")


def test_two_opencvs_at_once_are_a_warning_and_none_of_pips_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    def installed(*names: str) -> Diagnosis:
        monkeypatch.setattr(
            doctor, "distributions", lambda: [SimpleNamespace(metadata={"Name": name}) for name in names]
        )
        return diagnose()

    both = installed("opencv_python", "numpy", "opencv-contrib-python")
    (warning,) = both.warnings
    assert warning.startswith(
        "2 packages of OpenCV are installed into one folder, opencv-contrib-python and opencv-python:"
    )
    assert not both.problems
    none = installed("numpy")
    assert "of no package of pip's" in none.facts["OpenCV"]
    assert not none.warnings


def test_what_an_extra_lacks_is_said_with_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [*PROJECT["dependencies"], 'not-there>=1; extra == "archive"', 'numpy; extra == "archive"']
    monkeypatch.setattr(doctor, "requires", lambda _: lines)
    assert main(["doctor"]) == 0
    assert "archive: python -m pip install 'not-there>=1'\n" in capsys.readouterr().out


def test_a_folder_that_cannot_be_written_is_a_warning(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "folder"))
    (warning,) = diagnose().warnings
    assert warning.startswith(f"NUMBA_CACHE_DIR={tmp_path / 'file' / 'folder'} cannot be written")


def test_codecs_and_features_are_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    import av
    import cv2

    def broken() -> None:
        raise AttributeError("without it")

    monkeypatch.setattr(av, "codecs_available", {"mpeg4"})
    monkeypatch.setattr(cv2, "SIFT_create", broken)
    sift, decoding = diagnose().problems
    assert sift == "SIFT features cannot be found by cv2 (AttributeError: without it)"
    assert decoding.startswith("videos cannot be decoded by av ")
