"""Re-weighted fit of one motion: correct inliers, correct noise, exclusion of faulty cameras."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.relative_pose.affine_ransac import SEED_THRESHOLD_PX
from sylpose.relative_pose.irls import IrlsFit, _measure_complexity, make_irls_start, run_irls
from sylpose.relative_pose.limits import MAX_SIGMA_GROWTH, SIGMA_FLOOR_PX
from sylpose.relative_pose.planes import fit_edge_on, is_flat
from sylpose.relative_pose.robust_fit import draw_and_fit
from sylpose.relative_pose.terms import Stack, locate_object, stack_initial_motions, stack_terms
from sylpose.rig import Rig
from sylpose.simulate import SimulatedPair, arc, random_motion, simulate_matches
from tests.scenes import BODY, compute_angle_degrees, compute_epipolar_px, get_true_motion, make_terms, make_zigzag_rig


class RobustResult(NamedTuple):
    """Result of `fit_robust_motion`."""

    fit: IrlsFit
    iterations: int
    predicted_decrease: float

    @property
    def rotation(self) -> FloatArray:
        return self.fit.candidate.rotation

    @property
    def translation(self) -> FloatArray:
        return self.fit.candidate.translation


def fit_stack(stack: Stack, usable: BoolArray | None = None, seed: int = 0) -> RobustResult:
    """Fit without additional initial motions."""
    all_usable = np.ones(len(stack.x), dtype=bool) if usable is None else usable
    fit, _, iterations, decrease, _ = draw_and_fit(
        stack, all_usable, stack_initial_motions([]), np.random.default_rng(seed)
    )
    return RobustResult(fit, iterations, decrease)


def make_scene(seed: int, rig: Rig, turn: float = 5.0, **options: object) -> tuple[SimulatedPair, Stack, FloatArray]:
    """Return matches, their stacked terms, and the object's center."""
    rng = np.random.default_rng(seed)
    pair = simulate_matches(rig, BODY, random_motion(turn, 0.02, rng), rng=rng, **options)  # type: ignore[arg-type]
    data = make_terms(rig, pair.matches)
    center, radius = locate_object(data)
    return pair, stack_terms(data, center, radius), center


def split_by_term(stack: Stack, values: FloatArray) -> list[FloatArray]:
    return np.split(values, stack.offsets[1:-1])


@pytest.mark.parametrize(
    ("kind", "share"),
    [*(("uniform", share) for share in (0.1, 0.3, 0.5)), *(("second_motion", share) for share in (0.1, 0.3, 0.4))],
)
def test_inliers_are_correct(kind: str, share: float) -> None:
    """Static matches are separated before (`sylpose.relative_pose.solver`)."""
    rig, kept, caught = make_zigzag_rig(4), [], []
    for seed in range(5):
        pair, stack, center = make_scene(seed, rig, 8.0, per_camera=100, outliers=share, outlier_kind=kind)
        data = make_terms(rig, pair.matches)
        for term, w, wrong in zip(
            data, split_by_term(stack, fit_stack(stack).fit.weights), pair.is_outlier, strict=True
        ):
            # A mismatch that the true motion explains cannot be detected, nor does it bias the fit.
            far = np.abs(compute_epipolar_px(term, center, *get_true_motion(pair, center))) > 4
            kept += list(w[~wrong] > 0)
            caught += list(w[wrong & far] == 0)
    assert np.mean(kept) > 0.98
    # A second motion with nearly half of a camera's matches raises that camera's noise.
    assert np.mean(caught) > (0.95 if kind == "second_motion" else 0.98)


def test_steep_planes_count_in_the_search_only_if_the_object_is_flat() -> None:
    """Otherwise they explain some matches of a second body."""
    rig, gains = make_zigzag_rig(4), []
    for seed in (1, 2):
        _, stack, _ = make_scene(seed, rig, 8.0, per_camera=100, outliers=0.4, outlier_kind="second_motion")
        usable, found = np.ones(len(stack.x)), fit_stack(stack).fit
        prior = found.candidate._replace(depth_model=stack.depth_model_mean)
        plain, strict, free = (make_irls_start(stack, prior, found.sigma_px) for _ in range(3))
        _, _, cost = run_irls(stack, usable, plain, SIGMA_FLOOR_PX)
        assert fit_edge_on(stack, usable, strict, True)[2] == cost
        assert not is_flat(stack, strict)
        gains.append(cost - fit_edge_on(stack, usable, free, False)[2])
    assert min(gains) > 0.01


