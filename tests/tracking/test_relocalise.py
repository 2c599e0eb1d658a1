"""Finding an object again: by what keyframes know of it, anywhere in the images; and nothing where it is not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.features.sift import Features, detect
from sylpose.landmarks.places import Landmarks, new_landmarks
from sylpose.rig import Rig
from sylpose.simulate import Actor, chamfered_box, demo_scene
from sylpose.tracking.frame import Reference
from sylpose.tracking.keyframes import viewpoints
from sylpose.tracking.relocalise import NEAREST, OTHERS, relocalise
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


@pytest.fixture(scope="module")
def pool() -> Iterator[Executor]:
    with ThreadPoolExecutor(2) as pool:
        yield pool


@pytest.fixture(scope="module")
def clip() -> Clip:
    """The keyframes, then what is to be recognised."""
    poses = [*(turned(turn) for turn in TURNS), *ELSEWHERE]
    return Clip.render(moving_scene(lambda frame: poses[round(frame)], len(poses), n_cameras=N_CAMERAS))


@pytest.fixture(scope="module")
def keyframes(clip: Clip) -> list[Reference]:
    return [keyframe(clip, k) for k in range(len(TURNS))]


def keyframe(clip: Clip, k: int, sd: float = 0.02 * RADIUS) -> Reference:
    """A frame with the features of the object and their true places, said to be good to sd."""
    pose = clip.truth.world_from_object[k]
    kept, landmarks = [], []
    for camera, image in zip(clip.rig, clip.images[k], strict=True):
        features = detect(image, camera)
        places = surface_points(camera, features.normalized, pose, clip.truth.vertices)
        on_it = np.isfinite(places[:, 0])
        distance = np.linalg.norm(places[on_it] - pose.inv().apply(camera.center), axis=1)
        kept.append(features.subset(on_it))
        landmarks.append(new_landmarks(kept[-1], camera, pose.inv(), distance, np.full(len(distance), sd)))
    background = tuple(np.zeros(len(f), bool) for f in kept)
    return Reference(
        k,
        k / 30,
        tuple(kept),
        background,
        tuple(landmarks),
        world_from_object=pose,
        viewpoints=viewpoints(clip.rig, pose),
    )


def seen(rig: Rig, images: Images, index: int = 99) -> Reference:
    """A frame with all that is to be seen in it."""
    features = tuple(
        Features.none() if image is None else detect(image, camera) for camera, image in zip(rig, images, strict=True)
    )
    return Reference(index, index / 30, features, tuple(np.zeros(len(f), bool) for f in features))


def errors(found: RigidTransform | None, true: RigidTransform) -> tuple[float, float]:
    """Degrees; millimetres of the centre."""
    assert found is not None
    turn = np.rad2deg((found.rotation * true.rotation.inv()).magnitude())
    return float(turn), 1e3 * float(np.linalg.norm(found.translation - true.translation))


@pytest.mark.parametrize("k", range(len(ELSEWHERE)))
def test_it_is_found_turned_and_elsewhere(clip: Clip, keyframes: list[Reference], pool: Executor, k: int) -> None:
    k += len(TURNS)
    for last in (keyframes[0], keyframes[-1]):
        found = relocalise(clip.rig, keyframes, seen(clip.rig, clip.images[k]), last, RADIUS, 0, pool)
        degrees, millimetres = errors(found, clip.truth.world_from_object[k])
        assert degrees < 1.5
        assert millimetres < 8


def test_one_camera_that_sees_it_is_enough(clip: Clip, keyframes: list[Reference], pool: Executor) -> None:
    k = len(TURNS)
    for c in range(N_CAMERAS):
        images: Images = [image if i == c else None for i, image in enumerate(clip.images[k])]
        found = relocalise(clip.rig, keyframes, seen(clip.rig, images), keyframes[-1], RADIUS, 0, pool)
        if found is not None:  # by few matches of one camera it may not be believed
            assert errors(found, clip.truth.world_from_object[k])[0] < 5
    alone = clip.rig.subset(["cam_1"])
    only = [
        replace(
            r,
            features=r.features[1:2],
            background=r.background[1:2],
            landmarks=r.landmarks[1:2],
            viewpoints=r.viewpoints[1:2],
        )
        for r in keyframes
    ]
    k = len(TURNS) + 3
    found = relocalise(alone, only, seen(alone, clip.images[k][1:2]), only[0], RADIUS, 0, pool)
    assert errors(found, clip.truth.world_from_object[k])[0] < 3


def others(path_of: Sequence[RigidTransform], seed: int) -> Clip:
    """Another body than the keyframes'."""
    body = chamfered_box(np.array([0.3, 0.22, 0.26]), 430, seed=seed)
    scene = demo_scene(frames=1, size=SIZE, n_cameras=N_CAMERAS)
    actors = (Actor(body, lambda frame: path_of[round(frame)]),)
    return Clip.render(replace(scene, actors=actors, frames=len(path_of)))


