"""The paper's estimators as methods of `estimate_motion`: results and faulty cameras."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.methods import METHODS, MOTION_METHODS, PAPER_METHODS
from sylpose.moments import PairMoments
from sylpose.relative_pose.motion import estimate_motion
from sylpose.relative_pose.sylvester_methods import ESTIMATORS, apply_estimator
from sylpose.relative_pose.terms import Fit, TermData
from sylpose.results import Motion
from sylpose.rig import Rig
from sylpose.simulate import Body, SimulatedPair, box, random_motion, ring, simulate_matches
from sylpose.status import Status
from sylpose.sylvester.depth_plane import solve_depth_plane
from sylpose.sylvester.one_camera import solve_one_camera
from tests.scenes import BODY, compute_motion_error, compute_rotation_degrees, make_zigzag_rig


def make_scene(rig: Rig, seed: int, turn: float = 10.0, **options: object) -> SimulatedPair:
    rng = np.random.default_rng(seed)
    return simulate_matches(rig, BODY, random_motion(turn, 0.02, rng), rng=rng, **options)  # type: ignore[arg-type]


def compute_inlier_moments(pair: SimulatedPair, found: Motion) -> list[PairMoments]:
    return [PairMoments.from_matches(m.x[i], m.y[i]) for m, i in zip(pair.matches, found.inliers, strict=True)]


def test_method_names_match_the_command_line() -> None:
    assert tuple(ESTIMATORS) == PAPER_METHODS
    assert set(PAPER_METHODS) < set(MOTION_METHODS) < set(METHODS) | {"epipolar"}


@pytest.mark.parametrize("method", PAPER_METHODS)
def test_every_estimator_is_a_two_frame_method(method: str) -> None:
    """The error is a share of the rotation.

    It is smallest with a planar depth model.
    """
    rig, turn, errors = make_zigzag_rig(6), 20.0, []
    for seed in range(6):
        pair = make_scene(rig, seed, turn)
        found = estimate_motion(rig, pair.matches, method=method)
        assert found.method == method
        assert found.faults == ()
        assert found.motion is not None
        errors.append(compute_rotation_degrees(compute_motion_error(pair, found)) / turn)
    least, most = (0.001, 0.02) if method == "depth-plane" else (0.1, 0.3)
    assert least < np.median(errors) < most
    assert np.sort(errors)[-2] < 1.5 * most


@pytest.mark.parametrize("turn", [3.0, 12.0])
@pytest.mark.parametrize("body", [BODY, box()])
def test_covariance_includes_the_neglected_depth(body: Body, turn: float) -> None:
    """Over all six unknowns; with noise alone the mean normalized error was 17 to 300."""
    rig, nees = make_zigzag_rig(5), []
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


def test_coplanar_cameras_leave_the_rotation_unobservable() -> None:
    rig = ring(4)
    for seed in range(4):
        found = estimate_motion(rig, make_scene(rig, seed, 4.0).matches, method="sylvester")
        assert found.status is Status.ROTATION_NOT_OBSERVABLE


def test_a_single_camera_takes_the_mirrored_solution_nearer_to_the_robust_fit() -> None:
    rig = make_zigzag_rig(1)
    pair = make_scene(rig, 0, 20.0)
    found, robust = (estimate_motion(rig, pair.matches, method=method) for method in ("sylvester", "epipolar"))
    assert found.motion is not None
    assert robust.motion is not None
    (moments,) = compute_inlier_moments(pair, found)
    rotations = solve_one_camera(rig.cameras[0].rotation, moments).rotations
    away = [(Rotation.from_matrix(R).inv() * robust.motion.rotation).magnitude() for R in rotations]
    expected = Rotation.from_matrix(rotations[int(np.argmin(away))])
    assert (expected * found.motion.rotation.inv()).magnitude() < np.deg2rad(2.0)


def test_depth_plane_uses_the_inliers() -> None:
    rig = make_zigzag_rig(4)
    pair = make_scene(rig, 3, outliers=0.2)
    found = estimate_motion(rig, pair.matches, method="depth-plane")
    assert found.motion is not None
    rotations = np.array([camera.rotation for camera in rig])
    expected = solve_depth_plane(rotations, compute_inlier_moments(pair, found))
    # The fit weights the inliers; the moments here do not.
    assert (Rotation.from_matrix(expected.rotation) * found.motion.rotation.inv()).magnitude() < np.deg2rad(0.2)


def test_matches_without_spread_leave_the_rotation_open() -> None:
    rig = make_zigzag_rig(2)
    point = np.tile([[0.01, 0.02]], (9, 1))
    data = [TermData(c, point, point, camera.rotation, camera.center, camera.focal) for c, camera in enumerate(rig)]
    weights = (np.ones(9), np.ones(9))
    robust = Fit(Status.OK, np.eye(3), np.zeros(3), weights, weights, np.eye(6), np.eye(6), 1)
    for method in PAPER_METHODS:
        fit = apply_estimator(method, data, robust, np.zeros(3), rig.names)
        assert fit.status is Status.ROTATION_NOT_OBSERVABLE
