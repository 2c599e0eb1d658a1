"""What cannot be true is refused; what cameras tell in truth is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sylpose.landmarks.messages import Judges, Says
from sylpose.network.plausibility import objection
from sylpose.tracking.reports import Ages, Agreed, Following, Known, Recognised, Stance
from tests.network.test_codec import TERM

GOOD = Says(np.concatenate([np.eye(6)[np.triu_indices(6)], np.ones(6)]), 5.0, 0.4)
NO_MATCHES = "what it says of its matches is of none"
NO_INFORMATION = "what it says of the pose is no information"


def changed(says: Says, at: int, value: float) -> Says:
    upper = says.upper.copy()
    upper[at] = value
    return replace(says, upper=upper)


@pytest.mark.parametrize(
    "told",
    [
        (GOOD, Says(np.zeros(27), 0.0, np.nan)),
        (changed(GOOD, 1, 1.0),),  # singular
        GOOD.coarse(),
        Agreed.none(),
        Following.none(),
        Known.none(),
        Stance(),
        (Judges(1.0, 2.0, 3, 3, 4.0),),
        (0, 0.0),
        True,
        np.zeros((0, 3)),
    ],
    ids=str,
)
def test_what_can_be_true_is_taken(told: object) -> None:
    assert objection(told, 0) is None


@pytest.mark.parametrize(
    ("told", "why"),
    [
        ((GOOD, changed(GOOD, 0, -1.0)), NO_INFORMATION),
        ((changed(GOOD, 1, 1.1),), NO_INFORMATION),
        ((changed(GOOD, 26, np.nan),), NO_INFORMATION),
        ((changed(GOOD, 0, np.inf),), NO_INFORMATION),
        ((changed(GOOD, 0, 1e22),), NO_MATCHES),
        ((replace(GOOD, mass=0.0),), NO_MATCHES),
        ((replace(GOOD, mass=np.nan),), NO_MATCHES),
        ((replace(GOOD, level_px=0.0),), NO_MATCHES),
        ((Judges(1.0, 2.0, 4, 3, 4.0),), NO_MATCHES),
        ((Judges(np.nan, 2.0, 3, 3, 4.0),), NO_MATCHES),
        (Following(-1, 0, True, True), NO_MATCHES),
        (replace(Agreed.none(), references=(3,), weights=(np.nan,)), NO_MATCHES),
        (replace(Agreed.none(), references=(3,)), NO_MATCHES),
        (replace(Agreed.none(), features=3, strong=4), NO_MATCHES),
        (replace(Agreed.none(), noise_px=-1.0), NO_MATCHES),
        (Ages(np.array([3.0]), np.array([-1.0])), NO_MATCHES),
        (Ages(np.array([3.0, 4.0]), np.array([9e6, 9e6])), NO_MATCHES),
        (Recognised(np.full((1, 3), np.nan), np.zeros((1, 2))), NO_MATCHES),
        (np.full((1, 3), 1e10), NO_MATCHES),
        (10**9, NO_MATCHES),
    ],
    ids=str,
)
def test_what_cannot_be_true_is_refused(told: object, why: str) -> None:
    assert objection(told, 0) == why


def test_matches_are_the_cameras_own() -> None:
    assert objection([TERM], TERM.camera) is None
    assert objection([TERM], TERM.camera + 1) == NO_MATCHES
    assert objection([replace(TERM, rotation=2 * np.eye(3))], TERM.camera) == NO_MATCHES
    assert objection([replace(TERM, focal=0.0)], TERM.camera) == NO_MATCHES
