"""The tracker when the object is hidden or gone, or jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.results import FrameStatus
from sylpose.tracking.tracked_frame import why_none
from sylpose.tracking.tracker import track
from tests.clips import (
    HALF_DEGREE,
    Clip,
    assert_valid,
    board_before,
    drifting,
    errors,
    hidden_clip,
    inliers,
    moving_scene,
    normalised_squares,
    statuses,
    turned,
)


@pytest.mark.parametrize(("features", "back", "most_deg", "most_mm"), [("klt", 10, 0.8, 3), ("sift", 10, 0.3, 1)])
def test_all_cameras_covered_for_a_few_frames(features: str, back: int, most_deg: float, most_mm: float) -> None:
    clip = hidden_clip()
    tracked = list(track(clip.frames(), clip.rig, clip.boxes, features=features))
    # Found again at once, by SIFT's three keyframes, or with all that was to be seen in the last frame before.
    assert statuses(tracked) == [
        FrameStatus.FIRST,
        *[FrameStatus.TRACKED] * 6,
        *[FrameStatus.COASTING] * (back - 7),
        FrameStatus.RELOCALISED,
        *[FrameStatus.TRACKED] * (14 - back),
    ]
    assert_valid(tracked)
    error = errors(tracked, clip.truth)
    assert error[:6, 0].max() < 0.25
    assert error[back - 1 :, 0].max() < most_deg
    assert error[back - 1 :, 1].max() < most_mm
    # It goes on as it did, and what is said of that covers the error and grows.
    coasting = tracked[7:10]
    assert error[6:9, 0].max() < 1
    assert normalised_squares(tracked, clip.truth)[6:9].max() < 40
    assert (np.diff([np.linalg.norm(f.pose.sigma[3:]) for f in coasting]) > 0).all()
    assert not any(f.pose.measured for f in coasting)


def test_all_cameras_covered_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sylpose.tracking.joint_state.MAX_COASTING", 5)
    first, last = 6, 12
    rig = moving_scene(drifting, 1).rig

    def path(frame: float) -> RigidTransform:
        return drifting(min(frame, first) + 0.65 * max(frame - first, 0))  # slower, unseen

    clip = Clip.render(moving_scene(path, 17, [board_before(camera, first, last) for camera in rig]))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    hidden = statuses(tracked)[first : last + 1]
    n = hidden.index(FrameStatus.LOST)
    assert n == 5
    assert hidden == [FrameStatus.COASTING] * n + [FrameStatus.LOST] * (len(hidden) - n)
    assert all(f.pose.world_from_object is None for f in tracked[first + n : last + 1])
    found = statuses(tracked)[last + 1 :].index(FrameStatus.RELOCALISED)
    assert found < 3
    assert statuses(tracked)[last + 2 + found :] == [FrameStatus.TRACKED] * (17 - last - 2 - found)
    assert errors(tracked, clip.truth)[-(17 - last - 1 - found) :, 0].max() < 0.8
    assert_valid(tracked)


def test_half_of_the_cameras_covered() -> None:
    rig = moving_scene(drifting, 1).rig
    boards = [board_before(rig.cameras[c], 7, 12) for c in (0, 2)]
    clip = Clip.render(moving_scene(drifting, 18, boards))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 17
    seen = inliers(tracked)
    assert seen[7:13, [0, 2]].max() < 20
    assert (seen[7:13, [1, 3]] > 40).all()
    assert (seen[-1] > 40).all()
    error = errors(tracked, clip.truth)
    assert error[:, 0].max() < 0.8
    assert error[12:, 0].max() < HALF_DEGREE
    # By then it is known where the surface is, and so how far it turned.
    assert np.degrees([np.linalg.norm(f.pose.sigma[:3]) for f in tracked[6:]]).max() < 1.0


def leaving(frame: float) -> RigidTransform:
    """Up and out of sight from frame 6 to 10, back from 18 to 22, and slowly turning all the time."""
    away = float(np.clip((frame - 6) / 4, 0, 1) * np.clip((22 - frame) / 4, 0, 1))
    return RigidTransform.from_translation([0, -0.9 * away, 0]) * turned(1.5 * frame)


def test_leaving_and_coming_back() -> None:
    clip = Clip.render(moving_scene(leaving, 28))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    found = statuses(tracked)
    assert found[:7] == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 6
    assert FrameStatus.LOST in found[10:18]
    assert set(found[11:18]) <= {FrameStatus.COASTING, FrameStatus.LOST, FrameStatus.ONLY_STILL}
    back = found.index(FrameStatus.RELOCALISED)
    assert back <= 22 + 2
    assert set(found[back + 1 :]) == {FrameStatus.TRACKED}
    after = [f for f in tracked if f.pose.index == 0 or f.pose.index > 24]
    assert errors(after, clip.truth)[:, 0].max() < 0.8
    assert_valid(tracked)


@pytest.mark.parametrize("steady", [pytest.param(3, marks=pytest.mark.slow), 8])
def test_a_jump(steady: int) -> None:
    """15 degrees and a tenth of the distance from one frame to the next, after slow and steady motion."""

    def path(frame: float) -> RigidTransform:
        jumped = 15.0 if frame >= steady else 0.0
        return turned(2 * frame + jumped, np.array([0.003, -0.001, 0.002]) * frame + [0.008 * jumped, 0, 0])

    clip = Clip.render(moving_scene(path, steady + 4))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (steady + 3)
    error = errors(tracked, clip.truth)
    assert error[:, 0].max() < HALF_DEGREE
    assert error[:, 1].max() < 2


def test_why_a_frame_has_no_pose() -> None:
    clip = hidden_clip()
    tracked = list(track(clip.frames()[:12], clip.rig, clip.boxes))
    for frame in tracked:
        pose, sought = frame.pose, frame.sought
        if pose.status is FrameStatus.FIRST:
            assert not pose.reason
            continue
        # What is drawn is what was counted.
        assert [len(camera.rejected) for camera in sought] == list(pose.matches - pose.inliers)
        assert all(len(camera.features) >= n for camera, n in zip(sought, pose.matches, strict=True))
        assert bool(pose.reason) == (not pose.measured)
    hidden = tracked[8].pose
    assert hidden.reason == why_none(
        hidden.status, sum(len(camera.features) for camera in tracked[8].sought), int(hidden.matches.sum())
    )
    assert "match" in hidden.reason or "feature" in hidden.reason


def test_nothing_to_be_seen_is_said_as_such() -> None:
    clip = Clip.render(moving_scene(drifting, 8))
    frames = clip.frames()
    blank = [
        replace(f, images=tuple(np.full_like(image, 90) for image in f.images if image is not None)) for f in frames[5:]
    ]
    tracked = list(track([*frames[:5], *blank], clip.rig, clip.boxes))
    assert {f.pose.reason for f in tracked[5:]} == {"0 features where it was looked for, in all cameras together"}
    assert all(len(camera.features) == len(camera.rejected) == 0 for f in tracked[5:] for camera in f.sought)


@pytest.mark.parametrize(
    ("status", "features", "matches", "said"),
    [
        (FrameStatus.LOST, 1, 0, "1 feature where it was looked for, in all cameras together"),
        (FrameStatus.LOST, 300, 4, "4 of 300 features match what is known of the object"),
        (FrameStatus.COASTING, 300, 40, "no pose agrees with enough of the 40 matches among 300 features"),
        (FrameStatus.NO_MOTION, 300, 0, "300 features, too few of which moved, or by too little"),
        (FrameStatus.NOT_CONSISTENT, 300, 0, "300 features; what moved was no rigid body, or not for long"),
        (FrameStatus.ONLY_STILL, 300, 40, "what agrees with a pose stands still and was never seen to move"),
    ],
)
def test_reasons(status: FrameStatus, features: int, matches: int, said: str) -> None:
    assert why_none(status, features, matches) == said
