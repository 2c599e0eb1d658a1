"""Single camera: pseudo-orthogonality, global optimum, mirrored rotations, symmetries, unobservable directions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.status import Status
from sylpose.sylvester import so3
from sylpose.sylvester.equation import solve_sylvester
from sylpose.sylvester.one_camera import OneCameraSolution, solve_one_camera, solve_unconstrained
from sylpose.sylvester.orthographic import build_cost, compute_views
from tests.scenes import compute_angle

seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=12, deadline=None)
SQUARE = np.array([[1.0, 1], [1, -1], [-1, 1], [-1, -1]])
LINE = np.outer([-2.0, -1, 0.5, 2.5], [0.6, 0.8])
MIRROR = np.diag([1.0, 1, -1])


def random_rotation(rng: np.random.Generator) -> FloatArray:
    return np.asarray(Rotation.random(rng=rng).as_matrix())


def cloud(rng: np.random.Generator, n: int = 12) -> FloatArray:
    """Return points (2n, 3) in camera axes, each also at the opposite depth: depth is uncorrelated with the image."""
    points = rng.normal(size=(n, 3)) * rng.uniform(0.3, 2, size=3)
    return np.concatenate([points, points @ MIRROR])


def image_moments(
    rng: np.random.Generator, points: FloatArray, turn_seen: FloatArray, noise: float = 0.0
) -> PairMoments:
    """Return the moments of the orthographic images before and after a rotation in camera axes and a translation."""
    x, y = points[:, :2] + rng.normal(size=2), (points @ turn_seen.T)[:, :2] + rng.normal(size=2)
    return PairMoments.from_matches(x + noise * rng.normal(size=x.shape), y + noise * rng.normal(size=y.shape))


def noisy_moments(seed: int, noise: float = 0.1) -> tuple[FloatArray, PairMoments]:
    rng = np.random.default_rng(seed)
    return random_rotation(rng), image_moments(rng, cloud(rng), random_rotation(rng), noise)


def pseudo_orthogonality(solution: OneCameraSolution) -> float:
    N, m = solution.N, solution.m
    return float(np.abs(N @ N.T + np.outer(m, m) - np.eye(2)).max())


def same_pair(a: FloatArray, b: FloatArray) -> float:
    """Return the angle between two pairs of rotations, in the better matching order."""
    return min(max(compute_angle(a[0], b[k]), compute_angle(a[1], b[1 - k])) for k in (0, 1))


# --- The optimum ------------------------------------------------------------------------------------------------------


@given(seeds, st.floats(0, np.pi))
@quick
def test_exact_for_uncorrelated_depth(seed: int, turn_angle: float) -> None:
    rng = np.random.default_rng(seed)
    q, axis = random_rotation(rng), random_rotation(rng)[0]
    turn_seen = Rotation.from_rotvec(turn_angle * axis).as_matrix()
    for solve in (solve_one_camera, solve_unconstrained):
        solution = solve(q, image_moments(rng, cloud(rng), turn_seen), aim=False)
        np.testing.assert_allclose(solution.N, turn_seen[:2, :2], atol=1e-12)
        # m is the square root of 1 - c²: half of the digits if the rotation is in the image plane.
        expected = np.array([q.T @ turn_seen @ q, q.T @ MIRROR @ turn_seen @ MIRROR @ q])
        assert same_pair(solution.rotations, expected) < 1e-6
        assert np.abs(solution.multiplier).max() < 1e-10  # the constraint is inactive


@given(seeds, st.sampled_from([0.0, 0.1, 1.0]), st.sampled_from([0.3, 1.0, 3.0]))
@quick
def test_equals_the_global_minimum_on_so3(seed: int, noise: float, growth: float) -> None:
    """Two unrelated methods find it; `growth` covers all cases of the derivation."""
    rng = np.random.default_rng(seed)
    q, points, turn_seen = random_rotation(rng), cloud(rng), random_rotation(rng)
    x, y = points[:, :2], growth * (points @ turn_seen.T)[:, :2]
    moments = PairMoments.from_matches(x, y + noise * rng.normal(size=y.shape))
    solution = solve_one_camera(q, moments, aim=False)
    quadratic = build_cost(compute_views(q[None], [moments], aim=False))
    candidates, _, _ = so3.minimize(quadratic.H, quadratic.h)
    best = float(quadratic.cost(candidates[0]))
    assert abs(solution.cost * quadratic.scale - best) < 1e-8 * quadratic.size
    assert solution.status is not Status.NOT_CERTIFIED
    if len(candidates) > 1 and np.linalg.norm(solution.m) > 0.1:
        assert min(compute_angle(solution.rotations[0], c) for c in candidates) < 1e-5
        assert min(compute_angle(solution.rotations[1], c) for c in candidates) < 1e-5


@given(seeds)
@quick
def test_no_feasible_block_has_a_lower_cost(seed: int) -> None:
    q, moments = noisy_moments(seed, noise=0.5)
    solution = solve_one_camera(q, moments, aim=False)
    blocks = Rotation.random(5000, rng=np.random.default_rng(seed)).as_matrix()[:, :2, :2]
    scale = 2 * np.trace(moments.s_xx) / 9

    def cost(N: FloatArray) -> FloatArray:
        squares = np.trace(moments.s_yy) - 2 * (N * moments.s_yx).sum(axis=(-2, -1))
        return np.asarray((squares + (N @ moments.s_xx * N).sum(axis=(-2, -1))) / (2 * scale))

    assert solution.cost == pytest.approx(float(cost(solution.N)), abs=1e-12 * (1 + solution.cost))
    assert (cost(blocks) >= solution.cost - 1e-12).all()


# All branches: N too small, too large in one direction, too large in all (a rotation, a reflection); equal eigenvalues
# at the root (two equally good optima next to the m = 0 axis); y without any spread.
@pytest.mark.parametrize(
    ("x", "transform", "orthogonal"),
    [
        (SQUARE * [2, 1], [[0.6, 0.1], [0.2, 0.5]], False),
        (SQUARE * [2, 1], [[1.5, 0.1], [0.2, 0.3]], False),
        (SQUARE * [2, 1], [[1.3, -0.8], [0.8, 1.5]], True),
        (SQUARE * [2, 1], [[1.3, 0.8], [0.8, -1.5]], True),
        (SQUARE * [2, 1], [[0.7, 0], [0, 0.3]], False),
        (SQUARE * [1, 2], [[0.3, 0], [0, 0.7]], False),
        (SQUARE, [[0.5, -0.2], [0.2, 0.5]], False),
        (SQUARE * [2, 1], [[0, 0], [0, 0]], False),
        (SQUARE * [2, 1], [[1e-200, 0], [0, 0]], False),
    ],
)
def test_every_case_of_the_derivation(x: FloatArray, transform: FloatArray, orthogonal: bool) -> None:
    moments = PairMoments.from_matches(x, x @ np.asarray(transform).T)
    solution = solve_one_camera(np.eye(3), moments, aim=False)
    quadratic = build_cost(compute_views(np.eye(3)[None], [moments], aim=False))
    best = quadratic.cost(so3.minimize(quadratic.H, quadratic.h)[0][0]) / quadratic.scale
    assert solution.cost == pytest.approx(best, abs=1e-9)
    assert pseudo_orthogonality(solution) < 1e-14
    assert (np.linalg.norm(solution.m) == 0) == orthogonal
    gradient, _ = so3.compute_derivatives(quadratic.H, quadratic.h, solution.rotations)
    np.testing.assert_allclose(gradient, 0, atol=1e-12)


coordinates = arrays(np.float64, st.tuples(st.integers(1, 6), st.just(4)), elements=st.floats(-100, 100))


@given(coordinates)
@settings(max_examples=100, deadline=None)
def test_pseudo_orthogonality_for_any_data(xy: FloatArray) -> None:
    moments = PairMoments.from_matches(xy[:, :2], xy[:, 2:])
    for solve in (solve_one_camera, solve_unconstrained):
        for aim in (False, True):
            solution = solve(np.eye(3), moments, aim=aim)
            assert np.isfinite(solution.information).all()
            assert solution.status is not Status.NOT_CERTIFIED
            if np.isnan(solution.rotations).any():
                assert solution.unobservable.shape == (2, 3, 3)
                continue
            assert pseudo_orthogonality(solution) < 1e-14
            for rotation in solution.rotations:
                np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
                assert np.linalg.det(rotation) == pytest.approx(1)


@given(seeds, st.sampled_from([0.3, 1.0, 3.0]))
@quick
def test_result_solves_sylvesters_equation(seed: int, growth: float) -> None:
    q, moments = noisy_moments(seed)
    grown = PairMoments(moments.matrix * np.outer(*[np.kron([growth, growth, 1], [1, 1, 1])] * 2))
    solution = solve_one_camera(q, grown, aim=False)
    L, scale = solution.multiplier, 2 * np.trace(grown.s_xx) / 9
    np.testing.assert_allclose(solve_sylvester(L, grown.s_xx / scale, grown.s_yx / scale), solution.N, atol=1e-10)
    np.testing.assert_allclose(L, L.T, atol=1e-12)
    np.testing.assert_allclose(L @ solution.m, 0, atol=1e-10)


@given(seeds)
@quick
def test_solutions_are_mirror_images(seed: int) -> None:
    q, moments = noisy_moments(seed)
    solution = solve_one_camera(q, moments, aim=False)
    through_the_image = q.T @ MIRROR @ q
    np.testing.assert_allclose(
        solution.rotations[1], through_the_image @ solution.rotations[0] @ through_the_image, atol=1e-14
    )
    np.testing.assert_allclose((q @ solution.rotations[0] @ q.T)[:2, :2], solution.N, atol=1e-14)
    np.testing.assert_allclose((q @ solution.rotations[0] @ q.T)[:2, 2], solution.m, atol=1e-14)
    assert solution.m[0] >= 0
    quadratic = build_cost(compute_views(q[None], [moments], aim=False))
    for rotation in solution.rotations:
        assert quadratic.cost(rotation) / quadratic.scale == pytest.approx(solution.cost, abs=1e-12)


# --- Symmetries -------------------------------------------------------------------------------------------------------


@given(seeds)
@quick
def test_equivariant_under_a_change_of_world_frame(seed: int) -> None:
    q, moments = noisy_moments(seed)
    new_from_old = random_rotation(np.random.default_rng(seed + 1))
    for solve in (solve_one_camera, solve_unconstrained):
        a, b = solve(q, moments), solve(q @ new_from_old.T, moments)
        np.testing.assert_allclose(b.rotations, new_from_old @ a.rotations @ new_from_old.T, atol=1e-10)
        np.testing.assert_allclose(
            b.information, new_from_old @ a.information @ new_from_old.T, atol=1e-8 * np.abs(a.information).max()
        )
        np.testing.assert_array_equal(b.N, a.N)


@given(seeds, st.floats(-3, 3))
@quick
def test_equivariant_under_camera_roll(seed: int, roll: float) -> None:
    q, moments = noisy_moments(seed)
    Z = Rotation.from_rotvec([0, 0, roll]).as_matrix()
    a, b = solve_one_camera(q, moments), solve_one_camera(Z @ q, moments.transform(Z))
    assert same_pair(a.rotations, b.rotations) < 1e-8
    np.testing.assert_allclose(b.N, Z[:2, :2] @ a.N @ Z[:2, :2].T, atol=1e-9)
    np.testing.assert_allclose(b.multiplier, Z[:2, :2] @ a.multiplier @ Z[:2, :2].T, atol=1e-9)


@given(seeds, st.floats(1e-4, 1e4), st.floats(1e-3, 1e3))
@quick
def test_invariant_to_units_and_weights(seed: int, unit: float, weight: float) -> None:
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(2, 9, 2))
    a = solve_one_camera(np.eye(3), PairMoments.from_matches(x, y), aim=False)
    b = solve_one_camera(np.eye(3), PairMoments.from_matches(unit * x, unit * y, np.full(len(x), weight)), aim=False)
    np.testing.assert_allclose(b.rotations, a.rotations, atol=1e-8)
    assert b.cost == pytest.approx(a.cost, rel=1e-8)
    noise = weight * a.noise_information
    np.testing.assert_allclose(b.noise_information, noise, atol=1e-6 * noise.max())


@given(seeds)
@quick
def test_swapped_frames_give_the_inverse_without_noise(seed: int) -> None:
    """For a cloud as deep as wide: depth must be uncorrelated with the image in the other frame, too."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(10, 3))
    points -= points.mean(axis=0)
    points = points @ np.linalg.inv(np.linalg.cholesky(points.T @ points)).T
    q, turn_seen = random_rotation(rng), random_rotation(rng)
    x, y = points[:, :2], (points @ turn_seen.T)[:, :2]
    a = solve_one_camera(q, PairMoments.from_matches(x, y), aim=False)
    b = solve_one_camera(q, PairMoments.from_matches(y, x), aim=False)
    assert same_pair(np.swapaxes(b.rotations, 1, 2), a.rotations) < 1e-6


