"""A trajectory refined as a whole: all poses and all landmarks together, by what was seen in all frames.

The tracker knows the past only; this knows the future too. It uses the tracks of the landmarks and not the stored moments:
a landmark that is seen in many frames ties them all, with a depth that all of them have a share in, where moments of two
frames leave each depth open (docs/benchmarks.md, "Smoothing", has the figures).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import RigidTransform, RotationSpline

from sylpose.bundle_adjustment.bundle import Bundled, Observations
from sylpose.bundle_adjustment.calibration_refinement import MOVED_SHARE, Correction, Doubt, Moved, apart, with_moved
from sylpose.bundle_adjustment.lost_frames import given_up
from sylpose.bundle_adjustment.scale_prior import bundle_sized, length_is_open
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.validation import kind_of, listed, number, shown, truth, whole
from sylpose.results import FramePose, Observable, Status
from sylpose.rig import Rig
from sylpose.tracking.joint_state import Nudge
from sylpose.tracking.keyframes import inherited
from sylpose.tracking.reports import placed
from sylpose.tracking.tracked_frame import Sightings, TrackedFrame
from sylpose.tracking.wide_baseline_init import another_path

__all__ = ["Smoothed", "Track", "smooth"]


# Landmarks seen less often than this tell next to nothing of the motion, and that with a bias: features that slide
# along an edge or were confused are lost soon. They are used, the longer ones first, by frames with less than so many
# sights; those that were never seen to move by frames that have hardly any, so many (choice).
OFTEN, ENOUGH, FEW = (8, 5, 2), 100, 30
# Measured poses on each side of a gap that the curve through it goes by (choice).
AROUND = 3


@dataclass(frozen=True, eq=False)
class Track:
    """What smoothing keeps of a tracked frame: no images.

    Attributes:
        pose: as tracked; of a known object, of the frame that it was learnt in (`KnownHere.telling`).
        sightings: per camera.
        late: (C,) seconds.
        radius: of the object.
        nudges: of cameras, up to now.
        stays: whether its pose is not refined with others: that of a keyframe which another rig has seen.
    """

    pose: FramePose
    sightings: tuple[Sightings, ...]
    late: FloatArray
    radius: float
    nudges: tuple[Nudge, ...] = ()
    stays: bool = False

    @classmethod
    def of(cls, tracked: TrackedFrame) -> Track:
        """Of a frame that the tracker has yielded."""
        pose = tracked.pose if tracked.learnt is None else tracked.learnt
        return cls(pose, tracked.sightings, tracked.late, tracked.radius, tracked.nudges)


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A refined trajectory.

    Attributes:
        poses: of all frames; those that nothing ties to the first are as they were. Coasting ones go between what was
            measured before and after them. Where one of it is missing, or most of what a frame saw contradicts the others,
            poses as tracked are carried along with what was before.
        status: OK; NOT_CONVERGED; TOO_FEW_MATCHES when there was nothing to refine: then the poses are as they were.
        offsets: (C,) seconds by which each camera is late, their mean 0, and offsets_sd: (C,) their standard deviations;
            zeros when not asked for.
        sigma_px: (C,) noise of each camera, pixels.
        rounds: of the solver.
        length_sd: relative standard deviation of the path's length, all displacements of the object's origin being too
            long or too short by one factor: what a motion without turns leaves open. inf when nothing was displaced, or
            nothing refined.
        length_share: in [0, 1], the share of it in the variance of all displacements.
        correction: of the calibration, where that was asked for; with a camera more for each that was moved.
        moved: those, in order of time.
    """

    poses: tuple[FramePose, ...]
    status: Status
    offsets: FloatArray
    offsets_sd: FloatArray
    sigma_px: FloatArray
    rounds: int
    length_sd: float = np.inf
    length_share: float = 0.0
    correction: Correction | None = None
    moved: tuple[Moved, ...] = ()


