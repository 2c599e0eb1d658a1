"""How far two trajectories are apart: absolute and relative errors (ATE and RPE), after what may differ has been aligned.

J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; S. Umeyama, "Least-squares estimation of
transformation parameters between two point patterns", PAMI 1991.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray, IntArray

__all__ = ["Alignment", "Comparison", "compared", "pairs_in_time", "statistics"]

Alignment = Literal["first", "none", "se3", "sim3", "both"]
# Positions that spread across a line by less than this share of their length leave the turn about it open, and so do turns
# about one axis (choice: what noise of a thousandth of the way makes of a degree).
FLAT = 1e-3
# In which the turns of both frames settle (derived: each takes the error down by the share of turns about one axis).
ROUNDS = 100


@dataclass(frozen=True, eq=False)
class Comparison:
    """Errors of a trajectory against another one, its poses T_k told in the frames of the other's, Q_k.

    Attributes:
        align: what was allowed to differ.
        total: poses of the other trajectory; those of them with one in this, `len(times)`, are compared.
        times: (n,) of the other's poses.
        found, reference: n poses each, the former aligned.
        scale: by which lengths of this trajectory were multiplied: 1 but for "sim3".
        rotation: (n,) radians, of Q_k⁻¹ T_k.
        position: (n,) how far apart their origins are.
        relative_rotation, relative_position: (n - step,) of (Q_k⁻¹ Q_k+step)⁻¹ (T_k⁻¹ T_k+step).
    """

    align: Alignment
    total: int
    times: FloatArray
    found: RigidTransform
    reference: RigidTransform
    scale: float
    rotation: FloatArray
    position: FloatArray
    relative_rotation: FloatArray
    relative_position: FloatArray


def compared(
    times: FloatArray,
    poses: RigidTransform,
    reference_times: FloatArray,
    reference: RigidTransform,
    *,
    align: Alignment = "first",
    step: int = 1,
    within: float | None = None,
) -> Comparison:
    """Errors of m poses against n reference ones.

    Args:
        times, reference_times: (m,), (n,) increasing.
        align: what may differ. "first": the objects' frames: T_k is T_k T_0⁻¹ Q_0, motions since the first common pose.
            "none": nothing. "se3": the worlds, turned and moved so that positions fit best; "sim3": scaled, too. "both":
            the worlds and the objects' frames, so that first turns fit best, then positions.
        step: poses between which relative errors are.
        within: how far apart in time poses are that belong together; None for half of the reference's least step.

    Raises:
        ValueError: another alignment; fewer than two poses that belong together, or as many as the step; positions on a
            line, or turns about one axis, to which nothing can be aligned.
    """
    if align not in get_args(Alignment):
        raise ValueError(f"align must be one of {', '.join(get_args(Alignment))}, got {align!r}")
    if step < 1:
        raise ValueError(f"step must be at least 1, got {step}")
    ours, theirs = pairs_in_time(times, reference_times, within)
    if len(ours) < max(2, step + 1):
        raise ValueError(
            f"{len(ours)} of {len(reference_times)} poses have one of the other trajectory at their time; "
            f"{max(2, step + 1)} are needed"
        )
    found, right, scale = poses[ours], reference[theirs], 1.0
    if align == "first":
        found = found * found[0].inv() * right[0]
    elif align in ("se3", "sim3"):
        turn, shift, scale = _aligned(found.translation, right.translation, align == "sim3")
        place = scale * turn.apply(found.translation) + shift
        found = RigidTransform.from_components(place, turn * found.rotation)
    elif align == "both":
        found = _aligned_both(found, right)
    off = right.inv() * found
    relative = (right[:-step].inv() * right[step:]).inv() * (found[:-step].inv() * found[step:])
    return Comparison(
        align,
        len(reference_times),
        np.asarray(reference_times)[theirs],
        found,
        right,
        scale,
        np.asarray(off.rotation.magnitude()),
        np.linalg.norm(found.translation - right.translation, axis=1),
        np.asarray(relative.rotation.magnitude()),
        np.linalg.norm(relative.translation, axis=1),
    )


def pairs_in_time(times: FloatArray, others: FloatArray, within: float | None = None) -> tuple[IntArray, IntArray]:
    """Which of `times` belongs to which of `others`: for each of these the nearest, where it is within a distance.

    Args:
        times, others: (m,), (n,) increasing.
        within: None for half of the least step of `others`.

    Raises:
        ValueError: times that do not increase; fewer than two of `others` where `within` is None; a distance that is none.
    """
    for row in (times, others):
        if (np.diff(row) <= 0).any():
            raise ValueError("times must increase")
    if within is None:
        if len(others) < 2:
            raise ValueError(f"two poses to compare with are needed, got {len(others)}")
        within = 0.5 * float(np.diff(others).min())
    if not 0 <= within < np.inf:
        raise ValueError(f"within must be a number of seconds, got {within:g}")
    if not len(times):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    behind = np.clip(np.searchsorted(times, others), 1, max(len(times) - 1, 1))
    if len(times) == 1:
        nearest = np.zeros(len(others), np.int64)
    else:
        nearest = np.where(others - times[behind - 1] <= times[behind] - others, behind - 1, behind)
    theirs = np.flatnonzero(np.abs(times[nearest] - others) <= within)
    return np.asarray(nearest[theirs], dtype=np.int64), np.asarray(theirs, dtype=np.int64)


def statistics(errors: FloatArray) -> dict[str, float]:
    """Of n errors."""
    return {
        "rmse": float(np.sqrt(np.mean(errors**2))),
        "mean": float(errors.mean()),
        "median": float(np.median(errors)),
        "std": float(errors.std()),
        "min": float(errors.min()),
        "max": float(errors.max()),
    }


def _aligned(points: FloatArray, onto: FloatArray, scaled: bool) -> tuple[Rotation, FloatArray, float]:
    """Turn, shift and scale with the least sum of |scale turn(points) + shift - onto|² (Umeyama)."""
    a, b = points - points.mean(axis=0), onto - onto.mean(axis=0)
    for what in (a, b):
        spread = np.linalg.svd(what, compute_uv=False)
        if not spread[1] > FLAT * spread[0]:
            raise ValueError(
                "se3 and sim3 align positions, and these lie on a line or at a place, which leaves a turn open; take first "
                "or none"
            )
    turn = Rotation.align_vectors(b, a)[0]
    scale = float(np.sum(b * turn.apply(a)) / np.sum(a * a)) if scaled else 1.0
    if not scale > 0:
        raise ValueError("sim3 finds no scale with which positions fit")
    return turn, onto.mean(axis=0) - scale * turn.apply(points.mean(axis=0)), scale


def _aligned_both(found: RigidTransform, right: RigidTransform) -> RigidTransform:
    """X T_k Y that is nearest to Q_k: in turns first, of which both X and Y follow, then in positions."""
    ours, theirs = found.rotation, right.rotation
    # Turns since the first and since the last pose are the same about axes that X takes to each other.
    moved, wanted = (
        np.concatenate([(turns * turns[k].inv()).as_rotvec() for k in (0, len(turns) - 1)]) for turns in (ours, theirs)
    )
    for what in (moved, wanted):
        spread = np.linalg.svd(what, compute_uv=False)
        if not spread[1] > FLAT * max(spread[0], FLAT):
            raise ValueError(
                "both aligns by turns about several axes, and these are about one, or none; take first, se3 or sim3"
            )
    world = Rotation.align_vectors(wanted, moved)[0]
    for _ in range(ROUNDS):
        before = world
        object_ = ((world * ours).inv() * theirs).mean()
        world = (theirs * (ours * object_).inv()).mean()
        if (world * before.inv()).magnitude() < 1e-14:
            break
    # q = X (R o + p) + t is linear in the object's origin o and the shift t.
    turned = (world * ours).as_matrix()
    rows = np.concatenate([turned, np.broadcast_to(np.eye(3), turned.shape)], axis=2).reshape(-1, 6)
    rest = right.translation - world.apply(found.translation)
    solved = np.linalg.lstsq(rows, rest.ravel(), rcond=None)[0]
    places = world.apply(found.translation) + (rows @ solved).reshape(-1, 3)
    return RigidTransform.from_components(places, world * ours * object_)
