"""Alignment equals solvePnP for known depths and an epipolar fit for unknown ones, with a consistent covariance in
between."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from threading import Barrier
from typing import Any, TypeVar, cast

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.landmarks.alignment import (
    FIRST_PX,
    AlignmentResult,
    AlignmentStart,
    LandmarkMatches,
    align,
    make_camera_state,
    stack_matches,
)
from sylpose.landmarks.camera_terms import CUTOFF, MAX_INDEPENDENT_MATCHES, compute_camera_terms
from sylpose.landmarks.distributed_alignment import DistributedAligner
from sylpose.landmarks.joint_step import compute_disagreement, inflate_variances
from sylpose.landmarks.messages import TermsMessage
from sylpose.rig import Camera, Rig
from sylpose.simulate import dome, ellipsoid, ring

T = TypeVar("T")
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


def make_visible_points(camera: Camera, n: int, rng: np.random.Generator) -> FloatArray:
    """Return (n, 3) points of the body that face the camera, which looks at the origin."""
    cosine = np.einsum("ni,ni->n", BODY.normals, camera.center - BODY.points)
    return np.asarray(BODY.points[rng.choice(np.flatnonzero(cosine > 0.3), n, replace=False)])


def make_matches(
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
) -> LandmarkMatches:
    """Return one camera's matches for a motion X -> R X + d.

    Args:
        depth_sd: stated for the landmarks.
        depth_off: distance of the points from their landmarks, along their rays: standard deviation of individual
            errors.
        drawn: draw errors as stated: individual ones, and a common one of the surface.
    """
    points = make_visible_points(camera, n, rng)
    ray = points - camera.center
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    rotation, shift = truth
    # The truth is drawn around the estimates, not the other way round: that is the meaning of an estimate's standard
    # deviation. (Landmarks with independent errors make rotations appear smaller, as errors in variables do.)
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
    return LandmarkMatches(
        points=points,
        depth_error=depth_sd * ray,
        image=image,
        feature=np.arange(n),
        prior_weight=np.ones(n),
        rotation=camera.rotation,
        center=camera.center,
        focal=camera.focal,
    )


def make_all_matches(
    rig: Rig,
    truth: tuple[FloatArray, FloatArray],
    seed: int = 0,
    *,
    depth_sd: float = KNOWN,
    depth_off: float = 0.0,
    noise_px: float = 0.0,
    outliers: float = 0.0,
    drawn: bool = False,
) -> list[LandmarkMatches]:
    rng = np.random.default_rng(seed)
    return [
        make_matches(
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


def error(found: AlignmentResult, truth: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Return the (6,) error (w, d): radians and length units."""
    turn = Rotation.from_matrix(truth[0] @ found.rotation.T).as_rotvec()
    return np.concatenate([turn, truth[1] - found.translation])


def degrees(found: AlignmentResult, truth: tuple[FloatArray, FloatArray]) -> float:
    return float(np.rad2deg(np.linalg.norm(error(found, truth)[:3])))


# --- the linear algebra: kernels against their naive twins


def project_landmarks(
    one: LandmarkMatches, surface: FloatArray, rotation: FloatArray, shift: FloatArray
) -> tuple[FloatArray, ...]:
    """Return landmarks relative to g (n, 3), rotated, world axes; their images (n, 2); and the derivatives of these.

    The derivatives are by the point (n, 2, 3) and by the depth error (n, 2).
    """
    turned = (one.points + (stack_matches([one]).basis @ surface)[:, None] * one.depth_error) @ rotation.T
    p = (turned + shift - one.center) @ one.rotation.T
    image = p[:, :2] / p[:, 2:]
    by_camera = np.zeros((len(p), 2, 3))
    by_camera[:, 0, 0] = by_camera[:, 1, 1] = 1.0 / p[:, 2]
    by_camera[:, :, 2] = -image / p[:, 2:]
    by_point = by_camera @ one.rotation
    return turned, image, by_point, np.einsum("nij,nj->ni", by_point, one.depth_error @ rotation.T)