@pytest.mark.parametrize("outliers", [0.0, 0.3])
@pytest.mark.parametrize("noise_px", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("rig", [make_zigzag_rig(4), arc(2, 40)], ids=["around4", "arc2"])
def test_noise_is_estimated(rig: Rig, noise_px: float, outliers: float) -> None:
    ratios = []
    for seed in range(6):
        _, stack, _ = make_scene(seed, rig, per_camera=100, noise_px=noise_px, outliers=outliers)
        ratios.append(fit_stack(stack).fit.sigma_px / noise_px)
    assert 0.85 < np.mean(ratios) < 1.15
    assert np.max(np.abs(np.mean(ratios, axis=1) - 1)) < 0.3  # in each scene


def test_noisier_camera_has_larger_sigma() -> None:
    rig = make_zigzag_rig(4)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        motion = random_motion(5, 0.02, rng)
        pairs = [simulate_matches(rig, BODY, motion, rng=np.random.default_rng(seed), noise_px=s) for s in (0.3, 1.5)]
        matches = [*pairs[0].matches[:3], pairs[1].matches[3]]
        data = make_terms(rig, matches)
        sigma = fit_stack(stack_terms(data, *locate_object(data))).fit.sigma_px
        # Underestimated: each σ is shrunk towards the rig's, and none exceeds `MAX_SIGMA_GROWTH` times the seeds'.
        assert sigma[3] > 2.0 * sigma[:3].max()


def test_residuals_are_in_pixels() -> None:
    _, stack, _ = make_scene(0, make_zigzag_rig(4), per_camera=300)
    found = fit_stack(stack)
    assert np.std(found.fit.residuals_px[found.fit.weights > 0]) == pytest.approx(0.5, rel=0.1)


def test_junk_camera_is_excluded() -> None:
    rig = make_zigzag_rig(4)
    for seed in range(8):
        pair, stack, center = make_scene(seed, rig, junk=("cam_1",))
        found = fit_stack(stack)
        agree = [np.mean(w > 0) for w in split_by_term(stack, found.fit.weights)]
        assert agree[1] < 0.15
        assert min(agree[0], agree[2], agree[3]) > 0.9
        rotation, translation = get_true_motion(pair, center)
        assert compute_angle_degrees(found.rotation, rotation) < 1.0
        assert np.linalg.norm(found.translation - translation) < 0.005


def test_unusable_matches_have_no_weight() -> None:
    pair, stack, center = make_scene(2, make_zigzag_rig(4), outliers=0.3)
    usable = ~np.concatenate(pair.is_outlier)
    found = fit_stack(stack, usable)
    assert (found.fit.weights[~usable] == 0).all()
    assert compute_angle_degrees(found.rotation, get_true_motion(pair, center)[0]) < 0.6


def test_result_is_deterministic() -> None:
    _, stack, _ = make_scene(3, make_zigzag_rig(4), outliers=0.3)
    (a, *first_numbers), (b, *second_numbers) = fit_stack(stack), fit_stack(stack)
    assert first_numbers == second_numbers
    for one, other in zip((*a.candidate, *a[1:]), (*b.candidate, *b[1:]), strict=True):
        np.testing.assert_array_equal(one, other)


def test_result_hardly_depends_on_the_seed() -> None:
    for seed in range(5):
        _, stack, _ = make_scene(seed, make_zigzag_rig(4), outliers=0.3)
        a, b = fit_stack(stack, seed=1), fit_stack(stack, seed=2)
        assert compute_angle_degrees(a.rotation, b.rotation) < 0.02
        np.testing.assert_allclose(a.translation, b.translation, atol=1e-4)


def test_weights_and_information_are_valid() -> None:
    _, stack, _ = make_scene(4, make_zigzag_rig(4), outliers=0.3)
    found = fit_stack(stack)
    assert ((found.fit.weights >= 0) & (found.fit.weights <= 1)).all()
    assert found.predicted_decrease < 0.02
    assert 0 < found.iterations < 500
    for matrix in (found.fit.information, found.fit.information_without_depth):
        np.testing.assert_allclose(matrix, matrix.T, rtol=1e-9)
        assert np.linalg.eigvalsh(matrix).min() > 0


def test_no_usable_matches_give_no_fit() -> None:
    _, stack, _ = make_scene(5, make_zigzag_rig(2))
    found = fit_stack(stack, np.zeros(len(stack.x), bool))
    assert found.predicted_decrease == np.inf
    assert not found.fit.weights.any()


def test_junk_alone_is_not_explained_by_noise() -> None:
    """If nothing agrees, the noise level must not grow until everything does; once in ten scenes it may (a
    regression)."""
    rig, passed = make_zigzag_rig(4), 0
    for seed in range(10):
        _, stack, _ = make_scene(seed, rig, junk=rig.names)
        passed += bool(np.mean(fit_stack(stack).fit.weights > 0) > 0.5)
    assert passed <= 1


def test_noise_of_junk_is_bounded() -> None:
    """Of eight seeds or more, within the threshold, the rms with four unknowns is at most √2 times that."""
    bound = MAX_SIGMA_GROWTH * np.sqrt(2.0) * SEED_THRESHOLD_PX
    for seed in range(10):
        _, stack, _ = make_scene(seed, make_zigzag_rig(4), junk=make_zigzag_rig(4).names)
        assert (fit_stack(stack).fit.sigma_px <= bound + 1e-12).all()


def test_information_without_depth_prior_is_smaller() -> None:
    """With one camera the length of the translation is unknown without the prior."""
    for seed in range(5):
        for n in (1, 4):
            _, stack, _ = make_scene(seed, make_zigzag_rig(n), 10.0)
            found = fit_stack(stack)
            units = 1.0 / np.sqrt(np.diag(found.fit.information))
            known, alone = (
                m * np.outer(units, units) for m in (found.fit.information, found.fit.information_without_depth)
            )
            assert np.linalg.eigvalsh(known - alone).min() > -1e-6
            if n == 1:
                assert np.linalg.eigvalsh(alone)[0] < 1e-3 * np.linalg.eigvalsh(known)[0]


@pytest.mark.parametrize("seed", range(4))
def test_complexity_is_that_of_the_marginal_likelihood(seed: int) -> None:
    """It is the logarithm of the prior's density over the posterior's at their peaks, which also SciPy computes."""
    a, b = np.random.default_rng(seed).normal(size=(2, 6, 9))
    prior = a @ a.T
    posterior = prior + b @ b.T
    peaks = [multivariate_normal(cov=np.linalg.inv(p)).logpdf(np.zeros(6)) for p in (posterior, prior)]
    found = _measure_complexity(np.linalg.cholesky(posterior), prior, np.empty((6, 6)))
    assert found == pytest.approx(peaks[0] - peaks[1], rel=1e-9)
    assert _measure_complexity(np.linalg.cholesky(posterior), -prior, np.empty((6, 6))) == np.inf
