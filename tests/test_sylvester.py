"""The paper's equation and its centralised estimator: exactness, symmetries, certificate, derivatives, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import solve_sylvester as scipy_solve_sylvester
from scipy.spatial.transform import Rotation

from sylpose import so3
from sylpose.equation import SingularSylvesterError, solve_generalized_sylvester, solve_sylvester
from sylpose.moments import PairMoments
from sylpose.orthographic import quadratic_of, views_of
from sylpose.sylvester import (
    CentralizedSolution,
    solve_centralized,
    translation_from_means,
)

FloatArray = NDArray[np.float64]
Matches = list[tuple[FloatArray, FloatArray]]
seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=25, deadline=None)


def random_rotations(rng: np.random.Generator, n: int) -> FloatArray:
    return np.asarray(Rotation.random(n, rng=rng).as_matrix())


def angle(a: FloatArray, b: FloatArray) -> float:
    return float(Rotation.from_matrix(a @ b.T).magnitude())


def general_cameras(rng: np.random.Generator, n: int) -> FloatArray:
    """Cameras whose first three viewing directions are far from one plane (mutually orthogonal, then disturbed)."""
    base = np.array([np.roll(np.eye(3), k, axis=0) for k in range(3)])  # z axes along z, y, x
    near = Rotation.from_rotvec(0.3 * rng.uniform(-1, 1, size=(3, 3))).as_matrix()
    return np.asarray(np.concatenate([base @ near, random_rotations(rng, n - 3)]) @ random_rotations(rng, 1)[0])


def orthographic(
    rng: np.random.Generator, cameras: FloatArray, turn: FloatArray, noise: float = 0.0, even: bool = True, n: int = 12
) -> Matches:
    """Per camera the orthographic images of its own points. `even`: every point also at the opposite depth, the
    condition under which the estimator is exact (depth uncorrelated with the image)."""
    out = []
    for q in cameras:
        points = rng.normal(size=(n, 3)) * rng.uniform(0.3, 2, size=3)
        if even:
            points = np.concatenate([points, points * [1, 1, -1]])
        x, y = points[:, :2], (points @ (q @ turn @ q.T).T)[:, :2]
        offset = rng.normal(size=(2, 1, 2))
        out.append((x + offset[0] + noise * rng.normal(size=x.shape), y + offset[1] + noise * rng.normal(size=y.shape)))
    return out


def moments_of(matches: Matches) -> list[PairMoments]:
    return [PairMoments.from_matches(x, y) for x, y in matches]


def noisy_problem(seed: int, n: int = 4) -> tuple[FloatArray, Matches, FloatArray]:
    rng = np.random.default_rng(seed)
    cameras, turn = general_cameras(rng, n), random_rotations(rng, 1)[0]
    return cameras, orthographic(rng, cameras, turn, noise=0.05), turn


def same(a: CentralizedSolution, b: CentralizedSolution, tolerance: float = 1e-8) -> bool:
    return a.certified == b.certified and angle(a.rotation, b.rotation) < tolerance


# --- The equations ----------------------------------------------------------------------------------------------------


@given(seeds, st.integers(1, 4), st.integers(1, 4), st.sampled_from([(), (3,), (2, 3)]))
@quick
def test_two_sided_equation_solves_and_equals_scipy(seed: int, m: int, n: int, batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(*batch, m, m)) + 6 * np.eye(m)
    b, c = rng.normal(size=(n, n)) + 6 * np.eye(n), rng.normal(size=(*batch, m, n))
    solution = solve_sylvester(a, b, c)
    np.testing.assert_allclose(a @ solution + solution @ b, c, atol=1e-12)
    for i in np.ndindex(*batch):
        np.testing.assert_allclose(solution[i], scipy_solve_sylvester(a[i], b, c[i]), atol=1e-12)


@given(seeds, st.integers(1, 3), st.integers(1, 3), st.integers(1, 4), st.sampled_from([(), (2,)]))
@quick
def test_generalized_equation_solves(seed: int, m: int, n: int, terms: int, batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(seed)
    # Positive definite terms: the sum of their Kronecker products is regular.
    half_a, half_b = rng.normal(size=(terms, *batch, m, m)), rng.normal(size=(terms, n, n))
    a = half_a @ np.swapaxes(half_a, -1, -2) + 0.1 * np.eye(m)
    b = half_b @ np.swapaxes(half_b, -1, -2) + 0.1 * np.eye(n)
    x = rng.normal(size=(*batch, m, n))
    c = sum((a[k] @ x @ b[k] for k in range(terms)), start=np.zeros(()))
    np.testing.assert_allclose(solve_generalized_sylvester(list(a), list(b), c), x, atol=1e-8)


def test_the_two_sided_equation_is_a_generalized_one() -> None:
    rng = np.random.default_rng(0)
    a, b, c = rng.normal(size=(2, 2)), rng.normal(size=(3, 3)), rng.normal(size=(2, 3))
    general = solve_generalized_sylvester([a, np.eye(2)], [np.eye(3), b], c)
    np.testing.assert_allclose(general, solve_sylvester(a, b, c), atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_a_shared_eigenvalue_is_refused_and_named(seed: int) -> None:
    rng = np.random.default_rng(seed)
    u, v = rng.normal(size=(3, 3)), rng.normal(size=(2, 2))
    a = u @ np.diag([1.0, 2.5, 4.0]) @ np.linalg.inv(u)
    b = v @ np.diag([-2.5, 7.0]) @ np.linalg.inv(v)
    with pytest.raises(SingularSylvesterError, match=r"2\.5(0000+\d*)? of A with 2\.5|2\.4999+\d* of"):
        solve_sylvester(a, b, np.ones((3, 2)))


def test_the_singular_member_of_a_batch_is_named() -> None:
    a = np.array([np.diag([1.0, 2.0]), np.diag([1.0, 3.0])])
    with pytest.raises(
        SingularSylvesterError, match=r"index 1 of the batch.*: eigenvalues collide, 3 of A with 3 of -B$"
    ):
        solve_sylvester(a, np.diag([-3.0, 5.0]), np.ones((2, 2)))


def test_a_singular_generalized_equation_is_refused_with_its_rank() -> None:
    a = np.diag([1.0, 1.0, 0.0])  # one camera sees nothing along its axis
    with pytest.raises(SingularSylvesterError, match="rank 4 for 9 unknowns"):
        solve_generalized_sylvester([a], [a], np.ones((3, 3)))
    assert issubclass(SingularSylvesterError, ValueError)


def test_bad_equations_are_refused() -> None:
    eye = np.eye(2)
    with pytest.raises(ValueError, match="A must be square"):
        solve_sylvester(np.ones((2, 3)), eye, eye)
    with pytest.raises(ValueError, match="B must be a finite matrix"):
        solve_sylvester(eye, eye * np.nan, eye)
    with pytest.raises(ValueError, match="C must be 2x2"):
        solve_sylvester(eye, eye, np.ones((3, 2)))
    with pytest.raises(ValueError, match="equally many"):
        solve_generalized_sylvester([eye], [], eye)
    with pytest.raises(ValueError, match="one size"):
        solve_generalized_sylvester([eye, np.eye(3)], [eye, eye], eye)


# --- All cameras ------------------------------------------------------------------------------------------------------


@given(seeds, st.integers(3, 6), st.floats(0, np.pi))
@quick
def test_exact_and_certified_where_depth_is_uncorrelated_with_the_image(seed: int, n: int, turn_angle: float) -> None:
    rng = np.random.default_rng(seed)
    cameras, axis = general_cameras(rng, n), random_rotations(rng, 1)[0, 0]
    turn = Rotation.from_rotvec(turn_angle * axis).as_matrix()
    solution = solve_centralized(cameras, moments_of(orthographic(rng, cameras, turn)), aim=False)
    assert solution.certified
    assert solution.converged
    assert angle(solution.rotation, turn) < 1e-8
    assert np.abs(solution.multiplier).max() < 1e-8  # nothing holds the unconstrained optimum back


@given(seeds)
@quick
def test_exact_for_one_cloud_seen_by_all_when_its_spread_is_the_same_in_every_direction(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cameras, turn = general_cameras(rng, 3), random_rotations(rng, 1)[0]
    points = rng.normal(size=(20, 3))
    points -= points.mean(axis=0)
    points = points @ np.linalg.inv(np.linalg.cholesky(points.T @ points)).T
    moments = [PairMoments.from_matches((points @ q.T)[:, :2], (points @ turn.T @ q.T)[:, :2]) for q in cameras]
    assert angle(solve_centralized(cameras, moments, aim=False).rotation, turn) < 1e-8


def test_correlated_depth_biases_it() -> None:
    """The condition above is needed: the same without it is not exact, noise or not."""
    rng = np.random.default_rng(1)
    cameras, turn = general_cameras(rng, 4), Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix()
    solution = solve_centralized(cameras, moments_of(orthographic(rng, cameras, turn, even=False)), aim=False)
    assert angle(solution.rotation, turn) > 1e-3


@given(seeds)
@quick
def test_equivariant_under_a_change_of_world_frame(seed: int) -> None:
    cameras, matches, _ = noisy_problem(seed)
    new_from_old = random_rotations(np.random.default_rng(seed + 1), 1)[0]
    a = solve_centralized(cameras, moments_of(matches))
    b = solve_centralized(cameras @ new_from_old.T, moments_of(matches))
    assert a.certified == b.certified
    assert angle(b.rotation, new_from_old @ a.rotation @ new_from_old.T) < 1e-8
    np.testing.assert_allclose(
        b.information, new_from_old @ a.information @ new_from_old.T, atol=1e-6 * np.abs(a.information).max()
    )
    np.testing.assert_allclose(b.multiplier, new_from_old @ a.multiplier @ new_from_old.T, atol=1e-7)


@given(seeds)
@quick
def test_invariant_to_the_order_and_grouping_of_matches_and_cameras(seed: int) -> None:
    cameras, matches, _ = noisy_problem(seed)
    rng = np.random.default_rng(seed)
    reference = solve_centralized(cameras, moments_of(matches))
    order = rng.permutation(len(cameras))
    assert same(reference, solve_centralized(cameras[order], [moments_of(matches)[c] for c in order]))
    shuffled = [(x[p], y[p]) for x, y in matches for p in [rng.permutation(len(x))]]
    parts = [PairMoments.from_matches(x[:7], y[:7]) + PairMoments.from_matches(x[7:], y[7:]) for x, y in shuffled]
    assert same(reference, solve_centralized(cameras, parts))
    silent = solve_centralized(np.concatenate([cameras, cameras[:1]]), [*moments_of(matches), PairMoments.zero()])
    assert same(reference, silent)


@given(seeds)
@quick
def test_two_cameras_of_equal_rotation_are_one_if_their_means_are_equal(seed: int) -> None:
    """Not otherwise: each camera's points are centred by its own mean."""
    cameras, matches, _ = noisy_problem(seed)
    (x0, y0), (x1, y1) = matches[0], matches[1]
    x1, y1 = x1 - x1.mean(axis=0) + x0.mean(axis=0), y1 - y1.mean(axis=0) + y0.mean(axis=0)
    first, second = moments_of([(x0, y0), (x1, y1)])
    rest = moments_of(matches[2:])
    apart = solve_centralized(cameras[[0, 0, 2, 3]], [first, second, *rest])
    together = solve_centralized(cameras[[0, 2, 3]], [first + second, *rest])
    assert same(apart, together, 1e-7)
    assert together.cost == pytest.approx(apart.cost, rel=1e-9)


