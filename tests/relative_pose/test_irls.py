"""One robust motion: its inliers are the inliers, its noise is the noise, cameras gone wrong are set aside."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.relative_pose.irls import SIGMA_GROWTH, Reweighted
from sylpose.relative_pose.robust_fit import SEED_SIGMA_PX, fitted
from sylpose.relative_pose.terms import Stack, guesses_of, object_place, stack_terms
from sylpose.rig import Rig
from sylpose.simulate import SimulatedPair, arc, random_motion, simulate_matches
from tests.scenes import BODY, around, data_of, epipolar_px, truth, turn_between


class Robust(NamedTuple):
    """What `robust_fit` finds and says."""

    found: Reweighted
    iterations: int
    promise: float

    @property
    def rotation(self) -> FloatArray:
        return self.found.candidate.rotation

    @property
    def shift(self) -> FloatArray:
        return self.found.candidate.shift


def fit_of(stack: Stack, usable: BoolArray | None = None, seed: int = 0) -> Robust:
    """Without guesses."""
    every = np.ones(len(stack.x), dtype=bool) if usable is None else usable
    fit, _, iterations, promise = fitted(stack, every, guesses_of([]), np.random.default_rng(seed))
    return Robust(fit, iterations, promise)


def scene(seed: int, rig: Rig, turn: float = 5.0, **options: object) -> tuple[SimulatedPair, Stack, FloatArray]:
    """Matches, the problem that they make, and its centre."""
    rng = np.random.default_rng(seed)
    pair = simulate_matches(rig, BODY, random_motion(turn, 0.02, rng), rng=rng, **options)  # type: ignore[arg-type]
    data = data_of(rig, pair.matches)
    center, radius = object_place(data)
    return pair, stack_terms(data, center, radius), center


def split(stack: Stack, values: FloatArray) -> list[FloatArray]:
    return np.split(values, stack.offsets[1:-1])


@pytest.mark.parametrize(
    ("kind", "share"),
    [*(("uniform", share) for share in (0.1, 0.3, 0.5)), *(("second_motion", share) for share in (0.1, 0.3, 0.4))],
)
def test_inliers_are_the_inliers(kind: str, share: float) -> None:
    """Matches that stand still are told before (`sylpose.relative_pose.solver`)."""
    rig, kept, caught = around(4), [], []
    for seed in range(5):
        pair, stack, center = scene(seed, rig, 8.0, per_camera=100, outliers=share, outlier_kind=kind)
        data = data_of(rig, pair.matches)
        for term, w, wrong in zip(data, split(stack, fit_of(stack).found.weights), pair.is_outlier, strict=True):
            # A mismatch that the true motion explains cannot be told from a match, nor does it harm.
            far = np.abs(epipolar_px(term, center, *truth(pair, center))) > 4
            kept += list(w[~wrong] > 0)
            caught += list(w[wrong & far] == 0)
    assert np.mean(kept) > 0.98
    # A second motion that is nearly a majority in some camera raises that camera's noise.
    assert np.mean(caught) > (0.95 if kind == "second_motion" else 0.98)


@pytest.mark.parametrize("outliers", [0.0, 0.3])
@pytest.mark.parametrize("noise_px", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("rig", [around(4), arc(2, 40)], ids=["around4", "arc2"])
def test_the_noise_is_measured(rig: Rig, noise_px: float, outliers: float) -> None:
    ratios = []
    for seed in range(6):
        _, stack, _ = scene(seed, rig, per_camera=100, noise_px=noise_px, outliers=outliers)
        ratios.append(fit_of(stack).found.sigma_px / noise_px)
    assert 0.85 < np.mean(ratios) < 1.15
    assert np.max(np.abs(np.mean(ratios, axis=1) - 1)) < 0.3  # in each scene


def test_a_camera_noisier_than_the_others_is_believed_less() -> None:
    rig = around(4)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        motion = random_motion(5, 0.02, rng)
        pairs = [simulate_matches(rig, BODY, motion, rng=np.random.default_rng(seed), noise_px=s) for s in (0.3, 1.5)]
        matches = [*pairs[0].matches[:3], pairs[1].matches[3]]
        data = data_of(rig, matches)
        sigma = fit_of(stack_terms(data, *object_place(data))).found.sigma_px
        # By less than it is: each is drawn towards the rig's, and none exceeds `SIGMA_GROWTH` times the seeds'.
        assert sigma[3] > 2.0 * sigma[:3].max()


def test_residuals_are_measured_in_pixels() -> None:
    _, stack, _ = scene(0, around(4), per_camera=300)
    found = fit_of(stack)
    assert np.std(found.found.across[found.found.weights > 0]) == pytest.approx(0.5, rel=0.1)


def test_a_junk_camera_is_set_aside() -> None:
    rig = around(4)
    for seed in range(8):
        pair, stack, center = scene(seed, rig, junk=("cam_1",))
        found = fit_of(stack)
        agree = [np.mean(w > 0) for w in split(stack, found.found.weights)]
        assert agree[1] < 0.15
        assert min(agree[0], agree[2], agree[3]) > 0.9
        rotation, shift = truth(pair, center)
        assert turn_between(found.rotation, rotation) < 1.0
        assert np.linalg.norm(found.shift - shift) < 0.005


def test_matches_that_are_not_usable_are_not_used() -> None:
    pair, stack, center = scene(2, around(4), outliers=0.3)
    usable = ~np.concatenate(pair.is_outlier)
    found = fit_of(stack, usable)
    assert (found.found.weights[~usable] == 0).all()
    assert turn_between(found.rotation, truth(pair, center)[0]) < 0.6


def test_the_same_input_gives_the_same_to_the_last_bit() -> None:
    _, stack, _ = scene(3, around(4), outliers=0.3)
    (a, *said), (b, *same) = fit_of(stack), fit_of(stack)
    assert said == same
    for one, other in zip((*a.candidate, *a[1:]), (*b.candidate, *b[1:]), strict=True):
        np.testing.assert_array_equal(one, other)


def test_other_draws_give_nearly_the_same() -> None:
    for seed in range(5):
        _, stack, _ = scene(seed, around(4), outliers=0.3)
        a, b = fit_of(stack, seed=1), fit_of(stack, seed=2)
        assert turn_between(a.rotation, b.rotation) < 0.02
        np.testing.assert_allclose(a.shift, b.shift, atol=1e-4)


def test_weights_and_information_make_sense() -> None:
    _, stack, _ = scene(4, around(4), outliers=0.3)
    found = fit_of(stack)
    assert ((found.found.weights >= 0) & (found.found.weights <= 1)).all()
    assert found.promise < 0.02
    assert 0 < found.iterations < 500
    for matrix in (found.found.information, found.found.without_depth):
        np.testing.assert_allclose(matrix, matrix.T, rtol=1e-9)
        assert np.linalg.eigvalsh(matrix).min() > 0


def test_nothing_usable_is_no_fit() -> None:
    _, stack, _ = scene(5, around(2))
    found = fit_of(stack, np.zeros(len(stack.x), bool))
    assert found.promise == np.inf
    assert not found.found.weights.any()


def test_junk_alone_does_not_pass_for_noise() -> None:
    """When nothing agrees, the noise level must not grow until everything does; once in ten scenes it may (a regression)."""
    rig, passed = around(4), 0
    for seed in range(10):
        _, stack, _ = scene(seed, rig, junk=rig.names)
        passed += bool(np.mean(fit_of(stack).found.weights > 0) > 0.5)
    assert passed <= 1


def test_junk_alone_never_has_more_noise_than_the_ceiling() -> None:
    for seed in range(10):
        _, stack, _ = scene(seed, around(4), junk=around(4).names)
        assert (fit_of(stack).found.sigma_px <= SIGMA_GROWTH * SEED_SIGMA_PX[1] + 1e-12).all()


def test_without_what_is_believed_of_the_surfaces_less_is_known() -> None:
    """And in one camera nothing of how far it moved."""
    for seed in range(5):
        for n in (1, 4):
            _, stack, _ = scene(seed, around(n), 10.0)
            found = fit_of(stack)
            units = 1.0 / np.sqrt(np.diag(found.found.information))
            known, alone = (m * np.outer(units, units) for m in (found.found.information, found.found.without_depth))
            assert np.linalg.eigvalsh(known - alone).min() > -1e-6
            if n == 1:
                assert np.linalg.eigvalsh(alone)[0] < 1e-3 * np.linalg.eigvalsh(known)[0]
