"""Interleaved bodies, and few matches that agree by chance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import Matches, Motion, Rig, Status, estimate_motion
from sylpose.geometry.numba_linalg import apply_rotvec
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.relative_pose import robust_fit
from sylpose.relative_pose.irls import IrlsFit, make_empty_irls_fit, make_irls_start, run_irls
from sylpose.relative_pose.limits import SIGMA_FLOOR_PX
from sylpose.relative_pose.motion_mixture import (
    MAX_DEPENDENCE,
    N_PRODUCTS,
    _linearize_inliers,
    divide_inliers,
    fit_motion_mixture,
    measure_dependence,
)
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.terms import Candidate, Stack, TermData, locate_object, stack_terms
from sylpose.simulate import SimulatedPair, arc, dome, ellipsoid, random_motion, simulate_matches

NOISE_PX = 0.5


def draw_motions(seed: int) -> tuple[RigidTransform, RigidTransform]:
    """Draw the motions of the two bodies of `make_pair`."""
    rng = np.random.default_rng([seed, 1])
    first, second = (random_motion(float(rng.uniform(4, 10)), 0.02, rng) for _ in range(2))
    return first, second


def make_pair(
    seed: int, *, cameras: int = 3, second_share: float = 0.0, matches: int = 60
) -> tuple[Rig, SimulatedPair]:
    """Make matches of a body, a share of them of a copy of it that moves differently."""
    rng = np.random.default_rng(seed)
    rig = arc(2, 70.0, 1.5, 1000.0, height=[0.4, -0.3]) if cameras == 2 else dome(cameras, 1.5, 1000.0)
    first, second = draw_motions(seed)
    pair = simulate_matches(
        rig,
        ellipsoid((0.15, 0.12, 0.1)),
        first,
        rng=rng,
        per_camera=matches,
        noise_px=NOISE_PX,
        outliers=second_share,
        outlier_kind=second,
    )
    return rig, pair


def make_terms(rig: Rig, matches: tuple[Matches, ...]) -> list[TermData]:
    views = enumerate(zip(rig, matches, strict=True))
    return [TermData(c, m.x, m.y, camera.rotation, camera.center, camera.focal) for c, (camera, m) in views]


def fit_all(rig: Rig, matches: tuple[Matches, ...], motion: RigidTransform) -> tuple[Stack, IrlsFit]:
    """Fit one motion to the matches, beginning with a known one."""
    data = [
        TermData(c, m.x, m.y, k.rotation, k.center, k.focal) for c, (k, m) in enumerate(zip(rig, matches, strict=True))
    ]
    center, radius = locate_object(data)
    stack = stack_terms(data, center, radius, 0.0)
    start = Candidate(motion.rotation.as_matrix(), motion.apply(center) - center, stack.depth_model_mean)
    fit = make_irls_start(stack, start, np.full(len(data), NOISE_PX))
    run_irls(stack, np.ones(len(stack.x)), fit, SIGMA_FLOOR_PX)
    return stack, fit


def estimate_single(rig: Rig, matches: tuple[Matches, ...]) -> RigidTransform:
    """Estimate a single motion of all matches, whatever they belong to."""
    data = make_terms(rig, matches)
    center, radius = locate_object(data)
    fit = fit_terms(data, center, radius, [], np.random.default_rng(0))
    shift = RigidTransform.from_translation(fit.translation + center)
    return (
        shift
        * RigidTransform.from_rotation(Rotation.from_matrix(fit.rotation))
        * RigidTransform.from_translation(-center)
    )


def is_wrong(found: Motion, motion: RigidTransform) -> bool:
    """Return whether a rotation is off by more than three degrees, and sure of it: less than once in a million times."""
    assert found.motion is not None
    error = (motion.rotation * found.motion.rotation.inv()).as_rotvec()
    square = float(error @ np.linalg.inv(found.covariance[:3, :3]) @ error)
    return bool(np.rad2deg(np.linalg.norm(error)) > 3.0) and square > chi_squared_bound(3, 1e-6)


def test_derivatives_equal_finite_differences() -> None:
    rig, pair = make_pair(0)
    stack, fit = fit_all(rig, pair.matches, pair.motion)
    residuals, slopes = _linearize_inliers(stack, fit)
    h, numerical = 1e-6, np.empty_like(slopes)
    for k in range(6):
        ends = []
        for side in (-1.0, 1.0):
            step = np.zeros(6)
            step[k] = side * h
            moved = make_empty_irls_fit(stack)
            apply_rotvec(step[:3], fit.candidate.rotation, moved.candidate.rotation)
            moved.candidate.translation[:] = fit.candidate.translation + step[3:]
            moved.weights[:] = fit.weights
            end, _ = _linearize_inliers(stack, moved)
            ends.append(end)
        numerical[:, k] = (ends[1] - ends[0]) / (2.0 * h)
    # The units change with the motion as well: compare what is perpendicular to the residuals in each term.
    for first, last in zip(stack.offsets, stack.offsets[1:], strict=False):
        r = residuals[first:last, None]
        difference = numerical[first:last] - slopes[first:last]
        difference -= r * (r.T @ difference) / (r.T @ r)
        assert np.abs(difference).max() < 1e-4 * np.abs(slopes[first:last]).max()


def test_residuals_of_one_body_do_not_depend_on_the_motion() -> None:
    """White's test is chi-squared with as many degrees of freedom as there are products."""
    values = []
    for seed in range(60):
        rig, pair = make_pair(seed)
        values.append(measure_dependence(*fit_all(rig, pair.matches, pair.motion)))
    assert N_PRODUCTS - 6 < np.mean(values) < N_PRODUCTS + 6
    assert np.mean(np.array(values) > MAX_DEPENDENCE) < 0.07
    assert max(values) < chi_squared_bound(N_PRODUCTS, 1e-5)


