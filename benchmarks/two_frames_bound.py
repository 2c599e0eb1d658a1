"""The Cramer-Rao bound of a scene: the least covariance that any unbiased estimator can have, from the true geometry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.two_frames_scenes import Scene
from sylpose.geometry.arrays import FloatArray

__all__ = ["bounds", "sampled_errors"]


SAMPLES = 200


def bounds(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Covariances (6, 6) of (w, d), docs/conventions.md, with depths that are not known and with depths that are.

    The inliers are taken as known. Each point's true place in image i is eliminated: y has the noise
    V = sigma^2 (I + Jx Jx'). Without its depth, only what is normal to its epipolar line in y tells of the motion: along
    it, the depth takes all up.
    For the problem "pose" both are the one bound of points known in 3D.
    """
    unknown, known = np.zeros((6, 6)), np.zeros((6, 6))
    center = scene.truth.apply(scene.center)
    turn = scene.truth.rotation.as_matrix()
    for camera, points in zip(scene.rig, scene.points, strict=True):
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            continue
        moved = scene.truth.apply(points)
        by_place = camera.focal * _projection_jacobian(camera.camera_from_world.apply(moved)) @ camera.rotation
        jacobian = np.concatenate([by_place @ -_cross(moved - center), by_place], axis=2)
        if scene.problem == "pose":
            information = np.einsum("nia,nib->ab", jacobian, jacobian) / scene.noise**2
            unknown += information
            known += information
            continue
        seen = camera.camera_from_world.apply(points)
        depth = seen[:, 2, None, None]
        by_seen = by_place @ turn @ camera.rotation.T
        jx = by_seen[:, :, :2] * depth / camera.focal
        noise = scene.noise**2 * (np.eye(2) + jx @ jx.transpose(0, 2, 1))
        known += np.einsum("nia,nib->ab", jacobian, np.linalg.solve(noise, jacobian))
        along = (by_seen @ (seen / seen[:, 2:])[:, :, None])[:, :, 0]
        normal = np.column_stack([-along[:, 1], along[:, 0]])
        row = np.einsum("ni,nia->na", normal, jacobian)
        unknown += (row / np.einsum("ni,nij,nj->n", normal, noise, normal)[:, None]).T @ row
    return np.asarray(np.linalg.pinv(unknown, hermitian=True)), np.asarray(np.linalg.pinv(known, hermitian=True))


def sampled_errors(covariances: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Errors that an estimator at the bound would make, degrees and mm: Gaussian, 200 per covariance (6, 6).

    Their median and percentiles are comparable with those of an estimator's errors over the same scenes.
    """
    rng = np.random.default_rng(0)
    factors = []
    for covariance in covariances:
        values, vectors = np.linalg.eigh(covariance)
        factors.append(vectors * np.sqrt(np.maximum(values, 0.0)))
    errors = np.einsum("sij,skj->ski", np.array(factors), rng.standard_normal((len(factors), SAMPLES, 6))).reshape(
        -1, 6
    )
    turns, shifts = np.linalg.norm(errors[:, :3], axis=1), np.linalg.norm(errors[:, 3:], axis=1)
    return np.asarray(np.rad2deg(turns)), np.asarray(1e3 * shifts)


def _projection_jacobian(points: FloatArray) -> FloatArray:
    """(n, 2, 3) of (X/Z, Y/Z) by (X, Y, Z)."""
    out = np.zeros((len(points), 2, 3))
    out[:, 0, 0] = out[:, 1, 1] = 1 / points[:, 2]
    out[:, :, 2] = -points[:, :2] / points[:, 2:] ** 2
    return out


def _cross(vectors: FloatArray) -> FloatArray:
    """(n, 3, 3) matrices of the cross product by each vector."""
    return np.asarray(np.cross(vectors[:, None, :], np.eye(3)).transpose(0, 2, 1))
