"""Frames and pairs: matches with references, background detection, and triangulation on the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import comb
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.features.sift import Features
from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.landmark_filter import LandmarkTable
from sylpose.rig import Camera, Rig
from sylpose.simulate import ellipsoid, ring
from sylpose.tracking.camera_side.frame import (
    CameraFrame,
    FrameMatches,
    find_background,
    find_static,
    is_explained_by_chance,
    mark_background,
    match_frames,
    select_inliers,
    triangulate,
)
from sylpose.tracking.frame_solvers import compute_reference_motion
from sylpose.tracking.joint_side.joint_state import KnownMotion, SolvedFrame, compute_viewpoints
from sylpose.tracking.reports import InlierStatistics
from tests.scenes import compute_epipolar_px

RADIUS = 0.15
BODY = ellipsoid((RADIUS, 0.1, 0.12), n=500).points
START = RigidTransform.from_components([0.03, -0.02, 0.05], Rotation.from_rotvec([0.2, 0.1, -0.3]))
N_OBJECT, N_ROOM = 60, 40


@pytest.fixture(scope="module")
def rig() -> Rig:
    return ring(3, 1.5, 1000.0, height=(0.4, -0.1, 0.2), distortion=(-0.1, 0.02, 0.0, 0.0))


def make_pose(turn_deg: float, translation: float, steps: int = 1) -> RigidTransform:
    """The object's pose after some steps, each a rotation about a tilted axis through it and a translation."""
    turn = Rotation.from_rotvec(np.deg2rad(turn_deg * steps) * np.array([0.36, 0.8, 0.48]))
    along = translation * steps * np.array([0.6, -0.64, 0.48])
    return RigidTransform.from_components(START.translation + along, turn * START.rotation)


class ObservedFrame(NamedTuple):
    """A frame, its pose, and each camera's data."""

    solved: SolvedFrame
    cameras: list[CameraFrame]

    @property
    def pose(self) -> RigidTransform:
        return self.solved.world_from_object


def observe(rig: Rig, number: int, features: Sequence[Features], pose: RigidTransform) -> ObservedFrame:
    sees = np.array([len(f) > 0 for f in features])
    covariance, time_offsets = np.zeros((6, 6)), np.zeros(len(rig))
    frame = SolvedFrame(number, number / 30, time_offsets, pose, covariance, compute_viewpoints(rig, pose), sees)
    return ObservedFrame(frame, [CameraFrame(f, np.zeros(len(f), bool), LandmarkTable()) for f in features])


def make_frame(rig: Rig, number: int, pose: RigidTransform) -> ObservedFrame:
    """The cameras' data of N_OBJECT object points, the same in each frame, and N_ROOM points of a room."""
    features = []
    for c, camera in enumerate(rig):
        rng = np.random.default_rng(c)
        points = BODY[rng.choice(len(BODY), N_OBJECT, replace=False)]
        room = rng.uniform([100, 100], [1100, 800], (N_ROOM, 2))
        pixels = np.concatenate([camera.project(pose.apply(points)), room])
        descriptors = rng.gamma(0.5, size=(len(pixels), 128)).astype(np.float32)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        features.append(Features(pixels, camera.normalize(pixels), descriptors))
    return observe(rig, number, features, pose)


def object_points(camera: int) -> FloatArray:
    rng = np.random.default_rng(camera)
    return np.asarray(BODY[rng.choice(len(BODY), N_OBJECT, replace=False)])


def make_pair(reference: ObservedFrame, current: ObservedFrame, camera: int) -> FrameMatches:
    return match_frames(reference.solved.number, reference.cameras[camera], current.cameras[camera])


def learn_background_of(rig: Rig, reference: ObservedFrame, current: ObservedFrame, *cameras: int) -> None:
    """Apply `learn_background` to some cameras, or to all."""
    for c in cameras or range(len(rig)):
        pair = make_pair(reference, current, c)
        motion = KnownMotion({reference.solved.number: reference.pose}, current.pose, RADIUS)
        mark_background(pair, current.cameras[c], find_background(pair, current.cameras[c], rig.cameras[c], motion))


def triangulate_pair(
    pair: FrameMatches, camera: Camera, reference: ObservedFrame, current: ObservedFrame
) -> FloatArray:
    return triangulate(pair, camera, reference.pose, current.pose)


# --- matches


