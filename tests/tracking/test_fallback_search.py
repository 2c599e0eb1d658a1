"""Jumps between frames and low texture: the fallback search finds what the usual search misses, without false poses."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from benchmarks.kinds import KINDS
from sylpose.features.sift import Features, detect_features
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.landmarks.landmark_filter import LandmarkTable, initialize_landmarks
from sylpose.rig import Camera
from sylpose.simulate import Actor, Scene, TexturedBody
from sylpose.status import FrameStatus
from sylpose.tracking import relocalization, state_machine
from sylpose.tracking.camera_side import camera as camera_module
from sylpose.tracking.camera_side.frame import CameraFrame, FrameMatches, drop_background
from sylpose.tracking.context import Context, Frame
from sylpose.tracking.joint_side.joint_state import JointState, KnownMotion
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.pose_search import PoseCandidate, SearchResult, find_pose
from sylpose.tracking.tracker import track
from tests.clips import Clip, compute_pose_errors, make_rotated_pose, moving_scene, statuses

N_CAMERAS, FRAMES = 3, 5
# Remaining contrast of the texture: at the usual threshold SIFT detects almost no features on it.
LOW_CONTRAST = 0.12


def reduce_contrast(scene: Scene, contrast: float) -> Scene:
    """Return the scene with its object's texture at reduced contrast."""

    def fade(texture: Image) -> Image:
        return np.rint(128 + contrast * (texture.astype(float) - 128)).astype(np.uint8)

    body: TexturedBody = scene.actors[0].body
    body = replace(body, textures=tuple(map(fade, body.textures)))
    return replace(scene, actors=(Actor(body, scene.actors[0].path), *scene.actors[1:]))


def make_jumping_clip(degrees: float, contrast: float = 1.0) -> Clip:
    return Clip.render(
        reduce_contrast(moving_scene(lambda k: make_rotated_pose(degrees * k), FRAMES, n_cameras=N_CAMERAS), contrast)
    )


@pytest.mark.parametrize("features", ["klt", pytest.param("sift", marks=pytest.mark.slow)])
def test_jumps_from_first_frame(features: str) -> None:
    clip = make_jumping_clip(20.0)
    tracked = list(track(clip.frames(), clip.rig, clip.boxes, features=features))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
    assert compute_pose_errors(tracked, clip.truth)[:, 0].max() < 1.0


@pytest.fixture(scope="module")
def low_contrast_clip() -> Clip:
    return make_jumping_clip(12.0, LOW_CONTRAST)


def test_low_contrast_texture(low_contrast_clip: Clip) -> None:
    tracked = list(track(low_contrast_clip.frames(), low_contrast_clip.rig, low_contrast_clip.boxes, features="sift"))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
    assert compute_pose_errors(tracked, low_contrast_clip.truth)[:, 0].max() < 2.0


def test_position_jumps_while_rotation_is_slow() -> None:
    """A plain object steps further than features are searched for near the prediction, in frame 12."""
    variation = KINDS["plain"](np.random.default_rng([30, *b"plain"]))
    frames = list(itertools.islice(variation.frames(), 14))
    tracked = list(track(frames, variation.scene.rig, variation.boxes, seed=30))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (len(frames) - 1)


def test_usual_search_with_low_contrast_features(low_contrast_clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relocalization, "find_pose_with_all_features", lambda _team, joint, *_: (joint, None))
    tracked = list(track(low_contrast_clip.frames(), low_contrast_clip.rig, low_contrast_clip.boxes, features="sift"))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
    assert compute_pose_errors(tracked, low_contrast_clip.truth)[:, 0].max() < 2.0
    clip, options = low_contrast_clip, TrackingOptions(min_strong_inliers=0)
    tracked = list(track(clip.frames(), clip.rig, clip.boxes, features="sift", options=options))
    assert statuses(tracked).count(FrameStatus.TRACKED) < FRAMES - 1


