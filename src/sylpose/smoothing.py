"""Joint refinement of a trajectory: all poses and landmarks from the observations in all frames.

The tracker uses only past frames; this also uses later ones. It uses the landmarks' tracks, not the stored moments: a
landmark observed in many frames connects all of them and has one common depth, where moments of two frames leave each
depth undetermined (docs/history/benchmarks.md, "Smoothing", has the figures).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import RigidTransform, RotationSpline

from sylpose.bundle_adjustment.bundle import BundleOptions, BundleResult, Observations
from sylpose.bundle_adjustment.calibration_refinement import (
    MOVED_TRANSLATION_RATIO,
    CalibrationCorrection,
    CalibrationPrior,
    MovedCamera,
    add_moved_cameras,
    compute_mean_camera_distance,
    default_calibration_prior,
)
from sylpose.bundle_adjustment.keyframes import bundle_adjust_by_keyframes, correlate_errors
from sylpose.bundle_adjustment.scale_prior import bundle_adjust_with_scale, find_lost_frames
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.blas_threads import limit_blas_threads
from sylpose.geometry.matrices import enlarge_covariance
from sylpose.geometry.validation import check_bool, check_integer, check_list, check_number, check_type, format_value
from sylpose.relative_pose.camera_evidence import pool_f_ratios
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Rig
from sylpose.status import FrameStatus, Observability, Status
from sylpose.tracking.camera_side.frame import LandmarkObservations
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.joint_side.joint_state import Nudge, compute_pose_change, inherit_covariance, is_change_explained
from sylpose.tracking.known_object import TransferredObject
from sylpose.tracking.reports import quantize_positions
from sylpose.units import INITIAL_DISTANCES

# Landmarks with fewer observations contain little information on the motion, and biased: features that slide along an
# edge or were mismatched are soon lost. They are used, the longer tracks first, by frames with fewer than so many
# observations; those never seen to move by frames with very few, so many (choice).
MIN_TRACK_LENGTHS, ENOUGH_OBSERVATIONS, FEW_OBSERVATIONS = (8, 5, 2), 100, 30
# Reason of frames that the refined path does not explain.
LOST_REASON = "most observations contradict the refined path"
# Measured poses on each side of a gap that determine the interpolating curve (choice).
N_NEIGHBORS = 3


@dataclass(frozen=True, eq=False)
class Track:
    """Data of a tracked frame that smoothing keeps, without images.

    Attributes:
        pose: as tracked; for a known object, in the frame in which it was mapped (`TransferredObject.converter`).
        observations: landmark observations per camera.
        time_offsets: (C,) time offsets, seconds.
        radius: radius of the object.
        nudges: camera motions so far.
        is_fixed: whether its pose is fixed: that of a keyframe observed by another rig.
    """

    pose: FramePose
    observations: tuple[LandmarkObservations, ...]
    time_offsets: FloatArray
    radius: float
    nudges: tuple[Nudge, ...] = ()
    is_fixed: bool = False

    @classmethod
    def from_tracked(cls, tracked: TrackedFrame) -> Track:
        """Return the track of a frame yielded by the tracker."""
        pose = tracked.pose if tracked.learned_pose is None else tracked.learned_pose
        return cls(pose, tracked.observations, tracked.time_offsets, tracked.radius, tracked.nudges)


@dataclass(frozen=True, eq=False)
class SmoothedTrajectory:
    """A refined trajectory.

    Attributes:
        poses: of all frames, none with a better status than tracked. Those not connected to the first one are
            unchanged. Coasting ones are interpolated between the measured ones before and after. Without one of these,
            tracked poses are moved along with the previous measured one; so are those of frames most of whose
            observations disagree with the others, which become contradicted. Covariances of refined ones are at
            least the share of the tracked ones that errors along tracks have in common (`correlate_errors`).
        status: OK; NOT_CONVERGED, or TOO_FEW_MATCHES when there was nothing to refine: then the poses are unchanged.
        offsets: (C,) time offset of each camera, seconds, positive for a delay; their mean is 0. Zeros if not requested
            or not OK.
        offsets_sd: (C,) their standard deviations.
        sigma_px: (C,) noise of each camera, pixels.
        iterations: iterations of the solver.
        scale_sd: relative standard deviation of the path's length: of a common factor of all translations of the
            object's origin, which a motion without rotation does not determine. inf without any translation or
            refinement.
        scale_variance_ratio: in [0, 1], its fraction of the variance of all translations.
        correction: correction of the calibration, if requested; with an additional camera for each that was moved.
        moved_cameras: the moved cameras, in order of time.
    """

    poses: tuple[FramePose, ...]
    status: Status
    offsets: FloatArray
    offsets_sd: FloatArray
    sigma_px: FloatArray
    iterations: int
    scale_sd: float = np.inf
    scale_variance_ratio: float = 0.0
    correction: CalibrationCorrection | None = None
    moved_cameras: tuple[MovedCamera, ...] = ()


def smooth(frames: Iterable[TrackedFrame], rig: Rig) -> Trajectory:
    """Refine the poses of all tracked frames jointly, as `track_session` does.

    Args:
        frames: all frames that `track` yields, in order of time. Pass its iterator rather than a list: the images are
            dropped frame by frame.
        rig: the rig that they were tracked with.

    Returns:
        the refined trajectory; the poses as tracked, with a warning (`warnings.warn`), if they cannot be refined.

    Raises:
        TypeError: naming the argument: other frames, or no rig.
        ValueError: frames of another rig, or of an object known from another recording, which only `track_session`
            refines.
    """
    n, tracks = len(check_type(rig, Rig, "rig")), list[Track]()
    if not isinstance(frames, Iterable):
        raise TypeError(f"frames must be what `track` yields, got {format_value(frames)}")
    for k, frame in enumerate(frames):
        if check_type(frame, TrackedFrame, f"frames[{k}]").learned_pose is not None:
            raise ValueError(f"frames[{k}]: of an object known from another recording; use `track_session`")
        if len(frame.observations) != n:
            raise ValueError(f"frames[{k}]: tracked with {len(frame.observations)} cameras, the rig has {n}")
        tracks.append(Track.from_tracked(frame))
    result = smooth_tracks(tracks, rig, calibration_prior=default_calibration_prior(rig))
    if result.status is not Status.OK:
        warnings.warn(f"smoothing: {result.status.text} The poses are as tracked.", stacklevel=2)
    return Trajectory(result.poses, rig.names, rig.unit if n > 1 else INITIAL_DISTANCES)


@limit_blas_threads()
def smooth_tracks(
    frames: Sequence[Track],
    rig: Rig,
    *,
    offsets_sd: float | None = None,
    calibration_prior: CalibrationPrior | None = None,
    recalibrate: bool = False,
    moved_cameras: Sequence[MovedCamera] = (),
    on_iteration: Callable[[int], None] | None = None,
) -> SmoothedTrajectory:
    """Refine the poses of all frames jointly; the first one, or those marked as fixed, do not change.

    Args:
        frames: all frames of the tracker, in order of time.
        rig: the tracker's.
        offsets_sd: seconds; if given, the cameras' time offsets are estimated as well, with this prior standard
            deviation.
        calibration_prior: prior of calibration errors (`default_calibration_prior`), as in `bundle_adjust`.
        recalibrate: whether to estimate them, as in `bundle_adjust`.
        moved_cameras: cameras that were moved, and from which frame on, in addition to camera motions detected by the
            tracker; their new poses are estimated if a calibration prior is given.
        on_iteration: called with the number of each iteration of the refinement as it begins.

    Returns:
        the refined trajectory.

    Raises:
        ValueError, TypeError: naming the argument; `recalibrate` or `moved_cameras` without a calibration prior.
    """
    arguments = offsets_sd, calibration_prior, recalibrate, on_iteration
    frames, moved_cameras = _check_arguments(frames, rig, moved_cameras, *arguments)
    n, poses, zeros = len(rig), [frame.pose for frame in frames], np.zeros(len(rig))
    # A frame without observations (before the object was seen to move) would only bend the path between its neighbors.
    used = [k for k, f in enumerate(frames) if f.pose.is_observed and any(len(s.landmark_ids) for s in f.observations)]
    # Frames that the cameras contradict would bend it as well, unless all are alike, or what they contradict is estimated.
    agreed = [k for k in used if frames[k].pose.status is not FrameStatus.CONTRADICTED]
    estimates_rig = recalibrate or offsets_sd is not None or len(moved_cameras) > 0
    used = agreed if 2 * len(agreed) > len(used) and not estimates_rig else used
    tracks = [frames[k] for k in used]
    if len(used) < 2 or all(track.is_fixed for track in tracks):
        return SmoothedTrajectory(tuple(poses), Status.TOO_FEW_MATCHES, zeros, zeros, np.full(n, np.nan), 0)
    observations, landmarks = collect_observations(tracks)
    landmarks = quantize_positions(landmarks, tracks[-1].radius)  # the precision that nodes exchange
    time_offsets, extended_rig, camera = np.array([track.time_offsets for track in tracks]), rig, observations.camera
    all_moved: tuple[MovedCamera, ...] = ()
    if calibration_prior is not None:
        moved_by_frame = {(m.camera, m.frame): m for m in (*moved_cameras, *_detected_moved_cameras(tracks[-1], rig))}
        all_moved = tuple(sorted(moved_by_frame.values(), key=lambda m: m.frame))
        extended_rig, calibration_prior = add_moved_cameras(rig, calibration_prior, all_moved)
        index = np.array([track.pose.index for track in tracks])[observations.frame]
        for i, m in enumerate(all_moved):
            camera = np.where((observations.camera == m.camera) & (index >= m.frame), n + i, camera)
        time_offsets = np.hstack([time_offsets, time_offsets[:, [m.camera for m in all_moved]]])
    start, radius = stack_poses([track.pose for track in tracks]), tracks[-1].radius
    is_fixed = np.array([track.is_fixed for track in tracks])
    options = BundleOptions(
        fixed=is_fixed if is_fixed.any() else None,
        landmarks=landmarks,
        times=np.array([track.pose.time for track in tracks])[:, None] + time_offsets,
        offsets_sd=offsets_sd,
        calibration_prior=calibration_prior,
        recalibrate=recalibrate,
        on_iteration=on_iteration,
    )
    extended = replace(observations, camera=camera)
    # Time offsets are reached along a curve through neighboring poses, and calibration errors show in all frames.
    needs_all = bool(time_offsets.any() or all_moved) or recalibrate or offsets_sd is not None
    adjust = bundle_adjust_with_scale if needs_all else bundle_adjust_by_keyframes
    result = adjust(extended_rig, extended, start, radius, options)
    if result.status is not Status.OK:  # no estimate: everything remains as tracked
        poses = _extend_contradiction(poses, frames)
        return SmoothedTrajectory(tuple(poses), result.status, zeros, zeros, result.sigma_px[:n], result.iterations)
    poses = _apply_result(frames, used, observations, result, n, estimates_rig=estimates_rig or len(all_moved) > 0)
    poses = _extend_contradiction(poses, frames)
    return SmoothedTrajectory(
        tuple(poses),
        result.status,
        result.offsets[:n],
        result.offsets_sd[:n],
        result.sigma_px[:n],
        result.iterations,
        result.scale_sd,
        result.scale_variance_ratio,
        result.correction,
        all_moved,
    )


def _check_arguments(
    frames: Sequence[Track],
    rig: Rig,
    moved_cameras: Sequence[MovedCamera],
    offsets_sd: float | None,
    calibration_prior: CalibrationPrior | None,
    recalibrate: bool,
    on_iteration: Callable[[int], None] | None,
) -> tuple[list[Track], list[MovedCamera]]:
    """Check the arguments of `smooth_tracks`; return its frames and moved cameras as lists."""
    n = len(check_type(rig, Rig, "rig"))
    frames, moved_cameras = check_list(frames, Track, "frames"), check_list(moved_cameras, MovedCamera, "moved_cameras")
    for k, frame in enumerate(frames):
        check_type(frame.pose, FramePose, f"frames[{k}]: pose")
        check_list(frame.observations, LandmarkObservations, f"frames[{k}]: observations")
    if offsets_sd is not None:
        check_number(offsets_sd, "offsets_sd", above=0.0)
    if calibration_prior is not None:
        check_type(calibration_prior, CalibrationPrior, "calibration_prior")
        if np.shape(calibration_prior.rotation_sd) != (n,):
            raise ValueError(f"calibration_prior: not for the rig's {n} cameras")
    if check_bool(recalibrate, "recalibrate") and calibration_prior is None:
        raise ValueError("recalibrate: requires a calibration_prior")
    if recalibrate and calibration_prior is not None and calibration_prior.covariance is not None:
        raise ValueError("recalibrate: the calibration_prior is of a calibration from the same observations")
    for m in moved_cameras:
        check_integer(m.camera, "moved_cameras: camera", maximum=n - 1)
    if on_iteration is not None and not callable(on_iteration):
        raise TypeError(f"on_iteration must be a function, got {format_value(on_iteration)}")
    if moved_cameras and calibration_prior is None:
        raise ValueError("moved_cameras: requires a calibration_prior")
    return frames, moved_cameras


def _apply_result(
    frames: Sequence[Track],
    used: Sequence[int],
    observations: Observations,
    result: BundleResult,
    cameras: int,
    *,
    estimates_rig: bool,
) -> list[FramePose]:
    """Return the poses of all frames, with those of the used ones refined.

    Args:
        observations: of the rig's cameras, before those that were moved became two.
        estimates_rig: whether the rig or the clocks of its cameras were estimated as well.
    """
    poses = [frame.pose for frame in frames]
    counts, residuals = _count_camera_inliers(result, observations, len(used), cameras)
    is_fixed, is_lost = np.array([frames[k].is_fixed for k in used]), find_lost_frames(result, observations)
    is_lost[is_fixed] = is_lost[0] = False
    f_ratios = np.array([frames[k].pose.f_ratio for k in used])
    covariance = result.covariance * np.fmax(1.0, np.fmax(f_ratios, pool_f_ratios(f_ratios)))[:, None, None]
    tracked_covariance = np.array([frames[k].pose.covariance for k in used])
    if is_fixed.any():
        covariance = covariance + inherit_covariance(result.world_from_object, tracked_covariance, is_fixed)
    # The refinement reduces only the share of a track's errors that frames do not have in common. Other errors of poses
    # that are uncertain as tracked are reduced; fixed frames are not refined.
    share = correlate_errors(observations, result)
    is_localized = np.array([frames[k].pose.status in (FrameStatus.TRACKED, FrameStatus.RELOCALIZED) for k in used])
    has_common = is_localized & (share > 0.0) & ~is_fixed
    has_common &= result.connected & np.isfinite(tracked_covariance).all(axis=(1, 2))
    has_common[0] = False  # the reference
    for i in np.flatnonzero(has_common).tolist():
        covariance[i] = enlarge_covariance(covariance[i], share * tracked_covariance[i])
    corrected = result.corrected_poses
    if not estimates_rig:  # its corrections move poses
        covariance = covariance + _measure_unexplained_changes(frames, used, result, corrected)
    is_refined, is_lost_frame = np.zeros((2, len(frames)), bool)
    is_refined[used], is_lost_frame[used] = result.connected & ~is_lost, result.connected & is_lost
    for i, k in enumerate(used[1:], start=1):
        if is_refined[k]:
            observability = Observability.NO_TRANSLATION_SCALE if result.rests_on_prior[i] else Observability.ALL
            if poses[k].observability is Observability.NO_SCALE:
                observability = Observability.NO_SCALE
            poses[k] = replace(
                poses[k],
                world_from_object=corrected[i],
                covariance=covariance[i],
                observability=observability,
                inliers=counts[i],
                residuals=residuals[i],
            ).mark_uncertain()
        elif is_lost_frame[k] and poses[k].status is not FrameStatus.FIRST:
            poses[k] = replace(poses[k], status=FrameStatus.CONTRADICTED, reason=poses[k].reason or LOST_REASON)
    return _fill_gaps(poses, [frame.pose for frame in frames], is_refined, is_lost_frame)


def _measure_unexplained_changes(
    frames: Sequence[Track], used: Sequence[int], result: BundleResult, corrected: RigidTransform
) -> FloatArray:
    """Return the squared changes (n, 6, 6) of poses by the refinement; zero if their uncertainty as tracked explains them.

    Others show a wrong model (of a body that is not rigid, tracker and refinement may follow different parts) or a biased
    tracker.
    """
    out = np.zeros((len(used), 6, 6))
    for i, k in enumerate(used[1:], start=1):  # the first one is the reference
        track, pose = frames[k], frames[k].pose
        if pose.world_from_object is None or not pose.is_measured or track.is_fixed or not result.connected[i]:
            continue
        change = compute_pose_change(pose.world_from_object, corrected[i])
        if np.isfinite(pose.covariance).all() and not is_change_explained(change, pose.covariance, track.radius):
            out[i] = np.outer(change, change)
    return out


def _extend_contradiction(poses: list[FramePose], frames: Sequence[Track]) -> list[FramePose]:
    """Return the poses, all of them contradicted if most were as tracked: then the rig is wrong in all frames."""
    tracked = [f.pose.status for f in frames if f.pose.is_observed and f.pose.status is not FrameStatus.FIRST]
    if 2 * tracked.count(FrameStatus.CONTRADICTED) <= len(tracked):
        return poses
    reason = "in most frames the cameras see different motions"
    return [
        replace(pose, status=FrameStatus.CONTRADICTED, reason=pose.reason or reason)
        if pose.is_measured and pose.status is not FrameStatus.FIRST
        else pose
        for pose in poses
    ]


def _detected_moved_cameras(last: Track, rig: Rig) -> list[MovedCamera]:
    """Return the moved cameras according to the last frame.

    A camera's rotation comes with a translation, which the background shows as a rotation, more so the nearer it is;
    the background is assumed to be behind the object.
    """
    pose, translation_sd = last.pose.world_from_object, MOVED_TRANSLATION_RATIO * compute_mean_camera_distance(rig)
    assert pose is not None
    distances = np.linalg.norm(np.array([c.center for c in rig]) - pose.translation, axis=1)
    sds = [float(np.hypot(nudge.sd, translation_sd / distances[nudge.camera])) for nudge in last.nudges]
    return [MovedCamera(n.camera, n.frame, sd, n.rotation) for n, sd in zip(last.nudges, sds, strict=True)]


def stack_poses(poses: Sequence[FramePose]) -> RigidTransform:
    return RigidTransform.concatenate([p.world_from_object for p in poses if p.world_from_object is not None])


def collect_observations(frames: Sequence[Track]) -> tuple[Observations, FloatArray]:
    """Return the observations of usable landmarks, renumbered from 0, and each landmark's last estimated position."""
    counts = [[len(s.landmark_ids) for s in f.observations] for f in frames]
    cameras = np.concatenate([np.repeat(np.arange(len(n)), n) for n in counts])
    frame = np.repeat(np.arange(len(frames)), [sum(n) for n in counts])
    all_observations = [s for f in frames for s in f.observations]
    # Landmark numbers are per camera.
    number = np.concatenate([s.landmark_ids for s in all_observations])
    _, landmark = np.unique(cameras * (number.max(initial=0) + 1) + number, return_inverse=True)
    has_moved = np.bincount(landmark, np.concatenate([s.has_moved for s in all_observations])) > 0
    used = _select_observations(frame, landmark, has_moved)
    _, indices = np.unique(landmark[used], return_inverse=True)
    landmarks = np.zeros((int(indices.max(initial=-1)) + 1, 3))
    landmarks[indices] = np.concatenate([s.positions for s in all_observations])[used]  # the last one wins
    image = np.concatenate([s.normalized for s in all_observations])[used]
    return Observations(frame[used], cameras[used], indices, image), landmarks


