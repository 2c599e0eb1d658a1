"""Never the background: a start needs more than the jitter of what stands still, and a pose more than standing features."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.features.sift import Features
from sylpose.geometry.arrays import Image
from sylpose.landmarks.landmark_filter import new_landmarks
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.results import FrameStatus
from sylpose.rig import Camera
from sylpose.simulate import Actor, arc, demo_scene, render_frames
from sylpose.tracking.camera_executor import OneProcess
from sylpose.tracking.frame import CameraFrame, Pair
from sylpose.tracking.initialization import FirstMotion, agree, first_motion, jitter_of
from sylpose.tracking.joint_state import MIN_MOVED, Joint
from sylpose.tracking.reobserved import CLEARLY, SeenAgain
from sylpose.tracking.reports import Ages, Agreed
from sylpose.tracking.state_machine import PATIENCE
from sylpose.tracking.tracker import track
from tests.clips import HALF_DEGREE, SIZE, Clip, errors, frame_sets, rested, statuses

RIG = arc(2, 60, 1.5, 1000.0)


def wall(sigma: float, moving: int, shift: float, seed: int) -> FirstMotion:
    """What is found of a wall whose keypoints jitter by so much, heavy-tailed, and of a body before it that turns."""
    rng, pairs = np.random.default_rng(seed), []
    turn = Rotation.from_rotvec([0.2 * shift, shift, -0.4 * shift])
    for camera in RIG:
        standing = rng.uniform([20, 20], [1250, 930], (600, 2))
        jitter = sigma * rng.standard_normal((600, 2)) * rng.choice([1.0, 2.5], (600, 1), p=[0.9, 0.1])
        body = rng.uniform(-0.12, 0.12, (moving, 3))
        before, now = camera.project(body), camera.project(turn.apply(body))
        i = np.concatenate([standing, before])
        j = np.concatenate([standing + jitter, now + 0.3 * rng.standard_normal(now.shape)])
        looks = np.zeros((len(i), 128), np.float32)
        earlier, later = (Features(p, camera.normalize(p), looks) for p in (i, j))
        frame = CameraFrame(earlier, np.zeros(len(i), bool), LandmarkTable())
        pairs.append([Pair.of(0, frame, later, np.tile(np.arange(len(i))[:, None], 2))])
    assert jitter_of(pairs[0][0]) == pytest.approx(max(sigma, 0.15), rel=0.35)
    crew = OneProcess(2, 1)
    try:
        return first_motion(crew, RIG, pairs, 0, np.random.default_rng(0))
    finally:
        crew.close()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("sigma", [0.2, 0.9])
def test_the_jitter_of_a_wall_is_no_motion(sigma: float, seed: int) -> None:
    assert not wall(sigma, 0, 0.0, seed).certain


@pytest.mark.parametrize(("sigma", "shift", "certain"), [(0.2, 0.01, False), (0.2, 0.12, True), (0.9, 0.2, True)])
def test_a_body_before_it_is(sigma: float, shift: float, certain: bool) -> None:
    """Once it has moved by clearly more than the wall jitters."""
    found = wall(sigma, 60, shift, 1)
    assert found.certain == certain
    if certain:
        turn = found.motion.rotation * Rotation.from_rotvec([0.2 * shift, shift, -0.4 * shift]).inv()
        assert turn.magnitude() < 0.15 * shift


def test_motions_of_one_body_go_on() -> None:
    """A second motion that explains the matches as well is another one in each frame."""
    one, other = (RigidTransform.from_rotation(Rotation.from_rotvec(np.radians(v))) for v in ([0, 4, 0], [0, 6, 0]))
    away = RigidTransform.from_rotation(Rotation.from_rotvec(np.radians([5, 0, 0])))
    assert agree(one, other)
    assert not agree(away, other)
    assert not agree(None, other)
    slide = RigidTransform.from_translation([0.1, 0.0, 0.0])
    assert agree(slide, slide)


# --- a landmark that has moved with the object, and a pose that such ones support


def seen(residual: float, far: float, camera: Camera = RIG.cameras[0]) -> SeenAgain:
    """One feature, so far from where it was seen first, that agrees with the pose up to a residual, pixels."""
    pixels = np.array([[600.0, 400.0]])
    features = Features(pixels, camera.normalize(pixels), np.zeros((1, 128), np.float32))
    table = LandmarkTable()
    earlier = CameraFrame(features, np.zeros(1, bool), table)
    landmarks = new_landmarks(features, camera, RigidTransform.identity(), np.ones(1), np.full(1, 0.1))
    earlier.numbers = table.learn(landmarks)
    moved = pixels + np.array([far, 0.0])
    later = Features(moved, camera.normalize(moved), features.descriptors)
    pair = Pair.of(0, earlier, later, np.zeros((1, 2), np.int64))
    return SeenAgain.of([pair], [(np.ones(1), np.array([residual]))], 1.5, 1.0)


def test_a_landmark_has_moved_where_the_pose_says_so() -> None:
    assert seen(0.2, 5.0).known.moved.sum() == 1
    assert seen(0.2, 1.0).known.moved.sum() == 0
    # A keypoint that was seen at a wrong place first stands still, and disagrees by as much as it is away.
    assert seen(-1.01 * CLEARLY * 5.0, 5.0).known.moved.sum() == 0
    np.testing.assert_array_equal(seen(0.2, 5.0).known.origin, [[600.0, 400.0]])


def agreed(features: int, moved: int) -> Agreed:
    return Agreed(features, features, (0,), (1.0,), Ages.of(np.ones(features)), features, moved, moved, 0.3, True)


def test_what_was_never_seen_to_move_supports_no_pose_once_the_object_has_moved() -> None:
    before, after = Joint(), replace(Joint(), proven=True)
    only_wall, board = [agreed(900, 3), agreed(700, 0)], [agreed(80, 60), agreed(70, 50)]
    assert not before.may_be_background(only_wall)
    assert after.may_be_background(only_wall)
    assert not after.may_be_background(board)
    assert not before.proven_by(only_wall)
    assert before.proven_by(board)
    # Something that passes by in front of one camera proves nothing; one camera alone has nobody to ask.
    assert not before.proven_by([agreed(80, 60), agreed(70, 0)])
    assert before.proven_by([agreed(80, MIN_MOVED)])


# --- rendered


def compressed(image: Image) -> Image:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 60])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)


def test_an_object_that_stands_for_long_before_a_room_in_compressed_pictures() -> None:
    """All frames are solved in the end, and the standing ones say that it stood."""
    stands, moves = 14, 6
    clip = Clip.render(rested(demo_scene(frames=moves, turn_deg=15, size=SIZE, n_cameras=2, seed=1), stands, moves))
    frames = frame_sets([tuple(compressed(image) for image in images) for images in clip.images])
    tracked = list(track(frames, clip.rig))
    assert stands < PATIENCE
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (len(frames) - 1)
    assert errors(tracked, clip.truth)[:, 0].max() < 2 * HALF_DEGREE
    # The pose of a standing object is known, not defined.
    assert 0 < tracked[5].pose.sigma[:3].max() < np.radians(1.5)


def test_what_vanishes_before_a_room_is_not_followed_into_it() -> None:
    """The object is gone at once, the room stays: no pose pretends."""
    scene = demo_scene(frames=6, turn_deg=15, size=SIZE, n_cameras=2, seed=1)
    clip = Clip.render(scene)
    out_of_sight = Actor(scene.actors[0].body, lambda _: RigidTransform.from_translation([0.0, 50.0, 0.0]))
    rooms = list(render_frames(replace(scene, actors=(out_of_sight,), frames=4)))
    tracked = list(track(frame_sets([*clip.images, *rooms]), clip.rig, clip.boxes))
    assert all(f.pose.status is FrameStatus.TRACKED for f in tracked[1:6])
    assert not any(f.pose.measured for f in tracked[6:])
