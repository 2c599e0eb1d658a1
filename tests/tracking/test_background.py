"""Background rejection: initial motion exceeds the noise of static features, and poses need moving features."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.features.sift import Features
from sylpose.geometry.arrays import Image
from sylpose.landmarks.landmark_filter import LandmarkTable, initialize_landmarks
from sylpose.relative_pose.terms import MIN_MATCHES
from sylpose.rig import Camera
from sylpose.simulate import Actor, arc, make_demo_scene, render_frames
from sylpose.status import FrameStatus
from sylpose.tracking.camera_side.frame import (
    MAJORITY,
    CameraFrame,
    FrameMatches,
    ReobservedFeatures,
    count_ages,
)
from sylpose.tracking.context import Context, LocalExecutor
from sylpose.tracking.first_motion import FirstMotion, estimate_first_motion, estimate_jitter, is_continuing_motion
from sylpose.tracking.joint_side.joint_state import JointState, ObjectMotion
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.reports import PoseAgreement
from sylpose.tracking.tracker import track
from tests.clips import HALF_DEGREE, SIZE, Clip, compute_pose_errors, frame_sets, prepend_rest, statuses

RIG = arc(2, 60, 1.5, 1000.0)


def estimate_wall_motion(sigma: float, moving: int, translation: float, seed: int) -> FirstMotion:
    """First motion of a wall with heavy-tailed keypoint noise and a rotating body in front of it."""
    rng, pairs = np.random.default_rng(seed), []
    turn = Rotation.from_rotvec([0.2 * translation, translation, -0.4 * translation])
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
        pairs.append([FrameMatches.from_indices(0, frame, later, np.tile(np.arange(len(i))[:, None], 2))])
    assert estimate_jitter(pairs[0][0]) == pytest.approx(max(sigma, 0.15), rel=0.35)
    executor = LocalExecutor(2, 1)
    try:
        context = Context(RIG, (), executor, "landmarks", False, True, np.zeros(2), 0)
        return estimate_first_motion(context, pairs, 0)
    finally:
        executor.close()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("sigma", [0.2, 0.9])
def test_keypoint_noise_of_wall_is_no_motion(sigma: float, seed: int) -> None:
    assert not estimate_wall_motion(sigma, 0, 0.0, seed).is_significant


@pytest.mark.parametrize(("sigma", "shift", "certain"), [(0.2, 0.01, False), (0.2, 0.12, True), (0.9, 0.2, True)])
def test_body_in_front_of_wall_is_motion(sigma: float, shift: float, certain: bool) -> None:
    """Once it has moved clearly more than the wall's noise."""
    found = estimate_wall_motion(sigma, 60, shift, 1)
    assert found.is_significant == certain
    if certain:
        turn = found.motion.rotation * Rotation.from_rotvec([0.2 * shift, shift, -0.4 * shift]).inv()
        assert turn.magnitude() < 0.15 * shift


def test_motions_of_one_body_continue() -> None:
    """An ambiguous second motion differs in each frame."""
    one, other = (RigidTransform.from_rotation(Rotation.from_rotvec(np.radians(v))) for v in ([0, 4, 0], [0, 6, 0]))
    away = RigidTransform.from_rotation(Rotation.from_rotvec(np.radians([5, 0, 0])))
    assert is_continuing_motion(one, other)
    assert not is_continuing_motion(away, other)
    assert not is_continuing_motion(None, other)
    slide = RigidTransform.from_translation([0.1, 0.0, 0.0])
    assert is_continuing_motion(slide, slide)


# --- landmarks that have moved with the object, and poses supported by them


