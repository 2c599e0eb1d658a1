"""The state machine's checks of poses that it has found."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from sylpose.tracking.reports import PoseAgreement
from sylpose.tracking.state_machine import has_known_references


def test_pose_rests_on_known_frames_only() -> None:
    """A search that starts again from the first frame discards the frames that an earlier candidate rests on."""
    agreements = [PoseAgreement(references=(0, 2)), PoseAgreement(references=(2,)), PoseAgreement()]
    candidate = cast(Any, SimpleNamespace(agreements=agreements))
    before, after = (
        cast(Any, SimpleNamespace(frames=SimpleNamespace(by_number=known))) for known in ({0: 0, 2: 0}, {0: 0})
    )
    assert has_known_references(before, candidate)
    assert not has_known_references(after, candidate)
