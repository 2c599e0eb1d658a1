"""Scenes that the tests of the two-frame core share, and plain arrays for its compiled parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.matches import Matches
from sylpose.moments import PairMoments
from sylpose.relative_pose.moments_cost import Sums
from sylpose.relative_pose.terms import Candidate, Stack, TermData
from sylpose.results import Motion
from sylpose.rig import Rig
from sylpose.simulate import SimulatedPair, ellipsoid, ring

BODY = ellipsoid((0.15, 0.12, 0.1))


def around(n: int) -> Rig:
    """`n` cameras around the object, alternately above and below it."""
    return ring(n, height=[0.4 * (-1) ** k for k in range(n)])


def data_of(rig: Rig, matches: Sequence[Matches]) -> list[TermData]:
    """One term per camera that has matches, as `estimate_motion` makes them."""
    return [
        TermData(c, m.x, m.y, camera.rotation, camera.center, camera.focal)
        for c, (camera, m) in enumerate(zip(rig, matches, strict=True))
        if len(m)
    ]


def carried(data: Sequence[TermData], change: RigidTransform) -> list[TermData]:
    """The terms of a world that is moved as a whole."""
    turn = change.rotation.as_matrix()
    return [replace(t, rotation=t.rotation @ turn.T, center=np.asarray(change.apply(t.center))) for t in data]


def moments_of(stack: Stack, weights: FloatArray | None = None) -> FloatArray:
    """(T, 9, 9) pair moments of all matches, each with weight 1 unless said otherwise."""
    w = np.ones(len(stack.x)) if weights is None else weights
    parts = [slice(a, b) for a, b in zip(stack.offsets, stack.offsets[1:], strict=False)]
    return np.array([PairMoments.from_matches(stack.x[p], stack.y[p], w[p]).matrix for p in parts])


def variance_of(stack: Stack, sigma_px: float) -> FloatArray:
    """(T,) variance of an image coordinate, normalised units."""
    return np.asarray((sigma_px / stack.focal) ** 2)


def sums_of(stack: Stack, sigma_px: float) -> Sums:
    """The sums of all matches, at one level of noise."""
    return Sums(moments_of(stack), variance_of(stack, sigma_px))


def at(stack: Stack, t: int, rotation: FloatArray, shift: FloatArray, surface: FloatArray) -> Candidate:
    """A motion with a surface of term t; the other terms have none."""
    surfaces = np.full((len(stack.focal), len(surface)), np.nan)
    surfaces[t] = surface
    return Candidate(np.ascontiguousarray(rotation), np.asarray(shift, dtype=float), surfaces)


def epipolar_px(term: TermData, center: FloatArray, rotation: FloatArray, shift: FloatArray) -> FloatArray:
    """(n,) signed epipolar distances (Sampson's) of a term's matches, pixels."""
    tau = rotation @ (term.center_x - center) - (term.center - center) + shift
    turn = term.rotation @ rotation @ term.rotation_x.T
    essential = np.cross(np.eye(3), term.rotation @ tau) @ turn
    x, y = (np.column_stack([points, np.ones(len(term))]) for points in (term.x, term.y))
    lines_y, lines_x = x @ essential.T, y @ essential
    g = np.sum(lines_y[:, :2] ** 2, axis=1) + np.sum(lines_x[:, :2] ** 2, axis=1)
    return np.asarray(term.focal * np.einsum("ni,ni->n", y, lines_y) / np.sqrt(g))


def truth(pair: SimulatedPair, center: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The true (R, d) about a centre."""
    return pair.motion.rotation.as_matrix(), np.asarray(pair.motion.apply(center) - center)


def random_rotations(rng: np.random.Generator, n: int) -> FloatArray:
    """(n, 3, 3), evenly over all rotations."""
    return np.asarray(Rotation.random(n, rng=rng).as_matrix())


def angle(a: FloatArray, b: FloatArray) -> float:
    """Between two rotation matrices, radians."""
    return float(Rotation.from_matrix(a @ b.T).magnitude())


def turn_between(a: FloatArray, b: FloatArray) -> float:
    """The angle between two rotation matrices, degrees."""
    return float(np.rad2deg(angle(a, b)))


def error(pair: SimulatedPair, found: Motion) -> FloatArray:
    """(6,) the error (w, d) of a motion: radians, and the displacement of its centre."""
    assert found.motion is not None, found.status
    turn = (pair.motion.rotation * found.motion.rotation.inv()).as_rotvec()
    return np.concatenate([turn, pair.motion.apply(found.center) - found.motion.apply(found.center)])


def degrees(error: FloatArray) -> float:
    """The angle of an error (6,)."""
    return float(np.rad2deg(np.linalg.norm(error[:3])))


def shift(error: FloatArray) -> float:
    """The length of an error's (6,) displacement."""
    return float(np.linalg.norm(error[3:]))


def nees(error: FloatArray, found: Motion) -> float:
    """An error's square in units of its covariance: 6 on average when the covariance is right."""
    return float(error @ np.linalg.solve(found.covariance, error))