@given(seeds, st.floats(1e-4, 1e4), st.floats(1e-3, 1e3))
@quick
def test_units_and_weights_change_nothing(seed: int, unit: float, weight: float) -> None:
    cameras, matches, _ = noisy_problem(seed)
    a = solve_centralized(cameras, moments_of(matches), aim=False)
    b = solve_centralized(
        cameras, [PairMoments.from_matches(unit * x, unit * y, np.full(len(x), weight)) for x, y in matches], aim=False
    )
    assert same(a, b)
    assert b.cost == pytest.approx(a.cost, rel=1e-6)
    np.testing.assert_allclose(b.multiplier, a.multiplier, atol=1e-7)
    # Residual variance and spread scale together, and so do the weights of both: information counts the weight once.
    np.testing.assert_allclose(
        b.information, weight * a.information, rtol=1e-5, atol=1e-6 * weight * a.information.max()
    )


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("seed", range(3))
def test_no_rotation_is_better(seed: int, n: int) -> None:
    """1,000 random rotations, the best of them polished: none beats the answer, certified or not."""
    rng = np.random.default_rng(seed)
    cameras, turn = random_rotations(rng, n), Rotation.from_rotvec(rng.normal(size=3) * 0.4).as_matrix()
    moments = moments_of(orthographic(rng, cameras, turn, noise=0.1, even=False))
    solution = solve_centralized(cameras, moments, aim=False)
    assert solution.converged
    assert not (n == 1 and solution.certified)
    q = quadratic_of(views_of(cameras, moments, aim=False))
    starts = random_rotations(rng, 1000)
    costs = so3.cost_of(q.H, q.h, starts)
    for start in starts[np.argsort(costs)[:20]]:
        for _ in range(30):
            gradient, hessian = so3.derivatives(q.H, q.h, start)
            values, vectors = np.linalg.eigh(hessian)
            step = -vectors @ (vectors.T @ gradient / np.maximum(np.abs(values), 0.5))
            start = Rotation.from_rotvec(step).as_matrix() @ start
        assert so3.cost_of(q.H, q.h, start) + q.constant >= solution.cost - 1e-9
    if solution.certified:
        # What the certificate promises, by its own formula.
        K = q.H + np.kron(solution.multiplier, np.eye(3))
        difference = (starts - solution.rotation).reshape(-1, 9)
        gap = costs + q.constant - solution.cost
        np.testing.assert_allclose(gap, 0.5 * np.einsum("ni,ij,nj->n", difference, K, difference), atol=1e-9)
        assert (gap > 0).all()


