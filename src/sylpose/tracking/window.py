"""Sliding-window bundle adjustment of selected frames during tracking.

A frame's pose inherits the errors of the frames it is matched with. At intervals the keyframes and the latest frames
are refined jointly with the landmarks that several of them observe (`bundle_adjustment.bundle`). This corrects initial
errors, a scale that only a later rotation determines, and the drift up to a revisited side; later frames build on the
result.

An alternative initial path from wide-baseline motions checks the sequential poses. If the object rotates slowly, is
nearly planar or is visible in few cameras, its first small rotation barely separates motion from depth. A wrong depth
then makes each next pose consistent with the previous ones, and joint refinement ends in the nearest local minimum with
false certainty. Two distant frames are free of this: the landmarks observed in both are matches, which one large motion
explains or not, with depth unknown (`estimate_motion`). If that motion contradicts the path, the path is bent to agree
with it, as another start of the refinement, and the likelier result is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.bundle_adjustment.bundle import BundleOptions, BundleResult, Observations
from sylpose.bundle_adjustment.calibration_refinement import default_calibration_prior
from sylpose.bundle_adjustment.scale_prior import SMALL_ROTATION, bundle_adjust_with_scale, is_scale_unobservable
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.future import BackgroundResult
from sylpose.geometry.matrices import enlarge_covariance
from sylpose.relative_pose.limits import MAX_ROUNDS
from sylpose.results import MAX_ROTATION_SD
from sylpose.rig import Rig
from sylpose.status import Status
from sylpose.tracking.camera_side.camera import CameraTracker
from sylpose.tracking.context import Context
from sylpose.tracking.joint_side.joint_state import (
    RETRY_FRAMES,
    JointState,
    PendingRefinement,
    SolvedFrame,
    compute_pose_change,
    compute_viewpoints,
    find_nearest_views,
    inherit_covariance,
)
from sylpose.tracking.joint_side.object_model import MIN_SURFACE_POINTS
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.pose_search import SAME_PLACE_RATIO
from sylpose.tracking.reports import NewObservations, quantize_positions

# If the last refinement is at least so many frames ago, the next one runs in the background: its result is used before
# another one is due (derived).
BACKGROUND_INTERVAL = RETRY_FRAMES
# A refinement is valid if it turns the last pose by less than this, radians, and moves it by less than `SAME_PLACE_RATIO`
# (choice: with 10 degrees, a faint object was tracked up to 8 degrees off instead of uncertain).
MAX_ROTATION_CHANGE = 0.1
# Upper limit of landmark numbers (derived).
MAX_LANDMARK_ID = 2**32


def refine_window(context: Context, state: JointState) -> JointState:
    """Refine the keyframes and the last frames jointly; each camera updates its landmarks.

    With few frames, or if the refinement diverges, it only updates the uncertainty of the last frame's pose.

    Where the object shows little that is new, and live, the refinement runs in the background and is applied some frames
    later (`JointState.is_refinement_ready`).
    """
    frames, last, before = _select_frames(state, context.options.max_window_frames), state.last, state.refinement.last
    if len(frames) < 2:
        return state
    numbers = [frame.number for frame in frames]
    is_urgent = before is None or (context.search_clock is None and last.number - before.number < BACKGROUND_INTERVAL)
    earlier = state.refinement.shared or (NewObservations(),) * len(context.rig)
    own_new = [
        _collect_new_observations(camera, numbers, earlier[camera.index], state.object.radius, context.options)
        for camera in context.cameras
    ]
    new = context.executor.gather(own_new, NewObservations())
    shared = [old.merge(added) for old, added in zip(earlier, new, strict=True)]
    known = sorted(state.frames.by_number)
    refinement = replace(state.refinement, shared=tuple(seen.select(known) for seen in shared), last=last)
    landmark_cameras = np.repeat(np.arange(len(new)), [len(added.landmark_ids) for added in new])
    if not len(landmark_cameras):
        return replace(state, refinement=refinement)
    used = [seen.select(numbers, added.landmark_ids) for seen, added in zip(shared, new, strict=True)]
    found = BackgroundResult(bundle_frames, *_build_bundle_input(context, frames, used, new), state.object.radius)
    pending = PendingRefinement(
        last.number, tuple(frames), landmark_cameras, tuple(added.landmark_ids for added in new), found
    )
    state = replace(state, refinement=replace(refinement, pending=pending))
    return apply_refinement(context, state) if is_urgent else state


def apply_refinement(context: Context, state: JointState) -> JointState:
    """Apply the pending refinement; frames solved since it began follow the correction of its last frame."""
    pending = state.refinement.pending
    assert pending is not None
    refinement, frames = replace(state.refinement, pending=None), pending.frames
    state, bundled = replace(state, refinement=refinement), _add_fixed_covariance(pending.result.value(), frames)
    if bundled.status is Status.TOO_FEW_MATCHES:
        return state
    at = [frame.number for frame in frames].index(pending.number)  # for buffered frames it is not the last one
    refinement = replace(refinement, rests_on_prior=bool(bundled.rests_on_prior[at]))
    state = replace(state, refinement=refinement)
    last, refined_to = frames[at], bundled.world_from_object[at]
    change = compute_pose_change(last.world_from_object, refined_to)
    is_near = (
        np.linalg.norm(change[:3]) < MAX_ROTATION_CHANGE
        and np.linalg.norm(change[3:]) < SAME_PLACE_RATIO * state.object.radius
    )
    # Fewer than the recent frames and the first one do not determine depths well enough; with fixed keyframes, about half of
    # the window remains.
    n_enough = min(context.options.n_recent_frames, context.options.max_window_frames // 2)
    is_settled = len(frames) > n_enough and bundled.status is Status.OK and is_near
    if is_settled and _has_known_depth(bundled, pending.landmark_cameras):
        state = replace(state, object=replace(state.object, is_depth_guessed=False))
    # In boxes the solution may be the mirrored rotation, and converge there too.
    if is_settled and not state.object.is_depth_guessed:
        return _move_frames(context, state, pending, bundled, at)
    is_uncertain = np.sqrt(np.diag(bundled.covariance[at])[:3].max()) > MAX_ROTATION_SD
    if not bundled.connected[at] or is_uncertain:  # the frame is unconstrained
        return state
    # The covariance includes the difference between the two estimates, which use the same matches.
    inflated, known = enlarge_covariance(last.covariance, bundled.covariance[at]) + np.outer(change, change), {}
    if (present := state.frames.by_number.get(last.number)) is not None:
        known = {last.number: replace(present, covariance=inflated)}
    refinement = replace(refinement, covariance=inflated)
    return replace(state, frames=state.frames.replace_frames(known), refinement=refinement)


def _move_frames(
    context: Context, state: JointState, pending: PendingRefinement, bundled: BundleResult, at: int
) -> JointState:
    """Move the known frames to their refined poses, and the landmarks with them.

    Args:
        at: index of the last refined frame.
    """
    frames, known_frames = pending.frames, state.frames.by_number
    poses = {
        frame.number: (bundled.world_from_object[k], bundled.covariance[k])
        for k, frame in enumerate(frames)
        if bundled.connected[k] and frame.number in known_frames and not frame.is_fixed
    }
    if bundled.connected[at]:
        correction = bundled.world_from_object[at] * frames[at].world_from_object.inv()
        poses |= {
            k: (correction * f.world_from_object, f.covariance)
            for k, f in known_frames.items()
            if k > frames[-1].number
        }
    moved = {
        k: replace(
            known_frames[k],
            world_from_object=pose,
            covariance=covariance,
            viewpoints=compute_viewpoints(context.rig, pose),
        )
        for k, (pose, covariance) in poses.items()
    }
    context.executor.run(partial(_move_landmarks, pending=pending, positions=bundled.landmarks), context.cameras)
    refinement = replace(state.refinement, covariance=bundled.covariance[at] if bundled.connected[at] else None)
    return replace(state, frames=state.frames.replace_frames(moved), refinement=refinement)


def _move_landmarks(camera: CameraTracker, pending: PendingRefinement, positions: FloatArray) -> None:
    """Move one camera's landmarks, given the refined positions (m, 3) of all cameras'."""
    is_own = pending.landmark_cameras == camera.index
    if is_own.any():
        camera.table.move(pending.landmark_ids[camera.index], positions[is_own])


def _add_fixed_covariance(bundled: BundleResult, frames: Sequence[SolvedFrame]) -> BundleResult:
    """Add the fixed frames' covariance to that of the refined ones."""
    is_fixed, covariances = (
        np.array([frame.is_fixed for frame in frames]),
        np.array([frame.covariance for frame in frames]),
    )
    if not is_fixed.any():
        return bundled
    return replace(
        bundled, covariance=bundled.covariance + inherit_covariance(bundled.world_from_object, covariances, is_fixed)
    )


