"""Cameras close together, whose rays hardly determine where the object is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.honesty import compare_with_truth, solve
from benchmarks.honesty_kinds import make_problem
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.matches import Matches
from sylpose.relative_pose.motion import estimate_motion
from sylpose.relative_pose.terms import locate_object
from sylpose.rig import Rig
from sylpose.simulate import SimulatedPair, arc, box, plane, random_motion, simulate_matches
from sylpose.status import Status
from tests.scenes import compute_motion_error, compute_nees, compute_rotation_degrees, make_terms

# Two cameras three degrees apart, at this distance from the object's center.
DISTANCE = 2.0


def simulate_parts(n_scenes: int) -> Iterator[tuple[Rig, SimulatedPair]]:
    """Simulate large objects of which the two cameras match different parts, so that their median rays mislead."""
    rig = arc(2, 3.0, DISTANCE, 700.0)
    for seed in range(n_scenes):
        rng = np.random.default_rng(seed)
        body = (plane((1.2, 0.9)), box((1.0, 0.8, 0.7)))[seed % 2]
        start = RigidTransform.from_rotation(Rotation.from_rotvec(rng.normal(0.0, 0.3, 3)))
        motion = random_motion(float(rng.uniform(2.0, 10.0)), 0.1, rng)
        pair = simulate_matches(rig, body, motion, rng=rng, per_camera=200, noise_px=0.3, start=start)
        direction, matches = rng.normal(size=2), []
        for m, side in zip(pair.matches, (1.0, -1.0), strict=True):
            position = side * m.x @ direction
            is_shown = position > np.quantile(position, 0.4)
            matches.append(Matches(m.x[is_shown], m.y[is_shown]))
        yield rig, replace(pair, matches=tuple(matches))


def test_object_is_where_the_depths_are() -> None:
    distances, wrong, wrong_lengths, unconverged = [], 0, 0, 0
    for rig, pair in simulate_parts(60):
        found = estimate_motion(rig, pair.matches)
        unconverged += found.status is Status.NOT_CONVERGED
        if found.status is not Status.OK:
            continue
        error = compute_motion_error(pair, found)
        is_turned = compute_rotation_degrees(error) > 3.0
        is_sure = compute_nees(error, found) > chi_squared_bound(6, 1e-6)
        wrong += is_turned and is_sure
        wrong_lengths += not is_turned and is_sure
        distances.append(float(np.linalg.norm(found.center - np.mean([camera.center for camera in rig], axis=0))))
    assert wrong == 0
    assert wrong_lengths <= 8  # the distance that the depths show is not that of the object
    # In the others, the length of the translation or the plane's motion is not observable.
    assert unconverged <= 2
    assert len(distances) >= 36
    assert np.quantile(distances, 0.1) > 0.5 * DISTANCE
    assert np.median(distances) == pytest.approx(DISTANCE, rel=0.2)


def test_radius_is_measured_at_a_known_center() -> None:
    for rig, pair in simulate_parts(4):
        for distance in (0.5 * DISTANCE, DISTANCE):
            center = np.array([0.0, 0.0, distance - DISTANCE])
            found, radius = locate_object(make_terms(rig, pair.matches), center)
            assert (found == center).all()
            spread = np.median([np.linalg.norm(m.x - np.median(m.x, axis=0), axis=1) for m in pair.matches])
            assert radius == pytest.approx(2.0 * spread * distance, rel=0.1)


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("few, two cameras", 9918),
        ("narrow", 30140),
        ("narrow", 40056),
        ("narrow, flat", 30133),
        ("narrow, wrong 30 to 60 %", 9925),
    ],
)
def test_relocated_motion_is_not_wrong_and_sure(kind: str, seed: int) -> None:
    """At the distance found, the fit converges nowhere along its weakest direction."""
    problem = make_problem(kind, seed)
    assert not compare_with_truth(problem, solve(problem)).wrong
