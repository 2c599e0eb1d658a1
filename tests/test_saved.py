"""The saved results have the present format, and are those of a new run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sylpose.io import calibration
from sylpose.io.object_files import OBJECT_FILE, load_object
from sylpose.report.files import read_trajectory, read_tum, write_trajectory
from sylpose.runs.run_metadata import USED_CALIBRATION
from tests.saved import BOX_RESULT, FILES, compute_result

RESULTS = pytest.mark.parametrize("result", FILES, ids=lambda result: result.name)


@RESULTS
def test_saved_results_have_the_present_format(result: Path, tmp_path: Path) -> None:
    """Written again, the files are the same but for the last digit of a number."""
    assert {file.name for file in result.iterdir()} == set(FILES[result])
    assert sum(file.stat().st_size for file in result.iterdir()) < 400_000
    saved = read_trajectory(result / "trajectory.csv")
    write_trajectory(tmp_path, saved)
    for name in ("trajectory.csv", "trajectory.tum"):
        old, new = ((folder / name).read_text().splitlines() for folder in (result, tmp_path))
        assert old[0] == new[0]
        assert len(old) == len(new)
        assert [line.count(",") for line in old] == [line.count(",") for line in new]


def test_saved_object_is_readable() -> None:
    known = load_object(BOX_RESULT / OBJECT_FILE)
    assert known.camera_names == calibration.load(BOX_RESULT / USED_CALIBRATION).names
    assert len(known.positions) > 300


@pytest.mark.slow
@RESULTS
def test_saved_results_are_those_of_a_new_run(result: Path, tmp_path: Path) -> None:
    """Up to the rounding of another processor."""
    new = compute_result(result, tmp_path / "take")
    saved, found = (read_trajectory(folder / "trajectory.csv") for folder in (result, new))
    assert [pose.status for pose in found] == [pose.status for pose in saved]
    for (_, a), (_, b) in [[read_tum(folder / "trajectory.tum") for folder in (result, new)]]:
        assert np.degrees((a.rotation * b.rotation.inv()).magnitude()).max() < 0.05
        assert np.linalg.norm(a.translation - b.translation, axis=1).max() < 0.0005
    if OBJECT_FILE in FILES[result]:
        one, other = (load_object(folder / OBJECT_FILE) for folder in (result, new))
        assert other.radius == pytest.approx(one.radius, rel=0.01)
        assert len(other.positions) == pytest.approx(len(one.positions), rel=0.1)
        assert len(other._keyframes) == pytest.approx(len(one._keyframes), abs=1)
