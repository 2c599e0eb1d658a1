"""Rays from the cameras to the object intersect, except those of a wrongly calibrated camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from benchmarks.robust_pairs import rotate_calibration, simulate_four_cameras
from sylpose.relative_pose.leave_one_out import (
    compute_ray_miss,
    is_other_camera_misaligned,
    solve_without_faulty_cameras,
)
from sylpose.relative_pose.motion import estimate_motion
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.terms import Solution, TermData, locate_object, make_failed_fit
from sylpose.status import Status
from tests.scenes import make_terms

SCENES = 30


def test_rays_meet_in_any_length_unit() -> None:
    for seed in range(SCENES):
        rig, pair = simulate_four_cameras(seed)
        data = make_terms(rig, pair.matches)
        assert 0.0 < compute_ray_miss(data) < 0.5
        larger = [TermData(t.camera, t.x, t.y, t.rotation, 1e3 * t.center, t.focal) for t in data]
        assert compute_ray_miss(larger) == pytest.approx(compute_ray_miss(data))
        # Rays through one point have zero distance to it.
        one = [
            TermData(t.camera, 0.1 * t.x - np.median(0.1 * t.x, axis=0), t.y, t.rotation, -t.rotation[2], 1.0)
            for t in data
        ]
        assert compute_ray_miss(one) == pytest.approx(0.0, abs=1e-9)


def test_good_cameras_are_exonerated() -> None:
    right = 0
    for seed in range(SCENES):
        rig, pair = simulate_four_cameras(seed)
        data = make_terms(rig, pair.matches)
        assert not any(is_other_camera_misaligned(data, term) for term in data)
        faulty_rig, bad = rotate_calibration(rig, 20.0, seed)
        data = make_terms(faulty_rig, pair.matches)
        exonerated = [is_other_camera_misaligned(data, term) for term in data]
        k = faulty_rig.names.index(bad)
        assert not exonerated[k]
        right += all(s for c, s in enumerate(exonerated) if c != k)
    assert right >= 0.8 * SCENES


@pytest.mark.parametrize("degrees", [10.0, 20.0])
def test_good_camera_is_not_named_for_a_faulty_one(degrees: float) -> None:
    """Regression: this was one of sixty scenes in which it was."""
    rig, pair = simulate_four_cameras(56)
    faulty_rig, bad = rotate_calibration(rig, degrees, 56)
    found = estimate_motion(faulty_rig, pair.matches)
    assert all(text.startswith(f"camera {bad}: ") for text in found.faults)


def test_single_subset_with_a_pose_is_checked() -> None:
    """Of four cameras, only leaving out the first gives a pose."""
    rig, pair = simulate_four_cameras(2)
    data = make_terms(rig, pair.matches)

    def solve(terms: Sequence[TermData], start: Solution | None = None) -> Solution:
        cameras, place = [term.camera for term in terms], locate_object(terms)
        if len(cameras) > 1 and cameras != [1, 2, 3]:
            return Solution(make_failed_fit(terms, Status.NOT_CONVERGED), *place)
        guesses = [] if start is None else [(start.fit.rotation, start.fit.translation)]
        return Solution(fit_terms(terms, *place, guesses, np.random.default_rng(0)), *place)

    found = solve_without_faulty_cameras(data, solve(data), rig.names, solve)
    assert found.fit.status.has_pose
    assert not found.fit.faults or found.fit.faults[0].startswith(f"camera {rig.names[0]}")
