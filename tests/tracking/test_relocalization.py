"""Relocalization from keyframe landmarks anywhere in the images, without false detections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.absolute_pose.pose import estimate_pose
from sylpose.features.sift import MAX_FAINT_FEATURES, MAX_FEATURES, Features, detect_features
from sylpose.geometry.arrays import Image
from sylpose.landmarks.landmark_filter import Landmarks, LandmarkTable, initialize_landmarks
from sylpose.rig import Camera, Rig
from sylpose.simulate import Actor, chamfered_box, make_demo_scene
from sylpose.status import Status
from sylpose.tracking.camera_side.frame import CameraFrame
from sylpose.tracking.joint_side.joint_state import SolvedFrame, compute_viewpoints
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.relocalization import (
    N_KEYFRAMES,
    estimate_relocalized_pose,
    has_known_references,
    match_keyframes,
    select_keyframes,
)
from sylpose.tracking.reports import PoseAgreement, RelocalizationMatches
from tests.clips import SIZE, Clip, Images, make_rotated_pose, moving_scene, surface_points

# Rotations of the keyframes, and the positions of the object.
ROTATIONS_DEG = (0.0, 12.0, 24.0, 36.0)
N_CAMERAS = 3
RADIUS = 0.15
# Poses to relocalize: rotated further, farther away, rotated back, at a known view but another position.
ELSEWHERE = [
    make_rotated_pose(56, [0.16, 0.08, 0.05]),
    make_rotated_pose(18, [-0.1, -0.05, 0.3]),
    make_rotated_pose(-20, [-0.17, 0.1, -0.1]),
    make_rotated_pose(24, [0.2, -0.1, 0]),
]


class Keyframe(NamedTuple):
    """A solved frame and each camera's data of it."""

    solved: SolvedFrame
    cameras: list[CameraFrame]


def relocalize_frame(
    rig: Rig,
    keyframes: Sequence[Keyframe],
    current: Sequence[CameraFrame],
    last: Keyframe,
    radius: float,
    missed: int,
) -> RigidTransform | None:
    """Relocalize as the tracker does: per-camera matching with keyframes, then a joint pose."""
    return estimate_relocalized_pose(rig, match_frame(keyframes, current, last, radius, missed), TrackingOptions())


def match_frame(
    keyframes: Sequence[Keyframe], current: Sequence[CameraFrame], last: Keyframe, radius: float, missed: int
) -> list[RelocalizationMatches]:
    """Match each camera's frame with the keyframes that the tracker would try."""
    solved, by_number = [k.solved for k in keyframes], {k.solved.number: k.cameras for k in keyframes}
    records = []
    for c, camera_frame in enumerate(current):
        tried = select_keyframes(solved, c, last.solved, missed)
        records.append(
            match_keyframes([by_number[k.number][c] for k in tried], camera_frame, radius, TrackingOptions())
        )
    return records


@pytest.fixture(scope="module")
def clip() -> Clip:
    """The keyframes, then the poses to relocalize."""
    poses = [*(make_rotated_pose(turn) for turn in ROTATIONS_DEG), *ELSEWHERE]
    return Clip.render(moving_scene(lambda frame: poses[round(frame)], len(poses), n_cameras=N_CAMERAS))


@pytest.fixture(scope="module")
def keyframes(clip: Clip) -> list[Keyframe]:
    return [make_keyframe(clip, k) for k in range(len(ROTATIONS_DEG))]


def detect_in_image(image: Image, camera: Camera, faint: bool) -> Features:
    return detect_features(image, camera, None, MAX_FAINT_FEATURES if faint else MAX_FEATURES, faint=faint)


