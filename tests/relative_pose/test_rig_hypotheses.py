"""Hypotheses on contradicting cameras: each mistake is found on simulated matches, and good rigs are not accused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.relative_pose.camera_evidence import MAX_POOLED_F_RATIO
from sylpose.relative_pose.rig_hypotheses import (
    MAX_AGREEING,
    MAX_NAMED,
    MIN_PAIRS,
    FramePair,
    Hypothesis,
    HypothesisFit,
    Mistake,
    compute_f_ratios,
    list_hypotheses,
    select_explanations,
    summarize,
)
from sylpose.rig import Camera, Rig
from sylpose.simulate import arc, ellipsoid, random_motion, simulate_matches
from sylpose.units import METERS

Recording = tuple[Rig, list[FramePair]]
FLIP_YZ, FLIP_Y = np.diag([1.0, -1.0, -1.0]), np.diag([1.0, -1.0, 1.0])


def record(cameras: int, seed: int = 1, size: tuple[int, int] = (640, 480)) -> Recording:
    """Simulate three pairs of frames; cameras at different heights, and no principal point in the middle."""
    rng = np.random.default_rng([cameras, seed])
    rig = arc(cameras, 35.0, 1.5, 1000.0, size, height=rng.uniform(-0.6, 0.6, cameras))
    pairs = list[FramePair]()
    for _ in range(3):
        motion = random_motion(rng.uniform(8.0, 14.0), rng.uniform(0.01, 0.04), rng)
        found = simulate_matches(rig, ellipsoid((0.15, 0.12, 0.1)), motion, rng=rng, per_camera=80, noise_px=0.3)
        pairs.append(
            [(view.denormalize(m.x), view.denormalize(m.y)) for view, m in zip(rig, found.matches, strict=True)]
        )
    return rig, pairs


def change_rig(rig: Rig, change: Callable[[Camera], RigidTransform]) -> Rig:
    return Rig([replace(camera, camera_from_world=change(camera)) for camera in rig])


def change_pixels(recording: Recording, change: Callable[[FloatArray], FloatArray], camera: int | None) -> Recording:
    rig, pairs = recording
    changed: list[FramePair] = [
        [(change(x), change(y)) if camera in (None, c) else (x, y) for c, (x, y) in enumerate(pair)] for pair in pairs
    ]
    return rig, changed


def reflect(camera: Camera) -> RigidTransform:
    pose = camera.camera_from_world
    rotation = Rotation.from_matrix(FLIP_Y @ pose.rotation.as_matrix() @ FLIP_Y)
    return RigidTransform.from_components(FLIP_Y @ pose.translation, rotation)


def rotate(camera: Camera, degrees: float) -> RigidTransform:
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.3, 0.9, 0.3]))
    return RigidTransform.from_rotation(turn) * camera.camera_from_world


OPENGL = RigidTransform.from_rotation(Rotation.from_matrix(FLIP_YZ))
WHOLE: dict[Mistake, Callable[[Recording], Recording]] = {
    Mistake.MIRRORED: lambda own: change_pixels(own, lambda p: p * [-1, 1] + [639, 0], None),
    Mistake.TURNED: lambda own: change_pixels(own, lambda p: [639, 479] - p, None),
    Mistake.FLIPPED: lambda own: (change_rig(own[0], reflect), own[1]),
    Mistake.INVERTED: lambda own: (change_rig(own[0], lambda camera: camera.camera_from_world.inv()), own[1]),
    Mistake.OPENGL: lambda own: (change_rig(own[0], lambda camera: OPENGL * camera.camera_from_world), own[1]),
    Mistake.INVERTED_OPENGL: lambda own: (
        change_rig(own[0], lambda camera: (OPENGL * camera.camera_from_world).inv()),
        own[1],
    ),
}
ONE: dict[Mistake, Callable[[Recording], Recording]] = {
    Mistake.MIRRORED: lambda own: change_pixels(own, lambda p: p * [-1, 1] + [639, 0], 1),
    Mistake.TURNED: lambda own: change_pixels(own, lambda p: [639, 479] - p, 1),
    Mistake.INCONSISTENT: lambda own: (
        Rig(
            [
                *own[0].cameras[:1],
                replace(own[0].cameras[1], camera_from_world=rotate(own[0].cameras[1], 15.0)),
                *own[0].cameras[2:],
            ]
        ),
        own[1],
    ),
}


def explain(recording: Recording) -> list[HypothesisFit]:
    rig, pairs = recording
    given = compute_f_ratios(rig, pairs, Hypothesis())
    return select_explanations([summarize(h, compute_f_ratios(rig, pairs, h), given) for h in list_hypotheses(rig)])


def named(fits: Sequence[HypothesisFit]) -> list[Hypothesis]:
    return [fit.hypothesis for fit in fits]


@pytest.mark.parametrize(
    "cameras", [2, 3, pytest.param(4, marks=pytest.mark.slow), pytest.param(6, marks=pytest.mark.slow)]
)
def test_good_rigs_are_not_accused(cameras: int) -> None:
    for seed in range(2):
        rig, pairs = record(cameras, seed)
        assert np.median(compute_f_ratios(rig, pairs, Hypothesis())) < 1.0
        assert explain((rig, pairs)) == []


def check_named(found: Sequence[Sequence[Hypothesis]], expected: Hypothesis) -> None:
    """Check that one is named in most recordings, and nothing else in any: not every motion shows it."""
    assert all(own in ([expected], []) for own in found)
    assert 2 * sum(bool(own) for own in found) >= len(found)


@pytest.mark.parametrize("cameras", [3, pytest.param(4, marks=pytest.mark.slow)])
@pytest.mark.parametrize("mistake", WHOLE)
def test_mistakes_of_the_whole_rig_are_named(mistake: Mistake, cameras: int) -> None:
    found = [named(explain(WHOLE[mistake](record(cameras, seed)))) for seed in range(2)]
    check_named(found, Hypothesis(mistake))


@pytest.mark.parametrize("mistake", WHOLE)
def test_two_cameras_leave_at_most_three_mistakes(mistake: Mistake) -> None:
    """The right one is among them. A pair of cameras has symmetries, and fewer constraints."""
    for seed in range(2):
        found = named(explain(WHOLE[mistake](record(2, seed))))
        assert Hypothesis(mistake) in found or not found
        assert len(found) <= MAX_NAMED


@pytest.mark.parametrize("cameras", [3, pytest.param(4, marks=pytest.mark.slow)])
@pytest.mark.parametrize("mistake", ONE)
def test_the_faulty_camera_is_named(mistake: Mistake, cameras: int) -> None:
    found = [named(explain(ONE[mistake](record(cameras, seed)))) for seed in range(2)]
    check_named(found, Hypothesis(mistake, (1,)))


@pytest.mark.parametrize("units", [("m", "mm"), ("in", "mm"), ("cm", "m")])
@pytest.mark.parametrize("cameras", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_the_unit_of_one_camera_is_named(units: tuple[str, str], cameras: int) -> None:
    rig, pairs = record(cameras)
    first, second, *others = rig
    pose, scale = second.camera_from_world, METERS[units[1]] / METERS[units[0]]
    wrong = RigidTransform.from_components(scale * pose.translation, pose.rotation)
    recording = Rig([first, replace(second, camera_from_world=wrong), *others]), pairs
    found = named(explain(recording))
    # Of two cameras, it is either the one or the other.
    expected = [Hypothesis(Mistake.UNIT, (1,), units=units), Hypothesis(Mistake.UNIT, (0,), units=units[::-1])]
    assert found
    assert all(own in expected[: 2 if cameras == 2 else 1] for own in found)


@pytest.mark.parametrize("order", [(1, 0, 2), (1, 2, 0), pytest.param((2, 3, 0, 1), marks=pytest.mark.slow)])
def test_exchanged_cameras_are_named(order: tuple[int, ...]) -> None:
    rig, pairs = record(len(order))
    assert named(explain((rig, [[pair[c] for c in order] for pair in pairs]))) == [Hypothesis(Mistake.EXCHANGED, order)]


@pytest.mark.parametrize("clockwise", [True, False])
def test_square_images_may_be_turned_by_a_right_angle(clockwise: bool) -> None:
    recording = record(3, size=(640, 640))

    def turn(pixels: FloatArray) -> FloatArray:
        u, v = pixels.T
        return np.column_stack([639 - v, u] if clockwise else [v, 639 - u])

    mistake = Mistake.CLOCKWISE if clockwise else Mistake.COUNTERCLOCKWISE
    assert named(explain(change_pixels(recording, turn, 2))) == [Hypothesis(mistake, (2,))]
    assert not any(h.mistake is mistake for h in list_hypotheses(record(3)[0]))


def test_hypotheses_are_distinct_and_bounded() -> None:
    for cameras, orders in ((2, 1), (3, 5), (4, 23), (6, 15 + 5)):
        rig = arc(cameras, 35.0, 1.5, 1000.0)
        hypotheses = list(list_hypotheses(rig))
        assert len(set(hypotheses)) == len(hypotheses)
        assert sum(h.mistake is Mistake.EXCHANGED for h in hypotheses) == orders
    # Images of another size do not fit the camera.
    first, *others = arc(3, 35.0, 1.5, 1000.0, (640, 480))
    mixed = Rig([replace(first, size=(480, 640)), *others])
    assert [h.cameras for h in list_hypotheses(mixed) if h.mistake is Mistake.EXCHANGED] == [(0, 2, 1)]


def test_no_motion_and_no_matches_are_no_agreement() -> None:
    """A motion without a baseline fits any matches under any hypothesis."""
    rig, pairs = record(3)
    still = [[(x, x) for x, _ in pair] for pair in pairs]
    assert np.isinf(compute_f_ratios(rig, still, Hypothesis())).all()
    alone = [[pair[0], (pair[1][0][:9], pair[1][1][:9]), (pair[2][0][:0], pair[2][1][:0])] for pair in pairs]
    assert np.isnan(compute_f_ratios(rig, alone, Hypothesis())).all()


def test_a_mistake_explains_every_pair_of_frames() -> None:
    """Outliers may contradict a pair of frames in any case, but no pair contradicts the right explanation alone."""
    hypothesis, nan = Hypothesis(Mistake.EXCHANGED, (1, 0)), np.nan
    found = summarize(hypothesis, np.array([25.0, 1.6, 0.5, nan]), np.array([6.8, 26.5, 10.8, 4.0]))
    assert (found.f_ratio, found.given_ratio, found.worst_ratio, found.n_pairs) == (1.6, 10.8, 25.0, 3)
    assert not found.is_agreement
    found = summarize(hypothesis, np.array([25.0, 1.6, 0.5]), np.array([20.0, 26.5, 10.8]))
    assert found.worst_ratio == 0.0
    assert found.is_agreement


def test_selection_needs_pairs_and_a_clear_reduction() -> None:
    mirrored, left_out = Hypothesis(Mistake.MIRRORED), Hypothesis(Mistake.INCONSISTENT, (0,))
    assert select_explanations([HypothesisFit(mirrored, 0.5, 100.0, MIN_PAIRS - 1)]) == []
    assert select_explanations([HypothesisFit(mirrored, 0.5, MAX_POOLED_F_RATIO, 5)]) == []
    assert select_explanations([HypothesisFit(mirrored, 0.5, 1.01 * MAX_POOLED_F_RATIO, 5)])
    assert select_explanations([HypothesisFit(mirrored, 1.01 * MAX_AGREEING, 100.0, 5)]) == []
    assert select_explanations([HypothesisFit(mirrored, 0.5, 20.0, 5, 1.01 * MAX_POOLED_F_RATIO)]) == []
    assert select_explanations([HypothesisFit(mirrored, 0.5, 20.0, MIN_PAIRS)]) == []
    assert select_explanations([HypothesisFit(mirrored, 0.5, 20.0, MIN_PAIRS + 1)])
    assert select_explanations([]) == []
    # A camera that can be left out may be the one with the mistake; two that can are both named.
    both = [HypothesisFit(left_out, 0.1, 100.0, 5), HypothesisFit(mirrored, 0.6, 100.0, 5)]
    assert named(select_explanations(both)) == [mirrored]
    other = replace(left_out, cameras=(1,))
    assert named(select_explanations([both[0], HypothesisFit(other, 0.6, 100.0, 5)])) == [left_out, other]
    assert select_explanations([HypothesisFit(Hypothesis(Mistake.LATE, (0,), 1), 0.1, 100.0, MIN_PAIRS)]) == []
    late = [HypothesisFit(Hypothesis(Mistake.LATE, (0,), k), 0.1 * k, 100.0, 5) for k in (2, 1, 3)]
    assert [fit.hypothesis.lag for fit in select_explanations(late)] == [1]
    orders = [HypothesisFit(Hypothesis(Mistake.EXCHANGED, (k,)), 0.5, 100.0, 5) for k in range(MAX_NAMED + 1)]
    assert select_explanations(orders) == []
    assert all(a.f_ratio <= b.f_ratio for a, b in pairwise(select_explanations(orders[1:])))