def _select_observations(frame: IntArray, landmark: IntArray, moved: BoolArray) -> BoolArray:
    """Return (n,) mask of the observations to use.

    Those of landmarks with many observations; in frames with few of these also ones with fewer observations; and in
    frames with very few also ones of landmarks not marked in `moved` (m,), which include background.
    """
    track_lengths, used = np.bincount(landmark)[landmark], np.zeros(len(frame), bool)
    on_object = (track_lengths >= MIN_TRACK_LENGTHS[0]) | moved[landmark]
    for counts, enough in ((on_object, ENOUGH_OBSERVATIONS), (np.ones_like(on_object), FEW_OBSERVATIONS)):
        for min_length in MIN_TRACK_LENGTHS:
            is_poor = np.bincount(frame, used) < enough
            used |= counts & (track_lengths >= min_length) & (np.bincount(landmark, is_poor[frame])[landmark] > 0)
    return used


def _count_camera_inliers(
    result: BundleResult, observations: Observations, n: int, cameras: int
) -> tuple[IntArray, FloatArray]:
    """Return (n, C) numbers of inliers and their rms residuals in pixels, NaN without any."""
    is_inlier = result.weights > 0
    cell = (observations.frame * cameras + observations.camera)[is_inlier]
    counts = np.bincount(cell, minlength=n * cameras)
    squares = np.bincount(cell, (result.residuals[is_inlier] ** 2).sum(axis=1), minlength=n * cameras)
    rms = np.sqrt(np.divide(squares, counts, out=np.full(n * cameras, np.nan), where=counts > 0))
    return counts.reshape(n, cameras).astype(np.int64), rms.reshape(n, cameras)


