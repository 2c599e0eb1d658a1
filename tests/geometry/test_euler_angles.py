"""Euler angles about any three axes: agreement with SciPy, and standard deviations against sampling."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sylpose.geometry.euler_angles import PAN_TILT_ROLL, parse_euler_angles
from sylpose.results import pan_tilt_roll

SEQUENCES = ("XYZ", "xyz", "ZXY", "zxz", "ZYZ", "YXZ")
# Axes of a joint, none along a coordinate axis.
JOINT = "1,2,2 2,1,-2 2,-2,1"


@given(st.sampled_from(SEQUENCES), st.integers(0, 2**32 - 1))
def test_letters_match_scipy(text: str, seed: int) -> None:
    turn = Rotation.random(rng=np.random.default_rng(seed))
    np.testing.assert_allclose(parse_euler_angles(text).from_rotation(turn), turn.as_euler(text), atol=1e-9)


@given(st.sampled_from((*SEQUENCES, JOINT, "0,0,1 1,0,0 0,1,0")), st.integers(0, 2**32 - 1))
def test_round_trip(text: str, seed: int) -> None:
    angles, turns = parse_euler_angles(text), Rotation.random(5, rng=np.random.default_rng(seed))
    assert (angles.to_rotation(angles.from_rotation(turns)) * turns.inv()).magnitude().max() < 1e-7


def test_rotation_about_one_axis() -> None:
    angles = parse_euler_angles(JOINT)
    for k in range(3):
        np.testing.assert_allclose(
            angles.from_rotation(Rotation.from_rotvec(0.7 * angles.axes[k])), 0.7 * np.eye(3)[k], atol=1e-9
        )


def test_pan_tilt_roll() -> None:
    turn = Rotation.random(rng=np.random.default_rng(3))
    np.testing.assert_allclose(PAN_TILT_ROLL.from_rotation(turn), pan_tilt_roll(turn), atol=1e-12)
    np.testing.assert_allclose(parse_euler_angles("YXZ").from_rotation(turn), pan_tilt_roll(turn), atol=1e-12)


@pytest.mark.parametrize("text", [*SEQUENCES, JOINT])
def test_sigma_matches_sampling(text: str) -> None:
    rng, angles = np.random.default_rng(5), parse_euler_angles(text)
    half = rng.normal(size=(3, 3))
    covariance = 1e-6 * half @ half.T
    turn = angles.to_rotation([0.7, 1.1, 2.0] if text in ("zxz", "ZYZ") else [0.7, -0.9, 2.0])
    w = rng.multivariate_normal(np.zeros(3), covariance, size=20_000)
    sampled = angles.from_rotation(Rotation.from_rotvec(w) * turn).std(axis=0)
    np.testing.assert_allclose(angles.sigma(turn, covariance), sampled, rtol=0.03)


def test_sigma_is_nan_in_gimbal_lock() -> None:
    assert np.isnan(parse_euler_angles("XYZ").sigma(Rotation.from_euler("XYZ", [0.3, np.pi / 2, 0.1]), np.eye(3))).all()
    assert np.isnan(parse_euler_angles("XYZ").sigma(Rotation.identity(), np.full((3, 3), np.inf))).all()


@pytest.mark.parametrize(
    "text",
    ["", "XY", "XYy", "XXY", "ABC", "1,0,0 0,1,0", "1,0,0 1,1,0 0,0,1", "0,0,0 1,0,0 0,1,0", "nan,0,0 0,1,0 0,0,1"],
)
def test_invalid_axes_are_rejected(text: str) -> None:
    with pytest.raises(ValueError, match="angles: "):
        parse_euler_angles(text)
