"""Reasons for missing poses, in few sentences."""

from __future__ import annotations

import numpy as np

from sylpose.report.failure_reasons import MAX_REASONS, explain_missing_poses, group_sentences
from sylpose.report.plots import draw_trajectory_figure
from sylpose.results import FramePose, Trajectory
from sylpose.status import FrameStatus


def make_lost_trajectory(reasons: list[str]) -> Trajectory:
    none = np.full((6, 6), np.nan)
    zero, none_of = np.zeros(1), np.zeros(1, np.int64)
    frames = [
        FramePose(k, k, FrameStatus.LOST, None, none, none_of, zero, reason=reason) for k, reason in enumerate(reasons)
    ]
    return Trajectory(frames, ["cam_0"])


def test_sentences_with_different_numbers_are_grouped() -> None:
    moved = [f"{n} features; cam_1 moved 2.5 px" for n in (900, 1100, 95)]
    sentences = [*moved[:2], "no light", moved[2]]
    assert group_sentences(sentences) == [("95 to 1100 features; cam_1 moved 2.5 px", 3), ("no light", 1)]
    # A number within a name makes a different sentence.
    assert group_sentences(["cam_1 is dark", "cam_2 is dark"]) == [("cam_1 is dark", 1), ("cam_2 is dark", 1)]
    assert group_sentences([]) == []


def test_reasons_have_frame_counts() -> None:
    lines = explain_missing_poses(
        make_lost_trajectory(["5117 features; nothing moved"] * 2 + ["5203 features; nothing moved", "dark"])
    )
    assert lines == [
        f"4 frames: lost. {FrameStatus.LOST.text}",
        "3 frames: 5117 to 5203 features; nothing moved",
        "1 frame: dark",
    ]
    many = explain_missing_poses(make_lost_trajectory([f"reason {chr(97 + k)}" for k in range(MAX_REASONS + 2)]))
    assert len(many) == MAX_REASONS + 2
    assert many[-1] == "and 2 more reasons: see the column reason of trajectory.csv"


def test_figure_lists_input_problems_first() -> None:
    its = make_lost_trajectory(["dark"] * 3)
    texts = [
        text.get_text()
        for text in draw_trajectory_figure(its, input_warnings=["The cameras look away from each other."]).texts
    ]
    assert texts.index("The cameras look away from each other.") < texts.index("3 frames: dark")
    assert "Problems found before the run" not in [text.get_text() for text in draw_trajectory_figure(its).texts]