def test_pair_contains_common_features(rig: Rig) -> None:
    reference, current = make_frame(rig, 3, START), make_frame(rig, 4, make_pose(5, 0.02))
    pair = make_pair(reference, current, 1)
    i, j = pair.indices.T
    np.testing.assert_array_equal(i, j)  # both frames have equal features in equal order
    assert len(pair) == N_OBJECT + N_ROOM
    np.testing.assert_array_equal(pair.pixels_i, reference.cameras[1].features.pixels[i])
    np.testing.assert_array_equal(pair.pixels_j, current.cameras[1].features.pixels[j])
    np.testing.assert_array_equal(pair.normalized_i, reference.cameras[1].features.normalized[i])
    np.testing.assert_array_equal(pair.normalized_j, current.cameras[1].features.normalized[j])
    assert pair.reference == 3
    assert pair.earlier is reference.cameras[1]


def test_static_matches_are_those_of_room(rig: Rig) -> None:
    pair = make_pair(make_frame(rig, 0, START), make_frame(rig, 1, make_pose(8, 0.04)), 0)
    room = pair.indices[:, 0] >= N_OBJECT
    np.testing.assert_array_equal(find_static(pair), room)


def test_inliers_have_weight(rig: Rig) -> None:
    reference, current = make_frame(rig, 0, START), make_frame(rig, 1, make_pose(5, 0.02))
    pairs = [make_pair(reference, current, c) for c in range(len(rig))]
    weights = [np.zeros(len(pair)) for pair in pairs]
    weights[0][[1, 5]] = 0.5
    weights[2][:3] = 1.0
    kept = select_inliers(pairs, weights)
    assert [len(pair) for pair in kept] == [2, 3]
    np.testing.assert_array_equal(kept[0].pixels_j, pairs[0].pixels_j[[1, 5]])
    np.testing.assert_array_equal(kept[0].indices, pairs[0].indices[[1, 5]])


def test_no_features_give_no_matches(rig: Rig) -> None:
    nothing = observe(rig, 1, [Features.empty() for _ in rig], START)
    for pair in (make_pair(nothing, make_frame(rig, 2, START), 0), make_pair(make_frame(rig, 2, START), nothing, 0)):
        assert len(pair) == 0
        assert pair.pixels_i.shape == pair.normalized_j.shape == (0, 2)


# --- background


def test_static_features_of_moving_object_are_background(rig: Rig) -> None:
    reference, current = make_frame(rig, 0, START), make_frame(rig, 1, make_pose(8, 0.06))
    learn_background_of(rig, reference, current)
    for c in range(len(rig)):
        for marks in (reference.cameras[c].background, current.cameras[c].background):
            # A pixel at which a point of the object would have been static is not decisive.
            assert not marks[:N_OBJECT].any()
            assert marks[N_OBJECT:].mean() > 0.9


def test_no_background_without_motion(rig: Rig) -> None:
    reference, current = make_frame(rig, 0, START), make_frame(rig, 1, make_pose(0.05, 0.0005))
    learn_background_of(rig, reference, current)
    assert not any(camera.background.any() for camera in (*reference.cameras, *current.cameras))


def test_points_on_rotation_axis_are_not_background(rig: Rig) -> None:
    # The object rotates about cam_0's viewing ray through its center: features near the center may be on it.
    camera = rig.cameras[0]
    axis = START.translation - camera.center
    turn = Rotation.from_rotvec(np.deg2rad(10) * axis / np.linalg.norm(axis))
    end = RigidTransform.from_components(START.translation, turn * START.rotation)
    pixels = camera.project(START.translation) + np.array([[0, 0], [3, 4], [150, 0]])
    features = Features(pixels, camera.normalize(pixels), np.eye(3, 128, dtype=np.float32))
    nothing = (Features.empty(), Features.empty())
    reference, current = observe(rig, 0, (features, *nothing), START), observe(rig, 1, (features, *nothing), end)
    learn_background_of(rig, reference, current, 0)
    assert reference.cameras[0].background.tolist() == current.cameras[0].background.tolist() == [False, False, True]


