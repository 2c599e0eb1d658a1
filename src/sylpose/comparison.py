"""Absolute and relative trajectory errors (ATE and RPE) after alignment.

J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; S. Umeyama, "Least-squares
estimation of transformation parameters between two point patterns", PAMI 1991.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray, IntArray

Alignment = Literal["first", "none", "se3", "sim3", "both"]
# Positions whose second singular value is below this fraction of the first do not determine the rotation about their
# line; the same holds for rotations about one axis (choice: noise of a thousandth of the path gives about a degree).
MIN_SPREAD_RATIO = 1e-3
# Iterations until the rotations of both frames converge (derived: each reduces the error by the fraction of rotations
# about one axis).
MAX_ITERATIONS = 100


@dataclass(frozen=True, eq=False)
class Comparison:
    """Errors of poses T_k in the frames of the reference poses Q_k.

    Attributes:
        align: the alignment that was applied.
        n_reference: number of reference poses; `len(times)` of them have a corresponding pose and are compared.
        times: (n,) of the reference poses.
        estimate, reference: n poses each; the former are aligned.
        scale: factor applied to the lengths of the compared trajectory: 1 except for "sim3".
        rotation: (n,) rotation angles of Q_k⁻¹ T_k, radians.
        position: (n,) distances between the origins.
        relative_rotation, relative_position: (n - step,) of (Q_k⁻¹ Q_k+step)⁻¹ (T_k⁻¹ T_k+step).
    """

    align: Alignment
    n_reference: int
    times: FloatArray
    estimate: RigidTransform
    reference: RigidTransform
    scale: float
    rotation: FloatArray
    position: FloatArray
    relative_rotation: FloatArray
    relative_position: FloatArray


def compare_trajectories(
    times: FloatArray,
    poses: RigidTransform,
    reference_times: FloatArray,
    reference: RigidTransform,
    *,
    align: Alignment = "first",
    step: int = 1,
    max_time_diff: float | None = None,
) -> Comparison:
    """Compute the errors of m poses against n reference poses.

    Args:
        times, reference_times: (m,), (n,) increasing.
        poses, reference: m and n poses.
        align: what may differ. "first": the object frames: T_k becomes T_k T_0⁻¹ Q_0, motions since the first common
            pose. "none": nothing. "se3": the world frames, by a rotation and translation that fit the positions best;
            "sim3": also by a scale. "both": the world and object frames, which fit first the rotations, then the
            positions.
        step: number of poses between the two of a relative error.
        max_time_diff: largest time difference of corresponding poses; None for half of the reference's smallest step.

    Raises:
        ValueError: unknown alignment; fewer than two corresponding poses, or not more than the step; positions on a
            line, or rotations about one axis, which do not determine the alignment.
    """
    if align not in get_args(Alignment):
        raise ValueError(f"align must be one of {', '.join(get_args(Alignment))}, got {align!r}")
    if step < 1:
        raise ValueError(f"step must be at least 1, got {step}")
    indices, reference_indices = associate_timestamps(times, reference_times, max_time_diff)
    if len(indices) < max(2, step + 1):
        raise ValueError(
            f"{len(indices)} of {len(reference_times)} poses have a corresponding pose at their time; "
            f"{max(2, step + 1)} are needed"
        )
    estimate, matched_reference, scale = poses[indices], reference[reference_indices], 1.0
    if align == "first":
        estimate = estimate * estimate[0].inv() * matched_reference[0]
    elif align in ("se3", "sim3"):
        rotation, translation, scale = _align_umeyama(
            estimate.translation, matched_reference.translation, align == "sim3"
        )
        positions = scale * rotation.apply(estimate.translation) + translation
        estimate = RigidTransform.from_components(positions, rotation * estimate.rotation)
    elif align == "both":
        estimate = _align_both_frames(estimate, matched_reference)
    errors = matched_reference.inv() * estimate
    relative = (matched_reference[:-step].inv() * matched_reference[step:]).inv() * (
        estimate[:-step].inv() * estimate[step:]
    )
    position = np.linalg.norm(estimate.translation - matched_reference.translation, axis=1)
    absolute_errors = np.asarray(errors.rotation.magnitude()), position
    relative_errors = np.asarray(relative.rotation.magnitude()), np.linalg.norm(relative.translation, axis=1)
    compared = np.asarray(reference_times)[reference_indices], estimate, matched_reference, scale
    return Comparison(align, len(reference_times), *compared, *absolute_errors, *relative_errors)


def associate_timestamps(
    times: FloatArray, others: FloatArray, max_time_diff: float | None = None
) -> tuple[IntArray, IntArray]:
    """Associate each of `others` with the nearest of `times`, if it is close enough.

    Args:
        times, others: (m,), (n,) increasing.
        max_time_diff: largest difference; None for half of the smallest step of `others`.

    Returns:
        indices into `times` and into `others` of the pairs.

    Raises:
        ValueError: times that do not increase; fewer than two of `others` where `max_time_diff` is None; an invalid
            `max_time_diff`.
    """
    for row in (times, others):
        if (np.diff(row) <= 0).any():
            raise ValueError("times must increase")
    if max_time_diff is None:
        if len(others) < 2:
            raise ValueError(f"two poses to compare with are needed, got {len(others)}")
        max_time_diff = 0.5 * float(np.diff(others).min())
    if not 0 <= max_time_diff < np.inf:
        raise ValueError(f"max_time_diff must be a number of seconds, got {max_time_diff:g}")
    if not len(times):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    right_indices = np.clip(np.searchsorted(times, others), 1, max(len(times) - 1, 1))
    if len(times) == 1:
        nearest = np.zeros(len(others), np.int64)
    else:
        nearest = np.where(
            others - times[right_indices - 1] <= times[right_indices] - others, right_indices - 1, right_indices
        )
    other_indices = np.flatnonzero(np.abs(times[nearest] - others) <= max_time_diff)
    return np.asarray(nearest[other_indices], dtype=np.int64), np.asarray(other_indices, dtype=np.int64)


def compute_statistics(errors: FloatArray) -> dict[str, float]:
    """Compute summary statistics of n errors."""
    return {
        "rmse": float(np.sqrt(np.mean(errors**2))),
        "mean": float(errors.mean()),
        "median": float(np.median(errors)),
        "std": float(errors.std()),
        "min": float(errors.min()),
        "max": float(errors.max()),
    }


def _align_umeyama(points: FloatArray, targets: FloatArray, with_scale: bool) -> tuple[Rotation, FloatArray, float]:
    """Fit rotation, translation and scale from points to targets (Umeyama).

    The sum of |scale R points + t - targets|² is minimized.
    """
    a, b = points - points.mean(axis=0), targets - targets.mean(axis=0)
    for centered in (a, b):
        spread = np.linalg.svd(centered, compute_uv=False)
        if not spread[1] > MIN_SPREAD_RATIO * spread[0]:
            raise ValueError(
                "se3 and sim3 align positions, but these are on a line or at one point, which leaves the rotation "
                "undetermined; use first or none"
            )
    rotation = Rotation.align_vectors(b, a)[0]
    scale = float(np.sum(b * rotation.apply(a)) / np.sum(a * a)) if with_scale else 1.0
    if not scale > 0:
        raise ValueError("sim3: no positive scale fits the positions")
    return rotation, targets.mean(axis=0) - scale * rotation.apply(points.mean(axis=0)), scale


def _align_both_frames(estimate: RigidTransform, reference: RigidTransform) -> RigidTransform:
    """Fit X T_k Y to Q_k: first by the rotations of X and Y, then by the positions."""
    rotations, reference_rotations = estimate.rotation, reference.rotation
    # Rotations since the first and since the last pose are the same up to X, which maps their axes to each other.
    axes, reference_axes = (
        np.concatenate([(sequence * sequence[k].inv()).as_rotvec() for k in (0, len(sequence) - 1)])
        for sequence in (rotations, reference_rotations)
    )
    for vectors in (axes, reference_axes):
        spread = np.linalg.svd(vectors, compute_uv=False)
        if not spread[1] > MIN_SPREAD_RATIO * max(spread[0], MIN_SPREAD_RATIO):
            raise ValueError(
                "both needs rotations about several axes, but these are about one or none; use first, se3 or sim3"
            )
    world = Rotation.align_vectors(reference_axes, axes)[0]
    for _ in range(MAX_ITERATIONS):
        previous = world
        object_ = ((world * rotations).inv() * reference_rotations).mean()
        world = (reference_rotations * (rotations * object_).inv()).mean()
        if (world * previous.inv()).magnitude() < 1e-14:
            break
    # q = X (R o + p) + t is linear in the object's origin o and the translation t.
    rotated = (world * rotations).as_matrix()
    rows = np.concatenate([rotated, np.broadcast_to(np.eye(3), rotated.shape)], axis=2).reshape(-1, 6)
    offsets = reference.translation - world.apply(estimate.translation)
    solution = np.linalg.lstsq(rows, offsets.ravel(), rcond=None)[0]
    positions = world.apply(estimate.translation) + (rows @ solution).reshape(-1, 3)
    return RigidTransform.from_components(positions, world * rotations * object_)
