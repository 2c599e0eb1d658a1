"""Frames that a refinement loses because their poses start far off are relocalized; inconsistent ones are detected.

A path that breaks because a part of it starts far off is refined again.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.bundle import BundleOptions, BundleResult, Observations, bundle_adjust
from sylpose.bundle_adjustment.calibration_refinement import default_calibration_prior
from sylpose.bundle_adjustment.scale_prior import (
    bundle_adjust_with_scale,
    find_lost_frames,
    find_repeated_observations,
    has_break,
    recover,
    relocalize_lost_frames,
)
from sylpose.geometry.arrays import BoolArray
from sylpose.status import Status
from tests.bundle_adjustment.test_bundle import RADIUS, RIG, disturb_poses, error, path, tracks

FRAMES, AWAY = 16, (5, 11)


@pytest.fixture(scope="module")
def seen() -> tuple[RigidTransform, Observations]:
    poses = path(np.arange(FRAMES))
    return poses, tracks([poses] * len(RIG), 30, 0.3, 0)


def disturbed(poses: RigidTransform, axis: tuple[float, float, float] = (0.6, 0.0, 0.8)) -> RigidTransform:
    """Disturb all poses slightly, and two by 170 degrees and a third of the radius; smaller errors are corrected by a
    refinement."""
    out = list(disturb_poses(poses))
    for k in AWAY:
        turn = Rotation.from_rotvec(np.deg2rad(170.0) * np.array(axis))
        out[k] = RigidTransform.from_components(out[k].translation + RADIUS / 3, turn * out[k].rotation)
    return RigidTransform.concatenate(out)


def first() -> BoolArray:
    return np.asarray(np.arange(FRAMES) == 0)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.6, 0.0, 0.8), (0.0, 0.6, 0.8)])
def test_frame_with_far_start_is_relocalized(
    seen: tuple[RigidTransform, Observations], axis: tuple[float, float, float]
) -> None:
    truth, observations = seen
    start = disturbed(truth, axis)
    alone = bundle_adjust(RIG, observations, start, RADIUS)
    np.testing.assert_array_equal(np.flatnonzero(find_lost_frames(alone, observations)), AWAY)
    found = bundle_adjust_with_scale(RIG, observations, start, RADIUS)
    assert not find_lost_frames(found, observations).any()
    best = bundle_adjust(RIG, observations, truth, RADIUS)
    left = error(best.world_from_object, found.world_from_object)[1:]
    assert np.einsum("ni,nij,nj->n", left, np.linalg.inv(found.covariance[1:]), left).max() < 0.1
    assert ((found.weights > 0) != (best.weights > 0)).sum() <= 3


def test_only_the_inconsistent_frame_is_lost(seen: tuple[RigidTransform, Observations]) -> None:
    truth, observations = seen
    rng, image = np.random.default_rng(3), observations.image.copy()
    junk = observations.frame == AWAY[0]
    image[junk] = rng.uniform(-0.15, 0.15, (int(junk.sum()), 2))
    reported = replace(observations, image=image)
    found = bundle_adjust_with_scale(RIG, reported, disturb_poses(truth), RADIUS)
    assert np.flatnonzero(find_lost_frames(found, reported)).tolist() == [AWAY[0]]
    assert relocalize_lost_frames(RIG, reported, found, first()) is None
    others = np.setdiff1d(np.arange(FRAMES), AWAY[0])
    assert np.abs(error(truth, found.world_from_object)[others, :3]).max() < np.deg2rad(0.3)


def test_fixed_frame_is_not_relocalized(seen: tuple[RigidTransform, Observations]) -> None:
    truth, observations = seen
    start = disturbed(truth)
    alone = bundle_adjust(RIG, observations, start, RADIUS)
    stays = first()
    stays[list(AWAY)] = True
    assert relocalize_lost_frames(RIG, observations, alone, stays) is None
    again = relocalize_lost_frames(RIG, observations, alone, first())
    assert again is not None
    moved = np.abs(error(alone.world_from_object, again)).max(axis=1) > 0
    np.testing.assert_array_equal(np.flatnonzero(moved), AWAY)
    assert np.abs(error(truth, again)[list(AWAY), :3]).max() < np.deg2rad(1.0)


def test_landmarks_observed_once_are_ignored(seen: tuple[RigidTransform, Observations]) -> None:
    _, observations = seen
    counts = np.bincount(observations.landmark)
    np.testing.assert_array_equal(find_repeated_observations(observations), counts[observations.landmark] >= 2)


def turn_once(n: int) -> tuple[RigidTransform, Observations]:
    """Return n poses of one turn, and observations of which few connect the poses from 8 to n - 4 with the others."""
    axis = np.array([0.3, 1.0, 0.2]) / np.linalg.norm([0.3, 1.0, 0.2])
    poses = RigidTransform.from_rotation(Rotation.from_rotvec((np.arange(n + 3) * 2.0 * np.pi / n)[:, None] * axis))
    seen = tracks([poses] * len(RIG), 15, 0.1, 0, longest=6)  # the last three poses are the first ones again
    is_split = np.random.default_rng(3).random(seen.landmark.max() + 1) < 0.6
    part = (seen.frame >= 8).astype(int) + (seen.frame >= n - 3)
    landmark = seen.landmark + np.where(is_split[seen.landmark], part * len(is_split), 0)
    _, landmark = np.unique(landmark, return_inverse=True)
    order = np.argsort(seen.frame % n, kind="stable")
    return poses[:n], Observations(seen.frame[order] % n, seen.camera[order], landmark[order], seen.image[order])


def make_break() -> tuple[RigidTransform, Observations, RigidTransform, BundleOptions]:
    """Return the poses of one turn, observations, poses of which a part is turned, and options with their landmarks."""
    truth, observations = turn_once(24)
    best = bundle_adjust(RIG, observations, truth, RADIUS)
    is_turned = (np.arange(24) >= 8) & (np.arange(24) < 21)
    turn = Rotation.from_rotvec(np.deg2rad(12.0) * is_turned[:, None] * np.array([0.0, 1.0, 0.0]))
    start = RigidTransform.from_rotation(turn) * truth
    first = np.zeros(len(best.landmarks), int)
    first[observations.landmark[::-1]] = observations.frame[::-1]
    landmarks = (start[first].inv() * truth[first]).apply(best.landmarks)
    return truth, observations, start, BundleOptions(landmarks=landmarks)


@pytest.mark.parametrize("recalibrate", [False, True])
def test_broken_path_is_refined_again(recalibrate: bool) -> None:
    truth, observations, start, options = make_break()
    options = replace(options, calibration_prior=default_calibration_prior(RIG), recalibrate=recalibrate)
    alone = bundle_adjust(RIG, observations, start, RADIUS, options)
    best = bundle_adjust(RIG, observations, truth, RADIUS, options)
    fixed = np.arange(24) == 0
    assert has_break(alone, observations, fixed)
    assert not has_break(alone, observations, np.ones(24, bool))
    assert not has_break(best, observations, fixed)
    assert np.abs(error(truth, alone.world_from_object)[:, :3]).max() > np.deg2rad(4.0)
    found = bundle_adjust_with_scale(RIG, observations, start, RADIUS, options)
    assert np.abs(error(best.world_from_object, found.world_from_object)[:, :3]).max() < np.deg2rad(0.05)


def test_converged_result_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A start that does not converge replaces no solution that did, whatever it costs."""
    _, observations, start, options = make_break()
    alone = bundle_adjust(RIG, observations, start, RADIUS, options)
    assert alone.status is Status.OK

    def stop_early(*arguments: Any) -> BundleResult:
        return replace(bundle_adjust(*arguments), status=Status.NOT_CONVERGED)

    monkeypatch.setattr("sylpose.bundle_adjustment.scale_prior.bundle_adjust", stop_early)
    assert recover(RIG, observations, start, alone, RADIUS, options) is alone
    unfinished = replace(alone, status=Status.NOT_CONVERGED)
    assert recover(RIG, observations, start, unfinished, RADIUS, options) is not unfinished
    assert recover(RIG, observations, start, unfinished, RADIUS, replace(options, coarse=True)) is unfinished
