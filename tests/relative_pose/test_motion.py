"""`estimate_motion`: exact, robust, and correct about unobservable motions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import simulate
from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import invert_information
from sylpose.matches import Matches
from sylpose.moments import PairMoments
from sylpose.relative_pose.motion import estimate_motion, estimate_motions
from sylpose.results import Motion
from sylpose.rig import Camera, Rig
from sylpose.status import Status
from sylpose.sylvester.centralized import solve_centralized
from tests.scenes import compute_motion_error, compute_nees

BODY = simulate.ellipsoid((0.15, 0.12, 0.10))


def make_rig(n: int) -> Rig:
    """Return n cameras around the object, not in one plane, none opposite another."""
    if n < 4:
        return simulate.arc(n, 50.0, height=0.3)
    return simulate.dome(n)


def compute_errors(motion: Motion, truth: RigidTransform, center: FloatArray) -> tuple[float, float]:
    """Return the errors in degrees, and in millimeters at the object's center."""
    assert motion.motion is not None
    turn = np.degrees((truth.rotation.inv() * motion.motion.rotation).magnitude())
    return float(turn), 1e3 * float(np.linalg.norm(motion.motion.apply(center) - truth.apply(center)))


def make_pair(rig: Rig, seed: int, turn: float = 5.0, **options: Any) -> simulate.SimulatedPair:
    rng = np.random.default_rng(seed)
    motion = simulate.random_motion(turn, 0.02, rng)
    return simulate.simulate_matches(rig, BODY, motion, rng=rng, **options)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), cameras=st.sampled_from([3, 4, 6]), turn=st.floats(1.0, 30.0))
def test_exact_without_noise(seed: int, cameras: int, turn: float) -> None:
    rig = make_rig(cameras)
    pair = make_pair(rig, seed, turn, noise_px=0.0)
    degrees, mm = compute_errors(estimate_motion(rig, pair.matches), pair.motion, pair.center)
    # Not zero: the prior depth is wrong by the distance of the surface from the center. Noise of 0.5 px would cause ten
    # times as much and more.
    assert degrees < 0.03
    assert mm < 0.3


@pytest.mark.parametrize(
    ("cameras", "options", "degrees", "mm"),
    [
        (2, {}, 0.6, 4.0),
        (4, {}, 0.3, 1.5),
        (8, {}, 0.25, 1.0),
        (4, {"outliers": 0.3}, 0.35, 2.0),
        (4, {"outliers": 0.3, "outlier_kind": "static"}, 0.35, 2.0),
        (4, {"outliers": 0.5, "outlier_kind": "static"}, 0.45, 2.5),
        (4, {"outliers": 0.3, "outlier_kind": "second_motion"}, 0.45, 2.5),
        (4, {"junk": ("cam_1",)}, 0.4, 2.5),
        (4, {"per_camera": {"cam_2": 0}}, 0.4, 2.5),
    ],
)
def test_median_error(cameras: int, options: dict[str, Any], degrees: float, mm: float) -> None:
    rig = make_rig(cameras)
    found = []
    for seed in range(9):
        pair = make_pair(rig, seed, **options)
        motion = estimate_motion(rig, pair.matches)
        found.append(compute_errors(motion, pair.motion, pair.center) if motion.motion is not None else (180.0, 1e3))
    assert np.median(found, axis=0)[0] < degrees
    assert np.median(found, axis=0)[1] < mm


def test_inliers_are_correct() -> None:
    rig = make_rig(4)
    pair = make_pair(rig, 3, outliers=0.3)
    motion = estimate_motion(rig, pair.matches)
    for mask, wrong in zip(motion.inliers, pair.is_outlier, strict=True):
        assert mask[~wrong].mean() > 0.85
        assert mask[wrong].mean() < 0.3
    assert (motion.residuals < 1.5).all()


