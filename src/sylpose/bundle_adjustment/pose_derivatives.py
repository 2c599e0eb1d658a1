"""How poses that are known frame by frame go on between frames: their derivatives by time."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray

__all__ = ["exact_motion", "motion", "speed_noise"]

# Poses that a polynomial of the fourth degree goes through (derived).
NEAR = 5


def motion(turns: FloatArray, places: FloatArray, times: FloatArray) -> FloatArray:
    """(N, 2, 6) first and second derivatives of the poses by time, from parabolas through three neighbours.

    Args:
        turns: (N, 3, 3) rotations; places: (N, 3).
        times: (N,) rising.
    """
    out = np.zeros((len(times), 2, 6))
    if len(times) < 2:
        return out
    gap = np.diff(times)[:, None]
    turn = Rotation.from_matrix(turns[1:] @ turns[:-1].transpose(0, 2, 1)).as_rotvec()
    speed = np.hstack([turn, np.diff(places, axis=0)]) / gap
    if len(times) == 2:
        out[:, 0] = speed
        return out
    before, after = gap[:-1], gap[1:]
    out[1:-1, 0] = (after * speed[:-1] + before * speed[1:]) / (before + after)
    out[1:-1, 1] = 2.0 * (speed[1:] - speed[:-1]) / (before + after)
    out[0, 1], out[-1, 1] = out[1, 1], out[-2, 1]
    out[0, 0] = out[1, 0] - gap[0] * out[1, 1]
    out[-1, 0] = out[-2, 0] + gap[-1] * out[-2, 1]
    return out


def exact_motion(turns: FloatArray, places: FloatArray, times: FloatArray) -> FloatArray:
    """The same from polynomials of the fourth degree through five neighbours, but for two frames at each end.

    Parabolas take a motion to and fro for slower than it is, by (2 pi / frames of a period)² / 6: time offsets would come
    out as much too large.
    """
    out = motion(turns, places, times)
    if len(times) < NEAR:
        return out
    near = np.arange(len(times) - NEAR + 1)[:, None] + np.arange(NEAR)
    middle = near[:, NEAR // 2]
    there, here = turns[near], turns[middle].transpose(0, 2, 1)
    turn = Rotation.from_matrix((there @ here[:, None]).reshape(-1, 3, 3)).as_rotvec().reshape(*near.shape, 3)
    change = np.concatenate([turn, places[near] - places[middle, None]], axis=2)
    out[middle] = _slopes(times)[:, 1:3] @ change
    return out


def speed_noise(times: FloatArray) -> FloatArray:
    """(N,) about the variance of the speeds of `exact_motion`, in those of poses whose errors are independent."""
    out = 0.5 / np.gradient(times) ** 2
    out[[0, -1]] *= 13.0  # at the ends, of three poses from one side
    if len(times) >= NEAR:
        out[NEAR // 2 : -(NEAR // 2)] = (_slopes(times)[:, 1] ** 2).sum(axis=1)
    return np.asarray(out)


def _slopes(times: FloatArray) -> FloatArray:
    """(N - 4, 5, 5) by how much each of five values counts in the derivatives, from the 0th, of the polynomial through them,
    at the one in the middle."""
    near = np.arange(len(times) - NEAR + 1)[:, None] + np.arange(NEAR)
    away = times[near] - times[near[:, NEAR // 2], None]
    scale = away[:, -1:] - away[:, :1]
    powers = (away / scale)[..., None] ** np.arange(NEAR)
    factorials = np.array([1.0, 1.0, 2.0, 6.0, 24.0])
    return np.asarray(np.linalg.inv(powers) * (factorials / scale ** np.arange(NEAR))[..., None])
