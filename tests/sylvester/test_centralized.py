"""Centralized estimator of the paper: exactness, symmetries, certificate, derivatives, invalid input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.status import Status
from sylpose.sylvester.centralized import (
    CentralizedSolution,
    find_unobservable_rotations,
    rotation_status,
    solve_centralized,
    solve_centralized_batch,
)
from sylpose.sylvester.equation import solve_generalized_sylvester
from sylpose.sylvester.orthographic import build_cost, compute_views
from tests.scenes import compute_angle, draw_rotations

Matches = list[tuple[FloatArray, FloatArray]]
seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=12, deadline=None)


def general_cameras(rng: np.random.Generator, n: int) -> FloatArray:
    """Return cameras whose first three viewing directions are far from one plane (orthogonal, then perturbed)."""
    base = np.array([np.roll(np.eye(3), k, axis=0) for k in range(3)])  # z axes along z, y, x
    near = Rotation.from_rotvec(0.3 * rng.uniform(-1, 1, size=(3, 3))).as_matrix()
    return np.asarray(np.concatenate([base @ near, draw_rotations(rng, n - 3)]) @ draw_rotations(rng, 1)[0])


def simulate_orthographic(
    rng: np.random.Generator,
    cameras: FloatArray,
    turn: FloatArray,
    noise: float = 0.0,
    symmetric_depth: bool = True,
    n: int = 12,
) -> Matches:
    """Return each camera's orthographic images of its own points.

    With `symmetric_depth` every point also occurs at the opposite depth: depth is uncorrelated with the image, the
    condition under which the estimator is exact.
    """
    out = []
    for q in cameras:
        points = rng.normal(size=(n, 3)) * rng.uniform(0.3, 2, size=3)
        if symmetric_depth:
            points = np.concatenate([points, points * [1, 1, -1]])
        x, y = points[:, :2], (points @ (q @ turn @ q.T).T)[:, :2]
        offset = rng.normal(size=(2, 1, 2))
        out.append((x + offset[0] + noise * rng.normal(size=x.shape), y + offset[1] + noise * rng.normal(size=y.shape)))
    return out


def pair_moments(matches: Matches) -> list[PairMoments]:
    return [PairMoments.from_matches(x, y) for x, y in matches]


def noisy_problem(seed: int, n: int = 4) -> tuple[FloatArray, Matches, FloatArray]:
    rng = np.random.default_rng(seed)
    cameras, turn = general_cameras(rng, n), draw_rotations(rng, 1)[0]
    return cameras, simulate_orthographic(rng, cameras, turn, noise=0.05), turn


def is_same(a: CentralizedSolution, b: CentralizedSolution, tolerance: float = 1e-8) -> bool:
    return a.certified == b.certified and compute_angle(a.rotation, b.rotation) < tolerance


# --- All cameras ------------------------------------------------------------------------------------------------------


@given(seeds, st.integers(3, 6), st.floats(0, np.pi))
@quick
def test_exact_and_certified_for_uncorrelated_depth(seed: int, n: int, turn_angle: float) -> None:
    rng = np.random.default_rng(seed)
    cameras, axis = general_cameras(rng, n), draw_rotations(rng, 1)[0, 0]
    turn = Rotation.from_rotvec(turn_angle * axis).as_matrix()
    solution = solve_centralized(cameras, pair_moments(simulate_orthographic(rng, cameras, turn)), aim=False)
    assert solution.certified
    assert solution.converged
    assert compute_angle(solution.rotation, turn) < 1e-8
    assert np.abs(solution.multiplier).max() < 1e-8  # the constraint is inactive


@given(seeds)
@quick
def test_exact_for_a_common_isotropic_cloud(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    cameras, turn = general_cameras(rng, 3), draw_rotations(rng, 1)[0]
    points = rng.normal(size=(20, 3))
    points -= points.mean(axis=0)
    points = points @ np.linalg.inv(np.linalg.cholesky(points.T @ points)).T
    moments = [PairMoments.from_matches((points @ q.T)[:, :2], (points @ turn.T @ q.T)[:, :2]) for q in cameras]
    assert compute_angle(solve_centralized(cameras, moments, aim=False).rotation, turn) < 1e-8


def test_correlated_depth_causes_bias() -> None:
    """The condition is necessary: without it the estimate is biased even without noise."""
    rng = np.random.default_rng(1)
    cameras, turn = general_cameras(rng, 4), Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix()
    solution = solve_centralized(
        cameras, pair_moments(simulate_orthographic(rng, cameras, turn, symmetric_depth=False)), aim=False
    )
    assert compute_angle(solution.rotation, turn) > 1e-3


def test_cost_of_the_paper_is_not_symmetric_in_the_frames() -> None:
    """Frame j is modeled as a function of frame i: with noise, the inverse problem has a different solution."""
    cameras, matches, turn = noisy_problem(0)
    a = solve_centralized(cameras, pair_moments(matches), aim=False)
    b = solve_centralized(cameras, pair_moments([(y, x) for x, y in matches]), aim=False)
    assert 1e-4 < compute_angle(b.rotation, a.rotation.T) < 0.3
    assert compute_angle(a.rotation, turn) < 0.1


def test_costs_add_over_the_cameras() -> None:
    cameras, matches, _ = noisy_problem(1)
    views = compute_views(cameras, pair_moments(matches))
    whole = build_cost(views)
    parts = [build_cost(views.subset([c])) for c in range(len(cameras))]
    for name in ("H", "h", "constant", "weight"):
        total = sum(getattr(part, name) for part in parts)
        np.testing.assert_allclose(total, getattr(whole, name), rtol=1e-12, atol=1e-12 * float(whole.scale))


@given(seeds)
@quick
def test_equivariant_under_a_change_of_world_frame(seed: int) -> None:
    cameras, matches, _ = noisy_problem(seed)
    new_from_old = draw_rotations(np.random.default_rng(seed + 1), 1)[0]
    a = solve_centralized(cameras, pair_moments(matches))
    b = solve_centralized(cameras @ new_from_old.T, pair_moments(matches))
    assert a.certified == b.certified
    assert compute_angle(b.rotation, new_from_old @ a.rotation @ new_from_old.T) < 1e-8
    np.testing.assert_allclose(
        b.information, new_from_old @ a.information @ new_from_old.T, atol=1e-6 * np.abs(a.information).max()
    )
    np.testing.assert_allclose(b.multiplier, new_from_old @ a.multiplier @ new_from_old.T, atol=1e-7)


@given(seeds)
@quick
def test_invariant_to_order_and_grouping(seed: int) -> None:
    cameras, matches, _ = noisy_problem(seed)
    rng = np.random.default_rng(seed)
    reference = solve_centralized(cameras, pair_moments(matches))
    order = rng.permutation(len(cameras))
    assert is_same(reference, solve_centralized(cameras[order], [pair_moments(matches)[c] for c in order]))
    shuffled = [(x[p], y[p]) for x, y in matches for p in [rng.permutation(len(x))]]
    parts = [PairMoments.from_matches(x[:7], y[:7]) + PairMoments.from_matches(x[7:], y[7:]) for x, y in shuffled]
    assert is_same(reference, solve_centralized(cameras, parts))
    with_empty_camera = solve_centralized(
        np.concatenate([cameras, cameras[:1]]), [*pair_moments(matches), PairMoments.zero()]
    )
    assert is_same(reference, with_empty_camera)


@given(seeds)
@quick
def test_parallel_cameras_with_equal_means_can_be_merged(seed: int) -> None:
    """The means must be equal, because each camera's points are centered by its own mean."""
    cameras, matches, _ = noisy_problem(seed)
    (x0, y0), (x1, y1) = matches[0], matches[1]
    x1, y1 = x1 - x1.mean(axis=0) + x0.mean(axis=0), y1 - y1.mean(axis=0) + y0.mean(axis=0)
    first, second = pair_moments([(x0, y0), (x1, y1)])
    rest = pair_moments(matches[2:])
    apart = solve_centralized(cameras[[0, 0, 2, 3]], [first, second, *rest])
    together = solve_centralized(cameras[[0, 2, 3]], [first + second, *rest])
    assert is_same(apart, together, 1e-7)
    assert together.cost == pytest.approx(apart.cost, rel=1e-9)


