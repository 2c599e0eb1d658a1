"""Hand-eye equation A X = X B: exact without noise, honest with it, and singular motions refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.sylvester.hand_eye import (
    measure_axis_spread,
    select_pairs,
    solve_hand_eye_rotation,
    solve_hand_eye_translations,
)
from tests.scenes import compute_angle

seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=12, deadline=None)
SCALES = np.array([1.0, 0.6, 1.7])


def simulate_poses(
    seed: int, noise: tuple[float, float] = (0.0, 0.0), frames: int = 40
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return X (C, 3, 3), x and o (C, 3); measured rotations (C, N, 3, 3) and positions (C, N, 3); rotations of T."""
    rng = np.random.default_rng(seed)
    n = len(SCALES)
    X, O = (Rotation.random(n, rng=rng).as_matrix() for _ in range(2))
    x, o = rng.normal(size=(n, 3)), 0.1 * rng.normal(size=(n, 3))
    X[0] = O[0] = np.eye(3)
    x[0] = o[0] = 0.0
    R = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.15, size=(frames, 3)), axis=0)).as_matrix()
    t = np.cumsum(rng.normal(scale=0.05, size=(frames, 3)), axis=0) + np.array([0.0, 0.0, 2.0])
    errors = Rotation.from_rotvec(noise[0] * rng.normal(size=(n * frames, 3))).as_matrix().reshape(n, frames, 3, 3)
    rotations = errors @ (X[:, None] @ R @ O[:, None])
    points = np.einsum("nij,cj->cni", R, o) + t
    positions = (np.einsum("cij,cnj->cni", X, points) + x[:, None]) / SCALES[:, None, None]
    return X, x, o, rotations, positions + noise[1] * rng.normal(size=positions.shape), R


def relative(rotations: FloatArray) -> FloatArray:
    i, j = select_pairs(len(rotations)).T
    return np.asarray(rotations[j] @ rotations[i].transpose(0, 2, 1))


@given(seed=seeds)
@quick
def test_rotation_is_exact_and_certified(seed: int) -> None:
    X, _, _, rotations, _, _ = simulate_poses(seed)
    b = relative(rotations[0])
    found = solve_hand_eye_rotation(relative(rotations[1]), b, np.ones(len(b)))
    assert found.certified
    np.testing.assert_allclose(found.rotation, X[1], atol=1e-9)


@given(seed=seeds)
@quick
def test_rotation_follows_changes_of_axes(seed: int) -> None:
    _, _, _, rotations, _, _ = simulate_poses(seed, (0.02, 0.0))
    a, b = relative(rotations[1]), relative(rotations[0])
    P, Q = Rotation.random(2, rng=np.random.default_rng(seed)).as_matrix()
    variance = np.ones(len(a))
    found, turned = (solve_hand_eye_rotation(p, q, variance) for p, q in ((a, b), (P @ a @ P.T, Q @ b @ Q.T)))
    np.testing.assert_allclose(turned.rotation, P @ found.rotation @ Q.T, atol=1e-7)
    np.testing.assert_allclose(turned.information, P @ found.information @ P.T, rtol=1e-5, atol=1e-5)


def test_half_turns_are_as_good_as_any() -> None:
    """A logarithm has either sign there, a rotation matrix has not."""
    X = Rotation.random(rng=np.random.default_rng(2)).as_matrix()
    b = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()
    # Half turns about the axes leave the sign of each axis open: one rotation about (1, 1, 1) decides it.
    b = np.concatenate([b, Rotation.from_rotvec([[0.9, 0.5, 0.2]]).as_matrix()])
    found = solve_hand_eye_rotation(X @ b @ X.T, b, np.ones(4))
    np.testing.assert_allclose(found.rotation, X, atol=1e-8)


def test_rotation_against_kronecker_products() -> None:
    """R_A X = X R_B as a null space (Andreff, Horaud, Espiau 1999): another linear method."""
    _, _, _, rotations, _, _ = simulate_poses(3, (1e-3, 0.0))
    a, b = relative(rotations[1]), relative(rotations[0])
    rows = np.vstack([np.kron(p, np.eye(3)) - np.kron(np.eye(3), q.T) for p, q in zip(a, b, strict=True)])
    u, _, v = np.linalg.svd(np.linalg.svd(rows)[2][-1].reshape(3, 3))
    other = u @ v * np.sign(np.linalg.det(u @ v))
    assert compute_angle(solve_hand_eye_rotation(a, b, np.ones(len(a))).rotation, other) < 0.2


