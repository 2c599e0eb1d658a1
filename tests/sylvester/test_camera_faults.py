"""Fault detection: faulty cameras are identified and excluded, good ones are not, and uncertain cases are reported."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.simulate import box, ellipsoid, plane, random_motion, ring, simulate_matches
from sylpose.status import Status
from sylpose.sylvester import camera_faults as agreement
from sylpose.sylvester.camera_faults import Diagnosis, diagnose_cameras, find_faulty_cameras, solve_robust
from sylpose.sylvester.centralized import solve_centralized
from sylpose.sylvester.orthographic import compute_views
from tests.scenes import compute_angle, draw_rotations

seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=8, deadline=None)


def random_cameras(rng: np.random.Generator, n: int) -> FloatArray:
    """Return camera rotations: the first three look along three axes, the others in random directions."""
    base = np.array([np.roll(np.eye(3), k, axis=0) for k in range(3)])
    return np.asarray(np.concatenate([base, draw_rotations(rng, n - 3)]) @ draw_rotations(rng, 1)[0])


def simulate_orthographic(
    rng: np.random.Generator, cameras: FloatArray, turn: FloatArray, size: float = 1.0, noise: float = 0.0
) -> list[tuple[FloatArray, FloatArray]]:
    """Return each camera's images of its own points; every point also occurs at the opposite depth."""
    matches = []
    for q in cameras:
        points = size * rng.normal(size=(30, 3))
        points = np.concatenate([points, points * [1, 1, -1]])
        x, y = points[:, :2], (points @ (q @ turn @ q.T).T)[:, :2]
        matches.append((x, y + noise * rng.normal(size=y.shape)))
    return matches


def pair_moments(matches: list[tuple[FloatArray, FloatArray]]) -> list[PairMoments]:
    return [PairMoments.from_matches(x, y) for x, y in matches]


def fault_kinds(diagnosis: Diagnosis) -> dict[int, str]:
    return {c: fault.kind for c, fault in enumerate(diagnosis.faults) if fault is not None}


# --- Scenes -------------------------------------------------------------------------------------------------------------

# (rng, rotation (3, 3), x, y) -> the same data with a fault.
FaultFunction = Callable[
    [np.random.Generator, FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray, FloatArray]
]


def make_rotated_calibration(degrees: float) -> FaultFunction:
    """Return a fault that rotates the calibration about a random axis."""

    def apply_fault(
        rng: np.random.Generator, q: FloatArray, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        axis = rng.standard_normal(3)
        off = Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis)).as_matrix()
        return off @ q, x, y

    return apply_fault


