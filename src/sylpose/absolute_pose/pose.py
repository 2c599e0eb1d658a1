"""`estimate_pose`: where an object is, from points known in its own frame and seen by any of several cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.absolute_pose.pose_kernels import information, score
from sylpose.absolute_pose.pose_noise import CUTOFF
from sylpose.absolute_pose.pose_scale import other_size
from sylpose.absolute_pose.pose_search import MIN_MATCHES, Pose, best_poses, by_luck, contradicted
from sylpose.absolute_pose.pose_views import Views, views_of
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.duplicates import distinct
from sylpose.geometry.matrices import covariance_of
from sylpose.geometry.noise import USUAL_PX, NoisePx, NoiseUnits, noise_units
from sylpose.geometry.observability import UNSEEN_SHARE, UNSEEN_TURN, about_a_turn, unseen_directions
from sylpose.geometry.robust_loss import BIQUARTIC_BOUND
from sylpose.geometry.validation import finite_rows, items, kind_of, number, whole
from sylpose.results import Motion, Status
from sylpose.rig import MAX_LENGTH, MAX_PX, Rig

__all__ = ["estimate_pose"]

LEAST_ERROR = 1e-9  # no noise is less, pixels (choice)
# Usual noise is believed beforehand as if so many degrees of freedom had shown it: four matches, which leave two, may agree
# by far better than they were measured; noise that is said as if so many had, an eighth of its size (choice).
USUAL_FREEDOM, SAID_FREEDOM = 2.0, 30.0
# Of two poses that explain the matches nearly equally well, the better is believed from these odds on (measured: of flat
# models of 4 to 20 points before one camera that are OK, 1 in 250 is the mirror image; by odds of 3 1 in 20 is) (choice).
CLEAR_ODDS = 20.0


def estimate_pose(
    rig: Rig,
    points: Sequence[ArrayLike],
    pixels: Sequence[ArrayLike],
    *,
    max_error_px: float = 12.0,
    noise_px: NoisePx | None = None,
    seed: int = 0,
) -> Motion:
    """The object's pose from points known in its own frame, seen by any subset of the cameras: solvePnP for many cameras.

    Args:
        rig: C cameras.
        points: C arrays (n_c, 3), what each camera sees, in the object's frame; empty where it sees nothing.
        pixels: C arrays (n_c, 2), where it sees them, in the image as recorded (lens included). A match that is given
            several times counts once.
        max_error_px: matches further off than this are wrong, whatever the noise; set it to five times the largest
            noise that is to be expected.
        noise_px: (C,) what is known of the noise in each camera, the standard deviation of a coordinate, pixels; or a number
            by each camera's name. Cameras count accordingly, `max_error_px` is of the one with the least and, of others, in
            proportion, and no less noise is believed; where the matches show more, more is. Infinite: the camera has no say.
            None: the matches alone tell.
        seed: of the search. Same input and seed, same result.

    Returns:
        `Motion` with `motion` world_from_object; look at its `status` first. `center` is the mean of all given points, but
        for copies and what cameras without a say see, in the object's frame, as the centre of any motion is where it starts:
        `motion.apply(center)` is where it lies in the world, and the covariance is of (w, d) with d the error of that place.
        `residuals` are reprojection errors.
        Fewer than four different matches give TOO_FEW_MATCHES; points on one line TURN_NOT_OBSERVABLE; a place that is
        less certain than half of its distance from the cameras SCALE_NOT_OBSERVABLE; matches that agree no better than
        random ones, or cameras as many of which say another pose, NOT_CONSISTENT. Where the cameras would agree on points of
        another size, as of another unit, `faults` says so.

    Raises:
        ValueError: not one array per camera; shapes that do not fit; values that are not finite, naming the camera; a
            max_error_px that is not positive; noise of other cameras, or that none has.

    Source: docs/method.md, "A known model".
    """
    n = len(kind_of(rig, Rig, "rig"))
    points, pixels = items(points, "points", n), items(pixels, "pixels", n)
    max_error_px = number(max_error_px, "max_error_px", above=0.0, least=LEAST_ERROR, most=MAX_PX)
    seed = whole(seed, "seed")
    units = NoiseUnits(np.ones(n), 0.0) if noise_px is None else noise_units(noise_px, rig.names)
    models = [
        finite_rows(p, 3, f"camera {camera.name}: points", most=MAX_LENGTH)
        for camera, p in zip(rig, points, strict=True)
    ]
    places = [
        finite_rows(u, 2, f"camera {camera.name}: pixels", most=MAX_PX) for camera, u in zip(rig, pixels, strict=True)
    ]
    for camera, x, u in zip(rig, models, places, strict=True):
        if len(x) != len(u):
            raise ValueError(f"camera {camera.name}: {len(x)} points but {len(u)} pixels; give one pixel per point")
    options: dict[str, Any] = {"max_error_px": max_error_px, "noise_px": noise_px, "seed": seed}
    heard = units.per_px > 0.0
    if any(len(x) and not hears for x, hears in zip(models, heard, strict=True)):
        some = [[v if hears else v[:0] for v, hears in zip(vs, heard, strict=True)] for vs in (models, places)]
        found = estimate_pose(rig, *some, **options)
        masks = zip(found.inliers, models, heard, strict=True)
        return replace(found, inliers=tuple(m if hears else np.zeros(len(x), bool) for m, x, hears in masks))
    singles = [distinct(x, u) for x, u in zip(models, places, strict=True)]
    if any(single is not None for single in singles):
        once = [[v if s is None else v[s.rows] for v, s in zip(vs, singles, strict=True)] for vs in (models, places)]
        found = estimate_pose(rig, *once, **options)
        return replace(
            found, inliers=tuple(m if s is None else m[s.which] for m, s in zip(found.inliers, singles, strict=True))
        )
    counts = np.array([len(x) for x in models])
    model = np.concatenate(models)
    center = model.mean(axis=0) if len(model) else np.full(3, np.nan)
    if not _enough(model, np.repeat(np.arange(len(rig)), counts)):
        return _result(rig, counts, Status.TOO_FEW_MATCHES, center)
    used = np.flatnonzero(counts)
    cameras = [rig.cameras[c] for c in used]
    origin, views = views_of(cameras, model - center, [places[c] for c in used], units.per_px[used], units.least)
    top = float(max_error_px * units.per_px.max()) ** 2
    extent, axes = np.linalg.eigh(views.points.T @ views.points / len(model))
    if not extent[1] > 1e-12 * extent[2]:
        return _result(rig, counts, Status.TURN_NOT_OBSERVABLE, center, unseen=np.eye(6))
    poses = best_poses(views, top, axes[:, 0], np.random.default_rng(seed))
    if not poses:
        return _result(rig, counts, Status.NOT_CONSISTENT, center)
    best = poses[0]
    status = Status.OK if best.settled else Status.NOT_CONVERGED
    every = bool(best.weights.all())
    faults: tuple[str, ...] = ()
    if not every and by_luck(views, best):
        status = Status.NOT_CONSISTENT
    elif not every and contradicted(views, best, top, axes[:, 0], seed):
        status = Status.NOT_CONSISTENT
        if (size := other_size(views, top, axes[:, 0], seed)) is not None:
            times = np.format_float_positional(size, trim="-")
            faults = (
                f"the points would fit if they were {times} times as large: are they in another unit than the calibration?",
            )
    seen = np.empty((6, 6))
    information(views, best.rotation, best.place, best.noise, seen)
    seen *= _as_believed(best, units.least)
    unseen = np.empty((0, 6))
    if status is Status.OK:
        limits = _limits(views, best)
        weak = _unseen(views, poses, seen, limits, units.least)
        unseen = weak * limits
        if len(weak):
            status = Status.TURN_NOT_OBSERVABLE if about_a_turn(weak) else Status.SCALE_NOT_OBSERVABLE
        elif every and by_luck(views, best):
            status = Status.NOT_CONSISTENT
    found = _result(rig, counts, status, center, best, origin, seen, unseen)
    return replace(found, residuals=found.residuals / np.where(heard, units.per_px, 1.0), faults=faults)


def _enough(model: FloatArray, camera: IntArray) -> bool:
    """Whether at least `MIN_MATCHES` different points are seen, each point counted once per camera."""
    different = set()
    for k in range(len(model)):
        different.add((camera[k], *model[k]))
        if len(different) == MIN_MATCHES:
            return True
    return False


def _beforehand(said: float) -> tuple[float, float]:
    """The noise that is believed before the matches show it, pixels, and as if by how many degrees of freedom."""
    return (said, SAID_FREEDOM) if said > 0.0 else (USUAL_PX, USUAL_FREEDOM)


def _as_believed(pose: Pose, said: float) -> float:
    """What is left of a pose's information as its noise is itself estimated, so that the covariance is that of Student's
    distribution, and where it is less than what is believed of noise; `said` is the noise that is known, pixels, or 0."""
    believed, freedom = _beforehand(said)
    shown, known = float(np.median(pose.noise.variances)), pose.freedom + (freedom if said > 0.0 else 0.0)
    less = shown * (pose.freedom + freedom) / (pose.freedom * shown + freedom * believed**2)
    return max(known - 2.0, 0.5) / known * min(less, 1.0)


def _limits(views: Views, pose: Pose) -> FloatArray:
    """(6,) standard deviations beyond which (w, d) have not been seen: a turn, and half of the distance."""
    centers = -np.einsum("cij,ci->cj", views.turns, views.shifts)
    distance = float(np.linalg.norm(centers - pose.place, axis=1).min())
    return np.array([UNSEEN_TURN] * 3 + [UNSEEN_SHARE * distance] * 3)


def _unseen(views: Views, poses: Sequence[Pose], seen: FloatArray, limits: FloatArray, said: float) -> FloatArray:
    """The directions (k, 6) of (w, d) that are known to less than the limits, in units of these; or the one to another pose,
    turned by more, that explains the matches about as well."""
    best = poses[0]
    if len(weak := unseen_directions(seen, limits)):
        return weak
    (noise, freedom), top = _beforehand(said), CUTOFF**2 * float(np.median(best.noise.variances))
    losses = np.array([score(views, pose.rotation, pose.place, top, np.inf) for pose in poses])
    squares = BIQUARTIC_BOUND * top * losses + freedom * noise**2
    for pose, square in zip(poses[1:], squares[1:], strict=True):
        other = Rotation.from_matrix(pose.rotation @ best.rotation.T).as_rotvec()
        odds = 0.5 * (best.freedom + freedom) * np.log(square / squares[0])
        if np.linalg.norm(other) > UNSEEN_TURN and odds < np.log(CLEAR_ODDS):
            away = np.concatenate([other, pose.place - best.place])[None] / limits
            return away / np.linalg.norm(away)
    return weak


def _result(
    rig: Rig,
    counts: IntArray,
    status: Status,
    center: FloatArray,
    pose: Pose | None = None,
    origin: FloatArray | None = None,
    seen: FloatArray | None = None,
    unseen: FloatArray | None = None,
) -> Motion:
    """The public result; without a pose, of no inliers and no information."""
    agree = np.zeros(counts.sum(), bool) if pose is None else pose.weights > 0
    residuals, motion = np.full(len(counts), np.nan), None
    if pose is not None:
        camera = np.repeat(np.arange(len(counts)), counts)[agree]
        sums = np.bincount(camera, pose.squares[agree], len(counts))
        numbers = np.bincount(camera, minlength=len(counts))
        np.sqrt(sums / np.maximum(numbers, 1), out=residuals, where=numbers > 0)
    if pose is not None and origin is not None and status.has_pose:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = pose.rotation, origin + pose.place - pose.rotation @ center
        motion = RigidTransform(matrix, normalize=False)
    seen = np.zeros((6, 6)) if seen is None else seen
    return Motion(
        status=status,
        motion=motion,
        center=center,
        information=seen,
        covariance=covariance_of(seen),
        unseen=np.empty((0, 6)) if unseen is None else unseen,
        inliers=tuple(np.split(agree, np.cumsum(counts)[:-1])),
        residuals=residuals,
        method="pose",
        iterations=0 if pose is None else pose.rounds,
        camera_names=rig.names,
        unit=rig.unit,
    )
