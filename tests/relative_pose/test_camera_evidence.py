"""Evidence of cameras for or against a joint motion: against an independent fit, for faults of all kinds, invariances."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.matrices import essential_matrix
from sylpose.matches import Matches
from sylpose.relative_pose.camera_evidence import (
    KEPT_SHARE,
    MAX_F_RATIO,
    CameraEvidence,
    _fit_motion,
    _sampson,
    compare_motions,
    compute_f_ratio,
    linearize_distances,
    transfer_motion,
)
from sylpose.relative_pose.solver import fit_terms
from sylpose.relative_pose.terms import TermData, locate_object
from sylpose.rig import Rig
from sylpose.simulate import arc, box, dome, ellipsoid, random_motion, simulate_matches

NOISE_PX = 0.3
Pair = tuple[Rig, tuple[Matches, ...], RigidTransform]


def make_pair(cameras: int, seed: int) -> Pair:
    rng = np.random.default_rng([cameras, seed])
    heights = rng.uniform(-0.6, 0.6, cameras)
    rig = arc(cameras, 35.0, 1.5, 1000.0, height=heights) if seed % 2 else dome(cameras, 1.5, 1000.0)
    motion = random_motion(rng.uniform(5.0, 12.0), rng.uniform(0.01, 0.04), rng)
    body = ellipsoid((0.15, 0.12, 0.1)) if seed % 3 else box((0.25, 0.2, 0.15))
    pair = simulate_matches(rig, body, motion, rng=rng, per_camera=80, noise_px=NOISE_PX)
    return rig, pair.matches, motion


def make_terms(rig: Rig, matches: Sequence[Matches]) -> list[TermData]:
    views = zip(rig, matches, strict=False)
    return [TermData(c, m.x, m.y, view.rotation, view.center, view.focal) for c, (view, m) in enumerate(views)]


def get_f_ratio(evidence: Sequence[CameraEvidence]) -> float:
    return compute_f_ratio(np.array([own.excess for own in evidence]))


def measure_evidence(
    term: TermData, center: FloatArray, rotation: FloatArray, translation: FloatArray
) -> CameraEvidence:
    """Return the evidence of a camera about the motion X -> R (X - center) + center + t."""
    moved = rotation @ (term.center - center) + center + translation - term.center
    shift = term.rotation @ moved / np.linalg.norm(term.center - center)
    return CameraEvidence(
        *compare_motions(term.x, term.y, term.focal, term.rotation @ rotation @ term.rotation.T, shift, 0.0)
    )


def evaluate(rig: Rig, matches: Sequence[Matches]) -> list[CameraEvidence]:
    """Return the evidence about the best joint motion."""
    terms = make_terms(rig, matches)
    center, radius = locate_object(terms)
    fit = fit_terms(terms, center, radius, [], np.random.default_rng(0))
    assert np.isfinite(fit.rotation).all()
    return [measure_evidence(term, center, fit.rotation, fit.translation) for term in terms]


def mirror(rig: Rig, matches: Sequence[Matches]) -> tuple[Rig, list[Matches]]:
    return rig, [Matches(m.x * [-1, 1], m.y * [-1, 1]) for m in matches]


def turn_upside_down(rig: Rig, matches: Sequence[Matches]) -> tuple[Rig, list[Matches]]:
    return rig, [Matches(-m.x, -m.y) for m in matches]


def exchange(rig: Rig, matches: Sequence[Matches]) -> tuple[Rig, list[Matches]]:
    return rig, [matches[1], matches[0], *matches[2:]]


def freeze_one(rig: Rig, matches: Sequence[Matches]) -> tuple[Rig, list[Matches]]:
    return rig, [Matches(matches[0].x, matches[0].x), *matches[1:]]


def mirror_one(rig: Rig, matches: Sequence[Matches]) -> tuple[Rig, list[Matches]]:
    return rig, [Matches(matches[0].x * [-1, 1], matches[0].y * [-1, 1]), *matches[1:]]


@pytest.mark.parametrize("cameras", [2, 3, 4])
def test_good_rigs_do_not_contradict_themselves(cameras: int) -> None:
    ratios = [get_f_ratio(evaluate(*make_pair(cameras, seed)[:2])) for seed in range(8)]
    assert np.median(ratios) < 1.0
    assert max(ratios) < 4.0


def test_clock_error_is_a_nuisance() -> None:
    """A camera that sees a fifth more of the motion contradicts it, unless its clock may be off by as much."""
    strict, lenient, late = list[float](), list[float](), list[float]()
    for seed in range(8):
        rng = np.random.default_rng(seed)
        rig, body = dome(2, 1.5, 1000.0), ellipsoid((0.15, 0.12, 0.1))
        rotvec, shift = rng.normal(size=3), rng.normal(size=3)
        rotvec, shift = 0.15 * rotvec / np.linalg.norm(rotvec), 0.02 * shift / np.linalg.norm(shift)

        def share(part: float, *, rotvec: FloatArray = rotvec, shift: FloatArray = shift) -> RigidTransform:
            return RigidTransform.from_components(part * shift, Rotation.from_rotvec(part * rotvec))

        for part, found in ((1.2, (strict, lenient)), (2.0, (late,))):
            matches = simulate_matches(rig, body, share(part), rng=rng, per_camera=80, noise_px=NOISE_PX).matches
            term, center = make_terms(rig, matches)[0], np.zeros(3)
            rotation, translation = transfer_motion(term, center, share(1.0).rotation.as_matrix(), shift)
            for values, sd in zip(found, (0.0, 0.2) if part == 1.2 else (0.2,), strict=True):
                values.append(compare_motions(term.x, term.y, term.focal, rotation, translation, sd)[3])
    assert np.median(strict) > 20.0
    assert np.median(lenient) < 5.0
    assert np.median(late) > 50.0


@pytest.mark.parametrize("count", [12, 20, 28])
def test_few_matches_are_evidence(count: int) -> None:
    """From twice as many as there are unknowns, they agree with the true motion, and contradict another one."""
    other = RigidTransform.from_rotation(Rotation.from_rotvec([0.1, 0.1, 0.1]))
    right, wrong = list[float](), list[float]()
    for seed in range(12):
        rig, matches, motion = make_pair(2, seed)
        terms = make_terms(rig, [Matches(m.x[:count], m.y[:count]) for m in matches])
        for tested, ratios in ((motion, right), (motion * other, wrong)):
            rotation = tested.rotation.as_matrix()
            found = [measure_evidence(term, np.zeros(3), rotation, tested.translation) for term in terms]
            assert any(own.n >= 10 for own in found)
            ratios.append(get_f_ratio(found))
    assert np.nanmedian(right) < 3.0
    assert np.nanmedian(wrong) > 30.0


@pytest.mark.parametrize("corrupt", [mirror, turn_upside_down, exchange])
def test_rigs_that_are_wrong_as_a_whole_contradict_themselves(
    corrupt: Callable[[Rig, Sequence[Matches]], tuple[Rig, list[Matches]]],
) -> None:
    ratios = []
    for seed in range(1, 81, 2):  # on an arc at different heights: no symmetry hides the fault
        rig, matches, _ = make_pair(4, seed)
        terms = make_terms(*corrupt(rig, matches))
        center, radius = locate_object(make_terms(rig, matches))
        fit = fit_terms(terms, center, radius, [], np.random.default_rng(0))
        evidence = [measure_evidence(term, center, fit.rotation, fit.translation) for term in terms]
        ratios.append(get_f_ratio(evidence))
    assert np.isnan(ratios).sum() <= 4  # no rigid motion is found, or hardly any camera has one
    assert np.nanmin(ratios) > 4.0
    assert np.nanmedian(ratios) > 20.0


@pytest.mark.parametrize("corrupt", [freeze_one, mirror_one])
def test_one_faulty_camera_has_most_excess(
    corrupt: Callable[[Rig, Sequence[Matches]], tuple[Rig, list[Matches]]],
) -> None:
    for seed in range(6):
        rig, matches, motion = make_pair(4, seed)
        terms = make_terms(*corrupt(rig, matches))
        center, _ = locate_object(make_terms(rig, matches))
        rotation, translation = motion.rotation.as_matrix(), motion.apply(center) - center
        evidence = [measure_evidence(term, center, rotation, translation) for term in terms]
        assert int(np.argmax([own.excess for own in evidence])) == 0
        # The others agree, whichever camera is wrong.
        assert get_f_ratio(evidence) < 20.0
        assert get_f_ratio(evidence[:2]) > MAX_F_RATIO


def test_own_fit_equals_an_independent_one() -> None:
    """SciPy's least squares over five unknowns of the essential matrix reaches the same residual."""
    rig, matches, motion = make_pair(2, 1)
    term = make_terms(rig, matches)[0]
    center = np.zeros(3)
    evidence = measure_evidence(term, center, motion.rotation.as_matrix(), motion.apply(center) - center)
    assert evidence.n == len(term)
    x, y = (np.column_stack([points, np.ones(len(points))]) for points in (term.x, term.y))
    own = rig.cameras[0].camera_from_world * motion * rig.cameras[0].camera_from_world.inv()

    def residuals(unknowns: FloatArray) -> FloatArray:
        rotation = Rotation.from_rotvec(unknowns[:3]) * own.rotation
        essential = essential_matrix(rotation.as_matrix(), unknowns[3:])
        left, right = x @ essential.T, y @ essential
        value = np.einsum("ni,ni->n", y, left)
        return np.asarray(
            term.focal * value / np.sqrt((left[:, :2] ** 2).sum(axis=1) + (right[:, :2] ** 2).sum(axis=1))
        )

    start = np.concatenate([np.zeros(3), own.translation / np.linalg.norm(own.translation)])
    found = least_squares(residuals, start, x_scale=[0.01] * 3 + [1.0] * 3, xtol=1e-12, ftol=1e-12)
    expected = np.sqrt((found.fun**2).sum() / (len(term) - 5))
    assert evidence.own_px == pytest.approx(expected, rel=1e-3)
    assert evidence.own_px == pytest.approx(NOISE_PX, rel=0.3)
    # Of nine in ten matches, those that the joint motion explains best.
    kept = np.sort(np.abs(residuals(start)))[: int(KEPT_SHARE * (len(term) - 1)) + 1]
    assert evidence.joint_px == pytest.approx(np.sqrt(np.mean(kept**2)), rel=1e-6)


