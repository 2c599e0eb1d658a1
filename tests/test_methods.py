"""Table of the methods: it agrees with the code, docs/choosing.md and `--help`."""

from __future__ import annotations

import inspect
from importlib import import_module
from pathlib import Path

import pytest

import sylpose
from sylpose.commands.main import main
from sylpose.methods import (
    FEATURES,
    METHODS,
    MOTION_METHODS,
    PAPER_METHODS,
    TABLE,
    Method,
    format_methods_table,
    resolve_features,
)
from sylpose.relative_pose.sylvester_methods import ESTIMATORS
from sylpose.runs.options import RunOptions
from sylpose.status import FrameStatus
from sylpose.tracking.frame_solvers import SOLVERS
from sylpose.tracking.tracker import Tracker, TrackerArguments, TrackerBase
from tests.conftest import FRAMES
from tests.paths import REPOSITORY


def test_code_has_the_methods_of_the_table() -> None:
    assert len(set(METHODS)) == len(TABLE)
    assert tuple(SOLVERS) == METHODS
    assert tuple(ESTIMATORS) == PAPER_METHODS
    assert set(PAPER_METHODS) < set(MOTION_METHODS) < set(METHODS)
    for function in (sylpose.track, TrackerBase, RunOptions):
        defaults = {name: p.default for name, p in inspect.signature(function).parameters.items()}
        assert (defaults["method"], defaults["features"]) == (METHODS[0], FEATURES[0])
    keywords = [name for name, p in inspect.signature(TrackerBase).parameters.items() if p.kind is p.KEYWORD_ONLY]
    assert keywords == list(TrackerArguments.__annotations__)  # `Tracker` passes them on
    assert inspect.signature(sylpose.estimate_motion).parameters["method"].default == MOTION_METHODS[0]


@pytest.mark.parametrize("method", TABLE, ids=METHODS)
def test_function_exists(method: Method) -> None:
    module, _, name = method.function.rpartition(".")
    loaded = import_module(f"sylpose.{module}")
    assert getattr(loaded, name).__module__ == loaded.__name__


def test_documentation_has_the_table() -> None:
    text = (REPOSITORY / "docs" / "choosing.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:3] == "| `"]
    message = [[cell.replace(" (default)", "").strip("`") for cell in row[:4]] for row in rows if len(row) == 5][1:]
    assert message == [[m.name, m.inputs, m.output, ", ".join(m.features)] for m in TABLE]


def test_help_has_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["track", "--help"]) == 0
    printed = capsys.readouterr().out
    for line in format_methods_table().splitlines():
        assert len(line) < 78
        assert f"  {line}\n" in printed
    assert [line.split()[0] for line in format_methods_table().splitlines()[1:]] == list(METHODS)


@pytest.mark.parametrize("method", TABLE, ids=METHODS)
def test_unsupported_features_are_rejected(method: Method, recording: Path) -> None:
    session = sylpose.open_session(recording)
    assert resolve_features(method.name, "auto") == method.features[0]
    for features in ("sift", "klt"):
        if features in method.features:
            assert resolve_features(method.name, features) == features
        else:
            with pytest.raises(ValueError, match=f"features: '{features}' does not suit the method '{method.name}'"):
                Tracker(session.rig, method=method.name, features=features)
            with pytest.raises(ValueError, match=f"features: '{features}'"):
                sylpose.track_session(session, options=sylpose.RunOptions(method=method.name, features=features))
    assert not (recording / "sylpose").exists()


def test_invalid_choices_are_named() -> None:
    with pytest.raises(ValueError, match="method: 'magic' is not one of landmarks, epipolar"):
        resolve_features("magic", "auto")
    with pytest.raises(ValueError, match="features: 'surf' is not one of auto, sift, klt"):
        resolve_features("landmarks", "surf")


def test_command_line_rejects_in_one_line(capsys: pytest.CaptureFixture[str], recording: Path) -> None:
    assert main(["track", str(recording), "--method", "depth-plane", "--features", "klt"]) == 2
    text = capsys.readouterr()
    assert not text.out
    assert text.err.count("\n") == 1
    assert "depth-plane" in text.err


@pytest.mark.parametrize(("method", "features"), [(m.name, features) for m in TABLE for features in m.features[1:]])
def test_non_default_features(method: str, features: str, recording: Path) -> None:
    """The defaults: tests/tracking/test_tracker.py."""
    session = sylpose.open_session(recording)
    frames = sylpose.track(session.frames(), session.rig, session.boxes, method=method, features=features)
    assert [f.pose.status for f in frames] == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
