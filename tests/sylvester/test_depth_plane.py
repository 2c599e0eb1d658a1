"""Depth plane estimator: exactness, derivatives, symmetries, statuses and covariance (Monte Carlo)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.rig import Rig
from sylpose.simulate import Body, arc, box, ellipsoid, plane, random_motion, ring, simulate_matches
from sylpose.status import Status
from sylpose.sylvester import depth_plane
from sylpose.sylvester.centralized import solve_centralized
from sylpose.sylvester.depth_plane import (
    LOOSE_DECREASE_TOLERANCE,
    DepthPlaneSolution,
    build_problem,
    compute_costs,
    compute_derivatives,
    search_minima,
    solve_depth_plane,
)
from tests.scenes import compute_angle_degrees, make_zigzag_rig

Problem = tuple[FloatArray, list[PairMoments], FloatArray]
MOVED_TO = np.array([0.03, -0.02, 1.02])
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=8, deadline=None)


def simulate_planes(
    seed: int,
    n: int,
    turn_deg: float,
    *,
    perspective: bool = False,
    relief: float = 0.0,
    noise: float = 0.0,
    spread: float = 0.1,
    matches: int = 40,
) -> tuple[FloatArray, list[PairMoments], FloatArray, FloatArray]:
    """Simulate cameras all around, each with its own tilted plane: return rotations, moments, R and slopes (C, 2).

    This is the model of the estimator, with residual depth and noise.
    """
    rng = np.random.default_rng(seed)
    rotations = np.asarray(Rotation.random(n, rng=rng).as_matrix())
    motion = Rotation.from_rotvec(np.deg2rad(turn_deg) * rotations[0].T @ [0.8, 0.36, 0.48]).as_matrix()
    slopes, moments = rng.uniform(-1, 1, (n, 2)), []
    for q, a in zip(rotations, slopes, strict=True):
        u = spread * rng.standard_normal((matches, 2))
        u = np.concatenate([u, -u])  # the slopes refer to the mean ray
        if perspective:
            depth = 1 / (1 - u @ a)  # Z = 1 + a'(X, Y)
            points = np.column_stack([u * depth[:, None], depth])
            x = u
            moved = (points - [0, 0, 1]) @ (q @ motion @ q.T).T + MOVED_TO
            y = moved[:, :2] / moved[:, 2:]
        else:
            points = np.column_stack([u, u @ a + relief * rng.standard_normal(len(u))])
            x, y = u, 1.02 * (points @ (q @ motion @ q.T).T)[:, :2] + [0.3, -0.2]
        moments.append(PairMoments.from_matches(*(p + noise * rng.standard_normal(p.shape) for p in (x, y))))
    return rotations, moments, motion, slopes


def simulate_scene(seed: int, rig: Rig, body: Body, turn_deg: float = 5.0, *, orthographic: bool = False) -> Problem:
    """Return rotations, moments and R of a random body and rotation: 60 matches per camera, noise of 0.5 px."""
    rng = np.random.default_rng(seed)
    motion = random_motion(turn_deg, 0.02, rng)
    start = RigidTransform.from_rotation(Rotation.random(rng=rng))
    pair = simulate_matches(rig, body, motion, rng=rng, start=start, orthographic=orthographic)
    moments = [PairMoments.from_matches(m.x, m.y) for m in pair.matches]
    return np.array([c.rotation for c in rig]), moments, motion.rotation.as_matrix()


def normalized_error(solution: DepthPlaneSolution, truth: FloatArray) -> float:
    """Return the squared error in units of the covariance."""
    error = Rotation.from_matrix(truth @ solution.rotation.T).as_rotvec()
    return float(error @ solution.information @ error)


# --- Exactness --------------------------------------------------------------------------------------------------------


@given(seeds, st.integers(5, 7), st.floats(8, 25), st.booleans())
@few
def test_exact_for_noise_free_planes(seed: int, n: int, turn_deg: float, perspective: bool) -> None:
    rotations, moments, motion, slopes = simulate_planes(seed, n, turn_deg, perspective=perspective)
    solution = solve_depth_plane(rotations, moments, noise=1e-5, aim=perspective)
    assert solution.status is Status.OK
    assert compute_angle_degrees(solution.rotation, motion) < 1e-3
    np.testing.assert_allclose(solution.planes, slopes, atol=1e-2)
    # In perspective: the depth at the mean ray, one before the motion, along that ray.
    np.testing.assert_allclose(solution.scales, 1 / np.linalg.norm(MOVED_TO) if perspective else 1.02, atol=1e-4)


def test_error_is_due_to_noise_only() -> None:
    errors = []
    for noise in (1e-4, 1e-5, 1e-6):
        rotations, moments, motion, _ = simulate_planes(3, 4, 10.0, noise=noise)
        errors.append(compute_angle_degrees(solve_depth_plane(rotations, moments, aim=False).rotation, motion))
    assert errors[1] < 0.3 * errors[0]
    assert errors[2] < 0.3 * errors[1]


def test_planes_and_scales_are_recovered() -> None:
    rotations, moments, _, slopes = simulate_planes(5, 5, 12.0, relief=0.02, noise=5e-4, matches=400)
    solution = solve_depth_plane(rotations, moments, aim=False)
    np.testing.assert_allclose(solution.planes, slopes, atol=0.15)
    np.testing.assert_allclose(solution.scales, 1.02, atol=3e-3)
    np.testing.assert_allclose(solution.residual_depth, 0.02, rtol=0.25)
    np.testing.assert_allclose(solution.sigma, 5e-4, rtol=0.1)
    given_noise = solve_depth_plane(rotations, moments, noise=5e-4, aim=False)
    np.testing.assert_allclose(given_noise.sigma, 5e-4)
    assert compute_angle_degrees(given_noise.rotation, solution.rotation) < 0.02


@pytest.mark.parametrize("perspective", [True, False])
@pytest.mark.parametrize("noise", [None, 7e-4])
def test_derivatives_against_finite_differences(perspective: bool, noise: float | None) -> None:
    rotations, moments, _ = simulate_scene(0, make_zigzag_rig(3), ellipsoid((0.15, 0.12, 0.1)))
    problem, _ = build_problem(rotations, moments, noise, perspective)
    rng = np.random.default_rng(1)
    scales = np.array([1, 1, 0.03, 1e-3, 1e-3, 0.3, 0.3])
    own = scales * rng.standard_normal((1, 3, 7)) + [0, 0, 0, 0, 0, np.log(0.02), 0]
    own[..., 6] = np.log(7e-4) if noise else np.log(7e-4) + own[..., 6]
    R = Rotation.from_rotvec([[0.05, -0.03, 0.06]]).as_matrix()
    gradient, information = compute_derivatives(problem, R, own)

    def cost(step: FloatArray) -> float:
        """Return the cost as a function of w and the second camera's own unknowns."""
        turned = Rotation.from_rotvec(step[None, :3]).as_matrix() @ R
        changed = own + np.eye(3)[1][:, None] * step[3:]
        return float(compute_costs(problem, turned, changed)[0])

    numeric = np.array([(cost(e) - cost(-e)) / 2e-6 for e in 1e-6 * np.eye(10)])
    analytic = np.concatenate([gradient[0, :, :3].sum(axis=0), gradient[0, 1, 3:]])
    np.testing.assert_allclose(analytic[:9], numeric[:9], rtol=1e-5, atol=1e-3)
    assert analytic[9] == pytest.approx(numeric[9], rel=1e-5) if noise is None else analytic[9] == 0
    assert np.linalg.eigvalsh(information[0, 1]).min() > 0


