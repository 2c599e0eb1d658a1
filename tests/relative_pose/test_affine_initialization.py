"""Two cameras' affine maps of a flat object: one of the turns that fit them is about the true one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.affine_initialization import FEW, affine_turns
from sylpose.relative_pose.terms import Stack, TermData, object_place, stack_terms
from sylpose.rig import Rig
from sylpose.simulate import arc, plane, random_motion, ring, simulate_matches
from sylpose.simulate.bodies import Body
from tests.scenes import data_of, sums_of

BOARD = plane((0.2, 0.3))
RIG = arc(2, 40, 2.5)


def stack_of(rig: Rig, seed: int, turn: float, body: Body = BOARD, earlier: RigidTransform | None = None) -> Stack:
    rng = np.random.default_rng(seed)
    motion = random_motion(turn, 0.01, rng)
    start = RigidTransform.from_rotation(Rotation.random(rng=rng))
    pair = simulate_matches(rig, body, motion, rng=rng, noise_px=0.0, start=start)
    data = [replace(term, base_from_reference=earlier) for term in data_of(rig, pair.matches)]
    return stack_terms(data, *object_place(data))


def turns_of(stack: Stack) -> FloatArray:
    turns = np.zeros((2**FEW, 3))
    return turns[: affine_turns(stack, sums_of(stack, 0.5), turns)]


def off(turns: FloatArray, rotation: Rotation) -> float:
    """The share of the true turn that the nearest one is off by."""
    return float((Rotation.from_rotvec(turns) * rotation.inv()).magnitude().min() / rotation.magnitude())


@pytest.mark.parametrize("turn", [0.5, 3.0, 12.0])
def test_one_of_them_is_about_the_turn(turn: float) -> None:
    shares = []
    for seed in range(60):
        rotation = random_motion(turn, 0.01, np.random.default_rng(seed)).rotation
        stack = stack_of(RIG, seed, turn)
        found = turns_of(stack)
        if len(found):
            shares.append(off(found, rotation))
    assert len(shares) > 50  # else a camera sees the board from its edge, or not at all
    # To first order: what is left is perspective and the turn's square.
    assert np.median(shares) < 0.35
    assert np.quantile(shares, 0.9) < 0.6


def test_the_mirrored_turn_is_among_them_too() -> None:
    """The lines meet in the turn; those of the second planes pass elsewhere."""
    apart = []
    for seed in range(20):
        found = turns_of(stack_of(RIG, seed, 5.0))
        if len(found):
            gaps = (
                Rotation.from_rotvec(np.repeat(found, 4, axis=0)) * Rotation.from_rotvec(np.tile(found, (4, 1))).inv()
            )
            apart.append(np.degrees(gaps.magnitude().max()))
    assert np.median(apart) > 3.0


@pytest.mark.parametrize(
    ("rig", "body", "earlier"),
    [
        (ring(3), BOARD, None),  # more cameras leave little choice
        (RIG, plane((0.3, 0.002)), None),  # nothing is seen across a line
        (RIG, BOARD, RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.3, 0.0]))),  # of another frame
    ],
    ids=["three cameras", "a line", "another frame"],
)
def test_where_it_says_nothing_there_are_none(rig: Rig, body: Body, earlier: RigidTransform | None) -> None:
    for seed in range(5):
        assert len(turns_of(stack_of(rig, seed, 5.0, body, earlier))) == 0


@pytest.mark.parametrize("x", [np.zeros((8, 2)), np.full((8, 2), 0.1), np.linspace(0, 0.1, 16).reshape(8, 2)])
def test_points_without_sense_give_none(x: ArrayLike) -> None:
    points = np.asarray(x, float)
    data = [
        TermData(c, points, points + 1e-3, camera.rotation, camera.center, camera.focal) for c, camera in enumerate(RIG)
    ]
    assert len(turns_of(stack_terms(data, np.zeros(3), 0.1))) == 0
