"""Alignment is solvePnP where depths are known, an epipolar fit where they are not, and honest in between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sylpose.alignment import Aligned, Sights, _basis, _linearise, align
from sylpose.rig import Camera, Rig
from sylpose.simulate import dome, ellipsoid, ring

FloatArray = NDArray[np.float64]
RADIUS = 0.15
BODY = ellipsoid((RADIUS, 0.1, 0.12), n=3000)
IDENTITY = np.eye(3), np.zeros(3)
KNOWN, UNKNOWN = 1e-6, 1e3  # standard deviations of depths


@pytest.fixture(scope="module")
def rig() -> Rig:
    return ring(4, 1.5, 1000.0, height=(0.4, -0.1, 0.2, 0.5))


def motion(turn_deg: float, shift: float, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    axis, direction = rng.standard_normal((2, 3))
    turn = Rotation.from_rotvec(np.deg2rad(turn_deg) * axis / np.linalg.norm(axis))
    return turn.as_matrix(), shift * direction / np.linalg.norm(direction)


def seen_by(camera: Camera, n: int, rng: np.random.Generator) -> FloatArray:
    """(n, 3) points of the body that face the camera, which looks at the origin."""
    cosine = np.einsum("ni,ni->n", BODY.normals, camera.center - BODY.points)
    return np.asarray(BODY.points[rng.choice(np.flatnonzero(cosine > 0.3), n, replace=False)])


def sight(
    camera: Camera,
    truth: tuple[FloatArray, FloatArray],
    rng: np.random.Generator,
    *,
    n: int = 60,
    depth_sd: float = KNOWN,
    depth_off: float = 0.0,
    noise_px: float = 0.0,
    outliers: float = 0.0,
    drawn: bool = False,
) -> Sights:
    """What one camera sees of a motion X -> R X + d.

    Args:
        depth_sd: said about the landmarks.
        depth_off: how far the points are from their landmarks, along their rays: standard deviation, each for itself.
        drawn: draw that from what is said: each for itself, and all of the surface together.
    """
    points = seen_by(camera, n, rng)
    ray = points - camera.center
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    rotation, shift = truth
    # The truth is drawn around what is known, not the other way round: that is what a standard deviation of knowledge
    # means. (Landmarks that are off by errors of their own make turns look smaller, as errors in variables do.)
    off = depth_off * rng.standard_normal(n)
    if drawn:
        place = camera.normalize(camera.project(points @ rotation.T + shift))
        spread = np.linalg.norm(place.std(axis=0))
        basis = np.column_stack([np.ones(n), (place - np.median(place, axis=0)) / spread])
        off = depth_sd * (rng.standard_normal(n) + basis @ rng.standard_normal(3))
    image = camera.normalize(camera.project((points + off[:, None] * ray) @ rotation.T + shift))
    image = image + noise_px / camera.focal * rng.standard_normal((n, 2))
    wrong = rng.permutation(n)[: round(outliers * n)]
    image[wrong] = rng.uniform(image.min(axis=0), image.max(axis=0), (len(wrong), 2))
    return Sights(
        points=points,
        depth_error=depth_sd * ray,
        image=image,
        feature=np.arange(n),
        trust=np.ones(n),
        rotation=camera.rotation,
        center=camera.center,
        focal=camera.focal,
    )


def sights_of(
    rig: Rig,
    truth: tuple[FloatArray, FloatArray],
    seed: int = 0,
    *,
    depth_sd: float = KNOWN,
    depth_off: float = 0.0,
    noise_px: float = 0.0,
    outliers: float = 0.0,
    drawn: bool = False,
) -> list[Sights]:
    rng = np.random.default_rng(seed)
    return [
        sight(
            camera,
            truth,
            rng,
            depth_sd=depth_sd,
            depth_off=depth_off,
            noise_px=noise_px,
            outliers=outliers,
            drawn=drawn,
        )
        for camera in rig
    ]


def error(found: Aligned, truth: tuple[FloatArray, FloatArray]) -> FloatArray:
    """(6,) the error (w, d): radians and length units."""
    turn = Rotation.from_matrix(truth[0] @ found.rotation.T).as_rotvec()
    return np.concatenate([turn, truth[1] - found.shift])


def degrees(found: Aligned, truth: tuple[FloatArray, FloatArray]) -> float:
    return float(np.rad2deg(np.linalg.norm(error(found, truth)[:3])))


# --- the linear algebra


@pytest.mark.parametrize("depth_sd", [0.0, 0.05, 5.0])
def test_derivatives_equal_finite_differences(rig: Rig, depth_sd: float) -> None:
    rng = np.random.default_rng(0)
    one = sight(rig.cameras[1], motion(5, 0.02), rng, n=20, depth_sd=depth_sd, noise_px=1.0)
    basis, surface = _basis(one), np.array([0.3, -0.2, 0.1]) * min(1.0, 0.05 / max(depth_sd, 1e-9))
    rotation, shift = motion(8, 0.05, seed=3)
    e, jac, _ = _linearise(one, basis, surface, rotation, shift, 0.7)
    assert e.shape == (20, 2)
    assert jac.shape == (20, 2, 9)

    def residuals(x: FloatArray) -> FloatArray:
        turned = Rotation.from_rotvec(x[:3]).as_matrix() @ rotation
        return _linearise(one, basis, surface + x[6:], turned, shift + x[3:6], 0.7)[0]

    for k in range(9):
        h = 1e-6 * np.eye(9)[k] * (1.0 if k < 6 else 1.0 / max(depth_sd, 1.0))
        numeric = (residuals(h) - residuals(-h)) / (2 * h[k])
        np.testing.assert_allclose(jac[:, :, k], numeric, rtol=1e-5, atol=1e-7 * max(depth_sd, 1.0))


def test_the_weight_is_the_inverse_of_both_noises(rig: Rig) -> None:
    camera = rig.cameras[0]
    one = sight(camera, motion(5, 0.02), np.random.default_rng(1), n=15, depth_sd=0.08)
    rotation, shift = motion(4, 0.03, seed=2)
    _, _, inverse = _linearise(one, _basis(one), np.zeros(3), rotation, shift, 0.7)
    h = 1e-6
    moved = [
        _linearise(
            replace(one, points=one.points + k * h * one.depth_error), _basis(one), np.zeros(3), rotation, shift, 1
        )
        for k in (1, -1)
    ]
    along = (moved[0][0] - moved[1][0]) / (2 * h)
    variance = (0.7 / camera.focal) ** 2 * np.eye(2) + along[:, :, None] * along[:, None, :]
    np.testing.assert_allclose(inverse, np.linalg.inv(variance), rtol=1e-5)


# --- the limits


@pytest.mark.parametrize(("turn", "shift"), [(10, 0.0), (0, 0.15), (10, 0.15)])
@pytest.mark.parametrize("seed", range(4))
def test_exact_without_noise_from_far_away(rig: Rig, turn: float, shift: float, seed: int) -> None:
    # A tenth of the distance is half of the object's size.
    truth = motion(6, 0.03, seed)
    off_turn, off_shift = motion(turn, shift, seed + 10)
    found = align(sights_of(rig, truth, seed), off_turn @ truth[0], truth[1] + off_shift)
    assert found.converged
    np.testing.assert_allclose(error(found, truth), 0, atol=1e-6)
    assert found.cost < 1e-3
    assert all((w > 0).all() for w in found.weights)
    assert all(np.abs(r).max() < 1e-2 for r in found.residuals)


@pytest.mark.parametrize("seed", range(3))
def test_known_depths_of_one_camera_are_solve_pnp(seed: int) -> None:
    camera, truth = dome(3).cameras[seed], motion(7, 0.04, seed)
    # So little noise that the robust weights are all alike.
    one = sight(camera, truth, np.random.default_rng(seed), noise_px=0.02)
    found = align([one], *IDENTITY)
    _, turn, place = cv2.solvePnP(one.points, one.image, np.eye(3), np.zeros(0), flags=cv2.SOLVEPNP_ITERATIVE)
    rotation = camera.rotation.T @ Rotation.from_rotvec(turn.ravel()).as_matrix()
    shift = camera.rotation.T @ place.ravel() + camera.center
    sd = np.sqrt(np.diag(np.linalg.inv(found.information)))
    assert (np.abs(error(found, (rotation, shift))) < 0.02 * sd).all()
    assert degrees(found, truth) < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_unknown_depths_are_an_epipolar_fit(rig: Rig, seed: int) -> None:
    truth = motion(8, 0.05, seed)
    sights = sights_of(rig, truth, seed, depth_sd=UNKNOWN, depth_off=0.02, noise_px=0.02)
    found = align(sights, *IDENTITY)

    def distances(x: FloatArray) -> FloatArray:
        """Of the points from their epipolar lines, pixels."""
        rotation, shift = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]
        parts = []
        for s in sights:
            ray = (s.points - s.center) @ rotation.T @ s.rotation.T
            start = (rotation @ s.center + shift - s.center) @ s.rotation.T
            line = np.cross(np.broadcast_to(start, ray.shape), ray)
            homogeneous = np.column_stack([s.image, np.ones(len(s.image))])
            parts.append(s.focal * np.einsum("ni,ni->n", homogeneous, line) / np.linalg.norm(line[:, :2], axis=1))
        return np.concatenate(parts)

    start = np.concatenate([Rotation.from_matrix(truth[0]).as_rotvec(), truth[1]])
    best = least_squares(distances, start, xtol=1e-14, ftol=1e-14, gtol=1e-14, x_scale="jac").x
    sd = np.sqrt(np.diag(np.linalg.inv(found.information)))
    assert (np.abs(error(found, (Rotation.from_rotvec(best[:3]).as_matrix(), best[3:]))) < 0.2 * sd).all()
    # The residuals it reports are these distances.
    theirs = np.abs(np.concatenate(found.residuals))
    x = np.concatenate([Rotation.from_matrix(found.rotation).as_rotvec(), found.shift])
    np.testing.assert_allclose(theirs, np.abs(distances(x)), atol=5e-3)


def test_knowing_more_is_knowing_more(rig: Rig) -> None:
    truth = motion(5, 0.03)
    sd = []
    for depth_sd in (UNKNOWN, 0.1, 0.02, KNOWN):
        found = align(sights_of(rig, truth, 1, depth_sd=depth_sd, noise_px=0.5), *IDENTITY)
        sd.append(np.sqrt(np.diag(np.linalg.inv(found.information))))
    assert (np.diff(sd, axis=0) < 0).all()


# --- starts


@pytest.mark.parametrize("depth_sd", [0.02, 0.1, 0.3])
@pytest.mark.parametrize("turn", [0.0, 1.0, 5.0])
def test_the_identity_is_no_trap(rig: Rig, depth_sd: float, turn: float) -> None:
    truth = motion(turn, 0.01, 5)
    found = align(sights_of(rig, truth, 5, depth_sd=depth_sd, depth_off=0.02, noise_px=0.3), *IDENTITY)
    assert found.converged
    assert degrees(found, truth) < 0.25
    assert np.linalg.norm(error(found, truth)[3:]) < 0.002


@pytest.mark.parametrize("depth_sd", [0.02, UNKNOWN])
def test_the_start_does_not_decide(rig: Rig, depth_sd: float) -> None:
    truth = motion(6, 0.03, 6)
    sights = sights_of(rig, truth, 6, depth_sd=depth_sd, depth_off=0.01, noise_px=0.3)
    a = align(sights, *IDENTITY)
    b = align(sights, *truth)
    c = align(sights, *truth, first_px=4.0)
    sd = np.sqrt(np.diag(np.linalg.inv(a.information)))
    for other in (b, c):
        assert (np.abs(error(a, (other.rotation, other.shift))) < 0.15 * sd).all()
        assert other.cost == pytest.approx(a.cost, rel=0.05)


# --- what is wrong


@pytest.mark.parametrize("seed", range(5))
def test_a_third_of_outliers_does_no_harm(rig: Rig, seed: int) -> None:
    truth = motion(6, 0.03, seed)
    clean, found = (
        align(sights_of(rig, truth, seed, outliers=share, depth_sd=0.03, depth_off=0.02, noise_px=0.4), *IDENTITY)
        for share in (0.0, 0.3)
    )
    assert found.converged
    assert degrees(found, truth) < max(0.25, 3 * degrees(clean, truth))
    assert np.linalg.norm(error(found, truth)[3:]) < 0.003
    for w in found.weights:
        assert 0.55 < (w > 0).mean() < 0.9
    assert found.cost > clean.cost


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_of_junk_is_set_aside(rig: Rig, seed: int) -> None:
    truth = motion(5, 0.03, seed)
    sights = sights_of(rig, truth, seed, depth_sd=0.03, depth_off=0.02, noise_px=0.4)
    mixed = np.random.default_rng(seed).permutation(len(sights[2].image))
    sights[2] = replace(sights[2], image=sights[2].image[mixed])
    found = align(sights, *IDENTITY)
    without = align([s for c, s in enumerate(sights) if c != 2], *IDENTITY)
    assert degrees(found, truth) < 0.25
    assert (found.weights[2] > 0).mean() < 0.2
    # The junk may not pretend to knowledge.
    ratio = np.trace(np.linalg.inv(found.information)) / np.trace(np.linalg.inv(without.information))
    assert 0.7 < ratio < 1.4


def test_landmarks_behind_a_camera_are_outliers(rig: Rig) -> None:
    truth = motion(5, 0.02)
    sights = sights_of(rig, truth, 2, depth_sd=0.02, noise_px=0.3)
    points = sights[0].points.copy()
    points[:5] = 2 * rig.cameras[0].center - points[:5]
    sights[0] = replace(sights[0], points=points)
    found = align(sights, *IDENTITY)
    assert (found.weights[0][:5] == 0).all()
    assert degrees(found, truth) < 0.2


# --- what is said about it


def test_the_information_is_that_of_the_errors() -> None:
    """Normalised squares of the error (NEES) of landmarks drawn from their own model: 6 for 6 unknowns."""
    rig = ring(3, 1.5, 1000.0, height=(0.4, -0.1, 0.2))
    nees = []
    for seed in range(60):
        truth = motion(4, 0.02, seed)
        sights = sights_of(rig, truth, seed, depth_sd=0.03, noise_px=0.5, drawn=True)
        found = align(sights, *IDENTITY)
        e = error(found, truth)
        nees.append(float(e @ found.information @ e))
    assert 4 < np.mean(nees) < 9


def test_a_feature_matched_twice_counts_once(rig: Rig) -> None:
    truth = motion(5, 0.03)
    once = sights_of(rig, truth, 3, depth_sd=0.03, depth_off=0.02, noise_px=0.4)
    twice = [
        replace(
            s,
            points=np.tile(s.points, (2, 1)),
            depth_error=np.tile(s.depth_error, (2, 1)),
            image=np.tile(s.image, (2, 1)),
            feature=np.tile(s.feature, 2),
            trust=np.tile(s.trust, 2),
        )
        for s in once
    ]
    a, b = align(once, *IDENTITY), align(twice, *IDENTITY)
    np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-9)
    np.testing.assert_allclose(a.shift, b.shift, atol=1e-9)
    np.testing.assert_allclose(a.information, b.information, rtol=1e-6, atol=1e-6 * np.abs(a.information).max())
    assert len(b.weights[0]) == len(b.residuals[0]) == 2 * len(a.weights[0])


def test_a_landmark_that_contradicts_takes_its_feature_with_it(rig: Rig) -> None:
    truth = motion(5, 0.03)
    sights = sights_of(rig, truth, 4, depth_sd=0.02, noise_px=0.3)
    first = sights[0]
    wrong = first.points[:1] + 0.06 * rig.cameras[0].rotation[:1]
    sights[0] = replace(
        first,
        points=np.concatenate([first.points, wrong]),
        depth_error=np.concatenate([first.depth_error, first.depth_error[:1]]),
        image=np.concatenate([first.image, first.image[:1]]),
        feature=np.append(first.feature, 0),
        trust=np.append(first.trust, 1.0),
    )
    found = align(sights, *IDENTITY)
    assert found.weights[0][0] == found.weights[0][-1] == 0
    assert (found.weights[0][1:-1] > 0).mean() > 0.9


def test_trust_moves_the_answer(rig: Rig) -> None:
    # Two halves of the landmarks move differently, by a little: the trusted half decides.
    one, other = motion(4.0, 0.02, 1), motion(4.4, 0.02, 1)
    halves = [sights_of(rig, truth, 7, noise_px=0.1, depth_sd=0.01) for truth in (one, other)]
    for trust in (1e-3, 1.0):
        sights = [
            replace(
                a,
                image=np.where((np.arange(60) % 2 == 0)[:, None], a.image, b.image),
                trust=np.where(np.arange(60) % 2 == 0, 1.0, trust),
            )
            for a, b in zip(*halves, strict=True)
        ]
        found = align(sights, *IDENTITY, first_px=16.0)
        if trust < 1:
            assert degrees(found, one) < 0.1


@pytest.mark.parametrize("empty", [[0], [0, 2], [0, 1, 2]])
def test_cameras_without_matches(rig: Rig, empty: Sequence[int]) -> None:
    truth = motion(5, 0.03)
    sights = sights_of(rig, truth, 8, depth_sd=0.02, noise_px=0.3)
    nothing = np.empty((0, 3))
    for c in empty:
        sights[c] = replace(
            sights[c],
            points=nothing,
            depth_error=nothing,
            image=np.empty((0, 2)),
            feature=np.empty(0, np.int64),
            trust=np.empty(0),
        )
    found = align(sights, *IDENTITY)
    assert degrees(found, truth) < 1.0
    assert all(len(found.weights[c]) == len(found.residuals[c]) == 0 for c in empty)


def test_the_same_again_is_the_same(rig: Rig) -> None:
    sights = sights_of(rig, motion(5, 0.03), 9, depth_sd=0.03, noise_px=0.5, outliers=0.2)
    a, b = align(sights, *IDENTITY), align(sights, *IDENTITY)
    np.testing.assert_array_equal(a.rotation, b.rotation)
    np.testing.assert_array_equal(a.information, b.information)
