"""Smooth paths of the bodies of the tracking benchmark, defined at fractional frames too."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from sylpose.geometry.arrays import FloatArray

__all__ = [
    "Path",
    "bump_profile",
    "compute_excursion",
    "make_closed_path",
    "make_straight_path",
    "make_tumbling_path",
    "smooth_step",
    "smooth_window",
    "swing_profile",
]

Path = Callable[[float], RigidTransform]
# (n,) frames -> (n,) values.
Profile = Callable[[FloatArray], FloatArray]

# Paths extend by this many frames before the first and after the last, for exposure times and clock offsets.
MARGIN = 3
# Steps per frame in the integration of rotations.
STEPS_PER_FRAME = 8


def smooth_step(t: ArrayLike) -> FloatArray:
    """Return a step from 0 at t = 0 to 1 at t = 1 without velocity and acceleration at the ends; constant outside."""
    s = np.clip(np.asarray(t, dtype=float), 0.0, 1.0)
    return np.asarray(s**3 * (10 + s * (6 * s - 15)))


def smooth_window(t: ArrayLike, start: float, end: float, ramp: float) -> FloatArray:
    """Return 1 from start to end and 0 outside, with smooth ramps before the start and after the end."""
    t = np.asarray(t, dtype=float)
    return smooth_step((t - start + ramp) / ramp) * smooth_step((end + ramp - t) / ramp)


def bump_profile(t: ArrayLike, middle: float, width: float) -> FloatArray:
    """Return 1 in the middle, falling to 0 at a distance of `width`; the area is the width."""
    s = np.clip((np.asarray(t, dtype=float) - middle) / width, -1.0, 1.0)
    return np.asarray(np.cos(np.pi / 2 * s) ** 2)


def swing_profile(t: ArrayLike, events: Sequence[tuple[float, float]]) -> FloatArray:
    """Return a smooth alternation between -1/2 and 1/2; each event (middle, duration in frames) changes the side."""
    t = np.asarray(t, dtype=float)
    side = np.full(t.shape, -0.5)
    for k, (middle, length) in enumerate(events):
        side = side + (1 if k % 2 == 0 else -1) * smooth_step((t - middle) / length + 0.5)
    return side


def make_tumbling_path(
    frames: int, speed_deg: Profile, position: Callable[[FloatArray], FloatArray], rng: np.random.Generator
) -> Path:
    """Return a rotation about an axis that varies by up to about 60 degrees from the vertical.

    Args:
        frames: number of frames.
        speed_deg: angular speed at the frames (n,), degrees per frame.
        place: the body's center (n, 3) at the frames (n,).
        rng: random generator of the axis.
    """
    times = np.arange(-MARGIN * STEPS_PER_FRAME, (frames + MARGIN) * STEPS_PER_FRAME + 1) / STEPS_PER_FRAME
    a, b = rng.uniform(0, 2 * np.pi, 2)
    axis = np.column_stack([np.sin(times / 27 + a), 0.3 + np.cos(times / 61 + b) ** 2, 0.8 * np.cos(times / 37 + a)])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    steps = Rotation.from_rotvec(np.deg2rad(speed_deg(times))[:, None] * axis / STEPS_PER_FRAME)
    rotations = [Rotation.identity()]
    for step in steps[:-1]:
        rotations.append(step * rotations[-1])
    start = rotations[MARGIN * STEPS_PER_FRAME].inv()
    rotation = Slerp(times, Rotation.concatenate(rotations) * start)
    return lambda frame: RigidTransform.from_components(position(np.array([float(frame)]))[0], rotation(float(frame)))


def make_closed_path(period: float, size: float, rng: np.random.Generator) -> Callable[[FloatArray], FloatArray]:
    """Return a closed path in space, frames (n,) -> (n, 3), of extent `size`, smaller in the vertical."""
    a, b, c = rng.uniform(0, 2 * np.pi, 3)

    def position(frames: FloatArray) -> FloatArray:
        s = 2 * np.pi * frames / period
        return 0.5 * size * np.column_stack([np.sin(s + a), 0.5 * np.sin(2 * s + b), 0.9 * np.sin(s + c)])

    return position


def make_straight_path(start: ArrayLike, end: ArrayLike, first: float, last: float, rotation_deg: float = 2.0) -> Path:
    """Return a straight path from start (3,) to end (3,) between two frames, with `turn_deg` of rotation per frame.

    The body is static before the first and after the last frame.
    """
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)

    def path(frame: float) -> RigidTransform:
        share = np.clip((frame - first) / (last - first), 0.0, 1.0)
        rotation = Rotation.from_rotvec(np.deg2rad(rotation_deg) * share * (last - first) * np.array([0.36, 0.8, 0.48]))
        return RigidTransform.from_components(start + share * (end - start), rotation)

    return path


def compute_excursion(
    frames: FloatArray, leaves: float, returns: float, ramp: float, excursion: ArrayLike, final_offset: ArrayLike
) -> FloatArray:
    """Return translations (n, 3): `excursion` between two frames, and `final_offset` after the return."""
    away_share = smooth_window(frames, leaves + ramp, returns - ramp, ramp)
    moved_share = smooth_step((frames - leaves - ramp) / (returns - leaves - 2 * ramp))
    return np.asarray(
        away_share[:, None] * np.asarray(excursion, dtype=float)
        + moved_share[:, None] * np.asarray(final_offset, dtype=float)
    )