def test_swapped_frames_give_nearly_the_inverse_with_noise() -> None:
    """Only y is modeled as noisy, so the results differ, but by less than their errors."""
    apart, errors = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        points = rng.normal(size=(40, 3))
        turn_seen = Rotation.from_rotvec([0.5, 0.3, 0.4]).as_matrix()
        x, y = (p[:, :2] + 0.02 * rng.normal(size=(40, 2)) for p in (points, points @ turn_seen.T))
        a = solve_one_camera(np.eye(3), PairMoments.from_matches(x, y), aim=False)
        b = solve_one_camera(np.eye(3), PairMoments.from_matches(y, x), aim=False)
        apart.append(same_pair(np.swapaxes(b.rotations, 1, 2), a.rotations))
        errors.append(min(compute_angle(r, turn_seen) for r in a.rotations))
    assert min(apart) > 1e-6
    assert np.median(apart) < 2 * np.median(errors)


# --- The baseline -----------------------------------------------------------------------------------------------------


@given(seeds, st.sampled_from([0.05, 0.5]))
@quick
def test_constrained_cost_is_at_most_the_projected_one(seed: int, noise: float) -> None:
    q, moments = noisy_moments(seed, noise)
    assert solve_one_camera(q, moments).cost <= solve_unconstrained(q, moments).cost + 1e-12


