"""Of equally good alignments the one near the prediction is selected, and the others widen its covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.alignment import (
    MAX_COST_DIFFERENCE,
    AlignmentResult,
    align,
    select_hypothesis,
    subtract_uncertainty,
)
from sylpose.rig import Rig
from sylpose.simulate import ring
from tests.landmarks.test_alignment import IDENTITY, make_all_matches, motion

OFF = np.array([0.05, -0.02, 0.01, 0.004, 0.02, -0.03])


@pytest.fixture(scope="module")
def rig() -> Rig:
    return ring(4, 1.5, 1000.0)


@pytest.fixture(scope="module")
def right(rig: Rig) -> AlignmentResult:
    return align(make_all_matches(rig, motion(5, 0.03), noise_px=0.3), *IDENTITY)


def offset_pose(one: AlignmentResult, off: FloatArray, vote: float) -> AlignmentResult:
    """Return another pose, offset by (w, d)."""
    turn = Rotation.from_rotvec(off[:3]).as_matrix() @ one.rotation
    return replace(one, rotation=turn, translation=one.translation + off[3:], reference_cost=vote)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_nearer_of_two_equal_hypotheses_is_selected(right: AlignmentResult, sign: float) -> None:
    other = offset_pose(right, sign * OFF, right.reference_cost - 0.5 * MAX_COST_DIFFERENCE)
    best, off = select_hypothesis([other, right], right.rotation, right.translation)
    assert best == 1
    np.testing.assert_allclose(off, sign * OFF, atol=1e-12)
    # If the prediction is at the other, that one is selected.
    best, off = select_hypothesis([other, right], other.rotation, other.translation)
    assert best == 0
    np.testing.assert_allclose(off[3:], -sign * OFF[3:], atol=1e-12)


def test_uncertain_hypothesis_is_not_preferred(right: AlignmentResult) -> None:
    sloppy = replace(offset_pose(right, OFF, right.reference_cost), information=0.01 * right.information)
    ahead = offset_pose(right, 0.3 * OFF, 0.0)
    for found in ([sloppy, right], [right, sloppy]):
        assert found[select_hypothesis(found, ahead.rotation, ahead.translation)[0]] is right


def test_first_of_equal_poses_is_selected(right: AlignmentResult) -> None:
    sd = 0.2 * OFF / np.sqrt(OFF @ right.information @ OFF)
    same = offset_pose(right, sd, right.reference_cost - 0.1 * MAX_COST_DIFFERENCE)
    best, off = select_hypothesis([right, same], same.rotation, same.translation)
    assert best == 0
    np.testing.assert_array_equal(off, np.zeros(6))


def test_clearly_better_hypothesis_is_selected(right: AlignmentResult) -> None:
    worse = offset_pose(right, OFF, right.reference_cost + 1.5 * MAX_COST_DIFFERENCE)
    best, off = select_hypothesis([worse, right], worse.rotation, worse.translation)
    assert best == 1
    np.testing.assert_array_equal(off, np.zeros(6))


def test_unconverged_hypothesis_is_ignored(right: AlignmentResult) -> None:
    astray = replace(offset_pose(right, OFF, right.reference_cost), converged=False)
    best, off = select_hypothesis([astray, right], astray.rotation, astray.translation)
    assert best == 1
    np.testing.assert_array_equal(off, np.zeros(6))
    # If none converged, the one with the lowest cost is selected.
    neither = replace(right, converged=False, reference_cost=right.reference_cost + MAX_COST_DIFFERENCE)
    best, off = select_hypothesis([neither, astray], *IDENTITY)
    assert best == 1
    np.testing.assert_array_equal(off, np.zeros(6))


def test_difference_is_to_the_farthest(right: AlignmentResult) -> None:
    found = [right, *(offset_pose(right, share * OFF, right.reference_cost) for share in (0.3, 1.0, -0.6))]
    np.testing.assert_allclose(select_hypothesis(found, right.rotation, right.translation)[1], OFF, atol=1e-12)


def test_difference_is_added_to_the_covariance(right: AlignmentResult) -> None:
    information = subtract_uncertainty(right.information, OFF)
    expected = np.linalg.inv(right.information) + np.outer(OFF, OFF)
    np.testing.assert_allclose(np.linalg.inv(information), expected, rtol=1e-6, atol=1e-9 * expected.max())
    np.testing.assert_array_equal(subtract_uncertainty(right.information, np.zeros(6)), right.information)
    # Unobservable directions stay unobservable.
    np.testing.assert_array_equal(subtract_uncertainty(np.zeros((6, 6)), OFF), np.zeros((6, 6)))


def test_vote_is_the_cost_at_a_fixed_noise(rig: Rig) -> None:
    # With twice the noise, the fit with estimated noise explains as much, and that with a fixed noise less.
    found = [align(make_all_matches(rig, motion(5, 0.03), noise_px=px), *IDENTITY) for px in (0.25, 0.5, 1.0)]
    costs, votes = [f.cost for f in found], [f.reference_cost for f in found]
    assert max(costs) < 1.3 * min(costs)
    assert votes[0] < 0.5 * votes[1] < 0.25 * votes[2]
    assert votes[1] == pytest.approx(costs[1], rel=0.2)