def test_four_cameras_are_certified_and_the_answer_solves_sylvesters_equation() -> None:
    for seed in range(10):
        cameras, matches, turn = noisy_problem(seed)
        moments = moments_of(matches)
        solution = solve_centralized(cameras, moments, aim=False)
        assert solution.certified
        assert len(solution.candidates) == 1
        assert angle(solution.rotation, turn) < 0.1
        np.testing.assert_allclose(solution.rotation @ solution.rotation.T, np.eye(3), atol=1e-10)
        p = np.eye(3)[:2]
        a = [q.T @ p.T @ p @ q for q in cameras]
        b = [q.T @ p.T @ m.s_xx @ p @ q for q, m in zip(cameras, moments, strict=True)]
        c = sum((q.T @ p.T @ m.s_yx @ p @ q for q, m in zip(cameras, moments, strict=True)), start=np.zeros(()))
        scale = sum(np.trace(np.kron(*ab)) for ab in zip(a, b, strict=True)) / 9
        again = solve_generalized_sylvester([*a, scale * solution.multiplier], [*b, np.eye(3)], c)
        np.testing.assert_allclose(again, solution.rotation, atol=1e-8)


@given(seeds)
@quick
def test_derivatives_against_finite_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(9, 9))
    H, h, R = half @ half.T / 9, rng.normal(size=9), random_rotations(rng, 1)[0]

    def cost(w: FloatArray) -> float:
        return float(so3.cost_of(H, h, Rotation.from_rotvec(w).as_matrix() @ R))

    gradient, hessian = so3.derivatives(H, h, R)
    e = 1e-4 * np.eye(3)
    np.testing.assert_allclose(gradient, [(cost(d) - cost(-d)) / 2e-4 for d in e], atol=1e-6)
    numeric = [[(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / 4e-8 for a in e] for b in e]
    np.testing.assert_allclose(hessian, numeric, atol=1e-5)


@given(seeds)
@quick
def test_with_full_depth_it_is_kabsch(seed: int) -> None:
    """A = I, B = S_xx (3x3): points known in 3D in both frames."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(10, 3))
    y = x @ random_rotations(rng, 1)[0].T + 0.2 * rng.normal(size=x.shape)
    H, h = np.kron(np.eye(3), x.T @ x), (y.T @ x).ravel()
    scale = np.trace(H) / 9
    candidates, _, _ = so3.minimize(H / scale, h / scale)
    expected, _ = Rotation.align_vectors(y, x)
    assert angle(candidates[0], expected.as_matrix()) < 1e-8


@given(seeds, st.floats(0.2, 1.2))
@quick
def test_one_camera_gives_both_mirrored_turns_and_no_certificate(seed: int, turn_angle: float) -> None:
    rng = np.random.default_rng(seed)
    q = random_rotations(rng, 1)[0]
    sideways = rng.uniform(0, 2 * np.pi)
    turn_seen = Rotation.from_rotvec([0, 0, rng.uniform(-1, 1)]) * Rotation.from_rotvec(
        turn_angle * np.array([np.cos(sideways), np.sin(sideways), 0])
    )
    turn = q.T @ turn_seen.as_matrix() @ q
    solution = solve_centralized(q[None], moments_of(orthographic(rng, q[None], turn)), aim=False)
    mirror = q.T @ np.diag([1, 1, -1]) @ q
    assert not solution.certified
    assert np.abs(solution.costs[:2] - solution.costs[0]).max() < 1e-9
    assert (solution.costs[2:] > solution.costs[0] + 1e-6).all()  # far-off local minima, where there are any
    for expected in (turn, mirror @ turn @ mirror):
        assert min(angle(c, expected) for c in solution.candidates[:2]) < 1e-6


def test_cameras_in_one_plane_do_not_see_a_turn_about_its_normal() -> None:
    """A ring of cameras and the turn of a turntable: both signs fit, and without a turn its size is not known at all."""
    rng = np.random.default_rng(3)
    x_axis_down = np.array([[0, 0, -1], [1, 0, 0], [0, -1, 0]], float)  # looks along -y, the world's z is up
    cameras = np.array([x_axis_down @ Rotation.from_rotvec([0, 0, a]).as_matrix() for a in (0.0, 1.0, 2.2, 4.0)])
    assert np.abs(cameras[:, 2, 2]).max() < 1e-12
    turn = Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    solution = solve_centralized(cameras, moments_of(orthographic(rng, cameras, turn)), aim=False)
    assert not solution.certified
    assert sorted(angle(c, turn) < 1e-6 for c in solution.candidates) == [False, True]
    assert min(angle(c, turn.T) for c in solution.candidates) < 1e-6
    still = solve_centralized(cameras, moments_of(orthographic(rng, cameras, np.eye(3))), aim=False)
    values, vectors = np.linalg.eigh(still.information)
    assert values[0] < 1e-5 * values[1]
    assert abs(vectors[2, 0]) > 0.999


def test_no_motion_from_one_camera_is_one_candidate() -> None:
    rng = np.random.default_rng(4)
    q = random_rotations(rng, 1)
    solution = solve_centralized(q, moments_of(orthographic(rng, q, np.eye(3))), aim=False)
    assert len(solution.candidates) == 1
    assert angle(solution.rotation, np.eye(3)) < 1e-3


def test_points_that_fall_together_give_no_false_certificate() -> None:
    """y without spread: h = 0, so that nothing says which way the object turned."""
    rng = np.random.default_rng(7)
    cameras = general_cameras(rng, 3)
    moments = [PairMoments.from_matches(rng.normal(size=(9, 2)), np.zeros((9, 2))) for _ in cameras]
    solution = solve_centralized(cameras, moments)
    assert not solution.certified
    assert np.isfinite(solution.information).all()


def perspective(
    rng: np.random.Generator, cameras: FloatArray, centers: FloatArray, turn: FloatArray, d: FloatArray, size: float
) -> list[PairMoments]:
    """A small object at the origin, seen in perspective; every camera's points even in depth."""
    out = []
    for q, o in zip(cameras, centers, strict=True):
        ray = -o / np.linalg.norm(o)
        points = size * rng.normal(size=(20, 3))
        points = np.concatenate([points, points - 2 * np.outer(points @ ray, ray)])
        seen = [(p - o) @ q.T for p in (points, points @ turn.T + d)]
        x, y = (s[:, :2] / s[:, 2:] for s in seen)
        out.append(PairMoments.from_matches(x, y))
    return out


def test_aimed_cameras_make_small_objects_orthographic_wherever_they_are_in_the_image() -> None:
    rng = np.random.default_rng(5)
    cameras = general_cameras(rng, 4)
    off_axis = np.array([[0.3, 0.2, 1], [-0.4, 0.1, 1], [0.1, -0.5, 1], [0.3, 0.3, 1]])
    centers = -np.einsum("cji,cj->ci", cameras, 2 * off_axis)
    turn = Rotation.from_rotvec([0.2, -0.1, 0.15]).as_matrix()
    errors = []
    for size in (1e-2, 1e-3):
        moments = perspective(rng, cameras, centers, turn, np.zeros(3), size)
        errors.append(angle(solve_centralized(cameras, moments).rotation, turn))
        assert angle(solve_centralized(cameras, moments, aim=False).rotation, turn) > 10 * errors[-1]
    assert errors[1] < 3e-4


def test_bad_input_to_the_centralised_estimator_is_refused() -> None:
    rng = np.random.default_rng(6)
    cameras, matches, _ = noisy_problem(0)
    moments = moments_of(matches)
    with pytest.raises(ValueError, match=r"rotations must be \(C, 3, 3\) for C = 3"):
        solve_centralized(cameras, moments[:3])
    for wrong in (np.diag([1.0, 1, -1]), 1.1 * np.eye(3), np.full((3, 3), np.nan)):
        with pytest.raises(ValueError, match=r"rotations\[2\] is not a rotation"):
            solve_centralized([*cameras[:2], wrong, cameras[3]], moments)
    point = np.tile(rng.normal(size=2), (5, 1))
    for empty in (PairMoments.zero(), PairMoments.from_matches(point, point)):
        with pytest.raises(ValueError, match="spread"):
            solve_centralized(cameras[:1], [empty])


# --- Translation ------------------------------------------------------------------------------------------------------


def moved_means(
    rng: np.random.Generator, n: int, noise: float = 0.0
) -> tuple[FloatArray, FloatArray, list[PairMoments], FloatArray, FloatArray, FloatArray]:
    """Cameras whose mean surface point is at the centre's depth, which the model holds for."""
    g, d, turn = (
        rng.normal(size=3),
        0.1 * rng.normal(size=3),
        Rotation.from_rotvec(0.3 * rng.normal(size=3)).as_matrix(),
    )
    cameras, centers, moments = random_rotations(rng, n), [], []
    for q in cameras:
        s = g + 0.1 * rng.normal(size=3) @ np.diag([1, 1, 0]) @ q
        o = g - q.T @ [0.2, -0.1, 2.0]
        x, y = (p[:2] / p[2] for p in (q @ (s - o), q @ (g + turn @ (s - g) + d - o)))
        spread = 0.02 * rng.normal(size=(10, 2))
        spread -= spread.mean(axis=0)
        centers.append(o)
        seen_turn = (q @ turn @ q.T)[:2, :2]
        moments.append(
            PairMoments.from_matches(x + spread, y + spread @ seen_turn.T + noise * rng.normal(size=(10, 2)))
        )
    return cameras, np.array(centers), moments, turn, g, d


@given(seeds, st.integers(2, 5))
@quick
def test_displacement_is_exact_under_its_model(seed: int, n: int) -> None:
    cameras, centers, moments, turn, g, expected = moved_means(np.random.default_rng(seed), n)
    d, information = translation_from_means(cameras, centers, moments, turn, g)
    cond = np.linalg.cond(information)
    np.testing.assert_allclose(d, expected, atol=1e-12 * max(1.0, cond))
    np.testing.assert_allclose(information, information.T)


def test_one_camera_sees_no_displacement_along_its_ray() -> None:
    cameras, centers, moments, turn, g, expected = moved_means(np.random.default_rng(0), 1)
    d, information = translation_from_means(cameras, centers, moments, turn, g)
    ray = cameras[0].T @ [*moments[0].mean_y, 1.0]
    ray /= np.linalg.norm(ray)
    values, vectors = np.linalg.eigh(information)
    assert abs(values[0]) < 1e-12 * values[1]
    assert abs(vectors[:, 0] @ ray) == pytest.approx(1)
    assert abs(d @ ray) < 1e-12
    # Across the ray it is right: what is left of the truth moves the seen point along the ray only.
    np.testing.assert_allclose(np.cross(expected - d, ray), 0, atol=1e-12)


def test_displacement_information_agrees_with_sampling() -> None:
    normalised = []
    for seed in range(150):
        cameras, centers, moments, turn, g, expected = moved_means(np.random.default_rng(seed), 4, noise=1e-3)
        d, information = translation_from_means(cameras, centers, moments, turn, g)
        normalised.append((d - expected) @ information @ (d - expected))
    # 3 degrees of freedom; less is fine, for what the spread's own depth leaves in the residuals counts as noise too.
    assert np.median(normalised) < 3


def test_displacement_does_not_depend_on_silent_cameras_or_the_frame() -> None:
    rng = np.random.default_rng(1)
    cameras, centers, moments, turn, g, _ = moved_means(rng, 3, noise=1e-3)
    d, information = translation_from_means(cameras, centers, moments, turn, g)
    more = translation_from_means(
        np.concatenate([cameras, cameras[:1]]), [*centers, g + 9], [*moments, PairMoments.zero()], turn, g
    )
    np.testing.assert_allclose(more[0], d, atol=1e-12)
    new, shift = random_rotations(rng, 1)[0], rng.normal(size=3)
    turned = translation_from_means(
        cameras @ new.T, centers @ new.T + shift, moments, new @ turn @ new.T, new @ g + shift
    )
    np.testing.assert_allclose(turned[0], new @ d, atol=1e-10)
    np.testing.assert_allclose(turned[1], new @ information @ new.T, rtol=1e-6, atol=1e-8 * np.abs(information).max())


def test_bad_input_to_the_displacement_is_refused() -> None:
    cameras, centers, moments, turn, g, _ = moved_means(np.random.default_rng(2), 2)
    with pytest.raises(ValueError, match=r"centers must be \(2, 3\)"):
        translation_from_means(cameras, centers[:1], moments, turn, g)
    with pytest.raises(ValueError, match="rotation"):
        translation_from_means(cameras, centers, moments, 2 * turn, g)
    with pytest.raises(ValueError, match="no camera has matches"):
        translation_from_means(cameras, centers, [PairMoments.zero()] * 2, turn, g)
    with pytest.raises(ValueError, match="not in front of camera 1"):
        translation_from_means(cameras, [centers[0], g + 3 * cameras[1, 2]], moments, turn, g)