@given(seeds)
@quick
def test_projected_block_is_the_nearest(seed: int) -> None:
    q, moments = noisy_moments(seed, 0.5)
    solution = solve_unconstrained(q, moments, aim=False)
    free = solve_sylvester(np.zeros((2, 2)), moments.s_xx, moments.s_yx)
    assert pseudo_orthogonality(solution) < 1e-14
    blocks = Rotation.random(5000, rng=np.random.default_rng(seed)).as_matrix()[:, :2, :2]
    distances = np.linalg.norm(blocks - free, axis=(1, 2))
    assert np.linalg.norm(solution.N - free) <= distances.min() + 1e-12


def test_constrained_estimate_is_more_accurate() -> None:
    """Long, narrow sets of points, which hardly determine one column of N."""
    constrained: list[float] = []
    adjusted: list[float] = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        points = rng.normal(size=(12, 3)) * [1, 0.2, 0.5]
        points = np.concatenate([points, points @ MIRROR])
        turn_seen = random_rotation(rng)
        moments = image_moments(rng, points, turn_seen, noise=0.05)
        for errors, solve in ((constrained, solve_one_camera), (adjusted, solve_unconstrained)):
            errors.append(min(compute_angle(r, turn_seen) for r in solve(np.eye(3), moments, aim=False).rotations))
    assert np.mean(constrained) < 0.95 * np.mean(adjusted)
    assert np.median(constrained) < 0.95 * np.median(adjusted)


