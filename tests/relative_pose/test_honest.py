"""OK must mean OK: the kinds of `benchmarks/honesty.py`, some scenes of each, with what is right beside what is wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from benchmarks.honesty import outcomes, solve
from benchmarks.honesty_kinds import make_problem
from sylpose.matches import Matches
from sylpose.relative_pose.motion import estimate_motion
from sylpose.results import Status


def told(kind: str, scenes: int, wrong: int = 0) -> Sequence[Status]:
    """What is said of scenes of a kind, of which no more are wrong and sure."""
    found = outcomes(kind, range(5000, 5000 + scenes))
    assert sum(o.wrong for o in found) <= wrong, kind
    return [o.status for o in found]


def share_ok(statuses: Sequence[Status]) -> float:
    return statuses.count(Status.OK) / len(statuses)


@pytest.mark.parametrize("kind", ["solid", "sphere", "solid, wrong 30 to 50 %", "copies", "pose"])
def test_where_all_is_as_usual_it_is_ok(kind: str) -> None:
    assert share_ok(told(kind, 30)) >= 0.97


@pytest.mark.parametrize("kind", ["copies, few", "copies, wrong 30 to 60 %", "pose, copies"])
def test_a_match_that_is_given_again_is_no_other_match(kind: str) -> None:
    assert share_ok(told(kind, 30, wrong=kind == "copies, wrong 30 to 60 %")) >= 0.6


def test_copies_change_nothing_but_the_masks() -> None:
    problem = make_problem("solid, wrong 30 to 50 %", 0)
    rng = np.random.default_rng(0)
    picks = [np.concatenate([np.arange(len(m)), rng.integers(0, len(m), 200)]) for m in problem.matches]
    again = estimate_motion(problem.rig, [Matches(m.x[k], m.y[k]) for m, k in zip(problem.matches, picks, strict=True)])
    once = solve(problem)
    np.testing.assert_array_equal(again.information, once.information)
    np.testing.assert_array_equal(again.residuals, once.residuals)
    for mask, all_, k in zip(once.inliers, again.inliers, picks, strict=True):
        np.testing.assert_array_equal(mask[k], all_)
    # Eight matches, four of them the same, are five.
    few = [Matches(m.x[[0, 1, 1, 1]], m.y[[0, 1, 1, 1]]) for m in problem.matches[:2]]
    found = estimate_motion(problem.rig, [*few, *[Matches.none()] * (len(problem.rig) - 2)])
    assert found.status is Status.TOO_FEW_MATCHES


def test_of_two_cameras_that_contradict_each_other_none_is_believed() -> None:
    """Of three one may be; and one whose matches are all wrong says nothing against the other."""
    assert share_ok(told("pose, turned by 5 to 45, two cameras", 30, wrong=1)) <= 0.2
    assert share_ok(told("pose, turned by 1 to 45", 20)) >= 0.95
    assert share_ok(told("pose, junk", 20, wrong=1)) >= 0.95
    assert share_ok(told("pose, wrong 30 to 60 %", 20)) >= 0.95


def test_four_matches_that_happen_to_agree_are_not_believed_to_be_exact() -> None:
    assert share_ok(told("pose, few", 100, wrong=1)) >= 0.8


def test_noise_beyond_all_that_is_usual_is_measured_or_said_to_be_no_motion() -> None:
    """Held down to what the seeds allow, it chose matches of no motion, and was sure of it."""
    assert share_ok(told("noise x 3", 20, wrong=1)) >= 0.6
    assert share_ok(told("noise x 10", 30)) >= 0.3
    statuses = told("noise x 10, wrong 30 to 60 %", 30, wrong=1)
    assert statuses.count(Status.NOT_CONSISTENT) >= 10
    assert Status.OK not in told("all wrong", 20)


def test_two_cameras_on_opposite_sides_do_not_know_how_far_away_the_object_is() -> None:
    assert share_ok(told("two opposite", 30, wrong=1)) >= 0.5
    told("two opposite, wrong 30 to 60 %", 30, wrong=1)
