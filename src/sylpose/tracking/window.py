"""Sliding-window bundle adjustment of selected frames during tracking.

A frame's pose inherits the errors of the frames it is matched with. At intervals the keyframes and the latest frames
are refined jointly with the landmarks that several of them observe (`bundle_adjustment.bundle`). This corrects initial
errors, a scale that only a later rotation determines, and the drift up to a revisited side; later frames build on the
result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.bundle_adjustment.bundle import BundleOptions, BundleResult, Observations
from sylpose.bundle_adjustment.scale_prior import SMALL_ROTATION, bundle_adjust_with_scale, is_scale_unobservable
from sylpose.geometry.arrays import BoolArray, FloatArray, IntArray
from sylpose.geometry.future import BackgroundResult
from sylpose.geometry.rigid import relative_rotvec
from sylpose.results import MAX_ROTATION_SD, Status
from sylpose.rig import Rig
from sylpose.tracking.context import TrackerContext
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.joint_state import JointState, Refinement
from sylpose.tracking.keyframes import compute_viewpoints, find_nearest_views, inherit_covariance
from sylpose.tracking.reports import NewObservations, quantize_positions
from sylpose.tracking.wide_baseline_init import find_alternative_path

__all__ = ["bundle_frames", "collect_refinement", "enlarge_covariance", "is_refinement_due", "refine_window"]

# Maximum number of frames refined jointly, the first one and the last included (choice).
MAX_FRAMES = 32
# Maximum number of landmarks used per camera, those observed most often first (choice).
MAX_LANDMARKS = 150
# With at least so many moved landmarks, those that never moved are omitted (choice).
MIN_MOVED_LANDMARKS = 20
# After the first frames, a refinement is due once the object has rotated by this since the last one (radians) or moved
# by this share of its radius, as less motion shows little new; at the earliest after `MIN_INTERVAL` frames, at the
# latest after `MAX_INTERVAL` (choice).
MIN_NEW_ROTATION, MIN_NEW_TRANSLATION, MIN_INTERVAL, MAX_INTERVAL = np.radians(10.0), 0.3, 4, 12
# Minimum number of frames for a refinement; and for one that changes poses, as fewer frames do not determine depths
# well enough (choice).
MIN_FRAMES, MIN_FRAMES_TO_APPLY = 2, 9
# If the last refinement is at least so many frames ago, the next one runs in the background and is applied so many
# frames later (choice).
BACKGROUND_INTERVAL, RESULT_DELAY = 8, 5
# A refinement is valid if it changes the last pose by less than this rotation (radians) and share of the object's
# radius (choice).
MAX_ROTATION_CHANGE, MAX_TRANSLATION_CHANGE = 0.1, 0.3
# Maximum number of solver iterations: it starts near the solution (choice).
MAX_ROUNDS = 12
# Upper limit of landmark numbers (derived).
MAX_LANDMARK_ID = 2**32


def is_refinement_due(state: JointState) -> bool:
    """Return whether the last solved frame is to be refined with others.

    The first frames always are; later ones are after enough new motion.
    """
    last, before = state.last_frame, state.last_refined
    if state.pending_refinement is not None:
        return False
    if before is None or last.number - state.keyframes[0].number <= MIN_FRAMES_TO_APPLY:
        return True
    change, since = _compute_pose_change(before, last.world_from_object), last.number - before.number
    is_new = (
        np.linalg.norm(change[:3]) > MIN_NEW_ROTATION
        or np.linalg.norm(change[3:]) > MIN_NEW_TRANSLATION * state.object.radius
    )
    return since >= MAX_INTERVAL or (since >= MIN_INTERVAL and bool(is_new))


def refine_window(context: TrackerContext, state: JointState) -> JointState:
    """Refine the keyframes and the last frames jointly; each camera updates its landmarks.

    With few frames, or if the refinement diverges, it only updates the uncertainty of the path's scale and of the last
    frame's pose.

    Where the object shows little that is new, the refinement runs in the background and `collect_refinement` applies it
    some frames later.
    """
    frames = _select_frames(state)
    if len(frames) < MIN_FRAMES:
        return state
    numbers = [frame.number for frame in frames]
    is_urgent = state.last_refined is None or state.last_frame.number - state.last_refined.number < BACKGROUND_INTERVAL
    earlier = state.shared_observations or (NewObservations.empty(),) * len(context.rig)
    new = context.executor.all_gather(
        lambda c: _collect_new_observations(context, state, c, numbers, earlier[c]), NewObservations.empty()
    )
    shared = [
        shared_by_camera.merge(new_by_camera) for shared_by_camera, new_by_camera in zip(earlier, new, strict=True)
    ]
    state = replace(
        state,
        shared_observations=tuple(shared_by_camera.select(sorted(state.known_frames)) for shared_by_camera in shared),
        last_refined=state.last_frame,
    )
    used = [
        shared_by_camera.select(numbers, new_by_camera.landmark_ids)
        for shared_by_camera, new_by_camera in zip(shared, new, strict=True)
    ]
    landmark_cameras = np.repeat(np.arange(len(new)), [len(shared_by_camera.landmark_ids) for shared_by_camera in new])
    if not len(landmark_cameras):
        return state
    found = BackgroundResult(bundle_frames, *_build_bundle_input(context, frames, used, new), state.object.radius)
    pending = Refinement(
        state.last_frame.number,
        tuple(frames),
        landmark_cameras,
        tuple(shared_by_camera.landmark_ids for shared_by_camera in new),
        found,
    )
    state = replace(state, pending_refinement=pending)
    return _apply_refinement(context, state, pending) if is_urgent else state


def collect_refinement(context: TrackerContext, state: JointState, number: int) -> JointState:
    """Apply a background refinement once it is due in the frame with this number."""
    pending = state.pending_refinement
    return (
        state
        if pending is None or number < pending.number + RESULT_DELAY
        else _apply_refinement(context, state, pending)
    )


def _apply_refinement(context: TrackerContext, state: JointState, pending: Refinement) -> JointState:
    """Apply a refinement; frames solved since then follow the correction of its last frame."""
    state, frames = replace(state, pending_refinement=None), pending.frames
    bundled = _add_fixed_covariance(pending.result.value(), frames)
    if bundled.status is Status.TOO_FEW_MATCHES:
        return state
    state = replace(state, path_scale_sd=bundled.scale_sd if is_scale_unobservable(bundled) else 0.0)
    at = [frame.number for frame in frames].index(pending.number)  # for buffered frames it is not the last one
    last, refined_to = frames[at], bundled.world_from_object[at]
    change = _compute_pose_change(last, refined_to)
    is_near = (
        np.linalg.norm(change[:3]) < MAX_ROTATION_CHANGE
        and np.linalg.norm(change[3:]) < MAX_TRANSLATION_CHANGE * state.object.radius
    )
    is_settled = len(frames) >= MIN_FRAMES_TO_APPLY and bundled.status is Status.OK and is_near
    if is_settled and _has_known_depth(bundled, pending.landmark_cameras):
        state = replace(state, object=replace(state.object, is_depth_guessed=False))
    known_frames = state.known_frames
    # In boxes the solution may be the mirrored rotation, and converge there too.
    if not is_settled or state.object.is_depth_guessed:
        is_uncertain = np.sqrt(np.diag(bundled.covariance[at])[:3].max()) > MAX_ROTATION_SD
        if not bundled.connected[at] or is_uncertain:  # the frame is unconstrained
            return state
        # The covariance includes the difference between the two estimates, which use the same matches.
        inflated = enlarge_covariance(last.covariance, bundled.covariance[at]) + np.outer(change, change)
        known = (
            {last.number: replace(known_frames[last.number], covariance=inflated)}
            if last.number in known_frames
            else {}
        )
        return replace(state.replace_frames(known), refined_covariance=inflated)
    poses = {
        frame.number: (bundled.world_from_object[k], bundled.covariance[k])
        for k, frame in enumerate(frames)
        if bundled.connected[k] and frame.number in known_frames and not frame.is_fixed
    }
    if bundled.connected[at]:
        correction = refined_to * last.world_from_object.inv()
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

    def update_camera(c: int) -> None:
        is_local = pending.landmark_cameras == c
        if is_local.any():
            context.camera_trackers[c].table.move(pending.landmark_ids[c], bundled.landmarks[is_local])

    context.executor.map_cameras(update_camera, is_slow=True)
    return replace(
        state.replace_frames(moved), refined_covariance=bundled.covariance[at] if bundled.connected[at] else None
    )


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


def _compute_pose_change(last: SolvedFrame, refined_pose: RigidTransform) -> FloatArray:
    """Return the change (6,) (w, d) of a frame's pose by the refinement."""
    before = last.world_from_object
    return np.concatenate([relative_rotvec(before, refined_pose), refined_pose.translation - before.translation])


