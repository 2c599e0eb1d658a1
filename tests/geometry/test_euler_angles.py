"""Angles about any three axes: exact, as SciPy has them, with the spread that sampling shows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sylpose.geometry.euler_angles import PAN_TILT_ROLL, angles_of
from sylpose.results import pan_tilt_roll

SEQUENCES = ("XYZ", "xyz", "ZXY", "zxz", "ZYZ", "YXZ")
# Of a joint: none of them along an axis of the coordinate systems.
JOINT = "1,2,2 2,1,-2 2,-2,1"


@given(st.sampled_from(SEQUENCES), st.integers(0, 2**32 - 1))
def test_letters_mean_what_they_mean_in_scipy(text: str, seed: int) -> None:
    turn = Rotation.random(rng=np.random.default_rng(seed))
    np.testing.assert_allclose(angles_of(text).of(turn), turn.as_euler(text), atol=1e-9)


@given(st.sampled_from((*SEQUENCES, JOINT, "0,0,1 1,0,0 0,1,0")), st.integers(0, 2**32 - 1))
def test_the_rotation_comes_back(text: str, seed: int) -> None:
    angles, turns = angles_of(text), Rotation.random(5, rng=np.random.default_rng(seed))
    assert (angles.rotation(angles.of(turns)) * turns.inv()).magnitude().max() < 1e-7


def test_a_turn_about_one_axis_is_the_angle_about_it() -> None:
    angles = angles_of(JOINT)
    for k in range(3):
        np.testing.assert_allclose(angles.of(Rotation.from_rotvec(0.7 * angles.axes[k])), 0.7 * np.eye(3)[k], atol=1e-9)


def test_pan_tilt_roll_is_one_of_them() -> None:
    turn = Rotation.random(rng=np.random.default_rng(3))
    np.testing.assert_allclose(PAN_TILT_ROLL.of(turn), pan_tilt_roll(turn), atol=1e-12)
    np.testing.assert_allclose(angles_of("YXZ").of(turn), pan_tilt_roll(turn), atol=1e-12)


@pytest.mark.parametrize("text", [*SEQUENCES, JOINT])
def test_spread_agrees_with_sampling(text: str) -> None:
    rng, angles = np.random.default_rng(5), angles_of(text)
    half = rng.normal(size=(3, 3))
    covariance = 1e-6 * half @ half.T
    turn = angles.rotation([0.7, 1.1, 2.0] if text in ("zxz", "ZYZ") else [0.7, -0.9, 2.0])
    w = rng.multivariate_normal(np.zeros(3), covariance, size=20_000)
    sampled = angles.of(Rotation.from_rotvec(w) * turn).std(axis=0)
    np.testing.assert_allclose(angles.sigma(turn, covariance), sampled, rtol=0.03)


def test_spread_is_not_known_where_two_angles_cannot_be_told_apart() -> None:
    assert np.isnan(angles_of("XYZ").sigma(Rotation.from_euler("XYZ", [0.3, np.pi / 2, 0.1]), np.eye(3))).all()
    assert np.isnan(angles_of("XYZ").sigma(Rotation.identity(), np.full((3, 3), np.inf))).all()


@pytest.mark.parametrize(
    "text",
    ["", "XY", "XYy", "XXY", "ABC", "1,0,0 0,1,0", "1,0,0 1,1,0 0,0,1", "0,0,0 1,0,0 0,1,0", "nan,0,0 0,1,0 0,0,1"],
)
def test_what_are_no_axes_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="angles: "):
        angles_of(text)