@given(seeds, st.floats(1e-4, 1e4), st.floats(1e-3, 1e3))
@quick
def test_invariant_to_units_and_weights(seed: int, unit: float, weight: float) -> None:
    cameras, matches, _ = noisy_problem(seed)
    a = solve_centralized(cameras, pair_moments(matches), aim=False)
    b = solve_centralized(
        cameras, [PairMoments.from_matches(unit * x, unit * y, np.full(len(x), weight)) for x, y in matches], aim=False
    )
    assert is_same(a, b)
    assert b.cost == pytest.approx(a.cost, rel=1e-6)
    np.testing.assert_allclose(b.multiplier, a.multiplier, atol=1e-7)
    # Residual variance and spread scale equally, as do their weights: information is proportional to the weight.
    noise = weight * a.noise_information
    np.testing.assert_allclose(b.noise_information, noise, rtol=1e-5, atol=1e-6 * noise.max())


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_no_random_rotation_has_a_lower_cost(n: int) -> None:
    """The check uses the residuals directly, for certified and other results; half of the rotations are near the result."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        cameras, turn = draw_rotations(rng, n), Rotation.from_rotvec(rng.normal(size=3) * 0.4).as_matrix()
        matches = simulate_orthographic(rng, cameras, turn, noise=0.1, symmetric_depth=False)
        solution = solve_centralized(cameras, pair_moments(matches), aim=False)
        assert solution.converged
        near = Rotation.from_rotvec(0.05 * rng.normal(size=(500, 3))).as_matrix() @ solution.rotation
        tried = np.concatenate([solution.candidates, near, draw_rotations(rng, 500)])
        squares = np.zeros(len(tried))
        for q, (x, y) in zip(cameras, matches, strict=True):
            x, y, N = x - x.mean(axis=0), y - y.mean(axis=0), (q @ tried @ q.T)[:, :2, :2]
            squares += np.sum((y - x @ np.swapaxes(N, 1, 2)) ** 2, axis=(1, 2))
        assert squares[1:].min() >= squares[0] * (1 - 1e-9)
        k = len(solution.costs)
        np.testing.assert_allclose(squares[:k] / squares[0], solution.costs / solution.cost, rtol=1e-6)


def test_four_cameras_are_certified_and_solve_sylvesters_equation() -> None:
    for seed in range(10):
        cameras, matches, turn = noisy_problem(seed)
        moments = pair_moments(matches)
        solution = solve_centralized(cameras, moments, aim=False)
        assert solution.certified
        assert len(solution.candidates) == 1
        assert compute_angle(solution.rotation, turn) < 0.1
        np.testing.assert_allclose(solution.rotation @ solution.rotation.T, np.eye(3), atol=1e-10)
        p = np.eye(3)[:2]
        a = [q.T @ p.T @ p @ q for q in cameras]
        b = [q.T @ p.T @ m.s_xx @ p @ q for q, m in zip(cameras, moments, strict=True)]
        c = sum((q.T @ p.T @ m.s_yx @ p @ q for q, m in zip(cameras, moments, strict=True)), start=np.zeros(()))
        scale = sum(np.trace(np.kron(*ab)) for ab in zip(a, b, strict=True)) / 9
        again = solve_generalized_sylvester([*a, scale * solution.multiplier], [*b, np.eye(3)], c)
        np.testing.assert_allclose(again, solution.rotation, atol=1e-8)


@given(seeds, st.floats(0.2, 1.2))
@quick
def test_one_camera_gives_mirrored_rotations_without_certificate(seed: int, turn_angle: float) -> None:
    rng = np.random.default_rng(seed)
    q = draw_rotations(rng, 1)[0]
    sideways = rng.uniform(0, 2 * np.pi)
    turn_seen = Rotation.from_rotvec([0, 0, rng.uniform(-1, 1)]) * Rotation.from_rotvec(
        turn_angle * np.array([np.cos(sideways), np.sin(sideways), 0])
    )
    turn = q.T @ turn_seen.as_matrix() @ q
    solution = solve_centralized(q[None], pair_moments(simulate_orthographic(rng, q[None], turn)), aim=False)
    mirror = q.T @ np.diag([1, 1, -1]) @ q
    assert not solution.certified
    assert np.abs(solution.costs[:2] - solution.costs[0]).max() < 1e-9
    assert (solution.costs[2:] > solution.costs[0] + 1e-6).all()  # distant local minima, if there are any
    for expected in (turn, mirror @ turn @ mirror):
        assert min(compute_angle(c, expected) for c in solution.candidates[:2]) < 1e-6


def test_coplanar_cameras_do_not_observe_rotation_about_the_normal() -> None:
    """A ring of cameras and a turntable rotation: both signs fit, and without motion the angle is not observable."""
    rng = np.random.default_rng(3)
    x_axis_down = np.array([[0, 0, -1], [1, 0, 0], [0, -1, 0]], float)  # looks along -y; the world's z is up
    cameras = np.array([x_axis_down @ Rotation.from_rotvec([0, 0, a]).as_matrix() for a in (0.0, 1.0, 2.2, 4.0)])
    assert np.abs(cameras[:, 2, 2]).max() < 1e-12
    turn = Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    solution = solve_centralized(cameras, pair_moments(simulate_orthographic(rng, cameras, turn)), aim=False)
    assert not solution.certified
    assert sorted(compute_angle(c, turn) < 1e-6 for c in solution.candidates) == [False, True]
    assert min(compute_angle(c, turn.T) for c in solution.candidates) < 1e-6
    still = solve_centralized(cameras, pair_moments(simulate_orthographic(rng, cameras, np.eye(3))), aim=False)
    values, vectors = np.linalg.eigh(still.noise_information)
    assert values[0] < 1e-5 * values[1]
    assert abs(vectors[2, 0]) > 0.999


def test_identity_from_one_camera_is_a_single_candidate() -> None:
    rng = np.random.default_rng(4)
    q = draw_rotations(rng, 1)
    solution = solve_centralized(q, pair_moments(simulate_orthographic(rng, q, np.eye(3))), aim=False)
    assert len(solution.candidates) == 1
    assert compute_angle(solution.rotation, np.eye(3)) < 1e-3


def test_coincident_points_are_not_certified() -> None:
    """y has no spread: h = 0, so the cost does not depend on the rotation."""
    rng = np.random.default_rng(7)
    cameras = general_cameras(rng, 3)
    moments = [PairMoments.from_matches(rng.normal(size=(9, 2)), np.zeros((9, 2))) for _ in cameras]
    solution = solve_centralized(cameras, moments)
    assert not solution.certified
    assert np.isfinite(solution.information).all()


@pytest.mark.parametrize("unit", [1e-8, 1e8])
def test_spread_check_is_independent_of_the_unit(unit: float) -> None:
    cameras, matches, _ = noisy_problem(2)
    a = solve_centralized(cameras, pair_moments(matches), aim=False)
    b = solve_centralized(cameras, pair_moments([(unit * x, unit * y) for x, y in matches]), aim=False)
    assert is_same(a, b)


@pytest.mark.parametrize("n", [1, 10, 100_000])
@pytest.mark.parametrize("unit", [1e-8, 1.0, 1e8])
def test_rounding_errors_are_not_spread(n: int, unit: float) -> None:
    rng = np.random.default_rng(n)
    cameras, points = draw_rotations(rng, 3), unit * rng.normal(size=(3, 2, 2))
    weights = rng.uniform(0.1, 1, n)
    moments = [PairMoments.from_matches(np.tile(x, (n, 1)), np.tile(y, (n, 1)), weights) for x, y in points]
    for aim in (False, True):
        with pytest.raises(ValueError, match="no camera has matches that are spread"):
            solve_centralized(cameras, moments, aim=aim)


def simulate_perspective(
    rng: np.random.Generator, cameras: FloatArray, centers: FloatArray, turn: FloatArray, d: FloatArray, size: float
) -> list[PairMoments]:
    """Return the perspective images of a small object at the origin; each camera's points are symmetric in depth."""
    out = []
    for q, o in zip(cameras, centers, strict=True):
        ray = -o / np.linalg.norm(o)
        points = size * rng.normal(size=(20, 3))
        points = np.concatenate([points, points - 2 * np.outer(points @ ray, ray)])
        seen = [(p - o) @ q.T for p in (points, points @ turn.T + d)]
        x, y = (s[:, :2] / s[:, 2:] for s in seen)
        out.append(PairMoments.from_matches(x, y))
    return out


