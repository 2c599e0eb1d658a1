"""Translation for a given rotation: exactness under its model, and unobservable directions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.rig import Rig
from sylpose.simulate import SimulatedPair, arc, random_motion, ring, simulate_matches
from sylpose.sylvester.translation import refine_translation, solve_translation_from_means
from tests.scenes import BODY, draw_rotations, make_zigzag_rig

seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=12, deadline=None)
# An initial value without information.
NOTHING = np.zeros(3), np.zeros((3, 3))


# --- from the means ---------------------------------------------------------------------------------------------------


def simulate_means(
    rng: np.random.Generator, n: int, noise: float = 0.0, turn_size: float = 0.3, nearer: float = 0.0
) -> tuple[FloatArray, FloatArray, list[PairMoments], FloatArray, FloatArray, FloatArray]:
    """Simulate cameras whose mean surface point is at the center's depth, as modeled, or nearer or farther.

    `nearer` is the offset in units of the observed size.
    """
    g, d, turn = (
        rng.normal(size=3),
        0.1 * rng.normal(size=3),
        Rotation.from_rotvec(turn_size * rng.normal(size=3)).as_matrix(),
    )
    cameras, centers, moments = draw_rotations(rng, n), [], []
    for q in cameras:
        s = g + 0.1 * rng.normal(size=3) @ np.diag([1, 1, 0]) @ q
        if nearer:
            s += nearer * rng.normal() * 2.0 * np.sqrt(2) * 0.02 * q[2]
        o = g - q.T @ [0.2, -0.1, 2.0]
        x, y = (p[:2] / p[2] for p in (q @ (s - o), q @ (g + turn @ (s - g) + d - o)))
        spread = 0.02 * rng.normal(size=(10, 2))
        spread -= spread.mean(axis=0)
        centers.append(o)
        seen_turn = (q @ turn @ q.T)[:2, :2]
        moments.append(
            PairMoments.from_matches(x + spread, y + spread @ seen_turn.T + noise * rng.normal(size=(10, 2)))
        )
    return cameras, np.array(centers), moments, turn, g, d


@given(seeds, st.integers(2, 5))
@quick
def test_translation_is_exact_under_its_model(seed: int, n: int) -> None:
    cameras, centers, moments, turn, g, expected = simulate_means(np.random.default_rng(seed), n)
    d, information = solve_translation_from_means(cameras, centers, moments, turn, g)
    cond = np.linalg.cond(information)
    np.testing.assert_allclose(d, expected, atol=1e-12 * max(1.0, cond))
    np.testing.assert_allclose(information, information.T)


def test_one_camera_does_not_observe_translation_along_its_ray() -> None:
    cameras, centers, moments, turn, g, expected = simulate_means(np.random.default_rng(0), 1)
    d, information = solve_translation_from_means(cameras, centers, moments, turn, g)
    ray = cameras[0].T @ [*moments[0].mean_y, 1.0]
    ray /= np.linalg.norm(ray)
    values, vectors = np.linalg.eigh(information)
    assert abs(values[0]) < 1e-12 * values[1]
    assert abs(vectors[:, 0] @ ray) == pytest.approx(1)
    assert abs(d @ ray) < 1e-12
    # Across the ray the estimate is right: the remaining error moves the point along the ray only.
    np.testing.assert_allclose(np.cross(expected - d, ray), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("scene", "low", "high"),
    [
        # Noise, and the surface offset at a small rotation: three unknowns, +- 0.2 for 150 scenes.
        ({"noise": 1e-3, "turn_size": 0.0}, 2.0, 4.0),
        ({"noise": 1e-5, "turn_size": 0.05, "nearer": 1.0}, 1.8, 4.2),
        # The error is up to ρ times the angle, less for rotations about the line of sight: modeled in full it is too large.
        ({"noise": 1e-3, "turn_size": 0.3, "nearer": 1.0}, 0.8, 3.0),
    ],
)
@pytest.mark.parametrize("n", [3, 4])
def test_translation_information_agrees_with_sampling(scene: dict[str, float], low: float, high: float, n: int) -> None:
    normalised = []
    for seed in range(150):
        cameras, centers, moments, turn, g, expected = simulate_means(np.random.default_rng(seed), n, **scene)
        d, information = solve_translation_from_means(cameras, centers, moments, turn, g)
        normalised.append((d - expected) @ information @ (d - expected))
    assert low < np.mean(normalised) < high


def test_translation_is_independent_of_empty_cameras_and_frame() -> None:
    rng = np.random.default_rng(1)
    cameras, centers, moments, turn, g, _ = simulate_means(rng, 3, noise=1e-3)
    d, information = solve_translation_from_means(cameras, centers, moments, turn, g)
    more = solve_translation_from_means(
        np.concatenate([cameras, cameras[:1]]), [*centers, g + 9], [*moments, PairMoments.zero()], turn, g
    )
    np.testing.assert_allclose(more[0], d, atol=1e-12)
    new, shift = draw_rotations(rng, 1)[0], rng.normal(size=3)
    turned = solve_translation_from_means(
        cameras @ new.T, centers @ new.T + shift, moments, new @ turn @ new.T, new @ g + shift
    )
    np.testing.assert_allclose(turned[0], new @ d, atol=1e-10)
    np.testing.assert_allclose(turned[1], new @ information @ new.T, rtol=1e-6, atol=1e-8 * np.abs(information).max())


def test_invalid_input_to_the_translation_raises() -> None:
    cameras, centers, moments, turn, g, _ = simulate_means(np.random.default_rng(2), 2)
    with pytest.raises(ValueError, match=r"centers must be \(2, 3\)"):
        solve_translation_from_means(cameras, centers[:1], moments, turn, g)
    with pytest.raises(ValueError, match="rotation"):
        solve_translation_from_means(cameras, centers, moments, 2 * turn, g)
    with pytest.raises(ValueError, match="no camera has matches"):
        solve_translation_from_means(cameras, centers, [PairMoments.zero()] * 2, turn, g)
    with pytest.raises(ValueError, match="not in front of camera 1"):
        solve_translation_from_means(cameras, [centers[0], g + 3 * cameras[1, 2]], moments, turn, g)


# --- from the moments -------------------------------------------------------------------------------------------------


def simulate_scene(
    rig: Rig, seed: int, noise_px: float, turn_deg: float = 8.0
) -> tuple[SimulatedPair, list[PairMoments], FloatArray]:
    """Return matches of an ellipsoid, their moments and the true translation of its center."""
    rng = np.random.default_rng(seed)
    pair = simulate_matches(rig, BODY, random_motion(turn_deg, 0.02, rng), rng=rng, noise_px=noise_px)
    moments = [PairMoments.from_matches(m.x, m.y) for m in pair.matches]
    return pair, moments, np.asarray(pair.motion.apply(pair.center) - pair.center)


def of_rig(rig: Rig) -> tuple[FloatArray, FloatArray]:
    return np.array([c.rotation for c in rig]), np.array([c.center for c in rig])


@pytest.mark.parametrize("n", [2, 4])
@pytest.mark.parametrize("seed", range(4))
def test_epipolar_translation_is_exact_without_noise(n: int, seed: int) -> None:
    rig = make_zigzag_rig(n) if n > 2 else Rig(make_zigzag_rig(4).cameras[:2])
    pair, moments, expected = simulate_scene(rig, seed, 0.0)
    R = pair.motion.rotation.as_matrix()
    d, information = refine_translation(*of_rig(rig), moments, R, pair.center, *NOTHING)
    np.testing.assert_allclose(d, expected, atol=1e-7)
    np.testing.assert_allclose(information, information.T)


def test_more_accurate_than_the_means_on_a_surface() -> None:
    rig = make_zigzag_rig(4)
    by_means, by_moments = [], []
    for seed in range(12):
        pair, moments, expected = simulate_scene(rig, seed, 0.5, 15.0)
        R = pair.motion.rotation.as_matrix()
        start, prior = solve_translation_from_means(*of_rig(rig), moments, R, pair.center)
        d, _ = refine_translation(*of_rig(rig), moments, R, pair.center, start, prior)
        by_means.append(np.linalg.norm(start - expected))
        by_moments.append(np.linalg.norm(d - expected))
    assert 3 * np.median(by_moments) < np.median(by_means)


def test_information_includes_the_rotation_error() -> None:
    rig = make_zigzag_rig(4)
    sd, normalised = 0.002, []
    for seed in range(100):
        rng = np.random.default_rng(1000 + seed)
        pair, moments, expected = simulate_scene(rig, seed, 0.5)
        off = sd * rng.standard_normal(3)
        R = Rotation.from_rotvec(off).as_matrix() @ pair.motion.rotation.as_matrix()
        d, information = refine_translation(*of_rig(rig), moments, R, pair.center, *NOTHING)
        covariance = np.linalg.inv(information + np.diag([sd**-2] * 3 + [0.0] * 3))[3:, 3:]
        normalised.append((d - expected) @ np.linalg.solve(covariance, d - expected))
    assert 2.0 < np.mean(normalised) < 4.5  # three unknowns


def test_independent_of_frame_and_empty_cameras() -> None:
    rig = make_zigzag_rig(3)
    pair, moments, _ = simulate_scene(rig, 1, 0.5)
    Q, o = of_rig(rig)
    R, g = pair.motion.rotation.as_matrix(), pair.center
    d, information = refine_translation(Q, o, moments, R, g, *NOTHING)
    more = refine_translation(np.concatenate([Q, Q[:1]]), [*o, g + 9], [*moments, PairMoments.zero()], R, g, *NOTHING)
    np.testing.assert_allclose(more[0], d, atol=1e-9)
    new, shift = Rotation.from_rotvec([0.4, -1.0, 0.3]).as_matrix(), np.array([1.0, -2.0, 0.5])
    turned = refine_translation(Q @ new.T, o @ new.T + shift, moments, new @ R @ new.T, new @ g + shift, *NOTHING)
    np.testing.assert_allclose(turned[0], new @ d, atol=1e-7)
    both = np.kron(np.eye(2), new)
    np.testing.assert_allclose(turned[1], both @ information @ both.T, rtol=1e-3, atol=1e-4 * information.max())


@pytest.mark.parametrize("turn_deg", [0.0, 10.0, 60.0])
def test_one_camera_keeps_the_initial_translation(turn_deg: float) -> None:
    """Epipolar geometry of one camera gives no scale, and no direction without rotation."""
    rig = Rig(make_zigzag_rig(4).cameras[:1])
    for seed in range(4):
        pair, moments, expected = simulate_scene(rig, seed, 0.5, turn_deg)
        R = pair.motion.rotation.as_matrix()
        start, prior = solve_translation_from_means(*of_rig(rig), moments, R, pair.center)
        d, information = refine_translation(*of_rig(rig), moments, R, pair.center, start, prior)
        assert np.linalg.norm(d - expected) < 0.1 * (0.1 + np.deg2rad(turn_deg))
        assert np.isfinite(information).all()
    still = [PairMoments.from_matches(m.x, m.x) for m in pair.matches]
    d, information = refine_translation(*of_rig(rig), still, np.eye(3), pair.center, *NOTHING)
    assert np.abs(d).max() < 1e-9
    assert np.isfinite(information).all()


def test_means_include_the_surface_offset() -> None:
    rig = arc(4, 15.0)
    normalised = []
    for seed in range(40):
        pair, moments, expected = simulate_scene(rig, seed, 0.5, 10.0)
        d, information = solve_translation_from_means(
            *of_rig(rig), moments, pair.motion.rotation.as_matrix(), pair.center
        )
        normalised.append((d - expected) @ information @ (d - expected))
    assert (
        0.4 < np.mean(normalised) < 3.0
    )  # three unknowns; cameras on one side have equal errors, which are modeled as independent noise


def test_invalid_start_raises() -> None:
    rig = ring(2)
    pair, moments, _ = simulate_scene(rig, 0, 0.5)
    with pytest.raises(ValueError, match="initial has values that are not finite"):
        refine_translation(*of_rig(rig), moments, np.eye(3), pair.center, [np.nan, 0, 0], np.zeros((3, 3)))