def make_keyframe(clip: Clip, k: int, sd: float = 0.02 * RADIUS, *, faint: bool = False) -> Keyframe:
    """A frame with the object's features and their true positions, with standard deviation sd."""
    pose = clip.truth.world_from_object[k]
    kept, landmarks = [], []
    for camera, image in zip(clip.rig, clip.images[k], strict=True):
        features = detect_in_image(image, camera, faint)
        places = surface_points(camera, features.normalized, pose, clip.truth.vertices)
        on_it = np.isfinite(places[:, 0])
        distance = np.linalg.norm(places[on_it] - pose.inv().apply(camera.center), axis=1)
        kept.append(features.subset(on_it))
        landmarks.append(initialize_landmarks(kept[-1], camera, pose.inv(), distance, np.full(len(distance), sd)))
    cameras = [make_known_frame(f, m) for f, m in zip(kept, landmarks, strict=True)]
    return make_solved(clip.rig, k, pose, cameras)


def make_known_frame(features: Features, landmarks: Landmarks) -> CameraFrame:
    """A camera's frame with given landmarks only."""
    table = LandmarkTable()
    return CameraFrame(features, np.zeros(len(features), bool), table, table.update(landmarks))


def make_solved(rig: Rig, number: int, pose: RigidTransform, cameras: list[CameraFrame]) -> Keyframe:
    sees = np.array([len(camera.features) > 0 for camera in cameras])
    time_offsets, covariance = np.zeros(len(rig)), np.zeros((6, 6))
    return Keyframe(
        SolvedFrame(number, number / 30, time_offsets, pose, covariance, compute_viewpoints(rig, pose), sees), cameras
    )


def detect_in_frames(rig: Rig, images: Images, *, faint: bool = False) -> list[CameraFrame]:
    """Camera frames with all features in the images."""
    features = [
        Features.empty() if image is None else detect_in_image(image, camera, faint)
        for camera, image in zip(rig, images, strict=True)
    ]
    return [CameraFrame(f, np.zeros(len(f), bool), LandmarkTable()) for f in features]


def pose_errors(found: RigidTransform | None, true: RigidTransform) -> tuple[float, float]:
    """Degrees; millimeters of the center."""
    assert found is not None
    turn = np.rad2deg((found.rotation * true.rotation.inv()).magnitude())
    return float(turn), 1e3 * float(np.linalg.norm(found.translation - true.translation))


@pytest.mark.parametrize("k", range(len(ELSEWHERE)))
def test_relocalizes_rotated_and_moved_object(clip: Clip, keyframes: list[Keyframe], k: int) -> None:
    k += len(ROTATIONS_DEG)
    for last in (keyframes[0], keyframes[-1]):
        found = relocalize_frame(clip.rig, keyframes, detect_in_frames(clip.rig, clip.images[k]), last, RADIUS, 0)
        degrees, millimetres = pose_errors(found, clip.truth.world_from_object[k])
        assert degrees < 1.5
        assert millimetres < 8


def test_single_camera_suffices(clip: Clip, keyframes: list[Keyframe]) -> None:
    k = len(ROTATIONS_DEG)
    for c in range(N_CAMERAS):
        images: Images = [image if i == c else None for i, image in enumerate(clip.images[k])]
        found = relocalize_frame(clip.rig, keyframes, detect_in_frames(clip.rig, images), keyframes[-1], RADIUS, 0)
        if found is not None:  # a few matches of one camera may not suffice
            assert pose_errors(found, clip.truth.world_from_object[k])[0] < 5
    alone = clip.rig.subset(["cam_1"])
    only = [make_solved(alone, r.solved.number, r.solved.world_from_object, r.cameras[1:2]) for r in keyframes]
    k = len(ROTATIONS_DEG) + 3
    found = relocalize_frame(alone, only, detect_in_frames(alone, clip.images[k][1:2]), only[0], RADIUS, 0)
    assert pose_errors(found, clip.truth.world_from_object[k])[0] < 3


def make_other_body(path_of: Sequence[RigidTransform], seed: int) -> Clip:
    """A different body than the keyframes'."""
    body = chamfered_box(np.array([0.3, 0.22, 0.26]), 430, seed=seed)
    scene = make_demo_scene(frames=1, size=SIZE, n_cameras=N_CAMERAS)
    actors = (Actor(body, lambda frame: path_of[round(frame)]),)
    return Clip.render(replace(scene, actors=actors, frames=len(path_of)))