def test_divisions_lead_to_both_motions() -> None:
    """Where one motion between two bodies fits nearly all matches, one of its divisions leads to the bodies' motions."""
    found = []
    for seed in range(40):
        rig, pair = make_pair(seed, cameras=2, second_share=0.5)
        stack, fit = fit_all(rig, pair.matches, estimate_single(rig, pair.matches))
        if not (measure_dependence(stack, fit) > MAX_DEPENDENCE and np.mean(fit.weights > 0.0) > 0.9):
            continue
        motion, parts = (fit.candidate.rotation, fit.candidate.translation), divide_inliers(stack, fit)
        assert all((a ^ b)[fit.weights > 0.0].all() for a, b in parts)
        mixture = min((fit_motion_mixture(stack, (motion, motion), part) for part in parts), key=lambda m: m.cost)
        rotations = [Rotation.from_matrix(single.candidate.rotation) for single in mixture.fits]
        errors = [min((r * m.rotation.inv()).magnitude() for r in rotations) for m in draw_motions(seed)]
        found.append(np.rad2deg(max(errors)) < 2.0)
    assert len(found) >= 5
    assert np.mean(found) >= 0.7


@pytest.mark.parametrize(("cameras", "share"), [(2, 0.4), (3, 0.4), (3, 0.6), (4, 0.25)])
def test_interleaved_bodies_are_separated(cameras: int, share: float) -> None:
    """The result is the motion of one of the bodies, or none."""
    right = 0
    for seed in range(12):
        rig, pair = make_pair(100 + seed, cameras=cameras, second_share=share)
        found = estimate_motion(rig, pair.matches)
        if found.status is not Status.OK or found.motion is None:
            continue
        motions = draw_motions(100 + seed)
        assert not all(is_wrong(found, motion) for motion in motions), seed
        right += 1
        if share > 0.5:
            assert not is_wrong(found, motions[1]), "the larger body"
    assert right >= 6


def test_cameras_that_count_rows_upwards_see_no_second_body() -> None:
    for seed in range(8):
        rig, pair = make_pair(seed)
        matches = tuple(Matches(m.x * [1.0, -1.0], m.y * [1.0, -1.0]) for m in pair.matches)
        found = estimate_motion(rig, matches)
        assert found.status is not Status.OK
        assert found.second_body_ratio == 0.0


def test_few_mismatches_are_no_motion() -> None:
    for seed in range(40):
        rig, pair = make_pair(seed, matches=4)
        rng = np.random.default_rng(seed)
        wrong = [Matches(m.x, m.y[::-1] + 0.02 * rng.standard_normal(m.y.shape)) for m in pair.matches]
        assert estimate_motion(rig, wrong).status is not Status.OK, seed


def test_few_right_matches_are_no_chance() -> None:
    """Fifteen right matches agree better than fits to permuted ones."""
    agree = []
    for seed in range(20):
        rig, pair = make_pair(seed, matches=5)
        agree.append(estimate_motion(rig, pair.matches).status is not Status.NOT_CONSISTENT)
    assert np.mean(agree) >= 0.95


def test_half_of_many_matches_is_no_chance(monkeypatch: pytest.MonkeyPatch) -> None:
    """The choice of the inliers takes far less to describe than they gain: no fit to permuted matches is needed."""
    searches = list[int]()
    monkeypatch.setattr(robust_fit, "draw_and_fit", lambda stack, *_: searches.append(len(stack.x)))
    for seed in range(20):
        rig, pair = make_pair(seed, matches=60)
        rng = np.random.default_rng(seed)
        is_wrong = [rng.random(len(m.x)) < 0.5 for m in pair.matches]
        mixed = [
            Matches(m.x, np.where(wrong[:, None], rng.permutation(m.y), m.y))
            for m, wrong in zip(pair.matches, is_wrong, strict=True)
        ]
        assert estimate_motion(rig, mixed).status.has_pose
    assert not searches


def test_chance_of_mismatches() -> None:
    """Their likeliest fits are never certain, at any number of matches; then permuted matches decide."""
    for seed, per_camera in enumerate((6, 12, 40, 150) * 5):
        rig, pair = make_pair(seed, matches=per_camera)
        rng = np.random.default_rng(seed)
        wrong = [Matches(m.x, rng.permutation(m.y)) for m in pair.matches]
        assert estimate_motion(rig, wrong).status is Status.NOT_CONSISTENT, (seed, per_camera)


@pytest.mark.parametrize(("cameras", "per_camera"), [(12, 2), (8, 3)])
def test_few_matches_of_many_cameras_are_no_chance(cameras: int, per_camera: int) -> None:
    """One or two matches of a camera cannot be permuted."""
    statuses = [
        estimate_motion(rig, pair.matches).status
        for rig, pair in (make_pair(seed, cameras=cameras, matches=per_camera) for seed in range(8))
    ]
    assert statuses.count(Status.OK) >= 7
