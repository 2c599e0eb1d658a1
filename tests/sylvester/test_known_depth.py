"""Points known in 3D: agreement with SVD, quaternions and a general minimizer, degenerate sets, certificates, bad input."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.status import Status
from sylpose.sylvester import so3
from sylpose.sylvester.equation import solve_generalized_sylvester, solve_sylvester
from sylpose.sylvester.known_depth import KnownDepthSolution, solve_2d3d, solve_3d3d
from tests.scenes import compute_angle

seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=12, deadline=None)
P = np.eye(3)[:2]


def random_rotation(rng: np.random.Generator) -> FloatArray:
    return np.asarray(Rotation.random(rng=rng).as_matrix())


def kabsch(x: FloatArray, y: FloatArray, w: FloatArray) -> FloatArray:
    """Solve by SciPy's singular value method, about the weighted means."""
    found, _ = Rotation.align_vectors(y - w @ y / w.sum(), x - w @ x / w.sum(), weights=w)
    return np.asarray(found.as_matrix())


def horn(x: FloatArray, y: FloatArray, w: FloatArray) -> FloatArray:
    """Solve by the largest eigenvector of a 4x4 quaternion matrix (Horn, 1987): always a rotation."""
    C = (w[:, None] * (y - w @ y / w.sum())).T @ (x - w @ x / w.sum())
    skew = np.array([C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]])
    Q = np.block([[np.trace(C).reshape(1, 1), skew[None]], [skew[:, None], C + C.T - np.trace(C) * np.eye(3)]])
    return np.asarray(Rotation.from_quat(np.linalg.eigh(Q)[1][:, 3], scalar_first=True).as_matrix())


def half_squares(x: FloatArray, y: FloatArray, w: FloatArray, R: FloatArray) -> float:
    residuals = y - w @ y / w.sum() - (x - w @ x / w.sum()) @ R.T
    return float(w @ (residuals**2).sum(axis=1)) / 2


def scale_3d(x: FloatArray, w: FloatArray) -> float:
    return float(w @ ((x - w @ x / w.sum()) ** 2).sum(axis=1)) / 3


# --- 3D-3D ------------------------------------------------------------------------------------------------------------


@given(seeds, st.integers(3, 20), st.sampled_from([0.0, 0.1, 3.0]), st.sampled_from([1.0, -1.0]))
@quick
def test_3d3d_equals_svd_and_quaternions(seed: int, n: int, noise: float, handedness: float) -> None:
    """Random weighted sets with little noise or pure noise, and mirrored ones (best orthogonal matrix a reflection)."""
    rng = np.random.default_rng(seed)
    x, w, turn = rng.normal(size=(n, 3)) * [2, 1, 0.5] + 3, rng.uniform(0.1, 2, size=n), random_rotation(rng)
    y = (x * [1, 1, handedness]) @ turn.T - 1 + noise * rng.normal(size=x.shape)
    solution = solve_3d3d(x, y, w)
    assert compute_angle(solution.rotation, kabsch(x, y, w)) < 1e-9
    assert compute_angle(solution.rotation, horn(x, y, w)) < 1e-9
    assert np.linalg.det(solution.rotation) == pytest.approx(1, abs=1e-12)
    assert solution.costs[0] == pytest.approx(half_squares(x, y, w, solution.rotation) / scale_3d(x, w), abs=1e-12)
    assert solution.certified
    if noise == 0 and handedness == 1:
        assert compute_angle(solution.rotation, turn) < 1e-9
        np.testing.assert_allclose(solution.translation, -1 * np.ones(3), atol=1e-12)


@given(seeds, st.integers(3, 12), st.sampled_from([0.0, 0.1, 3.0]), st.floats(0, np.pi))
@quick
def test_3d3d_of_flat_sets_equals_svd_and_quaternions(seed: int, n: int, noise: float, turn_angle: float) -> None:
    rng = np.random.default_rng(seed)
    plane, w = random_rotation(rng)[:2], rng.uniform(0.1, 2, size=n)
    x = rng.normal(size=(n, 2)) @ plane
    turn = Rotation.from_rotvec(turn_angle * random_rotation(rng)[0]).as_matrix()
    y = (x + noise * rng.normal(size=(n, 2)) @ plane) @ turn.T + 1  # flat in both frames
    solution = solve_3d3d(x, y, w)
    assert compute_angle(solution.rotation, kabsch(x, y, w)) < 1e-9
    assert compute_angle(solution.rotation, horn(x, y, w)) < 1e-9
    if noise == 0:
        assert compute_angle(solution.rotation, turn) < 1e-9