def test_exact_matches_have_no_excess() -> None:
    rig, _, motion = make_pair(3, 2)
    pair = simulate_matches(rig, box((0.25, 0.2, 0.15)), motion, rng=np.random.default_rng(0), noise_px=0.0)
    for term in make_terms(rig, pair.matches):
        evidence = measure_evidence(term, np.zeros(3), motion.rotation.as_matrix(), motion.translation)
        assert evidence.n == len(term)
        assert evidence.joint_px < 1e-6
        assert evidence.excess < 1e-6


def test_derivatives_equal_differences() -> None:
    rng = np.random.default_rng(3)
    x, y, rotation = (
        rng.uniform(-0.2, 0.2, (1, 2)),
        rng.uniform(-0.2, 0.2, (1, 2)),
        Rotation.random(rng=rng).as_matrix(),
    )
    essential, changes = essential_matrix(rotation, rng.standard_normal(3)), rng.standard_normal((4, 9))
    distances, slopes = linearize_distances(x, y, np.ones(1), essential, changes)
    assert distances[0] == pytest.approx(_sampson(x, y, 0, essential), rel=1e-12)
    step = 1e-6
    for k, change in enumerate(changes):
        values = [_sampson(x, y, 0, essential + s * step * change.reshape(3, 3)) for s in (1, -1)]
        assert slopes[0, k] == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-6)


