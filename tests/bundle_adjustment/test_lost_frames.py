"""Frames that a refinement gives up, because their poses start far off, are found again; those that contradict are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.bundle import Observations, bundle
from sylpose.bundle_adjustment.lost_frames import counted_of, found_again, given_up
from sylpose.bundle_adjustment.scale_prior import bundle_sized
from sylpose.geometry.arrays import BoolArray
from tests.bundle_adjustment.test_bundle import RADIUS, RIG, error, off, path, tracks

FRAMES, AWAY = 16, (5, 11)


@pytest.fixture(scope="module")
def seen() -> tuple[RigidTransform, Observations]:
    poses = path(np.arange(FRAMES))
    return poses, tracks([poses] * len(RIG), 30, 0.3, 0)


def disturbed(poses: RigidTransform, axis: tuple[float, float, float] = (0.6, 0.0, 0.8)) -> RigidTransform:
    """All a little, and two of them by 170 degrees and a third of the radius; from less a refinement finds back."""
    out = list(off(poses))
    for k in AWAY:
        turn = Rotation.from_rotvec(np.deg2rad(170.0) * np.array(axis))
        out[k] = RigidTransform.from_components(out[k].translation + RADIUS / 3, turn * out[k].rotation)
    return RigidTransform.concatenate(out)


def first() -> BoolArray:
    return np.asarray(np.arange(FRAMES) == 0)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.6, 0.0, 0.8), (0.0, 0.6, 0.8)])
def test_a_frame_that_starts_far_off_is_found_again(
    seen: tuple[RigidTransform, Observations], axis: tuple[float, float, float]
) -> None:
    truth, observations = seen
    start = disturbed(truth, axis)
    alone = bundle(RIG, observations, start, RADIUS)
    np.testing.assert_array_equal(np.flatnonzero(given_up(alone, observations)), AWAY)
    found = bundle_sized(RIG, observations, start, RADIUS)
    assert not given_up(found, observations).any()
    best = bundle(RIG, observations, truth, RADIUS)
    left = error(best.world_from_object, found.world_from_object)[1:]
    assert np.einsum("ni,nij,nj->n", left, np.linalg.inv(found.covariance[1:]), left).max() < 0.1
    assert ((found.weights > 0) != (best.weights > 0)).sum() <= 3


def test_what_contradicts_all_others_is_given_up_and_nothing_else(seen: tuple[RigidTransform, Observations]) -> None:
    truth, observations = seen
    rng, image = np.random.default_rng(3), observations.image.copy()
    junk = observations.frame == AWAY[0]
    image[junk] = rng.uniform(-0.15, 0.15, (int(junk.sum()), 2))
    told = replace(observations, image=image)
    found = bundle_sized(RIG, told, off(truth), RADIUS)
    assert np.flatnonzero(given_up(found, told)).tolist() == [AWAY[0]]
    assert found_again(RIG, told, found, first()) is None
    others = np.setdiff1d(np.arange(FRAMES), AWAY[0])
    assert np.abs(error(truth, found.world_from_object)[others, :3]).max() < np.deg2rad(0.3)


def test_a_frame_that_stays_is_not_looked_for(seen: tuple[RigidTransform, Observations]) -> None:
    truth, observations = seen
    start = disturbed(truth)
    alone = bundle(RIG, observations, start, RADIUS)
    stays = first()
    stays[list(AWAY)] = True
    assert found_again(RIG, observations, alone, stays) is None
    again = found_again(RIG, observations, alone, first())
    assert again is not None
    moved = np.abs(error(alone.world_from_object, again)).max(axis=1) > 0
    np.testing.assert_array_equal(np.flatnonzero(moved), AWAY)
    assert np.abs(error(truth, again)[list(AWAY), :3]).max() < np.deg2rad(1.0)


def test_landmarks_seen_once_say_nothing(seen: tuple[RigidTransform, Observations]) -> None:
    _, observations = seen
    counts = np.bincount(observations.landmark)
    np.testing.assert_array_equal(counted_of(observations), counts[observations.landmark] >= 2)