def _has_known_depth(bundled: BundleResult, landmark_cameras: IntArray) -> bool:
    """Return whether the refinement determines depth, beyond what boxes provide.

    That requires a rotation on which more than two cameras agree: two may agree on its mirror image, concave for
    convex.

    Args:
        landmark_cameras: (m,) camera of each landmark.
    """
    poses = bundled.world_from_object
    max_angle = (poses.rotation * poses.rotation[0].inv()).magnitude().max()
    return (
        bool(max_angle > SMALL_ROTATION) and len(np.unique(landmark_cameras)) > 2 and not is_scale_unobservable(bundled)
    )


def _select_frames(state: JointState, max_frames: int) -> list[SolvedFrame]:
    """Select the frames to refine, in order of time.

    These are the first keyframe, the last frame, the recent ones and evenly spaced others; of fixed keyframes those
    with the nearest viewpoints.
    """
    keyframes, last = state.frames.keyframes, state.last
    fixed = [frame for frame in keyframes if frame.is_fixed]
    # Frames from which nothing is learned would move the landmarks.
    known = (*keyframes, *state.frames.recent, last)
    moving = {frame.number: frame for frame in known if not (frame.is_fixed or frame.n_uncertain)}
    frames = [moving[number] for number in sorted(moving)]
    if fixed:
        views = last.viewpoints
        near = [find_nearest_views(fixed, c, view, max_frames // (2 * len(views)) + 1) for c, view in enumerate(views)]
        nearest_frames = {frame.number: frame for its in near for frame in its}
        return [*(nearest_frames[number] for number in sorted(nearest_frames)), *frames[-max_frames // 2 :]]
    if len(frames) <= max_frames:
        return frames
    recent = frames[-max_frames // 2 :]
    older = frames[: -max_frames // 2]
    spread = np.unique(np.linspace(0, len(older) - 1, max_frames - len(recent)).astype(int))
    chosen = {frame.number: frame for frame in (*(older[k] for k in spread), *recent, last)}
    return [chosen[number] for number in sorted(chosen)]


def _collect_new_observations(
    camera: CameraTracker, numbers: Sequence[int], shared: NewObservations, radius: float, options: TrackingOptions
) -> NewObservations:
    """Select a camera's landmarks and its observations not shared before, in given frames."""
    frames = [camera.frames[number] for number in numbers]
    frame = np.repeat(np.asarray(numbers, np.int64), [len(frame.landmark_ids) for frame in frames])
    landmark = np.concatenate([np.empty(0, np.int64), *(frame.landmark_ids for frame in frames)])
    image = np.concatenate([np.empty((0, 2)), *(frame.features.normalized for frame in frames)])
    # A landmark matched with two features of a frame is ambiguous there.
    keys, first, count = np.unique(_compute_keys(frame, landmark), return_index=True, return_counts=True)
    keys, first = keys[count == 1], first[count == 1]
    known, inverse, counts = np.unique(landmark[first], return_inverse=True, return_counts=True)
    # Once the object has moved, landmarks that never did may be background, which a path with less rotation explains as
    # well.
    moved = camera.table.get(known).has_moved
    is_usable = moved if np.count_nonzero(moved) >= MIN_SURFACE_POINTS else np.ones(len(known), bool)
    # Observations of landmarks merged with others since are partly invalid.
    shared_here = shared.select(numbers)
    invalid = shared_here.landmark[~np.isin(_compute_keys(shared_here.frame, shared_here.landmark), keys)]
    good = np.flatnonzero((counts > 1) & is_usable & ~np.isin(known, invalid))
    good = np.sort(good[np.argsort(-counts[good], kind="stable")[: options.max_window_landmarks]])
    is_new = first[np.isin(inverse, good) & ~np.isin(keys, _compute_keys(shared_here.frame, shared_here.landmark))]
    # Initial positions need little precision.
    positions = quantize_positions(camera.table.get(known[good]).mean, radius)
    return NewObservations(frame[is_new], landmark[is_new], image[is_new], known[good], positions)


def _compute_keys(frame: IntArray, landmark: IntArray) -> IntArray:
    """Return a unique key (n,) for each pair of frame (n,) and landmark (n,)."""
    return frame * MAX_LANDMARK_ID + landmark


def _build_bundle_input(
    context: Context, frames: Sequence[SolvedFrame], used: Sequence[NewObservations], new: Sequence[NewObservations]
) -> tuple[Rig, Observations, RigidTransform, FloatArray, FloatArray, BoolArray | None]:
    """Build the input of `bundle_frames`.

    Args:
        used: per camera, the observations used.
        new: per camera, the landmarks and their positions.

    Returns:
        rig; observations; poses; landmark positions; times at which each camera took each frame; which frames are
        fixed, or None if none is.
    """
    cameras = np.repeat(np.arange(len(used)), [len(seen.frame) for seen in used])
    starts = np.cumsum([0, *(len(seen.landmark_ids) for seen in new)])
    landmark = [starts[c] + np.searchsorted(new[c].landmark_ids, seen.landmark) for c, seen in enumerate(used)]
    observations = Observations(
        np.searchsorted([frame.number for frame in frames], np.concatenate([seen.frame for seen in used])),
        cameras,
        np.concatenate(landmark).astype(np.int64),
        np.concatenate([seen.image for seen in used]),
    )
    poses = RigidTransform.concatenate([frame.world_from_object for frame in frames])
    times = np.array([frame.time + frame.time_offsets for frame in frames])
    if (np.diff(times.mean(axis=1)) <= 0).any():  # the reported time offsets are inconsistent
        times = np.array([frame.time for frame in frames])
    is_fixed = np.array([frame.is_fixed for frame in frames])
    positions = np.concatenate([seen.positions for seen in new])
    return context.rig, observations, poses, positions, times, is_fixed if is_fixed.any() else None


def bundle_frames(
    rig: Rig,
    observations: Observations,
    poses: RigidTransform,
    landmarks: FloatArray,
    times: FloatArray,
    is_fixed: BoolArray | None,
    radius: float,
) -> BundleResult:
    """Refine the frames jointly; see `_build_bundle_input`."""
    options = BundleOptions(
        fixed=is_fixed,
        landmarks=landmarks,
        times=times,
        calibration_prior=default_calibration_prior(rig),
        max_iterations=MAX_ROUNDS,
        coarse=True,
    )
    result = bundle_adjust_with_scale(rig, observations, poses, radius, options)
    # The landmarks, which later frames are aligned with, are of the cameras as calibrated, so the poses are not changed.
    change = result.calibration_change
    return replace(result, covariance=result.covariance + change[:, :, None] * change[:, None])