def test_known_background_is_skipped_and_passed_on(rig: Rig) -> None:
    reference, current = make_frame(rig, 0, START), make_frame(rig, 1, make_pose(8, 0.06))
    reference.cameras[1].background[N_OBJECT:] = True
    # Known background may also match another place by mistake: it is dropped, and that place is not marked.
    pixels = current.cameras[1].features.pixels.copy()
    pixels[N_OBJECT] += 30
    features = replace(current.cameras[1].features, pixels=pixels)
    others = [camera.features for camera in current.cameras]
    current = observe(rig, 1, [others[0], features, others[2]], current.pose)
    pair = make_pair(reference, current, 1)
    assert pair.indices[:, 0].tolist() == list(range(N_OBJECT))
    assert np.flatnonzero(current.cameras[1].background).tolist() == list(range(N_OBJECT + 1, N_OBJECT + N_ROOM))
    # Another reference lacks it, but the current frame has it now.
    other = make_pair(make_frame(rig, 0, START), current, 1)
    assert other.indices[:, 0].max() == N_OBJECT


def test_background_is_per_camera(rig: Rig) -> None:
    reference, current = make_frame(rig, 0, START), make_frame(rig, 1, make_pose(8, 0.06))
    learn_background_of(rig, reference, current, 2)
    assert [camera.background.any() for camera in reference.cameras] == [False, False, True]


def test_object_behind_camera(rig: Rig) -> None:
    behind = Camera(
        "cam_0",
        rig.cameras[0].size,
        rig.cameras[0].matrix,
        rig.cameras[0].distortion,
        RigidTransform.from_rotation(Rotation.from_rotvec([0, np.pi, 0])) * rig.cameras[0].camera_from_world,
    )
    odd = Rig([behind, *rig.cameras[1:]])
    reference, current = make_frame(rig, 0, START), make_frame(rig, 1, make_pose(8, 0.06))
    learn_background_of(odd, reference, current)
    assert not current.cameras[0].background[:N_OBJECT].any()


# --- geometry


def test_triangulation_is_exact_without_noise(rig: Rig) -> None:
    reference, current = make_frame(rig, 0, START), make_frame(rig, 1, make_pose(9, 0.03))
    for c in range(len(rig)):
        pair = make_pair(reference, current, c)
        pair = pair.subset(pair.indices[:, 0] < N_OBJECT)
        places = triangulate_pair(pair, rig.cameras[c], reference, current)
        assert len(places) > 0.9 * N_OBJECT
        gap = np.linalg.norm(places[:, None] - object_points(c), axis=2).min(axis=1)
        assert gap.max() < 1e-5


def test_triangulation_omits_uncertain_depths(rig: Rig) -> None:
    reference = make_frame(rig, 0, START)
    for turn, translation, share in ((0.0, 0.0, 0.0), (0.05, 0.0, 0.0), (0.5, 0.002, 0.5), (9, 0.03, 1.0)):
        current = make_frame(rig, 1, make_pose(turn, translation))
        places = triangulate_pair(make_pair(reference, current, 0), rig.cameras[0], reference, current)
        assert np.isfinite(places).all()
        assert places.shape[1] == 3
        if share == 0:
            assert len(places) == 0
    nothing = make_pair(reference, current, 0).subset(np.zeros(N_OBJECT + N_ROOM, bool))
    assert triangulate_pair(nothing, rig.cameras[0], reference, current).shape == (0, 3)


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_triangulation_accuracy(rig: Rig, noise: float) -> None:
    rng = np.random.default_rng(0)
    reference, current = make_frame(rig, 0, START), make_frame(rig, 1, make_pose(9, 0.03))
    pair = make_pair(reference, current, 1)
    pair = pair.subset(pair.indices[:, 0] < N_OBJECT)
    camera = rig.cameras[1]
    noisy = replace(
        pair,
        normalized_i=pair.normalized_i + noise / camera.focal * rng.standard_normal((len(pair), 2)),
        normalized_j=pair.normalized_j + noise / camera.focal * rng.standard_normal((len(pair), 2)),
    )
    places = triangulate_pair(noisy, camera, reference, current)
    gap = np.linalg.norm(places[:, None] - object_points(1), axis=2).min(axis=1)
    # A tenth of the distance for one pixel.
    assert np.median(gap) < 0.1 * 1.5 * max(noise, 0.01)


def test_term_of_last_frame_equals_matches(rig: Rig) -> None:
    base, current = make_frame(rig, 4, START), make_frame(rig, 5, make_pose(5, 0.02))
    pair = make_pair(base, current, 2)
    assert compute_reference_motion(pair, base.solved, {}) is None
    term = pair.to_term(2, rig.cameras[2])
    assert term.start_from_reference is None
    assert (term.camera, term.focal) == (2, rig.cameras[2].focal)
    np.testing.assert_array_equal(term.x, pair.normalized_i)
    np.testing.assert_array_equal(term.y, pair.normalized_j)
    np.testing.assert_array_equal(term.center_x, rig.cameras[2].center)