def naive(
    one: LandmarkMatches, surface: FloatArray, rotation: FloatArray, shift: FloatArray, sigma_px: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Compute one camera's d (n,), distances across (n,), weights (n,), and reduced hessian and gradient."""
    turned, image, by_point, b = project_landmarks(one, surface, rotation, shift)
    e, variance = image - one.image, (sigma_px / one.focal) ** 2
    v = variance * np.eye(2) + b[:, :, None] * b[:, None, :]
    distance = np.sqrt(np.einsum("ni,nij,nj->n", e, np.linalg.inv(v), e))
    w = np.maximum(1.0 - (distance / CUTOFF) ** 2, 0.0) ** 2
    least = np.array([w[one.feature == f].min() / (one.feature == f).sum() for f in one.feature])
    w = least * one.prior_weight
    length = np.linalg.norm(b, axis=1)
    unit = b / length[:, None]
    normal = np.column_stack([-unit[:, 1], unit[:, 0]])
    along, across = np.einsum("ni,ni->n", unit, e), np.einsum("ni,ni->n", normal, e)
    # The match's own depth: the mean of its depth error given its residual along the line.
    own = replace(one, points=one.points - (length * along / (variance + length**2))[:, None] * one.depth_error)
    own_turned, _, own_by_point, _ = project_landmarks(own, surface, rotation, shift)

    def rows(direction: FloatArray, turned: FloatArray, by_point: FloatArray) -> FloatArray:
        h = np.einsum("ni,nij->nj", direction, by_point)
        return np.hstack([np.cross(turned, h), h])

    j_along = np.hstack([rows(unit, turned, by_point), length[:, None] * stack_matches([one]).basis])
    j_across = np.hstack([rows(normal, own_turned, own_by_point), np.zeros((len(e), 3))])
    w_along = w / (variance + max(1.0, w.sum() / MAX_INDEPENDENT_MATCHES) * length**2)
    h = (j_along * w_along[:, None]).T @ j_along + (j_across * (w / variance)[:, None]).T @ j_across
    g = j_along.T @ (w_along * along) + j_across.T @ (w / variance * across)
    h[6:, 6:] += np.eye(3)
    g[6:] += surface
    gain = np.linalg.solve(h[6:, 6:], h[6:, :6])
    return distance, across, w, h[:6, :6] - h[:6, 6:] @ gain, g[:6] - gain.T @ g[6:]


def compiled(
    one: LandmarkMatches, surface: FloatArray, rotation: FloatArray, shift: FloatArray, sigma_px: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Compute the same as `naive` by the kernels."""
    stacked, reduced = stack_matches([one]), np.empty((6, 7))
    own = make_camera_state(stacked)
    own.depth_model[0] = surface
    mass = compute_camera_terms(stacked, 0, rotation, shift, sigma_px, True, own, reduced)
    assert mass == pytest.approx(own.weights.sum())
    return own.distance, own.cross_residual, own.weights, reduced[:, :6], reduced[:, 6]


@pytest.mark.parametrize("depth_sd", [1e-4, 0.01, 0.05])
@pytest.mark.parametrize("n", [8, 200])
def test_iteration_matches_naive_implementation(rig: Rig, depth_sd: float, n: int) -> None:
    rng = np.random.default_rng(n)
    one = make_matches(
        rig.cameras[1], motion(5, 0.02), rng, n=n, depth_sd=depth_sd, noise_px=1.0, outliers=0.2, drawn=True
    )
    one = replace(one, feature=rng.integers(0, n // 2, n), prior_weight=rng.uniform(0.1, 1.0, n))
    rotation, shift = motion(5.1, 0.02)
    surface = np.array([0.3, -0.2, 0.1])
    for a, b in zip(
        compiled(one, surface, rotation, shift, 0.7), naive(one, surface, rotation, shift, 0.7), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())


def test_result_solves_the_naive_equations(rig: Rig) -> None:
    truth = motion(5, 0.03)
    matches = make_all_matches(rig, truth, 1, depth_sd=0.03, noise_px=0.5, outliers=0.1, drawn=True)
    found = align(matches, *IDENTITY)
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    for c, one in enumerate(matches):
        *_, h, g = naive(one, found.depth_model[c], found.rotation, found.translation, float(found.sigma_px[c]))
        hessian += h / found.variance_inflation[c]
        gradient += g / found.variance_inflation[c]
    np.testing.assert_allclose(found.information, hessian, rtol=1e-6, atol=1e-8 * np.abs(hessian).max())
    assert gradient @ np.linalg.solve(hessian, gradient) < 0.05**2


def test_rows_are_derivatives(rig: Rig) -> None:
    """Derivatives of the residual, at the surface's depth: exact data, so that the match's own depth is the same."""
    truth = motion(5, 0.02)
    one = make_matches(rig.cameras[2], truth, np.random.default_rng(4), n=8, depth_sd=0.02)
    hessian = compiled(one, np.zeros(3), *truth, 0.7)[3]

    def residuals(x: FloatArray) -> FloatArray:
        turned = Rotation.from_rotvec(x[:3]).as_matrix() @ truth[0]
        return project_landmarks(one, x[6:], turned, truth[1] + x[3:6])[1] - one.image

    h = 1e-6
    jac = np.stack([(residuals(h * k) - residuals(-h * k)) / (2 * h) for k in np.eye(9)], axis=2)
    b = project_landmarks(one, np.zeros(3), *truth)[3]
    inverse = np.linalg.inv((0.7 / one.focal) ** 2 * np.eye(2) + b[:, :, None] * b[:, None, :])
    full = np.einsum("nik,nij,njl->kl", jac, inverse, jac) + np.diag([0.0] * 6 + [1.0] * 3)
    expected = full[:6, :6] - full[:6, 6:] @ np.linalg.solve(full[6:, 6:], full[6:, :6])
    np.testing.assert_allclose(hessian, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def systems(rng: np.random.Generator, off: FloatArray) -> FloatArray:
    """Return (C, 6, 7) terms of C cameras with estimates off (C, 6) of the same pose, at 0: H and -H x."""
    roots = rng.standard_normal((len(off), 12, 6)) * 100.0
    hessians = np.einsum("cki,ckj->cij", roots, roots)
    noise = np.array([np.linalg.cholesky(np.linalg.inv(h)) @ rng.standard_normal(6) for h in hessians])
    return np.concatenate([hessians, -np.einsum("cij,cj->ci", hessians, off + noise)[:, :, None]], axis=2)


def test_disagreement_is_chi_squared() -> None:
    rng = np.random.default_rng(0)
    found = np.empty((200, 4))
    for k in range(200):
        reduced = systems(rng, np.zeros((4, 6)))
        compute_disagreement(reduced, np.ones(4), found[k])
    assert 5.3 < found.mean() < 6.7
    # The difference of two estimates in units of its covariance.
    estimates = [-np.linalg.solve(r[:, :6], r[:, 6]) for r in reduced[1:]]
    others = sum(r[:, :6] for r in reduced[1:])
    mean = np.linalg.solve(others, sum(r[:, :6] @ x for r, x in zip(reduced[1:], estimates, strict=True)))
    gap = -np.linalg.solve(reduced[0, :, :6], reduced[0, :, 6]) - mean
    spread = np.linalg.inv(reduced[0, :, :6]) + np.linalg.inv(others)
    assert found[-1, 0] == pytest.approx(gap @ np.linalg.solve(spread, gap), rel=1e-4)


def test_inflation_of_the_inconsistent_camera_is_smooth() -> None:
    inflations = []
    for size in np.linspace(0.0, 0.2, 21):
        off = np.zeros((4, 6))
        off[1] = size
        prior = np.ones(4)
        for _ in range(10):
            inflate_variances(systems(np.random.default_rng(1), off), prior)
        inflations.append(prior)
    assert (inflations[0] < 2.0).all()
    assert inflations[-1][1] > 100
    assert (np.delete(inflations[-1], 1) < 2.0).all()
    assert (np.diff([d[1] for d in inflations]) > -1e-6).all()


# --- the limits


@pytest.mark.parametrize(("turn", "shift"), [(10, 0.0), (0, 0.15), (10, 0.15)])
@pytest.mark.parametrize("seed", range(4))
def test_exact_without_noise_from_far_away(rig: Rig, turn: float, shift: float, seed: int) -> None:
    # A tenth of the distance is half of the object's size.
    truth = motion(6, 0.03, seed)
    off_turn, off_shift = motion(turn, shift, seed + 10)
    found = align(make_all_matches(rig, truth, seed), off_turn @ truth[0], truth[1] + off_shift)
    assert found.converged
    np.testing.assert_allclose(error(found, truth), 0, atol=1e-6)
    assert found.cost < 1e-3
    assert all((w > 0).all() for w in found.weights)
    assert all(np.abs(r).max() < 1e-2 for r in found.residuals)


@pytest.mark.parametrize("seed", range(3))
def test_known_depths_match_solve_pnp(seed: int) -> None:
    camera, truth = dome(3).cameras[seed], motion(7, 0.04, seed)
    # So little noise that the robust weights are all equal.
    one = make_matches(camera, truth, np.random.default_rng(seed), noise_px=0.02)
    found = align([one], *IDENTITY)
    _, turn, place = cv2.solvePnP(one.points, one.image, np.eye(3), np.zeros(0), flags=cv2.SOLVEPNP_ITERATIVE)
    rotation = camera.rotation.T @ Rotation.from_rotvec(turn.ravel()).as_matrix()
    shift = camera.rotation.T @ place.ravel() + camera.center
    sd = np.sqrt(np.diag(np.linalg.inv(found.information)))
    assert (np.abs(error(found, (rotation, shift))) < 0.02 * sd).all()
    assert degrees(found, truth) < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_unknown_depths_match_epipolar_fit(rig: Rig, seed: int) -> None:
    truth = motion(8, 0.05, seed)
    matches = make_all_matches(rig, truth, seed, depth_sd=UNKNOWN, depth_off=0.02, noise_px=0.02)
    found = align(matches, *IDENTITY)

    def distances(x: FloatArray) -> FloatArray:
        """Return the distances of the points from their epipolar lines, pixels."""
        rotation, shift = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]
        parts = []
        for s in matches:
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
    # The reported residuals are these distances.
    theirs = np.abs(np.concatenate(found.residuals))
    x = np.concatenate([Rotation.from_matrix(found.rotation).as_rotvec(), found.translation])
    np.testing.assert_allclose(theirs, np.abs(distances(x)), atol=5e-3)


def test_information_increases_with_depth_accuracy(rig: Rig) -> None:
    truth = motion(5, 0.03)
    sd = []
    for depth_sd in (UNKNOWN, 0.1, 0.02, KNOWN):
        found = align(make_all_matches(rig, truth, 1, depth_sd=depth_sd, noise_px=0.5), *IDENTITY)
        sd.append(np.sqrt(np.diag(np.linalg.inv(found.information))))
    # Unknown depths contribute no information: beyond that point there is little change.
    assert (np.diff(sd, axis=0) < 0.01 * np.array(sd[1:])).all()
    assert (sd[-1] < 0.9 * sd[0]).all()


# --- starts


@pytest.mark.parametrize("depth_sd", [0.02, 0.1, 0.3])
@pytest.mark.parametrize("turn", [0.0, 1.0, 5.0])
def test_identity_is_not_a_local_minimum(rig: Rig, depth_sd: float, turn: float) -> None:
    truth = motion(turn, 0.01, 5)
    found = align(make_all_matches(rig, truth, 5, depth_sd=depth_sd, depth_off=0.02, noise_px=0.3), *IDENTITY)
    assert found.converged
    assert degrees(found, truth) < 0.25
    assert np.linalg.norm(error(found, truth)[3:]) < 0.002


@pytest.mark.parametrize("depth_sd", [0.02, UNKNOWN])
def test_result_is_independent_of_the_start(rig: Rig, depth_sd: float) -> None:
    truth = motion(6, 0.03, 6)
    matches = make_all_matches(rig, truth, 6, depth_sd=depth_sd, depth_off=0.01, noise_px=0.3)
    a = align(matches, *IDENTITY)
    b = align(matches, *truth)
    c = align(matches, *truth, first_px=4.0)
    sd = np.sqrt(np.diag(np.linalg.inv(a.information)))
    for other in (b, c):
        assert (np.abs(error(a, (other.rotation, other.translation))) < 0.15 * sd).all()
        assert other.cost == pytest.approx(a.cost, rel=0.05)


# --- what is wrong


@pytest.mark.parametrize("seed", range(5))
def test_a_third_of_outliers(rig: Rig, seed: int) -> None:
    truth = motion(6, 0.03, seed)
    clean, found = (
        align(
            make_all_matches(rig, truth, seed, outliers=share, depth_sd=0.03, depth_off=0.02, noise_px=0.4), *IDENTITY
        )
        for share in (0.0, 0.3)
    )
    assert found.converged
    assert degrees(found, truth) < max(0.25, 3 * degrees(clean, truth))
    assert np.linalg.norm(error(found, truth)[3:]) < 0.003
    for w in found.weights:
        assert 0.55 < (w > 0).mean() < 0.9
    assert found.cost > clean.cost


def make_faulty_camera(one: LandmarkMatches, camera: Camera, how: str, rng: np.random.Generator) -> LandmarkMatches:
    """Return a faulty camera: random matches, or a static image."""
    if how == "junk":
        return replace(one, image=one.image[rng.permutation(len(one.image))])
    still = camera.normalize(camera.project(one.points))
    return replace(one, image=still + 5e-5 * rng.standard_normal(still.shape))


@pytest.mark.parametrize("how", ["junk", "frozen"])
@pytest.mark.parametrize("n", [60, 300])
@pytest.mark.parametrize("seed", range(4))
def test_faulty_camera_is_rejected(rig: Rig, how: str, n: int, seed: int) -> None:
    """Also when it has most of the matches."""
    truth, rng = motion(5, 0.03, seed), np.random.default_rng(seed)
    matches = [
        make_matches(camera, truth, rng, n=n if c == 2 else 60, depth_sd=0.02, noise_px=0.4, drawn=True)
        for c, camera in enumerate(rig)
    ]
    matches[2] = make_faulty_camera(matches[2], rig.cameras[2], how, rng)
    found = align(matches, *IDENTITY)
    without = align([s for c, s in enumerate(matches) if c != 2], *IDENTITY)
    e, fair = error(found, truth), error(without, truth)
    sd = np.sqrt(np.diag(np.linalg.inv(without.information)))
    assert (np.abs(e) < np.maximum(2 * np.abs(fair), 2 * sd)).all()
    assert (found.weights[2] > 0).mean() < 0.2 or found.variance_inflation[2] > 5
    # The faulty one must not contribute spurious information.
    ratio = np.trace(np.linalg.inv(found.information)) / np.trace(np.linalg.inv(without.information))
    assert 0.7 < ratio < 1.4


@pytest.mark.parametrize("bad", [60, 120])
def test_miscalibrated_camera_is_down_weighted(rig: Rig, bad: int) -> None:
    """By two degrees: its landmarks are as wrong as its observations, so its matches agree on another motion."""
    camera, ratios, inflations = rig.cameras[1], [], []
    for seed in range(12):
        truth, rng = motion(5, 0.03, seed), np.random.default_rng(seed)
        matches = [
            make_matches(c, truth, rng, n=bad if c is camera else 60, depth_sd=0.005, noise_px=0.4, drawn=True)
            for c in rig
        ]
        off = motion(2.0, 0.0, seed + 50)[0]
        matches[1] = replace(
            matches[1],
            points=camera.center + (matches[1].points - camera.center) @ off.T,
            depth_error=matches[1].depth_error @ off.T,
            rotation=camera.rotation @ off.T,
        )
        found, without = align(matches, *IDENTITY), align([matches[0], *matches[2:]], *IDENTITY)
        e, fair = error(found, truth), error(without, truth)
        ratios.append((e @ without.information @ e, fair @ without.information @ fair))
        inflations.append(found.variance_inflation)
    joint, by_hand = np.sqrt(np.median(ratios, axis=0))
    assert joint < 2 * by_hand
    assert np.median(np.argmax(inflations, axis=1)) == 1


def test_two_disagreeing_cameras_are_both_inflated() -> None:
    rig = ring(2, 1.5, 1000.0, height=(0.4, -0.3))
    rng = np.random.default_rng(0)
    one, other = motion(5, 0.03), motion(5.5, 0.03)
    traces = []
    for truths in ((one, one), (one, other)):
        pairs = zip(rig, truths, strict=True)
        found = align([make_matches(c, truth, rng, depth_sd=1e-3, noise_px=0.3) for c, truth in pairs], *IDENTITY)
        traces.append(np.trace(np.linalg.inv(found.information)))
    assert (found.variance_inflation > 1.5).all()
    assert traces[1] > 1.5 * traces[0]


def test_landmarks_behind_a_camera_are_outliers(rig: Rig) -> None:
    truth = motion(5, 0.02)
    matches = make_all_matches(rig, truth, 2, depth_sd=0.02, noise_px=0.3)
    points = matches[0].points.copy()
    points[:5] = 2 * rig.cameras[0].center - points[:5]
    matches[0] = replace(matches[0], points=points)
    found = align(matches, *IDENTITY)
    assert (found.weights[0][:5] == 0).all()
    assert degrees(found, truth) < 0.2


# --- uncertainty ----------


def test_information_is_consistent() -> None:
    """Normalized squared errors (NEES) of landmarks drawn from their model: 6 for 6 unknowns."""
    rig = ring(3, 1.5, 1000.0, height=(0.4, -0.1, 0.2))
    nees = []
    for seed in range(60):
        truth = motion(4, 0.02, seed)
        matches = make_all_matches(rig, truth, seed, depth_sd=0.03, noise_px=0.5, drawn=True)
        found = align(matches, *IDENTITY)
        e = error(found, truth)
        nees.append(float(e @ found.information @ e))
    assert 4 < np.mean(nees) < 9


def test_feature_matched_twice_counts_once(rig: Rig) -> None:
    truth = motion(5, 0.03)
    once = make_all_matches(rig, truth, 3, depth_sd=0.03, depth_off=0.02, noise_px=0.4)
    twice = [
        replace(
            s,
            points=np.tile(s.points, (2, 1)),
            depth_error=np.tile(s.depth_error, (2, 1)),
            image=np.tile(s.image, (2, 1)),
            feature=np.tile(s.feature, 2),
            prior_weight=np.tile(s.prior_weight, 2),
        )
        for s in once
    ]
    a, b = align(once, *IDENTITY), align(twice, *IDENTITY)
    np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-9)
    np.testing.assert_allclose(a.translation, b.translation, atol=1e-9)
    np.testing.assert_allclose(a.information, b.information, rtol=1e-6, atol=1e-6 * np.abs(a.information).max())
    assert len(b.weights[0]) == len(b.residuals[0]) == 2 * len(a.weights[0])


def test_contradicting_landmark_rejects_its_feature(rig: Rig) -> None:
    truth = motion(5, 0.03)
    matches = make_all_matches(rig, truth, 4, depth_sd=0.02, noise_px=0.3)
    first = matches[0]
    wrong = first.points[:1] + 0.06 * rig.cameras[0].rotation[:1]
    matches[0] = replace(
        first,
        points=np.concatenate([first.points, wrong]),
        depth_error=np.concatenate([first.depth_error, first.depth_error[:1]]),
        image=np.concatenate([first.image, first.image[:1]]),
        feature=np.append(first.feature, 0),
        prior_weight=np.append(first.prior_weight, 1.0),
    )
    found = align(matches, *IDENTITY)
    assert found.weights[0][0] == found.weights[0][-1] == 0
    assert (found.weights[0][1:-1] > 0).mean() > 0.9


def test_trust_affects_the_result(rig: Rig) -> None:
    # Two halves of the landmarks move slightly differently: the half with the larger `trust` dominates.
    one, other = motion(4.0, 0.02, 1), motion(4.4, 0.02, 1)
    halves = [make_all_matches(rig, truth, 7, noise_px=0.1, depth_sd=0.01) for truth in (one, other)]
    for trust in (1e-3, 1.0):
        matches = [
            replace(
                a,
                image=np.where((np.arange(60) % 2 == 0)[:, None], a.image, b.image),
                prior_weight=np.where(np.arange(60) % 2 == 0, 1.0, trust),
            )
            for a, b in zip(*halves, strict=True)
        ]
        found = align(matches, *IDENTITY, first_px=16.0)
        if trust < 1:
            assert degrees(found, one) < 0.1


def select_matches(one: LandmarkMatches, index: IntArray) -> LandmarkMatches:
    """Return some of a camera's matches, each of a separate feature."""
    return replace(
        one,
        points=one.points[index],
        depth_error=one.depth_error[index],
        image=one.image[index],
        feature=np.arange(len(index)),
        prior_weight=one.prior_weight[index],
    )


@pytest.mark.parametrize("what", ["nothing", "one match", "two matches", "behind", "one point", "no trust"])
def test_underdetermined_pose_is_not_converged(rig: Rig, what: str) -> None:
    matches = make_all_matches(rig, motion(5, 0.03), 1, depth_sd=0.02, noise_px=0.3)
    for c, one in enumerate(matches):
        n = {"one match": 1, "two matches": 2}.get(what, 0) if c == 1 else 0
        if what == "behind":
            matches[c] = replace(one, points=2 * one.center - one.points)
        elif what == "one point":
            matches[c] = select_matches(one, np.zeros(5, np.int64))
        elif what == "no trust":
            matches[c] = replace(one, prior_weight=np.zeros(len(one.prior_weight)))
        else:
            matches[c] = select_matches(one, np.arange(n))
    found = align(matches, *IDENTITY)
    if what != "one point":
        assert not found.converged
    for part in (
        found.rotation,
        found.translation,
        found.information,
        found.sigma_px,
        found.variance_inflation,
        *found.weights,
    ):
        assert np.isfinite(part).all()
    assert np.isfinite(found.cost)


def test_no_cameras_are_rejected() -> None:
    with pytest.raises(ValueError, match="one camera"):
        align([], *IDENTITY)


@pytest.mark.parametrize("empty", [[0], [0, 2], [0, 1, 2]])
def test_cameras_without_matches(rig: Rig, empty: Sequence[int]) -> None:
    truth = motion(5, 0.03)
    matches = make_all_matches(rig, truth, 8, depth_sd=0.02, noise_px=0.3)
    for c in empty:
        matches[c] = select_matches(matches[c], np.arange(0))
    found = align(matches, *IDENTITY)
    assert degrees(found, truth) < 1.0
    assert all(len(found.weights[c]) == len(found.residuals[c]) == 0 for c in empty)


def test_alignment_is_deterministic(rig: Rig) -> None:
    matches = make_all_matches(rig, motion(5, 0.03), 9, depth_sd=0.03, noise_px=0.5, outliers=0.2)
    a, b = align(matches, *IDENTITY), align(matches, *IDENTITY)
    np.testing.assert_array_equal(a.rotation, b.rotation)
    np.testing.assert_array_equal(a.information, b.information)


# --- one camera among others


def roundtrip_message(reported: T) -> T:
    """Return a message as received: numbers only, in an iteration at most 256 bytes including overhead."""
    values = [getattr(reported, f.name) for f in fields(cast(Any, reported))]
    wire = b"".join(np.asarray(value, float).tobytes() for value in values)
    assert len(wire) <= 232
    numbers = np.frombuffer(wire)
    if len(numbers) == 29:
        return cast(T, TermsMessage(numbers[:27], *numbers[27:].tolist()))
    return type(reported)(*(type(value)(x) for value, x in zip(values, numbers.tolist(), strict=True)))


def align_in_threads(
    matches: Sequence[LandmarkMatches],
    starts: Sequence[AlignmentStart] = ((*IDENTITY, FIRST_PX),),
    *,
    compact: bool = False,
) -> tuple[list[list[AlignmentResult]], int]:
    """Run every camera in a separate thread, connected by messages; return the results and the number of rounds."""
    n = len(matches)
    sent: list[Any] = [None] * n
    together, rounds = Barrier(n), [0] * n

    def one(c: int) -> list[AlignmentResult]:
        def exchange(reported: tuple[T, ...], nothing: tuple[T, ...], /) -> list[tuple[T, ...]]:  # noqa: ARG001
            rounds[c] += 1
            sent[c] = tuple(roundtrip_message(part) for part in reported)
            together.wait(60)
            received = list(sent)
            together.wait(60)  # no one sends again before all have read
            return received

        return DistributedAligner(matches[c], c, n, exchange, compact=compact).align(starts)

    with ThreadPoolExecutor(n) as pool:
        return list(pool.map(one, range(n))), rounds[0]


@pytest.mark.parametrize("how", ["all well", "one camera is junk", "one camera sees nothing"])
def test_distributed_result_is_bit_identical(rig: Rig, how: str) -> None:
    truth, rng = motion(5, 0.03), np.random.default_rng(0)
    matches = make_all_matches(rig, truth, 3, depth_sd=0.02, noise_px=0.4, outliers=0.1, drawn=True)
    if how == "one camera is junk":  # each is left out once
        matches[2] = make_faulty_camera(matches[2], rig.cameras[2], "junk", rng)
    if how == "one camera sees nothing":
        matches[1] = select_matches(matches[1], np.arange(0))
    here = align(matches, *IDENTITY)
    for c, (found,) in enumerate(align_in_threads(matches)[0]):
        for name in ("rotation", "translation", "information", "sigma_px", "variance_inflation", "inliers"):
            np.testing.assert_array_equal(getattr(found, name), getattr(here, name))
        assert (found.cost, found.reference_cost, found.converged, found.iterations) == (
            here.cost,
            here.reference_cost,
            here.converged,
            here.iterations,
        )
        np.testing.assert_array_equal(found.weights[0], here.weights[c])
        np.testing.assert_array_equal(found.residuals[0], here.residuals[c])
        np.testing.assert_array_equal(found.depth_model[0], here.depth_model[c])


@pytest.mark.parametrize("how", ["all well", "one camera is junk", "one camera sees nothing", "a bad prediction"])
def test_compact_mode_is_nearly_equal(rig: Rig, how: str) -> None:
    truth, rng = motion(8 if how == "a bad prediction" else 3, 0.03), np.random.default_rng(0)
    matches = make_all_matches(rig, truth, 5, depth_sd=0.02, noise_px=0.4, outliers=0.1, drawn=True)
    if how == "one camera is junk":
        matches[2] = make_faulty_camera(matches[2], rig.cameras[2], "junk", rng)
    if how == "one camera sees nothing":
        matches[1] = select_matches(matches[1], np.arange(0))
    here = align(matches, *IDENTITY)
    found, rounds = align_in_threads(matches, [(*IDENTITY, FIRST_PX), (*IDENTITY, 8.0)], compact=True)
    first = found[0][0]
    # The last one measures the pose's quality.
    assert rounds <= 6 + (how == "one camera is junk")
    for both in found:
        for one in both:  # two starts, one pose
            np.testing.assert_array_equal(one.rotation, first.rotation)
            np.testing.assert_array_equal(one.variance_inflation, first.variance_inflation)
    off = np.append(
        Rotation.from_matrix(first.rotation @ here.rotation.T).as_rotvec(), first.translation - here.translation
    )
    assert first.converged
    assert 0 < off @ here.information @ off < 0.3**2
    np.testing.assert_allclose(np.diag(first.information), np.diag(here.information), rtol=0.2)
