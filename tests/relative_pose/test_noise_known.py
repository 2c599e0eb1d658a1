"""What is known of the cameras' noise: how they count, and what the covariance then says."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from sylpose.geometry.arrays import FloatArray
from sylpose.geometry.noise import USUAL_PX, noise_units
from sylpose.matches import Matches
from sylpose.relative_pose.motion import estimate_motion, estimate_motions
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.simulate import SimulatedPair, random_motion, simulate_matches
from tests.scenes import BODY, around, error, nees

RIG = around(4)
UNEQUAL = np.array([0.2, 0.5, 1.0, 4.0])


def scene(
    seed: int, noise_px: FloatArray, per_camera: int = 40, **options: float
) -> tuple[SimulatedPair, list[Matches]]:
    """The same noise of a seed, times that of each camera."""
    rng = np.random.default_rng(seed)
    motion = random_motion(8.0, 0.02, rng)
    pair = simulate_matches(RIG, BODY, motion, rng=rng, per_camera=per_camera, noise_px=0.0, **options)  # type: ignore[arg-type]
    return pair, noisy(RIG, pair.matches, noise_px, rng)


def noisy(rig: Rig, matches: Sequence[Matches], noise_px: FloatArray, rng: np.random.Generator) -> list[Matches]:
    sigma = [px / camera.focal for px, camera in zip(noise_px, rig, strict=True)]
    return [
        Matches(*(part + s * rng.normal(size=part.shape) for part in (m.x, m.y)))
        for m, s in zip(matches, sigma, strict=True)
    ]


@pytest.mark.parametrize(
    ("per_camera", "outliers"), [(15, 0.0), pytest.param(40, 0.0, marks=pytest.mark.slow), (40, 0.2)]
)
def test_covariance_tells_the_error_where_noise_is_unequal(per_camera: int, outliers: float) -> None:
    known, squares = [], {True: 0.0, False: 0.0}
    for seed in range(60):
        pair, matches = scene(seed, UNEQUAL, per_camera, outliers=outliers)
        for said in (True, False):
            found = estimate_motion(RIG, matches, noise_px=UNEQUAL if said else None)
            assert found.status is Status.OK or not said
            if found.motion is not None:
                off = error(pair, found)
                squares[said] += float(off[:3] @ off[:3])
                known += [nees(off, found)] if said else []
    # Six unknowns; the mean of sixty has a standard deviation of 0.45. No less noise is believed than is said: what is
    # measured is now and then more.
    assert 4.0 < np.mean(known) < 7.0
    assert squares[True] < 0.9 * squares[False]


def test_twice_the_noise_is_twice_the_standard_deviation() -> None:
    ratios = []
    for seed in range(12):
        sigmas = []
        for factor in (1.0, 2.0):
            _, matches = scene(seed, factor * UNEQUAL / 4)
            found = estimate_motion(RIG, matches, noise_px=factor * UNEQUAL / 4)
            sigmas.append(np.sqrt(np.diag(found.covariance)))
        ratios.append(sigmas[1] / sigmas[0])
    # To first order: surfaces are known by the same relief at either.
    assert np.median(ratios) == pytest.approx(2.0, rel=0.06)


def test_more_noise_than_there_is_is_believed_and_less_is_not() -> None:
    _, matches = scene(0, UNEQUAL)
    alone, equal, more, less = (
        np.sqrt(np.trace(estimate_motion(RIG, matches, noise_px=noise).covariance[:3, :3]))
        for noise in (None, UNEQUAL, 3.0 * UNEQUAL, UNEQUAL / 3.0)
    )
    assert more > 2.0 * equal
    assert less == pytest.approx(equal, rel=0.15)
    assert alone > 0.5 * less


@pytest.mark.parametrize("method", ["epipolar", "sylvester"])
def test_a_camera_of_infinite_noise_has_no_say(method: str) -> None:
    pair, matches = scene(3, np.full(4, 0.5))
    # Its matches are anything.
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
    # All that is said is in true pixels.
    np.testing.assert_allclose(found.residuals[[0, 1, 3]], 0.5, rtol=0.4)
    assert nees(error(pair, found), found) < 40.0


def test_cameras_without_a_say_leave_too_few_matches() -> None:
    _, matches = scene(4, np.full(4, 0.5))
    assert estimate_motion(RIG, matches, noise_px=np.full(4, np.inf)).status is Status.TOO_FEW_MATCHES


def test_residuals_are_pixels_whatever_the_noise() -> None:
    _, matches = scene(5, UNEQUAL)
    # Of a match in two frames, across its epipolar line; some of it goes into the surface.
    np.testing.assert_allclose(estimate_motion(RIG, matches, noise_px=UNEQUAL).residuals, UNEQUAL, rtol=0.4)


def test_large_noise_is_no_disagreement() -> None:
    """Keypoints of 4 pixels: what is far in pixels is not in units of the noise."""
    noise, ok, sigmas = np.full(4, 4.0), 0, []
    for seed in range(10):
        pair, matches = scene(seed, noise)
        found = estimate_motion(RIG, matches, noise_px=noise)
        ok += found.status is Status.OK
        sigmas += [nees(error(pair, found), found)] if found.status is Status.OK else []
    assert ok >= 7
    assert np.mean(sigmas) < 12.0


def test_copies_and_many_pairs_know_it_too() -> None:
    _, matches = scene(6, UNEQUAL)
    one = estimate_motion(RIG, matches, noise_px=UNEQUAL)
    twice = [Matches(np.concatenate([m.x, m.x]), np.concatenate([m.y, m.y])) for m in matches]
    for other in (estimate_motion(RIG, twice, noise_px=UNEQUAL), *estimate_motions(RIG, [matches], noise_px=UNEQUAL)):
        np.testing.assert_array_equal(other.covariance, one.covariance)


def test_units_in_which_all_have_the_same_noise() -> None:
    for noise in ([0.1, 0.3], [0.5, 0.5], [2.0, 8.0], [0.25, np.inf]):
        units = noise_units(noise, ("a", "b"))
        some = units.per_px > 0
        np.testing.assert_allclose(units.per_px[some] * np.array(noise)[some], units.least)
        # In pixels of the best camera, unless that is worse than usual.
        assert units.per_px.max() == pytest.approx(min(1.0, USUAL_PX / min(noise)))


def test_noise_by_the_cameras_names() -> None:
    _, matches = scene(6, UNEQUAL)
    by_name = dict(reversed(list(zip(RIG.names, UNEQUAL, strict=True))))
    one, other = (estimate_motion(RIG, matches, noise_px=noise) for noise in (UNEQUAL, by_name))
    np.testing.assert_array_equal(other.covariance, one.covariance)
    assert noise_units({"b": np.inf, "a": 0.25}, ("a", "b")).per_px.tolist() == [1.0, 0.0]
    first, *_ = RIG.names
    missing = {name: noise for name, noise in by_name.items() if name != first}
    for wrong, said in (
        (missing, f"camera {first} is missing"),
        (by_name | {"cam_9": 0.5}, "'cam_9' is no camera"),
        (by_name | {first: "large"}, rf"noise_px\['{first}'\]: 'large' is not a finite number"),
        (by_name | {first: 0.0}, "noise_px must be from"),
    ):
        with pytest.raises(ValueError, match=f"noise_px.*{said}" if said[0] in "c'" else said):
            estimate_motion(RIG, matches, noise_px=wrong)


@pytest.mark.parametrize("wrong", [[0.5], 0.5, [0.5, 0.5, 0.0, 0.5], [0.5, np.nan, 1, 1], [-1, 1, 1, 1], ["a"] * 4])
def test_noise_that_is_none_is_refused(wrong: object) -> None:
    _, matches = scene(0, UNEQUAL)
    with pytest.raises(ValueError, match="noise_px"):
        estimate_motion(RIG, matches, noise_px=wrong)  # type: ignore[arg-type]
