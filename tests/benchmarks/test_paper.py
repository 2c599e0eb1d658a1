"""Benchmarks of the paper's estimators: they run and measure the stated quantities."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import consensus as consensus_benchmark
from benchmarks import depth_plane as depth_plane_benchmark
from benchmarks import equations, paper_times, sensors
from sylpose.simulate import ellipsoid


def test_sensors_command_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["sensors.py", "--scenes", "1", "--rigs", "4", "--turns", "10"])
    sensors.main()
    rows = [line.split("|") for line in capsys.readouterr().out.splitlines() if line.startswith("| 4 ")]
    assert {row[3].strip() for row in rows} >= {"junk", "frozen", "turned 90", "mirrored"}


@pytest.mark.slow
def test_motion_tables_name_the_miscalibrated_camera(capsys: pytest.CaptureFixture[str]) -> None:
    sensors.print_motion_tables(1)
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("| 0 |") and line.endswith("| 0 of 1 | 0 of 1 |") for line in lines)
    assert any(line.startswith("| 45 |") and "| 1 of 1 |" in line for line in lines)
    assert sum(line.endswith(" of 6 |") for line in lines) == 9


def test_many_problems_prints_a_row_per_rig(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(paper_times, "PROBLEMS", 3)
    monkeypatch.setattr(paper_times, "COUNTS", (4, 100))
    paper_times.time_many_problems(1)
    output = capsys.readouterr().out
    assert "4 on a ring" in output
    assert len(paper_times.simulate_moments(paper_times.make_ring_rig(4), 0)) == 4


def test_singular_equations_are_singular(capsys: pytest.CaptureFixture[str]) -> None:
    equations.print_singular(np.random.default_rng(0), 2)
    rows = [line for line in capsys.readouterr().out.splitlines() if " of 2" in line]
    assert len(rows) == len(equations.make_forms())
    for row in rows:
        assert ("0 of 2 | 0 of 2" in row) == ("regular" in row)


def test_depth_plane_rows() -> None:
    rig = depth_plane_benchmark.make_ring_rig(4)
    problems = [
        depth_plane_benchmark.simulate_problem(seed, rig, ellipsoid((0.15, 0.12, 0.1)), 5.0) for seed in range(2)
    ]
    cells = [cell.strip() for cell in depth_plane_benchmark.format_row("ellipsoid", problems).strip("| \n").split("|")]
    assert cells[0] == "ellipsoid"
    assert float(cells[2]) < float(cells[1])  # the depth plane against depth ignored


def test_rounds_depend_on_the_tolerance() -> None:
    problem = next(iter(consensus_benchmark.simulate_problems(consensus_benchmark.make_zigzag_ring(4), 1)))
    loose, tight = (consensus_benchmark.count_rounds(problem, tolerance) for tolerance in (1e-3, 1e-8))
    assert 0 < loose < tight < 100