def test_result_is_a_minimum() -> None:
    rotations, moments, _ = simulate_scene(1, make_zigzag_rig(4), box())
    solution = solve_depth_plane(rotations, moments)
    problem, _ = build_problem(rotations, moments, None, True)
    own = np.column_stack([solution.planes, np.log(solution.scales), np.zeros((4, 2))])
    own = np.column_stack([own, np.log(solution.residual_depth), np.log(solution.sigma)])
    for w in 1e-3 * np.concatenate([np.eye(3), -np.eye(3)]):
        nearby = Rotation.from_rotvec(w).as_matrix() @ solution.rotation
        again = search_minima(problem, nearby[None], own[None])
        assert compute_angle_degrees(again.R[0], solution.rotation) < 1e-5
        assert again.cost[0] == pytest.approx(solution.cost, abs=1e-6)


# --- Symmetries -------------------------------------------------------------------------------------------------------


@given(seeds)
@few
def test_equivariant_under_a_change_of_world_frame(seed: int) -> None:
    rotations, moments, _ = simulate_scene(seed, make_zigzag_rig(4), box())
    new = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    a, b = solve_depth_plane(rotations, moments), solve_depth_plane(rotations @ new.T, moments)
    assert compute_angle_degrees(b.rotation, new @ a.rotation @ new.T) < 1e-5
    np.testing.assert_allclose(b.planes, a.planes, atol=1e-4)
    np.testing.assert_allclose(
        b.information, new @ a.information @ new.T, rtol=1e-4, atol=1e-4 * np.abs(a.information).max()
    )


