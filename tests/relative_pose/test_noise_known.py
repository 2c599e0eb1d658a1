"""Known noise of the cameras: its effect on weights and covariance, by Monte Carlo."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.robust_loss import DEFAULT_NOISE_PX, make_noise_units
from sylpose.matches import Matches
from sylpose.relative_pose.motion import estimate_motion, estimate_motions
from sylpose.rig import Rig
from sylpose.simulate import SimulatedPair, random_motion, simulate_matches
from sylpose.status import Status
from tests.scenes import BODY, compute_motion_error, compute_nees, make_zigzag_rig

RIG = make_zigzag_rig(4)
UNEQUAL = np.array([0.2, 0.5, 1.0, 4.0])


def make_scene(
    seed: int, noise_px: FloatArray, per_camera: int = 40, **options: float
) -> tuple[SimulatedPair, list[Matches]]:
    """Return a scene whose noise for a seed is scaled by that of each camera."""
    rng = np.random.default_rng(seed)
    motion = random_motion(8.0, 0.02, rng)
    pair = simulate_matches(RIG, BODY, motion, rng=rng, per_camera=per_camera, noise_px=0.0, **options)  # type: ignore[arg-type]
    return pair, add_noise(RIG, pair.matches, noise_px, rng)


def add_noise(rig: Rig, matches: Sequence[Matches], noise_px: FloatArray, rng: np.random.Generator) -> list[Matches]:
    sigma = [px / camera.focal for px, camera in zip(noise_px, rig, strict=True)]
    return [
        Matches(*(part + s * rng.normal(size=part.shape) for part in (m.x, m.y)))
        for m, s in zip(matches, sigma, strict=True)
    ]


@pytest.mark.parametrize(
    ("per_camera", "outliers"), [(15, 0.0), pytest.param(40, 0.0, marks=pytest.mark.slow), (40, 0.2)]
)
def test_covariance_matches_the_error_with_unequal_noise(per_camera: int, outliers: float) -> None:
    known, squares = [], {True: 0.0, False: 0.0}
    for seed in range(60):
        pair, matches = make_scene(seed, UNEQUAL, per_camera, outliers=outliers)
        for is_given in (True, False):
            found = estimate_motion(RIG, matches, noise_px=UNEQUAL if is_given else None)
            assert found.status is Status.OK or not is_given
            if found.motion is not None:
                off = compute_motion_error(pair, found)
                squares[is_given] += float(off[:3] @ off[:3])
                known += [compute_nees(off, found)] if is_given else []
    # Six unknowns; the mean of sixty has a standard deviation of 0.45. The given noise is a lower bound: sometimes the
    # estimate is larger.
    assert 4.0 < np.mean(known) < 7.0
    assert squares[True] < 0.9 * squares[False]


def test_twice_the_noise_doubles_the_standard_deviation() -> None:
    ratios = []
    for seed in range(12):
        sigmas = []
        for factor in (1.0, 2.0):
            _, matches = make_scene(seed, factor * UNEQUAL / 4)
            found = estimate_motion(RIG, matches, noise_px=factor * UNEQUAL / 4)
            sigmas.append(np.sqrt(np.diag(found.covariance)))
        ratios.append(sigmas[1] / sigmas[0])
    # To first order: the residual depth is the same in both.
    assert np.median(ratios) == pytest.approx(2.0, rel=0.06)


def test_given_noise_is_a_lower_bound() -> None:
    _, matches = make_scene(0, UNEQUAL)
    alone, equal, more, less = (
        np.sqrt(np.trace(estimate_motion(RIG, matches, noise_px=noise).covariance[:3, :3]))
        for noise in (None, UNEQUAL, 3.0 * UNEQUAL, UNEQUAL / 3.0)
    )
    assert more > 2.0 * equal
    assert less == pytest.approx(equal, rel=0.15)
    assert alone > 0.5 * less


@pytest.mark.parametrize("method", ["epipolar", "sylvester"])
def test_camera_with_infinite_noise_is_excluded(method: str) -> None:
    pair, matches = make_scene(3, np.full(4, 0.5))
    # Its matches are arbitrary.
    matches[2] = Matches(matches[2].x, matches[2].y[::-1])
    noise = np.array([0.5, 0.5, np.inf, 0.5])
    found = estimate_motion(RIG, matches, noise_px=noise, method=method)
    rig, rest = RIG.subset(["cam_0", "cam_1", "cam_3"]), [matches[k] for k in (0, 1, 3)]
    without = estimate_motion(rig, rest, noise_px=noise[[0, 1, 3]], method=method)
    assert found.motion is not None
    assert without.motion is not None
    np.testing.assert_array_equal(found.motion.as_matrix(), without.motion.as_matrix())
    np.testing.assert_array_equal(found.covariance, without.covariance)
    assert not found.inliers[2].any()
    assert np.isnan(found.residuals[2])
    # All residuals are in true pixels.
    np.testing.assert_allclose(found.residuals[[0, 1, 3]], 0.5, rtol=0.4)
    assert compute_nees(compute_motion_error(pair, found), found) < 40.0


def test_excluded_cameras_leave_too_few_matches() -> None:
    _, matches = make_scene(4, np.full(4, 0.5))
    assert estimate_motion(RIG, matches, noise_px=np.full(4, np.inf)).status is Status.TOO_FEW_MATCHES


def test_residuals_are_in_pixels_for_any_noise() -> None:
    _, matches = make_scene(5, UNEQUAL)
    # Of a match in two frames, across its epipolar line; the depth model absorbs a part.
    np.testing.assert_allclose(estimate_motion(RIG, matches, noise_px=UNEQUAL).residuals, UNEQUAL, rtol=0.4)


def test_large_noise_is_consistent() -> None:
    """Keypoint noise of 4 pixels: errors that are large in pixels are small in units of the noise."""
    noise, ok, sigmas = np.full(4, 4.0), 0, []
    for seed in range(10):
        pair, matches = make_scene(seed, noise)
        found = estimate_motion(RIG, matches, noise_px=noise)
        ok += found.status is Status.OK
        sigmas += [compute_nees(compute_motion_error(pair, found), found)] if found.status is Status.OK else []
    assert ok >= 7
    assert np.mean(sigmas) < 12.0


def test_duplicates_and_many_pairs_use_the_noise() -> None:
    _, matches = make_scene(6, UNEQUAL)
    one = estimate_motion(RIG, matches, noise_px=UNEQUAL)
    twice = [Matches(np.concatenate([m.x, m.x]), np.concatenate([m.y, m.y])) for m in matches]
    for other in (estimate_motion(RIG, twice, noise_px=UNEQUAL), *estimate_motions(RIG, [matches], noise_px=UNEQUAL)):
        np.testing.assert_array_equal(other.covariance, one.covariance)


def test_noise_units_equalize_the_cameras() -> None:
    for noise in ([0.1, 0.3], [0.5, 0.5], [2.0, 8.0], [0.25, np.inf]):
        units = make_noise_units(noise, ("a", "b"))
        some = units.per_px > 0
        np.testing.assert_allclose(units.per_px[some] * np.array(noise)[some], units.sigma)
        # In pixels of the best camera, unless it is worse than usual.
        assert units.per_px.max() == pytest.approx(min(1.0, DEFAULT_NOISE_PX / min(noise)))


def test_noise_by_camera_name() -> None:
    _, matches = make_scene(6, UNEQUAL)
    by_name = dict(reversed(list(zip(RIG.names, UNEQUAL, strict=True))))
    one, other = (estimate_motion(RIG, matches, noise_px=noise) for noise in (UNEQUAL, by_name))
    np.testing.assert_array_equal(other.covariance, one.covariance)
    assert make_noise_units({"b": np.inf, "a": 0.25}, ("a", "b")).per_px.tolist() == [1.0, 0.0]
    first, *_ = RIG.names
    missing = {name: noise for name, noise in by_name.items() if name != first}
    for wrong, message in (
        (missing, f"camera {first} is missing"),
        (by_name | {"cam_9": 0.5}, "'cam_9' is not a camera"),
        (by_name | {first: "large"}, rf"noise_px\['{first}'\]: 'large' is not a finite number"),
        (by_name | {first: 0.0}, "noise_px must be from"),
    ):
        with pytest.raises(ValueError, match=f"noise_px.*{message}" if message[0] in "c'" else message):
            estimate_motion(RIG, matches, noise_px=wrong)


@pytest.mark.parametrize("wrong", [[0.5], 0.5, [0.5, 0.5, 0.0, 0.5], [0.5, np.nan, 1, 1], [-1, 1, 1, 1], ["a"] * 4])
def test_invalid_noise_is_rejected(wrong: object) -> None:
    _, matches = make_scene(0, UNEQUAL)
    with pytest.raises(ValueError, match="noise_px"):
        estimate_motion(RIG, matches, noise_px=wrong)  # type: ignore[arg-type]