def test_fit_reaches_the_minimum_from_another_motion() -> None:
    rig, matches, motion = make_pair(2, 5)
    own = rig.cameras[0].camera_from_world * motion * rig.cameras[0].camera_from_world.inv()
    results = []
    for turn in (0.0, 0.05):
        rotation = (Rotation.from_rotvec([0.0, 0.0, turn]) * own.rotation).as_matrix()
        translation, damping = own.translation.copy(), 1e-3
        for _ in range(40):
            x, y = matches[0].x, matches[0].y
            damping, _ = _fit_motion(x, y, np.ones(len(x)), rotation, translation, damping)
        results.append((rotation, translation * np.sign(translation @ own.translation)))
    np.testing.assert_allclose(results[0][0], results[1][0], atol=1e-3)


@given(st.integers(0, 2**16))
def test_evidence_does_not_depend_on_world_or_unit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig, matches, motion = make_pair(3, seed % 6)
    scale, turn, shift = float(rng.uniform(0.01, 100.0)), Rotation.random(rng=rng), rng.standard_normal(3)
    term = make_terms(rig, matches)[1]
    first = measure_evidence(term, np.zeros(3), motion.rotation.as_matrix(), motion.translation)
    other = replace(
        term, rotation=term.rotation @ turn.as_matrix().T, center=scale * turn.apply(term.center.copy()) + shift
    )
    rotation = (turn * motion.rotation * turn.inv()).as_matrix()
    second = measure_evidence(other, shift, rotation, scale * turn.apply(motion.translation))
    np.testing.assert_allclose(astuple(second), astuple(first), rtol=1e-6, atol=1e-9)