def _fill_gaps(
    poses: Sequence[FramePose], tracked: Sequence[FramePose], is_refined: BoolArray, is_lost_frame: BoolArray
) -> list[FramePose]:
    """Interpolate coasting poses between two refined ones, and move the others along with their predecessor.

    Coasting poses without lost ones between follow a curve through the measured ones around them. Others, and those of
    contradicted frames, keep their pose relative to the last frame in which the object was observed.
    """
    out = list(poses)  # contradicted frames have their lower status
    is_measured = is_refined & np.array([pose.is_measured for pose in poses])
    observed = [k for k, pose in enumerate(tracked) if pose.is_observed and not is_lost_frame[k]]
    for i, k in enumerate(observed):
        end = observed[i + 1] if i + 1 < len(observed) else len(tracked)
        gap = [g for g in range(k + 1, end) if tracked[g].world_from_object is not None]
        coasting = not any(tracked[g].is_observed for g in gap)
        if coasting and end < len(tracked) and is_measured[k] and is_measured[end] and 0 < len(gap) == end - k - 1:
            neighbors = [m for m in observed[max(0, i + 1 - N_NEIGHBORS) : i + 1 + N_NEIGHBORS] if is_measured[m]]
            interpolated = _interpolate_poses([poses[m] for m in neighbors], [tracked[g].time for g in gap])
            for g, pose in zip(gap, interpolated, strict=True):
                near, far = (k, g - k) if g - k <= end - g else (end, end - g)
                # The covariance of the nearer end plus that of as many frames of coasting.
                covariance = poses[near].covariance + tracked[k + far].covariance
                out[g] = replace(
                    tracked[g], status=FrameStatus.INTERPOLATED, world_from_object=pose, covariance=covariance
                )
            continue
        old, new = tracked[k].world_from_object, poses[k].world_from_object
        for g in gap:
            gap_pose = tracked[g].world_from_object
            if old is not None and new is not None and gap_pose is not None:
                # Of `out`, not `tracked`: contradicted frames keep that status.
                out[g] = replace(out[g], world_from_object=new * old.inv() * gap_pose)
    return out