def test_rotation_is_honest_and_robust() -> None:
    squares = []
    for seed in range(60):
        X, _, _, rotations, _, _ = simulate_poses(seed, (2e-3, 0.0))
        a, b = (r[1:] @ r[:-1].transpose(0, 2, 1) for r in (rotations[1], rotations[0]))
        a[::8] = Rotation.random(len(a[::8]), rng=np.random.default_rng(seed)).as_matrix()
        found = solve_hand_eye_rotation(a, b, np.full(len(a), 4 * 4e-6))
        assert (found.weights[::8] == 0.0).all()
        error = Rotation.from_matrix(found.rotation @ X[1].T).as_rotvec()
        squares.append(error @ found.information @ error)
    # Neighboring motions share a frame, with errors of opposite sign, so the mean is not above that of three.
    assert 0.5 < np.mean(squares) < 3.6


def test_axis_spread() -> None:
    vectors = np.outer([1.0, -2.0, 0.5], [0.0, 0.6, 0.8])
    assert measure_axis_spread(vectors) < 1e-12
    assert measure_axis_spread(np.eye(3)) == pytest.approx(1.0)
    assert measure_axis_spread(np.zeros((4, 3))) == 0.0


@given(seed=seeds)
@quick
def test_translations_are_exact(seed: int) -> None:
    X, x, o, _, positions, R = simulate_poses(seed)
    positions[1, 3:9] = np.nan
    covariances = np.broadcast_to(np.eye(3), (*positions.shape, 3))
    found = solve_hand_eye_translations(X, R, positions, covariances)
    np.testing.assert_allclose(found.translations, x, atol=1e-7)
    np.testing.assert_allclose(found.offsets, o, atol=1e-7)
    np.testing.assert_allclose(found.scales, SCALES, atol=1e-7)
    known = solve_hand_eye_translations(X, R, positions * SCALES[:, None, None], covariances, has_known_scales=True)
    np.testing.assert_allclose(known.translations, x, atol=1e-7)
    np.testing.assert_allclose(known.offsets, o, atol=1e-7)


def test_translations_are_honest_unbiased_and_robust() -> None:
    squares, scale_errors = [], []
    for seed in range(40):
        X, x, o, _, positions, R = simulate_poses(seed, (0.0, 0.02))
        positions[1, ::9] += 0.7
        covariances = np.broadcast_to(4e-4 * np.eye(3), (*positions.shape, 3))
        found = solve_hand_eye_translations(X, R, positions, covariances)
        # In these frames either camera 1 is rejected, or the others, so that the frame is not used.
        assert (found.weights[:, ::9].min(axis=0) < 0.1).all()
        errors = np.concatenate([(found.translations - x)[1:].ravel(), (found.offsets - o)[1:].ravel()])
        errors = np.concatenate([errors, (found.scales - SCALES)[1:]])
        squares.append(errors @ np.linalg.solve(found.covariance, errors))
        scale_errors.append(errors[-2:] / np.sqrt(np.diag(found.covariance)[-2:]))
    assert np.mean(squares) == pytest.approx(14.0, rel=0.35)
    # Least squares would shrink the scales by several standard deviations in the mean.
    assert (np.abs(np.mean(scale_errors, axis=0)) < 0.5).all()


def test_singular_motions_are_refused() -> None:
    X, _, _, _, positions, R = simulate_poses(4)
    covariances = np.broadcast_to(np.eye(3), (*positions.shape, 3))
    one_axis = Rotation.from_rotvec(np.outer(np.linspace(0, 2, 40), [0, 0, 1])).as_matrix()
    with pytest.raises(ValueError, match="second axis"):
        solve_hand_eye_translations(X, one_axis, positions, covariances)
    in_place = np.einsum("cij,j->ci", X, [0.0, 0.0, 2.0])[:, None] + np.zeros_like(positions)
    in_place += np.random.default_rng(0).normal(scale=1e-3, size=positions.shape)
    with pytest.raises(ValueError, match="carry it about"):
        solve_hand_eye_translations(X, R, in_place, covariances)