@given(seeds, st.integers(2, 12), st.floats(0, np.pi))
@quick
def test_3d3d_of_collinear_sets_is_the_smallest_rotation(seed: int, n: int, turn_angle: float) -> None:
    """Cost and direction of the line equal those of SVD; the rotation about the line is free in both."""
    rng = np.random.default_rng(seed)
    line, w = random_rotation(rng)[0], rng.uniform(0.1, 2, size=n)
    turn = Rotation.from_rotvec(turn_angle * random_rotation(rng)[0]).as_matrix()
    x = np.linspace(-1, 2, n)[:, None] * line + rng.normal(size=3)
    y = x @ turn.T + rng.normal(size=3)
    solution = solve_3d3d(x, y, w)
    assert solution.status is Status.ROTATION_NOT_OBSERVABLE
    after = turn @ line
    np.testing.assert_allclose(solution.rotation @ line, after, atol=1e-9)
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # SciPy warns "not uniquely defined"
        scipys = kabsch(x, y, w)
    np.testing.assert_allclose(solution.rotation @ line, scipys @ line, atol=1e-9)
    assert solution.costs[0] * scale_3d(x, w) == pytest.approx(half_squares(x, y, w, scipys), abs=1e-12)
    between = 2 * np.arctan2(np.linalg.norm(after - line), np.linalg.norm(after + line))
    assert compute_angle(solution.rotation, np.eye(3)) == pytest.approx(between, abs=1e-7)
    assert solution.unobservable.shape == (1, 3)
    assert abs(solution.unobservable[0] @ after) == pytest.approx(1, abs=1e-9)
    np.testing.assert_allclose(solution.rotation @ x[0] + solution.translation, y[0], atol=1e-9)


def test_3d3d_of_a_reversed_line_is_a_half_turn() -> None:
    x = np.outer([-1.0, 0.5, 2], [0.6, 0, 0.8])
    solution = solve_3d3d(x, -x)
    np.testing.assert_allclose(solution.rotation @ x.T, -x.T, atol=1e-12)
    assert np.linalg.det(solution.rotation) == pytest.approx(1)
    assert compute_angle(solution.rotation, np.eye(3)) == pytest.approx(np.pi)


def test_3d3d_of_coincident_points_gives_translation_only() -> None:
    x = np.tile([1.0, 2, 3], (4, 1))
    solution = solve_3d3d(x, x + 0.5)
    assert solution.status is Status.ROTATION_NOT_OBSERVABLE
    assert np.isnan(solution.rotation).all()
    assert len(solution.unobservable) == 3
    np.testing.assert_allclose(solution.center_translation, 0.5)
    # Coincident in the second frame only: all rotations are equivalent.
    solution = solve_3d3d(x + np.eye(4)[:, :3], x)
    assert solution.status is Status.ROTATION_NOT_OBSERVABLE
    assert len(solution.unobservable) == 3


@given(seeds, st.sampled_from([0.1, 1.0]), st.sampled_from([1.0, -1.0]))
@quick
def test_3d3d_solves_sylvesters_equation(seed: int, noise: float, handedness: float) -> None:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(8, 3))
    y = (x * [1, 1, handedness]) @ random_rotation(rng).T + noise * rng.normal(size=x.shape)
    solution = solve_3d3d(x, y)
    dx, dy, scale = x - x.mean(axis=0), y - y.mean(axis=0), scale_3d(x, np.ones(8))
    S, C, L, R = dx.T @ dx / scale, dy.T @ dx / scale, solution.multiplier, solution.rotation
    np.testing.assert_allclose(R @ S + L @ R, C, atol=1e-10)
    np.testing.assert_allclose(L, L.T, atol=1e-10)
    # As A N + N B = C it has a unique solution unless eigenvalues of L and -S collide.
    assert np.abs(np.add.outer(np.linalg.eigvalsh(L), np.linalg.eigvalsh(S))).min() > 1e-9
    np.testing.assert_allclose(solve_sylvester(L, S, C), R, atol=1e-4)


