"""References: matches with them, what of them is background, and where their features are on the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.rig import Camera, Rig
from sylpose.simulate import ellipsoid, ring
from sylpose.tracking.frame import (
    CameraFrame,
    Pair,
    SolvedFrame,
    base_from_reference,
    inliers_of,
    learn_background,
    match_pair,
    standing,
    still,
    triangulate,
)
from sylpose.tracking.keyframes import viewpoints
from tests.scenes import epipolar_px

RADIUS = 0.15
BODY = ellipsoid((RADIUS, 0.1, 0.12), n=500).points
START = RigidTransform.from_components([0.03, -0.02, 0.05], Rotation.from_rotvec([0.2, 0.1, -0.3]))
N_OBJECT, N_ROOM = 60, 40


@pytest.fixture(scope="module")
def rig() -> Rig:
    return ring(3, 1.5, 1000.0, height=(0.4, -0.1, 0.2), distortion=(-0.1, 0.02, 0.0, 0.0))


def moved(turn_deg: float, shift: float, steps: int = 1) -> RigidTransform:
    """The object's pose after some steps from the start, each a turn about a tilted axis through it and a shift."""
    turn = Rotation.from_rotvec(np.deg2rad(turn_deg * steps) * np.array([0.36, 0.8, 0.48]))
    along = shift * steps * np.array([0.6, -0.64, 0.48])
    return RigidTransform.from_components(START.translation + along, turn * START.rotation)


class Seen(NamedTuple):
    """A frame, its pose, and what each camera has of it."""

    solved: SolvedFrame
    cameras: list[CameraFrame]

    @property
    def pose(self) -> RigidTransform:
        return self.solved.world_from_object


def seen(rig: Rig, number: int, features: Sequence[Features], pose: RigidTransform) -> Seen:
    sees = np.array([len(f) > 0 for f in features])
    covariance, late = np.zeros((6, 6)), np.zeros(len(rig))
    frame = SolvedFrame(number, number / 30, late, pose, covariance, viewpoints(rig, pose), sees)
    return Seen(frame, [CameraFrame(f, np.zeros(len(f), bool), LandmarkTable()) for f in features])


def frame(rig: Rig, number: int, pose: RigidTransform) -> Seen:
    """What the cameras see of the object, N_OBJECT points that are the same in each frame, and of a room, N_ROOM."""
    features = []
    for c, camera in enumerate(rig):
        rng = np.random.default_rng(c)
        points = BODY[rng.choice(len(BODY), N_OBJECT, replace=False)]
        room = rng.uniform([100, 100], [1100, 800], (N_ROOM, 2))
        pixels = np.concatenate([camera.project(pose.apply(points)), room])
        descriptors = rng.gamma(0.5, size=(len(pixels), 128)).astype(np.float32)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        features.append(Features(pixels, camera.normalize(pixels), descriptors))
    return seen(rig, number, features, pose)


def object_points(camera: int) -> FloatArray:
    rng = np.random.default_rng(camera)
    return np.asarray(BODY[rng.choice(len(BODY), N_OBJECT, replace=False)])


def pair_of(reference: Seen, current: Seen, camera: int) -> Pair:
    return match_pair(reference.solved.number, reference.cameras[camera], current.cameras[camera])


def learn(rig: Rig, reference: Seen, current: Seen, *cameras: int) -> None:
    """`learn_background` of some cameras, or of all."""
    for c in cameras or range(len(rig)):
        pair = pair_of(reference, current, c)
        poses = reference.pose, current.pose
        learn_background(pair, current.cameras[c], standing(pair, current.cameras[c], rig.cameras[c], *poses, RADIUS))


def places_of(pair: Pair, camera: Camera, reference: Seen, current: Seen) -> FloatArray:
    return triangulate(pair, camera, reference.pose, current.pose)


# --- matches


def test_a_pair_holds_what_both_frames_have(rig: Rig) -> None:
    reference, current = frame(rig, 3, START), frame(rig, 4, moved(5, 0.02))
    pair = pair_of(reference, current, 1)
    i, j = pair.indices.T
    np.testing.assert_array_equal(i, j)  # both frames have the same features in the same order
    assert len(pair) == N_OBJECT + N_ROOM
    np.testing.assert_array_equal(pair.pixels_i, reference.cameras[1].features.pixels[i])
    np.testing.assert_array_equal(pair.pixels_j, current.cameras[1].features.pixels[j])
    np.testing.assert_array_equal(pair.normalized_i, reference.cameras[1].features.normalized[i])
    np.testing.assert_array_equal(pair.normalized_j, current.cameras[1].features.normalized[j])
    assert pair.reference == 3
    assert pair.earlier is reference.cameras[1]


