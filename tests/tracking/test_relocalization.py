"""Finding an object again: by what keyframes know of it, anywhere in the images; and nothing where it is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.features.sift import ALL_FEATURES, MAX_FEATURES, Features, detect
from sylpose.geometry.arrays import Image
from sylpose.landmarks.landmark_filter import Landmarks, new_landmarks
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.rig import Camera, Rig
from sylpose.simulate import Actor, chamfered_box, demo_scene
from sylpose.tracking.frame import CameraFrame, SolvedFrame
from sylpose.tracking.keyframes import viewpoints
from sylpose.tracking.relocalization import LOOSE_RATIO, NEAREST, OTHERS, RATIO, pose_of, recognised, to_try
from tests.clips import SIZE, Clip, Images, moving_scene, surface_points, turned

# Turns of the keyframes, and where the object is by then.
TURNS = (0.0, 12.0, 24.0, 36.0)
N_CAMERAS = 3
RADIUS = 0.15
# Where it is looked for: further on, further away, the other way, as seen before but elsewhere.
ELSEWHERE = [
    turned(56, [0.16, 0.08, 0.05]),
    turned(18, [-0.1, -0.05, 0.3]),
    turned(-20, [-0.17, 0.1, -0.1]),
    turned(24, [0.2, -0.1, 0]),
]


class Keyframe(NamedTuple):
    """A solved frame, and what each camera has of it."""

    solved: SolvedFrame
    cameras: list[CameraFrame]


def relocalise(
    rig: Rig,
    keyframes: Sequence[Keyframe],
    current: Sequence[CameraFrame],
    last: Keyframe,
    radius: float,
    missed: int,
    ratio: float = RATIO,
) -> RigidTransform | None:
    """As the tracker does it: each camera recognises landmarks of its keyframes, all together find the pose."""
    solved, by_number = [k.solved for k in keyframes], {k.solved.number: k.cameras for k in keyframes}
    records = []
    for c in range(len(rig)):
        tried = to_try(solved, c, last.solved, missed)
        records.append(recognised([by_number[k.number][c] for k in tried], current[c], radius, ratio))
    return pose_of(rig, records)


@pytest.fixture(scope="module")
def clip() -> Clip:
    """The keyframes, then what is to be recognised."""
    poses = [*(turned(turn) for turn in TURNS), *ELSEWHERE]
    return Clip.render(moving_scene(lambda frame: poses[round(frame)], len(poses), n_cameras=N_CAMERAS))


@pytest.fixture(scope="module")
def keyframes(clip: Clip) -> list[Keyframe]:
    return [keyframe(clip, k) for k in range(len(TURNS))]


def found_in(image: Image, camera: Camera, faint: bool) -> Features:
    return detect(image, camera, None, ALL_FEATURES if faint else MAX_FEATURES, faint=faint)


def keyframe(clip: Clip, k: int, sd: float = 0.02 * RADIUS, *, faint: bool = False) -> Keyframe:
    """A frame with the features of the object and their true places, said to be good to sd."""
    pose = clip.truth.world_from_object[k]
    kept, landmarks = [], []
    for camera, image in zip(clip.rig, clip.images[k], strict=True):
        features = found_in(image, camera, faint)
        places = surface_points(camera, features.normalized, pose, clip.truth.vertices)
        on_it = np.isfinite(places[:, 0])
        distance = np.linalg.norm(places[on_it] - pose.inv().apply(camera.center), axis=1)
        kept.append(features.subset(on_it))
        landmarks.append(new_landmarks(kept[-1], camera, pose.inv(), distance, np.full(len(distance), sd)))
    cameras = [known(f, m) for f, m in zip(kept, landmarks, strict=True)]
    return solved(clip.rig, k, pose, cameras)


def known(features: Features, landmarks: Landmarks) -> CameraFrame:
    """Of a camera that knows nothing else."""
    table = LandmarkTable()
    return CameraFrame(features, np.zeros(len(features), bool), table, table.learn(landmarks))


def solved(rig: Rig, number: int, pose: RigidTransform, cameras: list[CameraFrame]) -> Keyframe:
    sees = np.array([len(camera.features) > 0 for camera in cameras])
    late, covariance = np.zeros(len(rig)), np.zeros((6, 6))
    return Keyframe(SolvedFrame(number, number / 30, late, pose, covariance, viewpoints(rig, pose), sees), cameras)


def seen(rig: Rig, images: Images, *, faint: bool = False) -> list[CameraFrame]:
    """What the cameras have of a frame, with all that is to be seen in it."""
    features = [
        Features.none() if image is None else found_in(image, camera, faint)
        for camera, image in zip(rig, images, strict=True)
    ]
    return [CameraFrame(f, np.zeros(len(f), bool), LandmarkTable()) for f in features]


def errors(found: RigidTransform | None, true: RigidTransform) -> tuple[float, float]:
    """Degrees; millimetres of the centre."""
    assert found is not None
    turn = np.rad2deg((found.rotation * true.rotation.inv()).magnitude())
    return float(turn), 1e3 * float(np.linalg.norm(found.translation - true.translation))


@pytest.mark.parametrize("k", range(len(ELSEWHERE)))
def test_it_is_found_turned_and_elsewhere(clip: Clip, keyframes: list[Keyframe], k: int) -> None:
    k += len(TURNS)
    for last in (keyframes[0], keyframes[-1]):
        found = relocalise(clip.rig, keyframes, seen(clip.rig, clip.images[k]), last, RADIUS, 0)
        degrees, millimetres = errors(found, clip.truth.world_from_object[k])
        assert degrees < 1.5
        assert millimetres < 8


def test_one_camera_that_sees_it_is_enough(clip: Clip, keyframes: list[Keyframe]) -> None:
    k = len(TURNS)
    for c in range(N_CAMERAS):
        images: Images = [image if i == c else None for i, image in enumerate(clip.images[k])]
        found = relocalise(clip.rig, keyframes, seen(clip.rig, images), keyframes[-1], RADIUS, 0)
        if found is not None:  # by few matches of one camera it may not be believed
            assert errors(found, clip.truth.world_from_object[k])[0] < 5
    alone = clip.rig.subset(["cam_1"])
    only = [solved(alone, r.solved.number, r.solved.world_from_object, r.cameras[1:2]) for r in keyframes]
    k = len(TURNS) + 3
    found = relocalise(alone, only, seen(alone, clip.images[k][1:2]), only[0], RADIUS, 0)
    assert errors(found, clip.truth.world_from_object[k])[0] < 3


def others(path_of: Sequence[RigidTransform], seed: int) -> Clip:
    """Another body than the keyframes'."""
    body = chamfered_box(np.array([0.3, 0.22, 0.26]), 430, seed=seed)
    scene = demo_scene(frames=1, size=SIZE, n_cameras=N_CAMERAS)
    actors = (Actor(body, lambda frame: path_of[round(frame)]),)
    return Clip.render(replace(scene, actors=actors, frames=len(path_of)))


