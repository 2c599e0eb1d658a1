"""Shared scenes of the two-frame tests, and plain arrays for the compiled functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.matches import Matches
from sylpose.moments import PairMoments
from sylpose.relative_pose.moments_cost import MomentSums, TermView, make_term_view, update_view
from sylpose.relative_pose.terms import Candidate, Stack, TermData
from sylpose.results import Motion
from sylpose.rig import Rig
from sylpose.simulate import SimulatedPair, ellipsoid, ring

BODY = ellipsoid((0.15, 0.12, 0.1))


def make_zigzag_rig(n: int) -> Rig:
    """Return `n` cameras around the object, alternately above and below it."""
    return ring(n, height=[0.4 * (-1) ** k for k in range(n)])


def make_terms(rig: Rig, matches: Sequence[Matches]) -> list[TermData]:
    """Return one term per camera with matches, as `estimate_motion` does."""
    return [
        TermData(c, m.x, m.y, camera.rotation, camera.center, camera.focal)
        for c, (camera, m) in enumerate(zip(rig, matches, strict=True))
        if len(m)
    ]


def transform_terms(data: Sequence[TermData], change: RigidTransform) -> list[TermData]:
    """Return the terms in a transformed world frame."""
    rotation = change.rotation.as_matrix()
    return [replace(t, rotation=t.rotation @ rotation.T, center=np.asarray(change.apply(t.center))) for t in data]


def compute_pair_moments(stack: Stack, weights: FloatArray | None = None) -> FloatArray:
    """Return (T, 9, 9) pair moments of all matches, with unit weights by default."""
    w = np.ones(len(stack.x)) if weights is None else weights
    parts = [slice(a, b) for a, b in zip(stack.offsets, stack.offsets[1:], strict=False)]
    return np.array([PairMoments.from_matches(stack.x[p], stack.y[p], w[p]).matrix for p in parts])


def compute_variance(stack: Stack, sigma_px: float) -> FloatArray:
    """Return (T,) the variance of an image coordinate, normalized units."""
    return np.asarray((sigma_px / stack.focal) ** 2)


def make_moment_sums(stack: Stack, sigma_px: float) -> MomentSums:
    """Return the moment sums of all matches at one noise level."""
    return MomentSums(compute_pair_moments(stack), compute_variance(stack, sigma_px))


def make_candidate(
    stack: Stack, t: int, rotation: FloatArray, translation: FloatArray, depth_model: FloatArray
) -> Candidate:
    """Return a motion with a depth model for term t only."""
    depth_models = np.full((len(stack.focal), len(depth_model)), np.nan)
    depth_models[t] = depth_model
    return Candidate(np.ascontiguousarray(rotation), np.asarray(translation, dtype=float), depth_models)


def make_view(stack: Stack, t: int, candidate: Candidate) -> TermView:
    """Return the view of term t's camera."""
    view = make_term_view()
    update_view(stack, t, candidate, view)
    return view


def compute_epipolar_px(
    term: TermData, center: FloatArray, rotation: FloatArray, translation: FloatArray
) -> FloatArray:
    """Return (n,) signed epipolar distances (Sampson's) of a term's matches, pixels."""
    tau = rotation @ (term.center_x - center) - (term.center - center) + translation
    turn = term.rotation @ rotation @ term.rotation_x.T
    essential = np.cross(np.eye(3), term.rotation @ tau) @ turn
    x, y = (np.column_stack([points, np.ones(len(term))]) for points in (term.x, term.y))
    lines_y, lines_x = x @ essential.T, y @ essential
    g = np.sum(lines_y[:, :2] ** 2, axis=1) + np.sum(lines_x[:, :2] ** 2, axis=1)
    return np.asarray(term.focal * np.einsum("ni,ni->n", y, lines_y) / np.sqrt(g))


def get_true_motion(pair: SimulatedPair, center: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the true (R, d) about a center."""
    return pair.motion.rotation.as_matrix(), np.asarray(pair.motion.apply(center) - center)


def draw_rotations(rng: np.random.Generator, n: int) -> FloatArray:
    """Return (n, 3, 3) uniformly distributed rotations."""
    return np.asarray(Rotation.random(n, rng=rng).as_matrix())


def compute_angle(a: FloatArray, b: FloatArray) -> float:
    """Return the angle between two rotation matrices, radians."""
    return float(Rotation.from_matrix(a @ b.T).magnitude())


def compute_angle_degrees(a: FloatArray, b: FloatArray) -> float:
    """Return the angle between two rotation matrices, degrees."""
    return float(np.rad2deg(compute_angle(a, b)))


def compute_motion_error(pair: SimulatedPair, found: Motion) -> FloatArray:
    """Return (6,) the error (w, d) of a motion: radians, and the translation at its center."""
    assert found.motion is not None, found.status
    rotvec = (pair.motion.rotation * found.motion.rotation.inv()).as_rotvec()
    return np.concatenate([rotvec, pair.motion.apply(found.center) - found.motion.apply(found.center)])


def compute_rotation_degrees(error: FloatArray) -> float:
    """Return the angle of an error (6,), degrees."""
    return float(np.rad2deg(np.linalg.norm(error[:3])))


def compute_translation_error(error: FloatArray) -> float:
    """Return the length of an error's (6,) translation."""
    return float(np.linalg.norm(error[3:]))


def compute_nees(error: FloatArray, found: Motion) -> float:
    """Return the normalized estimation error squared: 6 on average with a correct covariance."""
    return float(error @ np.linalg.solve(found.covariance, error))