def apply_mirror(
    _: np.random.Generator, q: FloatArray, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    return q, x * [-1, 1], y * [-1, 1]


def apply_freeze(
    rng: np.random.Generator, q: FloatArray, x: FloatArray, _: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The noise is half a pixel for f = 1000 px."""
    return q, x, x + 5e-4 * rng.standard_normal(x.shape)


def apply_junk(
    rng: np.random.Generator, q: FloatArray, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Replace the matches by random pairs in the object's image region."""
    anywhere = [rng.uniform(p.min(axis=0), p.max(axis=0), p.shape) for p in (x, y)]
    return q, anywhere[0], anywhere[1]


class Scene(NamedTuple):
    """Cameras (C, 3, 3) and their moments, the faulty ones, and the true rotation (3, 3)."""

    rotations: FloatArray
    moments: list[PairMoments]
    bad: tuple[int, ...]
    truth: FloatArray


def make_scene(n: int, turn_deg: float, seed: int, fault: FaultFunction | None = None, n_bad: int = 1) -> Scene:
    """Simulate an ellipsoid or a box in perspective; the seed selects the faulty cameras."""
    rng = np.random.default_rng([seed, n, round(10 * turn_deg)])
    body = (ellipsoid((0.15, 0.12, 0.1)), box())[seed % 2]
    motion = random_motion(turn_deg, 0.03, rng)
    rig = ring(n, height=[0.4 * (-1) ** k for k in range(n)])
    pair = simulate_matches(rig, body, motion, rng=rng)
    cameras = [(camera.rotation, m.x, m.y) for camera, m in zip(rig, pair.matches, strict=True)]
    bad = () if fault is None else tuple(rng.choice(n, n_bad, replace=False).tolist())
    for c in bad:
        assert fault is not None
        cameras[c] = fault(rng, *cameras[c])
    moments = [PairMoments.from_matches(x, y) for _, x, y in cameras]
    return Scene(np.array([q for q, _, _ in cameras]), moments, bad, motion.rotation.as_matrix())


def make_board_scene(
    n: int, turn_deg: float, seed: int, fault: FaultFunction | None = None, shift: float = 0.03, tilt: float = 70.0
) -> Scene:
    """Simulate a board whose normal is `tilt` degrees from the first camera's axis: several cameras see it from the side."""
    rng = np.random.default_rng([seed, n])
    rig = ring(n, height=[0.4 * (-1) ** k for k in range(n)])
    about = rng.uniform(0, 2 * np.pi)
    pose = Rotation.from_rotvec(np.deg2rad(tilt) * np.array([np.cos(about), np.sin(about), 0.0]))
    motion, start = random_motion(turn_deg, shift, rng), RigidTransform.from_rotation(pose)
    pair = simulate_matches(rig, plane((0.3, 0.2)), motion, rng=rng, start=start)
    cameras = [(camera.rotation, m.x, m.y) for camera, m in zip(rig, pair.matches, strict=True)]
    bad = () if fault is None else (int(rng.integers(n)),)
    for c in bad:
        assert fault is not None
        cameras[c] = fault(rng, *cameras[c])
    moments = [PairMoments.from_matches(x, y) for _, x, y in cameras]
    return Scene(np.array([q for q, _, _ in cameras]), moments, bad, motion.rotation.as_matrix())


class Outcome(NamedTuple):
    """Errors (radians) with all cameras, without the faulty ones, and robust; detected faults; certainty.

    `detected`: kinds of fault detected for faulty cameras; `false_alarms`: for good cameras.
    """

    all: float
    without_faulty: float
    robust: float
    detected: list[str]
    false_alarms: list[str]
    is_uncertain: bool


def evaluate_scene(s: Scene) -> Outcome:
    good = [c for c in range(len(s.moments)) if c not in s.bad]
    robust = solve_robust(s.rotations, s.moments)
    named = fault_kinds(robust.diagnosis)
    return Outcome(
        compute_angle(solve_centralized(s.rotations, s.moments).rotation, s.truth),
        compute_angle(solve_centralized(s.rotations[good], [s.moments[c] for c in good]).rotation, s.truth),
        np.pi if robust.solution is None else compute_angle(robust.rotation, s.truth),
        [kind for c, kind in named.items() if c in s.bad],
        [kind for c, kind in named.items() if c in good],
        not robust.diagnosis.consistent,
    )


# --- Monte Carlo, small (benchmarks/sensors.py is the large one) --------------------------------------------------------


@pytest.mark.parametrize("n", [3, 4, 8])
def test_good_cameras_are_not_reported(n: int) -> None:
    """Ellipsoids and boxes in perspective, for which the plain estimate is biased by degrees."""
    for seed in range(4):
        for turn in (5.0, 15.0):
            found = evaluate_scene(make_scene(n, turn, seed))
            assert found.false_alarms == []
            assert not found.is_uncertain


@pytest.mark.parametrize(
    ("spoil", "kind", "found_at_least"),
    [
        (make_rotated_calibration(180), "calibration", 6),
        pytest.param(apply_mirror, "calibration", 7, marks=pytest.mark.slow),
        pytest.param(apply_freeze, "frozen", 7, marks=pytest.mark.slow),
        (apply_junk, "junk", 10),
    ],
)
def test_one_faulty_camera_of_eight_is_detected_and_excluded(
    spoil: FaultFunction, kind: str, found_at_least: int
) -> None:
    outcomes = [evaluate_scene(make_scene(8, 10.0, seed, spoil)) for seed in range(10)]
    named = [k for o in outcomes for k in o.detected]
    assert len(named) >= found_at_least
    assert named.count(kind) >= 0.9 * len(named)
    assert [o.false_alarms for o in outcomes] == [[]] * 10
    errors = np.array([o[:3] for o in outcomes])
    median, worst = np.median(errors, axis=0), np.quantile(errors, 0.9, axis=0)
    assert median[2] <= 2 * median[1]
    assert worst[2] <= 2 * worst[1]
    assert median[0] > 1.2 * median[2]  # with the faulty camera, errors are larger


@pytest.mark.parametrize(
    ("turn", "shift"),
    [
        (0.0, 0.0),
        pytest.param(0.0, 0.03, marks=pytest.mark.slow),
        (1.0, 0.03),
        pytest.param(15.0, 0.03, marks=pytest.mark.slow),
    ],
)
def test_no_fault_is_reported_for_an_oblique_board(turn: float, shift: float) -> None:
    """With normally distributed slopes 11 % of the cameras were named, and 4 % for a static board, because of noise in x."""
    found = [evaluate_scene(make_board_scene(n, turn, seed, shift=shift)) for n in (4, 8) for seed in range(8)]
    assert [o.false_alarms for o in found] == [[]] * len(found)
    assert sum(o.is_uncertain for o in found) <= 1


@pytest.mark.parametrize(
    ("spoil", "found_at_least"),
    [
        (make_rotated_calibration(180), 12),
        pytest.param(apply_mirror, 12, marks=pytest.mark.slow),
        pytest.param(apply_freeze, 12, marks=pytest.mark.slow),
        pytest.param(apply_junk, 18, marks=pytest.mark.slow),
    ],
)
def test_faulty_camera_is_detected_for_a_board(spoil: FaultFunction, found_at_least: int) -> None:
    """Detection rates for eight cameras are 78 to 100 % (docs/history/benchmarks.md#bad-sensors)."""
    found = [evaluate_scene(make_board_scene(8, 10.0, seed, spoil, tilt=4.0 * seed)) for seed in range(20)]
    assert sum(len(o.detected) for o in found) >= found_at_least
    assert sum(len(o.false_alarms) for o in found) <= 1


def test_affine_map_is_unbiased_by_noise_in_x() -> None:
    """A stripe of 100 by 3 pixels with a pixel of noise: plain least squares give 0.9 instead of 1."""
    rng = np.random.default_rng(0)
    short = []
    for _ in range(200):
        x = rng.standard_normal((100, 2)) * [0.1, 0.003]
        seen, later = x + 1e-3 * rng.standard_normal((2, *x.shape))
        moments = [PairMoments.from_matches(seen, later)]
        views = compute_views(np.eye(3)[None], moments, aim=False)
        fits = agreement.fit_affine_maps(views)
        plain = views.s_yx[0] @ np.linalg.inv(views.s_xx[0])
        short.append((1 - plain[1, 1], 1 - fits.F[0, 1, 1], fits.noise[0, 3, 3]))
    plain_off, off, variance = np.mean(short, axis=0)
    assert plain_off == pytest.approx(0.1, abs=0.02)
    assert abs(off) < 0.03
    assert 0.5 < np.var([s[1] for s in short]) / variance < 1.5


@pytest.mark.parametrize("degrees", [5, 20])
def test_undetectably_small_fault_has_small_effect(degrees: float) -> None:
    errors = np.median(
        [evaluate_scene(make_scene(4, 5.0, seed, make_rotated_calibration(degrees)))[:3] for seed in range(10)], axis=0
    )
    assert errors[2] <= 2 * errors[1]


def test_two_faulty_cameras_of_eight_are_detected() -> None:
    found = [evaluate_scene(make_scene(8, 15.0, seed, apply_junk, 2)) for seed in range(5)]
    assert sum(o.detected.count("junk") for o in found) >= 9
    found = [evaluate_scene(make_scene(8, 15.0, seed, make_rotated_calibration(180), 2)) for seed in range(8)]
    assert sum(o.detected.count("calibration") for o in found) >= 8
    assert sum(len(o.false_alarms) for o in found) <= 1


# --- Results ---------------------------------------------------------------------------------------------------------


def test_result_excludes_faulty_camera_and_text_contains_its_name() -> None:
    s = make_scene(8, 10.0, 3, apply_junk)
    names = [f"cam_{k}" for k in range(8)]
    robust = solve_robust(s.rotations, s.moments, names=names)
    bad = s.bad[0]
    fault = robust.faults[bad]
    assert fault is not None
    assert fault.camera == names[bad]
    assert names[bad] in fault.text
    assert "junk" in robust.diagnosis.text
    assert robust.weights[bad] == 0
    assert fault.score == robust.diagnosis.scores[bad] > agreement.FAULT_SCORE
    rest = [c for c in range(8) if c != bad]
    assert (robust.weights[rest] == 1).all()
    by_hand = solve_centralized(s.rotations[rest], [s.moments[c] for c in rest])
    assert robust.solution is not None
    np.testing.assert_allclose(robust.solution.rotation, by_hand.rotation, atol=1e-12)
    assert robust.status is (Status.OK if by_hand.certified else Status.NOT_CERTIFIED)


def test_status_equals_that_of_the_solution() -> None:
    """With few noisy matches the rotation is often not fully observable; with noise as large as the spread it is random."""
    found = set()
    for seed in range(40):
        rng, noise = np.random.default_rng(seed), (0.5, 1.0)[seed % 2]
        cameras, turn = draw_rotations(rng, 4), draw_rotations(rng, 1)[0]
        moments = []
        for q in cameras:
            points = rng.normal(size=(8, 3))
            x, y = (points @ q.T)[:, :2], (points @ turn.T @ q.T)[:, :2]
            moments.append(PairMoments.from_matches(*(p + noise * rng.normal(size=p.shape) for p in (x, y))))
        robust = solve_robust(cameras, moments, aim=False)
        if robust.solution is not None and robust.diagnosis.consistent:
            assert robust.status is robust.solution.status
            np.testing.assert_array_equal(robust.rotation, robust.solution.rotation)
            np.testing.assert_array_equal(robust.information, robust.solution.information)
            found.add(robust.status)
    assert found == {Status.OK, Status.NOT_CERTIFIED, Status.ROTATION_NOT_OBSERVABLE}


def test_result_equals_plain_estimate_without_faults() -> None:
    s = make_scene(4, 5.0, 0)
    robust, plain = solve_robust(s.rotations, s.moments), solve_centralized(s.rotations, s.moments)
    assert (robust.weights == 1).all()
    assert robust.solution is not None
    np.testing.assert_array_equal(robust.solution.rotation, plain.rotation)
    assert robust.diagnosis.text == "No camera is at fault."


def test_two_disagreeing_cameras_are_both_kept() -> None:
    """The object rotates about the first camera's axis; the second, parallel camera reports the opposite rotation."""
    rng = np.random.default_rng(0)
    x = 0.05 * rng.normal(size=(40, 2))
    turned = x @ Rotation.from_rotvec([0, 0, 0.4]).as_matrix()[:2, :2].T
    back = x @ Rotation.from_rotvec([0, 0, -0.4]).as_matrix()[:2, :2].T
    moments = [PairMoments.from_matches(x, y + 1e-4 * rng.normal(size=x.shape)) for y in (turned, back)]
    robust = solve_robust([np.eye(3)] * 2, moments, names=["left", "right"])
    assert robust.faults == (None, None)
    assert robust.status is Status.NOT_CONSISTENT
    assert (robust.weights == 1).all()
    assert "cameras disagree" in robust.diagnosis.text
    agreeing = solve_robust([np.eye(3)] * 2, [moments[0]] * 2)
    assert agreeing.diagnosis.consistent


def test_no_majority_is_not_consistent() -> None:
    """Two cameras report one rotation, and two the opposite one."""
    rng = np.random.default_rng(1)
    x = 0.05 * rng.normal(size=(40, 2))
    moments = []
    for sign in (1, 1, -1, -1):
        y = x @ Rotation.from_rotvec([0, 0, 0.4 * sign]).as_matrix()[:2, :2].T
        moments.append(PairMoments.from_matches(x, y + 1e-4 * rng.normal(size=x.shape)))
    robust = solve_robust([np.eye(3)] * 4, moments)
    assert robust.status is Status.NOT_CONSISTENT
    assert robust.faults == (None,) * 4


def test_only_junk_cameras_give_no_solution() -> None:
    rng = np.random.default_rng(2)
    moments = [PairMoments.from_matches(*rng.uniform(-0.1, 0.1, (2, 60, 2))) for _ in range(3)]
    robust = solve_robust(draw_rotations(rng, 3), moments)
    assert robust.status is Status.NOT_CONSISTENT
    assert robust.solution is None
    assert np.isnan(robust.rotation).all()
    assert robust.rotation.shape == (3, 3)
    np.testing.assert_array_equal(robust.information, np.zeros((3, 3)))
    assert fault_kinds(robust.diagnosis) == {0: "junk", 1: "junk", 2: "junk"}


@pytest.mark.parametrize("noise", [0.0, 5e-4])
def test_no_camera_is_frozen_for_a_static_object(noise: float) -> None:
    rng = np.random.default_rng(3)
    cameras = random_cameras(rng, 4)
    images = [0.05 * rng.normal(size=(40, 2)) for _ in cameras]
    moments = [PairMoments.from_matches(x, x + 5e-4 * rng.normal(size=x.shape)) for x in images[1:]]
    frozen = PairMoments.from_matches(images[0], images[0] + noise * rng.normal(size=images[0].shape))
    robust = solve_robust(cameras, [frozen, *moments])
    assert robust.faults == (None,) * 4
    assert robust.solution is not None
    assert compute_angle(robust.solution.rotation, np.eye(3)) < 0.02


@pytest.mark.parametrize("noise", [0.0, 5e-4])
def test_two_frozen_cameras_of_four_are_detected(noise: float) -> None:
    rng = np.random.default_rng(1)
    cameras, turn = random_cameras(rng, 4), Rotation.from_rotvec([0.2, 0.2, -0.2]).as_matrix()
    matches = simulate_orthographic(rng, cameras, turn, size=0.05, noise=5e-4)
    for c in (0, 3):
        x = matches[c][0]
        matches[c] = x, x + noise * rng.normal(size=x.shape)
    assert fault_kinds(diagnose_cameras(cameras, pair_moments(matches), aim=False)) == {0: "frozen", 3: "frozen"}


def test_cameras_with_few_matches_are_not_scored() -> None:
    s = make_scene(8, 10.0, 0, apply_junk)
    few = PairMoments.from_matches(np.eye(2) * 0.1, np.eye(2) * 0.1)
    line = np.outer(np.linspace(-0.1, 0.1, 30), [1.0, 1.0])
    extra = [few, PairMoments.zero(), PairMoments.from_matches(line, line)]
    alone = diagnose_cameras(s.rotations, s.moments)
    more = diagnose_cameras(np.concatenate([s.rotations, s.rotations[:3]]), [*s.moments, *extra])
    assert np.isnan(more.scores[8:]).all()
    assert (more.weights[8:] == 1).all()
    assert fault_kinds(more) == fault_kinds(alone)
    np.testing.assert_allclose(more.scores[:8], alone.scores, rtol=1e-9)


def test_faults_for_a_given_rotation() -> None:
    s = make_scene(8, 10.0, 5, make_rotated_calibration(180))
    at_truth = find_faulty_cameras(s.rotations, s.moments, s.truth)
    assert fault_kinds(at_truth) == {s.bad[0]: "calibration"}
    good = make_scene(8, 10.0, 5)
    assert fault_kinds(find_faulty_cameras(good.rotations, good.moments, good.truth)) == {}
    wrong = find_faulty_cameras(good.rotations, good.moments, Rotation.from_rotvec([0.5, 0.5, 0.5]).as_matrix())
    assert not wrong.consistent


# --- Mathematics -------------------------------------------------------------------------------------------------------


@given(seeds, st.integers(4, 8), st.floats(0, 1.5))
@quick
def test_noise_free_orthographic_cameras_are_consistent(seed: int, n: int, turn_angle: float) -> None:
    rng = np.random.default_rng(seed)
    cameras = random_cameras(rng, n)
    turn = Rotation.from_rotvec(turn_angle * draw_rotations(rng, 1)[0, 0]).as_matrix()
    diagnosis = diagnose_cameras(cameras, pair_moments(simulate_orthographic(rng, cameras, turn)), aim=False)
    assert fault_kinds(diagnosis) == {}
    assert compute_angle(diagnosis.rotation, turn) < 0.05
    at_truth = find_faulty_cameras(cameras, pair_moments(simulate_orthographic(rng, cameras, turn)), turn, aim=False)
    assert at_truth.scores.max() < 1e-9


@given(seeds)
@quick
def test_equivariant_under_a_change_of_world_frame_and_order(seed: int) -> None:
    s = make_scene(5, 10.0, seed % 1000, apply_junk)
    rng = np.random.default_rng(seed)
    new_from_old, order = draw_rotations(rng, 1)[0], rng.permutation(5)
    a = diagnose_cameras(s.rotations, s.moments)
    b = diagnose_cameras(s.rotations[order] @ new_from_old.T, [s.moments[c] for c in order])
    np.testing.assert_allclose(b.scores, a.scores[order], rtol=1e-3, atol=1e-3)
    assert compute_angle(b.rotation, new_from_old @ a.rotation @ new_from_old.T) < 1e-4
    assert fault_kinds(b) == {k: a.faults[c].kind for k, c in enumerate(order) if a.faults[c] is not None}


@given(seeds)
@quick
def test_derivative_of_the_affine_map_against_finite_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    s = make_scene(4, 10.0, seed % 100)
    fits = agreement.fit_affine_maps(compute_views(s.rotations, s.moments))
    R = Rotation.from_rotvec(0.3 * rng.normal(size=3)).as_matrix()
    at = agreement.compute_scores(fits, R[None])
    slopes = at.slopes[0]

    def predicted(w: FloatArray) -> FloatArray:
        seen = fits.axes_y[:, :2] @ Rotation.from_rotvec(w).as_matrix() @ R @ np.swapaxes(fits.axes_x, 1, 2)
        return np.asarray((seen[:, :, :2] + seen[:, :, 2, None] * slopes[:, None]).reshape(-1, 4))

    e = 1e-6 * np.eye(3)
    numeric = np.stack([(predicted(d) - predicted(-d)) / 2e-6 for d in e], axis=-1)
    np.testing.assert_allclose(at.jacobian[0], numeric, atol=1e-8)


def test_thousands_of_cameras_take_linear_time() -> None:
    s = make_scene(50, 10.0, 0, make_rotated_calibration(180))

    def seconds(copies: int) -> float:
        rotations, moments = np.tile(s.rotations, (copies, 1, 1)), s.moments * copies
        start = time.process_time()
        diagnosis = diagnose_cameras(rotations, moments)
        assert len(fault_kinds(diagnosis)) in (0, copies)
        return time.process_time() - start

    seconds(1)
    assert seconds(40) < 80 * min(seconds(2) for _ in range(3))  # 20 times the cameras


def test_bad_input_is_refused() -> None:
    s = make_scene(3, 5.0, 0)
    with pytest.raises(ValueError, match="names: 2 for 3 cameras"):
        solve_robust(s.rotations, s.moments, names=["a", "b"])
    with pytest.raises(ValueError, match=r"rotations must be \(C, 3, 3\) for C = 2"):
        diagnose_cameras(s.rotations, s.moments[:2])
    with pytest.raises(ValueError, match="not a rotation matrix"):
        find_faulty_cameras(s.rotations, s.moments, 2 * np.eye(3))
    with pytest.raises(ValueError, match="spread"):
        solve_robust(s.rotations, [PairMoments.zero()] * 3)
