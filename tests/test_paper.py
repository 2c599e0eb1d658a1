"""The paper's estimators as methods: whose answer they give, and which cameras at fault are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import BODY, around, degrees, error
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.choices import METHODS, MOTION_METHODS, PAPER_METHODS
from sylpose.depth_plane import solve_depth_plane
from sylpose.features import Matches
from sylpose.fit import Fit
from sylpose.moments import PairMoments
from sylpose.motion import estimate_motion
from sylpose.paper import ESTIMATORS, paper_fit
from sylpose.results import Motion, Status
from sylpose.rig import Camera, Rig
from sylpose.simulate import SimulatedPair, random_motion, simulate_matches
from sylpose.terms import TermData


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
    rig = around(6)
    pair = scene(rig, 1)
    found = estimate_motion(rig, pair.matches, method=method)
    assert found.method == method
    assert found.faults == ()
    assert found.motion is not None
    bound = {"depth-plane": 0.6, "one-camera": 12.0, "unconstrained": 12.0}.get(method, 3.0)
    assert degrees(error(pair, found)) < bound


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


def with_camera(rig: Rig, index: int, camera: Camera) -> Rig:
    return Rig([camera if k == index else c for k, c in enumerate(rig)], rig.unit)


@pytest.mark.parametrize("method", ["epipolar", "sylvester", "depth-plane"])
@pytest.mark.parametrize("kind", ["junk", "frozen", "calibration"])
def test_a_camera_at_fault_is_named_and_does_little_harm(method: str, kind: str) -> None:
    rig = around(8)
    pair = scene(rig, 4, junk=("cam_3",) if kind == "junk" else ())
    matches, told = list(pair.matches), rig
    if kind == "frozen":
        noise = 3e-4 * np.random.default_rng(0).standard_normal(matches[3].x.shape)
        matches[3] = Matches(matches[3].x, matches[3].x + noise)
    if kind == "calibration":
        wrong = RigidTransform.from_rotation(Rotation.from_rotvec([0, 0, 2.5])) * rig["cam_3"].camera_from_world
        told = with_camera(rig, 3, replace(rig["cam_3"], camera_from_world=wrong))
    found = estimate_motion(told, matches, method=method)
    assert len(found.faults) == 1
    assert "cam_3" in found.faults[0]
    assert {"junk": "junk", "frozen": "frozen", "calibration": "calibration"}[kind] in found.faults[0]
    others = [c for c in range(8) if c != 3]
    by_hand = estimate_motion(
        rig.subset([rig.names[c] for c in others]), [pair.matches[c] for c in others], method=method
    )
    assert degrees(error(pair, found)) < 2 * degrees(error(pair, by_hand)) + 0.05


def test_clean_rigs_have_no_faults() -> None:
    for seed in range(5):
        rig = around(4)
        for method in ("epipolar", "sylvester"):
            assert estimate_motion(rig, scene(rig, seed, outliers=0.3).matches, method=method).faults == ()


def test_matches_without_spread_leave_the_turn_open() -> None:
    rig = around(2)
    point = np.tile([[0.01, 0.02]], (9, 1))
    data = [TermData(c, point, point, camera.rotation, camera.center, camera.focal) for c, camera in enumerate(rig)]
    weights = (np.ones(9), np.ones(9))
    robust = Fit(Status.OK, np.eye(3), np.zeros(3), weights, weights, np.eye(6), np.eye(6), 1)
    for method in PAPER_METHODS:
        fit = paper_fit(method, data, robust, np.zeros(3), rig.names)
        assert fit.status is Status.TURN_NOT_OBSERVABLE