def test_small_object_is_orthographic_about_its_mean_ray() -> None:
    rng = np.random.default_rng(5)
    cameras = general_cameras(rng, 4)
    off_axis = np.array([[0.3, 0.2, 1], [-0.4, 0.1, 1], [0.1, -0.5, 1], [0.3, 0.3, 1]])
    centers = -np.einsum("cji,cj->ci", cameras, 2 * off_axis)
    turn = Rotation.from_rotvec([0.2, -0.1, 0.15]).as_matrix()
    errors = []
    for size in (1e-2, 1e-3):
        moments = simulate_perspective(rng, cameras, centers, turn, np.zeros(3), size)
        errors.append(compute_angle(solve_centralized(cameras, moments).rotation, turn))
        assert compute_angle(solve_centralized(cameras, moments, aim=False).rotation, turn) > 10 * errors[-1]
    assert errors[1] < 3e-4


def test_status() -> None:
    rng = np.random.default_rng(8)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()
    cameras = general_cameras(rng, 4)
    good = solve_centralized(cameras, pair_moments(simulate_orthographic(rng, cameras, turn, noise=0.02)), aim=False)
    assert good.status is Status.OK
    assert rotation_status(False, True, good.unobservable) is Status.NOT_CONVERGED
    one = cameras[:1]
    mirrored = solve_centralized(one, pair_moments(simulate_orthographic(rng, one, turn, noise=0.02, n=200)), aim=False)
    # With noise alone it would be observable; with oblique surfaces it is not.
    assert len(find_unobservable_rotations(mirrored.noise_information, mirrored.rotation, 3)) == 0
    assert rotation_status(True, mirrored.certified, good.unobservable) is Status.NOT_CERTIFIED
    assert mirrored.status is Status.ROTATION_NOT_OBSERVABLE
    still = solve_centralized(one, pair_moments(simulate_orthographic(rng, one, np.eye(3))), aim=False)
    assert still.status is Status.ROTATION_NOT_OBSERVABLE
    nothing = [PairMoments.from_matches(rng.normal(size=(9, 2)), rng.normal(size=(9, 2))) for _ in cameras]
    assert solve_centralized(cameras, nothing, aim=False).status is not Status.OK


