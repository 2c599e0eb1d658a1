"""Known noise of the cameras in `estimate_pose`, by Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.absolute_pose.pose import estimate_pose
from sylpose.geometry.arrays import FloatArray
from sylpose.results import Motion
from sylpose.rig import Rig
from sylpose.simulate import arc, dome
from sylpose.status import Status

UNEQUAL = np.array([0.2, 0.5, 1.0, 4.0])
TAG = np.array([[-0.08, -0.08, 0.0], [0.08, -0.08, 0.0], [0.08, 0.08, 0.0], [-0.08, 0.08, 0.0]])

Scene = tuple[Rig, list[FloatArray], list[FloatArray], RigidTransform]


def scene(seed: int, noise_px: FloatArray, per_camera: int, tag: bool = False) -> Scene:
    """Return points in a cube, different for each camera, or the corners of a tag."""
    rng = np.random.default_rng(seed)
    rig = dome(len(noise_px)) if len(noise_px) > 3 else arc(len(noise_px), 50.0, height=0.3)
    truth = RigidTransform.from_components(rng.uniform(-0.1, 0.1, 3), Rotation.random(rng=rng))
    points = [TAG if tag else rng.uniform(-0.1, 0.1, (per_camera, 3)) for _ in rig]
    seen = zip(rig, points, noise_px, strict=True)
    pixels = [camera.project(truth.apply(p)) + px * rng.normal(size=(len(p), 2)) for camera, p, px in seen]
    return rig, points, pixels, truth


def compute_pose_error(found: Motion, truth: RigidTransform) -> tuple[float, float]:
    """Return the rotation error, radians, and the squared error in units of its covariance."""
    assert found.motion is not None, found.status
    turn = (truth.rotation * found.motion.rotation.inv()).as_rotvec()
    error = np.concatenate([turn, truth.apply(found.center) - found.motion.apply(found.center)])
    return float(np.linalg.norm(turn)), float(error @ np.linalg.solve(found.covariance, error))


@pytest.mark.parametrize(
    ("noise_px", "per_camera", "tag"),
    [(UNEQUAL, 20, False), (UNEQUAL, 3, False), (np.array([0.3, 2.0]), 4, True), (np.array([0.5]), 4, True)],
)
def test_covariance_is_consistent_for_unequal_noise(noise_px: FloatArray, per_camera: int, tag: bool) -> None:
    squares, turns, alone = [], [], []
    for seed in range(100):
        rig, points, pixels, truth = scene(seed, noise_px, per_camera, tag)
        found = estimate_pose(rig, points, pixels, noise_px=noise_px)
        if found.status is Status.ROTATION_NOT_OBSERVABLE and tag:  # flat, its mirrored pose is as good
            continue
        turn, square = compute_pose_error(found, truth)
        squares.append(square)
        turns.append(turn)
        if (
            default_result := estimate_pose(rig, points, pixels)
        ).motion is not None:  # without known noise less is determined
            alone.append(compute_pose_error(default_result, truth)[0])
    assert len(squares) > 90
    # Six unknowns: the mean of a hundred has a standard deviation of 0.35. Few matches over- and underestimate the
    # noise equally often, and only overestimates take effect.
    assert 4.0 < np.mean(squares) < 7.0
    if len(noise_px) > 1 and per_camera < 20:
        assert np.sqrt(np.mean(np.square(turns))) < 0.7 * np.sqrt(np.mean(np.square(alone)))


def test_sigma_is_proportional_to_noise() -> None:
    ratios = []
    for seed in range(20):
        sigmas = []
        for factor in (0.5, 1.0):
            rig, points, pixels, _ = scene(seed, factor * UNEQUAL, 20)
            found = estimate_pose(rig, points, pixels, noise_px=factor * UNEQUAL)
            sigmas.append(np.sqrt(np.diag(found.covariance)))
        ratios.append(sigmas[1] / sigmas[0])
    assert np.median(ratios) == pytest.approx(2.0, rel=0.03)


def test_camera_with_infinite_noise_is_ignored() -> None:
    rig, points, pixels, truth = scene(1, np.full(4, 0.5), 12)
    pixels[1] = pixels[1][::-1].copy()
    found = estimate_pose(rig, points, pixels, noise_px=[0.5, np.inf, 0.5, 0.5])
    points[1], pixels[1] = points[1][:0], pixels[1][:0]
    without = estimate_pose(rig, points, pixels, noise_px=[0.5] * 4)
    assert found.motion is not None
    assert without.motion is not None
    np.testing.assert_array_equal(found.motion.as_matrix(), without.motion.as_matrix())
    np.testing.assert_array_equal(found.covariance, without.covariance)
    assert [len(mask) for mask in found.inliers] == [12] * 4
    assert not found.inliers[1].any()
    np.testing.assert_allclose(found.residuals[[0, 2, 3]], 0.5 * np.sqrt(2.0), rtol=0.4)
    assert compute_pose_error(found, truth)[1] < 40.0
    nobody = estimate_pose(rig, points, pixels, noise_px=[np.inf] * 4)
    assert nobody.status is Status.TOO_FEW_MATCHES


def test_max_error_scales_with_noise() -> None:
    rig, points, pixels, _ = scene(2, np.full(4, 0.1), 12)
    pixels[0][0] += 3.0
    pixels[3][0] += 3.0
    for noise_px, kept in ((None, False), ([0.1] * 4, False), ([0.1, 0.1, 0.1, 1.0], True)):
        found = estimate_pose(rig, points, pixels, noise_px=noise_px)
        assert not found.inliers[0][0]
        assert found.inliers[3][0] == kept
        assert all(mask[1:].all() for mask in found.inliers)


@pytest.mark.parametrize("wrong", [[0.5], [0.5, 0.5, 0.0, 0.5], [0.5, np.nan, 1, 1]])
def test_invalid_noise_is_rejected(wrong: list[float]) -> None:
    rig, points, pixels, _ = scene(0, UNEQUAL, 5)
    with pytest.raises(ValueError, match="noise_px"):
        estimate_pose(rig, points, pixels, noise_px=wrong)