@given(seeds)
@quick
def test_3d3d_inverse_and_equivariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, w = rng.normal(size=(9, 3)), rng.integers(1, 4, size=9)
    y = x @ random_rotation(rng).T + 0.3 * rng.normal(size=x.shape)
    solution = solve_3d3d(x, y, w)
    assert compute_angle(solve_3d3d(y, x, w).rotation, solution.rotation.T) < 1e-9
    new, shift = random_rotation(rng), rng.normal(size=3)
    turned = solve_3d3d(x @ new.T + shift, y @ new.T + shift, w)
    np.testing.assert_allclose(turned.rotation, new @ solution.rotation @ new.T, atol=1e-10)
    np.testing.assert_allclose(turned.center_translation, new @ solution.center_translation, atol=1e-10)
    np.testing.assert_allclose(turned.information, new @ solution.information @ new.T, atol=1e-8 * w.sum())
    repeated = solve_3d3d(np.repeat(x, w, axis=0), np.repeat(y, w, axis=0))
    np.testing.assert_allclose(repeated.rotation, solution.rotation, atol=1e-10)
    np.testing.assert_allclose(repeated.information, solution.information, rtol=1e-8, atol=1e-8)


# --- 2D-3D ------------------------------------------------------------------------------------------------------------


class Scene:
    """Rigid object; each camera observes its own points, known in frame i, imaged in frame j."""

    def __init__(self, seed: int, cameras: int, noise: float = 0.0, shape: tuple[float, float, float] = (1, 0.8, 0.6)):
        rng = np.random.default_rng(seed)
        self.turn, self.shift = random_rotation(rng), rng.normal(size=3)
        self.rotations = np.array([random_rotation(rng) for _ in range(cameras)])
        self.centers = rng.normal(size=(cameras, 3))
        axes, middle = random_rotation(rng), rng.normal(size=3)
        self.points = [rng.normal(size=(12, 3)) * shape @ axes + middle for _ in range(cameras)]
        self.weights = [rng.uniform(0.5, 2, size=12) for _ in range(cameras)]
        self.images = [
            (p @ self.turn.T + self.shift - o) @ q[:2].T + noise * rng.normal(size=(12, 2))
            for p, q, o in zip(self.points, self.rotations, self.centers, strict=True)
        ]

    def solve(self, weights: bool = False) -> KnownDepthSolution:
        w = self.weights if weights else None
        return solve_2d3d(self.rotations, self.points, self.images, centers=self.centers, weights=w)

    def residuals(self, R: FloatArray) -> FloatArray:
        """Return the residuals of the images about their means, per camera."""
        out = [
            (y - y.mean(axis=0)) - (x - x.mean(axis=0)) @ (q[:2] @ R).T
            for x, y, q in zip(self.points, self.images, self.rotations, strict=True)
        ]
        return np.concatenate(out).ravel()

    @property
    def scale(self) -> float:
        return 2 / 9 * sum(float(((x - x.mean(axis=0)) ** 2).sum()) for x in self.points)


@given(seeds, st.integers(1, 4))
@quick
def test_2d3d_is_exact_and_certified_without_noise(seed: int, cameras: int) -> None:
    """One camera is sufficient if the points are not flat: depth resolves the mirror ambiguity."""
    scene = Scene(seed, cameras)
    solution = scene.solve(weights=True)
    assert solution.certified
    assert solution.status is Status.OK
    assert compute_angle(solution.rotation, scene.turn) < 1e-7
    assert len(solution.candidates) == 1
    moved = scene.turn @ solution.center + scene.shift - solution.center
    if cameras > 1:
        cond = np.linalg.cond(solution.center_translation_information)
        np.testing.assert_allclose(solution.center_translation, moved, atol=1e-7 * cond)
        return
    axis = scene.rotations[0, 2]
    np.testing.assert_allclose(solution.center_translation, moved - axis * (axis @ moved), atol=1e-6)
    np.testing.assert_allclose(
        solution.center_translation_information @ axis,
        0,
        atol=1e-9 * np.abs(solution.center_translation_information).max(),
    )


