"""The rays through what cameras see of one object meet, but for one that is calibrated wrongly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from benchmarks.robust_pairs import of_four, turned
from sylpose.relative_pose.coverage import another_looks_elsewhere, missed
from sylpose.relative_pose.fit import Solved, no_fit
from sylpose.relative_pose.leave_one_out import without_faults
from sylpose.relative_pose.motion import estimate_motion
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.terms import TermData, object_place
from sylpose.results import Status
from tests.scenes import data_of

SCENES = 30


def test_they_meet_in_one_point_and_another_unit_changes_nothing() -> None:
    for seed in range(SCENES):
        rig, pair = of_four(seed)
        data = data_of(rig, pair.matches)
        assert 0.0 < missed(data) < 0.5
        larger = [TermData(t.camera, t.x, t.y, t.rotation, 1e3 * t.center, t.focal) for t in data]
        assert missed(larger) == pytest.approx(missed(data))
        # Rays through one point miss it by nothing.
        one = [
            TermData(t.camera, 0.1 * t.x - np.median(0.1 * t.x, axis=0), t.y, t.rotation, -t.rotation[2], 1.0)
            for t in data
        ]
        assert missed(one) == pytest.approx(0.0, abs=1e-9)


def test_it_speaks_for_those_that_are_not_at_fault() -> None:
    right = 0
    for seed in range(SCENES):
        rig, pair = of_four(seed)
        data = data_of(rig, pair.matches)
        assert not any(another_looks_elsewhere(data, term) for term in data)
        told, bad = turned(rig, 20.0, seed)
        data = data_of(told, pair.matches)
        spoken = [another_looks_elsewhere(data, term) for term in data]
        k = told.names.index(bad)
        assert not spoken[k]
        right += all(s for c, s in enumerate(spoken) if c != k)
    assert right >= 0.8 * SCENES


@pytest.mark.parametrize("degrees", [10.0, 20.0])
def test_a_good_camera_is_not_named_for_another(degrees: float) -> None:
    """One of sixty was."""
    rig, pair = of_four(56)
    told, bad = turned(rig, degrees, 56)
    found = estimate_motion(told, pair.matches)
    assert all(text.startswith(f"camera {bad}: ") for text in found.faults)


def test_where_no_part_but_one_has_a_pose_it_is_asked_all_the_same() -> None:
    """Of four cameras, in which leaving out but one leads to a pose."""
    rig, pair = of_four(2)
    data = data_of(rig, pair.matches)

    def solve(terms: Sequence[TermData], near: Solved | None = None) -> Solved:
        cameras, place = [term.camera for term in terms], object_place(terms)
        if len(cameras) > 1 and cameras != [1, 2, 3]:
            return Solved(no_fit(terms, Status.NOT_CONVERGED), *place)
        guesses = [] if near is None else [(near.fit.rotation, near.fit.shift)]
        return Solved(fit_terms(terms, *place, guesses, np.random.default_rng(0)), *place)

    found = without_faults(data, solve(data), rig.names, solve)
    assert found.fit.status.has_pose
    assert not found.fit.faults or found.fit.faults[0].startswith(f"camera {rig.names[0]}")