# --- Observability ---------------------------------------------------------------------------------------------------


@given(seeds)
@quick
def test_information_against_finite_differences(seed: int) -> None:
    q, moments = noisy_moments(seed)
    for solve in (solve_one_camera, solve_unconstrained):
        solution = solve(q, moments)
        quadratic = build_cost(compute_views(q[None], [moments]))
        unit = 1 / float(quadratic.variance(quadratic.cost(solution.rotations[0])))
        for rotation, information in zip(solution.rotations, solution.noise_information, strict=True):

            def cost(w: FloatArray, rotation: FloatArray = rotation, quadratic: so3.QuadraticCost = quadratic) -> float:
                return float(quadratic.cost(Rotation.from_rotvec(w).as_matrix() @ rotation))

            e = 1e-4 * np.eye(3)
            numeric = [[(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / 4e-8 for a in e] for b in e]
            np.testing.assert_allclose(information, np.array(numeric) * unit, atol=1e-5 * unit * float(quadratic.scale))


def test_in_plane_rotation_has_equal_solutions() -> None:
    rng = np.random.default_rng(0)
    q = random_rotation(rng)
    for roll in (0.0, 0.4, np.pi):
        turn_seen = Rotation.from_rotvec([0, 0, roll]).as_matrix()
        solution = solve_one_camera(q, image_moments(rng, cloud(rng), turn_seen), aim=False)
        assert solution.status is Status.ROTATION_NOT_OBSERVABLE
        assert compute_angle(solution.rotations[0], solution.rotations[1]) < 1e-6
        assert compute_angle(solution.rotations[0], q.T @ turn_seen @ q) < 1e-6
        assert solution.unobservable.shape == (2, 2, 3)
        np.testing.assert_allclose(solution.unobservable @ q[2], 0, atol=1e-6)  # both are out-of-plane rotations


def test_out_of_plane_rotation_is_observed_to_second_order() -> None:
    """Its information decreases with its square; the in-plane rotation stays observable."""
    rng = np.random.default_rng(1)
    points = cloud(rng)
    weakest, strongest = [], []
    for turn_angle in (0.4, 0.04):
        moments = image_moments(
            np.random.default_rng(2), points, Rotation.from_rotvec([turn_angle, 0, 0.2]).as_matrix(), 0
        )
        values = np.linalg.eigvalsh(solve_one_camera(np.eye(3), moments, aim=False).noise_information[0])
        # In units of the variance, which here is that of the ignored depth.
        weakest.append(values[0] / values[2])
        strongest.append(values[2])
    assert weakest[1] / weakest[0] == pytest.approx(0.01, rel=0.2)
    assert strongest[1] > strongest[0]


@pytest.mark.parametrize(
    ("y", "direction"),
    [
        (LINE, [0.6, 0.8, 0]),  # static
        (LINE[:, ::-1], [0.8, 0.6, 0]),  # in-plane rotation
        (0.5 * LINE, [0.3, 0.4, np.sqrt(0.75)]),  # out-of-plane rotation
        (2 * LINE[:, ::-1], [0.8, 0.6, 0]),  # longer than any rotation allows
        (-LINE, [-0.6, -0.8, 0]),  # half a turn
    ],
)
def test_collinear_points_do_not_observe_rotation_about_the_line(y: FloatArray, direction: FloatArray) -> None:
    """The direction of the line is observable; the rotation about it is minimal."""
    moments = PairMoments.from_matches(LINE + 0.3, y - 0.2)
    solution = solve_one_camera(np.eye(3), moments, aim=False)
    assert solution.status is Status.ROTATION_NOT_OBSERVABLE
    assert pseudo_orthogonality(solution) < 1e-14
    before, after = np.array([0.6, 0.8, 0]), np.asarray(direction)
    # Either mirrored solution.
    ends = solution.rotations @ before
    np.testing.assert_allclose(np.abs(ends), np.abs([after, after]), atol=1e-7)
    np.testing.assert_allclose(ends[:, :2], [after[:2], after[:2]], atol=1e-12)
    for rotation, end, unseen in zip(solution.rotations, ends, solution.unobservable, strict=True):
        assert compute_angle(rotation, np.eye(3)) == pytest.approx(np.arccos(np.clip(end @ before, -1, 1)), abs=1e-7)
        np.testing.assert_allclose(unseen.T @ (unseen @ end), end, atol=1e-6)  # the line is not observable
    S, T, scale = moments.s_xx, moments.s_yx, 2 * np.trace(moments.s_xx) / 9
    np.testing.assert_allclose(solution.N @ S + scale * solution.multiplier @ solution.N, T, atol=1e-12)
    baseline = solve_unconstrained(np.eye(3), moments, aim=False)
    assert baseline.status is Status.ROTATION_NOT_OBSERVABLE
    assert baseline.cost >= solution.cost - 1e-12


def test_points_without_spread() -> None:
    point = np.full((5, 2), 0.3)
    for moments in (PairMoments.zero(), PairMoments.from_matches(point, point + 0.1)):
        for solve in (solve_one_camera, solve_unconstrained):
            solution = solve(np.eye(3), moments)
            assert solution.status is Status.ROTATION_NOT_OBSERVABLE
            assert not solution.status.has_pose
            assert np.isnan(solution.rotations).all()
            assert solution.unobservable.shape == (2, 3, 3)
            assert not solution.information.any()


def test_small_object_is_orthographic_about_its_mean_ray() -> None:
    rng = np.random.default_rng(3)
    q, turn = random_rotation(rng), Rotation.from_rotvec([0.3, -0.2, 0.4]).as_matrix()
    errors = []
    for size in (1e-2, 1e-3):
        center = q.T @ [0.8, -0.5, 2]
        points = size * rng.normal(size=(30, 3))
        ray = center / np.linalg.norm(center)
        points = np.concatenate([points, points - 2 * np.outer(points @ ray, ray)])
        x, y = ((p + center) @ q.T for p in (points, points @ turn.T))
        moments = PairMoments.from_matches(x[:, :2] / x[:, 2:], y[:, :2] / y[:, 2:])
        errors.append(min(compute_angle(r, turn) for r in solve_one_camera(q, moments).rotations))
        assert min(compute_angle(r, turn) for r in solve_one_camera(q, moments, aim=False).rotations) > 3 * errors[-1]
    assert errors[1] < 2e-3


def test_invalid_input_raises() -> None:
    _, moments = noisy_moments(0)
    for solve in (solve_one_camera, solve_unconstrained):
        with pytest.raises(ValueError, match=r"rotation must be \(3, 3\), got shape \(1, 3, 3\)"):
            solve(np.eye(3)[None], moments)
        for wrong in (np.diag([1.0, 1, -1]), 1.1 * np.eye(3), np.full((3, 3), np.nan)):
            with pytest.raises(ValueError, match=r"rotation (is not a rotation|has values that are not finite)"):
                solve(wrong, moments)