@given(seeds, st.integers(1, 3), st.sampled_from([0.05, 1.0]))
@settings(max_examples=8, deadline=None)
def test_2d3d_equals_a_general_minimizer_from_many_starts(seed: int, cameras: int, noise: float) -> None:
    scene = Scene(seed, cameras, noise)

    def run(start: FloatArray) -> tuple[float, FloatArray]:
        found = least_squares(
            lambda w: scene.residuals(Rotation.from_rotvec(w).as_matrix() @ start),
            np.zeros(3),
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
        )
        return float(found.cost), Rotation.from_rotvec(found.x).as_matrix() @ start

    cost, rotation = min((run(s) for s in Rotation.create_group("T").as_matrix()), key=lambda found: found[0])
    solution = scene.solve()
    assert solution.costs[0] * scene.scale == pytest.approx(cost, rel=1e-9)
    assert compute_angle(solution.rotation, rotation) < 1e-5


@given(seeds, st.integers(1, 3), st.sampled_from([0.1, 1.0]))
@quick
def test_2d3d_certificate_against_random_rotations(seed: int, cameras: int, noise: float) -> None:
    scene = Scene(seed, cameras, noise)
    solution = scene.solve()
    others = Rotation.random(200, rng=np.random.default_rng(seed)).as_matrix()
    gaps = np.array([float((scene.residuals(R) ** 2).sum()) / 2 / scene.scale - solution.costs[0] for R in others])
    assert (gaps > 0).all()
    if solution.certified:
        K = sum(
            np.kron(q[:2].T @ q[:2], (x - x.mean(axis=0)).T @ (x - x.mean(axis=0)))
            for x, q in zip(scene.points, scene.rotations, strict=True)
        )
        K = K / scene.scale + np.kron(solution.multiplier, np.eye(3))
        apart = (others - solution.rotation).reshape(-1, 9)
        np.testing.assert_allclose(gaps, 0.5 * np.einsum("ni,ij,nj->n", apart, K, apart), atol=1e-9)


def test_2d3d_is_usually_certified() -> None:
    for cameras in (1, 2, 3):
        certified = [Scene(seed, cameras, 0.05).solve().certified for seed in range(20)]
        assert np.mean(certified) >= 0.95


@given(seeds)
@quick
def test_2d3d_solves_the_generalized_equation(seed: int) -> None:
    scene = Scene(seed, 3, 0.1)
    solution = scene.solve()
    A = [q.T @ P.T @ P @ q for q in scene.rotations]
    B = [(x - x.mean(axis=0)).T @ (x - x.mean(axis=0)) for x in scene.points]
    C = sum(
        q.T @ P.T @ (y - y.mean(axis=0)).T @ (x - x.mean(axis=0))
        for q, x, y in zip(scene.rotations, scene.points, scene.images, strict=True)
    )
    again = solve_generalized_sylvester([*A, scene.scale * solution.multiplier], [*B, np.eye(3)], C)
    np.testing.assert_allclose(again, solution.rotation, atol=1e-7)