def make_reobserved(residual: float, displacement: float, camera: Camera = RIG.cameras[0]) -> ReobservedFeatures:
    """One feature displaced since its first observation, with a residual in the pose, pixels."""
    pixels = np.array([[600.0, 400.0]])
    features = Features(pixels, camera.normalize(pixels), np.zeros((1, 128), np.float32))
    table = LandmarkTable()
    earlier = CameraFrame(features, np.zeros(1, bool), table)
    landmarks = initialize_landmarks(features, camera, RigidTransform.identity(), np.ones(1), np.full(1, 0.1))
    earlier.landmark_ids = table.update(landmarks)
    moved = pixels + np.array([displacement, 0.0])
    later = Features(moved, camera.normalize(moved), features.descriptors)
    pair = FrameMatches.from_indices(0, earlier, later, np.zeros((1, 2), np.int64))
    return ReobservedFeatures.from_matches([pair], [(np.ones(1), np.array([residual]))], 1.5, 1.0)


def test_landmark_has_moved_if_it_agrees_with_pose() -> None:
    assert make_reobserved(0.2, 5.0).landmarks.has_moved.sum() == 1
    assert make_reobserved(0.2, 1.0).landmarks.has_moved.sum() == 0
    # A wrong first observation of a static keypoint disagrees by as much as it is displaced.
    assert make_reobserved(-1.01 * MAJORITY * 5.0, 5.0).landmarks.has_moved.sum() == 0
    np.testing.assert_array_equal(make_reobserved(0.2, 5.0).landmarks.origin, [[600.0, 400.0]])


def make_agreement(features: int, moved: int) -> PoseAgreement:
    return PoseAgreement(
        features,
        features,
        (0,),
        (1.0,),
        count_ages(np.ones(features)),
        features,
        moved,
        0.3,
        True,
    )


def test_static_features_support_no_pose_after_motion() -> None:
    before, after = JointState(), JointState(motion=ObjectMotion(has_moved=True))
    only_wall, board = (
        [make_agreement(900, 3), make_agreement(700, 0)],
        [make_agreement(80, 60), make_agreement(70, 50)],
    )
    assert not before.may_be_background(only_wall)
    assert after.may_be_background(only_wall)
    assert not after.may_be_background(board)
    assert not before.is_motion_verified(only_wall)
    assert before.is_motion_verified(board)
    # Motion in front of one of several cameras is not enough; a single camera cannot be checked against others.
    assert not before.is_motion_verified([make_agreement(80, 60), make_agreement(70, 0)])
    assert before.is_motion_verified([make_agreement(80, MIN_MATCHES)])


# --- rendered


def compress(image: Image) -> Image:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 60])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)


@pytest.mark.slow
def test_long_static_object_in_compressed_images() -> None:
    """All frames are solved in the end, and static ones have the static status."""
    stands, moves = 8, 4
    clip = Clip.render(
        prepend_rest(make_demo_scene(frames=moves, angle_deg=15, size=SIZE, n_cameras=2, seed=1), stands, moves)
    )
    frames = frame_sets([tuple(compress(image) for image in images) for images in clip.images])
    tracked = list(track(frames, clip.rig))
    assert stands < TrackingOptions.max_buffered_frames
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (len(frames) - 1)
    assert compute_pose_errors(tracked, clip.truth)[:, 0].max() < 2 * HALF_DEGREE
    # The pose of a static object is estimated, not defined.
    assert 0 < tracked[5].pose.sigma[:3].max() < np.radians(1.5)


def test_vanished_object_is_not_replaced_by_room() -> None:
    """The object disappears at once, the room remains: no pose is reported."""
    scene = make_demo_scene(frames=6, angle_deg=15, size=SIZE, n_cameras=2, seed=1)
    clip = Clip.render(scene)
    out_of_sight = Actor(scene.actors[0].body, lambda _: RigidTransform.from_translation([0.0, 50.0, 0.0]))
    rooms = list(render_frames(replace(scene, actors=(out_of_sight,), frames=4)))
    tracked = list(track(frame_sets([*clip.images, *rooms]), clip.rig, clip.boxes))
    assert all(f.pose.status is FrameStatus.TRACKED for f in tracked[1:6])
    assert not any(f.pose.is_measured for f in tracked[6:])
