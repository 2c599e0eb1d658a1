"""Why a run has no pose, in few sentences."""

from __future__ import annotations

import numpy as np

from sylpose.report.failure_reasons import MOST_REASONS, alike, why_nothing
from sylpose.report.plots import trajectory_figure
from sylpose.results import FramePose, FrameStatus, Trajectory


def nothing(reasons: list[str]) -> Trajectory:
    none = np.full((6, 6), np.nan)
    zero, none_of = np.zeros(1), np.zeros(1, np.int64)
    frames = [
        FramePose(k, k, FrameStatus.LOST, None, none, none_of, zero, reason=reason) for k, reason in enumerate(reasons)
    ]
    return Trajectory(frames, ["cam_0"])


def test_sentences_that_differ_in_numbers_only_are_one() -> None:
    moved = [f"{n} features; cam_1 moved 2.5 px" for n in (900, 1100, 95)]
    said = [*moved[:2], "no light", moved[2]]
    assert alike(said) == [("95 to 1100 features; cam_1 moved 2.5 px", 3), ("no light", 1)]
    # A number within a name makes another one of it.
    assert alike(["cam_1 is dark", "cam_2 is dark"]) == [("cam_1 is dark", 1), ("cam_2 is dark", 1)]
    assert alike([]) == []


def test_why_nothing_counts_frames() -> None:
    said = why_nothing(nothing(["5117 features; nothing moved"] * 2 + ["5203 features; nothing moved", "dark"]))
    assert said == [
        f"4 frames: lost. {FrameStatus.LOST.text}",
        "3 frames: 5117 to 5203 features; nothing moved",
        "1 frame: dark",
    ]
    many = why_nothing(nothing([f"reason {chr(97 + k)}" for k in range(MOST_REASONS + 2)]))
    assert len(many) == MOST_REASONS + 2
    assert many[-1] == "and 2 more reasons: see the column reason of trajectory.csv"


def test_the_picture_says_first_what_looked_wrong_before() -> None:
    its = nothing(["dark"] * 3)
    said = [
        text.get_text() for text in trajectory_figure(its, noticed=["The cameras look away from each other."]).texts
    ]
    assert said.index("The cameras look away from each other.") < said.index("3 frames: dark")
    assert "What looked wrong before the run" not in [text.get_text() for text in trajectory_figure(its).texts]
