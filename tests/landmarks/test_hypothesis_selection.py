"""Of alignments that explain matches alike the one near the prediction is taken, and the others are in its doubt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.alignment import Aligned, align
from sylpose.landmarks.hypothesis_selection import ALIKE, chosen, doubted
from sylpose.rig import Rig
from sylpose.simulate import ring
from tests.landmarks.test_alignment import IDENTITY, motion, sights_of

OFF = np.array([0.05, -0.02, 0.01, 0.004, 0.02, -0.03])


@pytest.fixture(scope="module")
def rig() -> Rig:
    return ring(4, 1.5, 1000.0)


@pytest.fixture(scope="module")
def right(rig: Rig) -> Aligned:
    return align(sights_of(rig, motion(5, 0.03), noise_px=0.3), *IDENTITY)


def moved(one: Aligned, off: FloatArray, vote: float) -> Aligned:
    """Another pose, that is off by (w, d)."""
    turn = Rotation.from_rotvec(off[:3]).as_matrix() @ one.rotation
    return replace(one, rotation=turn, shift=one.shift + off[3:], vote=vote)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_of_two_alike_the_nearer_is_taken_and_knows_of_the_other(right: Aligned, sign: float) -> None:
    other = moved(right, sign * OFF, right.vote - 0.5 * ALIKE)
    best, off = chosen([other, right], right.rotation, right.shift)
    assert best == 1
    np.testing.assert_allclose(off, sign * OFF, atol=1e-12)
    # Predicted where the other is, that one is taken.
    best, off = chosen([other, right], other.rotation, other.shift)
    assert best == 0
    np.testing.assert_allclose(off[3:], -sign * OFF[3:], atol=1e-12)


def test_one_that_knows_little_is_not_nearer_for_it(right: Aligned) -> None:
    sloppy = replace(moved(right, OFF, right.vote), information=0.01 * right.information)
    ahead = moved(right, 0.3 * OFF, 0.0)
    for found in ([sloppy, right], [right, sloppy]):
        assert found[chosen(found, ahead.rotation, ahead.shift)[0]] is right


def test_of_the_same_pose_the_first_is_taken(right: Aligned) -> None:
    sd = 0.2 * OFF / np.sqrt(OFF @ right.information @ OFF)
    same = moved(right, sd, right.vote - 0.1 * ALIKE)
    best, off = chosen([right, same], same.rotation, same.shift)
    assert best == 0
    np.testing.assert_array_equal(off, np.zeros(6))


def test_one_that_explains_more_is_taken_wherever_it_is_and_not_doubted(right: Aligned) -> None:
    worse = moved(right, OFF, right.vote + 1.5 * ALIKE)
    best, off = chosen([worse, right], worse.rotation, worse.shift)
    assert best == 1
    np.testing.assert_array_equal(off, np.zeros(6))


def test_one_that_did_not_settle_is_no_rival(right: Aligned) -> None:
    astray = replace(moved(right, OFF, right.vote), converged=False)
    best, off = chosen([astray, right], astray.rotation, astray.shift)
    assert best == 1
    np.testing.assert_array_equal(off, np.zeros(6))
    # Where none has settled, the one that explains most is as good as any.
    neither = replace(right, converged=False, vote=right.vote + ALIKE)
    best, off = chosen([neither, astray], *IDENTITY)
    assert best == 1
    np.testing.assert_array_equal(off, np.zeros(6))


def test_the_doubt_is_of_the_farthest(right: Aligned) -> None:
    found = [right, *(moved(right, share * OFF, right.vote) for share in (0.3, 1.0, -0.6))]
    np.testing.assert_allclose(chosen(found, right.rotation, right.shift)[1], OFF, atol=1e-12)


def test_doubt_adds_the_square_of_the_difference(right: Aligned) -> None:
    information = doubted(right.information, OFF)
    expected = np.linalg.inv(right.information) + np.outer(OFF, OFF)
    np.testing.assert_allclose(np.linalg.inv(information), expected, rtol=1e-6, atol=1e-9 * expected.max())
    np.testing.assert_array_equal(doubted(right.information, np.zeros(6)), right.information)
    # What nothing was known of stays so.
    np.testing.assert_array_equal(doubted(np.zeros((6, 6)), OFF), np.zeros((6, 6)))


def test_the_vote_is_the_cost_at_one_noise(rig: Rig) -> None:
    # Of twice the noise, the fitted noise explains as much, and one noise for all explains less.
    found = [align(sights_of(rig, motion(5, 0.03), noise_px=px), *IDENTITY) for px in (0.25, 0.5, 1.0)]
    costs, votes = [f.cost for f in found], [f.vote for f in found]
    assert max(costs) < 1.3 * min(costs)
    assert votes[0] < 0.5 * votes[1] < 0.25 * votes[2]
    assert votes[1] == pytest.approx(costs[1], rel=0.2)
