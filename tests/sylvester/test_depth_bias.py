"""Depth bias: covariance of rotations estimated with depth ignored (Monte Carlo), and unobservable directions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.rig import Rig
from sylpose.simulate import Body, arc, box, dome, ellipsoid, plane, random_motion, ring, simulate_matches
from sylpose.status import Status
from sylpose.sylvester import depth_bias
from sylpose.sylvester.centralized import CentralizedSolution, solve_centralized
from sylpose.sylvester.one_camera import solve_one_camera
from sylpose.sylvester.orthographic import compute_views
from tests.scenes import make_zigzag_rig


class EvaluatedSolution(NamedTuple):
    """Solution with its error in degrees, and the squared error in units of its covariance and of noise alone."""

    solution: CentralizedSolution
    degrees: float
    nees: float
    by_noise: float


def evaluate_solution(solution: CentralizedSolution, truth: FloatArray) -> EvaluatedSolution:
    w = Rotation.from_matrix(truth @ solution.rotation.T).as_rotvec()
    of_noise = w @ solution.noise_information @ w
    return EvaluatedSolution(
        solution, float(np.degrees(np.linalg.norm(w))), float(w @ solution.information @ w), float(of_noise)
    )


def simulate_model(seed: int, lean: float, turn_deg: float = 8.0, n: int = 8) -> EvaluatedSolution:
    """Simulate the model: orthographic cameras with random surface slopes, partly due to the body's shape."""
    rng = np.random.default_rng(seed)
    cameras, moments = np.asarray(Rotation.random(n, rng=rng).as_matrix()), []
    truth = random_motion(turn_deg, 0.0, rng).rotation.as_matrix()
    shape = rng.standard_normal((3, 3))
    for q in cameras:
        x = 0.05 * rng.standard_normal((60, 2))
        common = -q[:2] @ (shape + shape.T) @ q[2] / 2
        slopes = lean * (depth_bias.CAMERA_SHARE * rng.standard_normal(2) + depth_bias.BODY_SHARE * common)
        points = np.column_stack([x, x @ slopes + 0.01 * rng.standard_normal(60)])
        y = np.exp(depth_bias.LOG_SCALE * rng.standard_normal()) * (points @ (q @ truth @ q.T).T)[:, :2]
        moments.append(PairMoments.from_matches(*(p + 3e-4 * rng.standard_normal(p.shape) for p in (x, y))))
    return evaluate_solution(solve_centralized(cameras, moments, aim=False), truth)


def simulate_body(rig: Rig, body: Body, turn_deg: float, seeds: range) -> Iterator[EvaluatedSolution]:
    """Simulate a randomly oriented body that rotates about a random axis, in perspective with noise."""
    rotations = np.array([camera.rotation for camera in rig])
    for seed in seeds:
        rng = np.random.default_rng(seed)
        motion, start = random_motion(turn_deg, 0.02, rng), RigidTransform.from_rotation(Rotation.random(rng=rng))
        matches = simulate_matches(rig, body, motion, rng=rng, start=start).matches
        moments = [PairMoments.from_matches(m.x, m.y) for m in matches]
        yield evaluate_solution(solve_centralized(rotations, moments), motion.rotation.as_matrix())


@pytest.mark.parametrize("lean", [0.25, 0.5, 1.0])
def test_errors_match_the_covariance_for_assumed_slopes(lean: float) -> None:
    """The expected mean is 3, the median 2.4; for slopes of 1 the bias is not linear.

    The noise-only covariance would be tens to hundreds of times too small.
    """
    found = [simulate_model(seed, lean) for seed in range(150)]
    assert 1.4 < np.median([f.nees for f in found]) < 3.0
    assert 2.0 < np.mean([f.nees for f in found]) < 6.0
    assert np.mean([f.by_noise for f in found]) > 15.0


def test_covariance_for_uncorrelated_depth() -> None:
    """The paper's model: the estimated slopes are zero."""
    found = [simulate_model(seed, 0.0) for seed in range(150)]
    assert 0.3 < np.mean([f.nees for f in found]) < 3.5
    ratios = [np.trace(f.solution.covariance) / np.trace(np.linalg.inv(f.solution.noise_information)) for f in found]
    assert np.median(ratios) < 4.0
    assert {f.solution.status for f in found} == {Status.OK}


BODIES = {"ellipsoid": ellipsoid((0.15, 0.12, 0.1)), "box": box(), "board": plane()}
QUICK = (("ellipsoid", 1.0), ("box", 5.0), ("board", 20.0))


@pytest.mark.parametrize(
    ("body", "turn"),
    [
        pytest.param(body, turn, marks=() if (body, turn) in QUICK else pytest.mark.slow)
        for body in BODIES
        for turn in (1.0, 5.0, 20.0)
    ],
)
def test_errors_match_the_covariance_on_surfaces(body: str, turn: float) -> None:
    found = list(simulate_body(make_zigzag_rig(5), BODIES[body], turn, range(30)))
    assert 1.0 < np.mean([f.nees for f in found]) < 6.0
    assert max(f.nees for f in found) < 30.0
    if turn > 1.0:
        assert np.mean([f.by_noise for f in found]) > 12.0