@pytest.mark.parametrize(
    ("rig", "turn", "options", "least"),
    [
        (make_rig(4), 5.0, {}, (4.0, 3.5)),
        pytest.param(make_rig(8), 10.0, {"noise_px": 1.0, "per_camera": 20}, (4.0, 3.5), marks=pytest.mark.slow),
        # The depth prior allows for more than an ellipsoid, and two cameras constrain depth least.
        (simulate.arc(2, 40, height=[0.3, -0.3]), 5.0, {}, (3.0, 2.5)),
        pytest.param(make_rig(4), 1.0, {"noise_px": 0.25}, (4.0, 3.5), marks=pytest.mark.slow),
        (make_rig(4), 5.0, {"outliers": 0.3}, (4.0, 3.5)),
    ],
    ids=["dome of 4", "dome of 8, 1 px", "two cameras", "turn of 1 degree", "outliers"],
)
def test_covariance_matches_the_errors(
    rig: Rig, turn: float, options: dict[str, Any], least: tuple[float, float]
) -> None:
    """Normalized squared errors: six on average (benchmarks/uncertainty.py has the larger study)."""
    squared = []
    for seed in range(60):
        pair = make_pair(rig, seed, turn, **options)
        motion = estimate_motion(rig, pair.matches)
        # With two cameras, a rotation about the line between their rays hardly determines the scale.
        assert motion.status in (Status.OK, Status.SCALE_NOT_OBSERVABLE), seed
        squared.append(compute_nees(compute_motion_error(pair, motion), motion))
    assert least[0] < np.mean(squared) < 9.0
    assert least[1] < np.median(squared) < 8.0  # the median of chi-squared with 6 degrees of freedom is 5.3


def test_motion_is_equivariant_to_the_world_frame() -> None:
    rig = make_rig(4)
    pair = make_pair(rig, 1)
    new_from_old = RigidTransform.from_components([0.3, -1.0, 2.0], Rotation.from_rotvec([0.4, -1.1, 0.7]))
    moved = Rig([Camera(c.name, c.size, c.matrix, c.distortion, c.camera_from_world * new_from_old.inv()) for c in rig])
    here, there = estimate_motion(rig, pair.matches).motion, estimate_motion(moved, pair.matches).motion
    assert here is not None
    assert there is not None
    back = new_from_old.inv() * there * new_from_old
    np.testing.assert_allclose(back.as_matrix(), here.as_matrix(), atol=2e-4)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_motion_is_equivariant_to_the_length_unit(scale: float) -> None:
    rig = make_rig(4)
    pair = make_pair(rig, 1, outliers=0.2)
    poses = [c.camera_from_world for c in rig]
    scaled = [RigidTransform.from_components(scale * p.translation, p.rotation) for p in poses]
    other = Rig([Camera(c.name, c.size, c.matrix, c.distortion, p) for c, p in zip(rig, scaled, strict=True)])
    here, there = estimate_motion(rig, pair.matches), estimate_motion(other, pair.matches)
    assert here.motion is not None
    assert there.motion is not None
    np.testing.assert_allclose(there.motion.rotation.as_matrix(), here.motion.rotation.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(there.motion.translation / scale, here.motion.translation, atol=1e-6)
    units = np.array([1.0] * 3 + [scale] * 3)
    np.testing.assert_allclose(there.covariance / np.outer(units, units), here.covariance, rtol=1e-3, atol=1e-12)


def test_motion_is_invariant_to_camera_order() -> None:
    rig = make_rig(5)
    pair = make_pair(rig, 1, outliers=0.2)
    order = [3, 0, 4, 2, 1]
    other = Rig([rig.cameras[k] for k in order])
    here, there = estimate_motion(rig, pair.matches), estimate_motion(other, [pair.matches[k] for k in order])
    assert here.motion is not None
    assert there.motion is not None
    np.testing.assert_allclose(there.motion.as_matrix(), here.motion.as_matrix(), atol=5e-4)
    assert [there.n_inliers[order.index(k)] for k in range(5)] == pytest.approx(here.n_inliers, abs=1)


def test_swapped_frames_give_the_inverse() -> None:
    rig = make_rig(4)
    pair = make_pair(rig, 2)
    forth = estimate_motion(rig, pair.matches).motion
    back = estimate_motion(rig, [Matches(m.y, m.x) for m in pair.matches]).motion
    assert forth is not None
    assert back is not None
    np.testing.assert_allclose((forth * back).as_matrix(), np.eye(4), atol=2e-3)


def test_result_is_deterministic() -> None:
    rig = make_rig(4)
    pair = make_pair(rig, 5, outliers=0.3)
    a, b = (estimate_motion(rig, pair.matches, seed=7).motion for _ in range(2))
    assert a is not None
    assert b is not None
    np.testing.assert_array_equal(a.as_matrix(), b.as_matrix())


# --- unobservable motions ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 3, 7])
def test_too_few_matches(n: int) -> None:
    rig = make_rig(4)
    pair = make_pair(rig, 0)
    few = [Matches(m.x[:n], m.y[:n]) if c == 0 else Matches.empty() for c, m in enumerate(pair.matches)]
    motion = estimate_motion(rig, few)
    assert motion.status is Status.TOO_FEW_MATCHES
    assert motion.motion is None


def test_no_motion() -> None:
    rig = make_rig(4)
    rng = np.random.default_rng(0)
    pair = simulate.simulate_matches(rig, BODY, RigidTransform.identity(), rng=rng, noise_px=0.2)
    motion = estimate_motion(rig, pair.matches)
    assert motion.status is Status.NO_MOTION
    assert motion.motion is not None
    np.testing.assert_array_equal(motion.motion.as_matrix(), np.eye(4))


def test_invalid_input_is_rejected() -> None:
    rig = make_rig(3)
    good = [Matches.empty()] * 3
    with pytest.raises(ValueError, match="matches: 2 for 3 cameras"):
        estimate_motion(rig, good[:2])
    with pytest.raises(ValueError, match="'magic' is not one of"):
        estimate_motion(rig, good, method="magic")
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="not finite"):
            Matches(np.array([[bad, 0.0]]), np.zeros((1, 2)))


