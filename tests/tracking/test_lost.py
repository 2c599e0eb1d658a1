"""The tracker when the object is hidden, leaves the view or jumps."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.status import FrameStatus
from sylpose.tracking.context import TrackedFrame, explain_missing_pose
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.tracker import track
from tests.clips import (
    HALF_DEGREE,
    Clip,
    assert_valid,
    compute_pose_errors,
    compute_squared_mahalanobis,
    hidden_clip,
    inliers,
    make_drifting_pose,
    make_occluding_board,
    make_rotated_pose,
    moving_scene,
    statuses,
)


@cache
def track_hidden_clip(features: str) -> tuple[TrackedFrame, ...]:
    """Return the tracking result of `hidden_clip`; read only."""
    clip = hidden_clip()
    return tuple(track(clip.frames(), clip.rig, clip.boxes, features=features))


@pytest.mark.parametrize(
    ("features", "back", "most_deg", "most_mm"),
    [("klt", 10, 0.8, 3), pytest.param("sift", 10, 0.3, 1, marks=pytest.mark.slow)],
)
def test_all_cameras_covered_for_a_few_frames(features: str, back: int, most_deg: float, most_mm: float) -> None:
    clip, tracked = hidden_clip(), track_hidden_clip(features)
    # Relocalized at once, by three SIFT keyframes or by all features of the last frame before.
    assert statuses(tracked) == [
        FrameStatus.FIRST,
        *[FrameStatus.TRACKED] * 6,
        *[FrameStatus.COASTING] * (back - 7),
        FrameStatus.RELOCALIZED,
        *[FrameStatus.TRACKED] * (14 - back),
    ]
    assert_valid(tracked)
    error = compute_pose_errors(tracked, clip.truth)
    assert error[:6, 0].max() < 0.25
    assert error[back - 1 :, 0].max() < most_deg
    assert error[back - 1 :, 1].max() < most_mm
    # The predicted covariance covers the error and grows.
    coasting = tracked[7:10]
    assert error[6:9, 0].max() < 1
    assert compute_squared_mahalanobis(tracked, clip.truth)[6:9].max() < 40
    assert (np.diff([np.linalg.norm(f.pose.sigma[3:]) for f in coasting]) > 0).all()
    assert not any(f.pose.is_measured for f in coasting)


def test_all_cameras_covered_for_long() -> None:
    first, last = 5, 8
    frames = last + 5
    rig = moving_scene(make_drifting_pose, 1, n_cameras=3).rig

    def path(frame: float) -> RigidTransform:
        return make_drifting_pose(min(frame, first) + 0.65 * max(frame - first, 0))  # slower while hidden

    boards = [make_occluding_board(camera, first, last) for camera in rig]
    clip = Clip.render(moving_scene(path, frames, boards, n_cameras=3))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes, options=TrackingOptions(max_coasting_frames=2)))
    hidden = statuses(tracked)[first : last + 1]
    n = hidden.index(FrameStatus.LOST)
    assert n == 2
    assert hidden == [FrameStatus.COASTING] * n + [FrameStatus.LOST] * (len(hidden) - n)
    assert all(f.pose.world_from_object is None for f in tracked[first + n : last + 1])
    found = statuses(tracked)[last + 1 :].index(FrameStatus.RELOCALIZED)
    assert found < 3
    assert statuses(tracked)[last + 2 + found :] == [FrameStatus.TRACKED] * (frames - last - 2 - found)
    assert compute_pose_errors(tracked, clip.truth)[-(frames - last - 1 - found) :, 0].max() < 0.8
    assert_valid(tracked)


@pytest.mark.slow
def test_half_of_the_cameras_covered() -> None:
    rig = moving_scene(make_drifting_pose, 1).rig
    boards = [make_occluding_board(rig.cameras[c], 7, 10) for c in (0, 2)]
    clip = Clip.render(moving_scene(make_drifting_pose, 15, boards))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 14
    seen = inliers(tracked)
    assert seen[7:11, [0, 2]].max() < 20
    assert (seen[7:11, [1, 3]] > 40).all()
    assert (seen[-1] > 40).all()
    error = compute_pose_errors(tracked, clip.truth)
    assert error[:, 0].max() < 0.8
    assert error[10:, 0].max() < HALF_DEGREE
    # By then the depth is known, and so is the rotation angle.
    assert np.degrees([np.linalg.norm(f.pose.sigma[:3]) for f in tracked[6:]]).max() < 1.0


def leaving_path(frame: float) -> RigidTransform:
    """Up and out of view from frame 6 to 10, back from 14 to 18, rotating slowly all the time."""
    away = float(np.clip((frame - 6) / 4, 0, 1) * np.clip((18 - frame) / 4, 0, 1))
    return RigidTransform.from_translation([0, -0.9 * away, 0]) * make_rotated_pose(1.5 * frame)


@pytest.mark.slow
def test_leaving_and_coming_back() -> None:
    clip = Clip.render(moving_scene(leaving_path, 23, n_cameras=3))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes, options=TrackingOptions(max_coasting_frames=2)))
    found = statuses(tracked)
    assert found[:7] == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 6
    assert FrameStatus.LOST in found[10:14]
    assert set(found[11:14]) <= {FrameStatus.COASTING, FrameStatus.LOST, FrameStatus.BACKGROUND_ONLY}
    back = found.index(FrameStatus.RELOCALIZED)
    assert back <= 18 + 2
    assert set(found[back + 1 :]) == {FrameStatus.TRACKED}
    after = [f for f in tracked if f.pose.index == 0 or f.pose.index > 20]
    assert compute_pose_errors(after, clip.truth)[:, 0].max() < 0.8
    assert_valid(tracked)


@pytest.mark.parametrize("steady", [3, pytest.param(8, marks=pytest.mark.slow)])
def test_jump(steady: int) -> None:
    """15 degrees and a tenth of the distance between two frames, after slow, steady motion."""

    def path(frame: float) -> RigidTransform:
        jumped = 15.0 if frame >= steady else 0.0
        return make_rotated_pose(2 * frame + jumped, np.array([0.003, -0.001, 0.002]) * frame + [0.008 * jumped, 0, 0])

    clip = Clip.render(moving_scene(path, steady + 4))
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (steady + 3)
    error = compute_pose_errors(tracked, clip.truth)
    assert error[:, 0].max() < HALF_DEGREE
    assert error[:, 1].max() < 2


def test_explanation_of_missing_pose() -> None:
    tracked = track_hidden_clip("klt")[:9]
    for frame in tracked:
        pose, sought = frame.pose, frame.detections
        if pose.status is FrameStatus.FIRST:
            assert not pose.reason
            continue
        # The drawn features are the counted ones.
        assert [len(camera.rejected) for camera in sought] == list(pose.matches - pose.inliers)
        assert all(len(camera.features) >= n for camera, n in zip(sought, pose.matches, strict=True))
        assert bool(pose.reason) == (not pose.is_measured)
    hidden = tracked[8].pose
    assert hidden.reason == explain_missing_pose(
        hidden.status, sum(len(camera.features) for camera in tracked[8].detections), int(hidden.matches.sum())
    )
    assert "match" in hidden.reason or "feature" in hidden.reason


def test_images_without_features_are_reported() -> None:
    clip = hidden_clip()  # in view until frame 6
    frames = clip.frames()
    blank = [
        replace(f, images=tuple(np.full_like(image, 90) for image in f.images if image is not None))
        for f in frames[3:5]
    ]
    tracked = list(track([*frames[:3], *blank], clip.rig, clip.boxes))
    assert {f.pose.reason for f in tracked[3:]} == {"0 features in the search regions of all cameras"}
    assert all(len(camera.features) == len(camera.rejected) == 0 for f in tracked[3:] for camera in f.detections)


@pytest.mark.parametrize(
    ("status", "features", "matches", "said"),
    [
        (FrameStatus.LOST, 1, 0, "1 feature in the search regions of all cameras"),
        (FrameStatus.LOST, 300, 4, "4 of 300 features match known landmarks"),
        (FrameStatus.COASTING, 300, 40, "no pose fits enough of the 40 matches among 300 features"),
        (FrameStatus.NO_MOTION, 300, 0, "300 features, too few of which moved far enough"),
        (FrameStatus.NOT_CONSISTENT, 300, 0, "300 features; no rigid motion lasted long enough"),
        (FrameStatus.BACKGROUND_ONLY, 300, 40, "features that agree with a pose are static and never moved"),
    ],
)
def test_reason_texts(status: FrameStatus, features: int, matches: int, said: str) -> None:
    assert explain_missing_pose(status, features, matches) == said
