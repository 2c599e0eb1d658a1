"""The paper's estimators as methods: whose answer they give, and which cameras at fault are named."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.methods import METHODS, MOTION_METHODS, PAPER_METHODS
from sylpose.moments import PairMoments
from sylpose.relative_pose.fit import Fit
from sylpose.relative_pose.motion import estimate_motion
from sylpose.relative_pose.sylvester_methods import ESTIMATORS, paper_fit
from sylpose.relative_pose.terms import TermData
from sylpose.results import Motion, Status
from sylpose.rig import Rig
from sylpose.simulate import Body, SimulatedPair, box, random_motion, ring, simulate_matches
from sylpose.sylvester.depth_plane import solve_depth_plane
from tests.scenes import BODY, around, degrees, error


def scene(rig: Rig, seed: int, turn: float = 10.0, **options: object) -> SimulatedPair:
    rng = np.random.default_rng(seed)
    return simulate_matches(rig, BODY, random_motion(turn, 0.02, rng), rng=rng, **options)  # type: ignore[arg-type]


def inlier_moments(pair: SimulatedPair, found: Motion) -> list[PairMoments]:
    return [PairMoments.from_matches(m.x[i], m.y[i]) for m, i in zip(pair.matches, found.inliers, strict=True)]


def test_names_are_those_of_the_command_line() -> None:
    assert tuple(ESTIMATORS) == PAPER_METHODS
    assert set(PAPER_METHODS) < set(MOTION_METHODS) < set(METHODS) | {"epipolar"}


@pytest.mark.parametrize("method", PAPER_METHODS)
def test_every_estimator_is_a_method_of_two_frames(method: str) -> None:
    """Its error is a share of the turn, where no answer would be all of it: least with a plane for the depth; of one camera,
    which hardly sees turns out of its image, still less than no answer in most scenes."""
    rig, turn, errors = around(6), 20.0, []
    for seed in range(6):
        pair = scene(rig, seed, turn)
        found = estimate_motion(rig, pair.matches, method=method)
        assert found.method == method
        assert found.faults == ()
        assert found.motion is not None
        errors.append(degrees(error(pair, found)) / turn)
    least, most = {"depth-plane": (0.001, 0.02), "one-camera": (0.2, 0.7), "unconstrained": (0.2, 0.7)}.get(
        method, (0.1, 0.3)
    )
    assert least < np.median(errors) < most
    # The one camera that is asked may see nothing of the turn, and then says so.
    assert np.sort(errors)[-2] < (0.9 if most == 0.7 else 1.5 * most)


@pytest.mark.parametrize("turn", [3.0, 12.0])
@pytest.mark.parametrize("body", [BODY, box()])
def test_the_errors_of_those_that_ignore_depth_are_what_they_say(body: Body, turn: float) -> None:
    """Of all six unknowns; with noise alone counted the mean was 17 to 300."""
    rig, nees = around(5), []
    for seed in range(15):
        rng = np.random.default_rng(seed)
        start = RigidTransform.from_rotation(Rotation.random(rng=rng))
        pair = simulate_matches(rig, body, random_motion(turn, 0.02, rng), rng=rng, start=start)
        found = estimate_motion(rig, pair.matches, method="sylvester")
        assert found.status in (Status.OK, Status.SCALE_NOT_OBSERVABLE)
        assert found.motion is not None
        w = (found.motion.rotation * pair.motion.rotation.inv()).as_rotvec()
        off = np.concatenate([w, found.motion.apply(found.center) - pair.motion.apply(found.center)])
        nees.append(off @ found.information @ off)
    assert 1.0 < np.mean(nees) < 7.0
    assert max(nees) < 25.0


@pytest.mark.parametrize("method", [m for m in PAPER_METHODS if m != "depth-plane"])
def test_of_cameras_in_one_plane_those_that_ignore_depth_say_that_the_turn_is_not_seen(method: str) -> None:
    rig = ring(4)
    for seed in range(4):
        assert estimate_motion(rig, scene(rig, seed, 4.0).matches, method=method).status is Status.TURN_NOT_OBSERVABLE


def test_distributed_methods_are_the_centralised_one() -> None:
    rig = around(5)
    pair = scene(rig, 2)
    expected = estimate_motion(rig, pair.matches, method="sylvester").motion
    assert expected is not None
    for method in ("exchange", "refine", "gossip"):
        found = estimate_motion(rig, pair.matches, method=method).motion
        assert found is not None
        np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-7)


def test_the_depth_plane_is_asked_with_the_inliers() -> None:
    rig = around(4)
    pair = scene(rig, 3, outliers=0.2)
    found = estimate_motion(rig, pair.matches, method="depth-plane")
    assert found.motion is not None
    rotations = np.array([camera.rotation for camera in rig])
    expected = solve_depth_plane(rotations, inlier_moments(pair, found))
    # The inliers have robust weights, which the moments here do not.
    assert (Rotation.from_matrix(expected.rotation) * found.motion.rotation.inv()).magnitude() < np.deg2rad(0.2)


def test_matches_without_spread_leave_the_turn_open() -> None:
    rig = around(2)
    point = np.tile([[0.01, 0.02]], (9, 1))
    data = [TermData(c, point, point, camera.rotation, camera.center, camera.focal) for c, camera in enumerate(rig)]
    weights = (np.ones(9), np.ones(9))
    robust = Fit(Status.OK, np.eye(3), np.zeros(3), weights, weights, np.eye(6), np.eye(6), 1)
    for method in PAPER_METHODS:
        fit = paper_fit(method, data, robust, np.zeros(3), rig.names)
        assert fit.status is Status.TURN_NOT_OBSERVABLE
