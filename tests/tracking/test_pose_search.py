"""Noise estimate of inliers: robust against a few low-contrast features with large residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.rig import Rig
from sylpose.tracking.camera_side.frame import estimate_noise
from sylpose.tracking.pose_search import find_translation
from sylpose.tracking.reports import RelocalizationMatches
from tests.clips import make_rotated_pose, moving_scene


def test_noise_of_gaussian_residuals() -> None:
    off = np.random.default_rng(0).normal(0.0, 0.7, 20_000)
    assert estimate_noise(off) == pytest.approx(0.7, rel=0.02)


def test_noise_is_at_most_rms() -> None:
    """Residuals spread evenly around a wrong pose keep their rms."""
    off = np.random.default_rng(1).uniform(-3.0, 3.0, 20_000)
    assert estimate_noise(off) == pytest.approx(3.0 / np.sqrt(3.0), rel=0.02)


def test_few_outliers_hardly_count() -> None:
    rng = np.random.default_rng(2)
    off = np.concatenate([rng.normal(0.0, 0.5, 800), rng.uniform(-4.0, 4.0, 200)])
    assert estimate_noise(off) < 0.75 < np.sqrt(np.mean(off**2))
    assert estimate_noise(-off) == estimate_noise(off)


def test_noise_without_residuals_is_nan() -> None:
    assert np.isnan(estimate_noise(np.empty(0)))
    assert estimate_noise(np.array([-2.0])) == 2.0


RADIUS, POSE = 0.1, make_rotated_pose(20.0)
TRANSLATION = 0.5 * RADIUS * np.array([0.6, 0.0, 0.8])


def make_matches(rig: Rig, outlier_ratio: float, n: int = 200) -> list[RelocalizationMatches]:
    """Return each camera's matches at the translated pose; outliers are up to twice the translation away."""
    rng, n_true, matches = np.random.default_rng(3), round((1.0 - outlier_ratio) * n), []
    for camera in rig:
        points = rng.uniform(-0.5, 0.5, (n, 3)) * RADIUS
        pixels = camera.project(POSE.apply(points) + TRANSLATION)
        moved = camera.project(POSE.apply(points)) - pixels
        reach = 2.0 * np.linalg.norm(moved, axis=1).max()
        pixels[n_true:] += moved[n_true:] + rng.uniform(-reach, reach, (n - n_true, 2))
        matches.append(RelocalizationMatches(points, pixels))
    return matches


def make_rig(n_cameras: int) -> Rig:
    return moving_scene(make_rotated_pose, 1, n_cameras=n_cameras).rig


@pytest.mark.parametrize("outlier_ratio", [0.0, 0.8])
def test_translation_is_exact_despite_outliers(outlier_ratio: float) -> None:
    rig = make_rig(3)
    found = find_translation(rig, make_matches(rig, outlier_ratio), POSE, RADIUS, 0)
    assert np.linalg.norm(found - TRANSLATION) < 0.002 * RADIUS


def test_translation_of_single_camera() -> None:
    """Along its optical axis it is uncertain."""
    rig = make_rig(1)
    error = find_translation(rig, make_matches(rig, 0.8), POSE, RADIUS, 0) - TRANSLATION
    axis = rig.cameras[0].rotation[2]
    assert np.linalg.norm(error - axis * (axis @ error)) < 0.05 * RADIUS
    assert np.linalg.norm(error) < RADIUS


def test_translation_is_equivariant() -> None:
    """In another world frame it is the same vector, rotated."""
    rig = make_rig(3)
    matches = make_matches(rig, 0.8)
    moved = RigidTransform.from_components([0.3, -2.0, 1.0], Rotation.from_rotvec([1.0, 0.5, -2.0]))
    cameras = (replace(c, camera_from_world=c.camera_from_world * moved.inv()) for c in rig)
    found = find_translation(Rig(tuple(cameras)), matches, moved * POSE, RADIUS, 0)
    expected = moved.rotation.apply(find_translation(rig, matches, POSE, RADIUS, 0))
    assert np.allclose(found, expected, rtol=0.0, atol=1e-9 * RADIUS)


def test_translation_without_matches_is_zero() -> None:
    assert not find_translation(make_rig(2), [RelocalizationMatches()] * 2, POSE, RADIUS, 0).any()