@pytest.mark.parametrize(("texels", "turn"), [(4.5, 45.0), (6.0, 35.0)])
def test_relocalizes_blurred_texture(texels: float, turn: float) -> None:
    poses = [make_rotated_pose(0), make_rotated_pose(turn, [0.1, 0.05, 0])]
    scene = moving_scene(lambda frame: poses[round(frame)], 2, n_cameras=N_CAMERAS)
    body, path = scene.actors[0].body, scene.actors[0].path
    soft = tuple(np.asarray(cv2.GaussianBlur(t, (0, 0), texels), np.uint8) for t in body.textures)
    clip = Clip.render(replace(scene, actors=(Actor(replace(body, textures=soft), path),)))
    first, current = make_keyframe(clip, 0, faint=True), detect_in_frames(clip.rig, clip.images[1], faint=True)
    found = relocalize_frame(clip.rig, [first], current, first, RADIUS, 0)
    assert pose_errors(found, clip.truth.world_from_object[1])[0] < 1.5


def test_all_features_do_not_find_other_body(clip: Clip) -> None:
    known = [make_keyframe(clip, k, faint=True) for k in range(len(ROTATIONS_DEG))]
    for seed in (11, 12):
        other = make_other_body([make_rotated_pose(0), make_rotated_pose(24, [0.1, 0, 0])], seed)
        for images in other.images:
            current = detect_in_frames(clip.rig, images, faint=True)
            assert relocalize_frame(clip.rig, known, current, known[0], RADIUS, 0) is None


def test_absent_object_is_not_found(clip: Clip, keyframes: list[Keyframe]) -> None:
    nowhere = RigidTransform.from_translation([0, 50, 0])
    empty = Clip.render(moving_scene(lambda _: nowhere, 1, n_cameras=N_CAMERAS))
    assert (
        relocalize_frame(clip.rig, keyframes, detect_in_frames(clip.rig, empty.images[0]), keyframes[0], RADIUS, 0)
        is None
    )
    for seed in (11, 12, 13):
        other = make_other_body([make_rotated_pose(0), make_rotated_pose(24, [0.1, 0, 0])], seed)
        for images in other.images:
            assert (
                relocalize_frame(clip.rig, keyframes, detect_in_frames(clip.rig, images), keyframes[0], RADIUS, 0)
                is None
            )
    nothing: Images = (None,) * N_CAMERAS
    assert relocalize_frame(clip.rig, keyframes, detect_in_frames(clip.rig, nothing), keyframes[0], RADIUS, 0) is None


def test_unseen_side_is_not_found(clip: Clip, keyframes: list[Keyframe]) -> None:
    """Its other sides, whose corners look alike: no pose, rather than a wrong one, whatever the random samples."""
    upside_down = Rotation.from_rotvec([np.pi, 0, 0])
    turns = [Rotation.from_rotvec([0, np.pi, 0]), upside_down * Rotation.from_rotvec([0, 0.5, 0]), upside_down]
    behind = [RigidTransform.from_rotation(turn) for turn in turns]
    back = Clip.render(moving_scene(lambda frame: behind[round(frame)], len(behind), n_cameras=N_CAMERAS))
    for images, pose in zip(back.images, behind, strict=True):
        current, true = detect_in_frames(clip.rig, images), pose * clip.truth.world_from_object[0]
        for last in (keyframes[0], keyframes[-1]):
            records = match_frame(keyframes, current, last, RADIUS, 0)
            points, pixels = [record.points for record in records], [record.pixels for record in records]
            max_px = TrackingOptions().max_relocalization_error_px
            for seed in range(30):
                found = estimate_pose(clip.rig, points, pixels, max_error_px=max_px, seed=seed)
                assert found.status is not Status.OK or pose_errors(found.motion, true)[0] < 3
            found_pose = estimate_relocalized_pose(clip.rig, records, TrackingOptions())
            assert found_pose is None or pose_errors(found_pose, true)[0] < 3