@pytest.mark.parametrize(("texels", "turn"), [(4.5, 45.0), (6.0, 35.0)])
def test_blurred_paint_is_found_again_where_looks_need_not_be_as_much_alike(texels: float, turn: float) -> None:
    poses = [turned(0), turned(turn, [0.1, 0.05, 0])]
    scene = moving_scene(lambda frame: poses[round(frame)], 2, n_cameras=N_CAMERAS)
    body, path = scene.actors[0].body, scene.actors[0].path
    soft = tuple(np.asarray(cv2.GaussianBlur(t, (0, 0), texels), np.uint8) for t in body.textures)
    clip = Clip.render(replace(scene, actors=(Actor(replace(body, textures=soft), path),)))
    first, current = keyframe(clip, 0, faint=True), seen(clip.rig, clip.images[1], faint=True)
    assert relocalise(clip.rig, [first], current, first, RADIUS, 0) is None
    found = relocalise(clip.rig, [first], current, first, RADIUS, 0, LOOSE_RATIO)
    assert errors(found, clip.truth.world_from_object[1])[0] < 1.5


def test_it_is_not_found_where_it_is_not_by_all_that_is_somewhat_alike(clip: Clip) -> None:
    known = [keyframe(clip, k, faint=True) for k in range(len(TURNS))]
    for seed in (11, 12, 13):
        other = others([turned(0), turned(24, [0.1, 0, 0])], seed)
        for images in other.images:
            current = seen(clip.rig, images, faint=True)
            assert relocalise(clip.rig, known, current, known[0], RADIUS, 0, LOOSE_RATIO) is None