# --- Batches ----------------------------------------------------------------------------------------------------------


def make_problems(n: int, cameras: int) -> tuple[FloatArray, FloatArray]:
    """Return cameras (n, C, 3, 3) and moments (n, C, 9, 9), perspective, some without certificate."""
    all_cameras, all_matches, _ = zip(*(noisy_problem(seed, cameras) for seed in range(n)), strict=True)
    return np.array(all_cameras), np.array([[m.matrix for m in pair_moments(matches)] for matches in all_matches])


@pytest.mark.parametrize("aim", [False, True])
def test_batch_is_bit_identical_to_single_problems(aim: bool) -> None:
    cameras, moments = make_problems(30, 4)
    batch = solve_centralized_batch(cameras, moments, aim=aim)
    assert len(batch) == 30
    assert batch.certified.any()
    for q, matrices, found in zip(cameras, moments, batch, strict=True):
        alone = solve_centralized(q, [PairMoments(m) for m in matrices], aim=aim)
        assert (found.certified, found.converged, found.iterations) == (
            alone.certified,
            alone.converged,
            alone.iterations,
        )
        for name in ("candidates", "costs", "multiplier", "information", "noise_information"):
            np.testing.assert_array_equal(getattr(found, name), getattr(alone, name))
    np.testing.assert_array_equal(batch.rotations, [one.rotation for one in batch])
    some = solve_centralized_batch(cameras[7:2:-1], moments[7:2:-1], aim=aim)
    np.testing.assert_array_equal(some.rotations, batch.rotations[7:2:-1])