def test_covariance_without_information_is_infinite() -> None:
    covariance = invert_information(np.diag([4.0, 4.0, 4.0, 1.0, 1.0, 0.0]))
    np.testing.assert_allclose(np.diag(covariance), [0.25, 0.25, 0.25, 1.0, 1.0, np.inf])


# --- the paper's estimators -------------------------------------------------------------------------------------------


def test_rotation_translation_and_inlier_ratio_of_a_result() -> None:
    """The translation is that of the center, to which the covariance refers."""
    rig, rng = simulate.ring(4), np.random.default_rng(0)
    pair = simulate.simulate_matches(
        rig, simulate.ellipsoid((0.15, 0.12, 0.1)), simulate.random_motion(6.0, 0.03, rng), rng=rng, outliers=0.25
    )
    found = estimate_motion(rig, pair.matches)
    assert found.motion is not None
    assert found.rotation is not None
    assert found.translation is not None
    np.testing.assert_array_equal(found.rotation.as_matrix(), found.motion.rotation.as_matrix())
    expected = pair.motion.apply(found.center) - found.center
    sigma = np.sqrt(np.diag(found.covariance)[3:])
    assert np.all(np.abs(found.translation - expected) < 5 * sigma + 1e-4)
    assert found.inlier_ratio == pytest.approx(0.75, abs=0.05)
    nothing = estimate_motion(rig, [Matches.empty()] * 4)
    assert (nothing.rotation, nothing.translation) == (None, None)
    assert np.isnan(nothing.inlier_ratio)


def test_sylvester_is_the_centralized_solution_of_the_inliers() -> None:
    rig = make_rig(6)
    pair = make_pair(rig, 1, turn=4.0)
    robust, paper = estimate_motion(rig, pair.matches), estimate_motion(rig, pair.matches, method="sylvester")
    assert paper.motion is not None
    assert paper.method == "sylvester"
    moments = [PairMoments.from_matches(m.x[i], m.y[i]) for m, i in zip(pair.matches, robust.inliers, strict=True)]
    direct = solve_centralized(np.array([c.rotation for c in rig]), moments)
    between = Rotation.from_matrix(direct.rotation).inv() * paper.motion.rotation
    assert np.degrees(between.magnitude()) < 0.2  # only the fit weights the inliers
    assert compute_errors(paper, pair.motion, pair.center)[0] < 2.0


# --- many pairs -------------------------------------------------------------------------------------------------------


def test_many_pairs_equal_single_pairs() -> None:
    rig = make_rig(4)
    pairs = [make_pair(rig, seed, outliers=0.2).matches for seed in range(4)]
    alone = [estimate_motion(rig, matches) for matches in pairs]
    for threads in (1, 2):
        for one, found in zip(alone, estimate_motions(rig, pairs, threads=threads), strict=True):
            assert one.motion is not None
            assert found.motion is not None
            np.testing.assert_array_equal(found.motion.as_matrix(), one.motion.as_matrix())
            np.testing.assert_array_equal(found.covariance, one.covariance)
    with pytest.raises(ValueError, match="threads: 0"):
        estimate_motions(rig, pairs, threads=0)