def _interpolate_poses(poses: Sequence[FramePose], times: Sequence[float]) -> RigidTransform:
    """Interpolate poses at times (n,) by cubic splines."""
    stacked, known_times = stack_poses(poses), np.array([pose.time for pose in poses])
    translations = CubicSpline(known_times, stacked.translation)(times)
    return RigidTransform.from_components(translations, RotationSpline(known_times, stacked.rotation)(times))


def make_keyframe_tracks(transferred: TransferredObject, rig: Rig, time: float) -> list[Track]:
    """Return the model's keyframes as tracks to prepend to those of a recording.

    The recording was tracked with the model from its beginning (`Tracker`).

    Args:
        transferred: the model as transferred to this rig.
        rig: the tracker's.
        time: time of the recording's first frame.
    """
    tracks, n = [], len(transferred.keyframes)
    for k, frame in enumerate(transferred.keyframes):
        observations = []
        for name in rig.names:
            landmarks = transferred.landmarks.get(name)
            if landmarks is None:
                values = np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 3)), np.empty(0, bool)
            else:
                observed, normalized = landmarks.select_keyframe(k), landmarks.features[k].normalized
                values = landmarks.landmark_ids[k], normalized, observed.mean, observed.has_moved
            observations.append(LandmarkObservations(*values))
        counts = np.array([len(s.landmark_ids) for s in observations])
        status = FrameStatus.TRACKED if k else FrameStatus.FIRST
        residuals = np.full(len(rig), np.nan)
        pose = FramePose(k - n, time + k - n, status, frame.world_from_object, frame.covariance, counts, residuals)
        offsets, radius = np.zeros(len(rig)), transferred.known_object.radius
        tracks.append(Track(pose, tuple(observations), offsets, radius, is_fixed=frame.is_fixed))
    return tracks