def smooth(
    frames: Sequence[Track],
    rig: Rig,
    *,
    offsets_sd: float | None = None,
    doubt: Doubt | None = None,
    recalibrate: bool = False,
    moved: Sequence[Moved] = (),
    on_round: Callable[[int], None] | None = None,
) -> Smoothed:
    """Refines the poses of all frames together; the first one's stays, or those of the frames that say so.

    Args:
        frames: in order of time, all that the tracker gave.
        rig: the tracker's.
        offsets_sd: seconds; if given, how far apart in time the cameras are is estimated too, within about this.
        doubt, recalibrate: what may be wrong with the calibration (`usual_doubt`), and whether to estimate it, as in
            `bundle`.
        moved: which cameras stood elsewhere from which of the frames on, beside those that the tracker saw being nudged;
            where they stood is estimated, unless nothing is doubted.
        on_round: called with the number of each round of the refinement as it begins.

    Raises:
        ValueError, TypeError: naming the argument; `recalibrate` or `moved` cameras without a doubt.
    """
    n = len(kind_of(rig, Rig, "rig"))
    frames, moved = listed(frames, Track, "frames"), listed(moved, Moved, "moved")
    for k, frame in enumerate(frames):
        (
            kind_of(frame.pose, FramePose, f"frames[{k}]: pose"),
            listed(frame.sightings, Sightings, f"frames[{k}]: sightings"),
        )
    if offsets_sd is not None:
        number(offsets_sd, "offsets_sd", above=0.0)
    if doubt is not None and len(kind_of(doubt, Doubt, "doubt").turn) != n:
        raise ValueError(f"doubt is not of the rig's {n} cameras")
    if truth(recalibrate, "recalibrate") and doubt is None:
        raise ValueError("recalibrate: a calibration is estimated within a doubt, and there is none")
    for m in moved:
        whole(m.camera, "moved: camera", most=n - 1)
    if on_round is not None and not callable(on_round):
        raise TypeError(f"on_round must be a function, got {shown(on_round)}")
    if moved and doubt is None:
        raise ValueError("moved: cameras that were moved need a doubt, of where they were at first")
    nothing = np.zeros(len(rig))
    # A frame that taught nothing (before the object was seen to move) would only bend the way between its neighbours.
    used = [k for k, f in enumerate(frames) if f.pose.seen and any(len(seen.landmark) for seen in f.sightings)]
    poses = [frame.pose for frame in frames]
    if len(used) < 2 or all(frames[k].stays for k in used):
        return Smoothed(tuple(poses), Status.TOO_FEW_MATCHES, nothing, nothing, np.full(len(rig), np.nan), 0)
    seen, places = _observations([frames[k] for k in used])
    places = placed(places, frames[used[-1]].radius)  # nodes tell each other no more
    late, wider, camera = np.array([frames[k].late for k in used]), rig, seen.camera
    moves: tuple[Moved, ...] = ()
    if doubt is not None:
        nudged = _nudged(frames[used[-1]], rig)
        stood = {(m.camera, m.frame): m for m in (*moved, *nudged)}
        moves = tuple(sorted(stood.values(), key=lambda m: m.frame))
        wider, doubt = with_moved(rig, doubt, moves)
        index = np.array([frames[k].pose.index for k in used])[seen.frame]
        for i, m in enumerate(moves):
            camera = np.where((seen.camera == m.camera) & (index >= m.frame), len(rig) + i, camera)
        late = np.hstack([late, late[:, [m.camera for m in moves]]])
    sights, path, radius = (
        replace(seen, camera=camera),
        _stacked([frames[k].pose for k in used]),
        frames[used[-1]].radius,
    )
    stays = np.array([frames[k].stays for k in used])
    bundled = bundle_sized(
        wider,
        sights,
        path,
        radius,
        # Those that stay are of no path, and tell where the surface is.
        other=None if stays.any() else another_path(wider, sights, path, radius),
        fixed=stays if stays.any() else None,
        landmarks=places,
        times=np.array([frames[k].pose.time for k in used])[:, None] + late,
        offsets_sd=offsets_sd,
        doubt=doubt,
        recalibrate=recalibrate,
        on_round=on_round,
    )
    if bundled.status is not Status.TOO_FEW_MATCHES:
        open_length = length_is_open(bundled)
        counts, residuals = _per_camera(bundled, seen, len(used), len(rig))
        contradicted = given_up(bundled, seen)
        contradicted[stays] = contradicted[0] = False
        covariance = bundled.covariance
        if stays.any():
            own = np.array([frames[k].pose.covariance for k in used])
            covariance = covariance + inherited(bundled.world_from_object, own, stays)
        refined, astray = np.zeros((2, len(frames)), bool)
        refined[used], astray[used] = bundled.tied & ~contradicted, bundled.tied & contradicted
        for i, k in enumerate(used[1:], start=1):
            if refined[k]:
                poses[k] = replace(
                    poses[k],
                    world_from_object=bundled.world_from_object[i],
                    covariance=covariance[i],
                    observable=_observable(poses[k].observable, open_length),
                    inliers=counts[i],
                    residuals=residuals[i],
                ).judged()
        poses = _with_gaps_filled(poses, [frame.pose for frame in frames], refined, astray)
    return Smoothed(
        tuple(poses),
        bundled.status,
        bundled.offsets[: len(rig)],
        bundled.offsets_sd[: len(rig)],
        bundled.sigma_px[: len(rig)],
        bundled.rounds,
        bundled.length_sd,
        bundled.length_share,
        bundled.correction,
        moves,
    )


def _nudged(last: Track, rig: Rig) -> list[Moved]:
    """Where the cameras stand that were nudged, as the last frame knows it: with the turn goes a shift, which the background
    takes for a turn the more the nearer it is; it is taken to be behind the object."""
    where, shift = last.pose.world_from_object, MOVED_SHARE * apart(rig)
    assert where is not None
    far = np.linalg.norm(np.array([c.center for c in rig]) - where.translation, axis=1)
    return [Moved(n.camera, n.frame, float(np.hypot(n.sd, shift / far[n.camera])), n.turn) for n in last.nudges]


