"""Limits and sizes of the tracker: their ranges, and that they reach the steps that they belong to."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from sylpose import RunOptions, TrackingOptions, track
from sylpose.commands.track import parse_tracking_options
from sylpose.simulate import make_demo_scene, ring
from sylpose.status import FrameStatus
from sylpose.tracking.joint_side.joint_state import add_keyframe
from sylpose.tracking.map_update import add_f_ratio, pool_known
from sylpose.tracking.tracker import Tracker
from tests.clips import Clip, statuses
from tests.tracking.test_keyframes import make_frame, make_rotated

NAMES = [field.name for field in fields(TrackingOptions)]


@cache
def make_clip() -> Clip:
    return Clip.render(make_demo_scene(frames=4, angle_deg=12, size=(320, 240), n_cameras=3, seed=1))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [-1, float("nan"), "12", None])
def test_values_out_of_range_are_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name}: .* is not a (whole|finite) number (from|of|above)"):
        TrackingOptions(**{name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [("max_rival_ratio", 1.5), ("min_keyframe_rotation", 6.0), ("max_window_frames", 3), ("max_features", 12.5)],
)
def test_values_of_other_units_are_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name}: "):
        TrackingOptions(**{name: value})


def test_changes_are_those_that_differ() -> None:
    assert not TrackingOptions().changes
    assert TrackingOptions(max_keyframes=100, min_score=30).changes == {"min_score": 30.0}


def test_each_field_is_described_once() -> None:
    described = str(TrackingOptions.__doc__).split("Attributes:")[1].split("Raises:")[0]
    assert [line.split(":")[0].strip() for line in described.splitlines() if line[8:9].strip() and ":" in line] == NAMES


def test_options_of_the_command_line() -> None:
    assert parse_tracking_options(["max_keyframes=30", "min_score=25.5"]) == TrackingOptions(
        max_keyframes=30, min_score=25.5
    )
    for text, message in (
        ("max_keyframe=30", "--set: 'max_keyframe' is not one of max_f_ratio, "),
        ("max_keyframes=many", "--set max_keyframes: 'many' is not a number"),
        ("max_keyframes", "--set max_keyframes: '' is not a number"),
        ("max_keyframes=1", "^max_keyframes: 1 is not a whole number from 3"),
    ):
        with pytest.raises(ValueError, match=message):
            parse_tracking_options([text])


def test_other_types_are_refused() -> None:
    options: Any = {"max_keyframes": 30}
    with pytest.raises(TypeError, match=r"^options must be"):
        Tracker(make_clip().rig, options=options)
    with pytest.raises(TypeError, match=r"^tracking must be"):
        RunOptions(tracking=options)


def test_limits_of_contradictions() -> None:
    strict, wide = TrackingOptions(max_pooled_f_ratio=2.0), TrackingOptions(max_pooled_f_ratio=4.0)
    ratios: tuple[float, ...] = ()
    for _ in range(5):
        ratios = add_f_ratio(ratios, 3.0, replace(strict, n_pooled_f_ratios=4))
    assert len(ratios) == 4
    assert strict.max_pooled_f_ratio < pool_known(ratios) <= wide.max_pooled_f_ratio


def test_keyframes_from_smaller_rotations() -> None:
    rig = ring(3, 1.5)
    first, second = make_frame(rig, 0, make_rotated(0.0)), make_frame(rig, 1, make_rotated(3.0))
    near = TrackingOptions(min_keyframe_rotation=np.radians(2.0))
    assert len(add_keyframe((first,), second, TrackingOptions())) == 1
    assert len(add_keyframe((first,), second, near)) == 2


def test_options_reach_the_tracker() -> None:
    """The defaults are those without options; a limit that no frame meets lets none be tracked."""
    clip = make_clip()
    usual = list(track(clip.frames(), clip.rig, clip.boxes))
    same = list(track(clip.frames(), clip.rig, clip.boxes, options=TrackingOptions()))
    assert statuses(usual)[1:] == [FrameStatus.TRACKED] * 3
    for one, other in zip(usual, same, strict=True):
        assert one.pose.world_from_object is not None
        assert other.pose.world_from_object is not None
        np.testing.assert_array_equal(
            one.pose.world_from_object.as_matrix(), other.pose.world_from_object.as_matrix(), strict=True
        )
        np.testing.assert_array_equal(one.pose.covariance, other.pose.covariance)
    strict = TrackingOptions(min_score=1e6)
    assert FrameStatus.TRACKED not in statuses(track(clip.frames(), clip.rig, clip.boxes, options=strict))
    few = list(track(clip.frames(), clip.rig, clip.boxes, options=TrackingOptions(max_features=100)))
    assert few[1].pose.inliers.sum() < usual[1].pose.inliers.sum()
