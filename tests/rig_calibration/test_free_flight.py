"""Gravity from simulated throws: exact, honest, and refused where the hand carries the object."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.rig_calibration.free_flight import GRAVITY, find_free_flight
from sylpose.rig_calibration.result import CalibrationRefusedError

RATE, UNIT = 30.0, 0.83
CENTER = np.array([0.03, -0.05, 0.02])
# Downwards in the axes of the first camera.
DOWN = Rotation.from_euler("xyz", [0.2, -0.1, 0.4]).apply([0.0, 1.0, 0.0])


def throw(
    n_throws: int, noise: float, seed: int = 0, factor: int = 1, spin_rate: float = 4.0
) -> tuple[FloatArray, RigidTransform]:
    """Return times and poses, in units of `UNIT` meters: carried by hand, with throws of half a second between.

    The flights are integrated step by step, and the body spins about its center of mass. The rate is `RATE` times a factor.
    """
    rng = np.random.default_rng(seed)
    n, step = factor * 40 * (n_throws + 1), 1.0 / (factor * RATE)
    centers, rotations = [np.array([0.0, 0.0, 1.5])], [Rotation.identity()]
    velocity, spin, fine = np.zeros(3), np.zeros(3), 50
    for k in range(1, n):
        phase, cycle = k % (factor * 40), k // (factor * 40)
        place, rotation = centers[-1].copy(), rotations[-1]
        if phase == factor * 20 and cycle < n_throws:
            velocity, spin = -2.5 * DOWN + 0.3 * rng.normal(size=3), rng.normal(size=3) * spin_rate
        if factor * 20 <= phase < factor * 35 and cycle < n_throws:
            for _ in range(fine):
                place = place + (velocity + 0.5 * GRAVITY * DOWN * step / fine) * step / fine
                velocity = velocity + GRAVITY * DOWN * step / fine
            rotation = Rotation.from_rotvec(spin * step) * rotation
        else:
            t = k * step
            place = place + 0.02 * np.array([np.sin(9 * t), np.cos(7 * t), np.sin(11 * t + 1)])
            rotation = Rotation.from_rotvec(0.05 / factor * np.array([np.cos(5 * t), np.sin(6 * t), 0.3])) * rotation
        centers.append(place)
        rotations.append(rotation)
    R = Rotation.concatenate(rotations)
    positions = (np.array(centers) - R.apply(CENTER)) / UNIT + noise * rng.normal(size=(n, 3))
    R = Rotation.from_rotvec(2.0 * noise * rng.normal(size=(n, 3))) * R
    return np.arange(n, dtype=float) * step, RigidTransform.from_components(positions, R)


def test_exact_without_noise() -> None:
    """A noise of a millionth, since the frames carried by hand must differ from flights."""
    found = find_free_flight(*throw(2, 1e-6))
    assert found.scale == pytest.approx(UNIT, rel=1e-3)
    np.testing.assert_allclose(found.up, -DOWN, atol=1e-3)
    np.testing.assert_allclose(found.center * UNIT, CENTER, atol=1e-3)
    assert len(found.flights) == 2


def test_standard_deviations_are_honest() -> None:
    squares, scales = [], []
    for seed in range(8):
        found = find_free_flight(*throw(3, 1.5e-3, seed))
        error = found.gravity - GRAVITY * DOWN / UNIT
        squares.append(error @ np.linalg.solve(found.covariance, error) / 3.0)
        scales.append(found.scale / UNIT - 1.0)
        assert abs(scales[-1]) < 5.0 * found.scale_sd
        assert np.arccos(found.up @ -DOWN) < 5.0 * found.up_sd
    assert 0.3 < np.mean(squares) < 3.0
    assert np.sqrt(np.mean(np.square(scales))) < 0.02


def wave(seed: int) -> tuple[FloatArray, RigidTransform]:
    """Return times and poses of 8 seconds in which a hand waves the object with a third of a g, smoothly and at random."""
    rng = np.random.default_rng(seed)
    times = np.arange(240) / RATE
    rates, phases = 2.0 * np.pi * rng.uniform(0.6, 2.5, (6, 1, 1)), rng.uniform(0.0, 2.0 * np.pi, (6, 3, 1))
    swings = 2.0 * rng.normal(size=(6, 3, 1)) / rates**2 * np.sin(rates * times + phases)
    turns = 0.3 * rng.normal(size=(6, 3, 1)) * np.sin(0.3 * rates * times + phases)
    R = Rotation.from_rotvec(2e-3 * rng.normal(size=(240, 3))) * Rotation.from_rotvec(turns.sum(axis=0).T)
    x = np.array([0.0, 0.0, 1.5]) + swings.sum(axis=0).T - R.apply(CENTER) + 1e-3 * rng.normal(size=(240, 3))
    return times, RigidTransform.from_components(x, R)


def test_waving_hands_are_refused() -> None:
    """Some of their swings have the same acceleration by chance."""
    with_agreeing = 0
    for seed in range(24):
        with pytest.raises(CalibrationRefusedError, match="throw the object up twice") as refused:
            find_free_flight(*wave(seed))
        with_agreeing += "swings of the hand" in str(refused.value)
    assert with_agreeing > 2


def test_many_throws() -> None:
    """Chance agreements of swings between them do not contradict."""
    for seed in range(4):
        found = find_free_flight(*throw(8, 1.5e-3, seed))
        assert len(found.flights) >= 6
        assert abs(found.scale / UNIT - 1.0) < 4.0 * found.scale_sd < 0.04


@pytest.mark.parametrize("n_throws", [0, 1])
def test_refused_without_two_throws(n_throws: int) -> None:
    for seed in range(2):
        with pytest.raises(CalibrationRefusedError, match="throw the object up twice"):
            find_free_flight(*throw(n_throws, 1.5e-3, seed))


def test_short_paths_are_refused() -> None:
    times, poses = throw(1, 1e-3)
    with pytest.raises(CalibrationRefusedError, match="0 free flights"):
        find_free_flight(times[:5], poses[:5])


def test_many_frames_per_second() -> None:
    """Windows then begin and end at every third frame."""
    found = find_free_flight(*throw(3, 1.5e-3, 2, factor=3))
    assert abs(found.scale / UNIT - 1.0) < 4.0 * found.scale_sd < 0.02
    np.testing.assert_allclose(found.flights, [(60, 102), (180, 222), (300, 342)], atol=3)


def test_equivariance() -> None:
    """Another world, unit and clock: gravity turns and scales with them."""
    times, poses = throw(2, 1e-3, 4)
    found = find_free_flight(times, poses)
    turn = RigidTransform.from_components([1.0, -2.0, 0.5], Rotation.from_rotvec([0.3, 0.5, -0.2]))
    moved = turn * poses
    moved = RigidTransform.from_components(2.0 * moved.translation, moved.rotation)
    other = find_free_flight(times + 100.0, moved)
    assert other.flights == found.flights
    np.testing.assert_allclose(other.gravity, 2.0 * turn.rotation.apply(found.gravity), rtol=1e-6)
    slow = find_free_flight(times * 1.02, poses)
    assert slow.scale / found.scale == pytest.approx(1.02**2, rel=1e-6)
