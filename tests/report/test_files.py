"""Trajectory tables: the columns of trajectory.csv, not rounded."""

from __future__ import annotations

import csv
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.report.files import build_columns, read_tum, save_trajectory, to_dataframe, write_trajectory
from sylpose.results import FramePose, Trajectory
from sylpose.runs.view import load_trajectory
from sylpose.status import FrameStatus, Observability


def trajectory() -> Trajectory:
    """Rotate by more than half a turn, so that a quaternion's sign changes; one frame has unbounded uncertainty."""
    rng, frames = np.random.default_rng(0), []
    for k in range(12):
        pose = RigidTransform.from_components(rng.normal(size=3), Rotation.from_rotvec([0.2, 0.7 * k, -0.1]))
        some = rng.normal(size=(6, 8))
        frames.append(
            FramePose(
                k,
                k / 30,
                FrameStatus.TRACKED,
                pose,
                1e-5 * some @ some.T,
                rng.integers(0, 99, 2),
                np.array([0.3, np.nan]) + rng.random(),
                matches=rng.integers(99, 200, 2),
                variance_inflation=np.array([1.25, np.inf]),
                f_ratio=1.5,
            )
        )
    frames[3] = replace(frames[3], covariance=np.diag([np.inf] * 6), observability=Observability.NO_SCALE)
    frames[5] = replace(
        frames[5],
        status=FrameStatus.LOST,
        world_from_object=None,
        reason="no object, no match",
        faults=("a, b", "c"),
        matches=np.empty(0, np.int64),
        variance_inflation=np.empty(0),
    )
    return Trajectory(frames, ["left", "right"], "m")


def test_columns_match_the_file(tmp_path: Path) -> None:
    found = build_columns(trajectory())
    _, path = write_trajectory(tmp_path, trajectory())
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(found) == list(rows[0])
    assert {len(column) for column in found.values()} == {len(rows)} == {12}
    for name, column in found.items():
        for value, row in zip(column, rows, strict=True):
            cell = row[name]
            if isinstance(value, str) or cell == "inf":
                assert str(value) == cell
            elif cell == "":
                # No value, or an unbounded standard deviation.
                assert math.isnan(value) or (math.isinf(value) and name.endswith(("_sd", "_sd_deg")))
            else:
                assert value == pytest.approx(
                    float(cell), rel=1e-3 if name.startswith(("variance_inflation", "f_ratio")) else 1e-5
                )


def test_empty_trajectory_has_columns() -> None:
    found = build_columns(Trajectory([], ["left"]))
    assert {"index", "tx", "inliers_left", "reason"} <= set(found)
    assert not any(found.values())


def test_dataframe() -> None:
    pandas = pytest.importorskip("pandas")
    found = to_dataframe(trajectory())
    assert isinstance(found, pandas.DataFrame)
    assert list(found.columns) == list(build_columns(trajectory()))
    assert found["time"].iloc[2] == trajectory()[2].time
    assert found.loc[found["status"] == "tracked", "tx"].notna().all()
    assert found["tx"].isna().sum() == 1
    np.testing.assert_array_equal(found[["tx", "ty", "tz"]].to_numpy(), trajectory().positions)


def test_missing_pandas_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ModuleNotFoundError, match=r"needs pandas: python3 -m pip install 'sylpose\[export\]'"):
        to_dataframe(trajectory())


def test_saved_trajectories_are_those_of_a_run(tmp_path: Path) -> None:
    path, folder = trajectory(), tmp_path / "recording" / "sylpose"
    tum, table = write_trajectory(folder, path)
    for name, expected in (("a.csv", table), ("b.TUM", tum)):
        save_trajectory(path, tmp_path / "new" / name)
        assert (tmp_path / "new" / name).read_bytes() == expected.read_bytes()
    assert len(read_tum(tmp_path / "new" / "b.TUM")[0]) == path.measured_mask.sum()
    for place in (tmp_path / "recording", folder, table, str(tmp_path / "new" / "a.csv")):
        loaded = load_trajectory(place)
        assert (loaded.unit, [pose.status for pose in loaded]) == (path.unit, [pose.status for pose in path])
    with pytest.raises(ValueError, match=r"must end in \.csv or \.tum; `sylpose export` writes other formats"):
        save_trajectory(path, tmp_path / "a.c3d")


def test_results_that_are_not_there_are_named(tmp_path: Path) -> None:
    for name in ("cup", "mug"):
        write_trajectory(tmp_path / "two" / "sylpose" / name, trajectory())
    (tmp_path / "two" / "sylpose" / "settings.toml").touch()
    (tmp_path / "none").mkdir()
    with pytest.raises(FileNotFoundError, match=r"several results; select one of .*cup, .*mug"):
        load_trajectory(tmp_path / "two")
    with pytest.raises(FileNotFoundError, match="none: no result in it; expected a recording that was tracked"):
        load_trajectory(tmp_path / "none")
    with pytest.raises(FileNotFoundError, match="gone: no such file or folder"):
        load_trajectory(tmp_path / "gone")