@given(seeds)
@few
def test_invariant_to_camera_order_and_empty_cameras(seed: int) -> None:
    rotations, moments, _ = simulate_scene(seed, make_zigzag_rig(4), box())
    reference = solve_depth_plane(rotations, moments)
    order = np.random.default_rng(seed).permutation(4)
    shuffled = solve_depth_plane(rotations[order], [moments[c] for c in order])
    assert compute_angle_degrees(shuffled.rotation, reference.rotation) < 1e-5
    np.testing.assert_allclose(shuffled.planes, reference.planes[order], atol=1e-4)
    point = PairMoments.from_matches(np.zeros((9, 2)), np.zeros((9, 2)))
    two = PairMoments.from_matches(np.diag([0.1, 0.0]), np.diag([0.0, 0.1]))
    empty = [PairMoments.zero(), point, two]
    more = solve_depth_plane(np.concatenate([rotations, rotations[:3]]), [*moments, *empty])
    np.testing.assert_array_equal(more.rotation, reference.rotation)
    np.testing.assert_array_equal(more.information, reference.information)
    for values in (more.planes[:, 0], more.scales, more.residual_depth, more.sigma):
        assert np.isnan(values).tolist() == [False] * 4 + [True] * 3


@given(seeds, st.floats(1e-3, 1e3))
@few
def test_invariant_to_the_unit_of_orthographic_points(seed: int, unit: float) -> None:
    rotations, moments, _, _ = simulate_planes(seed, 4, 8.0, relief=0.02, noise=5e-4)
    scaled = [m.transform(np.diag([unit, unit, 1])) for m in moments]
    a, b = solve_depth_plane(rotations, moments, aim=False), solve_depth_plane(rotations, scaled, aim=False)
    assert compute_angle_degrees(b.rotation, a.rotation) < 1e-5
    np.testing.assert_allclose(b.sigma, unit * a.sigma, rtol=1e-4)
    np.testing.assert_allclose(b.residual_depth, unit * a.residual_depth, rtol=1e-3)


def test_symmetric_in_the_frames() -> None:
    """Up to the uncertainty: the planes of the two frames have different priors."""
    swap = np.arange(9).reshape(3, 3).T.ravel()
    for seed in range(5):
        rotations, moments, _ = simulate_scene(seed, make_zigzag_rig(4), box(), 10.0)
        forward = solve_depth_plane(rotations, moments)
        back = solve_depth_plane(rotations, [PairMoments(m.matrix[np.ix_(swap, swap)]) for m in moments])
        assert normalized_error(forward, back.rotation.T) < 0.5


# --- Accuracy --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("body", "bound"), [(ellipsoid((0.15, 0.15, 0.15)), 0.25), (box(), 0.2)])
def test_more_accurate_than_ignoring_depth_on_bodies(body: Body, bound: float) -> None:
    problems = [simulate_scene(seed, make_zigzag_rig(4), body, 10.0) for seed in range(10)]
    errors = [compute_angle_degrees(solve_depth_plane(q, m).rotation, R) for q, m, R in problems]
    plain = [compute_angle_degrees(solve_centralized(q, m).rotation, R) for q, m, R in problems]
    assert np.median(errors) < bound
    assert np.median(errors) < 0.5 * np.median(plain)