@given(seeds)
@quick
def test_2d3d_of_flat_points_in_one_camera_has_a_mirrored_solution(seed: int) -> None:
    """The second solution is the mirror image through the image plane of the mirror image through the object's plane."""
    scene = Scene(seed, 1, 0.0, (1, 0.8, 0))
    solution = scene.solve()
    normal = np.linalg.svd(scene.points[0] - scene.points[0].mean(axis=0))[2][2]
    axis = scene.rotations[0, 2]
    mirrored = (np.eye(3) - 2 * np.outer(axis, axis)) @ scene.turn @ (np.eye(3) - 2 * np.outer(normal, normal))
    for expected in (scene.turn, mirrored):
        assert (
            min(compute_angle(c, expected) for c in solution.candidates) < 1e-3
        )  # where both coincide, half of the digits
    if compute_angle(scene.turn, mirrored) > 0.2:
        assert not solution.certified
        assert solution.status is not Status.OK
        np.testing.assert_allclose(solution.costs[:2], 0, atol=1e-9)
        # A second camera resolves the ambiguity.
        both = Scene(seed, 2, 0.0, (1, 0.8, 0)).solve()
        assert both.costs[0] < 1e-9


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_2d3d_of_a_plane_is_certified_from_three_cameras(noise: float) -> None:
    """The normal is not in any image: two columns of the rotation are observed, the third follows."""
    certified = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        cameras, turn, frame = (random_rotation(rng) for _ in range(3))
        rotations = np.array([cameras, cameras @ random_rotation(rng), random_rotation(rng)])
        points = [rng.normal(size=(12, 2)) @ frame[:2] for _ in rotations]
        images = [
            p @ turn.T @ q[:2].T + noise * rng.normal(size=(12, 2)) for p, q in zip(points, rotations, strict=True)
        ]
        solution = solve_2d3d(rotations, points, images)
        certified += solution.certified
        if solution.certified:
            assert solution.status is Status.OK
            assert len(solution.costs) == 1
            assert compute_angle(solution.rotation, turn) < (0.1 if noise else 1e-6)
            # No rotation has a lower cost.
            others = np.asarray(Rotation.random(500, rng=rng).as_matrix())
            squares = np.zeros(501)
            for p, q, y in zip(points, rotations, images, strict=True):
                tried = (p - p.mean(axis=0)) @ np.swapaxes(q[:2] @ [solution.rotation, *others], 1, 2)
                squares += ((y - y.mean(axis=0) - tried) ** 2).sum(axis=(1, 2))
            assert squares[1:].min() > squares[0]
    assert certified >= 18


@pytest.mark.parametrize("offset", [0.0, 1e7])
def test_points_far_from_the_origin_have_spread(offset: float) -> None:
    """As in map coordinates."""
    rng = np.random.default_rng(3)
    x, turn = rng.normal(size=(12, 3)), random_rotation(rng)
    there = offset * np.array([1.0, -0.5, 0.3])
    solution = solve_3d3d(x + there, x @ turn.T + 2 * there)
    assert solution.status is Status.OK
    assert compute_angle(solution.rotation, turn) < 1e-7
    rotations = np.array([random_rotation(rng) for _ in range(3)])
    images = [(x @ turn.T + 2 * there) @ q[:2].T for q in rotations]
    solution = solve_2d3d(rotations, [x + there] * 3, images)
    assert solution.status is Status.OK
    assert compute_angle(solution.rotation, turn) < 1e-7
    # Coincident points there have no spread.
    point = np.tile(there + rng.normal(size=3), (12, 1))
    assert np.isnan(solve_3d3d(point, x).rotation).all()
    assert np.isnan(solve_2d3d(rotations, [point] * 3, images).rotation).all()


@pytest.mark.parametrize("weight", [1e-100, 1e-3, 1e100])
def test_weights_of_any_size_give_the_same_rotation(weight: float) -> None:
    rng = np.random.default_rng(3)
    x, turn = rng.normal(size=(12, 3)), random_rotation(rng)
    y = x @ turn.T + [1.0, 2, 3]
    solution = solve_3d3d(x, y, np.full(12, weight))
    assert compute_angle(solution.rotation, turn) < 1e-7
    np.testing.assert_allclose(solution.center_translation, (y - x).mean(axis=0))
    # The sum of the weights counts as the number of points: tiny weights leave nothing observable.
    assert solution.status is (Status.OK if weight > 1e-6 else Status.ROTATION_NOT_OBSERVABLE)


def test_too_large_weights_raise() -> None:
    x, y = np.random.default_rng(0).normal(size=(2, 12, 3))
    with pytest.raises(ValueError, match="there are no points"):
        solve_3d3d(x, y, np.full(12, 1e-310))
    with pytest.raises(ValueError, match=r"weights has values beyond 1e\+100"):
        solve_3d3d(x, y, np.full(12, 1e300))
    with pytest.raises(ValueError, match=r"weights\[0\] has values beyond 1e\+100"):
        solve_2d3d(np.eye(3)[None], [x], [y[:, :2]], weights=[np.full(12, 1e300)])