def test_batch_with_shared_cameras() -> None:
    cameras, moments = make_problems(5, 3)
    shared = solve_centralized_batch(cameras[0], moments, aim=False)
    repeated = solve_centralized_batch(np.repeat(cameras[:1], 5, axis=0), moments, aim=False)
    np.testing.assert_array_equal(shared.candidates, repeated.candidates)
    np.testing.assert_array_equal(shared.noise_information, repeated.noise_information)
    np.testing.assert_array_equal(shared[2].information, repeated[2].information)
    assert len(solve_centralized_batch(cameras[0], moments[:0])) == 0
    lists = [[PairMoments(matrix) for matrix in matrices] for matrices in moments]
    np.testing.assert_array_equal(solve_centralized_batch(cameras[0], lists, aim=False).candidates, shared.candidates)


def test_invalid_batches_raise() -> None:
    cameras, moments = make_problems(3, 4)
    for wrong in (moments[0], moments[..., :8]):
        with pytest.raises(ValueError, match=r"moments must be \(N, C, 9, 9\)"):
            solve_centralized_batch(cameras, wrong)
    with pytest.raises(ValueError, match="moments has values that are not finite"):
        solve_centralized_batch(cameras, np.full_like(moments, np.nan))
    with pytest.raises(ValueError, match="moments must be sums of squares"):
        solve_centralized_batch(cameras, -moments)
    with pytest.raises(ValueError, match="moments must be symmetric"):
        solve_centralized_batch(cameras, moments + np.triu(np.ones((9, 9))))
    for wrong in (cameras[:2], cameras[:, :3], cameras[0, :3]):
        with pytest.raises(ValueError, match="rotations must be"):
            solve_centralized_batch(wrong, moments)
    with pytest.raises(ValueError, match=r"rotations\[5\] is not a rotation"):
        solve_centralized_batch(np.where(np.arange(12).reshape(3, 4, 1, 1) == 5, 2.0, cameras), moments)
    empty = moments.copy()
    empty[1] = 0
    with pytest.raises(ValueError, match="problem 1: no camera has matches"):
        solve_centralized_batch(cameras, empty)


def test_invalid_input_raises() -> None:
    rng = np.random.default_rng(6)
    cameras, matches, _ = noisy_problem(0)
    moments = pair_moments(matches)
    with pytest.raises(ValueError, match=r"rotations must be \(C, 3, 3\) for C = 3"):
        solve_centralized(cameras, moments[:3])
    for wrong in (np.diag([1.0, 1, -1]), 1.1 * np.eye(3), np.full((3, 3), np.nan)):
        with pytest.raises(ValueError, match=r"rotations\[2\] is not a rotation"):
            solve_centralized([*cameras[:2], wrong, cameras[3]], moments)
    point = np.tile(rng.normal(size=2), (5, 1))
    for empty in (PairMoments.zero(), PairMoments.from_matches(point, point)):
        with pytest.raises(ValueError, match="spread"):
            solve_centralized(cameras[:1], [empty])