@pytest.mark.parametrize("steps_back", [0, 1, 3])
def test_term_of_older_reference_has_same_motion(rig: Rig, steps_back: int) -> None:
    """The motion from the last to the current frame leaves no residual in a term of an older reference."""
    base, current = make_frame(rig, 10, make_pose(4, 0.01, 3)), make_frame(rig, 11, make_pose(4, 0.01, 4))
    older = base if steps_back == 0 else make_frame(rig, 10 - steps_back, make_pose(4, 0.01, 3 - steps_back))
    motion = current.pose * base.pose.inv()
    center = base.pose.translation
    for c in range(len(rig)):
        pair = make_pair(older, current, c)
        moved_ = compute_reference_motion(pair, base.solved, {older.solved.number: older.solved})
        term = pair.subset(pair.indices[:, 0] < N_OBJECT).to_term(c, rig.cameras[c], moved_)
        rotation, translation = motion.rotation.as_matrix(), motion.apply(center) - center
        assert np.abs(compute_epipolar_px(term, center, rotation, translation)).max() < 1e-3
        # Another motion does.
        other = Rotation.from_rotvec([0.02, 0, 0.02]).as_matrix() @ rotation
        assert np.abs(compute_epipolar_px(term, center, other, translation)).max() > 1


# --- chance -------------------------------------------------------------------------------------------------------------


def fit_random_matches(rng: np.random.Generator, n: int, n_unknowns: int, width: float) -> int:
    """Return the largest number of n random equations, all of the same range, that one of many solutions fulfills.

    Each solution fulfills as many randomly selected equations as there are unknowns exactly, others within `width`.
    """
    equations, right, largest = rng.standard_normal((n, n_unknowns)), rng.uniform(-1.0, 1.0, n), 0
    for _ in range(300):
        chosen = rng.choice(n, n_unknowns, replace=False)
        solution = np.linalg.lstsq(equations[chosen], right[chosen], rcond=None)[0]
        # In (-1, 1) as the right sides, so that the probability is the width.
        reached = np.mod(equations @ solution + 1.0, 2.0) - 1.0
        largest = max(largest, int((np.abs(reached - right) < width).sum()))
    return largest


@pytest.mark.parametrize("n", [40, 80, 200])
@pytest.mark.parametrize("width", [0.01, 0.1, 0.3])
def test_best_of_random_matches_is_chance(n: int, width: float) -> None:
    for seed in range(5):
        inliers = fit_random_matches(np.random.default_rng(seed), n, 9, width)
        assert is_explained_by_chance([InlierStatistics(inliers, inliers, n, width * n, 3)])


@given(
    n=st.integers(30, 1000), share=st.floats(0.3, 0.7), probability=st.floats(1e-4, 0.002), cameras=st.integers(1, 3)
)
def test_many_exact_inliers_are_no_chance(n: int, share: float, probability: float, cameras: int) -> None:
    inliers = round(share * n)
    own = [InlierStatistics(inliers, inliers, n, probability * n, 3)] * cameras
    assert not is_explained_by_chance(own) or inliers * cameras <= 2 * (6 + 3 * cameras)
    # More of them are no worse evidence, a larger probability is no better.
    more = [replace(one, n_inlier_features=inliers + 1) for one in own]
    likelier = [replace(one, expected_by_chance=2.0 * probability * n) for one in own]
    assert is_explained_by_chance(own) or not is_explained_by_chance(more)
    assert is_explained_by_chance(likelier) or not is_explained_by_chance(own)


def test_number_of_false_alarms() -> None:
    """Of 40 matches 25 agree: 9 of them determine the unknowns."""
    choices = comb(40, 25) * comb(25, 9)
    for alarms, expected in ((0.99e-3, False), (1.01e-3, True)):
        probability = (alarms / choices) ** (1.0 / (25 - 9))
        assert is_explained_by_chance([InlierStatistics(25, 25, 40, 40.0 * probability, 3)]) is expected


def test_chance_of_few_or_of_nearly_all_matches() -> None:
    assert is_explained_by_chance([InlierStatistics(18, 18, 30, 1e-9, 3)])
    assert not is_explained_by_chance([InlierStatistics(19, 19, 30, 0.0, 3)])
    assert not is_explained_by_chance([InlierStatistics(27, 27, 30, 9.0, 3)])
