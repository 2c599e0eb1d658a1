"""The Sampson distance is the first-order distance by which a pair of points must move to fit the geometry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import essential_matrix, sampson_scale


def pair(seed: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """R, t and a point in both frames (3,), exact."""
    rng = np.random.default_rng(seed)
    rotation, translation = Rotation.from_rotvec(0.3 * rng.standard_normal(3)).as_matrix(), 0.2 * rng.standard_normal(3)
    point = np.array([*rng.uniform(-0.5, 0.5, 2), 2.0])
    moved = rotation @ point + translation
    return rotation, translation, point / point[2], moved / moved[2]


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_exact_pair_has_no_residual(seed: int) -> None:
    rotation, translation, x, y = pair(seed)
    assert abs(y @ essential_matrix(rotation, translation) @ x) < 1e-12


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_sampson_is_distance_to_the_geometry(seed: int) -> None:
    rotation, translation, x, y = pair(seed)
    E = essential_matrix(rotation, translation)
    off = 1e-3 * np.random.default_rng(seed).standard_normal(4)
    x, y = x + np.append(off[:2], 0.0), y + np.append(off[2:], 0.0)

    def residual(step: FloatArray) -> float:
        return 1e3 * float((y + np.append(step[2:], 0.0)) @ E @ (x + np.append(step[:2], 0.0)))

    least = minimize(
        lambda s: 1e6 * float(s @ s),
        np.zeros(4),
        method="SLSQP",
        constraints={"type": "eq", "fun": residual},
        tol=1e-12,
    )
    found = abs(y @ E @ x) / sampson_scale(E, x, y)
    assert found == pytest.approx(np.linalg.norm(least.x), rel=0.01, abs=1e-7)
    assert found <= np.linalg.norm(off) * 1.01


def test_stacks_match_single_calls() -> None:
    each = [pair(seed) for seed in range(4)]
    rotations, translations, x, y = (np.array(part) for part in zip(*each, strict=True))
    E = essential_matrix(rotations, translations)
    for k, (r, t, a, b) in enumerate(each):
        np.testing.assert_allclose(E[k], essential_matrix(r, t), atol=1e-15)
        assert sampson_scale(E, x, y)[k] == pytest.approx(float(sampson_scale(E[k], a, b)), rel=1e-12)
    np.testing.assert_allclose(
        sampson_scale(E[0], x, y), [sampson_scale(E[0], a, b) for a, b in zip(x, y, strict=True)]
    )


def test_no_motion_has_no_distance() -> None:
    E = essential_matrix(np.eye(3), np.zeros(3))
    assert np.ones(3) @ E @ np.ones(3) / sampson_scale(E, np.ones(3), np.ones(3)) == 0.0
