"""Cramér-Rao bound of a scene: the least covariance of any unbiased estimator, from the true geometry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.two_frames_scenes import Scene
from sylpose.geometry.arrays import FloatArray

__all__ = ["compute_bounds", "sample_errors"]


N_SAMPLES = 200


def compute_bounds(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Compute the bounds (6, 6) of (w, d), docs/conventions.md, with unknown depths and with known depths.

    The inliers are taken as known. Each point's true position in image i is eliminated: y has the noise
    V = sigma^2 (I + Jx Jx'). With unknown depth, only the component of y normal to its epipolar line constrains the motion;
    the depth absorbs the component along the line. For the problem "pose" both are the bound of points known in 3D.
    """
    unknown, known = np.zeros((6, 6)), np.zeros((6, 6))
    center = scene.truth.apply(scene.center)
    rotation = scene.truth.rotation.as_matrix()
    for camera, points in zip(scene.rig, scene.points, strict=True):
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            continue
        moved = scene.truth.apply(points)
        point_jacobian = camera.focal * _projection_jacobian(camera.camera_from_world.apply(moved)) @ camera.rotation
        jacobian = np.concatenate([point_jacobian @ -_cross(moved - center), point_jacobian], axis=2)
        if scene.problem == "pose":
            information = np.einsum("nia,nib->ab", jacobian, jacobian) / scene.noise**2
            unknown += information
            known += information
            continue
        camera_points = camera.camera_from_world.apply(points)
        depth = camera_points[:, 2, None, None]
        camera_jacobian = point_jacobian @ rotation @ camera.rotation.T
        jx = camera_jacobian[:, :, :2] * depth / camera.focal
        noise = scene.noise**2 * (np.eye(2) + jx @ jx.transpose(0, 2, 1))
        known += np.einsum("nia,nib->ab", jacobian, np.linalg.solve(noise, jacobian))
        line_direction = (camera_jacobian @ (camera_points / camera_points[:, 2:])[:, :, None])[:, :, 0]
        normal = np.column_stack([-line_direction[:, 1], line_direction[:, 0]])
        row = np.einsum("ni,nia->na", normal, jacobian)
        unknown += (row / np.einsum("ni,nij,nj->n", normal, noise, normal)[:, None]).T @ row
    return np.asarray(np.linalg.pinv(unknown, hermitian=True)), np.asarray(np.linalg.pinv(known, hermitian=True))


def sample_errors(covariances: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Sample Gaussian errors of an estimator at the bound, degrees and mm: 200 per covariance (6, 6).

    Their median and percentiles are comparable with those of an estimator's errors over the same scenes.
    """
    rng = np.random.default_rng(0)
    factors = []
    for covariance in covariances:
        values, vectors = np.linalg.eigh(covariance)
        factors.append(vectors * np.sqrt(np.maximum(values, 0.0)))
    errors = np.einsum("sij,skj->ski", np.array(factors), rng.standard_normal((len(factors), N_SAMPLES, 6))).reshape(
        -1, 6
    )
    rotation_errors, translation_errors = np.linalg.norm(errors[:, :3], axis=1), np.linalg.norm(errors[:, 3:], axis=1)
    return np.asarray(np.rad2deg(rotation_errors)), np.asarray(1e3 * translation_errors)


def _projection_jacobian(points: FloatArray) -> FloatArray:
    """Return the Jacobians (n, 2, 3) of (X/Z, Y/Z) with respect to (X, Y, Z)."""
    out = np.zeros((len(points), 2, 3))
    out[:, 0, 0] = out[:, 1, 1] = 1 / points[:, 2]
    out[:, :, 2] = -points[:, :2] / points[:, 2:] ** 2
    return out


def _cross(vectors: FloatArray) -> FloatArray:
    """Return the cross-product matrices (n, 3, 3) of the vectors."""
    return np.asarray(np.cross(vectors[:, None, :], np.eye(3)).transpose(0, 2, 1))
