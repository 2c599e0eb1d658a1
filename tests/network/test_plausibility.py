"""Impossible payloads are rejected; truthful ones are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sylpose.landmarks.messages import EvaluationMessage, TermsMessage
from sylpose.network.plausibility import find_implausibility
from sylpose.tracking.reports import (
    CameraMotionReport,
    CameraTerms,
    InitialMatches,
    KnownDepthMatches,
    LandmarkAges,
    MovingMatches,
    PoseAgreement,
    RelocalizationMatches,
    TrackingReport,
)
from tests.network.test_codec import TERM

GOOD = TermsMessage(np.concatenate([np.eye(6)[np.triu_indices(6)], np.ones(6)]), 5.0, 0.4)
NO_MATCHES = "its match statistics are impossible"
NO_INFORMATION = "its pose information matrix is invalid"


def change_upper(says: TermsMessage, at: int, value: float) -> TermsMessage:
    upper = says.upper.copy()
    upper[at] = value
    return replace(says, upper=upper)


@pytest.mark.parametrize(
    "told",
    [
        (GOOD, TermsMessage(np.zeros(27), 0.0, np.nan)),
        (change_upper(GOOD, 1, 1.0),),  # singular
        GOOD.to_single_precision(),
        PoseAgreement(),
        TrackingReport(),
        KnownDepthMatches(),
        CameraMotionReport(),
        (EvaluationMessage(1.0, 2.0, 3, 3, 4.0),),
        (0, 0.0),
        True,
        np.zeros((0, 3)),
    ],
    ids=str,
)
def test_plausible_payloads_are_accepted(told: object) -> None:
    assert find_implausibility(told, 0) is None


@pytest.mark.parametrize(
    ("told", "why"),
    [
        ((GOOD, change_upper(GOOD, 0, -1.0)), NO_INFORMATION),
        ((change_upper(GOOD, 1, 1.1),), NO_INFORMATION),
        ((change_upper(GOOD, 26, np.nan),), NO_INFORMATION),
        ((change_upper(GOOD, 0, np.inf),), NO_INFORMATION),
        ((change_upper(GOOD, 0, 1e22),), NO_MATCHES),
        ((replace(GOOD, weight_sum=0.0),), NO_MATCHES),
        ((replace(GOOD, weight_sum=np.nan),), NO_MATCHES),
        ((replace(GOOD, noise_px=0.0),), NO_MATCHES),
        ((EvaluationMessage(1.0, 2.0, 4, 3, 4.0),), NO_MATCHES),
        ((EvaluationMessage(np.nan, 2.0, 3, 3, 4.0),), NO_MATCHES),
        (TrackingReport(-1, 0, True, True), NO_MATCHES),
        (replace(PoseAgreement(), references=(3,), weights=(np.nan,)), NO_MATCHES),
        (replace(PoseAgreement(), references=(3,)), NO_MATCHES),
        (replace(PoseAgreement(), n_inlier_features=3, n_strong=4), NO_MATCHES),
        (replace(PoseAgreement(), noise_px=-1.0), NO_MATCHES),
        (LandmarkAges(np.array([3.0]), np.array([-1.0])), NO_MATCHES),
        (LandmarkAges(np.array([3.0, 4.0]), np.array([9e6, 9e6])), NO_MATCHES),
        (KnownDepthMatches(weights=np.ones(1)), NO_MATCHES),
        (RelocalizationMatches(np.full((1, 3), np.nan), np.zeros((1, 2))), NO_MATCHES),
        (np.full((1, 3), 1e10), NO_MATCHES),
        (10**9, NO_MATCHES),
    ],
    ids=str,
)
def test_implausible_payloads_are_rejected(told: object, why: str) -> None:
    assert find_implausibility(told, 0) == why


def test_matches_must_be_of_sending_camera() -> None:
    moving = MovingMatches(TERM, np.ones(len(TERM.x)), 0.5, 0)
    for payload in (CameraTerms((TERM,)), InitialMatches((moving,)), moving, (TERM,)):
        assert find_implausibility(payload, TERM.camera) is None
        assert find_implausibility(payload, TERM.camera + 1) == NO_MATCHES
    for count in (len(TERM.x) - 1, len(TERM.x) + 1):
        assert find_implausibility(replace(moving, displacement_px=np.ones(count)), TERM.camera) == NO_MATCHES
    for wrong in (replace(TERM, rotation=2 * np.eye(3)), replace(TERM, focal=0.0)):
        assert find_implausibility(CameraTerms((wrong,)), TERM.camera) == NO_MATCHES
        assert find_implausibility(InitialMatches((replace(moving, term=wrong),)), TERM.camera) == NO_MATCHES