def test_matches_of_another_body_are_no_contradiction() -> None:
    """The object has fewer matches than the other body; the joint motion is the object's."""
    rng = np.random.default_rng(0)
    rig, matches, motion = make_pair(3, 0)
    other = simulate_matches(rig, ellipsoid((0.15, 0.12, 0.1)), random_motion(9.0, 0.05, rng), rng=rng, per_camera=120)
    both = [
        Matches(np.vstack([one.x, two.x]), np.vstack([one.y, two.y]))
        for one, two in zip(matches, other.matches, strict=True)
    ]
    evidence = [
        measure_evidence(term, np.zeros(3), motion.rotation.as_matrix(), motion.translation)
        for term in make_terms(rig, both)
    ]
    assert all(own.n < 100 for own in evidence)
    assert get_f_ratio(evidence) < 20.0


def test_evidence_needs_matches_and_cameras() -> None:
    rig, matches, motion = make_pair(2, 1)
    few = Matches(matches[0].x[:9], matches[0].y[:9])
    nothing = measure_evidence(make_terms(rig, [few])[0], np.zeros(3), motion.rotation.as_matrix(), motion.translation)
    assert nothing.n == 0
    # No motion has no epipolar geometry: every match would fit.
    assert measure_evidence(make_terms(rig, matches)[0], np.zeros(3), np.eye(3), np.zeros(3)).n == 0
    assert np.isnan(get_f_ratio([nothing, CameraEvidence(20, 0.3, 0.4, 12.0)]))
    assert np.isnan(get_f_ratio([]))
    # Two cameras have four constraints, three have nine; of three the worst does not count, unless three are to remain.
    two = [CameraEvidence(20, 0.3, 0.4, 12.0), CameraEvidence(20, 0.3, 0.4, 8.0)]
    assert get_f_ratio([*two, nothing]) == pytest.approx(20.0 / 4.0)
    assert get_f_ratio(two) == pytest.approx(20.0 / 4.0)
    worst = CameraEvidence(20, 0.3, 9.0, 1e6)
    assert get_f_ratio([*two, worst]) == pytest.approx(20.0 / 4.0)
    excess = np.array([12.0, 8.0, 1e6])
    assert compute_f_ratio(excess, 3) > 1e5
    assert compute_f_ratio(np.append(excess, 12.0), 3) == pytest.approx(32.0 / 9.0)


def test_own_motion_is_not_trimmed_to_a_few_matches() -> None:
    """It explains nearly all matches of a camera that sees one motion, and the noise about it is theirs."""
    for seed in range(40):
        rig, matches, motion = make_pair(4, seed)
        for term in make_terms(rig, matches):
            own = measure_evidence(term, np.zeros(3), motion.rotation.as_matrix(), motion.translation)
            assert own.n > 0.8 * len(term)
            assert 0.5 * NOISE_PX < own.own_px < 2.0 * NOISE_PX


@pytest.mark.parametrize("share", [0.4, 0.45])
def test_another_body_with_more_matches_is_no_contradiction(share: float) -> None:
    excess = []
    for seed in range(12):
        rig, matches, motion = make_pair(2, seed)
        _, others, _ = make_pair(2, seed + 100)
        for term, other in zip(make_terms(rig, matches), make_terms(rig, others), strict=True):
            n = round(len(term) * share / (1.0 - share))
            mixed = replace(term, x=np.vstack([term.x[:n], other.x]), y=np.vstack([term.y[:n], other.y]))
            found = measure_evidence(mixed, np.zeros(3), motion.rotation.as_matrix(), motion.translation)
            excess.append(found.excess)
    assert np.mean(np.array(excess) > 20.0) <= 0.1