def test_still_matches_are_those_of_the_room(rig: Rig) -> None:
    pair = pair_of(frame(rig, 0, START), frame(rig, 1, moved(8, 0.04)), 0)
    room = pair.indices[:, 0] >= N_OBJECT
    np.testing.assert_array_equal(still(pair), room)


def test_inliers_are_what_has_weight(rig: Rig) -> None:
    reference, current = frame(rig, 0, START), frame(rig, 1, moved(5, 0.02))
    pairs = [pair_of(reference, current, c) for c in range(len(rig))]
    weights = [np.zeros(len(pair)) for pair in pairs]
    weights[0][[1, 5]] = 0.5
    weights[2][:3] = 1.0
    kept = inliers_of(pairs, weights)
    assert [len(pair) for pair in kept] == [2, 3]
    np.testing.assert_array_equal(kept[0].pixels_j, pairs[0].pixels_j[[1, 5]])
    np.testing.assert_array_equal(kept[0].indices, pairs[0].indices[[1, 5]])


def test_no_features_no_matches(rig: Rig) -> None:
    nothing = seen(rig, 1, [Features.none() for _ in rig], START)
    for pair in (pair_of(nothing, frame(rig, 2, START), 0), pair_of(frame(rig, 2, START), nothing, 0)):
        assert len(pair) == 0
        assert pair.pixels_i.shape == pair.normalized_j.shape == (0, 2)


# --- background


def test_what_stands_still_where_the_object_moved_is_background(rig: Rig) -> None:
    reference, current = frame(rig, 0, START), frame(rig, 1, moved(8, 0.06))
    learn(rig, reference, current)
    for c in range(len(rig)):
        for marks in (reference.cameras[c].background, current.cameras[c].background):
            # A place where a point of the object would have stood still says nothing.
            assert not marks[:N_OBJECT].any()
            assert marks[N_OBJECT:].mean() > 0.9


def test_without_motion_nothing_is_background(rig: Rig) -> None:
    reference, current = frame(rig, 0, START), frame(rig, 1, moved(0.05, 0.0005))
    learn(rig, reference, current)
    assert not any(camera.background.any() for camera in (*reference.cameras, *current.cameras))


def test_on_the_axis_of_a_turn_the_object_stands_still_too(rig: Rig) -> None:
    # The object turns about cam_0's line of sight through its centre: what is near the centre may well be on it.
    camera = rig.cameras[0]
    axis = START.translation - camera.center
    turn = Rotation.from_rotvec(np.deg2rad(10) * axis / np.linalg.norm(axis))
    end = RigidTransform.from_components(START.translation, turn * START.rotation)
    pixels = camera.project(START.translation) + np.array([[0, 0], [3, 4], [150, 0]])
    features = Features(pixels, camera.normalize(pixels), np.eye(3, 128, dtype=np.float32))
    nothing = (Features.none(), Features.none())
    reference, current = seen(rig, 0, (features, *nothing), START), seen(rig, 1, (features, *nothing), end)
    learn(rig, reference, current, 0)
    assert reference.cameras[0].background.tolist() == current.cameras[0].background.tolist() == [False, False, True]


def test_known_background_is_not_matched_and_passed_on(rig: Rig) -> None:
    reference, current = frame(rig, 0, START), frame(rig, 1, moved(8, 0.06))
    reference.cameras[1].background[N_OBJECT:] = True
    # Known background may also turn up somewhere else by mistake: then it is dropped, but says nothing about the place.
    pixels = current.cameras[1].features.pixels.copy()
    pixels[N_OBJECT] += 30
    features = replace(current.cameras[1].features, pixels=pixels)
    others = [camera.features for camera in current.cameras]
    current = seen(rig, 1, [others[0], features, others[2]], current.pose)
    pair = pair_of(reference, current, 1)
    assert pair.indices[:, 0].tolist() == list(range(N_OBJECT))
    assert np.flatnonzero(current.cameras[1].background).tolist() == list(range(N_OBJECT + 1, N_OBJECT + N_ROOM))
    # Another reference that does not know it: the current frame does now.
    other = pair_of(frame(rig, 0, START), current, 1)
    assert other.indices[:, 0].max() == N_OBJECT


def test_background_of_one_camera_says_nothing_about_another(rig: Rig) -> None:
    reference, current = frame(rig, 0, START), frame(rig, 1, moved(8, 0.06))
    learn(rig, reference, current, 2)
    assert [camera.background.any() for camera in reference.cameras] == [False, False, True]


