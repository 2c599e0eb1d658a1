"""How the bodies of the tracking benchmark move: smooth paths whose every pose is known, at fractions of frames too."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from sylpose.geometry.arrays import FloatArray

__all__ = ["Path", "away", "bump", "crossing", "loop", "smooth_step", "swings", "tumble", "window"]

Path = Callable[[float], RigidTransform]
# (n,) frames -> (n,) a number at each.
Profile = Callable[[FloatArray], FloatArray]

# Frames before the first and after the last that paths are defined for: exposures and clocks reach beyond them.
MARGIN = 3
# Turns are integrated in steps of this share of a frame.
STEPS_PER_FRAME = 8


def smooth_step(t: ArrayLike) -> FloatArray:
    """From 0 at t = 0 to 1 at t = 1 with neither speed nor acceleration at the ends; constant outside."""
    s = np.clip(np.asarray(t, dtype=float), 0.0, 1.0)
    return np.asarray(s**3 * (10 + s * (6 * s - 15)))


def window(t: ArrayLike, start: float, end: float, ramp: float) -> FloatArray:
    """1 from start to end, 0 outside, with smooth ramps that lie outside."""
    t = np.asarray(t, dtype=float)
    return smooth_step((t - start + ramp) / ramp) * smooth_step((end + ramp - t) / ramp)


def bump(t: ArrayLike, middle: float, width: float) -> FloatArray:
    """1 in the middle, 0 beyond a width to either side; its area is the width."""
    s = np.clip((np.asarray(t, dtype=float) - middle) / width, -1.0, 1.0)
    return np.asarray(np.cos(np.pi / 2 * s) ** 2)


def swings(t: ArrayLike, events: Sequence[tuple[float, float]]) -> FloatArray:
    """From one side to the other and back: each event (middle, frames that it takes) changes -1/2 to 1/2 or back."""
    t = np.asarray(t, dtype=float)
    side = np.full(t.shape, -0.5)
    for k, (middle, length) in enumerate(events):
        side = side + (1 if k % 2 == 0 else -1) * smooth_step((t - middle) / length + 0.5)
    return side


def tumble(
    frames: int, speed_deg: Profile, place: Callable[[FloatArray], FloatArray], rng: np.random.Generator
) -> Path:
    """A turn about an axis that wanders, up to about 60 degrees from the vertical.

    Args:
        speed_deg: degrees per frame at the frames (n,).
        place: the body's centre at the frames (n,): (n, 3).
    """
    times = np.arange(-MARGIN * STEPS_PER_FRAME, (frames + MARGIN) * STEPS_PER_FRAME + 1) / STEPS_PER_FRAME
    a, b = rng.uniform(0, 2 * np.pi, 2)
    axis = np.column_stack([np.sin(times / 27 + a), 0.3 + np.cos(times / 61 + b) ** 2, 0.8 * np.cos(times / 37 + a)])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    steps = Rotation.from_rotvec(np.deg2rad(speed_deg(times))[:, None] * axis / STEPS_PER_FRAME)
    turns = [Rotation.identity()]
    for step in steps[:-1]:
        turns.append(step * turns[-1])
    start = turns[MARGIN * STEPS_PER_FRAME].inv()
    turn = Slerp(times, Rotation.concatenate(turns) * start)
    return lambda frame: RigidTransform.from_components(place(np.array([float(frame)]))[0], turn(float(frame)))


def loop(period: float, size: float, rng: np.random.Generator) -> Callable[[FloatArray], FloatArray]:
    """A closed path in space of about a size from end to end, flatter in the vertical: frames (n,) -> (n, 3)."""
    a, b, c = rng.uniform(0, 2 * np.pi, 3)

    def place(frames: FloatArray) -> FloatArray:
        s = 2 * np.pi * frames / period
        return 0.5 * size * np.column_stack([np.sin(s + a), 0.5 * np.sin(2 * s + b), 0.9 * np.sin(s + c)])

    return place


def crossing(start: ArrayLike, end: ArrayLike, first: float, last: float, turn_deg: float = 2.0) -> Path:
    """A body that goes straight from start (3,) to end (3,) between two frames, turning by so much per frame; before and
    after it stands there."""
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)

    def path(frame: float) -> RigidTransform:
        share = np.clip((frame - first) / (last - first), 0.0, 1.0)
        turn = Rotation.from_rotvec(np.deg2rad(turn_deg) * share * (last - first) * np.array([0.36, 0.8, 0.48]))
        return RigidTransform.from_components(start + share * (end - start), turn)

    return path


def away(
    frames: FloatArray, leaves: float, back: float, ramp: float, shift: ArrayLike, beside: ArrayLike
) -> FloatArray:
    """(n, 3) displacement by `shift` between two frames, after which `beside` remains."""
    gone = window(frames, leaves + ramp, back - ramp, ramp)
    moved = smooth_step((frames - leaves - ramp) / (back - leaves - 2 * ramp))
    return np.asarray(gone[:, None] * np.asarray(shift, dtype=float) + moved[:, None] * np.asarray(beside, dtype=float))