def enlarge_covariance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a covariance (6, 6) not smaller than either input in any direction.

    Args:
        a: positive definite; enlarged wherever it is smaller than b.
        b: lower bound.
    """
    root = np.linalg.cholesky(a)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ b @ inverse.T)
    out = root @ vectors @ np.diag(np.maximum(values, 1.0)) @ vectors.T @ root.T
    return np.asarray(0.5 * (out + out.T))


def _select_frames(state: JointState) -> list[SolvedFrame]:
    """Select the frames to refine, in order of time.

    These are the first keyframe, the last frame, the recent ones and evenly spaced others; of fixed keyframes those
    with the nearest viewpoints.
    """
    fixed = [frame for frame in state.keyframes if frame.is_fixed]
    moving = {
        frame.number: frame for frame in (*state.keyframes, *state.recent, state.last_frame) if not frame.is_fixed
    }
    frames = [moving[number] for number in sorted(moving)]
    if fixed:
        views = state.last_frame.viewpoints
        near = [find_nearest_views(fixed, c, view, MAX_FRAMES // (2 * len(views)) + 1) for c, view in enumerate(views)]
        nearest_frames = {frame.number: frame for its in near for frame in its}
        return [*(nearest_frames[number] for number in sorted(nearest_frames)), *frames[-MAX_FRAMES // 2 :]]
    if len(frames) <= MAX_FRAMES:
        return frames
    recent = frames[-MAX_FRAMES // 2 :]
    older = frames[: -MAX_FRAMES // 2]
    spread = np.unique(np.linspace(0, len(older) - 1, MAX_FRAMES - len(recent)).astype(int))
    chosen = {frame.number: frame for frame in (*(older[k] for k in spread), *recent, state.last_frame)}
    return [chosen[number] for number in sorted(chosen)]


def _collect_new_observations(
    context: TrackerContext, state: JointState, c: int, numbers: Sequence[int], shared: NewObservations
) -> NewObservations:
    """Select a camera's landmarks and its observations not shared before, in given frames."""
    camera_tracker = context.camera_trackers[c]
    frames = [camera_tracker.frames[number] for number in numbers]
    frame = np.repeat(np.asarray(numbers, np.int64), [len(frame.landmark_ids) for frame in frames])
    landmark = np.concatenate([np.empty(0, np.int64), *(frame.landmark_ids for frame in frames)])
    image = np.concatenate([np.empty((0, 2)), *(frame.features.normalized for frame in frames)])
    # A landmark matched with two features of a frame is ambiguous there.
    keys, first, count = np.unique(_compute_keys(frame, landmark), return_index=True, return_counts=True)
    keys, first = keys[count == 1], first[count == 1]
    known, inverse, counts = np.unique(landmark[first], return_inverse=True, return_counts=True)
    # Once the object has moved, landmarks that never did may be background, which a path with less rotation explains as
    # well.
    moved = camera_tracker.table.get(known).has_moved
    is_usable = moved if np.count_nonzero(moved) >= MIN_MOVED_LANDMARKS else np.ones(len(known), bool)
    # Observations of landmarks merged with others since are partly invalid.
    shared_here = shared.select(numbers)
    invalid = shared_here.landmark[~np.isin(_compute_keys(shared_here.frame, shared_here.landmark), keys)]
    good = np.flatnonzero((counts > 1) & is_usable & ~np.isin(known, invalid))
    good = np.sort(good[np.argsort(-counts[good], kind="stable")[:MAX_LANDMARKS]])
    is_new = first[np.isin(inverse, good) & ~np.isin(keys, _compute_keys(shared_here.frame, shared_here.landmark))]
    # Initial positions need little precision.
    positions = quantize_positions(camera_tracker.table.get(known[good]).mean, state.object.radius)
    return NewObservations(frame[is_new], landmark[is_new], image[is_new], known[good], positions)


def _compute_keys(frame: IntArray, landmark: IntArray) -> IntArray:
    """Return a unique key (n,) for each pair of frame (n,) and landmark (n,)."""
    return frame * MAX_LANDMARK_ID + landmark


def _build_bundle_input(
    context: TrackerContext,
    frames: Sequence[SolvedFrame],
    used: Sequence[NewObservations],
    new: Sequence[NewObservations],
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
    options = BundleOptions(fixed=is_fixed, landmarks=landmarks, times=times, max_iterations=MAX_ROUNDS, coarse=True)
    # Fixed frames form no path, and determine the depth.
    alternative = find_alternative_path(rig, observations, poses, radius) if is_fixed is None else None
    return bundle_adjust_with_scale(rig, observations, poses, radius, options, alternative_start=alternative)