def test_2d3d_of_a_line_does_not_observe_rotation_about_it() -> None:
    scene = Scene(0, 3, 0.0, (1, 0, 0))
    points = [
        x - scene.points[0][0] for x in scene.points
    ]  # one line through all points: the cameras' sets share its direction
    solution = solve_2d3d(scene.rotations, points, scene.images)
    assert solution.status is Status.ROTATION_NOT_OBSERVABLE
    line = points[0][1] / np.linalg.norm(points[0][1])
    after = scene.turn @ line
    np.testing.assert_allclose(solution.rotation @ line, after, atol=1e-6)
    assert abs(solution.unobservable[0] @ after) == pytest.approx(1, abs=1e-6)


@given(seeds)
@quick
def test_2d3d_symmetries(seed: int) -> None:
    scene, rng = Scene(seed, 3, 0.05), np.random.default_rng(seed)
    reference = scene.solve(weights=True)
    new, shift = random_rotation(rng), rng.normal(size=3)
    turned = solve_2d3d(
        scene.rotations @ new.T,
        [x @ new.T + shift for x in scene.points],
        scene.images,
        centers=scene.centers @ new.T + shift,
        weights=scene.weights,
    )
    assert compute_angle(turned.rotation, new @ reference.rotation @ new.T) < 1e-7
    np.testing.assert_allclose(turned.center_translation, new @ reference.center_translation, atol=1e-6)
    np.testing.assert_allclose(
        turned.information, new @ reference.information @ new.T, atol=1e-6 * reference.information.max()
    )
    # Other order, a camera without points, and every point twice with half of the weight.
    order = [2, 0, 1]
    same = solve_2d3d(
        [*scene.rotations[order], np.eye(3)],
        [*(np.repeat(scene.points[c], 2, axis=0) for c in order), np.empty((0, 3))],
        [*(np.repeat(scene.images[c], 2, axis=0) for c in order), np.empty((0, 2))],
        centers=[*scene.centers[order], np.zeros(3)],
        weights=[*(np.repeat(scene.weights[c], 2) / 2 for c in order), np.empty(0)],
    )
    assert compute_angle(same.rotation, reference.rotation) < 1e-7
    np.testing.assert_allclose(same.center_translation, reference.center_translation, atol=1e-7)
    np.testing.assert_allclose(same.information, reference.information, rtol=1e-5, atol=1e-5)
    # A translation of all images of a camera changes the object's translation only.
    moved = solve_2d3d(scene.rotations, scene.points, [y + 1 for y in scene.images], weights=scene.weights)
    assert compute_angle(moved.rotation, reference.rotation) < 1e-7


# --- Uncertainty, bad input -------------------------------------------------------------------------------------------


