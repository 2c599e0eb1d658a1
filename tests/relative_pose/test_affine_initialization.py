"""Initial rotations from the cameras' affine maps of a flat object: one is close to the true rotation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.search import MAX_HYPOTHESES, estimate_affine_rotations
from sylpose.relative_pose.terms import Stack, TermData, locate_object, stack_terms
from sylpose.rig import Rig
from sylpose.simulate import arc, plane, random_motion, simulate_matches
from sylpose.simulate.bodies import Body
from tests.scenes import make_moment_sums, make_terms

BOARD = plane((0.2, 0.3))
RIG = arc(2, 40, 2.5)


def make_stack(rig: Rig, seed: int, turn: float, body: Body = BOARD, earlier: RigidTransform | None = None) -> Stack:
    rng = np.random.default_rng(seed)
    motion = random_motion(turn, 0.01, rng)
    start = RigidTransform.from_rotation(Rotation.random(rng=rng))
    pair = simulate_matches(rig, body, motion, rng=rng, noise_px=0.0, start=start)
    data = [replace(term, start_from_reference=earlier) for term in make_terms(rig, pair.matches)]
    return stack_terms(data, *locate_object(data))


def estimate_rotvecs(stack: Stack) -> FloatArray:
    rotvecs = np.zeros((MAX_HYPOTHESES, 3))
    return rotvecs[: estimate_affine_rotations(stack, make_moment_sums(stack, 0.5), rotvecs)]


def compute_relative_error(rotvecs: FloatArray, rotation: Rotation) -> float:
    """Return the error of the nearest rotation, relative to the true angle."""
    return float((Rotation.from_rotvec(rotvecs) * rotation.inv()).magnitude().min() / rotation.magnitude())


@pytest.mark.parametrize("turn", [0.5, 3.0, 12.0])
def test_one_candidate_is_near_the_true_rotation(turn: float) -> None:
    shares = []
    for seed in range(60):
        rotation = random_motion(turn, 0.01, np.random.default_rng(seed)).rotation
        stack = make_stack(RIG, seed, turn)
        found = estimate_rotvecs(stack)
        if len(found):
            shares.append(compute_relative_error(found, rotation))
    assert len(shares) > 50  # else a camera sees the board from its edge, or not at all
    # First-order model: perspective and the squared rotation remain.
    assert np.median(shares) < 0.35
    assert np.quantile(shares, 0.9) < 0.6


@pytest.mark.parametrize("n_cameras", [3, 5, 9])
def test_lines_of_more_cameras_meet_first_in_the_true_rotation(n_cameras: int) -> None:
    rig, shares = arc(n_cameras, 20.0, 2.5), []
    for seed in range(30):
        found = estimate_rotvecs(make_stack(rig, seed, 5.0))
        if len(found):
            rotation = random_motion(5.0, 0.01, np.random.default_rng(seed)).rotation
            shares.append((compute_relative_error(found[:1], rotation), compute_relative_error(found, rotation)))
    first, nearest = np.median(shares, axis=0)
    assert first < 0.35
    assert nearest < 0.2


def test_candidates_include_the_mirrored_rotation() -> None:
    """The lines meet in the true rotation; those of the second planes pass elsewhere."""
    apart = []
    for seed in range(20):
        found = estimate_rotvecs(make_stack(RIG, seed, 5.0))
        if len(found):
            gaps = (
                Rotation.from_rotvec(np.repeat(found, 4, axis=0)) * Rotation.from_rotvec(np.tile(found, (4, 1))).inv()
            )
            apart.append(np.degrees(gaps.magnitude().max()))
    assert np.median(apart) > 3.0


@pytest.mark.parametrize(
    ("rig", "body", "earlier"),
    [
        (RIG, plane((0.3, 0.002)), None),  # collinear points
        (RIG, BOARD, RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.3, 0.0]))),  # another reference frame
    ],
    ids=["a line", "another frame"],
)
def test_degenerate_terms_give_no_candidates(rig: Rig, body: Body, earlier: RigidTransform | None) -> None:
    for seed in range(5):
        assert len(estimate_rotvecs(make_stack(rig, seed, 5.0, body, earlier))) == 0


@pytest.mark.parametrize("x", [np.zeros((8, 2)), np.full((8, 2), 0.1), np.linspace(0, 0.1, 16).reshape(8, 2)])
def test_degenerate_points_give_no_candidates(x: ArrayLike) -> None:
    points = np.asarray(x, float)
    data = [
        TermData(c, points, points + 1e-3, camera.rotation, camera.center, camera.focal) for c, camera in enumerate(RIG)
    ]
    assert len(estimate_rotvecs(stack_terms(data, np.zeros(3), 0.1))) == 0