def test_uncertain_landmarks_are_ignored(clip: Clip, keyframes: list[Keyframe]) -> None:
    current = detect_in_frames(clip.rig, clip.images[len(ROTATIONS_DEG)])
    guesses = [make_keyframe(clip, k, sd=0.5 * RADIUS) for k in range(len(ROTATIONS_DEG))]
    assert relocalize_frame(clip.rig, guesses, current, guesses[0], RADIUS, 0) is None
    # For a larger object the same uncertainty is acceptable.
    assert relocalize_frame(clip.rig, guesses, current, guesses[0], 10 * RADIUS, 0) is not None
    background = [
        Keyframe(r.solved, [replace(m, background=np.ones(len(m.features), bool)) for m in r.cameras])
        for r in keyframes
    ]
    assert relocalize_frame(clip.rig, background, current, background[0], RADIUS, 0) is None


def test_no_keyframes_no_pose(clip: Clip, keyframes: list[Keyframe]) -> None:
    current = detect_in_frames(clip.rig, clip.images[len(ROTATIONS_DEG)])
    assert relocalize_frame(clip.rig, [], current, keyframes[0], RADIUS, 0) is None


def test_all_keyframes_are_tried_over_time(clip: Clip, keyframes: list[Keyframe]) -> None:
    """The only useful keyframe has a viewpoint far from the last frame's."""
    rig, n = clip.rig, 60
    k = len(ROTATIONS_DEG) + 3
    kept: list[Keyframe] = []
    for i in range(n):
        pose = RigidTransform.from_rotation(Rotation.from_rotvec([0, np.radians(0.1 * i), 0]))
        one = [
            replace(
                m,
                features=m.features.subset(np.arange(1)),
                background=np.zeros(1, bool),
                landmark_ids=m.landmark_ids[:1],
            )
            for m in keyframes[0].cameras
        ]
        kept.append(make_solved(rig, i, pose, one))
    good = Keyframe(
        replace(keyframes[2].solved, number=n, viewpoints=-keyframes[2].solved.viewpoints), keyframes[2].cameras
    )
    stride = (n + 1 - N_KEYFRAMES) // N_KEYFRAMES
    for place in (0, 17, 60):
        many = [*kept[:place], good, *kept[place:]]
        current = detect_in_frames(rig, clip.images[k])
        tries = [relocalize_frame(rig, many, current, kept[0], RADIUS, i) for i in range(stride)]
        found = [pose for pose in tries if pose is not None]
        assert len(found) >= 1
        assert all(pose_errors(pose, clip.truth.world_from_object[k])[0] < 1.5 for pose in found)


def test_relocalization_does_not_modify_keyframes(clip: Clip, keyframes: list[Keyframe]) -> None:
    before = [Landmarks.concatenate([m.landmarks for m in r.cameras]).mean.copy() for r in keyframes]
    current = detect_in_frames(clip.rig, clip.images[len(ROTATIONS_DEG)])
    one, two = (relocalize_frame(clip.rig, keyframes, current, keyframes[0], RADIUS, 0) for _ in range(2))
    assert one is not None
    assert two is not None
    np.testing.assert_array_equal(one.as_matrix(), two.as_matrix())
    for r, mean in zip(keyframes, before, strict=True):
        np.testing.assert_array_equal(Landmarks.concatenate([m.landmarks for m in r.cameras]).mean, mean)


def test_pose_rests_on_known_frames_only() -> None:
    """A search that starts again from the first frame discards the frames that an earlier candidate rests on."""
    agreements = [PoseAgreement(references=(0, 2)), PoseAgreement(references=(2,)), PoseAgreement()]
    candidate = cast(Any, SimpleNamespace(agreements=agreements))
    before, after = (
        cast(Any, SimpleNamespace(frames=SimpleNamespace(by_number=known))) for known in ({0: 0, 2: 0}, {0: 0})
    )
    assert has_known_references(before, candidate)
    assert not has_known_references(after, candidate)
