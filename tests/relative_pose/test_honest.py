"""Reliability of the status OK: some scenes of each kind of `benchmarks/honesty.py`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from benchmarks.honesty import evaluate_scenes, solve
from benchmarks.honesty_kinds import make_problem
from sylpose.matches import Matches
from sylpose.relative_pose.motion import estimate_motion
from sylpose.status import Status


def get_statuses(kind: str, scenes: int, wrong: int = 0) -> Sequence[Status]:
    """Return the statuses of scenes of a kind; at most `wrong` of them are wrong with a small covariance."""
    found = evaluate_scenes(kind, range(5000, 5000 + scenes))
    assert sum(o.wrong for o in found) <= wrong, kind
    return [o.status for o in found]


def compute_ok_share(statuses: Sequence[Status]) -> float:
    return statuses.count(Status.OK) / len(statuses)


@pytest.mark.parametrize("kind", ["solid", "sphere", "solid, wrong 30 to 50 %", "copies", "pose"])
def test_usual_scenes_are_ok(kind: str) -> None:
    assert compute_ok_share(get_statuses(kind, 20)) >= 0.97


@pytest.mark.parametrize(
    ("kind", "seed", "cause"),
    [
        ("y upwards", 9023, "they agree if pixels are counted upwards"),
        ("x to the left", 9005, "they agree if pixels are counted to the left, or the images are mirrored"),
        ("row, column", 9019, "they agree if pixels are given as row and column"),
        ("x to the left", 8032, "begin with cam_0: the others agree"),
    ],
)
def test_two_cameras_that_agree_are_no_proof(kind: str, seed: int, cause: str) -> None:
    """Of three with pixels along other axes two agree by chance, on a wrong motion."""
    _check_contradiction(kind, seed, cause)


@pytest.mark.parametrize(
    ("kind", "seed", "axes"),
    [
        ("y upwards", 8022, "counted upwards"),
        ("x to the left", 8006, "to the left, or the images are mirrored"),
        ("row, column", 8007, "row and column"),
    ],
)
def test_other_axes_of_pixels_are_named(kind: str, seed: int, axes: str) -> None:
    """Three of four cameras agree by chance, on a wrong motion."""
    _check_contradiction(kind, seed, axes)


def _check_contradiction(kind: str, seed: int, cause: str) -> None:
    result = solve(make_problem(kind, seed))
    assert result.status is Status.NOT_CONSISTENT
    assert result.motion is None
    assert cause in result.faults[0]


@pytest.mark.parametrize("kind", ["copies, few", "copies, wrong 30 to 60 %", "pose, copies"])
def test_duplicate_matches_are_no_new_evidence(kind: str) -> None:
    assert compute_ok_share(get_statuses(kind, 20, wrong=kind == "copies, wrong 30 to 60 %")) >= 0.6


def test_duplicates_change_only_the_masks() -> None:
    problem = make_problem("solid, wrong 30 to 50 %", 0)
    rng = np.random.default_rng(0)
    picks = [np.concatenate([np.arange(len(m)), rng.integers(0, len(m), 200)]) for m in problem.matches]
    again = estimate_motion(problem.rig, [Matches(m.x[k], m.y[k]) for m, k in zip(problem.matches, picks, strict=True)])
    once = solve(problem)
    np.testing.assert_array_equal(again.information, once.information)
    np.testing.assert_array_equal(again.residuals, once.residuals)
    for mask, all_, k in zip(once.inliers, again.inliers, picks, strict=True):
        np.testing.assert_array_equal(mask[k], all_)
    # Eight matches, of which four are duplicates, count as five.
    few = [Matches(m.x[[0, 1, 1, 1]], m.y[[0, 1, 1, 1]]) for m in problem.matches[:2]]
    found = estimate_motion(problem.rig, [*few, *[Matches.empty()] * (len(problem.rig) - 2)])
    assert found.status is Status.TOO_FEW_MATCHES


def test_two_contradictory_cameras_are_not_ok() -> None:
    """One of three cameras may contradict, and a camera with mismatches only is no evidence against the other."""
    assert compute_ok_share(get_statuses("pose, turned by 5 to 45, two cameras", 20, wrong=1)) <= 0.2
    assert compute_ok_share(get_statuses("pose, turned by 1 to 45", 20)) >= 0.95
    assert compute_ok_share(get_statuses("pose, junk", 20, wrong=1)) >= 0.95
    assert compute_ok_share(get_statuses("pose, wrong 30 to 60 %", 20)) >= 0.95


def test_four_accidental_matches_are_not_taken_as_exact() -> None:
    assert compute_ok_share(get_statuses("pose, few", 60, wrong=1)) >= 0.8


@pytest.mark.slow
def test_extreme_noise_is_estimated_or_inconsistent() -> None:
    """Regression: with the noise bounded by that of the seeds, the fit selected matches of no motion with a small
    covariance."""
    assert compute_ok_share(get_statuses("noise x 3", 20, wrong=1)) >= 0.6
    assert compute_ok_share(get_statuses("noise x 10", 30)) >= 0.3
    statuses = get_statuses("noise x 10, wrong 30 to 60 %", 20, wrong=1)
    assert statuses.count(Status.NOT_CONSISTENT) >= 7
    assert Status.OK not in get_statuses("all wrong", 20)


def test_opposite_cameras_are_not_overconfident() -> None:
    assert compute_ok_share(get_statuses("two opposite", 20, wrong=1)) >= 0.5
    get_statuses("two opposite, wrong 30 to 60 %", 20, wrong=1)