@given(seeds)
@quick
def test_information_against_finite_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene, x = Scene(seed, 2, 0.1), rng.normal(size=(7, 3))
    y = x @ random_rotation(rng).T + 0.2 * rng.normal(size=x.shape)
    w = np.ones(7)
    cases: list[tuple[KnownDepthSolution, Callable[[FloatArray], float], int]] = [
        (scene.solve(), lambda R: float((scene.residuals(R) ** 2).sum()) / 2, 48),
        (solve_3d3d(x, y), lambda R: half_squares(x, y, w, R), 21),
    ]
    for solution, half, coordinates in cases:

        def cost(
            v: FloatArray,
            rotation: FloatArray = solution.rotation,
            half: Callable[[FloatArray], float] = half,
        ) -> float:
            return half(Rotation.from_rotvec(v).as_matrix() @ rotation)

        e = 1e-4 * np.eye(3)
        numeric = np.array([[(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / 4e-8 for a in e] for b in e])
        numeric *= coordinates / (2 * cost(np.zeros(3)))
        np.testing.assert_allclose(solution.information, numeric, rtol=1e-3, atol=1e-4 * np.abs(numeric).max())


@pytest.mark.parametrize("cameras", [0, 1, 3])
def test_information_agrees_with_sampling(cameras: int) -> None:
    """Normalized squared errors average the number of unknowns. 0 cameras: 3D-3D."""
    turns, shifts = [], []
    for seed in range(300):
        if cameras:
            scene = Scene(seed, cameras, 0.02)
            solution, turn, shift = scene.solve(), scene.turn, scene.shift
        else:
            rng = np.random.default_rng(seed)
            x, turn, shift = rng.normal(size=(12, 3)), random_rotation(rng), rng.normal(size=3)
            solution = solve_3d3d(x, x @ turn.T + shift + 0.02 * rng.normal(size=x.shape))
        w = Rotation.from_matrix(turn @ solution.rotation.T).as_rotvec()
        d = turn @ solution.center + shift - solution.center - solution.center_translation
        turns.append(w @ solution.information @ w)
        shifts.append(d @ solution.center_translation_information @ d)
    # The variance is the mean square about the fit, too small by the degrees of freedom.
    assert 2.4 < np.mean(turns) < 4.5
    assert 1.2 < np.mean(shifts) < 4.5


def test_invalid_input_raises() -> None:
    x = np.random.default_rng(0).normal(size=(5, 3))
    for bad, message in (
        ((x[:, :2], x), r"x must be \(n, 3\), got shape \(5, 2\)"),
        ((x, x[:4]), "x has 5 points and y has 4"),
        ((x, x * np.nan), "y has values that are not finite"),
        ((x, x, np.ones(4)), r"weights must be \(5,\), got shape \(4,\)"),
        ((x, x, -np.ones(5)), "weights must be 5 finite, non-negative"),
        ((x, x, np.zeros(5)), "there are no points"),
        ((x[:0], x[:0]), "there are no points"),
    ):
        with pytest.raises(ValueError, match=message):
            solve_3d3d(*bad)
    q, y = np.eye(3)[None], x[:, :2]
    with pytest.raises(ValueError, match=r"rotations must be \(C, 3, 3\)"):
        solve_2d3d(q, [x, x], [y, y])
    with pytest.raises(ValueError, match=r"rotations\[0\] is not a rotation"):
        solve_2d3d(2 * q, [x], [y])
    with pytest.raises(ValueError, match="images: 2 for 1 cameras"):
        solve_2d3d(q, [x], [y, y])
    with pytest.raises(ValueError, match=r"centers must be \(1, 3\)"):
        solve_2d3d(q, [x], [y], centers=np.zeros(3))
    with pytest.raises(ValueError, match=r"images\[0\] must be \(n, 2\)"):
        solve_2d3d(q, [x], [x])
    with pytest.raises(ValueError, match=r"points\[0\] has 5 points and images\[0\] has 4"):
        solve_2d3d(q, [x], [y[:4]])
    with pytest.raises(ValueError, match=r"weights\[0\] must be \(5,\)"):
        solve_2d3d(q, [x], [y], weights=[np.ones(3)])
    with pytest.raises(ValueError, match="no camera has points"):
        solve_2d3d(q, [x[:0]], [y[:0]])
    together = solve_2d3d(q, [np.ones((4, 3))], [np.zeros((4, 2))])
    assert together.status is Status.ROTATION_NOT_OBSERVABLE
    assert np.isnan(together.rotation).all()


def test_3d3d_equals_the_general_so3_minimizer() -> None:
    rng = np.random.default_rng(1)
    x = rng.normal(size=(10, 3))
    y = x @ random_rotation(rng).T + 0.2 * rng.normal(size=x.shape)
    dx, dy = x - x.mean(axis=0), y - y.mean(axis=0)
    H, h = np.kron(np.eye(3), dx.T @ dx), (dy.T @ dx).ravel()
    scale = np.trace(H) / 9
    candidates, certified, _ = so3.minimize(H / scale, h / scale)
    assert certified
    solution = solve_3d3d(x, y)
    assert compute_angle(solution.rotation, candidates[0]) < 1e-8
    np.testing.assert_allclose(
        solution.multiplier, so3.compute_multiplier(H / scale, h / scale, candidates[0]), atol=1e-8
    )