def test_it_is_not_found_where_it_is_not(clip: Clip, keyframes: list[Reference], pool: Executor) -> None:
    nowhere = RigidTransform.from_translation([0, 50, 0])
    empty = Clip.render(moving_scene(lambda _: nowhere, 1, n_cameras=N_CAMERAS))
    assert relocalise(clip.rig, keyframes, seen(clip.rig, empty.images[0]), keyframes[0], RADIUS, 0, pool) is None
    for seed in (11, 12, 13):
        other = others([turned(0), turned(24, [0.1, 0, 0])], seed)
        for images in other.images:
            assert relocalise(clip.rig, keyframes, seen(clip.rig, images), keyframes[0], RADIUS, 0, pool) is None
    nothing: Images = (None,) * N_CAMERAS
    assert relocalise(clip.rig, keyframes, seen(clip.rig, nothing), keyframes[0], RADIUS, 0, pool) is None


def test_a_side_that_was_never_seen_is_not_found(clip: Clip, keyframes: list[Reference], pool: Executor) -> None:
    """Its other side, turned about the vertical and upside down: nothing, rather than something wrong."""
    behind = [
        RigidTransform.from_rotation(Rotation.from_rotvec([0, np.pi, 0])),
        RigidTransform.from_rotation(Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_rotvec([0, 0.5, 0])),
    ]
    back = Clip.render(moving_scene(lambda frame: behind[round(frame)], 2, n_cameras=N_CAMERAS))
    for images, pose in zip(back.images, behind, strict=True):
        found = relocalise(clip.rig, keyframes, seen(clip.rig, images), keyframes[0], RADIUS, 0, pool)
        assert found is None or errors(found, pose * clip.truth.world_from_object[0])[0] < 3


def test_only_places_that_are_known_count(clip: Clip, keyframes: list[Reference], pool: Executor) -> None:
    current = seen(clip.rig, clip.images[len(TURNS)])
    guesses = [keyframe(clip, k, sd=0.5 * RADIUS) for k in range(len(TURNS))]
    assert relocalise(clip.rig, guesses, current, guesses[0], RADIUS, 0, pool) is None
    # The same of an object that is larger: then that is well enough.
    assert relocalise(clip.rig, guesses, current, guesses[0], 10 * RADIUS, 0, pool) is not None
    background = [replace(r, background=tuple(np.ones(len(f), bool) for f in r.features)) for r in keyframes]
    assert relocalise(clip.rig, background, current, background[0], RADIUS, 0, pool) is None


def test_nothing_known_nothing_found(clip: Clip, keyframes: list[Reference], pool: Executor) -> None:
    current = seen(clip.rig, clip.images[len(TURNS)])
    assert relocalise(clip.rig, [], current, keyframes[0], RADIUS, 0, pool) is None


def test_of_many_keyframes_all_are_tried_in_turn(clip: Clip, keyframes: list[Reference], pool: Executor) -> None:
    """The one that shows the object looks from elsewhere than the last frame did; the others know next to nothing."""
    rig, n = clip.rig, 60
    k = len(TURNS) + 3
    kept: list[Reference] = []
    for i in range(n):
        pose = RigidTransform.from_rotation(Rotation.from_rotvec([0, np.radians(0.1 * i), 0]))
        one = tuple(f.subset(np.arange(1)) for f in keyframes[0].features)
        landmarks = tuple(m.subset(np.arange(1)) for m in keyframes[0].landmarks)
        kept.append(Reference(i, 0.0, one, (np.zeros(1, bool),) * 3, landmarks, pose, viewpoints=viewpoints(rig, pose)))
    good = replace(keyframes[2], viewpoints=-keyframes[2].viewpoints)
    stride = (n + 1 - NEAREST) // OTHERS
    for place in (0, 17, 60):
        many = [*kept[:place], good, *kept[place:]]
        current = seen(rig, clip.images[k])
        tries = [relocalise(rig, many, current, kept[0], RADIUS, i, pool) for i in range(stride)]
        found = [pose for pose in tries if pose is not None]
        assert len(found) >= 1
        assert all(errors(pose, clip.truth.world_from_object[k])[0] < 1.5 for pose in found)


def test_it_does_not_change_what_is_known(clip: Clip, keyframes: list[Reference], pool: Executor) -> None:
    before = [Landmarks.concatenate(r.landmarks).mean.copy() for r in keyframes]
    current = seen(clip.rig, clip.images[len(TURNS)])
    one, two = (relocalise(clip.rig, keyframes, current, keyframes[0], RADIUS, 0, pool) for _ in range(2))
    assert one is not None
    assert two is not None
    np.testing.assert_array_equal(one.as_matrix(), two.as_matrix())
    for r, mean in zip(keyframes, before, strict=True):
        np.testing.assert_array_equal(Landmarks.concatenate(r.landmarks).mean, mean)