def test_an_object_behind_a_camera_does_no_harm(rig: Rig) -> None:
    behind = Camera(
        "cam_0",
        rig.cameras[0].size,
        rig.cameras[0].matrix,
        rig.cameras[0].distortion,
        RigidTransform.from_rotation(Rotation.from_rotvec([0, np.pi, 0])) * rig.cameras[0].camera_from_world,
    )
    odd = Rig([behind, *rig.cameras[1:]])
    reference, current = frame(rig, 0, START), frame(rig, 1, moved(8, 0.06))
    learn(odd, reference, current)
    assert not current.cameras[0].background[:N_OBJECT].any()


# --- geometry


def test_triangulation_is_exact_without_noise(rig: Rig) -> None:
    reference, current = frame(rig, 0, START), frame(rig, 1, moved(9, 0.03))
    for c in range(len(rig)):
        pair = pair_of(reference, current, c)
        pair = pair.subset(pair.indices[:, 0] < N_OBJECT)
        places = places_of(pair, rig.cameras[c], reference, current)
        assert len(places) > 0.9 * N_OBJECT
        gap = np.linalg.norm(places[:, None] - object_points(c), axis=2).min(axis=1)
        assert gap.max() < 1e-5


def test_triangulation_gives_only_depths_that_are_known(rig: Rig) -> None:
    reference = frame(rig, 0, START)
    for turn, shift, share in ((0.0, 0.0, 0.0), (0.05, 0.0, 0.0), (0.5, 0.002, 0.5), (9, 0.03, 1.0)):
        current = frame(rig, 1, moved(turn, shift))
        places = places_of(pair_of(reference, current, 0), rig.cameras[0], reference, current)
        assert np.isfinite(places).all()
        assert places.shape[1] == 3
        if share == 0:
            assert len(places) == 0
    nothing = pair_of(reference, current, 0).subset(np.zeros(N_OBJECT + N_ROOM, bool))
    assert places_of(nothing, rig.cameras[0], reference, current).shape == (0, 3)


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_triangulation_is_as_good_as_it_says(rig: Rig, noise: float) -> None:
    rng = np.random.default_rng(0)
    reference, current = frame(rig, 0, START), frame(rig, 1, moved(9, 0.03))
    pair = pair_of(reference, current, 1)
    pair = pair.subset(pair.indices[:, 0] < N_OBJECT)
    camera = rig.cameras[1]
    noisy = replace(
        pair,
        normalized_i=pair.normalized_i + noise / camera.focal * rng.standard_normal((len(pair), 2)),
        normalized_j=pair.normalized_j + noise / camera.focal * rng.standard_normal((len(pair), 2)),
    )
    places = places_of(noisy, camera, reference, current)
    gap = np.linalg.norm(places[:, None] - object_points(1), axis=2).min(axis=1)
    # A tenth of the distance for one pixel.
    assert np.median(gap) < 0.1 * 1.5 * max(noise, 0.01)


def test_the_term_of_the_base_is_the_matches_themselves(rig: Rig) -> None:
    base, current = frame(rig, 4, START), frame(rig, 5, moved(5, 0.02))
    pair = pair_of(base, current, 2)
    assert base_from_reference(pair, base.solved, {}) is None
    term = pair.term(2, rig.cameras[2])
    assert term.base_from_reference is None
    assert (term.camera, term.focal) == (2, rig.cameras[2].focal)
    np.testing.assert_array_equal(term.x, pair.normalized_i)
    np.testing.assert_array_equal(term.y, pair.normalized_j)
    np.testing.assert_array_equal(term.center_x, rig.cameras[2].center)


@pytest.mark.parametrize("steps_back", [0, 1, 3])
def test_the_term_of_an_older_reference_speaks_of_the_same_motion(rig: Rig, steps_back: int) -> None:
    """The motion from the base to the current frame leaves no residual in a term of an older reference."""
    base, current = frame(rig, 10, moved(4, 0.01, 3)), frame(rig, 11, moved(4, 0.01, 4))
    older = base if steps_back == 0 else frame(rig, 10 - steps_back, moved(4, 0.01, 3 - steps_back))
    motion = current.pose * base.pose.inv()
    center = base.pose.translation
    for c in range(len(rig)):
        pair = pair_of(older, current, c)
        moved_ = base_from_reference(pair, base.solved, {older.solved.number: older.solved})
        term = pair.subset(pair.indices[:, 0] < N_OBJECT).term(c, rig.cameras[c], moved_)
        rotation, shift = motion.rotation.as_matrix(), motion.apply(center) - center
        assert np.abs(epipolar_px(term, center, rotation, shift)).max() < 1e-3
        # And another motion does.
        other = Rotation.from_rotvec([0.02, 0, 0.02]).as_matrix() @ rotation
        assert np.abs(epipolar_px(term, center, other, shift)).max() > 1
