"""The benchmarks of the paper's estimators run, and measure what they say."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from benchmarks import consensus as consensus_benchmark
from benchmarks import depth_plane as depth_plane_benchmark
from benchmarks import equations, paper_times, sensors
from sylpose.simulate import ellipsoid
from tests.paths import REPOSITORY

FOLDER = REPOSITORY / "benchmarks"


def test_sensors_as_a_user_types_it() -> None:
    done = subprocess.run(
        [sys.executable, str(FOLDER / "sensors.py"), "--scenes", "1", "--rigs", "4", "--turns", "10"],
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    rows = [line.split("|") for line in done.stdout.splitlines() if line.startswith("| 4 ")]
    assert {row[3].strip() for row in rows} >= {"junk", "frozen", "turned 90", "mirrored"}


def test_motions_with_a_wrong_calibration(capsys: pytest.CaptureFixture[str]) -> None:
    sensors.motion_tables(1)
    said = capsys.readouterr().out.splitlines()
    assert any(line.startswith("| 0 |") and line.endswith("| 0 of 1 | 0 of 1 |") for line in said)
    assert any(line.startswith("| 45 |") and "| 1 of 1 |" in line for line in said)
    assert sum(line.endswith(" of 6 |") for line in said) == 9


def test_times_are_of_the_problem_they_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(paper_times, "PROBLEMS", 3)
    monkeypatch.setattr(paper_times, "COUNTS", (4, 100))
    paper_times.many_problems(1)
    said = capsys.readouterr().out
    assert "4 around" in said
    assert len(paper_times.moments_of(paper_times.around(4), 0)) == 4


def test_singular_equations_of_the_benchmark_are_singular(capsys: pytest.CaptureFixture[str]) -> None:
    equations.singular(np.random.default_rng(0), 2)
    rows = [line for line in capsys.readouterr().out.splitlines() if " of 2" in line]
    assert len(rows) == len(equations.forms())
    for row in rows:
        assert ("0 of 2 | 0 of 2" in row) == ("regular" in row)


def test_depth_plane_rows() -> None:
    rig = depth_plane_benchmark.around(4)
    problems = [depth_plane_benchmark.synthetic(seed, rig, ellipsoid((0.15, 0.12, 0.1)), 5.0) for seed in range(2)]
    cells = [cell.strip() for cell in depth_plane_benchmark.row("ellipsoid", problems).strip("| \n").split("|")]
    assert cells[0] == "ellipsoid"
    assert float(cells[2]) < float(cells[1])  # the depth plane against depth ignored


def test_rounds_are_counted_to_the_tolerance() -> None:
    problem = next(iter(consensus_benchmark.problems(consensus_benchmark.tilted(4), 1)))
    loose, tight = (consensus_benchmark.rounds_to(problem, tolerance) for tolerance in (1e-3, 1e-8))
    assert 0 < loose < tight < 100