@pytest.mark.parametrize(
    ("contrast", "faint"), [pytest.param(1.0, False, marks=pytest.mark.slow), (LOW_CONTRAST, True)]
)
def test_low_contrast_features_are_used_if_needed(
    contrast: float, faint: bool, low_contrast_clip: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Objects rich in texture do not need them."""
    arguments: list[bool] = []

    def spy_detect(*args: Any, **kwargs: Any) -> Features:
        arguments.append(kwargs["faint"])
        return detect_features(*args, **kwargs)

    monkeypatch.setattr(camera_module, "detect_features", spy_detect)
    clip = low_contrast_clip if contrast == LOW_CONTRAST else make_jumping_clip(8.0)
    list(track(clip.frames(), clip.rig, clip.boxes, features="sift"))
    assert any(arguments) == faint
    assert all(arguments[-N_CAMERAS:]) == faint


def test_slow_object_with_weak_pose_is_searched_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """All tracks have slipped together in the last frame: a wrong pose with few inliers."""
    clip, usual = make_jumping_clip(4.0), find_pose
    slips: list[int] = []

    def slip(
        context: Context, state: JointState, frame: Frame, *args: Any, **kwargs: Any
    ) -> tuple[JointState, PoseCandidate | None]:
        state, found = usual(context, state, frame, *args, **kwargs)
        if found is None or frame.number != FRAMES - 1 or frame.has_new_features:
            return state, found
        slips.append(frame.number)
        motion = make_rotated_pose(6.0) * found.motion
        return state, replace(
            found,
            motion=motion,
            pose=motion * state.last.world_from_object,
            agreements=tuple(replace(a, n_inlier_features=4) for a in found.agreements),
        )

    monkeypatch.setattr(state_machine, "find_pose", slip)
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    assert slips
    assert statuses(tracked)[-1] is FrameStatus.TRACKED
    assert compute_pose_errors(tracked, clip.truth)[:, 0].max() < 1.0


def test_noisy_pose_of_slow_object_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """With residuals far above those before, as of a room after the object has left."""
    clip, usual = make_jumping_clip(4.0), find_pose

    def blur(context: Context, state: JointState, frame: Frame, guess: RigidTransform) -> SearchResult:
        state, found = usual(context, state, frame, guess)
        if found is None or frame.number != FRAMES - 1:
            return state, found
        return state, replace(found, agreements=tuple(replace(a, noise_px=20.0) for a in found.agreements))

    monkeypatch.setattr(state_machine, "find_pose", blur)
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    assert statuses(tracked)[1:] == [*[FrameStatus.TRACKED] * (FRAMES - 2), FrameStatus.COASTING]


def test_no_pose_of_absent_object(low_contrast_clip: Clip) -> None:
    """After the second frame only the room is visible."""
    gone = Clip.render(moving_scene(lambda _: make_rotated_pose(0, [0, 9, 0]), 2, n_cameras=N_CAMERAS))
    frames = low_contrast_clip.frames()[:2]
    frames += [
        FrameSet(k, k / 30, (None,) * N_CAMERAS, tuple(i), (None,) * N_CAMERAS) for k, i in enumerate(gone.images, 2)
    ]
    tracked = list(track(frames, low_contrast_clip.rig, low_contrast_clip.boxes, features="sift"))
    assert FrameStatus.TRACKED in statuses(tracked)[:2]
    assert set(statuses(tracked)[2:]) <= {FrameStatus.COASTING, FrameStatus.LOST}


def test_no_pose_from_room_after_object_left() -> None:
    """The object rotated by 45 degrees and is gone for four frames; the room has more features than it had."""
    take = KINDS["back"](np.random.default_rng([1, *b"back"]))
    tracked = list(track(itertools.islice(take.frames(), 13), take.scene.rig, take.boxes))
    assert statuses(tracked)[1:10] == [FrameStatus.TRACKED] * 9
    assert set(statuses(tracked)[10:]) <= {FrameStatus.COASTING, FrameStatus.LOST, FrameStatus.BACKGROUND_ONLY}


def test_static_features_of_predicted_motion_are_background() -> None:
    """Except landmarks that have moved before: then the object has stopped."""
    camera, radius = moving_scene(make_rotated_pose, 1).rig.cameras[0], 0.15
    before, predicted_pose = make_rotated_pose(0), make_rotated_pose(0, [0.15, 0, 0])
    pixels = camera.project(np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3)))
    features = make_features(camera, pixels)
    translation = np.zeros((40, 2))
    translation[20:] = 9.0
    later = make_features(camera, pixels + translation)
    distance = np.full(40, np.linalg.norm(camera.center))
    known = initialize_landmarks(features, camera, before.inv(), distance, np.full(40, radius))
    known.has_moved[:10] = True
    earlier, current = (CameraFrame(f, np.zeros(40, bool), LandmarkTable()) for f in (features, later))
    earlier.landmark_ids = earlier.table.update(known)
    pair = FrameMatches.from_indices(0, earlier, later, np.column_stack([np.arange(40)] * 2))
    (kept,) = drop_background([pair], current, camera, KnownMotion({0: before}, predicted_pose, radius))
    assert kept.indices[:, 0].tolist() == [*range(10), *range(20, 40)]
    assert np.flatnonzero(current.background).tolist() == list(range(10, 20))
    # An object predicted to be static gives no evidence of background.
    (unchanged,) = drop_background([pair], current, camera, KnownMotion({0: before}, before, radius))
    assert len(unchanged) == 40


def make_features(camera: Camera, pixels: FloatArray) -> Features:
    """Features with arbitrary descriptors."""
    return Features(pixels, camera.normalize(pixels), np.zeros((len(pixels), 128), np.float32))