def test_close_cameras_observe_out_of_plane_rotation() -> None:
    """A rotation about the vertical, observed by level cameras, for which ignoring depth fails."""
    rig = arc(3, 30, height=0.3)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        motion = random_motion(8.0, 0.01, rng, axis=[0, 1, 0])
        start = RigidTransform.from_rotation(Rotation.random(rng=rng))
        pair = simulate_matches(rig, box(), motion, rng=rng, start=start, per_camera=200, noise_px=0.2)
        rotations = np.array([c.rotation for c in rig])
        moments = [PairMoments.from_matches(m.x, m.y) for m in pair.matches]
        R = motion.rotation.as_matrix()
        assert compute_angle_degrees(solve_depth_plane(rotations, moments).rotation, R) < 1.0
        assert compute_angle_degrees(solve_centralized(rotations, moments).rotation, R) > 2.0


def test_covariance_agrees_with_sampling() -> None:
    """The normalized squared errors average near 3 for three unknowns, +- 0.4 for 40 scenes.

    They are slightly larger (3.8 for 60 scenes), because the depth unknowns are not normally distributed.
    """
    values = []
    for seed in range(40):
        rotations, moments, motion, _ = simulate_planes(seed, 4, 8.0, relief=0.02, noise=1e-3, matches=20)
        solution = solve_depth_plane(rotations, moments, aim=False)
        if solution.status is Status.OK:
            values.append(normalized_error(solution, motion))
            np.testing.assert_allclose(solution.covariance @ solution.information, np.eye(3), atol=1e-8)
    assert len(values) >= 38
    assert 2.0 < np.mean(values) < 4.8


# --- Statuses --------------------------------------------------------------------------------------------------------


def test_no_result_without_matches() -> None:
    rotations, moments, _ = simulate_scene(0, make_zigzag_rig(2), box())
    few_matches = PairMoments.from_matches(np.diag([0.1, 0.0]), np.diag([0.0, 0.1]))
    for nothing in (PairMoments.zero(), few_matches):
        solution = solve_depth_plane(rotations, [nothing] * len(moments))
        assert solution.status is Status.TOO_FEW_MATCHES
        assert np.isnan(solution.rotation).all()
        assert np.isinf(np.diag(solution.covariance)).all()
        assert not solution.converged


def test_one_camera_does_not_observe_the_rotation() -> None:
    rotations, moments, _ = simulate_scene(0, make_zigzag_rig(2), box())
    solution = solve_depth_plane(rotations, [moments[0], PairMoments.zero()])
    assert solution.status is Status.ROTATION_NOT_OBSERVABLE
    assert np.isfinite(solution.rotation).all()


def test_opposite_cameras_do_not_observe_the_rotation() -> None:
    """To first order, a rotation about an axis perpendicular to the rays changes neither image."""
    rng = np.random.default_rng(0)
    rotations = np.array([np.eye(3), np.diag([-1.0, 1, -1])])
    motion = Rotation.from_rotvec([0.0, 0.0, 0.1]).as_matrix()
    moments = []
    for q in rotations:
        x = 0.1 * rng.standard_normal((50, 2))
        y = x @ (q @ motion @ q.T)[:2, :2].T
        moments.append(PairMoments.from_matches(*(p + 5e-4 * rng.standard_normal(p.shape) for p in (x, y))))
    solution = solve_depth_plane(rotations, moments, aim=False)
    assert solution.status is Status.ROTATION_NOT_OBSERVABLE
    seen = np.linalg.eigh(solution.information)[1][:, 2]
    assert abs(seen[2]) > 0.99


def test_nearly_as_likely_rotation_is_not_certified() -> None:
    """Oblique views of a flat board from one side."""
    rotations, moments, R = simulate_scene(7, arc(3, 30), plane())
    solution = solve_depth_plane(rotations, moments)
    assert solution.status is Status.NOT_CERTIFIED
    assert compute_angle_degrees(solution.rotation, R) > 1.0


def test_two_cameras_suffice_unless_opposite() -> None:
    problems = [simulate_scene(seed, arc(2, 60), box()) for seed in range(10)]
    errors = [compute_angle_degrees(solve_depth_plane(q, m).rotation, R) for q, m, R in problems]
    assert np.median(errors) < 0.4