def test_it_is_not_found_where_it_is_not(clip: Clip, keyframes: list[Keyframe]) -> None:
    nowhere = RigidTransform.from_translation([0, 50, 0])
    empty = Clip.render(moving_scene(lambda _: nowhere, 1, n_cameras=N_CAMERAS))
    assert relocalise(clip.rig, keyframes, seen(clip.rig, empty.images[0]), keyframes[0], RADIUS, 0) is None
    for seed in (11, 12, 13):
        other = others([turned(0), turned(24, [0.1, 0, 0])], seed)
        for images in other.images:
            assert relocalise(clip.rig, keyframes, seen(clip.rig, images), keyframes[0], RADIUS, 0) is None
    nothing: Images = (None,) * N_CAMERAS
    assert relocalise(clip.rig, keyframes, seen(clip.rig, nothing), keyframes[0], RADIUS, 0) is None


def test_a_side_that_was_never_seen_is_not_found(clip: Clip, keyframes: list[Keyframe]) -> None:
    """Its other side, turned about the vertical and upside down: nothing, rather than something wrong."""
    behind = [
        RigidTransform.from_rotation(Rotation.from_rotvec([0, np.pi, 0])),
        RigidTransform.from_rotation(Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_rotvec([0, 0.5, 0])),
    ]
    back = Clip.render(moving_scene(lambda frame: behind[round(frame)], 2, n_cameras=N_CAMERAS))
    for images, pose in zip(back.images, behind, strict=True):
        found = relocalise(clip.rig, keyframes, seen(clip.rig, images), keyframes[0], RADIUS, 0)
        assert found is None or errors(found, pose * clip.truth.world_from_object[0])[0] < 3


def test_only_places_that_are_known_count(clip: Clip, keyframes: list[Keyframe]) -> None:
    current = seen(clip.rig, clip.images[len(TURNS)])
    guesses = [keyframe(clip, k, sd=0.5 * RADIUS) for k in range(len(TURNS))]
    assert relocalise(clip.rig, guesses, current, guesses[0], RADIUS, 0) is None
    # The same of an object that is larger: then that is well enough.
    assert relocalise(clip.rig, guesses, current, guesses[0], 10 * RADIUS, 0) is not None
    background = [
        Keyframe(r.solved, [replace(m, background=np.ones(len(m.features), bool)) for m in r.cameras])
        for r in keyframes
    ]
    assert relocalise(clip.rig, background, current, background[0], RADIUS, 0) is None


def test_nothing_known_nothing_found(clip: Clip, keyframes: list[Keyframe]) -> None:
    current = seen(clip.rig, clip.images[len(TURNS)])
    assert relocalise(clip.rig, [], current, keyframes[0], RADIUS, 0) is None


def test_of_many_keyframes_all_are_tried_in_turn(clip: Clip, keyframes: list[Keyframe]) -> None:
    """The one that shows the object looks from elsewhere than the last frame did; the others know next to nothing."""
    rig, n = clip.rig, 60
    k = len(TURNS) + 3
    kept: list[Keyframe] = []
    for i in range(n):
        pose = RigidTransform.from_rotation(Rotation.from_rotvec([0, np.radians(0.1 * i), 0]))
        one = [
            replace(m, features=m.features.subset(np.arange(1)), background=np.zeros(1, bool), numbers=m.numbers[:1])
            for m in keyframes[0].cameras
        ]
        kept.append(solved(rig, i, pose, one))
    good = Keyframe(
        replace(keyframes[2].solved, number=n, viewpoints=-keyframes[2].solved.viewpoints), keyframes[2].cameras
    )
    stride = (n + 1 - NEAREST) // OTHERS
    for place in (0, 17, 60):
        many = [*kept[:place], good, *kept[place:]]
        current = seen(rig, clip.images[k])
        tries = [relocalise(rig, many, current, kept[0], RADIUS, i) for i in range(stride)]
        found = [pose for pose in tries if pose is not None]
        assert len(found) >= 1
        assert all(errors(pose, clip.truth.world_from_object[k])[0] < 1.5 for pose in found)


def test_it_does_not_change_what_is_known(clip: Clip, keyframes: list[Keyframe]) -> None:
    before = [Landmarks.concatenate([m.landmarks for m in r.cameras]).mean.copy() for r in keyframes]
    current = seen(clip.rig, clip.images[len(TURNS)])
    one, two = (relocalise(clip.rig, keyframes, current, keyframes[0], RADIUS, 0) for _ in range(2))
    assert one is not None
    assert two is not None
    np.testing.assert_array_equal(one.as_matrix(), two.as_matrix())
    for r, mean in zip(keyframes, before, strict=True):
        np.testing.assert_array_equal(Landmarks.concatenate([m.landmarks for m in r.cameras]).mean, mean)
