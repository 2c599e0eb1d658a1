"""Joint refinement of a whole trajectory: all poses, all landmarks, and what each camera has once for all frames: how far in
front of the object the surface is that it sees and, if asked, by how much it is late.

Robust least squares on reprojection errors ("bundle adjustment") with static, calibrated cameras: a landmark X of the
object is seen by camera c in frame k at project(Q_c (R_k X + t_k - o_c)). Levenberg-Marquardt with re-weighting; the
landmarks are eliminated (Schur complement), which leaves six unknowns per frame and a border of what cameras share.

Source: B. Triggs, P. McLauchlan, R. Hartley, A. Fitzgibbon, "Bundle adjustment - a modern synthesis", 2000.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.calibration_refinement import EXACT, Correction, Doubt, correction_of, doubting, rescaled
from sylpose.bundle_adjustment.camera_parameters import offsets_and_surfaces, on_surface, usual_surfaces
from sylpose.bundle_adjustment.covisibility import pattern_of, tied_frames
from sylpose.bundle_adjustment.kernels import OFFSET, Sightings
from sylpose.bundle_adjustment.optimizer import minimise, refined
from sylpose.bundle_adjustment.problem import Fit, Problem, State
from sylpose.bundle_adjustment.scale_observability import told_by_noise
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.results import Status
from sylpose.rig import Rig

__all__ = ["Bundled", "Observations", "bundle", "stays_of"]


# Every pose is known to half a turn and to some of the object's radii around its start: what nothing ties stays there
# (choice).
WEAK_TURN, WEAK_RADII = np.pi, 10.0


@dataclass(frozen=True, eq=False)
class Observations:
    """n sights of landmarks.

    Attributes:
        frame, camera, landmark: (n,) which landmark is seen by which camera in which frame; any order.
        image: (n, 2) normalised points.
    """

    frame: IntArray
    camera: IntArray
    landmark: IntArray
    image: FloatArray

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, eq=False)
class Bundled:
    """A refined trajectory.

    Attributes:
        status: OK; NOT_CONVERGED within the bound of rounds; TOO_FEW_MATCHES when no frame is tied to a fixed one: then
            the poses are those given.
        world_from_object: N poses.
        landmarks: (M, 3) object's frame; those seen less than twice are as given, or on their ray, or at the origin.
        covariance: (N, 6, 6) of (w, d), docs/conventions.md, relative to the fixed frames, where it is zero.
        tied: (N,) frames that landmarks tie to a fixed frame, directly or through others. Others keep about the poses
            given, with a covariance as wide as the object's size and half a turn.
        sigma_px: (C,) noise of each camera, pixels, of one coordinate; NaN for a camera without observations.
        weights: (n,) in [0, 1], 0 for outliers and for landmarks seen less than twice.
        residuals: (n,) pixels; 1e6 behind a camera.
        offsets: (C,) seconds by which each camera is late, their mean 0; offsets_sd: (C,) their standard deviations, which
            come near the prior's where the motion does not show them. Zeros when not asked for.
        rounds: of Levenberg-Marquardt.
        excess: (N,) by what the variances are larger than independent noise of sigma_px would have them, at least 1:
            errors are alike along tracks, and where the calibration is off (`spread`).
        length_sd: relative standard deviation of the path's length, all displacements of the object's origin being too
            long or too short by one factor: what a motion without turns leaves open. inf when nothing was displaced.
        length_share: in [0, 1], the share of it in the variance of all displacements.
        correction: of the calibration, if that was asked for.
        doubt_shares: (4,) 1, then by what share of the doubt the cameras' turns, their shifts and their lenses seem to be
            off; 1 where nothing was doubted.
        away: (N, 3, 3) covariance of where the surface is that cameras see, all its observations together, from the object's
            origin: `bent`.
    """

    status: Status
    world_from_object: RigidTransform
    landmarks: FloatArray
    covariance: FloatArray
    tied: BoolArray
    sigma_px: FloatArray
    weights: FloatArray
    residuals: FloatArray
    offsets: FloatArray
    offsets_sd: FloatArray
    rounds: int
    excess: FloatArray
    length_sd: float
    length_share: float
    correction: Correction | None
    doubt_shares: FloatArray
    away: FloatArray


def bundle(
    rig: Rig,
    seen: Observations,
    world_from_object: RigidTransform,
    radius: float,
    *,
    landmarks: ArrayLike | None = None,
    fixed: ArrayLike | None = None,
    information: ArrayLike | None = None,
    times: ArrayLike | None = None,
    offsets_sd: float | None = None,
    surfaces: tuple[ArrayLike, ArrayLike] | None = None,
    surfaces_stay: bool = False,
    doubt: Doubt | None = None,
    recalibrate: bool = False,
    max_rounds: int = 30,
    roughly: bool = False,
    on_round: Callable[[int], None] | None = None,
) -> Bundled:
    """Refines poses and landmarks jointly, so that the landmarks project to where they are seen.

    Args:
        rig: C cameras.
        seen: n observations; landmarks seen by several cameras or found again later tie more, but need not exist.
        world_from_object: N poses, about right.
        radius: of the object.
        landmarks: (M, 3) where to start, object's frame; None: where the rays meet.
        fixed: (N,) frames whose poses stay, at least one; None: the first.
        information: (N, 6, 6) of (w, d), what is known of the poses beside the observations: they were measured as given.
        times: (N,) or (N, C) seconds: when each camera took each frame. The pose of a frame is that at the mean of its
            times; each camera's own instant is reached along a parabola through neighbouring poses. Rising; None: 0, 1, ...
        offsets_sd: seconds; if given, the cameras' time offsets are estimated, starting from zero plus or minus this.
        surfaces: mean (C,) and covariance (C, C), length units, of how far the surface that a camera sees is in front of the
            object's origin, towards that camera: its landmarks lie on it give or take three radii and a slope. What is
            believed of it does not average out, so it is all that tells the length of a motion without turns; any turn
            soon tells more. None: `usual_surfaces`, those of ordinary bodies of the radius.
        surfaces_stay: do not ask whether turns tell where the surfaces are: they stay where they are believed to be.
        doubt: what may be wrong with the calibration. It is then in the covariance, as much as the recording shows it to be
            wrong; None: nothing. Where cameras stand that were bumped into is estimated.
        recalibrate: estimate all of that, instead of only counting it.
        max_rounds: bound.
        roughly: end a seventh of a standard deviation per frame before the optimum, after half of the rounds; not for
            `recalibrate`.
        on_round: called with the number of each round as it begins.

    Raises:
        ValueError: shapes or indices that do not fit, values that are not finite, no fixed frame, times that do not rise.
    """
    n_frames, n_cameras = (1 if world_from_object.single else len(world_from_object)), len(rig)
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius: {radius} is not a positive length")
    if offsets_sd is not None and not (np.isfinite(offsets_sd) and offsets_sd > 0):
        raise ValueError(f"offsets_sd: {offsets_sd} is not a positive time")
    stays = stays_of(fixed, n_frames)
    known = np.zeros((n_frames, 6, 6)) if information is None else _finite("information", information, (n_frames, 6, 6))
    given = None if landmarks is None else _finite("landmarks", landmarks, (-1, 3))
    n_landmarks = int(np.max(seen.landmark, initial=-1)) + 1 if given is None else len(given)
    _check_observations(seen, n_frames, n_cameras, n_landmarks)
    instants = np.arange(n_frames) if times is None else np.asarray(times, float)
    instants = _finite("times", instants, (n_frames, n_cameras) if instants.ndim == 2 else (n_frames,))
    instants = instants if instants.ndim == 2 else np.repeat(instants[:, None], n_cameras, axis=1)
    moments = instants.mean(axis=1)
    if (np.diff(moments) <= 0).any():
        raise ValueError("times: must rise from frame to frame")

    turns, places = np.atleast_3d(world_from_object.rotation.as_matrix()), world_from_object.translation
    turns, places = turns.reshape(-1, 3, 3), places.reshape(-1, 3)
    order, names, sightings = _sorted(seen, stays)
    often = np.diff(sightings.start) >= 2
    tied = tied_frames(sightings, often, stays | known.any(axis=(1, 2)))
    depth, depth_covariance = usual_surfaces(radius, n_cameras) if surfaces is None else surfaces
    shared = offsets_and_surfaces(
        n_cameras,
        offsets_sd,
        np.unique(sightings.camera),
        _finite("surfaces: mean", depth, (n_cameras,)),
        _finite("surfaces: covariance", depth_covariance, (n_cameras, n_cameras)),
    )
    weak = np.repeat([WEAK_TURN**-2, (WEAK_RADII * radius) ** -2], 3)
    shifts = instants - moments[:, None]
    problem = Problem(
        sightings=sightings,
        counted=np.repeat(often, np.diff(sightings.start)).astype(float),
        pattern=pattern_of(sightings, often),
        start_turns=turns,
        start_places=places,
        prior=known + np.diag(weak),
        radius=radius,
        times=moments,
        shifts=shifts,
        timed=bool(np.abs(shifts).max() > 0) or shared.n_offsets > 0,
        shared=shared,
        rotations=np.array([camera.rotation for camera in rig]),
        centers=np.array([camera.center for camera in rig]),
        focals=np.array([camera.focal for camera in rig]),
    )
    state = State(
        turns, places, np.zeros((len(names), 3)), np.zeros(shared.spread.shape[2]), np.zeros((n_frames, 2, 6))
    )
    state = problem.with_motion(state)
    state = replace(state, points=problem.where_rays_meet(state) if given is None else given[names])
    problem = _on_surfaces(problem, state)
    moved = doubt is not None and bool((doubt.before >= 0).any())
    if doubt is not None and moved:
        # Where cameras stand that were bumped into has to be free from the first: all poses would go astray.
        problem, state = rescaled(*doubting(problem, state, rig, doubt), EXACT)
    if surfaces_stay:
        problem = problem.with_depths_held()
    if (tied & ~stays).any():
        fit = minimise(problem, state, max_rounds, on_round, roughly=roughly)
    else:
        unknown, e = np.zeros(len(seen)), problem.residuals(state)
        sigma = problem.noise(e, unknown)
        fit = Fit(state, Status.TOO_FEW_MATCHES, 0, problem.weights(e, sigma), sigma, unknown)
    summary = problem.summary(fit, tied)
    if not surfaces_stay and (tied & ~stays).any() and told_by_noise(problem, fit, summary, tied):
        problem = problem.with_depths_held()
        state = replace(fit.state, z=np.where(problem.shared.depths, 0.0, fit.state.z))
        fit = minimise(problem, state, max_rounds, on_round, roughly=roughly)
        summary = problem.summary(fit, tied)
    if doubt is not None:
        problem, state = rescaled(problem, fit.state, np.ones(4)) if moved else doubting(problem, fit.state, rig, doubt)
        fit = replace(fit, state=state)
        if recalibrate and (tied & ~stays).any():
            problem, fit, summary = refined(problem, fit, rig, sightings.image, tied, max_rounds, on_round)
        else:
            summary = problem.summary(fit, tied)
    state, shared = fit.state, problem.shared
    correction = correction_of(shared, rig, doubt.before, state.z, summary.shared) if doubt is not None else None

    points = np.zeros((n_landmarks, 3)) if given is None else given.copy()
    points[names] = state.points
    weights, distances = np.empty(len(seen)), np.empty(len(seen))
    weights[order], distances[order] = fit.weights, np.linalg.norm(problem.residuals(state), axis=1)
    asked = offsets_sd is not None
    unused = np.setdiff1d(np.arange(n_cameras), seen.camera)
    summary.sigma[unused] = np.nan
    spread = np.sqrt(np.einsum("ck,kl,cl->c", shared.spread[:, OFFSET], summary.shared, shared.spread[:, OFFSET]))
    if asked:
        spread[unused] = offsets_sd
    return Bundled(
        fit.status,
        RigidTransform.from_components(state.places, Rotation.from_matrix(state.turns)),
        points,
        summary.covariance,
        tied,
        summary.sigma,
        weights,
        distances,
        shared.of(state.z)[:, OFFSET],
        spread,
        fit.rounds,
        summary.excess,
        summary.length_sd,
        summary.length_share,
        correction if recalibrate else None,
        summary.doubt_shares,
        summary.away,
    )


def _finite(name: str, values: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """The values as an array of that shape (-1: any) and of finite numbers."""
    array = np.asarray(values, dtype=float)
    if array.ndim != len(shape) or any(want not in (-1, got) for want, got in zip(shape, array.shape, strict=True)):
        wanted = ", ".join("any" if n < 0 else str(n) for n in shape)
        raise ValueError(f"{name}: shape {array.shape}, expected ({wanted})")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: has values that are not finite")
    return array


def stays_of(fixed: ArrayLike | None, n_frames: int) -> BoolArray:
    """(N,) which frames' poses stay: `bundle`'s `fixed`."""
    stays = np.arange(n_frames) == 0 if fixed is None else np.asarray(fixed, dtype=bool)
    if stays.shape != (n_frames,):
        raise ValueError(f"fixed: shape {stays.shape}, expected ({n_frames},), one per pose")
    if not stays.any() or stays.all():
        raise ValueError("fixed: at least one frame must stay and at least one move")
    return stays


def _check_observations(seen: Observations, n_frames: int, n_cameras: int, n_landmarks: int) -> None:
    n = len(seen)
    for name, index, size in (
        ("frame", seen.frame, n_frames),
        ("camera", seen.camera, n_cameras),
        ("landmark", seen.landmark, n_landmarks),
    ):
        if np.shape(index) != (n,) or not np.issubdtype(np.asarray(index).dtype, np.integer):
            raise ValueError(f"observations: {name} must be ({n},) integers")
        if n and not (np.min(index) >= 0 and np.max(index) < size):
            raise ValueError(f"observations: {name} must be from 0 to {size - 1}")
    _finite("observations: image", seen.image, (n, 2))


def _sorted(seen: Observations, stays: BoolArray) -> tuple[IntArray, IntArray, Sightings]:
    """Order of the observations (n,), indices of the landmarks that are seen (m,), and the sightings; no surfaces yet."""
    order = np.lexsort((seen.camera, seen.frame, seen.landmark))
    names, counts = np.unique(seen.landmark, return_counts=True)
    free = np.where(stays, -1, np.cumsum(~stays) - 1).astype(np.int64)
    frame, camera = (np.asarray(index[order], np.int64) for index in (seen.frame, seen.camera))
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    image, lens = np.ascontiguousarray(seen.image[order], dtype=float), np.zeros((len(order), 3, 0))
    nothing = np.zeros((len(names), 3))
    return order, names, Sightings(start, frame, camera, image, lens, free, camera[start[:-1]], nothing, nothing)


def _on_surfaces(problem: Problem, state: State) -> Problem:
    """With where each landmark was first seen from, and how far to the side of the object's origin it then was."""
    seen = problem.sightings
    k, viewer = seen.frame[seen.start[:-1]], seen.viewer
    back = state.turns[k].transpose(0, 2, 1)
    centers = np.einsum("mij,mj->mi", back, problem.centers[viewer] - state.places[k])
    axes = np.einsum("mij,mkj->mki", back, problem.rotations[viewer][:, :2])
    toward, across = on_surface(state.points, centers, axes, problem.radius)
    return replace(problem, sightings=seen._replace(toward=toward, across=across))