def _observable(before: Observable, open_length: bool) -> Observable:
    if before is Observable.NO_SCALE:
        return before
    return Observable.NO_LENGTH if open_length else Observable.ALL


def _stacked(poses: Sequence[FramePose]) -> RigidTransform:
    return RigidTransform.concatenate([p.world_from_object for p in poses if p.world_from_object is not None])


def _observations(frames: Sequence[Track]) -> tuple[Observations, FloatArray]:
    """Sights of the landmarks worth using, numbered from 0, and where each landmark was last thought to be."""
    counts = [[len(s.landmark) for s in f.sightings] for f in frames]
    cameras = np.concatenate([np.repeat(np.arange(len(n)), n) for n in counts])
    frame = np.repeat(np.arange(len(frames)), [sum(n) for n in counts])
    every = [s for f in frames for s in f.sightings]
    # Each camera has numbers of its own.
    number = np.concatenate([s.landmark for s in every])
    _, landmark = np.unique(cameras * (number.max(initial=0) + 1) + number, return_inverse=True)
    used = _worth_using(frame, landmark, np.bincount(landmark, np.concatenate([s.moved for s in every])) > 0)
    _, names = np.unique(landmark[used], return_inverse=True)
    places = np.zeros((int(names.max(initial=-1)) + 1, 3))
    places[names] = np.concatenate([s.place for s in every])[used]  # the last one counts
    image = np.concatenate([s.normalized for s in every])[used]
    return Observations(frame[used], cameras[used], names, image), places


def _worth_using(frame: IntArray, landmark: IntArray, moved: BoolArray) -> BoolArray:
    """(n,) which sights to use: those of landmarks seen often; where that leaves a frame few, of ones seen less often, and
    where that leaves it hardly any, of ones (m,) not known to have moved with the object, too: background is among them."""
    sights, used = np.bincount(landmark)[landmark], np.zeros(len(frame), bool)
    on_it = (sights >= OFTEN[0]) | moved[landmark]
    for counts, enough in ((on_it, ENOUGH), (np.ones_like(on_it), FEW)):
        for least in OFTEN:
            poor = np.bincount(frame, used) < enough
            used |= counts & (sights >= least) & (np.bincount(landmark, poor[frame])[landmark] > 0)
    return used


def _per_camera(bundled: Bundled, seen: Observations, n: int, cameras: int) -> tuple[IntArray, FloatArray]:
    """(n, C) numbers of inliers and their rms residuals in pixels, NaN without any."""
    good = bundled.weights > 0
    cell = (seen.frame * cameras + seen.camera)[good]
    counts = np.bincount(cell, minlength=n * cameras)
    squares = np.bincount(cell, bundled.residuals[good] ** 2, minlength=n * cameras)
    rms = np.sqrt(np.divide(squares, counts, out=np.full(n * cameras, np.nan), where=counts > 0))
    return counts.reshape(n, cameras).astype(np.int64), rms.reshape(n, cameras)


def _with_gaps_filled(
    poses: Sequence[FramePose], before: Sequence[FramePose], refined: BoolArray, astray: BoolArray
) -> list[FramePose]:
    """Coasting poses between two refined ones, with none lost between, go along a curve through what was measured around
    them; others, and those that went astray, keep their place relative to the last frame in which the object was seen,
    before -> now."""
    out = list(poses)
    known = refined & np.array([pose.measured for pose in poses])
    seen = [k for k, pose in enumerate(before) if pose.seen and not astray[k]]
    for i, k in enumerate(seen):
        end = seen[i + 1] if i + 1 < len(seen) else len(before)
        gap = [g for g in range(k + 1, end) if before[g].world_from_object is not None]
        coasting = not any(before[g].seen for g in gap)
        if coasting and end < len(before) and known[k] and known[end] and 0 < len(gap) == end - k - 1:
            around = [m for m in seen[max(0, i + 1 - AROUND) : i + 1 + AROUND] if known[m]]
            for g, pose in zip(gap, _between([poses[m] for m in around], [before[g].time for g in gap]), strict=True):
                near, far = (k, g - k) if g - k <= end - g else (end, end - g)
                # As uncertain as the nearer end, and what as many frames of coasting made of it.
                spread = poses[near].covariance + before[k + far].covariance
                out[g] = replace(before[g], world_from_object=pose, covariance=spread)
            continue
        old, new = before[k].world_from_object, poses[k].world_from_object
        for g in gap:
            there = before[g].world_from_object
            if old is not None and new is not None and there is not None:
                out[g] = replace(before[g], world_from_object=new * old.inv() * there)
    return out


def _between(known: Sequence[FramePose], times: Sequence[float]) -> RigidTransform:
    """Poses at times (n,), on cubic splines through known ones."""
    stacked, when = _stacked(known), np.array([pose.time for pose in known])
    places = CubicSpline(when, stacked.translation)(times)
    return RigidTransform.from_components(places, RotationSpline(when, stacked.rotation)(times))
