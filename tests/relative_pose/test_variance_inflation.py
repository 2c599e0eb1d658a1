"""The covariance of a motion is inflated where the errors of neighboring matches, or of a camera, are alike."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.honesty import compare_with_truth
from benchmarks.honesty_kinds import Problem, make_problem
from sylpose import Matches, Rig, Status, estimate_motion


def measure_nees(kind: str, n: int) -> list[float]:
    outcomes = [
        compare_with_truth(p, estimate_motion(p.rig, p.matches)) for p in (make_problem(kind, s) for s in range(n))
    ]
    return [outcome.nees for outcome in outcomes if outcome.status is Status.OK]


@pytest.mark.parametrize(
    ("kind", "limits"),
    [("solid", (3.5, 7.5)), ("sphere", (3.5, 7.5)), ("near copies", (3.5, 7.5)), ("drift", (3.5, 35.0))],
)
def test_covariance_explains_errors_that_are_alike(kind: str, limits: tuple[float, float]) -> None:
    """Six on average with independent errors; 90 with smooth ones without an inflation."""
    squares = measure_nees(kind, 40)
    assert len(squares) > 25
    assert limits[0] < np.mean(np.fmin(squares, 200.0)) < limits[1]


def shuffle(problem: Problem, seed: int) -> Problem:
    rng = np.random.default_rng(seed)
    cameras = rng.permutation(len(problem.rig)).tolist()
    orders = [rng.permutation(len(m)) for m in problem.matches]
    matches = tuple(Matches(problem.matches[c].x[orders[c]], problem.matches[c].y[orders[c]]) for c in cameras)
    return problem._replace(rig=Rig([problem.rig.cameras[c] for c in cameras], problem.rig.unit), matches=matches)


def test_covariance_does_not_depend_on_order() -> None:
    for seed in range(4):
        problem = make_problem("drift", seed)
        here, there = (estimate_motion(p.rig, p.matches) for p in (problem, shuffle(problem, seed)))
        if here.status is Status.OK and there.status is Status.OK:
            ratio = np.trace(here.covariance) / np.trace(there.covariance)
            assert ratio == pytest.approx(1.0, abs=0.05)


def test_one_camera_that_disagrees_widens_the_covariance() -> None:
    """By as much as a small error of its calibration, which is no contradiction, moves the others' motion."""
    wider = []
    for seed in range(8):
        problem = make_problem("solid", seed)
        x, y = problem.matches[0].x, problem.matches[0].y
        turned = (Matches(x, np.add(y, (0.0, 0.0015))), *problem.matches[1:])
        right, wrong = (estimate_motion(problem.rig, matches) for matches in (problem.matches, turned))
        if right.status is Status.OK and wrong.status is Status.OK:
            wider.append(np.trace(wrong.covariance) / np.trace(right.covariance))
    assert len(wider) > 4
    assert np.median(wider) > 1.5