def test_collinear_matches_of_one_camera_are_tolerated() -> None:
    rotations, moments, motion, _ = simulate_planes(2, 5, 8.0, noise=5e-4)
    line = np.outer(np.linspace(-0.1, 0.1, 20), [1.0, 0.3])
    seen = line @ (rotations[0] @ motion @ rotations[0].T)[:2, :2].T
    noise = 5e-4 * np.random.default_rng(0).standard_normal((2, 20, 2))
    with_line = solve_depth_plane(
        rotations, [PairMoments.from_matches(line + noise[0], seen + noise[1]), *moments[1:]], aim=False
    )
    assert with_line.status is Status.OK
    assert normalized_error(with_line, motion) < 16.3  # exceeded by chance once in a thousand times


def test_identity_is_recovered() -> None:
    rotations, moments, R = simulate_scene(3, make_zigzag_rig(4), ellipsoid((0.15, 0.12, 0.1)), 0.0)
    solution = solve_depth_plane(rotations, moments)
    assert solution.status is Status.OK
    assert compute_angle_degrees(solution.rotation, R) < 0.6


@pytest.mark.parametrize("relief", [0.0, 0.05])
@pytest.mark.parametrize("seed", range(4))
def test_identity_without_noise_converges(seed: int, relief: float) -> None:
    """Residual depth along the line of sight is hidden: plain Fisher scoring oscillates with growing steps."""
    rng = np.random.default_rng(seed)
    rotations = np.asarray(Rotation.random(4, rng=rng).as_matrix())
    points = rng.standard_normal((4, 60, 3)) * [1, 1, relief]
    moments = [PairMoments.from_matches(x, x) for x in (p @ q[:2].T for p, q in zip(points, rotations, strict=True))]
    solution = solve_depth_plane(rotations, moments, aim=False)
    assert solution.converged
    assert solution.status is Status.OK
    assert compute_angle_degrees(solution.rotation, np.eye(3)) < 1e-6


def test_pure_translation_has_zero_rotation() -> None:
    rng = np.random.default_rng(0)
    rotations = np.asarray(Rotation.random(4, rng=rng).as_matrix())
    moments = []
    for q in rotations:
        points = 0.1 * rng.standard_normal((60, 3))
        seen = [(p @ q.T) + [0, 0, 1] for p in (points, points + np.array([0.02, 0.02, 0]))]
        moments.append(PairMoments.from_matches(*(p[:, :2] / p[:, 2:] for p in seen)))
    solution = solve_depth_plane(rotations, moments)
    assert solution.status is Status.OK
    assert compute_angle_degrees(solution.rotation, np.eye(3)) < 0.05


def test_slow_search_near_the_minimum_counts_as_converged(monkeypatch: pytest.MonkeyPatch) -> None:
    """A static object in a narrow arc of cameras, with noise: hundreds of steps for less than 0.1 standard deviations."""
    rotations, moments, _ = simulate_scene(6, arc(4, 30.0), ellipsoid((0.15, 0.12, 0.1)), 0.0)
    solution = solve_depth_plane(rotations, moments)
    assert solution.converged
    monkeypatch.setattr(depth_plane, "MAX_ITERATIONS", 1000)
    longer = solve_depth_plane(rotations, moments)
    assert 0 <= solution.cost - longer.cost < LOOSE_DECREASE_TOLERANCE
    apart = Rotation.from_matrix(longer.rotation @ solution.rotation.T).as_rotvec()
    assert apart @ longer.information @ apart < 0.1**2
    assert solution.iterations < longer.iterations


def test_iteration_limit_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_plane, "MAX_ITERATIONS", 4)
    rotations, moments, _ = simulate_scene(0, make_zigzag_rig(4), box())
    solution = solve_depth_plane(rotations, moments)
    assert solution.status is Status.NOT_CONVERGED
    assert not solution.converged
    assert solution.iterations == 8  # the first search, and the others in one batch


def test_invalid_input_raises() -> None:
    rotations, moments, _ = simulate_scene(0, ring(3), box())
    with pytest.raises(ValueError, match=r"rotations must be \(C, 3, 3\) for C = 2"):
        solve_depth_plane(rotations, moments[:2])
    with pytest.raises(ValueError, match=r"rotations\[1\] is not a rotation"):
        solve_depth_plane([rotations[0], 2 * rotations[1], rotations[2]], moments)
    for noise in (0.0, -1e-3, np.nan, [1e-3, 1e-3]):
        with pytest.raises(ValueError, match="noise must be positive, one number or one for each of 3 cameras"):
            solve_depth_plane(rotations, moments, noise=noise)
