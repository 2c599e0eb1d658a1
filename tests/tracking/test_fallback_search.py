"""Jumps from frame to frame, and little to go by: what the usual way does not find, the thorough way does; and not more."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.kinds import KINDS
from sylpose.features.sift import Features, detect
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.landmarks.landmark_filter import new_landmarks
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.results import FrameStatus
from sylpose.rig import Camera
from sylpose.simulate import Actor, Scene, TexturedBody
from sylpose.tracking import camera as camera_module
from sylpose.tracking import joint_state as joint_module
from sylpose.tracking import state_machine
from sylpose.tracking.context import Team
from sylpose.tracking.frame import CameraFrame, Frame, Pair, without_background
from sylpose.tracking.joint_state import Joint
from sylpose.tracking.pose_search import Found
from sylpose.tracking.tracker import track
from tests.clips import Clip, errors, moving_scene, statuses, turned

N_CAMERAS, FRAMES = 3, 5
# Of the paint that is left: SIFT's usual threshold finds next to nothing on it.
PALE = 0.12


def painted(scene: Scene, contrast: float) -> Scene:
    """The scene with its object's paint made so much paler."""

    def pale(texture: Image) -> Image:
        return np.rint(128 + contrast * (texture.astype(float) - 128)).astype(np.uint8)

    body: TexturedBody = scene.actors[0].body
    body = replace(body, textures=tuple(map(pale, body.textures)))
    return replace(scene, actors=(Actor(body, scene.actors[0].path), *scene.actors[1:]))


def jumping(degrees: float, contrast: float = 1.0) -> Clip:
    return Clip.render(painted(moving_scene(lambda k: turned(degrees * k), FRAMES, n_cameras=N_CAMERAS), contrast))


@pytest.mark.parametrize("features", ["klt", "sift"])
def test_jumps_from_the_first_frame_on(features: str) -> None:
    clip = jumping(20.0)
    tracked = list(track(clip.frames(), clip.rig, clip.boxes, features=features))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
    assert errors(tracked, clip.truth)[:, 0].max() < 1.0


@pytest.fixture(scope="module")
def pale() -> Clip:
    return jumping(12.0, PALE)


def test_pale_paint(pale: Clip) -> None:
    tracked = list(track(pale.frames(), pale.rig, pale.boxes, features="sift"))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
    assert errors(tracked, pale.truth)[:, 0].max() < 2.0


def test_the_usual_way_finds_it_by_faint_features_alone(pale: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_machine, "searched", lambda _team, joint, *_: (joint, None))
    tracked = list(track(pale.frames(), pale.rig, pale.boxes, features="sift"))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (FRAMES - 1)
    assert errors(tracked, pale.truth)[:, 0].max() < 2.0
    monkeypatch.setattr(state_machine, "FEW_AT_FIRST", 0)
    monkeypatch.setattr(joint_module, "STARVES", 0)
    tracked = list(track(pale.frames(), pale.rig, pale.boxes, features="sift"))
    assert statuses(tracked).count(FrameStatus.TRACKED) < FRAMES - 1


@pytest.mark.parametrize(("contrast", "faint"), [(1.0, False), (PALE, True)])
def test_faint_features_are_asked_for_where_there_is_little_else(
    contrast: float, faint: bool, pale: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rich object does not pay for them."""
    asked: list[bool] = []

    def spied(*args: Any, **kwargs: Any) -> Features:
        asked.append(kwargs["faint"])
        return detect(*args, **kwargs)

    monkeypatch.setattr(camera_module, "detect", spied)
    clip = pale if contrast == PALE else jumping(8.0)
    list(track(clip.frames(), clip.rig, clip.boxes, features="sift"))
    assert any(asked) == faint
    assert all(asked[-N_CAMERAS:]) == faint


def test_a_slow_object_is_looked_for_anew_where_little_agrees(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was followed has slipped in the last frame, together: a wrong pose of which a few features tell."""
    clip, usual = jumping(4.0), state_machine._found
    slips: list[int] = []

    def slipped(team: Team, joint: Joint, frame: Frame, *args: Any, **kwargs: Any) -> tuple[Joint, Found | None]:
        joint, found = usual(team, joint, frame, *args, **kwargs)
        if found is None or frame.number != FRAMES - 1:
            return joint, found
        slips.append(frame.number)
        motion = turned(6.0) * found.motion
        return joint, replace(found, motion=motion, agreed=tuple(replace(a, features=4) for a in found.agreed))

    monkeypatch.setattr(state_machine, "_found", slipped)
    tracked = list(track(clip.frames(), clip.rig, clip.boxes))
    assert slips
    assert statuses(tracked)[-1] is FrameStatus.TRACKED
    assert errors(tracked, clip.truth)[:, 0].max() < 1.0


def test_no_pose_where_it_is_not(pale: Clip) -> None:
    """After the second frame nothing but the room is seen."""
    gone = Clip.render(moving_scene(lambda _: turned(0, [0, 9, 0]), 2, n_cameras=N_CAMERAS))
    frames = pale.frames()[:2]
    frames += [
        FrameSet(k, k / 30, (None,) * N_CAMERAS, tuple(i), (None,) * N_CAMERAS) for k, i in enumerate(gone.images, 2)
    ]
    tracked = list(track(frames, pale.rig, pale.boxes, features="sift"))
    assert FrameStatus.TRACKED in statuses(tracked)[:2]
    assert set(statuses(tracked)[2:]) <= {FrameStatus.COASTING, FrameStatus.LOST}


def test_where_it_was_there_is_only_the_room() -> None:
    """It turned by 45 degrees, and is gone for four frames: there the room has more that can be found than it had."""
    take = KINDS["back"](np.random.default_rng([1, *b"back"]))
    tracked = list(track(itertools.islice(take.frames(), 13), take.scene.rig, take.boxes))
    assert statuses(tracked)[1:10] == [FrameStatus.TRACKED] * 9
    assert set(statuses(tracked)[10:]) <= {FrameStatus.COASTING, FrameStatus.LOST, FrameStatus.ONLY_STILL}


def test_what_stands_still_where_the_object_should_move_is_background() -> None:
    """But not what was seen to move before: then it is the object that has stopped."""
    camera, radius = moving_scene(turned, 1).rig.cameras[0], 0.15
    before, ahead = turned(0), turned(0, [0.15, 0, 0])
    pixels = camera.project(np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3)))
    features = features_at(camera, pixels)
    shift = np.zeros((40, 2))
    shift[20:] = 9.0
    later = features_at(camera, pixels + shift)
    distance = np.full(40, np.linalg.norm(camera.center))
    known = new_landmarks(features, camera, before.inv(), distance, np.full(40, radius))
    known.moved[:10] = True
    earlier, current = (CameraFrame(f, np.zeros(40, bool), LandmarkTable()) for f in (features, later))
    earlier.numbers = earlier.table.learn(known)
    pair = Pair.of(0, earlier, later, np.column_stack([np.arange(40)] * 2))
    kept = without_background(pair, current, camera, before, ahead, radius)
    assert kept.indices[:, 0].tolist() == [*range(10), *range(20, 40)]
    assert np.flatnonzero(current.background).tolist() == list(range(10, 20))
    # An object that is to stand still says nothing of what does.
    assert len(without_background(pair, current, camera, before, before, radius)) == 40


def features_at(camera: Camera, pixels: FloatArray) -> Features:
    """Features of any look."""
    return Features(pixels, camera.normalize(pixels), np.zeros((len(pixels), 128), np.float32))