@pytest.mark.parametrize(
    "rig", [ring(4), *(pytest.param(rig, marks=pytest.mark.slow) for rig in (ring(8), arc(4, 38.0))), arc(2, 60.0)]
)
def test_coplanar_cameras_do_not_observe_rotation_about_the_normal(rig: Rig) -> None:
    """Their errors are as large as the rotation itself, certified or not."""
    for body in BODIES.values():
        found = list(simulate_body(rig, body, 6.0, range(12)))
        assert max(f.degrees for f in found) > 3.0
        assert any(f.solution.certified for f in found) or len(rig) == 2
        for f in found:
            assert f.solution.status is Status.ROTATION_NOT_OBSERVABLE or f.nees < 12.0
        vertical = [np.abs(f.solution.unobservable[:, 1]).max(initial=0.0) for f in found]
        assert np.median(vertical) > 0.9


def test_good_rigs_observe_all_directions() -> None:
    for rig in (make_zigzag_rig(8), dome(6)):
        found = list(simulate_body(rig, BODIES["ellipsoid"], 5.0, range(20)))
        assert {f.solution.status for f in found} == {Status.OK}
        # The covariance is not too large either.
        sd = [np.degrees(np.sqrt(np.linalg.eigvalsh(f.solution.covariance)[-1])) for f in found]
        assert np.median(sd) < 1.2


def test_two_cameras_have_an_unobservable_direction() -> None:
    """For a board between two opposite cameras, a certified rotation was wrong by 160 degrees."""
    found = [f for body in BODIES.values() for f in simulate_body(ring(2), body, 6.0, range(20))]
    assert {f.solution.status for f in found} == {Status.ROTATION_NOT_OBSERVABLE}
    assert min(len(f.solution.unobservable) for f in found) == 1
    assert any(f.solution.certified for f in found)


def test_one_camera_does_not_observe_out_of_plane_rotation() -> None:
    """Both of its solutions may be far from the truth."""
    for f in simulate_body(make_zigzag_rig(1), BODIES["ellipsoid"], 5.0, range(10)):
        assert f.solution.status is Status.ROTATION_NOT_OBSERVABLE
        assert len(f.solution.unobservable) == 2


def test_bias_is_linear_in_the_slopes() -> None:
    """Compare solutions of exact affine images with small known slopes to the derivative."""
    rng = np.random.default_rng(3)
    cameras = np.asarray(Rotation.random(4, rng=rng).as_matrix())
    truth = Rotation.from_rotvec([0.2, -0.1, 0.15]).as_matrix()
    slopes, x = 1e-4 * rng.standard_normal((4, 2)), rng.standard_normal((4, 20, 2)) @ np.diag([1.0, 0.5])
    moments = []
    for q, a, points in zip(cameras, slopes, x, strict=True):
        seen_from = (q @ truth @ q.T)[:2]
        moments.append(PairMoments.from_matches(points, np.column_stack([points, points @ a]) @ seen_from.T))
    found = solve_centralized(cameras, moments, aim=False).rotation
    views = compute_views(cameras, moments, aim=False)
    maps = depth_bias._compute_maps(views, truth)
    of_axes = np.einsum("cji,cj->ci", np.linalg.eigh(views.s_xx)[1], slopes)
    moved = np.zeros((4, 4))  # both in the same units
    moved[:, :2] = maps.by_slopes * of_axes
    B = np.einsum("cik,cil->kl", maps.by_rotation, maps.by_rotation)
    expected = np.linalg.solve(B, np.einsum("cik,ci->k", maps.by_rotation, moved))
    w = Rotation.from_matrix(found @ truth.T).as_rotvec()
    np.testing.assert_allclose(w, expected, atol=0.01 * float(np.linalg.norm(expected)))
    assert np.linalg.norm(expected) > 1e-6


def test_equivariant_and_equal_for_mirrored_solutions() -> None:
    rng = np.random.default_rng(5)
    q, new = (np.asarray(Rotation.random(rng=rng).as_matrix()) for _ in range(2))
    x = 0.05 * rng.standard_normal((30, 2))
    y = x @ np.array([[0.98, 0.1], [-0.1, 0.9]]) + 1e-3 * rng.standard_normal((30, 2))
    moments = PairMoments.from_matches(x, y)
    here, there = solve_one_camera(q, moments), solve_one_camera(q @ new.T, moments)
    scale = np.abs(here.information).max()
    np.testing.assert_allclose(there.information, new @ here.information @ new.T, atol=1e-8 * scale)
    of_one, of_other = np.linalg.eigvalsh(here.information)
    np.testing.assert_allclose(of_one, of_other, rtol=1e-6, atol=1e-9 * scale)
